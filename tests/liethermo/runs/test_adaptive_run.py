"""Adaptive steps, events, outputs at given times and dense output: where a run steps is free, the laws are not."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.engines import array_engine
from liethermo.engines.compiled.engine import CompiledEngine
from liethermo.engines.compiled.step_loop import CompiledStepLoop
from liethermo.engines.step_control import arnoldi_hessenberg, step_size_after_acceptance, step_size_after_rejection
from liethermo.runs import adaptive_run
from liethermo.tracing.scalarize import UnsupportedPrimitive
from tests.systems import rigid_body

X0 = [0.001, 1.0, 0.001]


def nonlinear():
    inertia = jnp.array([3.0, 2.0, 1.0])
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / inertia) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1]),
        lambda p: jnp.log(1.0 + p @ p),
        lt.ProjectedMetric(rate=0.3),
    )


SYSTEM = nonlinear()
START = [0.8, 0.5, 0.9]


@pytest.fixture(scope="module")
def exact():
    """The state at t = 20, to 1e-14: two methods of high order agree on it."""
    x, y = (lt.integrate(SYSTEM, START, (0.0, 20.0), 0.05, lt.MetriplecticGauss(s)).x[-1] for s in (3, 4))
    assert np.abs(x - y).max() < 1e-10
    return y


SIZES = {1: 0.1, 2: 0.4, 3: 0.6, 4: 1.0}
"""Steps, for each number of stages, whose errors are above rounding."""


# -- adaptive steps ---------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("stages", "rtol"), [(1, 1e-4), (2, 1e-4), (2, 1e-7), (3, 1e-4), (3, 1e-7), (3, 1e-10), (4, 1e-7), (4, 1e-10)]
)
def test_the_error_follows_the_tolerance(stages, rtol, exact):
    """In some ten times what the state takes to change by its size, the same at every tolerance and order."""
    solution = lt.integrate(SYSTEM, START, (0.0, 20.0), lt.Adaptive(rtol), lt.MetriplecticGauss(stages))
    error = np.abs(solution.x[-1] - exact).max() / rtol
    assert 2.0 < error < 40.0
    assert solution.audit(energy=1e-14).passed, str(solution.audit())
    assert solution.t[-1] == 20.0
    assert solution.stats.rejected <= 3 + 0.01 * solution.stats.steps


@pytest.mark.slow
@pytest.mark.parametrize(("stages", "h"), list(SIZES.items()))
def test_the_estimate_of_the_local_error(stages, h):
    """Along a trajectory it is right to a factor of two in the mean, nowhere far above, and hardly anywhere far below.

    It is a vector that turns, and nearly vanishes where its parts cancel.
    """
    method, exact = lt.MetriplecticGauss(stages), lt.MetriplecticGauss(5)
    engines = [array_engine.ArrayEngine(SYSTEM, m) for m in (method, exact)]
    ratios = []
    for x in lt.integrate(SYSTEM, START, (0.0, 20.0), 0.5, engine="array").x:
        new, right = (f.step(f.initial_run_state(x), h) for f in engines)
        estimate = method.error(SYSTEM, x, np.zeros(3), h, new.k)
        ratios.append(float(estimate / np.abs(new.x - right.x).max()))
    mean = np.exp(np.mean(np.log(ratios)))
    assert 0.5 < mean < 2.0, ratios
    assert np.mean(np.array(ratios) < 0.1) <= 0.05, ratios
    assert max(ratios) < 100.0, ratios


@pytest.mark.slow
def test_the_estimate_scales_with_the_motion():
    """Near a relative equilibrium the error shrinks with the amplitude of what moves, not with the state."""
    body, method, h = lt.models.free_rigid_body(), lt.MetriplecticGauss(2), 0.4
    methods = method, lt.MetriplecticGauss(5)
    ratios = []
    for amplitude in (1e-1, 1e-3, 1e-5):
        x = np.array([amplitude, 0.0, 1.0])
        new, right = (e.step(e.initial_run_state(x), h) for e in (CompiledEngine(body, m) for m in methods))
        estimate = method.error(body, x, np.zeros(3), h, new.k)
        ratios.append(float(estimate) / np.abs(new.x - right.x).max())
    assert max(ratios) < 1.5 * min(ratios), ratios


@pytest.mark.slow
def test_steps_grow_as_a_body_relaxes():
    """At most 300 steps to t = 10^4; the last are of the size of the whole relaxation."""
    solution = lt.integrate(rigid_body(), X0, (0.0, 1e4), lt.Adaptive(1e-8), lt.MetriplecticGauss(4))
    assert solution.stats.steps <= 300
    assert solution.audit().passed
    assert solution.entropy[-1] == pytest.approx(10 * solution.energy[0], rel=1e-14)
    assert np.diff(solution.t)[-2] > 100 * np.diff(solution.t).min()


def test_steps_do_not_chatter():
    """In a steady rotation the step settles: it is changed in few of the steps, and nothing is rejected."""
    body = lt.models.free_rigid_body()
    solution = lt.integrate(body, [0.5, 0.0, 0.9], (0.0, 200.0), lt.Adaptive(1e-7), lt.MetriplecticGauss(3))
    steps = np.diff(solution.t)[5:-3]
    assert (np.abs(np.diff(steps)) > 1e-9 * steps[1:]).mean() < 0.5
    assert np.abs(np.diff(np.log(steps))).max() < np.log(3.1)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("explicit", [False, True])
def test_control(explicit):
    """On an error that follows h^(order + 1) the step tends to the one with the error aimed at, and stays."""
    proposed_step, optimal, power, sizes = 1e-5, 0.0, 1 / 5, []
    for _ in range(60):
        h = proposed_step
        error = (h / 0.1) ** 5
        previous_optimal, optimal = optimal, h * error**-power
        good = error <= 1.0
        proposed_step = float(
            step_size_after_acceptance(optimal, previous_optimal, h, h, power, np.inf, explicit)
            if good
            else step_size_after_rejection(error, h, power)
        )
        sizes.append(proposed_step)
    assert 0.05 < proposed_step <= 0.1
    assert proposed_step == pytest.approx(h, rel=1e-14 if explicit else 0.0)
    assert sizes[0] == pytest.approx(1e-4 if explicit else 3e-5)
    short_step = 0.01 * proposed_step  # which says nothing
    assert (
        float(step_size_after_acceptance(10.0, 0.0, short_step, proposed_step, power, np.inf, explicit))
        == proposed_step
    )
    assert float(step_size_after_rejection(np.inf, proposed_step, power)) == 0.25 * proposed_step


@pytest.mark.slow
def test_attempts_together_are_attempts_one_by_one(monkeypatch):
    """Rejected ones among them."""

    def run():
        step, method = lt.Adaptive(1e-7, first=2.0), lt.MetriplecticRungeKutta(4)
        return lt.integrate(SYSTEM, START, (0.0, 20.0), step, method, engine="compiled")

    default_run = run()
    monkeypatch.setattr(adaptive_run, "ATTEMPTS_PER_CALL", 1)
    single = run()
    assert default_run.stats.steps > 100
    assert default_run.stats.rejected > 0
    for name in ("t", "x", "energy", "entropy"):
        assert np.array_equal(getattr(default_run, name), getattr(single, name))
    assert replace(default_run.stats, wall_time=0.0) == replace(single.stats, wall_time=0.0)


@pytest.mark.slow
def test_the_array_engine_takes_over_amid_attempts_made_together(monkeypatch):
    """No step is lost that was taken before Newton's method was first needed and could not be compiled."""

    def run_with_engine(engine):
        step, method = lt.Adaptive(0.1, first=1e-3), lt.MetriplecticGauss(3)
        return lt.integrate(lt.models.free_rigid_body(), [1.0, 0.02, 0.02], (0.0, 400.0), step, method, engine=engine)

    calls = []

    def solver(self):
        calls.append(1)
        raise UnsupportedPrimitive("newton", "in this test")

    array_run = run_with_engine("array")
    monkeypatch.setattr(CompiledStepLoop, "_compiled_newton_address", solver)
    with pytest.warns(UserWarning, match="newton"):
        parts = run_with_engine("auto")
    assert calls
    assert len(parts.t) == len(array_run.t) > 50
    assert np.abs(parts.x - array_run.x).max() < 1e-12  # 2e-13 seen: the engines round otherwise, and the time is long


@pytest.mark.slow
def test_both_engines_take_the_same_steps():
    a, b = (
        lt.integrate(SYSTEM, START, (0.0, 5.0), lt.Adaptive(1e-6), lt.MetriplecticGauss(2), engine=engine)
        for engine in ("array", "compiled")
    )
    assert np.allclose(a.t, b.t, rtol=1e-9, atol=0)
    assert np.abs(a.x - b.x).max() < 1e-9


@pytest.mark.slow
def test_the_midpoint_scheme_can_be_adaptive_too(exact):
    solution = lt.integrate(SYSTEM, START, (0.0, 20.0), lt.Adaptive(1e-5))
    assert np.abs(solution.x[-1] - exact).max() < 1e-2
    assert solution.audit().energy_drift < 1e-14


def test_largest_and_first():
    options = lt.Adaptive(1e-6, first=0.01, largest=0.3)
    solution = lt.integrate(SYSTEM, START, (0.0, 5.0), options, lt.MetriplecticGauss(3))
    steps = np.diff(solution.t)
    assert steps[0] == 0.01
    assert steps.max() <= 0.3 * (1 + 1e-12)


@pytest.mark.slow
def test_a_tolerance_that_cannot_be_met():
    """A jump in the energy, which no step size gets over: the step underflows, and the status says why."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p**2 / jnp.array([3.0, 2.0, 1.0])) + jnp.where(p[0] > 0.5, 1.0, 0.0) * p[1],
        validate=False,
    )
    options = {"method": lt.MetriplecticGauss(2), "on_failure": "return"}
    solution = lt.integrate(system, [0.8, 0.5, 0.9], (0.0, 10.0), lt.Adaptive(1e-9), **options)
    assert solution.status.code == "step_underflow"
    reasons = "no step size helps", "the functions not smooth there"  # which one depends on the last size tried
    assert any(reason in solution.status.message for reason in reasons)
    assert solution.stats.steps > 3
    assert np.isfinite(solution.x).all()
    assert solution.x[-1, 0] == pytest.approx(0.5, abs=1e-6)
    with pytest.raises(lt.ConvergenceError, match="the step fell to"):
        lt.integrate(system, [0.8, 0.5, 0.9], (0.0, 10.0), lt.Adaptive(1e-9), lt.MetriplecticGauss(2))


@pytest.mark.slow
def test_suggest_step(exact):
    for rtol in (1e-6, 1e-9):
        h = lt.suggest_step(SYSTEM, START, rtol, lt.MetriplecticGauss(3))
        solution = lt.integrate(SYSTEM, START, (0.0, 20.0), h, lt.MetriplecticGauss(3))
        assert np.abs(solution.x[-1] - exact).max() < 10 * solution.stats.steps * rtol
        assert solution.stats.steps < 2000
    with pytest.raises(lt.InputError, match="nothing moves"):
        lt.suggest_step(rigid_body(), [1.0, 0.0, 0.0])


# -- what grows -------------------------------------------------------------------------------------------------------


def falls(field, x0, event, end):
    """The time of an event by an independent program, the small components resolved."""
    event.terminal = True
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-30, "events": event}
    return solve_ivp(lambda t, x: field(x), (0.0, end), x0, **options).t_events[0][0]


def relaxed_body(m):
    rates = m / np.array([10.0, 5.0, 1.0])
    return np.cross(m, rates) + (rates @ rates) * m - (rates @ m) * rates


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("p", "rtol", "stages", "max_error"),
    [
        (1e-6, 1e-4, 2, 80),
        (1e-7, 1e-4, 3, 80),
        (1e-10, 1e-6, 3, 80),
        (1e-13, 1e-8, 4, 80),
        (1e-15, 1e-6, 2, 200),  # while it has hardly moved, its error is judged by the distance that it has gone
    ],
)
def test_a_body_on_its_middle_axis_falls_when_it_has_to(p, rtol, stages, max_error):
    """However near it starts, and however large the tolerance is beside that."""
    x0 = [p, 1.0, p]
    exact = falls(relaxed_body, x0, lambda t, x: x[0] - 0.5, 600.0)
    method = lt.MetriplecticGauss(stages)
    solution = lt.integrate(rigid_body(), x0, (0.0, 600.0), lt.Adaptive(rtol), method, until=lambda x: x[0] - 0.5)
    assert solution.event_time == pytest.approx(exact, rel=0.005)
    assert solution.stats.steps < max_error


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "double well"])
def test_other_unstable_rests(name):
    """The top of a pendulum and of a double well; linear and cubic forces against each other."""
    energy, force = {
        "pendulum": (lambda x: 0.5 * x[1] ** 2 + jnp.cos(x[0]), np.sin),
        "double well": (lambda x: 0.5 * x[1] ** 2 - 0.5 * x[0] ** 2 + 0.25 * x[0] ** 4, lambda q: q - q**3),
    }[name]
    exact = falls(lambda x: np.array([x[1], force(x[0])]), [1e-12, 0.0], lambda t, x: x[0] - 0.5, 100.0)
    system = lt.MetriplecticSystem(mf.Canonical(1), energy)
    options = {"method": lt.MetriplecticGauss(2), "until": lambda x: x[0] - 0.5}
    solution = lt.integrate(system, [1e-12, 0.0], (0.0, 100.0), lt.Adaptive(1e-6), **options)
    assert solution.event_time == pytest.approx(exact, rel=0.01)


@pytest.mark.slow
def test_what_grows_in_a_larger_system():
    """Six wells in a row, coupled: the rates of growth from a Krylov space are those of the whole matrix."""
    system = wells(6)
    x = np.concatenate([[0.0, 0.1, 0.0, 0.7, 0.0, 0.2], np.zeros(6)])
    matrix = np.asarray(jax.jacfwd(system.vector_field)(jnp.asarray(x)))
    eigenvalues = np.linalg.eigvals(np.asarray(arnoldi_hessenberg(system, lt.MetriplecticMidpoint(), jnp.asarray(x))))
    assert np.sort(eigenvalues.real) == pytest.approx(np.sort(np.linalg.eigvals(matrix).real), abs=1e-9)


@pytest.mark.slow
def test_a_row_of_wells_leaves_its_rest():
    system, x0 = wells(20), np.zeros(40)
    x0[3] = 1e-11
    springs = np.diag(np.r_[1.0, np.full(18, 2.0), 1.0]) - np.eye(20, k=1) - np.eye(20, k=-1)

    def field(x):
        return np.concatenate([x[20:], x[:20] - x[:20] ** 3 - 0.6 * springs @ x[:20]])

    exact = falls(field, x0, lambda t, x: np.abs(x[:20]).max() - 0.3, 100.0)
    options = {"method": lt.MetriplecticGauss(2), "until": lambda x: jnp.max(jnp.abs(x[:20])) - 0.3}
    assert lt.integrate(system, x0, (0.0, 100.0), lt.Adaptive(1e-6), **options).event_time == pytest.approx(
        exact, rel=0.01
    )


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(8), lt.MetriplecticGauss(3)], ids=str)
@pytest.mark.parametrize("n_bodies", [2, 3])
def test_the_clock_of_a_driven_system_does_not_grow(method, n_bodies):
    """Derivatives by the time are huge in the unit of the clock; the rates of growth must not be their rounding."""
    inertia = np.linspace(1.0, 4.0, 3 * n_bodies)
    amplitudes = 0.05 * np.arange(1.0, 3.0 * n_bodies + 1.0)
    bodies = lt.LiePoissonSystem(
        mf.direct_sum(*[mf.so(3)] * n_bodies), lt.Quadratic(1.0 / inertia), torque=lambda t, mu: jnp.cos(t) * amplitudes
    )
    x0 = np.linspace(-1.0, 1.0, 3 * n_bodies)

    def field(t, x):
        momenta, velocities = x.reshape(-1, 3), (x / inertia).reshape(-1, 3)
        return np.cross(momenta, velocities).ravel() + np.cos(t) * amplitudes

    exact = solve_ivp(field, (0.0, 3.0), x0, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    solution = lt.integrate(bodies, x0, (0.0, 3.0), lt.Adaptive(1e-8), method)
    assert np.abs(solution.x[-1] - exact).max() < 1e-7
    assert len(solution.t) < 40


def wells(n):
    def energy(x):
        q, p = x[:n], x[n:]
        return 0.5 * p @ p + jnp.sum(0.25 * q**4 - 0.5 * q**2) + 0.3 * jnp.sum((q[1:] - q[:-1]) ** 2)

    return lt.MetriplecticSystem(mf.Canonical(n), energy)


@pytest.mark.slow
def test_suggested_steps_resolve_what_grows():
    """At the top of a saddle nothing seems to move, and any step would do for the estimate of the error."""
    h = lt.suggest_step(rigid_body(), [1e-10, 1.0, 1e-10], 1e-6, lt.MetriplecticGauss(2))
    rate = np.linalg.eigvals(np.asarray(jax.jacfwd(rigid_body().vector_field)(jnp.array([0.0, 1.0, 0.0])))).real.max()
    assert 0.05 < h * rate < 1.2


# -- events -----------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-9)])
def test_relaxed(step):
    solution = lt.integrate(rigid_body(), X0, (0.0, 1e4), step, lt.MetriplecticGauss(3), until=lt.Relaxed(1e-8))
    assert solution.status.code == "event"
    assert solution.status.ok
    assert solution.t[-1] == solution.event_time
    assert float(rigid_body().entropy_production(solution.x[-1])) == pytest.approx(1e-8, rel=1e-10)
    assert solution.audit().passed  # the last state too is a step's end


def test_an_event_is_located_to_rounding():
    """The free body's third component crosses zero; the time does not depend on the step but by its accuracy."""
    body = lt.models.free_rigid_body()
    solutions = [
        lt.integrate(body, [0.1, 0.2, 0.9], (0.0, 100.0), h, lt.MetriplecticGauss(6), until=lambda x: x[0]).event_time
        for h in (0.05, 0.031)
    ]
    assert solutions[0] == pytest.approx(solutions[1], rel=1e-13)
    solution = lt.integrate(body, [0.1, 0.2, 0.9], (0.0, 100.0), 0.05, lt.MetriplecticGauss(6), until=lambda x: x[0])
    assert abs(solution.x[-1, 0]) < 1e-13
    assert solution.audit().passed


def test_steps_that_are_looked_at_are_those_of_the_timetable():
    """A thousand steps of 0.1 to t = 100, and at the same times."""
    default_run = lt.integrate(rigid_body(), X0, (0.0, 100.0), 0.1)
    run_with_event = lt.integrate(rigid_body(), X0, (0.0, 100.0), 0.1, until=lambda x: x[0] - 5.0)
    assert run_with_event.stats.steps == default_run.stats.steps == 1000
    assert np.array_equal(run_with_event.t, default_run.t)
    assert np.array_equal(run_with_event.x, default_run.x)
    stops = lt.integrate(rigid_body(), X0, (0.0, 1.05), 0.1, save_at=[0.3, 0.75])
    assert stops.stats.steps == 3 + 5 + 3


def test_an_event_that_never_happens():
    solution = lt.integrate(rigid_body(), X0, (0.0, 10.0), 0.1, until=lambda x: x[0] - 5.0)
    assert (solution.status.code, solution.event_time) == ("completed", None)
    assert "did not happen" in solution.status.message
    assert solution.t[-1] == 10.0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-3)], ids=["fixed", "adaptive"])
@pytest.mark.parametrize(
    "until",
    [lambda x: jnp.nan * x[0], lambda x: jnp.where(x[1] < 0.995, jnp.nan, 1.0)],
    ids=["always", "from some time on"],
)
def test_of_a_function_that_is_not_a_number_at_the_end_nothing_is_known(until, step):
    """The function may have been zero: that the event has not happened would be a guess."""
    solution = lt.integrate(rigid_body(), X0, (0.0, 20.0), step, until=until)
    assert solution.x[-1, 1] < 0.995
    assert solution.event_time is None
    assert "whether the event (the event function) happened is unknown" in solution.status.message


def test_a_file_keeps_the_event(tmp_path):
    solution = lt.integrate(rigid_body(), X0, (0.0, 1e3), 0.1, until=lt.Relaxed(1e-6))
    assert lt.load(solution.save(tmp_path / "run.nc")).event_time == solution.event_time


# -- outputs ----------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-8)])
def test_save_at(step):
    times = [0.37, 1.0, 1.05, 7.3]
    solution = lt.integrate(SYSTEM, START, (0.0, 8.0), step, lt.MetriplecticGauss(3), save_at=times)
    assert solution.t.tolist() == [0.0, *times, 8.0]
    assert solution.audit().passed
    for t, x in zip(solution.t[1:], solution.x[1:], strict=True):
        reference = lt.integrate(SYSTEM, START, (0.0, t), 0.02, lt.MetriplecticGauss(4)).x[-1]
        assert np.abs(x - reference).max() < 1e-6


def test_dense_output_is_asked_for():
    with pytest.raises(lt.InputError, match="dense=True"):
        lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1)(0.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"step": lt.Adaptive(1e-6), "method": lt.Reference()}, "chooses its own steps"),
        ({"until": 3.0}, r"lt\.Relaxed\(tol\) or a function"),
        ({"until": lambda x: x}, "one number"),
        ({"until": lt.Relaxed(1e-3), "system": lt.models.free_rigid_body()}, "produces entropy or loses energy"),
        ({"save_at": [0.5, 2.0]}, r"times of t_span = \(0, 1\), got 2, outside of it"),
        ({"save_at": [np.nan]}, "list of times"),
    ],
)
def test_bad_input(arguments, message):
    default = {"system": rigid_body(), "x0": X0, "t_span": (0.0, 1.0), "step": 0.1}
    with pytest.raises((lt.InputError, lt.FunctionError), match=message):
        lt.integrate(**(default | arguments))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rtol": -1.0}, "rtol must be"),
        ({"rtol": 0.0}, "both zero"),
        ({"rtol": 1e-17}, "below the rounding"),
        ({"first": 0.0}, "first step"),
        ({"largest": np.inf}, "largest step"),
    ],
)
def test_bad_tolerances(options, message):
    with pytest.raises(lt.InputError, match=message):
        lt.Adaptive(**options)
    with pytest.raises(lt.InputError, match="tol must be positive"):
        lt.Relaxed(0.0)


# -- the method -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "explicit"), [(1.0, True), (300.0, False)])
def test_a_method_is_suggested_by_what_it_costs(rate, explicit):
    system, x0 = lt.models.rigid_body(rate=rate), np.array([0.1, 1.0, 0.1])
    suggestion = lt.suggest_method(system, x0, 1e-6)
    assert suggestion.method.explicit == explicit
    assert ("stiff, explicit steps cost" in suggestion.reason) != explicit
    assert [trial.evaluations for trial in suggestion.trials] == sorted(
        trial.evaluations for trial in suggestion.trials
    )
    assert suggestion.trials[0].method is suggestion.method
    assert len(str(suggestion).splitlines()) == len(suggestion.trials) + 2
    span = 20 * suggestion.step
    run = lt.integrate(system, x0, (0.0, span), suggestion.step, suggestion.method)
    exact = lt.integrate(system, x0, (0.0, span), span, lt.Reference(rtol=1e-12, scheme="Radau")).x[-1]
    assert np.abs(run.x[-1] - exact).max() < 1e-4
    with pytest.raises(lt.errors.InputError, match="nothing moves"):
        lt.suggest_method(system, [1.0, 0.0, 0.0])
