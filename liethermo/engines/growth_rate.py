"""Growth rates of the linearised flow, which limit adaptive steps."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..dissipation.geometry import project_tangent
from ..systems import System
from ..tracing.programs import jit_cached

DENSE_JACOBIAN_DIM = 8
"""Largest dimension for which the whole Jacobian matrix of the vector field is computed after every step."""

KRYLOV_DIM = 24
"""Dimension of the Krylov space from which the growth rate of a larger system is computed."""

POWER_ITERATIONS = 4
"""Number of power iterations that estimate the spectral radius of the Jacobian of a larger system."""


def jacobian_probe(system: System, x) -> jax.Array:
    """Return a probe of the Jacobian of the vector field at x, from which growth rates are estimated.

    For at most :data:`DENSE_JACOBIAN_DIM` components the probe is the Jacobian matrix, shape (n, n). Otherwise it has
    shape (:data:`POWER_ITERATIONS`, n): the images of normalised iterates of the power method.
    """
    jacobian_product, n = _jacobian_product(system, x), x.shape[0]
    if n <= DENSE_JACOBIAN_DIM:
        return jax.vmap(jacobian_product)(jnp.eye(n)).T

    def power_step(v, _):
        v = jacobian_product(v)
        return _unit_vector(v), v

    return jax.lax.scan(power_step, _unit_vector(_fixed_random_vector(n)), length=POWER_ITERATIONS)[1]


@jit_cached
def arnoldi_hessenberg(system, method, x):
    """Return the Hessenberg matrix of Arnoldi's method, shape (m, m), for the Jacobian of the vector field at x.

    Its eigenvalues approximate the extremal eigenvalues of the Jacobian.
    """
    system, x = system.solved_subsystem(x)
    jacobian_product, n = _jacobian_product(system, x), x.shape[0]
    m = min(n, KRYLOV_DIM)

    def arnoldi_step(carry, i):
        basis, matrix = carry
        v = jacobian_product(basis[i])
        coefficients, remainder = orthogonalise(basis, v)
        remainder_norm = jnp.linalg.norm(remainder)
        # in an invariant subspace the remainder vanishes: continue outside of it
        is_invariant = remainder_norm <= 1e-10 * jnp.linalg.norm(v)
        remainder_norm = jnp.where(is_invariant, 0.0, remainder_norm)
        remainder = jnp.where(is_invariant, jnp.roll(_fixed_random_vector(n), i + 1), remainder)
        matrix = matrix.at[:m, i].set(coefficients[:m]).at[i + 1, i].set(remainder_norm)
        return (basis.at[i + 1].set(_unit_vector(orthogonalise(basis, _unit_vector(remainder))[1])), matrix), None

    def orthogonalise(basis, v):
        coefficients = basis @ v
        v = v - coefficients @ basis
        correction = basis @ v  # the second pass removes the rounding errors of the first
        return coefficients + correction, v - correction @ basis

    initial_basis = jnp.zeros((m + 1, n)).at[0].set(_unit_vector(_fixed_random_vector(n)))
    (_, matrix), _ = jax.lax.scan(arnoldi_step, (initial_basis, jnp.zeros((m + 1, m))), jnp.arange(m))
    return matrix[:m]


def _jacobian_product(system: System, x) -> Callable:
    """Return the product of the Jacobian of the vector field at x with tangent vectors, as a function."""
    return lambda v: project_tangent(system, x, jax.jvp(system.vector_field, (x,), (project_tangent(system, x, v),))[1])


def _fixed_random_vector(n: int) -> np.ndarray:
    """Return a fixed random vector, which has a component along every eigenvector."""
    return np.random.default_rng(0).standard_normal(n)


def _unit_vector(v):
    norm = jnp.linalg.norm(v)
    return v / jnp.where(norm > 0.0, norm, 1.0)
