"""Compiler options for the programs of a fit."""

from __future__ import annotations

import os
from typing import Any


def fast_compile_options() -> dict[str, Any]:
    """Return options with which long programs of derivatives compile sooner and run about as fast.

    A level of optimisation that the user has set is respected.
    """
    if "optimization_level" in os.environ.get("XLA_FLAGS", ""):
        return {}
    return {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
