"""``ComposedSystem``: bodies with entropies of their own that exchange momentum, heat and matter [SML §5]."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.structures.poisson import StateIndices

from ...dissipation.base import Dissipation, nondecreasing_law_if
from ...dissipation.bodies import (
    ContactFriction,
    Drag,
    HeatConduction,
    LinearFriction,
    MatterExchange,
    Process,
    conserved_number_combinations,
)
from ...errors import InputError
from ...functions.checks import checked_energy, traced_function_and_shape
from ...functions.edges import Edges, connected_component_labels, graph_edges
from ...functions.energy import Energy, Function, Quadratic, TimeDependent
from ...functions.indices import pattern_of_matrix, sparsity_pattern, union_pattern
from ...functions.mechanics import is_independent_of, is_mechanical_energy
from ...functions.time_span import ConstantFunction, LastArgumentIgnored, required_argument_count
from ..base import System, name_momentum_maps
from ..domain import Domain
from ..evolution import entropy_component
from ..interface import SparseNewton
from ..states import evaluate_batch
from .bodies import Copies, Membrane, Reaction, Subsystem, name_subsystems


class ComposedSystem(System):
    """Bodies with states (q, p, S), coupled by a potential, heat conduction and friction [SML §5, Examples 2-4].

    ``q_a' = H_{p_a}``, ``p_a' = -H_{q_a}`` and friction, ``S_a' = sum_b k_ab (T_b - T_a) / T_a`` and the heat of
    friction, with ``H = sum_a H_a(q_a, p_a, S_a) + V(q, S)`` and temperatures ``T_a = H_{S_a}``. The state is
    (q_1, p_1, S_1, q_2, …). H is constant; the entropy is the sum of the S_a and does not fall. Bodies may hold matter
    too, ``mu = H_N``, that passes membranes and reacts; the numbers that no process changes are constants of motion.

    Discretisations evaluate the Fourier factors ``K_ab = k_ab (1/T_a - 1/T_b)`` and the heat of friction with discrete
    temperatures and velocities, the components of the discrete gradient. So conduction alone gives
    ``S' - S = h sum_{a<b} k_ab (T_a - T_b)^2 / (T_a T_b) >= 0`` for every H, where SML Lemma 6.2 asks for a quadratic
    one. Linear friction has the same law. If a temperature is not positive in a step, the run stops with a status that
    says so. (Contact friction is the exception: see :class:`EvolutionSystem` for what it asks of H_a.)

    Networks of 1e5 bodies are made of :class:`Copies`, with :class:`liethermo.Each` as the potential of what joins
    them. A step then costs as much as there are bodies and edges; a stiff one is solved by sparse Newton iteration.

    Parameters
    ----------
    subsystems : sequence of Subsystem or Copies, or dict of them by name
        The bodies.
    coupling : function of q, of (q, S) or of (q, S, t), or an Energy of the whole state; or a sequence of such
        V, with q the positions of all subsystems in one array and S their entropies, shape (N,). Where bodies hold
        matter a function of three arguments is one of (q, S, N), all their particle numbers in one array. An Energy may
        have coordinates of its own (``lt.Function(e).on(...)``), such as the squared distance of two bodies.
    conductance : array, shape (N, N), or SciPy sparse matrix; or sequence of (i, j, k); or a number for two bodies
        Symmetric and >= 0 (power / temperature). In an edge, or for two bodies, it may be a function of the two
        temperatures (T_i, T_j), or of (T_i, T_j, x) with the whole state x, symmetric under exchange of the bodies; a
        step on which it is negative is refused.
    drag : array, shape (N, N), or SciPy sparse matrix; or sequence of (i, j, c); or a number for two bodies
        Coefficients c of friction between bodies with equally many degrees of freedom, ``-c_ij (v_i - v_j)`` on i, each
        heated by half (mass / time).
    conduction : {"discrete", "midpoint"}
        Fourier factors by the discrete temperatures, so that the entropy grows in each step for every energy, or by the
        temperatures at the midpoint, as SML §6.2 prints them: then it is known to grow for quadratic energies alone,
        and no law of it is stated.
    membranes, reactions : sequence of Membrane, sequence of Reaction
        The membranes that particles pass, and the reactions within bodies.
    connected : bool
        Refuse a conductance whose graph falls into parts that exchange no heat.
    momentum_maps, validate : dict of functions, or a sequence of them; bool
        Conserved quantities of a symmetry, functions of the state; and whether to test the axioms at a few random
        points. Use ``system.check(points=...)`` instead if an energy is not defined at normally distributed points.

    Raises
    ------
    AxiomError, FunctionError, InputError
        If an axiom fails, or a function or an argument does not fit.

    Attributes
    ----------
    poisson : manifolds.ExtendedPhaseSpace
        ``poisson.state_indices`` has the indices of all q, p and S in a state.
    subsystems, names : tuple of Subsystem or Copies, tuple of str
        The bodies and their names.
    """

    poisson: mf.ExtendedPhaseSpace
    subsystems: tuple[Subsystem | Copies, ...]
    labels: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        subsystems: Sequence[Subsystem | Copies] | Mapping[str, Subsystem | Copies] | Copies,
        coupling=None,
        conductance=None,
        drag=None,
        connected: bool = True,
        momentum_maps=(),
        validate: bool = True,
        conduction: Literal["discrete", "midpoint"] = "discrete",
        membranes: Sequence[Membrane] = (),
        reactions: Sequence[Reaction] = (),
    ):
        if conduction not in ("discrete", "midpoint"):
            raise InputError(f"conduction must be 'discrete' or 'midpoint', got {conduction!r}")
        self.labels, self.subsystems = name_subsystems(subsystems)
        dofs, kinds = (
            tuple(n for body in self.subsystems for n in (getattr(body, name),) * body.count)
            for name in ("degrees_of_freedom", "species")
        )
        structure = mf.ExtendedPhaseSpace(dofs, kinds if any(kinds) else ())
        energy = checked_energy(self._total_energy(structure, coupling), structure.dim, "the energy", allow_time=True)
        entropy = entropy_component(structure.dim, structure.state_indices.S)
        terms = self._make_dissipations(structure, energy, conductance, drag, connected, conduction)
        exchanges = [*(membranes if isinstance(membranes, list | tuple) else [membranes])]
        exchanges += [*(reactions if isinstance(reactions, list | tuple) else [reactions])]
        for item in exchanges:
            if not isinstance(item, Membrane | Reaction):
                raise InputError(
                    f"membranes and reactions must be lt.Membrane and lt.Reaction, got {type(item).__name__}"
                )
        processes = [item.make_process(self.names, structure) for item in exchanges]
        if processes:
            terms.append(MatterExchange(processes))
        momentum_maps = {**_particle_invariants(structure, processes), **name_momentum_maps(momentum_maps)}
        self._build(structure, structure.dim, energy, entropy, terms or None, momentum_maps, validate)

    # -- in parts -------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(
            name
            for label, body in zip(self.labels, self.subsystems, strict=True)
            for name in ([label] if isinstance(body, Subsystem) else [f"{label} {i}" for i in range(body.count)])
        )

    def split(self, x) -> tuple[jax.Array, ...]:
        """Return the states of the subsystems, shapes (..., dim_a), from states of the whole, shape (..., n).

        States of :class:`Copies` form one array, shape (..., count, dim_a).
        """
        states = jnp.split(self.state(x, batch=True), self._subsystem_offsets[1:-1], axis=-1)
        return tuple(
            y if isinstance(body, Subsystem) else y.reshape(*y.shape[:-1], body.count, body.dim)
            for y, body in zip(states, self.subsystems, strict=True)
        )

    def entropies(self, x) -> jax.Array:
        """Return the entropies S_a of the bodies, shape (..., N)."""
        return self.state(x, batch=True)[..., self._state_indices.S]

    def temperatures(self, x, t=None) -> jax.Array:
        """Return the temperatures ``T_a = H_{S_a}``, shape (..., N), at x and at t if the energy depends on it."""
        return evaluate_batch(self, _energy_gradient, x, t, "(n)")[..., self._state_indices.S]

    def numbers_of_particles(self, x) -> jax.Array:
        """Return the particle numbers of all bodies, shape (..., K)."""
        return self.state(x, batch=True)[..., self.poisson.particle_indices.N]

    def chemical_potentials(self, x, t=None) -> jax.Array:
        """Return the chemical potentials ``mu = H_N``, shape (..., K), at x and at t if the energy depends on it."""
        return evaluate_batch(self, _energy_gradient, x, t, "(n)")[..., self.poisson.particle_indices.N]

    def fourier_factors(self, x, t=None) -> jax.Array:
        """Return the skew matrix ``K_ab = k_ab (1/T_a - 1/T_b)``, shape (..., N, N), with ``S_a' = sum_b K_ab T_b``.

        The matrix is dense, for systems of few bodies; the dynamics uses the edges alone.
        """
        beta = 1.0 / self.temperatures(x, t)
        factors = jnp.zeros((*beta.shape, beta.shape[-1]))
        for term in self.total_dissipation.terms:
            if isinstance(term, HeatConduction):
                i, j = np.array(term.first_bodies, dtype=int), np.array(term.second_bodies, dtype=int)
                k = jnp.vectorize(term.conductances, signature="(n),(e),(e)->(e)")(
                    x, 1.0 / beta[..., i], 1.0 / beta[..., j]
                )
                factor = k * (beta[..., i] - beta[..., j])
                factors = factors.at[..., i, j].set(factor).at[..., j, i].set(-factor)
        return factors

    @property
    def domain(self) -> Domain:
        def lowest_temperature(x):
            return jnp.min(self.energy.gradient(x)[..., self._state_indices.S])

        return Domain("positive temperatures", self._why_outside_domain, margin=lowest_temperature)

    def _why_outside_domain(self, x) -> str:
        """Return which temperatures at states are not positive, as a text; "" if all are positive."""
        T = np.atleast_2d(self.temperatures(x)).min(axis=0)
        cold = np.flatnonzero(~(T > 0.0))
        if not cold.size:
            return ""
        names = self.names
        clauses = [f"the temperature of {names[a]} is {T[a]:.4g}" for a in cold[:MAX_NAMED_BODIES]]
        if cold.size > MAX_NAMED_BODIES:
            clauses.append(f"{cold.size - MAX_NAMED_BODIES} more temperatures are not positive")
        return f"{' and '.join(clauses)}; temperatures must be positive"

    @property
    def sparse_newton(self) -> SparseNewton:
        return SparseNewton(self._find_jacobian_pattern, self._residual_weights)

    def _find_jacobian_pattern(self) -> scipy.sparse.csr_array | None:
        """Return the sparsity pattern of the Jacobian of the field, shape (n, n); None if it is not known."""
        if self.poisson.species:
            return None
        patterns = (term.force_pattern(self) for term in self.total_dissipation.terms)
        operator, hessian = (
            union_pattern([_poisson_pattern(self.poisson), *patterns]),
            self.energy.hessian_pattern(self.dim),
        )
        if operator is None or hessian is None:
            return None
        identity = scipy.sparse.eye_array(self.dim, dtype=bool, format="csr")
        return pattern_of_matrix((operator + identity) @ (hessian + identity))

    def _residual_weights(self, x) -> jax.Array:
        """Return weights of the equations of a step, shape (n,): temperatures for entropies, otherwise 1.

        ``T S'`` is linear in the temperatures, but S' is not.
        """
        S = self._state_indices.S
        return jnp.ones_like(x).at[S].set(self.energy.gradient(x)[S])

    # -- construction -----------------------------------------------------------------------------------

    @property
    def _state_indices(self) -> StateIndices:
        return self.poisson.state_indices

    @property
    def _subsystem_offsets(self) -> np.ndarray:
        """Index of the first component of each subsystem in a state, and the dimension of the state."""
        return np.cumsum([0, *(body.count * body.dim for body in self.subsystems)])

    def _total_energy(self, structure: mf.ExtendedPhaseSpace, coupling) -> Energy:
        """Return the sum of the energies of the bodies and of the coupling, as a function of the whole state."""
        terms = [
            body.energy_of_whole_state(int(start))
            for body, start in zip(self.subsystems, self._subsystem_offsets[:-1], strict=True)
        ]
        if coupling is not None:
            terms += [
                _coupling_energy(V, structure) for V in (coupling if isinstance(coupling, list | tuple) else [coupling])
            ]
        return sum(terms[1:], terms[0])

    def _make_dissipations(self, structure, energy, conductance, drag, connected, conduction) -> list[Dissipation]:
        """Return the dissipations for friction, heat conduction and drag of the bodies, in a list."""
        terms: list[Dissipation] = []
        dofs = structure.degrees_of_freedom
        first_indices = np.cumsum([0, *(body.count for body in self.subsystems)])
        bodies = tuple(
            a
            for body, i in zip(self.subsystems, first_indices[:-1].tolist(), strict=True)
            for a in range(i, i + body.count)
            if isinstance(body.friction, str)
        )
        if bodies:
            terms.append(
                ContactFriction(
                    bodies, law=nondecreasing_law_if(self._friction_surely_produces_entropy(energy, structure, bodies))
                )
            )
        rates = [_diagonal_friction(body) for body in self.subsystems]
        if any(R is not None for R in rates):  # one dissipation for all diagonal frictions
            zeros = [jnp.zeros(body.count * body.degrees_of_freedom) for body in self.subsystems]
            diagonals = [z if R is None else R for R, z in zip(rates, zeros, strict=True)]
            terms.append(LinearFriction(jnp.concatenate(diagonals)))
        for body, R, a in zip(self.subsystems, rates, first_indices[:-1].tolist(), strict=True):
            if R is None and not (body.friction is None or isinstance(body.friction, str)):
                terms.append(LinearFriction(body.friction, body_index=a))
        if conductance is not None:
            constants, functions = _split_conductances(conductance, len(dofs))
            graph = graph_edges(constants, len(dofs), "the conductance", self.names)
            laws = _conduction_laws(graph, functions, structure.dim, self.names) if functions else ()
            if connected:
                _require_connected(graph, self.names)
            terms.append(HeatConduction(graph._replace(weight=jnp.zeros(0)) if laws else graph, laws, conduction))
        if drag is not None:
            graph = graph_edges(drag, len(dofs), "the drag", self.names)
            _require_equal_velocity_counts(graph, dofs, self.names)
            terms.append(Drag(graph))
        return terms

    def _friction_surely_produces_entropy(
        self, energy: Energy, structure: mf.ExtendedPhaseSpace, bodies: tuple[int, ...]
    ) -> bool:
        """Return whether contact friction in ``bodies`` is known to produce entropy.

        It is for energies of which :func:`.is_mechanical_energy` is true.
        """
        if is_traced(energy):
            return False
        n_body_terms = sum(len(body.energy_of_whole_state(0).terms) for body in self.subsystems)
        momenta = structure.state_indices.p[np.isin(structure.state_indices.owner, bodies)]
        points = np.random.default_rng(0).standard_normal((2, structure.dim))
        return all(
            isinstance(body.energy, Energy) and is_mechanical_energy(body.energy, body.dim)
            for body in self.subsystems
            if isinstance(body.friction, str)
        ) and all(is_independent_of(term, points, momenta) for term in energy.terms[n_body_terms:])


def _energy_gradient(system: System, x) -> jax.Array:
    """Return the gradient of the energy at one state, shape (n,)."""
    return system.energy.gradient(x)


MAX_NAMED_BODIES = 3
"""Largest number of bodies that a message names."""


def _poisson_pattern(structure: mf.ExtendedPhaseSpace) -> scipy.sparse.csr_array:
    """Return the sparsity pattern of the Poisson tensor, shape (n, n)."""
    q, p, _, _ = structure.state_indices
    return sparsity_pattern(np.concatenate([q, p]), np.concatenate([p, q]), structure.dim)


# -- arguments --------------------------------------------------------------------------------------------------------


def _diagonal_friction(body: Subsystem | Copies) -> jax.Array | None:
    """Return the diagonal friction of a subsystem, shape (momenta,); None if its friction is not diagonal."""
    R = body.friction
    return R.ravel() if isinstance(R, jax.Array) and (R.ndim == 1 or isinstance(body, Copies)) else None


def _coupling_energy(V, structure: mf.ExtendedPhaseSpace) -> Energy:
    """Return the coupling V as an energy of the whole state."""
    if isinstance(V, Energy):
        return V
    if not callable(V):
        raise InputError(f"a coupling must be a function of q, or of (q, S), or an Energy, got {type(V).__name__}")
    q, _, S, _ = structure.state_indices
    n_arguments, N = required_argument_count(V), structure.particle_indices.N
    if n_arguments == 1:
        return Function(V).on(q)
    indices = (q, S, N) if structure.species and n_arguments is not None and n_arguments > 2 else (q, S)
    function = _SplitArguments(V, tuple(np.cumsum([len(i) for i in indices[:-1]]).tolist()))
    energy = TimeDependent(function) if n_arguments == len(indices) + 1 else Function(function)
    return energy.on(np.concatenate(indices))


class _SplitArguments(Module):
    """A function of one array and t, computed from V(q, S, t) or V(q, S, N, t); t may be missing."""

    V: Callable
    split_indices: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, y, *t):
        return self.V(*jnp.split(y, self.split_indices), *t)


def _particle_invariants(structure: mf.ExtendedPhaseSpace, processes: Sequence[Process]) -> dict[str, Energy]:
    """Return the sums of particle numbers that no process changes, by name, as functions of the state."""
    N = structure.particle_indices.N
    invariants: dict[str, Energy] = {}
    for i, weights in enumerate(conserved_number_combinations(processes, len(N)) if len(N) else ()):
        b = np.zeros(structure.dim)
        b[N] = weights
        invariants[f"particles {i + 1}"] = Quadratic(jnp.zeros(structure.dim), b)
    return invariants


def _split_conductances(conductance, n_bodies: int) -> tuple[Any, list[tuple[int, int, Callable]]]:
    """Return the conductances with 1 in place of functions, and the edges (i, j, function)."""
    if callable(conductance):
        conductance = [(0, 1, conductance)]
        if n_bodies != 2:
            raise InputError(
                f"a conductance given as one function needs two bodies, got {n_bodies}. Give edges (i, j, function)"
            )
    is_edge_list = isinstance(conductance, list | tuple) and all(isinstance(edge, tuple) for edge in conductance)
    functions = [edge for edge in conductance if any(map(callable, edge))] if is_edge_list else []
    if not functions:
        return conductance, []
    return [tuple(1.0 if callable(entry) else entry for entry in edge) for edge in conductance], functions


def _conduction_laws(
    graph: Edges, edges_with_functions, state_dim: int, body_names: tuple[str, ...]
) -> tuple[Callable, ...]:
    """Return for each edge of a graph a checked function of (T_i, T_j, x): its constant weight if none is given."""
    laws = {}
    for i, j, k in edges_with_functions:
        law = k if required_argument_count(k) == 3 else LastArgumentIgnored(k)
        what = f"the conductance between {body_names[int(i)]} and {body_names[int(j)]}"
        law, _ = traced_function_and_shape(law, ((), (), (state_dim,)), [()], what, "(T_i, T_j), or (T_i, T_j, x)")
        laws[min(i, j), max(i, j)] = law if i < j else _SwappedLaw(law)
    edges = zip(graph.first.tolist(), graph.second.tolist(), graph.weight, strict=True)
    return tuple(laws.get((i, j), ConstantFunction(weight)) for i, j, weight in edges)


class _SwappedLaw(Module):
    """A conduction law with the two bodies exchanged."""

    law: Callable

    def __call__(self, T_i, T_j, x):
        return self.law(T_j, T_i, x)


def _require_connected(graph: Edges, body_names: tuple[str, ...]) -> None:
    """Raise InputError if the graph of conductances is not connected."""
    labels = connected_component_labels(graph, len(body_names))
    if labels.max() > 0:
        examples = [" and ".join(np.array(body_names)[labels == i][:2]) for i in (0, 1)]
        raise InputError(
            f"the conductance has {labels.max() + 1} parts that exchange no heat, such as that of {examples[0]} and "
            f"that of {examples[1]}. Use connected=False to allow this"
        )


def _require_equal_velocity_counts(graph: Edges, dofs: tuple[int, ...], body_names: tuple[str, ...]) -> None:
    """Raise InputError if drag acts between bodies with different numbers of velocities."""
    n = np.array(dofs)
    bad = np.flatnonzero((n[graph.first] != n[graph.second]) | (n[graph.first] == 0))
    if bad.size:
        i, j = graph.first[bad[0]], graph.second[bad[0]]
        raise InputError(
            f"drag between {body_names[i]} and {body_names[j]} needs velocities of the same kind, but they have "
            f"{dofs[i]} and {dofs[j]} degrees of freedom"
        )
