"""Galerkin variational integrators: orders, the laws, and the energy error."""

from __future__ import annotations

import numpy as np
import pytest

import liethermo as lt
from liethermo.models.gases import mass_spring_gas_solution
from tests.liethermo.closed_systems import OPEN, X0

HOT = {"friction": 2.0, "moles": 0.001}
"""Parameters of a mass on a spring with little gas: friction heats it from 300 K to 366 K, so nothing is quadratic."""
START = [0.3, 0.5, 0.0]


def _slopes(errors):
    return np.log2(np.array(errors[:-1]) / errors[1:])


@pytest.mark.slow
@pytest.mark.parametrize(("stages", "order"), [(2, 4), (3, 6)])
def test_orders_against_the_exact_solution(stages, order):
    """The order is 2s for states and energy; the entropy grows at every step, also in coarse ones."""
    method, system = lt.VariationalGauss(stages), lt.models.mass_spring_gas(**HOT)
    assert method.order == order
    errors, drifts = [], []
    for steps in (8, 16, 32, 64):
        solution = lt.integrate(system, START, (0.0, 4.0), 4.0 / steps, method, save_every=steps // 8, engine="array")
        exact = mass_spring_gas_solution(solution.t, START, **HOT)
        errors.append(np.abs(solution.x - exact).max())
        drifts.append(solution.audit().energy_drift)
        assert solution.stats.least_entropy_increment > 0.0
    assert (np.abs(_slopes(errors) - order) < 0.3).all(), errors
    assert (np.abs(_slopes(drifts) - order) < 0.6).all(), drifts


@pytest.mark.slow
def test_one_stage_is_scheme_2():
    system = lt.models.mass_spring_gas(**HOT)
    methods = lt.VariationalGauss(1), lt.VariationalIntegrator.midpoint()
    gauss_states, scheme_states = (
        lt.integrate(system, START, (0.0, 4.0), 0.1, method, engine="compiled").x for method in methods
    )
    assert np.abs(gauss_states - scheme_states).max() < 1e-13


@pytest.mark.slow
def test_with_every_force_and_in_both_engines():
    """A Lagrangian of no special form, with work and heat from outside: state and energy balance have order 4."""
    system, method, errors, defects = OPEN["tangled"], lt.VariationalGauss(2), [], []
    exact = lt.integrate(system, X0, (0.0, 1.0), 1.0, lt.Reference(rtol=1e-12)).x[-1]
    for steps in (10, 20, 40):
        solution = lt.integrate(system, X0, (0.0, 1.0), 1.0 / steps, method, save_every=steps // 10, engine="array")
        errors.append(np.abs(solution.x[-1] - exact).max())
        defects.append(solution.audit().energy_drift)
    assert (np.abs(_slopes(errors) - 4) < 0.3).all(), errors
    assert (np.abs(_slopes(defects) - 4) < 0.6).all(), defects
    compiled_run = lt.integrate(system, X0, (0.0, 1.0), 1.0 / 40, method, save_every=4, engine="compiled")
    assert np.abs(compiled_run.x - solution.x).max() < 1e-13


@pytest.mark.slow
def test_the_energy_error_stays_bounded():
    """Over 2e5 steps of a nearly conservative motion it is no larger than over the first thousand steps."""
    system = lt.SimpleClosedSystem(
        lambda q, v, S: 0.5 * v @ v - 0.5 * q @ q - 0.25 * (q @ q) ** 2 - np.e**2 * (1.0 + S), 3, friction=1e-5
    )
    solution = lt.integrate(
        system, [1.0, 0.0, 0.0], (0.0, 4e4), 0.2, lt.VariationalGauss(2), save_every=20, engine="compiled"
    )
    error = np.abs(solution.energy - solution.energy[0])
    assert 1e-7 < error.max() < 1.2 * error[:50].max()
    assert solution.stats.least_entropy_increment >= 0.0


@pytest.mark.parametrize("stages", [0, 9, True, 1.5])
def test_bad_input(stages):
    with pytest.raises(lt.InputError, match="stages must be an integer from 1 to 8"):
        lt.VariationalGauss(stages)
