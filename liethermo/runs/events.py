"""Where a run ends before its time: events, and the relaxation of the state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from manifolds._module import Module

from ..errors import FunctionError, InputError
from ..systems import System
from ..tracing.traced import settled


@dataclass(frozen=True)
class Relaxed:
    """The event that the entropy production falls below ``tol`` (per unit of time), for ``integrate(until=...)``.

    Some systems produce no entropy, but their energy falls, as under a :class:`liethermo.DoubleBracket`. For these the
    rate at which the dissipation lowers the energy is used instead.

    The rate may be below ``tol`` at the start, as near an unstable equilibrium. It then has to rise above it first.

    Parameters
    ----------
    tol : float, > 0
        The rate (entropy / time, or energy / time if the energy falls) below which the run stops.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 1e4), lt.Adaptive(1e-8), until=lt.Relaxed(1e-6))
    >>> run.status.code
    'event'
    """

    tol: float

    def __post_init__(self):
        if not (math.isfinite(self.tol) and self.tol > 0.0):
            raise InputError(f"the rate to stop at must be positive and finite, not {self.tol!r}")


class Event:
    """A function of the state whose sign is watched.

    Parameters
    ----------
    until : Relaxed or function from a state, shape (n,), to a scalar
    system : System

    Attributes
    ----------
    function : pytree
        Of a system and a state, for engines.
    falling : bool
        Whether it is watched for a fall alone.
    """

    def __init__(self, until: Relaxed | Callable, system: System):
        self.falling = isinstance(until, Relaxed)
        self.name = "the event function"
        if isinstance(until, Relaxed):
            rate = _watched_rate(system)
            if rate is None:
                raise InputError(
                    "Relaxed(tol) watches the entropy production or the fall of the energy, and this system produces "
                    "no entropy and keeps its energy, or promises nothing: give a function of the state as until"
                )
            self.name = f"{rate.name} below {until.tol:g}"
            self.function: Any = rate(jnp.asarray(until.tol))
        elif callable(until):
            seen = jax.eval_shape(system.seen, jax.ShapeDtypeStruct((system.dim,), jnp.float64))
            self.function = OfPoints(settled(until, lambda f, x: f(x), seen.shape))
        else:
            raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, not {until!r}")
        x = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
        found = jax.eval_shape(lambda x: self.function(system, x), x)
        if getattr(found, "shape", None) != ():
            raise FunctionError("the event function must return one number")


class Excess(Module):
    """The entropy production above one."""

    tol: jax.Array
    name: ClassVar[str] = "entropy production"

    def __call__(self, system: System, x):
        return system.entropy_production(x) - self.tol


class ExcessFall(Module):
    """The rate at which the dissipation lowers the energy, above one."""

    tol: jax.Array
    name: ClassVar[str] = "fall of the energy"

    def __call__(self, system: System, x):
        return system.energy_fall(x) - self.tol


class OfPoints(Module):
    """A function of what the user sees of a state."""

    function: Callable

    def __call__(self, system: System, x):
        return self.function(system.seen(x))


def _watched_rate(system: System) -> type[Excess] | type[ExcessFall] | None:
    """What vanishes as a system relaxes, by its laws."""
    if system.entropy_law == "nondecreasing":
        return Excess
    return ExcessFall if system.energy_law == "nonincreasing" else None
