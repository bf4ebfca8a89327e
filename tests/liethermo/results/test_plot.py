"""Pictures: what they show is what the solution holds, and what they cannot show they refuse."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

import liethermo as lt
import manifolds as mf
from liethermo.results.plot.figures import BLUE, GREEN, GREY, RED
from liethermo.results.plot.surfaces import _fit_quadric, _LevelSurface, _sphere_grid

SIZE_OF_A_PICTURE = 5_000  # bytes; an empty one is smaller


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def body():
    return lt.models.rigid_body(rate=0.1)


@pytest.fixture(scope="module")
def relaxed(body):
    return lt.integrate(body, [0.2, 0.4, 1.0], (0.0, 20.0), 0.1)


@pytest.fixture(scope="module")
def free():
    """A free body, recorded without its entropy."""
    system = lt.LiePoissonSystem(mf.so(3), energy=lt.Quadratic([0.5, 1.0, 1.5]))
    return system, lt.integrate(system, [0.4, 0.1, 0.9], (0.0, 5.0), 0.1)


def line(ax, color, least=2):
    """The data of the one line of this colour with at least so many points."""
    (found,) = [found for found in ax.lines if found.get_color() == color and len(found.get_xdata()) >= least]
    return np.asarray(found.get_xdata()), np.asarray(found.get_ydata())


def labels(figure):
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def path_in_space(figure):
    """The segments of the trajectory, in the order of their starting points along the first axis of the drawing."""
    segments = [c._segments3d for c in figure.axes[0].collections if isinstance(c, Line3DCollection)]
    return np.concatenate([np.asarray(part) for part in segments])


# -- laws ---------------------------------------------------------------------------------------------------------


def test_laws_show_the_series_of_the_solution(relaxed):
    figure = lt.plot.laws(relaxed)
    energy, entropy, production = figure.axes
    t, error = line(energy, BLUE)
    np.testing.assert_array_equal(t, relaxed.t)
    np.testing.assert_array_equal(error, (relaxed.energy - relaxed.energy[0]) / abs(relaxed.energy[0]))
    t, S = line(entropy, BLUE)
    np.testing.assert_array_equal(t, relaxed.t)
    np.testing.assert_array_equal(S, relaxed.entropy)
    t, dS = line(production, GREEN)
    np.testing.assert_allclose(t, (relaxed.t[1:] + relaxed.t[:-1]) / 2, rtol=1e-14)
    np.testing.assert_array_equal(dS, np.diff(relaxed.entropy) / np.diff(relaxed.t))
    assert production.get_yscale() == "log"
    assert production.get_xlabel() == "time"
    assert figure.get_suptitle().startswith("The laws hold")


def test_the_production_is_that_of_the_system(body, relaxed):
    _, dS = line(lt.plot.laws(relaxed).axes[2], GREEN)
    middle = (relaxed.x[1:] + relaxed.x[:-1]) / 2
    # the midpoint scheme gives a quadratic entropy exactly this increment; 1.5e-13 measured
    np.testing.assert_allclose(dS, body.entropy_production(middle), rtol=1e-12)


def test_laws_without_entropy_have_the_energy_only(free):
    _, solution = free
    (panel,) = lt.plot.laws(solution).axes
    np.testing.assert_array_equal(line(panel, BLUE)[0], solution.t)


def test_laws_say_that_one_fails(body):
    rough = lt.integrate(body, [0.2, 0.4, 1.0], (0.0, 20.0), 0.1, method=lt.Reference(rtol=1e-4))
    figure = lt.plot.laws(rough)
    assert figure.get_suptitle().startswith("A law fails: energy drift")
    assert figure._suptitle.get_color() == RED


def test_laws_say_that_a_run_stopped(relaxed):
    stopped = replace(relaxed, status=lt.Status("not_converged", "stopped", 200, 20.0))
    assert "not_converged" in lt.plot.laws(stopped).get_suptitle()


def test_falling_entropy_is_not_hidden(relaxed):
    S = relaxed.entropy.copy()
    S[50:] -= 0.01  # between t = 4.9 and t = 5.0
    figure = lt.plot.laws(replace(relaxed, entropy=S))
    t, fall = line(figure.axes[2], RED, least=1)
    np.testing.assert_allclose(t, [4.95])
    np.testing.assert_allclose(fall, [(S[49] - S[50]) / 0.1], rtol=1e-12)
    assert "least entropy increment" in figure.get_suptitle()


def test_production_below_rounding_is_marked(relaxed):
    still = replace(relaxed, entropy=np.full_like(relaxed.entropy, 0.5))
    _, entropy, production = lt.plot.laws(still).axes
    assert len(line(production, GREY)[0]) == len(still.t) - 1
    assert np.isnan(line(production, GREEN)[1]).all()
    low, high = entropy.get_ylim()
    assert high - low > 1e-3  # rounding is not magnified


def test_the_limit_of_the_entropy_is_marked(relaxed):
    levelled = replace(relaxed, entropy=1.0 - 0.5 * np.exp(-2.0 * relaxed.t))
    texts = [text.get_text() for text in lt.plot.laws(levelled).axes[1].texts]
    assert texts == ["1"]
    assert not lt.plot.laws(relaxed).axes[1].texts


def test_energy_zero_at_the_start_is_not_divided_by(relaxed):
    shifted = replace(relaxed, energy=relaxed.energy - relaxed.energy[0])
    panel = lt.plot.laws(shifted).axes[0]
    assert "|" not in panel.get_ylabel()
    np.testing.assert_array_equal(line(panel, BLUE)[1], shifted.energy)


# -- momentum sphere ----------------------------------------------------------------------------------------------


def test_momentum_sphere_shows_the_trajectory(body, relaxed):
    figure = lt.plot.momentum_sphere(relaxed, body)
    ax = figure.axes[0]
    drawn = {tuple(segment.ravel()) for segment in path_in_space(figure)}
    expected = {tuple(np.concatenate(pair)) for pair in zip(relaxed.x[:-1], relaxed.x[1:], strict=True)}
    assert drawn == expected
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == (r"$\mu_1$", r"$\mu_2$", r"$\mu_3$")
    assert labels(figure) == [
        f"energy ${relaxed.energy[0]:.4g}$",
        f"entropy at start ${relaxed.entropy[0]:.4g}$",
        f"entropy at end ${relaxed.entropy[-1]:.4g}$",
        "start",
        "end",
    ]
    extent = np.ptp([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()], axis=1)
    np.testing.assert_allclose(extent, extent[0], rtol=1e-12)  # equal aspect


def test_momentum_sphere_is_labelled_by_the_names_of_the_basis(relaxed):
    algebra = mf.so(3).with_basis_names("Lx", "Ly", "Lz")
    system = lt.LiePoissonSystem(algebra, lt.Quadratic([0.1, 0.2, 1.0]), lt.Quadratic(np.ones(3)), validate=False)
    ax = lt.plot.momentum_sphere(relaxed, system).axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == ("Lx", "Ly", "Lz")
    assert "Lx**2 + Ly**2 + Lz**2" in system.casimirs()


def test_momentum_sphere_of_a_loaded_solution(body, relaxed, tmp_path):
    loaded = lt.load(relaxed.save(tmp_path / "body.nc"))
    assert labels(lt.plot.momentum_sphere(loaded)) == labels(lt.plot.momentum_sphere(relaxed, body))


def test_the_energy_surface_is_found_from_the_states(body, relaxed):
    found = _LevelSurface(_fit_quadric(relaxed.x), relaxed.x[0], 1.0).intersect_rays(_sphere_grid(8, 16))
    np.testing.assert_allclose(body.energy(found), relaxed.energy[0], rtol=1e-9)


def test_what_cannot_be_known_without_the_system_is_left_out(free):
    system, solution = free
    assert labels(lt.plot.momentum_sphere(solution)) == ["invariant $0.98$", "start", "end"]
    assert labels(lt.plot.momentum_sphere(solution, system)) == ["energy $0.6525$", "invariant $0.98$", "start", "end"]


@pytest.mark.slow
def test_a_falling_energy_is_drawn_on_the_conserved_casimir():
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([0.1, 0.2, 1.0]), dissipation=lt.DoubleBracket(0.1))
    solution = lt.integrate(system, [0.1, 1.0, 0.5], (0.0, 10.0), 0.1)
    names = [label.split(" $")[0] for label in labels(lt.plot.momentum_sphere(solution, system))]
    assert names == ["invariant", "energy at start", "energy at end", "start", "end"]
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
    hidden = sphere.hides(points, np.array([1.0, 0.0, 0.0]))
    assert hidden.tolist() == [False, False, True, True, True, False]


def test_long_trajectories_are_thinned_but_keep_their_ends(body, relaxed, monkeypatch):
    monkeypatch.setattr("liethermo.results.plot.surfaces.MAX_SEGMENTS", 50)
    segments = path_in_space(lt.plot.momentum_sphere(relaxed, body))
    assert len(segments) == 50
    assert any((segment[0] == relaxed.x[0]).all() for segment in segments)
    assert any((segment[1] == relaxed.x[-1]).all() for segment in segments)


def test_a_single_state_is_drawn(body, relaxed):
    single = replace(
        relaxed, t=relaxed.t[:1], x=relaxed.x[:1], energy=relaxed.energy[:1], entropy=relaxed.entropy[:1], casimirs={}
    )
    assert labels(lt.plot.momentum_sphere(single, body))[-2:] == ["start", "end"]
    assert len(lt.plot.laws(single).axes) == 3


def test_drawing_into_axes_that_are_given(body, relaxed):
    figure, ax = plt.subplots(subplot_kw={"projection": "3d"})
    ax.view_init(elev=80.0, azim=10.0)
    assert lt.plot.momentum_sphere(relaxed, body, ax=ax) is figure
    assert (ax.elev, ax.azim) == (80.0, 10.0)


# -- files and refusals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_figures_are_written_and_closed(relaxed, tmp_path, suffix):
    path = tmp_path / "new folder" / f"laws{suffix}"
    lt.plot.laws(relaxed, path=path)
    assert path.stat().st_size > SIZE_OF_A_PICTURE
    assert not plt.get_fignums()


def test_momentum_sphere_is_written(body, relaxed, tmp_path):
    lt.plot.momentum_sphere(relaxed, body, path=str(tmp_path / "body.PNG"))
    assert (tmp_path / "body.PNG").stat().st_size > SIZE_OF_A_PICTURE


@pytest.mark.parametrize("draw", [lt.plot.laws, lt.plot.momentum_sphere])
def test_unknown_suffixes_are_refused_before_drawing(relaxed, tmp_path, draw):
    with pytest.raises(lt.InputError, match=r"\.pdf, \.png, \.svg.*'body\.jpeg'"):
        draw(relaxed, path=tmp_path / "body.jpeg")
    assert not plt.get_fignums()


def test_a_file_that_cannot_be_written(relaxed, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(lt.FileError, match="cannot write"):
        lt.plot.laws(relaxed, path=tmp_path / "file" / "laws.png")
    assert not plt.get_fignums()


def test_other_dimensions_and_flat_axes_are_refused(body, relaxed):
    wide = replace(relaxed, x=np.tile(relaxed.x, 2))
    with pytest.raises(lt.InputError, match="3 components, got 6"):
        lt.plot.momentum_sphere(wide)
    other = lt.LiePoissonSystem(mf.se(3), lt.Quadratic(np.ones(6)))
    with pytest.raises(lt.InputError, match="3 components like the solution, got 6"):
        lt.plot.momentum_sphere(relaxed, other)
    _, flat = plt.subplots()
    with pytest.raises(lt.InputError, match="three-dimensional"):
        lt.plot.momentum_sphere(relaxed, body, ax=flat)


def test_momentum_sphere_of_a_body_with_a_bath():
    """The body is shown: its momentum keeps to its sphere, and its energy falls while the total one is constant."""
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), dissipation=lt.DoubleBracket(0.3), baths=lt.HeatBaths()
    )
    solution = lt.integrate(system, [0.1, 0.2, 1.0], (0.0, 20.0), 0.1)
    assert labels(lt.plot.momentum_sphere(solution, system))[:2] == ["invariant $1.05$", "energy at start $0.5117$"]
    assert np.ptp(solution.energy) < 1e-14
    with pytest.raises(lt.InputError, match="If the others are the entropies of baths, pass the system too"):
        lt.plot.momentum_sphere(solution)
