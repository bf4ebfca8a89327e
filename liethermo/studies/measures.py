"""Measures: the results that a study keeps of each point."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError
from ..results.ensemble import Ensemble
from ..runs.events import Relaxed
from ..tracing.short_form import qualified_name
from .axes import is_valid_name

NAMED_MEASURES = {
    "final": "state at the end",
    "final_attitude": "attitude at the end",
    "final_energy": "energy at the end",
    "final_entropy": "entropy at the end",
    "end_time": "time reached",
    "relaxation_time": "time constant of the relaxation",
    "energy_drift": "largest relative drift of the energy",
    "entropy_change": "entropy at the end less that at the start",
    "least_entropy_increment": "least increment of the entropy in one step",
    "work": "work done from outside",
    "steps": "steps taken",
    "iterations": "iterations of the solver",
}
"""Built-in measures by name, each with its description."""


@dataclass(frozen=True)
class At:
    """The measure of values at given times; steps are shortened to end there.

    Parameters
    ----------
    times : array, shape (times,)
        Increasing, within the span.
    what : {"x", "energy", "entropy", "attitude"}
        The quantity that is measured.
    """

    times: Any
    what: str = "x"

    def __post_init__(self):
        times = np.asarray(self.times, dtype=np.float64)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
            raise InputError(f"the times of lt.At must be finite and increasing, got {self.times!r:.80}")
        if self.what not in ("x", "energy", "entropy", "attitude"):
            raise InputError(f"what must be x, energy, entropy or attitude, got {self.what!r}")
        object.__setattr__(self, "times", tuple(times.tolist()))


class Measure(ABC):
    """Base class of the measures of a study.

    Attributes
    ----------
    needs_path : bool
        True if the measure needs the states along the run.
    """

    needs_path: ClassVar[bool] = False

    @property
    def needs_final_state(self) -> bool:
        """True if the measure needs the final state."""
        return False

    @abstractmethod
    def __call__(self, ensemble: Ensemble, n_points: int) -> tuple[np.ndarray, dict[int, str]]:
        """Return the values of the measure for at least the first ``n_points`` trajectories, and an error message for
        each failed trajectory, by index."""

    @abstractmethod
    def description(self) -> str:
        """Return a text that identifies the measure."""


@dataclass(frozen=True)
class EnsembleField(Measure):
    """A measure that reads a field of the ensemble."""

    name: str

    @property
    def needs_final_state(self) -> bool:
        return self.name in ("final", "final_attitude")

    def __call__(self, ensemble: Ensemble, n_points: int) -> tuple[np.ndarray, dict[int, str]]:
        field = {"final": "x"}.get(self.name, self.name.removeprefix("final_"))
        values = getattr(ensemble, field)
        if values is None:
            raise InputError(
                f"the measure {self.name!r} needs {field}, which the system does not have. Leave it out of measures="
            )
        return _final_values(values, ensemble) if self.name.startswith("final") or self.name == "work" else values, {}

    def description(self) -> str:
        return NAMED_MEASURES[self.name]


def _final_values(values: np.ndarray, ensemble: Ensemble) -> np.ndarray:
    """Select from the saved values of an ensemble those at the last saved time of each trajectory."""
    if ensemble.energy.ndim == 1:
        return values
    last_index = np.maximum(np.isfinite(ensemble.energy).sum(axis=1) - 1, 0)
    return values[np.arange(len(values)), last_index]


@dataclass(frozen=True)
class EventTime(Measure):
    """A measure of the time of the study's event; NaN if the event did not occur."""

    event: str

    def __call__(self, ensemble: Ensemble, n_points: int) -> tuple[np.ndarray, dict[int, str]]:
        return ensemble.event_time, {}

    def description(self) -> str:
        return f"time of {self.event}"


@dataclass(frozen=True)
class ValuesAtTimes(Measure):
    """A measure of values at given times."""

    at: At

    needs_path = True

    def __call__(self, ensemble: Ensemble, n_points: int) -> tuple[np.ndarray, dict[int, str]]:
        values = getattr(ensemble, self.at.what)
        if values is None:
            raise InputError(f"this system has no {self.at.what}")
        indices = [int(np.argmin(np.abs(ensemble.t - t))) for t in self.at.times]
        return values[:, indices], {}

    def description(self) -> str:
        return f"{self.at.what} at {list(self.at.times)}"


@dataclass(frozen=True)
class SolutionMeasure(Measure):
    """A measure computed by a user's function of a :class:`Solution`.

    Attributes
    ----------
    function : function
        Returns a number, or an array of a fixed shape.
    example_value : ndarray, optional
        The value at the example point. A value of another shape, or complex where this is real, is a failure.
    """

    function: Callable
    example_value: np.ndarray | None = field(default=None, compare=False)

    needs_path = True

    def __call__(self, ensemble: Ensemble, n_points: int) -> tuple[np.ndarray, dict[int, str]]:
        values_by_index: dict[int, np.ndarray] = {}
        failure_messages: dict[int, str] = {}
        example_value = self.example_value
        for i in range(n_points):
            try:
                value = np.asarray(self.function(ensemble.member_solution(i)))
                if value.dtype.kind not in "fiubc":
                    raise TypeError(f"it returned {value.dtype}, not numbers")
                example_value = value if example_value is None else example_value
                if value.shape != example_value.shape or (value.dtype.kind == "c") > (example_value.dtype.kind == "c"):
                    raise TypeError(
                        f"it returned {_describe_array(value)}, but {_describe_array(example_value)} at the first point"
                    )
                values_by_index[i] = value
            except Exception as error:  # user code; its error becomes the status of this point
                failure_messages[i] = f"{self._function_name} raised {type(error).__name__}: {error}"
        example_value = np.asarray(np.nan) if example_value is None else example_value
        values = np.full((len(ensemble), *example_value.shape), np.nan, dtype=np.result_type(np.float64, example_value))
        for i, value in values_by_index.items():
            values[i] = value
        return values, failure_messages

    @property
    def _function_name(self) -> str:
        return qualified_name(self.function)

    def description(self) -> str:
        return f"function {self._function_name}"


def _describe_array(value: np.ndarray) -> str:
    """Return the shape of an array, and whether it is real or complex, as text."""
    return f"{'complex' if value.dtype.kind == 'c' else 'real'} numbers of shape {value.shape}"


def parse_measures_and_event(specification: Mapping[str, Any], until: Any) -> tuple[dict[str, Measure], Any]:
    """Return the :class:`Measure` objects of a study by name, and the event that ends its runs.

    Raises
    ------
    InputError
        If a measure is invalid, or two of them end the runs at different events.
    """
    if not isinstance(specification, Mapping) or not specification:
        raise InputError(
            'measure must be a dict such as {"final": "final", "relaxed": lt.Relaxed(1e-8)}, '
            f"got {specification!r:.60}"
        )
    measures: dict[str, Measure] = {}
    for name, measure in specification.items():
        if isinstance(measure, Relaxed):
            if until is not None and until != measure:
                raise InputError(f"the measure {name!r} ends each run at {measure}, but {until!r} is to end it too")
            until = measure
    for name, measure in specification.items():
        if not is_valid_name(name):
            raise InputError(f"a measure cannot be called {name!r:.120}")
        if isinstance(measure, Relaxed):
            measures[name] = EventTime(f"relaxation, to a rate below {measure.tol:g}")
        elif isinstance(measure, At):
            measures[name] = ValuesAtTimes(measure)
        elif isinstance(measure, str) and measure in NAMED_MEASURES:
            measures[name] = EnsembleField(measure)
        elif measure == "event_time" and until is not None:
            measures[name] = EventTime("the event")
        elif callable(measure):
            measures[name] = SolutionMeasure(measure)
        else:
            raise InputError(
                f"the measure {name!r} must be lt.Relaxed(tol), lt.At(times), a function of a solution, or one of "
                f"{', '.join(NAMED_MEASURES)}"
                + (", event_time" if until is not None else "")
                + f", got {measure!r:.60}"
            )
    return measures, until
