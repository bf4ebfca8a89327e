"""The metriplectic midpoint scheme [BFM 4.5-4.6]."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax

import manifolds as mf
from manifolds._pytree_module import forward_to

from ..functions.gradients import DiscreteGradient, discrete_gradient_by_name
from ..systems import System
from ..systems.transport import has_generator
from .base import OneStepMethod, TransportingMethod, collocation_error_estimate, generator_field_residual_jvp, register
from .charts import wrap_in_charts


class MetriplecticMidpoint(TransportingMethod):
    """The metriplectic midpoint scheme of order 2, with the energy law exact for every energy [BFM 4.5].

    ``(x' - x)/h = Pi(z) dgrad H + K_d(z) grad S(z)``, where z is the midpoint and dgrad a discrete gradient.

    K_d is the dissipation rebuilt with dgrad H in its kernel (4.6), so the energy law holds exactly for every H and
    every dissipation. The entropy obeys its law exactly if it is quadratic, and to O(h^3) a step otherwise
    (``MetriplecticGauss`` removes that restriction). The scheme keeps quadratic Casimirs exactly if the dissipation
    keeps them by construction. If H is quadratic, it keeps all quadratic first integrals. Others drift at O(h^2).

    The order is 2, and 1 with ``"coordinate_increment"`` as printed in the paper, which is not symmetric. A step solves
    one implicit equation of the size of the state. For a general energy an iteration costs two values and three
    gradients with ``"gonzalez"``, two and five with ``"mean_value"``, and about 3n gradients with
    ``"coordinate_increment"``.

    On a manifold the scheme runs in the arrays around it. With ``retraction`` it is
    ``R_h^-1(x, x') = Pi(z) dgrad H + K_d(z) dS(z)`` with the discrete gradient (4.9)-(4.10), in the chart around z [BFM
    §4.4]. It preserves what the method preserves in R^n, and stays on the manifold to rounding.

    Parameters
    ----------
    gradient : {"gonzalez", "mean_value", "coordinate_increment", "symmetric_coordinate_increment"} or DiscreteGradient
        The discrete gradient of the energy.
    retraction : str or manifolds.Retraction, optional
        On a manifold, the retraction whose charts are used. ``"midpoint"`` is the paper's ``exp~_h`` (4.8), and
        :func:`manifolds.retraction` has the other names. If z is the start of the step, the scheme uses the midpoint in
        the chart, so the order is 2 too.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> lt.integrate(
    ...     body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1, lt.MetriplecticMidpoint()
    ... ).audit().passed
    True
    """

    gradient: DiscreteGradient
    retraction: str | mf.Retraction | None = eqx.field(static=True)

    def __init__(self, gradient: str | DiscreteGradient = "gonzalez", retraction: str | mf.Retraction | None = None):
        self.gradient = discrete_gradient_by_name(gradient)
        self.retraction = retraction

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        return wrap_in_charts(self, system, self.retraction, "midpoint")

    stages = 1

    order = forward_to("gradient")

    preserves = frozenset({"energy", "entropy_law_quadratic", "quadratic_casimirs"})

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        return system.field(*self.midpoint_and_gradients(system, x, compensation, h, k))[None]

    def midpoint_and_gradients(self, system: System, x, compensation, h, k) -> tuple:
        """Return the arguments of the field: the midpoint z, and the gradients dH, dS and dL of the step."""
        d = h * k[0]
        z = x + (compensation + 0.5 * d)
        dH = self.gradient(system.energy, x, d, compensation)
        dS = system.entropy_gradient(z)
        dL = tuple(self.gradient(L, x, d, compensation) for L in system.preserved_functions)
        return z, dH, dS, dL

    def attitude_velocities_at_stages(self, system: System, x, compensation, h, k) -> jax.Array:
        return system.attitude_velocity_from_gradients(*self.midpoint_and_gradients(system, x, compensation, h, k))[
            None
        ]

    def follows_attitude_exactly(self, system: System) -> bool:
        return True

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        if not has_generator(system):
            return super().residual_jvp(system, x, compensation, h, k)
        return generator_field_residual_jvp(system, lambda k: x + (compensation + 0.5 * h * k), k)

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        return collocation_error_estimate(system, x, compensation, h, k)

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    def __str__(self) -> str:
        return f"MetriplecticMidpoint(gradient={self.gradient})"


register(
    MetriplecticMidpoint("gonzalez"),
    MetriplecticMidpoint("mean_value"),
    MetriplecticMidpoint("coordinate_increment"),
    MetriplecticMidpoint("symmetric_coordinate_increment"),
)
