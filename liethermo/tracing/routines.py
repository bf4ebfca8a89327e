"""Functions that are written once, as routines: those with products of matrices, such as networks, and long ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jax.extend.core import ClosedJaxpr

from .builder import Builder, EnclosingScope, Scalar
from .caching import LRUCache
from .calls import MatrixProduct
from .complex_numbers import flatten_scalars, scalar_kinds, unflatten_scalars
from .primitives import MAX_UNROLLED_INPUT_PRODUCTS
from .program import Program, Routine, eliminate_dead_code

MIN_ROUTINE_PRODUCTS, MIN_ROUTINE_INSTRUCTIONS = 2, 500
"""Products of matrices as loops, or instructions, from which a function is worth a routine."""

_routine_cache: LRUCache[tuple] = LRUCache(256)


def has_matrix_products(jaxpr) -> bool:
    """Whether a product of matrices stands in it that may become a loop."""
    for eqn in jaxpr.eqns:
        inner = eqn.params.get("jaxpr")
        if (
            eqn.primitive.name == "dot_general"
            and max(math.prod(v.aval.shape) for v in eqn.invars) > MAX_UNROLLED_INPUT_PRODUCTS
        ):
            return True
        if isinstance(inner, ClosedJaxpr) and has_matrix_products(inner.jaxpr):
            return True
    return False


def call_as_routine(
    b: Builder, unroll: Callable, closed: ClosedJaxpr, arguments: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """The results of a function, by a routine where that is worth it.

    Calls of one function, jitted, have one routine, whatever is known of the numbers that they hand over. Matrices
    that lie in memory as they are given, such as weights, stay there.

    Parameters
    ----------
    unroll : function
        What unrolls a jaxpr: that of :mod:`.scalarize`.
    """
    scalars = flatten_scalars(arguments)
    held = [b.input_indices(x.ravel().tolist()) if x.ndim > 1 else None for x in arguments]
    known = [a if type(a) in (int, bool) else None for a in scalars]
    key = id(closed), tuple(None if place is None else tuple(place) for place in held), tuple(map(repr, known))
    # with the jaxpr, so that no other takes its place
    once = _routine_cache.get_or_compute(key, lambda: (closed, _RoutineCall.build(b, unroll, closed, arguments, held)))[
        1
    ]
    return unroll(b, closed.jaxpr, closed.consts, arguments) if once is None else once.emit_call(b, scalars, closed)


@dataclass(frozen=True)
class _RoutineCall:
    """A function as a routine.

    Attributes
    ----------
    routine : Routine
    argument_sources : tuple of (int or tuple)
        What the routine is given: the place, among all entries of the arguments, of a number; or those of what is in a
        table, a number that is known standing for itself, in a tuple.
    result_sources : tuple of (scalar, (int) or None)
        For each entry of the results what it is, where that is known, or in a tuple its place among all entries of the
        arguments; others are those of the routine, in order.
    """

    routine: Routine
    argument_sources: tuple[int | tuple[int | tuple[Scalar], ...], ...]
    result_sources: tuple[Scalar | tuple[int] | None, ...]

    @classmethod
    def build(cls, b: Builder, unroll: Callable, closed: ClosedJaxpr, arguments, held: Sequence) -> _RoutineCall | None:
        around, names = EnclosingScope(b), dict[Scalar, int]()  # inside, and where they are among the arguments
        own, entries = Builder(b.max_instructions, around), list[Scalar]()
        for x, aval, place in zip(arguments, closed.in_avals, held, strict=True):
            for kind, a in zip(scalar_kinds([aval]), flatten_scalars([x]), strict=True):
                if type(a) in (str, float):
                    name = f"x1_{len(entries)}" if place is None else around.import_scalar(a)
                    names.setdefault(name, len(entries))
                    a = _convert_to_kind(own, kind, name)
                entries.append(a)
        results = flatten_scalars(
            unroll(own, closed.jaxpr, closed.consts, unflatten_scalars(iter(entries), closed.in_avals))
        )
        made = [a for a in results if type(a) is str and a not in names]
        instructions, renamed = eliminate_dead_code(own.instructions, made)
        blocks = [i.op for i in instructions if isinstance(i.op, MatrixProduct | Routine)]
        if (
            len(instructions) <= MIN_ROUTINE_INSTRUCTIONS
            and len(blocks) < MIN_ROUTINE_PRODUCTS
            and not any(isinstance(op, Routine) for op in blocks)
        ):
            return None
        used = list(dict.fromkeys(a for i in instructions for a in i.args if type(a) is str and a[0] == "x"))
        given = tuple(names[a] if a in names else tuple(names.get(e, (e,)) for e in around.tables[a]) for a in used)
        program = Program((tuple(used),), instructions, (tuple(renamed[a] for a in made),), ((len(made),),))
        said = tuple((names[a],) if a in names else None if type(a) is str else a for a in results)
        return cls(Routine(program), given, said)

    def emit_call(self, b: Builder, scalars: Sequence[Scalar], closed: ClosedJaxpr) -> list[np.ndarray]:
        def argument(i) -> Scalar:
            if isinstance(i, int):
                return scalars[i]
            return b.table([scalars[j] if isinstance(j, int) else j[0] for j in i])

        found, entries = iter(b.emit_block(self.routine, *map(argument, self.argument_sources))), list[Scalar]()
        for kind, a in zip(scalar_kinds(closed.out_avals), self.result_sources, strict=True):
            known = scalars[a[0]] if isinstance(a, tuple) else a
            entries.append(_convert_to_kind(b, kind, next(found)) if known is None else known)
        return unflatten_scalars(iter(entries), closed.out_avals)


def _convert_to_kind(b: Builder, kind: str, a: Scalar) -> Scalar:
    """A number as what it was before it was handed over."""
    return a if kind == "f" else b.op("ne", a, 0.0) if kind == "b" else b.op("truncate", a)
