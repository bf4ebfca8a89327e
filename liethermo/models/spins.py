"""A single spin in a field, and lattices of spins."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..dissipation.landau_lifshitz import LandauLifshitz
from ..errors import InputError
from ..functions.conditions import checked_numbers
from ..functions.energy import Energy, Sum
from ..functions.magnetism import anisotropy, dzyaloshinskii_moriya, exchange, zeeman
from ..functions.magnetism.spin_energy import lattice_shape
from ..systems import HeatBaths, SpinSystem


def single_spin(field=1.0, rate=0.1, baths: HeatBaths | None = None) -> SpinSystem:
    """A spin in a field B along the third axis, ``H = -B s_3``; damping turns it towards the field.

    With |s| = 1 the motion is known: ``s_3 = tanh(rate B t + artanh s_3(0))``, and the rest turns by the angle ``B t``
    [Landau & Lifshitz 1935]. Switching from one polar angle to another takes the time ``log(s' / s) / (rate B)``, s the
    tangents of the half angles.

    Parameters
    ----------
    field : float
        B.
    rate : float, >= 0
        Rate of :class:`liethermo.LandauLifshitz`.
    baths : HeatBaths, optional
        Baths that absorb the heat; without them the energy falls.
    """
    return SpinSystem(1, zeeman(1, _third_axis_vector(field)), LandauLifshitz(rate), baths)


def spin_lattice(
    sites=(32, 32),
    exchange_constant=1.0,
    anisotropy_constant=0.0,
    field=(0.0, 0.0, 0.0),
    dmi=None,
    rate=0.1,
    baths: HeatBaths | bool = True,
    bath=None,
    periodic=True,
    axis=(0.0, 0.0, 1.0),
) -> SpinSystem:
    """Damped spins on a lattice, or on a graph, with exchange, anisotropy, a field and antisymmetric exchange.

    ``H = -sum J s_i . s_j - sum K (n . s_i)^2 - sum B . s_i + sum D . (s_i x s_j)``, the terms of ``lt.magnetism``.
    A state has the spins site by site, and behind them the entropy of each bath; ``system.state(spins)`` takes spins of
    shape ``(*sites, 3)`` alone.

    Parameters
    ----------
    sites : int or tuple of int
    exchange_constant : float, array or graph
        J: see :func:`liethermo.magnetism.exchange`; a symmetric matrix or a list of edges puts the spins on a graph.
    anisotropy_constant : float, or array of the shape of the sites
    field : array, shape (3,) or ``(*sites, 3)``
    dmi : array, list of edges, or None
        D: see :func:`liethermo.magnetism.dzyaloshinskii_moriya`.
    rate : float >= 0, or array of the shape of the sites
        Rate of :class:`liethermo.LandauLifshitz`.
    baths : HeatBaths or bool
        True: one bath with a heat capacity equal to the number of sites and an initial temperature of 1. False: no
        bath, so the energy falls.
    bath : array of int, of the shape of the sites, optional
        Index of the bath that each site heats.
    periodic : bool or tuple of bool
    axis : array, shape (3,) or ``(*sites, 3)``
        Axis of the anisotropy.
    """
    shape = lattice_shape(sites)
    terms: list[Energy] = [*exchange(shape, exchange_constant, periodic=periodic).terms]
    if np.any(anisotropy_constant):
        terms.append(anisotropy(shape, anisotropy_constant, axis))
    if np.any(field):
        terms.append(zeeman(shape, field))
    if dmi is not None:
        terms += dzyaloshinskii_moriya(shape, dmi, periodic=periodic).terms
    if not isinstance(baths, HeatBaths | bool):
        raise InputError(f"baths must be lt.HeatBaths, True for one as large as the lattice, or False, got {baths!r}")
    lattice_baths = HeatBaths(capacity=float(np.prod(shape))) if baths is True else baths or None
    return SpinSystem(shape, Sum(tuple(terms)), LandauLifshitz(rate, bath), lattice_baths)


def _third_axis_vector(field):
    return jnp.stack([jnp.zeros(()), jnp.zeros(()), checked_numbers(field, "the field", ())])
