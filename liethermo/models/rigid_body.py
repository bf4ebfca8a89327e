"""The relaxed rigid body [Morrison 1986; BFM Example 3.2, §4.3, Fig. 1], and the free one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import manifolds as mf
from manifolds._arrays import host_array

from ..dissipation.checks import checked_rate
from ..dissipation.inner_product import KillingDissipation
from ..functions.energy import Quadratic
from ..systems import LiePoissonSystem
from .inertia import InertiaWarning, checked_inertia, inverse_inertia

__all__ = ["InertiaWarning", "free_rigid_body", "rigid_body"]


def rigid_body(
    inertia: Sequence[float] = (10.0, 5.0, 1.0), rate: float = 1.0, attitude: bool = False, torque=None
) -> LiePoissonSystem:
    """Morrison's rigid body [1986]: a torque that does no work turns it to its axis of greatest inertia.

    ``Pi' = Pi × Omega + rate (|Omega|^2 Pi - (Omega . Pi) Omega)``, ``Omega_i = Pi_i / I_i``, with the energy
    ``H = sum Pi_i^2 / (2 I_i)`` and the entropy ``S = |Pi|^2 / 2``. The second term is the torque. It is normal to
    Omega, so H is constant, and S grows: from almost every state it tends to ``max(I) * H``.

    It is a model on so(3)*, of a body that is controlled from outside. A body left to itself, with friction between
    its parts, keeps |Pi| and loses kinetic energy to heat: see :func:`tumbling_body`.

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments of inertia, or the tensor in body axes (mass * length**2), or (0, J, J) for a slender rod,
        whose momentum has no component along its axis. The moments of a body obey
        ``I_i <= I_j + I_k``, since each is a sum of two of three moments of its masses. The default is the paper's
        (Fig. 1), which does not: as equations on so(3)* they are as good as any, but no rigid body has them.
    rate : float, >= 0
        lambda in ``mu' = mu x Omega + lambda Omega x (mu x Omega)`` (time). 1 is the equation as printed in the paper,
        where 𝒦 is the dot product. It is ``KillingDissipation(rate / 2)``, since the Killing form of so(3) is -2 times
        the dot product.
    attitude : bool
        If true, runs follow the attitude, an element of SO(3).
    torque : torque, or a list of them; optional
        Further external torques (mass * length**2 / time**2): see :mod:`liethermo.torques`.

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
        energy=Quadratic(inverse_inertia(checked_inertia(inertia, allow_rod=True))),
        entropy=Quadratic(np.ones(3)),
        dissipation=KillingDissipation(0.5 * host_array(checked_rate(rate))),
        group=mf.SO(3) if attitude else None,
        torque=torque,
    )


def free_rigid_body(
    inertia: Sequence[float] = (2.0, 1.0, 2.0 / 3.0), attitude: bool = False, torque=None
) -> LiePoissonSystem:
    """The free rigid body ``Pi' = Pi × Omega``: energy and ``|Pi|^2 / 2`` both conserved.

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        As for :func:`rigid_body`. The default moments are those of a published check, which no body has.
    attitude : bool
        If true, runs follow the attitude, an element of SO(3).
    torque : torque, or a list of them; optional
        External torques (N m): see :mod:`liethermo.torques`. The body is then not free, and has no entropy.

    Examples
    --------
    >>> body = lt.models.free_rigid_body((3.0, 2.0, 1.0))
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1)
    >>> bool(abs(run.energy - run.energy[0]).max() < 1e-14)
    True
    """
    energy = Quadratic(inverse_inertia(checked_inertia(inertia, allow_rod=True)))
    entropy = Quadratic(np.ones(3)) if torque is None else None
    return LiePoissonSystem(
        mf.so(3), energy=energy, entropy=entropy, group=mf.SO(3) if attitude else None, torque=torque
    )
