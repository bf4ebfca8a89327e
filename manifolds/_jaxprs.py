"""Reading of jaxprs: primitives that call one, array operations by their parameters, and lines of the user's code."""

from __future__ import annotations

from pathlib import Path

import numpy as np

CALL_PRIMITIVES = frozenset(
    "jit pjit call closed_call core_call custom_jvp_call custom_vjp_call checkpoint remat remat2".split()
)
"""Primitives that call a jaxpr."""

UNKNOWN_ORIGIN = "of unknown origin"
"""Source line of an equation that JAX does not trace back to the user's code."""

LIBRARY_FOLDERS = {Path(__file__).parent}
"""Folders with code that is not the user's, beside those of JAX and equinox; a package on top of this one adds its
own."""


def user_source_line(eqn) -> str:
    """Return the innermost line of the user's code that led to an equation."""
    for frame in getattr(eqn.source_info.traceback, "frames", ()):
        path = Path(frame.file_name)
        if is_user_file(path):
            return f"{path.name}:{frame.line_num}, in {frame.function_name}"
    return UNKNOWN_ORIGIN


def is_user_file(path: Path) -> bool:
    """Return whether a file is the user's, and not part of a library, JAX or equinox."""
    return not {"jax", "jaxlib", "equinox"} & set(path.parts) and not any(map(path.is_relative_to, LIBRARY_FOLDERS))


def broadcast(x, params):
    """Return an array broadcast by the parameters of ``broadcast_in_dim``."""
    expanded_shape = np.ones(len(params["shape"]), int)
    expanded_shape[list(params["broadcast_dimensions"])] = x.shape
    return np.broadcast_to(x.reshape(expanded_shape), params["shape"])


def reshape(x, params):
    """Return an array reshaped by the parameters of ``reshape``."""
    return (x if params["dimensions"] is None else x.transpose(params["dimensions"])).reshape(params["new_sizes"])
