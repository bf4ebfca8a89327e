"""Functions of an angle and of its square that are smooth where it vanishes."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

HALF_TURN_MARGIN = 1e-8
"""At angles above pi minus this, noise decides the sign of an axis: see :func:`leading_sign`.

In groups where the half turn has no axis, logarithms are taken of eigenvalues at angles below only.
"""


def stumpff(order: int, z) -> jax.Array:
    """Stumpff function ``c_p(z) = sum_k (-z)^k / (2k + p)!`` for p = 0, 1, 2, 3 and z >= 0, to rounding.

    With ``z = t**2``: cos t, sin t / t, (1 - cos t) / t**2, (t - sin t) / t**3.
    """
    far = (jnp.cos, _sinc, lambda t: 0.5 * _sinc(t / 2) ** 2, lambda t: (t - jnp.sin(t)) / t**3)[order]
    return _piecewise(_stumpff_series(order, -1.0), far, z, 1.0)


def hyperbolic_stumpff(order: int, z) -> jax.Array:
    """``c_p(-z) = sum_k z^k / (2k + p)!`` for p = 0, 1, 2 and z >= 0, to rounding.

    With ``z = t**2``: cosh t, sinh t / t, (cosh t - 1) / t**2.
    """
    far = (jnp.cosh, _sinhc, lambda t: 0.5 * _sinhc(t / 2) ** 2)[order]
    return _piecewise(_stumpff_series(order, 1.0), far, z, 1.0)


def angle_over_sine(z, cosine) -> jax.Array:
    """``atan2(s, c) / s`` with ``z = s**2``: the angle over the sine, for sine and cosine of any common scale.

    Smooth where z = 0 and c > 0; not finite where z = 0 and c < 0, at the angle pi.
    """
    small = (cosine > 0) & (z < 0.01 * cosine**2)
    s = jnp.sqrt(jnp.where(small, 1.0, z))
    c = jnp.where(small, cosine, 1.0)
    near = _power_series([(-1.0) ** k / (2 * k + 1) for k in range(9)], jnp.where(small, z, 0.0) / c**2) / c
    return jnp.where(small, near, jnp.arctan2(s, cosine) / s)


def arcsinh_over_sinh(z) -> jax.Array:
    """``arcsinh(s) / s`` with ``z = s**2``, smooth at 0."""
    terms = [(-0.25) ** k * math.comb(2 * k, k) / (2 * k + 1) for k in range(9)]
    return _piecewise(terms, lambda s: jnp.arcsinh(s) / s, z, 0.01)


def leading_sign(x) -> jax.Array:
    """Sign of the first component that is not zero (1e-8 of the length, which is not zero), shape (..., 1).

    The axis of a half turn is taken to have the sign 1: of the two logarithms one is so chosen, and rounding chooses no
    other. Within HALF_TURN_MARGIN of the half turn its angle may then be larger than pi by as much.
    """
    sign, least = jnp.ones((*x.shape[:-1], 1)), HALF_TURN_MARGIN * jnp.sqrt(_squared_length(x))
    for i in reversed(range(x.shape[-1])):
        component = x[..., i : i + 1]
        sign = jnp.where(component > least, 1.0, jnp.where(component < -least, -1.0, sign))
    return sign


def _root_or_nan(z):
    """``sqrt(z)``, NaN where z <= 0."""
    return jnp.sqrt(jnp.where(z > 0.0, z, jnp.nan))


def _sinc(t: jax.Array) -> jax.Array:
    return jnp.sin(t) / t


def _sinhc(t: jax.Array) -> jax.Array:
    return jnp.sinh(t) / t


def _power_series(coefficients: list[float], z) -> jax.Array:
    """``sum_k coefficients[k] z^k``."""
    total = jnp.zeros_like(z)
    for coefficient in reversed(coefficients):
        total = coefficient + z * total
    return total


def _stumpff_series(order: int, sign: float) -> list[float]:
    """Enough terms for |z| <= 1: the first one left out is below 1/20!."""
    return [sign**k / math.factorial(2 * k + order) for k in range(10)]


def _piecewise(coefficients: list[float], far: Callable, z, radius: float) -> jax.Array:
    """A power series in z up to a radius, ``far(sqrt z)`` beyond.

    Both sides see arguments where they are smooth, so no NaN gradient.
    """
    small = z < radius
    near = _power_series(coefficients, jnp.where(small, z, 0.0))
    return jnp.where(small, near, far(jnp.sqrt(jnp.where(small, 1.0, z))))


def _squared_length(x: jax.Array) -> jax.Array:
    """``|x|^2``, shape (..., 1)."""
    return jnp.sum(x**2, axis=-1, keepdims=True)
