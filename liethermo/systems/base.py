"""``System``, the base class of all systems: ``x' = Pi(x) dH + force(x; dH, dS)`` and the laws that follow from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced, real_array
from manifolds._precision import with_library_settings
from manifolds.structures.poisson import ProductPoisson

from ..dissipation.base import Dissipation, sum_dissipations, terms_with_preserved_values
from ..dissipation.heating import couple_to_baths
from ..errors import AxiomError, CasimirError, InputError
from ..functions.checks import checked_energy, trace_energies, with_polynomial_degrees
from ..functions.energy import Energy, function_name, make_energy
from ..functions.on_spaces import energy_of_vectors, flatten_site_functions
from ..functions.with_baths import BodyBathsEnergy
from ..tracing.caching import memoize
from ..tracing.interpret import evaluate_at_points
from ..tracing.traced import trace_callables
from .baths import BathEntropy, HeatBaths, poisson_with_baths
from .check import AXIOM_TOLERANCE, CheckReport, check_system
from .conservation import is_proportional, judge_conservation, rates_of_change
from .interface import InvariantVerdicts, SystemInterface

TEST_STATE_SCALES = (1.0, 1e-4, 1e4)
"""Scales of the random states at which it is tested which functions a system conserves."""

LARGE_STATE_DIM = 2_000
"""Number of state components above which one random state of each scale is tested."""

N_NEARBY_STATES = 4
"""Number of initial states near which conservation is tested too."""

NEARBY_RADII = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4)
"""Distances of the tested states from an initial state, relative to its norm."""


TEST_TIMES = (0.0, 0.7310585786300049, -1.618033988749895)
"""Times at which conservation is tested if the energy depends on time."""


class ReorderedSystem(NamedTuple):
    """A system with the components of its states in another order.

    Attributes
    ----------
    system : System
    reorder_state, restore_state : functions of states, shape (..., n)
        Reorder the components, and restore their order.
    pullback : function from an Energy to an Energy
        Turns a function of states into a function of reordered states.
    """

    system: System
    reorder_state: Callable
    restore_state: Callable
    pullback: Callable


class System(SystemInterface):
    """A metriplectic system on R^n or on a manifold [BFM §2.3]; see the subclasses for how to build one.

    On a manifold states, covectors and velocities are the arrays of the space, flat and real
    (``space.to_vector``): covectors act on tangent vectors alone, and velocities are tangent.

    A system is a pytree: its parameters (those of ``lt.Quadratic``, the rates, the arrays of ``equinox`` modules
    used as functions) are leaves, which can be swept, batched and differentiated.

    Attributes
    ----------
    poisson : manifolds.PoissonStructure
    energy, entropy : Energy
        Callable on states of shape (..., n), an energy that depends on time on a state and a time. ``entropy`` is None
        for a system without one.
    dissipation : Dissipation or None
    momentum_maps : dict of Energy
        Further functions that are claimed to be conserved, by name.
    dim : int
        Number of state components.
    space : manifolds.Space or None
        The state space, where it is not R^n.
    """

    @with_library_settings
    def _build(
        self, poisson, dim, energy, entropy, dissipation, momentum_maps, validate, space=None, baths=None
    ) -> None:
        """Check and set the common attributes; constructors of subclasses call it after they have set their own."""
        if not isinstance(baths, HeatBaths | None):
            raise InputError(f"baths are lt.HeatBaths(...), not {type(baths).__name__}")
        self.dim, self.space = dim, space
        self.poisson = trace_callables(poisson, lambda poisson, x: poisson.sharp(x, x), (dim,))
        self.energy = checked_energy(
            self.energy_of_vectors(make_energy(energy, "the energy")), dim, "the energy", allow_time=True
        )
        self.entropy = None
        if entropy is not None:
            self.entropy = checked_energy(
                self.energy_of_vectors(make_energy(entropy, "the entropy")), dim, "the entropy"
            )
        momentum_maps = name_momentum_maps(momentum_maps)
        roles = {name: f"momentum map {name!r}" for name in momentum_maps}
        self.momentum_maps = {
            name: checked_energy(self.energy_of_vectors(make_energy(J, roles[name])), dim, roles[name])
            for name, J in momentum_maps.items()
        }
        if space is None:  # in a chart no function is quadratic
            self.energy = with_polynomial_degrees(self.energy, dim)
            self.entropy = None if self.entropy is None else with_polynomial_degrees(self.entropy, dim)
            self.momentum_maps = {name: with_polynomial_degrees(J, dim) for name, J in self.momentum_maps.items()}
        dissipation = sum_dissipations(dissipation)
        bath_terms: tuple[Dissipation, ...] = ()
        if dissipation is not None:

            def drives_baths(term: Dissipation) -> bool:
                return term.acts_on_baths_alone or (self.entropy is None and term.needs_entropy)

            bath_terms = tuple(term for term in dissipation.terms if drives_baths(term))
            dissipation = sum_dissipations([term for term in dissipation.terms if not drives_baths(term)] or None)
        for term in bath_terms:
            if baths is None and term.acts_on_baths_alone:
                raise InputError(f"{type(term).__name__} acts on baths: give the system baths=lt.HeatBaths(...)")
            if baths is None:
                raise InputError(f"{type(term).__name__} drives the entropy up, so the system needs an entropy")
            if not term.can_drive_baths:
                raise InputError(
                    f"{type(term).__name__} drives the entropy of the body up, which it needs beside the entropies of "
                    "its baths: give entropy="
                )
        self.dissipation = None
        if dissipation is not None:
            dissipation = flatten_site_functions(dissipation, self.shape)
            self.dissipation = self._bind_dissipation(dissipation)
        if baths is not None:
            self._attach_baths(baths, bath_terms)
        if self.preserved and not is_traced(self):
            self.preserved_labels = self._find_preserved_names()
        if validate and not is_traced(self):
            self._validate()

    def _bind_dissipation(self, dissipation: Dissipation) -> Dissipation:
        dissipation = trace_energies(dissipation, self.dim, "a preserved function")
        return self._trace_dissipation(dissipation.bind_to(self))

    def _attach_baths(self, baths: HeatBaths, bath_terms: tuple[Dissipation, ...] = ()) -> None:
        """Append baths to this system, in place; the dissipations ``bath_terms`` act on the extended states."""
        body, n, m = copy(self), self.dim, baths.number
        if self.dissipation is not None or not bath_terms:
            self.dissipation = couple_to_baths(
                self.dissipation, body, m, baths.has_positive_temperatures, self._extend_from_body
            )
        if body.space is not None and body.space.dtype.kind == "c":
            raise InputError(f"baths are for real spaces, and {body.space.name} is complex")
        self.baths, self.dim = baths, n + m
        self.space = None if body.space is None else mf.Product(body.space, mf.Euclidean(m))
        self.poisson = poisson_with_baths(body.poisson, m)
        self.energy = BodyBathsEnergy(body.energy, baths.energy, n, self.dim)
        heat = BathEntropy(m)
        self.entropy = heat if body.entropy is None else self._extend_from_body(body.entropy) + heat
        self.momentum_maps = {name: self._extend_from_body(J) for name, J in body.momentum_maps.items()}
        if bath_terms:
            bound_terms = tuple(self._bind_dissipation(term) for term in bath_terms)
            self.dissipation = sum_dissipations([d for d in (self.dissipation, *bound_terms) if d is not None])

    def drop_baths(self) -> System:
        if self.baths is None:
            return self
        assert isinstance(self.poisson, ProductPoisson)
        body = copy(self)
        attributes = {
            "dim": self.body_dim,
            "space": None if self.space is None else _drop_last_factor(self.space),
            "poisson": self.poisson.first,
            "energy": self.energy.body if isinstance(self.energy, BodyBathsEnergy) else self.energy,
            "baths": None,
        }
        for name, value in attributes.items():
            object.__setattr__(body, name, value)
        return body

    def _extend_from_body(self, energy: Energy) -> Energy:
        """Return a function of states with baths from a function of states of the body."""
        return energy.on(range(self.body_dim))

    @with_library_settings
    def temperatures(self, x, t=None) -> jax.Array:
        """Return the temperatures of the baths, shape (..., number of baths), for states of shape (..., n).

        Temperatures that are functions of the time are those at the times t, shape (...).
        """
        if self.baths is None:
            raise InputError("this system has no baths: give it baths=lt.HeatBaths(...)")
        entropies, energy = jnp.asarray(x)[..., self.body_dim :], self.baths.energy
        if not energy.depends_on_time:
            return jnp.vectorize(energy.gradient, signature="(m)->(m)")(entropies)
        if t is None:
            raise InputError("a temperature of these baths depends on the time: give the times beside the states")
        evaluate = jnp.vectorize(lambda y, t: energy.at_time(t).gradient(y), signature="(m),()->(m)")
        return evaluate(entropies, jnp.asarray(t, dtype=jnp.float64))

    def energy_of_vectors(self, energy: Energy) -> Energy:
        """Return a function of flat states from a function of states in the shape that users see."""
        return energy_of_vectors(flatten_site_functions(energy, self.shape), self.space)

    def _trace_dissipation(self, dissipation: Dissipation) -> Dissipation:
        """Return the dissipation with its plain functions traced for the arguments that its force passes to them."""

        def force(dissipation, x):
            return dissipation.force(self, x, x, x, (x,) * len(dissipation.preserve))

        return trace_callables(dissipation, force, (self.dim,), is_leaf=lambda part: isinstance(part, Energy))

    # -- dynamics -------------------------------------------------------------------------------------------------

    def vector_field(self, x, t=None) -> jax.Array:
        """Return ``x'`` at states x, shape (..., n), and at the time t if the energy depends on it."""
        return self.evaluate_batch(lambda system, y: system._vector_field(y), x, t, "(n)")

    def entropy_production(self, x, t=None) -> jax.Array:
        """Return the rate of growth of the entropy, ``grad S . x'``, shape (...), at states x and the time t."""
        entropy = self._require_entropy()
        return self.evaluate_batch(lambda system, y: jnp.dot(entropy.gradient(y), system._vector_field(y)), x, t, "()")

    def energy_fall(self, x, t=None) -> jax.Array:
        """Return the rate at which the dissipation lowers the energy, ``-grad H . force``, shape (...), at x and t."""

        def fall_rate(system: System, y):
            if system.dissipation is None:
                return jnp.zeros(())
            dH = system.energy.gradient(y)
            dS = None if system.entropy is None else system.entropy.gradient(y)
            return -system.dissipation.rate_of_change(system, y, dH, dS, system._preserved_gradients(y), dH)

        return self.evaluate_batch(fall_rate, x, t, "()")

    @with_library_settings
    def friction_matrix(self, x, t=None, dissipation: Dissipation | None = None) -> jax.Array:
        """Return the matrix K(x) of the symmetric bracket, shape (n, n), for which the force is ``K(x) grad S``.

        By default the dissipation is that of the system; it may be another, such as one of its summands.
        """
        x, system = self.state(x), self if t is None else self.at_time(t)
        dissipation = self.dissipation if dissipation is None else dissipation
        if dissipation is None:
            return jnp.zeros((self.dim, self.dim))
        dH, dL = system.energy.gradient(x), tuple(L.gradient(x) for L in dissipation.preserve)
        return jax.jacfwd(lambda dS: dissipation.force(system, x, dH, dS, dL))(jnp.zeros(self.dim))

    def transport(self, x, dH, dS, dL=()) -> jax.Array:
        """Return the covector that transports the state, ``x' = Pi(x) transport`` without torques.

        It is dH plus the velocities of the dissipations [:meth:`liethermo.Dissipation.velocity`], for the body without
        baths; the gradients are continuous or discrete. On a Lie algebra an attitude follows it:
        ``g' = g hat(transport)``.
        """
        total = dH[: self.body_dim]
        for sigma in self._dissipation_velocities(x, dH, dS, dL):
            total = total if sigma is None else total + sigma
        return total

    @property
    def is_torque_free(self) -> bool:
        """True if ``x' = Pi(x) transport``, so that on a Lie algebra the momentum in space is constant."""
        answers: list[bool] = []

        def record_answer(x):
            velocities = self._dissipation_velocities(x, x, x, (x,) * len(self.preserved))
            answers.append(all(sigma is not None for sigma in velocities))

        jax.eval_shape(record_answer, jax.ShapeDtypeStruct((self.dim,), jnp.float64))
        return answers[0]

    def _dissipation_velocities(self, x, dH, dS, dL) -> list[jax.Array | None]:
        """Return the velocity of each dissipation; None for a dissipation that acts as a torque."""
        terms = () if self.dissipation is None else terms_with_preserved_values(self.dissipation, dL)
        return [term.velocity(self, x, dH, dS, term_dL) for term, term_dL in terms]

    # -- time -------------------------------------------------------------------------------------------------------

    @property
    def is_driven(self) -> bool:
        """True if the energy depends on time, or a torque acts, so that work is done from outside."""
        return self.energy.depends_on_time

    def at_time(self, t) -> System:
        """Return the system with its energy frozen at the time t; itself if it does not depend on time."""
        return eqx.tree_at(lambda system: system.energy, self, self.energy.at_time(t)) if self.is_driven else self

    def systems_at_test_times(self) -> list[System]:
        """Return the system frozen at each of :data:`TEST_TIMES`."""
        return [self.at_time(t) for t in TEST_TIMES]

    @with_library_settings
    def evaluate_batch(self, function: Callable, x, t, result_signature: str) -> jax.Array:
        """Return ``function(system, x)`` for each state of a batch, with the system frozen at the time t of that state.

        Parameters
        ----------
        result_signature : str
            The shape of one result, as in ``"(n)"``.

        Raises
        ------
        InputError
            If a time is needed and none is given.
        """
        x = self.state(x, batch=True)
        if not self.is_driven:
            return jnp.vectorize(lambda y: function(self, y), signature=f"(n)->{result_signature}")(x)
        if t is None:
            what = "energy of this system depends on" if self.energy.depends_on_time else "torque is known at a"
            raise InputError(f"the {what} time: give the time beside the state")
        evaluate = jnp.vectorize(lambda y, t: function(self.at_time(t), y), signature=f"(n),()->{result_signature}")
        return evaluate(x, jnp.asarray(t, dtype=jnp.float64))

    # -- other forms of the same system -------------------------------------------------------------------------------

    def local_system(self, x, is_centred: bool = False) -> tuple[System, jax.Array]:
        """Return this system in local coordinates near a state, and the coordinates of that state.

        With ``is_centred`` the local system is for use at that state alone.
        """
        return self, x

    def solved_subsystem(self, x) -> tuple[System, jax.Array]:
        """Return the sub-system and the part of a state that the equations of a step are solved for.

        Slopes and errors have its dimension. The other components follow from it, and have tolerances of their own.
        """
        return self, x

    def reorder_components(self) -> ReorderedSystem | None:
        """Return this system with its components in the order that is fastest for large states; None if it has none."""
        return None

    def system_of_step(self, x) -> System:
        """Return the system for a step that starts at x, shape (n,).

        Functions of time that jump at the end of this step have their limits from before, and those that jump at its
        start their limits from after.

        Parameters
        ----------
        x : array, shape (n,)
        """
        return self

    @property
    def energy_jumps(self) -> bool:
        """True if the energy may jump at a break of the span."""
        return False

    def add_jump_of_energy(self, x, amount) -> jax.Array:
        """Return x with a jump of the energy added to the work, if a step from x starts at a break.

        Parameters
        ----------
        x : array, shape (n,)
        amount : array, shape ()
            Energy after the jump minus the energy before.
        """
        return x

    def error_of_step(self, x, error, mean_slope) -> jax.Array:
        """Return the error of a step from x, over its size, with the error of the work as one of the state, shape (n,).

        A step that is corrected onto the level of the energy less the work moves the state by the error of the work.

        Parameters
        ----------
        x : array, shape (n,)
        error, mean_slope : array, shape (n,)
            Estimated error and displacement of the step, both over its size.
        """
        return error

    def clock_components(self, v) -> jax.Array:
        """Return v, shape (n,), with zeros in all components but those that only count: a clock, and the work done."""
        return jnp.zeros_like(v)

    def to_user_solution(self, solution: Any) -> Any:
        """Return a solution in the form that the user sees."""
        return self.reshape_to_sites(solution)

    def reshape_to_sites(self, result: Any) -> Any:
        """Return ``result``, a solution or an ensemble, with its states, shape (..., n), as arrays (..., *sites, d)."""
        if not self.sites:
            return result
        states = {name: value for name in result.state_fields if (value := getattr(result, name)) is not None}
        reshaped = {name: value.reshape(*value.shape[:-1], *self.shape) for name, value in states.items()}
        return dataclasses.replace(result, **reshaped)

    def freeze_at(self, x) -> System:
        """Return the system for use at one state, with the common parts of Pi and K computed once."""
        return self

    # -- functions and laws -------------------------------------------------------------------------------------------

    @property
    def preserved(self) -> tuple[Energy, ...]:
        """Functions that the dissipation, or one of its summands, has to preserve beside the energy."""
        return () if self.dissipation is None else self.dissipation.preserve

    def functions(self) -> dict[str, Energy]:
        """Return momentum maps, functions that the dissipation preserves, and Casimirs, by name, each quantity once."""
        casimirs, preserved = self.casimirs(), dict[str, Energy]()
        for name, L in zip(self.preserved_names, self.preserved, strict=True):
            if name not in self.momentum_maps and name not in preserved:
                preserved[name] = L
        return self.momentum_maps | preserved | casimirs

    @property
    def preserved_names(self) -> tuple[str, ...]:
        """Names of the functions :attr:`preserved` among :meth:`functions`."""
        return tuple(self.preserved_by_name()) if self.preserved_labels is None else self.preserved_labels

    def preserved_by_name(self) -> dict[str, Energy]:
        """Return the functions :attr:`preserved` by numbered names."""
        return {f"preserved {i + 1}": L for i, L in enumerate(self.preserved)}

    def _find_preserved_names(self) -> tuple[str, ...]:
        """Return names of the preserved functions: of the map or Casimir that each is a multiple of, or new ones."""
        functions = self.functions_for_naming()
        gradients = evaluate_at_points(stack_gradients, functions, self.test_states(2))  # shape (points, functions, n)
        return self.names_from_multiples(first_multiple_indices(gradients, len(self.preserved)).tolist())

    def functions_for_naming(self) -> tuple[Energy, ...]:
        """Return momentum maps and Casimirs, followed by the preserved functions, which may be multiples of them."""
        return (*(self.momentum_maps | self.casimirs()).values(), *self.preserved)

    def test_states(self, count: int) -> np.ndarray:
        """Return random states at which functions are compared, ``count`` of each of :data:`TEST_STATE_SCALES`."""
        return np.concatenate([self.samples(count, seed, scale) for seed, scale in enumerate(TEST_STATE_SCALES)])

    def names_from_multiples(self, multiples: Sequence[int]) -> tuple[str, ...]:
        """Return the name of each preserved function: that of the function it is a multiple of, or its own.

        Parameters
        ----------
        multiples : sequence of int
            For each preserved function, the index in :meth:`functions_for_naming` of an earlier function of which it is
            a multiple; -1 if there is none.
        """
        names, reserved = list(self.momentum_maps | self.casimirs()), {"energy", "entropy"}
        n_named = len(names)
        for multiple, (fallback, L) in zip(multiples, self.preserved_by_name().items(), strict=True):
            name = function_name(L)
            usable = name.isidentifier() and name not in {*names, *reserved}
            names.append(names[multiple] if multiple >= 0 else name if usable else fallback)
        return tuple(names[n_named:])

    @with_library_settings
    def first_integrals(self) -> frozenset[str]:
        """Return the names of the functions that the system conserves.

        Momentum maps are claimed to be conserved. A Casimir is conserved if the dissipation conserves it. A function
        that one dissipation has to preserve is conserved if the motion and the other summands conserve it. If no
        construction implies conservation, the function is tested at random states; it is left out while JAX traces the
        system. If the test cannot decide, a function that the dissipation has to preserve counts as conserved.
        """
        return self._find_invariants().conserved_names

    @with_library_settings
    def undecided_functions(self) -> frozenset[str]:
        """Return the names of the functions for which the test of conservation could not decide.

        The vector field could be evaluated at none of the test states, for example because the entropy is defined for
        few states.
        """
        return self._find_invariants(include_declared=False).undecided_names

    def resolve_invariants_near(self, x) -> System:
        """Return this system with the undecided functions tested near states in its domain.

        Parameters
        ----------
        x : array, shape (n,) or (m, n)
        """
        if self.invariant_verdicts is not None or is_traced(self) or not self.undecided_functions():
            return self
        resolved = copy(self)
        verdicts = self._find_invariants(near=np.asarray(self.state(x, batch=True)))
        object.__setattr__(resolved, "invariant_verdicts", verdicts)
        return resolved

    def _find_invariants(self, near=None, include_declared: bool = True) -> InvariantVerdicts:
        """Return which functions are conserved; ``include_declared`` adds preserved ones unless a test refutes them."""
        if self.invariant_verdicts is not None:
            return self.invariant_verdicts
        verdicts = _memoized_verdicts(self) if near is None else self._conservation_verdicts(near)
        return InvariantVerdicts.from_verdicts(verdicts, self.preserved_names if include_declared else ())

    def _conservation_verdicts(self, near=None) -> dict[str, bool | None]:
        """Return whether each function is conserved, by construction or by a test; None if undecided."""
        claimed, torque_free = self.invariants_by_construction(), self.torque_invariant_casimirs
        unclaimed = {name: f for name, f in self.functions().items() if name not in claimed}
        # a test says nothing of functions that a torque changes: the torque may be zero at the tested times only
        testable = {name: f for name, f in unclaimed.items() if not self.torque_name or name in torque_free}
        with jax.ensure_compile_time_eval():  # JAX may be tracing something else
            verdicts = [False] * len(testable) if is_traced(self) else self.conserves(tuple(testable.values()), near)
        tested = dict(zip(testable, verdicts, strict=True))
        return dict.fromkeys(unclaimed, False) | tested | dict.fromkeys(claimed, True)

    def invariants_by_construction(self) -> frozenset[str]:
        """Return the names of the functions that are conserved by construction and need no test."""
        by_form = self.dissipation is None or self.dissipation.preserves_casimirs
        return frozenset({*self.momentum_maps, *(self.torque_invariant_casimirs if by_form else ())})

    def invariants(self) -> dict[str, tuple[Energy, bool | None]]:
        """Return functions to record along a run, by name, each with whether it is conserved; None if not known."""
        verdicts = self._find_invariants()
        return {
            name: (function, None if name in verdicts.undecided_names else name in verdicts.conserved_names)
            for name, function in self.functions().items()
        }

    def conserves(self, functions: tuple[Energy, ...], near: np.ndarray | None = None) -> list[bool | None]:
        """Return whether each function is constant along the vector field, at random states of several scales.

        The motion and every dissipation must each conserve the function, relative to their own size, however slow a
        dissipation is; otherwise their changes must cancel.

        Parameters
        ----------
        near : array, shape (n,) or (m, n), optional
            States inside the domain: states near them are tested too.

        Returns
        -------
        list of bool or None
            None if the rate of change could be evaluated at no state.
        """
        if not functions:
            return []
        if self.is_driven:
            by_time = [system.conserves(functions, near) for system in self.systems_at_test_times()]
            return [False if False in v else None if None in v else True for v in zip(*by_time, strict=True)]
        points = self.test_states(self.test_states_per_scale)
        if near is not None:
            points = np.concatenate([points, self.states_near(near)])
        rates = evaluate_at_points(rates_of_change, (self, functions), points)
        is_defined, is_conserved = judge_conservation(rates)  # shapes (points, functions)
        by_function = zip(is_defined.T, is_conserved.T, strict=True)
        return [bool(conserved[defined].all()) if defined.any() else None for defined, conserved in by_function]

    @property
    def test_states_per_scale(self) -> int:
        """Number of random states of each scale at which conservation is tested."""
        return 4 if self.dim <= LARGE_STATE_DIM else 1

    def states_near(self, x) -> np.ndarray:
        """Return a few of the states x, shape (m, n), and on R^n states around them at decreasing distances."""
        x = np.reshape(np.asarray(x), (-1, self.dim))[:N_NEARBY_STATES]
        if self.space is not None:
            return x
        random = np.random.default_rng(0).standard_normal((len(NEARBY_RADII), *x.shape))
        lengths = np.linalg.norm(x, axis=1, keepdims=True) / np.sqrt(self.dim)
        return np.concatenate([x, *(x + radius * lengths * w for radius, w in zip(NEARBY_RADII, random, strict=True))])

    # -- checks ---------------------------------------------------------------------------------------------------

    def state(self, x, batch: bool = False) -> jax.Array:
        """Return ``x`` as a state of this system: real doubles, finite, shape (n,), or (..., n) with ``batch``.

        For a system on sites x may have the shape ``(*sites, d)``. On a manifold x may have the shape of points,
        and must be a point of it.

        Raises
        ------
        InputError, manifolds.OffManifoldError
        """
        numbers = self.state_array(x, batch)
        return numbers.astype(jnp.float64) if isinstance(numbers, jax.core.Tracer) else real_array(numbers)

    def state_array(self, x, batch: bool = False) -> np.ndarray | jax.Array:
        """Return the state x as :meth:`state` does, as an array of NumPy unless JAX traces it."""
        if not isinstance(x, jax.Array):
            try:
                x = np.asarray(x)
            except (TypeError, ValueError) as error:
                raise InputError(f"a state is a rectangular array of real numbers: {error}") from None
            if x.dtype.kind not in "fiubc":
                raise InputError(f"a state is an array of real numbers, not of {x.dtype}")
        if self.space is not None and x.shape[-len(self.space.shape) :] == self.space.shape:
            x = self.space.to_vector(x)
        if self.sites and x.shape[-len(self.shape) :] == self.shape:
            x = x.reshape(*x.shape[: -len(self.shape)], self.dim)
        if self.baths is not None and x.shape[-1:] != (self.dim,):
            x = self._append_bath_entropies(x)
        if jnp.iscomplexobj(x):
            raise InputError(f"a state is real, not {x.dtype}; take the real part if that is meant")
        if x.shape[-1:] != (self.dim,) or (x.ndim > 1 and not batch):
            expected = f"(..., {self.dim})" if batch else f"({self.dim},)"
            if self.sites:
                shown = ", ".join([*(["..."] if batch else []), *map(str, self.shape)])
                expected = f"({shown}), or flat {expected}"
            raise InputError(f"a state of this system has shape {expected}, not {x.shape}")
        if isinstance(x, jax.core.Tracer):
            return x
        numbers = np.asarray(x, dtype=np.float64)
        if not np.isfinite(numbers).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(numbers))[0])
            raise InputError(f"the state is not finite: component {where} is {numbers[where]}")
        if self.space is not None:
            self.space.point(self.points(numbers))
        return numbers

    def _append_bath_entropies(self, x) -> np.ndarray | jax.Array:
        """Append zero entropies of the baths to a state of the body; return any other array unchanged."""
        body = self.drop_baths()
        shape = body.shape if body.space is None else body.space.shape
        if shape == (1, 3) and x.shape == (3,):
            x = x[None]
        if x.shape[-len(shape) :] == shape:
            vectors = x.reshape(*x.shape[: -len(shape)], -1) if body.space is None else body.space.to_vector(x)
        elif x.shape[-1:] == (body.dim,):
            vectors = x
        else:
            return x
        zeros = np.zeros((*vectors.shape[:-1], self.dim - body.dim))
        return (jnp if isinstance(x, jax.Array) else np).concatenate([vectors, zeros], axis=-1)

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

    def _validate(self) -> None:
        """Raise an error if an axiom fails at random states; the constructors call it."""
        for row in check_system(self, None, 4, 0, 1.0, matrices=not self.has_poisson_by_construction).rows:
            if row.passed is not False:
                continue
            kind = CasimirError if row.axiom == "Pi grad S = 0" else AxiomError
            raise kind(
                f"{row.axiom} fails: residual {row.residual:.3g}, tolerance {row.tolerance:.1g}. {row.note}".rstrip()
                + " (validate=False builds the system all the same)",
                residual=row.residual,
                tolerance=row.tolerance,
            )

    def _vector_field(self, x) -> jax.Array:
        if self.has_generator:
            return self.generator_field(x)
        dS = jnp.zeros_like(x) if self.entropy is None else self.entropy.gradient(x)
        gradients = self.energy.gradient(x), dS, *self._preserved_gradients(x)
        dH, dS, *dL = (
            alpha if self.space is None else self.lower_index(x, self.raise_index(x, alpha)) for alpha in gradients
        )
        return self.field(x, dH, dS, tuple(dL))

    def _preserved_gradients(self, x) -> tuple[jax.Array, ...]:
        return tuple(L.gradient(x) for L in self.preserved)

    def _require_entropy(self) -> Energy:
        if self.entropy is None:
            raise InputError("this system has no entropy")
        return self.entropy


def _drop_last_factor(space: mf.Space) -> mf.Space:
    """A product without its last factor."""
    assert isinstance(space, mf.Product)
    first, *others = space.factors[:-1]
    return mf.Product(first, *others) if others else first


@memoize
def _memoized_verdicts(system: System) -> dict[str, bool | None]:
    return system._conservation_verdicts()


def stack_gradients(functions: tuple[Energy, ...], x) -> jax.Array:
    """Return the gradients of several functions at a state, shape (functions, n)."""
    return jnp.stack([f.gradient(x) for f in functions])


def first_multiple_indices(gradients: np.ndarray, count: int) -> np.ndarray:
    """Return for each of the last ``count`` functions the first one before it of which it is a multiple, or -1.

    Parameters
    ----------
    gradients : array, shape (..., points, functions, n)

    Returns
    -------
    array of int, shape (..., count)
    """
    total = gradients.shape[-2]
    multiples = np.full((*gradients.shape[:-3], count), -1)
    for k, i in enumerate(range(total - count, total)):
        for j in reversed(range(i)):
            alike = is_proportional(gradients[..., i, :], gradients[..., j, :])
            multiples[..., k] = np.where(alike, j, multiples[..., k])
    return multiples


def name_momentum_maps(given) -> dict[str, Any]:
    """Return momentum maps by name, from a mapping or a sequence of functions."""
    if isinstance(given, Mapping):
        return dict(given)
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise InputError(f"momentum_maps are a dict of functions, or a sequence of them, not {type(given).__name__}")
    return {getattr(J, "__name__", f"J{i + 1}"): J for i, J in enumerate(given)}


__all__ = ["AXIOM_TOLERANCE", "System", "name_momentum_maps"]
