"""Double brackets: the energy falls along coadjoint orbits."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from manifolds.matrices.blocks import Diagonal

from ..functions.conditions import checked_numbers, require_condition
from .base import Damping
from .checks import check_form_shape, checked_bath_indices, checked_rate, checked_semidefinite, repeat_over_sites
from .factor import Factor, form_root
from .geometry import isotropic_size, isotropic_vector


class DoubleBracket(Damping):
    """Double bracket: keeps every Casimir and lowers the energy [Bloch, Krishnaprasad, Marsden, Ratiu 1996].

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

    rate: jax.Array
    metric: Any

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
        return self.rate * system.poisson.sharp(x, self._bracket_velocity(system, x, dH))

    def velocity(self, system, x, dH, dS, dL):
        return self.rate * self._bracket_velocity(system, x, dH)

    def _bracket_velocity(self, system, x, dH) -> jax.Array:
        """Return sigma = ``(Pi dH)^♯``, shape (n,), by the metric; the force is ``rate * Pi sigma``."""
        motion = system.poisson.sharp(x, dH)
        return system.lower_index(x, motion) if self.metric is None else self.metric @ motion

    def factor(self, system, x, dH, dL):
        root = None if self.metric is None else form_root(self.metric)

        def velocity(w):
            return system.lower_index(x, isotropic_vector(system, x, w)) if root is None else root @ w

        def times(w):
            return system.poisson.sharp(x, velocity(w))

        n_columns = isotropic_size(system) if root is None else system.dim
        return Factor(n_columns, times, velocity=velocity).scale_by(self.rate)


def _checked_metric(metric) -> Any:
    if np.ndim(metric) != 1:
        return checked_semidefinite(metric, "the metric")
    entries = checked_numbers(metric, "the metric")
    require_condition(entries, lambda entries: entries >= 0.0, "the diagonal of the metric must be >= 0, got {value}")
    return Diagonal(entries)
