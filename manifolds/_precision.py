"""The settings of JAX: 64-bit floating point, and those that this library runs under whatever its user debugs with."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, TypeVar, cast

import jax

from .errors import PrecisionError

jax.config.update("jax_enable_x64", True)  # before anything is traced

F = TypeVar("F", bound=Callable)

LIBRARY_SETTINGS = ("allow", "standard", False)
"""Rank promotion, dtype promotion and the search for infinities, as the code of this library has them."""

_saved_user_settings: ContextVar[tuple[Any, ...] | None] = ContextVar("asked", default=None)
"""What the user has them at, while code of this library runs."""


@contextlib.contextmanager
def library_settings() -> Iterator[None]:
    """Run code of this library: its ranks are promoted, and infinities in its searches are no faults.

    Raises
    ------
    PrecisionError
        If double precision has been switched off.
    """
    config: Any = jax.config
    if not config.jax_enable_x64:
        raise PrecisionError(
            "JAX computes in single precision, since jax_enable_x64 was switched off after the import: no law holds to "
            'rounding then. Switch it on again with jax.config.update("jax_enable_x64", True)'
        )
    asked = (config.jax_numpy_rank_promotion, config.jax_numpy_dtype_promotion, config.jax_debug_infs)
    if asked == LIBRARY_SETTINGS:
        yield
        return
    token = _saved_user_settings.set(asked)
    try:
        with _apply_settings(LIBRARY_SETTINGS):
            yield
    finally:
        _saved_user_settings.reset(token)


@contextlib.contextmanager
def user_settings() -> Iterator[None]:
    """Run a function of the user's as the user has JAX set."""
    asked = _saved_user_settings.get()
    if asked is None:
        yield
        return
    token = _saved_user_settings.set(None)
    try:
        with _apply_settings(asked):
            yield
    finally:
        _saved_user_settings.reset(token)


def with_library_settings(function: F) -> F:
    """A function that users call, run under :func:`library_settings`."""

    @functools.wraps(function)
    def called(*arguments, **named):
        with library_settings():
            return function(*arguments, **named)

    return cast("F", called)


@contextlib.contextmanager
def _apply_settings(values: tuple[Any, ...]) -> Iterator[None]:
    ranks, kinds, infinities = values
    with jax.numpy_rank_promotion(ranks), jax.numpy_dtype_promotion(kinds), jax.debug_infs(infinities):
        yield
