"""``System``, the base class of all systems: ``x' = Pi(x) dH + force(x; dH, dS)`` and the laws that follow from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced, real_array
from manifolds._precision import with_library_settings
from manifolds._pytree_module import replace_fields
from manifolds.structures.poisson import ProductPoisson

from ..dissipation.base import Dissipation, dissipation_terms, sum_dissipations
from ..dissipation.heating import couple_to_baths
from ..errors import InputError
from ..functions.bath_energy import BodyBathsEnergy
from ..functions.checks import checked_energy, trace_energies, with_polynomial_degrees
from ..functions.energy import Energy, make_energy
from ..functions.flat_states import functions_of_flat_states
from ..functions.on_spaces import energy_of_vectors
from ..tracing.short_form import callable_name, format_arguments
from ..tracing.traced import trace_callables
from .baths import ABSENT_BATHS, BathEntropy, HeatBaths, checked_baths, poisson_with_baths
from .check import AXIOM_TOLERANCE, CheckReport, check_system, require_axioms
from .conservation import project_covector
from .interface import SystemInterface
from .invariants import candidate_invariants, find_invariants, find_preserved_function_names
from .states import checked_state_array, evaluate_batch, reshape_to_sites
from .transport import added_attitude_velocities, generator_field, has_generator


class System(SystemInterface):
    """A metriplectic system on R^n or on a manifold [BFM §2.3]; see the subclasses for how to build one.

    On a manifold states, covectors and velocities are the arrays of the space, flat and real
    (``space.to_vector``): covectors act on tangent vectors alone, and velocities are tangent.

    A system is a pytree: its parameters (those of ``lt.Quadratic``, the rates, the arrays of ``equinox`` modules
    used as functions) are leaves, which can be swept, batched and differentiated.

    Attributes
    ----------
    poisson : manifolds.PoissonStructure
        The Poisson structure.
    energy, entropy : Energy
        Callable on states of shape (..., n), an energy that depends on time on a state and a time. ``entropy`` is None
        for a system without one.
    dissipation : Dissipation or None
        The dissipation; None without one.
    momentum_maps : dict of Energy
        Further functions that are claimed to be conserved, by name.
    dim : int
        Number of state components.
    space : manifolds.Space or None
        The state space, where it is not R^n.
    """

    def __repr__(self) -> str:
        body = self.drop_baths()
        state_space = body.space if body.lie_algebra is None else body.lie_algebra
        parts = {
            "energy": body.energy,
            "entropy": None if isinstance(body.entropy, BathEntropy) else body.entropy,
            "dissipation": self.dissipation,
            "baths": self.baths if self.baths.number else None,
            "torque": self.torque_laws.name,
        }
        name = f"{self.dim} components" if state_space is None else state_space.name
        return f"{type(self).__name__}({name}, {format_arguments(parts)})"

    @with_library_settings
    def _build(
        self,
        poisson,
        dim,
        energy,
        entropy,
        dissipation,
        momentum_maps,
        validate,
        space=None,
        baths=None,
        check_poisson: bool = True,
    ) -> None:
        """Check the arguments and set the attributes that all systems have; constructors call it last.

        Without ``check_poisson`` an expensive check is skipped, because Pi is a Poisson tensor by construction.
        """
        baths = checked_baths(baths)
        self.dim, self.space = dim, space
        self.poisson = trace_callables(poisson, lambda poisson, x: poisson.sharp(x, x), (dim,))
        self.energy = checked_energy(
            self.energy_of_flat_states(make_energy(energy, "the energy")), dim, "the energy", allow_time=True
        )
        self.entropy = None
        if entropy is not None:
            self.entropy = checked_energy(
                self.energy_of_flat_states(make_energy(entropy, "the entropy")), dim, "the entropy"
            )
        momentum_maps = name_momentum_maps(momentum_maps)
        roles = {name: f"momentum map {name!r}" for name in momentum_maps}
        self.momentum_maps = {
            name: checked_energy(self.energy_of_flat_states(make_energy(J, roles[name])), dim, roles[name])
            for name, J in momentum_maps.items()
        }
        if space is None:  # in a chart no function is quadratic
            self.energy = with_polynomial_degrees(self.energy, dim)
            self.entropy = None if self.entropy is None else with_polynomial_degrees(self.entropy, dim)
            self.momentum_maps = {name: with_polynomial_degrees(J, dim) for name, J in self.momentum_maps.items()}

        def needs_bath_entropies(term: Dissipation) -> bool:
            return term.acts_on_baths_alone or (self.entropy is None and term.needs_entropy)

        terms = dissipation_terms(dissipation)
        bath_terms = tuple(term for term in terms if needs_bath_entropies(term))
        dissipation = sum_dissipations([term for term in terms if not needs_bath_entropies(term)] or None)
        for term in bath_terms:
            if not baths.number:
                raise InputError(
                    f"{type(term).__name__} acts on baths. Give the system baths=lt.HeatBaths(...)"
                    if term.acts_on_baths_alone
                    else f"{type(term).__name__} increases the entropy, so the system needs an entropy"
                )
            if not term.can_act_on_baths:
                raise InputError(
                    f"{type(term).__name__} increases the entropy of the body, which has none besides the entropies "
                    "of its baths. Give entropy="
                )
        self.dissipation = None
        if dissipation is not None:
            dissipation = functions_of_flat_states(dissipation, self.shape)
            self.dissipation = _bind_dissipation(self, dissipation)
        if baths.number:
            _attach_baths(self, baths, bath_terms)
        if self.preserved_functions and not is_traced(self):
            self.preserved_labels = find_preserved_function_names(self)
        if validate and not is_traced(self):
            require_axioms(self, with_matrices=check_poisson)

    def drop_baths(self) -> System:
        if not self.baths.number:
            return self
        assert isinstance(self.poisson, ProductPoisson)
        return replace_fields(
            self,
            dim=self.body_dim,
            space=None if self.space is None else _drop_last_factor(self.space),
            poisson=self.poisson.first,
            energy=self.energy.body if isinstance(self.energy, BodyBathsEnergy) else self.energy,
            baths=ABSENT_BATHS,
        )

    @with_library_settings
    def temperatures(self, x, t=None) -> jax.Array:
        """Return the temperatures of the baths, shape (..., baths), for states of shape (..., n).

        With one bath, ``system.temperature(x)`` returns its temperature, shape (...).

        Parameters
        ----------
        x : array, shape (..., n)
        t : float or array, shape (...), optional
            The times of the states, if the temperatures depend on it.

        Raises
        ------
        InputError
            If there are no baths, or their temperatures depend on time and t is missing.
        """
        if not self.baths.number:
            raise InputError("this system has no baths. Give it baths=lt.HeatBaths(...)")
        entropies, energy = jnp.asarray(x)[..., self.body_dim :], self.baths.energy
        if isinstance(self.energy, BodyBathsEnergy):  # which may be frozen at a time
            energy = self.energy.baths
        if not energy.depends_on_time:
            return jnp.vectorize(energy.gradient, signature="(m)->(m)")(entropies)
        if t is None:
            raise InputError("the temperatures of the baths depend on time. Give the time beside the state")
        gradient = jnp.vectorize(lambda y, t: energy.at_time(t).gradient(y), signature="(m),()->(m)")
        return gradient(entropies, jnp.asarray(t, dtype=jnp.float64))

    def temperature(self, x, t=None) -> jax.Array:
        """Return the temperature of a system with one bath, or with one temperature, shape (...).

        Parameters
        ----------
        x : array, shape (..., n)
        t : float or array, shape (...), optional
            The times of the states, if the temperature depends on it.

        Raises
        ------
        InputError
            If the system has no temperature, or several: see :meth:`temperatures`.
        """
        T = self.temperatures(x, t)
        if T.shape[-1] != 1:
            raise InputError(
                f"this system has {T.shape[-1]} temperatures. Use system.temperatures(x), of shape (..., {T.shape[-1]})"
            )
        return T[..., 0]

    def energy_of_flat_states(self, energy: Energy) -> Energy:
        """Return an energy of flat states, shape (n,), from one of states in the shape that users see."""
        return energy_of_vectors(functions_of_flat_states(energy, self.shape), self.space)

    def _trace_dissipation(self, dissipation: Dissipation) -> Dissipation:
        """Return the dissipation with its Python functions traced by JAX at states of this system."""

        def force(dissipation, x):
            return dissipation.force(self, x, x, x, (x,) * len(dissipation.preserve))

        return trace_callables(dissipation, force, (self.dim,), is_leaf=lambda part: isinstance(part, Energy))

    # -- dynamics -------------------------------------------------------------------------------------------------

    def vector_field(self, x, t=None) -> jax.Array:
        """Return the vector field ``x'``, shape (..., n), at states x and, if the energy depends on it, the time t."""
        return evaluate_batch(self, _field_at, x, t, "(n)")

    def entropy_production(self, x, t=None) -> jax.Array:
        """Return the rate of growth of the entropy, ``grad S . x'``, shape (...), at states x and the time t."""
        if self.entropy is None:
            raise InputError("this system has no entropy")
        return evaluate_batch(self, _entropy_production_at, x, t, "()")

    def energy_fall(self, x, t=None) -> jax.Array:
        """Return the rate at which the dissipation lowers the energy, ``-grad H . force``, shape (...), at x and t."""
        return evaluate_batch(self, _energy_fall_at, x, t, "()")

    @with_library_settings
    def friction_matrix(self, x, t=None, dissipation: Dissipation | None = None) -> jax.Array:
        """Return the matrix K(x) of the symmetric bracket, shape (n, n), for which the force is ``K(x) grad S``.

        By default the dissipation is that of the system; it may be another, such as one of its summands.
        """
        x, system = self.state(x), self if t is None else self.at_time(t)
        dissipation = self.total_dissipation if dissipation is None else dissipation
        dH, dL = system.energy.gradient(x), tuple(L.gradient(x) for L in dissipation.preserve)
        return jax.jacfwd(lambda dS: dissipation.force(system, x, dH, dS, dL))(jnp.zeros(self.dim))

    def attitude_velocity_from_gradients(self, x, dH, dS, dL=()) -> jax.Array:
        """Return the velocity xi of an attitude, ``g' = g hat(xi)``, shape (body_dim,), from continuous or discrete
        gradients.

        It is dH plus :meth:`liethermo.Dissipation.added_attitude_velocity` of each dissipation, for the body without
        baths. Without external torques the motion of the body is ``Pi(x) xi``, except for internal momenta.
        """
        total = dH[: self.body_dim]
        for sigma in added_attitude_velocities(self, x, dH, dS, dL):
            total = total if sigma is None else total + sigma
        return total

    # -- other forms of the same system -------------------------------------------------------------------------------

    def local_system(self, x, is_centred: bool = False) -> tuple[System, jax.Array]:
        """Return this system in local coordinates near a state x, and the coordinates of x in it.

        With ``is_centred`` the local system is for use at that state alone.
        """
        return self, x

    def subsystem_to_solve(self, x) -> tuple[System, jax.Array]:
        """Return the subsystem whose equations a step solves, and the components of x that are its state.

        Slopes and errors have its dimension. The other components follow from it, and have tolerances of their own.
        """
        return self, x

    def to_user_solution(self, solution: Any) -> Any:
        """Return a solution with states in the shape that the user sees, from one of the system that was run."""
        return reshape_to_sites(self, solution)

    def cache_tensors_at(self, x) -> System:
        """Return the system for use at one state x, with the tensors that Pi and K share computed in advance."""
        return self

    # -- functions and laws -------------------------------------------------------------------------------------------

    def functions(self) -> dict[str, Energy]:
        """Return the functions that may be conserved, by name: momentum maps, preserved functions and Casimirs."""
        return candidate_invariants(self)

    @with_library_settings
    def first_integrals(self) -> frozenset[str]:
        """Return the names of the functions that the system conserves.

        Momentum maps are claimed to be conserved. A Casimir is conserved if the dissipation conserves it. A function
        that one dissipation has to preserve is conserved if the motion and the other summands conserve it. If no
        construction implies conservation, the function is tested at random states; it is left out while JAX traces the
        system. If the test cannot decide, a function that the dissipation has to preserve counts as conserved.
        """
        return find_invariants(self).conserved_names

    # -- checks ---------------------------------------------------------------------------------------------------

    def state(self, x, batch: bool = False) -> jax.Array:
        """Return ``x`` as a checked state: real doubles, finite, shape (n,), or (..., n) with ``batch``.

        For a system on sites x may have the shape ``(*sites, d)``. On a manifold x may have the shape of points,
        and must be a point of it. InputError or manifolds.OffManifoldError if it is no state.
        """
        numbers = self.state_array(x, batch)
        return numbers.astype(jnp.float64) if isinstance(numbers, jax.core.Tracer) else real_array(numbers)

    def state_array(self, x, batch: bool = False) -> np.ndarray | jax.Array:
        """Return ``x`` as a checked state, as :meth:`state` does, but as a NumPy array unless JAX traces it."""
        return checked_state_array(self, x, batch)

    @with_library_settings
    def check(self, points=None, samples: int = 16, seed: int = 0, scale: float = 1.0, times=None) -> CheckReport:
        """Test the axioms of a metriplectic system at given or random points; the report prints as a table.

        Parameters
        ----------
        points : array, shape (m, n), optional
            Where to test. By default ``samples`` normally distributed points of standard deviation ``scale``.
        samples, seed, scale
            Of the random points.
        times : array, shape (m,), or float, optional
            Of an energy that depends on time, those of the points; by default as random as the points.

        Returns
        -------
        CheckReport
            ``.passed``, ``.rows`` (axiom, residual, tolerance, passed, note).
        """
        return check_system(self, points, samples, seed, scale, times)

    def _vector_field(self, x) -> jax.Array:
        """Return the vector field at one state, shape (n,), from the exact gradients of all functions."""
        if has_generator(self):
            return generator_field(self, x)
        dS = jnp.zeros_like(x) if self.entropy is None else self.entropy.gradient(x)
        gradients = self.energy.gradient(x), dS, *(L.gradient(x) for L in self.preserved_functions)
        dH, dS, *dL = (project_covector(self, x, alpha) for alpha in gradients)
        return self.field(x, dH, dS, tuple(dL))


def _bind_dissipation(system: System, dissipation: Dissipation) -> Dissipation:
    """Return the dissipation bound to the system, with its Python functions traced by JAX."""
    dissipation = trace_energies(dissipation, system.dim, "a preserved function")
    return system._trace_dissipation(dissipation.bind_to(system))


def _attach_baths(system: System, baths: HeatBaths, bath_terms: tuple[Dissipation, ...]) -> None:
    """Append baths to a system in place, with the dissipations ``bath_terms``, which act on the extended states."""
    body, n, m = copy(system), system.dim, baths.number

    def lift_energy(energy: Energy) -> Energy:
        return energy.on(range(n))

    if system.dissipation is not None or not bath_terms:
        system.dissipation = couple_to_baths(
            system.total_dissipation, body, m, baths.has_positive_temperatures, lift_energy
        )
    if body.space is not None and body.space.dtype.kind == "c":
        raise InputError(f"baths need a real space, but {body.space.name} is complex")
    system.baths, system.dim = baths, n + m
    system.space = None if body.space is None else mf.Product(body.space, mf.Euclidean(m))
    system.poisson = poisson_with_baths(body.poisson, m)
    system.energy = BodyBathsEnergy(body.energy, baths.energy, n, system.dim)
    heat = BathEntropy(m)
    system.entropy = heat if body.entropy is None else lift_energy(body.entropy) + heat
    system.momentum_maps = {name: lift_energy(J) for name, J in body.momentum_maps.items()}
    if bath_terms:
        bound_terms = tuple(_bind_dissipation(system, term) for term in bath_terms)
        system.dissipation = sum_dissipations((*system.total_dissipation.terms, *bound_terms))


def _field_at(system: System, x) -> jax.Array:
    """Return the vector field at one state, shape (n,)."""
    return system._vector_field(x)


def _entropy_production_at(system: System, x) -> jax.Array:
    """Return the growth rate of the entropy at one state, shape ()."""
    assert system.entropy is not None
    return jnp.dot(system.entropy.gradient(x), system._vector_field(x))


def _energy_fall_at(system: System, x) -> jax.Array:
    """Return the rate at which the dissipation lowers the energy at one state, shape ()."""
    if system.dissipation is None:
        return jnp.zeros(())
    dH, dS = system.energy.gradient(x), system.entropy_gradient(x)
    dL = tuple(L.gradient(x) for L in system.preserved_functions)
    return -system.dissipation.rate_of_change(system, x, dH, dS, dL, dH)


def _drop_last_factor(space: mf.Space) -> mf.Space:
    """Return a product space without its last factor."""
    assert isinstance(space, mf.Product)
    first_factor, *other_factors = space.factors[:-1]
    return mf.Product(first_factor, *other_factors) if other_factors else first_factor


def name_momentum_maps(momentum_maps) -> dict[str, Any]:
    """Return momentum maps as a dict by name, from a mapping or from a sequence of functions."""
    if isinstance(momentum_maps, Mapping):
        return dict(momentum_maps)
    if not isinstance(momentum_maps, Sequence) or isinstance(momentum_maps, str):
        raise InputError(f"momentum_maps must be a dict or a sequence of functions, got {type(momentum_maps).__name__}")
    return {callable_name(J, f"J{i + 1}"): J for i, J in enumerate(momentum_maps)}


__all__ = ["AXIOM_TOLERANCE", "System", "name_momentum_maps"]
