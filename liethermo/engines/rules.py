"""When an iteration on the stage equations goes on, has converged, or is given up: one object, for every engine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from ..functions.gradients import EPS
from ..integrators.levels import LEVEL_RTOL_OF_STATE, LEVEL_RTOL_OF_STEP


@dataclass(frozen=True)
class SolverOptions:
    """The solver's rules.

    Updates of the slopes k are measured against ``|x|/h + |k|``, their scale. The size of a vector is its largest
    component, or of large systems its root mean square: neither grows with their number, but of many components there
    is always one whose updates shrink late, and the largest is the one where rounding is.

    Attributes
    ----------
    rms_norm_dim : int
        Components of a state above which they are many: for its size, and for the order that they are stored in. Among
        64 spins with noise one always shrinks so late that Newton's method was tried, for all of them.
    matrix_free_dim : int
        Components of a state above which a system is large. Newton's equations are then solved by products with the
        Jacobian matrix, which is not formed.
    max_fixed_point_iterations, max_newton_iterations : int
        The most iterations of each kind.
    max_jacobian_reuse : int
        Newton iterations with one factorisation before the Jacobian is taken afresh.
    max_newton_halvings : int
        Times that a Newton step is halved until the equations are solved better than before, in the second attempt.
        Whole steps come first: where halved ones get stuck in a valley of the misfit, whole ones leap out of it.
    fixed_point_contraction_limit : float
        Contraction rate above which fixed-point iteration is given up for Newton's.
    jacobian_contraction_limit : float
        Contraction rate above which Newton's method takes the Jacobian afresh.
    krylov_forcing_term : float
        Share of the misfit that such a solution may leave: each Newton iteration then gains two digits.
    krylov_basis_size, max_krylov_products : int
        Directions that it is kept orthogonal to, two vectors each; and the most products for one solution.
    stall_ratio : float
        An update above this fraction of the smallest so far has not shrunk: rounding makes the iterates cycle, and the
        cycle itself may still converge, by parts in 1e9.
    update_floor : float
        Update below which nothing is gained: even of one sign, errors of this size change the energy by 2e-15 in 1e6
        steps. (Stopping at one eps lets it drift by 4e-14.)
    plateau_rtol : float
        Largest update at which an iteration that has stopped shrinking counts as converged. Rounding in the vector
        field leaves a few eps; a conditioning of 100 is allowed for. Near a rest that lies at the origin the scale
        vanishes, but not what cancels in the slopes: there the misfit is measured against the size at which the slopes
        are rounded.
    projection_rtol : float
        What an explicit step may miss of the levels that it ends on, relative to its length. A step that leaves more
        has not been corrected, even where that is less than rounding of the state: near an equilibrium, where gradients
        depend on each other, all that is left has one sign, and adds up.
    projection_state_rtol : float
        What it may miss relative to the state, if the step is short.
    tiny : float
        Size, of a state over a step, that is none: below it lie the numbers that have lost their digits.
    drift_threshold : float
        Energy error, relative to the size of H, from which the energy is steered back: a few roundings of H itself.
    large_offset_ratio : float
        Value of H, relative to what it varies by, from which its rounding is far above that of the state: see
        :data:`..functions.gradients.NOISY`.
    """

    rms_norm_dim: int = 100
    matrix_free_dim: int = 1_000
    max_fixed_point_iterations: int = 60
    max_newton_iterations: int = 60
    max_jacobian_reuse: int = 4
    max_newton_halvings: int = 8
    fixed_point_contraction_limit: float = 0.6
    jacobian_contraction_limit: float = 0.3
    krylov_forcing_term: float = 1e-2
    krylov_basis_size: int = 8
    max_krylov_products: int = 200
    stall_ratio: float = 0.8
    update_floor: float = 1e-5 * EPS
    plateau_rtol: float = 1e3 * EPS
    projection_rtol: float = LEVEL_RTOL_OF_STEP
    projection_state_rtol: float = LEVEL_RTOL_OF_STATE
    tiny: float = 1e-280
    drift_threshold: float = 4 * EPS
    large_offset_ratio: float = 100.0

    def norm_for_dim(self, components: int) -> Callable[[jax.Array], jax.Array]:
        """What the size of a vector, shape (n,) or (stages, n), is for so many components of a state."""
        return _rms_norm if components > self.rms_norm_dim else _max_norm


def _max_norm(v) -> jax.Array:
    return jnp.max(jnp.abs(v))


def _rms_norm(v) -> jax.Array:
    return jnp.linalg.norm(v) / math.sqrt(v.size)


DEFAULT_OPTIONS = SolverOptions()
"""Those of every run."""
