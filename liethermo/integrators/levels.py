"""Projection of a step onto the levels of functions, and onto the surface, on which it has to end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..functions.energy import Energy
from ..functions.frames import MIN_SQUARED_NORM, vector_with_inner_products
from ..functions.gradients import CURVATURE_SWITCH, DIFFERENCE_NOISE, EPS, MIN_GRADIENT_VARIATION, Gonzalez
from ..functions.surface import Surface
from ..systems import System

MAX_PROJECTION_ITERATIONS = 4
"""Largest number of Newton corrections of a step: after four, a relative error of a twentieth is at rounding level."""

MAX_RELAXED_ITERATIONS = 3
"""Number of further corrections, with free entropy growth, for a step whose levels have no common point."""

LEVEL_RTOL_OF_STEP = 64.0 * EPS
"""Largest distance of a corrected step from its levels, relative to the length of the step."""

LEVEL_RTOL_OF_STATE = 0.01 * EPS
"""Largest distance of a corrected step from its levels, relative to the state.

The step of a state at rest is rounding, and no correction of it is known.
"""

MAX_RELAXED_RESIDUAL = 1e-6
"""Largest residual of the conserved levels, relative to the step and before any correction, for relaxed corrections.

A step that misses these levels by more is too long.
"""

GRADIENT_NOISE_RTOL = 1e-8
"""Tolerated noise in discrete gradients of explicit steps: see :data:`..functions.gradients.MAX_DIFFERENCE_NOISE`.

Such a step is not iterated: noise in the change of a function is no larger than its rounding. It does not add up, since
the values at the end of a step are those at the start of the next.
"""

SIMPSON_DEGREE = 4
"""Degree up to which Simpson's rule with gradients is exact."""

VALUE_DIFFERENCE_RTOL = 16.0 * EPS
"""Error of a difference of two function values, relative to their rounding scale: a few roundings of both."""

PRODUCT_RTOL = 4.0 * EPS
"""Error of the product of a gradient with a step, relative to their lengths: a few roundings of its terms."""

VANISHED_LENGTH = math.sqrt(MIN_SQUARED_NORM)
"""Length below which a direction counts as zero."""

REST_RTOL = 8.0 * EPS
"""Largest ``|Pi(x) dH|``, relative to |x| |dH|, that is rounding: no step along the leaf then changes H."""

SMALL_MOMENTUM_RATIO = 1e-3
"""Length of a momentum, relative to a state with wheels or joints, below which corrections move it less."""

MIN_MEAN_GRADIENT = 0.5
"""Smallest length of the mean gradient of a step, relative to the gradient at its start.

Where a driven body comes to rest, the gradient at the end of the step vanishes, and the change is rounded as before.
"""

MAX_WORK_RTOL = 1e-2
"""Largest correction of the work of a step at whose end a driven body is at rest, relative to the change of the energy.

There the level of the energy less the work may have no point: the state cannot lose more energy than it has. The error
of the work, of the order of the method, is then taken from the work.
"""

CHANGE_GRADIENT = Gonzalez(GRADIENT_NOISE_RTOL, across=True)
"""The discrete gradient that gives the change of a function in a step."""


class Law(NamedTuple):
    """A function and the sign of its change: -1 if it must fall, 0 if it must stay, 1 if it must rise."""

    function: Energy
    sign: float


LAW_SIGNS = {"conserved": 0.0, "nondecreasing": 1.0, "nonincreasing": -1.0}
"""Sign of the change of a function, by the name of its law."""


class ProjectionState(NamedTuple):
    """A displacement, its residuals (surface and levels), the lengths of the directions, and the next correction."""

    d: jax.Array
    surface_residual: jax.Array
    level_residual: jax.Array
    direction_lengths: jax.Array
    correction: jax.Array


def project_onto_levels(
    system: System,
    laws: list[Law],
    start_gradients: list,
    x,
    compensation,
    d,
    target_changes,
    max_corrections: int = MAX_PROJECTION_ITERATIONS,
    follow_leaf: bool = False,
    momentum_dim: int = 0,
) -> tuple[jax.Array, jax.Array]:
    """Return the displacement nearest to d that changes the functions by ``target_changes``, and its residual.

    The residual is the length by which the displacement misses these changes. ``start_gradients`` are the gradients of
    the functions at x + compensation. With ``follow_leaf`` the displacement is along the symplectic leaf, and d is the
    covector that carries the state. The first ``momentum_dim`` components are a momentum of constant length, which
    corrections leave at zero, and move less the smaller it is.

    Near an equilibrium the entropy is almost the largest that the conserved functions allow. If a step overestimates
    the production, the levels may have no common point. Corrections along linearly dependent gradients would then
    not converge, and the rounding errors on all levels would have one sign. So such a function has no prescribed
    change: it changes as the others determine, or not at all if that change has the wrong sign.
    """
    discrete_gradient, surface, clock = CHANGE_GRADIENT, system.constraint_surface, system.clock
    work_direction = None if clock is None else clock.work_direction(system.dim)
    signs = jnp.asarray([law.sign for law in laws])
    functions, blocks = [law.function for law in laws], system.state_blocks

    def corrected_displacement_and_residual(s: ProjectionState) -> tuple[jax.Array, jax.Array]:
        d = s.d + correction_displacement(system, x + (compensation + s.d), s.correction, follow_leaf, momentum_dim)
        return (d, jnp.zeros(())) if surface is None else surface.project_displacement(x, compensation, d)

    def gradient_vectors_at(state, gradients) -> list[jax.Array]:
        """Return the gradients as vectors: their inner products with a displacement are changes of the functions."""
        if follow_leaf:
            return [system.raise_index(state, v) for v in gradients]
        return correction_directions(system, state, gradients)

    def max_possible_changes(gradient_vectors, d) -> jax.Array:
        """Return the largest change of each function in any displacement whose blocks are as long as those of d."""
        return jnp.stack([sum(jnp.linalg.norm(v[b]) * jnp.linalg.norm(d[b]) for b in blocks) for v in gradient_vectors])

    def change_gradient(f: Energy, d, start_gradient, end_gradient) -> jax.Array:
        """Return the discrete gradient of f along d; for a polynomial by a quadrature with gradients at both ends."""
        mean = 0.5 * (start_gradient + end_gradient)
        if f.degree > SIMPSON_DEGREE:
            return discrete_gradient(f, x, d, compensation)
        return mean if f.is_quadratic else (mean + 2.0 * f.gradient(x + (compensation + 0.5 * d))) / 3.0

    def level_residuals(d, end_gradients) -> jax.Array:
        gradients = [
            change_gradient(f, d, *end_pair)
            for f, *end_pair in zip(functions, start_gradients, end_gradients, strict=True)
        ]
        return target_changes - jnp.stack([jnp.dot(gradient, d) for gradient in gradients])

    def apply_correction(s: ProjectionState) -> tuple[ProjectionState, list]:
        """Apply the next correction of a projection; return its state with new residuals, and the gradients there."""
        d, surface_residual = corrected_displacement_and_residual(s)
        end_gradients = [f.gradient(x + (compensation + d)) for f in functions]
        return s._replace(
            d=d, surface_residual=surface_residual, level_residual=level_residuals(d, end_gradients)
        ), end_gradients

    def drop_allowed_monotone_residuals(s: ProjectionState) -> ProjectionState:
        """Set the residual of each monotone function to zero if its change has the allowed sign; else aim at none."""
        actual_changes, rounding = (
            target_changes - s.level_residual,
            DIFFERENCE_NOISE * s.direction_lengths * jnp.linalg.norm(s.d),
        )
        return s._replace(
            level_residual=jnp.where(
                signs == 0.0, s.level_residual, jnp.where(signs * actual_changes >= -rounding, 0.0, -actual_changes)
            )
        )

    def with_next_correction(s: ProjectionState, end_gradients, direction_mask=None) -> ProjectionState:
        """Return s with the next correction, along the directions in ``direction_mask``, and the lengths of all.

        These lengths turn a residual of a function into a length like that of d. If parts of a state have different
        units, as entropies beside a momentum, the largest change of the function per length of d counts, or the
        rounding that the correction of another function leaves: for example that of the energy in baths that receive no
        heat.
        """
        end_state = x + (compensation + s.d)
        directions = correction_directions(system, end_state, end_gradients, follow_leaf, momentum_dim)
        is_same = not follow_leaf and not momentum_dim
        gradient_vectors = directions if is_same else gradient_vectors_at(end_state, end_gradients)
        if len(blocks) == 1:
            lengths = jnp.stack([jnp.linalg.norm(v) for v in gradient_vectors])
        else:
            step_length = jnp.linalg.norm(s.d)
            max_changes = max_possible_changes(gradient_vectors, s.d)
            products = jnp.abs(jnp.stack(gradient_vectors) @ jnp.stack(gradient_vectors).T)
            squares = jnp.diagonal(products)
            rounding_ratios = products / jnp.where(
                squares > MIN_SQUARED_NORM, squares, 1.0
            )  # of what rounds one in what rounds another
            lengths = (rounding_ratios @ max_changes) * (1.0 / jnp.where(step_length > 0.0, step_length, 1.0))
        if direction_mask is not None:
            directions = [jnp.where(direction_mask[i], v, 0.0) for i, v in enumerate(directions)]
        if work_direction is None:
            correction = level_correction_vector(system, directions, s.level_residual)
        else:
            start_lengths = max_possible_changes(start_vectors, s.d) / jnp.maximum(
                jnp.linalg.norm(s.d), VANISHED_LENGTH
            )
            is_unreachable = is_level_unreachable(s, max_possible_changes(gradient_vectors, s.d))
            lengths = jnp.maximum(lengths, MIN_MEAN_GRADIENT * start_lengths)
            work = s.level_residual * jnp.stack([jnp.dot(v, work_direction) for v in end_gradients])
            correction = level_correction_vector(system, directions, jnp.where(is_unreachable, 0.0, s.level_residual))
            correction += jnp.sum(jnp.where(is_unreachable, work, 0.0)) * work_direction
        return s._replace(direction_lengths=lengths, correction=correction)

    def is_level_unreachable(s: ProjectionState, end_changes) -> jax.Array:
        """Return for each function, shape (laws,), whether a driven body comes to rest before it reaches the level.

        The gradient of a function then nearly vanishes at the end of the step, and Newton's correction of the residual
        would be longer than half of the distance to the rest. A step that is too long for its residual is no such step.
        """
        changes, residual = max_possible_changes(start_vectors, s.d), jnp.abs(s.level_residual)
        is_out_of_reach = 4.0 * residual * changes > end_changes**2
        return (end_changes < MIN_MEAN_GRADIENT * changes) & is_out_of_reach & (residual <= MAX_WORK_RTOL * changes)

    def is_converged(s: ProjectionState) -> jax.Array:
        is_small = jnp.abs(s.level_residual) <= EPS * s.direction_lengths * jnp.linalg.norm(s.d)
        return (s.surface_residual == 0.0) & (is_small | (s.direction_lengths <= VANISHED_LENGTH)).all()

    def correct_unless_finished(carry, iteration):
        """Apply the next correction unless the iteration has finished; return the new carry, and None for the scan.

        Later corrections are relaxed, and the last one is along conserved functions only.
        """
        s, is_finished = carry
        is_relaxed, is_last = (
            iteration >= max_corrections - 1,
            iteration >= max_corrections + MAX_RELAXED_ITERATIONS - 2,
        )
        restarts = iteration == max_corrections - 1
        is_finished = is_finished | jax.lax.cond(
            restarts, lambda: ~is_near | is_within_tolerance(s), lambda: jnp.asarray(False)
        )

        def correct_once() -> ProjectionState:
            current = s._replace(
                d=jnp.where(restarts, start_d, s.d), correction=jnp.where(restarts, start_correction, s.correction)
            )
            current, end_gradients = apply_correction(current)
            current = current._replace(
                level_residual=jnp.where(
                    is_relaxed, drop_allowed_monotone_residuals(current).level_residual, current.level_residual
                )
            )
            direction_mask = (signs == 0.0) | ~is_relaxed | ((current.level_residual != 0.0) & ~is_last)
            return with_next_correction(current, end_gradients, direction_mask)

        s = jax.lax.cond(is_finished, lambda: s, correct_once)
        return (s, is_finished | is_converged(s)), None

    def residual_length(s: ProjectionState, rounding) -> jax.Array:
        """Return the level residual beyond rounding, converted to a length, shape ()."""
        has_vanished, excess = (
            s.direction_lengths <= VANISHED_LENGTH,
            jnp.maximum(jnp.abs(s.level_residual) - rounding, 0.0),
        )
        return jnp.max(jnp.where(has_vanished, 0.0, excess / jnp.where(has_vanished, 1.0, s.direction_lengths)))

    def is_within_tolerance(s: ProjectionState) -> jax.Array:
        tolerance = LEVEL_RTOL_OF_STEP * jnp.linalg.norm(s.d) + LEVEL_RTOL_OF_STATE * jnp.linalg.norm(x)
        return s.surface_residual + residual_length(s, level_residual_rounding(s.d)) <= tolerance

    def level_residual_rounding(d) -> jax.Array:
        """Return the part of the level residuals that rounding of functions explains, shape (laws,).

        On a surface the product of a gradient with d is rounded at the scale of both lengths, although the part of the
        gradient along the surface, in whose direction d is corrected, vanishes near rest.

        In a short step the change of a function is a quadrature of its gradient, whose rounding vanishes with d: then
        the values are not used. :class:`Gonzalez` uses the values of a term wherever its gradient is curved, however
        little it changes from one end to the other.
        """
        begin = x + compensation
        is_long = jnp.linalg.norm(d) > MIN_GRADIENT_VARIATION * jnp.linalg.norm(x)

        def is_curved(term: Energy, start_gradient, end_gradient) -> jax.Array:
            middle = term.gradient(begin + 0.5 * d)
            second_difference = jnp.linalg.norm(start_gradient + end_gradient - 2.0 * middle)
            return second_difference > CURVATURE_SWITCH * jnp.linalg.norm(middle)

        def rounding_of_function_change(f: Energy, start_gradient) -> jax.Array:
            end_gradient = f.gradient(begin + d)
            change = jnp.linalg.norm(end_gradient - start_gradient)
            uses_values = is_long | (change > MIN_GRADIENT_VARIATION * jnp.linalg.norm(start_gradient))
            scale = jnp.zeros(())
            for term in f.terms:
                if not term.is_quadratic:
                    ends = (start_gradient, end_gradient)
                    if len(f.terms) > 1:
                        ends = (term.gradient(begin), term.gradient(begin + d))
                    scale += jnp.where(uses_values | is_curved(term, *ends), term.difference_rounding_scale(x), 0.0)
            rounding = VALUE_DIFFERENCE_RTOL * scale
            if surface is not None:
                products = sum(jnp.linalg.norm(start_gradient[b]) * jnp.linalg.norm(d[b]) for b in blocks)
                rounding += PRODUCT_RTOL * products
            return rounding

        return jnp.stack(
            [rounding_of_function_change(f, start) for f, start in zip(functions, start_gradients, strict=True)]
        )

    start_vectors: list[jax.Array] = []
    if work_direction is not None:
        begin = x + compensation
        start_vectors = gradient_vectors_at(begin, start_gradients)
    zero_residual = jnp.zeros(len(laws))
    start_d, start_correction = (jnp.zeros_like(d), -d) if follow_leaf else (d, jnp.zeros_like(d))
    s = with_next_correction(
        *apply_correction(ProjectionState(start_d, jnp.zeros(()), zero_residual, zero_residual, start_correction))
    )
    is_near = residual_length(s, jnp.where(signs == 0.0, 0.0, jnp.inf)) <= MAX_RELAXED_RESIDUAL * jnp.linalg.norm(s.d)
    s, last_gradients = apply_correction(s)  # one correction is enough for a short step
    has_converged = is_converged(s)

    n_conserved = sum(law.sign == 0.0 for law in laws)
    can_be_released = n_conserved < len(laws) and (n_conserved > 0 or surface is not None)
    n_iterations = max_corrections - 1 + (MAX_RELAXED_ITERATIONS + 1 if can_be_released else 0)

    def iterate_corrections() -> tuple[ProjectionState, jax.Array]:
        s_further, _ = jax.lax.scan(
            correct_unless_finished, (with_next_correction(s, last_gradients), has_converged), jnp.arange(n_iterations)
        )[0]
        return s_further, is_converged(s_further)

    s, has_converged = jax.lax.cond(has_converged, lambda: (s, has_converged), iterate_corrections)
    rounding = jax.lax.cond(
        has_converged, lambda: jnp.zeros_like(s.level_residual), lambda: level_residual_rounding(s.d)
    )
    return s.d, s.surface_residual + residual_length(s, rounding)


def correction_directions(
    system: System, x, gradients: Sequence[jax.Array], follow_leaf: bool = False, momentum_dim: int = 0
) -> list[jax.Array]:
    """Return the directions, along the surface, in which functions with these gradients at x are corrected.

    With ``follow_leaf`` they are directions of the covectors that carry the state along its leaf. The first
    ``momentum_dim`` components are a momentum of constant length: see :func:`_weights_vanishing_with_momentum`.
    """
    if momentum_dim:
        weights = _weights_vanishing_with_momentum(system, x, momentum_dim)
        gradients = [weights * gradient for gradient in gradients]
    if follow_leaf:
        gradients = [_symplectic_leaf_direction(system, x, gradient) for gradient in gradients]
    directions, surface = [system.raise_index(x, gradient) for gradient in gradients], system.constraint_surface
    return directions if surface is None else [surface.project_direction(x, v) for v in directions]


def _symplectic_leaf_direction(system: System, x, gradient) -> jax.Array:
    """Return ``Pi(x) gradient``, shape (n,); zero if it is only rounding, as at a state at rest on its leaf."""
    direction, n = system.poisson.sharp(x, gradient), system.body_dim  # a clock and work have other units
    is_at_rest = jnp.linalg.norm(direction[:n]) <= REST_RTOL * jnp.linalg.norm(x[:n]) * jnp.linalg.norm(gradient[:n])
    return jnp.where(is_at_rest & (jnp.arange(direction.size) < n), 0.0, direction)


def level_correction_vector(
    system: System,
    directions: Sequence[jax.Array],
    changes: jax.Array,
    is_usable: Callable[[jax.Array], jax.Array] | None = None,
) -> jax.Array:
    """Return the vector in the span of the directions whose inner products with them are the given changes."""
    return vector_with_inner_products(directions, changes, min(len(system.state_blocks), 2), is_usable)


def correction_displacement(
    system: System, x, correction, follow_leaf: bool = False, momentum_dim: int = 0
) -> jax.Array:
    """Return the displacement of x by a correction: itself, or with ``follow_leaf`` the motion along the leaf by it.

    The covector of this motion is minus the correction: ``dH . Pi K = -(Pi dH) . K`` gives its sign.
    """
    if follow_leaf:
        return system.poisson.leaf_displacement(x, -correction)
    return _weights_vanishing_with_momentum(system, x, momentum_dim) * correction if momentum_dim else correction


def _weights_vanishing_with_momentum(system: System, x, momentum_dim: int) -> jax.Array:
    """Return weights of the components, shape (n,), that vanish on a momentum near zero: a correction moves it less.

    The first ``momentum_dim`` components are the momentum, of constant length. Near zero the gradient of its length
    vanishes, so nothing else keeps a correction of the energy from moving it by more than its own length. The factor of
    its components falls with its length, to zero at zero.
    """
    momentum, state = (jnp.linalg.norm(x[:n]) for n in (momentum_dim, system.body_dim))
    ratio = momentum / jnp.where(state > 0.0, state, 1.0)
    weight = jnp.where(ratio <= REST_RTOL, 0.0, jnp.minimum(ratio / SMALL_MOMENTUM_RATIO, 1.0))
    return jnp.where(jnp.arange(x.shape[0]) < momentum_dim, weight, 1.0)


def project_implicit_step(
    system: System, surface: Surface, invariants: Sequence[Energy], x, compensation, d, is_noisy: bool = False
) -> jax.Array:
    """Return the displacement d of an implicit step, which already obeys the laws, projected onto the surface.

    The functions ``invariants`` and a conserved energy stay constant. Other functions with a law keep the change that
    they have, unless noise drives the step: then they have no law. The result is NaN if the projection fails.
    """
    laws = [Law(C, 0.0) for C in invariants]
    for function, law in ((system.energy, system.energy_law), (system.entropy, system.entropy_law)):
        if law in LAW_SIGNS and function is not None and not (is_noisy and LAW_SIGNS[law]):
            laws.append(Law(function, LAW_SIGNS[law]))
    if laws:
        changes = [
            jnp.zeros(()) if law.sign == 0.0 else jnp.dot(CHANGE_GRADIENT(law.function, x, d, compensation), d)
            for law in laws
        ]
        start_gradients = [law.function.gradient(x + compensation) for law in laws]
        d, residual = project_onto_levels(system, laws, start_gradients, x, compensation, d, jnp.stack(changes))
    else:
        d, residual = surface.project_displacement(x, compensation, d)
    return jnp.where(residual <= PROJECTION_RTOL * jnp.linalg.norm(x), d, jnp.nan)


PROJECTION_RTOL = 1e-12
"""Largest distance of an implicit step from the surface and the levels, relative to the state."""
