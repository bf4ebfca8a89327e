"""Dissipation that heats: what a body loses of its energy, baths take up with their entropies."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.energy import Energy
from ..functions.frames import sqrt_or_zero
from ..functions.indices import Indices
from ..functions.with_baths import temperature_slopes
from .base import Dissipation, DissipationSum, LiftedDissipation, LiftedGeometry
from .geometry import Geometry


class Heating(LiftedDissipation):
    """A dissipation ``-K0 dH`` of a body, with baths of entropies y and temperatures ``T = U'(y)`` that it heats.

    It is ``K dS`` on states (x, y) with ``K = B B^T`` and, for ``K0 = B0 B0^T`` and a single bath,

        B = sqrt(T) [B0; -dH^T B0 / T],

    so that ``x' = … - K0 dH`` and ``T y' = dH . K0 dH``. ``K (dH, T) = 0`` and ``K >= 0`` by form, for discrete
    gradients too: both laws are exact. What K0 keeps of the body is kept, every Casimir by a double bracket. Where each
    site has its own bath, K0 acts site by site, and so does this.

    With a temperature below zero the sign of T is taken out of K: the entropy grows there too.

    Attributes
    ----------
    bath : Indices, of shape () or that of the sites
        The number of the bath that takes the heat, from 0; of all sites, or of each.
    has_positive_temperatures : bool
        Whether the temperatures are positive in every state. Then the motion of the body does not wait for them.
    """

    bath: Indices = eqx.field(static=True)
    has_positive_temperatures: bool = eqx.field(static=True)

    energy_law = "conserved"
    entropy_law = "nondecreasing"
    is_symmetric = True
    needs_entropy = False
    has_generator = False

    def force(self, system, x, dH, dS, dL):
        body, n = system.drop_baths(), system.body_dim
        force = self.inner.force(body, x[:n], self._force_gradient(body, dH, dS, n), None, tuple(L[:n] for L in dL))
        return self._join_with_entropies(body, force, dH, n)

    def velocity(self, system, x, dH, dS, dL):
        body, n = system.drop_baths(), system.body_dim
        return self.inner.velocity(body, x[:n], self._force_gradient(body, dH, dS, n), None, tuple(L[:n] for L in dL))

    def factor(self, system, x, dH, dL):
        body, n = system.drop_baths(), system.body_dim
        B = self.inner.factor(body, x[:n], dH[:n], tuple(L[:n] for L in dL))
        if B is None:
            return None
        T = self._values_at_sites(dH[n:])
        scale = sqrt_or_zero(self.temperature_signs(dH[n:]) * T)

        def times(w):
            return self._join_with_entropies(body, body.scale_at_sites(scale, B.times(w)), dH, n)

        along = B.velocity
        velocity = None if along is None else lambda w: body.scale_at_sites(scale, along(w))
        turning = None if B.spin_coefficients is None else scale * B.spin_coefficients
        return B._replace(times=times, velocity=velocity, spin_coefficients=turning, solenoidal=False)

    def divergence(self, system, x):
        """``sqrt(T) div B0 + T' B0^T dH / (2 T^3/2)``, T' the derivative of T by y: no matrix is formed."""
        body, n = system.drop_baths(), system.body_dim
        dH, dL = system.energy.gradient(x), tuple(L.gradient(x) for L in self.preserve)
        B = self.inner.factor(body, x[:n], dH[:n], tuple(L[:n] for L in dL))
        assert B is not None
        if self.has_site_baths and not B.solenoidal:  # each site has a temperature of its own
            return super().divergence(system, x)
        T = jnp.abs(self._values_at_sites(dH[n:]))
        own = jnp.zeros(B.size) if B.solenoidal else jnp.sqrt(T) * self.inner.divergence(body, x[:n])
        warmer = temperature_slopes(system.energy, x, n)
        if warmer is None:
            return own
        share = jnp.where(T > 0.0, 0.5 * self._values_at_sites(warmer) / jnp.where(T > 0.0, T, 1.0) ** 1.5, 0.0)
        return own + B.transpose_times(body.scale_at_sites(share, dH[:n]))

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return _body_geometry(system, x)

    @property
    def has_site_baths(self) -> bool:
        """Whether each site has a bath of its own."""
        return bool(self.bath.shape)

    def temperature_signs(self, T) -> jax.Array:
        """That of the temperatures, at the sites that heat them.

        A temperature changes its sign at no state: so this is a constant, as ``sign`` would not be for Taylor series.
        """
        if self.has_positive_temperatures:
            return jnp.ones(np.shape(self.bath)).ravel() if self.has_site_baths else jnp.ones(())
        return jnp.where(self._values_at_sites(T) < 0.0, -1.0, 1.0)

    def entropy_rates(self, lost, T) -> jax.Array:
        """What the entropies grow by, shape (m,), where a body loses an energy, of shape () or at each site."""
        if self.has_site_baths:
            return jax.ops.segment_sum(lost, np.asarray(self.bath).ravel(), len(T)) / T
        return jnp.where(np.arange(len(T)) == int(np.asarray(self.bath)), lost / T, 0.0)

    def _force_gradient(self, body: Geometry, dH, dS, n: int) -> jax.Array:
        """What takes the place of dH in the force on the body, shape (n,): dH, where the entropy is that of baths."""
        T, e, sign = self._values_at_sites(dH[n:]), self._values_at_sites(dS[n:]), self.temperature_signs(dH[n:])
        return body.scale_at_sites(sign, body.scale_at_sites(e, dH[:n]) - body.scale_at_sites(T, dS[:n]))

    def _values_at_sites(self, values) -> jax.Array:
        """Values of baths, shape (m,), at the sites that heat them, shape () or (sites,)."""
        return values[np.asarray(self.bath).ravel()] if self.has_site_baths else values[int(np.asarray(self.bath))]

    def _join_with_entropies(self, body: Geometry, v, dH, n: int) -> jax.Array:
        """What moves the body, shape (n,), and the entropies that take the energy which it loses."""
        gained = body.dot_at_sites(dH[:n], v) if self.has_site_baths else jnp.dot(dH[:n], v)
        return jnp.concatenate([v, self.entropy_rates(-gained, dH[n:])])


class HeatlessDissipation(LiftedDissipation):
    """A dissipation of a body that makes no heat, beside baths."""

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return _body_geometry(system, x)

    def velocity(self, system, x, dH, dS, dL):
        at = _body_geometry(system, x)
        return self.inner.velocity(at.system, at.x, *at.lift_gradients(dH, dS, dL))


def _body_geometry(system: Geometry, x) -> LiftedGeometry:
    n = system.body_dim
    return LiftedGeometry(
        system.drop_baths(),
        x[:n],
        lambda alpha: alpha[:n],
        lambda v: jnp.pad(v, (0, len(x) - n)),
        preserves_solenoidal=True,
    )


def couple_to_baths(
    dissipation: Dissipation | None, body: Geometry, number: int, positive: bool, pulled: Callable[[Energy], Energy]
) -> Dissipation:
    """The dissipation of a body, beside baths that take its heat: so many, of positive temperatures or of any.

    Raises
    ------
    InputError
        If it makes no heat, or there is no bath of the number that it names.
    """
    parts = () if dissipation is None else dissipation.terms
    if not any(part.energy_law == "nonincreasing" for part in parts):
        found = f"{type(parts[0]).__name__} makes none" if parts else "there is none"
        raise InputError(
            "baths take the heat of a dissipation that lowers the energy, such as lt.DoubleBracket or lt.Friction, and "
            f"{found}: leave out baths="
        )
    carried = tuple(_couple_term_to_baths(part, body, number, positive, pulled) for part in parts)
    return carried[0] if len(carried) == 1 else DissipationSum(carried)


def _couple_term_to_baths(
    part: Dissipation, body: Geometry, number: int, positive: bool, pulled: Callable[[Energy], Energy]
) -> Dissipation:
    functions = tuple(map(pulled, part.preserve))
    if part.energy_law != "nonincreasing":
        return HeatlessDissipation(part, functions)
    bath = Indices(0) if part.heated_bath_index is None else part.heated_bath_index
    numbers = np.asarray(bath)
    if numbers.shape not in ((), body.heating_sites):
        there = f", or of the shape {body.heating_sites} of the sites" if body.heating_sites else ""
        raise InputError(f"bath is the number of a bath{there}, not an array of shape {numbers.shape}")
    if not (numbers.min() >= 0 and numbers.max() < number):
        outside = int(numbers[(numbers < 0) | (numbers >= number)][0]) if numbers.shape else int(numbers)
        raise InputError(f"a dissipation heats bath {outside}, but there are {number}, which count from 0")
    return Heating(part, functions, bath, positive)
