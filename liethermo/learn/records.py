"""Read trajectories from tables: CSV files, DataFrames, datasets of xarray, and arrays with names."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from manifolds._class_members import ListedABCMeta

from ..errors import FileError, InputError
from ..units import TIME, parse_unit, split_label

TIME_NAMES = ("t", "time", "times", "timestamp", "seconds_elapsed")
"""Names of a column of times that need not be given, in lower case."""

SEPARATORS = (",", ";", "\t")
"""Separators of the columns of a file that are recognised."""


class Trajectory(NamedTuple):
    """Times, shape (m,), and the observations at these times, shape (m, ...)."""

    t: np.ndarray
    x: np.ndarray

    @property
    def flat_trajectory(self) -> Trajectory:
        """The trajectory with each observation as a row of numbers, shape (m, k)."""
        return Trajectory(self.t, self.x.reshape(len(self.t), -1))


@dataclass(frozen=True)
class Records(Sequence[Trajectory], metaclass=ListedABCMeta):
    """Trajectories from a table, with the names of its columns; :func:`read_data` returns them.

    A fit takes the columns by the names in the result of ``observe``, or all of them in order.

    Attributes
    ----------
    names : tuple of str
        Names of the k columns, without their units.
    trajectories : tuple of Trajectory
        Times, shape (m,), and values, shape (m, k), of each trajectory in SI units; NaN where a value is missing.
    """

    names: tuple[str, ...]
    trajectories: tuple[Trajectory, ...]

    def __len__(self) -> int:
        return len(self.trajectories)

    def __getitem__(self, i: Any) -> Any:
        return self.trajectories[i]

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    def __str__(self) -> str:
        n_rows = sum(len(t) for t, _ in self.trajectories)
        start, end = min(t[0] for t, _ in self.trajectories), max(t[-1] for t, _ in self.trajectories)
        n_missing = sum(int(np.isnan(x).sum()) for _, x in self.trajectories)
        missing_text = f", {n_missing} values missing" if n_missing else ""
        plural = "y" if len(self) == 1 else "ies"
        return (
            f"{', '.join(self.names)}: {n_rows} rows in {len(self)} trajector{plural}, times {start:.4g} to {end:.4g}"
            f"{missing_text}"
        )

    def select(self, names: Sequence[str]) -> Records:
        """Return records that have only the named columns, in this order.

        Raises
        ------
        InputError
            If there is no column of this name.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"the data have no column {name!r}; their columns are {', '.join(self.names)}")
        indices = [self.names.index(name) for name in names]
        return Records(tuple(names), tuple(Trajectory(t, x[:, indices]) for t, x in self.trajectories))


def read_data(
    source: Any,
    columns: Sequence[str] | None = None,
    *,
    time: str | None = None,
    trajectory: str | None = None,
    units: Mapping[str, str] | None = None,
) -> Records:
    """Read trajectories from a table: a CSV file, a DataFrame, a dataset of xarray, or arrays with names.

    Columns are found by name. A label such as ``gx [deg/s]`` or ``gx (deg/s)`` is a name with a unit, and an attribute
    ``units`` in xarray is a unit too. Values with a unit are converted to SI units, in which angles are in radians;
    values without a unit are not changed. Missing values, empty in a file or NaN, stay missing.

    Parameters
    ----------
    source : path, pandas.DataFrame, xarray.Dataset, xarray.DataArray, structured array, or dict of arrays
        The table. In xarray the dimension of the time is called ``time``, or it is the first one of a variable after
        that of the trajectories. A further dimension becomes columns ``x[0]``, ``x[1]`` and so on.
    columns : sequence of str, optional
        Names of the columns to read, in order; by default all except the times and the numbers of the trajectories.
    time : str, optional
        Name of the column, index or coordinate of times: numbers, or dates, which count in seconds from the first one.
        By default it is called ``t``, ``time`` or ``timestamp``.
    trajectory : str, optional
        Name of a column that numbers several trajectories, or of a dimension. By default there is one trajectory.
    units : dict from names to units, optional
        Units of columns, such as ``{"time": "ms", "gx": "deg/s"}``, which replace those in the labels. An empty
        string says that a column has no unit.

    Returns
    -------
    Records

    Raises
    ------
    FileError
        If a file cannot be read.
    InputError
        If a column or a unit is not known, times do not grow, or a column has no values.

    Examples
    --------
    >>> table = {"time [ms]": [0.0, 10.0, 25.0], "angle [deg]": [0.0, 90.0, 180.0]}
    >>> data = lt.learn.read_data(table)
    >>> data.names, data[0].t
    (('angle',), array([0.   , 0.01 , 0.025]))
    """
    table = _read_all_columns(source, trajectory, time)
    labels = _Labels(list(table), units or {})
    time_label = labels.find_time_label(time)
    group_label = None if trajectory is None else labels.find_label(trajectory, "trajectory=")
    if columns is None:
        value_labels = [label for label in table if label not in (time_label, group_label)]
    elif isinstance(columns, str) or not all(isinstance(name, str) for name in columns):
        raise InputError(f"columns must be a list of names, got {columns!r}")
    else:
        value_labels = [labels.find_label(name, "columns=") for name in columns]
    if not value_labels:
        raise InputError(f"the data have no columns besides the times {labels.names[time_label]!r}")
    unread_names = [
        name for name in labels.units if labels.find_label(name, "units=") not in {time_label, *value_labels}
    ]
    if unread_names:
        raise InputError(
            f"units has {unread_names[0]!r}, but this column is not read. Remove it, or add it to columns="
        )
    t = _times_in_seconds(table[time_label], labels, time_label)
    x = np.stack([_value_column(table[label], labels, label) for label in value_labels], axis=1)
    groups = np.zeros(len(t)) if group_label is None else np.asarray(table[group_label])
    names = tuple(labels.names[label] for label in value_labels)
    trajectories = []
    for group in dict.fromkeys(groups.tolist()):
        rows = groups == group
        trajectory_name = "the data" if group_label is None else f"trajectory {group}"
        trajectories.append(_checked_table_trajectory(trajectory_name, t[rows], x[rows], names, group_label is None))
    return Records(names, tuple(trajectories))


def is_readable_table(data: Any) -> bool:
    """Return True if data are a table with names, which :func:`read_data` reads."""
    return (
        isinstance(data, str | os.PathLike | Mapping)
        or _is_instance_of(data, "pandas", "DataFrame")
        or _is_instance_of(data, "xarray", "Dataset", "DataArray")
        or (isinstance(data, np.ndarray) and data.dtype.names is not None)
    )


def _is_instance_of(value: Any, module: str, *classes: str) -> bool:
    """Return True if a value is an instance of a class of a module, without importing that module."""
    return module in sys.modules and isinstance(value, tuple(vars(sys.modules[module])[name] for name in classes))


# -- names and units ------------------------------------------------------------------------------------------------


class _Labels:
    """The labels of the columns of a table, their names, and the units that a user gives for some of them."""

    def __init__(self, labels: list[str], units: Mapping[str, str]):
        self.names = {label: split_label(label)[0] for label in labels}
        self.units = dict(units)

    def find_label(self, name_or_label: str, argument_name: str) -> str:
        """Return the label of the column with a name; a label with a unit is returned unchanged.

        Raises
        ------
        InputError
        """
        if name_or_label in self.names:
            return name_or_label
        matches = [label for label, short_name in self.names.items() if short_name == name_or_label]
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise InputError(
                f"several columns are called {name_or_label!r}. Give {argument_name} the whole label, {matches[0]!r}"
            )
        raise InputError(f"the data have no column {name_or_label!r}; their columns are {', '.join(self.names)}")

    def find_time_label(self, time: str | None) -> str:
        """Return the label of the column of times, given by its name, or found if ``time`` is None."""
        if time is not None:
            return self.find_label(time, "time=")
        matches = [label for label, name in self.names.items() if name.lower() in TIME_NAMES]
        if len(matches) != 1:
            problem = (
                f"the columns {', '.join(matches)} may all be times" if matches else "the data have no column 'time'"
            )
            raise InputError(
                f"{problem}; their columns are {', '.join(self.names)}. Name the column of the times, such as "
                f"lt.learn.read_data(data, time={(matches or list(self.names))[0]!r})"
            )
        return matches[0]

    def unit_text(self, label: str) -> str:
        """Return the unit of a column as text: the user's, or the one in the label."""
        for name in (label, self.names[label]):
            if name in self.units:
                return self.units[name]
        return split_label(label)[1]

    def column_unit(self, label: str):
        """Return the :class:`.Unit` of a column.

        Raises
        ------
        InputError
        """
        text = self.unit_text(label)
        if not isinstance(text, str):
            raise InputError(f"a unit must be a name such as 'deg/s', got {text!r} for {self.names[label]!r}")
        try:
            return parse_unit(text)
        except InputError as error:
            name = self.names[label]
            raise InputError(f"column {label!r}: {error}. Set it with units={{{name!r}: ...}}, '' for none") from None


def _times_in_seconds(values: np.ndarray, labels: _Labels, label: str) -> np.ndarray:
    """Convert a column of times to seconds; dates count from the first one.

    Raises
    ------
    InputError
        If a date is missing or dates have a unit, the unit is none of time, or values are not numbers.
    """
    if values.dtype.kind in "OUS" and not all(map(_converts_to_float, values)):
        with contextlib.suppress(TypeError, ValueError):
            values = values.astype("datetime64[ns]")
    if values.dtype.kind in "mM":  # dates and durations
        if labels.unit_text(label):
            raise InputError(f"the times {labels.names[label]!r} are dates, which have no unit. Leave it out of units=")
        if np.isnat(values).any():
            raise InputError(f"the times {labels.names[label]!r} have missing values. Remove these rows")
        return (values - values[0]) / np.timedelta64(1, "ns") * 1e-9
    unit = labels.column_unit(label)
    if unit.dimension not in (TIME, ()):
        raise InputError(
            f"the times {labels.names[label]!r} are in {labels.unit_text(label)!r}. Give a unit of time, as 's'"
        )
    return unit.to_si(_to_floats(values, label))


def _value_column(values: np.ndarray, labels: _Labels, label: str) -> np.ndarray:
    """Convert a column of observations to SI units; raise InputError if it has no values or some are not numbers."""
    column = labels.column_unit(label).to_si(_to_floats(values, label))
    if np.isnan(column).all():
        raise InputError(f"column {labels.names[label]!r} has no values, only missing ones. Remove it with columns=")
    return column


def _to_floats(values: np.ndarray, label: str) -> np.ndarray:
    """Convert a column to floats; raise InputError, with the label of the column, if a value is not a number."""
    try:
        if values.dtype.kind not in "biufO":
            raise TypeError
        return values.astype(np.float64)
    except (TypeError, ValueError):
        first_invalid_value = next((value for value in values.tolist() if not _converts_to_float(value)), values[0])
        raise InputError(
            f"column {label!r} must have numbers, got {first_invalid_value!r:.60}. "
            "Name the columns to read with columns="
        ) from None


def _converts_to_float(value: Any) -> bool:
    """Return True if ``float(value)`` succeeds."""
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _checked_table_trajectory(
    trajectory_name: str, t: np.ndarray, x: np.ndarray, names: Sequence[str], is_only_trajectory: bool
) -> Trajectory:
    """Return a trajectory made of the rows of a table that have values, after checking them.

    Raises
    ------
    InputError
        If times are missing, do not grow, or are fewer than two.
    """
    if not np.isfinite(t).all():
        row = int(np.flatnonzero(~np.isfinite(t))[0])
        raise InputError(f"{trajectory_name}: time {row} is {t[row]}. Remove the rows without a time")
    has_value = ~np.isnan(x).all(axis=1)
    t, x = t[has_value], x[has_value]
    if len(t) < 2:
        raise InputError(
            f"{trajectory_name}: {len(t)} row{'s' if len(t) != 1 else ''} with values, at least 2 are needed for a fit"
        )
    i = int(np.argmax(np.diff(t) <= 0.0))
    if t[i + 1] == t[i]:
        raise InputError(f"{trajectory_name}: time {t[i]:.6g} occurs twice. Keep one of these rows, or their mean")
    if t[i + 1] < t[i]:
        advice = (
            "Sort the rows by time; if they are several trajectories, name the column that numbers them with "
            "trajectory="
            if is_only_trajectory
            else "Sort the rows by time"
        )
        raise InputError(
            f"{trajectory_name}: times must grow, but time {i + 1} is {t[i + 1]:.6g} after {t[i]:.6g}. {advice}"
        )
    empty_columns = [name for name, column in zip(names, x.T, strict=True) if np.isnan(column).all()]
    if empty_columns:
        raise InputError(
            f"{trajectory_name}: column {empty_columns[0]!r} has no values. Leave out this trajectory, or the column"
        )
    return Trajectory(t, x)


# -- sources ----------------------------------------------------------------------------------------------------------


def _read_all_columns(source: Any, trajectory: str | None, time: str | None) -> dict[str, np.ndarray]:
    """Read all columns of a table as arrays of equal length, by label.

    Raises
    ------
    FileError, InputError
        If the file cannot be read, the source is no table, or columns differ in length.
    """
    if isinstance(source, str | os.PathLike):
        return _columns_of_dataframe(_read_csv(Path(source)))
    if _is_instance_of(source, "pandas", "DataFrame"):
        return _columns_of_dataframe(source)
    if _is_instance_of(source, "xarray", "DataArray"):
        return _columns_of_dataset(
            source.to_dataset(name="x" if source.name is None else source.name), trajectory, time
        )
    if _is_instance_of(source, "xarray", "Dataset"):
        return _columns_of_dataset(source, trajectory, time)
    if isinstance(source, np.ndarray) and source.dtype.names is not None:
        source = {name: source[name] for name in source.dtype.names}
    if not isinstance(source, Mapping):
        raise InputError(
            "data must be a path of a CSV file, a DataFrame, a dataset of xarray or a dict of arrays, got "
            f"{type(source).__name__}"
        )
    columns = {str(name): np.asarray(values) for name, values in source.items()}
    lengths = {name: values.shape for name, values in columns.items()}
    if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
        text = ", ".join(f"{name} {shape}" for name, shape in lengths.items())
        raise InputError(f"the columns of a table must be arrays of one length, got {text}")
    return columns


def _read_csv(path: Path):
    """Read a CSV file into a DataFrame; the separator is the most frequent one in the header line.

    Raises
    ------
    FileError
        If the file does not exist, is no table, or has no header line.
    """
    import pandas

    try:
        with path.open(encoding="utf-8-sig") as file:
            header = next((line for line in file if line.strip() and not line.startswith("#")), "")
        separator = max(SEPARATORS, key=header.count)
        read_options = {"sep": separator, "comment": "#", "skipinitialspace": True, "encoding": "utf-8-sig"}
        frame = pandas.read_csv(path, **read_options)
        if separator != "," and any(map(pandas.api.types.is_string_dtype, frame.dtypes)):  # 1,5 in place of 1.5
            frame = pandas.read_csv(path, decimal=",", **read_options)
    except FileNotFoundError:
        raise FileError(f"there is no file {path!s:.200}") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:  # errors of the parser of pandas are ValueErrors
        raise FileError(f"{path!s:.200} could not be read as a table: {str(error).strip():.200}") from error
    if all(_converts_to_float(name.strip('"')) for name in map(str, frame.columns)):
        raise FileError(
            f"{path!s:.200} must begin with a line of names such as 't [s],gx [deg/s]', got {header.strip():.60}"
        )
    return frame


def _columns_of_dataframe(frame) -> dict[str, np.ndarray]:
    """Return the columns and named indices of a DataFrame as arrays, by name; raise InputError if names are equal."""
    columns = {str(name).strip(): _series_to_array(frame[name]) for name in frame.columns}
    if len(columns) < len(frame.columns):
        raise InputError(
            f"the columns of the table must have different names, got {', '.join(map(str, frame.columns))}"
        )
    for name in frame.index.names:
        if name is not None and name not in columns:
            columns[str(name)] = np.asarray(frame.index.get_level_values(name))
    return columns


def _series_to_array(series) -> np.ndarray:
    """Convert a pandas Series to an array; missing values become NaN."""
    if series.dtype.kind in "biufcmM" and isinstance(series.dtype, np.dtype):
        return series.to_numpy()
    if series.dtype.kind == "M":  # dates with a time zone
        return series.to_numpy(dtype="datetime64[ns]")
    if series.dtype.kind in "biuf":  # types of pandas with missing values
        return series.to_numpy(dtype=np.float64, na_value=np.nan)
    return series.to_numpy(dtype=object)


def _columns_of_dataset(dataset, trajectory: str | None, time: str | None) -> dict[str, np.ndarray]:
    """Return the variables of an xarray dataset as columns by label, with the trajectories one after another.

    Raises
    ------
    InputError
        If there are no variables with dimensions, or no coordinate of the times.
    """
    variables = {str(name): variable for name, variable in dataset.data_vars.items() if variable.dims}
    if not variables:
        raise InputError("the dataset has no variables with dimensions")
    template = next(iter(variables.values()))
    dims = [dim for dim in template.dims if dim != trajectory]
    named_dims = [dim for dim in dims if dim == time or (time is None and str(dim).lower() in TIME_NAMES)]
    time_dim = next(iter([*named_dims, *dims]), None)
    if time_dim not in dataset.coords:
        raise InputError(f"the dataset has no coordinate of the times {time_dim!r}. Add it with assign_coords")
    leading = ([trajectory] if trajectory in template.dims else []) + [time_dim]
    columns: dict[str, np.ndarray] = {}
    coordinates = {str(dim): dataset[dim] for dim in leading}
    coordinates |= {
        str(name): c for name, c in dataset.coords.items() if set(c.dims) == {time_dim} and name != time_dim
    }
    for name, variable in {**coordinates, **variables}.items():
        other_dims = [dim for dim in variable.dims if dim not in leading]
        missing_dims = {dim: template.sizes[dim] for dim in leading if dim not in variable.dims}
        variable = variable.expand_dims(missing_dims) if missing_dims else variable
        values = np.asarray(variable.transpose(*leading, *other_dims).values)
        label = f"{name} [{variable.attrs['units']}]" if "units" in variable.attrs else name
        short_name, unit_text = name, label[len(name) :]
        n_rows = int(np.prod(values.shape[: len(leading)]))
        if not other_dims:
            columns[label] = values.reshape(n_rows)
            continue
        for index in np.ndindex(values.shape[len(leading) :]):
            text = ", ".join(map(str, index))
            columns[f"{short_name}[{text}]{unit_text}"] = values[(..., *index)].reshape(n_rows)
    return columns
