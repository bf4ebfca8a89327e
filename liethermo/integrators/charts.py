"""Methods of vector spaces on manifolds: in the chart of a retraction, around another point at every step."""

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
from .base import MethodWrapper, OneStepMethod, collocation_error, pullback_method


class InCharts(MethodWrapper):
    """A method as it runs on a manifold, step by step in coordinates around a point z: :class:`liethermo.ChartSystem`.

    The step from x to x' is one from R^dim to R^dim, from the coordinates of x to those of x'. So the laws that the
    method keeps hold on the manifold, exactly; and x' is a point of it to rounding, as charts give points: nothing is
    projected. The order is that of the method, as a change of coordinates does not alter it.

    With a retraction whose base point is at the start of the step, z = x. With one whose base point is
    in the middle, z is the midpoint of x and x' [BFM 4.8]; a method of one stage takes Pi and K there as they are, and
    with the discrete gradient in the chart around z, which is (4.9)-(4.10), this is the integrator of BFM §4.4.

    Made by :func:`liethermo.integrate` from a method with a retraction. Slopes are tangent vectors at x, as vectors of
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
        step = self._chart_step(system, x, compensation, h, k)
        return step.push_forward(step.method.slopes(step.system, step.start, step.compensation, h, step.k))

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        """The point at the end of the step; NaN where the step is longer than the domain of the retraction."""
        step = self._chart_step(system, x, compensation, h, k)
        end = step.start + (step.compensation + self.method.increment(h, step.k))
        inside = self._domain_fraction(system, x, self.increment(h, k)) < 1.0
        new = jnp.where(inside, self.retraction.space.to_vector(step.system.coordinates.point(end)), jnp.nan)
        return new, jnp.zeros_like(new)

    def displace(self, system: System, x, v) -> jax.Array:
        return self.retraction.space.to_vector(self.retraction.chart._point(system.points(x), system.points(v)))

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        """By one-sided differences, half of the digits, which is enough for Newton's method.

        The second derivatives of a chart may not exist, and where they do the compiler would spend most of its time on
        what is hardly ever needed.
        """
        sizes, misfit = system.component_scales(k), self.slopes(system, x, compensation, h, k) - k

        def difference_quotient(d):
            step = EPS**0.5 / jnp.max(jnp.abs(d) / sizes)
            k_there = k + step * d
            return (self.slopes(system, x, compensation, h, k_there) - k_there - misfit) / step

        return difference_quotient

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        return (
            self.method.error(system, x, compensation, h, k)
            if self.explicit
            else collocation_error(system, x, compensation, h, k)
        )

    def why_step_failed(self, system: System, x, k, h) -> str:
        x, k = jnp.asarray(x), jnp.asarray(k)
        reach = float(self._domain_fraction(system, x, self.increment(h, k)))
        if not reach >= 0.5:
            return self.method.why_step_failed(system, x, k, h)
        radius = self.retraction.space.injectivity_radius(system.points(x))
        return (
            f"the last step was {reach:.3g} times as long as the domain of {self.retraction} allows (injectivity "
            f"radius {radius:.6g}), and none may be longer: try a step of {0.25 * h / reach:.2g}"
        )

    def _domain_fraction(self, system: System, x, v) -> jax.Array:
        """Length of a displacement from x relative to the domain of the retraction."""
        point = system.points(x)
        return self.retraction._reach(point, self.retraction.space._project_tangent(point, system.points(v)))

    def _chart_step(self, system: System, x, compensation, h, k) -> _ChartStep:
        """The step in coordinates around z."""
        chart, space, start, x = self.retraction.chart, self.retraction.space, x, system.points(x)
        vectors = space.from_vector(k)
        around = mf.coordinates_around(chart, x)
        own = jax.vmap(around.components)(vectors)
        compensation = around.components(system.points(compensation))
        if isinstance(self.retraction, mf.Chart):
            local = ChartSystem(system, around, start=start)

            def push_forward(slopes):
                return space.to_vector(jax.vmap(around.vector)(slopes))

            return _ChartStep(
                local,
                pullback_method(self.method, local),
                jnp.zeros_like(compensation),
                compensation,
                own,
                push_forward,
            )

        half = 0.5 * around.vector(self.method.increment(h, own))
        z = chart._point(x, half)
        carried = chart._carry(x, half, half)
        around_z = mf.coordinates_around(chart, z)

        def components_at_z(c):
            return around_z.components(chart._carry(x, half, around.vector(c)))

        def push_forward_from_z(c):
            return space.to_vector(chart._carry(z, -carried, around_z.vector(c)))

        local = ChartSystem(system, around_z, around_z.centre() if self.stages == 1 else None, start)
        own = jax.vmap(components_at_z)(own)
        begin = -0.5 * self.method.increment(h, own)
        return _ChartStep(
            local,
            pullback_method(self.method, local),
            begin,
            components_at_z(compensation),
            own,
            jax.vmap(push_forward_from_z),
        )

    def predict(self, k, before) -> jax.Array:
        if self.explicit or self.stages == 1:
            return self.method.predict(k, before)
        return 2.0 * k - before  # whatever the method's own: the chart has changed

    def __str__(self) -> str:
        return f"{self.method} with {self.retraction}"


class _ChartStep(NamedTuple):
    """A step in coordinates: the system there and the method, where it starts, the slopes, and the way back to x."""

    system: ChartSystem
    method: OneStepMethod
    start: jax.Array
    compensation: jax.Array
    k: jax.Array
    push_forward: Callable


def wrap_in_charts(
    method: OneStepMethod, system: System, retraction: str | mf.Retraction | None, default: str
) -> OneStepMethod:
    """The method on a system: itself on R^n.

    Raises
    ------
    InputError
        If the retraction is none of the system's space.
    SpaceError
        If the space lacks what the retraction is made of.
    """
    if system.space is None:
        if retraction is not None:
            raise InputError("a retraction is for a system on a manifold, and this one is on R^n")
        return method
    if retraction is None:
        retraction = default if system.space.has_geodesics else "projection"
    return InCharts(method, resolve_retraction(system.space, retraction))


def resolve_retraction(space: mf.Space, given: str | mf.Retraction) -> mf.Retraction:
    """A retraction of a space, by name or as it is."""
    found = mf.retraction(space, given) if isinstance(given, str) else given
    if found.space != space:
        raise InputError(f"the retraction is one of {found.space.name}, not of {space.name}")
    return found
