"""Magnetic fluids on the sphere: the equations in matrices, Alfvén waves, and conservation laws."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.models import QuantisedSphere, magnetic_fluid


def bracket(a, b):
    return a @ b - b @ a


def start(q, seed=1, degrees=(1, 4)):
    return q.magnetic_state(q.random(seed, degrees, 4.0), q.random(seed + 1, degrees, 1.0))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("rate", [0.0, 0.05])
def test_the_equations_are_the_documented_ones(rate):
    q = QuantisedSphere(8)
    x = start(q, degrees=(1, 6))
    vorticity, potential = q.magnetic_fields(x)
    W, B, P, J = (
        np.asarray(q.matrix(f)) for f in (vorticity, potential, q.inverse_laplacian(vorticity), q.laplacian(potential))
    )
    F, G = q.gamma * (bracket(P, W) + bracket(J, B)), q.gamma * bracket(P, B)
    expected_rates = F + rate * q.gamma * (bracket(W, F) + bracket(B, G)), G + rate * q.gamma * bracket(B, F)
    system = magnetic_fluid(8, rate)
    for rate_of_change, expected_rate in zip(q.magnetic_fields(system.vector_field(x)), expected_rates, strict=True):
        np.testing.assert_allclose(q.matrix(rate_of_change), expected_rate, atol=1e-12 * np.abs(expected_rate).max())
    energy = -q.gamma / 2 * (np.trace(P.conj().T @ W) + np.trace(B.conj().T @ J)).real
    assert float(system.energy(x)) == pytest.approx(energy, rel=1e-13)


def test_waves_along_a_field_are_those_of_alfven():
    """Linearised about ``theta = b cos``, the waves have the frequency ``m b sqrt(1 - 2 / l (l + 1))``."""
    q, b, l, m = QuantisedSphere(7), 0.7, 4, 3
    a = np.zeros((l + 1, l + 1), dtype=complex)
    a[1, 0] = b * math.sqrt(4 * math.pi / 3)
    wave = np.zeros_like(a)
    wave[l, m] = 0.5 + 0.2j
    zero_state, function = jnp.zeros(q.algebra.dim), q.from_coefficients(wave)
    rest = q.magnetic_state(zero_state, q.from_coefficients(a))
    field = magnetic_fluid(7).vector_field
    assert np.abs(field(rest)).max() < 1e-12
    _, vorticity_response = jax.jvp(field, (rest,), (q.magnetic_state(function, zero_state),))
    _, potential_response = jax.jvp(field, (rest,), (q.magnetic_state(zero_state, function),))
    eigenvalue = l * (l + 1)
    coefficients = (
        q.coefficients(q.magnetic_fields(vorticity_response)[1], l),
        q.coefficients(q.magnetic_fields(potential_response)[0], l),
    )
    np.testing.assert_allclose(coefficients[0], 1j * m * b / eigenvalue * wave, atol=1e-13)
    np.testing.assert_allclose(coefficients[1], 1j * m * b * (eigenvalue - 2) * wave, atol=1e-12)


@pytest.mark.slow
def test_midpoints_keep_what_is_quadratic():
    """Energy, cross helicity and the square of the potential are conserved; cubic Casimirs are a control."""
    q = QuantisedSphere(6)
    run = lt.integrate(magnetic_fluid(6), start(q), (0.0, 0.5), 0.01, lt.MetriplecticMidpoint(), save_every=10)
    assert np.ptp(run.energy) <= 1e-14 * abs(run.energy[0])
    changes = {name: np.ptp(series) / np.abs(series).max() for name, series in run.casimirs.items()}
    assert len(changes) == 4
    assert [change < 1e-13 for change in changes.values()] == [True, True, False, False], changes
    W, B = q.magnetic_fields(run.x[:: len(run.x) - 1])
    cross = [np.vdot(q.matrix(w), q.matrix(b)).real for w, b in zip(W, B, strict=True)]
    assert cross[1] == pytest.approx(cross[0], rel=1e-12)
    assert np.abs(run.x[-1] - run.x[0]).max() > 0.1  # it has moved


@pytest.mark.slow
def test_energy_cross_helicity_and_magnetic_casimirs_are_kept_in_ten_thousand_steps():
    q = QuantisedSphere(6)
    run = lt.integrate(
        magnetic_fluid(6), start(q), (0.0, 100.0), 0.01, lt.MetriplecticRungeKutta(4), save_every=1000, engine="array"
    )
    assert run.audit().passed, str(run.audit())
    assert np.ptp(run.energy) <= 1e-13 * abs(run.energy[0])
    for name, series in run.casimirs.items():
        assert np.ptp(series) <= 1e-12 * np.abs(series).max(), name


@pytest.mark.slow
def test_the_energy_decays_and_the_casimirs_stay():
    q = QuantisedSphere(6)
    run = lt.integrate(magnetic_fluid(6, 0.2), start(q), (0.0, 2.0), 0.01, lt.MetriplecticRungeKutta(4), save_every=20)
    assert run.audit().passed, str(run.audit())
    assert (np.diff(run.energy) < 0.0).all()
    assert run.energy[-1] < 0.95 * run.energy[0]
    spectra = [np.linalg.eigvalsh(1j * np.asarray(q.matrix(q.magnetic_fields(y)[1]))) for y in (run.x[0], run.x[-1])]
    np.testing.assert_allclose(spectra[1], spectra[0], atol=1e-5)  # what is not followed is kept to the order: 5e-7


def test_a_metric_may_be_a_diagonal():
    random = np.random.default_rng(0)
    x, entries = random.standard_normal(3), random.uniform(0.5, 2.0, 3)
    fields = [
        lt.LiePoissonSystem(lt.models.free_rigid_body().algebra, lambda p: p[0] ** 2, None, lt.DoubleBracket(0.3, G))
        for G in (entries, np.diag(entries))
    ]
    np.testing.assert_allclose(fields[0].vector_field(x), fields[1].vector_field(x), rtol=1e-14)
    for invalid_metric, message in ((-entries, ">= 0"), (entries[:2], "3 components")):
        with pytest.raises(lt.InputError, match=message):
            lt.LiePoissonSystem(
                lt.models.free_rigid_body().algebra, lambda p: p[0], None, lt.DoubleBracket(0.3, invalid_metric)
            )
