"""Bodies of constant heat capacity that exchange heat: at rest, moving freely, on a spring [SML Examples 2-4, 6]."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import positive_condition
from ..functions.edges import graph_edges
from ..functions.energy import Function, Quadratic
from ..functions.mechanics import Kinetic
from ..systems import ComposedSystem, Copies, Subsystem
from .parameters import checked_integer, checked_positive, checked_positive_vector


def thermal_energy(x, capacity):
    """Return the internal energy ``c exp(S / c)`` of the last component S of a state, with the heat capacity c."""
    return capacity * jnp.exp(x[-1] / capacity)


class ThermalEnergy(Module):
    """The internal energy ``c exp(S / c)`` of one body, from the last component S of its state."""

    capacity: jax.Array = eqx.field(metadata=positive_condition("capacity").metadata)

    def __call__(self, x):
        return thermal_energy(x, self.capacity)


def thermo_particles(capacities: Sequence[float] = (1.0, 1.0), conductance=1.0) -> ComposedSystem:
    """Bodies at rest that exchange heat: ``H = sum c_a exp(S_a / c_a)`` in the state (S_1, S_2, …) [SML Example 2].

    ``S_a' = sum_b k_ab (T_b - T_a) / T_a`` with ``T_a = exp(S_a / c_a)``, so ``c_a T_a' = sum_b k_ab (T_b - T_a)``: all
    tend to the mean temperature ``sum c_a T_a / sum c_a``. There can be 1e5 of them, on a sparse graph. Figs. 3 and 4
    start at the temperatures (273.15, 300), with c = 1, k = 1, h = 0.1.

    Parameters
    ----------
    capacities : sequence of float, > 0
        c_a (energy / temperature).
    conductance : float for two bodies, or a graph as in :class:`liethermo.ComposedSystem`
        k_ab (power / temperature).
    """
    c = checked_positive_vector(capacities, "capacities")
    return ComposedSystem(Copies(len(c), thermal_energy, 1, c), conductance=conductance)


def thermo_particles_solution(t, temperatures, capacities=(1.0, 1.0), conductance=1.0) -> np.ndarray:
    """Return the exact temperatures at times t, shape (..., N), from those at t = 0, as a linear relaxation."""
    c, count = np.asarray(capacities, dtype=float), len(capacities)
    graph = graph_edges(conductance, count, "the conductance", tuple(map(str, range(count))))
    laplacian = np.zeros((count, count))
    for i, j, k in zip(graph.first, graph.second, np.asarray(graph.weight), strict=True):
        laplacian[[i, j], [i, j]] += k
        laplacian[[i, j], [j, i]] -= k
    root = np.sqrt(c)
    rates, modes = np.linalg.eigh(laplacian / np.outer(root, root))
    amplitudes = modes.T @ (root * np.asarray(temperatures, dtype=float))
    return (np.exp(-np.multiply.outer(np.asarray(t, dtype=float), rates)) * amplitudes) @ modes.T / root


def moving_thermo_particles(
    masses: Sequence[float] = (1.0, 1.0),
    capacities: Sequence[float] = (1.0, 1.0),
    conductance=1.0,
    dimension: int = 1,
) -> ComposedSystem:
    """Freely moving bodies that exchange heat: ``H = sum p_a^2 / (2 m_a) + c_a exp(S_a / c_a)`` [SML Example 3].

    The motion is uniform and the heat flows as if at rest: momentum and kinetic energy are constant.

    Parameters
    ----------
    masses : sequence of float, > 0
        Masses of the particles.
    capacities, conductance
        As for :func:`thermo_particles`.
    dimension : int
        Dimension of the space; the state is (q_1, p_1, S_1, q_2, …), q_a and p_a with ``dimension`` components.
    """
    bodies = _moving_subsystems(masses, capacities, dimension, 0.0)
    axis_vectors = np.eye(2 * dimension + 1)[dimension:-1]
    momentum_vectors = {"momentum" if dimension == 1 else f"momentum {i + 1}": p for i, p in enumerate(axis_vectors)}
    constants = {
        name: Quadratic(np.zeros(len(bodies) * len(p)), np.tile(p, len(bodies))) for name, p in momentum_vectors.items()
    }
    inverse = 1.0 / checked_positive(masses, "masses", len(bodies))
    constants["kinetic energy"] = Quadratic(jnp.outer(inverse, axis_vectors.sum(axis=0)).ravel())
    return ComposedSystem(bodies, conductance=conductance, momentum_maps=constants)


def thermo_springs(
    masses: Sequence[float] = (1.0, 1.0),
    stiffness: float = 1.0,
    capacities: Sequence[float] = (1.0, 1.0),
    conductance: float = 1.0,
    friction: float = 0.0,
    drag: float = 0.0,
) -> ComposedSystem:
    """Two bodies on a line, joined by a spring, exchange heat: ``V = k (q_1 - q_2)^2 / 2`` [SML Example 4].

    Without friction, motion and heat flow are independent. With drag the bodies stop oscillating and share the heat.
    The total momentum is conserved unless there is friction on the surroundings.

    Parameters
    ----------
    masses, stiffness, capacities : float, > 0
        Masses of the bodies, stiffness of the spring, heat capacities of the bodies.
    conductance : float, >= 0
        Heat conductance between the bodies (power / temperature).
    friction, drag : float, >= 0
        Coefficients of linear friction of either body on its surroundings, and between the two (mass / time).
    """
    k, is_frictionless = checked_positive(stiffness, "stiffness"), isinstance(friction, float | int) and friction == 0.0
    return ComposedSystem(
        _moving_subsystems(masses, capacities, 1, friction),
        coupling=Quadratic(k * np.array([[1.0, -1.0], [-1.0, 1.0]])).on([0, 3]),
        conductance=conductance,
        drag=drag,
        connected=False,  # allow a conductance of zero
        momentum_maps={"momentum": Quadratic(np.zeros(6), [0.0, 1.0, 0.0, 0.0, 1.0, 0.0])} if is_frictionless else {},
    )


def _moving_subsystems(masses, capacities, dimension, friction) -> list[Subsystem]:
    c = checked_positive_vector(capacities, "capacities")
    m, n = checked_positive(masses, "masses", len(c)), checked_integer(dimension, "dimension")
    return [
        Subsystem(Kinetic(jnp.full(n, 1.0 / m_a)) + Function(ThermalEnergy(c_a)).on([2 * n]), 2 * n + 1, friction)
        for m_a, c_a in zip(m, c, strict=True)
    ]


def heat_grid(shape: Sequence[int] = (32, 32), capacity: float = 1.0, conductance: float = 1.0) -> ComposedSystem:
    """Bodies at rest on a grid, each in contact with its neighbours along the axes: ``H = sum c exp(S_a / c)``.

    The temperatures obey ``c T_a' = k sum_b (T_b - T_a)`` over the neighbours b, the heat equation with insulated ends,
    and tend to their mean. The state has the entropies in C order, ``c log T``. It may have 1e5 nodes and more; its
    fastest mode decays at up to 4 k / c for each axis, its slowest at ``(pi / n)^2 k / c``.

    Parameters
    ----------
    shape : sequence of int
        Nodes along each axis.
    capacity : float, > 0
        c of each node (energy / temperature).
    conductance : float, > 0
        k between neighbours (power / temperature).
    """
    sizes = _checked_shape(shape)
    c, k = checked_positive(capacity, "capacity"), checked_positive(conductance, "conductance")
    nodes = math.prod(sizes)
    graph = grid_adjacency_matrix(sizes)
    pairs = zip(*scipy.sparse.triu(graph).nonzero(), strict=True)
    edges = [(i, j, k) for i, j in pairs] if is_traced(k) else float(k) * graph
    return ComposedSystem(Copies(nodes, thermal_energy, 1, jnp.broadcast_to(c, nodes), name="node"), conductance=edges)


def heat_grid_solution(t, temperatures, capacity: float = 1.0, conductance: float = 1.0) -> np.ndarray:
    """Return the exact temperatures at a time from those at t = 0, in the shape of the grid, as a sum of cosines."""
    import scipy.fft  # at the top, this would slow down the import of the library

    T = np.asarray(temperatures, dtype=float)
    rates = np.zeros(T.shape)
    for axis, n in enumerate(T.shape):
        mode = 4.0 * np.sin(0.5 * np.pi * np.arange(n) / n) ** 2
        rates = rates + mode.reshape([-1 if i == axis else 1 for i in range(T.ndim)])
    return scipy.fft.idctn(np.exp(-conductance / capacity * rates * t) * scipy.fft.dctn(T))


def grid_adjacency_matrix(shape: Sequence[int]) -> scipy.sparse.csr_array:
    """Return the sparse adjacency matrix of a grid, its nodes in C order; neighbours along the axes have weight 1."""
    sizes = _checked_shape(shape)
    graph = scipy.sparse.csr_array((math.prod(sizes), math.prod(sizes)))
    for axis, n in enumerate(sizes):
        line = scipy.sparse.diags_array([np.ones(n - 1)] * 2, offsets=[-1, 1], shape=(n, n))
        n_outer, n_inner = math.prod(sizes[:axis]), math.prod(sizes[axis + 1 :])
        line_blocks = scipy.sparse.kron(line, scipy.sparse.eye_array(n_inner))
        graph = graph + scipy.sparse.kron(scipy.sparse.eye_array(n_outer), line_blocks)
    return scipy.sparse.csr_array(graph)


def _checked_shape(shape: Sequence[int]) -> tuple[int, ...]:
    if not isinstance(shape, Sequence) or isinstance(shape, str) or len(shape) == 0:
        raise InputError(f"shape must be the number of nodes along each axis, such as (32, 32), got {shape!r}")
    return tuple(checked_integer(n, "each entry of shape") for n in shape)
