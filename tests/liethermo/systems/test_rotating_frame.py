"""Rotating frames, beside runs in the laboratory and the shift of Bloch and Siegert."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt

LOWER = np.array([[0.0, 1.0], [0.0, 0.0]])
UPPER_LEVEL = np.diag([0.0, 1.0])
RHO = np.array([[0.6, 0.2 - 0.1j], [0.2 + 0.1j, 0.4]])
OMEGA = 2.0
RABI = 0.7
GAMMA = 0.2


def test_without_approximation_it_is_the_motion_in_the_laboratory():
    """H, a state and an observable go into the frame and back."""
    H = [OMEGA * UPPER_LEVEL, [RABI * (LOWER + LOWER.T), lambda t: jnp.cos(1.8 * t)]]
    frame = lt.RotatingFrame(1.8 * UPPER_LEVEL)
    laboratory = lt.QuantumSystem(H, lt.LindbladJumps([(LOWER, GAMMA)]))
    rotating = lt.QuantumSystem(frame.hamiltonian(H), frame.jumps([(LOWER, GAMMA)]))
    runs = [lt.integrate(s, RHO, (0.0, 3.0), 0.02, lt.MetriplecticGauss(3)) for s in (laboratory, rotating)]
    rho = [np.asarray(s.density(run.x)) for s, run in zip((laboratory, rotating), runs, strict=True)]
    np.testing.assert_allclose(frame.to_frame(rho[0], runs[0].t), rho[1], atol=1e-10)
    np.testing.assert_allclose(frame.to_laboratory(rho[1], runs[0].t), rho[0], atol=1e-10)


def test_a_circular_drive_is_constant_in_the_frame():
    def H(t):
        turned = jnp.exp(1j * 1.8 * t) * jnp.asarray(LOWER)
        return OMEGA * UPPER_LEVEL + 0.5 * RABI * (turned + turned.conj().T)

    frame = lt.RotatingFrame(1.8 * UPPER_LEVEL)
    constant = frame.rotating_wave(OMEGA * UPPER_LEVEL, RABI * (LOWER + LOWER.T), 1.8)
    for t in (0.0, 0.7, 5.0):
        np.testing.assert_allclose(frame.hamiltonian(H)(t), constant, atol=1e-14)
    np.testing.assert_allclose(constant, [[0.0, 0.5 * RABI], [0.5 * RABI, 0.2]], atol=1e-15)


def test_the_phase_of_a_drive():
    frame = lt.RotatingFrame(UPPER_LEVEL)
    H = frame.rotating_wave(UPPER_LEVEL, LOWER + LOWER.T, 1.0, phase=0.3)
    mean = np.mean([frame.hamiltonian([UPPER_LEVEL, [LOWER + LOWER.T, lambda t: jnp.cos(t + 0.3)]])(t)
                    for t in np.arange(64) * 2 * np.pi / 64], axis=0)  # fmt: skip
    np.testing.assert_allclose(H, mean, atol=1e-14)


@pytest.mark.slow
def test_three_levels_with_two_frequencies():
    """A ladder: the drive of the lower transition is resonant, the upper one is left out."""
    D = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    frame = lt.RotatingFrame(np.diag([0.0, 1.0, 4.0]))
    H = frame.rotating_wave(np.diag([0.0, 1.2, 4.0]), D, 1.0)
    np.testing.assert_allclose(H, [[0.0, 0.5, 0.0], [0.5, 0.2, 0.0], [0.0, 0.0, 0.0]], atol=1e-15)
    assert sorted(np.round(list(frame.components(D)), 12)) == [-3.0, -1.0, 1.0, 3.0]


@pytest.mark.slow
def test_the_error_of_the_approximation_is_linear_in_the_drive():
    """Terms that oscillate at ``2 omega`` with the strength ``Omega / 2`` move populations by ``Omega / (4 omega)``."""
    frame, errors = lt.RotatingFrame(UPPER_LEVEL), []
    for rabi in (0.1, 0.05):
        D, span = rabi * (LOWER + LOWER.T), (0.0, 2 * np.pi / rabi)
        systems = [
            lt.QuantumSystem([UPPER_LEVEL, [D, lambda t: jnp.cos(t)]]),
            lt.QuantumSystem(frame.rotating_wave(UPPER_LEVEL, D, 1.0)),
        ]
        runs = [lt.integrate(s, [1.0, 0.0], span, 0.2, lt.MetriplecticGauss(2)) for s in systems]
        populations = [np.asarray(s.density(run.x))[:, 1, 1].real for s, run in zip(systems, runs, strict=True)]
        errors.append(np.abs(populations[1] - populations[0]).max())
    assert 0.8 < errors[0] / (0.1 / 4) < 1.3
    assert 1.8 < errors[0] / errors[1] < 2.2


def test_what_is_refused():
    frame = lt.RotatingFrame(UPPER_LEVEL)
    with pytest.raises(
        lt.InputError,
        match="no component of the drive is constant in the frame: the frame turns",
    ):
        frame.rotating_wave(UPPER_LEVEL, LOWER + LOWER.T, 2.0)
    with pytest.raises(lt.InputError, match=r"components of the frequencies \[-1.0, 1.0\]"):
        frame.jumps([(LOWER + LOWER.T, 0.1)])
    with pytest.raises(lt.InputError, match=r"generator of the frame, \(2, 2\), got \(3, 3\)"):
        frame.hamiltonian(np.eye(3))
