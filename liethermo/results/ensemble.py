"""Result of an ensemble of runs: all trajectories with their laws and their statuses."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from manifolds._arguments import is_integer
from manifolds._precision import with_library_settings
from manifolds._tables import html_grid

from ..engines.status_codes import STATUS_NAMES, StatusCode
from ..errors import InputError
from .audit import (
    FAILED_TRAJECTORIES_ROW,
    Audit,
    AuditRow,
    Tolerances,
    accuracy_and_consistency_rows,
    check_laws,
    condition_rows,
    coverage_text,
    invariant_drift_row,
)
from .audit_evidence import AuditableResult, Evidence, velocity_copy_functions
from .events import Events
from .netcdf import (
    ENSEMBLE_FORMAT,
    build_dataset,
    dataclass_from_json,
    join_complex,
    numeric_array_of_shape,
    split_complex,
    state_axis_names,
)
from .orientation import orientation_and_velocity_variables
from .solution import Solution
from .status import Laws, Stats, Status

if TYPE_CHECKING:
    import xarray


STATUS_MESSAGES = {
    StatusCode.COMPLETED: "reached t = {t:.15g} in {n} steps",
    StatusCode.NOT_CONVERGED: "the equations of step {next}, from t = {t:.15g}, were not solved: the iteration "
    "stopped at a residual of {r:.2g} relative to the state. Try a smaller step",
    StatusCode.NON_FINITE: "NaN or infinity in step {next}, from t = {t:.15g}: the energy, the entropy, the vector "
    "field or the event function is not finite there. Check the domain of the functions, or try a smaller step",
    StatusCode.INTERRUPTED: "stopped by the user after step {n}, t = {t:.15g}",
    StatusCode.EVENT: "the event happened at t = {t:.15g} in {n} steps",
    StatusCode.STEP_UNDERFLOW: "no step from t = {t:.15g}, after step {n}, was short enough for the tolerance: the "
    "tolerance may be below the rounding errors, or the functions may not be smooth there",
    StatusCode.STEP_LIMIT: "the largest number of attempted steps was used up at t = {t:.15g}. Allow more with "
    "Adaptive(most_steps=...), or take a larger tolerance or a method of higher order",
    StatusCode.INADMISSIBLE: "{reason}",
}
"""Template of the message for each status: t is the end time, n the number of steps, r the residual."""


@dataclass(frozen=True)
class Ensemble(AuditableResult):
    """The result of :func:`ensemble`: B trajectories, which are the first axis of every array.

    ``e[i]`` is one trajectory as a :class:`Solution`, and iterating over an ensemble gives all of them.

    Attributes
    ----------
    t : ndarray, shape (times,)
        Start, saves and end for ``outputs="trajectory"``; otherwise the end alone, shape (1,).
    x : ndarray or None
        Final states, shape (B, n), or trajectories, shape (B, times, n), with NaN from where one failed; None for
        ``outputs="summary"``.
    energy, entropy : ndarray, shape (B,) or (B, times), as x has
        Final values for ``"summary"``. ``entropy`` is None for a system without one.
    status : ndarray of int8, shape (B,)
        Indices in ``STATUS_NAMES``: 0 completed, 1 not converged, 2 not finite, 3 interrupted, 4 ended by its event, 5
        and 6 adaptive steps that were too short or too many, 8 inadmissible: a trajectory that could not be started,
        with its parameters or from its state.
    steps, rejected, iterations : ndarray, shape (B,)
        Numbers of steps taken, of adaptive steps that were too long, and of solver iterations.
    residual : ndarray, shape (B,)
        ``h |k - slopes(k)| / |x|`` of the last attempted step.
    energy_drift : ndarray, shape (B,)
        ``max |H - H0|`` over every step, relative to the rounding scale of H: as for :class:`Audit`.
    largest_energy_increment, least_entropy_increment : ndarray, shape (B,)
        Extreme increments in one step, over every step.
    energy_sensitivity, entropy_sensitivity : ndarray, shape (B,)
        Largest :meth:`liethermo.Energy.sensitivity` over every step, relative to which rounding is judged.
    first_energy, entropy_change, entropy_scale : ndarray, shape (B,)
        ``H(0)``, ``S(T) - S(0)`` and ``max(|S(0)|, |S(T)|)``.
    relaxation_time : ndarray, shape (B,)
        ``int_0^T (S(T) - S(t)) dt / (S(T) - S(0))``, T the end of the trajectory: the time constant of an exponential
        relaxation that is over by T. Under a double bracket the energy replaces S. NaN if nothing relaxes.
    smallest_energy, largest_energy, end_time : ndarray, shape (B,)
        Extremes of the energy over every step, less the work done from outside, and the time reached.
    x0 : ndarray, shape (B, n); on sites, as x, with ``(*sites, d)`` instead of n
        Initial states.
    laws, engine, wall_time : Laws, str, float
        The laws that the audit checks, the engine, and the seconds of the run, with compilation.
    attitude, attitude0 : ndarray, shape (B, m, m) or (B, times, m, m), or None
        Elements of the group, if the system has one and states are kept, and those at the start.
    work : ndarray, shape (B,) or (B, times), or None
        Work done on the system from outside, if its energy depends on time; the drift and the increments of the energy
        are then those of the energy less the work.
    events : Events
        The events of each function of ``until``: ``e.events[k]`` has times ``t``, states ``x``, numbers ``trajectory``.
    reasons, provenance : mapping from int to str, dict
        Why trajectories are inadmissible or have failed; JSON data: library version, method, step, system, date.
    """

    state_fields = ("x", "x0")

    t: np.ndarray
    x: np.ndarray | None
    energy: np.ndarray
    entropy: np.ndarray | None
    status: np.ndarray
    steps: np.ndarray
    residual: np.ndarray
    energy_drift: np.ndarray
    largest_energy_increment: np.ndarray
    least_entropy_increment: np.ndarray
    entropy_scale: np.ndarray
    energy_sensitivity: np.ndarray
    entropy_sensitivity: np.ndarray
    first_energy: np.ndarray
    entropy_change: np.ndarray
    relaxation_time: np.ndarray
    iterations: np.ndarray
    smallest_energy: np.ndarray
    largest_energy: np.ndarray
    end_time: np.ndarray
    rejected: np.ndarray
    x0: np.ndarray
    laws: Laws
    engine: str
    wall_time: float
    attitude: np.ndarray | None = None
    attitude0: np.ndarray | None = None
    work: np.ndarray | None = None
    events: Events = field(default_factory=Events)
    reasons: Mapping[int, str] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    evidence_source: Callable[[], Evidence] | None = field(default=None, repr=False, compare=False)
    velocity_sources: Mapping[str, Callable[[], np.ndarray]] = field(default_factory=dict, repr=False, compare=False)
    solution_builder: Callable[[Ensemble, int], Solution] | None = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "solution_builder": None}

    def __len__(self) -> int:
        return len(self.status)

    @property
    def ok(self) -> np.ndarray:
        """True for each trajectory that reached its end, shape (B,)."""
        return np.isin(self.status, (StatusCode.COMPLETED, StatusCode.EVENT))

    @property
    def event_time(self) -> np.ndarray:
        """Times of the events, shape (B,); NaN if a trajectory has none."""
        return np.where(self.status == StatusCode.EVENT, self.end_time, np.nan)

    def __repr__(self) -> str:
        n_completed = int(np.sum(self.ok))
        return f"Ensemble({len(self.status)} trajectories to t = {np.max(self.end_time):g}, {n_completed} completed)"

    # -- one trajectory -------------------------------------------------------------------------------------------

    def __getitem__(self, i: int) -> Solution:
        """Return one trajectory as a solution at the saved times, or at its start and end.

        Its Casimirs and the evidence for its audit are computed now; a trajectory of an ensemble from a file has none.

        Raises
        ------
        IndexError
            If there is no such trajectory.
        InputError
            If no states were kept, or the trajectory is inadmissible.
        """
        i = self._checked_member_index(i)
        if self.x is None:
            raise InputError('no states were kept. Run the ensemble with outputs="final" or "trajectory"')
        if self.status[i] == StatusCode.INADMISSIBLE:
            raise InputError(self.message(i))
        return self.member_solution(i) if self.solution_builder is None else self.solution_builder(self, i)

    def __iter__(self) -> Iterator[Solution]:
        return (self[i] for i in range(len(self)))

    def _checked_member_index(self, i) -> int:
        """Return i as an index from 0; raise InputError or IndexError if there is no such trajectory."""
        if not is_integer(i):
            raise InputError(f"the index of a trajectory must be an integer, got {i!r}")
        if not -len(self) <= i < len(self):
            raise IndexError(f"the index of a trajectory must be from {-len(self)} to {len(self) - 1}, got {i}")
        return int(i) % len(self)

    def message(self, i: int) -> str:
        """Return a text that begins with the index of a trajectory and says how the trajectory ended."""
        i = self._checked_member_index(i)
        facts = {"t": self.end_time[i], "n": self.steps[i], "next": self.steps[i] + 1, "r": self.residual[i]}
        code, reason = StatusCode(self.status[i]), self.reasons.get(i, "")
        text = STATUS_MESSAGES[code].format(reason=reason, **facts)
        if reason and code != StatusCode.INADMISSIBLE:
            text = f"step {facts['next']} could not be taken: {reason}"
        return f"trajectory {i}: {text}"

    def member_status(self, i: int) -> Status:
        """Return the status of a trajectory."""
        i = self._checked_member_index(i)
        residual = float(np.nan_to_num(self.residual[i]))
        return Status(
            StatusCode(self.status[i]), self.message(i), int(self.steps[i]), float(self.end_time[i]), residual
        )

    def member_stats(self, i: int) -> Stats:
        """Return the statistics of a trajectory; fixed-point and Newton iterations are counted together."""
        has_stepped = self.steps[i] > 0
        min_entropy_increment = float(self.least_entropy_increment[i]) if has_stepped else None
        return Stats(
            steps=int(self.steps[i]),
            fixed_point_iterations=int(self.iterations[i]),
            rejected=int(self.rejected[i]),
            worst_residual=float(self.residual[i]) if self.ok[i] else 0.0,
            energy_range=(float(self.smallest_energy[i]), float(self.largest_energy[i])) if has_stepped else None,
            least_entropy_increment=min_entropy_increment,
            largest_energy_increment=float(self.largest_energy_increment[i]) if has_stepped else None,
            wall_time=self.wall_time,
        )

    def member_solution(self, i: int) -> Solution:
        """Return one trajectory as a solution with the data of this ensemble, without Casimirs."""
        has_time_series = self.energy.ndim == 2
        is_reached = np.isfinite(self.energy[i]) if has_time_series else np.array([True])
        work = None if self.work is None else self.work[i]

        def series(values_of_members, initial_value):
            """Return the values of this trajectory at its saved times, or at its start and end."""
            return (
                values_of_members[i][is_reached] if has_time_series else np.stack([initial_value, values_of_members[i]])
            )

        assert self.x is not None
        first_energy = self.first_energy[i]
        entropy_sensitivity = None if self.entropy is None else float(self.entropy_sensitivity[i])
        attitude = None
        if self.attitude is not None and self.attitude0 is not None:
            attitude = series(self.attitude, self.attitude0[i])
        evidence = Evidence(energy=float(self.energy_sensitivity[i]), entropy=entropy_sensitivity)
        return Solution(
            t=self.t[is_reached] if has_time_series else np.array([self.provenance["t_span"][0], self.end_time[i]]),
            x=series(self.x, self.x0[i]),
            energy=series(self.energy, first_energy),
            entropy=None if self.entropy is None else series(self.entropy, self._initial_entropy(i)),
            casimirs={}
            if work is None
            else {"work": work[is_reached] if has_time_series else np.stack([0.0 * work, work])},
            status=self.member_status(i),
            stats=self.member_stats(i),
            laws=self.laws,
            provenance={**self.provenance, "trajectory": i, "x0": self.x0[i].tolist()},
            attitude=attitude,
            event_time=float(self.end_time[i]) if self.status[i] == StatusCode.EVENT else None,
            events=self.events.select_trajectory(i),
            evidence_source=lambda: evidence,
            velocity_sources=self._member_velocity_sources(i, is_reached) if has_time_series else {},
        )

    def _member_velocity_sources(self, i: int, is_reached: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
        """Return functions that compute the velocities of trajectory i at its saved times, by name."""

        def velocities(name: str) -> np.ndarray:
            return self.velocity_sources[name]()[i][is_reached]

        return {name: partial(velocities, name) for name in self.velocity_sources}

    def _initial_entropy(self, i: int) -> float:
        assert self.entropy is not None
        return self.entropy[i, 0] if self.entropy.ndim == 2 else self.entropy[i] - self.entropy_change[i]

    # -- all trajectories -----------------------------------------------------------------------------------------

    def __str__(self) -> str:
        counts = [
            f"{(self.status == code).sum()} {name}" for code, name in enumerate(STATUS_NAMES) if code in self.status
        ]
        lines = [f"{len(self)} trajectories to t = {self.t[-1]:g}: {', '.join(counts)}"]
        failed_indices = np.flatnonzero(~self.ok)
        lines += [f"  {STATUS_NAMES[self.status[i]]}: {self.message(i)}" for i in failed_indices[:5]]
        lines += [f"  and {len(failed_indices) - 5} more"] if len(failed_indices) > 5 else []
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        counts = [(STATUS_NAMES[code], str(int((self.status == code).sum()))) for code in np.unique(self.status)]
        drift = f"largest relative energy drift {np.max(self.energy_drift, initial=0.0):.1e}"
        return html_grid((f"{len(self)} trajectories to t = {self.t[-1]:g}", ""), counts, drift)

    @with_library_settings
    def audit(
        self, energy: float = Tolerances.energy, entropy: float = Tolerances.entropy, **tolerances: float
    ) -> Audit:
        """Audit the laws of energy and entropy at every step of every trajectory; each row shows the worst trajectory.

        Steps are examined along at most 32 trajectories (with adaptive steps, the first of each). Conserved
        functions, and conditions such as the positivity of density matrices, are evaluated at the saved states of these
        trajectories. If not all steps were checked, the verdict says how many. InputError if the name of a tolerance is
        unknown, or a tolerance is negative.

        Parameters
        ----------
        energy, entropy, casimirs, residual, accuracy, consistency : float
            Tolerances: see :class:`liethermo.results.audit.Tolerances`.
        """
        limits = Tolerances.with_defaults(energy=energy, entropy=entropy, **tolerances)
        has_stepped, drifts = self.steps > 0, self.evidence.drifts
        checks = check_laws(self, self.laws, limits, self.evidence.terms, self.entropy is not None)
        worst_trajectories = [(check, int(np.argmax(check.excess))) for check in checks]
        *rows, residual_row = (check.audit_row(i, f"worst is trajectory {i}") for check, i in worst_trajectories)
        rows += [invariant_drift_row(name, drift, limits) for name, drift in drifts.items()]
        rows += [residual_row, *condition_rows(self.evidence)]
        if self.evidence_source is not None or self.evidence.local_error is not None:
            rows += accuracy_and_consistency_rows(self.evidence, limits)
        n_failed = int((~self.ok & (self.status != StatusCode.INTERRUPTED)).sum())
        rows.append(AuditRow(FAILED_TRAJECTORIES_ROW, n_failed, 0, n_failed == 0))
        min_entropy_increment = (
            np.nan if self.entropy is None else float(self.least_entropy_increment.min(initial=0.0, where=has_stepped))
        )
        drift, residual = (float(a.max(initial=0.0, where=has_stepped)) for a in (self.energy_drift, self.residual))
        coverage = coverage_text(self.evidence, int(self.steps.sum()))
        casimir_drift = max((drift.change for drift in drifts.values()), default=np.nan)
        return Audit(drift, min_entropy_increment, casimir_drift, residual, tuple(rows), coverage)

    # -- files --------------------------------------------------------------------------------------------------------

    def to_xarray(self, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Return an ``xarray.Dataset`` with coordinates ``trajectory`` and ``time``; all else is in attributes (JSON).

        ``status_text`` and ``message`` describe the end of every trajectory. Each variable has a long name; those of
        energy and entropy state the law that they obey.

        Parameters
        ----------
        units : dict of str, optional
            Units by the name of a variable, such as ``{"time": "s", "energy": "J"}``: the library cannot know yours.

        Raises
        ------
        InputError
            If there is no variable of this name.
        """
        has_time_series = self.energy.ndim == 2
        series_dims = ("trajectory", "time") if has_time_series else ("trajectory",)
        variables: dict[str, Any] = {
            name: (series_dims if name in TIME_SERIES_FIELDS else ("trajectory",), value)
            for name in (*TIME_SERIES_FIELDS, *PER_MEMBER_FIELDS)
            if (value := getattr(self, name)) is not None
        }
        for name, dims in (("x", series_dims), ("x0", ("trajectory",))):
            if (value := getattr(self, name)) is not None:
                variables[name] = ((*dims, *state_axis_names(value.ndim - len(dims))), value)
        for name, dims in (("attitude", series_dims), ("attitude0", ("trajectory",))):
            if (value := getattr(self, name)) is not None:
                variables[name] = ((*dims, "row", "column", "part"), split_complex(value))
        variables |= orientation_and_velocity_variables(self, series_dims)
        variables |= self.events.dataset_variables()
        variables["status_text"] = ("trajectory", np.array([STATUS_NAMES[code] for code in self.status], dtype=object))
        is_failed = ~self.ok
        messages = [self.message(i) if is_failed[i] else "" for i in range(len(self))]
        variables["message"] = ("trajectory", np.array(messages, dtype=object))
        attributes = {
            "format": ENSEMBLE_FORMAT,
            "times": len(self.t),
            "laws": json.dumps(asdict(self.laws)),
            "evidence": json.dumps(asdict(self.evidence)),
            "provenance": json.dumps(self.provenance),
            "engine": self.engine,
            "wall_time": self.wall_time,
            "reasons": json.dumps({str(i): text for i, text in self.reasons.items()}),
        }
        coordinates = {"time": self.t, "trajectory": np.arange(len(self))}
        return build_dataset(variables, coordinates, attributes, self.laws, units)

    @classmethod
    def from_file(cls, series: dict[str, np.ndarray], attributes: dict[str, Any]) -> Ensemble:
        """Build an ensemble from arrays and attributes of a file: see :func:`.netcdf.read_variables_and_attributes`.

        KeyError, TypeError or ValueError if a part is missing or does not fit.
        """
        if len(series["time"]) != int(attributes["times"]):
            raise ValueError(f"it has {len(series['time'])} times, and {attributes['times']} were written")
        n_trajectories, n_times = len(series["x0"]), len(numeric_array_of_shape(series, "time", (None,)))
        per_member = {name: numeric_array_of_shape(series, name, (n_trajectories,)) for name in PER_MEMBER_FIELDS}
        time_series = {
            name: numeric_array_of_shape(series, name, (n_trajectories,), (n_trajectories, n_times))
            for name in TIME_SERIES_FIELDS
            if name in series
        }
        states = {name: series[name] for name in ("x0", "x", "attitude0", "attitude") if name in series}
        for name in states:
            numeric_array_of_shape(series, name, (n_trajectories, *[None] * max(series[name].ndim - 1, 1)))
        for name in ("attitude", "attitude0"):
            if name in states:
                states[name] = join_complex(states[name])
        reasons, provenance = (json.loads(attributes[name]) for name in ("reasons", "provenance"))
        if not isinstance(reasons, dict) or not isinstance(provenance, dict):
            raise ValueError("its attributes reasons and provenance are not JSON objects")
        if not ((per_member["status"] >= 0) & (per_member["status"] < len(STATUS_NAMES))).all():
            raise ValueError(f"its status has an unknown code: {int(per_member['status'].max())}")
        evidence = dataclass_from_json(Evidence, json.loads(attributes["evidence"]))
        return cls(
            t=series["time"],
            **dict.fromkeys(("x", "entropy", "work")) | per_member | time_series | states,  # type: ignore[arg-type]
            laws=dataclass_from_json(Laws, json.loads(attributes["laws"])),
            engine=str(attributes["engine"]),
            wall_time=float(attributes["wall_time"]),
            reasons={int(i): str(text) for i, text in reasons.items()},
            provenance=provenance,
            events=Events.from_dataset(series),
            evidence_source=lambda: evidence,
            velocity_sources=velocity_copy_functions(series),
        )


TIME_SERIES_FIELDS = ("energy", "entropy", "work")
"""Fields with a value at each saved time."""

PER_MEMBER_FIELDS = tuple(
    "status steps residual energy_drift largest_energy_increment least_entropy_increment entropy_scale "
    "energy_sensitivity entropy_sensitivity first_energy entropy_change relaxation_time iterations smallest_energy "
    "largest_energy end_time rejected".split()
)
"""Fields with one value for each trajectory."""
