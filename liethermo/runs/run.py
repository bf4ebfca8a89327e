"""The only time loop: a run under way, what is kept of it, and how it ended."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import time
import warnings
from collections.abc import Callable
from importlib import metadata
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..engines import array
from ..engines.compiled import stepper as compiled
from ..engines.sparse.newton import SparseEngine
from ..errors import InputError
from ..functions.checks import traced_energies
from ..integrators import OneStepMethod, Reference, WithAttitude
from ..results.dense import Dense
from ..results.evidence import MEASURED, Witness, spread
from ..results.solution import Solution
from ..results.status import Laws, Stats, Status
from ..systems import AttitudeSystem, LiePoissonSystem, System, driven
from ..tracing.interpret import at_points
from ..tracing.programs import program
from ..tracing.remembered import remembered
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive import Adaptive
from .events import Event
from .stepwise import MOST_KEPT, stops_of
from .stepwise import run as run_stepwise
from .timetable import CHUNK_SAVES, CHUNK_STEPS, Timetable

SMALL_DIM, SMALL_PROGRAM = 16, 4000
"""Components of a state and operations of a step up to which it is compiled in about the time that XLA takes (two or
three seconds), so that "auto" always takes it."""

COMPILED_DIM = 40
"""Components up to which unrolled scalar code is a good idea."""

SPARSE_DIM = 200
"""Components from which a system that knows its sparsity is solved by it."""

MOST_LISTED = 1_000
"""Components up to which the first state is listed in the provenance; an attribute of a file cannot be of any size."""

COMPILED_STEPS = 20_000
"""Steps from which it is worth compiling for some seconds more."""

NO_GROUP = "an attitude is for a system with a group: give LiePoissonSystem one, such as group=mf.SO(3)"

SHORTER = (2.0, 8.0, 64.0, 1024.0, 16384.0)
"""Parts of a step that could not be solved that are tried, to see whether shorter ones can."""

CHECKPOINT_SECONDS = 60.0
"""A run with ``save_to`` rewrites its file at most this often before the end."""


class CompiledEngineWarning(UserWarning):
    """A system that the compiled engine cannot run, so that the array engine does."""


class Run:
    """A run under way: what has been saved, and how it stands."""

    def __init__(self, system, method, x0, table: Timetable, save_to, engine):
        self.system, self.method, self.table = system, method, table
        self.save_to, self.started = save_to, time.perf_counter()
        self.written = self.started
        self.times = [table.start]
        self.states = [np.asarray(x0)[None]]
        self.values: list[np.ndarray] = []  # energies and entropies of the states
        self.status: Status | None = None
        self.stats = Stats()
        self.step: float | Adaptive = table.h
        self.event_time: float | None = None
        self.dense: Dense | None = None
        self.longest: list[float] = []  # steps after each state that is kept
        self.capacity: int | None = None
        wanted = SMALL_DIM if table.steps < COMPILED_STEPS else COMPILED_DIM
        self.engine = ("compiled" if is_small(system, wanted) else "array") if engine == "auto" else engine
        self.sparse: SparseEngine | None = None
        if engine == "sparse" or (engine == "auto" and system.dim >= SPARSE_DIM):
            self.sparse = self._sparse(needed=engine == "sparse")
        self.fallback = engine == "auto"

    def _sparse(self, needed: bool) -> SparseEngine | None:
        """The sparse engine, where the system and the method can have it."""
        if not isinstance(self.method, OneStepMethod):
            return None
        if self.system.sparsity() is None:
            if needed:
                raise InputError(
                    f"the sparse engine cannot run a {self.system.kind} that does not know its sparsity: a "
                    "ComposedSystem of lt.Copies joined by lt.Each does"
                )
            return None
        self.engine = "sparse"
        return SparseEngine(self.system, self.method)

    @property
    def _driver(self) -> Any:
        """The engine."""
        return self.sparse or (compiled if self.engine == "compiled" else array)

    # -- the library's own methods ----------------------------------------------------------------------------------

    def by_steps(self, bar) -> None:
        """Drive the engine call by call, to the end, a failure or Ctrl-C."""
        every = self.table.every or 1
        saves = _power_of_two(self.table.full // every)  # few distinct capacities, so few compilations
        capacity = max(1, min(CHUNK_SAVES, CHUNK_STEPS // every, saves))
        if self.sparse is not None:
            capacity = 1  # its steps may take seconds: show each, and keep each on Ctrl-C
        self.capacity = capacity
        state, interrupted = None, False
        self.values = [self._energies(self.states[0])]
        try:
            state = self._begin()
            for h, saves, every in self.table.calls(saves=capacity):
                state = self._advance(state, h, saves, every, capacity)
                bar.update(self.times[-1])
                if int(state.status) != array.RUNNING:
                    break
                self._checkpoint(state)
        except KeyboardInterrupt:
            interrupted = True
        if state is None:
            self.status = Status("interrupted", "stopped by the user before the first step", 0, self.table.start)
            return
        step = int(state.step)
        now, h = self.table.time(step), self.table.last if step >= self.table.full else self.table.h
        self.stats, self.status = _stats(state), self._status(state, now, h, interrupted, capacity)

    def by_single_steps(self, bar, step: float | Adaptive, save_at, until, dense: bool) -> None:
        """Look at every step: adaptive ones, events, outputs at given times, dense output."""
        start, end, every = self.table.start, self.table.end, self.table.every or 1
        stops, event = stops_of(save_at, start, end), None if until is None else Event(until, self.system)
        self.step, pieces, last, kept = step, [], None, 0

        def keep(t, reached, h, before, after):
            nonlocal last, kept
            last = reached, after
            if len(self.times) > kept:  # the first step after a state that is kept
                self.longest.append(h)
                kept = len(self.times)
            self.longest[-1] = max(self.longest[-1], h)
            if dense:
                pieces.append((t, h, np.asarray(before.x), np.asarray(after.k)))
            if reached in stops if save_at is not None else int(after.step) % every == 0:
                self._append(reached, after)
                last = None
            bar.update(reached)
            self._checkpoint(after)

        state = None
        try:
            state = self._begin()
        except KeyboardInterrupt:
            self.values = [self._energies(self.states[0])]
            self.status = Status("interrupted", "stopped by the user before the first step", 0, start)
            return
        self.values = [np.array([[float(state.energy), float(state.entropy)]])]
        numbers = self.system.dim * ((1 if save_at is None else 0) / every + (self._stages + 1 if dense else 0))
        outcome = run_stepwise(
            self.system,
            self.method,
            self._stepping(),
            state,
            (start, end),
            step,
            stops,
            event,
            keep,
            most_kept=MOST_KEPT / max(numbers, 1e-9),
        )
        if last is not None:
            self._append(*last)
        self.event_time = outcome.event_time
        if pieces:
            begins, lengths, x, k = (np.array(column) for column in zip(*pieces, strict=True))
            self.dense = Dense(begins, lengths, x, k, None if self.system.space is None else self._along)
        state, now = outcome.state, self.times[-1]
        self.stats = dataclasses.replace(_stats(state), rejected=outcome.rejected)
        steps = int(state.step)
        if isinstance(step, Adaptive) and (outcome.underflow is not None or outcome.limit):
            self.status = _given_up(outcome, step, end, now)
        elif event is not None and outcome.event_time is not None:
            text = f"{event.name}: reached at t = {now:.15g} in {steps} steps"
            self.status = Status("event", text, steps, now, float(state.residual))
        else:
            h = step if isinstance(step, float) else float("nan")
            self.status = self._status(state, now, h, outcome.interrupted)
            if event is not None and self.status.ok:
                text = f"{self.status.message}; the event ({event.name}) did not happen"
                self.status = dataclasses.replace(self.status, message=text)

    def _along(self, x, v) -> np.ndarray:
        return np.asarray(_along(self.system, self.method, x, v))

    def _append(self, t: float, state) -> None:
        self.times.append(t)
        self.states.append(np.asarray(state.x)[None])
        self.values.append(np.array([[float(state.energy), float(state.entropy)]]))

    def _begin(self):
        """The state to start from, by the engine that can run the system."""
        x = self.states[0][0]
        if self.engine == "compiled":
            try:
                if self._affordable():
                    return compiled.begin(self.system, self.method, x)
                self.engine = "array"
            except UnsupportedPrimitive as error:
                self._fall_back(error)
        return array.begin(self.system, self.method, x)

    def _fall_back(self, error: UnsupportedPrimitive) -> None:
        """Let the array engine go on, where no engine was asked for."""
        if not self.fallback:
            raise error
        warn_of_fallback(error, stacklevel=7)
        self.engine = "array"

    @property
    def _stages(self) -> int:
        return self.method.stages

    def _attempt(self, call: Callable, state):
        """What ``call(engine, state)`` gives; by the array engine where only Newton's method cannot be compiled.

        Its program is made when a step first needs it.
        """
        try:
            return call(self._driver, state)
        except UnsupportedPrimitive as error:
            self._fall_back(error)
            like = array.begin(self.system, self.method, jnp.asarray(state.x))
            state = jax.tree_util.tree_map(lambda a, b: jnp.asarray(a, b.dtype), state, like)
            return call(self._driver, state)

    def _stepping(self) -> Callable:
        """One step, as an engine's ``stepping`` gives it."""
        made: dict[Any, Callable] = {}  # by engine

        def one(driver, state, h):
            if driver not in made:
                made[driver] = driver.stepping(self.system, self.method)
            return made[driver](state, h)

        return lambda state, h: self._attempt(lambda driver, state: one(driver, state, h), state)

    def _affordable(self) -> bool:
        """Whether to compile: where it was asked for, where it is quick, or where a long run repays it."""
        if not self.fallback or self.table.steps >= COMPILED_STEPS:
            return True
        return compiled.stepper_for(self.system, self.method)[0].operations <= SMALL_PROGRAM

    def _advance(self, state, h, saves, every, capacity):
        before = int(state.step)
        state, (x, energy, entropy, reached) = self._attempt(
            lambda driver, state: driver.advance(self.system, self.method, state, h, saves, every, capacity), state
        )
        kept = int(np.asarray(reached).sum())
        states, steps = np.asarray(x)[:kept], before + every * np.arange(1, kept + 1)
        values = np.stack([np.asarray(energy)[:kept], np.asarray(entropy)[:kept]], axis=1)
        if int(state.step) > before + every * kept:  # it failed between two saves: keep what there is
            states, steps = np.concatenate([states, np.asarray(state.x)[None]]), np.append(steps, int(state.step))
            values = np.append(values, [[float(state.energy), float(state.entropy)]], axis=0)
        self.states.append(states)
        self.values.append(values)
        self.times.extend(self.table.time(int(n)) for n in steps)
        return state

    def _status(self, state, now: float, h: float, interrupted: bool, capacity: int = 1) -> Status:
        code, step, residual = int(state.status), int(state.step), float(state.residual)
        if interrupted:
            return Status("interrupted", f"stopped by the user after step {step}, t = {now:g}", step, now)
        if code == array.RUNNING:
            return Status("completed", f"reached t = {now:g} in {step} steps", step, now, residual)
        where = f"step {step + 1}, from t = {now:g} with h = {h:g}"
        if code == array.NOT_CONVERGED:
            message = (
                f"the equations of {where} were not solved: the iteration stopped at a residual of {residual:.2g} "
                f"relative to the state (wanted: rounding, below {array.PLATEAU:.0e}). "
                + self._advice(state, h, capacity)
            )
            return Status("not_converged", message, step, now, residual)
        message = (
            f"NaN or infinity in {where}: the energy, the entropy or the vector field is not finite there "
            f"({self._culprit(state)}). Check the domain of your functions along the trajectory, or try a smaller step"
        )
        return Status("non_finite", message, step, now, residual)

    def _advice(self, state, h: float, capacity: int) -> str:
        """What helps where a step of size h could not be solved: shorter ones are tried."""
        state = dataclasses.replace(state, status=jnp.zeros_like(jnp.asarray(state.status)))
        for part in SHORTER:
            one = h / part, 1, 1, capacity
            new, _ = self._attempt(
                lambda driver, state, one=one: driver.advance(self.system, self.method, state, *one), state
            )
            if int(new.status) == array.RUNNING:
                return f"Try a smaller step, for example {h / part:g}"
        return (
            f"Steps down to {h / SHORTER[-1]:g} were tried and do not help: the functions may not be smooth there, or "
            "lose more digits than the iteration expects, as differences of large terms do"
        )

    def _culprit(self, state) -> str:
        """Which function is not finite just ahead of the last good state."""
        ahead = jnp.asarray(state.x) + self.table.h * jnp.nan_to_num(jnp.asarray(state.k[0]))
        system = self.system
        if isinstance(self.method, OneStepMethod) and (
            reason := self.method.explain(system, state.x, state.k, self.table.h)
        ):
            return reason
        suspects = {"energy": system.energy.value, "gradient of the energy": system.energy.gradient}
        if system.entropy is not None:
            suspects |= {"entropy": system.entropy.value, "gradient of the entropy": system.entropy.gradient}
        for name, function in suspects.items():
            if not bool(jnp.isfinite(jnp.asarray(function(ahead))).all()):
                near = np.array2string(np.asarray(system.seen(ahead)), precision=4, threshold=8)
                return f"the {name} first, near x = {near}"
        return (
            system.outside(ahead) or f"the iteration overflowed{system.domain and f', or did not find {system.domain}'}"
        )

    # -- SciPy --------------------------------------------------------------------------------------------------------

    def by_scipy(self, bar) -> None:
        """One call of the reference solver, its output at the times a fixed step would have."""
        times = self.table.times
        self.values = [self._energies(self.states[0])]
        try:
            x, evaluations, message = self.method.trajectory(self.system, self.states[0][0], times)
        except KeyboardInterrupt:
            self.status = Status("interrupted", "stopped by the user before SciPy returned anything", 0, times[0])
            return
        self.times, self.states = list(times[: len(x)]), [x]
        self.values = [self._energies(x)]
        self.stats = Stats(steps=len(x) - 1, fixed_point_iterations=evaluations)
        now = self.times[-1]
        bar.update(now)
        if message:
            text = f"SciPy's {self.method.scheme} stopped after t = {now:g}: {message}"
            self.status = Status("reference_failed", text, len(x) - 1, now)
        else:
            self.status = Status("completed", f"reached t = {now:g}", len(x) - 1, now)

    def _energies(self, x: np.ndarray) -> np.ndarray:
        return np.stack(at_points(array.values, self.system, x), axis=1)

    # -- the result ---------------------------------------------------------------------------------------------------

    def solution(self) -> Solution:
        """What there is so far."""
        system = self.system
        x = np.concatenate(self.states)
        invariants, laws = prepared(system, self.method)
        energy, entropy = np.concatenate(self.values).T
        wall = time.perf_counter() - self.started
        found = Solution(
            t=np.array(self.times),
            x=x,
            energy=energy,
            entropy=None if system.entropy is None else entropy,
            casimirs={
                name: at_points(_value, function, x)
                for name, function in {**{name: f for name, (f, _) in invariants.items()}, **system.ledger}.items()
            },
            status=self.status or Status("interrupted", "still running", len(x) - 1, self.times[-1]),
            stats=dataclasses.replace(self.stats, wall_time=wall),
            laws=laws,
            provenance=self._provenance(),
            event_time=self.event_time,
            dense=self.dense,
            witness=self._witness(x, {name: f for name, (f, _) in invariants.items()}),
        )
        return system.presented(found)

    def _witness(self, x: np.ndarray, functions: dict) -> Witness:
        """What finds the evidence for an audit."""
        some = spread(len(x), MEASURED)
        same = [self.table.h if self.table.full else self.table.last] * (len(x) - 1)
        h = np.array((self.longest or same)[: len(x) - 1])
        again = _Again(self.system, self.method, self._driver, self.capacity)
        return Witness(self.system, self.method, functions, x[some], np.array(self.times)[some], h[some[:-1]], again)

    def _checkpoint(self, state) -> None:
        if self.save_to is not None and time.perf_counter() - self.written > CHECKPOINT_SECONDS:
            self.stats = _stats(state)
            self.solution().save(self.save_to)
            self.written = time.perf_counter()

    def _provenance(self) -> dict[str, Any]:
        algebra = getattr(self.system, "algebra", None)
        return {
            "library": f"liethermo {_version()}",
            "jax": jax.__version__,
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "method": str(self.method),
            "engine": None if isinstance(self.method, Reference) else self.engine,
            "step": self.step if isinstance(self.step, float) else dataclasses.asdict(self.step),
            "t_span": [self.table.start, self.table.end],
            "save_every": self.table.every,
            "x0": np.asarray(self.states[0][0]).tolist() if self.system.dim <= MOST_LISTED else None,
            "system": type(self.system).__name__,
            "algebra": None if algebra is None else algebra.name,
            "dissipation": None if self.system.dissipation is None else type(self.system.dissipation).__name__,
        }


@dataclasses.dataclass(frozen=True, eq=False)
class _Again:
    """One step from any state, by the program that a run has compiled; ``capacity`` is None for single steps."""

    system: System
    method: Any
    driver: Any
    capacity: int | None

    def __call__(self, x: np.ndarray, h: float):
        state = self.driver.begin(self.system, self.method, jnp.asarray(x))
        if self.capacity is None:
            return self.driver.stepping(self.system, self.method)(state, h)
        return self.driver.advance(self.system, self.method, state, h, 1, 1, self.capacity)[0]


# -- helpers --------------------------------------------------------------------------------------------------------


def check_choice(what: str, given, choices: tuple[str, ...]) -> None:
    if given not in choices:
        *others, last = map(repr, choices)
        raise InputError(f"{what} must be {', '.join(others)} or {last}, not {given!r}")


def is_small(system: System, most: int) -> bool:
    """Whether a system is worth trying to compile: unrolled code, on the CPU, for ``most`` components at most."""
    return system.unrollable and system.dim <= most and jax.default_backend() == "cpu"


def warn_of_fallback(error: UnsupportedPrimitive, stacklevel: int) -> None:
    warnings.warn(f"{error}; the array engine runs it instead", CompiledEngineWarning, stacklevel=stacklevel)


@remembered
def as_run(system: System, method) -> tuple[System, Any]:
    """The system and the method as they are run.

    With clock and work where the energy depends on time, with attitudes where there is a group, in charts on a
    manifold.
    """
    if not isinstance(method, OneStepMethod):
        return driven(system, unit=1.0), method  # its errors are measured component by component
    system = driven(system)
    method = traced_energies(method.pulled(system).on(system), system.dim)
    if isinstance(system, LiePoissonSystem) and system.reconstruction is not None:
        return AttitudeSystem(system), WithAttitude(method, system.reconstruction)
    return system, method


@remembered
def prepared(system: System, method) -> tuple[dict, Laws]:
    """What is recorded along a run and what is promised of it; raises InputError where the method cannot be used."""
    if isinstance(method, OneStepMethod):
        method.check(system)
    invariants = system.invariants()
    return invariants, laws_of(system, method, invariants)


def laws_of(system: System, method, invariants) -> Laws:
    """What the system promises and, of its invariants, what the method keeps."""
    keeps = method.keeps if isinstance(method, OneStepMethod) else lambda system, name: False
    constants = [name for name, (_, kept) in invariants.items() if kept]
    conserved = tuple(name for name in constants if keeps(system, name))
    unpromised = tuple(name for name in constants if name not in conserved)
    quadratic = system.entropy is not None and system.entropy.is_quadratic
    exact = {"energy": {"energy"}, "entropy": {"entropy_law", *(["entropy_law_quadratic"] if quadratic else [])}}
    inexact = tuple(law for law, claims in exact.items() if not claims & method.preserves)
    ledger = tuple(system.ledger)
    return Laws(system.energy_law, system.entropy_law, conserved, ledger, inexact, system.balance, unpromised)


@program
def _along(system: System, method: OneStepMethod, x, v):
    return jax.vmap(lambda x, v: method.along(system, x, v))(x, v)


def _value(function, x):
    return function.value(x)


def _stats(state: array.State) -> Stats:
    followed = int(state.step) > 0
    return Stats(
        steps=int(state.step),
        fixed_point_iterations=int(state.fixed_point),
        newton_iterations=int(state.newton),
        most_iterations=int(state.most_iterations),
        worst_residual=float(state.worst_residual),
        energy_range=(float(state.smallest_energy), float(state.largest_energy)) if followed else None,
        least_entropy_increment=float(state.least_entropy_increment) if followed else None,
        largest_energy_increment=float(state.largest_energy_increment) if followed else None,
    )


def _given_up(outcome, step: Adaptive, end: float, now: float) -> Status:
    """How adaptive steps ended before the end, where none of them failed for good."""
    steps, residual = int(outcome.state.step), float(outcome.state.residual)
    if outcome.limit == "steps":
        text = f"{step.most_steps} steps were tried and t = {now:g} of {end:g} is reached: "
        text += "Adaptive(most_steps=...) allows more, and a larger tolerance takes fewer"
        return Status("step_limit", text, steps, now, residual)
    if outcome.limit:
        text = f"what is kept of {steps} steps fills the memory and t = {now:g} of {end:g} is reached: "
        return Status("step_limit", text + "save_every or save_at keeps fewer states", steps, now, residual)
    text = f"the step fell to {outcome.underflow:.2g} after step {steps}, t = {now:g}, and "
    if int(outcome.state.status) == array.RUNNING:
        text += "the error is still too large: the tolerance may be below what rounding allows, or the functions not "
        text += f"smooth there. Try a larger tolerance than {step}"
    else:
        text += "its equations are still not solved, so no step size helps: check that the functions are smooth and "
        text += "finite near that state"
    return Status("step_underflow", text, steps, now, residual)


def _power_of_two(n: int) -> int:
    """The next power of two: few distinct chunk sizes, so few compilations."""
    return 1 << max(0, n - 1).bit_length()


@functools.cache
def _version() -> str:
    try:
        return metadata.version("liethermo")
    except metadata.PackageNotFoundError:
        return "(not installed)"
