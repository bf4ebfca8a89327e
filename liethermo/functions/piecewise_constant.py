"""Functions of time that are constant between given times."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from .conditions import checked_numbers
from .time_span import FunctionWithBreaks, checked_breaks


class PiecewiseConstant(FunctionWithBreaks):
    """A function of time that is constant between given times and zero outside, such as a train of pulses.

    At a time where it jumps it has its value from after the jump. The steps of a run end at these times.

    Parameters
    ----------
    times : sequence of float, length m
        Increasing times of the jumps. They are no parameters of a system: they decide where steps end.
    values : array, shape (m - 1, ...)
        The values between two of the times.

    Raises
    ------
    InputError
        If the times do not increase, or there is not one value for each interval.

    Examples
    --------
    >>> pulses = lt.PiecewiseConstant([2.0, 2.5, 7.0], [1.0, -1.0])
    >>> [float(pulses(t)) for t in (1.0, 2.0, 3.0, 7.0)]
    [0.0, 1.0, -1.0, 0.0]
    """

    times: tuple[float, ...] = eqx.field(static=True)
    values: jax.Array

    def __init__(self, times, values):
        self.times, self.values = checked_breaks(times), checked_numbers(values, "values")
        if self.times != tuple(np.asarray(times, dtype=np.float64)) or self.values.shape[:1] != (len(self.times) - 1,):
            raise InputError(
                "PiecewiseConstant needs increasing times and one value for each interval between two of them, got "
                f"{len(times)} times and values of shape {self.values.shape}"
            )

    @property
    def break_times(self) -> tuple[float, ...]:
        return self.times

    def __call__(self, t) -> jax.Array:
        has_begun = jnp.where(t >= jnp.asarray(self.times), 1.0, 0.0)
        is_in_interval = has_begun[:-1] - has_begun[1:]  # 1 for the interval that contains t, else 0
        return jnp.tensordot(is_in_interval, self.values, 1)
