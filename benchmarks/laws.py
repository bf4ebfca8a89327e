"""Whether the laws held in a run, to the tolerances of the tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import liethermo as lt
from tests.cases import tolerance

COLUMNS = {"Energy drift": "error", "Least entropy increment": "error", "Laws": "text"}
"""The columns of a table that :meth:`Laws.cells` fills."""


@dataclass(frozen=True)
class Laws:
    """Of one run or the worst of many.

    Attributes
    ----------
    energy_drift : float
        ``max |H - H0| / |H0|``.
    least_entropy_increment : float or None
        Of one step, relative to ``max |S|``; None where only the ends of a run are known.
    """

    energy_drift: float
    least_entropy_increment: float | None

    @property
    def are_kept(self) -> bool:
        increment = self.least_entropy_increment
        return self.energy_drift <= tolerance("energy") and (increment is None or increment >= -tolerance("entropy"))

    def table_cells(self) -> list:
        increment = self.least_entropy_increment
        broken = []
        if not self.energy_drift <= tolerance("energy"):
            broken.append("energy")
        if increment is not None and not increment >= -tolerance("entropy"):
            broken.append("entropy")
        return [self.energy_drift, increment, "hold" if not broken else f"broken: {', '.join(broken)}"]


def solution_laws(solution: lt.Solution) -> Laws:
    """Of a run of the library, every step of it."""
    audit, entropy = solution.audit(), solution.entropy
    assert entropy is not None
    return Laws(audit.energy_drift, audit.entropy_min_increment / float(np.abs(entropy).max()))


def c_run_laws(runs: np.ndarray) -> Laws:
    """The worst of one or more records of a C program, every step of them."""
    first = runs["first_energy"]
    drift = np.maximum(runs["largest_energy"] - first, first - runs["smallest_energy"]) / np.abs(first)
    return Laws(float(drift.max()), float((runs["least_entropy_increment"] / np.abs(runs["entropy"])).min()))


def path_laws(states: np.ndarray, system: lt.System) -> Laws:
    """Of a trajectory, shape (times, n)."""
    assert system.entropy is not None
    H, S = np.asarray(system.energy(states)), np.asarray(system.entropy(states))
    increment = float(np.diff(S).min() / np.abs(S).max())
    return Laws(float(np.abs(H - H[0]).max() / abs(H[0])), increment)


def end_state_laws(before: np.ndarray, after: np.ndarray, system: lt.System) -> Laws:
    """The worst of many runs of which only the ends are known, shape (runs, n)."""
    H0, H1 = np.asarray(system.energy(before)), np.asarray(system.energy(after))
    return Laws(float((np.abs(H1 - H0) / np.abs(H0)).max()), None)
