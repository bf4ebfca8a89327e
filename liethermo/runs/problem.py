"""``Problem``: a system and a method in the form of the engines, with the laws and engines that all runs share."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ..engines.select_engine import MIN_STEPS_TO_COMPILE, EngineWithFallback
from ..integrators import OneStepMethod, Reference
from ..systems import System
from ..tracing.caching import memoize
from .noise import Fluctuations
from .preparation import (
    checked_initial_state,
    invariants_and_laws,
    limit_time_functions_to_span,
    prepare_system_and_method,
    resolve_invariants,
)
from .schedule import StepSchedule
from .solution_builder import RecordedFunctions


class Problem:
    """A system and a method in the form of the engines, with the laws and the engines of all their runs.

    Attributes
    ----------
    system : System
        The user's system, with a clock, an attitude, and charts or an embedding if it needs them.
    method : OneStepMethod or Reference
        The user's method, with noise and reconstruction if the system needs them.
    noise : Fluctuations or None
    functions : RecordedFunctions
    laws : Laws
    is_driven : bool
        Whether functions of the system depend on time.
    state_shape : tuple of int
        Shape of a state: (n,), or (*sites, d).
    has_fixed_domain : bool
        Whether runs may start at the same states whatever the parameters of the system are.
    starts_anywhere : bool
        Whether every finite array of shape (n,) is an initial state.
    """

    def __init__(self, system: System, method: Any, noise: Fluctuations | None):
        self.system, self.method, self.noise = system, method, noise
        invariants, self.laws = invariants_and_laws(system, method)
        self.functions = RecordedFunctions.from_system(system, invariants)
        self.is_driven = system.clock is not None
        self._engines = _ThreadEngines()
        self.state_shape = system.shape if system.sites else (system.dim,)
        kind = type(system)
        self.has_fixed_domain = system.space is None and system.domain.allows_every_start
        self.starts_anywhere = (
            self.has_fixed_domain and system.inner_system is None and kind.state_array is System.state_array
        )

    @classmethod
    def from_user(
        cls,
        system: System,
        method: OneStepMethod | Reference,
        noise: Fluctuations | None = None,
        adaptive_tolerance: float | None = None,
        x0=None,
    ) -> Problem:
        """Return the cached problem of a system and a method, for adaptive steps of a tolerance or for fixed steps.

        Conservation laws that do not hold by construction are tested at states near x0.

        Raises
        ------
        InputError
            If the method cannot run the system.
        """
        return _cached_problem(resolve_invariants(system, x0), method, noise, adaptive_tolerance)

    def initial_state(self, x0, t: float, attitude=None) -> np.ndarray | jax.Array:
        """Return the initial state from the user's x0, shape (n,), after checking that a run can start there.

        Raises
        ------
        InputError
        """
        is_list = isinstance(x0, list | tuple) and all(type(component) is float for component in x0)
        if self.starts_anywhere and attitude is None and (is_list or type(x0) is np.ndarray):
            x = np.asarray(x0)
            if x.dtype == np.float64 and x.shape == (self.system.dim,) and np.isfinite(x).all():
                return x
        return checked_initial_state(self.system, self.method, x0, t, attitude)

    def system_limited_to_span(self, schedule: StepSchedule) -> System:
        """Return the system with its functions of time evaluated only at times within the span of a schedule."""
        return limit_time_functions_to_span(self.system, schedule) if self.is_driven else self.system

    def engine_of_run(
        self, requested_engine: str, system: System, planned_steps: int, noise_increments: Callable | None = None
    ) -> EngineWithFallback:
        """Return an engine for a run in this thread; runs that do not depend on time or noise share engines.

        Parameters
        ----------
        requested_engine : str
            See :data:`..engines.select_engine.ENGINES`.
        system : System
            The system in the span of the run.
        planned_steps : int
            Number of steps that the run will take.
        noise_increments : function, optional
            See :class:`..engines.select_engine.EngineWithFallback`.
        """
        if self.is_driven or noise_increments is not None:
            return EngineWithFallback(system, self.method, requested_engine, planned_steps, noise_increments)
        key = requested_engine, planned_steps >= MIN_STEPS_TO_COMPILE
        engine = self._engines.engines_by_request.get(key)
        if engine is None or engine.has_fallen_back:  # the next run tries again, and warns again
            engine = self._engines.engines_by_request[key] = EngineWithFallback(
                system, self.method, requested_engine, planned_steps
            )
        return engine


class _ThreadEngines(threading.local):
    """Engines of the current thread, whose buffers no other thread may use."""

    def __init__(self):
        self.engines_by_request: dict[tuple[str, bool], EngineWithFallback] = {}


@memoize
def _cached_problem(system: System, method, noise: Fluctuations | None, adaptive_tolerance: float | None) -> Problem:
    return Problem(*prepare_system_and_method(system, method, noise, adaptive_tolerance), noise)
