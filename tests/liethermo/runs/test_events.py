"""Events within steps: the first of several is found, and what is undone before the step ends is seen."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

BODY = lt.models.rigid_body()
OSCILLATOR = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x @ x)
METHODS = [lt.MetriplecticGauss(3), lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(20)]


def two_levels(x):
    """Positive at first; of x = (cos t, -sin t) it changes its sign four times while cos t is below -0.8."""
    return (x[0] + 0.8) * (x[0] + 0.95)


def two_levels_and_one(x):
    """And once more, at t = 4.07."""
    return two_levels(x) * (0.8 - x[1])


FIRST = np.arccos(-0.8)


@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
@pytest.mark.parametrize("until", [two_levels, two_levels_and_one])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_first_of_several_in_a_step_is_found(method, until, engine):
    """An even and an odd number of them; the longest steps are of three radians."""
    arguments = (0.0, 8.0), lt.Adaptive(1e-9), method
    found = lt.integrate(OSCILLATOR, [1.0, 0.0], *arguments, until=until, engine=engine)
    assert found.event_time == pytest.approx(FIRST, abs=1e-7)
    assert abs(found.x[-1, 0] + 0.8) < 4e-16, "to rounding"
    assert found.audit().passed
    many = lt.ensemble(OSCILLATOR, [[1.0, 0.0], [0.5, 0.0]], *arguments, until=until, engine=engine)
    assert many.event_time[0] == pytest.approx(found.event_time, abs=1e-13)
    assert np.isnan(many.event_time[1])


def test_control_without_looks_a_later_one_is_taken_for_the_first(monkeypatch):
    monkeypatch.setattr(lt.MetriplecticTaylor, "looks", property(lambda self: np.zeros(0)))
    method = lt.MetriplecticTaylor(19)  # which nothing has been compiled for
    arguments = (0.0, 8.0), lt.Adaptive(1e-9), method
    assert lt.integrate(OSCILLATOR, [1.0, 0.0], *arguments, until=two_levels_and_one).event_time > FIRST + 0.1


@pytest.mark.parametrize("method", METHODS[1:], ids=str)
def test_a_body_that_relaxes_for_a_moment_is_relaxed(method):
    """The entropy production falls below the limit, rises again within a step or two, and falls for good later."""
    x0s = np.random.default_rng(0).standard_normal((200, 3))
    x0s /= np.linalg.norm(x0s, axis=1)[:, None]
    given = BODY, x0s, (0.0, 30.0)
    fine = lt.ensemble(*given, 0.005, lt.MetriplecticRungeKutta(8), until=lt.Relaxed(1e-6))
    long = lt.ensemble(*given, lt.Adaptive(1e-8), method, until=lt.Relaxed(1e-6))
    assert np.isfinite(fine.event_time).sum() > 50
    assert np.array_equal(np.isfinite(long.event_time), np.isfinite(fine.event_time))
    assert np.nanmax(np.abs(long.event_time - fine.event_time)) < 1e-3
    ends = lt.ensemble(*given, 1.0, lt.MetriplecticRungeKutta(8), until=lt.Relaxed(1e-6))
    late = ends.event_time > fine.event_time + 0.1
    assert late.any(), "steps of given size are looked at where they end, and miss some"


@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-8)])
@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
def test_a_part_of_a_step_that_fails_is_not_passed_over(engine, step):
    """The event is where the function is not a number: adaptive steps become shorter in vain, given ones say so."""
    until = lambda x: jnp.where(jnp.abs(x[0] - 0.5) < 0.02, jnp.nan, x[0] - 0.5)  # noqa: E731
    found = lt.integrate(
        OSCILLATOR,
        [1.0, 0.0],
        (0.0, 4.0),
        step,
        lt.MetriplecticRungeKutta(8),
        until=until,
        engine=engine,
        on_failure="return",
    )
    assert found.event_time is None
    assert found.status.code == ("non_finite" if step == 0.1 else "step_underflow")
    assert ("the event function is not a number" in found.status.message) == (step == 0.1)
    assert found.t[-1] == pytest.approx(np.arccos(0.5), abs=0.11)


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(lt.MetriplecticRungeKutta(8), id="8"),
        pytest.param(lt.MetriplecticTaylor(20), id="Taylor", marks=pytest.mark.slow),
    ],
)
def test_an_event_that_comes_and_goes_within_a_step_is_seen(method):
    """A body turns about two axes in turn, and is above a level for a fraction of a step each time."""
    body, x0 = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.0), np.array([1.0, 0.2, 0.1])
    fine = lt.integrate(body, x0, (0.0, 40.0), 1e-3, lt.MetriplecticGauss(3))
    level = 0.998 * fine.x[:, 1].max()
    above = np.flatnonzero(fine.x[:, 1] > level)
    rises = fine.t[above[0]]
    falls = fine.t[above[np.argmax(np.diff(above) > 1)]]
    arguments = (0.0, 40.0), lt.Adaptive(1e-8), method
    steps = np.diff(lt.integrate(body, x0, *arguments, dense=True).t)
    assert falls - rises < steps.mean() / 2
    found = lt.integrate(body, x0, *arguments, until=lambda x: x[1] - level)
    assert found.event_time == pytest.approx(rises, abs=1.5e-3)
    assert abs(found.x[-1, 1] - level) < 1e-13
    many = lt.ensemble(body, np.tile(x0, (3, 1)), *arguments, until=lambda x: x[1] - level)
    assert np.abs(many.event_time - found.event_time).max() < 1e-12
