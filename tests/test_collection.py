"""Check that a module of tests that builds systems when it is read is refused."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import liethermo  # noqa: F401  # registers

ROOT = Path(__file__).parents[1]
BUILDS = "import liethermo as lt\nBODIES = [lt.models.rigid_body((i + 3.0, 2.0, 1.0)) for i in range(2)] + {more}\n"
OTHER_SYSTEM = "[lt.models.gas_piston()]"


@pytest.mark.slow
@pytest.mark.parametrize("too_many", [True, False])
def test_a_module_that_builds_systems_when_it_is_read_is_refused(too_many, tmp_path):
    module = tmp_path / "test_it.py"
    module.write_text(BUILDS.format(more=OTHER_SYSTEM if too_many else "[]") + "\n\ndef test_it():\n    pass\n")
    command = [sys.executable, "-m", "pytest", "-p", "tests.conftest", "--collect-only", "-q", "-n", "0", str(module)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert (run.returncode != 0) == too_many, run.stdout
    assert ("programs when it is read" in run.stdout) == too_many


def modules_that_register(root: Path, packages: list[str]) -> list[str]:
    """Return the names of the modules below ``root`` that register a method, an algebra, a group or a space."""
    files = [file for package in packages for file in sorted((root / package).rglob("*.py"))]
    registering = [file for file in files if re.search(r"^@?register\(", file.read_text(), re.MULTILINE)]
    return [".".join(file.relative_to(root).with_suffix("").parts) for file in registering]


def test_every_module_that_registers_is_imported():
    """A file that nothing imports would register nothing, and no test would run on what it defines."""
    names = modules_that_register(ROOT, ["liethermo", "manifolds"])
    assert len(names) > 15
    forgotten = [name for name in names if name not in sys.modules]
    assert not forgotten, f"import in the __init__.py beside it: {', '.join(forgotten)}"


def test_control_a_forgotten_module_is_named(tmp_path):
    (tmp_path / "liethermo").mkdir()
    (tmp_path / "liethermo" / "forgotten.py").write_text("class M: ...\n\n\nregister(M())\n")
    assert modules_that_register(tmp_path, ["liethermo"]) == ["liethermo.forgotten"]
    assert "liethermo.forgotten" not in sys.modules
