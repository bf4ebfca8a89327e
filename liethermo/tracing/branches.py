"""What of a scalar program is needed only where a test holds, so that it can be jumped over elsewhere.

A program computes both sides of every ``lax.cond`` and then chooses, which is right wherever it runs. Where machine
code is written, this finds what only one side needs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

from .builder import Block, Instruction
from .program import Program

MIN_BRANCH_COST = 32
"""Instructions that are worth a jump."""

COSTLY_OPERATIONS = frozenset("exp exp2 expm1 log log1p pow cbrt sin cos tan asin acos atan atan2".split()) | frozenset(
    "sinh cosh tanh asinh acosh atanh erf erfc rem".split()
)
"""Operations that cost as many as that."""

Guard: TypeAlias = tuple[tuple[str, bool], ...]
"""Branches, one inside another, and the side of each: what has this guard is needed on these sides alone."""


class Branch(NamedTuple):
    """A choice between two sides.

    Attributes
    ----------
    test : Instruction
        Says which one.
    sides : tuple of list
        What is needed where the test holds, and what is needed where it does not: instructions and branches.
    choices : list of Instruction
        ``select`` between the two, all by this test.
    """

    test: Instruction
    sides: tuple[list[Instruction | Branch], list[Instruction | Branch]]
    choices: list[Instruction]


def nest_branches(program: Program, min_instructions: int = MIN_BRANCH_COST) -> list[Instruction | Branch]:
    """The instructions of a program in an order of evaluation, those needed on one side of a branch inside it.

    Parameters
    ----------
    program : Program
    min_instructions : int
        Instructions that a side has at least; a shorter one stands before the choice.
    """
    tests = {instruction.target for instruction in program.instructions if instruction.op == "branch"}
    if not tests:
        return list(program.instructions)
    guards = _guards(program, tests)
    sizes = Counter[Guard]()
    for instruction in program.instructions:
        guard = guards[instruction.target]
        for depth in range(1, len(guard) + 1):
            sizes[guard[:depth]] += (
                MIN_BRANCH_COST if instruction.op in COSTLY_OPERATIONS or isinstance(instruction.op, Block) else 1
            )
    for target, guard in guards.items():
        while guard and sizes[guard] < min_instructions:
            guard = guard[:-1]
        guards[target] = guard
    return _order_by_dependence(program.instructions, guards, 0)


def _guards(program: Program, tests: set[str]) -> dict[str, Guard]:
    """Where each instruction is needed, by these tests.

    The choices of a branch stand together, so all are where any of them is needed. That moves what they depend on, and
    with it other choices: it is repeated until nothing moves.
    """
    together: dict[str, Guard] = {}
    while True:
        guards: dict[str, Guard] = {a: () for entries in program.outputs for a in entries if isinstance(a, str)}
        found: dict[str, Guard] = {}
        for target, op, args in reversed(program.instructions):
            guard = guards.setdefault(target, ())
            test = args[0] if op == "select" and args[0] in tests else None
            if isinstance(test, str):
                found[test] = _common_prefix(found.get(test, guard), guard)
                guard = guards[target] = _common_prefix(together.get(test, guard), guard)
            for place, a in enumerate(args):
                if isinstance(a, str):
                    needed = (*guard, (test, place == 1)) if isinstance(test, str) and place else guard
                    guards[a] = _common_prefix(guards.get(a, needed), needed)
        if found == together:
            return {instruction.target: guards[instruction.target] for instruction in program.instructions}
        together = found


def _common_prefix(one: Guard, other: Guard) -> Guard:
    """The branches that both are in."""
    depth = 0
    while depth < min(len(one), len(other)) and one[depth] == other[depth]:
        depth += 1
    return one[:depth]


def _order_by_dependence(
    instructions: Sequence[Instruction], guards: dict[str, Guard], depth: int
) -> list[Instruction | Branch]:
    """Instructions that are in the same ``depth`` branches, each after what it depends on."""
    inner = {guards[i.target][depth][0] for i in instructions if len(guards[i.target]) > depth}
    place: dict[str, str] = {}  # of each target: a branch by the name of its test, or itself
    parts: dict[str, list[Instruction]] = {}
    for i in instructions:
        guard = guards[i.target]
        test = guard[depth][0] if len(guard) > depth else i.args[0] if i.op == "select" else None
        place[i.target] = test if isinstance(test, str) and test in inner else i.target
        parts.setdefault(place[i.target], []).append(i)

    order: dict[str, None] = {}
    for name in parts:
        stack = [name]
        while stack:
            own = stack[-1]
            needed = (place[a] for i in parts[own] for a in i.args if isinstance(a, str) and a in place)
            if missing := [other for other in needed if other != own and other not in order]:
                stack.extend(reversed(missing))
            else:
                order[stack.pop()] = None

    def item(name: str) -> Instruction | Branch:
        if name not in inner:
            return parts[name][0]
        sides: dict[Guard, list[Instruction]] = {((name, True),): [], ((name, False),): [], (): []}
        for i in parts[name]:
            sides[guards[i.target][depth : depth + 1]].append(i)
        then, otherwise, outside = sides.values()
        test = next(i for i in outside if i.target == name)
        both = _order_by_dependence(then, guards, depth + 1), _order_by_dependence(otherwise, guards, depth + 1)
        return Branch(test, both, [i for i in outside if i is not test])

    return [item(name) for name in order]
