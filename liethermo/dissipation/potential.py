"""Friction that is not linear in the forces: the gradient of a convex potential."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module, forward_to
from manifolds.matrices.exponential import hyperbolic_stumpff

from ..errors import FunctionError, InputError
from ..functions.conditions import checked_numbers, positive_condition
from ..functions.time_span import required_argument_count
from ..tracing.index_check import check_indices_and_return_shapes
from .base import Dissipation
from .checks import RATE_CONDITION, state_shape_dtype
from .factor import Factor
from .projected_metric import ProjectedMetric

CONVEXITY_CHECK = "psi convex"
"""Row of ``system.check()``: convexity of a dissipation potential, tested on random pairs of forces."""

MINIMUM_AT_ZERO_CHECK = "psi least at 0"
"""Row of ``system.check()``: the slope of a dissipation potential vanishes at zero force."""

CONVEXITY_PAIRS = 8
"""Number of random pairs of forces, at each scale, that test the convexity of a potential."""

CONVEXITY_FORCE_SCALES = (1e-3, 1e-1, 1.0, 10.0)
"""Lengths, per component, of the random forces that test the convexity of a potential."""


class DissipationPotential(Dissipation):
    """Dissipation by a potential of the thermodynamic forces: ``force = B grad psi(B^T dS)``.

    B is the factor of another dissipation, ``B B^T = K``. By default it is the orthogonal projector P off dH, and the
    force is ``P grad psi(P dS)``. The factor of a :class:`ProjectedMetric` with a cometric is an oblique projector;
    with functions to ``preserve`` it projects off their gradients too. A dissipation on an algebra has forces ``[dH,
    dS]`` in the algebra, and heat conduction has one force for each pair of bodies.

    If psi is convex with its minimum at zero, ``S' = (B^T dS) . grad psi(B^T dS) >= 0``, and ``B^T dH = 0`` for the
    discrete gradient too: so every method obeys both laws as for K. The potential ``|f|^2 / 2`` gives K itself.
    ``system.check()`` tests that psi is convex with its minimum at zero, and building a system rejects any other psi.
    At a kink of psi the slope that JAX returns is used; the iterations of implicit methods need a continuous slope.

    Parameters
    ----------
    psi : function from the forces, shape (size,), to a scalar; or from a state and the forces
        :class:`CoulombFriction`, :class:`PowerLawFriction`, :class:`ActivatedFriction`, or a function of your own.
    of : Dissipation, optional
        The dissipation whose factor makes the forces; ``ProjectedMetric(normalized=True)`` by default.

    Raises
    ------
    AxiomError
        When a system is built, if psi is not convex or has no minimum at 0.
    InputError
        If ``of`` has no factor.
    """

    psi: Callable
    of: Dissipation
    depends_on_state: bool = eqx.field(static=True)

    def __init__(self, psi: Callable, of: Dissipation | None = None):
        if not callable(psi):
            raise InputError(f"psi must be a function from forces to a number, got {type(psi).__name__}")
        of = ProjectedMetric(normalized=True) if of is None else of
        if not isinstance(of, Dissipation):
            raise InputError(f"of must be a dissipation, got {type(of).__name__}")
        if of.energy_law != "conserved":
            raise InputError(f"of must be a dissipation that conserves the energy, and {type(of).__name__} does not")
        self.psi, self.of, self.depends_on_state = psi, of, required_argument_count(psi) == 2

    is_symmetric = False

    preserves_casimirs = forward_to("of")
    preserve = forward_to("of")
    force_pattern = forward_to("of")

    def bind_to(self, system):
        bound_potential = eqx.tree_at(lambda d: d.of, self, self.of.bind_to(system))
        shape = check_indices_and_return_shapes(
            lambda x: bound_potential.psi_at_state(x)(
                jnp.zeros(bound_potential._inner_factor_at_state(system, x).size)
            ),
            state_shape_dtype(system.dim),
        )
        if shape.shape != ():
            raise FunctionError(f"psi must return one number, but it returns shape {shape.shape}")
        return bound_potential

    def psi_at_state(self, x) -> Callable:
        """Return the potential as a function of the forces at a state."""
        return lambda f: jnp.asarray(self.psi(x, f) if self.depends_on_state else self.psi(f))

    def input_residuals(self, system, x):
        """Return relative residuals of two conditions on the potential: it is convex, and least at zero force."""
        slope = jax.grad(self.psi_at_state(x))
        size = self._inner_factor_at_state(system, x).size
        pairs = np.random.default_rng(0).standard_normal((CONVEXITY_PAIRS, 2, size))
        pairs = np.concatenate([scale * pairs for scale in CONVEXITY_FORCE_SCALES])

        def monotonicity_residual(pair):
            a, b = pair
            slopes = jnp.stack([slope(a), slope(b)])
            length = jnp.linalg.norm(a - b) * jnp.max(jnp.linalg.norm(slopes, axis=1))
            return jnp.maximum(-jnp.dot(a - b, slopes[0] - slopes[1]), 0.0) / jnp.where(length > 0.0, length, 1.0)

        max_slope = jnp.max(jnp.linalg.norm(jax.vmap(slope)(pairs[:, 0]), axis=1))
        slope_at_zero = jnp.linalg.norm(slope(jnp.zeros(size))) / jnp.where(max_slope > 0.0, max_slope, 1.0)
        return self.of.input_residuals(system, x) | {
            CONVEXITY_CHECK: jnp.max(jax.vmap(monotonicity_residual)(pairs)),
            MINIMUM_AT_ZERO_CHECK: slope_at_zero,
        }

    def force(self, system, x, dH, dS, dL):
        B = self._inner_factor(system, x, dH, dL)
        return B.times(jax.grad(self.psi_at_state(x))(B.transpose_times(dS)))

    def _inner_factor_at_state(self, system, x) -> Factor:
        """Return the factor of the underlying dissipation for the exact gradients at x."""
        return self._inner_factor(system, x, system.energy.gradient(x), tuple(L.gradient(x) for L in self.preserve))

    def _inner_factor(self, system, x, dH, dL) -> Factor:
        """Return the factor of the underlying dissipation; raise InputError if it has none."""
        B = self.of.factor(system, x, dH, dL)
        if B is None:
            space_text = "" if system.space is None else f" on {system.space.name}"
            raise InputError(
                f"{type(self.of).__name__} gives no factor of its friction matrix{space_text}, so of= cannot use it"
            )
        return B


# -- named potentials -------------------------------------------------------------------------------------------------


class NamedPotential(Module):
    """Base of potentials: a sum over the forces, or with ``each=False`` an isotropic function of their length."""

    each: bool = eqx.field(static=True, default=False, kw_only=True)

    def __call__(self, f):
        return jnp.sum(self.value_of_square(f * f)) if self.each else self.value_of_square(jnp.dot(f, f))

    def value_of_square(self, squared_force):
        """Return the potential as a function of the square of a force."""
        raise NotImplementedError


class CoulombFriction(NamedPotential):
    """Dry friction ``strength (sqrt(f^2 + width^2) - width)``: its flux is at most ``strength``, for any force f.

    The potential is smooth. For forces far below the width it is linear friction with the coefficient ``strength /
    width``.

    Parameters
    ----------
    strength : float, >= 0
        Largest flux.
    width : float, > 0
        Force below which the flux is linear.
    each : bool
        Apply the potential to every force by itself, or to their length (by default).
    """

    strength: jax.Array
    width: jax.Array

    def __init__(self, strength=1.0, width=1e-2, *, each: bool = False):
        self.strength, self.width = (
            _checked_nonnegative_number(strength, "the strength", True),
            _checked_nonnegative_number(width, "the width", False),
        )
        self.each = bool(each)

    def value_of_square(self, q):
        return self.strength * q / (jnp.sqrt(q + self.width**2) + self.width)


class PowerLawFriction(NamedPotential):
    """Power law ``strength / p ((f^2 + width^2)^(p/2) - width^p)``: its flux grows as ``|f|^(p-1)``.

    The potential is smooth for a width > 0. Without a width its slope is continuous, and of Hölder class p - 1 at f = 0
    for p < 2; if Newton's method stalls there, a width helps. For p = 2 it is quadratic.

    Parameters
    ----------
    exponent : float, > 1
        p, the exponent of the potential.
    strength, width : float, >= 0
        Coefficient, and the force below which the flux is linear.
    each : bool
        Apply the potential to every force by itself, or to their length (by default).
    """

    exponent: jax.Array
    strength: jax.Array
    width: jax.Array

    def __init__(self, exponent, strength=1.0, width=0.0, *, each: bool = False):
        self.exponent = _checked_nonnegative_number(exponent, "the exponent", False)
        if not isinstance(self.exponent, jax.core.Tracer) and not float(self.exponent) > 1.0:
            raise InputError(f"the exponent of a power law must be > 1, got {float(self.exponent):g}")
        self.strength, self.width = (
            _checked_nonnegative_number(strength, "the strength", True),
            _checked_nonnegative_number(width, "the width", True),
        )
        self.each = bool(each)

    def value_of_square(self, q):
        q = q + self.width**2
        power = jnp.where(q > 0.0, jnp.where(q > 0.0, q, 1.0) ** (0.5 * self.exponent), 0.0)
        return self.strength / self.exponent * (power - self.width**self.exponent)


class ActivatedFriction(NamedPotential):
    """Flow over a barrier, ``rate scale^2 (cosh(f / scale) - 1)``: its flux is ``rate scale sinh(f / scale)``.

    This is the law of mass action, and Eyring's law of creep. The potential is smooth. For forces far below the scale
    it is linear friction with the coefficient ``rate``.

    Parameters
    ----------
    rate : float, >= 0
        Coefficient of the friction for small forces.
    scale : float, > 0
        Force above which the flux grows exponentially.
    each : bool
        Apply the potential to every force by itself, or to their length (by default).
    """

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
    scale: jax.Array = eqx.field(metadata=positive_condition("the scale").metadata)

    def __init__(self, rate=1.0, scale=1.0, *, each: bool = False):
        self.rate, self.scale = (
            _checked_nonnegative_number(rate, "the rate", True),
            _checked_nonnegative_number(scale, "the scale", False),
        )
        self.each = bool(each)

    def value_of_square(self, q):
        return self.rate * q * hyperbolic_stumpff(2, q / self.scale**2)


def _checked_nonnegative_number(value, label: str, allow_zero: bool) -> jax.Array:
    """Return a number as an array, shape (); raise InputError if it is negative, or zero where that is not allowed."""
    number = checked_numbers(value, label, ())
    if not isinstance(number, jax.core.Tracer) and not (float(number) >= 0.0 if allow_zero else float(number) > 0.0):
        raise InputError(f"{label} must be {'>=' if allow_zero else '>'} 0, got {float(number):g}")
    return number
