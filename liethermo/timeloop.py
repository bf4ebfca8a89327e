"""The only time loop: chunks, progress, failure, saving."""

from __future__ import annotations

import dataclasses
import datetime
import math
import os
import sys
import time
import warnings
from importlib import metadata
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from .engine import array, compiled
from .engine.scalarize import UnsupportedPrimitive
from .errors import ConvergenceError, InputError, NonFiniteError
from .integrators import MetriplecticMidpoint, OneStepMethod, Reference
from .solution import Laws, Solution, Stats, Status
from .systems import System

if TYPE_CHECKING:
    from rich.progress import Progress

CHUNK_SAVES = 1024
"""Saved states per call of the engine: enough to hide the cost of a call, few enough to show progress."""

CHUNK_STEPS = 100_000
"""Steps per call of the engine at most (about a second), so that Ctrl-C is heard."""

COMPILED_STEPS = 200_000
"""Steps from which "auto" compiles: the array engine would take longer for them than the compiler does."""

COMPILED_DIM = 40
"""Components up to which unrolled scalar code is a good idea."""

CHECKPOINT_SECONDS = 60.0
"""A run with ``save_to`` rewrites its file at most this often before the end."""


class CompiledEngineWarning(UserWarning):
    """A system that the compiled engine cannot run, so that the array engine does."""


def integrate(
    system: System,
    x0,
    t_span: tuple[float, float],
    step: float,
    method: OneStepMethod | Reference | None = None,
    *,
    save_every: int = 1,
    engine: Literal["auto", "array", "compiled"] = "auto",
    on_failure: Literal["raise", "return"] = "raise",
    progress: bool | None = None,
    save_to: str | os.PathLike | None = None,
) -> Solution:
    """Integrate a system from a state over a span of time.

    Parameters
    ----------
    system : System
    x0 : array, shape (n,)
    t_span : (float, float)
        Start and end, the end later. The last step is shortened to arrive there.
    step : float
        Step size, > 0; the spacing of the output for ``Reference``.
    method : OneStepMethod or Reference
        ``MetriplecticMidpoint()`` by default.
    save_every : int
        Keep every so-manieth state, and the last; the laws are followed at every step all the same.
    engine : {"auto", "array", "compiled"}
        JAX programs for systems of any size, or machine code of their own for small ones, ten times as fast and
        more, after some seconds of compiling the first time. "auto" compiles for runs that are long enough to repay
        it, and falls back, with a warning, where the system uses what cannot be compiled.
    on_failure : {"raise", "return"}
        What to do where a step cannot be taken. The trajectory so far is kept either way: on the exception as
        ``.solution``, or returned, with a ``status`` that says what happened.
    progress : bool, optional
        Show a progress bar; by default where the standard error is a terminal.
    save_to : path, optional
        Write the solution here, also on failure and at most once a minute on the way.

    Returns
    -------
    Solution
        After Ctrl-C, what exists, with status "interrupted".

    Raises
    ------
    InputError
        If an argument cannot be used.
    ConvergenceError, NonFiniteError
        If a step fails and ``on_failure`` is "raise".
    """
    method = MetriplecticMidpoint() if method is None else method
    if not isinstance(method, OneStepMethod | Reference):
        raise InputError(f"the method must be an integrator such as lt.MetriplecticMidpoint(), not {method!r}")
    _check(system, t_span, step, save_every, engine, on_failure)
    x = system.state(x0)
    span = (float(t_span[0]), float(t_span[1]))
    run = _Run(system, method, x, span, float(step), save_every, save_to, engine)
    with _Progress(span, progress) as bar:
        (run.by_scipy if isinstance(method, Reference) else run.by_steps)(bar)
    solution = run.solution()
    if save_to is not None:
        solution.save(save_to)
    if on_failure == "raise" and solution.status.code == "not_converged":
        raise ConvergenceError(solution.status.message, solution)
    if on_failure == "raise" and solution.status.code in ("non_finite", "reference_failed"):
        raise NonFiniteError(solution.status.message, solution)
    return solution


class _Run:
    """A run under way: what has been saved, and how it stands."""

    def __init__(self, system, method, x0, span, h, every, save_to, engine):
        self.system, self.method, self.span, self.h, self.every = system, method, span, h, every
        self.save_to, self.started = save_to, time.perf_counter()
        self.written = self.started
        self.times = [span[0]]
        self.states = [np.asarray(x0)[None]]
        self.values: list[np.ndarray] = []  # energies and entropies of the states
        self.status: Status | None = None
        self.stats = Stats()
        # The tolerance keeps 0.1 * 1000 from asking for a thousand-and-first step of 1e-14.
        steps = (span[1] - span[0]) / h
        self.steps = math.floor(steps * (1 + 1e-12))
        self.last = span[1] - (span[0] + self.steps * h)
        if self.last <= 1e-12 * (span[1] - span[0]):
            self.last = 0.0
        long = self.steps >= COMPILED_STEPS and system.dim <= COMPILED_DIM
        self.engine = "compiled" if engine == "compiled" or (engine == "auto" and long) else "array"
        self.fallback = engine == "auto"

    # -- the library's own methods ----------------------------------------------------------------------------------

    def by_steps(self, bar) -> None:
        """Drive the engine chunk by chunk, to the end, a failure or Ctrl-C."""
        capacity = max(1, min(CHUNK_SAVES, CHUNK_STEPS // self.every, _power_of_two(self.steps // self.every)))
        state, interrupted = self._begin(), False
        self.values.append(np.array([[float(state.energy), float(state.entropy)]]))
        try:
            done = 0
            while done < self.steps and int(state.status) == array.RUNNING:
                left = self.steps - done
                saves, every = (min(capacity, left // self.every), self.every) if left >= self.every else (1, left)
                state = self._advance(state, self.h, saves, every, capacity)
                done = int(state.step)
                bar.update(self.times[-1])
                self._checkpoint(state)
            if int(state.status) == array.RUNNING and self.last > 0.0:
                state = self._advance(state, self.last, 1, 1, capacity)
        except KeyboardInterrupt:
            interrupted = True
        self.stats, self.status = _stats(state), self._status(state, interrupted)

    def _begin(self):
        """The state to start from, by the engine that can run the system."""
        x = self.states[0][0]
        if self.engine == "compiled":
            try:
                return compiled.begin(self.system, self.method, x)
            except UnsupportedPrimitive as error:
                if not self.fallback:
                    raise
                warnings.warn(f"{error}; the array engine runs it instead", CompiledEngineWarning, stacklevel=5)
                self.engine = "array"
        return array.begin(self.system, self.method, x)

    def _advance(self, state, h, saves, every, capacity):
        before = int(state.step)
        engine = compiled if self.engine == "compiled" else array
        state, (x, energy, entropy, reached) = engine.advance(
            self.system, self.method, state, h, saves, every, capacity
        )
        kept = int(np.asarray(reached).sum())
        states, steps = np.asarray(x)[:kept], before + every * np.arange(1, kept + 1)
        values = np.stack([np.asarray(energy)[:kept], np.asarray(entropy)[:kept]], axis=1)
        if int(state.step) > before + every * kept:  # it failed between two saves: keep what there is
            states, steps = np.concatenate([states, np.asarray(state.x)[None]]), np.append(steps, int(state.step))
            values = np.append(values, [[float(state.energy), float(state.entropy)]], axis=0)
        self.states.append(states)
        self.values.append(values)
        self.times.extend(self._time(n) for n in steps)
        return state

    def _time(self, step: int) -> float:
        if step > self.steps or (step == self.steps and not self.last):
            return self.span[1]
        return self.span[0] + step * self.h

    def _status(self, state, interrupted: bool) -> Status:
        code, step, residual = int(state.status), int(state.step), float(state.residual)
        now = self._time(step)
        if interrupted:
            return Status("interrupted", f"stopped by the user after step {step}, t = {now:g}", step, now)
        if code == array.RUNNING:
            return Status("completed", f"reached t = {now:g} in {step} steps", step, now, residual)
        h = self.last if step >= self.steps else self.h
        where = f"step {step + 1}, from t = {now:g} with h = {h:g}"
        if code == array.NOT_CONVERGED:
            message = (
                f"the equations of {where} were not solved: the iteration stopped at a residual of {residual:.2g} "
                f"relative to the state (wanted: rounding, below {array.PLATEAU:.0e}). "
                f"Try a smaller step, for example {h / 2:g}"
            )
            return Status("not_converged", message, step, now, residual)
        message = (
            f"NaN or infinity in {where}: the energy, the entropy or the vector field is not finite there "
            f"({self._culprit(state)}). Check the domain of your functions along the trajectory, or try a smaller step"
        )
        return Status("non_finite", message, step, now, residual)

    def _culprit(self, state) -> str:
        """Which function is not finite just ahead of the last good state."""
        ahead = jnp.asarray(state.x) + self.h * jnp.nan_to_num(jnp.asarray(state.k[0]))
        system = self.system
        suspects = {"energy": system.energy.value, "gradient of the energy": system.energy.gradient}
        if system.entropy is not None:
            suspects |= {"entropy": system.entropy.value, "gradient of the entropy": system.entropy.gradient}
        for name, function in suspects.items():
            if not bool(jnp.isfinite(jnp.asarray(function(ahead))).all()):
                return f"the {name} first, near x = {np.array2string(np.asarray(ahead), precision=4, threshold=8)}"
        return "the iteration overflowed"

    # -- SciPy --------------------------------------------------------------------------------------------------------

    def by_scipy(self, bar) -> None:
        """One call of the reference solver, its output at the times a fixed step would have."""
        counts = [*range(0, self.steps, self.every), self.steps]
        times = np.array([self._time(n) for n in counts] + ([self.span[1]] if self.last else []))
        times = np.unique(times)
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
        entropy = np.zeros(len(x)) if self.system.entropy is None else np.asarray(self.system.entropy(x))
        return np.stack([np.asarray(self.system.energy(x)), entropy], axis=1)

    # -- the result ---------------------------------------------------------------------------------------------------

    def solution(self) -> Solution:
        """What there is so far."""
        system = self.system
        x = np.concatenate(self.states)
        invariants = system.invariants()
        energy, entropy = np.concatenate(self.values).T
        conserved = tuple(name for name, (J, kept) in invariants.items() if kept and _keeps(self.method, J))
        wall = time.perf_counter() - self.started
        return Solution(
            t=np.array(self.times),
            x=x,
            energy=energy,
            entropy=None if system.entropy is None else entropy,
            casimirs={name: np.asarray(function(x)) for name, (function, _) in invariants.items()},
            status=self.status or Status("interrupted", "still running", len(x) - 1, self.times[-1]),
            stats=dataclasses.replace(self.stats, wall_time=wall),
            laws=Laws(system.energy_law, system.entropy_law, conserved),
            provenance=self._provenance(),
        )

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
            "step": self.h,
            "t_span": list(self.span),
            "save_every": self.every,
            "x0": np.asarray(self.states[0][0]).tolist(),
            "system": type(self.system).__name__,
            "algebra": None if algebra is None else algebra.name,
            "dissipation": None if self.system.dissipation is None else type(self.system.dissipation).__name__,
        }


# -- helpers --------------------------------------------------------------------------------------------------------


def _check(system, t_span, step, save_every, engine, on_failure) -> None:
    if not isinstance(system, System):
        raise InputError(
            f"the first argument must be a system such as lt.LiePoissonSystem, not {type(system).__name__}"
        )
    try:
        start, end = (float(t) for t in t_span)
    except (TypeError, ValueError):
        raise InputError(f"t_span must be two numbers (start, end), not {t_span!r}") from None
    if not (math.isfinite(start) and math.isfinite(end) and end > start):
        raise InputError(f"t_span must be finite and increasing, not ({start:g}, {end:g})")
    try:
        h = float(step)
    except (TypeError, ValueError):
        raise InputError(f"step must be a number, not {step!r}") from None
    if not (math.isfinite(h) and h > 0.0):
        raise InputError(f"step must be positive and finite, not {h:g}: time runs forwards, since entropy grows")
    if start + h == start or end + h == end:
        raise InputError(f"step {h:g} vanishes beside the times {start:g} and {end:g} in double precision")
    if isinstance(save_every, bool) or not isinstance(save_every, int) or save_every < 1:
        raise InputError(f"save_every must be a positive integer, not {save_every!r}")
    if engine not in ("auto", "array", "compiled"):
        raise InputError(f"engine must be 'auto', 'array' or 'compiled', not {engine!r}")
    if on_failure not in ("raise", "return"):
        raise InputError(f"on_failure must be 'raise' or 'return', not {on_failure!r}")


def _keeps(method, function) -> bool:
    """Whether the method keeps a function exactly that the system conserves."""
    from .energy import Quadratic

    quadratic = all(isinstance(term, Quadratic) for term in function.terms)
    return quadratic and "quadratic_invariants" in method.preserves


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


def _power_of_two(n: int) -> int:
    """The next power of two: few distinct chunk sizes, so few compilations."""
    return 1 << max(0, n - 1).bit_length()


def _version() -> str:
    try:
        return metadata.version("liethermo")
    except metadata.PackageNotFoundError:
        return "(not installed)"


class _Progress:
    """A progress bar on the standard error, shown only where someone is there to see it."""

    def __init__(self, span: tuple[float, float], wanted: bool | None):
        self.span = span
        self.bar: Progress | None = None
        self.wanted = sys.stderr.isatty() if wanted is None else wanted

    def __enter__(self):
        if self.wanted:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (TextColumn("t = {task.fields[t]:.4g}"), BarColumn(), TimeRemainingColumn())
            self.bar = bar = Progress(*columns, console=Console(stderr=True, force_terminal=True), transient=True)
            bar.start()
            self.task = bar.add_task("", total=self.span[1] - self.span[0], t=self.span[0])
        return self

    def update(self, t: float) -> None:
        if self.bar is not None:
            self.bar.update(self.task, completed=t - self.span[0], t=t)

    def __exit__(self, *_):
        if self.bar is not None:
            self.bar.stop()
