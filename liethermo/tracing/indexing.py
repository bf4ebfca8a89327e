"""Entries at places that are known at run time alone: gathering and scattering, slices that start anywhere."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from .builder import Scalar, array

Place = tuple[int, ...]


def known(*indices: np.ndarray) -> bool:
    """Whether indices are numbers."""
    return not any(type(i) is str for x in indices for i in x.flat)


class Starts:
    """Where windows of one size start in an array, some of it known at run time alone.

    Parameters
    ----------
    b : Builder
    shape, window : tuple of int
    starts : sequence of scalars, one for each axis
        Integers. A window that would stick out is moved inside.
    """

    def __init__(self, b, shape: Place, window: Place, starts: Sequence[Scalar]):
        self.b, self.starts = b.real, starts
        self.most = [n - m for n, m in zip(shape, window, strict=True)]

    def inside(self) -> Scalar:
        """Whether nothing sticks out."""
        b = self.b
        tests = [
            b.op("and", b.op("ge", s, 0), b.op("le", s, most)) for s, most in zip(self.starts, self.most, strict=True)
        ]
        found: Scalar = True
        for test in tests:
            found = b.op("and", found, test)
        return found

    def reach(self) -> tuple[Scalar, list[Place]]:
        """The number, at run time, of the place where the window starts, and all places that it may be."""
        b = self.b
        number: Scalar = 0
        ranges = []
        for s, most in zip(self.starts, self.most, strict=True):
            if type(s) is str:
                s = b.min(b.max(s, 0), most)
                number = b.add(b.mul(number, most + 1), s)
                ranges.append(range(most + 1))
            else:
                s = min(max(int(s), 0), most)
                ranges.append(range(s, s + 1))
        return number, list(itertools.product(*ranges))


def _moved(place: Place, offset: Place) -> Place:
    return tuple(i + j for i, j in zip(place, offset, strict=True))


def window(b, x: np.ndarray, starts: Sequence[Scalar], sizes: Place) -> np.ndarray:
    """``dynamic_slice``."""
    number, places = Starts(b, x.shape, sizes, starts).reach()
    entries = [b.pick(number, [x[_moved(p, o)] for p in places]) for o in np.ndindex(*sizes)]
    return array(entries, sizes)


def _combined(
    b, result: np.ndarray, number: Scalar, places: Sequence[Place], offset: Place, entry: Callable, sure=True
):
    """Put ``entry(old)`` where the window starts, in place."""
    for i, place in enumerate(places):
        at = _moved(place, offset)
        hit = b.op("and", sure, b.op("eq", number, i) if len(places) > 1 else True)
        result[at] = b.select(hit, entry(result[at]), result[at])


def updated(b, x: np.ndarray, update: np.ndarray, starts: Sequence[Scalar]) -> np.ndarray:
    """``dynamic_update_slice``."""
    number, places = Starts(b, x.shape, update.shape, starts).reach()
    result = x.copy()
    for offset in np.ndindex(*update.shape):
        _combined(b, result, number, places, offset, lambda old, offset=offset: update[offset])
    return result


def _windows(indices: np.ndarray, batch: Place, index_map, batching, rank: int) -> Iterator[tuple[Place, list]]:
    """Each place in the batch, and the start there, an entry for each axis of the array."""
    own_batching, indices_batching = batching
    for place in np.ndindex(*batch):
        start: list[Any] = [0] * rank
        for axis, i in zip(index_map, indices[place], strict=True):
            start[axis] = i
        for axis, other in zip(own_batching, indices_batching, strict=True):
            start[axis] = place[other]
        yield place, start


def gathered(b, eqn, x: np.ndarray, indices: np.ndarray, filling: Scalar) -> np.ndarray:
    """``gather``, its modes as JAX has them."""
    numbers, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    shape, sizes = eqn.outvars[0].aval.shape, tuple(int(n) for n in eqn.params["slice_sizes"])
    offset_dims = [int(i) for i in numbers.offset_dims]
    left_out = {int(i) for i in (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)}
    kept = [i for i in range(x.ndim) if i not in left_out]
    batch_dims = [i for i in range(len(shape)) if i not in offset_dims]
    result = np.empty(shape, object)
    batching = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    batch = tuple(shape[i] for i in batch_dims)
    for place, start in _windows(indices, batch, numbers.start_index_map, batching, x.ndim):
        starts = Starts(b, x.shape, sizes, start)
        number, places = starts.reach()
        sure = starts.inside() if mode == jax.lax.GatherScatterMode.FILL_OR_DROP else True
        for inner in np.ndindex(*(sizes[i] for i in kept)):
            offset = [0] * x.ndim
            target = [0] * len(shape)
            for axis, dim, i in zip(kept, offset_dims, inner, strict=True):
                offset[axis], target[dim] = i, i
            for dim, i in zip(batch_dims, place, strict=True):
                target[dim] = i
            found = b.pick(number, [x[_moved(p, tuple(offset))] for p in places])
            result[tuple(target)] = b.select(sure, found, filling)
    return result


def scattered(b, eqn, x: np.ndarray, indices: np.ndarray, updates: np.ndarray, combine: Callable) -> np.ndarray:
    """``scatter`` and its kin, ``combine(old, update)`` being what takes the place of what is there."""
    numbers, mode = eqn.params["dimension_numbers"], eqn.params["mode"]
    window_dims = [int(i) for i in numbers.update_window_dims]
    left_out = {int(i) for i in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)}
    kept = [i for i in range(x.ndim) if i not in left_out]
    sizes = [1] * x.ndim
    for axis, dim in zip(kept, window_dims, strict=True):
        sizes[axis] = updates.shape[dim]
    batch_dims = [i for i in range(updates.ndim) if i not in window_dims]
    batching = numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    batch, result = tuple(updates.shape[i] for i in batch_dims), x.copy()
    clips = mode == jax.lax.GatherScatterMode.CLIP
    if not math.prod(updates.shape):
        return result
    for place, start in _windows(indices, batch, numbers.scatter_dims_to_operand_dims, batching, x.ndim):
        starts = Starts(b, x.shape, tuple(sizes), start)
        number, places = starts.reach()
        sure = True if clips else starts.inside()  # an update that sticks out is dropped
        for inner in np.ndindex(*(sizes[i] for i in kept)):
            offset, source = [0] * x.ndim, [0] * updates.ndim
            for axis, dim, i in zip(kept, window_dims, inner, strict=True):
                offset[axis], source[dim] = i, i
            for dim, i in zip(batch_dims, place, strict=True):
                source[dim] = i
            update = updates[tuple(source)]
            _combined(b, result, number, places, tuple(offset), lambda old, u=update: combine(old, u), sure)
    return result
