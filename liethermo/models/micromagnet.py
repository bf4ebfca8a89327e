"""A ferromagnet on rectangular cells, in SI units."""

from __future__ import annotations

import numpy as np

from ..dissipation.landau_lifshitz import LandauLifshitz
from ..functions.conditions import checked_numbers
from ..functions.energy import Energy
from ..functions.magnetism import (
    anisotropy,
    continuum_antisymmetric_exchange,
    continuum_exchange,
    demagnetisation,
    mesh,
    units,
    zeeman,
)
from ..functions.magnetism.units import ELECTRON_G_FACTOR
from ..systems import HeatBaths, SpinSystem


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
    size : float, or tuple of three floats
        Edges of a cell (m).
    saturation : float
        Saturation magnetisation (A / m).
    stiffness : float
        Exchange stiffness A (J / m).
    alpha : float >= 0
        Gilbert's damping constant.
    anisotropy_constant : float
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
    if np.any(anisotropy_constant):
        terms.append(anisotropy(box, anisotropy_constant * box.cell_volume, axis))
    if callable(field) or np.any(field):
        terms.append(zeeman(box, field, moment))
    if np.any(dmi):
        terms.append(continuum_antisymmetric_exchange(box, dmi, dmi_kind))
    if demagnetising:
        terms.append(demagnetisation(box, M))
    motion = units("SI").gilbert(alpha, moment, g)
    return SpinSystem(box, terms, LandauLifshitz(motion.rate), baths, ratio=motion.ratio)
