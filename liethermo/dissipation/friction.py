"""Friction against the surroundings, which take the energy."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root

from .base import Dissipation
from .checks import check_matrix, checked_rate, form_at, semidefinite
from .factor import Factor


class Friction(Dissipation):
    """``x' = Pi dH - rate * D(x) dH``: the energy falls, ``H' = -rate dH . D dH <= 0``, and is gone.

    With D = diag(0, gamma) on (q, p) it is the drag ``p' = -gamma v``; on the dual of an algebra it is that of a body
    in a fluid. The heat is not followed, so no entropy is needed and its law is not claimed. In a bath of a temperature
    (:class:`liethermo.Fluctuations`) it is Langevin's equation, and the heat is recorded.

    Parameters
    ----------
    D : array, shape (n, n), or (n,) for a diagonal matrix, or function from x, shape (n,), to a matrix (n, n)
        Positive semidefinite. A function is taken to have the same rank everywhere.
    rate : float, >= 0
    """

    D: Callable | jax.Array
    rate: jax.Array

    def __init__(self, D, rate=1.0):
        if not callable(D):
            D = semidefinite(np.diag(D) if np.ndim(D) == 1 else D, "the friction D")
        self.D = D
        self.rate = checked_rate(rate)

    @property
    def energy_law(self):
        return "nonincreasing"

    @property
    def entropy_law(self):
        return None

    @property
    def needs_entropy(self):
        return False

    def prepared(self, system):
        check_matrix(self.D, system.dim, "the friction D")
        return self

    def force(self, system, x, dH, dS, dL):
        return -self.rate * (form_at(self.D, x) @ dH)

    def factor(self, system, x, dH, dL):
        root = semidefinite_root(self.D(x)) if callable(self.D) else semidefinite_factor(self.D)
        return Factor(system.dim, lambda w: root @ w, not callable(self.D)).scaled(self.rate)
