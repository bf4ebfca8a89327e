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
from .conservation import dissipation_keeps_casimirs, is_proportional, judge_conservation, rates_of_change
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


def named_functions(system: SystemInterface) -> dict[str, Energy]:
    """Return momentum maps, functions that the dissipation preserves, and Casimirs, by name, each quantity once."""
    casimirs, preserved = system.casimirs(), dict[str, Energy]()
    for name, L in zip(preserved_names(system), system.preserved, strict=True):
        if name not in system.momentum_maps and name not in preserved:
            preserved[name] = L
    return system.momentum_maps | preserved | casimirs


def preserved_names(system: SystemInterface) -> tuple[str, ...]:
    """Return the names of the functions ``system.preserved`` among :func:`named_functions`."""
    return tuple(preserved_by_name(system)) if system.preserved_labels is None else system.preserved_labels


def preserved_by_name(system: SystemInterface) -> dict[str, Energy]:
    """Return the functions ``system.preserved`` by numbered names."""
    return {f"preserved {i + 1}": L for i, L in enumerate(system.preserved)}


def find_preserved_names(system: SystemInterface) -> tuple[str, ...]:
    """Return names of the preserved functions: of the map or Casimir that each is a multiple of, or new ones."""
    functions = functions_for_naming(system)
    gradients = evaluate_at_points(stack_gradients, functions, random_states(system, 2))  # shape (points, functions, n)
    return names_from_multiples(system, first_multiple_indices(gradients, len(system.preserved)).tolist())


def functions_for_naming(system: SystemInterface) -> tuple[Energy, ...]:
    """Return momentum maps and Casimirs, followed by the preserved functions, which may be multiples of them."""
    return (*(system.momentum_maps | system.casimirs()).values(), *system.preserved)


def names_from_multiples(system: SystemInterface, multiples: Sequence[int]) -> tuple[str, ...]:
    """Return a name for each preserved function: that of a known function of which it is a multiple, or else its
    own.

    Parameters
    ----------
    multiples : sequence of int
        For each preserved function, the index in :func:`functions_for_naming` of an earlier function of which it is a
        multiple; -1 if there is none.
    """
    names, reserved = list(system.momentum_maps | system.casimirs()), {"energy", "entropy"}
    n_named = len(names)
    for multiple, (fallback, L) in zip(multiples, preserved_by_name(system).items(), strict=True):
        name = function_name(L)
        usable = name.isidentifier() and name not in {*names, *reserved}
        names.append(names[multiple] if multiple >= 0 else name if usable else fallback)
    return tuple(names[n_named:])


def stack_gradients(functions: tuple[Energy, ...], x) -> jax.Array:
    """Return the gradients of several functions at a state, shape (functions, n)."""
    return jnp.stack([f.gradient(x) for f in functions])


def first_multiple_indices(gradients: np.ndarray, count: int) -> np.ndarray:
    """Return for each of the last ``count`` functions the first one before it of which it is a multiple, or -1.

    Parameters
    ----------
    gradients : array, shape (..., points, functions, n)

    Returns
    -------
    array of int, shape (..., count)
    """
    total = gradients.shape[-2]
    multiples = np.full((*gradients.shape[:-3], count), -1)
    for k, i in enumerate(range(total - count, total)):
        for j in reversed(range(i)):
            alike = is_proportional(gradients[..., i, :], gradients[..., j, :])
            multiples[..., k] = np.where(alike, j, multiples[..., k])
    return multiples


# -- verdicts ---------------------------------------------------------------------------------------------------------


def find_invariants(system: SystemInterface, near=None, include_declared: bool = True) -> InvariantVerdicts:
    """Return which functions are conserved; ``include_declared`` adds preserved ones unless a test refutes them."""
    if system.invariant_verdicts is not None:
        return system.invariant_verdicts
    verdicts = _memoized_verdicts(system) if near is None else _conservation_verdicts(system, near)
    return InvariantVerdicts.from_verdicts(verdicts, preserved_names(system) if include_declared else ())


@with_library_settings
def undecided_functions(system: SystemInterface) -> frozenset[str]:
    """Return the names of the functions for which the test of conservation could not decide.

    The vector field could be evaluated at none of the test states, for example because the entropy is defined for few
    states.
    """
    return find_invariants(system, include_declared=False).undecided_names


def resolve_invariants_near(system: System, states) -> System:
    """Return the system with the undecided functions tested near states in its domain.

    Parameters
    ----------
    states : array, shape (n,) or (m, n)
    """
    if system.invariant_verdicts is not None or is_traced(system) or not undecided_functions(system):
        return system
    return replace_fields(system, invariant_verdicts=find_invariants(system, near=np.asarray(states)))


@memoize
def _memoized_verdicts(system: SystemInterface) -> dict[str, bool | None]:
    return _conservation_verdicts(system)


def _conservation_verdicts(system: SystemInterface, near=None) -> dict[str, bool | None]:
    """Return whether each function is conserved, by construction or by a test; None if undecided."""
    claimed, torque = invariants_by_construction(system), system.torque_laws
    torque_free = system.casimirs().keys() - torque.changed_casimirs
    unclaimed = {name: f for name, f in named_functions(system).items() if name not in claimed}
    # a test says nothing of functions that a torque changes: the torque may be zero at the tested times only
    testable = {name: f for name, f in unclaimed.items() if not torque.name or name in torque_free}
    with jax.ensure_compile_time_eval():  # JAX may be tracing something else
        verdicts = [False] * len(testable) if is_traced(system) else conserves(system, tuple(testable.values()), near)
    tested = dict(zip(testable, verdicts, strict=True))
    return dict.fromkeys(unclaimed, False) | tested | dict.fromkeys(claimed, True)


def invariants_by_construction(system: SystemInterface) -> frozenset[str]:
    """Return the names of the functions that are conserved by construction and need no test."""
    constant_casimirs = system.casimirs().keys() if dissipation_keeps_casimirs(system) else frozenset()
    return frozenset(system.momentum_maps) | (constant_casimirs - system.torque_laws.changed_casimirs)


def recorded_functions_with_verdicts(system: SystemInterface) -> dict[str, tuple[Energy, bool | None]]:
    """Return functions to record along a run, by name, each with whether it is conserved; None if not known."""
    if system.inner is not None:
        inner_verdicts = recorded_functions_with_verdicts(system.inner)
        return {name: (f.on(range(system.inner.dim)), verdict) for name, (f, verdict) in inner_verdicts.items()}
    verdicts = find_invariants(system)
    return {
        name: (function, None if name in verdicts.undecided_names else name in verdicts.conserved_names)
        for name, function in named_functions(system).items()
    }


# -- the test ---------------------------------------------------------------------------------------------------------


def conserves(
    system: SystemInterface, functions: tuple[Energy, ...], near: np.ndarray | None = None
) -> list[bool | None]:
    """Return whether each function is constant along the vector field, at random states of several scales.

    The motion and every dissipation must each conserve the function, relative to their own size, however slow a
    dissipation is; otherwise their changes must cancel. Components that only count, such as a clock and the work, are
    left out, so that they set no scale.

    Parameters
    ----------
    near : array, shape (n,) or (m, n), optional
        States inside the domain: states near them are tested too.

    Returns
    -------
    list of bool or None
        None if the rate of change could be evaluated at no state.
    """
    if not functions:
        return []
    if (inner := system.inner) is not None:
        restricted = tuple(_InnerEnergy(f, system.dim - inner.dim) for f in functions)
        return conserves(inner, restricted, None if near is None else near[..., : inner.dim])
    if system.is_driven:
        by_time = [conserves(frozen, functions, near) for frozen in systems_at_test_times(system)]
        return [False if False in v else None if None in v else True for v in zip(*by_time, strict=True)]
    points = random_states(system, n_random_states(system))
    if near is not None:
        points = np.concatenate([points, states_near(system, near)])
    rates = evaluate_at_points(rates_of_change, (system, functions), points)
    is_defined, is_conserved = judge_conservation(rates)  # shapes (points, functions)
    by_function = zip(is_defined.T, is_conserved.T, strict=True)
    return [bool(conserved[defined].all()) if defined.any() else None for defined, conserved in by_function]


class _InnerEnergy(Energy):
    """A function of the inner state, from a function of a longer state that depends on no more."""

    energy: Energy
    n_extra: int = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(jnp.concatenate([x, jnp.zeros(self.n_extra)]))


def systems_at_test_times(system: System) -> list[System]:
    """Return the system frozen at each of :data:`TEST_TIMES`, and at a random attitude if a torque needs one."""
    if not system.torque_laws.needs_attitude:
        return [system.at_time(t) for t in TEST_TIMES]
    assert system.matrix_group is not None
    attitudes = system.matrix_group.random(0, (len(TEST_TIMES),), scale=1.0)
    return [system.at_time(t, attitude) for t, attitude in zip(TEST_TIMES, attitudes, strict=True)]


def random_states(system: SystemInterface, count: int) -> np.ndarray:
    """Return random states at which functions are compared, ``count`` of each of :data:`TEST_STATE_SCALES`."""
    return np.concatenate([system.samples(count, seed, scale) for seed, scale in enumerate(TEST_STATE_SCALES)])


def n_random_states(system: SystemInterface) -> int:
    """Return the number of random states of each scale at which conservation is tested."""
    return 4 if system.dim <= LARGE_STATE_DIM else 1


def states_near(system: SystemInterface, x) -> np.ndarray:
    """Return a few of the states x, shape (m, n), and on R^n states around them at decreasing distances."""
    x = np.reshape(np.asarray(x), (-1, system.dim))[:N_NEARBY_STATES]
    if system.space is not None:
        return x
    random = np.random.default_rng(0).standard_normal((len(NEARBY_RADII), *x.shape))
    lengths = np.linalg.norm(x, axis=1, keepdims=True) / np.sqrt(system.dim)
    return np.concatenate([x, *(x + radius * lengths * w for radius, w in zip(NEARBY_RADII, random, strict=True))])
