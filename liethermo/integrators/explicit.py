"""Base class of explicit methods with both laws: each step is corrected onto the levels on which it has to end."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf

from ..dissipation.base import terms_with_preserved_values
from ..errors import InputError
from ..functions.energy import Energy
from ..functions.gradients import EPS
from ..systems import AttitudeChartSystem, System
from ..systems.transport import generator_field, has_generator
from .base import OneStepMethod, TransportingMethod
from .charts import InCharts, wrap_in_charts
from .levels import (
    CHANGE_GRADIENT,
    LAW_SIGNS,
    MAX_PROJECTION_ITERATIONS,
    Law,
    correction_directions,
    correction_displacement,
    level_correction_vector,
    project_onto_levels,
)
from .preserved import check_preserved, function_on_states, preserved_functions


class StepRow(IntEnum):
    """Rows of the array ``k``, shape (stages, n), that an explicit step returns.

    Attributes
    ----------
    MEAN_SLOPE
        ``(x' - x) / h``.
    ERROR
        The estimate of the local error, over h.
    CONSTRAINT_RESIDUAL
        The distance from the levels after the corrections, over h, in every component.
    INITIAL_LEVELS
        The values of the conserved functions at the start of the run.
    FIRST_METHOD_ROW
        The first of the rows that a method adds for interpolation.
    """

    MEAN_SLOPE = 0
    ERROR = 1
    CONSTRAINT_RESIDUAL = 2
    INITIAL_LEVELS = 3
    FIRST_METHOD_ROW = 4


DRIFT_THRESHOLD = 4.0 * EPS
"""Drift of a conserved function from its initial value, relative to its size, above which steps correct it."""

MAX_DRIFT_CORRECTION = 0.25 * EPS
"""Largest correction of the drift of a conserved function in a step, relative to its size: far below its rounding."""

MAX_CORRECTION_DISPLACEMENT = 1e-10
"""Largest displacement of a drift correction, relative to the state; larger ones are skipped.

A larger displacement means that the gradients of the laws are nearly parallel, as at an equilibrium. The levels then
have hardly any common point, and the initial levels may have none."""


class UncorrectedStep(NamedTuple):
    """An explicit step before its corrections onto the levels of the laws.

    Attributes
    ----------
    d : array, shape (n,)
        The displacement.
    law_changes : array, shape (laws,)
        Required changes of the functions of the laws, from a quadrature of their rates with nonnegative weights.
    error : array, shape (n,)
        A vector of the size of the local error, over h.
    interpolation_rows : array, shape (rows, n)
        Rows of ``k`` for the states inside the step.
    """

    d: jax.Array
    law_changes: jax.Array
    error: jax.Array
    interpolation_rows: jax.Array


class ExplicitMethod(TransportingMethod):
    """Base of explicit methods: a step y, corrected to the point x' near y on the levels of the laws.

        H(x') = H(x),    C(x') = C(x),    S(x') = S(x) + (entropy produced),

    for every C that the system is known to conserve [:doc:`/explanation/exact_laws`]. The entropy produced is a
    quadrature of ``sigma = grad S . K grad S >= 0`` with nonnegative weights, of the order of the method.

    Newton's method finds x' along the gradients of H and the C, and along the component of grad S that is independent
    of these. The change of a function is computed from a discrete gradient along the step, whose rounding vanishes with
    the step. So rounding does not keep a relaxing state off its equilibrium.

    Vectors of constant length, such as many spins, are held one by one, with work and memory proportional to their
    number: each is projected radially onto its sphere, and the corrections above are made along the spheres.

    If only Casimirs are held besides the energy, and the structure can transport a state along its leaf, as in quantum
    systems without dissipation, the method integrates a covector beside the state, at its own order
    [:meth:`manifolds.PoissonStructure.leaf_covector_rate`]. The step ends where the covector carries the state
    [:meth:`manifolds.PoissonStructure.leaf_displacement`], and corrections are made along the leaf. The gradients of
    the Casimirs, which may depend on each other, are not needed.

    If the energy falls and the entropy is conserved, as with double bracket dissipation, the energy falls by its own
    quadrature.

    If the motion has a form without the gradient of the entropy, such as Lindblad's equation
    [:attr:`liethermo.Dissipation.has_generator`], the stages do not evaluate the entropy: ``S(x') = max(S(y), S(x))``,
    to the same order, where y is the step on the levels of all conserved functions.

    A subclass defines the step before its corrections: :meth:`base_step`.

    Parameters
    ----------
    number : int or None
        The order; None until the tolerance of a run has determined it.
    preserve, retraction, held
        See :class:`.MetriplecticRungeKutta`.
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
    def base_step(self, rates: Callable, skip_law_rates: bool, x, compensation, h) -> UncorrectedStep:
        """Return the step from x + compensation without corrections onto the levels of the laws.

        Parameters
        ----------
        rates : function from a state, shape (n,), to arrays of shapes (n,) and (laws,)
            The field, and the rates of change of the functions of the laws.
        skip_law_rates : bool
            True if the rates of the functions are zero and need not be evaluated.
        """

    @property
    def order(self) -> int:
        assert self.number is not None
        return self.number

    explicit = True

    preserves = frozenset({"energy", "entropy_law", "casimirs"})

    def preserves_function(self, system: System, name: str) -> bool:
        return name in system.first_integrals()

    def follows_attitude_exactly(self, system: System) -> bool:
        """Return True on coadjoint orbits of dimension 2 or less, where levels are orbits except for momenta at rest.

        Some larger orbits have fewer dimensions than the levels around them, for example on se(3) the orbit of a body
        that spins but does not translate. Near these the rotation that would cancel an error is much larger than the
        error. Momenta of internal parts, such as a wheel with friction, do not matter for the attitude.
        """
        orbit_dim, casimirs, has_all_casimirs = system.orbit_levels
        # With a torque, the impulse is projected onto the orbit instead.
        casimirs_are_held = system.torque_laws.has_impulse or casimirs <= set(self.held)
        return has_all_casimirs and casimirs_are_held and orbit_dim - len(casimirs) <= 2

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        method_on_states = self._with_transformed_functions(
            lambda C: function_on_states(system, C), tuple(sorted(system.first_integrals()))
        )
        method = wrap_in_charts(method_on_states, system, self.retraction, "exp")
        if isinstance(method, InCharts) and not isinstance(method.retraction, mf.Chart):
            raise InputError(
                f"{self} needs a retraction with its base point at the start of the step, got {method.retraction}"
            )
        return method

    def requested_invariants(self, system: System) -> tuple[Energy, ...]:
        return tuple(function_on_states(system, C) for C in self.functions)

    def _with_transformed_functions(self, transform: Callable, also_conserved: tuple[str, ...]) -> Self:
        """Return the method with transformed preserved functions, holding the system's functions of these names."""
        return type(self)(self.number, tuple(map(transform, self.functions)), self.retraction, also_conserved)

    def check(self, system: System) -> None:
        """Raise InputError unless the system has a law to hold and conserves the functions that are to be preserved."""
        if not self._laws_to_hold(system):
            raise InputError(
                f"{self} needs a system with an energy or entropy law, but this one has none. Use lt.Reference"
            )
        check_preserved(system, self.functions)

    def start(self, system: System, x) -> jax.Array:
        laws = self._laws_to_hold(system, self._can_follow_symplectic_leaf(system))
        levels = jnp.stack([law.function.value(x) for law in laws])[: _max_stored_levels(system)]
        levels = jnp.concatenate([levels, jnp.zeros(x.shape[0] - levels.shape[0])])
        return (
            jnp.zeros((self.stages, x.shape[0]))
            .at[StepRow.MEAN_SLOPE]
            .set(system.vector_field(x))
            .at[StepRow.INITIAL_LEVELS]
            .set(levels)
        )

    # -- the step -----------------------------------------------------------------------------------------------------

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return the rows of :class:`StepRow`; of the k passed in, only the initial levels are used."""
        follow_leaf, n, skip_law_rates = (
            self._can_follow_symplectic_leaf(system),
            x.shape[0],
            has_generator(system) or not system.total_dissipation.terms,
        )
        laws = self._laws_to_hold(system, follow_leaf)
        start_gradients = [law.function.gradient(x + compensation) for law in laws]

        def stage_rates(z) -> tuple[jax.Array, jax.Array]:
            """Return the rates of the state (and of the covector that carries it along a leaf) and of the laws."""
            field, changes = self.field_and_law_rates(system, laws, z[:n])
            covector_rate = (
                system.poisson.leaf_covector_rate(z[n:], system.energy.gradient(z[:n])) if follow_leaf else None
            )
            return field if covector_rate is None else jnp.append(field, covector_rate), changes

        start, start_compensation = (jnp.append(v, jnp.zeros(n)) if follow_leaf else v for v in (x, compensation))
        d, changes, error, interpolation_rows = self.base_step(
            stage_rates, skip_law_rates, start, start_compensation, h
        )
        if follow_leaf:
            d, error, interpolation_rows = d[n:], error[:n], interpolation_rows[:, :n]
        if system.engine_hints.has_fixed_levels:
            changes = changes + self._drift_correction_changes(
                system, laws, start_gradients, x, compensation, k[StepRow.INITIAL_LEVELS], follow_leaf
            )

        def displacement_on_levels_and_residual(laws: list[Law]) -> tuple[jax.Array, jax.Array]:
            selection = slice(len(laws))
            return project_onto_levels(
                system,
                laws,
                start_gradients[selection],
                x,
                compensation,
                d,
                changes[selection],
                self.max_corrections,
                follow_leaf,
                self._constant_length_momentum_dim(system),
            )

        d, residual = (
            self._project_conserved_first(laws, x, compensation, displacement_on_levels_and_residual)
            if has_generator(system)
            else displacement_on_levels_and_residual(laws)
        )
        return jnp.stack(
            [d / h, error, jnp.broadcast_to(residual / h, x.shape), k[StepRow.INITIAL_LEVELS], *interpolation_rows]
        )

    def _drift_correction_changes(
        self, system: System, laws: list[Law], gradients: list, x, compensation, levels, follow_leaf: bool
    ) -> jax.Array:
        """Return the changes of the functions, shape (laws,), that lead back to the levels at the start of the run.

        Each step is exact except for a few roundings, whose sum would be a random walk. The engines correct the energy
        in the same way. A function whose gradient depends on the previous ones, such as the entropy at an equilibrium,
        changes as the corrections of the others determine.
        """

        momentum_dim = self._constant_length_momentum_dim(system)

        def clipped_drift(law: Law, gradient, level) -> jax.Array:
            scale = jnp.maximum(jnp.abs(level), law.function.sensitivity(x))
            drift = (level - law.function.value(x)) - jnp.dot(gradient, compensation)
            return jnp.where(
                jnp.abs(drift) > DRIFT_THRESHOLD * scale,
                jnp.clip(drift, -MAX_DRIFT_CORRECTION * scale, MAX_DRIFT_CORRECTION * scale),
                0.0,
            )

        drifts = jnp.stack(
            [
                clipped_drift(law, gradient, levels[i])
                if law.sign == 0.0 and i < _max_stored_levels(system)
                else jnp.zeros(())
                for i, (law, gradient) in enumerate(zip(laws, gradients, strict=True))
            ]
        )

        def gives_small_displacement(correction) -> jax.Array:
            displacement = correction_displacement(system, x, correction, follow_leaf, momentum_dim)
            is_small = [
                jnp.linalg.norm(displacement[b]) <= MAX_CORRECTION_DISPLACEMENT * jnp.linalg.norm(x[b])
                for b in system.state_blocks
            ]
            return jnp.stack(is_small).all()

        def changes_by_level_correction() -> jax.Array:  # the drifts, as far as the level correction can cancel them
            directions = correction_directions(system, x, gradients, follow_leaf, momentum_dim)
            correction = level_correction_vector(system, directions, drifts, gives_small_displacement)
            return jnp.stack([jnp.dot(v, correction) for v in directions])

        return jax.lax.stop_gradient(jax.lax.cond((drifts != 0.0).any(), changes_by_level_correction, lambda: drifts))

    def _project_conserved_first(
        self, laws: list[Law], x, compensation, project: Callable
    ) -> tuple[jax.Array, jax.Array]:
        """Return a projected displacement and its residual: onto the levels of the conserved laws if that is enough.

        If a monotone function then changes with the wrong sign, the step is projected onto all levels.

        A function that rises or falls does so by the motion itself. A step with the wrong sign is therefore off the
        motion by at least the size of the second projection.
        """
        conserved_laws = [law for law in laws if law.sign == 0.0]
        if len(conserved_laws) in (0, len(laws)):
            return project(laws)
        projection = project(conserved_laws)
        d, monotone_laws = projection[0], laws[len(conserved_laws) :]
        has_right_sign = jnp.stack(
            [law.sign * jnp.dot(CHANGE_GRADIENT(law.function, x, d, compensation), d) >= 0.0 for law in monotone_laws]
        )
        return jax.lax.cond(has_right_sign.all(), lambda: projection, lambda: project(laws))

    def field_and_law_rates(self, system: System, laws: list[Law], x) -> tuple[jax.Array, jax.Array]:
        """Return the field at a stage, shape (n,), and the rate of each law's function, without any wrong sign.

        If the field has a form without the entropy, the rates are not needed and zero.
        """
        system = system.cache_tensors_at(x)
        if has_generator(system):
            return generator_field(system, x), jnp.zeros(len(laws))
        dH = system.energy.gradient(x)
        if not system.total_dissipation.terms:
            return system.field(x, dH, jnp.zeros_like(x)), jnp.zeros(len(laws))
        dS = jnp.zeros_like(x) if system.entropy is None else system.entropy.gradient(x)
        dL = tuple(L.gradient(x) for L in system.preserved_functions)
        terms = list(terms_with_preserved_values(system.total_dissipation.terms, dL))

        def law_rate_from_dissipation(law: Law) -> jax.Array:
            """Return the rate of a law's function by dissipation alone: near rest the motion would add rounding."""
            if law.sign == 0.0:
                return jnp.zeros(())
            gradient = law.function.gradient(x)
            rate = sum(term.rate_of_change(system, x, dH, dS, dL_term, gradient) for term, dL_term in terms)
            return law.sign * jnp.maximum(law.sign * rate, 0.0)

        return system.field(x, dH, dS, dL), jnp.stack([law_rate_from_dissipation(law) for law in laws])

    def _constant_length_momentum_dim(self, system: System) -> int:
        """Return the number of leading components that are a momentum of constant length, in a body with moving parts.

        Wheels and joints move the body also where the total momentum is zero. The number is 0 if there are no internal
        parts, or if the method does not hold the Casimirs of the momentum.
        """
        dim, casimirs, _ = system.orbit_levels
        return dim if casimirs and casimirs <= set(self.held) and dim < system.body_dim else 0

    def _can_follow_symplectic_leaf(self, system: System) -> bool:
        """Return True if a step can follow the symplectic leaf, on which all Casimirs are constant.

        This requires a structure that knows its leaves, and a Casimir that is not quadratic: the gradients of such
        Casimirs depend on each other at many states.
        """
        if system.total_dissipation.terms:
            return False
        casimirs = [C for name, C in system.casimirs().items() if name in self.held]
        casimirs += [] if system.entropy is None else [system.entropy]
        v = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
        return (
            not all(C.is_quadratic for C in casimirs)
            and jax.eval_shape(system.poisson.leaf_covector_rate, v, v) is not None
        )

    def _laws_to_hold(self, system: System, follow_leaf: bool = False) -> list[Law]:
        """Return the laws onto whose levels steps are projected: conserved functions first, then monotone ones.

        With ``follow_leaf``, the list has no functions that are constant on a symplectic leaf.
        """
        functions = system.functions()
        laws = [Law(system.energy, LAW_SIGNS[system.energy_law])] if system.energy_law in LAW_SIGNS else []
        constant_names = set() if system.constraint_surface is None else {system.constraint_surface.name}
        constant_names |= set(system.casimirs()) if follow_leaf else set()
        laws += [Law(functions[name], 0.0) for name in self.held if name not in constant_names]
        laws += [Law(C, 0.0) for C in self.functions]
        if system.entropy_law in LAW_SIGNS and not follow_leaf:
            assert system.entropy is not None
            laws.append(Law(system.entropy, LAW_SIGNS[system.entropy_law]))
        return sorted(laws, key=lambda law: law.sign != 0.0)

    def increment(self, h, k) -> jax.Array:
        return h * k[StepRow.MEAN_SLOPE]

    def predict(self, k, previous_k) -> jax.Array:
        return k

    def why_step_failed(self, system: System, x, k, h) -> str:
        if not bool(jnp.isfinite(system.vector_field(jnp.asarray(x))).all()):
            return ""
        return (
            f"the step h = {h:g} is too long for an explicit method: its stages diverge or leave the domain of the "
            "functions. Try a smaller step, or lt.MetriplecticGauss if the system is stiff"
        )

    def __str__(self) -> str:
        suffix = f", preserve={len(self.functions)} functions" if self.functions else ""
        return f"{type(self).__name__}(order={self.number}{suffix})"


def constraint_residual(k) -> jax.Array:
    """Return the distance of an explicit step from its levels, divided by h, shape (): a row of its slopes k."""
    return jnp.max(jnp.abs(k[StepRow.CONSTRAINT_RESIDUAL]))


def _max_stored_levels(system: System) -> int:
    """Return how many initial levels a run can store, one in each component of the state that is not an angle."""
    return system.inner_system.dim if isinstance(system, AttitudeChartSystem) else system.dim
