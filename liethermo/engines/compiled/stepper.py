"""The compiled engine: a user's plain functions as machine code, for small systems on the CPU.

The steps of the array engine, for one system and method, are traced, unrolled to scalar programs (:mod:`liethermo.
tracing.scalarize`) and placed in a loop over steps (:mod:`.loop`) that LLVM compiles. The system's parameters (the
arrays among its leaves) stay arguments: a sweep compiles once. Machine code is kept on disk, so that another process
finds it.
"""

from __future__ import annotations

import functools
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...integrators import OneStepMethod
from ...integrators.fluctuating import driven_by, noise_dimension
from ...systems import System
from ...tracing.calls import deferred
from ...tracing.remembered import Latest
from ...tracing.scalarize import faults_reported, scalarize
from ..array import portion_of
from ..pacing import TOLD, Pace, Pacing, attempted, begun, shape_seen
from ..rules import RULES, Rules
from ..searching import NONE
from ..stages import Solved, by_newton
from ..stepping import State, equations, first_state, take_step
from .form import Form, numbers_of
from .loop import DEFERRED, HASTY_SIZE, Layout, Loops, Piece, step_loop
from .machine_code import MachineCode
from .newton import solver

FIELDS = State._fields
OWN = tuple(name for name in Pace._fields if name != "state")
"""Those of a pace beside them."""
GIVEN = ("dW", "x", "compensation", "h", "k", "before")
"""What it is given."""
SOLVED = ("converged", "defined", "residual", "newton", "noise", "k")
"""What Newton's method may make better of :class:`..stages.Solved`."""


class CompiledEngine:
    """The compiled engine for one system and method: its results are those of the array engine.

    Raises
    ------
    UnsupportedPrimitive
        If the system or the method uses what cannot be unrolled; of Newton's method, when a step first needs it.
    """

    name = "compiled"

    def __init__(self, system: System, method: OneStepMethod, rules: Rules = RULES, planned: int = 0):
        self._parameters, self.portion, self._planned = numbers_of(system, method), portion_of(system), planned
        self._form, self._method, self._rules = Form.of(system), method, rules

    @functools.cached_property
    def _stepper(self) -> Stepper:
        """Its loop of steps, made when it is first needed: a run with a pace has one of its own."""
        return stepper_of(self._form, self._parameters, self._method, rules=self._rules)

    def paced(self, pacing: Pacing) -> tuple[Stepper, np.ndarray]:
        """The stepper of a run with a pace, and its parameters."""
        whole = np.append(self._parameters, numbers_of(pacing))
        return stepper_of(self._form, whole, self._method, pacing, rules=self._rules), whole

    @property
    def operations(self) -> int:
        """How many scalar operations a step takes."""
        return self._stepper.operations

    def begin(self, x) -> State:
        return self._state(self._stepper.begin(self._parameters, np.asarray(x, dtype=np.float64)[None], self._planned))

    def advance(self, state: State, h, saves: int, every: int, noise=None):
        new, out = self._run(state, h, saves, every, noise)
        reached = np.arange(saves) < (int(new.step) - int(state.step)) // every
        return new, (out[:, :-2], out[:, -2], out[:, -1], reached)

    def step(self, state: State, h, noise=None) -> State:
        return self._run(state, h, 1, 1, noise)[0]

    def ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        blocks = self._stepper.begin(self._parameters, x)
        self._stepper.run(self._parameters, blocks, h, 1, 1)
        found = self._stepper.fields(blocks, ("x", "status"))
        return np.where(found["status"].reshape(-1, 1) == 0.0, found["x"], np.nan)

    def _run(self, state: State, h, saves: int, every: int, noise) -> tuple[State, np.ndarray]:
        blocks = self._stepper.block_of(state)
        out = self._stepper.run(self._parameters, blocks, h, saves, every, None if noise is None else noise[None])[0]
        return self._state(blocks), out

    def _state(self, blocks: np.ndarray) -> State:
        return self._stepper.state_in(blocks)


class Stepper:
    """The step loop of one method on systems of one form, compiled; parameters are arguments.

    With a pacing a step is an attempt, whose size the loop chooses.

    Parameters
    ----------
    forms : sequence of Form
        Of the system and of the method, and of the pacing where there is one.
    parameters : array, shape (p,)
        Those of one of each, one after another. Zeros among them hold for all, unless they vary.
    method : OneStepMethod
    pacing : Pacing or None
    lanes : int
        Trajectories that advance together, a block.
    varies : array of bool, shape (p,)
        Which parameters are each trajectory's own.

    Attributes
    ----------
    names : tuple of str
        The fields of a trajectory.
    begins, given : tuple of str
        The input of a run besides its x, and what a step is given besides the fields.
    kept : tuple of str
        The fields that are written down at each save.
    """

    def __init__(
        self,
        forms: Sequence[Form],
        parameters: np.ndarray,
        method: OneStepMethod,
        pacing: Pacing | None,
        lanes: int,
        varies: np.ndarray,
        rules: Rules,
    ):
        self.lanes, self._rules, self._varies = lanes, rules, varies
        self._known = np.where((parameters == 0.0) & ~varies, 0.0, np.nan)
        self._lock = threading.Lock()
        self._newton: MachineCode | None = None
        self._forms = forms
        system = forms[0].build(parameters[: forms[0].size])
        n, slopes = system.dim, jax.eval_shape(lambda x: method.start(system, x), jnp.zeros(system.dim)).shape
        self._shapes: dict[str, tuple[int, ...]] = {"x": (n,), "compensation": (n,), "k": slopes, "p": parameters.shape}
        self._shapes |= {
            "before": (0 if method.explicit else method.stages, slopes[1]),
            "dW": (noise_dimension(method),),
        }
        self.names: tuple[str, ...] = FIELDS if pacing is None else (*FIELDS, *OWN)
        self.kept = ("x", "energy", "entropy") if pacing is None else TOLD
        self.begins = () if pacing is None else ("t", "stop", "length")
        self.given = ("p", "dW", "h") if pacing is None else ("p", "dW")
        if pacing is not None:
            self._shapes |= {"seen": shape_seen(system, method, pacing), "search": NONE.shape}
        step = self._piece(self.step, (*self.given, *self.names), self.names)
        if method.explicit:
            changing = [i for i, a in enumerate(step.arguments) if a not in ("p", "h")]
            step = step._replace(program=step.program.factored(changing))
        begin = self._piece(self.begun, ("p", "x", *self.begins), self.names)
        self._pieces = {"step": step, "begin": begin}
        handed = 0 if method.explicit else sum(math.prod(self.shape(name)) for name in (*SOLVED, *GIVEN))
        names = (*self.names, *self.begins, *self.given[1:])
        shapes = {name: self.shape(name) for name in names} | {"p": (int(varies.sum()),), DEFERRED: (handed,)}
        self._layout = Layout(shapes)
        rows, sizes = self._layout.rows, self._layout.sizes
        self._places = [(rows[name], rows[name] + sizes[name], self.shape(name)) for name in FIELDS]
        state = [name for name in (*self.names, "h") if name in rows]
        make = functools.partial(step_loop, self._pieces, self._layout, state, varies, lanes, self.kept)
        self._code = Loops(make, lanes == 1 and self.operations <= HASTY_SIZE)

    # -- what is compiled -----------------------------------------------------------------------------------------

    def built(self, p) -> list[Any]:
        """System and method, and pacing, with the parameters p."""
        ends = itertools.accumulate(form.size for form in self._forms)
        return [form.build(p[end - form.size : end]) for form, end in zip(self._forms, ends, strict=True)]

    def begun(self, p, x, *times) -> tuple:
        """The fields of a run about to start at x."""
        system, method, *way = self.built(p)
        if not way:
            return first_state(system, method, x)
        pace = begun(system, method, way[0], x, *times)
        return *pace.state, *pace[1:]

    def step(self, p, dW, *given) -> tuple:
        """The fields after a step, or an attempt, from its size and those before, or these alone."""
        system, method, *way = self.built(p)
        if not way:
            h, *fields = given
            return take_step(system, driven_by(method, dW), State(*fields), h, self._rules, self._second(dW))
        before = Pace(State(*given[: len(FIELDS)]), *given[len(FIELDS) :])
        pace = attempted(system, method, way[0], before, self._rules, self._second(dW))
        return *pace.state, *pace[1:]

    def _second(self, dW) -> Callable:
        """Newton's method, for :func:`..stepping.take_step`: a program of its own, compiled when a step needs it."""

        def second(first: Solved, *given) -> Solved:
            handed = [1.0 * getattr(first, name) for name in SOLVED]
            found = deferred.bind(*handed, dW, *(jnp.asarray(a) for a in given), results=len(SOLVED))
            solved = first._replace(**dict(zip(SOLVED, found, strict=True)))
            return solved._replace(converged=solved.converged > 0.0, defined=solved.defined > 0.0)

        return second

    def _by_newton(self, p, handed) -> tuple:
        """What takes the place of what is handed over."""
        system, method, *_ = self.built(p)
        shapes = [self.shape(name) for name in (*SOLVED, *GIVEN)]
        ends = itertools.accumulate(map(math.prod, shapes))
        parts = [handed[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, shapes, strict=True)]
        dW, x, compensation, h, k, before = parts[len(SOLVED) :]
        own = equations(system, driven_by(method, dW), x, compensation, h, k, before, self._rules, jax.lax.map)
        found = by_newton(own, self._rules)
        return tuple(1.0 * getattr(found, name) for name in SOLVED)

    @property
    def operations(self) -> int:
        """Scalar operations of a step with one iteration."""
        return self._pieces["step"].program.size

    def _piece(self, function: Callable, names: Sequence[str], results: Sequence[str] = ()) -> Piece:
        shapes = [jax.ShapeDtypeStruct(self.shape(a), jnp.float64) for a in names]
        known = [self._known if a == "p" else None for a in names]
        return Piece(scalarize(jax.make_jaxpr(function)(*shapes), known), tuple(names), tuple(results))

    # -- trajectories in blocks -----------------------------------------------------------------------------------

    def begin(self, parameters, x: np.ndarray, planned: int = 0, **fields: np.ndarray) -> np.ndarray:
        """Blocks, shape (blocks, rows * lanes), of trajectories about to start at x, shape (trajectories, n).

        ``parameters`` has shape (p,), or (trajectories, p) where some vary; so many steps are ``planned``.
        """
        blocks = self.blocks({"x": x, **fields}, parameters)
        first = np.ascontiguousarray(parameters if np.ndim(parameters) == 1 else parameters[0], dtype=np.float64)
        status = self.part(blocks, "status")
        empty = status == EMPTY
        self._code.functions(0, planned)[0](first.ctypes.data, blocks.ctypes.data, len(blocks))
        status[empty] = EMPTY
        return blocks

    def part(self, blocks: np.ndarray, name: str | None = None) -> np.ndarray:
        """A field of blocks, or all rows of them, shape (blocks, entries, lanes)."""
        whole = blocks.reshape(len(blocks), self.height, self.lanes)
        return whole if name is None else whole[:, self.rows(name)]

    @property
    def height(self) -> int:
        """How many rows a trajectory has."""
        return self._layout.height

    def rows(self, name: str) -> slice:
        """Those of a field."""
        first = self._layout.rows[name]
        return slice(first, first + self._layout.sizes[name])

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a field of one trajectory."""
        return self._shapes.get(name, ())

    def blocks(self, fields: dict[str, Any], parameters=None) -> np.ndarray:
        """Blocks of trajectories with the given fields, trajectories first; nothing else is set but their status."""
        if self._varies.any() and "p" not in fields:
            fields = fields | {"p": parameters[:, self._varies]}
        number = len(fields["x"])
        whole = np.empty((-(-number // self.lanes), self.height, self.lanes))
        whole[:, self.rows("status")] = 0.0
        for name, values in fields.items():
            whole[:, self.rows(name)] = self._in_lanes(np.reshape(values, (number, -1)))
        return self._marked(whole, number)

    def block_of(self, state: State) -> np.ndarray:
        """The only block of a trajectory by itself."""
        whole = np.zeros((1, self.height))
        row = whole[0]
        for (first, end, shape), value in zip(self._places, state, strict=True):
            if shape:
                row[first:end].reshape(shape)[...] = value
            else:
                row[first] = value
        return whole

    def state_in(self, blocks: np.ndarray) -> State:
        """The state in the only block of a trajectory by itself."""
        row = blocks[0]
        return State(*(row[first:end].reshape(shape) if shape else row[first] for first, end, shape in self._places))

    def of_rows(self, whole: np.ndarray) -> np.ndarray:
        """Blocks of trajectories from all their rows, shape (trajectories, rows)."""
        return self._marked(np.ascontiguousarray(self._in_lanes(whole)), len(whole))

    def _in_lanes(self, rows: np.ndarray) -> np.ndarray:
        """Rows of trajectories, shape (trajectories, m), as (blocks, m, lanes); the last one fills empty lanes."""
        count = -(-len(rows) // self.lanes)
        if empty := count * self.lanes - len(rows):
            rows = np.concatenate([rows, np.repeat(rows[-1:], empty, axis=0)])
        return rows.reshape(count, self.lanes, -1).swapaxes(1, 2)

    def _marked(self, whole: np.ndarray, number: int) -> np.ndarray:
        """Blocks, shape (blocks, rows, lanes), of so many trajectories, their empty lanes marked; each in one row."""
        used = number - (len(whole) - 1) * self.lanes
        whole[-1, self._layout.rows["status"], used:] = EMPTY
        return whole.reshape(len(whole), -1)

    def fields(self, blocks: np.ndarray, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Fields of trajectories, trajectories first, those of empty lanes among them."""
        found, number = {}, len(blocks) * self.lanes
        for name in self.names if names is None else names:
            values = self.part(blocks, name).swapaxes(0, 1)
            found[name] = values.reshape(-1, number).T.reshape(number, *self.shape(name))
        return found

    def run(
        self, parameters, blocks: np.ndarray, h: float | np.ndarray, saves: int, every: int, noise=None, out=None
    ) -> np.ndarray:
        """Advance blocks in place by ``saves * every`` steps of size h, or less where steps fail.

        The size is one for all, or one for each lane, those of empty ones among them.
        ``noise`` has the increments, shape (trajectories, steps, increments), of a method that is driven by any.

        Returns, at each save, what is :attr:`kept` of every trajectory: shape (trajectories, saves, width), with those
        of empty lanes, and undefined after a failure. It is written to ``out``, if there is one.
        """
        lanes, count, width = self.lanes, len(blocks), self.width
        if "h" in self._layout.rows:
            self.part(blocks, "h")[:, 0] = np.reshape(h, (-1, lanes)) if np.ndim(h) else h
        parameters = np.ascontiguousarray(parameters, dtype=np.float64)
        out = np.empty((count, saves, width * lanes)) if out is None else out
        done = np.zeros(count, dtype=np.int64)
        saves, every = int(saves), int(every)
        arguments = [parameters.ctypes.data, blocks.ctypes.data, done.ctypes.data, count, saves, every]
        increments = self._in_blocks(noise, count, saves * every)
        arguments += [out.ctypes.data, saves * every, increments.ctypes.data]
        solve = 0 if self._newton is None else self._solver()
        _, advance = self._code.functions(count * saves * every)
        while advance(*arguments, solve) < count:
            solve = self._solver()
        return out.reshape(count, saves, width, lanes).transpose(0, 3, 1, 2).reshape(count * lanes, saves, width)

    def kept_of_one(self, out: np.ndarray) -> dict[str, np.ndarray]:
        """By name what is kept of a trajectory that is a block by itself, from rows of ``out``."""
        ends = np.cumsum([self._layout.sizes[name] for name in self.kept])
        parts = np.split(out, ends[:-1], axis=-1)
        return {name: part.reshape(len(out), *self.shape(name)) for name, part in zip(self.kept, parts, strict=True)}

    @property
    def width(self) -> int:
        """Numbers that are kept of a trajectory at each save."""
        return sum(self._layout.sizes[name] for name in self.kept)

    def _in_blocks(self, noise: np.ndarray | None, count: int, steps: int) -> np.ndarray:
        """Increments as the loop reads them, shape (blocks, steps, increments, lanes)."""
        if noise is None or not self._shapes["dW"][0]:
            return np.zeros((count, steps, self._shapes["dW"][0], self.lanes))
        padded = np.zeros((count * self.lanes, steps, self._shapes["dW"][0]))
        padded[: len(noise)] = noise
        return np.ascontiguousarray(padded.reshape(count, self.lanes, steps, -1).transpose(0, 2, 3, 1))

    # -- machine code -------------------------------------------------------------------------------------------------

    def _solver(self) -> int:
        """The address of Newton's method, which is compiled when a step first needs it."""
        with self._lock, faults_reported():
            if self._newton is None:
                self._shapes[DEFERRED] = (self._layout.sizes[DEFERRED],)
                program = self._piece(self._by_newton, ("p", DEFERRED)).program
                self._newton = solver(program, self._layout, self._varies, self.lanes)
            return self._newton.address("solve")


EMPTY = 9.0
"""Status of a lane without a trajectory."""

STEPPERS = 128
"""Forms whose loops are held in memory."""

_steppers: Latest[Any] = Latest(STEPPERS)


def stepper_of(
    form: Form,
    parameters: np.ndarray,
    method: OneStepMethod,
    pacing: Pacing | None = None,
    lanes: int = 1,
    varies: np.ndarray | None = None,
    rules: Rules = RULES,
) -> Stepper:
    """The stepper for systems of a form, a method, and a pacing.

    Which of their parameters are zero belongs to it: a diagonal matrix makes a shorter program.

    Parameters
    ----------
    parameters : array, shape (p,)
        Of a system of that form, of the method, and of the pacing: see :func:`numbers_of`.
    """
    forms = [form, Form.of(method), *([] if pacing is None else [Form.of(pacing)])]
    varies = np.zeros(len(parameters), dtype=bool) if varies is None else varies
    known = ((parameters == 0.0) & ~varies).tobytes(), varies.tobytes()
    key = *((form.key, form.shapes) for form in forms), *known, lanes, rules
    return _steppers.find(key, lambda: Stepper(forms, parameters, method, pacing, lanes, varies, rules))
