"""Solutions and ensembles in NetCDF files: written whole, sealed, and checked before they are read."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from manifolds.errors import warn

from .. import disk
from ..errors import FileError, InputError
from .status import Laws

if TYPE_CHECKING:
    import xarray

T = TypeVar("T")

SOLUTION_FORMAT, FORMATS_WITHOUT_CHECKSUM = "liethermo-solution-2", ("liethermo-solution-1",)
ENSEMBLE_FORMAT = "liethermo-ensemble-1"

FILE_ATTRIBUTES = tuple(
    "format times status stats laws evidence provenance event_time engine wall_time reasons sha256".split()
)
"""What a file may have."""

CHECKSUM_TAG = b"\nliethermo sha256 "
"""What comes after the end of the NetCDF file, with the digest of all before it."""


MAX_COMPRESSION_RATIO = 2_000
"""How many times as large as a file its content can be: numbers of one value alone take hardly any place."""

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
    "invariant_name": "names of the recorded functions",
    "invariant": "Casimirs, momentum maps, preserved functions and what comes from outside",
}


def state_axis_names(axes: int) -> list[str]:
    """The names of the axes of a state: those of its sites, if it has any, and its components."""
    sites = ["site"] if axes == 2 else [f"site_{i + 1}" for i in range(axes - 1)]
    return [*sites, "component"]


def build_dataset(
    variables: dict[str, Any],
    coordinates: dict[str, Any],
    attributes: dict[str, Any],
    laws: Laws,
    units: Mapping[str, str] | None,
) -> xarray.Dataset:
    """The dataset of a result: what each variable is, its unit, the law that is promised of it, and a checksum."""
    import xarray

    dataset, units = xarray.Dataset(variables, coordinates, attributes), units or {}
    unknown = [name for name in units if name not in dataset.variables]
    if unknown:
        raise InputError(f"a result has no variable {unknown[0]!r}; it has {', '.join(map(str, dataset.variables))}")
    promised = {"energy": laws.energy, "entropy": laws.entropy}
    for name, variable in dataset.variables.items():
        said = {
            "long_name": LONG_NAMES.get(str(name), str(name).replace("_", " ")),
            "units": units.get(str(name)),
            "law": promised.get(str(name)),
        }
        variable.attrs.update({key: text for key, text in said.items() if text is not None})
    content = {str(name): values.to_numpy() for name, values in dataset.variables.items()}
    return dataset.assign_attrs(sha256=checksum(content, attributes))


class SaveableResult(ABC):
    """What can be kept in a file, from which :func:`liethermo.load` brings it back."""

    @abstractmethod
    def to_xarray(self, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """The whole as a dataset, its variables with these units."""

    def save(self, path: str | os.PathLike, units: Mapping[str, str] | None = None) -> Path:
        """Write a NetCDF file, which :func:`load` reads; it appears whole or not at all.

        Parameters
        ----------
        path : path
        units : dict of str, optional
            Units by the name of a variable: see :meth:`to_xarray`.

        Raises
        ------
        FileError
            If the file cannot be written.
        InputError
            If there is no variable of a name in ``units``.
        """
        return write_dataset(self.to_xarray(units), path)


def write_dataset(dataset: xarray.Dataset, path: str | os.PathLike) -> Path:
    """Write a NetCDF file; it appears whole or not at all.

    HDF5 makes it in memory, since it does not survive a disk that is full.
    """
    path = Path(path)
    numbers = [name for name, v in dataset.variables.items() if v.dtype.kind == "f" and v.size]
    made = io.BytesIO()
    with _synchronous_dask():
        dataset.to_netcdf(made, engine="h5netcdf", encoding={name: {"fletcher32": True} for name in numbers})
    made.seek(0, io.SEEK_END)
    made.write(CHECKSUM_TAG + hashlib.sha256(made.getbuffer()).hexdigest().encode())
    try:
        disk.write_atomically(path, made.getbuffer())
    except (OSError, ValueError) as error:  # the latter for what is no path
        raise FileError(
            f"cannot write {path!s:.200}: {disk.describe_os_error(error)}. The result itself is as it was"
        ) from error
    disk.remove_dead_parts(path.parent, path.name)
    return path


@contextlib.contextmanager
def _synchronous_dask() -> Iterator[None]:
    """Let xarray ask no scheduler of Dask for a lock: where there is a client, it might be one that is gone."""
    if "dask" not in sys.modules:
        yield
        return
    import dask

    with dask.config.set(scheduler="synchronous"):
        yield


def read_dataset(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The variables and the attributes of a file that :func:`write` wrote, checked.

    Raises
    ------
    FileError
        If the file is missing, cut short, damaged, or not a result of this library.

    Warns
    -----
    UserWarning
        If an earlier version wrote the file, without a checksum: damage may show in nothing.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise FileError(f"there is no file {path!s:.200}")
        _check_file_digest(path)
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"cannot read {path!s:.200}: {disk.describe_os_error(error)}") from error
    try:
        series, attributes = _read_hdf5(path)
    except Exception as error:  # the readers beneath raise a dozen kinds for a broken file
        raise FileError(
            f"{path} cannot be read as NetCDF: it is cut short, damaged or of another kind ({error})"
        ) from error
    if attributes.get("format") not in (SOLUTION_FORMAT, ENSEMBLE_FORMAT, *FORMATS_WITHOUT_CHECKSUM):
        raise FileError(
            f"{path} is a NetCDF file, but not a liethermo result (its format is {attributes.get('format')!r})"
        )
    if attributes["format"] in FORMATS_WITHOUT_CHECKSUM:
        warn(f"{path} has no checksum, as an earlier version wrote it: damage would not show")
    elif attributes.get("sha256") != checksum(series, attributes):
        raise FileError(f"{path} is damaged: its content does not have the checksum that it was written with")
    return series, attributes


def _check_file_digest(path: Path) -> None:
    """Before HDF5 sees the file: a damaged one can keep its reader in an endless loop.

    A file without a seal is let through: programs that write to an HDF5 file may cut off what follows its end.
    """
    length = len(CHECKSUM_TAG) + 2 * hashlib.sha256().digest_size
    whole = path.stat().st_size - length
    if whole < 0:
        return
    with open(path, "rb") as file:
        file.seek(whole)
        end = file.read()
    if end.startswith(CHECKSUM_TAG) and end != CHECKSUM_TAG + _sha256_of_prefix(path, whole):
        raise FileError(f"{path} is damaged, or was changed: it does not have the checksum that it was written with")


def _sha256_of_prefix(path: Path, length: int) -> bytes:
    """SHA-256 of the beginning of a file, in hexadecimal digits."""
    found = hashlib.sha256()
    with open(path, "rb") as file:
        while length > 0:
            part = file.read(min(length, 2**20))
            if not part:
                break
            found.update(part)
            length -= len(part)
    return found.hexdigest().encode()


def _read_hdf5(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The variables of a file by name, and its attributes."""
    import h5py  # not through h5netcdf, which prints a traceback of its own for a file that it cannot open

    with h5py.File(path) as file:
        for name in file:  # before anything that they lead to is opened
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{name!r} is a link to another place")
        found = {name: v for name, v in file.items() if not _is_dimension_scale(v)}
        for name, v in found.items():
            if not isinstance(v, h5py.Dataset) or v.is_virtual or v.external:
                raise ValueError(f"{name!r} is not an array of this file")
            if v.size * max(v.dtype.itemsize, 1) > MAX_COMPRESSION_RATIO * path.stat().st_size:
                raise ValueError(f"{name!r} says that it is larger than the file can hold")
        series = {
            name: np.array(v.asstr()[...] if h5py.check_string_dtype(v.dtype) else v[...]) for name, v in found.items()
        }
        said = {name: np.asarray(file.attrs[name]).item() for name in FILE_ATTRIBUTES if name in file.attrs}
        return series, said


def _is_dimension_scale(variable) -> bool:
    """Whether a variable is but the length of a dimension."""
    return bytes(variable.attrs.get("NAME", b"")).startswith(b"This is a netCDF dimension but not a netCDF variable")


def dataclass_from_json(kind: type[T], stored: Any) -> T:
    """An object of a dataclass from the JSON data that it was written as; ValueError where that is something else."""
    import pydantic

    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    if not isinstance(stored, dict) or not known.issuperset(stored):
        raise ValueError(f"it has no {kind.__name__.lower()} as this version writes it")
    try:
        return pydantic.TypeAdapter(kind).validate_python(stored)
    except pydantic.ValidationError as error:
        fault = error.errors()[0]
        at = ".".join(map(str, fault["loc"]))
        raise ValueError(f"its {kind.__name__.lower()} cannot be used: {at} {fault['msg']}") from None


def array_of_shape(series: Mapping[str, np.ndarray], name: str, *shapes: tuple[int | None, ...]) -> np.ndarray:
    """An array of a file; ValueError unless it has numbers, in one of these shapes, where None stands for any size."""
    found = series[name]
    fits = [len(s) == found.ndim and all(n in (None, m) for n, m in zip(s, found.shape, strict=True)) for s in shapes]
    if found.dtype.kind not in "fiu" or not any(fits):
        raise ValueError(f"{name!r} is an array of {found.dtype}, shape {found.shape}, which does not fit the others")
    return found


def split_complex(values: np.ndarray) -> np.ndarray:
    """Matrices with real and imaginary parts along a last axis: NetCDF has no complex numbers."""
    return np.stack([values.real, values.imag][: 1 + np.iscomplexobj(values)], axis=-1)


def join_complex(parts: np.ndarray) -> np.ndarray:
    """The inverse of :func:`split_complex`."""
    return parts[..., 0] if parts.shape[-1] == 1 else parts[..., 0] + 1j * parts[..., 1]


def checksum(series: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> str:
    """SHA-256 of the names, types, shapes and bytes of all variables, and of the attributes."""
    found = hashlib.sha256()
    for name in sorted(series):
        values = np.asarray(series[name])
        text = values.dtype.kind in "OUS"
        kind = "text" if text or not values.size else values.dtype.newbyteorder("<").str
        found.update(json.dumps([name, kind, values.shape]).encode())
        found.update(
            json.dumps(values.tolist()).encode() if kind == "text" else values.astype(kind, order="C").tobytes()
        )
    said = [[name, str(attributes[name])] for name in FILE_ATTRIBUTES[:-1] if name in attributes]
    found.update(json.dumps(said).encode())
    return found.hexdigest()
