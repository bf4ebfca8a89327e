"""The levels of functions, and the surface, that a step has to end on; and how it is brought there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..functions.energy import Energy
from ..functions.frames import VANISHED, towards
from ..functions.gradients import DIFFERENCE_NOISE, EPS, SPREAD, Gonzalez
from ..functions.surface import Surface
from ..systems import System

CORRECTIONS = 4
"""Newton corrections of a step at most: a relative error of a twentieth is one of rounding after them."""

RELAXED_CORRECTIONS = 3
"""Further corrections of a step whose levels have no common point, which leave the growth of the entropy open."""

MAX_MISS = 64.0 * EPS
"""What a corrected step may miss of its levels, relative to its length."""

MIN_MISS = 0.01 * EPS
"""What it may miss relative to the state: the step of a state at rest is rounding, of which no correction is known."""

MAX_RELAXED_MISS = 1e-6
"""What a step may miss of the levels that stay, relative to its length and before any correction, for these corrections
to be tried: a step that misses more is too long."""

NOISY = 1e-8
"""As :data:`..functions.gradients.NOISY`, for a step that is not iterated: noise in what a function changes by is no
more than its rounding, and does not add up, since the values at which one step ends are those that the next begins
with."""

SIMPSON = 4
"""Degree up to which his rule with gradients is exact."""

DIFFERENCE = 16.0 * EPS
"""What a change of a function may be off, relative to the size at which its values are rounded: a few roundings of
both."""

VANISHED_LENGTH = math.sqrt(VANISHED)

AT_REST = 8.0 * EPS
"""Size of ``Pi(x) dH``, relative to those of x and dH, that is rounding: no step along the leaf changes H there."""

ALONG = Gonzalez(NOISY, across=True)
"""The discrete gradient that gives the change of a function in a step."""


class Law(NamedTuple):
    """A function, and whether it is to fall, to stay or to rise: -1, 0 or 1."""

    function: Energy
    sign: float


LAWS = {"conserved": 0.0, "nondecreasing": 1.0, "nonincreasing": -1.0}


class Ended(NamedTuple):
    """A displacement, what it misses of the surface and the levels, lengths of directions, and what is to be added."""

    d: jax.Array
    left: jax.Array
    defect: jax.Array
    lengths: jax.Array
    correction: jax.Array


def corrected(
    system: System,
    laws: list[Law],
    starts: list,
    x,
    compensation,
    d,
    changes,
    corrections: int = CORRECTIONS,
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
    change, surface = ALONG, system.surface
    signs = jnp.asarray([law.sign for law in laws])
    functions, blocks = [law.function for law in laws], system.blocks

    def landed(s: Ended) -> tuple[jax.Array, jax.Array]:
        d = s.d + displacement(system, x + (compensation + s.d), s.correction, leaf)
        return (d, jnp.zeros(())) if surface is None else surface.reached(x, compensation, d)

    def along(f: Energy, d, first, last) -> jax.Array:
        """A discrete gradient: of a polynomial a mean of gradients, those at both ends among them."""
        mean = 0.5 * (first + last)
        if f.degree > SIMPSON:
            return change(f, x, d, compensation)
        return mean if f.is_quadratic else (mean + 2.0 * f.gradient(x + (compensation + 0.5 * d))) / 3.0

    def misses(d, ends) -> jax.Array:
        found = [along(f, d, *both) for f, *both in zip(functions, starts, ends, strict=True)]
        return changes - jnp.stack([jnp.dot(gradient, d) for gradient in found])

    def moved(s: Ended) -> tuple[Ended, list]:
        """With the correction that was found before, what is missed; and the gradients there."""
        d, left = landed(s)
        ends = [f.gradient(x + (compensation + d)) for f in functions]
        return s._replace(d=d, left=left, defect=misses(d, ends)), ends

    def without_amount(s: Ended) -> Ended:
        """What is missed where functions that rise or fall need not change by a given amount."""
        changed, rounding = changes - s.defect, DIFFERENCE_NOISE * s.lengths * jnp.linalg.norm(s.d)
        return s._replace(
            defect=jnp.where(signs == 0.0, s.defect, jnp.where(signs * changed >= -rounding, 0.0, -changed))
        )

    def aimed(s: Ended, ends, used=None) -> Ended:
        """The next correction, along the directions that are ``used``, and the lengths of all directions.

        These are numbers by which what is missed becomes a length as that of d: where parts of a state have units
        of their own, as entropies beside a momentum, those by which a function changes most in d; or by what the
        correction of another one leaves by rounding, as that of the energy in baths which take no heat.
        """
        end = x + (compensation + s.d)
        found = directions(system, end, ends, leaf)
        changing = [system.raised(end, v) for v in ends] if leaf else found
        if len(blocks) == 1:
            lengths = jnp.stack([jnp.linalg.norm(v) for v in changing])
        else:
            moved = jnp.linalg.norm(s.d)
            most = jnp.stack([sum(jnp.linalg.norm(v[b]) * jnp.linalg.norm(s.d[b]) for b in blocks) for v in changing])
            products = jnp.abs(jnp.stack(changing) @ jnp.stack(changing).T)
            squares = jnp.diagonal(products)
            shares = products / jnp.where(squares > VANISHED, squares, 1.0)  # of what rounds one in what rounds another
            lengths = (shares @ most) * (1.0 / jnp.where(moved > 0.0, moved, 1.0))
        if used is not None:
            found = [jnp.where(used[i], v, 0.0) for i, v in enumerate(found)]
        return s._replace(lengths=lengths, correction=correction(system, found, s.defect))

    def done(s: Ended) -> jax.Array:
        small = jnp.abs(s.defect) <= EPS * s.lengths * jnp.linalg.norm(s.d)
        return (s.left == 0.0) & (small | (s.lengths <= VANISHED_LENGTH)).all()

    def again(carry, number):
        """The next correction; those beyond the first few are relaxed, and the last is along conserved functions."""
        s, finished = carry
        relaxed, last = number >= corrections - 1, number >= corrections + RELAXED_CORRECTIONS - 2
        begin = number == corrections - 1
        finished = finished | jax.lax.cond(begin, lambda: ~is_near | is_corrected(s), lambda: jnp.asarray(False))

        def corrected_once() -> Ended:
            at = s._replace(d=jnp.where(begin, first[0], s.d), correction=jnp.where(begin, first[1], s.correction))
            at, ends = moved(at)
            at = at._replace(defect=jnp.where(relaxed, without_amount(at).defect, at.defect))
            used = (signs == 0.0) | ~relaxed | ((at.defect != 0.0) & ~last)
            return aimed(at, ends, used)

        s = jax.lax.cond(finished, lambda: s, corrected_once)
        return (s, finished | done(s)), None

    def missed_length(s: Ended, rounding) -> jax.Array:
        """What is missed beyond rounding, as a length, shape ()."""
        vanished, beyond = s.lengths <= VANISHED_LENGTH, jnp.maximum(jnp.abs(s.defect) - rounding, 0.0)
        return jnp.max(jnp.where(vanished, 0.0, beyond / jnp.where(vanished, 1.0, s.lengths)))

    def is_corrected(s: Ended) -> jax.Array:
        allowed = MAX_MISS * jnp.linalg.norm(s.d) + MIN_MISS * jnp.linalg.norm(x)
        return s.left + missed_length(s, rounding_of_values(s.d)) <= allowed

    def rounding_of_values(d) -> jax.Array:
        """What rounding of the values may make of what is missed, shape (laws,): nothing where they are not used.

        In a short step the change of a function is a quadrature of its gradient, whose rounding vanishes with d.
        """
        sizes = jnp.stack([sum((term.hidden(x) for term in f.terms), jnp.zeros(())) for f in functions])
        ends = [f.gradient(x + (compensation + d)) for f in functions]
        spreads = [jnp.linalg.norm(end - start) for end, start in zip(ends, starts, strict=True)]
        slopes = [jnp.linalg.norm(start) for start in starts]
        varies = jnp.stack(spreads) > SPREAD * jnp.stack(slopes)
        return jnp.where(varies | (jnp.linalg.norm(d) > SPREAD * jnp.linalg.norm(x)), DIFFERENCE * sizes, 0.0)

    none = jnp.zeros(len(laws))
    first = (jnp.zeros_like(d), -d) if leaf else (d, jnp.zeros_like(d))
    s = aimed(*moved(Ended(first[0], jnp.zeros(()), none, none, first[1])))
    is_near = missed_length(s, jnp.where(signs == 0.0, 0.0, jnp.inf)) <= MAX_RELAXED_MISS * jnp.linalg.norm(s.d)
    s, ends = moved(s)  # of a short step one correction is enough
    ended = done(s)

    conserved = sum(law.sign == 0.0 for law in laws)
    can_be_released = conserved < len(laws) and (conserved > 0 or surface is not None)
    number = corrections - 1 + (RELAXED_CORRECTIONS + 1 if can_be_released else 0)

    def further() -> tuple[Ended, jax.Array]:
        s_further, _ = jax.lax.scan(again, (aimed(s, ends), ended), jnp.arange(number))[0]
        return s_further, done(s_further)

    s, ended = jax.lax.cond(ended, lambda: (s, ended), further)
    rounding = jax.lax.cond(ended, lambda: jnp.zeros_like(s.defect), lambda: rounding_of_values(s.d))
    return s.d, s.left + missed_length(s, rounding)


def directions(system: System, x, gradients: Sequence[jax.Array], leaf: bool = False) -> list[jax.Array]:
    """Those in which corrections of functions with these gradients at x move a state: along the surface.

    With ``leaf`` they are those of the covectors that carry it along its leaf.
    """
    if leaf:
        gradients = [_along_leaf(system, x, gradient) for gradient in gradients]
    found, surface = [system.raised(x, gradient) for gradient in gradients], system.surface
    return found if surface is None else [surface.along(x, v) for v in found]


def _along_leaf(system: System, x, gradient) -> jax.Array:
    """``Pi(x) gradient``, shape (n,); zero where it is the rounding of zero, as at a state of rest on its leaf."""
    found, n = system.poisson.sharp(x, gradient), system.body_dim  # behind which a clock and work have other units
    at_rest = jnp.linalg.norm(found[:n]) <= AT_REST * jnp.linalg.norm(x[:n]) * jnp.linalg.norm(gradient[:n])
    return jnp.where(at_rest & (jnp.arange(found.size) < n), 0.0, found)


def correction(
    system: System,
    along: Sequence[jax.Array],
    changes: jax.Array,
    is_usable: Callable[[jax.Array], jax.Array] | None = None,
) -> jax.Array:
    """The vector in the span of these directions that changes their functions by so much, as far as it is usable."""
    return towards(along, changes, min(len(system.blocks), 2), is_usable)


def displacement(system: System, x, correction, leaf: bool = False) -> jax.Array:
    """What a correction displaces a state x by: ``dH . Pi K = -(Pi dH) . K`` has the sign of the covector K."""
    return system.poisson.carried(x, -correction) if leaf else correction


def ended(
    system: System, surface: Surface, held: Sequence[Energy], x, compensation, d, driven: bool = False
) -> jax.Array:
    """The displacement of an implicit step, which has changed all functions as it has to, brought to the surface.

    The functions ``held`` stay as they were, and so does an energy that is conserved; what else has a law changes by
    what it has changed by, if the step is not driven by noise, under which it has none. NaN where that is not found.
    """
    laws = [Law(C, 0.0) for C in held]
    for function, law in ((system.energy, system.energy_law), (system.entropy, system.entropy_law)):
        if law in LAWS and function is not None and not (driven and LAWS[law]):
            laws.append(Law(function, LAWS[law]))
    if laws:
        changes = [
            jnp.zeros(()) if law.sign == 0.0 else jnp.dot(ALONG(law.function, x, d, compensation), d) for law in laws
        ]
        starts = [law.function.gradient(x + compensation) for law in laws]
        d, defect = corrected(system, laws, starts, x, compensation, d, jnp.stack(changes))
    else:
        d, defect = surface.reached(x, compensation, d)
    return jnp.where(defect <= UNREACHED * jnp.linalg.norm(x), d, jnp.nan)


UNREACHED = 1e-12
"""What a step may miss of the surface and the levels, relative to the state."""
