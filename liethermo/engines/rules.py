"""When an iteration on the stage equations goes on, has converged, or is given up: one object, for every engine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from ..functions.gradients import EPS
from ..integrators.levels import MAX_MISS, MIN_MISS


@dataclass(frozen=True)
class Rules:
    """The solver's rules.

    Updates of the slopes k are measured against ``|x|/h + |k|``, their scale. The size of a vector is its largest
    component, or of large systems its root mean square: neither grows with their number, but of many components there
    is always one whose updates shrink late, and the largest is the one where rounding is.

    Attributes
    ----------
    many : int
        Components of a state above which they are many: for its size, and for the order that they are stored in. Among
        64 spins with noise one always shrinks so late that Newton's method was tried, for all of them.
    large : int
        Components of a state above which a system is large. Newton's equations are then solved by products with the
        Jacobian matrix, which is not formed.
    fixed_point, newton : int
        The most iterations of each kind.
    reuse : int
        Newton iterations with one factorisation before the Jacobian is taken afresh.
    halvings : int
        Times that a Newton step is halved until the equations are solved better than before, in the second attempt.
        Whole steps come first: where halved ones get stuck in a valley of the misfit, whole ones leap out of it.
    slow : float
        Contraction rate above which fixed-point iteration is given up for Newton's.
    stale : float
        Contraction rate above which Newton's method takes the Jacobian afresh.
    forcing : float
        Share of the misfit that such a solution may leave: each Newton iteration then gains two digits.
    kept, products : int
        Directions that it is kept orthogonal to, two vectors each; and the most products for one solution.
    shrinking : float
        An update above this fraction of the smallest so far has not shrunk: rounding makes the iterates cycle, and the
        cycle itself may still converge, by parts in 1e9.
    floor : float
        Update below which nothing is gained: even of one sign, errors of this size change the energy by 2e-15 in 1e6
        steps. (Stopping at one eps lets it drift by 4e-14.)
    plateau : float
        Largest update at which an iteration that has stopped shrinking counts as converged. Rounding in the vector
        field leaves a few eps; a conditioning of 100 is allowed for. Near a rest that lies at the origin the scale
        vanishes, but not what cancels in the slopes: there the misfit is measured against the size at which the slopes
        are rounded.
    corrected : float
        What an explicit step may miss of the levels that it ends on, relative to its length. A step that leaves more
        has not been corrected, even where that is less than rounding of the state: near an equilibrium, where gradients
        depend on each other, all that is left has one sign, and adds up.
    corrected_at_rest : float
        What it may miss relative to the state, if the step is short.
    vanished : float
        Size, of a state over a step, that is none: below it lie the numbers that have lost their digits.
    steered : float
        Energy error, relative to the size of H, from which the energy is steered back: a few roundings of H itself.
    constant : float
        Value of H, relative to what it varies by, from which its rounding is far above that of the state: see
        :data:`..functions.gradients.NOISY`.
    """

    many: int = 100
    large: int = 1_000
    fixed_point: int = 60
    newton: int = 60
    reuse: int = 4
    halvings: int = 8
    slow: float = 0.6
    stale: float = 0.3
    forcing: float = 1e-2
    kept: int = 8
    products: int = 200
    shrinking: float = 0.8
    floor: float = 1e-5 * EPS
    plateau: float = 1e3 * EPS
    corrected: float = MAX_MISS
    corrected_at_rest: float = MIN_MISS
    vanished: float = 1e-280
    steered: float = 4 * EPS
    constant: float = 100.0

    def size(self, components: int) -> Callable[[jax.Array], jax.Array]:
        """What the size of a vector, shape (n,) or (stages, n), is for so many components of a state."""
        return _root_mean_square if components > self.many else _largest


def _largest(v) -> jax.Array:
    return jnp.max(jnp.abs(v))


def _root_mean_square(v) -> jax.Array:
    return jnp.linalg.norm(v) / math.sqrt(v.size)


RULES = Rules()
"""Those of every run."""
