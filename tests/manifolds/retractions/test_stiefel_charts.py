"""Charts of Stiefel manifolds: inverses of long steps, derivatives, orders by hand, and NumPy's decompositions."""

import jax
import numpy as np
import pytest
import scipy.linalg

import manifolds as mf

SPACES = [mf.Stiefel(4, 2), mf.Stiefel(5, 3), mf.Stiefel(3, 1)]
ORDERS = {"qr": 1, "polar": 1, "cayley": 2}  # by hand, in the canonical metric
each_chart = pytest.mark.parametrize("kind", ORDERS)


def sample(space, length, seed=0):
    z = np.asarray(space.random(seed, (3,)))
    c = np.random.default_rng(seed).standard_normal((3, space.dim))
    return z, np.asarray(space.from_coordinates(z, length * c / np.linalg.norm(c, axis=1, keepdims=True)))


@pytest.mark.sampled(3)
@each_chart
@pytest.mark.parametrize("space", SPACES, ids=lambda space: space.name)
def test_inverse_gives_back_steps_of_any_length(kind, space):
    chart = mf.retraction(space, kind)
    for length in (0.3, 5.0):
        z, v = sample(space, length)
        x = np.asarray(chart.point(z, v))
        assert bool(np.all(space.belongs(x)))
        np.testing.assert_allclose(chart.vector(z, x), v, atol=2e-13 * max(1.0, length**2))  # at most 3e-14 seen


@pytest.mark.sampled(1)
@each_chart
def test_derivative_at_zero_is_the_identity(kind):
    space = SPACES[0]
    chart = mf.retraction(space, kind)
    z, v = sample(space, 1.0)
    np.testing.assert_allclose(chart.point(z, 0.0 * v), z, atol=1e-15)
    slope = jax.jvp(lambda t: chart.point(z, t * v), (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, v, atol=1e-14)


@pytest.mark.sampled(1)
@each_chart
def test_order_is_the_stated_one(kind):
    space = SPACES[1]
    chart = mf.retraction(space, kind)
    assert chart.order == ORDERS[kind]
    sizes, errors = np.array([0.08, 0.04, 0.02]), []
    for size in sizes:
        z, v = sample(space, size)
        errors.append(np.abs(np.asarray(chart.point(z, v)) - space.exp(z, v)).max())
    slope = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert abs(slope - (ORDERS[kind] + 1)) < 0.1


def test_points_are_those_of_the_decompositions_of_numpy():
    space = mf.Stiefel(5, 3)
    z, v = sample(space, 1.5)
    for i in range(3):
        q, r = np.linalg.qr(z[i] + v[i])
        np.testing.assert_allclose(mf.QRRetraction(space).point(z, v)[i], q * np.sign(np.diag(r)), atol=1e-14)
        np.testing.assert_allclose(
            mf.PolarRetraction(space).point(z, v)[i], scipy.linalg.polar(z[i] + v[i])[0], atol=1e-14
        )


@pytest.mark.sampled(1)
@each_chart
def test_maps_are_traced_and_other_spaces_refused(kind):
    space = SPACES[0]
    chart = mf.retraction(space, kind)
    z, v = sample(space, 0.5)
    x = jax.jit(jax.vmap(chart.point))(z, v)
    np.testing.assert_allclose(jax.jit(jax.vmap(chart.vector))(z, x), v, atol=1e-13)
    if kind != "cayley":
        with pytest.raises(mf.SpaceError, match="Stiefel"):
            mf.retraction(mf.Sphere(2), kind)


def test_far_points_have_no_vector():
    space = mf.Stiefel(4, 2)
    z = np.eye(4, 2)
    for kind in ("qr", "polar"):
        with pytest.raises(mf.DomainError):
            mf.retraction(space, kind).vector(z, -z)
