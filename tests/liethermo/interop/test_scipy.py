"""``lt.scipy.solve_ivp`` gives the results of SciPy's function, and conserves the laws."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.engines.select_engine import EngineWithFallback

BODY = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.3)
X0 = [0.1, 0.2, 1.0]
SPAN = (0.0, 8.0)


@jax.jit
def velocity(y):
    return BODY.vector_field(y)


def field(t, y):
    return np.asarray(velocity(y))


def test_solve_ivp_agrees_with_scipy_and_keeps_the_laws():
    times = [1.0, 2.5, 8.0]
    theirs = solve_ivp(field, SPAN, X0, "DOP853", times, rtol=1e-10, atol=1e-12)
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, t_eval=times, rtol=1e-10, atol=1e-12)
    assert ours.success
    assert ours.status == theirs.status == 0
    assert np.array_equal(ours.t, theirs.t)
    assert ours.y.shape == theirs.y.shape
    assert np.allclose(ours.y, theirs.y, rtol=0, atol=1e-8)
    assert ours.sol is None
    assert ours.t_events is None
    assert ours.nfev > 0
    assert ours.solution.audit().energy_drift < 1e-14
    assert np.ptp(BODY.energy(theirs.y.T)) > 1e-13  # theirs drifts: there is something to keep


def crossing_event(t, y):
    return y[0] - y[1] + 0.1 * np.sin(t)


def oscillating_event(t, y):
    return np.sin(3.0 * t) + y[2] - 1.0


def _event(function, **attributes):
    copy = lambda t, y: function(t, y)  # noqa: E731
    vars(copy).update(attributes)
    return copy


def solve_by_both(events, span=SPAN, rtol=1e-10, **settings):
    """Return the results of SciPy and of the library."""
    settings = {"events": events, "rtol": rtol, "atol": rtol, **settings}
    return solve_ivp(field, span, X0, "DOP853", **settings), lt.scipy.solve_ivp(BODY, span, X0, **settings)


def assert_same_events(theirs, ours, tolerance=1e-8):
    assert ours.status == theirs.status
    assert [len(times) for times in ours.t_events] == [len(times) for times in theirs.t_events]
    for name in ("t_events", "y_events"):
        for our_values, peer_values in zip(getattr(ours, name), getattr(theirs, name), strict=True):
            assert np.abs(our_values - peer_values.reshape(our_values.shape)).max(initial=0.0) < tolerance


@pytest.mark.sampled("-1")
@pytest.mark.parametrize("direction", [-1, 0, 1])
def test_events_are_those_of_scipy(direction):
    events = [_event(f, direction=direction) for f in (crossing_event, oscillating_event)]
    theirs, ours = solve_by_both(events, dense_output=True)
    assert_same_events(theirs, ours)
    assert len(ours.t_events[0]) + len(ours.t_events[1]) > 2
    assert ours.sol([1.0, 2.0]).shape == theirs.sol([1.0, 2.0]).shape == (3, 2)
    assert ours.sol(1.0).shape == (3,)
    assert np.abs(ours.sol(TIMES) - theirs.sol(TIMES)).max() < 1e-8


TIMES = np.linspace(*SPAN, 50)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [None, lt.MetriplecticGauss(3), lt.MetriplecticRungeKutta(4)], ids=str)
@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_events_are_zeros_and_as_accurate_as_asked_and_the_laws_hold_there(rtol, method):
    exact = solve_ivp(field, SPAN, X0, "DOP853", events=crossing_event, rtol=3e-14, atol=1e-16).t_events[0]
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, method, events=crossing_event, rtol=rtol, atol=rtol, dense_output=True)
    assert np.abs(ours.t_events[0] - exact).max() < 30.0 * rtol
    assert max(abs(crossing_event(t, y)) for t, y in zip(ours.t_events[0], ours.y_events[0], strict=True)) < 2e-15
    states = np.concatenate([ours.y_events[0], ours.sol(TIMES).T])
    assert np.ptp([*BODY.energy(states), ours.solution.energy[0]]) < 2e-15


def test_several_zeros_in_a_step_are_found():
    """At this tolerance a step spans up to half a radian and may contain more than two zeros."""
    theirs, ours = solve_by_both(lambda t, y: np.sin(9.0 * t) + 0.1 * y[0], rtol=1e-6, max_step=0.05)
    coarse_run = lt.scipy.solve_ivp(
        BODY, SPAN, X0, events=lambda t, y: np.sin(9.0 * t) + 0.1 * y[0], rtol=1e-6, atol=1e-6
    )
    assert_same_events(theirs, ours, 1e-5)
    run_without_events = lt.scipy.solve_ivp(BODY, SPAN, X0, rtol=1e-6, atol=1e-6)
    assert len(run_without_events.t) < len(theirs.t_events[0]) / 2
    assert np.abs(coarse_run.t_events[0] - theirs.t_events[0]).max() < 1e-4


@pytest.mark.sampled(1)
@pytest.mark.parametrize("terminal", [True, 2, 3])
def test_terminal_events_end_the_run_at_their_zeros(terminal):
    """Other events are kept up to the terminal one, whose state is the last."""
    shifted_event = lambda t, y: oscillating_event(t, y) - 0.01  # noqa: E731
    theirs, ours = solve_by_both([_event(shifted_event, terminal=terminal), crossing_event], dense_output=True)
    assert_same_events(theirs, ours)
    assert (ours.status, ours.success, ours.message) == (1, True, "A termination event occurred.")
    assert len(ours.t_events[0]) == int(terminal)
    assert ours.t[-1] == ours.t_events[0][-1]
    assert np.array_equal(ours.y[:, -1], ours.y_events[0][-1])
    assert abs(shifted_event(ours.t[-1], ours.y[:, -1])) < 2e-15
    assert ours.solution.audit().passed
    assert np.array_equal(ours.sol(ours.t[-1]), ours.y[:, -1])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("terminal", [False, True])
def test_events_at_both_ends(terminal):
    """Zeros exactly at the end or at the start count as in SciPy, and an end of a step counts once."""
    for time in (SPAN[1], SPAN[0]):
        theirs, ours = solve_by_both(_event(lambda t, y, time=time: t - time, terminal=terminal))
        assert_same_events(theirs, ours)
        assert ours.t_events[0].tolist() == [time]
        assert ours.t[-1] == (time if terminal else SPAN[1])
    sampled_run = lt.scipy.solve_ivp(BODY, SPAN, X0, t_eval=[1.0, 3.0], events=lambda t, y: t - 3.0)
    assert sampled_run.t_events[0].tolist() == [3.0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("width", [1e-6, 1e-3, 0.02, 0.5])
def test_a_function_that_is_not_a_number_has_no_zero_there(width):
    """The NaN interval may be wider than the steps, or so narrow that only the search meets it."""
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, events=lambda t, y: np.nan if abs(t - 3.0) < width else t - 3.0)
    assert ours.success
    assert ours.t_events[0].size == 0


def forced_oscillator(t, y):
    return [y[1], -y[0] + 0.1 * np.sin(2.0 * t)]


OSCILLATOR = lt.MetriplecticSystem(
    poisson=mf.Canonical(1), energy=lambda x, t: 0.5 * (x @ x) - 0.1 * jnp.sin(2.0 * t) * x[0], dim=2
)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("direction", [-1, 0, 1])
def test_events_in_the_first_step_of_a_driven_system(direction):
    """Events in the first step and zeros at the start are found in a driven system."""
    functions = (lambda t, y: y[0] - 0.9995, lambda t, y: y[1], lambda t, y: y[0] - 1.0, lambda t, y: t)
    events = [_event(f, direction=direction) for f in functions]
    settings = {"events": events, "rtol": 1e-9, "atol": 1e-9}
    # in longer steps SciPy sees no event that is undone within a step
    theirs = solve_ivp(forced_oscillator, (0.0, 10.0), [1.0, 0.0], "DOP853", max_step=0.05, **settings)
    ours = lt.scipy.solve_ivp(OSCILLATOR, (0.0, 10.0), [1.0, 0.0], **settings)
    if direction <= 0:
        assert ours.t_events[0][0] < ours.t[1]
        assert ours.t_events[1][0] == ours.t_events[2][0] == 0.0
    assert_same_events(theirs, ours, 1e-6)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "events", [lambda t, y: y[1] * 0.0, lambda t, y: min(t - 1.0, 0.0) if t else 0.0], ids=["zero", "nearly"]
)
def test_a_zero_at_the_start_is_a_zero_whatever_comes_next(events):
    """As in SciPy, a terminal event that is zero at the start ends the run."""
    settings = {"events": _event(events, terminal=True)}
    theirs = solve_ivp(forced_oscillator, (0.0, 10.0), [1.0, 0.0], **settings)
    ours = lt.scipy.solve_ivp(OSCILLATOR, (0.0, 10.0), [1.0, 0.0], **settings)
    assert ours.status == theirs.status == 1
    assert ours.t_events[0].tolist() == theirs.t_events[0].tolist() == [0.0]


def test_events_of_a_body_near_its_middle_axis():
    """Partial steps of long steps do not converge there at a loose tolerance; shorter ones do."""
    body, x0 = lt.models.free_rigid_body((3.0, 2.0, 1.0)), [1e-6, 1.0, 1e-6]

    def field_of_body(t, m):
        return np.cross(m, m / np.array([3.0, 2.0, 1.0]))

    first = lambda t, y: y[0]  # noqa: E731
    exact = solve_ivp(field_of_body, (0.0, 400.0), x0, "DOP853", rtol=3e-14, atol=1e-20, events=first).t_events[0]
    for rtol in (1e-3, 1e-6):
        ours = lt.scipy.solve_ivp(body, (0.0, 400.0), x0, events=first, dense_output=True, rtol=rtol, atol=1e-3 * rtol)
        assert len(ours.t_events[0]) == len(exact) == 3
        # deviations grow at their rate to a few thousandths, whatever the tolerance: see lt.Adaptive
        assert np.abs(ours.t_events[0] / exact - 1.0).max() < 4e-3
        assert np.abs(ours.y_events[0][:, 0]).max() < 1e-16
        assert np.ptp(np.linalg.norm(ours.y_events[0], axis=1)) < 1e-13


def test_a_state_between_steps_that_cannot_be_found_is_an_error(monkeypatch):
    monkeypatch.setattr(EngineWithFallback, "step_ends", lambda self, x, h: np.full_like(x, np.nan))
    run = lt.integrate(BODY, X0, SPAN, 0.5, dense=True)
    assert np.array_equal(run(SPAN[1]), run.x[-1])
    with pytest.raises(lt.ConvergenceError, match=r"the state at t = 0\.75, between two steps, cannot be found"):
        run([0.5, 0.75])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("width", [1e-6, 0.5, 3.0])
def test_the_message_says_where_a_function_is_not_a_number(width):
    """A sign change across NaN values may or may not be a zero, so it is reported."""
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, events=lambda t, y: np.nan if abs(t - 3.0) < width else t - 3.0)
    assert "the event function is NaN before t = " in ours.message
    same_sign_run = lt.scipy.solve_ivp(BODY, SPAN, X0, events=lambda t, y: np.nan if abs(t - 3.0) < width else t + 3.0)
    assert "NaN" not in same_sign_run.message


def test_arguments_of_scipy():
    """An infinite maximum step is allowed, and ``args`` are passed to the events."""
    level = lambda t, y, c: crossing_event(t, y) - c  # noqa: E731
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, events=level, args=(0.01,), vectorized=True, max_step=np.inf)
    assert crossing_event(ours.t_events[0][0], ours.y_events[0][0]) == pytest.approx(0.01, abs=1e-15)
    assert lt.scipy.solve_ivp(BODY, SPAN, X0, t_eval=[0.0]).t.tolist() == [0.0]
    assert lt.scipy.solve_ivp(BODY, SPAN, X0, t_eval=[]).t.size == 0


@pytest.mark.parametrize("call", [lt.scipy.solve_ivp, lambda system, span, x0: lt.integrate(system, x0, span, 0.1)])
def test_the_advice_on_a_span_that_runs_backwards(call):
    """The advice leads from the end of a run back to its start, with friction and in a driven system."""
    driven = lt.MetriplecticSystem(mf.Canonical(1), lambda x, t: 0.5 * (x @ x) - jnp.sin(3.0 * t) * x[0])
    for system, x0, span in ((BODY, X0, SPAN), (driven, [0.4, -0.2], (0.1, 2.7))):
        with pytest.raises(lt.InputError, match="finite and increasing") as error:
            call(system, span[::-1], x0)
        advice = re.search(r"scipy\.integrate\.solve_ivp\(.*\)", str(error.value))[0]
        end = lt.integrate(system, x0, span, 0.02, lt.MetriplecticGauss(3)).x[-1]
        start = eval(advice, {"scipy": scipy, "system": system, "x0": end}).y[:, -1]
        np.testing.assert_allclose(start, x0, rtol=0, atol=1e-7)


def test_a_failure_is_told_as_scipy_tells_it():

    result = lt.scipy.solve_ivp(BODY, (0.0, 1e3), X0, method=lt.MetriplecticGauss(1), rtol=1e-300, atol=1e-300)
    assert not result.success
    assert result.status == -1
    assert result.message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fun": field}, "must be a system"),
        ({"t_eval": [2.0, 1.0]}, "increasing"),
        ({"t_eval": [1.0, 9.0]}, r"t_eval must be times of t_span = \(0, 8\), got 9"),
        ({"t_eval": [-1.0, 1.0]}, "got -1, outside of it"),
        ({"t_span": (8.0, 0.0)}, r"must be finite and increasing, got \(8, 0\)"),
        ({"t_span": 3.0}, "two numbers"),
        ({"args": (1.0,)}, "args are passed to the events, but there are none"),
        ({"args": 1.0, "events": crossing_event}, r"Write args=\(1.0,\)"),
        ({"events": _event(crossing_event, terminal=-1)}, "terminal must be True or the number"),
        ({"jac": None}, "leave out jac: the methods take it from the system"),
        ({"rtoll": 1e-6}, "leave out rtoll: solve_ivp has no such option"),
        ({"max_step": -1.0}, "largest step"),
    ],
)
def test_invalid_arguments_are_refused(arguments, message):
    with pytest.raises(lt.InputError, match=message):
        lt.scipy.solve_ivp(**({"fun": BODY, "t_span": SPAN, "y0": X0} | arguments))
