"""What is kept of every point of a study."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError
from ..results.ensemble import Ensemble
from ..runs.events import Relaxed
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
"""Measures that have a name of their own, and what they are."""


@dataclass(frozen=True)
class At:
    """The measure of values at given times: steps are made to end there.

    Parameters
    ----------
    times : array, shape (times,)
        Increasing, within the span.
    what : {"x", "energy", "entropy", "attitude"}
    """

    times: Any
    what: str = "x"

    def __post_init__(self):
        times = np.asarray(self.times, dtype=np.float64)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
            raise InputError(f"the times of a measure are finite and increase, and are not {self.times!r:.80}")
        if self.what not in ("x", "energy", "entropy", "attitude"):
            raise InputError(f"At keeps x, energy, entropy or attitude, not {self.what!r}")
        object.__setattr__(self, "times", tuple(times.tolist()))


class Measure(ABC):
    """One measure.

    Attributes
    ----------
    needs_path : bool
        Whether it needs the states along the run.
    """

    needs_path: ClassVar[bool] = False

    @property
    def needs_final_state(self) -> bool:
        """Whether it needs the last state."""
        return False

    @abstractmethod
    def __call__(self, ensemble: Ensemble, count: int) -> tuple[np.ndarray, dict[int, str]]:
        """Its values of at least the first ``count`` trajectories, and why it has none of some of them."""

    @abstractmethod
    def description(self) -> str:
        """What it is, in words that tell it from another."""


@dataclass(frozen=True)
class EnsembleField(Measure):
    """A field of an ensemble."""

    name: str

    @property
    def needs_final_state(self) -> bool:
        return self.name in ("final", "final_attitude")

    def __call__(self, ensemble: Ensemble, count: int) -> tuple[np.ndarray, dict[int, str]]:
        field = {"final": "x"}.get(self.name, self.name.removeprefix("final_"))
        values = getattr(ensemble, field)
        if values is None:
            raise InputError(f"this system has no {field}, so that {self.name!r} is no measure of it")
        return _final_values(values, ensemble) if self.name.startswith("final") or self.name == "work" else values, {}

    def description(self) -> str:
        return NAMED_MEASURES[self.name]


def _final_values(values: np.ndarray, ensemble: Ensemble) -> np.ndarray:
    """The values where each trajectory ended."""
    if ensemble.energy.ndim == 1:
        return values
    last = np.maximum(np.isfinite(ensemble.energy).sum(axis=1) - 1, 0)
    return values[np.arange(len(values)), last]


@dataclass(frozen=True)
class EventTime(Measure):
    """When the event of the study happened; NaN where it did not."""

    event: str

    def __call__(self, ensemble: Ensemble, count: int) -> tuple[np.ndarray, dict[int, str]]:
        return ensemble.event_time, {}

    def description(self) -> str:
        return f"time of {self.event}"


@dataclass(frozen=True)
class ValuesAtTimes(Measure):
    """Values at given times."""

    at: At

    needs_path = True

    def __call__(self, ensemble: Ensemble, count: int) -> tuple[np.ndarray, dict[int, str]]:
        values = getattr(ensemble, self.at.what)
        if values is None:
            raise InputError(f"this system has no {self.at.what}")
        places = [int(np.argmin(np.abs(ensemble.t - t))) for t in self.at.times]
        return values[:, places], {}

    def description(self) -> str:
        return f"{self.at.what} at {list(self.at.times)}"


@dataclass(frozen=True)
class SolutionMeasure(Measure):
    """A user's function of a solution, to a number or an array of a fixed shape.

    Attributes
    ----------
    function : function
    example_value : ndarray, optional
        What it returned at the first point that was run: of this shape and kind it is at all others, or has failed.
    """

    function: Callable
    example_value: np.ndarray | None = field(default=None, compare=False)

    needs_path = True

    def __call__(self, ensemble: Ensemble, count: int) -> tuple[np.ndarray, dict[int, str]]:
        found: dict[int, np.ndarray] = {}
        reasons: dict[int, str] = {}
        like = self.example_value
        for i in range(count):
            try:
                value = np.asarray(self.function(ensemble.member_solution(i)))
                if value.dtype.kind not in "fiubc":
                    raise TypeError(f"it returned {value.dtype}, not numbers")
                like = value if like is None else like
                if value.shape != like.shape or (value.dtype.kind == "c") > (like.dtype.kind == "c"):
                    raise TypeError(
                        f"it returned {_describe_array(value)}, and {_describe_array(like)} at the first point"
                    )
                found[i] = value
            except Exception as error:  # the function may be anyone's, and this is the status of one point
                reasons[i] = f"{self._function_name} raised {type(error).__name__}: {error}"
        like = np.asarray(np.nan) if like is None else like
        values = np.full((len(ensemble), *like.shape), np.nan, dtype=np.result_type(np.float64, like))
        for i, value in found.items():
            values[i] = value
        return values, reasons

    @property
    def _function_name(self) -> str:
        return getattr(self.function, "__qualname__", type(self.function).__name__)

    def description(self) -> str:
        return f"function {self._function_name}"


def _describe_array(value: np.ndarray) -> str:
    return f"{'complex' if value.dtype.kind == 'c' else 'real'} numbers of shape {value.shape}"


def parse_measures(given: Mapping[str, Any], until: Any) -> tuple[dict[str, Measure], Any]:
    """The measures that :class:`Study` is given, by name, and the event at which its runs end.

    Raises
    ------
    InputError
        If one is none, or two of them want the runs to end at different events.
    """
    if not isinstance(given, Mapping) or not given:
        raise InputError(
            f'measure is a dict such as {{"final": "final", "relaxed": lt.Relaxed(1e-8)}}, not {given!r:.60}'
        )
    found: dict[str, Measure] = {}
    for name, measure in given.items():
        if isinstance(measure, Relaxed):
            if until is not None and until != measure:
                raise InputError(f"the measure {name!r} ends each run at {measure}, but {until!r} is to end it too")
            until = measure
    for name, measure in given.items():
        if not is_valid_name(name):
            raise InputError(f"a measure cannot be called {name!r:.120}")
        if isinstance(measure, Relaxed):
            found[name] = EventTime(f"relaxation, to a rate below {measure.tol:g}")
        elif isinstance(measure, At):
            found[name] = ValuesAtTimes(measure)
        elif isinstance(measure, str) and measure in NAMED_MEASURES:
            found[name] = EnsembleField(measure)
        elif measure == "event_time" and until is not None:
            found[name] = EventTime("the event")
        elif callable(measure):
            found[name] = SolutionMeasure(measure)
        else:
            raise InputError(
                f"the measure {name!r} is lt.Relaxed(tol), lt.At(times), a function of a solution, or one of "
                f"{', '.join(NAMED_MEASURES)}"
                + (", event_time" if until is not None else "")
                + f"; not {measure!r:.60}"
            )
    return found, until
