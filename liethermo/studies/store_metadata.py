"""Validation of the metadata of a store, which may be foreign or damaged."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from manifolds.errors import warn

from ..results.netcdf import dataclass_from_json
from ..results.status import Laws
from .axes import MAX_POINTS, is_valid_name
from .files import ZarrArray
from .solve import LAW_QUANTITIES

CHECKSUM_ATTRIBUTE = "sha256"
"""Attribute of the group with the SHA-256 digest of all other metadata."""

MAX_CHUNKS = 10**7
"""Maximum number of chunks of a store; each chunk is a file in each array."""

REQUIRED_ARRAY_DTYPES = {"status": ("int8",), "message": ("string",), "laws": ("float64",), "quantity": ("string",)}
"""Allowed data types of the arrays that every store contains."""


def with_checksum(group_metadata: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata of a group with their digest among the attributes."""
    attributes = {name: value for name, value in group_metadata["attributes"].items() if name != CHECKSUM_ATTRIBUTE}
    group_metadata = {**group_metadata, "attributes": attributes}
    digest = hashlib.sha256(json.dumps(group_metadata, sort_keys=True).encode()).hexdigest()
    return {**group_metadata, "attributes": {**attributes, CHECKSUM_ATTRIBUTE: digest}}


def parse_group_metadata(root: Path, group_metadata: dict[str, Any]) -> tuple[dict[str, ZarrArray], dict[str, Any]]:
    """Return the arrays and the attributes of a group, from its metadata.

    Raises
    ------
    ValueError, KeyError, TypeError, AttributeError
        If a study cannot have written the metadata.

    Warns
    -----
    UserWarning
        If an earlier version wrote the metadata, without a checksum.
    """
    attributes = group_metadata["attributes"]
    if CHECKSUM_ATTRIBUTE not in attributes:
        warn(f"{root} has no checksum of its metadata, as an earlier version made it: damage to them would not show")
    elif attributes[CHECKSUM_ATTRIBUTE] != with_checksum(group_metadata)["attributes"][CHECKSUM_ATTRIBUTE]:
        raise ValueError("its metadata do not have the checksum that they were written with")
    arrays = {}
    for name, array_metadata in group_metadata["consolidated_metadata"]["metadata"].items():
        arrays[name] = ZarrArray.from_metadata(name, array_metadata)
        if arrays[name].metadata() != array_metadata:  # other readers use its codecs and fill values
            raise ValueError(f"the array {name!r} is none that a study writes")
    _require_arrays(arrays, attributes)
    _require_study(attributes, arrays["status"].shape)
    return arrays, attributes


def _require_arrays(arrays: Mapping[str, ZarrArray], attributes: Mapping[str, Any]) -> None:
    """Raise ValueError unless the store has exactly the arrays that a study writes, with matching shapes."""
    measures, axes = attributes["measures"], attributes["axes"]
    if not isinstance(measures, list):
        raise ValueError("its measures are not listed")
    columns = [name for axis in axes.values() for name in axis]
    for name in (*measures, *axes, *columns):
        if not is_valid_name(name):
            raise ValueError(f"nothing in it can be called {name!r:.120}")
    if shared_names := {*measures} & {*axes, *columns}:
        raise ValueError(f"{shared_names.pop()!r} is a measure and an axis")
    states = {f"{name}_state" for name in axes} & set(arrays)
    expected_names = {*measures, *axes, *columns, *states, *REQUIRED_ARRAY_DTYPES}
    if set(arrays) != expected_names:
        raise ValueError(f"it has the arrays {sorted(arrays)}, and should have {sorted(expected_names)}")
    status = arrays["status"]
    chunks = math.prod(-(-m // c) for m, c in zip(status.shape, status.chunks, strict=True))
    if len(status.shape) != len(axes) or math.prod(status.shape) > MAX_POINTS or chunks > MAX_CHUNKS:
        raise ValueError(f"no study has points in shape {status.shape} and chunks {status.chunks}")
    for name in (*measures, "laws", "message", "status"):
        array, trailing_shape = arrays[name], arrays[name].shape[len(axes) :]
        axis_dims = list(array.dims[: len(axes)])
        if (
            array.shape != status.shape + trailing_shape
            or array.chunks != status.chunks + trailing_shape
            or axis_dims != list(axes)
        ):
            raise ValueError(f"{name!r} has shape {array.shape} in chunks {array.chunks} along {array.dims}")
        if array.dtype not in REQUIRED_ARRAY_DTYPES.get(name, ("float64", "complex128")):
            raise ValueError(f"{name!r} is of type {array.dtype}")
    if arrays["quantity"].shape != (len(LAW_QUANTITIES),) or arrays["laws"].shape[len(axes) :] != (
        len(LAW_QUANTITIES),
    ):
        raise ValueError("what is known of the laws is not what this version keeps")
    for (name, axis_dims), length in zip(axes.items(), status.shape, strict=True):
        for array_name in (name, *axis_dims, *({f"{name}_state"} & states)):
            if arrays[array_name].shape[:1] != (length,) or arrays[array_name].dims[:1] != (name,):
                raise ValueError(f"{array_name!r} has {arrays[array_name].shape} values, and its axis {length}")


def _require_study(attributes: Mapping[str, Any], shape: tuple[int, ...]) -> None:
    """Raise ValueError unless the attributes describe a study, with an example inside the axes."""
    dataclass_from_json(Laws, attributes["laws"])
    study = attributes["study"]
    if list(study["measures"]) != attributes["measures"]:
        raise ValueError("its measures are not those of its study")
    numbers = [study[name] for name in ("motion", "energy", "x0")]
    numbers += [study["values"][name] for name in study["measures"]]
    for entry in (*numbers, study["versions"], study["operations"]):
        if not isinstance(entry, list | dict | str):
            raise ValueError(f"its study cannot have the values {entry!r:.60}")
    for entry in numbers:
        np.asarray(entry, dtype=np.float64)
    example_index = study["place"]
    is_inside = [type(i) is int and 0 <= i < n for i, n in zip(example_index, shape, strict=True)]
    if not all(is_inside):
        raise ValueError(f"its example is at {example_index!r:.60}")
