"""Discrete gradients of an entropy that is a function of known Casimirs."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from ..functions.energy import Energy
from ..functions.frames import OrthonormalFrame, gram_schmidt
from ..functions.gradients import CorrectionDirection, FunctionChange, correct_gradients

CASIMIR_NEWTON_STEPS = 3
"""Newton steps to a level of the Casimirs: the distance is O(h), so O(h^8) is left after three."""


def composed_entropy_gradients(
    S: Energy, casimirs: Sequence[Energy], gradients, x, compensation, h, k, A, b
) -> jax.Array:
    """Return discrete gradients of ``S = f(C_1, …, C_m)`` at the stages of a collocation method, shape (s, n).

    Each is ``sum_j (f_j(c_i) + alpha r_ij) gC_ij``, a combination of the discrete gradients of the Casimirs at the
    stage. Their rates are ``r_ij = gC_ij . k_i``, and their values ``c_i = C(x) + h sum_l A_il r_l`` are collocated as
    separate unknowns. The number alpha makes ``h sum_i b_i gS_i . k_i = S(x') - S(x)``. So a motion that keeps
    the Casimirs keeps S. At a critical point of f, f' is zero, and so is gS. With the stage u_i
    itself, which is off the level of the Casimirs by O(h^{s+1}), friction would act there.

    f need not be known: its derivatives at c are the components of grad S in the grad C_j, at a point near x with C =
    c.

    Parameters
    ----------
    gradients : array, shape (m, s, n)
        The discrete gradients of the Casimirs.
    """
    rates = jnp.einsum("jin,in->ij", gradients, k)

    def casimir_frame(y) -> OrthonormalFrame:
        return gram_schmidt([C.gradient(y) for C in casimirs])

    def entropy_coefficients(casimir_changes):
        y = x
        for _ in range(CASIMIR_NEWTON_STEPS):
            residual = casimir_changes - jnp.stack([C.value(y) - C.value(x) for C in casimirs])
            y = y + casimir_frame(y).vector_with_inner_products(residual)
        return casimir_frame(y).coefficients(S.gradient(y))

    coefficients = jax.vmap(entropy_coefficients)(h * (A @ rates))
    entropy_change = FunctionChange.of(S, x, compensation, h * (b @ k), [])
    return jnp.einsum(
        "ij,jin->in",
        correct_gradients(entropy_change, coefficients, rates, CorrectionDirection.of(rates, b), h, b),
        gradients,
    )
