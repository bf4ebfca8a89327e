"""The bodies of a composed system, one by one or many of a kind, and the membranes and reactions between them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.structures.poisson import ParticleIndices

from ...dissipation.bodies import Process
from ...dissipation.checks import checked_semidefinite
from ...errors import InputError
from ...functions.checks import checked_energy, traced_function_and_shape, with_polynomial_degrees
from ...functions.conditions import checked_numbers, nonnegative_condition, require_condition
from ...functions.energy import Energy, Quadratic, make_energy
from ...functions.mechanics import Each


class Subsystem(Module):
    """A body of a composed system, with the energy of its own state (q, p, S) and its friction.

    Parameters
    ----------
    energy : function from (q, p, S) in one array, shape (dim,), to a scalar, or an Energy; or None
        With ``lt.Kinetic`` and ``lt.Potential`` as terms where that is its form; None where it is all in the coupling.
    dim : int
        2n + 1 components; 1 for a body at rest, whose state is S alone, and more where it holds matter.
    friction : optional
        A coefficient R of linear friction, ``p' = -R v`` and ``S' = v . R v / T`` (mass / time): a number, an array of
        shape (n,) for a diagonal matrix or (n, n), positive semidefinite, or a function from the state of the body to
        one. Or "contact": the friction ``p' = -p T`` of an evolution field [SML 7]. None by default.
    name : str, optional
        For messages.
    species : int
        Kinds of particles in a body at rest: its state is (S, N_1, N_2, …), so dim = 1 + species. A wall that moves is
        a body of its own, joined by the coupling.
    """

    energy: Energy
    friction: jax.Array | Callable | str | None
    dim: int = eqx.field(static=True)
    name: str | None = eqx.field(static=True)
    species: int = eqx.field(static=True)

    def __init__(self, energy, dim: int, friction=None, name: str | None = None, species: int = 0):
        self.species = species
        if species == 0:
            _check_dim(dim)
        elif isinstance(species, bool) or not isinstance(species, int) or species < 0 or dim != 1 + species:
            raise InputError(
                f"{name or 'a subsystem'} holds {species!r} kinds of particles, so its state is (S, N) of dim 1 + "
                f"species, got dim {dim!r}. Model a moving wall as a body of its own"
            )
        self.dim, self.name = dim, name
        energy = Quadratic(jnp.zeros(dim)) if energy is None else make_energy(energy, "the energy of a subsystem")
        self.energy = with_polynomial_degrees(
            checked_energy(energy, dim, f"the energy of {name or 'a subsystem'}"), dim
        )
        self.friction = _checked_friction(friction, dim - species, name or "a subsystem")

    @property
    def degrees_of_freedom(self) -> int:
        return (self.dim - self.species) // 2

    @property
    def count(self) -> int:
        """Number of bodies, which is 1."""
        return 1

    def energy_of_whole_state(self, start_index: int) -> Energy:
        """Return the energy as a function of the whole state, in which the body begins at ``start_index``."""
        return self.energy.on(np.arange(start_index, start_index + self.dim))


class Copies(Module):
    """Many bodies of one kind in a composed system, with one energy function and parameters for each body.

    The energy of body a is ``H_a(q_a, p_a, S_a)``. The costs of tracing and compiling do not grow with the number of
    bodies, so there can be 1e5 of them.

    Parameters
    ----------
    count : int
        Number of bodies.
    energy : function or Energy, or None
        From (q, p, S) in one array, shape (dim,), and the parameters of a body, to a scalar: with a heat capacity c,
        say, ``lambda x, c: c * jnp.exp(x[-1] / c)``. Or an Energy, the same for all. None where it is all in the
        coupling.
    dim : int
        2n + 1 components of each; 1 for bodies at rest.
    parameters : array, shape (count, ...), or tuple of such
        Parameters that differ from body to body, an entry for each.
    friction : optional
        Coefficients of linear friction (mass / time): a number, an array of shape (n,) for all, or (count, n). Or
        "contact": see :class:`Subsystem`.
    name : str, optional
        What the bodies are called in messages, with a number behind it.
    """

    energy: Energy | Callable
    parameters: tuple[jax.Array, ...]
    friction: jax.Array | str | None
    count: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    def __init__(self, count: int, energy, dim: int, parameters=(), friction=None, name: str | None = None):
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError(f"count, the number of bodies, must be an integer >= 1, got {count!r}")
        _check_dim(dim)
        self.count, self.dim, self.name = count, dim, name
        self.energy = Quadratic(jnp.zeros(dim)) if energy is None else energy
        parameter_tuple = parameters if isinstance(parameters, tuple) else (parameters,)
        self.parameters = tuple(
            checked_numbers(a, f"the parameters of {name or 'the bodies'}") for a in parameter_tuple
        )
        self.energy_of_whole_state(0)  # checked there
        self.friction = _checked_copies_friction(friction, count, dim, name or "the bodies")

    @property
    def degrees_of_freedom(self) -> int:
        return self.dim // 2

    @property
    def species(self) -> int:
        """Number of kinds of particles, which is 0: copies hold no matter."""
        return 0

    def energy_of_whole_state(self, start_index: int) -> Energy:
        """Return the energy of all copies as a function of the whole state, in which they begin at ``start_index``."""
        indices = np.arange(start_index, start_index + self.count * self.dim).reshape(self.count, self.dim)
        return Each(self.energy, indices, *self.parameters)


# -- arguments --------------------------------------------------------------------------------------------------------


def name_subsystems(subsystems) -> tuple[tuple[str, ...], tuple[Subsystem | Copies, ...]]:
    """Return a name for each subsystem, and the subsystems as a tuple; InputError for objects of other types."""
    if isinstance(subsystems, Mapping):
        names, bodies = tuple(map(str, subsystems)), tuple(subsystems.values())
    else:
        bodies = tuple(subsystems) if isinstance(subsystems, Iterable) else (subsystems,)
        starts = np.cumsum([0, *(body.count if isinstance(body, Subsystem | Copies) else 1 for body in bodies)])
        names = tuple(
            (body.name if isinstance(body, Subsystem | Copies) else None)
            or ("body" if isinstance(body, Copies) else f"body {i}")
            for body, i in zip(bodies, starts[:-1], strict=True)
        )
    for name, body in zip(names, bodies, strict=True):
        if not isinstance(body, Subsystem | Copies):
            raise InputError(f"{name} must be an lt.Subsystem or lt.Copies, got {type(body).__name__}")
    if not bodies:
        raise InputError("a composed system must have at least one subsystem")
    return names, bodies


def _check_dim(dim) -> None:
    """Raise InputError unless dim is 2n + 1, or 1."""
    if isinstance(dim, bool) or not isinstance(dim, int) or dim < 1 or dim % 2 == 0:
        raise InputError(f"dim, the size of a state (q, p, S), must be 2n + 1, or 1 for S alone, got {dim!r}")


def _checked_friction(friction, dim: int, name: str):
    """Check the friction of a body; return an array, shape (n,) or (n, n), a function, "contact" or None."""
    n = dim // 2
    if friction is None:
        return None
    if n == 0:
        raise InputError(f"{name} has no momenta, so it cannot have friction")
    if isinstance(friction, str):
        if friction != "contact":
            raise InputError(f"friction of {name} must be a coefficient or 'contact', got {friction!r}")
        return friction
    if callable(friction):
        shapes, at = ((), (n,), (n, n)), f"a state of shape ({dim},)"
        return traced_function_and_shape(friction, [(dim,)], shapes, f"friction of {name}", at)[0]
    R = checked_numbers(friction, f"friction of {name}", (), (n,), (n, n))
    R = jnp.full(n, R) if R.ndim == 0 else R
    if R.ndim == 2:
        return checked_semidefinite(R, f"the friction of {name}")
    return _require_nonnegative(R, name)


def _checked_copies_friction(friction, count: int, dim: int, name: str):
    """Return the friction of copies of a body as a checked array, shape (count, n), "contact" or None."""
    if friction is None or isinstance(friction, str):
        return _checked_friction(friction, dim, name)
    n, R = dim // 2, checked_numbers(friction, f"friction of {name}")
    if n == 0 or R.shape not in ((), (n,), (count, n)):
        raise InputError(
            f"friction of {name}, {count} with {n} momenta each, must have shape (), ({n},) or ({count}, {n}), "
            f"got {R.shape}"
        )
    return _require_nonnegative(jnp.broadcast_to(R, (count, n)), name)


def _require_nonnegative(R: jax.Array, name: str) -> jax.Array:
    """Return the friction coefficients R; InputError if one is negative."""
    require_condition(R.min(), lambda r: r >= 0.0, f"friction of {name} must be >= 0, got {{value:g}}")
    return R


class Membrane(Module):
    """A membrane through which particles pass between two bodies, driven by their chemical potentials.

    The numbers change by ``N_1' = L (mu_2 / T_2 - mu_1 / T_1 + …) = -N_2'``.

    Between equal temperatures ``J = L (mu_2 - mu_1) / T``; what the particles lose heats either body by half. Between
    bodies of different temperature the flux is driven by ``e (1/T_1 - 1/T_2) - (mu_1/T_1 - mu_2/T_2)``, with the energy
    ``e = (mu_1 + mu_2)/2 + s (T_1 + T_2)/2`` that a particle carries.

    Parameters
    ----------
    first, second : int or str
        The bodies, by number or by name.
    permeability : float, >= 0, or function of the whole state to one
        L (particles^2 / (entropy time)).
    species : int, or a pair of them
        Which of the particle numbers of a body, the same in both or one in each.
    carries : float
        s, the entropy that a particle carries.
    """

    first: int | str = eqx.field(static=True)
    second: int | str = eqx.field(static=True)
    permeability: jax.Array | Callable
    species: tuple[int, int] = eqx.field(static=True)
    carries: jax.Array

    def __init__(self, first, second, permeability, species: int | tuple[int, int] = 0, carries: float = 0.0):
        self.first, self.second = first, second
        self.permeability = _checked_coefficient(permeability, "the permeability of a membrane")
        pair = (species, species) if isinstance(species, int) else species
        if not (isinstance(pair, tuple) and len(pair) == 2 and all(type(kind) is int for kind in pair)):
            raise InputError(f"the species of a membrane must be an integer or a pair of integers, got {species!r}")
        self.species = pair
        self.carries = checked_numbers(carries, "the entropy that a particle carries", ())
        require_condition(
            self.carries, lambda s: abs(s) < np.inf, "the entropy that a particle carries must be finite, got {value}"
        )

    def make_process(self, body_names: Sequence[str], structure: mf.ExtendedPhaseSpace) -> Process:
        """Return the membrane as a :class:`Process` between bodies with ``body_names``, in states of a structure."""
        a, b = (_body_index(body, body_names) for body in (self.first, self.second))
        if a == b:
            raise InputError(f"a membrane must join two bodies, got {body_names[a]} twice")
        stoichiometry, sides = np.zeros(len(structure.particle_indices.N)), np.zeros((2, len(body_names)))
        for body, kind, sign in ((a, self.species[0], 1.0), (b, self.species[1], -1.0)):
            stoichiometry[_particle_index(body, kind, body_names, structure.particle_indices)] = sign
            sides[:, body] = 0.5, sign
        numbers, heat_shares, entropy_transport = (tuple(row.tolist()) for row in (stoichiometry, *sides))
        L = _checked_state_function(self.permeability, structure.dim, "the permeability of a membrane")
        return Process(numbers, heat_shares, entropy_transport, self.carries, L)


class Reaction(Module):
    """A chemical reaction among the particles of a body, driven by its affinity.

    It obeys ``N' = nu L A / T`` with the affinity ``A = -nu . mu``.

    It rests where ``nu . mu = 0``, the law of mass action of ideal gases. The rates of mass action themselves are those
    of ``L = (k_f prod n_educts - k_b prod n_products) T / A``, which is positive.

    Parameters
    ----------
    body : int or str
        Number or name of the body that reacts.
    stoichiometry : sequence of float
        nu, negative for what is used up: (-1, -1, 1) for A + B -> C.
    rate : float, >= 0, or function of the whole state to one
        L (particles^2 / (entropy time)).
    """

    body: int | str = eqx.field(static=True)
    stoichiometry: tuple[float, ...] = eqx.field(static=True)
    rate: jax.Array | Callable

    def __init__(self, body, stoichiometry: Sequence[float], rate):
        self.body, self.rate = body, _checked_coefficient(rate, "the rate of a reaction")
        numbers = checked_numbers(stoichiometry, "the stoichiometry of a reaction")
        if numbers.ndim != 1 or not (np.isfinite(numbers).all() and np.any(numbers)):
            raise InputError(f"the stoichiometry of a reaction must be a row of finite numbers, got {numbers.tolist()}")
        self.stoichiometry = tuple(numbers.tolist())

    def make_process(self, body_names: Sequence[str], structure: mf.ExtendedPhaseSpace) -> Process:
        """Return the reaction as a :class:`Process` among bodies with ``body_names``, in states of a structure."""
        body = _body_index(self.body, body_names)
        matter = structure.particle_indices
        indices = np.flatnonzero(matter.owner == body)
        if len(indices) != len(self.stoichiometry):
            raise InputError(
                f"a reaction in {body_names[body]} must have {len(indices)} stoichiometric numbers, "
                f"got {len(self.stoichiometry)}"
            )
        stoichiometry, heat_shares = np.zeros(len(matter.N)), np.zeros(len(body_names))
        stoichiometry[indices], heat_shares[body] = self.stoichiometry, 1.0
        zero_transport = (0.0,) * len(body_names)
        L = _checked_state_function(self.rate, structure.dim, "the rate of a reaction")
        return Process(tuple(stoichiometry.tolist()), tuple(heat_shares.tolist()), zero_transport, jnp.zeros(()), L)


def _checked_coefficient(coefficient, what: str) -> jax.Array | Callable:
    """Return a coefficient as a nonnegative number, shape (), or a function unchanged."""
    if callable(coefficient):
        return coefficient
    value = checked_numbers(coefficient, what, ())
    nonnegative_condition(what).require(value)
    return value


def _checked_state_function(coefficient, dim: int, what: str) -> jax.Array | Callable:
    """Return a coefficient unchanged, or traced and checked if it is a function of the whole state."""
    if not callable(coefficient):
        return coefficient
    return traced_function_and_shape(coefficient, [(dim,)], [()], what, f"a state of shape ({dim},)")[0]


def _body_index(body, body_names: Sequence[str]) -> int:
    """Return the index of a body that is given by number or by name; InputError if there is none."""
    if isinstance(body, str) and body in body_names:
        if list(body_names).count(body) > 1:
            raise InputError(f"{body!r} is the name of several bodies. Give the number of a body instead")
        return list(body_names).index(body)
    if isinstance(body, int) and not isinstance(body, bool) and 0 <= body < len(body_names):
        return body
    raise InputError(f"there is no body {body!r}. The bodies are {', '.join(body_names)}, counted from 0")


def _particle_index(
    body_index: int, kind_index: int, body_names: Sequence[str], particle_indices: ParticleIndices
) -> int:
    """Return the index of a particle number among all, for a kind of particles of a body."""
    indices = np.flatnonzero(particle_indices.owner == body_index)
    if not 0 <= kind_index < len(indices):
        raise InputError(
            f"{body_names[body_index]} has {len(indices)} kinds of particles, counted from 0, got the kind {kind_index}"
        )
    return int(indices[kind_index])
