"""Classical algebras by products of matrices, compared to equal algebras by structure constants."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from manifolds.algebras.matrix_algebra import MatrixTrace
from tests.refusals import refusal_test

SLOW_PAIRS = [("u", 3), ("so", 5), ("sp", 2), ("gl", 3)]
PAIRS = [("su", 3), ("so", 3, 2), ("sl", 3), *(pytest.param(p, marks=pytest.mark.slow) for p in SLOW_PAIRS)]


@pytest.fixture(scope="module", params=PAIRS, ids=lambda p: f"{p[0]}{p[1:]}")
def pair(request):
    name, *sizes = request.param
    constructor = getattr(mf, name)
    matrix_algebra = constructor(*sizes, by_matrices=True)
    constants_algebra = constructor(*sizes)
    assert isinstance(matrix_algebra, mf.MatrixAlgebra)
    assert not isinstance(constants_algebra, mf.MatrixAlgebra)
    return matrix_algebra, constants_algebra


@pytest.mark.sampled(1)
def test_operations_and_forms_are_those_of_the_constants(pair):
    m, c = pair
    x, y, mu = np.random.default_rng(0).standard_normal((3, 4, c.dim))
    for name, arguments in [("bracket", (x, y)), ("ad_star", (x, mu)), ("ad", (x,)), ("hat", (x,))]:
        np.testing.assert_allclose(getattr(m, name)(*arguments), getattr(c, name)(*arguments), atol=1e-14)
    np.testing.assert_allclose(m.vee(m.hat(x)), x, atol=1e-15)
    action = m.action(x[0])
    np.testing.assert_allclose(action.bracket(y[0]), c.bracket(x[0], y[0]), atol=1e-14)
    np.testing.assert_allclose(action.ad_star(mu[0]), c.ad_star(x[0], mu[0]), atol=1e-14)
    np.testing.assert_allclose(m.killing_form(), c.killing_form(), atol=1e-13)
    np.testing.assert_allclose(m.killing_inner_product() @ x[0], c.killing_inner_product() @ x[0], atol=1e-13)
    if c.is_semisimple():
        np.testing.assert_allclose(m.cartan_involution(), c.cartan_involution(), atol=1e-14)
    M = np.asarray(m.dual_matrix(mu))
    pairings = np.einsum("nij,nij->n", M.conj(), np.asarray(m.hat(y))).real
    np.testing.assert_allclose(pairings, (mu * y).sum(axis=1), atol=1e-14)
    np.testing.assert_allclose(m.from_dual_matrix(M), mu, atol=1e-14)


@pytest.mark.sampled(1)
def test_structure_is_that_of_the_constants(pair):
    m, c = pair
    for question in (
        "is_abelian is_semisimple is_compact_type is_solvable is_nilpotent is_unimodular derived_series "
        "lower_central_series killing_signature casimir_count"
    ).split():
        assert getattr(m, question)() == getattr(c, question)(), question
    np.testing.assert_allclose(m.structure_constants, c.structure_constants, atol=1e-15)
    np.testing.assert_array_equal(m.basis, c.basis)


def test_traces_are_independent_casimirs_as_many_as_there_are(pair):
    m, _ = pair
    (mu,) = np.random.default_rng(1).standard_normal((1, m.dim))
    gradients = []
    for degree in range(1, 2 * m.matrix_size):
        for F in m.casimirs(degree):
            gradient = np.asarray(jax.grad(F)(mu))
            assert np.abs(m.ad_star(gradient, mu)).max() < 1e-13 * np.abs(gradient).max()
            gradients.append(gradient / np.linalg.norm(gradient))
    assert np.linalg.matrix_rank(np.array(gradients), tol=1e-6) == len(gradients) == m.casimir_count()


def test_derivatives_of_traces_are_those_of_powers_of_matrices(pair):
    """First and second derivatives, and those of the first along a second momentum, equal JAX's for matrix powers."""
    m, _ = pair
    mu, nu, direction = np.random.default_rng(2).standard_normal((3, m.dim))

    def trace_of_power(mu, degree):
        M = m.dual_matrix(mu) * (1j if m.classical_data.is_compact else 1.0)
        return jnp.trace(jnp.linalg.matrix_power(M, degree)).real

    for degree in (2, 3, 4, 5):
        F, f = MatrixTrace(m, degree), functools.partial(trace_of_power, degree=degree)
        derivatives_along_nu = [jax.grad(lambda mu, f=f: jax.jvp(f, (mu,), (nu,))[1]) for f in (F, f)]
        pairs = [(F(mu), f(mu)), (jax.hessian(F)(mu), jax.hessian(f)(mu))]
        pairs += zip(*(jax.jvp(gradient, (mu,), (direction,)) for gradient in derivatives_along_nu), strict=True)
        for value, expected_value in pairs:
            np.testing.assert_allclose(value, expected_value, atol=1e-12 * max(1.0, np.abs(expected_value).max()))


@pytest.mark.slow
def test_suite_holds(pair):
    assert mf.testing.check_algebra(pair[0], degree=2).passed


@pytest.mark.slow
def test_the_representation_changes_with_the_size():
    su11 = mf.su(11)
    assert type(su11) is mf.LieAlgebra
    assert np.count_nonzero(su11.structure_constants) < 0.01 * su11.dim**3, "rounding is among the constants"
    assert isinstance(mf.su(12), mf.MatrixAlgebra)
    assert mf.su(12) == mf.su(12) != mf.su(13)


def test_large_algebras_take_memory_of_a_few_states():
    g = mf.su(128)
    x, y, mu = np.random.default_rng(2).standard_normal((3, g.dim)) / 100
    X, Y = np.asarray(g.hat(x)), np.asarray(g.hat(y))
    np.testing.assert_allclose(g.hat(g.bracket(x, y)), X @ Y - Y @ X, atol=1e-12)
    assert float(g.ad_star(x, mu) @ y) == pytest.approx(float(mu @ g.bracket(x, y)), abs=1e-11)
    names = [name for name, _ in g.leading_casimirs()]
    assert names == ["tr((i M)**2)", "tr((i M)**3)", "tr((i M)**4)"]
    assert g.casimir_count() == 127
    for F in (F for _, F in g.leading_casimirs()):
        gradient = jax.grad(F)(mu)
        assert np.abs(g.ad_star(gradient, mu)).max() < 1e-12 * max(1.0, np.abs(gradient).max())


test_refusals = refusal_test(
    (lambda: mf.su(10**5), "one step with matrices of su.100000. would take 1.6e.03 GB", mf.SizeError),
    (lambda: mf.su(512).structure_constants, "1.44e.08 GB", mf.SizeError),
    (lambda: mf.so(900).killing_form(), "GB", mf.SizeError),
    (lambda: mf.su(400).basis, "GB.*hat and vee need no list", mf.SizeError),
    (lambda: mf.su(12).vee(1j * np.eye(12)), "its trace is 12", mf.LieAlgebraError),
    (lambda: mf.so(20).vee(np.triu(np.ones((20, 20)), 1)), r"not in so\(20\): it is 0.5 away", mf.LieAlgebraError),
    (lambda: mf.su(12).bracket(np.zeros(142), np.zeros(143)), "last axis 143", mf.ShapeError),
    (lambda: mf.so(20).casimirs(10), "Pfaffian", mf.LieAlgebraError),
    (lambda: mf.su(12).casimirs(0), "degree", mf.ParameterError),
)
