"""Periodic states: limit cycles of engines and driven atoms, beside closed forms and SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import liethermo as lt
from tests.liethermo.dissipation.test_lindblad import LOWER, SX, SZ, liouvillian

UPPER_LEVEL = np.diag([0.0, 1.0])


def otto_engine(low=1.0, high=2.0, cold=0.4, hot=1.6, period=40.0):
    """Return a qubit that is coupled to a hot bath at the high frequency, and to a cold one at the low frequency."""

    def wave(t):
        return jnp.sin(2 * np.pi * t / period)

    jumps = [
        lt.ThermalJumps([(LOWER, lambda w, T, t: 30.0 * jnp.maximum(wave(t) - 0.8, 0.0) ** 3)], bath=0),
        lt.ThermalJumps([(LOWER, lambda w, T, t: 30.0 * jnp.maximum(-wave(t) - 0.8, 0.0) ** 3)], bath=1),
    ]
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    H = [(UPPER_LEVEL, lambda t: middle + half * jnp.clip(2.0 * wave(t), -1.0, 1.0))]
    kinks = tuple(period / 12.0 * np.array([1.0, 5.0, 7.0, 11.0]))
    return lt.QuantumSystem(H, jumps, baths=lt.HeatBaths(np.inf, [hot, cold], 2)), kinks


def test_an_otto_engine_has_its_efficiency():
    """``1 - omega_low / omega_high``; heat and work add up to zero; the heat is that of the populations' ratios."""
    engine, kinks = otto_engine()
    cycle = lt.steady_cycle(engine, 40.0, 0.5, lt.MetriplecticGauss(2), breaks=kinks)
    assert cycle.stable
    np.testing.assert_allclose(cycle.efficiency, 0.5, rtol=1e-13)
    np.testing.assert_allclose(cycle.heat.sum() + cycle.work, 0.0, atol=1e-15)
    # populations relax at the rates 2 g cosh(omega / 2T), whose integrals over the contacts are known
    time = np.linspace(0.0, 20.0, 20001)
    contact = scipy.integrate.simpson(30.0 * np.maximum(np.sin(2 * np.pi * time / 40.0) - 0.8, 0.0) ** 3, x=time)
    omega, T = np.array([2.0, 1.0]), np.array([1.6, 0.4])
    kept = np.exp(-2.0 * np.cosh(omega / (2 * T)) * contact)
    gibbs = 1.0 / (1.0 + np.exp(omega / T))
    # p_hot = gibbs_hot + kept_hot (p_cold - gibbs_hot), and the same with hot and cold exchanged
    p_hot, p_cold = np.linalg.solve([[1.0, -kept[0]], [-kept[1], 1.0]], (1.0 - kept) * gibbs)
    np.testing.assert_allclose(cycle.heat, omega * np.array([p_hot - p_cold, p_cold - p_hot]), rtol=1e-5)


@pytest.mark.slow
def test_a_refrigerator_has_its_coefficient_of_performance():
    """Work drives heat from the cold bath to the hot one where ``omega_low / T_cold < omega_high / T_hot``."""
    refrigerator, kinks = otto_engine(low=0.4, high=2.0, cold=1.0, hot=1.6)
    cycle = lt.steady_cycle(refrigerator, 40.0, 0.5, lt.MetriplecticGauss(2), breaks=kinks)
    assert cycle.work > 0.0
    assert cycle.heat[1] > 0.0
    np.testing.assert_allclose(cycle.heat[1] / cycle.work, 0.4 / (2.0 - 0.4), rtol=1e-12)
    assert np.isnan(cycle.efficiency)


def test_a_driven_atom_is_that_of_its_stroboscopic_map():
    """The fixed point and the multipliers of the map of one period, integrated by DOP853."""
    omega, period = 1.7, 2 * np.pi / 1.7
    H, drive, jumps = -SZ, 0.6 * SX, [(LOWER, 0.25)]
    atom = lt.QuantumSystem([H, [drive, lambda t: jnp.cos(omega * t)]], lt.LindbladJumps(jumps))
    cycle = lt.steady_cycle(atom, period, period / 40, lt.MetriplecticGauss(3))

    def field(t, y):
        return (liouvillian(H + np.cos(omega * t) * drive, jumps) @ y.reshape(4, 4)).ravel()

    matrix = scipy.integrate.solve_ivp(
        field, (0.0, period), np.eye(4, dtype=complex).ravel(), method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1].reshape(4, 4)  # fmt: skip
    values, vectors = np.linalg.eig(matrix)
    order = np.argsort(-np.abs(values))
    rest = vectors[:, order[0]].reshape(2, 2)
    np.testing.assert_allclose(atom.density(cycle.x), rest / np.trace(rest), atol=1e-9)
    np.testing.assert_allclose(np.abs(cycle.multipliers), np.abs(values[order[1:]]), atol=1e-8)


@pytest.mark.slow
def test_a_mechanical_cycle():
    """A damped oscillator that is driven: amplitude ``f / |k - omega^2 + i c omega|``."""
    c, omega, period = 0.3, 1.4, 2 * np.pi / 1.4

    def energy(x, t):
        return 0.5 * (x[0] ** 2 + x[1] ** 2) - 0.2 * jnp.cos(omega * t) * x[0]

    oscillator = lt.MetriplecticSystem(
        [[0.0, 1.0], [-1.0, 0.0]], energy, dissipation=lt.Friction([[0.0, 0.0], [0.0, c]]), dim=2
    )
    cycle = lt.steady_cycle(oscillator, period, period / 40, lt.MetriplecticGauss(3), x0=[0.5, 0.0])
    amplitude = 0.2 / (1.0 - omega**2 + 1j * c * omega)
    np.testing.assert_allclose(cycle.x, [amplitude.real, -(omega * amplitude).imag], atol=1e-8)
    assert cycle.stable


def test_what_is_refused():
    engine, _ = otto_engine()
    with pytest.raises(lt.InputError, match="does not repeat itself after the period 30"):
        lt.steady_cycle(engine, 30.0, 0.5)
    with pytest.raises(lt.InputError, match=r"at rest is lt\.steady_state"):
        lt.steady_cycle(lt.QuantumSystem(SZ, lt.LindbladJumps([(LOWER, 0.1)])), 1.0, 0.1)
    with pytest.raises(lt.InputError, match="period must be a positive number, got -1"):
        lt.steady_cycle(engine, -1.0, 0.1)
