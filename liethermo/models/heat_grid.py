"""Heat conduction on a grid of bodies."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced

from ..errors import InputError
from ..systems import ComposedSystem, Copies
from .parameters import checked_integer, checked_positive
from .thermo_particles import thermal_energy


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
