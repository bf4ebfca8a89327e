"""Values and set-ups of the tests of Manifolds.jl, for the spaces that are here too.

Their tests are in ``test/manifolds/*.jl`` of Manifolds.jl 0.8 to 0.10. The metric of their rotations is ``tr(u^T v)``,
twice ours, so that their lengths are sqrt(2) times as large. The metric of their Grassmann manifolds is that of frames,
so that our lengths are sqrt(2) times as large. Their hyperbolic points have the coordinate of time last.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from manifolds.matrices.exponential import expm
from tests.cases import max_abs

EXACT = 1e-14
"""Results of order one; at most 2e-15 seen."""


# -- sphere ------------------------------------------------------------------------------------------------------------


def test_sphere():
    space, points = mf.Sphere(2), np.eye(3)
    assert space.injectivity_radius() == np.pi
    distances = np.asarray(space.distance(points[:, None], points[None]))
    assert max_abs(distances - np.pi / 2 * (1.0 - np.eye(3))) < EXACT
    v = np.asarray(space.log(points[0], points[1]))
    assert max_abs(v - np.pi / 2 * points[1]) < EXACT
    assert max_abs(np.asarray(space.transport(points[0], v, points[2])) - points[2]) < EXACT
    assert max_abs(np.asarray(space.transport(points[0], v, points[1])) + points[0]) < EXACT
    for x in ([1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0]):
        with pytest.raises(mf.ManifoldsError):
            space.point(np.array(x))
    with pytest.raises(mf.OffManifoldError):
        space.norm(points[0], points[0])


def test_sphere_antipodes_have_a_distance_but_no_logarithm_here():
    """Manifolds.jl takes one of all the geodesics."""
    space, x = mf.Sphere(2), np.array([1.0, 0.0, 0.0])
    assert abs(float(space.distance(x, -x)) - np.pi) < EXACT
    with pytest.raises(mf.DomainError, match="antipode"):
        space.log(x, -x)


# -- hyperbolic space --------------------------------------------------------------------------------------------------

FIVE_POINTS = np.array([[1.0, 0.0, 0.0], *([np.sqrt(2.0), a, b] for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)))])


def test_hyperbolic():
    space = mf.Hyperbolic(2)
    assert space.injectivity_radius() == np.inf
    assert abs(float(space.distance(FIVE_POINTS[0], FIVE_POINTS[1])) - np.arcsinh(1.0)) < EXACT
    assert abs(float(space.distance(FIVE_POINTS[1], FIVE_POINTS[3])) - np.arccosh(2.0)) < EXACT
    v = np.asarray(space.log(FIVE_POINTS[0], FIVE_POINTS[1]))
    assert max_abs(v - np.arcsinh(1.0) * np.array([0.0, 1.0, 0.0])) < EXACT
    frame = np.asarray(space.frame(FIVE_POINTS[1]))
    x = np.broadcast_to(FIVE_POINTS[1], (2, 2, 3))
    inner = np.asarray(space.inner(x, np.broadcast_to(frame[:, None], x.shape), np.broadcast_to(frame[None], x.shape)))
    assert max_abs(inner - np.eye(2)) < EXACT


def test_hyperbolic_mean():
    assert max_abs(mf.frechet_mean(mf.Hyperbolic(2), FIVE_POINTS) - FIVE_POINTS[0]) < EXACT  # 1e-4 there
    with pytest.raises(mf.ParameterError):
        mf.frechet_mean(mf.Hyperbolic(2), FIVE_POINTS, np.ones(6))


# -- Grassmann ---------------------------------------------------------------------------------------------------------

PLANE = np.diag([1.0, 1.0, 0.0])
TANGENT = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0]])


def test_grassmann_projectors():
    space = mf.Grassmann(3, 2)
    assert space.dim == 2
    assert abs(space.injectivity_radius() - np.sqrt(2.0) * np.pi / 2) < EXACT
    turn = np.asarray(expm(jnp.asarray(TANGENT @ PLANE - PLANE @ TANGENT)))
    assert max_abs(space.exp(PLANE, TANGENT) - turn @ PLANE @ turn.T) < EXACT
    inverse_turn = np.asarray(expm(jnp.asarray(PLANE @ TANGENT - TANGENT @ PLANE)))
    assert max_abs(space.transport(PLANE, -TANGENT, TANGENT) - inverse_turn @ TANGENT @ inverse_turn.T) < EXACT
    for x in ([[1, 0, 0], [0, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 0, 0], [0, 1, 0]], [[0, 1, 0], [0, 1, 0], [0, 0, 0]]):
        with pytest.raises(mf.OffManifoldError):
            space.point(np.array(x, dtype=float))
    for v in ([[0, 0, 1], [0, 0, 1], [1, 0, 0]], np.ones((3, 3))):
        with pytest.raises(mf.OffManifoldError):
            space.norm(PLANE, np.array(v, dtype=float))


def test_grassmann_lengths():
    """Their vector ``[0 0; 0 0; 0 1]`` at the plane has the length 1, and turns one of its lines by one radian."""
    space, tangent = mf.Grassmann(3, 2), np.zeros((3, 3))
    tangent[2, 1] = tangent[1, 2] = 1.0
    y = np.asarray(space.exp(PLANE, tangent))
    expected = space.subspace(np.array([[1.0, 0.0], [0.0, np.cos(1.0)], [0.0, np.sin(1.0)]]))
    assert max_abs(y - np.asarray(expected)) < EXACT
    assert abs(float(space.distance(PLANE, y)) - np.sqrt(2.0)) < EXACT
    assert max_abs(np.asarray(space.log(PLANE, y)) - tangent) < EXACT


# -- rotations ---------------------------------------------------------------------------------------------------------


def test_rotations_of_the_plane():
    space = mf.SpecialOrthogonal(2)
    angles = np.array([0.0, np.pi / 2, 2 * np.pi / 3, np.pi / 4])
    points = np.array([[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in angles])
    distances = np.asarray(space.distance(points[:, None], points[None]))
    assert max_abs(distances - np.abs(angles[:, None] - angles[None])) < EXACT
    half = -np.eye(2)
    assert max_abs(space.exp(points[0], space.log(points[0], half)) - half) < EXACT
    for x in ([[2.0, 0.0], [0.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]]):
        with pytest.raises(mf.OffManifoldError):
            space.point(np.array(x))


@pytest.mark.parametrize("n", [3, pytest.param(4, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)])
def test_rotations_by_vectors_of_length_pi(n):
    """``distance(p, exp(log(p))) < 20 eps`` there, too."""
    space = mf.SpecialOrthogonal(n)
    x = np.asarray(space.random(42))
    c = np.random.default_rng(42).standard_normal(space.dim)
    y = np.asarray(space.exp(x, space.from_coordinates(x, np.pi * c / np.linalg.norm(c))))
    assert float(space.distance(y, space.exp(x, space.log(x, y)))) < 20 * np.finfo(float).eps


def test_projection_to_the_rotations():
    """Their matrix of 1 to 9 has no nearest rotation, as it is singular; there any of the nearest is taken."""
    space = mf.SpecialOrthogonal(3)
    with pytest.raises(mf.DomainError):
        space.project(np.arange(1.0, 10.0).reshape(3, 3).T)
    a = np.random.default_rng(44).standard_normal((3, 3))
    a *= np.sign(np.linalg.det(a))
    assert bool(space.belongs(space.project(a), EXACT))


# -- positive definite matrices ----------------------------------------------------------------------------------------


def spd_points():
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    return np.eye(3), np.diag([2.0, 2.0, 1.0]), turn @ np.diag([1.0, 2.0, 1.0]) @ turn.T


def test_spd():
    space, (p, q, r) = mf.SPD(3), spd_points()
    assert space.injectivity_radius() == np.inf
    assert abs(float(space.distance(p, q)) - np.sqrt(2.0) * np.log(2.0)) < EXACT
    assert abs(float(space.distance(p, r)) - np.log(2.0)) < EXACT
    for x in (np.diag([1.0, 0.0, 1.0]), [[2.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 4.0]]):
        with pytest.raises(mf.OffManifoldError):
            space.point(np.array(x))
    frame = np.asarray(space.frame(q))
    gram = np.einsum("aij,bji->ab", np.linalg.solve(q, frame), np.linalg.solve(q, frame))
    assert max_abs(gram - np.eye(6)) < EXACT
    v = np.array([[1.0, 1.0, 0.5], [1.0, 1.0, 0.0], [0.5, 0.0, 1.0]])
    assert max_abs(space.from_coordinates(q, space.coordinates(q, v)) - v) < EXACT


def test_spd_transport_and_the_pole_ladder():
    """The pole ladder is exact on symmetric spaces: the transport is that of two reflections in points."""
    space, (p, q, r) = mf.SPD(3), spd_points()
    u, v = np.asarray(space.log(p, r)), np.asarray(space.log(p, q))
    transported_u = np.asarray(space.transport(p, v, u))
    middle = np.asarray(space.midpoint(p, q))
    end = np.asarray(space.exp(p, u))
    mirrored_end = np.asarray(space.exp(middle, -np.asarray(space.log(middle, end))))
    assert max_abs(transported_u + np.asarray(space.log(q, mirrored_end))) < 10 * EXACT
    assert abs(float(space.norm(q, transported_u)) - float(space.norm(p, u))) < EXACT
    transported_v = np.asarray(space.transport(p, v, v))
    assert abs(float(space.inner(q, transported_u, transported_v)) - float(space.inner(p, u, v))) < EXACT


# -- frames ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_stiefel_canonical_metric():
    space = mf.Stiefel(3, 2)
    p = np.eye(3)[:, :2]
    u, v = np.zeros((2, 3, 2))
    u[2], v[2] = [1.0, 1.0], [-1.0, 1.0]
    for w in (u, v):
        q = space.exp(p, w)
        assert max_abs(space.log(p, q) - w) < 1e-13
        assert abs(float(space.distance(p, q)) - float(space.norm(p, w))) < 1e-13
    assert float(space.inner(p, u, v)) == 0.0
    assert abs(float(space.inner(p, u, 2 * u + 3 * v)) - 2 * float(space.inner(p, u, u))) < EXACT
    assert max_abs(space.project(np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])) - p) < EXACT
    frames_in_10d, start = mf.Stiefel(10, 2), np.eye(10)[:, :2]
    z = np.asarray(frames_in_10d.project_tangent(start, 0.2 * np.random.default_rng(42).standard_normal((10, 2))))
    assert max_abs(frames_in_10d.log(start, frames_in_10d.exp(start, z)) - z) < 1e-13
    w = np.asarray(frames_in_10d.project_tangent(start, np.random.default_rng(43).standard_normal((10, 2))))
    formula = np.trace(z.T @ (np.eye(10) - start @ start.T / 2) @ w)
    assert abs(float(frames_in_10d.inner(start, z, w)) - formula) < EXACT
