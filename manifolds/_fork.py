"""Processes that are forked after JAX has run: they cannot compile, and raise an error instead of waiting for ever."""

from __future__ import annotations

import os

import jax

from .errors import ForkError

COMPILED = "/jax/core/compile/backend_compile_duration"
"""What JAX says when XLA has compiled a program."""

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""What it says just before XLA does."""

_ran, _forked = False, False


def _watch(event: str, duration_secs: float, **kwargs: str | int) -> None:
    global _ran
    del duration_secs, kwargs
    if event == LOWERED and _forked:
        raise ForkError(
            "this process was forked after JAX had run, and XLA cannot compile here: it would wait for threads that the"
            ' fork has left behind. Start processes by multiprocessing.get_context("spawn")'
        )
    _ran = _ran or event == COMPILED


def _in_child() -> None:
    global _forked
    _forked = _forked or _ran


jax.monitoring.register_event_duration_secs_listener(_watch)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
