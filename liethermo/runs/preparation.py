"""Preparation of a run: the system and method in the form of the engines, the initial state, and the promised laws."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from manifolds._arrays import is_traced

from ..errors import FunctionError, InputError
from ..functions.checks import trace_energies
from ..functions.time_span import set_time_span
from ..integrators import DEFAULT_METHOD, OneStepMethod, Reference, WithAttitude
from ..integrators.base import pullback_method
from ..integrators.fluctuating import noise_dimension
from ..results.status import Laws
from ..systems import (
    AttitudeSystem,
    DrivenSystem,
    LiePoissonSystem,
    System,
    embed_in_arrays,
    make_autonomous,
)
from ..systems.clock import WORK_NAME
from ..systems.invariants import recorded_functions_with_verdicts, resolve_invariants_near, undecided_function_names
from ..systems.transport import has_generator
from ..tracing.caching import LRUCache, memoize
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import is_library_object
from .adaptive import Adaptive
from .noise import DEFAULT_NOISE_METHOD, Fluctuations
from .schedule import StepSchedule
from .system_family import Family

Result = TypeVar("Result")

REFERENCE_OPTIONS_MESSAGE = (
    "Reference chooses its own steps and cannot be combined with Adaptive, save_at, until or dense. Use another method"
)
"""Error message for options that need steps of the library's own methods."""

NOISE_OPTIONS_MESSAGE = (
    "noise= needs fixed steps and cannot be combined with Adaptive, until or dense. Give the step as a number"
)
"""Error message for options that a run with noise does not have."""


def refuse_tracers(function: Callable[..., Result]) -> Callable[..., Result]:
    """Return a function that raises an InputError, which names ``lt.flow``, if JAX traces its arguments."""

    @functools.wraps(function)
    def call(*arguments, **keywords) -> Result:
        try:
            return function(*arguments, **keywords)
        except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
            if not is_traced(arguments, keywords):
                raise
            raise InputError(
                "a run needs numbers, but jax.jit, jax.grad or jax.vmap traces its arguments. Use "
                "lt.flow(system, x0, t_span, step, method), which JAX compiles and differentiates"
            ) from error

    return call


def check_choice(argument_name: str, value, choices: tuple[str, ...]) -> None:
    if value not in choices:
        *leading_choices, last_choice = map(repr, choices)
        raise InputError(f"{argument_name} must be {', '.join(leading_choices)} or {last_choice}, got {value!r}")


def checked_or_default_method(method, noise: Fluctuations | None = None, *, is_single_trajectory: bool = False) -> Any:
    """Return the method of a run, the default one for None.

    Raises
    ------
    InputError
        If ``method`` is not a method, or is Reference and the run is not ``is_single_trajectory``.
    """
    if method is None:
        return DEFAULT_METHOD if noise is None else DEFAULT_NOISE_METHOD
    if not isinstance(method, OneStepMethod | Reference):
        raise InputError(f"method must be an integrator such as lt.MetriplecticGauss(), got {method!r}")
    if isinstance(method, Reference) and not is_single_trajectory:
        raise InputError("Reference runs single trajectories, with lt.integrate or a propagator. Use another method")
    return method


def refuse_incompatible_options(
    method, step, noise: Fluctuations | None, until=None, dense: bool = False, save_at=None
) -> None:
    """Raise InputError if Reference or noise is combined with adaptive steps, events, dense output or ``save_at``."""
    is_examined = isinstance(step, Adaptive) or until is not None or dense
    if isinstance(method, Reference) and (is_examined or save_at is not None):
        raise InputError(REFERENCE_OPTIONS_MESSAGE)
    if noise is not None and is_examined:
        raise InputError(NOISE_OPTIONS_MESSAGE)


def resolve_invariants(system: System, x0) -> System:
    """Return the system after testing its undecided conservation laws at states near x0."""
    return resolve_invariants_near(system, system.state_array(x0, True)) if has_undecided_invariants(system) else system


@memoize
def has_undecided_invariants(system: System) -> bool:
    """Return whether some conservation laws of the system must be tested near the initial state of a run."""
    return not is_traced(system) and bool(undecided_function_names(system))


@memoize
def prepare_system_and_method(
    system: System, method, noise: Fluctuations | None = None, adaptive_tolerance: float | None = None
) -> tuple[System, Any]:
    """Return the system and the method in the form of the engines, for adaptive steps of a tolerance or fixed steps.

    They include clock and work for a driven system, noise, the attitude if there is a group, and charts or the
    embedding of a manifold.
    """
    if not isinstance(method, OneStepMethod):
        if noise is not None:
            raise InputError(f"noise= works only with lt.MetriplecticMidpoint, got {method}")
        if system.torque_laws.needs_attitude:
            raise InputError(
                f"the torque {system.torque_laws.name} depends on the attitude, which {method} cannot integrate. Use a "
                "method of the library, such as lt.MetriplecticGauss()"
            )
        return make_autonomous(system, unit=1.0), method  # its errors are measured component by component
    method = method if noise is None else noise.method_with_noise(make_autonomous(system), method)
    return prepare_for_method(system, method, adaptive_tolerance, True)


@memoize
def prepare_for_method(
    system: System, method: OneStepMethod, adaptive_tolerance: float | None = None, with_attitude: bool = False
) -> tuple[System, OneStepMethod]:
    """Return the system and a method of the library in the form of the engines, without noise.

    They include the attitude if ``with_attitude`` is True or a torque depends on it.
    """
    autonomous_system = make_autonomous(system if method.uses_charts else embed_in_arrays(system))
    method = trace_energies(
        pullback_method(method, autonomous_system).on(autonomous_system, adaptive_tolerance), autonomous_system.dim
    )
    reconstruction = system.reconstruction if isinstance(system, LiePoissonSystem) else None
    if reconstruction is None or not (with_attitude or system.torque_laws.needs_attitude):
        return autonomous_system, method
    assert isinstance(autonomous_system, LiePoissonSystem | DrivenSystem)
    kind = "exp" if method.explicit else reconstruction
    return AttitudeSystem(autonomous_system, kind), WithAttitude(method, kind)


def checked_initial_state(system: System, method, x0, t: float, attitude=None) -> jax.Array | np.ndarray:
    """Return the initial state of a prepared system from the user's x0, after checking that a run can start there.

    Raises
    ------
    InputError
        If ``attitude`` is given and the system has no group, or no run can start at x0.
    """
    x = system.initial_state(x0, t, attitude)
    if reason := why_not_startable(system, method, x):
        raise InputError(reason)
    return x


def why_not_startable(system: System, method, x) -> str:
    """Return the reason why no run can start at x, a state or a batch of states; "" if a run can start."""
    ignores_singularity = has_generator(system) and (not isinstance(method, OneStepMethod) or method.explicit)
    domain = system.domain
    reason = domain.why_outside(x) or ("" if ignores_singularity else domain.why_entropy_gradient_infinite(x))
    return reason and f"the run cannot start at this x0: {reason}"


def wrap_family_like_member(family: Family, wrapped_member: System) -> Family:
    """Return the family with each member wrapped as ``wrapped_member`` is: by a clock, an attitude or an embedding."""
    if wrapped_member.wrapped_system is None:
        return family
    return wrap_family_like_member(family, wrapped_member.wrapped_system.system).map_members(
        wrapped_member.wrapped_system.wrap, *wrapped_member.wrapped_system.arguments
    )


MAX_LIMITED_SYSTEMS = 64
"""Largest number of systems limited to a span that are cached; the least recently used are dropped."""

_limited_systems: LRUCache[tuple[System, System]] = LRUCache(MAX_LIMITED_SYSTEMS)


def limit_time_functions_to_span(system: System, schedule: StepSchedule) -> System:
    """Return the prepared system with its functions of time evaluated only at times within the span of a schedule.

    These functions may jump at the breaks within the span. Equal arguments return the same object, so that cached
    results are shared.
    """
    if system.clock is None:
        return system
    span = *schedule.span_of_time_functions, *schedule.breaks
    if is_traced(system):
        return set_time_span(system, *span)
    # the value holds the system, so that its id stays its own
    key = id(system), *span
    return _limited_systems.get_or_compute(key, lambda: (system, set_time_span(system, *span)))[1]


def limit_time_functions_of_family(family: Family, example_member: System, schedule: StepSchedule) -> Family:
    """Return the family with the functions of time of each member evaluated only within the span of a schedule."""
    if example_member.clock is None:
        return family
    return family.map_members_with_shared_numbers(set_time_span, *schedule.span_of_time_functions, *schedule.breaks)


@memoize
def invariants_and_laws(system: System, method) -> tuple[dict, Laws]:
    """Return the functions recorded as invariants along a run, by name with verdicts, and the promised laws.

    Raises
    ------
    InputError
        If the method cannot run the system.
    """
    if isinstance(method, OneStepMethod):
        method.check(system)
        if not is_library_object(method):
            check_shapes_of_method(system, method)
    invariants = recorded_functions_with_verdicts(system)
    return invariants, promised_laws(system, method, invariants)


def check_shapes_of_method(system: System, method: OneStepMethod) -> None:
    """Trace the slopes and the increment of a user's method, and check that they have the shapes of slopes and state.

    Raises
    ------
    FunctionError
        If ``slopes`` or ``increment`` cannot be traced, with the line of the method, or returns another shape.
    """
    x, h = jax.ShapeDtypeStruct((system.dim,), np.float64), jax.ShapeDtypeStruct((), np.float64)
    k = jax.ShapeDtypeStruct((method.stages, system.dim), np.float64)
    functions_to_trace: dict[str, tuple[Callable, tuple, tuple[int, ...]]] = {
        "slopes": (lambda x, h, k: method.slopes(system, x, 0.0 * x, h, k), (x, h, k), k.shape),
        "increment": (method.increment, (h, k), x.shape),
    }
    for name, (function, arguments, shape) in functions_to_trace.items():
        try:
            result = jax.eval_shape(function, *arguments)
        except TRACE_ERRORS as error:
            description = f"{name} of {type(method).__name__} could not be traced"
            raise FunctionError(trace_error_message(description, error)) from error
        if getattr(result, "shape", None) != shape:
            got = getattr(result, "shape", type(result).__name__)
            raise FunctionError(f"{name} of {type(method).__name__} must return an array of shape {shape}, got {got}")


def promised_laws(system: System, method, invariants) -> Laws:
    """Return the laws promised for a run: energy, entropy, and the invariants that the method preserves."""
    method_preserves = method.preserves_function if isinstance(method, OneStepMethod) else lambda system, name: False
    constants = [
        *(name for name, (_, is_conserved) in invariants.items() if is_conserved),
        *system.vector_invariant_names,
    ]
    unknown = tuple(name for name, (_, is_conserved) in invariants.items() if is_conserved is None)
    conserved_names = tuple(name for name in constants if method_preserves(system, name))
    unpromised_names = tuple(name for name in constants if name not in conserved_names)
    balance_entries = () if system.clock is None else (WORK_NAME,)
    if isinstance(method, OneStepMethod) and noise_dimension(method):  # what holds on paths, and what in the mean
        energy = "conserved" if system.energy_law == "conserved" else None
        laws_in_mean = ("energy", "entropy") if energy is None else ("entropy",)
        return Laws(
            energy,
            None,
            conserved_names,
            tuple(system.ledger_functions),
            (),
            balance_entries,
            unpromised_names,
            laws_in_mean,
            unknown,
        )
    quadratic = system.entropy is not None and system.entropy.is_quadratic
    exact = {"energy": {"energy"}, "entropy": {"entropy_law", *(["entropy_law_quadratic"] if quadratic else [])}}
    inexact = tuple(law for law, claims in exact.items() if not claims & method.preserves)
    ledger = tuple(system.ledger_functions)
    law_names = system.energy_law, system.entropy_law
    return Laws(*law_names, conserved_names, ledger, inexact, balance_entries, unpromised_names, unknown=unknown)
