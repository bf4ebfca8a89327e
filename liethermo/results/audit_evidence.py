"""Evidence for the audit of a result: numbers beside its series, computed when they are first asked for.

See :mod:`liethermo.runs.evidence` for the computation.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError
from ..systems.conditions import RunCondition, worst_conditions
from .netcdf import SaveableResult
from .rounding_scale import InvariantDrift


@dataclass(frozen=True)
class Evidence:
    """Measured data that an audit of a run needs besides the series of states, energy and entropy.

    Attributes
    ----------
    energy, entropy : float or None
        Largest sensitivity along the run, at which the function is rounded (:meth:`Energy.sensitivity`).
    invariants : dict of float
        Largest sensitivities of the other recorded functions, by name.
    terms : dict of float
        Largest rounding scale of the value of ``"energy"``, ``"entropy"`` and the others along the run: that of the
        largest terms, which may cancel in the value.
    local_error : float or None
        Largest local error of a step: its distance from short steps that replace it, relative to its length, or to a
        hundredth of the whole motion if that is longer; None if nothing moves.
    error_time : float or None
        Time of the step with the largest local error.
    looked : int or None
        Number of steps that were checked: each was compared with the vector field at its ends and at points between,
        and the worst were repeated.
    inconsistency : float or None
        Largest distance between the slope of a step and the vector field, relative to the field, that remains as the
        step gets shorter.
    conditions : tuple of RunCondition
        Conditions beside the laws, such as the positivity of a density matrix.
    drifts : dict of InvariantDrift
        Of an ensemble: drifts of the conserved functions, by name, each of the trajectory where it is largest.
    """

    energy: float | None = None
    entropy: float | None = None
    invariants: Mapping[str, float] = field(default_factory=dict)
    terms: Mapping[str, float] = field(default_factory=dict)
    local_error: float | None = None
    error_time: float | None = None
    looked: int | None = None
    inconsistency: float | None = None
    conditions: tuple[RunCondition, ...] = ()
    drifts: Mapping[str, InvariantDrift] = field(default_factory=dict)

    def __post_init__(self):
        if (self.local_error is None) != (self.error_time is None):
            raise InputError("local_error and error_time must be given together")


def merge_evidence(evidence_list: Sequence[Evidence]) -> Evidence:
    """Return the joint evidence of several sets of runs, with the maximum of each quantity."""
    names = dict.fromkeys(name for evidence in evidence_list for name in evidence.terms)
    terms = {name: max(evidence.terms.get(name, 0.0) for evidence in evidence_list) for name in names}
    conditions = worst_conditions(evidence.conditions for evidence in evidence_list)
    drifts = largest_drifts(evidence.drifts for evidence in evidence_list)
    inconsistency = max(
        (evidence.inconsistency for evidence in evidence_list if evidence.inconsistency is not None), default=None
    )
    merged_evidence = Evidence(terms=terms, inconsistency=inconsistency, conditions=conditions, drifts=drifts)
    evidence_with_error = [evidence for evidence in evidence_list if evidence.local_error is not None]
    if not evidence_with_error:
        return merged_evidence
    worst_evidence = max(
        evidence_with_error, key=lambda evidence: np.nan_to_num(evidence.local_error or 0.0, nan=np.inf)
    )
    n_checked = sum(evidence.looked or 0 for evidence in evidence_with_error)
    return dataclasses.replace(
        merged_evidence, local_error=worst_evidence.local_error, error_time=worst_evidence.error_time, looked=n_checked
    )


def largest_drifts(drifts_of_runs: Iterable[Mapping[str, InvariantDrift]]) -> dict[str, InvariantDrift]:
    """Return the largest drift of each function over several runs, relative to its rounding scale, by name."""
    largest_by_name: dict[str, InvariantDrift] = {}
    for name, drift in (item for drifts in drifts_of_runs for item in drifts.items()):
        largest_drift_so_far = largest_by_name.setdefault(name, drift)
        if not drift.change <= largest_drift_so_far.change:
            largest_by_name[name] = drift
    return largest_by_name


VELOCITY_AXES = {"angular_velocity": "axis", "rotor_rates": "rotor", "joint_rates": "joint_coordinate"}
"""Velocities that belong to the states of a result, by name, and the name of their last axis in datasets."""


class AuditableResult(SaveableResult):
    """A result of a run that can be audited, because it has evidence or a function that computes evidence."""

    state_fields: ClassVar[tuple[str, ...]] = ("x",)
    """Names of the fields that are states, shape (..., n)."""

    t: np.ndarray
    x: Any
    energy: np.ndarray
    attitude: np.ndarray | None
    provenance: dict[str, Any]
    evidence_source: Callable[[], Evidence] | None
    velocity_sources: Mapping[str, Callable[[], np.ndarray]]

    @property
    def joints(self) -> dict[str, np.ndarray]:
        """Joint coordinates by the name of the body (rad, or length), of a tree of jointed bodies; else empty.

        Each has the shape of the times, (times,), or (times, 2) for a universal joint; in an ensemble trajectories are
        first.
        """
        return {} if self.x is None else self.split_by_joint(self.x, 0)

    def split_by_joint(self, values: np.ndarray, first_state_index: int) -> dict[str, np.ndarray]:
        """Return joint coordinates or joint rates by the name of the body, from ``values``, shape (..., n).

        Column 0 of ``values`` belongs to the component ``first_state_index`` of a state.
        """
        return {
            name: values[..., start - first_state_index]
            if end - start == 1
            else values[..., start - first_state_index : end - first_state_index]
            for name, (start, end) in self.provenance.get("joints", {}).items()
        }

    @functools.cached_property
    def evidence(self) -> Evidence:
        """Data that an audit needs besides the series; computed at its first use."""
        return Evidence() if self.evidence_source is None else self.evidence_source()

    def velocities(self) -> dict[str, np.ndarray]:
        """Return the velocities at the saved states by name: of a rigid body, of its rotors, and of joints."""
        return {name: source() for name, source in self.velocity_sources.items()}

    def __getstate__(self) -> dict[str, Any]:  # a pickled copy has the evidence itself, not the function
        fields = {name: getattr(self, name) for name in vars(self)}
        fields |= {"evidence": self.evidence, "evidence_source": None}
        return fields | {"velocity_sources": velocity_copy_functions(self.velocities())}


def velocity_copy_functions(arrays_by_name: Mapping[str, np.ndarray]) -> dict[str, Callable[[], np.ndarray]]:
    """Return functions without arguments that return copies of the velocity arrays, by name."""
    return {name: functools.partial(np.copy, arrays_by_name[name]) for name in VELOCITY_AXES if name in arrays_by_name}
