"""Functions that become routines, written once and called: long ones, and those with products of matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jax.extend.core import ClosedJaxpr

from .builder import EnclosingScope, ProgramBuilder, Scalar
from .caching import LRUCache
from .calls import MatrixProduct
from .complex_numbers import flatten_scalars, real_scalar_kinds, unflatten_scalars
from .program import Program, Routine, eliminate_dead_code_and_rename

MIN_ROUTINE_PRODUCTS = 2
"""Smallest number of products of matrices, as loops, for which a function becomes a routine."""

MIN_ROUTINE_INSTRUCTIONS = 500
"""Number of instructions above which a function becomes a routine."""

_routine_cache: LRUCache[tuple] = LRUCache(256)


def call_routine_or_unroll(
    builder: ProgramBuilder, unroll: Callable, closed_jaxpr: ClosedJaxpr, arguments: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the results of a function, computed by a routine if it is long enough, and unrolled otherwise.

    Calls of one jitted function share one routine, whatever constants they pass. Matrices that are inputs of the
    program, such as weights, are read in place.

    Parameters
    ----------
    unroll : function
        Unrolls a jaxpr: :func:`.scalarize._unroll_jaxpr`.
    """
    scalars = flatten_scalars(arguments)
    input_positions = [builder.input_positions_or_none(x.ravel().tolist()) if x.ndim > 1 else None for x in arguments]
    integer_values = [a if type(a) in (int, bool) else None for a in scalars]
    key = (
        id(closed_jaxpr),
        tuple(None if positions is None else tuple(positions) for positions in input_positions),
        tuple(map(repr, integer_values)),
    )
    # the entry holds the jaxpr, so that no other object takes its id
    routine_call = _routine_cache.get_or_compute(
        key,
        lambda: (closed_jaxpr, _RoutineCall.build_or_none(builder, unroll, closed_jaxpr, arguments, input_positions)),
    )[1]
    return (
        unroll(builder, closed_jaxpr.jaxpr, closed_jaxpr.consts, arguments)
        if routine_call is None
        else routine_call.emit_call(builder, scalars, closed_jaxpr)
    )


@dataclass(frozen=True)
class _RoutineCall:
    """A routine that computes a function, with the origin of the routine's arguments and of the function's results.

    Attributes
    ----------
    routine : Routine
    argument_sources : tuple of (int or tuple)
        For each argument of the routine the index of a scalar among the entries of all arguments; for a table, a tuple
        of such indices, in which ``(number,)`` is a constant.
    result_sources : tuple of (scalar, (int) or None)
        For each entry of the results its constant, or its index among the entries of all arguments in a tuple; None for
        a result of the routine.
    """

    routine: Routine
    argument_sources: tuple[int | tuple[int | tuple[Scalar], ...], ...]
    result_sources: tuple[Scalar | tuple[int] | None, ...]

    @classmethod
    def build_or_none(
        cls, builder: ProgramBuilder, unroll: Callable, closed_jaxpr: ClosedJaxpr, arguments, input_positions: Sequence
    ) -> _RoutineCall | None:
        """Unroll a function into a routine; None if it is too short to become one."""
        scope, argument_indices = EnclosingScope(builder), dict[Scalar, int]()  # index of each inner name
        inner_builder, entries = ProgramBuilder(builder.max_instructions, scope), list[Scalar]()
        for x, aval, positions in zip(arguments, closed_jaxpr.in_avals, input_positions, strict=True):
            for kind, a in zip(real_scalar_kinds([aval]), flatten_scalars([x]), strict=True):
                if type(a) in (str, float):
                    name = f"x1_{len(entries)}" if positions is None else scope.import_scalar(a)
                    argument_indices.setdefault(name, len(entries))
                    a = _convert_to_kind(inner_builder, kind, name)
                entries.append(a)
        results = flatten_scalars(
            unroll(
                inner_builder,
                closed_jaxpr.jaxpr,
                closed_jaxpr.consts,
                unflatten_scalars(iter(entries), closed_jaxpr.in_avals),
            )
        )
        computed_results = [a for a in results if type(a) is str and a not in argument_indices]
        instructions, new_names = eliminate_dead_code_and_rename(inner_builder.instructions, computed_results)
        blocks = [i.op for i in instructions if isinstance(i.op, MatrixProduct | Routine)]
        if (
            len(instructions) <= MIN_ROUTINE_INSTRUCTIONS
            and len(blocks) < MIN_ROUTINE_PRODUCTS
            and not any(isinstance(op, Routine) for op in blocks)
        ):
            return None
        used_names = list(dict.fromkeys(a for i in instructions for a in i.args if type(a) is str and a[0] == "x"))
        argument_sources = tuple(
            argument_indices[a]
            if a in argument_indices
            else tuple(argument_indices.get(e, (e,)) for e in scope.tables[a])
            for a in used_names
        )
        program = Program(
            (tuple(used_names),),
            instructions,
            (tuple(new_names[a] for a in computed_results),),
            ((len(computed_results),),),
        )
        result_sources = tuple(
            (argument_indices[a],) if a in argument_indices else None if type(a) is str else a for a in results
        )
        return cls(Routine(program), argument_sources, result_sources)

    def emit_call(
        self, builder: ProgramBuilder, scalars: Sequence[Scalar], closed_jaxpr: ClosedJaxpr
    ) -> list[np.ndarray]:
        """Emit a call of the routine for the entries of all arguments; return the results of the function."""

        def argument_scalar(source) -> Scalar:
            if isinstance(source, int):
                return scalars[source]
            return builder.make_table([scalars[entry] if isinstance(entry, int) else entry[0] for entry in source])

        results = iter(builder.emit_block(self.routine, *map(argument_scalar, self.argument_sources)))
        entries = list[Scalar]()
        for kind, result_source in zip(real_scalar_kinds(closed_jaxpr.out_avals), self.result_sources, strict=True):
            value = scalars[result_source[0]] if isinstance(result_source, tuple) else result_source
            entries.append(_convert_to_kind(builder, kind, next(results)) if value is None else value)
        return unflatten_scalars(iter(entries), closed_jaxpr.out_avals)


def _convert_to_kind(builder: ProgramBuilder, kind: str, a: Scalar) -> Scalar:
    """Convert a real number, the form in which routines pass values, to a kind: real, truth value or integer."""
    return a if kind == "f" else builder.op("ne", a, 0.0) if kind == "b" else builder.op("truncate", a)
