"""Damping of spins, site by site: to a lower energy, or with a bath whose entropy takes the heat."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import real_array
from manifolds.structures.spins import Planes, Spins, cross_planes, dotted, planes, scaled, summed

from ..errors import InputError
from ..functions.indices import Indices
from .base import Dissipation
from .checks import checked_rate
from .factor import Factor


class LandauLifshitz(Dissipation):
    """Landau-Lifshitz damping, ``lambda_i s_i x (s_i x dH_i)`` at each site i: every |s_i| is kept, and H falls.

    With ``t_i = s_i x dH_i`` the energy falls at the rate ``sum lambda_i |t_i|^2``. In a system without baths that is
    all: a double bracket, which needs no entropy. In one with baths of entropies y_b and temperatures
    ``T_b = dH/dy_b`` the heat goes to the bath b(i) of the site and the energy is constant,

        s_i' = … + lambda_i s_i x (s_i x dH_i),   y_b' = sum_{i in b} lambda_i |t_i|^2 / T_b,

    which is ``K dS`` with ``K = sum_i lambda_i |T_b| w_i^T w_i`` and maps
    ``w_i alpha = s_i x alpha_i - t_i alpha_b / T_b``
    whose kernels dH lies in. Each site is damped as it would be alone, however many there are.

    Gilbert's form ``s' = gamma s x dH + alpha s x s'`` is the same motion with ``gamma / (1 + alpha^2)`` in place of
    gamma and ``lambda = alpha gamma / (1 + alpha^2)``, for |s| = 1: see :meth:`gilbert`.

    Parameters
    ----------
    rate : float >= 0, or array of the shape of the sites
        lambda_i.
    bath : array of int, of the shape of the sites, optional
        b(i), the number of the bath that a site heats, from 0; by default all heat the first.
    baths : int
        How many baths there are; a system fills it in.

    References
    ----------
    Landau & Lifshitz 1935; Gilbert 2004 (eq. 12); Bloch, Krishnaprasad, Marsden & Ratiu 1996 for the double bracket.
    """

    rate: jax.Array
    bath: Indices | None = eqx.field(static=True)
    baths: int = eqx.field(static=True)

    def __init__(self, rate=1.0, bath=None, baths: int = 0):
        array = real_array(rate)
        self.rate = checked_rate(array) if array.shape == () else array
        if array.shape and not isinstance(array, jax.core.Tracer) and not (np.asarray(array) >= 0.0).all():
            raise InputError(f"a dissipation rate must be >= 0, not {float(np.asarray(array).min())}")
        self.bath = bath if bath is None or isinstance(bath, Indices) else Indices(bath)
        self.baths = baths

    @staticmethod
    def gilbert(alpha, ratio=1.0) -> tuple[jax.Array, jax.Array]:
        """Gyromagnetic ratio and rate of Landau and Lifshitz for the damping alpha and the ratio of Gilbert's form."""
        alpha, ratio = real_array(alpha), real_array(ratio)
        return ratio / (1.0 + alpha**2), alpha * ratio / (1.0 + alpha**2)

    @property
    def energy_law(self):
        return "conserved" if self.baths else "nonincreasing"

    @property
    def entropy_law(self):
        return "nondecreasing" if self.baths else "conserved"

    @property
    def keeps_casimirs(self) -> bool:
        return True  # those of the spins: the entropies of baths, which are made to grow, are not listed as such

    @property
    def needs_entropy(self) -> bool:
        return False

    def prepared(self, system):
        spins = system.poisson
        if not isinstance(spins, Spins):
            raise InputError(
                "LandauLifshitz damps the spins of a SpinSystem; on so(3) at every site DoubleBracket is the same "
                "without a bath"
            )
        if self.rate.shape not in ((), spins.sites):
            raise InputError(
                f"rates are one number, or have the shape {spins.sites} of the sites, not {self.rate.shape}"
            )
        if self.bath is not None:
            numbers = np.asarray(self.bath)
            if numbers.shape != spins.sites:
                raise InputError(f"bath is a number for each of the sites {spins.sites}, not of shape {numbers.shape}")
            if not (numbers.min() >= 0 and numbers.max() < spins.others):
                outside = int(numbers[(numbers < 0) | (numbers >= spins.others)][0])
                raise InputError(f"a site heats bath {outside}, but there are {spins.others}, which count from 0")
        return dataclasses.replace(self, baths=spins.others)

    def force(self, system, x, dH, dS, dL):
        if not self.baths:
            return system.poisson.joined(*self.parts(system, x, dH, None, None))
        spins = system.poisson
        return spins.joined(*self.parts(system, x, dH, spins.covectors(dS), dS[3 * spins.count :]))

    def parts(self, system, x, dH, dS: Planes | None, e) -> tuple[Planes, jax.Array]:
        """The components of the force on the spins, and the force on the baths, shape (m,).

        ``dS`` are those of the gradient of the entropy by the spins, None where it is known to vanish, and ``e`` is
        that by the entropies of the baths.
        """
        spins = system.poisson
        s, rate = spins.spins(x), self.rate.reshape(-1)
        torque = cross_planes(s, spins.covectors(dH))
        if not self.baths:
            return scaled(rate, cross_planes(s, torque)), jnp.zeros(0)
        T = dH[3 * spins.count :]
        share, size = self._of_sites(e / T), rate * self._of_sites(_size(T))
        if dS is None:
            strength = size * share
            return scaled(strength, cross_planes(s, torque)), self._heat(strength, torque, torque) / T
        a, b, c = cross_planes(s, dS)
        pull = a - share * torque[0], b - share * torque[1], c - share * torque[2]
        return scaled(size, cross_planes(pull, s)), -self._heat(size, torque, pull) / T

    def factor(self, system, x, dH, dL):
        spins = system.poisson
        s, rate, T = spins.spins(x), self.rate.reshape(-1), dH[3 * spins.count :]
        torque = cross_planes(s, spins.covectors(dH))
        size = rate * self._of_sites(_size(T)) if self.baths else rate
        root = jnp.where(size > 0.0, jnp.sqrt(jnp.where(size > 0.0, size, 1.0)), 0.0)

        def times(w):
            pull = planes(w.reshape(spins.count, 3))
            warmed = -self._heat(root, torque, pull) / T if self.baths else jnp.zeros(0)
            return spins.joined(scaled(root, cross_planes(pull, s)), warmed)

        return Factor(3 * spins.count, times)

    def _of_sites(self, values) -> jax.Array:
        """Values of baths, shape (m,), at the sites that heat them, shape (count,) or (1,)."""
        return values[:1] if self.bath is None else values[np.asarray(self.bath).ravel()]

    def _heat(self, size, torque: Planes, pull: Planes) -> jax.Array:
        """``sum size t . pull`` over the sites of each bath, shape (m,)."""
        if self.bath is not None:
            return jax.ops.segment_sum(size * dotted(torque, pull), np.asarray(self.bath).ravel(), self.baths)
        whole = size[0] * summed(torque, pull) if size.size == 1 else jnp.sum(size * dotted(torque, pull))
        return jnp.zeros(self.baths).at[0].set(whole)


def _size(T) -> jax.Array:
    """``|T|``, with Taylor series: a temperature changes its sign at no state, and ``abs`` would not say so."""
    return jnp.where(T < 0.0, -T, T)
