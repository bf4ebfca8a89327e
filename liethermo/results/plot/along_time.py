"""Figures of runs: the laws over time, projections of orbits, and the change of invariants."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from manifolds._arguments import is_integer

from ...errors import InputError
from ...functions.gradients import EPS
from ...systems import System
from ...systems.invariants import recorded_functions_with_verdicts
from ..audit import LAW_FAILURE_VERDICT, Audit
from ..solution import Solution
from .figures import BLUE, DPI, GREEN, GREY, ORANGE, RED, checked_figure_path, save_figure


def laws(solution: Solution, path: str | os.PathLike | None = None) -> Figure:
    """Plot energy error, entropy and entropy production of a run, with the verdict of the audit as title.

    The production is the difference quotient of the saved entropies, on a logarithmic axis. Increments below the
    rounding of the entropy itself (the tolerance of the audit) are marked at that level in grey, larger decreases in
    red by their magnitude. A solution without entropy has the first panel only.

    Parameters
    ----------
    solution : Solution
        The run to plot.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If the suffix of ``path`` is another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    panels, audit = 1 if solution.entropy is None else 3, solution.audit()
    figure, axes = plt.subplots(
        panels, sharex=True, squeeze=False, figsize=(6.4, 1.1 + 1.7 * panels), dpi=DPI, layout="constrained"
    )
    _draw_energy_error(axes[0, 0], solution.t, solution.energy_balance, " - W" if solution.laws.balance else "")
    if solution.entropy is not None:
        _draw_entropy(axes[1, 0], solution.t, solution.entropy)
        _draw_entropy_production(axes[2, 0], solution.t, solution.entropy, _allowed_entropy_fall(audit))
    for ax in axes[:, 0]:
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0.0)
    axes[-1, 0].set_xlabel("time")
    figure.align_ylabels()
    figure.suptitle(_verdict_title(audit), color="black" if audit.passed else RED, fontsize="medium")
    return save_figure(figure, path)


def _draw_energy_error(ax: Axes, t: np.ndarray, H: np.ndarray, work_label: str) -> None:
    """Draw the energy error relative to the initial energy over time; ``work_label`` is " - W" or ""."""
    initial_energy = float(H[0])
    error = (H - initial_energy) / (abs(initial_energy) or 1.0)
    max_error = float(np.abs(error).max())
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    if max_error < 20 * EPS:  # the scale is one unit of rounding
        ax.axhspan(-EPS, EPS, color="0.93", linewidth=0)
        ax.set_ylim(-1.4 * max(max_error, EPS), 1.4 * max(max_error, EPS))
    ax.plot(t, error, color=BLUE, linewidth=0.8)
    ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)
    ax.set_ylabel(rf"$(H{work_label} - H_0)\,/\,|H_0|$" if initial_energy else f"$H{work_label} - H_0$")


def _draw_entropy(ax: Axes, t: np.ndarray, S: np.ndarray) -> None:
    """Draw the entropy over time, with a dashed line at its final value if it has converged."""
    ax.plot(t, S, color=BLUE, linewidth=1.5)
    ax.set_ylabel("entropy $S$")
    change = float(np.ptp(S))
    if change <= 1e-9 * float(np.abs(S).max()):  # constant: do not magnify its rounding
        width = 0.01 * abs(float(S[0])) or 1.0
        ax.set_ylim(S[0] - width, S[0] + width)
    tail = S[t >= t[-1] - 0.1 * (t[-1] - t[0])]
    if len(tail) > 2 and float(np.ptp(tail)) <= 1e-4 * change:
        ax.axhline(S[-1], color=GREY, linewidth=0.8, linestyle="--", zorder=1)
        transform = ax.get_yaxis_transform()  # x in units of the axes, y of the data
        style: dict[str, Any] = {"ha": "right", "va": "top", "color": "0.3", "fontsize": "small"}
        ax.annotate(f"{S[-1]:.6g}", (1.0, S[-1]), (0, -4), transform, "offset points", **style)


def _allowed_entropy_fall(audit: Audit) -> float:
    """Return the decrease of the entropy in one step that the audit allows."""
    return next((-row.tolerance for row in audit.rows if row.law == "least entropy increment" and row.tolerance), 0.0)


def _draw_entropy_production(ax: Axes, t: np.ndarray, S: np.ndarray, rounding_threshold: float) -> None:
    """Draw dS/dt on a logarithmic axis; increments below ``rounding_threshold`` are grey, larger decreases red."""
    dt, dS, t = np.diff(t), np.diff(S), (t[:-1] + t[1:]) / 2
    rounding_threshold = rounding_threshold or 4 * EPS * float(np.abs(S).max())
    is_rising, is_falling = dS > rounding_threshold, dS < -rounding_threshold
    is_constant = ~(is_rising | is_falling)
    ax.set_yscale("log")
    ax.plot(t, np.where(is_rising, dS / dt, np.nan), color=GREEN, linewidth=1.5, marker="." if len(t) < 50 else "")
    if is_constant.any():
        level = rounding_threshold / float(dt.max())
        ax.plot(
            t[is_constant],
            np.full(is_constant.sum(), level),
            ".",
            color=GREY,
            markersize=2,
            label="at or below rounding",
        )
        if is_constant.all():
            ax.set_ylim(level / 10, level * 10)
    if is_falling.any():
        ax.plot(
            t[is_falling], -dS[is_falling] / dt[is_falling], "v", color=RED, markersize=4, label="falling: $-dS/dt$"
        )
    if is_constant.any() or is_falling.any():
        ax.legend(frameon=False, fontsize="small", markerscale=2)
    ax.set_ylabel("production $dS/dt$")


def _verdict_title(audit: Audit) -> str:
    """Return the title of a figure: the verdict of the audit, with the measured values of the relevant laws."""
    violated_rows = [row for row in audit.rows if row.passed is False]
    if violated_rows:
        is_law_failure = audit.verdict == LAW_FAILURE_VERDICT
        return ("A law fails: " if is_law_failure else f"{audit.verdict.capitalize()}: ") + "; ".join(
            f"{row.law} {row.value:.2g}" + (f" ({row.note})" if row.note else "") for row in violated_rows
        )
    law_rows = [row for row in audit.rows if row.law.startswith(("energy", "entropy", "least", "largest"))]
    return "The laws hold: " + ", ".join(f"{row.law} {row.value:.2g}" for row in law_rows)


Coordinate = int | str | Callable
"""A component by its index, counted from 0, or by its name; or a function of the state."""

COLOURS = (BLUE, ORANGE, GREEN, RED, "black")
"""Colours of the curves of invariants, used in turn."""

ORBIT_FLOWS = 4
"""Number of random coadjoint flows in a row that lead from the initial state to a point of its orbit."""

MAX_LABEL_LENGTH = 36
"""Largest number of characters in a label of a curve; longer names are shortened."""


def projection(
    solution: Solution,
    coordinates: Sequence[Coordinate],
    system: System | None = None,
    path: str | os.PathLike | None = None,
    orbit_points: int = 0,
) -> Figure:
    """Plot a trajectory, and the coadjoint orbit on which it starts, in two or three chosen coordinates.

    The trajectory is coloured by time. Points of the orbit are grey: images of the initial state under random products
    of coadjoint actions. A motion that conserves every Casimir stays in the orbit.

    Parameters
    ----------
    solution : Solution
        The run to plot.
    coordinates : sequence of 2 or 3 int, str or callable
        Components by their indices, counted from 0, or by the names of the basis elements; or functions of one state,
        such as an invariant.
    system : System, optional
        The system that was integrated; names and the orbit need it.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.
    orbit_points : int, >= 0
        The number of points of the orbit.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If a coordinate is none of these, or the orbit is asked for without a system on a Lie algebra.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    if len(coordinates) not in (2, 3):
        raise InputError(f"coordinates must have 2 or 3 entries, got {len(coordinates)}")
    algebra = None if system is None else system.lie_algebra
    names = None if algebra is None else algebra.basis_names
    labels, functions = zip(*(_coordinate_label_and_function(c, solution, names) for c in coordinates), strict=True)
    figure = plt.figure(figsize=(6.4, 5.2), dpi=DPI, layout="constrained")
    ax: Any = figure.add_subplot(projection="3d" if len(coordinates) == 3 else None)
    if orbit_points:
        if algebra is None:
            raise InputError("orbit_points needs system=, a system on a Lie algebra")
        orbit = _random_points_of_coadjoint_orbit(algebra, solution.x[0, : algebra.dim], orbit_points)
        padding = np.broadcast_to(solution.x[0, algebra.dim :], (orbit_points, solution.x.shape[1] - algebra.dim))
        states = np.concatenate([orbit, padding], axis=1)
        ax.scatter(*(f(states) for f in functions), s=2.0, color="0.75", label="coadjoint orbit")
    curve = ax.scatter(*(f(solution.x) for f in functions), c=solution.t, s=4.0, cmap="viridis", label="trajectory")
    figure.colorbar(curve, ax=ax, label="time", shrink=0.8)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    if isinstance(ax, Axes3D):
        ax.set_zlabel(labels[2])
    ax.legend(loc="upper left", frameon=False, fontsize="small")
    return save_figure(figure, path)


def invariants(solution: Solution, system: System, path: str | os.PathLike | None = None) -> Figure:
    """Plot how much the energy, the Casimirs and the momentum maps of a run have changed, over time.

    Each curve is the change of one function relative to its largest value, on a logarithmic axis. Changes below
    rounding are drawn at its level.

    Parameters
    ----------
    solution : Solution
        The run to plot.
    system : System
        The system that was integrated.
    path : path, optional
        Write the figure to this .pdf, .png or .svg file, and close it.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If the suffix of ``path`` is another.
    FileError
        If the file cannot be written.
    """
    path = checked_figure_path(path)
    functions: dict[str, Callable] = {"energy": system.energy}
    functions |= {name: function for name, (function, _) in recorded_functions_with_verdicts(system).items()}
    figure, ax = plt.subplots(figsize=(6.4, 3.6), dpi=DPI, layout="constrained")
    for i, (name, function) in enumerate(functions.items()):
        values = np.asarray(jax.vmap(lambda x, f=function: f(x))(jnp.asarray(solution.x)))
        scale = float(np.abs(values).max()) or 1.0
        label = name if len(name) <= MAX_LABEL_LENGTH else name[: MAX_LABEL_LENGTH - 1] + "…"
        change = np.maximum(np.abs(values - values[0]) / scale, EPS)
        ax.semilogy(solution.t, change, color=COLOURS[i % len(COLOURS)], linewidth=1.0, label=label)
    ax.set(xlabel="time", ylabel="relative change")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize="small")
    return save_figure(figure, path)


def _coordinate_label_and_function(
    coordinate: Coordinate, solution: Solution, basis_names: tuple[str, ...] | None
) -> tuple[str, Callable[[np.ndarray], np.ndarray]]:
    """Return the label of a coordinate, and the coordinate as a function of states, shape (..., n)."""
    if callable(coordinate):
        text = str(coordinate)
        label = "function of the state" if text.startswith("<") else text
        return label, lambda x: np.asarray(jax.vmap(coordinate)(jnp.asarray(x)))
    if isinstance(coordinate, str):
        if basis_names is None or coordinate not in basis_names:
            cure = (
                f"The names are {', '.join(basis_names)}"
                if basis_names
                else "Names need system=, a system on a Lie algebra whose basis has names"
            )
            raise InputError(f"{coordinate!r} is not the name of a basis element. {cure}")
        coordinate = basis_names.index(coordinate)
    n = solution.x.shape[1]
    if not is_integer(coordinate) or not 0 <= coordinate < n:
        raise InputError(f"a coordinate must be an index from 0 to {n - 1}, a name or a function, got {coordinate!r}")
    index = int(coordinate)
    label = basis_names[index] if basis_names is not None and index < len(basis_names) else rf"$\mu_{{{index + 1}}}$"
    return label, lambda x: x[:, index]


def _random_points_of_coadjoint_orbit(algebra, mu: np.ndarray, n_points: int) -> np.ndarray:
    """Return random points of the coadjoint orbit through mu, shape (n_points, dim)."""
    directions = jax.random.normal(jax.random.key(0), (ORBIT_FLOWS, n_points, algebra.dim))
    points = jnp.broadcast_to(jnp.asarray(mu), (n_points, algebra.dim))
    for x in directions:
        ad_transpose = jnp.swapaxes(algebra.ad(x), -1, -2)
        points = (jax.scipy.linalg.expm(ad_transpose) @ points[..., None])[..., 0]
    return np.asarray(points)
