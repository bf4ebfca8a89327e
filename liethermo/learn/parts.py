"""What a learned system is made of: energies, entropies, Poisson tensors and frictions with networks in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds.matrices.linear import skew_matrix

from ..dissipation.base import Dissipation
from ..dissipation.factor import Factor
from ..errors import InputError
from ..functions.energy import Energy as AnyEnergy
from ..functions.energy import Function
from ..systems.baths import poisson_with_baths
from .networks import Learned, Network


class Energy(Function):
    """An energy that is learned: a network, or any ``equinox.Module``.

    Known terms are added to it, ``lt.Quadratic(A) + lt.learn.Energy(4)``, and stay as they are; ``.on(indices)`` makes
    it a function of some components of a larger state.

    Parameters
    ----------
    function : int, or function from x, shape (n,), to a scalar
        The number n of components that a network is a function of; or an ``equinox.Module``, whose floating-point
        arrays are learned.
    width, depth : int
        Neurons of a hidden layer of the network, and how many such layers.
    seed : int
        Of the first weights.

    Raises
    ------
    InputError
        If there is nothing to be learned.
    """

    def __init__(self, function: int | Callable, width: int = 32, depth: int = 2, seed: int = 0):
        if isinstance(function, int):
            self.function = _ScalarOutput(Network.from_sizes(function, 1, width, depth, seed))
        elif callable(function) and not isinstance(function, AnyEnergy):
            self.function = Learned(function)
        else:
            raise InputError(
                f"lt.learn.{type(self).__name__} takes the number of components of a network, or an equinox.Module, "
                f"not {type(function).__name__}; what is known is added to it with +"
            )
        self.degree = math.inf

    def gradient(self, x) -> jax.Array:
        return _gradient_jitted(self.function, x)


@eqx.filter_jit
def _gradient_jitted(function: Callable, x) -> jax.Array:
    """A gradient that is traced once, as the calls of :class:`.networks.Learned` are."""
    return jax.grad(lambda y: jnp.asarray(function(y)))(x)


class Entropy(Energy):
    """An entropy that is learned: as :class:`Energy`, with other first weights for the same seed."""

    def __init__(self, function: int | Callable, width: int = 32, depth: int = 2, seed: int = 1):
        super().__init__(function, width, depth, seed)


class _ScalarOutput(eqx.Module):
    """The only output of a network."""

    network: Network

    def __call__(self, x):
        return self.network(x)[0]


def _function_or_network(
    function: Callable | None, dim: int, outputs: int, width: int, depth: int, seed: int
) -> Callable:
    return Network.from_sizes(dim, outputs, width, depth, seed) if function is None else Learned(function)


class Poisson(mf.PoissonStructure):
    """A skew tensor that is learned, with the gradient of the entropy in its kernel by form: ``Pi = P A(x) P^T``.

    A is skew, its entries are outputs of a network, and ``P^T = 1 - dS (G dS)^T / (dS . G dS)``, G diagonal with the
    squares of the spreads of the data [cf. Gruber et al. 2025]. So energy and entropy obey their laws whatever the
    weights are. The Jacobi identity is not built in, except where the tensor is known: the row "Jacobi" of
    ``system.check()`` says how far it is from holding.

    Parameters
    ----------
    dim : int
    width, depth, seed
        As of :class:`Energy`.
    function : function from x, shape (dim,), to the entries above the diagonal, row by row; optional
        An ``equinox.Module`` in place of the network.

    Attributes
    ----------
    entropy : Energy or None
        That of the system, which :class:`Metriplectic` fills in.
    """

    function: Callable
    metric: jax.Array
    entropy: AnyEnergy | None
    n_components: int = eqx.field(static=True)

    def __init__(self, dim: int, width: int = 32, depth: int = 2, seed: int = 2, function: Callable | None = None):
        self.function = _function_or_network(function, dim, dim * (dim - 1) // 2, width, depth, seed)
        self.n_components, self.metric, self.entropy = dim, jnp.ones(dim), None

    @staticmethod
    def canonical(degrees_of_freedom: int, dim: int | None = None) -> mf.PoissonStructure:
        """The known tensor of (q, p) in the first components of a state; the others are at rest without friction."""
        return extend_poisson(mf.Canonical(degrees_of_freedom), dim)

    @staticmethod
    def lie_poisson(algebra: mf.LieAlgebra, dim: int | None = None) -> mf.PoissonStructure:
        """The known tensor of the dual of a Lie algebra in the first components of a state, likewise."""
        return extend_poisson(mf.LiePoisson(algebra), dim)

    @property
    def dim(self) -> int:
        return self.n_components

    def tensor(self, x) -> jax.Array:
        A = skew_matrix(self.function(x), self.n_components)
        if self.entropy is None:
            return A
        dS = self.entropy.gradient(x)
        raised = self.metric * dS
        square = jnp.dot(raised, dS)
        image = A @ dS  # P A P^T = A - (g (A dS)^T - (A dS) g^T) / g . dS with g = G dS
        turned = jnp.outer(raised, image)
        return A + (turned - turned.T) / jnp.where(square > 0.0, square, 1.0)


def extend_poisson(poisson: mf.PoissonStructure, dim: int | None) -> mf.PoissonStructure:
    """A structure with components behind its own, up to ``dim``, that nothing is conjugate to."""
    assert poisson.dim is not None
    if dim is None or dim == poisson.dim:
        return poisson
    if dim < poisson.dim:
        raise InputError(f"the Poisson structure has {poisson.dim} coordinates, more than the {dim} of a state")
    return poisson_with_baths(poisson, dim - poisson.dim)


class Friction(Dissipation):
    """A friction that is learned, ``K = B B^T`` with ``B^T grad H = 0`` by form, whatever the weights are.

    The columns of B are, by ``construction``,

    - ``"skew"``: ``A_k(x) dH`` with skew matrices A_k [cf. Zhang et al. 2022]; smooth where dH = 0 too.
    - ``"projected"``: ``b_k(x)`` less its component along ``G dH``, G diagonal with the squares of the spreads of the
      data [cf. Gruber et al. 2025]: n numbers a column instead of n (n - 1)/2.

    Handed a discrete gradient dH, they have that in their kernel: so the energy is conserved exactly in every step.

    Parameters
    ----------
    dim : int
    rank : int
        Columns of B: in how many ways the system dissipates.
    construction : {"skew", "projected"}
    width, depth, seed
        As of :class:`Energy`.
    function : function from x, shape (dim,), to the numbers of all columns, one after another; optional
        An ``equinox.Module`` in place of the network.
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
            raise InputError(f"construction is 'skew' or 'projected', not {construction!r}")
        if isinstance(rank, bool) or not isinstance(rank, int) or rank < 1:
            raise InputError(f"rank is a positive integer, not {rank!r}")
        numbers = rank * (dim * (dim - 1) // 2 if construction == "skew" else dim)
        self.function = _function_or_network(function, dim, numbers, width, depth, seed)
        self.n_components, self.rank, self.construction, self.metric = dim, rank, construction, jnp.ones(dim)

    def bind_to(self, system):
        if system.dim != self.n_components:
            raise InputError(f"the friction is of {self.n_components} components, but the state has {system.dim}")
        return self

    def factor_columns(self, x, dH) -> jax.Array:
        """B, shape (dim, rank)."""
        found = self.function(x).reshape(self.rank, -1)
        if self.construction == "skew":
            return (skew_matrix(found, self.n_components) @ dH).T
        raised = self.metric * dH
        overlap = jnp.dot(raised, dH)
        return (found - jnp.outer(found @ dH, raised) / jnp.where(overlap > 0.0, overlap, 1.0)).T

    def force(self, system, x, dH, dS, dL):
        B = self.factor_columns(x, dH)
        return B @ (dS @ B)

    def factor(self, system, x, dH, dL):
        B = self.factor_columns(x, dH)
        return Factor(self.rank, lambda w: B @ w)
