"""Membranes and reactions between the bodies of a composed system."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.structures.extended import ParticleIndices

from ...dissipation.matter import Process
from ...errors import InputError
from ...functions.checks import traced_function_and_shape
from ...functions.conditions import checked_numbers, require_condition


class Membrane(Module):
    """A membrane that lets particles pass between two bodies: ``N_1' = L (mu_2 / T_2 - mu_1 / T_1 + …) = -N_2'``.

    Between equal temperatures ``J = L (mu_2 - mu_1) / T``; what the particles lose heats either body by half. Between
    bodies of different temperature the flux is driven by ``e (1/T_1 - 1/T_2) - (mu_1/T_1 - mu_2/T_2)``, with the energy
    ``e = (mu_1 + mu_2)/2 + s (T_1 + T_2)/2`` that a particle carries.

    Parameters
    ----------
    first, second : int or str
        The bodies, by number or by name.
    permeability : float, >= 0, or function of the whole state to one
        L (particles^2 / (entropy time)).
    species : int, or a pair of them
        Which of the particle numbers of a body, the same in both or one in each.
    carries : float
        s, the entropy that a particle carries.
    """

    first: int | str = eqx.field(static=True)
    second: int | str = eqx.field(static=True)
    permeability: jax.Array | Callable
    species: tuple[int, int] = eqx.field(static=True)
    carries: jax.Array

    def __init__(self, first, second, permeability, species: int | tuple[int, int] = 0, carries: float = 0.0):
        self.first, self.second = first, second
        self.permeability = _check_coefficient(permeability, "the permeability of a membrane")
        pair = (species, species) if isinstance(species, int) else species
        if not (isinstance(pair, tuple) and len(pair) == 2 and all(type(kind) is int for kind in pair)):
            raise InputError(f"the species of a membrane must be an integer or a pair of integers, got {species!r}")
        self.species = pair
        self.carries = checked_numbers(carries, "the entropy that a particle carries", ())
        require_condition(
            self.carries, lambda s: abs(s) < np.inf, "the entropy that a particle carries must be finite, got {value}"
        )

    def process(self, names: Sequence[str], structure: mf.ExtendedPhaseSpace) -> Process:
        """Return the process of the membrane between bodies of the given names, in states of a structure."""
        a, b = (_body_index(body, names) for body in (self.first, self.second))
        if a == b:
            raise InputError(f"a membrane must join two bodies, got {names[a]} twice")
        stoichiometry, sides = np.zeros(len(structure.particle_indices.N)), np.zeros((2, len(names)))
        for body, kind, sign in ((a, self.species[0], 1.0), (b, self.species[1], -1.0)):
            stoichiometry[_particle_index(body, kind, names, structure.particle_indices)] = sign
            sides[:, body] = 0.5, sign
        numbers, heat_shares, entropy_transport = (tuple(row.tolist()) for row in (stoichiometry, *sides))
        L = _check_state_function(self.permeability, structure.dim, "the permeability of a membrane")
        return Process(numbers, heat_shares, entropy_transport, self.carries, L)


class Reaction(Module):
    """A reaction among the particles of a body, ``N' = nu L A / T`` with the affinity ``A = -nu . mu``.

    It rests where ``nu . mu = 0``, the law of mass action of ideal gases. The rates of mass action themselves are those
    of ``L = (k_f prod n_educts - k_b prod n_products) T / A``, which is positive.

    Parameters
    ----------
    body : int or str
    stoichiometry : sequence of float
        nu, negative for what is used up: (-1, -1, 1) for A + B -> C.
    rate : float, >= 0, or function of the whole state to one
        L (particles^2 / (entropy time)).
    """

    body: int | str = eqx.field(static=True)
    stoichiometry: tuple[float, ...] = eqx.field(static=True)
    rate: jax.Array | Callable

    def __init__(self, body, stoichiometry: Sequence[float], rate):
        self.body, self.rate = body, _check_coefficient(rate, "the rate of a reaction")
        numbers = checked_numbers(stoichiometry, "the stoichiometry of a reaction")
        if numbers.ndim != 1 or not (np.isfinite(numbers).all() and np.any(numbers)):
            raise InputError(f"the stoichiometry of a reaction must be a row of finite numbers, got {numbers.tolist()}")
        self.stoichiometry = tuple(numbers.tolist())

    def process(self, names: Sequence[str], structure: mf.ExtendedPhaseSpace) -> Process:
        """Return the process of the reaction among bodies of the given names, in states of a structure."""
        body = _body_index(self.body, names)
        matter = structure.particle_indices
        indices = np.flatnonzero(matter.owner == body)
        if len(indices) != len(self.stoichiometry):
            raise InputError(
                f"a reaction in {names[body]} must have {len(indices)} stoichiometric numbers, "
                f"got {len(self.stoichiometry)}"
            )
        stoichiometry, heat_shares = np.zeros(len(matter.N)), np.zeros(len(names))
        stoichiometry[indices], heat_shares[body] = self.stoichiometry, 1.0
        no_transport = (0.0,) * len(names)
        L = _check_state_function(self.rate, structure.dim, "the rate of a reaction")
        return Process(tuple(stoichiometry.tolist()), tuple(heat_shares.tolist()), no_transport, jnp.zeros(()), L)


def _check_coefficient(coefficient, what: str) -> jax.Array | Callable:
    if callable(coefficient):
        return coefficient
    value = checked_numbers(coefficient, what, ())
    require_condition(value, lambda L: (L >= 0.0) & (np.inf > L), what + " must be >= 0 and finite, got {value}")
    return value


def _check_state_function(coefficient, dim: int, what: str) -> jax.Array | Callable:
    """Return a coefficient; a function is checked on states of shape (dim,)."""
    if not callable(coefficient):
        return coefficient
    return traced_function_and_shape(coefficient, [(dim,)], [()], what, f"a state of shape ({dim},)")[0]


def _body_index(body, names: Sequence[str]) -> int:
    if isinstance(body, str) and body in names:
        if list(names).count(body) > 1:
            raise InputError(f"{body!r} is the name of several bodies. Give the number of a body instead")
        return list(names).index(body)
    if isinstance(body, int) and not isinstance(body, bool) and 0 <= body < len(names):
        return body
    raise InputError(f"there is no body {body!r}. The bodies are {', '.join(names)}, counted from 0")


def _particle_index(body: int, kind: int, names: Sequence[str], matter: ParticleIndices) -> int:
    indices = np.flatnonzero(matter.owner == body)
    if not 0 <= kind < len(indices):
        raise InputError(f"{names[body]} has {len(indices)} kinds of particles, counted from 0, got the kind {kind}")
    return int(indices[kind])
