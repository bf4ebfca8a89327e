"""Lie algebras: definition and checks, sums, Casimirs, the catalogue."""
