"""Kinds of friction: against the surroundings, with a friction matrix of the user, and as a force."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from ..errors import InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import semidefinite_condition
from .base import Damping, Dissipation
from .checks import (
    RATE_CONDITION,
    check_form_shape,
    checked_bath_indices,
    checked_rate,
    checked_semidefinite,
    evaluate_form,
    reject_number_as_form,
    require_algebra,
)
from .factor import Factor
from .geometry import isotropic_noise, isotropic_noise_dim, project_tangent


class Friction(Damping):
    """Friction against the surroundings: ``x' = Pi dH - rate * D(x) dH``, with ``H' = -rate dH . D dH <= 0``.

    Without a D it is the gradient flow of the metric. With D = diag(0, gamma) on (q, p) it is the drag ``p' = -gamma
    v``; on the dual of an algebra it is the drag of a body in a fluid. If a system has baths
    (:class:`liethermo.HeatBaths`), they take the heat. Otherwise the heat is not recorded, and no law of an entropy is
    claimed. At a constant temperature (:class:`liethermo.Fluctuations`) it is Langevin's equation, and the heat is
    recorded.

    Parameters
    ----------
    D : array, shape (n, n), or (n,) for a diagonal matrix, or function from x, shape (n,), to a matrix (n, n); optional
        Positive semidefinite, in units such that ``rate * D`` has x**2 / (energy * time). A function must have the same
        rank everywhere. By default the identity, or on a manifold the inverse of the metric of the space.
    rate : float, >= 0
        Factor of D, in the units described there.
    bath : int, or array of int of the shape of the sites, optional
        The number of the bath that takes the heat, from 0; by default the first.

    Examples
    --------
    An oscillator with drag loses energy:

    >>> J = np.array([[0.0, 1.0], [-1.0, 0.0]])
    >>> oscillator = lt.MetriplecticSystem(
    ...     J, lt.Quadratic(np.ones(2)), None, lt.Friction([0.0, 0.2])
    ... )
    >>> run = lt.integrate(oscillator, [1.0, 0.0], (0.0, 20.0), 0.1)
    >>> bool(run.energy[-1] < 0.03 * run.energy[0]), run.audit().passed
    (True, True)
    """

    D: Callable | jax.Array | None = eqx.field(metadata=semidefinite_condition("the friction D").metadata)
    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)

    def __init__(self, D=None, rate=1.0, bath=None):
        reject_number_as_form(D, self, "the friction D")
        if D is not None and not callable(D):
            D = jnp.asarray(D) if is_traced(D) else D
            diagonal = jnp.diag if is_traced(D) else np.diag
            D = checked_semidefinite(diagonal(D) if np.ndim(D) == 1 else D, "the friction D")
        self.D = D
        self.rate = checked_rate(rate)
        self.bath = checked_bath_indices(bath)

    def bind_to(self, system):
        if self.D is not None:
            check_form_shape(self.D, system.dim, "the friction D")
        return self

    def force(self, system, x, dH, dS, dL):
        if self.D is None:
            return -self.rate * system.raise_index(x, dH)
        return -self.rate * project_tangent(system, x, evaluate_form(self.D, x) @ project_tangent(system, x, dH))

    def factor(self, system, x, dH, dL):
        if self.D is None:
            return Factor(
                isotropic_noise_dim(system), lambda w: isotropic_noise(system, x, w), system.space is None
            ).scale_by(self.rate)
        root = semidefinite_root(self.D(x)) if callable(self.D) else semidefinite_factor(self.D)
        constant = system.space is None and not callable(self.D)
        return Factor(system.dim, lambda w: project_tangent(system, x, root @ w), constant).scale_by(self.rate)


FRICTION_KERNEL_CHECK = "K grad H = 0, as given"
"""Row of ``system.check()``: K grad H = 0 for a friction operator before it is projected."""


class FrictionOperator(Dissipation):
    """Dissipation by a friction matrix K(x) with ``K(x) grad H(x) = 0`` [BFM Remark 4.7].

    Building a system, and ``system.check()``, test that grad H is in the kernel of K. For any other K only the
    projection ``P^T K P`` would act, where P is the projector off grad H; ``project=True`` says that this is intended.

    A discretisation passes a discrete gradient dH beside ``grad H(x)``. The kernel is then moved from one to the other:
    ``K_d = P^T K P`` with ``P = 1 - dH grad H^T / (grad H . dH)``, the projector along dH onto the complement of grad
    H. K_d is semidefinite, has dH in its kernel, keeps every other kernel vector of K that is orthogonal to grad H
    (momentum maps), and tends to K.

    The remark itself uses the complement of the kernel that is orthogonal in a metric G, as the ``projection``
    "orthogonal" does: ``P = 1 - dH (G dH)^T / (dH . G dH)``. The two projections differ by the rotation from grad H to
    dH, O(h^2) in a step, and obey the same laws. The orthogonal one moves kernel vectors of K that are not orthogonal
    to dH, and needs no safeguard if dH rotates away from grad H.

    If a system has baths (:class:`liethermo.HeatBaths`) and no entropy of its own, K acts on the state followed by the
    entropies of the baths, whose sum is the entropy that grows.

    Parameters
    ----------
    K : function from x, shape (n,), to a matrix (n, n), or a constant matrix
        The friction matrix, symmetric and semidefinite, in units such that ``rate * K`` has x**2 / (entropy * time).
        With baths, n counts their entropies too.
    rate : float, >= 0
        Factor of K, in the units described there.
    project : bool
        Accept any symmetric semidefinite K, and use its projection off grad H.
    projection : {"oblique", "orthogonal"}
        How the kernel is moved to the discrete gradient; G is the metric of the space.

    Examples
    --------
    >>> def friction(x):
    ...     v = jnp.array([-x[1], x[0], 0.0])  # orthogonal to grad H
    ...     return jnp.outer(v, v)
    >>> system = lt.LiePoissonSystem(
    ...     mf.so(3),
    ...     lt.Quadratic([1.0, 1.0, 0.0]),
    ...     mf.so(3).casimirs(2)[0],
    ...     lt.FrictionOperator(friction),
    ... )
    >>> bool(system.check().passed)
    True
    """

    K: Callable | jax.Array = eqx.field(metadata=semidefinite_condition("the friction operator K").metadata)
    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
    project: bool = eqx.field(static=True)
    projection: str = eqx.field(static=True)

    def __init__(self, K, rate=1.0, project: bool = False, projection: Literal["oblique", "orthogonal"] = "oblique"):
        reject_number_as_form(K, self, "the operator K")
        self.K = K if callable(K) else checked_semidefinite(K, "the friction operator K")
        self.rate = checked_rate(rate)
        self.project = bool(project)
        if projection not in ("oblique", "orthogonal"):
            raise InputError(f"projection must be 'oblique' or 'orthogonal', got {projection!r}")
        self.projection = projection

    can_act_on_baths = True

    def bind_to(self, system):
        check_form_shape(self.K, system.dim, "the friction operator K")
        return self

    def input_residuals(self, system, x):
        if self.project:
            return {}
        K, dH = evaluate_form(self.K, x), system.energy.gradient(x)
        dH = dH if system.space is None else system.lower_index(x, system.raise_index(x, dH))
        scale = jnp.max(jnp.abs(K)) * jnp.max(jnp.abs(dH))
        residual = jnp.max(jnp.abs(jnp.stack([K @ dH, dH @ K])))
        return {FRICTION_KERNEL_CHECK: residual / jnp.where(scale > 0.0, scale, 1.0)}

    def force(self, system, x, dH, dS, dL):
        direction = self._projection_direction(system, x, dH)
        image = evaluate_form(self.K, x) @ (dS - jnp.dot(direction, dS) * dH)
        return self.rate * (image - jnp.dot(dH, image) * direction)

    def factor(self, system, x, dH, dL):
        """Return the factor ``P^T B`` of the operator ``P^T K P``, where ``B B^T = K``.

        B is the symmetric root of K(x), or the Cholesky factor of a constant K.
        """
        root = semidefinite_root(self.K(x)) if callable(self.K) else semidefinite_factor(self.K)
        direction = self._projection_direction(system, x, dH)

        def times(w):
            image = root @ w
            return image - jnp.dot(dH, image) * direction

        return Factor(system.dim, times).scale_by(self.rate)

    def _projection_direction(self, system, x, dH):
        """Return the vector a with ``a . dH = 1`` along which P projects."""
        dH_vector = system.raise_index(x, dH)
        gradient = dH_vector if self.projection == "orthogonal" else system.raise_index(x, system.energy.gradient(x))
        overlap, square = jnp.dot(gradient, dH), jnp.dot(dH_vector, dH)
        # If grad H is tiny or nearly orthogonal to dH, project orthogonally off dH instead.
        is_usable = overlap > 1e-3 * square
        direction = jnp.where(is_usable, gradient, dH_vector)
        overlap = jnp.where(is_usable, overlap, square)
        return direction / jnp.where(overlap > 0.0, overlap, 1.0)


class EulerPoincareForce(Dissipation):
    """A force ``ad*_xi F(xi)`` [BFM 3.2, 3.4]: ``mu' = ad*_xi (mu + F(xi))`` conserves the energy for every F.

    The entropy law is not guaranteed; ``system.check()`` reports the sign of the entropy production at random points.

    Parameters
    ----------
    F : function from xi in g, shape (dim,), to a covector, shape (dim,)
        On copies of an algebra both have the shape ``(*sites, d)``.
    """

    F: Callable

    entropy_law = None
    needs_entropy = False

    def bind_to(self, system):
        require_algebra(system, "EulerPoincareForce")
        traced_function_and_shape(
            self.F, [system.shape], [system.shape], "the force F", f"a velocity of shape {system.shape}"
        )
        return dataclasses.replace(self, F=_FlattenedMap(self.F, system.shape)) if system.sites else self

    def added_momentum(self, dH, bracket_dH_dS):
        return self.F(dH)

    def force(self, system, x, dH, dS, dL):
        return system.algebra.ad_star(dH, self.F(dH))


class _FlattenedMap(Module):
    """A map of arrays of a given shape, called with flat arrays."""

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, xi):
        return jnp.asarray(self.function(xi.reshape(self.shape))).ravel()
