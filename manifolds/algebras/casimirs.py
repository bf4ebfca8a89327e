"""Casimirs: the number of independent ones of an algebra, and the polynomials among them.

A Casimir is a function F on g* with ``ad*_{grad F(mu)} mu = 0`` for every mu. It is enough that F Poisson-commutes
with elements that generate the algebra, by the Jacobi identity; on the coefficients of a homogeneous polynomial each
of these conditions is linear. Where the structure constants are rational, perhaps after a scaling of the basis, the
polynomials found are exact and proved to be complete.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import LieAlgebraError, ParameterError, warn
from .invariants import TracePolynomial, fundamental_invariants
from .polynomial import Formula, Polynomial
from .polynomial_casimirs import TooLargeError, casimir_count, new_casimirs
from .structure import AlgebraStructure

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
        by the number and the degrees of the generators (see :mod:`manifolds.algebras.invariants`).

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
    if isinstance(degree, bool) or not isinstance(degree, int | np.integer) or degree < 1:
        raise ParameterError(f"the degree of a Casimir must be an integer >= 1, not {degree!r}")
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
            "they may be rational or transcendental (for bianchi('V') it is mu2/mu3): raise the degree, or solve "
            "ad*_(grad C) mu = 0 by hand and use the solution as a function of mu",
            NoPolynomialCasimirWarning,
        )
    return casimir_list


def casimirs_up_to(g: AlgebraStructure, max_degree: int) -> list:
    """Return the polynomial Casimirs of degrees 1 to ``max_degree``; the warning of :func:`casimirs` comes once."""
    if isinstance(max_degree, bool) or not isinstance(max_degree, int | np.integer) or max_degree < 1:
        raise ParameterError(f"max_degree must be an integer >= 1, not {max_degree!r}")
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
    return named_casimirs + _independent_invariants(g, [F for _, F in named_casimirs], count)


def _independent_invariants(g: AlgebraStructure, polynomials: list, count: int) -> list[tuple[str, Callable]]:
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
                f"{function} is no Casimir of {g.name}: at mu = {np.round(mu, 3).tolist()}, ad* mu of its gradient has "
                f"the size {residual:.3g}, not 0 (tolerance {INVARIANT_TOLERANCE * scale:.1g}); check the signs, and "
                "that it is finite there",
                residual=residual,
                tolerance=INVARIANT_TOLERANCE * scale,
            )
