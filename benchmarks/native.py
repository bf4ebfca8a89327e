"""The C programs, built on first use with ``cc -O3 -march=native`` and called through ctypes."""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from liethermo.engines.solver_options import DEFAULT_OPTIONS

from .report import UnavailableError

SOURCE_FOLDER = Path(__file__).parent / "c"
"""Folder of the C sources."""
COMPILER_OPTIONS = ["-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared"]
"""Compiler options of all programs."""

SHARED_OPTIONS = (
    "max_fixed_point_iterations",
    "fixed_point_contraction_limit",
    "stall_ratio",
    "update_floor",
    "plateau_rtol",
    "drift_threshold",
)
"""Fields of :class:`.SolverOptions` that the C programs use, as macros in capitals."""

STATUSES = ("completed", "not_converged", "non_finite")
"""Names of the status codes of the C programs."""


def c_run_record_dtype(components: int) -> np.dtype:
    """Return the NumPy dtype of the C struct ``PeerRun`` in c/midpoint.h, for states of n components."""
    vectors = [(name, "f8", components) for name in ("x", "low", "k", "before")]
    energies = ["energy", "entropy", "first_energy", "largest_energy", "smallest_energy"]
    increments = ["least_entropy_increment", "largest_energy_increment"]
    numbers = [(name, "f8") for name in (*energies, *increments, "residual", "worst_residual", "integral")]
    return np.dtype(vectors + numbers + [(name, "i8") for name in ("status", "steps", "iterations", "most_iterations")])


SUMMARY_DTYPE = np.dtype(
    [("x", "f8", 3)]
    + [(name, "f8") for name in ("first_energy", "largest_energy", "smallest_energy", "entropy")]
    + [(name, "f8") for name in ("least_entropy_increment", "steps", "iterations", "integral")]
    + [("status", "i8")]
)
"""Record type ``LawSummary`` of c/ensemble.c."""

RING_DTYPE = np.dtype(
    [(name, "f8") for name in ("energy", "entropy", "first_energy", "largest_energy", "smallest_energy")]
    + [("least_entropy_increment", "f8")]
    + [(name, "i8") for name in ("status", "steps", "iterations")]
)
"""Record type ``Record`` of c/spins.c."""


def find_c_compiler() -> str | None:
    """Return the C compiler: ``$CC``, or ``cc``; None if there is none."""
    return shutil.which(os.environ.get("CC", "cc"))


def solver_option_macros() -> list[str]:
    """Return compiler options that define the library's solver options as C macros."""
    return [f"-D{name.upper()}={getattr(DEFAULT_OPTIONS, name)!r}" for name in SHARED_OPTIONS]


@functools.cache
def compile_library(source: str, *options: str) -> ctypes.CDLL:
    """Compile a file in ``c/`` and return the loaded library.

    Raises
    ------
    UnavailableError
        If there is no compiler, or it fails.
    """
    command = find_c_compiler()
    if command is None:
        raise UnavailableError("no C compiler was found; install one, or name it with CC=...")
    target = _build_folder() / f"{Path(source).stem}{len(os.listdir(_build_folder()))}.so"
    arguments = [
        command,
        *COMPILER_OPTIONS,
        *solver_option_macros(),
        *options,
        str(SOURCE_FOLDER / source),
        "-o",
        str(target),
        "-lm",
        "-lpthread",
    ]
    process = subprocess.run(arguments, capture_output=True, text=True, check=False)
    if process.returncode != 0:
        raise UnavailableError(f"{source} could not be compiled: {process.stderr.strip().splitlines()[-1]}")
    return ctypes.CDLL(str(target))


class BodyProgram:
    """The step loop in C of one body, or of another system with its own source file.

    Parameters
    ----------
    source : str
        File in ``c/``.
    parameters : sequence of float
        The numbers of its ``Problem``, in order.
    options : str
        Further options of the compiler.
    """

    def __init__(self, source: str, parameters: Sequence[float], *options: str):
        self._library, self._parameters = compile_library(source, *options), np.array(parameters, dtype=float)

    def integrate(self, x0, step: float, steps: int, save_every: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Take ``steps`` steps from x0; return every n-th state, by default the last, and a record of
        :func:`c_run_record_dtype`."""
        save_every = steps if save_every is None else save_every
        x0 = np.ascontiguousarray(x0, dtype=float)
        saves, run = steps // save_every, np.zeros(1, c_run_record_dtype(len(x0)))
        states = np.empty((saves, len(x0)))
        self._library.integrate(
            _pointer(self._parameters),
            _pointer(x0),
            ctypes.c_double(step),
            ctypes.c_int64(saves),
            ctypes.c_int64(save_every),
            _pointer(states),
            _pointer(run),
        )
        _require_all_succeeded(run)
        return states, run


class EnsembleProgram:
    """The step loop in C of many rigid bodies, with SIMD lanes and threads; parameters as for rigid_body.c."""

    def __init__(self, parameters: Sequence[float]):
        self._library, self._parameters = compile_library("ensemble.c", "-Wno-psabi"), np.array(parameters, dtype=float)

    def integrate(self, x0s, step: float, steps: int, threads: int) -> np.ndarray:
        """Take ``steps`` steps from each of the x0s, shape (bodies, 3); return records of :data:`SUMMARY_DTYPE`."""
        x0s = np.ascontiguousarray(x0s, dtype=float)
        records = np.zeros(len(x0s), SUMMARY_DTYPE)
        self._library.integrate_ensemble(
            _pointer(self._parameters),
            _pointer(x0s),
            ctypes.c_int64(len(x0s)),
            ctypes.c_double(step),
            ctypes.c_int64(steps),
            ctypes.c_int64(threads),
            _pointer(records),
        )
        _require_all_succeeded(records)
        return records


class SpinRingProgram:
    """The step loop in C of a ring of spins with a bath, with OpenMP threads; parameters as for spins.c."""

    def __init__(self, parameters: Sequence[float]):
        self._library, self._parameters = compile_library("spins.c", "-fopenmp"), np.array(parameters, dtype=float)

    def integrate(self, x0, step: float, steps: int, threads: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after ``steps`` steps from x0, shape (3 count + 1,), and a record of :data:`RING_DTYPE`."""
        x, record = np.array(x0, dtype=float), np.zeros(1, RING_DTYPE)
        self._library.omp_set_num_threads(ctypes.c_int(threads))
        self._library.integrate_ring(
            _pointer(self._parameters),
            _pointer(x),
            ctypes.c_int64(len(x) // 3),
            ctypes.c_double(step),
            ctypes.c_int64(steps),
            _pointer(record),
        )
        _require_all_succeeded(record)
        return x, record


class HeunProgram:
    """The algorithm of VAMPIRE in C, on a periodic cube of spins with exchange and an easy axis along z.

    Parameters
    ----------
    edge : int
        Number of spins along an edge.
    exchange, axis, rate : float
        Constants of the exchange, of the axis, and of the damping.
    """

    def __init__(self, edge: int, exchange: float, axis: float, rate: float):
        self._library, self._parameters = compile_library("heun.c"), (exchange, axis, rate)
        index = np.arange(edge**3, dtype=np.int32).reshape(edge, edge, edge)
        shifted_indices = [np.roll(index, shift, axis=a) for a in range(3) for shift in (1, -1)]
        self._neighbours = np.ascontiguousarray(np.stack(shifted_indices, axis=-1).reshape(-1, len(shifted_indices)))

    def integrate(self, spins, step: float, steps: int, temperature: float = 0.0) -> np.ndarray:
        """Return the spins, shape (count, 3), after ``steps`` steps in a bath of this temperature."""
        x, (exchange, axis, rate) = np.array(spins, dtype=float).reshape(-1, 3), self._parameters
        amplitude = np.sqrt(2.0 * rate * temperature / ((1.0 + rate**2) * step))
        self._library.integrate_heun(
            _pointer(np.array([exchange, axis, rate, amplitude, self._neighbours.shape[1]])),
            _pointer(x),
            _pointer(self._neighbours),
            ctypes.c_int64(len(x)),
            ctypes.c_double(step),
            ctypes.c_int64(steps),
        )
        return x


@functools.cache
def _build_folder() -> Path:
    folder = tempfile.TemporaryDirectory(prefix="liethermo-benchmarks-")
    atexit.register(folder.cleanup)
    return Path(folder.name)


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def _require_all_succeeded(records: np.ndarray) -> None:
    worst_status = int(records["status"].max())
    if worst_status != 0:
        raise RuntimeError(f"a C program stopped early: {STATUSES[worst_status]}, after {records['steps'].min()} steps")
