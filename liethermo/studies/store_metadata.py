"""What a store says of itself, checked before it is believed: it may come from anywhere, or be damaged."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from manifolds.errors import warn

from ..results.files import dataclass_from_json
from ..results.status import Laws
from .axes import MAX_POINTS, is_valid_name
from .files import ZarrArray
from .solve import LAW_QUANTITIES

CHECKSUM_ATTRIBUTE = "sha256"
"""The attribute of the group with the digest of all its other metadata."""

MAX_CHUNKS = 10**7
"""The most that a store has: each is a file in each array."""

REQUIRED_ARRAY_DTYPES = {"status": ("int8",), "message": ("string",), "laws": ("float64",), "quantity": ("string",)}
"""Types of the arrays of every store."""


def with_checksum(group: dict[str, Any]) -> dict[str, Any]:
    """The metadata of a group with their digest among the attributes."""
    attributes = {name: value for name, value in group["attributes"].items() if name != CHECKSUM_ATTRIBUTE}
    group = {**group, "attributes": attributes}
    digest = hashlib.sha256(json.dumps(group, sort_keys=True).encode()).hexdigest()
    return {**group, "attributes": {**attributes, CHECKSUM_ATTRIBUTE: digest}}


def read_group(root: Path, group: dict[str, Any]) -> tuple[dict[str, ZarrArray], dict[str, Any]]:
    """The arrays and the attributes of a group, from its metadata.

    Raises
    ------
    ValueError, KeyError, TypeError, AttributeError
        If it has not what a study writes.

    Warns
    -----
    UserWarning
        If an earlier version wrote the metadata, without a checksum.
    """
    attributes = group["attributes"]
    if CHECKSUM_ATTRIBUTE not in attributes:
        warn(f"{root} has no checksum of its metadata, as an earlier version made it: damage to them would not show")
    elif attributes[CHECKSUM_ATTRIBUTE] != with_checksum(group)["attributes"][CHECKSUM_ATTRIBUTE]:
        raise ValueError("its metadata do not have the checksum that they were written with")
    arrays = {}
    for name, said in group["consolidated_metadata"]["metadata"].items():
        arrays[name] = ZarrArray.from_metadata(name, said)
        if arrays[name].metadata() != said:  # its codecs and fill values, which other readers go by
            raise ValueError(f"the array {name!r} is none that a study writes")
    _require_arrays(arrays, attributes)
    _require_study(attributes, arrays["status"].shape)
    return arrays, attributes


def _require_arrays(arrays: Mapping[str, ZarrArray], attributes: Mapping[str, Any]) -> None:
    """It has the arrays that a study writes, and no others."""
    measures, axes = attributes["measures"], attributes["axes"]
    if not isinstance(measures, list):
        raise ValueError("its measures are not listed")
    columns = [name for axis in axes.values() for name in axis]
    for name in (*measures, *axes, *columns):
        if not is_valid_name(name):
            raise ValueError(f"nothing in it can be called {name!r:.120}")
    if both := {*measures} & {*axes, *columns}:
        raise ValueError(f"{both.pop()!r} is a measure and an axis")
    states = {f"{name}_state" for name in axes} & set(arrays)
    expected = {*measures, *axes, *columns, *states, *REQUIRED_ARRAY_DTYPES}
    if set(arrays) != expected:
        raise ValueError(f"it has the arrays {sorted(arrays)}, and should have {sorted(expected)}")
    status = arrays["status"]
    chunks = math.prod(-(-m // c) for m, c in zip(status.shape, status.chunks, strict=True))
    if len(status.shape) != len(axes) or math.prod(status.shape) > MAX_POINTS or chunks > MAX_CHUNKS:
        raise ValueError(f"no study has points in shape {status.shape} and chunks {status.chunks}")
    for name in (*measures, "laws", "message", "status"):
        array, more = arrays[name], arrays[name].shape[len(axes) :]
        along = list(array.dims[: len(axes)])
        if array.shape != status.shape + more or array.chunks != status.chunks + more or along != list(axes):
            raise ValueError(f"{name!r} has shape {array.shape} in chunks {array.chunks} along {array.dims}")
        if array.dtype not in REQUIRED_ARRAY_DTYPES.get(name, ("float64", "complex128")):
            raise ValueError(f"{name!r} is of type {array.dtype}")
    if arrays["quantity"].shape != (len(LAW_QUANTITIES),) or arrays["laws"].shape[len(axes) :] != (
        len(LAW_QUANTITIES),
    ):
        raise ValueError("what is known of the laws is not what this version keeps")
    for (name, along), length in zip(axes.items(), status.shape, strict=True):
        for own in (name, *along, *({f"{name}_state"} & states)):
            if arrays[own].shape[:1] != (length,) or arrays[own].dims[:1] != (name,):
                raise ValueError(f"{own!r} has {arrays[own].shape} values, and its axis {length}")


def _require_study(attributes: Mapping[str, Any], shape: tuple[int, ...]) -> None:
    """It says what study it is of."""
    dataclass_from_json(Laws, attributes["laws"])
    study = attributes["study"]
    if list(study["measures"]) != attributes["measures"]:
        raise ValueError("its measures are not those of its study")
    numbers = [study[name] for name in ("motion", "energy", "x0")]
    numbers += [study["values"][name] for name in study["measures"]]
    for listed in (*numbers, study["versions"], study["operations"]):
        if not isinstance(listed, list | dict | str):
            raise ValueError(f"its study cannot have the values {listed!r:.60}")
    for listed in numbers:
        np.asarray(listed, dtype=np.float64)
    place = study["place"]
    inside = [type(i) is int and 0 <= i < n for i, n in zip(place, shape, strict=True)]
    if not all(inside):
        raise ValueError(f"its example is at {place!r:.60}")
