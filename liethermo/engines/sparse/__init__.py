"""Sparse engine: Newton's method with sparse matrices for large networks."""
