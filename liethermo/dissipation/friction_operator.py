"""Friction by a matrix that the user gives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from ..errors import InputError
from .base import Dissipation
from .checks import check_form_shape, checked_rate, checked_semidefinite, evaluate_form, reject_rate_as_form
from .factor import Factor

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

    K: Callable | jax.Array
    rate: jax.Array
    project: bool = eqx.field(static=True)
    projection: str = eqx.field(static=True)

    def __init__(self, K, rate=1.0, project: bool = False, projection: Literal["oblique", "orthogonal"] = "oblique"):
        reject_rate_as_form(K, self, "the operator K")
        self.K = K if callable(K) else checked_semidefinite(K, "the friction operator K")
        self.rate = checked_rate(rate)
        self.project = bool(project)
        if projection not in ("oblique", "orthogonal"):
            raise InputError(f"projection must be 'oblique' or 'orthogonal', got {projection!r}")
        self.projection = projection

    can_drive_baths = True

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
