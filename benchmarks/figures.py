"""Figures of the benchmark pages."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from .first_page import PeerComparison
from .report import Table

FASTER_COLOUR = "#0072b2"
"""Colour of tasks in which this library is faster."""
SLOWER_COLOUR = "#d55e00"
"""Colour of tasks in which this library is slower."""

LINE_STYLES = {", compiled engine": "-", ", array engine": "--", ", C": ":"}
"""Line style by the suffix that names the engine; the colour stands for the method."""


def draw_work_precision(series: dict[str, list[list[float]]], path: Path) -> None:
    """Draw time against error, one curve for each method; the file name determines the format."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with matplotlib.rc_context({"svg.hashsalt": "liethermo", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
        colours: dict[str, str] = {}
        for name, points in series.items():
            errors, seconds = zip(*points, strict=True)
            width = 2.0 if name.endswith("engine") else 1.0  # the library's own stand out
            suffix = next((end for end in LINE_STYLES if name.endswith(end)), "")
            colour = colours.setdefault(name.removesuffix(suffix), f"C{len(colours)}")
            line = {"linestyle": LINE_STYLES.get(suffix, "-"), "linewidth": width, "color": colour}
            axes.loglog(errors, seconds, marker="o", markersize=2 + width, label=name, **line)
        axes.invert_xaxis()
        axes.set_xlabel("relative error at the end")
        axes.set_ylabel("time of a run (s)")
        axes.grid(True, which="major", linewidth=0.4, alpha=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def draw_time_ratios(themes: dict[str, list[PeerComparison]], path: Path) -> None:
    """Draw the ratio of times, one bar per task, grouped by theme; bars to the left of 1 mean that this library is
    faster."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [(theme, c) for theme, comparisons in themes.items() for c in comparisons]
    with matplotlib.rc_context({"svg.hashsalt": "liethermo", "svg.fonttype": "none", "font.size": 8}):
        figure, axes = plt.subplots(figsize=(8.0, 0.6 + 0.19 * len(rows)), layout="constrained")
        for i, (_, c) in enumerate(rows):
            axes.barh(i, c.ratio - 1.0, left=1.0, height=0.7, color=FASTER_COLOUR if c.ratio < 1.0 else SLOWER_COLOUR)
        axes.set_yticks(range(len(rows)), [f"{c.work} · {c.peer.split(',')[0]}" for _, c in rows])
        axes.set_xscale("log")
        axes.axvline(1.0, color="black", linewidth=0.8)
        axes.invert_yaxis()
        ends = [i for i in range(1, len(rows)) if rows[i][0] != rows[i - 1][0]]
        for end in ends:
            axes.axhline(end - 0.5, color="black", linewidth=0.3, alpha=0.5)
        axes.set_xlabel("time here / time there")
        axes.grid(True, axis="x", which="major", linewidth=0.4, alpha=0.5)
        axes.set_axisbelow(True)
        axes.margins(y=0.01)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(axis="y", length=0)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def draw_magnet(table: Table, path: Path) -> None:
    """Draw magnetisation, specific heat and Binder's cumulant against temperature; smaller lattices are paler."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from .measurements.magnet import CRITICAL_CUMULANT, CRITICAL_TEMPERATURE, MONTE_CARLO_ROW, NOISE_ROW

    lengths = sorted({row[1] for row in table.rows})
    with matplotlib.rc_context({"svg.hashsalt": "liethermo", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.2), layout="constrained")
        colours = plt.get_cmap("viridis_r")(np.linspace(0.1, 1.0, len(lengths)))
        for colour, length in zip(colours, lengths, strict=True):
            for generator, style in ((NOISE_ROW, {"fmt": "o", "ms": 3.5}), (MONTE_CARLO_ROW, {"fmt": "-", "lw": 0.8})):
                rows = [row for row in table.rows if row[0] == generator and row[1] == length]
                for ax, column in zip(axes, (5, 7, 9), strict=True):
                    values, errors = ([row[i] for row in rows] for i in (column, column + 1))
                    label = f"{length}³ spins" if generator == NOISE_ROW and ax is axes[0] else None
                    temperatures = [float(row[2]) for row in rows]
                    ax.errorbar(temperatures, values, errors, color=colour, label=label, **style)
        for ax, name in zip(axes, ("magnetisation", "specific heat", "Binder's cumulant"), strict=True):
            ax.axvline(CRITICAL_TEMPERATURE, color="0.6", linewidth=0.8, zorder=0)
            ax.set(xlabel="kT / J", ylabel=name)
            ax.spines[["top", "right"]].set_visible(False)
        axes[2].axhline(CRITICAL_CUMULANT, color="0.6", linewidth=0.8, zorder=0)
        figure.legend(frameon=False, loc="outside right center")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)
