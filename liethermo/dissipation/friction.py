"""Friction against the surroundings, which take the energy."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from .base import Damping
from .checks import (
    check_form_shape,
    checked_bath_indices,
    checked_rate,
    checked_semidefinite,
    evaluate_form,
    reject_rate_as_form,
)
from .factor import Factor
from .geometry import isotropic_size, isotropic_vector, project_tangent


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

    D: Callable | jax.Array | None
    rate: jax.Array

    def __init__(self, D=None, rate=1.0, bath=None):
        reject_rate_as_form(D, self, "the friction D")
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
                isotropic_size(system), lambda w: isotropic_vector(system, x, w), system.space is None
            ).scale_by(self.rate)
        root = semidefinite_root(self.D(x)) if callable(self.D) else semidefinite_factor(self.D)
        constant = system.space is None and not callable(self.D)
        return Factor(system.dim, lambda w: project_tangent(system, x, root @ w), constant).scale_by(self.rate)
