"""Pictures of a study: a heat map over two axes, lines over one, points of a sample."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from ...errors import InputError
from .figures import BLUE, DPI, GREEN, GREY, ORANGE, RED, checked_figure_path, save_figure

if TYPE_CHECKING:
    import xarray

NON_MEASURE_VARIABLES = ("status", "message", "laws")
"""Variables that are no measures."""

MAX_CLASSES = 10
"""Different whole numbers up to which values are classes, each with a colour of its own."""

HATCH_STYLE: dict[str, Any] = {"hatch": "////", "facecolor": "0.93", "edgecolor": GREY, "linewidth": 0.0}


def study(
    dataset: xarray.Dataset,
    variable: str | None = None,
    path: str | os.PathLike | None = None,
    ax: Axes | None = None,
    contours: int = 8,
) -> Figure:
    """A measure of a study over its axes: points that failed are hatched, those not done yet are left white.

    Over two axes it is a heat map with contours; over one a line, one for each component; over a sample of two
    parameters coloured points. An axis whose values are spaced geometrically is logarithmic. A measure with few whole
    numbers, such as the number of a basin, has a colour for each.

    Parameters
    ----------
    dataset : xarray.Dataset
        ``study.results``, with two axes at most. Choose points on other axes first:
        ``results.sel(rate=0.1, method="nearest")``.
    variable : str, optional
        The measure; by default the first with one number for each point.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.
    ax : Axes, optional
        Draw here; by default in a new figure.
    contours : int
        How many; 0 for none.

    Raises
    ------
    InputError
        If there is no such measure, it has too many axes, or the suffix of ``path`` is another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    if "status" not in dataset:
        raise InputError("this dataset is not one of a study: it has no variable status")
    axes = [str(dim) for dim in dataset["status"].dims]
    values = dataset[_measure_name(dataset, axes, variable)]
    more = [str(dim) for dim in values.dims if dim not in axes]
    own = {name: c for name, c in dataset.coords.items() if c.dims == tuple(axes) and name not in axes}
    columns = [str(name) for name, c in own.items() if c.dtype.kind in "fiu"]
    sample = len(axes) == 1 and len(columns) > 1
    if len(axes) not in (1, 2) or len(more) > (0 if sample or len(axes) == 2 else 1):
        dims = ", ".join(f"{dim} ({dataset.sizes[dim]})" for dim in (*axes, *more))
        raise InputError(f"a picture has one or two axes, and {values.name} has {dims}: choose with results.isel(...)")
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 4.4), dpi=DPI, layout="constrained")
    failed = _has_failed(dataset)
    if sample:
        _draw_points(ax, values, failed, *(dataset[name] for name in columns[:2]))
    elif len(axes) == 1:
        _draw_lines(ax, values.transpose(axes[0], *more), failed, dataset[axes[0]])
    else:
        _draw_map(ax, values.transpose(*axes), failed.transpose(*axes), contours)
    return save_figure(ax.figure, path)  # type: ignore[arg-type]


def _measure_name(dataset: xarray.Dataset, axes: list[str], variable: str | None) -> str:
    measures = [str(name) for name in dataset.data_vars if name not in NON_MEASURE_VARIABLES]
    if variable is not None:
        if variable not in measures:
            raise InputError(f"there is no measure {variable!r}; there are {', '.join(measures)}")
        return variable
    plain = [name for name in measures if set(dataset[name].dims) == set(axes)]
    if not (plain or measures):
        raise InputError("this dataset has no measure")
    return (plain or measures)[0]


def _has_failed(dataset: xarray.Dataset) -> xarray.DataArray:
    """Where a point came to another end than the one it should."""
    codes = dict(zip(dataset["status"].flag_meanings.split(), dataset["status"].flag_values, strict=True))
    return ~dataset["status"].isin([codes[name] for name in ("completed", "event", "missing") if name in codes])


def _label(values: xarray.DataArray) -> str:
    name, units = values.attrs.get("long_name", str(values.name)), values.attrs.get("units")
    return f"{name} [{units}]" if units else name


def _is_geometric(places: np.ndarray) -> bool:
    if len(places) < 3 or not (places > 0.0).all() or places.max() < 4.0 * places.min():
        return False
    spread = [np.ptp(np.diff(p)) / np.abs(np.diff(p)).max() for p in (places, np.log(places))]
    return bool(spread[1] < 0.1 < spread[0])


def _cell_edges(places: np.ndarray) -> np.ndarray:
    """The edges of cells around places: the middles between them, as the axis is scaled."""
    if len(places) == 1:
        return places[0] + np.array([-0.5, 0.5]) * (abs(places[0]) or 1.0)
    p = np.log(places) if _is_geometric(places) else places
    middle = (p[1:] + p[:-1]) / 2
    edges = np.concatenate([[2 * p[0] - middle[0]], middle, [2 * p[-1] - middle[-1]]])
    return np.exp(edges) if _is_geometric(places) else edges


def _axis_values(coordinate: xarray.DataArray) -> np.ndarray:
    """Numbers along an axis; texts have the numbers from 0 on."""
    return coordinate.to_numpy().astype(float) if coordinate.dtype.kind in "fiub" else np.arange(coordinate.size) * 1.0


def _set_axis(ax: Axes, which: str, coordinate: xarray.DataArray, places: np.ndarray) -> None:
    axis = getattr(ax, f"{which}axis")
    if _is_geometric(np.sort(places)):
        getattr(ax, f"set_{which}scale")("log")
    if coordinate.dtype.kind not in "fiub":
        axis.set_ticks(places, [str(text) for text in coordinate.to_numpy()])
    axis.set_label_text(_label(coordinate))


def _colour_map(values: np.ndarray) -> dict[str, Any]:
    """A map that is even in lightness; for classes a colour each."""
    known = np.unique(values[np.isfinite(values)])
    if 0 < len(known) <= MAX_CLASSES and (known == np.round(known)).all():
        classes = np.arange(known.min(), known.max() + 2) - 0.5
        return {"cmap": plt.get_cmap("viridis", len(classes) - 1), "norm": BoundaryNorm(classes, len(classes) - 1)}
    return {"cmap": "viridis"}


def _draw_map(ax: Axes, values: xarray.DataArray, failed: xarray.DataArray, contours: int) -> None:
    down, across = (values[dim] for dim in values.dims)
    y, x = _axis_values(down), _axis_values(across)
    rows, columns = np.argsort(y), np.argsort(x)
    y, x, z = y[rows], x[columns], values.to_numpy()[np.ix_(rows, columns)]
    bad = failed.to_numpy()[np.ix_(rows, columns)]
    colours, seen = _colour_map(z), np.ma.masked_invalid(np.where(bad, np.nan, z))
    mesh = ax.pcolormesh(_cell_edges(x), _cell_edges(y), seen, rasterized=True, **colours)
    bar = ax.figure.colorbar(mesh, ax=ax, label=_label(values))
    if "norm" in colours:
        bar.set_ticks(np.unique(z[np.isfinite(z)]).tolist())
    elif contours and min(z.shape) > 2 and seen.count() > 3 and np.ptp(seen.compressed()) > 0.0:
        lines = ax.contour(x, y, seen, contours, colors="white", linewidths=0.6, alpha=0.8)
        ax.clabel(lines, fontsize="xx-small", fmt="%.3g")
    _hatch_cells(ax, _cell_edges(x), _cell_edges(y), bad)
    for which, coordinate, places in (("x", across, _axis_values(across)), ("y", down, _axis_values(down))):
        _set_axis(ax, which, coordinate, places)


def _hatch_cells(ax: Axes, x: np.ndarray, y: np.ndarray, bad: np.ndarray) -> None:
    """Hatch cells, neighbours in a row together."""
    patches = []
    for i, row in enumerate(bad):
        turns = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for first, last in zip(turns[::2], turns[1::2], strict=True):
            patches.append(Rectangle((x[first], y[i]), x[last] - x[first], y[i + 1] - y[i]))
    if patches:
        ax.add_collection(PatchCollection(patches, **HATCH_STYLE), autolim=False)
        _add_failure_legend(ax)


def _add_failure_legend(ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    handles, labels = [*handles, Patch(**HATCH_STYLE)], [*labels, "failed"]
    ax.legend(handles, labels, loc="upper left", fontsize="small", framealpha=0.9)


def _draw_lines(ax: Axes, values: xarray.DataArray, failed: xarray.DataArray, coordinate: xarray.DataArray) -> None:
    places = _axis_values(coordinate)
    order = np.argsort(places)
    z, bad = values.to_numpy().reshape(len(places), -1)[order], failed.to_numpy()[order]
    names = values[values.dims[1]].to_numpy() if values.ndim == 2 else [""]
    colours = (BLUE, ORANGE, GREEN, RED)
    for k, name in enumerate(names):
        style: dict[str, Any] = (
            {"color": colours[k], "label": str(name)} if len(names) <= len(colours) and values.ndim == 2 else {}
        )
        ax.plot(places[order], np.where(bad, np.nan, z[:, k]), marker="." if len(places) < 60 else "", **style)
    edges = _cell_edges(places[order])
    for i in np.flatnonzero(bad):
        ax.axvspan(edges[i], edges[i + 1], zorder=0, **HATCH_STYLE)
    _set_axis(ax, "x", coordinate, places)
    ax.set_ylabel(_label(values))
    ax.spines[["top", "right"]].set_visible(False)
    if bad.any():
        _add_failure_legend(ax)
    elif values.ndim == 2 and len(names) <= len(colours):
        ax.legend(frameon=False, fontsize="small")


def _draw_points(
    ax: Axes, values: xarray.DataArray, failed: xarray.DataArray, x: xarray.DataArray, y: xarray.DataArray
) -> None:
    z, bad = values.to_numpy(), failed.to_numpy()
    colours = _colour_map(z[~bad])
    good = ~bad & np.isfinite(z)
    points = ax.scatter(x.to_numpy()[good], y.to_numpy()[good], c=z[good], s=14, linewidth=0, **colours)
    ax.figure.colorbar(points, ax=ax, label=_label(values))
    if bad.any():
        ax.plot(x.to_numpy()[bad], y.to_numpy()[bad], "x", color=GREY, markersize=5, label="failed")
        ax.legend(loc="upper left", fontsize="small", framealpha=0.9)
    for which, coordinate in (("x", x), ("y", y)):
        places = coordinate.to_numpy().astype(float)
        if (places > 0.0).all() and places.max() > 50.0 * places.min():
            getattr(ax, f"set_{which}scale")("log")
        getattr(ax, f"set_{which}label")(_label(coordinate))
