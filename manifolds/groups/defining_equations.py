"""A matrix group from equations that its elements satisfy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._sizes import checked_size
from ..algebras._null_space import RANK_TOLERANCE, numerical_null_space
from ..algebras.lie_algebra import LieAlgebra
from ..errors import ClosureError, ParameterError
from ..matrices.linear import solve

IDENTITY_TOLERANCE = 1e-12
"""Largest residual of the equations at the identity: rounding of a few operations."""

EXPONENTIAL_TOLERANCE = 1e-9
"""Largest residual of the equations at exponentials of the algebra: rounding of an exponential and the equations."""


@dataclass(frozen=True)
class IndependentEquations:
    """Independent combinations of equations of a matrix, with the distance to their solutions to first order.

    Attributes
    ----------
    function : callable
        The equations, matrix (n, n) to array, or to a list of arrays.
    combinations : tuple of tuple of float
        Rows of coefficients.
    """

    function: Callable
    combinations: tuple[tuple[float, ...], ...]

    def __call__(self, g) -> jax.Array:
        return jnp.asarray(self.combinations) @ ravel_pytree(self.function(g))[0]

    def newton_step(self, g) -> jax.Array:
        """Return the least change of one matrix that solves the linearised equations, shape (n, n)."""
        derivative = jax.jacfwd(self)(g).reshape(len(self.combinations), -1)
        weights = solve(derivative @ derivative.T, -self(g)[:, None])[:, 0]
        return (weights @ derivative).reshape(g.shape)


@dataclass(frozen=True)
class EquationDefect:
    """Distance of a matrix from the solutions of equations to first order, relative to the size of the matrix."""

    equations: IndependentEquations

    def __call__(self, g) -> jax.Array:
        return jnp.abs(self.equations.newton_step(g)).max() / jnp.maximum(jnp.abs(g).max(), 1e-300)


@dataclass(frozen=True)
class EquationRestore:
    """One Newton step to the solutions of equations, for batches of matrices."""

    equations: IndependentEquations

    def __call__(self, g) -> jax.Array:
        return jnp.vectorize(lambda a: a + self.equations.newton_step(a), signature="(m,n)->(m,n)")(g)


def fields_from_equations(function: Callable, n: int, name: str) -> dict[str, Any]:
    """Return the fields of a matrix group of the solutions of equations near the identity.

    The parameters and errors are those of :meth:`manifolds.MatrixGroup.from_equations`.
    """
    n = checked_size(n, 1, "MatrixGroup.from_equations(f, n)")
    identity = jnp.eye(n)
    try:
        residual = np.asarray(ravel_pytree(function(identity))[0], dtype=np.float64)
        derivative = np.asarray(jax.jacfwd(lambda a: ravel_pytree(function(a))[0])(identity)).reshape(-1, n * n)
    except TypeError as error:
        raise ParameterError(
            f"f must be a function by jax.numpy from a real matrix ({n}, {n}) to real arrays: {error}"
        ) from None
    if not np.abs(residual).max(initial=0.0) <= IDENTITY_TOLERANCE:
        raise ParameterError(
            f"f must vanish at the identity, got {np.abs(residual).max():.3g}; subtract its value there"
        )
    scale = float(np.abs(derivative).max(initial=0.0))
    if not scale > 0.0:
        raise ParameterError("the derivative of f at the identity is zero, so it defines no algebra; use a first power")
    left, singular_values, _ = np.linalg.svd(derivative / scale)
    vectors = numerical_null_space(derivative / scale, name)
    if not len(vectors):
        raise ParameterError("f has the identity as an isolated solution: the group has dimension 0")
    algebra = LieAlgebra.from_matrices(vectors.reshape(-1, n, n), name=f"algebra of {name}")
    combinations = left[:, : int((singular_values > RANK_TOLERANCE).sum())].T
    equations = IndependentEquations(function, tuple(map(tuple, combinations.tolist())))
    x = np.random.default_rng(0).standard_normal((4, algebra.dim))
    for matrix in np.asarray(jax.scipy.linalg.expm(algebra.hat(x) / np.linalg.norm(algebra.hat(x)))):
        residual = np.abs(np.asarray(ravel_pytree(function(jnp.asarray(matrix)))[0])).max()
        if not residual <= EXPONENTIAL_TOLERANCE * max(1.0, scale):
            raise ClosureError(
                f"the solutions of f are no group: exponentials of its algebra miss them by {residual:.3g} (tolerance "
                f"{EXPONENTIAL_TOLERANCE * max(1.0, scale):.0e}); add the equations that are missing",
                residual=float(residual),
                tolerance=EXPONENTIAL_TOLERANCE * max(1.0, scale),
            )
    return {
        "name": name,
        "algebra": algebra,
        "defect": EquationDefect(equations),
        "restore_map": EquationRestore(equations),
    }
