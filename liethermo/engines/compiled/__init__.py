"""Compiled engine: machine code for small systems on the CPU."""
