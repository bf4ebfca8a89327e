"""Gauss tableaus against decimal arithmetic of 60 digits, the order conditions, and the collocation polynomial."""

import functools
import itertools
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest

from liethermo.integrators.tableaus import (
    MAX_STAGES,
    extrapolation_matrix,
    gauss_tableau,
    interpolation_weights,
    kronrod_rule,
)

STAGES = range(1, MAX_STAGES + 1)
EPS = float(np.finfo(float).eps)
DIGITS = 60
"""Decimal digits of the reference arithmetic."""


# -- the oracle: Lagrange interpolation in powers of t, at the roots of d^s/dt^s [t^s (t - 1)^s] -----------------------


def value(polynomial, t):
    """Return the value at t of a polynomial with coefficients from the constant one up."""
    return functools.reduce(lambda total, a: total * t + a, reversed(polynomial), 0 * t)


def product(p, q):
    total = [p[0] * 0] * (len(p) + len(q) - 1)
    for (i, a), (j, b) in itertools.product(enumerate(p), enumerate(q)):
        total[i + j] += a * b
    return total


def integral(polynomial):
    return [polynomial[0] * 0, *(a / (m + 1) for m, a in enumerate(polynomial))]


def derivative(polynomial):
    return [m * a for m, a in enumerate(polynomial)][1:]


def roots(polynomial):
    """Return all roots, simple and inside (0, 1), by bisection between sign changes on a fine grid."""
    coefficients = [Decimal(a.numerator) / Decimal(a.denominator) for a in polynomial]
    grid = [Decimal(i) / 999 for i in range(1000)]
    zeros = []
    for low, b in itertools.pairwise(grid):
        rises = value(coefficients, b) > 0
        if (value(coefficients, low) > 0) == rises:
            continue
        for _ in range(200):
            middle = (low + b) / 2
            low, b = (low, middle) if (value(coefficients, middle) > 0) == rises else (middle, b)
        zeros.append(low)
    assert len(zeros) == len(polynomial) - 1
    return zeros


def lagrange(nodes):
    """Yield the coefficients of the polynomials that are 1 at one node and 0 at the others."""
    for j, node in enumerate(nodes):
        factors = [
            [-other_node / (node - other_node), 1 / (node - other_node)] for i, other_node in enumerate(nodes) if i != j
        ]
        yield functools.reduce(product, factors, [Decimal(1)])


@functools.cache
def oracle(stages):
    """Return nodes and the Lagrange polynomials through them, to some 50 digits."""
    with localcontext(prec=DIGITS):
        power = functools.reduce(product, [[Fraction(0), Fraction(-1), Fraction(1)]] * stages)  # (t^2 - t)^s
        for _ in range(stages):
            power = derivative(power)
        nodes = roots(power)
        return nodes, list(lagrange(nodes))


@functools.cache
def exact_tableau(stages):
    """Return A, b, c as Decimals."""
    with localcontext(prec=DIGITS):
        c, basis = oracle(stages)
        integrals = [integral(p) for p in basis]
        return [[value(p, t) for p in integrals] for t in c], [value(p, Decimal(1)) for p in integrals], c


def roundings(computed, exact):
    """Return the largest error in units of the rounding of each entry, which is 1/2 for the nearest double."""
    with localcontext(prec=DIGITS):
        pairs = zip(np.ravel(computed), np.ravel(exact), strict=True)
        return max(float(abs(Decimal(float(a)) - b) / Decimal(float(np.spacing(abs(a))))) for a, b in pairs)


# -- the tableau ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stages", STAGES)
def test_every_entry_is_the_nearest_double(stages):
    """The error is half a rounding plus that of extended precision; without extended precision a few roundings."""
    tableau, exact = gauss_tableau(stages), exact_tableau(stages)
    has_extended_precision = np.finfo(np.longdouble).eps < 1e-18
    for computed, exact_values in zip(tableau, exact, strict=True):
        assert roundings(computed, exact_values) <= (0.51 if has_extended_precision else 40.0)


def test_the_tableaus_of_the_textbook():
    """s = 1, 2, 3 as printed in Hairer, Lubich & Wanner 2006, II (1.20) and table 1.1."""
    r3, r15 = 3**0.5, 15**0.5
    textbook = {
        1: ([[1 / 2]], [1.0], [1 / 2]),
        2: ([[1 / 4, 1 / 4 - r3 / 6], [1 / 4 + r3 / 6, 1 / 4]], [1 / 2, 1 / 2], [1 / 2 - r3 / 6, 1 / 2 + r3 / 6]),
        3: (
            [
                [5 / 36, 2 / 9 - r15 / 15, 5 / 36 - r15 / 30],
                [5 / 36 + r15 / 24, 2 / 9, 5 / 36 - r15 / 24],
                [5 / 36 + r15 / 30, 2 / 9 + r15 / 15, 5 / 36],
            ],
            [5 / 18, 4 / 9, 5 / 18],
            [1 / 2 - r15 / 10, 1 / 2, 1 / 2 + r15 / 10],
        ),
    }
    for stages, tableau in textbook.items():
        for computed, exact_values in zip(gauss_tableau(stages), tableau, strict=True):
            assert np.allclose(computed, exact_values, rtol=0, atol=2 * EPS)


@pytest.mark.parametrize("stages", STAGES)
def test_order_conditions(stages):
    """B(2s): sum b c^(q-1) = 1/q. C(s): sum_j a_ij c_j^(q-1) = c_i^q/q. Both fail one degree further."""
    A, b, c = gauss_tableau(stages)

    def B(q):
        return abs(b @ c ** (q - 1) - 1 / q)

    def C(q):
        return np.abs(A @ c ** (q - 1) - c**q / q).max()

    assert max(map(B, range(1, 2 * stages + 1))) <= 2 * EPS
    assert max(map(C, range(1, stages + 1))) <= 2 * EPS
    # the next power misses by the square integral of the monic Legendre polynomial, about 4^-2s
    assert B(2 * stages + 1) > 0.3 * 16.0**-stages
    assert C(stages + 1) > 0.1 * 4.0**-stages / (stages + 1)


@pytest.mark.parametrize("stages", STAGES)
def test_symplectic_and_symmetric(stages):
    """b_i a_ij + b_j a_ji = b_i b_j, which keeps quadratic invariants; reversed in time the method is the same."""
    A, b, c = gauss_tableau(stages)
    assert np.abs(b[:, None] * A + (b[:, None] * A).T - np.outer(b, b)).max() <= EPS
    assert np.abs(A + A[::-1, ::-1] - b).max() <= 2 * EPS
    assert np.abs(c + c[::-1] - 1.0).max() <= EPS


def test_radau_tableau_fails_the_order_and_symplecticity_tests():
    """Radau IIA of two stages has order 3 and is not symplectic: the two tests above tell it from Gauss."""
    A, b, c = np.array([[5 / 12, -1 / 12], [3 / 4, 1 / 4]]), np.array([3 / 4, 1 / 4]), np.array([1 / 3, 1.0])
    assert abs(b @ c**3 - 1 / 4) > 0.01
    assert np.abs(b[:, None] * A + (b[:, None] * A).T - np.outer(b, b)).max() > 0.01


# -- the collocation polynomial ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("stages", STAGES)
def test_beyond_continues_a_polynomial(stages):
    """Slopes of degree s - 1 at the nodes of one step become those of the next; one degree more fails."""
    c, rng = gauss_tableau(stages).c, np.random.default_rng(stages)
    size = np.abs(extrapolation_matrix(stages)).sum(axis=1).max()  # what rounding of the slopes is multiplied by
    polynomial = np.polynomial.Polynomial(rng.standard_normal(stages))
    error = np.abs(extrapolation_matrix(stages) @ polynomial(c) - polynomial(1 + c)).max()
    assert error <= 20 * EPS * size
    assert np.abs(extrapolation_matrix(stages) @ c**stages - (1 + c) ** stages).max() > 0.1


@pytest.mark.parametrize("stages", STAGES)
def test_integrated_integrates_a_polynomial(stages):
    """The weights integrate the Lagrange polynomials everywhere; they are 0, A and b at 0, the nodes and 1."""
    A, b, c = gauss_tableau(stages)
    theta = np.linspace(-0.5, 1.5, 41).reshape(1, 41)
    weights = interpolation_weights(stages, theta)
    assert weights.shape == (1, 41, stages)
    with localcontext(prec=DIGITS):
        integrals = [integral(p) for p in oracle(stages)[1]]
        exact = [[float(value(p, Decimal(float(t)))) for p in integrals] for t in theta[0]]
    size = np.maximum(1.0, np.abs(exact).sum(axis=1, keepdims=True))
    assert (np.abs(weights[0] - exact) / size).max() <= 10 * EPS
    assert np.abs(interpolation_weights(stages, c) - A).max() <= 4 * EPS
    assert np.abs(interpolation_weights(stages, 1.0) - b).max() <= 4 * EPS
    assert np.abs(interpolation_weights(stages, 0.0)).max() <= 4 * EPS


def test_tableaus_are_computed_once():
    assert gauss_tableau(3) is gauss_tableau(3)
    assert all(
        a.dtype == np.float64 for a in (*gauss_tableau(3), extrapolation_matrix(3), interpolation_weights(3, 0.3))
    )


@pytest.mark.parametrize(("stages", "degree"), [(1, 5), (2, 7)])
def test_finer_quadrature(stages, degree):
    """The Kronrod rule, through the collocation polynomial, is exact to its degree, and not beyond."""
    c, rule = gauss_tableau(stages).c, kronrod_rule(stages)
    theta = rule.A @ np.ones(stages)  # slopes of 1 take the polynomial to the node itself
    for power in range(degree + 2):
        error = abs(rule.b @ theta**power + (gauss_tableau(stages).b + rule.weight_change) @ c**power - 1 / (power + 1))
        assert (error <= 2 * EPS) if power <= degree else (error > 1e-6)
    slopes = np.random.default_rng(0).standard_normal(stages)
    line = np.polynomial.Polynomial.fit(c, slopes, stages - 1)
    assert np.abs(rule.slope_matrix @ slopes - line(theta)).max() <= 20 * EPS
    assert np.abs(rule.A @ slopes - line.integ()(theta) + line.integ()(0.0)).max() <= 20 * EPS
    assert kronrod_rule(3) is None
