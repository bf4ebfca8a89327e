"""A variational integrator for Euler-Poincaré equations with entropy, through the Cayley map or exp."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import square_matrices
from manifolds.groups.maps import cayley, dexp, exp
from manifolds.matrices.linear import solve

from ...errors import InputError
from ...functions.conditions import require_condition
from ...functions.newton import newton_correction, newton_iterate
from ...systems import EulerPoincareClosedSystem, System
from ...systems.kind_checks import require_kind
from ...tracing.programs import jit_cached
from ..base import (
    WHY_FIXED_VARIATIONAL_STEP,
    OneStepMethod,
    checked_run_states,
    checked_step_size,
    register,
)

NEWTON_STEPS = 20
"""Newton steps for the velocities between the states of a finished run."""


class LieVariational(OneStepMethod):
    """Variational integrator of order 2 for Euler-Poincaré equations with entropy.

        (dtau^-1_{h xi_k})* l_xi(k) - (dtau^-1_{-h xi_k-1})* l_xi(k-1) = F^-_k + F^+_k-1,    T s = P_H - f·xi

    is the discrete principle of GBY Definition 3.7 with ``L_d = h l(xi_k, (S_k + S_k+1)/2)`` and ``g_k+1 = g_k tau(h
    xi_k)``, where tau is the Cayley map or exp, varied along ``g_k exp(eta_k)``. Without heat it is the scheme of
    Bou-Rabee & Marsden (2009). Half of each force acts at either end, ``F^± = h (f + F)(xi_k, S)/2``. The inverse of
    the derivative of the Cayley map is a polynomial, ``dtau^-1_xi eta = (I - xi/2) eta (I + xi/2)``. That of exp,
    ``ad_xi / (exp(ad_xi) - 1)``, exists for every algebra, also for SU(n) with n > 2, which the Cayley map leaves.

    It runs as a one-step method on states (xi, S) of an :class:`liethermo.EulerPoincareClosedSystem`, from the momentum
    at one node, ``mu_k = l_xi``, to the next: without friction ``mu_k+1 = Ad*_{tau(h xi_k)} mu_k``. So the spatial
    momentum and its Casimirs are conserved exactly (to the solver) wherever f does not act. The entropy falls at no
    step. The energy error is of second order, and bounded without friction. A step solves one equation of the size of
    (xi, S) by Newton's method.

    :meth:`attitudes` returns the group elements g_k of a run.

    Parameters
    ----------
    tau : {"cayley", "exp"}
        The map from the algebra to the group.
    """

    systems = "Euler-Poincaré systems with entropy"
    why_fixed_step: ClassVar[str] = WHY_FIXED_VARIATIONAL_STEP

    tau: str = eqx.field(static=True)

    def __init__(self, tau: Literal["cayley", "exp"] = "cayley"):
        if tau not in ("cayley", "exp"):
            raise InputError(f"tau must be 'cayley' or 'exp', got {tau!r}")
        self.tau = tau

    def __str__(self) -> str:
        return "LieVariational" if self.tau == "cayley" else f"LieVariational({self.tau})"

    @property
    def stages(self) -> int:
        return 2  # the second row of slopes holds the velocity between the nodes

    order = 2

    preserves = frozenset({"entropy_law"})

    def check(self, system: System) -> None:
        """Raise InputError if the system has the wrong kind, or its algebra has no group by the Cayley map."""
        algebra = require_kind(system, EulerPoincareClosedSystem, "LieVariational").algebra
        if self.tau == "exp":
            return
        if algebra.basis is None:
            raise InputError(
                f"the Cayley map needs matrices for {algebra.name}: build it with from_matrices, or take "
                "lt.LieVariational('exp')"
            )
        X, Y = algebra.hat(np.random.default_rng(0).standard_normal((2, algebra.dim)))
        try:
            algebra.vee(X @ Y @ X)
        except mf.LieAlgebraError as error:
            raise InputError(
                f"the Cayley map does not take {algebra.name} to a group: X Y X leaves the algebra. Take "
                "lt.LieVariational('exp')"
            ) from error

    def start(self, system: System, x) -> jax.Array:
        system = require_kind(system, EulerPoincareClosedSystem, "LieVariational")
        n = system.algebra.dim
        return jnp.stack([system.vector_field(x), jnp.zeros_like(x).at[:n].set(x[:n])])

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        system = require_kind(system, EulerPoincareClosedSystem, "LieVariational")
        n = system.algebra.dim
        xi0, S0, t = system.split_state(x + compensation)
        step = _LieStep(system, self.tau, S0, h, t)
        mu0 = system.momentum(xi0, S0)

        def residual(y):
            return jnp.append(mu0 - step.momenta(y)[0], step.constraint_residual(y))

        y = newton_iterate(residual, jnp.append(k[1, :n], k[0, n]), 1)
        S1, mu1 = S0 + h * y[n], step.momenta(y)[1]
        guess = xi0 + h * k[0, :n]
        W = jax.jacfwd(system.momentum)(guess, S1)
        xi_dot = k[0, :n] - newton_correction(W, (system.momentum(guess, S1) - mu1) / h)
        ledger = system.ledger_rates(*step.work_and_heat_rates(y))
        return jnp.stack([jnp.concatenate([xi_dot, y[n:], ledger]), jnp.zeros_like(x).at[:n].set(y[:n])])

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        return jnp.negative  # the slopes are Newton's method already: their derivative vanishes at the solution

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    def attitudes(self, system: EulerPoincareClosedSystem, x, h: float, start=None) -> np.ndarray:
        """Return the group elements ``g_k+1 = g_k tau(h xi_k)`` along a run, shape (times, m, m).

        Parameters
        ----------
        system : EulerPoincareClosedSystem
        x : array, shape (times, dim + 1)
            Every state of a run with steps of size h.
        start : array, shape (m, m), optional
            g_0; the identity by default.
        """
        self.check(system)
        increments = np.asarray(_group_increments(self, system, checked_run_states(system, x), checked_step_size(h)))
        matrix_size = increments.shape[-1]
        g0 = np.eye(matrix_size) if start is None else square_matrices(start, matrix_size, "start")
        require_condition(g0, np.isfinite, "start must be finite, got the entry {value}")
        elements = [np.asarray(g0)]
        for increment in increments:
            elements.append(elements[-1] @ increment)
        return np.array(elements)


class _LieStep(NamedTuple):
    """The discrete equations of a step from the time t, for y = (xi, s): its velocity and the slope of the entropy."""

    system: EulerPoincareClosedSystem
    tau: str
    S0: jax.Array
    h: jax.Array
    t: jax.Array

    def _midpoint_arguments(self, y) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the arguments of the forces: the velocity xi, the entropy and the time in the middle of the step."""
        return y[:-1], self.S0 + 0.5 * self.h * y[-1], self.t + 0.5 * self.h

    def momenta(self, y) -> tuple[jax.Array, jax.Array]:
        """Return the momenta mu at the start and at the end of the step."""
        xi, S, t = self._midpoint_arguments(y)
        force = self.system.friction_force(xi, S, t) + self.system.external_force(xi, S, t)
        mu, impulse = self.system.momentum(xi, S), 0.5 * self.h * force
        mu_start, mu_end = (self._apply_dtau_inverse_transpose(sign * self.h * xi, mu) for sign in (1.0, -1.0))
        return mu_start - impulse, mu_end + impulse

    def _apply_dtau_inverse_transpose(self, xi, mu) -> jax.Array:
        """Return the transpose of ``dtau^-1_xi`` applied to mu, trivialised on the right; for -xi on the left."""
        algebra = self.system.algebra
        if self.tau == "exp":
            return solve(dexp(algebra, -xi).T, mu[:, None])[:, 0]
        half = 0.5 * algebra.hat(xi)
        identity = jnp.eye(len(half))
        basis = jnp.asarray(algebra.basis)
        return jax.vmap(lambda eta: algebra.vee((identity - half) @ eta @ (identity + half)))(basis) @ mu

    def constraint_residual(self, y) -> jax.Array:
        """Return the residual ``T s + f . xi - P_H`` of the entropy equation; NaN if the temperature T is not positive.

        s is the entropy rate, f the friction, xi the velocity, and P_H the heat power.
        """
        xi, S, t = self._midpoint_arguments(y)
        T = -jax.grad(self.system.lagrangian, argnums=1)(xi, S)
        power = jnp.dot(self.system.friction_force(xi, S, t), xi) - self.system.heating(xi, S, t)
        return jnp.where(T > 0.0, T, jnp.nan) * y[-1] + power

    def work_and_heat_rates(self, y) -> tuple[jax.Array, jax.Array]:
        """Return the work and the heat received from outside, per unit of time."""
        middle = self._midpoint_arguments(y)
        return jnp.dot(self.system.external_force(*middle), y[:-1]), self.system.heating(*middle)


@jit_cached
def _group_increments(method: LieVariational, system: EulerPoincareClosedSystem, x, h):
    """Return the group increments ``tau(h xi_k)`` of all steps of a run, shape (steps, m, m).

    The velocity xi_k of a step follows from the momentum at its start.
    """
    tau = cayley if method.tau == "cayley" else exp

    def group_increment(x0, x1):
        (xi0, S0, t), (xi1, S1, _) = system.split_state(x0), system.split_state(x1)
        step, s, mu0 = _LieStep(system, method.tau, S0, h, t), (S1 - S0) / h, system.momentum(xi0, S0)

        def residual(xi):
            return mu0 - step.momenta(jnp.append(xi, s))[0]

        xi = newton_iterate(residual, 0.5 * (xi0 + xi1), NEWTON_STEPS)
        return tau(system.algebra, h * xi)

    return jax.vmap(group_increment)(x[:-1], x[1:])


register(LieVariational(), LieVariational("exp"))
