"""The members of classes that users call: what ``help()`` and the reference show.

The reference shows the members of a class that :data:`CLASS_MEMBERS` names for it and for its base classes; ``help()``
lists those that :data:`HELP_MEMBERS` names, which a user calls first, so that it fits on two screens. A class that has
no entry, and no base class with one, shows every public member. An enumeration shows its members.
"""

from __future__ import annotations

from abc import ABCMeta
from enum import EnumType

CLASS_MEMBERS: dict[str, tuple[str, ...]] = {}
"""Members that users call, by the name of the class that defines or first needs them."""

HELP_MEMBERS: dict[str, tuple[str, ...]] = {}
"""Members that ``help()`` of a class lists."""


def declare_class_members(members: dict[str, str]) -> None:
    """Declare the members of each class that users call, as a text of names; ``help()`` lists those before a slash."""
    for owner, names in members.items():
        HELP_MEMBERS[owner] = tuple(names.partition("/")[0].split())
        CLASS_MEMBERS[owner] = tuple(names.replace("/", " ").split())


declare_class_members(
    {
        "Space": """
            point random belongs project inner exp log distance
            / residual random_tangent project_tangent norm flat sharp squared_distance midpoint transport frame
            coordinates from_coordinates to_vector from_vector
            """,
        "Flag": "projectors",
        "Grassmann": "subspace",
        "GroupSpace": "/ velocity from_velocity",
        "LevelSet": "/ geodesic",
        "Product": "split join",
        "TangentBundle": "tangential_part",
        "PoissonStructure": "tensor sharp bracket hamiltonian_vector_field jacobi_residual rank",
        "DensityMatrices": "matrix vector",
        "ExtendedPhaseSpace": "state_indices particle_indices",
        "Spins": "spins",
        "ContactStructure": """
            form flat sharp reeb jacobi_bracket evolution_vector_field hamiltonian_vector_field
            / differential volume horizontal bivector cartan_bracket
            """,
        "SplitContact": "/ liouville cosymplectic_bracket liouville_bracket",
        "LagrangianContact": "momentum rates legendre hessian energy",
        "LieAlgebra": """
            from_brackets bracket ad ad_star hat vee casimirs
            / killing_form is_semisimple from_structure_constants from_matrices casimir_count killing_signature
            killing_inner_product cartan_involution is_abelian is_solvable is_nilpotent is_unimodular is_compact_type
            derived_series lower_central_series isomorphism_type change_of_basis with_basis_names with_invariants
            poisson_tensor
            """,
        "StructureMethods": """
            / centre derived_ideals lower_central_ideals derivations radical nilradical levi_decomposition index
            orbit_dimension
            """,
        "DirectSum": "split",
        "MagneticExtension": "halves",
        "MatrixAlgebra": "dual_matrix from_dual_matrix",
        "MatrixGroup": """
            from_equations compose identity exp log Ad / inverse Ad_star belongs random cayley inverse_cayley
            """,
    }
)


def names_listed_by_help(cls: type) -> list[str]:
    """Return the names of the members that ``help()`` of a class lists, in alphabetical order."""
    names, has_entry = dict[str, None](), False
    for base in cls.__mro__:
        package = base.__module__.partition(".")[0]
        if package in LIBRARY_PACKAGES and base.__qualname__ in CLASS_MEMBERS:
            has_entry = True
            names |= dict.fromkeys(HELP_MEMBERS[base.__qualname__])
        elif package not in (*LIBRARY_PACKAGES, "equinox", "builtins", "collections"):
            names |= dict.fromkeys(name for name in vars(base) if not name.startswith("_"))
    if not has_entry:
        return sorted(name for name in type.__dir__(cls) if not name.startswith("_"))
    return sorted(name for name in names if hasattr(cls, name))


LIBRARY_PACKAGES = {"manifolds"}
"""Packages whose classes show the members that :data:`CLASS_MEMBERS` names."""


class ListedType(type):
    """Type of classes of which ``dir``, and so ``help``, lists the members that users call.

    The ``dir`` of an instance is complete.
    """

    def __dir__(cls) -> list[str]:
        return names_listed_by_help(cls)


class ListedABCMeta(ListedType, ABCMeta):
    """Type of abstract base classes whose ``dir`` lists the members that users call."""


class ListedEnumType(EnumType):
    """Type of enumerations whose ``dir`` lists their members, without the methods of str or int."""

    def __dir__(cls) -> list[str]:
        return list(cls.__members__)
