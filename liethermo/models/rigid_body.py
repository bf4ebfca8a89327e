"""The relaxed rigid body [Morrison 1986; BFM Example 3.2, §4.3, Fig. 1], and the free one."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds.errors import warn

from ..dissipation.checks import checked_rate
from ..dissipation.inner_product import KillingDissipation
from ..functions.conditions import checked_numbers, require_condition
from ..functions.energy import Quadratic
from ..systems import LiePoissonSystem
from .inertia import checked_inertia_tensors, inverse_inertia

PUBLISHED_INERTIAS = ((10.0, 5.0, 1.0), (2.0, 1.0, 2.0 / 3.0))
"""Moments of published examples that no body can have, but that give no warning; the first is Morrison's."""

POSITIVE_MOMENTS_TEXT = "moments of inertia must be positive and finite, got {value}"
"""Error message for moments of inertia that are not positive and finite."""


class InertiaWarning(UserWarning):
    """Moments of inertia that no rigid body has."""


def rigid_body(inertia: Sequence[float] = (10.0, 5.0, 1.0), rate: float = 1.0) -> LiePoissonSystem:
    """Morrison's rigid body [1986]: a torque that does no work turns it to its axis of greatest inertia.

    ``Pi' = Pi × Omega + rate (|Omega|^2 Pi - (Omega . Pi) Omega)``, ``Omega_i = Pi_i / I_i``, with the energy
    ``H = sum Pi_i^2 / (2 I_i)`` and the entropy ``S = |Pi|^2 / 2``. The second term is the torque. It is normal to
    Omega, so H is constant, and S grows: from almost every state it tends to ``max(I) * H``.

    It is a model on so(3)*, of a body that is controlled from outside. A body left to itself, with friction between
    its parts, keeps |Pi| and loses kinetic energy to heat: see :func:`tumbling_body`.

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments of inertia, or the tensor in body axes (mass * length**2). The moments of a body obey
        ``I_i <= I_j + I_k``, since each is a sum of two of three moments of its masses. The default is the paper's
        (Fig. 1), which does not: as equations on so(3)* they are as good as any, but no rigid body has them.
    rate : float, >= 0
        lambda in ``mu' = mu x Omega + lambda Omega x (mu x Omega)`` (time). 1 is the equation as printed in the paper,
        where 𝒦 is the dot product. It is ``KillingDissipation(rate / 2)``, since the Killing form of so(3) is -2 times
        the dot product.

    Warns
    -----
    InertiaWarning
        If no body can have these moments of inertia, unless they are the paper's.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> body.dim, lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1).audit().passed
    (3, True)
    """
    return LiePoissonSystem(
        mf.so(3),
        energy=Quadratic(inverse_inertia(checked_inertia(inertia))),
        entropy=Quadratic(np.ones(3)),
        dissipation=KillingDissipation(0.5 * checked_rate(rate)),
    )


def free_rigid_body(inertia: Sequence[float] = (2.0, 1.0, 2.0 / 3.0)) -> LiePoissonSystem:
    """The free rigid body ``Pi' = Pi × Omega``: energy and ``|Pi|^2 / 2`` both conserved.

    The default inertias are those of a published check, which no body has: see :func:`rigid_body`.
    """
    energy = Quadratic(inverse_inertia(checked_inertia(inertia)))
    return LiePoissonSystem(mf.so(3), energy=energy, entropy=Quadratic(np.ones(3)))


def checked_inertia(inertia) -> np.ndarray | jax.Array:
    """Return moments of inertia, shape (3,), or a tensor, shape (3, 3), and warn if no body can have them.

    A diagonal tensor is returned as its moments.
    """
    checked_array = checked_numbers(inertia, "inertia", (3,), (3, 3))
    if is_traced(inertia):
        if checked_array.ndim == 2:
            require_condition(
                checked_array, _is_positive_definite, "a tensor of inertia must be positive definite, got {value}"
            )
        else:
            require_condition(checked_array, _are_positive, POSITIVE_MOMENTS_TEXT)
        return checked_array
    array = np.asarray(inertia, dtype=np.float64)
    if array.ndim == 2:
        array = checked_inertia_tensors(array)
        if not (array - np.diag(np.diag(array))).any():
            array = np.diag(array).copy()
    else:
        require_condition(array, _are_positive, POSITIVE_MOMENTS_TEXT)
    moments = array if array.ndim == 1 else np.linalg.eigvalsh(array)
    if tuple(moments.tolist()) not in PUBLISHED_INERTIAS:
        max_moment, rest_sum = float(moments.max()), float(moments.sum() - moments.max())
        if max_moment > rest_sum * (1 + 1e-12):
            warn(
                f"no rigid body has the moments of inertia {moments.tolist()}: the largest, {max_moment:g}, is more "
                f"than the sum of the others, {rest_sum:g}. The equations hold all the same",
                InertiaWarning,
            )
    return array


def _are_positive(moments):
    return (moments > 0.0) & (moments < np.inf)


def _is_positive_definite(tensor):
    return jnp.linalg.eigvalsh(tensor) > 0.0
