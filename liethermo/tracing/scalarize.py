"""From a traced JAX function of small arrays to a straight-line program of scalar instructions.

The jaxpr, derivatives included, is unrolled entry by entry. What is known at compile time is computed then, structural
zeros vanish, equal subexpressions merge and dead ones are dropped, so an ``einsum`` with structure constants becomes
the few products that it stands for. The result is the same to rounding as JAX's, or there is none.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from ..errors import InputError, LiethermoError
from .builder import (
    OF_TESTS,
    OPERATIONS,
    TESTS,
    Builder,
    Instruction,
    LimitExceededError,
    Scalar,
    array,
    constant,
)
from .primitives import PARAMETERS, RULES

LIMIT = 200_000
"""Instructions that a program may have: far more than compile in reasonable time."""

UNKNOWN = "of unknown origin"


class UnsupportedPrimitive(LiethermoError):
    """A function that cannot be unrolled.

    Attributes
    ----------
    primitive : str
        The JAX primitive in the way.
    where : str
        The line of the user's code that called for it, as far as JAX knows.
    reason : str
        What about it is not supported, where it is not the primitive as such.
    too_large : bool
        Whether the program is only too long to be unrolled.
    """

    def __init__(self, primitive: str, where: str, reason: str = "", too_large: bool = False):
        self.primitive, self.where, self.reason, self.too_large = primitive, where, reason, too_large
        refusal = f"the compiled engine cannot run the JAX primitive {primitive!r} {reason}".rstrip()
        super().__init__(f"{refusal} ({where})")


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
    def operations(self) -> Counter[str]:
        """How many instructions there are of each kind."""
        return Counter(instruction.op for instruction in self.instructions)

    def evaluate(self, *arrays, batch: bool = False) -> list[np.ndarray]:
        """The outputs for given input arrays, interpreted with NumPy: nothing is compiled.

        With ``batch`` inputs and outputs have one axis more in front, the same for all.
        """
        values: dict[Scalar, Any] = {}
        front: tuple[int, ...] = ()
        for names, x in zip(self.inputs, arrays, strict=True):
            x = np.asarray(x, dtype=np.float64)
            if batch:
                front = x.shape[:1]
                x = x.reshape(*front, len(names)).T
            values.update(zip(names, x if batch else x.ravel(), strict=True))
        with np.errstate(all="ignore"):
            for target, op, args in self.instructions:
                values[target] = OPERATIONS[op](*(values[a] if type(a) is str else a for a in args))

        def gathered(entries, shape):
            found = np.empty((*front, len(entries)))
            for i, a in enumerate(entries):
                found[..., i] = values[a] if type(a) is str else a
            return found.reshape((*front, *shape))

        return [gathered(entries, shape) for entries, shape in zip(self.outputs, self.shapes, strict=True)]

    def degree(self, place: int) -> float:
        """Degree of the outputs as polynomials in an input array; infinity where they are not written as such.

        Parameters
        ----------
        place : int
            Of the input.
        """
        degrees: dict[Scalar, float] = dict.fromkeys(self.inputs[place], 1)
        for target, op, args in self.instructions:
            found = [degrees.get(a, 0) for a in args]
            if op in ("add", "sub", "neg"):
                degrees[target] = max(found)
            elif op == "mul":
                degrees[target] = sum(found)
            elif op == "div" and not found[1]:
                degrees[target] = found[0]
            else:
                degrees[target] = math.inf if any(found) else 0
        return max((degrees.get(a, 0) for entries in self.outputs for a in entries), default=0)

    def factored(self, varying: Sequence[int]) -> Program:
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

    def split(self, late: Sequence[int]) -> tuple[Program, Program]:
        """What can be computed without some of the inputs, and the rest.

        The second program has one more input array, at the end: the output of the first. Arrays hold numbers, so truth
        values are handed over as 1.0 and 0.0.

        Parameters
        ----------
        late : sequence of int
            Places of those inputs.
        """
        waiting: set[Scalar] = {name for i in late for name in self.inputs[i]}
        early, rest = [], []
        for instruction in self.instructions:
            if waiting.isdisjoint(instruction.args):
                early.append(instruction)
            else:
                rest.append(instruction)
                waiting.add(instruction.target)
        wanted = {a for instruction in rest for a in instruction.args} | {
            a for entries in self.outputs for a in entries
        }
        handed = [instruction.target for instruction in early if instruction.target in wanted]
        true_or_false = truth_values(early)
        truths = {a: f"{a}_as_number" for a in handed if a in true_or_false}
        early += [Instruction(number, "float", (a,)) for a, number in truths.items()]
        rest = [Instruction(a, "ne", (number, 0.0)) for a, number in truths.items()] + rest
        handed = [truths.get(a, a) for a in handed]
        instructions, renamed = _live(early, handed)
        first = Program(self.inputs, instructions, (tuple(renamed[a] for a in handed),), ((len(handed),),))
        return first, Program((*self.inputs, tuple(handed)), tuple(rest), self.outputs, self.shapes)


def scalarize(closed: ClosedJaxpr, known: Sequence | None = None, limit: int = LIMIT) -> Program:
    """Unroll a closed jaxpr, as ``jax.make_jaxpr`` gives it, into scalar instructions.

    Parameters
    ----------
    closed : ClosedJaxpr
        Of a function of float64 arrays.
    known : sequence, optional
        For each input array None, or an array of its shape: a number fixes that entry at compile time, NaN leaves it to
        run time. (A parameter matrix that is diagonal may as well be so in the program.)
    limit : int
        Largest number of instructions.

    Raises
    ------
    UnsupportedPrimitive
        Where there is no rule for a primitive, where indices depend on the input, or beyond the limit.
    """
    builder = Builder(limit)
    inputs, arguments = [], []
    for i, var in enumerate(closed.jaxpr.invars):
        if var.aval.dtype != np.float64:
            raise InputError(f"argument {i} of a compiled function must be of float64, not of {var.aval.dtype}")
        names = [f"x{i}_{j}" for j in range(math.prod(var.aval.shape))]
        fixed = None if known is None or known[i] is None else np.asarray(known[i], dtype=np.float64)
        entries = (
            names if fixed is None else [n if v != v else v for n, v in zip(names, fixed.ravel().tolist(), strict=True)]
        )
        inputs.append(tuple(names))
        arguments.append(array(entries, var.aval.shape))
    results = _unroll(builder, closed.jaxpr, closed.consts, arguments)
    outputs = [x.ravel().tolist() for x in results]
    instructions, renamed = _live(builder.instructions, [a for entries in outputs for a in entries])
    return Program(
        tuple(inputs),
        instructions,
        tuple(tuple(renamed.get(a, a) if type(a) is str else a for a in entries) for entries in outputs),
        tuple(x.shape for x in results),
    )


def _unroll(b: Builder, jaxpr, consts, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The outputs of a jaxpr as arrays of scalars."""
    values = dict(zip(jaxpr.constvars, map(constant, consts), strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))

    def read(v) -> np.ndarray:
        return constant(v.val, getattr(v.aval, "dtype", None)) if isinstance(v, Literal) else values[v]

    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        try:
            _check_equation(eqn)
            found = (CONTROL.get(name) or RULES.get(name) or _refuse)(b, eqn, *map(read, eqn.invars))
            results = found if isinstance(found, list) else [found]
            _check_results(eqn, results)
        except NotImplementedError as error:
            raise UnsupportedPrimitive(name, origin(eqn), str(error)) from None
        except UnsupportedPrimitive as inside:
            if inside.where != UNKNOWN:
                raise
            raise UnsupportedPrimitive(inside.primitive, origin(eqn), inside.reason, inside.too_large) from None
        except LimitExceededError:
            reason = f"within the size limit: the program exceeds {b.limit} scalar instructions"
            raise UnsupportedPrimitive(name, origin(eqn), reason, too_large=True) from None
        values.update(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _refuse(b, eqn, *arguments):
    raise NotImplementedError


def _check_equation(eqn) -> None:
    """Refuse what the rules were not written for."""
    if eqn.primitive.name in RULES:
        for name, value in eqn.params.items():
            if name not in PARAMETERS.split() and value is not None:
                raise NotImplementedError(f"with {name}={value}")
    for var in (*eqn.invars, *eqn.outvars):
        if getattr(getattr(var.aval, "dtype", None), "kind", None) not in ("f", "i", "b"):
            raise NotImplementedError(f"on {var.aval}")


MOVES = frozenset("broadcast_in_dim reshape squeeze expand_dims transpose slice concatenate".split())
"""Primitives that compute nothing: what they move was admitted where it was made."""


def _check_results(eqn, results: Sequence[np.ndarray]) -> None:
    """Refuse what Python's float and int would not compute alike: other precisions, integers that could wrap around."""
    name = eqn.primitive.name
    harmless = name in MOVES or (name == "convert_element_type" and eqn.invars[0].aval.dtype == bool)
    for var, result in zip(eqn.outvars, results, strict=True):
        dtype = var.aval.dtype
        assert result.shape == var.aval.shape, f"{eqn.primitive.name}: {result.shape} is not {var.aval.shape}"
        if dtype.kind == "f" and dtype != np.float64:
            raise NotImplementedError(f"on {dtype}")
        if dtype.kind == "i":
            limits, numbers = np.iinfo(dtype), [a for a in result.flat if type(a) is not str]
            if len(numbers) < result.size and dtype != np.int64 and not harmless:
                raise NotImplementedError(f"on {dtype} at run time")
            if not all(limits.min <= a <= limits.max for a in numbers):
                raise NotImplementedError(f"beyond the range of {dtype}")


# -- primitives that contain jaxprs -----------------------------------------------------------------------------------


def _call(b, eqn, *arguments):
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    if isinstance(inner, ClosedJaxpr):
        return _unroll(b, inner.jaxpr, inner.consts, arguments)
    return _unroll(b, inner, (), arguments)


def _linear_solve(b, eqn, *arguments):
    """The user's way of solving; the matrix is only there for derivatives, and they have been taken."""
    sizes, solve = eqn.params["const_lengths"], eqn.params["jaxprs"].solve
    start = sizes.matvec + sizes.vecmat
    return _unroll(b, solve.jaxpr, solve.consts, [*arguments[start : start + sizes.solve], *arguments[sum(sizes) :]])


def _cond(b, eqn, index, *arguments):
    """Every branch, then a choice of results: the branches are pure."""
    shapes = [var.aval.shape for var in eqn.outvars]
    branches = eqn.params["branches"]
    which = index.item()
    if type(which) is not str:
        branches = (branches[min(max(which, 0), len(branches) - 1)],)
    *others, chosen = (_unroll(b, branch.jaxpr, branch.consts, arguments) for branch in branches)
    for i in reversed(range(len(others))):
        first = b.op("le", which, i)
        sides = ([a for x in side for a in x.ravel().tolist()] for side in (others[i], chosen))
        entries = iter(b.branch(first, *sides))
        chosen = [array(list(itertools.islice(entries, math.prod(shape))), shape) for shape in shapes]
    return chosen


def _scan(b, eqn, *arguments):
    """A loop of known length, unrolled."""
    params = eqn.params
    inner, consts, carried = params["jaxpr"], params["num_consts"], params["num_consts"] + params["num_carry"]
    carry, slices = list(arguments[consts:carried]), arguments[carried:]
    rows = range(params["length"])
    gathered = []
    for i in reversed(rows) if params["reverse"] else rows:
        results = _unroll(b, inner.jaxpr, inner.consts, [*arguments[:consts], *carry, *(x[i, ...] for x in slices)])
        carry = results[: len(carry)]
        gathered.append(results[len(carry) :])
    if params["reverse"]:
        gathered.reverse()
    stacked = [
        array([a for row in gathered for a in row[k].flat], var.aval.shape)
        for k, var in enumerate(eqn.outvars[len(carry) :])
    ]
    return carry + stacked


CALLS = "jit pjit call closed_call core_call custom_jvp_call custom_vjp_call checkpoint remat remat2"
CONTROL = {
    **dict.fromkeys(CALLS.split(), _call),
    "custom_linear_solve": _linear_solve,
    "cond": _cond,
    "scan": _scan,
}


# -- helpers ----------------------------------------------------------------------------------------------------------


def truth_values(instructions: Sequence[Instruction]) -> set[str]:
    """The targets that are true or false."""
    found: set[str] = set()
    for target, op, args in instructions:
        chosen = args[1:] if op == "select" else ()
        if op in TESTS or op in OF_TESTS or any(a in found or isinstance(a, bool) for a in chosen):
            found.add(target)
    return found


def _live(
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


def origin(eqn) -> str:
    """The innermost line outside JAX that led to an equation."""
    for frame in getattr(eqn.source_info.traceback, "frames", ()):
        if not {"jax", "jaxlib", "equinox"} & set(Path(frame.file_name).parts):
            return f"{Path(frame.file_name).name}:{frame.line_num}, in {frame.function_name}"
    return UNKNOWN
