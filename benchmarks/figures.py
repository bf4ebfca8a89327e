"""Figures of the benchmark pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from .first_page import PeerComparison
from .report import Table

PEER_MARKERS = {
    "C": ("o", "#000000"),
    "heyoka": ("s", "#d55e00"),
    "diffrax": ("^", "#0072b2"),
    "SciPy": ("v", "#56b4e9"),
    "MuJoCo": ("D", "#009e73"),
    "Basilisk": ("P", "#cc79a7"),
    "isospectral": ("X", "#e69f00"),
}
"""Marker and colour of each program by the beginning of its name."""

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
    """Draw the ratios of times, one line per task with a marker for each program, narrow enough for a telephone.

    Points left of 1 mean that this library is faster.
    """
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks_by_theme = {theme: list(dict.fromkeys(c.work for c in comparisons)) for theme, comparisons in themes.items()}
    n_lines = sum(len(tasks) + 1 for tasks in tasks_by_theme.values())
    with matplotlib.rc_context({"svg.hashsalt": "liethermo", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(4.2, 1.0 + 0.33 * n_lines), layout="constrained")
        label_place: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 9}
        height, labelled_peers = 0.0, set()
        for theme, comparisons in themes.items():
            axes.text(0.0, height, theme, weight="bold", **label_place)
            for task in tasks_by_theme[theme]:
                height += 1.0
                axes.text(0.0, height - 0.28, task, **label_place)
                axes.axhline(height + 0.2, color="0.85", linewidth=0.6, zorder=0)
                for c in (c for c in comparisons if c.work == task):
                    peer = next(start for start in PEER_MARKERS if c.peer.startswith(start))
                    marker, colour = PEER_MARKERS[peer]
                    label = None if peer in labelled_peers else peer
                    axes.plot(c.ratio, height + 0.2, marker, color=colour, markersize=6, label=label)
                    labelled_peers.add(peer)
            height += 1.1
        ratios = [c.ratio for comparisons in themes.values() for c in comparisons]
        limits = min(ratios, default=1.0) / 1.5, 1.5 * max(ratios, default=1.0)  # without peers there is no ratio
        axes.set(xscale="log", xlim=limits, ylim=(height - 0.4, -0.6))
        axes.set_xlabel(
            "← liethermo is faster   ·   the other is faster →\ntime of liethermo / time of the other program"
        )
        axes.xaxis.set_major_formatter("{x:g}")
        axes.axvline(1.0, color="black", linewidth=0.8, zorder=1)
        axes.axvspan(limits[0], 1.0, color="0.96", zorder=-1)
        axes.set_yticks([])
        axes.spines[["top", "right", "left"]].set_visible(False)
        if labelled_peers:
            figure.legend(frameon=False, loc="outside upper left", ncols=4, handletextpad=0.0, columnspacing=0.8)
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
