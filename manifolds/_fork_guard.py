"""Raise an error in processes that were forked after JAX had run: XLA cannot compile there and would wait for ever."""

from __future__ import annotations

import os

import jax
from jax._src import xla_bridge

from .errors import ForkError

LOWERING_EVENT = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""Event that JAX reports just before XLA compiles a program."""

_forked_after_start = False
"""True in a process that was forked after JAX had started the threads of its backend, which an array does."""


def _refuse_compilation(event: str, duration_secs: float, **kwargs: str | int) -> None:
    del duration_secs, kwargs
    if event == LOWERING_EVENT and _forked_after_start:
        raise ForkError(
            "this process was forked after JAX had run, so XLA cannot compile in it. "
            'Start processes by multiprocessing.get_context("spawn")'
        )


def _mark_forked_child() -> None:
    global _forked_after_start
    _forked_after_start = _forked_after_start or xla_bridge.backends_are_initialized()


jax.monitoring.register_event_duration_secs_listener(_refuse_compilation)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_forked_child)
