"""Files of vector fields of OOMMF and mumax3, OVF 1.0 and 2.0, in text and binary."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...disk import checked_path
from ...errors import FileError, InputError
from ..conditions import checked_host_numbers

CHECK_VALUES = {4: 1234567.0, 8: 123456789012345.0}
"""First number of binary data, by its bytes, which shows the order of the bytes."""

HEADER_BYTES = 65_536
"""Bytes in which the header of a file must end."""


class VectorField(NamedTuple):
    """A field on a rectangular mesh.

    Attributes
    ----------
    values : array, shape (nx, ny, nz, components)
        Values in the cells, multiplied by the factor of the file.
    size : tuple of three floats
        Edges of a cell (metres, or the unit of the file).
    origin : tuple of three floats
        Middle of the first cell.
    title : str
        Title of the figure.
    unit : str
        Unit of the values.
    length_unit : str
        Unit of the axes.
    """

    values: np.ndarray
    size: tuple[float, float, float]
    origin: tuple[float, float, float]
    title: str = ""
    unit: str = ""
    length_unit: str = "m"


def read_ovf(path) -> VectorField:
    """Return the field of a file in OOMMF's vector field format, OVF 1.0 or 2.0, as mumax3 and OOMMF write it.

    Text and binary files with 4 and 8 bytes are read. The order of axes is x, y, z, as of the spins on a :func:`mesh`.

    Parameters
    ----------
    path : str or path
        The file to read.

    Returns
    -------
    VectorField

    Raises
    ------
    FileError
        If the file is not a rectangular OVF file, or is damaged.
    """
    path = checked_path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(f"{path} could not be read: {error}") from error
    version, header, kind, start = _parse_header(content, path)
    if header.get("meshtype", "rectangular").lower() != "rectangular":
        raise FileError(f"{path} has an irregular mesh. Only rectangular meshes are read")
    try:
        nodes = tuple(int(header[f"{axis}nodes"]) for axis in "xyz")
        size = float(header["xstepsize"]), float(header["ystepsize"]), float(header["zstepsize"])
        origin = float(header["xbase"]), float(header["ybase"]), float(header["zbase"])
        dim = int(header["valuedim"]) if version == 2 else 3
        factor = float(header.get("valuemultiplier", 1.0)) if version == 1 else 1.0
    except KeyError as error:
        raise FileError(f"{path} has no valid header: the entry {error} is missing") from error
    except ValueError as error:
        raise FileError(f"{path} has no valid header: {error}") from error
    if min(*nodes, dim) < 1:
        raise FileError(f"{path} must have positive numbers of cells and components, got {nodes} and {dim}")
    if not (min(size) > 0.0 and np.isfinite((*size, *origin, factor)).all()):
        raise FileError(
            f"{path} must have positive edges of cells and finite numbers in its header, got the edges {size}, the "
            f"origin {origin} and the multiplier {factor:g}"
        )
    count = math.prod(nodes) * dim
    data = _read_data(content, start, kind, version, count, path)
    values = factor * data.reshape(*nodes[::-1], dim).transpose(2, 1, 0, 3)
    unit = _first_list_entry(header.get("valueunits", "")) if version == 2 else header.get("valueunit", "")
    title, length_unit = header.get("title", ""), header.get("meshunit", "m")
    return VectorField(np.ascontiguousarray(values), size, origin, title, unit, length_unit)


def write_ovf(
    path,
    values,
    size,
    representation: str = "binary 8",
    version: int = 2,
    title: str = "m",
    unit: str = "1",
    origin=None,
) -> None:
    """Write a field to a file in OOMMF's vector field format, which OOMMF, mumax3 and Ubermag read.

    Parameters
    ----------
    path : str or path
        The file to write.
    values : array, shape (nx, ny, nz, components)
        Such as ``system.spins(x)``; three components for version 1.
    size : float, or tuple of three floats
        Edges of a cell (metres).
    representation : str
        "text", "binary 4" or "binary 8": numbers of 17 digits, or of 4 or 8 bytes.
    version : int
        1 or 2.
    title, unit : str
        The title, and the unit of the values.
    origin : tuple of three floats, optional
        Middle of the first cell; half a cell from the corner (0, 0, 0) by default.

    Raises
    ------
    InputError, FileError
    """
    array = checked_host_numbers(values, "values of an OVF file")
    edges = checked_host_numbers(size, "size")
    edges = np.broadcast_to(edges, (3,)) if edges.shape in ((), (3,)) else np.zeros(3)
    if version not in (1, 2):
        raise InputError(f"version must be 1 or 2, got {version!r}")
    if array.ndim != 4 or not array.size or (version == 1 and array.shape[3] != 3):
        components = "3" if version == 1 else "components"
        raise InputError(
            f"values of an OVF file of version {version} must have shape (nx, ny, nz, {components}), got {array.shape}"
        )
    if not ((edges > 0.0) & (edges < np.inf)).all():
        raise InputError(f"size must be one or three positive and finite edges of a cell, got {size}")
    kinds = {"text": "Text", "binary 4": "Binary 4", "binary 8": "Binary 8"}
    if representation not in kinds:
        raise InputError(f'representation must be "text", "binary 4" or "binary 8", got {representation!r}')
    base = edges / 2.0 if origin is None else checked_host_numbers(origin, "origin")
    if base.shape != (3,) or not np.isfinite(base).all():
        raise InputError(f"origin must be three finite numbers, got {origin}")
    for name, text in (("title", title), ("unit", unit)):
        if not isinstance(text, str) or "##" in text or len(text.splitlines()) > 1 or text != text.strip():
            raise InputError(
                f"{name} must be a single line without '##', which begins a comment, and without spaces at its ends, "
                f"got {text!r}"
            )
    if "{" in unit or "}" in unit:
        raise InputError(f"unit must not have braces, got {unit!r}")
    lines = _header_lines(array, edges, base, version, title, unit)
    kind = kinds[representation]
    flat = array.transpose(2, 1, 0, 3).reshape(-1, array.shape[3])
    if kind == "Text":
        body = "".join(" ".join(f"{v:.17g}" for v in row) + "\n" for row in flat.tolist()).encode()
    else:
        width = int(kind[-1])
        dtype = np.dtype(f"{'<' if version == 2 else '>'}f{width}")
        if np.abs(flat[np.isfinite(flat)]).max(initial=0.0) > np.finfo(dtype).max:
            raise InputError(f'values must be at most {np.finfo(dtype).max:.3g} in 4 bytes. Use "binary 8"')
        body = np.concatenate([[CHECK_VALUES[width]], flat.ravel()]).astype(dtype).tobytes() + b"\n"
    head = "".join(f"# {line}\n" for line in [*lines, f"Begin: Data {kind}"])
    tail = f"# End: Data {kind}\n# End: Segment\n"
    path = checked_path(path)
    try:
        path.write_bytes(head.encode() + body + tail.encode())
    except OSError as error:
        raise FileError(f"{path} could not be written: {error}") from error


def _header_lines(array: np.ndarray, edges, base, version: int, title: str, unit: str) -> list[str]:
    """Return the lines of the header of an OVF file, without the leading ``# ``."""
    nodes, dim = array.shape[:3], array.shape[3]
    first_line = "OOMMF OVF 2.0" if version == 2 else "OOMMF: rectangular mesh v1.0"
    lines = [first_line, "Segment count: 1", "Begin: Segment", "Begin: Header", f"Title: {title}"]
    lines += ["meshtype: rectangular", "meshunit: m"]
    min_corner, max_corner = base - edges / 2.0, base + (np.array(nodes) - 0.5) * edges
    for axis, a, b, c, e, n in zip("xyz", min_corner, max_corner, base, edges, nodes, strict=True):
        lines += [f"{axis}min: {a:.17g}", f"{axis}max: {b:.17g}", f"{axis}base: {c:.17g}"]
        lines += [f"{axis}nodes: {n}", f"{axis}stepsize: {e:.17g}"]
    if version == 2:
        labels = " ".join(f"m_{axis}" for axis in ("xyz" if dim == 3 else map(str, range(dim))))
        lines += [
            f"valuedim: {dim}",
            f"valuelabels: {labels}",
            "valueunits: " + " ".join([_list_entry(unit or "1")] * dim),
        ]
    else:
        lengths = np.linalg.norm(array, axis=-1)
        lines += [f"valueunit: {unit or 1}", "valuemultiplier: 1"]
        lines += [f"ValueRangeMinMag: {lengths.min():.17g}", f"ValueRangeMaxMag: {lengths.max():.17g}"]
    return [*lines, "End: Header"]


def _list_entry(text: str) -> str:
    """Return a text as an entry of a Tcl list, in braces if it has spaces."""
    return f"{{{text}}}" if " " in text else text


def _first_list_entry(text: str) -> str:
    """Return the first entry of a Tcl list, without its braces."""
    if text.startswith("{") and "}" in text:
        return text[1 : text.index("}")]
    return text.split(" ")[0]


def _parse_header(content: bytes, path: Path) -> tuple[int, dict[str, str], str, int]:
    """Return the version, the entries of the header, the kind of the data, and where they begin."""
    header: dict[str, str] = {}
    position, version = 0, 0
    while position < min(len(content), HEADER_BYTES):
        end = content.find(b"\n", position)
        end = len(content) if end < 0 else end
        line = _decode_line(content[position:end]).strip()
        position = end + 1
        if not version:
            version = _version_of_line(line, path)
            continue
        text = line.lstrip("#").split("##")[0].strip()
        key, _, value = text.partition(":")
        key = key.strip().lower().replace(" ", "")
        if key == "begin" and value.strip().lower().startswith("data"):
            return version, header, " ".join(value.lower().split()[1:]), position
        header.setdefault(key, value.strip())
    raise FileError(f"{path} has no data: the line '# Begin: Data' is missing")


def _decode_line(line: bytes) -> str:
    """Return a line of a header as text, from UTF-8, or from Latin-1 if it is no UTF-8."""
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _version_of_line(line: str, path: Path) -> int:
    """Return the OVF version, 1 or 2, that the first line of a file names; raise FileError for another line."""
    text = line.lstrip("# ").lower()
    if text.startswith("oommf"):
        if text.endswith("2.0"):
            return 2
        if "v1.0" in text or text.endswith("1.0") or "v0.99" in text:
            return 1
    raise FileError(f"{path} is not an OVF file of version 1.0 or 2.0: its first line is {line[:60]!r}")


def _read_data(content: bytes, data_start: int, data_kind: str, version: int, n_numbers: int, path: Path) -> np.ndarray:
    """Return ``n_numbers`` numbers from the data of an OVF file, from ``data_start`` on; raise FileError if damaged."""
    if data_kind == "text":
        end = content.find(b"#", data_start)
        words = content[data_start : end if end >= 0 else len(content)].split()
        try:
            numbers = np.array(words, dtype=float)
        except ValueError as error:
            raise FileError(f"{path} has data that are not numbers: {error}") from error
        if len(numbers) != n_numbers:
            cause = "The file is not complete" if len(numbers) < n_numbers else "Its header does not fit its data"
            raise FileError(f"{path} must have {n_numbers} numbers, got {len(numbers)}. {cause}")
        return numbers
    if data_kind not in ("binary 4", "binary 8"):
        raise FileError(f"{path} has data of the kind {data_kind!r}. Text, binary 4 and binary 8 are read")
    width = int(data_kind[-1])
    if len(content) < data_start + width * (n_numbers + 1):
        raise FileError(f"{path} must have {n_numbers} numbers of {width} bytes, got fewer. The file is not complete")
    following_text = content[data_start + width * (n_numbers + 1) :].lstrip()
    if following_text and not following_text.startswith(b"#"):
        raise FileError(
            f"{path} has more data than the {n_numbers} numbers of {width} bytes of its header. Its header does "
            "not fit its data"
        )
    for order in "<>" if version == 2 else "><":
        numbers = np.frombuffer(content, dtype=np.dtype(f"{order}f{width}"), count=n_numbers + 1, offset=data_start)
        if numbers[0] == CHECK_VALUES[width]:
            return numbers[1:].astype(float)
    raise FileError(f"{path} is damaged: its data do not begin with the number {CHECK_VALUES[width]:.0f}")
