"""Machine code for small systems on the CPU."""
