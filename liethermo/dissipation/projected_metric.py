"""Metrics projected off the gradients of conserved functions, and the same projection site by site."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.errors import warn
from manifolds.matrices.linear import skew_matrix
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from ..errors import InputError
from ..functions.checks import with_polynomial_degrees
from ..functions.conditions import semidefinite_condition
from ..functions.energy import Energy, make_energy
from ..functions.frames import gram_schmidt, sqrt_or_zero
from .base import Dissipation
from .checks import (
    RATE_CONDITION,
    checked_rate,
    checked_rates,
    checked_semidefinite,
    evaluate_form,
    reject_number_as_form,
)
from .factor import Factor
from .geometry import isotropic_noise, isotropic_noise_dim, project_tangent


class GlobalRateWarning(UserWarning):
    """Warns that a dissipation couples all sites, so that the damping of each site grows with their number."""


class ProjectedMetric(Dissipation):
    """Gradient of the entropy in a cometric G, without the components along conserved gradients [BFM 2.2, Remark 2.1].

    ``K(alpha, beta) = det(C) G(P alpha, P beta)``, P the G-orthogonal projector off the span of dH and the
    gradients dL_a of ``preserve``, and ``C_ab = G(dL_a, dL_b)`` with L_1 = H. For the energy alone
    ``det(C) = G(dH, dH)`` and this is BFM (2.2), ``G(dH, dH) G(alpha, beta) - G(dH, alpha) G(dH, beta)``. With
    ``normalized=True`` the factor det(C) is left out (Remark 2.1).

    It couples all components: on many sites the factor ``G(dH, dH)`` grows with their number, and with it the damping
    of each. For damping site by site take :class:`LocalProjectedMetric`.

    Parameters
    ----------
    cometric : array, shape (n, n), or function from x, shape (n,), to one
        G, positive definite, in any units: they go into that of the rate. By default the identity, or on a manifold
        the metric of the space.
    preserve : sequence of functions or energies
        Functions that the dissipation keeps constant besides the energy.
    normalized : bool
        Leave out the factor det(C) [BFM Remark 2.1].
    rate : float, >= 0
        Factor of K. The unit of ``rate * G**2`` is x**4 / (energy**2 * entropy * time); that of ``rate * G`` with
        ``normalized`` is x**2 / (entropy * time).

    Examples
    --------
    >>> g = mf.so(4)
    >>> energy = lt.Quadratic([1.0, 2.0, 3.0, 1.0, 1.5, 2.0])
    >>> system = lt.LiePoissonSystem(
    ...     g, energy, g.casimirs(2)[0], lt.ProjectedMetric(rate=0.1)
    ... )
    >>> bool(system.check().passed)
    True
    """

    cometric: jax.Array | Callable | None = eqx.field(metadata=semidefinite_condition("the cometric").metadata)
    functions: tuple[Energy, ...]
    normalized: bool = eqx.field(static=True)
    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)

    def __init__(self, cometric=None, preserve=(), normalized=False, rate=1.0):
        reject_number_as_form(cometric, self, "the cometric")
        self.cometric = (
            cometric if cometric is None or callable(cometric) else checked_semidefinite(cometric, "the cometric")
        )
        functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
        self.functions = tuple(make_energy(L, "a preserved function") for L in functions)
        self.normalized = bool(normalized)
        self.rate = checked_rate(rate)

    @property
    def preserve(self):
        return self.functions

    def bind_to(self, system):
        if system.sites and not self.normalized:
            warn(
                f"ProjectedMetric damps each of the {math.prod(system.sites)} sites at a rate that grows with their "
                "number, since G(dH, dH) is a sum over all sites. Use LocalProjectedMetric, which acts site by site, "
                "or normalized=True, which leaves this factor out",
                GlobalRateWarning,
            )
        if system.space is not None:
            return self
        return eqx.tree_at(
            lambda d: d.functions,
            self,
            tuple(with_polynomial_degrees(L, system.dim) for L in self.functions),
        )

    def force(self, system, x, dH, dS, dL):
        raise_index = self._cometric_map(system, x)
        if not dL and not self.normalized:
            GdH = raise_index(dH)
            square = jnp.dot(GdH, dH)
            ratio = jnp.dot(GdH, dS) / jnp.where(square > 0.0, square, 1.0)
            image = raise_index(
                dS - ratio * dH
            )  # subtract first: near an equilibrium the difference of images would lose digits
            return self.rate * (square * image - jnp.dot(image, dH) * GdH)
        frame = gram_schmidt((dH, *dL), metric_map=raise_index)
        projection = frame.project_off_transposed(raise_index(frame.project_off(dS)))
        return self.rate * (projection if self.normalized else math.prod(frame.squared_norms) * projection)

    def factor(self, system, x, dH, dL):
        """Return a factor ``P^T L`` of the friction matrix, P its projector and ``L L^T = G`` its metric.

        The divergence of the latter is zero if G is constant.
        """
        G, n = evaluate_form(self.cometric, x), system.dim
        if system.space is not None:
            if G is not None:
                return None
            return self._projected_factor(
                system, x, dH, dL, isotropic_noise_dim(system), lambda w: isotropic_noise(system, x, w)
            )
        root = jnp.eye(n) if G is None else semidefinite_root(G) if callable(self.cometric) else semidefinite_factor(G)
        if not dL and not self.normalized:

            def times(w):
                return root @ (skew_matrix(w, n) @ (dH @ root))

            return Factor(math.comb(n, 2), times, solenoidal=not callable(self.cometric)).scale_by(self.rate)
        return self._projected_factor(system, x, dH, dL, n, lambda w: root @ w)

    def _projected_factor(self, system, x, dH, dL, n_columns: int, root_times: Callable) -> Factor:
        """Return the factor ``P^T L``, where ``root_times(w)`` is L w and P projects off dH and dL."""
        frame = gram_schmidt((dH, *dL), metric_map=self._cometric_map(system, x))
        rate = self.rate if self.normalized else self.rate * math.prod(frame.squared_norms)
        return Factor(n_columns, lambda w: frame.project_off_transposed(root_times(w))).scale_by(rate)

    def _cometric_map(self, system, x):
        """Return the map from covectors to vectors by the cometric at x, tangent to the space of the system."""
        G = evaluate_form(self.cometric, x)
        return lambda alpha: (
            system.raise_index(x, alpha)
            if G is None
            else project_tangent(system, x, G @ project_tangent(system, x, alpha))
        )


class LocalProjectedMetric(Dissipation):
    """The projected metric, site by site: each of many sites is damped as it would be alone.

    ``K(alpha, beta) = sum_i rate_i [G(dH_i, dH_i) G(alpha_i, beta_i) - G(dH_i, alpha_i) G(dH_i, beta_i)]`` over the
    sites i: BFM (2.2) at each, where dH_i are the components of the gradient there. Each term has dH in its kernel, so
    the total energy is constant, and no rate depends on the number of sites. On so(3) at every site the force is
    ``rate_i dH_i x (dS_i x dH_i)``; there it is also the force of ``KillingDissipation(rate / 2)``.

    Parameters
    ----------
    rate : float >= 0, or array of the shape of the sites
        Rate of the dissipation at each site.
    cometric : array, shape (d, d), optional
        G of one site, positive definite; the identity by default.
    """

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
    cometric: jax.Array | None = eqx.field(metadata=semidefinite_condition("the cometric of a site").metadata)

    def __init__(self, rate=1.0, cometric=None):
        self.rate = checked_rates(rate)
        self.cometric = None if cometric is None else checked_semidefinite(cometric, "the cometric of a site")

    def bind_to(self, system):
        if system.space is not None:
            raise InputError(
                "LocalProjectedMetric needs a system on copies of an algebra, but this one is on a manifold"
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
