"""Parameters of a fit by name: those of a system, or the arguments of a function that builds one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..errors import FunctionError, InputError
from ..runs.flow import system_with_parameters
from ..runs.named_parameters import require_parameter
from ..systems import System
from ..systems.kind_checks import require_system
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from .losses import ParameterVector
from .observation import entry_names


def initial_parameter_values(system: System | Callable, parameters: Any) -> dict[str, np.ndarray]:
    """Return the initial values of the named parameters of a fit, as a dict of arrays.

    Parameters
    ----------
    system : System, or function from a dict of parameters to a System
    parameters : dict from names to values; or names of parameters of a system, whose values are in it

    Raises
    ------
    InputError
        If names or values cannot be used.
    """
    if isinstance(system, System) and not isinstance(parameters, Mapping):
        names = _to_name_list(parameters)
        if names is None:
            raise InputError(f"parameters must be names, or a dict from names to initial values, got {parameters!r}")
        parameters = {name: require_parameter(system, name).value for name in names}
    if not isinstance(parameters, Mapping) or not all(isinstance(name, str) for name in parameters):
        raise InputError(
            "a function that builds a system needs parameters=, a dict from names to initial values, got "
            f"{parameters!r}"
        )
    values = {}
    for name, value in parameters.items():
        try:
            values[name] = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"the parameter {name!r} must be a number or an array, got {value!r:.60}") from None
        if not np.isfinite(values[name]).all():
            raise InputError(f"the initial value of the parameter {name!r} must be finite, got {value!r:.60}")
    if not values:
        raise InputError("parameters is empty. Name the parameters to fit, such as parameters={'rate': 0.1}")
    return values


def build_with_parameters(system: System | Callable, parameter_values: Mapping[str, Any]) -> System:
    """Build the system with the given parameter values, after checking that traced values build one too.

    Raises
    ------
    InputError, FunctionError
        If there is no such system, or the function does not return one or does not accept traced values.
    """
    try:
        built_system = system_with_parameters(system, parameter_values)
    except KeyError as error:
        raise InputError(f"the system needs the parameter {error}. Add it to parameters=") from None
    require_system(built_system, "the function that builds the system must return a system")
    try:
        jax.eval_shape(
            lambda parameter_values: ravel_pytree(system_with_parameters(system, parameter_values))[0],
            dict(parameter_values),
        )
    except TRACE_ERRORS as error:
        description = "the function that builds the system could not be evaluated for traced parameters"
        raise FunctionError(trace_error_message(description, error)) from error
    return built_system


def named_parameter_vector(
    system: System | Callable, values: Mapping[str, np.ndarray], positive: Any = None
) -> ParameterVector:
    """Pack named parameters into a :class:`ParameterVector`, with the logarithms of those that stay positive.

    Parameters
    ----------
    positive : bool, name or names, optional
        The parameters that stay positive; True for all.

    Raises
    ------
    InputError
        If a name is not known, or a parameter that stays positive has an initial value that is not.
    """
    log_names = _names_of_positive_parameters(positive, list(values))
    for name in log_names:
        if not (values[name] > 0.0).all():
            raise InputError(f"the parameter {name!r} must stay positive, but its initial value is {values[name]}")
    tree = {name: jnp.asarray(np.log(value) if name in log_names else value) for name, value in values.items()}
    names = list(tree)
    initial_values, unravel = ravel_pytree([tree[name] for name in names])

    def parameters_of(vector) -> dict[str, Any]:
        arrays = dict(zip(names, unravel(vector), strict=True))
        return {name: jnp.exp(array) if name in log_names else array for name, array in arrays.items()}

    is_log = [np.full(np.size(values[name]), name in log_names) for name in names]
    return ParameterVector(
        np.asarray(initial_values),
        tuple(np.shape(values[name]) for name in names),
        lambda vector: system_with_parameters(system, parameters_of(vector)),
        entry_names(values),
        np.concatenate(is_log),
        parameters_of,
    )


def _names_of_positive_parameters(positive: Any, names: list[str]) -> tuple[str, ...]:
    """Return the names of the parameters that stay positive; raise InputError if one is unknown."""
    if positive is None or isinstance(positive, bool):
        return tuple(names) if positive else ()
    name_list = _to_name_list(positive)
    if name_list is None:
        raise InputError(f"positive must be True, or names of parameters, if parameters= is given; got {positive!r}")
    if unknown := [name for name in name_list if name not in names]:
        raise InputError(f"positive has {unknown[0]!r}, but the parameters of the fit are {', '.join(names)}")
    return tuple(name_list)


def _to_name_list(names: Any) -> list[str] | None:
    """Return one name, or several, as a list; None if a value is not a text."""
    name_list = [names] if isinstance(names, str) else list(names) if isinstance(names, Iterable) else [names]
    return name_list if all(isinstance(name, str) for name in name_list) else None
