"""Suggest a step size, or a method, for a given accuracy."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from manifolds._precision import with_library_settings

from ..engines.select_engine import EngineWithFallback
from ..engines.step_control import DEADBAND, largest_growth_rate_by_arnoldi
from ..errors import InputError, LiethermoError
from ..integrators import MetriplecticGauss, MetriplecticRungeKutta, MetriplecticTaylor, OneStepMethod
from ..integrators.taylor import order_for_tolerance
from ..systems import System
from .adaptive import Adaptive, make_step_control
from .adaptive_run import AcceptedSteps, AdaptiveRun
from .preparation import checked_initial_state, checked_or_default_method, prepare_for_method


@with_library_settings
def suggest_step(system: System, x0, rtol: float = 1e-8, method: OneStepMethod | None = None, t0: float = 0.0) -> float:
    """Return a step size for fixed steps that are as accurate as ``lt.Adaptive(rtol)`` near x0.

    The step size is the smallest of the first thirty adaptive steps, after their initial growth at the largest allowed
    rate, rounded down to two digits.

    Parameters
    ----------
    system : System
        The system. Its functions fix the units.
    x0 : array, shape (n,)
        The state near which the step is to be accurate, in the units of the system.
    rtol : float
        The relative tolerance (dimensionless).
    method : OneStepMethod
        The integrator; by default ``MetriplecticGauss(1)``, of order 2.
    t0 : float
        The time (in the unit of the system), for an energy or a torque that depends on it. A torque that depends on
        the attitude is evaluated at the identity.

    Returns
    -------
    float
        The step size (in the unit of time of the system).

    Raises
    ------
    InputError
        If nothing moves at x0, so that any step will do.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> step = lt.suggest_step(body, [0.1, 0.2, 1.0], 1e-8, lt.MetriplecticGauss(3))
    >>> bool(0.01 < step < 2.0)
    True
    """
    return _try_method(system, x0, rtol, checked_or_default_method(method), t0).step


@dataclass(frozen=True)
class Trial:
    """Result of a short trial of a method on a system.

    Attributes
    ----------
    method : OneStepMethod
    step : float
        Step size (time) for the tolerance.
    evaluations : float
        Number of evaluations of the vector field per unit of time.
    """

    method: OneStepMethod
    step: float
    evaluations: float


@dataclass(frozen=True)
class MethodSuggestion:
    """The method with the least work, and the trials of all methods; prints as a table.

    Attributes
    ----------
    method : OneStepMethod
    step : float
    reason : str
        The reason for the choice, as a text.
    trials : tuple of Trial
        In order of increasing work.
    """

    reason: str
    trials: tuple[Trial, ...]

    @property
    def method(self) -> OneStepMethod:
        return self.trials[0].method

    @property
    def step(self) -> float:
        return self.trials[0].step

    def __str__(self) -> str:
        lines = [f"{'method':<36}{'step':>9}  evaluations of the field in a unit of time"]
        lines += [f"{trial.method!s:<36}{trial.step:>9.2g}  {trial.evaluations:.3g}" for trial in self.trials]
        return "\n".join([*lines, self.reason])


CANDIDATE_METHODS = (*map(MetriplecticRungeKutta, (4, 6, 8)), *map(MetriplecticGauss, (1, 2, 3, 4)))
"""Methods that :func:`suggest_method` tries, besides a Taylor method of an order that depends on the tolerance."""


@with_library_settings
def suggest_method(system: System, x0, rtol: float = 1e-8, t0: float = 0.0) -> MethodSuggestion:
    """Compare the methods that obey both laws near x0, and return the cheapest one for ``rtol``.

    Each method runs for about thirty adaptive steps. Its cost is stages times iterations, divided by the step size. So
    stiffness, which makes explicit steps short, is taken into account.

    Parameters
    ----------
    system, x0, rtol, t0
        As for :func:`suggest_step`, with the same units.

    Returns
    -------
    MethodSuggestion
        The method, its step, the reason for the choice and the trials of all methods; it prints as a table.

    Raises
    ------
    InputError
        If nothing moves at x0, or no method reaches the accuracy.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> found = lt.suggest_method(body, [0.1, 0.2, 1.0], rtol=1e-8)
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), found.step, found.method)
    >>> run.audit().passed
    True
    """
    trials, refusals = [], []
    for method in (*CANDIDATE_METHODS, MetriplecticTaylor(order_for_tolerance(rtol))):
        try:
            trials.append(_try_method(system, x0, rtol, method, t0))
        except LiethermoError as error:
            refusals.append(f"{method}: {error}")
    if not trials:
        raise InputError("no method takes steps of this accuracy from this x0: " + "; ".join(refusals))
    trials.sort(key=lambda trial: trial.evaluations)
    cheapest, explicit_trials = trials[0], [trial for trial in trials if trial.method.explicit]
    if cheapest.method.explicit:
        reason = f"{cheapest.method} with steps of {cheapest.step:g}: the system is not stiff at this accuracy"
    elif explicit_trials:
        ratio = explicit_trials[0].evaluations / cheapest.evaluations
        reason = f"{cheapest.method} with steps of {cheapest.step:g}: the system is stiff, explicit steps cost "
        reason += f"{ratio:.1f} times as much"
    else:
        reason = f"{cheapest.method} with steps of {cheapest.step:g}: no explicit method takes steps from this state"
    return MethodSuggestion(reason, tuple(trials))


def _try_method(system: System, x0, rtol: float, method: OneStepMethod, t0: float) -> Trial:
    """Take up to thirty adaptive steps from x0 with a method, and return its step size and its work.

    Raises
    ------
    InputError
        If nothing moves at x0, or the method takes no step of this accuracy.
    """
    system, prepared_method = prepare_for_method(system, method, rtol)
    prepared_method.check(system)
    x = np.asarray(checked_initial_state(system, prepared_method, x0, t0))
    max_rate, norm = float(np.abs(np.asarray(system.vector_field(x))).max()), float(np.abs(x).max())
    if not max_rate > 0.0:
        raise InputError("the vector field is zero at this x0, so there is no step to suggest. Give another x0")
    step_sizes: list[float] = []
    iterations = [0]

    def record_step_size_and_iterations(accepted_steps: AcceptedSteps):
        """Record the size of an accepted step and the iterations so far; end the trial after thirty steps."""
        step_sizes.append(float(accepted_steps.h[0]))
        iterations.append(
            int(accepted_steps.state_after.fixed_point_iterations) + int(accepted_steps.state_after.newton_iterations)
        )
        if len(step_sizes) == 30:
            raise _TrialCompleteError

    def run_trial(rate: float) -> AdaptiveRun:
        """Take up to thirty adaptive steps over a span of length 1e6 / rate, and return the run."""
        step_sizes.clear()
        iterations[1:] = []
        span_length = 1e6 / rate
        control = make_step_control(Adaptive(rtol), prepared_method, span_length, None)
        adaptive_runs = engine.start_adaptive(control, x, 0.0, span_length, span_length)
        stop_times = np.array([span_length])
        run = AdaptiveRun(
            engine, adaptive_runs, control, stop_times, record_step_size_and_iterations, attempts_per_call=1
        )
        run.advance_to_end()  # one attempt a call, since iterations are counted
        return run

    with contextlib.suppress(_TrialCompleteError):
        engine, rate = EngineWithFallback(system, prepared_method, "auto", 1), max_rate / max(norm, 1e-300)
        if (
            run_trial(rate).underflow_step_size is not None
            and (growth := largest_growth_rate_by_arnoldi(system, prepared_method, x)) > rate
        ):
            run_trial(growth)  # near an equilibrium, steps resolve the growth rate and not the slow motion
    if len(step_sizes) < 2:
        raise InputError(
            f"{method} took {len(step_sizes)} steps of the accuracy rtol = {rtol:g} from this x0, and 2 are needed. "
            "Give a larger rtol or another x0"
        )
    n_growing = next((i for i, (a, b) in enumerate(pairwise(step_sizes)) if b < DEADBAND[1] * a), len(step_sizes) - 1)
    h = min(step_sizes[n_growing:])
    digits = 1 - math.floor(math.log10(h))
    work = (
        prepared_method.evaluations_per_iteration
        * (iterations[-1] - iterations[n_growing])
        / sum(step_sizes[n_growing:])
    )
    return Trial(method, math.floor(h * 10.0**digits) / 10.0**digits, work)


class _TrialCompleteError(Exception):
    """Exception that ends a trial run after enough steps."""
