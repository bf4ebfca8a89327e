"""Coordinates around a point: maps of vectors and covectors; vectors carried along charts; flat vectors."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import manifolds as mf

S2 = mf.Sphere(2)
SO3 = mf.SpecialOrthogonal(3)


def is_close(a, b, tolerance=1e-14) -> bool:
    """Return True if the arrays agree to rounding of numbers of order one; at most 4e-15 seen."""
    return float(np.abs(np.asarray(a) - np.asarray(b)).max()) <= tolerance


CHARTS = [
    pytest.param(mf.retraction(S2 * mf.Euclidean(2), "exp"), id="product"),
    pytest.param(mf.retraction(SO3, "cayley"), id="cayley"),
    pytest.param(mf.retraction(S2**2, "exp"), id="power", marks=pytest.mark.slow),
    pytest.param(mf.retraction(mf.SPD(2), "exp"), id="SPD(2)", marks=pytest.mark.slow),
    pytest.param(mf.retraction(mf.SPD(2), "euclidean"), id="SPD(2)-euclidean", marks=pytest.mark.slow),
    pytest.param(mf.retraction(mf.SpecialEuclidean(3), "group_exp"), id="SE(3)", marks=pytest.mark.slow),
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("chart", CHARTS)
def test_vectors_and_covectors_in_coordinates(chart):
    """``lower`` inverts the derivative of the chart, ``lift`` is the transpose; at the centre both are those of the
    frame."""
    space = chart.space
    z = space.random(0)
    c, w, alpha = 0.3 * np.random.default_rng(0).standard_normal((3, space.dim))

    @jax.jit
    def everything(z, c, w, alpha):
        coordinates = mf.coordinates_around(chart, z)
        point, velocity = jax.jvp(coordinates.point, (c,), (w,))
        place, centre = coordinates.at(c), coordinates.centre()
        pairings = space._pair(place.lift(alpha), velocity), space._pair(centre.lift(alpha), coordinates.vector(w))
        return (
            point,
            place.point,
            place.lower(velocity),
            pairings,
            centre.lower(coordinates.vector(w)),
            coordinates.at(0 * c)[0],
        )

    point, place_point, lowered_velocity, pairings, lowered_at_centre, centre = everything(z, c, w, alpha)
    assert is_close(point, place_point)
    assert is_close(lowered_velocity, w)
    assert is_close(pairings, np.dot(alpha, w))
    assert is_close(lowered_at_centre, w)
    assert is_close(centre, z)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("chart", CHARTS)
def test_vectors_carried_along(chart):
    space = chart.space
    z = space.random(1)
    v, u = space.from_coordinates(z, 0.4 * np.random.default_rng(1).standard_normal((2, space.dim)))
    x = chart.point(z, v)
    return_vector, carried_u = -chart.carry(z, v, v), chart.carry(z, v, u)
    assert is_close(chart.point(x, return_vector), z)
    assert is_close(chart.carry(x, return_vector, carried_u), u)


def test_flat_vectors():
    space = mf.SpecialUnitary(2)
    x = space.random(0, (3,))
    vectors = space.to_vector(x)
    assert vectors.shape == (3, space.size) == (3, 8)
    assert vectors.dtype == np.float64
    assert is_close(space.from_vector(vectors), x, 0.0)
    with pytest.raises(mf.ShapeError, match="last axis 8"):
        space.from_vector(vectors[:, :4])
