"""Events of a run: for each event function the times and the states at which they happened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .netcdf import numeric_array_of_shape, state_axis_names


class EventSeries(NamedTuple):
    """Events of one event function, in the order of their trajectories and times.

    Attributes
    ----------
    name : str
    t : ndarray, shape (events,)
        Times.
    x : ndarray, shape (events, n)
        States at these times, in the form of ``solution.x``.
    trajectory : ndarray of int, shape (events,)
        Numbers of the trajectories of an ensemble; zeros for a single run.
    """

    name: str
    t: np.ndarray
    x: np.ndarray
    trajectory: np.ndarray

    def select(self, is_selected: np.ndarray) -> EventSeries:
        """Return the events for which the mask ``is_selected``, shape (events,), is True."""
        return EventSeries(self.name, self.t[is_selected], self.x[is_selected], self.trajectory[is_selected])


class Events(tuple[EventSeries, ...]):
    """Events of a run: ``events[k]`` are those of event function k, with times ``t`` and states ``x``."""

    __slots__ = ()

    @property
    def times(self) -> list[np.ndarray]:
        """The times of each event function."""
        return [series.t for series in self]

    @property
    def states(self) -> list[np.ndarray]:
        """The states of each event function."""
        return [series.x for series in self]

    def select_trajectory(self, i: int) -> Events:
        """Return the events of trajectory i of an ensemble, as events of a single run."""
        return Events(
            series.select(series.trajectory == i)._replace(
                trajectory=np.zeros((series.trajectory == i).sum(), dtype=int)
            )
            for series in self
        )

    # -- files --------------------------------------------------------------------------------------------------------

    def dataset_variables(self) -> dict[str, Any]:
        """Return the variables of an ``xarray.Dataset`` that hold the events; {} without event functions."""
        if not self:
            return {}
        counts, x = [len(series.t) for series in self], np.concatenate(self.states)
        return {
            "event_name": ("event_kind", np.array([series.name for series in self], dtype=object)),
            "event_function": ("event", np.repeat(np.arange(len(self)), counts)),
            "event_trajectory": ("event", np.concatenate([series.trajectory for series in self])),
            "event_t": ("event", np.concatenate(self.times)),
            "event_x": (("event", *state_axis_names(x.ndim - 1)), x),
        }

    @classmethod
    def from_dataset(cls, variables: Mapping[str, np.ndarray]) -> Events:
        """Return the events stored in the variables of a file; KeyError or ValueError if a variable does not fit."""
        if "event_name" not in variables:
            return cls()
        t = numeric_array_of_shape(variables, "event_t", (None,))
        function, trajectory = (
            numeric_array_of_shape(variables, f"event_{name}", (len(t),)) for name in ("function", "trajectory")
        )
        x = numeric_array_of_shape(variables, "event_x", (len(t), *[None] * (variables["event_x"].ndim - 1)))
        return cls(
            EventSeries(str(name), t[function == k], x[function == k], trajectory[function == k].astype(int))
            for k, name in enumerate(variables["event_name"])
        )
