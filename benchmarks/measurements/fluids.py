"""Fluids on the sphere as su(N): the time of a step with selective decay, against the isospectral midpoint without."""

from __future__ import annotations

import functools

import numpy as np

import liethermo as lt

from .. import child as process
from ..isospectral import IsospectralMidpoint
from ..report import Report, Table, Target
from ..timing import race

DEGREES, TURN, RATE = (2, 12), 0.05, 1e-3
"""Degrees of the first vorticity; how far the fastest part of the fluid turns in a step, in radians; of the decay."""


def run(quick: bool) -> Report:
    """Time steps of both, on matrices of growing size."""
    sizes = (16, 20) if quick else (32, 64, 128, 256, 512)
    rows, targets = [], []
    for N in sizes:
        steps, rounds = (2, 1) if quick else (max(4, 10_240 // N), 1 if N > 256 else 3)
        found, ratio = process.call("fluids", str(N), str(steps), str(rounds), one_core=True)
        rows += found
        if not quick and N in (128, 256):
            targets.append(
                Target(f"su({N}), one step with exact laws, against the isospectral step without", 1.0, ratio)
            )
    columns = {
        "N": "count",
        "": "text",
        "Time a step": "seconds",
        "Relative": "ratio",
        "Energy": "error",
        **{f"tr W^{k}": "error" for k in (2, 3, 4)},
        "Iterations": "number",
    }
    caption = (
        f"Steps in which the fluid turns by {TURN} radians; relative changes of the energy and of the Casimirs in all "
        "of them. Both run in a process of one core, and the time is that of the processor. Without decay the Casimirs "
        "are to stay; with it the enstrophy, tr W^2, falls and never rises."
    )
    text = (
        "Zeitlin's fluid from a random field of degrees 2 to 12. *Isospectral midpoint* is the published algorithm in "
        "NumPy and machine code, without dissipation. The library takes steps of `MetriplecticRungeKutta(4)` with "
        "selective decay, the energy exact and the entropy never falling."
    )
    return Report("Large matrix algebras: a fluid on the sphere", text, [Table(caption, columns, rows)], targets, {})


def child(*numbers: str):
    """Both in one process; the rows of the table and the ratio of the times."""
    N, steps, rounds = map(int, numbers)
    q = lt.models.QuantisedSphere(N)
    x = q.random(0, (min(DEGREES[0], N - 1), min(DEGREES[1], N - 1)), 4.0)
    W, scheme = np.asarray(q.matrix(x)), IsospectralMidpoint(N)
    h = TURN / (q.gamma * np.abs(np.linalg.eigvalsh(1j * scheme.stream(W))).max() * 2.0)
    system = lt.models.zeitlin(N, "enstrophy", RATE)
    span, method = (0.0, h * steps), lt.MetriplecticRungeKutta(4)
    ours = functools.partial(lt.integrate, system, x, span, h, method, save_every=steps, engine="array", progress=False)
    peer = functools.partial(scheme.integrate, W, h * q.gamma, steps)
    outcomes = race(
        {"isospectral midpoint, no dissipation": peer, "this library, selective decay": ours}, rounds=rounds
    )
    (name, theirs), (own_name, mine) = outcomes.items()
    after, iterations = theirs.result
    solution = mine.result
    energy = solution.stats.energy_range
    low, high = energy if energy is not None else (solution.energy.min(), solution.energy.max())
    drift, kept = abs(scheme.energy(after) / scheme.energy(W) - 1.0), (high - low) / abs(solution.energy[0])
    changed = _casimirs(W, np.asarray(q.matrix(solution.x[-1])))
    ratio = float(mine.processor / theirs.processor)
    rows = [
        [N, name, theirs.processor / steps, 1.0, drift, *_casimirs(W, after), iterations],
        [N, own_name, mine.processor / steps, ratio, float(kept), *changed, None],
    ]
    return rows, ratio


def _casimirs(before: np.ndarray, after: np.ndarray) -> list[float]:
    """Relative changes of the traces of powers 2 to 4, the odd one relative to that of its absolute values."""
    a, b = (np.linalg.eigvalsh(1j * W) for W in (before, after))
    return [float(abs((b**k).sum() - (a**k).sum()) / (np.abs(a) ** k).sum()) for k in (2, 3, 4)]
