"""Damping of spins, site by site: to a lower energy, or with a bath whose entropy takes the heat."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds.structures.spins import (
    Spins,
    VectorComponents,
    cross_vectors,
    dot_vectors,
    scale_vectors,
    split_vectors,
    sum_of_dots,
)

from ..errors import InputError
from ..functions.conditions import checked_numbers, require_condition
from ..functions.frames import sqrt_or_zero
from .base import Damping
from .checks import RATE_CONDITION, checked_bath_indices, checked_rates
from .factor import Factor


class LandauLifshitz(Damping):
    """Landau-Lifshitz damping ``lambda_i s_i x (s_i x dH_i)`` at each site i: every |s_i| is constant, and H falls.

    It is the double bracket of so(3) at every site, with a rate of its own at each: the energy falls at the rate
    ``sum lambda_i |s_i x dH_i|^2``. In a system without baths that is all. In one with baths the heat goes to the bath
    of the site and the energy is constant: see :class:`liethermo.dissipation.heating.Heating`. Each site is damped as
    it would be alone, however many there are.

    Gilbert's form ``s' = gamma s x dH + alpha s x s'`` is the same motion with ``gamma / (1 + alpha^2)`` in place of
    gamma and ``lambda = alpha gamma / (1 + alpha^2)``, for |s| = 1: see :meth:`gilbert`.

    Parameters
    ----------
    rate : float >= 0, or array of the shape of the sites
        lambda_i (1 / (energy * time)).
    bath : int, or array of int of the shape of the sites, optional
        The number of the bath that a site heats, from 0; by default all heat the first.

    References
    ----------
    Landau & Lifshitz 1935; Gilbert 2004 (eq. 12); Bloch, Krishnaprasad, Marsden & Ratiu 1996 for the double bracket.

    Examples
    --------
    A spin turns towards the field, and its length stays constant:

    >>> system = lt.SpinSystem(
    ...     1, lt.magnetism.zeeman(1, [0.0, 0.0, 1.0]), lt.LandauLifshitz(0.5)
    ... )
    >>> spin = lt.integrate(system, [[0.6, 0.0, 0.8]], (0.0, 20.0), 0.1)
    >>> bool(spin.x[-1, 2] > 0.999), bool(abs(np.linalg.norm(spin.x[-1]) - 1.0) < 1e-14)
    (True, True)
    """

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)

    def __init__(self, rate=1.0, bath=None):
        self.rate = checked_rates(rate)
        self.bath = checked_bath_indices(bath)

    @staticmethod
    def gilbert(alpha, ratio=1.0) -> tuple[jax.Array, jax.Array]:
        """Return the pair (ratio, rate) of Landau and Lifshitz' form, from the alpha and ratio of Gilbert's form.

        The damping ``alpha s x s'`` of Gilbert's form lowers the energy if alpha and ratio have one sign.

        Raises
        ------
        InputError
            If ``alpha ratio`` is negative or not finite.
        """
        alpha, ratio = checked_numbers(alpha, "alpha"), checked_numbers(ratio, "ratio")
        require_condition(
            alpha * ratio,
            lambda a: (a >= 0.0) & (a < np.inf),
            "alpha ratio must be >= 0 and finite, got {value}; otherwise the damping raises the energy. With ratio < 0 "
            "give alpha < 0",
        )
        return ratio / (1.0 + alpha**2), alpha * ratio / (1.0 + alpha**2)

    entropy_law = "conserved"
    preserves_casimirs = True

    def bind_to(self, system):
        spins = system.poisson
        if not isinstance(spins, Spins):
            raise InputError(
                "LandauLifshitz needs a SpinSystem. For so(3) at every site use DoubleBracket, which has the same force"
            )
        if self.rate.shape not in ((), spins.sites):
            raise InputError(
                f"rate must be one number, or have the shape {spins.sites} of the sites, got {self.rate.shape}"
            )
        return self

    def force(self, system, x, dH, dS, dL):
        force, _ = self.damping_force_and_energy_loss(system.poisson, x, dH)
        return system.poisson.join_state(force, jnp.zeros(0))

    def damping_force_and_energy_loss(
        self, spins: Spins, x, dH, sign=1.0, per_site: bool = False
    ) -> tuple[VectorComponents, jax.Array]:
        """Return the force components on ``spins`` and the rate at which the energy falls, both times ``sign``.

        The rate is that of all sites together, or with ``per_site`` of each site.
        """
        s, rate = spins.spins(x), sign * self.rate.reshape(-1)
        torque = cross_vectors(s, spins.split_covectors(dH))
        if rate.size == 1 and not per_site:
            energy_loss = rate[0] * sum_of_dots(torque, torque)
        else:
            energy_loss = rate * dot_vectors(torque, torque)
            energy_loss = energy_loss if per_site else jnp.sum(energy_loss)
        return scale_vectors(rate, cross_vectors(s, torque)), energy_loss

    def factor(self, system, x, dH, dL):
        spins = system.poisson
        s, scale = spins.spins(x), sqrt_or_zero(self.rate.reshape(-1))

        def times(w):
            vectors = split_vectors(w.reshape(spins.count, 3))
            return spins.join_state(scale_vectors(scale, cross_vectors(vectors, s)), jnp.zeros(0))

        # solenoidal: w x s has divergence zero for any w that does not depend on s
        return Factor(
            3 * spins.count, times, solenoidal=True, spin_coefficients=scale.reshape(self.rate.shape and (-1,))
        )
