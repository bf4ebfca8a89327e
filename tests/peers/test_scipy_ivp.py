"""Set-ups and values of SciPy's own tests of ``solve_ivp`` (scipy/integrate/_ivp/tests/test_ivp.py, BSD licence).

Its functions are right-hand sides; ours are systems with the same solutions. Each test names the one that it follows.
What cannot be followed: fields without an energy (stiff kinetics, complex decay), time that runs backwards, SciPy's
solver classes and its numerical Jacobians.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import liethermo as lt
import manifolds as mf

RTOL = 1e-3
ATOL = 1e-6

METHODS = [
    lt.MetriplecticRungeKutta(4),
    lt.MetriplecticRungeKutta(8),
    lt.MetriplecticTaylor(8),
    lt.MetriplecticGauss(3),
]

solve_ivp = lt.scipy.solve_ivp


def canonical(energy, pairs=1):
    return lt.MetriplecticSystem(poisson=mf.Canonical(pairs), energy=energy, dim=2 * pairs)


def linear_energy(x):
    return -x[0] * x[1] - 2.5 * x[1] ** 2 - 0.5 * x[0] ** 2


LINEAR = canonical(linear_energy)
"""Hamiltonian system of SciPy's fun_linear: q' = -q - 5 p, p' = q + p."""

OSCILLATOR = canonical(lambda x: 0.5 * (x @ x))

RATIONAL = canonical(lambda x, t: 0.5 * x[1] ** 2 + 20.0 * x[0] / (t + 10.0) ** 3)
"""Driven particle along q = t / (t + 10), the first component of SciPy's fun_rational; the second is t p."""

AT_5 = [1.0 / 3.0, 10.0 / 15.0**2]


def sol_linear(t):
    return np.vstack((-5.0 * np.sin(2.0 * t), 2.0 * np.cos(2.0 * t) + np.sin(2.0 * t)))


def sol_rational(t):
    return np.array([t / (t + 10.0), 10.0 / (t + 10.0) ** 2])


def compute_error(y, exact):
    error = (y - exact) / (ATOL + RTOL * np.abs(exact))
    return np.linalg.norm(error, axis=0) / np.sqrt(len(error))


def with_attributes(function, **attributes):
    copy = lambda t, y, *args: function(t, y, *args)  # noqa: E731
    vars(copy).update(attributes)
    return copy


def crossing_1(t, y):
    """Evaluate SciPy's event_rational_1, y the components of its fun_rational."""
    return y[0] - (t * y[1]) ** 0.7


def crossing_2(t, y):
    return (t * y[1]) ** 0.6 - y[0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_integration(method):
    """test_integration, forwards: errors at the steps, at 50 times and at one time, within five tolerances."""
    res = solve_ivp(RATIONAL, [5, 9], AT_5, method, rtol=RTOL, atol=ATOL, dense_output=True)
    assert (res.t[0], res.t[-1], res.t_events, res.y_events, res.success, res.status) == (5, 9, None, None, True, 0)
    assert np.all(compute_error(res.y, sol_rational(res.t)) < 5)
    for times in (np.linspace(5, 9), 7.0):
        assert np.all(compute_error(res.sol(times), sol_rational(times)) < 5)
    assert np.allclose(res.sol(res.t), res.y, rtol=1e-15, atol=1e-15)
    if method.explicit:
        assert (res.njev, res.nlu) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_integration_const_jac(method):
    """Errors are measured by the size of the state: SciPy measures each component, which is small near its zero."""
    res = solve_ivp(LINEAR, [0, 2], [0, 2], method, rtol=RTOL, atol=ATOL, dense_output=True)
    assert res.success
    assert res.status == 0
    size = np.abs(sol_linear(np.linspace(0, 2))).max()
    for times, states in ((res.t, res.y), (np.linspace(0, 2), res.sol(np.linspace(0, 2)))):
        assert np.abs(states - sol_linear(times)).max() < 5 * (ATOL + RTOL * size)
        if method.order > 4:
            assert np.all(compute_error(states, sol_linear(times)) < 10)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
@pytest.mark.parametrize(("direction", "numbers"), [(0, (1, 1)), (1, (1, 0)), (-1, (0, 1))])
def test_events(method, direction, numbers):
    events = [with_attributes(f, direction=direction) for f in (crossing_1, crossing_2)]
    res = solve_ivp(RATIONAL, [5, 8], AT_5, method, events=events)
    assert res.status == 0
    assert tuple(len(times) for times in res.t_events) == numbers
    for function, interval, times, states in zip(
        events, [(5.3, 5.7), (7.3, 7.7)], res.t_events, res.y_events, strict=True
    ):
        assert states.shape == (len(times), 2)
        for t, y in zip(times, states, strict=True):
            assert interval[0] < t < interval[1]
            assert function(t, y) == pytest.approx(0.0, abs=1e-8)
            assert np.allclose(sol_rational(t), y, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_events_with_a_terminal_one():
    """test_events, third part: the second event would come after the end."""
    end_event = with_attributes(lambda t, y: t - 7.4, terminal=True)
    res = solve_ivp(RATIONAL, [5, 8], AT_5, events=(crossing_1, crossing_2, end_event), dense_output=True)
    assert res.status == 1
    assert [len(times) for times in res.t_events] == [1, 0, 1]
    assert 5.3 < res.t_events[0][0] < 5.7
    assert res.t_events[2][0] == pytest.approx(7.4, abs=1e-14)
    times = np.linspace(res.t[0], res.t[-1])
    assert np.all(compute_error(res.sol(times), sol_rational(times)) < 5)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("number", [3, 4])
def test_event_terminal_integer(number):
    res = solve_ivp(OSCILLATOR, (0, 100), [1, 0], events=with_attributes(lambda t, y: y[0], terminal=number))
    assert len(res.t_events[0]) == len(res.y_events[0]) == number
    assert np.abs(res.y_events[0][:, 0]).max() < 1e-14


def test_event_terminal_iv():
    """None and 0 are no end; what is neither True nor a positive integer is refused."""
    runs = [
        solve_ivp(OSCILLATOR, (0, 30), [1, 0], events=with_attributes(lambda t, y: y[0], terminal=terminal))
        for terminal in (None, 0)
    ]
    assert np.array_equal(runs[0].t_events, runs[1].t_events)
    assert runs[0].t_events[0].size == 10
    for terminal in (-1, 3.5):
        with pytest.raises(ValueError, match="terminal"):
            solve_ivp(OSCILLATOR, (0, 100), [1, 0], events=with_attributes(lambda t, y: y[0], terminal=terminal))


def test_duplicate_timestamps():
    """An endless span, ended by an event, in steps of 5e-6 as there; beyond its end nothing is extrapolated."""
    cannon = canonical(lambda x: 0.5 * x[1] ** 2 + 9.80665 * x[0])
    hit_ground = with_attributes(lambda t, y: y[0], terminal=True, direction=-1)
    res = solve_ivp(
        cannon, [0, np.inf], [0, 0.01], max_step=0.05 * 0.001 / 9.80665, events=hit_ground, dense_output=True
    )
    assert res.success
    assert res.status == 1
    assert res.t_events[0] == pytest.approx([0.00203943], rel=1e-5)
    assert res.y_events[0] == pytest.approx(np.array([[0.0, -0.01]]), abs=1e-9)
    with pytest.raises(lt.InputError, match="t must be from 0 to"):
        res.sol(0.01)


def test_max_step():
    res = solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL, max_step=0.5, dense_output=True)
    assert (res.t[0], res.t[-1], res.success) == (5, 9, True)
    assert np.all(np.diff(res.t) <= 0.5 + 1e-15)
    assert np.all(compute_error(res.y, sol_rational(res.t)) < 5)
    assert np.array_equal(res.sol(res.t), res.y)
    with pytest.raises(ValueError, match="must be positive"):
        solve_ivp(RATIONAL, [5, 9], AT_5, max_step=-1)
    tiny = solve_ivp(RATIONAL, [5, 9], AT_5, max_step=1e-20)
    assert not tiny.success
    assert "does not tell t + h from t" in tiny.message


def test_first_step():
    res = solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL, max_step=0.5, first_step=0.1)
    assert res.t[1] - 5 == pytest.approx(0.1)
    assert res.t[-1] == 9
    assert np.all(compute_error(res.y, sol_rational(res.t)) < 5)
    for first_step in (-1, 0, 5):
        with pytest.raises(ValueError, match="first_step must be positive and at most the length of t_span, 4, got"):
            solve_ivp(RATIONAL, [5, 9], AT_5, first_step=first_step)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "times", [np.linspace(5, 9, 10), [5, 5.01, 7, 8, 8.01, 9], [5.01, 7, 8, 8.01]], ids=["grid", "ends", "between"]
)
def test_t_eval(times):
    res = solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL, t_eval=times)
    assert np.array_equal(res.t, times)
    assert res.success
    assert res.status == 0
    assert np.all(compute_error(res.y, sol_rational(res.t)) < 5)
    dense = solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL, t_eval=times, dense_output=True)
    assert np.array_equal(dense.t, res.t)
    assert np.array_equal(dense.y, res.y)


def test_t_eval_outside():
    with pytest.raises(ValueError, match=r"t_eval must be times of t_span"):
        solve_ivp(RATIONAL, [5, 9], AT_5, t_eval=[4, 6])


def test_t_eval_early_event():
    end_event = with_attributes(lambda t, y: t - 7, terminal=True)
    res = solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL, t_eval=np.linspace(7.5, 9, 16), events=end_event)
    assert res.success
    assert res.status == 1
    assert res.message == "A termination event occurred."
    assert res.t.size == res.y.size == 0
    assert len(res.t_events) == 1
    assert res.t_events[0].tolist() == [7.0]


def test_no_integration():
    """test_no_integration and test_zero_interval: a span of length zero."""
    res = solve_ivp(OSCILLATOR, [4, 4], [2, 3], dense_output=True)
    assert res.success
    assert res.status == 0
    assert res.t.tolist() == [4.0, 4.0]
    assert res.sol(4).tolist() == [2.0, 3.0]
    assert res.y.tolist() == [[2.0, 2.0], [3.0, 3.0]]
    assert res.solution.audit().passed
    with pytest.raises(lt.InputError, match="t must be from 4 to 4"):  # SciPy extrapolates
        res.sol([4, 5, 6])
    theirs = scipy.integrate.solve_ivp(lambda t, y: [y[1], -y[0]], [4, 4], [2, 3])
    assert np.array_equal(theirs.t, res.t)
    assert np.array_equal(theirs.y, res.y)
    assert solve_ivp(OSCILLATOR, [4, 4], [2, 3], t_eval=[4]).t.tolist() == [4.0]
    stopped_run = solve_ivp(OSCILLATOR, [4, 4], [2, 3], events=with_attributes(lambda t, y: y[0] - 2, terminal=True))
    assert stopped_run.status == 1
    assert stopped_run.t_events[0].tolist() == [4.0]


def oscillator_and_logistic(omega, k):
    """test_args: x' = -omega y, y' = omega x, z' = k z (1 - z), the last from an entropy."""
    return lt.MetriplecticSystem(
        poisson=lambda x: jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
        energy=lambda x: 0.5 * omega * (x[0] ** 2 + x[1] ** 2),
        entropy=lambda x: k * (x[2] ** 2 / 2.0 - x[2] ** 3 / 3.0),
        dissipation=lt.FrictionOperator(lambda x: jnp.diag(jnp.array([0.0, 0.0, 1.0]))),
        dim=3,
    )


@pytest.mark.slow
def test_args():
    omega, k, t_final, z_final = 2.0, 4.0, 5.0, 0.99
    z0 = np.exp(-k * t_final) / ((1 - z_final) / z_final + np.exp(-k * t_final))
    events = [
        with_attributes(lambda t, w, *_: w[0], direction=-1),
        with_attributes(lambda t, w, *_: w[1], direction=1),
        with_attributes(lambda t, w, omega, k, z_final: w[2] - z_final, terminal=True),
    ]
    sol = solve_ivp(
        oscillator_and_logistic(omega, k),
        [0, 2 * t_final],
        [0, -1, z0],
        events=events,
        dense_output=True,
        args=(omega, k, z_final),
        rtol=1e-10,
        atol=1e-13,
    )
    assert sol.t_events[0] == pytest.approx([0.5 * np.pi, 1.5 * np.pi], rel=1e-7)
    assert sol.t_events[1] == pytest.approx([0.25 * np.pi, 1.25 * np.pi], rel=1e-7)
    assert sol.t_events[2] == pytest.approx([t_final], rel=1e-7)
    t = np.linspace(0, sol.t_events[2][0], 250)
    exact = [np.sin(omega * t), -np.cos(omega * t), 1 / (((1 - z0) / z0) * np.exp(-k * t) + 1)]
    assert np.allclose(sol.sol(t)[:2], exact[:2], rtol=1e-9, atol=1e-9)
    # z0 = 2e-7 beside 1: relative to z, which SciPy measures by itself, the first errors are larger
    assert np.allclose(sol.sol(t)[2], exact[2], rtol=1e-7, atol=1e-12)
    assert np.abs(sol.sol(sol.t_events[0])[0]).max() < 5e-14
    assert np.abs(sol.sol(sol.t_events[1])[1]).max() < 5e-14


def test_args_single_value():
    with pytest.raises(ValueError, match=r"Write args=\(-1,\)"):
        solve_ivp(OSCILLATOR, (0, 0.1), [1, 0], events=lambda t, y, a: y[0] - a, args=-1)


def test_array_rtol():
    """Arrays are accepted; a too small entry is raised with SciPy's warning; tighter ones improve the error."""
    system = canonical(lambda x: x[0] * x[1])
    exact = [np.e, 1 / np.e]

    def error(**tolerances):
        res = solve_ivp(system, (0, 1), [1.0, 1.0], lt.MetriplecticRungeKutta(4), **tolerances)
        assert res.success
        return np.abs(res.y[:, -1] - exact).max()

    loose = error(rtol=[1e-1, 1e-1], atol=[1e-3, 1e-3])
    assert loose == error(rtol=1e-1, atol=1e-3)
    with pytest.warns(UserWarning, match="At least one element"):
        assert error(rtol=[1e-1, 1e-16]) < loose
    assert error(rtol=[1e-1, 1e-6], atol=[1e-9, 1.0]) < loose
    for bad_tolerances in ({"atol": [1e-6] * 3}, {"rtol": [1e-3]}):
        with pytest.raises(ValueError, match=r"must be a number or an array of shape \(2,\), as y0"):
            error(**bad_tolerances)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_integration_zero_rhs(method):
    res = solve_ivp(canonical(lambda x: 0.5 * x[1] ** 2, 1), [0, 10], [1.0, 0.0], method)
    assert res.success
    assert res.status == 0
    assert np.abs(res.y - [[1.0], [0.0]]).max() < 1e-15


@pytest.mark.parametrize("fill", [np.nan, np.inf])
def test_initial_state_finiteness(fill):
    with pytest.raises(ValueError, match="finite"):
        solve_ivp(OSCILLATOR, [0, 10], np.full(2, fill))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_tbound_respected_small_interval(method):
    t_end = 1e-4
    system = canonical(lambda x, t: jnp.where(t > t_end, jnp.nan, 2.0) * x[0] * x[1])
    res = solve_ivp(system, (0.0, t_end), [1.0, 1.0], method)
    assert res.success
    assert res.y[:, -1] == pytest.approx(np.exp([2 * t_end, -2 * t_end]), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[:2], ids=str)
def test_tbound_respected_oscillator(method):
    """A constant field that is not known after t = 205, in steps as long as the span."""
    rates = np.array([1.73307544e-02, 6.49376470e-06, 0.0, 0.0])
    system = canonical(lambda x, t: jnp.where(t > 205.0, jnp.nan, 1.0) * (rates @ x[4:]), 4)
    start = np.array([134.08298555, 138.82348612, 100.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    res = solve_ivp(system, (100.0, 200.0), start, method, dense_output=True, max_step=100.0)
    assert res.success
    assert res.y[:4, -1] == pytest.approx(start[:4] + 100.0 * rates, rel=1e-14)


def test_event_dense_output():
    """test_event_dense_output_LSODA: y' = (t - 2) y, beside a momentum that stays zero; steps are up to 1 long."""
    system = canonical(lambda x, t: (t - 2.0) * x[0] * x[1])

    def exact(t):
        return np.exp(t**2 / 2 - 2 * t + np.log(0.05) - 6)

    res = solve_ivp(
        system,
        [-2, 2],
        [0.05, 0.0],
        events=lambda t, y: y[0] - 2.02e-5,
        dense_output=True,
        rtol=RTOL,
        atol=ATOL,
        first_step=1e-3,
        max_step=1,
    )
    assert res.success
    assert res.status == 0
    assert (res.t[0], res.t[-1]) == (-2, 2)
    assert res.t[1] + 2 == pytest.approx(1e-3)
    for times, states in ((res.t, res.y), (np.linspace(-2, 2), res.sol(np.linspace(-2, 2)))):
        assert np.all(np.abs(states[0] - exact(times)) / (ATOL + RTOL * exact(times)) < 5)
    assert len(res.t_events[0]) == 1
    assert np.array_equal(res.sol(res.t), res.y)


def test_initial_max_step():
    """test_inital_maxstep: the first step that is chosen is no longer than the longest allowed."""
    unlimited_run = solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL)
    max_step = 0.5 * (unlimited_run.t[1] - unlimited_run.t[0])
    assert solve_ivp(RATIONAL, [5, 9], AT_5, rtol=RTOL, atol=ATOL, max_step=max_step).t[1] - 5.0 == pytest.approx(
        max_step
    )


def test_an_endless_span_needs_an_end():
    """SciPy runs for ever."""
    with pytest.raises(lt.InputError, match=r"Set event\.terminal = True"):
        solve_ivp(OSCILLATOR, (0, np.inf), [1, 0], events=lambda t, y: y[0])
    with pytest.raises(lt.InputError, match=r"infinite end needs lt\.integrate with adaptive steps and an event"):
        lt.integrate(OSCILLATOR, [1.0, 0.0], (0.0, np.inf), 0.1)
    run = lt.integrate(OSCILLATOR, [1.0, 0.0], (0.0, np.inf), lt.Adaptive(1e-8), until=lambda x: x[0])
    assert run.event_time == pytest.approx(0.5 * np.pi, rel=1e-6)
    resting_run = solve_ivp(
        OSCILLATOR, (0, np.inf), [0, 0], events=with_attributes(lambda t, y: t - 1e3, terminal=True)
    )
    assert resting_run.t[-1] == pytest.approx(1e3)
