"""Functions of an angle and of its square that are smooth at zero."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

HALF_TURN_MARGIN = 1e-8
"""Distance of an angle from pi below which rounding decides the sign of the axis: see :func:`leading_sign`.

In groups where the half turn has no axis, logarithms need eigenvalues at angles below pi minus this.
"""


def stumpff(order: int, z) -> jax.Array:
    """Return the Stumpff function ``c_p(z) = sum_k (-z)^k / (2k + p)!`` for p = 0, 1, 2, 3 and z >= 0, to rounding.

    With ``z = t**2``: cos t, sin t / t, (1 - cos t) / t**2, (t - sin t) / t**3.
    """
    closed_form = (jnp.cos, _sinc, lambda t: 0.5 * _sinc(t / 2) ** 2, lambda t: (t - jnp.sin(t)) / t**3)[order]
    return _piecewise(_stumpff_series(order, -1.0), closed_form, z, 1.0)


def hyperbolic_stumpff(order: int, z) -> jax.Array:
    """Return ``c_p(-z) = sum_k z^k / (2k + p)!`` for p = 0, 1, 2 and z >= 0, to rounding.

    With ``z = t**2``: cosh t, sinh t / t, (cosh t - 1) / t**2.
    """
    closed_form = (jnp.cosh, _sinhc, lambda t: 0.5 * _sinhc(t / 2) ** 2)[order]
    return _piecewise(_stumpff_series(order, 1.0), closed_form, z, 1.0)


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
    return _piecewise(terms, lambda s: jnp.arcsinh(s) / s, z, 0.01)


def leading_sign(x) -> jax.Array:
    """Return the sign of the first component larger than 1e-8 of the length, shape (..., 1).

    A half turn has two logarithms; the one whose axis has the leading sign 1 is returned, so that rounding cannot
    choose
    the other. Within HALF_TURN_MARGIN of the half turn its angle may then exceed pi by as much.
    """
    sign, threshold = jnp.ones((*x.shape[:-1], 1)), HALF_TURN_MARGIN * jnp.sqrt(_squared_length(x))
    for i in reversed(range(x.shape[-1])):
        component = x[..., i : i + 1]
        sign = jnp.where(component > threshold, 1.0, jnp.where(component < -threshold, -1.0, sign))
    return sign


def _root_or_nan(z):
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


def _piecewise(coefficients: list[float], closed_form: Callable, z, radius: float) -> jax.Array:
    """Evaluate a power series in z for z < radius, and ``closed_form(sqrt z)`` beyond.

    Each branch receives arguments at which it is smooth, so that no gradient is NaN.
    """
    use_series = z < radius
    series = _power_series(coefficients, jnp.where(use_series, z, 0.0))
    return jnp.where(use_series, series, closed_form(jnp.sqrt(jnp.where(use_series, 1.0, z))))


def _squared_length(x: jax.Array) -> jax.Array:
    """Return ``|x|^2``, shape (..., 1)."""
    return jnp.sum(x**2, axis=-1, keepdims=True)
