"""Baths whose temperature is a function of time, baths of several kinds, and power from a laser."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from tests.refusals import refusal_test

FIELD = 1.2
RATE = 0.3
START = np.array([1.0, 0.0, 0.2]) / np.sqrt(1.04)


def spin_in_a_bath(temperature, **arguments):
    zeeman = lt.magnetism.zeeman(1, (0.0, 0.0, FIELD))
    return lt.SpinSystem(1, zeeman, lt.LandauLifshitz(RATE), lt.HeatBaths(np.inf, temperature), **arguments)


def motion(t, u):
    """Rates of the spin, of the entropy, and of the work ``y T'``."""
    s, dH = u[:3], np.array([0.0, 0.0, -FIELD])
    torque = np.cross(s, dH)
    heat = RATE * torque @ torque
    return [*(torque + RATE * np.cross(s, torque)), heat / (1.0 + 0.5 * np.sin(t)), u[3] * 0.5 * np.cos(t)]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)])
def test_a_bath_with_a_given_temperature_does_its_work(method):
    reference = solve_ivp(motion, (0.0, 6.0), [*START, 0.0, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    system = spin_in_a_bath(lambda t: 1.0 + 0.5 * jnp.sin(t))
    run = lt.integrate(system, system.state(START), (0.0, 6.0), 0.025, method)
    audit = run.audit()
    assert audit.passed
    assert audit.energy_drift < 1e-15
    assert np.diff(run.entropy).min() > 0.0
    tolerance = 2e-4 if method.order == 2 else 1e-6
    assert np.abs(run.x[-1] - reference[:4]).max() < tolerance
    assert abs(run.casimirs["work"][-1] - reference[4]) < tolerance
    assert np.abs(system.temperatures(run.x, run.t)[:, 0] - 1.0 - 0.5 * np.sin(run.t)).max() < 1e-15


@pytest.mark.slow
def test_a_temperature_that_is_constant_as_a_function_changes_nothing():
    noise, ends = lt.Fluctuations(seed=1), []
    for temperature in (0.8, lambda t: 0.8 + 0.0 * t):
        system = spin_in_a_bath(temperature)
        starts = np.repeat(np.asarray(system.state([0.0, 0.0, 1.0]))[None], 3, axis=0)
        ends.append(np.asarray(lt.ensemble(system, starts, (0.0, 1.0), 0.05, noise=noise).x))
    assert np.abs(ends[0] - ends[1]).max() < 1e-13
    assert np.ptp(ends[0][:, 2]) > 0.05


def test_noise_follows_a_temperature_that_rises_slowly():
    """The mean spin is Langevin's function of the temperature of the moment, within four standard errors."""
    system = spin_in_a_bath(lambda t: 0.3 + 0.1 * t)
    starts = np.repeat(np.asarray(system.state([0.0, 0.0, 1.0]))[None], 2000, axis=0)
    run = lt.ensemble(system, starts, (0.0, 30.0), 0.1, lt.MetriplecticMidpoint(), noise=lt.Fluctuations(seed=2))
    x = FIELD / 3.2  # the temperature of a time 1 / (rate * T) before the end, to which the spin has relaxed
    mean, error = run.x[:, 2].mean(), run.x[:, 2].std() / np.sqrt(2000)
    assert abs(mean - (1.0 / np.tanh(x) - 1.0 / x)) < 4.0 * error
    cold = FIELD / 0.3
    assert abs(mean - (1.0 / np.tanh(cold) - 1.0 / cold)) > 20.0 * error


@pytest.mark.slow
def test_a_cryostat_cools_electrons_through_phonons():
    """Three baths: electrons of capacity ``c T``, phonons, and a cryostat whose temperature is a function of time."""
    baths = lt.HeatBaths(
        capacity=[1.0, 3.0, np.inf],
        temperature=[1.0, 1.0, lambda t: 1.0 - 0.02 * t],
        number=3,
        energy=[lambda y: y + y**2 / 1.0, None, None],
    )
    zeeman = lt.magnetism.zeeman(1, (0.0, 0.0, FIELD))
    damping = [lt.LandauLifshitz(RATE), lt.BathConduction([(0, 1, 2.0), (1, 2, 1.0)])]
    system = lt.SpinSystem(1, zeeman, damping, baths)
    run = lt.integrate(system, system.state(START), (0.0, 30.0), 0.1, lt.MetriplecticGauss(2))
    assert run.audit().passed
    T = np.asarray(system.temperatures(run.x, run.t))
    assert T[-1, 0] > T[-1, 1] > T[-1, 2]
    late = run.t > 20.0  # the spin has come to rest: what phonons and electrons lose flows to the cryostat
    lost = -3.0 * np.ptp(T[late, 1]) - 0.25 * np.ptp(T[late, 0] ** 2)
    assert abs(lost + np.trapezoid(T[late, 1] - T[late, 2], run.t[late])) < 1e-5


def test_the_pulse_has_its_energy_and_its_width():
    pulse = lt.magnetism.LaserPulse(energy=2.0, duration=0.1, centre=0.5)
    t = np.linspace(0.0, 1.0, 2001)
    assert abs(np.trapezoid(np.asarray(pulse(t)), t) - 2.0) < 1e-12
    assert abs(float(pulse(0.55)) - 0.5 * float(pulse(0.5))) < 1e-12


METHODS_ON_A_SPHERE = [
    (lt.MetriplecticMidpoint(), 1e-4),
    (lt.MetriplecticGauss(2), 5e-9),
    (lt.MetriplecticRungeKutta(4), 5e-8),
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "tolerance"), METHODS_ON_A_SPHERE, ids=str)
def test_friction_on_a_sphere_heats_a_bath(method, tolerance):
    """Beside SciPy: the point slides downhill on the sphere, and the bath takes the energy."""
    A, rate, capacity, temperature = np.diag([1.0, 2.0, 4.0]), 0.3, 2.0, 1.5
    x0 = np.array([0.6, 0.48, 0.64])

    def rates(t, u):
        slope = A @ u[:3] - u[:3] * (u[:3] @ A @ u[:3])
        return [*(-rate * slope), rate * slope @ slope / (temperature * np.exp(u[3] / capacity))]

    reference = solve_ivp(rates, (0.0, 2.0), [*x0, 0.0], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    system = lt.MetriplecticSystem(
        mf.NoPoisson(3),
        lambda x: 0.5 * x @ jnp.asarray(A) @ x,
        dissipation=lt.Friction(rate * np.eye(3)),
        space=mf.Sphere(2),
        baths=lt.HeatBaths(capacity, temperature),
    )
    run = lt.integrate(system, x0, (0.0, 2.0), 0.05, method)
    assert np.abs(run.x[-1] - reference).max() < tolerance
    assert run.audit().passed
    assert run.audit().energy_drift < 1e-15
    assert system.check().passed


SPACES = {
    "sphere": mf.Sphere(2),
    "SPD(2)": mf.SPD(2),
    "SO(3)": mf.GroupSpace(mf.SO(3)),
    "product": mf.Product(mf.Sphere(2), mf.Euclidean(1)),
}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_random_states_of_spaces_with_baths(space):
    """The entropies of baths are normal numbers with their capacities as standard deviations."""
    size = space.size
    friction, baths = lt.Friction(np.eye(size)), lt.HeatBaths([1e3, 1e-3])
    system = lt.MetriplecticSystem(
        mf.NoPoisson(size), lambda x: jnp.sum(x**2), dissipation=friction, space=space, baths=baths, validate=False
    )
    entropies = system.samples(50)[:, size:]
    assert np.abs(np.log10(np.std(entropies, axis=0)) - [3.0, -3.0]).max() < 0.2


@pytest.mark.slow
def test_a_temperature_below_zero_stops_the_run():
    system = spin_in_a_bath(lambda t: 1.0 - t)
    with pytest.raises(lt.IntegrationError):
        lt.integrate(system, system.state(START), (0.0, 2.0), 0.05)


def test_power_from_a_bath_stops_the_run():
    """A device that takes heat would lower the entropy."""
    system = spin_in_a_bath(1.0, power=lambda t: jnp.cos(t))
    with pytest.raises(lt.IntegrationError):
        lt.integrate(system, system.state(START), (0.0, 4.0), 0.05)


def test_the_number_of_baths_is_that_of_their_entries():
    hot_and_cold = [2.0, 0.5]
    y = np.array([0.3, -0.2])
    for implied, given in [
        (lt.HeatBaths(3.0, hot_and_cold), lt.HeatBaths(3.0, hot_and_cold, number=2)),
        (lt.HeatBaths(np.array([1.0, 2.0])), lt.HeatBaths([1.0, 2.0], number=2)),
        (lt.HeatBaths(energy=[None, lambda y: y + y**2]), lt.HeatBaths(energy=[None, lambda y: y + y**2], number=2)),
    ]:
        assert implied.number == 2
        assert implied.energy.value(y) == given.energy.value(y)
    assert lt.HeatBaths(3.0, 2.0).number == lt.HeatBaths().number == 1


def test_a_system_without_baths_has_baths_of_number_zero():
    """Its baths may be given to another system, which has none either."""
    zeeman = lt.magnetism.zeeman(1, (0.0, 0.0, FIELD))
    system = lt.SpinSystem(1, zeeman, lt.LandauLifshitz(RATE))
    again = lt.SpinSystem(1, zeeman, lt.LandauLifshitz(RATE), baths=system.baths)
    assert system.baths.number == again.baths.number == 0
    assert system.dim == system.body_dim == again.dim == 3
    assert repr(again) == repr(system)
    assert np.array_equal(system.samples(2), again.samples(2))
    assert spin_in_a_bath(1.0).drop_baths().baths.number == 0
    with pytest.raises(lt.InputError, match=r"no baths\. Give it baths="):
        system.temperatures(START)


BAD = {
    "a finite capacity": (lambda: lt.HeatBaths(2.0, lambda t: 1.0 + t), "must be infinite"),
    "a vector of temperatures": (lambda: lt.HeatBaths(np.inf, lambda t: jnp.ones(2)), "must have shape"),
    "lists of different lengths": (lambda: lt.HeatBaths([1.0, 2.0], [1.0, 2.0, 3.0]), "of 3 baths"),
    "no temperatures": (lambda: lt.HeatBaths(1.0, []), "positive integer, got 0"),
    "too few temperatures": (lambda: lt.HeatBaths(1.0, [1.0], number=2), "must have one entry per bath, got 1"),
    "power without baths": (
        lambda: lt.SpinSystem(1, lt.magnetism.zeeman(1, (0, 0, 1.0)), power=lambda t: t),
        "Give baths",
    ),
    "power as a number": (lambda: spin_in_a_bath(1.0, power=1.0), "function of the time"),
    "power for two baths": (lambda: spin_in_a_bath(1.0, power=[None, lambda t: t]), "1 entries, one per bath"),
    "temperatures without times": (
        lambda: (s := spin_in_a_bath(lambda t: 1.0 + t)).temperatures(s.state(START)),
        "Give the time beside the state",
    ),
    "a pulse of no duration": (lambda: lt.magnetism.LaserPulse(1.0, 0.0), "positive"),
}


test_bad_baths_are_refused = refusal_test(BAD, error=(lt.InputError, lt.FunctionError))


def test_one_temperature_has_no_axis_and_several_have_one():
    one, two = (lt.HeatBaths(capacity=2.0, temperature=temperatures) for temperatures in (3.0, [3.0, 4.0]))

    def spin(baths):
        return lt.SpinSystem(1, lt.magnetism.zeeman(1, (0, 0, 1.0)), lt.LandauLifshitz(0.1), baths)

    x = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 2.0 * np.log(2.0)]])
    np.testing.assert_allclose(spin(one).temperature(x), [3.0, 6.0], rtol=1e-14)
    np.testing.assert_allclose(spin(one).temperatures(x), [[3.0], [6.0]], rtol=1e-14)
    with pytest.raises(lt.InputError, match=r"2 temperatures. Use system.temperatures\(x\), of shape \(..., 2\)"):
        spin(two).temperature(np.zeros(5))
    with pytest.raises(lt.InputError, match="no baths"):
        spin(None).temperature(x[:, :3])


def test_systems_with_a_temperature_of_their_own_have_both_forms():
    gas = lt.EvolutionSystem(lambda x: 0.5 * x[1] ** 2 + jnp.exp(x[2]), 3)
    x = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, np.log(5.0)]])
    np.testing.assert_allclose(gas.temperature(x), [1.0, 5.0], rtol=1e-14)
    np.testing.assert_allclose(gas.temperatures(x), [[1.0], [5.0]], rtol=1e-14)
    wheels = lt.models.body_with_wheels()
    y = wheels.state(angular_velocity=(0.1, 0.2, 0.3), temperature=1.7)
    assert float(wheels.temperature(y)) == pytest.approx(1.7, rel=1e-14)
    assert wheels.temperatures(y).shape == (1,)
    assert float(wheels.temperatures(y)[0]) == pytest.approx(1.7, rel=1e-14)
