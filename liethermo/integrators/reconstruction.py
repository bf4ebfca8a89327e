"""Reconstruction: the attitude of a body, stepped along with its momentum at the order of any method."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.groups.maps import central_part, from_adjoint_cayley, inverse_dexp
from manifolds.matrices.linear import solve_near_identity

from ..errors import InputError
from ..functions.frames import vector_with_products
from ..functions.gradients import two_sum
from ..systems import MOMENTUM_LESS_IMPULSE, SPATIAL_MOMENTUM, AttitudeSystem, DrivenSystem, TurningSystem
from .base import MethodWrapper, TransportingMethod, pullback_method
from .explicit import INITIAL_LEVELS_ROW
from .tableaus import gauss_tableau

RECONSTRUCTIONS = ("coadjoint", "cayley", "exp")


class WithAttitude(MethodWrapper):
    """A method for momenta, and after it ``g' = g hat(xi)``, xi_i the velocities that it moves with at its stages.

    The equations of a step are those of the momentum alone, and their tolerances are measured by it. The attitude is
    then found without any: so it does not depend on the units of the momentum. xi is the discrete gradient of the
    energy, and what friction inside adds to it [:meth:`liethermo.Dissipation.velocity`].

    ``"cayley"`` is Gauss collocation on the matrices, ``G_i = g + h sum_j A_ij G_j hat(xi_j)``: with one stage
    ``g' = g cayley(h xi)``. It keeps what is quadratic in g: that g is orthogonal, unitary or symplectic.

    ``"coadjoint"`` is the same collocation on the matrices Ad(g), which ends at ``Ad(g) R``: ``g' = g
    adjoint_cayley(x)`` with ``cay(ad x) = R``, and with one stage x = h xi. Where no torque acts ``mu' = ad*_xi mu``
    gives ``mu' = R^T mu`` at every number of stages, for every step and every energy, as long as the method takes its
    slopes from Pi alone. So the spatial momentum ``Ad_star(inverse(g), mu)`` is kept to rounding: of a free body, and
    of one with a :class:`liethermo.DoubleBracket`. That R is an adjoint action
    is a property of the group: it is for SO(2), SO(3), SO(4), SE(2), SE(3), SU(2), SL(2), Sp(1), GL(2) and
    Heisenberg(n), of which ``"cayley"`` is the same on SO(2), SO(3), SE(2) and Heisenberg(n). It is not for SU(n) and
    SL(n) with n > 2, Sp(n) with n > 1, SO(n) with n > 4, SE(n) with n > 3: there collocation takes mu off its coadjoint
    orbit by O(h^(2s)), as Casimirs of higher degree drift, and the spatial momentum is kept to the order of the method.

    ``"exp"`` is collocation in the algebra, ``g' = g exp(h sum b_i k_i)`` with ``k_i = dexp^-1(h sum_j A_ij k_j) xi_i``
    [Munthe-Kaas 1999]: with one stage ``g' = g exp(h xi)``. It stays in every group; spatial momenta are kept to the
    order of the method.

    Explicit methods turn by ``"exp"``, whatever is asked for: their step is that of (mu, theta), ``g' = g exp(theta)``.
    Where no torque acts they turn a little further, by no more than the error of the step, so that the momentum in
    space is what it was when the run began: on coadjoint orbits of two dimensions, as those of SO(3), SU(2), SL(2) and
    SE(2) are.

    A torque that depends on the attitude is taken at those of the stages, which follow from the slopes of the momentum:
    so the unknowns of a step are the same. Its impulse is ``h sum_i b_i Ad_star(inverse(g), tau)_i`` with the same
    collocation on the matrices Ad(g). What is bilinear in these and in mu is kept by it, and so the momentum in space
    less the impulse is constant to rounding, where it is without a torque. Explicit methods make the impulse by a
    quadrature of their order. It moves, and the attitude turns, by no more than the error of the step, so that the same
    holds.

    Momenta are those that the method gives without attitudes; the order is the same for all three.

    Attributes
    ----------
    kind : {"coadjoint", "cayley", "exp"}
    """

    kind: str = eqx.field(static=True)

    def __check_init__(self):
        if self.kind not in RECONSTRUCTIONS:
            raise InputError(f"the reconstruction is {', '.join(map(repr, RECONSTRUCTIONS))}, not {self.kind!r}")

    @property
    def _transporting_method(self) -> TransportingMethod:
        """The method, which says how it moves the body."""
        if isinstance(self.method, TransportingMethod):
            return self.method
        raise InputError(
            f"{self.method} does not say which velocities it moves with, so attitudes cannot be reconstructed"
        )

    def preserves_function(self, system, name: str) -> bool:
        if name not in (SPATIAL_MOMENTUM, MOMENTUM_LESS_IMPULSE):
            return self.method.preserves_function(system.body, name)
        follows = self.kind == "coadjoint" or (self.kind == "cayley" and system.group.cayley_is_adjoint())
        return (self.explicit or follows) and self._transporting_method.can_transport_attitude(system.body)

    def check(self, system) -> None:
        body = system.body
        self.method.check(body.bind_attitude(system.group.identity) if isinstance(body, DrivenSystem) else body)

    # -- the momentum, which the equations of a step are about --------------------------------------------------------

    def slopes(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:  # type: ignore[override]
        """Those of the momentum; of an explicit method those of the angles beside it."""
        method, mu, mu_compensation = self.method, system.points(x), system.points(compensation)
        if self.explicit:
            local = TurningSystem(system, self.order, system.split_state(x)[1])
            return pullback_method(method, local).slopes(
                local, local.local_coordinates(x), local.local_coordinates(compensation), h, k
            )
        body = system.body
        if not (isinstance(body, DrivenSystem) and body.needs_attitude):
            return method.slopes(body, mu, mu_compensation, h, k)
        pushed = jax.vmap(lambda torque: method.slopes(body.with_torque(torque), mu, mu_compensation, h, k))
        found = pushed(self._stage_torques(system, x, compensation, h, k))  # all stages with the torques of all
        return jnp.stack([found[i, i] for i in range(self.stages)])

    def start(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        if not self.explicit:
            return self.method.start(system.body_at_attitude(x), system.points(x))
        mu, g = system.split_state(x)
        local, n = TurningSystem(system, self.order, g), system.group.dim
        k = self.method.start(
            local, local.local_coordinates(x)
        )  # behind the levels that it has begun on is room for more
        return k.at[INITIAL_LEVELS_ROW, mu.shape[0] : mu.shape[0] + n].set(mu[:n] @ system.spatial_action(g))

    def error(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:  # type: ignore[override]
        return self.method.error(
            system.body_at_attitude(x), system.points(x), system.points(compensation), h, system.points(k)
        )

    def initial_compensation(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        mu, g = system.split_state(x)
        off = _group_correction(system.group, g) if self.kind == "cayley" else jnp.zeros_like(g)
        momentum = jnp.zeros_like(system.spatial_impulse(x)) if system.torque_name else None
        return system.join_state(self.method.initial_compensation(system.body, mu), off, momentum)

    # -- the attitude, which follows from it --------------------------------------------------------------------------

    def move(self, system: AttitudeSystem, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:  # type: ignore[override]
        (mu, g), (mu_compensation, g_compensation) = system.split_state(x), system.split_state(compensation)
        new, new_compensation = self.method.move(system.body, mu, mu_compensation, h, system.points(k))
        if self.explicit:
            return self._apply_explicit_step(system, x, compensation, new, new_compensation, h, k)
        xi = (
            h
            * self._transporting_method.stage_velocities(system.body, mu, mu_compensation, h, k)[:, : system.group.dim]
        )
        p, p_compensation = (
            self._update_spatial_momentum(system, x, compensation, h, k, xi) if system.has_impulse else (None, None)
        )
        if self.kind == "cayley":
            gained = (g + g_compensation) @ _collocation_increment(system.group.algebra.hat(xi))
            turned, turned_compensation = two_sum(g, g_compensation + gained)
            return system.join_state(new, turned, p), system.join_state(
                new_compensation, turned_compensation + _group_correction(system.group, turned), p_compensation
            )
        turned = system.group.restore_map(g @ self._attitude_increment(system.group, xi))
        return system.join_state(new, turned, p), system.join_state(new_compensation, jnp.zeros_like(g), p_compensation)

    def _apply_explicit_step(
        self, system: AttitudeSystem, x, compensation, new, new_compensation, h, k
    ) -> tuple[jax.Array, jax.Array]:
        g, group, n = system.split_state(x)[1], system.group, system.group.dim
        local, step = TurningSystem(system, self.order, g), self.increment(h, k)
        turned = g @ group.exp_map(group.algebra, local.angles(step))
        follows, p_compensation = (
            system.body.is_torque_free and self._transporting_method.can_transport_attitude(system.body),
            None,
        )
        if system.has_impulse:
            p, p_compensation = two_sum(
                system.spatial_impulse(x), system.spatial_impulse(compensation) + local.spatial_impulse(step)
            )
            if follows:
                p, p_compensation = _project_onto_orbit(system.momentum_system, p, new), jnp.zeros_like(p)
        else:  # that of the start of the run, since the roundings of steps would add up
            p = k[INITIAL_LEVELS_ROW, system.body.dim : system.body.dim + n]
        if follows:
            turned = _align_attitude(group, turned, p, new[:n])
        turned = group.restore_map(turned)
        return system.join_state(new, turned, p if system.has_impulse else None), system.join_state(
            new_compensation, jnp.zeros_like(g), p_compensation
        )

    def step_without_compensation(self, system: AttitudeSystem, x, h) -> jax.Array:
        """A step without care for rounding, of a method that has such: see :meth:`.MetriplecticRungeKutta.plain`."""
        g, group = system.split_state(x)[1], system.group
        local = TurningSystem(system, self.order, g)
        method: Any = pullback_method(self.method, local)
        end = method.step_without_compensation(local, local.local_coordinates(x), h)
        return system.join_state(system.points(end), g @ group.exp_map(group.algebra, local.angles(end)))

    def _attitude_increment(self, group, xi) -> jax.Array:
        """By what an attitude is turned in a step, of angles h xi at the stages, shape (stages, dim)."""
        if self.kind == "coadjoint":
            return self._coadjoint_increment(group, xi)
        return group.exp_map(group.algebra, gauss_tableau(len(xi)).b @ self._algebra_slopes(group.algebra, xi))

    def _stage_attitudes(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:
        """Those at the stages, at which torques are taken, shape (stages, m, m), in the group."""
        (mu, g), (mu_compensation, g_compensation), group = (
            system.split_state(x),
            system.split_state(compensation),
            system.group,
        )
        xi = (
            h
            * self._transporting_method.stage_velocities(system.body, mu, mu_compensation, h, k)[:, : system.group.dim]
        )
        if self.kind == "exp" or (self.kind == "coadjoint" and len(xi) > 1):
            return g @ group.exp_map(group.algebra, gauss_tableau(len(xi)).A @ self._algebra_slopes(group.algebra, xi))
        if self.kind == "cayley":
            found = (g + g_compensation) @ _collocation_stages(group.algebra.hat(xi))
        else:
            found = 0.5 * (g + g @ self._attitude_increment(group, xi))[None]  # the same from either end
        for _ in range(RESTORE_STEPS):
            found = group.restore_map(found)
        return found

    def _stage_torques(self, system: AttitudeSystem, x, compensation, h, k) -> jax.Array:
        """Those at the stages, shape (stages, size of a state of the body without its clock)."""
        body, states = system.body, system.points(x) + (system.points(compensation) + h * (gauss_tableau(len(k)).A @ k))
        assert isinstance(body, DrivenSystem)
        if not body.needs_attitude:
            return jax.vmap(body.external_torque)(states)
        attitudes = self._stage_attitudes(system, x, compensation, h, k)
        return jax.vmap(lambda g, state: body.bind_attitude(g).external_torque(state))(attitudes, states)

    def _update_spatial_momentum(
        self, system: AttitudeSystem, x, compensation, h, k, xi
    ) -> tuple[jax.Array, jax.Array]:
        """The momentum in space as the impulse of the step makes it, and what rounding keeps from it."""
        torques = self._stage_torques(system, x, compensation, h, k)[:, : system.group.dim]
        actions = _collocation_stages(-system.group.algebra.ad(xi).swapaxes(-1, -2)).swapaxes(
            -1, -2
        )  # Ad(inverse(g)), relative
        impulse = h * jnp.einsum("i,ia,iab->b", gauss_tableau(len(xi)).b, torques, actions)
        gained = impulse @ system.spatial_action(system.split_state(x)[1])
        return two_sum(system.spatial_impulse(x), system.spatial_impulse(compensation) + gained)

    def displace(self, system: AttitudeSystem, x, v) -> jax.Array:  # type: ignore[override]
        """With the momentum displaced: what is looked at on the way of a step are functions of that."""
        mu, g = system.split_state(x)
        return system.join_state(mu + system.points(v), g, system.spatial_impulse(x))

    @staticmethod
    def _coadjoint_increment(group, xi) -> jax.Array:
        """The element of the group whose adjoint action is that of the step; of angles h xi, shape (stages, dim).

        Where the end of collocation is no adjoint action it is that of the nearest, to the order of the method.
        """
        algebra = group.algebra
        if len(xi) == 1:
            return group.adjoint_cayley_map(algebra, xi[0])
        R = jnp.eye(algebra.dim) + _collocation_increment(algebra.ad(xi))
        x = from_adjoint_cayley(algebra, R) + central_part(algebra, gauss_tableau(len(xi)).b @ xi)
        return group.adjoint_cayley_map(algebra, x)

    def _algebra_slopes(self, algebra, xi) -> jax.Array:
        """h theta' at the stages of collocation in the algebra, shape (stages, dim).

        A sweep of iteration gains a power of the step; so many are one more than its order needs.
        """
        tableau, k = gauss_tableau(len(xi)), xi
        for _ in range(2 * len(xi) - 1 if len(xi) > 1 else 0):  # of one stage k is xi, which commutes with itself
            k = inverse_dexp(algebra, tableau.A @ k, xi, self.order)
        return k

    def __str__(self) -> str:
        return f"{self.method} with attitudes by {self.kind}"


RESTORE_STEPS = 3
"""Newton steps to the group from the mean of two attitudes: where a step turns by 0.5, what is left is 1e-11, and
below rounding where it turns by 0.2."""


def _collocation_increment(X) -> jax.Array:
    """``G - I``, G the end of Gauss collocation of ``G' = G X`` on [0, 1] from I, for X at the stages, (s, m, m)."""
    return jnp.einsum("j,jab,jbc->ac", gauss_tableau(len(X)).b, _collocation_stages(X), X)


def _collocation_stages(X) -> jax.Array:
    """The stages G_i of that collocation, shape (s, m, m).

    Solved for their transposes, ``G_i^T = I + sum_j A_ij X_j^T G_j^T``.
    """
    (stages, m), tableau = X.shape[:2], gauss_tableau(len(X))
    turned = X.swapaxes(-1, -2)
    implicit = jnp.einsum("ij,jab->iajb", tableau.A, turned).reshape(stages * m, stages * m)
    start = jnp.tile(jnp.eye(m), (stages, 1))
    G = solve_near_identity(jnp.eye(stages * m) - implicit, start).reshape(stages, m, m)
    return G.swapaxes(-1, -2)


RESTORE_FRACTION = 2.0**-6
"""Share of what the entries of an attitude lack by being rounded that a step gives back."""


def _group_correction(group, g) -> jax.Array:
    """What to add to an attitude that steps have left outside of its group.

    What entries lack by being rounded is known beside them, and is not what steps have done. Given back in full at
    every step it would add up, in one direction while the body spins steadily: to 1e-12 in 1e6 steps.
    """
    missing = group.restore_map(g) - g
    rounding = jnp.max(jnp.abs(missing)) <= 4.0 * jnp.finfo(jnp.float64).eps * jnp.max(jnp.abs(g))
    return jnp.where(rounding, RESTORE_FRACTION, 1.0) * missing


MAX_NEWTON_ITERATIONS, NEWTON_DAMPING = 3, 1e-8
"""Newton steps of :func:`_align_attitude`, and what is added to the diagonal of a matrix that may be singular, relative to
its largest entry. A step leaves the square of the misfit, or this share of it."""


def _project_onto_orbit(momenta, p, mu) -> jax.Array:
    """The dual vector next to p, of the group, that has the Casimirs of a state mu; other momenta of it stay."""
    n = len(p)
    size = jnp.max(jnp.abs(mu[:n]))
    size, casimirs = jnp.where(size > 0.0, size, 1.0), momenta.momentum_casimirs().values()
    p, mu = p / size, mu[: momenta.algebra.dim] / size
    for _ in range(MAX_NEWTON_ITERATIONS):
        whole = jnp.concatenate([p, mu[n:]])
        defect = jnp.stack([C.value(mu) - C.value(whole) for C in casimirs])
        p = p + vector_with_products([C.gradient(whole)[:n] for C in casimirs], defect)
    return size * p


def _align_attitude(group, g, p, new) -> jax.Array:
    """The element next to g whose coadjoint action takes the momentum in space to the new one, on the same orbit.

    By Newton's method: ``ad*_eta m = new - m`` for the least eta, m being p as seen from g [Marquardt 1963].
    """
    algebra, size = group.algebra, jnp.max(jnp.abs(new))
    p, new = (v / jnp.where(size > 0.0, size, 1.0) for v in (p, new))

    def newton_step(made: int, g) -> jax.Array:
        m = group.Ad_star(g, p)
        defect, moved = new - m, algebra.ad_star(jnp.eye(algebra.dim), m)
        square = moved @ moved.T
        most = jnp.max(jnp.diagonal(square))
        damping = jnp.where(
            most > 0.0, NEWTON_DAMPING * most, 1.0
        )  # what moves m by rounding alone does not turn either
        eta = solve_near_identity(square + damping * jnp.eye(algebra.dim), (moved @ defect)[:, None])[:, 0]
        g = g @ group.exp_map(algebra, eta)
        if made == MAX_NEWTON_ITERATIONS:
            return g
        return jax.lax.cond(jnp.max(jnp.abs(defect)) > NEWTON_DAMPING, lambda: newton_step(made + 1, g), lambda: g)

    return newton_step(1, g)
