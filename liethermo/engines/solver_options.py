"""Options of the nonlinear solver: when an iteration continues, has converged, or is given up."""

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
    """Limits and tolerances of the solvers of the stage equations, the same for every engine.

    Updates of the slopes k are measured relative to ``|x|/h + |k|``. The norm is the maximum norm, or for systems of
    many components the root mean square. Neither grows with the dimension, but the largest component is the one where
    rounding shows, while among many components there is always one whose updates shrink late.

    Attributes
    ----------
    rms_norm_dim : int
        Dimension above which the norm is the root mean square and components are reordered for speed. Among 64 spins
        with noise one always converges so late that Newton's method was started, for all of them.
    matrix_free_dim : int
        Dimension above which Newton's equations are solved by Jacobian-vector products, without the Jacobian matrix.
    max_fixed_point_iterations, max_newton_iterations : int
        Largest number of iterations of each kind.
    max_jacobian_reuse : int
        Number of Newton iterations with one factorisation before the Jacobian is computed again.
    max_newton_halvings : int
        Number of times that a Newton step is halved until the residual decreases, in the second attempt. The first
        attempt takes full steps: damped ones can get stuck in a valley of the residual that full ones leave.
    fixed_point_contraction_limit : float
        Contraction rate above which fixed-point iteration is given up for Newton's method.
    jacobian_contraction_limit : float
        Contraction rate above which Newton's method computes the Jacobian again.
    krylov_forcing_term : float
        Relative residual of a Krylov solution: each Newton iteration then gains two digits.
    krylov_basis_size, max_krylov_products : int
        Number of directions to which a new one is made orthogonal (two vectors each); largest number of products.
    stall_ratio : float
        An update above this fraction of the smallest one so far has not shrunk: rounding makes the iterates cycle, and
        the cycle itself may still converge, by parts in 1e9.
    update_floor : float
        Relative update below which iterating further gains nothing: even of one sign, errors of this size change the
        energy by 2e-15 in 1e6 steps. (Stopping at one eps lets it drift by 4e-14.)
    plateau_rtol : float
        Largest relative update at which a stalled iteration counts as converged. Rounding in the vector field leaves a
        few eps; a condition number of 100 is allowed for. Near an equilibrium at the origin ``|x|/h + |k|`` vanishes,
        but not the terms that cancel in k: there the residual is compared with the rounding scale of the slopes.
    rounding_rtol, min_contraction : float
        A fixed-point iteration that stalls has converged if its update, relative to the state, is at most the first, or
        if its updates have shrunk by the second. Otherwise Newton's method decides.
    projection_rtol : float
        Largest constraint residual of an explicit step, relative to its length. A step with a larger one has not been
        projected, even if the residual is below the rounding of the state: near an equilibrium, where gradients are
        linearly dependent, all residuals have one sign and add up.
    projection_state_rtol : float
        Largest constraint residual of a short explicit step, relative to the state.
    tiny : float
        Slope norm below which a state counts as zero, because smaller numbers have lost digits.
    drift_threshold : float
        Energy error, relative to the magnitude of H, above which it is corrected: a few roundings of H itself.
    large_offset_ratio : float
        Ratio of H to its variation above which the rounding of H far exceeds that of the state: see
        :data:`..functions.gradients.MAX_DIFFERENCE_NOISE`.
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
    rounding_rtol: float = 16.0 * EPS
    min_contraction: float = 1e-4
    projection_rtol: float = LEVEL_RTOL_OF_STEP
    projection_state_rtol: float = LEVEL_RTOL_OF_STATE
    tiny: float = 1e-280
    drift_threshold: float = 4 * EPS
    large_offset_ratio: float = 100.0

    def norm_for_dim(self, dim: int) -> Callable[[jax.Array], jax.Array]:
        """Return the function that measures slopes of systems of dimension ``dim``: maximum or root mean square."""
        return _rms_norm if dim > self.rms_norm_dim else _max_norm


def _max_norm(v) -> jax.Array:
    """Return the largest absolute value of the entries."""
    return jnp.max(jnp.abs(v))


def _rms_norm(v) -> jax.Array:
    """Return the root mean square of all entries."""
    return jnp.linalg.norm(v) / math.sqrt(v.size)


DEFAULT_OPTIONS = SolverOptions()
"""Default solver options, used by every run."""
