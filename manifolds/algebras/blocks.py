"""Direct sums of many algebras, and copies of one algebra on sites, computed block by block.

No array over pairs of components is made: time and memory are the sums of those of the blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from .._arguments import check_memory, checked_size
from .._arrays import numeric_array, real_components
from .._pytree_module import forward_to
from ..errors import (
    ComponentError,
    LieAlgebraError,
    ParameterError,
    RepresentationError,
    ShapeError,
)
from ..matrices.linear import BlockDiagonal
from .axioms import AXIOM_TOLERANCE
from .bracket_algebra import BracketAlgebra
from .killing import row_space_basis
from .lie_algebra import LieAlgebra
from .polynomial import Polynomial

MAX_COPIES_LISTED = 8
"""Largest number of copies whose Casimirs are followed one by one along a motion; for more copies their sum is
followed."""

MAX_LISTED_EXPONENTS = 1_000_000
"""Largest number of exponents in the Casimirs of all sites for which they are listed one by one."""


def power(g: LieAlgebra, sites) -> DirectSum:
    """Return the direct sum of copies of an algebra on sites, also written ``g ** sites``.

    Elements of different sites commute.

    Parameters
    ----------
    g : LieAlgebra
        The algebra to copy.
    sites : int or tuple of int
        Number of copies; a tuple, such as ``(64, 64)``, for a lattice.

    Returns
    -------
    LieAlgebra
        With dimension ``n * g.dim`` for n sites. Its elements have the shape ``(*sites, g.dim)``, or are flat: results
        have the shape of the arguments.

    Raises
    ------
    ParameterError
        If the sites are not positive integers.
    SizeError
        If one element would not fit into memory.
    """
    if not isinstance(g, LieAlgebra):
        raise ParameterError(f"power(g, sites): g must be a LieAlgebra, got {type(g).__name__}")
    shape = tuple(sites) if isinstance(sites, tuple | list) else (sites,)
    if not shape:
        raise ParameterError("power(g, sites): sites must not be empty")
    shape = tuple(checked_size(n, 1, "power(g, sites)", "each number of sites") for n in shape)
    if isinstance(g, DirectSum) and g.sites is not None:
        shape = (*shape, *g.sites)
        g = g.blocks[0][0]
    count = math.prod(shape)
    check_memory(float(count) * g.dim, f"one element of {g.name} on {count} sites", "take fewer sites")
    return DirectSum(((g, count),), shape)


def merged_direct_sum(algebras: Sequence[LieAlgebra]) -> DirectSum:
    """Return the direct sum of algebras in order, with equal neighbours merged into one block."""
    blocks: list[tuple[LieAlgebra, int]] = []
    for g in algebras:
        summands = g.blocks if isinstance(g, DirectSum) else ((g, 1),)
        for summand, count in summands:
            if blocks and (blocks[-1][0] is summand or blocks[-1][0] == summand):
                blocks[-1] = (blocks[-1][0], blocks[-1][1] + count)
            else:
                blocks.append((summand, count))
    return DirectSum(tuple(blocks))


@jax.tree_util.register_static
class DirectSum(BracketAlgebra):
    """Direct sum of algebras, by blocks; see :func:`manifolds.power` and :func:`manifolds.direct_sum`.

    Attributes
    ----------
    blocks : tuple of (LieAlgebra, int)
        Each algebra with the number of its consecutive copies.
    sites : tuple of int, or None
        Numbers of sites, if the blocks are copies of one algebra on sites.
    """

    def __init__(self, blocks: tuple[tuple[LieAlgebra, int], ...], sites: tuple[int, ...] | None = None):
        self.blocks, self.sites = blocks, sites
        if sites is None:
            name = " + ".join(g.name if count == 1 else f"({g.name})^{count}" for g, count in blocks)
        else:
            name = f"({blocks[0][0].name})^{'x'.join(map(str, sites))}"
        super().__init__(name, sum(g.dim * count for g, count in blocks))

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.dim,) if self.sites is None else (*self.sites, self.blocks[0][0].dim)

    @cached_property
    def _key(self):
        return self.blocks, self.sites

    # -- the operations, block by block -----------------------------------------------------------------------------

    def bracket(self, x, y) -> jax.Array:
        """Return the Lie bracket ``[x, y]``; elements and result have shape (..., dim) or ``(..., *sites, d)``."""
        return self._apply_to_blocks("_batched_bracket", (x, "x"), (y, "y"))

    def ad_star(self, x, mu) -> jax.Array:
        """Return the coadjoint operator ``ad*_x mu``; elements have shape (..., dim) or ``(..., *sites, d)``."""
        return self._apply_to_blocks("_batched_ad_star", (x, "x"), (mu, "mu"))

    def action(self, x) -> BlockAction:
        return BlockAction(self, x)

    def ad(self, x) -> jax.Array:
        """Return the matrix of ``y -> [x, y]``, shape (..., dim, dim); mostly zeros, so only small sums allow it."""
        self._check_matrix_memory("the matrix of ad")
        ads = [g.ad(component) for (g, _), component in zip(self.blocks, self.split(x), strict=True)]
        return _block_diagonal(ads)

    def split(self, x, what: str = "x") -> list[jax.Array]:
        """Return the components of an element in each block, each of shape (..., count, d)."""
        x, components, start = self._flatten_element(x, what)[0], [], 0
        for g, count in self.blocks:
            stop = start + g.dim * count
            components.append(x[..., start:stop].reshape(*x.shape[:-1], count, g.dim))
            start = stop
        return components

    def _apply_to_blocks(self, method_name: str, *named_elements) -> jax.Array:
        """Call a method of each block's algebra on its components of the elements, and join the results.

        ``named_elements`` are pairs of an element and its label for messages.
        """
        has_site_axes = any(self._flatten_element(x, what)[1] for x, what in named_elements)
        argument_blocks = zip(*(self.split(x, what) for x, what in named_elements), strict=True)
        results = [getattr(g, method_name)(*parts) for (g, _), parts in zip(self.blocks, argument_blocks, strict=True)]
        rows = [result.reshape(*result.shape[:-2], -1) for result in results]
        components = rows[0] if len(rows) == 1 else jnp.concatenate(rows, axis=-1)
        return components.reshape(*components.shape[:-1], *self.shape) if has_site_axes else components

    def _flatten_element(self, x, label: str) -> tuple[jax.Array, bool]:
        """Return an element of shape (..., dim), and True if it came with axes for the sites."""
        array = jnp.asarray(numeric_array(x, label))
        if self.sites is not None and array.shape[-len(self.shape) :] == self.shape:
            array = array.reshape(*array.shape[: -len(self.shape)], self.dim)
            return real_components(array, self.dim, label), True
        if self.sites is not None and array.shape[-1:] != (self.dim,):
            raise ShapeError(
                f"{label} must have shape (..., {_axes_text(self.shape)}) or (..., {self.dim}), got {array.shape}"
            )
        return real_components(array, self.dim, label), False

    def _element(self, x, label: str) -> jax.Array:
        return self._flatten_element(x, label)[0]

    def _batched_bracket(self, x, y) -> jax.Array:
        return self.bracket(x, y)

    def _batched_ad_star(self, x, mu) -> jax.Array:
        return self.ad_star(x, mu)

    # -- structure, from the blocks -----------------------------------------------------------------------------------

    def killing_form(self) -> np.ndarray:
        return self._block_diagonal_matrix("the Killing form", lambda g: g.killing_form())

    def cartan_involution(self) -> np.ndarray:
        return self._block_diagonal_matrix("the Cartan involution", lambda g: g.cartan_involution())

    def killing_inner_product(self) -> BlockDiagonal:
        forms = tuple(_to_jax_if_dense(g.killing_inner_product()) for g, _ in self.blocks)
        return BlockDiagonal(forms, tuple(g.dim for g, _ in self.blocks), tuple(count for _, count in self.blocks))

    def killing_signature(self) -> tuple[int, int, int]:
        positive, negative, zero = np.sum([count * np.array(g.killing_signature()) for g, count in self.blocks], axis=0)
        return int(positive), int(negative), int(zero)

    def is_abelian(self) -> bool:
        return all(g.is_abelian() for g, _ in self.blocks)

    def is_semisimple(self) -> bool:
        return all(g.is_semisimple() for g, _ in self.blocks)

    def is_unimodular(self) -> bool:
        return all(g.is_unimodular() for g, _ in self.blocks)

    def derived_series(self) -> list[int]:
        return _sum_dimension_series([(g.derived_series(), count) for g, count in self.blocks])

    def lower_central_series(self) -> list[int]:
        return _sum_dimension_series([(g.lower_central_series(), count) for g, count in self.blocks])

    # -- Casimirs -----------------------------------------------------------------------------------------------------

    def casimir_count(self) -> int:
        return sum(count * g.casimir_count() for g, count in self.blocks)

    def _casimirs_of_degree(self, degree: int) -> list:
        """Return the Casimirs of each block in turn, as functions of the full mu.

        Raises
        ------
        LieAlgebraError
            If there are too many to list; :meth:`site_casimirs` evaluates the Casimirs of all sites together.
        """
        number = sum(count * len(g.casimirs(degree)) for g, count in self.blocks)
        if number * self.dim > MAX_LISTED_EXPONENTS:
            raise LieAlgebraError(
                f"{self.name} has {number} Casimirs of degree {degree}, too many to be listed as functions of all its "
                f"{self.dim} components; site_casimirs({degree}) evaluates those of all sites together"
            )
        return [
            _embed_casimir(F, start + i * g.dim, g.dim, self.dim)
            for g, count, start in self._blocks_with_starts()
            for i in range(count)
            for F in g.casimirs(degree)
        ]

    def site_casimirs(self, degree: int) -> list[SiteCasimirs]:
        """Return the Casimirs of the blocks, each a function of the full mu with one value per copy.

        For copies on sites the values have shape ``(..., *sites)``.
        """
        return [
            self._casimir_at_copies(F, g, count, start)
            for g, count, start in self._blocks_with_starts()
            for F in g.casimirs(degree)
        ]

    def leading_casimirs(self) -> list[tuple[str, Callable]]:
        named_casimirs: list[tuple[str, Callable]] = []
        for i, (g, count, start) in enumerate(self._blocks_with_starts()):
            block_text = "" if len(self.blocks) == 1 else f" in block {i + 1}"
            for name, F in g.leading_casimirs():
                if count > MAX_COPIES_LISTED:
                    named_casimirs.append(
                        (f"sum of {name}{block_text}", CasimirSum(self._casimir_at_copies(F, g, count, start)))
                    )
                    continue
                for j in range(count):
                    named_casimirs.append(
                        (f"{name} at {j + 1}{block_text}", _embed_casimir(F, start + j * g.dim, g.dim, self.dim))
                    )
        return named_casimirs

    def _casimir_at_copies(self, F: Callable, g: LieAlgebra, count: int, start: int) -> SiteCasimirs:
        return SiteCasimirs(F, g.dim, count, start, self.dim, self.sites)

    def _blocks_with_starts(self) -> Iterator[tuple[LieAlgebra, int, int]]:
        start = 0
        for g, count in self.blocks:
            yield g, count, start
            start += g.dim * count

    # -- constants ----------------------------------------------------------------------------------------------------

    def _build_by_constants(self) -> LieAlgebra:
        return direct_sum_by_constants([g for g, count in self.blocks for _ in range(count)])

    def _block_diagonal_matrix(
        self, matrix_name: str, matrix_of_block: Callable[[LieAlgebra], np.ndarray]
    ) -> np.ndarray:
        self._check_matrix_memory(matrix_name)
        return scipy.linalg.block_diag(*(block for g, count in self.blocks for block in [matrix_of_block(g)] * count))


class BlockAction:
    """Action of one element of a direct sum, block by block."""

    def __init__(self, g: DirectSum, x):
        self.g, self.x = g, x

    def bracket(self, y) -> jax.Array:
        return self.g.bracket(self.x, y)

    def ad_star(self, mu) -> jax.Array:
        return self.g.ad_star(self.x, mu)


@jax.tree_util.register_static
@dataclass(frozen=True)
class SiteCasimirs:
    """Casimir of one algebra, evaluated at each of its copies: shape (..., dim) to (..., copies).

    With sites, mu may have the shape ``(..., *sites, d)``, and the values have ``(..., *sites)``.
    """

    casimir: Callable
    size: int
    count: int
    start: int
    dim: int
    sites: tuple[int, ...] | None

    def __call__(self, mu) -> jax.Array:
        mu = jnp.asarray(numeric_array(mu, "mu"))
        shape = (self.count,) if self.sites is None else self.sites
        axes = (*shape, self.size)
        if self.sites is None or mu.shape[-len(axes) :] != axes:
            mu = real_components(mu, self.dim, "mu")[..., self.start : self.start + self.count * self.size]
            mu = mu.reshape(*mu.shape[:-1], *axes)
        return self.casimir(mu)

    def __str__(self) -> str:
        return f"{self.casimir} at each of {self.count} copies"


@jax.tree_util.register_static
@dataclass(frozen=True)
class CasimirSum:
    """Sum of a Casimir over all copies of its algebra, shape (..., dim) to (...)."""

    site_casimirs: SiteCasimirs

    dim = forward_to("site_casimirs")

    def __call__(self, mu) -> jax.Array:
        return jnp.sum(
            self.site_casimirs(real_components(mu, self.dim, "mu")).reshape(*jnp.shape(mu)[:-1], -1), axis=-1
        )

    def __str__(self) -> str:
        return f"sum of {self.site_casimirs.casimir}"


@jax.tree_util.register_static
@dataclass(frozen=True)
class BlockCasimir:
    """Casimir of one block as a function of the full mu, shape (..., dim) to (...)."""

    casimir: Callable
    start: int
    size: int
    dim: int

    def __call__(self, mu) -> jax.Array:
        return self.casimir(real_components(mu, self.dim, "mu")[..., self.start : self.start + self.size])

    def __str__(self) -> str:
        return f"{self.casimir} of components {self.start + 1} to {self.start + self.size}"


def _embed_casimir(casimir, start: int, size: int, dim: int) -> Polynomial | BlockCasimir:
    """Return a Casimir of a summand as a function of all ``dim`` components; the summand begins at ``start``."""
    if not isinstance(casimir, Polynomial):
        return BlockCasimir(casimir, start, size, dim)
    exponents = np.zeros((len(casimir.terms), dim), dtype=np.int64)
    exponents[:, start : start + size] = casimir.exponents
    return Polynomial(exponents, casimir.coefficients)


def direct_sum_by_constants(algebras: Sequence[LieAlgebra]) -> LieAlgebra:
    """Return the direct sum as an algebra with one array of structure constants."""
    dim = sum(g.dim for g in algebras)
    constants, start = np.zeros((dim, dim, dim)), 0
    for g in algebras:
        block = slice(start, start + g.dim)
        constants[block, block, block] = g.structure_constants
        start += g.dim
    bases = [g.basis for g in algebras]
    matrix_bases = [basis for basis in bases if basis is not None]
    basis = None
    if len(matrix_bases) == len(bases):
        basis = np.array(
            [
                scipy.linalg.block_diag(
                    *(e if i == j else np.zeros_like(neighbour[0]) for j, neighbour in enumerate(matrix_bases))
                )
                for i, block_basis in enumerate(matrix_bases)
                for e in block_basis
            ]
        )
    name = " + ".join(g.name for g in algebras)
    total = LieAlgebra(constants, name=name, basis=basis, basis_names=joined_basis_names(*algebras))
    starts = np.cumsum([0, *(g.dim for g in algebras)])
    invariants = [
        _embed_casimir(F, int(start), g.dim, dim)
        for g, start in zip(algebras, starts, strict=False)
        for F in g.invariants
    ]
    return total._with_unchecked_invariants(invariants) if invariants else total


def joined_basis_names(*algebras: LieAlgebra) -> tuple[str, ...] | None:
    """Return the names of all basis elements in order; None if an algebra has none, or two names are equal."""
    names = [name for g in algebras for name in g.basis_names or ()]
    return tuple(names) if len(set(names)) == sum(g.dim for g in algebras) else None


def _sum_dimension_series(dims_and_counts: list[tuple[list[int], int]]) -> list[int]:
    """Return the sum of series of dimensions, each times its count; a shorter series continues with its last value."""
    n_terms = max(len(dims) for dims, _ in dims_and_counts)
    return [sum(count * dims[min(i, len(dims) - 1)] for dims, count in dims_and_counts) for i in range(n_terms)]


def _block_diagonal(stacks: list[jax.Array]) -> jax.Array:
    """Return block-diagonal matrices, shape (..., n, n), from stacks of shape (..., count, d, d)."""
    size = sum(stack.shape[-3] * stack.shape[-1] for stack in stacks)
    matrix, start = jnp.zeros((*stacks[0].shape[:-3], size, size)), 0
    for stack in stacks:
        count, d = stack.shape[-3], stack.shape[-1]
        block = jnp.einsum("...idm,ij->...idjm", stack, np.eye(count)).reshape(*stack.shape[:-3], count * d, count * d)
        matrix = matrix.at[..., start : start + count * d, start : start + count * d].set(block)
        start += count * d
    return matrix


def _to_jax_if_dense(form):
    return jnp.asarray(form) if isinstance(form, np.ndarray) else form


def _axes_text(shape: tuple[int, ...]) -> str:
    return ", ".join(map(str, shape))


LieAlgebra._power = staticmethod(power)


MAX_DIM_BY_CONSTANTS = 40
"""Largest dimension in which a direct sum is an array of structure constants."""


def direct_sum(*algebras: LieAlgebra) -> LieAlgebra:
    """Return the direct sum of algebras: the elements of the first, then of the second, …; different summands commute.

    Up to dimension 40 the sum has structure constants; a larger one acts block by block, without them, and consecutive
    copies of one algebra act as one batch. See :func:`manifolds.power`.

    Parameters
    ----------
    algebras : LieAlgebra
        The summands, at least one.

    Examples
    --------
    >>> g = mf.direct_sum(mf.so(3), mf.abelian(1))
    >>> g.dim, g.casimir_count()
    (4, 2)
    """
    if not algebras:
        raise ShapeError("direct_sum needs at least one algebra")
    if sum(g.dim for g in algebras) <= MAX_DIM_BY_CONSTANTS:
        return direct_sum_by_constants(algebras)
    return merged_direct_sum(algebras)


def semidirect_sum(g: LieAlgebra, representation, name: str | None = None, *, ideal=None) -> LieAlgebra:
    """Return the semidirect sum of g with an ideal: ``[(x, u), (y, v)] = ([x, y], rho(x) v - rho(y) u + [u, v])``.

    Parameters
    ----------
    g : LieAlgebra
        The algebra that acts.
    representation : array, shape (g.dim, m, m), or callable
        The matrices ``rho(e_a)``, or a function from components x, shape (dim,), to ``rho(x)``. With an ideal these are
        derivations of it: the columns of ``rho(e_a)`` are the images of the basis elements.
    name : str, optional
        The name in messages.
    ideal : LieAlgebra, of dimension m, optional
        The algebra of u and v; by default the abelian algebra of a vector space.

    Returns
    -------
    LieAlgebra
        Of dimension ``g.dim + m``: the elements of g first, then those of the ideal. On a vector space its matrices are
        the affine ones ``[[rho(x), v], [0, 0]]``, preceded by the matrices of g if rho alone is not faithful. With an
        ideal they are the adjoint matrices if its centre is zero, and unknown otherwise.

    Raises
    ------
    RepresentationError
        If ``[rho(e_a), rho(e_b)] != rho([e_a, e_b])`` for some pair, or ``rho(e_a) [u, v]`` is not
        ``[rho(e_a) u, v] + [u, rho(e_a) v]`` for some pair of the ideal; the message names the pair.
    """
    if ideal is not None and not isinstance(ideal, LieAlgebra):
        raise ComponentError(f"ideal must be a LieAlgebra, got {type(ideal).__name__}")
    if callable(representation):
        representation = [np.asarray(representation(e)) for e in np.eye(g.dim)]
    rho = np.asarray(representation, dtype=np.float64)
    m = ideal.dim if ideal is not None else rho.shape[-1] if rho.ndim else 0
    if rho.shape != (g.dim, m, m):
        raise ShapeError(f"a representation of {g.name} must have shape ({g.dim}, {m}, {m}), got {rho.shape}")
    _check_representation(g, rho)
    dim = g.dim + m
    constants = np.zeros((dim, dim, dim))
    constants[: g.dim, : g.dim, : g.dim] = g.structure_constants
    constants[: g.dim, g.dim :, g.dim :] = rho.swapaxes(1, 2)  # [e_a, v_j] = rho(e_a) v_j
    constants[g.dim :, : g.dim, g.dim :] = -rho.swapaxes(1, 2).swapaxes(0, 1)
    if ideal is None:
        return LieAlgebra(constants, name=name or f"{g.name} x R^{m}", basis=_semidirect_sum_matrices(g, rho))
    _check_derivations(g, rho, ideal)
    constants[g.dim :, g.dim :, g.dim :] = ideal.structure_constants
    total = LieAlgebra(constants, name=name or f"{g.name} x {ideal.name}", basis_names=joined_basis_names(g, ideal))
    adjoint = total._balanced_constants_and_factors[0].reshape(dim, -1)
    is_faithful = adjoint.any() and len(row_space_basis(adjoint)) == dim
    return LieAlgebra(
        constants,
        name=total.name,
        basis=total.structure_constants.swapaxes(1, 2) if is_faithful else None,
        basis_names=total.basis_names,
    )


def _check_representation(g: LieAlgebra, representation_matrices: np.ndarray) -> None:
    """Raise RepresentationError unless the commutators of the matrices are those of a representation of g."""
    products = np.einsum("aij,bjk->abik", representation_matrices, representation_matrices)
    defect = (
        products - products.swapaxes(0, 1) - np.einsum("abc,cij->abij", g.structure_constants, representation_matrices)
    )
    residuals = np.abs(defect).max(axis=(2, 3))
    images = float(np.abs(g.structure_constants).max() * np.abs(representation_matrices).max())
    tolerance = AXIOM_TOLERANCE * max(float(np.abs(products).max()), images)
    if residuals.max() > tolerance:
        a, b = np.unravel_index(residuals.argmax(), residuals.shape)
        raise RepresentationError(
            f"not a representation of {g.name}: [rho(e{a + 1}), rho(e{b + 1})] differs from rho([e{a + 1}, e{b + 1}]) "
            f"by {residuals.max():.3g} (tolerance {tolerance:.1g})",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(int(a), int(b)),
        )


def _check_derivations(g: LieAlgebra, representation_matrices: np.ndarray, ideal: LieAlgebra) -> None:
    """Raise RepresentationError unless every matrix is a derivation of the ideal."""
    C = ideal.structure_constants
    defect = np.einsum("ijk,alk->aijl", C, representation_matrices)  # D [u_i, u_j] - [D u_i, u_j] - [u_i, D u_j]
    defect -= np.einsum("aki,kjl->aijl", representation_matrices, C) + np.einsum(
        "akj,ikl->aijl", representation_matrices, C
    )
    residuals = np.abs(defect).max(axis=3)
    tolerance = AXIOM_TOLERANCE * float(np.abs(C).max() * np.abs(representation_matrices).max())
    if residuals.max() > tolerance:
        a, i, j = (int(index) for index in np.unravel_index(residuals.argmax(), residuals.shape))
        raise RepresentationError(
            f"rho(e{a + 1}) of {g.name} is not a derivation D of {ideal.name}: D [u{i + 1}, u{j + 1}] differs from "
            f"[D u{i + 1}, u{j + 1}] + [u{i + 1}, D u{j + 1}] by {residuals.max():.3g} (tolerance {tolerance:.1g})",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(a, i, j),
        )


def _semidirect_sum_matrices(g: LieAlgebra, representation_matrices: np.ndarray) -> np.ndarray | None:
    """Return matrices of the semidirect sum with an abelian ideal; None if g and the affine ones give none.

    They are affine, shape (dim, m + 1, m + 1); beside the matrices of g if the affine ones alone are not faithful.
    """
    m, dim = representation_matrices.shape[1], g.dim + representation_matrices.shape[1]
    affine = np.zeros((dim, m + 1, m + 1))
    affine[: g.dim, :m, :m] = representation_matrices
    affine[np.arange(g.dim, dim), np.arange(m), m] = 1.0
    norms = np.linalg.norm(representation_matrices, axis=(1, 2))
    if norms.all() and len(row_space_basis(representation_matrices.reshape(g.dim, -1) / norms[:, None])) == g.dim:
        return affine
    if g.basis is None:
        return None
    padded_basis = np.concatenate([g.basis, np.zeros((m, *g.basis.shape[1:]))])
    return np.array([scipy.linalg.block_diag(u, e) for u, e in zip(padded_basis, affine, strict=True)])
