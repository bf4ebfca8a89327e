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
from ..functions.conditions import ParameterCondition, condition_of_field
from ..functions.energy import Quadratic
from ..models.inertia import INERTIA_CONDITION, inverse_moments
from ..systems import System
from ..tracing.caching import memoize

WRAPPER_FIELDS = frozenset({"body", "part", "term", "function", "phi", "contact", "first"})
"""Fields of the objects of a system that hold the object of the user, and are left out of names."""

DERIVED_FIELDS = frozenset({"momentum_maps", "momentum_casimirs", "subsystems"})
"""Fields of a system that follow from others. Their arrays have no names, but those of a Lagrangian in them."""


class NamedParameter(NamedTuple):
    """A parameter of a system.

    Attributes
    ----------
    value : ndarray
    leaves : tuple of int
        Numbers of the arrays of the system that hold it, in the order of :func:`parameter_arrays`.
    is_inverse : bool
        Whether these arrays hold the inverse: those of an energy with moments of inertia do.
    condition : ParameterCondition or None
        The condition of the constructor on the value.
    """

    value: np.ndarray
    leaves: tuple[int, ...]
    is_inverse: bool = False
    condition: ParameterCondition | None = None

    def to_leaf(self, value):
        """Convert a value of the parameter, or several along the first axis, to the array that the system stores.

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

    The names are those of the user's objects, whether or not the system has baths, a clock or an attitude. What is kept
    in several places, such as the capacity of a bath, is one parameter. A rigid body has ``energy.inertia``.
    """
    return {name: parameter.value for name, parameter in _parameters_by_name_and_by_path(system)[0].items()}


def replace_parameters(system: System, values: Mapping[str, Any]) -> System:
    """Return a system with new values of some of its parameters, traced or not, by name.

    Raises
    ------
    InputError
        If the system has no parameter of this name, or a value has another shape or is refused by the constructor of
        its object, as a negative rate is.
    """
    # the system's own arrays, which cannot change in place, so that results for the new system can be cached
    leaves: list[Any] = jax.tree_util.tree_leaves(eqx.filter(system, eqx.is_inexact_array))
    replaced: dict[int, str] = {}
    for name, value in values.items():
        parameter = find_parameter(system, name)
        array = host_array(real_array(value))
        if array.shape != parameter.value.shape:
            raise InputError(f"{name} must have shape {parameter.value.shape}, got {array.shape}")
        _check_and_record_name(replaced, name, parameter)
        if parameter.condition is not None:
            parameter.condition.require(array)
        for i in parameter.leaves:
            leaves[i] = real_array(parameter.to_leaf(array))
    return ProgramStructure.from_module(system).rebuild(leaves)


def refused_members(system: System, values: Mapping[str, Any]) -> dict[int, str]:
    """Return the members of a family with a value that the constructor of its object refuses, with the reasons.

    Members with NaN are left out: the family has a reason for them.

    Parameters
    ----------
    system : System
    values : mapping of str to array, shape (members, ...)
    """
    reasons: dict[int, str] = {}
    for name, value in values.items():
        condition = find_parameter(system, name).condition
        if condition is not None:
            reasons |= condition.violations(np.asarray(value, dtype=np.float64))
    return reasons


def _condition_at(system: System, path: Sequence[Any]) -> ParameterCondition | None:
    """Return the condition of the field of a system that holds the array at a path; None if it has none."""
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


def arrays_with_members(system: System, values: Mapping[str, Any]) -> list[np.ndarray]:
    """Return the arrays of a family of systems (members along the first axis), with given values of some parameters.

    Arrays that all members share have a first axis of length 1.

    Raises
    ------
    InputError
        If the system has no parameter of this name, or values have another shape.
    """
    leaves = [array[None] for array in parameter_arrays(system)]
    replaced: dict[int, str] = {}
    for name, value in values.items():
        parameter, array = find_parameter(system, name), np.asarray(value, dtype=np.float64)
        if array.ndim == 0 or array.shape[1:] != parameter.value.shape:
            expected_shape = ", ".join(["trajectories", *map(str, parameter.value.shape)])
            raise InputError(f"the values of {name} must have shape ({expected_shape}), got {array.shape}")
        _check_and_record_name(replaced, name, parameter)
        for i in parameter.leaves:
            leaves[i] = np.asarray(parameter.to_leaf(array))
    return leaves


def find_parameter(system: System, name: str) -> NamedParameter:
    """Return the parameter that :func:`lookup_parameter` finds; raise InputError if there is none.

    Raises
    ------
    InputError
        If there is none; the message lists the names.
    """
    parameter = lookup_parameter(system, name)
    if parameter is None:
        names = ", ".join(named_parameters(system))
        raise InputError(
            f"the system has no parameter {name!r}; its parameters are {names}. For others, give a function that "
            "builds the system"
        )
    return parameter


def lookup_parameter(system: System, name: str) -> NamedParameter | None:
    """Return the parameter with a name, or with the path of one of its arrays in the system; None if there is none."""
    by_name, by_path = _parameters_by_name_and_by_path(system)
    return by_name.get(name) or by_path.get(name)


def _check_and_record_name(replaced: dict[int, str], name: str, parameter: NamedParameter) -> None:
    """Raise InputError if the parameter was given before under another name; otherwise record its name."""
    for i in parameter.leaves:
        if i in replaced:
            raise InputError(f"{name} and {replaced[i]} are the same parameter. Give one of them")
        replaced[i] = name


@memoize
def _parameters_by_name_and_by_path(system: System) -> tuple[dict[str, NamedParameter], dict[str, NamedParameter]]:
    """Return the parameters of a system by name, and by the paths of their arrays."""
    flat, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(system, eqx.is_inexact_array))
    fields = [[jax.tree_util.keystr((key,)).removeprefix(".") for key in path] for path, _ in flat]
    paths = [jax.tree_util.keystr(path).removeprefix(".") for path, _ in flat]
    arrays, has_derived_energy = parameter_arrays(system), _has_derived_energy(fields)
    conditions = [_condition_at(system, path) for path, _ in flat]
    leaves_by_name: dict[str, list[int]] = {}
    for i, path_fields in enumerate(fields):
        is_of_lagrangian = "lagrangian" in path_fields
        is_derived = path_fields[0] in DERIVED_FIELDS and not is_of_lagrangian
        if has_derived_energy:
            is_derived |= is_of_lagrangian or path_fields[0] == "energy"
        if arrays[i].size and not is_derived:
            leaves_by_name.setdefault(_public_name(path_fields), []).append(i)
    by_name: dict[str, NamedParameter] = {}
    for name, leaves in leaves_by_name.items():
        value = arrays[leaves[0]]
        if all(np.array_equal(arrays[i], value, equal_nan=True) for i in leaves):
            condition = next((conditions[i] for i in leaves if conditions[i] is not None), None)
            by_name[name] = NamedParameter(value, tuple(leaves), condition=condition)
        else:  # different parameters, whose paths differ in the fields of wrappers only
            by_name |= {paths[i]: NamedParameter(arrays[i], (i,), condition=conditions[i]) for i in leaves}
    by_path = {paths[i]: parameter for parameter in by_name.values() for i in parameter.leaves}
    return _with_inertia(system, by_name, by_path), by_path


def _has_derived_energy(fields: list[list[str]]) -> bool:
    """Return whether the energy was computed from the Lagrangian of a system, so that neither can be set alone."""
    has_lagrangian = any(path[0] == "lagrangian" for path in fields)
    return has_lagrangian and not any(path[0] == "energy" and "lagrangian" in path for path in fields)


def _public_name(fields: list[str]) -> str:
    """Return the name of an array of a system from the fields of its path."""
    if "lagrangian" in fields:
        fields = fields[len(fields) - 1 - fields[::-1].index("lagrangian") :]
    elif fields[:2] in (["energy", "baths"], ["baths", "energy"]):
        # a bath of infinite capacity has the linear energy T S
        fields = ["baths", *("temperature" if field == "b" else field for field in fields[2:])]
    name = previous = fields[0]
    for field in (*(f for f in fields[1:-1] if f not in WRAPPER_FIELDS), *fields[1:][-1:]):
        if field != previous:  # not the friction of a friction
            name += field if field.startswith("[") else f".{field}"
        previous = field
    return name


def _with_inertia(
    system: System, by_name: dict[str, NamedParameter], by_path: dict[str, NamedParameter]
) -> dict[str, NamedParameter]:
    """Return the parameters with ``energy.inertia`` in place of the matrix of the energy of a rigid body.

    The matrix keeps its name as a path.
    """
    matrix = by_name.get("energy.A")
    if matrix is None or matrix.value.shape not in ((3,), (3, 3)) or system.inertia is None:
        return by_name
    body = system.drop_baths()
    if not isinstance(body.energy, Quadratic) or body.dim != 3:
        return by_name
    by_path["energy.A"] = matrix
    inverse = 1.0 / matrix.value if matrix.value.ndim == 1 else np.linalg.inv(matrix.value)
    inertia = NamedParameter(inverse, matrix.leaves, is_inverse=True, condition=INERTIA_CONDITION)
    return {"energy.inertia": inertia, **{name: p for name, p in by_name.items() if name != "energy.A"}}
