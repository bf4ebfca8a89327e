"""Reading of results, and histories of attitudes as CSV files, with the units in the names of the columns."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..disk import checked_path
from ..errors import FileError, InputError
from ..systems.rotations import rotation_matrices
from ..units import parse_unit, split_label
from .audit_evidence import AuditableResult
from .ensemble import Ensemble
from .netcdf import ENSEMBLE_FORMAT, read_variables_and_attributes
from .orientation import angular_velocity, euler_angles, quaternions
from .solution import Solution

QUATERNION_COLUMNS = ("q_x", "q_y", "q_z", "q_w")
"""Names of the columns of quaternions; a file may have them in any order."""

RATE_COLUMNS = tuple(f"omega_{axis}" for axis in "xyz")
"""Names of the columns of the angular velocity in body axes, before their unit."""

NORM_TOLERANCE = 1e-3
"""Largest difference from 1 of the norm of a quaternion in a file: numbers with three digits are normalised."""


class AttitudeHistory(NamedTuple):
    """Attitudes of a body, and angular velocities if they are known, at several times.

    Attributes
    ----------
    t : ndarray, shape (times,)
        Times (s).
    attitude : ndarray, shape (times, 3, 3)
        Rotation matrices from body axes to axes in space; each is an ``attitude=`` of a run.
    angular_velocity : ndarray, shape (times, 3), or None
        Omega in body axes (rad/s), if the file has it.
    """

    t: np.ndarray
    attitude: np.ndarray
    angular_velocity: np.ndarray | None

    @property
    def rotation(self) -> Rotation:
        """The attitudes as a ``scipy.spatial.transform.Rotation``, one for each time."""
        return Rotation.from_matrix(self.attitude)


def write_csv(
    path: str | os.PathLike,
    solution: AuditableResult,
    degrees: bool = False,
    scalar: Literal["last", "first"] = "last",
    euler: str | None = None,
) -> Path:
    """Write the attitudes and angular velocities of a run as a CSV file, which :func:`read_csv` reads back.

    The first line names the columns: ``t [s]``, ``q_x, q_y, q_z, q_w`` of the unit quaternions from body to space, and
    ``omega_x [rad/s]`` and so on in body axes. With ``euler="ZYX"`` the last columns are the Euler angles
    ``euler_ZYX_1 [rad]`` to ``euler_ZYX_3 [rad]``. Numbers are written so that they are read back to the bit.

    Parameters
    ----------
    path : path
        The file to write.
    solution : Solution
        A result of a body with attitudes in SO(3), with the second as its unit of time.
    degrees : bool
        If true, angular velocities are in deg/s, and Euler angles in degrees.
    scalar : {"last", "first"}
        Place of the column ``q_w``.
    euler : str, optional
        Sequence of Euler angles that are written too, as for :func:`euler_angles`. :func:`read_csv` does not need them.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        If the result has no attitudes or is an ensemble, or the sequence is not of three letters.
    FileError
        If the file cannot be written.
    """
    q = quaternions(solution, scalar)
    if q.shape != (*np.shape(solution.t), 4):
        raise InputError("a file has one history. Write each trajectory of an ensemble, write_csv(path, e[i])")
    quaternion_names = QUATERNION_COLUMNS if scalar == "last" else np.roll(QUATERNION_COLUMNS, 1).tolist()
    names, columns = ["t [s]", *quaternion_names], [np.asarray(solution.t)[:, None], q]
    if "angular_velocity" in solution.velocity_sources:
        unit = "deg/s" if degrees else "rad/s"
        names += [f"{name} [{unit}]" for name in RATE_COLUMNS]
        columns.append(angular_velocity(solution, degrees=degrees))
    if euler is not None:
        columns.append(euler_angles(solution, euler, degrees))
        names += [f"euler_{euler}_{i} [{'deg' if degrees else 'rad'}]" for i in (1, 2, 3)]
    path = checked_path(path)
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(names)
            writer.writerows([repr(number) for number in row] for row in np.concatenate(columns, axis=1).tolist())
    except OSError as error:
        raise FileError(f"{path} could not be written: {error}") from error
    return path


def read_csv(path: str | os.PathLike) -> AttitudeHistory:
    """Read attitudes and angular velocities from a CSV file with named columns.

    The columns are found by their names, in any order: ``t``, ``q_x, q_y, q_z, q_w``, and as far as there are any
    ``omega_x, omega_y, omega_z``. Their units follow in brackets, such as ms, deg/s or rpm; without one they are s and
    rad/s. Other columns are left out. Quaternions are normalised.

    Parameters
    ----------
    path : path
        The file to read.

    Returns
    -------
    AttitudeHistory

    Raises
    ------
    FileError
        If the file cannot be read, a column is missing or there twice, or its numbers are not finite or no attitudes.
    """
    path = checked_path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = [row for row in csv.reader(file) if row]
        values = np.array([[float(entry) for entry in row] for row in rows], dtype=float)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path} could not be read: {error}") from error
    except ValueError as error:
        raise FileError(f"{path} is not a table of numbers with a line of names: {error}") from error
    if values.ndim != 2 or values.shape[1] != len(header):
        raise FileError(f"{path} must have {len(header)} numbers in each line after the names, and at least one line")
    columns = [split_label(name) for name in header]
    names = [name for name, _ in columns]
    missing_columns = [name for name in ("t", *QUATERNION_COLUMNS) if name not in names]
    rate_names = [name for name in RATE_COLUMNS if name in names]
    if rate_names:
        missing_columns += [name for name in RATE_COLUMNS if name not in names]
    if missing_columns:
        raise FileError(f"{path} has no column {missing_columns[0]!r}; its columns are {', '.join(header)}")
    for name in ("t", *QUATERNION_COLUMNS, *rate_names):
        if names.count(name) > 1:
            raise FileError(f"{path} has {names.count(name)} columns {name!r}, so which one counts is not known")
    for name in ("t", *rate_names):  # the norm of a quaternion shows its entries that are not finite
        if not (is_finite := np.isfinite(values[:, names.index(name)])).all():
            line = int(np.argmin(is_finite)) + 2
            raise FileError(f"{path} has a number in the column {name!r}, line {line}, that is not finite")
    units = dict(columns)
    for name in QUATERNION_COLUMNS:
        if units[name] not in ("", "1"):
            raise FileError(f"{path} has {name} in {units[name]!r}, but components of a quaternion have no unit")
    time_factor = _factor_to_si(path, "times", units["t"], "s")
    q = values[:, [names.index(name) for name in QUATERNION_COLUMNS]]
    norms = np.linalg.norm(q, axis=1)
    if not (np.abs(norms - 1.0) <= NORM_TOLERANCE).all():
        worst_row = int(np.argmax(np.nan_to_num(np.abs(norms - 1.0), nan=np.inf)))
        raise FileError(f"{path} has a quaternion of norm {norms[worst_row]:.6g} in line {worst_row + 2}; it must be 1")
    attitude = rotation_matrices(Rotation.from_quat(q))
    rates = None
    if rate_names:
        factors = [_factor_to_si(path, "angular velocities", units[name], "rad/s") for name in RATE_COLUMNS]
        rates = values[:, [names.index(name) for name in RATE_COLUMNS]] * np.array(factors)
    return AttitudeHistory(time_factor * values[:, names.index("t")], np.asarray(attitude), rates)


def _factor_to_si(path: Path, quantity: str, unit_name: str, si_unit: str) -> float:
    """Return the factor that converts a unit in a file to the SI unit of the quantity; 1 without a unit.

    Raises
    ------
    FileError
        If the unit is not known, or belongs to another quantity.
    """
    try:
        unit = parse_unit(unit_name or si_unit)
    except InputError as error:
        raise FileError(f"{path} has {quantity} in {unit_name!r}: {error}") from None
    if unit.dimension != parse_unit(si_unit).dimension:
        raise FileError(
            f"{path} has {quantity} in {unit_name!r}, a unit of another kind. Convert the column to {si_unit}"
        )
    return unit.factor


def load(path: str | os.PathLike) -> Solution | Ensemble:
    """Read a file written by :meth:`Solution.save` or :meth:`Ensemble.save`.

    Parameters
    ----------
    path : str or path
        The NetCDF file.

    Returns
    -------
    Solution or Ensemble
        The result that was saved.

    Raises
    ------
    FileError
        If the file is missing, cut short, damaged, or not a result of this library.

    Warns
    -----
    UserWarning
        If an earlier version wrote the file, without a checksum, so damage cannot be detected.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> solution = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 5.0), 0.1)
    >>> path = solution.save("run.nc")
    >>> bool((lt.load("run.nc").x == solution.x).all())
    True
    """
    series, attributes = read_variables_and_attributes(path)
    try:
        if attributes["format"] == ENSEMBLE_FORMAT:
            return Ensemble.from_file(series, attributes)
        return Solution.from_file(series, attributes)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise FileError(f"{path} lacks a part of a liethermo result: {error}") from error
