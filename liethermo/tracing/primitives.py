"""The rules by which each JAX primitive becomes scalar arithmetic: ``rule(builder, equation, *arrays)``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import numpy as np

from . import indexing
from . import linear_algebra as algebra
from .builder import (
    ELEMENTARY_OPERATIONS,
    ComplexPair,
    Scalar,
    as_complex_pair,
    constant_array,
    elementwise,
    entries_along,
    scalar_array,
)
from .calls import DeferredBlock
from .complex_numbers import flatten_scalars, scalar_kinds, unflatten_scalars

Rule = Callable[..., "np.ndarray | list[np.ndarray]"]


def _dtype(eqn, argument: int = 0) -> np.dtype:
    return eqn.invars[argument].aval.dtype


def _numeric_rule(method: str) -> Rule:
    """A method of the builder, on numbers."""

    def rule(b, eqn, *arrays):
        if _dtype(eqn).kind == "b":
            raise NotImplementedError("on truth values")
        return elementwise(getattr(b, method), *arrays)

    return rule


def _extremum_rule(method: str, of_truths: str) -> Rule:
    """The larger, or the smaller, of two numbers, or of two truth values."""

    def rule(b, eqn, x, y):
        if _dtype(eqn).kind == "b":
            return elementwise(lambda u, v: b.op(of_truths, u, v), x, y)
        return elementwise(getattr(b, method), x, y)

    return rule


def _power(b, eqn, x, y):
    return elementwise(b.pow, x, convert_dtype(b, y, _dtype(eqn, 1), _dtype(eqn)))


def _operation_rule(op: str) -> Rule:
    """An operation that has nothing to simplify."""
    return lambda b, eqn, *arrays: elementwise(lambda *args: b.op(op, *args), *arrays)


def _rearrangement_rule(function: Callable[..., Any]) -> Rule:
    """A rearrangement of entries: ``function(array, parameters)``."""
    return lambda b, eqn, x: function(x, eqn.params)


def _identity(b, eqn, *arrays):
    return list(arrays)


def _deferred_rule(b, eqn, *arrays):
    avals = [var.aval for var in eqn.outvars]
    found = b.emit_block(DeferredBlock(scalar_kinds(avals)), *flatten_scalars(arrays))
    return unflatten_scalars(iter(found), avals)


def _divide(b, eqn, x, y):
    if _dtype(eqn).kind in "iu":
        return _operation_rule("quotient")(b, eqn, x, y)
    return _numeric_rule("div")(b, eqn, x, y)


def _remainder(b, eqn, x, y):
    if _dtype(eqn).kind in "iu":
        return elementwise(lambda a, n: b.sub(a, b.mul(n, b.op("quotient", a, n))), x, y)
    return _operation_rule("rem")(b, eqn, x, y)


def _integer_pow(b, eqn, x):
    one = _dtype(eqn).type(1).item()
    return elementwise(lambda a: b.integer_pow(a, eqn.params["y"], one), x)


def _not(b, eqn, x):
    if _dtype(eqn).kind != "b":
        raise NotImplementedError("on the bits of integers")
    return _operation_rule("not")(b, eqn, x)


def _clamp(b, eqn, low, x, high):
    return elementwise(lambda lo, a, hi: b.min(b.max(lo, a), hi), low, x, high)


def _round(b, eqn, x):
    to_even = eqn.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return elementwise((lambda a: b.op("rint", a)) if to_even else b.round_half_away, x)


def _select(b, eqn, which, *cases):
    if _dtype(eqn).kind == "b":
        return elementwise(b.select, which, cases[1], cases[0])
    chosen = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        chosen = elementwise(lambda w, a, rest, i=i: b.select(b.op("le", w, i), a, rest), which, cases[i], chosen)
    return chosen


def _convert(b, eqn, x):
    return convert_dtype(b, x, _dtype(eqn), np.dtype(eqn.params["new_dtype"]))


def convert_dtype(b, x: np.ndarray, source: np.dtype, target: np.dtype) -> np.ndarray:
    """Return an array of scalars of one type as those of another, integers not yet wrapped around.

    A number becomes the nearest integer of the type that lies towards zero, and NaN becomes 0, as XLA has it.
    """
    conversion = (source.kind + target.kind).replace("u", "i")
    if conversion in ("ff", "ii", "bb", "cc"):
        return x
    if source.kind == "c":
        if target.kind == "b":
            return elementwise(lambda a: b.op("ne", a, ComplexPair(0.0, 0.0)), x)
        real = elementwise(lambda a: as_complex_pair(a).re, x)
        return real if target.kind == "f" else convert_dtype(b.real, real, np.dtype(np.float64), target)
    if target.kind == "c":
        return elementwise(lambda a: ComplexPair(a if source.kind == "f" else b.real.op("float", a), 0.0), x)
    if target.kind == "b":
        return elementwise(lambda a: b.op("ne", a, 0), x)
    if conversion == "fi":
        limits, whole = np.iinfo(target), elementwise(lambda a: b.op("truncate", a), x)
        if target == np.int64:
            return whole
        return elementwise(lambda a: b.min(b.max(a, int(limits.min)), int(limits.max)), whole)
    return elementwise(lambda a: b.op("float" if target.kind == "f" else "int", a), x)


def _reduction_rule(combine: Callable[..., Scalar], start: Scalar | None = None) -> Rule:
    def rule(b, eqn, x):
        rows, shape = entries_along(x, eqn.params["axes"])
        if start is None and not all(rows):
            raise NotImplementedError("of no entries")
        empty: Any = 0.0 if start is None else constant_array(start, _dtype(eqn)).item()
        return scalar_array([reduce(lambda u, v: combine(b, u, v), row) if row else empty for row in rows], shape)

    return rule


def _builder_method(name: str) -> Callable[..., Scalar]:
    return lambda b, u, v: getattr(b, name)(u, v)


def _builder_operation(op: str) -> Callable[..., Scalar]:
    return lambda b, u, v: b.op(op, u, v)


def _arg_extremum_rule(better: str) -> Rule:
    """The first place of the extreme entry; NaN counts as one."""

    def first_extremum_index(b, row):
        best, at = row[0], 0
        for i, v in enumerate(row[1:], 1):
            nan_first = b.op("and", b.op("ne", v, v), b.op("eq", best, best))
            wins = b.op("or", b.op(better, v, best), nan_first)
            best, at = b.select(wins, v, best), b.select(wins, i, at)
        return at

    def rule(b, eqn, x):
        rows, shape = entries_along(x, eqn.params["axes"])
        return scalar_array([first_extremum_index(b, row) for row in rows], shape)

    return rule


def _cumulative_rule(combine: Callable[..., Scalar]) -> Rule:
    def rule(b, eqn, x):
        axis, step = eqn.params["axis"], -1 if eqn.params["reverse"] else 1
        rows, shape = entries_along(x, (axis,))
        sums = [list(itertools.accumulate(row[::step], lambda u, v: combine(b, u, v)))[::step] for row in rows]
        return np.moveaxis(scalar_array([a for row in sums for a in row], (*shape, x.shape[axis])), -1, axis)

    return rule


MAX_UNROLLED_PRODUCTS, MAX_UNROLLED_INPUT_PRODUCTS, MAX_UNROLLED_OUTER_PRODUCTS = 900, 100, 9_000
"""Products of real numbers in a product of matrices that is unrolled, at most: more are a loop. Where one of them lies
in memory as it is given, such as the weights of a network, a loop copies nothing, and is worth it earlier. A product
of a column and a row sums nothing: unrolled, it costs only those of its entries that are used."""


def _count_products(rows: np.ndarray, columns: np.ndarray) -> int:
    """How many products of entries a product of two matrices takes, those with a zero left out."""
    counts = [np.reshape([not _is_zero(a) for a in x.ravel().tolist()], x.shape).sum(axis=0) for x in (rows, columns)]
    return int(np.sum(counts[0] * counts[1]))


def _is_zero(a: Scalar) -> bool:
    parts = (a.re, a.im) if isinstance(a, ComplexPair) else (a,)
    return all(type(part) is not str and part == 0 for part in parts)


def _needs_loop(b, rows: np.ndarray, columns: np.ndarray) -> bool:
    """Whether the product of two matrices, the second by its columns, is better a loop."""
    count = _count_products(rows, columns)
    if b.real is not b:  # of complex numbers
        return 4 * count > MAX_UNROLLED_PRODUCTS
    if rows.shape[-1] == 1:
        return count > MAX_UNROLLED_OUTER_PRODUCTS
    if count > MAX_UNROLLED_PRODUCTS or count <= MAX_UNROLLED_INPUT_PRODUCTS:
        return count > MAX_UNROLLED_PRODUCTS
    return any(min(x.shape) > 1 and algebra.input_table(b, x) is not None for x in (rows, columns))


def _dot_general(b, eqn, x, y):
    (sum_x, sum_y), (batch_x, batch_y) = eqn.params["dimension_numbers"]
    rest_x = [i for i in range(x.ndim) if i not in (*sum_x, *batch_x)]
    rest_y = [i for i in range(y.ndim) if i not in (*sum_y, *batch_y)]
    shape = [x.shape[i] for i in (*batch_x, *rest_x)] + [y.shape[i] for i in rest_y]
    batch, size = math.prod(x.shape[i] for i in batch_x), math.prod(x.shape[i] for i in sum_x)
    left = x.transpose(*batch_x, *rest_x, *sum_x).reshape(batch, math.prod(x.shape[i] for i in rest_x), size)
    right = y.transpose(*batch_y, *rest_y, *sum_y).reshape(batch, math.prod(y.shape[i] for i in rest_y), size)
    dtype = eqn.outvars[0].aval.dtype
    left, right = (convert_dtype(b, side, _dtype(eqn, i), dtype) for i, side in enumerate((left, right)))
    if dtype.kind == "b":
        both = _builder_operation("and")
        return scalar_array(
            [
                reduce(lambda u, v: b.op("or", u, v), map(lambda u, v: both(b, u, v), row, column), False)
                for rows, columns in zip(left.tolist(), right.tolist(), strict=True)
                for row, column in itertools.product(rows, columns)
            ],
            shape,
        )
    zero, result = constant_array(0, dtype).item(), []
    for rows, columns in zip(left, right, strict=True):
        # as structure constants are
        sparse = [[(k, a) for k, a in enumerate(row) if not _is_zero(a)] for row in rows.tolist()]
        if dtype.kind in "fc" and _needs_loop(b, rows, columns):
            result += algebra.matrix_product(b, rows, columns.T).ravel().tolist()
            continue
        for entries, column in itertools.product(sparse, columns.tolist()):
            result.append(reduce(b.add, (b.mul(a, column[k]) for k, a in entries), zero))
    return scalar_array(result, shape)


def broadcast(x, params):
    inner = np.ones(len(params["shape"]), int)
    inner[list(params["broadcast_dimensions"])] = x.shape
    return np.broadcast_to(x.reshape(inner), params["shape"])


def reshape(x, params):
    return (x if params["dimensions"] is None else x.transpose(params["dimensions"])).reshape(params["new_sizes"])


def _iota(b, eqn):
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    counts = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return constant_array(np.broadcast_to(counts, shape), eqn.params["dtype"])


def _platform_index(b, eqn):
    """Which of several implementations is the CPU's, or that for any platform."""
    return constant_array(next(i for i, names in enumerate(eqn.params["platforms"]) if names is None or "cpu" in names))


def _slice(x, params):
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]


def _dynamic_slice(b, eqn, x, *starts):
    return indexing.read_window(b, x, [i.item() for i in starts], eqn.params["slice_sizes"])


def _dynamic_update_slice(b, eqn, x, update, *starts):
    result = x.copy()
    indexing.update_window(b, result, [i.item() for i in starts], update.shape, lambda old: update)
    return result


def _pad(b, eqn, x, filling):
    shape = eqn.outvars[0].aval.shape
    result = np.full(shape, filling.item(), object)
    sources, targets = [], []
    for n, size, (low, _, between) in zip(x.shape, shape, eqn.params["padding_config"], strict=True):
        place = int(low) + np.arange(n) * (int(between) + 1)
        sources.append(np.flatnonzero((place >= 0) & (place < size)))
        targets.append(place[sources[-1]])
    result[np.ix_(*targets)] = x[np.ix_(*sources)]
    return result


def _unstack(x, params):
    axis = params["axis"]
    return [part.squeeze(axis) for part in np.split(x, x.shape[axis], axis)]  # arrays, of no dimension even


def _split_sections(x, params):
    return np.split(x, np.cumsum([int(n) for n in params["sizes"]])[:-1], axis=params["axis"])


def _gather(b, eqn, x, indices):
    dtype, filling = _dtype(eqn), eqn.params["fill_value"]
    if filling is None:
        filling = {"f": math.nan, "b": True, "c": math.nan}.get(dtype.kind)
    if filling is None:
        filling = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return indexing.gather(b, eqn, x, indices, constant_array(filling, dtype).item())


def _scatter_rule(combine: Callable[..., Scalar]) -> Rule:
    def rule(b, eqn, x, indices, updates):
        return indexing.scatter(b, eqn, x, indices, updates, lambda old, new: combine(b, old, new))

    return rule


UNROLLING_RULES: dict[str, Rule] = {
    **{name: _numeric_rule(name) for name in ("add", "sub", "mul", "neg", "logistic")},
    "max": _extremum_rule("max", "or"),
    "min": _extremum_rule("min", "and"),
    "pow": _power,
    "add_any": _numeric_rule("add"),
    "div": _divide,
    "rem": _remainder,
    "square": lambda b, eqn, x: elementwise(b.mul, x, x),
    "integer_pow": _integer_pow,
    "rsqrt": lambda b, eqn, x: elementwise(lambda a: b.div(1.0, b.op("sqrt", a)), x),
    "clamp": _clamp,
    "round": _round,
    **{name: _operation_rule(name) for name in ELEMENTARY_OPERATIONS},
    "not": _not,
    "select_n": _select,
    "convert_element_type": _convert,
    **dict.fromkeys(("stop_gradient", "copy", "copy_p", "name", "optimization_barrier"), _identity),
    "reduce_sum": _reduction_rule(_builder_method("add"), 0),
    "reduce_prod": _reduction_rule(_builder_method("mul"), 1),
    "reduce_max": _reduction_rule(_builder_method("max")),
    "reduce_min": _reduction_rule(_builder_method("min")),
    "reduce_and": _reduction_rule(_builder_operation("and"), True),
    "reduce_or": _reduction_rule(_builder_operation("or"), False),
    "argmax": _arg_extremum_rule("gt"),
    "argmin": _arg_extremum_rule("lt"),
    "cumsum": _cumulative_rule(_builder_method("add")),
    "cumprod": _cumulative_rule(_builder_method("mul")),
    "cummax": _cumulative_rule(_builder_method("max")),
    "cummin": _cumulative_rule(_builder_method("min")),
    "dot_general": _dot_general,
    "broadcast_in_dim": _rearrangement_rule(broadcast),
    "reshape": _rearrangement_rule(reshape),
    **{name: lambda b, eqn, x: x.reshape(eqn.outvars[0].aval.shape) for name in ("squeeze", "expand_dims")},
    "transpose": _rearrangement_rule(lambda x, params: x.transpose(params["permutation"])),
    "rev": _rearrangement_rule(lambda x, params: np.flip(x, params["dimensions"]) if params["dimensions"] else x),
    "slice": _rearrangement_rule(_slice),
    "split": _rearrangement_rule(_split_sections),
    "concatenate": lambda b, eqn, *xs: np.concatenate(xs, axis=eqn.params["dimension"]),
    "stack": lambda b, eqn, *xs: np.stack(xs, axis=eqn.params["axis"]),
    "unstack": _rearrangement_rule(_unstack),
    "tile": _rearrangement_rule(lambda x, params: np.tile(x, params["reps"])),
    "pad": _pad,
    "iota": _iota,
    "empty2": lambda b, eqn: constant_array(np.zeros(eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype)),
    "platform_index": _platform_index,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter-add": _scatter_rule(_builder_method("add")),
    "scatter-sub": _scatter_rule(_builder_method("sub")),
    "scatter-mul": _scatter_rule(_builder_method("mul")),
    "scatter-min": _scatter_rule(_builder_method("min")),
    "scatter-max": _scatter_rule(_builder_method("max")),
    "real": lambda b, eqn, x: elementwise(lambda a: as_complex_pair(a).re, x),
    "imag": lambda b, eqn, x: elementwise(lambda a: as_complex_pair(a).im, x),
    "conj": lambda b, eqn, x: elementwise(b.conj, x),
    "complex": lambda b, eqn, x, y: elementwise(ComplexPair, x, y),
    "eigh": algebra.eigh,
    "deferred": _deferred_rule,
    "inverse": algebra.inverse,
    "lu": algebra.lu,
    "qr": algebra.qr,
    "svd": algebra.svd,
    "cholesky": algebra.cholesky,
    "triangular_solve": algebra.triangular_solve,
    "sort": algebra.sort,
    "lt_to": algebra.total_order_rule("lt"),
    "le_to": algebra.total_order_rule("le"),
    "conv_general_dilated": algebra.convolution,
    "zeta": lambda b, eqn, s, q: elementwise(lambda u, v: algebra.zeta(b, u, v), s, q),
    "polygamma": algebra.polygamma,
    "digamma": lambda b, eqn, x: elementwise(lambda a: algebra.digamma(b, a), x),
    "lgamma": lambda b, eqn, x: elementwise(lambda a: algebra.lgamma(b, a), x),
    "igamma": algebra.incomplete_gamma_rule("igamma"),
    "igammac": algebra.incomplete_gamma_rule("igammac"),
}
"""How each primitive is unrolled; calls of other functions are followed in :mod:`liethermo.tracing.scalarize`."""

SUPPORTED_PARAMETERS = """
accuracy algorithm axes axis batch_group_count broadcast_dimensions compute_uv conjugate_a dimension dimension_numbers
dimensions dtype feature_group_count fill_value full_matrices index_dtype indices_are_sorted input_dtype is_stable
left_side lhs_dilation limit_indices lower memory_space mode name new_dtype new_sizes num_keys out_sharding padding
padding_config permutation pivoting platforms precision preferred_element_type reps results reverse rhs_dilation
rounding_method shape sharding sizes slice_sizes sort_eigenvalues start_indices strides subset_by_index transpose_a
unique_indices unit_diagonal update_consts update_jaxpr use_magma weak_type window_strides y
"""
"""Parameters of primitives that the rules heed, or that do not matter here. Another one, if it is set, may mean
anything: the primitive is refused."""
