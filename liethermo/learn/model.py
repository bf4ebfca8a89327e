"""Metriplectic systems with learned parts, and the scaling of their networks to the data."""

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
from .parts import Energy, Entropy, Friction, Network, Poisson, extend_poisson, learned_mask

T = TypeVar("T", bound=System)


class Metriplectic(MetriplecticSystem):
    """Metriplectic system ``x' = Pi(x) grad H + K(x) grad S`` with learned parts; both laws hold for all weights.

    Each part that is not given is learned by its own network. Every method can integrate the system, with exact laws in
    every step.

    Parameters
    ----------
    dim : int
        Number of state components.
    energy, entropy : Energy, or function from x, shape (dim,), to a scalar; optional
        Known, learned [:class:`Energy`, :class:`Entropy`], or the sum of both.
    poisson : manifolds.PoissonStructure, skew matrix or function from x to one; optional
        Known, or :class:`Poisson`. A structure of fewer coordinates acts on the first components; the others, such as
        entropies, are constant without friction.
    friction : Dissipation, list of them, or None; optional
        Known, or :class:`Friction`; None for a system without friction.
    width, depth, rank : int
        Size of the networks, and rank of the friction.
    seed : int
        Seed of the initial weights.
    validate : bool
        If the Poisson tensor is known, test the axioms at a few random points: an entropy that is not constant along
        the Hamiltonian motion is refused, learned or not. A learned tensor has the gradient of the entropy in its
        kernel.

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
                raise InputError(f"friction must be a Dissipation, a list of them, 'learned' or None, got {friction!r}")
            friction = Friction(dim, rank, width=width, depth=depth, seed=4 * seed + 3)
        has_learned_tensor = isinstance(poisson, Poisson)  # but for the Jacobi identity
        super().__init__(poisson, energy, entropy, friction, dim=dim, validate=validate and not has_learned_tensor)
        self.poisson = fill_poisson_entropy(self.poisson, self.entropy)


def fill_poisson_entropy(poisson: mf.PoissonStructure, entropy: AnyEnergy | None) -> mf.PoissonStructure:
    """Return the structure with the system's entropy filled in, if it is a learned one that needs it."""
    if not isinstance(poisson, Poisson) or poisson.entropy is None:
        return poisson
    return eqx.tree_at(lambda p: p.entropy, poisson, entropy)


def copy_entropy_to_poisson(system: T) -> T:
    """Return the system with the current weights of its entropy also in its Poisson structure."""
    return eqx.tree_at(lambda s: s.poisson, system, fill_poisson_entropy(system.poisson, system.entropy))


def scale_networks(system: T, scales: DataScales, points: np.ndarray) -> T:
    """Return the system with its networks scaled to the data, so that their inputs and outputs are of order one.

    Networks that have scales already are not changed.

    Parameters
    ----------
    scales : DataScales
        Scales of the data.
    points : array, shape (m, n)
        Some states.
    """
    x, s, tau = jnp.asarray(points), jnp.asarray(scales.scale), scales.time_scale

    def mean_variation(function: AnyEnergy) -> float:
        """Return the mean variation of a known function over the data."""
        return float(jnp.mean(jnp.abs(jax.vmap(function.gradient)(x) * s)))

    energy = entropy = 1.0
    poisson = system.poisson
    if not has_learned_parts(system.energy):
        energy = mean_variation(system.energy)
    elif not has_learned_parts(poisson):
        tensor = jnp.mean(jnp.abs(jax.vmap(poisson.tensor)(x)), axis=0)
        max_entry = float(jnp.max(tensor / jnp.outer(s, s)))
        energy = 1.0 / (tau * max_entry) if max_entry > 0.0 else 1.0
    if system.entropy is not None and not has_learned_parts(system.entropy):
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

    def map_leaves(leaf_class, tree, change):
        return jax.tree_util.tree_map(change, tree, is_leaf=lambda part: isinstance(part, leaf_class))

    parts: dict[str, Any] = {
        "energy": _fill_network_scales(system.energy, x, energy),
        "entropy": _fill_network_scales(system.entropy, x, entropy),
        "dissipation": map_leaves(Friction, system.dissipation, scale_friction),
    }
    if isinstance(poisson, Poisson):
        scaled_function = _fill_network_scales(poisson.function, x, pairs / (energy * tau))
        poisson = eqx.tree_at(lambda p: (p.function, p.metric), poisson, (scaled_function, s**2))
    parts["poisson"] = poisson
    names = list(parts)
    present_names = [name for name in names if parts[name] is not None]
    scaled_system = eqx.tree_at(
        lambda m: [getattr(m, name) for name in present_names], system, [parts[name] for name in present_names]
    )
    return copy_entropy_to_poisson(scaled_system)


def has_learned_parts(tree: Any) -> bool:
    """Return True if a pytree has learned parts."""
    return any(jax.tree_util.tree_leaves(learned_mask(tree)))


def _fill_network_scales(tree: Any, x: jax.Array, output_unit) -> Any:
    """Set the input scales of the networks in a pytree from points x, and their output unit, unless they are set
    already."""

    def scale_part(part):
        if isinstance(part, Pullback):
            inner = _fill_network_scales(part.term, jax.vmap(part.coordinates)(x), output_unit)
            return eqx.tree_at(lambda p: p.term, part, inner)
        if not isinstance(part, Network) or not part.has_default_scales:
            return part
        spread = jnp.std(x, axis=0)
        spread = jnp.where(spread > 0.0, spread, 1.0)
        return Network(jnp.mean(x, axis=0), spread, output_unit * part.output_scale, part.function)

    return jax.tree_util.tree_map(scale_part, tree, is_leaf=lambda part: isinstance(part, Pullback | Network))
