"""Functions with products of matrices, such as networks, as routines that are written once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from .builder import Around, Builder, Scalar
from .calls import Product
from .complex_numbers import arranged, flat, kinds
from .primitives import OF_HELD
from .program import Program, Routine, live

FEW = 2
"""Products of matrices as loops from which a function is worth a routine."""


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
    b: Builder, unroll: Callable, closed: ClosedJaxpr, arguments: Sequence[np.ndarray], avals: Sequence, made: Sequence
) -> list[np.ndarray] | None:
    """The results of a function with products of matrices, such as a network, by a routine; None where it is short.

    Calls of one function, jitted, have one routine, whatever is known of the numbers that they hand over. Matrices
    that lie in memory as they are given, such as weights, stay there.

    Parameters
    ----------
    unroll : function
        What unrolls a jaxpr: that of :mod:`.scalarize`.
    avals, made : sequence
        The types of the arguments, and of the results.
    """
    kept = [x.ndim > 1 and b.given(x.ravel().tolist()) is not None for x in arguments]
    scalars = flat(arguments)
    known = [a if type(a) in (int, bool) else None for a in scalars]
    places = [tuple(b.given(x.ravel().tolist()) or ()) if held else () for x, held in zip(arguments, kept, strict=True)]
    key = (id(closed), tuple(places), tuple(known))
    if key not in b.routines:
        b.routines[key] = closed, _Once.of(b, unroll, closed, arguments, avals, made, kept)
    once = b.routines[key][1]
    return None if once is None else once.called(b, scalars, made)


@dataclass(frozen=True)
class _Once:
    """A function as a routine.

    Attributes
    ----------
    routine : Routine
    given : tuple of (int or tuple of int)
        What the routine is given: the places, among all entries of the arguments, of a number, or of those of a table.
    results : tuple of (str, scalar)
        For each entry of the results ``"result"`` and its place among those of the routine, ``"argument"`` and its
        place among the entries of the arguments, or ``"number"`` and the number that it is.
    """

    routine: Routine
    given: tuple[int | tuple[int, ...], ...]
    results: tuple[tuple[str, Any], ...]

    @classmethod
    def of(cls, b, unroll, closed, arguments, avals, made, kept) -> _Once | None:
        names: dict[str, int] = {}  # inside, and where they are among the arguments
        around = Around(b)
        own, entered, count = Builder(b.limit, around), [], 0
        for x, aval, is_held in zip(arguments, avals, kept, strict=True):
            entries: list[Scalar] = []
            for kind, a in zip(kinds([aval]), flat([x]), strict=True):
                if type(a) in (str, float):
                    name = around.enter(a) if is_held else f"x1_{count}"
                    names.setdefault(name, count)
                    a = _of_kind(own, kind, name)
                entries.append(a)
                count += 1
            entered += arranged(iter(entries), [aval])
        results = flat(unroll(own, closed.jaxpr, closed.consts, entered))
        if sum(isinstance(i.op, Product) for i in own.instructions) < FEW and not any(
            isinstance(i.op, Routine) for i in own.instructions
        ):
            return None
        computed: list[Scalar] = list(dict.fromkeys(a for a in results if type(a) is str and a not in names))
        instructions, renamed = live(own.instructions, computed)
        used = list(dict.fromkeys(str(a) for i in instructions for a in i.args if type(a) is str and a[0] == "x"))
        program = Program((tuple(used),), instructions, (tuple(renamed[a] for a in computed),), ((len(computed),),))
        given = tuple(
            names[a] if a in names else tuple(names.get(entry, (entry,)) for entry in around.tables[a]) for a in used
        )
        order = {a: i for i, a in enumerate(computed)}
        said = tuple(
            ("number", a) if type(a) is not str else ("argument", names[a]) if a in names else ("result", order[a])
            for a in results
        )
        return cls(Routine(program), given, said)

    def called(self, b: Builder, scalars: Sequence[Scalar], made) -> list[np.ndarray]:
        args = [
            scalars[i] if isinstance(i, int) else b.table([scalars[j] if isinstance(j, int) else j[0] for j in i])
            for i in self.given
        ]
        found, entries = b.block(self.routine, *args), []
        for kind, (what, a) in zip(kinds(made), self.results, strict=True):
            if what == "result":
                a = _of_kind(b, kind, found[a])
            entries.append(scalars[a] if what == "argument" else a)
        return arranged(iter(entries), made)


def _of_kind(b: Builder, kind: str, a: Scalar) -> Scalar:
    """A number as what it was before it was handed over."""
    return a if kind == "f" else b.op("ne", a, 0.0) if kind == "b" else b.op("truncate", a)
