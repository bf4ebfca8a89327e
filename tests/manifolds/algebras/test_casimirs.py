"""Casimirs: their number, degrees and exact form; and the arithmetic of polynomials."""

import dataclasses
import warnings
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import manifolds as mf
from manifolds.algebras import _subspaces as linear
from manifolds.algebras import polynomial_casimirs as module
from manifolds.algebras.polynomial import Polynomial
from tests.cases import ALGEBRAS

INVARIANCE_TOLERANCE = 1e-15
"""Largest |ad*_{grad F} mu| / (|grad F| |mu|) of a Casimir; the largest measured is 2e-16 (sl(3) and su(4), degree
3)."""


def casimirs(g, degree):
    """Return ``g.casimirs(degree)``, ignoring a warning that there are no polynomial ones."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mf.NoPolynomialCasimirWarning)
        return g.casimirs(degree)


def invariance_residual(g, F):
    """Return the largest |ad*_{grad F} mu| / (|grad F| |mu|) at random points."""
    mu = jnp.asarray(np.random.default_rng(0).standard_normal((20, g.dim)))
    gradient = jax.vmap(jax.grad(F))(mu)
    size = jnp.linalg.norm(gradient, axis=1) * jnp.linalg.norm(mu, axis=1)
    return float(jnp.max(jnp.linalg.norm(g.ad_star(gradient, mu), axis=1) / size))


def exact_value(F, mu):
    terms = (c * np.prod([x**e for x, e in zip(mu, power, strict=True)]) for power, c in F.terms)
    return sum(terms, Fraction(0))


# -- how many -----------------------------------------------------------------------------------------------------


COUNTS = (
    [(mf.so(n), n // 2) for n in range(2, 8)]
    + [(mf.so(2, 1), 1), (mf.so(3, 1), 2), (mf.so(4, 1), 2), (mf.so(3, 3), 3)]
    + [(mf.su(n), n - 1) for n in range(2, 6)]
    + [(mf.sl(n), n - 1) for n in range(2, 6)]
    + [(mf.sp(n), n) for n in range(1, 4)]
    + [(mf.gl(n), n) for n in range(1, 5)]
    + [(mf.g2(), 2)]
    + [(mf.abelian(n), n) for n in (1, 2, 5)]
    + [(mf.heisenberg(n), 1) for n in (1, 2, 4)]
    + [(mf.se(n), (n + 1) // 2) for n in range(2, 6)]  # rank of so(n) plus rank of the little group, so(n - 1)
    + [(mf.aff(n), 0) for n in (1, 2, 3)]
    + [(mf.galilei(2), 2), (mf.galilei(3), 2)]  # P^2 and |K x P|^2 [Levy-Leblond 1963]
    + [(mf.bianchi(k), 3 if k == "I" else 1) for k in ("I", "II", "III", "IV", "V", "VIII", "IX")]
    + [(mf.bianchi("VI", h=h), 1) for h in (0, -0.25, -0.5, -1, -2)]
    + [(mf.bianchi("VII", h=h), 1) for h in (0, 0.3, 1)]
    + [(mf.direct_sum(mf.so(3), mf.heisenberg(1)), 2), (mf.semidirect_sum(mf.sl(2), mf.sl(2).basis), 1)]
)


@pytest.mark.parametrize(("g", "count"), COUNTS, ids=lambda value: getattr(value, "name", str(value)))
def test_known_counts(g, count):
    assert g.casimir_count() == count


DEGREES = [
    (mf.so(4), (2, 2)),
    (mf.so(5), (2, 4)),
    (mf.so(6), (2, 3, 4)),
    (mf.so(3, 1), (2, 2)),
    (mf.su(3), (2, 3)),
    (mf.su(4), (2, 3, 4)),
    (mf.sl(3), (2, 3)),
    (mf.sl(4), (2, 3, 4)),
    (mf.sp(2), (2, 4)),
    (mf.gl(2), (1, 2)),
    (mf.gl(3), (1, 2, 3)),
    (mf.abelian(3), (1, 1, 1)),
    (mf.heisenberg(2), (1,)),
    (mf.se(3), (2, 2)),
    (mf.se(4), (2, 4)),
    (mf.galilei(2), (2, 2)),
    (mf.galilei(3), (2, 4)),
    (mf.bianchi("III"), (1,)),
    (mf.bianchi("VI", h=-0.25), (4,)),
    (mf.direct_sum(mf.so(3), mf.heisenberg(1)), (1, 2)),
    (mf.semidirect_sum(mf.sl(2), mf.sl(2).basis), (3,)),
]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("g", "degrees"), DEGREES, ids=lambda value: getattr(value, "name", str(value)))
def test_known_degrees_of_generators_which_are_independent(g, degrees):
    generators = [F for degree in (1, 2, 3, 4) for F in casimirs(g, degree)]
    assert tuple(F.degree for F in generators) == degrees
    mu = jnp.asarray(np.random.default_rng(0).standard_normal(g.dim))
    gradients = np.array([jax.grad(F)(mu) for F in generators])
    assert np.linalg.matrix_rank(gradients, tol=1e-6) == len(generators) == g.casimir_count()


# -- which ones ---------------------------------------------------------------------------------------------------


@pytest.mark.sampled(5)
@pytest.mark.parametrize("g", ALGEBRAS, ids=lambda g: g.name)
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_casimirs_are_invariant_and_perturbed_ones_are_not(g, degree):
    noncentral_index = int(np.abs(g.structure_constants).sum(axis=(1, 2)).argmax())
    power = np.eye(g.dim, dtype=int)[[noncentral_index]] * degree
    for F in casimirs(g, degree):
        assert F.degree == degree
        assert invariance_residual(g, F) < INVARIANCE_TOLERANCE
        if not g.is_abelian():
            perturbed_casimir = F + Polynomial(power, [1e-6])
            assert invariance_residual(g, perturbed_casimir) > 1e3 * INVARIANCE_TOLERANCE


@pytest.mark.parametrize(
    ("g", "degree", "expected_texts"),
    [
        (mf.so(3), 2, ["mu1**2 + mu2**2 + mu3**2"]),
        (mf.su(2), 2, ["mu1**2 + mu2**2 + mu3**2"]),
        (mf.sl(2), 2, ["mu1**2 + 4*mu2*mu3"]),
        (mf.so(2, 1), 2, ["mu1**2 - mu2**2 - mu3**2"]),
        (
            mf.so(4),
            2,
            ["mu1**2 + mu2**2 + mu3**2 + mu4**2 + mu5**2 + mu6**2", "mu1*mu6 - mu2*mu5 + mu3*mu4"],
        ),
        (mf.se(2), 2, ["mu2**2 + mu3**2"]),
        (mf.se(3), 2, ["mu1*mu4 + mu2*mu5 + mu3*mu6", "mu4**2 + mu5**2 + mu6**2"]),
        (mf.gl(2), 1, ["mu1 + mu4"]),
        (mf.gl(2), 2, ["mu1*mu4 - mu2*mu3"]),
        (mf.heisenberg(1), 1, ["mu3"]),
        (mf.heisenberg(1), 2, []),
        (mf.abelian(2), 1, ["mu1", "mu2"]),
        (mf.abelian(2), 3, []),
        (mf.galilei(2), 2, ["mu2*mu5 - mu3*mu4", "mu4**2 + mu5**2"]),
        (mf.bianchi("VI", h=-0.25), 4, ["mu2**4 + 2*mu2**3*mu3 - 2*mu2*mu3**3 - mu3**4"]),
        (mf.semidirect_sum(mf.sl(2), mf.sl(2).basis), 3, ["mu1*mu4*mu5 + mu2*mu5**2 - mu3*mu4**2"]),
        (mf.so(3), 41, []),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_exact_form(g, degree, expected_texts):
    assert [str(F) for F in casimirs(g, degree)] == expected_texts
    assert all(isinstance(c, Fraction) for F in casimirs(g, degree) for c in F.coefficients)


def test_su3_has_the_length_and_the_cubic_of_the_d_symbols():
    g = mf.su(3)
    [quadratic], [cubic] = g.casimirs(2), g.casimirs(3)
    assert str(quadratic) == " + ".join(f"mu{a}**2" for a in range(1, 9))
    mu = np.random.default_rng(0).standard_normal(8)
    X = 1j * np.asarray(g.hat(mu))
    assert cubic(mu) == pytest.approx(4 / np.sqrt(3) * np.trace(X @ X @ X).real, rel=1e-13)


def test_galilei_quartic_is_the_square_of_a_cross_product():
    [F] = mf.galilei(3).casimirs(4)
    mu = np.random.default_rng(0).standard_normal(10)
    assert F(mu) == pytest.approx(np.sum(np.cross(mu[3:6], mu[6:9]) ** 2), rel=1e-13)


def test_a_result_is_a_list_of_its_own():
    g = mf.so(3)
    g.casimirs(2).clear()
    assert len(g.casimirs(2)) == 1


steps = st.lists(
    st.tuples(st.integers(0, 5), st.integers(0, 5), st.sampled_from([-2, -1, Fraction(1, 2), Fraction(2, 3), 1, 3])),
    max_size=6,
)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(g=st.sampled_from([mf.so(3), mf.se(2), mf.so(4), mf.gl(2), mf.heisenberg(2), mf.galilei(2)]), steps=steps)
def test_casimirs_do_not_depend_on_the_basis(g, steps):
    change = np.array([[Fraction(int(i == j)) for j in range(g.dim)] for i in range(g.dim)])
    inverse = change.copy()
    for i, j, factor in steps:  # e_i -> e_i + factor e_j, or a multiple of e_i
        i, j = i % g.dim, j % g.dim
        if i == j:
            change[i], inverse[:, i] = change[i] * factor, inverse[:, i] / factor
        else:
            change[i], inverse[:, j] = change[i] + factor * change[j], inverse[:, j] - factor * inverse[:, i]
    constants = g.rational_constants.numerator.astype(object)
    constants = np.einsum("ai,bj,ijk,kc->abc", change, change, constants, inverse)
    h = mf.LieAlgebra.from_structure_constants(constants, name="changed")
    assume(h.rational_constants is not None)
    assert h.casimir_count() == g.casimir_count()
    random = np.random.default_rng(0)
    points = [[Fraction(int(x), 7) for x in random.integers(-20, 20, g.dim)] for _ in range(6)]
    for degree in (1, 2):
        original_casimirs, new_casimirs = casimirs(g, degree), casimirs(h, degree)
        assert len(original_casimirs) == len(new_casimirs)
        linear_casimirs = [F for F in casimirs(g, 1) if degree == 2]
        span = original_casimirs + [F * G for F in linear_casimirs for G in linear_casimirs]
        values = np.array([[exact_value(F, mu) for F in span] for mu in points]).reshape(6, -1)
        for F in new_casimirs:
            assert all(c.denominator == 1 for c in F.coefficients)
            assert F.coefficients[0] > 0
            transformed_values = np.array([exact_value(F, change @ mu) for mu in points])  # mu'_i = <mu, e'_i>
            extended_echelon, _ = linear.row_echelon(np.column_stack([values, transformed_values]))
            echelon, _ = linear.row_echelon(values)
            assert len(extended_echelon) == len(echelon)  # in the span of the old ones, exactly


def test_constants_that_are_not_rational():
    g = mf.so(4)
    rotation, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((6, 6)))
    constants = np.einsum("ai,bj,ijk,ck->abc", rotation, rotation, g.structure_constants, rotation)
    h = mf.LieAlgebra.from_structure_constants((constants - constants.swapaxes(0, 1)) / 2, name="rotated so(4)")
    assert module._rationally_scaled_algebra(h)[0].rational_constants is None
    assert h.casimir_count() == 2
    F, G = h.casimirs(2)
    assert str(F).startswith("mu1**2 + ")
    assert isinstance(F.coefficients[0], float)
    assert max(invariance_residual(h, F), invariance_residual(h, G)) < 1e-12
    assert h.casimirs(4) == []


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_casimirs_in_a_basis_of_any_scale(scale):
    """Constants are no fractions and of every size: the Casimirs are those of se(3) in the given units."""
    g, random = mf.se(3), np.random.default_rng(3)
    units = scale * 10.0 ** random.uniform(-3, 3, g.dim)
    constants = np.einsum("a,b,abc,c->abc", units, units, g.structure_constants, 1 / units)
    h = mf.LieAlgebra.from_structure_constants(constants, name="in units")
    assert h.rational_constants is None
    assert h.casimir_count() == 2
    mu = random.standard_normal(g.dim)
    for F, G in zip(g.casimirs(2), h.casimirs(2), strict=True):
        leading_factor = np.prod(units ** G.exponents[0])
        assert G(units * mu) == pytest.approx(leading_factor * float(F(mu)), rel=1e-12)


@pytest.mark.parametrize("g", [mf.se(3), mf.so(4), mf.sl(3), mf.bianchi("VI", h=-0.5)], ids=lambda g: g.name)
def test_square_roots_are_scaled_away(g):
    random = np.random.default_rng(2)
    scale = np.sqrt(random.choice([1, 2, 3, 5, 6], g.dim) / random.choice([1, 7], g.dim))
    constants = np.einsum("a,b,abc,c->abc", scale, scale, g.structure_constants, 1 / scale)
    h = mf.LieAlgebra.from_structure_constants(constants, name="scaled")
    assert h.rational_constants is None
    assert module._rationally_scaled_algebra(h)[0].rational_constants is not None
    for degree in (1, 2, 3):
        for F, G in zip(casimirs(g, degree), casimirs(h, degree), strict=True):
            weights = np.prod(scale**G.exponents, axis=1)
            expected_coefficients = (
                weights[0] / weights * np.array([float(c / F.coefficients[0]) for c in F.coefficients])
            )
            np.testing.assert_allclose(G.coefficients, expected_coefficients, rtol=5e-15)


def test_a_rank_without_a_clear_gap_is_an_error():
    """Two elements act on a plane almost alike, and no scaling separates them. The two so(3) below are separated by
    one."""
    constants = np.zeros((4, 4, 4))
    constants[0, 2, 2] = constants[0, 3, 3] = constants[1, 2, 2] = 1.0
    constants[1, 3, 3] = 1.0 + 1e-9 * np.pi
    g = mf.LieAlgebra.from_structure_constants(constants - constants.swapaxes(0, 1), name="nearly")
    with pytest.raises(mf.LieAlgebraError, match=r"not clear.*rescale the basis") as caught:
        g.casimir_count()
    assert 1e-10 < caught.value.residual < 1e-7
    small_so3 = mf.LieAlgebra.from_structure_constants(1e-9 * np.pi * mf.so(3).structure_constants, name="small")
    assert mf.direct_sum(mf.so(3), small_so3).casimir_count() == 2


# -- when there is none -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [mf.bianchi("IV"), mf.bianchi("V"), mf.bianchi("VII", h=0.3)], ids=lambda g: g.name)
def test_casimirs_that_are_not_polynomials_are_announced(g):
    with pytest.warns(mf.NoPolynomialCasimirWarning, match=r"1 independent Casimir, .* up to degree 4. .*rational"):
        assert g.casimirs(4) == []
    with pytest.warns(mf.NoPolynomialCasimirWarning):  # every time, although the answer is remembered
        assert g.casimirs(4) == []


@pytest.mark.parametrize(
    ("g", "degree"), [(mf.aff(1), 3), (mf.aff(2), 2), (mf.so(3), 1), (mf.so(3), 4), (mf.se(3), 3)], ids=str
)
def test_an_empty_answer_that_hides_nothing_gives_no_warning(g, degree):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert g.casimirs(degree) == []


@pytest.mark.parametrize("degree", [0, -1, 1.5, 2.0, True, "2"])
def test_degrees_that_are_refused(degree):
    with pytest.raises(mf.ParameterError, match="integer >= 1"):
        mf.so(3).casimirs(degree)


def test_too_many_monomials_are_refused_with_their_number(monkeypatch):
    with pytest.raises(mf.LieAlgebraError, match=r"se\(7\) has 1107568 monomials of degree 6, more than the 20000"):
        mf.se(7).casimirs(6)
    monkeypatch.setattr(module, "MAX_BLOCK_SIZE", 5)
    with pytest.raises(mf.LieAlgebraError, match="couples 10 monomials of degree 2, more than the 5"):
        mf.se(5).casimirs(2)


# -- exact linear algebra -----------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_rational_null_space(data):
    rows, columns = data.draw(st.integers(0, 5)), data.draw(st.integers(1, 6))
    p = linear.large_prime(0)
    entry = st.one_of(st.integers(-3, 3), st.integers(-(2**40), 2**40), st.sampled_from([p, -2 * p]))
    matrix = np.array([[data.draw(entry) for _ in range(columns)] for _ in range(rows)], dtype=np.int64)
    matrix = matrix.reshape(rows, columns)
    basis = linear.rational_null_space(matrix)
    echelon, _ = linear.row_echelon(
        np.array([[Fraction(int(x)) for x in row] for row in matrix]).reshape(rows, columns)
    )
    assert len(basis) == columns - len(echelon)
    for vector in basis:
        assert all(sum(int(a) * v for a, v in zip(row, vector, strict=True)) == 0 for row in matrix)
        assert np.gcd.reduce(np.array(vector, dtype=object)) == 1
        assert next(v for v in vector if v) > 0


def test_primes():
    assert [linear.large_prime(k) for k in range(3)] == [2**31 - 1, 2147483629, 2147483587]


# -- polynomials --------------------------------------------------------------------------------------------------


x, y, z = (Polynomial([row], [1]) for row in np.eye(3, dtype=int).tolist())
coefficients = st.one_of(st.integers(-9, 9), st.fractions(-3, 3, max_denominator=7), st.floats(-4, 4))
polynomials = st.lists(st.tuples(st.tuples(*[st.integers(0, 3)] * 3), coefficients), max_size=5).map(
    lambda terms: Polynomial(np.array([p for p, _ in terms], dtype=int).reshape(-1, 3), [c for _, c in terms])
)


def test_printing():
    F = Polynomial([[0, 3, 0, 0], [2, 0, 0, 0], [1, 0, 0, 1]], [-3, 1, 2])
    assert str(F) == "mu1**2 + 2*mu1*mu4 - 3*mu2**3"
    assert repr(F) == "<Polynomial mu1**2 + 2*mu1*mu4 - 3*mu2**3>"
    assert str(x * Fraction(1, 3) - y) == "1/3*mu1 - mu2"
    assert str(-x * 0.1 - 1) == "-0.1*mu1 - 1"
    assert str(x - x) == "0"
    assert str(x * 1e-20 * -1.0) == "-1e-20*mu1"


def test_attributes():
    F = Polynomial([[1, 1, 0], [0, 0, 3], [1, 1, 0], [0, 1, 0]], [1, Fraction(1, 2), np.int64(2), 0])
    assert (F.dim, F.degree) == (3, 3)
    assert F.exponents.tolist() == [[1, 1, 0], [0, 0, 3]]
    assert not F.exponents.flags.writeable
    assert F.coefficients == (3, Fraction(1, 2))
    assert all(type(c) is Fraction for c in F.coefficients)
    assert 3 * x * y + z * z * z * Fraction(1, 2) == F
    assert hash(F) == hash(3 * y * x + Fraction(1, 2) * z * z * z)
    assert np.float64(2.0) * x == x + x == 2 * x
    assert 1 - x == -(x - 1)
    assert F.gradient() == (3 * y, 3 * x, Fraction(3, 2) * z * z)
    with pytest.raises(dataclasses.FrozenInstanceError):
        F.dim = 4


def test_a_polynomial_is_static_under_jax():
    assert jax.tree.leaves(x + y) == []
    value = jax.jit(lambda F, mu: F(mu))(x * y, jnp.arange(3.0) + 1)
    assert value == 2.0
    assert value.dtype == jnp.float64


@settings(max_examples=20, deadline=None)
@given(F=polynomials, G=polynomials, c=coefficients)
def test_arithmetic_agrees_with_values(F, G, c):
    mu = np.random.default_rng(0).uniform(-1.5, 1.5, (2, 5, 3))
    a, b = np.asarray(F(mu)), np.asarray(G(mu))
    assert a.shape == (2, 5)
    for polynomial, expected_values in [
        (F + G, a + b),
        (F - G, a - b),
        (F * G, a * b),
        (c * F, float(c) * a),
        (F - c, a - c),
    ]:
        np.testing.assert_allclose(polynomial(mu), np.asarray(expected_values, dtype=float), rtol=1e-11, atol=1e-9)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(F=polynomials, mask=st.lists(st.sampled_from([0.0, 1.0]), min_size=3, max_size=3))
def test_derivatives_at_vanishing_components(F, mask):
    mu = jnp.array([1.3, -0.7, 0.4]) * jnp.array(mask)
    expected_gradient = jnp.array([dF(mu) for dF in F.gradient()])
    np.testing.assert_allclose(jax.grad(F)(mu), expected_gradient, atol=1e-10)
    expected_hessian = jnp.array([[d(mu) for d in dF.gradient()] for dF in F.gradient()])
    np.testing.assert_allclose(jax.hessian(F)(mu), expected_hessian, atol=1e-10)


def test_polynomials_that_are_refused():
    with pytest.raises(mf.ShapeError, match="2 coefficients need exponents of shape"):
        Polynomial([[1, 0]], [1, 2])
    with pytest.raises(mf.ComponentError, match="integers >= 0"):
        Polynomial([[1, -1]], [1])
    for bad in (float("nan"), 1j, "1"):
        with pytest.raises(mf.ComponentError, match="finite real"):
            Polynomial([[1, 0]], [bad])
    with pytest.raises(mf.ShapeError, match="2 and in 3 variables"):
        Polynomial([[1, 0]], [1]) + x
    with pytest.raises(mf.ShapeError, match="last axis 3"):
        x(jnp.zeros(4))
    with pytest.raises(TypeError):
        x * "2"
