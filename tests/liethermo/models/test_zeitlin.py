"""Fluids on the sphere: Laplacian, harmonics and brackets against closed forms, and both kinds of decay."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import liethermo as lt
import manifolds as mf
from liethermo.models import QuantisedSphere, zeitlin
from tests.refusals import refusal_test


def bracket(a, b):
    return a @ b - b @ a


def spin_matrices(N):
    """Return S_x, S_y, S_z from the ladder operators of the textbooks, shape (N, N) each."""
    s = (N - 1) / 2
    up = np.diag([math.sqrt(s * (s + 1) - m * (m + 1)) for m in s - 1 - np.arange(N - 1)], 1)
    return (up + up.T) / 2, (up - up.T) / 2j, np.diag(s - np.arange(N))


def coefficients(L, **entries):
    a = np.zeros((L + 1, L + 1), dtype=complex)
    for name, value in entries.items():
        a[int(name[1]), int(name[2])] = value
    return a


def test_laplacian_is_the_double_commutator_with_spins_and_its_inverse_inverts_it():
    q = QuantisedSphere(9)
    (mu,) = np.random.default_rng(0).standard_normal((1, q.algebra.dim))
    W = np.asarray(q.matrix(mu))
    exact = -sum(bracket(S, bracket(S, W)) for S in spin_matrices(9))
    np.testing.assert_allclose(q.matrix(q.laplacian(mu)), exact, atol=1e-12)
    np.testing.assert_allclose(q.laplacian(q.inverse_laplacian(mu)), mu, atol=1e-13)
    np.testing.assert_allclose(q.inverse_laplacian(q.laplacian(mu)), mu, atol=1e-13)
    np.testing.assert_allclose(q.state(W), mu, atol=1e-14)


@pytest.mark.parametrize("N", [2, 5, 64])
def test_harmonics_are_orthonormal_eigenvectors_with_the_eigenvalues_of_the_sphere(N):
    q = QuantisedSphere(N)
    main, couplings = q._tridiagonal_coefficients
    for m in {0, 1, N // 2, N - 1}:
        v, l = q.harmonics(m, N - 1), np.arange(m, N)
        coupling = couplings[: N - m - 1, m]
        image = main[: N - m, m, None] * v
        image[:-1] += coupling[:, None] * v[1:]
        image[1:] += coupling[:, None] * v[:-1]
        np.testing.assert_allclose(image, l * (l + 1) * v, atol=1e-12 * N**2)
        np.testing.assert_allclose(v.T @ v, np.eye(N - m), atol=1e-12)


def test_coefficients_matrices_and_values_on_the_sphere_agree():
    q, random = QuantisedSphere(7), np.random.default_rng(1)
    mu = random.standard_normal(q.algebra.dim)
    a = q.coefficients(mu)
    np.testing.assert_allclose(q.from_coefficients(a), mu, atol=1e-13)
    np.testing.assert_allclose(q.coefficients(mu, 3), a[:4, :4], atol=1e-13)
    theta, phi = np.pi * (np.arange(30) + 0.5) / 30, 2 * np.pi * np.arange(16) / 16
    exact = sum(
        (1 if m == 0 else 2) * (a[l, m] * scipy.special.sph_harm_y(l, m, theta[:, None], phi)).real
        for l in range(7)
        for m in range(l + 1)
    )
    np.testing.assert_allclose(q.on_grid(mu, (30, 16)), exact, atol=1e-13)
    square = (np.abs(a[:, 0]) ** 2).sum() + 2 * (np.abs(a[:, 1:]) ** 2).sum()
    assert square == pytest.approx(np.linalg.norm(q.matrix(mu)) ** 2, rel=1e-13)
    assert -float(zeitlin(7).entropy(mu)) == pytest.approx(square / 2, rel=1e-13)
    assert float(jnp.sum(q.random(0, (2, 4), 3.0) ** 2)) == pytest.approx(3.0)


def test_the_bracket_tends_to_that_of_functions_with_the_square_of_the_size():
    """The structure constant of Y_21, Y_31 and Y_43 converges to its integral on the sphere with the order 1 / N^2."""

    def structure_constant(N):
        q = QuantisedSphere(N)
        A, B, C = (q.matrix(q.from_coefficients(coefficients(4, **c))) for c in ({"a21": 1}, {"a32": 1j}, {"a43": 1}))
        return float((-q.gamma * np.trace(np.asarray(C).conj().T @ bracket(np.asarray(A), np.asarray(B)))).real)

    x, w = np.polynomial.legendre.leggauss(16)
    theta, phi = np.arccos(x), 2 * np.pi * np.arange(32) / 32
    grid = {}
    for (l, m), a in {(2, 1): 1, (3, 2): 1j, (4, 3): 1}.items():
        Y, (Y_theta, Y_phi) = (
            f.squeeze()
            for f in [
                scipy.special.sph_harm_y(l, m, theta[:, None], phi),
                np.moveaxis(scipy.special.sph_harm_y(l, m, theta[:, None], phi, diff_n=1)[1], -1, 0),
            ]
        )
        grid[l] = [2 * (a * f).real for f in (Y, Y_theta, Y_phi)]
    sine = np.sin(theta)[:, None]
    poisson = (grid[2][1] * grid[3][2] - grid[2][2] * grid[3][1]) / sine
    exact = float((w[:, None] * (2 * np.pi / 32) * grid[4][0] * poisson).sum())
    errors = np.array([structure_constant(N) - exact for N in (8, 16, 32)])
    assert abs(errors[-1]) < 0.01 * abs(exact)
    rates = np.log2(errors[:-1] / errors[1:])
    assert rates[-1] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("N", [6, 20])
def test_a_rossby_haurwitz_wave_turns_rigidly_at_its_speed(N):
    spin, l, m = 0.7, 4, 3
    q = QuantisedSphere(N)
    a = coefficients(4, a10=2 * spin * math.sqrt(4 * math.pi / 3), a43=0.5 + 0.2j)
    rate_of_change = q.coefficients(zeitlin(N).vector_field(q.from_coefficients(a)), 4)
    speed = -1j * m * spin * (1 - 2 / (l * (l + 1)))
    np.testing.assert_allclose(rate_of_change, speed * np.where(np.arange(5) == m, a, 0.0), atol=1e-12)


@pytest.mark.slow
def test_a_rossby_haurwitz_wave_turns_rigidly_for_a_day():
    spin, q = 0.7, QuantisedSphere(6)
    a = coefficients(4, a10=2 * spin * math.sqrt(4 * math.pi / 3), a43=0.5 + 0.2j)
    day = lt.integrate(zeitlin(6), q.from_coefficients(a), (0.0, 10.0), 0.05, lt.MetriplecticRungeKutta(8))
    rotated = a * np.exp(-1j * 3 * spin * (1 - 2 / 20) * 10.0 * (np.arange(5) == 3))
    np.testing.assert_allclose(q.coefficients(day.x[-1], 4), rotated, atol=1e-11)


@pytest.mark.parametrize("decay", [None, "enstrophy", "energy"])
def test_the_equations_are_the_documented_ones(decay):
    q, rate = QuantisedSphere(8), 0.05
    x = q.random(1, (2, 6))
    system = zeitlin(8, decay, rate if decay else 0.0)
    P, W = np.asarray(q.matrix(q.inverse_laplacian(x))), np.asarray(q.matrix(x))
    motion = q.gamma * bracket(P, W)
    friction = {
        None: 0.0,
        "enstrophy": rate * q.gamma * bracket(P, motion),
        "energy": rate * q.gamma * bracket(W, motion),
    }
    np.testing.assert_allclose(q.matrix(system.vector_field(x)), motion + friction[decay], atol=1e-13)
    assert float(system.energy(x)) == pytest.approx(-q.gamma / 2 * np.trace(P.conj().T @ W).real, rel=1e-13)
    if decay == "enstrophy":
        assert float(system.entropy_production(x)) == pytest.approx(rate * np.linalg.norm(motion) ** 2, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("decay", ["enstrophy", "energy"])
def test_conserved_functions_stay_to_rounding_and_the_decaying_one_falls(decay):
    q = QuantisedSphere(12)
    x = q.random(2, (2, 5), 4.0)
    run = lt.integrate(zeitlin(12, decay, 0.05), x, (0.0, 1.0), 0.02, lt.MetriplecticRungeKutta(4), engine="array")
    constant, decreasing = (run.energy, -run.entropy) if decay == "enstrophy" else (run.entropy, run.energy)
    assert np.ptp(constant) < 1e-13 * abs(constant[0])
    assert np.diff(decreasing).max() < 0.0
    assert set(run.casimirs) == {"tr((i M)**2)", "tr((i M)**3)", "tr((i M)**4)"}
    if decay == "energy":
        assert run.audit().passed
        assert all(np.ptp(series) < 1e-12 * abs(series[0]) for series in run.casimirs.values())


@pytest.mark.slow
def test_without_decay_the_spectrum_stays_to_rounding():
    q = QuantisedSphere(10)
    x = q.random(3, (2, 5), 4.0)
    run = lt.integrate(zeitlin(10), x, (0.0, 1.0), 0.01, lt.MetriplecticRungeKutta(8), engine="array")
    initial_spectrum, final_spectrum = (np.linalg.eigvalsh(1j * np.asarray(q.matrix(y))) for y in (run.x[0], run.x[-1]))
    np.testing.assert_allclose(final_spectrum, initial_spectrum, atol=1e-13 * np.abs(initial_spectrum).max())


def test_a_picture_of_a_field_is_written(tmp_path):
    q = QuantisedSphere(6)
    lt.plot.sphere_field(q.on_grid(q.random(0, (2, 4)), (8, 16)), tmp_path / "field.png", title="vorticity")
    assert (tmp_path / "field.png").stat().st_size > 1000


test_invalid_arguments_are_refused = refusal_test(
    (lambda: zeitlin(1), "N must be an integer >= 2"),
    (lambda: zeitlin(8, "heat"), "'enstrophy', 'energy' or None, got 'heat'"),
    (lambda: zeitlin(8, "energy", -1.0), ">= 0"),
    (lambda: zeitlin(10**6), "GB", mf.SizeError),
    (lambda: QuantisedSphere(4).state(1j * np.diag([1, 2, 3, 4])), "has a trace of 1.83"),
    (lambda: QuantisedSphere(4).state(np.diag([1.0, -1.0, 0.0, 0.0])), "anti-Hermitian"),
    (lambda: QuantisedSphere(4).state(np.zeros((5, 5))), r"shape \(4, 4\), got \(5, 5\)"),
    (lambda: QuantisedSphere(4).from_coefficients(np.zeros((5, 5))), "L < 4"),
    (lambda: QuantisedSphere(4).from_coefficients(np.eye(4)), r"a\[0, 0\]"),
    (lambda: QuantisedSphere(4).from_coefficients(coefficients(3, a20=1j)), "real"),
    (lambda: QuantisedSphere(4).random(0, (2, 4)), "from 1 to 3"),
    (lambda: lt.plot.sphere_field(np.zeros(4)), "latitudes"),
    (lambda: lt.plot.sphere_field(np.full((4, 4), np.nan)), "finite"),
)
