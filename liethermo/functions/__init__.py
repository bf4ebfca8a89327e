"""Energies and entropies as sums of terms: their gradients, discrete gradients, and how rounding sees them."""
