"""Friction that grows with the gradient of the energy: ``K = rate (|dH|^2 I - dH dH^T)``, semidefinite."""

import jax
import jax.numpy as jnp

import liethermo as lt


class Steep(lt.Dissipation):
    rate: jax.Array

    def __init__(self, rate):
        self.rate = jnp.asarray(rate, dtype=float)

    def force(self, system, x, dH, dS, dL):
        return self.rate * (jnp.dot(dH, dH) * dS - jnp.dot(dH, dS) * dH)
