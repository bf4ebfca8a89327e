"""Where a run ends before its time: events, and the relaxation of the state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._module import Module

from ..errors import FunctionError, InputError
from ..functions.gradients import EPS
from ..systems import System
from ..tracing.interpret import evaluator
from ..tracing.traced import settled


@dataclass(frozen=True)
class Relaxed:
    """The event that the entropy production falls below ``tol`` (per unit of time), for ``integrate(until=...)``.

    A state whose production is below it from the start, such as one near an unstable equilibrium, has to rise above it
    first.
    """

    tol: float

    def __post_init__(self):
        if not (math.isfinite(self.tol) and self.tol > 0.0):
            raise InputError(f"the entropy production to stop at must be positive and finite, not {self.tol!r}")


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
        self.name = f"entropy production below {until.tol:g}" if isinstance(until, Relaxed) else "the event function"
        if isinstance(until, Relaxed):
            if system.entropy_law != "nondecreasing":
                raise InputError("Relaxed(tol) watches the entropy production, and this system produces no entropy")
            self.function: Any = Excess(jnp.asarray(until.tol))
        elif callable(until):
            seen = jax.eval_shape(system.seen, jax.ShapeDtypeStruct((system.dim,), jnp.float64))
            self.function = OfPoints(settled(until, lambda f, x: f(x), seen.shape))
        else:
            raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, not {until!r}")
        self._value = evaluator(_value, (system, self.function), system.dim)
        if np.shape(self(system.samples(1)[0])) != ():
            raise FunctionError("the event function must return one number")

    def __call__(self, x: np.ndarray) -> float:
        return self._value(x[None])[0]

    def happens(self, before: float, after: float) -> bool:
        """Whether it happens between two values."""
        return before > 0.0 >= after or (not self.falling and before < 0.0 <= after)


class Excess(Module):
    """The entropy production above one."""

    tol: jax.Array

    def __call__(self, system: System, x):
        return system.entropy_production(x) - self.tol


class OfPoints(Module):
    """A function of what the user sees of a state."""

    function: Callable

    def __call__(self, system: System, x):
        return self.function(system.seen(x))


def _value(model, x):
    system, function = model
    return function(system, x)


def located(value: Callable[[np.ndarray, np.ndarray], np.ndarray], before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The shares of steps in which events happen, shape (m,), to rounding [Chandrupatla 1997].

    Looked for among steps from the same states, so that an event is as accurate as the method and the laws hold there.
    Each of them is found by itself, whatever the others are.

    Parameters
    ----------
    value : function of (shares, places) to values
        Of what is watched, after these shares of the steps with these places.
    before, after : array, shape (m,)
        The values at both ends of the steps, of different signs.
    """
    a, b = np.zeros(len(before)), np.ones(len(before))
    fa, fb = before.copy(), after.copy()
    c, fc = a.copy(), fa.copy()
    share = np.full(len(before), 0.5)
    found = np.where(fb == 0.0, 1.0, np.nan)
    while (left := np.flatnonzero(np.isnan(found))).size:
        t = a[left] + share[left] * (b[left] - a[left])
        ft = value(t, left)
        same = np.sign(ft) == np.sign(fa[left])
        c[left], fc[left] = np.where(same, a[left], b[left]), np.where(same, fa[left], fb[left])
        other, fo = np.where(same, b[left], a[left]), np.where(same, fb[left], fa[left])
        a[left], fa[left], b[left], fb[left] = t, ft, other, fo
        best = np.where(np.abs(ft) < np.abs(fo), t, other)
        width, least = np.abs(other - t), 4.0 * EPS * np.abs(best) + 1e-300
        done = (width <= least) | (ft == 0.0) | ~np.isfinite(ft)
        found[left] = np.where(done, np.where(ft == 0.0, t, best), np.nan)
        share[left] = _share(t, other, c[left], ft, fo, fc[left], 0.5 * least / np.fmax(width, least))
    return found


def _share(a, b, c, fa, fb, fc, least) -> np.ndarray:
    """Where between a and b to look next: by inverse quadratic interpolation where that is safe, or halfway."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
        safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
        t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    return np.clip(np.where(safe & np.isfinite(t), t, 0.5), least, 1.0 - least)
