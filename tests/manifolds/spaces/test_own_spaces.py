"""User-defined spaces, groups and charts, and manifolds from their equations: required members, and what follows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

HEISENBERG = mf.MatrixGroup("mine", mf.heisenberg(1), mf.Heisenberg(1).defect)
"""The Heisenberg group as a user would define it, with an algebra and a distance."""


def is_close(a, b, tolerance=1e-14) -> bool:
    """Return True if the arrays agree to rounding of numbers of order one; at most 3e-15 seen."""
    return float(np.abs(np.asarray(a) - np.asarray(b)).max()) <= tolerance


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Ellipsoid(mf.Space):
    """Space with the four required members alone; its projection is radial, not the nearest point."""

    axes: tuple[float, ...]
    name = "an ellipsoid"

    @property
    def dim(self):
        return len(self.axes) - 1

    @property
    def shape(self):
        return (len(self.axes),)

    def _project(self, x):
        return x / jnp.sqrt(((x / np.array(self.axes)) ** 2).sum(axis=-1, keepdims=True))


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class ConformalEllipsoid(Ellipsoid):
    """Ellipsoid with a metric of its own."""

    def _inner(self, x, u, v):
        return (u * v).sum(axis=-1) * (1.0 + x[..., 0] ** 2)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Stereographic(mf.Chart):
    """User-defined chart on the sphere: from the antipode of z onto the tangent plane."""

    space: mf.Space
    order = 2

    def _point(self, z, v):
        square = (v**2).sum(axis=-1, keepdims=True) / 4
        return (v + (1.0 - square) * z) / (1.0 + square)

    def _vector(self, z, x):
        height = (x * z).sum(axis=-1, keepdims=True)
        return 2.0 * (x - height * z) / (1.0 + height)


@pytest.mark.parametrize(
    "space", [pytest.param(Ellipsoid((1.0, 2.0, 3.0)), marks=pytest.mark.slow), ConformalEllipsoid((1, 2))]
)
def test_what_follows_from_a_projection(space):
    x, w, c = space.random(0, (2,)), np.ones((2, *space.shape)), np.random.default_rng(0).standard_normal(space.dim)
    normal = np.asarray(x) / np.array(space.axes) ** 2
    v = np.asarray(space.from_coordinates(x, np.stack([c, -c])))
    tangent_part = np.asarray(space.project_tangent(x, w))
    gradient = space.sharp(x, w)
    assert is_close((v * normal).sum(axis=-1), 0.0)
    assert is_close((tangent_part * normal).sum(axis=-1), 0.0)
    normal_part, unit = w - tangent_part, normal / np.linalg.norm(normal, axis=1, keepdims=True)
    assert is_close(
        normal_part, (normal_part * unit).sum(axis=1, keepdims=True) * unit
    )  # along the normal: the nearest
    assert is_close(space.coordinates(x, v), np.stack([c, -c]))
    assert is_close(space.norm(x, v), np.linalg.norm(c))
    assert is_close((space.flat(x, v) * v).sum(axis=-1), np.sum(c**2))
    assert is_close(space.inner(x, gradient, v), (w * v).sum(axis=-1))
    assert not bool(space.belongs(1.001 * x).any())
    with pytest.raises(mf.OffManifoldError, match=r"an ellipsoid: v\[0\] is not tangent"):
        space.norm(x, normal)


class CountedFromOne(mf.Space):
    """A sphere whose author counts components from one."""

    name, dim, shape = "a sphere counted from one", 2, (3,)

    def _project(self, x):
        return x / jnp.sqrt(x[..., 1] ** 2 + x[..., 2] ** 2 + x[..., 3] ** 2)[..., None]

    def _project_tangent(self, x, w):
        return w - (x * w).sum(axis=-1, keepdims=True) * x


def test_an_index_out_of_range_in_a_space_of_ones_own():
    with pytest.raises(IndexError, match="_project of CountedFromOne has the index 3 of an axis with 3"):
        CountedFromOne().point([1.0, 2.0, 2.0], project=True)


def test_a_space_without_geodesics():
    space = Ellipsoid((1.0, 2.0))
    x = space.random(0)
    assert not space.has_geodesics
    assert not (space * mf.Sphere(2)).has_geodesics
    assert (mf.Sphere(1) ** 2).has_geodesics
    for call in (lambda: space.exp(x, 0 * x), lambda: space.log(x, x), lambda: mf.retraction(space)):
        with pytest.raises(mf.SpaceError, match=r"Implement _exp, _log and _transport, or .*ProjectionRetraction"):
            call()
    R = mf.retraction(space, "projection")
    v = space.random_tangent(1, x, 0.4)
    assert is_close(R.vector(x, R.point(x, v)), v)
    assert is_close(R.differential(x, 0 * v, v), v)
    with pytest.raises(mf.DomainError, match=r"is not defined: the chart around x does not reach y"):
        R.vector(x, -x)


def test_a_chart_of_ones_own():
    """Two maps and an order define a chart: the midpoint is found by iteration, missing operations raise."""
    space = mf.Sphere(2)
    chart = Stereographic(space)
    z = space.random(0)
    v, w = space.random_tangent(1, z, 0.7), space.random_tangent(2, z)
    assert is_close(chart.vector(z, chart.point(z, v)), v)
    assert is_close(chart.differential(z, 0 * v, w), w)
    x, y = mf.MidpointRetraction(chart)(z, v)
    middle, velocity = mf.MidpointRetraction(chart).inverse(x, y)
    assert is_close(middle, z)
    assert is_close(velocity, v)
    with pytest.raises(mf.SpaceError, match="gives no _carry"):
        chart.carry(z, v, w)


@pytest.mark.slow
def test_a_group_of_ones_own_as_a_space():
    space = mf.GroupSpace(HEISENBERG, inner=np.diag([1.0, 4.0, 9.0]))
    assert (space.name, space.dim, space.shape) == ("mine", 3, (3, 3))
    assert space == mf.GroupSpace(HEISENBERG, inner=np.diag([1.0, 4.0, 9.0])) != mf.GroupSpace(HEISENBERG)
    x, xi = space.random(0), np.array([0.3, -0.2, 0.5])
    v = space.from_velocity(x, xi)
    assert is_close(space.norm(x, v), np.sqrt(0.09 + 4 * 0.04 + 9 * 0.25))
    assert is_close(space.exp(x, v), x @ HEISENBERG.exp(xi))
    assert is_close(space.log(x, space.exp(x, v)), v)
    assert is_close(mf.retraction(space, "cayley").point(x, v), x @ HEISENBERG.cayley(xi))
    assert is_close(space.project(x), x)
    with pytest.raises(mf.DomainError, match="no point of the space is nearest"):
        space.project(x + 0.1)  # it has no restore_map


def test_a_group_names_its_space():
    assert mf.retraction(HEISENBERG, "cayley").space == mf.GroupSpace(HEISENBERG)
    assert repr(mf.retraction(mf.SE(3), "cayley")) == "CayleyRetraction(SE(3))"
    with pytest.raises(mf.SpaceError, match=r"use GroupSpace\(group\)"):
        mf.CayleyRetraction(HEISENBERG)
    with pytest.raises(mf.SpaceError, match="must be a MatrixGroup, such as"):
        mf.GroupSpace(mf.so(3))
    for inner, message in [(np.eye(2), "symmetric matrix of shape"), (np.diag([1.0, 1.0, -2.0]), "the eigenvalue -2")]:
        with pytest.raises(mf.ParameterError, match=message):
            mf.GroupSpace(HEISENBERG, inner)


def test_a_chart_by_a_map_that_leaves_the_group():
    """The constructor raises an error with the residual; the control shows how far the map would leave the group."""
    group = mf.MatrixGroup("mine", mf.sl(3), lambda g: jnp.abs(jnp.linalg.det(g) - 1.0))
    with pytest.raises(mf.LieAlgebraError, match=r"misses by 0\.0\d+ ") as info:
        mf.retraction(group, "cayley")
    identity = np.eye(3)
    X = np.asarray(group.algebra.hat(np.ones(8) / 4))
    assert abs(np.linalg.det(np.linalg.solve(identity - X / 2, identity + X / 2)) - 1.0) > 1e-3
    assert info.value.residual > 1e-3
    with pytest.raises(mf.LieAlgebraError, match="has no cayley_map"):
        mf.retraction(replace(mf.SO(3), cayley_map=None), "cayley")


def square(x):
    return jnp.sum(x**2) - 1.0


def torus(x):
    return (jnp.sqrt(x[0] ** 2 + x[1] ** 2) - 2.0) ** 2 + x[2] ** 2 - 1.0


def test_a_sphere_from_its_equation():
    """The maps equal those of the sphere in closed form, also with other metrics."""
    space, sphere = mf.LevelSet(square, 3, name="ball's edge"), mf.Sphere(2)
    assert (space.name, space.dim, space.shape, space.metric) == ("ball's edge", 2, (3,), "induced")
    x = np.asarray(space.random(0, (2,)))
    assert np.abs(np.linalg.norm(x, axis=1) - 1.0).max() < 1e-15
    w = np.ones((2, 3))
    assert np.abs(space.project_tangent(x, w) - sphere.project_tangent(x, w)).max() < 1e-15
    assert np.abs(space.sharp(x, w) - sphere.sharp(x, w)).max() < 1e-15
    v = np.asarray(space.random_tangent(1, x[0]))
    assert np.abs(space.geodesic(x[0], v, steps=400) - sphere.exp(x[0], v)).max() < 1e-10  # 4e-12 seen
    g = np.diag([1.0, 2.0, 3.0])
    anisotropic_sphere = mf.LevelSet(square, 3, metric=g)
    gradient = np.asarray(anisotropic_sphere.sharp(x[0], w[0]))
    assert abs(gradient @ x[0]) < 1e-15
    assert abs(gradient @ g @ v - w[0] @ v) < 1e-14
    assert abs(float(anisotropic_sphere.inner(x[0], v, v)) - v @ g @ v) < 1e-14
    curved_sphere = mf.LevelSet(square, 3, metric=lambda x: jnp.diag(1.0 + x**2))
    assert abs(float(curved_sphere.inner(x[0], v, v)) - v @ np.diag(1.0 + x[0] ** 2) @ v) < 1e-14


@pytest.mark.slow
def test_the_suite_of_spaces():
    mf.testing.check_space(mf.LevelSet(torus, 3))
    mf.testing.check_space(mf.LevelSet([square, lambda x: x[0] ** 3 + x[1] - 0.2], 4))
    mf.testing.check_space(mf.LevelSet(square, (2, 2), metric=np.diag([1.0, 2.0, 3.0, 4.0])))


@pytest.mark.slow
def test_a_run_on_a_torus():
    """The equations are no polynomials: the implicit method projects its steps onto them and keeps its laws."""
    space = mf.LevelSet(torus, 3, name="torus")
    system = lt.MetriplecticSystem(
        None, lambda x: x[0] + 0.3 * x[2], lambda x: -(x[1] ** 2) - x[2], lt.ProjectedMetric(), space=space
    )
    start = space.point([1.5, 1.5, 0.9], project=True)
    ends = []
    for n in (20, 40, 160):
        run = lt.integrate(system, start, (0.0, 2.0), 2.0 / n, lt.MetriplecticGauss(2))
        assert run.audit().passed
        assert float(space.residual(run.x).max()) < 4e-15
        ends.append(run.x[-1])
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert abs(np.log2(errors[0] / errors[1]) - 4.0) < 0.2


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: mf.LevelSet([square, lambda x: 2.0 * square(x)], 3), mf.SpaceError, "depend on each other.*Leave one"),
        (lambda: mf.LevelSet(lambda x: jnp.sum(x**2) + 1.0, 3), mf.SpaceError, "no point of it from 16 random arrays"),
        (lambda: mf.LevelSet(lambda x: square(x) ** 2, 3), mf.SpaceError, "gradient of constraint 0 vanishes.*near"),
        (lambda: mf.LevelSet(lambda x: x, 3), mf.SpaceError, "3 constraints on 3 numbers leave no manifold"),
        (lambda: mf.LevelSet(lambda x: x @ np.ones(5), 3), mf.SpaceError, r"must take an array of shape \(3,\)"),
        (lambda: mf.LevelSet(lambda x: x[1] ** 2 + x[3] ** 2 - 1.0, 3), mf.SpaceError, "index 3 of an axis with 3 ent"),
        (lambda: mf.LevelSet([square, lambda x: x[-5]], 4), mf.SpaceError, "constraint 1 has the index -5 of an axis"),
        (lambda: mf.LevelSet(square, 3, metric=lambda x: x[4] * jnp.eye(3)), mf.SpaceError, "metric has the index 4"),
        (lambda: mf.LevelSet(square, 3, metric=np.eye(2)), mf.ParameterError, r"shape \(3, 3\)"),
        (lambda: mf.LevelSet(square, 3, metric=-np.eye(3)), mf.ParameterError, "eigenvalue -1"),
        (lambda: mf.LevelSet(square, 3).point([1.0, 1.0, 0.0]), mf.OffManifoldError, r"residual 0\.\d+, tolerance"),
        (lambda: mf.LevelSet(square, 3).point([0.0, 0.0, 0.0]), mf.OffManifoldError, "depend on each other there"),
    ],
)
def test_refusals(build, error, message):
    with pytest.raises(error, match=message) as caught:
        build()
    assert "\n" not in str(caught.value)


def test_an_energy_that_is_not_finite_there():
    """The error is one line that names the function, instead of a NaN."""
    space = mf.LevelSet(square, 3)
    system = lt.MetriplecticSystem(
        None, lambda x: jnp.log(x[0]), dissipation=lt.Friction(), space=space, validate=False
    )
    with pytest.raises(lt.NonFiniteError, match="energy") as caught:
        lt.integrate(system, np.array([-0.6, 0.8, 0.0]), (0.0, 1.0), 0.1, lt.MetriplecticRungeKutta(4))
    assert "\n" not in str(caught.value)
