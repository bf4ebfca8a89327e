"""Checks of the functions that users pass, which are evaluated once, traced, and refused with the reason."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..tracing.interpret import polynomial_degree_bound
from ..tracing.searches import iterate_equations
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import TracedFunction, trace_callables_and_result_shapes
from .energy import Energy, Function, Pullback, SpanLimitedEnergy, StateTimeEnergy, map_operands


def with_polynomial_degrees(energy: Energy, dim: int) -> Energy:
    """Return the energy with the degree set in each of its plain functions that is written as a polynomial."""
    if isinstance(energy, StateTimeEnergy):
        return StateTimeEnergy(with_polynomial_degrees(energy.energy, dim))
    if isinstance(energy, SpanLimitedEnergy):
        inner_energy = with_polynomial_degrees(energy.energy, dim)
        # a polynomial is defined at every time
        return inner_energy if inner_energy.is_quadratic else SpanLimitedEnergy(inner_energy, energy.span)
    if isinstance(energy, Pullback):
        (inner_dim,) = jax.eval_shape(energy.coordinates, jax.ShapeDtypeStruct((dim,), jnp.float64)).shape
        return eqx.tree_at(lambda e: e.term, energy, with_polynomial_degrees(energy.term, inner_dim))
    if isinstance(energy, Function) and energy.degree == math.inf:
        degree = polynomial_degree_bound(energy_value, energy, dim)
        return energy if degree == math.inf else Function(energy.function, degree)
    return map_operands(energy, lambda operand: with_polynomial_degrees(operand, dim))


def energy_value(energy: Energy, x) -> jax.Array:
    """Return the value of an energy at a state.

    One function serves all energies, because compiled programs are cached by the identity of their function.
    """
    return energy.value(x)


def checked_energy(energy: Energy, dim: int, role: str, allow_time: bool = False) -> Energy:
    """Return the energy with its plain functions traced, so that closures that differ only in numbers are equal.

    With ``allow_time`` the energy may depend on time.

    Raises
    ------
    FunctionError, InputError
        Unless the energy maps a state of this dimension to one real number, and the coordinates of each term exist.
    """
    if energy.depends_on_time and not allow_time:
        raise InputError(
            f"{role} must be a function of the state alone, got a function of two arguments or of time. Only the "
            "energy of a system, the Lagrangian of an EulerPoincareSystem and couplings of a ComposedSystem may depend "
            "on time"
        )
    try:
        energy, result = trace_callables_and_result_shapes(
            energy, lambda energy, x, t: energy.at_time(t).value(x), (dim,), ()
        )
    except TRACE_ERRORS as error:
        for term in energy.terms:
            term.check_components(dim, role)  # names the term if its coordinates are at fault
        if isinstance(error, IndexOutOfRangeError):
            raise error.with_function(f"{role}, a function of a state of shape ({dim},),") from None
        default_advice = "It must be written with jax.numpy and accept one array"
        message = trace_error_message(
            f"{role} could not be evaluated on a state of shape ({dim},)", error, default_advice
        )
        raise FunctionError(message) from error
    for term in energy.terms:
        term.check_components(dim, role)
    if result.shape != ():
        raise FunctionError(
            f"{role} must return one number, but it returns shape {result.shape}; did you mean jnp.sum?"
        )
    if not jnp.issubdtype(result.dtype, jnp.floating):
        raise FunctionError(f"{role} must return a real number, but it returns {result.dtype}")
    _check_derivative_of_scatter(energy, dim, role)
    return energy


def _check_derivative_of_scatter(energy: Energy, dim: int, role: str) -> None:
    """Raise FunctionError if an energy changes entries of an array in a way that JAX cannot differentiate."""
    programs = [
        leaf.program
        for leaf in jax.tree_util.tree_leaves(energy, is_leaf=_is_traced_function)
        if _is_traced_function(leaf)
    ]
    equations = itertools.chain.from_iterable(iterate_equations(p.closed_jaxpr.jaxpr) for p in programs)
    if not any(equation.primitive.name.startswith("scatter") for equation, _ in equations):
        return
    try:
        jax.eval_shape(lambda x: energy.at_time(0.0).gradient(x), jax.ShapeDtypeStruct((dim,), jnp.float64))
    except NotImplementedError as error:
        raise FunctionError(
            f"{role} must have a derivative, but JAX cannot compute it: {error}. Replace x.at[i].apply(f) by "
            "x.at[i].set(f(x[i])), and x.at[i].multiply(a), if each index occurs once, by x.at[i].set(x[i] * a)"
        ) from error


def _is_traced_function(leaf) -> bool:
    """Return whether a leaf of a pytree is a function that has been traced already."""
    return isinstance(leaf, TracedFunction)


def trace_energies(tree, dim: int, role: str | None = None):
    """Return a pytree with each energy in it checked and traced.

    An energy that occurs twice is traced once and stays one object.
    Without a role, an energy that fails the check is left unchanged.
    """
    checked_energies: dict[int, Energy] = {}

    def check_node(node):
        if not isinstance(node, Energy):
            return node
        if id(node) not in checked_energies:
            try:
                checked_energies[id(node)] = checked_energy(node, dim, role or "a function")
            except (FunctionError, InputError):
                if role is not None:
                    raise
                checked_energies[id(node)] = node
        return checked_energies[id(node)]

    return jax.tree_util.tree_map(check_node, tree, is_leaf=lambda node: isinstance(node, Energy))


def traced_function_and_shape(
    function: Callable,
    argument_shapes: Sequence[tuple[int, ...]],
    allowed_shapes: Sequence[tuple[int, ...]],
    function_description: str,
    arguments_description: str,
) -> tuple[Callable, tuple[int, ...]]:
    """Return a traced function of arrays of given shapes, and the shape of its result.

    Messages name the function by ``function_description``, and its arguments by ``arguments_description``.

    Raises
    ------
    FunctionError
        Unless the result is real and has one of ``allowed_shapes``.
    """
    try:
        function, result = trace_callables_and_result_shapes(
            function, lambda function, *a: jnp.asarray(function(*a)), *argument_shapes
        )
    except IndexOutOfRangeError as error:
        raise error.with_function(f"{function_description}, at {arguments_description},") from None
    except TRACE_ERRORS as error:
        raise FunctionError(
            trace_error_message(f"{function_description} could not be evaluated at {arguments_description}", error)
        ) from error
    if result.shape not in allowed_shapes:
        expected_shapes = " or ".join(map(str, allowed_shapes))
        raise FunctionError(f"{function_description} must have shape {expected_shapes}, got {result.shape}")
    if jnp.iscomplexobj(result):
        raise FunctionError(
            f"{function_description} must be real, got {result.dtype}. Take the real part if that is meant"
        )
    return function, result.shape
