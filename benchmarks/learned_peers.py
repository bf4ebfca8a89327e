"""Our own GFINN and NMS, written from their papers: both laws hold in continuous time, and RK4 integrates them.

Inputs, outputs and time are scaled as in ``lt.learn``. Points, loss, optimiser and batches are those of
``lt.learn.fit``; only the construction of energy, entropy and brackets, and the integrator, differ.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from liethermo.learn import losses
from liethermo.learn.data import DataScales, Trajectory
from liethermo.learn.fitting import BATCH_SIZES
from liethermo.learn.training import Phase, TrainingRun


class Perceptron(eqx.Module):
    """A multilayer perceptron with tanh activations."""

    layers: list[tuple[jax.Array, jax.Array]]

    def __init__(self, sizes: list[int], random: np.random.Generator):
        self.layers = [
            (jnp.asarray(random.standard_normal((m, n)) / np.sqrt(n)), jnp.zeros(m))
            for n, m in itertools.pairwise(sizes)
        ]

    def __call__(self, x):
        for W, b in self.layers[:-1]:
            x = jnp.tanh(W @ x + b)
        W, b = self.layers[-1]
        return W @ x + b


class PeerModel(eqx.Module):
    """The system ``x' = L(x) grad E + M(x) grad S`` with ``L grad S = 0`` and ``M grad E = 0``, in scaled variables."""

    energy: Perceptron
    entropy: Perceptron

    def brackets(self, x, dE, dS) -> tuple[jax.Array, jax.Array]:
        raise NotImplementedError

    def rates(self, x):
        dE, dS = (jax.grad(lambda y, f=f: f(y)[0])(x) for f in (self.energy, self.entropy))
        L, M = self.brackets(x, dE, dS)
        return L @ dE + M @ dS


class GFINN(PeerModel):
    """GFINN: ``L = B^T (s - s^T) B``, rows ``xi_j grad S``, ``M = C^T t t^T C``, rows ``xi_j grad E`` [Zhang et al.
    2022].

    The xi_j are constant skew matrices, s and t networks, as in the authors' code for gas containers, but without its
    knowledge of energy and entropy.
    """

    skew: jax.Array  # (2, K, n, n): of L, and of M
    poisson_network: Perceptron
    friction_network: Perceptron
    rank: int = eqx.field(static=True)

    def __init__(self, n: int, width: int, depth: int, seed: int):
        random = np.random.default_rng(seed)
        sizes = [n, *[width] * depth]
        self.energy, self.entropy = Perceptron([*sizes, 1], random), Perceptron([n, width, 1], random)
        self.poisson_network, self.friction_network = (Perceptron([*sizes, n * n], random) for _ in range(2))
        self.skew, self.rank = jnp.asarray(random.standard_normal((2, n, n, n)) / np.sqrt(n)), n

    def brackets(self, x, dE, dS):
        xi = jnp.triu(self.skew, 1)
        xi = xi - jnp.swapaxes(xi, -1, -2)
        B, C = jnp.einsum("kij,j->ki", xi[0], dS), jnp.einsum("kij,j->ki", xi[1], dE)
        s, t = (f(x).reshape(self.rank, self.rank) for f in (self.poisson_network, self.friction_network))
        return B.T @ (s - s.T) @ B, C.T @ (t @ t.T) @ C


class NMS(PeerModel):
    """NMS: ``L = P_S A P_S`` and ``M = P_E B D D^T B^T P_E`` [Gruber et al. 2025].

    The P project orthogonally to the gradients. A (skew), B and D are networks of the state.
    """

    tensor: Perceptron
    columns: Perceptron
    weights: Perceptron
    rank: int = eqx.field(static=True)

    def __init__(self, n: int, width: int, depth: int, seed: int, rank: int):
        random = np.random.default_rng(seed)
        sizes = [n, *[width] * depth]
        self.energy, self.entropy = (Perceptron([*sizes, 1], random) for _ in range(2))
        self.tensor = Perceptron([*sizes, n * n], random)
        self.columns, self.weights = Perceptron([*sizes, n * rank], random), Perceptron([*sizes, rank * rank], random)
        self.rank = rank

    def brackets(self, x, dE, dS):
        n = x.shape[0]
        A = jnp.tril(self.tensor(x).reshape(n, n), -1)
        projector_S, projector_E = (jnp.eye(n) - jnp.outer(g, g) / jnp.dot(g, g) for g in (dS, dE))
        D = jnp.tril(self.weights(x).reshape(self.rank, self.rank))
        C = projector_E @ self.columns(x).reshape(n, self.rank) @ D
        return projector_S @ (A - A.T) @ projector_S, C @ C.T


class UnscaledPeer(eqx.Module):
    """A peer model in the units of the data."""

    peer: PeerModel
    scales: DataScales

    def _vector_field(self, x):
        centre, size, time = self.scales
        return size / time * self.peer.rates((x - centre) / size)


def train(peer: PeerModel, data: list[Trajectory], scales: DataScales, steps: int, rate: float, seed: int) -> PeerModel:
    """Train a peer model by derivative matching, as in ``lt.learn.fit``, and return it."""
    start, unravel = ravel_pytree(peer)
    shapes = tuple(leaf.shape for leaf in jax.tree_util.tree_leaves(peer))
    parameter_vector = losses.ParameterVector(
        np.asarray(start), shapes, lambda vector: UnscaledPeer(unravel(vector), scales)
    )
    task = losses.spline_matching_objective(parameter_vector, data, None, scales)
    training = TrainingRun(
        [Phase("matching", task, None, steps, rate, BATCH_SIZES["matching"], shapes)],
        parameter_vector.initial_values,
        "",
    )
    training.run(seed, None, None, False)
    return unravel(jnp.asarray(training.weights))


def forecast(
    peer: PeerModel, x0: np.ndarray, scales: DataScales, step: float, steps: int
) -> tuple[np.ndarray, Callable]:
    """Integrate a peer model by RK4; return states, shape (trajectories, steps + 1, n), and a function of these for
    energy and entropy."""
    h = step / scales.time_scale

    def rk4(y, _):
        a = peer.rates(y)
        b = peer.rates(y + 0.5 * h * a)
        c = peer.rates(y + 0.5 * h * b)
        new = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + peer.rates(y + h * c))
        return new, new

    def trajectory(y):
        return jnp.concatenate([y[None], jax.lax.scan(rk4, y, length=steps)[1]])

    y = jax.jit(jax.vmap(trajectory))(jnp.asarray((x0 - scales.centre) / scales.scale))

    def laws(states):
        z = (states - scales.centre) / scales.scale
        return tuple(np.asarray(jax.vmap(f)(jnp.asarray(z)))[..., 0] for f in (peer.energy, peer.entropy))

    return np.asarray(y) * scales.scale + scales.centre, laws
