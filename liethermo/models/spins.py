"""A single spin in a field, lattices of spins, and a ferromagnet on rectangular cells."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced

from ..dissipation.landau_lifshitz import LandauLifshitz
from ..errors import InputError
from ..functions.conditions import checked_numbers
from ..functions.energy import Energy, Sum
from ..functions.magnetism import (
    anisotropy,
    continuum_antisymmetric_exchange,
    continuum_exchange,
    demagnetisation,
    dzyaloshinskii_moriya,
    exchange,
    mesh,
    units,
    zeeman,
)
from ..functions.magnetism.spin_energy import lattice_shape
from ..functions.magnetism.units import ELECTRON_G_FACTOR
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
        Shape of the lattice.
    exchange_constant : float, array or graph
        J: see :func:`liethermo.magnetism.exchange`; a symmetric matrix or a list of edges puts the spins on a graph.
    anisotropy_constant : float, or array of the shape of the sites
        Energy of the easy axis of a spin.
    field : array, shape (3,) or ``(*sites, 3)``
        The external field.
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
        Periodic boundaries, of all axes or of each.
    axis : array, shape (3,) or ``(*sites, 3)``
        Axis of the anisotropy.
    """
    shape = lattice_shape(sites)
    terms: list[Energy] = [*exchange(shape, exchange_constant, periodic=periodic).terms]
    K = checked_numbers(anisotropy_constant, "an anisotropy constant")
    if _may_be_nonzero(K):
        terms.append(anisotropy(shape, K, axis))
    field = checked_numbers(field, "a field")
    if _may_be_nonzero(field):
        terms.append(zeeman(shape, field))
    if dmi is not None:
        terms += dzyaloshinskii_moriya(shape, dmi, periodic=periodic).terms
    if not isinstance(baths, HeatBaths | bool):
        raise InputError(
            "baths must be lt.HeatBaths, True (one bath whose heat capacity is the number of sites) or False, "
            f"got {baths!r}"
        )
    lattice_baths = HeatBaths(capacity=float(np.prod(shape))) if baths is True else baths or None
    return SpinSystem(shape, Sum(tuple(terms)), LandauLifshitz(rate, bath), lattice_baths)


def _may_be_nonzero(value) -> bool:
    """Return whether an array has an entry that is not zero; True for a traced array, whose entries are not known."""
    return is_traced(value) or bool(np.any(value))


def _third_axis_vector(field):
    return jnp.stack([jnp.zeros(()), jnp.zeros(()), checked_numbers(field, "the field", ())])


def micromagnet(
    cells=(40, 10, 1),
    size=(5e-9, 5e-9, 3e-9),
    saturation=8e5,
    stiffness=1.3e-11,
    alpha=0.02,
    anisotropy_constant=0.0,
    axis=(0.0, 0.0, 1.0),
    field=(0.0, 0.0, 0.0),
    dmi=0.0,
    dmi_kind: str = "interfacial",
    demagnetising: bool = True,
    baths: HeatBaths | None = None,
    periodic=False,
    g: float = ELECTRON_G_FACTOR,
) -> SpinSystem:
    """A ferromagnet on rectangular cells with exchange, anisotropy, fields, and Gilbert's damping, in SI units.

    Spins are the directions of the magnetisation. Times are in seconds, energies in joule. The defaults are permalloy,
    as in µMAG's standard problem 4.

    Parameters
    ----------
    cells : tuple of three int
        Numbers of cells along the three axes.
    size : float, or tuple of three floats
        Edges of a cell (m).
    saturation : float
        Saturation magnetisation (A / m).
    stiffness : float
        Exchange stiffness A (J / m).
    alpha : float >= 0
        Gilbert's damping constant.
    anisotropy_constant : float, or array of the shape of the cells
        Uniaxial constant K (J / m³).
    axis : array, shape (3,)
        Axis of the anisotropy, a unit vector.
    field : array, shape (3,) or ``(*cells, 3)``; or function of the time (s)
        B (T).
    dmi : float
        Dzyaloshinskii-Moriya constant (J / m²).
    dmi_kind : str
        "interfacial" or "bulk".
    demagnetising : bool
        Include the demagnetising field.
    baths : HeatBaths, optional
        Baths (temperatures ``k T`` in joule) that absorb the heat; without them the energy falls.
    periodic : bool or tuple of bool
        Whether the mesh is periodic; the demagnetising field needs open borders.
    g : float
        Factor of the gyromagnetic ratio.

    Returns
    -------
    SpinSystem

    Examples
    --------
    >>> film = lt.models.micromagnet((8, 4, 1))
    >>> up = np.tile([1.0, 0.0, 0.0], (8, 4, 1, 1))
    >>> run = lt.integrate(
    ...     film, film.state(up), (0.0, 1e-11), 2.5e-13, lt.MetriplecticRungeKutta(4)
    ... )
    >>> bool(run.energy[-1] < run.energy[0])
    True
    """
    box = mesh(cells, size, periodic)
    M = checked_numbers(saturation, "the saturation magnetisation", ())
    moment = M * box.cell_volume
    terms: list[Energy] = [continuum_exchange(box, stiffness)]
    K = checked_numbers(anisotropy_constant, "an anisotropy constant")
    if _may_be_nonzero(K):
        terms.append(anisotropy(box, K * box.cell_volume, axis))
    if not callable(field):
        field = checked_numbers(field, "a field")
    if callable(field) or _may_be_nonzero(field):
        terms.append(zeeman(box, field, moment))
    D = checked_numbers(dmi, "a Dzyaloshinskii-Moriya constant", ())
    if _may_be_nonzero(D):
        terms.append(continuum_antisymmetric_exchange(box, D, dmi_kind))
    if demagnetising:
        terms.append(demagnetisation(box, M))
    motion = units("SI").gilbert(alpha, moment, g)
    return SpinSystem(box, terms, LandauLifshitz(motion.rate), baths, ratio=motion.ratio)
