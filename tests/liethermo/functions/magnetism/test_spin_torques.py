"""Torques of currents beside closed forms, with their work in the ledger."""

import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism
METHODS = [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_spin_in_a_current_has_its_closed_form_and_its_work(method):
    """``z' = (rate B - a) (1 - z^2)``; work is the gain of energy and heat, to rounding."""
    a, b, rate, B = 0.3, 0.2, 0.1, 1.0
    torque = mag.Slonczewski((0.0, 0.0, 1.0), a, b)
    system = lt.SpinSystem(1, mag.zeeman(1, (0, 0, B)), lt.LandauLifshitz(rate), lt.HeatBaths(2.0), torque=torque)
    run = lt.integrate(system, system.state([[0.6, 0.0, 0.8]]), (0.0, 10.0), 0.02, method)
    z = np.tanh((rate * B - a) * run.t + np.arctanh(0.8))
    np.testing.assert_allclose(run.x[:, 2], z, atol=3e-4 if method is METHODS[0] else 1e-8)
    np.testing.assert_allclose(np.linalg.norm(run.x[:, :3], axis=1), 1.0, atol=4e-16)
    work = np.asarray(run.casimirs["work"])
    np.testing.assert_allclose(run.energy - run.energy[0], work, atol=1e-14)
    power = B * a * (1.0 - z**2)  # -B z' of the torque
    by_trapezes = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(run.t))])
    np.testing.assert_allclose(work, by_trapezes, atol=5e-4)
    assert (np.diff(run.entropy) > 0.0).all()
    phase = np.unwrap(np.arctan2(run.x[:, 1], run.x[:, 0]))
    np.testing.assert_allclose(phase, (B - b) * run.t, atol=3e-3)


@pytest.mark.slow
def test_a_wall_moves_with_the_electrons_if_alpha_is_beta():
    """Gilbert's equation with beta = alpha carries a rigid texture with the velocity u [Barnes & Maekawa 2005]."""
    count, alpha, u = 120, 0.2, 0.8
    box = mag.mesh((count, 1, 1), 0.5)
    energy = mag.continuum_exchange(box, 1.0) + mag.anisotropy(box, 0.125)
    width = 1.0 / np.sqrt(1.0)  # A = 1, K = K V / V = 1
    x = box.positions[:, 0, 0, 0]
    start = np.zeros((count, 1, 1, 3))
    start[:, 0, 0, 2], start[:, 0, 0, 0] = np.tanh((x - 20.0) / width), 1.0 / np.cosh((x - 20.0) / width)
    ratio, rate = lt.LandauLifshitz.gilbert(alpha, 8.0)
    torque = mag.ZhangLi(box, (u, 0.0, 0.0), alpha, alpha)
    system = lt.SpinSystem(box, energy, lt.LandauLifshitz(rate), ratio=ratio, torque=torque)
    rest = mag.minimise(energy, start, 1e-8).spins
    run = lt.integrate(system, system.state(rest), (0.0, 10.0), 0.02, lt.MetriplecticRungeKutta(4), save_every=500)
    positions = [np.interp(0.0, system.spins(s)[:, 0, 0, 2], x) for s in run.x]
    # central differences on cells of half a wall width are short by some per cent
    assert positions[-1] - positions[0] == pytest.approx(10.0 * u, rel=0.05)


def test_directions_and_amplitudes():
    spin_orbit = mag.SpinOrbit((2.0, 0.0, 0.0), -0.1, lambda t: 0.5 * t)
    s = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(spin_orbit.polarisation, [0.0, 1.0, 0.0])
    expected = -0.1 * np.cross(s, [0.0, 1.0, 0.0]) + 1.0 * np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(spin_orbit(2.0, s), expected)
    by_site = mag.Slonczewski((0.0, 0.0, 1.0), np.array([1.0, 2.0]))
    np.testing.assert_allclose(by_site(0.0, s), np.array([[1.0], [2.0]]) * np.cross(s, [0.0, 0.0, 1.0]))


def test_bad_torques_are_refused():
    energy = mag.zeeman(2, (0.0, 0.0, 1.0))
    with pytest.raises(lt.LiethermoError, match="must be a function w of t and s"):
        lt.SpinSystem(2, energy, torque=1.0)
    with pytest.raises(lt.LiethermoError, match=r"must return real numbers of shape \(2, 3\) or \(3,\)"):
        lt.SpinSystem(2, energy, torque=lambda t, s: s[:, 0])
    with pytest.raises(lt.LiethermoError, match="parallel to the normal"):
        mag.SpinOrbit((0.0, 0.0, 1.0), 1.0)
    with pytest.raises(lt.LiethermoError, match=r"lt\.magnetism\.mesh"):
        mag.ZhangLi(mag.lattice("bcc", 3), (1.0, 0.0, 0.0))


def test_the_largest_step_holds_for_torques_and_for_noise_without_baths():
    s = np.array([[0.6, 0.0, 0.8]])
    torque = mag.Slonczewski((1.0, 0.0, 0.0), -100.0, lambda t: 30.0 * t)
    system = lt.SpinSystem(1, mag.zeeman(1, (0.0, 0.0, 0.5)), lt.LandauLifshitz(0.1), torque=torque)
    w = -100.0 * np.cross(s, [1.0, 0.0, 0.0]) + 60.0 * np.array([1.0, 0.0, 0.0])
    rate = np.hypot(1.0, 0.1) * 0.5 + np.linalg.norm(np.cross(s, w))
    assert system.largest_step(s, 0.2, t=2.0) == pytest.approx(0.2 / rate, rel=1e-13)
    at_rest = lt.SpinSystem(1, mag.zeeman(1, (0.0, 0.0, 0.5)), torque=torque)
    assert at_rest.largest_step([[0.0, 0.0, 1.0]], 0.2) == pytest.approx(0.2 / (0.5 + 100.0), rel=1e-13)
    by_noise = system.largest_step(s, 0.01, boltzmann=3.0, temperature=500.0)
    assert by_noise == pytest.approx(1e-4 / (2.0 * 3.0 * 500.0 * 0.1), rel=1e-13)
    with pytest.raises(lt.InputError, match="Give temperature="):
        system.largest_step(s, boltzmann=3.0)
    warm = lt.SpinSystem(1, mag.zeeman(1, (0.0, 0.0, 0.5)), lt.LandauLifshitz(0.1), lt.HeatBaths())
    with pytest.raises(lt.InputError, match="the baths have the temperatures"):
        warm.largest_step(s, boltzmann=3.0, temperature=2.0)
    for arguments in ({"angle": -1.0}, {"angle": np.nan}, {"boltzmann": -1.0}, {"boltzmann": "x"}, {"t": np.nan}):
        with pytest.raises(lt.InputError, match=f"{next(iter(arguments)) if 't' not in arguments else 'time'} must be"):
            system.largest_step(s, **arguments)


@pytest.mark.parametrize(
    "make",
    [
        lambda bad: mag.Slonczewski((1.0, 0.0, 0.0), bad),
        lambda bad: mag.Slonczewski((1.0, bad, 0.0)),
        lambda bad: mag.SpinOrbit((1.0, bad, 0.0)),
        lambda bad: mag.SpinOrbit((1.0, 0.0, 0.0), normal=(0.0, 0.0, bad)),
        lambda bad: mag.ZhangLi(mag.mesh((2, 1, 1), 1.0), (1.0, 0.0, bad)),
        lambda bad: mag.ZhangLi(mag.mesh((2, 1, 1), 1.0), (1.0, 0.0, 0.0), bad),
        lambda bad: mag.LaserPulse(bad, 1.0),
        lambda bad: mag.LaserPulse(1.0, bad),
        lambda bad: mag.LaserPulse(1.0, 1.0, bad),
        lambda bad: lt.SpinSystem(2, mag.zeeman(2, (0.0, 0.0, 1.0)), ratio=bad),
        lambda bad: lt.LandauLifshitz.gilbert(bad),
        lambda bad: mag.units("meV").gilbert(0.1, 1.0, bad),
    ],
)
def test_amplitudes_are_finite(make):
    make(0.5)
    for bad in (np.nan, np.inf, "x", 1j):
        with pytest.raises(lt.InputError, match=r"must be (one |positive |>= 0 |made of |finite)|, got|must be finite"):
            make(bad)


def test_the_parameters_of_a_reversed_precession():
    """The advice of the message: Gilbert's damping lowers the energy for alpha and ratio of one sign."""
    with pytest.raises(lt.InputError, match="give alpha < 0"):
        lt.LandauLifshitz.gilbert(0.1, -2.0)
    ratio, rate = lt.LandauLifshitz.gilbert(-0.1, -2.0)
    s, g = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.3, -1.0])
    v = float(ratio) * np.cross(s, g) + float(rate) * np.cross(s, np.cross(s, g))
    np.testing.assert_allclose(v, -2.0 * np.cross(s, g) - 0.1 * np.cross(s, v), atol=1e-15)
    assert g @ v < 0.0


def test_a_current_flows_in_its_own_mesh():
    torque = mag.ZhangLi(mag.mesh((2, 2, 3), 1.0), (1.0, 0.0, 0.0))
    with pytest.raises(lt.FunctionError, match=r"mesh of \(2, 2, 3\) cells"):
        lt.SpinSystem((3, 2, 2), mag.zeeman((3, 2, 2), (0.0, 0.0, 1.0)), torque=torque)
