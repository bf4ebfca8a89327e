"""Cache of machine code on disk: only files that this user alone can have written are run."""

import hashlib
import os
import stat
import subprocess
import sys
import warnings

import numpy as np
import pytest

from liethermo.engines.compiled import kept, machine_code
from liethermo.engines.compiled.kept import CacheWarning
from tests.liethermo.tracing.test_scalarize import program_of
from tests.machine_code import compile_program as compiled


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path / "cache"))
    kept._warn_untrusted.cache_clear()
    return tmp_path / "cache"


@pytest.fixture
def compilations(monkeypatch):
    """Return a list that grows by one with each compilation."""
    calls = []
    monkeypatch.setattr(
        machine_code, "_compile_module", lambda *a, make=machine_code._compile_module: calls.append(1) or make(*a)
    )
    return calls


def run() -> None:
    assert compiled(program_of(lambda a: a * 7.25, np.ones(2)))(np.ones(2))[0][0] == 7.25


def test_the_folder_and_its_files_are_the_users_alone(folder, compilations):
    run()
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700
    (file,) = folder.glob("*.o")
    assert stat.S_IMODE(os.stat(file).st_mode) == 0o600
    run()
    assert len(compilations) == 1


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_a_folder_that_others_may_write_to_is_not_used(folder, compilations, mode):
    run()
    os.chmod(folder, mode)
    with pytest.warns(CacheWarning, match="others may write to it"):
        run()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run()  # the warning is not repeated
    assert len(compilations) == 3


def test_a_file_that_others_may_write_to_is_not_run(folder, compilations):
    run()
    (file,) = folder.glob("*.o")
    os.chmod(file, 0o666)
    with pytest.warns(CacheWarning, match="others may write to it"):
        run()
    assert len(compilations) == 2
    run()  # the file has been replaced
    assert len(compilations) == 2


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_what_belongs_to_another_user_is_not_run(folder, compilations):
    run()
    (file,) = folder.glob("*.o")
    os.chown(file, 12345, 12345)
    with pytest.warns(CacheWarning, match="belongs to another user"):
        run()
    assert len(compilations) == 2
    os.chown(folder, 12345, 12345)
    with pytest.warns(CacheWarning, match="belongs to another user"):
        run()
    assert len(compilations) == 3


def test_links_are_not_followed(folder, compilations, tmp_path):
    run()
    (file,) = folder.glob("*.o")
    file.rename(tmp_path / "elsewhere.o")
    file.symlink_to(tmp_path / "elsewhere.o")
    run()
    assert len(compilations) == 2
    assert not file.is_symlink()
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved")
    with pytest.warns(CacheWarning, match="it is a link"):
        run()
    assert len(compilations) == 3


ELF = b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x01\0\x3e\0" + b"\xff" * 44
"""Header of an ELF object whose sections lie beyond its end."""


def with_checksum(code: bytes) -> bytes:
    return hashlib.sha256(code).digest() + code


@pytest.mark.parametrize(
    "content",
    [
        b"",
        with_checksum(b""),
        with_checksum(b"#!/bin/sh\n"),
        with_checksum(b"\x7fELF"),
        with_checksum(ELF),
        with_checksum(b"\0" * 500),
    ],
)
def test_what_is_no_object_is_passed_over(folder, compilations, content):
    run()
    (file,) = folder.glob("*.o")
    file.write_bytes(content)
    run()
    assert len(compilations) == 2


def test_a_pipe_is_passed_over(folder, compilations):
    run()
    (file,) = folder.glob("*.o")
    file.unlink()
    os.mkfifo(file)
    run()
    assert len(compilations) == 2


HOMELESS_SCRIPT = """
import os, pathlib
def nobody():
    raise RuntimeError("Could not determine home directory.")
pathlib.Path.home = nobody
import liethermo as lt
print(lt.integrate(lt.models.rigid_body(), [0.1, 1.0, 0.1], (0.0, 1.0), 0.1).audit().passed)
"""


@pytest.mark.parametrize("has_xdg_cache", [True, False])
def test_without_a_home(tmp_path, has_xdg_cache):
    removed_variables = {"HOME", "LIETHERMO_CACHE", "XDG_CACHE_HOME"}
    environment = {name: value for name, value in os.environ.items() if name not in removed_variables}
    if has_xdg_cache:
        environment["XDG_CACHE_HOME"] = str(tmp_path)
    process = subprocess.run(
        [sys.executable, "-c", HOMELESS_SCRIPT], capture_output=True, text=True, env=environment, check=False
    )
    assert process.stdout.strip() == "True", process.stderr
    assert (tmp_path / "liethermo").exists() == has_xdg_cache


def test_a_folder_that_cannot_be_made_is_no_fault(monkeypatch, compilations):
    for folder_name in ("/dev/null/cache", "a\0b"):
        monkeypatch.setattr(kept, "cache_folder", lambda where=folder_name: kept.Path(where))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run()
    assert len(compilations) == 2
