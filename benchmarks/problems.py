"""The benchmark systems."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf

INERTIA = (10.0, 5.0, 1.0)
"""Moments of inertia of the body of [BFM §4.3, Fig. 1]."""
X0 = (0.001, 1.0, 0.001)
"""Initial angular momentum, nearly along the middle axis [BFM §4.3, Fig. 1]."""

STIFFNESS = 0.1
"""Coefficient of the quartic term of :func:`general_body`."""


def body_field(x, y, z, rate):
    """Return the three components of the vector field ``Pi' = (Pi + rate Omega × Pi) × Omega`` of the relaxed body.

    It is plain arithmetic, so that numba, JAX and heyoka can each compile it.
    """
    a, b, c = x / INERTIA[0], y / INERTIA[1], z / INERTIA[2]
    u, v, w = x + rate * (b * z - c * y), y + rate * (c * x - a * z), z + rate * (a * y - b * x)
    return v * c - w * b, w * a - u * c, u * b - v * a


def quadratic_body(rate: float) -> lt.LiePoissonSystem:
    """Return the relaxed rigid body with H and S as ``lt.Quadratic``."""
    return lt.models.rigid_body(INERTIA, rate)


def function_body(rate: float) -> lt.LiePoissonSystem:
    """Return the relaxed rigid body with H and S as plain functions, not declared as quadratic."""
    inertia = jnp.array(INERTIA)
    return lt.LiePoissonSystem(
        mf.so(3),
        energy=lambda mu: 0.5 * jnp.sum(mu**2 / inertia),
        entropy=lambda mu: 0.5 * jnp.sum(mu**2),
        dissipation=lt.KillingDissipation(0.5 * rate),
    )


def general_body(rate: float) -> lt.LiePoissonSystem:
    """Return a body with a quartic H and a logarithmic S, as in c/general.c."""
    inertia = jnp.array(INERTIA)
    return lt.LiePoissonSystem(
        mf.so(3),
        energy=lambda mu: jnp.sum(mu**2 / (2 * inertia)) + STIFFNESS / 4 * jnp.sum(mu**4),
        entropy=lambda mu: jnp.log(1.0 + jnp.sum(mu**2)),
        dissipation=lt.KillingDissipation(0.5 * rate),
    )


def body_parameters(rate: float) -> list[float]:
    """Return the parameters of the C programs c/rigid_body.c and c/ensemble.c, in the order of their ``Problem``."""
    return [*(1.0 / moment for moment in INERTIA), rate]


def general_parameters(rate: float) -> list[float]:
    """Return the parameters of the C program c/general.c, in the order of its ``Problem``."""
    return [*body_parameters(rate), STIFFNESS]


def generalized_body(g: mf.LieAlgebra, rate: float) -> lt.LiePoissonSystem:
    """Return a body on an algebra with a definite Killing form: distinct inertias, and the form's Casimir as
    entropy."""
    inertia = 1.0 + np.arange(g.dim) / g.dim
    killing = -g.killing_form()
    inverse = np.linalg.inv(killing)
    entropy = lt.Quadratic((inverse + inverse.T) / 2 * np.trace(killing) / g.dim)
    return lt.LiePoissonSystem(g, lt.Quadratic(1.0 / inertia), entropy, lt.KillingDissipation(rate))


def random_states(bodies: int, dim: int = 3) -> np.ndarray:
    """Return states of norm one in random directions, shape (bodies, dim)."""
    states = np.random.default_rng(0).standard_normal((bodies, dim))
    return states / np.linalg.norm(states, axis=1, keepdims=True)
