"""What a run is made of: the system and the method as they are run, and the laws that it will be judged by."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from manifolds._arrays import is_traced

from ..errors import InputError
from ..functions.checks import trace_energies
from ..functions.time_span import limit_times
from ..integrators import OneStepMethod, WithAttitude
from ..integrators.base import pullback_method
from ..integrators.fluctuating import noise_dimension
from ..results.status import Laws
from ..systems import (
    AttitudeSystem,
    DrivenSystem,
    EmbeddedSystem,
    LiePoissonSystem,
    System,
    embed_in_arrays,
    make_autonomous,
)
from ..tracing.caching import LRUCache, memoize
from .family import Family
from .fluctuations import Fluctuations

Result = TypeVar("Result")

MISSING_GROUP_MESSAGE = "an attitude is for a system with a group: give LiePoissonSystem one, such as group=mf.SO(3)"


def refuse_tracers(function: Callable[..., Result]) -> Callable[..., Result]:
    """Decorator: say that a run takes numbers, and what to take instead, where JAX traces its arguments."""

    @functools.wraps(function)
    def call(*arguments, **named) -> Result:
        try:
            return function(*arguments, **named)
        except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
            if not is_traced(arguments, named):
                raise
            raise InputError(
                "a run needs numbers, but jax.jit, jax.grad or jax.vmap traces its arguments. Use "
                "lt.flow(system, x0, t_span, step, method), which JAX compiles and differentiates"
            ) from error

    return call


def check_choice(what: str, given, choices: tuple[str, ...]) -> None:
    if given not in choices:
        *others, last = map(repr, choices)
        raise InputError(f"{what} must be {', '.join(others)} or {last}, not {given!r}")


def resolve_invariants(system: System, x0) -> System:
    """The system, with what it conserves found out near the states that a run starts from, where that is open."""
    return system.resolve_invariants_near(x0) if _has_undecided_invariants(system) else system


@memoize
def _has_undecided_invariants(system: System) -> bool:
    return not is_traced(system) and bool(system.undecided_functions())


@memoize
def prepare_run(
    system: System, method, noise: Fluctuations | None = None, tolerance: float | None = None
) -> tuple[System, Any]:
    """The system and the method as they are run, with adaptive steps of a tolerance or with given ones.

    With clock and work where the energy depends on time, with noise, with attitudes where there is a group, in charts
    on a manifold or in the space around it.
    """
    if not isinstance(method, OneStepMethod):
        if noise is not None:
            raise InputError(f"steps with noise are those of lt.MetriplecticMidpoint, and {method} has none")
        if system.needs_attitude:
            raise InputError(f"{method} follows no attitude, and the torque {system.torque_name} depends on it")
        return make_autonomous(system, unit=1.0), method  # its errors are measured component by component
    method = method if noise is None else noise.method_with_noise(make_autonomous(system), method)
    return prepare_for_method(system, method, tolerance, True)


@memoize
def prepare_for_method(
    system: System, method: OneStepMethod, tolerance: float | None = None, attitude: bool = False
) -> tuple[System, OneStepMethod]:
    """The same for a method of the library; attitudes where a torque depends on them, or where they are asked for."""
    found = make_autonomous(system if method.uses_charts else embed_in_arrays(system))
    method = trace_energies(pullback_method(method, found).on(found, tolerance), found.dim)
    wanted = system.reconstruction if isinstance(system, LiePoissonSystem) else None
    if wanted is None or not (attitude or system.needs_attitude):
        return found, method
    assert isinstance(found, LiePoissonSystem | DrivenSystem)
    kind = "exp" if method.explicit else wanted
    return AttitudeSystem(found, kind), WithAttitude(method, kind)


def initial_state(system: System, x0, t: float, attitude=None, batch: bool = False) -> jax.Array | np.ndarray:
    """The state of a run that starts from one of its user; or several, with ``batch``.

    Raises
    ------
    InputError
        If there is an attitude and no group.
    """
    if isinstance(system, AttitudeSystem):
        return system.initial_state(x0, attitude, batch, t)
    if attitude is not None:
        raise InputError(MISSING_GROUP_MESSAGE)
    return system.initial_state(x0, t, batch) if isinstance(system, DrivenSystem) else system.state_array(x0, batch)


def checked_initial_state(system: System, method, x0, t: float, attitude=None) -> jax.Array | np.ndarray:
    """The state of a run of a method that starts from one of its user.

    Raises
    ------
    InputError
        If there is an attitude and no group, or no run can start there.
    """
    x = initial_state(system, x0, t, attitude)
    if reason := why_not_startable(system, method, x):
        raise InputError(reason)
    return x


def why_not_startable(system: System, method, x) -> str:
    """Why no run can start at x, or at one of several states, in words; empty where one can."""
    spared = system.has_generator and (not isinstance(method, OneStepMethod) or method.explicit)
    reason = system.outside(x) or ("" if spared else system.why_singular(x))
    return reason and f"the run cannot start at this x0: {reason}"


def wrap_family(family: Family, system: System) -> Family:
    """The family of what the members are run as, where the system is what one of them is."""
    if isinstance(system, AttitudeSystem):
        return wrap_family(family, system.body).map_members(AttitudeSystem, system.reconstruction)
    if isinstance(system, EmbeddedSystem):
        return family.map_members(EmbeddedSystem, *system.projection_flags)
    return wrap_family(family, system.body).map_members(DrivenSystem) if isinstance(system, DrivenSystem) else family


MAX_LIMITED_SYSTEMS = 64
"""Systems with the spans of their runs that are held in memory, those last used."""

_limited_systems: LRUCache[tuple[System, System]] = LRUCache(MAX_LIMITED_SYSTEMS)


def limit_to_span(system: System, start: float, end: float) -> System:
    """Return a system as it is run, its functions of time evaluated at times from ``start`` to ``end`` only.

    One object for equal arguments, so that what is found for it is found once.
    """
    if not is_driven_run(system):
        return system
    if is_traced(system):
        return limit_times(system, start, end)
    # held with what it is made of, whose identity no other object takes meanwhile
    return _limited_systems.get_or_compute((id(system), start, end), lambda: (system, limit_times(system, start, end)))[
        1
    ]


def limit_family_to_span(family: Family, system: System, start: float, end: float) -> Family:
    """Return the family of what :func:`limit_to_span` makes of the members, where the system is one of them."""
    return family.map_members_with_numbers(limit_times, start, end) if is_driven_run(system) else family


def is_driven_run(system: System) -> bool:
    """Whether a system as it is run has a clock, since its functions depend on time."""
    return isinstance(system.body if isinstance(system, AttitudeSystem) else system, DrivenSystem)


@memoize
def invariants_and_laws(system: System, method) -> tuple[dict, Laws]:
    """What is recorded along a run and what is promised of it; raises InputError where the method cannot be used."""
    if isinstance(method, OneStepMethod):
        method.check(system)
    invariants = system.invariants()
    return invariants, promised_laws(system, method, invariants)


def promised_laws(system: System, method, invariants) -> Laws:
    """What the system promises and, of its invariants, what the method keeps."""
    keeps = method.preserves_function if isinstance(method, OneStepMethod) else lambda system, name: False
    constants = [*(name for name, (_, kept) in invariants.items() if kept), *system.constant_names]
    unknown = tuple(name for name, (_, kept) in invariants.items() if kept is None)
    conserved = tuple(name for name in constants if keeps(system, name))
    unpromised = tuple(name for name in constants if name not in conserved)
    if isinstance(method, OneStepMethod) and noise_dimension(method):  # what holds on paths, and what in the mean
        energy = "conserved" if system.energy_law == "conserved" else None
        mean = ("energy", "entropy") if energy is None else ("entropy",)
        return Laws(
            energy, None, conserved, tuple(system.ledger), (), system.balance_entries, unpromised, mean, unknown
        )
    quadratic = system.entropy is not None and system.entropy.is_quadratic
    exact = {"energy": {"energy"}, "entropy": {"entropy_law", *(["entropy_law_quadratic"] if quadratic else [])}}
    inexact = tuple(law for law, claims in exact.items() if not claims & method.preserves)
    ledger = tuple(system.ledger)
    of_both = system.energy_law, system.entropy_law
    return Laws(*of_both, conserved, ledger, inexact, system.balance_entries, unpromised, unknown=unknown)
