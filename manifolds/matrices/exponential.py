"""Functions of an angle that are smooth at zero, the matrix exponential, and Cayley's map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .chains import matrix_function_chain
from .linear import _one_norm, max_abs_entry, solve

HALF_TURN_MARGIN = 1e-8
"""Distance of an angle from pi below which rounding decides the sign of the axis: see :func:`leading_sign`.

In groups where the half turn has no axis, logarithms need eigenvalues at angles below pi minus this.
"""


def stumpff(order: int, z) -> jax.Array:
    """Return the Stumpff function ``c_p(z) = sum_k (-z)^k / (2k + p)!`` for p = 0, 1, 2, 3 and z >= 0, to rounding.

    With ``z = t**2``: cos t, sin t / t, (1 - cos t) / t**2, (t - sin t) / t**3.
    """
    closed_form = (jnp.cos, _sinc, lambda t: 0.5 * _sinc(t / 2) ** 2, lambda t: (t - jnp.sin(t)) / t**3)[order]
    return _series_or_closed_form(_stumpff_series(order, -1.0), closed_form, z, 1.0)


def hyperbolic_stumpff(order: int, z) -> jax.Array:
    """Return ``c_p(-z) = sum_k z^k / (2k + p)!`` for p = 0, 1, 2 and z >= 0, to rounding.

    With ``z = t**2``: cosh t, sinh t / t, (cosh t - 1) / t**2.
    """
    closed_form = (jnp.cosh, _sinhc, lambda t: 0.5 * _sinhc(t / 2) ** 2)[order]
    return _series_or_closed_form(_stumpff_series(order, 1.0), closed_form, z, 1.0)


def angle_over_sine(z, cosine) -> jax.Array:
    """Return ``atan2(s, c) / s`` with ``z = s**2``: the angle over the sine, for sine and cosine of any common scale.

    The function is smooth where z = 0 and c > 0; it is not finite where z = 0 and c < 0, at the angle pi.
    """
    use_series = (cosine > 0) & (z < 0.01 * cosine**2)
    s = jnp.sqrt(jnp.where(use_series, 1.0, z))
    c = jnp.where(use_series, cosine, 1.0)
    series = _power_series([(-1.0) ** k / (2 * k + 1) for k in range(9)], jnp.where(use_series, z, 0.0) / c**2) / c
    return jnp.where(use_series, series, jnp.arctan2(s, cosine) / s)


def arcsinh_over_sinh(z) -> jax.Array:
    """Return ``arcsinh(s) / s`` with ``z = s**2``, smooth at 0."""
    terms = [(-0.25) ** k * math.comb(2 * k, k) / (2 * k + 1) for k in range(9)]
    return _series_or_closed_form(terms, lambda s: jnp.arcsinh(s) / s, z, 0.01)


def leading_sign(x) -> jax.Array:
    """Return the sign of the first component larger than 1e-8 of the length, shape (..., 1).

    A half turn has two logarithms; the one whose axis has the leading sign 1 is returned, so that rounding cannot
    choose the other. Within HALF_TURN_MARGIN of the half turn its angle may then exceed pi by as much.
    """
    sign, threshold = jnp.ones((*x.shape[:-1], 1)), HALF_TURN_MARGIN * jnp.sqrt(_squared_length(x))
    for i in reversed(range(x.shape[-1])):
        component = x[..., i : i + 1]
        sign = jnp.where(component > threshold, 1.0, jnp.where(component < -threshold, -1.0, sign))
    return sign


def _sqrt_or_nan(z):
    """Return ``sqrt(z)``, NaN where z <= 0."""
    return jnp.sqrt(jnp.where(z > 0.0, z, jnp.nan))


def _sinc(t: jax.Array) -> jax.Array:
    return jnp.sin(t) / t


def _sinhc(t: jax.Array) -> jax.Array:
    return jnp.sinh(t) / t


def _power_series(coefficients: list[float], z) -> jax.Array:
    """Return ``sum_k coefficients[k] z^k``."""
    total = jnp.zeros_like(z)
    for coefficient in reversed(coefficients):
        total = coefficient + z * total
    return total


def _stumpff_series(order: int, sign: float) -> list[float]:
    """Return the coefficients of a Stumpff series for |z| <= 1; the first omitted term is below 1/20!."""
    return [sign**k / math.factorial(2 * k + order) for k in range(10)]


def _series_or_closed_form(coefficients: list[float], closed_form: Callable, z, radius: float) -> jax.Array:
    """Evaluate a power series in z for z < radius, and ``closed_form(sqrt z)`` beyond.

    Each branch receives arguments at which it is smooth, so that no gradient is NaN.
    """
    use_series = z < radius
    series = _power_series(coefficients, jnp.where(use_series, z, 0.0))
    return jnp.where(use_series, series, closed_form(jnp.sqrt(jnp.where(use_series, 1.0, z))))


def _squared_length(x: jax.Array) -> jax.Array:
    """Return ``|x|^2``, shape (..., 1)."""
    return jnp.sum(x**2, axis=-1, keepdims=True)


CAYLEY_CONDITION_LIMIT = 1e12
"""Condition number of I - X/2 above which X counts as a pole of the Cayley map."""


def expm(X) -> jax.Array:
    """Return the matrix exponential: [13/13] Padé approximant with scaling and squaring [Higham 2005].

    Derivatives of every order, in both modes, are blocks of the exponential of a larger matrix (:mod:`.chains`).
    ``jax.scipy.linalg.expm`` (0.10) rounds the number of squarings down, not up, and so loses up to eight digits at
    norms above 5.4. This function takes norms up to 3e5; larger ones give NaN.
    """
    return matrix_function_chain(Exponential(), [jnp.asarray(X)], (0,), np.zeros(1))


@dataclass(frozen=True)
class Exponential:
    """Exponential of any matrix, with its chains: see :class:`.chains.MatrixFunction`."""

    def decompose(self, a, unrolled: bool) -> tuple[jax.Array, ...]:
        return (a,)

    def chain(self, decompositions, slots, shifts, directions, unrolled: bool) -> jax.Array:
        """Return the last block of the first row of the exponential of a matrix with the directions beside its
        diagonal.

        The directions are scaled to the size of the matrices, so that they need no more squarings [Al-Mohy & Higham
        2009].
        """
        matrices = [a for (a,) in decompositions]
        k, dtype = len(directions), matrices[0].dtype
        diagonal = [
            matrices[slot] + shifts[..., j, None, None].astype(dtype) * np.eye(matrices[slot].shape[-1])
            for j, slot in enumerate(slots)
        ]
        if k == 0:
            return _pade_exponential(diagonal[0], unrolled)
        scales = [max_abs_entry(E)[..., None, None] for E in directions]
        scales = [jnp.where(size > 0.0, size, 1.0) for size in scales]
        batch = jnp.broadcast_shapes(*(a.shape[:-2] for a in (*diagonal, *directions)))
        rows = []
        for i, a in enumerate(diagonal):
            blocks = [jnp.zeros((*batch, a.shape[-1], b.shape[-1]), dtype) for b in diagonal]
            blocks[i] = jnp.broadcast_to(a, (*batch, *a.shape[-2:]))
            if i < k:
                E = directions[i] / scales[i]
                blocks[i + 1] = jnp.broadcast_to(E, (*batch, *E.shape[-2:]))
            rows.append(jnp.concatenate(blocks, axis=-1))
        block_exponential = _pade_exponential(jnp.concatenate(rows, axis=-2), unrolled)
        last_block = block_exponential[..., : diagonal[0].shape[-1], -diagonal[-1].shape[-1] :]
        for scale in scales:
            last_block = last_block * scale
        return last_block


def _pade_exponential(X, is_unrolled: bool) -> jax.Array:
    """Return the matrix exponential by the [13/13] Padé approximant with scaling and squaring, shape (..., n, n)."""
    identity = np.eye(X.shape[-1])
    squarings = jnp.ceil(jnp.log2(jnp.maximum(_one_norm(X) / _PADE_RADIUS, 1.0)))[..., None, None]
    Y, b = X / 2.0**squarings, _PADE_COEFFICIENTS
    Y2 = Y @ Y
    Y4 = Y2 @ Y2
    Y6 = Y4 @ Y2
    odd_terms = Y @ (Y6 @ (b[13] * Y6 + b[11] * Y4 + b[9] * Y2) + b[7] * Y6 + b[5] * Y4 + b[3] * Y2 + b[1] * identity)
    even_terms = Y6 @ (b[12] * Y6 + b[10] * Y4 + b[8] * Y2) + b[6] * Y6 + b[4] * Y4 + b[2] * Y2 + b[0] * identity
    quotient = jnp.linalg.solve if is_unrolled else solve
    g = identity + 2 * quotient(even_terms - odd_terms, odd_terms)  # not (even + odd): keeps the digits of a small X

    def square_if_needed(state):
        k, g = state
        return k + 1.0, jnp.where(k < squarings, g @ g, g)

    n_squarings = jnp.minimum(jnp.max(squarings), _MAX_SQUARINGS)
    g = jax.lax.while_loop(lambda state: state[0] < n_squarings, square_if_needed, (jnp.zeros(()), g))[1]
    return jnp.where(squarings <= _MAX_SQUARINGS, g, jnp.nan)


_PADE_RADIUS = 5.371920351148152
"""Largest 1-norm at which the [13/13] approximant is accurate to rounding [Higham 2005]."""
_PADE_COEFFICIENTS = [math.comb(13, k) * math.factorial(26 - k) / math.factorial(26) for k in range(14)]
_MAX_SQUARINGS = 16
"""Largest number of squarings, for norms up to 3e5."""


def cayley_of(X) -> jax.Array:
    """Return ``I + (I - X/2)^-1 X``, NaN where I - X/2 is singular."""
    identity = jnp.eye(X.shape[-1])
    denominator = identity - X / 2
    g = identity + solve(denominator, X)
    condition = max_abs_entry(denominator) * max_abs_entry(identity + g) / 2  # I + g = 2 (I - X/2)^-1
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None, None], g, jnp.nan)
