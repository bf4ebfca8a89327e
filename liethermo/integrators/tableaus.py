"""Tableaus: Gauss-Legendre collocation with its polynomial, and explicit steps on the Lobatto nodes."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from ..functions.path import KronrodRule

MAX_STAGES = 8
"""Largest number of Gauss nodes."""


class GaussTableau(NamedTuple):
    """The Gauss method of s stages on [0, 1], order 2s [Hairer, Lubich & Wanner 2006, II.1].

    Attributes
    ----------
    A : ndarray, shape (s, s)
    b, c : ndarray, shape (s,)
    """

    A: np.ndarray
    b: np.ndarray
    c: np.ndarray


@functools.cache
def gauss_tableau(stages: int) -> GaussTableau:
    """Return the tableau of s Gauss nodes, each entry rounded once from extended precision."""
    A, b, c = _extended_precision_tableau(stages)
    return GaussTableau(*(np.asarray(a, dtype=np.float64) for a in (A, b, c)))


@functools.cache
def extrapolation_matrix(stages: int) -> np.ndarray:
    """Return the matrix, shape (s, s), that extrapolates the stage slopes to the next step by their polynomial."""
    return _lagrange_values(stages, 1 + _extended_precision_tableau(stages)[2]).astype(np.float64)


@functools.cache
def start_slope_weights(stages: int) -> np.ndarray:
    """Return weights w with ``u'(0) = w @ k``, where u is the collocation polynomial, shape (s,)."""
    return _lagrange_values(stages, np.zeros((), dtype=np.longdouble)).astype(np.float64)


def interpolation_weights(stages: int, theta) -> np.ndarray:
    """Return weights w, shape (..., s): ``u(theta) = x + h w @ k`` is the collocation polynomial at t + theta h."""
    nodes = 2 * np.asarray(theta, dtype=np.float64) - 1
    values = _legendre_values(stages, nodes)
    return _legendre_integrals(values) @ _lagrange_coefficients(stages).astype(np.float64)


@functools.cache
def kronrod_rule(stages: int) -> KronrodRule | None:
    """Return the Kronrod rule of 1 Gauss node (1 + 2 nodes, degree 5) or 2 (2 + 3, degree 7); None for more."""
    if stages > 2:
        return None
    if stages == 1:
        offsets, b, change = [-((3 / 5) ** 0.5), (3 / 5) ** 0.5], [5 / 18, 5 / 18], [-5 / 9]
    else:
        offsets, b = [-((6 / 7) ** 0.5), 0.0, (6 / 7) ** 0.5], [49 / 495, 14 / 45, 49 / 495]
        change = [-14 / 55, -14 / 55]
    theta = (1 + np.array(offsets)) / 2
    slopes = _lagrange_values(stages, theta).astype(np.float64)
    return KronrodRule(interpolation_weights(stages, theta), slopes, np.array(b), np.array(change))


def _extended_precision_tableau(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, b and c of the Gauss method in extended precision."""
    x, b = _gauss_rule(stages)
    return _legendre_integrals(_legendre_values(stages, x)) @ _lagrange_coefficients(stages), b, (1 + x) / 2


@functools.cache
def _gauss_rule(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss nodes on [-1, 1] and weights on [0, 1] in extended precision."""
    x = np.polynomial.legendre.leggauss(stages)[0].astype(np.longdouble)
    for _ in range(2):  # Newton's method from double precision; the second pass has the slope at the root
        values = _legendre_values(stages, x)
        slope = stages * (values[..., stages - 1] - x * values[..., stages]) / (1 - x * x)
        x = x - values[..., stages] / slope
    return x, 1 / ((1 - x * x) * slope**2)


def _lagrange_coefficients(stages: int) -> np.ndarray:
    """Return the Lagrange polynomials of the nodes in Legendre polynomials: entry m, j is ``(2m + 1) b_j P_m(x_j)``."""
    x, b = _gauss_rule(stages)
    return ((2 * np.arange(stages) + 1) * b[:, None] * _legendre_values(stages, x)[:, :stages]).T


def _lagrange_values(stages: int, theta) -> np.ndarray:
    """Return the Lagrange polynomials of the Gauss nodes at theta, shape (..., s)."""
    return _legendre_values(stages, 2 * theta - 1)[..., :stages] @ _lagrange_coefficients(stages)


def _legendre_values(stages: int, x) -> np.ndarray:
    """Return the Legendre polynomials ``P_0 … P_s`` at x, shape (..., s + 1), where s is ``stages``."""
    values = [np.ones_like(x), x]
    for m in range(1, stages):
        values.append(((2 * m + 1) * x * values[m] - m * values[m - 1]) / (m + 1))
    return np.stack(values, axis=-1)


def _legendre_integrals(values: np.ndarray) -> np.ndarray:
    """Return the integrals over [0, theta] of the shifted ``P_0 … P_(s-1)``, from the values of ``P_0 … P_s`` there."""
    stages = values.shape[-1] - 1
    integral_0 = (1 + values[..., 1:2]) / 2
    m = np.arange(1, stages)
    return np.concatenate([integral_0, (values[..., 2:] - values[..., :-2]) / (2 * (2 * m + 1))], axis=-1)


class ErrorEstimate(NamedTuple):
    """Estimate of the local error of a step of length l, ``scale l (|E| / l)^(p / q)`` with ``E = h sum_i d_i k_i``.

    Here p is the order of the method, and E is O(h^(q + 1)).

    Attributes
    ----------
    weights : ndarray, shape (s,)
        The weights d.
    order : int
        The exponent q.
    scale : float
        The factor with which the estimate is right as h -> 0.
    """

    weights: np.ndarray
    order: int
    scale: float


class ExplicitTableau(NamedTuple):
    """Tableau of an explicit Runge-Kutta method: ``X_i = x + h sum_j A_ij k_j``, ``x' = x + h sum_i b_i k_i``.

    Attributes
    ----------
    A, b : ndarray, shapes (s, s) and (s,)
    error_estimate : ErrorEstimate
        Estimate that is right for a linear equation x' = a x.
    quadrature_error_estimate : ErrorEstimate or None
        Estimate that is right for a quadrature x' = f(t); None if the other one responds to it. At orders 6 and 8 the
        other one does not: its weights add up to zero at each node.
    """

    A: np.ndarray
    b: np.ndarray
    error_estimate: ErrorEstimate
    quadrature_error_estimate: ErrorEstimate | None


RESPONSE_RTOL = 1e-8
"""Response of error weights to the vector of a tree that counts as none, relative to the vector."""

LOBATTO_ORDERS = (4, 6, 8)
"""Orders for which there is a tableau."""


@functools.cache
def lobatto_nodes_and_weights(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (with both ends) and weights on [0, 1]: exact to degree ``2 n_nodes - 3``, all weights positive."""
    m = n_nodes - 1  # the inner nodes are the roots of P_m'
    x = np.polynomial.legendre.Legendre.basis(m).deriv().roots().astype(np.longdouble)
    for _ in range(3):  # Newton's method from double precision
        values, previous_values = _legendre_value(m, x), _legendre_value(m - 1, x)
        slope = m * (previous_values - x * values) / (1 - x * x)
        x = x - slope * (1 - x * x) / (2 * x * slope - m * n_nodes * values)
    x = np.concatenate([[-1], np.sort(x), [1]])
    b = 1 / (m * n_nodes * _legendre_value(m, x) ** 2)
    return ((1 + x) / 2).astype(np.float64), b.astype(np.float64)


def _legendre_value(m: int, x) -> np.ndarray:
    """Return the Legendre polynomial ``P_m`` at x, of the shape of x."""
    return np.polynomial.legendre.Legendre.basis(m)(x)


@functools.cache
def explicit_lobatto_tableau(order: int) -> ExplicitTableau:
    """Return the explicit tableau with Lobatto weights of order 4 [Kutta 1901], 6 [Butcher 1964] or 8.

    That of order 8 is by Cooper and Verner (1972).
    """
    A, b = {4: _kutta_coefficients, 6: _butcher_coefficients, 8: _cooper_verner_coefficients}[order]()
    nodes = A.sum(axis=1)
    powers = [np.ones(len(b))]
    for _ in range(order):
        powers.append(A @ powers[-1])  # A^n 1: for a linear equation, order n + 1 means b . A^n 1 = 1 / (n + 1)!
    # c^n / n!: for a quadrature, order n + 1 means b . c^n / n! = 1 / (n + 1)!
    monomials = [nodes**n / math.factorial(n) for n in range(order + 1)]
    estimate = _error_estimate(A, b, order, powers)
    responds_to_quadrature = abs(estimate.weights @ monomials[estimate.order]) > RESPONSE_RTOL
    return ExplicitTableau(A, b, estimate, None if responds_to_quadrature else _error_estimate(A, b, order, monomials))


def _error_estimate(A: np.ndarray, b: np.ndarray, order: int, tree_vectors: list[np.ndarray]) -> ErrorEstimate:
    """Return the error estimate that is exact for equations whose steps contain only the given rooted trees.

    ``tree_vectors[q]`` is the stage vector of the tree with q + 1 nodes. The weights vanish on all rooted trees of at
    most q nodes, with the largest possible q.
    """
    weights, q = _error_weights_and_order(A, order, tree_vectors)
    residual = abs(1.0 / math.factorial(order + 1) - b @ tree_vectors[order])
    response = abs(weights @ tree_vectors[q])
    assert response > 0.0
    return ErrorEstimate(weights, q, residual / response ** (order / q))


def _error_weights_and_order(A: np.ndarray, order: int, tree_vectors: list[np.ndarray]) -> tuple[np.ndarray, int]:
    """Return the weights of an error estimate, and its order q: it vanishes on rooted trees of at most q nodes."""
    vectors = rooted_tree_vectors(A, order - 1)
    for q in range(order - 1, 0, -1):
        conditions = np.array([v for n in range(1, q + 1) for v in vectors[n]])
        _, singular_values, right_vectors = np.linalg.svd(conditions)
        null_space = right_vectors[np.sum(singular_values > 1e-10 * singular_values[0]) :]
        response = null_space @ tree_vectors[q]  # choose the weights with the largest response
        if np.linalg.norm(response) > RESPONSE_RTOL * np.linalg.norm(tree_vectors[q]):
            return response @ null_space / np.linalg.norm(response), q
    raise AssertionError("every tableau has an error estimate of order 1")


def rooted_tree_vectors(A: np.ndarray, order: int) -> dict[int, list[np.ndarray]]:
    """Return, for each number of nodes up to ``order``, the stage vectors of the rooted trees with that many nodes.

    The vector of a tree is the product of ``A v`` over its branches, with v the vectors of the branches. A method has
    order p if ``b . v`` is one over the density of the tree, for all trees of at most p nodes [Hairer, Nørsett & Wanner
    1993, II.2].
    """
    vectors: dict[int, list[np.ndarray]] = {1: [np.ones(len(A))]}
    for n in range(2, order + 1):
        vectors[n] = list(_forest_products(A, vectors, n - 1, n - 1))
    return vectors


def _forest_products(A, vectors, n_nodes: int, max_branch_nodes: int):
    """Yield the products of branches with ``n_nodes`` nodes in total, at most ``max_branch_nodes`` in each branch."""
    if n_nodes == 0:
        yield np.ones(len(A))
        return
    for branch_nodes in range(min(n_nodes, max_branch_nodes), 0, -1):
        for v in vectors[branch_nodes]:
            for remaining_product in _forest_products(A, vectors, n_nodes - branch_nodes, branch_nodes):
                yield (A @ v) * remaining_product


def _kutta_coefficients() -> tuple[np.ndarray, np.ndarray]:
    A = np.zeros((4, 4))
    A[1, 0], A[2, 1], A[3, 2] = 0.5, 0.5, 1.0
    return A, np.array([1, 2, 2, 1]) / 6


def _butcher_coefficients() -> tuple[np.ndarray, np.ndarray]:
    s, A = np.sqrt(5.0), np.zeros((7, 7))
    A[1, 0] = (5 - s) / 10
    A[2, :2] = -s / 10, (5 + 2 * s) / 10
    A[3, :3] = (-15 + 7 * s) / 20, (-1 + s) / 4, (15 - 7 * s) / 10
    A[4, :4] = (5 - s) / 60, 0, 1 / 6, (15 + 7 * s) / 60
    A[5, :5] = (5 + s) / 60, 0, (9 - 5 * s) / 12, 1 / 6, (-5 + 3 * s) / 10
    A[6, :6] = 1 / 6, 0, (-55 + 25 * s) / 12, (-25 - 7 * s) / 12, 5 - 2 * s, (5 + s) / 2
    return A, np.array([1, 0, 0, 0, 5, 5, 1]) / 12


def _cooper_verner_coefficients() -> tuple[np.ndarray, np.ndarray]:
    s, A, b = np.sqrt(21.0), np.zeros((11, 11)), np.zeros(11)
    A[1, 0] = 1 / 2
    A[2, :2] = 1 / 4, 1 / 4
    A[3, :3] = 1 / 7, (-7 - 3 * s) / 98, (21 + 5 * s) / 49
    A[4, :4] = (11 + s) / 84, 0, (18 + 4 * s) / 63, (21 - s) / 252
    A[5, :5] = (5 + s) / 48, 0, (9 + s) / 36, (-231 + 14 * s) / 360, (63 - 7 * s) / 80
    A[6, :6] = (10 - s) / 42, 0, (-432 + 92 * s) / 315, (633 - 145 * s) / 90, (-504 + 115 * s) / 70, (63 - 13 * s) / 35
    A[7, :7] = 1 / 14, 0, 0, 0, (14 - 3 * s) / 126, (13 - 3 * s) / 63, 1 / 9
    A[8, :8] = 1 / 32, 0, 0, 0, (91 - 21 * s) / 576, 11 / 72, (-385 - 75 * s) / 1152, (63 + 13 * s) / 128
    A[9, :4] = 1 / 14, 0, 0, 0
    A[9, 4:9] = 1 / 9, (-733 - 147 * s) / 2205, (515 + 111 * s) / 504, (-51 - 11 * s) / 56, (132 + 28 * s) / 245
    A[10, 4:7] = (-42 + 7 * s) / 18, (-18 + 28 * s) / 45, (-273 - 53 * s) / 72
    A[10, 7:10] = (301 + 53 * s) / 72, (28 - 28 * s) / 45, (49 - 7 * s) / 18
    b[[0, 7, 8, 9, 10]] = 1 / 20, 49 / 180, 16 / 45, 49 / 180, 1 / 20
    return A, b
