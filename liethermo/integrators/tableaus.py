"""Gauss-Legendre collocation: tableaus to the last bit, and the collocation polynomial between and beyond its nodes."""

from __future__ import annotations

import functools
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
