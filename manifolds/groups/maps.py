"""Maps between an algebra of matrices and its group: for any algebra, for products, and from defining equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import comb
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._arguments import checked_size
from ..algebras._subspaces import RANK_TOLERANCE, numerical_null_space
from ..algebras.blocks import direct_sum
from ..algebras.lie_algebra import LieAlgebra
from ..errors import ClosureError, ParameterError
from ..matrices.exponential import CAYLEY_CONDITION_LIMIT, cayley_of, expm
from ..matrices.linear import _matrix_square_root, _one_norm, determinant, max_abs_entry, solve, solve_without_pivoting

_NODES = np.polynomial.legendre.leggauss(32)[0][16:]
"""Nodes of Gauss quadrature of even functions on [0, 1]: half of the rule with 32 nodes on [-1, 1]."""

_WEIGHTS = np.polynomial.legendre.leggauss(32)[1][16:]
"""Weights of this quadrature."""


def exp(algebra: LieAlgebra, x) -> jax.Array:
    """Return the exponential ``expm(hat(x))`` of components x, a matrix of the group."""
    return expm(algebra.hat(x))


def dexp(algebra: LieAlgebra, x) -> jax.Array:
    """Return the left-trivialised derivative of exp, ``int_0^1 exp(-s ad x) ds``, shape (..., dim, dim).

    ``d exp(x) = exp(x) hat(dexp(x) dx)``. The integral is a block of a larger exponential [Van Loan 1978].
    """
    ad, one = algebra.ad(x), jnp.broadcast_to(np.eye(algebra.dim), (*x.shape, algebra.dim))
    top = jnp.concatenate([-ad, one], axis=-1)
    return expm(jnp.concatenate([top, jnp.zeros_like(top)], axis=-2))[..., : algebra.dim, algebra.dim :]


def inverse_dexp(algebra: LieAlgebra, x, v, order: int) -> jax.Array:
    """Return ``dexp(x)^-1 v`` by its series in ``ad x``, truncated after the power ``order``.

    This is the rate x' for which ``exp(x)`` turns at the velocity v, ``d exp(x) / dt = exp(x) hat(v)``.
    """
    term, total = v, v
    for j in range(1, order + 1):
        term = -algebra.bracket(x, term) / j
        if _BERNOULLI[j]:
            total = total + _BERNOULLI[j] * term
    return total


def _bernoulli_numbers(count: int) -> list[float]:
    """Return the coefficients B_0 … B_(count - 1), Bernoulli's numbers."""
    numbers = [Fraction(1)]
    for m in range(1, count):
        weighted_sum = sum((comb(m + 1, j) * b for j, b in enumerate(numbers)), Fraction(0))
        numbers.append(-weighted_sum / (m + 1))
    return list(map(float, numbers))


_BERNOULLI = _bernoulli_numbers(26)
"""Bernoulli's numbers up to the largest order of :func:`inverse_dexp`."""


def cayley(algebra: LieAlgebra, x) -> jax.Array:
    """Return the Cayley map of hat(x); see :func:`cayley_of`."""
    return cayley_of(algebra.hat(x))


def inverse_cayley(algebra: LieAlgebra, g) -> jax.Array:
    """Return the components of ``2 (g + I)^-1 (g - I)``, NaN where g + I is singular to rounding."""
    identity = np.eye(g.shape[-1])
    x = algebra.vee(2 * solve(g + identity, g - identity))
    condition = max_abs_entry(g + identity) * max_abs_entry(identity - algebra.hat(x) / 2) / 2  # 2 (g + I)^-1 = I - X/2
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None], x, jnp.nan)


def adjoint_cayley(algebra: LieAlgebra, x) -> jax.Array:
    """Return the group element g with ``Ad(g) = cay(ad x)``, for any algebra that has one.

    ``ad y = 2 artanh(A/2) = int_0^1 A (I - t^2 A^2/4)^-1 dt`` with A = ad(x), by Gauss quadrature: right to rounding
    where the eigenvalues of A are imaginary and below 3, or real and below 1.5; to 1e-13 at 4, and to 1e-11 at 1.8.
    """
    adjoint, identity = _adjoint_algebra(algebra), np.eye(algebra.dim)
    A = adjoint.hat(x)[..., None, :, :]
    values = solve_without_pivoting(
        identity - _NODES[:, None, None] ** 2 / 4 * (A @ A), A + jnp.zeros((len(_NODES), 1, 1))
    )
    return exp(algebra, adjoint.vee((_WEIGHTS[:, None, None] * values).sum(axis=-3)) + central_part(algebra, x))


def components_from_ad_cayley(algebra: LieAlgebra, ad_cayley_matrix) -> jax.Array:
    """Return the components x, none in the centre, with ``cay(ad x)`` a given matrix near I."""
    identity = np.eye(algebra.dim)
    return _adjoint_algebra(algebra).vee(
        2 * solve_without_pivoting(ad_cayley_matrix + identity, ad_cayley_matrix - identity)
    )


def central_part(algebra: LieAlgebra, x) -> jax.Array:
    """Return the projection of x on the centre of the algebra, as components, shape (..., dim)."""
    adjoint = _adjoint_algebra(algebra)
    return x - adjoint.vee(adjoint.hat(x))


@cache
def _adjoint_algebra(algebra: LieAlgebra) -> LieAlgebra:
    """Return the algebra with the matrices ad(e_a); its ``vee`` returns components with none in the centre."""
    constants = algebra.structure_constants
    return LieAlgebra(constants, name=f"ad({algebra.name})", basis=constants.swapaxes(1, 2))


_MAX_OUTSIDE_FRACTION = 1e-3
"""Largest fraction of a logarithm outside of the algebra, relative to its size.

It is more than rounding makes and less than 2 pi / n, the phase of SU(n) that leaves the algebra.
"""


def log(algebra: LieAlgebra, g) -> jax.Array:
    """Return the principal logarithm in components, NaN where an eigenvalue is on or next to the negative axis.

    The result is NaN too where the matrix logarithm is not in the algebra, as in SU(n) if the angles of the eigenvalues
    sum to 2 pi. The algorithm takes square roots until s is near I; then ``log s = 2 artanh (s - I)(s + I)^-1``, which
    keeps to the algebra of a group with a quadratic form; then one Newton step on ``exp(x) = g`` in components, which
    removes the rounding that the roots amplify.
    """
    identity, batch = jnp.eye(g.shape[-1], dtype=g.dtype), g.shape[:-2]

    def is_far_from_identity(state):
        s, _, is_converged = state
        return is_converged & (_one_norm(s - identity) > 0.25)

    def take_square_root(state):
        s, halvings, is_converged = state
        root, _, success = _matrix_square_root(s)
        needs_root = is_far_from_identity(state)
        return (
            jnp.where(needs_root[..., None, None], root, s),
            halvings + needs_root,
            is_converged & (success | ~needs_root),
        )

    log_scale = jnp.log(jnp.abs(determinant(g)))[..., None, None] / g.shape[-1]
    start = (g / jnp.exp(log_scale), jnp.zeros(batch), jnp.ones(batch, dtype=bool))
    s, halvings, is_converged = jax.lax.while_loop(
        lambda state: is_far_from_identity(state).any(), take_square_root, start
    )
    Z = solve(s + identity, s - identity)
    Z2, series = Z @ Z, jnp.zeros_like(g)
    for k in reversed(range(9)):  # |Z| < 1/7, so the first term left out is below rounding
        series = identity / (2 * k + 1) + Z2 @ series
    X = log_scale * identity + 2.0 ** (halvings + 1.0)[..., None, None] * Z @ series
    x = algebra.vee(X)
    is_converged &= max_abs_entry(X - algebra.hat(x)) < _MAX_OUTSIDE_FRACTION * (1.0 + max_abs_entry(X))
    remainder = algebra.vee(expm(algebra.hat(-x)) @ g - identity)
    x = x + solve(dexp(algebra, x), remainder[..., None])[..., 0]
    return jnp.where(is_converged[..., None], x, jnp.nan)


@dataclass(frozen=True)
class BlockMap:
    """A map of each factor of a product, applied to the blocks of a matrix or to the parts of an element.

    Attributes
    ----------
    maps : tuple of callable
        The map of each factor.
    algebras : tuple of LieAlgebra
        The algebras of the factors.
    takes_components, gives_components : bool
        True if the arguments, or the values, are components of the algebra instead of matrices.
    """

    maps: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]
    takes_components: bool = False
    gives_components: bool = False

    def __call__(self, algebra: LieAlgebra, argument) -> jax.Array:
        blocks = (_split_components if self.takes_components else split_blocks)(self.algebras, argument)
        images = [f(g, block) for f, g, block in zip(self.maps, self.algebras, blocks, strict=True)]
        return jnp.concatenate(images, axis=-1) if self.gives_components else join_blocks(images)


@dataclass(frozen=True)
class MatrixBlockMap:
    """A map ``g -> g`` of each factor of a product, applied to the blocks."""

    maps: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]

    def __call__(self, g) -> jax.Array:
        blocks = split_blocks(self.algebras, g)
        return join_blocks([f(block) for f, block in zip(self.maps, blocks, strict=True)])


@dataclass(frozen=True)
class BlockDefect:
    """The largest distance of a block from its group, and of the other entries from zero."""

    defects: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]

    def __call__(self, g) -> jax.Array:
        blocks = split_blocks(self.algebras, g)
        max_distance = jnp.abs(g - join_blocks(blocks)).max(axis=(-2, -1))
        for defect, block in zip(self.defects, blocks, strict=True):
            max_distance = jnp.maximum(max_distance, defect(block))
        return max_distance


@dataclass(frozen=True)
class BlockEquations:
    """The equations of all factors of a product."""

    equations: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]

    def __call__(self, g) -> jax.Array:
        blocks = split_blocks(self.algebras, g)
        return jnp.concatenate([f(block) for f, block in zip(self.equations, blocks, strict=True)], axis=-1)


def product_group_fields(group_1: Any, group_2: Any) -> dict[str, Any]:
    """Return the fields of the :class:`.MatrixGroup` that is the product of two groups, by name."""
    groups = (group_1, group_2)
    algebras = tuple(group.algebra for group in groups)

    def block_map_of_components(kind: str) -> BlockMap | None:
        maps = tuple({"cayley": g.cayley_map, "adjoint_cayley": g.adjoint_cayley_map}[kind] for g in groups)
        return None if None in maps else BlockMap(maps, algebras, takes_components=True)

    equations = tuple(group.equations for group in groups)
    return {
        "name": f"{group_1.name} x {group_2.name}",
        "algebra": direct_sum(*algebras),
        "defect": BlockDefect(tuple(group.defect for group in groups), algebras),
        "inverse_map": MatrixBlockMap(tuple(group.inverse_map for group in groups), algebras),
        "exp_map": BlockMap(tuple(group.exp_map for group in groups), algebras, takes_components=True),
        "log_map": BlockMap(tuple(group.log_map for group in groups), algebras, gives_components=True),
        "cayley_map": block_map_of_components("cayley"),
        "inverse_cayley_map": BlockMap(
            tuple(group.inverse_cayley_map for group in groups), algebras, gives_components=True
        ),
        "adjoint_cayley_map": block_map_of_components("adjoint_cayley"),
        "restore_map": MatrixBlockMap(tuple(group.restore_map for group in groups), algebras),
        "equations": None if None in equations else BlockEquations(equations, algebras),
    }


def split_blocks(algebras: tuple[LieAlgebra, ...], g) -> list[jax.Array]:
    """Return the diagonal blocks of matrices, real ones for factors of real matrices."""
    blocks, start = [], 0
    for algebra in algebras:
        basis = algebra._require_basis()
        block = g[..., start : start + basis.shape[-1], start : start + basis.shape[-1]]
        blocks.append(block if jnp.iscomplexobj(basis) else block.real)
        start += basis.shape[-1]
    return blocks


def join_blocks(blocks: list[jax.Array]) -> jax.Array:
    """Return block diagonal matrices, shape (..., m, m), from their blocks."""
    size, start, rows = sum(block.shape[-1] for block in blocks), 0, []
    for block in blocks:
        n = block.shape[-1]
        widths = [(0, 0)] * (block.ndim - 1) + [(start, size - start - n)]
        rows.append(jnp.pad(block, widths))
        start += n
    return jnp.concatenate(rows, axis=-2)


def _split_components(algebras: tuple[LieAlgebra, ...], x) -> list[jax.Array]:
    """Return the components of an element of a direct sum in each summand, shapes (..., dim of the summand)."""
    components, start = [], 0
    for algebra in algebras:
        components.append(x[..., start : start + algebra.dim])
        start += algebra.dim
    return components


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
    """Return the fields, by name, of the matrix group of the solutions of equations near the identity.

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
        raise ParameterError("the derivative of f at the identity is zero, so it defines no algebra. Use a first power")
    left_vectors, singular_values, _ = np.linalg.svd(derivative / scale)
    vectors = numerical_null_space(derivative / scale, name)
    if not len(vectors):
        raise ParameterError("f has the identity as an isolated solution: the group has dimension 0")
    algebra = LieAlgebra.from_matrices(vectors.reshape(-1, n, n), name=f"algebra of {name}")
    combinations = left_vectors[:, : int((singular_values > RANK_TOLERANCE).sum())].T
    equations = IndependentEquations(function, tuple(map(tuple, combinations.tolist())))
    x = np.random.default_rng(0).standard_normal((4, algebra.dim))
    for matrix in np.asarray(jax.scipy.linalg.expm(algebra.hat(x) / np.linalg.norm(algebra.hat(x)))):
        residual = np.abs(np.asarray(ravel_pytree(function(jnp.asarray(matrix)))[0])).max()
        if not residual <= EXPONENTIAL_TOLERANCE * max(1.0, scale):
            raise ClosureError(
                f"the solutions of f are not a group: exponentials of its algebra miss them by {residual:.3g} "
                f"(tolerance {EXPONENTIAL_TOLERANCE * max(1.0, scale):.0e}). Add the equations that are missing",
                residual=float(residual),
                tolerance=EXPONENTIAL_TOLERANCE * max(1.0, scale),
            )
    return {
        "name": name,
        "algebra": algebra,
        "defect": EquationDefect(equations),
        "restore_map": EquationRestore(equations),
    }
