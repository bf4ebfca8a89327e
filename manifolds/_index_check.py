"""Detection of constant indices out of range, which JAX does not report.

JAX reads ``m[2]`` for ``m[3]`` of three components, drops ``m.at[3].set(0.0)``, and reads NaN for ``jnp.take(m, 3)``.
The indices are found in a jaxpr before anything is computed. An access that states how it treats an index out of range,
such as ``x.at[3].get(mode="fill")``, ``mode="clip"`` or ``mode="drop"``, is not checked, nor are computed indices.
"""

from __future__ import annotations

import dis
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxprs_in_params

from ._jaxprs import CALL_PRIMITIVES, broadcast, is_user_file, reshape, user_source_line
from .errors import IndexOutOfRangeError

MAX_INDICES = 10_000
"""Largest number of constant indices of one access that are checked."""

ScatterMode = jax.lax.GatherScatterMode

MODE_ARGUMENT_FUNCTIONS = {
    *"set add subtract multiply mul divide power min max apply get take take_along_axis".split(),
    *"gather scatter scatter_add scatter_sub scatter_mul scatter_min scatter_max scatter_apply".split(),
}
"""Functions of JAX that go on silently with an index out of range, unless their argument ``mode`` says what is meant.

Other functions of JAX document what they do with one: ``jax.ops.segment_sum`` drops it.
"""

INDEX_OPERATIONS: dict[str, Callable[..., np.ndarray]] = {
    "lt": lambda params, a, b: a < b,
    "add": lambda params, a, b: a + b,
    "sub": lambda params, a, b: a - b,
    "mul": lambda params, a, b: a * b,
    "neg": lambda params, a: -a,
    "iota": lambda params: _iota(params["shape"], params["dimension"], params["dtype"]),
    "select_n": lambda params, index, *cases: np.choose(index.astype(int), cases),
    "convert_element_type": lambda params, a: a.astype(params["new_dtype"]),
    "broadcast_in_dim": lambda params, a: broadcast(a, params),
    "reshape": lambda params, a: reshape(a, params),
    "squeeze": lambda params, a: a.squeeze(params["dimensions"]),
    "concatenate": lambda params, *arrays: np.concatenate(arrays, axis=params["dimension"]),
}
"""Primitives by which users compute a constant index and JAX brings it to its final form."""


def _iota(shape: Sequence[int], axis: int, dtype) -> np.ndarray:
    """Return the numbers 0, 1, ... along an axis of an array, as ``jax.lax.broadcasted_iota`` does."""
    return np.broadcast_to(np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))]), shape)


def check_indices(closed_jaxpr: ClosedJaxpr, label: str = "a function") -> None:
    """Raise IndexOutOfRangeError if a jaxpr has a constant index that is out of range.

    A table of indices may have entries out of range if the values read there are not used, as for neighbours that some
    sites do not have.

    Parameters
    ----------
    closed_jaxpr : ClosedJaxpr
    label : str
        What the error calls the function.
    """
    table_errors: list[IndexOutOfRangeError] = []
    try:
        _check_and_evaluate_indices(
            closed_jaxpr.jaxpr, closed_jaxpr.consts, [None] * len(closed_jaxpr.jaxpr.invars), table_errors
        )
    except IndexOutOfRangeError as error:
        raise error.with_function(label) from None
    if table_errors and _uses_out_of_range_entries(closed_jaxpr):
        raise table_errors[0].with_function(label)


def _check_and_evaluate_indices(
    jaxpr: Jaxpr, consts: Sequence, arguments: Sequence, table_errors: list[IndexOutOfRangeError], caller: Any = None
) -> list:
    """Check the indices in a jaxpr; return the results that are constant integers as arrays, None for the others.

    The arguments are constant integers or None too. A single wrong index raises an error, and so does a wrong index in
    a table of entries to be written; the error of a wrong index in a table of entries to be read is appended to
    ``table_errors``. ``caller`` is the equation that calls the jaxpr, if the jaxpr belongs to a function of JAX: JAX
    keeps the jaxprs of its own functions, with the lines of the user's code that called them first.
    """
    constants = dict(zip(jaxpr.invars, arguments, strict=True))
    constants.update((v, _constant_indices(c)) for v, c in zip(jaxpr.constvars, consts, strict=True))

    def read(atom) -> np.ndarray | None:
        return _constant_indices(atom.val) if isinstance(atom, Literal) else constants.get(atom)

    eqn: Any
    for eqn in jaxpr.eqns:
        name, values = eqn.primitive.name, [read(v) for v in eqn.invars]
        if name in INDEX_ACCESSES:
            for index, axis_length in _invalid_indices(eqn, values, caller or eqn):
                error = IndexOutOfRangeError(
                    index, axis_length, user_source_line(caller or eqn), access=_bad_index_effect(eqn)
                )
                if name != "gather" or eqn.invars[1].aval.size == eqn.invars[1].aval.shape[-1]:
                    raise error
                table_errors.append(error)
        elif name in CALL_PRIMITIVES:
            inner_caller = caller or (eqn if _calls_function_of_jax(eqn) else None)
            results = _check_and_evaluate_indices(*_called_jaxpr_and_constants(eqn), values, table_errors, inner_caller)
            constants.update(zip(eqn.outvars, results, strict=True))
        elif name == "cond":
            branches, branch_index = eqn.params["branches"], values[0]
            possible_branches = (
                branches if branch_index is None else [branches[int(np.clip(branch_index, 0, len(branches) - 1))]]
            )
            for branch in possible_branches:
                _check_and_evaluate_indices(branch.jaxpr, branch.consts, values[1:], table_errors, caller)
        elif (
            name in INDEX_OPERATIONS and eqn.outvars[0].aval.size <= MAX_INDICES and all(v is not None for v in values)
        ):
            constants[eqn.outvars[0]] = _constant_indices(np.asarray(INDEX_OPERATIONS[name](eqn.params, *values)))
        else:
            for inner in jaxprs_in_params(eqn.params):
                _check_and_evaluate_indices(
                    inner, [None] * len(inner.constvars), [None] * len(inner.invars), table_errors, caller
                )
    return [read(v) for v in jaxpr.outvars]


def _called_jaxpr_and_constants(eqn) -> tuple[Jaxpr, Sequence]:
    """Return the jaxpr that an equation calls, and its constants."""
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    return (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())


def _calls_function_of_jax(eqn) -> bool:
    """Return whether an equation calls a function that JAX defines, not one of the user's that is jitted."""
    filename = _called_jaxpr_and_constants(eqn)[0].debug_info.func_filename
    return filename is not None and not is_user_file(Path(filename))


def _bad_index_effect(eqn) -> str:
    """Return "read" or "write" for an access that moves an index out of range, "fill" or "drop" if it skips it."""
    reads = eqn.primitive.name in ("gather", "dynamic_slice")
    if eqn.params.get("mode") == ScatterMode.FILL_OR_DROP:
        return "fill" if reads else "drop"
    return "read" if reads else "write"


def _uses_out_of_range_entries(closed_jaxpr: ClosedJaxpr) -> bool:
    """Return whether a result becomes NaN, at random points, if NaN is read at indices out of range.

    True also if the results are NaN at all points in any case, since nothing is known of the entries then.
    """
    if any(isinstance(c, jax.core.Tracer) for c in closed_jaxpr.consts):
        return True
    rng = np.random.default_rng(0)
    with jax.ensure_compile_time_eval():  # numbers, even where something else is traced
        for center, half_width in TEST_RANGES:
            point = [
                jnp.asarray(center + half_width * rng.uniform(-1.0, 1.0, v.aval.shape), v.aval.dtype)
                for v in closed_jaxpr.jaxpr.invars
            ]
            results_with_nan, results_with_zero = (
                _evaluate_with_fill_value(closed_jaxpr.jaxpr, closed_jaxpr.consts, point, fill)
                for fill in (math.nan, 0.0)
            )
            if not _has_nan(results_with_nan):
                return False
            if not _has_nan(results_with_zero):
                return True
    return True


TEST_RANGES = ((1.0, 0.5), (0.1, 0.1), (0.0, 0.01), (3.0, 1.0), (30.0, 10.0))
"""Centres and half widths of the ranges of random points, from the likeliest inside a function's domain."""


def _has_nan(results: Sequence) -> bool:
    """Return whether an array of real or complex numbers among the results has a NaN entry."""
    return any(bool(jnp.isnan(a).any()) for a in results if jnp.issubdtype(a.dtype, jnp.inexact))


def _evaluate_with_fill_value(jaxpr: Jaxpr, consts: Sequence, arguments: Sequence, fill_value: float) -> list:
    """Evaluate a jaxpr, reading ``fill_value`` at indices out of range."""
    env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else env[atom]

    eqn: Any
    for eqn in jaxpr.eqns:
        values, name = list(map(read, eqn.invars)), eqn.primitive.name
        if name in CALL_PRIMITIVES:
            results = _evaluate_with_fill_value(*_called_jaxpr_and_constants(eqn), values, fill_value)
        else:
            params = eqn.params
            if (
                name == "gather"
                and (is_silently_clamped(eqn) or _gather_fills_with_nan(eqn))
                and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.inexact)
            ):
                params = params | {"mode": ScatterMode.FILL_OR_DROP, "fill_value": fill_value}
            results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(params))
        env.update(zip(eqn.outvars, results if isinstance(results, list | tuple) else [results], strict=True))
    return list(map(read, jaxpr.outvars))


def _constant_indices(value: Any) -> np.ndarray | None:
    """Return an integer or truth value, or a small array of them, that is known at trace time; None otherwise."""
    if isinstance(value, jax.core.Tracer) or not hasattr(value, "dtype") or value.dtype.kind not in "iub":
        return None
    return np.asarray(value) if math.prod(np.shape(value)) <= MAX_INDICES else None


def _invalid_indices(eqn, constant_inputs: Sequence, call: Any) -> Iterator[tuple[int, int]]:
    """Yield each constant index that is out of range, as the user wrote it, with the length of its axis.

    ``call`` is the equation whose traceback has the user's call.
    """
    if eqn.params.get("mode") == ScatterMode.FILL_OR_DROP and not _user_call_omits_mode(call):
        return
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


def _gather_fills_with_nan(eqn) -> bool:
    """Return whether a gather reads NaN at an index out of range."""
    fill_value = eqn.params.get("fill_value")
    return eqn.params["mode"] == ScatterMode.FILL_OR_DROP and (fill_value is None or bool(np.isnan(fill_value)))


def _user_call_omits_mode(eqn) -> bool:
    """Return whether the user's call of a function with an argument ``mode`` leaves this argument out.

    In a jaxpr, ``x.at[3].set(0.0)`` and ``x.at[3].set(0.0, mode="drop")`` are the same, so the names of the arguments
    are read from the bytecode of the call. False if the call is not known, or passes ``**options``.
    """
    traceback = eqn.source_info.traceback
    if traceback is None:
        return False
    called_function = eqn.params.get("name")  # of a function that is jitted: no frame of its own is on the stack
    for code, offset in zip(*traceback.raw_frames(), strict=True):
        if is_user_file(Path(code.co_filename)):
            keywords = _keyword_names_of_call(code, offset)
            return called_function in MODE_ARGUMENT_FUNCTIONS and keywords is not None and "mode" not in keywords
        if not set(Path(code.co_filename).parts) & _JAX_MACHINERY:
            called_function = code.co_name
    return False


_JAX_MACHINERY = {"interpreters", "core.py", "source_info_util.py", "pjit.py", "traceback_util.py"}
"""Files and folders of JAX whose functions stand between a public function and the operations that it traces."""


def _keyword_names_of_call(code: CodeType, bytecode_offset: int) -> tuple[str, ...] | None:
    """Return the names of the keyword arguments of the call at an offset of the bytecode; None for ``**options``.

    The offset may lie behind that of the call, in the space that Python reserves for its cache.
    """
    keywords: tuple[str, ...] = ()
    last_constant: Any = ()
    call, keywords_of_call = "", keywords
    for instruction in dis.get_instructions(code):
        if instruction.offset > bytecode_offset:
            break
        call, keywords_of_call = instruction.opname, keywords
        if call == "LOAD_CONST":
            last_constant = instruction.argval
        elif call == "KW_NAMES":  # Python 3.11 and 3.12
            keywords = code.co_consts[instruction.arg or 0]
        elif call == "CALL_KW":  # Python 3.13
            keywords_of_call = last_constant
        elif call == "CALL":
            keywords = ()
    return None if call == "CALL_FUNCTION_EX" else keywords_of_call


def _gather_accesses(eqn, constant_inputs):
    """Yield (axis, starts of windows, length of window) for each indexed axis of a gather with constant indices."""
    if is_silently_clamped(eqn) or _gather_fills_with_nan(eqn):
        yield from _accesses_by_axis(
            constant_inputs[1], eqn.params["dimension_numbers"].start_index_map, eqn.params["slice_sizes"]
        )


def _scatter_accesses(eqn, constant_inputs):
    """Yield (axis, starts of windows, length of window) for each indexed axis of a scatter with constant indices."""
    numbers = eqn.params["dimension_numbers"]
    if is_silently_clamped(eqn) or eqn.params["mode"] == ScatterMode.FILL_OR_DROP:
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
