"""The oscillator algebra: q, p and their bracket, which is central, and the turning of one into the other."""

import numpy as np

import manifolds as mf

C = np.zeros((4, 4, 4))
C[0, 1, 2], C[0, 2, 1], C[1, 2, 3] = 1, -1, 1
OSCILLATOR = mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="oscillator")
