"""Spec files of strangers: they cannot run foreign code, and are refused quickly if they are invalid."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

import liethermo as lt
from liethermo.cli import app
from liethermo.spec import read
from liethermo.spec.trust import pickle_spec_modules_by_value

RUN = "[run]\ninitial = [0.1, 1.0, 0.1]\nt_span = [0.0, 1.0]\nstep = 0.1\n"
MINE = """
from os import system
from mine_too import inertia
import liethermo as lt

def build(rate=1.0):
    return lt.models.rigid_body(inertia, rate)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_of_trust.py").write_text(MINE)
    (tmp_path / "mine_too.py").write_text("inertia = (3.0, 2.0, 1.0)")
    yield tmp_path
    for name in ("mine_of_trust", "mine_too", "elsewhere_of_trust"):
        sys.modules.pop(name, None)


def spec(folder: Path, text: str, name: str = "spec.toml") -> Path:
    (folder / name).write_text(text)
    return folder / name


def model(function: str, parameters: str = "{}") -> str:
    return f'[model]\nfunction = "{function}"\nparameters = {parameters}\n{RUN}'


@pytest.mark.parametrize("command", ["run", "check", "study"])
@pytest.mark.parametrize(
    ("function", "parameters"),
    [
        ("os:system", '{command = "touch ran"}'),
        ("posix:system", '{command = "touch ran"}'),
        ("subprocess:getoutput", '{cmd = "touch ran"}'),
        ("mine_of_trust:system", '{command = "touch ran"}'),
        ("builtins:exec", "{}"),
        ("liethermo.models:rigid_body", "{}"),
    ],
)
def test_a_spec_runs_nothing_that_is_not_beside_it(folder, command, function, parameters):
    path = spec(folder, model(function, parameters))
    result = CliRunner().invoke(app, [command, str(path)])
    assert result.exit_code == 2
    assert "defines no function" in result.stderr or "only if you allow it by name" in result.stderr
    assert not (folder / "ran").exists()


def test_a_module_beside_the_spec_is_used_and_told(folder):
    original_path = list(sys.path)
    path = spec(folder, model("mine_of_trust:build", "{rate = 2.0}"))
    result = CliRunner().invoke(app, ["check", str(path)])
    assert result.exit_code == 0
    assert f"imports mine_of_trust from {folder / 'mine_of_trust.py'}" in result.stdout
    assert sys.path == original_path


def test_another_file_of_the_same_name_is_another_module(folder, tmp_path):
    read(spec(folder, model("mine_of_trust:build")))
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    (other_folder / "mine_of_trust.py").write_text("def build(): return 5\n")
    assert read(spec(other_folder, model("mine_of_trust:build"))).build() == 5


def test_a_module_elsewhere_has_to_be_allowed(folder, tmp_path, monkeypatch):
    other_folder = tmp_path / "away"
    other_folder.mkdir()
    (other_folder / "elsewhere_of_trust.py").write_text(
        "import liethermo as lt\ndef build(): return lt.models.rigid_body()\n"
    )
    monkeypatch.syspath_prepend(str(other_folder))
    path = spec(folder, model("elsewhere_of_trust:build"))
    result = CliRunner().invoke(app, ["check", str(path)])
    assert "only if you allow it by name: --allow elsewhere_of_trust" in result.stderr.replace("\n", " ")
    assert CliRunner().invoke(app, ["check", str(path), "--allow", "elsewhere_of_trust"]).exit_code == 0


def test_a_file_beside_the_spec_shadows_nothing(folder):
    (folder / "xarray.py").write_text("raise SystemExit('shadowed')")
    path = spec(folder, model("mine_of_trust:build"))
    result = CliRunner().invoke(app, ["run", str(path), "--out", "results", "--set", "run.step=0.01"])
    assert result.exit_code == 0, result.stderr
    check_result = CliRunner().invoke(app, ["check", str(spec(folder, model("xarray:build")))])
    assert "there is another module 'xarray'" in check_result.stderr


SHADOWING = """
import sys
from pathlib import Path
import liethermo as lt
from liethermo.spec import read
from liethermo.spec.trust import pickle_spec_modules_by_value
assert "xarray" not in sys.modules
try:
    read(Path(sys.argv[1]))
except lt.SpecError as error:
    print(error)
import xarray
print(xarray.__version__)
"""


def test_a_file_beside_the_spec_is_not_taken_for_an_installed_module(folder):
    """A module that has not been imported yet is refused too, since it would be found beside the spec afterwards."""
    (folder / "xarray.py").write_text("def build(): return 5")
    path = spec(folder, model("xarray:build"))
    command = [sys.executable, "-P", "-c", SHADOWING, str(path)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert "there is another module 'xarray'" in process.stdout


def test_modules_beside_the_spec_are_sent_to_workers(folder):
    """They are pickled by value with their own imports, since a worker has other folders."""
    import cloudpickle

    build, pickle_file = read(spec(folder, model("mine_of_trust:build"))).build, folder / "build.pickle"
    pickle_file.write_bytes(cloudpickle.dumps(build))
    unpack = f"import pickle; print(type(pickle.load(open({str(pickle_file)!r}, 'rb'))(2.0)).__name__)"
    command = [sys.executable, "-P", "-c", unpack]
    assert (
        "No module named 'mine_of_trust'" in subprocess.run(command, capture_output=True, text=True, check=False).stderr
    )
    with pickle_spec_modules_by_value(folder):
        pickle_file.write_bytes(cloudpickle.dumps(build))
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.stdout.strip() == "LiePoissonSystem", process.stderr


STUDY = f"[model]\nname='rigid_body'\n{RUN}[study.axes]\n"

BAD = {
    "long number": RUN.replace("0.1]", "9" * 5000 + "]"),
    "number without end": RUN.replace("0.1]", "9" * 4000 + "]"),
    "lists in lists": f"[model]\nname = 'rigid_body'\n[run]\ninitial = {'[' * 20_000}{']' * 20_000}\n",
    "tables in tables": f"x = {'{a=' * 20_000}1{'}' * 20_000}\n",
    "key of many parts": f"{'a.' * 20_000}b = 1\n",
    "head of many parts": f"[{'a.' * 20_000}b]\n",
    "large": "#" * 100_000_000,
    "too many points": STUDY + "rate={first=1.0, last=2.0, points=1000000000000}",
    "all too many points": STUDY + "rate={first=1.0, last=2.0, points=100000}\n"
    '"initial[0]"={first=0.1, last=0.2, points=100000}',
    "a word among numbers": STUDY + "rate=[1.0, 'fast']",
    "a word": STUDY + "rate=['fast', 'slow']",
    "a word in the state": STUDY + "'initial[0]'=['fast', 'slow']",
    "not text": "\x00\x01",
    "an entry of 5000 digits": STUDY + f"'initial[{'9' * 5000}]'=[1.0]",
    "a seed below zero": STUDY + "p={sobol=4, ranges={rate=[1.0, 2.0]}, seed=-1}",
    "too many faults": f"{RUN}" + "".join(f"k{i}=1\n" for i in range(20_000)),
}


@pytest.mark.parametrize("what", BAD)
def test_invalid_specs_are_refused_quickly(folder, what):
    path, start = spec(folder, BAD[what]), time.perf_counter()
    result = CliRunner().invoke(app, ["study", str(path), "--out", "store"])
    assert result.exit_code == 2, result.output
    assert isinstance(result.exception, SystemExit)
    assert result.stderr.startswith("liethermo: ")
    assert all(len(line) < 600 for line in result.stderr.splitlines())
    assert len(result.stderr.splitlines()) < 500
    assert time.perf_counter() - start < 20.0


@pytest.mark.parametrize("change", ["a." * 20_000 + "b=1", "run.step=" + "[" * 20_000, "run.step=" + "9" * 5000])
def test_changes_that_cannot_be_made(folder, change):
    with pytest.raises(lt.SpecError):
        read(spec(folder, f"[model]\nname = 'rigid_body'\n{RUN}"), [change])


def test_an_invalid_path_is_refused():
    with pytest.raises(lt.FileError, match="cannot read the spec file"):
        read("a\0b.toml")
