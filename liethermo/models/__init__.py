"""Ready-made systems, each with its source and reference data.

A function ``model_solution`` in the module of a model returns the exact solution.
"""

from __future__ import annotations

from manifolds._names import public_dir

from .body_with_wheels import body_with_wheels
from .cylinder import cylinder
from .gas_piston import gas_piston
from .heat_grid import heat_grid
from .magnetic_fluid import magnetic_fluid
from .mass_spring_gas import mass_spring_gas
from .micromagnet import micromagnet
from .open_gases import IdealMixture, porous_piston, reaction_vessel
from .oscillator import damped_oscillator
from .quantised_sphere import QuantisedSphere
from .rigid_body import free_rigid_body, rigid_body
from .rotors import damper_wheel, dual_spin, reaction_wheels, ring_damper
from .sorting_flow import hermitian_matrix, hermitian_state, sorting_flow, toda_flow
from .spins import single_spin, spin_lattice
from .thermo_particles import moving_thermo_particles, thermo_particles, thermo_springs
from .thermoelastic_chain import thermoelastic_chain
from .tumbling_body import tumbling_body
from .zeitlin import zeitlin

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
__dir__ = public_dir(__all__)
