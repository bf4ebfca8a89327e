"""Energies of spins, lattices, and the quantities that are measured in magnets."""

from manifolds._arguments import module_dir_function

from .bond_terms import biquadratic, exchange_tensor
from .correlations import StructureFactor, dynamic_structure_factor, structure_factor, topological_charge
from .dipoles import dipoles
from .grid_terms import dzyaloshinskii_moriya, exchange
from .lattices import Bonds, Lattice, lattice
from .micromagnetics import (
    continuum_antisymmetric_exchange,
    continuum_exchange,
    demagnetisation,
    demagnetising_factors,
    mesh,
)
from .ovf import VectorField, read_ovf, write_ovf
from .relaxation import HysteresisLoop, Minimum, hysteresis_loop, minimise
from .site_terms import (
    anisotropy,
    cubic_anisotropy,
    polynomial_anisotropy,
    stevens_anisotropy,
    uniaxial_anisotropy,
    zeeman,
)
from .spin_torques import LaserPulse, Slonczewski, SpinOrbit, ZhangLi
from .spin_waves import spin_temperature, spin_wave_frequencies
from .transitions import Estimate, MagnetSamples, binder_cumulant, cumulant_crossing
from .units import SpinDynamics, Units, units

__all__ = [
    "Bonds",
    "Estimate",
    "HysteresisLoop",
    "LaserPulse",
    "Lattice",
    "MagnetSamples",
    "Minimum",
    "Slonczewski",
    "SpinDynamics",
    "SpinOrbit",
    "StructureFactor",
    "Units",
    "VectorField",
    "ZhangLi",
    "anisotropy",
    "binder_cumulant",
    "biquadratic",
    "continuum_antisymmetric_exchange",
    "continuum_exchange",
    "cubic_anisotropy",
    "cumulant_crossing",
    "demagnetisation",
    "demagnetising_factors",
    "dipoles",
    "dynamic_structure_factor",
    "dzyaloshinskii_moriya",
    "exchange",
    "exchange_tensor",
    "hysteresis_loop",
    "lattice",
    "mesh",
    "minimise",
    "polynomial_anisotropy",
    "read_ovf",
    "spin_temperature",
    "spin_wave_frequencies",
    "stevens_anisotropy",
    "structure_factor",
    "topological_charge",
    "uniaxial_anisotropy",
    "units",
    "write_ovf",
    "zeeman",
]
__dir__ = module_dir_function(__all__)
