"""Move the instructions that only one side of a branch needs into that side, so that they can be jumped over.

A scalar program computes both sides of every ``lax.cond`` and then selects one, which is right wherever it runs. The
writer of machine code calls :func:`sink_instructions_into_branches` to move the instructions of one side behind a jump.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

from .builder import Block, Instruction
from .program import Program

MIN_BRANCH_COST = 32
"""Smallest cost of a side, in instructions, for which a jump is emitted; a jump costs more than a shorter side."""

COSTLY_OPERATIONS = frozenset("exp exp2 expm1 log log1p pow cbrt sin cos tan asin acos atan atan2".split()) | frozenset(
    "sinh cosh tanh asinh acosh atanh erf erfc rem".split()
)
"""Operations whose cost counts as :data:`MIN_BRANCH_COST` instructions."""

Guard: TypeAlias = tuple[tuple[str, bool], ...]
"""Nested branches, each with its side: an instruction with this guard is needed on these sides only."""


class Branch(NamedTuple):
    """A branch of a program: its condition, the instructions of both sides, and the selections between them.

    Attributes
    ----------
    test : Instruction
        The instruction that computes the condition.
    sides : tuple of list
        The instructions and branches that are needed if the condition is true, and those that are needed if it is
        false.
    choices : list of Instruction
        The ``select`` instructions that choose between the two sides by this test.
    """

    test: Instruction
    sides: tuple[list[Instruction | Branch], list[Instruction | Branch]]
    choices: list[Instruction]


def sink_instructions_into_branches(
    program: Program, min_side_cost: int = MIN_BRANCH_COST
) -> list[Instruction | Branch]:
    """Move the instructions that only one side of a branch needs into that side; return all in order of evaluation.

    Parameters
    ----------
    program : Program
    min_side_cost : int
        Smallest cost of a side, in instructions. A cheaper side is computed before the choice.
    """
    tests = {instruction.target for instruction in program.instructions if instruction.op == "branch"}
    if not tests:
        return list(program.instructions)
    guards = _enclosing_branches_by_target(program, tests)
    costs = Counter[Guard]()
    for instruction in program.instructions:
        guard = guards[instruction.target]
        for depth in range(1, len(guard) + 1):
            costs[guard[:depth]] += (
                MIN_BRANCH_COST if instruction.op in COSTLY_OPERATIONS or isinstance(instruction.op, Block) else 1
            )
    for target, guard in guards.items():
        while guard and costs[guard] < min_side_cost:
            guard = guard[:-1]
        guards[target] = guard
    return _nested_topological_order(program.instructions, guards, 0)


def _enclosing_branches_by_target(program: Program, branch_names: set[str]) -> dict[str, Guard]:
    """Return the branches that have to enclose each instruction (its guard), by the name that the instruction defines.

    All ``select`` instructions of a branch stand together, so each has the common prefix of their guards. This moves
    their arguments, and with these other choices; the pass is repeated until the guards no longer change.
    """
    choice_guards: dict[str, Guard] = {}
    while True:
        guards: dict[str, Guard] = {a: () for entries in program.outputs for a in entries if isinstance(a, str)}
        new_choice_guards: dict[str, Guard] = {}
        for target, op, args in reversed(program.instructions):
            guard = guards.setdefault(target, ())
            test = args[0] if op == "select" and args[0] in branch_names else None
            if isinstance(test, str):
                new_choice_guards[test] = _common_prefix(new_choice_guards.get(test, guard), guard)
                guard = guards[target] = _common_prefix(choice_guards.get(test, guard), guard)
            for argument_index, a in enumerate(args):
                if isinstance(a, str):
                    argument_guard = (
                        (*guard, (test, argument_index == 1)) if isinstance(test, str) and argument_index else guard
                    )
                    guards[a] = _common_prefix(guards.get(a, argument_guard), argument_guard)
        if new_choice_guards == choice_guards:
            return {instruction.target: guards[instruction.target] for instruction in program.instructions}
        choice_guards = new_choice_guards


def _common_prefix(a: Guard, b: Guard) -> Guard:
    """Return the leading branches that two guards have in common."""
    depth = 0
    while depth < min(len(a), len(b)) and a[depth] == b[depth]:
        depth += 1
    return a[:depth]


def _nested_topological_order(
    instructions: Sequence[Instruction], guards: dict[str, Guard], depth: int
) -> list[Instruction | Branch]:
    """Order instructions so that each follows its arguments, nested into branches below the first ``depth`` ones.

    The instructions share their first ``depth`` enclosing branches.
    """
    inner_tests = {guards[i.target][depth][0] for i in instructions if len(guards[i.target]) > depth}
    group_names: dict[str, str] = {}  # by target: the test of its branch, or the target
    groups: dict[str, list[Instruction]] = {}
    for i in instructions:
        guard = guards[i.target]
        test = guard[depth][0] if len(guard) > depth else i.args[0] if i.op == "select" else None
        group_names[i.target] = test if isinstance(test, str) and test in inner_tests else i.target
        groups.setdefault(group_names[i.target], []).append(i)

    order: dict[str, None] = {}
    for name in groups:
        stack = [name]
        while stack:
            group = stack[-1]
            dependencies = (
                group_names[a] for i in groups[group] for a in i.args if isinstance(a, str) and a in group_names
            )
            if missing_groups := [
                dependency for dependency in dependencies if dependency != group and dependency not in order
            ]:
                stack.extend(reversed(missing_groups))
            else:
                order[stack.pop()] = None

    def build_instruction_or_branch(group_name: str) -> Instruction | Branch:
        if group_name not in inner_tests:
            return groups[group_name][0]
        sides: dict[Guard, list[Instruction]] = {((group_name, True),): [], ((group_name, False),): [], (): []}
        for i in groups[group_name]:
            sides[guards[i.target][depth : depth + 1]].append(i)
        true_side, false_side, common_items = sides.values()
        test = next(i for i in common_items if i.target == group_name)
        ordered_sides = (
            _nested_topological_order(true_side, guards, depth + 1),
            _nested_topological_order(false_side, guards, depth + 1),
        )
        return Branch(test, ordered_sides, [i for i in common_items if i is not test])

    return [build_instruction_or_branch(name) for name in order]
