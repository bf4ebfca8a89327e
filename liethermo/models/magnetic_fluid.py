"""Ideal magnetohydrodynamics on the sphere, with the Casimirs of its matrices [Modin & Roop 2025]."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation.base import Dissipation
from ..dissipation.checks import checked_rate
from ..dissipation.double_bracket import DoubleBracket
from ..functions.energy import Energy
from ..systems import LiePoissonSystem
from .quantised_sphere import QuantisedSphere


class MagneticEnergy(Energy):
    """Gamma times the energy of flow and magnetic field, ``gamma / 2 (tr W^H (-Delta)^{-1} W + tr B^H (-Delta) B)``."""

    sphere: QuantisedSphere = eqx.field(static=True)

    is_quadratic = True

    def gradient(self, x) -> jax.Array:
        sphere, n = self.sphere, self.sphere.algebra.dim
        tables = sphere.algebra.matrix_basis
        velocity = tables.raise_index(sphere.inverse_laplacian(x[:n]))
        current = sphere.laplacian(tables.lower_index(x[n:]))
        return -sphere.gamma * jnp.concatenate([velocity, current])

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.dot(x, self.gradient(x))


def magnetic_fluid(N: int, rate=0.0) -> LiePoissonSystem:
    """A conducting fluid on the unit sphere, its vorticity W and magnetic potential B N by N matrices.

    ``W' = gamma ([P, W] + [J, B])``, ``B' = gamma [P, B]`` with ``Delta P = W``, ``J = Delta B`` is
    ``omega' = -{psi, omega} + {theta, Delta theta}``, ``theta' = -{psi, theta}`` for functions of degree below N: the
    potential theta is carried by the flow, and its field acts on the flow by the force of Lorentz. The system is that
    of :func:`manifolds.magnetic_extension` of su(N), a state the components of W in the dual of su(N) and those of B
    in su(N). Conserved are the energy, all ``tr B^k`` and all ``tr W B^k``: the integrals of functions of theta, and
    of vorticity times these. The first of the latter is the cross helicity.

    With a rate the motion ``(F, G) = (W', B')`` has the friction ``rate gamma ([W, F] + [B, G])`` in W and
    ``rate gamma [B, F]`` in B, a double bracket: the energy decays, and all these Casimirs are kept, so the flow tends
    to an equilibrium of less energy with the same integrals of theta.

    Parameters
    ----------
    N : int, >= 2
    rate : float, >= 0
        Rate of the decay (1 / time).

    Returns
    -------
    LiePoissonSystem
        Its energy is gamma times that of the fluid, so that its time is that of the fluid. States are made by
        :meth:`QuantisedSphere.magnetic_state`, and taken apart by :meth:`QuantisedSphere.magnetic_fields`.

    Raises
    ------
    InputError
    manifolds.SizeError
    """
    sphere, rate = QuantisedSphere(N), checked_rate(rate)
    algebra = mf.magnetic_extension(sphere.algebra, by_brackets=True)
    # a concrete zero leaves the double bracket out
    is_undamped = not isinstance(rate, jax.core.Tracer) and not float(rate)
    # components of a motion of W are half of those of its matrix, and those of B have twice its dual ones
    metric = np.repeat([1.0, 0.25], sphere.algebra.dim)
    dissipation: Dissipation | None = None if is_undamped else DoubleBracket(2.0 * sphere.gamma * rate, metric)
    return LiePoissonSystem(algebra, MagneticEnergy(sphere), None, dissipation, validate=False)
