"""Rules that unroll each JAX primitive into scalar arithmetic: ``rule(builder, equation, *arrays)``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import numpy as np

from manifolds._jaxprs import broadcast, reshape

from . import indexing
from . import linear_algebra as algebra
from .builder import (
    ELEMENTARY_OPERATIONS,
    ComplexPair,
    Scalar,
    as_complex_pair,
    constant_array,
    map_elementwise,
    rows_and_outer_shape,
    scalar_array,
)
from .calls import DeferredBlock
from .complex_numbers import flatten_scalars, real_scalar_kinds, unflatten_scalars

Rule = Callable[..., "np.ndarray | list[np.ndarray]"]


def _input_dtype(eqn, argument_index: int = 0) -> np.dtype:
    """Return the dtype of an input of an equation."""
    return eqn.invars[argument_index].aval.dtype


def _builder_method_rule(method: str) -> Rule:
    """Return the rule of an elementwise primitive: a method of the builder, applied to each entry."""

    def rule(builder, eqn, *arrays):
        if _input_dtype(eqn).kind == "b":
            raise NotImplementedError("on truth values")
        return map_elementwise(getattr(builder, method), *arrays)

    return rule


def _extremum_rule(method: str, boolean_op: str) -> Rule:
    """Return the unrolling rule of ``max`` or ``min``, for numbers and for truth values."""

    def rule(builder, eqn, x, y):
        if _input_dtype(eqn).kind == "b":
            return map_elementwise(lambda u, v: builder.op(boolean_op, u, v), x, y)
        return map_elementwise(getattr(builder, method), x, y)

    return rule


def _power(builder, eqn, x, y):
    return map_elementwise(builder.pow, x, convert_dtype(builder, y, _input_dtype(eqn, 1), _input_dtype(eqn)))


def _operation_rule(op: str) -> Rule:
    """Return the unrolling rule that emits an operation for each entry; the builder does not simplify it."""
    return lambda builder, eqn, *arrays: map_elementwise(lambda *args: builder.op(op, *args), *arrays)


def _rearrangement_rule(function: Callable[..., Any]) -> Rule:
    """Return the unrolling rule that rearranges the entries of an array by ``function(array, parameters)``."""
    return lambda builder, eqn, x: function(x, eqn.params)


def _identity(builder, eqn, *arrays):
    return list(arrays)


def _emit_deferred_block(builder, eqn, *arrays):
    """Emit a :class:`DeferredBlock`, whose code is filled in later; return its results as arrays of scalars."""
    avals = [var.aval for var in eqn.outvars]
    results = builder.emit_block(DeferredBlock(real_scalar_kinds(avals)), *flatten_scalars(arrays))
    return unflatten_scalars(iter(results), avals)


def _divide(builder, eqn, x, y):
    if _input_dtype(eqn).kind in "iu":
        return _operation_rule("quotient")(builder, eqn, x, y)
    return _builder_method_rule("div")(builder, eqn, x, y)


def _remainder(builder, eqn, x, y):
    if _input_dtype(eqn).kind in "iu":
        return map_elementwise(lambda a, n: builder.sub(a, builder.mul(n, builder.op("quotient", a, n))), x, y)
    return _operation_rule("rem")(builder, eqn, x, y)


def _integer_pow(builder, eqn, x):
    unit = _input_dtype(eqn).type(1).item()
    return map_elementwise(lambda a: builder.integer_pow(a, eqn.params["y"], unit), x)


def _not(builder, eqn, x):
    if _input_dtype(eqn).kind != "b":
        raise NotImplementedError("on the bits of integers")
    return _operation_rule("not")(builder, eqn, x)


def _clamp(builder, eqn, low, x, high):
    return map_elementwise(lambda lo, a, hi: builder.min(builder.max(lo, a), hi), low, x, high)


def _round(builder, eqn, x):
    to_even = eqn.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return map_elementwise((lambda a: builder.op("rint", a)) if to_even else builder.round_half_away, x)


def _select(builder, eqn, selector, *cases):
    if _input_dtype(eqn).kind == "b":
        return map_elementwise(builder.select, selector, cases[1], cases[0])
    result = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        result = map_elementwise(
            lambda s, a, c, i=i: builder.select(builder.op("le", s, i), a, c), selector, cases[i], result
        )
    return result


def _convert_element_type(builder, eqn, x):
    return convert_dtype(builder, x, _input_dtype(eqn), np.dtype(eqn.params["new_dtype"]))


def convert_dtype(builder, x: np.ndarray, source: np.dtype, target: np.dtype) -> np.ndarray:
    """Return an array of scalars converted from one dtype to another; integers are not yet wrapped around.

    A real number is rounded towards zero and clipped to the range of the integer type; NaN becomes 0, as in XLA.
    """
    conversion = (source.kind + target.kind).replace("u", "i")
    if conversion in ("ff", "ii", "bb", "cc"):
        return x
    if source.kind == "c":
        if target.kind == "b":
            return map_elementwise(lambda a: builder.op("ne", a, ComplexPair(0.0, 0.0)), x)
        real = map_elementwise(lambda a: as_complex_pair(a).re, x)
        return real if target.kind == "f" else convert_dtype(builder.real_builder, real, np.dtype(np.float64), target)
    if target.kind == "c":
        return map_elementwise(
            lambda a: ComplexPair(a if source.kind == "f" else builder.real_builder.op("float", a), 0.0), x
        )
    if target.kind == "b":
        return map_elementwise(lambda a: builder.op("ne", a, 0), x)
    if conversion == "fi":
        limits, integers = np.iinfo(target), map_elementwise(lambda a: builder.op("truncate", a), x)
        if target == np.int64:
            return integers
        return map_elementwise(lambda a: builder.min(builder.max(a, int(limits.min)), int(limits.max)), integers)
    return map_elementwise(lambda a: builder.op("float" if target.kind == "f" else "int", a), x)


def _reduction_rule(combine: Callable[..., Scalar], start: Scalar | None = None) -> Rule:
    """Return the unrolling rule of a reduction by ``combine(builder, u, v)``; ``start`` is its value for no entries."""

    def rule(builder, eqn, x):
        rows, shape = rows_and_outer_shape(x, eqn.params["axes"])
        if start is None and not all(rows):
            raise NotImplementedError("over an empty axis")
        empty: Any = 0.0 if start is None else constant_array(start, _input_dtype(eqn)).item()
        return scalar_array([reduce(lambda u, v: combine(builder, u, v), row) if row else empty for row in rows], shape)

    return rule


def _make_method_combiner(method: str) -> Callable[..., Scalar]:
    """Return the function ``combine(builder, u, v)`` that calls a method of the builder."""
    return lambda builder, u, v: getattr(builder, method)(u, v)


def _make_operation_combiner(op: str) -> Callable[..., Scalar]:
    """Return the function ``combine(builder, u, v)`` that emits an operation."""
    return lambda builder, u, v: builder.op(op, u, v)


def _arg_extremum_rule(comparison: str) -> Rule:
    """Return the unrolling rule of ``argmax`` or ``argmin``: the first index of the extreme entry, or of a NaN."""

    def first_extremum_index(builder, row):
        extremum, index = row[0], 0
        for i, v in enumerate(row[1:], 1):
            nan_first = builder.op("and", builder.op("ne", v, v), builder.op("eq", extremum, extremum))
            is_better = builder.op("or", builder.op(comparison, v, extremum), nan_first)
            extremum, index = builder.select(is_better, v, extremum), builder.select(is_better, i, index)
        return index

    def rule(builder, eqn, x):
        rows, shape = rows_and_outer_shape(x, eqn.params["axes"])
        return scalar_array([first_extremum_index(builder, row) for row in rows], shape)

    return rule


def _cumulative_rule(combine: Callable[..., Scalar]) -> Rule:
    """Return the unrolling rule of a cumulative reduction by ``combine(builder, u, v)``."""

    def rule(builder, eqn, x):
        axis, step = eqn.params["axis"], -1 if eqn.params["reverse"] else 1
        rows, shape = rows_and_outer_shape(x, (axis,))
        sums = [list(itertools.accumulate(row[::step], lambda u, v: combine(builder, u, v)))[::step] for row in rows]
        return np.moveaxis(scalar_array([a for row in sums for a in row], (*shape, x.shape[axis])), -1, axis)

    return rule


MAX_UNROLLED_PRODUCTS = 900
"""Largest number of scalar products in a product of matrices that is unrolled; a larger one becomes a loop."""

MAX_UNROLLED_INPUT_PRODUCTS = 100
"""Limit that replaces :data:`MAX_UNROLLED_PRODUCTS` if a matrix is an input, such as the weights of a network.

A loop reads the input in place and copies nothing, so it pays off earlier.
"""

MAX_UNROLLED_OUTER_PRODUCTS = 9_000
"""Limit that replaces :data:`MAX_UNROLLED_PRODUCTS` for an outer product, whose unused entries cost nothing."""


def _count_nonzero_products(rows: np.ndarray, columns: np.ndarray) -> int:
    """Return how many multiplications of a matrix product have no factor that is a constant zero.

    The first matrix is given by its rows, the second by its columns.
    """
    counts = [np.reshape([not _is_zero(a) for a in x.ravel().tolist()], x.shape).sum(axis=0) for x in (rows, columns)]
    return int(np.sum(counts[0] * counts[1]))


def _is_zero(a: Scalar) -> bool:
    """Return whether a scalar is a constant that equals zero."""
    components = (a.re, a.im) if isinstance(a, ComplexPair) else (a,)
    return all(type(component) is not str and component == 0 for component in components)


def _should_multiply_by_loop(builder, rows: np.ndarray, columns: np.ndarray) -> bool:
    """Return whether a product of two matrices, the second given by its columns, is large enough to become a loop."""
    n_products = _count_nonzero_products(rows, columns)
    if builder.real_builder is not builder:  # complex numbers
        return 4 * n_products > MAX_UNROLLED_PRODUCTS
    if rows.shape[-1] == 1:
        return n_products > MAX_UNROLLED_OUTER_PRODUCTS
    if n_products > MAX_UNROLLED_PRODUCTS or n_products <= MAX_UNROLLED_INPUT_PRODUCTS:
        return n_products > MAX_UNROLLED_PRODUCTS
    return any(
        min(x.shape) > 1 and algebra.input_table_and_strides_or_none(builder, x) is not None for x in (rows, columns)
    )


def _dot_general(builder, eqn, x, y):
    """Unroll ``dot_general`` into sums of products without zero factors, or into loops for large matrices."""
    (sum_x, sum_y), (batch_x, batch_y) = eqn.params["dimension_numbers"]
    free_x = [i for i in range(x.ndim) if i not in (*sum_x, *batch_x)]
    free_y = [i for i in range(y.ndim) if i not in (*sum_y, *batch_y)]
    shape = [x.shape[i] for i in (*batch_x, *free_x)] + [y.shape[i] for i in free_y]
    n_batches, n_summed = math.prod(x.shape[i] for i in batch_x), math.prod(x.shape[i] for i in sum_x)
    lhs = x.transpose(*batch_x, *free_x, *sum_x).reshape(n_batches, math.prod(x.shape[i] for i in free_x), n_summed)
    rhs = y.transpose(*batch_y, *free_y, *sum_y).reshape(n_batches, math.prod(y.shape[i] for i in free_y), n_summed)
    dtype = eqn.outvars[0].aval.dtype
    lhs, rhs = (convert_dtype(builder, operand, _input_dtype(eqn, i), dtype) for i, operand in enumerate((lhs, rhs)))
    if dtype.kind == "b":
        logical_and = _make_operation_combiner("and")
        return scalar_array(
            [
                reduce(
                    lambda u, v: builder.op("or", u, v),
                    map(lambda u, v: logical_and(builder, u, v), row, column),
                    False,
                )
                for rows, columns in zip(lhs.tolist(), rhs.tolist(), strict=True)
                for row, column in itertools.product(rows, columns)
            ],
            shape,
        )
    zero, result = constant_array(0, dtype).item(), []
    for rows, columns in zip(lhs, rhs, strict=True):
        # skip zeros, such as those of structure constants
        sparse = [[(k, a) for k, a in enumerate(row) if not _is_zero(a)] for row in rows.tolist()]
        if dtype.kind in "fc" and _should_multiply_by_loop(builder, rows, columns):
            result += algebra.matrix_product_by_loop(builder, rows, columns.T).ravel().tolist()
            continue
        for entries, column in itertools.product(sparse, columns.tolist()):
            result.append(reduce(builder.add, (builder.mul(a, column[k]) for k, a in entries), zero))
    return scalar_array(result, shape)


def _iota(builder, eqn):
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    counts = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return constant_array(np.broadcast_to(counts, shape), eqn.params["dtype"])


def _platform_index(builder, eqn):
    """Return the index of the first implementation of a ``platform_index`` that is for the CPU or for any platform."""
    return constant_array(next(i for i, names in enumerate(eqn.params["platforms"]) if names is None or "cpu" in names))


def _slice(x, params):
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]


def _dynamic_slice(builder, eqn, x, *starts):
    return indexing.read_window(builder, x, [i.item() for i in starts], eqn.params["slice_sizes"])


def _dynamic_update_slice(builder, eqn, x, update, *starts):
    result = x.copy()
    indexing.update_window_in_place(builder, result, [i.item() for i in starts], update.shape, lambda old: update)
    return result


def _pad(builder, eqn, x, fill_value):
    shape = eqn.outvars[0].aval.shape
    result = np.full(shape, fill_value.item(), object)
    sources, targets = [], []
    for n, padded_length, (low, _, interior) in zip(x.shape, shape, eqn.params["padding_config"], strict=True):
        positions = int(low) + np.arange(n) * (int(interior) + 1)
        sources.append(np.flatnonzero((positions >= 0) & (positions < padded_length)))
        targets.append(positions[sources[-1]])
    result[np.ix_(*targets)] = x[np.ix_(*sources)]
    return result


def _unstack(x, params):
    axis = params["axis"]
    return [section.squeeze(axis) for section in np.split(x, x.shape[axis], axis)]  # arrays, even 0-d ones


def _split(x, params):
    return np.split(x, np.cumsum([int(n) for n in params["sizes"]])[:-1], axis=params["axis"])


def _gather(builder, eqn, x, indices):
    dtype, fill_value = _input_dtype(eqn), eqn.params["fill_value"]
    if fill_value is None:
        fill_value = {"f": math.nan, "b": True, "c": math.nan}.get(dtype.kind)
    if fill_value is None:
        fill_value = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return indexing.gather(builder, eqn, x, indices, constant_array(fill_value, dtype).item())


def _scatter_rule(combine: Callable[..., Scalar]) -> Rule:
    """Return the unrolling rule of a scatter that replaces an entry by ``combine(builder, old_entry, update)``."""

    def rule(builder, eqn, x, indices, updates):
        return indexing.scatter(
            builder, eqn, x, indices, updates, lambda old_entry, update: combine(builder, old_entry, update)
        )

    return rule


UNROLLING_RULES: dict[str, Rule] = {
    **{name: _builder_method_rule(name) for name in ("add", "sub", "mul", "neg", "logistic")},
    "max": _extremum_rule("max", "or"),
    "min": _extremum_rule("min", "and"),
    "pow": _power,
    "add_any": _builder_method_rule("add"),
    "div": _divide,
    "rem": _remainder,
    "square": lambda builder, eqn, x: map_elementwise(builder.mul, x, x),
    "integer_pow": _integer_pow,
    "rsqrt": lambda builder, eqn, x: map_elementwise(lambda a: builder.div(1.0, builder.op("sqrt", a)), x),
    "clamp": _clamp,
    "round": _round,
    **{name: _operation_rule(name) for name in ELEMENTARY_OPERATIONS},
    "not": _not,
    "select_n": _select,
    "convert_element_type": _convert_element_type,
    **dict.fromkeys(("stop_gradient", "copy", "copy_p", "name", "optimization_barrier"), _identity),
    "reduce_sum": _reduction_rule(_make_method_combiner("add"), 0),
    "reduce_prod": _reduction_rule(_make_method_combiner("mul"), 1),
    "reduce_max": _reduction_rule(_make_method_combiner("max")),
    "reduce_min": _reduction_rule(_make_method_combiner("min")),
    "reduce_and": _reduction_rule(_make_operation_combiner("and"), True),
    "reduce_or": _reduction_rule(_make_operation_combiner("or"), False),
    "argmax": _arg_extremum_rule("gt"),
    "argmin": _arg_extremum_rule("lt"),
    "cumsum": _cumulative_rule(_make_method_combiner("add")),
    "cumprod": _cumulative_rule(_make_method_combiner("mul")),
    "cummax": _cumulative_rule(_make_method_combiner("max")),
    "cummin": _cumulative_rule(_make_method_combiner("min")),
    "dot_general": _dot_general,
    "broadcast_in_dim": _rearrangement_rule(broadcast),
    "reshape": _rearrangement_rule(reshape),
    **{name: lambda builder, eqn, x: x.reshape(eqn.outvars[0].aval.shape) for name in ("squeeze", "expand_dims")},
    "transpose": _rearrangement_rule(lambda x, params: x.transpose(params["permutation"])),
    "rev": _rearrangement_rule(lambda x, params: np.flip(x, params["dimensions"]) if params["dimensions"] else x),
    "slice": _rearrangement_rule(_slice),
    "split": _rearrangement_rule(_split),
    "concatenate": lambda builder, eqn, *xs: np.concatenate(xs, axis=eqn.params["dimension"]),
    "stack": lambda builder, eqn, *xs: np.stack(xs, axis=eqn.params["axis"]),
    "unstack": _rearrangement_rule(_unstack),
    "tile": _rearrangement_rule(lambda x, params: np.tile(x, params["reps"])),
    "pad": _pad,
    "iota": _iota,
    "empty2": lambda builder, eqn: constant_array(np.zeros(eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype)),
    "platform_index": _platform_index,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter-add": _scatter_rule(_make_method_combiner("add")),
    "scatter-sub": _scatter_rule(_make_method_combiner("sub")),
    "scatter-mul": _scatter_rule(_make_method_combiner("mul")),
    "scatter-min": _scatter_rule(_make_method_combiner("min")),
    "scatter-max": _scatter_rule(_make_method_combiner("max")),
    "real": lambda builder, eqn, x: map_elementwise(lambda a: as_complex_pair(a).re, x),
    "imag": lambda builder, eqn, x: map_elementwise(lambda a: as_complex_pair(a).im, x),
    "conj": lambda builder, eqn, x: map_elementwise(builder.conj, x),
    "complex": lambda builder, eqn, x, y: map_elementwise(ComplexPair, x, y),
    "eigh": algebra.eigh,
    "deferred": _emit_deferred_block,
    "inverse": algebra.inverse,
    "lu": algebra.lu,
    "qr": algebra.qr,
    "svd": algebra.svd,
    "cholesky": algebra.cholesky,
    "triangular_solve": algebra.triangular_solve,
    "sort": algebra.sort,
    "lt_to": algebra.total_order_comparison_rule("lt"),
    "le_to": algebra.total_order_comparison_rule("le"),
    "conv_general_dilated": algebra.convolution,
    "zeta": lambda builder, eqn, s, q: map_elementwise(lambda u, v: algebra.hurwitz_zeta(builder, u, v), s, q),
    "polygamma": algebra.polygamma,
    "digamma": lambda builder, eqn, x: map_elementwise(lambda a: algebra.digamma(builder, a), x),
    "lgamma": lambda builder, eqn, x: map_elementwise(lambda a: algebra.lgamma(builder, a), x),
    "igamma": algebra.incomplete_gamma_rule("igamma"),
    "igammac": algebra.incomplete_gamma_rule("igammac"),
}
"""Rule of each primitive; :mod:`liethermo.tracing.scalarize` has the rules of calls, loops and branches."""

SUPPORTED_PARAMETERS = """
accuracy algorithm axes axis batch_group_count broadcast_dimensions compute_uv conjugate_a dimension dimension_numbers
dimensions dtype feature_group_count fill_value full_matrices index_dtype indices_are_sorted input_dtype is_stable
left_side lhs_dilation limit_indices lower memory_space mode name new_dtype new_sizes num_keys out_sharding padding
padding_config permutation pivoting platforms precision preferred_element_type reps results reverse rhs_dilation
rounding_method shape sharding sizes slice_sizes sort_eigenvalues start_indices strides subset_by_index transpose_a
unique_indices unit_diagonal update_consts update_jaxpr use_magma weak_type window_strides y
"""
"""Parameters of primitives that the rules handle or that do not affect results here.

A primitive is refused if any other parameter is set.
"""
