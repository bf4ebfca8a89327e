"""Trajectories with paces of their own, one or many, and what takes them on from pause to pause, for every engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.rounding import rounding
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.interpret import at_points
from ..tracing.programs import program
from . import searching
from .array import OnDemand
from .codes import Code
from .compiled.form import Form
from .compiled.paced import LanePaces
from .growth import FEW
from .pacing import (
    ARRIVED,
    CAUGHT,
    FINISHED,
    LOOKING,
    TOLD,
    Pace,
    Pacing,
    begin,
    begun,
    fastest,
    follow,
    follow_by,
    rate_of,
    reach,
)
from .rules import EPS, RULES
from .stepping import State


class _ArrayPaces:
    """What the array engine's have in common; fields are read and written with trajectories first."""

    number: int
    pace: Pace

    def read(self, name: str, chosen: Any = slice(None)) -> np.ndarray:
        """A field of :class:`.stepping.State` or of :class:`.pacing.Pace` of some of them, trajectories first."""
        return self._field(name)[chosen]

    def write(self, name: str, chosen: np.ndarray, values) -> None:
        whole = self._field(name).copy()
        whole[chosen] = values
        self._put(name, whole)

    def _field(self, name: str) -> np.ndarray:
        state = self.pace.state
        value = np.asarray(getattr(state if name in State._fields else self.pace, name))
        return value.reshape(self.number, *value.shape[self._in_front :])

    def _put(self, name: str, whole: np.ndarray) -> None:
        value = jnp.asarray(whole if self._in_front else whole[0])
        of_state = name in State._fields
        changes: dict[str, Any] = {"state": self.pace.state._replace(**{name: value})} if of_state else {name: value}
        self.pace = self.pace._replace(**changes)

    _in_front = 1


class SinglePaces(_ArrayPaces):
    """One trajectory, by programs of its own; ``step`` takes a step of an engine whose steps are no program."""

    _in_front = 0

    def __init__(self, system: System, method: OneStepMethod, pacing: Pacing, step: Callable | None = None):
        self.system, self.method, self.pacing, self._step, self.number = system, method, pacing, step, 1
        self._on_demand = OnDemand(method)

    def begin(self, x, t: float, stop: float, length: float) -> SinglePaces:
        times = (jnp.asarray(float(time)) for time in (t, stop, length))
        self.pace = begin(self.system, self.method, self.pacing, jnp.asarray(x), *times)
        return self

    def continued(self, others: OnePace) -> SinglePaces:
        """From where another engine has come to."""
        x, t, stop = (others.read(name)[0] for name in ("x", "t", "stop"))
        self.begin(x, t, stop, stop - t)
        for name in (*State._fields, *Pace._fields[1:]):
            whole = self._field(name)
            self._put(name, np.asarray(others.read(name)).reshape(whole.shape).astype(whole.dtype))
        return self

    def state(self) -> State:
        """As it stands."""
        return State(*(self.read(name)[0] for name in State._fields))

    def attempts(self, most: int) -> dict[str, np.ndarray]:
        """Make so many attempts, or fewer: attempts first, what :data:`.pacing.TOLD` names of each."""
        del most  # one, which nothing else follows
        if self._step is None:
            given, one = (self.system, self.method, self.pacing), jnp.asarray(1)
            self.pace = self._on_demand.follow(lambda p, newton: follow(*given, p, one, RULES, newton), self.pace)
        else:
            self.pace = follow_by(self._step, self.system, self.method, self.pacing, self.pace, 1)
        return {name: self.read(name) for name in TOLD}


class VmapPaces(_ArrayPaces):
    """All trajectories of a batch in one program."""

    def __init__(self, form: Form, parameters, axes, method: OneStepMethod, pacing: Pacing, x, t, stop, length):
        self.form, self.parameters, self.axes, self.method, self.pacing = form, parameters, axes, method, pacing
        self.number, self._on_demand = len(x), OnDemand(method)
        times = (jnp.asarray(float(time)) for time in (t, stop, length))
        self.pace = _begin_all(form, parameters, axes, method, pacing, jnp.asarray(x), *times)

    def follow(self, most: int) -> None:
        """So many attempts of each, or as many as it takes until it pauses."""
        given, count = (self.form, self.parameters, self.axes, self.method, self.pacing), jnp.asarray(most)
        self.pace = self._on_demand.follow(lambda p, newton: _follow_all(*given, p, count, newton), self.pace)


OnePace: TypeAlias = SinglePaces | LanePaces
"""One trajectory, whose attempts can be looked at."""

ManyPaces: TypeAlias = VmapPaces | LanePaces
"""Trajectories that are followed together; each is what it would be alone."""

Paces: TypeAlias = OnePace | ManyPaces
"""Trajectories with paces of their own."""


@program
def _begin_all(form, parameters, axes, method, pacing, x, t, stop, length):
    def one(p, x):
        return begun(form.rebuild(p), method, pacing, x, t, stop, length)

    return jax.vmap(one, in_axes=(axes, 0))(parameters, x)


@program
def _follow_all(form, parameters, axes, method, pacing, paces, most, newton: bool):
    def one(p, own):
        return follow(form.rebuild(p), method, pacing, own, most, RULES, newton)

    return jax.vmap(one, in_axes=(axes, 0))(parameters, paces)


ZERO = 2.0**10
"""Roundings that a function may be off zero at an event."""


def _rounding(model: tuple[System, Any], x) -> jax.Array:
    """The size at which what is watched is rounded at a state, which is rounded itself."""
    system, watched = model
    return rounding(lambda y: watched(system, y), x, jnp.maximum(jnp.abs(x), system.sizes(x)))


# -- from pause to pause ----------------------------------------------------------------------------------------------


class Guide:
    """Takes trajectories on from their pauses.

    Parameters
    ----------
    paces : Paces
    pacing : Pacing
    method : OneStepMethod
    stops : array
        Times at which steps have to end, increasing; the last is the end of the span.
    member : function from a place to the system of that trajectory

    Attributes
    ----------
    jumps : list of float
        When what is watched has changed its sign without being zero.
    """

    def __init__(self, paces: Paces, pacing: Pacing, method: OneStepMethod, stops: np.ndarray, member: Callable):
        self.paces, self.pacing, self.method, self.stops, self.member = paces, pacing, method, stops, member
        self.jumps: list[float] = []

    def paused(self, why: int) -> np.ndarray:
        """The places of those that pause for a reason."""
        return np.flatnonzero(self.paces.read("status") == why)

    def verify(self) -> None:
        """Those where what is watched changes its sign: an event is where it is zero, to rounding.

        Others go on past the jump, or the pole, as if it were a stop. Where it is not known what the function is
        between the two signs, since it is not a number, neither is whether the event happens: the run ends.
        What is watched for a fall alone may jump: it has fallen.
        """
        paces, there = self.paces, self.paused(CAUGHT)
        if not there.size:
            return
        value, before = paces.read("search", there)[:, searching.VALUE], paces.read("value", there)
        zero = np.isfinite(value) if self.pacing.falling else self._vanishes(there, value, before)
        paces.write("status", there[zero], Code.EVENT)
        unknown = ~zero & ~np.isfinite(before)
        paces.write("status", there[unknown], Code.NON_FINITE)
        past = ~zero & ~unknown
        there, t = there[past], paces.read("t", there[past])
        if there.size:
            self.jumps += t.tolist()
            paces.write("value", there, -before[past])
            paces.write("base", there, t)
            paces.write("since", there, paces.read("step", there))
            paces.write("status", there, np.where(t >= paces.read("stop", there), ARRIVED, Code.COMPLETED))

    def _vanishes(self, there: np.ndarray, value: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Whether what is watched is zero, to rounding, where its value is this and was that when the step began.

        It is beside a value that much larger. Otherwise its rounding is looked at, but not beside a pole, where it is
        larger than it was and rounded by all that it is.
        """
        size, before = np.abs(value), np.abs(before)
        zero = (size == 0.0) | ((size <= ZERO * EPS * before) & np.isfinite(before))
        for places in self._alike(there[~zero & np.isfinite(size) & (size <= ZERO * before)]):
            own, model = np.isin(there, places), (self.member(int(places[0])), self.pacing.watched)
            rounded = at_points(_rounding, model, self.paces.read("x", places))
            zero[own] = size[own] <= ZERO * EPS * np.where(np.isnan(rounded), np.inf, rounded)
        return zero

    def _alike(self, places: np.ndarray) -> list[np.ndarray]:
        """The places of trajectories of the same system, together."""
        found: dict[int, list[int]] = {}
        kept = [self.member(int(i)) for i in places]  # held, so that no identity is used twice
        for i, system in zip(places, kept, strict=True):
            found.setdefault(id(system), []).append(int(i))
        return [np.array(group) for group in found.values()]

    def resume(self) -> None:
        """Those at a stop are done or go on to the next, and what grows near a state is looked at."""
        paces, status = self.paces, self.paces.read("status")
        there = np.flatnonzero(status == ARRIVED)
        if there.size:
            t = paces.read("t", there)
            done = t >= self.stops[-1]
            paces.write("status", there[done], FINISHED)
            there, t = there[~done], t[~done]
        if there.size:
            paces.write("base", there, t)
            paces.write("since", there, paces.read("step", there))
            paces.write("stop", there, self.stops[np.searchsorted(self.stops, t, side="right")])
        waiting = np.concatenate([there, np.flatnonzero(status == LOOKING)])
        if not waiting.size:
            return
        unknown = waiting[np.isnan(paces.read("growth", waiting))]
        if unknown.size:
            self._look(unknown)
        spent = paces.read("tried", waiting) >= float(self.pacing.most)
        paces.write("status", waiting, np.where(spent, Code.STEP_LIMIT, Code.COMPLETED))

    def _look(self, chosen: np.ndarray) -> None:
        seen, paces = self.paces.read("seen", chosen), self.paces
        if seen.shape[2] <= FEW:
            rates = fastest(seen)
        else:
            x = paces.read("x", chosen)
            rates = np.array([rate_of(self.member(int(i)), self.method, x[j]) for j, i in enumerate(chosen)])
        longest = np.divide(reach(self.method), rates, out=np.full(len(rates), np.inf), where=rates > 0.0)
        paces.write("growth", chosen, rates)
        paces.write("proposed", chosen, np.minimum(paces.read("proposed", chosen), longest))
