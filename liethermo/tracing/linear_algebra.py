"""Unrolling rules for linear algebra, sorting, convolution and special functions."""

from __future__ import annotations

import functools
import itertools
import math
from functools import reduce

import numpy as np

from .builder import ComplexPair, Scalar, as_complex_pair, constant_array, map_elementwise, scalar_array
from .calls import LapackCall, MatrixProduct
from .complex_numbers import ComplexBuilder

MAX_UNROLLED_LU_ROWS = 4
"""Largest number of rows of a matrix whose LU factorisation is unrolled; LAPACK factorises larger ones."""

MAX_BUBBLE_SORT_ENTRIES = 16
"""Largest number of entries that are sorted by exchanging neighbours; more use a network of size O(n log(n)^2)."""


def _flatten_batch_axes(x: np.ndarray) -> np.ndarray:
    """Return an array of matrices, shape (..., m, n), as a stack of matrices, shape (k, m, n)."""
    return x.reshape(-1, *x.shape[-2:])


def call_lapack(builder, name: str, sizes: tuple[int, ...], *matrices: np.ndarray) -> list[np.ndarray]:
    """Call a LAPACK function; return its results as arrays of scalars."""
    is_complex = isinstance(builder, ComplexBuilder)
    call = _shared_lapack_call(name, sizes, is_complex)
    arguments: list[Scalar] = []
    for x in matrices:
        entries = x.ravel().tolist()
        arguments += [a.re for a in entries] + [a.im for a in entries] if is_complex else entries
    results, arrays = iter(builder.real_builder.emit_block(call, *arguments)), []
    for shape, is_real in call.result_specs:
        n_entries = math.prod(shape)
        result_entries = list(itertools.islice(results, n_entries))
        if is_complex and not is_real:
            result_entries = [
                ComplexPair(re, im)
                for re, im in zip(result_entries, list(itertools.islice(results, n_entries)), strict=True)
            ]
        arrays.append(scalar_array(result_entries, shape))
    return arrays


@functools.lru_cache(maxsize=256)
def _shared_lapack_call(name: str, sizes: tuple[int, ...], is_complex: bool) -> LapackCall:
    """Return the LAPACK call with these arguments; equal arguments give one object, so that equal calls merge."""
    return LapackCall(name, sizes, is_complex)


def matrix_product_by_loop(builder, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the product of two matrices, computed in a loop; a complex product is four real ones."""
    if not isinstance(builder, ComplexBuilder):
        (table_x, strides_x), (table_y, strides_y) = (
            _make_table_and_strides(builder, x),
            _make_table_and_strides(builder, y),
        )
        sizes = (*x.shape, y.shape[1])
        return scalar_array(
            builder.emit_block(MatrixProduct(sizes, (strides_x, strides_y)), table_x, table_y), (x.shape[0], y.shape[1])
        )
    (a, c), (d, e) = (
        [map_elementwise(lambda v, k=k: getattr(as_complex_pair(v), k), m) for k in ("re", "im")] for m in (x, y)
    )
    ad, ce, ae, cd = (
        matrix_product_by_loop(builder.real_builder, *factors) for factors in ((a, d), (c, e), (a, e), (c, d))
    )
    return map_elementwise(
        ComplexPair,
        map_elementwise(builder.real_builder.sub, ad, ce),
        map_elementwise(builder.real_builder.add, ae, cd),
    )


def input_table_and_strides_or_none(builder, x: np.ndarray) -> tuple[str, tuple[int, int]] | None:
    """Return the name of a table and the strides by which it holds a matrix, if the matrix is an input of the program.

    The strides are the distances in the table between neighbouring rows and between neighbouring columns; nothing is
    copied. The matrix may be the transpose of an input. The result is None if it is not an input.
    """
    names = x.ravel().tolist()
    positions = builder.input_positions_or_none(names)
    if positions is None or len({array_index for array_index, _ in positions}) > 1:
        return None
    entry_indices = np.array([entry_index for _, entry_index in positions]).reshape(x.shape)
    rows, columns = x.shape
    for strides in ((columns, 1), (1, rows)):
        if (
            entry_indices - entry_indices[0, 0]
            == np.add.outer(strides[0] * np.arange(rows), strides[1] * np.arange(columns))
        ).all():
            return builder.make_table([names[i] for i in np.argsort(entry_indices, axis=None)]), strides
    return None


def _make_table_and_strides(builder, x: np.ndarray) -> tuple[str, tuple[int, int]]:
    """Return the name of a table that holds a matrix, and its strides; the table is an input in place if possible."""
    return input_table_and_strides_or_none(builder, x) or (builder.make_table(x.ravel().tolist()), (x.shape[1], 1))


def _map_matrices(builder, eqn, x: np.ndarray, function) -> list[np.ndarray]:
    """Apply ``function`` to each matrix of x, shape (..., m, n); return arrays with the same leading axes."""
    results = [function(a) for a in _flatten_batch_axes(x)]
    outputs = []
    for var, matrices in zip(eqn.outvars, zip(*results, strict=True), strict=True):
        outputs.append(scalar_array([a for matrix in matrices for a in matrix.ravel().tolist()], var.aval.shape))
    return outputs


def eigh(builder, eqn, a):
    """Unroll ``eigh`` into calls of LAPACK; return eigenvectors and eigenvalues."""
    if eqn.params["subset_by_index"] not in (None, (0, a.shape[-1])):
        raise NotImplementedError("for a subset of the eigenvalues")
    lower = eqn.params["lower"]

    def eigh_of_matrix(m):
        m = m if lower else m.T if not isinstance(builder, ComplexBuilder) else map_elementwise(builder.conj, m.T)
        return call_lapack(builder, "eigh", (len(m),), m)

    return _map_matrices(builder, eqn, a, eigh_of_matrix)


def _swap_row_with_pivot(builder, matrix: np.ndarray, row: int, pivot_row: Scalar) -> np.ndarray:
    """Return a copy of a matrix with the rows ``row`` and ``pivot_row`` exchanged, where ``pivot_row >= row``."""
    matrix, row_k, candidate_rows = matrix.copy(), matrix[row].copy(), matrix[row:].copy()
    for j in range(matrix.shape[1]):
        matrix[row, j] = builder.pick(builder.real_builder.sub(pivot_row, row), list(candidate_rows[:, j]))
    for i in range(row + 1, len(matrix)):
        is_hit = builder.real_builder.op("eq", pivot_row, i)
        for j in range(matrix.shape[1]):
            matrix[i, j] = builder.select(is_hit, row_k[j], matrix[i, j])
    return matrix


def _unrolled_lu(builder, a: np.ndarray) -> tuple[np.ndarray, list[Scalar]]:
    """Return the LU factors with partial pivoting, and the row with which each row is exchanged."""
    a, r = a.copy(), builder.real_builder
    pivots: list[Scalar] = []
    for k in range(min(a.shape)):
        moduli = [r.op("abs", v) if not isinstance(builder, ComplexBuilder) else builder.modulus(v) for v in a[k:, k]]
        max_modulus, pivot_index = moduli[0], k
        for i, modulus in enumerate(moduli[1:], k + 1):
            is_larger = r.op("gt", modulus, max_modulus)
            max_modulus, pivot_index = r.select(is_larger, modulus, max_modulus), r.select(is_larger, i, pivot_index)
        a = _swap_row_with_pivot(builder, a, k, pivot_index)
        pivots.append(pivot_index)
        for i in range(k + 1, len(a)):
            factor = builder.div(a[i, k], a[k, k])
            # a column of zeros stays zero, as in LAPACK
            is_zero = builder.op("eq", a[k, k], 0.0)
            a[i, k] = builder.select(is_zero, a[i, k], factor)
            for j in range(k + 1, a.shape[1]):
                a[i, j] = builder.sub(a[i, j], builder.mul(a[i, k], a[k, j]))
    return a, pivots


def lu(builder, eqn, a):
    """Unroll ``lu``, into scalars for small matrices; return the factors, the pivots and the permutation."""
    m, n = a.shape[-2:]
    r = builder.real_builder

    def lu_of_matrix(x):
        if m <= MAX_UNROLLED_LU_ROWS and n <= MAX_UNROLLED_LU_ROWS:
            factors, pivots = _unrolled_lu(builder, x)
        else:
            factors, pivot_values = call_lapack(builder, "lu", (m, n), x)
            pivots = [r.op("truncate", p) for p in pivot_values.tolist()]
        order = constant_array(np.arange(m)[:, None])
        for k, pivot in enumerate(pivots):
            order = _swap_row_with_pivot(r, order, k, pivot)
        return factors, scalar_array(pivots, (len(pivots),)), order[:, 0]

    return _map_matrices(builder, eqn, a, lu_of_matrix)


def inverse(builder, eqn, a):
    """Unroll the primitive ``inverse`` of :mod:`liethermo.engines.stage_solver`, which Newton's method calls."""
    return _map_matrices(builder, eqn, a, lambda x: call_lapack(builder, "inverse", (len(x),), x))


def qr(builder, eqn, a):
    """Unroll ``qr`` into calls of LAPACK; return both factors."""
    if eqn.params["pivoting"]:
        raise NotImplementedError("with pivoting")
    m, n = a.shape[-2:]
    columns = m if eqn.params["full_matrices"] else min(m, n)
    return _map_matrices(builder, eqn, a, lambda x: call_lapack(builder, "qr", (m, n, columns), x))


def svd(builder, eqn, a):
    """Unroll ``svd`` into calls of LAPACK; return the singular values and, if requested, the singular vectors."""
    if eqn.params["subset_by_index"] not in (None, (0, min(a.shape[-2:]))):
        raise NotImplementedError("for a subset of the singular values")
    m, n = a.shape[-2:]
    full = int(eqn.params["full_matrices"]) if eqn.params["compute_uv"] else 0

    def svd_of_matrix(x):
        results = call_lapack(builder, "svd", (m, n, full), x)
        return results if eqn.params["compute_uv"] else results[:1]

    return _map_matrices(builder, eqn, a, svd_of_matrix)


def cholesky(builder, eqn, a):
    """Unroll ``cholesky``; return the lower factor, NaN for a matrix that is not positive definite."""
    n, r = a.shape[-1], builder.real_builder
    lower = constant_array(np.zeros(a.shape))
    for A, L in zip(_flatten_batch_axes(a), _flatten_batch_axes(lower), strict=True):
        is_positive: Scalar = True
        for j in range(n):
            pivot = reduce(builder.sub, (builder.mul(v, builder.conj(v)) for v in L[j, :j]), A[j, j])
            real_pivot = pivot.re if isinstance(pivot, ComplexPair) else pivot
            is_positive = r.op("and", is_positive, r.op("gt", real_pivot, 0.0))
            root = r.op("sqrt", real_pivot)
            L[j, j] = ComplexPair(root, 0.0) if isinstance(pivot, ComplexPair) else root
            for i in range(j + 1, n):
                products = (builder.mul(u, builder.conj(v)) for u, v in zip(L[i, :j], L[j, :j], strict=True))
                L[i, j] = builder.div(reduce(builder.sub, products, A[i, j]), L[j, j])
        L[...] = map_elementwise(lambda v, ok=is_positive: builder.select(ok, v, math.nan), L)
    return map_elementwise(lambda v: builder.add(v, 0.0), lower) if isinstance(builder, ComplexBuilder) else lower


def triangular_solve(builder, eqn, a, rhs):
    """Solve ``a x = rhs``, or ``x a = rhs``, by substitution."""
    params = eqn.params
    if params["transpose_a"] and params["conjugate_a"]:
        a = map_elementwise(builder.conj, a)
    if params["transpose_a"] == params["left_side"]:
        a = a.swapaxes(-1, -2)
    if not params["left_side"]:
        rhs = rhs.swapaxes(-1, -2)
    lower = params["lower"] != (params["transpose_a"] == params["left_side"])
    n, x = a.shape[-1], rhs.copy()
    order = range(n) if lower else range(n)[::-1]
    for A, X in zip(_flatten_batch_axes(a), _flatten_batch_axes(x), strict=True):
        for n_solved, i in enumerate(order):
            for k in range(X.shape[1]):
                residual = reduce(builder.sub, (builder.mul(A[i, j], X[j, k]) for j in order[:n_solved]), X[i, k])
                X[i, k] = residual if params["unit_diagonal"] else builder.div(residual, A[i, i])
    return x if params["left_side"] else x.swapaxes(-1, -2)


# -- sorting ----------------------------------------------------------------------------------------------------------


def is_sorted_before(builder, kind: str, x: Scalar, y: Scalar) -> Scalar:
    """Return the scalar that is true if x is sorted before y; NaN is sorted last."""
    is_less = builder.op("lt", x, y)
    return (
        is_less
        if kind != "f"
        else builder.op("or", is_less, builder.op("and", builder.op("ne", y, y), builder.op("eq", x, x)))
    )


def _sorting_network(n: int):
    """Yield pairs of indices to be compared: neighbours, which sort stably, or Batcher's network [Knuth]."""
    if n <= MAX_BUBBLE_SORT_ENTRIES:
        yield from ((j, j + 1) for i in range(n) for j in range(n - 1 - i))
        return
    t = (n - 1).bit_length()
    p = 1 << (t - 1)
    while p:
        q, r, d = 1 << (t - 1), 0, p
        while True:
            yield from ((i, i + d) for i in range(n - d) if i & p == r)
            if q == p:
                break
            d, q, r = q - p, q >> 1, p
        p >>= 1


def sort(builder, eqn, *operands):
    """Unroll ``sort`` along an axis into comparisons; the first operands are the keys, all are reordered alike."""
    axis, keys = eqn.params["dimension"], eqn.params["num_keys"]
    n = operands[0].shape[axis]
    kinds = ["f" if var.aval.dtype.kind == "f" else "i" for var in eqn.invars[:keys]]
    arrays = [np.moveaxis(x, axis, -1).copy() for x in operands]
    for index in np.ndindex(*arrays[0].shape[:-1]):
        rows = [x[index].tolist() for x in arrays]
        key_rows, tie_breakers = list(rows[:keys]), []
        key_kinds = list(kinds)
        if n > MAX_BUBBLE_SORT_ENTRIES:  # the network is not stable
            tie_breakers, key_kinds = [list(range(n))], [*kinds, "i"]
        for i, j in _sorting_network(n):
            must_swap: Scalar = False
            for key, kind in reversed(list(zip([*key_rows, *tie_breakers], key_kinds, strict=True))):
                is_less = is_sorted_before(builder, kind, key[j], key[i])
                is_equal = builder.op("not", builder.op("or", is_less, is_sorted_before(builder, kind, key[i], key[j])))
                must_swap = builder.op("or", is_less, builder.op("and", is_equal, must_swap))
            for row in (*rows, *tie_breakers):
                row[i], row[j] = builder.select(must_swap, row[j], row[i]), builder.select(must_swap, row[i], row[j])
        for x, row in zip(arrays, rows, strict=True):
            x[index] = scalar_array(row, (n,))
    return [np.moveaxis(x, -1, axis) for x in arrays]


def total_order_comparison_rule(op: str):
    """Return the unrolling rule of ``lt_to`` or ``le_to``, which compare in an order with NaN last and -0 before 0."""

    def rule(builder, eqn, x, y):
        kind = eqn.invars[0].aval.dtype.kind

        def is_less(u, v):
            if kind != "f":
                return builder.op("lt", u, v)
            zeros = builder.op("and", builder.op("eq", u, 0.0), builder.op("eq", v, 0.0))
            signs = builder.op("lt", builder.div(1.0, u), builder.div(1.0, v))
            return builder.op("or", is_sorted_before(builder, kind, u, v), builder.op("and", zeros, signs))

        return map_elementwise(is_less if op == "lt" else lambda u, v: builder.op("not", is_less(v, u)), x, y)

    return rule


# -- convolution ------------------------------------------------------------------------------------------------------


def convolution(builder, eqn, x, kernel):
    """Unroll ``conv_general_dilated`` into sums of products."""
    params, dims = eqn.params, eqn.params["dimension_numbers"]
    if params["batch_group_count"] != 1:
        raise NotImplementedError("with batch_group_count > 1")
    x, kernel = x.transpose(dims.lhs_spec), kernel.transpose(dims.rhs_spec)
    shape = tuple(eqn.outvars[0].aval.shape[i] for i in dims.out_spec)
    groups, inputs = params["feature_group_count"], kernel.shape[1]
    result = np.empty(shape, object)
    for index in np.ndindex(*shape):
        n, channel, position = index[0], index[1], index[2:]
        first_input = channel // (shape[1] // groups) * inputs
        products = []
        for offset in np.ndindex(*kernel.shape[2:]):
            source = []
            for i, j, stride, (low, _), input_dilation, kernel_dilation, axis_length in zip(
                position,
                offset,
                params["window_strides"],
                params["padding"],
                params["lhs_dilation"],
                params["rhs_dilation"],
                x.shape[2:],
                strict=True,
            ):
                source_index, remainder = divmod(i * stride + j * kernel_dilation - low, input_dilation)
                if remainder or not 0 <= source_index < axis_length:
                    break
                source.append(source_index)
            else:
                products += [
                    builder.mul(x[(n, first_input + c, *source)], kernel[(channel, c, *offset)]) for c in range(inputs)
                ]
        result[index] = reduce(builder.add, products, 0.0)
    return result.transpose(np.argsort(dims.out_spec))


# -- special functions ------------------------------------------------------------------------------------------------

EULER_MACLAURIN_DIVISORS = [12.0, -720.0, 30240.0, -1209600.0, 47900160.0, -1.8924375803183791606e9, 7.47242496e10]
EULER_MACLAURIN_DIVISORS += [-2.950130727918164224e12, 1.1646782814350067249e14, -4.5979787224074726105e15]
EULER_MACLAURIN_DIVISORS += [1.8152105401943546773e17, -7.1661652561756670113e18]
"""Divisors ``(2 j)! / B_2j`` of the terms j = 1, 2, ... of the asymptotic series of ``hurwitz_zeta``."""

ZETA_DIRECT_TERMS = 10
"""Number of terms of ``hurwitz_zeta`` that are summed before its asymptotic series begins."""


def hurwitz_zeta(builder, s: Scalar, q: Scalar) -> Scalar:
    """Return Hurwitz's zeta function ``sum_k (q + k)^-s`` by the Euler-Maclaurin formula, as XLA computes it.

    The formula holds for q < 0 and an integer s too, but the series is inaccurate unless ``q + 10`` is well above zero.
    """
    minus_s = builder.neg(s)
    total = reduce(builder.add, (builder.pow(builder.add(q, float(k)), minus_s) for k in range(ZETA_DIRECT_TERMS)))
    q_end = builder.add(q, float(ZETA_DIRECT_TERMS))
    power = builder.pow(q_end, minus_s)
    total = builder.add(total, builder.div(builder.mul(power, q_end), builder.sub(s, 1.0)))
    inverse_square, series = builder.div(1.0, builder.mul(q_end, q_end)), 0.0
    for j in reversed(range(1, len(EULER_MACLAURIN_DIVISORS))):
        rising_factorial = builder.mul(builder.add(s, 2.0 * j), builder.add(s, 2.0 * j - 1.0))
        series = builder.mul(
            rising_factorial, builder.mul(inverse_square, builder.add(series, 1.0 / EULER_MACLAURIN_DIVISORS[j]))
        )
    series = builder.add(series, 1.0 / EULER_MACLAURIN_DIVISORS[0])
    total = builder.add(total, builder.mul(power, builder.add(builder.mul(builder.div(s, q_end), series), 0.5)))

    def is_integer(a: Scalar) -> Scalar:
        return builder.op("eq", a, builder.op("floor", a))

    is_nonpositive = builder.op("le", q, 0.0)
    is_even = builder.op("and", is_integer(s), builder.op("eq", builder.op("rem", s, 2.0), 0.0))
    is_undefined = builder.op(
        "or", builder.op("lt", s, 1.0), builder.op("and", is_nonpositive, builder.op("not", is_integer(s)))
    )
    is_pole = builder.op("and", is_nonpositive, is_integer(q))
    total = builder.select(
        is_pole, builder.select(is_even, math.inf, math.nan), builder.select(is_undefined, math.nan, total)
    )
    return builder.select(builder.op("eq", s, 1.0), math.inf, total)


def digamma(builder, x: Scalar) -> Scalar:
    """Return the logarithmic derivative of the gamma function; NaN at zero, as in XLA."""
    return builder.select(builder.op("eq", x, 0.0), math.nan, builder.op("digamma", x))


def lgamma(builder, x: Scalar) -> Scalar:
    """Return ``log(abs(gamma(x)))``; infinity at minus infinity, as in XLA."""
    return builder.select(builder.op("eq", x, -math.inf), math.inf, builder.op("lgamma", x))


def incomplete_gamma_rule(op: str):
    """Return the unrolling rule of ``igamma`` or ``igammac``, with NaN at the limits where JAX returns NaN.

    These limits are a = 0 with x < 1 (``igamma`` only), and an infinite a with a finite x >= 1.
    """
    limit = 1.0 if op == "igamma" else 0.0

    def incomplete_gamma_of(builder, a: Scalar, x: Scalar) -> Scalar:
        result = builder.op(op, a, x)
        if op == "igamma":
            result = builder.select(
                builder.op("and", builder.op("eq", a, 0.0), builder.op("lt", x, 1.0)), math.nan, result
            )
        is_infinite = builder.op("and", builder.op("eq", a, math.inf), builder.op("ge", x, 1.0))
        return builder.select(is_infinite, builder.select(builder.op("eq", x, math.inf), limit, math.nan), result)

    return lambda builder, eqn, a, x: map_elementwise(lambda u, v: incomplete_gamma_of(builder, u, v), a, x)


def polygamma(builder, eqn, order, x):
    """Return the polygamma function: the derivative of ``digamma`` whose order is a known constant."""

    def polygamma_of(derivative_order, argument):
        if type(derivative_order) is str:
            raise NotImplementedError("with an order that is unknown at compile time")
        if not math.isfinite(derivative_order) or derivative_order != int(derivative_order) or derivative_order < 0:
            return math.nan
        if derivative_order == 0:
            return digamma(builder, argument)
        sign = 1.0 if int(derivative_order) % 2 else -1.0
        return builder.mul(
            sign * math.factorial(int(derivative_order)), hurwitz_zeta(builder, derivative_order + 1.0, argument)
        )

    return map_elementwise(polygamma_of, order, x)
