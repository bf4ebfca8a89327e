"""The levels of functions, and the surface, that a step has to end on; and how it is brought there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..functions.energy import Energy
from ..functions.frames import MIN_SQUARED_NORM, vector_with_products
from ..functions.gradients import DIFFERENCE_NOISE, EPS, MIN_GRADIENT_VARIATION, Gonzalez
from ..functions.surface import Surface
from ..systems import System

MAX_PROJECTION_ITERATIONS = 4
"""Newton corrections of a step at most: a relative error of a twentieth is one of rounding after them."""

MAX_RELAXED_ITERATIONS = 3
"""Further corrections of a step whose levels have no common point, which leave the growth of the entropy open."""

LEVEL_RTOL_OF_STEP = 64.0 * EPS
"""What a corrected step may miss of its levels, relative to its length."""

LEVEL_RTOL_OF_STATE = 0.01 * EPS
"""What it may miss relative to the state: the step of a state at rest is rounding, of which no correction is known."""

MAX_RELAXED_RESIDUAL = 1e-6
"""What a step may miss of the levels that stay, relative to its length and before any correction, for these corrections
to be tried: a step that misses more is too long."""

GRADIENT_NOISE_RTOL = 1e-8
"""As :data:`..functions.gradients.NOISY`, for a step that is not iterated: noise in what a function changes by is no
more than its rounding, and does not add up, since the values at which one step ends are those that the next begins
with."""

SIMPSON_DEGREE = 4
"""Degree up to which his rule with gradients is exact."""

VALUE_DIFFERENCE_RTOL = 16.0 * EPS
"""What a change of a function may be off, relative to the size at which its values are rounded: a few roundings of
both."""

VANISHED_LENGTH = math.sqrt(MIN_SQUARED_NORM)

REST_RTOL = 8.0 * EPS
"""Size of ``Pi(x) dH``, relative to those of x and dH, that is rounding: no step along the leaf changes H there."""

CHANGE_GRADIENT = Gonzalez(GRADIENT_NOISE_RTOL, across=True)
"""The discrete gradient that gives the change of a function in a step."""


class Law(NamedTuple):
    """A function, and whether it is to fall, to stay or to rise: -1, 0 or 1."""

    function: Energy
    sign: float


LAW_SIGNS = {"conserved": 0.0, "nondecreasing": 1.0, "nonincreasing": -1.0}


class ProjectionState(NamedTuple):
    """A displacement, what it misses of the surface and the levels, lengths of directions, and what is to be added."""

    d: jax.Array
    surface_residual: jax.Array
    level_residual: jax.Array
    direction_lengths: jax.Array
    correction: jax.Array


def project_onto_levels(
    system: System,
    laws: list[Law],
    starts: list,
    x,
    compensation,
    d,
    changes,
    corrections: int = MAX_PROJECTION_ITERATIONS,
    leaf: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """The displacement nearest to d that changes the functions as it has to, and what it misses, as a length.

    ``starts`` are the gradients of the functions at x + compensation. With ``leaf`` the displacement is along the
    symplectic leaf, and d is the covector that carries the state.

    Near an equilibrium the entropy is almost the largest that the conserved functions allow, so the levels may have no
    common point where a step overestimates the production. Corrections along gradients that depend on each other would
    then wander, and miss all levels by rounding of one sign. So the amount by which a function is to rise or to fall is
    left open there: it changes as the others make it, or not at all where that would have the wrong sign.
    """
    change, surface = CHANGE_GRADIENT, system.surface
    signs = jnp.asarray([law.sign for law in laws])
    functions, blocks = [law.function for law in laws], system.state_blocks

    def corrected_displacement(s: ProjectionState) -> tuple[jax.Array, jax.Array]:
        d = s.d + correction_displacement(system, x + (compensation + s.d), s.correction, leaf)
        return (d, jnp.zeros(())) if surface is None else surface.project_displacement(x, compensation, d)

    def mean_gradient(f: Energy, d, first, last) -> jax.Array:
        """A discrete gradient: of a polynomial a mean of gradients, those at both ends among them."""
        mean = 0.5 * (first + last)
        if f.degree > SIMPSON_DEGREE:
            return change(f, x, d, compensation)
        return mean if f.is_quadratic else (mean + 2.0 * f.gradient(x + (compensation + 0.5 * d))) / 3.0

    def level_residuals(d, ends) -> jax.Array:
        found = [mean_gradient(f, d, *both) for f, *both in zip(functions, starts, ends, strict=True)]
        return changes - jnp.stack([jnp.dot(gradient, d) for gradient in found])

    def apply_correction(s: ProjectionState) -> tuple[ProjectionState, list]:
        """With the correction that was found before, what is missed; and the gradients there."""
        d, left = corrected_displacement(s)
        ends = [f.gradient(x + (compensation + d)) for f in functions]
        return s._replace(d=d, surface_residual=left, level_residual=level_residuals(d, ends)), ends

    def release_entropy_change(s: ProjectionState) -> ProjectionState:
        """What is missed where functions that rise or fall need not change by a given amount."""
        changed, rounding = changes - s.level_residual, DIFFERENCE_NOISE * s.direction_lengths * jnp.linalg.norm(s.d)
        return s._replace(
            level_residual=jnp.where(
                signs == 0.0, s.level_residual, jnp.where(signs * changed >= -rounding, 0.0, -changed)
            )
        )

    def with_next_correction(s: ProjectionState, ends, used=None) -> ProjectionState:
        """The next correction, along the directions that are ``used``, and the lengths of all directions.

        These are numbers by which what is missed becomes a length as that of d: where parts of a state have units
        of their own, as entropies beside a momentum, those by which a function changes most in d; or by what the
        correction of another one leaves by rounding, as that of the energy in baths which take no heat.
        """
        end = x + (compensation + s.d)
        found = correction_directions(system, end, ends, leaf)
        changing = [system.raise_index(end, v) for v in ends] if leaf else found
        if len(blocks) == 1:
            lengths = jnp.stack([jnp.linalg.norm(v) for v in changing])
        else:
            moved = jnp.linalg.norm(s.d)
            most = jnp.stack([sum(jnp.linalg.norm(v[b]) * jnp.linalg.norm(s.d[b]) for b in blocks) for v in changing])
            products = jnp.abs(jnp.stack(changing) @ jnp.stack(changing).T)
            squares = jnp.diagonal(products)
            shares = products / jnp.where(
                squares > MIN_SQUARED_NORM, squares, 1.0
            )  # of what rounds one in what rounds another
            lengths = (shares @ most) * (1.0 / jnp.where(moved > 0.0, moved, 1.0))
        if used is not None:
            found = [jnp.where(used[i], v, 0.0) for i, v in enumerate(found)]
        return s._replace(direction_lengths=lengths, correction=level_correction(system, found, s.level_residual))

    def is_converged(s: ProjectionState) -> jax.Array:
        small = jnp.abs(s.level_residual) <= EPS * s.direction_lengths * jnp.linalg.norm(s.d)
        return (s.surface_residual == 0.0) & (small | (s.direction_lengths <= VANISHED_LENGTH)).all()

    def iterate(carry, number):
        """The next correction; those beyond the first few are relaxed, and the last is along conserved functions."""
        s, finished = carry
        relaxed, last = number >= corrections - 1, number >= corrections + MAX_RELAXED_ITERATIONS - 2
        begin = number == corrections - 1
        finished = finished | jax.lax.cond(begin, lambda: ~is_near | is_within_tolerance(s), lambda: jnp.asarray(False))

        def correct_once() -> ProjectionState:
            at = s._replace(d=jnp.where(begin, first[0], s.d), correction=jnp.where(begin, first[1], s.correction))
            at, ends = apply_correction(at)
            at = at._replace(
                level_residual=jnp.where(relaxed, release_entropy_change(at).level_residual, at.level_residual)
            )
            used = (signs == 0.0) | ~relaxed | ((at.level_residual != 0.0) & ~last)
            return with_next_correction(at, ends, used)

        s = jax.lax.cond(finished, lambda: s, correct_once)
        return (s, finished | is_converged(s)), None

    def residual_length(s: ProjectionState, rounding) -> jax.Array:
        """What is missed beyond rounding, as a length, shape ()."""
        vanished, beyond = (
            s.direction_lengths <= VANISHED_LENGTH,
            jnp.maximum(jnp.abs(s.level_residual) - rounding, 0.0),
        )
        return jnp.max(jnp.where(vanished, 0.0, beyond / jnp.where(vanished, 1.0, s.direction_lengths)))

    def is_within_tolerance(s: ProjectionState) -> jax.Array:
        allowed = LEVEL_RTOL_OF_STEP * jnp.linalg.norm(s.d) + LEVEL_RTOL_OF_STATE * jnp.linalg.norm(x)
        return s.surface_residual + residual_length(s, value_rounding(s.d)) <= allowed

    def value_rounding(d) -> jax.Array:
        """What rounding of the values may make of what is missed, shape (laws,): nothing where they are not used.

        In a short step the change of a function is a quadrature of its gradient, whose rounding vanishes with d.
        """
        sizes = jnp.stack(
            [sum((term.difference_rounding_scale(x) for term in f.terms), jnp.zeros(())) for f in functions]
        )
        ends = [f.gradient(x + (compensation + d)) for f in functions]
        spreads = [jnp.linalg.norm(end - start) for end, start in zip(ends, starts, strict=True)]
        slopes = [jnp.linalg.norm(start) for start in starts]
        varies = jnp.stack(spreads) > MIN_GRADIENT_VARIATION * jnp.stack(slopes)
        return jnp.where(
            varies | (jnp.linalg.norm(d) > MIN_GRADIENT_VARIATION * jnp.linalg.norm(x)),
            VALUE_DIFFERENCE_RTOL * sizes,
            0.0,
        )

    none = jnp.zeros(len(laws))
    first = (jnp.zeros_like(d), -d) if leaf else (d, jnp.zeros_like(d))
    s = with_next_correction(*apply_correction(ProjectionState(first[0], jnp.zeros(()), none, none, first[1])))
    is_near = residual_length(s, jnp.where(signs == 0.0, 0.0, jnp.inf)) <= MAX_RELAXED_RESIDUAL * jnp.linalg.norm(s.d)
    s, ends = apply_correction(s)  # of a short step one correction is enough
    ended = is_converged(s)

    conserved = sum(law.sign == 0.0 for law in laws)
    can_be_released = conserved < len(laws) and (conserved > 0 or surface is not None)
    number = corrections - 1 + (MAX_RELAXED_ITERATIONS + 1 if can_be_released else 0)

    def iterate_further() -> tuple[ProjectionState, jax.Array]:
        s_further, _ = jax.lax.scan(iterate, (with_next_correction(s, ends), ended), jnp.arange(number))[0]
        return s_further, is_converged(s_further)

    s, ended = jax.lax.cond(ended, lambda: (s, ended), iterate_further)
    rounding = jax.lax.cond(ended, lambda: jnp.zeros_like(s.level_residual), lambda: value_rounding(s.d))
    return s.d, s.surface_residual + residual_length(s, rounding)


def correction_directions(system: System, x, gradients: Sequence[jax.Array], leaf: bool = False) -> list[jax.Array]:
    """Those in which corrections of functions with these gradients at x move a state: along the surface.

    With ``leaf`` they are those of the covectors that carry it along its leaf.
    """
    if leaf:
        gradients = [_leaf_direction(system, x, gradient) for gradient in gradients]
    found, surface = [system.raise_index(x, gradient) for gradient in gradients], system.surface
    return found if surface is None else [surface.project_direction(x, v) for v in found]


def _leaf_direction(system: System, x, gradient) -> jax.Array:
    """``Pi(x) gradient``, shape (n,); zero where it is the rounding of zero, as at a state of rest on its leaf."""
    found, n = system.poisson.sharp(x, gradient), system.body_dim  # behind which a clock and work have other units
    at_rest = jnp.linalg.norm(found[:n]) <= REST_RTOL * jnp.linalg.norm(x[:n]) * jnp.linalg.norm(gradient[:n])
    return jnp.where(at_rest & (jnp.arange(found.size) < n), 0.0, found)


def level_correction(
    system: System,
    along: Sequence[jax.Array],
    changes: jax.Array,
    is_usable: Callable[[jax.Array], jax.Array] | None = None,
) -> jax.Array:
    """The vector in the span of these directions that changes their functions by so much, as far as it is usable."""
    return vector_with_products(along, changes, min(len(system.state_blocks), 2), is_usable)


def correction_displacement(system: System, x, correction, leaf: bool = False) -> jax.Array:
    """What a correction displaces a state x by: ``dH . Pi K = -(Pi dH) . K`` has the sign of the covector K."""
    return system.poisson.leaf_displacement(x, -correction) if leaf else correction


def project_implicit_step(
    system: System, surface: Surface, held: Sequence[Energy], x, compensation, d, driven: bool = False
) -> jax.Array:
    """The displacement of an implicit step, which has changed all functions as it has to, brought to the surface.

    The functions ``held`` stay as they were, and so does an energy that is conserved; what else has a law changes by
    what it has changed by, if the step is not driven by noise, under which it has none. NaN where that is not found.
    """
    laws = [Law(C, 0.0) for C in held]
    for function, law in ((system.energy, system.energy_law), (system.entropy, system.entropy_law)):
        if law in LAW_SIGNS and function is not None and not (driven and LAW_SIGNS[law]):
            laws.append(Law(function, LAW_SIGNS[law]))
    if laws:
        changes = [
            jnp.zeros(()) if law.sign == 0.0 else jnp.dot(CHANGE_GRADIENT(law.function, x, d, compensation), d)
            for law in laws
        ]
        starts = [law.function.gradient(x + compensation) for law in laws]
        d, defect = project_onto_levels(system, laws, starts, x, compensation, d, jnp.stack(changes))
    else:
        d, defect = surface.project_displacement(x, compensation, d)
    return jnp.where(defect <= PROJECTION_RTOL * jnp.linalg.norm(x), d, jnp.nan)


PROJECTION_RTOL = 1e-12
"""What a step may miss of the surface and the levels, relative to the state."""
