"""Searches of the equations of a jaxpr, those of the jaxprs within it included."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from jax.extend.core import Jaxpr, jaxprs_in_params

from .primitives import MAX_UNROLLED_INPUT_PRODUCTS

DATA_MOVEMENT = frozenset(
    "reshape broadcast_in_dim squeeze transpose slice dynamic_slice concatenate gather pad rev copy iota "
    "convert_element_type".split()
)
"""Primitives without arithmetic."""


def iterate_equations(jaxpr: Jaxpr, repetitions: int = 1, *, calls_only: bool = False) -> Iterator[tuple[Any, int]]:
    """Yield each equation of a jaxpr, then those of the jaxprs within it, with the number of times that it runs.

    The body of a loop of unknown length counts once.

    Parameters
    ----------
    calls_only : bool
        Whether to enter only jaxprs that are called, and leave out branches, ``while`` loops and functions with their
        own derivatives.
    """
    for equation in jaxpr.eqns:
        yield equation, repetitions
        params = equation.params
        for inner in jaxprs_in_params({"jaxpr": params.get("jaxpr")} if calls_only else params):
            yield from iterate_equations(inner, repetitions * params.get("length", 1), calls_only=calls_only)


def has_large_matrix_products(jaxpr: Jaxpr) -> bool:
    """Return whether a jaxpr contains a product of matrices that may become a loop."""
    return any(
        equation.primitive.name == "dot_general"
        and max(math.prod(v.aval.shape) for v in equation.invars) > MAX_UNROLLED_INPUT_PRODUCTS
        for equation, _ in iterate_equations(jaxpr, calls_only=True)
    )


def aval_dtype(aval: Any) -> Any:
    """Return the type of the numbers of an abstract value of JAX; None for a token, which has no numbers."""
    return getattr(aval, "dtype", None)


def has_while_loop(jaxpr: Jaxpr) -> bool:
    """Return whether a jaxpr contains a ``while`` loop."""
    return any(equation.primitive.name == "while" for equation, _ in iterate_equations(jaxpr))


def count_scalar_operations(jaxpr: Jaxpr) -> int:
    """Return the number of scalar operations of a jaxpr, operations on zeros included.

    One pass of a loop of unknown length is counted.
    """
    return sum(repetitions * _count_equation_operations(equation) for equation, repetitions in iterate_equations(jaxpr))


def _count_equation_operations(equation: Any) -> int:
    """Return the number of scalar operations of an equation, without those of the jaxprs within it."""
    if equation.primitive.name in DATA_MOVEMENT or any(jaxprs_in_params(equation.params)):
        return 0
    if equation.primitive.name == "dot_general":
        contracted_axes = equation.params["dimension_numbers"][0][0]
        n_products = math.prod(equation.invars[0].aval.shape[axis] for axis in contracted_axes)
        return n_products * math.prod(equation.outvars[0].aval.shape)
    return max(math.prod(v.aval.shape) for v in (*equation.invars, *equation.outvars))
