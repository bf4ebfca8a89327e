"""Foreign, changed or damaged stores: nothing outside is read or written, and the reports are true."""

import contextlib
import json
import os
import shutil
import struct
from pathlib import Path

import google_crc32c
import numpy as np
import pytest

import liethermo as lt
from liethermo.cli import app
from liethermo.studies import store as stores
from liethermo.studies import store_metadata
from liethermo.studies.store_metadata import CHECKSUM_ATTRIBUTE, with_checksum
from liethermo.studies.store_results import audit_store, load_status, load_study


def study(store, rates=(0.5, 1.0, 2.0, 4.0)):
    return lt.Study(
        lambda p: lt.models.rigid_body(rate=p["rate"]),
        {"rate": list(rates)},
        x0=[0.1, 1.0, 0.1],
        t_span=(0.0, 1.0),
        step=0.1,
        measure={"end": "final", "tau": "relaxation_time"},
        store=store,
        chunk=2,
    )


@pytest.fixture(scope="module")
def original_store(tmp_path_factory):
    store = tmp_path_factory.mktemp("stores") / "made.zarr"
    study(store).run()
    return store


@pytest.fixture
def store(original_store, tmp_path):
    return Path(shutil.copytree(original_store, tmp_path / "store.zarr"))


def collect_errors(store):
    """Call everything that reads a store, and return the messages of the errors."""
    calls = [
        lambda: load_status(store),
        lambda: audit_store(store),
        lambda: load_study(store).load(),
        lambda: study(store).run(),
        lambda: study(store).results.load(),
    ]
    messages = []
    for call in calls:
        try:
            call()
        except lt.LiethermoError as error:  # and no other
            messages.append(str(error))
    return messages


def change_metadata(store, change, seal=True):
    """Change the metadata of a store, with a valid checksum if ``seal`` is true."""
    group = json.loads((store / "zarr.json").read_text())
    change(group)
    (store / "zarr.json").write_text(json.dumps(with_checksum(group) if seal else group))
    return store


def rename_measure(name):
    def change(group):
        attributes, arrays = group["attributes"], group["consolidated_metadata"]["metadata"]
        arrays[name] = arrays.pop("end")
        arrays[name]["dimension_names"][-1] = f"{name}_component"
        attributes["measures"] = [name, "tau"]
        description = attributes["study"]
        for key in ("measures", "values"):
            description[key] = {name: description[key]["end"], "tau": description[key]["tau"]}

    return change


NAMES = [
    "../../escaped",
    "/tmp/escaped",
    "..",
    ".",
    "",
    "zarr.json",
    "a/b",
    "a\\b",
    "x\0y",
    "status",
    "rate",
    "a" * 300,
]


@pytest.mark.parametrize("name", NAMES, ids=[f"{name!r:.12}" for name in NAMES])
def test_a_measure_cannot_have_the_name_of_a_place(store, name):
    initial_files = {path for path in store.parent.parent.rglob("*") if store not in path.parents}
    messages = collect_errors(change_metadata(store, rename_measure(name)))
    assert len(messages) == 5
    assert all("nothing in it can be called" in text or "names a measure and an axis" in text for text in messages)
    assert {path for path in store.parent.parent.rglob("*") if store not in path.parents} == initial_files
    with pytest.raises(lt.InputError):
        lt.Study(
            lambda p: lt.models.rigid_body(rate=p["rate"]), {"rate": [1.0]}, x0=[0.1, 1.0, 0.1], t_span=(0.0, 1.0),
            step=0.1, measure={name: "final"},
        )  # fmt: skip


def test_the_measures_are_a_part_of_what_a_study_is(store):
    messages = collect_errors(change_metadata(store, rename_measure("other")))
    assert any("is the store of another study" in text and "measures" in text for text in messages)


def set_in_array(name, **entries):
    def change(group):
        array = group["consolidated_metadata"]["metadata"][name]
        for key, value in entries.items():
            if key == "chunks":
                array["chunk_grid"]["configuration"]["chunk_shape"] = value
            elif value is None:
                del array[key]
            else:
                array[key] = value

    return change


def set_in_group(*keys, value=None):
    def change(group):
        for key in keys[:-1]:
            group = group[key]
        if value is None:
            del group[keys[-1]]
        else:
            group[keys[-1]] = value

    return change


METADATA = {
    "a chunk of zero": set_in_array("end", chunks=[0, 3]),
    "a status of zero": set_in_array("status", chunks=[0]),
    "huge": set_in_array("status", shape=[10**9], chunks=[10**9]),
    "huge by huge": set_in_array("end", shape=[10**9, 10**9]),
    "huge coordinates": set_in_array("rate", shape=[10**9]),
    "a huge table of quantities": set_in_array("quantity", shape=[10**9]),
    "no attributes": set_in_array("end", attributes=None),
    "integers for numbers": set_in_array("end", data_type="int64"),
    "other codecs": set_in_array("end", codecs=[]),
    "another fill value": set_in_array("end", fill_value=5.0),
    "another axis": set_in_array("end", dimension_names=["tau", "end_component"]),
    "no study": set_in_group("attributes", "study"),
    "no measures": set_in_group("attributes", "measures"),
    "no values": set_in_group("attributes", "study", "values"),
    "values of nothing": set_in_group("attributes", "study", "values", value=5),
    "no versions": set_in_group("attributes", "study", "versions"),
    "a motion in words": set_in_group("attributes", "study", "motion", value=["fast"]),
    "laws of another kind": set_in_group("attributes", "laws", value={"energy": "perhaps"}),
}


@pytest.mark.parametrize("what", METADATA)
def test_metadata_that_no_study_writes_are_refused(store, what):
    messages = collect_errors(change_metadata(store, METADATA[what]))
    assert len(messages) == 5
    assert all("damaged or changed" in text and "\n" not in text for text in messages)


def test_metadata_have_a_checksum(store):
    def change_title(group):
        group["attributes"]["title"] += "s"

    assert collect_errors(change_metadata(store, change_title)) == []
    assert len(collect_errors(change_metadata(store, change_title, seal=False))) == 5
    with pytest.warns(UserWarning, match="an earlier version"):
        assert load_status(change_metadata(store, set_in_group("attributes", CHECKSUM_ATTRIBUTE), seal=False)).complete


def replace_by_link(path, target):
    os.rename(path, target)
    path.symlink_to(target)


def replace_by_pipe(path, _):
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("file_name", ["end/c", "end/c/0/0", "status/c/0", "rate/c/0", ".lock"])
@pytest.mark.parametrize("plant", [replace_by_link, replace_by_pipe])
def test_nothing_leads_out_of_a_store(store, tmp_path, file_name, plant):
    if plant is replace_by_pipe and file_name == "end/c":
        return
    target = tmp_path / "outside"
    plant(store / file_name, target)
    initial_contents = {path: path.read_bytes() for path in tmp_path.rglob("outside*") if path.is_file()}
    messages = collect_errors(store)
    assert len(messages) == 5
    assert all("all in the store of a study are plain files" in text for text in messages)
    assert {path: path.read_bytes() for path in tmp_path.rglob("outside*") if path.is_file()} == initial_contents


def test_an_unknown_status_counts_as_damage(store):
    mark = np.array([77, 0], dtype=np.int8).tobytes()
    (store / "status/c/0").write_bytes(mark + struct.pack("<I", google_crc32c.value(mark)))
    assert load_status(store).done == 2
    assert audit_store(store).passed
    with pytest.raises(lt.FileError, match="a status that there is not"):
        load_study(store).load()
    assert study(store).run().damaged == ("status/c/0 is damaged",)
    assert collect_errors(store) == []


@pytest.mark.parametrize("name", ["rate/c/0", "quantity/c/0"])
@pytest.mark.parametrize("is_deleted", [True, False])
def test_coordinates_are_written_again_by_the_study_that_knows_them(store, original_store, name, is_deleted):
    undamaged = load_study(original_store).load()
    (store / name).unlink() if is_deleted else (store / name).write_bytes(b"")
    with pytest.raises(lt.FileError, match="Run the study again"):
        load_study(store).load()
    if name == "rate/c/0":
        with pytest.raises(lt.FileError, match="in their order"):
            study(store, (4.0, 2.0, 1.0, 0.5)).run()
    study(store).run()
    assert load_study(store).load().identical(undamaged)


def test_a_missing_chunk_is_not_read_as_nan(store):
    (store / "tau/c/1").unlink()
    dataset = load_study(store)
    assert np.isfinite(dataset["tau"][:2].values).all()
    with pytest.raises(lt.FileError, match="tau/c/1"):
        dataset["tau"].values  # noqa: B018
    assert study(store).run().damaged == ("tau/c/1 is missing",)


def test_a_damaged_chunk_is_told_on_the_command_line(store):
    from typer.testing import CliRunner

    (store / "tau/c/1").write_bytes(b"")
    result = CliRunner().invoke(app, ["plot", str(store), "--out", str(store.parent / "a.png")])
    assert result.exit_code == 2
    assert "tau/c/1 is damaged" in result.stderr.replace("\n", "")


def test_the_loser_of_a_race_for_a_store_is_told(tmp_path, monkeypatch):
    path, rename, locks = tmp_path / "store.zarr", os.rename, contextlib.ExitStack()

    def rename_too_late(source, target):
        monkeypatch.undo()
        study(path).run()
        locks.enter_context(store_metadata.lock_store(path))(4)
        rename(source, target)

    monkeypatch.setattr(stores.os, "rename", rename_too_late)
    with locks, pytest.raises(lt.FileError, match=f"another run works on .*: process {os.getpid()} on"):
        study(path).run()
    assert os.listdir(tmp_path) == ["store.zarr"]
    assert study(path).run().complete


def test_a_store_that_cannot_be_made_leaves_nothing(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store_metadata.disk.os, "replace", full)
    with pytest.raises(lt.FileError, match=r"cannot make the store .*store\.zarr: the disk is full"):
        study(tmp_path / "store.zarr").run()
    assert os.listdir(tmp_path) == []
