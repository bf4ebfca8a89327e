"""Manifolds from their equations: compared to closed forms, and refusals."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf


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
        (lambda: mf.LevelSet([square, lambda x: 2.0 * square(x)], 3), mf.SpaceError, "depend on each other.*leave one"),
        (lambda: mf.LevelSet(lambda x: jnp.sum(x**2) + 1.0, 3), mf.SpaceError, "no point of it from 16 random arrays"),
        (lambda: mf.LevelSet(lambda x: square(x) ** 2, 3), mf.SpaceError, "gradient of constraint 0 vanishes.*near"),
        (lambda: mf.LevelSet(lambda x: x, 3), mf.SpaceError, "3 constraints on 3 numbers leave no manifold"),
        (lambda: mf.LevelSet(lambda x: x @ np.ones(5), 3), mf.SpaceError, r"take no array of shape \(3,\)"),
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
