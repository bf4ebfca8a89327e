"""Weighted graphs between the parts of a system, checked, from matrices or lists of edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..errors import InputError

ASYMMETRY_RTOL = 1e-12
"""Largest difference of a symmetric matrix from its transpose, relative to its largest entry: a few roundings."""


class Edges(NamedTuple):
    """The edges of a graph, each once, as two arrays of nodes and an array of weights.

    Attributes
    ----------
    first, second : ndarray of int, shape (edges,)
        The nodes of each edge, with first < second.
    weight : array, shape (edges,)
    """

    first: np.ndarray
    second: np.ndarray
    weight: jax.Array


def graph_edges(
    graph, n_nodes: int, weight_name: str, node_names: Sequence[str], allow_negative: bool = False
) -> Edges:
    """Return the checked edges of a symmetric weighted graph, without edges of weight zero.

    Parameters
    ----------
    graph : array, shape (nodes, nodes), or SciPy sparse matrix; or sequence of (i, j, weight), each pair once; or a
        number for the one edge of two nodes
    n_nodes : int
    weight_name : str
        Name of the weights, for messages.
    node_names : sequence of str
        Names of the nodes, for messages.
    allow_negative : bool
        Whether weights may be negative.

    Raises
    ------
    InputError
    """
    if isinstance(graph, jax.core.Tracer):  # a matrix that is swept or differentiated keeps all its edges
        first_nodes, second_nodes = np.triu_indices(n_nodes, 1)
        return Edges(first_nodes, second_nodes, graph if graph.ndim == 0 else graph[first_nodes, second_nodes])
    first_nodes, second_nodes, weight = _node_and_weight_arrays(graph, n_nodes, weight_name)
    if isinstance(weight, jax.Array):  # some weights are tracers
        return Edges(first_nodes, second_nodes, weight)
    for e in np.flatnonzero((first_nodes == second_nodes) & (weight != 0.0))[:1]:
        raise InputError(
            f"{weight_name} of {node_names[first_nodes[e]]} with itself must be 0, got {weight[e]:g}. "
            "Leave the diagonal zero"
        )
    for e in np.flatnonzero(~((allow_negative | (weight >= 0.0)) & np.isfinite(weight)))[:1]:
        ends = f"{node_names[first_nodes[e]]} and {node_names[second_nodes[e]]}"
        raise InputError(
            f"{weight_name} between {ends} must be finite{'' if allow_negative else ' and >= 0'}, got {weight[e]:g}"
        )
    is_nonzero = weight != 0.0
    return Edges(first_nodes[is_nonzero], second_nodes[is_nonzero], jnp.asarray(weight[is_nonzero]))


def connected_component_labels(graph: Edges, n_nodes: int) -> np.ndarray:
    """Return the label of the connected component to which each node belongs, shape (nodes,)."""
    matrix = scipy.sparse.coo_array((np.ones(len(graph.first)), (graph.first, graph.second)), (n_nodes, n_nodes))
    return scipy.sparse.csgraph.connected_components(matrix, directed=False)[1]


def _node_and_weight_arrays(
    graph, n_nodes: int, weight_name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray | jax.Array]:
    """Return the first nodes, second nodes and weights of the edges of a graph in any of the accepted forms."""
    if scipy.sparse.issparse(graph) or _is_matrix(graph):
        return _edges_of_matrix(scipy.sparse.coo_array(graph), n_nodes, weight_name)
    if not _is_edge_list(graph) and np.ndim(graph) == 0:
        if n_nodes != 2:
            raise InputError(
                f"{weight_name} may be one number only for two parts, got {n_nodes} parts. Give a matrix or edges"
            )
        graph = [(0, 1, graph)]
    weight_by_pair: dict[tuple[int, int], Any] = {}
    for edge in graph:
        try:
            first_node, second_node, k = edge
            i, j, k = int(first_node), int(second_node), k if isinstance(k, jax.core.Tracer) else float(k)
            if (i, j) != (first_node, second_node):
                raise TypeError("not whole numbers")
        except (TypeError, ValueError):
            raise InputError(f"{weight_name}: an edge must be (i, j, weight), got {edge!r}") from None
        if not (0 <= i < n_nodes and 0 <= j < n_nodes):
            raise InputError(
                f"{weight_name}: the edge ({i}, {j}) must join two of the {n_nodes} parts, which are numbered from 0"
            )
        if (min(i, j), max(i, j)) in weight_by_pair:
            raise InputError(f"{weight_name}: the edge between {i} and {j} is given twice")
        weight_by_pair[min(i, j), max(i, j)] = k
    ends = np.array(list(weight_by_pair), dtype=int).reshape(-1, 2)
    weights = list(weight_by_pair.values())
    has_tracers = any(isinstance(k, jax.core.Tracer) for k in weights)
    return ends[:, 0], ends[:, 1], jnp.stack([jnp.asarray(k) for k in weights]) if has_tracers else np.array(weights)


def _edges_of_matrix(matrix, n_nodes: int, weight_name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first nodes, second nodes and weights of the upper triangle of a symmetric sparse matrix."""
    if matrix.shape != (n_nodes, n_nodes):
        raise InputError(
            f"{weight_name} of {n_nodes} parts must be a ({n_nodes}, {n_nodes}) matrix, got shape {matrix.shape}"
        )
    asymmetry = abs(matrix - matrix.T).max()
    if not asymmetry <= ASYMMETRY_RTOL * abs(matrix).max():
        raise InputError(f"{weight_name} must be symmetric, but it differs from its transpose by {asymmetry:.3g}")
    upper = scipy.sparse.triu(matrix).tocoo()
    return upper.row.astype(int), upper.col.astype(int), upper.data.astype(float)


def _is_matrix(graph) -> bool:
    """Return whether a graph is given as a square matrix of numbers."""
    try:
        array = np.asarray(graph, dtype=float)
    except (TypeError, ValueError):
        return False
    return array.ndim == 2 and array.shape[0] == array.shape[1] and not _is_edge_list(graph)


def _is_edge_list(graph) -> bool:
    """Return whether a graph is given as a sequence of tuples, its edges."""
    return isinstance(graph, list | tuple) and all(isinstance(edge, tuple) for edge in graph)
