"""JAX functions as programs: traced by content, made scalar instructions, loops and calls, interpreted at a few points.

Knows nothing of dynamics.
"""
