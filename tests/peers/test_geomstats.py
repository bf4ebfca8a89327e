"""Values and set-ups of the tests of geomstats, for the spaces that are here too.

Their data are in ``tests/data/*_data.py`` of geomstats 2.5 to 2.8. Points, vectors and expected values are theirs.
Where conventions differ, a comment says how.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from manifolds.matrices.exponential import expm
from manifolds.matrices.spectral import spectral
from tests.cases import max_abs

EXACT = 1e-14
"""Results of order one; at most 2e-15 seen."""

LN_2 = np.log(2.0)
SINH_1 = np.sinh(1.0)


def unit_vector(x):
    return np.asarray(x) / np.linalg.norm(x)


# -- spheres -----------------------------------------------------------------------------------------------------------


def test_hypersphere_distances():
    space = mf.Sphere(4)
    orthogonal_points = unit_vector([10.0, -2.0, -0.5, 0.0, 0.0]), unit_vector([2.0, 10.0, 0.0, 0.0, 0.0])
    assert abs(float(space.distance(*orthogonal_points)) - np.pi / 2) < EXACT
    a, b = unit_vector([10.0, -2.0, -5.0, 0.0, 0.0]), unit_vector([1.0, -20.0, -5.0, 0.0, 3.0])
    assert abs(float(space.distance(a, b)) - 1.24864502) < 1e-8
    poles = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # the diameter of these three
    assert abs(float(mf.Sphere(2).distance(poles[:, None], poles[None]).max()) - np.pi) < EXACT


def test_hypersphere_inner_product():
    space, x = mf.Sphere(4), np.eye(5)[4]
    assert float(space.inner(x, np.eye(5)[0], np.eye(5)[1])) == 0.0


def test_hypersphere_log_and_exp():
    space = mf.Sphere(4)
    x = unit_vector([1.0, 2.0, 3.0, 4.0, 6.0])
    y = unit_vector(x + 1e-4 * np.array([-1.0, -2.0, 1.0, 1.0, 0.1]))
    assert max_abs(space.exp(x, space.log(x, y)) - y) < EXACT
    x, v = np.eye(5)[0], np.pi / 6 * np.eye(5)[2]
    assert max_abs(space.log(x, space.exp(x, v)) - v) < EXACT
    x = unit_vector([16.0, -2.0, -2.5, 84.0, 3.0])
    v = space.project_tangent(x, np.array([9.0, 0.0, -1.0, -2.0, 1.0]))
    angle = float(space.norm(x, v)) % (2 * np.pi)  # once around and further
    assert abs(float(space.distance(x, space.exp(x, v))) - min(angle, 2 * np.pi - angle)) < 10 * EXACT


# -- positive definite matrices ----------------------------------------------------------------------------------------


def test_spd_membership():
    space = mf.SPD(2)
    cases = [([[3.0, -1.0], [-1.0, 3.0]], True), ([[1.0, 1.0], [2.0, 1.0]], False), (np.eye(2), True)]
    cases.append(([[1.0, -1.0], [0.0, 1.0]], False))
    assert [bool(space.belongs(np.array(x))) for x, _ in cases] == [expected for _, expected in cases]
    assert not bool(mf.SPD(3).belongs(np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])))
    assert max_abs(np.asarray(space.project(np.eye(2))) - np.eye(2)) == 0.0
    with pytest.raises(mf.DomainError):  # geomstats moves it to 1e-12 times the identity
        space.project(-np.diag([1.0, 2.0]))


def test_spd_exp_and_log():
    space, one = mf.SPD(2), np.eye(2)
    assert max_abs(space.exp(one, 2.0 * one) - np.exp(2.0) * one) < 10 * EXACT
    assert max_abs(space.log(2.0 * one, one) + 2.0 * LN_2 * one) < EXACT


@pytest.mark.parametrize(
    ("function", "base", "tangent", "expected"),
    [
        (
            lambda a: spectral(jnp.sqrt, a),
            [[1.0, 0.0, 0.0], [0.0, 2.5, 1.5], [0.0, 1.5, 2.5]],
            [[2.0, 1.0, 1.0], [1.0, 0.5, 0.5], [1.0, 0.5, 0.5]],
            [[1.0, 1 / 3, 1 / 3], [1 / 3, 0.125, 0.125], [1 / 3, 0.125, 0.125]],
        ),
        (
            lambda a: spectral(jnp.log, a),
            np.diag([1.0, 1.0, 4.0]),
            [[1.0, 1.0, 3.0], [1.0, 1.0, 3.0], [3.0, 3.0, 4.0]],
            [[1.0, 1.0, 2 * LN_2], [1.0, 1.0, 2 * LN_2], [2 * LN_2, 2 * LN_2, 1.0]],
        ),
        (
            expm,
            np.diag([1.0, 1.0, -1.0]),
            np.ones((3, 3)),
            [[np.e, np.e, SINH_1], [np.e, np.e, SINH_1], [SINH_1, SINH_1, 1 / np.e]],
        ),
    ],
    ids=["power 1/2", "log", "exp"],
)
def test_differentials_of_matrix_functions(function, base, tangent, expected):
    """At matrices with equal eigenvalues among them."""
    base, tangent = np.array(base), np.array(tangent)
    assert max_abs(jax.jit(lambda a, b: jax.jvp(function, (a,), (b,))[1])(base, tangent) - np.array(expected)) < EXACT


# -- rotations ---------------------------------------------------------------------------------------------------------


def plane_rotation(angle, sign=-1.0):
    return np.array([[np.cos(angle), sign * np.sin(angle)], [np.sin(angle), np.cos(angle)]])


VECTORS = {
    "0": np.zeros(3),
    "close to 0": 1e-10 * np.array([1.0, -1.0, 1.0]),
    "below pi": (np.pi - 1e-9) / np.sqrt(2.0) * np.array([0.0, 1.0, -1.0]),
    "pi": np.pi * np.array([1.0, 0.0, 0.0]),
    "above pi": (np.pi + 1e-9) / np.sqrt(3.0) * np.array([-1.0, 1.0, -1.0]),
    "between pi and 2 pi": (np.pi + 0.3) / np.sqrt(5.0) * np.array([-2.0, 1.0, 0.0]),
    "below 2 pi": (2 * np.pi - 1e-9) / np.sqrt(6.0) * np.array([2.0, 1.0, -1.0]),
    "2 pi": 2 * np.pi / np.sqrt(3.0) * np.array([1.0, 1.0, -1.0]),
    "above 2 pi": (2 * np.pi + 1e-9) / np.sqrt(2.0) * np.array([1.0, 0.0, -1.0]),
}


def test_rotations_members():
    space = mf.SpecialOrthogonal(2)
    assert bool(space.belongs(plane_rotation(np.pi / 3)))
    assert not bool(space.belongs(plane_rotation(np.pi / 3, sign=1.0)))
    assert [mf.SpecialOrthogonal(n).dim for n in (2, 3, 4)] == [1, 3, 6]
    assert max_abs(space.project(np.eye(2) + 1e-12) - np.eye(2)) < 1e-12
    with pytest.raises(mf.ManifoldsError):
        space.belongs(np.zeros((2, 3)))  # False there


@pytest.mark.parametrize("name", VECTORS)
def test_rotation_vectors(name):
    """Their regularized vector is that of the logarithm: of an angle below pi, or pi with either sign."""
    group, v = mf.SO(3), VECTORS[name]
    g = np.asarray(group.exp(v))
    w = np.asarray(group.log(g))
    angle, length = np.linalg.norm(v), np.linalg.norm(w)
    angle_mod_2pi = angle % (2 * np.pi)
    assert abs(length - min(angle_mod_2pi, 2 * np.pi - angle_mod_2pi)) < 1e-14
    assert max_abs(np.asarray(group.exp(w)) - g) < EXACT


def test_rotation_matrices_of_vectors():
    group = mf.SO(3)
    half, root = 0.5, np.sqrt(3.0) / 2
    expected = [[1.0, 0.0, 0.0], [0.0, half, -root], [0.0, root, half]]
    assert max_abs(group.exp([np.pi / 3, 0.0, 0.0]) - np.array(expected)) < EXACT
    for v in (1e-11 * np.array([12.0, 1.0, -81.0]), np.array([0.1, 1.3, -0.5])):
        skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        t = np.linalg.norm(v)
        rodrigues = np.eye(3) + np.sin(t) / t * skew + (2 * np.sin(t / 2) ** 2) / t**2 * skew @ skew
        assert max_abs(group.exp(v) - rodrigues) < EXACT
    c, s = np.cos(0.12), np.sin(0.12)
    assert (
        max_abs(group.log(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])) - np.array([0.12, 0.0, 0.0])) < EXACT
    )
    # so(2) begins with E_12, which turns the second axis to the first: the angle is theirs with the other sign
    assert max_abs(mf.SO(2).log(plane_rotation(2 * np.pi / 5)) + 2 * np.pi / 5) < EXACT


def test_antipodal_rotations_have_a_logarithm_here():
    """geomstats refuses it. Here one of the two is chosen, and leads there."""
    space, x = mf.SpecialOrthogonal(3), np.diag([1.0, -1.0, -1.0])
    assert max_abs(space.exp(x, space.log(x, np.eye(3))) - np.eye(3)) < EXACT


# -- rigid motions -----------------------------------------------------------------------------------------------------


def test_rigid_motions_members():
    def matrix(angle, corner=1.0):
        g = np.eye(3)
        g[:2, :2], g[:2, 2], g[2, 2] = plane_rotation(angle), [2.0, 3.0], corner
        return g

    space, g = mf.SpecialEuclidean(2), matrix(np.pi / 3)
    assert bool(space.belongs(g))
    assert not bool(space.belongs(matrix(np.pi / 3, corner=0.0)))
    t = np.pi / 3
    twist = np.array([[0.0, -t, 2.0], [t, 0.0, 3.0], [0.0, 0.0, 0.0]])
    assert max_abs(space.project_tangent(g, g @ twist) - g @ twist) < EXACT
    with pytest.raises(mf.OffManifoldError, match="not tangent"):
        space.norm(g, g @ (twist + np.diag([0.0, 0.0, 1.0])))
    assert [mf.SE(n).dim for n in (2, 3)] == [3, 6]


def test_rigid_motions_exp_and_log():
    """The vectors are theirs, (rotation, translation); translations up to 555 and angles up to 2 pi."""
    plane = mf.SE(2)
    shift = np.array([0.0, 0.6, 0.7])
    assert max_abs(plane.log(plane.exp(shift)) - shift) < EXACT
    group = mf.SE(3)
    shifts = [
        [1.0, 5.0, 2.0],
        [-100.0, 0.0, 2.0],
        [-10.2, 0.0, 2.6],
        [8.0, 555.0, -2.0],
        [1.0, 8.0, -10.0],
        [0.4, 5.0, 60.0],
    ]
    for v in VECTORS.values():
        for u in shifts:
            g = np.eye(4)
            g[:3, :3], g[:3, 3] = group_rotation(v), u
            roundtrip = np.asarray(group.exp(group.log(g)))
            assert max_abs(roundtrip - g) < 1e-14 * max(1.0, np.abs(u).max())


def group_rotation(v):
    return np.asarray(mf.SO(3).exp(v))


# -- subspaces and frames ----------------------------------------------------------------------------------------------

XY = np.diag([1.0, 1.0, 0.0])
YZ = np.diag([0.0, 1.0, 1.0])
XZ = np.diag([1.0, 0.0, 1.0])
"""Projectors on the coordinate planes."""

R_Y = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
R_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def test_grassmannian_exp_by_a_right_angle():
    space = mf.Grassmann(3, 2)
    assert bool(space.belongs(np.array([XY, YZ, XZ])).all())
    for x, turn, y in ((XY, R_Y, YZ), (YZ, R_Y, XY), (YZ, R_Z, XZ)):
        v = np.pi / 2 * (turn @ x - x @ turn)
        assert max_abs(np.asarray(space.exp(x, v)) - y) < EXACT
        assert abs(float(space.distance(x, y)) - np.pi / np.sqrt(2.0)) < EXACT  # where their logarithm is not unique


def test_stiefel_to_grassmannian():
    frame = np.array([[1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]) / np.sqrt(2.0)
    space = mf.Grassmann(3, 2)
    for n in (2, 3, 4):
        turned_frame = np.asarray(expm(jnp.asarray(np.pi / n * R_Z))) @ frame
        assert max_abs(space.subspace(turned_frame) - XY) < EXACT


@pytest.mark.slow
def test_stiefel_canonical_metric():
    """Their two frames differ by a turn of one column by pi/4."""
    space, a = mf.Stiefel(4, 3), np.eye(4)[:, :3]
    b = a.copy()
    b[:, 0] = np.array([1.0, 0.0, 0.0, 1.0]) / np.sqrt(2.0)
    assert abs(float(space.distance(a, b)) - np.pi / 4) < 1e-13
    assert max_abs(space.exp(a, space.log(a, b)) - b) < 1e-13
    with pytest.raises(mf.ParameterError, match="SpecialOrthogonal"):  # two sheets: refused there by the logarithm
        mf.Stiefel(3, 3)


# -- hyperbolic space --------------------------------------------------------------------------------------------------


def lift(*coordinates):
    return np.array([np.sqrt(1.0 + np.square(coordinates).sum()), *coordinates])


def from_ball(x):
    square = float(np.dot(x, x))
    return np.array([1.0 + square, *(2.0 * np.asarray(x))]) / (1.0 - square)


def test_hyperboloid_members():
    assert bool(mf.Hyperbolic(3).belongs(np.array([1.0, 0.0, 0.0, 0.0])))
    assert not bool(mf.Hyperbolic(2).belongs(np.array([0.5, 7.0, 3.0])))
    assert bool(mf.Hyperbolic(2).belongs(lift(0.5, 7.0)))
    with pytest.raises(mf.OffManifoldError):
        mf.Hyperbolic(3).point(np.array([-1.0, 1.0, 0.0, 0.0]))


def test_hyperboloid_inner_product_is_minkowski():
    space = mf.Hyperbolic(3)
    x = space.point(np.array([1.16563816, 0.36381045, -0.47000603, 0.07381469]), project=True)
    u, v = (space.project_tangent(x, np.array(w)) for w in ([10.0, 200.0, 1.0, 1.0], [11.0, 20.0, -21.0, 0.0]))
    minkowski = np.dot(u[1:], v[1:]) - u[0] * v[0]
    assert abs(float(space.inner(x, u, v)) / minkowski - 1.0) < 1e-14


def test_hyperboloid_distances():
    """In the ball and from coordinates; their test compares these two only."""
    space, a, b = mf.Hyperbolic(2), np.array([0.7, 0.2]), np.array([0.2, 0.2])
    expected = np.arccosh(1.0 + 2.0 * np.sum((a - b) ** 2) / ((1.0 - a @ a) * (1.0 - b @ b)))
    assert abs(float(space.distance(from_ball(a), from_ball(b))) - expected) < EXACT
    for a, b in (((10.0, 0.2), (1.0, 6.0)), ((10.0, 0.2, 3.0, 4.0), (1.0, 6.0, 2.0, 1.0))):
        x, y = lift(*a), lift(*b)
        distance = float(mf.Hyperbolic(len(a)).distance(x, y))
        assert abs(distance - np.arccosh(x[0] * y[0] - x[1:] @ y[1:])) < EXACT * 10
    x, y = lift(4.0, 0.2), lift(3.0, 3.0)
    assert max_abs(space.exp(x, space.log(x, y)) - y) < 50 * EXACT
