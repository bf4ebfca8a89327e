"""``steady_cycle``: the periodic state that a system reaches under a drive that repeats itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.linalg

from manifolds._precision import with_library_settings

from ..errors import ConvergenceError, InputError
from ..integrators import OneStepMethod
from ..results.solution import Solution
from ..systems import System
from ..systems.invariants import stack_gradients
from ..systems.kind_checks import require_system
from ..systems.linearisation import conserved_functions, constant_temperature_entropy_indices
from ..tracing.interpret import evaluate_at_points
from ..tracing.programs import jit_unoptimised
from .propagator import Propagator
from .schedule import CHUNK_STEPS

CYCLE_RTOL = 1e-10
"""Largest distance of the two ends of a cycle, relative to the norm of the state."""

MAX_NEWTON_STEPS = 30
"""Largest number of Newton steps towards a cycle. A map that is affine, as that of a density matrix, needs two."""

STALL_RATIO = 0.1
"""Ratio of two distances above which Newton's method has reached rounding."""

DIFFERENCE_STEP = 1e-5
"""Distance of the states of a difference quotient, relative to that of random states. Its error is near 1e-10."""

PERIODICITY_RTOL = 1e-9
"""Largest difference of the vector field after a period, relative to the field, of a system that counts as periodic."""

CHECKED_FRACTIONS = (0.0, 0.137, 0.381, 0.618, 0.811)
"""Fractions of a period at which the vector field is compared with its value one period later."""


@dataclass(frozen=True, eq=False)
class SteadyCycle:
    """A state that repeats itself after a period, with the work and the heat of one cycle.

    Attributes
    ----------
    x : array, shape (n,)
        The state at the start of the period; the entropies of baths of constant temperature are zero.
    period : float
        Period of the cycle (time).
    residual : float
        Distance of the ends of the cycle, relative to the norm of the state.
    multipliers : array, shape (m,), complex
        Floquet multipliers, the factors by which small deviations change in one period, the largest first. Directions
        in which conserved functions change, and the counters of heat, are left out.
    work : float
        Work that the system receives in a period (energy); negative for an engine. The work on baths whose temperature
        depends on time is not part of it.
    heat : array, shape (baths,)
        Heat that flows from each bath into the system in a period (energy).
    solution : Solution
        The run over one period.
    """

    x: np.ndarray
    period: float
    residual: float
    multipliers: np.ndarray
    work: float
    heat: np.ndarray
    solution: Solution

    @property
    def stable(self) -> bool:
        """True if small deviations decay: all multipliers lie inside the unit circle."""
        return bool((np.abs(self.multipliers) < 1.0).all())

    @property
    def efficiency(self) -> float:
        """Work output over the heat that flows in from baths; NaN if the cycle delivers no work."""
        heat_in = float(self.heat[self.heat > 0.0].sum())
        return -self.work / heat_in if self.work < 0.0 < heat_in else np.nan

    def __str__(self) -> str:
        largest_multiplier = np.abs(self.multipliers).max(initial=0.0)
        return (
            f"cycle of the period {self.period:.6g}: work {self.work:.3g}, heat from the baths "
            f"{np.array2string(self.heat, precision=3)}; largest multiplier {largest_multiplier:.3g}, "
            f"residual {self.residual:.1e}"
        )


@with_library_settings
def steady_cycle(
    system: System,
    period: float,
    step: float,
    method: OneStepMethod | None = None,
    x0=None,
    start: float = 0.0,
    breaks: Sequence[float] = (),
) -> SteadyCycle:
    """Return the periodic state of a system whose energy or rates depend on time with a period.

    Newton's method solves ``P(x) = x`` for the map P of one period (the stroboscopic or Poincaré map), with the values
    that conserved functions have at x0. The map is that of the steps of ``method``, and so the cycle is exact for
    them. For a density matrix and baths of constant temperature P is affine; for an engine the result is its limit
    cycle, without the transient.

    Parameters
    ----------
    system : System
        The system; its functions fix the units.
    period : float
        The period (time).
    step : float
        Size of the steps (time).
    method : OneStepMethod
        The integrator; by default ``MetriplecticGauss(1)``, of order 2.
    x0 : array, shape (n,), optional
        State from which the search starts; by default a random one, and the completely mixed state of a quantum
        system.
    start : float
        Time at which the period starts (time).
    breaks : sequence of float
        Times at which functions of time jump; see :func:`integrate`.

    Returns
    -------
    SteadyCycle

    Raises
    ------
    ConvergenceError
        If Newton's method does not converge.
    InputError
        If the system does not repeat itself after the period, or an argument cannot be used.

    Examples
    --------
    An Otto engine of one qubit: two baths that are coupled in turn, while the frequency changes between them.

    >>> lower, excited = np.array([[0, 1], [0, 0]]), np.diag([0.0, 1.0])
    >>> wave = lambda t: jnp.sin(2 * np.pi * t / 40.0)
    >>> hot = lt.ThermalJumps(
    ...     [(lower, lambda w, T, t: 0.5 * jnp.maximum(wave(t) - 0.8, 0.0))], bath=0
    ... )
    >>> cold = lt.ThermalJumps(
    ...     [(lower, lambda w, T, t: 0.5 * jnp.maximum(-wave(t) - 0.8, 0.0))], bath=1
    ... )
    >>> H = [(excited, lambda t: 1.5 + 0.5 * jnp.clip(2.0 * wave(t), -1.0, 1.0))]
    >>> engine = lt.QuantumSystem(H, [hot, cold], baths=lt.HeatBaths(np.inf, [1.6, 0.4], 2))
    >>> cycle = lt.steady_cycle(
    ...     engine, 40.0, 0.5, breaks=40.0 / 12.0 * np.array([1, 5, 7, 11])
    ... )  # kinks of H
    >>> cycle.work < 0.0, round(cycle.efficiency, 12), 1 - 1.0 / 2.0
    (True, 0.5, 0.5)
    """
    require_system(system, "system must be a system such as lt.models.rigid_body()")
    if not system.is_driven:
        raise InputError(f"this {system.kind} does not depend on time. Its state at rest is lt.steady_state(system)")
    if not (isinstance(period, int | float | np.number) and np.isfinite(period) and period > 0.0):
        raise InputError(f"period must be a positive number, got {period!r}")
    _check_periodicity(system, float(period), start)
    x = np.array(system.steady_state_guess() if x0 is None else system.state(x0))
    counters = constant_temperature_entropy_indices(system)
    mapped_components = np.setdiff1d(np.arange(system.dim), counters)
    x[counters] = 0.0
    span, propagator = (start, start + float(period)), Propagator(system, method, step)
    end_of_period = _PeriodMap(propagator, span, tuple(breaks), x, mapped_components)
    x[mapped_components] = end_of_period(x[mapped_components])  # a first period takes part of the transient
    frozen_system = system.at_time(start)
    invariant_functions = tuple(f for name, f in conserved_functions(frozen_system, x).items() if name != "energy")
    gradients = np.zeros((0, len(mapped_components)))
    if invariant_functions:
        gradients = evaluate_at_points(stack_gradients, invariant_functions, x[None])[0][:, mapped_components]
    tangents = scipy.linalg.null_space(gradients) if len(gradients) else np.eye(len(mapped_components))
    scale, distances = float(np.linalg.norm(x[mapped_components])) or 1.0, list[float]()
    while len(distances) < MAX_NEWTON_STEPS:
        end = end_of_period(x[mapped_components])
        distances.append(float(np.linalg.norm(end - x[mapped_components])) / scale)
        has_stalled = len(distances) > 1 and distances[-1] > STALL_RATIO * distances[-2]
        if not np.isfinite(distances[-1]) or (distances[-1] <= CYCLE_RTOL and has_stalled):
            break
        monodromy = end_of_period.derivative_by_differences(
            x[mapped_components], end, system.samples(len(mapped_components))[:, mapped_components]
        )
        matrix = np.concatenate([monodromy - np.eye(len(mapped_components)), gradients])
        residual = np.append(x[mapped_components] - end, np.zeros(len(gradients)))
        x[mapped_components] += np.linalg.lstsq(matrix, residual, rcond=None)[0]
    if not distances[-1] <= CYCLE_RTOL:
        raise ConvergenceError(
            f"no cycle of the period {period:g} was found: after {len(distances)} steps its ends differ by "
            f"{distances[-1]:.2g}, relative to the state. Give another x0, or a shorter step",
            None,
        )
    solution = propagator(x, span, breaks=tuple(breaks))
    multipliers = np.linalg.eigvals(tangents.T @ monodromy @ tangents)
    heat, work = _heat_and_work(system, solution)
    return SteadyCycle(
        x,
        float(period),
        distances[-1],
        multipliers[np.argsort(-np.abs(multipliers))],
        work,
        heat,
        solution,
    )


def _heat_and_work(system: System, solution: Solution) -> tuple[np.ndarray, float]:
    """Return the heat that flows from each bath into the system over a cycle, and the work that the system receives."""
    work = float(solution.casimirs["work"][-1] - solution.casimirs["work"][0])
    if not system.baths.number:
        return np.zeros(0), work
    if not system.baths.energy.depends_on_time:
        entropies = (solution.x[-1] - solution.x[0])[system.body_dim :]
        return -np.asarray(system.temperatures(solution.x[0])) * entropies, work
    velocities = np.asarray(system.vector_field(solution.x, solution.t))[:, system.body_dim :]
    currents = -np.asarray(system.temperatures(solution.x, solution.t)) * velocities
    heat = scipy.integrate.simpson(currents, x=solution.t, axis=0)
    return heat, -float(heat.sum())  # the ledger also has the work of the agent that changes the temperatures


def _check_periodicity(system: System, period: float, start: float) -> None:
    """Raise InputError unless the vector field repeats itself after a period, at a few states and times."""
    points = jnp.asarray(system.samples(3))
    times = start + period * np.array(CHECKED_FRACTIONS)
    fields = np.asarray(_vector_field_at_points_and_times(system, points, jnp.asarray([times, times + period])))
    difference, field_norm = np.abs(fields[1] - fields[0]).max(), np.abs(fields[0]).max()
    if not difference <= PERIODICITY_RTOL * max(field_norm, np.finfo(float).tiny) * max(1.0, abs(start) + period):
        raise InputError(
            f"this {system.kind} does not repeat itself after the period {period:g}: its vector field then differs by "
            f"{difference / field_norm:.2g} of its size. Functions of time have to be periodic for all times"
        )


@jit_unoptimised
def _vector_field_at_points_and_times(system: System, points, times) -> jax.Array:
    """Return the vector field at all times and points, shape ``(*times, points, n)``, in one program.

    Evaluated one operation after another, the field of a drive with baths takes much longer than the run.
    """
    shape = (*times.shape, *points.shape)
    return system.vector_field(jnp.broadcast_to(points, shape), jnp.broadcast_to(times[..., None], shape[:-1]))


class _PeriodMap(NamedTuple):
    """The map of a state over one period, restricted to the components that are not counters of heat.

    Attributes
    ----------
    propagator : Propagator
    span : (float, float)
    breaks : tuple of float
    x : array, shape (n,)
        A state with the initial values of the counters.
    mapped_components : array of int, shape (m,)
        Indices of the components that are no counters.
    """

    propagator: Propagator
    span: tuple[float, float]
    breaks: tuple[float, ...]
    x: np.ndarray
    mapped_components: np.ndarray

    def __call__(self, start_components: np.ndarray) -> np.ndarray:
        x = self.x.copy()
        x[self.mapped_components] = start_components
        return np.asarray(self.propagator(x, self.span, save_every=CHUNK_STEPS, breaks=self.breaks).x[-1])[
            self.mapped_components
        ]

    def derivative_by_differences(
        self, start_components: np.ndarray, end_components: np.ndarray, samples: np.ndarray
    ) -> np.ndarray:
        """Return the derivative of the map, shape (m, m), by finite differences towards ``samples``, shape (m, m).

        Points between two states of a convex set, such as density matrices, belong to the set.
        """
        displacements = DIFFERENCE_STEP * (samples - start_components)
        changes = np.stack([self(start_components + d) - end_components for d in displacements])
        return np.linalg.lstsq(displacements, changes, rcond=None)[0].T
