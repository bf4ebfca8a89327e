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
    """The events of a run: names, traceable functions, directions, and the rules that end the run.

    Parameters
    ----------
    until : Relaxed or function, or a sequence of them
        A function of (x) or (t, x) that returns a number. Arguments named ``t``, ``attitude``, ``parameters`` and
        ``system`` are the time, the element of the group, a dict of the parameters of the system by name, and the
        system. Its attributes ``terminal`` (True, False or the number of zeros that ends the run; by default True) and
        ``direction`` mean what they mean in SciPy.
    system : System
        The prepared system that the engines run.
    start_time, initial_state : float and array, shape (n,)
        The initial time and state.

    Attributes
    ----------
    names : tuple of str
    functions : tuple of pytrees
        Functions of (system, t, x), for engines.
    directions : tuple of int
    rules : EventRules
    """

    def __init__(self, until: Until | EventSpecification, system: System, start_time: float, initial_state):
        specification = until if isinstance(until, EventSpecification) else EventSpecification(until)
        events = [
            _make_event(event, number, n_counted_before, specification, system, start_time, initial_state)
            for number, (event, n_counted_before) in enumerate(
                zip(specification.events, specification.n_counted_before, strict=True)
            )
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
    """The events that a user passes, one or several, in the conventions of :func:`integrate` or of SciPy.

    Parameters
    ----------
    user_events : Until
    scipy_arguments : tuple, optional
        Given for events in SciPy's conventions: functions of (t, y, *scipy_arguments), which end the run only if they
        have an attribute ``terminal``, and whose jumps across zero are events too.
    n_counted_before : sequence of int, optional
        For each function, the number of its zeros that an earlier part of the run has counted.
    """

    def __init__(
        self, user_events: Until, scipy_arguments: tuple | None = None, n_counted_before: Sequence[int] | None = None
    ):
        self.events = tuple(user_events) if isinstance(user_events, Sequence) else (user_events,)
        if not self.events:
            raise InputError("until must have at least one event, got an empty list")
        self.scipy_arguments = scipy_arguments
        self.n_counted_before = [0] * len(self.events) if n_counted_before is None else list(n_counted_before)


def _make_event(
    user_event: Any,
    event_index: int,
    n_counted_before: int,
    specification: EventSpecification,
    system: System,
    start_time: float,
    initial_state,
) -> tuple[str, RateAboveThreshold | EventFunction, int, int | None, bool]:
    """Return name, function, direction, terminal count and ``counts_jumps`` of an event: see :class:`EventRules`."""
    scipy_arguments = specification.scipy_arguments
    if isinstance(user_event, Relaxed):
        return *_rate_below_tolerance_event(user_event, system), -1, 1, True
    if not callable(user_event):
        raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, got {user_event!r}")
    name = "the event function" if len(specification.events) == 1 else f"event function {event_index}"
    direction = int(np.sign(direction_attribute_of_event(user_event)))
    count = _n_zeros_to_end_run(user_event, default_terminal=scipy_arguments is None)
    function = _trace_event_function(user_event, name, scipy_arguments, system, start_time, initial_state)
    return name, function, direction, None if count is None else count - n_counted_before, scipy_arguments is not None


def direction_attribute_of_event(event_function: Any) -> float:
    """Return the attribute ``direction`` of an event function, with SciPy's meaning; 0 if it has none."""
    return getattr(event_function, "direction", 0) or 0


def terminal_attribute_of_event(event_function: Any, default: bool = False) -> Any:
    """Return the attribute ``terminal`` of an event function, with SciPy's meaning; ``default`` if it has none."""
    return getattr(event_function, "terminal", default)


def _n_zeros_to_end_run(event_function: Any, default_terminal: bool) -> int | None:
    """Return the number of zeros of an event function after which the run ends; None if it never ends the run."""
    terminal = terminal_attribute_of_event(event_function, default_terminal)
    if terminal is None or terminal is False or terminal == 0:
        return None
    if int(terminal) != terminal or terminal < 0:
        raise InputError(f"terminal must be True or the number of zeros that ends the run, got {terminal!r}")
    return int(terminal)


def _rate_below_tolerance_event(relaxation: Relaxed, system: System) -> tuple[str, RateAboveThreshold]:
    """Return name and function of the event at which the rate of entropy production, or energy loss, is below tol."""
    if system.entropy_law == "nondecreasing":  # the laws say which rate vanishes as the system relaxes
        rate, name = "entropy_production", "entropy production"
    elif system.energy_law == "nonincreasing":
        rate, name = "energy_fall", "fall of the energy"
    else:
        raise InputError(
            "Relaxed(tol) needs a system that produces entropy or loses energy, and this system promises neither. Give "
            "a function of the state as until"
        )
    return f"{name} below {relaxation.tol:g}", RateAboveThreshold(jnp.asarray(relaxation.tol), rate)


class RateAboveThreshold(Module):
    """Event function that returns a rate of the system minus a threshold."""

    threshold: jax.Array
    rate_name: str = eqx.field(static=True)
    calls_python = False

    def __call__(self, system: System, t, x):
        return getattr(system, self.rate_name)(x) - self.threshold


class EventFunction(Module):
    """Event function that calls a user's function with the time, state, attitude or parameters that it asks for.

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


def event_arguments(argument_names: Sequence[str], system: System, t, x) -> tuple:
    """Return the arguments of an event function at time t and state x of a prepared system.

    The parameters are one array, of all parameters one after another: see :func:`parameter_values`.
    """
    return tuple(_event_argument_by_name(name, system, t, x) for name in argument_names)


def _event_argument_by_name(name: str, system: System, t, x):
    """Return the time, the attitude, the parameters in one array, or for any other name the user's state."""
    if name == "t":
        return jnp.asarray(t, dtype=jnp.float64)
    if name == "attitude":
        assert system.attitude_layout is not None
        return system.attitude_layout.split_state(x)[1]
    if name in ("parameters", "system"):
        return jnp.concatenate([jnp.ravel(a) for a in _parameters_of_user_system(system)] or [jnp.zeros(0)])
    return system.user_state(x)


def _parameters_of_user_system(system: System) -> list:
    return jax.tree_util.tree_leaves(eqx.filter(unwrap_user_system(system), eqx.is_inexact_array))


def _trace_event_function(
    user_function: Callable,
    event_name: str,
    scipy_arguments: tuple | None,
    system: System,
    start_time: float,
    initial_state,
) -> EventFunction:
    """Return a user's event function in the form of the engines: traced, or called in Python if it cannot be traced.

    Raises
    ------
    FunctionError
        If the function fails at the initial state, or returns no number.
    InputError
        If it asks for an attitude that the system does not have.
    """
    names = ("t", "x") if scipy_arguments is not None else _event_argument_names(user_function)
    if "attitude" in names and system.attitude_layout is None:
        raise InputError(f"{event_name} asks for the attitude, and this system has none. Give it a group")
    call = _pass_parameters_and_extra_arguments(user_function, names, scipy_arguments or (), system)
    example = jax.eval_shape(lambda t, x: event_arguments(names, system, t, x), jnp.zeros(()), initial_state)
    shapes = [argument.shape for argument in example]
    state_shape = jax.eval_shape(system.user_state, jax.ShapeDtypeStruct((system.dim,), jnp.float64)).shape
    failure: Exception | None = None
    for traceable in (call, accept_jax_arrays(call)):
        try:
            traced_function = trace_callables(traceable, lambda f, *a: f(*a), *shapes)
            value = jax.eval_shape(traced_function, *example)
        except IndexOutOfRangeError as error:
            raise error.with_function(f"{event_name}, at a state of shape {state_shape},") from None
        except TRACE_ERRORS as error:
            failure = failure or error
        else:
            check_result_is_scalar(value, event_name)
            return EventFunction(traced_function, names)
    assert failure is not None
    arguments = [np.asarray(a) for a in event_arguments(names, system, start_time, jnp.asarray(initial_state))]
    try:
        result = call(*arguments)
        number = np.asarray(np.empty(0) if result is None else result, dtype=np.float64)
    except Exception as error:
        description = f"{event_name} could not be evaluated on a state of shape {state_shape}"
        raise FunctionError(trace_error_message(description, failure)) from error
    if result is None:
        raise FunctionError(trace_error_message(f"{event_name} could not be evaluated", failure))
    check_result_is_scalar(number, event_name)
    return EventFunction(PythonCall(call), names)


def check_result_is_scalar(result, function_name: str) -> None:
    """Raise FunctionError unless the result of a user's function is a number, an array of shape ()."""
    shape = getattr(result, "shape", None)
    if shape != ():
        description = type(result).__name__ if shape is None else f"shape {shape}"
        raise FunctionError(
            f"{function_name} must return one number, got {description}. For several events, give a list of functions"
        )


def _event_argument_names(function: Callable) -> tuple[str, ...]:
    """Return the names of the arguments of an event function: "x" for the state, or one of ``ARGUMENT_NAMES``."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return ("x",)
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required_names = [p.name for p in parameters if p.kind in kinds and p.default is inspect.Parameter.empty]
    if len(required_names) == 2 and not set(required_names) & set(ARGUMENT_NAMES):
        return ("t", "x")
    names = tuple(name if name in ARGUMENT_NAMES else "x" for name in required_names) or ("x",)
    if names.count("x") > 1:
        raise InputError(
            f"an event function must have the arguments (x) or (t, x), and any of {', '.join(ARGUMENT_NAMES)} by "
            f"these names, got {', '.join(required_names)}"
        )
    return names


def _pass_parameters_and_extra_arguments(
    user_function: Callable, argument_names: Sequence[str], extra_arguments: tuple, system: System
) -> Callable:
    """Return a function that calls the user's one, with its parameters as a dict or system and with extra arguments."""
    if not extra_arguments and not {"parameters", "system"} & set(argument_names):
        return user_function
    tree = eqx.filter(unwrap_user_system(system), eqx.is_inexact_array)
    paths, structure = jax.tree_util.tree_flatten_with_path(tree)
    static = eqx.filter(unwrap_user_system(system), eqx.is_inexact_array, inverse=True)
    labels = [jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths]
    shapes = [leaf.shape for _, leaf in paths]

    def call(*arguments):
        values = list(arguments)
        for i, name in enumerate(argument_names):
            if name in ("parameters", "system"):
                parameter_arrays, offset = [], 0
                for shape in shapes:
                    size = math.prod(shape)
                    parameter_arrays.append(values[i][offset : offset + size].reshape(shape))
                    offset += size
                values[i] = (
                    dict(zip(labels, parameter_arrays, strict=True))
                    if name == "parameters"
                    else eqx.combine(jax.tree_util.tree_unflatten(structure, parameter_arrays), static)
                )
        return user_function(*values, *extra_arguments)

    return call


def collect_events(system: System, event_names: Sequence[str], occurrences: Sequence[EventOccurrence]) -> Events:
    """Return the events of a run or an ensemble, one series of times and user's states for each event function."""
    series = []
    for k, name in enumerate(event_names):
        occurrences_of_event = sorted((e for e in occurrences if e.function == k), key=lambda e: (e.trajectory, e.t))
        x = np.reshape([e.x for e in occurrences_of_event], (len(occurrences_of_event), system.dim))
        numbers = np.array([e.trajectory for e in occurrences_of_event], dtype=int)
        t = np.array([e.t for e in occurrences_of_event], dtype=np.float64)
        series.append(EventSeries(name, t, np.asarray(system.user_state(x)), numbers))
    return Events(series)
