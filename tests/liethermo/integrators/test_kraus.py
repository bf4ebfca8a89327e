"""Steps that are quantum channels: positive and exact in the trace at any size, at their order beside SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import liethermo as lt
from tests.liethermo.dissipation.test_lindblad import LOWER, SX, SZ, liouvillian

H = 0.5 * SZ + 0.6 * SX
JUMPS = [(LOWER, 0.4), (SZ, 0.1)]
UPPER_LEVEL = np.diag([0.0, 1.0]).astype(complex)


def observed_orders(system, expected, steps, order):
    errors = []
    for step in steps:
        run = lt.integrate(system, UPPER_LEVEL, (0.0, 4.0), step, lt.KrausMethod(order))
        errors.append(np.abs(system.density(run.x[-1]) - expected).max())
    return np.log2(np.array(errors[:-1]) / errors[1:])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("order", [2, 4])
def test_order_with_a_constant_generator(order):
    system = lt.QuantumSystem(H, lt.LindbladJumps(JUMPS))
    expected = (scipy.linalg.expm(4 * liouvillian(H, JUMPS)) @ UPPER_LEVEL.ravel()).reshape(2, 2)
    orders = observed_orders(system, expected, (0.4, 0.2, 0.1), order)
    assert (orders > order - 0.2).all()


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 4])
def test_order_with_a_drive_and_rates_that_depend_on_time(order):
    system = lt.QuantumSystem(
        [0.5 * SZ, [0.8 * SX, lambda t: jnp.cos(1.1 * t)]],
        lt.LindbladJumps([(LOWER, lambda t: 0.4 * (1 + 0.9 * jnp.sin(t))), (SZ, 0.1)]),
    )

    def field(t, y):
        rates = [(LOWER, 0.4 * (1 + 0.9 * np.sin(t))), (SZ, 0.1)]
        power = -0.88 * np.sin(1.1 * t) * np.trace(y[:4].reshape(2, 2) @ SX)
        return np.append(liouvillian(0.5 * SZ + 0.8 * np.cos(1.1 * t) * SX, rates) @ y[:4], power)

    expected = scipy.integrate.solve_ivp(
        field, (0.0, 4.0), np.append(UPPER_LEVEL.ravel(), 0.0), method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    orders = observed_orders(system, expected[:4].reshape(2, 2), (0.2, 0.1, 0.05), order)
    assert (orders > order - 0.25).all()
    run = lt.integrate(system, UPPER_LEVEL, (0.0, 4.0), 0.1, lt.KrausMethod(order))
    np.testing.assert_allclose(run.casimirs["work"][-1], expected[4].real, atol={2: 2e-4, 4: 2e-7}[order])


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("step", [0.3, 3.0, 30.0])
def test_every_step_is_a_channel(order, step):
    """Steps far too long for accuracy stay positive and keep the trace; Gauss steps leave the cone."""
    rng = np.random.default_rng(0)
    a = rng.standard_normal((3, 3, 3)) + 1j * rng.standard_normal((3, 3, 3))
    system = lt.QuantumSystem(a[0] + a[0].conj().T, lt.LindbladJumps([(a[1], 0.3), (a[2], 0.2)]))
    run = lt.integrate(system, [0.0, 1.0, 0.0], (0.0, 10 * step), step, lt.KrausMethod(order))
    rho = np.asarray(system.density(run.x))
    assert run.status.ok
    assert np.linalg.eigvalsh(rho).min() > -1e-14
    np.testing.assert_allclose(np.trace(rho, axis1=1, axis2=2), 1.0, atol=1e-13)
    row = next(row for row in run.audit().rows if row.law == "least eigenvalue of rho")
    assert row.passed


def test_a_method_that_is_no_channel_leaves_the_cone():
    """Control: a Gauss step as long as that; the run stops, or its audit promises nothing."""
    system = lt.QuantumSystem(H, lt.LindbladJumps([(LOWER, 4.0)]))
    run = lt.integrate(system, UPPER_LEVEL, (0.0, 8.0), 2.0, lt.MetriplecticGauss(1), on_failure="return")
    assert np.linalg.eigvalsh(system.density(run.x)).min() < -1e-3
    row = next(row for row in run.audit().rows if row.law == "least eigenvalue of rho")
    assert row.passed is None


@pytest.mark.sampled(1)
@pytest.mark.parametrize("outputs", ["final", "trajectory"])
def test_the_audit_of_an_ensemble_shows_the_least_eigenvalue(outputs, tmp_path):
    """The worst trajectory is the one that starts in the upper level; a quantum channel keeps the others positive."""
    system = lt.QuantumSystem(H, lt.LindbladJumps([(LOWER, 4.0)]))
    states = np.stack([np.eye(2) / 2, UPPER_LEVEL])
    rows = {}
    for method in (lt.KrausMethod(2), lt.MetriplecticGauss(1)):
        many = lt.ensemble(system, states, (0.0, 8.0), 2.0, method, outputs=outputs, parameters=None)
        rows[type(method)] = next(row for row in many.audit().rows if row.law == "least eigenvalue of rho")
        many.save(tmp_path / "many.nc")
        assert str(lt.load(tmp_path / "many.nc").audit()) == str(many.audit())
    assert rows[lt.KrausMethod].passed
    assert rows[lt.KrausMethod].value > -1e-14
    gauss = rows[lt.MetriplecticGauss]
    assert gauss.passed is None
    if outputs == "trajectory":
        min_eigenvalue = min(np.linalg.eigvalsh(system.density(many.x))[np.isfinite(many.energy)].min(), 0.0)
        assert gauss.value == pytest.approx(min_eigenvalue, abs=1e-12)


def test_a_fast_precession_needs_no_short_steps():
    """Coherence turns 1,600 times between two steps; W is exact."""
    omega, gamma = 1e4, 0.1
    system = lt.QuantumSystem(np.diag([0.0, omega]), lt.LindbladJumps([(LOWER, gamma)]))
    rho = np.array([[0.5, 0.5], [0.5, 0.5]])
    run = lt.integrate(system, rho, (0.0, 4.0), 1.0, lt.KrausMethod(4))
    expected = 0.5 * np.exp(1j * omega * 4.0 - 0.5 * gamma * 4.0)
    np.testing.assert_allclose(system.density(run.x[-1])[0, 1], expected, atol=1e-8)


def test_a_channel_is_affine():
    """Mixtures of states are mixed by a step, as by the motion."""
    system = lt.QuantumSystem(H, lt.LindbladJumps(JUMPS))
    states = [np.diag([1.0, 0.0]), np.array([[0.5, 0.5j], [-0.5j, 0.5]]), None]
    states[2] = 0.3 * states[0] + 0.7 * states[1]
    ends = [lt.integrate(system, rho, (0.0, 2.0), 1.0, lt.KrausMethod(2)).x[-1] for rho in states]
    np.testing.assert_allclose(0.3 * ends[0] + 0.7 * ends[1], ends[2], atol=1e-15)


def test_what_is_refused():
    thermal = lt.QuantumSystem(SZ, lt.ThermalJumps([(LOWER, 0.1)]), baths=lt.HeatBaths(np.inf, 1.0))
    with pytest.raises(lt.InputError, match=r"KrausMethod needs lt\.LindbladJumps"):
        lt.integrate(thermal, np.eye(2) / 2, (0.0, 1.0), 0.1, lt.KrausMethod())
    with pytest.raises(lt.InputError, match=r"KrausMethod needs an lt\.QuantumSystem"):
        lt.integrate(lt.models.rigid_body(), [0.1, 0.2, 1.0], (0.0, 1.0), 0.1, lt.KrausMethod())
    with pytest.raises(lt.InputError, match="order must be 2 or 4"):
        lt.KrausMethod(3)
