"""Trace JAX functions by content, unroll them into scalar programs, and interpret these programs at a few points.

This package knows nothing of dynamics.
"""
