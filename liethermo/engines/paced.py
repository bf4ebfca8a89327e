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


class ArrayPaces:
    """Trajectories with paces of their own in the array engine; they are read and written with trajectories first.

    Parameters
    ----------
    method : OneStepMethod
    pace : Pace
        Of one trajectory, or of several in front.
    follow : function from a pace, a count of attempts, and whether there is Newton's method, to a pace
        See :func:`.pacing.follow`.
    alone : bool
        Whether there is one.
    """

    def __init__(self, method: OneStepMethod, pace: Pace, follow: Callable, alone: bool = False):
        self.pace, self._follow, self._alone = pace, follow, alone
        self.on_demand = OnDemand(method)

    def read(self, name: str, chosen: Any = slice(None)) -> np.ndarray:
        """A field of :class:`.stepping.State` or of :class:`.pacing.Pace` of some of them, trajectories first."""
        value = np.asarray(getattr(self.pace.state if name in State._fields else self.pace, name))
        return (value[None] if self._alone else value)[chosen]

    def write(self, name: str, chosen: np.ndarray | slice, values) -> None:
        whole = self.read(name).copy()
        whole[chosen] = values
        changed = {name: jnp.asarray(whole[0] if self._alone else whole)}
        of_state = name in State._fields
        self.pace = self.pace._replace(**{"state": self.pace.state._replace(**changed)} if of_state else changed)

    def follow(self, most: int) -> None:
        """So many attempts of each, or as many as it takes until it pauses."""
        self.pace = self.on_demand.follow(lambda pace, newton: self._follow(pace, most, newton), self.pace)

    def state(self) -> State:
        """That of the only trajectory as it stands."""
        return State(*(self.read(name)[0] for name in State._fields))

    def attempts(self, most: int) -> dict[str, np.ndarray]:
        """Make so many attempts of the only trajectory, or fewer.

        Attempts first, what :data:`.pacing.TOLD` names of each.
        """
        del most  # one, which nothing else follows
        self.follow(1)
        return {name: self.read(name) for name in TOLD}


Paces: TypeAlias = ArrayPaces | LanePaces
"""Trajectories that are followed together, each as it would be alone; or one, whose attempts can be looked at."""


def single(
    system: System, method: OneStepMethod, pacing: Pacing, x, t, stop, length, step: Callable | None = None
) -> ArrayPaces:
    """One trajectory, by programs of its own; ``step`` takes a step of an engine whose steps are no program."""
    pace = begin(system, method, pacing, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop, length))))

    def followed(pace: Pace, most: int, newton: bool) -> Pace:
        if step is not None:
            return follow_by(step, system, method, pacing, pace, most)
        return follow(system, method, pacing, pace, jnp.asarray(most), RULES, newton)

    found = ArrayPaces(method, pace, followed, True)
    found.on_demand.newton |= step is not None  # which has its own
    return found


def continued(system: System, method: OneStepMethod, pacing: Pacing, others: Paces) -> ArrayPaces:
    """The only trajectory of others from where another engine has come to."""
    found = single(system, method, pacing, *(others.read(name)[0] for name in ("x", "t", "stop", "stop")))
    for name in (*State._fields, *Pace._fields[1:]):
        found.write(name, slice(None), others.read(name).reshape(found.read(name).shape))
    return found


def many(form: Form, parameters, axes, method: OneStepMethod, pacing: Pacing, x, t, stop, length) -> ArrayPaces:
    """All trajectories of a batch in one program."""
    given = form, parameters, axes, method, pacing
    pace = _begin_all(*given, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop, length))))
    return ArrayPaces(method, pace, lambda pace, most, newton: _follow_all(*given, pace, jnp.asarray(most), newton))


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
