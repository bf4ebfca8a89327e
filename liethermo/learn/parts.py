"""Learned systems: neural networks in the units of the data, and energies, entropies, tensors and frictions of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arguments import is_integer
from manifolds._pytree_module import Module
from manifolds.matrices.linear import skew_matrix

from ..dissipation.base import Dissipation
from ..dissipation.factor import Factor
from ..errors import InputError
from ..functions.energy import Energy as AnyEnergy
from ..functions.energy import Function, Pullback, make_energy
from ..systems import MetriplecticSystem, System
from ..systems.baths import poisson_with_baths
from ..tracing.traced import TracedFunction
from .data import DataScales


class Learned(Module):
    """A function whose floating-point arrays are parameters that :func:`liethermo.learn.fit` learns.

    Calling it calls the function. Arrays outside of such marks are not changed by a fit.

    Parameters
    ----------
    function : function of arrays, such as an ``equinox.Module``
        The function with the fitted parameters.
    """

    function: Callable

    def __call__(self, *arguments):
        return _call_jitted(self.function, arguments)


@eqx.filter_jit
def _call_jitted(function: Callable, arguments: tuple):
    """Call a function under ``jit``, so that a compiled program has one routine for all calls of it."""
    return function(*arguments)


class Perceptron(Module):
    """A multilayer perceptron ``W_d tanh(... tanh(W_0 x + b_0) ...) + b_d``, with random weights.

    Parameters
    ----------
    sizes : sequence of int
        Widths of the input, the hidden layers and the output.
    seed : int
    """

    weights: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]

    def __init__(self, sizes, seed: int):
        random = np.random.default_rng(seed)
        pairs = list(itertools.pairwise(sizes))
        self.weights = tuple(jnp.asarray(random.standard_normal((m, n)) / np.sqrt(n)) for n, m in pairs)
        self.biases = tuple(jnp.asarray(0.1 * random.standard_normal(m)) for _, m in pairs)

    def __call__(self, x):
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = jnp.tanh(W @ x + b)
        return self.weights[-1] @ x + self.biases[-1]


class Network(Module):
    """A scaled network ``output_scale * function((x - centre) / scale)`` whose inner values are of order one.

    Attributes
    ----------
    centre, scale : array, shape (m,)
        Mean and standard deviation of the inputs over the data, which :func:`liethermo.learn.fit` fills in.
    output_scale : array, shape (outputs,)
        Scale of the outputs, which :func:`liethermo.learn.fit` fills in.
    function : Learned
    """

    centre: jax.Array
    scale: jax.Array
    output_scale: jax.Array
    function: Learned

    @classmethod
    def from_sizes(cls, dim: int, outputs: int, width: int, depth: int, seed: int) -> Network:
        """Return a perceptron with ``depth`` hidden layers of ``width`` neurons, with default scales."""
        for name, value in {"the number of components": dim, "width": width, "depth": depth}.items():
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(f"{name} must be a positive integer, got {value!r}")
        if not is_integer(seed) or seed < 0:
            raise InputError(f"seed must be an integer >= 0, got {seed!r}")
        layers = Perceptron([dim, *[width] * depth, outputs], int(seed))
        return cls(jnp.zeros(dim), jnp.ones(dim), jnp.ones(outputs), Learned(layers))

    @property
    def has_default_scales(self) -> bool:
        """True if no scales have been filled in."""
        fields = ((self.centre, 0.0), (self.scale, 1.0), (self.output_scale, 1.0))
        return all(bool(np.all(np.asarray(values) == default)) for values, default in fields)

    def __call__(self, x):
        return self.output_scale * self.function((x - self.centre) / self.scale)


def learned_mask(tree: Any) -> Any:
    """Return a pytree with True for each learned array; a subtree without any is a single False.

    Constants in plain functions inside a mark are not learned.
    """

    def is_parameter(node):
        return False if isinstance(node, TracedFunction) else eqx.is_inexact_array(node)

    def mask_part(node):
        if not isinstance(node, Learned):
            return False
        return jax.tree_util.tree_map(is_parameter, node, is_leaf=lambda leaf: isinstance(leaf, TracedFunction))

    return jax.tree_util.tree_map(mask_part, tree, is_leaf=lambda node: isinstance(node, Learned))


class Energy(Function):
    """A learned energy: a network, or any ``equinox.Module``.

    Known terms can be added, as in ``lt.Quadratic(A) + lt.learn.Energy(4)``; the fit does not change them.
    ``.on(indices)`` makes it a function of some components of a larger state.

    Parameters
    ----------
    function : int, or function from x, shape (n,), to a scalar
        The number n of inputs of a network; or an ``equinox.Module``, whose floating-point arrays are learned.
    width, depth : int
        Neurons per hidden layer of the network, and number of hidden layers.
    seed : int
        Seed of the initial weights.

    Raises
    ------
    InputError
        If nothing can be learned.

    Examples
    --------
    >>> energy = lt.learn.Energy(3, width=8)
    >>> np.shape(energy(np.array([0.1, 0.2, 0.3])))
    ()
    """

    def __init__(self, function: int | Callable, width: int = 32, depth: int = 2, seed: int = 0):
        if isinstance(function, int):
            self.function = _ScalarOutput(Network.from_sizes(function, 1, width, depth, seed))
        elif callable(function) and not isinstance(function, AnyEnergy):
            self.function = Learned(function)
        else:
            raise InputError(
                f"lt.learn.{type(self).__name__} needs the number of components of a network, or an equinox.Module, "
                f"got {type(function).__name__}. Add known terms to it with +"
            )
        self.degree = math.inf

    def gradient(self, x) -> jax.Array:
        return _gradient_jitted(self.function, x)


@eqx.filter_jit
def _gradient_jitted(function: Callable, x) -> jax.Array:
    """Return the gradient of a function under ``jit``, so that it is traced once."""
    return jax.grad(lambda y: jnp.asarray(function(y)))(x)


class Entropy(Energy):
    """A learned entropy: :class:`Energy` with another default seed of the initial weights.

    Parameters
    ----------
    function, width, depth, seed : int or callable, int, int, int
        As for :class:`Energy`; the default seed is 1.
    """

    def __init__(self, function: int | Callable, width: int = 32, depth: int = 2, seed: int = 1):
        super().__init__(function, width, depth, seed)


class _ScalarOutput(eqx.Module):
    """A network with one output, as a scalar function."""

    network: Network

    def __call__(self, x):
        return self.network(x)[0]


def _learned_function_or_network(
    function: Callable | None, dim: int, outputs: int, width: int, depth: int, seed: int
) -> Callable:
    return Network.from_sizes(dim, outputs, width, depth, seed) if function is None else Learned(function)


class Poisson(mf.PoissonStructure):
    """A learned skew tensor ``Pi = P A(x) P^T`` whose kernel contains the gradient of the entropy by construction.

    A is skew, and its entries are outputs of a network. ``P^T = 1 - dS (G dS)^T / (dS . G dS)``, where G is diagonal
    with the squared standard deviations of the data [cf. Gruber et al. 2025]. So energy and entropy obey their laws for
    all weights. The Jacobi identity is not built in, except where the tensor is known: the row "Jacobi" of
    ``system.check()`` measures its violation.

    Parameters
    ----------
    dim : int
        Number of components of the state.
    width, depth, seed
        As for :class:`Energy`.
    function : function from x, shape (dim,), to the entries above the diagonal, row by row; optional
        An ``equinox.Module`` in place of the network.

    Attributes
    ----------
    entropy : Energy or None
        Entropy of the system, which :class:`Metriplectic` fills in.
    """

    function: Callable
    metric: jax.Array
    entropy: AnyEnergy | None
    n_components: int = eqx.field(static=True)

    def __init__(self, dim: int, width: int = 32, depth: int = 2, seed: int = 2, function: Callable | None = None):
        self.function = _learned_function_or_network(function, dim, dim * (dim - 1) // 2, width, depth, seed)
        self.n_components, self.metric, self.entropy = dim, jnp.ones(dim), None

    @staticmethod
    def canonical(degrees_of_freedom: int, dim: int | None = None) -> mf.PoissonStructure:
        """Return the canonical tensor of (q, p) in the first components of a state; the others are constant without
        friction."""
        return extend_poisson(mf.Canonical(degrees_of_freedom), dim)

    @staticmethod
    def lie_poisson(algebra: mf.LieAlgebra, dim: int | None = None) -> mf.PoissonStructure:
        """Return the Lie-Poisson tensor of an algebra in the first components of a state; the others are constant
        without friction."""
        return extend_poisson(mf.LiePoisson(algebra), dim)

    @property
    def dim(self) -> int:
        return self.n_components

    def tensor(self, x) -> jax.Array:
        A = skew_matrix(self.function(x), self.n_components)
        if self.entropy is None:
            return A
        dS = self.entropy.gradient(x)
        metric_dS = self.metric * dS
        square = jnp.dot(metric_dS, dS)
        image = A @ dS  # P A P^T = A - (g (A dS)^T - (A dS) g^T) / g . dS with g = G dS
        correction = jnp.outer(metric_dS, image)
        return A + (correction - correction.T) / jnp.where(square > 0.0, square, 1.0)


def extend_poisson(poisson: mf.PoissonStructure, dim: int | None) -> mf.PoissonStructure:
    """Return a Poisson structure extended to ``dim`` components; the additional ones commute with all functions."""
    assert poisson.dim is not None
    if dim is None or dim == poisson.dim:
        return poisson
    if dim < poisson.dim:
        raise InputError(f"the Poisson structure has {poisson.dim} coordinates, more than the {dim} of a state")
    return poisson_with_baths(poisson, dim - poisson.dim)


class Friction(Dissipation):
    """A learned friction ``K = B B^T`` with ``B^T grad H = 0`` by construction, for all weights.

    ``construction`` selects the columns of B:

    - ``"skew"``: ``A_k(x) dH`` with skew matrices A_k [cf. Zhang et al. 2022]; smooth where dH = 0 too.
    - ``"projected"``: ``b_k(x)`` minus its component along ``G dH``, where G is diagonal with the squared standard
      deviations of the data [cf. Gruber et al. 2025]: n numbers a column instead of n (n - 1)/2.

    A discrete gradient dH is in their kernel too, so the energy is conserved exactly in every step.

    Parameters
    ----------
    dim : int
        Number of components of the state.
    rank : int
        Number of columns of B, the number of dissipation channels.
    construction : {"skew", "projected"}
        The form that conserves the energy.
    width, depth, seed
        As for :class:`Energy`.
    function : function from x, shape (dim,), to the numbers of all columns, one after another; optional
        An ``equinox.Module`` in place of the network.

    Examples
    --------
    >>> friction = lt.learn.Friction(3, rank=2, width=8)
    >>> friction.rank
    2
    """

    function: Callable
    metric: jax.Array
    n_components: int = eqx.field(static=True)
    rank: int = eqx.field(static=True)
    construction: str = eqx.field(static=True)

    def __init__(
        self,
        dim: int,
        rank: int = 1,
        construction: Literal["skew", "projected"] = "skew",
        width: int = 32,
        depth: int = 2,
        seed: int = 3,
        function: Callable | None = None,
    ):
        if construction not in ("skew", "projected"):
            raise InputError(f"construction must be 'skew' or 'projected', got {construction!r}")
        if isinstance(rank, bool) or not isinstance(rank, int) or rank < 1:
            raise InputError(f"rank must be a positive integer, got {rank!r}")
        numbers = rank * (dim * (dim - 1) // 2 if construction == "skew" else dim)
        self.function = _learned_function_or_network(function, dim, numbers, width, depth, seed)
        self.n_components, self.rank, self.construction, self.metric = dim, rank, construction, jnp.ones(dim)

    def bind_to(self, system):
        if system.dim != self.n_components:
            raise InputError(f"the friction has {self.n_components} components, but the state has {system.dim}")
        return self

    def factor_columns(self, x, dH) -> jax.Array:
        """Return B, shape (dim, rank)."""
        entries = self.function(x).reshape(self.rank, -1)
        if self.construction == "skew":
            return (skew_matrix(entries, self.n_components) @ dH).T
        metric_dH = self.metric * dH
        overlap = jnp.dot(metric_dH, dH)
        return (entries - jnp.outer(entries @ dH, metric_dH) / jnp.where(overlap > 0.0, overlap, 1.0)).T

    def force(self, system, x, dH, dS, dL):
        B = self.factor_columns(x, dH)
        return B @ (dS @ B)

    def factor(self, system, x, dH, dL):
        B = self.factor_columns(x, dH)
        return Factor(self.rank, lambda w: B @ w)


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
        self.poisson = fill_learned_poisson_entropy(self.poisson, self.entropy)


def fill_learned_poisson_entropy(poisson: mf.PoissonStructure, entropy: AnyEnergy | None) -> mf.PoissonStructure:
    """Return a Poisson structure with the entropy of its system stored in it, if it is a learned one that needs it."""
    if not isinstance(poisson, Poisson) or poisson.entropy is None:
        return poisson
    return eqx.tree_at(lambda p: p.entropy, poisson, entropy)


def copy_entropy_to_poisson(system: T) -> T:
    """Return the system with the current weights of its entropy copied to its Poisson structure."""
    return eqx.tree_at(lambda s: s.poisson, system, fill_learned_poisson_entropy(system.poisson, system.entropy))


def scale_networks(system: T, data_scales: DataScales, states: np.ndarray) -> T:
    """Return the system with the scales of its networks set from the data, so that inputs and outputs are of order one.

    Networks that have scales already are not changed.

    Parameters
    ----------
    data_scales : DataScales
        Scales of the data.
    states : array, shape (m, n)
        Some states.
    """
    x, s, tau = jnp.asarray(states), jnp.asarray(data_scales.scale), data_scales.time_scale

    def mean_variation(function: AnyEnergy) -> float:
        """Return the mean over the data of the change of a function over one standard deviation of the state."""
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

    def scale_friction(dissipation):
        if isinstance(dissipation, Friction):
            root = jnp.sqrt(entropy * tau)
            unit = pairs / (energy * root) if dissipation.construction == "skew" else s / root
            scaled_function = _fill_network_scales(dissipation.function, x, jnp.tile(unit, dissipation.rank))
            return eqx.tree_at(lambda p: (p.function, p.metric), dissipation, (scaled_function, s**2))
        return dissipation

    def map_leaves(leaf_class, tree, change):
        return jax.tree_util.tree_map(change, tree, is_leaf=lambda part: isinstance(part, leaf_class))

    scaled_fields: dict[str, Any] = {
        "energy": _fill_network_scales(system.energy, x, energy),
        "entropy": _fill_network_scales(system.entropy, x, entropy),
        "dissipation": map_leaves(Friction, system.dissipation, scale_friction),
    }
    if isinstance(poisson, Poisson):
        scaled_function = _fill_network_scales(poisson.function, x, pairs / (energy * tau))
        poisson = eqx.tree_at(lambda p: (p.function, p.metric), poisson, (scaled_function, s**2))
    scaled_fields["poisson"] = poisson
    names = list(scaled_fields)
    present_names = [name for name in names if scaled_fields[name] is not None]
    scaled_system = eqx.tree_at(
        lambda m: [getattr(m, name) for name in present_names], system, [scaled_fields[name] for name in present_names]
    )
    return copy_entropy_to_poisson(scaled_system)


def has_learned_parts(tree: Any) -> bool:
    """Return True if a pytree has learned arrays."""
    return any(jax.tree_util.tree_leaves(learned_mask(tree)))


def _fill_network_scales(tree: Any, points: jax.Array, output_scale) -> Any:
    """Return a pytree whose networks have input scales computed from points, and an output scale, unless they were
    set."""

    def scale_part(node):
        if isinstance(node, Pullback):
            scaled_function = _fill_network_scales(node.term, jax.vmap(node.coordinates)(points), output_scale)
            return eqx.tree_at(lambda p: p.term, node, scaled_function)
        if not isinstance(node, Network) or not node.has_default_scales:
            return node
        std = jnp.std(points, axis=0)
        std = jnp.where(std > 0.0, std, 1.0)
        return Network(jnp.mean(points, axis=0), std, output_scale * node.output_scale, node.function)

    return jax.tree_util.tree_map(scale_part, tree, is_leaf=lambda node: isinstance(node, Pullback | Network))
