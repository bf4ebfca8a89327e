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
    inner: tuple = ()
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
    """``target = op(*args)``, op a key of :data:`OPERATIONS` or a block, whose target stands for all its results."""

    target: str
    op: str | Block
    args: tuple[Scalar, ...]


def _truncated(a) -> np.ndarray:
    """As XLA converts to integers: NaN to 0, and what is too large to the nearest one."""
    a = np.asarray(a, dtype=np.float64)
    inside = np.abs(a) < 2.0**63
    outside = np.where(a != a, 0, np.where(a < 0.0, -(2**63), 2**63 - 1))
    return np.where(inside, np.where(inside, a, 0.0).astype(np.int64), outside)


def _quotient(a, n):
    """The quotient of integers, towards zero; by zero it is -1, as XLA has it."""
    a, n = np.asarray(a, dtype=np.int64), np.asarray(n, dtype=np.int64)
    safe = np.where(n == 0, 1, n)
    below = a // safe
    towards_zero = below + ((below * safe != a) & ((a < 0) != (safe < 0)))
    return np.where(n == 0, -1, towards_zero)[()]


def _wrapped(a, bits: int, signed: bool):
    """An integer as so many bits hold it."""
    low = np.asarray(a, dtype=np.int64) & ((1 << bits) - 1)
    return np.where(signed & (low >> (bits - 1) == 1), low - (1 << bits), low)[()]


def _picked(place, *entries):
    """The entry at a place from zero; the first, or the last, where it lies outside."""
    place, *found = np.broadcast_arrays(np.clip(np.asarray(place, dtype=np.int64), 0, len(entries) - 1), *entries)
    return np.take_along_axis(np.stack(found), place[None], 0)[0][()]


SPECIAL: dict[str, Callable[..., Any]] = {
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

ELEMENTARY: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in "abs sign sqrt cbrt exp exp2 expm1 log log1p sin cos tan".split()},
    **{name: getattr(np, name) for name in "sinh cosh tanh floor ceil".split()},
    **{f"a{name}": getattr(np, f"arc{name}") for name in "sin cos tan tan2 sinh cosh tanh".split()},
    "erf": lambda x: scipy.special.erf(x),
    "erfc": lambda x: scipy.special.erfc(x),
    "is_finite": np.isfinite,
    **{name: getattr(operator, name) for name in "eq ne lt le gt ge xor".split()},
    "and": operator.and_,
    "or": operator.or_,
    **SPECIAL,
}
"""Operations that are primitives of the same name, with nothing to simplify."""

OPERATIONS: dict[str, Callable[..., Any]] = (
    ELEMENTARY
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
        "truncate": _truncated,
        "branch": lambda condition, number: condition,
        "quotient": _quotient,
        "wrap": _wrapped,
        "single": lambda a: (
            np.float64(np.float32(a)) if np.ndim(a) == 0 else np.asarray(a, np.float32).astype(np.float64)
        ),
        "pick": _picked,
        "lookup": lambda place, table: _picked(place, *table),
        "item": lambda results, i: results[i],
        "column": lambda results, start, length: results[start : start + length],
        "table": lambda *entries: list(entries),
    }
)
"""What each operation means, on numbers and on NumPy arrays of them."""


def meaning(op: str | Block) -> Callable[..., Any]:
    """What an operation or a block means."""
    return op if isinstance(op, Block) else OPERATIONS[op]


TESTS = {"eq", "ne", "lt", "le", "gt", "ge", "is_finite"}
"""Operations on numbers that give a truth value."""

OF_TESTS = {"and", "or", "xor", "not", "branch"}
"""Those on truth values."""

FEW = 16
"""Entries among which one is picked by choices; more are a table."""

COMMUTATIVE = {"add", "mul", "and", "or", "xor", "eq", "ne"}


class LimitExceededError(Exception):
    """More instructions than allowed."""


class Around:
    """What is around a program that is one of its instructions.

    Attributes
    ----------
    builder : Builder
        Of that.
    inside, outside : dict
        The names that its variables have inside, and the inverse of that.
    tables : dict
        What is in its tables, by their names inside.
    """

    def __init__(self, builder: Builder):
        self.builder = builder
        self.inside: dict[Scalar, str] = {}
        self.outside: dict[Scalar, Scalar] = {}
        self.tables: dict[str, tuple[Scalar, ...]] = {}

    def enter(self, a: Scalar) -> str:
        """The name of a variable inside."""
        if a not in self.inside:
            self.inside[a] = name = f"x0_{len(self.inside)}"
            self.outside[name] = a
        return self.inside[a]

    def table(self, entries: Sequence[Scalar]) -> str:
        """The name inside of a table around, of what these are there."""
        name = self.enter(self.builder.table([self.outside[a] if type(a) is str else a for a in entries]))
        self.tables[name] = tuple(entries)
        return name


class Builder:
    """Collects instructions; each method returns the scalar that holds its result.

    Nothing is emitted for a result that is known, equals an earlier one, or is one but for a sign that can be moved on.
    All this is exact, save for the sign of a zero and one licence: a structural zero times anything, or divided by
    anything, is zero. Sums are never reassociated.

    Parameters
    ----------
    limit : int
        Instructions that it may collect.
    around : Around, optional
        What is around a program inside a loop, or in a routine.
    """

    def __init__(self, limit: int, around: Around | None = None):
        self.limit, self.around = limit, around
        self.instructions: list[Instruction] = []
        self._emitted: dict[tuple[str | Block, ...], str] = {}
        self._opposite: dict[Scalar, str] = {}  # the b of each a = -b
        self._branches: dict[tuple[str, ...], int] = {}
        self.calls: dict[tuple, tuple] = {}

    @property
    def real(self) -> Builder:
        """The builder of real scalars: itself."""
        return self

    def op(self, op: str | Block, *args: Scalar) -> Any:
        """The result of an operation, with no simplification but constants folded and equal expressions merged."""
        if not any(type(a) is str for a in args):
            return fold(op, *args)
        if op in COMMUTATIVE:
            args = tuple(sorted(args, key=str))
        return self._named(op, *args)

    def _named(self, op: str | Block, *args: Scalar) -> str:
        key = (op, *(a if type(a) is str else repr(a) for a in args))  # repr tells 0.0 from -0.0, 1 from True
        name = self._emitted.get(key)
        if name is None:
            if len(self.instructions) >= self.limit:
                raise LimitExceededError
            name = self._emitted[key] = f"t{len(self.instructions)}"
            self.instructions.append(Instruction(name, op, args))
        return name

    def block(self, block: Block, *args: Scalar) -> list[Scalar]:
        """The results of a block."""
        whole = self.op(block, *args)
        if isinstance(whole, str):
            return [self.op("item", whole, i) for i in range(len(block.kinds))]
        return [a.item() if isinstance(a, np.generic | np.ndarray) else a for a in whole]

    def table(self, entries: Sequence[Scalar]) -> str:
        """Entries as one variable, which a loop reads by their numbers: what another loop has made is left as it is.

        Inside a loop those of what is around it are a table there: it is made once.
        """
        if self.around is not None and not any(type(a) is str and a not in self.around.outside for a in entries):
            return self.around.table(entries)
        first = self._made(entries[0]) if entries else None
        if first is not None and first.op == "item":
            whole, start = first.args[0], int(first.args[1])
            if all(self._made(a) == (a, "item", (whole, start + i)) for i, a in enumerate(entries)):
                return self._named("column", whole, start, len(entries))
        return self._named("table", *entries)

    def given(self, entries: Sequence[Scalar]) -> list[tuple[int, int]] | None:
        """The places, of an array and of an entry, that scalars have among the inputs of the outermost program.

        None where one is no input.
        """
        if self.around is not None:
            return self.around.builder.given([self.around.outside.get(a, 0.0) for a in entries])
        if not all(type(a) is str and a[0] == "x" for a in entries):
            return None
        return [(int(place), int(number)) for place, number in (str(a)[1:].split("_") for a in entries)]

    def _made(self, a: Scalar) -> Instruction | None:
        return self.instructions[int(a[1:])] if type(a) is str and a[0] == "t" else None

    def add(self, a, b):
        if type(a) is not str and type(b) is not str:
            return a + b
        if a == 0:
            return b
        if b == 0:
            return a
        if b in self._opposite:
            return self.sub(a, self._opposite[b])
        if a in self._opposite:
            return self.sub(b, self._opposite[a])
        return self.op("add", a, b)

    def sub(self, a, b):
        if type(a) is not str and type(b) is not str:
            return a - b
        if b == 0:
            return a
        if a == 0:
            return self.neg(b)
        if b in self._opposite:
            return self.add(a, self._opposite[b])
        return self.op("sub", a, b)

    def neg(self, a):
        if type(a) is not str:
            return -a
        if a in self._opposite:
            return self._opposite[a]
        result = self.op("neg", a)
        self._opposite[result] = a
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
        return self._signed(self.mul, "mul", a, b)

    def div(self, a, b):
        if type(a) is not str and type(b) is not str:
            return fold("div", a, b)
        if a == 0:
            return abs(a)
        if b == 1:
            return a
        return self._signed(self.div, "div", a, b)

    def _signed(self, method, op, a, b):
        """A product or quotient, minus signs taken out of it."""
        for x, result in (a, lambda y: method(y, b)), (b, lambda y: method(a, y)):
            opposite = self._opposite.get(x) if type(x) is str else -x if x < 0 else None
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
            self.op("pick", place, *entries) if len(entries) <= FEW else self.op("lookup", place, self.table(entries))
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


def fold(op: str | Block, *args: Scalar) -> Any:
    """The value of an operation on numbers, by the rules of IEEE arithmetic: nothing raises."""
    with np.errstate(all="ignore"):
        value = meaning(op)(*(np.float64(a) if type(a) is float else a for a in args))
    return value.item() if isinstance(value, np.generic | np.ndarray) else value


# -- arrays of scalars ----------------------------------------------------------------------------------------------


class Pair:
    """A complex scalar. No sequence, so that NumPy's object arrays take it for one entry."""

    __slots__ = ("im", "re")

    def __init__(self, re: Scalar, im: Scalar):
        self.re, self.im = re, im


def pair(a) -> Pair:
    """A complex number, or a real scalar, as one."""
    if isinstance(a, Pair):
        return a
    return Pair(a.real, a.imag) if isinstance(a, complex) else Pair(a, 0.0)


def constant(value, dtype=None) -> np.ndarray:
    """An array of numbers as an array of scalars, complex ones as pairs."""
    found = np.asarray(value, dtype=dtype)
    if found.dtype.kind != "c":
        return found.astype(object)
    return array([Pair(a.real, a.imag) for a in found.ravel().tolist()], found.shape)


def array(scalars: Sequence[Any], shape) -> np.ndarray:
    result = np.empty(len(scalars), object)
    result[:] = scalars
    return result.reshape(shape)


def elementwise(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    """Apply a function entry by entry."""
    if len({np.shape(x) for x in arrays}) > 1:
        arrays = np.broadcast_arrays(*arrays)
    return array(list(map(function, *(x.ravel().tolist() for x in arrays))), arrays[0].shape)


def entries_along(x: np.ndarray, axes) -> tuple[list[list[Scalar]], tuple[int, ...]]:
    """The entries along some axes, for each place on the others; and the shape of those others."""
    kept = [i for i in range(x.ndim) if i not in axes]
    shape = tuple(x.shape[i] for i in kept)
    size = math.prod(x.shape[i] for i in axes)
    return x.transpose(*kept, *axes).reshape(math.prod(shape), size).tolist(), shape
