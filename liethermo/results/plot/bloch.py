"""Figure of the states of a qubit in the Bloch ball."""

from __future__ import annotations

import os

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from ...errors import InputError
from ...systems import QuantumSystem
from ..solution import Solution
from .figures import BLUE, DPI, GREY, RED, checked_figure_path, save_figure
from .surfaces import sphere_grid


def bloch_ball(
    states,
    system: QuantumSystem,
    part: int | str = 0,
    path: str | os.PathLike | None = None,
    ax: Axes3D | None = None,
    labels: tuple[str, str] = ("0", "1"),
) -> Figure:
    """Plot the states of a qubit in the Bloch ball: a curve that ends in a red point.

    Pure states lie on the sphere, the completely mixed state in its centre. The first level of the Hamiltonian is the
    north pole, the second one the south pole, as of :meth:`liethermo.QuantumSystem.bloch`.

    Parameters
    ----------
    states : Solution, or array, shape (n,) or (..., n)
        A run, or states; several curves if there are two leading axes, such as the trajectories of an ensemble.
    system : QuantumSystem
        The system of the states.
    part : int or str
        The qubit, in a product of systems.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.
    ax : Axes3D, optional
        Draw here, an axes made with ``projection="3d"``; by default in a new figure.
    labels : (str, str)
        Names of the two levels.

    Raises
    ------
    InputError
        If the system has no qubit with this number, ``ax`` has another projection, or the suffix of ``path`` is
        another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    if not isinstance(system, QuantumSystem):
        raise InputError(f"a Bloch ball shows states of an lt.QuantumSystem, not of a {type(system).__name__}")
    vectors = np.asarray(system.bloch(states.x if isinstance(states, Solution) else states, part))
    if ax is None:
        ax = plt.figure(figsize=(4.6, 4.6), dpi=DPI, layout="constrained").add_subplot(projection="3d")
    elif not isinstance(ax, Axes3D):
        raise InputError('ax must be made with projection="3d"')
    x, y, z = np.moveaxis(sphere_grid(24, 36), -1, 0)
    ax.plot_wireframe(x, y, z, rstride=2, cstride=2, color=GREY, alpha=0.25, linewidth=0.4)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    ax.plot(np.cos(angle), np.sin(angle), np.zeros_like(angle), color=GREY, linewidth=0.6)
    for direction in np.eye(3):
        ax.plot(*np.outer(direction, [-1.0, 1.0]), color=GREY, linewidth=0.6)
    for curve in vectors.reshape(-1, *vectors.shape[-2:]) if vectors.ndim > 1 else vectors[None, None]:
        if len(curve) > 1:
            ax.plot(*curve.T, color=BLUE, linewidth=1.2)
        ax.scatter(*curve[-1:].T, color=RED, s=22, depthshade=False)
    ax.text(0.0, 0.0, 1.15, labels[0], ha="center", va="center")
    ax.text(0.0, 0.0, -1.15, labels[1], ha="center", va="center")
    ax.set(xlabel="x", ylabel="y", xticks=[-1, 0, 1], yticks=[-1, 0, 1], zticks=[-1, 0, 1], box_aspect=(1, 1, 1))
    ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
    figure = ax.get_figure(root=True)
    assert figure is not None
    return save_figure(figure, path)
