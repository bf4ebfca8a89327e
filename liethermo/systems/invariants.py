"""Find what a system conserves: its functions by name, each quantity once, and whether it keeps them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings
from manifolds._pytree_module import replace_fields

from ..functions.energy import Energy, function_name
from ..tracing.caching import memoize
from ..tracing.interpret import evaluate_at_points
from .conservation import dissipation_keeps_casimirs, function_rates_of_change, is_proportional, judge_conservation
from .interface import InvariantVerdicts, SystemInterface

System = TypeVar("System", bound=SystemInterface)

TEST_STATE_SCALES = (1.0, 1e-4, 1e4)
"""Scales of the random states at which it is tested which functions a system conserves."""

LARGE_STATE_DIM = 2_000
"""Number of state components above which one random state of each scale is tested."""

N_NEARBY_STATES = 4
"""Number of initial states near which conservation is tested too."""

NEARBY_RADII = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4)
"""Distances of the tested states from an initial state, relative to its norm."""

TEST_TIMES = (0.0, 0.7310585786300049, -1.618033988749895)
"""Times at which conservation is tested if the energy depends on time."""


# -- names ------------------------------------------------------------------------------------------------------------


def candidate_invariants(system: SystemInterface) -> dict[str, Energy]:
    """Return the functions that may be conserved, by name: momentum maps, preserved functions, Casimirs, each once."""
    casimirs, preserved_by_name = system.casimirs(), dict[str, Energy]()
    for name, L in zip(preserved_function_names(system), system.preserved_functions, strict=True):
        if name not in system.momentum_maps and name not in preserved_by_name:
            preserved_by_name[name] = L
    return system.momentum_maps | preserved_by_name | casimirs


def preserved_function_names(system: SystemInterface) -> tuple[str, ...]:
    """Return the names of the preserved functions of a system, those of :func:`candidate_invariants`."""
    return tuple(preserved_functions_by_number(system)) if system.preserved_labels is None else system.preserved_labels


def preserved_functions_by_number(system: SystemInterface) -> dict[str, Energy]:
    """Return the preserved functions of a system in a dict with the names "preserved 1", "preserved 2" and so on."""
    return {f"preserved {i + 1}": L for i, L in enumerate(system.preserved_functions)}


def find_preserved_function_names(system: SystemInterface) -> tuple[str, ...]:
    """Return a name for each preserved function: that of a map or Casimir of which it is a multiple, or its own."""
    functions = named_then_preserved_functions(system)
    states = random_test_states(system, 2)
    gradients = evaluate_at_points(stack_gradients, functions, states)  # shape (points, functions, n)
    proportional_indices = first_proportional_indices(gradients, len(system.preserved_functions))
    return name_preserved_functions(system, proportional_indices.tolist())


def named_then_preserved_functions(system: SystemInterface) -> tuple[Energy, ...]:
    """Return a tuple of the momentum maps and Casimirs of a system, followed by its preserved functions."""
    return (*(system.momentum_maps | system.casimirs()).values(), *system.preserved_functions)


def name_preserved_functions(system: SystemInterface, proportional_indices: Sequence[int]) -> tuple[str, ...]:
    """Return a name for each preserved function: that of an earlier function of which it is a multiple, or its own.

    Parameters
    ----------
    proportional_indices : sequence of int
        For each preserved function, the index in :func:`named_then_preserved_functions` of an earlier function of
        which it is a multiple; -1 if there is none.
    """
    names, reserved_names = list(system.momentum_maps | system.casimirs()), {"energy", "entropy"}
    n_named = len(names)
    for proportional_index, (fallback, L) in zip(
        proportional_indices, preserved_functions_by_number(system).items(), strict=True
    ):
        name = function_name(L)
        is_usable = name.isidentifier() and name not in {*names, *reserved_names}
        names.append(names[proportional_index] if proportional_index >= 0 else name if is_usable else fallback)
    return tuple(names[n_named:])


def stack_gradients(functions: tuple[Energy, ...], x) -> jax.Array:
    """Return the gradients of several functions at a state, shape (functions, n)."""
    return jnp.stack([f.gradient(x) for f in functions])


def first_proportional_indices(gradients: np.ndarray, n_last: int) -> np.ndarray:
    """Return for each of the last ``n_last`` functions the first earlier one of which it is a multiple, or -1.

    Parameters
    ----------
    gradients : array, shape (..., points, functions, n)

    Returns
    -------
    array of int, shape (..., n_last)
    """
    total = gradients.shape[-2]
    multiples = np.full((*gradients.shape[:-3], n_last), -1)
    for k, i in enumerate(range(total - n_last, total)):
        for j in reversed(range(i)):
            is_multiple = is_proportional(gradients[..., i, :], gradients[..., j, :])
            multiples[..., k] = np.where(is_multiple, j, multiples[..., k])
    return multiples


# -- verdicts ---------------------------------------------------------------------------------------------------------


def find_invariants(system: SystemInterface, near_states=None, include_declared: bool = True) -> InvariantVerdicts:
    """Return the names of conserved functions and of undecided ones.

    With ``include_declared`` an undecided function that is declared as preserved counts as conserved.
    """
    if system.invariant_verdicts is not None:
        return system.invariant_verdicts
    verdicts = (
        _memoized_conservation_verdicts(system) if near_states is None else _conservation_verdicts(system, near_states)
    )
    return InvariantVerdicts.from_verdicts(verdicts, preserved_function_names(system) if include_declared else ())


@with_library_settings
def undecided_function_names(system: SystemInterface) -> frozenset[str]:
    """Return the names of the functions of which the test could not decide whether they are conserved.

    The vector field could be evaluated at none of the test states, for example because the entropy is defined for few
    states.
    """
    return find_invariants(system, include_declared=False).undecided_names


def resolve_invariants_near(system: System, states) -> System:
    """Return the system with verdicts on its undecided functions, tested near given states of its domain.

    Parameters
    ----------
    states : array, shape (n,) or (m, n)
    """
    if system.invariant_verdicts is not None or is_traced(system) or not undecided_function_names(system):
        return system
    return replace_fields(system, invariant_verdicts=find_invariants(system, near_states=np.asarray(states)))


@memoize
def _memoized_conservation_verdicts(system: SystemInterface) -> dict[str, bool | None]:
    """Return whether each function of a system is conserved; the answer is cached by the content of the system."""
    return _conservation_verdicts(system)


def _conservation_verdicts(system: SystemInterface, near_states=None) -> dict[str, bool | None]:
    """Return by name whether each function is conserved, by construction or by a test; None if undecided."""
    claimed_names, torque = invariants_by_construction(system), system.torque_laws
    torque_free = system.casimirs().keys() - torque.changed_casimirs
    unclaimed_functions = {name: f for name, f in candidate_invariants(system).items() if name not in claimed_names}
    # a test says nothing of functions that a torque changes: the torque may be zero at the tested times only
    testable = {name: f for name, f in unclaimed_functions.items() if not torque.name or name in torque_free}
    with jax.ensure_compile_time_eval():  # JAX may be tracing something else
        verdicts = (
            [False] * len(testable)
            if is_traced(system)
            else are_conserved(system, tuple(testable.values()), near_states)
        )
    tested_verdicts = dict(zip(testable, verdicts, strict=True))
    return dict.fromkeys(unclaimed_functions, False) | tested_verdicts | dict.fromkeys(claimed_names, True)


def invariants_by_construction(system: SystemInterface) -> frozenset[str]:
    """Return the names of the functions that are conserved by construction and need no test."""
    constant_casimirs = system.casimirs().keys() if dissipation_keeps_casimirs(system) else frozenset()
    return frozenset(system.momentum_maps) | (constant_casimirs - system.torque_laws.changed_casimirs)


def recorded_functions_with_verdicts(system: SystemInterface) -> dict[str, tuple[Energy, bool | None]]:
    """Return the functions to record along a run, by name, each with True if conserved, False if not, else None."""
    if system.inner_system is not None:
        inner_verdicts = recorded_functions_with_verdicts(system.inner_system)
        return {name: (f.on(range(system.inner_system.dim)), verdict) for name, (f, verdict) in inner_verdicts.items()}
    verdicts = find_invariants(system)
    return {
        name: (function, None if name in verdicts.undecided_names else name in verdicts.conserved_names)
        for name, function in candidate_invariants(system).items()
    }


# -- the test ---------------------------------------------------------------------------------------------------------


def are_conserved(
    system: SystemInterface, functions: tuple[Energy, ...], near_states: np.ndarray | None = None
) -> list[bool | None]:
    """Return whether each function is constant along the vector field, at random states of several scales.

    The motion and every dissipation must each conserve the function, relative to their own size, however slow a
    dissipation is; otherwise their changes must cancel. Components that only count, such as a clock and the work, are
    left out, so that they set no scale.

    Parameters
    ----------
    near_states : array, shape (n,) or (m, n), optional
        States inside the domain: states near them are tested too.

    Returns
    -------
    list of bool or None
        None if the rate of change could be evaluated at no state.
    """
    if not functions:
        return []
    if (inner := system.inner_system) is not None:
        restricted_functions = tuple(_RestrictedEnergy(f, system.dim - inner.dim) for f in functions)
        return are_conserved(
            inner, restricted_functions, None if near_states is None else near_states[..., : inner.dim]
        )
    if system.is_driven:
        verdicts_by_time = [are_conserved(frozen, functions, near_states) for frozen in systems_at_test_times(system)]
        return [False if False in v else None if None in v else True for v in zip(*verdicts_by_time, strict=True)]
    points = random_test_states(system, n_test_states_per_scale(system))
    if near_states is not None:
        points = np.concatenate([points, states_near(system, near_states)])
    rates = evaluate_at_points(function_rates_of_change, (system, functions), points)
    is_defined, is_conserved = judge_conservation(rates)  # shapes (points, functions)
    flags_by_function = zip(is_defined.T, is_conserved.T, strict=True)
    return [bool(holds[is_valid].all()) if is_valid.any() else None for is_valid, holds in flags_by_function]


class _RestrictedEnergy(Energy):
    """A function of the inner state, computed from a function of a longer state with zeros appended."""

    energy: Energy
    n_extra: int = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(jnp.concatenate([x, jnp.zeros(self.n_extra)]))


def systems_at_test_times(system: System) -> list[System]:
    """Return the system frozen at each of :data:`TEST_TIMES`; at random attitudes too if a torque needs them."""
    if not system.torque_laws.needs_attitude:
        return [system.at_time(t) for t in TEST_TIMES]
    assert system.matrix_group is not None
    attitudes = system.matrix_group.random(0, (len(TEST_TIMES),), scale=1.0)
    return [system.at_time(t, attitude) for t, attitude in zip(TEST_TIMES, attitudes, strict=True)]


def random_test_states(system: SystemInterface, n_per_scale: int) -> np.ndarray:
    """Return random states, ``n_per_scale`` of each of :data:`TEST_STATE_SCALES`, shape (scales * n_per_scale, n)."""
    return np.concatenate([system.samples(n_per_scale, seed, scale) for seed, scale in enumerate(TEST_STATE_SCALES)])


def n_test_states_per_scale(system: SystemInterface) -> int:
    """Return the number of random states of each scale that a test of conservation uses."""
    return 4 if system.dim <= LARGE_STATE_DIM else 1


def states_near(system: SystemInterface, states) -> np.ndarray:
    """Return some of the given states, shape (m, n), and on R^n also states around them at decreasing distances."""
    states = np.reshape(np.asarray(states), (-1, system.dim))[:N_NEARBY_STATES]
    if system.space is not None:
        return states
    random = np.random.default_rng(0).standard_normal((len(NEARBY_RADII), *states.shape))
    lengths = np.linalg.norm(states, axis=1, keepdims=True) / np.sqrt(system.dim)
    return np.concatenate(
        [states, *(states + radius * lengths * w for radius, w in zip(NEARBY_RADII, random, strict=True))]
    )
