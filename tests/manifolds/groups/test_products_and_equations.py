"""Products of groups and groups from equations: the property suite, the groups of the catalogue, and runs."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

FORM = np.diag([1.0, 1.0, -1.0])


def orthogonal(A):
    return A.T @ A - jnp.eye(3)


def lorentz(A):
    return A.T @ FORM @ A - FORM


def rigid(A):
    """Return the equations of SE(2)."""
    return jnp.concatenate([(A[:2, :2].T @ A[:2, :2] - jnp.eye(2)).ravel(), A[2] - jnp.array([0.0, 0.0, 1.0])])


@pytest.mark.parametrize(
    "factors", [(mf.SE(2), mf.SO(2)), pytest.param((mf.SU(2), mf.SO(3)), marks=pytest.mark.slow)], ids=str
)
def test_product_passes_the_suite_and_is_that_of_its_factors(factors):
    first, second = factors
    G = first * second
    assert mf.testing.check_group(G).passed
    assert (G.name, G.dim) == (f"{first.name} x {second.name}", first.dim + second.dim)
    assert G.algebra == mf.direct_sum(first.algebra, second.algebra)
    assert first * second == G
    assert hash(first * second) == hash(G)
    x = 0.4 * np.random.default_rng(0).standard_normal((2, G.dim))
    g, m = np.asarray(G.exp(x)), first.matrix_size
    np.testing.assert_allclose(g[:, :m, :m], first.exp(x[:, : first.dim]), atol=1e-15)
    np.testing.assert_allclose(g[:, m:, m:], second.exp(x[:, first.dim :]), atol=1e-15)
    assert not g[:, :m, m:].any()
    assert not bool(G.belongs(g[0] + np.eye(len(g[0]))[::-1]))
    with pytest.raises(TypeError):
        first * 2


def test_product_is_the_attitude_of_a_run():
    G = mf.SE(2) * mf.SO(2)
    system = lt.LiePoissonSystem(G.algebra, lt.Quadratic([1.0, 2.0, 3.0, 0.5]), group=G, reconstruction="exp")
    solution = lt.integrate(system, [0.3, 0.5, -0.2, 0.7], (0.0, 5.0), 0.05)
    assert solution.audit().passed
    g = np.asarray(solution.attitude[-1])
    assert bool(G.belongs(g))
    np.testing.assert_allclose(g[3:, 3:], mf.SO(2).exp([5.0 * 0.5 * 0.7]), atol=1e-12)


@pytest.mark.parametrize(
    ("f", "text", "catalogue"),
    [
        pytest.param(orthogonal, "A3,9", mf.SO(3), marks=pytest.mark.slow, id="O(3)"),
        pytest.param(lorentz, "A3,8", None, id="O(2,1)"),
        pytest.param(rigid, "A3,6", mf.SE(2), marks=pytest.mark.slow, id="SE(2)"),
    ],
)
def test_group_from_equations(f, text, catalogue):
    G = mf.MatrixGroup.from_equations(f, 3, name="G")
    assert str(G.algebra.isomorphism_type()) == text
    x = 0.3 * np.random.default_rng(0).standard_normal((3, 3))
    g = np.asarray(G.exp(x))
    assert bool(np.all(G.belongs(g)))
    assert not bool(np.any(G.belongs(g + 1e-3)))
    np.testing.assert_allclose(G.log(g), x, atol=1e-12)
    restored = np.asarray(G.restore_map(jnp.asarray(g + 1e-6 * np.ones((3, 3)))))
    assert np.asarray(G.defect(restored)).max() < 1e-10
    if catalogue is not None:
        np.testing.assert_allclose(catalogue.log(g), catalogue.algebra.vee(G.algebra.hat(x)), atol=1e-12)


def test_equations_may_be_a_list():
    """Orthogonal matrices that keep the third axis turn about it."""
    axis = jnp.array([0.0, 0.0, 1.0])
    G = mf.MatrixGroup.from_equations(lambda A: [orthogonal(A), A @ axis - axis], 3, name="turns")
    assert G.dim == 1
    g = np.asarray(G.exp(np.array([0.3])))
    assert bool(G.belongs(g))
    np.testing.assert_allclose(np.abs(g[0, 1]), np.sin(0.3 * np.abs(G.algebra.basis).max()), atol=1e-14)
    assert not bool(G.belongs(mf.SO(3).exp(np.array([0.3, 0.0, 0.0]))))


def test_group_from_equations_is_the_attitude_of_a_run():
    G = mf.MatrixGroup.from_equations(orthogonal, 3)
    basis = np.asarray(mf.so(3).vee(G.algebra.basis))  # rows: the elements of the new basis in so(3)
    inverse = np.linalg.inv(basis)
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 1 / 3]), group=mf.SO(3))
    energy = inverse.T @ np.diag([1.0, 0.5, 1 / 3]) @ inverse
    system = lt.LiePoissonSystem(G.algebra, lt.Quadratic(energy), group=G, reconstruction="exp")
    mu = np.array([0.4, 0.8, -0.3])
    reference = lt.integrate(body, mu, (0.0, 2.0), 0.01)
    solution = lt.integrate(system, basis @ mu, (0.0, 2.0), 0.01)
    np.testing.assert_allclose(solution.x @ inverse.T, reference.x, atol=1e-10)
    np.testing.assert_allclose(solution.attitude[-1], reference.attitude[-1], atol=1e-4)  # two reconstructions


def test_equations_that_define_no_group_are_refused():
    cases = [
        (lambda A: A - 2.0 * jnp.eye(2), mf.ParameterError, "vanish at the identity"),
        (lambda A: A - jnp.eye(2), mf.ParameterError, "isolated"),
        (lambda A: (A[0, 1] - A[1, 0]) ** 2, mf.ParameterError, "derivative of f at the identity is zero"),
        (lambda A: A[0, 1] - A[1, 0] + (A[0, 0] - 1.0), mf.ClosureError, "leaves the span"),
        (lambda A: jnp.stack([A[0, 1], A[1, 0], A[0, 0] + A[1, 1] - 2.0]), mf.ClosureError, "not a group"),
    ]
    for f, error, message in cases:
        with pytest.raises(error, match=message):
            mf.MatrixGroup.from_equations(f, 2)


def test_sums_carry_the_invariants_of_their_summands():
    g = mf.direct_sum(mf.patera("A3,3"), mf.patera("A2"), mf.patera("A3,2"))
    assert (len(g.invariants), g.index(), len(g.leading_casimirs())) == (2, 2, 2)
