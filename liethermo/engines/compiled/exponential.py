"""Exponential function as instructions for all lanes at once: the C library takes one number at a time."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir

MAX_NORMAL_ARGUMENT = 700.0
"""Largest magnitude of an argument whose exponential is not subnormal; the C library computes the others."""

LOG2_HIGH = float.fromhex("0x1.62e42fee00000p-1")
"""log(2) without its last bits, so that its product with an integer up to 2^11 is exact."""

LOG2_LOW = float.fromhex("0x1.a39ef35793c76p-33")
"""log(2) - LOG2_HIGH."""

ROUND_TO_INT_SHIFT = 1.5 * 2.0**52
"""Shift that rounds a number to the nearest integer, which is then in the last bits of the sum."""

SERIES_DEGREE = 13
"""Degree of the power series of exp on arguments below log(2) / 2; its truncation error is 4e-18."""


def write_exponential(writer: Any, x: ir.Value) -> ir.Value:
    """Write ``exp(x) = 2^k exp(r)`` with ``x = k log 2 + r``, to one unit in the last place.

    Parameters
    ----------
    writer : ProgramWriter
    """
    build = writer.builder
    is_normal = build.fcmp_ordered("<", writer.write_operation("abs", [x]), writer.constant(MAX_NORMAL_ARGUMENT))
    fast_result = _write_fast_exponential(writer, x)
    fast_block = build.block
    with build.if_then(writer.has_true_lane(build.not_(is_normal)), likely=False):
        exact_result = build.select(is_normal, fast_result, writer.call_per_lane("exp", [x]))
        exact_block = build.block
    result = build.phi(writer.double_type)
    result.add_incoming(fast_result, fast_block)
    result.add_incoming(exact_result, exact_block)
    return result


def _write_fast_exponential(writer: Any, x: ir.Value) -> ir.Value:
    build = writer.builder

    def multiply_add(a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        return writer.call_intrinsic("llvm.fmuladd", (a, b, c), writer.double_type)

    rounding_shift = writer.constant(ROUND_TO_INT_SHIFT)
    shifted_k = multiply_add(x, writer.constant(1.0 / math.log(2.0)), rounding_shift)
    k = build.fsub(shifted_k, rounding_shift)
    r = multiply_add(k, writer.constant(-LOG2_LOW), multiply_add(k, writer.constant(-LOG2_HIGH), x))
    # exp(r) = 1 + (r + r^2 q(r)); q is summed by independent pairs
    terms = [writer.constant(1.0 / math.factorial(n)) for n in range(2, SERIES_DEGREE + 1)]
    power = r
    square = build.fmul(r, r)
    while len(terms) > 1:
        pairs = [multiply_add(power, high, low) for low, high in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + terms[2 * len(pairs) :]
        power = square if power is r else build.fmul(power, power)
    bits = build.shl(build.bitcast(shifted_k, writer.int_type), writer.constant(52))  # only the bits of k are left
    scale = build.bitcast(build.add(bits, writer.constant(1023 << 52)), writer.double_type)
    return build.fmul(scale, build.fadd(writer.constant(1.0), multiply_add(square, terms[0], r)))
