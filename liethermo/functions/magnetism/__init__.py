"""Energies of spins, lattices, and the quantities that are measured in magnets."""

from manifolds._names import public_dir

from .bond_terms import biquadratic, exchange_tensor
from .dipoles import dipoles
from .grid_terms import dzyaloshinskii_moriya, exchange
from .lattices import Bonds, Lattice, lattice
from .site_terms import (
    anisotropy,
    cubic_anisotropy,
    polynomial_anisotropy,
    stevens_anisotropy,
    uniaxial_anisotropy,
    zeeman,
)

__all__ = [
    "Bonds",
    "Lattice",
    "anisotropy",
    "biquadratic",
    "cubic_anisotropy",
    "dipoles",
    "dzyaloshinskii_moriya",
    "exchange",
    "exchange_tensor",
    "lattice",
    "polynomial_anisotropy",
    "stevens_anisotropy",
    "uniaxial_anisotropy",
    "zeeman",
]
__dir__ = public_dir(__all__)
