"""Lie algebras: definitions and checks, sums, Casimirs, and the catalogue of named algebras."""
