"""Friction against the surroundings, which take the energy."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from ..functions.indices import Indices
from .base import Dissipation
from .checks import (
    check_form_shape,
    checked_bath_indices,
    checked_rate,
    checked_semidefinite,
    evaluate_form,
    reject_rate_as_form,
)
from .factor import Factor


class Friction(Dissipation):
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
    """

    D: Callable | jax.Array | None
    rate: jax.Array
    bath: Indices | None = eqx.field(static=True)

    def __init__(self, D=None, rate=1.0, bath=None):
        reject_rate_as_form(D, self, "the friction D")
        if D is not None and not callable(D):
            D = jnp.asarray(D) if is_traced(D) else D
            diagonal = jnp.diag if is_traced(D) else np.diag
            D = checked_semidefinite(diagonal(D) if np.ndim(D) == 1 else D, "the friction D")
        self.D = D
        self.rate = checked_rate(rate)
        self.bath = checked_bath_indices(bath)

    energy_law = "nonincreasing"
    entropy_law = None
    needs_entropy = False

    def bind_to(self, system):
        if self.D is not None:
            check_form_shape(self.D, system.dim, "the friction D")
        return self

    @property
    def heated_bath_index(self):
        return self.bath

    def force(self, system, x, dH, dS, dL):
        if self.D is None:
            return -self.rate * system.raise_index(x, dH)
        return -self.rate * system.project_tangent(x, evaluate_form(self.D, x) @ system.project_tangent(x, dH))

    def factor(self, system, x, dH, dL):
        if self.D is None:
            return Factor(
                system.isotropic_size, lambda w: system.isotropic_vector(x, w), system.space is None
            ).scale_by(self.rate)
        root = semidefinite_root(self.D(x)) if callable(self.D) else semidefinite_factor(self.D)
        constant = system.space is None and not callable(self.D)
        return Factor(system.dim, lambda w: system.project_tangent(x, root @ w), constant).scale_by(self.rate)
