"""A body with its attitude: the momentum of a Lie-Poisson system, and the element of the group that it moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.groups import maps

from ..dissipation.base import Carried
from ..errors import InputError
from ..functions.energy import Energy, Sum
from ..functions.of_first import OfFirst
from ..tracing.interpret import at_points
from .base import System
from .lie_poisson import LiePoissonSystem

SPATIAL_MOMENTUM = "momentum in space"
"""The name of ``Ad_star(inverse(g), mu)`` among what is constant along a run."""


class AttitudeSystem(System):
    """A Lie-Poisson system for mu, and ``g' = g hat(transport(mu))`` beside it [:doc:`/explanation/exact_laws`].

    A state is mu, with the entropies of baths where there are any, followed by the entries of g, row by row, their
    imaginary parts last where there are any. Energy, entropy and Casimirs are those of mu. Made by
    :func:`liethermo.integrate` from a system with a group.

    Attributes
    ----------
    body : LiePoissonSystem
    reconstruction : {"coadjoint", "cayley", "exp"}
        How the attitude is found: see :class:`liethermo.WithAttitude`.
    group : manifolds.MatrixGroup
    """

    body: LiePoissonSystem
    reconstruction: str = eqx.field(static=True)
    group: mf.MatrixGroup = eqx.field(static=True)

    def __init__(self, body: LiePoissonSystem, reconstruction: str):
        assert body.group is not None
        self.body, self.reconstruction, self.group, self.space = body, reconstruction, body.group, None
        self.dim = body.dim + self._parts * self.group.matrix_size**2
        self.poisson, self.dissipation, self.momentum_maps = body.poisson, body.dissipation, {}
        self.energy = self._of_momentum(body.energy)
        self.entropy = None if body.entropy is None else self._of_momentum(body.entropy)
        self.preserved_as, self.decided = body.preserved_as, body.decided

    @property
    def unrollable(self) -> bool:
        general = {"exp": maps.exp, "coadjoint": maps.adjoint_cayley}
        own = {"exp": self.group.exp_map, "coadjoint": self.group.adjoint_cayley_map}
        kind = self.reconstruction
        unrolls = kind not in own or own[kind] is not general[kind]  # a power series of matrices, squared up again
        return self.body.unrollable and self._parts == 1 and unrolls

    def split(self, x) -> tuple[jax.Array, jax.Array]:
        """State of the body, shape (..., n), and group element, shape (..., m, m), of a state."""
        n, m = self.body.dim, self.group.matrix_size
        parts = x[..., n:].reshape(*x.shape[:-1], self._parts, m, m)
        return x[..., :n], parts[..., 0, :, :] if self._parts == 1 else parts[..., 0, :, :] + 1j * parts[..., 1, :, :]

    def join(self, mu, g) -> jax.Array:
        """The inverse of :meth:`split`."""
        parts = g[..., None, :, :] if self._parts == 1 else jnp.stack([g.real, g.imag], axis=-3)
        return jnp.concatenate([mu, parts.reshape(*mu.shape[:-1], -1)], axis=-1)

    def begin(self, mu, attitude=None, batch: bool = False) -> jax.Array:
        """The state with a momentum and an attitude, the identity by default; or several, with ``batch``.

        Raises
        ------
        InputError
            If the attitude is not in the group.
        """
        g = self.group.identity if attitude is None else self.group._element(attitude, "attitude")
        if not bool(self.group.belongs(g).all()):
            residual = float(self.group.defect(g).max())
            raise InputError(
                f"the attitude is not in {self.group.name}: relative distance {residual:.3g}, tolerance 1e-10"
            )
        mu = self.body.state(mu, batch)
        size = jnp.broadcast_shapes(mu.shape[:-1], g.shape[:-2])
        if size and not batch:
            raise InputError(f"a run has one attitude, of shape {self.group.identity.shape}, not {g.shape}")
        return self.join(jnp.broadcast_to(mu, (*size, mu.shape[-1])), jnp.broadcast_to(g, (*size, *g.shape[-2:])))

    def points(self, x):
        """The states of the body: what functions of the state are functions of."""
        return x[..., : self.body.dim]

    def sizes(self, k):
        """Those of momenta, which have a unit, and of attitudes, which have none."""
        n = self.body.dim
        return jnp.concatenate([self.body.sizes(k[..., :n]), super().sizes(k[..., n:])], axis=-1)

    def presented(self, solution):
        mu, g = self.split(solution.x)
        stats = dataclasses.replace(
            solution.stats,
            attitude_residual=self.distance(solution.x),
            spatial_momentum_change=self.change_in_space(solution.x),
        )
        dense = None if solution.dense is None else solution.dense.through(self.points)
        return dataclasses.replace(
            self.body.presented(solution), x=mu, attitude=np.ascontiguousarray(g), dense=dense, stats=stats
        ).with_provenance(
            system=type(self.body).__name__,
            algebra=self.body.algebra.name,
            x0=np.asarray(mu[0]).tolist(),
        )

    def distance(self, x) -> float:
        """The largest distance of the attitudes of states, shape (m, n), from the group, relative to their size."""
        return float(np.max(_at_states(_distance, self, x)))

    def change_in_space(self, x) -> float:
        """The largest change of the momentum in space along states, shape (m, n), the first being that at the start.

        Relative to the largest of the terms that it is the sum of.
        """
        found, sizes = _at_states(_in_space, self, x)
        size = float(np.max(sizes))
        return float(np.abs(found - found[0]).max()) / (size if size > 0.0 else 1.0)

    @property
    def inertia(self):
        return self.body.inertia

    @property
    def constants(self):
        return (SPATIAL_MOMENTUM,) if self.body.torque_free else ()

    @property
    def blocks(self):
        return *self.body.blocks, slice(self.body.dim, None)

    def invariants(self):
        return {name: (self._of_momentum(J), kept) for name, (J, kept) in self.body.invariants().items()}

    def _vector_field(self, x):
        (mu, g), body = self.split(x), self.body
        dS = None if body.entropy is None else body.entropy.gradient(mu)
        xi = body.transport(mu, body.energy.gradient(mu), dS, body._preserved_gradients(mu))
        return self.join(body._vector_field(mu), g @ self.group.algebra.hat(xi[: self.group.dim]))

    def _of_momentum(self, energy: Energy) -> Energy:
        terms = tuple(OfFirst(term, self.body.dim) for term in energy.terms)
        return terms[0] if len(terms) == 1 else Sum(terms)

    @property
    def _parts(self) -> int:
        return 2 if jnp.iscomplexobj(self.group.identity) else 1


def _at_states(function: Callable, system: AttitudeSystem, x):
    """The values of ``function(system, x)`` at states, shape (m, n)."""
    rows = np.minimum(np.arange(1 << (len(x) - 1).bit_length()), len(x) - 1)  # few lengths, so few compilations
    return at_points(function, system, np.asarray(x)[rows])


def _distance(system: AttitudeSystem, x) -> jax.Array:
    return system.group.defect(system.split(x)[1])


def _in_space(system: AttitudeSystem, x) -> tuple[jax.Array, jax.Array]:
    """The momentum in space, and the size of the largest terms in it."""
    (state, g), group = system.split(x), system.group
    mu = state[: group.algebra.dim]
    action = group.Ad(group.inverse_map(g))
    return mu @ action, jnp.max(jnp.abs(mu) @ jnp.abs(action))


UNIT = 2.0**-300
"""Angles beside a momentum are kept in a unit this small, so that they count for nothing in the length of a step that
is measured by the momentum, be that of 1e20 or of 1e-20. A power of two, so that nothing is rounded."""


class TurningSystem(System):
    """A body in coordinates (mu, theta) around an attitude g, which it turns to ``g exp(hat(theta))``.

    ``theta' = dexp(theta)^-1 transport(mu)`` [Munthe-Kaas 1999]: a system on a vector space, for one step of a method
    that needs no more. The laws are those of mu. Theta is in units of :data:`UNIT`.

    Attributes
    ----------
    whole : AttitudeSystem
    order : int
        The power of theta to which its velocity is computed.
    """

    whole: AttitudeSystem
    order: int = eqx.field(static=True)

    def __init__(self, whole: AttitudeSystem, order: int):
        body = whole.body
        self.whole, self.order, self.dim, self.space = whole, order, body.dim + whole.group.dim, None
        self.poisson = mf.NoPoisson(self.dim)  # the motion is that of field()
        self.energy, self.entropy = whole.energy, whole.entropy
        self.momentum_maps = {name: self.pulled(J) for name, J in body.momentum_maps.items()}
        self.dissipation = _OnMomentum.of(body.dissipation, self.pulled)
        self.preserved_as, self.decided = body.preserved_as, body.decided

    @property
    def blocks(self):
        return *self.whole.body.blocks, slice(self.whole.body.dim, None)

    def pulled(self, energy: Energy) -> Energy:
        return self.whole._of_momentum(energy)

    def casimirs(self):
        return {name: self.pulled(C) for name, C in self.whole.body.casimirs().items()}

    def field(self, x, dH, dS, dL=()):
        body, n = self.whole.body, self.whole.body.dim
        given = x[:n], dH[:n], None if dS is None else dS[:n], tuple(L[:n] for L in dL)
        algebra = self.whole.group.algebra
        turning = maps.inverse_dexp(algebra, self.angles(x), body.transport(*given)[: algebra.dim], self.order)
        return jnp.concatenate([body.field(*given), UNIT * turning])

    # -- coordinates --------------------------------------------------------------------------------------------------

    def around(self, x) -> jax.Array:
        """The coordinates of a state around its own attitude."""
        return jnp.concatenate([self.whole.points(x), jnp.zeros(self.whole.group.dim)])

    def angles(self, v) -> jax.Array:
        """Theta of a vector of coordinates, shape (..., dim of the group)."""
        return v[..., self.whole.body.dim :] / UNIT


class _OnMomentum(Carried):
    """A dissipation of the momentum."""

    def force(self, system, x, dH, dS, dL):
        body = system.whole.body
        n = body.dim
        dS, dL = None if dS is None else dS[:n], tuple(L[:n] for L in dL)
        return jnp.pad(self.part.force(body, x[:n], dH[:n], dS, dL), (0, len(x) - n))
