"""Functions that users give: evaluated once, traced, and refused with reasons where they are none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..tracing.interpret import polynomial_degree
from ..tracing.trace_errors import TRACE_ERRORS, explain_trace_error
from ..tracing.traced import trace_callables_with_result
from .energy import Energy, Function, Negative, Pullback, SpanLimitedEnergy, StateTimeEnergy, Sum


def mark_polynomial_degrees(energy: Energy, dim: int) -> Energy:
    """The same energy, the degrees of its plain functions marked that are written as polynomials."""
    if isinstance(energy, Sum):
        return Sum(tuple(mark_polynomial_degrees(term, dim) for term in energy.summands))
    if isinstance(energy, Negative):
        return Negative(mark_polynomial_degrees(energy.term, dim))
    if isinstance(energy, StateTimeEnergy):
        return StateTimeEnergy(mark_polynomial_degrees(energy.energy, dim))
    if isinstance(energy, SpanLimitedEnergy):
        inner = mark_polynomial_degrees(energy.energy, dim)
        return (
            inner if inner.is_quadratic else SpanLimitedEnergy(inner, energy.span)
        )  # a polynomial is known at every time
    if isinstance(energy, Pullback):
        (inner,) = jax.eval_shape(energy.coordinates, jax.ShapeDtypeStruct((dim,), jnp.float64)).shape
        return eqx.tree_at(lambda e: e.term, energy, mark_polynomial_degrees(energy.term, inner))
    if isinstance(energy, Function) and energy.degree == math.inf:
        degree = polynomial_degree(energy_value, energy, dim)
        return energy if degree == math.inf else Function(energy.function, degree)
    return energy


def energy_value(energy: Energy, x) -> jax.Array:
    """Its value at a state: of any energy one function, as what is compiled is kept by."""
    return energy.value(x)


def check_energy(energy: Energy, dim: int, role: str, allow_time: bool = False) -> Energy:
    """The energy with its plain functions traced, so that closures with other numbers are alike.

    With ``allow_time`` it may depend on the time too.

    Raises
    ------
    FunctionError, InputError
        Unless it maps a state of this dimension to one real number, each term in coordinates that it has.
    """
    if energy.depends_on_time and not allow_time:
        raise InputError(
            f"{role} depends on time, or is a function of two arguments, which only the energy of a system may be "
            "(and the Lagrangian of an EulerPoincareSystem, and couplings of a ComposedSystem)"
        )
    try:
        energy, result = trace_callables_with_result(
            energy, lambda energy, x, t: energy.at_time(t).value(x), (dim,), ()
        )
    except TRACE_ERRORS as error:
        for term in energy.terms:
            term.check_components(dim, role)  # says which term, where the fault is in its coordinates
        if isinstance(error, IndexOutOfRangeError):
            raise error.with_function(f"{role}, a function of a state of shape ({dim},),") from None
        cure = "It must be written with jax.numpy and accept one array"
        message = explain_trace_error(f"{role} could not be evaluated on a state of shape ({dim},)", error, cure)
        raise FunctionError(message) from error
    for term in energy.terms:
        term.check_components(dim, role)
    if result.shape != ():
        raise FunctionError(
            f"{role} must return one number, but it returns shape {result.shape}; did you mean jnp.sum?"
        )
    if not jnp.issubdtype(result.dtype, jnp.floating):
        raise FunctionError(f"{role} must return a real number, but it returns {result.dtype}")
    return energy


def trace_energies(tree, dim: int, role: str | None = None):
    """A pytree with the energies in it checked as :func:`check_energy` does; one that occurs twice stays one object.

    Without a role, those that are no functions of a state are left as they are.
    """
    found: dict[int, Energy] = {}

    def check_once(part):
        if not isinstance(part, Energy):
            return part
        if id(part) not in found:
            try:
                found[id(part)] = check_energy(part, dim, role or "a function")
            except (FunctionError, InputError):
                if role is not None:
                    raise
                found[id(part)] = part
        return found[id(part)]

    return jax.tree_util.tree_map(check_once, tree, is_leaf=lambda part: isinstance(part, Energy))


def check_function_shape(
    function: Callable, arguments: Sequence[tuple[int, ...]], shapes: Sequence[tuple[int, ...]], what: str, at: str
) -> tuple[Callable, tuple[int, ...]]:
    """A function of arrays of these shapes, traced, and the shape of its values; ``at`` names its arguments.

    Raises
    ------
    FunctionError
        Unless it gives real numbers of one of ``shapes``.
    """
    try:
        function, found = trace_callables_with_result(
            function, lambda function, *a: jnp.asarray(function(*a)), *arguments
        )
    except IndexOutOfRangeError as error:
        raise error.with_function(f"{what}, at {at},") from None
    except TRACE_ERRORS as error:
        raise FunctionError(explain_trace_error(f"{what} could not be evaluated at {at}", error)) from error
    if found.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise FunctionError(f"{what} has shape {wanted}, not {found.shape}")
    if jnp.iscomplexobj(found):
        raise FunctionError(f"{what} is real, not {found.dtype}; take the real part if that is meant")
    return function, found.shape
