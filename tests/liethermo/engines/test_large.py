"""Solver of the array engine for steps with too many unknowns for a Jacobian matrix."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.base import Dissipation
from liethermo.engines import array_engine
from liethermo.engines.solver_options import DEFAULT_OPTIONS
from liethermo.engines.stage_solver import (
    IterationState,
    StageEquations,
    solve_fixed_point,
    solve_krylov,
    solve_newton,
    solve_stages,
)
from liethermo.engines.step import initial_run_state_program
from liethermo.runs.preparation import checked_initial_state, prepare_system_and_method

N_SPINS = 5_000
"""Number of spins of the large ring."""


class Damping(Dissipation):
    """Damping of spins along ``s x (s x dH)`` that heats a bath of entropy x[-1], as a user would write it."""

    rate: jax.Array

    def force(self, system, x, dH, dS, dL):
        s, a, b = (y[:-1].reshape(-1, 3) for y in (x, dH, dS))
        torque = jnp.cross(s, a)
        heat_torque = dH[-1] * jnp.cross(s, b) - dS[-1] * torque
        return jnp.append(
            (self.rate * jnp.cross(heat_torque, s)).ravel(), -self.rate / dH[-1] * jnp.sum(torque * heat_torque)
        )


def ring(count, exchange=1.0):
    """Return a ring of ``count`` spins with exchange and an easy axis, and a bath, written with plain functions."""

    def energy(x):
        s = x[:-1].reshape(-1, 3)
        bath = count * jnp.exp(x[-1] / count)
        return bath - exchange * jnp.sum(s * jnp.roll(s, 1, axis=0)) - 0.1 * jnp.sum(s[:, 2] ** 2)

    def poisson_map(x, alpha):
        s, a = (y[:-1].reshape(-1, 3) for y in (x, alpha))
        return jnp.append(jnp.cross(s, a).ravel(), 0.0)

    return lt.MetriplecticSystem(
        mf.PoissonMap(poisson_map, 3 * count + 1), energy, lambda x: x[-1], Damping(jnp.asarray(0.1)), validate=False
    )


def random_spins(count):
    s = np.random.default_rng(0).standard_normal((count, 3))
    return np.append((s / np.linalg.norm(s, axis=1)[:, None]).ravel(), 0.0)


@pytest.mark.slow
def test_many_damped_spins_take_long_steps():
    """Many damped spins need Newton's method only for long steps, although some spin always converges late."""
    system, x = ring(N_SPINS), random_spins(N_SPINS)
    for h, steps in ((0.1, 20), (1.0, 3)):
        solution = lt.integrate(system, x, (0.0, steps * h), h, save_every=steps, engine="array")
        energy, stats = solution.energy, solution.stats
        assert abs(energy[-1] - energy[0]) <= 1e-13 * abs(energy[0])
        assert stats.least_entropy_increment > 1.0
        assert (stats.newton_iterations > 0) == (h == 1.0)
        s = solution.x[-1, :-1].reshape(-1, 3)
        assert np.abs(np.linalg.norm(s, axis=1) - 1.0).max() < 1e-14


def slowness_by_update(updates, rate):
    """Return, after each update, whether the iteration is slower than ``rate``."""
    k = jnp.zeros((1, 1))
    iteration, slowness = IterationState.initial(k), []
    for update in updates:
        k = k + update
        iteration = iteration.next_state(k, DEFAULT_OPTIONS)
        slowness.append(bool(iteration.shrinks_slower_than(rate)))
    return slowness


def test_an_iteration_is_slow_by_its_last_update_and_by_the_last_two():
    assert slowness_by_update([1.0, 0.5, 0.4, 0.3, 0.25], 0.6) == [False, False, True, True, True]
    assert slowness_by_update([1.0, 0.5], 0.3) == [False, True]  # the rate that Newton's method requires
    assert (
        slowness_by_update([1.0, 100.0, 1e-2, 1.0, 1e-4, 1e-2], 0.6)[2:] == [False] * 4
    )  # two components that drive each other
    assert slowness_by_update([1.0, 100.0, 0.9, 90.0, 0.8, 80.0], 0.6)[3::2] == [
        True,
        True,
    ]  # two components that do not converge
    assert slowness_by_update([1.0, 2.0, 4.0, 8.0], 0.6)[1:] == [True] * 3


@pytest.mark.parametrize("growth", [0.97, 1.0, 1.2])
def test_an_iteration_that_starts_below_its_limit_and_does_not_shrink_has_not_converged(growth):
    """A stiff system at rest: updates of 5e-14 of the state stall, but are no rounding."""
    turn = growth * np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    guess = jnp.array([[5e-14, 0.0]])
    equations = StageEquations(lambda k: k @ turn, guess, lambda k: 1.0, lambda k: lambda r: r @ inverse_of(turn))
    assert not bool(solve_fixed_point(equations).converged)
    solution = solve_stages(equations)
    assert bool(solution.converged)
    assert np.abs(solution.k).max() <= 1e-20


def inverse_of(turn):
    """Return the inverse of the Jacobian of ``slopes(k) - k``, for rows k."""
    return np.linalg.inv(turn - np.eye(2))


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.05, 0.6])
def test_spins_in_line_that_a_bath_shakes(h):
    """The bath is corrected a hundred times as much as the spins, in turns: that alone needs no Newton's method."""
    bath = lt.HeatBaths(capacity=27.0)
    system = lt.models.spin_lattice((3, 3, 3), baths=bath)
    initial_spins = np.tile([0.0, 0.0, 1.0], (3, 3, 3, 1))
    run = lt.integrate(system, initial_spins, (0.0, 3 * h), h, noise=lt.Fluctuations(1.0, 1), engine="array")
    assert (run.stats.newton_iterations > 0) == (h == 0.6)  # long steps do need it
    assert run.audit().energy_drift <= 1e-14


def test_newtons_method_is_compiled_when_a_step_needs_it():
    """A run that compiles Newton's method late equals one that could use it from the start."""
    system = lt.models.rigid_body(inertia=(10, 5, 1), rate=200.0)
    for h, needs_newton in ((1e-3, False), (0.5, True)):
        engine = array_engine.ArrayEngine(system, lt.MetriplecticMidpoint())
        start = engine.initial_run_state(jnp.array([0.1, 1.0, 0.1]))
        lazy_state, lazy_saves = engine.advance(start, h, 4, 2)
        assert engine._lazy_newton.has_newton is needs_newton
        state, saves = array_engine.take_steps_and_save(
            system, engine.method, start, *map(jnp.asarray, (h, 4, 2)), engine.max_saves_per_call
        )
        assert int(lazy_state.step) == int(state.step) == 8
        assert np.abs(np.asarray(lazy_saves[0]) - np.asarray(saves[0])).max() <= 1e-15


def test_steps_before_newtons_method_is_needed_are_not_taken_again(monkeypatch):
    """A torque accelerates a body until fixed-point iteration fails; the run resumes at that step."""
    body = lt.LiePoissonSystem(
        mf.so(3), lambda p: 0.5 * p @ (p / jnp.array([3.0, 2.0, 1.0])), torque=lambda t, mu: jnp.array([0.5, 0.4, 0.3])
    )
    calls, advance = [], array_engine.take_steps_and_save

    def recording_advance(system, method, state, *arguments):
        calls.append((int(state.step), arguments[-2]))
        return advance(system, method, state, *arguments)

    monkeypatch.setattr(array_engine, "take_steps_and_save", recording_advance)
    system, method = prepare_system_and_method(body, lt.MetriplecticMidpoint())
    engine = array_engine.ArrayEngine(system, method)
    start = engine.initial_run_state(checked_initial_state(system, method, [0.1, 0.1, 0.1], 0.0))
    lazy_state, lazy_saves = engine.advance(start, 0.5, 10, 4)
    assert calls[0] == (0, False)
    assert calls[1] == (calls[1][0], True)
    assert 1 < calls[1][0] < 40
    assert calls[1][0] % 4  # between two saves
    eager_state, eager_saves = advance(
        system, method, start, *map(jnp.asarray, (0.5, 10, 4)), engine.max_saves_per_call
    )
    assert int(lazy_state.newton_iterations) == int(eager_state.newton_iterations) > 0
    assert int(lazy_state.fixed_point_iterations) == int(eager_state.fixed_point_iterations)
    for a, b in zip(lazy_saves, eager_saves, strict=True):
        np.testing.assert_allclose(a[:10], b[:10], rtol=1e-13, atol=1e-13)


def stiff_heat_chain(n, rate):
    """Return slopes, linear in k, of a heat-conducting chain with rates up to 4 ``rate``, and a guess."""
    rng = np.random.default_rng(0)
    source = jnp.asarray(rng.standard_normal((1, n)))

    def slopes(k):
        x = 0.5 * k
        flow = rate * (jnp.roll(x, 1, axis=1) + jnp.roll(x, -1, axis=1) - 2.0 * x)
        return source + flow + 0.2 * (jnp.roll(x, 1, axis=1) - jnp.roll(x, -1, axis=1))

    return slopes, source


def solve_matrix_free(slopes, guess, options=DEFAULT_OPTIONS):
    def newton_solve_at(k):
        matvec = jax.linearize(lambda k: slopes(k) - k, k)[1]
        return lambda residual: solve_krylov(matvec, residual, options)

    n = guess.shape[1]
    norm = options.norm_for_dim(n)
    return solve_stages(StageEquations(slopes, guess, lambda k: 1.0 + norm(k), newton_solve_at), options)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.1, 10.0, 1000.0])
def test_stiff_equations_are_solved_to_rounding_without_their_matrix(rate):
    slopes, guess = stiff_heat_chain(1_500, rate)
    solution = solve_matrix_free(slopes, guess)
    matrix = np.eye(1_500) - np.asarray(jax.jacfwd(lambda k: slopes(k[None])[0])(jnp.zeros(1_500)))
    exact = np.linalg.solve(matrix, np.asarray(slopes(jnp.zeros_like(guess)))[0])
    assert bool(solution.converged)
    assert np.abs(np.asarray(solution.k)[0] - exact).max() < 1e-12
    assert (int(solution.newton_iterations) > 0) == (rate > 1.0)


def test_it_is_said_where_the_equations_are_not_solved():
    slopes, guess = stiff_heat_chain(1_500, 1000.0)
    few_iterations = replace(DEFAULT_OPTIONS, max_krylov_products=2, max_newton_iterations=2, max_newton_halvings=0)
    assert not bool(solve_matrix_free(slopes, guess, few_iterations).converged)
    assert not bool(solve_matrix_free(lambda k: 2.0 * k * k + 1.0, guess).converged)  # it has no solution


@pytest.mark.parametrize(("contraction", "converges"), [(0.55, True), (0.75, False)])
def test_newton_iteration_that_shrinks_to_rounding_at_its_limit_has_converged(contraction, converges):
    """60 iterations shrink the update by 0.55**60 = 3e-16, and by 0.75**60 = 3e-8."""
    solution = jnp.array([[1.0, -2.0, 0.5]])
    equations = StageEquations(
        lambda k: solution,
        jnp.zeros_like(solution),
        lambda k: 1.0 + jnp.abs(k).max(),
        lambda k: lambda residual: (contraction - 1.0) * residual,
    )
    result = solve_newton(equations, DEFAULT_OPTIONS)
    assert bool(result.converged) == converges
    if converges:
        assert int(result.newton_iterations) == DEFAULT_OPTIONS.max_newton_iterations
        assert np.abs(np.asarray(result.k - solution)).max() < 1e-14


@pytest.mark.slow
def test_the_work_does_not_depend_on_how_many_copies_there_are():
    """Copies of a ring in one state take the same number of iterations as one ring, because norms are means."""
    spins = random_spins(400)[:-1]
    counts = []
    for copies in (1, 8):
        system, x = ring(400 * copies, 3.0), np.append(np.tile(spins, copies), 0.0)
        method = lt.MetriplecticGauss(1).on(system)
        state = initial_run_state_program(system, method, x)
        new_state = array_engine.ArrayEngine(system, method).step(state, 0.2)
        assert int(new_state.status) == 0
        counts.append((int(new_state.fixed_point_iterations), int(new_state.newton_iterations)))
    assert counts[0][1] > 0
    assert abs(counts[0][0] - counts[1][0]) <= 1
    assert abs(counts[0][1] - counts[1][1]) <= 1


def test_krylov_solves_what_dense_elimination_solves():
    rng = np.random.default_rng(1)
    random_matrix = rng.standard_normal((60, 60))
    matrix = jnp.asarray(np.eye(60) + 0.3 * (random_matrix - random_matrix.T))
    b = jnp.asarray(rng.standard_normal(60))
    x = solve_krylov(lambda v: matrix @ v, b, replace(DEFAULT_OPTIONS, krylov_forcing_term=1e-12, krylov_basis_size=60))
    np.testing.assert_allclose(x, np.linalg.solve(matrix, b), atol=1e-11)
    short_basis_x = solve_krylov(
        lambda v: matrix @ v, b, replace(DEFAULT_OPTIONS, krylov_forcing_term=1e-3, krylov_basis_size=2)
    )
    assert np.linalg.norm(matrix @ short_basis_x - b) <= 1.01e-3 * np.linalg.norm(b)
    assert not np.asarray(solve_krylov(lambda v: matrix @ v, jnp.zeros(60), DEFAULT_OPTIONS)).any()


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("strength", "length"), [(12.0, 1.0), (0.1, 1e6)], ids=["slow", "large"])
def test_one_of_many_components_is_solved_like_the_others(strength, length):
    """The root mean square hides no component: a spin that converges slowly, or one that is a million times longer."""
    n, h = 40, 0.05 / length
    energy = lambda m: -jnp.sum(m * jnp.roll(m, 1, axis=0)) - strength * m[0, 2] ** 2  # noqa: E731
    spins = np.random.default_rng(0).standard_normal((n, 3))
    spins[0] = 0.6 * length, 0.0, 0.8 * length
    inputs = lt.LiePoissonSystem(mf.power(mf.so(3), n), energy), lt.MetriplecticMidpoint()
    system, method = prepare_system_and_method(*inputs)
    assert system.dim > DEFAULT_OPTIONS.rms_norm_dim
    engine = array_engine.ArrayEngine(system, method)
    state = engine.initial_run_state(jnp.asarray(spins.ravel()))
    for _ in range(10):
        previous_state, state = state, engine.step(state, h)
        residual = np.abs(method.slopes(system, previous_state.x, previous_state.compensation, h, state.k) - state.k)[0]
        scale = np.abs(np.asarray(previous_state.x)).reshape(n, 3).max(axis=1, keepdims=True) / h + np.abs(
            state.k[0]
        ).reshape(n, 3)
        assert (residual.reshape(n, 3) / scale).max() < 1e-14, np.unravel_index(
            np.argmax(residual.reshape(n, 3) / scale), (n, 3)
        )
    lengths = [np.linalg.norm(np.asarray(x).reshape(n, 3), axis=1) for x in (spins, state.x)]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-14)
    assert abs(
        float(state.energy) - float(engine.initial_run_state(jnp.asarray(spins.ravel())).energy)
    ) <= 1e-14 * float(state.energy_sensitivity)
