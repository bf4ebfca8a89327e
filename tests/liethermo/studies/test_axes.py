"""Axes: grids, zipped parameters, samples, replicas, invalid arguments, and pictures of what varies along them."""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray
from scipy.stats import qmc

import liethermo as lt
from liethermo.studies.axes import Axes, axes_in_store_order
from liethermo.studies.solve import STATUSES
from tests.refusals import refusal_test


def test_a_grid_has_every_combination_and_zipped_parameters_vary_together():
    axes = Axes.from_mapping({"a": [1.0, 2.0], "pair": lt.zipped(b=[3, 4, 5], c=["x", "y", "z"])})
    assert axes.shape == (2, 3)
    assert axes.parameter_names == ("a", "b", "c")
    points = axes.parameters_at(tuple(np.indices(axes.shape).reshape(2, -1)))
    assert points["a"].tolist() == [1, 1, 1, 2, 2, 2]
    assert points["b"].tolist() == [3, 4, 5] * 2
    assert points["c"].tolist() == ["x", "y", "z"] * 2
    assert axes.describe_point((1, 2)) == "a = 2, b = 5, c = z"


def test_samples_lie_in_their_ranges_as_their_construction_says():
    cube = lt.latin_hypercube(40, seed=3, rate=(1e-3, 10.0, "log"), ratio=(-1.0, 2.0))
    u = np.log(cube.columns["rate"] / 1e-3) / np.log(1e4)
    for unit in (u, (cube.columns["ratio"] + 1.0) / 3.0):  # one point in each of 40 strips
        assert sorted(np.floor(40 * unit).astype(int)) == list(range(40))
    sequence = lt.sobol(64, seed=1, a=(0.0, 1.0), b=(0.0, 1.0))
    ours = qmc.discrepancy(np.stack(list(sequence.columns.values()), axis=1))
    random = np.random.default_rng(0).random((64, 2))
    assert ours < 0.3 * qmc.discrepancy(random)
    assert np.array_equal(lt.sobol(200, seed=1, a=(0.0, 1.0), b=(0.0, 1.0)).columns["a"][:64], sequence.columns["a"])


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({}, "axes must be a dict"),
        ({"a": []}, "of shape"),
        ({"a": [[1.0, 2.0]]}, "several numbers at once"),
        ({"a": [1.0, np.nan]}, "value 1 of 'a' is nan"),
        ({"a": [1.0, 2.0, 1.0]}, "the axis 'a' has 1.0 more than once"),
        ({"status": [1.0]}, "cannot be called 'status'"),
        ({"a/b": [1.0]}, "cannot be called"),
        ({"a": [1.0], "s": lt.zipped(a=[1.0])}, "'a' stands for more than one thing"),
        ({"a": [None]}, "got object"),
    ],
)
def test_invalid_axes_are_refused(mapping, message):
    with pytest.raises(lt.InputError, match=message):
        Axes.from_mapping(mapping)


test_invalid_samples_are_refused = refusal_test(
    (lambda: lt.zipped(a=[1.0, 2.0], b=[1.0]), "a has 2, b has 1"),
    (lambda: lt.zipped(), "needs parameters"),
    (lambda: lt.sobol(4, seed=0, a=(1.0, 0.0)), "the range of a must be finite and increasing"),
    (lambda: lt.latin_hypercube(4, seed=0, a=(0.0, 1.0, "log")), "positive with 'log'"),
    (lambda: lt.latin_hypercube(4, seed=0, a=3.0), r"must be \(low, high\)"),
    (lambda: lt.latin_hypercube(0, seed=0, a=(0.0, 1.0)), "positive integer"),
    (lambda: lt.latin_hypercube(4, seed=0), "needs at least one range"),
    (lambda: lt.replicas([0.0, 1.0]), r"shape \(replicas, n\)"),
    (lambda: lt.replicas([[0.0, 1.0], [np.inf, 1.0]]), "replica 1 is not finite"),
)


def test_longer_axes_match_the_order_of_a_store_and_its_rounding():
    stored_axes, longer_axes = (
        Axes.from_mapping({"a": np.linspace(0.1, 0.7, 7)}),
        Axes.from_mapping({"a": np.linspace(0.1, 0.8, 8)[::-1]}),
    )
    assert stored_axes.axes[0].labels[2] != longer_axes.axes[0].labels[5]  # 0.3 and its neighbour
    matched_axis = axes_in_store_order(longer_axes, stored_axes).axes[0]
    assert matched_axis.labels.tolist() == [*stored_axes.axes[0].labels, 0.8]
    with pytest.raises(lt.InputError, match=r"the axis 'a' lacks 0\.1, which is value 0"):
        axes_in_store_order(Axes.from_mapping({"a": [0.2, 0.3]}), stored_axes)
    with pytest.raises(lt.InputError, match=r"the axes are b \(b\)"):
        axes_in_store_order(Axes.from_mapping({"b": [0.2]}), stored_axes)


def test_replicas_are_told_apart_by_their_states_and_may_be_alike():
    states = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    matched_axis = axes_in_store_order(
        Axes.from_mapping({"r": lt.replicas(states)}), Axes.from_mapping({"r": lt.replicas(states[1:])})
    ).axes[0]
    assert np.array_equal(matched_axis.states, states[[1, 2, 0]])
    with pytest.raises(lt.InputError, match="lacks"):
        axes_in_store_order(
            Axes.from_mapping({"r": lt.replicas(states[1:])}), Axes.from_mapping({"r": lt.replicas(states[:2])})
        )


@pytest.fixture(autouse=True)
def _use_agg_backend():
    matplotlib.use("Agg")
    yield
    plt.close("all")


def dataset(**changes):
    """Return a dataset as a study has it, over a logarithmic and a linear axis."""
    rate, ratio = np.geomspace(0.01, 1.0, 7), np.linspace(0.1, 0.5, 5)
    tau = 1.0 / rate[:, None] + ratio
    status = np.zeros((7, 5), dtype=np.int8)
    status[0, 1:3] = STATUSES["inadmissible"]
    status[6, 4] = STATUSES["missing"]
    tau[status != 0] = np.nan
    about = {"flag_values": list(STATUSES.values()), "flag_meanings": " ".join(STATUSES)}
    return xarray.Dataset(
        {
            "status": (("rate", "ratio"), status, about),
            "tau": (("rate", "ratio"), tau, {"long_name": "relaxation time", "units": "s"}),
            "final": (("rate", "ratio", "final_component"), np.stack([tau, 2 * tau, 3 * tau], axis=-1)),
            **changes,
        },
        {"rate": ("rate", rate, {"units": "1/s"}), "ratio": ratio},
    )


def test_a_heat_map_has_the_values_hatched_failures_and_labels(tmp_path):
    figure = lt.plot.study(dataset())
    ax, bar = figure.axes
    (mesh,) = [c for c in ax.collections if isinstance(c, matplotlib.collections.QuadMesh)]
    expected_values = dataset().tau.to_numpy()
    assert np.array_equal(np.ma.filled(mesh.get_array(), np.nan), expected_values, equal_nan=True)
    (failure_patches,) = [c for c in ax.collections if isinstance(c, matplotlib.collections.PatchCollection)]
    assert failure_patches.get_hatch() == "////"
    (box,) = [path.get_extents() for path in failure_patches.get_paths()]  # two neighbours in one
    np.testing.assert_allclose([box.x0, box.x1], [0.15, 0.35])
    assert ax.get_yscale() == "log"
    assert ax.get_xscale() == "linear"
    assert ax.get_ylabel() == "rate [1/s]"
    assert bar.get_ylabel() == "relaxation time [s]"
    lt.plot.study(dataset(), path=tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_axes_in_any_order_are_drawn_in_theirs():
    permuted = dataset().isel(rate=[3, 0, 6, 1, 5, 2, 4])
    meshes = [lt.plot.study(data).axes[0].collections[0].get_array() for data in (dataset(), permuted)]
    assert np.ma.allequal(*meshes)


def test_lines_over_one_axis_with_failures():
    ax = lt.plot.study(dataset().isel(ratio=1)).axes[0]
    (line,) = ax.lines
    assert np.array_equal(line.get_ydata(), dataset().tau[:, 1], equal_nan=True)
    assert len(ax.patches) == 1
    ax = lt.plot.study(dataset().isel(rate=2), "final").axes[0]
    assert len(ax.lines) == 3


def test_classes_have_a_colour_each_and_samples_are_points():
    basin = xarray.DataArray(np.arange(35.0).reshape(7, 5) % 3, dims=("rate", "ratio"))
    figure = lt.plot.study(dataset(basin=basin), "basin")
    assert figure.axes[0].collections[0].get_cmap().N == 3
    sample = dataset().stack(point=("rate", "ratio"), create_index=False).drop_vars("final")
    sample = sample.assign_coords(point=np.arange(35))
    (points,) = lt.plot.study(sample).axes[0].collections
    assert len(points.get_offsets()) == 32


def test_undrawable_measures_are_refused(tmp_path):
    with pytest.raises(lt.InputError, match="no measure 'sigma'; there are tau, final"):
        lt.plot.study(dataset(), "sigma")
    with pytest.raises(lt.InputError, match=r"final has rate \(7\), ratio \(5\), final_component \(3\)\. Choose"):
        lt.plot.study(dataset(), "final")
    with pytest.raises(lt.InputError, match="ends in none of them"):
        lt.plot.study(dataset(), path=tmp_path / "map.xyz")
    with pytest.raises(lt.InputError, match="has no variable status"):
        lt.plot.study(dataset().drop_vars("status"))
