"""The members of systems, dissipations, methods and results that users call: see :mod:`manifolds._class_members`."""

from __future__ import annotations

from manifolds._class_members import CLASS_MEMBERS, LIBRARY_PACKAGES

LIBRARY_PACKAGES.add("liethermo")
CLASS_MEMBERS.update(
    (name, tuple(members.split()))
    for name, members in {
        # Systems
        "System": "state vector_field entropy_production temperatures casimirs first_integrals check",
        "LiePoissonSystem": "momentum_of_velocity",
        "EulerPoincareSystem": "velocity momentum",
        "SimpleClosedSystem": "legendre momentum mechanical_energy",
        "LedgerSystem": "temperature friction_force external_force heating",
        "EulerPoincareClosedSystem": "momentum momenta",
        "VelocityContactSystem": "legendre",
        "Herglotz": "hamiltonian_system",
        "ThermodynamicHerglotz": "hamiltonian_system",
        "EvolutionSystem": "temperature",
        "ComposedSystem": "split entropies numbers_of_particles chemical_potentials",
        "SpinSystem": "spins largest_step",
        "QuantumSystem": """
            density reduced expectation bloch steady_state heat_currents power adiabatic_parameter coupled
            """,
        "TreeSystem": "mass_matrix joint_rates",
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
        "VariationalIntegrator": "verlet midpoint symmetrised discrete_system curve energies",
        "LieVariational": "attitudes",
        # Results
        "Solution": "audit energy_balance save to_xarray from_file",
        "AuditableResult": "joints velocities",
        "Ensemble": "ok audit save to_xarray from_file event_time message member_solution member_status member_stats",
        "Fluctuations": "of check increments",
    }.items()
)
