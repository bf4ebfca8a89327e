"""How the programs of a fit are compiled."""

from __future__ import annotations

import os
from typing import Any


def fast_compile_options() -> dict[str, Any]:
    """Options for programs that derivatives make long: they compile sooner, and run about as fast.

    Where the user has chosen a level of optimisation, that is taken.
    """
    if "optimization_level" in os.environ.get("XLA_FLAGS", ""):
        return {}
    return {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
