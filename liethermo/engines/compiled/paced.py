"""Steps of sizes of their own in the compiled engine: the loop of :mod:`.stepper`, a pass being an attempt."""

from __future__ import annotations

import numpy as np

from ...integrators import OneStepMethod
from ...systems import System
from ...tracing.scalarize import UnsupportedPrimitive
from ..pacing import TOLD, Pace, Pacing, attempted, begun, shape_seen
from ..rules import RULES, Rules
from ..searching import NONE
from ..stepping import State
from .form import Form, numbers_of
from .stepper import FIELDS, Stepper, key_of, remembered_stepper

OWN = tuple(name for name in Pace._fields if name != "state")
NAMES = (*FIELDS, *OWN)


class PacedStepper(Stepper):
    """The loop of one method, with steps chosen in one way, on systems of one form.

    Parameters
    ----------
    form, own, way : Form
        Of the system, the method and the pacing; their parameters lie one after another.
    seen : tuple of int
        The shape of what a pace knows of the motion nearby.
    others
        As for :class:`.stepper.Stepper`.
    """

    names, kept = NAMES, TOLD
    begins, given = ("t", "stop", "length"), ("p", "dW")

    def __init__(self, form: Form, own: Form, way: Form, parameters, method, seen: tuple, lanes, varies, rules):
        self._way, self._skip, self._seen = way, form.size + own.size, seen
        super().__init__(form, own, parameters, method, lanes, varies, rules)

    def shape(self, name: str) -> tuple[int, ...]:
        return {"seen": self._seen, "search": NONE.shape}.get(name) or super().shape(name)

    def begun(self, p, x, *others) -> tuple:
        return split(begun(*self.both(p), self._way.build(p[self._skip :]), x, *others))

    def step(self, p, dW, *fields) -> tuple:
        """The fields after an attempt."""
        pace = Pace(State(*fields[: len(FIELDS)]), *fields[len(FIELDS) :])
        pacing = self._way.build(p[self._skip :])
        return split(attempted(*self.both(p), pacing, pace, self._rules, self._second(dW)))


def split(pace: Pace) -> tuple:
    return *pace.state, *pace[1:]


def paced_stepper_of(
    form: Form,
    parameters: np.ndarray,
    method: OneStepMethod,
    pacing: Pacing,
    lanes: int = 1,
    varies: np.ndarray | None = None,
    rules: Rules = RULES,
) -> tuple[PacedStepper, np.ndarray]:
    """The stepper for systems of a form, a method and a pacing, and the parameters of all three.

    ``parameters`` and ``varies`` are those of system and method.
    """
    own, way = Form.of(method), Form.of(pacing)
    varies = np.zeros(len(parameters), dtype=bool) if varies is None else varies
    whole = np.append(parameters, numbers_of(pacing))
    varies = np.append(varies, np.zeros(len(whole) - len(varies), dtype=bool))

    def make() -> PacedStepper:
        seen = shape_seen(form.build(parameters), method, pacing)
        return PacedStepper(form, own, way, whole, method, seen, lanes, varies, rules)

    return remembered_stepper(key_of((form, own, way), whole, varies, lanes, rules), make), whole


class LanePaces:
    """Trajectories in lanes, each with a pace of its own: :class:`..paced.ManyPaces`, or :class:`..paced.OnePace`.

    Parameters
    ----------
    stepper : PacedStepper
    first : array, shape (p,)
        The parameters of one of them, those of the method and the pacing among them.
    parameters : array, shape (p,) or (trajectories, p)
    x : array, shape (trajectories, n)
    t, stop, length : float
        See :func:`..pacing.begun`.
    """

    def __init__(self, stepper: PacedStepper, first, parameters, x: np.ndarray, t, stop, length):
        self.stepper, self.first, self.number = stepper, first, len(x)
        each = {name: np.full((len(x), 1), value) for name, value in (("t", t), ("stop", stop), ("length", length))}
        self.blocks = stepper.begin(parameters, x, 0, **each)

    def follow(self, most: int) -> None:
        self.stepper.run(self.first, self.blocks, 0.0, 1, most)

    def state(self) -> State:
        return self.stepper.state_in(self.blocks.copy())

    def attempts(self, most: int) -> dict[str, np.ndarray]:
        """Make so many attempts of the only trajectory, or fewer: see :class:`..paced.OnePace`."""
        before, out = self.read("tried")[0], np.empty((1, most, self.stepper.width))
        try:
            self.stepper.run(self.first, self.blocks, 0.0, most, 1, out=out)
        except UnsupportedPrimitive:
            if self.read("tried")[0] == before:
                raise
        return self.stepper.kept_of_one(out[0, : int(self.read("tried")[0] - before)])

    def read(self, name: str, chosen: np.ndarray | slice = slice(None)) -> np.ndarray:
        if isinstance(chosen, slice):
            return self.stepper.fields(self.blocks, (name,))[name][: self.number][chosen].copy()
        values = self._rows(chosen, name)
        return values if name == "p" else values.reshape(len(chosen), *self.stepper.shape(name))

    def write(self, name: str, chosen: np.ndarray, values) -> None:
        block, lane = np.divmod(chosen, self.stepper.lanes)
        self.stepper.part(self.blocks, name)[block, :, lane] = np.broadcast_to(values, chosen.shape)[:, None]

    def _rows(self, chosen: np.ndarray, name: str | None = None) -> np.ndarray:
        """A field of some of them, or all that is known of them, shape (trajectories, rows)."""
        block, lane = np.divmod(chosen, self.stepper.lanes)
        return self.stepper.part(self.blocks, name)[block, :, lane]

    def only(self, chosen: np.ndarray) -> None:
        """Go on with some of them."""
        self.blocks, self.number = self.stepper.of_rows(self._rows(chosen)), len(chosen)


def paced_stepper_for(system: System, method: OneStepMethod, pacing: Pacing) -> tuple[PacedStepper, np.ndarray]:
    """The stepper for one trajectory of a system, and the parameters of all three."""
    return paced_stepper_of(Form.of(system), numbers_of(system, method), method, pacing)


def lane_pace(
    system: System, method: OneStepMethod, pacing: Pacing, x, t: float, stop: float, length: float
) -> LanePaces:
    """One trajectory, a block by itself."""
    stepper, whole = paced_stepper_for(system, method, pacing)
    return LanePaces(stepper, whole, whole, np.asarray(x, dtype=np.float64)[None], t, stop, length)
