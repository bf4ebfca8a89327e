"""The members of systems, dissipations, methods and results that users call: see :mod:`manifolds._class_members`."""

from __future__ import annotations

from manifolds._class_members import LIBRARY_PACKAGES, declare_class_members

LIBRARY_PACKAGES.add("liethermo")
declare_class_members(
    {
        # Systems
        "System": "state vector_field entropy_production casimirs / temperatures first_integrals check",
        "LiePoissonSystem": "/ momentum_of_velocity",
        "EulerPoincareSystem": "velocity momentum",
        "SimpleClosedSystem": "/ legendre momentum mechanical_energy",
        "LedgerSystem": "temperature friction_force / external_force heating",
        "EulerPoincareClosedSystem": "momentum / momenta",
        "VelocityContactSystem": "legendre",
        "Herglotz": "hamiltonian_system",
        "ThermodynamicHerglotz": "hamiltonian_system",
        "EvolutionSystem": "temperature",
        "ComposedSystem": "split entropies / numbers_of_particles chemical_potentials",
        "SpinSystem": "spins largest_step",
        "QuantumSystem": """
            density expectation / heat_currents reduced steady_state bloch power adiabatic_parameter coupled
            """,
        "Tree": "add system names base / from_urdf from_mjcf",
        "TreeSystem": "/ mass_matrix joint_rates",
        "JointedBodies": "angular_velocity centre_of_mass base_position",
        # Dissipations
        "Dissipation": "energy_law entropy_law preserves_casimirs",
        "FourBracket": "kulkarni_nomizu",
        "HeatConduction": "edge_entropy_rates",
        "KillingDissipation": "inner_product",
        "LandauLifshitz": "gilbert",
        "LindbladJumps": "from_collapse_operators current rates_at operators_at",
        "SteepestEntropyAscent": "ascent_direction",
        "ThermalJumps": "replace_operators",
        # Functions
        "Energy": "value gradient depends_on_time at_time",
        "Kinetic": "at",
        "TimeDependent": "break_times",
        # Methods
        "OneStepMethod": "explicit evaluations_per_iteration check preserves_function",
        "VariationalIntegrator": "verlet midpoint symmetrised / discrete_system curve energies",
        "LieVariational": "attitudes",
        # Results
        "Training": "estimate confidence_interval with_estimates problems",
        "Solution": "audit energy_balance save / to_xarray from_file",
        "AuditableResult": "velocities / joints",
        "Ensemble": """
            ok audit save / message event_time to_xarray from_file member_solution member_status member_stats
            """,
        "Fluctuations": "of check increments",
    }
)
