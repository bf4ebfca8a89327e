"""The classical Heisenberg magnet through its transition, by noise and by Monte Carlo; Binder's crossing."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

import liethermo as lt

from ..heat_bath import sample_heat_bath
from ..report import Report, Table, Target

CRITICAL_TEMPERATURE = 1.4429
"""Of ``E = -J sum s_i . s_j`` on the simple cubic lattice, in units of J [Chen, Ferrenberg & Landau 1993]: the inverse
of 0.693035(37)."""

CRITICAL_CUMULANT = 0.6217
"""Binder's cumulant of a cube with periodic sides at the transition [Holm & Janke 1993]."""

RATE, STEP = 2.0, 0.025

STEPS_BY_LENGTH = {6: (50_000,), 8: (100_000,), 12: (64_000,), 16: (70_000,), 24: (60_000,), 32: (40_000, 28_000)}
"""Steps of the runs at the transition, by the number of sites along an edge."""

STEP_SHARE_BY_TEMPERATURE = {1.30: 0.4, 1.37: 0.2, 1.50: 0.5, 1.60: 0.2}
"""Other temperatures, and the share of the steps there, where the spins are less slow."""

STEPS_PER_RUN, SAVE_EVERY, SWEEPS_BY_LENGTH = 2000, 20, {8: 6000, 12: 4000, 16: 3000, 24: 1200, 32: 800}


MIN_CROSSING_BLOCKS = 20
"""Blocks of a run from which the error of a crossing is known: of fewer the slope of a cumulant is too uncertain."""


@dataclass(frozen=True)
class Series:
    """Energy a spin and magnetisation vector along a run in equilibrium, shape (n, 4)."""

    generator: str
    length: int
    temperature: float
    steps: int
    steps_per_row: int
    samples: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        return self.samples[:, 0]

    @property
    def squared_magnetisation(self) -> np.ndarray:
        return (self.samples[:, 1:] ** 2).sum(axis=1)

    @property
    def autocorrelation_time(self) -> float:
        """The integrated time of m², in rows, up to a window of six of it [Sokal 1997]."""
        return integrated_autocorrelation(self.squared_magnetisation)

    @property
    def all_indices(self) -> np.ndarray:
        """The places of all rows."""
        return np.arange(len(self.samples))

    def equilibrated(self) -> Series:
        """Without the beginning: a twentieth, and eight times the autocorrelation, if that is no more than half."""
        n = len(self.samples)
        skipped = max(n // 20, min(n // 2, int(8 * integrated_autocorrelation(self.squared_magnetisation[n // 10 :]))))
        return replace(self, samples=self.samples[skipped:])

    def jackknife_blocks(self) -> list[np.ndarray]:
        """Rows in blocks of at least eight autocorrelation times, four to forty of them."""
        count = int(np.clip(len(self.samples) / (8 * self.autocorrelation_time), 4, 40))
        return np.array_split(self.all_indices, count)


def integrated_autocorrelation(x: np.ndarray) -> float:
    x = x - x.mean()
    spectrum = np.fft.rfft(x, 2 * len(x))
    found = np.fft.irfft(spectrum * spectrum.conj())[: len(x)]
    total = 0.5
    for lag, value in enumerate(found[1:] / found[0], start=1):
        total += value
        if lag > 6 * total:
            break
    return float(total)


def magnetisation(series: Series, chosen) -> float:
    return float(np.sqrt(series.squared_magnetisation[chosen]).mean())


def specific_heat(series: Series, chosen) -> float:
    return float(series.energy[chosen].var() * series.length**3 / series.temperature**2)


def binder_cumulant(series: Series, chosen) -> float:
    """``1 - <m^4> / 3 <m^2>^2``."""
    square = series.squared_magnetisation[chosen]
    return float(1.0 - (square**2).mean() / (3.0 * square.mean() ** 2))


def with_error(quantity, series: Series) -> tuple[float, float]:
    """A quantity and its standard error, from the blocks left out one after another."""
    return quantity(series, series.all_indices), float(
        np.sqrt(jackknife_variance(lambda chosen: quantity(series, chosen), series))
    )


def jackknife_variance(quantity, series: Series) -> float:
    """That of a function of the chosen rows of a series, from the blocks left out one after another."""
    left = [quantity(np.delete(series.all_indices, block)) for block in series.jackknife_blocks()]
    return float((len(left) - 1) * np.var(left))


def cumulant_slope(series: Series, chosen) -> float:
    """The derivative of the cumulant by the temperature, from how m² and m⁴ fluctuate with the energy."""
    energy, square = series.energy[chosen] * series.length**3, series.squared_magnetisation[chosen]
    second, fourth = square.mean(), (square**2).mean()
    changes = [((x - x.mean()) * energy).mean() / series.temperature**2 for x in (square, square**2)]
    return float((2.0 * fourth * changes[0] / second - changes[1]) / (3.0 * second**2))


def cumulant_crossing(a: Series, b: Series) -> tuple[float, float]:
    """Where the cumulants of two lattices are equal, from runs at one temperature, and its standard error.

    Each is a straight line through its value there.
    """
    temperature = a.temperature

    def at(of_a, of_b) -> float:
        apart = binder_cumulant(a, of_a) - binder_cumulant(b, of_b)
        return temperature - apart / (cumulant_slope(a, of_a) - cumulant_slope(b, of_b))

    by_a = jackknife_variance(lambda of_a: at(of_a, b.all_indices), a)
    by_b = jackknife_variance(lambda of_b: at(a.all_indices, of_b), b)
    return at(a.all_indices, b.all_indices), float(np.sqrt(by_a + by_b))


def join_runs(runs: list[Series]) -> Series:
    """Runs under the same conditions as one, each without its beginning."""
    rows = np.concatenate([run.equilibrated().samples for run in runs])
    return replace(runs[0], steps=sum(run.steps for run in runs), samples=rows)


def noise_series(length: int, temperature: float, steps: int, seed: int) -> Series:
    """A run in a bath of constant temperature, from spins that point one way more than the other."""
    sites, random, rows = (length,) * 3, np.random.default_rng(seed), []
    system = lt.models.spin_lattice(sites, rate=RATE, baths=lt.HeatBaths(np.inf, temperature))
    spins = random.standard_normal((*sites, 3)) + np.array([0.0, 0.0, 2.0])
    spins /= np.linalg.norm(spins, axis=-1, keepdims=True)
    for portion in range(-(-steps // STEPS_PER_RUN)):
        count = min(STEPS_PER_RUN, steps - portion * STEPS_PER_RUN)
        noise = lt.Fluctuations(1.0, seed=100_000 * seed + portion)
        run = lt.integrate(
            system, system.state(spins), (0.0, count * STEP), STEP, noise=noise, save_every=SAVE_EVERY, engine="array"
        )
        spins = np.asarray(system.spins(run.x))
        means = spins[1:].mean(axis=(1, 2, 3))
        energy = (run.energy[1:] - temperature * run.x[1:, -1]) / length**3
        rows.append(np.column_stack([energy, means]))
        spins = spins[-1]
    return Series(NOISE_ROW, length, temperature, steps, SAVE_EVERY, np.concatenate(rows))


NOISE_ROW, MONTE_CARLO_ROW = "noise", "Monte Carlo"


def run(quick: bool) -> Report:
    """Runs at the transition and on both sides of it, on lattices of several sizes."""
    runs: list[list[Series]] = []
    sizes = {4: (1_000,), 6: (1_000, 1_000)} if quick else STEPS_BY_LENGTH
    for seed, (length, steps) in enumerate(sizes.items(), start=21):
        runs.append(
            [noise_series(length, CRITICAL_TEMPERATURE, count, seed + 1000 * i) for i, count in enumerate(steps)]
        )
        others = enumerate(STEP_SHARE_BY_TEMPERATURE.items())
        runs += [[noise_series(length, T, int(share * steps[0]), 10 * seed + i)] for i, (T, share) in others]
    temperatures = sorted([CRITICAL_TEMPERATURE, *STEP_SHARE_BY_TEMPERATURE])
    for length, sweeps in ({4: 200} if quick else SWEEPS_BY_LENGTH).items():
        chains = sample_heat_bath(length, temperatures, sweeps)
        runs += [
            [Series(MONTE_CARLO_ROW, length, T, sweeps, 1, rows)] for T, rows in zip(temperatures, chains, strict=True)
        ]
    found = [join_runs(some) for some in runs]
    at = [series for series in found if series.generator == NOISE_ROW and series.temperature == CRITICAL_TEMPERATURE]
    return make_report([series_row(series) for series in found], crossing_rows(at))


def series_row(series: Series) -> list:
    """A row of the table: what a run has come to, with a standard error each."""
    quantities = [with_error(f, series) for f in (magnetisation, specific_heat, binder_cumulant)]
    times = series.autocorrelation_time * series.steps_per_row
    return [series.generator, series.length, f"{series.temperature:g}", series.steps, times, *sum(quantities, ())]


def crossing_rows(found: list[Series]) -> list[list]:
    """For each two of some lattices: where their cumulants are equal, its error, from how many blocks; how far off."""
    rows = []
    for a, b in itertools.combinations(sorted(found, key=lambda series: series.length), 2):
        (T, error), blocks = cumulant_crossing(a, b), min(len(series.jackknife_blocks()) for series in (a, b))
        rows.append([f"{a.length}³ and {b.length}³", T, error, blocks, abs(T / CRITICAL_TEMPERATURE - 1.0)])
    return rows


def make_report(rows: list[list], crossed: list[list]) -> Report:
    """The table of all runs, and that of crossings."""
    rows = sorted(rows, key=lambda row: (row[0], row[1], float(row[2])))
    columns = {"By": "text", "Edge": "count", "kT / J": "text", "Steps or sweeps": "count", "Autocorrelation": "number"}
    for name in ("m", "c", "U"):
        columns |= {name: "precise", f"± of {name}": "error"}
    caption = (
        "Magnetisation m and specific heat c of a spin, Binder's cumulant U, with a standard error each; steps of "
        f"{STEP} with the rate {RATE:g}. The autocorrelation of m² is in steps, or sweeps."
    )
    where = Table(
        "Where Binder's cumulants of two lattices are equal.",
        {"Lattices": "text", "kT / J": "precise", "±": "error", "Blocks": "count", "From the transition": "number"},
        crossed,
    )
    text = (
        "The classical Heisenberg magnet on a simple cubic lattice, `lt.models.spin_lattice` in a bath of constant "
        "temperature, beside a heat bath with over-relaxation (Monte Carlo, in NumPy). Errors are those of blocks of "
        f"at least eight autocorrelation times. The transition is at kT = {CRITICAL_TEMPERATURE} J (Chen, Ferrenberg and Landau "
        f"1993), where U = {CRITICAL_CUMULANT} of large cubes (Holm and Janke 1993). Near it a cumulant is taken to be a "
        "straight line; its slope follows from how the magnetisation fluctuates with the energy in the same run. The "
        f"error of a crossing is known where each run has {MIN_CROSSING_BLOCKS} blocks at least."
    )
    known = [row for row in crossed if row[3] >= MIN_CROSSING_BLOCKS]
    best = min(known, key=lambda row: row[2], default=None)
    distance = None if best is None else abs(best[1] / CRITICAL_TEMPERATURE - 1.0) + best[2] / CRITICAL_TEMPERATURE
    work = "Binder's crossing with the least error: from the transition, a standard error added"
    targets = [Target(work, 0.01, distance, "number")]
    return Report("A magnet at its transition", text, [Table(caption, columns, rows), where], targets)
