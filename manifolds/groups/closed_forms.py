"""Closed formulas of particular groups: exp, log and Cayley maps, distances, equations and inverses.

The exponentials are combinations of the Stumpff functions of the squared angle, entire functions with no division at
zero, so values keep full relative accuracy down to the smallest angle and derivatives of every order exist there. The
logarithms use :func:`manifolds.matrices.exponential.angle_over_sine`, which is smooth at zero too.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from ..algebras.lie_algebra import LieAlgebra
from ..matrices.exponential import (
    HALF_TURN_MARGIN,
    _sqrt_or_nan,
    _squared_length,
    angle_over_sine,
    leading_sign,
    stumpff,
)
from ..matrices.linear import adjoint, determinant, inverse, max_abs_entry, newton_schulz_step
from ..matrices.symmetric import eigh, symmetrize
from .maps import log


def exp_so2(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rotation of the plane by the angle x: ``cos(x) I + sin(x)/x X`` with X = hat(x)."""
    z = _squared_length(x)[..., None]
    return stumpff(0, z) * np.eye(2) + stumpff(1, z) * algebra.hat(x)


def log_so2(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the angle from its sine and cosine, between -pi + HALF_TURN_MARGIN and pi + HALF_TURN_MARGIN."""
    sine, cosine = ((g - g.swapaxes(-1, -2)) / 2)[..., 0, 1:2], (g[..., :1, 0] + g[..., 1:2, 1]) / 2
    angle = jnp.arctan2(sine, cosine)
    angle = jnp.where(angle < HALF_TURN_MARGIN - math.pi, angle + 2 * math.pi, angle)
    return jnp.where(cosine < 0, angle, angle_over_sine(sine**2, cosine) * sine)


def exp_so3(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rotation about x by the angle ``|x|``, by Rodrigues' formula with X = hat(x)."""
    z, X = _squared_length(x)[..., None], algebra.hat(x)
    return jnp.eye(3) + stumpff(1, z) * X + stumpff(2, z) * X @ X


def log_so3(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the rotation vector from the quaternion, accurate at every angle; half turns use :func:`leading_sign`."""
    w, v = _scaled_quaternion(g)
    sign = jnp.where(_rotation_angle(w, v) > math.pi - HALF_TURN_MARGIN, leading_sign(v), 1.0)
    return 2 * angle_over_sine(_squared_length(v), sign * w) * sign * v


def cayley_so3(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rotation ``I + (X + X^2/2) / (1 + |x|^2/4)``, the Cayley map of X = hat(x)."""
    X = algebra.hat(x)[..., :3, :3]
    return jnp.eye(3) + (X + X @ X / 2) / (1.0 + _squared_length(x[..., :3])[..., None] / 4)


def inverse_cayley_so3(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the components x with ``cayley(x) = g``: ``2 tan(a/2)`` times the axis, for the rotation angle a."""
    w, v = _scaled_quaternion(g)
    return jnp.where(_rotation_angle(w, v) <= math.pi - HALF_TURN_MARGIN, 2 * v / w, jnp.nan)


def exp_se3(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rigid motion of the twist x = (w, u): Rodrigues' rotation and translation, with W = hat(w)."""
    z, u = _squared_length(x[..., :3])[..., None], x[..., 3:, None]
    W = algebra.hat(x)[..., :3, :3]
    rotation = jnp.eye(3) + stumpff(1, z) * W + stumpff(2, z) * W @ W
    return affine_matrix(rotation, u + W @ (stumpff(2, z) * u + stumpff(3, z) * W @ u))


def log_rigid(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the twist of a rigid motion in the plane or in space: the components (w, u) of its logarithm.

    ``d = (1 - (a/2) cot(a/2)) / a^2`` for the angle a; in Stumpff functions of the half angle, d = (c2 - c3) / (4 c1):
    no cancellation.
    """
    rotation, t = g[..., :-1, :-1], g[..., :-1, -1:]
    w = (log_so2 if t.shape[-2] == 2 else log_so3)(algebra, rotation)
    W = algebra.hat(jnp.concatenate([w, jnp.zeros_like(t[..., 0])], axis=-1))[..., :-1, :-1]
    z = _squared_length(w)[..., None] / 4
    d = (stumpff(2, z) - stumpff(3, z)) / (4 * stumpff(1, z))
    u = t - W @ (t / 2 - d * (W @ t))
    return jnp.concatenate([w, u[..., 0]], axis=-1)


def cayley_se3(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rigid motion of the Cayley map: rotation R and translation ``(R u + u) / 2`` for x = (w, u)."""
    rotation, u = cayley_so3(algebra, x), x[..., 3:, None]
    return affine_matrix(rotation, 0.5 * (rotation @ u + u))


def inverse_cayley_se3(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the twist (w, u) with ``cayley((w, u)) = g``, u being ``(I - W/2) t`` for the translation t."""
    w, t = inverse_cayley_so3(algebra, g[..., :3, :3]), g[..., :3, 3]
    return jnp.concatenate([w, t - jnp.cross(w, t) / 2], axis=-1)


def exp_su2(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the SU(2) matrix ``cos(|x|/2) I + sin(|x|/2) X / (|x|/2)`` with X = hat(x)."""
    z = _squared_length(x)[..., None] / 4
    return stumpff(0, z) * np.eye(2) + stumpff(1, z) * algebra.hat(x)


def log_su2(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the rotation vector of length below 2 pi: g is the unit quaternion ``w - i v . sigma``."""
    w, v = _su2_quaternion(g)
    return jnp.where(
        _rotation_angle(w, v) <= 2 * (math.pi - HALF_TURN_MARGIN),
        2 * angle_over_sine(_squared_length(v), w) * v,
        jnp.nan,
    )


def inverse_cayley_su2(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the components x with ``cayley(x) = g``: ``4 tan(a/4)`` times the axis, for the angle a of g."""
    w, v = _su2_quaternion(g)
    square = jnp.where(w > 0, 1.0, _squared_length(v))
    x = 4 * v * jnp.where(w > 0, 1 / jnp.where(w > 0, 1 + w, 1.0), (1 - w) / square)  # 1 + w may cancel
    return jnp.where(_rotation_angle(w, v) <= 2 * (math.pi - HALF_TURN_MARGIN), x, jnp.nan)


def element_with_cayley_adjoint_gl2(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the 2 x 2 matrix g with ``Ad(g) = cay(ad x)``: for trace 0 ``(I + X) / sqrt(det(I + X))``, X = hat(x).

    X^2 is a number, so that both sides of ``Ad(g) = cay(ad x)`` turn, or boost, by the same angle. NaN where
    det(I + X) <= 0.
    """
    X, identity = algebra.hat(x), jnp.eye(2)
    half = jnp.trace(X, axis1=-2, axis2=-1)[..., None, None] / 2
    X = X - half * identity
    square = -jnp.trace(X @ X, axis1=-2, axis2=-1).real[..., None, None] / 2
    return jnp.exp(half) * (identity + X) / _sqrt_or_nan(1.0 + square)


def element_with_cayley_adjoint_so4(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rotation g of R^4 with ``Ad(g) = cay(ad x)``, by the self-dual and anti-self-dual parts of hat(x)."""
    X, identity = algebra.hat(x), jnp.eye(4)
    rows = [[X[..., i, j] for j in range(4)] for i in range(4)]
    dual = jnp.zeros_like(X)
    for i, j, k, m in [(0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (1, 2, 0, 3), (3, 1, 0, 2), (2, 3, 0, 1)]:
        dual = dual.at[..., i, j].set(rows[k][m]).at[..., j, i].set(rows[m][k])
    factors = [identity + (X + sign * dual) / 2 for sign in (1.0, -1.0)]
    norms = [jnp.sqrt((f**2).sum(axis=(-2, -1), keepdims=True)) / 2 for f in factors]
    return (factors[0] / norms[0]) @ (factors[1] / norms[1])


def element_with_cayley_adjoint_se3(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the rigid motion g with ``Ad(g) = cay(ad x)``: the Cayley map of the dual rotation."""
    w, u = x[..., :3], x[..., 3:]
    translation = (u + jnp.cross(w, u) / 2) / (1.0 + _squared_length(w) / 4)
    return affine_matrix(cayley_so3(algebra, x), translation[..., None])


def exp_heisenberg(algebra: LieAlgebra, x: jax.Array) -> jax.Array:
    """Return the exponential ``I + X + X^2/2`` of X = hat(x), exact as X^3 = 0, and so the Cayley map too."""
    X = algebra.hat(x)
    return jnp.eye(X.shape[-1]) + X + X @ X / 2


def log_heisenberg(algebra: LieAlgebra, g: jax.Array) -> jax.Array:
    """Return the components of the logarithm ``N - N^2/2``, with N = g - I."""
    N = g - np.eye(g.shape[-1])
    return algebra.vee(N - N @ N / 2)


# -- distance from the group, relative to the size of g ---------------------------------------------------------


def special_unitary_defect(g) -> jax.Array:
    """Return the distance of ``g^H g`` from I, or of ``det g`` from 1 if that is larger."""
    return jnp.maximum(max_abs_entry(adjoint(g) @ g - np.eye(g.shape[-1])), jnp.abs(determinant(g) - 1.0))


def rigid_defect(g) -> jax.Array:
    """Return the distance of the linear part from the rotations, or of the last row from (0, …, 0, 1) if that is
    larger."""
    last_row_residual = jnp.abs(g[..., -1, :] - np.eye(g.shape[-1])[-1]).max(axis=-1)
    return jnp.maximum(special_unitary_defect(g[..., :-1, :-1]), last_row_residual)


def unimodular_defect(g) -> jax.Array:
    """Return the distance of ``det g`` from 1, relative to the product of the norms of the rows.

    A relative change of g changes the determinant by as much.
    """
    row_norm_product = jnp.prod(jnp.linalg.norm(g, axis=-1), axis=-1)
    return jnp.abs(determinant(g) - 1.0) / jnp.maximum(row_norm_product, 1.0)


def symplectic_defect(g) -> jax.Array:
    """Return the distance of ``g^* g`` from I relative to the squared size of g, with ``g^* = -J g^T J``."""
    scale = jnp.maximum(max_abs_entry(g) ** 2, 1.0)
    return max_abs_entry(symplectic_inverse(g) @ g - np.eye(g.shape[-1])) / scale


def invertible_defect(g) -> jax.Array:
    """Return 0 for an invertible matrix; infinity if its condition number makes it singular to rounding."""
    condition = g.shape[-1] * max_abs_entry(g) * max_abs_entry(inverse(g))
    return jnp.where(condition * np.finfo(float).eps < 1.0, 0.0, jnp.inf)


def heisenberg_defect(g) -> jax.Array:
    """Return the largest entry of ``|g - I|`` outside the coordinates ``g[0, 1:]`` and ``g[:-1, -1]``."""
    return max_abs_entry(jnp.where(_heisenberg_coordinate_mask(g), 0.0, g - np.eye(g.shape[-1])))


# -- equations: they vanish on the group, and products from the right with its elements do not change them ----------


def orthogonal_equations(g) -> jax.Array:
    """Return the entries of ``g g^T - I`` on and above the diagonal."""
    n = g.shape[-1]
    return (g @ g.swapaxes(-1, -2) - np.eye(n))[..., *np.triu_indices(n)]


def rigid_equations(g) -> jax.Array:
    """Return the orthogonal equations of the linear part, and the last row minus (0, …, 0, 1)."""
    last_row_residual = g[..., -1, :] - np.eye(g.shape[-1])[-1]
    return jnp.concatenate([orthogonal_equations(g[..., :-1, :-1]), last_row_residual], axis=-1)


def symplectic_equations(g) -> jax.Array:
    """Return the entries of ``g J g^T - J`` above the diagonal; for 2 x 2 matrices ``det g - 1``."""
    n = g.shape[-1] // 2
    top, bottom = g[..., :n], g[..., n:]
    form = top @ bottom.swapaxes(-1, -2)
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    return (form - form.swapaxes(-1, -2) - J)[..., *np.triu_indices(2 * n, 1)]


def unimodular_equations(g) -> jax.Array:
    """Return ``det g - 1``, shape (..., 1)."""
    return determinant(g)[..., None] - 1.0


def special_unitary_equations(g) -> jax.Array:
    """Return independent real and imaginary parts of ``g g^H - I``, and the imaginary part of ``det g``."""
    n = g.shape[-1]
    residual = g @ adjoint(g) - np.eye(n)
    parts = residual.real[..., *np.triu_indices(n)], residual.imag[..., *np.triu_indices(n, 1)]
    return jnp.concatenate([*parts, determinant(g).imag[..., None]], axis=-1)


# -- inverses -----------------------------------------------------------------------------------------------------


def rigid_inverse(g) -> jax.Array:
    """Return the inverse rigid motion ``[[R^T, -R^T t], [0, 1]]`` of the rotation R and translation t of g."""
    rotation_transpose = g[..., :-1, :-1].swapaxes(-1, -2)
    return affine_matrix(rotation_transpose, -rotation_transpose @ g[..., :-1, -1:])


def symplectic_inverse(g) -> jax.Array:
    """Return the inverse ``-J g^T J`` of a symplectic matrix, with J = [[0, I], [-I, 0]]."""
    n = g.shape[-1] // 2
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(n))
    return -J @ g.swapaxes(-1, -2) @ J


def heisenberg_inverse(g) -> jax.Array:
    """Return the inverse of g, ``I - N + N^2`` with N = g - I."""
    N = g - np.eye(g.shape[-1])
    return np.eye(g.shape[-1]) - N + N @ N


# -- one Newton step to the group ---------------------------------------------------------------------------------


def return_unchanged(g) -> jax.Array:
    """Return g itself, for groups without a formula of restoration."""
    return g


def restore_special_unitary(g) -> jax.Array:
    """Return g after one Newton step towards orthonormal rows and determinant 1."""
    return restore_unimodular(newton_schulz_step(g))


def restore_rigid(g) -> jax.Array:
    """Return g after one Newton step of its linear part towards the orthogonal matrices."""
    return affine_matrix(newton_schulz_step(g[..., :-1, :-1]), g[..., :-1, -1:])


def restore_unimodular(g) -> jax.Array:
    """Return g after one Newton step towards determinant 1."""
    return g * (1.0 - (determinant(g) - 1.0) / g.shape[-1])[..., None, None]


def restore_symplectic(g) -> jax.Array:
    """Return g after one Newton step towards the symplectic matrices: ``g (3 I - g^* g) / 2``, g^* = -J g^T J."""
    return 1.5 * g - 0.5 * g @ (symplectic_inverse(g) @ g)


def restore_heisenberg(g) -> jax.Array:
    """Return g with the entries outside the first row and the last column replaced by those of I."""
    return jnp.where(_heisenberg_coordinate_mask(g), g, np.eye(g.shape[-1]))


def affine_matrix(linear: jax.Array, translation: jax.Array) -> jax.Array:
    """Return the homogeneous matrix ``[[linear, translation], [0, 1]]``; ``translation`` has shape (..., n, 1)."""
    top = jnp.concatenate([linear, translation], axis=-1)
    last_row = jnp.broadcast_to(np.eye(top.shape[-1])[-1:], (*top.shape[:-2], 1, top.shape[-1]))
    return jnp.concatenate([top, last_row], axis=-2)


# -- helpers ------------------------------------------------------------------------------------------------------


def _heisenberg_coordinate_mask(g) -> np.ndarray:
    """Return a mask of the matrix entries that are coordinates of the Heisenberg group, shape (m, m)."""
    mask = np.zeros(g.shape[-2:], dtype=bool)
    mask[0, 1:] = mask[:-1, -1] = True
    return mask


def _scaled_quaternion(g: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the quaternion (w, v) of a rotation, w >= 0, with a norm between 1/2 and 4.

    ``4 q q^T`` is linear in the rotation; its row with the largest diagonal entry gives q without cancellation
    [Shepperd 1978].
    """
    trace = jnp.trace(g, axis1=-2, axis2=-1)[..., None, None]
    outer = g + g.swapaxes(-1, -2) + (1.0 - trace) * np.eye(3)
    skew = (g - g.swapaxes(-1, -2))[..., [2, 0, 1], [1, 2, 0]]
    outer = jnp.concatenate([skew[..., None, :], outer], axis=-2)
    outer = jnp.concatenate([jnp.concatenate([1.0 + trace, skew[..., None]], axis=-2), outer], axis=-1)
    row = jnp.argmax(jnp.diagonal(outer, axis1=-2, axis2=-1), axis=-1)[..., None]
    q = jnp.where((np.arange(4) == row)[..., None], outer, 0.0).sum(
        axis=-2
    )  # a mask, since programs of scalars cannot index by a variable
    q = q * jnp.where(q[..., :1] < 0, -1.0, 1.0)
    return q[..., :1], q[..., 1:]


def _su2_quaternion(g: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the unit quaternion (w, v) of ``g = w - i v . sigma`` in SU(2)."""
    a, b, c, d = g[..., 0, 0], g[..., 0, 1], g[..., 1, 0], g[..., 1, 1]
    w, v = (a + d).real / 2, jnp.stack([-(b + c).imag, (c - b).real, (d - a).imag], axis=-1) / 2
    return w[..., None], v


def _rotation_angle(w: jax.Array, v: jax.Array) -> jax.Array:
    """Return the rotation angle ``2 atan2(|v|, w)`` of the quaternion (w, v), of any norm, shape (..., 1)."""
    return 2 * jnp.arctan2(jnp.sqrt(_squared_length(v)), w)


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
