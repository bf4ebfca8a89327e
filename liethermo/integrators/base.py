"""One-step methods: a fixed-point equation for the stage slopes, and the step that its solution makes."""

from __future__ import annotations

import enum
import functools
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module, forward_to
from manifolds.retractions.charts import RETRACTIONS

from ..errors import InputError
from ..functions.conditions import checked_numbers, require_condition
from ..functions.energy import Energy
from ..functions.gradients import EPS, DiscreteGradient, two_sum
from ..functions.rounding import value_and_rounding_scale
from ..systems import System
from ..systems.conservation import dissipation_keeps_casimirs
from ..systems.transport import generator_field
from .levels import project_implicit_step
from .tableaus import MAX_STAGES, extrapolation_matrix, gauss_tableau, interpolation_weights, start_slope_weights

_registry: list[OneStepMethod] = []

EVERY_SYSTEM = "every system"
"""Value of :attr:`OneStepMethod.systems` for a method without restrictions."""


class Guarantee(enum.StrEnum):
    """A property that a method keeps to rounding at every step; a member is equal to its value.

    ``ENERGY`` is the law of the energy, ``ENTROPY_LAW`` that of every entropy, ``ENTROPY_LAW_QUADRATIC`` that of
    quadratic ones; ``CASIMIRS`` are the known Casimirs that are conserved, ``QUADRATIC_CASIMIRS`` the quadratic ones,
    if the dissipation preserves them by construction. ``POSITIVITY`` says that a density matrix stays positive.
    """

    ENERGY = "energy"
    ENTROPY_LAW = "entropy_law"
    ENTROPY_LAW_QUADRATIC = "entropy_law_quadratic"
    CASIMIRS = "casimirs"
    QUADRATIC_CASIMIRS = "quadratic_casimirs"
    POSITIVITY = "positivity"


class OneStepMethod(Module):
    """A one-step method: slopes ``k``, shape (stages, n), with ``k = slopes(system, x, compensation, h, k)``.

    The state is ``x + compensation``, an unevaluated sum: the compensation holds the rounding errors of the previous
    steps (compensated summation). A scheme should form its points as ``x + (compensation + …)``.

    A subclass is complete when it defines the abstract members and is registered with :func:`register`: the shared test
    suite then tests its order and its guarantees. Every engine runs it from these definitions alone.

    Attributes
    ----------
    order : int
    preserves : frozenset of str
        Guarantees that hold to rounding at every step, by their names: see :class:`Guarantee`.
    stages : int
    systems : str
        The systems that the method is for, in words; :meth:`check` refuses others.
    why_fixed_step : str
        For a method without an error estimate, the reason why its steps have a fixed size.
    """

    systems: ClassVar[str] = EVERY_SYSTEM
    why_fixed_step: ClassVar[str] = "it does not estimate the error of its steps"
    retraction = cast("str | mf.Retraction | None", None)
    """Charts that the method takes its steps in, by name or as an object; a field of methods that can use them."""

    def __check_init__(self):
        retraction = self.retraction
        if not isinstance(retraction, mf.Retraction | None) and retraction not in tuple(RETRACTIONS):
            names = ", ".join(map(repr, RETRACTIONS))
            raise InputError(f"retraction must be a manifolds.Retraction or one of {names}, got {retraction!r}")
        unknown = sorted(set(self.preserves) - set(Guarantee))
        if unknown:
            names = ", ".join(map(repr, map(str, Guarantee)))
            raise InputError(f"preserves of {type(self).__name__} has {unknown[0]!r}; a method may preserve {names}")

    # -- every method gives -------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def stages(self) -> int: ...

    @property
    @abstractmethod
    def order(self) -> int: ...

    @property
    @abstractmethod
    def preserves(self) -> frozenset[str]: ...

    @abstractmethod
    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return the right-hand side of the stage equations at the slopes k, shape (stages, n).

        The step has the size h and starts at x + compensation. Solved slopes are equal to this result, and the slopes
        of an explicit method are the result for any k.
        """

    @abstractmethod
    def increment(self, h, k) -> jax.Array:
        """Return ``x' - x``, shape (n,), from the solved slopes."""

    # -- it may say more of its step ----------------------------------------------------------------------------------

    @property
    def explicit(self) -> bool:
        """True if the slopes do not depend on k, so that nothing is iterated: see :class:`.ExplicitMethod`."""
        return False

    @property
    def evaluations_per_iteration(self) -> int:
        """Number of evaluations of the vector field in one iteration."""
        return self.stages

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        """Return the state at the end of the step and its compensation, the rounding error of the addition."""
        return apply_increment(self, system, x, compensation, self.increment(h, k))

    def displace(self, system: System, x, v) -> jax.Array:
        """Return the state at a displacement v from x; used inside a step, where the laws need not hold."""
        return x + v

    def weights(self, theta) -> np.ndarray:
        """Return weights w, shape (..., stages): ``h sum_i w_i k_i`` is the displacement at the fraction theta."""
        return interpolation_weights(self.stages, theta)

    @property
    def carries_compensation(self) -> bool:
        """True if a step passes its compensation on; otherwise the next step depends on x alone."""
        return True

    @property
    def invariant_names(self) -> frozenset[str]:
        """Names of the functions, besides the energy, that a method without compensation conserves."""
        return frozenset()

    def initial_compensation(self, system: System, x) -> jax.Array:
        """Return the compensation at the start of a run, shape (n,): the displacement from x to its surface."""
        nothing = jnp.zeros_like(x)
        return (
            nothing if system.constraint_surface is None else system.constraint_surface.correct_rounding(x, nothing)[1]
        )

    def start(self, system: System, x) -> jax.Array:
        """Return the slopes, shape (stages, n), with which the iteration of the first step begins."""
        return jnp.tile(system.vector_field(x), (self.stages, 1))

    def predict(self, k, previous_k) -> jax.Array:
        """Return a guess of the next slopes, from the slopes k of this step and ``previous_k`` of the one before."""
        return 2.0 * k - previous_k

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return an estimate of the local error of a step, in the units of x; adaptive steps need it."""
        raise InputError(f"{self} has no error estimate: {self.why_fixed_step}")

    def attitude_speed_bound(self, system: System, x) -> jax.Array:
        """Return the angular rate, rad / time, of the attitude that follows the steps; 0 if there is no attitude.

        :meth:`error` does not contain the error of the attitude, so this rate limits adaptive steps.
        """
        return jnp.zeros(())

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        """Return the derivative of ``slopes - k`` by k, for Newton's method: a linear function of directions like k."""
        return jax.linearize(lambda k: self.slopes(system, x, compensation, h, k) - k, k)[1]

    def why_step_failed(self, system: System, x, k, h) -> str:
        """Return why the step from x is not finite, as a text, or ""; k are the slopes of the previous step."""
        return ""

    # -- and of what it runs on ---------------------------------------------------------------------------------------

    def check(self, system: System) -> None:
        """Raise InputError if the method cannot run the system; called when a run starts."""

    def preserves_function(self, system: System, name: str) -> bool:
        """Return True if the method preserves, to rounding, the conserved function of the system with this name."""
        casimir, quadratic = name in system.casimirs(), system.functions()[name].is_quadratic
        gradients_are_linear = system.energy.is_quadratic and (system.entropy is None or system.entropy.is_quadratic)
        if (
            quadratic and gradients_are_linear and self.order > 1
        ):  # every discrete gradient is that of a collocation polynomial
            return bool(self.preserves & {"casimirs", "quadratic_casimirs"})
        if "quadratic_casimirs" in self.preserves:
            force_keeps_casimirs = dissipation_keeps_casimirs(system)
            return casimir and quadratic and force_keeps_casimirs
        return casimir and "casimirs" in self.preserves

    def requested_invariants(self, system: System) -> tuple[Energy, ...]:
        """Return the functions of the state that the user has asked the method to preserve."""
        return ()

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        """Return the method as it runs on a system: itself on R^n, in the charts of a retraction on a manifold.

        ``tolerance`` is the relative tolerance of adaptive steps, or None for fixed steps.
        """
        return self

    @property
    def uses_charts(self) -> bool:
        """True if the method runs on a manifold in the charts of a retraction, and not in the space around it."""
        return self.retraction is not None

    def __str__(self) -> str:
        return type(self).__name__

    def __repr__(self) -> str:
        return str(self)


class MethodWrapper(OneStepMethod):
    """A method that wraps an inner method and has nearly its slopes; members that it does not define are forwarded.

    Attributes
    ----------
    method : OneStepMethod
    """

    method: OneStepMethod

    stages = forward_to("method")
    order = forward_to("method")
    preserves = forward_to("method")
    explicit = forward_to("method")
    evaluations_per_iteration = forward_to("method")
    increment = forward_to("method")
    weights = forward_to("method")
    predict = forward_to("method")
    check = forward_to("method")
    carries_compensation = forward_to("method")
    invariant_names = forward_to("method")
    initial_compensation = forward_to("method")
    why_step_failed = forward_to("method")


class TransportingMethod(OneStepMethod):
    """A method that gives the velocities with which it moves a body, so that an attitude can follow."""

    @abstractmethod
    def follows_attitude_exactly(self, system: System) -> bool:
        """Return True if an attitude can follow the steps exactly, with the spatial momentum conserved to rounding.

        It can if the slopes at Gauss nodes are Pi times :meth:`attitude_velocities_at_stages`, or if the steps of an
        explicit method end on the coadjoint orbit on which they began.
        """

    def attitude_velocities_at_stages(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return the velocities of an attitude at the stages, shape (stages, n), from the gradients of the step.

        They are those of :meth:`.System.attitude_velocity_from_gradients`.

        An explicit method has none: an attitude follows its steps by angles of their own.
        """
        raise NotImplementedError


class GaussMethod(OneStepMethod):
    """Base of the methods on Gauss nodes: s stages, order 2s, and slopes that extrapolate to the next step."""

    number: int = eqx.field(static=True)

    @property
    def stages(self) -> int:
        return self.number

    @property
    def order(self) -> int:
        return 2 * self.number

    def increment(self, h, k) -> jax.Array:
        return h * (gauss_tableau(self.number).b @ k)

    def predict(self, k, previous_k) -> jax.Array:
        return 2.0 * k - previous_k if self.number == 1 else extrapolation_matrix(self.number) @ k


WHY_FIXED_VARIATIONAL_STEP = (
    "a variational scheme conserves a function near the energy only if all steps have one size [Hairer, Lubich & "
    "Wanner 2006, VIII.1]; with adaptive steps the energy would drift. Use a smaller fixed step, or "
    "lt.MetriplecticGauss if the laws have to hold in long steps too"
)
"""Reason, for error messages, why variational schemes have steps of a fixed size."""


def apply_increment(
    method: OneStepMethod,
    system: System,
    x,
    compensation,
    d,
    invariants: tuple[Energy, ...] = (),
    ends_on_surface: bool = False,
    is_noisy: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """Return x + compensation + d and its compensation, projected onto the surface of the system if it has one.

    The step of an implicit method also keeps the ``invariants``, functions besides energy and entropy.
    ``ends_on_surface`` says that d needs no projection, ``is_noisy`` that noise contributes to d.
    """
    surface = system.constraint_surface
    if surface is None:
        return two_sum(x, compensation + d)
    if not (method.explicit or ends_on_surface or surface.is_kept_by_collocation):
        d = project_implicit_step(system, surface, invariants, x, compensation, d, is_noisy)
    return surface.correct_rounding(*two_sum(x, compensation + d))


def event_check_fractions(order: int) -> np.ndarray:
    """Return the fractions of an adaptive step at which the sign of an event is evaluated, shape (2 order - 1,)."""
    count = 2 * order
    return np.arange(1, count) / count


def is_permutation_equivariant(method: OneStepMethod) -> bool:
    """Return True if a step does not depend on the order of the components, as it does with some discrete gradients."""
    leaves = jax.tree_util.tree_leaves(method, is_leaf=lambda part: isinstance(part, DiscreteGradient))
    return all(part.is_coordinate_order_independent for part in leaves if isinstance(part, DiscreteGradient))


def has_error_estimate(method) -> bool:
    """Return True if a method defines :meth:`OneStepMethod.error`, and the method that it wraps does too."""
    overrides_error = isinstance(method, OneStepMethod) and type(method).error is not OneStepMethod.error
    return overrides_error and (not isinstance(method, MethodWrapper) or has_error_estimate(method.method))


def pullback_method(method: OneStepMethod, local_system) -> OneStepMethod:
    """Return the method with its own functions pulled back to a chart or a reordering."""

    def pullback_if_energy(node):
        return local_system.pullback(node) if isinstance(node, Energy) else node

    return jax.tree_util.tree_map(pullback_if_energy, method, is_leaf=lambda part: isinstance(part, Energy))


def checked_stages(stages) -> int:
    """Return ``stages``, the number of Gauss nodes, unchanged; raise InputError if there is no tableau for it."""
    if isinstance(stages, bool) or not isinstance(stages, int) or not 1 <= stages <= MAX_STAGES:
        raise InputError(f"stages must be an integer from 1 to {MAX_STAGES}, got {stages!r}")
    return stages


def checked_step_size(h) -> jax.Array:
    """Return the step size h as a scalar array; raise InputError if it is zero or not finite."""
    h = checked_numbers(h, "the step h", ())
    require_condition(
        h, lambda h: (abs(h) > 0.0) & (abs(h) < np.inf), "the step h must be finite and not zero, got {value}"
    )
    return h


def checked_run_states(system: System, x) -> jax.Array:
    """Return the states x of a run as an array, shape (times, n); raise InputError if there are fewer than two."""
    x = system.state(x, batch=True)
    if x.ndim != 2 or len(x) < 2:
        raise InputError(f"x must have at least two states of a run, shape (times, {system.dim}), got {x.shape}")
    return x


SLOPE_ROUNDING_FACTOR = 30.0
"""Rounding errors, in units of the rounding of the field, by which solved slopes may differ from the field."""


def generator_field_residual_jvp(system: System, slopes_to_stage_states: Callable, k) -> Callable:
    """Return the derivative of ``f(stage states) - k`` by k, where f is the generator field, which needs no entropy.

    It serves as :meth:`OneStepMethod.residual_jvp`: the slopes of a method differ from f only by the corrections of
    their gradients, which are of the order of the method. The derivative of f contains no eigenvectors.
    """
    return jax.linearize(
        lambda k: jax.vmap(functools.partial(generator_field, system))(slopes_to_stage_states(k)) - k, k
    )[1]


def collocation_error_estimate(system: System, x, compensation, h, k) -> jax.Array:
    """Return an estimate, shape (), of the local error of collocation at s Gauss nodes, which is O(h^{2s+1}).

    The residual ``f(x) - u'(0)`` of the collocation polynomial u at the start is O(h^s) relative to the speed [Hairer &
    Wanner 1996, IV.8]. The method has order 2s, so the local error is estimated as the length of the step, h|k|, times
    the square of the relative residual, divided by 2s + 1. This divisor makes the estimate right, to a factor that
    tends to 1, for a linear oscillation of any amplitude.

    The part of the residual that rounding may explain is subtracted: it does not shrink with h, and near a rest at the
    origin nothing else is left.
    """
    s, weights = len(k), start_slope_weights(len(k))
    field, rounding_scale = value_and_rounding_scale(system.vector_field, x + compensation)
    noise = SLOPE_ROUNDING_FACTOR * EPS * (1.0 + np.abs(weights).sum()) * jnp.max(rounding_scale)
    defect = jnp.maximum(jnp.max(jnp.abs(field - weights @ k)) - noise, 0.0)
    speed = jnp.max(jnp.abs(k))
    return h * defect * (defect / jnp.where(speed > 0.0, speed, 1.0)) / (2 * s + 1)


def register(*methods: OneStepMethod) -> None:
    """Add instances to the methods that the shared test suite runs."""
    _registry.extend(methods)


def registered_methods(special: bool = False) -> Iterator[OneStepMethod]:
    """Yield the registered one-step methods, one instance for each variant that the test suite runs.

    Parameters
    ----------
    special : bool
        Include methods for one kind of system: see :attr:`OneStepMethod.systems`.
    """
    yield from (method for method in _registry if special or method.systems == EVERY_SYSTEM)
