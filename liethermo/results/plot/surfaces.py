"""Figures on surfaces: a trajectory on its energy and Casimir surfaces, a function on the sphere, the Bloch ball."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from contourpy import contour_generator
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from scipy.ndimage import map_coordinates

from ...errors import InputError
from ...systems import QuantumSystem, System
from ...systems.invariants import recorded_functions_with_verdicts
from ...systems.kind_checks import require_kind
from ..solution import Solution
from .figures import BLUE, DPI, GREY, ORANGE, RED, checked_figure_path, save_figure

MAX_SEGMENTS = 20_000
"""Largest number of segments in a 3D figure, each drawn by itself; longer trajectories are thinned."""

TIME_COLORMAP = plt.get_cmap("viridis")
"""Colour map of the time along a trajectory."""

PointFunction = Callable[[np.ndarray], np.ndarray]  # points, shape (..., 3), to values, shape (...)


def momentum_sphere(
    solution: Solution,
    system: System | None = None,
    path: str | os.PathLike | None = None,
    ax: Axes3D | None = None,
) -> Figure:
    """Plot a trajectory on its energy surface, with the surfaces of constant entropy on which it starts and ends.

    The energy surface is solid, with lines of constant entropy on it; the entropy surfaces are drawn by their sections
    with the coordinate planes and the plane of the paper. The trajectory is coloured by time. Parts that the solid
    hides from the viewpoint of ``ax`` are pale or left out, so turn the axes before drawing, not after. A system
    without entropy shows its first Casimir or momentum map instead. If the energy decreases (double bracket), the two
    functions change places. They also do for a system with baths, which are left out: the body loses the energy that
    they gain.

    Surfaces are found along rays from the origin. A surface that a ray meets twice is left out; one that does not close
    around the origin, such as a cylinder, is drawn by sections that end a little beyond the trajectory.

    Parameters
    ----------
    solution : Solution
        A result of a system with three components, such as one on so(3)*, and baths besides.
    system : System, optional
        The system that was integrated, which a solution read from a file does not know. Without it the energy surface
        is the quadric through all states, if there is exactly one, and the entropy surfaces are spheres if the algebra
        is so(3) or su(2), where every Casimir is a function of ``|mu|``; what remains unknown is left out. The axes are
        labelled by the names of the basis elements of its algebra, if they have some.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.
    ax : Axes3D, optional
        Draw here; by default in a new figure, seen from the side on which the trajectory ends.

    Raises
    ------
    InputError
        If the states do not have three components, ``ax`` is flat, or the suffix of ``path`` is another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    if system is not None and system.body_dim < system.dim == solution.x.shape[1]:
        solution = _body_solution(solution, system)
    if solution.x.shape[1] != 3:
        raise InputError(
            f"momentum_sphere draws states of 3 components, got {solution.x.shape[1]}. If the others are the entropies "
            "of baths, pass the system too; lt.plot.laws draws any solution"
        )
    if system is not None and system.body_dim != 3:
        raise InputError(f"system must have 3 components like the solution, got {system.body_dim}")
    if ax is not None and not isinstance(ax, Axes3D):
        raise InputError("ax must be three-dimensional. Make it with subplot_kw={'projection': '3d'}")
    if ax is None:
        ax = plt.figure(figsize=(6.4, 5.2), dpi=DPI, layout="constrained").add_subplot(projection="3d")
        _turn_axes_towards(solution.x[-1], ax)
    ax.set_proj_type("ortho")
    ax.computed_zorder = False  # the zorder of each piece is set here

    scene = _Scene(ax, solution.x)
    conserved_quantity, changing_quantity = _conserved_and_changing_quantity(solution, system)
    if conserved_quantity is not None:
        scene.draw_solid(conserved_quantity.function, conserved_quantity.label(0))
    if changing_quantity is not None:
        scene.draw_contours(changing_quantity.function, 12)
        scene.draw_level_surface(changing_quantity.function, 0, ORANGE, changing_quantity.label(0))
        if not changing_quantity.is_constant:
            scene.draw_level_surface(changing_quantity.function, -1, BLUE, changing_quantity.label(-1))
    _draw_trajectory(solution, scene)

    name = "x" if solution.provenance.get("algebra") is None else r"\mu"
    algebra = None if system is None else system.lie_algebra
    names = None if algebra is None else algebra.basis_names
    x, y, z = names or (f"${name}_{i}$" for i in (1, 2, 3))
    ax.set(xlabel=x, ylabel=y, zlabel=z)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color("white")
        axis._axinfo["grid"].update(color="0.9", linewidth=0.5)
    ax.locator_params(nbins=4)
    ax.set_box_aspect((1, 1, 1), zoom=0.95)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(loc="upper left", frameon=False, fontsize="small", handlelength=1.2)
    return save_figure(ax.figure, path)


def _body_solution(solution: Solution, system: System) -> Solution:
    """Return the solution of a system with baths restricted to its body: states and energy of the body."""
    x = solution.x[:, : system.body_dim]
    energy = np.asarray(_restrict_to_body(system.energy, system)(x))
    laws = dataclasses.replace(solution.laws, energy="nonincreasing")
    return dataclasses.replace(solution, x=x, energy=energy, entropy=None, laws=laws)


def _restrict_to_body(function: Callable, system: System) -> Callable:
    """Return a function of the states of a system as a function of its body, with the entropies of baths zero."""
    n_bath_entropies = system.dim - system.body_dim
    return lambda x: function(jnp.concatenate([x, jnp.zeros((*x.shape[:-1], n_bath_entropies))], axis=-1))


@dataclass(frozen=True)
class _Quantity:
    """A function of the state, with its values along a run."""

    name: str
    function: PointFunction
    values: np.ndarray

    @property
    def is_constant(self) -> bool:
        return float(np.ptp(self.values)) <= 1e-9 * float(np.abs(self.values).max())

    def label(self, index: int) -> str:
        position_label = "" if self.is_constant else (" at end", " at start")[index + 1]
        return f"{self.name}{position_label} ${self.values[index]:.4g}$"


SQUARED_NORM = "mu1**2 + mu2**2 + mu3**2"
"""Name of the Casimir of so(3), the square of the length of the momentum."""


def _conserved_and_changing_quantity(
    solution: Solution, system: System | None
) -> tuple[_Quantity | None, _Quantity | None]:
    """Return the conserved and the changing quantity of a run, usually energy and entropy; None if unknown."""
    energy: PointFunction | None
    entropy: PointFunction | None
    name = SQUARED_NORM
    if system is not None:
        energy = _vectorize_in_blocks(_restrict_to_body(system.energy, system))
        # the entropy of baths is no function of the body
        body_entropy = system.entropy if system.body_dim == system.dim else None
        function = body_entropy
        if function is None:
            functions = recorded_functions_with_verdicts(system).items()
            name, function = next(((name, J) for name, (J, is_conserved) in functions if is_conserved), (name, None))
        entropy = None if function is None else _vectorize_in_blocks(_restrict_to_body(function, system))
    else:
        energy = _fit_quadric(solution.x) if solution.laws.energy == "conserved" else None
        spheres = solution.provenance.get("algebra") in ("so(3)", "su(2)", "bianchi('IX')")
        entropy = (lambda x: (x * x).sum(axis=-1)) if spheres else None
    quantities = [None if energy is None else _Quantity("energy", energy, solution.energy), None]
    if entropy is not None and solution.entropy is not None:
        quantities[1] = _Quantity("entropy", entropy, solution.entropy)
    elif entropy is not None:
        quantities[1] = _Quantity(r"$|\mu|^2$" if name == SQUARED_NORM else name, entropy, entropy(solution.x))
    return (quantities[0], quantities[1]) if solution.laws.energy == "conserved" else (quantities[1], quantities[0])


VALUES_PER_BLOCK = 8192
"""Number of points at which a function is evaluated by one call of its program."""


def _vectorize_in_blocks(function: Callable) -> PointFunction:
    """Return a function of one point vectorized over point arrays of any shape; blocks of one size compile it once."""
    compiled_function = jax.jit(lambda x: function(x))

    def evaluate(points: np.ndarray) -> np.ndarray:
        flat_points = points.reshape(-1, 3)
        padded_blocks = np.concatenate([flat_points, np.zeros((-len(flat_points) % VALUES_PER_BLOCK, 3))]).reshape(
            -1, VALUES_PER_BLOCK, 3
        )
        return np.concatenate([compiled_function(x) for x in padded_blocks])[: len(flat_points)].reshape(
            points.shape[:-1]
        )

    return evaluate


def _fit_quadric(states: np.ndarray) -> PointFunction | None:
    """Return the quadratic polynomial that vanishes at all states; None unless it is unique up to a factor."""
    scale = float(np.abs(states).max()) or 1.0
    i, j = np.triu_indices(3)

    def monomials(points: np.ndarray) -> np.ndarray:
        x = points / scale
        return np.concatenate([x[..., i] * x[..., j], x, np.ones((*x.shape[:-1], 1))], axis=-1)

    if len(states) < 10:
        return None
    _, singular_values, rows = np.linalg.svd(monomials(states), full_matrices=False)
    is_unique = singular_values[-1] < 1e-13 * singular_values[0] and singular_values[-2] > 1e-7 * singular_values[0]
    return (lambda points: monomials(points) @ rows[-1]) if is_unique else None


class _LevelSurface:
    """Level surface of a function through a point, whose points are found along rays from the origin.

    Attributes
    ----------
    is_simple, is_closed : bool
        Whether some ray meets the surface and none meets it twice; whether every ray meets it.
    """

    def __init__(self, function: PointFunction, point: np.ndarray, extent: float):
        self.function, self.level, self.extent = function, float(function(point)), extent
        self.radii = np.append(0.0, np.geomspace(0.01 * extent, 10.0 * extent, 60))
        meetings = self._ray_crossings(unit_sphere_grid(16, 32)).sum(axis=0)
        self.is_simple, self.is_closed = bool(meetings.max() == 1), bool((meetings == 1).all())

    def intersect_rays(self, directions: np.ndarray) -> np.ndarray:
        """Return the points where rays along unit vectors, shape (..., 3), meet the surface; NaN for other rays."""
        has_crossing = self._ray_crossings(directions)
        first_interval = has_crossing.argmax(axis=0)
        inner_radius, outer_radius = self.radii[first_interval], self.radii[first_interval + 1]
        inner_side = self._is_above_level(inner_radius[..., None] * directions)
        for _ in range(40):
            midpoint = (inner_radius + outer_radius) / 2
            is_on_inner_side = self._is_above_level(midpoint[..., None] * directions) == inner_side
            inner_radius, outer_radius = (
                np.where(is_on_inner_side, midpoint, inner_radius),
                np.where(is_on_inner_side, outer_radius, midpoint),
            )
        is_hit = has_crossing.any(axis=0) & (self.is_closed | (outer_radius <= 1.5 * self.extent))
        return np.where(is_hit[..., None], outer_radius[..., None] * directions, np.nan)

    def hides(self, points: np.ndarray, view_direction: np.ndarray) -> np.ndarray:
        """Return whether the surface hides points, shape (..., 3), from a distant viewer in a direction."""
        depths = np.geomspace(0.01, 20.0, 80) * self.extent
        side = self._is_above_level(points + depths.reshape(-1, *[1] * points.ndim) * view_direction)
        return (side[1:] != side[:-1]).any(axis=0)

    def _is_above_level(self, points: np.ndarray) -> np.ndarray:
        return self.function(points) > self.level

    def _ray_crossings(self, directions: np.ndarray) -> np.ndarray:
        """Return whether rays cross the surface in each interval of ``radii``, shape (intervals, ...)."""
        side = self._is_above_level(self.radii.reshape(-1, *[1] * directions.ndim) * directions)
        return side[1:] != side[:-1]


class _Scene:
    """3D axes in which a solid and curves around it are drawn, without the parts of curves that the solid hides."""

    def __init__(self, ax: Axes3D, states: np.ndarray):
        self.ax, self.states, self.view_direction = ax, states, _view_direction(ax)
        self.extent = float(np.linalg.norm(states, axis=1).max()) or 1.0
        self.solid: _LevelSurface | None = None

    def draw_solid(self, function: PointFunction, label: str) -> None:
        """Draw the level surface of a function through the first state as a solid, or its sections if it is open."""
        surface = _LevelSurface(function, self.states[0], self.extent)
        if not surface.is_closed:
            self.draw_level_surface(function, 0, GREY, label)
            return
        self.solid, self.mesh = surface, surface.intersect_rays(unit_sphere_grid(96, 192))
        normals = np.cross(np.gradient(self.mesh, axis=0), np.gradient(self.mesh, axis=1))
        normals[[0, -1]] = normals[[1, -2]]  # the normals vanish at the poles of the mesh
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        grey = 0.80 + 0.18 * normals @ (0.6 * self.view_direction + [0.0, 0.0, 0.8])  # lit from in front and above
        shades = np.repeat(np.clip(grey, 0.0, 1.0)[..., None], 3, axis=-1)
        style = {"rstride": 1, "cstride": 1, "shade": False, "antialiased": False, "linewidth": 0, "zorder": 1}
        self.ax.plot_surface(*np.moveaxis(self.mesh, -1, 0), facecolors=shades, **style)
        self.ax.plot([], [], [], "s", color="0.85", label=label)
        for line in _level_curves(self.mesh, normals @ self.view_direction, 0.0):
            self._draw_line(line, color=GREY, linewidth=0.8)

    def draw_contours(self, function: PointFunction, n_contours: int) -> None:
        """Draw curves on the solid along which the function is constant."""
        if self.solid is not None:
            values = function(self.mesh)
            for level in np.linspace(values.min(), values.max(), n_contours + 2)[1:-1]:
                self._draw_contour(values, level, color=GREY, linewidth=0.4)

    def draw_level_surface(self, function: PointFunction, index: int, color: str, label: str) -> None:
        """Draw plane sections of the level surface through a state, and its intersection with the solid."""
        surface = _LevelSurface(function, self.states[index], self.extent)
        if not surface.is_simple:
            return
        for normal in (*np.eye(3), self.view_direction):
            section = surface.intersect_rays(_great_circle(normal))
            is_visible, is_behind = ~self.is_hidden(section), surface.hides(section, self.view_direction)
            self._draw_line(section, is_visible & ~is_behind, color=color, linewidth=0.7)
            self._draw_line(section, is_visible & is_behind, color=color, linewidth=0.7, alpha=0.3)
        if self.solid is not None:
            self._draw_contour(function(self.mesh), surface.level, color=color, linewidth=1.2)
        self.ax.plot([], [], [], color=color, label=label)

    def is_hidden(self, points: np.ndarray) -> np.ndarray:
        """Return whether the solid hides points, shape (m, 3)."""
        return (
            np.zeros(len(points), dtype=bool) if self.solid is None else self.solid.hides(points, self.view_direction)
        )

    def _draw_line(self, points: np.ndarray, is_visible: np.ndarray | bool = True, **style) -> None:
        self.ax.plot(*np.where(np.reshape(is_visible, (-1, 1)), points, np.nan).T, zorder=2, **style)

    def _draw_contour(self, values: np.ndarray, level: float, **style) -> None:
        for line in _level_curves(self.mesh, values, level):
            self._draw_line(line, ~self.is_hidden(line), **style)


def _level_curves(mesh: np.ndarray, values: np.ndarray, level: float) -> Iterator[np.ndarray]:
    """Yield the curves, shape (m, 3), in a mesh (rows, columns, 3) on which ``values`` equal the level."""
    contours: Any = contour_generator(z=values)
    for line in contours.lines(level):
        column, row = line.T
        yield np.stack([map_coordinates(mesh[..., k], [row, column], order=1) for k in range(3)], axis=-1)


def _draw_trajectory(solution: Solution, scene: _Scene) -> None:
    """Draw the trajectory, coloured by time and pale where it is hidden, with its start and its end."""
    n_segments = len(solution.t) - 1
    indices = np.linspace(0, n_segments, min(n_segments, MAX_SEGMENTS) + 1).round().astype(int)
    t, x = solution.t[indices], solution.x[indices]
    is_hidden = scene.is_hidden(x)
    scale = Normalize(solution.t[0], solution.t[-1])
    segments, colors = np.stack([x[:-1], x[1:]], axis=1), TIME_COLORMAP(scale((t[:-1] + t[1:]) / 2))
    is_segment_hidden = is_hidden[:-1] & is_hidden[1:]
    for is_selected, alpha, zorder in ((is_segment_hidden, 0.25, 3), (~is_segment_hidden, 1.0, 4)):
        if is_selected.any():
            lines = Line3DCollection(
                segments[is_selected], colors=colors[is_selected], alpha=alpha, linewidths=1.7, zorder=zorder
            )
            lines.set_capstyle("round")  # otherwise gaps show at the joints of segments
            scene.ax.add_collection3d(lines)
    for i, face, label in ((0, "white", "start"), (-1, "black", "end")):
        style = {"color": "black", "markerfacecolor": face, "markersize": 5, "zorder": 5}
        scene.ax.plot(*x[[i]].T, "o", alpha=0.25 if is_hidden[i] else 1.0, **style)
        scene.ax.plot([], [], [], "o", label=label, **style)
    bar = {"label": "time", "shrink": 0.6, "pad": 0.05, "aspect": 30}
    scene.ax.figure.colorbar(ScalarMappable(scale, TIME_COLORMAP), ax=scene.ax, **bar)


def unit_sphere_grid(latitude_cells: int, longitude_cells: int) -> np.ndarray:
    """Return unit vectors by latitude and longitude, shape (latitude_cells + 1, longitude_cells + 1, 3)."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, latitude_cells + 1), np.linspace(0, 2 * np.pi, longitude_cells + 1), indexing="ij"
    )
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def _great_circle(normal: np.ndarray) -> np.ndarray:
    """Return unit vectors orthogonal to ``normal``, one a degree, shape (361, 3)."""
    phi = np.linspace(0, 2 * np.pi, 361)[:, None]
    _, _, (_, a, b) = np.linalg.svd(normal[None])
    return np.cos(phi) * a + np.sin(phi) * b


def _view_direction(ax: Axes3D) -> np.ndarray:
    """Return the unit vector from the origin towards the viewer of the axes."""
    elevation, azimuth = np.radians([ax.elev, ax.azim])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def _turn_axes_towards(state: np.ndarray, ax: Axes3D) -> None:
    """Turn the axes so that the state is on the near side, seen from above if possible."""
    azimuth = float(np.degrees(np.arctan2(state[1], state[0]))) + 40.0
    ax.view_init(elev=22.0, azim=azimuth)
    if _view_direction(ax) @ state < 0.0:
        ax.view_init(elev=-22.0, azim=azimuth)


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
        Title of the figure.

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
        raise InputError("values must be finite, got NaN or infinity")
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
    require_kind(system, QuantumSystem, "a Bloch ball")
    vectors = np.asarray(system.bloch(states.x if isinstance(states, Solution) else states, part))
    if ax is None:
        ax = plt.figure(figsize=(4.6, 4.6), dpi=DPI, layout="constrained").add_subplot(projection="3d")
    elif not isinstance(ax, Axes3D):
        raise InputError('ax must be made with projection="3d"')
    x, y, z = np.moveaxis(unit_sphere_grid(24, 36), -1, 0)
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
