"""Exact trajectories of the relaxed rigid body: Taylor series in 40-digit decimal arithmetic."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np

from .problems import INERTIA

DECIMAL_DIGITS = 40
"""Digits of the decimal arithmetic."""
TAYLOR_ORDER = 30
"""Order of the Taylor series."""
TAYLOR_STEP = Decimal("0.25")
"""Step of the series; for states of norm one its terms fall by a factor of ten or more, so the error is 1e-30."""


def exact_state(x0, rate: float, t_end: float) -> np.ndarray:
    """Return the state at ``t_end``, a multiple of 1/4, from x0, correct to double precision."""
    with localcontext(prec=DECIMAL_DIGITS):
        x = [Decimal(float(a)) for a in x0]
        for _ in range(int(Decimal(t_end) / TAYLOR_STEP)):
            series = _taylor_coefficients(x, Decimal(rate))
            x = [sum((c * TAYLOR_STEP**n for n, c in enumerate(component)), Decimal(0)) for component in series]
        return np.array([float(a) for a in x])


def _taylor_coefficients(x0: list[Decimal], rate: Decimal) -> list[list[Decimal]]:
    """Return the Taylor coefficients of the three components, by the recursion of :func:`.suites.body_field`."""
    inverse = [1 / Decimal(moment) for moment in INERTIA]
    x: list[list[Decimal]] = [[a] for a in x0]
    w: list[list[Decimal]] = [[], [], []]
    u: list[list[Decimal]] = [[], [], []]
    for n in range(TAYLOR_ORDER):
        for i in range(3):
            w[i].append(inverse[i] * x[i][n])
        for i in range(3):
            u[i].append(x[i][n] + rate * _cross_coefficient(w, x, i, n))
        new = [_cross_coefficient(u, w, i, n) / (n + 1) for i in range(3)]
        for i in range(3):
            x[i].append(new[i])
    return x


def _cross_coefficient(a, b, i: int, n: int) -> Decimal:
    """Return coefficient n of component i of the cross product of two series."""
    j, k = (i + 1) % 3, (i + 2) % 3
    return sum((a[j][m] * b[k][n - m] - a[k][m] * b[j][n - m] for m in range(n + 1)), Decimal(0))
