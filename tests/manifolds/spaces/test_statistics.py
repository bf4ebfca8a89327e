"""Fréchet means and dispersions, against geomstats and what defines them."""

import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf

SPACES = [mf.Sphere(2), mf.SpecialOrthogonal(3), mf.SPD(3), mf.Hyperbolic(2)]


def cloud(space, seed, size=12, scale=0.4):
    rng = np.random.default_rng(seed)
    centre = space.random(seed)
    return space.exp(centre, space.from_coordinates(centre, scale * rng.standard_normal((size, space.dim))))


def twin(space):
    from geomstats.geometry.hyperboloid import Hyperboloid
    from geomstats.geometry.hypersphere import Hypersphere
    from geomstats.geometry.spd_matrices import SPDAffineMetric, SPDMatrices
    from geomstats.geometry.special_orthogonal import SpecialOrthogonal

    if isinstance(space, mf.SPD):
        found = SPDMatrices(n=3, equip=False)
        found.equip_with_metric(SPDAffineMetric)
        return found
    if isinstance(space, mf.SpecialOrthogonal):
        return SpecialOrthogonal(n=3, point_type="matrix")
    return (Hypersphere if isinstance(space, mf.Sphere) else Hyperboloid)(dim=2)


@pytest.mark.sampled("S^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_the_mean_is_that_of_geomstats(space):
    """To the accuracy of its descent; and by its logarithms ours is stationary to rounding."""
    from geomstats.learning.frechet_mean import FrechetMean

    points, other = np.asarray(cloud(space, 1)), twin(space)
    mean = np.asarray(mf.frechet_mean(space, points))
    estimator = FrechetMean(other).set(epsilon=1e-12, max_iter=200)
    assert np.abs(mean - estimator.fit(points).estimate_).max() < 1e-5
    assert np.abs(other.metric.log(points, mean).mean(axis=0)).max() < 1e-13


@pytest.mark.sampled("H^2")
@pytest.mark.parametrize("space", SPACES, ids=lambda s: s.name)
def test_no_point_nearby_is_better(space):
    rng, points = np.random.default_rng(0), cloud(space, 2)
    weights = rng.uniform(0.1, 1.0, len(points))
    mean = mf.frechet_mean(space, points, weights)
    least = mf.dispersion(space, points, weights)
    assert least == pytest.approx(float(mf.dispersion(space, points, weights, mean)), rel=1e-13)
    for direction in rng.standard_normal((5, space.dim)):
        other = space.exp(mean, space.from_coordinates(mean, 0.05 * direction / np.linalg.norm(direction)))
        assert mf.dispersion(space, points, weights, other) > least + 1e-4


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
    with pytest.raises(mf.ParameterError, match="no points"):
        mf.frechet_mean(sphere, np.zeros((0, 3)))
    with pytest.raises(mf.ParameterError, match="one weight for each point"):
        mf.frechet_mean(sphere, poles, [1.0])
    with pytest.raises(mf.ParameterError, match="not negative"):
        mf.frechet_mean(sphere, poles, [1.0, -1.0])
    with pytest.raises(mf.OffManifoldError):
        mf.frechet_mean(sphere, 2.0 * poles)
