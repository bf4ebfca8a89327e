"""The compiled engine: a user's plain functions at the speed of C, for small systems on the CPU.

The step equations of a method on a system are traced, unrolled to scalar programs (:mod:`.scalarize`), translated
(:mod:`.straight_line`) and placed before the step loop (:mod:`.step_loop`) in a module that numba compiles. The
system's parameters (the arrays among its leaves) stay arguments: a sweep compiles once. Modules are kept on disk under
the hash of their text, so that another process finds them compiled.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import itertools
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...integrators import OneStepMethod
from ...systems import System
from ...tracing.remembered import Latest, remembered
from ...tracing.scalarize import Program, scalarize
from .. import array
from ..array import State
from . import step_loop
from . import straight_line as straight_line_module
from .module_cache import load
from .straight_line import is_plain

VECTORS = {"x": "X", "low": "LOW", "k": "K", "before": "BEFORE"}

NUMBERS = {
    "energy": "ENERGY",
    "entropy": "ENTROPY",
    "status": "STATUS",
    "step": "STEP",
    "fixed_point": "FIXED_POINT",
    "newton": "NEWTONS",
    "most_iterations": "MOST",
    "residual": "RESIDUAL",
    "worst_residual": "WORST",
    "largest_energy": "HIGHEST",
    "smallest_energy": "LOWEST",
    "least_entropy_increment": "LEAST_RISE",
    "largest_energy_increment": "LARGEST_GAIN",
    "integral": "INTEGRAL",
    "first_energy": "FIRST_ENERGY",
    "energy_sensitivity": "ENERGY_SIZE",
    "entropy_sensitivity": "ENTROPY_SIZE",
}
"""The fields of :class:`.array.State`, and the rows that hold them in the step loop."""

WORK = """AFTER_ENERGY AFTER_ENTROPY CHECK AFTER_ENERGY_SIZE AFTER_ENTROPY_SIZE H SIZE UPDATE SLOPE PREVIOUS BEST
STALLED PHASE CHANGE TRIES CORRECTIONS NOISE"""
"""The other rows of one number."""

OF_NEWTON = ("DIRECTION", "CHANGES", "LINEAR")
"""What Newton's method works with, for one lane at a time: one after another in an array of its own."""

CONSTANTS = """FIXED_POINT_LIMIT FLOOR HALVINGS HARD IDLE ITERATING NEWTON_LIMIT NEWTON_REUSE NON_FINITE NOT_CONVERGED
PLATEAU SHRINKING SLOW SOLVED VANISHED"""


class CompiledEngine:
    """The compiled engine for one system and method: an :class:`..choice.Engine`, with the results of the array engine.

    Raises
    ------
    UnsupportedPrimitive
        If the system or the method uses what cannot be unrolled; of Newton's method, when a step first needs it.
    """

    name = "compiled"

    def __init__(self, system: System, method: OneStepMethod):
        self._stepper, self._parameters = stepper_for(system, method)

    @property
    def operations(self) -> int:
        """Of a step."""
        return self._stepper.operations

    def begin(self, x) -> State:
        return self._state(self._stepper.begin(self._parameters, np.asarray(x, dtype=np.float64)[None]))

    def advance(self, state: State, h, saves: int, every: int, capacity: int):
        del capacity  # nothing is compiled for a number of saves
        new, out = self._run(state, h, saves, every)
        reached = np.arange(saves) < (int(new.step) - int(state.step)) // every
        return new, (out[:, :-2], out[:, -2], out[:, -1], reached)

    def step(self, state: State, h) -> State:
        return self._run(state, h, 1, 1)[0]

    def _run(self, state: State, h, saves: int, every: int) -> tuple[State, np.ndarray]:
        blocks = self._stepper.blocks({name: np.asarray(getattr(state, name))[None] for name in (*VECTORS, *NUMBERS)})
        out = self._stepper.run(self._parameters, blocks, h, saves, every)[0]
        return self._state(blocks), out

    def _state(self, blocks: np.ndarray) -> State:
        fields: dict[str, Any] = {name: value[0] for name, value in self._stepper.fields(blocks).items()}
        return State(**fields)


class Stepper:
    """The step loop of one method on systems of one form, compiled; parameters are arguments.

    Parameters
    ----------
    form, own : Form
        Of the system and of the method.
    parameters : array, shape (p,)
        Those of one system and method of these forms. Zeros among them hold for all, unless they vary.
    method : OneStepMethod
    lanes : int
        Trajectories that advance together, a block.
    varies : array of bool, shape (p,)
        Which parameters are each trajectory's own.
    """

    def __init__(
        self, form: Form, own: Form, parameters: np.ndarray, method: OneStepMethod, lanes: int, varies: np.ndarray
    ):
        self.lanes = lanes
        system, size = form.build(parameters), form.size

        def both(p) -> tuple[System, OneStepMethod]:
            return form.build(p[:size]), own.build(p[size:])

        self._hard_steps = 0  # that have asked for Newton's method
        self._loops: dict[bool, Callable] = {}
        self._slow: ModuleType | None = None
        self._lock = threading.Lock()
        self._relaxing = int(system.energy_law != "nonincreasing")
        self._varies = varies
        self._known = np.where((parameters == 0.0) & ~varies, 0.0, np.nan)

        def prepare(x, k, before):
            return method.predict(k, before), jnp.max(jnp.abs(x))

        def iterate(p, x, low, h, k):
            system, method = both(p)
            new = method.slopes(system, x, low, h[0], k)
            return new, jnp.max(jnp.abs(new - k)), jnp.max(jnp.abs(new))

        def sound(p, x):
            return array.noise_of(both(p)[0], x)

        def along(p, x, low, h, k, direction):
            system, method = both(p)
            return method.change(system, x, low, h[0], k, direction)

        def finish(p, x, low, h, k, first_energy):
            return array.finish(*both(p), x, low, h[0], k, first_energy[0])

        def start(p, x):
            system, method = both(p)
            return method.start(system, x), *array.values(system, x), *array.sensitivities(system, x)

        n = system.dim
        self._shapes: dict[str, tuple[int, ...]] = dict.fromkeys([*NUMBERS.values(), *WORK.split()], (1,))
        self._shapes |= dict.fromkeys(("X", "LOW", "AFTER", "AFTER_LOW"), (n,))
        self._shapes |= dict.fromkeys(("K", "BEFORE", "GUESS", "NEW", "DIRECTION", "CHANGES"), (method.stages, n))
        self._shapes |= {"P": parameters.shape}

        step, end = "P X LOW H GUESS", "P X LOW H GUESS FIRST_ENERGY"
        after = "AFTER AFTER_LOW AFTER_ENERGY AFTER_ENTROPY CHECK AFTER_ENERGY_SIZE AFTER_ENTROPY_SIZE"
        # What an iteration needs and does not change is computed once a step.
        fixed, changing = self._traced(iterate, step).split([step.split().index("GUESS")])
        self._shapes["FIXED"] = fixed.shapes[0]
        self._programs: dict[str, list[_Piece]] = {
            "prepare": [
                _Piece(self._traced(prepare, "X K BEFORE"), "X K BEFORE", "GUESS SIZE"),
                _Piece(fixed, step, "FIXED"),
            ],
            "iterate": [_Piece(changing, f"{step} FIXED", "NEW UPDATE SLOPE")],
            "finish": [_Piece(self._traced(finish, end), end, after)],
        }
        self._start = self._traced(start, "P X")
        # Of a derivative, what is the same in every direction is computed once a Jacobian.
        self._derivative = lambda: self._traced(along, f"{step} DIRECTION").split([len(step.split())])
        self._sound = lambda: self._traced(sound, "P X")
        self._step_arguments = step

        sizes = {name: math.prod(shape) for name, shape in self._shapes.items()}
        sizes |= {"P": int(self._varies.sum()), "DIRECTION": 0, "CHANGES": 0}
        self._rows = dict(zip(sizes, itertools.accumulate(sizes.values(), initial=0), strict=False))
        self._height = sum(sizes.values())

    @property
    def operations(self) -> int:
        """Scalar operations of a step with one iteration."""
        pieces = itertools.chain.from_iterable(self._programs.values())
        return sum(len(piece.program.instructions) for piece in pieces)

    def _traced(self, function: Callable, arguments: str) -> Program:
        shapes = [jax.ShapeDtypeStruct(self._shapes[a], jnp.float64) for a in arguments.split()]
        known = [self._known if a == "P" else None for a in arguments.split()]
        return scalarize(jax.make_jaxpr(function)(*shapes), known)

    # -- trajectories in blocks -----------------------------------------------------------------------------------

    def begin(self, parameters, x: np.ndarray) -> np.ndarray:
        """Blocks, shape (blocks, rows * lanes), of trajectories about to start at x, shape (trajectories, n).

        ``parameters`` has shape (p,), or (trajectories, p) where some vary.
        """
        own = np.broadcast_to(parameters, (len(x), len(self._varies)))
        k, energy, entropy, *sizes = self._start.evaluate(own, x, batch=True)
        fields: dict[str, Any] = dict.fromkeys(NUMBERS, 0.0) | {"x": x, "low": 0.0, "k": k, "before": k}
        fields |= dict.fromkeys(("energy", "first_energy", "smallest_energy", "largest_energy"), energy)
        fields |= {"entropy": entropy, "energy_sensitivity": sizes[0], "entropy_sensitivity": sizes[1]}
        fields |= {"least_entropy_increment": np.inf, "largest_energy_increment": -np.inf}
        return self.blocks(fields, own)

    def blocks(self, fields: dict[str, Any], parameters=None) -> np.ndarray:
        """Blocks of trajectories with the given fields of :class:`.array.State`, trajectories first."""
        number, lanes = len(fields["x"]), self.lanes
        count = -(-number // lanes)
        blocks = np.zeros((count, self._height, lanes))

        def fill(first, values):
            rows = np.asarray(values, dtype=np.float64).reshape(number, -1)
            if number < count * lanes:  # some lanes stay empty
                rows = np.concatenate([rows, np.repeat(rows[-1:], count * lanes - number, axis=0)])
            blocks[:, first : first + rows.shape[1]] = rows.reshape(count, lanes, -1).swapaxes(1, 2)

        for name, row in {**VECTORS, **NUMBERS}.items():
            fill(self._rows[row], np.broadcast_to(fields[name], (number, *np.shape(fields[name])[1:])))
        if self._varies.any():
            fill(self._rows["P"], parameters[:, self._varies])
        blocks[-1, self._rows["STATUS"], lanes - (count * lanes - number) :] = EMPTY
        return blocks.reshape(count, -1)

    def fields(self, blocks: np.ndarray) -> dict[str, np.ndarray]:
        """The fields of :class:`.array.State`, trajectories first, those of empty lanes among them."""
        count = len(blocks)
        rows = blocks.reshape(count, self._height, self.lanes).swapaxes(1, 2).reshape(count * self.lanes, -1)

        def read(row, shape):
            return rows[:, self._rows[row] : self._rows[row] + math.prod(shape)].reshape(-1, *shape)

        vectors = {name: read(row, self._shapes[row]) for name, row in VECTORS.items()}
        return vectors | {name: rows[:, self._rows[row]] for name, row in NUMBERS.items()}

    def run(self, parameters, blocks: np.ndarray, h: float, saves: int, every: int) -> np.ndarray:
        """Advance blocks in place by ``saves * every`` steps of size h, or less where steps fail.

        Returns, at each save, every trajectory's state, energy and entropy: shape (trajectories, saves, n + 2), with
        those of empty lanes, and undefined after a failure.
        """
        n, lanes, count = self._shapes["X"][0], self.lanes, len(blocks)
        start = self._rows["H"] * lanes
        blocks[:, start : start + lanes] = h
        out, done = np.empty((count, saves, (n + 2) * lanes)), np.zeros(count, dtype=np.int64)
        while (hard := self._loop()(parameters, blocks, done, saves, every, out, saves * every)) < count:
            self._hard_steps += lanes
            if self._hard_steps <= SPELLED_OUT:
                one = slice(hard, hard + 1)
                with np.errstate(all="ignore"):
                    self._spelled_out().advance(parameters, blocks[one], done[one], saves, every, out[one], 1)
        return out.reshape(count, saves, n + 2, lanes).transpose(0, 3, 1, 2).reshape(count * lanes, saves, n + 2)

    # -- modules ------------------------------------------------------------------------------------------------------

    def _loop(self) -> Callable:
        """The function ``advance`` of the module, compiled or found compiled; with Newton's method where it pays."""
        newton = self._hard_steps > SPELLED_OUT
        with self._lock:
            if newton not in self._loops:
                self._loops[newton] = load(self._text(newton), self._try_out).advance
            return self._loops[newton]

    def _spelled_out(self) -> ModuleType:
        """The module with Newton's method, run by Python as it stands: a thousand times as slow, and there at once."""
        with self._lock:
            if self._slow is None:
                module = ModuleType("spelled_out")
                exec(compile(self._text(True, spelled_out=True), "<step>", "exec"), module.__dict__)
                self._slow = module
            return self._slow

    def _try_out(self, module: ModuleType) -> None:
        """Take no step, which compiles the loop or finds it compiled."""
        blocks, done = np.zeros((0, self._height * self.lanes)), np.zeros(0, dtype=np.int64)
        module.advance(np.zeros(self._shapes["P"]), blocks, done, 0, 1, np.zeros((0, 0, 0)), 0)

    def _text(self, newton: bool, spelled_out: bool = False) -> str:
        """The module; with Newton's method or without, to be compiled or to be run by Python."""
        lanes, n, m = self.lanes, self._shapes["X"][0], math.prod(self._shapes["K"])
        programs = dict(self._programs)
        size = self._add_derivative(programs) if newton else 0
        lines = ["import math", "", "import numpy as np", ""]
        if spelled_out:
            lines += ["njit = entry = lambda function: function"]
        else:
            lines += ["import numba", "", "from liethermo.engines.compiled.straight_line import straight_line", ""]
            lines += [f"# translated by {_translator()}"]
            options = "error_model='numpy', nogil=True, no_cfunc_wrapper=True"
            lines += [f"entry = numba.njit(cache=CACHE, {options})"]
            # inlined, programs keep their values in registers; with Newton's method there are too many calls for that
            lines += [f"njit = numba.njit({options}, no_cpython_wrapper=True, forceinline={not newton})"]
        lines += [f"N, M, LANES, NEWTON, LENGTH = {n}, {m}, {lanes}, {newton}, {2 * m + size}"]
        lines += [f"{name} = {getattr(step_loop, name)!r}" for name in CONSTANTS.split()]
        lines += [f"{name} = {row * lanes}" for name, row in self._rows.items()]
        lines += [f"RELAXING = {self._relaxing * lanes}"]
        for name, pieces in programs.items():
            looped = name not in ("linearise", "along")
            body = [line for i, piece in enumerate(pieces) for line in self._body(piece, f"_{i}")]
            plain = not spelled_out and all(is_plain(piece.program) for piece in pieces)
            lines += ["", "", *_function(name, body, looped, plain)]
        if not newton:
            lines += ["", "", "linearise = along = sound = njit(lambda p, w, l, v: None)"]
        return "\n".join(lines) + "\n\n\n" + _template()

    def _add_derivative(self, programs: dict[str, list[_Piece]]) -> int:
        """Add the programs of Newton's method; the length of what ``linearise`` hands to ``along``."""
        linear, along = self._derivative()
        (size,) = self._shapes["LINEAR"] = linear.shapes[0]
        arguments = f"{self._step_arguments} DIRECTION"
        programs["linearise"] = [_Piece(linear, arguments, "LINEAR")]
        programs["along"] = [_Piece(along, f"{arguments} LINEAR", "CHANGES")]
        programs["sound"] = [_Piece(self._sound(), "P X", "NOISE")]
        return size

    def _body(self, piece: _Piece, prefix: str) -> list[str]:
        return piece.program.body(self._cells(piece.arguments), self._cells(piece.results), prefix)

    def _cells(self, names: str) -> list[str]:
        """Where the entries of some arrays are found for lane l, as Python expressions."""
        cells, lanes, own = [], self.lanes, itertools.count(self._rows["P"])
        for name in names.split():
            size = math.prod(self._shapes[name])
            if name == "P":
                cells += [f"w[{next(own) * lanes} + l]" if v else f"p[{i}]" for i, v in enumerate(self._varies)]
            elif name in OF_NEWTON:
                cells += [f"v[{OF_NEWTON.index(name) * math.prod(self._shapes['K']) + i}]" for i in range(size)]
            else:
                cells += [f"w[{(self._rows[name] + i) * lanes} + l]" for i in range(size)]
        return cells


SPELLED_OUT = 300
"""Steps with Newton's method, times lanes, up to which it is not compiled: Python takes some milliseconds for one, and
the program of a derivative is long."""


class _Piece(NamedTuple):
    """A program, and the names of the arrays that it reads and writes."""

    program: Program
    arguments: str
    results: str


EMPTY = 9.0
"""Status of a lane without a trajectory."""


@dataclass(frozen=True)
class Form:
    """What systems, or methods, have in common that differ in their parameters.

    Attributes
    ----------
    key : hashable
        The same for the same form.
    shapes : tuple of shapes
        Of the parameters, which are arrays.
    rebuild : function from a list of arrays to one of them
    """

    key: Any
    shapes: tuple[tuple[int, ...], ...]
    rebuild: Callable[[list], Any] = field(compare=False)

    @classmethod
    def of(cls, system: System | OneStepMethod) -> Form:
        """The form of a system or method, its parameters being the arrays among its leaves."""
        dynamic, static = eqx.partition(system, eqx.is_inexact_array)
        leaves, structure = jax.tree_util.tree_flatten(dynamic)
        functions, outline = jax.tree_util.tree_flatten(static)
        return cls(
            (outline, tuple(functions)),
            tuple(np.shape(leaf) for leaf in leaves),
            lambda arrays: eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static),
        )

    @property
    def size(self) -> int:
        """How many numbers the parameters are."""
        return sum(map(math.prod, self.shapes))

    def build(self, p) -> Any:
        """The one with the parameters p, shape (size,), all arrays one after another."""
        ends = list(itertools.accumulate(map(math.prod, self.shapes)))
        arrays = [p[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, self.shapes, strict=True)]
        return self.rebuild(arrays)


STEPPERS = 128
"""Forms whose loops are held in memory."""

_steppers: Latest[Stepper] = Latest(STEPPERS)


def stepper_of(
    form: Form, parameters: np.ndarray, method: OneStepMethod, lanes: int = 1, varies: np.ndarray | None = None
) -> Stepper:
    """The stepper for systems of a form, and a method.

    Which of their parameters are zero belongs to it: a diagonal matrix makes a shorter program.

    Parameters
    ----------
    parameters : array, shape (p,)
        Of a system of that form, then of the method: see :func:`numbers_of`.
    """
    own, varies = Form.of(method), np.zeros(len(parameters), dtype=bool) if varies is None else varies
    known = (parameters == 0.0) & ~varies
    key = (form.key, form.shapes, own.key, own.shapes, known.tobytes(), lanes, varies.tobytes())
    return _steppers.find(key, lambda: Stepper(form, own, parameters, method, lanes, varies))


def numbers_of(tree: System | OneStepMethod) -> np.ndarray:
    """The parameters of a system or a method, shape (p,)."""
    leaves = jax.tree_util.tree_leaves(eqx.filter(tree, eqx.is_inexact_array))
    return np.concatenate([np.zeros(0), *(np.asarray(leaf, dtype=np.float64).ravel() for leaf in leaves)])


@remembered
def stepper_for(system: System, method: OneStepMethod) -> tuple[Stepper, np.ndarray]:
    """The stepper for one trajectory of a system, and the parameters of both."""
    parameters = np.concatenate([numbers_of(system), numbers_of(method)])
    return stepper_of(Form.of(system), parameters, method), parameters


def _function(name: str, body: list[str], looped: bool, plain: bool) -> list[str]:
    """A program as lines of a module: translated where it is plain, else left to numba."""
    arguments = "p, w, first, last" if looped else "p, w, l, v"
    if plain:
        text = "\n".join(body)
        yielded = [f"_{name} = straight_line({text!r}, {looped})"]
        return [*yielded, "", "", "@njit", f"def {name}({arguments}):", f"    _{name}({arguments})"]
    lines = ["for l in range(first, last):", *(f"    {line}" for line in body)] if looped else body
    return ["@njit", f"def {name}({arguments}):", *(f"    {line}" for line in lines or ["pass"])]


@functools.cache
def _translator() -> str:
    """What tells versions of the translation apart, whose machine code is not the same."""
    return hashlib.sha256(inspect.getsource(straight_line_module).encode()).hexdigest()[:12]


def _template() -> str:
    """The step loop, as the module :mod:`.step_loop` has it below its mark."""
    source = inspect.getsource(step_loop)
    return source[source.index("@njit\ndef settle") :]
