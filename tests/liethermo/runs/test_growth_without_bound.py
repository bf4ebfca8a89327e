"""Runs whose state grows without bound say so, with its size and the time; ensembles of them raise no warnings."""

import warnings

import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

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


@pytest.mark.sampled(2)
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
