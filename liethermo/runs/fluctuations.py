"""Noise of a run: how large it is, and the random numbers of every step, found by counting."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..dissipation.noise import factor_residuals
from ..errors import InputError
from ..functions.energy import Energy, make_energy
from ..integrators import MetriplecticMidpoint, OneStepMethod
from ..integrators.fluctuating import add_noise
from ..systems import System
from ..systems.check import AXIOM_TOLERANCE, CheckReport, CheckRow
from ..tracing.interpret import evaluate_at_points
from .threefry import derive_key, grid_seeds, normal_numbers, split_words
from .timetable import StepSchedule

MAX_STANDARD_DEVIATIONS = 6.0
"""Standard deviations that no random number exceeds, so that the equation of a step keeps a solution: one in 5e8 would,
and to cut it off changes their variance by 1e-8."""


@dataclass(frozen=True)
class Fluctuations:
    """Noise that belongs to the dissipation: ``dx = (Pi dH + K dS + k div K) dt + sqrt(2 k) B dW``, ``B B^T = K``.

    Where the dissipation keeps the energy, every path has the energy of its start, exactly. The measure that the states
    tend to is ``exp(S / k)`` on that level of the energy, and of whatever else motion and noise keep. That holds where
    the motion keeps volumes, as on duals of unimodular algebras and in canonical coordinates. With a ``temperature``,
    for dissipations that lower the energy (:class:`DoubleBracket`, :class:`Friction`), it is ``exp(-H / (k T))``: that
    of a body in a bath, Langevin's equation.

    The random numbers of a step are functions of the seed, the number of the trajectory, the time at which the step
    starts, and its length. They do not depend on the engine, on what is saved, or on how a run or an ensemble is
    divided up. A normal number is cut off at six standard deviations.

    A run may go on in parts: ``integrate(system, run.x[-1], (run.t[-1], t2), step, noise=noise)``, with the same noise
    and the same step. Where the parts end at ends of steps of the whole run, they are the whole run. That is so to the
    bit where nothing depends on time, and to rounding where an energy or a torque does. The times may be rounded in
    different ways, as ``0.1 * 13`` and ``1.3`` are, if they are large by no more than 1e12 steps. Parts that end within
    a step, or have another step, are another path, with random numbers that are independent of those before. Two runs
    of the same seed, trajectory, step and times have the same noise: independent ones need different seeds.

    Parameters
    ----------
    boltzmann : float, >= 0
        k, in the units of the entropy: how large fluctuations are. Zero is the run without noise, to the bit.
    seed : int, >= 0; or one for every trajectory of an ensemble, no two alike
        The seed of the random numbers.
    temperature : float, >= 0, optional
        The temperature of the bath (energy / entropy), for dissipations that lower the energy.
    density : function from a state to a number, optional
        The logarithm of the density of the measure that the motion keeps (dimensionless), if that is not volume. The
        states tend to its product with the measure above.
    first : int, >= 0
        Number of the first trajectory: ``first=i`` of a single run is trajectory i of an ensemble.
    """

    boltzmann: float = 1.0
    seed: int | Sequence[int] = 0
    temperature: float | None = None
    density: Callable | Energy | None = None
    first: int = 0

    def __post_init__(self):
        _check_nonnegative("boltzmann", self.boltzmann)
        if self.temperature is not None:
            _check_nonnegative("the temperature", self.temperature)
        seeds = self.seeds
        for name, numbers, bits in (("seed", seeds, 63), ("first", [self.first], 31)):
            whole = all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in numbers)
            if not (whole and all(0 <= n < 2**bits for n in numbers)):
                raise InputError(f"{name} is an integer from 0 to 2^{bits} - 1, not {getattr(self, name)!r}")
        if len(set(seeds)) < len(seeds):
            again = next(seed for i, seed in enumerate(seeds) if seed in seeds[:i])
            places = [i for i, seed in enumerate(seeds) if seed == again]
            raise InputError(
                f"the seed {again} is given to the trajectories {places[0]} and {places[1]}: they would have the same "
                "noise. One seed for all is enough, the numbers of the trajectories set them apart"
            )

    @property
    def seeds(self) -> list[int]:
        """One, or one for each trajectory."""
        return list(self.seed) if isinstance(self.seed, list | tuple | np.ndarray) else [self.seed]  # type: ignore[list-item]

    def grid_seeds(self, places: Sequence[np.ndarray]) -> np.ndarray:
        """A seed for each point of a grid with these places along its axes: see :class:`liethermo.Study`."""
        return grid_seeds(self.seeds[0], places)

    def of(self, i: int) -> Fluctuations:
        """The noise of one trajectory of an ensemble."""
        return replace(self, first=self.first + i) if len(self.seeds) == 1 else replace(self, seed=self.seeds[i])

    def check(self, system: System, samples: int = 8, seed: int = 0, scale: float = 1.0) -> CheckReport:
        """Test at random points that there is such noise, and that the motion keeps the measure; prints as a table.

        The rows are ``B B^T = K``; ``B^T grad H = 0``; of columns that are stated to have no divergence that they have
        none; and, without a verdict, how far the motion is from keeping volume, or the ``density``: where it does not,
        the measure of the class's description is not the one that the states tend to.
        """
        self.method_with_noise(system, DEFAULT_NOISE_METHOD)
        points = system.samples(samples, seed, scale)
        density = None if self.density is None else make_energy(self.density, "the density")
        measured = evaluate_at_points(_noise_residuals, (system, density), points)
        inside = np.isfinite(measured[MEASURE_ROW])
        if not inside.any():
            raise InputError(f"energy or dissipation is not finite at any of the {len(points)} test points")
        rows = []
        for name, values in measured.items():
            worst = float(values[inside].max())
            judged = name != MEASURE_ROW
            note = "" if judged or worst <= AXIOM_TOLERANCE else "no: what the states tend to is not known"
            rows.append(CheckRow(name, worst, AXIOM_TOLERANCE, worst <= AXIOM_TOLERANCE if judged else None, note))
        return CheckReport(tuple(rows), int(inside.sum()))

    def as_provenance(self) -> dict[str, Any]:
        """For the provenance of a run."""
        density = None if self.density is None else getattr(self.density, "__name__", str(self.density))
        return {**vars(self), "seed": self.seeds if len(self.seeds) > 1 else self.seeds[0], "density": density}

    def method_with_noise(self, system: System, method: OneStepMethod) -> OneStepMethod:
        """The method for steps with this noise; itself where there is none."""
        if not self.boltzmann:
            return method
        density = None if self.density is None else make_energy(self.density, "the density")
        return add_noise(system, method, self.boltzmann, self.temperature, density)

    def consecutive_increments(
        self, increments: int, members: np.ndarray, first: int, steps: int, h: float
    ) -> np.ndarray:
        """Return increments of consecutive steps of size h of a run that begins at time 0, from step ``first`` on.

        Shape (trajectories, steps, increments).
        """
        return self.increments(increments, members, (first + np.arange(steps)) * h, h, h)

    def increments(
        self, count: int, trajectories: np.ndarray, starts: np.ndarray, length: float, step: float
    ) -> np.ndarray:
        """Return increments of the Wiener processes in steps of one length, shape (trajectories, steps, count).

        They depend on the seed, the trajectory, the start and the length of each step alone: see :func:`step_cells`.

        Parameters
        ----------
        count : int
            Wiener processes.
        trajectories : array of int, shape (trajectories,)
            Numbers of trajectories.
        starts : array, shape (steps,)
            The times at which the steps start.
        length : float, > 0
            The length of these steps (time).
        step : float, > 0
            The step of the run (time): the length of all steps but those that are shortened to end at a given time.
        """
        if len(self.seeds) == 1:
            seeds, numbers = np.array(self.seeds), trajectories + self.first
        else:
            seeds, numbers = np.asarray(self.seeds)[trajectories], np.full(len(trajectories), self.first)
        halvings, cells = step_cells(starts, length, step)
        highs, lows = split_words(cells)
        values = np.empty((len(trajectories), len(cells), count))
        for high in np.unique(highs):
            key = derive_key(_step_key(step_code(step), halvings, int(high)), split_words(seeds), (numbers, 0))
            values[:, highs == high] = normal_numbers(key, lows[highs == high], count)
        return np.sqrt(length) * np.clip(values, -MAX_STANDARD_DEVIATIONS, MAX_STANDARD_DEVIATIONS)


CELLS_PER_STEP = 64
"""Cells of time in a step: steps that start in the same cell are the same step."""

CELL_EDGE_FRACTION = 0.5 * (math.sqrt(5.0) - 1.0)
"""Where in its cell a multiple of the cell's length lies, as a share of that: the golden section, which is as far as
possible from all simple fractions. In a run that starts at a simple fraction of a step, no step starts near the edge of
a cell, where rounding would decide between two cells."""


def step_cells(starts, length: float, step: float) -> tuple[int, np.ndarray]:
    """Return integers that name steps by their times: one for their length, and one for each start, shape (steps,).

    Times are counted in units of the ``step`` of the run, so that in a run that starts at a multiple of it the starts
    are integers, but for their rounding. Each is put into a cell, 64 cells a step, whose edges are far from integers
    and simple fractions. So a start that is rounded in another way, such as ``0.1 * 13`` for ``1.0 + 0.1 * 3``, is in
    the same cell, as long as the rounding of times is less than a two hundredth of a step. In shorter steps cells are
    shorter, by as many halvings as the first integer says: no two steps of a path have the same integers.
    """
    halvings = 1 - math.frexp(2.0 * CELL_EDGE_FRACTION * length / step)[1]
    cells = np.floor(np.asarray(starts) / step * (CELLS_PER_STEP * 2.0**halvings) + CELL_EDGE_FRACTION)
    return halvings, cells.astype(np.int64)


def step_code(step: float) -> int:
    """Return an integer that names the step of a run by its first 32 bits, rounded where few numbers lie halfway.

    Steps such as ``(t1 - t0) / 10``, which differ in their last bits, have the same one.
    """
    mantissa, exponent = math.frexp(step)
    return (exponent << 31) + math.floor((mantissa - 0.5) * 2.0**32 + CELL_EDGE_FRACTION)


@functools.lru_cache(256)
def _step_key(code: int, halvings: int, high: int) -> tuple[np.ndarray, np.ndarray]:
    """The key of all steps whose cells have these high words, shape (1,): found once for many calls."""
    return derive_key(split_words([0]), split_words([code]), ([halvings], [high]))


MEASURE_ROW = "the motion keeps the measure"


def _noise_residuals(model: tuple[System, Energy | None], x):
    system, density = model
    assert system.dissipation is not None

    def motion(y):
        return system.poisson.sharp(y, system.energy.gradient(y))

    parts = system.divergence_terms(x, lambda y, alpha: jnp.dot(alpha, motion(y)))
    if density is not None:
        parts = jnp.append(parts, jnp.dot(density.gradient(x), motion(x)))
    size = jnp.max(jnp.abs(parts)) + jnp.max(jnp.abs(motion(x))) / (1.0 + jnp.max(jnp.abs(x)))
    own = {MEASURE_ROW: jnp.abs(jnp.sum(parts)) / jnp.where(size > 0.0, size, 1.0)}
    return factor_residuals(system.dissipation, system, x) | own


@dataclass(frozen=True)
class NoisePaths:
    """The noise of trajectories with the given numbers, shape (B,), along the course of a run."""

    noise: Fluctuations
    n_increments: int
    trajectory_numbers: np.ndarray
    schedule: StepSchedule

    def step_increments(self, chosen: slice | np.ndarray, first: int, steps: int, h) -> np.ndarray:
        """Return the increments of steps of size h, from the one after ``first`` steps of the run on."""
        starts = self.schedule.times_after(first + np.arange(steps))
        return self.noise.increments(
            self.n_increments, self.trajectory_numbers[chosen], starts, float(h), self.schedule.h
        )


def check_noise(noise, members: int = 1) -> None:
    """Raise InputError unless this is noise for so many trajectories, or none."""
    if noise is not None and not isinstance(noise, Fluctuations):
        raise InputError(f"noise is lt.Fluctuations(boltzmann, seed), not {noise!r}")
    if noise is not None and len(noise.seeds) not in (1, members):
        raise InputError(f"{len(noise.seeds)} seeds for {members} trajectories: give one, or one for each")


DEFAULT_NOISE_METHOD = MetriplecticMidpoint()
"""The method of runs with noise where none is named."""


def _check_nonnegative(what: str, value) -> None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what} is one number, not {value!r}") from None
    if not (0.0 <= number < np.inf):
        raise InputError(f"{what} must be finite and >= 0, not {number:g}")
