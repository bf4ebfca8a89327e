"""A run and its comparisons with equivalent runs, which the property suite of relations makes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from manifolds.testing import Suite

from ..integrators import OneStepMethod
from ..results.solution import Solution
from ..runs.adaptive import Adaptive
from ..runs.integrate import integrate
from ..systems import System
from .suites import random_initial_state

ROUNDING_RTOL = 1e-11
"""Largest difference of states that should differ by rounding alone, relative to the largest state component.

The steps of a short run accumulate 1e-14, which growing modes of the motion multiply.
"""


DISCRETISATION_ERROR_FACTOR = 10.0
"""Largest difference, in errors of the method, of two runs that divide the time into different steps."""


SkipReason = str | None
"""The reason why a relation does not apply to a case, or None if it was checked."""


class RelationCase:
    """A base run, with methods that make equivalent runs and compare them with it.

    Parameters
    ----------
    system, method, x0, step
        As for :func:`check_relations`.
    time : float
        Duration of the run.
    seed : int
        Seed of the random axes and of the neighbouring state.
    """

    def __init__(self, system: System, method: OneStepMethod, x0, step: float | Adaptive, time: float, seed: int):
        self.system, self.method, self.x0 = system, method, np.asarray(x0, dtype=np.float64)
        self.step, self.time, self.seed = step, time, seed
        self.suite, self.name = Suite(f"{method} in a {system.kind}"), ""

    def run(self, system: System | None = None, x0=None, span=None, step=None, **options) -> Solution:
        """Integrate with the arguments of the base run, except for the given ones, and return the run, even if it
        failed."""
        return integrate(
            self.system if system is None else system,
            self.x0 if x0 is None else x0,
            (0.0, self.time) if span is None else span,
            self.step if step is None else step,
            self.method,
            on_failure="return",
            progress=False,
            **options,
        )

    @functools.cached_property
    def base_run(self) -> Solution:
        """The run with which all other runs of the case are compared."""
        return self.run()

    @property
    def state_scale(self) -> float:
        """The largest absolute component of the states of the base run."""
        return float(np.abs(self.base_run.x).max())

    @functools.cached_property
    def method_error(self) -> float:
        """The error of the method relative to the state scale, measured with half the step or a hundredth of the
        tolerance."""
        if isinstance(self.step, Adaptive):
            finer_step: float | Adaptive = replace(self.step, rtol=0.01 * self.step.rtol, atol=0.01 * self.step.atol)
        else:
            finer_step = 0.5 * self.step
        return float(np.abs(self.run(step=finer_step).x[-1] - self.base_run.x[-1]).max()) / self.state_scale

    @property
    def rounding_tolerance(self) -> float:
        """The allowed relative rounding error; with adaptive steps at least a tenth of their tolerance, since rounding
        changes the steps."""
        return max(ROUNDING_RTOL, 0.1 * self.step.rtol) if isinstance(self.step, Adaptive) else ROUNDING_RTOL

    @property
    def discretisation_tolerance(self) -> float:
        """The allowed difference of runs that divide the time into different steps."""
        return max(self.rounding_tolerance, DISCRETISATION_ERROR_FACTOR * self.method_error)

    def compare_states_with_expected(self, label: str, states, expected_states, tolerance: float) -> None:
        """Add a row to the report with the largest difference of states from expected ones, relative to the state
        scale."""
        self.suite.check_small(
            f"{self.name}: {label}", np.asarray(states) - np.asarray(expected_states), self.state_scale, tolerance
        )

    def compare_with_base_run(
        self,
        description: str,
        run: Solution,
        to_base: Callable = lambda x: x,
        tolerance: float | None = None,
        has_same_function_names: bool = True,
    ) -> None:
        """Add rows to the report that compare a run with the base run: status, states, attitude, invariants and audit.

        With ``has_same_function_names`` the conserved functions must have equal names. Otherwise only their number must
        agree.
        """
        tolerance = self.rounding_tolerance if tolerance is None else tolerance
        label = f"{self.name}: {description}"
        status = (run.status.code, self.base_run.status.code)
        self.suite.check_true(
            f"{label} ends alike", status[0] == status[1], "" if status[0] == status[1] else run.status.message
        )
        if status[0] != status[1]:
            return
        has_equal_times = len(run.t) == len(self.base_run.t) and not isinstance(self.step, Adaptive)
        compared_rows = slice(None) if has_equal_times else slice(-1, None)
        self.compare_states_with_expected(
            description, to_base(run.x[compared_rows]), self.base_run.x[compared_rows], tolerance
        )
        if run.attitude is not None and self.base_run.attitude is not None:
            self.suite.check_equal(
                f"{label}, attitude", run.attitude[compared_rows], self.base_run.attitude[compared_rows], tolerance
            )
        names, base_names = names_of_conserved_functions(run), names_of_conserved_functions(self.base_run)
        names_agree = names == base_names if has_same_function_names else len(names) == len(base_names)
        self.suite.check_true(
            f"{label}, same constants", names_agree, "" if names_agree else f"{sorted(names)}, not {sorted(base_names)}"
        )
        is_same_verdict = run.audit().passed == self.base_run.audit().passed
        self.suite.check_true(f"{label}, same verdict", is_same_verdict, "" if is_same_verdict else run.audit().verdict)


def names_of_conserved_functions(run: Solution) -> set[str]:
    """Return the names of the functions that a run conserves, whether the method promises it or not."""
    return {*run.laws.conserved, *run.laws.unpromised}


def state_near_initial_state(case: RelationCase) -> np.ndarray:
    """Return a state inside the domain at about a twentieth of the state scale from the initial state."""
    direction = np.random.default_rng(case.seed + 1).standard_normal(case.x0.shape)
    nearby_x = case.x0 + 0.05 * case.state_scale * direction / np.linalg.norm(direction)
    if not case.system.domain.why_outside(nearby_x.ravel()):
        return nearby_x
    return case.x0 + 0.05 * (random_initial_state(case.system, case.seed + 1).reshape(case.x0.shape) - case.x0)
