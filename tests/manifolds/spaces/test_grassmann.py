"""Grassmann manifolds compared to geomstats; the suite of spaces runs on them by registration."""

from __future__ import annotations

import numpy as np
import pytest

import liethermo as lt
import manifolds as mf


@pytest.mark.slow
def test_against_geomstats():
    from geomstats.geometry.grassmannian import Grassmannian

    theirs, ours = Grassmannian(4, 2).metric, mf.Grassmann(4, 2)
    x = np.asarray(ours.random(0))
    u, v = np.asarray(ours.random_tangent(2, x)), 0.4 * np.asarray(ours.random_tangent(1, x))
    y = np.asarray(ours.exp(x, v))
    assert np.abs(theirs.exp(v, x) - y).max() < 1e-12
    assert np.abs(theirs.log(y, x) - ours.log(x, y)).max() < 1e-12
    assert abs(theirs.dist(x, y) - ours.distance(x, y)) < 1e-12
    assert np.abs(theirs.parallel_transport(u, x, direction=v) - ours.transport(x, v, u)).max() < 1e-12


def test_subspaces_and_their_angles():
    space = mf.Grassmann(3, 1)
    x, y = space.subspace(np.array([[1.0], [0.0], [0.0]])), space.subspace(np.array([[1.0], [1.0], [0.0]]))
    assert abs(float(space.distance(x, y)) - np.sqrt(2.0) * np.pi / 4.0) < 1e-15 * 4
    with pytest.raises(mf.DomainError, match="right angle"):
        space.log(x, space.subspace(np.array([[0.0], [0.0], [2.0]])))
    with pytest.raises(mf.ParameterError, match="p must be less than n"):
        mf.Grassmann(3, 3)
    assert not bool(space.belongs(np.diag([1.0, 1.0, 0.0])))  # a projector, to a plane


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticGauss(2)], ids=str)
def test_a_run_finds_the_dominant_subspace(method):
    """The gradient flow of tr(A x) ends at the eigenvectors of the two largest eigenvalues."""
    space, A = mf.Grassmann(4, 2), np.diag([4.0, 3.0, 1.0, 0.5]) + 0.2
    system = lt.MetriplecticSystem(None, lambda x: -(A * x).sum(), dissipation=lt.Friction(), space=space)
    run = lt.integrate(system, space.random(0), (0.0, 15.0), 0.05, method)
    vectors = np.linalg.eigh(A)[1][:, -2:]
    assert np.abs(system.points(run.x[-1]) - vectors @ vectors.T).max() < 1e-9
    assert float(space.residual(system.points(run.x)).max()) < 1e-14
