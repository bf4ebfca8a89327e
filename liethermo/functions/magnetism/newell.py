"""Demagnetising tensors of rectangular cells: closed form near by, averages of the dipolar tensor far away.

The tensor N of two equal cells gives the mean field ``-N M`` in one cell due to the other, uniformly magnetised. Nearby
it is the closed form of Newell, Williams & Dunlop 1993. That form is a sixth difference of functions that grow as r^3,
so its rounding error grows as r^3 too. Far away N is the mean of ``V T(r) / 4 pi`` over the vectors between points of
two cells, T the dipolar tensor, by Gauss quadrature with the density of these vectors.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np

from .ewald import COMPONENTS, dipole_tensor

CLOSED_FORM_DISTANCE = 8.0
"""Distance, in longest edges of a cell, up to which the closed form is used.

Up to there its rounding error, in 80-bit numbers, is below 4e-16 for cells as flat as 1 : 1 : 0.05.
"""

FAR_NODES = ((12.0, 6), (24.0, 5), (40.0, 4), (np.inf, 3))
"""Gauss nodes of each axis up to a distance in longest edges; measured errors are below 1e-16."""


def demagnetising_tensors(cells: tuple[int, ...], size: np.ndarray) -> np.ndarray:
    """Return the demagnetising tensor between a cell and those at offsets (i, j, k) >= 0, shape (6, nx, ny, nz).

    Parameters
    ----------
    cells : tuple of int
        Number of offsets along each axis.
    size : array, shape (3,)
        Edges of a cell (length).
    """
    size = np.asarray(size, dtype=float)
    scale = size.max()
    edges = size / scale
    offsets = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    distances = np.linalg.norm(offsets * edges, axis=1)
    tensors = np.zeros((6, len(offsets)))
    is_near = distances <= CLOSED_FORM_DISTANCE
    tensors[:, is_near] = _closed_form_tensors(offsets[is_near], edges)
    min_distance = CLOSED_FORM_DISTANCE
    for max_distance, nodes in FAR_NODES:
        is_far = (distances > min_distance) & (distances <= max_distance)
        tensors[:, is_far] = _mean_dipole_tensors(offsets[is_far] * edges, edges, nodes)
        min_distance = max_distance
    return tensors.reshape(6, *cells)


def mirror_octant(tensors: np.ndarray, padded_cells: tuple[int, ...]) -> np.ndarray:
    """Return tensors at all offsets of a padded grid, 0, 1, …, -1 along each axis, from those at offsets >= 0.

    The tensors at negative offsets follow by mirror symmetry.
    """
    result = np.zeros((6, *padded_cells))
    cells = tensors.shape[1:]
    for component, (i, j) in enumerate(COMPONENTS):
        for signs in itertools.product((1, -1), repeat=3):
            if any(s < 0 and n == 1 for s, n in zip(signs, cells, strict=True)):
                continue
            source = tuple(slice(0, n) if s > 0 else slice(1, n) for s, n in zip(signs, cells, strict=True))
            target = tuple(
                slice(0, n) if s > 0 else slice(length - 1, length - n, -1)
                for s, n, length in zip(signs, cells, padded_cells, strict=True)
            )
            result[component][target] = signs[i] * signs[j] * tensors[component][source]
    return result


def _closed_form_tensors(offsets: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the demagnetising tensors of cells at integer offsets, shape (6, n), by Newell's closed form.

    They are computed in the widest floating-point format.
    """
    wide_edges = np.asarray(edges, dtype=np.longdouble)
    result = np.zeros((6, len(offsets)), dtype=np.longdouble)
    for shift in itertools.product((-1, 0, 1), repeat=3):
        weight = np.prod([2.0 if s == 0 else -1.0 for s in shift])
        x, y, z = ((offsets + shift) * wide_edges).T
        values = (
            _newell_f(x, y, z),
            _newell_g(x, y, z),
            _newell_g(x, z, y),
            _newell_f(y, x, z),
            _newell_g(y, z, x),
            _newell_f(z, y, x),
        )
        for component, value in enumerate(values):
            result[component] += weight * value
    return np.asarray(result / (4.0 * np.longdouble(np.pi) * np.prod(wide_edges)), dtype=float)


def _newell_f(x, y, z):
    """Return Newell's function f(x, y, z), even in each argument [Newell, Williams & Dunlop 1993, eq. 27]."""
    x, y, z = np.abs(x), np.abs(y), np.abs(z)
    r = np.sqrt(x * x + y * y + z * z)
    return (
        0.5 * y * (z * z - x * x) * _asinh_ratio(y, x, z)
        + 0.5 * z * (y * y - x * x) * _asinh_ratio(z, x, y)
        - x * y * z * _atan_ratio(y * z, x * r)
        + (2.0 * x * x - y * y - z * z) * r / 6.0
    )


def _newell_g(x, y, z):
    """Return Newell's function g(x, y, z), odd in x and y and even in z [Newell, Williams & Dunlop 1993, eq. 32]."""
    z = np.abs(z)
    r = np.sqrt(x * x + y * y + z * z)
    return (
        x * y * z * _asinh_ratio(z, x, y)
        + y / 6.0 * (3.0 * z * z - y * y) * _asinh_ratio(x, y, z)
        + x / 6.0 * (3.0 * z * z - x * x) * _asinh_ratio(y, x, z)
        - z**3 / 6.0 * _atan_ratio(x * y, z * r)
        - 0.5 * z * y * y * _atan_ratio(x * z, y * r)
        - 0.5 * z * x * x * _atan_ratio(y * z, x * r)
        - x * y * r / 3.0
    )


def _asinh_ratio(a, b, c):
    """Return ``asinh(a / sqrt(b^2 + c^2))``, 0 where b = c = 0: it is multiplied by 0 there."""
    base = np.sqrt(b * b + c * c)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(base > 0.0, np.arcsinh(a / base), 0.0)


def _atan_ratio(a, b):
    """Return ``atan(a / b)``, 0 where b = 0: it is multiplied by 0 there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b != 0.0, np.arctan(a / b), 0.0)


def _mean_dipole_tensors(r: np.ndarray, edges: np.ndarray, n_nodes: int) -> np.ndarray:
    """Return ``V / 4 pi`` times the mean of the dipolar tensor over the vectors between two cells, shape (6, n)."""
    points, weights = triangle_density_gauss_rule(n_nodes)
    total = np.zeros((6, len(r)))
    for (a, u), (b, v), (c, w) in itertools.product(enumerate(points), repeat=3):
        tensor = dipole_tensor(r + np.array([u, v, w]) * edges)
        for component, (i, j) in enumerate(COMPONENTS):
            total[component] += weights[a] * weights[b] * weights[c] * tensor[:, i, j]
    return np.prod(edges) / (4.0 * np.pi) * total


@functools.cache
def triangle_density_gauss_rule(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and weights of Gauss quadrature with the density ``1 - |t|`` on [-1, 1].

    The recurrence of the orthogonal polynomials is computed by the Stieltjes procedure [Gautschi 2004].
    """
    t, w = np.polynomial.legendre.leggauss(2 * n_nodes + 2)
    t, w = np.concatenate([0.5 * (t - 1.0), 0.5 * (t + 1.0)]), np.tile(0.5 * w, 2)
    w = w * (1.0 - np.abs(t))
    previous, current = np.zeros_like(t), np.ones_like(t)
    beta: list[float] = []
    norm = np.sum(w)
    for _ in range(n_nodes - 1):  # the density is even, so the diagonal of the matrix is 0
        previous_beta = beta[-1] if beta else 0.0
        previous, current = current, t * current - previous_beta * previous
        new_norm = np.sum(w * current**2)
        beta.append(new_norm / norm)
        norm = new_norm
    matrix = np.diag(np.sqrt(beta), 1) + np.diag(np.sqrt(beta), -1)
    points, vectors = np.linalg.eigh(matrix)
    return points, vectors[0] ** 2
