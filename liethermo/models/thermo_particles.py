"""Bodies of constant heat capacity that exchange heat: at rest, moving freely, on a spring [SML Examples 2-4, 6]."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

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

    capacity: jax.Array

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
    capacities, conductance
        As for :func:`thermo_particles`.
    dimension : int
        Dimension of the space; the state is (q_1, p_1, S_1, q_2, …), q_a and p_a with ``dimension`` components.
    """
    bodies = _moving_bodies(masses, capacities, dimension, 0.0)
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
    conductance : float, >= 0
    friction, drag : float, >= 0
        Coefficients of linear friction of either body on its surroundings, and between the two (mass / time).
    """
    k, is_frictionless = checked_positive(stiffness, "stiffness"), isinstance(friction, float | int) and friction == 0.0
    return ComposedSystem(
        _moving_bodies(masses, capacities, 1, friction),
        coupling=Quadratic(k * np.array([[1.0, -1.0], [-1.0, 1.0]])).on([0, 3]),
        conductance=conductance,
        drag=drag,
        connected=False,  # allow a conductance of zero
        momentum_maps={"momentum": Quadratic(np.zeros(6), [0.0, 1.0, 0.0, 0.0, 1.0, 0.0])} if is_frictionless else {},
    )


def _moving_bodies(masses, capacities, dimension, friction) -> list[Subsystem]:
    c = checked_positive_vector(capacities, "capacities")
    m, n = checked_positive(masses, "masses", len(c)), checked_integer(dimension, "dimension")
    return [
        Subsystem(Kinetic(jnp.full(n, 1.0 / m_a)) + Function(ThermalEnergy(c_a)).on([2 * n]), 2 * n + 1, friction)
        for m_a, c_a in zip(m, c, strict=True)
    ]
