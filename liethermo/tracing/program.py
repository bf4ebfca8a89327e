"""Scalar programs: instructions in order, among them calls and loops, which have several results."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .builder import Block, Instruction, Scalar, implementation
from .calls import MatrixProduct


@dataclass(frozen=True)
class Program:
    """Scalar instructions in order, each variable assigned once.

    Attributes
    ----------
    inputs : tuple of tuple of str
        Names of the entries of each input array, in row-major order.
    instructions : tuple of Instruction
    outputs : tuple of tuple of scalars
        For each output array its entries: names, or numbers where they are constant.
    shapes : tuple of tuple of int
        Shapes of the output arrays.
    """

    inputs: tuple[tuple[str, ...], ...]
    instructions: tuple[Instruction, ...]
    outputs: tuple[tuple[Scalar, ...], ...]
    shapes: tuple[tuple[int, ...], ...]

    @property
    def operation_counts(self) -> Counter[str]:
        """How many instructions there are of each kind."""
        return Counter(str(instruction.op) for instruction in self.instructions)

    @functools.cached_property
    def instruction_count(self) -> int:
        """How many instructions compute something, those inside loops among them: what is moved alone costs little."""
        own = sum(i.op not in ("item", "column", "table") for i in self.instructions)
        blocks = (i.op for i in self.instructions if isinstance(i.op, Block))
        return own + sum(program.instruction_count for block in blocks for program in block.inner_programs)

    def evaluate(self, *arrays, batch: bool = False) -> list[np.ndarray]:
        """The outputs for given input arrays, interpreted with NumPy: nothing is compiled.

        With ``batch`` inputs and outputs have one axis more in front, the same for all.
        """
        given, front = [], ()
        for names, x in zip(self.inputs, arrays, strict=True):
            x = np.asarray(x, dtype=np.float64)
            if batch:
                front = x.shape[:1]
                x = x.reshape(*front, len(names)).T
            given.append(x if batch else x.ravel())

        def assemble_output(entries, shape):
            found = np.empty((*front, len(entries)))
            for i, a in enumerate(entries):
                found[..., i] = a
            return found.reshape((*front, *shape))

        return [assemble_output(entries, shape) for entries, shape in zip(self.run(*given), self.shapes, strict=True)]

    def run(self, *given: Sequence) -> list[list]:
        """The entries of the outputs for those of the inputs: numbers, or arrays of them for many points at once."""
        places, start, instructions, results = self._interpretation_plan
        values = start.copy()
        for own, entries in zip(places, given, strict=True):
            for place, entry in zip(own, entries, strict=True):
                values[place] = entry
        with np.errstate(all="ignore"):
            for function, target, args in instructions:
                values[target] = function(*[values[a] for a in args])
        return [[values[place] for place in own] for own in results]

    @functools.cached_property
    def _interpretation_plan(
        self,
    ) -> tuple[list[list[int]], list, list[tuple[Callable, int, list[int]]], list[list[int]]]:
        """How it is interpreted: the places of inputs, what is at each place at the start, instructions, and results.

        A place is free again after its value is read for the last time. So arrays of many points stay in fast memory.
        """
        last = {a: i for i, instruction in enumerate(self.instructions) for a in instruction.args if type(a) is str}
        last.update((a, len(self.instructions)) for entries in self.outputs for a in entries if type(a) is str)
        places: dict[str, int] = {}
        start: list = []
        free: list[int] = []

        def place(value=None) -> int:
            start.append(value)
            return len(start) - 1

        def read(args) -> list[int]:
            return [places[a] if type(a) is str else place(a) for a in args]

        places.update((name, place()) for names in self.inputs for name in names)
        inputs, instructions = [read(names) for names in self.inputs], []
        for i, (target, op, args) in enumerate(self.instructions):
            own = read(args)
            free += [places[a] for a in set(args) if type(a) is str and last[a] == i]
            places[target] = free.pop() if free else place()
            instructions.append((implementation(op), places[target], own))
            if target not in last:
                free.append(places[target])
        return inputs, start, instructions, [read(entries) for entries in self.outputs]

    def degree(self, place: int) -> float:
        """Degree of the outputs as polynomials in an input array; infinity where they are not written as such.

        Parameters
        ----------
        place : int
            Of the input.
        """
        return self._propagate_degrees(dict.fromkeys(self.inputs[place], 1))

    def _propagate_degrees(self, degrees: dict[Scalar, float]) -> float:
        """Where those of some of the inputs are known, and the others count for nothing."""
        for target, op, args in self.instructions:
            found = [degrees.get(a, 0) for a in args]
            if op in ("add", "sub", "neg", "table", "item", "column"):
                degrees[target] = max(found)
            elif op == "mul" or isinstance(op, MatrixProduct):
                degrees[target] = sum(found)
            elif isinstance(op, Routine):
                degrees[target] = op.program._propagate_degrees(dict(zip(op.program.inputs[0], found, strict=True)))
            elif op == "div" and not found[1]:
                degrees[target] = found[0]
            else:
                degrees[target] = math.inf if any(found) else 0
        return max((degrees.get(a, 0) for entries in self.outputs for a in entries), default=0)

    def factor_constants(self, varying: Sequence[int]) -> Program:
        """The same, with products ``(v a) b`` written ``v (a b)`` where a and b do not depend on some of the inputs.

        In a loop over those, ``a b`` is then computed once.

        Parameters
        ----------
        varying : sequence of int
            Places of those inputs.
        """
        depends: set[Scalar] = {name for i in varying for name in self.inputs[i]}
        products: dict[Scalar, tuple[Scalar, Scalar]] = {}
        factors: dict[tuple[Scalar, Scalar], str] = {}
        instructions: list[Instruction] = []
        for instruction in self.instructions:
            changing = [a for a in instruction.args if a in depends]
            if changing:
                depends.add(instruction.target)
            if instruction.op == "mul" and len(changing) == 1:
                first, second = instruction.args
                v, b = (first, second) if first in depends else (second, first)
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
    """``while test(constants, carried): carried = body(constants, carried)``.

    Its arguments are the constants, then what is carried at the start; its results what is carried at the end. Where
    there are several lanes, those whose test has failed wait, unchanged, for the others.

    Attributes
    ----------
    test, body : Program
        Of the two arrays; the first has one truth value as its result.
    kinds : tuple of str
        Of what is carried.
    """

    test: Program
    body: Program
    kinds: tuple[str, ...]
    name: str = field(default="while", repr=False)

    @property
    def inner_programs(self) -> tuple[Program, ...]:  # type: ignore[override]
        return self.test, self.body

    def __call__(self, *args) -> list:
        fixed = len(self.test.inputs[0])
        constants, carried = args[:fixed], list(args[fixed:])
        while True:
            ((going,),) = self.test.run(constants, carried)
            if not np.any(going):
                return carried
            (new,) = self.body.run(constants, carried)
            carried = [np.where(going, after, before)[()] for after, before in zip(new, carried, strict=True)]


@dataclass(frozen=True, eq=False)
class ScanLoop(Block):
    """``carried, stacked[i] = body(constants, carried, [table[i] for table in tables])`` for every i.

    Its arguments are the constants, what is carried at the start, and the tables; its results what is carried at the
    end, and the stacked tables, one after another.

    Attributes
    ----------
    length : int
    reverse : bool
        Whether the last i is the first.
    body : Program
        Of three arrays, with two as its results.
    carry_kinds, stacked_kinds : tuple of str
        The kinds of what is carried, and of what is in a row of each stacked table.
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
    def kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.carry_kinds + tuple(kind for kind in self.stacked_kinds for _ in range(self.length))

    def __call__(self, *args) -> list:
        fixed = len(self.body.inputs[0])
        start = fixed + len(self.carry_kinds)
        constants, carried, tables = args[:fixed], list(args[fixed:start]), args[start:]
        stacked: list[list] = [[None] * self.length for _ in self.stacked_kinds]
        for i in range(self.length)[::-1] if self.reverse else range(self.length):
            carried, row = self.body.run(constants, carried, [table[i] for table in tables])
            for column, value in zip(stacked, row, strict=True):
                column[i] = value
        return carried + [a for column in stacked for a in column]


@dataclass(frozen=True, eq=False)
class Routine(Block):
    """A program that is written once and called wherever it is needed.

    Attributes
    ----------
    program : Program
        Of one array of numbers, with another as its result.
    """

    program: Program
    name: str = field(default="routine", repr=False)

    @property
    def kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("f",) * len(self.program.outputs[0])

    def __call__(self, *args) -> list:
        return self.program.run(args)[0]


# -- what follows from instructions -----------------------------------------------------------------------------------


def eliminate_dead_code(
    instructions: Sequence[Instruction], results: Sequence[Scalar]
) -> tuple[tuple[Instruction, ...], dict[Scalar, str]]:
    """The instructions that results depend on, each as late as its first use allows, and their new names.

    Computing a value just before it is used keeps few alive at a time: registers are scarce.
    """
    defined: dict[Scalar, Instruction] = {instruction.target: instruction for instruction in instructions}
    order: list[Instruction] = []
    renamed: dict[Scalar, str] = {}
    for result in results:
        stack = [result]
        while stack:
            instruction = defined.get(stack[-1])
            if instruction is None or instruction.target in renamed:
                stack.pop()
            elif missing := [a for a in instruction.args if a in defined and a not in renamed]:
                stack.extend(reversed(missing))
            else:
                args = tuple(renamed.get(a, a) if type(a) is str else a for a in instruction.args)
                renamed[stack.pop()] = f"t{len(order)}"
                order.append(Instruction(f"t{len(order)}", instruction.op, args))
    return tuple(order), renamed
