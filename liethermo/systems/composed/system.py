"""Composed systems: bodies with entropies of their own that push, rub and warm each other [SML §5]."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.structures.extended import StateIndices

from ...dissipation.base import Dissipation
from ...dissipation.bodies import ContactFriction, Drag, HeatConduction, LinearFriction
from ...dissipation.matter import MatterExchange, Process, conserved_numbers
from ...errors import InputError
from ...functions.arguments import ConstantFunction, LastArgumentIgnored, required_argument_count
from ...functions.checks import check_energy, check_function_shape
from ...functions.edges import Edges, connected_components, graph_edges
from ...functions.energy import Energy, Function, Quadratic, TimeDependent
from ...functions.indices import pattern_of_matrix, sparsity_pattern, union_pattern
from ...functions.mechanics import is_independent_of, is_mechanical
from ..base import System, name_momentum_maps
from ..evolution import entropy_component
from .bodies import Copies, Subsystem, name_subsystems
from .matter import Membrane, Reaction


class ComposedSystem(System):
    """Bodies with their own (q, p, S), a coupling potential, heat conduction and friction [SML §5, Examples 2-4].

    ``q_a' = H_{p_a}``, ``p_a' = -H_{q_a}`` and friction, ``S_a' = sum_b k_ab (T_b - T_a) / T_a`` and the heat of
    friction, with ``H = sum_a H_a(q_a, p_a, S_a) + V(q, S)`` and temperatures ``T_a = H_{S_a}``. The state is
    (q_1, p_1, S_1, q_2, …). H is constant; the entropy is the sum of the S_a and does not fall. Bodies may hold matter
    too, ``mu = H_N``, that passes membranes and reacts; the numbers that no process changes are constants of motion.

    Discretisations evaluate the Fourier factors ``K_ab = k_ab (1/T_a - 1/T_b)`` and the heat of friction with discrete
    temperatures and velocities, the components of the discrete gradient. So conduction alone gives
    ``S' - S = h sum_{a<b} k_ab (T_a - T_b)^2 / (T_a T_b) >= 0`` for every H, where SML Lemma 6.2 asks for a quadratic
    one; likewise linear friction. A step on which a temperature is not positive is refused: the run stops with a status
    that says so. (Contact friction is the exception: see :class:`EvolutionSystem` for what it asks of H_a.)

    Networks of 1e5 bodies are made of :class:`Copies`, with :class:`liethermo.Each` as the potential of what joins
    them. A step then costs as much as there are bodies and edges; a stiff one is solved by sparse Newton iteration.

    Parameters
    ----------
    subsystems : sequence of Subsystem or Copies, or dict of them by name
    coupling : function of q, of (q, S) or of (q, S, t), or an Energy of the whole state; or a sequence of such
        V, with q the positions of all subsystems in one array and S their entropies, shape (N,). Where bodies hold
        matter a function of three arguments is one of (q, S, N), all their particle numbers in one array. An Energy may
        have coordinates of its own (``lt.Function(e).on(...)``), such as the squared distance of two bodies.
    conductance : array, shape (N, N), or SciPy sparse matrix; or sequence of (i, j, k); or a number for two bodies
        Symmetric and >= 0 (power / temperature). In an edge, or for two bodies, it may be a function of the two
        temperatures (T_i, T_j), or of (T_i, T_j, x) with the whole state x, symmetric under exchange of the bodies; a
        step on which it is negative is refused.
    drag : likewise
        Coefficients c of friction between bodies with equally many degrees of freedom, ``-c_ij (v_i - v_j)`` on i, each
        heated by half (mass / time).
    conduction : {"discrete", "midpoint"}
        Fourier factors by the discrete temperatures, so that the entropy grows in each step for every energy, or by the
        temperatures at the midpoint, as SML §6.2 prints them: then it is known to grow for quadratic energies alone,
        and no law of it is stated.
    membranes : sequence of Membrane
    reactions : sequence of Reaction
    connected : bool
        Refuse a conductance whose graph falls into parts that exchange no heat.
    momentum_maps : dict of functions, or a sequence of them
    validate : bool
        Test the axioms at a few random points. Turn off where an energy is not defined at normally distributed points,
        and use ``system.check(points=...)``.

    Raises
    ------
    AxiomError, FunctionError, InputError

    Attributes
    ----------
    poisson : manifolds.ExtendedPhaseSpace
        ``poisson.state_indices`` has the indices of all q, p and S in a state.
    subsystems : tuple of Subsystem or Copies
    names : tuple of str
        Of the bodies.
    """

    poisson: mf.ExtendedPhaseSpace
    subsystems: tuple[Subsystem | Copies, ...]
    labels: tuple[str, ...] = eqx.field(static=True)

    domain: ClassVar[str] = "positive temperatures"

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
            raise InputError(f"conduction is 'discrete' or 'midpoint', not {conduction!r}")
        self.labels, self.subsystems = name_subsystems(subsystems)
        dofs, kinds = (
            tuple(n for body in self.subsystems for n in (getattr(body, name),) * body.count)
            for name in ("degrees_of_freedom", "species")
        )
        structure = mf.ExtendedPhaseSpace(dofs, kinds if any(kinds) else ())
        energy = check_energy(self._total_energy(structure, coupling), structure.dim, "the energy", allow_time=True)
        entropy = entropy_component(structure.dim, structure.state_indices.S)
        dissipation = self._make_dissipation(structure, energy, conductance, drag, connected, conduction)
        given = [*(membranes if isinstance(membranes, list | tuple) else [membranes])]
        given += [*(reactions if isinstance(reactions, list | tuple) else [reactions])]
        for one in given:
            if not isinstance(one, Membrane | Reaction):
                raise InputError(f"membranes and reactions are lt.Membrane and lt.Reaction, not {type(one).__name__}")
        processes = [one.process(self.names, structure) for one in given]
        if processes:
            exchange = MatterExchange(processes)
            dissipation = exchange if dissipation is None else dissipation + exchange
        momentum_maps = {**_particle_invariants(structure, processes), **name_momentum_maps(momentum_maps)}
        self._build(structure, structure.dim, energy, entropy, dissipation, momentum_maps, validate)

    # -- in parts -------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(
            name
            for label, body in zip(self.labels, self.subsystems, strict=True)
            for name in ([label] if isinstance(body, Subsystem) else [f"{label} {i}" for i in range(body.count)])
        )

    def split(self, x) -> tuple[jax.Array, ...]:
        """The states of the subsystems, shapes (..., dim_a), in a state or a batch of states.

        Those of :class:`Copies` are in one array, shape (..., count, dim_a).
        """
        found = jnp.split(self.state(x, batch=True), self._subsystem_offsets[1:-1], axis=-1)
        return tuple(
            part if isinstance(body, Subsystem) else part.reshape(*part.shape[:-1], body.count, body.dim)
            for part, body in zip(found, self.subsystems, strict=True)
        )

    def entropies(self, x) -> jax.Array:
        """The S_a, shape (..., N)."""
        return self.state(x, batch=True)[..., self._state_indices.S]

    def temperatures(self, x, t=None) -> jax.Array:
        """The ``T_a = H_{S_a}``, shape (..., N); at a time, where the energy depends on one."""
        return self.evaluate_batch(lambda system, y: system.energy.gradient(y), x, t, "(n)")[..., self._state_indices.S]

    def numbers_of_particles(self, x) -> jax.Array:
        """Those of all bodies, shape (..., K)."""
        return self.state(x, batch=True)[..., self.poisson.particle_indices.N]

    def chemical_potentials(self, x, t=None) -> jax.Array:
        """The ``mu = H_N`` of all particle numbers, shape (..., K); at a time, where the energy depends on one."""
        return self.evaluate_batch(lambda system, y: system.energy.gradient(y), x, t, "(n)")[
            ..., self.poisson.particle_indices.N
        ]

    def fourier_factors(self, x, t=None) -> jax.Array:
        """The skew matrix ``K_ab = k_ab (1/T_a - 1/T_b)``, shape (..., N, N), for which ``S_a' = sum_b K_ab T_b``.

        All of it, zeros too: for few bodies. The dynamics works with the edges alone.
        """
        cold = 1.0 / self.temperatures(x, t)
        factors = jnp.zeros((*cold.shape, cold.shape[-1]))
        for part in () if self.dissipation is None else self.dissipation.terms:
            if isinstance(part, HeatConduction):
                i, j = np.array(part.first_bodies, dtype=int), np.array(part.second_bodies, dtype=int)
                k = jnp.vectorize(part.conductances, signature="(n),(e),(e)->(e)")(
                    x, 1.0 / cold[..., i], 1.0 / cold[..., j]
                )
                factor = k * (cold[..., i] - cold[..., j])
                factors = factors.at[..., i, j].set(factor).at[..., j, i].set(-factor)
        return factors

    def outside(self, x) -> str:
        T = np.atleast_2d(self.temperatures(x)).min(axis=0)
        cold = np.flatnonzero(~(T > 0.0))
        if not cold.size:
            return ""
        names = self.names
        found = [f"the temperature of {names[a]} is {T[a]:.4g}" for a in cold[:MAX_NAMED_BODIES]]
        if cold.size > MAX_NAMED_BODIES:
            found.append(f"of {cold.size - MAX_NAMED_BODIES} more likewise")
        return f"{' and '.join(found)}: it has to be positive"

    def domain_margin(self, x):
        return jnp.min(self.energy.gradient(x)[..., self._state_indices.S])

    def sparsity_pattern(self) -> scipy.sparse.csr_array | None:
        if self.poisson.species:
            return None
        parts = [
            _poisson_pattern(self.poisson),
            *([] if self.dissipation is None else [self.dissipation.couplings(self)]),
        ]
        through, hessian = union_pattern(parts), self.energy.couplings(self.dim)
        if through is None or hessian is None:
            return None
        itself = scipy.sparse.eye_array(self.dim, dtype=bool, format="csr")
        return pattern_of_matrix((through + itself) @ (hessian + itself))

    def residual_weights(self, x) -> jax.Array:
        """The temperatures at the entropies: ``T S'`` is a flow of energy, linear in temperatures where S' is not."""
        S = self._state_indices.S
        return jnp.ones_like(x).at[S].set(self.energy.gradient(x)[S])

    # -- how it is put together -----------------------------------------------------------------------------------

    @property
    def _state_indices(self) -> StateIndices:
        return self.poisson.state_indices

    @property
    def _subsystem_offsets(self) -> np.ndarray:
        """Where each of the subsystems begins in a state, and the end."""
        return np.cumsum([0, *(body.count * body.dim for body in self.subsystems)])

    def _total_energy(self, structure: mf.ExtendedPhaseSpace, coupling) -> Energy:
        terms = [
            body.energy_in_state(int(at))
            for body, at in zip(self.subsystems, self._subsystem_offsets[:-1], strict=True)
        ]
        if coupling is not None:
            terms += [
                _coupling_energy(V, structure) for V in (coupling if isinstance(coupling, list | tuple) else [coupling])
            ]
        return sum(terms[1:], terms[0])

    def _make_dissipation(self, structure, energy, conductance, drag, connected, conduction) -> Dissipation | None:
        found: list[Dissipation] = []
        dofs = structure.degrees_of_freedom
        first = np.cumsum([0, *(body.count for body in self.subsystems)])
        bodies = tuple(
            a
            for body, i in zip(self.subsystems, first[:-1].tolist(), strict=True)
            for a in range(i, i + body.count)
            if isinstance(body.friction, str)
        )
        if bodies:
            found.append(ContactFriction(bodies, self._is_entropy_producing(energy, structure, bodies)))
        rates = [_diagonal_friction(body) for body in self.subsystems]
        if any(R is not None for R in rates):  # all that are diagonal in one
            none = [jnp.zeros(body.count * body.degrees_of_freedom) for body in self.subsystems]
            all_rates = [z if R is None else R for R, z in zip(rates, none, strict=True)]
            found.append(LinearFriction(jnp.concatenate(all_rates)))
        for body, R, a in zip(self.subsystems, rates, first[:-1].tolist(), strict=True):
            if R is None and not (body.friction is None or isinstance(body.friction, str)):
                found.append(LinearFriction(body.friction, body_index=a))
        if conductance is not None:
            given, functions = _split_conductances(conductance, len(dofs))
            graph = graph_edges(given, len(dofs), "the conductance", self.names)
            laws = _conduction_laws(graph, functions, structure.dim, self.names) if functions else ()
            if connected:
                _require_connected(graph, self.names)
            found.append(HeatConduction(graph._replace(weight=jnp.zeros(0)) if laws else graph, laws, conduction))
        if drag is not None:
            graph = graph_edges(drag, len(dofs), "the drag", self.names)
            _require_velocities(graph, dofs, self.names)
            found.append(Drag(graph))
        return sum(found[1:], found[0]) if found else None

    def _is_entropy_producing(self, energy: Energy, structure: mf.ExtendedPhaseSpace, bodies: tuple[int, ...]) -> bool:
        """Whether contact friction in some bodies is known to produce entropy: see :func:`is_mechanical`."""
        if is_traced(energy):
            return False
        own = sum(len(body.energy_in_state(0).terms) for body in self.subsystems)
        momenta = structure.state_indices.p[np.isin(structure.state_indices.owner, bodies)]
        points = np.random.default_rng(0).standard_normal((2, structure.dim))
        return all(
            isinstance(body.energy, Energy) and is_mechanical(body.energy, body.dim)
            for body in self.subsystems
            if isinstance(body.friction, str)
        ) and all(is_independent_of(term, points, momenta) for term in energy.terms[own:])


MAX_NAMED_BODIES = 3
"""Bodies that a message names."""


def _poisson_pattern(structure: mf.ExtendedPhaseSpace) -> scipy.sparse.csr_array:
    """The pattern of the Poisson tensor."""
    q, p, _, _ = structure.state_indices
    return sparsity_pattern(np.concatenate([q, p]), np.concatenate([p, q]), structure.dim)


# -- arguments --------------------------------------------------------------------------------------------------------


def _diagonal_friction(body: Subsystem | Copies) -> jax.Array | None:
    """The diagonal friction of a subsystem, an entry for each momentum."""
    R = body.friction
    return R.ravel() if isinstance(R, jax.Array) and (R.ndim == 1 or isinstance(body, Copies)) else None


def _coupling_energy(V, structure: mf.ExtendedPhaseSpace) -> Energy:
    """A coupling as an Energy of the whole state."""
    if isinstance(V, Energy):
        return V
    if not callable(V):
        raise InputError(f"a coupling is a function of q, or of (q, S), or an Energy, not {type(V).__name__}")
    q, _, S, _ = structure.state_indices
    needed, N = required_argument_count(V), structure.particle_indices.N
    if needed == 1:
        return Function(V).on(q)
    parts = (q, S, N) if structure.species and needed is not None and needed > 2 else (q, S)
    joined = _SplitArguments(V, tuple(np.cumsum([len(part) for part in parts[:-1]]).tolist()))
    return (TimeDependent(joined) if needed == len(parts) + 1 else Function(joined)).on(np.concatenate(parts))


class _SplitArguments(Module):
    """V(q, S), or V(q, S, N), and of t, as a function of one array, and of t."""

    V: Callable
    split_indices: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, y, *t):
        return self.V(*jnp.split(y, self.split_indices), *t)


def _particle_invariants(structure: mf.ExtendedPhaseSpace, processes: Sequence[Process]) -> dict[str, Energy]:
    """The sums of particle numbers that no process changes."""
    N = structure.particle_indices.N
    found: dict[str, Energy] = {}
    for i, weights in enumerate(conserved_numbers(processes, len(N)) if len(N) else ()):
        b = np.zeros(structure.dim)
        b[N] = weights
        found[f"particles {i + 1}"] = Quadratic(jnp.zeros(structure.dim), b)
    return found


def _split_conductances(conductance, bodies: int) -> tuple[Any, list[tuple[int, int, Callable]]]:
    """A graph of conductances, with 1 for functions, and the edges that have one."""
    if callable(conductance):
        conductance = [(0, 1, conductance)]
        if bodies != 2:
            raise InputError(
                f"the conductance as one function is meant for two bodies, not {bodies}: give edges (i, j, function)"
            )
    listed = isinstance(conductance, list | tuple) and all(isinstance(edge, tuple) for edge in conductance)
    functions = [edge for edge in conductance if any(map(callable, edge))] if listed else []
    if not functions:
        return conductance, []
    return [tuple(1.0 if callable(part) else part for part in edge) for edge in conductance], functions


def _conduction_laws(graph: Edges, functions, dim: int, names: tuple[str, ...]) -> tuple[Callable, ...]:
    """A function of (T_i, T_j, x) for each edge of a graph, checked: where none is given, its weight."""
    found = {}
    for i, j, k in functions:
        law = k if required_argument_count(k) == 3 else LastArgumentIgnored(k)
        what = f"the conductance between {names[int(i)]} and {names[int(j)]}"
        law, _ = check_function_shape(law, ((), (), (dim,)), [()], what, "(T_i, T_j), or (T_i, T_j, x)")
        found[min(i, j), max(i, j)] = law if i < j else _SwappedLaw(law)
    pairs = zip(graph.first.tolist(), graph.second.tolist(), graph.weight, strict=True)
    return tuple(found.get((i, j), ConstantFunction(weight)) for i, j, weight in pairs)


class _SwappedLaw(Module):
    """A law of two bodies, with the bodies in the other order."""

    law: Callable

    def __call__(self, T_i, T_j, x):
        return self.law(T_j, T_i, x)


def _require_connected(graph: Edges, names: tuple[str, ...]) -> None:
    part = connected_components(graph, len(names))
    if part.max() > 0:
        examples = [" and ".join(np.array(names)[part == i][:2]) for i in (0, 1)]
        raise InputError(
            f"the conductance falls into {part.max() + 1} parts that exchange no heat, such as that of {examples[0]} "
            f"and that of {examples[1]}. If that is meant, say connected=False"
        )


def _require_velocities(graph: Edges, dofs: tuple[int, ...], names: tuple[str, ...]) -> None:
    n = np.array(dofs)
    bad = np.flatnonzero((n[graph.first] != n[graph.second]) | (n[graph.first] == 0))
    if bad.size:
        i, j = graph.first[bad[0]], graph.second[bad[0]]
        raise InputError(
            f"drag between {names[i]} and {names[j]} needs velocities of the same kind, but they have {dofs[i]} "
            f"and {dofs[j]} degrees of freedom"
        )
