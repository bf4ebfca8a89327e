"""Solutions and ensembles in NetCDF files, written atomically and verified by a checksum."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import sys
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from manifolds._class_members import ListedABCMeta
from manifolds.errors import warn

from .. import disk
from ..errors import FileError, InputError
from .status import Laws

if TYPE_CHECKING:
    import xarray

T = TypeVar("T")

SOLUTION_FORMAT = "liethermo-solution-2"
"""Format name in the file of a solution."""

FORMATS_WITHOUT_CHECKSUM = ("liethermo-solution-1",)
"""Older formats, which can be read but have no checksum."""

ENSEMBLE_FORMAT = "liethermo-ensemble-1"
"""Format name in the file of an ensemble."""

FILE_ATTRIBUTES = tuple(
    "format times status stats laws evidence provenance event_time engine wall_time reasons sha256".split()
)
"""Attributes that a file may have."""

CHECKSUM_TAG = b"\nliethermo sha256 "
"""Tag after the end of the NetCDF file, followed by the digest of all bytes before it."""


MAX_COMPRESSION_RATIO = 2_000
"""Largest ratio of the size of the content to the size of its file: equal numbers compress to almost nothing."""

LONG_NAMES = {
    "time": "time",
    "x": "state of the system, a component in each column",
    "energy": "energy",
    "entropy": "entropy",
    "x0": "state at the start",
    "attitude0": "element of the Lie group of the system at the start",
    "work": "work done on the system from outside",
    "status": "how the run ended, as a number",
    "status_text": "how the run ended",
    "attitude": "element of the Lie group of the system, real part and, where it has one, imaginary part",
    "quaternion": "unit quaternion of the attitude, scalar last",
    "nutation": "angle from the axis of greatest inertia to the angular momentum",
    "precession": "angle by which that axis has turned about the angular momentum in space",
    "spin": "angle by which the body has turned about that axis",
    "angular_velocity": "angular velocity of the body, in body axes",
    "rotor_rates": "rates of the rotors relative to the body",
    "joint_rates": "rates of the joint coordinates, in the order of the state",
    "invariant_name": "names of the recorded functions",
    "invariant": "Casimirs, momentum maps, preserved functions and what comes from outside",
}
"""Long name of each variable in a file."""

CONVENTIONS = {
    "attitude": "of SO(3): the matrix from body axes to axes in space, v_space = g v_body",
    "quaternion": "components (x, y, z, w), scalar last, Hamilton's product; maps body axes to axes in space",
    "angular_velocity": "components (x, y, z) in body axes, dH/dPi",
}
"""Convention of each variable that needs one, written as its attribute ``comment``."""

DEFAULT_UNITS = {"quaternion": "1", "nutation": "rad", "precession": "rad", "spin": "rad"}
"""Units of variables that do not depend on those of the system."""


def unit_of_variable(name: str, units: Mapping[str, str]) -> str | None:
    """Return the unit of a variable, from the units that a user gives by name; None if the unit is unknown."""
    if name in ("angular_velocity", "rotor_rates") and "time" in units:
        return units.get(name, f"rad/{units['time']}")
    return units.get(name, DEFAULT_UNITS.get(name))


def state_axis_names(n_axes: int) -> list[str]:
    """Return the names of the axes of a state with ``n_axes`` axes: those of its sites, then "component"."""
    sites = ["site"] if n_axes == 2 else [f"site_{i + 1}" for i in range(n_axes - 1)]
    return [*sites, "component"]


def build_dataset(
    variables: dict[str, Any],
    coordinates: dict[str, Any],
    attributes: dict[str, Any],
    laws: Laws,
    units: Mapping[str, str] | None,
) -> xarray.Dataset:
    """Return the dataset of a result, with a long name, a unit and a promised law for each variable, and a checksum."""
    import xarray

    dataset, units = xarray.Dataset(variables, coordinates, attributes), units or {}
    unknown_names = [name for name in units if name not in dataset.variables]
    if unknown_names:
        raise InputError(
            f"a result has no variable {unknown_names[0]!r}; it has {', '.join(map(str, dataset.variables))}"
        )
    laws_by_variable = {"energy": laws.energy, "entropy": laws.entropy}
    for name, variable in dataset.variables.items():
        variable_attributes = {
            "long_name": LONG_NAMES.get(str(name), str(name).replace("_", " ")),
            "units": unit_of_variable(str(name), units),
            "law": laws_by_variable.get(str(name)),
            "comment": CONVENTIONS.get(str(name)),
        }
        variable.attrs.update({key: text for key, text in variable_attributes.items() if text is not None})
    content = {str(name): values.to_numpy() for name, values in dataset.variables.items()}
    return dataset.assign_attrs(sha256=checksum(content, attributes))


class SaveableResult(metaclass=ListedABCMeta):
    """A result that can be saved to a file, which :func:`liethermo.load` reads."""

    @abstractmethod
    def to_xarray(self, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Return the result as a dataset whose variables have these units."""

    def save(self, path: str | os.PathLike, units: Mapping[str, str] | None = None) -> Path:
        """Write a NetCDF file, which :func:`load` reads; it is complete or does not appear at all.

        FileError if the file cannot be written, InputError if a name in ``units`` has no variable.

        Parameters
        ----------
        path : path
            The file to write.
        units : dict of str, optional
            Units by the name of a variable: see :meth:`to_xarray`.
        """
        return write_dataset(self.to_xarray(units), path)


def write_dataset(dataset: xarray.Dataset, path: str | os.PathLike) -> Path:
    """Write a NetCDF file; it is complete or does not appear at all.

    HDF5 writes it to memory, because it does not survive a full disk.
    """
    path = disk.checked_path(path)
    float_names = [name for name, v in dataset.variables.items() if v.dtype.kind == "f" and v.size]
    buffer = io.BytesIO()
    with _use_synchronous_dask():
        dataset.to_netcdf(buffer, engine="h5netcdf", encoding={name: {"fletcher32": True} for name in float_names})
    buffer.seek(0, io.SEEK_END)
    buffer.write(CHECKSUM_TAG + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())
    with disk.file_errors("write", path, "The result in memory is unchanged"):
        disk.write_atomically(path, buffer.getbuffer())
    disk.remove_abandoned_files(path.parent, path.name)
    return path


@contextlib.contextmanager
def _use_synchronous_dask() -> Iterator[None]:
    """Make xarray write without a Dask scheduler, because a Dask client may belong to a scheduler that has stopped."""
    if "dask" not in sys.modules:
        yield
        return
    import dask

    with dask.config.set(scheduler="synchronous"):
        yield


def read_variables_and_attributes(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the variables and the attributes of a file that :func:`write_dataset` wrote, after checking it.

    Raises
    ------
    FileError
        If the file is missing, cut short, damaged, or not a result of this library.

    Warns
    -----
    UserWarning
        If an earlier version wrote the file, without a checksum, so that damage might not be noticed.
    """
    path = disk.checked_path(path)
    with disk.file_errors("read", path):
        if not path.is_file():
            raise FileError(f"there is no file {path!s:.200}")
        _check_file_digest(path)
    try:
        series, attributes = _read_hdf5(path)
    except Exception as error:  # HDF5's readers raise a dozen kinds of errors for a broken file
        raise FileError(
            f"{path} cannot be read as NetCDF: it is cut short, damaged or of another format. {error}"
        ) from error
    if attributes.get("format") not in (SOLUTION_FORMAT, ENSEMBLE_FORMAT, *FORMATS_WITHOUT_CHECKSUM):
        raise FileError(
            f"{path} is not a liethermo result: the format of this NetCDF file is {attributes.get('format')!r}"
        )
    if attributes["format"] in FORMATS_WITHOUT_CHECKSUM:
        warn(f"{path} was written by an earlier version, without a checksum, so damage cannot be detected")
    elif attributes.get("sha256") != checksum(series, attributes):
        raise FileError(f"{path} is damaged: its content does not match its stored checksum")
    return series, attributes


def _check_file_digest(path: Path) -> None:
    """Raise FileError if the digest after the end of a file does not fit, before HDF5 opens it.

    A damaged file can keep the reader of HDF5 in an endless loop. A file without a digest is accepted, because
    programs that write to an HDF5 file may cut off the bytes after its end.
    """
    tag_length = len(CHECKSUM_TAG) + 2 * hashlib.sha256().digest_size
    content_length = path.stat().st_size - tag_length
    if content_length < 0:
        return
    with open(path, "rb") as file:
        file.seek(content_length)
        end = file.read()
    if end.startswith(CHECKSUM_TAG) and end != CHECKSUM_TAG + _sha256_of_prefix(path, content_length):
        raise FileError(f"{path} is damaged, or was changed: it does not have the checksum that it was written with")


def _sha256_of_prefix(path: Path, n_bytes: int) -> bytes:
    """Return the SHA-256 of the first ``n_bytes`` bytes of a file, in hexadecimal digits."""
    digest, n_remaining = hashlib.sha256(), n_bytes
    with open(path, "rb") as file:
        while n_remaining > 0:
            chunk = file.read(min(n_remaining, 2**20))
            if not chunk:
                break
            digest.update(chunk)
            n_remaining -= len(chunk)
    return digest.hexdigest().encode()


def _read_hdf5(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the variables of a file by name, and its attributes."""
    import h5py  # not through h5netcdf, which prints a traceback if it cannot open a file

    with h5py.File(path) as file:
        for name in file:  # before any link is followed
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{name!r} is a link to another place")
        variables = {name: v for name, v in file.items() if not _is_dimension_scale(v)}
        for name, v in variables.items():
            if not isinstance(v, h5py.Dataset) or v.is_virtual or v.external:
                raise ValueError(f"{name!r} is not an array of this file")
            if v.size * max(v.dtype.itemsize, 1) > MAX_COMPRESSION_RATIO * path.stat().st_size:
                raise ValueError(f"{name!r} claims to be larger than the file can hold")
        series = {
            name: np.array(v.asstr()[...] if h5py.check_string_dtype(v.dtype) else v[...])
            for name, v in variables.items()
        }
        attributes = {name: np.asarray(file.attrs[name]).item() for name in FILE_ATTRIBUTES if name in file.attrs}
        return series, attributes


def _is_dimension_scale(variable) -> bool:
    """Return whether a variable only stores the length of a dimension."""
    return bytes(variable.attrs.get("NAME", b"")).startswith(b"This is a netCDF dimension but not a netCDF variable")


def dataclass_from_json(cls: type[T], json_data: Any) -> T:
    """Return an object of the dataclass ``cls`` with the fields in JSON data; ValueError if the data do not fit."""
    import pydantic

    field_names = {field.name for field in fields(cls)}  # type: ignore[arg-type]
    if not isinstance(json_data, dict) or not field_names.issuperset(json_data):
        raise ValueError(f"its {cls.__name__.lower()} was not written by this version")
    try:
        return pydantic.TypeAdapter(cls).validate_python(json_data)
    except pydantic.ValidationError as error:
        first_error = error.errors()[0]
        location = ".".join(map(str, first_error["loc"]))
        raise ValueError(f"its {cls.__name__.lower()} cannot be used: {location} {first_error['msg']}") from None


def numeric_array_of_shape(
    variables: Mapping[str, np.ndarray], name: str, *shapes: tuple[int | None, ...]
) -> np.ndarray:
    """Return a numeric array among the variables of a file; ValueError unless it has one of the shapes.

    None in a shape stands for any length.
    """
    array = variables[name]
    matches = [
        len(s) == array.ndim and all(n in (None, m) for n, m in zip(s, array.shape, strict=True)) for s in shapes
    ]
    if array.dtype.kind not in "fiu" or not any(matches):
        raise ValueError(f"{name!r} is an array of {array.dtype}, shape {array.shape}, which does not fit the others")
    return array


def split_complex(matrices: np.ndarray) -> np.ndarray:
    """Return matrices with real and imaginary parts along a new last axis, because NetCDF has no complex numbers."""
    return np.stack([matrices.real, matrices.imag][: 1 + np.iscomplexobj(matrices)], axis=-1)


def join_complex(split_matrices: np.ndarray) -> np.ndarray:
    """Return the real or complex matrices of which :func:`split_complex` stored the parts along the last axis."""
    return (
        split_matrices[..., 0]
        if split_matrices.shape[-1] == 1
        else split_matrices[..., 0] + 1j * split_matrices[..., 1]
    )


def checksum(variables: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the names, types, shapes and bytes of all variables, and of the attributes."""
    digest = hashlib.sha256()
    for name in sorted(variables):
        values = np.asarray(variables[name])
        is_text = values.dtype.kind in "OUS"
        type_code = "text" if is_text or not values.size else values.dtype.newbyteorder("<").str
        digest.update(json.dumps([name, type_code, values.shape]).encode())
        digest.update(
            json.dumps(values.tolist()).encode()
            if type_code == "text"
            else values.astype(type_code, order="C").tobytes()
        )
    stored_attributes = [[name, str(attributes[name])] for name in FILE_ATTRIBUTES[:-1] if name in attributes]
    digest.update(json.dumps(stored_attributes).encode())
    return digest.hexdigest()
