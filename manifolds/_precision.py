"""Settings of JAX: 64-bit floating point, and the settings that the library's code runs under whatever the user has
set."""

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
"""Rank promotion, dtype promotion and ``debug_infs`` while library code runs.

The library relies on rank promotion, and its searches may produce infinities.
"""

_saved_user_settings: ContextVar[tuple[Any, ...] | None] = ContextVar("asked", default=None)
"""Settings of the user, in the order of LIBRARY_SETTINGS, while library code runs; None otherwise."""


@contextlib.contextmanager
def library_settings() -> Iterator[None]:
    """Run the library code in a ``with`` block under LIBRARY_SETTINGS.

    Raises
    ------
    PrecisionError
        If double precision has been switched off.
    """
    user_values = _checked_settings()
    if user_values == LIBRARY_SETTINGS:
        yield
        return
    token = _saved_user_settings.set(user_values)
    try:
        with _temporary_settings(LIBRARY_SETTINGS):
            yield
    finally:
        _saved_user_settings.reset(token)


def _checked_settings() -> tuple[Any, ...]:
    """Return the settings in force, in the order of LIBRARY_SETTINGS.

    Raises
    ------
    PrecisionError
        If double precision has been switched off.
    """
    config: Any = jax.config
    if not config.jax_enable_x64:
        raise PrecisionError(
            "JAX must compute in double precision, but jax_enable_x64 was switched off after the import. "
            'Switch it on again with jax.config.update("jax_enable_x64", True)'
        )
    return config.jax_numpy_rank_promotion, config.jax_numpy_dtype_promotion, config.jax_debug_infs


@contextlib.contextmanager
def user_settings() -> Iterator[None]:
    """Restore the user's settings in a ``with`` block, in which a function of the user runs."""
    user_values = _saved_user_settings.get()
    if user_values is None:
        yield
        return
    token = _saved_user_settings.set(None)
    try:
        with _temporary_settings(user_values):
            yield
    finally:
        _saved_user_settings.reset(token)


def with_library_settings(function: F) -> F:
    """Decorate a public function so that it runs under :func:`library_settings`."""

    @functools.wraps(function)
    def call_with_settings(*args, **kwargs):
        if _checked_settings() == LIBRARY_SETTINGS:  # the usual case, without the cost of a context manager
            return function(*args, **kwargs)
        with library_settings():
            return function(*args, **kwargs)

    return cast("F", call_with_settings)


@contextlib.contextmanager
def _temporary_settings(settings: tuple[Any, ...]) -> Iterator[None]:
    """Set the JAX settings, in the order of LIBRARY_SETTINGS, inside a ``with`` block."""
    rank_promotion, dtype_promotion, debug_infs = settings
    with (
        jax.numpy_rank_promotion(rank_promotion),
        jax.numpy_dtype_promotion(dtype_promotion),
        jax.debug_infs(debug_infs),
    ):
        yield
