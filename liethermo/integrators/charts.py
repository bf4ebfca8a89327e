"""Methods of vector spaces on manifolds: each step runs in the chart of a retraction around another point."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf

from ..errors import InputError
from ..functions.gradients import EPS
from ..systems import ChartSystem, System
from .base import MethodWrapper, OneStepMethod, collocation_error_estimate, pullback_method


class InCharts(MethodWrapper):
    """A method on a manifold, run step by step in coordinates around a point z.

    The step from x to x' is a step in R^dim, from the coordinates of x to those of x'. So the laws that the method
    preserves hold exactly on the manifold, and x' is on it to rounding, without a projection. The order is that of the
    method, since a change of coordinates does not alter it.

    For a retraction with its base point at the start of the step, z = x. For a retraction with its base point in the
    middle, z is the midpoint of x and x' [BFM 4.8]; a method of one stage evaluates Pi and K there. With the discrete
    gradient in the chart around z, equations (4.9)-(4.10), this is the integrator of BFM §4.4.

    :func:`liethermo.integrate` makes it from a method with a retraction. Slopes are tangent vectors at x, as vectors of
    shape (n,).

    Attributes
    ----------
    retraction : manifolds.Retraction
    """

    retraction: mf.Retraction = eqx.field(static=True)

    @property
    def preserves(self) -> frozenset[str]:
        return self.method.preserves & {"energy", "entropy_law"}

    def preserves_function(self, system: System, name: str) -> bool:
        return (
            self.method.preserves_function(system, name) if self.explicit else super().preserves_function(system, name)
        )

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        step = self._make_chart_step(system, x, compensation, h, k)
        return step.push_forward(step.method.slopes(step.system, step.start, step.compensation, h, step.k))

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        """Return the point at the end of the step; NaN if the step is longer than the domain of the retraction."""
        step = self._make_chart_step(system, x, compensation, h, k)
        end = step.start + (step.compensation + self.method.increment(h, step.k))
        is_in_domain = self._domain_fraction(system, x, self.increment(h, k)) < 1.0
        x_new = jnp.where(is_in_domain, self.retraction.space.to_vector(step.system.coordinates.point(end)), jnp.nan)
        return x_new, jnp.zeros_like(x_new)

    def displace(self, system: System, x, v) -> jax.Array:
        return self.retraction.space.to_vector(self.retraction.chart._point(system.points(x), system.points(v)))

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        """Return the derivative of the residual by one-sided differences, with digits enough for Newton's method.

        The second derivatives of a chart may not exist. Where they do, compiling them would take most of the time, and
        they are hardly ever needed.
        """
        scales, residual = system.slope_scales(k), self.slopes(system, x, compensation, h, k) - k

        def difference_quotient(direction):
            step_size = EPS**0.5 / jnp.max(jnp.abs(direction) / scales)
            k_shifted = k + step_size * direction
            return (self.slopes(system, x, compensation, h, k_shifted) - k_shifted - residual) / step_size

        return difference_quotient

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        return (
            self.method.error(system, x, compensation, h, k)
            if self.explicit
            else collocation_error_estimate(system, x, compensation, h, k)
        )

    def why_step_failed(self, system: System, x, k, h) -> str:
        x, k = jnp.asarray(x), jnp.asarray(k)
        domain_fraction = float(self._domain_fraction(system, x, self.increment(h, k)))
        if not domain_fraction >= 0.5:
            return self.method.why_step_failed(system, x, k, h)
        radius = self.retraction.space.injectivity_radius(system.points(x))
        return (
            f"the last step was {domain_fraction:.3g} times as long as the domain of {self.retraction} allows "
            f"(injectivity radius {radius:.6g}). Try a step of {0.25 * h / domain_fraction:.2g}"
        )

    def _domain_fraction(self, system: System, x, v) -> jax.Array:
        """Return the length of the displacement v from x, as a fraction of the domain of the retraction."""
        point = system.points(x)
        return self.retraction._reach(point, self.retraction.space._project_tangent(point, system.points(v)))

    def _make_chart_step(self, system: System, x, compensation, h, k) -> _ChartStep:
        """Return the data of the step in the chart around its base point: local system, method, start and slopes."""
        chart, space, start, x = self.retraction.chart, self.retraction.space, x, system.points(x)
        vectors = space.from_vector(k)
        coordinates_x = mf.coordinates_around(chart, x)
        k_chart = jax.vmap(coordinates_x.components)(vectors)
        compensation = coordinates_x.components(system.points(compensation))
        if isinstance(self.retraction, mf.Chart):
            local = ChartSystem(system, coordinates_x, start=start)

            def push_forward(slopes):
                return space.to_vector(jax.vmap(coordinates_x.vector)(slopes))

            return _ChartStep(
                local,
                pullback_method(self.method, local),
                jnp.zeros_like(compensation),
                compensation,
                k_chart,
                push_forward,
            )

        half = 0.5 * coordinates_x.vector(self.method.increment(h, k_chart))
        z = chart._point(x, half)
        half_at_z = chart._carry(x, half, half)
        coordinates_z = mf.coordinates_around(chart, z)

        def transport_components_to_z(components_at_x):  # by the chart, from x to its base point z
            return coordinates_z.components(chart._carry(x, half, coordinates_x.vector(components_at_x)))

        def slope_at_x(slope_components_at_z):
            return space.to_vector(chart._carry(z, -half_at_z, coordinates_z.vector(slope_components_at_z)))

        local = ChartSystem(system, coordinates_z, coordinates_z.centre() if self.stages == 1 else None, start)
        k_chart = jax.vmap(transport_components_to_z)(k_chart)
        start_at_z = -0.5 * self.method.increment(h, k_chart)
        return _ChartStep(
            local,
            pullback_method(self.method, local),
            start_at_z,
            transport_components_to_z(compensation),
            k_chart,
            jax.vmap(slope_at_x),
        )

    def predict(self, k, previous_k) -> jax.Array:
        if self.explicit or self.stages == 1:
            return self.method.predict(k, previous_k)
        return 2.0 * k - previous_k  # the extrapolation of the method does not apply: the chart has changed

    def __str__(self) -> str:
        return f"{self.method} with {self.retraction}"


class _ChartStep(NamedTuple):
    """A step in coordinates: the local system and method, the start, the slopes, and the map of slopes back to x."""

    system: ChartSystem
    method: OneStepMethod
    start: jax.Array
    compensation: jax.Array
    k: jax.Array
    push_forward: Callable


def wrap_in_charts(
    method: OneStepMethod, system: System, retraction: str | mf.Retraction | None, default_retraction_name: str
) -> OneStepMethod:
    """Return the method as it runs on the system: itself on R^n, wrapped in charts on a manifold.

    Raises
    ------
    InputError
        If the retraction does not belong to the space of the system.
    SpaceError
        If the space lacks a map that the retraction needs.
    """
    if system.space is None:
        if retraction is not None:
            raise InputError("retraction= needs a system on a manifold, and this one is on R^n. Leave retraction= out")
        return method
    if retraction is None:
        retraction = default_retraction_name if system.space.has_geodesics else "projection"
    return InCharts(method, resolve_retraction(system.space, retraction))


def resolve_retraction(space: mf.Space, name_or_retraction: str | mf.Retraction) -> mf.Retraction:
    """Return the retraction of the space with this name, or the given one; raise InputError if it has another space."""
    retraction = mf.retraction(space, name_or_retraction) if isinstance(name_or_retraction, str) else name_or_retraction
    if retraction.space != space:
        raise InputError(f"the retraction belongs to {retraction.space.name}, but the system is on {space.name}")
    return retraction
