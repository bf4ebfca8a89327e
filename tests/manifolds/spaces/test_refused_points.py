"""Refusals of spaces: points and vectors off the space, the cut locus, and arrays of the wrong kind."""

import numpy as np
import pytest

import manifolds as mf

NORTH = np.array([0.0, 0.0, 1.0])


def test_a_point_off_the_space():
    space = mf.Sphere(2)
    with pytest.raises(
        mf.OffManifoldError, match=r"S\^2: x\[1\] is off the space: residual 1, tolerance 1e-08; .*project=True"
    ) as info:
        space.point([NORTH, 2 * NORTH])
    assert (info.value.residual, info.value.tolerance) == (1.0, 1e-8)
    assert isinstance(info.value, ValueError)
    assert np.array_equal(space.point(2 * NORTH, project=True), NORTH)
    assert np.array_equal(space.point(1.001 * NORTH, tolerance=0.01), 1.001 * NORTH)
    with pytest.raises(mf.OffManifoldError, match="y is off the space"):
        space.log(NORTH, 2 * NORTH)
    with pytest.raises(mf.OffManifoldError, match="residual nan, as it is not finite"):
        space.point([np.nan, 0.0, 1.0])
    with pytest.raises(mf.DomainError, match="no point of the space is nearest"):
        space.point(0 * NORTH, project=True)
    for other_space, x, message in [
        (mf.Hyperbolic(2), [-1.0, 0.0, 0.0], "residual inf"),
        (mf.SPD(2), np.diag([1.0, -0.5]), "not positive definite, with the least eigenvalue -0.5"),
        (mf.SPD(2), [[1.0, 0.1], [0.0, 1.0]], "residual 0.1"),
        (mf.SpecialOrthogonal(3), np.diag([1.0, 1.0, -1.0]), "residual 2"),
        (mf.Sphere(2) ** 2, [NORTH, 1.5 * NORTH], "residual 0.5"),
    ]:
        with pytest.raises(mf.OffManifoldError, match=message):
            other_space.point(x)
    for other_space, x in [(mf.SPD(2), np.diag([1.0, -0.5])), (mf.SpecialOrthogonal(3), np.diag([1.0, 1.0, -1.0]))]:
        with pytest.raises(mf.DomainError, match="no point of the space"):
            other_space.project(x)


def test_a_vector_that_is_not_tangent():
    space = mf.Sphere(2)
    with pytest.raises(
        mf.OffManifoldError, match=r"v\[0\] is not tangent at x: residual 1, .* project_tangent\(x, v\)"
    ):
        space.exp(NORTH, [NORTH, 0 * NORTH])
    with pytest.raises(mf.OffManifoldError, match="u is not tangent"):
        space.transport(NORTH, 0 * NORTH, NORTH)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("space", "x", "y", "message"),
    [
        (mf.Sphere(2), NORTH, -NORTH, r"S\^2: log\(x, y\) is not defined: y is within 0 of the antipode"),
        (mf.SpecialOrthogonal(4), np.eye(4), -np.eye(4), r"x\^-1 y has the eigenvalue -1.* below pi"),
        (mf.SpecialUnitary(2), np.eye(2), -np.eye(2), r"SU\(2\): log\(x, y\) is not defined"),
        (mf.Sphere(2) ** 2, [NORTH, NORTH], [NORTH, -NORTH], r"in copy 1, y is within 0 of the antipode"),
        (mf.Euclidean(1) * mf.Sphere(2), [0, *NORTH], [0, *-NORTH], r"in factor 1, S\^2, y is within 0"),
        pytest.param(
            mf.Stiefel(3, 2),
            np.eye(3)[:, :2],
            -np.eye(3)[:, :2],
            r"no geodesic shorter than 3\.14159",
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda case: getattr(case, "name", ""),
)
def test_points_at_the_cut_locus(space, x, y, message):
    with pytest.raises(mf.DomainError, match=message):
        space.log(x, y)


def test_arrays_of_the_wrong_kind():
    space = mf.Sphere(2)
    with pytest.raises(mf.ShapeError, match=r"x must have the shape \(\.\.\., 3\) for S\^2, but its shape is \(2,\)"):
        space.exp([1.0, 0.0], [0.0, 1.0])
    with pytest.raises(mf.ComponentError, match="x must be real"):
        space.point(1j * NORTH)
    with pytest.raises(mf.ShapeError, match="c must have last axis 2"):
        space.from_coordinates(NORTH, [1.0, 2.0, 3.0])
    with pytest.raises(mf.ParameterError, match="n must be at least 1"):
        mf.Sphere(0)
    with pytest.raises(mf.ParameterError, match="use SpecialOrthogonal"):
        mf.Stiefel(3, 3)
    with pytest.raises(mf.ParameterError, match="length must be a positive number"):
        mf.SpecialEuclidean(3, -1.0)
    with pytest.raises(mf.SpaceError, match="must be state spaces"):
        mf.Product(mf.Sphere(2), 3)
    with pytest.raises(TypeError):
        mf.Sphere(2) * 3
