"""Minima and hysteresis loops beside closed forms."""

import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism


@pytest.mark.sampled(1)
@pytest.mark.parametrize("degrees", [1.0, 20.0, 45.0, 80.0])
def test_a_grain_switches_at_the_field_of_stoner_and_wohlfarth(degrees):
    """``h = (cos^{2/3} a + sin^{2/3} a)^{-3/2}`` in units of 2 K / mu [Stoner & Wohlfarth 1948]."""
    angle, mu, K = np.radians(degrees), 0.5, 0.3
    expected = (np.cos(angle) ** (2 / 3) + np.sin(angle) ** (2 / 3)) ** -1.5
    h = np.concatenate([[0.0], expected * np.array([0.9, 0.99, 0.999, 1.001, 1.01])])
    direction = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    fields = h[:, None] * 2 * K / mu * direction
    loop = mag.hysteresis_loop(mag.anisotropy(1, K), [[0.0, 0.0, 1.0]], fields, mu)
    assert (loop.magnetisation[:4, 2] > 0.0).all()
    assert (loop.magnetisation[4:, 2] < 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(loop.spins, axis=-1), 1.0, rtol=1e-14)


def test_an_anisotropy_of_50_micro_ev_switches_at_its_field_in_tesla():
    """A grain of 2.5 Bohr magnetons and 0.05 meV switches at ``2 K / mu`` = 0.691 T along its axis.

    The field is from the constants 0.05788 meV / T and 0.05 meV, not from the units of the library.
    """
    mu = mag.units("meV").moment(2.5)
    threshold = 2 * 0.05 / (2.5 * 0.0578838)
    tilt = np.radians(1e-3)
    expected = threshold * (np.cos(tilt) ** (2 / 3) + np.sin(tilt) ** (2 / 3)) ** -1.5
    fields = np.array([0.999, 1.001])[:, None] * expected * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    loop = mag.hysteresis_loop(mag.anisotropy(1, 0.05), [[0.0, 0.0, 1.0]], fields, mu)
    assert loop.magnetisation[0, 2] > 0.0 > loop.magnetisation[1, 2]


def test_a_spin_opposite_to_its_field_turns():
    loop = mag.hysteresis_loop(mag.anisotropy(1, 0.1), [[0.0, 0.0, 1.0]], [[0.0, 0.0, -1.0]])
    np.testing.assert_allclose(loop.magnetisation[0], [0.0, 0.0, -1.0], atol=1e-7)
    fixed = mag.minimise(mag.zeeman(1, (0.0, 0.0, -1.0)), [[0.0, 0.0, 1.0]])  # control: no torque, no step
    assert (fixed.steps, fixed.spins[0, 2]) == (0, 1.0)


def test_triangles_order_at_120_degrees():
    """The energy of a triangular antiferromagnet is ``-3 |J| / 2`` a spin [Wannier 1950, for vectors]."""
    crystal = mag.lattice("triangular", (6, 6))
    start = np.random.default_rng(1).standard_normal((6, 6, 3))
    start /= np.linalg.norm(start, axis=-1, keepdims=True)
    ground = mag.minimise(mag.exchange(crystal, -1.0), start, 1e-9)
    assert ground.energy / 36 == pytest.approx(-1.5, abs=1e-12)
    assert ground.torque < 1e-9


def test_lengths_are_kept_and_functions_are_accepted():
    start = np.array([[2.0, 0.0, 0.1], [0.0, 0.5, 0.1]])
    minimum = mag.minimise(lambda s: -s[0, 2] - 2.0 * s[1, 2], start)
    np.testing.assert_allclose(np.linalg.norm(minimum.spins, axis=1), np.linalg.norm(start, axis=1), rtol=1e-14)
    np.testing.assert_allclose(minimum.spins[:, 2], np.linalg.norm(start, axis=1), rtol=1e-14)


def test_a_descent_that_does_not_end_says_so():
    start = np.random.default_rng(1).standard_normal((20, 3))
    with pytest.raises(lt.LiethermoError, match="after 3 steps the torque is"):
        mag.minimise(mag.exchange(20), start, max_steps=3)
    with pytest.raises(lt.LiethermoError, match=r"shape \(\*sites, 3\)"):
        mag.minimise(mag.exchange(20), start.ravel())
    with pytest.raises(lt.LiethermoError, match="greater than 0"):
        mag.minimise(mag.exchange(2), np.zeros((2, 3)))
    with pytest.raises(lt.LiethermoError, match=r"fields must have shape \(n, 3\)"):
        mag.hysteresis_loop(mag.exchange(20), start, [0.0, 0.0, 1.0])
