"""The classical Heisenberg magnet through its transition, by noise and by Monte Carlo; Binder's crossing."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

import liethermo as lt

from ..heat_bath import heat_bath
from ..report import Report, Table, Target

CRITICAL = 1.4429
"""Of ``E = -J sum s_i . s_j`` on the simple cubic lattice, in units of J [Chen, Ferrenberg & Landau 1993]: the inverse
of 0.693035(37)."""

UNIVERSAL = 0.6217
"""Binder's cumulant of a cube with periodic sides at the transition [Holm & Janke 1993]."""

RATE, STEP = 2.0, 0.025

SIZES = {6: 50_000, 8: 100_000, 12: 64_000, 16: 70_000}
"""Steps at the transition, by the number of sites along an edge."""

AWAY = {1.30: 0.1, 1.37: 0.1, 1.50: 0.5, 1.60: 0.1}
"""Other temperatures, and the share of the steps there, where the spins are less slow."""

PORTION, EVERY, SWEEPS = 2000, 20, {8: 6000, 12: 2500, 16: 1200}

NEAR = (1.37, CRITICAL, 1.50)
"""Temperatures between which cumulants are taken to be straight, to find where they cross."""


@dataclass(frozen=True)
class Series:
    """Energy a spin and magnetisation vector along a run in equilibrium, shape (n, 4)."""

    by: str
    length: int
    temperature: float
    steps: int
    between: int
    rows: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        return self.rows[:, 0]

    @property
    def square(self) -> np.ndarray:
        return (self.rows[:, 1:] ** 2).sum(axis=1)

    @property
    def autocorrelation(self) -> float:
        """The integrated time of m², in rows, up to a window of six of it [Sokal 1997]."""
        return autocorrelation(self.square)

    def settled(self) -> Series:
        """Without the beginning: a twentieth, and no less than eight times the autocorrelation."""
        skipped = max(len(self.rows) // 20, int(8 * autocorrelation(self.square[len(self.rows) // 10 :])))
        return Series(self.by, self.length, self.temperature, self.steps, self.between, self.rows[skipped:])

    def blocks(self) -> list[np.ndarray]:
        """Rows in blocks of at least eight autocorrelation times, four to forty of them."""
        n = len(self.rows)
        return np.array_split(np.arange(n), int(np.clip(n / (8 * self.autocorrelation), 4, 40)))


def autocorrelation(x: np.ndarray) -> float:
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
    return float(np.sqrt(series.square[chosen]).mean())


def specific_heat(series: Series, chosen) -> float:
    return float(series.energy[chosen].var() * series.length**3 / series.temperature**2)


def cumulant(series: Series, chosen) -> float:
    """``1 - <m^4> / 3 <m^2>^2``."""
    square = series.square[chosen]
    return float(1.0 - (square**2).mean() / (3.0 * square.mean() ** 2))


def with_error(quantity, series: Series) -> tuple[float, float]:
    """A quantity and its standard error, from the blocks left out one after another."""
    blocks, everything = series.blocks(), np.arange(len(series.rows))
    left = [quantity(series, np.delete(everything, block)) for block in blocks]
    return quantity(series, everything), float(np.sqrt((len(blocks) - 1) * np.var(left)))


def crossing(temperatures, small, large, draws: int = 2000) -> tuple[float, float]:
    """Where the cumulants of two lattices are equal, on straight lines between temperatures, and its standard error.

    ``small`` and ``large`` have a cumulant and its error for each temperature; the error of the crossing is found by
    drawing from these. NaN where the lines do not cross.
    """
    (of_small, of_large), random = np.swapaxes([small, large], 1, 2), np.random.default_rng(0)

    def at(a, b) -> float:
        off = np.asarray(a) - np.asarray(b)
        changes = np.flatnonzero((off[:-1] < 0.0) & (off[1:] >= 0.0))
        if not len(changes):
            return np.nan
        i = changes[-1]
        return temperatures[i] - off[i] * (temperatures[i + 1] - temperatures[i]) / (off[i + 1] - off[i])

    drawn = [at(*(random.normal(*values) for values in (of_small, of_large))) for _ in range(draws)]
    found = np.array(drawn)[np.isfinite(drawn)]
    return at(of_small[0], of_large[0]), float(found.std()) if len(found) else np.nan


def by_noise(length: int, temperature: float, steps: int, seed: int) -> Series:
    """A run in a bath of constant temperature, from spins that point one way more than the other."""
    sites, random, rows = (length,) * 3, np.random.default_rng(seed), []
    system = lt.models.spin_lattice(sites, rate=RATE, baths=lt.HeatBaths(np.inf, temperature))
    spins = random.standard_normal((*sites, 3)) + np.array([0.0, 0.0, 2.0])
    spins /= np.linalg.norm(spins, axis=-1, keepdims=True)
    for portion in range(-(-steps // PORTION)):
        count = min(PORTION, steps - portion * PORTION)
        noise = lt.Fluctuations(1.0, seed=100_000 * seed + portion)
        run = lt.integrate(
            system, system.state(spins), (0.0, count * STEP), STEP, noise=noise, save_every=EVERY, engine="array"
        )
        spins = np.asarray(system.spins(run.x))
        means = spins[1:].mean(axis=(1, 2, 3))
        energy = (run.energy[1:] - temperature * run.x[1:, -1]) / length**3
        rows.append(np.column_stack([energy, means]))
        spins = spins[-1]
    return Series(NOISE, length, temperature, steps, EVERY, np.concatenate(rows))


NOISE, MONTE_CARLO = "noise", "Monte Carlo"


def run(quick: bool) -> Report:
    """Runs at the transition and on both sides of it, on lattices of several sizes."""
    found = []
    sizes = {4: 400, 6: 400} if quick else SIZES
    for seed, (length, steps) in enumerate(sizes.items(), start=21):
        found.append(by_noise(length, CRITICAL, steps, seed))
        others = enumerate(AWAY.items())
        found += [by_noise(length, T, int(share * steps), 10 * seed + i) for i, (T, share) in others]
    temperatures = sorted([CRITICAL, *AWAY])
    for length, sweeps in ({4: 200} if quick else SWEEPS).items():
        chains = heat_bath(length, temperatures, sweeps)
        found += [Series(MONTE_CARLO, length, T, sweeps, 1, rows) for T, rows in zip(temperatures, chains, strict=True)]
    return report(found)


def report(found: list[Series]) -> Report:
    """The table of all runs, and the crossings of those at the transition."""
    rows, cumulants = [], {}
    for series in sorted((series.settled() for series in found), key=lambda s: (s.by, s.length, s.temperature)):
        quantities = [with_error(f, series) for f in (magnetisation, specific_heat, cumulant)]
        times = series.autocorrelation * series.between
        rows.append([series.by, series.length, f"{series.temperature:g}", series.steps, times, *sum(quantities, ())])
        if series.by == NOISE:
            cumulants[series.length, series.temperature] = quantities[2]
    columns = {"By": "text", "Edge": "count", "kT / J": "text", "Steps or sweeps": "count", "Autocorrelation": "number"}
    for name in ("m", "c", "U"):
        columns |= {name: "precise", f"± of {name}": "error"}
    caption = (
        "Magnetisation m and specific heat c of a spin, Binder's cumulant U, with a standard error each; steps of "
        f"{STEP} with the rate {RATE:g}. The autocorrelation of m² is in steps, or sweeps."
    )
    lengths = [n for n in sorted({length for length, _ in cumulants}) if all((n, T) in cumulants for T in NEAR)]
    crossings: list[tuple[str, float, float]] = []
    for a, b in itertools.combinations(lengths, 2):
        small, large = ([cumulants[n, T] for T in NEAR] for n in (a, b))
        crossings.append((f"{a}³ and {b}³", *crossing(NEAR, small, large)))
    crossed = Table(
        "Where Binder's cumulants of two lattices are equal.",
        {"Lattices": "text", "kT / J": "precise", "±": "error", "From the transition": "number"},
        [[name, T, error, abs(T / CRITICAL - 1.0)] for name, T, error in crossings],
    )
    text = (
        "The classical Heisenberg magnet on a simple cubic lattice, `lt.models.spin_lattice` in a bath of constant "
        "temperature, beside a heat bath with over-relaxation (Monte Carlo, in NumPy). Errors are those of blocks of "
        f"at least eight autocorrelation times. The transition is at kT = {CRITICAL} J (Chen, Ferrenberg and Landau "
        f"1993), where U = {UNIVERSAL} of large cubes (Holm and Janke 1993). Between the runs next to it cumulants are "
        "taken to be straight lines, and the error of a crossing is found by drawing from theirs."
    )
    best = min(crossings, key=lambda c: c[2], default=None)
    distance = None if best is None else abs(best[1] / CRITICAL - 1.0) + best[2] / CRITICAL
    work = "Binder's crossing with the least error: from the transition, a standard error added"
    targets = [Target(work, 0.01, distance, "number")]
    return Report("A magnet at its transition", text, [Table(caption, columns, rows), crossed], targets)
