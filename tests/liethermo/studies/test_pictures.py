"""Pictures of studies: heat maps, lines, samples, and measures that cannot be drawn."""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray

import liethermo as lt
from liethermo.studies.solve import STATUSES


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
