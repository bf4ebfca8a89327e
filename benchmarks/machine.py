"""Description of the machine and the software of a measurement, without names of hosts or folders."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

from .native import find_c_compiler

PACKAGES = "liethermo numpy scipy jax numba llvmlite diffrax heyoka mujoco pymanopt bsk".split()
"""Packages whose versions are recorded."""


def machine_description() -> dict[str, str]:
    """Return the hardware, the system and the versions of compiler and packages, by name."""
    return {
        "Processor": _processor_text(),
        "Cores": str(available_cores()),
        "Memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
        "System": f"{_operating_system_text()}, {platform.machine()}",
        "C compiler": _compiler_version_text(),
        "Python": platform.python_version(),
        "Packages": ", ".join(f"{name} {_package_version(name)}" for name in PACKAGES),
    }


def available_cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def load_average() -> str:
    """Return the load average of the last minute as text."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def _processor_text() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        fields.setdefault(name.strip(), value.strip())
    vectors = [name for name in ("avx512f", "avx2") if name in fields.get("flags", "").split()]
    return " with ".join([fields.get("model name", platform.machine()), *map(str.upper, vectors[:1])])


def _operating_system_text() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError, AttributeError):
        return platform.system()


def _compiler_version_text() -> str:
    command = find_c_compiler()
    if command is None:
        return "none"
    return subprocess.run([command, "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]


def _package_version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
