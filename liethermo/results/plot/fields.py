"""Figure of a function on the sphere."""

from __future__ import annotations

import os

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...errors import InputError
from .figures import DPI, checked_figure_path, save_figure


def sphere_field(
    values,
    path: str | os.PathLike | None = None,
    ax: Axes | None = None,
    largest: float | None = None,
    title: str = "",
) -> Figure:
    """Plot a function on the sphere by colours, in a Mollweide projection, which preserves areas.

    Parameters
    ----------
    values : array, shape (latitudes, longitudes)
        Values at colatitudes ``pi (i + 1/2) / latitudes`` from the north and longitudes ``2 pi j / longitudes``, as
        :meth:`liethermo.models.QuantisedSphere.on_grid` gives them.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.
    ax : Axes, optional
        Draw here, an axes made with ``projection="mollweide"``; by default in a new figure.
    largest : float, optional
        The magnitude at which the colours end on both sides of zero; by default that of the values.
    title : str

    Raises
    ------
    InputError
        If the values are not finite and on a grid, ``ax`` has another projection, or the suffix of ``path`` is another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    field = np.asarray(values)
    if field.ndim != 2 or min(field.shape) < 2 or field.dtype.kind not in "fiu":
        raise InputError(f"values must be real numbers of shape (latitudes, longitudes), got shape {np.shape(values)}")
    if not np.isfinite(field).all():
        raise InputError("values must be finite")
    if ax is None:
        ax = plt.figure(figsize=(6.4, 3.4), dpi=DPI, layout="constrained").add_subplot(projection="mollweide")
    elif getattr(ax, "name", "") != "mollweide":
        raise InputError('ax must be made with projection="mollweide"')
    latitudes, longitudes = field.shape
    edges = np.linspace(-np.pi, np.pi, longitudes + 1), np.linspace(np.pi / 2, -np.pi / 2, latitudes + 1)
    colour_limit = float(np.abs(field).max()) if largest is None else largest
    centred_field = np.roll(field, longitudes // 2, axis=1)  # longitude zero is in the centre
    picture = ax.pcolormesh(
        *edges, centred_field, cmap="RdBu_r", vmin=-colour_limit, vmax=colour_limit, rasterized=True
    )
    ax.set(xticks=[], yticks=[], title=title)
    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.colorbar(picture, ax=ax, shrink=0.8)
    return save_figure(figure, path)
