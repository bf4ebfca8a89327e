"""What explicit methods with both laws share: a step is brought back onto the levels that it has to end on."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf

from ..dissipation.base import terms_with_preserved
from ..errors import InputError
from ..functions.energy import Energy
from ..functions.gradients import EPS
from ..systems import ChartSystem, System, TurningSystem
from .base import OneStepMethod, TransportingMethod
from .charts import InCharts, wrap_in_charts
from .levels import (
    CHANGE_GRADIENT,
    LAW_SIGNS,
    MAX_PROJECTION_ITERATIONS,
    Law,
    correction_directions,
    correction_displacement,
    level_correction,
    project_onto_levels,
)
from .preserved import check_preserved, function_on_states, preserved_functions

MEAN_SLOPE_ROW, ERROR_ROW, CONSTRAINT_RESIDUAL_ROW, INITIAL_LEVELS_ROW, FIRST_METHOD_ROW = range(5)
"""What stands in the vectors that a step hands on: its mean slope, the estimate of its local error; in each component,
what is missed of the levels after the corrections; the levels that the run has begun on; from OWN on what a method adds
for the states between. Error and what is missed are over h."""

DRIFT_THRESHOLD, MAX_DRIFT_CORRECTION = 4.0 * EPS, 0.25 * EPS
"""What a function that is conserved has to be off the level of the start, relative to its size, for steps to take it
back, and the most that one takes back: far below what its rounding is."""

MAX_CORRECTION_DISPLACEMENT = 1e-10
"""What a step may move by to be taken back, relative to the state: more where the gradients of the laws are nearly
parallel. There the levels have next to no points in common, as at an equilibrium, and those of the start may have
none."""


class UncorrectedStep(NamedTuple):
    """A step before its corrections.

    Attributes
    ----------
    d : array, shape (n,)
        The displacement.
    law_changes : array, shape (laws,)
        What the functions of the laws have to change by, by a quadrature of their rates with nonnegative weights.
    error : array, shape (n,)
        Of the size of the local error, over h.
    interpolation_rows : array, shape (rows, n)
        Further rows to hand on.
    """

    d: jax.Array
    law_changes: jax.Array
    error: jax.Array
    interpolation_rows: jax.Array


class ExplicitMethod(TransportingMethod):
    """A step y of some explicit method, and x' the point near y where

        H(x') = H(x),    C(x') = C(x),    S(x') = S(x) + what it has produced,

    for every C that the system is known to conserve [:doc:`/explanation/exact_laws`]. What the entropy has produced
    is a quadrature of ``sigma = grad S . K grad S >= 0`` with nonnegative weights, of the order of the method.

    The point x' is found by Newton's method along the gradients of H and the C, and that of S as far as it is
    independent of these. What a function changes by is taken from a discrete gradient along the step, whose rounding
    vanishes with the step. So a state that relaxes is not held off its equilibrium by rounding.

    Vectors of constant length, such as many spins, are held one by one, in work and memory that grow with their number:
    each is brought back to its sphere along its radius, and the corrections above are made along the spheres.

    Where nothing but Casimirs is held besides the energy and the structure can turn a state along its leaf, as in
    quantum systems without dissipation, a covector is found beside the state, ``K' = turning(K, dH)``, at the order of
    the method. The step ends where it carries the state [:meth:`manifolds.PoissonStructure.carried`], and corrections
    are made along the leaf: the gradients of the Casimirs, which may depend on each other, are not needed.

    Where the energy falls and the entropy is conserved, as with double bracket dissipation, the energy falls by its own
    quadrature.

    Where the motion has a form without the gradient of the entropy, as Lindblad's equation has
    [:attr:`liethermo.Dissipation.has_generator`], the stages are spared the entropy:
    ``S(x') = max(S(y), S(x))``, to the same order, y being the step on the levels of all that is conserved.

    A subclass says what the step is before it is corrected: :meth:`uncorrected`.

    Parameters
    ----------
    number : int or None
        The order; None until the tolerance of a run has chosen one.
    preserve, retraction, held
        As of :class:`.MetriplecticRungeKutta`.
    """

    max_corrections: ClassVar[int] = MAX_PROJECTION_ITERATIONS

    number: int | None = eqx.field(static=True)
    functions: tuple[Energy, ...]
    retraction: str | mf.Retraction | None = eqx.field(static=True)
    held: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self, number: int | None, preserve: Sequence, retraction: str | mf.Retraction | None, held: tuple[str, ...]
    ):
        self.number, self.functions = number, preserved_functions(preserve)
        self.retraction, self.held = retraction, held

    @abstractmethod
    def base_step(self, rates: Callable, spared: bool, x, compensation, h) -> UncorrectedStep:
        """The step from x + compensation, which ends near the levels.

        Parameters
        ----------
        rates : function from a state, shape (n,), to arrays of shapes (n,) and (laws,)
            The field, and at what rates the functions of the laws change.
        spared : bool
            Whether these are zero.
        """

    @property
    def order(self) -> int:
        assert self.number is not None
        return self.number

    explicit = True

    preserves = frozenset({"energy", "entropy_law", "casimirs"})

    def preserves_function(self, system: System, name: str) -> bool:
        return name in system.first_integrals()

    def can_transport_attitude(self, system: System) -> bool:
        """On orbits of two dimensions: their levels are orbits everywhere, but for momenta that nothing moves.

        Among larger ones some have fewer dimensions than the levels around them, as that of a body on se(3) that spins
        but does not move. Near these the turn that makes up for an error is much larger than the error. Momenta of
        parts that turn inside, such as a wheel that rubs, are no matter of the attitude's.
        """
        size, casimirs = system.orbit_levels
        held = system.has_impulse or casimirs <= set(self.held)  # of a torque, the impulse is made to fit
        return system.has_all_casimirs and held and size - len(casimirs) <= 2

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        seen = self._map_functions(lambda C: function_on_states(system, C), tuple(sorted(system.first_integrals())))
        method = wrap_in_charts(seen, system, self.retraction, "exp")
        if isinstance(method, InCharts) and not isinstance(method.retraction, mf.Chart):
            raise InputError(
                f"{self} needs a retraction with its base point where the step starts, not {method.retraction}"
            )
        return method

    def requested_invariants(self, system: System) -> tuple[Energy, ...]:
        return tuple(function_on_states(system, C) for C in self.functions)

    def _map_functions(self, change: Callable, held: tuple[str, ...]) -> Self:
        """The method with its preserved functions changed, holding these of the system."""
        return type(self)(self.number, tuple(map(change, self.functions)), self.retraction, held)

    def check(self, system: System) -> None:
        """Raise InputError unless the system has a law to hold and conserves what is to be preserved."""
        if not self._laws(system):
            raise InputError(f"{self} holds the laws of a system, and this one claims none: take lt.Reference")
        check_preserved(system, self.functions)

    def start(self, system: System, x) -> jax.Array:
        laws = self._laws(system, self._can_follow_leaf(system))
        levels = jnp.stack([law.function.value(x) for law in laws])[: _max_stored_levels(system)]
        levels = jnp.concatenate([levels, jnp.zeros(x.shape[0] - levels.shape[0])])
        return (
            jnp.zeros((self.stages, x.shape[0]))
            .at[MEAN_SLOPE_ROW]
            .set(system.vector_field(x))
            .at[INITIAL_LEVELS_ROW]
            .set(levels)
        )

    # -- the step -----------------------------------------------------------------------------------------------------

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        """The vectors that the step hands on; of those before it the levels alone are needed."""
        leaf, n, spared = self._can_follow_leaf(system), x.shape[0], system.has_generator or system.dissipation is None
        laws = self._laws(system, leaf)
        starts = [law.function.gradient(x + compensation) for law in laws]

        def stage_rates(z) -> tuple[jax.Array, jax.Array]:
            """Those of the state and, along a leaf, of the covector that carries it."""
            field, changes = self.field_and_law_rates(system, laws, z[:n])
            turning = system.poisson.leaf_covector_rate(z[n:], system.energy.gradient(z[:n])) if leaf else None
            return field if turning is None else jnp.append(field, turning), changes

        begin, rest = (jnp.append(v, jnp.zeros(n)) if leaf else v for v in (x, compensation))
        d, changes, error, between = self.base_step(stage_rates, spared, begin, rest, h)
        if leaf:
            d, error, between = d[n:], error[:n], between[:, :n]
        if not isinstance(system, ChartSystem):  # whose row of levels is new at every step
            changes = changes + self._drift_correction(
                system, laws, starts, x, compensation, k[INITIAL_LEVELS_ROW], leaf
            )

        def project_onto(laws: list[Law]) -> tuple[jax.Array, jax.Array]:
            found = slice(len(laws))
            return project_onto_levels(
                system, laws, starts[found], x, compensation, d, changes[found], self.max_corrections, leaf
            )

        d, defect = (
            self._project_conserved_first(laws, x, compensation, project_onto)
            if system.has_generator
            else project_onto(laws)
        )
        return jnp.stack([d / h, error, jnp.broadcast_to(defect / h, x.shape), k[INITIAL_LEVELS_ROW], *between])

    def _drift_correction(
        self, system: System, laws: list[Law], gradients: list, x, compensation, levels, leaf: bool
    ) -> jax.Array:
        """What functions that are conserved are to change by, back to the levels that the run has begun on.

        Each step is exact but for a few roundings, whose sum would walk at random. The engines do so with the energy.
        A function whose gradient depends on those before it, as that of the entropy does at an equilibrium, changes as
        these make it.
        """

        def clipped_drift(law: Law, gradient, level) -> jax.Array:
            size = jnp.maximum(jnp.abs(level), law.function.sensitivity(x))
            off = (level - law.function.value(x)) - jnp.dot(gradient, compensation)
            return jnp.where(
                jnp.abs(off) > DRIFT_THRESHOLD * size,
                jnp.clip(off, -MAX_DRIFT_CORRECTION * size, MAX_DRIFT_CORRECTION * size),
                0.0,
            )

        found = jnp.stack(
            [
                clipped_drift(law, gradient, levels[i])
                if law.sign == 0.0 and i < _max_stored_levels(system)
                else jnp.zeros(())
                for i, (law, gradient) in enumerate(zip(laws, gradients, strict=True))
            ]
        )

        def is_small_displacement(v) -> jax.Array:
            move = correction_displacement(system, x, v, leaf)
            near = [
                jnp.linalg.norm(move[b]) <= MAX_CORRECTION_DISPLACEMENT * jnp.linalg.norm(x[b])
                for b in system.state_blocks
            ]
            return jnp.stack(near).all()

        def limited_changes() -> jax.Array:
            along = correction_directions(system, x, gradients, leaf)
            move = level_correction(system, along, found, is_small_displacement)
            return jnp.stack([jnp.dot(v, move) for v in along])

        return jax.lax.stop_gradient(jax.lax.cond((found != 0.0).any(), limited_changes, lambda: found))

    def _project_conserved_first(
        self, laws: list[Law], x, compensation, ended: Callable
    ) -> tuple[jax.Array, jax.Array]:
        """The end of a step on the levels of what is conserved; on all of them where a function changes wrongly there.

        These are to rise or to fall, as the motion makes them: so a step with the wrong sign is off the motion by no
        less than what is mended.
        """
        conserved = [law for law in laws if law.sign == 0.0]
        if len(conserved) in (0, len(laws)):
            return ended(laws)
        found = ended(conserved)
        d, others = found[0], laws[len(conserved) :]
        right = jnp.stack(
            [law.sign * jnp.dot(CHANGE_GRADIENT(law.function, x, d, compensation), d) >= 0.0 for law in others]
        )
        return jax.lax.cond(right.all(), lambda: found, lambda: ended(laws))

    def field_and_law_rates(self, system: System, laws: list[Law], x) -> tuple[jax.Array, jax.Array]:
        """The field at a stage, and at what rates the functions of the laws change, of the sign that the law wants.

        Where the field has a form without the entropy, the rates are not needed, and zero.
        """
        system = system.freeze_at(x)
        if system.has_generator:
            return system.generator_field(x), jnp.zeros(len(laws))
        dH = system.energy.gradient(x)
        if system.dissipation is None:
            return system.field(x, dH, jnp.zeros_like(x)), jnp.zeros(len(laws))
        dS = jnp.zeros_like(x) if system.entropy is None else system.entropy.gradient(x)
        dL = tuple(L.gradient(x) for L in system.preserved)
        parts = list(terms_with_preserved(system.dissipation, dL))

        def dissipation_rate(law: Law) -> jax.Array:
            """Without the motion, along which H and S do not change: near rest that is rounding noise."""
            if law.sign == 0.0:
                return jnp.zeros(())
            gradient = law.function.gradient(x)
            found = sum(part.rate_of_change(system, x, dH, dS, own, gradient) for part, own in parts)
            return law.sign * jnp.maximum(law.sign * found, 0.0)

        return system.field(x, dH, dS, dL), jnp.stack([dissipation_rate(law) for law in laws])

    def _can_follow_leaf(self, system: System) -> bool:
        """Whether a step goes along the symplectic leaf, on which all Casimirs are constant, so that none is corrected.

        Where it can, and not all Casimirs are quadratic: the gradients of others depend on each other at many states.
        """
        if system.dissipation is not None:
            return False
        held = [C for name, C in system.casimirs().items() if name in self.held]
        held += [] if system.entropy is None else [system.entropy]
        v = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
        return (
            not all(C.is_quadratic for C in held)
            and jax.eval_shape(system.poisson.leaf_covector_rate, v, v) is not None
        )

    def _laws(self, system: System, leaf: bool = False) -> list[Law]:
        """The functions that a step ends on levels of; the one that changes last, where the others leave it room.

        With ``leaf``, those that are not constant on a symplectic leaf.
        """
        functions = system.functions()
        laws = [Law(system.energy, LAW_SIGNS[system.energy_law])] if system.energy_law in LAW_SIGNS else []
        others = set() if system.surface is None else {system.surface.name}
        others |= set(system.casimirs()) if leaf else set()
        laws += [Law(functions[name], 0.0) for name in self.held if name not in others]
        laws += [Law(C, 0.0) for C in self.functions]
        if system.entropy_law in LAW_SIGNS and not leaf:
            assert system.entropy is not None
            laws.append(Law(system.entropy, LAW_SIGNS[system.entropy_law]))
        return sorted(laws, key=lambda law: law.sign != 0.0)

    def increment(self, h, k) -> jax.Array:
        return h * k[MEAN_SLOPE_ROW]

    def predict(self, k, before) -> jax.Array:
        return k

    def why_step_failed(self, system: System, x, k, h) -> str:
        if not bool(jnp.isfinite(system.vector_field(jnp.asarray(x))).all()):
            return ""
        return (
            f"the stages of a step of {h:g} run away, or leave the domain of the functions: it is too long for an "
            "explicit method; lt.MetriplecticGauss takes longer ones of a stiff system"
        )

    def __str__(self) -> str:
        kept = f", preserve={len(self.functions)} functions" if self.functions else ""
        return f"{type(self).__name__}(order={self.number}{kept})"


def constraint_residual(k) -> jax.Array:
    """How far an explicit step misses the levels that it has to end on, as a length of a slope."""
    return jnp.max(jnp.abs(k[CONSTRAINT_RESIDUAL_ROW]))


def _max_stored_levels(system: System) -> int:
    """How many levels a run remembers: no more than the components that functions depend on, as angles are none."""
    return system.attitude_system.body.dim if isinstance(system, TurningSystem) else system.dim
