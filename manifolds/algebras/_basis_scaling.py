"""Scale the basis so that all structure constants are of similar size, which separates them from rounding errors."""

from __future__ import annotations

import numpy as np

STRUCTURE_TOLERANCE = 1e-10
"""Values below this count as rounding errors, relative to balanced constants.

In random bases of condition number 1e2, scaled by 1e-6 … 1e6, zeros come out below 1e-13, and nonzero values above
1e-5 (Killing forms) and 1e-4 (brackets).
"""

_MIN_RELATIVE_CONSTANT = 1e-12
"""Constants below this, relative to the largest, are left out of the balance, so that rounding errors do not grow."""

_MAX_ROUNDS = 20
"""Largest number of rounds in which the set of constants taken as nonzero is updated."""


def balance_constants(constants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the constants in the basis ``factors[a] e_a``, the largest of size 1, and the factors.

    The factors minimise the sum of squares of the logarithms of the nonzero constants,
    ``log |C[a, b, c]| + x_a + x_b - x_c``. Multiples of the basis elements therefore lead to equal balanced constants.
    """
    magnitudes = np.abs(constants)
    if not magnitudes.any():
        return constants, np.ones(len(constants))
    mask, scaled_constants = np.zeros(constants.shape, dtype=bool), constants
    for _ in range(_MAX_ROUNDS):
        new_mask = mask | (np.abs(scaled_constants) > _MIN_RELATIVE_CONSTANT * np.abs(scaled_constants).max())
        if (new_mask == mask).all():
            break
        mask = new_mask  # constants that stand out from rounding only after scaling take part from then on
        logarithms = np.log(magnitudes, where=mask, out=np.zeros(magnitudes.shape))
        x, *_ = np.linalg.lstsq(_normal_matrix(mask), -_normal_right_hand_side(logarithms), rcond=1e-10)
        exponents = x[:, None, None] + x[:, None] - x
        max_exponent = (logarithms + exponents)[mask].max()
        x, exponents = x - max_exponent, exponents - max_exponent
        scaled_constants = constants * np.exp(exponents)
    return scaled_constants, np.exp(x)


def _normal_right_hand_side(values: np.ndarray) -> np.ndarray:
    """Return the right-hand side of the normal equations of the scaling, shape (dim,), from ``values``."""
    return values.sum(axis=(1, 2)) + values.sum(axis=(0, 2)) - values.sum(axis=(0, 1))


def _normal_matrix(mask: np.ndarray) -> np.ndarray:
    """Return the matrix of the normal equations of the scaling, shape (dim, dim), for entries in ``mask``."""
    pair_counts = mask.sum(axis=2) - mask.sum(axis=1) - mask.sum(axis=0)  # of a and b, of a and c, of b and c
    return pair_counts + pair_counts.T + np.diag(mask.sum(axis=(1, 2)) + mask.sum(axis=(0, 2)) + mask.sum(axis=(0, 1)))
