"""Motions that come to rest at the origin, where nothing can be judged by the size of the state."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.stage_solver import slope_rounding_scale
from liethermo.functions.rounding import value_and_rounding_scale
from liethermo.models.thermo_particles import thermo_particles_solution

two = functools.cache(lt.models.thermo_particles)
WARM = np.log([0.5, 1.5])  # relaxes to T = 1, where both entropies vanish


@pytest.mark.slow
def test_the_size_at_which_a_function_is_rounded():
    """The scale is that of the terms that cancel, not of their sum; and zero where nothing is rounded."""
    cases = [
        (lambda x: 1.0 - jnp.cos(x), 1e-9, 1.0),
        (lambda x: jnp.exp(x) - 1.0, 1e-12, 1.0),
        (lambda x: (1e6 + x) - 1e6, 1e-3, 1e6),
        (lambda x: 3.0 * x, 1e-9, 3e-9),
        (lambda x: x + x, 0.0, 0.0),
    ]
    for function, x, expected in cases:
        value, size = value_and_rounding_scale(function, np.array(x))
        assert value == function(x)
        assert 0.2 * expected <= size <= 5 * expected
    assert 0.2 < slope_rounding_scale(two(), np.zeros(2)) < 10.0
    assert slope_rounding_scale(lt.models.rigid_body(), np.array([1e-9, 0.0, 0.0])) < 1e-17


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_two_bodies_of_temperature_one(engine):
    solution = lt.integrate(two(), WARM, (0.0, 60.0), 0.1, engine=engine)
    assert np.abs(solution.x[-1]).max() < 1e-14
    assert solution.stats.worst_residual < 1e-12
    assert np.abs(solution.energy - 2.0).max() < 2e-15
    assert np.abs(np.exp(solution.x) - thermo_particles_solution(solution.t, [0.5, 1.5])).max() < 1e-3


def test_starting_next_to_rest():
    """At temperatures that differ by 1e-9: nothing of the run is larger."""
    x0 = np.array([1e-9, -1e-9])
    solution = lt.integrate(two(), x0, (0.0, 2.0), 0.1, lt.MetriplecticGauss(2), engine="compiled")
    assert solution.x[-1] == pytest.approx(np.exp(-4.0) * x0, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled", "sparse"])
def test_a_grid_that_cools_to_temperature_one(engine):
    T = np.random.default_rng(0).uniform(0.5, 1.5, 16)
    grid = lt.models.heat_grid((4, 4))
    solution = lt.integrate(grid, np.log(T / T.mean()), (0.0, 100.0), 0.5, engine=engine)
    assert np.abs(solution.x[-1]).max() < 1e-13
    assert solution.stats.worst_residual < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_an_ensemble_that_comes_to_rest(engine):
    starts = np.random.default_rng(0).uniform(0.5, 1.5, (5, 2))
    starts = np.log(starts / starts.mean(axis=1, keepdims=True))
    runs = lt.ensemble(two(), starts, (0.0, 40.0), 0.1, engine=engine)
    assert runs.ok.all(), str(runs)
    assert np.abs(runs.x).max() < 1e-14
    assert runs.residual.max() < 1e-12


def test_flow_to_rest():
    assert np.abs(lt.flow(two(), WARM, (0.0, 30.0), 0.1)).max() < 1e-13


@pytest.mark.sampled(1)
@pytest.mark.parametrize("x0", [WARM, np.zeros(2)], ids=["warm", "at rest"])
def test_adaptive_steps_to_rest(x0):
    """Some tens of steps, and the last of them long: rounding is no error."""
    solution = lt.integrate(two(), x0, (0.0, 1e4), lt.Adaptive(1e-8), lt.MetriplecticGauss(3))
    assert solution.stats.steps < 200
    assert np.abs(solution.x[-1]).max() < 1e-13


def test_a_state_that_leaves_the_numbers():
    """An exact zero, and the smallest numbers there are."""
    body = lt.models.rigid_body()
    for x0 in (np.zeros(3), np.full(3, 1e-300), np.array([0.0, 0.0, 5e-324])):
        solution = lt.integrate(body, x0, (0.0, 10.0), lt.Adaptive(1e-8))
        assert solution.status.ok
        assert np.array_equal(solution.x[-1], x0)


@pytest.mark.slow
def test_an_adaptive_run_takes_no_more_than_it_may(monkeypatch):
    body, x0 = lt.models.rigid_body(), [0.1, 1.0, 0.1]
    options = {"method": lt.MetriplecticGauss(2), "on_failure": "return"}
    solution = lt.integrate(body, x0, (0.0, 50.0), lt.Adaptive(1e-8, most_steps=20), **options)
    assert (solution.status.code, solution.status.ok) == ("step_limit", False)
    assert "20 steps were tried" in solution.status.message
    assert 10 < solution.stats.steps <= 20
    assert solution.t[-1] == solution.status.time
    with pytest.raises(lt.ConvergenceError, match="most_steps"):
        lt.integrate(body, x0, (0.0, 50.0), lt.Adaptive(1e-8, most_steps=20), lt.MetriplecticGauss(2))
    with pytest.raises(lt.InputError, match="most_steps must be"):
        lt.Adaptive(most_steps=0)
    monkeypatch.setattr("liethermo.runs.run.MAX_STORED_VALUES", 60)
    solution = lt.integrate(body, x0, (0.0, 50.0), lt.Adaptive(1e-8), **options)
    assert "save_every or save_at" in solution.status.message
    assert solution.stats.steps == 20
    assert lt.integrate(body, x0, (0.0, 5.0), lt.Adaptive(1e-8), save_at=[1.0], **options).status.ok


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [lt.MetriplecticGauss(2), lt.MetriplecticMidpoint(), lt.MetriplecticMidpoint("mean_value")],
)
def test_terms_that_cancel_in_the_energy(method):
    """``1 - cos q`` is rounding near q = 0, of the size of 1, however small the energy is that comes out."""
    system = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 + 1.0 - jnp.cos(x[0]))
    amplitudes, h = np.array([1e-9, 1e-7, 1e-5, 1e-3]), 0.05
    starts = np.stack([np.zeros(4), amplitudes], axis=1)
    swing = np.array([np.sin(10.0), np.cos(10.0)])
    runs = lt.ensemble(system, starts, (0.0, 10.0), h, method)
    assert runs.audit().passed, f"\n{runs.audit()}"
    assert np.abs(runs.x / amplitudes[:, None] - swing).max() < (1e-6 if method.order == 4 else 0.01)
    for x0 in starts:
        solution = lt.integrate(system, x0, (0.0, 10.0), h, method)
        assert solution.audit().passed, f"\n{solution.audit()}"
        assert np.abs(solution.x[-1] / x0[1] - swing).max() < (1e-6 if method.order == 4 else 0.01)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("stages", "max_error"), [(2, 1e-6), (3, 1e-10)])
def test_a_driven_body_that_comes_to_rest_stays_where_its_torque_leaves_it(stages, max_error):
    """``L' = sin t`` from rest: at t = 2 pi the energy is zero and the work, rounded, is not."""
    body = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1.0, 0.5, 0.4]), torque=lambda t, m: jnp.stack([0.0, 0.0, 1.0]) * jnp.sin(t)
    )
    solution = lt.integrate(body, [0.0, 0.0, 0.0], (0.0, 4.0 * np.pi), np.pi / 20.0, lt.MetriplecticGauss(stages))
    assert np.abs(solution.x[:, 2] - (1.0 - np.cos(solution.t))).max() < max_error
    assert solution.audit().passed
