"""Gathering, scattering and slices, at places that are numbers or are known at run time alone."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from .builder import LimitExceededError, Scalar, elementwise, scalar_array

Index = tuple[int, ...]


def _candidate_windows(b, shape: Index, starts: Sequence[Scalar], sizes: Index) -> tuple[Scalar, list[tuple]]:
    """The number, at run time, of a window that begins at scalars, moved inside where it sticks out; and all windows
    that it may be."""
    number: Scalar = 0
    ranges = []
    for s, n, m in zip(starts, shape, sizes, strict=True):
        if type(s) is str:
            number = b.add(b.mul(number, n - m + 1), b.min(b.max(s, 0), n - m))
            ranges.append(range(n - m + 1))
        else:
            first = min(max(int(s), 0), n - m)
            ranges.append(range(first, first + 1))
    places = itertools.product(*ranges)
    # with an ellipsis, so that what is there is an array even of no axes
    return number, [(*(slice(i, i + m) for i, m in zip(place, sizes, strict=True)), ...) for place in places]


def _is_window_inside(b, shape: Index, starts: Sequence[Scalar], sizes: Index) -> Scalar:
    """Whether nothing of a window sticks out."""
    ends = list(zip(starts, (n - m for n, m in zip(shape, sizes, strict=True)), strict=True))
    if not all(0 <= s <= most for s, most in ends if not isinstance(s, str)):
        return False
    return b.all(b.op(test, s, end) for s, most in ends if type(s) is str for test, end in (("ge", 0), ("le", most)))


def read_window(b, x: np.ndarray, starts: Sequence[Scalar], sizes: Index) -> np.ndarray:
    """The entries in a window, shape ``sizes``: ``dynamic_slice``."""
    number, places = _candidate_windows(b.real, x.shape, starts, sizes)
    if len(places) == 1:
        return x[places[0]]
    entries = zip(*(x[place].ravel().tolist() for place in places), strict=True)
    return scalar_array([b.pick(number, own) for own in entries], sizes)


def update_window(
    b, x: np.ndarray, starts: Sequence[Scalar], sizes: Index, change: Callable, sure: Scalar = True
) -> None:
    """Change the entries in a window to ``change(old)``, where a truth value holds."""
    number, places = _candidate_windows(b.real, x.shape, starts, sizes)
    for i, place in enumerate(places):
        hit = b.real.op("and", sure, b.real.op("eq", number, i)) if len(places) > 1 else sure
        x[place] = _select_array(b, hit, change(x[place]), x[place])


def _select_array(b, test: Scalar, x: np.ndarray, other) -> np.ndarray:
    return x if test is True else elementwise(lambda a, c: b.select(test, a, c), x, other)


def _window_starts(b, shape: Index, inner: Sequence[int], indices: np.ndarray, axes, batching, rank: int) -> Iterator:
    """Where each window lies in an array of this shape, of which ``inner`` are its own axes, and where it starts."""
    batch = [range(n) if i not in inner else [slice(None)] for i, n in enumerate(shape)]
    if np.prod([len(places) for places in batch]) > b.real.max_instructions:
        raise LimitExceededError
    for place in itertools.product(*batch):
        own = tuple(i for i in place if isinstance(i, int))
        start: list[Scalar] = [0] * rank
        for axis, i in zip(axes, indices[own], strict=True):
            start[axis] = i
        for axis, other in zip(*batching, strict=True):
            start[axis] = own[other]
        yield place, start


def gather(b, eqn, x: np.ndarray, indices: np.ndarray, filling: Scalar) -> np.ndarray:
    """``gather``, its modes as JAX has them."""
    numbers, sizes = eqn.params["dimension_numbers"], tuple(map(int, eqn.params["slice_sizes"]))
    left_out, result = (
        (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims),
        np.empty(_result_shape(eqn), object),
    )
    fills = eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    batching = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    own, axes = [n for i, n in enumerate(sizes) if i not in left_out], numbers.start_index_map
    for place, start in _window_starts(b, result.shape, numbers.offset_dims, indices, axes, batching, x.ndim):
        found = read_window(b, x, start, sizes)
        sure = _is_window_inside(b.real, x.shape, start, sizes) if fills else True
        result[place] = _select_array(b, sure, found, filling).reshape(own)[()]  # of no axes an entry
    return result


def _result_shape(eqn) -> Index:
    return eqn.outvars[0].aval.shape


def scatter(b, eqn, x: np.ndarray, indices: np.ndarray, updates: np.ndarray, combine: Callable) -> np.ndarray:
    """``scatter`` and its kin, ``combine(old, update)`` being what takes the place of what is there."""
    numbers, clips = eqn.params["dimension_numbers"], eqn.params["mode"] == jax.lax.GatherScatterMode.CLIP
    left_out, inner = (*numbers.inserted_window_dims, *numbers.operand_batching_dims), list(numbers.update_window_dims)
    own = iter([updates.shape[i] for i in inner])
    sizes, result = tuple(1 if i in left_out else next(own) for i in range(x.ndim)), x.copy()
    batching = numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    if not updates.size:
        return result
    axes = numbers.scatter_dims_to_operand_dims
    for place, start in _window_starts(b, updates.shape, inner, indices, axes, batching, x.ndim):
        new = updates[(*place, ...)].reshape(sizes)
        sure = True if clips else _is_window_inside(b.real, x.shape, start, sizes)  # what sticks out is dropped
        update_window(b, result, start, sizes, lambda old, new=new: elementwise(combine, old, new), sure)
    return result
