"""Scalar arithmetic that simplifies itself.

A scalar is a Python number, known at compile time, or a ``str``, the name of a variable. An array is a NumPy array of
such objects, so NumPy itself moves data: reshaping, slicing or transposing costs the program nothing.
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
    """An operation with several results, which ``item`` picks out: a loop, or a call. Those that do the same are equal.

    Attributes
    ----------
    name : str
    kinds : tuple of str
        Of its results: ``"f"`` for a number, ``"i"`` for an integer, ``"b"`` for a truth value.
    """

    name: str
    kinds: tuple[str, ...]
    inner_programs: tuple = ()
    """The programs that it runs again and again."""

    def __call__(self, *args) -> list:
        """Its results, for numbers or for NumPy arrays of them."""
        raise NotImplementedError

    @functools.cached_property
    def _text(self) -> str:
        return repr(self)

    def __eq__(self, other) -> bool:
        return type(self) is type(other) and self._text == other._text

    def __hash__(self) -> int:
        return hash(self._text)

    def __str__(self) -> str:
        return self.name


class Instruction(NamedTuple):
    """``target = op(*args)``, op a key of :data:`SYMPY_OPERATIONS` or a block, whose target stands for all its results."""

    target: str
    op: str | Block
    args: tuple[Scalar, ...]


def _truncate_to_int64(a) -> np.ndarray:
    """As XLA converts to integers: NaN to 0, and what is too large to the nearest one."""
    a = np.asarray(a, dtype=np.float64)
    inside = np.abs(a) < 2.0**63
    outside = np.where(a != a, 0, np.where(a < 0.0, -(2**63), 2**63 - 1))
    return np.where(inside, np.where(inside, a, 0.0).astype(np.int64), outside)


def _integer_quotient(a, n):
    """The quotient of integers, towards zero; by zero it is -1, as XLA has it."""
    a, n = np.asarray(a, dtype=np.int64), np.asarray(n, dtype=np.int64)
    safe = np.where(n == 0, 1, n)
    below = a // safe
    towards_zero = below + ((below * safe != a) & ((a < 0) != (safe < 0)))
    return np.where(n == 0, -1, towards_zero)[()]


def _wrap_integer(a, bits: int, signed: bool):
    """An integer as so many bits hold it."""
    low = np.asarray(a, dtype=np.int64) & ((1 << bits) - 1)
    return np.where(signed & (low >> (bits - 1) == 1), low - (1 << bits), low)[()]


def _take_clipped(place, *entries):
    """The entry at a place from zero; the first, or the last, where it lies outside."""
    place, *found = np.broadcast_arrays(np.clip(np.asarray(place, dtype=np.int64), 0, len(entries) - 1), *entries)
    return np.take_along_axis(np.stack(found), place[None], 0)[0][()]


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
"""Special functions, SciPy's. It is imported where one is needed."""

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
"""Operations that are primitives of the same name, with nothing to simplify."""

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
        "truncate": _truncate_to_int64,
        "branch": lambda condition, number: condition,
        "quotient": _integer_quotient,
        "wrap": _wrap_integer,
        "single": lambda a: (
            np.float64(np.float32(a)) if np.ndim(a) == 0 else np.asarray(a, np.float32).astype(np.float64)
        ),
        "pick": _take_clipped,
        "lookup": lambda place, table: _take_clipped(place, *table),
        "item": lambda results, i: results[i],
        "column": lambda results, start, length: results[start : start + length],
        "table": lambda *entries: list(entries),
    }
)
"""What each operation means, on numbers and on NumPy arrays of them."""


def implementation(op: str | Block) -> Callable[..., Any]:
    """What an operation or a block means."""
    return op if isinstance(op, Block) else OPERATIONS[op]


COMPARISONS = {"eq", "ne", "lt", "le", "gt", "ge", "is_finite"}
"""Operations on numbers that give a truth value."""

BOOLEAN_OPERATIONS = {"and", "or", "xor", "not", "branch"}
"""Those on truth values."""

MAX_SELECT_ENTRIES = 16
"""Entries among which one is picked by choices; more are a table."""

COMMUTATIVE = {"add", "mul", "and", "or", "xor", "eq", "ne"}


class LimitExceededError(Exception):
    """More instructions than allowed."""


class EnclosingScope:
    """What is around a program that is one of its instructions.

    Attributes
    ----------
    builder : Builder
        Of that.
    inner_names, outer_scalars : dict
        The names that its variables have inside, and the inverse of that.
    tables : dict
        What is in its tables, by their names inside.
    """

    def __init__(self, builder: Builder):
        self.builder = builder
        self.inner_names: dict[Scalar, str] = {}
        self.outer_scalars: dict[Scalar, Scalar] = {}
        self.tables: dict[str, tuple[Scalar, ...]] = {}

    def import_scalar(self, a: Scalar) -> str:
        """The name of a variable inside."""
        if a not in self.inner_names:
            self.inner_names[a] = name = f"x0_{len(self.inner_names)}"
            self.outer_scalars[name] = a
        return self.inner_names[a]

    def table(self, entries: Sequence[Scalar]) -> str:
        """The name inside of a table around, of what these are there."""
        name = self.import_scalar(self.builder.table([self.outer_scalars[a] if type(a) is str else a for a in entries]))
        self.tables[name] = tuple(entries)
        return name


class Builder:
    """Collects instructions; each method returns the scalar that holds its result.

    Nothing is emitted for a result that is known, equals an earlier one, or is one but for a sign that can be moved on.
    All this is exact, save for the sign of a zero and one licence: a structural zero times anything, or divided by
    anything, is zero. Sums are never reassociated.

    Parameters
    ----------
    max_instructions : int
        Instructions that it may collect.
    enclosing : Around, optional
        What is around a program inside a loop, or in a routine.
    """

    def __init__(self, max_instructions: int, enclosing: EnclosingScope | None = None):
        self.max_instructions, self.enclosing = max_instructions, enclosing
        self.instructions: list[Instruction] = []
        self._emitted: dict[tuple[str | Block, ...], str] = {}
        self._negated_operand: dict[Scalar, str] = {}  # the b of each a = -b
        self._branches: dict[tuple[str, ...], int] = {}
        self.call_results: dict[tuple, tuple] = {}

    @property
    def real(self) -> Builder:
        """The builder of real scalars: itself."""
        return self

    def op(self, op: str | Block, *args: Scalar) -> Any:
        """The result of an operation, with no simplification but constants folded and equal expressions merged."""
        if not any(type(a) is str for a in args):
            return fold_constants(op, *args)
        if op in COMMUTATIVE:
            args = tuple(sorted(args, key=str))
        return self._emit(op, *args)

    def _emit(self, op: str | Block, *args: Scalar) -> str:
        key = (op, *(a if type(a) is str else repr(a) for a in args))  # repr tells 0.0 from -0.0, 1 from True
        name = self._emitted.get(key)
        if name is None:
            if len(self.instructions) >= self.max_instructions:
                raise LimitExceededError
            name = self._emitted[key] = f"t{len(self.instructions)}"
            self.instructions.append(Instruction(name, op, args))
        return name

    def emit_block(self, block: Block, *args: Scalar) -> list[Scalar]:
        """The results of a block."""
        whole = self.op(block, *args)
        if isinstance(whole, str):
            return [self.op("item", whole, i) for i in range(len(block.kinds))]
        return [a.item() if isinstance(a, np.generic | np.ndarray) else a for a in whole]

    def table(self, entries: Sequence[Scalar]) -> str:
        """Entries as one variable, which a loop reads by their numbers: what another loop has made is left as it is.

        Inside a loop those of what is around it are a table there: it is made once.
        """
        if self.enclosing is not None and not any(
            type(a) is str and a not in self.enclosing.outer_scalars for a in entries
        ):
            return self.enclosing.table(entries)
        first = self._defining_instruction(entries[0]) if entries else None
        if first is not None and first.op == "item":
            whole, start = first.args[0], int(first.args[1])
            if all(self._defining_instruction(a) == (a, "item", (whole, start + i)) for i, a in enumerate(entries)):
                return self._emit("column", whole, start, len(entries))
        return self._emit("table", *entries)

    def input_indices(self, entries: Sequence[Scalar]) -> list[tuple[int, int]] | None:
        """The places, of an array and of an entry, that scalars have among the inputs of the outermost program.

        None where one is no input.
        """
        if self.enclosing is not None:
            return self.enclosing.builder.input_indices([self.enclosing.outer_scalars.get(a, 0.0) for a in entries])
        if not all(type(a) is str and a[0] == "x" for a in entries):
            return None
        return [(int(place), int(number)) for place, number in (str(a)[1:].split("_") for a in entries)]

    def _defining_instruction(self, a: Scalar) -> Instruction | None:
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
        return self._extract_signs(self.mul, "mul", a, b)

    def div(self, a, b):
        if type(a) is not str and type(b) is not str:
            return fold_constants("div", a, b)
        if a == 0:
            return abs(a)
        if b == 1:
            return a
        return self._extract_signs(self.div, "div", a, b)

    def _extract_signs(self, method, op, a, b):
        """A product or quotient, minus signs taken out of it."""
        for x, result in (a, lambda y: method(y, b)), (b, lambda y: method(a, y)):
            opposite = self._negated_operand.get(x) if type(x) is str else -x if x < 0 else None
            if opposite is not None:
                return self.neg(result(opposite))
        return self.op(op, a, b)

    def integer_pow(self, a, n: int, one: Scalar = 1.0):
        """``a**n`` by repeated squaring."""
        if n < 0:
            return self.div(one, self.integer_pow(a, -n))
        result = one
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
        """``a if condition else b``."""
        if type(condition) is not str:
            return a if condition else b
        return a if type(a) is type(b) and repr(a) == repr(b) else self.op("select", condition, a, b)

    def branch(self, condition, then: Sequence[Scalar], otherwise: Sequence[Scalar]) -> list[Scalar]:
        """The scalars of one side, by a test that is theirs alone: see :mod:`.branches`."""
        key = tuple(a if type(a) is str else repr(a) for a in (condition, *then, *otherwise))
        own = self.op("branch", condition, self._branches.setdefault(key, len(self._branches)))
        return [self.select(own, a, b) for a, b in zip(then, otherwise, strict=True)]

    def pick(self, place, entries: Sequence[Scalar]) -> Scalar:
        """The entry at a place, an integer from zero: of one that lies outside the nearest."""
        if type(place) is not str:
            return entries[min(max(place, 0), len(entries) - 1)]
        alike = all(type(a) is type(entries[0]) and repr(a) == repr(entries[0]) for a in entries)
        if alike:
            return entries[0]
        return (
            self.op("pick", place, *entries)
            if len(entries) <= MAX_SELECT_ENTRIES
            else self.op("lookup", place, self.table(entries))
        )

    def conj(self, a):
        """Its complex conjugate: itself."""
        return a

    def max(self, a, b):
        return self.op("max", a, b)

    def min(self, a, b):
        return self.op("min", a, b)

    def logistic(self, a):
        return self.div(1.0, self.add(1.0, self.op("exp", self.neg(a))))

    def round_half_away(self, a):
        whole = self.op("trunc", a)
        beyond = self.op("ge", self.op("abs", self.sub(a, whole)), 0.5)  # false at infinity
        return self.select(beyond, self.add(whole, self.op("sign", a)), whole)

    def all(self, conditions):
        result: Scalar = True
        for condition in conditions:
            result = self.op("and", result, condition)
        return result


def fold_constants(op: str | Block, *args: Scalar) -> Any:
    """The value of an operation on numbers, by the rules of IEEE arithmetic: nothing raises."""
    with np.errstate(all="ignore"):
        value = implementation(op)(*(np.float64(a) if type(a) is float else a for a in args))
    return value.item() if isinstance(value, np.generic | np.ndarray) else value


# -- arrays of scalars ----------------------------------------------------------------------------------------------


class ComplexPair:
    """A complex scalar. No sequence, so that NumPy's object arrays take it for one entry."""

    __slots__ = ("im", "re")

    def __init__(self, re: Scalar, im: Scalar):
        self.re, self.im = re, im


def as_complex_pair(a) -> ComplexPair:
    """A complex number, or a real scalar, as one."""
    if isinstance(a, ComplexPair):
        return a
    return ComplexPair(a.real, a.imag) if isinstance(a, complex) else ComplexPair(a, 0.0)


def constant_array(value, dtype=None) -> np.ndarray:
    """An array of numbers as an array of scalars, complex ones as pairs."""
    found = np.asarray(value, dtype=dtype)
    if found.dtype.kind != "c":
        return found.astype(object)
    return scalar_array([ComplexPair(a.real, a.imag) for a in found.ravel().tolist()], found.shape)


def scalar_array(scalars: Sequence[Any], shape) -> np.ndarray:
    result = np.empty(len(scalars), object)
    result[:] = scalars
    return result.reshape(shape)


def elementwise(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    """Apply a function entry by entry."""
    if len({np.shape(x) for x in arrays}) > 1:
        arrays = np.broadcast_arrays(*arrays)
    return scalar_array(list(map(function, *(x.ravel().tolist() for x in arrays))), arrays[0].shape)


def entries_along(x: np.ndarray, axes) -> tuple[list[list[Scalar]], tuple[int, ...]]:
    """The entries along some axes, for each place on the others; and the shape of those others."""
    kept = [i for i in range(x.ndim) if i not in axes]
    shape = tuple(x.shape[i] for i in kept)
    size = math.prod(x.shape[i] for i in axes)
    return x.transpose(*kept, *axes).reshape(math.prod(shape), size).tolist(), shape
