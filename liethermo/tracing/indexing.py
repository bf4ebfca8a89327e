"""Gathering, scattering and slicing, at indices that are constants or known only at run time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from .builder import LimitExceededError, Scalar, map_elementwise, scalar_array

Index = tuple[int, ...]


def _candidate_index_and_windows(
    builder, shape: Index, starts: Sequence[Scalar], sizes: Index
) -> tuple[Scalar, list[tuple]]:
    """Return the index of a window among the candidate windows, and the list of these candidates.

    The index is a scalar that may be known at run time only. A window that sticks out of the array is moved inside.
    """
    return _candidate_window_index(builder, shape, starts, sizes), _candidate_windows(shape, starts, sizes)


def _candidate_window_index(builder, shape: Index, starts: Sequence[Scalar], sizes: Index) -> Scalar:
    """Return the index of a window among :func:`_candidate_windows`, a scalar that may be known at run time only."""
    window_number: Scalar = 0
    for s, n, m in zip(starts, shape, sizes, strict=True):
        if type(s) is str:
            window_number = builder.add(builder.mul(window_number, n - m + 1), builder.min(builder.max(s, 0), n - m))
    return window_number


def _candidate_windows(shape: Index, starts: Sequence[Scalar], sizes: Index) -> list[tuple]:
    """Return every window, a tuple of slices, that the starts may select; a start that is a number fixes its axis."""
    ranges = []
    for s, n, m in zip(starts, shape, sizes, strict=True):
        fixed_start = None if type(s) is str else min(max(int(s), 0), n - m)
        ranges.append(range(n - m + 1) if fixed_start is None else range(fixed_start, fixed_start + 1))
    corners = itertools.product(*ranges)
    # the ellipsis makes the result an array even without axes
    return [(*(slice(i, i + m) for i, m in zip(corner, sizes, strict=True)), ...) for corner in corners]


def _is_window_inside(builder, shape: Index, starts: Sequence[Scalar], sizes: Index) -> Scalar:
    """Return the scalar that is true if a window lies inside an array of this shape."""
    start_bounds = list(zip(starts, (n - m for n, m in zip(shape, sizes, strict=True)), strict=True))
    if not all(0 <= s <= last_start for s, last_start in start_bounds if not isinstance(s, str)):
        return False
    return builder.all(
        builder.op(test, s, bound)
        for s, last_start in start_bounds
        if type(s) is str
        for test, bound in (("ge", 0), ("le", last_start))
    )


def read_window(builder, x: np.ndarray, starts: Sequence[Scalar], sizes: Index) -> np.ndarray:
    """Unroll ``dynamic_slice``: return the entries of x in the window with these starts, shape ``sizes``."""
    if builder is builder.real_builder and any(type(s) is str for s in starts):
        return _read_window_by_shared_tables(builder, x, starts, sizes)
    window_number, windows = _candidate_index_and_windows(builder.real_builder, x.shape, starts, sizes)
    if len(windows) == 1:
        return x[windows[0]]
    entries = zip(*(x[window].ravel().tolist() for window in windows), strict=True)
    return scalar_array([builder.pick(window_number, candidates) for candidates in entries], sizes)


def _read_window_by_shared_tables(builder, x: np.ndarray, starts: Sequence[Scalar], sizes: Index) -> np.ndarray:
    """Return the real entries in a window at run-time indices, read from tables that all reads of one array share."""
    window_number = _candidate_window_index(builder, x.shape, starts, sizes)
    key = id(x), tuple(sizes), tuple(None if type(s) is str else int(s) for s in starts)
    if key not in builder.prepared_windows:
        windows = _candidate_windows(x.shape, starts, sizes)
        columns = zip(*(x[window].ravel().tolist() for window in windows), strict=True)
        prepared_entries = [builder.prepare_pick(column) for column in columns]
        builder.prepared_windows[key] = x, prepared_entries  # the array is held, so that its id remains its own
    prepared_entries = builder.prepared_windows[key][1]
    if type(window_number) is not str:  # each axis has one place
        return scalar_array([candidates[0] for candidates in prepared_entries], sizes)
    return scalar_array([builder.pick_prepared(window_number, candidates) for candidates in prepared_entries], sizes)


def update_window_in_place(
    builder, x: np.ndarray, starts: Sequence[Scalar], sizes: Index, change: Callable, condition: Scalar = True
) -> None:
    """Replace the entries of x in the window with these starts by ``change(entries)`` where the condition holds."""
    window_number, windows = _candidate_index_and_windows(builder.real_builder, x.shape, starts, sizes)
    for i, window in enumerate(windows):
        is_hit = (
            builder.real_builder.op("and", condition, builder.real_builder.op("eq", window_number, i))
            if len(windows) > 1
            else condition
        )
        x[window] = _select_array(builder, is_hit, change(x[window]), x[window])


def _select_array(builder, test: Scalar, x: np.ndarray, fallback) -> np.ndarray:
    """Return ``x if test else fallback`` as an array of scalars."""
    return x if test is True else map_elementwise(lambda a, c: builder.select(test, a, c), x, fallback)


def _window_indices_and_starts(
    builder, shape: Index, window_axes: Sequence[int], indices: np.ndarray, indexed_axes, paired_batch_axes, rank: int
) -> Iterator:
    """Yield, for each window of a gather or scatter, its index in the array of all windows and its start indices.

    Parameters
    ----------
    shape : tuple of int
        Shape of the array of all windows.
    window_axes : sequence of int
        Axes of this array that belong to a single window.
    indices : array of scalars, shape (..., number of indexed axes)
        Starts along the indexed axes of the array that is read or written.
    indexed_axes : sequence of int
    paired_batch_axes : (axes of the array that is read or written, axes of ``indices``)
    rank : int
        Number of axes of the array that is read or written.
    """
    batch = [range(n) if i not in window_axes else [slice(None)] for i, n in enumerate(shape)]
    if np.prod([len(indices_along_axis) for indices_along_axis in batch]) > builder.real_builder.max_instructions:
        raise LimitExceededError
    for index in itertools.product(*batch):
        batch_index = tuple(i for i in index if isinstance(i, int))
        start: list[Scalar] = [0] * rank
        for axis, i in zip(indexed_axes, indices[batch_index], strict=True):
            start[axis] = i
        for axis, batch_axis in zip(*paired_batch_axes, strict=True):
            start[axis] = batch_index[batch_axis]
        yield index, start


def gather(builder, eqn, x: np.ndarray, indices: np.ndarray, fill_value: Scalar) -> np.ndarray:
    """Unroll ``lax.gather``: return the windows at these indices as an array of scalars, with the modes of JAX."""
    numbers, sizes = eqn.params["dimension_numbers"], tuple(map(int, eqn.params["slice_sizes"]))
    dropped_axes, result = (
        (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims),
        np.empty(_result_shape(eqn), object),
    )
    fills = eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    batching = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    window_shape, axes = [n for i, n in enumerate(sizes) if i not in dropped_axes], numbers.start_index_map
    for index, start in _window_indices_and_starts(
        builder, result.shape, numbers.offset_dims, indices, axes, batching, x.ndim
    ):
        window = read_window(builder, x, start, sizes)
        is_inside = _is_window_inside(builder.real_builder, x.shape, start, sizes) if fills else True
        result[index] = _select_array(builder, is_inside, window, fill_value).reshape(window_shape)[
            ()
        ]  # without axes, an entry
    return result


def _result_shape(eqn) -> Index:
    return eqn.outvars[0].aval.shape


def scatter(builder, eqn, x: np.ndarray, indices: np.ndarray, updates: np.ndarray, combine: Callable) -> np.ndarray:
    """Unroll ``lax.scatter`` and its variants: return x with ``combine(old, update)`` in place of the entries."""
    numbers, clips = eqn.params["dimension_numbers"], eqn.params["mode"] == jax.lax.GatherScatterMode.CLIP
    unit_axes, window_axes = (
        (*numbers.inserted_window_dims, *numbers.operand_batching_dims),
        list(numbers.update_window_dims),
    )
    window_sizes = iter([updates.shape[i] for i in window_axes])
    sizes, result = tuple(1 if i in unit_axes else next(window_sizes) for i in range(x.ndim)), x.copy()
    batching = numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    if not updates.size:
        return result
    axes = numbers.scatter_dims_to_operand_dims
    for index, start in _window_indices_and_starts(
        builder, updates.shape, window_axes, indices, axes, batching, x.ndim
    ):
        new = updates[(*index, ...)].reshape(sizes)
        condition = (
            True if clips else _is_window_inside(builder.real_builder, x.shape, start, sizes)
        )  # updates outside are dropped
        update_window_in_place(
            builder, result, start, sizes, lambda old, new=new: map_elementwise(combine, old, new), condition
        )
    return result
