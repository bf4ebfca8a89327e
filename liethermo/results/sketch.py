"""A small picture of series along time, as SVG: what a notebook shows of a run at once, without a drawing package."""

from __future__ import annotations

import numpy as np

MAX_POINTS, MAX_CURVES = 400, 8
CURVE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#999999", "#F0E442")


def svg_sketch(t: np.ndarray, series: np.ndarray, label: str, width: int = 280, height: int = 110) -> str:
    """Curves over time in one frame, each component on the scale of all.

    Parameters
    ----------
    t : ndarray, shape (times,)
    series : ndarray, shape (times, curves)
        Of more than eight curves the first eight are drawn.
    label : str
        What the picture shows, in words.

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    kept = np.unique(np.linspace(0, len(t) - 1, min(len(t), MAX_POINTS)).round().astype(int))
    t, series = t[kept], series[kept, :MAX_CURVES]
    seen = series[np.isfinite(series)]
    low, high = (seen.min(), seen.max()) if seen.size else (0.0, 1.0)
    room = (high - low) or 1.0
    across = 4 + (width - 8) * (t - t[0]) / ((t[-1] - t[0]) or 1.0)
    up = height - 4 - (height - 8) * (series - low) / room
    curves = "".join(
        f'<polyline fill="none" stroke="{colour}" stroke-width="1.3" points="'
        + " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, column, strict=True) if np.isfinite(y))
        + '"/>'
        for colour, column in zip(CURVE_COLOURS, up.T, strict=False)
    )
    frame = f'<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1}" fill="none" stroke="#888"/>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'role="img" aria-label="{label}">{frame}{curves}</svg>'
    )
