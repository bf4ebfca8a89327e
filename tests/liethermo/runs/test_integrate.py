"""The time loop: what it accepts, how it fails, and that nothing computed is lost."""

import functools
import itertools
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines import array_engine
from liethermo.engines.solver_options import DEFAULT_OPTIONS, SolverOptions
from liethermo.engines.status_codes import StatusCode
from liethermo.runs.progress import Progress
from tests.cases import EPS
from tests.systems import rigid_body

X0 = [0.001, 1.0, 0.001]


# -- times and saving ---------------------------------------------------------------------------------------------


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("end", "h", "steps"), [(1.0, 0.1, 10), (100.0, 0.1, 1000), (1.05, 0.1, 11), (0.05, 0.1, 1), (0.3, 0.1, 3)]
)
def test_the_run_ends_where_it_was_told_to(end, h, steps):
    solution = lt.integrate(rigid_body(), X0, (0.0, end), h)
    assert solution.t[-1] == end
    assert solution.stats.steps == steps
    assert len(solution.t) == len(solution.x) == steps + 1
    assert np.allclose(np.diff(solution.t)[:-1], h, atol=1e-12)


@pytest.mark.parametrize("every", [1, 2, 7, 10, 100, 1000])
def test_save_every(every):
    full = lt.integrate(rigid_body(), X0, (2.0, 12.05), 0.1)
    saved_run = lt.integrate(rigid_body(), X0, (2.0, 12.05), 0.1, save_every=every)
    saved_steps = sorted({*range(0, 101, every), 100, 101})
    if every > 1:
        saved_steps = [n for n in saved_steps if n % every == 0 or n in (100, 101)]
    assert np.array_equal(saved_run.x, full.x[saved_steps])
    assert np.array_equal(saved_run.t, full.t[saved_steps])
    assert saved_run.stats.steps == full.stats.steps
    assert saved_run.stats.least_entropy_increment == full.stats.least_entropy_increment


def test_chunks_do_not_show(monkeypatch):
    whole_run = lt.integrate(rigid_body(), X0, (0.0, 30.0), 0.1)
    monkeypatch.setattr(array_engine, "MAX_SAVES_PER_CALL", 16)
    pieces = lt.integrate(rigid_body(), X0, (0.0, 30.0), 0.1)
    assert np.array_equal(whole_run.x, pieces.x)


def test_runs_are_reproducible_and_pure():
    first_run, second = (lt.integrate(rigid_body(), X0, (0.0, 5.0), 0.1) for _ in range(2))
    assert np.array_equal(first_run.x, second.x)
    assert first_run.provenance["method"] == "MetriplecticGauss(stages=1)"


# -- input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("x0", "words"),
    [
        ([1.0, 2.0], r"shape \(3,\), got \(2,\)"),
        ([[1.0, 2.0, 3.0]], r"\(1, 3\)"),
        ([1.0, np.nan, 0.0], r"component \(1,\) is nan"),
        ([1.0, np.inf, 0.0], "not finite"),
        ([1.0, 1j, 0.0], "real"),
        (["a", "b", "c"], "real numbers"),
        ([[1.0], [2.0, 3.0]], "real numbers"),
    ],
)
def test_unusable_states(x0, words):
    with pytest.raises(lt.InputError, match=words):
        lt.integrate(rigid_body(), x0, (0.0, 1.0), 0.1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"step": 0.0}, "positive"),
        ({"step": -0.1}, "positive"),
        ({"step": np.nan}, "positive"),
        ({"step": "small"}, "number"),
        ({"step": 1e-20, "t_span": (1.0, 2.0)}, "below the rounding of the times"),
        ({"t_span": (1.0, 0.0)}, "increasing"),
        ({"t_span": (0.0, 0.0)}, "increasing"),
        ({"t_span": (0.0, np.inf)}, "finite"),
        ({"t_span": 3.0}, "two numbers"),
        ({"save_every": 0}, "save_every"),
        ({"save_every": 1.5}, "save_every"),
        ({"engine": "quantum"}, "engine"),
        ({"on_failure": "ignore"}, "on_failure"),
        ({"method": "midpoint"}, "lt.MetriplecticGauss"),
    ],
)
def test_unusable_arguments(arguments, words):
    with pytest.raises(lt.InputError, match=words):
        lt.integrate(rigid_body(), X0, **{"t_span": (0.0, 1.0), "step": 0.1, **arguments})


def test_the_system_comes_first():
    with pytest.raises(lt.InputError, match="system"):
        lt.integrate(lambda x: x, X0, (0.0, 1.0), 0.1)


# -- failure ------------------------------------------------------------------------------------------------------


def test_a_step_too_large_names_step_time_residual_and_advice():
    stiff = lt.LiePoissonSystem(
        mf.so(3), lambda p: jnp.sum(jnp.sin(40.0 * p)), lt.Quadratic(np.ones(3)), lt.KillingDissipation()
    )
    with pytest.raises(
        lt.ConvergenceError, match=r"step 1, from t = 0 with h = 50.*residual.*smaller step, for example"
    ) as caught:
        lt.integrate(stiff, [0.3, 1.0, -0.2], (0.0, 500.0), 50.0)
    solution = caught.value.solution
    assert (solution.status.code, solution.status.step, solution.status.time) == ("not_converged", 0, 0.0)
    assert solution.status.residual > DEFAULT_OPTIONS.plateau_rtol
    assert np.array_equal(solution.x, [[0.3, 1.0, -0.2]])
    assert not solution.audit().passed
    assert isinstance(caught.value, ArithmeticError)
    advised_step = float(str(caught.value).split()[-1])
    assert lt.integrate(
        stiff, [0.3, 1.0, -0.2], (0.0, advised_step), advised_step
    ).status.ok  # half the step would not do


@pytest.mark.slow
def test_no_smaller_step_is_advised_where_none_helps(monkeypatch):
    """The message says what was tried: with too few iterations shorter steps cannot be solved either."""
    hasty = functools.partial(
        array_engine.ArrayEngine, options=SolverOptions(max_fixed_point_iterations=1, max_newton_iterations=1)
    )
    monkeypatch.setattr("liethermo.engines.select_engine.ArrayEngine", hasty)
    # so fast that one iteration does not solve the shortest step
    system = lt.LiePoissonSystem(
        mf.so(3), lambda p: 1e3 * jnp.sum(p**4), lt.Quadratic(np.ones(3)), lt.KillingDissipation()
    )
    solution = lt.integrate(system, [0.8, 0.5, 0.9], (0.0, 1.0), 0.25, on_failure="return", engine="array")
    assert solution.status.code == "not_converged"
    assert "Try a smaller step" not in solution.status.message
    assert "do not help" in solution.status.message


@pytest.mark.sampled(1)
@pytest.mark.parametrize("x0", [[1.0, 20.0, 0.1], [5.0, 100.0, 5.0]])
@pytest.mark.parametrize("h", [1.0, 20.0, 50.0, 1e3])
def test_huge_steps_solve_their_equation(h, x0):
    """A diverging iteration is not taken for a converged one: of quadratic functions ``x' - x = h f((x + x') / 2)``."""
    solution = lt.integrate(rigid_body(), x0, (0.0, 20 * h), h, on_failure="return")
    x, z = solution.x, 0.5 * (solution.x[1:] + solution.x[:-1])
    jacobian = np.abs(jax.vmap(jax.jacfwd(rigid_body().vector_field))(z)).sum(axis=2).max(axis=1)
    rounding = EPS * np.abs(x).max() * (1.0 + h * jacobian)
    defect = np.abs(np.diff(x, axis=0) - h * np.asarray(jax.vmap(rigid_body().vector_field)(z))).max(axis=1)
    assert (defect <= 20 * rounding).all()
    assert solution.audit().energy_drift <= 1e-14
    assert len(x) > 5
    if h < 1e3:  # beyond, Newton's method is allowed to fail, and says so
        assert solution.audit().passed
    else:
        assert solution.status.code == ("completed" if len(x) == 21 else "not_converged")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", list(lt.registered_methods()), ids=str)
def test_one_iteration_is_not_enough_and_says_so(method):
    """Control for dropped statuses: with a single iteration allowed every implicit method must report failure."""
    system = lt.LiePoissonSystem(mf.so(3), lambda p: jnp.sum(p**4), lt.Quadratic(np.ones(3)), lt.KillingDissipation())
    engine = array_engine.ArrayEngine(
        system, method.on(system), SolverOptions(max_fixed_point_iterations=1, max_newton_iterations=1)
    )
    state, _ = engine.advance(engine.initial_run_state(jnp.array([0.8, 0.5, 0.9])), 0.01, 10, 1)
    assert int(state.status) == (StatusCode.COMPLETED if method.explicit else StatusCode.NOT_CONVERGED)
    assert int(state.step) == (10 if method.explicit else 0)


def test_newton_takes_over_where_fixed_point_iteration_fails():
    """A stiff body: the fixed point does not contract, Newton's method solves the same equations, the laws hold."""
    system = lt.models.rigid_body(inertia=(10, 5, 1), rate=200.0)
    solution = lt.integrate(system, [0.1, 1.0, 0.1], (0.0, 50.0), 0.5)
    assert solution.stats.newton_iterations > 0
    assert solution.audit().passed, f"\n{solution.audit()}"
    assert solution.entropy[-1] == pytest.approx(10 * solution.energy[0], rel=1e-12)


def domain_system():
    """An energy that ends where the body is about to go: sqrt of something that becomes negative."""
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / jnp.array([10.0, 5.0, 1.0])) + 1e-3 * jnp.sqrt(1.1 - p[0]),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.5),
        validate=False,
    )


def test_nan_midway_keeps_what_was_computed():
    with pytest.raises(lt.NonFiniteError, match=r"NaN or infinity in step \d+.*energy first.*domain") as caught:
        lt.integrate(domain_system(), [0.001, 1.0, 0.001], (0.0, 500.0), 0.1)
    solution = caught.value.solution
    assert solution.status.code == "non_finite"
    assert len(solution.t) == solution.status.step + 1 > 10
    assert solution.t[-1] == solution.status.time
    assert np.isfinite(solution.x).all()
    assert solution.audit().energy_drift < 1e-13
    assert solution.x[-1, 0] < 1.1


@pytest.mark.sampled(1)
@pytest.mark.parametrize("every", [1, 7, 10_000])
def test_on_failure_return(every):
    solution = lt.integrate(domain_system(), X0, (0.0, 500.0), 0.1, save_every=every, on_failure="return")
    whole_run = lt.integrate(domain_system(), X0, (0.0, 500.0), 0.1, on_failure="return")
    assert str(solution.status) == str(whole_run.status)
    assert np.array_equal(solution.x[-1], whole_run.x[-1])  # the last good state, between two saves too
    assert solution.t[-1] == whole_run.t[-1]


def test_the_reference_method_reports_failure_too():
    solution = lt.integrate(domain_system(), X0, (0.0, 500.0), 1.0, lt.Reference(), on_failure="return")
    assert solution.status.code in ("reference_failed", "completed")
    assert np.isfinite(solution.x).all()
    with pytest.raises(lt.InputError, match="rtol"):
        lt.Reference(rtol=0.0)
    with pytest.raises(lt.InputError, match="DOP853"):
        lt.Reference(scheme="Euler")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_ctrl_c_returns_what_exists(engine, monkeypatch):
    """The signal comes in the middle of a run that would go on for days."""
    counter = itertools.count()

    def update(self, t):
        if next(counter) == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "update", update)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may ignore the signal
    try:
        solution = lt.integrate(rigid_body(), X0, (0.0, 1e9), 0.1, save_every=1000, engine=engine)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert solution.status.code == "interrupted"
    assert "stopped by the user" in str(solution.status)
    assert len(solution.t) > 10
    assert solution.audit().passed


def test_ctrl_c_before_the_first_step(monkeypatch):
    def raise_interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(array_engine, "initial_run_state_program", raise_interrupt)
    solution = lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1, engine="array")
    assert (solution.status.code, solution.x.tolist(), solution.stats.steps) == ("interrupted", [X0], 0)


def test_progress_bar_is_silent_by_default_and_shown_on_request(capsys):
    lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1)
    assert capsys.readouterr() == ("", "")
    lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1, progress=True)
    assert "t =" in capsys.readouterr().err


def leaves_its_domain_with_attitude(torque=None):
    """A body whose energy is not defined for mu_1 >= 1.05; friction, or a torque, brings it there."""
    inertia = jnp.array([3.0, 2.0, 1.0])
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda mu: 0.5 * jnp.sum(mu**2 / inertia) + 0.01 * jnp.sqrt(1.05 - mu[0] ** 2),
        dissipation=lt.DoubleBracket(0.3),
        baths=lt.HeatBaths(2.0, 1.0),
        group=mf.SO(3),
        torque=torque,
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticTaylor(6), lt.MetriplecticGauss(2)])
@pytest.mark.parametrize(
    "torque", [None, lt.torques.ConstantInBody([0.3, 0.0, 0.0]), lt.torques.ConstantInSpace([0.3, 0.0, 0.0])]
)
def test_a_body_with_an_attitude_that_leaves_its_domain_says_so(method, torque):
    """The slopes of a body with an attitude have fewer components than its states."""
    system = leaves_its_domain_with_attitude(torque)
    run = lt.integrate(system, [0.5, 1.0, 1.2], (0.0, 4.0), 1.0, method, on_failure="return", engine="array")
    assert run.status.code == "non_finite"
    assert ("diverge or leave the domain" if method.explicit else "the energy first") in run.status.message
    assert np.isfinite(run.x).all()
    assert run.audit().verdict.startswith("THE RUN STOPPED")


def test_the_body_of_the_readme_in_steps_that_are_too_long():
    """A failed step is reported, and the advice of the message holds: a smaller step arrives."""
    body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.08)
    options = {"method": lt.MetriplecticRungeKutta(4), "on_failure": "return"}
    run = lt.integrate(body, [0.6, 1.0, 10.0], (0.0, 10.0), 5.0, **options)
    assert run.status.code == "non_finite"
    assert "too long for an explicit method" in run.status.message
    assert lt.integrate(body, [0.6, 1.0, 10.0], (0.0, 10.0), 0.01, **options).status.ok


@pytest.mark.slow
def test_a_potential_with_a_logarithm_on_se3_in_a_step_that_is_too_long():
    system = lt.LiePoissonSystem(mf.se(3), lambda mu: 0.5 * mu @ mu + jnp.log(mu[0]), group=mf.SE(3))
    x0 = [1e-3, 0.5, 0.2, 0.3, 0.1, 0.2]
    run = lt.integrate(system, x0, (0.0, 20.0), 1.0, lt.MetriplecticRungeKutta(4), on_failure="return", engine="array")
    assert run.status.code == "non_finite"
    assert "too long for an explicit method" in run.status.message
