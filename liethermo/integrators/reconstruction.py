"""Reconstruction: the attitude of a body, stepped along with its momentum at the order of any method."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds._pytree_module import replace_fields
from manifolds.groups.maps import central_part, components_from_ad_cayley, inverse_dexp
from manifolds.matrices.linear import solve_without_pivoting

from ..errors import InputError
from ..functions.frames import vector_with_inner_products
from ..functions.gradients import two_sum
from ..systems import MOMENTUM_LESS_IMPULSE, SPATIAL_MOMENTUM, AttitudeChartSystem, AttitudeSystem
from ..systems.transport import dissipation_keeps_spatial_momentum
from .base import MethodWrapper, TransportingMethod, pullback_method
from .explicit import StepRow
from .tableaus import gauss_tableau

RECONSTRUCTIONS = ("coadjoint", "cayley", "exp")
"""Names of the reconstructions."""


class WithAttitude(MethodWrapper):
    """Step the attitude of a body, ``g' = g hat(xi)``, along with its momentum.

    The momentum follows the inner method alone, with tolerances for the momentum alone. The attitude is then computed
    from the velocities xi_i at the stages without an iteration, so it does not depend on the units of the momentum. xi
    is the discrete gradient of the energy plus the velocity that internal friction adds
    [:meth:`liethermo.Dissipation.added_attitude_velocity`].

    ``"cayley"`` is Gauss collocation on the matrices, ``G_i = g + h sum_j A_ij G_j hat(xi_j)``: with one stage ``g' = g
    cayley(h xi)``. It preserves quadratic properties of g: that g is orthogonal, unitary or symplectic.

    ``"coadjoint"`` is the same collocation on the matrices Ad(g), which ends at ``Ad(g) R``: ``g' = g
    adjoint_cayley(x)`` with ``cay(ad x) = R``, and with one stage x = h xi. Without a torque ``mu' = ad*_xi mu`` gives
    ``mu' = R^T mu`` for any number of stages, every step and every energy, if the slopes of the method are Pi times a
    covector. So the spatial momentum ``Ad_star(inverse(g), mu)`` is conserved to rounding: for a free body, and for a
    body with a :class:`liethermo.DoubleBracket`. R is an adjoint action for SO(2), SO(3), SO(4), SE(2), SE(3), SU(2),
    SL(2), Sp(1), GL(2) and Heisenberg(n); on SO(2), SO(3), SE(2) and Heisenberg(n) ``"cayley"`` is the same method. R
    is no adjoint action for SU(n) and SL(n) with n > 2, Sp(n) with n > 1, SO(n) with n > 4, SE(n) with n > 3. On these
    groups collocation moves mu off its coadjoint orbit by O(h^(2s)), as Casimirs of higher degree drift, and the
    spatial momentum is conserved to the order of the method.

    ``"exp"`` is collocation in the algebra, ``g' = g exp(h sum b_i k_i)`` with ``k_i = dexp^-1(h sum_j A_ij k_j) xi_i``
    [Munthe-Kaas 1999]: with one stage ``g' = g exp(h xi)``. The attitude stays in every group; the spatial momentum is
    conserved to the order of the method.

    Explicit methods always use ``"exp"``: their step is that of (mu, theta), ``g' = g exp(theta)``. Without a torque
    they rotate a little further, by no more than the error of the step, so that the spatial momentum is that of the
    start of the run. This holds on coadjoint orbits of dimension two, such as those of SO(3), SU(2), SL(2) and SE(2).

    A torque that depends on the attitude is evaluated at the attitudes of the stages, which follow from the slopes of
    the momentum: the unknowns of a step stay the same. Its impulse is ``h sum_i b_i Ad_star(inverse(g), tau)_i`` with
    the same collocation on the matrices Ad(g). This preserves bilinear functions of these matrices and mu. So the
    spatial momentum less the impulse is constant to rounding, wherever the spatial momentum is without a torque.
    Explicit methods compute the impulse by a quadrature of their order; then the impulse and the attitude are
    corrected, by no more than the error of the step, so that the same holds.

    For a given step the momenta are those of the inner method without attitudes, and the order is the same for all
    three reconstructions. An attitude turns also where the momentum rests, as in a steady spin. Adaptive steps are
    therefore limited by its rate: see :func:`.step_control.max_step_times_rate`.

    Attributes
    ----------
    kind : {"coadjoint", "cayley", "exp"}
    """

    kind: str = eqx.field(static=True)

    def __check_init__(self):
        if self.kind not in RECONSTRUCTIONS:
            raise InputError(f"reconstruction must be {', '.join(map(repr, RECONSTRUCTIONS))}, got {self.kind!r}")

    @property
    def _checked_inner_method(self) -> TransportingMethod:
        """The inner method; InputError if it does not give the velocities with which it moves a body."""
        if isinstance(self.method, TransportingMethod):
            return self.method
        raise InputError(f"{self.method} does not give its stage velocities, so attitudes cannot be reconstructed")

    def preserves_function(self, system, name: str) -> bool:
        if name not in (SPATIAL_MOMENTUM, MOMENTUM_LESS_IMPULSE):
            return self.method.preserves_function(system.body, name)
        follows = self.kind == "coadjoint" or (self.kind == "cayley" and system.group.cayley_is_adjoint())
        return (self.explicit or follows) and self._checked_inner_method.follows_attitude_exactly(system.body)

    def check(self, system) -> None:
        self.method.check(system.body.bind_attitude(system.group.identity))

    # -- the momentum, which the equations of a step are about --------------------------------------------------------

    def slopes(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:  # type: ignore[override]
        """Return the slopes of the momentum; for an explicit method also those of the rotation angles."""
        method, mu, mu_compensation = self.method, system.body_states(x), system.body_states(compensation)
        if self.explicit:
            local = AttitudeChartSystem(system, self.order, system.attitude_layout.split_state(x)[1])
            return pullback_method(method, local).slopes(
                local, local.coordinates_of_state(x), local.coordinates_of_state(compensation), h, k
            )
        body = system.body
        if not body.torque_laws.needs_attitude:
            return method.slopes(body, mu, mu_compensation, h, k)
        slopes_for_torque = jax.vmap(
            lambda torque: method.slopes(replace_fields(body, torque=torque), mu, mu_compensation, h, k)
        )
        slopes_by_torque = slopes_for_torque(
            self._stage_torques(system, x, compensation, h, k)
        )  # all stages with the torques of all
        return jnp.stack([slopes_by_torque[i, i] for i in range(self.stages)])

    def start(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        if not self.explicit:
            return self.method.start(system.body_at_attitude_of_state(x), system.body_states(x))
        mu, g = system.attitude_layout.split_state(x)
        local, n = AttitudeChartSystem(system, self.order, g), system.group.dim
        k = self.method.start(
            local, local.coordinates_of_state(x)
        )  # behind the levels that it has begun on is room for more
        return k.at[StepRow.INITIAL_LEVELS, mu.shape[0] : mu.shape[0] + n].set(
            mu[:n] @ system.momentum_to_space_matrix(g)
        )

    def error(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:  # type: ignore[override]
        return self.method.error(
            system.body_at_attitude_of_state(x),
            system.body_states(x),
            system.body_states(compensation),
            h,
            system.body_states(k),
        )

    def attitude_speed_bound(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        """Return a bound of the moduli of the eigenvalues of ad(xi): for SO(3) 1.2 times the angular velocity."""
        generator = system.group.algebra.ad(system.attitude_velocity(x))
        return jnp.sqrt(jnp.sqrt(jnp.sum((generator @ generator) ** 2)))

    def initial_compensation(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        layout = system.attitude_layout
        mu, g = layout.split_state(x)
        attitude_correction = (
            _additive_correction_onto_group(system.group, g) if self.kind == "cayley" else jnp.zeros_like(g)
        )
        momentum = jnp.zeros_like(layout.impulse(x)) if system.torque_laws.name else None
        return layout.join_state(self.method.initial_compensation(system.body, mu), attitude_correction, momentum)

    # -- the attitude, which follows from it --------------------------------------------------------------------------

    def move(self, system: AttitudeSystem, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:  # type: ignore[override]
        layout = system.attitude_layout
        (mu, g), (mu_compensation, g_compensation) = (
            layout.split_state(x),
            layout.split_state(compensation),
        )
        new_mu, new_mu_compensation = self.method.move(system.body, mu, mu_compensation, h, system.body_states(k))
        if self.explicit:
            return self._move_by_explicit_step(system, x, compensation, new_mu, new_mu_compensation, h, k)
        xi = (
            h
            * self._checked_inner_method.attitude_velocities_at_stages(system.body, mu, mu_compensation, h, k)[
                :, : system.group.dim
            ]
        )
        p, p_compensation = (
            self._next_spatial_momentum(system, x, compensation, h, k, xi) if system.impulse_dim else (None, None)
        )
        if self.kind == "cayley":
            dg = (g + g_compensation) @ _collocation_increment(system.group.algebra.hat(xi))
            new_g, new_g_compensation = two_sum(g, g_compensation + dg)
            return layout.join_state(new_mu, new_g, p), layout.join_state(
                new_mu_compensation,
                new_g_compensation + _additive_correction_onto_group(system.group, new_g),
                p_compensation,
            )
        new_g = system.group.restore_map(g @ self._attitude_increment(system.group, xi))
        return layout.join_state(new_mu, new_g, p), layout.join_state(
            new_mu_compensation, jnp.zeros_like(g), p_compensation
        )

    def _move_by_explicit_step(
        self, system: AttitudeSystem, x, compensation, new_mu, new_mu_compensation, h, k
    ) -> tuple[jax.Array, jax.Array]:
        """Return the state after an explicit step and its compensation, from the new momentum and its compensation."""
        layout = system.attitude_layout
        g, group, n = layout.split_state(x)[1], system.group, system.group.dim
        local, step = AttitudeChartSystem(system, self.order, g), self.increment(h, k)
        new_g = g @ group.exp_map(group.algebra, local.rotation_angles(step))
        keeps_orbit, p_compensation = (
            dissipation_keeps_spatial_momentum(system.body)
            and self._checked_inner_method.follows_attitude_exactly(system.body),
            None,
        )
        if system.impulse_dim:
            p, p_compensation = two_sum(
                layout.impulse(x),
                layout.impulse(compensation) + local.spatial_impulse(step),
            )
            if keeps_orbit:
                p, p_compensation = _project_onto_orbit(system.momentum_system, p, new_mu), jnp.zeros_like(p)
        else:  # use the spatial momentum at the start of the run: the roundings of steps would add up
            p = k[StepRow.INITIAL_LEVELS, system.body.dim : system.body.dim + n]
        if keeps_orbit:
            new_g = _align_attitude(group, new_g, p, new_mu[:n])
        new_g = group.restore_map(new_g)
        return layout.join_state(new_mu, new_g, p if system.impulse_dim else None), layout.join_state(
            new_mu_compensation, jnp.zeros_like(g), p_compensation
        )

    def step_without_compensation(self, system: AttitudeSystem, x, h) -> jax.Array:
        """Return the state after a step without compensated summation: see :class:`.MetriplecticRungeKutta`."""
        layout = system.attitude_layout
        g, group = layout.split_state(x)[1], system.group
        local = AttitudeChartSystem(system, self.order, g)
        method: Any = pullback_method(self.method, local)
        end = method.step_without_compensation(local, local.coordinates_of_state(x), h)
        return layout.join_state(system.body_states(end), g @ group.exp_map(group.algebra, local.rotation_angles(end)))

    def _attitude_increment(self, group, stage_angles) -> jax.Array:
        """Return the group element that rotates the attitude, for angles h xi at the stages, shape (stages, dim)."""
        if self.kind == "coadjoint":
            return self._group_increment(group, stage_angles)
        return group.exp_map(
            group.algebra, gauss_tableau(len(stage_angles)).b @ self._munthe_kaas_slopes(group.algebra, stage_angles)
        )

    def _stage_attitudes(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:
        """Return the attitudes at which the torques of the stages are evaluated, shape (stages, m, m)."""
        layout = system.attitude_layout
        (mu, g), (mu_compensation, g_compensation), group = (
            layout.split_state(x),
            layout.split_state(compensation),
            system.group,
        )
        xi = (
            h
            * self._checked_inner_method.attitude_velocities_at_stages(system.body, mu, mu_compensation, h, k)[
                :, : system.group.dim
            ]
        )
        if self.kind == "exp" or (self.kind == "coadjoint" and len(xi) > 1):
            return g @ group.exp_map(
                group.algebra, gauss_tableau(len(xi)).A @ self._munthe_kaas_slopes(group.algebra, xi)
            )
        if self.kind == "cayley":
            attitudes = (g + g_compensation) @ _collocation_stages(group.algebra.hat(xi))
        else:
            attitudes = (
                0.5 * (g + g @ self._attitude_increment(group, xi))[None]
            )  # the midpoint is the same from both ends
        for _ in range(RESTORE_STEPS):
            attitudes = group.restore_map(attitudes)
        return attitudes

    def _stage_torques(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:
        """Return the torques at the stages, shape (stages, body components without the clock)."""
        body, states = (
            system.body,
            system.body_states(x) + (system.body_states(compensation) + h * (gauss_tableau(len(k)).A @ k)),
        )
        if not body.torque_laws.needs_attitude:
            return jax.vmap(body.external_torque)(states)
        attitudes = self._stage_attitudes(system, x, compensation, h, k)
        return jax.vmap(lambda g, state: body.bind_attitude(g).external_torque(state))(attitudes, states)

    def _next_spatial_momentum(
        self, system: AttitudeSystem, x, compensation, h, k, stage_angles
    ) -> tuple[jax.Array, jax.Array]:
        """Return the spatial momentum after the impulse of the step, and its compensation."""
        layout = system.attitude_layout
        torques = self._stage_torques(system, x, compensation, h, k)[:, : system.group.dim]
        actions = _collocation_stages(-system.group.algebra.ad(stage_angles).swapaxes(-1, -2)).swapaxes(
            -1, -2
        )  # Ad(inverse(g)), relative
        impulse = h * jnp.einsum("i,ia,iab->b", gauss_tableau(len(stage_angles)).b, torques, actions)
        spatial_impulse = impulse @ system.momentum_to_space_matrix(layout.split_state(x)[1])
        return two_sum(layout.impulse(x), layout.impulse(compensation) + spatial_impulse)

    def displace(self, system: AttitudeSystem, x, v) -> jax.Array:  # type: ignore[override]
        """Displace the momentum alone: functions evaluated inside a step depend on it only."""
        layout = system.attitude_layout
        mu, g = layout.split_state(x)
        return layout.join_state(mu + system.body_states(v), g, layout.impulse(x))

    @staticmethod
    def _group_increment(group, stage_angles) -> jax.Array:
        """Return the group element whose adjoint action is that of the step, for angles h xi, shape (stages, dim).

        If the end of the collocation is no adjoint action, the nearest one is used, to the order of the method.
        """
        algebra = group.algebra
        if len(stage_angles) == 1:
            return group.adjoint_cayley_map(algebra, stage_angles[0])
        R = jnp.eye(algebra.dim) + _collocation_increment(algebra.ad(stage_angles))
        x = components_from_ad_cayley(algebra, R) + central_part(
            algebra, gauss_tableau(len(stage_angles)).b @ stage_angles
        )
        return group.adjoint_cayley_map(algebra, x)

    def _munthe_kaas_slopes(self, algebra, stage_angles) -> jax.Array:
        """Return h times the stage slopes of Munthe-Kaas collocation in the algebra, for angles h xi.

        They have the shape (stages, dim), as ``stage_angles`` has.

        Each sweep of the iteration gains a power of h; there is one more sweep than the order needs.
        """
        tableau, k = gauss_tableau(len(stage_angles)), stage_angles
        for _ in range(
            2 * len(stage_angles) - 1 if len(stage_angles) > 1 else 0
        ):  # with one stage k is xi, which commutes with itself
            k = inverse_dexp(algebra, tableau.A @ k, stage_angles, self.order)
        return k

    def __str__(self) -> str:
        return f"{self.method} with attitudes by {self.kind}"


RESTORE_STEPS = 3
"""Newton steps to the group from the mean of two attitudes.

A rotation by 0.5 in a step leaves a residual of 1e-11; a rotation by 0.2 leaves one below rounding.
"""


def _collocation_increment(stage_generators) -> jax.Array:
    """Return ``G - I`` at the end of Gauss collocation of ``G' = G X`` on [0, 1] from I, for X of shape (s, m, m)."""
    return jnp.einsum(
        "j,jab,jbc->ac", gauss_tableau(len(stage_generators)).b, _collocation_stages(stage_generators), stage_generators
    )


def _collocation_stages(stage_generators) -> jax.Array:
    """Return the stages G_i of Gauss collocation of ``G' = G X`` on [0, 1] from I, shape (s, m, m).

    They are solved for their transposes, ``G_i^T = I + sum_j A_ij X_j^T G_j^T``.
    """
    (stages, m), tableau = stage_generators.shape[:2], gauss_tableau(len(stage_generators))
    X_transposed = stage_generators.swapaxes(-1, -2)
    implicit = jnp.einsum("ij,jab->iajb", tableau.A, X_transposed).reshape(stages * m, stages * m)
    start = jnp.tile(jnp.eye(m), (stages, 1))
    G = solve_without_pivoting(jnp.eye(stages * m) - implicit, start).reshape(stages, m, m)
    return G.swapaxes(-1, -2)


RESTORE_FRACTION = 2.0**-6
"""Fraction of the correction to the group that a step applies where the correction is mere rounding of the entries."""


def _additive_correction_onto_group(group, g) -> jax.Array:
    """Return the matrix, shape (m, m), that added to an attitude g brings it back to its group.

    A correction of the size of rounding is no error of the step, since the compensation holds the rounding. Applied in
    full at every step it would add up, in one direction while the body spins steadily: to 1e-12 in 1e6 steps.
    """
    correction = group.restore_map(g) - g
    is_rounding = jnp.max(jnp.abs(correction)) <= 4.0 * jnp.finfo(jnp.float64).eps * jnp.max(jnp.abs(g))
    return jnp.where(is_rounding, RESTORE_FRACTION, 1.0) * correction


MAX_NEWTON_ITERATIONS = 3
"""Newton steps of :func:`_align_attitude` and :func:`_project_onto_orbit`; each squares the relative residual."""

NEWTON_DAMPING = 1e-8
"""Number added to the diagonal of a matrix that may be singular, relative to its largest entry.

A Newton step leaves this fraction of the residual, or its square. It is also the residual below which no further
step is taken."""


def _project_onto_orbit(momentum_system, p, mu) -> jax.Array:
    """Return a spatial momentum near p at which the Casimirs equal those at mu, with the internal momenta of mu."""
    n = len(p)
    scale = jnp.max(jnp.abs(mu[:n]))
    scale, casimirs = jnp.where(scale > 0.0, scale, 1.0), momentum_system.momentum_casimirs().values()
    p, mu = p / scale, mu[: momentum_system.algebra.dim] / scale
    for _ in range(MAX_NEWTON_ITERATIONS):
        momentum = jnp.concatenate([p, mu[n:]])
        residual = jnp.stack([C.value(mu) - C.value(momentum) for C in casimirs])
        p = p + vector_with_inner_products([C.gradient(momentum)[:n] for C in casimirs], residual)
    return scale * p


def _align_attitude(group, g, spatial_momentum, body_momentum) -> jax.Array:
    """Return the group element near g whose coadjoint action takes ``spatial_momentum`` to ``body_momentum``.

    Newton's method solves ``ad*_eta m = target - m`` for the least eta, where m is p seen from g [Marquardt 1963].
    """
    algebra, scale = group.algebra, jnp.max(jnp.abs(body_momentum))
    spatial_momentum, body_momentum = (
        v / jnp.where(scale > 0.0, scale, 1.0) for v in (spatial_momentum, body_momentum)
    )

    def newton_step(iteration: int, g) -> jax.Array:
        m = group.Ad_star(g, spatial_momentum)
        residual, orbit_tangents = body_momentum - m, algebra.ad_star(jnp.eye(algebra.dim), m)
        square = orbit_tangents @ orbit_tangents.T
        max_diagonal = jnp.max(jnp.diagonal(square))
        damping = jnp.where(
            max_diagonal > 0.0, NEWTON_DAMPING * max_diagonal, 1.0
        )  # what moves m by rounding alone does not turn either
        eta = solve_without_pivoting(square + damping * jnp.eye(algebra.dim), (orbit_tangents @ residual)[:, None])[
            :, 0
        ]
        g = g @ group.exp_map(algebra, eta)
        if iteration == MAX_NEWTON_ITERATIONS:
            return g
        return jax.lax.cond(
            jnp.max(jnp.abs(residual)) > NEWTON_DAMPING, lambda: newton_step(iteration + 1, g), lambda: g
        )

    return newton_step(1, g)
