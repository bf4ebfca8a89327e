"""A scaling of the basis that makes the structure constants of similar size, so that they show what is rounding."""

from __future__ import annotations

import numpy as np

STRUCTURE_TOLERANCE = 1e-10
"""What is smaller than this, relative to balanced constants, is rounding.

In random bases of condition number 1e2, scaled by 1e-6 … 1e6, zeros come out below 1e-13 and what is not zero above
1e-5 (Killing forms) and 1e-4 (brackets).
"""

_MIN_RELATIVE_CONSTANT = 1e-12
"""Constants below this, relative to the largest, take no part in the balance: rounding is not to be made large."""

_MAX_ROUNDS = 20


def balance_constants(constants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The constants in the basis ``factors[a] e_a``, the largest of size 1, and the factors.

    The logarithms of the constants that are not zero, ``log |C[a, b, c]| + x_a + x_b - x_c``, have the least sum of
    squares. Multiples of the basis elements therefore lead to the same balanced constants.
    """
    size = np.abs(constants)
    if not size.any():
        return constants, np.ones(len(constants))
    kept, scaled = np.zeros(constants.shape, dtype=bool), constants
    for _ in range(_MAX_ROUNDS):
        seen = kept | (np.abs(scaled) > _MIN_RELATIVE_CONSTANT * np.abs(scaled).max())
        if (seen == kept).all():
            break
        kept = seen  # what comes to light when the scales of the others are known takes part from then on
        logarithms = np.log(size, where=kept, out=np.zeros(size.shape))
        x, *_ = np.linalg.lstsq(_normal_matrix(kept), -_signed_sums(logarithms), rcond=1e-10)
        exponents = x[:, None, None] + x[:, None] - x
        largest = (logarithms + exponents)[kept].max()
        x, exponents = x - largest, exponents - largest
        scaled = constants * np.exp(exponents)
    return scaled, np.exp(x)


def _signed_sums(values: np.ndarray) -> np.ndarray:
    """``sum_abc values[a, b, c] (e_a + e_b - e_c)``."""
    return values.sum(axis=(1, 2)) + values.sum(axis=(0, 2)) - values.sum(axis=(0, 1))


def _normal_matrix(kept: np.ndarray) -> np.ndarray:
    """``sum_abc n n^T`` with ``n = e_a + e_b - e_c``, over the entries that are kept."""
    pairs = kept.sum(axis=2) - kept.sum(axis=1) - kept.sum(axis=0)  # of a and b, of a and c, of b and c
    return pairs + pairs.T + np.diag(kept.sum(axis=(1, 2)) + kept.sum(axis=(0, 2)) + kept.sum(axis=(0, 1)))
