"""Detection of constant indices out of range, which JAX clamps silently: ``m[3]`` of three components is ``m[2]``.

The indices are found in a jaxpr before anything is computed. An access that states how it treats an index out of range,
such as ``x.at[3].get(mode="fill")``, ``mode="clip"`` or ``mode="drop"``, is not checked, nor are computed indices.
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
    "select_n": lambda params, index, *cases: np.choose(index.astype(int), cases),
    "convert_element_type": lambda params, a: a.astype(params["new_dtype"]),
    "broadcast_in_dim": lambda params, a: broadcast(a, params),
    "reshape": lambda params, a: reshape(a, params),
    "squeeze": lambda params, a: a.squeeze(params["dimensions"]),
    "concatenate": lambda params, *arrays: np.concatenate(arrays, axis=params["dimension"]),
}
"""Primitives by which JAX brings an index to its final form; applied to constants, they give a constant index."""


def check_indices(closed_jaxpr: ClosedJaxpr) -> None:
    """Raise IndexOutOfRangeError if a jaxpr has a constant index that is out of range.

    A table of indices may have entries out of range if the values read there are not used, as for neighbours that some
    sites do not have.
    """
    table_errors: list[IndexOutOfRangeError] = []
    _check_and_evaluate_indices(
        closed_jaxpr.jaxpr, closed_jaxpr.consts, [None] * len(closed_jaxpr.jaxpr.invars), table_errors
    )
    if table_errors and _uses_out_of_range_entries(closed_jaxpr):
        raise table_errors[0]


def checked_result_shapes(function: Callable, *arguments) -> Any:
    """Return the shapes of the results of a function, as ``jax.eval_shape`` does, after checking its indices."""
    closed_jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    check_indices(closed_jaxpr)
    return shapes


def _check_and_evaluate_indices(
    jaxpr: Jaxpr, consts: Sequence, arguments: Sequence, table_errors: list[IndexOutOfRangeError]
) -> list:
    """Check the indices in a jaxpr; return the results that are constant integers as arrays, None for the others.

    The arguments are constant integers or None too. A single wrong index raises an error; the error of a wrong index in
    a table is appended to ``table_errors``.
    """
    constants = dict(zip(jaxpr.invars, arguments, strict=True))
    constants.update((v, _constant_indices(c)) for v, c in zip(jaxpr.constvars, consts, strict=True))

    def read(atom) -> np.ndarray | None:
        return _constant_indices(atom.val) if isinstance(atom, Literal) else constants.get(atom)

    eqn: Any
    for eqn in jaxpr.eqns:
        name, values = eqn.primitive.name, [read(v) for v in eqn.invars]
        if name in INDEX_ACCESSES:
            for index, axis_length in _invalid_indices(eqn, values):
                error = IndexOutOfRangeError(index, axis_length, user_source_line(eqn))
                if name != "gather" or eqn.invars[1].aval.size == eqn.invars[1].aval.shape[-1]:
                    raise error
                table_errors.append(error)
        elif name in CALL_PRIMITIVES.split():
            results = _check_and_evaluate_indices(*_called_jaxpr_and_constants(eqn), values, table_errors)
            constants.update(zip(eqn.outvars, results, strict=True))
        elif name == "cond":
            branches, branch_index = eqn.params["branches"], values[0]
            possible_branches = (
                branches if branch_index is None else [branches[int(np.clip(branch_index, 0, len(branches) - 1))]]
            )
            for branch in possible_branches:
                _check_and_evaluate_indices(branch.jaxpr, branch.consts, values[1:], table_errors)
        elif (
            name in INDEX_OPERATIONS and eqn.outvars[0].aval.size <= MAX_INDICES and all(v is not None for v in values)
        ):
            constants[eqn.outvars[0]] = _constant_indices(np.asarray(INDEX_OPERATIONS[name](eqn.params, *values)))
        else:
            for inner in jaxprs_in_params(eqn.params):
                _check_and_evaluate_indices(
                    inner, [None] * len(inner.constvars), [None] * len(inner.invars), table_errors
                )
    return [read(v) for v in jaxpr.outvars]


def _called_jaxpr_and_constants(eqn) -> tuple[Jaxpr, Sequence]:
    """Return the jaxpr that an equation calls, and its constants."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    return (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())


def _uses_out_of_range_entries(closed_jaxpr: ClosedJaxpr) -> bool:
    """Return whether a result becomes NaN, at a random point, if NaN is read at indices out of range."""
    if any(isinstance(c, jax.core.Tracer) for c in closed_jaxpr.consts):
        return True
    rng = np.random.default_rng(0)
    with jax.ensure_compile_time_eval():  # numbers, even where something else is traced
        point = [jnp.asarray(rng.uniform(0.5, 1.5, v.aval.shape), v.aval.dtype) for v in closed_jaxpr.jaxpr.invars]
        results = _evaluate_with_nan_reads(closed_jaxpr.jaxpr, closed_jaxpr.consts, point)
        return any(bool(jnp.isnan(a).any()) for a in results if jnp.issubdtype(a.dtype, jnp.inexact))


def _evaluate_with_nan_reads(jaxpr: Jaxpr, consts: Sequence, arguments: Sequence) -> list:
    """Evaluate a jaxpr, reading NaN at indices out of range."""
    env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else env[atom]

    eqn: Any
    for eqn in jaxpr.eqns:
        values, name = list(map(read, eqn.invars)), eqn.primitive.name
        if name in CALL_PRIMITIVES.split():
            results = _evaluate_with_nan_reads(*_called_jaxpr_and_constants(eqn), values)
        else:
            params = eqn.params
            if name == "gather" and is_silently_clamped(eqn) and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.inexact):
                params = params | {"mode": ScatterMode.FILL_OR_DROP, "fill_value": np.nan}
            results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(params))
        env.update(zip(eqn.outvars, results if isinstance(results, list | tuple) else [results], strict=True))
    return list(map(read, jaxpr.outvars))


def _constant_indices(value: Any) -> np.ndarray | None:
    """Return an integer or truth value, or a small array of them, that is known at trace time; None otherwise."""
    if isinstance(value, jax.core.Tracer) or not hasattr(value, "dtype") or value.dtype.kind not in "iub":
        return None
    return np.asarray(value) if math.prod(np.shape(value)) <= MAX_INDICES else None


def _invalid_indices(eqn, constant_inputs: Sequence) -> Iterator[tuple[int, int]]:
    """Yield each constant index that is out of range, as the user wrote it, with the length of its axis."""
    for axis, starts, window in INDEX_ACCESSES[eqn.primitive.name](eqn, constant_inputs):
        axis_length = eqn.invars[0].aval.shape[axis]
        for start in np.unique(starts).tolist():
            if start < 0:
                yield start - axis_length, axis_length  # JAX has already added the length to a negative index
            elif start > axis_length - window:
                yield start if window == 1 else max(start, axis_length), axis_length


def _dynamic_slice_accesses(eqn, constant_inputs):
    """Yield (axis, start of window, length of window) for each constant index of a ``dynamic_slice``."""
    yield from _slice_accesses(constant_inputs[1:], eqn.params["slice_sizes"])


def _dynamic_update_accesses(eqn, constant_inputs):
    """Yield (axis, start of window, length of window) for each constant index of a ``dynamic_update_slice``."""
    yield from _slice_accesses(constant_inputs[2:], eqn.invars[1].aval.shape)


def _slice_accesses(starts, window_lengths):
    """Yield (axis, start of window, length of window) for each axis whose start is constant."""
    yield from ((axis, s, w) for axis, (s, w) in enumerate(zip(starts, window_lengths, strict=True)) if s is not None)


def is_silently_clamped(eqn) -> bool:
    """Return whether a gather or scatter clamps its indices although the user has not asked for it.

    A slice at an index, mapped over a batch, becomes a gather that clips and drops no axis.
    """
    numbers, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    dropped_axes = numbers.collapsed_slice_dims if eqn.primitive.name == "gather" else numbers.inserted_window_dims
    return mode == ScatterMode.PROMISE_IN_BOUNDS or (mode == ScatterMode.CLIP and not dropped_axes)


def _gather_accesses(eqn, constant_inputs):
    """Yield (axis, starts of windows, length of window) for each indexed axis of a gather with constant indices."""
    if is_silently_clamped(eqn):
        yield from _accesses_by_axis(
            constant_inputs[1], eqn.params["dimension_numbers"].start_index_map, eqn.params["slice_sizes"]
        )


def _scatter_accesses(eqn, constant_inputs):
    """Yield (axis, starts of windows, length of window) for each indexed axis of a scatter with constant indices."""
    numbers = eqn.params["dimension_numbers"]
    if is_silently_clamped(eqn):
        unit_axes = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
        updates = iter([eqn.invars[2].aval.shape[i] for i in numbers.update_window_dims])
        windows = [1 if i in unit_axes else next(updates) for i in range(eqn.invars[0].aval.ndim)]
        yield from _accesses_by_axis(constant_inputs[1], numbers.scatter_dims_to_operand_dims, windows)


def _accesses_by_axis(indices, axes, window_lengths):
    """Yield (axis, starts of windows, length of window) for each column of ``indices``; none if they are None."""
    if indices is not None and indices.size:
        yield from ((int(axis), indices[..., i], int(window_lengths[axis])) for i, axis in enumerate(axes))


INDEX_ACCESSES = {
    "dynamic_slice": _dynamic_slice_accesses,
    "dynamic_update_slice": _dynamic_update_accesses,
    "gather": _gather_accesses,
    **dict.fromkeys("scatter scatter-add scatter-sub scatter-mul scatter-min scatter-max".split(), _scatter_accesses),
}
"""Primitives that read or write at indices, each with a generator of (axis, starts of windows, length of window)."""
