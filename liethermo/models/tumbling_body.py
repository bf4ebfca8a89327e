"""An isolated rigid body with internal friction: it tumbles, warms, and ends in a steady spin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import manifolds as mf

from ..dissipation.double_bracket import DoubleBracket
from ..errors import InputError
from ..functions.energy import Quadratic
from ..systems import HeatBaths, LiePoissonSystem
from .free_motion import rate_of
from .inertia import checked_inertia, inverse_inertia


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
