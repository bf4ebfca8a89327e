"""Base class of the energies of spins on a lattice, and checks of their parameters."""

from __future__ import annotations

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arguments import is_integer
from manifolds._arrays import is_traced
from manifolds.structures.spins import (
    Lattice as PeriodicSpins,
)
from manifolds.structures.spins import (
    VectorComponents,
    reshape_vectors,
    spin_components_from_state,
    state_from_spin_components,
)

from ...errors import InputError
from ..checks import checked_energy
from ..conditions import checked_numbers
from ..energy import Energy, make_energy
from ..flat_states import functions_of_flat_states
from .lattices import Lattice


class SpinEnergy(Energy):
    """A polynomial energy of spins on a lattice, computed component by component on arrays of the shape of the sites.

    Attributes
    ----------
    sites : tuple of int
    interaction_range : tuple of int
        Largest distance, along each axis, of two spins that interact.
    """

    sites: tuple[int, ...] = eqx.field(static=True)

    @property
    def interaction_range(self) -> tuple[int, ...]:
        return (0,) * len(self.sites)

    @abstractmethod
    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        """Return the energy of the spins, shape ()."""

    @abstractmethod
    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        """Return the gradient by each spin, as three arrays of components of the shape of the sites."""

    @property
    def is_quadratic(self) -> bool:
        return True

    def __neg__(self) -> Energy:
        return self.multiple(-1.0)

    def value(self, x) -> jax.Array:
        return self.lattice_value(PeriodicSpins(lattice_spin_components(x, self.sites)))

    def gradient(self, x) -> jax.Array:
        return flatten_covectors(self.lattice_gradients(PeriodicSpins(lattice_spin_components(x, self.sites))), x)

    def check_components(self, dim: int, role: str) -> None:
        check_spin_count(self.sites, dim, role)

    def flattened_states(self, x) -> jax.Array:
        return flattened_spins(x, self.sites)


def lattice_spin_components(x, sites: tuple[int, ...], planar: bool = False) -> VectorComponents:
    """Return the components of the spins of a state, each of the shape of the sites."""
    return reshape_vectors(spin_components_from_state(x, math.prod(sites), planar), sites)


def flatten_covectors(covectors: VectorComponents, x, planar: bool = False) -> jax.Array:
    """Return covectors of the spins as one covector of the state x."""
    return state_from_spin_components(
        reshape_vectors(covectors, (-1,)), jnp.zeros(x.size - 3 * covectors[0].size), planar
    )


def lattice_shape(sites) -> tuple[int, ...]:
    """Return the shape of a lattice as a tuple; an integer becomes a tuple of one entry."""
    if isinstance(sites, Lattice):
        return sites.sites
    shape = tuple(sites) if isinstance(sites, tuple | list) else (sites,)
    is_valid = all(is_integer(n) and n >= 1 for n in shape)
    if not shape or not is_valid:
        raise InputError(f"sites must be a positive integer, or a tuple for a lattice such as (64, 64), got {sites!r}")
    return tuple(int(n) for n in shape)


def flattened_spins(x, sites: tuple[int, ...]) -> jax.Array:
    """Return states, shape (..., n), from such states or from spins, shape ``(..., *sites, 3)``.

    Raises
    ------
    InputError
        If the shape is neither.
    """
    n, shape = 3 * math.prod(sites), (*sites, 3)
    if x.shape[-1:] >= (n,):
        return x
    if x.shape[-len(shape) :] != shape:
        raise InputError(f"spins must have shape (..., {', '.join(map(str, shape))}) or (..., {n}), got {x.shape}")
    return x.reshape(*x.shape[: -len(shape)], n)


def energy_of_spins(energy, sites: tuple[int, ...]) -> Energy:
    """Return an energy of spins as a checked energy of flat states.

    Parameters
    ----------
    energy : Energy, function from the spins, shape ``(*sites, 3)``, to a scalar, or list of them
    sites : tuple of int

    Raises
    ------
    InputError, FunctionError
        If the energy depends on time, or does not map spins of this shape to one real number.
    """
    function = make_energy(energy, "the energy")
    if function.depends_on_time:
        raise InputError(
            "the energy must be a function of the spins alone, but it depends on time. Give it at one time t: "
            "energy.at_time(t) in place of an Energy, lambda s: f(s, t) in place of a function f"
        )
    return checked_energy(functions_of_flat_states(function, (*sites, 3)), 3 * math.prod(sites), "the energy")


def check_spin_count(sites: tuple[int, ...], dim: int, role: str) -> None:
    """Raise InputError if a state has fewer components than the spins of a term."""
    count = math.prod(sites)
    if 3 * count > dim:
        raise InputError(f"{role} has a term of {count} spins, so the state needs {3 * count} components, got {dim}")


def checked_site_values(value, shape, entry_shape: tuple[int, ...], quantity_name: str) -> jax.Array:
    """Return a value, given once or for each site, as an array; InputError unless its shape fits and it is finite."""
    array = checked_numbers(value, quantity_name)
    if array.shape not in (entry_shape, (*shape, *entry_shape)):
        expected_shapes = f"{entry_shape} or {(*shape, *entry_shape)}" if entry_shape else f"() or {shape}"
        raise InputError(f"{quantity_name} must have shape {expected_shapes}, got {array.shape}")
    return check_finite(array, quantity_name)


def checked_finite_numbers(value, quantity_name: str, *shapes: tuple[int, ...]) -> jax.Array:
    """Return a user's numbers as an array of float64; InputError unless their shape fits and they are finite."""
    return check_finite(checked_numbers(value, quantity_name, *shapes), quantity_name)


def check_spin_lengths(spins) -> None:
    """Raise InputError if a spin, along the last axis of an array of numbers, has the length zero."""
    if not np.linalg.norm(np.asarray(spins), axis=-1).all():
        raise InputError("every spin must have a length greater than 0")


def check_finite(array: jax.Array, quantity_name: str) -> jax.Array:
    """Return an array; raise InputError unless its numbers are finite."""
    if not is_traced(array) and not np.isfinite(np.asarray(array)).all():
        raise InputError(f"{quantity_name} must be finite, got {np.asarray(array).tolist()}")
    return array


def bond_component_indices(first_sites, second_sites) -> np.ndarray:
    """Return the indices into a state of the components of both spins of each bond, shape (bonds, 6).

    The spins are given by their site numbers, shape (bonds,) each.
    """
    ends = np.stack([first_sites, second_sites], axis=1)
    return (3 * ends[:, :, None] + np.arange(3)).reshape(len(ends), 6)
