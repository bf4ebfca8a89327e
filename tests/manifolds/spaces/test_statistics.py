"""Fréchet means and dispersions, compared to geomstats and to their definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf

SPACES = [mf.Sphere(2), mf.SpecialOrthogonal(3), mf.SPD(3), mf.Hyperbolic(2)]


def cloud(space, seed, size=12):
    rng = np.random.default_rng(seed)
    centre = space.random(seed)
    return space.exp(centre, space.from_coordinates(centre, 0.4 * rng.standard_normal((size, space.dim))))


def twin(space):
    from geomstats.geometry.hyperboloid import Hyperboloid
    from geomstats.geometry.hypersphere import Hypersphere
    from geomstats.geometry.spd_matrices import SPDAffineMetric, SPDMatrices
    from geomstats.geometry.special_orthogonal import SpecialOrthogonal

    if isinstance(space, mf.SPD):
        spd = SPDMatrices(n=3, equip=False)
        spd.equip_with_metric(SPDAffineMetric)
        return spd
    if isinstance(space, mf.SpecialOrthogonal):
        return SpecialOrthogonal(n=3, point_type="matrix")
    return (Hypersphere if isinstance(space, mf.Sphere) else Hyperboloid)(dim=2)


@pytest.mark.sampled("S^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_the_mean_is_that_of_geomstats(space):
    """To the accuracy of its descent; by its logarithms our mean is stationary to rounding."""
    from geomstats.learning.frechet_mean import FrechetMean

    points, twin_space = np.asarray(cloud(space, 1)), twin(space)
    mean = np.asarray(mf.frechet_mean(space, points))
    estimator = FrechetMean(twin_space).set(epsilon=1e-12, max_iter=200)
    assert np.abs(mean - estimator.fit(points).estimate_).max() < 1e-5
    assert np.abs(twin_space.metric.log(points, mean).mean(axis=0)).max() < 1e-13


@pytest.mark.sampled("H^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_no_point_nearby_is_better(space):
    rng, points = np.random.default_rng(0), cloud(space, 2)
    weights = rng.uniform(0.1, 1.0, len(points))
    mean = mf.frechet_mean(space, points, weights)
    min_dispersion = mf.dispersion(space, points, weights)
    assert min_dispersion == pytest.approx(float(mf.dispersion(space, points, weights, mean)), rel=1e-13)
    for direction in rng.standard_normal((5, space.dim)):
        neighbour = space.exp(mean, space.from_coordinates(mean, 0.05 * direction / np.linalg.norm(direction)))
        assert mf.dispersion(space, points, weights, neighbour) > min_dispersion + 1e-4


@pytest.mark.sampled("S^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_means_and_dispersions_can_be_traced(space):
    """Results under jit and vmap equal those without; derivatives agree with differences along geodesics."""
    points, centre = cloud(space, 3, size=6), space.random(3)
    weights = jnp.arange(1.0, 7.0)
    mean = jax.jit(lambda x, w: mf.frechet_mean(space, x, w))(points, weights)
    np.testing.assert_allclose(mean, mf.frechet_mean(space, points, weights), rtol=0, atol=3e-15)
    jitted_dispersion = jax.jit(lambda x, w: mf.dispersion(space, x, w))
    assert float(jitted_dispersion(points, weights)) == pytest.approx(
        float(mf.dispersion(space, points, weights)), rel=1e-14
    )
    dispersions = jax.vmap(lambda w: mf.dispersion(space, points, w))(jnp.stack([weights, jnp.ones(6)]))
    np.testing.assert_allclose(
        dispersions, [jitted_dispersion(points, weights), mf.dispersion(space, points)], rtol=1e-14
    )

    rng = np.random.default_rng(4)
    directions = jnp.asarray(rng.standard_normal((6, space.dim)))
    points_at = jax.vmap(lambda x, c, s: space.exp(x, space.from_coordinates(x, s * c)), (0, 0, None))
    dispersion_at = lambda s: mf.dispersion(space, points_at(points, directions, s), weights)  # noqa: E731
    h = 1e-3
    value_below, value_at_zero, value_above = (float(dispersion_at(s)) for s in (-h, 0.0, h))
    first_derivative, second_derivative = jax.grad(dispersion_at)(0.0), jax.grad(jax.grad(dispersion_at))(0.0)
    assert float(first_derivative) == pytest.approx((value_above - value_below) / (2 * h), rel=1e-4, abs=1e-6)
    assert float(second_derivative) == pytest.approx((value_above - 2 * value_at_zero + value_below) / h**2, rel=1e-4)
    means = lambda s: mf.frechet_mean(space, points_at(points, directions, s), weights)  # noqa: E731
    slope = jax.jvp(means, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, (means(h) - means(-h)) / (2 * h), rtol=1e-3, atol=1e-4)
    dispersion_from_centre = jax.jit(lambda x: mf.dispersion(space, points, None, x))(centre)
    assert float(dispersion_from_centre) == pytest.approx(float(mf.dispersion(space, points, None, centre)), rel=1e-14)


def test_a_traced_mean_that_does_not_come_to_rest_is_nan():
    """Antipodal points have no mean; without tracing they raise an error."""
    pole = jnp.array([0.0, 0.0, 1.0])
    assert np.isnan(jax.jit(lambda x: mf.frechet_mean(mf.Sphere(2), x))(jnp.stack([pole, -pole]))).all()
    with pytest.raises(mf.ManifoldsError):
        mf.frechet_mean(mf.Sphere(2), jnp.stack([pole, -pole]))


@pytest.mark.slow
def test_closed_forms():
    """Rotations about one axis by angles, and points of R^2."""
    angles = np.array([0.1, 0.4, 1.0])
    turns = mf.SO(3).exp(angles[:, None] * np.array([0.0, 0.6, 0.8]))
    space = mf.SpecialOrthogonal(3)
    assert np.abs(mf.frechet_mean(space, turns) - mf.SO(3).exp(0.5 * np.array([0.0, 0.6, 0.8]))).max() < 1e-14
    assert float(mf.dispersion(space, turns)) == pytest.approx(angles.var(), rel=1e-13)
    plane = np.array([[0.0, 1.0], [2.0, 5.0]])
    assert np.array_equal(mf.frechet_mean(mf.Euclidean(2), plane, [3.0, 1.0]), [0.5, 2.0])


def test_what_has_no_mean():
    sphere = mf.Sphere(2)
    poles = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    with pytest.raises(mf.DomainError, match="antipode"):
        mf.frechet_mean(sphere, poles)
    with pytest.raises(mf.ParameterError, match="points must not be empty"):
        mf.frechet_mean(sphere, np.zeros((0, 3)))
    with pytest.raises(mf.ParameterError, match="one weight for each point"):
        mf.frechet_mean(sphere, poles, [1.0])
    with pytest.raises(mf.ParameterError, match="not negative"):
        mf.frechet_mean(sphere, poles, [1.0, -1.0])
    with pytest.raises(mf.OffManifoldError):
        mf.frechet_mean(sphere, 2.0 * poles)
