"""Raise an error in processes that were forked after JAX had run: XLA cannot compile there and would wait for ever."""

from __future__ import annotations

import os

import jax

from .errors import ForkError

BACKEND_COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
"""Event that JAX reports when XLA has compiled a program."""

LOWERING_EVENT = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""Event that JAX reports just before XLA compiles a program."""

_has_compiled, _forked_after_compile = False, False


def _track_compilation(event: str, duration_secs: float, **kwargs: str | int) -> None:
    global _has_compiled
    del duration_secs, kwargs
    if event == LOWERING_EVENT and _forked_after_compile:
        raise ForkError(
            "this process was forked after JAX had run, so XLA cannot compile in it. "
            'Start processes by multiprocessing.get_context("spawn")'
        )
    _has_compiled = _has_compiled or event == BACKEND_COMPILE_EVENT


def _mark_forked_child() -> None:
    global _forked_after_compile
    _forked_after_compile = _forked_after_compile or _has_compiled


jax.monitoring.register_event_duration_secs_listener(_track_compilation)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_forked_child)
