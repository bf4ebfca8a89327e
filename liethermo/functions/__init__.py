"""Energies and entropies as sums of terms, with their gradients, discrete gradients and rounding errors."""
