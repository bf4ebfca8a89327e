"""Exact conversion to SymPy and back."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sympy

import manifolds as mf


@pytest.mark.parametrize("g", [mf.so(3), mf.se(3), mf.heisenberg(1), mf.sl(2)], ids=lambda g: g.name)
def test_casimirs_and_constants_return_unchanged(g):
    for casimir in g.casimirs(1 if g.name.startswith("heisenberg") else 2):
        expression = mf.sympy.expression(casimir)
        assert mf.sympy.polynomial(expression, mf.sympy.symbols(g.dim)) == casimir
    returned_algebra = mf.sympy.algebra(mf.sympy.structure_constants(g), name=g.name)
    assert np.array_equal(returned_algebra.structure_constants, g.structure_constants)
    assert returned_algebra.rational_constants is not None


def test_sympy_proves_that_a_casimir_is_one():
    g = mf.se(3)
    mu, C = mf.sympy.symbols(g.dim), mf.sympy.structure_constants(g)
    for casimir in map(mf.sympy.expression, g.casimirs(2)):
        dC = [sympy.diff(casimir, x) for x in mu]
        for b in range(g.dim):
            motion = sum(C[a, b, c] * dC[a] * mu[c] for a in range(g.dim) for c in range(g.dim))
            assert sympy.expand(motion) == 0


def test_fractions_and_names_are_kept():
    q, p = sympy.symbols("q p", real=True)
    polynomial = mf.sympy.polynomial(sympy.Rational(1, 3) * q**2 - 2 * p + sympy.Float(0.1), (q, p))
    assert str(polynomial) == "1/3*q**2 - 2*p + 0.1"
    assert polynomial.coefficients[0] == Fraction(1, 3)
    assert mf.sympy.expression(polynomial).coeff(q, 2) == sympy.Rational(1, 3)
    irrational = mf.LieAlgebra.from_structure_constants(np.sqrt(2.0) * mf.so(3).structure_constants)
    assert float(mf.sympy.structure_constants(irrational)[0, 1, 2]) == np.sqrt(2.0)


def test_what_is_no_polynomial_or_algebra_is_refused():
    q, k = sympy.symbols("q k", real=True)
    with pytest.raises(mf.ManifoldsError, match="not a polynomial"):
        mf.sympy.polynomial(sympy.sin(q), (q,))
    with pytest.raises(mf.ManifoldsError, match="substitute"):
        mf.sympy.polynomial(k * q, (q,))
    with pytest.raises(mf.ManifoldsError, match="as many symbols"):
        mf.sympy.expression(mf.so(3).casimirs(2)[0], (q,))
    with pytest.raises(mf.ManifoldsError, match="three indices"):
        mf.sympy.algebra([[0, 1], [1, 0]])
    constants = np.array(mf.so(3).structure_constants, dtype=int)
    constants[0, 1, 1], constants[1, 0, 1] = 1, -1
    with pytest.raises(mf.JacobiError):
        mf.sympy.algebra(constants.tolist())
