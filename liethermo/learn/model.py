"""Metriplectic systems of which any part is learned, and the units in which their networks work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation.base import Dissipation
from ..errors import InputError
from ..functions.energy import Energy as AnyEnergy
from ..functions.energy import Pullback, make_energy
from ..systems import MetriplecticSystem, System
from .data import DataScales
from .networks import Network, learned_mask
from .parts import Energy, Entropy, Friction, Poisson, extend_poisson

T = TypeVar("T", bound=System)


class Metriplectic(MetriplecticSystem):
    """``x' = Pi(x) grad H + K(x) grad S`` of which any part is learned: both laws hold before, during and after that.

    What is not given is learned by a network of its own. A system like any other: every method runs it, with its laws
    exact in every step.

    Parameters
    ----------
    dim : int
        Number of state components.
    energy, entropy : Energy, or function from x, shape (dim,), to a scalar; optional
        Known, learned [:class:`Energy`, :class:`Entropy`], or the sum of both.
    poisson : manifolds.PoissonStructure, skew matrix or function from x to one; optional
        Known, or :class:`Poisson`. One of fewer coordinates is that of the first components: the others, such as
        entropies, are at rest without friction.
    friction : Dissipation, list of them, or None; optional
        Known, or :class:`Friction`; None of a system without.
    width, depth, rank : int
        Of the networks, and of the friction.
    seed : int
        Of the first weights.
    validate : bool
        Where the Poisson tensor is known, test the axioms at a few random points: an entropy that is not constant along
        its motions is refused, learned or not. A learned tensor has the entropy in its kernel.

    Raises
    ------
    CasimirError, AxiomError, FunctionError, InputError
    """

    def __init__(
        self,
        dim: int,
        energy: AnyEnergy | Callable | None = None,
        entropy: AnyEnergy | Callable | None = None,
        poisson: mf.PoissonStructure | Callable | Any | None = None,
        friction: Dissipation | Sequence[Dissipation] | str | None = "learned",
        width: int = 32,
        depth: int = 2,
        rank: int = 1,
        seed: int = 0,
        validate: bool = True,
    ):
        energy = Energy(dim, width, depth, 4 * seed) if energy is None else make_energy(energy, "the energy")
        entropy = Entropy(dim, width, depth, 4 * seed + 1) if entropy is None else make_energy(entropy, "the entropy")
        if poisson is None:
            poisson = Poisson(dim, width, depth, 4 * seed + 2)
        if isinstance(poisson, Poisson):
            poisson = eqx.tree_at(lambda p: p.entropy, poisson, entropy, is_leaf=lambda part: part is None)
        elif isinstance(poisson, mf.PoissonStructure) and poisson.dim is not None:
            poisson = extend_poisson(poisson, dim)
        if isinstance(friction, str):
            if friction != "learned":
                raise InputError(f"friction is a Dissipation, a list of them, 'learned' or None, not {friction!r}")
            friction = Friction(dim, rank, width=width, depth=depth, seed=4 * seed + 3)
        by_form = isinstance(poisson, Poisson)  # but for the Jacobi identity
        super().__init__(poisson, energy, entropy, friction, dim=dim, validate=validate and not by_form)
        self.poisson = poisson_with_entropy(self.poisson, self.entropy)


def poisson_with_entropy(poisson: mf.PoissonStructure, entropy: AnyEnergy | None) -> mf.PoissonStructure:
    """The structure with the entropy of its system in it, where it is one that has to know it."""
    if not isinstance(poisson, Poisson) or poisson.entropy is None:
        return poisson
    return eqx.tree_at(lambda p: p.entropy, poisson, entropy)


def tie_entropy(system: T) -> T:
    """The system with the weights of its entropy wherever that occurs."""
    return eqx.tree_at(lambda s: s.poisson, system, poisson_with_entropy(system.poisson, system.entropy))


def scale_networks(system: T, found: DataScales, points: np.ndarray) -> T:
    """The system with networks that work on numbers of the size of one; those that do already are left alone.

    Parameters
    ----------
    found : Scales
        Of the data.
    points : array, shape (m, n)
        Some states.
    """
    x, s, tau = jnp.asarray(points), jnp.asarray(found.scale), found.time_scale

    def mean_variation(function: AnyEnergy) -> float:
        """What a known function varies by over the data."""
        return float(jnp.mean(jnp.abs(jax.vmap(function.gradient)(x) * s)))

    energy = entropy = 1.0
    poisson = system.poisson
    if not has_networks(system.energy):
        energy = mean_variation(system.energy)
    elif not has_networks(poisson):
        tensor = jnp.mean(jnp.abs(jax.vmap(poisson.tensor)(x)), axis=0)
        largest = float(jnp.max(tensor / jnp.outer(s, s)))
        energy = 1.0 / (tau * largest) if largest > 0.0 else 1.0
    if system.entropy is not None and not has_networks(system.entropy):
        entropy = mean_variation(system.entropy)
    entropy = entropy if entropy > 0.0 else 1.0
    energy = energy if energy > 0.0 else 1.0
    pairs = jnp.outer(s, s)[np.triu_indices(system.dim, 1)]

    def scale_friction(part):
        if isinstance(part, Friction):
            root = jnp.sqrt(entropy * tau)
            unit = pairs / (energy * root) if part.construction == "skew" else s / root
            inner = _fill_network_scales(part.function, x, jnp.tile(unit, part.rank))
            return eqx.tree_at(lambda p: (p.function, p.metric), part, (inner, s**2))
        return part

    def map_instances(kind, tree, change):
        return jax.tree_util.tree_map(change, tree, is_leaf=lambda part: isinstance(part, kind))

    parts: dict[str, Any] = {
        "energy": _fill_network_scales(system.energy, x, energy),
        "entropy": _fill_network_scales(system.entropy, x, entropy),
        "dissipation": map_instances(Friction, system.dissipation, scale_friction),
    }
    if isinstance(poisson, Poisson):
        inner = _fill_network_scales(poisson.function, x, pairs / (energy * tau))
        poisson = eqx.tree_at(lambda p: (p.function, p.metric), poisson, (inner, s**2))
    parts["poisson"] = poisson
    names = list(parts)
    there = [name for name in names if parts[name] is not None]
    changed = eqx.tree_at(lambda m: [getattr(m, name) for name in there], system, [parts[name] for name in there])
    return tie_entropy(changed)


def has_networks(tree: Any) -> bool:
    """Whether anything in a pytree is learned."""
    return any(jax.tree_util.tree_leaves(learned_mask(tree)))


def _fill_network_scales(tree: Any, x: jax.Array, unit) -> Any:
    """The networks in a pytree with the scales of their inputs, and outputs in a unit, unless they have scales."""

    def change(part):
        if isinstance(part, Pullback):
            inner = _fill_network_scales(part.term, jax.vmap(part.coordinates)(x), unit)
            return eqx.tree_at(lambda p: p.term, part, inner)
        if not isinstance(part, Network) or not part.has_default_scales:
            return part
        spread = jnp.std(x, axis=0)
        spread = jnp.where(spread > 0.0, spread, 1.0)
        return Network(jnp.mean(x, axis=0), spread, unit * part.output_scale, part.function)

    return jax.tree_util.tree_map(change, tree, is_leaf=lambda part: isinstance(part, Pullback | Network))
