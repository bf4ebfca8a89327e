"""The discrete Herglotz integrator of the evolution field [SML §6.3]."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp

from manifolds._module import Module
from manifolds.matrices.linear import solve

from ..errors import InputError
from ..functions.energy import Energy, as_energy
from ..systems import EvolutionSystem, System
from .base import ONE_SIZE, OneStepMethod


class DiscreteHerglotz(OneStepMethod):
    """``D_1 L_d(q_1, q_2, S_1) + (1 + D_S L_d(q_1, q_2, S_1)) D_2 L_d(q_0, q_1, S_0) = 0`` for q_2 [SML 40],
    ``S_1 - S_0 = (q_1 - q_0)·D_2 L_d(q_0, q_1, S_0)`` [SML 41].

    Run here as a one-step method on states (q, p, S) of an :class:`liethermo.EvolutionSystem`, with the momentum
    ``p_1 = D_2 L_d(q_0, q_1, S_0)``: (40) gives q_2 from (q_1, p_1, S_1). The discrete Lagrangian alone makes the step;
    the system only says what energy and entropy are recorded.

    Nothing is kept exactly, neither the energy nor the sign of the entropy production. Order 1, since (40) and (41)
    take the entropy at the start of the step; where L does not depend on S, a variational integrator of the order of
    L_d. One equation of the size of q a step, solved by Newton's method; explicit where L_d is quadratic in q_2.

    Parameters
    ----------
    discrete_lagrangian : function of (q_0, q_1, S_0, h), q of shape (n,), to a scalar
        The action of a step, such as ``h L``; :meth:`midpoint` makes one from a Lagrangian.
    """

    systems = "evolution systems"
    fixed: ClassVar[str] = ONE_SIZE

    discrete_lagrangian: Callable

    @classmethod
    def midpoint(cls, lagrangian) -> DiscreteHerglotz:
        """That of ``L_d(q_0, q_1, S_0) = h L((q_0 + q_1)/2, (q_1 - q_0)/h, S_0)`` [SML Example 7].

        Parameters
        ----------
        lagrangian : function from (q, v, S) in one array, shape (2n + 1,), to a scalar, or an Energy
        """
        return cls(_Midpoint(as_energy(lagrangian, "the Lagrangian")))

    @property
    def stages(self) -> int:
        return 1

    @property
    def order(self) -> int:
        return 1

    @property
    def preserves(self) -> frozenset[str]:
        return frozenset()

    def state(self, q0, q1, S0, h) -> jax.Array:
        """The state (q_1, p_1, S_1) after a first step that is known, shape (2n + 1,), to start a run from."""
        q0, q1 = (jnp.atleast_1d(jnp.asarray(q, dtype=jnp.float64)) for q in (q0, q1))
        p1 = jax.grad(self.discrete_lagrangian, argnums=1)(q0, q1, jnp.asarray(S0, dtype=jnp.float64), h)
        return jnp.concatenate([q1, p1, (S0 + jnp.dot(q1 - q0, p1))[None]])

    def check(self, system: System) -> None:
        """Raise InputError unless the state is a (q, p, S)."""
        if not isinstance(system, EvolutionSystem):
            raise InputError(f"DiscreteHerglotz runs an lt.EvolutionSystem, not a {system.kind}")

    def slopes(self, system: System, x, low, h, k) -> jax.Array:
        n, start = len(x) // 2, x + low
        q, p, S = start[:n], start[n : 2 * n], start[2 * n]

        def misfit(q1):  # of (40)
            by_q, by_S = jax.grad(self.discrete_lagrangian, argnums=(0, 2))(q, q1, S, h)
            return by_q + (1.0 + by_S) * p

        q1 = q + h * k[0, :n]
        velocity = k[0, :n] - solve(h * jax.jacfwd(misfit)(q1), misfit(q1)[:, None])[:, 0]
        p1 = jax.grad(self.discrete_lagrangian, argnums=1)(q, q + h * velocity, S, h)
        return jnp.concatenate([velocity, (p1 - p) / h, jnp.dot(velocity, p1)[None]])[None]

    def increment(self, h, k) -> jax.Array:
        return h * k[0]


class _Midpoint(Module):
    lagrangian: Energy

    def __call__(self, q0, q1, S0, h):
        return h * self.lagrangian.value(jnp.concatenate([0.5 * (q0 + q1), (q1 - q0) / h, jnp.reshape(S0, 1)]))
