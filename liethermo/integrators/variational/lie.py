"""A variational integrator for Euler-Poincaré equations with entropy, through the Cayley map."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.groups.maps import cayley
from manifolds.matrices.linear import solve

from ...errors import InputError
from ...systems import EulerPoincareClosedSystem, System
from ...tracing.programs import program
from ..base import ONE_SIZE, OneStepMethod, register

NEWTON_STEPS = 20
"""For the velocities between the states of a finished run."""


class LieVariational(OneStepMethod):
    """``(dtau^-1_{h xi_k})* l_xi(k) - (dtau^-1_{-h xi_k-1})* l_xi(k-1) = F^-_k + F^+_k-1``, ``T_k s_k = -f_k·xi_k``.

    The discrete principle of GBY Definition 3.7 with ``L_d = h l(xi_k, (S_k + S_k+1)/2)`` and
    ``g_k+1 = g_k tau(h xi_k)``, tau the Cayley map, varied along ``g_k exp(eta_k)``; without heat, the scheme of
    Bou-Rabee & Marsden (2009). Friction acts by halves on both ends, ``F^± = h f(xi_k, S)/2``. The inverse of the
    derivative of tau is a polynomial, ``dtau^-1_xi eta = (I - xi/2) eta (I + xi/2)``.

    It runs as a one-step method on states (xi, S) of an :class:`liethermo.EulerPoincareClosedSystem`, from the momentum
    at one node, ``mu_k = l_xi``, to the next: without friction ``mu_k+1 = Ad*_{tau(h xi_k)} mu_k``. So the spatial
    momentum is kept exactly (to the solver) wherever f does not act, and its Casimir functions with it; the entropy
    falls at no step; the energy error is of second order and stays bounded without friction. Order 2. One equation of
    the size of (xi, S) a step, solved by Newton's method.

    :meth:`attitudes` gives the group elements g_k of a run.
    """

    systems = "Euler-Poincaré systems with entropy"
    fixed: ClassVar[str] = ONE_SIZE

    @property
    def stages(self) -> int:
        return 2  # the second row of slopes holds the velocity between the nodes

    @property
    def order(self) -> int:
        return 2

    @property
    def preserves(self) -> frozenset[str]:
        return frozenset({"entropy_law"})

    def check(self, system: System) -> None:
        """Raise InputError unless the Cayley map takes the algebra of the system to a group."""
        if not isinstance(system, EulerPoincareClosedSystem):
            raise InputError(f"LieVariational runs an lt.EulerPoincareClosedSystem, not a {system.kind}")
        algebra = system.algebra
        if algebra.basis is None:
            raise InputError(f"LieVariational needs matrices for {algebra.name}: build it with from_matrices")
        X, Y = algebra.hat(np.random.default_rng(0).standard_normal((2, algebra.dim)))
        try:
            algebra.vee(X @ Y @ X)
        except mf.LieAlgebraError as error:
            raise InputError(
                f"the Cayley map does not take {algebra.name} to a group: X Y X leaves the algebra"
            ) from error

    def start(self, system: System, x) -> jax.Array:
        return jnp.stack([system.vector_field(x), jnp.append(x[:-1], 0.0)])

    def slopes(self, system: System, x, low, h, k) -> jax.Array:
        assert isinstance(system, EulerPoincareClosedSystem)
        state = x + low
        xi0, S0, mu0 = state[:-1], state[-1], system.momentum(state[:-1], state[-1])

        def misfit(y):
            return jnp.append(_motion(system, mu0, S0, h, y), _production(system, S0, h, y))

        y = jnp.append(k[1, :-1], k[0, -1])
        y = y - solve(jax.jacfwd(misfit)(y), misfit(y)[:, None])[:, 0]
        S1, (_, mu1) = S0 + h * y[-1], _momenta(system, S0, h, y)
        guess = xi0 + h * k[0, :-1]
        W = jax.jacfwd(system.momentum)(guess, S1)
        xi_dot = k[0, :-1] - solve(W, ((system.momentum(guess, S1) - mu1) / h)[:, None])[:, 0]
        return jnp.stack([jnp.append(xi_dot, y[-1]), jnp.append(y[:-1], 0.0)])

    def change(self, system: System, x, low, h, k, d) -> jax.Array:
        return -d  # the slopes are Newton's method already: their derivative vanishes at the solution

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    def attitudes(self, system: EulerPoincareClosedSystem, x, h: float, start=None) -> np.ndarray:
        """The group elements ``g_k+1 = g_k tau(h xi_k)`` along a run, shape (times, m, m).

        Parameters
        ----------
        system : EulerPoincareClosedSystem
        x : array, shape (times, dim + 1)
            Every state of a run with steps of size h.
        start : array, shape (m, m), optional
            g_0; the identity by default.
        """
        steps = np.asarray(_turns(system, system.state(x, batch=True), jnp.asarray(h)))
        first = np.eye(steps.shape[-1]) if start is None else np.asarray(start)
        path = [first]
        for turn in steps:
            path.append(path[-1] @ turn)
        return np.array(path)


def _dtau_inverse(algebra: mf.LieAlgebra, xi) -> jax.Array:
    """The matrix of ``eta -> (I - xi/2) eta (I + xi/2)``, shape (dim, dim): right-trivialised; of -xi, the left one."""
    half = 0.5 * algebra.hat(xi)
    one = jnp.eye(len(half))
    return jax.vmap(lambda eta: algebra.vee((one - half) @ eta @ (one + half)), out_axes=1)(jnp.asarray(algebra.basis))


def _momenta(system: EulerPoincareClosedSystem, S0, h, y) -> tuple[jax.Array, jax.Array]:
    """mu_k and mu_k+1 of a step with velocity and entropy slope y."""
    xi, S = y[:-1], S0 + 0.5 * h * y[-1]
    mu, push = system.momentum(xi, S), 0.5 * h * system.friction_force(xi, S)
    first, second = (_dtau_inverse(system.algebra, sign * h * xi).T @ mu for sign in (1.0, -1.0))
    return first - push, second + push


def _motion(system: EulerPoincareClosedSystem, mu0, S0, h, y) -> jax.Array:
    return mu0 - _momenta(system, S0, h, y)[0]


def _production(system: EulerPoincareClosedSystem, S0, h, y) -> jax.Array:
    xi, S = y[:-1], S0 + 0.5 * h * y[-1]
    T = -jax.grad(system.lagrangian, argnums=1)(xi, S)
    return jnp.where(T > 0.0, T, jnp.nan) * y[-1] + jnp.dot(system.friction_force(xi, S), xi)


@program
def _turns(system: EulerPoincareClosedSystem, x, h):
    """``tau(h xi_k)`` of every step, xi_k from the momentum before it."""

    def one(before, after):
        s, mu0 = (after[-1] - before[-1]) / h, system.momentum(before[:-1], before[-1])

        def newton(_, xi):
            misfit = lambda xi: _motion(system, mu0, before[-1], h, jnp.append(xi, s))  # noqa: E731
            return xi - solve(jax.jacfwd(misfit)(xi), misfit(xi)[:, None])[:, 0]

        xi = jax.lax.fori_loop(0, NEWTON_STEPS, newton, 0.5 * (before[:-1] + after[:-1]))
        return cayley(system.algebra, h * xi)

    return jax.vmap(one)(x[:-1], x[1:])


register(LieVariational())
