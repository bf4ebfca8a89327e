"""Check that a module of tests that builds systems when it is read is refused."""

import subprocess
import sys
from pathlib import Path

import pytest

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
