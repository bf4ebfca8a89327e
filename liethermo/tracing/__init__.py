"""JAX functions as programs: traced by content, unrolled to scalar arithmetic, interpreted at a few points.

Knows nothing of dynamics.
"""
