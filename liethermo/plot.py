"""Pictures of a run: its path on the energy surface, and its laws along time."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from contourpy import contour_generator
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from scipy.ndimage import map_coordinates

from .audit import EPS, Tolerances
from .energy import Energy, Quadratic
from .errors import FileError, InputError
from .solution import Solution
from .systems import System

SUFFIXES = (".png", ".svg", ".pdf")
DPI = 150
MOST_SEGMENTS = 20_000
"""Longer trajectories are thinned for the 3D picture, which draws every segment by itself."""

# Okabe and Ito's colours, told apart by colour-blind readers, and a map that stays dark enough on white paper.
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "0.45"
TIME_MAP = plt.get_cmap("viridis")


# -- the path on the energy surface -------------------------------------------------------------------------------


def momentum_sphere(
    solution: Solution,
    system: System | None = None,
    path: str | os.PathLike | None = None,
    ax: Axes3D | None = None,
) -> Figure:
    """The trajectory on its energy surface, between the surfaces of constant entropy where it starts and ends.
    """
    path = _checked(path)
    x = solution.x
    if x.shape[-1] != 3:
        raise InputError(f"momentum_sphere draws states of three components, not {x.shape[-1]}; plot.laws draws any")
    if system is not None and system.dim != 3:
        raise InputError(f"this solution has three components, but the system {system.dim}")
    if ax is not None and not isinstance(ax, Axes3D):
        raise InputError("ax must be three-dimensional: make it with projection='3d'")
    if ax is None:
        ax = plt.figure(figsize=(6.4, 5.2), dpi=DPI, layout="constrained").add_subplot(projection="3d")
        ax.view_init(elev=22.0, azim=float(np.degrees(np.arctan2(x[-1, 1], x[-1, 0]))) + 50.0)
    ax.set_proj_type("ortho")
    ax.computed_zorder = False  # far side of the path, surface, nets, near side: in the order of their zorder
    size = float(np.linalg.norm(x, axis=1).max())

    energy, entropy = _energy_surface(solution, system), _entropy_function(solution, system)
    surface = None if energy is None else _level_surface(energy, x[0], _sphere(90, 180), size)
    view = _viewpoint(ax)
    if surface is None:
        hidden = lambda points: np.zeros(points.shape[:-1], dtype=bool)
    else:
        hidden = lambda points: _hidden(energy, x[0], points, view, size)
        right, up = _screen(view)
        # light from upper left front
        ax.plot_surface(*surface.T, color="0.93", alpha=0.85, linewidth=0, rcount=90, ccount=180, zorder=2, lightsource=LightSource(azdeg=90-ax.azim+40, altdeg=50))
        ax.plot([], [], [], "s", color="0.8", label=f"energy $H = {solution.energy[0]:.4g}$")
    if entropy is not None:
        if surface is not None:
          values = np.asarray(entropy(surface))
          gen = contour_generator(z=np.ma.masked_invalid(values))
          for level in np.linspace(np.nanmin(values), np.nanmax(values), 12)[1:-1]:
            for line in gen.lines(level):
                pts = np.stack([map_coordinates(surface[..., k], line.T[::-1], order=1) for k in range(3)], -1)
                _curve(ax, pts, hidden(pts), color="0.6", lw=0.5, z=2.5, faint=0)
        levels = [(0, ORANGE, "initial"), (-1, BLUE, "final")]
        for index, color, label in levels:
            if surface is not None:
              for line in gen.lines(float(entropy(x[index]))):
                pts = np.stack([map_coordinates(surface[..., k], line.T[::-1], order=1) for k in range(3)], -1)
                _curve(ax, pts, hidden(pts), color=color, lw=1., z=2.5, faint=0.3)
            for normal in (*np.eye(3), view):
                pts = _level_surface(entropy, x[index], _circle(normal), size)
                _curve(ax, pts, hidden(pts), color=color, lw=0.6, z=3, faint=0.25)
            ax.plot([], [], [], color=color, label=f"{label} entropy $S={solution.entropy[index]:.4g}$")
    _path(ax, solution, hidden(x))

    name = "x" if solution.provenance.get("algebra") is None else r"\mu"
    ax.set(xlabel=f"${name}_1$", ylabel=f"${name}_2$", zlabel=f"${name}_3$")
    ax.set_aspect("equal")
    ax.locator_params(nbins=4)
    for a in (ax.xaxis, ax.yaxis, ax.zaxis):
        a.set_pane_color("1.0")
        a._axinfo["grid"].update(color="0.9", linewidth=0.5)
    ax.legend(loc="upper left", frameon=False, fontsize="small", handlelength=1.2)
    return _finished(ax.figure, path)

def _curve(ax, pts, hidden, color, lw, z, faint):
    for mask, alpha, zorder in ((~hidden, faint, 1), (hidden, 1.0, z)):
        if alpha:
            ax.plot(*np.where(mask[:, None], np.nan, pts).T, color=color, alpha=alpha, lw=lw, zorder=zorder)

def _screen(view):
    right = np.cross([0, 0, 1.0], view)
    right /= np.linalg.norm(right)
    return right, np.cross(view, right)

def _path(ax: Axes3D, solution: Solution, hidden: np.ndarray) -> None:
    """The trajectory, coloured by time and pale where it is not ``near``; its start and its end."""
    stride = 1 + (len(solution.t) - 1) // MOST_SEGMENTS
    kept = np.unique(np.append(np.arange(0, len(solution.t), stride), len(solution.t) - 1))
    t, x, hidden = solution.t[kept], solution.x[kept], hidden[kept]
    segments, middles = np.stack([x[:-1], x[1:]], axis=1), (t[:-1] + t[1:]) / 2
    scale = plt.Normalize(t[0], t[-1])
    seen = ~(hidden[:-1] & hidden[1:])
    for side, alpha, zorder in ((~seen, 0.35, 1), (seen, 1.0, 4)):
        if not side.any():
            continue
        lines = Line3DCollection(segments[side], colors=TIME_MAP(scale(middles[side])), alpha=alpha, linewidths=1.6)
        lines.set(zorder=zorder, capstyle="round")
        ax.add_collection3d(lines)
    ends = ((0, "o", "white", "start"), (-1, "o", "black", "end"))
    for index, marker, face, label in ends:
        ax.plot(
            *x[[index]].T, marker, mfc=face, mec="black", ms=5, zorder=1.5 if hidden[index] else 5, label=label, ls="none"
        )
    bar = plt.cm.ScalarMappable(scale, TIME_MAP)
    ax.figure.colorbar(bar, ax=ax, label="time $t$", shrink=0.6, pad=0.08, aspect=30)


def _energy_surface(solution: Solution, system: System | None) -> Energy | None:
    """The system's energy; without a system, the one quadric that passes through every state, if it is one."""
    if system is not None:
        return system.energy
    i, j = np.triu_indices(3)
    scale = float(np.abs(solution.x).max())
    x = solution.x / scale
    monomials = np.column_stack([x[:, i] * x[:, j], x, np.ones(len(x))])
    if len(x) < monomials.shape[1]:
        return None
    _, singular, rows = np.linalg.svd(monomials, full_matrices=False)
    if singular[-1] > 1e-13 * singular[0] or singular[-2] < 1e-7 * singular[0]:
        return None  # no quadric, or a choice of several
    square = np.zeros((3, 3))
    square[i, j] = rows[-1, :6]
    return Quadratic((square + square.T) / scale**2, rows[-1, 6:9] / scale, rows[-1, 9])


def _entropy_function(solution: Solution, system: System | None) -> Energy | None:
    if system is not None:
        return system.entropy
    spheres = solution.provenance.get("algebra") in ("so(3)", "su(2)", "bianchi('IX')")
    return Quadratic(np.ones(3)) if spheres else None


def _hidden(function, point, points, view, size):
    level = float(function(point))
    depths = np.geomspace(0.01, 3.0, 60)[:, None, None]*size
    above = np.asarray(function(points + depths * view)) > level
    return (above[1:] != above[:-1]).any(axis=0)


def _level_surface(function: Energy, point: np.ndarray, directions: np.ndarray, size) -> np.ndarray | None:
    level = float(function(point))
    inside = float(function(np.zeros(3))) > level
    radii = np.append(0.0, np.geomspace(0.01 * size, 10.0 * size, 60))
    above = np.asarray(function(radii.reshape(-1, *[1]*directions.ndim) * directions)) > level
    crossings = above[1:] != above[:-1]
    if (crossings.sum(axis=0) > 1).any() or not crossings.any():
        return None
    first = crossings.argmax(axis=0)
    low, high = radii[first], radii[first + 1]
    for _ in range(40):
        middle = (low + high) / 2
        beyond = (np.asarray(function(middle[..., None] * directions)) > level) != inside
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    hit = crossings.any(axis=0)
    if not hit.all():
        hit &= high <= 1.5 * size
    return np.where(hit[..., None], high[..., None] * directions, np.nan)


def _sphere(rows: int, columns: int) -> np.ndarray:
    """Unit vectors on circles of latitude, shape (rows + 1, columns + 1, 3)."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)

def _circle(normal):
    _,_,rows=np.linalg.svd(normal[None])
    phi=np.linspace(0,2*np.pi,361)
    return np.cos(phi)[:,None]*rows[1]+np.sin(phi)[:,None]*rows[2]

def _viewpoint(ax: Axes3D) -> np.ndarray:
    elev, azim = np.radians([ax.elev, ax.azim])
    return np.array([np.cos(elev) * np.cos(azim), np.cos(elev) * np.sin(azim), np.sin(elev)])


def _checked(path):
    if path is None:
        return None
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} must end in one of {', '.join(SUFFIXES)}")
    return path


def _finished(figure, path):
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=DPI)
        except OSError as error:
            raise FileError(f"cannot write {path}: {error}") from error
        plt.close(figure)
    return figure
