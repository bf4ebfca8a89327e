"""What the reference shows of each class: the members that users call.

The page of a class shows the members that :data:`SHOWN` names for it and for its base classes, its own first. A class
that has no entry, and no base class with one, shows every documented public member: such a class has few. What all
spaces, algebras or structures have is described once, on the page of their base class, to which the others link. The
page ``api_authors`` describes what authors of methods, dissipations and kinds of systems override.
"""

from __future__ import annotations

import functools
import inspect
from types import ModuleType
from typing import Any

LIBRARY = ("liethermo", "manifolds")
MAX_MEMBERS_WITHOUT_ENTRY = 12
"""Members that the page of a class without an entry may show; a class with more needs an entry."""

NAMED_TUPLE_FIELD = "Alias for field number"
"""What Python documents the fields of named tuples with; the docstring of the class describes them."""

SHOWN: dict[str, tuple[str, ...]] = {
    name: tuple(members.split())
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
        "LindbladJumps": "from_collapse_operators current rates_at",
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
        "Ensemble": "ok audit save to_xarray from_file event_time message member_solution member_status member_stats",
        "Fluctuations": "of check increments",
        # Geometry
        "Space": """
            point random belongs project residual random_tangent project_tangent inner norm flat sharp exp log distance
            squared_distance midpoint transport frame coordinates from_coordinates to_vector from_vector
            """,
        "Flag": "projectors",
        "Grassmann": "subspace",
        "GroupSpace": "velocity from_velocity",
        "LevelSet": "geodesic",
        "Product": "split join",
        "TangentBundle": "tangential_part",
        "PoissonStructure": "tensor sharp bracket hamiltonian_vector_field jacobi_residual rank",
        "DensityMatrices": "matrix vector",
        "ExtendedPhaseSpace": "state_indices particle_indices",
        "Spins": "spins",
        "ContactStructure": """
            form differential volume flat sharp reeb horizontal bivector cartan_bracket jacobi_bracket
            evolution_vector_field hamiltonian_vector_field
            """,
        "SplitContact": "liouville cosymplectic_bracket liouville_bracket",
        "LagrangianContact": "momentum rates legendre hessian energy",
        "LieAlgebra": """
            from_brackets from_structure_constants from_matrices bracket ad ad_star hat vee casimirs casimir_count
            killing_form killing_signature killing_inner_product cartan_involution is_abelian is_semisimple is_solvable
            is_nilpotent is_unimodular is_compact_type derived_series lower_central_series isomorphism_type
            change_of_basis with_basis_names with_invariants poisson_tensor
            """,
        "StructureMethods": """
            centre derived_ideals lower_central_ideals derivations radical nilradical levi_decomposition index
            orbit_dimension
            """,
        "DirectSum": "split",
        "MagneticExtension": "halves",
        "MatrixAlgebra": "dual_matrix from_dual_matrix",
        "MatrixGroup": """
            from_equations compose inverse identity belongs random exp log cayley inverse_cayley Ad Ad_star
            """,
    }.items()
}
"""Members that users call, by the name of the class that defines or first needs them."""


def is_value(owner: type, name: str) -> bool:
    """Return True for an attribute that is a mere value, of which autodoc would print the documentation of its type."""
    value = inspect.getattr_static(owner, name)
    described = callable(value) or isinstance(value, (property, classmethod, staticmethod)) or hasattr(value, "__get__")
    return not described


def is_documented(owner: type, name: str) -> bool:
    """Return True if the member is a function or a property with a docstring of its own or of a base class."""
    doc = "" if is_value(owner, name) else inspect.getdoc(getattr(owner, name)) or ""
    return bool(doc) and not doc.startswith(NAMED_TUPLE_FIELD)


def public_members(owner: type) -> list[str]:
    """Return the documented public members that the library itself defines, in the order of the source."""
    names = [
        name
        for base in owner.__mro__
        if base.__module__.partition(".")[0] in LIBRARY
        for name in vars(base)
        if not name.startswith("_")
    ]
    return [name for name in dict.fromkeys(names) if is_documented(owner, name)]


def shown_members(owner: type) -> list[str]:
    """Return the members that the page of a class describes, its own first."""
    if not has_entry(owner):
        return public_members(owner)
    common = _common_base(owner)
    elsewhere = common.__mro__ if common else ()
    return _entry_members(owner, [base for base in owner.__mro__ if base not in elsewhere])


def common_members(owner: type) -> tuple[str, list[str]]:
    """Return the full name of the base class that describes the other members, and their names; "" without one."""
    common = _common_base(owner)
    if common is None:
        return "", []
    own = shown_members(owner)
    return f"manifolds.{common.__name__}", [name for name in shown_members(common) if name not in own]


def has_entry(owner: type) -> bool:
    """Return True if the class, or one of its base classes, has an entry."""
    return any(_has_entry(base) for base in owner.__mro__)


def _has_entry(base: type) -> bool:
    return base.__module__.partition(".")[0] in LIBRARY and base.__qualname__ in SHOWN


def _entry_members(owner: type, bases: list[type]) -> list[str]:
    entries = [SHOWN[base.__qualname__] for base in bases if _has_entry(base)]
    names = dict.fromkeys(name for entry in entries for name in entry)
    return [name for name in names if is_documented(owner, name)]


def _common_base(owner: type) -> type | None:
    """Return the base class of the geometry whose page describes what all of its kind have; None without one."""
    import manifolds

    bases = (manifolds.LieAlgebra, manifolds.Space, manifolds.PoissonStructure, manifolds.ContactStructure)
    return next((base for base in bases if issubclass(owner, base) and owner is not base), None)


@functools.cache
def public_classes() -> dict[str, type]:
    """Return the public classes of both packages, and of their public modules, by their full names."""
    import liethermo
    import manifolds

    found: dict[str, type] = {}

    def collect(prefix: str, module: ModuleType, names: tuple[str, ...]) -> None:
        for name in names:
            value: Any = getattr(module, name)
            if inspect.isclass(value):
                found[f"{prefix}.{name}"] = value
            elif inspect.ismodule(value):
                collect(f"{prefix}.{name}", value, tuple(value.__all__))

    for package in (liethermo, manifolds):
        collect(package.__name__, package, tuple(package.__all__))
    return found


def pages() -> dict[str, dict[str, Any]]:
    """Return what the template of class pages needs, by the full name of the class."""
    result: dict[str, dict[str, Any]] = {}
    for name, owner in public_classes().items():
        base, common = common_members(owner)
        result[name] = {"shown": shown_members(owner), "base": base, "common": common}
    return result
