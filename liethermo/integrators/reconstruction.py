"""Reconstruction: the attitude of a body, stepped along with its momentum at the order of any method [EQUATIONS §4]."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from ..errors import InputError
from ..gradients import compensated
from ..systems import AttitudeSystem
from .base import OneStepMethod
from .tableaus import gauss

RECONSTRUCTIONS = ("cayley", "exp")


class WithAttitude(OneStepMethod):
    """A method for momenta, and beside it ``g' = g hat(xi)`` at its stages, xi_i its discrete gradients of the energy.

    ``"cayley"`` is Gauss collocation on the matrices, ``G_i = g + h sum_j A_ij G_j hat(xi_j)``: with one stage
    ``g' = g cayley(h xi)``. It keeps what is quadratic in (mu, g): that g is orthogonal, unitary or symplectic, and
    the spatial momentum g mu of a free body, for every number of stages.

    ``"exp"`` is collocation in the algebra, ``g' = g exp(h sum b_i k_i)`` with ``k_i = dexp^-1(h sum_j A_ij k_j) xi_i``
    [Munthe-Kaas 1999]: with one stage ``g' = g exp(h xi)``. It stays in every group; spatial momenta are kept to the
    order of the method.

    Momenta are those that the method gives without attitudes; the order is the same for both.

    Attributes
    ----------
    method : OneStepMethod
    kind : {"cayley", "exp"}
    """

    method: OneStepMethod
    kind: str = eqx.field(static=True)

    def __check_init__(self):
        if self.kind not in RECONSTRUCTIONS:
            raise InputError(f"the reconstruction is 'cayley' or 'exp', not {self.kind!r}")

    @property
    def stages(self) -> int:
        return self.method.stages

    @property
    def order(self) -> int:
        return self.method.order

    @property
    def preserves(self) -> frozenset[str]:
        return self.method.preserves

    def check(self, system) -> None:
        self.method.check(system.body)

    def slopes(self, system: AttitudeSystem, x, low, h, k) -> jax.Array:  # type: ignore[override]
        (mu, g), (mu_low, g_low), (rates, g_rates) = map(system.split, (x, low, k))
        algebra, A = system.group.algebra, gauss(self.stages).A
        momenta = self.method.slopes(system.body, mu, mu_low, h, rates)
        xi = self.method.velocities(system.body, mu, mu_low, h, rates)
        moved = h * jnp.einsum("ij,j...->i...", A, g_rates)
        if self.kind == "cayley":
            return system.join(momenta, (g + (g_low + moved)) @ algebra.hat(xi))
        return system.join(momenta, algebra.hat(_inverse_dexp(algebra, algebra.vee(moved), xi, self.order)))

    def increment(self, h, k) -> jax.Array:
        """Of momentum and, with ``"exp"``, in the algebra."""
        return self.method.increment(h, k)

    def move(self, system: AttitudeSystem, x, low, h, k) -> tuple[jax.Array, jax.Array]:  # type: ignore[override]
        new, new_low = compensated(x, low + self.increment(h, k))
        mu, g = system.split(new)
        mu_low, g_low = system.split(new_low)
        if self.kind == "exp":
            g = self._turned(system, x, self.increment(h, k))
            return system.join(mu, g), system.join(mu_low, jnp.zeros_like(g))
        restored = system.group.restore_map(g)  # what rounding has added, far below what the state resolves
        return new, system.join(mu_low, g_low + (restored - g))

    def along(self, system: AttitudeSystem, x, v) -> jax.Array:  # type: ignore[override]
        if self.kind == "cayley":
            return x + v
        return system.join(system.points(x + v), self._turned(system, x, v))

    @staticmethod
    def _turned(system: AttitudeSystem, x, v) -> jax.Array:
        """``g exp(omega)``, omega the part of v in the algebra."""
        (_, g), (_, omega), algebra = system.split(x), system.split(v), system.group.algebra
        return system.group.restore_map(g @ system.group.exp_map(algebra, algebra.vee(omega)))

    def start(self, system: AttitudeSystem, x) -> jax.Array:  # type: ignore[override]
        (mu, g), algebra = system.split(x), system.group.algebra
        rates = self.method.start(system.body, mu)
        turn = algebra.hat(system.body.energy.gradient(mu))
        turn = g @ turn if self.kind == "cayley" else turn
        return system.join(rates, jnp.broadcast_to(turn, (self.stages, *turn.shape)))

    def predict(self, k, before) -> jax.Array:
        return self.method.predict(k, before)

    def error(self, system: AttitudeSystem, x, low, h, k) -> jax.Array:  # type: ignore[override]
        (mu, _), (mu_low, _), (rates, _) = map(system.split, (x, low, k))
        return self.method.error(system.body, mu, mu_low, h, rates)

    def judged(self, system: AttitudeSystem, x):  # type: ignore[override]
        return self.method.judged(system.body, system.split(x)[0])

    def __str__(self) -> str:
        return f"{self.method} with attitudes by {self.kind}"


def _inverse_dexp(algebra, omega, xi, order: int) -> jax.Array:
    """``sum_j (-1)^j B_j / j! ad_omega^j xi``, j <= order: the omega' that turns ``exp(omega)`` with velocity xi."""
    term, total = xi, xi
    for j in range(1, order + 1):
        term = -algebra.bracket(omega, term) / j
        if _BERNOULLI[j]:
            total = total + _BERNOULLI[j] * term
    return total


def _bernoulli(count: int) -> list[float]:
    numbers: list[float] = []
    for m in range(count):
        numbers.append(1.0 if m == 0 else -sum(math.comb(m + 1, j) * b for j, b in enumerate(numbers)) / (m + 1))
    return [b if m == 1 or m % 2 == 0 else 0.0 for m, b in enumerate(numbers)]


_BERNOULLI = _bernoulli(17)
