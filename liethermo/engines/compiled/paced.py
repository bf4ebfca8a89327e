"""Trajectories with steps of sizes of their own in the compiled engine."""

from __future__ import annotations

import numpy as np

from ...tracing.scalarize import UnsupportedPrimitive
from ..stepping import State
from .stepper import Stepper


class LanePaces:
    """Trajectories in lanes, each with a pace of its own, in place of :class:`..paced.ArrayPaces`.

    Parameters
    ----------
    stepper : Stepper
    first : array, shape (p,)
        The parameters of one of them, those of the method and the pacing among them.
    parameters : array, shape (p,) or (trajectories, p)
    x : array, shape (trajectories, n)
    t, stop, length : float
        See :func:`..pacing.begun`.
    """

    def __init__(self, stepper: Stepper, first, parameters, x: np.ndarray, t, stop, length):
        self.stepper, self.first, self.number = stepper, first, len(x)
        each = {name: np.full((len(x), 1), value) for name, value in (("t", t), ("stop", stop), ("length", length))}
        self.blocks = stepper.begin(parameters, x, 0, **each)

    def follow(self, most: int) -> None:
        self.stepper.run(self.first, self.blocks, 0.0, 1, most)

    def state(self) -> State:
        return self.stepper.state_in(self.blocks.copy())

    def attempts(self, most: int) -> dict[str, np.ndarray]:
        """Make so many attempts of the only trajectory, or fewer: see :meth:`..paced.ArrayPaces.attempts`."""
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
