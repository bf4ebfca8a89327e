"""Thermal noise of a run: its amplitude, and the random numbers of every step by a counter-based generator."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arguments import is_integer
from manifolds._class_members import ListedType

from ..dissipation.geometry import divergence_summands_of_fields
from ..dissipation.noise import factor_property_residuals
from ..errors import InputError
from ..functions.conditions import host_number
from ..functions.energy import Energy, make_energy
from ..integrators import MetriplecticMidpoint, OneStepMethod
from ..integrators.fluctuating import stochastic_method
from ..systems import System
from ..systems.check import AXIOM_TOLERANCE, CheckReport, CheckRow
from ..tracing.interpret import evaluate_at_points
from ..tracing.short_form import callable_name
from .schedule import StepSchedule

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
"""Rotation distances of the rounds, in bits, from the definition of Threefry-2x32."""
PARITY = np.uint32(0x1BD11BDA)
"""Parity constant of the key schedule, from the definition of Threefry."""

VALUES_PER_BLOCK = 1 << 15
"""Number of random numbers generated at once, small enough for the cache."""


def threefry(key, counter) -> tuple[np.ndarray, np.ndarray]:
    """Return two words of 32 random bits for each key and counter, by the cipher Threefry-2x32.

    Keys and counters are pairs of arrays of uint32, whose shapes broadcast.
    """
    words = (*key, PARITY ^ key[0] ^ key[1])
    x, y = counter[0] + words[0], counter[1] + words[1]
    for group in range(5):
        for rotation in ROTATIONS[group % 2]:
            x = x + y
            y = (y << np.uint32(rotation) | y >> np.uint32(32 - rotation)) ^ x
        x, y = x + words[(group + 1) % 3], y + words[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def grid_seeds(seed: int, grid_indices: Sequence[np.ndarray]) -> np.ndarray:
    """Return a seed below 2^63 for each grid point, from one seed and the indices along each axis, shape (points,)."""
    count = len(grid_indices[0]) if grid_indices else 1
    key = np.full(count, seed >> 32, np.uint32), np.full(count, seed & 0xFFFFFFFF, np.uint32)
    for axis, axis_indices in enumerate(grid_indices):
        key = threefry(key, (np.asarray(axis_indices).astype(np.uint32), np.full(count, axis, np.uint32)))
    return (key[0].astype(np.int64) & 0x7FFFFFFF) << 32 | key[1].astype(np.int64)


def derive_key(key, *counters) -> tuple[np.ndarray, np.ndarray]:
    """Return the key derived from ``key`` by a chain of counters, each encrypted with the key derived so far."""
    for counter in counters:
        key = threefry(key, tuple(np.asarray(word).astype(np.uint32) for word in counter))
    return key


def high_and_low_words(integers) -> tuple[np.ndarray, np.ndarray]:
    """Return the high and low 32 bits of 64-bit integers, negative ones in two's complement."""
    integers = np.asarray(integers).astype(np.int64).view(np.uint64)
    return (integers >> np.uint64(32)).astype(np.uint32), integers.astype(np.uint32)


def normal_numbers_of_steps(keys, step_counters: np.ndarray, n_numbers_per_step: int) -> np.ndarray:
    """Return normal random numbers for each key and step, shape (keys, steps, n_numbers_per_step).

    Parameters
    ----------
    keys : two arrays of uint32, shape (keys,)
    step_counters : array of uint32, shape (steps,)
    n_numbers_per_step : int
    """
    numbers = np.empty((len(keys[0]), len(step_counters), n_numbers_per_step))
    value_indices = np.arange(n_numbers_per_step, dtype=np.uint32)
    steps_per_block = max(1, VALUES_PER_BLOCK // max(n_numbers_per_step, 1))
    keys_per_block = max(1, steps_per_block // max(len(step_counters), 1))
    for i in range(0, len(numbers), keys_per_block):
        block_keys = keys[0][i : i + keys_per_block, None, None], keys[1][i : i + keys_per_block, None, None]
        for start in range(0, len(step_counters), steps_per_block):
            high_words, low_words = threefry(
                block_keys, (step_counters[start : start + steps_per_block, None], value_indices)
            )
            bits = high_words.astype(np.uint64) << np.uint64(32) | low_words
            values = scipy.special.ndtri(((bits >> np.uint64(11)) + 0.5) * 2.0**-53)
            numbers[i : i + keys_per_block, start : start + steps_per_block] = values
    return numbers


MAX_STANDARD_DEVIATIONS = 6.0
"""Largest absolute value of a normal random number, so that the equation of a step keeps a solution. One number in 5e8
exceeds it; clipping changes the variance by 1e-8."""


@dataclass(frozen=True)
class Fluctuations(metaclass=ListedType):
    """Thermal noise that matches the dissipation: ``dx = (Pi dH + K dS + k div K) dt + sqrt(2 k) B dW`` with ``B B^T =
    K``.

    If the dissipation conserves the energy, every path has exactly its initial energy. The equilibrium measure is then
    ``exp(S / k)`` on this energy level, and on the levels of all other functions that motion and noise conserve. This
    holds if the motion preserves volume, as on duals of unimodular algebras and in canonical coordinates. With a
    ``temperature``, for dissipations that lower the energy (:class:`DoubleBracket`, :class:`Friction`), the equilibrium
    measure is ``exp(-H / (k T))``, as for a body in a bath (Langevin's equation).

    The random numbers of a step are functions of the seed, the number of the trajectory, and the start and length of
    the step. They do not depend on the engine, on the saved states, or on the division of a run or an ensemble into
    parts. Normal numbers are clipped at six standard deviations.

    A run can be continued by ``integrate(system, run.x[-1], (run.t[-1], t2), step, noise=noise)`` with the same noise
    and step. If the parts end at ends of steps, they are equal to the whole run: to the bit if nothing depends on time,
    to rounding if an energy or a torque does. The times may be rounded differently, as ``0.1 * 13`` and ``1.3`` are, up
    to 1e12 steps. Parts that end inside a step, or that have another step, follow another path with independent random
    numbers. Two runs with equal seed, trajectory, step and times have the same noise, so independent runs need
    different seeds.

    Parameters
    ----------
    boltzmann : float, >= 0
        k, in the units of the entropy, which sets the size of the fluctuations. With zero the run has no noise, to the
        bit.
    seed : int, >= 0; or one for every trajectory of an ensemble, all different
        The seed of the random numbers.
    temperature : float, >= 0, optional
        The temperature of the bath (energy / entropy), for dissipations that lower the energy.
    density : function from a state to a number, optional
        The logarithm of the density of the measure that the motion preserves (dimensionless), if that is not volume.
        The equilibrium measure is its product with the measure above.
    first : int, >= 0
        Number of the first trajectory: ``first=i`` of a single run is trajectory i of an ensemble.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.5)
    >>> noise = lt.Fluctuations(boltzmann=0.1, seed=1)
    >>> run = lt.integrate(
    ...     body, [0.5, 0.5, 1.0], (0.0, 10.0), 0.05, lt.MetriplecticMidpoint(), noise=noise
    ... )
    >>> bool(abs(run.energy - run.energy[0]).max() < 1e-12)
    True
    """

    boltzmann: float = 1.0
    seed: int | Sequence[int] = 0
    temperature: float | None = None
    density: Callable | Energy | None = None
    first: int = 0

    def __post_init__(self):
        _require_nonnegative_number("boltzmann", self.boltzmann)
        if self.temperature is not None:
            _require_nonnegative_number("the temperature", self.temperature)
        seeds = self.seeds
        for name, numbers, bits in (("seed", seeds, 63), ("first", [self.first], 31)):
            are_integers = all(is_integer(n) for n in numbers)
            if not (are_integers and all(0 <= n < 2**bits for n in numbers)):
                raise InputError(f"{name} must be an integer from 0 to 2^{bits} - 1, got {getattr(self, name)!r}")
        if len(set(seeds)) < len(seeds):
            duplicate = next(seed for i, seed in enumerate(seeds) if seed in seeds[:i])
            indices = [i for i, seed in enumerate(seeds) if seed == duplicate]
            raise InputError(
                f"trajectories {indices[0]} and {indices[1]} have the same seed {duplicate}, so they would have the "
                "same noise. Give one seed for all; each trajectory then has noise of its own"
            )

    @property
    def seeds(self) -> list[int]:
        """List of the seeds: one for all trajectories, or one each."""
        return list(self.seed) if isinstance(self.seed, list | tuple | np.ndarray) else [self.seed]  # type: ignore[list-item]

    def grid_seeds(self, grid_indices: Sequence[np.ndarray]) -> np.ndarray:
        """Return a seed for each point of a grid, shape (points,), from its ``grid_indices`` along each axis."""
        return grid_seeds(self.seeds[0], grid_indices)

    def of(self, i: int) -> Fluctuations:
        """Return the noise of trajectory i of an ensemble."""
        return replace(self, first=self.first + i) if len(self.seeds) == 1 else replace(self, seed=self.seeds[i])

    def check(self, system: System, samples: int = 8, seed: int = 0, scale: float = 1.0) -> CheckReport:
        """Test at random points that the noise exists and that the motion conserves the measure; the report prints as a
        table.

        The rows test ``B B^T = K``, then ``B^T grad H = 0``, then that columns of B declared divergence-free are so.
        The last row does not pass or fail: it is the rate at which the motion changes volume, or the measure of
        ``density``. If it is not zero, the states tend to another measure than the one in the description of the class.
        """
        self.method_with_noise(system, DEFAULT_NOISE_METHOD)
        points = system.samples(samples, seed, scale)
        density = None if self.density is None else make_energy(self.density, "the density")
        residuals = evaluate_at_points(_noise_and_measure_residuals, (system, density), points)
        is_finite = np.isfinite(residuals[MEASURE_ROW])
        if not is_finite.any():
            raise InputError(
                f"energy or dissipation is not finite at any of the {len(points)} test points. Give another scale="
            )
        rows = []
        for name, values in residuals.items():
            max_residual = float(values[is_finite].max())
            has_verdict = name != MEASURE_ROW
            note = "" if has_verdict or max_residual <= AXIOM_TOLERANCE else "no: the equilibrium measure is unknown"
            rows.append(
                CheckRow(
                    name, max_residual, AXIOM_TOLERANCE, max_residual <= AXIOM_TOLERANCE if has_verdict else None, note
                )
            )
        return CheckReport(tuple(rows), int(is_finite.sum()))

    def to_provenance(self) -> dict[str, Any]:
        """Return the noise as data for the provenance of a run."""
        density = None if self.density is None else callable_name(self.density, str(self.density))
        return {**vars(self), "seed": self.seeds if len(self.seeds) > 1 else self.seeds[0], "density": density}

    def method_with_noise(self, system: System, method: OneStepMethod) -> OneStepMethod:
        """Return the method whose steps add this noise, or ``method`` itself if ``boltzmann`` is zero."""
        if not self.boltzmann:
            return method
        density = None if self.density is None else make_energy(self.density, "the density")
        return stochastic_method(system, method, self.boltzmann, self.temperature, density)

    def increments_of_equal_steps(
        self, n_increments: int, trajectory_numbers: np.ndarray, first_step: int, n_steps: int, h: float
    ) -> np.ndarray:
        """Return Wiener increments, shape (trajectories, n_steps, n_increments), of equal steps of a run from time 0.

        The ``n_steps`` steps of size h begin after ``first_step`` steps; ``trajectory_numbers`` selects trajectories.
        """
        return self.increments(n_increments, trajectory_numbers, (first_step + np.arange(n_steps)) * h, h, h)

    def increments(
        self, count: int, trajectories: np.ndarray, starts: np.ndarray, length: float, step: float
    ) -> np.ndarray:
        """Return increments of the Wiener processes in steps of one length, shape (trajectories, steps, count).

        The increments depend only on the seed, the trajectory, the start and the length of each step:
        see :func:`integer_codes_of_step_times`.

        Parameters
        ----------
        count : int
            Number of Wiener processes.
        trajectories : array of int, shape (trajectories,)
            Numbers of the trajectories.
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
        halvings, cells = integer_codes_of_step_times(starts, length, step)
        high_words, low_words = high_and_low_words(cells)
        values = np.empty((len(trajectories), len(cells), count))
        for high_word in np.unique(high_words):
            key = derive_key(
                _random_key_of_steps(integer_code_of_step_size(step), halvings, int(high_word)),
                high_and_low_words(seeds),
                (numbers, 0),
            )
            values[:, high_words == high_word] = normal_numbers_of_steps(key, low_words[high_words == high_word], count)
        return np.sqrt(length) * np.clip(values, -MAX_STANDARD_DEVIATIONS, MAX_STANDARD_DEVIATIONS)


CELLS_PER_STEP = 64
"""Number of time cells in a step; steps that start in the same cell share their random numbers."""

CELL_EDGE_FRACTION = 0.5 * (math.sqrt(5.0) - 1.0)
"""Position of a multiple of the cell length inside its cell, as a fraction of that length. The golden section is as far
as possible from all simple fractions. In a run that starts at a simple fraction of a step, no step starts near the edge
of a cell, where rounding would decide between two cells."""


def integer_codes_of_step_times(step_starts, step_length: float, run_step: float) -> tuple[int, np.ndarray]:
    """Return integers that identify steps by their times: one for their length, and one for each start, shape (steps,).

    Times are counted in units of ``run_step``. If the run starts at a multiple of it, the starts are
    integers up to rounding. Each start is assigned to a cell, 64 cells per step, whose edges are far from integers and
    simple fractions. So a start that is rounded differently, such as ``0.1 * 13`` for ``1.0 + 0.1 * 3``, is in the same
    cell, as long as the rounding of times is below 1/200 of a step. For shorter steps the cells are halved, as often as
    the first integer says. So no two steps of a path have the same integers.
    """
    halvings = 1 - math.frexp(2.0 * CELL_EDGE_FRACTION * step_length / run_step)[1]
    cells = np.floor(np.asarray(step_starts) / run_step * (CELLS_PER_STEP * 2.0**halvings) + CELL_EDGE_FRACTION)
    return halvings, cells.astype(np.int64)


def integer_code_of_step_size(step_size: float) -> int:
    """Return an integer that identifies the step size of a run by the first 32 bits of its mantissa and its exponent.

    Steps such as ``(t1 - t0) / 10``, which differ in their last bits, have equal codes.
    """
    mantissa, exponent = math.frexp(step_size)
    return (exponent << 31) + math.floor((mantissa - 0.5) * 2.0**32 + CELL_EDGE_FRACTION)


@functools.lru_cache(256)
def _random_key_of_steps(run_step_code: int, halvings: int, high_word: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the key of the generator for all steps whose time cells have this high word, two arrays of shape (1,)."""
    return derive_key(high_and_low_words([0]), high_and_low_words([run_step_code]), ([halvings], [high_word]))


MEASURE_ROW = "the motion keeps the measure"
"""Name of the report row that judges the conservation of the measure."""


def _noise_and_measure_residuals(model: tuple[System, Energy | None], x):
    """Return the residuals of the noise factor and of the conservation of the measure at x, by name."""
    system, density = model

    def motion(y):
        return system.poisson.sharp(y, system.energy.gradient(y))

    terms = divergence_summands_of_fields(system, x, lambda y, alpha: jnp.dot(alpha, motion(y)))
    if density is not None:
        terms = jnp.append(terms, jnp.dot(density.gradient(x), motion(x)))
    scale = jnp.max(jnp.abs(terms)) + jnp.max(jnp.abs(motion(x))) / (1.0 + jnp.max(jnp.abs(x)))
    measure_residual = {MEASURE_ROW: jnp.abs(jnp.sum(terms)) / jnp.where(scale > 0.0, scale, 1.0)}
    return factor_property_residuals(system.total_dissipation, system, x) | measure_residual


@dataclass(frozen=True)
class NoisePaths:
    """Wiener increments of the trajectories with given numbers, shape (B,), along the schedule of a run."""

    noise: Fluctuations
    n_increments: int
    trajectory_numbers: np.ndarray
    schedule: StepSchedule

    def step_increments(self, members: slice | np.ndarray, first_step: int, n_steps: int, h) -> np.ndarray:
        """Return the Wiener increments of steps ``first_step`` to ``first_step + n_steps - 1``, all of size h.

        The shape is (members, n_steps, n_increments).
        """
        starts = self.schedule.times_after(first_step + np.arange(n_steps))
        return self.noise.increments(
            self.n_increments, self.trajectory_numbers[members], starts, float(h), self.schedule.h
        )


def check_noise(noise, n_trajectories: int = 1) -> None:
    """Raise InputError unless ``noise`` is None, or Fluctuations with one seed for all trajectories or one for each."""
    if noise is not None and not isinstance(noise, Fluctuations):
        raise InputError(f"noise must be lt.Fluctuations(boltzmann, seed), got {noise!r}")
    if noise is not None and len(noise.seeds) not in (1, n_trajectories):
        raise InputError(
            f"noise has {len(noise.seeds)} seeds for {n_trajectories} trajectories. Give one seed, or one each"
        )


DEFAULT_NOISE_METHOD = MetriplecticMidpoint()
"""Default method of runs with noise."""


def _require_nonnegative_number(name: str, value) -> None:
    """Raise InputError unless a value is a finite number >= 0."""
    number = host_number(value, name)
    if not (0.0 <= number < np.inf):
        raise InputError(f"{name} must be finite and >= 0, got {number:g}")
