"""The classical Heisenberg magnet at its transition, by noise and by Monte Carlo; crossings of Binder's cumulant."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

import liethermo as lt
from liethermo.functions.magnetism.transitions import autocorrelation_time

from ..heat_bath import simulate_heisenberg_heat_bath
from ..report import Report, Table, Target

CRITICAL_TEMPERATURE = 1.4429
"""Transition temperature of ``E = -J sum s_i . s_j`` on the simple cubic lattice, in units of J: the inverse of
0.693035(37) [Chen, Ferrenberg & Landau 1993]."""

CRITICAL_CUMULANT = 0.6217
"""Binder's cumulant of a periodic cube at the transition [Holm & Janke 1993]."""

RATE = 2.0
"""Damping rate."""
STEP = 0.025
"""Step size."""

STEPS_BY_LENGTH = {6: (50_000,), 8: (100_000,), 12: (64_000,), 16: (70_000,), 24: (60_000,), 32: (40_000, 28_000)}
"""Numbers of steps of the runs at the transition, by the number of sites along an edge."""

STEP_SHARE_BY_TEMPERATURE = {1.30: 0.4, 1.37: 0.2, 1.50: 0.5, 1.60: 0.2}
"""Other temperatures, and the fraction of steps there, where the spins are less slow."""

STEPS_PER_RUN = 2000
"""Number of steps of a call."""
SAVE_EVERY = 20
"""Steps between saved states."""
SWEEPS_BY_LENGTH = {8: 6000, 12: 4000, 16: 3000, 24: 1200, 32: 800}
"""Monte Carlo sweeps, by the number of sites along an edge."""


MIN_CROSSING_BLOCKS = 20
"""Minimum number of blocks for the error of a crossing; with fewer, the slope of a cumulant is too uncertain."""


@dataclass(frozen=True)
class Series:
    """Time series of energy per spin and magnetisation vector of a run in equilibrium, shape (n, 4)."""

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
    def magnetisation_vectors(self) -> np.ndarray:
        return self.samples[:, 1:]

    @property
    def squared_magnetisation(self) -> np.ndarray:
        return (self.magnetisation_vectors**2).sum(axis=1)

    def magnet_samples(self) -> lt.magnetism.MagnetSamples:
        """Return the samples with the energy of all spins."""
        energy = self.energy * self.length**3
        return lt.magnetism.MagnetSamples(self.temperature, energy, self.magnetisation_vectors)

    @property
    def autocorrelation_time(self) -> float:
        """The integrated autocorrelation time of m², in rows, with a window of six times its value [Sokal 1997]."""
        return autocorrelation_time(self.squared_magnetisation)

    @property
    def row_indices(self) -> np.ndarray:
        """Indices of all rows of the samples."""
        return np.arange(len(self.samples))

    def drop_transient(self) -> Series:
        """Return the series without its beginning: a twentieth, or eight autocorrelation times if that is at most
        half."""
        n = len(self.samples)
        n_skipped = max(n // 20, min(n // 2, int(8 * autocorrelation_time(self.squared_magnetisation[n // 10 :]))))
        return replace(self, samples=self.samples[n_skipped:])

    def jackknife_blocks(self) -> list[np.ndarray]:
        """Return row indices in four to forty blocks of at least eight autocorrelation times."""
        count = int(np.clip(len(self.samples) / (8 * self.autocorrelation_time), 4, 40))
        return np.array_split(self.row_indices, count)


def magnetisation(series: Series, rows) -> float:
    return float(np.sqrt(series.squared_magnetisation[rows]).mean())


def specific_heat(series: Series, rows) -> float:
    return float(series.energy[rows].var() * series.length**3 / series.temperature**2)


def value_and_jackknife_error(quantity, series: Series) -> tuple[float, float]:
    """Return a quantity and its jackknife standard error."""
    return quantity(series, series.row_indices), float(
        np.sqrt(jackknife_variance(lambda row_indices: quantity(series, row_indices), series))
    )


def jackknife_variance(quantity, series: Series) -> float:
    """Return the jackknife variance of a function of row indices."""
    estimates = [quantity(np.delete(series.row_indices, block)) for block in series.jackknife_blocks()]
    return float((len(estimates) - 1) * np.var(estimates))


def join_runs(runs: list[Series]) -> Series:
    """Return runs under equal conditions as one series, each without its beginning."""
    rows = np.concatenate([run.drop_transient().samples for run in runs])
    return replace(runs[0], steps=sum(run.steps for run in runs), samples=rows)


def noise_series(length: int, temperature: float, steps: int, seed: int) -> Series:
    """Run in a bath of constant temperature, from partly aligned spins."""
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


NOISE_ROW = "noise"
"""Name of the series by noise."""
MONTE_CARLO_ROW = "Monte Carlo"
"""Name of the series by Monte Carlo."""


def run(is_quick: bool) -> Report:
    """Run lattices of several sizes at the transition and at temperatures around it."""
    runs: list[list[Series]] = []
    sizes = {4: (1_000,), 6: (1_000, 1_000)} if is_quick else STEPS_BY_LENGTH
    for seed, (length, steps) in enumerate(sizes.items(), start=21):
        runs.append(
            [noise_series(length, CRITICAL_TEMPERATURE, count, seed + 1000 * i) for i, count in enumerate(steps)]
        )
        other_temperatures = enumerate(STEP_SHARE_BY_TEMPERATURE.items())
        runs += [
            [noise_series(length, T, int(share * steps[0]), 10 * seed + i)] for i, (T, share) in other_temperatures
        ]
    temperatures = sorted([CRITICAL_TEMPERATURE, *STEP_SHARE_BY_TEMPERATURE])
    for length, sweeps in ({4: 200} if is_quick else SWEEPS_BY_LENGTH).items():
        chains = simulate_heisenberg_heat_bath(length, temperatures, sweeps)
        runs += [
            [Series(MONTE_CARLO_ROW, length, T, sweeps, 1, rows)] for T, rows in zip(temperatures, chains, strict=True)
        ]
    series_list = [join_runs(runs_at_temperature) for runs_at_temperature in runs]
    critical_series = [
        series for series in series_list if series.generator == NOISE_ROW and series.temperature == CRITICAL_TEMPERATURE
    ]
    return make_report([series_row(series) for series in series_list], crossing_rows(critical_series))


def series_row(series: Series) -> list:
    """Return a row of the table: the results of a series with their standard errors."""
    cumulant = lt.magnetism.binder_cumulant(series.magnetisation_vectors)
    quantities = [*(value_and_jackknife_error(f, series) for f in (magnetisation, specific_heat)), tuple(cumulant)]
    times = series.autocorrelation_time * series.steps_per_row
    return [series.generator, series.length, f"{series.temperature:g}", series.steps, times, *sum(quantities, ())]


def crossing_rows(series_list: list[Series]) -> list[list]:
    """Return for each pair of lattices the crossing, its error, the number of blocks, and the relative deviation."""
    rows = []
    for a, b in itertools.combinations(sorted(series_list, key=lambda series: series.length), 2):
        T, error = lt.magnetism.cumulant_crossing(a.magnet_samples(), b.magnet_samples())
        blocks = min(len(series.jackknife_blocks()) for series in (a, b))
        rows.append([f"{a.length}³ and {b.length}³", T, error, blocks, abs(T / CRITICAL_TEMPERATURE - 1.0)])
    return rows


def make_report(rows: list[list], crossings: list[list]) -> Report:
    """Return the report with the table of all runs and that of crossings."""
    rows = sorted(rows, key=lambda row: (row[0], row[1], float(row[2])))
    columns = {"By": "text", "Edge": "count", "kT / J": "text", "Steps or sweeps": "count", "Autocorrelation": "number"}
    for name in ("m", "c", "U"):
        columns |= {name: "precise", f"± of {name}": "error"}
    caption = (
        "Magnetisation m and specific heat c of a spin, Binder's cumulant U, with a standard error each; steps of "
        f"{STEP} with the rate {RATE:g}. The autocorrelation of m² is in steps, or sweeps."
    )
    crossing_table = Table(
        "Where Binder's cumulants of two lattices are equal.",
        {"Lattices": "text", "kT / J": "precise", "±": "error", "Blocks": "count", "From the transition": "number"},
        crossings,
    )
    text = (
        "The classical Heisenberg magnet on a simple cubic lattice, `lt.models.spin_lattice` in a bath of constant "
        "temperature, beside a heat bath with over-relaxation (Monte Carlo, in NumPy). Errors are those of blocks of "
        f"at least eight autocorrelation times. The transition is at kT = {CRITICAL_TEMPERATURE} J (Chen, "
        "Ferrenberg and Landau "
        f"1993), where U = {CRITICAL_CUMULANT} of large cubes (Holm and Janke 1993). Near it a cumulant is taken "
        "to be a "
        "straight line; its slope follows from how the magnetisation fluctuates with the energy in the same run. The "
        f"error of a crossing is known where each run has {MIN_CROSSING_BLOCKS} blocks at least."
    )
    reliable_rows = [row for row in crossings if row[3] >= MIN_CROSSING_BLOCKS]
    best_row = min(reliable_rows, key=lambda row: row[2], default=None)
    distance = (
        None if best_row is None else abs(best_row[1] / CRITICAL_TEMPERATURE - 1.0) + best_row[2] / CRITICAL_TEMPERATURE
    )
    work = "Binder's crossing with the least error: from the transition, a standard error added"
    targets = [Target(work, 0.01, distance, "number")]
    return Report("A magnet at its transition", text, [Table(caption, columns, rows), crossing_table], targets)
