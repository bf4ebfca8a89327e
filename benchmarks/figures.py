"""The picture of the work-precision page."""

from __future__ import annotations

from pathlib import Path

import matplotlib

STYLES = {", compiled engine": "-", ", array engine": "--", ", C": ":"}
"""Lines by what runs a method, whose colour is the same for all."""


def work_precision(series: dict[str, list[list[float]]], path: Path) -> None:
    """Time against error, a curve for each method; the format is that of the file name."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with matplotlib.rc_context({"svg.hashsalt": "liethermo", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
        colours: dict[str, str] = {}
        for name, points in series.items():
            errors, seconds = zip(*points, strict=True)
            width = 2.0 if name.endswith("engine") else 1.0  # the library's own stand out
            by = next((end for end in STYLES if name.endswith(end)), "")
            colour = colours.setdefault(name.removesuffix(by), f"C{len(colours)}")
            line = {"linestyle": STYLES.get(by, "-"), "linewidth": width, "color": colour}
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
