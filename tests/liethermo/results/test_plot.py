"""Figures: they show the data of the solution, orbits are projected, and invalid input is refused."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

import liethermo as lt
import manifolds as mf
from liethermo.results.plot.figures import BLUE, GREEN, GREY, RED
from liethermo.results.plot.surfaces import _fit_quadric, _LevelSurface, unit_sphere_grid

matplotlib.use("Agg")


MIN_FIGURE_BYTES = 5_000
"""Size in bytes that every figure exceeds; an empty one is smaller."""


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def body():
    return lt.models.rigid_body(rate=0.1)


@pytest.fixture(scope="module")
def relaxed_solution(body):
    return lt.integrate(body, [0.2, 0.4, 1.0], (0.0, 20.0), 0.1)


@pytest.fixture(scope="module")
def free_body():
    """Return a free body without an entropy, and its solution."""
    system = lt.LiePoissonSystem(mf.so(3), energy=lt.Quadratic([0.5, 1.0, 1.5]))
    return system, lt.integrate(system, [0.4, 0.1, 0.9], (0.0, 5.0), 0.1)


def line_data(ax, color, min_points=2):
    """Return x and y of the only line of this colour with at least ``min_points`` points."""
    (line,) = [found for found in ax.lines if found.get_color() == color and len(found.get_xdata()) >= min_points]
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def labels(figure):
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def path_in_space(figure):
    """Return the segments of the trajectory in a 3D figure."""
    segments = [c._segments3d for c in figure.axes[0].collections if isinstance(c, Line3DCollection)]
    return np.concatenate([np.asarray(collection_segments) for collection_segments in segments])


# -- laws ---------------------------------------------------------------------------------------------------------


def test_laws_show_the_series_of_the_solution(relaxed_solution):
    figure = lt.plot.laws(relaxed_solution)
    energy, entropy, production = figure.axes
    t, error = line_data(energy, BLUE)
    np.testing.assert_array_equal(t, relaxed_solution.t)
    np.testing.assert_array_equal(
        error, (relaxed_solution.energy - relaxed_solution.energy[0]) / abs(relaxed_solution.energy[0])
    )
    t, S = line_data(entropy, BLUE)
    np.testing.assert_array_equal(t, relaxed_solution.t)
    np.testing.assert_array_equal(S, relaxed_solution.entropy)
    t, dS = line_data(production, GREEN)
    np.testing.assert_allclose(t, (relaxed_solution.t[1:] + relaxed_solution.t[:-1]) / 2, rtol=1e-14)
    np.testing.assert_array_equal(dS, np.diff(relaxed_solution.entropy) / np.diff(relaxed_solution.t))
    assert production.get_yscale() == "log"
    assert production.get_xlabel() == "time"
    assert figure.get_suptitle().startswith("The laws hold")


def test_the_production_is_that_of_the_system(body, relaxed_solution):
    _, dS = line_data(lt.plot.laws(relaxed_solution).axes[2], GREEN)
    midpoints = (relaxed_solution.x[1:] + relaxed_solution.x[:-1]) / 2
    # the midpoint scheme gives a quadratic entropy exactly this increment; 1.5e-13 measured
    np.testing.assert_allclose(dS, body.entropy_production(midpoints), rtol=1e-12)


def test_laws_without_entropy_have_the_energy_only(free_body):
    _, solution = free_body
    (panel,) = lt.plot.laws(solution).axes
    np.testing.assert_array_equal(line_data(panel, BLUE)[0], solution.t)


def test_laws_say_that_one_fails(body):
    inaccurate_run = lt.integrate(body, [0.2, 0.4, 1.0], (0.0, 20.0), 0.1, method=lt.Reference(rtol=1e-4))
    figure = lt.plot.laws(inaccurate_run)
    assert figure.get_suptitle().startswith("A law fails: energy drift")
    assert figure._suptitle.get_color() == RED


def test_laws_say_that_a_run_stopped(relaxed_solution):
    stopped_solution = replace(relaxed_solution, status=lt.Status("not_converged", "stopped", 200, 20.0))
    assert "not_converged" in lt.plot.laws(stopped_solution).get_suptitle()


def test_falling_entropy_is_not_hidden(relaxed_solution):
    S = relaxed_solution.entropy.copy()
    S[50:] -= 0.01  # between t = 4.9 and t = 5.0
    figure = lt.plot.laws(replace(relaxed_solution, entropy=S))
    t, fall_rate = line_data(figure.axes[2], RED, min_points=1)
    np.testing.assert_allclose(t, [4.95])
    np.testing.assert_allclose(fall_rate, [(S[49] - S[50]) / 0.1], rtol=1e-12)
    assert "least entropy increment" in figure.get_suptitle()


def test_production_below_rounding_is_marked(relaxed_solution):
    constant_entropy = replace(relaxed_solution, entropy=np.full_like(relaxed_solution.entropy, 0.5))
    _, entropy, production = lt.plot.laws(constant_entropy).axes
    assert len(line_data(production, GREY)[0]) == len(constant_entropy.t) - 1
    assert np.isnan(line_data(production, GREEN)[1]).all()
    y_min, y_max = entropy.get_ylim()
    assert y_max - y_min > 1e-3  # rounding is not magnified


def test_the_limit_of_the_entropy_is_marked(relaxed_solution):
    saturating_entropy = replace(relaxed_solution, entropy=1.0 - 0.5 * np.exp(-2.0 * relaxed_solution.t))
    texts = [text.get_text() for text in lt.plot.laws(saturating_entropy).axes[1].texts]
    assert texts == ["1"]
    assert not lt.plot.laws(relaxed_solution).axes[1].texts


def test_energy_zero_at_the_start_is_not_divided_by(relaxed_solution):
    zero_energy_start = replace(relaxed_solution, energy=relaxed_solution.energy - relaxed_solution.energy[0])
    panel = lt.plot.laws(zero_energy_start).axes[0]
    assert "|" not in panel.get_ylabel()
    np.testing.assert_array_equal(line_data(panel, BLUE)[1], zero_energy_start.energy)


# -- momentum sphere ----------------------------------------------------------------------------------------------


def test_momentum_sphere_shows_the_trajectory(body, relaxed_solution):
    figure = lt.plot.momentum_sphere(relaxed_solution, body)
    ax = figure.axes[0]
    drawn_segments = {tuple(segment.ravel()) for segment in path_in_space(figure)}
    expected = {
        tuple(np.concatenate(pair)) for pair in zip(relaxed_solution.x[:-1], relaxed_solution.x[1:], strict=True)
    }
    assert drawn_segments == expected
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == (r"$\mu_1$", r"$\mu_2$", r"$\mu_3$")
    assert labels(figure) == [
        f"energy ${relaxed_solution.energy[0]:.4g}$",
        f"entropy at start ${relaxed_solution.entropy[0]:.4g}$",
        f"entropy at end ${relaxed_solution.entropy[-1]:.4g}$",
        "start",
        "end",
    ]
    extent = np.ptp([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()], axis=1)
    np.testing.assert_allclose(extent, extent[0], rtol=1e-12)  # equal aspect


def test_momentum_sphere_is_labelled_by_the_names_of_the_basis(relaxed_solution):
    algebra = mf.so(3).with_basis_names("Lx", "Ly", "Lz")
    system = lt.LiePoissonSystem(algebra, lt.Quadratic([0.1, 0.2, 1.0]), lt.Quadratic(np.ones(3)), validate=False)
    ax = lt.plot.momentum_sphere(relaxed_solution, system).axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == ("Lx", "Ly", "Lz")
    assert "Lx**2 + Ly**2 + Lz**2" in system.casimirs()


@pytest.mark.slow
def test_momentum_sphere_of_a_loaded_solution(body, relaxed_solution, tmp_path):
    loaded_solution = lt.load(relaxed_solution.save(tmp_path / "body.nc"))
    assert labels(lt.plot.momentum_sphere(loaded_solution)) == labels(lt.plot.momentum_sphere(relaxed_solution, body))


def test_the_energy_surface_is_found_from_the_states(body, relaxed_solution):
    surface_points = _LevelSurface(_fit_quadric(relaxed_solution.x), relaxed_solution.x[0], 1.0).intersect_rays(
        unit_sphere_grid(8, 16)
    )
    np.testing.assert_allclose(body.energy(surface_points), relaxed_solution.energy[0], rtol=1e-9)


def test_what_cannot_be_known_without_the_system_is_left_out(free_body):
    system, solution = free_body
    assert labels(lt.plot.momentum_sphere(solution)) == [r"$|\mu|^2$ $0.98$", "start", "end"]
    assert labels(lt.plot.momentum_sphere(solution, system)) == ["energy $0.6525$", r"$|\mu|^2$ $0.98$", "start", "end"]


@pytest.mark.slow
def test_a_falling_energy_is_drawn_on_the_conserved_casimir():
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([0.1, 0.2, 1.0]), dissipation=lt.DoubleBracket(0.1))
    solution = lt.integrate(system, [0.1, 1.0, 0.5], (0.0, 10.0), 0.1)
    names = [label.split(" $")[0] for label in labels(lt.plot.momentum_sphere(solution, system))]
    assert names == [r"$|\mu|^2$", "energy at start", "energy at end", "start", "end"]
    assert "energy at start" not in labels(lt.plot.momentum_sphere(solution))


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("algebra", "casimir"),
    [(mf.se(2), lambda m: m[1] ** 2 + m[2] ** 2), (mf.bianchi("VIII"), lambda m: m[0] ** 2 + m[1] ** 2 - m[2] ** 2)],
    ids=["cylinder", "hyperboloid"],
)
def test_open_surfaces_and_energies_that_are_not_quadratic(algebra, casimir):
    system = lt.LiePoissonSystem(
        algebra, lambda m: jnp.dot(m, m) / 2 + m[0] ** 4 / 10, casimir, lt.ProjectedMetric(rate=0.1)
    )
    solution = lt.integrate(system, [0.3, 1.0, 0.2], (0.0, 5.0), 0.1)
    figure = lt.plot.momentum_sphere(solution, system)
    assert any(isinstance(c, Poly3DCollection) for c in figure.axes[0].collections)
    assert labels(figure)[1].startswith("entropy at start")
    assert labels(lt.plot.momentum_sphere(solution)) == ["start", "end"]


@pytest.mark.slow
def test_a_surface_met_twice_by_a_ray_is_left_out():
    system = lt.LiePoissonSystem(mf.so(3), lambda m: jnp.sin(3.0 * jnp.dot(m, m)) + m[0], lambda m: jnp.dot(m, m))
    solution = lt.integrate(system, [0.3, 1.0, 0.2], (0.0, 1.0), 0.05)
    assert [label.split(" ")[0] for label in labels(lt.plot.momentum_sphere(solution, system))] == [
        "entropy",
        "start",
        "end",
    ]


def test_a_solid_hides_what_is_behind_it():
    sphere = _LevelSurface(lambda x: (x * x).sum(axis=-1), np.array([1.0, 0.0, 0.0]), 1.0)
    assert sphere.is_simple
    assert sphere.is_closed
    points = np.array(
        [[2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-2.0, 0.9, 0.0], [-2.0, 1.1, 0.0]]
    )
    is_hidden = sphere.hides(points, np.array([1.0, 0.0, 0.0]))
    assert is_hidden.tolist() == [False, False, True, True, True, False]


def test_long_trajectories_are_thinned_but_keep_their_ends(body, relaxed_solution, monkeypatch):
    monkeypatch.setattr("liethermo.results.plot.surfaces.MAX_SEGMENTS", 50)
    segments = path_in_space(lt.plot.momentum_sphere(relaxed_solution, body))
    assert len(segments) == 50
    assert any((segment[0] == relaxed_solution.x[0]).all() for segment in segments)
    assert any((segment[1] == relaxed_solution.x[-1]).all() for segment in segments)


def test_a_single_state_is_drawn(body, relaxed_solution):
    single_state = replace(
        relaxed_solution,
        t=relaxed_solution.t[:1],
        x=relaxed_solution.x[:1],
        energy=relaxed_solution.energy[:1],
        entropy=relaxed_solution.entropy[:1],
        casimirs={},
    )
    assert labels(lt.plot.momentum_sphere(single_state, body))[-2:] == ["start", "end"]
    assert len(lt.plot.laws(single_state).axes) == 3


def test_drawing_into_axes_that_are_given(body, relaxed_solution):
    figure, ax = plt.subplots(subplot_kw={"projection": "3d"})
    ax.view_init(elev=80.0, azim=10.0)
    assert lt.plot.momentum_sphere(relaxed_solution, body, ax=ax) is figure
    assert (ax.elev, ax.azim) == (80.0, 10.0)


# -- files and refusals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_figures_are_written_and_closed(relaxed_solution, tmp_path, suffix):
    path = tmp_path / "new folder" / f"laws{suffix}"
    lt.plot.laws(relaxed_solution, path=path)
    assert path.stat().st_size > MIN_FIGURE_BYTES
    assert not plt.get_fignums()


def test_momentum_sphere_is_written(body, relaxed_solution, tmp_path):
    lt.plot.momentum_sphere(relaxed_solution, body, path=str(tmp_path / "body.PNG"))
    assert (tmp_path / "body.PNG").stat().st_size > MIN_FIGURE_BYTES


@pytest.mark.parametrize("draw", [lt.plot.laws, lt.plot.momentum_sphere])
def test_unknown_suffixes_are_refused_before_drawing(relaxed_solution, tmp_path, draw):
    with pytest.raises(lt.InputError, match=r"\.pdf, \.png, \.svg.*'body\.jpeg'"):
        draw(relaxed_solution, path=tmp_path / "body.jpeg")
    assert not plt.get_fignums()


def test_a_file_that_cannot_be_written(relaxed_solution, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(lt.FileError, match="cannot write"):
        lt.plot.laws(relaxed_solution, path=tmp_path / "file" / "laws.png")
    assert not plt.get_fignums()


def test_other_dimensions_and_flat_axes_are_refused(body, relaxed_solution):
    six_components = replace(relaxed_solution, x=np.tile(relaxed_solution.x, 2))
    with pytest.raises(lt.InputError, match="3 components, got 6"):
        lt.plot.momentum_sphere(six_components)
    se3_system = lt.LiePoissonSystem(mf.se(3), lt.Quadratic(np.ones(6)))
    with pytest.raises(lt.InputError, match="3 components like the solution, got 6"):
        lt.plot.momentum_sphere(relaxed_solution, se3_system)
    _, flat_axes = plt.subplots()
    with pytest.raises(lt.InputError, match="three-dimensional"):
        lt.plot.momentum_sphere(relaxed_solution, body, ax=flat_axes)


@pytest.mark.slow
def test_momentum_sphere_of_a_body_with_a_bath():
    """The body is shown alone: its momentum stays on its sphere, and its energy falls while the total is constant."""
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), dissipation=lt.DoubleBracket(0.3), baths=lt.HeatBaths()
    )
    solution = lt.integrate(system, [0.1, 0.2, 1.0], (0.0, 20.0), 0.1)
    assert labels(lt.plot.momentum_sphere(solution, system))[:2] == [r"$|\mu|^2$ $1.05$", "energy at start $0.5117$"]
    assert np.ptp(solution.energy) < 1e-14
    with pytest.raises(lt.InputError, match="If the others are the entropies of baths, pass the system too"):
        lt.plot.momentum_sphere(solution)


def test_bloch_ball_of_a_run_and_of_states(tmp_path):
    """The curve is the Bloch vectors of the run, and its last point is marked."""
    lower = np.array([[0.0, 1.0], [0.0, 0.0]])
    qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), lt.LindbladJumps([(lower, 0.2)]))
    run = lt.integrate(qubit, [0.6, 0.8], (0.0, 5.0), 0.1)
    figure = lt.plot.bloch_ball(run, qubit, labels=("g", "e"))
    curves = [np.stack(line.get_data_3d()) for line in figure.axes[0].lines]
    assert any(c.shape == (3, 51) and np.allclose(c, np.asarray(qubit.bloch(run.x)).T) for c in curves)
    plt.close(figure)
    path = tmp_path / "ball.png"
    lt.plot.bloch_ball(np.stack([run.x, run.x]), qubit, path=path)  # several trajectories
    assert path.stat().st_size > 10_000
    with pytest.raises(lt.InputError, match=r"a Bloch ball needs an lt\.QuantumSystem"):
        lt.plot.bloch_ball(run, lt.models.rigid_body())
    with pytest.raises(lt.InputError, match='projection="3d"'):
        lt.plot.bloch_ball(run, qubit, ax=plt.figure().add_subplot())


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
