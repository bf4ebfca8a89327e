"""Reconstruction: the attitude of a body, stepped along with its momentum at the order of any method."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.groups.maps import central, from_adjoint_cayley, inverse_dexp
from manifolds.matrices.linear import solve_near_identity

from ..errors import InputError
from ..functions.gradients import compensated
from ..systems import AttitudeSystem, TurningSystem
from .base import OneStepMethod
from .tableaus import gauss

RECONSTRUCTIONS = ("coadjoint", "cayley", "exp")


class WithAttitude(OneStepMethod):
    """A method for momenta, and beside it ``g' = g hat(xi)`` at its stages, xi_i its discrete gradients of the energy.

    ``"cayley"`` is Gauss collocation on the matrices, ``G_i = g + h sum_j A_ij G_j hat(xi_j)``: with one stage
    ``g' = g cayley(h xi)``. It keeps what is quadratic in g: that g is orthogonal, unitary or symplectic.

    ``"coadjoint"`` is the same collocation on the matrices Ad(g), which ends at ``Ad(g) R``: ``g' = g
    adjoint_cayley(x)`` with ``cay(ad x) = R``, and with one stage x = h xi. A free body's ``mu' = ad*_xi mu`` gives
    ``mu' = R^T mu`` at every number of stages, for every step and every energy, as long as the method takes its slopes
    from Pi alone. So the spatial momentum ``Ad_star(inverse(g), mu)`` is kept to rounding. That R is an adjoint action
    is a property of the group: it is for SO(2), SO(3), SO(4), SE(2), SE(3), SU(2), SL(2), Sp(1), GL(2) and
    Heisenberg(n), of which ``"cayley"`` is the same on SO(2), SO(3), SE(2) and Heisenberg(n). It is not for SU(n) and
    SL(n) with n > 2, Sp(n) with n > 1, SO(n) with n > 4, SE(n) with n > 3: there collocation takes mu off its coadjoint
    orbit by O(h^(2s)), as Casimirs of higher degree drift, and the spatial momentum is kept to the order of the method.

    ``"exp"`` is collocation in the algebra, ``g' = g exp(h sum b_i k_i)`` with ``k_i = dexp^-1(h sum_j A_ij k_j) xi_i``
    [Munthe-Kaas 1999]: with one stage ``g' = g exp(h xi)``. It stays in every group; spatial momenta are kept to the
    order of the method.

    Explicit methods turn by ``"exp"``, whatever is asked for: their step is that of (mu, theta), ``g' = g exp(theta)``.

    Momenta are those that the method gives without attitudes; the order is the same for all three.

    Attributes
    ----------
    method : OneStepMethod
    kind : {"coadjoint", "cayley", "exp"}
    """

    method: OneStepMethod
    kind: str = eqx.field(static=True)

    def __check_init__(self):
        if self.kind not in RECONSTRUCTIONS:
            raise InputError(f"the reconstruction is {', '.join(map(repr, RECONSTRUCTIONS))}, not {self.kind!r}")

    @property
    def stages(self) -> int:
        return self.method.stages

    @property
    def order(self) -> int:
        return self.method.order

    @property
    def preserves(self) -> frozenset[str]:
        return self.method.preserves

    @property
    def increments(self) -> int:
        return self.method.increments

    def driven_by(self, dW) -> OneStepMethod:
        return WithAttitude(self.method.driven_by(dW), self.kind)

    def keeps(self, system, name: str) -> bool:
        return self.method.keeps(system.body, name)

    @property
    def explicit(self) -> bool:
        return self.method.explicit

    def check(self, system) -> None:
        self.method.check(system.body)

    def slopes(self, system: AttitudeSystem, x, low, h, k) -> jax.Array:  # type: ignore[override]
        if self.explicit:
            local = TurningSystem(system, self.order)
            start, rest, own = local.around(x), local.around(low), local.lowered_rates(k)
            return local.raised_rates(self.method.pulled(local).slopes(local, start, rest, h, own))
        (mu, g), (mu_low, g_low), (rates, g_rates) = map(system.split, (x, low, k))
        algebra, A = system.group.algebra, gauss(self.stages).A
        momenta = self.method.slopes(system.body, mu, mu_low, h, rates)
        xi = self.method.velocities(system.body, mu, mu_low, h, rates)
        if self.kind == "coadjoint":
            return system.join(momenta, algebra.hat(xi))
        moved = h * jnp.einsum("ij,j...->i...", A, g_rates)
        if self.kind == "cayley":
            return system.join(momenta, (g + (g_low + moved)) @ algebra.hat(xi))
        return system.join(momenta, algebra.hat(inverse_dexp(algebra, algebra.vee(moved), xi, self.order)))

    def increment(self, h, k) -> jax.Array:
        """The increment of the momentum and, unless by ``"cayley"``, of the attitude in the algebra."""
        return self.method.increment(h, k)

    def move(self, system: AttitudeSystem, x, low, h, k) -> tuple[jax.Array, jax.Array]:  # type: ignore[override]
        new, new_low = compensated(x, low + self.increment(h, k))
        mu, g = system.split(new)
        mu_low, g_low = system.split(new_low)
        if self.kind == "cayley":
            restored = system.group.restore_map(g)  # what rounding has added, far below what the state resolves
            return new, system.join(mu_low, g_low + (restored - g))
        if self.kind == "exp":
            g = self._turned(system, x, self.increment(h, k))
        else:
            g = system.group.restore_map(system.split(x)[1] @ self._coadjoint(system, h, k))
        return system.join(mu, g), system.join(mu_low, jnp.zeros_like(g))

    def along(self, system: AttitudeSystem, x, v) -> jax.Array:  # type: ignore[override]
        if self.kind == "cayley":
            return x + v
        return system.join(system.points(x + v), self._turned(system, x, v))

    def _coadjoint(self, system: AttitudeSystem, h, k) -> jax.Array:
        """The element of the group whose adjoint action is that of the step."""
        group, xi = system.group, h * system.group.algebra.vee(system.split(k)[1])
        assert group.adjoint_cayley_map is not None
        return group.adjoint_cayley_map(group.algebra, xi[0] if self.stages == 1 else _collocated(group.algebra, xi))

    @staticmethod
    def _turned(system: AttitudeSystem, x, v) -> jax.Array:
        """``g exp(omega)``, omega the part of v in the algebra."""
        (_, g), (_, omega), algebra = system.split(x), system.split(v), system.group.algebra
        return system.group.restore_map(g @ system.group.exp_map(algebra, algebra.vee(omega)))

    def start(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        if self.explicit:
            local = TurningSystem(system, self.order)
            return local.raised_rates(self.method.start(local, local.around(x)))
        (mu, g), algebra = system.split(x), system.group.algebra
        rates = self.method.start(system.body, mu)
        turn = algebra.hat(system.body.energy.gradient(mu))
        turn = g @ turn if self.kind == "cayley" else turn
        return system.join(rates, jnp.broadcast_to(turn, (self.stages, *turn.shape)))

    def missed(self, system: AttitudeSystem, x, low, h, k) -> jax.Array:  # type: ignore[override]
        (mu, _), (mu_low, _), (rates, _) = map(system.split, (x, low, k))
        return self.method.missed(system.body, mu, mu_low, h, rates)

    def weights(self, theta):
        return self.method.weights(theta)

    def predict(self, k, before) -> jax.Array:
        return self.method.predict(k, before)

    @property
    def has_estimate(self) -> bool:
        return self.method.has_estimate

    def error(self, system: AttitudeSystem, x, low, h, k) -> jax.Array:  # type: ignore[override]
        (mu, _), (mu_low, _), (rates, _) = map(system.split, (x, low, k))
        return self.method.error(system.body, mu, mu_low, h, rates)

    def judged(self, system: AttitudeSystem, x):  # type: ignore[override]
        return self.method.judged(system.body, system.split(x)[0])

    def __str__(self) -> str:
        return f"{self.method} with attitudes by {self.kind}"


def _collocated(algebra, xi) -> jax.Array:
    """The x with ``cay(ad x) = R``, R the end of Gauss collocation of ``Q' = Q ad(xi)`` on [0, 1] from I.

    Solved for the transposes of the stages, ``Q_i^T = I + sum_j A_ij ad(xi_j)^T Q_j^T``. Where R is no adjoint action
    x is the one of the nearest, to the order of the method.
    """
    (stages, dim), tableau = xi.shape, gauss(len(xi))
    turned = algebra.ad(xi).swapaxes(-1, -2)
    implicit = jnp.einsum("ij,jab->iajb", tableau.A, turned).reshape(stages * dim, stages * dim)
    start = jnp.tile(jnp.eye(dim), (stages, 1))
    Q = solve_near_identity(jnp.eye(stages * dim) - implicit, start).reshape(stages, dim, dim)
    R = jnp.eye(dim) + jnp.einsum("j,jab,jbc->ca", tableau.b, turned, Q)
    return from_adjoint_cayley(algebra, R) + central(algebra, tableau.b @ xi)
