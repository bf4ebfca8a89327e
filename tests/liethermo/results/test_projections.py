"""Figures of runs with any number of components: what they draw, and what they refuse."""

import matplotlib
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def run():
    g = mf.patera("A5,16", p=0.2, s=0.7)
    system = lt.LiePoissonSystem(g, lt.Quadratic([1.0, 1.25, 1.5, 1.75, 2.0]))
    x0 = [0.7, 0.2, 0.4, 0.3, 0.5]
    return system, lt.integrate(system, x0, (0.0, 5.0), 0.05, method=lt.MetriplecticGauss(2))


def test_projection_draws_the_run_and_points_of_its_orbit(run, tmp_path):
    system, solution = run
    figure = lt.plot.projection(solution, ["e1", 4], system, orbit_points=50)
    orbit, curve = figure.axes[0].collections
    np.testing.assert_allclose(curve.get_offsets(), solution.x[:, [0, 4]])
    assert len(orbit.get_offsets()) == 50
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("e1", "e5")
    lt.plot.projection(solution, [0, 1, 4], path=tmp_path / "orbit.png")
    assert (tmp_path / "orbit.png").stat().st_size > 1000


def test_points_of_an_orbit_have_the_invariants_of_the_start(run):
    system, solution = run
    invariant = system.algebra.invariants[0]
    figure = lt.plot.projection(solution, [invariant, 0], system, orbit_points=50)
    orbit, _ = figure.axes[0].collections
    values = np.asarray(orbit.get_offsets())[:, 0]
    np.testing.assert_allclose(values, float(invariant(solution.x[0])), rtol=1e-6)  # exponentials amplify rounding


def test_invariants_draws_each_of_them(run):
    system, solution = run
    (ax,) = lt.plot.invariants(solution, system).axes
    assert len(ax.lines) == 4
    assert max(float(line.get_ydata().max()) for line in ax.lines) < 1e-12
    assert {float(line.get_ydata()[0]) for line in ax.lines} == {float(np.finfo(float).eps)}  # changes from the start


def test_faults_are_named(run):
    system, solution = run
    for coordinates, message in [([0], "2 or 3"), ([0, 9], "index from 0 to 4"), (["e1", "z"], "'z' is not the name")]:
        with pytest.raises(lt.InputError, match=message):
            lt.plot.projection(solution, coordinates, system)
    with pytest.raises(lt.InputError, match="needs system="):
        lt.plot.projection(solution, [0, 1], orbit_points=5)
