"""Upper bounds of the degrees of polynomials, array by array, for functions that are too large to be unrolled."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

DEGREE_PRESERVING = frozenset(
    "add sub add_any neg copy reshape transpose squeeze broadcast_in_dim rev slice concatenate pad reduce_sum cumsum "
    "expand_dims split optimization_barrier".split()
)
"""Primitives that are linear in all arguments together: a result has the largest degree of an argument."""

INDEXED_PRIMITIVES = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2}
"""Primitives that move entries by index, with the number of arguments that hold entries; the others hold indices."""

PRODUCT_PRIMITIVES = frozenset(["mul", "dot_general", "conv_general_dilated"])
"""Bilinear primitives, whose results have the sum of the degrees of their arguments."""

CALL_PRIMITIVES = frozenset(["jit", "pjit", "closed_call", "core_call", "checkpoint", "remat2", "custom_jvp_call"])
"""Primitives that call a jaxpr."""


def array_degree_bound(closed_jaxpr: ClosedJaxpr, input_index: int) -> float:
    """Return an upper bound of the degree of the outputs as polynomials in one of the inputs, or infinity.

    All entries of an array share the largest degree among them, so the cost does not depend on the size of arrays.
    """
    input_degrees = [1.0 if i == input_index else 0.0 for i in range(len(closed_jaxpr.jaxpr.invars))]
    return max(_output_degrees(closed_jaxpr.jaxpr, input_degrees), default=0.0)


def _output_degrees(jaxpr: Jaxpr, input_degrees: Sequence[float]) -> list[float]:
    """Return the degree of each output of a jaxpr, from the degrees of its inputs."""
    degrees = dict(zip(jaxpr.invars, input_degrees, strict=True))

    def degree(atom) -> float:
        return 0.0 if isinstance(atom, Literal) else degrees.get(atom, 0.0)

    for equation in jaxpr.eqns:
        argument_degrees = [degree(atom) for atom in equation.invars]
        results = _equation_degrees(equation, argument_degrees) if any(argument_degrees) else [0.0]
        results = results if len(results) > 1 else results * len(equation.outvars)
        degrees.update(zip(equation.outvars, results, strict=True))
    return [degree(atom) for atom in jaxpr.outvars]


def _equation_degrees(equation, argument_degrees: list[float]) -> list[float]:
    """Return the degrees of the results of one equation: one degree for all results, or one for each."""
    name, parameters = equation.primitive.name, equation.params
    if name in DEGREE_PRESERVING:
        return [max(argument_degrees)]
    if name in PRODUCT_PRIMITIVES:
        return [sum(argument_degrees)]
    if name in INDEXED_PRIMITIVES:
        entry_degrees, index_degrees = (
            argument_degrees[: INDEXED_PRIMITIVES[name]],
            argument_degrees[INDEXED_PRIMITIVES[name] :],
        )
        return [math.inf if any(index_degrees) else max(entry_degrees)]
    if name == "div" and not argument_degrees[1]:
        return [argument_degrees[0]]
    if name == "square":
        return [2.0 * argument_degrees[0]]
    if name == "integer_pow" and parameters["y"] >= 0:
        return [parameters["y"] * argument_degrees[0]]
    if name == "select_n" and not argument_degrees[0]:
        return [max(argument_degrees[1:])]
    if name in CALL_PRIMITIVES:
        inner = parameters.get("jaxpr", parameters.get("call_jaxpr"))
        return _output_degrees(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner, argument_degrees)
    return [math.inf]
