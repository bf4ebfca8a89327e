"""The magnetic extension g ⋉ g* by the brackets of g, compared to the semidirect sum with structure constants."""

import jax
import numpy as np
import pytest

import manifolds as mf

ALGEBRAS = {
    "so(3)": lambda: mf.so(3),
    "sl(2)": lambda: mf.sl(2),
    "se(2)": lambda: mf.se(2),
    "heisenberg": lambda: mf.heisenberg(1),
    "two copies": lambda: mf.so(3) ** 2,
    "su(3) by matrices": lambda: mf.su(3, by_matrices=True),
    "gl(2) by matrices": lambda: mf.gl(2, by_matrices=True),
}


@pytest.fixture(scope="module", params=ALGEBRAS)
def pair(request):
    g = ALGEBRAS[request.param]()
    return mf.magnetic_extension(g, by_brackets=True), mf.magnetic_extension(g, by_brackets=False)


@pytest.mark.sampled(2)
def test_operations_and_forms_are_those_of_the_constants(pair):
    m, c = pair
    x, y, mu = np.random.default_rng(0).standard_normal((3, 4, c.dim))
    for name, arguments in [("bracket", (x, y)), ("ad_star", (x, mu)), ("ad", (x,))]:
        np.testing.assert_allclose(getattr(m, name)(*arguments), getattr(c, name)(*arguments), atol=1e-13)
    action = m.action(x[0])
    np.testing.assert_allclose(action.bracket(y[0]), c.bracket(x[0], y[0]), atol=1e-13)
    np.testing.assert_allclose(action.ad_star(mu[0]), c.ad_star(x[0], mu[0]), atol=1e-13)
    np.testing.assert_allclose(m.killing_form(), c.killing_form(), atol=1e-13)
    np.testing.assert_allclose(m.killing_inner_product() @ x[0], c.killing_inner_product() @ x[0], atol=1e-12)
    questions = "is_abelian is_semisimple is_solvable is_nilpotent is_unimodular derived_series lower_central_series"
    for question in (*questions.split(), "killing_signature", "casimir_count"):
        assert getattr(m, question)() == getattr(c, question)(), question


@pytest.mark.sampled(2)
def test_casimirs_are_in_the_kernel_and_as_many_as_there_are(pair):
    m, c = pair
    (mu,) = np.random.default_rng(1).standard_normal((1, m.dim))

    def casimir_residual(F):
        gradient = np.asarray(jax.jit(jax.grad(F))(mu))
        return np.abs(c.ad_star(gradient, mu)).max() / np.abs(gradient).max()

    assert all(casimir_residual(F) < 1e-12 for _, F in m.leading_casimirs())
    assert casimir_residual(lambda mu: jax.numpy.sum(mu[: m.algebra.dim] ** 2)) > 1e-3  # control: no Casimir
    if m.algebra.is_semisimple():
        casimirs = [F for degree in range(1, 5) for F in m.casimirs(degree)]
        gradients = np.array([jax.jit(jax.grad(F))(mu) for F in casimirs])
        gradients /= np.linalg.norm(gradients, axis=1, keepdims=True)
        assert all(casimir_residual(F) < 1e-12 for F in casimirs)
        assert np.linalg.matrix_rank(gradients, tol=1e-8) == m.casimir_count()


def test_the_one_of_the_rotations_are_the_motions_of_space():
    np.testing.assert_array_equal(mf.magnetic_extension(mf.so(3)).structure_constants, mf.se(3).structure_constants)


def test_large_ones_make_no_constants():
    g = mf.magnetic_extension(mf.su(64))
    x, mu = np.random.default_rng(2).standard_normal((2, g.dim))
    assert g.ad_star(x, mu).shape == (2 * (64**2 - 1),)
    assert g.casimir_count() == 2 * 63
    assert not g.is_semisimple()
    assert g.is_unimodular()
    assert len(g.leading_casimirs()) == 4
    assert g == mf.magnetic_extension(mf.su(64)) != mf.magnetic_extension(mf.su(65))
    with pytest.raises(mf.SizeError, match="GB"):
        _ = g.structure_constants
    with pytest.raises(mf.ParameterError, match="must be a LieAlgebra, got int"):
        mf.magnetic_extension(3)
