"""Minima of the energy of spins, and hysteresis loops as sequences of minima."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arguments import is_integer
from manifolds._precision import with_library_settings

from ...errors import ConvergenceError, InputError
from ..conditions import checked_numbers, nonnegative_condition, positive_condition
from ..energy import Energy, Sum
from .site_terms import zeeman
from .spin_energy import check_spin_lengths, checked_finite_numbers, checked_site_values, energy_of_spins

MAX_ROTATION = 0.3
"""Largest angle (radian) by which a spin turns in a step, so that a descent stays in its valley."""

SUFFICIENT_DECREASE = 1e-4
"""Fraction of the predicted decrease of the energy that a step must reach [Armijo 1966]."""

ENERGY_ROUNDING = 1e-14
"""Increase of the energy, relative to its terms, that is rounding: the torque shrinks further when the energy rests."""


class Minimum(NamedTuple):
    """A minimum of the energy of spins.

    Attributes
    ----------
    spins : array, shape ``(*sites, 3)``
        The spins at the minimum.
    energy : float
        The energy there.
    torque : float
        Largest ``|s_i x grad_i H|``, relative to the largest ``|grad_i H|`` of a spin of the length of s_i.
    steps : int
        Number of steps.
    """

    spins: np.ndarray
    energy: float
    torque: float
    steps: int


@with_library_settings
def minimise(energy, spins, tolerance: float = 1e-8, max_steps: int = 100_000) -> Minimum:
    """Return spins of constant lengths at a local minimum of an energy, found by steepest descent with adaptive steps.

    Each step rotates every spin towards its field, by the step sizes of Barzilai & Borwein 1988 with a line search that
    never lets the energy grow [Exl et al. 2014, which mumax3 uses]. The descent follows a valley: it finds the minimum
    next to the start, not the lowest one.

    Parameters
    ----------
    energy : Energy, list of energies, or function from the spins, shape ``(*sites, 3)``, to a scalar
        The energy of the spins.
    spins : array, shape ``(*sites, 3)``
        The start; its lengths are kept.
    tolerance : float > 0
        The descent ends when no torque ``|s x grad H|`` exceeds this fraction of the largest gradient.
    max_steps : int > 0
        Largest number of steps.

    Returns
    -------
    Minimum

    Raises
    ------
    InputError, FunctionError
    ConvergenceError
        If the torque is not small after ``max_steps`` steps.

    Examples
    --------
    >>> energy = lt.magnetism.zeeman(1, (0.0, 0.0, 2.0))
    >>> round(lt.magnetism.minimise(energy, [[1.0, 0.0, 0.0]]).energy, 9)
    -2.0
    """
    start = _checked_start(spins)
    _check_stopping_criteria(tolerance, max_steps)
    return _minimise_checked(energy_of_spins(energy, start.shape[:-1]), start, tolerance, max_steps)


def _checked_start(spins) -> jax.Array:
    """Return spins of shape ``(*sites, 3)``; raise InputError unless they are finite and no spin is zero."""
    start = checked_numbers(spins, "spins")
    if start.ndim < 2 or start.shape[-1] != 3 or not bool(jnp.isfinite(start).all()):
        raise InputError(f"spins must be finite numbers of shape (*sites, 3), got {start.shape}")
    check_spin_lengths(start)
    return start


def _check_stopping_criteria(tolerance, max_steps) -> None:
    """Raise InputError unless the tolerance and the number of steps are positive and finite."""
    positive_condition("the tolerance").require(checked_numbers(tolerance, "the tolerance", ()))
    if not is_integer(max_steps) or max_steps < 1:
        raise InputError(f"max_steps must be a positive integer, got {max_steps!r}")


def _minimise_checked(energy: Energy, start: jax.Array, tolerance: float, max_steps: int) -> Minimum:
    """Return the minimum of an energy of flat states next to checked spins."""
    lengths = jnp.linalg.norm(start, axis=-1, keepdims=True)
    result = _descend_to_minimum(energy, start / lengths, lengths, jnp.asarray(tolerance), jnp.asarray(max_steps))
    unit_vectors, value, torque, steps = jax.device_get(result)
    if not torque <= tolerance:
        raise ConvergenceError(
            f"after {int(steps)} steps the torque is {float(torque):.3g} of the largest gradient, not below "
            f"{tolerance:g}. Use more max_steps or a larger tolerance",
            None,
        )
    return Minimum(unit_vectors * np.asarray(lengths), float(value), float(torque), int(steps))


class _DescentState(NamedTuple):
    """State of a gradient descent: unit vectors, energy, tangential gradient, torque, step size, attempts so far."""

    u: jax.Array
    value: jax.Array
    slope: jax.Array
    torque: jax.Array
    step: jax.Array
    attempts: jax.Array


@eqx.filter_jit
def _descend_to_minimum(energy: Energy, unit_vectors, lengths, tolerance, max_steps):
    """Return the unit vectors, energy and relative torque of a minimum, and the number of steps that found it."""

    def value_and_slope(unit_vectors):
        x = (unit_vectors * lengths).reshape(-1)
        gradient = lengths * energy.gradient(x).reshape(unit_vectors.shape)
        slope = gradient - jnp.sum(gradient * unit_vectors, axis=-1, keepdims=True) * unit_vectors
        torque = jnp.max(jnp.linalg.norm(slope, axis=-1))
        scale = jnp.max(jnp.linalg.norm(gradient, axis=-1))
        return energy.value(x), slope, torque / jnp.where(scale > 0.0, scale, 1.0), scale

    def rotate(unit_vectors, slope, step):
        # u' = ((4 - a^2) u - 4 step slope) / (4 + a^2), a = step |slope|: a rotation by 2 atan(a / 2)
        square = step**2 * jnp.sum(slope**2, axis=-1, keepdims=True)
        return ((4.0 - square) * unit_vectors - 4.0 * step * slope) / (4.0 + square)

    def limit_rotation(step, slope):
        return jnp.minimum(step, MAX_ROTATION / jnp.maximum(jnp.max(jnp.linalg.norm(slope, axis=-1)), 1e-300))

    def attempt_step(state: _DescentState) -> _DescentState:
        unit_vectors = rotate(state.u, state.slope, state.step)
        unit_vectors = unit_vectors / jnp.linalg.norm(unit_vectors, axis=-1, keepdims=True)
        value, slope, torque, scale = value_and_slope(unit_vectors)
        decrease = SUFFICIENT_DECREASE * state.step * jnp.sum(state.slope**2)
        rounding = ENERGY_ROUNDING * (jnp.abs(state.value) + scale * jnp.sqrt(unit_vectors.size / 3.0))
        is_accepted = value <= state.value - decrease + rounding
        du, dslope = unit_vectors - state.u, slope - state.slope
        curvature = jnp.sum(du * dslope)
        long_step = jnp.sum(du**2) / jnp.where(curvature > 0.0, curvature, 1.0)
        short_step = curvature / jnp.maximum(jnp.sum(dslope**2), 1e-300)
        next_step = jnp.where(
            curvature > 0.0, jnp.where(state.attempts % 2 == 0, long_step, short_step), 2.0 * state.step
        )
        accepted_state = _DescentState(
            unit_vectors, value, slope, torque, limit_rotation(next_step, slope), state.attempts + 1
        )
        rejected_state = state._replace(step=0.25 * state.step, attempts=state.attempts + 1)
        return jax.tree_util.tree_map(lambda a, b: jnp.where(is_accepted, a, b), accepted_state, rejected_state)

    value, slope, torque, scale = value_and_slope(unit_vectors)
    first_step = limit_rotation(1.0 / jnp.where(scale > 0.0, scale, 1.0), slope)
    start = _DescentState(unit_vectors, value, slope, torque, first_step, jnp.zeros((), dtype=int))
    end = jax.lax.while_loop(lambda s: (s.torque > tolerance) & (s.attempts < max_steps), attempt_step, start)
    return end.u, end.value, end.torque, end.attempts


class HysteresisLoop(NamedTuple):
    """Minima of the energy at a sequence of fields.

    Attributes
    ----------
    fields : array, shape (n, 3)
        The fields, in the order in which they were applied.
    magnetisation : array, shape (n, 3)
        Mean of the spins, weighted with their moments relative to the mean moment.
    spins : array, shape ``(n, *sites, 3)``
        The spins at rest in each field.
    energies : array, shape (n,)
        Energies, with that in the field.
    """

    fields: np.ndarray
    magnetisation: np.ndarray
    spins: np.ndarray
    energies: np.ndarray


@with_library_settings
def hysteresis_loop(
    energy,
    spins,
    fields,
    moment=1.0,
    tolerance: float = 1e-8,
    max_steps: int = 100_000,
    perturbation: float = 1e-5,
    seed: int = 0,
) -> HysteresisLoop:
    """Return the minima of the energy at a sequence of fields, each followed from the last one.

    Parameters
    ----------
    energy : Energy, list of energies, or function from the spins, shape ``(*sites, 3)``, to a scalar
        The energy of the spins without the field.
    spins : array, shape ``(*sites, 3)``
        The start; its lengths are kept.
    fields : array, shape (n, 3)
        Fields in their order, such as ``np.linspace(1, -1, 41)[:, None] * [0, 0, 1]``.
    moment : float, or array of the shape of the sites
        Moments in the Zeeman energy.
    tolerance, max_steps
        See :func:`minimise`.
    perturbation : float >= 0
        Size of random rotations (radian) before each descent. Without them a spin exactly opposite to its field stays
        there, although the state is unstable.
    seed : int >= 0
        Seed of the rotations.

    Returns
    -------
    HysteresisLoop

    Raises
    ------
    InputError, FunctionError, ConvergenceError
    """
    state = np.asarray(_checked_start(spins))
    sites = state.shape[:-1]
    terms = energy_of_spins(energy, sites).terms
    values = np.asarray(checked_finite_numbers(fields, "fields"))
    if values.ndim != 2 or values.shape[1] != 3 or not len(values):
        raise InputError(f"fields must have shape (n, 3) with n >= 1, got {values.shape}")
    _check_stopping_criteria(tolerance, max_steps)
    angle = checked_numbers(perturbation, "the perturbation", ())
    nonnegative_condition("the perturbation").require(angle)
    if not is_integer(seed) or seed < 0:
        raise InputError(f"the seed must be an integer >= 0, got {seed!r}")
    random = np.random.default_rng(seed)
    moments = np.asarray(checked_site_values(moment, sites, (), "a moment"))
    if not moments.mean() > 0.0:
        raise InputError(f"the mean of the moments must be positive, got {moments.mean():g}")
    weights = np.broadcast_to(moments / moments.mean(), sites)
    minima = []
    for field in values:
        lengths = np.linalg.norm(state, axis=-1, keepdims=True)
        state = state + float(angle) * lengths * random.standard_normal(state.shape)
        state = state * lengths / np.linalg.norm(state, axis=-1, keepdims=True)
        total = Sum((*terms, zeeman(sites, field, moments)))
        minimum = _minimise_checked(total, jnp.asarray(state), tolerance, max_steps)
        state = np.asarray(minimum.spins)
        minima.append(minimum)
    loop_spins = np.stack([minimum.spins for minimum in minima])
    axes = tuple(range(1, loop_spins.ndim - 1))
    mean = np.mean(weights[..., None] * loop_spins, axis=axes)
    return HysteresisLoop(values, mean, loop_spins, np.array([minimum.energy for minimum in minima]))
