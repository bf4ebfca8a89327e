"""Sparse Jacobian matrices and the solution of linear equations with them, on the host."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import scipy

MAX_FRONT_WIDTH = 1_000
"""Largest width of a level of a breadth-first search for which a matrix is factorised.

Such a level cuts the graph in two, and elimination fills about the square of its width: a plane grid of 1e6 nodes is at
the limit, taking seconds. Wider graphs (grids in space, networks of small diameter) are well connected, and Krylov
iteration is quick for them: tens to hundreds of products.
"""

KRYLOV_RTOL = 1e-6
"""Relative residual of a Krylov solution; Newton's iteration corrects the rest.

(1e-12 gave the same laws, at 1.7 times the products.)
"""

MAX_KRYLOV_ITERATIONS = 2_000
"""Largest number of Krylov iterations for one solution."""


class JacobianCompression:
    """Compression of a sparse Jacobian matrix: all its entries from few Jacobian-vector products.

    Columns without a common row get one colour and are computed together, by a derivative along their sum [Curtis,
    Powell & Reid 1974]. Dense rows (of *hubs*) would need as many colours as they have entries; they are computed one
    by one, by vector-Jacobian products. The limit between both is chosen to need the fewest derivatives.

    Parameters
    ----------
    pattern : scipy.sparse.csr_array, shape (n, n)
        Entries that can be different from zero.
    stages : int
        The function maps (stages, n) to (stages, n), and every stage depends on every other by the same pattern.
    """

    def __init__(self, pattern: scipy.sparse.csr_array, stages: int = 1):
        self.dim, self.stages = pattern.shape[0], stages
        self.front_width = _max_bfs_level_width(pattern)
        row_sizes = np.diff(pattern.indptr)
        self.dense_rows = np.flatnonzero(row_sizes > _max_coloured_row_size(row_sizes))
        self._dense_row_columns = [pattern.indices[pattern.indptr[i] : pattern.indptr[i + 1]] for i in self.dense_rows]
        rows, columns = np.repeat(np.arange(self.dim), row_sizes), pattern.indices
        is_coloured = ~np.isin(rows, self.dense_rows)
        rows, columns = rows[is_coloured], columns[is_coloured]
        coloured_pattern = scipy.sparse.csr_array((np.ones(len(rows), dtype=bool), (rows, columns)), pattern.shape)
        self.colours = _colour_columns(coloured_pattern)
        order = np.argsort(self.colours[columns], kind="stable")
        ends = np.cumsum(np.bincount(self.colours[columns], minlength=self.colours.max(initial=-1) + 1))
        self._colour_entries = list(
            zip(np.split(rows[order], ends[:-1]), np.split(columns[order], ends[:-1]), strict=True)
        )

    @property
    def n_derivatives(self) -> int:
        """Return the number of directional derivatives (jvp and vjp) that one Jacobian matrix takes."""
        return self.stages * (len(self._colour_entries) + len(self.dense_rows))

    def assemble_jacobian(self, jvp: Callable, vjp: Callable) -> scipy.sparse.csc_array:
        """Return the Jacobian matrix, shape (stages n, stages n).

        Parameters
        ----------
        jvp, vjp : functions from an array, shape (stages, n), to one
            The product of the matrix, and of its transpose, with a vector.
        """
        n, stages = self.dim, range(self.stages)
        rows, columns, entries = [], [], []
        seed = np.zeros((self.stages, n))
        for colour, (r, c) in enumerate(self._colour_entries):
            has_colour = self.colours == colour
            for j in stages:
                seed[j] = has_colour
                product = np.asarray(jvp(seed))
                seed[j] = 0.0
                for i in stages:
                    rows.append(i * n + r)
                    columns.append(j * n + c)
                    entries.append(product[i, r])
        for dense_row, c in zip(self.dense_rows, self._dense_row_columns, strict=True):
            for i in stages:
                seed[i, dense_row] = 1.0
                product = np.asarray(vjp(seed))
                seed[i, dense_row] = 0.0
                for j in stages:
                    rows.append(np.full(len(c), i * n + dense_row))
                    columns.append(j * n + c)
                    entries.append(product[j, c])
        indices = np.concatenate(rows), np.concatenate(columns)
        return scipy.sparse.csc_array((np.concatenate(entries), indices), (self.stages * n, self.stages * n))


class SparseInverse:
    """Solver of ``matrix @ x = b``, by factorisation if elimination fills little, else by Krylov iteration.

    Parameters
    ----------
    matrix : scipy.sparse.csc_array, shape (n, n)
    front_width : int
        Width of the widest level of its graph: see :data:`MAX_FRONT_WIDTH`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular or not finite.
    """

    def __init__(self, matrix: scipy.sparse.csc_array, front_width: int):
        if not np.isfinite(matrix.data).all():
            raise np.linalg.LinAlgError("the matrix is not finite")
        if front_width <= MAX_FRONT_WIDTH:
            options = {"SymmetricMode": True}  # pivots on the diagonal, as far as that is stable
            try:
                factors = scipy.sparse.linalg.splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options=options)
            except RuntimeError as error:
                raise np.linalg.LinAlgError(str(error)) from error
            self._solve = factors.solve
            return
        diagonal = matrix.diagonal()
        scaling = scipy.sparse.diags_array(1.0 / np.where(diagonal != 0.0, diagonal, 1.0))
        scaled_matrix = scipy.sparse.csr_array(scaling @ matrix)

        def solve_bicgstab(b):
            b_norm = float(np.linalg.norm(scaling @ b)) or 1.0  # SciPy stops at a small absolute residual
            x, _ = scipy.sparse.linalg.bicgstab(
                scaled_matrix, scaling @ b / b_norm, rtol=KRYLOV_RTOL, maxiter=MAX_KRYLOV_ITERATIONS
            )
            return b_norm * x

        self._solve = solve_bicgstab

    def __call__(self, b: np.ndarray) -> np.ndarray:
        return self._solve(b)


def _max_coloured_row_size(row_sizes: np.ndarray) -> int:
    """Return the largest number of entries of a row that is coloured.

    About as many colours are needed, and a derivative for each larger row: their sum is minimised.
    """
    candidates = np.unique(row_sizes)
    n_larger = len(row_sizes) - np.searchsorted(np.sort(row_sizes), candidates, side="right")
    return int(candidates[np.argmin(candidates + n_larger)])


def _max_bfs_level_width(pattern: scipy.sparse.csr_array) -> int:
    """Return the number of nodes in the widest level of a breadth-first search through the largest component.

    The search starts at a peripheral node.
    """
    graph = scipy.sparse.csr_array(pattern + pattern.T, dtype=float)
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    start = int(np.argmax(label == np.bincount(label).argmax()))
    for _ in range(2):  # the second search starts where the first ended
        distance = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=start, unweighted=True)
        is_reached = np.isfinite(distance)
        start = int(np.argmax(np.where(is_reached, distance, -1.0)))
    return int(np.bincount(distance[is_reached].astype(int)).max())


def _colour_columns(pattern: scipy.sparse.csr_array) -> np.ndarray:
    """Return a colour for each column, greedily and in order, so that no row has two columns of one colour."""
    csc_pattern = scipy.sparse.csc_array(pattern)
    rows = csc_pattern.indices.tolist()
    row_colours = [0] * pattern.shape[0]  # for each row, a bit mask of the colours of its columns
    colours = []
    for start, end in itertools.pairwise(csc_pattern.indptr.tolist()):
        column_rows = rows[start:end]
        used_colours = 0
        for row in column_rows:
            used_colours |= row_colours[row]
        free_colour = ~used_colours & (used_colours + 1)  # the lowest bit that is not set
        for row in column_rows:
            row_colours[row] |= free_colour
        colours.append(free_colour.bit_length() - 1)
    return np.array(colours, dtype=int)
