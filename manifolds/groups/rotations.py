"""Logarithm of rotations, defined also where one plane is turned by pi."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..algebras.lie_algebra import LieAlgebra
from ..matrices.stumpff import HALF_TURN_MARGIN, leading_sign
from ..matrices.symmetric import eigh, symmetrize
from .maps import log


def rotation_log(algebra: LieAlgebra, g) -> jax.Array:
    """Return the logarithm in SO(n), also where one plane is turned by pi; the sign there is that of ``leading_sign``.

    With J the quarter turn of that plane, g times its half turn has a principal logarithm, which commutes with J:
    ``log g = log(g exp(-pi J)) + pi J``. If more than one plane is turned by pi, J may be any element of a
    continuum, and the result is NaN.
    """
    values, vectors = eigh(symmetrize(g))
    first_mask = _first_minimum_mask(values)
    second_mask = _first_minimum_mask(jnp.where(first_mask, jnp.inf, values))
    third_value = jnp.where(first_mask | second_mask, jnp.inf, values).min(axis=-1, keepdims=True)
    u, v = ((vectors * column[..., None, :]).sum(axis=-1) for column in (first_mask, second_mask))
    J = v[..., :, None] * u[..., None, :] - u[..., :, None] * v[..., None, :]
    sine = (J * (g - g.swapaxes(-1, -2))).sum(axis=(-2, -1))[..., None] / 4
    sign = jnp.where(jnp.abs(sine) > HALF_TURN_MARGIN, jnp.sign(sine), leading_sign(algebra.vee(J)))
    is_turned = (jnp.where(second_mask, values, 0.0).min(axis=-1, keepdims=True) < _MAX_HALF_TURN_COSINE) & (
        third_value > _MAX_HALF_TURN_COSINE
    )
    J = jnp.where(is_turned[..., None], sign[..., None] * J, 0.0)
    return log(algebra, g @ (np.eye(g.shape[-1]) + 2 * J @ J)) + jnp.pi * algebra.vee(J)


_MAX_HALF_TURN_COSINE = -1.0 + 2e-15
"""Cosines below this count as half turns: angles that differ from pi by less than 6e-8, and rounding."""


def _first_minimum_mask(values):
    """Return a mask of the first smallest entry along the last axis."""
    return jnp.arange(values.shape[-1]) == jnp.argmin(values, axis=-1)[..., None]  # no index that varies
