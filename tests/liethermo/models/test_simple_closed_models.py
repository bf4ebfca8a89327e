"""A mass on a spring in a gas, and a gas under a piston."""

from __future__ import annotations

import numpy as np
import pytest

import liethermo as lt
from liethermo.models.cylinder import cylinder_rest
from liethermo.models.mass_spring_gas import CASES, mass_spring_gas_solution
from liethermo.tracing.interpret import evaluate_at_points
from tests.refusals import refusal_test

START = [0.3, -0.2, 0.1]
FRICTIONS = {"undamped": 0.0, "underdamped": 2.0, "critical": 10.0, "overdamped": 25.0}


def _rate(system, x):
    return system.vector_field(x)


@pytest.mark.sampled(7)
@pytest.mark.parametrize("friction", FRICTIONS.values(), ids=FRICTIONS)
@pytest.mark.parametrize("case", CASES)
def test_the_exact_solution_solves_the_equations(case, friction):
    """Eighth-order differences of the exact solution agree with the field, in every regime of damping."""
    system = lt.models.mass_spring_gas(**CASES[case], friction=friction)
    t, d = np.linspace(0.5, 9.5, 10), 0.02

    def path(t):
        return mass_spring_gas_solution(t, START, **CASES[case], friction=friction)

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
