"""Composed systems: bodies with entropies of their own that push, rub and warm each other [SML §5]."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation import Dissipation, semidefinite
from ..energy import Energy, Function, Quadratic, as_energy, check_scalar, is_traced, recognised
from ..errors import InputError
from ..graph import Edges, edges, parts
from ..mechanics import is_free_of, is_mechanical
from ..thermal import ContactFriction, Drag, HeatConduction, LinearFriction
from .base import System


class Subsystem(eqx.Module):
    """One body of a composed system: its energy in its own state (q, p, S), and its friction.

    Parameters
    ----------
    energy : function from (q, p, S) in one array, shape (dim,), to a scalar, or an Energy; or None
        With ``lt.Kinetic`` and ``lt.Potential`` as terms where that is its form; None where it is all in the coupling.
    dim : int
        2n + 1 components; 1 for a body at rest, whose state is S alone.
    friction : optional
        A coefficient R of linear friction, ``p' = -R v`` and ``S' = v . R v / T`` (mass / time): a number, an array of
        shape (n,) for a diagonal matrix or (n, n), positive semidefinite, or a function from the state of the body to
        one. Or "contact": the friction ``p' = -p T`` of an evolution field [SML 7]. None by default.
    name : str, optional
        For messages.
    """

    energy: Energy
    friction: jax.Array | Callable | str | None
    dim: int = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    def __init__(self, energy, dim: int, friction=None, name: str | None = None):
        if isinstance(dim, bool) or not isinstance(dim, int) or dim < 1 or dim % 2 == 0:
            raise InputError(f"dim counts the components of a state (q, p, S): 2n + 1, and 1 for S alone, not {dim!r}")
        self.dim, self.name = dim, name
        energy = Quadratic(jnp.zeros(dim)) if energy is None else as_energy(energy, "the energy of a subsystem")
        check_scalar(energy, dim, f"the energy of {name or 'a subsystem'}")
        self.energy = recognised(energy, dim)
        self.friction = _checked_friction(friction, dim, name or "a subsystem")

    @property
    def degrees_of_freedom(self) -> int:
        return self.dim // 2


class ComposedSystem(System):
    """Bodies with their own (q, p, S), a coupling potential, heat conduction and friction [SML §5, Examples 2-4].

    ``q_a' = H_{p_a}``, ``p_a' = -H_{q_a}`` and friction, ``S_a' = sum_b k_ab (T_b - T_a) / T_a`` and the heat of
    friction, with ``H = sum_a H_a(q_a, p_a, S_a) + V(q, S)`` and temperatures ``T_a = H_{S_a}``. The state is
    (q_1, p_1, S_1, q_2, …). H is constant; the entropy is the sum of the S_a and does not fall.

    Discretisations evaluate the Fourier factors ``K_ab = k_ab (1/T_a - 1/T_b)`` and the heat of friction with discrete
    temperatures and velocities, the components of the discrete gradient. So conduction alone gives
    ``S' - S = h sum_{a<b} k_ab (T_a - T_b)^2 / (T_a T_b) >= 0`` for every H, where SML Lemma 6.2 asks for a quadratic
    one; likewise linear friction. A step on which a temperature is not positive is refused: the run stops with a status
    that says so. (Contact friction is the exception: see :class:`EvolutionSystem` for what it asks of H_a.)

    Parameters
    ----------
    subsystems : sequence of Subsystem, or dict of them by name
    coupling : function of q, or of (q, S), or an Energy of the whole state; or a sequence of such
        V, with q the positions of all subsystems in one array and S their entropies, shape (N,). An Energy may have
        coordinates of its own (``lt.Function(e).on(...)``), such as the squared distance of two bodies.
    conductance : array, shape (N, N), or SciPy sparse matrix; or sequence of (i, j, k); or a number for two bodies
        Symmetric and >= 0 (power / temperature).
    drag : likewise
        Coefficients c of friction between bodies with equally many degrees of freedom, ``-c_ij (v_i - v_j)`` on i, each
        heated by half (mass / time).
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
        ``poisson.places`` has the indices of all q, p and S in a state.
    subsystems : tuple of Subsystem
    names : tuple of str
    """

    poisson: mf.ExtendedPhaseSpace
    subsystems: tuple[Subsystem, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    domain: ClassVar[str] = "positive temperatures"

    def __init__(
        self,
        subsystems: Sequence[Subsystem] | Mapping[str, Subsystem],
        coupling=None,
        conductance=None,
        drag=None,
        connected: bool = True,
        momentum_maps=(),
        validate: bool = True,
    ):
        self.names, self.subsystems = _named(subsystems)
        structure = mf.ExtendedPhaseSpace(tuple(body.degrees_of_freedom for body in self.subsystems))
        energy = self._energy(structure, coupling)
        check_scalar(energy, structure.dim, "the energy")
        entropy = Quadratic(jnp.zeros(structure.dim), jnp.zeros(structure.dim).at[structure.places.S].set(1.0))
        dissipation = self._dissipation(structure, energy, conductance, drag, connected)
        self._build(structure, structure.dim, energy, entropy, dissipation, momentum_maps, validate)

    # -- in parts -------------------------------------------------------------------------------------------------

    def split(self, x) -> tuple[jax.Array, ...]:
        """The states of the subsystems, shapes (..., dim_a), in a state or a batch of states."""
        ends = np.cumsum([body.dim for body in self.subsystems])[:-1]
        return tuple(jnp.split(self.state(x, batch=True), ends, axis=-1))

    def entropies(self, x) -> jax.Array:
        """The S_a, shape (..., N)."""
        return self.state(x, batch=True)[..., self._places.S]

    def temperatures(self, x) -> jax.Array:
        """The ``T_a = H_{S_a}``, shape (..., N)."""
        gradient = jnp.vectorize(self.energy.gradient, signature="(n)->(n)")(self.state(x, batch=True))
        return gradient[..., self._places.S]

    def fourier_factors(self, x) -> jax.Array:
        """The skew matrix ``K_ab = k_ab (1/T_a - 1/T_b)``, shape (..., N, N), for which ``S_a' = sum_b K_ab T_b``."""
        cold = 1.0 / self.temperatures(x)
        factors = jnp.zeros((*cold.shape, cold.shape[-1]))
        for part in getattr(self.dissipation, "parts", (self.dissipation,)):
            if isinstance(part, HeatConduction):
                i, j = np.array(part.first, dtype=int), np.array(part.second, dtype=int)
                factor = part.conductance * (cold[..., i] - cold[..., j])
                factors = factors.at[..., i, j].set(factor).at[..., j, i].set(-factor)
        return factors

    def outside(self, x) -> str:
        cold = [
            f"the temperature of {name} is {T:.4g}"
            for name, T in zip(self.names, self.temperatures(x).tolist(), strict=True)
            if not T > 0.0
        ]
        return f"{' and '.join(cold)}: it has to be positive" if cold else ""

    # -- how it is put together -----------------------------------------------------------------------------------

    @property
    def _places(self) -> mf.contact.Places:
        return self.poisson.places

    def _energy(self, structure: mf.ExtendedPhaseSpace, coupling) -> Energy:
        ends = np.cumsum([body.dim for body in self.subsystems])
        terms = [
            body.energy.on(np.arange(end - body.dim, end)) for body, end in zip(self.subsystems, ends, strict=True)
        ]
        if coupling is not None:
            terms += [
                _potential(V, structure) for V in (coupling if isinstance(coupling, list | tuple) else [coupling])
            ]
        return sum(terms[1:], terms[0])

    def _dissipation(self, structure, energy, conductance, drag, connected) -> Dissipation | None:
        dofs, frictions = structure.degrees_of_freedom, [body.friction for body in self.subsystems]
        found: list[Dissipation] = []
        if bodies := tuple(a for a, R in enumerate(frictions) if isinstance(R, str)):
            found.append(ContactFriction(bodies, self._pays(energy, structure, bodies)))
        diagonals = [R if isinstance(R, jax.Array) and R.ndim == 1 else None for R in frictions]
        if any(R is not None for R in diagonals):  # all in one
            rates = [jnp.zeros(n) if R is None else R for R, n in zip(diagonals, dofs, strict=True)]
            found.append(LinearFriction(jnp.concatenate(rates)))
        for a, R in enumerate(frictions):
            if not (R is None or isinstance(R, str) or R is diagonals[a]):
                found.append(LinearFriction(R, body=a))
        if conductance is not None:
            graph = edges(conductance, len(dofs), "the conductance", self.names)
            if connected:
                _need_connected(graph, self.names)
            found.append(HeatConduction(graph))
        if drag is not None:
            graph = edges(drag, len(dofs), "the drag", self.names)
            _need_velocities(graph, dofs, self.names)
            found.append(Drag(graph))
        return sum(found[1:], found[0]) if found else None

    def _pays(self, energy: Energy, structure: mf.ExtendedPhaseSpace, bodies: tuple[int, ...]) -> bool:
        """Whether contact friction in some bodies is known to produce entropy: see :func:`is_mechanical`."""
        if is_traced(energy):
            return False
        own = sum(len(body.energy.terms) for body in self.subsystems)
        momenta = structure.places.p[np.isin(structure.places.owner, bodies)]
        points = np.random.default_rng(0).standard_normal((2, structure.dim))
        return all(is_mechanical(self.subsystems[a].energy, self.subsystems[a].dim) for a in bodies) and all(
            is_free_of(term, points, momenta) for term in energy.terms[own:]
        )


# -- arguments --------------------------------------------------------------------------------------------------------


def _named(subsystems) -> tuple[tuple[str, ...], tuple[Subsystem, ...]]:
    if isinstance(subsystems, Mapping):
        names, bodies = tuple(map(str, subsystems)), tuple(subsystems.values())
    else:
        bodies = tuple(subsystems)
        names = tuple(getattr(body, "name", None) or f"body {i}" for i, body in enumerate(bodies))
    for name, body in zip(names, bodies, strict=True):
        if not isinstance(body, Subsystem):
            raise InputError(f"{name} must be an lt.Subsystem, not {type(body).__name__}")
    if not bodies:
        raise InputError("a composed system has at least one subsystem")
    return names, bodies


def _potential(V, structure: mf.ExtendedPhaseSpace) -> Energy:
    """A coupling as an Energy of the whole state."""
    if isinstance(V, Energy):
        return V
    if not callable(V):
        raise InputError(f"a coupling is a function of q, or of (q, S), or an Energy, not {type(V).__name__}")
    q, _, S, _ = structure.places
    if _arguments(V) == 1:
        return Function(V).on(q)
    return Function(_Apart(V, len(q))).on(np.concatenate([q, S]))


def _arguments(function: Callable) -> int:
    """How many arguments a function takes by position, 2 where it does not tell."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 2
    needed = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty]
    return len(needed)


class _Apart(eqx.Module):
    """V(q, S) as a function of one array."""

    V: Callable
    positions: int = eqx.field(static=True)

    def __call__(self, y):
        return self.V(y[: self.positions], y[self.positions :])


def _checked_friction(friction, dim: int, name: str):
    n = dim // 2
    if friction is None:
        return None
    if n == 0:
        raise InputError(f"{name} has no momenta, so it cannot have friction")
    if isinstance(friction, str):
        if friction != "contact":
            raise InputError(f"friction of {name} is a coefficient or 'contact', not {friction!r}")
        return friction
    if callable(friction):
        shape = jax.eval_shape(lambda x: jnp.asarray(friction(x)), jax.ShapeDtypeStruct((dim,), jnp.float64)).shape
        if shape not in ((), (n,), (n, n)):
            raise InputError(f"friction of {name} must return shape (), ({n},) or ({n}, {n}), not {shape}")
        return friction
    R = jnp.asarray(friction, dtype=jnp.float64)
    if R.ndim == 0:
        R = jnp.full(n, R)
    if R.shape not in ((n,), (n, n)):
        raise InputError(f"friction of {name} has shape (), ({n},) or ({n}, {n}), not {R.shape}")
    if R.ndim == 2:
        return semidefinite(R, f"the friction of {name}")
    if not is_traced(R) and not (np.asarray(R) >= 0.0).all():
        raise InputError(f"friction of {name} must be >= 0, not {np.min(np.asarray(R)):g}: it would cool the body")
    return R


def _need_connected(graph: Edges, names: tuple[str, ...]) -> None:
    part = parts(graph, len(names))
    if part.max() > 0:
        examples = [" and ".join(np.array(names)[part == i][:2]) for i in (0, 1)]
        raise InputError(
            f"the conductance falls into {part.max() + 1} parts that exchange no heat, such as that of {examples[0]} "
            f"and that of {examples[1]}. If that is meant, say connected=False"
        )


def _need_velocities(graph: Edges, dofs: tuple[int, ...], names: tuple[str, ...]) -> None:
    for i, j in zip(graph.first, graph.second, strict=True):
        if dofs[i] != dofs[j] or dofs[i] == 0:
            raise InputError(
                f"drag between {names[i]} and {names[j]} needs velocities of the same kind, but they have {dofs[i]} "
                f"and {dofs[j]} degrees of freedom"
            )
