"""Figures of a study: a heat map over two axes, lines over one, points of a sample."""

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
"""Names of the variables of a study that are not measures."""

MAX_CLASSES = 10
"""Largest number of different integers for which values are drawn as classes, each with its own colour."""

HATCH_STYLE: dict[str, Any] = {"hatch": "////", "facecolor": "0.93", "edgecolor": GREY, "linewidth": 0.0}
"""Style of the cells of points that failed."""


def study(
    dataset: xarray.Dataset,
    variable: str | None = None,
    path: str | os.PathLike | None = None,
    ax: Axes | None = None,
    contours: int = 8,
) -> Figure:
    """Plot a measure of a study over its axes; failed points are hatched, missing ones are left white.

    Over two axes it is a heat map with contours; over one a line, one for each component; over a sample of two
    parameters coloured points. An axis with geometrically spaced values is logarithmic. A measure with few integer
    values, such as the number of a basin, has a colour for each.

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
        Number of contours; 0 for none.

    Raises
    ------
    InputError
        If there is no such measure, it has too many axes, or the suffix of ``path`` is another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    if "status" not in dataset:
        raise InputError("dataset must be the results of a study, but it has no variable status")
    axes = [str(dim) for dim in dataset["status"].dims]
    values = dataset[_checked_or_first_measure_name(dataset, axes, variable)]
    extra_dims = [str(dim) for dim in values.dims if dim not in axes]
    point_coordinates = {name: c for name, c in dataset.coords.items() if c.dims == tuple(axes) and name not in axes}
    columns = [str(name) for name, c in point_coordinates.items() if c.dtype.kind in "fiu"]
    is_sample = len(axes) == 1 and len(columns) > 1
    if len(axes) not in (1, 2) or len(extra_dims) > (0 if is_sample or len(axes) == 2 else 1):
        dims = ", ".join(f"{dim} ({dataset.sizes[dim]})" for dim in (*axes, *extra_dims))
        raise InputError(
            f"a picture must have one or two axes, but {values.name} has {dims}. Choose points with results.isel(...)"
        )
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 4.4), dpi=DPI, layout="constrained")
    is_failed = _failed_point_mask(dataset)
    if is_sample:
        _draw_scatter_plot(ax, values, is_failed, *(dataset[name] for name in columns[:2]))
    elif len(axes) == 1:
        _draw_lines(ax, values.transpose(axes[0], *extra_dims), is_failed, dataset[axes[0]])
    else:
        _draw_heat_map(ax, values.transpose(*axes), is_failed.transpose(*axes), contours)
    return save_figure(ax.figure, path)  # type: ignore[arg-type]


def _checked_or_first_measure_name(dataset: xarray.Dataset, axes: list[str], variable: str | None) -> str:
    measures = [str(name) for name in dataset.data_vars if name not in NON_MEASURE_VARIABLES]
    if variable is not None:
        if variable not in measures:
            raise InputError(f"there is no measure {variable!r}; there are {', '.join(measures)}")
        return variable
    scalar_measures = [name for name in measures if set(dataset[name].dims) == set(axes)]
    if not (scalar_measures or measures):
        raise InputError("this dataset has no measure")
    return (scalar_measures or measures)[0]


def _failed_point_mask(dataset: xarray.Dataset) -> xarray.DataArray:
    """Return a mask of the points whose status is not "completed", "event" or "missing"."""
    codes = dict(zip(dataset["status"].flag_meanings.split(), dataset["status"].flag_values, strict=True))
    return ~dataset["status"].isin([codes[name] for name in ("completed", "event", "missing") if name in codes])


def _label_with_unit(values: xarray.DataArray) -> str:
    name, units = values.attrs.get("long_name", str(values.name)), values.attrs.get("units")
    return f"{name} [{units}]" if units else name


def _has_geometric_spacing(points: np.ndarray) -> bool:
    if len(points) < 3 or not (points > 0.0).all() or points.max() < 4.0 * points.min():
        return False
    gap_variations = [np.ptp(np.diff(p)) / np.abs(np.diff(p)).max() for p in (points, np.log(points))]
    return bool(gap_variations[1] < 0.1 < gap_variations[0])


def _cell_edges(centres: np.ndarray) -> np.ndarray:
    """Return the edges of cells around their centres: midpoints on a linear or, if geometric, logarithmic axis."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5]) * (abs(centres[0]) or 1.0)
    p = np.log(centres) if _has_geometric_spacing(centres) else centres
    midpoints = (p[1:] + p[:-1]) / 2
    edges = np.concatenate([[2 * p[0] - midpoints[0]], midpoints, [2 * p[-1] - midpoints[-1]]])
    return np.exp(edges) if _has_geometric_spacing(centres) else edges


def _numeric_axis_values(coordinate: xarray.DataArray) -> np.ndarray:
    """Return the values along an axis as numbers; texts are replaced by 0, 1, 2, …"""
    return coordinate.to_numpy().astype(float) if coordinate.dtype.kind in "fiub" else np.arange(coordinate.size) * 1.0


def _set_axis_scale_and_label(ax: Axes, axis_letter: str, coordinate: xarray.DataArray, points: np.ndarray) -> None:
    axis = getattr(ax, f"{axis_letter}axis")
    if _has_geometric_spacing(np.sort(points)):
        getattr(ax, f"set_{axis_letter}scale")("log")
    if coordinate.dtype.kind not in "fiub":
        axis.set_ticks(points, [str(text) for text in coordinate.to_numpy()])
    axis.set_label_text(_label_with_unit(coordinate))


def _colour_options(values: np.ndarray) -> dict[str, Any]:
    """Return plot options: a colour map of even lightness, with one colour for each class if the values are classes."""
    distinct_values = np.unique(values[np.isfinite(values)])
    if 0 < len(distinct_values) <= MAX_CLASSES and (distinct_values == np.round(distinct_values)).all():
        classes = np.arange(distinct_values.min(), distinct_values.max() + 2) - 0.5
        return {"cmap": plt.get_cmap("viridis", len(classes) - 1), "norm": BoundaryNorm(classes, len(classes) - 1)}
    return {"cmap": "viridis"}


def _draw_heat_map(ax: Axes, values: xarray.DataArray, failure_mask: xarray.DataArray, n_contours: int) -> None:
    y_coordinate, x_coordinate = (values[dim] for dim in values.dims)
    y, x = _numeric_axis_values(y_coordinate), _numeric_axis_values(x_coordinate)
    rows, columns = np.argsort(y), np.argsort(x)
    y, x, z = y[rows], x[columns], values.to_numpy()[np.ix_(rows, columns)]
    is_failed = failure_mask.to_numpy()[np.ix_(rows, columns)]
    colours, masked_values = _colour_options(z), np.ma.masked_invalid(np.where(is_failed, np.nan, z))
    mesh = ax.pcolormesh(_cell_edges(x), _cell_edges(y), masked_values, rasterized=True, **colours)
    bar = ax.figure.colorbar(mesh, ax=ax, label=_label_with_unit(values))
    if "norm" in colours:
        bar.set_ticks(np.unique(z[np.isfinite(z)]).tolist())
    elif n_contours and min(z.shape) > 2 and masked_values.count() > 3 and np.ptp(masked_values.compressed()) > 0.0:
        lines = ax.contour(x, y, masked_values, n_contours, colors="white", linewidths=0.6, alpha=0.8)
        ax.clabel(lines, fontsize="xx-small", fmt="%.3g")
    _hatch_cells(ax, _cell_edges(x), _cell_edges(y), is_failed)
    for letter, coordinate, points in (
        ("x", x_coordinate, _numeric_axis_values(x_coordinate)),
        ("y", y_coordinate, _numeric_axis_values(y_coordinate)),
    ):
        _set_axis_scale_and_label(ax, letter, coordinate, points)


def _hatch_cells(ax: Axes, x_edges: np.ndarray, y_edges: np.ndarray, is_failed: np.ndarray) -> None:
    """Hatch the cells of failed points; neighbours in a row are joined."""
    patches = []
    for i, row in enumerate(is_failed):
        turns = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for start, end in zip(turns[::2], turns[1::2], strict=True):
            patches.append(
                Rectangle((x_edges[start], y_edges[i]), x_edges[end] - x_edges[start], y_edges[i + 1] - y_edges[i])
            )
    if patches:
        ax.add_collection(PatchCollection(patches, **HATCH_STYLE), autolim=False)
        _add_failure_legend(ax)


def _add_failure_legend(ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    handles, labels = [*handles, Patch(**HATCH_STYLE)], [*labels, "failed"]
    ax.legend(handles, labels, loc="upper left", fontsize="small", framealpha=0.9)


def _draw_lines(
    ax: Axes, values: xarray.DataArray, failure_mask: xarray.DataArray, coordinate: xarray.DataArray
) -> None:
    points = _numeric_axis_values(coordinate)
    order = np.argsort(points)
    z, is_failed = values.to_numpy().reshape(len(points), -1)[order], failure_mask.to_numpy()[order]
    names = values[values.dims[1]].to_numpy() if values.ndim == 2 else [""]
    colours = (BLUE, ORANGE, GREEN, RED)
    for k, name in enumerate(names):
        style: dict[str, Any] = (
            {"color": colours[k], "label": str(name)} if len(names) <= len(colours) and values.ndim == 2 else {}
        )
        ax.plot(points[order], np.where(is_failed, np.nan, z[:, k]), marker="." if len(points) < 60 else "", **style)
    edges = _cell_edges(points[order])
    for i in np.flatnonzero(is_failed):
        ax.axvspan(edges[i], edges[i + 1], zorder=0, **HATCH_STYLE)
    _set_axis_scale_and_label(ax, "x", coordinate, points)
    ax.set_ylabel(_label_with_unit(values))
    ax.spines[["top", "right"]].set_visible(False)
    if is_failed.any():
        _add_failure_legend(ax)
    elif values.ndim == 2 and len(names) <= len(colours):
        ax.legend(frameon=False, fontsize="small")


def _draw_scatter_plot(
    ax: Axes, values: xarray.DataArray, failure_mask: xarray.DataArray, x: xarray.DataArray, y: xarray.DataArray
) -> None:
    z, is_failed = values.to_numpy(), failure_mask.to_numpy()
    colours = _colour_options(z[~is_failed])
    is_drawn = ~is_failed & np.isfinite(z)
    points = ax.scatter(x.to_numpy()[is_drawn], y.to_numpy()[is_drawn], c=z[is_drawn], s=14, linewidth=0, **colours)
    ax.figure.colorbar(points, ax=ax, label=_label_with_unit(values))
    if is_failed.any():
        ax.plot(x.to_numpy()[is_failed], y.to_numpy()[is_failed], "x", color=GREY, markersize=5, label="failed")
        ax.legend(loc="upper left", fontsize="small", framealpha=0.9)
    for letter, coordinate in (("x", x), ("y", y)):
        coordinate_values = coordinate.to_numpy().astype(float)
        if (coordinate_values > 0.0).all() and coordinate_values.max() > 50.0 * coordinate_values.min():
            getattr(ax, f"set_{letter}scale")("log")
        getattr(ax, f"set_{letter}label")(_label_with_unit(coordinate))
