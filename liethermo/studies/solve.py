"""Solution of the points of a study; the result of a point does not depend on the other points."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..engines.status_codes import RESULT_CODES, StatusCode
from ..integrators import OneStepMethod
from ..results.audit import Tolerances, check_laws
from ..results.ensemble import Ensemble
from ..results.status import Laws
from ..runs.ensemble import ensemble
from ..runs.evidence import energy_and_entropy_rounding_scales
from ..runs.noise import Fluctuations
from ..systems import System
from ..systems.rotations import attitude_array
from ..tracing.caching import LRUCache
from ..tracing.interpret import evaluate_at_points
from .measures import Measure
from .members import PointParameters, PointwiseArrays, StudySystems

LAW_BROKEN = 64
"""Status of a point that ran to its end but violated a law; above every :class:`.StatusCode`."""

MEASURE_FAILED = 65
"""Status of a point whose run succeeded but one of whose measures raised an error."""

EMPTY_POINT_STATUS = -1
"""Status of a point without results: the fill value of the status array."""

STATUSES = {code.status_name: int(code) for code in RESULT_CODES if code != StatusCode.INTERRUPTED} | {
    "law_broken": LAW_BROKEN,
    "measure_failed": MEASURE_FAILED,
    "missing": EMPTY_POINT_STATUS,
}
"""Status names of a point and their codes in a store."""

SUCCESS_CODES = (StatusCode.COMPLETED, StatusCode.EVENT)
"""Status codes of a run that succeeded."""
LAW_QUANTITIES = (
    "steps iterations residual first_energy energy_drift largest_energy_increment energy_sensitivity energy_terms "
    "least_entropy_increment entropy_change entropy_scale entropy_sensitivity entropy_terms"
).split()
"""Numbers stored per point about the laws, enough to judge them later with other tolerances."""

ARRAY_BATCH_SIZE = 1024
"""Number of trajectories in a batch of the array engine, constant so that results do not depend on it."""

MAX_ARRAY_BATCH_VALUES = 2**15
"""Maximum number of state components in a batch of the array engine; batches of large states are smaller."""

MAX_PATH_BYTES = 2**27
"""Maximum number of bytes of the trajectories that are in memory at once."""


@dataclass(frozen=True)
class StudyTask:
    """The work to do at every point; it is sent to the workers.

    Attributes
    ----------
    build : function from the dict of a point to a System
    parameter_names : tuple of str
    x0, attitude : array or function from the dict of a point
        None if an axis brings the states, or the system has no attitude.
    t_span, step, method, until, engine
        As for :func:`liethermo.ensemble`.
    measures : dict of Measure
    example_point : dict
        The point whose system represents all others.
    n_saved : int
        Number of states along a run that are in memory at once.
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
    """Results of B points: status, message, laws and measures.

    Attributes
    ----------
    status : ndarray of int8, shape (B,)
    message : ndarray of str, shape (B,)
    laws : ndarray, shape (B, len(LAW_QUANTITIES))
    measures : dict of ndarray, shape (B, ...)
    """

    status: np.ndarray
    message: np.ndarray
    laws: np.ndarray
    measures: dict[str, np.ndarray]

    def arrays_by_name(self) -> dict[str, Any]:
        """Return the result arrays by their names in the store."""
        return {"status": self.status, "message": self.message, "laws": self.laws, **self.measures}


class LawSummary:
    """Laws of some points, read from a store, in the form that :func:`.check_laws` expects."""

    def __init__(self, status: np.ndarray, laws: np.ndarray):
        self.ok = np.isin(status, (*SUCCESS_CODES, LAW_BROKEN, MEASURE_FAILED))
        self._columns = dict(zip(LAW_QUANTITIES, np.moveaxis(laws, -1, 0), strict=True))

    def __getattr__(self, name: str) -> np.ndarray:
        try:
            return self.__dict__["_columns"][name]
        except KeyError:
            raise AttributeError(name) from None


FILLER_SEED_START = 2**63 - 2**32
"""First seed of the padding trajectories of a batch; the seeds of points are smaller."""


class PointSolver:
    """Solver of a task, with the family of its systems and the engine that runs them."""

    def __init__(self, task: StudyTask):
        self.task = task
        self.systems = StudySystems(task.build, task.parameter_names, task.example_point)
        self._x0 = None if task.x0 is None else PointwiseArrays(task.x0, task.parameter_names, "x0", task.example_point)
        self._attitude = (
            None
            if task.attitude is None
            else PointwiseArrays(
                attitude_array(task.attitude, None), task.parameter_names, "attitude", task.example_point
            )
        )
        needs_path = any(measure.needs_path for measure in task.measures.values())
        needs_final_state = any(measure.needs_final_state for measure in task.measures.values())
        self._outputs: Any = "trajectory" if needs_path else "final" if needs_final_state else "summary"
        self.laws: Laws | None = None
        self.engine: Any = task.engine

    def solve(
        self,
        points: PointParameters,
        initial_states: np.ndarray | None,
        n_points: int,
        noise_seeds: np.ndarray | None = None,
    ) -> PointResults:
        """Run the systems at some points and return their results.

        ``initial_states`` are given if an axis has them, and ``noise_seeds`` if the steps have noise; both have one
        entry for each of the ``n_points`` points.
        """
        self._noise_seeds = noise_seeds
        failure_messages: dict[int, str] = (
            {} if self.systems.family is None else self.systems.why_points_inadmissible(points, n_points)
        )
        x0s, attitudes = initial_states, None
        if self._x0 is not None:
            x0s, new_messages = self._x0(points, n_points)
            failure_messages = new_messages | failure_messages
        if self._attitude is not None:
            attitudes, new_messages = self._attitude(points, n_points)
            failure_messages = new_messages | failure_messages
        assert x0s is not None
        for i in map(int, np.flatnonzero(~np.isfinite(x0s.reshape(n_points, -1)).all(axis=1))):
            failure_messages.setdefault(i, f"the initial state is not finite: {x0s[i].tolist()}")
        indices = np.setdiff1d(np.arange(n_points), list(failure_messages))
        ensembles = self._solve_ensembles(points, x0s, attitudes, indices, failure_messages)
        return self._collect_results(ensembles, failure_messages, n_points)

    # -- ensembles ------------------------------------------------------------------------------------------------

    def _solve_ensembles(self, points, x0s, attitudes, indices: np.ndarray, failure_messages: dict[int, str]) -> list:
        """Run the points at ``indices`` in ensembles, and return pairs of point indices and ensemble.

        A point that cannot be run gets an entry in ``failure_messages``.
        """
        ensembles = []
        for start in range(0, len(indices), batch_size := self._points_per_ensemble()):
            ensembles += self._solve_or_bisect(
                points, x0s, attitudes, indices[start : start + batch_size], failure_messages
            )
        return ensembles

    def _points_per_ensemble(self) -> int:
        """Return the number of points of an ensemble: one without a family, and a constant one for the array engine."""
        if self.systems.family is None:
            return 1
        dim = self.systems.example_system.dim
        bytes_per_path = 8 * self.task.n_saved * (dim + 2)
        max_paths = max(2, MAX_PATH_BYTES // bytes_per_path) if bytes_per_path else 2**30
        return (
            max(1, min(ARRAY_BATCH_SIZE, MAX_ARRAY_BATCH_VALUES // dim, max_paths))
            if self.engine == "array"
            else max_paths
        )

    def _solve_or_bisect(self, points, x0s, attitudes, indices: np.ndarray, failure_messages: dict[int, str]) -> list:
        """Run the points at ``indices`` in one ensemble or, if that fails, each half by itself; return pairs of point
        indices and ensemble."""
        if not len(indices):
            return []
        try:
            solved_ensemble = self._run_ensemble(points, x0s, attitudes, indices)
        except Exception as error:  # becomes the status of the point when it is alone in the batch
            if len(indices) == 1:
                failure_messages[int(indices[0])] = describe_error(error)
                return []
        else:
            start_failures = solved_ensemble[
                -1
            ].reasons  # solve the other points without these, as results must not depend on the batch
            if not start_failures:
                return [(indices, solved_ensemble)]
            failure_messages |= {int(indices[i]): reason for i, reason in start_failures.items() if i < len(indices)}
            return self._solve_or_bisect(
                points, x0s, attitudes, np.setdiff1d(indices, list(failure_messages)), failure_messages
            )
        n_half = len(indices) // 2
        halves = indices[:n_half], indices[n_half:]
        return [
            indices_and_ensemble
            for half in halves
            for indices_and_ensemble in self._solve_or_bisect(points, x0s, attitudes, half, failure_messages)
        ]

    def _run_ensemble(self, points, x0s, attitudes, indices: np.ndarray) -> tuple[Any, np.ndarray, Ensemble]:
        """Run the points at ``indices`` as one ensemble; return their systems, initial states and the ensemble.

        For the array engine the batch is padded with the last point to a constant length, so that the compiled program
        does not depend on their number.
        """
        task = self.task
        if self.systems.family is None:
            padded_indices = indices
            family: Any = self.systems.system_at({name: values[padded_indices[0]] for name, values in points.items()})
        else:
            batch_size = self._points_per_ensemble() if self.engine == "array" else max(2, len(indices))
            padded_indices = indices[np.minimum(np.arange(batch_size), len(indices) - 1)]
            family = self.systems.family_at(points, padded_indices)
        attitude = None if attitudes is None else attitudes[padded_indices]
        noise = None
        if task.noise is not None and self._noise_seeds is not None:
            seeds = FILLER_SEED_START + np.arange(len(padded_indices))  # distinct seeds for the padding
            seeds[: len(indices)] = self._noise_seeds[indices]
            noise = replace(task.noise, seed=tuple(map(int, seeds[: len(padded_indices)])))
        options: dict[str, Any] = {"until": task.until, "save_at": task.save_at, "attitude": attitude, "noise": noise}
        result = ensemble(
            family, x0s[padded_indices], task.t_span, task.step, task.method, progress=False,
            outputs=self._outputs, engine=self.engine, **{k: v for k, v in options.items() if v is not None},
        )  # fmt: skip
        if (result.status == StatusCode.INTERRUPTED).any():
            raise KeyboardInterrupt
        return family, x0s[padded_indices], result

    # -- results ----------------------------------------------------------------------------------------------------

    def _collect_results(self, ensembles: list, failure_messages: dict[int, str], n_points: int) -> PointResults:
        """Evaluate the laws and measures of all ensembles, and return the results of all points."""
        status = np.full(n_points, StatusCode.INADMISSIBLE, dtype=np.int8)
        message = np.full(n_points, "", dtype=object)
        message[list(failure_messages)] = list(failure_messages.values())
        laws = np.full((n_points, len(LAW_QUANTITIES)), np.nan)
        measures: dict[str, np.ndarray] = {}
        for indices, (family, x0s, result) in ensembles:
            count = len(indices)
            self.laws, self.engine = result.laws, result.engine
            summary, codes, texts = self._law_values_and_trajectory_outcomes(family, x0s, result)
            for name, measure in self.task.measures.items():
                values, failures = measure(result, count)
                values = np.where(
                    _expand_mask_dims(np.isin(codes, (*SUCCESS_CODES, LAW_BROKEN)), values), values, np.nan
                )
                for i, reason in failures.items():
                    if codes[i] in SUCCESS_CODES:
                        codes[i], texts[i] = MEASURE_FAILED, f"{name}: {reason}"
                if name not in measures:
                    measures[name] = np.full((n_points, *values.shape[1:]), np.nan, dtype=values.dtype)
                measures[name][indices] = values[:count]
            status[indices], laws[indices] = codes[:count], summary[:count]
            for i, text in texts.items():
                if i < count:
                    message[indices[i]] = text
        return PointResults(status, message, laws, measures)

    def _law_values_and_trajectory_outcomes(
        self, family: Any, x0s: np.ndarray, ensemble_result: Ensemble
    ) -> tuple[np.ndarray, np.ndarray, dict[int, str]]:
        """Return the law quantities of each trajectory, its status code, and its message by index."""
        names = [name for name in LAW_QUANTITIES if not name.endswith("_terms")]
        columns = {name: np.asarray(getattr(ensemble_result, name), dtype=np.float64) for name in names}
        columns |= {"energy_terms": np.zeros(len(ensemble_result)), "entropy_terms": np.zeros(len(ensemble_result))}
        codes = ensemble_result.status.astype(np.int8)
        messages = {
            int(i): ensemble_result.message(int(i)).partition(": ")[2] for i in np.flatnonzero(~ensemble_result.ok)
        }
        violations = self._law_violation_messages(ensemble_result, columns)
        if len(violations):  # cancelling terms raise the tolerance, so their magnitudes are computed for the violations
            for name, terms in self._rounding_scales_at_start(family, x0s, violations).items():
                columns[f"{name}_terms"][list(violations)] = terms
            for i, text in self._law_violation_messages(ensemble_result, columns).items():
                codes[i], messages[i] = LAW_BROKEN, text
        return np.stack([columns[name] for name in LAW_QUANTITIES], axis=-1), codes, messages

    def _law_violation_messages(
        self, ensemble_result: Ensemble, law_values: Mapping[str, np.ndarray]
    ) -> dict[int, str]:
        """Return a message, by index, for each successful trajectory that violates a law."""
        terms = {name: law_values[f"{name}_terms"] for name in ("energy", "entropy")}
        violations: dict[int, str] = {}
        for check in check_laws(ensemble_result, ensemble_result.laws, Tolerances(), terms, has_entropy=False):
            for i in map(int, np.flatnonzero(check.is_violated & ensemble_result.ok)):
                row = check.audit_row(i)
                violations.setdefault(i, f"{row.law} {row.value:.3g}, allowed {row.tolerance:.2g}")
        return violations

    def _rounding_scales_at_start(
        self, family: Any, x0s: np.ndarray, violations: Mapping[int, str]
    ) -> dict[str, np.ndarray]:
        """Return the magnitudes at which energy and entropy are rounded, at the start of the violating trajectories."""
        indices = np.array(list(violations))
        x = np.asarray(self.systems.example_system.state(x0s[indices], batch=True))
        if self.systems.example_system.energy.depends_on_time:
            return {}
        if isinstance(family, System):
            magnitudes = evaluate_at_points(energy_and_entropy_rounding_scales, family, x)
        else:
            magnitudes = family.evaluate(energy_and_entropy_rounding_scales, indices, x)
        return {
            name: np.nan_to_num(magnitudes[:, k]) for k, name in enumerate(("energy", "entropy")[: magnitudes.shape[1]])
        }


def _expand_mask_dims(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the mask with appended axes of length 1, so that it broadcasts against the values."""
    return mask.reshape(-1, *[1] * (values.ndim - 1))


def describe_error(error: Exception) -> str:
    """Return the error's text, preceded by its type unless the library raised it."""
    is_library_error = type(error).__module__.partition(".")[0] in ("liethermo", "manifolds")
    return str(error) if is_library_error else f"{type(error).__name__}: {error}"


# -- on workers -------------------------------------------------------------------------------------------------------

_solver_cache: LRUCache[PointSolver] = LRUCache(4)


def cached_solver(pickled_task: bytes) -> PointSolver:
    """Return the solver of a pickled task, constructed once per process."""
    import cloudpickle

    return _solver_cache.get_or_compute(
        hashlib.sha256(pickled_task).digest(), lambda: PointSolver(cloudpickle.loads(pickled_task))
    )
