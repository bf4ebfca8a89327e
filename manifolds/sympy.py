"""Exact conversion of polynomials, Casimirs and Lie algebras to and from SymPy, an optional package.

``mf.sympy.expression(casimir)``, ``mf.sympy.polynomial(expression, symbols)``, ``mf.sympy.structure_constants(g)`` and
``mf.sympy.algebra(constants)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import sympy

from ._arguments import component_names, module_dir_function
from .algebras.lie_algebra import LieAlgebra
from .algebras.polynomial import Formula, Polynomial
from .errors import ComponentError, ShapeError

__all__ = ["algebra", "expression", "polynomial", "structure_constants", "symbols"]
__dir__ = module_dir_function(__all__)


def symbols(dim: int, names: Sequence[str] | None = None) -> tuple[sympy.Symbol, ...]:
    """Return real symbols for the components of ``mu``, by default ``mu1``, ``mu2``, …"""
    return tuple(
        sympy.Symbol(name, real=True) for name in component_names(None if names is None else tuple(names), dim)
    )


def expression(polynomial: Polynomial | Formula, variables: Sequence[sympy.Symbol] | None = None) -> sympy.Expr:
    """Return a polynomial or a formula as a SymPy expression; fractions stay exact.

    Parameters
    ----------
    polynomial : Polynomial or Formula
        A Casimir, for example; expand a ``TracePolynomial`` by its ``expanded()`` first.
    variables : sequence of dim symbols, optional
        By default the symbols of :func:`symbols`, with the names of the polynomial.

    Raises
    ------
    ShapeError
        If there are not ``dim`` symbols.
    """
    generators = symbols(polynomial.dim, polynomial.names) if variables is None else tuple(variables)
    if len(generators) != polynomial.dim:
        raise ShapeError(f"a polynomial in {polynomial.dim} variables needs as many symbols, got {len(generators)}")
    if isinstance(polynomial, Formula):
        meanings = dict(zip(polynomial.names, generators, strict=True)) | {"abs": sympy.Abs}
        return sympy.sympify(polynomial.text, locals=meanings)
    return sympy.Add(
        *(
            _to_sympy_number(coefficient) * sympy.Mul(*(x**e for x, e in zip(generators, power, strict=True)))
            for power, coefficient in polynomial.terms
        )
    )


def polynomial(expression: Any, variables: Sequence[sympy.Symbol]) -> Polynomial:
    """Return a SymPy expression as a polynomial in the given symbols, whose names it prints with.

    Raises
    ------
    ComponentError
        If the expression is not a polynomial in the symbols with real coefficients.
    """
    terms: dict[tuple[int, ...], Any] = {}
    for term in sympy.Add.make_args(sympy.expand(sympy.sympify(expression))):
        number, monomial = term.as_independent(*variables, as_Add=False)  # keeps the type of the number
        powers_of = monomial.as_powers_dict()
        if not set(powers_of) <= {*variables, sympy.S.One} or not all(
            e.is_Integer and e >= 0 for e in powers_of.values()
        ):
            raise ComponentError(f"{expression} is not a polynomial in {', '.join(map(str, variables))}. See {term}")
        power = tuple(int(powers_of.get(x, 0)) for x in variables)
        terms[power] = terms.get(power, 0) + number
    powers = np.array(list(terms), dtype=np.int64).reshape(-1, len(variables))
    result = Polynomial(powers, [_from_sympy_number(value) for value in terms.values()])
    return result.with_names(*map(str, variables))


def structure_constants(g: LieAlgebra) -> sympy.ImmutableDenseNDimArray:
    """Return ``C[a, b, c]`` of an algebra: rationals where they are known exactly, else floats."""
    exact = g.rational_constants
    if exact is None:
        entries = [sympy.Float(float(value), 17) for value in g.structure_constants.ravel()]
    else:
        entries = [sympy.Rational(int(n), int(exact.denominator)) for n in np.asarray(exact.numerator).ravel()]
    return sympy.ImmutableDenseNDimArray(entries, g.structure_constants.shape)


def algebra(constants: Any, name: str = "g", basis_names: Sequence[str] | None = None) -> LieAlgebra:
    """Return the Lie algebra of SymPy structure constants, shape (dim, dim, dim); rationals stay exact.

    Raises
    ------
    ComponentError
        If an entry is not a real number.
    LieAlgebraError
        If an axiom fails: see :meth:`LieAlgebra.from_structure_constants`.
    """
    entries = sympy.ImmutableDenseNDimArray(constants)
    if len(entries.shape) != 3:
        raise ShapeError(f"structure constants must have three indices, got {len(entries.shape)}")
    coefficients = [_from_sympy_number(entries[i]) for i in np.ndindex(*entries.shape)]
    table = np.empty(len(coefficients), dtype=object)
    table[:] = coefficients
    return LieAlgebra.from_structure_constants(table.reshape(entries.shape), name, basis_names)


def _to_sympy_number(value: Fraction | float) -> sympy.Expr:
    """Return a fraction as a SymPy rational, a float as a SymPy float of 17 digits."""
    if isinstance(value, Fraction):
        return sympy.Rational(value.numerator, value.denominator)
    return sympy.Float(value, 17)


def _from_sympy_number(value: Any) -> Fraction | float:
    """Return a real SymPy number as a Fraction or a float; raise ComponentError if it is none."""
    if value.is_Rational:
        return Fraction(int(value.p), int(value.q))
    if value.is_number and value.is_real:
        return float(value)
    raise ComponentError(f"{value} is not a real number; substitute numbers for the parameters first")
