"""Degrees of polynomials, array by array: an upper bound for functions that are too large to be unrolled."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

DEGREE_PRESERVING = frozenset(
    "add sub add_any neg copy reshape transpose squeeze broadcast_in_dim rev slice concatenate pad reduce_sum cumsum "
    "expand_dims split optimization_barrier".split()
)
"""Primitives whose results are sums of entries of their arguments: of the largest of their degrees."""

INDEXED_PRIMITIVES = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2}
"""Those that move entries to places that further arguments name; and how many of the arguments have entries."""

PRODUCT_PRIMITIVES = frozenset(["mul", "dot_general", "conv_general_dilated"])

CALL_PRIMITIVES = frozenset(["jit", "pjit", "closed_call", "core_call", "checkpoint", "remat2", "custom_jvp_call"])


def array_degree_bound(closed: ClosedJaxpr, place: int) -> float:
    """Degree of the outputs as polynomials in one of the inputs, at most; infinity where they are not written as such.

    All entries of an array count as one of the largest degree among them, so that the size of arrays does not matter.
    """
    given = [1.0 if i == place else 0.0 for i in range(len(closed.jaxpr.invars))]
    return max(_output_degrees(closed.jaxpr, given), default=0.0)


def _output_degrees(jaxpr: Jaxpr, given: Sequence[float]) -> list[float]:
    known = dict(zip(jaxpr.invars, given, strict=True))

    def degree(atom) -> float:
        return 0.0 if isinstance(atom, Literal) else known.get(atom, 0.0)

    for equation in jaxpr.eqns:
        found = [degree(atom) for atom in equation.invars]
        results = _equation_degrees(equation, found) if any(found) else [0.0]
        results = results if len(results) > 1 else results * len(equation.outvars)
        known.update(zip(equation.outvars, results, strict=True))
    return [degree(atom) for atom in jaxpr.outvars]


def _equation_degrees(equation, found: list[float]) -> list[float]:
    """The degrees of the results of one equation: one for all, or one for each."""
    name, parameters = equation.primitive.name, equation.params
    if name in DEGREE_PRESERVING:
        return [max(found)]
    if name in PRODUCT_PRIMITIVES:
        return [sum(found)]
    if name in INDEXED_PRIMITIVES:
        entries, places = found[: INDEXED_PRIMITIVES[name]], found[INDEXED_PRIMITIVES[name] :]
        return [math.inf if any(places) else max(entries)]
    if name == "div" and not found[1]:
        return [found[0]]
    if name == "square":
        return [2.0 * found[0]]
    if name == "integer_pow" and parameters["y"] >= 0:
        return [parameters["y"] * found[0]]
    if name == "select_n" and not found[0]:
        return [max(found[1:])]
    if name in CALL_PRIMITIVES:
        inner = parameters.get("jaxpr", parameters.get("call_jaxpr"))
        return _output_degrees(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner, found)
    return [math.inf]
