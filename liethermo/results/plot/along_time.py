"""Figure of the laws of a run over time."""

from __future__ import annotations

import os
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...functions.gradients import EPS
from ..audit import LAW_FAILURE_VERDICT, Audit
from ..solution import Solution
from .figures import BLUE, DPI, GREEN, GREY, RED, checked_figure_path, save_figure


def laws(solution: Solution, path: str | os.PathLike | None = None) -> Figure:
    """Plot energy error, entropy and entropy production of a run, with the verdict of the audit as title.

    The production is the difference quotient of the saved entropies, on a logarithmic axis. Increments below the
    rounding of the entropy itself (the tolerance of the audit) are marked at that level in grey, larger decreases in
    red by their magnitude. A solution without entropy has the first panel only.

    Parameters
    ----------
    solution : Solution
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
    _draw_energy(axes[0, 0], solution.t, solution.energy_balance, " - W" if solution.laws.balance else "")
    if solution.entropy is not None:
        _draw_entropy(axes[1, 0], solution.t, solution.entropy)
        _draw_production(axes[2, 0], solution.t, solution.entropy, _allowed_entropy_fall(audit))
    for ax in axes[:, 0]:
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0.0)
    axes[-1, 0].set_xlabel("time")
    figure.align_ylabels()
    figure.suptitle(_verdict_title(audit), color="black" if audit.passed else RED, fontsize="medium")
    return save_figure(figure, path)


def _draw_energy(ax: Axes, t: np.ndarray, H: np.ndarray, work_label: str) -> None:
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


def _draw_production(ax: Axes, t: np.ndarray, S: np.ndarray, rounding: float) -> None:
    dt, dS, t = np.diff(t), np.diff(S), (t[:-1] + t[1:]) / 2
    rounding = rounding or 4 * EPS * float(np.abs(S).max())
    is_rising, is_falling = dS > rounding, dS < -rounding
    is_constant = ~(is_rising | is_falling)
    ax.set_yscale("log")
    ax.plot(t, np.where(is_rising, dS / dt, np.nan), color=GREEN, linewidth=1.5, marker="." if len(t) < 50 else "")
    if is_constant.any():
        level = rounding / float(dt.max())
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
    violated_rows = [row for row in audit.rows if row.passed is False]
    if violated_rows:
        is_law_failure = audit.verdict == LAW_FAILURE_VERDICT
        return ("A law fails: " if is_law_failure else f"{audit.verdict.capitalize()}: ") + "; ".join(
            f"{row.law} {row.value:.2g}" + (f" ({row.note})" if row.note else "") for row in violated_rows
        )
    law_rows = [row for row in audit.rows if row.law.startswith(("energy", "entropy", "least", "largest"))]
    return "The laws hold: " + ", ".join(f"{row.law} {row.value:.2g}" for row in law_rows)
