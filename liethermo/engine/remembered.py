"""Results kept for the objects they were found for: systems and methods never change."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

Found = TypeVar("Found")

KEPT = 128
"""Results of one function that are held in memory, the latest ones."""


def remembered(function: Callable[..., Found]) -> Callable[..., Found]:
    """Decorator: call a function of pytrees once for the same objects; they are told apart by identity.

    Objects with leaves that could change in place, as NumPy arrays can, or that are being traced, are not remembered.
    """
    known: dict[tuple[int, ...], tuple[tuple, Found]] = {}

    @functools.wraps(function)
    def call(*arguments) -> Found:
        key = tuple(map(id, arguments))
        if key in known:
            return known[key][1]
        found = function(*arguments)
        if not any(isinstance(leaf, np.ndarray | jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(arguments)):
            while len(known) >= KEPT:
                del known[next(iter(known))]
            known[key] = arguments, found  # held on to, so that no other object takes its identity
        return found

    return call


def fingerprint(tree: Any) -> Any:
    """A key that tells pytrees apart by the values of arrays and the identity of the rest; None where there is none."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    try:
        parts = tuple(
            (leaf.shape, np.asarray(leaf).tobytes()) if isinstance(leaf, jax.Array | np.ndarray | np.generic) else leaf
            for leaf in leaves
        )
        hash(key := (structure, parts))
    except (TypeError, jax.errors.JAXTypeError):  # something unhashable, or traced
        return None
    return key
