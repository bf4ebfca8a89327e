"""Caches of results of functions of systems and methods, which never change."""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np

Result = TypeVar("Result")

MAX_CACHED_RESULTS = 64
"""Largest number of results that one function keeps; the least recently used are dropped."""

MAX_CACHED_BYTES = 2**28
"""Largest total size, in bytes, of the arrays among the arguments that one function keeps."""

MAX_COMPARED_BYTES = 2**20
"""Largest size, in bytes, of arguments compared by content; comparing larger ones takes longer than most calls."""


class LRUCache(Generic[Result]):
    """A cache of the results that were used last.

    Parameters
    ----------
    max_entries : int
        Largest number of results.
    max_bytes : float, optional
        Largest total size of the entries. One entry is always kept.
    """

    def __init__(self, max_entries: int, max_bytes: float = float("inf")):
        self.max_entries, self.max_bytes = max_entries, max_bytes
        self._entries: OrderedDict[Hashable, tuple[Result, int]] = OrderedDict()
        self._total_bytes, self._lock = 0, threading.Lock()

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: Hashable) -> Result | None:
        """Return the result for a key, or None."""
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            return self._entries[key][0]

    def get_or_compute(self, key: Hashable, compute: Callable[[], Result], n_bytes: int = 0) -> Result:
        """Return the result for a key; compute and store it if it is missing."""
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key][0]
        result = compute()
        with self._lock:
            if key not in self._entries:
                self._total_bytes += n_bytes
            self._entries[key] = result, n_bytes
            while len(self._entries) > self.max_entries or (
                self._total_bytes > self.max_bytes and len(self._entries) > 1
            ):
                self._total_bytes -= self._entries.popitem(last=False)[1][1]
        return result


def memoize(function: Callable[..., Result]) -> Callable[..., Result]:
    """Decorator: cache the results of a function of pytrees, by the identity of its arguments and by their content.

    A call whose arguments have NumPy arrays, which can change in place, or tracers among their leaves is not cached.
    """
    identity_cache: LRUCache[tuple[tuple, Result]] = LRUCache(MAX_CACHED_RESULTS, MAX_CACHED_BYTES)
    content_cache: LRUCache[Result] = LRUCache(MAX_CACHED_RESULTS, MAX_CACHED_BYTES)

    def get_or_compute_by_content(arguments: tuple, contents: tuple[_ArgumentContent, ...], n_bytes: int) -> Result:
        compute, keys = functools.partial(function, *arguments), tuple(content.key for content in contents)
        if n_bytes > MAX_COMPARED_BYTES or None in keys:
            return compute()
        return content_cache.get_or_compute(keys, compute, n_bytes)

    @functools.wraps(function)
    def call(*arguments) -> Result:
        entry = identity_cache.get(identities := tuple(map(id, arguments)))
        if entry is not None:
            return entry[1]
        contents = tuple(map(_cached_key_and_size, arguments))
        if any(content.is_changeable for content in contents):
            return function(*arguments)
        n_bytes = sum(content.n_bytes for content in contents)
        # the entry holds the arguments, so that no other object takes their id
        return identity_cache.get_or_compute(
            identities, lambda: (arguments, get_or_compute_by_content(arguments, contents, n_bytes)), n_bytes
        )[1]

    return call


class _ArgumentContent(NamedTuple):
    """Key and size of an argument of a cached function, for a lookup by its content.

    Attributes
    ----------
    key : hashable
        Its :func:`pytree_key_or_none`; None if it has none, or is too large to be compared.
    n_bytes : int
        Size of its arrays.
    is_changeable : bool
        Whether it contains NumPy arrays, which can change in place, or tracers.
    """

    key: Hashable | None
    n_bytes: int
    is_changeable: bool


_content_cache: LRUCache[tuple[Any, _ArgumentContent]] = LRUCache(MAX_CACHED_RESULTS, MAX_CACHED_BYTES)


def _cached_key_and_size(argument: Any) -> _ArgumentContent:
    """Return the key and size of an argument's content, cached by the identity of the argument."""
    entry = _content_cache.get(id(argument))
    if entry is not None:
        return entry[1]
    leaves = jax.tree_util.tree_leaves(argument)
    if any(isinstance(leaf, np.ndarray | jax.core.Tracer) for leaf in leaves):
        return _ArgumentContent(None, 0, is_changeable=True)
    n_bytes = sum(leaf.nbytes for leaf in leaves if eqx.is_array(leaf))
    content = _ArgumentContent(
        pytree_key_or_none(argument) if n_bytes <= MAX_COMPARED_BYTES else None, n_bytes, is_changeable=False
    )
    # the entry holds the argument, so that no other object takes its id
    return _content_cache.get_or_compute(id(argument), lambda: (argument, content), n_bytes)[1]


def pytree_key_or_none(tree: Any) -> Any:
    """Return a key that distinguishes pytrees by the values of their arrays and by their other leaves.

    The result is None if a leaf cannot be hashed or is a tracer.
    """
    leaves, structure = jax.tree_util.tree_flatten(tree)
    try:
        leaf_keys = tuple(
            (leaf.shape, leaf.dtype, np.asarray(leaf).tobytes())
            if isinstance(leaf, jax.Array | np.ndarray | np.generic)
            else (type(leaf), leaf)
            for leaf in leaves
        )
        hash(key := (structure, leaf_keys))
    except (TypeError, jax.errors.JAXTypeError):  # an unhashable leaf, or a tracer
        return None
    return key
