"""What an integrator is: a fixed-point equation for its stage slopes, and the step they make."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module, forward_to
from manifolds.retractions.charts import RETRACTIONS

from ..errors import InputError
from ..functions.conditions import check_numbers, require_condition
from ..functions.energy import Energy
from ..functions.gradients import EPS, DiscreteGradient, two_sum
from ..functions.rounding import value_and_rounding_scale
from ..systems import System
from .levels import project_implicit_step
from .tableaus import MAX_STAGES, extrapolation_matrix, gauss_tableau, interpolation_weights, start_slope_weights

_registry: list[OneStepMethod] = []

EVERY_SYSTEM = "every system"


class OneStepMethod(Module):
    """A one-step method: slopes ``k``, shape (stages, n), with ``k = slopes(system, x, compensation, h, k)``.

    The state is ``x + compensation``, an unevaluated sum: rounding has kept the compensation from x in the steps before
    (compensated summation). A scheme should form its points as ``x + (compensation + …)``.

    A subclass is complete when it gives the abstract members and is registered with
    :func:`register`: the shared test-suite then holds it to its order and its guarantees. Both engines run it from
    these definitions alone.

    Attributes
    ----------
    order : int
    preserves : frozenset of str
        Guarantees that hold to rounding at every step. They are among ``"energy"`` (its law), ``"entropy_law"`` (for
        every entropy), ``"entropy_law_quadratic"`` (for a quadratic one), ``"casimirs"`` (those known to be
        conserved) and ``"quadratic_casimirs"`` (quadratic ones, where the dissipation keeps them by construction).
    stages : int
    systems : str
        What it is for, in words; :meth:`check` refuses others.
    why_fixed_step : str
        Of a method without an estimate of its error, why its steps are of one size.
    """

    systems: ClassVar[str] = EVERY_SYSTEM
    why_fixed_step: ClassVar[str] = "it does not estimate the error of its steps"

    def __check_init__(self):
        given = getattr(self, "retraction", None)
        if not isinstance(given, mf.Retraction | None) and given not in tuple(RETRACTIONS):
            names = ", ".join(map(repr, RETRACTIONS))
            raise InputError(f"retraction is a manifolds.Retraction, or the name of one ({names}), not {given!r}")

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
        """Right-hand side of the stage equations, shape (stages, n), from x + compensation, shape (n,), in a step h."""

    @abstractmethod
    def increment(self, h, k) -> jax.Array:
        """``x' - x``, shape (n,), from the solved slopes."""

    # -- it may say more of its step ----------------------------------------------------------------------------------

    @property
    def explicit(self) -> bool:
        """Whether the slopes do not depend on k, so that there is nothing to iterate: see :class:`.ExplicitMethod`."""
        return False

    @property
    def evaluations_per_iteration(self) -> int:
        """How often one iteration evaluates the vector field."""
        return self.stages

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        """The state at the end of the step and its compensation: the increment added, its rounding error caught."""
        return apply_increment(self, system, x, compensation, self.increment(h, k))

    def displace(self, system: System, x, v) -> jax.Array:
        """The state that a displacement v leads to from x: where the step is on its way, outside of the laws."""
        return x + v

    def weights(self, theta) -> np.ndarray:
        """Those w for which ``h sum_i w_i k_i`` displaces the state by a share theta of a step, shape (..., stages)."""
        return interpolation_weights(self.stages, theta)

    @property
    def carries_compensation(self) -> bool:
        """Whether a step hands on what rounding has kept from its end; otherwise the next step depends on x alone."""
        return True

    @property
    def invariant_names(self) -> frozenset[str]:
        """The names of the functions of its system that a method without such a memory holds besides the energy."""
        return frozenset()

    def initial_compensation(self, system: System, x) -> jax.Array:
        """Return the compensation of a step from x, shape (n,), that leads back to the surface of the system."""
        nothing = jnp.zeros_like(x)
        return nothing if system.surface is None else system.surface.correct_rounding(x, nothing)[1]

    def start(self, system: System, x) -> jax.Array:
        """Slopes to begin the iteration of a first step with."""
        return jnp.tile(system.vector_field(x), (self.stages, 1))

    def predict(self, k, before) -> jax.Array:
        """Slopes to begin the next step with, extrapolated from those of the last two steps."""
        return 2.0 * k - before

    def error(self, system: System, x, compensation, h, k) -> jax.Array:
        """An estimate of the local error of a step, the size of a vector like x; needed for adaptive steps."""
        raise InputError(f"{self} has no error estimate: {self.why_fixed_step}")

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        """The derivative of ``slopes - k`` by k, for Newton's method: a linear function of directions like k."""
        return jax.linearize(lambda k: self.slopes(system, x, compensation, h, k) - k, k)[1]

    def why_step_failed(self, system: System, x, k, h) -> str:
        """Why the step from x is not finite, where the method knows; k are the slopes of the step before."""
        return ""

    # -- and of what it runs on ---------------------------------------------------------------------------------------

    def check(self, system: System) -> None:
        """Raise InputError where the method cannot be used on a system; called when a run starts."""

    def preserves_function(self, system: System, name: str) -> bool:
        """Whether it keeps, to rounding, the function of the system with this name, which the system conserves."""
        casimir, quadratic = name in system.casimirs(), system.functions()[name].is_quadratic
        linear = system.energy.is_quadratic and (system.entropy is None or system.entropy.is_quadratic)
        if quadratic and linear and self.order > 1:  # every discrete gradient is that of a collocation polynomial
            return bool(self.preserves & {"casimirs", "quadratic_casimirs"})
        if "quadratic_casimirs" in self.preserves:
            by_force = system.dissipation is None or system.dissipation.preserves_casimirs
            return casimir and quadratic and by_force
        return casimir and "casimirs" in self.preserves

    def requested_invariants(self, system: System) -> tuple[Energy, ...]:
        """Functions of the states of a system that its user has asked the method to preserve."""
        return ()

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        """The method as it runs on a system: itself on R^n, in the charts of a retraction on a manifold.

        With the relative tolerance of adaptive steps, where steps are not of given sizes.
        """
        return self

    @property
    def uses_charts(self) -> bool:
        """Whether on a manifold it runs in the charts of a retraction, and not in the space around."""
        return getattr(self, "retraction", None) is not None

    def __str__(self) -> str:
        return type(self).__name__


class MethodWrapper(OneStepMethod):
    """A method made of another one, whose steps are about the same slopes: what it does not say is that of the other.

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
    """A method that says with which velocities it moves a body, so that an attitude can follow."""

    @abstractmethod
    def can_transport_attitude(self, system: System) -> bool:
        """Whether an attitude can follow its steps exactly, so that the momentum in space is kept to rounding.

        It can where the slopes at Gauss nodes are Pi times :meth:`velocities`, or the steps of an explicit method end
        on the coadjoint orbit on which they began.
        """

    def stage_velocities(self, system: System, x, compensation, h, k) -> jax.Array:
        """Those at the stages, :meth:`.System.transport` of what the step takes for dH, shape (stages, n).

        An explicit method has none: an attitude follows its steps by angles of their own.
        """
        raise NotImplementedError


class GaussMethod(OneStepMethod):
    """What methods on the Gauss nodes share: as many stages as nodes, order 2s, slopes that extend to the next step."""

    number: int = eqx.field(static=True)

    @property
    def stages(self) -> int:
        return self.number

    @property
    def order(self) -> int:
        return 2 * self.number

    def increment(self, h, k) -> jax.Array:
        return h * (gauss_tableau(self.number).b @ k)

    def predict(self, k, before) -> jax.Array:
        return 2.0 * k - before if self.number == 1 else extrapolation_matrix(self.number) @ k


WHY_FIXED_VARIATIONAL_STEP = (
    "what a variational scheme keeps without holding it, such as the energy of a free motion, it keeps by steps of one "
    "size alone, which conserve a function near it [Hairer, Lubich & Wanner 2006, VIII.1]; steps that follow an error "
    "let it drift. Take a smaller fixed step, or lt.MetriplecticGauss where laws are to hold in long steps too"
)
"""Why variational schemes have steps of one size."""


def apply_increment(
    method: OneStepMethod,
    system: System,
    x,
    compensation,
    d,
    held: tuple[Energy, ...] = (),
    ends_on_surface: bool = False,
    is_noisy: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """x + compensation + d, on the surface that the system has; of an implicit step, on which also ``held`` are kept.

    These are functions besides energy and entropy. ``ends_on_surface`` says that d ends on the surface by itself, ``is_noisy``
    that noise moves it.
    """
    surface = system.surface
    if surface is None:
        return two_sum(x, compensation + d)
    if not (method.explicit or ends_on_surface or surface.is_kept_by_collocation):
        d = project_implicit_step(system, surface, held, x, compensation, d, is_noisy)
    return surface.correct_rounding(*two_sum(x, compensation + d))


def event_check_fractions(order: int) -> np.ndarray:
    """Shares of an adaptive step at which the sign of an event is looked at: the higher the order, the longer it is."""
    count = 2 * order
    return np.arange(1, count) / count


def is_permutation_equivariant(method: OneStepMethod) -> bool:
    """Whether a step does not depend on the order of components, as with some discrete gradients it does."""
    parts = jax.tree_util.tree_leaves(method, is_leaf=lambda part: isinstance(part, DiscreteGradient))
    return all(part.is_order_independent for part in parts if isinstance(part, DiscreteGradient))


def has_error_estimate(method) -> bool:
    """Whether a method gives :meth:`OneStepMethod.error`, and the one that it wraps does."""
    given = isinstance(method, OneStepMethod) and type(method).error is not OneStepMethod.error
    return given and (not isinstance(method, MethodWrapper) or has_error_estimate(method.method))


def pullback_method(method: OneStepMethod, local) -> OneStepMethod:
    """The method with its own functions in the coordinates of ``local``: a system in a chart, or in another order."""

    def pullback_part(part):
        return local.pullback(part) if isinstance(part, Energy) else part

    return jax.tree_util.tree_map(pullback_part, method, is_leaf=lambda part: isinstance(part, Energy))


def checked_stages(stages) -> int:
    """How many Gauss nodes, where there is a tableau for them."""
    if isinstance(stages, bool) or not isinstance(stages, int) or not 1 <= stages <= MAX_STAGES:
        raise InputError(f"stages is an integer from 1 to {MAX_STAGES}, not {stages!r}")
    return stages


def kind_name(system) -> str:
    """What a system is; of anything else its class."""
    return system.kind if isinstance(system, System) else type(system).__name__


def checked_step_size(h) -> jax.Array:
    """The size of the steps of a run."""
    h = check_numbers(h, "the step h", ())
    require_condition(h, lambda h: (abs(h) > 0.0) & (abs(h) < np.inf), "the step h is finite and not zero, not {value}")
    return h


def checked_run_states(system: System, x) -> jax.Array:
    """Every state of a run, shape (times, n), at least two."""
    x = system.state(x, batch=True)
    if x.ndim != 2 or len(x) < 2:
        raise InputError(f"x has the states of a run, at least two, shape (times, {system.dim}), not {x.shape}")
    return x


SLOPE_ROUNDING_FACTOR = 30.0
"""Roundings that solved slopes may differ by."""


def generator_residual_jvp(system: System, stages: Callable, k) -> Callable:
    """:meth:`OneStepMethod.linearised` by the form of the motion without the entropy, at the stages that k makes.

    The slopes differ from it by the corrections of their gradients alone, which are of the order of the method, and its
    derivative has no eigenvectors in it.
    """
    return jax.linearize(lambda k: jax.vmap(system.generator_field)(stages(k)) - k, k)[1]


def collocation_error(system: System, x, compensation, h, k) -> jax.Array:
    """A local error O(h^{2s+1}) of collocation at s Gauss nodes, from how far its polynomial u misses the field.

    The defect ``f(x) - u'(0)`` at the start is O(h^s) of the speed [Hairer & Wanner 1996, IV.8]. The method being of
    order 2s, the error of a step h|k| is its square, relative to the speed; over 2s + 1, which makes it right to a
    factor that tends to 1 for a linear oscillation, of whatever amplitude.

    What rounding alone may make of the defect is no error of the step: it does not shrink with h, and near a rest at
    the origin it is all there is.
    """
    s, weights = len(k), start_slope_weights(len(k))
    field, size = value_and_rounding_scale(system.vector_field, x + compensation)
    noise = SLOPE_ROUNDING_FACTOR * EPS * (1.0 + np.abs(weights).sum()) * jnp.max(size)
    defect = jnp.maximum(jnp.max(jnp.abs(field - weights @ k)) - noise, 0.0)
    speed = jnp.max(jnp.abs(k))
    return h * defect * (defect / jnp.where(speed > 0.0, speed, 1.0)) / (2 * s + 1)


def register(*methods: OneStepMethod) -> None:
    """Add instances to those that the shared test-suite runs."""
    _registry.extend(methods)


def registered_methods(special: bool = False) -> Iterator[OneStepMethod]:
    """The registered instances, one after another.

    Parameters
    ----------
    special : bool
        Those for one kind of system too: see :attr:`OneStepMethod.systems`.
    """
    yield from (method for method in _registry if special or method.systems == EVERY_SYSTEM)
