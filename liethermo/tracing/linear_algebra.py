"""How the primitives of linear algebra, of sorting, convolution and of special functions become instructions."""

from __future__ import annotations

import functools
import itertools
import math
from functools import reduce

import numpy as np

from .builder import ComplexPair, Scalar, as_complex_pair, constant_array, elementwise, scalar_array
from .calls import LapackCall, MatrixProduct
from .complex_numbers import ComplexBuilder

MAX_UNROLLED_LU_ROWS = 4
"""Rows of a matrix whose elimination is unrolled; a larger one is LAPACK's."""

MAX_BUBBLE_SORT_ENTRIES = 16
"""Entries that are sorted by exchanging neighbours; more take a network whose size grows as n log(n)^2."""


def _matrix_stack(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1, *x.shape[-2:])


def call_lapack(b, name: str, sizes: tuple[int, ...], *matrices: np.ndarray) -> list[np.ndarray]:
    """The results of a call, as arrays of scalars."""
    is_complex = isinstance(b, ComplexBuilder)
    call = _cached_call(name, sizes, is_complex)
    given: list[Scalar] = []
    for x in matrices:
        entries = x.ravel().tolist()
        given += [a.re for a in entries] + [a.im for a in entries] if is_complex else entries
    found, arrays = iter(b.real.emit_block(call, *given)), []
    for shape, real in call.result_specs:
        size = math.prod(shape)
        parts = list(itertools.islice(found, size))
        if is_complex and not real:
            parts = [ComplexPair(re, im) for re, im in zip(parts, list(itertools.islice(found, size)), strict=True)]
        arrays.append(scalar_array(parts, shape))
    return arrays


@functools.lru_cache(maxsize=256)
def _cached_call(*what) -> LapackCall:
    """One object for equal calls, so that those of the same matrices merge."""
    return LapackCall(*what)


def matrix_product(b, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The product of two matrices, as a loop; of complex ones those of their parts."""
    if not isinstance(b, ComplexBuilder):
        (table_x, steps_x), (table_y, steps_y) = _matrix_table(b, x), _matrix_table(b, y)
        sizes = (*x.shape, y.shape[1])
        return scalar_array(
            b.emit_block(MatrixProduct(sizes, (steps_x, steps_y)), table_x, table_y), (x.shape[0], y.shape[1])
        )
    (a, c), (d, e) = (
        [elementwise(lambda v, k=k: getattr(as_complex_pair(v), k), m) for k in ("re", "im")] for m in (x, y)
    )
    ad, ce, ae, cd = (matrix_product(b.real, *both) for both in ((a, d), (c, e), (a, e), (c, d)))
    return elementwise(ComplexPair, elementwise(b.real.sub, ad, ce), elementwise(b.real.add, ae, cd))


def input_table(b, x: np.ndarray) -> tuple[str, tuple[int, int]] | None:
    """A matrix that lies in memory as it is given, such as parameters, or its transpose: nothing is copied.

    Its table, and how far apart entries are there of neighbouring rows, and of neighbouring columns.
    """
    names = x.ravel().tolist()
    outer = b.input_indices(names)
    if outer is None or len({place for place, _ in outer}) > 1:
        return None
    numbers = np.array([number for _, number in outer]).reshape(x.shape)
    rows, columns = x.shape
    for steps in ((columns, 1), (1, rows)):
        if (numbers - numbers[0, 0] == np.add.outer(steps[0] * np.arange(rows), steps[1] * np.arange(columns))).all():
            return b.table([names[i] for i in np.argsort(numbers, axis=None)]), steps
    return None


def _matrix_table(b, x: np.ndarray) -> tuple[str, tuple[int, int]]:
    return input_table(b, x) or (b.table(x.ravel().tolist()), (x.shape[1], 1))


def _map_matrices(b, eqn, x: np.ndarray, function) -> list[np.ndarray]:
    """``function`` of each matrix in x, shape (..., m, n): arrays with the same axes in front."""
    found = [function(a) for a in _matrix_stack(x)]
    outputs = []
    for var, parts in zip(eqn.outvars, zip(*found, strict=True), strict=True):
        outputs.append(scalar_array([a for part in parts for a in part.ravel().tolist()], var.aval.shape))
    return outputs


def eigh(b, eqn, a):
    if eqn.params["subset_by_index"] not in (None, (0, a.shape[-1])):
        raise NotImplementedError("of some eigenvalues alone")
    lower = eqn.params["lower"]

    def eigh_of_matrix(m):
        m = m if lower else m.T if not isinstance(b, ComplexBuilder) else elementwise(b.conj, m.T)
        return call_lapack(b, "eigh", (len(m),), m)

    return _map_matrices(b, eqn, a, eigh_of_matrix)


def _swap_rows(b, x: np.ndarray, k: int, place: Scalar) -> np.ndarray:
    """A matrix with row k and the row at a place, which is not before k, in each other's place."""
    x, first, rest = x.copy(), x[k].copy(), x[k:].copy()
    for j in range(x.shape[1]):
        x[k, j] = b.pick(b.real.sub(place, k), list(rest[:, j]))
    for i in range(k + 1, len(x)):
        hit = b.real.op("eq", place, i)
        for j in range(x.shape[1]):
            x[i, j] = b.select(hit, first[j], x[i, j])
    return x


def _unrolled_lu(b, a: np.ndarray) -> tuple[np.ndarray, list[Scalar]]:
    """LU factors with the largest pivots, and the row that each is exchanged with."""
    a, r = a.copy(), b.real
    pivots: list[Scalar] = []
    for k in range(min(a.shape)):
        sizes = [r.op("abs", v) if not isinstance(b, ComplexBuilder) else b.modulus(v) for v in a[k:, k]]
        best, at = sizes[0], k
        for i, size in enumerate(sizes[1:], k + 1):
            larger = r.op("gt", size, best)
            best, at = r.select(larger, size, best), r.select(larger, i, at)
        a = _swap_rows(b, a, k, at)
        pivots.append(at)
        for i in range(k + 1, len(a)):
            factor = b.div(a[i, k], a[k, k])
            # a column of zeros stays one, as LAPACK has it
            zero = b.op("eq", a[k, k], 0.0)
            a[i, k] = b.select(zero, a[i, k], factor)
            for j in range(k + 1, a.shape[1]):
                a[i, j] = b.sub(a[i, j], b.mul(a[i, k], a[k, j]))
    return a, pivots


def lu(b, eqn, a):
    m, n = a.shape[-2:]
    r = b.real

    def lu_of_matrix(x):
        if m <= MAX_UNROLLED_LU_ROWS and n <= MAX_UNROLLED_LU_ROWS:
            factors, pivots = _unrolled_lu(b, x)
        else:
            factors, found = call_lapack(b, "lu", (m, n), x)
            pivots = [r.op("truncate", p) for p in found.tolist()]
        order = constant_array(np.arange(m)[:, None])
        for k, place in enumerate(pivots):
            order = _swap_rows(r, order, k, place)
        return factors, scalar_array(pivots, (len(pivots),)), order[:, 0]

    return _map_matrices(b, eqn, a, lu_of_matrix)


def inverse(b, eqn, a):
    """The primitive is the library's own: see :func:`..engines.stages.newton_steps`."""
    return _map_matrices(b, eqn, a, lambda x: call_lapack(b, "inverse", (len(x),), x))


def qr(b, eqn, a):
    if eqn.params["pivoting"]:
        raise NotImplementedError("with pivoting")
    m, n = a.shape[-2:]
    columns = m if eqn.params["full_matrices"] else min(m, n)
    return _map_matrices(b, eqn, a, lambda x: call_lapack(b, "qr", (m, n, columns), x))


def svd(b, eqn, a):
    if eqn.params["subset_by_index"] not in (None, (0, min(a.shape[-2:]))):
        raise NotImplementedError("of some singular values alone")
    m, n = a.shape[-2:]
    full = int(eqn.params["full_matrices"]) if eqn.params["compute_uv"] else 0

    def svd_of_matrix(x):
        found = call_lapack(b, "svd", (m, n, full), x)
        return found if eqn.params["compute_uv"] else found[:1]

    return _map_matrices(b, eqn, a, svd_of_matrix)


def cholesky(b, eqn, a):
    n, r = a.shape[-1], b.real
    lower = constant_array(np.zeros(a.shape))
    for A, L in zip(_matrix_stack(a), _matrix_stack(lower), strict=True):
        positive: Scalar = True
        for j in range(n):
            pivot = reduce(b.sub, (b.mul(v, b.conj(v)) for v in L[j, :j]), A[j, j])
            size = pivot.re if isinstance(pivot, ComplexPair) else pivot
            positive = r.op("and", positive, r.op("gt", size, 0.0))
            root = r.op("sqrt", size)
            L[j, j] = ComplexPair(root, 0.0) if isinstance(pivot, ComplexPair) else root
            for i in range(j + 1, n):
                products = (b.mul(u, b.conj(v)) for u, v in zip(L[i, :j], L[j, :j], strict=True))
                L[i, j] = b.div(reduce(b.sub, products, A[i, j]), L[j, j])
        L[...] = elementwise(lambda v, ok=positive: b.select(ok, v, math.nan), L)
    return elementwise(lambda v: b.add(v, 0.0), lower) if isinstance(b, ComplexBuilder) else lower


def triangular_solve(b, eqn, a, rhs):
    """``x`` with ``a x = rhs``, or ``x a = rhs``, by substitution."""
    params = eqn.params
    if params["transpose_a"] and params["conjugate_a"]:
        a = elementwise(b.conj, a)
    if params["transpose_a"] == params["left_side"]:
        a = a.swapaxes(-1, -2)
    if not params["left_side"]:
        rhs = rhs.swapaxes(-1, -2)
    lower = params["lower"] != (params["transpose_a"] == params["left_side"])
    n, x = a.shape[-1], rhs.copy()
    order = range(n) if lower else range(n)[::-1]
    for A, X in zip(_matrix_stack(a), _matrix_stack(x), strict=True):
        for done, i in enumerate(order):
            for k in range(X.shape[1]):
                rest = reduce(b.sub, (b.mul(A[i, j], X[j, k]) for j in order[:done]), X[i, k])
                X[i, k] = rest if params["unit_diagonal"] else b.div(rest, A[i, i])
    return x if params["left_side"] else x.swapaxes(-1, -2)


# -- sorting ----------------------------------------------------------------------------------------------------------


def is_sorted_before(b, kind: str, x: Scalar, y: Scalar) -> Scalar:
    """Whether x stands before y where numbers are in order: NaN is the last."""
    less = b.op("lt", x, y)
    return less if kind != "f" else b.op("or", less, b.op("and", b.op("ne", y, y), b.op("eq", x, x)))


def _sorting_network(n: int):
    """Pairs of places to be compared: neighbours, which keeps the order of what is alike; or Batcher's [Knuth]."""
    if n <= MAX_BUBBLE_SORT_ENTRIES:
        yield from ((j, j + 1) for i in range(n) for j in range(n - 1 - i))
        return
    t = (n - 1).bit_length()
    p = 1 << (t - 1)
    while p:
        q, rest, d = 1 << (t - 1), 0, p
        while True:
            yield from ((i, i + d) for i in range(n - d) if i & p == rest)
            if q == p:
                break
            d, q, rest = q - p, q >> 1, p
        p >>= 1


def sort(b, eqn, *operands):
    axis, keys = eqn.params["dimension"], eqn.params["num_keys"]
    n = operands[0].shape[axis]
    kinds = ["f" if var.aval.dtype.kind == "f" else "i" for var in eqn.invars[:keys]]
    moved = [np.moveaxis(x, axis, -1).copy() for x in operands]
    for place in np.ndindex(*moved[0].shape[:-1]):
        rows = [x[place].tolist() for x in moved]
        key_rows, more = list(rows[:keys]), []
        own = list(kinds)
        if n > MAX_BUBBLE_SORT_ENTRIES:  # the network does not keep the order of what is alike
            more, own = [list(range(n))], [*kinds, "i"]
        for i, j in _sorting_network(n):
            swaps: Scalar = False
            for key, kind in reversed(list(zip([*key_rows, *more], own, strict=True))):
                other = is_sorted_before(b, kind, key[j], key[i])
                alike = b.op("not", b.op("or", other, is_sorted_before(b, kind, key[i], key[j])))
                swaps = b.op("or", other, b.op("and", alike, swaps))
            for row in (*rows, *more):
                row[i], row[j] = b.select(swaps, row[j], row[i]), b.select(swaps, row[i], row[j])
        for x, row in zip(moved, rows, strict=True):
            x[place] = scalar_array(row, (n,))
    return [np.moveaxis(x, -1, axis) for x in moved]


def total_order_rule(op: str):
    """``lt_to`` and ``le_to``: NaN is the last of all numbers, and -0 stands before 0."""

    def rule(b, eqn, x, y):
        kind = eqn.invars[0].aval.dtype.kind

        def is_less(u, v):
            if kind != "f":
                return b.op("lt", u, v)
            zeros = b.op("and", b.op("eq", u, 0.0), b.op("eq", v, 0.0))
            signs = b.op("lt", b.div(1.0, u), b.div(1.0, v))
            return b.op("or", is_sorted_before(b, kind, u, v), b.op("and", zeros, signs))

        return elementwise(is_less if op == "lt" else lambda u, v: b.op("not", is_less(v, u)), x, y)

    return rule


# -- convolution ------------------------------------------------------------------------------------------------------


def convolution(b, eqn, x, kernel):
    """``conv_general_dilated``: the sum of the products that fall together."""
    params, dims = eqn.params, eqn.params["dimension_numbers"]
    if params["batch_group_count"] != 1:
        raise NotImplementedError("with groups of batches")
    x, kernel = x.transpose(dims.lhs_spec), kernel.transpose(dims.rhs_spec)
    shape = tuple(eqn.outvars[0].aval.shape[i] for i in dims.out_spec)
    groups, inputs = params["feature_group_count"], kernel.shape[1]
    result = np.empty(shape, object)
    for place in np.ndindex(*shape):
        n, channel, at = place[0], place[1], place[2:]
        first = channel // (shape[1] // groups) * inputs
        products = []
        for offset in np.ndindex(*kernel.shape[2:]):
            source = []
            for i, j, stride, (low, _), dilation, spread, size in zip(
                at,
                offset,
                params["window_strides"],
                params["padding"],
                params["lhs_dilation"],
                params["rhs_dilation"],
                x.shape[2:],
                strict=True,
            ):
                where, rest = divmod(i * stride + j * spread - low, dilation)
                if rest or not 0 <= where < size:
                    break
                source.append(where)
            else:
                products += [b.mul(x[(n, first + c, *source)], kernel[(channel, c, *offset)]) for c in range(inputs)]
        result[place] = reduce(b.add, products, 0.0)
    return result.transpose(np.argsort(dims.out_spec))


# -- special functions ------------------------------------------------------------------------------------------------

EULER_MACLAURIN_DIVISORS = [12.0, -720.0, 30240.0, -1209600.0, 47900160.0, -1.8924375803183791606e9, 7.47242496e10]
EULER_MACLAURIN_DIVISORS += [-2.950130727918164224e12, 1.1646782814350067249e14, -4.5979787224074726105e15]
EULER_MACLAURIN_DIVISORS += [1.8152105401943546773e17, -7.1661652561756670113e18]
"""Divisors ``(2 j)! / B_2j`` of the terms j = 1, 2, ... of the asymptotic series of ``zeta``."""

ZETA_DIRECT_TERMS = 10
"""Terms that are summed before the asymptotic series of ``zeta`` begins."""


def zeta(b, s: Scalar, q: Scalar) -> Scalar:
    """Return Hurwitz's ``sum_k (q + k)^-s`` by the formula of Euler and Maclaurin, term by term as XLA computes it.

    For q < 0 and an integer s too, but the series is of little use where ``q + 10`` is not well above zero.
    """
    minus = b.neg(s)
    total = reduce(b.add, (b.pow(b.add(q, float(k)), minus) for k in range(ZETA_DIRECT_TERMS)))
    at = b.add(q, float(ZETA_DIRECT_TERMS))
    power = b.pow(at, minus)
    total = b.add(total, b.div(b.mul(power, at), b.sub(s, 1.0)))
    inverse_square, series = b.div(1.0, b.mul(at, at)), 0.0
    for j in reversed(range(1, len(EULER_MACLAURIN_DIVISORS))):
        rising = b.mul(b.add(s, 2.0 * j), b.add(s, 2.0 * j - 1.0))
        series = b.mul(rising, b.mul(inverse_square, b.add(series, 1.0 / EULER_MACLAURIN_DIVISORS[j])))
    series = b.add(series, 1.0 / EULER_MACLAURIN_DIVISORS[0])
    total = b.add(total, b.mul(power, b.add(b.mul(b.div(s, at), series), 0.5)))

    def is_integer(a: Scalar) -> Scalar:
        return b.op("eq", a, b.op("floor", a))

    below = b.op("le", q, 0.0)
    is_even = b.op("and", is_integer(s), b.op("eq", b.op("rem", s, 2.0), 0.0))
    undefined = b.op("or", b.op("lt", s, 1.0), b.op("and", below, b.op("not", is_integer(s))))
    at_pole = b.op("and", below, is_integer(q))
    total = b.select(at_pole, b.select(is_even, math.inf, math.nan), b.select(undefined, math.nan, total))
    return b.select(b.op("eq", s, 1.0), math.inf, total)


def digamma(b, x: Scalar) -> Scalar:
    """Return the logarithmic derivative of the gamma function: NaN at zero, as XLA has it."""
    return b.select(b.op("eq", x, 0.0), math.nan, b.op("digamma", x))


def lgamma(b, x: Scalar) -> Scalar:
    """Return ``log(abs(gamma(x)))``: infinity at minus infinity, as XLA has it."""
    return b.select(b.op("eq", x, -math.inf), math.inf, b.op("lgamma", x))


def incomplete_gamma_rule(op: str):
    """Return the rule of ``igamma`` or ``igammac``, which JAX leaves undefined at some limits.

    So it is for a = 0 and x < 1 (``igamma`` alone), and for an infinite a and a finite x >= 1.
    """
    limit = 1.0 if op == "igamma" else 0.0

    def incomplete_gamma_of(b, a: Scalar, x: Scalar) -> Scalar:
        found = b.op(op, a, x)
        if op == "igamma":
            found = b.select(b.op("and", b.op("eq", a, 0.0), b.op("lt", x, 1.0)), math.nan, found)
        infinite = b.op("and", b.op("eq", a, math.inf), b.op("ge", x, 1.0))
        return b.select(infinite, b.select(b.op("eq", x, math.inf), limit, math.nan), found)

    return lambda b, eqn, a, x: elementwise(lambda u, v: incomplete_gamma_of(b, u, v), a, x)


def polygamma(b, eqn, order, x):
    """The derivatives of digamma."""

    def polygamma_of(m, v):
        if type(m) is str:
            raise NotImplementedError("of an order that is not known at compile time")
        if not math.isfinite(m) or m != int(m) or m < 0:
            return math.nan
        if m == 0:
            return digamma(b, v)
        sign = 1.0 if int(m) % 2 else -1.0
        return b.mul(sign * math.factorial(int(m)), zeta(b, m + 1.0, v))

    return elementwise(polygamma_of, order, x)
