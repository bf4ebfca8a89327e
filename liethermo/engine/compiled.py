"""The compiled engine: a user's plain functions at the speed of C, for small systems on the CPU.

The step equations of a method on a system are traced, unrolled to scalar programs (:mod:`.scalarize`) and placed before
the step loop (:mod:`.step_loop`) in a module that numba compiles. The system's parameters (the arrays among its leaves)
stay arguments: a sweep compiles once. Modules are kept on disk under the hash of their text, so that another process
finds them compiled.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import inspect
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from ..systems import System
from . import array, step_loop
from .array import State
from .scalarize import Program, scalarize

COUNTS = ("status", "step", "fixed_point", "newton", "most_iterations")
ARRAYS = ("x", "low", "k", "before")
REALS = (
    "energy",
    "entropy",
    "residual",
    "worst_residual",
    "largest_energy",
    "smallest_energy",
    "least_entropy_increment",
    "largest_energy_increment",
)
"""The fields of :class:`.array.State` as the loop keeps them: arrays of their own, and numbers in two arrays."""

CONSTANTS = (
    "FIXED_POINT_LIMIT",
    "FLOOR",
    "NEEDS_NEWTON",
    "NEWTON_LIMIT",
    "NEWTON_REUSE",
    "NON_FINITE",
    "NOT_CONVERGED",
    "PLATEAU",
    "SHRINKING",
    "SLOW",
)

begin = array.begin


def advance(system: System, method: OneStepMethod, state: State, h, saves: int, every: int, capacity: int):
    """Up to ``saves`` times ``every`` steps of size h; as :func:`.array.advance`, and with the same result.

    Raises
    ------
    UnsupportedPrimitive
        If the system or the method uses what cannot be unrolled.
    """
    del capacity  # nothing is compiled for a number of saves
    stepper, parameters = stepper_for(system, method)
    arrays = {name: np.array(getattr(state, name), dtype=np.float64) for name in ARRAYS}
    counts = np.array([int(getattr(state, name)) for name in COUNTS])
    reals = np.array([float(getattr(state, name)) for name in REALS])
    out, origin = np.empty((saves, system.dim)), int(counts[1])
    for newton in (False, True):  # the module with a Jacobian is compiled only where a step asks for it
        loop = stepper.loop(newton or stepper.stiff)
        loop(parameters, float(h), origin, saves, every, *(a.reshape(-1) for a in arrays.values()), counts, reals, out)
        if counts[0] != step_loop.NEEDS_NEWTON:
            break
        stepper.stiff = True
    fields: dict[str, Any] = dict(arrays) | dict(zip((*COUNTS, *REALS), (*counts, *reals), strict=True))
    return State(**fields), (out, np.arange(saves) < (counts[1] - origin) // every)


class Stepper:
    """The step loop of one method on systems of one form, compiled; parameters are arguments.

    Attributes
    ----------
    stiff : bool
        Whether some step has asked for Newton's method: the loop then has it from the start.
    """

    def __init__(self, system: System, method: OneStepMethod):
        self.stiff = False
        self._loops: dict[bool, Callable] = {}
        self._n, self._m = system.dim, system.dim * method.stages
        dynamic, static = eqx.partition(system, eqx.is_inexact_array)
        leaves, structure = jax.tree_util.tree_flatten(dynamic)
        ends = np.cumsum([np.size(leaf) for leaf in leaves])

        def rebuilt(p):
            parts = [p[end - np.size(a) : end].reshape(np.shape(a)) for a, end in zip(leaves, ends, strict=True)]
            return eqx.combine(jax.tree_util.tree_unflatten(structure, parts), static)

        def slopes(p, x, low, h, k):
            return method.slopes(rebuilt(p), x, low, h[0], k)

        def misfit(p, x, low, h, k):
            flat = jax.jacfwd(lambda v: slopes(p, x, low, h, v.reshape(k.shape)).ravel() - v)
            return flat(k.ravel())

        def values(p, x):
            return jnp.concatenate([jnp.reshape(value, 1) for value in array.values(rebuilt(p), x)])

        n, s = self._n, method.stages
        self._specs: dict[str, tuple[Callable[..., Any], str, bool]] = {
            "slopes": (slopes, "p x low h k", True),
            "jacobian": (misfit, "p x low h k", True),
            "values": (values, "p x", True),
            "increment": (lambda h, k: method.increment(h[0], k), "h k", False),
            "predict": (method.predict, "k before", False),
        }
        self._shapes = {"x": (n,), "low": (n,), "h": (1,), "k": (s, n), "before": (s, n)}
        parameters = _parameters(dynamic)
        self._shapes["p"] = parameters.shape
        self._zeros = np.where(parameters == 0.0, 0.0, np.nan)

    def loop(self, newton: bool) -> Callable:
        """The function ``advance`` of the module, compiled or found compiled."""
        if newton not in self._loops:
            names = [name for name in self._specs if newton or name != "jacobian"]
            text = self._text({name: self.program(name) for name in names}, newton)
            self._loops[newton] = load(text, self._try_out).advance
        return self._loops[newton]

    def _try_out(self, module: ModuleType) -> None:
        """Take no step, which compiles the loop or finds it compiled."""
        state = [np.zeros(self._n), np.zeros(self._n), np.zeros(self._m), np.zeros(self._m)]
        numbers = np.zeros(len(COUNTS), dtype=np.int64), np.zeros(len(REALS))
        module.advance(np.zeros(self._shapes["p"]), 1.0, 0, 0, 1, *state, *numbers, np.zeros((0, self._n)))

    def program(self, name: str) -> Program:
        """One of the scalar programs: slopes, jacobian, values, increment or predict."""
        function, arguments, with_parameters = self._specs[name]
        shapes = [jax.ShapeDtypeStruct(self._shapes[a], jnp.float64) for a in arguments.split()]
        known = [self._zeros if a == "p" else None for a in arguments.split()] if with_parameters else None
        return scalarize(jax.make_jaxpr(function)(*shapes), known)

    def _text(self, programs: dict[str, Program], newton: bool) -> str:
        n, m = self._n, self._m
        lines = ["import math", "", "import numpy as np", "from numba import njit as compiled", ""]
        lines += ["njit = compiled(cache=CACHE, error_model='numpy')", f"N, M, NEWTON = {n}, {m}, {newton}"]
        lines += [f"{name} = {getattr(step_loop, name)!r}" for name in CONSTANTS]
        for name, program in programs.items():
            arguments = self._specs[name][1].split()
            sources = []
            for argument in arguments:
                size = int(np.prod(self._shapes[argument]))
                sources += ["h"] if argument == "h" else [f"{argument}[{i}]" for i in range(size)]
            targets = [f"out[{i // m}, {i % m}]" if name == "jacobian" else f"out[{i}]" for i in range(_size(program))]
            body = program.body(sources, targets)
            lines += ["", "", "@njit", f"def {name}({', '.join(arguments)}, out):", *(f"    {line}" for line in body)]
        if not newton:
            lines += ["", "", "@njit", "def jacobian(p, x, low, h, k, out):", "    return"]
        return "\n".join(lines) + "\n\n\n" + _template()


_steppers: dict[Any, Stepper] = {}


def stepper_for(system: System, method: OneStepMethod) -> tuple[Stepper, np.ndarray]:
    """The stepper for systems of this form, and the parameters of this one.

    The form is the structure of the system (its functions by identity) and which of its parameters are zero: a diagonal
    matrix makes a shorter program.
    """
    dynamic, static = eqx.partition(system, eqx.is_inexact_array)
    parameters = _parameters(dynamic)
    functions, structure = jax.tree_util.tree_flatten(static)
    shapes = tuple(np.shape(leaf) for leaf in jax.tree_util.tree_leaves(dynamic))
    key = (structure, tuple(functions), shapes, (parameters == 0.0).tobytes(), method)
    if key not in _steppers:
        _steppers[key] = Stepper(system, method)
    return _steppers[key], parameters


def _parameters(dynamic) -> np.ndarray:
    """All arrays among the leaves of a system, one after another."""
    leaves = [np.asarray(leaf, dtype=np.float64).ravel() for leaf in jax.tree_util.tree_leaves(dynamic)]
    return np.concatenate([np.zeros(0), *leaves])


def _size(program: Program) -> int:
    return sum(map(len, program.outputs))


def _template() -> str:
    """The step loop, as the module :mod:`.step_loop` has it below its mark."""
    source = inspect.getsource(step_loop)
    return source[source.index("@njit\ndef residual_size") :]


# -- modules on disk ----------------------------------------------------------------------------------------------


def cache_folder() -> Path:
    """Where compiled modules are kept: ``$LIETHERMO_CACHE``, or a folder under the user's cache directory."""
    named = os.environ.get("LIETHERMO_CACHE")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "liethermo"


def load(text: str, try_out: Callable[[ModuleType], None]) -> ModuleType:
    """The module with this text, compiled by ``try_out`` or found so on disk; from memory alone where that fails."""
    name = "liethermo_step_" + hashlib.sha256(text.encode()).hexdigest()[:24]
    try:
        module = _imported(name, _written(name, text.replace("CACHE", "True")))
        try_out(module)
        return module
    except Exception:  # a folder that cannot be written, a file that was damaged: numba raises what it meets
        sys.modules.pop(name, None)
        with contextlib.suppress(OSError):
            for file in cache_folder().glob(f"**/{name}*"):
                file.unlink()
    module = ModuleType(name)
    exec(compile(text.replace("CACHE", "False"), f"<{name}>", "exec"), module.__dict__)
    try_out(module)  # an error that is not the disk's shows here
    return module


def _written(name: str, text: str) -> Path:
    """The file of a module, which appears whole or not at all, so that a killed process leaves nothing broken."""
    folder = cache_folder()
    path = folder / f"{name}.py"
    if not (path.is_file() and path.read_text() == text):
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "w") as file:
                file.write(text)
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
    return path


def _imported(name: str, path: Path) -> ModuleType:
    if name in sys.modules:
        return sys.modules[name]
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    sys.modules[name] = module
    return module
