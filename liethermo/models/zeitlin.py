"""Ideal fluids on the sphere, with as many Casimirs as their matrices have eigenvalues [Zeitlin 1991, 2004]."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..dissipation.base import Dissipation
from ..dissipation.checks import checked_rate
from ..dissipation.double_bracket import DoubleBracket
from ..dissipation.inner_product import KillingDissipation
from ..errors import InputError
from ..functions.energy import Energy, Quadratic
from ..systems import LiePoissonSystem
from .quantised_sphere import QuantisedSphere


class KineticEnergy(Energy):
    """The kinetic energy of a fluid on the sphere times gamma, ``gamma / 2 tr(W^H (-Delta)^{-1} W)``."""

    sphere: QuantisedSphere = eqx.field(static=True)

    is_quadratic = True

    def gradient(self, x) -> jax.Array:
        psi = self.sphere.inverse_laplacian(x)
        return -self.sphere.gamma * self.sphere.algebra.matrix_basis.raise_index(psi)

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.dot(x, self.gradient(x))


def zeitlin(N: int, decay: Literal["enstrophy", "energy"] | None = None, rate=0.0) -> LiePoissonSystem:
    """A two-dimensional ideal fluid on the unit sphere, its vorticity an N by N matrix: the dual of su(N).

    ``W' = gamma [P, W]``, ``Delta P = W``, is ``omega' = -{psi, omega}``, ``Delta psi = omega``, for functions of
    degree below N, in the time of the fluid. Coordinates, harmonics and pictures are those of
    :class:`liethermo.models.QuantisedSphere`. All ``tr W^k`` are conserved, as all integrals of powers of vorticity
    are. The entropy is minus the enstrophy ``integral omega^2 / 2 = tr(W^H W) / 2``, a Casimir. Decay is one of two
    mirror images:

    "enstrophy"
        ``W' = gamma [P, W] + rate gamma^2 [P, [P, W]]``: the energy is constant and the enstrophy falls, by
        ``rate tr|gamma [P, W]|^2``, until ``[P, W] = 0``, where vorticity is a function of the stream function. This is
        the selective decay of Gay-Balmaz and Holm [2013], and :class:`KillingDissipation` here.
    "energy"
        ``W' = gamma [P, W] + rate gamma^2 [W, [P, W]]``: every Casimir is constant and the energy falls, towards the
        same states [Vallis, Carnevale & Young 1989]; :class:`DoubleBracket` here.

    A step of an explicit method takes O(N^3) operations in products of matrices, and O(N^2) memory.

    Parameters
    ----------
    N : int, >= 2
    decay : {"enstrophy", "energy"}, optional
        The function that decays; by default none.
    rate : float, >= 0
        Rate of the decay, in units of time for "enstrophy" and 1 / time for "energy".

    Returns
    -------
    LiePoissonSystem
        Its energy is gamma times that of the fluid, so that its time is that of the fluid.

    Raises
    ------
    InputError
    manifolds.SizeError
        If N is so large that a step would not fit into memory.

    Examples
    --------
    >>> fluid = lt.models.zeitlin(8, decay="enstrophy", rate=0.1)
    >>> fluid.dim
    63
    """
    sphere, rate = QuantisedSphere(N), checked_rate(rate)
    if decay not in (None, "enstrophy", "energy"):
        raise InputError(f"decay must be 'enstrophy', 'energy' or None, got {decay!r}")
    dissipation: Dissipation | None = None
    if decay == "enstrophy":  # -kappa is N on components, 2N on matrices
        dissipation = KillingDissipation(rate / (2.0 * sphere.N))
    elif decay == "energy":  # a motion's components of mu are half of those of its matrix
        dissipation = DoubleBracket(2.0 * sphere.gamma * rate)
    return LiePoissonSystem(
        sphere.algebra,
        KineticEnergy(sphere),
        Quadratic(np.full(sphere.algebra.dim, -2.0)),
        dissipation,
        validate=False,  # the axioms hold by construction, and testing Jacobi would take O(N^6)
    )
