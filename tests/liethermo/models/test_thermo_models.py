"""The thermodynamic models against their closed forms and the figures of SML."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.models.gases import (
    GAS_CONSTANT,
    MASS_SPRING_CASES,
    IdealGas,
    cylinder_rest,
    gas_piston_equilibrium,
    gas_piston_state,
    mass_spring_gas_solution,
)
from liethermo.models.springs import damped_oscillator_solution
from liethermo.models.thermo_particles import thermo_particles_solution
from liethermo.tracing.interpret import evaluate_at_points
from tests.cases import tolerance
from tests.refusals import refusal_test


def run(system, x0, t, h, method=None):
    solution = lt.integrate(system, x0, (0.0, t), h, method, engine="array")
    assert solution.audit().energy_drift <= tolerance("energy")
    assert solution.stats.least_entropy_increment >= -tolerance("entropy") * np.abs(solution.entropy).max()
    return solution


# -- the closed forms themselves --------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.1, 2.0, 5.0], ids=["under", "critical", "over"])
def test_the_exact_oscillator(friction):
    """The exact solution satisfies the equations and conserves the energy, for any damping."""
    system, x0 = lt.models.damped_oscillator(2.0, 2.0, friction), [0.3, -1.0, 0.2]
    parameters = (2.0, 2.0, friction)
    t, dt = np.array([0.0, 0.7, 3.0]), 1e-5
    x, x_after, x_before = (damped_oscillator_solution(t + s, x0, *parameters) for s in (0.0, dt, -dt))
    assert np.allclose(x[0], x0, rtol=0, atol=1e-15)
    assert np.allclose((x_after - x_before) / (2 * dt), system.vector_field(x), rtol=0, atol=1e-8)
    assert np.ptp(np.asarray(system.energy(x))) < 1e-14


def test_the_exact_relaxation():
    """The exact solution for three bodies in a row satisfies the equations, and ends at the mean temperature."""
    c, k, T0 = np.array([1.0, 2.0, 0.5]), [(0, 1, 0.7), (1, 2, 2.0)], np.array([3.0, 1.0, 2.0])
    system, t, dt = lt.models.thermo_particles(c, k), np.array([0.0, 0.5, 200.0]), 1e-5
    T, T_after, T_before = (thermo_particles_solution(t + s, T0, c, k) for s in (0.0, dt, -dt))
    x = c * np.log(T)
    assert np.allclose(T[0], T0, rtol=1e-14)
    assert np.allclose(T[2], c @ T0 / c.sum(), rtol=1e-12)
    assert np.allclose(system.energy(x), c @ T0, rtol=1e-14)
    assert np.allclose(system.temperatures(x), T, rtol=1e-14)
    rates = np.asarray(system.vector_field(x)) * T / c  # T' = T S' / c
    assert np.allclose((T_after - T_before) / (2 * dt), rates, rtol=0, atol=1e-8)


def test_the_ideal_gas():
    """``T = U_S``, ``P = -U_V = n R T / V``, and the entropy is the inverse function."""
    gas, T, V = IdealGas(jnp.asarray(2.0), jnp.asarray(0.3)), 350.0, 0.4
    S = gas.entropy(T, V)
    dS, dV = 1e-4, 1e-6
    nRT = 2.0 * GAS_CONSTANT * T
    assert float(gas.energy(S, V)) == pytest.approx(1.5 * nRT, rel=1e-14)
    assert float(gas.energy(S + dS, V) - gas.energy(S - dS, V)) / (2 * dS) == pytest.approx(T, rel=1e-8)
    assert float(gas.energy(S, V + dV) - gas.energy(S, V - dV)) / (2 * dV) == pytest.approx(-nRT / V, rel=1e-8)


# -- the figures of the paper -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_figures_1_and_2():
    """(39) from (0, 10, 0): q to second order, S too, both laws; the errors that the figures show."""
    errors = []
    for h in (0.2, 0.1, 0.05):
        solution = run(lt.models.damped_oscillator(), [0.0, 10.0, 0.0], 60.0, h)
        errors.append(np.abs(solution.x - damped_oscillator_solution(solution.t, [0.0, 10.0, 0.0])).max(axis=0))
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (np.abs(ratios - 4.0) < 0.1).all(), ratios
    assert errors[1] == pytest.approx([0.06120, 0.06130, 0.6104], rel=1e-3)  # of (39), iterated by itself


@pytest.mark.slow
def test_figures_3_and_4():
    """273.15 and 300: temperatures as in the picture, equal at the end; entropy from 11.3138 to 11.3160."""
    system = lt.models.thermo_particles()
    solution = run(system, np.log([273.15, 300.0]), 50.0, 0.1)
    assert solution.stats.steps == 500
    assert (np.diff(solution.entropy[:50]) > 0).all()
    T = np.asarray(system.temperatures(solution.x))
    exact = thermo_particles_solution(solution.t, [273.15, 300.0])
    assert np.abs(T - exact).max() == pytest.approx(0.0165, rel=0.02)
    assert np.abs(T[-1] - 286.575).max() < 1e-12 * 286.575
    assert solution.entropy[[0, -1]] == pytest.approx([np.log(273.15 * 300.0), 2 * np.log(286.575)], rel=1e-15)


@pytest.mark.slow
def test_figures_5_and_6():
    """(42) from q = 0, 1: the path to first order; the energy oscillates and settles 1.7 % below where it began."""

    def action(q0, q1, S0, h):
        return (q1 - q0) @ (q1 - q0) / (2 * h) - h * (q1 + q0) @ (q1 + q0) / 8 - h * 0.1 * S0

    system, method, errors = lt.models.damped_oscillator(), lt.DiscreteHerglotz(action), []
    for h in (0.1, 0.05, 0.025):
        x1 = method.state(0.0, 10.0 * h, 0.0, h)
        solution = lt.integrate(system, x1, (0.0, 80.0), h, method, engine="array")
        errors.append(np.abs(solution.x[:, 0] - damped_oscillator_solution(solution.t, x1)[:, 0]).max())
        if h == 0.1:
            energies_of_42 = [51.2478125, 50.3769]  # the formula, iterated by itself
            assert solution.energy[[0, -1]] == pytest.approx(energies_of_42, abs=1e-4)
            assert np.ptp(solution.energy) > 0.5
    assert errors[0] == pytest.approx(0.07113, rel=1e-3)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.2)


# -- the others -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_moving_particles():
    """Uniform motion, exactly, and the heat as if at rest."""
    system = lt.models.moving_thermo_particles((1.0, 2.0), (1.0, 3.0), 0.5, dimension=2)
    x0 = [0.0, 1.0, 0.3, -0.2, 0.1, 2.0, 0.0, -1.0, 0.5, 0.9]
    solution = run(system, x0, 4.0, 0.1)
    (q, p, _), (Q, P, _) = [np.split(np.asarray(part), [2, 4], axis=-1) for part in system.split(solution.x)]
    assert np.abs(p - [0.3, -0.2]).max() < 1e-15
    assert np.abs(P - [-1.0, 0.5]).max() < 1e-15
    assert np.abs(q[-1] - [1.2, 0.2]).max() < 1e-14
    assert np.abs(Q[-1] - [0.0, 1.0]).max() < 1e-14
    resting_run = run(lt.models.thermo_particles((1.0, 3.0), 0.5), [0.1, 0.9], 4.0, 0.1)
    assert np.abs(system.entropies(solution.x) - resting_run.x).max() < 1e-13


@pytest.mark.slow
def test_thermo_springs():
    """Without friction the spring swings as if cold; with drag it stops, and all its energy is heat, shared evenly."""
    x0 = [1.0, 0.0, 0.0, -1.0, 0.0, 0.5]
    cold = run(lt.models.thermo_springs(stiffness=2.0), x0, 10.0, 0.05)
    omega = 2 * np.arctan(0.05) / 0.05  # of the midpoint rule; 2 exactly
    assert np.abs(cold.x[:, 0] - np.cos(omega * cold.t)).max() < 1e-12
    with_drag = lt.models.thermo_springs(stiffness=2.0, drag=1.0)
    solution = run(with_drag, [1.0, 0.3, 0.0, -1.0, 0.3, 0.5], 40.0, 0.1)
    assert np.abs(solution.casimirs["momentum"] - 0.6).max() < 1e-14
    assert "momentum" in solution.laws.unpromised  # kept all the same, as a momentum that is linear
    T = np.asarray(with_drag.temperatures(solution.x[-1]))
    assert np.allclose(T, (solution.energy[0] - 0.3**2) / 2, rtol=1e-6)
    assert "momentum" not in lt.models.thermo_springs(friction=0.1).momentum_maps


@pytest.mark.slow
@pytest.mark.parametrize("moles", [(1.0, 2.0)])
def test_gas_piston_reaches_its_equilibrium(moles):
    """The final state has the position and the temperature of the closed form."""
    system = lt.models.gas_piston(moles, mass=50.0, capacity=5.0, conductance=(50.0, 50.0), friction=400.0)
    x0 = gas_piston_state(0.5, (400.0, 300.0, 250.0), moles, capacity=5.0)
    assert np.allclose(system.temperatures(x0), [400.0, 300.0, 250.0], rtol=1e-14)
    solution = run(system, x0, 15.0, 0.02)
    q, T = gas_piston_equilibrium(solution.energy[0], moles, capacity=5.0)
    assert solution.x[-1, 1] == pytest.approx(q, abs=1e-9)
    assert np.allclose(system.temperatures(solution.x[-1]), T, rtol=1e-9)
    assert abs(solution.x[-1, 2]) < 1e-7
    report = system.check(points=solution.x[::100])
    assert report.passed, f"\n{report}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(6)], ids=str
)
def test_thermoelastic_chain(method):
    """Both laws and the angular momentum to rounding; heat flows and the springs calm down."""
    chain = lt.models.thermoelastic_chain(2, 2, stiffness=20.0, expansion=2.0, conductance=1.0)
    x0 = [1.2, 0.0, 0.0, 2.0, 0.0, 2.6, 0.2, -0.5, 3.0, 0.0]
    solution = run(chain, x0, 20.0, 0.05, method)
    momentum = solution.casimirs["angular momentum xy"]
    assert momentum[0] == pytest.approx(1.2 * 2.0 + 2.6 * 3.0 + 0.2 * 0.5)
    assert np.abs(momentum - momentum[0]).max() <= tolerance("casimir") * momentum[0]
    assert ("angular momentum xy" in solution.laws.conserved) == method.explicit  # the others hold it on request
    assert solution.entropy[-1] > solution.entropy[0] + 1e-3


@pytest.mark.slow
def test_a_thermospring():
    """``T = e_S``; slack and without entropy at its own length and temperature; tension as the docstring says."""
    chain = lt.models.thermoelastic_chain(1, 1, stiffness=3.0, expansion=0.4, capacity=2.0, length=1.5, temperature=4.0)
    assert float(chain.energy([1.5, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-15)
    assert float(chain.temperatures([1.5, 0.0, 0.0])[0]) == pytest.approx(4.0, rel=1e-15)
    r, S = 1.8, 0.3
    u = np.log(r / 1.5)
    T = 4.0 * np.exp((S - 0.4 * u) / 2.0)
    assert float(chain.temperatures([r, 0.0, S])[0]) == pytest.approx(T, rel=1e-14)
    assert float(chain.vector_field([r, 0.0, S])[1]) == pytest.approx(-(3.0 * u - 0.4 * (T - 4.0)) / r, rel=1e-13)
    hung = lt.models.thermoelastic_chain(2, 3, gravity=9.81)
    assert not hung.momentum_maps
    x = np.random.default_rng(0).standard_normal(14)
    free = lt.models.thermoelastic_chain(2, 3)
    difference = np.asarray(hung.vector_field(x) - free.vector_field(x))
    assert np.allclose(difference[[5, 12]], -9.81, rtol=1e-14)
    assert len(free.momentum_maps) == 3


test_unusable_parameters = refusal_test(
    (lambda: lt.models.damped_oscillator(friction=0.0), "friction must be positive"),
    (lambda: lt.models.thermo_particles((1.0, -1.0)), "capacities must be positive"),
    (lambda: lt.models.thermo_particles((1.0, 1.0, 1.0)), "only for two parts, got 3"),
    (lambda: lt.models.moving_thermo_particles(dimension=0), "dimension must be an integer >= 1"),
    (lambda: lt.models.moving_thermo_particles(masses=(1.0,)), r"masses must have shape \(2,\), got \(1,\)"),
    (lambda: lt.models.thermo_springs(conductance=-1.0), ">= 0"),
    (lambda: lt.models.gas_piston(moles=(1.0, 0.0)), "moles must be positive"),
    (lambda: lt.models.thermoelastic_chain(dimension=4), "1, 2 or 3, got 4"),
    (lambda: lt.models.thermoelastic_chain(bodies=0), "bodies must be an integer"),
)


START = [0.3, -0.2, 0.1]
FRICTIONS = {"undamped": 0.0, "underdamped": 2.0, "critical": 10.0, "overdamped": 25.0}


def _rate(system, x):
    return system.vector_field(x)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("friction", FRICTIONS.values(), ids=FRICTIONS)
@pytest.mark.parametrize("case", MASS_SPRING_CASES)
def test_the_exact_solution_solves_the_equations(case, friction):
    """Eighth-order differences of the exact solution agree with the field, in every regime of damping."""
    system = lt.models.mass_spring_gas(**MASS_SPRING_CASES[case], friction=friction)
    t, d = np.linspace(0.5, 9.5, 10), 0.02

    def path(t):
        return mass_spring_gas_solution(t, START, **MASS_SPRING_CASES[case], friction=friction)

    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    slopes = sum(w * (path(t + i * d) - path(t - i * d)) / d for i, w in weights.items())
    assert np.abs(slopes - evaluate_at_points(_rate, system, path(t))).max() < 1e-10
    assert np.array_equal(path(0.0), START)
    energy = np.asarray(system.energy(path(t)))
    assert np.ptp(energy) < 1e-12 * energy[0]


def test_the_branches_of_damping_meet():
    """The solution is continuous at critical damping, which is 10 kg/s in Case 1."""
    t = np.linspace(0.0, 300.0, 50)
    critical = mass_spring_gas_solution(t, START, friction=10.0)
    for nearby_friction in (10.0 * (1 - 1e-9), 10.0 * (1 + 1e-9)):
        assert np.abs(mass_spring_gas_solution(t, START, friction=nearby_friction) - critical).max() < 1e-8
    assert np.isfinite(mass_spring_gas_solution(1e4, START, friction=1e3)).all()  # cosh alone overflows


def test_the_heat_is_the_printed_one():
    """The heat equals f(t) after (5.8), for 4 k m > lambda^2."""
    m, k, lam, (x0, v0, _), t = 5.0, 5.0, 2.0, START, np.linspace(0.0, 20.0, 9)
    root = np.sqrt(4 * k * m - lam**2)
    omega2 = root / m
    f = (
        0.5 * m * v0**2
        + 0.5 * k * x0**2
        - np.exp(-lam / m * t)
        / (2 * root**2)
        * (
            4 * k * m * (m * v0**2 + lam * v0 * x0 + k * x0**2)
            - lam * (v0**2 * lam * m + 4 * v0 * m * k * x0 + lam * k * x0**2) * np.cos(omega2 * t)
            - lam * (m * v0**2 - k * x0**2) * root * np.sin(omega2 * t)
        )
    )
    x, heat = mass_spring_gas_solution(t, START, friction=lam), 1.5 * 8.31446261815324
    T = 300.0 * np.exp(x[:, 2] / heat)
    assert np.abs(heat * (T - T[0]) - f).max() < 1e-11


@pytest.mark.slow
def test_a_gas_under_a_piston_returns_to_equilibrium():
    """The equilibrium has the external pressure; a displaced piston returns to it, warmer."""
    gas, rest = lt.models.cylinder(mass=20.0, friction=150.0, pressure=1e5), cylinder_rest(1e5, T=300.0)
    rate = evaluate_at_points(_rate, gas, np.asarray(gas.state(rest))[None])[0]
    assert np.abs(rate[:5]).max() < 1e-9  # the clock runs on
    assert float(gas.temperature(rest)) == pytest.approx(300.0, rel=1e-13)
    assert "temperature" not in gas.domain.why_outside(gas.state(rest))
    displaced = rest + np.array([0.5, 0.0, 0.0])
    solution = lt.integrate(gas, displaced, (0.0, 10.0), 0.01, lt.VariationalIntegrator.symmetrised(), engine="array")
    end = solution.x[-1]
    assert end[2] > displaced[2]
    assert np.abs(end[:3] - cylinder_rest(1e5, float(gas.temperature(end)))).max() < 1e-4


def test_pressure_and_heat_may_depend_on_time():
    gas = lt.models.cylinder(pressure=lambda q, v, S, t: 1e5 * (1 + t), heat_power=lambda q, v, S: 10.0)
    rest = cylinder_rest(1e5, T=300.0)
    rate_at_0, rate_at_1 = (evaluate_at_points(_rate, gas, np.array([[*rest, 0.0, 0.0, t]]))[0] for t in (0.0, 1.0))
    assert rate_at_0[1] - rate_at_1[1] == pytest.approx(1e5 * 0.01 / 1.0, rel=1e-9)
    assert rate_at_0[4] == 10.0


test_invalid_parameters_are_refused = refusal_test(
    (lambda: lt.models.mass_spring_gas(mass=0.0), "mass must be positive"),
    (lambda: lt.models.mass_spring_gas(friction=-1.0), "inject"),
    (lambda: lt.models.cylinder(area=-1.0), "area must be positive"),
    (lambda: lt.models.cylinder(pressure=lambda q, v, S: v * np.ones(2)), "external force"),
    error=(lt.InputError, lt.FunctionError),
)
