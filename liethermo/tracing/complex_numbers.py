"""Complex numbers as pairs of real scalars, while a jaxpr is unrolled: a program itself has real ones alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import reduce

import numpy as np

from .builder import Builder, ComplexPair, Scalar, as_complex_pair, scalar_array


def flatten_scalars(arrays: Sequence[np.ndarray]) -> list[Scalar]:
    """The real scalars in arrays, one after another."""
    found: list[Scalar] = []
    for x in arrays:
        for a in x.ravel().tolist():
            found += [a.re, a.im] if isinstance(a, ComplexPair) else [a]
    return found


def unflatten_scalars(scalars: Iterator[Scalar], avals: Sequence) -> list[np.ndarray]:
    """Arrays of these shapes and types from real scalars one after another: the inverse of :func:`flat`."""
    arrays = []
    for aval in avals:
        size, is_complex = math.prod(aval.shape), aval.dtype.kind == "c"
        entries = [ComplexPair(next(scalars), next(scalars)) if is_complex else next(scalars) for _ in range(size)]
        arrays.append(scalar_array(entries, aval.shape))
    return arrays


def scalar_kinds(avals: Sequence) -> tuple[str, ...]:
    """The kinds of those scalars: see :attr:`.builder.Block.kinds`."""
    return tuple(
        kind
        for aval in avals
        for kind in ("ff" if aval.dtype.kind == "c" else {"b": "b", "f": "f"}.get(aval.dtype.kind, "i"))
        * math.prod(aval.shape)
    )


class ComplexBuilder:
    """A builder's methods on pairs, by those on their parts."""

    def __init__(self, real: Builder):
        self.real, self.max_instructions = real, real.max_instructions

    def add(self, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real
        return ComplexPair(r.add(a.re, b.re), r.add(a.im, b.im))

    def sub(self, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real
        return ComplexPair(r.sub(a.re, b.re), r.sub(a.im, b.im))

    def neg(self, a):
        a, r = as_complex_pair(a), self.real
        return ComplexPair(r.neg(a.re), r.neg(a.im))

    def mul(self, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real
        return ComplexPair(r.sub(r.mul(a.re, b.re), r.mul(a.im, b.im)), r.add(r.mul(a.re, b.im), r.mul(a.im, b.re)))

    def conj(self, a):
        a = as_complex_pair(a)
        return ComplexPair(a.re, self.real.neg(a.im))

    def div(self, a, b):
        """With the divisor scaled, so that its square neither overflows nor vanishes; by infinity it is zero."""
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real
        if type(b.im) is not str and b.im == 0:
            return ComplexPair(r.div(a.re, b.re), r.div(a.im, b.re))
        size = r.max(r.op("abs", b.re), r.op("abs", b.im))
        c, d = r.div(b.re, size), r.div(b.im, size)
        square = r.mul(r.add(r.mul(c, c), r.mul(d, d)), size)
        over = self.mul(a, ComplexPair(c, r.neg(d)))
        infinite = r.op("eq", size, math.inf)
        zero = r.add(r.sub(a.re, a.re), r.sub(a.im, a.im))  # or NaN
        return ComplexPair(*(r.select(infinite, zero, r.div(part, square)) for part in (over.re, over.im)))

    def integer_pow(self, a, n: int, one=1.0):
        if n < 0:
            return self.div(one, self.integer_pow(a, -n))
        return reduce(self.mul, [a] * n, as_complex_pair(one))

    def pow(self, a, b):
        return self.op("exp", self.mul(b, self.op("log", a)))

    def select(self, condition, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real
        return ComplexPair(r.select(condition, a.re, b.re), r.select(condition, a.im, b.im))

    def pick(self, place, entries):
        parts, r = [as_complex_pair(a) for a in entries], self.real
        return ComplexPair(r.pick(place, [a.re for a in parts]), r.pick(place, [a.im for a in parts]))

    def logistic(self, a):
        return self.div(1.0, self.add(1.0, self.op("exp", self.neg(a))))

    def modulus(self, a) -> Scalar:
        """``|a|``, without overflow."""
        a, r = as_complex_pair(a), self.real
        x, y = r.op("abs", a.re), r.op("abs", a.im)
        large, small = r.max(x, y), r.min(x, y)
        ratio = r.div(small, r.select(r.op("gt", large, 0.0), large, 1.0))
        return r.mul(large, r.op("sqrt", r.add(1.0, r.mul(ratio, ratio))))

    def op(self, op: str, *args):
        r = self.real
        if op in ("le", "lt", "ge", "gt") or op not in COMPLEX_OPERATIONS:  # of what is no complex number
            if any(isinstance(a, ComplexPair) for a in args):
                raise NotImplementedError("on complex numbers")
            return r.op(op, *args)
        return getattr(self, f"_{op}")(*map(as_complex_pair, args))

    def _abs(self, a):
        return self.modulus(a)

    def _eq(self, a, b):
        return self.real.op("and", self.real.op("eq", a.re, b.re), self.real.op("eq", a.im, b.im))

    def _ne(self, a, b):
        return self.real.op("or", self.real.op("ne", a.re, b.re), self.real.op("ne", a.im, b.im))

    def _sign(self, a):
        r, size = self.real, self.modulus(a)
        return self.div(a, r.select(r.op("eq", size, 0.0), 1.0, size))

    def _polar(self, size, angle):
        r = self.real
        return ComplexPair(r.mul(size, r.op("cos", angle)), r.mul(size, r.op("sin", angle)))

    def _exp(self, a):
        return self._polar(self.real.op("exp", a.re), a.im)

    def _log(self, a):
        return ComplexPair(self.real.op("log", self.modulus(a)), self.real.op("atan2", a.im, a.re))

    def _log1p(self, a):
        r = self.real
        square = r.add(r.mul(a.re, r.add(2.0, a.re)), r.mul(a.im, a.im))  # |1 + a|^2 - 1, which may overflow
        size = self.modulus(ComplexPair(r.add(1.0, a.re), a.im))
        near = r.mul(0.5, r.op("log1p", square))
        real = r.select(r.op("gt", size, 4.0), r.op("log", size), near)
        return ComplexPair(real, r.op("atan2", a.im, r.add(1.0, a.re)))

    def _expm1(self, a):
        r = self.real
        grown, half = r.op("expm1", a.re), r.op("sin", r.mul(0.5, a.im))
        less = r.mul(-2.0, r.mul(half, half))  # cos - 1
        real = r.add(r.add(grown, less), r.mul(grown, less))
        return ComplexPair(real, r.mul(r.op("exp", a.re), r.op("sin", a.im)))

    def _sqrt(self, a):
        r = self.real
        root = r.op("sqrt", r.mul(0.5, r.add(r.op("abs", a.re), self.modulus(a))))
        zero = r.op("eq", root, 0.0)
        other = r.div(r.op("abs", a.im), r.select(zero, 1.0, r.mul(2.0, root)))
        right = r.op("ge", a.re, 0.0)
        below = r.op("lt", a.im, 0.0)
        imaginary = r.select(right, other, root)
        return ComplexPair(r.select(right, root, other), r.select(below, r.neg(imaginary), imaginary))

    def _sin(self, a):
        r = self.real
        return ComplexPair(
            r.mul(r.op("sin", a.re), r.op("cosh", a.im)),
            r.mul(r.op("cos", a.re), r.op("sinh", a.im)),
        )

    def _cos(self, a):
        r = self.real
        return ComplexPair(
            r.mul(r.op("cos", a.re), r.op("cosh", a.im)),
            r.neg(r.mul(r.op("sin", a.re), r.op("sinh", a.im))),
        )

    def _apply_rotated(self, function, a):
        """``-i f(i a)``."""
        found = function(ComplexPair(self.real.neg(a.im), a.re))
        return ComplexPair(found.im, self.real.neg(found.re))

    def _sinh(self, a):
        return self._apply_rotated(self._sin, a)

    def _cosh(self, a):
        return self._cos(ComplexPair(self.real.neg(a.im), a.re))

    def _tanh(self, a):
        r = self.real
        s, t = r.op("tanh", a.re), r.op("tan", a.im)
        ss, tt = r.mul(s, s), r.mul(t, t)
        below = r.add(1.0, r.mul(ss, tt))
        return ComplexPair(
            r.div(r.mul(s, r.add(1.0, tt)), below),
            r.div(r.mul(t, r.sub(1.0, ss)), below),
        )

    def _tan(self, a):
        return self._apply_rotated(self._tanh, a)


COMPLEX_OPERATIONS = frozenset("abs eq ne sign exp log log1p expm1 sqrt sin cos sinh cosh tanh tan".split())
"""Operations that are known of complex numbers."""
