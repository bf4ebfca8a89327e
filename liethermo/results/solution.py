"""What a run returns: the trajectory, the record of its laws, how it ended, and where it came from."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FileError, InputError
from .audit import Audit, Tolerances, audit
from .evidence import Evidence

if TYPE_CHECKING:
    import xarray

    from ..runs.stepwise import Dense

FORMAT, WITHOUT_CHECKSUM = "liethermo-solution-2", ("liethermo-solution-1",)

VARIABLES = ("time", "x", "energy", "entropy", "attitude", "invariant_name", "invariant")
ATTRIBUTES = ("format", "times", "status", "stats", "laws", "evidence", "provenance", "event_time", "sha256")
"""What a file has."""

SEAL = b"\nliethermo sha256 "
"""What comes after the end of the NetCDF file, with the digest of all before it."""


@dataclass(frozen=True)
class Status:
    """How a run ended.

    Attributes
    ----------
    code : {"completed", "event", "not_converged", "non_finite", "step_underflow", "step_limit", "interrupted",
        "reference_failed"}
    message : str
        A full sentence: what happened, where, and what to try.
    step : int
        Steps taken; where ``ok`` is false the step after it is the one that failed.
    time : float
        Time reached.
    residual : float
        ``h |k - slopes(k)| / |x|`` of the last step tried.
    """

    code: str
    message: str
    step: int
    time: float
    residual: float = 0.0

    @property
    def ok(self) -> bool:
        return self.code in ("completed", "event")

    def __str__(self) -> str:
        return f"{self.code}: {self.message}"


@dataclass(frozen=True)
class Stats:
    """The work of a run and its extremes over *all* steps, saved or not.

    Attributes
    ----------
    steps, fixed_point_iterations, newton_iterations, most_iterations : int
        ``most_iterations`` is the largest number in one step.
    rejected : int
        Steps that were tried and were too long.
    worst_residual : float
        Largest ``h |k - slopes(k)| / |x|`` accepted.
    energy_range : (float, float)
        Smallest and largest energy met; less the work done from outside, where there is any.
    least_entropy_increment, largest_energy_increment : float
        Of one step. These three are None where no step was followed (no step taken, or ``Reference``).
    attitude_residual : float or None
        Largest distance from the group of the attitudes kept, relative to their size; None without a group.
    wall_time : float
        Seconds, compilation included.
    """

    steps: int = 0
    fixed_point_iterations: int = 0
    newton_iterations: int = 0
    rejected: int = 0
    most_iterations: int = 0
    worst_residual: float = 0.0
    energy_range: tuple[float, float] | None = None
    least_entropy_increment: float | None = None
    largest_energy_increment: float | None = None
    attitude_residual: float | None = None
    wall_time: float = 0.0

    @property
    def iterations_per_step(self) -> float:
        return (self.fixed_point_iterations + self.newton_iterations) / max(self.steps, 1)


@dataclass(frozen=True)
class Laws:
    """What the system promises: the law of the energy, of the entropy, and the functions it conserves.

    ``conserved`` names those that the method promises to keep to rounding, ``unpromised`` those that it does not: an
    audit shows how far these drift, without a verdict. ``ledger`` names those of the recorded functions that say what
    comes from outside, ``balance`` those of them that the energy of a solution contains and its law is stated without
    (``dH = work``), and ``inexact`` which of the two laws ("energy", "entropy") the method makes no claim to keep: an
    audit judges them all the same, and says so.
    """

    energy: str | None = "conserved"
    entropy: str | None = None
    conserved: tuple[str, ...] = ()
    ledger: tuple[str, ...] = ()
    inexact: tuple[str, ...] = ()
    balance: tuple[str, ...] = ()
    unpromised: tuple[str, ...] = ()


@dataclass(frozen=True)
class Solution:
    """A trajectory with its laws.

    Attributes
    ----------
    t : ndarray, shape (times,)
    x : ndarray, shape (times, n)
    energy : ndarray, shape (times,)
    entropy : ndarray, shape (times,), or None
    casimirs : dict of ndarray, shape (times,)
        Casimirs, momentum maps and preserved functions along the run, by name.
    status : Status
    stats : Stats
    laws : Laws
    provenance : dict
        Library version, method, step, system, date, spec: JSON data.
    event_time : float or None
        When the event of ``integrate(until=...)`` happened.
    dense : Dense or None
        The polynomials between the steps (``integrate(dense=True)``); not written to files.
    attitude : ndarray, shape (times, m, m), or None
        Elements of the group of the system, where it has one.
    evidence : Evidence
        What an audit needs besides the series: found when first asked for, and written to files.
    """

    t: np.ndarray
    x: np.ndarray
    energy: np.ndarray
    entropy: np.ndarray | None
    casimirs: dict[str, np.ndarray]
    status: Status
    stats: Stats
    laws: Laws
    provenance: dict[str, Any] = field(default_factory=dict)
    event_time: float | None = None
    dense: Dense | None = None
    attitude: np.ndarray | None = None
    witness: Callable[[], Evidence] | None = field(default=None, repr=False, compare=False)

    @functools.cached_property
    def evidence(self) -> Evidence:
        return Evidence() if self.witness is None else self.witness()

    def __getstate__(self) -> dict[str, Any]:  # a copy in another process knows the evidence, not how to find it
        return {**vars(self), "evidence": self.evidence, "witness": None}

    def __call__(self, t) -> np.ndarray:
        """States at any times, shape (..., n), from the collocation polynomials of the steps.

        Raises
        ------
        InputError
            Unless the run was made with ``dense=True`` and covers the times.
        """
        if self.dense is None:
            raise InputError("this solution has no dense output; ask for it with integrate(..., dense=True)")
        return self.dense(t)

    @property
    def energy_balance(self) -> np.ndarray:
        """The energy less the work done from outside, shape (times,): what the first law keeps of a driven system."""
        return self.energy - sum(self.casimirs[name] for name in self.laws.balance)

    def audit(self, **tolerances: float) -> Audit:
        """Whether the laws held and the steps resolve the motion, as a table.

        Some steps are taken again when this is first called, from at most 64 states of the run.

        Parameters
        ----------
        energy, entropy, casimirs, residual, attitude, accuracy, consistency : float
            What is accepted: see :class:`liethermo.results.audit.Tolerances`.

        Raises
        ------
        InputError
            If there is no tolerance of a name, or it is negative.
        """
        return audit(self, Tolerances.of(**tolerances))

    def with_provenance(self, **entries) -> Solution:
        """The same solution with more said about where it comes from."""
        return replace(self, provenance={**self.provenance, **entries})

    def to_xarray(self) -> xarray.Dataset:
        """An ``xarray.Dataset`` with coordinate ``time`` and all series; the rest as attributes (JSON)."""
        import xarray

        series = {"energy": ("time", self.energy)}
        if self.entropy is not None:
            series["entropy"] = ("time", self.entropy)
        variables: dict[str, Any] = {"x": (("time", "component"), self.x), **series}
        if self.attitude is not None:  # NetCDF has no complex numbers
            parts = np.stack([self.attitude.real, self.attitude.imag][: 1 + np.iscomplexobj(self.attitude)], axis=-1)
            variables["attitude"] = (("time", "row", "column", "part"), parts)
        variables["invariant"] = (
            ("invariant_name", "time"),
            np.array(list(self.casimirs.values())).reshape(len(self.casimirs), len(self.t)),
        )
        coordinates = {"time": self.t, "invariant_name": np.array(list(self.casimirs), dtype=object)}
        attributes = {
            "format": FORMAT,
            "times": len(self.t),
            "status": json.dumps(asdict(self.status)),
            "stats": json.dumps(asdict(self.stats)),
            "laws": json.dumps(asdict(self.laws)),
            "evidence": json.dumps(asdict(self.evidence)),
            "provenance": json.dumps(self.provenance),
            "event_time": json.dumps(self.event_time),
        }
        dataset = xarray.Dataset(variables, coordinates, attributes)
        content = {str(name): values.to_numpy() for name, values in dataset.variables.items()}
        return dataset.assign_attrs(sha256=_checksum(content, attributes))

    def save(self, path: str | os.PathLike) -> Path:
        """Write a NetCDF file; it appears whole or not at all."""
        path = Path(path)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            dataset = self.to_xarray()
            numbers = [name for name, v in dataset.variables.items() if v.dtype.kind == "f" and v.size]
            checked = {name: {"fletcher32": True} for name in numbers}
            dataset.to_netcdf(temporary, engine="h5netcdf", encoding=checked)
            _seal(temporary)
            os.replace(temporary, path)
        except OSError as error:
            raise FileError(f"cannot write {path}: {error}") from error
        finally:
            temporary.unlink(missing_ok=True)
        return path

    def __repr__(self) -> str:
        return f"Solution({len(self.t)} times to t = {self.status.time:g}, {self.status.code})"


_LISTS = ("conserved", "ledger", "inexact", "balance", "unpromised")
"""The fields of :class:`Laws` that are tuples of names."""


def load(path: str | os.PathLike) -> Solution:
    """Read a file written by :meth:`Solution.save`.

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
    if not path.is_file():
        raise FileError(f"there is no file {path}")
    _check_seal(path)
    try:
        series, attributes = _content(path)
    except Exception as error:  # the readers beneath raise a dozen kinds for a broken file
        raise FileError(
            f"{path} cannot be read as NetCDF: it is cut short, damaged or of another kind ({error})"
        ) from error
    if attributes.get("format") not in (FORMAT, *WITHOUT_CHECKSUM):
        raise FileError(
            f"{path} is a NetCDF file, but not a liethermo result (its format is {attributes.get('format')!r})"
        )
    if attributes["format"] in WITHOUT_CHECKSUM:
        warnings.warn(f"{path} has no checksum, as an earlier version wrote it: damage would not show", stacklevel=2)
    elif attributes.get("sha256") != _checksum(series, attributes):
        raise FileError(f"{path} is damaged: its content does not have the checksum that it was written with")
    try:
        stored = {name: json.loads(attributes[name]) for name in ("status", "stats", "laws", "provenance")}
        t, x = series["time"], series["x"]
        if len(t) != int(attributes["times"]):
            raise ValueError(f"{len(t)} times of {attributes['times']}")
        names = [str(name) for name in series["invariant_name"]]
        if stored["stats"]["energy_range"] is not None:
            stored["stats"]["energy_range"] = tuple(stored["stats"]["energy_range"])
        stored["laws"] |= {name: tuple(stored["laws"].get(name, ())) for name in _LISTS}
        evidence = Evidence(**json.loads(attributes.get("evidence", "{}")))
        return Solution(
            t=t,
            x=x,
            energy=series["energy"],
            entropy=series.get("entropy"),
            casimirs=dict(zip(names, series["invariant"], strict=True)),
            status=Status(**stored["status"]),
            stats=Stats(**stored["stats"]),
            laws=Laws(**stored["laws"]),
            provenance=stored["provenance"],
            event_time=json.loads(attributes.get("event_time", "null")),
            attitude=_attitude(series["attitude"]) if "attitude" in series else None,
            witness=lambda: evidence,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"{path} lacks a part of a liethermo result: {error}") from error


def _seal(path: Path) -> None:
    """Append the digest of a file to it; readers of HDF5 do not look beyond the end that its header states."""
    digest = _digest(path, path.stat().st_size)
    with open(path, "ab") as file:
        file.write(SEAL + digest)


def _check_seal(path: Path) -> None:
    """Before HDF5 sees the file: a damaged one can keep its reader in an endless loop.

    A file without a seal is let through: programs that write to an HDF5 file may cut off what follows its end.
    """
    length = len(SEAL) + 2 * hashlib.sha256().digest_size
    whole = path.stat().st_size - length
    if whole < 0:
        return
    with open(path, "rb") as file:
        file.seek(whole)
        end = file.read()
    if end.startswith(SEAL) and end != SEAL + _digest(path, whole):
        raise FileError(f"{path} is damaged, or was changed: it does not have the checksum that it was written with")


def _digest(path: Path, length: int) -> bytes:
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


def _content(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The variables of a file by name, and its attributes."""
    import h5py  # not through h5netcdf, which prints a traceback of its own for a file that it cannot open

    with h5py.File(path) as file:
        found = {name: file[name] for name in VARIABLES if name in file}
        series = {
            name: np.array(v.asstr()[...] if h5py.check_string_dtype(v.dtype) else v[...]) for name, v in found.items()
        }
        said = {name: np.asarray(file.attrs[name]).item() for name in ATTRIBUTES if name in file.attrs}
        return series, said


def _checksum(series: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> str:
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
    said = [[name, str(attributes[name])] for name in ATTRIBUTES[:-1] if name in attributes]
    found.update(json.dumps(said).encode())
    return found.hexdigest()


def _attitude(parts: np.ndarray) -> np.ndarray:
    return parts[..., 0] if parts.shape[-1] == 1 else parts[..., 0] + 1j * parts[..., 1]
