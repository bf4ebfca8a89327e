"""The isolated body with internal friction against closed forms, with every method and also at the scale of
asteroids."""

import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.liethermo.test_bodies import free_body_run

ROUND = (1.0, 1.0, 1.6)
START = np.array([0.8, 0.1, 0.6])
METHODS = {
    "midpoint": lt.MetriplecticMidpoint(),
    "gauss": lt.MetriplecticGauss(3),
    "rk8": lt.MetriplecticRungeKutta(8),
    "taylor": lt.MetriplecticTaylor(8),
}


def assert_laws_hold(run):
    """Assert both laws to rounding, at 5 times the measured errors."""
    energy_scale = np.abs(run.energy).max()
    assert np.abs(run.energy - run.energy[0]).max() <= 4e-15 * energy_scale
    assert run.stats.least_entropy_increment >= -4e-16 * max(np.abs(run.entropy).max(), 1e-300)
    L = np.linalg.norm(run.x[:, :3], axis=1)
    assert np.ptp(L) <= 4e-15 * L[0]


def spatial_momentum_drift(run):
    """Return the largest change of the angular momentum in space, relative to its norm."""
    S = np.einsum("tij,tj->ti", run.attitude, run.x[:, :3])
    return np.abs(S - S[0]).max() / np.linalg.norm(S[0])


def test_the_nutation_of_a_round_body_falls_by_its_closed_form():
    """``tan theta = tan theta_0 exp(-rate (1/I_1 - 1/I_3) L^2 t)``: 4e-16 measured with steps of order 8."""
    body = lt.models.tumbling_body(ROUND, rate=0.05, capacity=2.0)
    run = lt.integrate(body, START, (0.0, 40.0), 0.1, METHODS["rk8"])
    tangents = np.tan(lt.bodies.nutation(run))
    exact = tangents[0] * np.exp(-0.05 * (1 / 1.0 - 1 / 1.6) * (START @ START) * run.t)
    assert np.abs(tangents - exact).max() < 1e-12
    assert_laws_hold(run)
    assert spatial_momentum_drift(run) < 1e-14  # 5e-15
    assert {row.law for row in run.audit().rows} >= {"drift of momentum in space", "energy drift"}
    assert run.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scale", [1e19, 1e-3], ids=["asteroid", "satellite"])
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(method, id=name, marks=() if name in ("midpoint", "gauss") else pytest.mark.slow)
        for name, method in (METHODS | {"adaptive": "adaptive"}).items()
    ],
)
def test_both_laws_and_the_momentum_in_space_at_sizes_in_si(method, scale):
    """Moments of 1e19 kg m^2 that turn in days, and of 1e-3 kg m^2 that turn in seconds, compared with DOP853."""
    inertia, omega = scale * np.array([1.0, 1.5, 2.0]), 2e-5 if scale > 1.0 else 0.2
    mu0 = inertia * omega * np.array([0.5, 0.05, 1.0])
    energy = np.sum(mu0**2 / inertia) / 2
    tau, capacity = 20.0 / omega, energy / 300.0
    body = lt.models.tumbling_body(inertia, tau, mu0, capacity=capacity, temperature=300.0)
    step, integrator = (0.05 / omega, method) if method != "adaptive" else (lt.Adaptive(1e-9), METHODS["rk8"])
    run = lt.integrate(body, mu0, (0.0, 40.0 / omega), step, integrator)
    assert_laws_hold(run)
    assert spatial_momentum_drift(run) < 3e-14  # up to 6e-15
    assert np.allclose(body.temperatures(run.x)[-1], 300.0 * np.exp(run.x[-1, 3] / capacity), rtol=1e-15)
    kinetic = 0.5 * np.sum(run.x[:, :3] ** 2 / inertia, axis=1)
    heat = capacity * (body.temperatures(run.x)[:, 0] - 300.0)
    assert np.abs(kinetic + heat - energy).max() < 1e-13 * energy
    reference = free_body_run(
        inertia / scale, mu0 / scale / omega, 40.0, rate=float(body.dissipation.part.rate) * scale * omega
    )
    error = np.abs(run.x[-1, :3] / scale / omega - reference.y[:3, -1]).max()
    assert error < (3e-3 if method is METHODS["midpoint"] else 1e-7)
    assert np.allclose(run.attitude[-1], reference.y[3:, -1].reshape(3, 3), rtol=0, atol=3e-2 if error > 1e-6 else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e19, 1.0, 1e-9])
def test_long_explicit_steps_in_any_units(scale):
    """A momentum of 1e15 beside an entropy of 1e7 once made the energy drift by 4e-10; it is exact now."""
    omega = 2e-5 if scale > 1.0 else 1.0
    inertia = scale * np.array([1.0, 1.5, 2.0])
    mu0 = inertia * omega * np.array([0.5, 0.05, 1.0])
    capacity = np.sum(mu0**2 / inertia) / 600.0
    body = lt.models.tumbling_body(inertia, 20.0 / omega, mu0, None, capacity, 300.0, attitude=False)
    run = lt.integrate(body, mu0, (0.0, 40.0 / omega), lt.Adaptive(1e-6), METHODS["rk8"])
    assert 30 < run.stats.steps < 45
    assert_laws_hold(run)
    assert run.audit().passed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "tolerance", "scale"),
    [("midpoint", 1e-13, 1.0), ("gauss", 1e-13, 1e19), ("rk4", 5e-15, 1.0), ("rk8", 5e-15, 1e-3)],
)
def test_the_momentum_in_space_after_a_million_steps(method, tolerance, scale):
    """Implicit steps conserve the momentum in space to 3e-14, explicit ones to 1e-15.

    The error was 9e-13 while each step measured it from the result of the previous step.
    """
    inertia, omega = scale * np.array([1.0, 1.5, 2.0]), 1.0 if scale == 1.0 else 2e-5 if scale > 1.0 else 0.2
    mu0 = inertia * omega * np.array([0.8, 0.07, 0.3])
    for friction in (1e-6, 1e-3):
        rate = friction / np.linalg.norm(mu0)
        body = lt.models.tumbling_body(inertia, rate=rate, capacity=np.sum(mu0**2 / inertia), temperature=1.0)
        integrator = METHODS.get(method, lt.MetriplecticRungeKutta(4))
        run = lt.integrate(body, mu0, (0.0, 1e5 / omega), 0.1 / omega, integrator, save_every=10_000)
        assert run.stats.steps == 1_000_000
        assert spatial_momentum_drift(run) < tolerance
        assert run.stats.attitude_residual < 1e-15


def test_the_rate_that_a_relaxation_time_asks_for():
    """The nutation of a body with three different moments decays by e in tau, up to the square of the nutation."""
    inertia, tau, L = np.array([1.0, 1.3, 2.0]), 200.0, 1.7
    angle = 1e-4
    mu0 = L * np.array([np.sin(angle), 0.0, np.cos(angle)])
    body = lt.models.tumbling_body(inertia, relaxation_time=tau, momentum=L, attitude=False)
    rate = float(body.dissipation.part.rate)
    exact_rate = rate * L**2 / 2 * ((1 / inertia[0] - 1 / inertia[2]) + (1 / inertia[1] - 1 / inertia[2]))
    assert exact_rate == pytest.approx(1 / tau, rel=1e-14)
    # what oscillates is left out at times a whole number of periods apart
    d1, d2 = 1 / inertia[0] - 1 / inertia[2], 1 / inertia[1] - 1 / inertia[2]
    frequency = np.sqrt(d1 * d2 * L**2 - (rate * L**2 * (d1 - d2) / 2) ** 2)  # of the linear equations with friction
    times = 2 * np.pi / frequency * np.arange(40)
    run = lt.integrate(body, mu0, (0.0, times[-1]), 0.05, METHODS["rk8"], save_at=times)
    fall = np.log(lt.bodies.nutation(run)[:-1] / lt.bodies.nutation(run)[1:]) / np.diff(times)
    assert np.abs(fall * tau - 1).max() < 1e-7
    slower_body = lt.models.tumbling_body(inertia, relaxation_time=1.01 * tau, momentum=mu0)
    assert float(slower_body.dissipation.part.rate) == pytest.approx(rate / 1.01, rel=1e-12)


def test_it_ends_in_a_spin_about_the_axis_of_greatest_inertia_as_warm_as_the_balance_says():
    inertia = np.array([3.0, 2.0, 1.5])
    body = lt.models.tumbling_body(inertia, rate=0.2, capacity=2.0, temperature=1.5, attitude=False)
    assert body.group is None
    run = lt.integrate(body, START, (0.0, 600.0), 0.2)
    assert run.attitude is None
    min_energy = START @ START / (2 * 3.0)
    assert np.isclose(np.sin(lt.bodies.nutation(run)[-1]), 0.0, atol=1e-6)
    temperature_rise = (0.5 * np.sum(START**2 / inertia) - min_energy) / 2.0
    assert float(body.temperatures(run.x[-1])[0]) == pytest.approx(1.5 + temperature_rise, rel=1e-10)


@pytest.mark.slow
def test_body_quantities_of_an_ensemble_are_those_of_its_members():
    """The members have different rates, or different inertias and then no common axis."""
    body = lt.models.tumbling_body(ROUND, rate=0.05)
    rates = np.array([0.02, 0.05])
    trajectories = lt.ensemble(
        body, START, (0.0, 10.0), 0.1, parameters={"dissipation.part.rate": rates}, outputs="trajectory"
    )
    for i in range(2):
        for quantity in (lt.bodies.nutation, lt.bodies.precession, lt.bodies.spin, lt.bodies.quaternions):
            assert np.allclose(quantity(trajectories)[i], quantity(trajectories[i]), rtol=0, atol=1e-12)
    final_states = lt.ensemble(body, START, (0.0, 10.0), 0.1, parameters={"dissipation.part.rate": rates})
    assert np.allclose(lt.bodies.nutation(final_states), lt.bodies.nutation(trajectories)[:, -1], rtol=0, atol=1e-14)
    assert lt.bodies.quaternions(final_states).shape == (2, 4)
    build = lambda I2: lt.models.tumbling_body((1.0, I2, 1.6), relaxation_time=10.0, momentum=1.0)  # noqa: E731
    mixed_inertias = lt.ensemble(build, START, (0.0, 1.0), 0.1, parameters=np.array([1.1, 1.2]))
    with pytest.raises(lt.InputError, match="Give axis="):
        lt.bodies.nutation(mixed_inertias)
    assert np.allclose(
        lt.bodies.nutation(mixed_inertias, (0, 0, 2)), [lt.bodies.nutation(run)[-1] for run in mixed_inertias]
    )


def test_noise_keeps_the_energy_the_size_of_the_momentum_and_the_momentum_in_space():
    body = lt.models.tumbling_body(ROUND, rate=0.05, capacity=50.0, temperature=0.2)
    run = lt.integrate(body, START, (0.0, 20.0), 0.05, noise=lt.Fluctuations(boltzmann=0.05, seed=3))
    assert np.ptp(run.energy) <= 4e-15 * np.abs(run.energy).max()
    assert np.ptp(np.linalg.norm(run.x[:, :3], axis=1)) < 4e-15
    assert spatial_momentum_drift(run) < 1e-14
    assert np.diff(run.entropy).min() < 0.0  # on a path it may fall


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lt.models.tumbling_body((3, 2, 1.5)), "got none of them"),
        (lambda: lt.models.tumbling_body((3, 2, 1.5), 1.0), "got relaxation_time"),
        (lambda: lt.models.tumbling_body((3, 2, 1.5), 1.0, 1.0, 1.0), "got relaxation_time, momentum, rate"),
        (lambda: lt.models.tumbling_body((3, 2, 1.5), 1.0, (1.0, 2.0)), "one number, or three"),
        (lambda: lt.models.tumbling_body((3, 2, 1.5), 0.0, 1.0), "a relaxation time must be positive"),
        (lambda: lt.models.tumbling_body((2, 2, 2), 1.0, 1.0), "three equal moments"),
        (lambda: lt.models.tumbling_body((3, 2, 1.5), rate=-1.0), "must be >= 0 and finite, got -1.0"),
        (lambda: lt.models.tumbling_body((3, 2, 1.5), rate=1.0, capacity=0.0), "capacity of a bath must be positive"),
        (lambda: lt.models.tumbling_body((3, 2, -1.5), rate=1.0), "positive and finite"),
    ],
)
def test_invalid_parameters_are_refused(make, message):
    with pytest.raises(lt.InputError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


# -- baths of any system ----------------------------------------------------------------------------------------------

ENERGY = lt.Quadratic([1.0, 0.5, 0.4])
CASIMIR = lt.Quadratic(np.ones(3))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda **baths: lt.LiePoissonSystem(mf.so(3), ENERGY, CASIMIR, lt.KillingDissipation(), **baths),
            "does not lower the energy",
        ),
        (lambda **baths: lt.LiePoissonSystem(mf.so(3), ENERGY, **baths), "has no dissipation"),
        (lambda **baths: lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), ENERGY, **baths), "has no dissipation"),
        (
            lambda **baths: lt.MetriplecticSystem(
                mf.LiePoisson(mf.so(3)), ENERGY, CASIMIR, lt.ProjectedMetric(), **baths
            ),
            "does not lower the energy",
        ),
    ],
)
def test_a_bath_without_a_source_of_heat_is_refused(make, message):
    with pytest.raises(lt.InputError, match=message) as error:
        make(baths=lt.HeatBaths())
    assert "\n" not in str(error.value)
    make()


def test_a_metric_that_is_not_positive_is_refused():
    for metric, message in (
        (np.diag([1.0, 1.0, -1.0]), "negative eigenvalue -1"),
        (np.diag([1.0, 1.0, np.nan]), "finite"),
    ):
        with pytest.raises((lt.InputError, lt.IndefiniteError), match=message) as error:
            lt.DoubleBracket(0.1, metric=metric)
        assert "\n" not in str(error.value)
