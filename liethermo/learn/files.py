"""Fitted systems in files of arrays and JSON: no code is kept, and none is run when one is read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._precision import with_library_settings

from ..errors import FileError
from ..systems import System
from .training import Training, read_archive, write_archive

T = TypeVar("T", bound=System)

MODEL_FORMAT = "liethermo-learned-1"

CURVE_FIELDS = ("step", "phase", "loss", "validation")

ESTIMATE_FIELDS = ("values", "standard_errors", "covariance", "noise")
"""Arrays of the record of a fit that files of older versions do not have."""

JSON_FIELDS = (
    *("parameters", "seconds", "ended", "names", "rank", "condition", "residual", "held_out", "gradient"),
    *("converged", "noise_is_estimated"),
)
"""Other parts of the record of a fit, in the JSON of its file."""


def _split_arrays(system: Any) -> tuple[list[Any], Any, Any]:
    dynamic, static = eqx.partition(system, eqx.is_array)
    leaves, structure = jax.tree_util.tree_flatten(dynamic)
    return leaves, structure, static


@with_library_settings
def save(system: System, path: str | os.PathLike) -> Path:
    """Write the numbers of a system, and the record of its fit, to a file that :func:`load` reads.

    The file has arrays and JSON: it appears whole or not at all, and holds no code.

    Parameters
    ----------
    system : System
    path : path

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    path, training = Path(path), getattr(system, "training", None)
    arrays = {f"leaf_{i}": np.asarray(leaf) for i, leaf in enumerate(_split_arrays(system)[0])}
    said: dict[str, Any] = {"format": MODEL_FORMAT, "kind": system.kind}
    if training is not None:
        arrays |= {name: getattr(training, name) for name in CURVE_FIELDS}
        arrays |= {name: getattr(training, name) for name in ESTIMATE_FIELDS}
        said["training"] = {name: getattr(training, name) for name in JSON_FIELDS}
    write_archive(path, said, arrays)
    return path


@with_library_settings
def load(path: str | os.PathLike, system: T) -> T:
    """A system that :func:`save` has written, with its numbers in one that is built as it was.

    Parameters
    ----------
    path : path
    system : System
        Made as the one that was fitted, such as by the same function: what it computes is not in the file. Its own
        numbers do not matter.

    Raises
    ------
    FileError
        If there is no such file, it is damaged, or it is of a system that is built otherwise.
    """
    said, arrays = read_archive(Path(path), MODEL_FORMAT)
    leaves, structure, static = _split_arrays(system)
    kept = [arrays.get(f"leaf_{i}", np.zeros(0, bool)) for i in range(sum(n.startswith("leaf_") for n in arrays))]
    shapes = [[(x.shape, x.dtype.kind) for x in these] for these in (kept, map(np.asarray, leaves))]
    if said.get("kind") != system.kind or shapes[0] != shapes[1]:
        raise FileError(
            f"{path!s:.200} holds a {said.get('kind')} with {len(kept)} arrays, and this {system.kind} with "
            f"{len(leaves)} is built otherwise: give load a system made as the one that was saved"
        )
    found = eqx.combine(jax.tree_util.tree_unflatten(structure, list(map(jnp.asarray, kept))), static)
    if not all(np.isfinite(x).all() for x in kept if x.dtype.kind == "f"):
        raise FileError(f"{path!s:.200} has numbers that are not finite: it is no system that was fitted")
    if "training" in said:
        try:
            curves = {name: arrays[name] for name in CURVE_FIELDS} | {
                n: arrays[n] for n in ESTIMATE_FIELDS if n in arrays
            }
            words = said["training"] | {"names": tuple(said["training"].get("names", ()))}
            training = Training(**curves, **words)  # type: ignore[arg-type]
        except (KeyError, TypeError) as error:
            raise FileError(f"{path!s:.200} has a record of its fit that is damaged ({error!s:.100})") from None
        object.__setattr__(found, "training", training)
    return found
