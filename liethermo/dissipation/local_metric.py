"""The projected metric, site by site."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from manifolds.matrices.linear import skew_matrix
from manifolds.matrices.symmetric import semidefinite_factor

from ..errors import InputError
from ..functions.frames import sqrt_or_zero
from .base import Dissipation
from .checks import checked_rates, checked_semidefinite
from .factor import Factor


class LocalProjectedMetric(Dissipation):
    """The projected metric, site by site: each of many sites is damped as it would be alone.

    ``K(alpha, beta) = sum_i rate_i [G(dH_i, dH_i) G(alpha_i, beta_i) - G(dH_i, alpha_i) G(dH_i, beta_i)]`` over the
    sites i: BFM (2.2) at each, where dH_i are the components of the gradient there. Each term has dH in its kernel, so
    the total energy is constant, and no rate depends on the number of sites. On so(3) at every site the force is
    ``rate_i dH_i x (dS_i x dH_i)``; there it is also the force of ``KillingDissipation(rate / 2)``.

    Parameters
    ----------
    rate : float >= 0, or array of the shape of the sites
    cometric : array, shape (d, d), optional
        G of one site, positive definite; the identity by default.
    """

    rate: jax.Array
    cometric: jax.Array | None

    def __init__(self, rate=1.0, cometric=None):
        self.rate = checked_rates(rate)
        self.cometric = None if cometric is None else checked_semidefinite(cometric, "the cometric of a site")

    def bind_to(self, system):
        if system.space is not None:
            raise InputError(
                "LocalProjectedMetric needs a system on copies of an algebra, and this one is on a manifold"
            )
        if self.rate.shape not in ((), system.sites):
            raise InputError(
                f"rate must be one number, or have the shape {system.sites} of the sites, got {self.rate.shape}"
            )
        d = system.shape[-1]
        if self.cometric is not None and self.cometric.shape != (d, d):
            raise InputError(f"the cometric of a site must have shape ({d}, {d}), got {self.cometric.shape}")
        return self

    def force(self, system, x, dH, dS, dL):
        a, b = dH.reshape(system.shape), dS.reshape(system.shape)
        Ga, Gb = (a, b) if self.cometric is None else (a @ self.cometric, b @ self.cometric)
        square, overlap = jnp.sum(Ga * a, axis=-1), jnp.sum(Ga * b, axis=-1)
        return (self.rate[..., None] * (square[..., None] * Gb - overlap[..., None] * Ga)).ravel()

    def factor(self, system, x, dH, dL):
        """Return the factor with columns ``(l_j . dH) l_i - (l_i . dH) l_j``, i < j, at each site, l columns of a
        root."""
        d, count = system.shape[-1], math.prod(system.sites)
        L = jnp.eye(d) if self.cometric is None else semidefinite_factor(self.cometric)
        rates = jnp.broadcast_to(self.rate, system.sites or ()).reshape(count, 1)
        gradients = dH.reshape(count, d) @ L

        def times(w):
            rotations = skew_matrix(w.reshape(count, -1), d)
            return (sqrt_or_zero(rates) * (jnp.einsum("nij,nj->ni", rotations, gradients) @ L.T)).ravel()

        return Factor(count * math.comb(d, 2), times, solenoidal=True)
