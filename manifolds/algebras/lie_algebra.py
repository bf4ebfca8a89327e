"""Finite-dimensional real Lie algebras, from structure constants or from matrices.

Conventions: ``[e_a, e_b] = sum_c C[a, b, c] e_c``; the pairing of g* with g is the dot product of components; and
``<ad*_xi mu, eta> = <mu, [xi, eta]>`` with no minus sign, so that Lie-Poisson motion is ``mu' = ad*_{grad H} mu``
[BFM 3.1]. Components stand on the last axis; leading axes are batches.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from .._arrays import is_traced, real_components, square_matrices
from .._names import checked_names
from ..errors import (
    AntisymmetryError,
    ClosureError,
    ComponentError,
    JacobiError,
    LieAlgebraError,
    RepresentationError,
    ShapeError,
)
from ._balance import STRUCTURE_TOLERANCE, balanced
from ._exact import RationalArray, jacobi_sums, rational_array
from .casimirs import casimirs
from .polynomial_casimirs import casimir_count

AXIOM_TOLERANCE = 1e-12
"""Relative residual allowed in an axiom when the constants are not rational (rounding of a few products)."""


@jax.tree_util.register_static
class LieAlgebra:
    """A real Lie algebra with a chosen basis.

    Build one with :meth:`from_structure_constants`, :meth:`from_matrices`, or a name of the catalogue
    (``manifolds.so(3)``). Two algebras are equal when their constants and matrices are.

    What is said about the structure (``is_semisimple``, ``derived_series``, …) holds for the algebra and not for its
    basis: it is decided on constants that a scaling of the basis elements has made of similar size, where what is below
    1e-10 counts as rounding.

    Attributes
    ----------
    dim : int
    name : str
    structure_constants : ndarray, shape (dim, dim, dim), read-only
        ``C[a, b, c]`` with ``[e_a, e_b] = sum_c C[a, b, c] e_c``.
    rational_constants : RationalArray or None
        The same constants as exact fractions, where they are recognised as such and are not too large.
    basis : ndarray, shape (dim, m, m), or None
        The matrices ``e_a``, where known.
    basis_names : tuple of str, or None
        What the basis elements are called, and the components of mu in Casimirs and pictures with them; see
        :meth:`with_basis_names`.
    """

    def __init__(self, structure_constants, *, name: str = "g", basis=None, basis_names=None):
        constants = _checked_constants(structure_constants)
        exact = rational_array(constants)
        machine_size = exact is not None and exact.numerator.dtype != object
        self.rational_constants: RationalArray | None = exact if machine_size else None
        self.structure_constants = _frozen(np.asarray(constants if exact is None else exact, dtype=np.float64))
        self.dim: int = self.structure_constants.shape[0]
        self.name = name
        self.basis: np.ndarray | None = None if basis is None else _frozen(np.asarray(basis))
        self.basis_names = None if basis_names is None else checked_names(basis_names, self.dim)
        _check_axioms(self.structure_constants if exact is None else exact.numerator, name, exact)

    # -- construction -------------------------------------------------------------------------------------------

    @classmethod
    def from_structure_constants(cls, structure_constants, name: str = "g", basis_names=None) -> LieAlgebra:
        """The algebra with ``[e_a, e_b] = sum_c C[a, b, c] e_c``.

        Parameters
        ----------
        structure_constants : array of int, Fraction or float, shape (dim, dim, dim)
        name : str
        basis_names : sequence of dim str, optional

        Raises
        ------
        ShapeError, ComponentError
            If the array is not cubic, real and finite.
        AntisymmetryError, JacobiError
            If an axiom fails; the message names the basis elements and the residual. The check is exact when every
            constant is an integer or a fraction, and to 1e-12 relative otherwise.
        """
        return cls(structure_constants, name=name, basis_names=basis_names)

    @classmethod
    def from_matrices(cls, basis, name: str = "g", basis_names=None) -> LieAlgebra:
        """The algebra spanned over the reals by ``basis``, with the commutator.

        Parameters
        ----------
        basis : array, real or complex, shape (dim, m, m)
        name : str
        basis_names : sequence of dim str, optional

        Raises
        ------
        ClosureError
            If the matrices are linearly dependent over the reals or a commutator leaves their span.
        """
        try:
            matrices = np.asarray(basis)
            matrices = matrices.astype(np.complex128 if np.iscomplexobj(matrices) else np.float64)
        except (TypeError, ValueError) as error:
            raise ComponentError(f"the basis is not a rectangular array of numbers: {error}") from None
        if matrices.ndim != 3 or matrices.shape[1] != matrices.shape[2] or 0 in matrices.shape:
            raise ShapeError(f"a matrix basis has shape (dim, m, m), not {matrices.shape}")
        if not np.isfinite(matrices).all():
            raise ComponentError("the matrix basis has entries that are not finite")
        dim = len(matrices)
        sizes = np.linalg.norm(matrices, axis=(1, 2))
        if not sizes.all():
            raise ClosureError(f"e{sizes.argmin() + 1} is the zero matrix; a basis is linearly independent")
        matrices, given = matrices / sizes[:, None, None], matrices  # of norm 1: what is rounding has one size
        columns = _real_columns(matrices)
        singular = scipy.linalg.svdvals(columns)
        if dim > columns.shape[0] or singular[-1] <= 1e-10 * singular[0]:
            raise ClosureError(
                f"the {dim} matrices are linearly dependent over the reals (smallest over largest singular value "
                f"{singular[-1] / singular[0]:.1e}); remove the superfluous ones",
                residual=float(singular[-1]),
                tolerance=float(1e-10 * singular[0]),
            )
        products = np.einsum("aij,bjk->abik", matrices, matrices)
        commutators = _real_columns((products - products.swapaxes(0, 1)).reshape(dim * dim, *matrices.shape[1:]))
        commutators[:, np.linalg.norm(commutators, axis=0) <= AXIOM_TOLERANCE] = 0.0
        coordinates, *_ = scipy.linalg.lstsq(columns, commutators)
        residuals = np.abs(columns @ coordinates - commutators).max(axis=0)
        tolerance = 1e-10
        if residuals.max() > tolerance:
            a, b = divmod(int(residuals.argmax()), dim)
            raise ClosureError(
                f"[e{a + 1}, e{b + 1}] leaves the span of the {dim} matrices (residual {residuals.max():.3g} "
                f"for matrices of norm 1, tolerance {tolerance:.1g}); add the missing commutators to the basis",
                residual=float(residuals.max()),
                tolerance=tolerance,
                indices=(a, b),
            )
        constants = coordinates.T.reshape(dim, dim, dim)
        constants = (constants - constants.swapaxes(0, 1)) / 2
        scales = sizes[:, None, None] * sizes[:, None] / sizes
        constants = _without_rounding(constants, scales, columns, commutators)
        return cls(constants, name=name, basis=given, basis_names=basis_names)

    def with_basis_names(self, *names: str) -> LieAlgebra:
        """The same algebra with names for its basis elements, equal to the one without.

        Its Casimirs print with these names in place of ``mu1``, ``mu2``, …, pictures label their axes so, and sums of
        algebras that all have names keep them.

        Raises
        ------
        ParameterError
            If there are not ``dim`` different names, each an identifier such as ``Jx``.

        Examples
        --------
        >>> g = manifolds.se(2).with_basis_names("L", "Px", "Py")
        >>> print(*g.casimirs(2))
        Px**2 + Py**2
        """
        named = copy(self)
        named.basis_names = checked_names(names, self.dim)
        return named

    # -- the operations -----------------------------------------------------------------------------------------

    def bracket(self, x, y) -> jax.Array:
        """Lie bracket ``[x, y]``; ``x``, ``y`` and the result have shape (..., dim)."""
        return jnp.einsum("abc,...a,...b->...c", self.structure_constants, self._element(x, "x"), self._element(y, "y"))

    def ad(self, x) -> jax.Array:
        """Matrix of ``y -> [x, y]``, shape (..., dim, dim): ``ad(x) @ y == bracket(x, y)``."""
        return jnp.einsum("abc,...a->...cb", self.structure_constants, self._element(x, "x"))

    def ad_star(self, x, mu) -> jax.Array:
        """Coadjoint operator ``ad*_x mu``, defined by ``<ad*_x mu, y> = <mu, [x, y]>`` [BFM, after 3.1].

        Parameters
        ----------
        x : array, shape (..., dim)
            Algebra element (1/time for a body).
        mu : array, shape (..., dim)
            Dual element (mass * length**2 / time for a body).

        Returns
        -------
        array, shape (..., dim)

        Raises
        ------
        ShapeError
            If the last axes differ from ``dim``.
        """
        return jnp.einsum(
            "abc,...a,...c->...b", self.structure_constants, self._element(x, "x"), self._element(mu, "mu")
        )

    def killing_form(self) -> np.ndarray:
        """Killing form ``kappa[a, b] = tr(ad_a ad_b)``, shape (dim, dim)."""
        return self._killing_form

    def killing_signature(self) -> tuple[int, int, int]:
        """Numbers of positive, negative and zero eigenvalues of the Killing form, the same in every basis."""
        eigenvalues = np.linalg.eigvalsh(_killing_form(self._balanced[0]))
        positive, negative = (int((sign * eigenvalues > STRUCTURE_TOLERANCE).sum()) for sign in (1, -1))
        return positive, negative, self.dim - positive - negative

    def hat(self, x) -> jax.Array:
        """The matrix ``sum_a x_a e_a``, shape (..., m, m)."""
        return jnp.einsum("...a,aij->...ij", self._element(x, "x"), self._known_basis())

    def vee(self, X) -> jax.Array:
        """Components of a matrix of the algebra, shape (..., dim): the inverse of :meth:`hat`.

        Raises
        ------
        LieAlgebraError
            If ``X`` is not in the span of the basis (residual above 1e-8 relative; not checked under tracing).
        """
        basis = self._known_basis()
        matrix = square_matrices(X, basis.shape[-1], "X")
        flat = matrix.reshape(*matrix.shape[:-2], -1)
        flat = jnp.concatenate([flat.real, flat.imag], axis=-1)
        components = jnp.einsum("ai,...i->...a", self._left_inverse, flat)
        if not is_traced(flat):
            residual = float(jnp.max(jnp.abs(components @ _real_columns(basis).T - flat), initial=0.0))
            tolerance = 1e-8 * max(float(np.abs(basis).max()), float(jnp.max(jnp.abs(flat), initial=0.0)))
            if not residual <= tolerance:
                raise LieAlgebraError(
                    f"the matrix is not in {self.name}: it is {residual:.3g} away from its span "
                    f"(tolerance {tolerance:.1g})",
                    residual=residual,
                    tolerance=tolerance,
                )
        return components

    # -- structure ----------------------------------------------------------------------------------------------

    def is_abelian(self) -> bool:
        """Whether every bracket vanishes."""
        return not self.structure_constants.any()

    def is_semisimple(self) -> bool:
        """Whether the Killing form is nondegenerate (Cartan's criterion)."""
        return self.killing_signature()[2] == 0

    def is_compact_type(self) -> bool:
        """Whether the Killing form is negative definite: the algebra of a compact semisimple group."""
        return self.killing_signature() == (0, self.dim, 0)

    def is_solvable(self) -> bool:
        """Whether the derived series ends at zero."""
        return self.derived_series()[-1] == 0

    def is_nilpotent(self) -> bool:
        """Whether the lower central series ends at zero."""
        return self.lower_central_series()[-1] == 0

    def is_unimodular(self) -> bool:
        """Whether ``tr ad_x = 0`` for every x."""
        traces = np.einsum("abb->a", self._balanced[0])
        return bool(np.abs(traces).max() <= STRUCTURE_TOLERANCE)

    def derived_series(self) -> list[int]:
        """Dimensions of g, [g, g], [[g, g], [g, g]], … until they no longer fall."""
        return self._series(lambda ideal: (ideal, ideal))

    def lower_central_series(self) -> list[int]:
        """Dimensions of g, [g, g], [g, [g, g]], … until they no longer fall."""
        return self._series(lambda ideal: (np.eye(self.dim), ideal))

    def cartan_involution(self) -> np.ndarray:
        """A Cartan involution theta, shape (dim, dim), for which ``-kappa(x, theta y)`` is positive definite.

        The identity on compact type. Otherwise found without matrices: among all inner products of unit volume, the
        one that minimises the norm of the bracket satisfies ``ad_x^T = -ad_{theta x}`` [Lauret 2003]; the norm is
        convex along the geodesics of inner products, so Newton's method finds it. For ``sl``, ``so`` and ``sp`` in
        their usual bases theta is ``X -> -X^T``.

        Raises
        ------
        LieAlgebraError
            If the algebra is not semisimple.
        """
        return self._cartan_involution

    # -- Casimirs -----------------------------------------------------------------------------------------------

    def casimir_count(self) -> int:
        """Number of independent Casimir functions near a generic point of g*.

        That is dim minus the generic rank of the Lie-Poisson tensor; they need not be polynomials.
        """
        return casimir_count(self)

    def casimirs(self, degree: int):
        """All homogeneous polynomial Casimirs of this degree, modulo products of those of lower degree.

        Returns a list of :class:`manifolds.Polynomial`, callable on ``mu`` and printing as
        ``mu1**2 + mu2**2 + mu3**2``; the coefficients are exact when the structure constants are rational. Where there
        are too many monomials and the algebra is semisimple or reductive, :class:`manifolds.TracePolynomial`.
        """
        found = casimirs(self, degree)
        return found if self.basis_names is None else [F.with_names(*self.basis_names) for F in found]

    # -- Python ---------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"LieAlgebra({self.name!r}, dim={self.dim})"

    def __eq__(self, other) -> bool:
        return isinstance(other, LieAlgebra) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self):
        basis = () if self.basis is None else (self.basis.shape, self.basis.tobytes())
        return self.dim, self.structure_constants.tobytes(), basis

    def _element(self, x, what: str) -> jax.Array:
        return real_components(x, self.dim, what)

    def _known_basis(self) -> np.ndarray:
        if self.basis is None:
            raise LieAlgebraError(
                f"{self.name} was defined by structure constants, so its matrices are not known; build it with "
                "LieAlgebra.from_matrices to use hat and vee"
            )
        return self.basis

    @cached_property
    def _left_inverse(self) -> np.ndarray:
        return np.linalg.pinv(_real_columns(self._known_basis()))

    @cached_property
    def _killing_form(self) -> np.ndarray:
        return _frozen(_killing_form(self.structure_constants))

    @cached_property
    def _balanced(self) -> tuple[np.ndarray, np.ndarray]:
        """The constants in a basis scaled by factors, the largest of size 1, and the factors."""
        return balanced(self.structure_constants)

    @cached_property
    def _cartan_involution(self) -> np.ndarray:
        if not self.is_semisimple():
            raise LieAlgebraError(f"{self.name} is not semisimple, so it has no Cartan involution")
        if self.is_compact_type():
            return _frozen(np.eye(self.dim))
        constants, factors = self._balanced
        theta = _cartan_involution(constants, self.name) * factors[:, None] / factors
        snapped = np.asarray(np.round(theta))
        return _frozen(snapped if np.abs(snapped - theta).max() < 1e-10 else theta)

    def _series(self, factors: Callable) -> list[int]:
        ideal, dims = np.eye(self.dim), [self.dim]
        while True:
            left, right = factors(ideal)
            products = np.einsum("ia,jb,abc->ijc", left, right, self._balanced[0], optimize=True)
            ideal = _row_space(products.reshape(-1, self.dim))
            if len(ideal) == dims[-1]:
                return dims
            dims.append(len(ideal))
            if not len(ideal):
                return dims


def direct_sum(*algebras: LieAlgebra) -> LieAlgebra:
    """Direct sum: the elements of the first algebra, then of the second, …; different summands commute."""
    if not algebras:
        raise ShapeError("direct_sum needs at least one algebra")
    dim = sum(g.dim for g in algebras)
    constants = np.zeros((dim, dim, dim))
    start = 0
    for g in algebras:
        block = slice(start, start + g.dim)
        constants[block, block, block] = g.structure_constants
        start += g.dim
    bases = [g.basis for g in algebras]
    known = [basis for basis in bases if basis is not None]
    basis = None
    if len(known) == len(bases):
        basis = np.array(
            [
                scipy.linalg.block_diag(*(e if i == j else np.zeros_like(other[0]) for j, other in enumerate(known)))
                for i, own in enumerate(known)
                for e in own
            ]
        )
    return LieAlgebra(
        constants, name=" + ".join(g.name for g in algebras), basis=basis, basis_names=_joined_names(*algebras)
    )


def semidirect_sum(g: LieAlgebra, representation, name: str | None = None, *, ideal=None) -> LieAlgebra:
    """Semidirect sum of g with what it acts on: ``[(x, u), (y, v)] = ([x, y], rho(x) v - rho(y) u + [u, v])``.

    Parameters
    ----------
    g : LieAlgebra
    representation : array, shape (g.dim, m, m), or callable
        The matrices ``rho(e_a)``, or a function from components x, shape (dim,), to ``rho(x)``. With an ideal its
        derivations: the columns of ``rho(e_a)`` are the images of the basis elements.
    name : str, optional
    ideal : LieAlgebra, of dimension m, optional
        The algebra that u and v are in; by default the abelian one of a vector space.

    Returns
    -------
    LieAlgebra
        Dimension ``g.dim + m``: the elements of g first, then those of the ideal. On a vector space its matrices are
        the affine ones ``[[rho(x), v], [0, 0]]``, preceded by those of g where rho alone is not faithful. With an ideal
        they are the adjoint ones where its centre is zero, and unknown otherwise.

    Raises
    ------
    RepresentationError
        If ``[rho(e_a), rho(e_b)] != rho([e_a, e_b])`` for some pair, or ``rho(e_a) [u, v]`` is not
        ``[rho(e_a) u, v] + [u, rho(e_a) v]`` for some pair of the ideal; they are named.
    """
    if ideal is not None and not isinstance(ideal, LieAlgebra):
        raise ComponentError(f"the ideal is a LieAlgebra, not {type(ideal).__name__}")
    if callable(representation):
        representation = [np.asarray(representation(e)) for e in np.eye(g.dim)]
    rho = np.asarray(representation, dtype=np.float64)
    m = ideal.dim if ideal is not None else rho.shape[-1] if rho.ndim else 0
    if rho.shape != (g.dim, m, m):
        raise ShapeError(f"a representation of {g.name} has shape ({g.dim}, {m}, {m}), not {rho.shape}")
    _check_representation(g, rho)
    dim = g.dim + m
    constants = np.zeros((dim, dim, dim))
    constants[: g.dim, : g.dim, : g.dim] = g.structure_constants
    constants[: g.dim, g.dim :, g.dim :] = rho.swapaxes(1, 2)  # [e_a, v_j] = rho(e_a) v_j
    constants[g.dim :, : g.dim, g.dim :] = -rho.swapaxes(1, 2).swapaxes(0, 1)
    if ideal is None:
        return LieAlgebra(constants, name=name or f"{g.name} x R^{m}", basis=_affine_matrices(g, rho))
    _check_derivations(g, rho, ideal)
    constants[g.dim :, g.dim :, g.dim :] = ideal.structure_constants
    total = LieAlgebra(constants, name=name or f"{g.name} x {ideal.name}", basis_names=_joined_names(g, ideal))
    adjoint = total._balanced[0].reshape(dim, -1)
    faithful = adjoint.any() and len(_row_space(adjoint)) == dim
    return LieAlgebra(
        constants,
        name=total.name,
        basis=total.structure_constants.swapaxes(1, 2) if faithful else None,
        basis_names=total.basis_names,
    )


def _check_representation(g: LieAlgebra, rho: np.ndarray) -> None:
    products = np.einsum("aij,bjk->abik", rho, rho)
    defect = products - products.swapaxes(0, 1) - np.einsum("abc,cij->abij", g.structure_constants, rho)
    residuals = np.abs(defect).max(axis=(2, 3))
    images = float(np.abs(g.structure_constants).max() * np.abs(rho).max())
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


def _check_derivations(g: LieAlgebra, rho: np.ndarray, ideal: LieAlgebra) -> None:
    C = ideal.structure_constants
    defect = np.einsum("ijk,alk->aijl", C, rho)  # D [u_i, u_j] - [D u_i, u_j] - [u_i, D u_j]
    defect -= np.einsum("aki,kjl->aijl", rho, C) + np.einsum("akj,ikl->aijl", rho, C)
    residuals = np.abs(defect).max(axis=3)
    tolerance = AXIOM_TOLERANCE * float(np.abs(C).max() * np.abs(rho).max())
    if residuals.max() > tolerance:
        a, i, j = (int(index) for index in np.unravel_index(residuals.argmax(), residuals.shape))
        raise RepresentationError(
            f"rho(e{a + 1}) of {g.name} is not a derivation D of {ideal.name}: D [u{i + 1}, u{j + 1}] differs from "
            f"[D u{i + 1}, u{j + 1}] + [u{i + 1}, D u{j + 1}] by {residuals.max():.3g} (tolerance {tolerance:.1g})",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(a, i, j),
        )


def _affine_matrices(g: LieAlgebra, rho: np.ndarray) -> np.ndarray | None:
    m, dim = rho.shape[1], g.dim + rho.shape[1]
    affine = np.zeros((dim, m + 1, m + 1))
    affine[: g.dim, :m, :m] = rho
    affine[np.arange(g.dim, dim), np.arange(m), m] = 1.0
    sizes = np.linalg.norm(rho, axis=(1, 2))
    if sizes.all() and len(_row_space(rho.reshape(g.dim, -1) / sizes[:, None])) == g.dim:
        return affine
    if g.basis is None:
        return None
    upper = np.concatenate([g.basis, np.zeros((m, *g.basis.shape[1:]))])
    return np.array([scipy.linalg.block_diag(u, e) for u, e in zip(upper, affine, strict=True)])


# -- helpers ------------------------------------------------------------------------------------------------------


def _joined_names(*algebras: LieAlgebra) -> tuple[str, ...] | None:
    """The names of all basis elements, where all have some and no two the same."""
    names = [name for g in algebras for name in g.basis_names or ()]
    return tuple(names) if len(set(names)) == sum(g.dim for g in algebras) else None


def _checked_constants(values) -> np.ndarray:
    try:
        array = np.asarray(values)
        numeric = array.astype(np.complex128 if np.iscomplexobj(array) else np.float64)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"the structure constants are not a rectangular array of numbers: {error}") from None
    if array.ndim != 3 or len(set(array.shape)) != 1 or array.shape[0] == 0:
        raise ShapeError(f"structure constants have shape (dim, dim, dim), not {array.shape}")
    if np.iscomplexobj(numeric):
        raise ComponentError("structure constants must be real: use a real basis of the algebra")
    if not np.isfinite(numeric).all():
        a, b, c = np.argwhere(~np.isfinite(numeric))[0]
        raise ComponentError(f"the structure constant C[{a}, {b}, {c}] is {numeric[a, b, c]}")
    return array


def _check_axioms(constants: np.ndarray, name: str, exact: RationalArray | None) -> None:
    """Antisymmetry and Jacobi; ``constants`` are the integer numerators where ``exact`` is given."""
    unit = 1.0 if exact is None else 1.0 / exact.denominator
    how = "checked exactly" if exact is not None else "tolerance {:.1g}"
    scale = float(np.abs(constants).max())
    symmetric = np.abs(constants + constants.swapaxes(0, 1)).max(axis=2)
    tolerance = 0.0 if exact is not None else AXIOM_TOLERANCE * scale
    if symmetric.max() > tolerance:
        a, b = (int(i) for i in np.unravel_index(symmetric.argmax(), symmetric.shape))
        raise AntisymmetryError(
            f"{name}: [e{a + 1}, e{b + 1}] + [e{b + 1}, e{a + 1}] has a component of size "
            f"{symmetric.max() * unit:.3g} ({how.format(tolerance)}); set C[b, a, :] = -C[a, b, :]",
            residual=float(symmetric.max() * unit),
            tolerance=tolerance,
            indices=(a, b),
        )
    sums = jacobi_sums(constants)
    tolerance = 0.0 if exact is not None else AXIOM_TOLERANCE * scale**2 * len(constants)
    worst = int(np.abs(sums.data).argmax()) if sums.nnz else -1
    if worst >= 0 and abs(sums.data[worst]) > tolerance:
        residual = abs(float(sums.data[worst])) * unit**2
        a, b, c = sorted(int(i) for i in np.unravel_index(sums.coords[0][worst], constants.shape))
        raise JacobiError(
            f"{name}: the Jacobi identity fails for (e{a + 1}, e{b + 1}, e{c + 1}): "
            f"[[e{a + 1}, e{b + 1}], e{c + 1}] + cyclic has a component of size {residual:.3g} "
            f"({how.format(tolerance)})",
            residual=residual,
            tolerance=tolerance,
            indices=(a, b, c),
        )


def _without_rounding(
    constants: np.ndarray, scales: np.ndarray, columns: np.ndarray, commutators: np.ndarray
) -> np.ndarray:
    """The constants, times their scales, snapped to nearby fractions, if the commutators then hold at least as well.

    The constants are those of matrices of norm 1, the ``columns``.
    """
    scaled = constants * scales
    snapped = _nearest_fractions(scaled, 1e-12 * np.maximum(scales, np.abs(scaled)))
    defect = np.abs(columns @ (snapped / scales).reshape(len(constants) ** 2, -1).T - commutators).max()
    return snapped if defect <= 4 * np.finfo(float).eps else scaled


def _nearest_fractions(values: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Each value, or the nearest fraction of denominator 64 or less where that is nearer than ``within``."""
    found, least = values, within
    for denominator in range(1, 65):
        fractions = np.round(values * denominator) / denominator
        distances = np.abs(fractions - values)
        found = np.where(distances < least, fractions, found)
        least = np.minimum(distances, least)
    return found


def _real_columns(matrices: np.ndarray) -> np.ndarray:
    """Each matrix as a column of its real and imaginary parts: linear algebra over the reals."""
    flat = matrices.reshape(len(matrices), -1)
    return np.concatenate([flat.real, flat.imag], axis=1).T


def _killing_form(constants: np.ndarray) -> np.ndarray:
    return np.einsum("acd,bdc->ab", constants, constants, optimize=True)


def _row_space(rows: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the span of rows of size 1; what is smaller than STRUCTURE_TOLERANCE is rounding."""
    _, singular, basis = np.linalg.svd(rows, full_matrices=False)
    return basis[singular > STRUCTURE_TOLERANCE]


def _cartan_involution(constants: np.ndarray, name: str) -> np.ndarray:
    """Newton's method for the inner product of least bracket norm (see LieAlgebra.cartan_involution)."""
    dim = len(constants)
    upper = np.triu_indices(dim)
    directions = np.zeros((len(upper[0]), dim, dim))
    directions[np.arange(len(upper[0])), upper[0], upper[1]] = 1.0
    directions = (directions + directions.swapaxes(1, 2)) / 2
    directions -= np.einsum("kaa->k", directions)[:, None, None] * np.eye(dim) / dim  # volume is kept
    change = np.eye(dim)  # columns: the current basis in terms of the given one

    def transported(basis: np.ndarray) -> np.ndarray:
        return np.einsum("ai,bj,abc,kc->ijk", basis, basis, constants, np.linalg.inv(basis), optimize=True)

    current = transported(change)
    for _ in range(100):
        # d/dt of the constants when the basis moves by exp(t S), for each symmetric direction S
        moved = (
            np.einsum("kai,abc->kibc", directions, current, optimize=True)
            + np.einsum("kbj,abc->kajc", directions, current, optimize=True)
            - np.einsum("kdc,abc->kabd", directions, current, optimize=True)
        )
        # |exp(tS) C|^2 = |C|^2 + 2t <C, SC> + 2 t^2 |SC|^2 + …, minimised by -1/2 of a least-squares solution.
        # Near the minimum the derivations in p move nothing (S C -> 0); the cut-off keeps such directions out.
        weights, *_ = np.linalg.lstsq(moved.reshape(len(moved), -1).T, current.ravel(), rcond=1e-3)
        newton = -np.einsum("k,kij->ij", weights, directions) / 2
        size = np.abs(newton).max()
        if size < 1e-15 * dim:
            break
        change = change @ scipy.linalg.expm(newton * min(1.0, 0.5 / size))
        current = transported(change)
        if size < 1e-13:
            break
    # In the adapted basis ad_x^T = -ad_{theta x}: solve for theta, then return to the given basis.
    ad = current.swapaxes(1, 2)  # ad[a] is the matrix of e_a
    theta, *_ = np.linalg.lstsq(ad.reshape(dim, -1).T, -ad.swapaxes(1, 2).reshape(dim, -1).T, rcond=None)
    theta = change @ theta @ np.linalg.inv(change)
    automorphism = np.einsum("abd,cd->abc", constants, theta) - np.einsum(
        "da,eb,dec->abc", theta, theta, constants, optimize=True
    )
    residual = max(np.abs(automorphism).max(), np.abs(theta @ theta - np.eye(dim)).max())
    tolerance = 1e-9 * max(1.0, float(np.abs(constants).max()), float(np.abs(theta).max()) ** 2)
    if not residual <= tolerance:
        raise LieAlgebraError(
            f"no Cartan involution of {name} was found (residual {residual:.2g}, tolerance {tolerance:.1g}); "
            "rescale the basis so that the structure constants are of order one",
            residual=float(residual),
            tolerance=tolerance,
        )
    return theta


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.array(array)
    array.setflags(write=False)
    return array
