"""What an audit asks of a run besides its series: how its functions are rounded, and steps taken again from its states.

All of it is found when it is first asked for, at a bounded number of states.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..functions.energy import Energy
from ..functions.rounding import with_rounding
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.interpret import at_points
from ..tracing.scalarize import UnsupportedPrimitive

MEASURED = 256
"""States of a run at which the sensitivities of its functions are evaluated."""

STEPS_AGAIN, STATE_NUMBERS = 32, 2_000
"""Steps that are taken again for their local errors; fewer of large systems, so that their states have no more numbers
than the second together, but four at least."""

PLACES, RUNGS = 3, 7
"""States at which short steps are compared with the vector field, and how many, each an eighth of the one before."""

SHORT = 1e-3
"""The first of them, as a fraction of the time in which the state changes by its size."""

WHOLE = 0.01
"""Fraction of the whole motion below which the distance of a step does not count: a body that has come to rest may take
long steps."""

STILL = 1e-12
"""A step that moves the state by less, relative to its size, tells nothing: what it does is rounding."""


@dataclass(frozen=True)
class Evidence:
    """What is known of a run besides its series.

    Attributes
    ----------
    energy, entropy : float or None
        Largest sensitivity along the run: the size at which the function is rounded (:meth:`Energy.sensitivity`).
    invariants : dict of float
        The same of the other recorded functions, by name.
    terms : dict of float
        Largest size at which the value of ``"energy"``, of ``"entropy"`` and of the others is rounded along the run:
        that of the largest terms inside, which may cancel in the value.
    local_error : float or None
        Largest estimated local error of a step, relative to the distance that it goes, or to a hundredth of the whole
        motion where that is more; None where the method has no estimate or nothing moves.
    error_time : float or None
        Where it is that large.
    inconsistency : float or None
        Largest distance between the slope of a step and the vector field, relative to the field, that is left as the
        step gets shorter.
    """

    energy: float | None = None
    entropy: float | None = None
    invariants: Mapping[str, float] = field(default_factory=dict)
    terms: Mapping[str, float] = field(default_factory=dict)
    local_error: float | None = None
    error_time: float | None = None
    inconsistency: float | None = None


@dataclass(frozen=True, eq=False)
class Witness:
    """Finds the evidence of a run when it is called.

    Attributes
    ----------
    system : System
    method : OneStepMethod or Reference
    functions : dict of Energy
        The recorded ones beside energy and entropy.
    x : ndarray, shape (m, n)
        Some states, in their order.
    t, h : ndarray, shape (m,) and at most (m,)
        Their times, and the steps that the run took from them.
    again : function of (x, h) to the state of the engine after one step
    """

    system: System
    method: Any
    functions: Mapping[str, Energy]
    x: np.ndarray
    t: np.ndarray
    h: np.ndarray
    again: Callable

    def __call__(self) -> Evidence:
        return self._found

    @functools.cached_property
    def _found(self) -> Evidence:
        functions = [*laws_functions(self.system), *self.functions.values()]
        names = [*("energy", "entropy")[: len(functions) - len(self.functions)], *self.functions]
        sensitivities, terms = at_points(sizes, tuple(functions), self.x)
        own = dict(zip(names, _largest(sensitivities), strict=True))
        energy, entropy = own.pop("energy"), own.pop("entropy", None)
        found = Evidence(energy, entropy, own, dict(zip(names, _largest(terms), strict=True)))
        if not isinstance(self.method, OneStepMethod) or self.method.increments:  # noise is what a short step shows
            return found
        number = min(STEPS_AGAIN, max(4, STATE_NUMBERS // self.x.shape[1]))
        tried = (self._step(i, self.h[i]) for i in spread(len(self.h), number))
        steps = [step for step in tried if step is not None and step.length > STILL * np.abs(step.x).max()]
        if not steps:  # nothing moves
            return found
        found = dataclasses.replace(found, inconsistency=self._inconsistency(steps))
        steps = [step for step in steps if step.moved > STILL * np.abs(step.x).max()]
        if not steps or not has_estimate(self.method):
            return found
        places = np.asarray(self.system.points(self.x)).reshape(len(self.x), -1)
        whole = WHOLE * float(np.ptp(places, axis=0).max())
        at = np.array([np.concatenate([step.x, [step.h], step.k.ravel()]) for step in steps])
        errors = at_points(_local_errors, (self.system, self.method), at) / [max(step.moved, whole) for step in steps]
        worst = int(np.argmax(np.nan_to_num(errors)))
        return dataclasses.replace(
            found, local_error=float(errors[worst]), error_time=float(self.t[steps[worst].place])
        )

    def _inconsistency(self, steps: list[_Step]) -> float | None:
        """The largest over a few states of what short steps miss of the field: the least over the steps from one."""
        fastest = max(step.length / step.h for step in steps)
        moving = [step for step in steps if step.length > 1e-6 * fastest * step.h]
        short: list[list[_Step]] = []
        for i in spread(len(moving), PLACES):
            size, speed = np.abs(moving[i].x).max(), moving[i].length / moving[i].h
            first = min(moving[i].h, SHORT * size / speed) if size > 0.0 else moving[i].h
            tried = (self._step(moving[i].place, first / 8.0**n) for n in range(RUNGS))
            short.append([step for step in tried if step is not None])
        starts = [step.x for steps in short for step in steps]
        ends = [step.x + step.d for steps in short for step in steps]
        if not starts:
            return None
        found = iter(at_points(_field, self.system, np.array(starts + ends)).reshape(2, len(starts), -1).swapaxes(0, 1))
        missed = [[_missed(step, *next(found)) for step in steps] for steps in short]
        return max((np.nanmin(values) for values in missed if np.isfinite(values).any()), default=None)

    def _step(self, place: int, h: float) -> _Step | None:
        """One step from a state of the run; None where it cannot be taken."""
        x, points = self.x[place], self.system.points
        try:
            state = self.again(x, float(h))
        except UnsupportedPrimitive:  # Newton's method, where the run went without it
            return None
        if int(state.status) != 0:
            return None
        d = (np.asarray(state.x) - x) + np.asarray(state.low)
        moved = float(np.abs(np.asarray(points(x + d)) - np.asarray(points(x))).max())
        return _Step(place, float(h), x, d, np.asarray(state.k), moved)


class _Step(NamedTuple):
    """A step from a state x of the run, which displaces it by d, and what its user sees of it by ``moved``."""

    place: int
    h: float
    x: np.ndarray
    d: np.ndarray
    k: np.ndarray
    moved: float

    @property
    def length(self) -> float:
        return float(np.abs(self.d).max())


def _missed(step: _Step, before: np.ndarray, after: np.ndarray) -> float:
    """How far the slope of a step is from the mean of the field at its ends, relative to that."""
    mean = 0.5 * (before + after)
    size = float(np.abs(mean).max())
    missed = float(np.abs(step.d / step.h - mean).max())
    return missed / size if size > 0.0 else missed


def spread(count: int, most: int) -> np.ndarray:
    """At most so many places among ``count``, the first and the last among them."""
    return np.arange(count) if count <= most else np.arange(most) * (count - 1) // (most - 1)


def _largest(values: np.ndarray) -> list[float]:
    return [float(v) for v in np.nan_to_num(values, nan=0.0, posinf=0.0).max(axis=0)]


def laws_functions(system: System) -> list[Energy]:
    """The energy, and the entropy where there is one."""
    return [system.energy, *([] if system.entropy is None else [system.entropy])]


def sizes(functions: Sequence[Energy], x) -> tuple[jnp.ndarray, jnp.ndarray]:
    """The sensitivities of functions at a state, and the sizes at which their values are rounded."""
    sensitivities = jnp.stack([f.sensitivity(x) for f in functions])
    return sensitivities, jnp.stack([with_rounding(f.value, x)[1] for f in functions])


def _field(system: System, x):
    return system.vector_field(x)


def _local_errors(model: tuple[System, OneStepMethod], step):
    return error_at(*model, step)


def error_at(system: System, method: OneStepMethod, step) -> jnp.ndarray:
    """The method's estimate of the local error of a step: state, size and slopes one after another."""
    n = system.dim
    x, h, k = step[:n], step[n], step[n + 1 :].reshape(-1, n)
    return method.error(system, x, jnp.zeros_like(x), h, k)


def has_estimate(method) -> bool:
    """Whether a method knows the error of its steps."""
    return isinstance(method, OneStepMethod) and method.has_estimate
