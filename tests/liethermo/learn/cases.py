"""A damped oscillator that heats itself, and records of it from SciPy's DOP853."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import liethermo as lt
import manifolds as mf

STIFFNESS = 2.0
"""k of H = p^2/2 + k q^2/2 + exp(s), so T = exp(s); p' = -k q - gamma p, T s' = gamma p^2."""

GAMMA = 0.3
"""Friction coefficient gamma of these equations."""


def _rates(t, x):
    q, p, s = x
    return [p, -STIFFNESS * q - GAMMA * p, GAMMA * p * p * np.exp(-s)]


@functools.cache
def record(number=4, points=41, span=4.0, seed=0):
    """Times, and states of shape (number, points, 3)."""
    random = np.random.default_rng(seed)
    t = np.linspace(0.0, span, points)
    starts = np.column_stack([random.uniform(-1.5, 1.5, (number, 2)), random.uniform(-0.3, 0.3, number)])
    runs = [scipy.integrate.solve_ivp(_rates, (0.0, span), x, "DOP853", t, rtol=1e-12, atol=1e-13).y.T for x in starts]
    return t, np.stack(runs)


class Spring(eqx.Module):
    """The energy, with the logarithm of a stiffness to be learned."""

    log_stiffness: jax.Array

    def __call__(self, x):
        return 0.5 * x[1] ** 2 + 0.5 * jnp.exp(self.log_stiffness) * x[0] ** 2 + jnp.exp(x[2])


class Rubbing(eqx.Module):
    """The entries above the diagonal of the skew matrix with ``A dH = sqrt(gamma / T) (0, -T, p)``."""

    log_gamma: jax.Array

    def __call__(self, x):
        return jnp.stack([0.0, 0.0, -jnp.exp(0.5 * (self.log_gamma - x[2]))])


def entropy(x):
    return x[2]


def oscillator(stiffness=1.0, gamma=1.0, **parts):
    """The system, of which two numbers are to be learned, or as it is with parts in their place."""
    energy = lt.learn.Energy(Spring(jnp.log(jnp.asarray(stiffness))))
    friction = lt.learn.Friction(3, function=Rubbing(jnp.log(jnp.asarray(gamma))))
    arguments = {"energy": energy, "entropy": entropy, "poisson": mf.Canonical(1), "friction": friction}
    return lt.learn.Metriplectic(3, **{**arguments, **parts})
