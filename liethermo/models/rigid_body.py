"""Rigid bodies: free, relaxed [Morrison 1986; BFM Example 3.2, §4.3, Fig. 1], and tumbling with internal friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import manifolds as mf
from manifolds._arrays import host_array

from ..dissipation.brackets import DoubleBracket, KillingDissipation
from ..dissipation.checks import checked_rate
from ..errors import InputError
from ..functions.energy import Quadratic
from ..systems import HeatBaths, LiePoissonSystem
from .free_motion import rate_of
from .inertia import InertiaWarning, checked_inertia, inverse_inertia

__all__ = ["InertiaWarning", "free_rigid_body", "rigid_body"]


def rigid_body(
    inertia: Sequence[float] = (10.0, 5.0, 1.0), rate: float = 1.0, attitude: bool = False, torque=None
) -> LiePoissonSystem:
    """Morrison's rigid body [1986]: a torque that does no work turns it to its axis of greatest inertia.

    ``Pi' = Pi × Omega + rate (|Omega|^2 Pi - (Omega . Pi) Omega)``, ``Omega_i = Pi_i / I_i``, with the energy
    ``H = sum Pi_i^2 / (2 I_i)`` and the entropy ``S = |Pi|^2 / 2``. The second term is the torque. It is normal to
    Omega, so H is constant, and S grows: from almost every state it tends to ``max(I) * H``.

    It is a model on so(3)*, of a body that is controlled from outside. A torque-free body, with friction between
    its parts, conserves |Pi| and loses kinetic energy to heat: see :func:`tumbling_body`.

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments of inertia, or the tensor in body axes (mass * length**2), or (0, J, J) for a slender rod,
        whose momentum has no component along its axis. The moments of a body obey ``I_i <= I_j + I_k``, since each is a
        sum of two of three moments of its masses. The default moments of the paper (Fig. 1) violate this
        condition: the equations on so(3)* are valid, but no rigid body has such moments.
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


def tumbling_body(
    inertia: Sequence[float],
    relaxation_time: float | None = None,
    momentum: float | Sequence[float] | None = None,
    rate: float | None = None,
    capacity: float = 1.0,
    temperature: float = 1.0,
    attitude: bool = True,
    torque=None,
) -> LiePoissonSystem:
    """An isolated body heated by internal friction: an asteroid, or a satellite without thrusters.

    ``mu' = mu × (xi + sigma)``, ``xi_i = mu_i / I_i``, ``sigma = rate mu × xi``, and ``T y' = rate |mu × xi|**2`` for
    the entropy y, of a body of heat capacity C and temperature ``T = T_0 exp(y / C)``. The energy
    ``sum mu_i**2 / (2 I_i) + C (T - T_0)`` and ``|mu|`` are constant, the entropy grows, and the kinetic energy falls
    to ``|mu|**2 / (2 max(I))``, of a spin about the axis of greatest inertia. The attitude follows
    ``g' = g hat(xi + sigma)``, so the angular momentum in space, ``g mu``, is constant. See :mod:`liethermo.bodies`.

    Everything is in SI units, or in any other consistent ones. The state is (mu, y), and mu alone stands for y = 0.

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments of inertia, of which none is more than the sum of the others, or the tensor in body axes
        (kg m**2); (0, J, J) for a slender rod, whose momentum has no component along its axis.
    relaxation_time : float, > 0
        Time (s) in which small nutations decay by a factor e, at the angular momentum ``momentum``. If the three
        moments differ, the nutation oscillates, and this is the decay of its amplitude. If the two greatest are equal,
        as for a rod, the tangent of the angle from the flat spin decays so. For nearly equal moments see
        :func:`liethermo.bodies.rate_of`.
    momentum : float, > 0, or three numbers
        The norm of the angular momentum, or the vector in body axes (kg m**2 / s), at which the relaxation time holds,
        since it is proportional to ``1 / |mu|**2``. The initial momentum of a run may differ.
    rate : float, >= 0
        Rate of the friction (s / (kg m**2)), instead of the relaxation time and the momentum.
    capacity : float, > 0
        C (J / K).
    temperature : float, > 0
        T_0 (K), at y = 0.
    attitude : bool
        If true, runs follow the attitude, an element of SO(3) that maps body axes to axes in space.
    torque : torque, or a list of them; optional
        External torques (kg m**2 / s**2): see :mod:`liethermo.torques`. The body is then not isolated.

    Raises
    ------
    InputError
        If there is neither a relaxation time with its momentum nor a rate, or both.

    Warns
    -----
    InertiaWarning
        If no body can have these moments of inertia.

    Examples
    --------
    >>> body = lt.models.tumbling_body(inertia=(3.0, 2.0, 1.0), rate=0.08)
    >>> run = lt.integrate(body, [0.06, 0.1, 1.0], (0.0, 100.0), 0.1)
    >>> run.audit().passed, run.attitude.shape
    (True, (1001, 3, 3))
    """
    moments = checked_inertia(inertia, allow_rod=True)
    if (rate is None) == (relaxation_time is None) or (momentum is None) != (relaxation_time is None):
        arguments = {"relaxation_time": relaxation_time, "momentum": momentum, "rate": rate}
        names = ", ".join(name for name, value in arguments.items() if value is not None) or "none of them"
        raise InputError(f"give rate=, or relaxation_time= and momentum=, at which it holds; got {names}")
    friction = rate if relaxation_time is None else rate_of(relaxation_time, moments, _momentum_norm(momentum))
    return LiePoissonSystem(
        mf.so(3),
        energy=Quadratic(inverse_inertia(moments)),
        dissipation=DoubleBracket(friction),
        group=mf.SO(3) if attitude else None,
        baths=HeatBaths(capacity, temperature),
        torque=torque,
    )


def _momentum_norm(momentum):
    """Return the norm of an angular momentum, given as the norm itself or as a vector of shape (3,)."""
    if np.shape(momentum) not in ((), (3,)):
        raise InputError(f"momentum must be one number, or three, got an array of shape {np.shape(momentum)}")
    return momentum if np.shape(momentum) == () else np.linalg.norm(momentum)
