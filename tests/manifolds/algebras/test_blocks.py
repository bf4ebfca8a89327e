"""Copies of an algebra and direct sums by blocks, compared to equal algebras given by structure constants."""

import jax
import numpy as np
import pytest

import manifolds as mf
from manifolds.algebras.blocks import MAX_DIM_BY_CONSTANTS, direct_sum_by_constants, merged_direct_sum

MIXED_SUMMANDS = [mf.so(3), mf.so(3), mf.heisenberg(1), mf.sl(2), mf.so(3)]


@pytest.fixture(scope="module", params=["power", "mixed"])
def pair(request):
    if request.param == "power":
        return mf.so(3) ** 4, direct_sum_by_constants([mf.so(3)] * 4)
    return merged_direct_sum(MIXED_SUMMANDS), direct_sum_by_constants(MIXED_SUMMANDS)


def test_operations_are_those_of_the_constants(pair):
    g, by_constants = pair
    x, y, mu = np.random.default_rng(0).standard_normal((3, 2, 5, g.dim))
    for name, args in [("bracket", (x, y)), ("ad_star", (x, mu)), ("ad", (x,))]:
        np.testing.assert_allclose(getattr(g, name)(*args), getattr(by_constants, name)(*args), atol=1e-14)
    np.testing.assert_allclose(g.poisson_tensor(mu[0, 0]), by_constants.poisson_tensor(mu[0, 0]), atol=1e-14)
    block_action, dense_action = g.action(x[0, 0]), by_constants.action(x[0, 0])
    np.testing.assert_allclose(block_action.bracket(y[0, 0]), dense_action.bracket(y[0, 0]), atol=1e-14)
    np.testing.assert_allclose(block_action.ad_star(mu[0, 0]), dense_action.ad_star(mu[0, 0]), atol=1e-14)


def test_structure_is_that_of_the_constants(pair):
    g, dense = pair
    for question in (
        "is_abelian is_semisimple is_compact_type is_solvable is_nilpotent is_unimodular derived_series "
        "lower_central_series killing_signature casimir_count"
    ).split():
        assert getattr(g, question)() == getattr(dense, question)(), question
    np.testing.assert_array_equal(g.killing_form(), dense.killing_form())
    np.testing.assert_array_equal(g.structure_constants, dense.structure_constants)
    if g.is_semisimple():
        np.testing.assert_array_equal(g.cartan_involution(), dense.cartan_involution())
        x = np.random.default_rng(1).standard_normal(g.dim)
        np.testing.assert_allclose(g.killing_inner_product() @ x, dense.killing_inner_product() @ x, rtol=1e-15)


def test_casimirs_are_those_of_the_constants(pair):
    g, dense = pair
    for degree in (1, 2):
        assert set(g.casimirs(degree)) == set(dense.casimirs(degree))
        (mu,) = np.random.default_rng(2).standard_normal((1, g.dim))
        listed_values = sorted(float(F(mu)) for F in g.casimirs(degree))
        site_values = sorted(np.concatenate([np.zeros(0), *(F(mu) for F in g.site_casimirs(degree))]))
        np.testing.assert_allclose(site_values, listed_values, rtol=1e-15)


@pytest.mark.slow
def test_suite_holds_for_copies_and_for_sums(pair):
    assert mf.testing.check_algebra(pair[0], degree=2).passed


def test_elements_of_copies_have_the_shape_of_the_sites_or_are_flat():
    g = mf.sl(2) ** (2, 3)
    assert g.shape == (2, 3, 3)
    assert g.dim == 18
    assert g.sites == (2, 3)
    x, y = np.random.default_rng(3).standard_normal((2, 4, *g.shape))
    brackets = g.bracket(x, y)
    assert brackets.shape == (4, 2, 3, 3)
    np.testing.assert_allclose(brackets, mf.sl(2).bracket(x, y), atol=1e-15)
    flat_brackets = g.bracket(x.reshape(4, 18), y.reshape(4, 18))
    np.testing.assert_array_equal(flat_brackets, brackets.reshape(4, 18))
    np.testing.assert_allclose(jax.jit(jax.vmap(g.ad_star))(x, y), g.ad_star(x, y), atol=1e-14)
    (casimir,) = g.site_casimirs(2)
    assert casimir(x).shape == (4, 2, 3)


def test_copies_of_copies_have_the_sites_of_both():
    assert (mf.so(3) ** 2) ** 3 == mf.power(mf.so(3), (3, 2))
    assert mf.so(3) ** 2 != mf.so(3) ** 3
    assert hash(mf.so(3) ** 2) == hash(mf.power(mf.so(3), 2))
    mixed = merged_direct_sum(MIXED_SUMMANDS) ** 2
    x, y = np.random.default_rng(4).standard_normal((2, *mixed.shape))
    np.testing.assert_allclose(mixed.bracket(x, y), merged_direct_sum(MIXED_SUMMANDS).bracket(x, y), atol=1e-14)


def test_direct_sums_change_their_form_with_their_size_and_not_what_they_do():
    small_sum, large_sum = (mf.direct_sum(*[mf.so(3)] * n) for n in (13, 14))
    assert small_sum.dim <= MAX_DIM_BY_CONSTANTS < large_sum.dim
    assert not isinstance(small_sum, mf.DirectSum)
    assert isinstance(large_sum, mf.DirectSum)
    assert large_sum.blocks == ((mf.so(3), 14),)
    assert large_sum.shape == (42,)
    assert mf.direct_sum(small_sum, large_sum).blocks == ((small_sum, 1), (mf.so(3), 14))


def test_a_million_copies_take_no_array_of_constants():
    g = mf.so(3) ** 10**6
    assert g.casimir_count() == 10**6
    assert g.is_semisimple()
    assert g.killing_signature() == (0, 3 * 10**6, 0)
    x = np.random.default_rng(5).standard_normal(g.shape)
    assert g.bracket(x, x[::-1]).shape == x.shape
    ((name, total),) = g.leading_casimirs()
    assert name == "sum of mu1**2 + mu2**2 + mu3**2"
    assert float(total(x.ravel())) == pytest.approx((x**2).sum())


@pytest.mark.parametrize(
    ("attempt", "error", "message"),
    [
        (lambda: mf.so(3) ** 0, mf.ParameterError, "at least 1, got 0"),
        (lambda: mf.so(3) ** 2.5, mf.ParameterError, "must be an integer, got 2.5"),
        (lambda: mf.power(mf.so(3), ()), mf.ParameterError, "sites must not be empty"),
        (lambda: mf.power("so(3)", 2), mf.ParameterError, "got str"),
        (lambda: mf.so(3) ** (10**7, 10**7), mf.SizeError, "2.4e+06 GB"),
        (lambda: (mf.so(3) ** 10**5).structure_constants, mf.SizeError, "2.16e+08 GB"),
        (lambda: (mf.so(3) ** 10**6).killing_form(), mf.SizeError, "7.2e+04 GB"),
        (lambda: (mf.so(3) ** 10**4).casimirs(2), mf.LieAlgebraError, r"site_casimirs\(2\)"),
        (lambda: (mf.so(3) ** 4).bracket(np.zeros((3, 4)), np.zeros(12)), mf.ShapeError, r"\(\.\.\., 4, 3\)"),
        (lambda: (mf.so(3) ** 4).bracket(np.zeros(12) * 1j, np.zeros(12)), mf.ComponentError, "real"),
    ],
)
def test_refusals(attempt, error, message):
    with pytest.raises(error, match=message.replace("+", r"\+")):
        attempt()
