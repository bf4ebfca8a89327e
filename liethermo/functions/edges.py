"""Weighted graphs between the parts of a system, from matrices or lists of edges, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..errors import InputError

ASYMMETRY_RTOL = 1e-12
"""How far a symmetric matrix may be from its transpose, relative to its largest entry."""


class Edges(NamedTuple):
    """Each edge once: its two ends and its weight.

    Attributes
    ----------
    first, second : ndarray of int, shape (edges,)
        With first < second.
    weight : array, shape (edges,)
    """

    first: np.ndarray
    second: np.ndarray
    weight: jax.Array


def graph_edges(graph, nodes: int, what: str, names: Sequence[str], allow_negative: bool = False) -> Edges:
    """The edges of a symmetric graph; those of weight zero are left out.

    Parameters
    ----------
    graph : array, shape (nodes, nodes), or SciPy sparse matrix; or sequence of (i, j, weight), each pair once; or a
        number for the one edge of two nodes
    nodes : int
    what : str
        What the weights are, for messages.
    names : sequence of str
        Of the nodes, for messages.
    allow_negative : bool
        Whether weights may be negative.

    Raises
    ------
    InputError
    """
    if isinstance(graph, jax.core.Tracer):  # a matrix that is being swept or differentiated: all of its edges
        first, second = np.triu_indices(nodes, 1)
        return Edges(first, second, graph if graph.ndim == 0 else graph[first, second])
    first, second, weight = _edge_arrays(graph, nodes, what)
    if isinstance(weight, jax.Array):  # some are tracers
        return Edges(first, second, weight)
    for e in np.flatnonzero((first == second) & (weight != 0.0))[:1]:
        raise InputError(f"{what} of {names[first[e]]} with itself is {weight[e]:g}: leave the diagonal zero")
    for e in np.flatnonzero(~((allow_negative | (weight >= 0.0)) & np.isfinite(weight)))[:1]:
        ends = f"{names[first[e]]} and {names[second[e]]}"
        raise InputError(
            f"{what} between {ends} is {weight[e]:g}: it must be finite{'' if allow_negative else ' and >= 0'}"
        )
    kept = weight != 0.0
    return Edges(first[kept], second[kept], jnp.asarray(weight[kept]))


def connected_components(graph: Edges, nodes: int) -> np.ndarray:
    """The number of the connected part that each node belongs to, shape (nodes,)."""
    matrix = scipy.sparse.coo_array((np.ones(len(graph.first)), (graph.first, graph.second)), (nodes, nodes))
    return scipy.sparse.csgraph.connected_components(matrix, directed=False)[1]


def _edge_arrays(graph, nodes: int, what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | jax.Array]:
    if scipy.sparse.issparse(graph) or _is_matrix(graph):
        return _matrix_edges(scipy.sparse.coo_array(graph), nodes, what)
    if not _is_edge_list(graph) and np.ndim(graph) == 0:
        if nodes != 2:
            raise InputError(f"{what} as one number is meant for two parts, not {nodes}: give a matrix or edges")
        graph = [(0, 1, graph)]
    found: dict[tuple[int, int], Any] = {}
    for edge in graph:
        try:
            first, second, k = edge
            i, j, k = int(first), int(second), k if isinstance(k, jax.core.Tracer) else float(k)
            if (i, j) != (first, second):
                raise TypeError("not whole numbers")
        except (TypeError, ValueError):
            raise InputError(f"{what}: an edge is (i, j, weight), not {edge!r}") from None
        if not (0 <= i < nodes and 0 <= j < nodes):
            raise InputError(f"{what}: the edge ({i}, {j}) leaves the {nodes} parts, which count from 0")
        if (min(i, j), max(i, j)) in found:
            raise InputError(f"{what}: the edge between {i} and {j} is given twice")
        found[min(i, j), max(i, j)] = k
    ends = np.array(list(found), dtype=int).reshape(-1, 2)
    weights = list(found.values())
    traced = any(isinstance(k, jax.core.Tracer) for k in weights)
    return ends[:, 0], ends[:, 1], jnp.stack([jnp.asarray(k) for k in weights]) if traced else np.array(weights)


def _matrix_edges(matrix, nodes: int, what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if matrix.shape != (nodes, nodes):
        raise InputError(f"{what} is a ({nodes}, {nodes}) matrix for {nodes} parts, not one of shape {matrix.shape}")
    asymmetry = abs(matrix - matrix.T).max()
    if not asymmetry <= ASYMMETRY_RTOL * abs(matrix).max():
        raise InputError(f"{what} is not symmetric: it differs from its transpose by {asymmetry:.3g}")
    upper = scipy.sparse.triu(matrix).tocoo()
    return upper.row.astype(int), upper.col.astype(int), upper.data.astype(float)


def _is_matrix(graph) -> bool:
    try:
        array = np.asarray(graph, dtype=float)
    except (TypeError, ValueError):
        return False
    return array.ndim == 2 and array.shape[0] == array.shape[1] and not _is_edge_list(graph)


def _is_edge_list(graph) -> bool:
    return isinstance(graph, list | tuple) and all(isinstance(edge, tuple) for edge in graph)
