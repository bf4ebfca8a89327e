"""Save and load fitted systems as arrays and JSON; the files contain no code."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._precision import with_library_settings

from ..disk import checked_path
from ..errors import FileError
from ..systems import System
from .training import Training, read_archive, write_archive

T = TypeVar("T", bound=System)

MODEL_FORMAT = "liethermo-learned-1"
"""Name of the file format of fitted systems."""

CURVE_FIELDS = ("step", "phase", "loss", "validation")
"""Arrays of the record of a fit, in every file."""

ESTIMATE_FIELDS = ("values", "standard_errors", "covariance", "noise", "initial_states")
"""Arrays of the record of a fit that files of older versions do not have."""

JSON_FIELDS = (
    *("parameters", "seconds", "ended", "names", "rank", "condition", "residual", "held_out", "gradient"),
    *("converged", "noise_is_estimated", "degrees_of_freedom", "is_positive"),
)
"""Other fields of the record of a fit, stored in the JSON of the file."""


def _flatten_array_leaves(system: Any) -> tuple[list[Any], Any, Any]:
    """Return the array leaves of a system, the tree structure of these, and the system with None in their place."""
    dynamic, static = eqx.partition(system, eqx.is_array)
    leaves, structure = jax.tree_util.tree_flatten(dynamic)
    return leaves, structure, static


@with_library_settings
def save(system: System, path: str | os.PathLike) -> Path:
    """Save the arrays of a system, and the record of its fit, to a file that :func:`load` reads.

    The file contains arrays and JSON, and no code. It is written atomically.

    Parameters
    ----------
    system : System
        The system whose parameters are saved.
    path : path
        The file to write.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    path, training = checked_path(path), getattr(system, "training", None)
    arrays = {f"leaf_{i}": np.asarray(leaf) for i, leaf in enumerate(_flatten_array_leaves(system)[0])}
    metadata: dict[str, Any] = {"format": MODEL_FORMAT, "kind": system.kind}
    if training is not None:
        arrays |= {name: getattr(training, name) for name in CURVE_FIELDS}
        arrays |= {name: getattr(training, name) for name in ESTIMATE_FIELDS}
        metadata["training"] = {name: getattr(training, name) for name in JSON_FIELDS}
    write_archive(path, metadata, arrays)
    return path


@with_library_settings
def load(path: str | os.PathLike, system: T) -> T:
    """Load fitted arrays into a system built like the one that :func:`save` wrote.

    Parameters
    ----------
    path : path
        The file to read.
    system : System
        A system built like the one that was fitted, such as by the same function, because the file holds arrays only.
        Its own arrays do not matter.

    Raises
    ------
    FileError
        If there is no such file, it is damaged, or it holds a system of another structure.
    """
    metadata, arrays = read_archive(checked_path(path), MODEL_FORMAT)
    leaves, structure, static = _flatten_array_leaves(system)
    saved_leaves = [
        arrays.get(f"leaf_{i}", np.zeros(0, bool)) for i in range(sum(n.startswith("leaf_") for n in arrays))
    ]
    shapes = [
        [(x.shape, x.dtype.kind) for x in arrays_of_tree] for arrays_of_tree in (saved_leaves, map(np.asarray, leaves))
    ]
    if metadata.get("kind") != system.kind or shapes[0] != shapes[1]:
        raise FileError(
            f"{path!s:.200} holds a {metadata.get('kind')} with {len(saved_leaves)} arrays, which does not match the "
            f"number and shapes of the {len(leaves)} of this {system.kind}. Pass a system built like the saved one"
        )
    loaded_system = eqx.combine(jax.tree_util.tree_unflatten(structure, list(map(jnp.asarray, saved_leaves))), static)
    if not all(np.isfinite(x).all() for x in saved_leaves if x.dtype.kind == "f"):
        raise FileError(f"{path!s:.200} has numbers that are not finite, so it holds no fitted system")
    if "training" in metadata:
        try:
            curves = {name: arrays[name] for name in CURVE_FIELDS} | {
                n: arrays[n] for n in ESTIMATE_FIELDS if n in arrays
            }
            sequences = {name: tuple(metadata["training"].get(name, ())) for name in ("names", "is_positive")}
            training_fields = metadata["training"] | sequences
            training = Training(**curves, **training_fields)  # type: ignore[arg-type]
        except (KeyError, TypeError) as error:
            raise FileError(f"{path!s:.200} has a record of its fit that is damaged ({error!s:.100})") from None
        object.__setattr__(loaded_system, "training", training)
    return loaded_system
