"""Finite-dimensional real Lie algebras, from structure constants or from matrices.

Conventions: ``[e_a, e_b] = sum_c C[a, b, c] e_c``; the pairing of g* with g is the dot product of components; and
``<ad*_xi mu, eta> = <mu, [xi, eta]>`` with no minus sign, so that Lie-Poisson motion is ``mu' = ad*_{grad H} mu``
[BFM 3.1]. Components stand on the last axis; leading axes are batches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from functools import cached_property
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_names
from .._arrays import is_traced, real_array, real_components, square_matrices
from ..errors import ComponentError, LieAlgebraError, ParameterError, ShapeError
from ._rational import RationalArray, rational_array
from .axioms import (
    STRUCTURE_TOLERANCE,
    balance_constants,
    check_axioms,
    constants_and_matrices,
    finite_cubic_array,
    real_columns,
)
from .bracket_table import algebra_html, constants_and_names
from .casimirs import DEFAULT_MAX_DEGREE, casimirs, casimirs_up_to, check_invariant, leading_casimirs
from .killing import cartan_involution_of, killing_form_of, row_space_basis
from .polynomial_casimirs import casimir_count
from .structure import Action, AdMatrixAction, Operator, terms_to_unroll, unrolled_bracket
from .structure_methods import CasimirInBasis, StructureMethods, constants_and_inverse_in_basis


@jax.tree_util.register_static
class LieAlgebra(StructureMethods):
    """A real Lie algebra with a chosen basis.

    Build one with :meth:`from_structure_constants`, :meth:`from_matrices`, or a name of the catalogue
    (``manifolds.so(3)``). Two algebras are equal when their constants and matrices are.

    Large algebras, and copies of one (``g ** n``), are of this class too; they compute the constants, the matrices and
    the forms only on demand. More members: ``dir(g)``, such as ``radical``, ``isomorphism_type``, ``change_of_basis``.
    Statements about the structure (``is_semisimple``, ``derived_series``, …) do not depend on the basis: it is scaled
    first, so that the constants have similar sizes. Constants below 1e-10 then count as zero.

    Attributes
    ----------
    dim, name : int, str
        The dimension, and the name in messages.
    structure_constants : ndarray, shape (dim, dim, dim), read-only
        ``C[a, b, c]`` with ``[e_a, e_b] = sum_c C[a, b, c] e_c``.
    rational_constants : RationalArray or None
        The same constants as exact fractions, where they are recognised as such and are not too large.
    basis, basis_names : ndarray, shape (dim, m, m), or None; tuple of str, or None
        The matrices ``e_a``, where known, and the names of ``e_a`` in Casimirs and figures: :meth:`with_basis_names`.

    Examples
    --------
    >>> C = np.zeros((3, 3, 3))
    >>> C[0, 1, 2], C[0, 2, 1] = 1, -1  # [e1, e2] = e3, [e1, e3] = -e2: the plane
    >>> g = mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="plane")
    >>> print(*g.casimirs(degree=2))
    mu2**2 + mu3**2
    """

    invariants: tuple[Callable, ...] = ()
    """Casimirs given by :meth:`with_invariants`."""

    def __init__(self, structure_constants, *, name: str = "g", basis=None, basis_names=None):
        constants = finite_cubic_array(structure_constants)
        fractions = rational_array(constants)
        fits_int64 = fractions is not None and fractions.numerator.dtype != object
        self._rational: RationalArray | None = fractions if fits_int64 else None
        self._constants = _read_only_copy(np.asarray(constants if fractions is None else fractions, dtype=np.float64))
        self.dim: int = self._constants.shape[0]
        self.name = name
        self._basis: np.ndarray | None = None if basis is None else _read_only_copy(np.asarray(basis))
        self.basis_names = None if basis_names is None else checked_names(basis_names, self.dim)
        check_axioms(self._constants if fractions is None else fractions.numerator, name, fractions, self.basis_names)

    @property
    def structure_constants(self) -> np.ndarray:
        return self._constants

    @property
    def rational_constants(self) -> RationalArray | None:
        return self._rational

    @property
    def basis(self) -> np.ndarray | None:
        return self._basis

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one element: ``(dim,)``; for copies on sites ``(*sites, dim of one copy)``."""
        return (self.dim,)

    # -- construction -------------------------------------------------------------------------------------------

    @classmethod
    def from_structure_constants(cls, structure_constants, name: str = "g", basis_names=None) -> LieAlgebra:
        """Return the algebra with ``[e_a, e_b] = sum_c C[a, b, c] e_c``.

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
        """Return the algebra that ``basis`` spans over the reals, with the commutator as bracket.

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
        constants, matrices = constants_and_matrices(basis)
        return cls(constants, name=name, basis=matrices, basis_names=basis_names)

    @classmethod
    def from_brackets(cls, brackets, *, name: str = "g", basis=None) -> LieAlgebra:
        """Return the algebra with the given brackets of named basis elements; all other brackets are zero.

        ParameterError, ComponentError, AntisymmetryError or JacobiError for unknown names, contradictory entries, or
        brackets that break the Jacobi identity.

        Parameters
        ----------
        brackets : dict
            The brackets by pairs of names; the opposite ones follow. A value is a name, such as ``"e3"`` or ``"-e3"``,
            a dictionary from names to coefficients (int, Fraction or float), or 0.
        name : str
            The name in messages.
        basis : sequence of str, optional
            The names of all basis elements in their order; by default ``e1``, ``e2``, … or the order of occurrence.

        Examples
        --------
        >>> g = mf.LieAlgebra.from_brackets({("e2", "e4"): "e1", ("e3", "e4"): {"e2": 1}})
        >>> print(*g.casimirs(max_degree=2), sep=", ")
        e1, 2*e1*e3 - e2**2
        """
        constants, names = constants_and_names(brackets, basis)
        return cls(constants, name=name, basis_names=names)

    def with_invariants(self, *functions: Callable) -> LieAlgebra:
        """Return an algebra that carries Casimirs beside its polynomial ones: rational or logarithmic, for example.

        Systems on the algebra follow them as they follow polynomial Casimirs. Each is checked at random points: ad* of
        its gradient must vanish.

        Parameters
        ----------
        *functions : callable
            Functions of mu, shape (dim,), by JAX, such as a :class:`manifolds.Formula`. They must be hashable.

        Raises
        ------
        LieAlgebraError
            If a function is no Casimir.

        Examples
        --------
        >>> g = mf.bianchi("V").with_invariants(mf.Formula("y / z", ("x", "y", "z")))
        >>> [name for name, _ in g.leading_casimirs()]
        ['y / z']
        """
        for function in functions:
            check_invariant(self, function)
        return self._with_unchecked_invariants(functions)

    def _with_unchecked_invariants(self, functions: Iterable[Callable]) -> LieAlgebra:
        """Return a copy with further invariants, which are not tested."""
        algebra = copy(self)
        algebra.__dict__.pop("_key", None)
        algebra.invariants = (*self.invariants, *functions)
        return algebra

    def with_basis_names(self, *names: str) -> LieAlgebra:
        """Return an equal algebra whose basis elements have names.

        Its Casimirs print with these names instead of ``mu1``, ``mu2``, …; pictures label their axes with them, and
        sums of algebras that all have names keep them.

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
        algebra = copy(self)
        algebra.basis_names = checked_names(names, self.dim)
        return algebra

    def change_of_basis(self, P, *, name: str | None = None, basis_names=None) -> LieAlgebra:
        """Return the algebra in the basis ``sum_b P[a, b] e_b``: the rows of P are its elements in this basis.

        Components of elements become ``P^-T x``, those of mu ``P mu``. Fractions stay exact.

        Parameters
        ----------
        P : array of int, Fraction or float, shape (dim, dim)
        name : str, optional
            By default the name of this algebra.
        basis_names : sequence of dim str, optional

        Raises
        ------
        ShapeError
            If P is not a real matrix of this shape.
        LieAlgebraError
            If the rows of P are linearly dependent.

        Examples
        --------
        >>> g = mf.heisenberg(1).change_of_basis([[1, 0, 0], [0, 1, 0], [0, 0, 2]])
        >>> print(g.bracket([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
        [0.  0.  0.5]
        """
        constants, inverse = constants_and_inverse_in_basis(self, P)
        rows = tuple(map(tuple, inverse.astype(np.float64).tolist()))
        basis = None if self.basis is None else np.tensordot(np.asarray(P, dtype=np.float64), self.basis, axes=(1, 0))
        algebra = LieAlgebra(constants, name=name or self.name, basis=basis, basis_names=basis_names)
        return algebra._with_unchecked_invariants(CasimirInBasis(F, rows) for F in self.invariants)

    # -- the operations -----------------------------------------------------------------------------------------

    def bracket(self, x, y) -> jax.Array:
        """Return the Lie bracket ``[x, y]``; ``x``, ``y`` and the result have shape (..., dim)."""
        return jnp.einsum(
            "abc,...a,...b->...c", real_array(self.structure_constants), self._element(x, "x"), self._element(y, "y")
        )

    def ad(self, x) -> jax.Array:
        """Return the matrix of ``y -> [x, y]``, shape (..., dim, dim): ``ad(x) @ y == bracket(x, y)``."""
        return jnp.einsum("abc,...a->...cb", real_array(self.structure_constants), self._element(x, "x"))

    def ad_star(self, x, mu) -> jax.Array:
        """Return the coadjoint operator ``ad*_x mu``, defined by ``<ad*_x mu, y> = <mu, [x, y]>`` [BFM, after 3.1].

        The last axes of ``x`` (1 / time for a body), ``mu`` (mass * length**2 / time) and the result have length dim;
        ShapeError if they have not.
        """
        return jnp.einsum(
            "abc,...a,...c->...b", real_array(self.structure_constants), self._element(x, "x"), self._element(mu, "mu")
        )

    def poisson_tensor(self, mu) -> jax.Array:
        """Return the matrix ``Pi(mu)[b, a] = sum_c C[a, b, c] mu_c``, shape (dim, dim), at one mu, shape (dim,)."""
        return jnp.einsum("abc,c->ba", self.structure_constants, mu)

    def action(self, x) -> Action:
        """Return the maps ``y -> [x, y]`` and ``mu -> ad*_x mu`` of one x, shape (dim,)."""
        return AdMatrixAction(self.ad(x))

    def killing_form(self) -> np.ndarray:
        """Return the Killing form ``kappa[a, b] = tr(ad_a ad_b)``, shape (dim, dim)."""
        return self._killing_form

    def killing_signature(self) -> tuple[int, int, int]:
        """Return the numbers of positive, negative and zero eigenvalues of the Killing form, in any basis."""
        eigenvalues = np.linalg.eigvalsh(killing_form_of(self._balanced_constants_and_factors[0]))
        positive, negative = (int((sign * eigenvalues > STRUCTURE_TOLERANCE).sum()) for sign in (1, -1))
        return positive, negative, self.dim - positive - negative

    def hat(self, x) -> jax.Array:
        """Return the matrix ``sum_a x_a e_a``, shape (..., m, m)."""
        return jnp.einsum("...a,aij->...ij", self._element(x, "x"), self._require_basis())

    def vee(self, X) -> jax.Array:
        """Return the components of a matrix of the algebra, shape (..., dim): the inverse of :meth:`hat`.

        LieAlgebraError if ``X`` is not in the span of the basis (residual above 1e-8 relative), except under tracing.
        """
        basis = self._require_basis()
        matrix = square_matrices(X, basis.shape[-1], "X")
        entries = matrix.reshape(*matrix.shape[:-2], -1)
        entries = jnp.concatenate([entries.real, entries.imag], axis=-1)
        components = jnp.einsum("ai,...i->...a", self._basis_left_inverse, entries)
        if not is_traced(entries):
            residual = float(jnp.max(jnp.abs(components @ real_columns(basis).T - entries), initial=0.0))
            tolerance = 1e-8 * max(float(np.abs(basis).max()), float(jnp.max(jnp.abs(entries), initial=0.0)))
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
        """Return True if every bracket vanishes."""
        return not self.structure_constants.any()

    def is_semisimple(self) -> bool:
        """Return True if the Killing form is nondegenerate (Cartan's criterion)."""
        return self.killing_signature()[2] == 0

    def is_compact_type(self) -> bool:
        """Return True if the Killing form is negative definite: the algebra of a compact semisimple group."""
        return self.killing_signature() == (0, self.dim, 0)

    def is_solvable(self) -> bool:
        """Return True if the derived series ends at zero."""
        return self.derived_series()[-1] == 0

    def is_nilpotent(self) -> bool:
        """Return True if the lower central series ends at zero."""
        return self.lower_central_series()[-1] == 0

    def is_unimodular(self) -> bool:
        """Return True if ``tr ad_x = 0`` for every x."""
        traces = np.einsum("abb->a", self._balanced_constants_and_factors[0])
        return bool(np.abs(traces).max() <= STRUCTURE_TOLERANCE)

    def derived_series(self) -> list[int]:
        """Return the dimensions of g, [g, g], [[g, g], [g, g]], … until they no longer fall."""
        return self._ideal_series_dims(lambda ideal: (ideal, ideal))

    def lower_central_series(self) -> list[int]:
        """Return the dimensions of g, [g, g], [g, [g, g]], … until they no longer fall."""
        return self._ideal_series_dims(lambda ideal: (np.eye(self.dim), ideal))

    def cartan_involution(self) -> np.ndarray:
        """Return a Cartan involution theta, shape (dim, dim), for which ``-kappa(x, theta y)`` is positive definite.

        It is the identity on compact type. Otherwise it is computed without matrices: among all inner products of unit
        volume, the one that minimises the norm of the bracket satisfies ``ad_x^T = -ad_{theta x}`` [Lauret 2003]; the
        norm is convex along the geodesics of inner products, so Newton's method finds it. For ``sl``, ``so`` and ``sp``
        in their usual bases theta is ``X -> -X^T``.

        Raises
        ------
        LieAlgebraError
            If the algebra is not semisimple.
        """
        return self._cartan_involution

    def killing_inner_product(self) -> Operator:
        """Return the matrix of ``-kappa(x, theta y)``, theta a Cartan involution; ``-kappa`` if there is none.

        On a semisimple algebra it is positive definite. ``form @ x`` is the covector of x, shape (dim,).
        """
        if not self.is_semisimple():
            return -self.killing_form()
        form = -self.killing_form() @ self.cartan_involution()
        return (form + form.T) / 2

    def isomorphism_type(self):
        """Return the isomorphism type of the algebra over the reals: names of the list of Patera et al. (1976).

        The algebra may be the sum of any number of indecomposable ones of dimension up to 5. See
        :func:`manifolds.patera` for the names and :class:`manifolds.IsomorphismType` for the result. Parameters are
        those of one representative of each type. Where rounding leaves a choice, and above dimension 5, the result is
        unknown, with the reason.

        Examples
        --------
        >>> print(mf.direct_sum(mf.so(3), mf.abelian(2)).isomorphism_type())
        A3,9 + 2 A1
        >>> mf.bianchi("VI", h=-0.25).isomorphism_type().name
        'A3,5^a'
        """
        return self._isomorphism_type(self)

    _isomorphism_type: ClassVar[Callable]
    """Classification, set by :mod:`manifolds.algebras.isomorphism_type`, which is imported after this module."""

    # -- many copies ----------------------------------------------------------------------------------------------

    def __pow__(self, sites) -> LieAlgebra:
        return self._power(self, sites)

    _power: ClassVar[Callable[..., LieAlgebra]]
    """Constructor of copies, set by :mod:`manifolds.algebras.blocks`, which is imported after this module."""

    def _batched_bracket(self, x, y) -> jax.Array:
        """Return the bracket for large batches, shape (..., dim)."""
        return (
            self.bracket(x, y)
            if self._terms_to_unroll is None
            else unrolled_bracket(self._terms_to_unroll, x, y, self.dim)
        )

    def _batched_ad_star(self, x, mu) -> jax.Array:
        """Return the coadjoint operator for large batches, shape (..., dim)."""
        if self._terms_to_unroll is None:
            return self.ad_star(x, mu)
        return unrolled_bracket(tuple((a, c, b, value) for a, b, c, value in self._terms_to_unroll), x, mu, self.dim)

    @cached_property
    def _terms_to_unroll(self) -> tuple[tuple[int, int, int, float], ...] | None:
        return terms_to_unroll(self._constants)

    # -- Casimirs -----------------------------------------------------------------------------------------------

    def casimir_count(self) -> int:
        """Return the number of independent Casimir functions near a generic point of g*.

        This is dim minus the generic rank of the Lie-Poisson tensor; the Casimirs need not be polynomials.
        """
        return casimir_count(self)

    def casimirs(self, degree: int | None = None, *, max_degree: int | None = None) -> list:
        """Return homogeneous polynomial Casimirs, modulo products of Casimirs of lower degree.

        The list holds :class:`manifolds.Polynomial`, callable on ``mu`` and printing as ``mu1**2 + mu2**2 + mu3**2``;
        the coefficients are exact when the structure constants are rational. It holds
        :class:`manifolds.TracePolynomial` if there are too many monomials and the algebra is semisimple or reductive.

        Parameters
        ----------
        degree : int, optional
            The degree of all Casimirs that are returned.
        max_degree : int, optional
            Return the Casimirs of all degrees from 1 to this one instead, by default to 4. ParameterError if both are
            given, or one is not a positive integer.
        """
        if degree is not None and max_degree is not None:
            raise ParameterError("casimirs takes degree or max_degree, not both. Give one of them")
        if degree is not None:
            return self._casimirs_of_degree(degree)
        return casimirs_up_to(self, DEFAULT_MAX_DEGREE if max_degree is None else max_degree)

    def _casimirs_of_degree(self, degree: int) -> list:
        polynomials = casimirs(self, degree)
        return polynomials if self.basis_names is None else [F.with_names(*self.basis_names) for F in polynomials]

    def leading_casimirs(self) -> list[tuple[str, Callable]]:
        """Return pairs (name, Casimir) of low degree that are quick to find and to evaluate, to follow along a motion.

        The Casimirs are functions from mu, shape (dim,), to a number. A small algebra has its polynomial ones, as many
        as there are; copies on sites have the Casimirs of a few copies, or the sums over many; a large matrix algebra
        has the traces of the first powers.
        """
        return leading_casimirs(self)

    # -- Python ---------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"LieAlgebra({self.name!r}, dim={self.dim})"

    def _repr_html_(self) -> str:
        return algebra_html(self.name, self.dim, lambda: self.structure_constants, self.basis_names)

    def __eq__(self, other) -> bool:
        return isinstance(other, LieAlgebra) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self):
        basis = () if self.basis is None else (self.basis.shape, self.basis.tobytes())
        return self.dim, self.structure_constants.tobytes(), basis, self.invariants

    def _element(self, x, label: str) -> jax.Array:
        """Return the components of an element as an array, shape (..., dim), after a check of shape and type."""
        return real_components(x, self.dim, label)

    def _require_basis(self) -> np.ndarray:
        """Return the matrices of the basis; raise LieAlgebraError if the algebra has none."""
        if self.basis is None:
            raise LieAlgebraError(
                f"{self.name} was defined by structure constants and has no matrices. Build it with "
                "LieAlgebra.from_matrices to use hat and vee"
            )
        return self.basis

    @cached_property
    def _basis_left_inverse(self) -> np.ndarray:
        return np.linalg.pinv(real_columns(self._require_basis()))

    @cached_property
    def _killing_form(self) -> np.ndarray:
        return _read_only_copy(killing_form_of(self.structure_constants))

    @cached_property
    def _balanced_constants_and_factors(self) -> tuple[np.ndarray, np.ndarray]:
        """Constants in the basis scaled by factors, the largest of size 1, and the factors."""
        return balance_constants(self.structure_constants)

    @cached_property
    def _cartan_involution(self) -> np.ndarray:
        if not self.is_semisimple():
            raise LieAlgebraError(f"{self.name} is not semisimple, so it has no Cartan involution")
        if self.is_compact_type():
            return _read_only_copy(np.eye(self.dim))
        constants, factors = self._balanced_constants_and_factors
        theta = cartan_involution_of(constants, self.name) * factors[:, None] / factors
        rounded_theta = np.asarray(np.round(theta))
        return _read_only_copy(rounded_theta if np.abs(rounded_theta - theta).max() < 1e-10 else theta)

    def _ideal_series_dims(self, spans_to_bracket: Callable) -> list[int]:
        """Return the dimensions of a series of ideals until they no longer fall.

        ``spans_to_bracket`` maps rows that span an ideal to the two spans whose brackets span the next one.
        """
        ideal, dims = np.eye(self.dim), [self.dim]
        while True:
            left_factor, right_factor = spans_to_bracket(ideal)
            products = np.einsum(
                "ia,jb,abc->ijc", left_factor, right_factor, self._balanced_constants_and_factors[0], optimize=True
            )
            ideal = row_space_basis(products.reshape(-1, self.dim))
            if len(ideal) == dims[-1]:
                return dims
            dims.append(len(ideal))
            if not len(ideal):
                return dims


def _read_only_copy(array: np.ndarray) -> np.ndarray:
    array = np.array(array)
    array.setflags(write=False)
    return array


def trilinear_form(algebra: LieAlgebra, form=None) -> np.ndarray:
    """Return the covariant tensor ``c(x, y, z) = form(x, [y, z])`` of an inner product [BFM Remark 3.3].

    Parameters
    ----------
    algebra : LieAlgebra
        The Lie algebra.
    form : array, shape (dim, dim), optional
        By default the Killing form, for which the tensor is totally skew.

    Returns
    -------
    ndarray, shape (dim, dim, dim)
        ``c[a, b, d] = form(e_a, [e_b, e_d])``.
    """
    if not isinstance(algebra, LieAlgebra):
        raise LieAlgebraError(f"algebra must be a manifolds.LieAlgebra, such as mf.so(3), got {algebra!r}")
    form = np.asarray(real_components(algebra.killing_form() if form is None else form, algebra.dim, "the form"))
    if form.shape != (algebra.dim, algebra.dim):
        raise ShapeError(f"the form on {algebra.name} must have shape ({algebra.dim}, {algebra.dim}), got {form.shape}")
    if not np.isfinite(form).all():
        raise ComponentError(f"the form on {algebra.name} must be finite, got {form.tolist()}")
    return np.einsum("ae,bde->abd", form, np.asarray(algebra.structure_constants))
