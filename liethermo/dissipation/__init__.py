"""Dissipation, the part of the motion that produces entropy: one construction a file."""
