"""Matrix-free solution of linear equations in ``lax`` loops, for Newton's method on large systems."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .solver_options import SolverOptions


def solve_krylov(matvec: Callable, b: jax.Array, options: SolverOptions) -> jax.Array:
    """Solve ``matvec(x) = b`` to the relative residual ``options.krylov_forcing_term``; return x, of the shape of b.

    Conjugate residuals, each direction made orthogonal to the last few [Eisenstat, Elman & Schultz 1983, "Orthomin"].
    With all directions kept, x would have the least residual in the Krylov space; the memory is ``2
    options.krylov_basis_size`` vectors. It converges if the symmetric part of the matrix is definite, which holds for a
    step unless growth is faster than 1/h. After ``options.max_krylov_products`` products the last iterate is returned.
    Clustered eigenvalues are resolved together, so a few stiff components of a large state cost a few products.
    """

    def is_unfinished(carry):
        _, r, _, _, n_products = carry
        return (n_products < options.max_krylov_products) & (
            jnp.linalg.norm(r) > options.krylov_forcing_term * b_norm
        ) | (n_products == 0)

    def orthomin_step(carry):
        x, r, directions, images, n_products = carry
        p, q = r, matvec(r)
        coefficients = jnp.tensordot(images, q, q.ndim)
        p, q = p - jnp.tensordot(coefficients, directions, 1), q - jnp.tensordot(coefficients, images, 1)
        q_norm = jnp.linalg.norm(q)
        inverse_norm = jnp.where(q_norm > 0.0, 1.0 / jnp.where(q_norm > 0.0, q_norm, 1.0), 0.0)
        p, q = inverse_norm * p, inverse_norm * q
        residual_component = jnp.vdot(q, r)
        slot = n_products % options.krylov_basis_size
        directions, images = directions.at[slot].set(p), images.at[slot].set(q)
        return x + residual_component * p, r - residual_component * q, directions, images, n_products + 1

    b_norm = jnp.linalg.norm(b)
    empty_basis = jnp.zeros((options.krylov_basis_size, *b.shape))
    return jax.lax.while_loop(
        is_unfinished, orthomin_step, (jnp.zeros_like(b), b, empty_basis, empty_basis, jnp.zeros((), dtype=jnp.int64))
    )[0]
