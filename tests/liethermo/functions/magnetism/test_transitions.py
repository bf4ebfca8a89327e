"""Binder's cumulants and their crossings beside exact values, and the transitions of bcc and fcc magnets."""

import numpy as np
import pytest

import liethermo as lt
from tests.refusals import refusal_test

mag = lt.magnetism
RANDOM = np.random.default_rng(7)


def vectors_with_memory(count: int, memory: float) -> np.ndarray:
    """Return normal vectors with the correlation ``memory**lag``, shape (count, 3)."""
    noise = np.sqrt(1.0 - memory**2) * RANDOM.standard_normal((count, 3))
    x = [RANDOM.standard_normal(3)]
    for w in noise:
        x.append(memory * x[-1] + w)
    return np.array(x[1:])


def test_limits_of_the_cumulant():
    """2/3 for a constant length; 4/9 for normal vectors, whose error is that of correlated samples."""
    directions = RANDOM.standard_normal((100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert mag.binder_cumulant(directions).value == pytest.approx(2.0 / 3.0, abs=1e-15)
    estimates = [mag.binder_cumulant(vectors_with_memory(2000, 0.8)) for _ in range(100)]
    values = np.array([estimate.value for estimate in estimates])
    assert values.mean() == pytest.approx(4.0 / 9.0, abs=0.005)
    assert np.mean([estimate.error for estimate in estimates]) == pytest.approx(values.std(), rel=0.25)
    blind = np.array([_error_of_independent_samples(vectors_with_memory(2000, 0.8)) for _ in range(10)])
    assert blind.mean() < 0.7 * values.std()


def _error_of_independent_samples(m) -> float:
    """Control: the jackknife of single samples, as if they were independent."""
    square = (m**2).sum(axis=1)
    n = len(square)
    second, fourth = (square.sum() - square) / (n - 1), ((square**2).sum() - square**2) / (n - 1)
    return float(np.sqrt((n - 1) * np.var(1.0 - fourth / (3.0 * second**2))))


def test_the_crossing_of_two_magnets_without_interaction_is_extrapolated():
    """Mean fields: ``P(m) ~ m^2 exp(-N (f / T + m^2 / 2))`` with ``f = -m^2 / 2 + m^4 / 4``, ordered below 1."""
    samples = []
    for N in (200, 800):
        m = np.linspace(0.0, 1.2, 6001)
        T = 1.005
        f = -0.5 * m**2 + 0.25 * m**4
        weight = m**2 * np.exp(-N * f / T - N * 0.5 * m**2)
        lengths = RANDOM.choice(m, size=40_000, p=weight / weight.sum())
        directions = RANDOM.standard_normal((40_000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        energy = N * (-0.5 * lengths**2 + 0.25 * lengths**4)
        samples.append(mag.MagnetSamples(T, energy, lengths[:, None] * directions))
    crossing = mag.cumulant_crossing(*samples)
    assert abs(crossing.value - 1.0) < 4.0 * crossing.error
    assert crossing.error < 6e-3


BAD = {
    "one component": (lambda: mag.binder_cumulant(np.ones(10)), "shape"),
    "two samples": (lambda: mag.binder_cumulant(np.ones((2, 3))), "n >= 4"),
    "two temperatures": (
        lambda: mag.cumulant_crossing(*(mag.MagnetSamples(T, np.ones(9), np.ones((9, 3))) for T in (1.0, 2.0))),
        "the same temperature",
    ),
    "too few energies": (
        lambda: mag.cumulant_crossing(*(mag.MagnetSamples(1.0, np.ones(8), np.ones((9, 3))) for _ in range(2))),
        "must have shape",
    ),
}


test_bad_samples_are_refused = refusal_test(BAD)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "literature", "step", "lengths"), [("bcc", 2.0542, 0.018, (4, 8)), ("fcc", 3.177, 0.012, (3, 6))]
)
def test_crystals_lose_their_order_at_the_temperature_of_the_literature(name, literature, step, lengths):
    """``kT_c / J`` of unit vectors, J counted once a pair, within 1 %.

    bcc is 1 / 0.486798 [Chen, Ferrenberg & Landau 1993], fcc 1 / 0.3147 [McKenzie, Domb & Hunter 1982]. The
    lattices have 108 to 1,024 spins.
    """
    samples = []
    for length in lengths:
        crystal = mag.lattice(name, (length,) * 3)
        baths = lt.HeatBaths(np.inf, literature)
        system = lt.SpinSystem(crystal, mag.exchange(crystal, 1.0), lt.LandauLifshitz(2.0), baths)
        state = system.state(np.tile([0.0, 0.0, 1.0], (*crystal.sites, 1)))
        energies, means = [], []
        for part in range(25):
            noise = lt.Fluctuations(seed=1000 * length + part)
            run = lt.integrate(system, state, (0.0, 2000 * step), step, noise=noise, save_every=20, engine="array")
            spins = np.asarray(system.spins(run.x))
            state = system.state(spins[-1])
            if part > 1:
                energies.append(run.energy[1:] - literature * run.x[1:, -1])
                means.append(spins[1:].reshape(len(spins) - 1, -1, 3).mean(axis=1))
        samples.append(mag.MagnetSamples(literature, np.concatenate(energies), np.concatenate(means)))
        assert mag.binder_cumulant(samples[-1].magnetisation).value == pytest.approx(0.6217, abs=0.02)  # Holm & Janke
    crossing = mag.cumulant_crossing(*samples)
    assert crossing.error < 0.01 * literature  # the fcc run measures 0.84 %
    assert abs(crossing.value - literature) < 0.01 * literature


def test_wrong_kinds_of_samples_are_refused():
    m = np.random.default_rng(0).standard_normal((20, 3))
    for bad, message in (("x", "real numbers"), (1j * m, "real numbers"), (0.0 * m, "zero in every sample")):
        with pytest.raises(lt.InputError, match=message):
            mag.binder_cumulant(bad)
    good = mag.MagnetSamples(1.0, np.arange(20.0), m)
    for a, message in (
        (3, "MagnetSamples"),
        (good._replace(temperature=-1.0), "temperature of samples must be positive"),
        (good._replace(temperature=np.inf), "temperature of samples must be positive"),
        (good._replace(energy=np.full(20, np.nan)), "energies of samples must be finite"),
    ):
        with pytest.raises(lt.InputError, match=message):
            mag.cumulant_crossing(a, a)
