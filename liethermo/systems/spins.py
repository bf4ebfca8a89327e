"""Spins on sites, alone or with the baths that they heat."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced, real_array
from manifolds._module import Module
from manifolds.structures.spins import added

from ..dissipation.base import Dissipation
from ..dissipation.landau_lifshitz import LandauLifshitz
from ..errors import InputError
from ..functions.checks import check_scalar, recognised
from ..functions.each import Each
from ..functions.energy import Energy, Function, Negative, Sum, TimeDependent, as_energy
from ..functions.magnetism import checked_sites
from ..functions.planes import by_planes, reach, to_planes, to_sites
from ..functions.spheres import Spheres, Squares
from ..functions.spins_and_baths import SpinsAndBaths
from .base import Arranged, System

LENGTHS = "sum |s|^2 / 2"


class SpinSystem(System):
    """``s_i' = gamma_i s_i x grad_i H`` at every site, damped, alone or with baths of their own entropies.

    A state is ``(s_1, s_2, …, y_1, …, y_m)`` in one row: the spins site by site in C order, then the entropy of each
    bath. Baths have the energy ``U(y)``, and ``T_b = dU/dy_b`` is their temperature; energy and entropy of the whole
    are ``H(s) + U(y)`` and ``sum y_b``. Every |s_i| is constant, to rounding, with every method of this library: no
    charts are needed, and memory and time of a step grow with the number of sites.

    Parameters
    ----------
    sites : int or tuple of int
    energy : Energy or function from s, shape ``(*sites, 3)``, to a scalar
        Such as a sum of the terms in ``lt.magnetism``. May depend on time.
    dissipation : LandauLifshitz, or a list of dissipations that act together; optional
    baths : HeatBaths, optional
    ratio : float, or array of the shape of the sites
        gamma_i.
    momentum_maps : dict of functions, or a sequence of them
        Of s, shape ``(*sites, 3)``.
    validate : bool

    Raises
    ------
    InputError, FunctionError, AxiomError
    """

    lattice: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        sites,
        energy,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        baths: HeatBaths | None = None,
        ratio=1.0,
        momentum_maps=(),
        validate: bool = True,
    ):
        self.lattice = checked_sites(sites)
        poisson = mf.Spins(self.lattice, 0 if baths is None else baths.number, ratio)
        terms = [_of_spins(term, self.lattice) for term in as_energy(energy, "the energy").terms]
        whole = terms[0] if len(terms) == 1 else Sum(tuple(terms))
        entropy = None if baths is None else _LastSum(baths.number)
        if baths is not None:
            whole = check_scalar(whole, self._size, "the energy", timed=True)
            if whole.depends_on_time:
                whole = Sum((*whole.terms, baths.at(self._size)))
            else:
                whole = SpinsAndBaths(recognised(whole, self._size), baths.at(0), self._size)
        named = momentum_maps if isinstance(momentum_maps, Mapping) else {J.__name__: J for J in momentum_maps}
        maps = {name: _of_spins(as_energy(J, f"momentum map {name!r}"), self.lattice) for name, J in named.items()}
        self._build(poisson, poisson.dim, whole, entropy, dissipation, maps, validate)

    def field(self, x, dH, dS, dL=()):
        """As for every system, the motion and the damping of the spins joined before they become a state's."""
        if type(self.dissipation) is not LandauLifshitz or not isinstance(self.poisson, mf.Spins):
            return super().field(x, dH, dS, dL)  # a class of its own may have a force of its own
        heating = None if self.entropy is None else dS[self._size :]  # the entropy is that of the baths
        damped, warmed = self.dissipation.parts(self, x, dH, None, heating)
        return self.poisson.joined(added(self.poisson.turned(x, dH), damped), warmed)

    def numbers(self, x, batch: bool = False):
        """A state in one row; also from the spins alone, with every bath at entropy zero.

        The spins have the shape ``(*sites, 3)``; a single one may have the shape (3,).
        """
        shape, given = (*self.lattice, 3), np.shape(x)
        if shape == (1, 3) and not batch and given == (3,):
            x, given = np.asarray(x)[None], shape
        if given != (self.dim,) and given[-len(shape) :] == shape and (batch or len(given) == len(shape)):
            flat = jnp.reshape(jnp.asarray(x, dtype=jnp.float64), (*given[: -len(shape)], -1))
            x = jnp.concatenate([flat, jnp.zeros((*flat.shape[:-1], self.dim - flat.shape[-1]))], axis=-1)
        elif given[-1:] != (self.dim,):
            raise InputError(
                f"a state has its spins in shape {shape}, or all {self.dim} components in one row, not shape {given}"
            )
        return super().numbers(x, batch)

    def spins(self, x) -> jax.Array:
        """The spins of states, shape (..., n) to ``(..., *sites, 3)``."""
        return _on_sites(jnp.asarray(x), self.lattice)

    def temperatures(self, x) -> jax.Array:
        """The temperatures of the baths: states of shape (..., n) give (..., m)."""
        x = jnp.asarray(x)
        return jnp.vectorize(self.energy.gradient, signature="(n)->(n)")(x)[..., self._size :]

    @property
    def _size(self) -> int:
        """How many components the spins have."""
        return 3 * math.prod(self.lattice)

    def casimirs(self) -> dict[str, Energy]:
        return {LENGTHS: Squares(math.prod(self.lattice))}

    @property
    def spheres(self) -> Spheres:
        assert isinstance(self.poisson, mf.Spins)
        return Spheres(math.prod(self.lattice), LENGTHS, self.poisson.planar)

    def arranged(self) -> Arranged | None:
        """With the spins component by component; what other dissipations do with components is not known."""
        spins = self.poisson
        known = type(self) is SpinSystem and type(self.dissipation) in (type(None), LandauLifshitz)
        if not known or not isinstance(spins, mf.Spins) or spins.planar or self.is_driven:
            return None
        count = spins.count
        planar = mf.Spins(spins.sites, spins.others, spins.ratio, reach(self.energy, spins.sites))
        there, back, pulled = (functools.partial(f, count=count) for f in (to_planes, to_sites, by_planes))
        functions = [pulled(f) for f in (self.energy, *self.momentum_maps.values())]
        system = eqx.tree_at(lambda s: [s.poisson, s.energy, *s.momentum_maps.values()], self, [planar, *functions])
        return Arranged(system, there, back, pulled)

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        found = super().samples(count, seed, scale)
        found[..., self._size :] *= min(1.0, 1.0 / scale)  # of a temperature exp(y) that is finite
        return found


class HeatBaths(Module):
    """Baths, each with an energy that is a function of its own entropy y: by default ``U = c T exp(y / c)``.

    That is a constant heat capacity c, and the temperature T at y = 0.

    Parameters
    ----------
    capacity, temperature : float > 0, or array, shape (number,)
    number : int
    energy : function from y, a scalar, to a scalar, optional
        The same for all baths, in place of the two numbers. It has to increase.
    """

    parameters: tuple[jax.Array, ...]
    function: Callable
    number: int = eqx.field(static=True)

    def __init__(self, capacity=1.0, temperature=1.0, number: int = 1, energy: Callable | None = None):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise InputError(f"the number of baths is a positive integer, not {number!r}")
        given = {"capacity": capacity, "temperature": temperature} if energy is None else {}
        self.parameters = tuple(_positive(value, what, number) for what, value in given.items())
        self.function, self.number = _warmth if energy is None else _OfEntropy(energy), number

    def at(self, place: int) -> Energy:
        """Their energy, of the components of a state from this place on."""
        return Each(self.function, place + np.arange(self.number)[:, None], *self.parameters)


def _positive(value, what: str, number: int) -> jax.Array:
    array = real_array(value)
    if array.shape not in ((), (number,)):
        raise InputError(f"the {what} of {number} baths is one number, or has shape ({number},), not {array.shape}")
    if not is_traced(array) and not bool(((array > 0.0) & jnp.isfinite(array)).all()):
        raise InputError(f"the {what} of a bath must be positive and finite, not {array.tolist()}")
    return jnp.broadcast_to(array, (number,))


def _warmth(y, capacity, temperature):
    return capacity * temperature * jnp.exp(y[0] / capacity)


class _OfEntropy(Module):
    energy: Callable

    def __call__(self, y):
        return self.energy(y[0])


def _of_spins(term: Energy, lattice: tuple[int, ...]) -> Energy:
    """A plain function of spins on their sites as one of states; terms of other kinds are of states already."""
    if isinstance(term, Negative):
        return Negative(_of_spins(term.term, lattice))
    if isinstance(term, Function | TimeDependent):
        return type(term)(_OfSpins(term.function, lattice))
    return term


class _OfSpins(Module):
    """A function of spins on their sites, as one of states."""

    function: Callable
    lattice: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x, *time):
        return self.function(_on_sites(x, self.lattice), *time)


def _on_sites(x, lattice: tuple[int, ...]) -> jax.Array:
    """The spins of states, shape (..., n) to ``(..., *sites, 3)``."""
    return x[..., : 3 * math.prod(lattice)].reshape(*x.shape[:-1], *lattice, 3)


class _LastSum(Energy):
    """The sum of the last components: the entropies of the baths."""

    number: int = eqx.field(static=True)

    @property
    def is_quadratic(self) -> bool:
        return True

    def value(self, x) -> jax.Array:
        return jnp.sum(x[-self.number :])

    def gradient(self, x) -> jax.Array:
        return jnp.where(jnp.arange(x.size) < x.size - self.number, 0.0, 1.0)
