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

Found = TypeVar("Found")

KEPT = 64
"""Results of one function that are held in memory, those last used."""

BYTES = 2**28
"""Largest size of the arrays that they were found for, together."""

COMPARED = 2**20
"""Largest size of arrays that are compared by content: comparing larger ones takes longer than a call should."""


class Latest(Generic[Found]):
    """Results by their keys, those last used.

    Parameters
    ----------
    kept : int
        How many.
    size : int, optional
        Of all together.
    """

    def __init__(self, kept: int, size: float = float("inf")):
        self.kept, self.size = kept, size
        self._found: OrderedDict[Hashable, tuple[Found, int]] = OrderedDict()
        self._total, self._lock = 0, threading.Lock()

    def __len__(self) -> int:
        return len(self._found)

    def get(self, key: Hashable) -> Found | None:
        """What is known by a key, or None."""
        with self._lock:
            if key not in self._found:
                return None
            self._found.move_to_end(key)
            return self._found[key][0]

    def find(self, key: Hashable, make: Callable[[], Found], size: int = 0) -> Found:
        """What is known by a key; made, and kept, where nothing is."""
        with self._lock:
            if key in self._found:
                self._found.move_to_end(key)
                return self._found[key][0]
        found = make()
        with self._lock:
            if key not in self._found:
                self._total += size
            self._found[key] = found, size
            while len(self._found) > self.kept or (self._total > self.size and len(self._found) > 1):
                self._total -= self._found.popitem(last=False)[1][1]
        return found


def remembered(function: Callable[..., Found]) -> Callable[..., Found]:
    """Decorator: call a function of pytrees once for the same objects, or for others of the same content.

    Objects with leaves that could change in place, as NumPy arrays can, or that are being traced, are not remembered.
    """
    known: Latest[tuple[tuple, Found]] = Latest(KEPT, BYTES)
    alike: Latest[Found] = Latest(KEPT, BYTES)

    def by_content(arguments: tuple, size: int) -> Found:
        content = fingerprint(arguments) if size <= COMPARED else None
        make = functools.partial(function, *arguments)
        return make() if content is None else alike.find(content, make, size)

    @functools.wraps(function)
    def call(*arguments) -> Found:
        found = known.get(identities := tuple(map(id, arguments)))
        if found is not None:
            return found[1]
        leaves = jax.tree_util.tree_leaves(arguments)
        if any(isinstance(leaf, np.ndarray | jax.core.Tracer) for leaf in leaves):
            return function(*arguments)
        size = sum(leaf.nbytes for leaf in leaves if eqx.is_array(leaf))
        # the arguments are held on to, so that no other object takes their identity
        return known.find(identities, lambda: (arguments, by_content(arguments, size)), size)[1]

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
