"""A body with its attitude: the momentum of a Lie-Poisson system, and the element of the group that it moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import forward_to
from manifolds.groups import maps

from ..dissipation.base import LiftedDissipation, LiftedGeometry
from ..errors import InputError
from ..functions.energy import Energy, Linear
from ..tracing.interpret import evaluate_at_points
from .base import System
from .driven import DrivenSystem
from .lie_poisson import LiePoissonSystem

SPATIAL_MOMENTUM = "momentum in space"
"""The name of ``Ad_star(inverse(g), mu)`` among what is constant along a run."""

MOMENTUM_LESS_IMPULSE = "momentum in space less the impulse"
"""The name of what is constant in its place where a torque acts."""

IMPULSE_NAME = "impulse"
"""The name of what a torque has given to the momentum in space, before the number of a component."""


class AttitudeSystem(System):
    """A Lie-Poisson system for mu, and ``g' = g hat(transport(mu))`` beside it [:doc:`/explanation/exact_laws`].

    A state is that of the body, mu first, followed by the entries of g, row by row, their imaginary parts last where
    there are any. Where a torque tau acts, the momentum in space as its impulse makes it comes last, ``p' =
    Ad_star(inverse(g), tau)``. Energy, entropy and Casimirs are those of mu. Made by :func:`liethermo.integrate` from a
    system with a group.

    Attributes
    ----------
    body : LiePoissonSystem, or DrivenSystem of one
    reconstruction : {"coadjoint", "cayley", "exp"}
        How the attitude is found: see :class:`liethermo.WithAttitude`.
    group : manifolds.MatrixGroup
    """

    body: LiePoissonSystem | DrivenSystem
    reconstruction: str = eqx.field(static=True)
    group: mf.MatrixGroup = eqx.field(static=True)

    @property
    def matrix_group(self) -> mf.MatrixGroup:
        return self.group

    def __init__(self, body: LiePoissonSystem | DrivenSystem, reconstruction: str):
        group = momentum_system_of(body).group
        assert group is not None
        self.body, self.reconstruction, self.group, self.space = body, reconstruction, group, None
        self.dim = body.dim + self._n_real_parts * group.matrix_size**2 + (group.dim if body.has_impulse else 0)
        self.poisson, self.dissipation, self.momentum_maps = body.poisson, body.dissipation, {}
        self.energy = self._extend_from_momentum(body.energy)
        self.entropy = None if body.entropy is None else self._extend_from_momentum(body.entropy)
        self.preserved_labels, self.invariant_verdicts = body.preserved_labels, body.invariant_verdicts

    @property
    def can_unroll(self) -> bool:
        general = {"exp": maps.exp, "coadjoint": maps.adjoint_cayley}
        own = {"exp": self.group.exp_map, "coadjoint": self.group.adjoint_cayley_map}
        kind = self.reconstruction
        unrolls = kind not in own or own[kind] is not general[kind]  # a power series of matrices, squared up again
        return self.body.can_unroll and self._n_real_parts == 1 and unrolls

    @property
    def momentum_system(self) -> LiePoissonSystem:
        """The system of mu and of baths alone."""
        return momentum_system_of(self.body)

    torque_name = forward_to("body")
    has_impulse = forward_to("body")
    torque_invariant_casimirs = forward_to("body")

    def split_state(self, x) -> tuple[jax.Array, jax.Array]:
        """State of the body, shape (..., n), and group element, shape (..., m, m), of a state."""
        n, m = self.body.dim, self.group.matrix_size
        parts = x[..., n : n + self._n_real_parts * m**2].reshape(*x.shape[:-1], self._n_real_parts, m, m)
        return x[..., :n], parts[..., 0, :, :] if self._n_real_parts == 1 else parts[..., 0, :, :] + 1j * parts[
            ..., 1, :, :
        ]

    def spatial_impulse(self, x) -> jax.Array:
        """The momentum in space as the impulse of the torque makes it, shape (..., dim of the algebra); or (..., 0)."""
        return x[..., self.body.dim + self._n_real_parts * self.group.matrix_size**2 :]

    def join_state(self, mu, g, p=None) -> jax.Array:
        """The inverse of :meth:`split` and :meth:`spatial_impulse`."""
        parts = g[..., None, :, :] if self._n_real_parts == 1 else jnp.stack([g.real, g.imag], axis=-3)
        rest = [] if p is None else [p]
        return jnp.concatenate([mu, parts.reshape(*mu.shape[:-1], -1), *rest], axis=-1)

    def clock_components(self, v):
        mu, g = self.split_state(v)
        return self.join_state(
            self.body.clock_components(mu), jnp.zeros_like(g), self.spatial_impulse(v) if self.torque_name else None
        )

    def body_at_attitude(self, x) -> LiePoissonSystem | DrivenSystem:
        """The body, for use at the attitude of a state."""
        return self.body.bind_attitude(self.split_state(x)[1]) if isinstance(self.body, DrivenSystem) else self.body

    def solved_part(self, x) -> tuple[System, jax.Array]:
        return self.body_at_attitude(x), self.points(x)

    def spatial_action(self, g) -> jax.Array:
        """The matrix, shape (..., n, n), that a dual vector is multiplied by from the left to become one in space."""
        return self.group.Ad(self.group.inverse_map(g))

    def initial_state(self, mu, attitude=None, batch: bool = False, t: float = 0.0) -> jax.Array:
        """The state with a momentum and an attitude, the identity by default, at a time; or several, with ``batch``.

        Raises
        ------
        InputError
            If the attitude is not in the group.
        """
        g = self.group.identity if attitude is None else self.group._element(attitude, "attitude")
        if not is_traced(g):
            with jax.ensure_compile_time_eval():  # something else may be traced meanwhile
                if not bool(self.group.belongs(g).all()):
                    residual = float(self.group.defect(g).max())
                    raise InputError(
                        f"the attitude is not in {self.group.name}: relative distance {residual:.3g}, tolerance 1e-10"
                    )
        body = self.body
        mu = body.initial_state(mu, t, batch) if isinstance(body, DrivenSystem) else body.state(mu, batch)
        size = jnp.broadcast_shapes(mu.shape[:-1], g.shape[:-2])
        if size and not batch:
            raise InputError(f"a run has one attitude, of shape {self.group.identity.shape}, not {g.shape}")
        mu, g = jnp.broadcast_to(mu, (*size, mu.shape[-1])), jnp.broadcast_to(g, (*size, *g.shape[-2:]))
        if not self.has_impulse:
            return self.join_state(mu, g)
        return self.join_state(mu, g, jnp.einsum("...a,...ab->...b", mu[..., : self.group.dim], self.spatial_action(g)))

    def points(self, x):
        """The states of the body: what functions of the state are functions of."""
        return x[..., : self.body.dim]

    def user_state(self, x):
        return self.body.user_state(self.points(x))

    def outside(self, x) -> str:
        return self.body.outside(self.points(x))

    def domain_margin(self, x):
        return self.body.domain_margin(self.points(x))

    def why_singular(self, x) -> str:
        return self.body.why_singular(self.points(x))

    def component_scales(self, k):
        """Those of momenta, which have a unit, and of attitudes, which have none."""
        n, m = self.body.dim, self.dim - self.spatial_impulse(k).shape[-1]
        parts = [self.body.component_scales(k[..., :n]), super().component_scales(k[..., n:m])]
        return jnp.concatenate([*parts, *([super().component_scales(k[..., m:])] if m < self.dim else [])], axis=-1)

    def raise_index(self, x, alpha):
        n = self.body.dim
        return jnp.concatenate([self.body.raise_index(x[:n], alpha[:n]), alpha[n:]])

    def lower_index(self, x, v):
        n = self.body.dim
        return jnp.concatenate([self.body.lower_index(x[:n], v[:n]), v[n:]])

    def to_user_solution(self, solution):
        states, g = self.split_state(solution.x)
        stats = dataclasses.replace(
            solution.stats,
            attitude_residual=self.max_attitude_residual(solution.x),
            spatial_momentum_change=self.max_spatial_momentum_change(solution.x),
        )
        dense = None if solution.dense is None else solution.dense.with_output_map(self.points)
        series = {name: f - f[0] if name in self.impulse_names else f for name, f in solution.casimirs.items()}
        of_body = dataclasses.replace(solution, x=np.asarray(states), dense=dense, stats=stats, casimirs=series)
        found = self.body.to_user_solution(of_body)
        return dataclasses.replace(found, attitude=np.ascontiguousarray(g)).with_provenance(
            system=type(self.momentum_system).__name__,
            algebra=self.momentum_system.algebra.name,
            x0=found.x[0].tolist(),
        )

    def max_attitude_residual(self, x) -> float:
        """The largest distance of the attitudes of states, shape (m, n), from the group, relative to their size."""
        return float(np.max(_evaluate_at_states(_attitude_residual, self, x)))

    def max_spatial_momentum_change(self, x) -> float:
        """The largest change of the momentum in space along states, shape (m, n), the first being that at the start.

        Less the impulse, where a torque acts.

        Relative to the largest of the terms that it is the sum of.
        """
        found, sizes = _evaluate_at_states(_spatial_momentum_and_scale, self, x)
        size = float(np.max(sizes))
        return float(np.abs(found - found[0]).max()) / (size if size > 0.0 else 1.0)

    inertia = forward_to("momentum_system")

    @property
    def constant_names(self):
        if not self.body.is_torque_free:
            return ()
        return (MOMENTUM_LESS_IMPULSE,) if self.has_impulse else (SPATIAL_MOMENTUM,)

    @property
    def impulse_names(self) -> tuple[str, ...]:
        """The names of the components of the impulse; none where no torque acts."""
        return tuple(f"{IMPULSE_NAME} {i + 1}" for i in range(self.group.dim)) if self.has_impulse else ()

    @property
    def ledger(self):
        found = {name: self._extend_from_momentum(f) for name, f in self.body.ledger.items()}
        return found | {name: Linear(jnp.ones(1)).on([i - self.group.dim]) for i, name in enumerate(self.impulse_names)}

    balance_entries = forward_to("body")

    @property
    def state_blocks(self):
        n, m = self.body.dim, self.dim - (self.group.dim if self.has_impulse else 0)
        return *_body_blocks(self.body), slice(n, m), *([slice(m, None)] if m < self.dim else [])

    def invariants(self):
        return {name: (self._extend_from_momentum(J), kept) for name, (J, kept) in self.body.invariants().items()}

    def _vector_field(self, x):
        (mu, g), body = self.split_state(x), self.body_at_attitude(x)
        dS = None if body.entropy is None else body.entropy.gradient(mu)
        xi = body.transport(mu, body.energy.gradient(mu), dS, body._preserved_gradients(mu))
        p = body.external_torque(mu)[: self.group.dim] @ self.spatial_action(g) if self.has_impulse else None
        return self.join_state(body._vector_field(mu), g @ self.group.algebra.hat(xi[: self.group.dim]), p)

    def _extend_from_momentum(self, energy: Energy) -> Energy:
        return energy.on(range(self.body.dim))

    @property
    def _n_real_parts(self) -> int:
        return 2 if self.group.is_complex else 1


def _body_blocks(body: System) -> list[slice]:
    """The blocks of the states of a body, as those of the first part of longer states."""
    return [slice(*block.indices(body.dim)) for block in body.state_blocks]


def _evaluate_at_states(function: Callable, system: AttitudeSystem, x):
    """The values of ``function(system, x)`` at states, shape (m, n)."""
    rows = np.minimum(np.arange(1 << (len(x) - 1).bit_length()), len(x) - 1)  # few lengths, so few compilations
    return evaluate_at_points(function, system, np.asarray(x)[rows])


def momentum_system_of(body: System) -> LiePoissonSystem:
    """The system of momenta in one that may be driven."""
    found = body.body if isinstance(body, DrivenSystem) else body
    assert isinstance(found, LiePoissonSystem)
    return found


def _attitude_residual(system: AttitudeSystem, x) -> jax.Array:
    return system.group.defect(system.split_state(x)[1])


def _spatial_momentum_and_scale(system: AttitudeSystem, x) -> tuple[jax.Array, jax.Array]:
    """The momentum in space, less what the impulse makes of it, and the size of the largest terms in it."""
    (state, g), p = system.split_state(x), system.spatial_impulse(x)
    mu, action = state[: system.group.dim], system.spatial_action(g)
    found = mu @ action
    return found - p if system.has_impulse else found, jnp.max(jnp.abs(mu) @ jnp.abs(action))


ANGLE_UNIT = 2.0**-300
"""Angles beside a momentum are kept in a unit this small, so that they count for nothing in the length of a step that
is measured by the momentum, be that of 1e20 or of 1e-20. A power of two, so that nothing is rounded."""


class TurningSystem(System):
    """A body in coordinates (mu, theta) around an attitude g, which it turns to ``g exp(hat(theta))``.

    ``theta' = dexp(theta)^-1 transport(mu)`` [Munthe-Kaas 1999]: a system on a vector space, for one step of a method
    that needs no more. The laws are those of mu. Theta is in units of :data:`UNIT`, and so is the momentum in space
    that is behind it where a torque acts.

    Attributes
    ----------
    attitude_system : AttitudeSystem
    order : int
        The power of theta to which its velocity is computed.
    attitude : array, shape (m, m)
        g.
    """

    attitude_system: AttitudeSystem
    order: int = eqx.field(static=True)
    attitude: jax.Array

    def __init__(self, attitude_system: AttitudeSystem, order: int, attitude: jax.Array):
        body = attitude_system.body
        self.attitude_system, self.order, self.attitude = attitude_system, order, attitude
        self.dim, self.space = body.dim + attitude_system.group.dim * (2 if attitude_system.has_impulse else 1), None
        self.poisson = mf.NoPoisson(self.dim)  # the motion is that of field()
        self.energy, self.entropy = attitude_system.energy, attitude_system.entropy
        self.momentum_maps = {name: self.pullback(J) for name, J in body.momentum_maps.items()}
        self.dissipation = _MomentumDissipation.lift_terms(body.dissipation, self.pullback)
        self.preserved_labels, self.invariant_verdicts = body.preserved_labels, body.invariant_verdicts

    @property
    def state_blocks(self):
        n, m = self.attitude_system.body.dim, self.attitude_system.body.dim + self.attitude_system.group.dim
        return *_body_blocks(self.attitude_system.body), slice(n, m), *([slice(m, None)] if self.has_impulse else [])

    def pullback(self, energy: Energy) -> Energy:
        return self.attitude_system._extend_from_momentum(energy)

    torque_name = forward_to("attitude_system")
    has_impulse = forward_to("attitude_system")
    torque_invariant_casimirs = forward_to("attitude_system")

    def casimirs(self):
        return {name: self.pullback(C) for name, C in self.attitude_system.body.casimirs().items()}

    raise_index = forward_to("attitude_system")
    lower_index = forward_to("attitude_system")

    def field(self, x, dH, dS, dL=()):
        body, n = self.body_at_attitude(x), self.attitude_system.body.dim
        given = x[:n], dH[:n], None if dS is None else dS[:n], tuple(L[:n] for L in dL)
        algebra = self.attitude_system.group.algebra
        turning = maps.inverse_dexp(algebra, self.angles(x), body.transport(*given)[: algebra.dim], self.order)
        rates = [body.field(*given), ANGLE_UNIT * turning]
        if self.has_impulse:
            push = body.external_torque(x[:n])
            assert push is not None
            rates.append(ANGLE_UNIT * (push[: algebra.dim] @ self.attitude_system.spatial_action(self._attitude_at(x))))
        return jnp.concatenate(rates)

    def body_at_attitude(self, x) -> System:
        """The body, for use at the attitude of the coordinates."""
        body = self.attitude_system.body
        return (
            body.bind_attitude(self._attitude_at(x)) if isinstance(body, DrivenSystem) and body.needs_attitude else body
        )

    def _attitude_at(self, x) -> jax.Array:
        group = self.attitude_system.group
        return self.attitude @ group.exp_map(group.algebra, self.angles(x))

    # -- coordinates --------------------------------------------------------------------------------------------------

    def local_coordinates(self, x) -> jax.Array:
        """The coordinates of a state around its own attitude."""
        return jnp.concatenate(
            [
                self.attitude_system.points(x),
                jnp.zeros(self.attitude_system.group.dim),
                ANGLE_UNIT * self.attitude_system.spatial_impulse(x),
            ]
        )

    def angles(self, v) -> jax.Array:
        """Theta of a vector of coordinates, shape (..., dim of the algebra)."""
        n = self.attitude_system.body.dim
        return v[..., n : n + self.attitude_system.group.dim] / ANGLE_UNIT

    def spatial_impulse(self, v) -> jax.Array:
        """The momentum in space of a vector of coordinates, shape (..., dim of the algebra)."""
        return v[..., self.attitude_system.body.dim + self.attitude_system.group.dim :] / ANGLE_UNIT


class _MomentumDissipation(LiftedDissipation):
    """A dissipation of the momentum."""

    is_noiseless = forward_to("inner")

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        n = system.attitude_system.body.dim
        return LiftedGeometry(
            system.body_at_attitude(x), x[:n], lambda alpha: alpha[:n], lambda v: jnp.pad(v, (0, len(x) - n))
        )
