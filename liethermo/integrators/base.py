"""What an integrator is: a fixed-point equation for its stage slopes, and the step they make."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._module import Module

from ..errors import InputError
from ..functions.energy import Energy
from ..functions.gradients import EPS, compensated
from ..functions.rounding import with_rounding
from ..systems import System
from .levels import ended
from .tableaus import MOST_STAGES, at_start, beyond, gauss, integrated

_registry: list[OneStepMethod] = []

EVERY_SYSTEM = "every system"


class OneStepMethod(Module):
    """An implicit one-step method: slopes ``k``, shape (stages, n), that solve ``k = slopes(system, x, low, h, k)``.

    The state is ``x + low``, an unevaluated sum: low is what rounding has kept from x in the steps before (compensated
    summation), and a scheme should form its points as ``x + (low + …)``.

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
    fixed : str
        Of a method without an estimate of its error, why its steps are of one size.
    """

    systems: ClassVar[str] = EVERY_SYSTEM
    fixed: ClassVar[str] = "it does not estimate the error of its steps"

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
    def slopes(self, system: System, x, low, h, k) -> jax.Array:
        """Right-hand side of the stage equations, shape (stages, n), at a state x + low, shape (n,), and step h."""

    @abstractmethod
    def increment(self, h, k) -> jax.Array:
        """``x' - x``, shape (n,), from the solved slopes."""

    # -- it may say more of its step ----------------------------------------------------------------------------------

    @property
    def explicit(self) -> bool:
        """Whether the slopes do not depend on k, so that there is nothing to iterate: see :meth:`missed`."""
        return False

    def missed(self, system: System, x, low, h, k) -> jax.Array:
        """How far an explicit method misses the levels that its step has to end on, as a length of a slope."""
        del system, x, low, h
        return jnp.zeros_like(jnp.max(k))

    @property
    def orderless(self) -> bool:
        """Whether a step does not depend on the order of components, so that large states may have another inside."""
        return False

    @property
    def evaluations(self) -> int:
        """How often one iteration evaluates the vector field."""
        return self.stages

    def move(self, system: System, x, low, h, k) -> tuple[jax.Array, jax.Array]:
        """The state at the end of the step as x' + low', the increment added with its rounding error caught."""
        d, surface = self.increment(h, k), system.surface
        if surface is None:
            return compensated(x, low + d)
        if not (self.explicit or surface.collocated):
            d = ended(system, surface, self.holds(system), x, low, d)
        return surface.settled(*compensated(x, low + d))

    def holds(self, system: System) -> tuple[Energy, ...]:
        """The functions besides energy and entropy that an implicit step keeps."""
        del system
        return ()

    def along(self, system: System, x, v) -> jax.Array:
        """The state that a displacement v leads to from x: where the step is on its way, outside of the laws."""
        return x + v

    def weights(self, theta) -> np.ndarray:
        """Those w for which ``h sum_i w_i k_i`` displaces the state by a share theta of a step, shape (..., stages)."""
        return integrated(self.stages, theta)

    @property
    def looks(self) -> np.ndarray:
        """Shares of an adaptive step at which the sign of an event is looked at, on its way: the more, the longer."""
        count = 2 * self.order
        return np.arange(1, count) / count

    def start(self, system: System, x) -> jax.Array:
        """Slopes to begin the iteration of a first step with."""
        return jnp.tile(system.vector_field(x), (self.stages, 1))

    def predict(self, k, before) -> jax.Array:
        """Slopes to begin the next step with, extrapolated from those of the last two steps."""
        return 2.0 * k - before

    def error(self, system: System, x, low, h, k) -> jax.Array:
        """An estimate of the local error of a step, the size of a vector like x; needed for adaptive steps."""
        raise InputError(f"{self} has no error estimate: {self.fixed}")

    @property
    def has_estimate(self) -> bool:
        """Whether it gives :meth:`error`."""
        return type(self).error is not OneStepMethod.error

    def unknowns(self, system: System) -> int:
        """How many components a slope has: as many as a state, or as the part of it that a step is solved for."""
        return system.dim

    def judged(self, system: System, x) -> tuple[System, jax.Array]:
        """The part of the system, and of the state, that a step is solved for; slopes and errors are of its size.

        The rest of the state follows from it in :meth:`move`, and no tolerance of the one is measured by the other.
        """
        return system, x

    def velocities(self, system: System, x, low, h, k) -> jax.Array:
        """The velocities of a body at the stages, :meth:`.System.transport` of what the step takes for dH.

        Shape (stages, n); an attitude follows them.
        """
        raise InputError(f"{self} does not say which velocities it moves with, so attitudes cannot be reconstructed")

    def transports(self, system: System) -> bool:
        """Whether an attitude can follow its steps exactly, so that the momentum in space is kept to rounding.

        An implicit method can where its slopes at Gauss nodes are Pi times :meth:`velocities`. An explicit one can
        where its steps end on the coadjoint orbit that they began on.
        """
        del system
        return False

    def explain(self, system: System, x, k, h) -> str:
        """Why the step from x is not finite, where the method knows; k are the slopes of the step before."""
        del system, x, k, h
        return ""

    # -- and of what it runs on ---------------------------------------------------------------------------------------

    def check(self, system: System) -> None:
        """Raise InputError where the method cannot be used on a system; called when a run starts."""

    def keeps(self, system: System, name: str) -> bool:
        """Whether it keeps, to rounding, the function of the system with this name, which the system conserves."""
        casimir, quadratic = name in system.casimirs(), system.functions()[name].is_quadratic
        linear = system.energy.is_quadratic and (system.entropy is None or system.entropy.is_quadratic)
        if quadratic and linear and self.order > 1:  # every discrete gradient is that of a collocation polynomial
            return bool(self.preserves & {"casimirs", "quadratic_casimirs"})
        if "quadratic_casimirs" in self.preserves:
            by_force = system.dissipation is None or system.dissipation.keeps_casimirs
            return casimir and quadratic and by_force
        return casimir and "casimirs" in self.preserves

    def suited(self, tolerance: float | None) -> OneStepMethod:
        """The method for adaptive steps of a relative tolerance, or None for steps of given sizes: itself, mostly."""
        del tolerance
        return self

    def on(self, system: System) -> OneStepMethod:
        """The method as it runs on a system: itself on R^n, in the charts of a retraction on a manifold."""
        return self

    def pulled(self, local) -> OneStepMethod:
        """The method in a chart: its own functions, if it has any, in the coordinates of the system ``local`` there."""
        return self

    def turned(self, k, change: Callable) -> jax.Array:
        """Slopes with their components changed as those of states are, by ``change``, a function of arrays (..., n)."""
        return change(k)

    @property
    def increments(self) -> int:
        """Random numbers that a step is driven by: none of a method for equations without noise."""
        return 0

    def driven_by(self, dW) -> OneStepMethod:
        """The method for one step, with its :attr:`increments`, shape (increments,)."""
        del dW
        return self

    # -- what follows -------------------------------------------------------------------------------------------------

    def change(self, system: System, x, low, h, k, d) -> jax.Array:
        """The derivative of ``slopes - k`` by k in the direction d, shape (stages, n), for Newton's method."""
        return jax.jvp(lambda k: self.slopes(system, x, low, h, k) - k, (k,), (d,))[1]

    def jacobian(self, system: System, x, low, h, k) -> jax.Array:
        """The matrix of :meth:`change`, shape (stages * n, stages * n)."""
        columns = jax.vmap(lambda d: self.change(system, x, low, h, k, d.reshape(k.shape)).ravel())(jnp.eye(k.size))
        return columns.T

    def __str__(self) -> str:
        return type(self).__name__


class Wrapping(OneStepMethod):
    """A method made of another one, whose steps are about the same slopes: what it does not say is that of the other.

    Attributes
    ----------
    method : OneStepMethod
    """

    method: OneStepMethod

    @property
    def stages(self) -> int:
        return self.method.stages

    @property
    def order(self) -> int:
        return self.method.order

    @property
    def preserves(self) -> frozenset[str]:
        return self.method.preserves

    @property
    def explicit(self) -> bool:
        return self.method.explicit

    @property
    def evaluations(self) -> int:
        return self.method.evaluations

    @property
    def has_estimate(self) -> bool:
        return self.method.has_estimate

    @property
    def increments(self) -> int:
        return self.method.increments

    def driven_by(self, dW) -> OneStepMethod:
        return eqx.tree_at(lambda m: m.method, self, self.method.driven_by(dW))

    def increment(self, h, k) -> jax.Array:
        return self.method.increment(h, k)

    def weights(self, theta) -> np.ndarray:
        return self.method.weights(theta)

    def predict(self, k, before) -> jax.Array:
        return self.method.predict(k, before)

    def missed(self, system: System, x, low, h, k) -> jax.Array:
        return self.method.missed(system, x, low, h, k)

    def check(self, system: System) -> None:
        self.method.check(system)


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
        return h * (gauss(self.number).b @ k)

    def predict(self, k, before) -> jax.Array:
        return 2.0 * k - before if self.number == 1 else beyond(self.number) @ k


ONE_SIZE = (
    "what a variational scheme keeps without holding it, such as the energy of a free motion, it keeps by steps of one "
    "size alone, which conserve a function near it [Hairer, Lubich & Wanner 2006, VIII.1]; steps that follow an error "
    "let it drift. Take a smaller fixed step, or lt.MetriplecticGauss where laws are to hold in long steps too"
)
"""Why variational schemes have steps of one size."""


def checked_stages(stages) -> int:
    """How many Gauss nodes, where there is a tableau for them."""
    if isinstance(stages, bool) or not isinstance(stages, int) or not 1 <= stages <= MOST_STAGES:
        raise InputError(f"stages is an integer from 1 to {MOST_STAGES}, not {stages!r}")
    return stages


ROUNDINGS = 30.0
"""Roundings that solved slopes may differ by."""


def collocation_error(system: System, x, low, h, k) -> jax.Array:
    """A local error O(h^{2s+1}) of collocation at s Gauss nodes, from how far its polynomial u misses the field.

    The defect ``f(x) - u'(0)`` at the start is O(h^s) of the speed [Hairer & Wanner 1996, IV.8]. The method being of
    order 2s, the error of a step h|k| is its square, relative to the speed; over 2s + 1, which makes it right to a
    factor that tends to 1 for a linear oscillation, of whatever amplitude.

    What rounding alone may make of the defect is no error of the step: it does not shrink with h, and near a rest at
    the origin it is all there is.
    """
    s, weights = len(k), at_start(len(k))
    field, size = with_rounding(system.vector_field, x + low)
    noise = ROUNDINGS * EPS * (1.0 + np.abs(weights).sum()) * jnp.max(size)
    missed = jnp.maximum(jnp.max(jnp.abs(field - weights @ k)) - noise, 0.0)
    speed = jnp.max(jnp.abs(k))
    return h * missed * (missed / jnp.where(speed > 0.0, speed, 1.0)) / (2 * s + 1)


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
