"""Dissipation by inner products on a Lie algebra: BFM's construction, and its case with the Killing form."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np

import manifolds as mf
from manifolds._arrays import real_array

from ..errors import IndefiniteError, InputError
from .base import Dissipation
from .checks import checked_rate, checked_semidefinite, repeat_over_sites, require_algebra
from .factor import Factor, form_root


class BracketDissipation(Dissipation):
    """Base of forces ``ad*_dH F``, where F, the ``added_momentum``, is linear in ``[dH, dS]``."""

    def force(self, system, x, dH, dS, dL):
        g = system.algebra
        return g.ad_star(dH, self.added_momentum(dH, g.bracket(dH, dS)))

    def rate_of_change(self, system, x, dH, dS, dL, gradient):
        """Return the rate ``F . [dH, gradient]`` of a function with this gradient.

        For the entropy, the bracket is the one that F is made of, and is computed once.
        """
        action = system.algebra.action(dH)
        return action.bracket(gradient) @ self.added_momentum(dH, action.bracket(dS))


class InnerProductDissipation(BracketDissipation):
    """Dissipation by an inner product on the Lie algebra: ``K(alpha, beta) = 𝒦([dH, alpha], [dH, beta])``.

    It is the forced Euler-Poincaré equation ``mu' = ad*_xi (mu + F)`` with ``<F, eta> = 𝒦(eta, [xi, grad S])``
    [BFM 3.6-3.7], so ``S' = 𝒦([xi, grad S], [xi, grad S]) >= 0`` for a Casimir S.

    Parameters
    ----------
    K : array, shape (dim, dim)
        The inner product 𝒦 on g, symmetric and positive semidefinite (mu**2 * time / entropy). On copies of an algebra
        it may be one of a single site, shape (d, d), and acts site by site.

    Raises
    ------
    IndefiniteError, InputError
        If it is not.

    Examples
    --------
    >>> g = mf.so(3)
    >>> form = lt.InnerProductDissipation(np.diag([1.0, 1.0, 2.0]))
    >>> system = lt.LiePoissonSystem(
    ...     g, lt.Quadratic([1.0, 2.0, 3.0]), g.casimirs(2)[0], form
    ... )
    >>> bool(system.check().passed)
    True
    """

    K: Any

    def __init__(self, K):
        if callable(K):
            raise InputError(
                "the inner product 𝒦 must be a constant matrix, got a function. For a form that depends on the state "
                "use lt.ProjectedMetric(cometric=...) or lt.FrictionOperator(K, project=True)"
            )
        self.K = checked_semidefinite(K, "the inner product 𝒦")

    def bind_to(self, system):
        K = repeat_over_sites(self.K, system)
        require_algebra(system, "InnerProductDissipation", K)
        return self if K is self.K else eqx.tree_at(lambda d: d.K, self, K)

    def added_momentum(self, dH, bracket_dH_dS):
        return self.K @ bracket_dH_dS

    def factor(self, system, x, dH, dL):
        return _bracket_factor(system, dH, self.K)


class KillingDissipation(BracketDissipation):
    """Dissipation by minus the Killing form kappa; it needs no metric. See :class:`InnerProductDissipation`.

    ``𝒦 = -rate * kappa`` on compact type, ``𝒦(x, y) = -rate * kappa(x, theta y)`` with a Cartan involution theta on
    noncompact semisimple algebras, and ``-rate * kappa`` again wherever that is at least semidefinite (se(3)). On so(3)
    ``-kappa = 2 I``, so rate 1/2 gives the projected metric (BFM 2.2). On a sum of algebras, and on copies of one on
    sites, the form has a block for each, so the dissipation acts site by site, at the same rate however many there are.

    Parameters
    ----------
    rate : float, >= 0
        The factor of the form (mu**2 * time / entropy, with mu the unit of the momentum).
    form : optional
        𝒦 for rate 1 (dimensionless). A system fills it in from its algebra.

    Raises
    ------
    IndefiniteError
        When used on an algebra that is not semisimple and whose ``-kappa`` is indefinite.

    Examples
    --------
    >>> g = mf.so(3)
    >>> system = lt.LiePoissonSystem(
    ...     g, lt.Quadratic([1.0, 2.0, 3.0]), g.casimirs(2)[0], lt.KillingDissipation(0.1)
    ... )
    >>> bool(system.check().passed)
    True
    """

    rate: jax.Array
    form: Any

    def __init__(self, rate=1.0, form=None):
        self.rate = checked_rate(rate)
        self.form = form  # bind_to() fills it in, once the algebra is known

    @staticmethod
    def inner_product(g: mf.LieAlgebra) -> Any:
        """Return the positive semidefinite form 𝒦 on g for rate 1: a matrix, shape (dim, dim), or a block form."""
        if not g.is_semisimple() and (n_negative := g.killing_signature()[0]):
            min_eigenvalue = float(np.linalg.eigvalsh(-g.killing_form())[0])
            raise IndefiniteError(
                f"{g.name} is not semisimple and minus its Killing form is indefinite, with {n_negative} negative "
                f"eigenvalues, the lowest {min_eigenvalue:.3g}: the entropy could fall. Use ProjectedMetric(), or "
                "InnerProductDissipation(K) with an inner product K",
                residual=min_eigenvalue,
                tolerance=0.0,
            )
        return g.killing_inner_product()

    def bind_to(self, system):
        g = require_algebra(system, "KillingDissipation")
        form = self.inner_product(g)
        if g.is_solvable():  # Cartan's criterion: kappa(g, [g, g]) = 0
            raise InputError(
                f"{g.name} is solvable: its Killing form vanishes on brackets, so KillingDissipation would do nothing. "
                "Instead use ProjectedMetric() or InnerProductDissipation(K)"
            )
        return dataclasses.replace(self, form=real_array(form) if isinstance(form, np.ndarray) else form)

    def added_momentum(self, dH, bracket_dH_dS):
        return self.rate * (self.form @ bracket_dH_dS)

    def factor(self, system, x, dH, dL):
        factor = _bracket_factor(system, dH, self.form)
        return None if factor is None else factor.scale_by(self.rate)


def _bracket_factor(system, dH, form) -> Factor | None:
    """Return the factor of ``ad*_dH 𝒦 ad_dH``, whose columns have divergence zero; None if 𝒦 has no known root.

    C is skew in a, b: ``div ad*_dH F = C[a, b, c] H_ab F_c`` vanishes.
    """
    root, g = form_root(form), system.algebra
    return None if root is None else Factor(g.dim, lambda w: g.ad_star(dH, root @ w), solenoidal=True)
