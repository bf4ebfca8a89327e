"""Tables as data of fits: files, DataFrames, datasets of xarray and arrays with names."""

from __future__ import annotations

import numpy as np
import pandas
import pytest
import xarray

import liethermo as lt
from liethermo.learn.data import parse_trajectories
from liethermo.learn.observation import make_observation

T = np.array([0.0, 0.01, 0.025, 0.04])
ANGLES = np.array([10.0, 20.0, np.nan, 40.0])
HEIGHTS = np.array([1.0, 2.0, 3.0, 4.0])


def check(data, names=("angle", "height")):
    assert data.names == names
    assert len(data) == 1
    t, x = data[0]
    np.testing.assert_allclose(t, T, rtol=1e-14)
    np.testing.assert_allclose(x, np.column_stack([np.radians(ANGLES), HEIGHTS]), rtol=1e-14)


FRAME = pandas.DataFrame({"time [ms]": 1e3 * T, "angle [deg]": ANGLES, "height (m)": HEIGHTS})
UNITS = {"time": "ms", "angle": "deg"}


def test_units_stand_in_the_labels_of_a_frame():
    check(lt.learn.read_data(FRAME))


def test_units_are_given_by_name():
    frame = pandas.DataFrame({"time": 1e3 * T, "angle": ANGLES, "height": HEIGHTS, "who": list("abcd")})
    check(lt.learn.read_data(frame, ["angle", "height"], units=UNITS))


def test_given_units_replace_those_of_labels():
    data = lt.learn.read_data(FRAME, units={"angle": ""})
    np.testing.assert_array_equal(data[0].x[:, 0], ANGLES)


def test_a_nullable_column_and_an_index_of_times_are_read():
    frame = pandas.DataFrame({"angle": pandas.array(ANGLES, dtype="Float64"), "height": HEIGHTS})
    frame.index = pandas.Index(1e3 * T, name="time")
    check(lt.learn.read_data(frame, units=UNITS))


@pytest.mark.parametrize(
    ("separator", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", ".")], ids=["comma", "semicolon", "de", "tab"]
)
def test_a_file_is_read_with_its_separator(tmp_path, separator, decimal):
    path = tmp_path / "records.csv"
    FRAME.to_csv(path, sep=separator, decimal=decimal, index=False)
    path.write_text("# a comment\n" + path.read_text(), encoding="utf-8-sig")
    check(lt.learn.read_data(path))
    check(lt.learn.read_data(str(path), columns=["angle", "height"]))


def test_a_dict_and_a_structured_array_are_tables():
    columns = {"time": 1e3 * T, "angle": ANGLES, "height": HEIGHTS}
    check(lt.learn.read_data(columns, units=UNITS))
    array = np.rec.fromarrays(list(columns.values()), names=list(columns))
    check(lt.learn.read_data(np.asarray(array), units=UNITS))


def test_attributes_of_a_dataset_are_units():
    dataset = xarray.Dataset(
        {"angle": ("time", ANGLES, {"units": "degrees"}), "height": ("time", HEIGHTS)},
        coords={"time": ("time", 1e3 * T, {"units": "ms"})},
    )
    check(lt.learn.read_data(dataset))


def test_a_dimension_numbers_trajectories_of_different_lengths():
    x = np.stack([np.column_stack([HEIGHTS, ANGLES]), np.column_stack([-HEIGHTS, -ANGLES])])
    x[1, 3] = np.nan
    array = xarray.DataArray(x, dims=("run", "time", "component"), coords={"time": T}, name="q")
    data = lt.learn.read_data(array, trajectory="run")
    assert data.names == ("q[0]", "q[1]")
    assert [len(t) for t, _ in data] == [4, 3]
    np.testing.assert_array_equal(data[1].x, x[1, :3])
    transposed_data = lt.learn.read_data(array.transpose("time", "component", "run"), trajectory="run")
    np.testing.assert_array_equal(transposed_data[1].x, x[1, :3])


def test_the_dataset_of_a_solution_is_a_table():
    run = lt.integrate(lt.models.rigid_body(), [0.1, 1.0, 0.1], (0.0, 1.0), 0.1)
    data = lt.learn.read_data(run.to_xarray()[["x"]])
    assert data.names == ("x[0]", "x[1]", "x[2]")
    np.testing.assert_array_equal(data[0].x, run.x)


def test_a_column_numbers_trajectories():
    frame = pandas.concat([FRAME.assign(run="first"), FRAME.assign(run="second")])
    data = lt.learn.read_data(frame, trajectory="run")
    assert len(data) == 2
    assert data.names == ("angle", "height")
    np.testing.assert_array_equal(data[1].t, data[0].t)


def test_dates_count_in_seconds_from_the_first():
    dates = np.datetime64("2024-05-01T12:00:00") + (1e6 * T).astype("timedelta64[us]")
    check(lt.learn.read_data({"timestamp": dates, "angle": ANGLES, "height": HEIGHTS}, units={"angle": "deg"}))
    texts = [str(date) for date in dates]
    check(lt.learn.read_data({"timestamp": texts, "angle": ANGLES, "height": HEIGHTS}, units={"angle": "deg"}))
    zone = pandas.DataFrame({"time": pandas.to_datetime(dates).tz_localize("UTC"), "angle": ANGLES, "height": HEIGHTS})
    check(lt.learn.read_data(zone, units={"angle": "deg"}))


def test_rows_without_values_are_left_out():
    data = lt.learn.read_data({"t": T, "x": ANGLES})
    np.testing.assert_array_equal(data[0].t, T[[0, 1, 3]])
    assert str(data) == "x: 3 rows in 1 trajectory, times 0 to 0.04"


def table(**changes):
    return {"t": T, "x": HEIGHTS} | changes


def test_the_time_of_a_dataset_may_be_any_dimension():
    x = np.column_stack([HEIGHTS, ANGLES])
    array = xarray.DataArray(x.T, dims=("component", "time"), coords={"time": T}, name="q")
    np.testing.assert_array_equal(lt.learn.read_data(array)[0].x, x)
    array = array.rename(time="clock")
    np.testing.assert_array_equal(lt.learn.read_data(array, time="clock")[0].x, x)


BAD = {
    "a dataset without times": (
        lambda: lt.learn.read_data(xarray.DataArray(HEIGHTS, dims=("time",))),
        "no coordinate of the times 'time'. Add it with assign_coords",
    ),
    "unsorted": (lambda: lt.learn.read_data(table(t=T[[0, 2, 1, 3]])), "time 2 is 0.01 after 0.025. Sort the rows"),
    "repeated": (lambda: lt.learn.read_data(table(t=T[[0, 1, 1, 3]])), "time 0.01 occurs twice. Keep one of these"),
    "unknown column": (lambda: lt.learn.read_data(table(), ["y"]), "no column 'y'; their columns are t, x"),
    "unknown time": (lambda: lt.learn.read_data(table(), time="s"), "no column 's'; their columns are t, x"),
    "no time": (
        lambda: lt.learn.read_data({"x": T}),
        "no column 'time'; their columns are x. Name the column of the times",
    ),
    "two times": (lambda: lt.learn.read_data(table(time=T)), "the columns t, time may all be times"),
    "all missing": (lambda: lt.learn.read_data(table(x=np.nan * T)), "column 'x' has no values, only missing ones"),
    "one row": (lambda: lt.learn.read_data({"t": [1.0], "x": [2.0]}), "1 row with values, at least 2 are needed"),
    "unknown unit": (
        lambda: lt.learn.read_data(table(), units={"x": "furlong"}),
        "column 'x': unknown unit 'furlong'. Known are",
    ),
    "unit of an unknown column": (lambda: lt.learn.read_data(table(), units={"y": "m"}), "no column 'y'"),
    "unit of a column that is not read": (
        lambda: lt.learn.read_data(table(y=T), ["x"], units={"y": "m"}),
        "units has 'y', but this column is not read",
    ),
    "unit that is no text": (
        lambda: lt.learn.read_data(table(), units={"x": 2}),
        "must be a name such as 'deg/s', got 2",
    ),
    "time in degrees": (
        lambda: lt.learn.read_data(table(), units={"t": "deg"}),
        "the times 't' are in 'deg'. Give a unit",
    ),
    "missing time": (lambda: lt.learn.read_data(table(t=ANGLES)), "time 2 is nan. Remove the rows without a time"),
    "text": (
        lambda: lt.learn.read_data(table(x=list("abcd"))),
        "column 'x' must have numbers, got 'a'. Name the columns",
    ),
    "one string of columns": (lambda: lt.learn.read_data(table(), "x"), "columns must be a list of names, got 'x'"),
    "only times": (lambda: lt.learn.read_data({"t": T}), "no columns besides the times 't'"),
    "unequal lengths": (lambda: lt.learn.read_data(table(y=T[:2])), "must be arrays of one length, got t (4,), x (4,)"),
    "a number": (lambda: lt.learn.read_data(3.0), "a DataFrame, a dataset of xarray or a dict of arrays, got float"),
    "one missing trajectory": (
        lambda: lt.learn.read_data(
            {"run": [0, 0, 1, 1], "t": [0, 1, 0, 1], "x": HEIGHTS, "y": [1, 2, np.nan, np.nan]}, trajectory="run"
        ),
        "trajectory 1: column 'y' has no values. Leave out this trajectory",
    ),
    "dates with a unit": (
        lambda: lt.learn.read_data(table(t=T.astype("datetime64[s]")), units={"t": "s"}),
        "are dates, which have no unit",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_table_that_cannot_be_used_has_an_error_of_one_line(case):
    call, words = BAD[case]
    with pytest.raises(lt.InputError) as raised:
        call()
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(lt.FileError, match="there is no file"):
        lt.learn.read_data(tmp_path / "none.csv")
    path = tmp_path / "numbers.csv"
    path.write_text("0.0,1.0\n0.1,2.0\n")
    with pytest.raises(lt.FileError, match="must begin with a line of names"):
        lt.learn.read_data(path)
    path.write_text("t,x\n0.0,1.0\n0.1,2.0,3.0,4.0\n")
    with pytest.raises(lt.FileError, match="could not be read as a table"):
        lt.learn.read_data(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(lt.FileError, match="could not be read as a table"):
        lt.learn.read_data(path)


def test_tables_in_a_list_are_several_trajectories():
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    observation = make_observation(body, None, lambda x: {"a": x[0], "b": x[2]})
    tables = [pandas.DataFrame({"t": T, "b [deg]": ANGLES, "a": HEIGHTS}), {"time": T[:2], "a": T[:2], "b": T[:2]}]
    first, second = parse_trajectories(tables, body, observation)
    np.testing.assert_array_equal(first.x, np.column_stack([HEIGHTS, np.radians(ANGLES)]))
    np.testing.assert_array_equal(second.x, np.column_stack([T[:2], T[:2]]))


def test_the_advice_of_errors_works():
    order = np.argsort(times := T[[0, 2, 1, 3]])
    np.testing.assert_array_equal(lt.learn.read_data({"t": times[order], "x": HEIGHTS[order]})[0].t, T)
    assert len(lt.learn.read_data({"n": [0, 0, 1, 1], "t": [0, 1, 0, 1], "x": HEIGHTS}, trajectory="n")) == 2
    assert lt.learn.read_data(table(time=T), time="t").names == ("x", "time")
    assert lt.learn.read_data({"t": T, "x (left)": HEIGHTS}, units={"x": ""}).names == ("x",)
