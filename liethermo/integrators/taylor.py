"""Taylor steps: explicit, of any order, with a polynomial between the states."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..errors import InputError
from ..systems import System
from ..systems.clock import convert_work_error_to_displacement
from ..systems.transport import has_generator
from ..tracing.taylor import TaylorSeriesError, check_has_taylor_series, solution_taylor_coefficients
from .base import OneStepMethod, register
from .charts import resolve_retraction
from .explicit import ExplicitMethod, StepRow, UncorrectedStep
from .tableaus import lobatto_nodes_and_weights

MIN_ORDER = 2
"""Lowest order of a Taylor method."""

MAX_ORDER = 24
"""Highest order of a Taylor method: in double precision a higher one brings nothing."""


DEFAULT_RTOL = 1e-10
"""Relative tolerance that determines the order if none is given."""


def order_for_tolerance(tolerance: float | None) -> int:
    """Return the order of a Taylor method for a relative tolerance, by default DEFAULT_RTOL [Jorba & Zou 2005]."""
    order = math.ceil(1.0 - 0.5 * math.log(DEFAULT_RTOL if tolerance is None else tolerance))
    return min(max(MIN_ORDER, order), MAX_ORDER)


class MetriplecticTaylor(ExplicitMethod):
    """Taylor steps with both laws exact, explicit, of any order from 2 to 24.

    ``X(s) = x + c_1 s + ... + c_p s^p``, the Taylor polynomial of the solution over the step, and x' near X(1) where

        H(x') = H(x),    C(x') = C(x),    S(x') = S(x) + h sum_i b_i sigma(X(s_i)),    sigma = grad S . K grad S >= 0,

    for every C that the system is known to conserve [:doc:`/explanation/exact_laws`]. The s_i and b_i are those of
    Lobatto's quadrature, with ``p / 2 + 1`` nodes. It has order p, and its weights are positive.
    :class:`.explicit.ExplicitMethod` computes x'.

    The coefficients follow from the recurrences of Taylor arithmetic [Hairer, Nørsett & Wanner 1993, I.8], which the
    library derives from the functions of the system: see :mod:`liethermo.tracing.taylor`. All functions have to be
    smooth. A choice by ``jnp.where`` or ``lax.cond`` is made at the start of each step.

    A step costs about ``p^2 / 2`` times the products of the field, ``p / 2`` evaluations of the entropy production, and
    a few corrections. Steps are long. The method is for accuracies of 1e-8 and better.

    Parameters
    ----------
    order : int or None
        From 2 to 24. None means the order ``1 - log(rtol) / 2`` for the tolerance of adaptive steps [Jorba & Zou 2005],
        and 13, the order for 1e-10, without a tolerance.
    preserve, retraction, held
        As of :class:`MetriplecticRungeKutta`.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> run = lt.integrate(
    ...     body, [0.1, 0.2, 1.0], (0.0, 100.0), lt.Adaptive(1e-12), lt.MetriplecticTaylor()
    ... )
    >>> run.audit().passed, run.stats.steps < 300
    (True, True)
    """

    def __init__(
        self,
        order: int | None = None,
        preserve: Sequence = (),
        retraction: str | mf.Retraction | None = None,
        held: tuple[str, ...] = (),
    ):
        if order is not None and (type(order) is not int or not MIN_ORDER <= order <= MAX_ORDER):
            raise InputError(f"order must be an integer from {MIN_ORDER} to {MAX_ORDER} or None, got {order!r}")
        super().__init__(order, preserve, retraction, held)

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        if self.number is not None:
            return super().on(system)
        return type(self)(order_for_tolerance(tolerance), self.functions, self.retraction, self.held).on(system)

    @property
    def order(self) -> int:
        return order_for_tolerance(None) if self.number is None else self.number

    @property
    def stages(self) -> int:
        return StepRow.FIRST_METHOD_ROW + self.order

    @property
    def evaluations_per_iteration(self) -> int:
        """Multiplications in a product of two series, p (p + 1) / 2, plus evaluations of the entropy production."""
        return self.order * (self.order + 1) // 2 + len(self._lobatto_rule[0])

    @property
    def _lobatto_rule(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on [0, 1] of the Lobatto quadrature of the order of the method."""
        return lobatto_nodes_and_weights((self.order + 1) // 2 + 1)

    def check(self, system: System) -> None:
        """Raise InputError unless there is a law to hold, ``preserve`` is conserved, and all functions are smooth."""
        super().check(system)
        x = jnp.asarray(system.samples(1)[0])
        functions = {"the energy": system.energy.value, "the vector field": system.vector_field}
        if system.entropy is not None and system.total_dissipation.terms and not has_generator(system):
            functions["the entropy"] = system.entropy.value
        for name, function in functions.items():
            try:
                check_has_taylor_series(function, x)
            except TaylorSeriesError as error:
                raise error.add_context(
                    f"{self} needs Taylor series, and of {name} ", "take lt.MetriplecticRungeKutta"
                ) from None
        if system.space is not None and self.retraction is not None:
            self._check_chart_has_taylor_series(system.space)

    def _check_chart_has_taylor_series(self, space: mf.Space) -> None:
        """Raise TaylorSeriesError unless the map from coordinates of the chart to states has a Taylor series."""
        assert self.retraction is not None
        chart = resolve_retraction(space, self.retraction).chart
        z = space.random(0)

        def state_from_coordinates(c):
            return space.to_vector(chart._point(z, space._from_coordinates(z, c)))

        try:
            check_has_taylor_series(state_from_coordinates, jnp.zeros(space.dim))
        except TaylorSeriesError as error:
            raise error.add_context(
                f"{self} needs Taylor series, and of {chart} ",
                "leave out retraction=, or take lt.MetriplecticGauss or lt.MetriplecticRungeKutta",
            ) from None

    def base_step(self, rates: Callable, skip_law_rates: bool, x, compensation, h) -> UncorrectedStep:
        nodes, b = self._lobatto_rule
        powers = np.arange(1.0, self.order + 1.0)
        c = solution_taylor_coefficients(
            lambda y: rates(y)[0], x, h, self.order
        )  # compensation is left out: in a chart x is its centre, exactly
        points = jnp.concatenate([x[None], x + (compensation + nodes[1:, None] ** powers @ c)])
        fields, law_rates = jax.vmap(rates)(points[-1:] if skip_law_rates else points)
        residual, changes = fields[-1] - (powers @ c) / h, law_rates[-1] if skip_law_rates else h * (b @ law_rates)
        return UncorrectedStep(jnp.sum(c, axis=0), changes, residual / (self.order + 1), c / h)

    def weights(self, theta) -> np.ndarray:
        """Return the weights of the polynomial and of its correction, which grows as the first neglected term."""
        theta = np.asarray(theta, dtype=np.float64)[..., None]
        next_power = theta ** (self.order + 1)
        row_weights = np.zeros((*theta.shape[:-1], self.stages))
        row_weights[..., StepRow.FIRST_METHOD_ROW :] = theta ** np.arange(1, self.order + 1) - next_power
        row_weights[..., StepRow.MEAN_SLOPE] = next_power[..., 0]
        return row_weights

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return an estimate of the error, shape (), from the residual of X: ``h |f(X(1)) - X'(1)| / (p + 1)``.

        At the end of a step the first neglected term of X' is p + 1 times that of X, so the ratio of estimate and
        error tends to 1 with h. The residual is also large if the value of a condition (``jnp.where``) has changed
        inside the step.
        """
        return h * jnp.max(
            jnp.abs(convert_work_error_to_displacement(system, x, k[StepRow.ERROR], k[StepRow.MEAN_SLOPE]))
        )


register(*map(MetriplecticTaylor, (6, 12, 20)))
