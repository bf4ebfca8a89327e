"""Files of results: written atomically, also by concurrent writers, and refused if their content was changed."""

import json
import os
import resource
import subprocess
import sys
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest

import liethermo as lt
from liethermo import disk
from liethermo.results import netcdf
from liethermo.runs import run


@pytest.fixture(scope="module")
def solution():
    return lt.integrate(lt.models.rigid_body(), [0.1, 1.0, 0.1], (0.0, 2.0), 0.1)


def rewrite(path: Path, change) -> Path:
    """Change a file and give it a valid checksum; return its path."""
    path.write_bytes(path.read_bytes()[: -len(netcdf.CHECKSUM_TAG) - 64])
    with h5py.File(path, "r+") as file:
        change(file)
    series, attributes = netcdf._read_hdf5(path)
    with h5py.File(path, "r+") as file:
        file.attrs["sha256"] = netcdf.checksum(series, attributes)
    return path


FULL_DISK_SCRIPT = """
import resource, signal, sys
import liethermo as lt
solution = lt.integrate(lt.models.rigid_body(), [0.1, 1.0, 0.1], (0.0, 200.0), 0.1)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for size in (0, 100, 5000, 20000, 60000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        solution.save(sys.argv[1])
        raise SystemExit("it was written")
    except lt.FileError as error:
        assert "cannot write" in str(error) and "\\n" not in str(error), error
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
assert solution.save(sys.argv[1]).exists() and (lt.load(sys.argv[1]).x == solution.x).all()
"""


def test_a_full_disk_is_an_error_and_no_crash(tmp_path):
    path = tmp_path / "run.nc"
    process = subprocess.run(
        [sys.executable, "-c", FULL_DISK_SCRIPT, str(path)], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert os.listdir(tmp_path) == ["run.nc"]


def test_a_disk_without_room(tmp_path):
    folder = tmp_path / "small"
    folder.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16k", "none", folder], check=False, capture_output=True
    ).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        solution = lt.integrate(lt.models.rigid_body(), [0.1, 1.0, 0.1], (0.0, 200.0), 0.1)
        with pytest.raises(lt.FileError, match="the disk is full"):
            solution.save(folder / "run.nc")
        assert os.listdir(folder) == []
    finally:
        subprocess.run(["umount", folder], check=True)


def test_a_save_that_fails_leaves_the_old_file(solution, tmp_path, monkeypatch):
    path = solution.save(tmp_path / "run.nc")
    content = path.read_bytes()

    def raise_disk_full(*ends):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(disk.os, "replace", raise_disk_full)
    with pytest.raises(lt.FileError, match=r"the disk is full .*The result in memory is unchanged"):
        solution.save(path)
    assert path.read_bytes() == content
    assert os.listdir(tmp_path) == ["run.nc"]


def test_many_write_to_one_path(solution, tmp_path):
    path, errors = tmp_path / "run.nc", []

    def save():
        try:
            for _ in range(5):
                solution.save(path)
        except Exception as error:  # asserted below
            errors.append(error)

    threads = [threading.Thread(target=save) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert np.array_equal(lt.load(path).x, solution.x)
    assert os.listdir(tmp_path) == ["run.nc"]


def test_a_planted_link_is_not_written_through(solution, tmp_path, monkeypatch):
    link_target = tmp_path / "precious"
    link_target.write_text("mine")
    partial_file_name = disk.partial_file_name("run.nc")
    monkeypatch.setattr(disk, "partial_file_name", lambda name: partial_file_name)
    (tmp_path / partial_file_name).symlink_to(link_target)
    with pytest.raises(lt.FileError, match="cannot write"):
        solution.save(tmp_path / "run.nc")
    assert link_target.read_text() == "mine"


def test_parts_of_dead_processes_are_swept(solution, tmp_path):
    ended_process = subprocess.Popen([sys.executable, "-c", ""])
    ended_process.wait()
    live_part, dead_part = (
        disk.partial_file_name("run.nc"),
        disk.partial_file_name("run.nc").replace(f".{os.getpid()}.", f".{ended_process.pid}."),
    )
    other_file_part = disk.partial_file_name("other.nc").replace(f".{os.getpid()}.", f".{ended_process.pid}.")
    for name in (live_part, dead_part, other_file_part):
        (tmp_path / name).write_bytes(b"half")
    solution.save(tmp_path / "run.nc")
    assert set(os.listdir(tmp_path)) == {"run.nc", live_part, other_file_part}


def _set_attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def _replace_array(name, values):
    def change(file):
        del file[name]
        file[name] = values

    return change


def _add_link(link):
    def change(file):
        file["energy2"] = link

    return change


CHANGES = {
    "deep JSON": _set_attribute("provenance", "[" * 20_000 + "]" * 20_000),
    "a number for the provenance": _set_attribute("provenance", "5"),
    "a list for the stats": _set_attribute("stats", "[1]"),
    "more than the stats": _set_attribute("stats", json.dumps({"steps": 1, "more": 2})),
    "steps in words": _set_attribute("stats", json.dumps({"steps": "many"})),
    "no such status": _set_attribute("status", json.dumps({"code": "fine", "message": "", "step": 1, "time": 1.0})),
    "a law that there is not": _set_attribute("laws", json.dumps({"energy": "maybe"})),
    "a time of an event in words": _set_attribute("event_time", '"noon"'),
    "states of another number": _replace_array("x", np.zeros((3, 3))),
    "states in one row": _replace_array("x", np.zeros(21)),
    "states in words": _replace_array("x", np.array([[b"a"] * 3] * 21)),
    "an energy of another number": _replace_array("energy", np.zeros(4)),
}
"""Changes of a file that make it no result."""


@pytest.mark.parametrize("change_name", CHANGES)
def test_what_is_no_result_is_refused(change_name, solution, tmp_path):
    path = rewrite(solution.save(tmp_path / "run.nc"), CHANGES[change_name])
    with pytest.raises(lt.FileError) as error_info:
        lt.load(path)
    assert "\n" not in str(error_info.value)


@pytest.mark.parametrize("link", [h5py.ExternalLink("other.nc", "/x"), h5py.SoftLink("/x")])
def test_links_are_not_followed(link, solution, tmp_path):
    path = solution.save(tmp_path / "run.nc")
    path.write_bytes(path.read_bytes()[: -len(netcdf.CHECKSUM_TAG) - 64])
    with h5py.File(path, "r+") as file:
        file["more"] = link
    with pytest.raises(lt.FileError, match="is a link to another place"):
        lt.load(path)


def test_an_array_that_the_file_cannot_hold_is_not_made(solution, tmp_path):
    path = solution.save(tmp_path / "run.nc")
    path.write_bytes(path.read_bytes()[: -len(netcdf.CHECKSUM_TAG) - 64])
    with h5py.File(path, "r+") as file:
        file.create_dataset("more", shape=(10**6, 10**6), chunks=(1000, 1000), dtype="f8")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(lt.FileError, match="larger than the file can hold"):
        lt.load(path)
    assert resource.getrlimit(resource.RLIMIT_AS) == limits


def test_an_ensemble_that_was_changed_is_refused(tmp_path):
    ensemble = lt.ensemble(lt.models.rigid_body(), [[0.1, 1.0, 0.1], [0.2, 1.0, 0.1]], (0.0, 1.0), 0.1)
    for change in (
        _replace_array("status", np.array([0, 77], dtype=np.int8)),
        _set_attribute("reasons", "3"),
        _set_attribute("provenance", "3"),
    ):
        path = rewrite(ensemble.save(tmp_path / "many.nc"), change)
        with pytest.raises(lt.FileError):
            lt.load(path)


@pytest.mark.parametrize("path", ["a\0b.nc", "x" * 300 + ".nc"])
def test_what_is_no_path(path, solution, tmp_path):
    with pytest.raises(lt.FileError, match="cannot write"):
        solution.save(tmp_path / path)
    with pytest.raises(lt.FileError):
        lt.load(tmp_path / path)


def raise_disk_full(*arguments):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-6)])
def test_a_run_that_cannot_be_kept_is_not_lost(tmp_path, monkeypatch, step):
    monkeypatch.setattr(disk.os, "replace", raise_disk_full)
    monkeypatch.setattr(run, "CHECKPOINT_SECONDS", 0.0)
    body, x0 = lt.models.rigid_body(), [0.1, 1.0, 0.1]
    warns_and_continues = pytest.warns(UserWarning, match="the disk is full .*The run goes on")
    with (
        warns_and_continues,
        pytest.raises(
            lt.FileError, match=r"the disk is full .*The exception has this result as \.solution"
        ) as error_info,
    ):
        lt.integrate(body, x0, (0.0, 2.0), step, save_to=tmp_path / "run.nc")
    monkeypatch.undo()
    undisturbed_run = lt.integrate(body, x0, (0.0, 2.0), step)
    assert np.array_equal(error_info.value.solution.x, undisturbed_run.x)
    assert error_info.value.solution.status.ok
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_pictures_appear_whole_or_not_at_all(solution, tmp_path, monkeypatch, suffix):
    path = tmp_path / f"laws.{suffix}"
    lt.plot.laws(solution, path=path)
    content = path.read_bytes()
    monkeypatch.setattr(disk.os, "replace", raise_disk_full)
    with pytest.raises(lt.FileError, match="the disk is full"):
        lt.plot.laws(solution, path=path)
    assert path.read_bytes() == content
    assert os.listdir(tmp_path) == [path.name]


def test_a_pipe_or_a_device_is_not_replaced(solution, tmp_path):
    os.mkfifo(tmp_path / "pipe.nc")
    for path in (tmp_path / "pipe.nc", tmp_path):
        with pytest.raises(lt.FileError, match="not a plain file"):
            solution.save(path)
    assert (tmp_path / "pipe.nc").is_fifo()
    with pytest.raises(lt.FileError, match="there is no file"):  # without waiting for the pipe
        lt.load(tmp_path / "pipe.nc")


def test_no_scheduler_is_asked_whether_a_file_may_be_written(solution, tmp_path, monkeypatch):
    """xarray asks a Dask scheduler for a lock if there is a client, which fails if the scheduler is gone."""
    import distributed

    def raise_gone(*arguments, **keywords):
        raise OSError("the scheduler is gone")

    with distributed.Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None):
        monkeypatch.setattr(distributed.Lock, "acquire", raise_gone)
        solution.save(tmp_path / "run.nc")
    assert np.array_equal(lt.load(tmp_path / "run.nc").x, solution.x)
