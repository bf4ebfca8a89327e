"""Functions of time and of a state and a time: their arguments, jumps and pieces, and the time span of a run."""

from __future__ import annotations

import functools
import inspect
import math
import sys
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its module of splines is loaded where one is used

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import InputError
from .conditions import checked_numbers, require_condition

BREAK_RTOL = 8.0 * float(np.finfo(np.float64).eps)
"""Largest rounding of the times of a run, relative to the largest: a step starts at a break if it starts so near."""


class TimeSpan(Module):
    """The start and end time of a run, infinite until a run sets them: see :func:`set_time_span`.

    The sum of the steps of a run may exceed the end of the span by a rounding error: 0.1 + 0.1 + 0.1 > 0.3. A table or
    a root that ends with the span is not defined there.

    Attributes
    ----------
    start, end : array, shape ()
    breaks : array, shape (m,)
        Times in the span at which functions of time jump; steps end there. It has shape (0,) if there are none.
    """

    start: jax.Array
    end: jax.Array
    breaks: jax.Array

    def __init__(self, start=-np.inf, end=np.inf, breaks=()):
        self.start, self.end, self.breaks = (_time_array(t) for t in (start, end, breaks))

    def interval_between_breaks_at(self, t) -> TimeSpan:
        """Return the interval between two breaks in which a step lies that starts at time t, shape ().

        The interval ends before a break, and starts after one, by the rounding error of the times. So a function
        that jumps at the break has one of its two limits there, whether it is defined with ``>=`` or with ``>``.
        """
        tolerance = self._break_tolerance
        is_past = self.breaks <= t + tolerance
        start = jnp.max(jnp.where(is_past, self.breaks + tolerance, self.start))
        end = jnp.min(jnp.where(is_past, self.end, self.breaks - tolerance))
        return TimeSpan(start, end)

    def starts_at_break(self, t) -> jax.Array:
        """Return whether a step that starts at time t, shape (), starts at a break."""
        return jnp.any(jnp.abs(self.breaks - t) <= self._break_tolerance)

    @property
    def _break_tolerance(self) -> jax.Array:
        """Distance up to which two times of the span count as equal."""
        largest_time = jnp.maximum(jnp.abs(self.start), jnp.max(jnp.abs(self.breaks)))
        return BREAK_RTOL * largest_time

    def clip(self, t) -> jax.Array:
        """Return the times t, shape (...), clipped to the span."""
        return _clip(t, self.start, self.end)


def _time_array(t) -> jax.Array:
    """Return times as a float64 array of concrete numbers, even during a trace; a tracer is returned unchanged."""
    if is_traced(t):
        return t
    with jax.ensure_compile_time_eval():  # a number, even where something else is traced
        return jnp.asarray(t, dtype=jnp.float64)


@jax.custom_jvp
def _clip(t, start, end) -> jax.Array:
    """Return times clipped to the interval from start to end."""
    return jnp.where(t > end, end, jnp.where(t < start, start, t))


@_clip.defjvp
def _clip_jvp(primals, tangents):
    """Return the clipped time and its tangent: the derivative by t is 1 outside too, where t lies by rounding."""
    return _clip(*primals), tangents[0]


def set_time_span(tree, start: float, end: float, *breaks: float):
    """Return a pytree, such as a system, whose functions of time get times that are clipped to a span.

    Parameters
    ----------
    tree : pytree
    start, end : float
    *breaks : float
        Times within the span at which functions of time jump.
    """
    times = jnp.stack([_time_array(t) for t in breaks]) if breaks else ()
    return replace_time_span(tree, TimeSpan(start, end, times))


def replace_time_span(tree, span: TimeSpan):
    """Return a pytree with each :class:`TimeSpan` in it replaced by another one."""

    def replace_span(node):
        return span if isinstance(node, TimeSpan) else node

    return jax.tree_util.tree_map(replace_span, tree, is_leaf=lambda node: isinstance(node, TimeSpan))


class FunctionWithBreaks(Module):
    """Base class of functions of time that are not smooth at known times, where the steps of a run end."""

    @property
    def break_times(self) -> tuple[float, ...]:
        """Times at which the function jumps."""
        return ()

    @property
    def kink_times(self) -> tuple[float, ...]:
        """Times at which a derivative of the function jumps, as far as they depend on no parameter."""
        return ()

    @property
    def known_span(self) -> tuple[float, float]:
        """First and last time at which the function is known; runs beyond them are refused."""
        return -math.inf, math.inf


class DeclaredTimes(NamedTuple):
    """Times at which functions of time in a pytree, such as a system, say that they are not smooth.

    Attributes
    ----------
    jumps, kinks : tuple of float
        Times at which a function, or one of its derivatives, jumps; in increasing order.
    known_span : tuple of two floats
        First and last time at which all functions are known.
    """

    jumps: tuple[float, ...]
    kinks: tuple[float, ...]
    known_span: tuple[float, float] = (-math.inf, math.inf)

    @classmethod
    def from_tree(cls, tree: Any) -> DeclaredTimes:
        """Return the times at which functions of time in a pytree declare to be not smooth."""
        leaves = jax.tree_util.tree_leaves(tree, is_leaf=lambda node: isinstance(node, FunctionWithBreaks))
        functions = [leaf for leaf in leaves if isinstance(leaf, FunctionWithBreaks)]
        jumps, kinks = {t for f in functions for t in f.break_times}, {t for f in functions for t in f.kink_times}
        starts, ends = zip((-math.inf, math.inf), *(f.known_span for f in functions), strict=True)
        return cls(tuple(sorted(jumps)), tuple(sorted(kinks)), (max(starts), min(ends)))


TIMES_OF_SMOOTH_FUNCTIONS = DeclaredTimes((), ())
"""The declared times of functions that are smooth."""


def checked_breaks(breaks) -> tuple[float, ...]:
    """Return the increasing times at which functions of time jump.

    Raises
    ------
    InputError
        Unless they are finite times that depend on no parameter.
    """
    try:
        times = np.asarray(breaks, dtype=np.float64)
    except jax.errors.TracerArrayConversionError as error:
        raise InputError(
            "the times at which a function jumps must be the same for all trajectories of an ensemble, because their "
            "steps end there; got times that depend on the parameters. Run each trajectory with lt.integrate"
        ) from error
    except (TypeError, ValueError):
        times = np.array(np.nan)
    if times.ndim != 1 or not np.isfinite(times).all():
        raise InputError(f"breaks must be a list of finite times, got {breaks!r:.60}")
    return tuple(np.unique(times).tolist())


def required_argument_count(function: Callable) -> int | None:
    """Return the number of positional arguments without a default; None if a function has no signature."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    return sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty for p in parameters)


class FixedTimeFunction(Module):
    """A function of the state and the time, at a fixed time."""

    function: Callable
    time: jax.Array

    def __call__(self, x):
        return self.function(x, self.time)


class StateTimeFunction(Module):
    """A function of the state and the time, as a function of the state with the time appended."""

    function: Callable

    def __call__(self, z):
        return self.function(z[:-1], z[-1])


class LastArgumentIgnored(Module):
    """A function called with one argument more, the last, which it ignores."""

    function: Callable

    def __call__(self, *arguments):
        return self.function(*arguments[:-1])


class ConstantFunction(Module):
    """A function that returns a constant for any arguments."""

    value: jax.Array

    def __call__(self, *arguments):
        return self.value


class NegatedFunction(Module):
    """The negative of a function of the state and the time."""

    function: Callable

    def __call__(self, x, t):
        return -jnp.asarray(self.function(x, t))


class MultipleFunction(Module):
    """A function of the state and the time, times a number."""

    function: Callable
    factor: jax.Array

    def __call__(self, x, t):
        return self.factor * jnp.asarray(self.function(x, t))


class CoordinatesWithTime(Module):
    """Coordinates of a state, with the time appended to the state and to the coordinates."""

    coordinates: Callable

    def __call__(self, z):
        return jnp.append(self.coordinates(z[:-1]), z[-1])


TableKind = Literal["linear", "cubic"]
"""Interpolation of a table: straight lines, or a cubic spline with two continuous derivatives."""


def is_spline(value: Any) -> bool:
    """Return whether a value is a spline of SciPy, a function of one number from which a table can be made."""
    if "scipy.interpolate" not in sys.modules:  # then there is none
        return False
    return isinstance(value, (*_spline_classes_with_axis(), scipy.interpolate.UnivariateSpline))


@functools.cache
def _spline_classes_with_axis() -> tuple[Any, ...]:
    """Return SciPy's classes of splines whose values may be arrays, with the times along any axis."""
    return scipy.interpolate.PPoly, scipy.interpolate.BPoly, scipy.interpolate.BSpline


class PiecewiseConstant(FunctionWithBreaks):
    """A function of time that is constant between given times and zero outside, such as a train of pulses.

    At a time where it jumps it has its value from after the jump. The steps of a run end at these times.

    Parameters
    ----------
    times : sequence of float, length m
        Increasing times of the jumps. They are not parameters of a system, because they decide where steps end.
    values : array, shape (m - 1, ...)
        The values between two of the times.

    Raises
    ------
    InputError
        If the times do not increase, or there is not one value for each interval.

    Examples
    --------
    >>> pulses = lt.PiecewiseConstant([2.0, 2.5, 7.0], [1.0, -1.0])
    >>> [float(pulses(t)) for t in (1.0, 2.0, 3.0, 7.0)]
    [0.0, 1.0, -1.0, 0.0]
    """

    times: tuple[float, ...] = eqx.field(static=True)
    values: jax.Array

    def __init__(self, times, values):
        self.times, self.values = checked_breaks(times), checked_numbers(values, "values")
        if self.times != tuple(np.asarray(times, dtype=np.float64)):
            raise InputError("the times of PiecewiseConstant must increase. Merge pulses that begin or end together")
        if self.values.shape[:1] != (len(self.times) - 1,):
            raise InputError(
                f"PiecewiseConstant with {len(self.times)} times needs {len(self.times) - 1} values, one for each "
                f"interval, got values of shape {self.values.shape}. Outside of these times it is zero"
            )

    @classmethod
    def from_pulses(cls, starts, ends, values) -> PiecewiseConstant:
        """Return the sum of rectangular pulses, which may overlap, such as the firings of thrusters.

        Parameters
        ----------
        starts, ends : sequence of float, length m
            Times at which each pulse starts and ends.
        values : array, shape (m, ...)
            The value of each pulse between these times.

        Raises
        ------
        InputError
            If a pulse does not end after its start, or the lengths differ.

        Examples
        --------
        >>> levels = lt.PiecewiseConstant.from_pulses([1.0, 2.0], [3.0, 4.0], [0.5, 1.0])
        >>> [float(levels(t)) for t in (0.0, 1.5, 2.5, 3.5, 4.5)]
        [0.0, 0.5, 1.5, 1.0, 0.0]
        """
        begins, finishes = checked_numbers(starts, "starts"), checked_numbers(ends, "ends")
        heights = checked_numbers(values, "values")
        if begins.ndim != 1 or begins.shape != finishes.shape or heights.shape[:1] != begins.shape:
            raise InputError(
                f"from_pulses needs one start, one end and one value for each pulse, got the shapes {begins.shape}, "
                f"{finishes.shape} and {heights.shape}"
            )
        times = np.array(checked_breaks(np.concatenate([begins, finishes])))
        if not bool(np.all(np.asarray(finishes) > np.asarray(begins))):
            raise InputError("each pulse must end after its start")
        is_on = (np.asarray(begins)[:, None] <= times[:-1]) & (times[:-1] < np.asarray(finishes)[:, None])
        return cls(times, jnp.tensordot(is_on.T.astype(float), heights, 1))

    @property
    def break_times(self) -> tuple[float, ...]:
        return self.times

    def __call__(self, t) -> jax.Array:
        if not self.values.shape[0]:
            return jnp.zeros(self.values.shape[1:])
        value = jnp.asarray(self.values)[interval_index(jnp.asarray(self.times), t)]
        return jnp.where((t >= self.times[0]) & (t < self.times[-1]), value, jnp.zeros_like(value))


class Table(FunctionWithBreaks):
    """A function of time from a table; zero before the first time and after the last.

    The interval that contains t is found by bisection, so that the time for a value and for the first answer of a run
    grows with the logarithm of the length of the table. The numbers are parameters. The steps of a run end at the times
    of a table joined by straight lines, and at the ends of others. They do not if the span has more than 1,000 of them,
    or more than steps of a given size.

    Parameters
    ----------
    times : array, shape (m,), or a spline of SciPy
        Increasing times (time), at least two. From a spline (``CubicSpline``, ``PchipInterpolator``,
        ``Akima1DInterpolator``, ``PPoly``, ``BPoly``, ``BSpline``, ``UnivariateSpline``) its polynomials are taken, and
        its values outside of its interval are not: a table is zero there.
    values : array, shape (m, ...), optional
        Values at these times; not with a spline.
    kind : {"linear", "cubic"}
        Interpolation of the values: linear, or ``scipy.interpolate.CubicSpline`` with its default ends.
    name : str
        Name of the values in messages.

    Attributes
    ----------
    times : array, shape (m,)
    values : array, shape (m, ...), or None
        The given values, if they are joined by straight lines.
    coefficients : array, shape (m - 1, order, ...), or None
        Otherwise the coefficients of ``(t - times[i])**j`` in each interval.

    Raises
    ------
    InputError

    Examples
    --------
    >>> thrust = lt.torques.Table([0.0, 1.0, 3.0], [0.0, 2.0, 2.0])
    >>> [float(thrust(t)) for t in (-1.0, 0.5, 2.0, 4.0)]
    [0.0, 1.0, 2.0, 0.0]
    """

    times: jax.Array
    values: jax.Array | None
    coefficients: jax.Array | None
    shape: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, times, values=None, kind: TableKind = "linear", name: str = "values"):
        if kind not in ("linear", "cubic"):
            raise InputError(f"kind must be 'linear' or 'cubic', got {kind!r}")
        if callable(times):
            if values is not None:
                raise InputError("give values= only with an array of times: a spline has its values")
            self.times, self.coefficients = _breakpoints_and_coefficients(times)
            self.values, self.shape = None, self.coefficients.shape[2:]
            return
        if values is None or callable(values):
            raise InputError("a table needs times and values, or a spline of SciPy alone")
        self.times, self.values = checked_numbers(times, "times"), checked_numbers(values, name)
        if self.times.ndim != 1 or self.times.size < 2 or self.values.shape[:1] != self.times.shape:
            raise InputError(
                f"times must have shape (m,) with m >= 2, and {name} m rows, got {self.times.shape} and "
                f"{self.values.shape}"
            )
        for label, numbers in {"times": self.times, name: self.values}.items():
            require_condition(numbers, lambda v: abs(v) < jnp.inf, label + " must be finite, got {value}")
        require_condition(self.times, lambda t: t[1:] > t[:-1], "the times of a table must increase, got {value}")
        self.shape, self.coefficients = self.values.shape[1:], None
        if kind == "cubic":
            spline = scipy.interpolate.CubicSpline(np.asarray(self.times), np.asarray(self.values))
            self.times, self.coefficients = _breakpoints_and_coefficients(spline)
            self.values = None

    @classmethod
    def from_parts(cls, times, values, coefficients) -> Table:
        """Return a table of values at times from its attributes, without a check."""
        table = object.__new__(cls)
        shape = values.shape[1:] if coefficients is None else coefficients.shape[2:]
        for name, value in {"times": times, "values": values, "coefficients": coefficients, "shape": shape}.items():
            object.__setattr__(table, name, value)
        return table

    @property
    def kink_times(self) -> tuple[float, ...]:
        return kinks_of_table(self.times, self.values is None)

    def __call__(self, t) -> jax.Array:
        times, n_intervals = jnp.asarray(self.times), self.times.shape[0] - 1
        i = interval_index(times, t)
        start = times[i]
        if self.values is not None:
            values = jnp.asarray(self.values)
            fraction = (t - start) / (times[i + 1] - start)
            value = (1.0 - fraction) * values[i] + fraction * values[i + 1]
        else:
            assert self.coefficients is not None
            value = _polynomial_value(jnp.asarray(self.coefficients)[i], t - start)
        return jnp.where((t >= times[0]) & (t <= times[n_intervals]), value, jnp.zeros(self.shape))


def kinks_of_table(times: jax.Array, is_smooth: bool) -> tuple[float, ...]:
    """Return the times at which a table has a kink: all of them, or the first and the last if its pieces are smooth.

    There are none if the times are not known, because JAX traces them or they differ in an ensemble.
    """
    if is_traced(times) or not np.isfinite(times).all():
        return ()
    return tuple(np.asarray(times)[[0, -1] if is_smooth else slice(None)].tolist())


class ContinuedSpline(FunctionWithBreaks):
    """The polynomials of a spline of SciPy, for runs within its interval.

    The first and the last polynomial continue outside, where a time lies by rounding.

    Attributes
    ----------
    times : array, shape (m,)
    coefficients : array, shape (m - 1, order, ...)
        Coefficients of ``(t - times[i])**j`` in each interval.
    """

    times: jax.Array
    coefficients: jax.Array

    def __init__(self, spline: Any):
        self.times, self.coefficients = _breakpoints_and_coefficients(spline)

    @property
    def known_span(self) -> tuple[float, float]:
        start, end = kinks_of_table(self.times, is_smooth=True) or (-math.inf, math.inf)
        return start, end

    def __call__(self, t) -> jax.Array:
        i = interval_index(self.times, t)
        return _polynomial_value(self.coefficients[i], t - self.times[i])


def _polynomial_value(coefficients: jax.Array, s) -> jax.Array:
    """Return ``sum_j coefficients[j] s**j`` by Horner's scheme."""
    value = coefficients[-1]
    for j in range(coefficients.shape[0] - 2, -1, -1):
        value = value * s + coefficients[j]
    return value


def interval_index(times: jax.Array, t) -> jax.Array:
    """Return the index of the interval between increasing times that contains t, by bisection; clamped to the ends."""
    n_intervals = times.shape[0] - 1
    index = jnp.zeros((), dtype=jnp.int64)
    step = 1 << max((n_intervals - 1).bit_length() - 1, 0)
    while step:
        trial = index + step
        has_begun = (trial < n_intervals) & (times[jnp.minimum(trial, n_intervals - 1)] <= t)
        index = jnp.where(has_begun, trial, index)
        step //= 2
    return index


def _breakpoints_and_coefficients(spline: Any) -> tuple[jax.Array, jax.Array]:
    """Return the times, shape (m,), and the ascending coefficients, shape (m - 1, order, ...), of a SciPy spline."""
    axis = spline.axis if isinstance(spline, _spline_classes_with_axis()) else 0
    if axis != 0:
        raise InputError(f"a spline must interpolate along axis 0, got axis {axis}")
    if isinstance(spline, scipy.interpolate.BPoly):
        spline = scipy.interpolate.PPoly.from_bernstein_basis(spline)
    elif isinstance(spline, scipy.interpolate.UnivariateSpline):
        spline = _bspline_to_piecewise_polynomial(scipy.interpolate.BSpline(*spline._eval_args))
    elif isinstance(spline, scipy.interpolate.BSpline):
        spline = _bspline_to_piecewise_polynomial(spline)
    if not isinstance(spline, scipy.interpolate.PPoly):
        raise InputError(
            "a table must be a piecewise polynomial of SciPy, or times and values, got "
            f"{type(spline).__name__}. Write Table(times, function(times), kind='cubic') with times at which its "
            "values are to be taken"
        )
    times, coefficients = np.asarray(spline.x, dtype=float), np.asarray(spline.c)
    if np.iscomplexobj(coefficients) or not (np.isfinite(times).all() and np.isfinite(coefficients).all()):
        raise InputError("a spline must have real, finite coefficients")
    if not (np.diff(times) > 0.0).all():
        raise InputError("the breakpoints of a spline must increase")
    return jnp.asarray(times), jnp.asarray(np.moveaxis(coefficients[::-1], 0, 1).astype(float))


def _bspline_to_piecewise_polynomial(spline: Any) -> Any:
    """Return a B-spline of degree k as piecewise polynomials, from its knot k to the last knot but k."""
    start, end = spline.t[spline.k], spline.t[-spline.k - 1]
    breakpoints = np.unique(spline.t[(spline.t >= start) & (spline.t <= end)])
    derivatives = [spline.derivative(j) if j else spline for j in range(spline.k + 1)]
    coefficients = [f(breakpoints[:-1]) / math.factorial(j) for j, f in enumerate(derivatives)]
    return scipy.interpolate.PPoly(np.stack(coefficients[::-1]), breakpoints)
