"""Steps of sizes of their own: one attempt, how it is judged and what comes next, as functions that every engine runs.

A run that looks at every step carries a :class:`Pace`. One attempt takes a step, judges it by its estimated error, and
chooses the next. Where something is wanted that no engine does by itself, the run pauses: at a time where a state is
kept, where what grows near the state has to be looked at, and where an event may be. A step in which what is watched
changes its sign is tried again in shorter and shorter parts, until one ends where it does: at a zero, or at a jump,
which is none (:meth:`.paced.Guide.verify`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._module import Module

from ..integrators import OneStepMethod
from ..integrators.base import event_shares
from ..systems import System
from ..tracing.programs import program
from . import searching
from .codes import Code
from .growth import FEW, growing, stretch
from .rules import EPS, RULES, Rules
from .stages import given_up
from .stepping import State, first_state, take_step

GROWTH, EXPLICIT_GROWTH = 3.0, 10.0
"""Largest factor from one step to the next: more, and the prediction of the stages of an implicit one is worth
nothing."""

SHRINKAGE = 0.2
UNSOLVED = 0.25
"""Smallest factor after a step of too large an error, and the factor after one that could not be solved."""

AIM = 0.4
"""The share of the allowed error that the next step aims at."""

CUT = 0.99
"""The share of the wanted size below which a step has been cut short."""

DEADBAND = (0.9, 1.3)
"""Factors for which the step is kept: changes that small are not worth a worse prediction, and would chatter."""

ROUNDED = 4.0 * EPS
"""The least error that is allowed in a step, relative to the size of the state."""

GROWTH_ERROR = 2e-3
"""Largest relative error of the rate at which a small deviation grows: what falls from an unstable rest does so in its
time, to a few thousandths. The error of the state does not show it, as the deviation is no part of the state yet."""

TURNING = 0.01
"""Rate of growth of an oscillation, relative to its frequency, from which it counts: the derivative of a motion that
goes on varies, and gives oscillations that nothing excites small rates of either sign."""

CHANGED = 0.05
"""Change of the derivative of the motion, relative to it, below which what grows is not looked for again."""

ARRIVED, LOOKING, CAUGHT, FINISHED = 20, 21, 22, 23
"""Why a run pauses, beside the :class:`Code` of how it ended: it is where steps had to end; what grows near its state
is to be looked at; it is where what is watched changes its sign; it is at its end."""


TOLD = ("x", "energy", "entropy", "step", "t", "taken")
"""What is recorded of each attempt of a trajectory that is watched: fields of its state, its time and its step."""


class Pacing(Module):
    """How steps are chosen and what is watched: parameters of a program, as those of a system are.

    Attributes
    ----------
    rtol, atol, first, largest, shortest, most : array, shape ()
        Tolerances; the first step to try, 0 where it is found; the longest and the shortest; how many are tried.
    watched : pytree
        The function ``(system, x)`` whose sign is watched, or None.
    falling : bool
        Whether it is watched for a fall alone.
    adaptive : bool
        Otherwise all steps are of the size ``first``, but for those that arrive where they have to.
    """

    rtol: jax.Array | np.ndarray
    atol: jax.Array | np.ndarray
    first: jax.Array | np.ndarray
    largest: jax.Array | np.ndarray
    shortest: jax.Array | np.ndarray
    most: jax.Array | np.ndarray
    watched: Any
    falling: bool = eqx.field(static=True)
    adaptive: bool = eqx.field(static=True)

    def allowed(self, size) -> jax.Array:
        """The error that a state of a size may have."""
        return self.atol + self.rtol * size

    def watch(self, system: System, x) -> jax.Array:
        return jnp.zeros(()) if self.watched is None else self.watched(system, x)


class Pace(NamedTuple):
    """A run under way whose steps are looked at; its status is that of its state, or why it pauses."""

    state: State
    t: jax.Array
    stop: jax.Array  # when a step has to end next
    base: jax.Array  # when one had to last,
    since: jax.Array  # and the steps taken until then
    proposed: jax.Array  # size of the next step, unless it has to end somewhere
    taken: jax.Array  # size of the last one tried
    optimal: jax.Array  # the size with which the last one that counts would have had the allowed error; 0 before
    tried: jax.Array
    rejected: jax.Array
    cause: jax.Array  # status of the last one tried
    value: jax.Array  # of what is watched; infinite, with the last sign that is known, where it is not a number
    speed: jax.Array  # the largest at which the state has changed, relative to its size
    growth: jax.Array  # rate of what grows fastest, when it was looked at last,
    seen: jax.Array  # and how the motion stretched what lay near
    search: jax.Array  # for the event in a step: a searching.Search


def begun(system: System, method: OneStepMethod, pacing: Pacing, x, t, stop, length) -> Pace:
    """The pace of a run about to start at x; ``length`` is that of its whole span."""
    state, zero = first_state(system, method, x), jnp.zeros(())
    own, at = system.solved_for(x)
    size = jnp.max(jnp.abs(at))
    unit = jnp.where(size > 0.0, size, 1.0)
    speed = jnp.max(jnp.abs(own.vector_field(at))) / unit
    share = jnp.minimum(pacing.allowed(size) / unit, 1.0)
    # a step whose error is what is allowed, if each derivative of the motion is faster by the same rate; half of it
    found = 0.5 * share ** (1.0 / method.order) / jnp.where(speed > 0.0, speed, 1.0)
    found = jnp.where((speed > 0.0) & (size > 0.0), jnp.minimum(length, found), 1e-3 * length)
    proposed = jnp.minimum(jnp.where(pacing.first > 0.0, pacing.first, found), pacing.largest)
    now = stretch(own, at) if pacing.adaptive else jnp.zeros((1, 1))
    pace = Pace(
        state=state,
        t=zero + t,
        stop=zero + stop,
        base=zero + t,
        since=zero,
        proposed=proposed,
        taken=zero,
        optimal=zero,
        tried=zero,
        rejected=zero,
        cause=zero,
        value=pacing.watch(system, x),
        speed=speed,
        growth=zero,
        seen=jnp.full_like(now, jnp.nan),
        search=jnp.asarray(searching.NONE),
    )
    return held_back(method, pace, now) if pacing.adaptive else pace


def shape_seen(system: System, method: OneStepMethod, pacing: Pacing) -> tuple[int, ...]:
    """The shape of what a pace knows of the motion nearby."""
    if not pacing.adaptive:
        return 1, 1
    x = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
    return jax.eval_shape(lambda x: stretch(*system.solved_for(x)), x).shape


def fitted(pacing: Pacing, pace: Pace) -> tuple[jax.Array, jax.Array]:
    """The size of the next step, and the time after it."""
    h, reached = fitted_whole(pacing, pace)
    if pacing.watched is None:
        return h, reached
    search = searching.Search(*pace.search)
    part = search.share * search.whole
    end_of_part = jnp.minimum(pace.t + part, pace.stop)
    return jnp.where(search.whole > 0.0, part, h), jnp.where(search.whole > 0.0, end_of_part, reached)


def fitted_whole(pacing: Pacing, pace: Pace) -> tuple[jax.Array, jax.Array]:
    """The same for one that is not a part of another: none ends just short of where one has to end."""
    if pacing.adaptive:
        left = pace.stop - pace.t
        arrives = left <= pace.proposed * (1 + 1e-12)
        h = jnp.where(arrives, left, jnp.where(left < 2.0 * pace.proposed, 0.5 * left, pace.proposed))
        reached = jnp.where(arrives, pace.stop, pace.t + h)
        # the step that the clock sees, so that rounding of the times does not add up
        return jnp.where(arrives | ~(reached > pace.t), h, reached - pace.t), reached
    # as a timetable has them
    length, done = pace.stop - pace.base, pace.state.step - pace.since
    full = jnp.floor(length / pace.proposed * (1 + 1e-12))
    last = pace.stop - (pace.base + full * pace.proposed)
    short = last > 1e-12 * length
    arrives = done + 1.0 >= jnp.where(short, full + 1.0, full)
    return jnp.where(done < full, pace.proposed, last), jnp.where(
        arrives, pace.stop, pace.base + (done + 1.0) * pace.proposed
    )


def attempted(
    system: System, method: OneStepMethod, pacing: Pacing, pace: Pace, rules: Rules = RULES, second=None
) -> Pace:
    """One attempt; ``second`` as for :func:`.stepping.take_step`."""
    h, reached = fitted(pacing, pace)
    return judged(system, method, pacing, pace, h, reached, take_step(system, method, pace.state, h, rules, second))


def judged(system: System, method: OneStepMethod, pacing: Pacing, pace: Pace, h, reached, new: State) -> Pace:
    """The pace after an attempt: the step from it to the state ``new`` counts, or another is to be tried."""
    old, solved, cause = pace.state, new.status == Code.COMPLETED, 1.0 * new.status
    good, proposed, code = solved, pace.proposed, new.status
    speed, optimal = pace.speed, pace.optimal
    if pacing.adaptive:
        here, there = (system.solved_for(x)[1] for x in (old.x, new.x))
        size = jnp.maximum(jnp.max(jnp.abs(here)), jnp.max(jnp.abs(there)))
        gone = jnp.max(jnp.abs(there - here)) / jnp.where(size > 0.0, size, 1.0)
        speed = jnp.maximum(speed, jnp.where(solved, gone / h, 0.0))
        part = h * speed  # of the time in which the state, at its fastest, changes by its size
        allowed = jnp.maximum(pacing.allowed(size) * jnp.minimum(part, 1.0), ROUNDED * size + RULES.vanished)
        error = method.error(system, old.x, old.compensation, h, new.k) / allowed
        error = jnp.where(solved, error, jnp.inf)
        good = error <= 1.0
        power = 1.0 / (method.order + jnp.where(part < 1.0, 0.0, 1.0))
        optimal = h * jnp.maximum(error, 1e-12) ** -power
        longer = after_good(optimal, pace.optimal, h, proposed, power, pacing.largest, method.explicit)
        optimal = jnp.where(h < CUT * proposed, pace.optimal, optimal)
        proposed = jnp.where(good, longer, after_bad(error, h, power))
        seen = reached > pace.t  # or else the step is less than the last place of the time
        good = good & seen
        code = jnp.where(good | (seen & (proposed >= pacing.shortest)), Code.COMPLETED, Code.STEP_UNDERFLOW)
    sight = Sight(
        good=good,
        ends=jnp.zeros((), dtype=bool),
        value=pace.value,
        reached=reached,
        proposed=proposed,
        code=code,
        rejected=1.0 * ~good,
        search=pace.search,
    )
    if pacing.watched is not None:
        sight = sighted(system, method, pacing, pace, h, new, sight)
    good, ends, value, reached, proposed, code, rejected, search = sight
    goes_on = good & ~ends

    def kept(after, before):
        return jnp.where(goes_on, after, before)

    state = jax.tree_util.tree_map(lambda after, before: jnp.where(good, after, before), new, old)
    code = jnp.where(goes_on & (reached >= pace.stop), ARRIVED, code)
    tried = pace.tried + 1.0
    after = Pace(
        state=state._replace(status=code.astype(old.status.dtype), residual=new.residual),
        t=jnp.where(good | ends, reached, pace.t),
        stop=pace.stop,
        base=pace.base,
        since=pace.since,
        proposed=proposed,
        taken=h,
        optimal=kept(optimal, pace.optimal),
        tried=tried,
        rejected=pace.rejected + rejected,
        cause=cause,
        value=kept(value, pace.value),
        speed=kept(speed, pace.speed),
        growth=pace.growth,
        seen=pace.seen,
        search=search,
    )
    if not pacing.adaptive:
        return after
    looked = held_back(method, after, stretch(*system.solved_for(new.x)))
    after = jax.tree_util.tree_map(kept, looked, after)
    spent = (tried >= pacing.most) & (after.state.status == Code.COMPLETED)
    status = jnp.where(spent, Code.STEP_LIMIT, after.state.status).astype(old.status.dtype)
    return after._replace(state=after.state._replace(status=status))


# -- events -----------------------------------------------------------------------------------------------------------


class Sight(NamedTuple):
    """What an attempt means."""

    good: jax.Array  # whether its state is the next one
    ends: jax.Array  # whether an event is there
    value: jax.Array  # of what is watched
    reached: jax.Array  # when it ends
    proposed: jax.Array  # size of the next
    code: jax.Array  # whether the run goes on, pauses or fails
    rejected: jax.Array  # 1 for an attempt in vain, or 0
    search: jax.Array


def sighted(system: System, method: OneStepMethod, pacing: Pacing, pace: Pace, h, new: State, sight: Sight) -> Sight:
    """An attempt as it was judged, with a view to the event.

    A step in which it happens begins a search among steps from the same state, so that the event is as accurate as the
    method, and the laws hold there. Where it happens and is undone within a step, as the polynomial of the step tells,
    a shorter one is tried first; and where a part of a step fails of which the whole did not. A step may end where what
    is watched is not a number. The search in one that begins there takes it for what it was, so it ends where it is a
    number again. What the value is where a search ends is left in its place: see :func:`.searching.located`.
    """
    value, search = pacing.watch(system, new.x), searching.Search(*pace.search)
    seen = jnp.where(jnp.isnan(value) & jnp.isinf(pace.value), pace.value, value)
    looking, solved = search.whole > 0.0, (new.status == Code.COMPLETED) & ~jnp.isnan(seen)
    begins = sight.good & changes(pacing, pace.value, value) & ~looking
    cut, first = jnp.zeros((), dtype=bool), jnp.ones(())
    if pacing.adaptive:
        first, undone = first_change(system, method, pacing, pace, h * new.k, value)
        cut = sight.good & undone & ~looking
        begins = begins & ~cut
    narrower, found = searching.narrowed(search, seen)
    at_root = looking & solved & found
    at_start = looking & solved & ~found & (narrower.share <= 4.0 * EPS)
    later = sight.reached > pace.t
    lost, ends = looking & ~solved, at_root | at_start
    proposed = jnp.where(cut, first * h, jnp.where(looking | begins, pace.proposed, sight.proposed))
    code = jnp.where(ends, CAUGHT, jnp.where(looking, Code.COMPLETED, sight.code))
    if pacing.adaptive:
        proposed = jnp.where(lost, UNSOLVED * search.whole, proposed)
        short = jnp.where(new.status == Code.COMPLETED, Code.NON_FINITE, Code.STEP_UNDERFLOW)
        code = jnp.where(lost & (proposed < pacing.shortest), short, code)
    else:
        code = jnp.where(lost, jnp.where(new.status == Code.COMPLETED, Code.NON_FINITE, new.status), code)
    begun = jnp.stack(searching.begun(h, pace.value, value))
    there = searching.located(jnp.where(at_start, pace.value, jnp.where(later, seen, 0.0)))
    goes_on = jnp.where(looking & ~lost, jnp.where(ends, jnp.stack(there), jnp.stack(narrower)), searching.NONE)
    return Sight(
        good=jnp.where(looking, at_root & later, sight.good & ~cut & ~begins),
        ends=ends,
        value=jnp.where(jnp.isnan(value), jnp.inf * pace.value, value),
        reached=jnp.where(at_start, pace.t + narrower.share * search.whole, sight.reached),
        proposed=proposed,
        code=code,
        rejected=jnp.where(looking, 1.0 * lost, jnp.where(cut, 1.0, sight.rejected)),
        search=jnp.where(begins, begun, goes_on),
    )


def changes(pacing: Pacing, before, after) -> jax.Array:
    """Whether what is watched changes its sign as an event does."""
    falls = (before > 0.0) & (after <= 0.0)
    return falls if pacing.falling else falls | ((before < 0.0) & (after >= 0.0))


def first_change(system: System, method: OneStepMethod, pacing: Pacing, pace: Pace, d, end):
    """The first share of a step, among `event_shares`, with another sign; and whether a later one undoes that.

    An end at which what is watched is not a number does so too.
    """

    def value(weights) -> jax.Array:
        return pacing.watch(system, method.displaced(system, pace.state.x, weights @ d))

    share, changed, undone = jnp.ones(()), jnp.zeros((), dtype=bool), jnp.zeros((), dtype=bool)
    shares = event_shares(method.order)
    seen = jax.vmap(value)(jnp.asarray(method.weights(shares))) if len(shares) else ()
    for theta, there in zip([*shares, 1.0], [*seen, end], strict=True):
        other = pace.value * there < 0.0
        undone = undone | (changed & (pace.value * there > 0.0))
        share = jnp.where(other & ~changed, theta, share)
        changed = changed | other
    return share, undone | (changed & jnp.isnan(end))


# -- the size of the next step ----------------------------------------------------------------------------------------


def after_good(optimal, before, h, proposed, power, largest, explicit: bool) -> jax.Array:
    """The size of the next step, after one of size h that would have had the allowed error with the size ``optimal``.

    Where the optimal size shrinks, from ``before``, it is taken to go on as it does [Gustafsson; Hairer & Wanner 1996,
    IV.8]. The size of an implicit method's steps is kept where the change would be small. A step that is cut short to
    end somewhere says little about the next.
    """
    most = EXPLICIT_GROWTH if explicit else GROWTH
    trend = jnp.where(optimal < before, optimal / jnp.where(before > 0.0, before, 1.0), 1.0)
    factor = jnp.clip(AIM**power * optimal / h * trend, SHRINKAGE, most)
    longer = jnp.minimum(h * factor, largest)
    same = (DEADBAND[0] < factor) & (factor < DEADBAND[1]) & (not explicit)
    return jnp.where(h < CUT * proposed, jnp.maximum(proposed, longer), jnp.where(same, proposed, longer))


def after_bad(error, h, power) -> jax.Array:
    """The size of the next step after one with too large an error; infinity where its equations are not solved."""
    finite = jnp.isfinite(error)
    factor = jnp.maximum(SHRINKAGE, (AIM / jnp.where(finite, jnp.maximum(error, 1.0), 1.0)) ** power)
    return h * jnp.minimum(jnp.where(finite, factor, UNSOLVED), 0.9)


# -- what grows -------------------------------------------------------------------------------------------------------


def reach(method: OneStepMethod) -> float:
    """Largest product of a step and a rate of growth: what grows near the state then does so to :data:`GROWTH_ERROR`.

    A step of a one-step method multiplies the solution of a linear equation of rate r by R(h r), instead of exp(h r).
    Implicit ones damp or keep what they do not resolve, so they sleep through an instability in long steps.
    R is taken to be the diagonal Padé approximation of the method's order.
    """
    s = max(1, method.order // 2)
    constant = math.factorial(2 * s) * math.factorial(2 * s + 1) / math.factorial(s) ** 2
    return (GROWTH_ERROR * constant) ** (0.5 / s)  # ln R(z) / z = 1 +- z^2s / constant + ...


def held_back(method: OneStepMethod, pace: Pace, now) -> Pace:
    """No step longer than what grows near the state allows; a pause where that is not known.

    ``now`` is how the motion stretches what lies near, as :func:`.growth.stretch` finds it.
    """
    short = ~((reach(method) < size_of(now) * pace.proposed) & jnp.isfinite(size_of(now)))
    same = norm(now - pace.seen) <= CHANGED * norm(pace.seen)
    limit = jnp.where(pace.growth > 0.0, reach(method) / jnp.where(pace.growth > 0.0, pace.growth, 1.0), jnp.inf)
    unknown = ~short & ~same
    paused = jnp.where(unknown & (pace.state.status == Code.COMPLETED), LOOKING, pace.state.status)
    return pace._replace(
        state=pace.state._replace(status=paused.astype(pace.state.status.dtype)),
        proposed=jnp.where(short | unknown, pace.proposed, jnp.minimum(pace.proposed, limit)),
        seen=jnp.where(unknown, now, pace.seen),
        growth=jnp.where(unknown, jnp.nan, pace.growth),
    )


def size_of(stretch) -> jax.Array:
    """No eigenvalue of the linearised motion is larger: from its matrix, or about so from its powers."""
    if stretch.shape[1] > FEW:
        return jnp.sqrt(jnp.max(jnp.sum(stretch * stretch, axis=1)))
    square = stretch @ stretch
    return jnp.sqrt(jnp.sqrt(norm(square @ square)))


def norm(matrix) -> jax.Array:
    return jnp.sqrt(jnp.sum(matrix * matrix))


def fastest(matrices: np.ndarray) -> np.ndarray:
    """The sizes of the largest eigenvalues among those that grow, of matrices of shape (..., n, n)."""
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    rates = np.linalg.eigvals(np.where(finite[..., None, None], matrices, 0.0))
    return np.where(rates.real > TURNING * np.abs(rates), np.abs(rates), 0.0).max(axis=-1, initial=0.0)


def rate_of(system: System, method: OneStepMethod, x) -> float:
    """How fast what grows near a state does, of a system whose stretch is no matrix."""
    return float(fastest(np.asarray(growing(system, method, jnp.asarray(x)))))


# -- programs ---------------------------------------------------------------------------------------------------------


@program
def begin(system: System, method: OneStepMethod, pacing: Pacing, x, t, stop, length) -> Pace:
    return begun(system, method, pacing, x, t, stop, length)


@program
def follow(
    system: System, method: OneStepMethod, pacing: Pacing, pace: Pace, most, rules: Rules, newton: bool = True
) -> Pace:
    """The pace after so many attempts, or where it pauses; without ``newton`` also before one that lacks it."""
    second = None if newton else given_up

    def goes_on(carry):
        pace, attempts = carry
        return (pace.state.status == Code.COMPLETED) & (attempts < most) & (newton | (pace.cause == Code.COMPLETED))

    def again(carry):
        pace, attempts = carry
        after = attempted(system, method, pacing, pace, rules, second)
        if not newton:
            lacking = pace._replace(cause=after.cause), after.cause == Code.COMPLETED
            after = jax.tree_util.tree_map(lambda a, b: jnp.where(lacking[1], a, b), after, lacking[0])
        return after, attempts + 1

    return jax.lax.while_loop(goes_on, again, (pace, jnp.zeros((), dtype=jnp.int64)))[0]


def follow_by(step: Callable, system: System, method: OneStepMethod, pacing: Pacing, pace: Pace, most: int) -> Pace:
    """The same, by an engine whose steps are no program."""
    for _ in range(most):
        if int(pace.state.status) != Code.COMPLETED:
            break
        h, reached = _fitted(pacing, pace)
        pace = _judged(system, method, pacing, pace, h, reached, step(pace.state, h))
    return pace


@program
def _fitted(pacing, pace):
    return fitted(pacing, pace)


@program
def _judged(system, method, pacing, pace, h, reached, new):
    return judged(system, method, pacing, pace, h, reached, new)
