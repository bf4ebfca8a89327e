"""Ready-made systems, each with its source and reference data.

A function ``model_solution`` in the module of a model returns the exact solution.
"""

from __future__ import annotations

from manifolds._arguments import module_dir_function

from .body_with_wheels import body_with_wheels
from .gases import IdealMixture, cylinder, gas_piston, mass_spring_gas, porous_piston, reaction_vessel
from .quantised_sphere import QuantisedSphere, magnetic_fluid, zeitlin
from .rigid_body import free_rigid_body, rigid_body, tumbling_body
from .rotors import damper_wheel, dual_spin, reaction_wheels, ring_damper
from .sorting_flow import hermitian_matrix, hermitian_state, sorting_flow, toda_flow
from .spins import micromagnet, single_spin, spin_lattice
from .springs import damped_oscillator, thermoelastic_chain
from .thermo_particles import heat_grid, moving_thermo_particles, thermo_particles, thermo_springs

__all__ = [
    "IdealMixture",
    "QuantisedSphere",
    "body_with_wheels",
    "cylinder",
    "damped_oscillator",
    "damper_wheel",
    "dual_spin",
    "free_rigid_body",
    "gas_piston",
    "heat_grid",
    "hermitian_matrix",
    "hermitian_state",
    "magnetic_fluid",
    "mass_spring_gas",
    "micromagnet",
    "moving_thermo_particles",
    "porous_piston",
    "reaction_vessel",
    "reaction_wheels",
    "rigid_body",
    "ring_damper",
    "single_spin",
    "sorting_flow",
    "spin_lattice",
    "thermo_particles",
    "thermo_springs",
    "thermoelastic_chain",
    "toda_flow",
    "tumbling_body",
    "zeitlin",
]
__dir__ = module_dir_function(__all__)
