"""Constant indices out of range, which JAX moves inside without a word: ``m[3]`` of three components is ``m[2]``.

They are found in a jaxpr before anything is computed. What says how it treats an index out of range is left alone:
``x.at[3].get(mode="fill")``, ``mode="clip"``, ``mode="drop"``; and so are indices that are computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxprs_in_params

from ..errors import IndexOutOfRangeError
from .primitives import broadcast, reshape
from .scalarize import CALL_PRIMITIVES, user_source_line

MAX_INDICES = 10_000
"""Largest number of constant indices of one access that are checked."""

ScatterMode = jax.lax.GatherScatterMode

INDEX_OPERATIONS: dict[str, Callable[..., np.ndarray]] = {
    "lt": lambda params, a, b: a < b,
    "add": lambda params, a, b: a + b,
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
    "convert_element_type": lambda params, a: a.astype(params["new_dtype"]),
    "broadcast_in_dim": lambda params, a: broadcast(a, params),
    "reshape": lambda params, a: reshape(a, params),
    "squeeze": lambda params, a: a.squeeze(params["dimensions"]),
    "concatenate": lambda params, *parts: np.concatenate(parts, axis=params["dimension"]),
}
"""Primitives by which JAX brings an index to its final form: what they make of constants is a constant index."""


def check_indices(closed: ClosedJaxpr) -> None:
    """Raise IndexOutOfRangeError where a jaxpr has a constant index that is out of range.

    A table of indices may have some that are out of range, where what is read there is not used, as with neighbours
    that some sites do not have.
    """
    in_tables: list[IndexOutOfRangeError] = []
    _check_jaxpr(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars), in_tables)
    if in_tables and _uses_out_of_range_entries(closed):
        raise in_tables[0]


def result_shape(function: Callable, *arguments) -> Any:
    """Return what ``jax.eval_shape`` returns of a function of arrays, once its indices have been checked."""
    closed, found = jax.make_jaxpr(function, return_shape=True)(*arguments)
    check_indices(closed)
    return found


def _check_jaxpr(jaxpr: Jaxpr, consts: Sequence, arguments: Sequence, in_tables: list[IndexOutOfRangeError]) -> list:
    """Check a jaxpr whose arguments are integers known as arrays, or None; return its results in this form.

    What is wrong in a table of indices is added to a list; a single index that is wrong is an error.
    """
    known = dict(zip(jaxpr.invars, arguments, strict=True))
    known.update((v, _constant_indices(c)) for v, c in zip(jaxpr.constvars, consts, strict=True))

    def read(atom) -> np.ndarray | None:
        return _constant_indices(atom.val) if isinstance(atom, Literal) else known.get(atom)

    eqn: Any
    for eqn in jaxpr.eqns:
        name, values = eqn.primitive.name, [read(v) for v in eqn.invars]
        if name in INDEX_ACCESSES:
            for index, size in _find_out_of_range(eqn, values):
                error = IndexOutOfRangeError(index, size, user_source_line(eqn))
                if name != "gather" or eqn.invars[1].aval.size == eqn.invars[1].aval.shape[-1]:
                    raise error
                in_tables.append(error)
        elif name in CALL_PRIMITIVES.split():
            results = _check_jaxpr(*_called_jaxpr(eqn), values, in_tables)
            known.update(zip(eqn.outvars, results, strict=True))
        elif name == "cond":
            branches, which = eqn.params["branches"], values[0]
            taken = branches if which is None else [branches[int(np.clip(which, 0, len(branches) - 1))]]
            for branch in taken:
                _check_jaxpr(branch.jaxpr, branch.consts, values[1:], in_tables)
        elif (
            name in INDEX_OPERATIONS and eqn.outvars[0].aval.size <= MAX_INDICES and all(v is not None for v in values)
        ):
            known[eqn.outvars[0]] = _constant_indices(np.asarray(INDEX_OPERATIONS[name](eqn.params, *values)))
        else:
            for inner in jaxprs_in_params(eqn.params):
                _check_jaxpr(inner, [None] * len(inner.constvars), [None] * len(inner.invars), in_tables)
    return [read(v) for v in jaxpr.outvars]


def _called_jaxpr(eqn) -> tuple[Jaxpr, Sequence]:
    """Return the jaxpr that an equation calls, and its constants."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    return (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())


def _uses_out_of_range_entries(closed: ClosedJaxpr) -> bool:
    """Whether the results are not numbers, at some point, once what is read out of range is none."""
    if any(isinstance(c, jax.core.Tracer) for c in closed.consts):
        return True
    random = np.random.default_rng(0)
    point = [jnp.asarray(random.uniform(0.5, 1.5, v.aval.shape), v.aval.dtype) for v in closed.jaxpr.invars]
    with jax.ensure_compile_time_eval():
        results = _evaluate_with_nan_reads(closed.jaxpr, closed.consts, point)
        return any(bool(jnp.isnan(a).any()) for a in results if jnp.issubdtype(a.dtype, jnp.inexact))


def _evaluate_with_nan_reads(jaxpr: Jaxpr, consts: Sequence, arguments: Sequence) -> list:
    """Evaluate a jaxpr, NaN standing for what it reads out of range."""
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else known[atom]

    eqn: Any
    for eqn in jaxpr.eqns:
        values, name = list(map(read, eqn.invars)), eqn.primitive.name
        if name in CALL_PRIMITIVES.split():
            found = _evaluate_with_nan_reads(*_called_jaxpr(eqn), values)
        else:
            params = eqn.params
            if name == "gather" and is_silently_clamped(eqn) and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.inexact):
                params = params | {"mode": ScatterMode.FILL_OR_DROP, "fill_value": np.nan}
            found = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(params))
        known.update(zip(eqn.outvars, found if isinstance(found, list | tuple) else [found], strict=True))
    return list(map(read, jaxpr.outvars))


def _constant_indices(value: Any) -> np.ndarray | None:
    """An integer or truth value, or a small array of them, that is known when a function is traced."""
    if isinstance(value, jax.core.Tracer) or not hasattr(value, "dtype") or value.dtype.kind not in "iub":
        return None
    return np.asarray(value) if math.prod(np.shape(value)) <= MAX_INDICES else None


def _find_out_of_range(eqn, values: Sequence) -> Iterator[tuple[int, int]]:
    """Indices of an access, as they were written, that are out of range, and how many entries their axes have."""
    for axis, starts, window in INDEX_ACCESSES[eqn.primitive.name](eqn, values):
        size = eqn.invars[0].aval.shape[axis]
        for start in np.unique(starts).tolist():
            if start < 0:
                yield start - size, size  # a negative index counts from the end, and that has been done
            elif start > size - window:
                yield start if window == 1 else max(start, size), size


def _dynamic_slice_accesses(eqn, values):
    yield from _slice_accesses(values[1:], eqn.params["slice_sizes"])


def _dynamic_update_accesses(eqn, values):
    yield from _slice_accesses(values[2:], eqn.invars[1].aval.shape)


def _slice_accesses(values, windows):
    yield from ((axis, s, w) for axis, (s, w) in enumerate(zip(values, windows, strict=True)) if s is not None)


def is_silently_clamped(eqn) -> bool:
    """Whether a gather or a scatter moves indices inside without being told to.

    A slice at an index, along a batch, becomes one that clips, and drops no axis.
    """
    numbers, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    dropped = numbers.collapsed_slice_dims if eqn.primitive.name == "gather" else numbers.inserted_window_dims
    return mode == ScatterMode.PROMISE_IN_BOUNDS or (mode == ScatterMode.CLIP and not dropped)


def _gather_accesses(eqn, values):
    if is_silently_clamped(eqn):
        yield from _index_columns(values[1], eqn.params["dimension_numbers"].start_index_map, eqn.params["slice_sizes"])


def _scatter_accesses(eqn, values):
    numbers = eqn.params["dimension_numbers"]
    if is_silently_clamped(eqn):
        left_out = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
        updates = iter([eqn.invars[2].aval.shape[i] for i in numbers.update_window_dims])
        windows = [1 if i in left_out else next(updates) for i in range(eqn.invars[0].aval.ndim)]
        yield from _index_columns(values[1], numbers.scatter_dims_to_operand_dims, windows)


def _index_columns(indices, axes, windows):
    if indices is not None and indices.size:
        yield from ((int(axis), indices[..., i], int(windows[axis])) for i, axis in enumerate(axes))


INDEX_ACCESSES = {
    "dynamic_slice": _dynamic_slice_accesses,
    "dynamic_update_slice": _dynamic_update_accesses,
    "gather": _gather_accesses,
    **dict.fromkeys("scatter scatter-add scatter-sub scatter-mul scatter-min scatter-max".split(), _scatter_accesses),
}
"""Primitives that read or write at indices: generators of axes, the starts of windows along them, and their lengths."""
