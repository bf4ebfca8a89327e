"""The laws of a run, judged by the tolerances of the tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import liethermo as lt
from tests.cases import tolerance

COLUMNS = {"Energy drift": "error", "Least entropy increment": "error", "Laws": "text"}
"""Columns of a table that :meth:`Laws.table_cells` fills."""


@dataclass(frozen=True)
class Laws:
    """Energy drift and least entropy increment of one run, or the worst of many.

    Attributes
    ----------
    energy_drift : float
        ``max |H - H0| / |H0|``.
    least_entropy_increment : float or None
        Least increment in one step, relative to ``max |S|``; None if only the ends of a run are known.
    """

    energy_drift: float
    least_entropy_increment: float | None

    @property
    def are_satisfied(self) -> bool:
        increment = self.least_entropy_increment
        return self.energy_drift <= tolerance("energy") and (increment is None or increment >= -tolerance("entropy"))

    def table_cells(self) -> list:
        increment = self.least_entropy_increment
        violations = []
        if not self.energy_drift <= tolerance("energy"):
            violations.append("energy")
        if increment is not None and not increment >= -tolerance("entropy"):
            violations.append("entropy")
        return [self.energy_drift, increment, "hold" if not violations else f"broken: {', '.join(violations)}"]


def solution_laws(solution: lt.Solution) -> Laws:
    """Return the energy drift and the least entropy increment of a library run, over every step."""
    audit, entropy = solution.audit(), solution.entropy
    assert entropy is not None
    return Laws(audit.energy_drift, audit.entropy_min_increment / float(np.abs(entropy).max()))


def c_run_laws(runs: np.ndarray) -> Laws:
    """Return the worst laws of one or more records of a C program, over every step."""
    first_energy = runs["first_energy"]
    drift = np.maximum(runs["largest_energy"] - first_energy, first_energy - runs["smallest_energy"]) / np.abs(
        first_energy
    )
    return Laws(float(drift.max()), float((runs["least_entropy_increment"] / np.abs(runs["entropy"])).min()))


def path_laws(states: np.ndarray, system: lt.System) -> Laws:
    """Return the energy drift and the least entropy increment along the states of a trajectory, shape (times, n)."""
    assert system.entropy is not None
    H, S = np.asarray(system.energy(states)), np.asarray(system.entropy(states))
    increment = float(np.diff(S).min() / np.abs(S).max())
    return Laws(float(np.abs(H - H[0]).max() / abs(H[0])), increment)


def end_state_laws(initial_states: np.ndarray, final_states: np.ndarray, system: lt.System) -> Laws:
    """Return the worst energy drift of many runs, from their initial and final states, shape (runs, n)."""
    H0, H1 = np.asarray(system.energy(initial_states)), np.asarray(system.energy(final_states))
    return Laws(float((np.abs(H1 - H0) / np.abs(H0)).max()), None)
