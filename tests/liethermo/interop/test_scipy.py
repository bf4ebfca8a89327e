"""``lt.scipy.solve_ivp`` does what SciPy's does, and keeps the laws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt

BODY = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.3)
X0, SPAN = [0.1, 0.2, 1.0], (0.0, 8.0)


def field(t, y):
    return np.asarray(BODY.vector_field(y))


def test_it_agrees_with_scipy_and_keeps_the_laws():
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
    energies = [float(BODY.energy.value(y)) for y in theirs.y.T]
    assert np.ptp(energies) > 1e-13  # theirs drifts: there is something to keep


def crossing(t, y):
    return y[0] - y[1]


def _event(function, **attributes):
    copy = lambda t, y: function(t, y)  # noqa: E731
    vars(copy).update(attributes)
    return copy


@pytest.mark.parametrize("direction", [-1, 0, 1])
def test_events_are_those_of_scipy(direction):
    watched = _event(crossing, direction=direction)
    settings = {"rtol": 1e-10, "atol": 1e-12, "dense_output": True}
    theirs = solve_ivp(field, SPAN, X0, "DOP853", events=[watched], **settings)
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, events=[watched], **settings)
    assert ours.t_events is not None
    assert ours.y_events is not None
    assert ours.sol is not None
    assert ours.t_events[0].shape == theirs.t_events[0].shape
    assert np.allclose(ours.t_events[0], theirs.t_events[0], atol=1e-5)
    assert ours.y_events[0].shape[-1] == 3
    assert ours.sol([1.0, 2.0]).shape == theirs.sol([1.0, 2.0]).shape == (3, 2)
    assert ours.sol(1.0).shape == (3,)


def test_a_terminal_event_ends_the_run_and_the_laws_hold_there():
    ours = lt.scipy.solve_ivp(BODY, SPAN, X0, events=_event(crossing, terminal=True), rtol=1e-9, atol=1e-12)
    assert (ours.status, ours.success, ours.message) == (1, True, "A termination event occurred.")
    assert ours.t_events is not None
    assert ours.t[-1] == pytest.approx(ours.t_events[0][0])
    assert abs(crossing(ours.t[-1], ours.y[:, -1])) < 1e-5
    assert ours.solution.audit().energy_drift < 1e-14
    second = lt.scipy.solve_ivp(BODY, SPAN, X0, events=_event(crossing, terminal=2), rtol=1e-9, atol=1e-12)
    assert second.t_events is not None
    assert len(second.t_events[0]) == 2


def test_a_failure_is_told_as_scipy_tells_it():

    result = lt.scipy.solve_ivp(BODY, (0.0, 1e3), X0, method=lt.MetriplecticGauss(1), rtol=1e-300, atol=1e-300)
    assert not result.success
    assert result.status == -1
    assert result.message


def test_bad_input_is_refused():
    with pytest.raises(lt.InputError, match="must be a system"):
        lt.scipy.solve_ivp(field, SPAN, X0)
    with pytest.raises(lt.InputError, match="increasing"):
        lt.scipy.solve_ivp(BODY, SPAN, X0, t_eval=[2.0, 1.0])
