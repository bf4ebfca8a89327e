"""Connected subgroups of a matrix group, by matrices that span their algebras."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import numeric_array
from ..errors import ParameterError
from ..matrices.linear import solve
from .matrix_group import MatrixGroup

SUBALGEBRA_TOLERANCE = 1e-10
"""What of a bracket of unit vectors may be off the subalgebra."""


def subalgebra_basis(group: MatrixGroup, stabilizer) -> np.ndarray:
    """Orthonormal components of what spans a subalgebra, shape (k, dim of the group).

    Parameters
    ----------
    group : MatrixGroup
        The basis of its algebra is orthogonal as matrices, all of one norm, as that of so(n) and of su(n) is.
    stabilizer : array, shape (k, n, n)

    Raises
    ------
    ParameterError
        If the matrices are dependent, not in the algebra of the group, or do not span a subalgebra.
    """
    basis, matrices = group.algebra._require_basis(), np.asarray(numeric_array(stabilizer, "stabilizer"))
    matrices = matrices.reshape(-1, *basis.shape[1:]) if matrices.size == 0 else matrices
    if matrices.shape[1:] != basis.shape[1:]:
        n = group.matrix_size
        raise ParameterError(
            f"the stabilizer in {group.name} is given by matrices, shape (k, {n}, {n}), not {matrices.shape}"
        )

    def components(a):
        return np.einsum("dij,...ij->...d", basis.conj(), a).real / (np.abs(basis[0]) ** 2).sum()

    def matrix(c):
        return np.einsum("...d,dij->...ij", c, basis)

    given = components(matrices)
    outside = np.abs(matrices - matrix(given)).max(axis=(1, 2), initial=0.0)
    if (outside > SUBALGEBRA_TOLERANCE).any():
        raise ParameterError(
            f"matrix {int(np.argmax(outside))} of the stabilizer is not in the algebra of {group.name}: it is "
            f"{outside.max():.2g} off"
        )
    if len(given) and (rank := np.linalg.matrix_rank(given)) < len(given):
        raise ParameterError(
            f"the {len(given)} matrices of the stabilizer in {group.name} span {rank} dimensions only: leave one out"
        )
    rows = np.linalg.qr(given.T)[0].T
    for j, i in itertools.combinations(range(len(rows)), 2):
        a, b = matrix(rows[i]), matrix(rows[j])
        bracket = components(a @ b - b @ a)
        if (off := np.linalg.norm(bracket - rows.T @ (rows @ bracket))) > SUBALGEBRA_TOLERANCE:
            raise ParameterError(
                f"the stabilizer in {group.name} is no subalgebra: the bracket of its directions {j} and {i} is "
                f"{off:.2g} off their span; add what is missing"
            )
    return rows


_MAX_NEWTON_STEPS = 30
"""Iterations of Newton's method."""


def factor_element(group: MatrixGroup, m: np.ndarray, h: np.ndarray, way, reach: float):
    """The c, shape (dim of m,), with b, for which ``exp(c m) exp(b h)`` is an element of the group.

    Parameters
    ----------
    m, h : array, shape (k, dim)
        Complements of each other in the algebra; h spans a subalgebra.
    way : array, shape (n, n)
        The element.
    reach : float
        Length from which on c is none: then the result is NaN, as where Newton's method finds none.
    """
    d = len(m)

    def ends(z):
        return [group.exp_map(group.algebra, part) for part in (z[:d] @ m, z[d:] @ h)]

    def gap(z, way):
        first, second = ends(z)
        return first @ second - way

    def balance(z, way):
        """The gap as a vector of the algebra, which vanishes where the gap does."""
        first, second = ends(z)
        return group.algebra.vee(group.inverse_map(first @ second) @ gap(z, way))

    def flat(a):
        return jnp.concatenate([a.real.ravel(), a.imag.ravel()])

    def step(state):
        z, _, steps = state
        J, f = jax.jacfwd(lambda z: (flat(gap(z, way)),) * 2, has_aux=True)(z)
        direction = solve(J.T @ J, -(J.T @ f)[:, None])[:, 0]
        lengths = 0.5 ** np.arange(8.0)
        sizes = jax.vmap(lambda t: (flat(gap(z + t * direction, way)) ** 2).sum())(lengths)
        move = jnp.asarray(lengths)[jnp.nanargmin(sizes)] * direction
        return z + move, jnp.abs(move).max(), steps + 1

    def newton(_, start):
        unfinished = lambda state: (state[1] > 1e-8) & (state[2] < _MAX_NEWTON_STEPS)  # noqa: E731
        z, change, _ = jax.lax.while_loop(unfinished, step, (start, jnp.inf, 0))
        found = ((z[:d] ** 2).sum() < reach**2) & (change <= 1e-8) & (jnp.abs(gap(z, way)).max() <= 1e-10)
        return jnp.where(found, z, jnp.nan)

    velocity = group.algebra.vee(way - group.inverse_map(way)) / 2.0
    z = jax.lax.custom_root(  # for the derivatives, by the implicit function theorem
        lambda z: balance(z, way),
        jax.lax.stop_gradient(jnp.concatenate([m @ velocity, h @ velocity])),
        newton,
        lambda linear, b: solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b[:, None])[:, 0],
    )
    return z[:d]
