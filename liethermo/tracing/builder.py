"""Scalar arithmetic that simplifies itself.

A scalar is a Python number, which is known at compile time, or a ``str``, the name of a variable. An array is a NumPy
array of such objects. NumPy moves the data, so reshaping, slicing or transposing adds no instruction.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

Scalar = str | float | int | bool


class Block:
    """An operation with several results, such as a loop or a call; equal blocks do the same work.

    The instruction of a block has one target, from which ``item`` instructions pick the results.

    Attributes
    ----------
    name : str
    result_kinds : tuple of str
        Kinds of the results: ``"f"`` for a real number, ``"i"`` for an integer, ``"b"`` for a truth value.
    """

    name: str
    result_kinds: tuple[str, ...]
    inner_programs: tuple = ()
    """Programs that the block runs repeatedly."""

    def __call__(self, *args) -> list:
        """Evaluate the block for numbers, or for NumPy arrays of them; return its results."""
        raise NotImplementedError

    @functools.cached_property
    def _comparison_key(self) -> str:
        """Text that two blocks share if and only if they are equal."""
        return repr(self)

    def __eq__(self, other) -> bool:
        return type(self) is type(other) and self._comparison_key == other._comparison_key

    def __hash__(self) -> int:
        return hash(self._comparison_key)

    def __str__(self) -> str:
        return self.name


class Instruction(NamedTuple):
    """One operation, ``target = op(*args)``.

    ``op`` is a key of :data:`OPERATIONS` or a block. The target of a block stands for all its results.
    """

    target: str
    op: str | Block
    args: tuple[Scalar, ...]


def _saturating_int64(a) -> np.ndarray:
    """Convert numbers to integers as XLA does: NaN becomes 0, and a number out of range the nearest integer."""
    a = np.asarray(a, dtype=np.float64)
    is_in_range = np.abs(a) < 2.0**63
    limit = np.where(a != a, 0, np.where(a < 0.0, -(2**63), 2**63 - 1))
    return np.where(is_in_range, np.where(is_in_range, a, 0.0).astype(np.int64), limit)


def _truncated_quotient(dividend, divisor):
    """Return the quotient of integers, rounded towards zero; division by zero gives -1, as in XLA."""
    dividend, divisor = np.asarray(dividend, dtype=np.int64), np.asarray(divisor, dtype=np.int64)
    is_zero = divisor == 0
    divisor = np.where(is_zero, 1, divisor)
    floor_quotient = dividend // divisor
    quotient = floor_quotient + ((floor_quotient * divisor != dividend) & ((dividend < 0) != (divisor < 0)))
    return np.where(is_zero, -1, quotient)[()]


def _wrap_integer(a, bits: int, is_signed: bool):
    """Return an integer modulo ``2**bits``, in the range of a signed or unsigned type."""
    low_bits = np.asarray(a, dtype=np.int64) & ((1 << bits) - 1)
    return np.where(is_signed & (low_bits >> (bits - 1) == 1), low_bits - (1 << bits), low_bits)[()]


def _take_clipped(index, *entries):
    """Return the entry at an index, which counts from zero; an index out of range is clipped."""
    if all(type(entry) is not np.ndarray or (entry.ndim == 1 and entry.strides == (0,)) for entry in entries):
        # parameters are the same at all points: arrays without a stride
        table = np.array([entry if type(entry) is not np.ndarray else entry[0] for entry in entries])
        return table[np.clip(np.asarray(index, dtype=np.int64), 0, len(entries) - 1)]
    index, *values = np.broadcast_arrays(np.clip(np.asarray(index, dtype=np.int64), 0, len(entries) - 1), *entries)
    return np.take_along_axis(np.stack(values), index[None], 0)[0][()]


SPECIAL_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "lgamma": lambda x: scipy.special.gammaln(x),
    "digamma": lambda x: scipy.special.psi(x),
    "erf_inv": lambda x: scipy.special.erfinv(x),
    "bessel_i0e": lambda x: scipy.special.i0e(x),
    "bessel_i1e": lambda x: scipy.special.i1e(x),
    "igamma": lambda a, x: scipy.special.gammainc(a, x),
    "igammac": lambda a, x: scipy.special.gammaincc(a, x),
    "regularized_incomplete_beta": lambda a, b, x: scipy.special.betainc(a, b, x),
}
"""SciPy's special functions. The lambdas delay the import of SciPy until one of them is called."""

ELEMENTARY_OPERATIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in "abs sign sqrt cbrt exp exp2 expm1 log log1p sin cos tan".split()},
    **{name: getattr(np, name) for name in "sinh cosh tanh floor ceil".split()},
    **{f"a{name}": getattr(np, f"arc{name}") for name in "sin cos tan tan2 sinh cosh tanh".split()},
    "erf": lambda x: scipy.special.erf(x),
    "erfc": lambda x: scipy.special.erfc(x),
    "is_finite": np.isfinite,
    **{name: getattr(operator, name) for name in "eq ne lt le gt ge xor".split()},
    "and": operator.and_,
    "or": operator.or_,
    **SPECIAL_FUNCTIONS,
}
"""Operations that are named like their JAX primitive and that the builder does not simplify."""

OPERATIONS: dict[str, Callable[..., Any]] = (
    ELEMENTARY_OPERATIONS
    | {
        **{name: getattr(operator, name) for name in "add sub mul neg".split()},
        "div": operator.truediv,
        "pow": operator.pow,
        "rem": np.fmod,
        "trunc": np.trunc,
        "rint": np.rint,
        "max": np.maximum,  # like XLA's, NaN if either is
        "min": np.minimum,
        "not": np.logical_not,
        "select": np.where,
        "float": lambda a: np.asarray(a, dtype=np.float64),
        "int": lambda a: np.asarray(a, dtype=np.int64),
        "truncate": _saturating_int64,
        "branch": lambda condition, number: condition,
        "quotient": _truncated_quotient,
        "wrap": _wrap_integer,
        "single": lambda a: (
            np.float64(np.float32(a)) if np.ndim(a) == 0 else np.asarray(a, np.float32).astype(np.float64)
        ),
        "pick": _take_clipped,
        "lookup": lambda index, table: _take_clipped(index, *table),
        "item": lambda results, i: results[i],
        "column": lambda results, start, length: results[start : start + length],
        "table": lambda *entries: list(entries),
    }
)
"""Meaning of each operation, on numbers and on NumPy arrays of them."""


def implementation(op: str | Block) -> Callable[..., Any]:
    """Return the Python function that evaluates an operation or a block on numbers."""
    return op if isinstance(op, Block) else OPERATIONS[op]


COMPARISONS = {"eq", "ne", "lt", "le", "gt", "ge", "is_finite"}
"""Operations on numbers that return a truth value."""

BOOLEAN_OPERATIONS = {"and", "or", "xor", "not", "branch"}
"""Operations on truth values."""

MAX_SELECT_ENTRIES = 16
"""Largest number of entries among which ``pick`` selects directly; more entries become a table."""

COMMUTATIVE = {"add", "mul", "and", "or", "xor", "eq", "ne"}
"""Operations whose arguments are sorted, so that equal expressions merge."""


class LimitExceededError(Exception):
    """Error that a program has more instructions than its builder allows."""


class EnclosingScope:
    """The builder around an inner program, such as a loop body, and the scalars that the inner program reads.

    Attributes
    ----------
    builder : ProgramBuilder
        The builder of the outer program.
    inner_names, outer_scalars : dict
        The name that each outer scalar has inside, and the inverse of this map.
    tables : dict
        The entries of each outer table, by its name inside.
    """

    def __init__(self, builder: ProgramBuilder):
        self.builder = builder
        self.inner_names: dict[Scalar, str] = {}
        self.outer_scalars: dict[Scalar, Scalar] = {}
        self.tables: dict[str, tuple[Scalar, ...]] = {}

    def import_scalar(self, a: Scalar) -> str:
        """Return the name by which the inner program reads a scalar of the outer one."""
        if a not in self.inner_names:
            self.inner_names[a] = name = f"x0_{len(self.inner_names)}"
            self.outer_scalars[name] = a
        return self.inner_names[a]

    def import_table(self, entries: Sequence[Scalar]) -> str:
        """Make a table of these entries in the outer program; return the name by which the inner program reads it."""
        name = self.import_scalar(
            self.builder.make_table([self.outer_scalars[a] if type(a) is str else a for a in entries])
        )
        self.tables[name] = tuple(entries)
        return name


TABLE_MARK = "table"
"""First of the two results of :meth:`ProgramBuilder.prepare_pick` that stand for a table; no scalar has this name."""

MAX_TABLE_STRIDE = 256
"""Largest distance in memory that is tried between the entries of a table of which only one is not fixed."""


def name_constants_found_in_an_input(
    entries: Sequence[Scalar], fixed_inputs: Sequence[np.ndarray | None]
) -> Sequence[Scalar]:
    """Replace the constants of a table by names of inputs if all its entries then are equidistant in one input array.

    Such a table is read where the input array lies, without a copy; any other table is returned unchanged. An input
    that is fixed to a number has this number at run time too, so the names stand for equal values.
    """
    named_entries = [(k, a) for k, a in enumerate(entries) if type(a) is str]
    if not named_entries or len(named_entries) == len(entries) or not all(a[0] == "x" for _, a in named_entries):
        return entries
    positions = [(k, *map(int, a[1:].split("_"))) for k, a in named_entries]
    first_index, array_index, first_position = positions[0]
    fixed_values = fixed_inputs[array_index] if array_index < len(fixed_inputs) else None
    if fixed_values is None or any(i != array_index for _, i, _ in positions):
        return entries
    if len(positions) > 1:
        stride, remainder = divmod(positions[1][2] - first_position, positions[1][0] - first_index)
        strides = [stride] if not remainder and stride > 0 else []
    else:
        strides = [*range(1, MAX_TABLE_STRIDE + 1)]
    table_values = np.array([np.nan if type(a) is str else a for a in entries], dtype=np.float64)
    for stride in strides:
        source = first_position + stride * (np.arange(len(entries)) - first_index)
        if source[0] < 0 or source[-1] >= fixed_values.size or any(source[k] != j for k, _, j in positions):
            continue
        if np.array_equal(fixed_values[source], table_values, equal_nan=True):
            return [f"x{array_index}_{j}" for j in source]
    return entries


class ProgramBuilder:
    """Builds a scalar program: each method emits instructions and returns the scalar that holds their result.

    No instruction is emitted for a result that is known at compile time, that equals an earlier one, or that differs
    from one by a sign which a later instruction can absorb. These simplifications are exact, except for the sign of a
    zero and one rule: a structural zero times anything, or divided by anything, is zero. Sums are never reassociated.

    Parameters
    ----------
    max_instructions : int
        Largest number of instructions that the builder may collect.
    enclosing : EnclosingScope, optional
        Scope around a program inside a loop or a routine.

    Attributes
    ----------
    fixed_inputs : tuple
        The numbers that fix entries of each input array, flat, NaN for entries that are known at run time only; None
        for an array without such numbers.
    prepared_windows : dict
        For arrays that have been read at run-time indices, the array and the entries of its windows, prepared by
        :meth:`prepare_pick`: many reads of one table are prepared once.
    """

    def __init__(self, max_instructions: int, enclosing: EnclosingScope | None = None):
        self.max_instructions, self.enclosing = max_instructions, enclosing
        self.fixed_inputs: tuple[np.ndarray | None, ...] = ()
        self.prepared_windows: dict[tuple, tuple[np.ndarray, list[tuple[Scalar, ...]]]] = {}
        self.instructions: list[Instruction] = []
        self._emitted: dict[tuple[str | Block, ...], str] = {}
        self._negated_operand: dict[Scalar, str] = {}  # b, by the name of a = -b
        self._branches: dict[tuple[str, ...], int] = {}
        self.call_results: dict[tuple, tuple] = {}

    @property
    def real_builder(self) -> ProgramBuilder:
        """Builder of real scalars: this object; for a complex builder, the builder of its real and imaginary parts."""
        return self

    def op(self, op: str | Block, *args: Scalar) -> Any:
        """Emit an operation and return its result; constants are folded, and equal operations are emitted once."""
        if not any(type(a) is str for a in args):
            return evaluate_on_numbers(op, *args)
        if op in COMMUTATIVE:
            args = tuple(sorted(args, key=str))
        return self._emit(op, *args)

    def _emit(self, op: str | Block, *args: Scalar) -> str:
        """Append an instruction unless an equal one exists; return the name of its result."""
        key = (op, *(a if type(a) is str else repr(a) for a in args))  # repr tells 0.0 from -0.0, 1 from True
        name = self._emitted.get(key)
        if name is None:
            if len(self.instructions) >= self.max_instructions:
                raise LimitExceededError
            name = self._emitted[key] = f"t{len(self.instructions)}"
            self.instructions.append(Instruction(name, op, args))
        return name

    def emit_block(self, block: Block, *args: Scalar) -> list[Scalar]:
        """Emit the instruction of a block and return the block's results."""
        result = self.op(block, *args)
        if isinstance(result, str):
            return [self.op("item", result, i) for i in range(len(block.result_kinds))]
        return [a.item() if isinstance(a, np.generic | np.ndarray) else a for a in result]

    def make_table(self, entries: Sequence[Scalar]) -> str:
        """Return the name of one variable that holds the entries, from which a loop reads by index.

        Consecutive results of one block are taken from it without a copy. Inside a loop, a table of outer scalars is
        made once, outside of the loop.
        """
        if self.enclosing is not None and not any(
            type(a) is str and a not in self.enclosing.outer_scalars for a in entries
        ):
            return self.enclosing.import_table(entries)
        first_instruction = self._defining_instruction(entries[0]) if entries else None
        if first_instruction is not None and first_instruction.op == "item":
            block_result, start = first_instruction.args[0], int(first_instruction.args[1])
            if all(
                self._defining_instruction(a) == (a, "item", (block_result, start + i)) for i, a in enumerate(entries)
            ):
                return self._emit("column", block_result, start, len(entries))
        return self._emit("table", *name_constants_found_in_an_input(entries, self.fixed_inputs))

    def input_positions_or_none(self, scalars: Sequence[Scalar]) -> list[tuple[int, int]] | None:
        """Return the (array, entry) indices of these scalars among the inputs of the outermost program.

        The result is None if a scalar is not an input.
        """
        if self.enclosing is not None:
            return self.enclosing.builder.input_positions_or_none(
                [self.enclosing.outer_scalars.get(a, 0.0) for a in scalars]
            )
        if not all(type(a) is str and a[0] == "x" for a in scalars):
            return None
        return [
            (int(array_index), int(entry_index))
            for array_index, entry_index in (str(a)[1:].split("_") for a in scalars)
        ]

    def _defining_instruction(self, a: Scalar) -> Instruction | None:
        """Return the instruction that computes a scalar; None for an input or a constant."""
        return self.instructions[int(a[1:])] if type(a) is str and a[0] == "t" else None

    def add(self, a, b):
        if type(a) is not str and type(b) is not str:
            return a + b
        if a == 0:
            return b
        if b == 0:
            return a
        if b in self._negated_operand:
            return self.sub(a, self._negated_operand[b])
        if a in self._negated_operand:
            return self.sub(b, self._negated_operand[a])
        return self.op("add", a, b)

    def sub(self, a, b):
        if type(a) is not str and type(b) is not str:
            return a - b
        if b == 0:
            return a
        if a == 0:
            return self.neg(b)
        if b in self._negated_operand:
            return self.add(a, self._negated_operand[b])
        return self.op("sub", a, b)

    def neg(self, a):
        if type(a) is not str:
            return -a
        if a in self._negated_operand:
            return self._negated_operand[a]
        result = self.op("neg", a)
        self._negated_operand[result] = a
        return result

    def mul(self, a, b):
        if type(a) is not str and type(b) is not str:
            return a * b
        if a == 0 or b == 0:
            return abs(a if a == 0 else b)
        if a == 1:
            return b
        if b == 1:
            return a
        return self._pull_out_signs(self.mul, "mul", a, b)

    def div(self, a, b):
        if type(a) is not str and type(b) is not str:
            return evaluate_on_numbers("div", a, b)
        if a == 0:
            return abs(a)
        if b == 1:
            return a
        return self._pull_out_signs(self.div, "div", a, b)

    def _pull_out_signs(self, multiply_or_divide, op, a, b):
        """Return a product or quotient of two scalars, with their minus signs taken out and applied to the result."""
        for x, result in (a, lambda y: multiply_or_divide(y, b)), (b, lambda y: multiply_or_divide(a, y)):
            opposite = self._negated_operand.get(x) if type(x) is str else -x if x < 0 else None
            if opposite is not None:
                return self.neg(result(opposite))
        return self.op(op, a, b)

    def integer_pow(self, a, n: int, unit: Scalar = 1.0):
        """Return ``a**n`` by repeated squaring."""
        if n < 0:
            return self.div(unit, self.integer_pow(a, -n))
        result = unit
        while n:
            if n & 1:
                result = self.mul(result, a)
            n >>= 1
            if n:
                a = self.mul(a, a)
        return result

    def pow(self, a, b):
        if type(b) is not str and float(b).is_integer() and abs(b) <= 3:
            return self.integer_pow(a, int(b))
        return self.op("pow", a, b)

    def select(self, condition, a, b):
        """Return ``a if condition else b``."""
        if type(condition) is not str:
            return a if condition else b
        return a if type(a) is type(b) and repr(a) == repr(b) else self.op("select", condition, a, b)

    def select_side(self, condition, true_values: Sequence[Scalar], false_values: Sequence[Scalar]) -> list[Scalar]:
        """Return the scalars of the side of a ``lax.cond`` that the condition selects.

        A ``branch`` instruction marks the condition, so that :mod:`.branches` finds the choices that belong together.
        """
        key = tuple(a if type(a) is str else repr(a) for a in (condition, *true_values, *false_values))
        test = self.op("branch", condition, self._branches.setdefault(key, len(self._branches)))
        return [self.select(test, a, b) for a, b in zip(true_values, false_values, strict=True)]

    def pick(self, index, entries: Sequence[Scalar]) -> Scalar:
        """Return the entry at an index, which counts from zero; an index out of range is clipped."""
        if type(index) is not str:
            return entries[min(max(index, 0), len(entries) - 1)]
        return self.pick_prepared(index, self.prepare_pick(entries))

    def prepare_pick(self, entries: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Prepare entries for :meth:`pick_prepared`, so that many picks share one table.

        Return one entry if all are equal, the entries if they are few, or :data:`TABLE_MARK` and the name of a table.
        """
        if all(type(a) is type(entries[0]) and repr(a) == repr(entries[0]) for a in entries):
            return (entries[0],)
        return tuple(entries) if len(entries) <= MAX_SELECT_ENTRIES else (TABLE_MARK, self.make_table(entries))

    def pick_prepared(self, index: str, prepared_entries: tuple[Scalar, ...]) -> Scalar:
        """Return the entry at a run-time index among entries from :meth:`prepare_pick`."""
        if len(prepared_entries) == 1:
            return prepared_entries[0]
        if prepared_entries[0] == TABLE_MARK:
            return self.op("lookup", index, prepared_entries[1])
        return self.op("pick", index, *prepared_entries)

    def conj(self, a):
        """Return the complex conjugate of a real scalar, which is the scalar."""
        return a

    def max(self, a, b):
        return self.op("max", a, b)

    def min(self, a, b):
        return self.op("min", a, b)

    def logistic(self, a):
        """Return ``1 / (1 + exp(-a))``."""
        return self.div(1.0, self.add(1.0, self.op("exp", self.neg(a))))

    def round_half_away(self, a):
        """Return the integer nearest to a real number; halves are rounded away from zero."""
        truncation = self.op("trunc", a)
        rounds_away = self.op("ge", self.op("abs", self.sub(a, truncation)), 0.5)  # false at infinity
        return self.select(rounds_away, self.add(truncation, self.op("sign", a)), truncation)

    def all(self, conditions):
        """Return the scalar that is true if all conditions are."""
        result: Scalar = True
        for condition in conditions:
            result = self.op("and", result, condition)
        return result


def evaluate_on_numbers(op: str | Block, *args: Scalar) -> Any:
    """Evaluate an operation on numbers by IEEE arithmetic, without exceptions."""
    with np.errstate(all="ignore"):
        value = implementation(op)(*(np.float64(a) if type(a) is float else a for a in args))
    return value.item() if isinstance(value, np.generic | np.ndarray) else value


# -- arrays of scalars ----------------------------------------------------------------------------------------------


class ComplexPair:
    """A complex scalar, stored as two real scalars.

    The class is not a sequence, so NumPy's object arrays treat an instance as one entry.
    """

    __slots__ = ("im", "re")

    def __init__(self, re: Scalar, im: Scalar):
        self.re, self.im = re, im


def as_complex_pair(a) -> ComplexPair:
    """Convert a complex number or a real scalar to a :class:`ComplexPair`."""
    if isinstance(a, ComplexPair):
        return a
    return ComplexPair(a.real, a.imag) if isinstance(a, complex) else ComplexPair(a, 0.0)


def constant_array(value, dtype=None) -> np.ndarray:
    """Return an array of numbers as an object array of scalars; complex numbers become pairs."""
    array = np.asarray(value, dtype=dtype)
    if array.dtype.kind != "c":
        return array.astype(object)
    return scalar_array([ComplexPair(a.real, a.imag) for a in array.ravel().tolist()], array.shape)


def scalar_array(scalars: Sequence[Any], shape) -> np.ndarray:
    """Return an object array of this shape that holds the scalars in row-major order."""
    result = np.empty(len(scalars), object)
    result[:] = scalars
    return result.reshape(shape)


def map_elementwise(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    """Apply a function to the entries of arrays, with broadcasting; return an object array of its results."""
    if len({np.shape(x) for x in arrays}) > 1:
        arrays = np.broadcast_arrays(*arrays)
    return scalar_array(list(map(function, *(x.ravel().tolist() for x in arrays))), arrays[0].shape)


def rows_and_outer_shape(x: np.ndarray, row_axes) -> tuple[list[list[Scalar]], tuple[int, ...]]:
    """Return a list of entries along some axes for each index of the other axes, and the shape of the other axes."""
    remaining_axes = [i for i in range(x.ndim) if i not in row_axes]
    shape = tuple(x.shape[i] for i in remaining_axes)
    n_entries = math.prod(x.shape[i] for i in row_axes)
    return x.transpose(*remaining_axes, *row_axes).reshape(math.prod(shape), n_entries).tolist(), shape
