"""Variational schemes for simple closed systems, on R^n and on Lie groups."""
