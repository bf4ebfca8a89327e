"""Events of a run: zeros of functions of the time and the state, and the relaxation of the state."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..engines.adaptive_runs import EventOccurrence, EventRules
from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..results.events import Events, EventSeries
from ..systems import System
from ..systems.kind_checks import unwrap_user_system
from ..tracing.numpy_calls import PythonCall, accept_jax_arrays
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import trace_callables


@dataclass(frozen=True)
class Relaxed:
    """The event that the entropy production falls below ``tol`` (per unit of time), for ``integrate(until=...)``.

    Some systems produce no entropy, but their energy falls, as under a :class:`liethermo.DoubleBracket`. For these the
    rate at which the dissipation lowers the energy is used instead.

    The rate may be below ``tol`` at the start, as near an unstable equilibrium. It then has to rise above it first.

    Parameters
    ----------
    tol : float, > 0
        The rate (entropy / time, or energy / time if the energy falls) below which the run stops.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> run = lt.integrate(
    ...     body, [0.1, 0.2, 1.0], (0.0, 1e4), lt.Adaptive(1e-8), until=lt.Relaxed(1e-6)
    ... )
    >>> run.status.code
    'event'
    """

    tol: float

    def __post_init__(self):
        if not (math.isfinite(self.tol) and self.tol > 0.0):
            raise InputError(f"tol must be positive and finite, got {self.tol!r}")


Until: TypeAlias = Relaxed | Callable | Sequence[Any]
"""Type of ``until``: an event, or several."""

ARGUMENT_NAMES = ("t", "attitude", "parameters", "system")
"""Names of arguments of an event function besides the state."""


class EventSet:
    """The events of a run, as the engines and the handler of their pauses need them.

    Parameters
    ----------
    until : Relaxed or function, or a sequence of them
        A function of (x) or (t, x) that returns a number. Arguments named ``t``, ``attitude``, ``parameters`` and
        ``system`` are the time, the element of the group, a dict of the parameters of the system by name, and the
        system. Its attributes ``terminal`` (True, False or the number of zeros that ends the run; by default True) and
        ``direction`` mean what they mean in SciPy.
    system : System
        The system as it is run.
    t, x : float and array, shape (n,)
        The initial time and state.

    Attributes
    ----------
    names : tuple of str
    functions : tuple of pytrees
        Functions of (system, t, x), for engines.
    directions : tuple of int
    rules : EventRules
    """

    def __init__(self, until: Until | EventSpecification, system: System, t: float, x):
        specification = until if isinstance(until, EventSpecification) else EventSpecification(until)
        events = [
            _prepared_event(event, number, counted, specification, system, t, x)
            for number, (event, counted) in enumerate(zip(specification.events, specification.counted, strict=True))
        ]
        self.names, self.functions, self.directions, counts, jumps = zip(*events, strict=True)
        self.rules = EventRules(counts, jumps)

    @property
    def calls_python(self) -> bool:
        """True if a function cannot be traced and is called in Python."""
        return any(function.calls_python for function in self.functions)

    def raise_first_error(self) -> None:
        """Raise the exception of an event function that is called in Python, if there was one."""
        for function in self.functions:
            if isinstance(function, EventFunction) and isinstance(function.function, PythonCall):
                function.function.raise_first_error()


class EventSpecification:
    """Events as the user gave them: one or several, in the conventions of :func:`integrate` or of SciPy.

    Parameters
    ----------
    until : Until
    scipy_arguments : tuple, optional
        Given for events in SciPy's conventions: functions of (t, y, *scipy_arguments), which end the run only if they
        have an attribute ``terminal``, and whose jumps across zero are events too.
    counted : sequence of int, optional
        For each function the number of its zeros that have been counted before.
    """

    def __init__(self, until: Until, scipy_arguments: tuple | None = None, counted: Sequence[int] | None = None):
        self.events = tuple(until) if isinstance(until, Sequence) else (until,)
        if not self.events:
            raise InputError("until must have an event at least, got an empty list")
        self.scipy_arguments = scipy_arguments
        self.counted = [0] * len(self.events) if counted is None else list(counted)


def _prepared_event(
    event: Any, number: int, counted: int, specification: EventSpecification, system: System, t: float, x
) -> tuple[str, RateAboveThreshold | EventFunction, int, int | None, bool]:
    """Return the name, the function, the direction and the rules of an event: see :class:`EventRules`."""
    scipy_arguments = specification.scipy_arguments
    if isinstance(event, Relaxed):
        return *_relaxation_event(event, system), -1, 1, True
    if not callable(event):
        raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, got {event!r}")
    name = "the event function" if len(specification.events) == 1 else f"event function {number}"
    direction = int(np.sign(event_direction(event)))
    count = _terminal_count(event, is_terminal=scipy_arguments is None)
    function = _checked_event_function(event, name, scipy_arguments, system, t, x)
    return name, function, direction, None if count is None else count - counted, scipy_arguments is not None


def event_direction(event: Any) -> float:
    """Return the ``direction`` of an event function, as SciPy reads it; 0 if it has none."""
    return getattr(event, "direction", 0) or 0


def event_terminal(event: Any, default: bool = False) -> Any:
    """Return the attribute ``terminal`` of an event function, as SciPy reads it; ``default`` if it has none."""
    return getattr(event, "terminal", default)


def _terminal_count(function: Any, is_terminal: bool) -> int | None:
    """Return the number of zeros of a function after which the run ends; None if it never ends the run."""
    terminal = event_terminal(function, is_terminal)
    if terminal is None or terminal is False or terminal == 0:
        return None
    if int(terminal) != terminal or terminal < 0:
        raise InputError(f"terminal must be True or the number of zeros that ends the run, got {terminal!r}")
    return int(terminal)


def _relaxation_event(event: Relaxed, system: System) -> tuple[str, RateAboveThreshold]:
    if system.entropy_law == "nondecreasing":  # the laws say which rate vanishes as the system relaxes
        rate, name = "entropy_production", "entropy production"
    elif system.energy_law == "nonincreasing":
        rate, name = "energy_fall", "fall of the energy"
    else:
        raise InputError(
            "Relaxed(tol) needs a system that produces entropy or loses energy, and this system promises neither. Give "
            "a function of the state as until"
        )
    return f"{name} below {event.tol:g}", RateAboveThreshold(jnp.asarray(event.tol), rate)


class RateAboveThreshold(Module):
    """A rate of a system minus a threshold."""

    threshold: jax.Array
    rate_name: str = eqx.field(static=True)
    calls_python = False

    def __call__(self, system: System, t, x):
        return getattr(system, self.rate_name)(x) - self.threshold


class EventFunction(Module):
    """A user's event function, applied to the time and the state in the user's form.

    Attributes
    ----------
    function : pytree
        The traced function of the arguments ``names``; a :class:`PythonCall` if it cannot be traced.
    names : tuple of str
        The arguments: "x", or one of :data:`ARGUMENT_NAMES`.
    """

    function: Any
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def calls_python(self) -> bool:
        return isinstance(self.function, PythonCall)

    def __call__(self, system: System, t, x):
        return self.function(*event_arguments(self.names, system, t, x))


def event_arguments(names: Sequence[str], system: System, t, x) -> tuple:
    """Return the arguments of an event function at time t and state x of a prepared system.

    The parameters are one array, of all parameters one after another: see :func:`parameter_values`.
    """
    return tuple(_event_argument(name, system, t, x) for name in names)


def _event_argument(name: str, system: System, t, x):
    if name == "t":
        return jnp.asarray(t, dtype=jnp.float64)
    if name == "attitude":
        assert system.attitude_layout is not None
        return system.attitude_layout.split_state(x)[1]
    if name in ("parameters", "system"):
        return jnp.concatenate([jnp.ravel(a) for a in _parameter_arrays(system)] or [jnp.zeros(0)])
    return system.user_state(x)


def _parameter_arrays(system: System) -> list:
    return jax.tree_util.tree_leaves(eqx.filter(unwrap_user_system(system), eqx.is_inexact_array))


def _checked_event_function(
    function: Callable, name: str, scipy_arguments: tuple | None, system: System, t: float, x
) -> EventFunction:
    """Return a user's event function for engines, traced if possible.

    Raises
    ------
    FunctionError
        If the function fails at the initial state, or returns no number.
    """
    names = ("t", "x") if scipy_arguments is not None else _argument_names(function)
    if "attitude" in names and system.attitude_layout is None:
        raise InputError(f"{name} asks for the attitude, and this system has none. Give it a group")
    call = _with_user_arguments(function, names, scipy_arguments or (), system)
    example = jax.eval_shape(lambda t, x: event_arguments(names, system, t, x), jnp.zeros(()), x)
    shapes = [argument.shape for argument in example]
    state_shape = jax.eval_shape(system.user_state, jax.ShapeDtypeStruct((system.dim,), jnp.float64)).shape
    failure: Exception | None = None
    for traceable in (call, accept_jax_arrays(call)):
        try:
            traced = trace_callables(traceable, lambda f, *a: f(*a), *shapes)
            value = jax.eval_shape(traced, *example)
        except IndexOutOfRangeError as error:
            raise error.with_function(f"{name}, at a state of shape {state_shape},") from None
        except TRACE_ERRORS as error:
            failure = failure or error
        else:
            _check_result_is_scalar(value, name)
            return EventFunction(traced, names)
    assert failure is not None
    arguments = [np.asarray(a) for a in event_arguments(names, system, t, jnp.asarray(x))]
    try:
        result = call(*arguments)
        number = np.asarray(np.empty(0) if result is None else result, dtype=np.float64)
    except Exception as error:
        description = f"{name} could not be evaluated on a state of shape {state_shape}"
        raise FunctionError(trace_error_message(description, failure)) from error
    if result is None:
        raise FunctionError(trace_error_message(f"{name} could not be evaluated", failure))
    _check_result_is_scalar(number, name)
    return EventFunction(PythonCall(call), names)


def _check_result_is_scalar(value, name: str) -> None:
    shape = getattr(value, "shape", None)
    if shape != ():
        raise FunctionError(
            f"{name} must return one number, got shape {type(value).__name__ if shape is None else shape}. For several "
            "events, give a list of functions"
        )


def _argument_names(function: Callable) -> tuple[str, ...]:
    """Return the names of the arguments of a user's function; the one that has none of our names is the state, "x"."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return ("x",)
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required = [p.name for p in parameters if p.kind in kinds and p.default is inspect.Parameter.empty]
    if len(required) == 2 and not set(required) & set(ARGUMENT_NAMES):
        return ("t", "x")
    names = tuple(name if name in ARGUMENT_NAMES else "x" for name in required) or ("x",)
    if names.count("x") > 1:
        raise InputError(
            f"an event function must have the arguments (x) or (t, x), and any of {', '.join(ARGUMENT_NAMES)} by "
            f"these names, got {', '.join(required)}"
        )
    return names


def _with_user_arguments(function: Callable, names: Sequence[str], more: tuple, system: System) -> Callable:
    """Return the user's function, called with parameters by name and with further arguments."""
    if not more and not {"parameters", "system"} & set(names):
        return function
    tree = eqx.filter(unwrap_user_system(system), eqx.is_inexact_array)
    paths, structure = jax.tree_util.tree_flatten_with_path(tree)
    static = eqx.filter(unwrap_user_system(system), eqx.is_inexact_array, inverse=True)
    labels = [jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths]
    shapes = [leaf.shape for _, leaf in paths]

    def call(*arguments):
        values = list(arguments)
        for i, name in enumerate(names):
            if name in ("parameters", "system"):
                parts, first = [], 0
                for shape in shapes:
                    size = math.prod(shape)
                    parts.append(values[i][first : first + size].reshape(shape))
                    first += size
                values[i] = (
                    dict(zip(labels, parts, strict=True))
                    if name == "parameters"
                    else eqx.combine(jax.tree_util.tree_unflatten(structure, parts), static)
                )
        return function(*values, *more)

    return call


def collect_events(system: System, names: Sequence[str], occurrences: Sequence[EventOccurrence]) -> Events:
    """Return the events of a run, or of an ensemble, in the user's form, by event function."""
    series = []
    for k, name in enumerate(names):
        found = sorted((e for e in occurrences if e.function == k), key=lambda e: (e.trajectory, e.t))
        x = np.reshape([e.x for e in found], (len(found), system.dim))
        numbers = np.array([e.trajectory for e in found], dtype=int)
        t = np.array([e.t for e in found], dtype=np.float64)
        series.append(EventSeries(name, t, np.asarray(system.user_state(x)), numbers))
    return Events(series)
