"""Explicit Runge-Kutta steps with nonnegative weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..errors import InputError
from ..functions.frames import vector_with_inner_products
from ..systems import System
from ..systems.clock import convert_work_error_to_displacement
from .base import register
from .explicit import ExplicitMethod, StepRow, UncorrectedStep
from .tableaus import LOBATTO_ORDERS, ErrorEstimate, ExplicitTableau, explicit_lobatto_tableau

START_SLOPE_ROW = StepRow.FIRST_METHOD_ROW
"""Row of ``k`` that holds the slope at the start of a step."""

END_SLOPE_ROW = StepRow.FIRST_METHOD_ROW + 1
"""Row of ``k`` that holds the slope of the last stage, at the end of a step."""

QUADRATURE_ERROR_ROW = StepRow.FIRST_METHOD_ROW + 2
"""Row of ``k`` that holds the estimate of the error of a quadrature, over h."""


def hermite_cubic_weights(theta, n_rows: int) -> np.ndarray:
    """Return the weights of the cubic through both ends of a step and their slopes; its error in the step is O(h^4).

    Parameters
    ----------
    theta : array, shape (...)
        Times since the start of the step, over its size.
    n_rows : int
        Number of rows of slopes, of which three have a weight.

    Returns
    -------
    array, shape (..., n_rows)
    """
    theta = np.asarray(theta, dtype=np.float64)
    row_weights = np.zeros((*theta.shape, n_rows))
    row_weights[..., StepRow.MEAN_SLOPE] = theta**2 * (3.0 - 2.0 * theta)
    row_weights[..., START_SLOPE_ROW] = theta * (1.0 - theta) ** 2
    row_weights[..., END_SLOPE_ROW] = theta**2 * (theta - 1.0)
    return row_weights


class MetriplecticRungeKutta(ExplicitMethod):
    """Explicit Runge-Kutta steps with both laws exact, of order 4, 6 or 8.

    ``X_i = x + h sum_{j<i} A_ij f(X_j)``, ``y = x + h sum_i b_i f(X_i)``, and x' the point near y where

        H(x') = H(x),    C(x') = C(x),    S(x') = S(x) + h sum_i b_i sigma(X_i),    sigma = grad S . K grad S >= 0,

    for every C that the system is known to conserve [:doc:`/explanation/exact_laws`]. The weights b of Lobatto's
    quadrature are nonnegative, so the entropy never falls. The quadrature has the order p of the method, 4, 6 or
    8, so x' - y is O(h^{p+1}). :class:`.explicit.ExplicitMethod` computes x'.

    If the energy falls and the entropy is conserved, as with double bracket dissipation, the energy falls by its own
    quadrature.

    A step costs 4, 7 or 11 evaluations of the field, and one to four corrections. A correction costs one change of
    each function. There are no stage equations to solve, but stiff systems need short steps. A step that is too long
    for its corrections ends the run with a status.

    On a manifold the scheme runs in the arrays around it. With ``retraction`` it runs in the chart ``v -> R(x, v)``
    around the state, a new chart in each step, with the same order and laws.

    Parameters
    ----------
    order : int
        4, 6 or 8.
    preserve : sequence of functions or energies
        Further first integrals to hold exactly. The system has to conserve them (checked when a run starts).
    retraction : str or manifolds.Retraction, optional
        On a manifold, the retraction whose charts are used, such as ``"exp"``; its base point is the start of a step.
    held : tuple of str
        Names of the functions of the system to keep. A run fills it in with those that the system conserves.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> method = lt.MetriplecticRungeKutta(order=4)
    >>> (
    ...     method.explicit,
    ...     lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1, method).audit().passed,
    ... )
    (True, True)
    """

    def __init__(
        self,
        order: int = 4,
        preserve: Sequence = (),
        retraction: str | mf.Retraction | None = None,
        held: tuple[str, ...] = (),
    ):
        if type(order) is not int or order not in LOBATTO_ORDERS:
            raise InputError(f"order must be 4, 6 or 8, got {order!r}")
        super().__init__(order, preserve, retraction, held)

    stages = QUADRATURE_ERROR_ROW + 1

    @property
    def evaluations_per_iteration(self) -> int:
        return len(self.tableau.b)

    @property
    def tableau(self) -> ExplicitTableau:
        return explicit_lobatto_tableau(self.order)

    def base_step(self, rates: Callable, skip_law_rates: bool, x, compensation, h) -> UncorrectedStep:
        t = self.tableau
        slopes, changes = self._stage_slopes_and_law_rates(rates, x, compensation, h)
        error, quadrature_error = (
            jnp.zeros_like(x) if estimate is None else jnp.asarray(estimate.weights) @ slopes
            for estimate in (t.error_estimate, t.quadrature_error_estimate)
        )
        rows = jnp.stack([slopes[0], slopes[-1], quadrature_error])
        return UncorrectedStep(h * (t.b @ slopes), h * (t.b @ changes), error, rows)

    def step_without_compensation(self, system: System, x, h) -> jax.Array:
        """Return the state after a step with one correction and no compensation, for derivatives by parameters.

        It misses the levels by the square of the error before the correction, O(h^{2p+2}): far below what a fit
        notices. Its program is short, and so are the programs of its derivatives.
        """
        laws, t = self._laws_to_hold(system), self.tableau

        @jax.checkpoint  # recomputing is faster than storing from step to step, and the program is shorter
        def field_and_law_rates(x) -> tuple[jax.Array, jax.Array]:
            """Return the field, and the rates of the laws by the whole field (the motion adds rounding alone)."""
            dH = system.energy.gradient(x)
            dS = jnp.zeros_like(x) if system.entropy is None else system.entropy.gradient(x)
            field = system.cache_tensors_at(x).field(
                x, dH, dS, tuple(L.gradient(x) for L in system.preserved_functions)
            )
            law_gradients = [
                dS if law.function is system.entropy else law.function.gradient(x) for law in laws if law.sign
            ]
            changes = [jnp.zeros(())] * (len(laws) - len(law_gradients)) + [
                jnp.dot(g, field) for g in law_gradients
            ]  # they come last
            return field, jnp.asarray(changes)

        slopes, changes = self._stage_slopes_and_law_rates(field_and_law_rates, x, 0.0, h)
        end = x + h * (t.b @ slopes)
        if not laws:
            return end
        end_points, functions = jnp.stack([x, end]), [law.function for law in laws]
        values, gradients = zip(*(jax.vmap(jax.value_and_grad(f.value))(end_points) for f in functions), strict=True)
        residuals = h * (t.b @ changes) - jnp.stack([end_value - start_value for start_value, end_value in values])
        return end + vector_with_inner_products(
            [system.raise_index(end, gradient) for _, gradient in gradients], residuals
        )

    def _stage_slopes_and_law_rates(self, rates: Callable, x, compensation, h) -> tuple[jax.Array, jax.Array]:
        """Return the field at the stages, shape (s, n), and the rates of the functions of the laws, shape (s, laws)."""
        t = self.tableau
        s = len(t.b)

        def evaluate_stage(slopes, index_and_weights):
            i, weights = index_and_weights
            slope, changes = rates(x + (compensation + h * (weights @ slopes)))
            return jax.lax.dynamic_update_index_in_dim(slopes, slope, i, 0), changes

        return jax.lax.scan(evaluate_stage, jnp.zeros((s, x.shape[0])), (np.arange(s), t.A))

    def weights(self, theta) -> np.ndarray:
        return hermite_cubic_weights(theta, self.stages)

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return the larger one of two error estimates, one for linear equations and one for quadratures."""
        t, step_length = self.tableau, h * jnp.max(jnp.abs(k[StepRow.MEAN_SLOPE]))

        def estimated_error(estimate: ErrorEstimate, row: int) -> jax.Array:
            error_size = h * jnp.max(
                jnp.abs(convert_work_error_to_displacement(system, x, k[row], k[StepRow.MEAN_SLOPE]))
            )
            ratio = error_size / jnp.where(step_length > 0.0, step_length, 1.0)
            return estimate.scale * step_length * ratio ** (self.order / estimate.order)

        error = estimated_error(t.error_estimate, StepRow.ERROR)
        if t.quadrature_error_estimate is None:
            return error
        return jnp.maximum(error, estimated_error(t.quadrature_error_estimate, QUADRATURE_ERROR_ROW))


register(*map(MetriplecticRungeKutta, LOBATTO_ORDERS))
