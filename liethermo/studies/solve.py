"""The points of a study solved: what is kept of each, whatever happens to it and in whatever company it is."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..engines.codes import RESULT_CODES, StatusCode
from ..integrators import OneStepMethod
from ..results.audit import Tolerances
from ..results.ensemble import Ensemble
from ..results.evidence import energy_and_entropy, rounding_scales
from ..results.many import evaluate_ensemble_laws
from ..results.status import Laws
from ..runs.ensemble import ensemble
from ..runs.fluctuations import Fluctuations
from ..systems import System
from ..tracing.caching import LRUCache
from ..tracing.interpret import evaluate_at_points
from .measures import Measure
from .members import PointParameters, PointwiseArrays, StudySystems

LAW_BROKEN, MEASURE_FAILED, NOT_COMPUTED = 64, 65, -1

STATUSES = {code.status_name: int(code) for code in RESULT_CODES if code != StatusCode.INTERRUPTED} | {
    "law_broken": LAW_BROKEN,
    "measure_failed": MEASURE_FAILED,
    "missing": NOT_COMPUTED,
}
"""How a point ended, and its number in a store."""

SUCCESS_CODES = (StatusCode.COMPLETED, StatusCode.EVENT)

LAW_QUANTITIES = (
    "steps iterations residual first_energy energy_drift largest_energy_increment energy_sensitivity energy_terms "
    "least_entropy_increment entropy_change entropy_scale entropy_sensitivity entropy_terms"
).split()
"""What is kept of every point about its laws: enough to judge them again with other tolerances."""

ARRAY_BATCH_SIZE, MAX_ARRAY_BATCH_VALUES = 1024, 2**15
"""Trajectories that the array engine takes at once, always as many; fewer where their states are large."""

MAX_PATH_BYTES = 2**27
"""Most bytes of the trajectories that are held at once."""


@dataclass(frozen=True)
class StudyTask:
    """What is done at every point; it is sent to the workers.

    Attributes
    ----------
    build : function from the dict of a point to a System
    parameter_names : tuple of str
    x0, attitude : array or function from the dict of a point; None where the points bring states, or there is no group
    t_span, step, method, until, engine
        As for :func:`liethermo.ensemble`.
    measures : dict of Measure
    example_point : dict
        The point whose system is looked at for all.
    n_saved : int
        States along a run that are held at once.
    """

    build: Callable[[dict], System]
    parameter_names: tuple[str, ...]
    x0: Any
    attitude: Any
    t_span: tuple[float, float]
    step: Any
    method: OneStepMethod
    until: Any
    engine: str
    measures: Mapping[str, Measure]
    example_point: Mapping[str, Any]
    save_at: tuple[float, ...] | None
    n_saved: int
    noise: Fluctuations | None = None


@dataclass
class PointResults:
    """What is kept of some points.

    Attributes
    ----------
    status : ndarray of int8, shape (B,)
    message : ndarray of str, shape (B,)
    laws : ndarray, shape (B, len(SUMMARY))
    measures : dict of ndarray, shape (B, ...)
    """

    status: np.ndarray
    message: np.ndarray
    laws: np.ndarray
    measures: dict[str, np.ndarray]

    def as_arrays(self) -> dict[str, Any]:
        return {"status": self.status, "message": self.message, "laws": self.laws, **self.measures}


class LawSummary:
    """The laws of some points as :func:`.many.laws_of_many` takes them, from what a store has of them."""

    def __init__(self, status: np.ndarray, laws: np.ndarray):
        self.ok = np.isin(status, (*SUCCESS_CODES, LAW_BROKEN, MEASURE_FAILED))
        self._columns = dict(zip(LAW_QUANTITIES, np.moveaxis(laws, -1, 0), strict=True))

    def __getattr__(self, name: str) -> np.ndarray:
        try:
            return self.__dict__["_columns"][name]
        except KeyError:
            raise AttributeError(name) from None


FILLER_SEED_START = 2**63 - 2**32
"""Seeds from here on belong to no point."""


class PointSolver:
    """A task with what has been found for it once: the family of its systems, and the engine that they run on."""

    def __init__(self, task: StudyTask):
        self.task = task
        self.systems = StudySystems(task.build, task.parameter_names, task.example_point)
        self._x0 = None if task.x0 is None else PointwiseArrays(task.x0, task.parameter_names, "x0", task.example_point)
        self._attitude = (
            None
            if task.attitude is None
            else PointwiseArrays(task.attitude, task.parameter_names, "attitude", task.example_point)
        )
        path = any(measure.needs_path for measure in task.measures.values())
        final = any(measure.needs_final_state for measure in task.measures.values())
        self._outputs: Any = "trajectory" if path else "final" if final else "summary"
        self.laws: Laws | None = None
        self.engine: Any = task.engine

    def solve(
        self, points: PointParameters, states: np.ndarray | None, size: int, seeds: np.ndarray | None = None
    ) -> PointResults:
        """What is kept of some points, with their initial states where they bring some, and their seeds with noise."""
        self._seeds = seeds
        reasons: dict[int, str] = {} if self.systems.family is None else self.systems.inadmissible_points(points, size)
        x0s, attitudes = states, None
        if self._x0 is not None:
            x0s, found = self._x0(points, size)
            reasons = found | reasons
        if self._attitude is not None:
            attitudes, found = self._attitude(points, size)
            reasons = found | reasons
        assert x0s is not None
        for i in map(int, np.flatnonzero(~np.isfinite(x0s.reshape(size, -1)).all(axis=1))):
            reasons.setdefault(i, f"the initial state is not finite: {x0s[i].tolist()}")
        chosen = np.setdiff1d(np.arange(size), list(reasons))
        parts = self._solve_ensembles(points, x0s, attitudes, chosen, reasons)
        return self._collect_results(parts, reasons, size)

    # -- ensembles ------------------------------------------------------------------------------------------------

    def _solve_ensembles(self, points, x0s, attitudes, chosen: np.ndarray, reasons: dict[int, str]) -> list:
        """Ensembles of the points, with their places; those that cannot be started get a reason."""
        parts = []
        for start in range(0, len(chosen), most := self._points_per_ensemble()):
            parts += self._solve_or_bisect(points, x0s, attitudes, chosen[start : start + most], reasons)
        return parts

    def _points_per_ensemble(self) -> int:
        """Points solved at once: one without a family; for XLA always as many."""
        if self.systems.family is None:
            return 1
        dim = self.systems.example_system.dim
        bytes_each = 8 * self.task.n_saved * (dim + 2)
        held = max(2, MAX_PATH_BYTES // bytes_each) if bytes_each else 2**30
        return max(1, min(ARRAY_BATCH_SIZE, MAX_ARRAY_BATCH_VALUES // dim, held)) if self.engine == "array" else held

    def _solve_or_bisect(self, points, x0s, attitudes, chosen: np.ndarray, reasons: dict[int, str]) -> list:
        """As :meth:`_solved`; where together they cannot be started, each half by itself."""
        if not len(chosen):
            return []
        try:
            part = self._run_ensemble(points, x0s, attitudes, chosen)
        except Exception as error:  # of one point, it is its status
            if len(chosen) == 1:
                reasons[int(chosen[0])] = describe_error(error)
                return []
        else:
            refused = part[-1].reasons  # of those, as of others, nothing may depend on who else is there
            if not refused:
                return [(chosen, part)]
            reasons |= {int(chosen[i]): reason for i, reason in refused.items() if i < len(chosen)}
            return self._solve_or_bisect(points, x0s, attitudes, np.setdiff1d(chosen, list(reasons)), reasons)
        middle = len(chosen) // 2
        halves = chosen[:middle], chosen[middle:]
        return [part for half in halves for part in self._solve_or_bisect(points, x0s, attitudes, half, reasons)]

    def _run_ensemble(self, points, x0s, attitudes, chosen: np.ndarray) -> tuple[Any, np.ndarray, Ensemble]:
        """An ensemble of some points, filled up with the last: the compiled program must not depend on their number."""
        task = self.task
        if self.systems.family is None:
            rows = chosen
            family: Any = self.systems.system_at({name: values[rows[0]] for name, values in points.items()})
        else:
            number = self._points_per_ensemble() if self.engine == "array" else max(2, len(chosen))
            rows = chosen[np.minimum(np.arange(number), len(chosen) - 1)]
            family = self.systems.family_at(points, rows)
        attitude = None if attitudes is None else attitudes[rows]
        noise = None
        if task.noise is not None and self._seeds is not None:
            filling = FILLER_SEED_START + np.arange(len(rows))  # seeds of those that only fill up, no two alike
            filling[: len(chosen)] = self._seeds[chosen]
            noise = replace(task.noise, seed=tuple(map(int, filling[: len(rows)])))
        options: dict[str, Any] = {"until": task.until, "save_at": task.save_at, "attitude": attitude, "noise": noise}
        found = ensemble(
            family, x0s[rows], task.t_span, task.step, task.method, progress=False,
            outputs=self._outputs, engine=self.engine, **{k: v for k, v in options.items() if v is not None},
        )  # fmt: skip
        if (found.status == StatusCode.INTERRUPTED).any():
            raise KeyboardInterrupt
        return family, x0s[rows], found

    # -- what is kept -----------------------------------------------------------------------------------------------

    def _collect_results(self, parts: list, reasons: dict[int, str], size: int) -> PointResults:
        status = np.full(size, StatusCode.INADMISSIBLE, dtype=np.int8)
        message = np.full(size, "", dtype=object)
        message[list(reasons)] = list(reasons.values())
        laws = np.full((size, len(LAW_QUANTITIES)), np.nan)
        measures: dict[str, np.ndarray] = {}
        for chosen, (family, x0s, found) in parts:
            number = len(chosen)
            self.laws, self.engine = found.laws, found.engine
            summary, codes, texts = self._judge_laws(family, x0s, found)
            for name, measure in self.task.measures.items():
                values, failed = measure(found, number)
                values = np.where(_align_axes(np.isin(codes, (*SUCCESS_CODES, LAW_BROKEN)), values), values, np.nan)
                for i, reason in failed.items():
                    if codes[i] in SUCCESS_CODES:
                        codes[i], texts[i] = MEASURE_FAILED, f"{name}: {reason}"
                if name not in measures:
                    measures[name] = np.full((size, *values.shape[1:]), np.nan, dtype=values.dtype)
                measures[name][chosen] = values[:number]
            status[chosen], laws[chosen] = codes[:number], summary[:number]
            for i, text in texts.items():
                if i < number:
                    message[chosen[i]] = text
        return PointResults(status, message, laws, measures)

    def _judge_laws(
        self, family: Any, x0s: np.ndarray, found: Ensemble
    ) -> tuple[np.ndarray, np.ndarray, dict[int, str]]:
        """The summary of each trajectory, its status, and its message."""
        names = [name for name in LAW_QUANTITIES if not name.endswith("_terms")]
        columns = {name: np.asarray(getattr(found, name), dtype=np.float64) for name in names}
        columns |= {"energy_terms": np.zeros(len(found)), "entropy_terms": np.zeros(len(found))}
        codes = found.status.astype(np.int8)
        texts = {int(i): found.message(int(i)).partition(": ")[2] for i in np.flatnonzero(~found.ok)}
        suspects = self._broken_laws(found, columns)
        if len(suspects):  # what cancels in a function allows it to change by more: looked at where it matters
            for name, terms in self._term_magnitudes(family, x0s, suspects).items():
                columns[f"{name}_terms"][list(suspects)] = terms
            for i, text in self._broken_laws(found, columns).items():
                codes[i], texts[i] = LAW_BROKEN, text
        return np.stack([columns[name] for name in LAW_QUANTITIES], axis=-1), codes, texts

    def _broken_laws(self, found: Ensemble, columns: Mapping[str, np.ndarray]) -> dict[int, str]:
        """The trajectories that came to their end and broke a law, and by how much."""
        terms = columns["energy_terms"], columns["entropy_terms"]
        broken: dict[int, str] = {}
        for law in evaluate_ensemble_laws(found, found.laws, Tolerances(), *terms):
            for i in map(int, np.flatnonzero(law.is_violated & found.ok)):
                broken.setdefault(i, f"{law.law} {law.values[i]:.3g}, allowed {law.limits[i]:.2g}")
        return broken

    def _term_magnitudes(self, family: Any, x0s: np.ndarray, suspects: Mapping[int, str]) -> dict[str, np.ndarray]:
        """The sizes at which energy and entropy are rounded at the start of some trajectories."""
        chosen = np.array(list(suspects))
        x = np.asarray(self.systems.example_system.state(x0s[chosen], batch=True))
        if self.systems.example_system.energy.depends_on_time:
            return {}
        if isinstance(family, System):
            largest = evaluate_at_points(_system_term_magnitudes, family, x)
        else:
            p = family.parameter_matrix(slice(None), len(x0s))[chosen]
            largest = evaluate_at_points(
                _family_term_magnitudes, (family.form, p.shape[1]), np.concatenate([p, x], axis=1)
            )
        return {name: np.nan_to_num(largest[:, k]) for k, name in enumerate(("energy", "entropy")[: largest.shape[1]])}


def _align_axes(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    return rows.reshape(-1, *[1] * (values.ndim - 1))


def _system_term_magnitudes(system: System, x):
    return rounding_scales(energy_and_entropy(system), x)[1]


def _family_term_magnitudes(model, at):
    form, p = model
    return rounding_scales(energy_and_entropy(form.build(at[:p])), at[p:])[1]


def describe_error(error: Exception) -> str:
    """What was raised: the library's own messages as they are, others with their kind."""
    own = type(error).__module__.partition(".")[0] in ("liethermo", "manifolds")
    return str(error) if own else f"{type(error).__name__}: {error}"


# -- on workers -------------------------------------------------------------------------------------------------------

_solver_cache: LRUCache[PointSolver] = LRUCache(4)


def cached_solver(packed: bytes) -> PointSolver:
    """The solver of a task as it was sent, made once in a process."""
    import cloudpickle

    return _solver_cache.get_or_compute(hashlib.sha256(packed).digest(), lambda: PointSolver(cloudpickle.loads(packed)))
