"""How fast the motion takes apart what lies near: what adaptive steps have to resolve."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..systems import System
from ..tracing.programs import jit_program

DENSE_JACOBIAN_DIM, KRYLOV_DIM = 8, 24
"""Components up to which the whole Jacobian matrix of the motion is looked at at every step, and vectors from which its
growing modes are found otherwise."""


POWER_ITERATIONS = 4
"""Times that the Jacobian matrix is applied to see how large it is."""


def jacobian_probe(system: System, x) -> jax.Array:
    """How the motion stretches what lies near a state.

    The Jacobian matrix, shape (n, n), of a few components; otherwise its first :data:`POWER_ITERATIONS` powers times a vector,
    each over the size of the one before, shape (POWERS, n).
    """
    stretched, n = _jacobian_product(system, x), x.shape[0]
    if n <= DENSE_JACOBIAN_DIM:
        return jax.vmap(stretched)(jnp.eye(n)).T

    def power(v, _):
        v = stretched(v)
        return _unit_vector(v), v

    return jax.lax.scan(power, _unit_vector(_generic_vector(n)), length=POWER_ITERATIONS)[1]


@jit_program
def arnoldi_hessenberg(system, method, x):
    """The matrix of the Jacobian in a Krylov space, shape (m, m): its eigenvalues lie near the outer ones [Arnoldi]."""
    system, x = system.solved_part(x)
    stretched, n = _jacobian_product(system, x), x.shape[0]
    m = min(n, KRYLOV_DIM)

    def arnoldi_step(carry, i):
        frame, matrix = carry
        v = stretched(frame[i])
        parts, rest = orthogonalise(frame, v)
        length = jnp.linalg.norm(rest)
        closed = length <= 1e-10 * jnp.linalg.norm(v)  # a space that the motion keeps: go on outside of it
        length, rest = jnp.where(closed, 0.0, length), jnp.where(closed, jnp.roll(_generic_vector(n), i + 1), rest)
        matrix = matrix.at[:m, i].set(parts[:m]).at[i + 1, i].set(length)
        return (frame.at[i + 1].set(_unit_vector(orthogonalise(frame, _unit_vector(rest))[1])), matrix), None

    def orthogonalise(frame, v):
        parts = frame @ v
        v = v - parts @ frame
        again = frame @ v  # the second pass removes what rounding left of the first
        return parts + again, v - again @ frame

    frame = jnp.zeros((m + 1, n)).at[0].set(_unit_vector(_generic_vector(n)))
    (_, matrix), _ = jax.lax.scan(arnoldi_step, (frame, jnp.zeros((m + 1, m))), jnp.arange(m))
    return matrix[:m]


def _jacobian_product(system: System, x) -> Callable:
    """The derivative of the motion at x, on tangent vectors."""
    return lambda v: system.project_tangent(x, jax.jvp(system.vector_field, (x,), (system.project_tangent(x, v),))[1])


def _generic_vector(n: int) -> np.ndarray:
    """A vector that has a part in every direction of interest."""
    return np.random.default_rng(0).standard_normal(n)


def _unit_vector(v):
    length = jnp.linalg.norm(v)
    return v / jnp.where(length > 0.0, length, 1.0)
