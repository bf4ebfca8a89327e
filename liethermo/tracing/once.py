"""Functions that are written once, as routines: those with products of matrices, such as networks, and long ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jax.extend.core import ClosedJaxpr

from .builder import Around, Builder, Scalar
from .calls import Product
from .complex_numbers import arranged, flat, kinds
from .primitives import OF_HELD
from .program import Program, Routine, live
from .remembered import Latest

FEW, LONG = 2, 500
"""Products of matrices as loops, or instructions, from which a function is worth a routine."""

_routines: Latest[tuple] = Latest(256)


def has_products(jaxpr) -> bool:
    """Whether a product of matrices stands in it that may become a loop."""
    for eqn in jaxpr.eqns:
        inner = eqn.params.get("jaxpr")
        if eqn.primitive.name == "dot_general" and max(math.prod(v.aval.shape) for v in eqn.invars) > OF_HELD:
            return True
        if isinstance(inner, ClosedJaxpr) and has_products(inner.jaxpr):
            return True
    return False


def written_once(
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
    scalars = flat(arguments)
    held = [b.given(x.ravel().tolist()) if x.ndim > 1 else None for x in arguments]
    known = [a if type(a) in (int, bool) else None for a in scalars]
    key = id(closed), tuple(None if place is None else tuple(place) for place in held), tuple(map(repr, known))
    # with the jaxpr, so that no other takes its place
    once = _routines.find(key, lambda: (closed, _Once.of(b, unroll, closed, arguments, held)))[1]
    return unroll(b, closed.jaxpr, closed.consts, arguments) if once is None else once.called(b, scalars, closed)


@dataclass(frozen=True)
class _Once:
    """A function as a routine.

    Attributes
    ----------
    routine : Routine
    given : tuple of (int or tuple)
        What the routine is given: the place, among all entries of the arguments, of a number; or those of what is in a
        table, a number that is known standing for itself, in a tuple.
    results : tuple of (scalar, (int) or None)
        For each entry of the results what it is, where that is known, or in a tuple its place among all entries of the
        arguments; others are those of the routine, in order.
    """

    routine: Routine
    given: tuple[int | tuple[int | tuple[Scalar], ...], ...]
    results: tuple[Scalar | tuple[int] | None, ...]

    @classmethod
    def of(cls, b: Builder, unroll: Callable, closed: ClosedJaxpr, arguments, held: Sequence) -> _Once | None:
        around, names = Around(b), dict[Scalar, int]()  # inside, and where they are among the arguments
        own, entries = Builder(b.limit, around), list[Scalar]()
        for x, aval, place in zip(arguments, closed.in_avals, held, strict=True):
            for kind, a in zip(kinds([aval]), flat([x]), strict=True):
                if type(a) in (str, float):
                    name = f"x1_{len(entries)}" if place is None else around.enter(a)
                    names.setdefault(name, len(entries))
                    a = _of_kind(own, kind, name)
                entries.append(a)
        results = flat(unroll(own, closed.jaxpr, closed.consts, arranged(iter(entries), closed.in_avals)))
        made = [a for a in results if type(a) is str and a not in names]
        instructions, renamed = live(own.instructions, made)
        blocks = [i.op for i in instructions if isinstance(i.op, Product | Routine)]
        if len(instructions) <= LONG and len(blocks) < FEW and not any(isinstance(op, Routine) for op in blocks):
            return None
        used = list(dict.fromkeys(a for i in instructions for a in i.args if type(a) is str and a[0] == "x"))
        given = tuple(names[a] if a in names else tuple(names.get(e, (e,)) for e in around.tables[a]) for a in used)
        program = Program((tuple(used),), instructions, (tuple(renamed[a] for a in made),), ((len(made),),))
        said = tuple((names[a],) if a in names else None if type(a) is str else a for a in results)
        return cls(Routine(program), given, said)

    def called(self, b: Builder, scalars: Sequence[Scalar], closed: ClosedJaxpr) -> list[np.ndarray]:
        def handed(i) -> Scalar:
            if isinstance(i, int):
                return scalars[i]
            return b.table([scalars[j] if isinstance(j, int) else j[0] for j in i])

        found, entries = iter(b.block(self.routine, *map(handed, self.given))), list[Scalar]()
        for kind, a in zip(kinds(closed.out_avals), self.results, strict=True):
            known = scalars[a[0]] if isinstance(a, tuple) else a
            entries.append(_of_kind(b, kind, next(found)) if known is None else known)
        return arranged(iter(entries), closed.out_avals)


def _of_kind(b: Builder, kind: str, a: Scalar) -> Scalar:
    """A number as what it was before it was handed over."""
    return a if kind == "f" else b.op("ne", a, 0.0) if kind == "b" else b.op("truncate", a)
