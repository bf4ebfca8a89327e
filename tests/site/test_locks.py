"""Check the packages that the set-up commands install: a run needs few, and every extra brings its own."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
MAX_PACKAGES = 60
"""Most packages of a run: more would make the first demo wait."""

EXTRA_PACKAGES = {
    "studies": {"dask", "distributed", "zarr"},
    "learn": {"optax"},
    "quantum": {"qutip"},
    "test": {"pytest", "hypothesis", "ruff", "mypy"},
    "docs": {"sphinx"},
    "bench": {"diffrax"},
}


def _packages(lock: str) -> dict[str, str]:
    """Return the versions of the packages in a lock file, by their names."""
    lines = (ROOT / lock).read_text().splitlines()
    return {
        name.lower(): version for name, version in (line.split("==") for line in lines if re.match(r"\w.*==", line))
    }


def test_a_run_needs_few_packages():
    run = _packages("requirements.lock")
    assert {"jax", "numpy", "llvmlite"} <= run.keys()
    assert len(run) <= MAX_PACKAGES


def test_each_extra_locks_what_it_needs_beside():
    run = _packages("requirements.lock")
    for extra, required_packages in EXTRA_PACKAGES.items():
        locked_packages = _packages(f"requirements-{extra}.lock").keys()
        assert required_packages <= locked_packages, extra
        assert not locked_packages & run.keys(), extra
