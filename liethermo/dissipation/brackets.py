"""Dissipation by brackets on a Lie algebra: double brackets, inner products (BFM's construction), and 4-brackets."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import real_array
from manifolds.matrices.linear import Diagonal, skew_matrix
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from ..errors import IndefiniteError, InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers, require_condition, semidefinite_condition
from .base import Damping, Dissipation
from .checks import (
    RATE_CONDITION,
    check_form_shape,
    checked_bath_indices,
    checked_rate,
    checked_semidefinite,
    evaluate_form,
    repeat_over_sites,
    require_algebra,
)
from .factor import Factor, form_root
from .geometry import isotropic_noise, isotropic_noise_dim


class DoubleBracket(Damping):
    """Double bracket: conserves every Casimir and lowers the energy [Bloch, Krishnaprasad, Marsden, Ratiu 1996].

    ``x' = Pi dH + rate * Pi (Pi dH)^♯``, that is ``ad*_xi mu + rate * ad*_sigma mu`` with ``sigma = (ad*_xi mu)^♯``
    on a Lie algebra, so ``H' = -rate |Pi dH|^2 <= 0``. It needs no entropy. An entropy of the system must be a Casimir,
    and is conserved. On so(3) it describes a body with internal friction and without torque: |mu| is constant, and the
    kinetic energy falls. If the system has baths, they take this energy: see :class:`liethermo.HeatBaths`.

    Parameters
    ----------
    rate : float, >= 0
        Factor of the bracket. The unit of ``rate * metric`` is 1 / mu: s / (kg m**2) for a body in SI units.
    metric : array, shape (n, n) or (n,), optional
        The positive semidefinite form ^♯, or its diagonal (dimensionless, or in units that go into that of the rate).
        By default it is the identity, or on a manifold the metric of the space. On copies of an algebra it may be that
        of one site, shape (d, d). Both act site by site.
    bath : int, or array of int of the shape of the sites, optional
        The number of the bath that takes the heat, from 0; by default the first.

    Examples
    --------
    >>> body = lt.LiePoissonSystem(
    ...     mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), dissipation=lt.DoubleBracket(0.1)
    ... )
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 50.0), 0.1)
    >>> size = np.linalg.norm(run.x, axis=1)
    >>> bool(run.energy[-1] < run.energy[0]), bool(np.ptp(size) < 1e-14)
    (True, True)
    """

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
    metric: Any = eqx.field(metadata=semidefinite_condition("the metric").metadata)

    def __init__(self, rate=1.0, metric=None, bath=None):
        self.rate = checked_rate(rate)
        self.bath = checked_bath_indices(bath)
        self.metric = None if metric is None else _checked_metric(metric)

    entropy_law = "conserved"
    preserves_casimirs = True

    def bind_to(self, system):
        if self.metric is None:
            return self
        metric = repeat_over_sites(self.metric, system)
        check_form_shape(metric, system.dim, "the metric")
        return self if metric is self.metric else eqx.tree_at(lambda d: d.metric, self, metric)

    def force(self, system, x, dH, dS, dL):
        return self.rate * system.poisson.sharp(x, self._velocity_at_unit_rate(system, x, dH))

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        return self.rate * self._velocity_at_unit_rate(system, x, dH)

    def _velocity_at_unit_rate(self, system, x, dH) -> jax.Array:
        """Return sigma = ``(Pi dH)^♯``, shape (n,), by the metric; the force is ``rate * Pi sigma``."""
        motion = system.poisson.sharp(x, dH)
        return system.lower_index(x, motion) if self.metric is None else self.metric @ motion

    def factor(self, system, x, dH, dL):
        root = None if self.metric is None else form_root(self.metric)

        def added_attitude_velocity(w):
            return system.lower_index(x, isotropic_noise(system, x, w)) if root is None else root @ w

        def times(w):
            return system.poisson.sharp(x, added_attitude_velocity(w))

        n_columns = isotropic_noise_dim(system) if root is None else system.dim
        return Factor(n_columns, times, added_attitude_velocity=added_attitude_velocity).scale_by(self.rate)


def _checked_metric(metric) -> Any:
    """Return a metric, a matrix or the diagonal of one, as a linear map; raise InputError unless it is semidefinite."""
    if np.ndim(metric) != 1:
        return checked_semidefinite(metric, "the metric")
    entries = checked_numbers(metric, "the metric")
    require_condition(entries, lambda entries: entries >= 0.0, "the diagonal of the metric must be >= 0, got {value}")
    return Diagonal(entries)


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

    K: Any = eqx.field(metadata=semidefinite_condition("the inner product 𝒦").metadata)

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
        return _bracket_dissipation_factor(system, dH, self.K)


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

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
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
        factor = _bracket_dissipation_factor(system, dH, self.form)
        return None if factor is None else factor.scale_by(self.rate)


def _bracket_dissipation_factor(system, dH, form) -> Factor | None:
    """Return B with ``B B^T = ad*_dH 𝒦 ad_dH``, or None if no R with ``R R^T = 𝒦`` is known.

    The divergence of each column of B is zero: C is skew in a, b, so ``div ad*_dH F = C[a, b, c] H_ab F_c`` vanishes.
    """
    root, g = form_root(form), system.algebra
    return None if root is None else Factor(g.dim, lambda w: g.ad_star(dH, root @ w), solenoidal=True)


class FourBracket(Dissipation):
    """Metriplectic 4-bracket dissipation ``(F, G) = (F, H; G, H)`` [Morrison & Updike 2024].

    The 4-bracket ``(F, K; G, N) = R^{ijkl} F_i K_j G_k N_l`` has the symmetries of a curvature tensor, so H is
    conserved whatever R is. Two families have constructors of their own: :meth:`kulkarni_nomizu`, which contains
    (BFM 2.2), and :meth:`lie_algebra`, which is (BFM 3.7).

    Parameters
    ----------
    tensor : array, shape (n, n, n, n), or function from x, shape (n,), to one
        ``R[i, j, k, l]``, antisymmetric in (i, j) and in (k, l), symmetric under exchange of the pairs (in units of
        x**4 / (energy**2 * entropy * time)).

    Raises
    ------
    InputError
        If a constant tensor lacks a symmetry, which is named.

    Examples
    --------
    >>> e = np.array(mf.so(3).structure_constants)
    >>> tensor = 0.1 * np.einsum("ijm,klm->ijkl", e, e)
    >>> system = lt.LiePoissonSystem(
    ...     mf.so(3),
    ...     lt.Quadratic([1.0, 2.0, 3.0]),
    ...     mf.so(3).casimirs(2)[0],
    ...     lt.FourBracket(tensor),
    ... )
    >>> bool(system.check().passed)
    True
    """

    tensor: Callable | jax.Array

    def __init__(self, tensor):
        if not callable(tensor):
            tensor = checked_numbers(tensor, "a 4-bracket")
            if tensor.ndim != 4 or len(set(tensor.shape)) != 1:
                raise InputError(f"a 4-bracket must have shape (n, n, n, n), got {tensor.shape}")
            _check_curvature_symmetries(tensor)
        self.tensor = tensor

    @staticmethod
    def kulkarni_nomizu(sigma, mu) -> Dissipation:
        """Return the 4-bracket ``sigma ∧ mu`` of two semidefinite forms on covectors, constants or functions of x.

        ``K(a, b) = sigma(a, b) mu(h, h) - sigma(a, h) mu(h, b) + mu(a, b) sigma(h, h) - mu(a, h) sigma(h, b)``, h = dH.
        With sigma = G/2 and mu = G it is the projected metric (BFM 2.2) of G.
        """
        return KulkarniNomizu(sigma, mu)

    @staticmethod
    def lie_algebra(form=None) -> Dissipation:
        """Return the 4-bracket ``𝒦([dF, dK], [dG, dN])`` of an inner product 𝒦 on g, by default the Killing one."""
        return KillingDissipation() if form is None else InnerProductDissipation(form)

    def bind_to(self, system):
        n = system.dim
        if callable(self.tensor):
            traced_function_and_shape(self.tensor, [(n,)], [(n,) * 4], "the 4-bracket", f"a state of shape ({n},)")
        elif self.tensor.shape != (n,) * 4:
            raise InputError(f"the 4-bracket has shape {self.tensor.shape}, but the state has {n} components")
        return self

    def force(self, system, x, dH, dS, dL):
        return jnp.einsum("ijkl,j,k,l->i", evaluate_form(self.tensor, x), dH, dS, dH)

    def factor(self, system, x, dH, dL):
        """Return the factor with the columns ``A dH``, where ``R = sum A (x) A``: R must be semidefinite on pairs."""
        i, j = np.triu_indices(system.dim, 1)
        form = evaluate_form(self.tensor, x)[i, j][:, i, j]
        _check_semidefinite_on_pairs(form)
        root = semidefinite_root(form) if callable(self.tensor) else semidefinite_factor(form)

        def times(w):
            return skew_matrix(root @ w, system.dim) @ dH

        return Factor(len(i), times, solenoidal=not callable(self.tensor))


class KulkarniNomizu(Dissipation):
    """The 4-bracket of two forms; see :meth:`FourBracket.kulkarni_nomizu`."""

    sigma: Callable | jax.Array = eqx.field(metadata=semidefinite_condition("the form sigma").metadata)
    mu: Callable | jax.Array = eqx.field(metadata=semidefinite_condition("the form mu").metadata)

    def __init__(self, sigma, mu):
        self.sigma = sigma if callable(sigma) else checked_semidefinite(sigma, "the form sigma")
        self.mu = mu if callable(mu) else checked_semidefinite(mu, "the form mu")

    def bind_to(self, system):
        check_form_shape(self.sigma, system.dim, "the form sigma")
        check_form_shape(self.mu, system.dim, "the form mu")
        return self

    def force(self, system, x, dH, dS, dL):
        sigma, mu = evaluate_form(self.sigma, x), evaluate_form(self.mu, x)
        sH, mH = sigma @ dH, mu @ dH
        from_sigma = jnp.dot(mH, dH) * (sigma @ dS) - jnp.dot(mH, dS) * sH
        from_mu = jnp.dot(sH, dH) * (mu @ dS) - jnp.dot(sH, dS) * mH
        return from_sigma + from_mu

    def factor(self, system, x, dH, dL):
        """Return the factor with a column ``(m_j . dH) s_i - (s_i . dH) m_j`` for each pair of columns of the roots."""
        n, constant = system.dim, not (callable(self.sigma) or callable(self.mu))
        s, m = (
            semidefinite_root(form(x)) if callable(form) else semidefinite_factor(form)
            for form in (self.sigma, self.mu)
        )

        def times(w):
            w = w.reshape(n, n)
            return s @ (w @ (dH @ m)) - m @ ((dH @ s) @ w)

        return Factor(n * n, times, constant)


def _check_semidefinite_on_pairs(form) -> None:
    """Raise IndefiniteError if the form of a 4-bracket on pairs of covectors has a negative eigenvalue."""
    if isinstance(form, jax.core.Tracer):
        return
    min_eigenvalue, scale = float(np.linalg.eigvalsh(np.asarray(form))[0]), float(np.abs(form).max())
    if min_eigenvalue < -1e-12 * scale * len(form):
        raise IndefiniteError(
            f"the 4-bracket has no factor: on pairs of covectors it has the negative eigenvalue {min_eigenvalue:.3g}. "
            "If the friction matrix that it makes is semidefinite, use that matrix in a FrictionOperator",
            residual=min_eigenvalue,
            tolerance=1e-12 * scale * len(form),
        )


def _check_curvature_symmetries(R) -> None:
    """Raise InputError unless R has the symmetries of a 4-bracket. The first Bianchi identity is not one of them."""
    if isinstance(R, jax.core.Tracer):
        return
    R = np.asarray(R)
    tolerance = 1e-12 * float(np.abs(R).max())
    for name, image in [
        ("R[i,j,k,l] = -R[j,i,k,l]", -R.transpose(1, 0, 2, 3)),
        ("R[i,j,k,l] = -R[i,j,l,k]", -R.transpose(0, 1, 3, 2)),
        ("R[i,j,k,l] = R[k,l,i,j]", R.transpose(2, 3, 0, 1)),
    ]:
        residual = float(np.abs(R - image).max())
        if residual > tolerance:
            raise InputError(
                f"the tensor R of a 4-bracket must obey {name}, but the sides differ by {residual:.3g} (tolerance "
                f"{tolerance:.1g})"
            )
