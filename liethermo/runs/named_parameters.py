"""Parameters of a system by name: their values, and systems with other values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import DictKey, GetAttrKey, SequenceKey

from manifolds._arrays import host_array, real_array

from ..engines.compiled.parameters import ProgramStructure, parameter_arrays
from ..errors import InputError
from ..functions.conditions import ParameterCondition, checked_host_numbers, checked_numbers, condition_of_field
from ..functions.energy import Quadratic
from ..models.inertia import INERTIA_CONDITION, inverse_moments
from ..systems import System
from ..tracing.caching import memoize

WRAPPER_FIELDS = frozenset({"body", "part", "term", "function", "phi", "contact", "first"})
"""Fields of the library's wrapper objects that hold a user's object; names of parameters leave them out."""

DERIVED_FIELDS = frozenset({"momentum_maps", "momentum_casimirs", "subsystems"})
"""Fields of a system that are computed from others; their arrays have no names, except those of a Lagrangian."""


class NamedParameter(NamedTuple):
    """The value of a parameter of a system, and the arrays of the system that store it.

    Attributes
    ----------
    value : ndarray
    leaf_indices : tuple of int
        Numbers of the arrays of the system that hold the parameter, in the order of :func:`parameter_arrays`.
    is_inverse : bool
        Whether these arrays hold the inverse: those of an energy with moments of inertia do.
    condition : ParameterCondition or None
        The condition of the constructor on the value.
    """

    value: np.ndarray
    leaf_indices: tuple[int, ...]
    is_inverse: bool = False
    condition: ParameterCondition | None = None

    def to_stored_array(self, value):
        """Return the array that the system stores for a value of the parameter, or for several along the first axis.

        Parameters
        ----------
        value : ndarray or tracer
        """
        if not self.is_inverse:
            return value
        if np.shape(self.value) == (3,):  # entry by entry, also of several sets of moments
            return inverse_moments(value)
        return jnp.linalg.inv(value)


def named_parameters(system: System) -> dict[str, np.ndarray]:
    """Return the parameters of a system by name, such as ``dissipation.rate``.

    The names are those of the user's objects, whether or not the system has baths, a clock or an attitude. A value that
    is stored in several places, such as the capacity of a bath, is one parameter. A rigid body has ``energy.inertia``.
    """
    return {name: parameter.value for name, parameter in _parameters_by_name_and_by_path(system)[0].items()}


def checked_parameters(parameters: Any) -> Mapping[str, Any]:
    """Return ``parameters`` if it maps names to values; raise InputError otherwise."""
    if not isinstance(parameters, Mapping):
        raise InputError(
            f"parameters of a system must be a dict from names to values, got {type(parameters).__name__}. For "
            "parameters of another form, give a function of them that builds the system"
        )
    return parameters


def replace_parameters(system: System, parameter_values: Mapping[str, Any]) -> System:
    """Return a copy of a system with new values, traced or not, of the named parameters.

    Raises
    ------
    InputError
        If the system has no parameter of this name, or a value has another shape or is refused by the constructor of
        its object, as a negative rate is.
    """
    # the system's own arrays, which cannot change in place, so that results for the new system can be cached
    leaves: list[Any] = jax.tree_util.tree_leaves(eqx.filter(system, eqx.is_inexact_array))
    names_by_leaf: dict[int, str] = {}
    for name, value in parameter_values.items():
        parameter = require_parameter(system, name)
        array = host_array(checked_numbers(value, name))
        if array.shape != parameter.value.shape:
            raise InputError(f"{name} must have shape {parameter.value.shape}, got {array.shape}")
        _claim_leaves(names_by_leaf, name, parameter)
        if parameter.condition is not None:
            parameter.condition.require(array)
        for i in parameter.leaf_indices:
            leaves[i] = real_array(parameter.to_stored_array(array))
    return ProgramStructure.from_module(system).rebuild(leaves)


def reasons_of_refused_members(system: System, member_values: Mapping[str, Any]) -> dict[int, str]:
    """Return the reasons why constructors refuse the parameter values of some members of a family, by member index.

    Members with NaN are left out: the family has a reason for them.

    Parameters
    ----------
    system : System
    member_values : mapping of str to array, shape (members, ...)
    """
    reasons: dict[int, str] = {}
    for name, value in member_values.items():
        condition = require_parameter(system, name).condition
        if condition is not None:
            reasons |= condition.violations(np.asarray(value, dtype=np.float64))
    return reasons


def _condition_at_path(system: System, path: Sequence[Any]) -> ParameterCondition | None:
    """Return the condition of the field of a system that holds the array at a path; None if the field has none."""
    ends = [i for i, key in enumerate(path) if isinstance(key, GetAttrKey)]
    return condition_of_field(_node_at(system, path[: ends[-1]]), path[ends[-1]].name) if ends else None


def _node_at(tree: Any, path: Sequence[Any]) -> Any:
    """Return the node of a pytree at a path of fields, indices and keys; None if the path has keys of another kind."""
    for key in path:
        if isinstance(key, GetAttrKey):
            tree = getattr(tree, key.name)
        elif isinstance(key, SequenceKey | DictKey):
            tree = tree[key.idx if isinstance(key, SequenceKey) else key.key]
        else:
            return None
    return tree


def stack_member_arrays(system: System, member_values: Mapping[str, Any]) -> list[np.ndarray]:
    """Return the arrays of a family of systems, with the members along the first axis, from values of some parameters.

    Parameters without ``member_values`` have the values of ``system`` and a first axis of length 1.

    Raises
    ------
    InputError
        If the system has no parameter of this name, or values have another shape.
    """
    leaves = [array[None] for array in parameter_arrays(system)]
    names_by_leaf: dict[int, str] = {}
    for name, value in member_values.items():
        parameter, array = require_parameter(system, name), checked_host_numbers(value, name)
        if array.ndim == 0 or array.shape[1:] != parameter.value.shape:
            expected_shape = ", ".join(["trajectories", *map(str, parameter.value.shape)])
            raise InputError(f"the values of {name} must have shape ({expected_shape}), got {array.shape}")
        _claim_leaves(names_by_leaf, name, parameter)
        for i in parameter.leaf_indices:
            leaves[i] = np.asarray(parameter.to_stored_array(array))
    return leaves


def require_parameter(system: System, name: str) -> NamedParameter:
    """Return the parameter with a name or path; raise InputError if the system has none.

    Raises
    ------
    InputError
        If there is no such parameter; the message lists the names.
    """
    parameter = find_parameter_or_none(system, name)
    if parameter is None:
        names = ", ".join(named_parameters(system))
        raise InputError(
            f"the system has no parameter {name!r}; its parameters are {names}. For others, give a function that "
            "builds the system"
        )
    return parameter


def find_parameter_or_none(system: System, name: str) -> NamedParameter | None:
    """Return the parameter with a name, or with the path of one of its arrays; None if the system has none."""
    parameters_by_name, parameters_by_path = _parameters_by_name_and_by_path(system)
    return parameters_by_name.get(name) or parameters_by_path.get(name)


def _claim_leaves(names_by_leaf: dict[int, str], name: str, parameter: NamedParameter) -> None:
    """Record the name under which the user gave a parameter; raise InputError if another name gave it before."""
    for i in parameter.leaf_indices:
        if i in names_by_leaf:
            raise InputError(f"{name} and {names_by_leaf[i]} are the same parameter. Give one of them")
        names_by_leaf[i] = name


@memoize
def _parameters_by_name_and_by_path(system: System) -> tuple[dict[str, NamedParameter], dict[str, NamedParameter]]:
    """Return two dicts of the parameters of a system: by name, and by the paths of their arrays."""
    paths_and_leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(system, eqx.is_inexact_array))
    fields = [[jax.tree_util.keystr((key,)).removeprefix(".") for key in path] for path, _ in paths_and_leaves]
    paths = [jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths_and_leaves]
    arrays, has_derived_energy = parameter_arrays(system), _is_energy_from_lagrangian(fields)
    conditions = [_condition_at_path(system, path) for path, _ in paths_and_leaves]
    leaves_by_name: dict[str, list[int]] = {}
    for i, path_fields in enumerate(fields):
        is_of_lagrangian = "lagrangian" in path_fields
        is_derived = path_fields[0] in DERIVED_FIELDS and not is_of_lagrangian
        if has_derived_energy:
            is_derived |= is_of_lagrangian or path_fields[0] == "energy"
        if arrays[i].size and not is_derived:
            leaves_by_name.setdefault(_public_name(path_fields), []).append(i)
    parameters_by_name: dict[str, NamedParameter] = {}
    for name, leaves in leaves_by_name.items():
        value = arrays[leaves[0]]
        if all(np.array_equal(arrays[i], value, equal_nan=True) for i in leaves):
            condition = next((conditions[i] for i in leaves if conditions[i] is not None), None)
            parameters_by_name[name] = NamedParameter(value, tuple(leaves), condition=condition)
        else:  # different parameters, whose paths differ in the fields of wrappers only
            parameters_by_name |= {paths[i]: NamedParameter(arrays[i], (i,), condition=conditions[i]) for i in leaves}
    parameters_by_path = {
        paths[i]: parameter for parameter in parameters_by_name.values() for i in parameter.leaf_indices
    }
    return _replace_energy_matrix_by_inertia(system, parameters_by_name, parameters_by_path), parameters_by_path


def _is_energy_from_lagrangian(field_paths: list[list[str]]) -> bool:
    """Return whether the energy was computed from the Lagrangian of a system, so that neither can be set alone."""
    has_lagrangian = any(path[0] == "lagrangian" for path in field_paths)
    return has_lagrangian and not any(path[0] == "energy" and "lagrangian" in path for path in field_paths)


def _public_name(path_fields: list[str]) -> str:
    """Return the name that users write for an array of a system, from the fields on its path."""
    if "lagrangian" in path_fields:
        path_fields = path_fields[len(path_fields) - 1 - path_fields[::-1].index("lagrangian") :]
    elif path_fields[:2] in (["energy", "baths"], ["baths", "energy"]):
        # a bath of infinite capacity has the linear energy T S
        path_fields = ["baths", *("temperature" if field_name == "b" else field_name for field_name in path_fields[2:])]
    name = previous_field = path_fields[0]
    for field_name in (*(f for f in path_fields[1:-1] if f not in WRAPPER_FIELDS), *path_fields[1:][-1:]):
        if field_name != previous_field:  # not the friction of a friction
            name += field_name if field_name.startswith("[") else f".{field_name}"
        previous_field = field_name
    return name


def _replace_energy_matrix_by_inertia(
    system: System, parameters_by_name: dict[str, NamedParameter], parameters_by_path: dict[str, NamedParameter]
) -> dict[str, NamedParameter]:
    """Return the parameters by name; for a rigid body, ``energy.inertia`` replaces the energy matrix ``energy.A``.

    The matrix is added to ``parameters_by_path``.
    """
    matrix = parameters_by_name.get("energy.A")
    if matrix is None or matrix.value.shape not in ((3,), (3, 3)) or system.inertia is None:
        return parameters_by_name
    body = system.drop_baths()
    if not isinstance(body.energy, Quadratic) or body.dim != 3:
        return parameters_by_name
    parameters_by_path["energy.A"] = matrix
    inverse = 1.0 / matrix.value if matrix.value.ndim == 1 else np.linalg.inv(matrix.value)
    inertia = NamedParameter(inverse, matrix.leaf_indices, is_inverse=True, condition=INERTIA_CONDITION)
    return {"energy.inertia": inertia, **{name: p for name, p in parameters_by_name.items() if name != "energy.A"}}
