"""Events within steps: the first of several is found, and what is undone before the step ends is seen."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines import adaptive_steps
from liethermo.engines.root_bracket import combined_event_values_at_step_ends
from tests.cases import few_combinations
from tests.systems import oscillator, rigid_body

METHODS = [lt.MetriplecticGauss(3), lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(20)]


def two_levels(x):
    """Positive at first; of x = (cos t, -sin t) it changes its sign four times while cos t is below -0.8."""
    return (x[0] + 0.8) * (x[0] + 0.95)


def two_levels_and_one(x):
    """And once more, at t = 4.07."""
    return two_levels(x) * (0.8 - x[1])


FIRST_EVENT_TIME = np.arccos(-0.8)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["compiled", "array"])
@pytest.mark.parametrize("until", [two_levels, two_levels_and_one])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_first_of_several_in_a_step_is_found(method, until, engine):
    """An even and an odd number of them; the longest steps are of three radians."""
    arguments = (0.0, 8.0), lt.Adaptive(1e-9), method
    solution = lt.integrate(oscillator(), [1.0, 0.0], *arguments, until=until, engine=engine)
    assert solution.event_time == pytest.approx(FIRST_EVENT_TIME, abs=1e-7)
    assert abs(solution.x[-1, 0] + 0.8) < 4e-16, "to rounding"
    assert solution.audit().passed
    ensemble = lt.ensemble(oscillator(), [[1.0, 0.0], [0.5, 0.0]], *arguments, until=until, engine=engine)
    assert ensemble.event_time[0] == pytest.approx(solution.event_time, abs=1e-13)
    assert np.isnan(ensemble.event_time[1])


def test_control_without_looks_a_later_one_is_taken_for_the_first(monkeypatch):
    monkeypatch.setattr(adaptive_steps, "event_check_fractions", lambda order: np.zeros(0))
    method = lt.MetriplecticTaylor(19)  # which nothing has been compiled for
    arguments = (0.0, 8.0), lt.Adaptive(1e-9), method
    assert (
        lt.integrate(oscillator(), [1.0, 0.0], *arguments, until=two_levels_and_one).event_time > FIRST_EVENT_TIME + 0.1
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", [METHODS[1], METHODS[2]], ids=str)
def test_a_body_that_relaxes_for_a_moment_is_relaxed(method):
    """The entropy production falls below the limit, rises again within a step or two, and falls for good later."""
    x0s = np.random.default_rng(0).standard_normal((200, 3))
    x0s /= np.linalg.norm(x0s, axis=1)[:, None]
    arguments = rigid_body(), x0s, (0.0, 30.0)
    fine = lt.ensemble(*arguments, 0.005, lt.MetriplecticRungeKutta(8), until=lt.Relaxed(1e-6))
    long = lt.ensemble(*arguments, lt.Adaptive(1e-8), method, until=lt.Relaxed(1e-6))
    assert np.isfinite(fine.event_time).sum() > 50
    assert np.array_equal(np.isfinite(long.event_time), np.isfinite(fine.event_time))
    assert np.nanmax(np.abs(long.event_time - fine.event_time)) < 1e-3
    ends = lt.ensemble(*arguments, 1.0, lt.MetriplecticRungeKutta(8), until=lt.Relaxed(1e-6))
    is_late = ends.event_time > fine.event_time + 0.1
    assert is_late.any(), "steps of given size are looked at where they end, and miss some"


# -- an event is a zero, or there is none -----------------------------------------------------------------------------

ENGINES = ["compiled", pytest.param("array", marks=pytest.mark.slow)]
HALF = np.arccos(0.5)


def hole(w):
    """Zero in the middle of where it is not a number; -w where it is one again."""
    return lambda x: jnp.where(jnp.abs(x[0] - 0.5) < w, jnp.nan, x[0] - 0.5)


def run_until(until, step, engine="compiled", order=8, noise_size=1e-13):
    """Alone, and in an ensemble, whose program may round otherwise: by ``noise_size``, in the time."""
    arguments = (0.0, 3.0), step, lt.MetriplecticRungeKutta(order)
    solution = lt.integrate(oscillator(), [1.0, 0.0], *arguments, until=until, engine=engine, on_failure="return")
    ensemble = lt.ensemble(oscillator(), [[1.0, 0.0], [1.0, 0.0]], *arguments, until=until, engine=engine)
    assert [solution.status.code] * 2 == [status.code for status in map(ensemble.member_status, range(2))]
    times = np.nan if solution.event_time is None else solution.event_time
    assert ensemble.event_time == pytest.approx([times] * 2, abs=noise_size, nan_ok=True)
    return solution


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("step", [lt.Adaptive(1e-8), 0.1])
@pytest.mark.parametrize("order", [4, 6, 8])
def test_the_edge_of_a_hole_is_no_event(order, engine, step):
    """The run says that a zero in the hole is neither found nor excluded: for holes of every size, on any processor."""
    for w in (1e-3, 0.01, 0.02, 0.05, 0.1, 0.3):
        solution = run_until(hole(w), step, engine, order)
        assert (solution.status.code, solution.event_time) == ("non_finite", None), w
        assert "the event function is NaN near" in solution.status.message
        assert solution.t[-1] == pytest.approx(HALF, abs=0.11 + 2 * w)


JUMPS = {
    "a step": lambda x: jnp.where(x[0] > 0.5, 1.0, -1.0),
    "hardly a step down": lambda x: jnp.where(2.0 * x[0] > 1.0, 1.0, -1e-6),
    "a pole": lambda x: 1.0 / (x[0] - 0.5),
    "a pole in other units": lambda x: 1e-20 / (x[0] - 0.5),
    "an angle": lambda x: jnp.arctan2(x[0] - 0.5, x[1]),
}


@pytest.mark.sampled("a pole-compiled-0.1")
@few_combinations(name=JUMPS, engine=["compiled", "array"], step=[0.1, lt.Adaptive(1e-8)])
def test_a_jump_is_no_event_and_the_run_goes_on(name, engine, step):
    solution = run_until(JUMPS[name], step, engine)
    assert (solution.status.code, solution.event_time, solution.t[-1]) == ("completed", None, 3.0)
    assert "changed its sign 1 times without being zero, first at t = 1.0472" in solution.status.message
    assert solution.audit().passed
    assert solution.x[-1] == pytest.approx([np.cos(3.0), -np.sin(3.0)], abs=1e-6)


ZEROS = {
    "after a pole": (lambda x: jnp.tan(3.0 * (x[0] - 0.5) + jnp.pi / 2), np.arccos(0.5 - np.pi / 6)),
    "of infinite slope": (lambda x: jnp.cbrt(x[0] - 0.5), HALF),
    "of no slope": (lambda x: (x[0] - 0.5) ** 3, HALF),
    "among large terms": (lambda x: (x[0] + 1e6) - (1e6 + 0.3), np.arccos(0.3)),
    "of a small function": (lambda x: 1e-20 * (x[0] - 0.5), HALF),
    "of a large function": (lambda x: 1e20 * (x[0] - 0.5), HALF),
    "after a hole": (lambda x: jnp.where(jnp.abs(x[0] - 0.7) < 0.05, jnp.nan, x[0] - 0.5), HALF),
    "next to a jump": (lambda x: jnp.where(x[0] > 0.5, 1.0, x[0] - 0.49), np.arccos(0.49)),
}


@pytest.mark.sampled(1)
@few_combinations(name=ZEROS, engine=["compiled", "array"], step=[0.1, lt.Adaptive(1e-8)])
def test_a_zero_is_an_event_however_it_is_rounded(name, engine, step):
    until, exact = ZEROS[name]
    solution = run_until(until, step, engine, noise_size=3e-10 if name == "among large terms" else 1e-13)  # that of 1e6
    assert solution.event_time == pytest.approx(exact, abs=1e-6 if name != "of no slope" else 1e-4)
    assert solution.audit().passed


def test_a_function_that_is_nan_at_the_end_of_a_step_is_no_event_beside_one():
    """In the step from 0.9 to 1.2 the first function is zero at pi / 3, and the second becomes NaN after it."""
    functions = [lambda x: x[0] - 0.5, lambda x: jnp.sqrt(x[0] - 0.45)]
    for until in (functions, functions[::-1]):
        solution = lt.integrate(oscillator(), [1.0, 0.0], (0.0, 3.0), 0.3, lt.MetriplecticGauss(4), until=until)
        assert solution.event_time == pytest.approx(np.pi / 3, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-20, 1.0, 1e20])
def test_jumps_and_zeros_of_a_body_with_an_attitude_in_any_unit(unit):
    """The attitude has none: its rounding is not that of the momenta."""
    inertia = np.array([3.0, 2.0, 1.0]) * unit
    body = lt.LiePoissonSystem(mf.so(3), lambda p: 0.5 * jnp.sum(p * p / inertia), group=mf.SO(3))
    arguments = body, np.array([0.1, 0.9, 0.3]) * unit, (0.0, 6.0), lt.Adaptive(1e-8), lt.MetriplecticRungeKutta(8)
    jump = lt.integrate(*arguments, until=lambda x: jnp.where(x[0] > 0.3 * unit, unit, -1e-3 * unit))
    zero = lt.integrate(*arguments, until=lambda x: x[0] - 0.3 * unit)
    assert (jump.event_time, zero.event_time) == (None, pytest.approx(1.44063018, abs=1e-7))


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
    solution = lt.integrate(body, x0, *arguments, until=lambda x: x[1] - level)
    assert solution.event_time == pytest.approx(rises, abs=1.5e-3)
    assert abs(solution.x[-1, 1] - level) < 1e-13
    ensemble = lt.ensemble(body, np.tile(x0, (3, 1)), *arguments, until=lambda x: x[1] - level)
    assert np.abs(ensemble.event_time - solution.event_time).max() < 1e-12


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), METHODS[1]], ids=["gauss", "rk8"])
@pytest.mark.parametrize("engine", ["compiled", "array"])
@pytest.mark.parametrize("step", [pytest.param(0.1, id="fixed"), pytest.param(lt.Adaptive(1e-9), id="adaptive")])
def test_a_body_whose_energy_falls_is_relaxed_where_it_falls_no_more(step, engine, method):
    """To rounding, in runs and ensembles, in any unit; the fall is that of the formula ``rate |mu x xi|^2``."""
    inertia, rate, tol, start = np.array([3.2, 3.0, 1.0]), 0.2, 1e-7, np.array([[1.0, 0.3, 0.5], [0.2, 0.3, 0.9]])

    def fall(mu, scale=1.0):
        return rate / scale * np.sum(np.cross(mu, mu / (scale * inertia)) ** 2, axis=-1)

    times = []
    for scale in (1.0, 1e20):
        H = lt.Quadratic(1.0 / (scale * inertia))
        body = lt.LiePoissonSystem(mf.so(3), H, dissipation=lt.DoubleBracket(rate / scale))
        until = lt.Relaxed(scale * tol)
        run = lt.integrate(body, scale * start[0], (0.0, 1e3), step, method, until=until, engine=engine)
        assert run.status.code == "event"
        assert "fall of the energy below" in run.status.message
        assert abs(fall(run.x[-1], scale) / (scale * tol) - 1.0) < 1e-9
        ensemble = lt.ensemble(body, scale * start, (0.0, 1e3), step, method, until=until, engine=engine)
        assert np.abs(fall(ensemble.x, scale) / (scale * tol) - 1.0).max() < 1e-9
        assert abs(ensemble.event_time[0] - run.event_time) < 1e-9
        times.append(run.event_time)
    assert abs(times[1] - times[0]) < 1e-6
    assert np.allclose(body.energy_fall(scale * start), fall(scale * start, scale), rtol=1e-13)


def rubbing(point):
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic([0.3, 0.5, 1.0]), dissipation=lt.DoubleBracket(point["rate"]))


@pytest.mark.slow
def test_a_study_of_bodies_whose_energy_falls():
    """The time is inverse to the rate, but for where the motion has turned the body."""
    study = lt.Study(
        rubbing, {"rate": [0.1, 0.2]}, x0=[1.0, 0.3, 0.5], t_span=(0.0, 1e3), step=0.1, method=METHODS[1],
        measure={"relaxed": lt.Relaxed(1e-6)},
    )  # fmt: skip
    study.run()
    slow_body, fast_body = study.results.relaxed.values
    assert 0.3 * slow_body < fast_body < 0.7 * slow_body < 700.0


def test_what_does_not_relax_has_no_relaxed_state():
    free = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([0.3, 0.5, 1.0]))
    with pytest.raises(lt.InputError, match="produces entropy or loses energy"):
        lt.integrate(free, [1.0, 0.3, 0.5], (0.0, 1.0), 0.1, until=lt.Relaxed(1e-8))


# -- several events, of the time, the attitude and the parameters -----------------------------------------------------


def with_attributes(function, **attributes):
    vars(function).update(attributes)
    return function


def level(t, x):
    return x[0] - 0.5


def sine(t, x):
    return 1e3 * np.sin(t) + 0.0 * x[1]


def velocity(x):
    return x[1]


TURN = 2.0 * np.pi


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
@pytest.mark.parametrize("step", [lt.Adaptive(1e-10), 0.1], ids=str)
def test_several_events_beside_their_exact_times(step, engine):
    """Terminal ones and others, with directions and counts, alone and in an ensemble whose members turn alike."""
    events = [
        with_attributes(lambda t, x: level(t, x), terminal=False),
        with_attributes(lambda t, x: sine(t, x), terminal=2, direction=1),
        with_attributes(lambda x: velocity(x) - 0.1, terminal=False, direction=-1),
    ]
    exact = [
        [np.arccos(0.5), TURN - np.arccos(0.5), TURN + np.arccos(0.5), 2 * TURN - np.arccos(0.5)],
        [TURN, 2 * TURN],
        [TURN - np.arcsin(0.1), 2 * TURN - np.arcsin(0.1)],
    ]
    arguments = (0.0, 20.0), step, lt.MetriplecticRungeKutta(8)
    solution = lt.integrate(oscillator(), [1.0, 0.0], *arguments, until=events, engine=engine)
    assert solution.event_time == solution.t[-1] == solution.events[1].t[-1]
    assert solution.audit().passed
    for series, times in zip(solution.events, exact, strict=True):
        assert series.t == pytest.approx(times, abs=1e-8)
        assert np.abs(np.linalg.norm(series.x, axis=1) - 1.0).max() < 1e-15
    assert np.abs(solution.events[0].x[:, 0] - 0.5).max() < 2e-16
    x0s = [[np.cos(a), -np.sin(a)] for a in (0.0, 0.0, 0.3)]
    many = lt.ensemble(oscillator(), x0s, *arguments, until=events, engine=engine)
    assert many.event_time == pytest.approx([2 * TURN] * 3, abs=1e-8)
    for k, series in enumerate(many.events):
        assert series.t[series.trajectory == 1] == pytest.approx(solution.events[k].t, abs=1e-12)
    assert many[2].events[0].t == pytest.approx(np.array(exact[0]) - 0.3, abs=1e-8)
    assert many[2].events.times[1] == pytest.approx(exact[1], abs=1e-8)


def test_events_without_end_leave_the_saved_states_of_fixed_steps():
    """The run goes on to the times of its steps, and saves every fifth of them."""
    event = with_attributes(lambda x: x[0] - 0.3, terminal=False)
    arguments = oscillator(), [1.0, 0.0], (0.0, 10.05), 0.1, lt.MetriplecticGauss(3)
    plain = lt.integrate(*arguments, save_every=5)
    solution = lt.integrate(*arguments, save_every=5, until=event)
    assert np.array_equal(plain.t, solution.t)
    assert np.abs(plain.x - solution.x).max() < 1e-9
    assert len(solution.events[0].t) == 3
    assert solution.stats.steps == plain.stats.steps + 3
    assert solution.audit().passed


def test_simultaneous_events_and_events_in_any_order():
    """Two functions with one zero, in units that differ; the order of the functions decides nothing."""
    first = with_attributes(lambda t, x: t - 1.25, terminal=False)
    second = with_attributes(lambda x: 1e-12 * (x[0] - np.cos(1.25)), terminal=False)
    third = with_attributes(lambda x: 1e12 * (x[0] - np.cos(1.2499999)), terminal=False)
    arguments = oscillator(), [1.0, 0.0], (0.0, 3.0), lt.Adaptive(1e-12), lt.MetriplecticRungeKutta(8)
    for order in ([first, second, third], [third, second, first]):
        times = {events.name: events.t for events in lt.integrate(*arguments, until=order).events}
        assert sorted(len(t) for t in times.values()) == [1, 1, 1]
        assert sorted(t[0] for t in times.values()) == pytest.approx([1.2499999, 1.25, 1.25], abs=1e-10)


RIGID = lt.LiePoissonSystem(
    mf.so(3),
    lambda p: 0.5 * jnp.sum(p * p / jnp.array([3.0, 2.0, 1.0])),
    lambda p: 0.5 * p @ p,
    lt.KillingDissipation(0.1),
    group=mf.SO(3),
)


def test_events_of_attitude_parameters_and_system():
    arguments = [0.5, 0.9, 1.0], (0.0, 20.0), lt.Adaptive(1e-10), lt.MetriplecticRungeKutta(4)
    run = lt.integrate(RIGID, *arguments, until=lambda x, attitude: attitude[2, 2] - 0.3)
    assert run.attitude[-1, 2, 2] == pytest.approx(0.3, abs=1e-15)
    rates = np.array([0.1, 0.2, 0.3])
    threshold = lambda x, parameters: x[0] - parameters["dissipation.rate"]  # noqa: E731
    many = lt.ensemble(RIGID, *arguments, parameters={"dissipation.rate": rates}, until=threshold)
    is_event = np.isfinite(many.event_time)
    assert is_event.any()
    assert many.x[is_event, 0] == pytest.approx(rates[is_event], abs=1e-15)
    alone = lt.integrate(RIGID, *arguments, until=threshold)
    assert alone.event_time == pytest.approx(many.event_time[0], abs=1e-12)
    level_of_entropy = lt.integrate(RIGID, *arguments, until=lambda x, system: system.entropy(x) - 1.2)
    assert level_of_entropy.entropy[-1] == pytest.approx(1.2, abs=1e-14)
    with pytest.raises(lt.InputError, match="asks for the attitude, and this system has none"):
        lt.integrate(oscillator(), [1.0, 0.0], (0.0, 1.0), 0.1, until=lambda x, attitude: x[0])


@pytest.mark.slow
def test_functions_of_numpy_and_of_python():
    """The functions that jax.numpy has are traced; others are called by the array engine, in runs and in ensembles."""

    def python_event(t, x):
        return math.sin(t) - 0.5 if t > 0.1 else -1.0

    numpy_event = lambda t, x: np.linalg.norm(x) * np.sin(t) - np.minimum(0.5, 1.0)  # noqa: E731
    for step in (lt.Adaptive(1e-9), 0.1):
        arguments = (0.0, 3.0), step, lt.MetriplecticRungeKutta(8)
        for event, engine in ((numpy_event, "compiled"), (python_event, "array")):
            run = lt.integrate(oscillator(), [1.0, 0.0], *arguments, until=event)
            assert run.provenance["engine"] == engine
            assert run.event_time == pytest.approx(np.pi / 6, abs=1e-13)
            many = lt.ensemble(oscillator(), [[1.0, 0.0], [0.0, 1.0]], *arguments, until=event)
            assert many.engine == engine
            assert many.event_time == pytest.approx([np.pi / 6] * 2, abs=1e-13)


def test_an_exception_of_an_event_function_is_the_users_own():
    def fails_later(t, x):
        if t > 1.0:
            raise KeyError("no such table")
        return -1.0

    for call in (lt.integrate, lt.ensemble):
        with pytest.raises(KeyError, match="no such table"):
            call(oscillator(), [1.0, 0.0], (0.0, 3.0), 0.1, until=fails_later)


@pytest.mark.parametrize(
    ("until", "message"),
    [
        ([], "at least one event"),
        ([lambda a, b, c: 0.0], r"must have the arguments \(x\) or \(t, x\)"),
        ([lambda x: x[0], 3.0], r"lt\.Relaxed\(tol\) or a function"),
        (with_attributes(lambda x: x[0], terminal=-1), "terminal must be True or the number"),
    ],
)
def test_events_that_cannot_be_used(until, message):
    with pytest.raises(lt.InputError, match=message):
        lt.integrate(oscillator(), [1.0, 0.0], (0.0, 1.0), 0.1, until=until)


def test_files_have_the_events(tmp_path):
    event = with_attributes(lambda x: x[0], terminal=2)
    arguments = (0.0, 9.0), 0.1, lt.MetriplecticRungeKutta(8)
    run = lt.integrate(oscillator(), [1.0, 0.0], *arguments, until=[event])
    many = lt.ensemble(oscillator(), [[1.0, 0.0], [2.0, 0.0]], *arguments, until=event)
    for result in (run, many):
        (series,), (loaded,) = result.events, lt.load(result.save(tmp_path / "run.nc")).events
        assert loaded.name == series.name
        for values, loaded_values in zip(series[1:], loaded[1:], strict=True):
            assert np.array_equal(values, loaded_values)
            assert len(values) in (2, 4)
    assert lt.load(lt.integrate(oscillator(), [1.0, 0.0], (0.0, 1.0), 0.1).save(tmp_path / "plain.nc")).events == ()


def test_event_functions_that_are_nan_at_the_end_of_a_step_have_no_event_in_it():
    start, end = combined_event_values_at_step_ends((0, 0), jnp.array([1.0, 2.0]), jnp.array([jnp.nan, -1.0]))
    assert (float(start), float(end)) == (1.0, -0.5)  # the second function, divided by its value at the start
    assert (
        float(combined_event_values_at_step_ends((0, 0), jnp.array([1.0, 2.0]), jnp.array([jnp.nan, 0.5]))[1]) == 0.25
    )
