"""Linear equations of any size by products with their matrix alone, in ``lax`` loops: for Newton's method."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .rules import SolverOptions


def solve_krylov(product: Callable, b: jax.Array, rules: SolverOptions) -> jax.Array:
    """An x with ``|b - product(x)| <= rules.forcing |b|``, of the shape of b, or the best found.

    Conjugate residuals, each direction made orthogonal to the last few [Eisenstat, Elman & Schultz 1983, "Orthomin"]:
    as long as they are all, the x of least residual in the Krylov space; the memory is ``2 rules.kept`` vectors. It
    converges where the symmetric part of the matrix is definite, as that of a step is unless what grows outgrows it.
    Eigenvalues that lie together are found together, so what a few components of a large state do costs a few products.
    """

    def goes_on(carry):
        _, r, _, _, number = carry
        return (number < rules.max_krylov_products) & (jnp.linalg.norm(r) > rules.krylov_forcing_term * size) | (
            number == 0
        )

    def orthomin_step(carry):
        x, r, directions, images, number = carry
        p, q = r, product(r)
        shares = jnp.tensordot(images, q, q.ndim)
        p, q = p - jnp.tensordot(shares, directions, 1), q - jnp.tensordot(shares, images, 1)
        length = jnp.linalg.norm(q)
        over = jnp.where(length > 0.0, 1.0 / jnp.where(length > 0.0, length, 1.0), 0.0)
        p, q = over * p, over * q
        along = jnp.vdot(q, r)
        place = number % rules.krylov_basis_size
        directions, images = directions.at[place].set(p), images.at[place].set(q)
        return x + along * p, r - along * q, directions, images, number + 1

    size = jnp.linalg.norm(b)
    none = jnp.zeros((rules.krylov_basis_size, *b.shape))
    return jax.lax.while_loop(
        goes_on, orthomin_step, (jnp.zeros_like(b), b, none, none, jnp.zeros((), dtype=jnp.int64))
    )[0]
