"""Casimirs by traces of powers: invariance, independence, number and degrees, also compared to linear algebra."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from manifolds.algebras import polynomial_casimirs as module
from manifolds.algebras.casimirs import fundamental_invariants
from manifolds.algebras.catalogue import _OCTONIONS
from tests.cases import slow_case


def unitary(n):
    return mf.LieAlgebra.from_matrices(np.concatenate([mf.su(n).basis, [1j * np.eye(n)]]), name=f"u({n})")


def remove_matrices(g):
    return mf.LieAlgebra.from_structure_constants(g.structure_constants, name=f"{g.name} by constants")


def change_to_random_basis(g):
    change = np.linalg.qr(np.random.default_rng(3).standard_normal((g.dim, g.dim)))[0]
    return mf.LieAlgebra.from_matrices(np.einsum("ba,aij->bij", change, g.basis), name=f"{g.name} moved")


DEGREES = {
    "g2": (mf.g2, (2, 6)),
    "su(3)": (lambda: mf.su(3), (2, 3)),
    "su(5)": (lambda: mf.su(5), (2, 3, 4, 5)),
    "so(5)": (lambda: mf.so(5), (2, 4)),
    "so(7)": (lambda: mf.so(7), (2, 4, 6)),
    "so(3,1)": (lambda: mf.so(3, 1), (2, 2)),
    "so(8)": (lambda: mf.so(8), (2, 4, 4, 6)),
    "so(10)": (lambda: mf.so(10), (2, 4, 5, 6, 8)),
    "so(3,3)": (lambda: mf.so(3, 3), (2, 3, 4)),
    "sl(5)": (lambda: mf.sl(5), (2, 3, 4, 5)),
    "sp(3)": (lambda: mf.sp(3), (2, 4, 6)),
    "gl(4)": (lambda: mf.gl(4), (1, 2, 3, 4)),
    "u(3)": (lambda: unitary(3), (1, 2, 3)),
    "su(3) + so(5)": (lambda: mf.direct_sum(mf.su(3), mf.so(5)), (2, 2, 3, 4)),
    "g2 moved": (lambda: change_to_random_basis(mf.g2()), (2, 6)),
    "g2 by constants": (lambda: remove_matrices(mf.g2()), (2, 6)),
    "su(5) by constants": (lambda: remove_matrices(mf.su(5)), (2, 3, 4, 5)),
    "sl(5) by constants": (lambda: remove_matrices(mf.sl(5)), (2, 3, 4, 5)),
}
"""Constructors and degrees of the fundamental invariants [Bourbaki, Lie, V, VI]; u(n) and gl(n) have degree 1 too."""


LARGE_ALGEBRAS = ("so(10)", "su(5) by constants", "sl(5) by constants")
"""Names of the algebras whose tests are slow."""


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "name",
    [
        slow_case(pytest.param(name, id=f"{name}-")) if name in LARGE_ALGEBRAS else pytest.param(name, id=f"{name}-")
        for name in DEGREES
    ],
)
def test_generators(name):
    make, degrees = DEGREES[name]
    g = make()
    assert g.name == name
    generators = fundamental_invariants(g)
    assert tuple(F.degree for F in generators) == degrees
    assert len({str(F) for F in generators}) == len(generators) == g.casimir_count()
    mu = np.random.default_rng(7).standard_normal(g.dim)
    gradients = np.array([np.asarray(jax.grad(F)(jnp.asarray(mu))) for F in generators])
    gradients /= np.linalg.norm(gradients, axis=1)[:, None]
    motion = np.einsum("abc,na,c->nb", g.structure_constants, gradients, mu)
    assert np.linalg.norm(motion, axis=1).max() < 1e-14 * np.linalg.norm(mu)
    assert np.linalg.svd(gradients, compute_uv=False)[-1] > 1e-4


def test_what_has_too_many_monomials_for_linear_algebra():
    g = mf.g2()
    [sextic] = g.casimirs(6)
    assert isinstance(sextic, mf.TracePolynomial)
    assert (sextic.dim, sextic.degree, str(sextic)) == (14, 6, "tr(X**6)")
    [quintic] = mf.su(5).casimirs(5)
    assert quintic.degree == 5
    quartic, pfaffian = mf.so(8).casimirs(4)
    assert str(quartic) == "tr(X**4)"
    assert isinstance(pfaffian, mf.Polynomial)
    assert len(pfaffian.terms) == 105
    assert all(c.denominator == 1 for c in pfaffian.coefficients)
    mu = np.random.default_rng(0).standard_normal(28)
    assert float(pfaffian(mu)) ** 2 == pytest.approx(np.linalg.det(mf.so(8).hat(mu)), rel=1e-12)
    assert mf.so(8).casimirs(5) == []  # known to be none
    assert [F.degree for F in mf.gl(5).casimirs(5)] == [5]


def test_they_are_those_of_linear_algebra(monkeypatch):
    """The quartics agree modulo products of lower degree and a factor, as the values at a few points show."""
    rng, g = np.random.default_rng(1), mf.so(5)
    mu = rng.standard_normal((6, g.dim))
    [quadratic], [quartic] = g.casimirs(2), g.casimirs(4)
    trace_casimir = fundamental_invariants(g)[1]
    columns = np.column_stack([trace_casimir(mu), quartic(mu), quadratic(mu) ** 2])
    assert np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)[-1] < 1e-14
    monkeypatch.setattr(module, "MAX_MONOMIAL_COUNT", 100)
    module.new_casimirs.cache_clear()
    try:
        assert g.casimirs(4) == [trace_casimir]
    finally:
        module.new_casimirs.cache_clear()


def test_written_out():
    """The expansion of a trace has the coefficients found by linear algebra, and the values of the trace."""
    g = mf.su(3)
    [cubic] = g.casimirs(3)
    polynomial = fundamental_invariants(g)[1].expanded()
    factor = polynomial.coefficients[0] / cubic.coefficients[0]
    assert np.array_equal(polynomial.exponents, cubic.exponents)
    np.testing.assert_allclose(polynomial.coefficients, factor * np.array(cubic.coefficients), rtol=1e-13)
    [sextic] = mf.g2().casimirs(6)
    mu = np.random.default_rng(2).standard_normal((3, 14))
    np.testing.assert_allclose(sextic.expanded()(mu), sextic(mu), rtol=1e-12)
    with pytest.raises(mf.LieAlgebraError, match="more than the 200000 that are written out"):
        fundamental_invariants(mf.so(8))[-1].expanded()


def test_a_trace_is_like_a_polynomial():
    [sextic] = mf.g2().casimirs(6)
    equal_trace = mf.TracePolynomial(sextic.matrices, 6, sextic.weight)
    assert equal_trace == sextic
    assert hash(equal_trace) == hash(sextic)
    assert equal_trace != mf.TracePolynomial(sextic.matrices, 5)
    assert jax.tree.leaves(sextic) == []
    mu = np.random.default_rng(4).standard_normal((2, 3, 14))
    values = jax.jit(lambda F, mu: F(mu))(sextic, mu)
    assert values.shape == (2, 3)
    assert values[1, 2] == pytest.approx(float(sextic(mu[1, 2])), rel=1e-13)
    gradient = jax.grad(sextic)(jnp.asarray(mu[0, 0]))
    assert mu[0, 0] @ gradient == pytest.approx(6 * float(sextic(mu[0, 0])), rel=1e-12)  # Euler
    hessian = jax.hessian(sextic)(jnp.zeros(14))
    assert not np.asarray(hessian).any()
    assert repr(sextic) == "<TracePolynomial tr(X**6), X of shape (7, 7)>"
    with pytest.raises(dataclasses.FrozenInstanceError):
        sextic.degree = 2
    with pytest.raises(mf.ShapeError, match="last axis 14"):
        sextic(np.zeros(3))
    with pytest.raises(mf.ShapeError, match=r"shape \(dim, m, m\)"):
        mf.TracePolynomial(np.zeros((2, 3)), 2)
    with pytest.raises(mf.ShapeError, match="weight"):
        mf.TracePolynomial(np.zeros((2, 3, 3)), 2, np.eye(2))


@pytest.mark.parametrize("g", [mf.se(3), mf.heisenberg(1), mf.aff(2), mf.galilei(3)], ids=lambda g: g.name)
def test_none_without_a_nondegenerate_trace_form(g):
    assert fundamental_invariants(g) is None


def test_g2():
    """The matrices preserve a three-form of R^7, and a cross product: |x × y|^2 = |x|^2 |y|^2 - (x·y)^2."""
    g = mf.g2()
    assert g.dim == 14
    assert g.rational_constants.denominator == 1
    assert g.killing_signature() == (0, 14, 0)
    form = np.zeros((7, 7, 7))
    for i, j, k, sign in _OCTONIONS:
        for p, q, r in ((i, j, k), (j, k, i), (k, i, j)):
            form[p, q, r], form[q, p, r] = sign, -sign
    x, y = np.random.default_rng(6).standard_normal((2, 7))
    product = np.einsum("ijk,i,j->k", form, x, y)
    assert product @ product == pytest.approx((x @ x) * (y @ y) - (x @ y) ** 2, rel=1e-14)
    for X in g.basis:
        assert np.array_equal(X, -X.T)
        derivative = np.einsum("ijk,i->jk", form, X @ x) + np.einsum("ijk,i,jl->lk", form, x, X)
        assert np.abs(derivative + np.einsum("ijk,i,kl->jl", form, x, X)).max() < 1e-14
