"""Heat conduction between baths, beside SciPy, beside a closed form, and with noise beside an exact distribution."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.systems.spins import reorder_spins
from tests.refusals import refusal_test

FIELD = 1.2
RATE = 0.3
CONDUCTANCE = 0.7
ELECTRON_CAPACITY = 0.5
"""Capacity of the electrons over their temperature."""

PULSE = lt.magnetism.LaserPulse(energy=3.0, duration=0.4, centre=1.5)
START = np.array([1.0, 0.0, 0.2]) / np.sqrt(1.04)


def two_temperatures(**arguments):
    """A spin, electrons with the capacity ``c T``, which the spin and a laser heat, and phonons."""
    baths = lt.HeatBaths(
        capacity=[1.0, 20.0],
        temperature=[0.5, 0.5],
        number=2,
        energy=[lambda y: 0.5 * y + y**2 / (2.0 * ELECTRON_CAPACITY), None],
    )
    zeeman = lt.magnetism.zeeman(1, (0.0, 0.0, FIELD))
    damping = [lt.LandauLifshitz(RATE, bath=0), lt.BathConduction(CONDUCTANCE)]
    return lt.SpinSystem(1, zeeman, damping, baths, **arguments)


def motion(t, u):
    """Rates of the spin and of the two temperatures, written out."""
    s, T_e, T_p = u[:3], u[3], u[4]
    dH = np.array([0.0, 0.0, -FIELD])
    torque = np.cross(s, dH)
    into_electrons = RATE * torque @ torque + float(PULSE(t)) + CONDUCTANCE * (T_p - T_e)
    return [
        *(torque + RATE * np.cross(s, torque)),
        into_electrons / (ELECTRON_CAPACITY * T_e),
        CONDUCTANCE * (T_e - T_p) / 20.0,
    ]


@pytest.mark.parametrize(
    ("method", "order"),
    [(lt.MetriplecticMidpoint(), 2), (lt.MetriplecticGauss(2), 4), (lt.MetriplecticRungeKutta(4), 4)],
    ids=str,
)
def test_a_laser_heats_electrons_spins_and_phonons(method, order):
    """Temperatures are SciPy's at the order of the method; energy less work is exact, and the pulse is the work."""
    reference = solve_ivp(motion, (0.0, 6.0), [*START, 0.5, 0.5], rtol=1e-11, atol=1e-12).y[:, -1]
    system = two_temperatures(power=[PULSE, None])
    errors = []
    for h in (0.05, 0.025):
        run = lt.integrate(system, system.state(START), (0.0, 6.0), h, method)
        end = np.concatenate([run.x[-1, :3], system.temperatures(run.x[-1])])
        errors.append(np.abs(end - reference).max())
        audit = run.audit()
        assert audit.passed
        assert audit.energy_drift < 1e-15
        assert np.diff(run.entropy).min() > 0.0
        assert abs(run.casimirs["work"][-1] - 3.0) < 1e-12
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] > 0.85 * 2.0**order


def test_two_baths_approach_each_other_exponentially():
    """The difference of two temperatures decays at the rate ``G (1 / C_1 + 1 / C_2)``."""
    baths = lt.HeatBaths(capacity=[2.0, 3.0], temperature=[1.5, 0.5], number=2)
    system = lt.SpinSystem(1, lt.magnetism.zeeman(1, (0.0, 0.0, 1.0)), lt.BathConduction([(0, 1, 0.6)]), baths)
    run = lt.integrate(system, system.state([0.0, 0.0, 1.0]), (0.0, 4.0), 0.05, lt.MetriplecticGauss(3))
    T = np.asarray(system.temperatures(run.x))
    assert np.abs(T[:, 0] - T[:, 1] - np.exp(-0.6 * (1 / 2.0 + 1 / 3.0) * run.t)).max() < 1e-9
    assert np.ptp(T @ [2.0, 3.0]) < 1e-13
    assert run.audit().passed


@pytest.mark.slow
def test_noise_of_conduction_has_the_distribution_of_equal_energy():
    """A spin and two small baths with noise: mean temperatures and mean spin of ``exp(S)`` on the energy level."""
    C, T_0 = np.array([3.0, 5.0]), np.array([1.0, 0.6])
    damping = [lt.LandauLifshitz(0.5), lt.BathConduction(0.8)]
    system = lt.SpinSystem(1, lt.magnetism.zeeman(1, (0.0, 0.0, 2.0)), damping, lt.HeatBaths(C, T_0, 2))
    assert system.check().passed
    assert lt.Fluctuations().check(system).passed
    starts = np.repeat(np.asarray(system.state([0.0, 0.0, 1.0]))[None], 1000, axis=0)
    noise = lt.Fluctuations(seed=3)
    x = np.asarray(lt.ensemble(system, starts, (0.0, 16.0), 0.04, lt.MetriplecticMidpoint(), noise=noise).x)
    assert np.ptp(system.energy(x)) < 1e-12

    z, share = np.meshgrid(np.linspace(-1.0, 1.0, 201), (np.arange(2000) + 0.5) / 2000)
    U_min, total = -C * T_0, -2.0 + 2.0 * z  # energy of both baths, from the energy of the spin
    width = total - U_min.sum()
    U = U_min[0] + share * width
    T = T_0[0] + U / C[0], T_0[1] + (total - U) / C[1]
    weight = T[0] ** (C[0] - 1) * T[1] ** (C[1] - 1) * width
    exact = np.array([np.sum(weight * f) / np.sum(weight) for f in (*T, z)])
    observations = np.column_stack([system.temperatures(x), x[:, 2]])
    assert (
        np.abs(observations.mean(axis=0) - exact) < 4.0 * observations.std(axis=0) / np.sqrt(len(observations))
    ).all()
    assert (observations.std(axis=0) > 0.05).all()


def test_many_spins_conduct_component_by_component():
    """The order of components of a large lattice changes nothing: three baths, of which sites heat two."""
    sites = (3, 4, 5)
    baths = lt.HeatBaths([4.0, 6.0, 9.0], [1.0, 0.7, 0.4], 3)
    bath = np.arange(60).reshape(sites) % 2
    damping = [lt.LandauLifshitz(0.2, bath), lt.BathConduction([(0, 1, 0.3), (1, 2, 0.5)])]
    system = lt.SpinSystem(sites, lt.magnetism.exchange(sites, 1.0), damping, baths)
    planar = reorder_spins(system)
    assert planar is not None
    x = np.asarray(system.samples(1)[0])
    field = np.asarray(planar.restore_state(planar.system.vector_field(planar.reorder_state(x))))
    scale = np.abs(field).max()
    assert np.abs(field - np.asarray(system.vector_field(x))).max() < 1e-14 * scale
    total = np.asarray(lt.System.field(system, x, *(f.gradient(x) for f in (system.energy, system.entropy))))
    assert np.abs(field - total).max() < 1e-14 * scale


BAD = {
    "no baths": (lambda: _with(None, 0.1), "give the system baths"),
    "one bath": (lambda: _with(lt.HeatBaths(), 0.1), "number=2"),
    "a third bath": (lambda: _with(lt.HeatBaths(number=2), [(0, 2, 0.1)]), "number=3"),
    "a negative conductance": (lambda: _with(lt.HeatBaths(number=2), -0.1), ">= 0"),
    "an asymmetric matrix": (lambda: _with(lt.HeatBaths(number=2), np.array([[0.0, 1.0], [0.5, 0.0]])), "symmetric"),
}


def _with(baths, conductance):
    damping = [lt.LandauLifshitz(0.1), lt.BathConduction(conductance)]
    return lt.SpinSystem(1, lt.magnetism.zeeman(1, (0.0, 0.0, 1.0)), damping, baths)


test_bad_conductances_are_refused = refusal_test(BAD)


def test_bodies_with_baths_conduct_too():
    """A damped rigid body: its two baths come to one temperature, both laws exact."""
    body = lt.LiePoissonSystem(
        mf.so(3),
        energy=lt.Quadratic([1 / 3, 1 / 2, 1.0]),
        dissipation=[lt.DoubleBracket(0.2), lt.BathConduction(0.5)],
        baths=lt.HeatBaths([1.0, 2.0], [1.0, 0.5], 2),
    )
    run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 40.0), 0.1, lt.MetriplecticMidpoint())
    assert run.audit().passed
    assert np.ptp(np.asarray(body.temperatures(run.x[-1]))) < 0.01  # the damping still heats the first
