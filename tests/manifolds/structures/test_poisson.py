"""Poisson structures: the axioms, on Lie algebras and on R^2n, and controls that must fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import manifolds as mf
from tests.cases import ALGEBRAS, tolerance

seeds = st.integers(0, 10**6)
STRUCTURES = [mf.LiePoisson(g) for g in ALGEBRAS] + [mf.Canonical(1), mf.Canonical(3)]
each_structure = pytest.mark.parametrize("P", STRUCTURES, ids=lambda P: f"{type(P).__name__}-{P.dim}")


def functions(n, seed):
    a, b, c = np.random.default_rng(seed).standard_normal((3, n)) / np.sqrt(n)
    return (lambda x: jnp.sin(a @ x)), (lambda x: (b @ x) ** 2), (lambda x: jnp.exp(c @ x / 2))


@pytest.mark.sampled(2)
@each_structure
@given(seed=seeds)
def test_axioms(P, seed):
    x = np.random.default_rng(seed).standard_normal(P.dim)
    f, g, h = functions(P.dim, seed)
    tensor = np.asarray(P.tensor(x))
    assert np.array_equal(tensor, -tensor.T)
    assert float(P.jacobi_residual(x)) <= tolerance("axiom") * 10
    assert np.allclose(P.sharp(x, h_ := np.ones(P.dim)), tensor @ h_, atol=1e-13)
    fg = P.bracket(f, g)
    assert float(fg(x)) == pytest.approx(-float(P.bracket(g, f)(x)), abs=1e-12)
    leibniz = P.bracket(lambda y: f(y) * g(y), h)(x)
    assert float(leibniz) == pytest.approx(float(f(x) * P.bracket(g, h)(x) + g(x) * P.bracket(f, h)(x)), abs=1e-12)


@pytest.mark.parametrize(
    "P", [mf.LiePoisson(mf.se(3)), mf.LiePoisson(mf.sl(3)), mf.Canonical(2)], ids=["se3", "sl3", "T*R2"]
)
def test_jacobi_identity_of_the_bracket(P):
    x = np.random.default_rng(0).standard_normal(P.dim)
    f, g, h = functions(P.dim, 0)
    cyclic = sum(P.bracket(P.bracket(a, b), c)(x) for a, b, c in [(f, g, h), (g, h, f), (h, f, g)])
    assert abs(float(cyclic)) < 1e-12


def test_hamiltonian_fields():
    H = lambda x: 0.5 * x[1] ** 2 + jnp.cos(x[0])  # noqa: E731
    assert np.allclose(mf.Canonical(1).hamiltonian_vector_field(H)([0.3, 0.7]), [0.7, np.sin(0.3)])
    P, Omega = np.array([0.1, 0.7, -0.3]), np.array([2.0, 1.0, 0.5])
    field = mf.LiePoisson(mf.so(3)).hamiltonian_vector_field(lambda m: 0.5 * jnp.sum(Omega * m * m))
    assert np.allclose(field(P), np.cross(P, Omega * P))
    assert mf.LiePoisson(mf.so(3)).rank(P) == 2


def test_a_tensor_of_ones_own():
    P = mf.PoissonTensor(lambda x: jnp.array([[0.0, x[0]], [-x[0], 0.0]]), dim=2)  # in two dimensions any tensor is one
    assert float(P.jacobi_residual([0.4, 0.2])) == 0.0
    # {x1, x2} = x2, {x2, x3} = 1: v . curl v = 1 for the vector v of the tensor, so Jacobi fails
    no_jacobi_tensor = mf.PoissonTensor(
        lambda x: jnp.array([[0.0, x[1], 0.0], [-x[1], 0.0, 1.0], [0.0, -1.0, 0.0]]), dim=3
    )
    assert float(no_jacobi_tensor.jacobi_residual([0.4, 0.2, 1.0])) > 0.1
    with pytest.raises(mf.ShapeError):
        mf.PoissonTensor(np.zeros((2, 3)))
    with pytest.raises(mf.ParameterError):
        mf.Canonical(0)


LEAVES = [mf.LiePoisson(mf.su(3)), mf.LiePoisson(mf.so(5)), mf.LiePoisson(mf.u(2)), mf.DensityMatrices(3)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("P", LEAVES, ids=lambda P: f"{type(P).__name__}-{P.dim}")
def test_stages_on_a_leaf(P):
    """The spectrum is conserved for any covectors and long steps; the control has stages off the leaf."""
    rng, (A, b) = np.random.default_rng(3), two_stage_gauss()
    matrices = P.matrix if isinstance(P, mf.DensityMatrices) else lambda x: jnp.tensordot(x, dual_basis(P.algebra), 1)
    x, alpha = rng.standard_normal(P.dim), rng.standard_normal((2, P.dim))

    def end_point(points):
        return x + 0.7 * b @ np.stack([P.sharp(u, a) for u, a in zip(points, alpha, strict=True)])

    def spectrum(x):
        return np.sort(np.linalg.eigvals(matrices(x)).imag + np.linalg.eigvals(matrices(x)).real)

    points = P.stages_on_leaf(x, alpha, 0.7 * A)
    assert np.abs(spectrum(end_point(points)) - spectrum(x)).max() <= 2e-14
    assert np.abs(spectrum(end_point([x, x])) - spectrum(x)).max() >= 1e-3
    slopes = np.stack([P.sharp(u, a) for u, a in zip(P.stages_on_leaf(x, alpha, 1e-6 * A), alpha, strict=True)])
    assert np.abs(P.stages_on_leaf(x, alpha, 1e-6 * A) - (x + 1e-6 * A @ slopes)).max() <= 1e-10


@pytest.mark.sampled(2)
@pytest.mark.parametrize("P", LEAVES, ids=lambda P: f"{type(P).__name__}-{P.dim}")
def test_a_covector_that_carries_a_state(P):
    """The rate is that of the motion, at a covector that is not small; the control uses the covector itself as the
    rate."""
    rng = np.random.default_rng(4)
    x, covector, alpha = rng.standard_normal((3, P.dim))
    end = x + P.leaf_displacement(x, covector)
    rate = jax.jvp(lambda K: P.leaf_displacement(x, K), (covector,), (P.leaf_covector_rate(covector, alpha),))[1]
    assert np.abs(rate - P.sharp(end, alpha)).max() <= 1e-13 * np.abs(x).max() * np.abs(covector).max() ** 2
    if isinstance(P, mf.DensityMatrices):  # a constant that is added to the energy moves nothing
        constant = np.append(np.ones(P.size), np.zeros(P.dim - P.size))
        assert (
            np.abs(P.leaf_covector_rate(covector, alpha + 1e6 * constant) - P.leaf_covector_rate(covector, alpha)).max()
            <= 1e-8
        )
    assert np.abs(jax.jvp(lambda K: P.leaf_displacement(x, K), (covector,), (alpha,))[1] - rate).max() >= 1e-2


def two_stage_gauss():
    root = np.sqrt(3.0) / 6.0
    return np.array([[0.25, 0.25 - root], [0.25 + root, 0.25]]), np.array([0.5, 0.5])


def dual_basis(g):
    basis = np.asarray(g.basis)
    return np.tensordot(np.linalg.inv(np.einsum("aij,bji->ab", basis, basis).real), basis, 1)


def test_other_leaves_are_not_known():
    for P in (mf.LiePoisson(mf.se(3)), mf.LiePoisson(mf.g2()), mf.LiePoisson(mf.sl(3)), mf.LiePoisson(mf.su(20))):
        assert P.stages_on_leaf(np.ones(P.dim), np.ones((1, P.dim)), np.eye(1)) is None
        assert P.leaf_covector_rate(np.ones(P.dim), np.ones(P.dim)) is None
