"""A step, and a method, for an accuracy that is asked for."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from manifolds._precision import with_library_settings

from ..engines.choice import EngineWithFallback
from ..engines.pacing import DEADBAND, growth_rate_at
from ..errors import InputError, LiethermoError
from ..integrators import DEFAULT_METHOD, MetriplecticGauss, MetriplecticRungeKutta, MetriplecticTaylor, OneStepMethod
from ..integrators.taylor import order_for_tolerance
from ..systems import System
from .adaptive import Adaptive, make_step_control
from .preparation import checked_initial_state, prepare_for_method
from .stepwise import AcceptedSteps, RunOutcome, advance_to_end


@with_library_settings
def suggest_step(system: System, x0, rtol: float = 1e-8, method: OneStepMethod | None = None, t0: float = 0.0) -> float:
    """A step size for fixed steps as accurate as those of ``lt.Adaptive(rtol)``, near x0.

    It is the smallest of the first thirty adaptive steps, after their first growth at the largest allowed rate, rounded
    down to two digits.

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

    Raises
    ------
    InputError
        Where nothing moves at x0, so that any step will do.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> step = lt.suggest_step(body, [0.1, 0.2, 1.0], 1e-8, lt.MetriplecticGauss(3))
    >>> bool(0.01 < step < 2.0)
    True
    """
    return _try_method(system, x0, rtol, DEFAULT_METHOD if method is None else method, t0).step


@dataclass(frozen=True)
class Trial:
    """A method tried on a system.

    Attributes
    ----------
    method : OneStepMethod
    step : float
        Of the size that the tolerance asks for.
    evaluations : float
        Of the vector field, in a unit of time.
    """

    method: OneStepMethod
    step: float
    evaluations: float


@dataclass(frozen=True)
class MethodSuggestion:
    """The method that takes least work, and what others would take; prints as a table.

    Attributes
    ----------
    method : OneStepMethod
    step : float
    reason : str
    trials : tuple of Trial
        Least work first.
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


@with_library_settings
def suggest_method(system: System, x0, rtol: float = 1e-8, t0: float = 0.0) -> MethodSuggestion:
    """The method, of those that keep both laws, that reaches an accuracy with the least work near x0.

    Each method runs for some thirty adaptive steps. Its cost is stages times iterations, divided by the step. So
    stiffness, which makes explicit steps short, is taken into account.

    Parameters
    ----------
    system, x0, rtol, t0
        As for :func:`suggest_step`, with the same units.

    Raises
    ------
    InputError
        Where nothing moves at x0, or no method reaches the accuracy.

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
        raise InputError("; ".join(refusals))
    trials.sort(key=lambda trial: trial.evaluations)
    best, explicit = trials[0], [trial for trial in trials if trial.method.explicit]
    if best.method.explicit:
        reason = f"{best.method} with steps of {best.step:g}: the system is not stiff at this accuracy"
    elif explicit:
        ratio = explicit[0].evaluations / best.evaluations
        reason = (
            f"{best.method} with steps of {best.step:g}: it is stiff, explicit steps cost {ratio:.1f} times as much"
        )
    else:
        reason = f"{best.method} with steps of {best.step:g}: no explicit method takes steps from this state"
    return MethodSuggestion(reason, tuple(trials))


def _try_method(system: System, x0, rtol: float, method: OneStepMethod, t0: float) -> Trial:
    system, used = prepare_for_method(system, method, rtol)
    used.check(system)
    x = np.asarray(checked_initial_state(system, used, x0, t0))
    speed, size = float(np.abs(np.asarray(system.vector_field(x))).max()), float(np.abs(x).max())
    if not speed > 0.0:
        raise InputError("nothing moves at this state, so there is no step to suggest: start elsewhere")
    taken: list[float] = []
    iterations = [0]

    def record_first_step(steps: AcceptedSteps):
        taken.append(float(steps.h[0]))
        iterations.append(int(steps.state_after.fixed_point_iterations) + int(steps.state_after.newton_iterations))
        if len(taken) == 30:
            raise _TrialCompleteError

    def run_trial(rate: float) -> RunOutcome:
        """Over a span in which what goes at this rate goes far."""
        taken.clear()
        iterations[1:] = []
        length = 1e6 / rate
        pacing = make_step_control(Adaptive(rtol), used, length, None)
        paces = engine.start_adaptive(pacing, x, 0.0, length, length)
        return advance_to_end(
            engine, paces, pacing, np.array([length]), record_first_step, attempts_per_call=1
        )  # since iterations are counted

    with contextlib.suppress(_TrialCompleteError):
        engine, rate = EngineWithFallback(system, used, "auto", 1), speed / max(size, 1e-300)
        if run_trial(rate).underflow_step_size is not None and (growth := growth_rate_at(system, used, x)) > rate:
            run_trial(growth)  # from near a rest, where steps are short beside the time that the state takes
    if len(taken) < 2:
        raise InputError(f"no step from this state is as accurate as {rtol:g}: {len(taken)} steps were taken")
    settled = next((i for i, (a, b) in enumerate(pairwise(taken)) if b < DEADBAND[1] * a), len(taken) - 1)
    h = min(taken[settled:])
    digits = 1 - math.floor(math.log10(h))
    work = used.evaluations_per_iteration * (iterations[-1] - iterations[settled]) / sum(taken[settled:])
    return Trial(method, math.floor(h * 10.0**digits) / 10.0**digits, work)


class _TrialCompleteError(Exception):
    """Ends a run that has served its purpose."""
