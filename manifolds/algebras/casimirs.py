"""Invariants and Casimirs of an algebra: the number of independent ones, and the polynomials among them.

A Casimir is a function F on g* with ``ad*_{grad F(mu)} mu = 0`` for every mu. It is enough that F Poisson-commutes
with elements that generate the algebra, by the Jacobi identity; on the coefficients of a homogeneous polynomial each
of these conditions is linear. Where the structure constants are rational, perhaps after a scaling of the basis, the
polynomials found are exact and proved to be complete.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_names, is_integer
from .._arrays import real_components
from ..errors import LieAlgebraError, ParameterError, ShapeError, warn
from ._subspaces import numerical_null_space
from .polynomial import Formula, Polynomial
from .polynomial_casimirs import TooLargeError, casimir_count, new_casimirs
from .structure import AlgebraStructure

MAX_COMMUTANT_SIZE = 40
"""Largest size of matrices whose commutant is computed."""

MAX_PFAFFIAN_PRODUCTS = 20000
"""Largest number of products in a Pfaffian that is expanded."""

MAX_EXPANSION_MONOMIALS = 200_000
"""Largest number of monomials in a trace that is expanded."""

MIN_INDEPENDENCE_SINE = 1e-6
"""Smallest sine of the angle between a gradient and the span of others for which it counts as independent."""


@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False, eq=False)
class TracePolynomial:
    """Homogeneous polynomial ``tr(W X(mu)**degree)``, ``X(mu) = sum_a mu_a X_a``, evaluated by powers of matrices.

    It represents a Casimir with too many monomials to expand. Like a :class:`Polynomial` it is immutable, hashable, a
    static leaf of a pytree, and callable on batches; JAX differentiates it (``jax.grad``). One value costs a few
    products of matrices.

    Parameters
    ----------
    matrices : array of float, shape (dim, m, m)
        The X_a.
    degree : int
        Degree of the polynomial.
    weight : array of float, shape (m, m), optional
        W, the identity by default.
    label : str
        Text of ``str``.

    Attributes
    ----------
    dim, degree : int
    matrices, weight : ndarray, read-only
    """

    matrices: np.ndarray
    degree: int
    weight: np.ndarray
    label: str
    names: tuple[str, ...] | None

    def __init__(self, matrices, degree: int, weight=None, label: str | None = None):
        X = np.array(matrices, dtype=np.float64)
        if X.ndim != 3 or X.shape[1] != X.shape[2]:
            raise ShapeError(f"the matrices of a trace must have shape (dim, m, m), got {X.shape}")
        W = np.eye(X.shape[1]) if weight is None else np.array(weight, dtype=np.float64)
        if W.shape != X.shape[1:]:
            raise ShapeError(f"the weight of a trace must have shape {X.shape[1:]}, got {W.shape}")
        X.setflags(write=False)
        W.setflags(write=False)
        label = label or f"tr(X**{degree})"
        attributes = {"matrices": X, "degree": int(degree), "weight": W, "label": label, "names": None}
        for name, value in attributes.items():
            object.__setattr__(self, name, value)

    @property
    def dim(self) -> int:
        """Number of components of mu."""
        return self.matrices.shape[0]

    def with_names(self, *names: str) -> TracePolynomial:
        """Return an equal trace whose expansion (:meth:`expanded`) prints with these names."""
        trace = TracePolynomial(self.matrices, self.degree, self.weight, self.label)
        object.__setattr__(trace, "names", checked_names(names, self.dim))
        return trace

    def __call__(self, mu) -> jax.Array:
        """Return the value at ``mu``, shape (..., dim) -> (...)."""
        X = jnp.einsum("...a,aij->...ij", real_components(mu, self.dim, "mu"), self.matrices)
        half = _matrix_power(X, self.degree // 2)
        remaining_power = half @ X if self.degree % 2 else half
        return jnp.einsum("...ij,...ji->...", self.weight @ half, remaining_power)

    def expanded(self) -> Polynomial:
        """Expand the trace into a :class:`Polynomial` with float coefficients; coefficients that are rounding are left
        out.

        Raises
        ------
        LieAlgebraError
            If there are more than 200,000 monomials of this degree.
        """
        n_monomials = math.comb(self.dim + self.degree - 1, self.degree)
        if n_monomials > MAX_EXPANSION_MONOMIALS:
            raise LieAlgebraError(
                f"{self} has up to {n_monomials} monomials, more than the {MAX_EXPANSION_MONOMIALS} that are written "
                "out"
            )
        coefficients, m = self.weight[None], self.weight.shape[0]
        factors = np.zeros((1, 0), dtype=np.int64)
        for _ in range(self.degree):  # the matrix W X**k: a coefficient for each monomial, given by its sorted factors
            products = np.einsum("nij,ajk->naik", coefficients, self.matrices, optimize=True).reshape(-1, m, m)
            new_factors = np.tile(np.arange(self.dim), len(factors))[:, None]
            extended_factors = np.hstack([np.repeat(factors, self.dim, axis=0), new_factors])
            factors, row = np.unique(np.sort(extended_factors, axis=1), axis=0, return_inverse=True)
            coefficients = np.zeros((len(factors), m, m))
            np.add.at(coefficients, row.ravel(), products)
        values = np.einsum("nii->n", coefficients)
        is_nonzero = np.abs(values) > 1e-13 * np.abs(values).max()
        exponents = (factors[is_nonzero][:, :, None] == np.arange(self.dim)).sum(axis=1)
        polynomial = Polynomial(exponents, values[is_nonzero].tolist())
        return polynomial if self.names is None else polynomial.with_names(*self.names)

    def _gradient(self, mu: np.ndarray) -> np.ndarray:
        """Return the gradient at mu, shape (dim,), if W commutes with X; zero where it is rounding."""
        X = np.einsum("a,aij->ij", mu, self.matrices)
        product = self.weight @ np.linalg.matrix_power(X, self.degree - 1)
        scale = np.linalg.norm(self.weight) * np.linalg.norm(X) ** (self.degree - 1) * np.linalg.norm(self.matrices)
        gradient = np.einsum("ij,aji->a", product, self.matrices)
        return self.degree * np.where(np.linalg.norm(gradient) > 1e-12 * scale, gradient, 0.0)

    @cached_property
    def _key(self):
        return self.matrices.shape, self.matrices.tobytes(), self.degree, self.weight.tobytes()

    def __eq__(self, other) -> bool:
        return isinstance(other, TracePolynomial) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __str__(self) -> str:
        return self.label

    def __repr__(self) -> str:
        return f"<TracePolynomial {self.label}, X of shape {self.matrices.shape[1:]}>"


def _matrix_power(X, exponent: int):
    """Return ``X**exponent`` by squaring, exponent >= 0."""
    result = None
    while exponent:
        if exponent % 2:
            result = X if result is None else result @ X
        exponent //= 2
        if exponent:
            X = X @ X
    return jnp.broadcast_to(jnp.eye(X.shape[-1]), X.shape) if result is None else result


# -- complete sets ------------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def fundamental_invariants(g: AlgebraStructure) -> tuple[TracePolynomial | Polynomial, ...] | None:
    """Return Casimirs that generate all polynomial ones, by increasing degree; None if no such set is found."""
    families: list[_EquivariantFamily] = []
    for family in _equivariant_families(g):
        families.append(family)
        generators = _complete_invariants(g, families)
        if generators is not None:
            return generators
    return None


def _complete_invariants(
    g: AlgebraStructure, families: list[_EquivariantFamily]
) -> tuple[TracePolynomial | Polynomial, ...] | None:
    """Return independent invariants of the families, if they are complete by number and degrees; else None."""
    count = casimir_count(g)
    degree_sum = (g.dim + count) // 2
    points = np.random.default_rng(0).standard_normal((3, g.dim))
    generators: list[TracePolynomial | Polynomial] = []
    spans = [np.zeros((0, g.dim)) for _ in points]
    for degree in range(1, degree_sum + 1):
        for F in (F for family in families for F in family.invariants(degree)):
            gradients = [_gradient_at(F, mu) for mu in points]
            if not all(_is_invariant(g, row, mu) for row, mu in zip(gradients, points, strict=True)):
                return None  # an algebra whose constants are too inaccurate
            extended_spans = [_extend_span(span, row) for span, row in zip(spans, gradients, strict=True)]
            if all(len(new) > len(old) for new, old in zip(extended_spans, spans, strict=True)):
                spans = extended_spans
                generators.append(F)
        if len(generators) >= count:
            break
    is_complete = len(generators) == count and sum(F.degree for F in generators) == degree_sum
    return tuple(generators) if is_complete else None


def _gradient_at(F: TracePolynomial | Polynomial, mu: np.ndarray) -> np.ndarray:
    """Return the gradient of an invariant at mu, shape (dim,)."""
    return F._gradient(mu) if isinstance(F, TracePolynomial) else np.asarray(jax.grad(F)(mu))


def _is_invariant(g: AlgebraStructure, gradient: np.ndarray, mu: np.ndarray) -> bool:
    """Return True if ``ad*_gradient mu`` vanishes to rounding, as for the gradient of a Casimir at mu."""
    motion = np.einsum("abc,a,c->b", g.structure_constants, gradient, mu)
    scale = np.abs(g.structure_constants).max() * np.linalg.norm(gradient) * np.linalg.norm(mu)
    return bool(np.linalg.norm(motion) <= 1e-10 * scale)


def _extend_span(span: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Append the direction of ``row`` orthogonal to the orthonormal rows of ``span``, unless it is negligible."""
    remainder = row - span.T @ (span @ row)
    remainder -= span.T @ (span @ remainder)
    norm = np.linalg.norm(remainder)
    return np.vstack([span, remainder / norm]) if norm > MIN_INDEPENDENCE_SINE * np.linalg.norm(row) else span


class _EquivariantFamily(NamedTuple):
    """Equivariant matrices X_a, the matrices that commute with all of them, and the Pfaffian or None."""

    name: str
    matrices: np.ndarray
    weights: list[np.ndarray]
    pfaffian: Polynomial | None = None

    def invariants(self, degree: int) -> Iterator[TracePolynomial | Polynomial]:
        power = self.name if degree == 1 else f"{self.name}**{degree}"
        for i, W in enumerate(self.weights):
            yield TracePolynomial(self.matrices, degree, W, f"tr(W{i} {power})" if i else f"tr({power})")
        if self.pfaffian is not None and self.pfaffian.degree == degree:
            yield self.pfaffian


def _equivariant_families(g: AlgebraStructure) -> Iterator[_EquivariantFamily]:
    """Yield equivariant families of matrices by increasing cost.

    They are the matrices of the algebra, the adjoint matrices, and the second derivatives of cubic Casimirs.
    """
    if g.basis is not None:
        basis = _real_matrices(g.basis)
        X = _dual_matrices(basis)
        if X is not None:
            yield _EquivariantFamily("X", X, _commutant(X, g.name), _pfaffian(basis, X, g.name))
    if not g.is_semisimple():
        return
    ad = g.structure_constants.swapaxes(1, 2)
    X = np.einsum("ab,bij->aij", np.linalg.inv(g.killing_form()), ad)
    yield _EquivariantFamily("ad(X)", X, _commutant(X, g.name))
    for i, cubic in enumerate(_cubic_casimirs(g)):
        D = _third_derivatives(cubic) @ g.killing_form()  # from g to g* to g
        yield _EquivariantFamily(f"D{i + 1}", D, [np.eye(g.dim)])


def _cubic_casimirs(g: AlgebraStructure) -> list[Polynomial]:
    """Return the Casimirs of degree 3; none if they are too costly or unclear."""
    try:
        return list(new_casimirs(g, 3))
    except LieAlgebraError:  # too many monomials, or no clear rank
        return []


def _third_derivatives(cubic: Polynomial) -> np.ndarray:
    """Return the third derivatives of a cubic polynomial, shape (dim, dim, dim)."""
    derivatives = np.zeros((cubic.dim,) * 3)
    for power, coefficient in cubic.terms:
        value = float(coefficient) * math.prod(math.factorial(e) for e in power)
        for index in set(permutations(np.repeat(np.arange(cubic.dim), power).tolist())):
            derivatives[index] = value
    return derivatives


def _real_matrices(basis: np.ndarray) -> np.ndarray:
    """Return complex matrices of size m as real matrices of size 2m."""
    if not np.iscomplexobj(basis):
        return np.asarray(basis)
    return np.block([[basis.real, -basis.imag], [basis.imag, basis.real]])


def _dual_matrices(basis: np.ndarray) -> np.ndarray | None:
    """Return the matrices X_a of ``X(mu)``, dual by the form ``tr(xy)``; None if the form is degenerate.

    Only a reductive algebra has a nondegenerate trace form.
    """
    form = np.einsum("aij,bji->ab", basis, basis)
    norms = np.linalg.norm(basis, axis=(1, 2))
    if np.abs(np.linalg.eigvalsh(form / np.outer(norms, norms))).min() < 1e-8:
        return None
    return np.linalg.solve(form, basis.reshape(len(basis), -1)).reshape(basis.shape)


def _commutant(X: np.ndarray, name: str) -> list[np.ndarray]:
    """Return a basis of the matrices that commute with all of X, the identity first."""
    m = X.shape[1]
    identity = np.eye(m)
    if m > MAX_COMMUTANT_SIZE:
        return [identity]
    random = np.random.default_rng(1).standard_normal((2, len(X)))  # two elements generate a semisimple algebra
    generic = np.einsum("ra,aij->rij", random / np.abs(X).max(), X)
    conditions = np.concatenate([np.kron(identity, x.T) - np.kron(x, identity) for x in generic])
    commuting_matrices = numerical_null_space(conditions, name).reshape(-1, m, m)
    return [identity, *commuting_matrices[1:]]


def _pfaffian(basis: np.ndarray, X: np.ndarray, name: str) -> Polynomial | None:
    """Return the Pfaffian of ``J X(mu)`` if the matrices preserve just one form J, up to a factor, a symmetric one."""
    m = X.shape[1]
    if m % 2 or m > MAX_COMMUTANT_SIZE:
        return None
    random = np.random.default_rng(2).standard_normal((2, len(basis)))
    generic = np.einsum("ra,aij->rij", random / np.abs(basis).max(), basis)
    conditions = np.concatenate([np.kron(x.T, np.eye(m)) + np.kron(np.eye(m), x.T) for x in generic])
    forms = numerical_null_space(conditions, name).reshape(-1, m, m)
    if len(forms) != 1 or not np.allclose(forms[0], forms[0].T, rtol=0.0, atol=1e-9):
        return None
    skew = np.einsum("ij,ajk->iak", forms[0], X)
    skew = (skew - skew.transpose(2, 1, 0)) / 2
    skew /= np.abs(skew).max()
    skew[np.abs(skew) < 1e-12] = 0.0
    integer_skew = np.rint(skew)
    skew = integer_skew if np.abs(skew - integer_skew).max() < 1e-12 else skew
    terms = max(int((skew[i, :, j] != 0).sum()) for i in range(m) for j in range(i))
    if terms ** (m // 2) * math.prod(range(m - 1, 0, -2)) > MAX_PFAFFIAN_PRODUCTS:
        return None
    number, units = int if skew is integer_skew else float, np.eye(len(X), dtype=np.int64)
    entries = {(i, j): Polynomial(units, [number(c) for c in skew[i, :, j]]) for i in range(m) for j in range(i + 1, m)}
    pfaffian = _expand_pfaffian(entries, tuple(range(m)))
    return -pfaffian if pfaffian.coefficients[0] < 0 else pfaffian


def _expand_pfaffian(entries: dict, rows: tuple[int, ...]) -> Polynomial:
    """Expand a Pfaffian along its first row; ``entries`` are the entries above the diagonal."""
    row, *columns = rows
    if len(rows) == 2:
        return entries[row, columns[0]]
    total = None
    for k, j in enumerate(columns):
        minor = _expand_pfaffian(entries, tuple(r for r in columns if r != j))
        term = entries[row, j] * minor * (-1) ** k
        total = term if total is None else total + term
    assert total is not None
    return total


MAX_LEADING_MONOMIALS = 400
"""Largest number of monomials of a degree in which leading Casimirs are searched for (a second's work)."""

DEFAULT_MAX_DEGREE = 4
"""Largest degree of the Casimirs that ``casimirs()`` returns without arguments: a second's work up to dimension 10."""


class NoPolynomialCasimirWarning(UserWarning):
    """Issued when an algebra has Casimirs but no polynomial one was found."""


def casimirs(g: AlgebraStructure, degree: int) -> list[Polynomial | TracePolynomial]:
    """Return all homogeneous polynomial Casimirs of this degree, modulo products of Casimirs of lower degree.

    The lists of degrees 1, 2, … together generate the ring of polynomial Casimirs. Each is a reduced row echelon
    basis in the lexicographic order of monomials, less the elements whose leading monomial is that of a combination
    of products.

    Parameters
    ----------
    g : AlgebraStructure
    degree : int
        At least 1.

    Returns
    -------
    list of Polynomial or TracePolynomial
        Coprime integer coefficients with a positive leading one, exact, where the structure constants are rational;
        otherwise floats with leading coefficient 1, correct to the last digit where a scaling of the basis makes the
        constants rational (su(n)). Where there are more than 20000 monomials of this degree, or more than 2000 coupled
        ones, and the algebra is semisimple or reductive: traces of powers of matrices, and Pfaffians, proved to be all
        by the number and the degrees of the generators.

    Raises
    ------
    ParameterError
        If the degree is not a positive integer.
    LieAlgebraError
        If there are too many monomials and no set of traces is complete; or if the constants
        cannot be made rational and the singular values show no clear gap.

    Warns
    -----
    NoPolynomialCasimirWarning
        If the algebra has Casimirs but no polynomial one of this degree or below. A semisimple algebra gives no
        warning: its Casimirs are polynomials, of degree 2 and more [Chevalley].
    """
    if not is_integer(degree) or degree < 1:
        raise ParameterError(f"the degree of a Casimir must be an integer >= 1, got {degree!r}")
    casimir_list: list[Polynomial | TracePolynomial]
    try:
        casimir_list = list(new_casimirs(g, int(degree)))
    except TooLargeError:
        generators = fundamental_invariants(g)
        if generators is None:
            raise
        casimir_list = [F for F in generators if F.degree == degree]
    n_casimirs = 0 if casimir_list or g.is_semisimple() else casimir_count(g)
    if n_casimirs and not any(new_casimirs(g, d) for d in range(1, int(degree) + 1)):
        warn(
            f"{g.name} has {n_casimirs} independent Casimir{'s' if n_casimirs > 1 else ''}, but no polynomial one "
            f"{'of degree 1' if degree == 1 else f'up to degree {degree}'}. There may be one of higher degree, or "
            "they may be rational or transcendental (for bianchi('V') it is mu2/mu3). Raise the degree, or solve "
            "ad*_(grad C) mu = 0 by hand and use the solution as a function of mu",
            NoPolynomialCasimirWarning,
        )
    return casimir_list


def casimirs_up_to(g: AlgebraStructure, max_degree: int) -> list:
    """Return the polynomial Casimirs of degrees 1 to ``max_degree``; the warning of :func:`casimirs` comes once."""
    if not is_integer(max_degree) or max_degree < 1:
        raise ParameterError(f"max_degree must be an integer >= 1, got {max_degree!r}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoPolynomialCasimirWarning)
        lower_casimirs = [F for degree in range(1, int(max_degree)) for F in g.casimirs(degree)]
    return lower_casimirs + g.casimirs(int(max_degree))


def leading_casimirs(g: AlgebraStructure) -> list[tuple[str, Callable]]:
    """Return pairs (name, Casimir) of polynomial Casimirs of low degree; see :meth:`LieAlgebra.leading_casimirs`."""
    named_casimirs: list[tuple[str, Callable]] = []
    count = g.casimir_count()
    for degree in range(1, g.dim + 1):
        if len(named_casimirs) >= count or math.comb(g.dim + degree - 1, degree) > MAX_LEADING_MONOMIALS:
            break
        with warnings.catch_warnings():  # an algebra without polynomial Casimirs has none to follow
            warnings.simplefilter("ignore", NoPolynomialCasimirWarning)
            polynomials = g.casimirs(degree)
        for i, casimir in enumerate(polynomials):
            text = str(casimir)
            named_casimirs.append((text if len(text) <= 60 else f"Casimir {i + 1} of degree {degree}", casimir))
    return named_casimirs + _invariants_independent_of(g, [F for _, F in named_casimirs], count)


def _invariants_independent_of(g: AlgebraStructure, polynomials: list, count: int) -> list[tuple[str, Callable]]:
    """Return the invariants given with the algebra that are independent of the polynomials at a random point."""
    functions, named_invariants = list(polynomials), list[tuple[str, Callable]]()
    mu = np.random.default_rng(0).standard_normal(g.dim)
    for i, invariant in enumerate(g.invariants):
        if len(functions) >= count:
            break
        with jax.ensure_compile_time_eval():
            gradients = np.array([jax.grad(F)(jnp.asarray(mu)) for F in (*functions, invariant)])
        gradients /= np.linalg.norm(gradients, axis=1, keepdims=True)
        if np.linalg.matrix_rank(gradients, tol=1e-9) > len(functions):
            functions.append(invariant)
            text = str(invariant)
            label = text if isinstance(invariant, Formula) and len(text) <= 60 else f"invariant {i + 1}"
            named_invariants.append((label, invariant))
    return named_invariants


INVARIANT_TOLERANCE = 1e-9
"""Largest relative size of ``ad* mu`` of the gradient of a function that counts as a Casimir: rounding of powers."""


def check_invariant(g: AlgebraStructure, function: Callable) -> None:
    """Raise LieAlgebraError if ``ad*_{grad F(mu)} mu`` does not vanish at random points."""
    for mu in np.random.default_rng(1).standard_normal((4, g.dim)):
        gradient = np.asarray(jax.grad(function)(jnp.asarray(mu)))
        scale = np.linalg.norm(gradient) * np.linalg.norm(mu) * max(1.0, float(np.abs(g.structure_constants).max()))
        residual = float(np.linalg.norm(np.asarray(g.ad_star(gradient, mu))))
        if not residual <= INVARIANT_TOLERANCE * scale:
            raise LieAlgebraError(
                f"{function} is not a Casimir of {g.name}: at mu = {np.round(mu, 3).tolist()}, ad* mu of its gradient "
                f"has the size {residual:.3g}, not 0 (tolerance {INVARIANT_TOLERANCE * scale:.1g}). Check the signs, "
                "and that it is finite there",
                residual=residual,
                tolerance=INVARIANT_TOLERANCE * scale,
            )
