"""Control of the step size: the parameters and the state of an adaptive run, and the size of its next step.

The error of a step limits the next one, and so does the rate at which small deviations grow. The steps themselves are
attempted in :mod:`.adaptive_steps`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..dissipation.geometry import project_tangent
from ..integrators import OneStepMethod
from ..systems import System
from ..systems.clock import keep_clock_components
from ..tracing.programs import jit_cached
from . import root_bracket
from .solver_options import EPS
from .status_codes import StatusCode
from .step import State

DENSE_JACOBIAN_DIM = 8
"""Largest dimension for which the whole Jacobian matrix of the vector field is computed after every step."""

KRYLOV_DIM = 24
"""Dimension of the Krylov space from which the growth rate of a larger system is computed."""

POWER_ITERATIONS = 4
"""Number of power iterations that estimate the spectral radius of the Jacobian of a larger system."""


def probe_jacobian(system: System, x) -> jax.Array:
    """Return the Jacobian of the vector field at x, or power iterates of it if it is large, for growth rates.

    For at most :data:`DENSE_JACOBIAN_DIM` components the probe is the Jacobian matrix, shape (n, n). Otherwise it has
    shape (:data:`POWER_ITERATIONS`, n): the images of normalised iterates of the power method.
    """
    jacobian_product, n = _make_jacobian_product(system, x), x.shape[0]
    if n <= DENSE_JACOBIAN_DIM:
        return jax.vmap(jacobian_product)(jnp.eye(n)).T

    def power_step(v, _):
        v = jacobian_product(v)
        return _unit_vector(v), v

    return jax.lax.scan(power_step, _unit_vector(_fixed_random_vector(n)), length=POWER_ITERATIONS)[1]


@jit_cached
def arnoldi_hessenberg(system, method, x):
    """Return the Hessenberg matrix, shape (m, m), of Arnoldi's method for the Jacobian of the field at x.

    Its eigenvalues approximate the extremal eigenvalues of the Jacobian.
    """
    system, x = system.subsystem_to_solve(x)
    jacobian_product, n = _make_jacobian_product(system, x), x.shape[0]
    m = min(n, KRYLOV_DIM)

    def arnoldi_step(carry, i):
        basis, matrix = carry
        v = jacobian_product(basis[i])
        coefficients, remainder = orthogonalise(basis, v)
        remainder_norm = jnp.linalg.norm(remainder)
        # in an invariant subspace the remainder vanishes: continue outside of it
        is_invariant = remainder_norm <= 1e-10 * jnp.linalg.norm(v)
        remainder_norm = jnp.where(is_invariant, 0.0, remainder_norm)
        remainder = jnp.where(is_invariant, jnp.roll(_fixed_random_vector(n), i + 1), remainder)
        matrix = matrix.at[:m, i].set(coefficients[:m]).at[i + 1, i].set(remainder_norm)
        return (basis.at[i + 1].set(_unit_vector(orthogonalise(basis, _unit_vector(remainder))[1])), matrix), None

    def orthogonalise(basis, v):
        coefficients = basis @ v
        v = v - coefficients @ basis
        correction = basis @ v  # the second pass removes the rounding errors of the first
        return coefficients + correction, v - correction @ basis

    initial_basis = jnp.zeros((m + 1, n)).at[0].set(_unit_vector(_fixed_random_vector(n)))
    (_, matrix), _ = jax.lax.scan(arnoldi_step, (initial_basis, jnp.zeros((m + 1, m))), jnp.arange(m))
    return matrix[:m]


def _make_jacobian_product(system: System, x) -> Callable:
    """Return a function that multiplies tangent vectors by the Jacobian of the vector field at x.

    Rows and columns of the time and the work are zero: nothing grows by them, and in the unit of the clock derivatives
    by the time are so large that the eigenvalues of the whole matrix would be rounding errors.
    """

    def restrict(v) -> jax.Array:
        v = project_tangent(system, x, v)
        return v - keep_clock_components(system, v)

    return lambda v: restrict(jax.jvp(system.vector_field, (x,), (restrict(v),))[1])


def _fixed_random_vector(n: int) -> np.ndarray:
    """Return the same random vector at each call, shape (n,), with components along all eigenvectors."""
    return np.random.default_rng(0).standard_normal(n)


def _unit_vector(v):
    norm = jnp.linalg.norm(v)
    return v / jnp.where(norm > 0.0, norm, 1.0)


MAX_FACTOR_IMPLICIT = 3.0
"""Largest ratio of consecutive step sizes of an implicit method; beyond it the predicted stages are worthless."""

MAX_FACTOR_EXPLICIT = 10.0
"""Largest ratio of consecutive step sizes of an explicit method."""

MIN_FACTOR = 0.2
"""Smallest ratio of consecutive step sizes, after a step with a large error."""

FACTOR_AFTER_NONCONVERGENCE = 0.25
"""Ratio of the next step size to that of a step whose stage equations were not solved."""

ERROR_TARGET_FRACTION = 0.4
"""Fraction of the allowed error at which the next step aims."""

TRUNCATED_STEP_RATIO = 0.99
"""Ratio to the planned step size below which a step counts as truncated by a stop time."""

DEADBAND = (0.9, 1.3)
"""Range of factors for which the step size is kept: small changes spoil the prediction, and chatter."""

MIN_RELATIVE_ERROR = 4.0 * EPS
"""Smallest allowed error of a step, relative to the norm of the state."""

GROWTH_RATE_RTOL = 2e-3
"""Largest relative error of the rate at which a small deviation grows.

A fall from an unstable equilibrium then takes the right time, to a few thousandths. The error estimate of the state
does not show this, because the deviation is not yet visible in the state.
"""

MAX_ATTITUDE_ANGLE = 0.5 * math.pi
"""Largest angle, in radians, by which an adaptive step turns an attitude. Rotation angles are unique below pi."""

MIN_GROWTH_TO_FREQUENCY = 0.01
"""Smallest ratio of the growth rate of an oscillation to its frequency for which it limits the step.

The Jacobian of an ongoing motion varies, which gives oscillations that nothing excites small rates of either sign.
"""

JACOBIAN_CHANGE_RTOL = 0.05
"""Relative change of the Jacobian probe below which the growth rate is not computed again."""


class StepControl(Module):
    """Parameters of adaptive steps and of the event search, passed to programs as arguments.

    Attributes
    ----------
    rtol, atol, first_step, max_step, min_step, max_attempts : array, shape ()
        Tolerances; the first step size, 0 to estimate it; the largest and smallest step size; the number of attempts.
    event_functions : tuple of pytrees
        Functions ``(system, t, x)`` whose sign changes are events.
    event_directions : tuple of int
        For each function 1 if only its rises are events, -1 if only its falls, or 0.
    adaptive : bool
        If false, all steps have the size ``first_step``, except those that end at a stop time.
    """

    rtol: jax.Array | np.ndarray
    atol: jax.Array | np.ndarray
    first_step: jax.Array | np.ndarray
    max_step: jax.Array | np.ndarray
    min_step: jax.Array | np.ndarray
    max_attempts: jax.Array | np.ndarray
    event_functions: tuple[Any, ...]
    event_directions: tuple[int, ...] = eqx.field(static=True)
    adaptive: bool = eqx.field(static=True)

    def allowed_error(self, scale) -> jax.Array:
        """Return the error of a step that is allowed for a state of norm ``scale``."""
        return self.atol + self.rtol * scale

    @property
    def event_shape(self) -> tuple[int]:
        """Shape of an array with one value for each event function; (1,) without functions."""
        return (max(1, len(self.event_functions)),)

    def event_values(self, system: System, t, x) -> jax.Array:
        """Return the values of the event functions at (t, x), shape ``event_shape``."""
        if not self.event_functions:
            return jnp.zeros(self.event_shape)
        return jnp.stack([function(system, t, x) for function in self.event_functions])


class AdaptiveState(NamedTuple):
    """The state of an adaptive run; its ``state.status`` may be the reason of a pause."""

    state: State
    t: jax.Array
    stop_time: jax.Array  # next time at which a step has to end
    last_stop_time: jax.Array
    steps_at_last_stop: jax.Array  # number of steps taken until the last stop time
    next_step_size: jax.Array  # unless the step has to end at a stop time
    last_step_size: jax.Array  # size of the last attempted step
    optimal_step_size: jax.Array  # size with which the last accepted step would have had the allowed error; 0 at first
    n_attempts: jax.Array
    n_rejected: jax.Array
    last_attempt_status: jax.Array
    event_values: jax.Array  # of the event functions; where one is NaN, infinity with its last known sign
    max_relative_rate: jax.Array  # largest rate of change of the state so far, relative to its norm
    growth_rate: jax.Array  # largest growth rate when it was last computed; NaN if it must be computed
    jacobian_probe: jax.Array  # probe of the Jacobian when the growth rate was last computed
    root_bracket: jax.Array  # search for the first event in a step: see root_bracket.pack_bracket_and_end_values


def jacobian_probe_shape(system: System, method: OneStepMethod, control: StepControl) -> tuple[int, ...]:
    """Return the shape of the field ``jacobian_probe`` of an adaptive state; (1, 1) for fixed steps."""
    if not control.adaptive:
        return 1, 1
    x = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
    return jax.eval_shape(lambda x: probe_jacobian(*system.subsystem_to_solve(x)), x).shape


def next_step_size_and_end_time(control: StepControl, adaptive_state: AdaptiveState) -> tuple[jax.Array, jax.Array]:
    """Return the size of the next step or of the next trial step of an event search, and the time after it."""
    h, time_after = next_step_size_and_end_time_outside_event_search(control, adaptive_state)
    if not control.event_functions:
        return h, time_after
    bracket, _ = root_bracket.unpack_bracket_and_end_values(adaptive_state.root_bracket)
    trial_step = bracket.trial_fraction * bracket.step_size
    trial_time = jnp.minimum(adaptive_state.t + trial_step, adaptive_state.stop_time)
    return jnp.where(bracket.step_size > 0.0, trial_step, h), jnp.where(bracket.step_size > 0.0, trial_time, time_after)


def next_step_size_and_end_time_outside_event_search(
    control: StepControl, adaptive_state: AdaptiveState
) -> tuple[jax.Array, jax.Array]:
    """Return the size of the next step, if no event is searched for, and the time after it.

    No step ends just before a stop time.
    """
    if control.adaptive:
        remaining = adaptive_state.stop_time - adaptive_state.t
        reaches_stop = remaining <= adaptive_state.next_step_size * (1 + 1e-12)
        h = jnp.where(
            reaches_stop,
            remaining,
            jnp.where(remaining < 2.0 * adaptive_state.next_step_size, 0.5 * remaining, adaptive_state.next_step_size),
        )
        time_after = jnp.where(reaches_stop, adaptive_state.stop_time, adaptive_state.t + h)
        # the step as the difference of the rounded times, so that their rounding errors do not accumulate
        return jnp.where(reaches_stop | ~(time_after > adaptive_state.t), h, time_after - adaptive_state.t), time_after
    # the same steps as runs.schedule; after an event the next one is shorter
    interval = adaptive_state.stop_time - adaptive_state.last_stop_time
    step, n_done = adaptive_state.next_step_size, adaptive_state.state.step - adaptive_state.steps_at_last_stop
    n_full = jnp.floor(interval / step * (1 + 1e-12))
    remainder = adaptive_state.stop_time - (adaptive_state.last_stop_time + n_full * step)
    has_remainder = remainder > 1e-12 * interval
    reaches_stop = n_done + 1.0 >= jnp.where(has_remainder, n_full + 1.0, n_full)
    time_after = jnp.where(
        reaches_stop, adaptive_state.stop_time, adaptive_state.last_stop_time + (n_done + 1.0) * step
    )
    if not control.event_functions:
        return jnp.where(n_done < n_full, step, remainder), time_after
    is_after_event = adaptive_state.t != adaptive_state.last_stop_time + n_done * step
    h = jnp.where(is_after_event, time_after - adaptive_state.t, jnp.where(n_done < n_full, step, remainder))
    return h, time_after


# -- choice of the step size ------------------------------------------------------------------------------------------


def step_size_after_acceptance(
    optimal, previous_optimal, h, planned_size, power, max_step, explicit: bool
) -> jax.Array:
    """Return the size of the next step after an accepted one of size h.

    A step of the size ``optimal`` would have had the allowed error. If the optimal size shrinks, from
    ``previous_optimal``, the trend is extrapolated [Gustafsson; Hairer & Wanner 1996, IV.8]. The step size of an
    implicit method is kept if the change would be small. A truncated step tells little about the next one.
    """
    max_factor = MAX_FACTOR_EXPLICIT if explicit else MAX_FACTOR_IMPLICIT
    trend = jnp.where(
        optimal < previous_optimal, optimal / jnp.where(previous_optimal > 0.0, previous_optimal, 1.0), 1.0
    )
    factor = jnp.clip(ERROR_TARGET_FRACTION**power * optimal / h * trend, MIN_FACTOR, max_factor)
    new_size = jnp.minimum(h * factor, max_step)
    is_in_deadband = (DEADBAND[0] < factor) & (factor < DEADBAND[1]) & (not explicit)
    return jnp.where(
        h < TRUNCATED_STEP_RATIO * planned_size,
        jnp.maximum(planned_size, new_size),
        jnp.where(is_in_deadband, planned_size, new_size),
    )


def step_size_after_rejection(error, h, power) -> jax.Array:
    """Return the size of the next step after a rejected one of size h with a given error, infinite if unsolved."""
    is_solved = jnp.isfinite(error)
    factor = jnp.maximum(
        MIN_FACTOR, (ERROR_TARGET_FRACTION / jnp.where(is_solved, jnp.maximum(error, 1.0), 1.0)) ** power
    )
    return h * jnp.minimum(jnp.where(is_solved, factor, FACTOR_AFTER_NONCONVERGENCE), 0.9)


# -- growth rates -----------------------------------------------------------------------------------------------------


def max_step_times_rate(method: OneStepMethod, relative_error):
    """Return the largest product of step size and rate for which the relative error is as given.

    A step of a one-step method multiplies the solution of a linear equation of rate r by R(h r), instead of exp(h r).
    R is assumed to be the diagonal Padé approximation of the method's order.
    """
    s = max(1, method.order // 2)
    pade_constant = math.factorial(2 * s) * math.factorial(2 * s + 1) / math.factorial(s) ** 2
    return (relative_error * pade_constant) ** (0.5 / s)  # ln R(z) / z = 1 +- z^2s / pade_constant + ...


def max_step_times_growth_rate_for_accuracy(method: OneStepMethod) -> float:
    """Return the largest product of step and growth rate for which growth is accurate to :data:`GROWTH_RATE_RTOL`.

    Implicit methods damp or preserve what they do not resolve, so a long step can miss an instability.
    """
    return max_step_times_rate(method, GROWTH_RATE_RTOL)


def max_step_for_attitude(method: OneStepMethod, system: System, x, relative_error) -> jax.Array:
    """Return the largest step in which an attitude that turns at its rate at x has a given relative error.

    Explicit methods follow rotation angles, which are exact in a steady turn: they only need the angles to be small.
    """
    rate = method.attitude_speed_bound(system, x)
    allowed_angle = jnp.inf if method.explicit else max_step_times_rate(method, relative_error)
    angle = jnp.minimum(allowed_angle, MAX_ATTITUDE_ANGLE)
    return jnp.where(rate > 0.0, angle / jnp.where(rate > 0.0, rate, 1.0), jnp.inf)


def limit_next_step_by_growth_rate(method: OneStepMethod, adaptive_state: AdaptiveState, probe) -> AdaptiveState:
    """Return the adaptive state with its next step limited by the growth rate, or paused to compute this rate.

    ``probe`` is the Jacobian probe at the state: see :func:`.step_control.probe_jacobian`.
    """
    is_short = ~(
        (max_step_times_growth_rate_for_accuracy(method) < spectral_radius_bound(probe) * adaptive_state.next_step_size)
        & jnp.isfinite(spectral_radius_bound(probe))
    )
    is_unchanged = frobenius_norm(probe - adaptive_state.jacobian_probe) <= JACOBIAN_CHANGE_RTOL * frobenius_norm(
        adaptive_state.jacobian_probe
    )
    limit = jnp.where(
        adaptive_state.growth_rate > 0.0,
        max_step_times_growth_rate_for_accuracy(method)
        / jnp.where(adaptive_state.growth_rate > 0.0, adaptive_state.growth_rate, 1.0),
        jnp.inf,
    )
    needs_rate = ~is_short & ~is_unchanged
    status = jnp.where(
        needs_rate & (adaptive_state.state.status == StatusCode.COMPLETED),
        StatusCode.PAUSED_FOR_GROWTH_RATE,
        adaptive_state.state.status,
    )
    return adaptive_state._replace(
        state=adaptive_state.state._replace(status=status.astype(adaptive_state.state.status.dtype)),
        next_step_size=jnp.where(
            is_short | needs_rate, adaptive_state.next_step_size, jnp.minimum(adaptive_state.next_step_size, limit)
        ),
        jacobian_probe=jnp.where(needs_rate, probe, adaptive_state.jacobian_probe),
        growth_rate=jnp.where(needs_rate, jnp.nan, adaptive_state.growth_rate),
    )


def spectral_radius_bound(probe) -> jax.Array:
    """Return a bound or an estimate of the spectral radius of the Jacobian, from its matrix or power iterates."""
    if probe.shape[1] > DENSE_JACOBIAN_DIM:
        return jnp.sqrt(jnp.max(jnp.sum(probe * probe, axis=1)))
    matrix_squared = probe @ probe
    return jnp.sqrt(jnp.sqrt(frobenius_norm(matrix_squared @ matrix_squared)))


def frobenius_norm(matrix) -> jax.Array:
    return jnp.sqrt(jnp.sum(matrix * matrix))


def max_moduli_of_growing_eigenvalues(matrices: np.ndarray) -> np.ndarray:
    """Return the largest modulus of growing eigenvalues of each matrix, shape (...), of matrices (..., n, n)."""
    is_finite = np.isfinite(matrices).all(axis=(-2, -1))
    rates = np.linalg.eigvals(np.where(is_finite[..., None, None], matrices, 0.0))
    return np.where(rates.real > MIN_GROWTH_TO_FREQUENCY * np.abs(rates), np.abs(rates), 0.0).max(axis=-1, initial=0.0)


def largest_growth_rate_by_arnoldi(system: System, method: OneStepMethod, x) -> float:
    """Return the largest growth rate of the linear motion at x, by Arnoldi's method, for large systems."""
    return float(max_moduli_of_growing_eigenvalues(np.asarray(arnoldi_hessenberg(system, method, jnp.asarray(x)))))
