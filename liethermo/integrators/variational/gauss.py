"""Galerkin variational integrators for simple closed systems: even orders, and no step without its heat."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp

from manifolds.matrices.linear import solve

from ...systems import System
from ..base import WHY_FIXED_VARIATIONAL_STEP, GaussMethod, checked_stages, register
from ..tableaus import gauss_tableau
from .equations import velocity_slope
from .schemes import require_simple_closed


class VariationalGauss(GaussMethod):
    """Variational integrator on polynomials of degree s with Gauss quadrature, of order 2s.

    The discrete action is ``L_d = h sum b_i L(q_i, V_i, S_i)`` on ``q_i = q_0 + h sum A_ij V_j``, varied over the
    inner V too, with the variational constraint ``T_i dS_i = -F_fr,i . dq_i`` and the phenomenological one at each
    node [after GBY Definition 3.7; Marsden & West 2001, §2.2.6]. In terms of momenta

        L_v(q_i, V_i, S_i) = p_0 + h sum A_ij (L_q + F_ext + F_fr)_j,    T_i s_i = (P_H - F_fr . V)_i,

    ``S_i = S_0 + h sum A_ij s_j``; q, p and S end with the weights b. One stage is scheme 2 with alpha = 1/2.

    The entropy falls at no step, ``S_1 - S_0 = h sum b_i s_i`` with positive b_i and T_i, for every L, friction and
    step: a composition of order 4 has to step backward, where friction would cool. The energy is not
    conserved; its error is of order 2s and stays bounded (measured; see the tests). The method is symplectic where
    nothing depends on S. A step solves one implicit equation of s times the size of the state.

    Parameters
    ----------
    stages : int
        1 to 8.

    Examples
    --------
    >>> spring = lt.models.mass_spring_gas()
    >>> run = lt.integrate(spring, [1.0, 0.0, 0.0], (0.0, 5.0), 0.1, lt.VariationalGauss(2))
    >>> run.status.ok, bool(run.entropy[-1] > run.entropy[0])
    (True, True)
    """

    systems = "simple closed systems"
    why_fixed_step: ClassVar[str] = WHY_FIXED_VARIATIONAL_STEP

    def __init__(self, stages: int = 2):
        self.number = checked_stages(stages)

    preserves = frozenset({"entropy_law"})

    def check(self, system: System) -> None:
        """Raise InputError unless the system is a simple closed system on R^n."""
        require_simple_closed(system, "VariationalGauss")

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        system = require_simple_closed(system, "VariationalGauss")
        (A, b, c), n, start = gauss_tableau(self.number), system.degrees_of_freedom, x + compensation
        (q0, v0, S0, t0), V, s = system.split_state(start), k[:, :n], k[:, 2 * n]
        q, S, t, p0 = q0 + h * (A @ V), S0 + h * (A @ s), t0 + h * c, system.momentum(q0, v0, S0)

        def node_forces_and_rates(q, V, S, t):
            dL_dq, p, minus_T = jax.grad(system.lagrangian_value, argnums=(0, 1, 2))(q, V, S)
            friction, external = system.friction_force(q, V, S, t), system.external_force(q, V, S, t)
            power, T = system.heating(q, V, S, t), jnp.where(minus_T < 0.0, -minus_T, jnp.nan)
            energy_rates = jnp.stack([jnp.dot(external, V), power])
            return dL_dq + friction + external, p, (power - jnp.dot(friction, V)) / T, energy_rates

        force, p, s, node_rates = jax.vmap(node_forces_and_rates)(q, V, S, t)
        W = jax.vmap(jax.jacfwd(system.momentum, argnums=1))(q, V, S)
        start_momentum_residual = p0 + h * (A @ force) - p
        V = V + jax.vmap(lambda W, r: solve(W, r[:, None])[:, 0])(W, start_momentum_residual)
        end = q0 + h * (b @ V), k[0, n : 2 * n], S0 + h * (b @ s)
        v_dot = velocity_slope(system, (q0, v0, S0, p0), end, b @ force, h)
        columns = [V, jnp.tile(v_dot, (self.number, 1)), s[:, None]]
        if system.has_ledger:
            columns += [node_rates, jnp.ones((self.number, 1))]
        return jnp.concatenate(columns, axis=1)

    def __str__(self) -> str:
        return f"VariationalGauss(stages={self.number})"


register(*map(VariationalGauss, (1, 2, 3)))
