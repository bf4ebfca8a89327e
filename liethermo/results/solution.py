"""Result of a run: the trajectory, also between the ends of its steps, its laws, its status and its provenance."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from manifolds._precision import with_library_settings
from manifolds._tables import html_grid

from ..errors import ConvergenceError, InputError
from .audit import Audit, Tolerances, audit_run
from .audit_evidence import AuditableResult, Evidence, velocity_copy_functions
from .events import Events
from .netcdf import (
    SOLUTION_FORMAT,
    build_dataset,
    dataclass_from_json,
    join_complex,
    numeric_array_of_shape,
    split_complex,
    state_axis_names,
)
from .orientation import orientation_and_velocity_variables
from .status import Laws, Stats, Status


def _identity(x: np.ndarray) -> np.ndarray:
    return x


@dataclass(frozen=True)
class DenseOutput:
    """Dense output ``x(t)``: the end of a step of the method that begins at the last state before t.

    Such states have the order of the method and obey its laws: the energy and the invariants equal those of the state
    at which the step begins, and the entropy is not smaller.

    Attributes
    ----------
    t : ndarray, shape (steps + 1,)
        Times at which the steps of the run begin, and the end of the last.
    x : ndarray, shape (steps + 1, n)
        States at these times.
    step_ends : function from states, shape (m, n), and step sizes, shape (m,), to states
        Returns NaN for a step that fails.
    to_user_state : function from states, shape (m, n), to states
        Converts internal states to the user's form.
    """

    t: np.ndarray
    x: np.ndarray
    step_ends: Callable[[np.ndarray, np.ndarray], np.ndarray]
    to_user_state: Callable[[np.ndarray], np.ndarray] = _identity

    def __call__(self, t) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        start, end = self.t[0], self.t[-1]
        slack = 1e-12 * (end - start)
        if not np.all((t >= start - slack) & (t <= end + slack)):
            raise InputError(f"t must be from {start:g} to {end:g}, the span of the solution, got {t}")
        times = np.clip(t.ravel(), start, end)
        i = np.searchsorted(self.t, times, side="right") - 1
        h, x = times - self.t[i], self.x[i]
        inside_steps = np.flatnonzero(h > 0.0)
        if inside_steps.size:
            x[inside_steps] = self.step_ends(x[inside_steps], h[inside_steps])
            self._raise_if_unsolved(times[inside_steps], x[inside_steps])
        x = self.to_user_state(x)
        return x.reshape(*t.shape, x.shape[-1])

    def _raise_if_unsolved(self, times: np.ndarray, states: np.ndarray) -> None:
        """Raise ConvergenceError if a partial step failed and its state is NaN."""
        is_unknown = np.isnan(states).any(axis=1)
        if is_unknown.any():
            raise ConvergenceError(
                f"the state at t = {times[is_unknown][0]:g}, between two steps, cannot be found: the equations of a "
                "partial step were not solved. Evaluate the solution at the ends of the steps, or take smaller steps",
                None,
            )

    def with_output_map(self, output_map: Callable[[np.ndarray], np.ndarray]) -> DenseOutput:
        """Return a dense output that applies ``output_map`` to the states which this one returns."""
        previous_map = self.to_user_state
        return replace(self, to_user_state=lambda x: np.asarray(output_map(previous_map(x))))


MAX_POINTS = 400
"""Largest number of points of a curve; longer series are thinned."""

MAX_CURVES = 8
"""Largest number of curves, which is the number of colours."""

SKETCH_SIZE = (280, 110)
"""Width and height of a sketch in pixels."""

CURVE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#999999", "#F0E442")
"""Colours of the curves, which colour-blind readers can tell apart [Okabe & Ito 2008]."""


def svg_sketch(t: np.ndarray, series: np.ndarray, label: str) -> str:
    """Return an SVG picture of curves over time in one frame, with a common scale.

    Parameters
    ----------
    t : ndarray, shape (times,)
    series : ndarray, shape (times, curves)
        Only the first eight curves are drawn.
    label : str
        Description of the picture, in words.

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    width, height = SKETCH_SIZE
    indices = np.unique(np.linspace(0, len(t) - 1, min(len(t), MAX_POINTS)).round().astype(int))
    t, series = t[indices], series[indices, :MAX_CURVES]
    finite_values = series[np.isfinite(series)]
    lowest_value, highest_value = (finite_values.min(), finite_values.max()) if finite_values.size else (0.0, 1.0)
    value_range = (highest_value - lowest_value) or 1.0
    x_pixels = 4 + (width - 8) * (t - t[0]) / ((t[-1] - t[0]) or 1.0)
    y_pixels = height - 4 - (height - 8) * (series - lowest_value) / value_range
    curves = "".join(
        f'<polyline fill="none" stroke="{colour}" stroke-width="1.3" points="'
        + " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(x_pixels, column, strict=True) if np.isfinite(y))
        + '"/>'
        for colour, column in zip(CURVE_COLOURS, y_pixels.T, strict=False)
    )
    frame = f'<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1}" fill="none" stroke="#888"/>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'role="img" aria-label="{label}">{frame}{curves}</svg>'
    )


if TYPE_CHECKING:
    import xarray


Class = TypeVar("Class", bound=type)


@dataclass(frozen=True, eq=False)
class DeferredValue:
    """Function without arguments that computes the value of a deferred field when the field is first read.

    Attributes
    ----------
    function : function without arguments
        Returns the value; it is called once.
    """

    function: Callable[[], Any]


def defer(function: Callable[[], Any]) -> Any:
    """Return a value for a deferred field, which calls ``function()`` when the field is first read."""
    return DeferredValue(function)


class _DeferredField:
    """Descriptor of a field that computes a :class:`DeferredValue` when it is first read."""

    def __init__(self, name: str):
        self._name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        value = vars(instance)[self._name]
        if isinstance(value, DeferredValue):
            value = vars(instance)[self._name] = value.function()
        return value

    def __set__(self, instance: Any, value: Any) -> None:
        vars(instance)[self._name] = value


def with_deferred_fields(*names: str) -> Callable[[Class], Class]:
    """Return a class decorator that lets the named fields hold values of :func:`defer`, computed when first read."""

    def add_descriptors(cls: Class) -> Class:
        for name in names:
            setattr(cls, name, _DeferredField(name))
        return cls

    return add_descriptors


@with_deferred_fields("casimirs", "provenance")
@dataclass(frozen=True)
class Solution(AuditableResult):
    """The result of a run: times, states, energy, entropy and conserved quantities.

    Attributes
    ----------
    t : ndarray, shape (times,)
        Times of the saved states.
    x : ndarray, shape (times, n), or ``(times, *sites, d)`` of a system on sites
        Saved states.
    energy : ndarray, shape (times,)
        Energy at these times, with that of the baths.
    entropy : ndarray, shape (times,), or None
        Entropy at these times; None for a system without one.
    casimirs : dict of ndarray, shape (times,)
        Casimirs, momentum maps and preserved functions along the run, by name.
    status, stats, laws : Status, Stats, Laws
        How the run ended, the numbers of steps and iterations, and the laws that the audit checks.
    provenance : dict
        Library version, method, step, system, date, spec: JSON data.
    event_time : float or None
        Time of the event of ``integrate(until=...)``.
    events : Events
        The events of each function of ``until``: ``solution.events[k]`` has times ``t`` and states ``x``.
    dense : DenseOutput or None
        The states between the steps (``integrate(dense=True)``); not written to files.
    attitude : ndarray, shape (times, m, m), or None
        Elements of the group of the system, if it has one.
    evidence : Evidence
        The data that an audit needs besides the series: computed at its first use, and saved in files.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> solution = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 5.0), 0.1)
    >>> solution.t.shape, solution.x.shape, solution.status.code
    ((51,), (51, 3), 'completed')
    >>> solution.to_xarray()["x"].dims
    ('time', 'component')
    """

    t: np.ndarray
    x: np.ndarray
    energy: np.ndarray
    entropy: np.ndarray | None
    casimirs: dict[str, np.ndarray]
    status: Status
    stats: Stats
    laws: Laws
    provenance: dict[str, Any] = field(default_factory=dict)
    event_time: float | None = None
    events: Events = field(default_factory=Events)
    dense: DenseOutput | None = None
    attitude: np.ndarray | None = None
    evidence_source: Callable[[], Evidence] | None = field(default=None, repr=False, compare=False)
    velocity_sources: Mapping[str, Callable[[], np.ndarray]] = field(default_factory=dict, repr=False, compare=False)

    @with_library_settings
    def __call__(self, t) -> np.ndarray:
        """Return the states at times t, shape (..., n), each by a step from the last state before its time.

        These states have the order of the method and obey its laws.

        Raises
        ------
        InputError
            Unless the run was made with ``dense=True`` and covers the times.
        """
        if self.dense is None:
            raise InputError("this solution has no dense output. Run integrate(..., dense=True)")
        states = self.dense(t)
        return states.reshape(*states.shape[:-1], *self.x.shape[1:])

    @property
    def energy_balance(self) -> np.ndarray:
        """The energy less the work done from outside, shape (times,); driven systems conserve it."""
        return self.energy - sum(self.casimirs[name] for name in self.laws.balance)

    @with_library_settings
    def audit(self, **tolerances: float) -> Audit:
        """Audit the run: judge whether the laws held and the steps resolve the motion, as a table.

        The first call examines the steps: all of them in runs of ordinary length, otherwise those where the motion is
        fastest, and the verdict then says how many. It computes the worst of them again. InputError if the name of a
        tolerance is unknown, or a tolerance is negative.

        Parameters
        ----------
        energy, entropy, casimirs, residual, attitude, accuracy, consistency : float
            Tolerance of each, relative (dimensionless): see :class:`liethermo.results.audit.Tolerances`.

        Examples
        --------
        >>> body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.1)
        >>> audit = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1).audit()
        >>> audit.passed, bool(audit.energy_drift < 1e-13)
        (True, True)
        """
        return audit_run(self, Tolerances.with_defaults(**tolerances))

    def with_provenance(self, **entries) -> Solution:
        """Return this solution with more entries in its provenance."""
        return replace(self, provenance={**self.provenance, **entries})

    def to_xarray(self, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Return an ``xarray.Dataset`` with coordinate ``time`` and all series; the rest is in attributes (JSON).

        Each variable has a long name; those of energy and entropy state the law that they obey. A body with
        attitudes has its ``quaternion``, ``nutation``, ``precession`` and ``spin`` too [:mod:`liethermo.bodies`], and
        every rigid body its ``angular_velocity`` in body axes; the attribute ``comment`` states the convention.

        Parameters
        ----------
        units : dict of str, optional
            Units by the name of a variable, such as ``{"time": "s", "energy": "J"}``: the library cannot know yours.

        Raises
        ------
        InputError
            If there is no variable of this name.
        """
        series = {"energy": ("time", self.energy)}
        if self.entropy is not None:
            series["entropy"] = ("time", self.entropy)
        variables: dict[str, Any] = {"x": (("time", *state_axis_names(self.x.ndim - 1)), self.x), **series}
        if self.attitude is not None:
            variables["attitude"] = (("time", "row", "column", "part"), split_complex(self.attitude))
        variables |= orientation_and_velocity_variables(self, ("time",))
        variables["invariant"] = (
            ("invariant_name", "time"),
            np.array(list(self.casimirs.values())).reshape(len(self.casimirs), len(self.t)),
        )
        variables |= self.events.dataset_variables()
        coordinates = {"time": self.t, "invariant_name": np.array(list(self.casimirs), dtype=object)}
        attributes = {
            "format": SOLUTION_FORMAT,
            "times": len(self.t),
            "status": json.dumps(asdict(self.status)),
            "stats": json.dumps(asdict(self.stats)),
            "laws": json.dumps(asdict(self.laws)),
            "evidence": json.dumps(asdict(self.evidence)),
            "provenance": json.dumps(self.provenance),
            "event_time": json.dumps(self.event_time),
        }
        return build_dataset(variables, coordinates, attributes, self.laws, units)

    def __repr__(self) -> str:
        return f"Solution({len(self.t)} times to t = {self.status.time:g}, {self.status.code})"

    def _repr_html_(self) -> str:
        """Return a summary for notebooks: how the run ended, with small pictures, and without a verdict on the laws."""
        facts = [
            ("system", str(self.provenance.get("system", "-"))),
            ("method", str(self.provenance.get("method", "-"))),
            ("status", str(self.status)),
            ("kept", f"{len(self.t)} times of {self.stats.steps} steps, states of {self.x[0].size} components"),
            ("energy", f"{self.energy[0]:.10g} to {self.energy[-1]:.10g}"),
        ]
        pictures = [svg_sketch(self.t, self.x.reshape(len(self.t), -1), "the components of the state along time")]
        if self.entropy is not None:
            facts.append(("entropy", f"{self.entropy[0]:.10g} to {self.entropy[-1]:.10g}"))
            pictures.append(svg_sketch(self.t, self.entropy[:, None], "the entropy along time"))
        return html_grid(("Solution", ""), facts) + "<div>" + " ".join(pictures) + "</div>"

    @classmethod
    def from_file(cls, series: dict[str, np.ndarray], attributes: dict[str, Any]) -> Solution:
        """Build a solution from the arrays and attributes of a file: see :func:`.netcdf.read_variables_and_attributes`.

        KeyError, TypeError or ValueError if a part is missing or does not fit.
        """
        json_data = {name: json.loads(attributes[name]) for name in ("status", "stats", "laws", "provenance")}
        t, x = numeric_array_of_shape(series, "time", (None,)), series["x"]
        if len(t) != int(attributes["times"]):
            raise ValueError(f"it has {len(t)} times, and {attributes['times']} were written")
        names = [str(name) for name in series["invariant_name"]]
        entropy = numeric_array_of_shape(series, "entropy", (len(t),)) if "entropy" in series else None
        attitude = None
        if "attitude" in series:
            m = series["attitude"].shape[1:2]
            attitude = join_complex(
                numeric_array_of_shape(series, "attitude", *((len(t), *m, *m, parts) for parts in (1, 2)))
            )
        event_time = json.loads(attributes.get("event_time", "null"))
        if not isinstance(event_time, int | float | None) or not isinstance(json_data["provenance"], dict):
            raise ValueError("its event_time is not a number, or its provenance is not a JSON object")
        evidence = dataclass_from_json(Evidence, json.loads(attributes.get("evidence", "{}")))
        return cls(
            t=t,
            x=numeric_array_of_shape(series, "x", (len(t), *[None] * max(x.ndim - 1, 1))),
            energy=numeric_array_of_shape(series, "energy", (len(t),)),
            entropy=entropy,
            casimirs=dict(zip(names, numeric_array_of_shape(series, "invariant", (len(names), len(t))), strict=True)),
            status=dataclass_from_json(Status, json_data["status"]),
            stats=dataclass_from_json(Stats, json_data["stats"]),
            laws=dataclass_from_json(Laws, json_data["laws"]),
            provenance=json_data["provenance"],
            event_time=event_time,
            events=Events.from_dataset(series),
            attitude=attitude,
            evidence_source=lambda: evidence,
            velocity_sources=velocity_copy_functions(series),
        )
