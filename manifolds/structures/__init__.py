"""Poisson structures and contact structures."""
