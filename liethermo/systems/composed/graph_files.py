"""Graphs from files: edge lists as CSV, and GraphML."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import scipy

from ...disk import checked_path
from ...errors import FileError, InputError
from ...functions.edges import graph_edges


@dataclass(frozen=True)
class Graph:
    """A weighted graph with named nodes, read from a file.

    Attributes
    ----------
    names : tuple of str
        Names of the bodies.
    matrix : scipy.sparse.csr_array, shape (nodes, nodes)
        Symmetric: what :class:`liethermo.ComposedSystem` takes as a conductance.
    """

    names: tuple[str, ...]
    matrix: scipy.sparse.csr_array

    def __len__(self) -> int:
        return len(self.names)


def read_graph(path: str | os.PathLike, weight: str = "conductance", nodes: Sequence[str] | int | None = None) -> Graph:
    """Read a graph of conductances from a file.

    A ``.csv`` file has a line for each edge, each pair once, and column titles in its first line: ``source``,
    ``target`` and the weight. A ``.graphml`` file declares its nodes, and its edges carry the weight as an attribute;
    networkx reads it (``pip install networkx``).

    Parameters
    ----------
    path : path
        The file to read.
    weight : str
        The column or attribute with the weights.
    nodes : sequence of str, or int, optional
        The names of the nodes, in the order that states have; a number n stands for "0" to "n - 1". An edge to any
        other is an error. By default those that the file has: as declared in GraphML, in the order of their first edges
        in CSV (in numerical order, where all are whole numbers).

    Returns
    -------
    Graph

    Raises
    ------
    FileError
        If the file is missing or of another kind, or GraphML is asked for and networkx is not there.
    InputError
        If an edge leads to a node that is missing, is given twice, or has no weight, or one that is negative or not
        finite.
    """
    path = checked_path(path)
    if not path.is_file():
        raise FileError(f"there is no file {path}")
    readers = {".csv": _read_csv, ".graphml": _read_graphml}
    if path.suffix.lower() not in readers:
        raise FileError(f"a file of a graph must be .csv or .graphml, got {path}")
    file_names, edges = readers[path.suffix.lower()](path, weight)
    names = _node_names(file_names, nodes, path)
    index = {name: i for i, name in enumerate(names)}
    indexed_edges = []
    for location, source, target, k in edges:
        for end in (source, target):
            if end not in index:
                raise InputError(f"{path}, {location}: there is no node {end!r} among the {len(names)} of the graph")
        indexed_edges.append((index[source], index[target], k))
    try:
        graph = graph_edges(indexed_edges, len(names), f"the {weight}", names)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    shape = (len(names), len(names))
    upper = scipy.sparse.coo_array((np.asarray(graph.weight), (graph.first, graph.second)), shape)
    return Graph(names, scipy.sparse.csr_array(upper + upper.T))


_EdgeList = list[tuple[str, str, str, float]]


def _read_csv(path: Path, weight: str) -> tuple[tuple[str, ...] | None, _EdgeList]:
    """Return the node names and the edges of a CSV file; an edge is (location, source, target, weight)."""
    edges: _EdgeList = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            titles = reader.fieldnames or []
            missing_titles = [title for title in ("source", "target", weight) if title not in titles]
            if missing_titles:
                raise InputError(
                    f"{path} has no column {missing_titles[0]!r} in its first line, but {', '.join(titles)}"
                )
            for row in reader:
                location = f"line {reader.line_num}"
                source, target = ((row[title] or "").strip() for title in ("source", "target"))
                if not (source and target):
                    raise InputError(f"{path}, {location}: an edge has two nodes, but one of them is missing")
                edges.append((location, source, target, _parse_weight(row[weight], weight, f"{path}, {location}")))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path} cannot be read as CSV: {error}") from error
    names = tuple(dict.fromkeys(end for _, source, target, _ in edges for end in (source, target)))
    return (tuple(sorted(names, key=int)) if all(name.isdecimal() for name in names) else names), edges


def _read_graphml(path: Path, weight: str) -> tuple[tuple[str, ...] | None, _EdgeList]:
    """Return the node names and the edges of a GraphML file; an edge is (location, source, target, weight)."""
    try:
        import networkx
    except ImportError as error:
        raise FileError(f"networkx, which reads {path}, is not installed: pip install networkx") from error
    try:
        graph = networkx.read_graphml(path)
        names = _declared_nodes(path)
    except (networkx.NetworkXError, ElementTree.ParseError, OSError, KeyError, ValueError) as error:
        raise FileError(f"{path} cannot be read as GraphML: {error}") from error
    edges: _EdgeList = []
    for source, target, data in graph.edges(data=True):
        location = f"the edge from {source} to {target}"
        edges.append((location, source, target, _parse_weight(data.get(weight), weight, f"{path}, {location}")))
    return names, edges


def _declared_nodes(path: Path) -> tuple[str, ...]:
    """Return the names of the nodes that a GraphML file declares, without those that only an edge names."""
    elements = ElementTree.parse(path).iter()
    return tuple(element.attrib["id"] for element in elements if element.tag.rsplit("}")[-1] == "node")


def _node_names(file_names: Iterable[str] | None, requested_nodes, path: Path) -> tuple[str, ...]:
    """Return the node names in the order of states: those that the user requested, or those of the file."""
    names = (
        tuple(file_names or ())
        if requested_nodes is None
        else tuple(map(str, range(requested_nodes) if isinstance(requested_nodes, int) else requested_nodes))
    )
    if not names:
        raise InputError(f"{path} has no nodes")
    if len(set(names)) < len(names):
        raise InputError("nodes have names of their own, but one is given twice")
    return names


def _parse_weight(text, weight: str, location: str) -> float:
    """Return the weight of an edge as a number; InputError if its text is none."""
    try:
        return float(text)
    except (TypeError, ValueError):
        raise InputError(f"{location}: the {weight} is {text!r}, not a number") from None
