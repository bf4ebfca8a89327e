"""Detection of constant indices out of range in the functions of users, with the errors of this package."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr

import manifolds.errors
from manifolds import _index_check
from manifolds._jaxprs import PACKAGE_FOLDERS

from ..errors import IndexOutOfRangeError

PACKAGE_FOLDERS.add(Path(__file__).parents[1])


def check_indices(closed_jaxpr: ClosedJaxpr) -> None:
    """Raise IndexOutOfRangeError if a jaxpr has a constant index that is out of range."""
    try:
        _index_check.check_indices(closed_jaxpr)
    except manifolds.errors.IndexOutOfRangeError as error:
        raise IndexOutOfRangeError(error.index, error.size, error.where, access=error.access) from None


def check_indices_and_return_shapes(function: Callable, *arguments) -> Any:
    """Return the shapes of the results of a function, as ``jax.eval_shape`` does, after checking its indices."""
    closed_jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    check_indices(closed_jaxpr)
    return shapes
