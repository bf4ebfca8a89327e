"""Results kept for what they were found for: systems and methods never change."""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import numpy as np

Result = TypeVar("Result")

MAX_CACHED_RESULTS = 64
"""Results of one function that are held in memory, those last used."""

MAX_CACHED_BYTES = 2**28
"""Largest size of the arrays that they were found for, together."""

MAX_COMPARED_BYTES = 2**20
"""Largest size of arrays that are compared by content: comparing larger ones takes longer than a call should."""


class LRUCache(Generic[Result]):
    """Results by their keys, those last used.

    Parameters
    ----------
    max_entries : int
        How many.
    max_size : int, optional
        Of all together.
    """

    def __init__(self, max_entries: int, max_size: float = float("inf")):
        self.max_entries, self.max_size = max_entries, max_size
        self._entries: OrderedDict[Hashable, tuple[Result, int]] = OrderedDict()
        self._total_size, self._lock = 0, threading.Lock()

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: Hashable) -> Result | None:
        """What is known by a key, or None."""
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            return self._entries[key][0]

    def get_or_compute(self, key: Hashable, make: Callable[[], Result], size: int = 0) -> Result:
        """What is known by a key; made, and kept, where nothing is."""
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key][0]
        found = make()
        with self._lock:
            if key not in self._entries:
                self._total_size += size
            self._entries[key] = found, size
            while len(self._entries) > self.max_entries or (
                self._total_size > self.max_size and len(self._entries) > 1
            ):
                self._total_size -= self._entries.popitem(last=False)[1][1]
        return found


def memoize(function: Callable[..., Result]) -> Callable[..., Result]:
    """Decorator: call a function of pytrees once for the same objects, or for others of the same content.

    Objects with leaves that could change in place, as NumPy arrays can, or that are being traced, are not remembered.
    """
    known: LRUCache[tuple[tuple, Result]] = LRUCache(MAX_CACHED_RESULTS, MAX_CACHED_BYTES)
    alike: LRUCache[Result] = LRUCache(MAX_CACHED_RESULTS, MAX_CACHED_BYTES)

    def find_by_content(arguments: tuple, size: int) -> Result:
        content = fingerprint(arguments) if size <= MAX_COMPARED_BYTES else None
        make = functools.partial(function, *arguments)
        return make() if content is None else alike.get_or_compute(content, make, size)

    @functools.wraps(function)
    def call(*arguments) -> Result:
        found = known.get(identities := tuple(map(id, arguments)))
        if found is not None:
            return found[1]
        leaves = jax.tree_util.tree_leaves(arguments)
        if any(isinstance(leaf, np.ndarray | jax.core.Tracer) for leaf in leaves):
            return function(*arguments)
        size = sum(leaf.nbytes for leaf in leaves if eqx.is_array(leaf))
        # the arguments are held on to, so that no other object takes their identity
        return known.get_or_compute(identities, lambda: (arguments, find_by_content(arguments, size)), size)[1]

    return call


def fingerprint(tree: Any) -> Any:
    """A key that tells pytrees apart by the values of arrays and the identity of the rest; None where there is none."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    try:
        parts = tuple(
            (leaf.shape, leaf.dtype, np.asarray(leaf).tobytes())
            if isinstance(leaf, jax.Array | np.ndarray | np.generic)
            else (type(leaf), leaf)
            for leaf in leaves
        )
        hash(key := (structure, parts))
    except (TypeError, jax.errors.JAXTypeError):  # something unhashable, or traced
        return None
    return key
