"""Small SVG pictures of time series, which notebooks show of a run without a plotting package."""

from __future__ import annotations

import numpy as np

MAX_POINTS = 400
"""Largest number of points of a curve; longer series are thinned."""

MAX_CURVES = 8
"""Largest number of curves, which is the number of colours."""

CURVE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#999999", "#F0E442")
"""Colours of the curves, which colour-blind readers can tell apart [Okabe & Ito 2008]."""


def svg_sketch(t: np.ndarray, series: np.ndarray, label: str, width: int = 280, height: int = 110) -> str:
    """Draw curves over time in one frame, with a common scale.

    Parameters
    ----------
    t : ndarray, shape (times,)
    series : ndarray, shape (times, curves)
        Only the first eight curves are drawn.
    label : str
        Description of the picture, in words.

    Returns
    -------
    str
        An ``<svg>`` element.
    """
    indices = np.unique(np.linspace(0, len(t) - 1, min(len(t), MAX_POINTS)).round().astype(int))
    t, series = t[indices], series[indices, :MAX_CURVES]
    finite_values = series[np.isfinite(series)]
    lower, upper = (finite_values.min(), finite_values.max()) if finite_values.size else (0.0, 1.0)
    value_range = (upper - lower) or 1.0
    x_pixels = 4 + (width - 8) * (t - t[0]) / ((t[-1] - t[0]) or 1.0)
    y_pixels = height - 4 - (height - 8) * (series - lower) / value_range
    curves = "".join(
        f'<polyline fill="none" stroke="{colour}" stroke-width="1.3" points="'
        + " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(x_pixels, column, strict=True) if np.isfinite(y))
        + '"/>'
        for colour, column in zip(CURVE_COLOURS, y_pixels.T, strict=False)
    )
    frame = f'<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1}" fill="none" stroke="#888"/>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'role="img" aria-label="{label}">{frame}{curves}</svg>'
    )
