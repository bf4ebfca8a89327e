"""``AttitudeSystem``: the momentum of a Lie-Poisson system together with its attitude, an element of the group."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import forward_to, replace_fields
from manifolds.groups import maps

from ..errors import InputError
from ..functions.energy import Energy, Linear
from ..tracing.interpret import evaluate_at_points
from .attitude_layout import AttitudeLayout
from .base import System
from .clock import Clock
from .driven import DrivenSystem
from .interface import EngineHints, WrappedSystem
from .kind_checks import require_kind, unwrap_user_system
from .lie_poisson import LiePoissonSystem
from .lifted import LiftedSystem
from .rotations import attitude_array
from .transport import dissipation_keeps_spatial_momentum

SPATIAL_MOMENTUM = "momentum in space"
"""Name of the constant of the motion ``Ad_star(inverse(g), mu)``."""

MOMENTUM_LESS_IMPULSE = "momentum in space less the impulse"
"""Name of the constant of the motion if a torque acts: the spatial momentum minus the impulse of the torque."""

IMPULSE_NAME = "impulse"
"""Name of the impulse of a torque on the spatial momentum; the number of the component follows."""


class AttitudeSystem(LiftedSystem):
    """A Lie-Poisson system for mu together with ``g' = g hat(xi(mu))`` [:doc:`/explanation/exact_laws`].

    A state consists of the state of the body, mu first, and the entries of g row by row; imaginary parts follow for
    complex groups. If a torque tau acts, the accumulated impulse comes last, ``p' = Ad_star(inverse(g), tau)``. Energy,
    entropy and Casimirs are functions of mu. :func:`liethermo.integrate` builds it from a system with a group.

    Attributes
    ----------
    body : LiePoissonSystem, or DrivenSystem of one
    reconstruction : {"coadjoint", "cayley", "exp"}
        Method that computes the attitude: see :class:`~liethermo.integrators.WithAttitude`.
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
        self.dim = self.attitude_layout.impulse_start + self.impulse_dim
        self.poisson, self.dissipation, self.momentum_maps = body.poisson, body.dissipation, {}
        self.energy = self.lift_energy(body.energy)
        self.entropy = None if body.entropy is None else self.lift_energy(body.entropy)
        self.preserved_labels, self.invariant_verdicts = body.preserved_labels, body.invariant_verdicts

    @property
    def engine_hints(self) -> EngineHints:
        series_maps = {"exp": maps.exp, "coadjoint": maps.adjoint_cayley}
        group_maps = {"exp": self.group.exp_map, "coadjoint": self.group.adjoint_cayley_map}
        kind = self.reconstruction
        has_closed_form = kind not in group_maps or group_maps[kind] is not series_maps[kind]
        engine_hints = super().engine_hints
        return engine_hints._replace(
            can_unroll=engine_hints.can_unroll and self.attitude_layout.n_reals_per_entry == 1 and has_closed_form
        )

    @property
    def momentum_system(self) -> LiePoissonSystem:
        """The Lie-Poisson system of the momentum mu and the baths, without attitude and clock."""
        return momentum_system_of(self.body)

    @property
    def attitude_layout(self) -> AttitudeLayout:
        return AttitudeLayout(self.group, self.body.dim, self.impulse_dim)

    @property
    def wrapped_system(self) -> WrappedSystem:
        return WrappedSystem(self.body, AttitudeSystem, (self.reconstruction,))

    @property
    def clock(self) -> Clock | None:
        clock = self.body.clock
        return clock and replace_fields(clock, n_trailing_counters=self.impulse_dim)

    def body_at_attitude_of_state(self, x) -> LiePoissonSystem | DrivenSystem:
        """Return the body with its torque bound to the attitude of a state."""
        return self.body.bind_attitude(self.attitude_layout.split_state(x)[1])

    def subsystem_to_solve(self, x) -> tuple[System, jax.Array]:
        return self.body_at_attitude_of_state(x), self.body_states(x)

    def momentum_to_space_matrix(self, g) -> jax.Array:
        """Return the matrix A, shape (..., n, n), that maps a body momentum to space, ``mu @ A``, at the attitude g."""
        return self.group.Ad(self.group.inverse_map(g))

    def initial_state(self, mu, t: float = 0.0, attitude=None, batch: bool = False) -> jax.Array:
        """Return the state with a momentum and an attitude (default: identity) at the time t; several with ``batch``.

        Raises
        ------
        InputError
            If the attitude is not in the group.
        """
        attitude = attitude_array(attitude, self.group)
        g = self.group.identity if attitude is None else self.group._element(attitude, "attitude")
        if not is_traced(g):
            with jax.ensure_compile_time_eval():  # JAX may be tracing something else
                if not bool(self.group.belongs(g).all()):
                    residual = float(self.group.defect(g).max())
                    raise InputError(
                        f"the attitude is not in {self.group.name}: relative distance {residual:.3g}, tolerance 1e-10"
                    )
        mu = jnp.asarray(self.body.initial_state(mu, t, None, batch))
        batch_shape = jnp.broadcast_shapes(mu.shape[:-1], g.shape[:-2])
        if batch_shape and not batch:
            raise InputError(f"a run has one attitude, of shape {self.group.identity.shape}, got {g.shape}")
        mu, g = jnp.broadcast_to(mu, (*batch_shape, mu.shape[-1])), jnp.broadcast_to(g, (*batch_shape, *g.shape[-2:]))
        if not self.impulse_dim:
            return self.attitude_layout.join_state(mu, g)
        return self.attitude_layout.join_state(
            mu, g, jnp.einsum("...a,...ab->...b", mu[..., : self.group.dim], self.momentum_to_space_matrix(g))
        )

    def body_states(self, x) -> jax.Array:
        """Return the states of the body, shape (..., body.dim), from states with an attitude, shape (..., n)."""
        return x[..., : self.body.dim]

    def points(self, x):
        """Return the states of the body, of which energy, entropy and Casimirs are functions."""
        return self.body_states(x)

    def user_state(self, x):
        return self.body.user_state(self.body_states(x))

    def slope_scales(self, slopes):
        """Return the scale of each component of slopes, shape (..., n), separate for momenta and for attitudes."""
        n, m = self.body.dim, self.dim - self.impulse_dim
        scales = [self.body.slope_scales(slopes[..., :n]), super().slope_scales(slopes[..., n:m])]
        if m < self.dim:
            scales.append(super().slope_scales(slopes[..., m:]))
        return jnp.concatenate(scales, axis=-1)

    def to_user_solution(self, solution):
        states, g = self.attitude_layout.split_state(solution.x)
        stats = dataclasses.replace(
            solution.stats,
            attitude_residual=self.max_attitude_residual(solution.x),
            spatial_momentum_change=self.max_spatial_momentum_change(solution.x),
        )
        dense = None if solution.dense is None else solution.dense.with_output_map(self.body_states)
        series = {name: f - f[0] if name in self.impulse_names else f for name, f in solution.casimirs.items()}
        body_solution = dataclasses.replace(solution, x=np.asarray(states), dense=dense, stats=stats, casimirs=series)
        body_solution = self.body.to_user_solution(body_solution)
        return dataclasses.replace(body_solution, attitude=np.ascontiguousarray(g)).with_provenance(
            system=type(self.momentum_system).__name__,
            algebra=self.momentum_system.algebra.name,
            x0=body_solution.x[0].tolist(),
        )

    def max_attitude_residual(self, states) -> float:
        """Return the largest relative distance between the attitudes of states, shape (m, n), and the group."""
        return float(np.max(_evaluate_at_states(_attitude_residual, self, states)))

    def max_spatial_momentum_change(self, states) -> float:
        """Return the largest relative change of the spatial momentum minus impulse among states, shape (m, n).

        The change is relative to the largest term that is added up in a component.
        """
        momenta, scales = _evaluate_at_states(_spatial_momentum_and_scale, self, states)
        scale = float(np.max(scales))
        return float(np.abs(momenta - momenta[0]).max()) / (scale if scale > 0.0 else 1.0)

    inertia = forward_to("momentum_system")

    @property
    def vector_invariant_names(self):
        if not dissipation_keeps_spatial_momentum(self.body):
            return ()
        return (MOMENTUM_LESS_IMPULSE,) if self.impulse_dim else (SPATIAL_MOMENTUM,)

    @property
    def impulse_dim(self) -> int:
        """Number of components of the impulse; 0 if no torque changes the momenta."""
        return self.group.dim if self.body.torque_laws.has_impulse else 0

    @property
    def impulse_names(self) -> tuple[str, ...]:
        """Names of the components of the impulse."""
        return tuple(f"{IMPULSE_NAME} {i + 1}" for i in range(self.impulse_dim))

    @property
    def ledger_functions(self):
        body_ledger = {name: self.lift_energy(f) for name, f in self.body.ledger_functions.items()}
        return body_ledger | {
            name: Linear(jnp.ones(1)).on([i - self.group.dim]) for i, name in enumerate(self.impulse_names)
        }

    @property
    def state_blocks(self):
        n, m = self.body.dim, self.dim - self.impulse_dim
        return *_body_block_slices(self.body), slice(n, m), *([slice(m, None)] if m < self.dim else [])

    def attitude_velocity(self, x) -> jax.Array:
        """Return the velocity xi of the attitude at a state, ``g' = g hat(xi)``, shape (group.dim,)."""
        mu, body = self.body_states(x), self.body_at_attitude_of_state(x)
        dS = body.entropy_gradient(mu)
        xi = body.attitude_velocity_from_gradients(
            mu, body.energy.gradient(mu), dS, tuple(L.gradient(mu) for L in body.preserved_functions)
        )
        return xi[: self.group.dim]

    def _vector_field(self, x):
        (mu, g), body = self.attitude_layout.split_state(x), self.body_at_attitude_of_state(x)
        p = body.external_torque(mu)[: self.group.dim] @ self.momentum_to_space_matrix(g) if self.impulse_dim else None
        return self.attitude_layout.join_state(
            body._vector_field(mu), g @ self.group.algebra.hat(self.attitude_velocity(x)), p
        )


def _body_block_slices(body: System) -> list[slice]:
    """Return the blocks of the body as slices of a state, which begins with the state of the body."""
    return [slice(*block.indices(body.dim)) for block in body.state_blocks]


def _evaluate_at_states(function: Callable, system: AttitudeSystem, states):
    """Return the values of ``function(system, x)`` at each state x, shape (m, n), with m as the first axis."""
    rows = np.minimum(
        np.arange(1 << (len(states) - 1).bit_length()), len(states) - 1
    )  # padded to a power of two, so that few programs are compiled
    return evaluate_at_points(function, system, np.asarray(states)[rows])


def momentum_system_of(body: System) -> LiePoissonSystem:
    """Return the user's Lie-Poisson system, without the clock of a driven system; InputError for other systems."""
    return require_kind(unwrap_user_system(body), LiePoissonSystem, "an attitude")


def _attitude_residual(system: AttitudeSystem, x) -> jax.Array:
    """Return the relative distance of the attitude of one state from the group, shape ()."""
    return system.group.defect(system.attitude_layout.split_state(x)[1])


def _spatial_momentum_and_scale(system: AttitudeSystem, x) -> tuple[jax.Array, jax.Array]:
    """Return the spatial momentum minus the impulse, and the size of the terms that cancel in it."""
    (state, g), p = system.attitude_layout.split_state(x), system.attitude_layout.impulse(x)
    mu, action = state[: system.group.dim], system.momentum_to_space_matrix(g)
    momentum = mu @ action
    scale = jnp.maximum(jnp.max(jnp.abs(mu) @ jnp.abs(action)), system.body.body_kinematics.momentum_scale(state))
    return momentum - p if system.impulse_dim else momentum, scale


ANGLE_UNIT = 2.0**-300
"""Unit of the angles that are stored beside a momentum. It is so small that angles do not count in a norm of the state,
which the momentum alone determines, be it 1e20 or 1e-20. It is a power of two, so that scaling rounds nothing."""


class AttitudeChartSystem(LiftedSystem):
    """A body in exponential coordinates (mu, theta) around a fixed attitude g; its attitude is ``g exp(hat(theta))``.

    ``theta' = dexp(theta)^-1 xi(mu)`` [Munthe-Kaas 1999]: a system on a vector space, for one step of a method
    that needs no more. The laws are those of mu. Theta is in units of
    :data:`ANGLE_UNIT`, and so is the spatial impulse that follows it if a torque acts.

    Attributes
    ----------
    attitude_system : AttitudeSystem
    order : int
        Highest power of theta in the series for its velocity.
    attitude : array, shape (m, m)
        The element g of the group.
    """

    attitude_system: AttitudeSystem
    order: int = eqx.field(static=True)
    attitude: jax.Array

    def __init__(self, attitude_system: AttitudeSystem, series_order: int, attitude: jax.Array):
        body = attitude_system.body
        self.attitude_system, self.order, self.attitude = attitude_system, series_order, attitude
        self.dim, self.space = body.dim + attitude_system.group.dim + attitude_system.impulse_dim, None
        self.poisson = mf.NoPoisson(self.dim)  # field() computes the motion
        self.energy, self.entropy = attitude_system.energy, attitude_system.entropy
        self._lift_laws()

    @property
    def inner_system(self) -> LiePoissonSystem | DrivenSystem:
        return self.attitude_system.body

    @property
    def state_blocks(self):
        n, m = self.inner_system.dim, self.inner_system.dim + self.attitude_system.group.dim
        return *_body_block_slices(self.inner_system), slice(n, m), *([slice(m, None)] if m < self.dim else [])

    def pullback(self, energy: Energy) -> Energy:
        return self.lift_energy(energy)

    def field(self, x, dH, dS, dL=()):
        body, arguments = self.inner_system_at(x), self.restrict_to_inner_state(x, dH, dS, dL)
        algebra = self.attitude_system.group.algebra
        velocity = body.attitude_velocity_from_gradients(*arguments)[: algebra.dim]
        angle_rates = maps.inverse_dexp(algebra, self.rotation_angles(x), velocity, self.order)
        rates = [body.field(*arguments), ANGLE_UNIT * angle_rates]
        if self.torque_laws.has_impulse:
            torque = body.external_torque(arguments[0])
            assert torque is not None
            rates.append(
                ANGLE_UNIT
                * (torque[: algebra.dim] @ self.attitude_system.momentum_to_space_matrix(self._attitude_at(x)))
            )
        return jnp.concatenate(rates)

    def inner_system_at(self, x) -> System:
        body = self.inner_system
        return body.bind_attitude(self._attitude_at(x)) if body.torque_laws.needs_attitude else body

    def _attitude_at(self, x) -> jax.Array:
        """Return the attitude matrix, shape (m, m), at coordinates x of the chart."""
        group = self.attitude_system.group
        return self.attitude @ group.exp_map(group.algebra, self.rotation_angles(x))

    # -- coordinates --------------------------------------------------------------------------------------------------

    def coordinates_of_state(self, x) -> jax.Array:
        """Return the coordinates (mu, 0, impulse) of a state x at the centre of the chart, shape (dim,)."""
        return jnp.concatenate(
            [
                self.attitude_system.body_states(x),
                jnp.zeros(self.attitude_system.group.dim),
                ANGLE_UNIT * self.attitude_system.attitude_layout.impulse(x),
            ]
        )

    def rotation_angles(self, coordinates) -> jax.Array:
        """Return the angles theta, shape (..., algebra.dim), from coordinates of the chart, shape (..., dim)."""
        n = self.inner_system.dim
        return coordinates[..., n : n + self.attitude_system.group.dim] / ANGLE_UNIT

    def spatial_impulse(self, coordinates) -> jax.Array:
        """Return the spatial impulse, shape (..., algebra.dim), from coordinates of the chart, shape (..., dim)."""
        return coordinates[..., self.inner_system.dim + self.attitude_system.group.dim :] / ANGLE_UNIT
