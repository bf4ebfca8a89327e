"""Scalar programs: instructions in order, some of which are calls and loops with several results."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from .builder import Block, Instruction, Scalar, implementation
from .calls import MatrixProduct


class _InterpretationPlan(NamedTuple):
    """The plan by which a program is interpreted: instructions on a list of values, whose indices are called slots.

    Attributes
    ----------
    input_slots, output_slots : list of list of int
        Slots of the entries of each input, and of each output.
    initial_values : list
        Value of each slot at the start; None except for constants.
    instructions : list of (function, int, list of int)
        The function, the slot of its result, and the slots of its arguments.
    """

    input_slots: list[list[int]]
    initial_values: list
    instructions: list[tuple[Callable, int, list[int]]]
    output_slots: list[list[int]]


@dataclass(frozen=True)
class Program:
    """A scalar program: instructions in order, each of which assigns one new variable.

    Attributes
    ----------
    inputs : tuple of tuple of str
        Names of the entries of each input array, in row-major order.
    instructions : tuple of Instruction
    outputs : tuple of tuple of scalars
        Entries of each output array: names, or numbers if they are constant.
    shapes : tuple of tuple of int
        Shapes of the output arrays.
    """

    inputs: tuple[tuple[str, ...], ...]
    instructions: tuple[Instruction, ...]
    outputs: tuple[tuple[Scalar, ...], ...]
    shapes: tuple[tuple[int, ...], ...]

    @property
    def operation_counts(self) -> Counter[str]:
        """Number of instructions of each kind."""
        return Counter(str(instruction.op) for instruction in self.instructions)

    @functools.cached_property
    def instruction_count(self) -> int:
        """Number of instructions that compute something, those inside loops included; moving data costs little."""
        count = sum(i.op not in ("item", "column", "table") for i in self.instructions)
        blocks = (i.op for i in self.instructions if isinstance(i.op, Block))
        return count + sum(program.instruction_count for block in blocks for program in block.inner_programs)

    def evaluate(self, *arrays, batch: bool = False) -> list[np.ndarray]:
        """Return the output arrays for these input arrays, computed with NumPy, without compiling.

        With ``batch``, inputs and outputs have one more leading axis, of equal length for all.
        """
        values, batch_shape = [], ()
        for names, x in zip(self.inputs, arrays, strict=True):
            x = np.asarray(x, dtype=np.float64)
            if batch:
                batch_shape = x.shape[:1]
                x = x.reshape(*batch_shape, len(names)).T
            values.append(x if batch else x.ravel())

        def assemble_output(entries, shape):
            array = np.empty((*batch_shape, len(entries)))
            for i, a in enumerate(entries):
                array[..., i] = a
            return array.reshape((*batch_shape, *shape))

        return [
            assemble_output(entries, shape)
            for entries, shape in zip(self.evaluate_entries(*values), self.shapes, strict=True)
        ]

    def evaluate_entries(self, *input_entries: Sequence) -> list[list]:
        """Return a list of entries for each output from a sequence of entries for each input, computed with NumPy.

        An entry is a number, or an array over many points.
        """
        plan = self._interpretation_plan
        values = plan.initial_values.copy()
        for slots, entries in zip(plan.input_slots, input_entries, strict=True):
            for slot, entry in zip(slots, entries, strict=True):
                values[slot] = entry
        with np.errstate(all="ignore"):
            for function, target, args in plan.instructions:
                values[target] = function(*[values[a] for a in args])
        return [[values[slot] for slot in slots] for slots in plan.output_slots]

    @functools.cached_property
    def _interpretation_plan(self) -> _InterpretationPlan:
        """Plan by which NumPy interprets the program.

        A slot is reused after its value is read for the last time, so arrays of many points stay in the processor's
        cache.
        """
        last_use = {a: i for i, instruction in enumerate(self.instructions) for a in instruction.args if type(a) is str}
        last_use.update((a, len(self.instructions)) for entries in self.outputs for a in entries if type(a) is str)
        slots: dict[str, int] = {}
        initial_values: list = []
        free_slots: list[int] = []

        def new_slot(value=None) -> int:
            initial_values.append(value)
            return len(initial_values) - 1

        def assign_slots(scalars) -> list[int]:
            return [slots[a] if type(a) is str else new_slot(a) for a in scalars]

        slots.update((name, new_slot()) for names in self.inputs for name in names)
        input_slots, instructions = [assign_slots(names) for names in self.inputs], []
        for i, (target, op, args) in enumerate(self.instructions):
            argument_slots = assign_slots(args)
            free_slots += [slots[a] for a in set(args) if type(a) is str and last_use[a] == i]
            slots[target] = free_slots.pop() if free_slots else new_slot()
            instructions.append((implementation(op), slots[target], argument_slots))
            if target not in last_use:
                free_slots.append(slots[target])
        output_slots = [assign_slots(entries) for entries in self.outputs]
        return _InterpretationPlan(input_slots, initial_values, instructions, output_slots)

    def degree_bound(self, input_index: int) -> float:
        """Return an upper bound of the degree of the outputs as polynomials in one input array, or infinity.

        Parameters
        ----------
        input_index : int
            Index of the input array.
        """
        return self._propagate_degrees(dict.fromkeys(self.inputs[input_index], 1))

    def _propagate_degrees(self, degrees: dict[Scalar, float]) -> float:
        """Add the degree of each instruction to ``degrees``, given those of inputs; return the largest of an output."""
        for target, op, args in self.instructions:
            argument_degrees = [degrees.get(a, 0) for a in args]
            if op in ("add", "sub", "neg", "table", "item", "column"):
                degrees[target] = max(argument_degrees)
            elif op == "mul" or isinstance(op, MatrixProduct):
                degrees[target] = sum(argument_degrees)
            elif isinstance(op, Routine):
                degrees[target] = op.program._propagate_degrees(
                    dict(zip(op.program.inputs[0], argument_degrees, strict=True))
                )
            elif op == "div" and not argument_degrees[1]:
                degrees[target] = argument_degrees[0]
            else:
                degrees[target] = math.inf if any(argument_degrees) else 0
        return max((degrees.get(a, 0) for entries in self.outputs for a in entries), default=0)

    def regroup_constant_factors(self, varying_inputs: Sequence[int]) -> Program:
        """Return an equivalent program that multiplies constant factors first: ``(v a) b`` becomes ``v (a b)``.

        A loop that changes only these inputs then computes ``a b`` once.

        Parameters
        ----------
        varying_inputs : sequence of int
            Indices of these inputs.
        """
        dependent: set[Scalar] = {name for i in varying_inputs for name in self.inputs[i]}
        products: dict[Scalar, tuple[Scalar, Scalar]] = {}
        factors: dict[tuple[Scalar, Scalar], str] = {}
        instructions: list[Instruction] = []
        for instruction in self.instructions:
            varying_args = [a for a in instruction.args if a in dependent]
            if varying_args:
                dependent.add(instruction.target)
            if instruction.op == "mul" and len(varying_args) == 1:
                lhs, rhs = instruction.args
                v, b = (lhs, rhs) if lhs in dependent else (rhs, lhs)
                if v in products:
                    v, a = products[v]
                    if (a, b) not in factors:
                        factors[a, b] = f"{instruction.target}_factor"
                        instructions.append(Instruction(factors[a, b], "mul", (a, b)))
                    b = factors[a, b]
                products[instruction.target] = v, b
                instruction = instruction._replace(args=(v, b))
            instructions.append(instruction)
        return replace(self, instructions=tuple(instructions))


@dataclass(frozen=True, eq=False)
class WhileLoop(Block):
    """The loop ``while test(constants, carry): carry = body(constants, carry)``.

    Its arguments are the constants, then the initial carry; its results are the final carry. In a batch of lanes, a
    lane whose test has failed keeps its values until all lanes have ended.

    Attributes
    ----------
    test, body : Program
        Programs of the two arrays; the result of ``test`` is one truth value.
    result_kinds : tuple of str
        Kinds of the carry.
    """

    test: Program
    body: Program
    result_kinds: tuple[str, ...]
    name: str = field(default="while", repr=False)

    @property
    def inner_programs(self) -> tuple[Program, ...]:  # type: ignore[override]
        return self.test, self.body

    def __call__(self, *args) -> list:
        n_constants = len(self.test.inputs[0])
        constants, carry = args[:n_constants], list(args[n_constants:])
        while True:
            ((is_running,),) = self.test.evaluate_entries(constants, carry)
            if not np.any(is_running):
                return carry
            (next_carry,) = self.body.evaluate_entries(constants, carry)
            carry = [
                np.where(is_running, new_value, old_value)[()]
                for new_value, old_value in zip(next_carry, carry, strict=True)
            ]


@dataclass(frozen=True, eq=False)
class ScanLoop(Block):
    """The loop ``carry, stacked[i] = body(constants, carry, [table[i] for table in tables])`` for every i.

    Its arguments are the constants, the initial carry and the tables. Its results are the final carry, then the stacked
    tables one after another.

    Attributes
    ----------
    length : int
    reverse : bool
        Whether the loop runs from the last i to the first.
    body : Program
        Program of three arrays with two results.
    carry_kinds, stacked_kinds : tuple of str
        Kinds of the carry, and of the entries in a row of the stacked tables.
    """

    length: int
    reverse: bool
    body: Program
    carry_kinds: tuple[str, ...]
    stacked_kinds: tuple[str, ...]
    name: str = field(default="scan", repr=False)

    @property
    def inner_programs(self) -> tuple[Program, ...]:  # type: ignore[override]
        return (self.body,)

    @property
    def result_kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.carry_kinds + tuple(kind for kind in self.stacked_kinds for _ in range(self.length))

    def __call__(self, *args) -> list:
        n_constants = len(self.body.inputs[0])
        table_start = n_constants + len(self.carry_kinds)
        constants, carry, tables = args[:n_constants], list(args[n_constants:table_start]), args[table_start:]
        columns: list[list] = [[None] * self.length for _ in self.stacked_kinds]
        for i in range(self.length)[::-1] if self.reverse else range(self.length):
            carry, row = self.body.evaluate_entries(constants, carry, [table[i] for table in tables])
            for column, value in zip(columns, row, strict=True):
                column[i] = value
        return carry + [a for column in columns for a in column]


@dataclass(frozen=True, eq=False)
class Routine(Block):
    """A program that is written once and called from several places.

    Attributes
    ----------
    program : Program
        Program of one array of real numbers, with one array as its result.
    """

    program: Program
    name: str = field(default="routine", repr=False)

    @property
    def result_kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("f",) * len(self.program.outputs[0])

    def __call__(self, *args) -> list:
        return self.program.evaluate_entries(args)[0]


# -- dead code --------------------------------------------------------------------------------------------------------


def eliminate_dead_code_and_rename(
    instructions: Sequence[Instruction], results: Sequence[Scalar]
) -> tuple[tuple[Instruction, ...], dict[Scalar, str]]:
    """Drop the instructions that the results do not need; return the others, renamed, and their new names by old name.

    Each instruction is as late as its first use allows: a value that is computed just before its use
    occupies a register for a short time.
    """
    definitions: dict[Scalar, Instruction] = {instruction.target: instruction for instruction in instructions}
    order: list[Instruction] = []
    new_names: dict[Scalar, str] = {}
    for result in results:
        stack = [result]
        while stack:
            instruction = definitions.get(stack[-1])
            if instruction is None or instruction.target in new_names:
                stack.pop()
            elif pending := [a for a in instruction.args if a in definitions and a not in new_names]:
                stack.extend(reversed(pending))
            else:
                args = tuple(new_names.get(a, a) if type(a) is str else a for a in instruction.args)
                new_names[stack.pop()] = f"t{len(order)}"
                order.append(Instruction(f"t{len(order)}", instruction.op, args))
    return tuple(order), new_names
