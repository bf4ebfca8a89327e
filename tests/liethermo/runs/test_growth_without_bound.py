"""Long runs: a million steps without drift, and states that grow without bound, which a run says."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from benchmarks.measurements import spin
from benchmarks.problems import general_body
from liethermo.functions.gradients import DISCRETE_GRADIENTS

GAUSS = lt.MetriplecticGauss(2)
EXPLICIT = lt.MetriplecticRungeKutta(4)


def hill():
    """Down from the top of a parabola: exponential growth, to overflow near t = 355."""
    return lt.MetriplecticSystem(mf.Canonical(1), lt.Quadratic(np.diag([-1.0, 1.0]))), 400.0, 0.2


def cubic():
    """``q'' = 3 q^2`` goes to infinity near t = 1.48."""
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 - x[0] ** 3), 10.0, 0.05


def steep():
    """``q'' = q^3``, from q = p = 1, goes to infinity near t = 1.311."""
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 - 0.25 * x[0] ** 4), 10.0, 0.01


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("case", "method", "adaptive"),
    [
        (hill, GAUSS, False),
        (cubic, GAUSS, False),
        (steep, EXPLICIT, False),
        (cubic, EXPLICIT, True),
        (hill, EXPLICIT, False),
        (steep, GAUSS, True),
    ],
)
def test_a_run_says_that_its_state_grows_without_bound(case, method, adaptive):
    system, end, h = case()
    solution = lt.integrate(
        system, [1.0, 1.0], (0.0, end), lt.Adaptive(1e-8) if adaptive else h, method, on_failure="return"
    )
    status = solution.status
    assert not status.ok
    assert "grows without bound" in status.message
    assert f"|x| = {np.abs(solution.x[-1]).max():.3g} at t = {status.time:g}" in status.message
    assert "smaller step" not in status.message
    assert "larger tolerance" not in status.message


def test_what_stays_bounded_is_told_what_helps():
    """A step that is too long, of a motion that stays on its circle."""
    body = lt.models.rigid_body()
    solution = lt.integrate(body, [0.1, 1.0, 0.3], (0.0, 60.0), 15.0, lt.MetriplecticRungeKutta(8), on_failure="return")
    assert "smaller step" in solution.status.message
    assert "without bound" not in solution.status.message


@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
def test_ensembles_that_overflow_raise_no_warnings(engine, tmp_path):
    system, end, h = hill()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ensemble = lt.ensemble(system, [[1.0, 1.0], [2.0, -1.0], [0.0, 0.0]], (0.0, end), h, GAUSS, engine=engine)
        audit = ensemble.audit()
        text, loaded_run = str(ensemble), lt.load(ensemble.save(tmp_path / "many.nc"))
    assert list(ensemble.ok) == [False, False, True]  # the last stays on the top
    assert not audit.passed
    assert [row.law for row in audit.rows if row.passed is False] == ["trajectories that failed"]
    assert audit.verdict == "SOME TRAJECTORIES STOPPED before their end; the laws hold until there"
    assert text.count("grows without bound: |x| = ") == 2
    assert "smaller step" not in text
    assert loaded_run.message(0) == ensemble.message(0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.05, lt.Adaptive(1e-6)], ids=["equal", "adaptive"])
def test_ensembles_say_what_has_grown(step):
    system, end, _ = cubic()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ensemble = lt.ensemble(system, [[1.0, 1.0], [0.5, 1.0]], (0.0, end), step, EXPLICIT, outputs="summary")
        ensemble.audit()
    assert not ensemble.ok.any()
    for i in range(2):
        message = ensemble.message(i)
        assert "without bound" in message
        assert f"at t = {ensemble.end_time[i]:g}" in message


def test_a_single_run_that_overflows_is_audited():
    system, end, h = hill()
    solution = lt.integrate(system, [1.0, 1.0], (0.0, end), h, GAUSS, on_failure="return")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        audit = solution.audit()
    assert audit.verdict == "THE RUN STOPPED before its end; the laws hold until there"
    assert np.isfinite(solution.energy).all()


MILLION = 1_000_000


@pytest.mark.sampled(1)
@pytest.mark.parametrize("h", [1e-5, 0.05, 0.1])
def test_free_body_energy_after_a_million_steps(h):
    """Relative drift below 2e-14: compensated summation, and an iteration that stops at its plateau and not before."""
    system = lt.models.free_rigid_body()
    solution = lt.integrate(system, [np.cos(1.1), 0, np.sin(1.1)], (0.0, MILLION * h), h, save_every=10_000)
    assert solution.stats.steps == MILLION
    assert solution.audit().energy_drift < 2e-14


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", DISCRETE_GRADIENTS)
def test_relaxing_to_rounding_and_staying_there(name):
    """A body with a non-quadratic energy relaxes until |x' - x| is at rounding, and stays for a million steps."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / jnp.array([3.0, 2.0, 1.0])) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1]),
        lt.Quadratic(np.ones(3)),
        lt.ProjectedMetric(rate=0.3),
    )
    method = lt.MetriplecticMidpoint(name)
    early_run = lt.integrate(system, [0.8, 0.5, 0.9], (0.0, 3000.0), 0.1, method, save_every=100)
    late_run = lt.integrate(system, early_run.x[-1], (0.0, 0.1 * MILLION), 0.1, method, save_every=1000)
    assert early_run.audit().passed, f"\n{early_run.audit()}"
    assert np.abs(early_run.x[-1] - early_run.x[-2]).max() < 1e-15
    audit = late_run.audit(energy=1e-14)
    assert audit.passed, f"\n{audit}"
    assert np.abs(late_run.x - late_run.x[0]).max() < 1e-13  # no random walk along the equilibria
    assert late_run.stats.iterations_per_step <= early_run.stats.iterations_per_step
    assert late_run.stats.newton_iterations == 0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_the_energy_of_a_motion_that_goes_on(engine):
    """A general energy, hardly relaxing: each step rounds anew, and the errors must not add up (they came to 1e-11)."""
    system, x0 = general_body(3.4e-4), [0.001, 1.0, 0.001]
    solution = lt.integrate(system, x0, (0.0, 10_000.0), 0.1, save_every=1000, engine=engine)
    assert solution.audit(energy=8e-15).passed, str(solution.audit())


@pytest.mark.slow
@pytest.mark.parametrize("gradient", ["gonzalez", "mean_value"])
def test_the_energy_in_long_steps(gradient):
    """The difference of H, used at every step, must not take back the correction of the drift (which was 1e-13)."""
    system, method = general_body(6.6e-6), lt.MetriplecticMidpoint(gradient)
    solution = lt.integrate(system, [0.3, 1.0, 0.2], (0.0, 3e5), 1.0, method, save_every=3000, engine="compiled")
    assert solution.audit(energy=8e-15).passed, str(solution.audit())


@pytest.mark.slow
def test_the_energy_on_a_sphere():
    """A spin and its bath, on its way for 1e5 steps in which the points are rounded anew (it came to 6e-13)."""
    solution = lt.integrate(spin.spin_system(2e-4), spin.X0, (0.0, 1e4), 0.1, save_every=1000, engine="compiled")
    assert solution.audit(energy=2e-14).passed, str(solution.audit())
