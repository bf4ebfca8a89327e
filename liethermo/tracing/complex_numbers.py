"""Complex numbers as pairs of real scalars while a jaxpr is unrolled; the program itself has real scalars only."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import reduce

import numpy as np

from .builder import ComplexPair, ProgramBuilder, Scalar, as_complex_pair, scalar_array


def flatten_scalars(arrays: Sequence[np.ndarray]) -> list[Scalar]:
    """Return the real scalars of arrays as one list; a complex entry contributes two."""
    scalars: list[Scalar] = []
    for x in arrays:
        for a in x.ravel().tolist():
            scalars += [a.re, a.im] if isinstance(a, ComplexPair) else [a]
    return scalars


def unflatten_scalars(scalars: Iterator[Scalar], avals: Sequence) -> list[np.ndarray]:
    """Return arrays of these types from a sequence of real scalars; the inverse of :func:`flatten_scalars`."""
    arrays = []
    for aval in avals:
        n_entries, is_complex = math.prod(aval.shape), aval.dtype.kind == "c"
        entries = [ComplexPair(next(scalars), next(scalars)) if is_complex else next(scalars) for _ in range(n_entries)]
        arrays.append(scalar_array(entries, aval.shape))
    return arrays


def real_scalar_kinds(avals: Sequence) -> tuple[str, ...]:
    """Return the kind of each real scalar of arrays with these avals, ``"f"``, ``"i"`` or ``"b"``, in one tuple."""
    return tuple(
        kind
        for aval in avals
        for kind in ("ff" if aval.dtype.kind == "c" else {"b": "b", "f": "f"}.get(aval.dtype.kind, "i"))
        * math.prod(aval.shape)
    )


class ComplexBuilder:
    """A builder of complex arithmetic, which calls a real builder for the real and imaginary parts."""

    def __init__(self, real_builder: ProgramBuilder):
        self.real_builder, self.max_instructions = real_builder, real_builder.max_instructions

    def add(self, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real_builder
        return ComplexPair(r.add(a.re, b.re), r.add(a.im, b.im))

    def sub(self, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real_builder
        return ComplexPair(r.sub(a.re, b.re), r.sub(a.im, b.im))

    def neg(self, a):
        a, r = as_complex_pair(a), self.real_builder
        return ComplexPair(r.neg(a.re), r.neg(a.im))

    def mul(self, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real_builder
        return ComplexPair(r.sub(r.mul(a.re, b.re), r.mul(a.im, b.im)), r.add(r.mul(a.re, b.im), r.mul(a.im, b.re)))

    def conj(self, a):
        a = as_complex_pair(a)
        return ComplexPair(a.re, self.real_builder.neg(a.im))

    def div(self, a, b):
        """Return a / b, with b scaled so that ``|b|^2`` neither overflows nor underflows; a / infinity is zero."""
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real_builder
        if type(b.im) is not str and b.im == 0:
            return ComplexPair(r.div(a.re, b.re), r.div(a.im, b.re))
        scale = r.max(r.op("abs", b.re), r.op("abs", b.im))
        c, d = r.div(b.re, scale), r.div(b.im, scale)
        square = r.mul(r.add(r.mul(c, c), r.mul(d, d)), scale)
        numerator = self.mul(a, ComplexPair(c, r.neg(d)))
        is_infinite = r.op("eq", scale, math.inf)
        zero = r.add(r.sub(a.re, a.re), r.sub(a.im, a.im))  # or NaN
        return ComplexPair(
            *(r.select(is_infinite, zero, r.div(component, square)) for component in (numerator.re, numerator.im))
        )

    def integer_pow(self, a, n: int, unit=1.0):
        if n < 0:
            return self.div(unit, self.integer_pow(a, -n))
        return reduce(self.mul, [a] * n, as_complex_pair(unit))

    def pow(self, a, b):
        return self.op("exp", self.mul(b, self.op("log", a)))

    def select(self, condition, a, b):
        a, b, r = as_complex_pair(a), as_complex_pair(b), self.real_builder
        return ComplexPair(r.select(condition, a.re, b.re), r.select(condition, a.im, b.im))

    def pick(self, index, entries):
        pairs, r = [as_complex_pair(a) for a in entries], self.real_builder
        return ComplexPair(r.pick(index, [a.re for a in pairs]), r.pick(index, [a.im for a in pairs]))

    def logistic(self, a):
        return self.div(1.0, self.add(1.0, self.op("exp", self.neg(a))))

    def modulus(self, a) -> Scalar:
        """Return ``|a|``, without overflow."""
        a, r = as_complex_pair(a), self.real_builder
        x, y = r.op("abs", a.re), r.op("abs", a.im)
        maximum, minimum = r.max(x, y), r.min(x, y)
        ratio = r.div(minimum, r.select(r.op("gt", maximum, 0.0), maximum, 1.0))
        return r.mul(maximum, r.op("sqrt", r.add(1.0, r.mul(ratio, ratio))))

    def op(self, op: str, *args):
        """Return the result of an operation; raise NotImplementedError if it has no rule for complex arguments."""
        r = self.real_builder
        if op in ("le", "lt", "ge", "gt") or op not in COMPLEX_OPERATIONS:  # operations on real numbers
            if any(isinstance(a, ComplexPair) for a in args):
                raise NotImplementedError("on complex numbers")
            return r.op(op, *args)
        return getattr(self, f"_{op}")(*map(as_complex_pair, args))

    def _abs(self, a):
        return self.modulus(a)

    def _eq(self, a, b):
        return self.real_builder.op(
            "and", self.real_builder.op("eq", a.re, b.re), self.real_builder.op("eq", a.im, b.im)
        )

    def _ne(self, a, b):
        return self.real_builder.op(
            "or", self.real_builder.op("ne", a.re, b.re), self.real_builder.op("ne", a.im, b.im)
        )

    def _sign(self, a):
        r, modulus = self.real_builder, self.modulus(a)
        return self.div(a, r.select(r.op("eq", modulus, 0.0), 1.0, modulus))

    def _complex_from_polar(self, modulus, angle):
        """Return ``modulus * exp(i angle)``."""
        r = self.real_builder
        return ComplexPair(r.mul(modulus, r.op("cos", angle)), r.mul(modulus, r.op("sin", angle)))

    def _exp(self, a):
        return self._complex_from_polar(self.real_builder.op("exp", a.re), a.im)

    def _log(self, a):
        return ComplexPair(self.real_builder.op("log", self.modulus(a)), self.real_builder.op("atan2", a.im, a.re))

    def _log1p(self, a):
        r = self.real_builder
        square = r.add(r.mul(a.re, r.add(2.0, a.re)), r.mul(a.im, a.im))  # |1 + a|^2 - 1, which may overflow
        modulus = self.modulus(ComplexPair(r.add(1.0, a.re), a.im))
        log_near_one = r.mul(0.5, r.op("log1p", square))
        real = r.select(r.op("gt", modulus, 4.0), r.op("log", modulus), log_near_one)
        return ComplexPair(real, r.op("atan2", a.im, r.add(1.0, a.re)))

    def _expm1(self, a):
        r = self.real_builder
        real_expm1, sin_half = r.op("expm1", a.re), r.op("sin", r.mul(0.5, a.im))
        cos_minus_one = r.mul(-2.0, r.mul(sin_half, sin_half))
        real = r.add(r.add(real_expm1, cos_minus_one), r.mul(real_expm1, cos_minus_one))
        return ComplexPair(real, r.mul(r.op("exp", a.re), r.op("sin", a.im)))

    def _sqrt(self, a):
        r = self.real_builder
        root = r.op("sqrt", r.mul(0.5, r.add(r.op("abs", a.re), self.modulus(a))))
        zero = r.op("eq", root, 0.0)
        quotient = r.div(r.op("abs", a.im), r.select(zero, 1.0, r.mul(2.0, root)))
        is_right_half = r.op("ge", a.re, 0.0)
        is_lower_half = r.op("lt", a.im, 0.0)
        imaginary = r.select(is_right_half, quotient, root)
        return ComplexPair(
            r.select(is_right_half, root, quotient), r.select(is_lower_half, r.neg(imaginary), imaginary)
        )

    def _sin(self, a):
        r = self.real_builder
        return ComplexPair(
            r.mul(r.op("sin", a.re), r.op("cosh", a.im)),
            r.mul(r.op("cos", a.re), r.op("sinh", a.im)),
        )

    def _cos(self, a):
        r = self.real_builder
        return ComplexPair(
            r.mul(r.op("cos", a.re), r.op("cosh", a.im)),
            r.neg(r.mul(r.op("sin", a.re), r.op("sinh", a.im))),
        )

    def _minus_i_f_of_i_a(self, function, a):
        """Return ``-i f(i a)`` of a complex number, which gives sinh from sin, and tan from tanh."""
        result = function(ComplexPair(self.real_builder.neg(a.im), a.re))
        return ComplexPair(result.im, self.real_builder.neg(result.re))

    def _sinh(self, a):
        return self._minus_i_f_of_i_a(self._sin, a)

    def _cosh(self, a):
        return self._cos(ComplexPair(self.real_builder.neg(a.im), a.re))

    def _tanh(self, a):
        r = self.real_builder
        s, t = r.op("tanh", a.re), r.op("tan", a.im)
        ss, tt = r.mul(s, s), r.mul(t, t)
        denominator = r.add(1.0, r.mul(ss, tt))
        return ComplexPair(
            r.div(r.mul(s, r.add(1.0, tt)), denominator),
            r.div(r.mul(t, r.sub(1.0, ss)), denominator),
        )

    def _tan(self, a):
        return self._minus_i_f_of_i_a(self._tanh, a)


COMPLEX_OPERATIONS = frozenset("abs eq ne sign exp log log1p expm1 sqrt sin cos sinh cosh tanh tan".split())
"""Operations that are implemented for complex numbers."""
