"""What every system has in common: ``x' = Pi(x) dH + force(x; dH, dS)`` and the laws that follow from it."""

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

from ..dissipation.base import Dissipation, sum_dissipations, terms_with_preserved
from ..dissipation.heating import couple_to_baths
from ..errors import AxiomError, CasimirError, InputError
from ..functions.checks import check_energy, mark_polynomial_degrees, trace_energies
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
"""Scales of the random points at which the system is asked which functions it conserves."""

LARGE_STATE_DIM = 2_000
"""Components of a state above which one point of each scale is enough."""

N_NEARBY_STATES, NEARBY_RADII = 4, (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4)
"""States near which it is asked too, and how near, relative to the size of a state."""


TEST_TIMES = (0.0, 0.7310585786300049, -1.618033988749895)
"""Times at which it is asked that of a system whose energy depends on time."""


class ReorderedSystem(NamedTuple):
    """A system with the components of its states in another order.

    Attributes
    ----------
    system : System
    reorder_state, restore_state : functions of states, shape (..., n)
        Into that order, and out of it.
    pullback : function from an Energy to an Energy
        A function of states, as one of states in that order.
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
        """Shared by the constructors of the subclasses, after they have set what is their own."""
        if not isinstance(baths, HeatBaths | None):
            raise InputError(f"baths are lt.HeatBaths(...), not {type(baths).__name__}")
        self.dim, self.space = dim, space
        self.poisson = trace_callables(poisson, lambda poisson, x: poisson.sharp(x, x), (dim,))
        self.energy = check_energy(
            self.energy_of_vectors(make_energy(energy, "the energy")), dim, "the energy", allow_time=True
        )
        self.entropy = None
        if entropy is not None:
            self.entropy = check_energy(self.energy_of_vectors(make_energy(entropy, "the entropy")), dim, "the entropy")
        momentum_maps = name_momentum_maps(momentum_maps)
        roles = {name: f"momentum map {name!r}" for name in momentum_maps}
        self.momentum_maps = {
            name: check_energy(self.energy_of_vectors(make_energy(J, roles[name])), dim, roles[name])
            for name, J in momentum_maps.items()
        }
        if space is None:  # in a chart no function is quadratic
            self.energy = mark_polynomial_degrees(self.energy, dim)
            self.entropy = None if self.entropy is None else mark_polynomial_degrees(self.entropy, dim)
            self.momentum_maps = {name: mark_polynomial_degrees(J, dim) for name, J in self.momentum_maps.items()}
        dissipation = sum_dissipations(dissipation)
        of_baths: tuple[Dissipation, ...] = ()
        if dissipation is not None and self.entropy is None:
            of_baths = tuple(part for part in dissipation.terms if part.needs_entropy)
            dissipation = sum_dissipations([part for part in dissipation.terms if not part.needs_entropy] or None)
        for part in of_baths:
            if baths is None:
                raise InputError(f"{type(part).__name__} drives the entropy up, so the system needs an entropy")
            if not part.can_drive_baths:
                raise InputError(
                    f"{type(part).__name__} drives the entropy of the body up, which it needs beside the entropies of "
                    "its baths: give entropy="
                )
        self.dissipation = None
        if dissipation is not None:
            dissipation = flatten_site_functions(dissipation, self.shape)
            self.dissipation = self._bind_dissipation(dissipation)
        if baths is not None:
            self._attach_baths(baths, of_baths)
        if self.preserved and not is_traced(self):
            self.preserved_labels = self._find_preserved_names()
        if validate and not is_traced(self):
            self._validate()

    def _bind_dissipation(self, dissipation: Dissipation) -> Dissipation:
        dissipation = trace_energies(dissipation, self.dim, "a preserved function")
        return self._trace_dissipation(dissipation.bind_to(self))

    def _attach_baths(self, baths: HeatBaths, of_baths: tuple[Dissipation, ...] = ()) -> None:
        """Put baths beside the body that this system has been so far; ``of_baths`` act on the states with baths."""
        body, n, m = copy(self), self.dim, baths.number
        if self.dissipation is not None or not of_baths:
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
        if of_baths:
            parts = tuple(self._bind_dissipation(part) for part in of_baths)
            self.dissipation = sum_dissipations([part for part in (self.dissipation, *parts) if part is not None])

    def drop_baths(self) -> System:
        if self.baths is None:
            return self
        assert isinstance(self.poisson, ProductPoisson)
        body = copy(self)
        parts = {
            "dim": self.body_dim,
            "space": None if self.space is None else _drop_last_factor(self.space),
            "poisson": self.poisson.first,
            "energy": self.energy.body if isinstance(self.energy, BodyBathsEnergy) else self.energy,
            "baths": None,
        }
        for name, part in parts.items():
            object.__setattr__(body, name, part)
        return body

    def _extend_from_body(self, energy: Energy) -> Energy:
        """A function of the state of the body, as one of that with baths."""
        return energy.on(range(self.body_dim))

    @with_library_settings
    def temperatures(self, x) -> jax.Array:
        """The temperatures of the baths: states of shape (..., n) give (..., number of baths)."""
        if self.baths is None:
            raise InputError("this system has no baths: give it baths=lt.HeatBaths(...)")
        entropies = jnp.asarray(x)[..., self.body_dim :]
        return jnp.vectorize(self.baths.energy.gradient, signature="(m)->(m)")(entropies)

    def energy_of_vectors(self, energy: Energy) -> Energy:
        """An energy of states as they are shown, as one of their vectors."""
        return energy_of_vectors(flatten_site_functions(energy, self.shape), self.space)

    def _trace_dissipation(self, dissipation: Dissipation) -> Dissipation:
        """The dissipation with its plain functions traced for the arguments that its force gives them."""

        def force(dissipation, x):
            return dissipation.force(self, x, x, x, (x,) * len(dissipation.preserve))

        return trace_callables(dissipation, force, (self.dim,), is_leaf=lambda part: isinstance(part, Energy))

    # -- dynamics -------------------------------------------------------------------------------------------------

    def vector_field(self, x, t=None) -> jax.Array:
        """``x'`` at a state or a batch of states, shape (..., n); at a time, where the energy depends on one."""
        return self.evaluate_batch(lambda system, y: system._vector_field(y), x, t, "(n)")

    def entropy_production(self, x, t=None) -> jax.Array:
        """The rate of growth of the entropy, ``grad S @ x'``, shape (...); at a time, likewise."""
        entropy = self._require_entropy()
        return self.evaluate_batch(lambda system, y: jnp.dot(entropy.gradient(y), system._vector_field(y)), x, t, "()")

    def energy_fall(self, x, t=None) -> jax.Array:
        """The rate at which the dissipation lowers the energy, ``-grad H . force``, shape (...); likewise."""

        def fall_rate(system: System, y):
            if system.dissipation is None:
                return jnp.zeros(())
            dH = system.energy.gradient(y)
            dS = None if system.entropy is None else system.entropy.gradient(y)
            return -system.dissipation.rate_of_change(system, y, dH, dS, system._preserved_gradients(y), dH)

        return self.evaluate_batch(fall_rate, x, t, "()")

    @with_library_settings
    def friction_matrix(self, x, t=None, dissipation: Dissipation | None = None) -> jax.Array:
        """The matrix K(x) of the symmetric bracket, shape (n, n), where the force is ``K(x) grad S``.

        The dissipation is that of the system, or another, such as one of its summands.
        """
        x, system = self.state(x), self if t is None else self.at_time(t)
        part = self.dissipation if dissipation is None else dissipation
        if part is None:
            return jnp.zeros((self.dim, self.dim))
        dH, dL = system.energy.gradient(x), tuple(L.gradient(x) for L in part.preserve)
        return jax.jacfwd(lambda dS: part.force(system, x, dH, dS, dL))(jnp.zeros(self.dim))

    def transport(self, x, dH, dS, dL=()) -> jax.Array:
        """The velocity that moves the state, ``x' = Pi(x) transport`` but for torques, for gradients of either kind.

        It is dH and what the dissipations add to it [:meth:`liethermo.Dissipation.velocity`], of the body without its
        baths. On a Lie algebra an attitude follows it, ``g' = g hat(transport)``.
        """
        total = dH[: self.body_dim]
        for sigma in self._dissipation_velocities(x, dH, dS, dL):
            total = total if sigma is None else total + sigma
        return total

    @property
    def is_torque_free(self) -> bool:
        """Whether the motion is all ``Pi(x) transport``: on a Lie algebra the momentum in space is then constant."""
        found: list[bool] = []

        def record_answer(x):
            velocities = self._dissipation_velocities(x, x, x, (x,) * len(self.preserved))
            found.append(all(sigma is not None for sigma in velocities))

        jax.eval_shape(record_answer, jax.ShapeDtypeStruct((self.dim,), jnp.float64))
        return found[0]

    def _dissipation_velocities(self, x, dH, dS, dL) -> list[jax.Array | None]:
        """Those of the dissipations, None where one is a torque."""
        parts = () if self.dissipation is None else terms_with_preserved(self.dissipation, dL)
        return [part.velocity(self, x, dH, dS, own) for part, own in parts]

    # -- time -------------------------------------------------------------------------------------------------------

    @property
    def is_driven(self) -> bool:
        """Whether the energy depends on time, or a torque acts, so that work is done from outside."""
        return self.energy.depends_on_time

    def at_time(self, t) -> System:
        """The system whose energy is for ever what it is at a time; itself where that does not depend on time."""
        return eqx.tree_at(lambda system: system.energy, self, self.energy.at_time(t)) if self.is_driven else self

    def systems_at_test_times(self) -> list[System]:
        """This system at a few times, for what is found out of one that is driven."""
        return [self.at_time(t) for t in TEST_TIMES]

    @with_library_settings
    def evaluate_batch(self, function: Callable, x, t, result_signature: str) -> jax.Array:
        """``function(system, x)`` for each state of a batch, the system as it is at the time t, or at each of several.

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
        at = jnp.vectorize(lambda y, t: function(self.at_time(t), y), signature=f"(n),()->{result_signature}")
        return at(x, jnp.asarray(t, dtype=jnp.float64))

    # -- other forms of the same system -------------------------------------------------------------------------------

    def local_system(self, x, is_centred: bool = False) -> tuple[System, jax.Array]:
        """This system near a state in as many coordinates as it has dimensions, and those of the state.

        With ``is_centred``, for use at that state alone.
        """
        return self, x

    def solved_part(self, x) -> tuple[System, jax.Array]:
        """The part of the system, and of a state, that a step is solved for; slopes and errors are of its size.

        The rest of the state follows from it, and no tolerance of the one is measured by the other.
        """
        return self, x

    def reorder_components(self) -> ReorderedSystem | None:
        """This system with its components in another order, in which programs for large states are faster, if any."""
        return None

    def clock_components(self, v) -> jax.Array:
        """Return v, shape (n,), with zeros in all components but those that only count: a clock, and the work done."""
        return jnp.zeros_like(v)

    def to_user_solution(self, solution: Any) -> Any:
        """A solution of this system, as its user is to see it."""
        return self.reshape_to_sites(solution)

    def reshape_to_sites(self, found: Any) -> Any:
        """A solution, or an ensemble, with its states, shape (..., n), as they are shown on sites."""
        if not self.sites:
            return found
        states = {name: value for name in found.state_fields if (value := getattr(found, name)) is not None}
        shown = {name: value.reshape(*value.shape[:-1], *self.shape) for name, value in states.items()}
        return dataclasses.replace(found, **shown)

    def freeze_at(self, x) -> System:
        """The same system, for use at one state: what its Pi and K have in common there is computed once."""
        return self

    # -- functions and laws -------------------------------------------------------------------------------------------

    @property
    def preserved(self) -> tuple[Energy, ...]:
        """The functions that the dissipation, or one of its summands, has to preserve besides the energy."""
        return () if self.dissipation is None else self.dissipation.preserve

    def functions(self) -> dict[str, Energy]:
        """Momentum maps, what the dissipation has to preserve, and Casimirs, by name; one name for one quantity."""
        casimirs, own = self.casimirs(), dict[str, Energy]()
        for name, L in zip(self.preserved_names, self.preserved, strict=True):
            if name not in self.momentum_maps and name not in own:
                own[name] = L
        return self.momentum_maps | own | casimirs

    @property
    def preserved_names(self) -> tuple[str, ...]:
        """What each of :attr:`preserved` is called among :meth:`functions`."""
        return tuple(self.preserved_by_name()) if self.preserved_labels is None else self.preserved_labels

    def preserved_by_name(self) -> dict[str, Energy]:
        """:attr:`preserved`, each with a key of its own."""
        return {f"preserved {i + 1}": L for i, L in enumerate(self.preserved)}

    def _find_preserved_names(self) -> tuple[str, ...]:
        """What is preserved, by the name of the momentum map or Casimir it is a multiple of, or by one of its own."""
        functions = self.functions_for_naming()
        gradients = evaluate_at_points(stack_gradients, functions, self.test_states(2))  # shape (points, functions, n)
        return self.names_from_multiples(first_multiple_indices(gradients, len(self.preserved)).tolist())

    def functions_for_naming(self) -> tuple[Energy, ...]:
        """Momentum maps and Casimirs, then what is preserved, which has the name of one of them if it is a multiple."""
        return (*(self.momentum_maps | self.casimirs()).values(), *self.preserved)

    def test_states(self, count: int) -> np.ndarray:
        """Random states at which functions are compared, shape (states, n), ``count`` of each of :data:`CONVEXITY_FORCE_SCALES`."""
        return np.concatenate([self.samples(count, seed, scale) for seed, scale in enumerate(TEST_STATE_SCALES)])

    def names_from_multiples(self, multiples: Sequence[int]) -> tuple[str, ...]:
        """The name of each of :attr:`preserved`: that of the function of which it is a multiple, or one of its own.

        Parameters
        ----------
        multiples : sequence of int
            For each, the place among :meth:`nameable` of a function before it of which it is a multiple; or -1.
        """
        names, taken = list(self.momentum_maps | self.casimirs()), {"energy", "entropy"}
        number = len(names)
        for multiple, (fallback, L) in zip(multiples, self.preserved_by_name().items(), strict=True):
            name = function_name(L)
            usable = name.isidentifier() and name not in {*names, *taken}
            names.append(names[multiple] if multiple >= 0 else name if usable else fallback)
        return tuple(names[number:])

    @with_library_settings
    def first_integrals(self) -> frozenset[str]:
        """The names of those of :meth:`functions` that the system conserves.

        Momentum maps are claimed to be conserved. A Casimir is conserved if the dissipation keeps it. A function that
        one dissipation has to preserve is conserved if the motion and the other summands keep it. If no construction
        says so, random points decide; while the system is being traced the function is left out. If random points
        cannot decide, a function that the dissipation has to preserve counts as conserved.
        """
        return self._find_invariants().conserved_names

    @with_library_settings
    def undecided_functions(self) -> frozenset[str]:
        """The names of those of :meth:`functions` of which it is not found out whether the system conserves them.

        At none of the points that were tried all of the motion could be evaluated, as where an entropy is defined for
        few states.
        """
        return self._find_invariants(include_declared=False).undecided_names

    def resolve_invariants_near(self, x) -> System:
        """This system, with what random points leave open found out near states that are in its domain.

        Parameters
        ----------
        x : array, shape (n,) or (m, n)
        """
        if self.invariant_verdicts is not None or is_traced(self) or not self.undecided_functions():
            return self
        found = copy(self)
        object.__setattr__(
            found, "invariant_verdicts", self._find_invariants(near=np.asarray(self.state(x, batch=True)))
        )
        return found

    def _find_invariants(self, near=None, include_declared: bool = True) -> InvariantVerdicts:
        """What it conserves; with ``include_declared``, what its dissipation has to preserve unless it is seen not to."""
        if self.invariant_verdicts is not None:
            return self.invariant_verdicts
        verdicts = _memoized_verdicts(self) if near is None else self._conservation_verdicts(near)
        return InvariantVerdicts.from_verdicts(verdicts, self.preserved_names if include_declared else ())

    def _conservation_verdicts(self, near=None) -> dict[str, bool | None]:
        """Whether it conserves each of its functions: by construction, or at random points."""
        claimed, untouched = self.invariants_by_construction(), self.torque_invariant_casimirs
        others = {name: f for name, f in self.functions().items() if name not in claimed}
        # points decide, but not of what a torque acts on: one that is zero at some times tells nothing of others
        open_ = {name: f for name, f in others.items() if not self.torque_name or name in untouched}
        with jax.ensure_compile_time_eval():  # this may be asked while something else is traced
            kept = [False] * len(open_) if is_traced(self) else self.conserves(tuple(open_.values()), near)
        return dict.fromkeys(others, False) | dict(zip(open_, kept, strict=True)) | dict.fromkeys(claimed, True)

    def invariants_by_construction(self) -> frozenset[str]:
        """The names of the functions that it conserves by construction: nothing has to be tried out."""
        by_form = self.dissipation is None or self.dissipation.preserves_casimirs
        return frozenset({*self.momentum_maps, *(self.torque_invariant_casimirs if by_form else ())})

    def invariants(self) -> dict[str, tuple[Energy, bool | None]]:
        """Functions worth recording along a run, by name, each with whether it is conserved; None where not known."""
        found = self._find_invariants()
        verdicts = {
            name: None if name in found.undecided_names else name in found.conserved_names for name in self.functions()
        }
        return {name: (function, verdicts[name]) for name, function in self.functions().items()}

    def conserves(self, functions: tuple[Energy, ...], near: np.ndarray | None = None) -> list[bool | None]:
        """Whether each function is constant along the vector field, at random points inside its domain.

        The motion and each dissipation have to keep it, each judged by its own size: a friction 1e12 times as slow as
        the motion is a friction still. Or else what one makes of it, another takes back. Points are of several scales.

        Parameters
        ----------
        near : array, shape (n,) or (m, n), optional
            States that are inside the domain: points near them are tried too.

        Returns
        -------
        list of bool or None
            None where it could be evaluated at no point: then it is not known.
        """
        if not functions:
            return []
        if self.is_driven:
            found = [system.conserves(functions, near) for system in self.systems_at_test_times()]
            return [False if False in kept else None if None in kept else True for kept in zip(*found, strict=True)]
        points = self.test_states(self.test_states_per_scale)
        if near is not None:
            points = np.concatenate([points, self.states_near(near)])
        defined, conserved = judge_conservation(
            evaluate_at_points(rates_of_change, (self, functions), points)
        )  # shapes (points, functions)
        pairs = zip(defined.T, conserved.T, strict=True)
        return [bool(kept[inside].all()) if inside.any() else None for inside, kept in pairs]

    @property
    def test_states_per_scale(self) -> int:
        """At how many random states of each scale it is judged whether a function is conserved."""
        return 4 if self.dim <= LARGE_STATE_DIM else 1

    def states_near(self, x) -> np.ndarray:
        """Some of the states x, shape (m, n), and on R^n points around them, ever nearer: they lie in most domains."""
        x = np.reshape(np.asarray(x), (-1, self.dim))[:N_NEARBY_STATES]
        if self.space is not None:
            return x
        random = np.random.default_rng(0).standard_normal((len(NEARBY_RADII), *x.shape))
        lengths = np.linalg.norm(x, axis=1, keepdims=True) / np.sqrt(self.dim)
        return np.concatenate([x, *(x + nearer * lengths * w for nearer, w in zip(NEARBY_RADII, random, strict=True))])

    # -- checks ---------------------------------------------------------------------------------------------------

    def state(self, x, batch: bool = False) -> jax.Array:
        """``x`` as a state of this system: real doubles, finite, shape (n,), or (..., n) with ``batch``.

        On sites it may have the shape ``(*sites, d)`` too. On a manifold it may have the shape of points, and has to be
        one.

        Raises
        ------
        InputError, manifolds.OffManifoldError
        """
        numbers = self.state_array(x, batch)
        return numbers.astype(jnp.float64) if isinstance(numbers, jax.core.Tracer) else real_array(numbers)

    def state_array(self, x, batch: bool = False) -> np.ndarray | jax.Array:
        """What :meth:`state` makes of x, as an array of NumPy where its values are known."""
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
        """A state of the body alone, with every bath at entropy zero; another array as it is."""
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
        """Raise where an axiom fails at random points: called by the constructors, so that no bad system exists."""
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
    """The gradients of several functions at a state, shape (functions, n)."""
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
    """Momentum maps by name."""
    if isinstance(given, Mapping):
        return dict(given)
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise InputError(f"momentum_maps are a dict of functions, or a sequence of them, not {type(given).__name__}")
    return {getattr(J, "__name__", f"J{i + 1}"): J for i, J in enumerate(given)}


__all__ = ["AXIOM_TOLERANCE", "System", "name_momentum_maps"]
