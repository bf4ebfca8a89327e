"""Fits of named parameters: to tables of sensors, with observations that depend on the parameters."""

from __future__ import annotations

import warnings

import jax.numpy as jnp
import numpy as np
import pandas
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats

import liethermo as lt
import manifolds as mf
from liethermo.learn.data import parse_trajectories
from liethermo.learn.observation import make_observation

from . import sensors

GUESS = {"I1/I2": 0.3, "I3/I2": 1.2}
RATIOS = sensors.INERTIA[[0, 2]]


def book(p):
    return lt.models.free_rigid_body((p["I1/I2"], 1.0, p["I3/I2"]))


def gyroscope(x, p):
    """The angular velocities of a body with the momenta x, whose inertias are unknown."""
    return {"gx": x[0] / p["I1/I2"], "gy": x[1], "gz": x[2] / p["I3/I2"]}


HOW = {"parameters": GUESS, "positive": True, "observe": gyroscope}
SHORT_MOTION = {"end": 1.2, "number": 60}
"""A motion with one turn over."""


def errors_of(training, expected):
    return (training.values - expected) / training.standard_errors


@pytest.mark.slow
def test_inertias_of_a_thrown_book_are_found_from_its_file(tmp_path):
    """From angular velocities alone, in deg/s at irregular times in ms; and they are those of SciPy."""
    table = sensors.thrown_book(1, **SHORT_MOTION)
    path = sensors.write_csv(tmp_path / "throw.csv", table)
    result = lt.learn.fit(book, path, **HOW).training
    assert result.converged
    assert result.names == ("I1/I2", "I3/I2")
    assert (result.rank, result.parameters) == (2, 2)
    assert np.abs(errors_of(result, RATIOS)).max() < 3.0
    assert result.residual == pytest.approx(1.0, abs=0.3)
    np.testing.assert_allclose(result.noise, np.radians(sensors.GYROSCOPE_NOISE), rtol=0.3)
    values, errors = scipy_fit(table, result.noise)
    np.testing.assert_allclose(result.values, values, atol=0.02 * errors.min())
    np.testing.assert_allclose(result.standard_errors, errors, rtol=0.03)


def scipy_fit(table, noise):
    """The ratios and their standard errors by SciPy alone, over the ratios and the first angular velocity."""
    t, *omega = (np.asarray(values) for values in table.values())
    t, omega = t / 1e3, np.radians(np.stack(omega, axis=1))

    def weighted_residuals(v):
        a, c = v[:2]
        field = lambda t, w: [  # noqa: E731
            (1.0 - c) / a * w[1] * w[2],
            (c - a) * w[2] * w[0],
            (a - 1.0) / c * w[0] * w[1],
        ]
        run = scipy.integrate.solve_ivp(field, t[[0, -1]], v[2:], "DOP853", t, rtol=1e-9, atol=1e-10)
        return ((run.y.T - omega) / noise).ravel()

    result = scipy.optimize.least_squares(weighted_residuals, np.concatenate([RATIOS, omega[0]]), x_scale="jac")
    variance = 2.0 * result.cost / (result.fun.size - result.x.size)
    return result.x[:2], np.sqrt(np.diag(np.linalg.inv(result.jac.T @ result.jac))[:2] * variance)


def coverage(seeds, motion):
    """Return which intervals of 95 % contain the true ratios, and the errors in standard errors."""
    contains, errors = [], []
    for seed in seeds:
        result = lt.learn.fit(book, sensors.thrown_book(seed, **motion), **HOW).training
        assert result.converged
        low, high = result.confidence_interval()
        contains.append((low < RATIOS) & (high > RATIOS))
        errors.append(errors_of(result, RATIOS))
    return np.array(contains), np.array(errors)


@pytest.mark.slow
def test_intervals_of_three_throws_contain_the_ratios():
    contains, errors = coverage(range(3), SHORT_MOTION)
    assert contains.sum(axis=0).min() >= 2
    assert np.abs(errors).max() < 3.0


@pytest.mark.slow
def test_intervals_contain_the_ratios_as_often_as_they_say():
    contains, errors = coverage(range(20), {})
    assert (contains.sum(axis=0) >= 17).all()
    assert 0.7 < np.sqrt(np.mean(errors**2)) < 1.35


def pendulum(p):
    inertia = sensors.MASS * sensors.LENGTH**2
    weight = sensors.MASS * sensors.GRAVITY * sensors.LENGTH
    return lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x: x[1] ** 2 / (2 * inertia) - weight * jnp.cos(x[0]),
        dissipation=lt.Friction([0.0, p["damping"]]),
        baths=lt.HeatBaths(p["capacity"], sensors.ROOM_TEMPERATURE),
    )


def angle_and_temperature(x, p):
    return {"angle": x[0], "temperature": sensors.ROOM_TEMPERATURE * jnp.exp(x[2] / p["capacity"])}


PENDULUM = {"parameters": {"damping": 0.01, "capacity": 1.0}, "positive": True, "observe": angle_and_temperature}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_damping_and_capacity_of_a_pendulum_are_found(seed):
    """From angles, and temperatures of which nine of ten are missing; friction heats the brake."""
    result = lt.learn.fit(pendulum, sensors.warm_pendulum(seed), **PENDULUM).training
    assert result.converged
    assert np.abs(errors_of(result, [sensors.DAMPING, sensors.CAPACITY])).max() < 3.0
    assert (result.standard_errors / result.values < [0.005, 0.05]).all()
    np.testing.assert_allclose(result.noise, [np.radians(0.3), 0.01], rtol=0.4)


def spring(p):
    return lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x: x[1] ** 2 / 2 + p["stiffness"] * x[0] ** 2 / 2,
        dissipation=lt.Friction([0.0, p["drag"]]),
        baths=lt.HeatBaths(1.0, 1.0),
    )


TIMES = np.linspace(0.0, 4.0, 41)
TRUE_SPRING = {"stiffness": 2.0, "drag": 0.3}
SPRING_GUESS = {"stiffness": 1.5, "drag": 0.1}


def spring_record(start=(1.0, 0.0)):
    """Positions of the damped spring in closed form."""
    decay, frequency = 0.15, np.sqrt(2.0 - 0.15**2)
    q, p = start
    return np.exp(-decay * TIMES) * (
        q * np.cos(frequency * TIMES) + (p + decay * q) / frequency * np.sin(frequency * TIMES)
    )


def fit_spring(data, **how):
    return lt.learn.fit(spring, data, **{"parameters": SPRING_GUESS, "positive": True, "observe": position, **how})


def position(x):
    return x[0]


def test_an_observation_may_depend_on_the_time():
    """A sensor drifts by an unknown rate, and starts at an unknown offset."""
    data = TIMES, spring_record() + 0.5 + 0.2 * TIMES
    guess = SPRING_GUESS | {"offset": 0.0, "drift": 0.0}
    observe = lambda t, x, p: x[0] + p["offset"] + p["drift"] * t  # noqa: E731
    fitted_system = fit_spring(data, parameters=guess, positive=["stiffness", "drag"], observe=observe)
    np.testing.assert_allclose(fitted_system.training.values, [2.0, 0.3, 0.5, 0.2], rtol=1e-4)


def records_with_missing_positions():
    positions = np.stack([spring_record(), spring_record((0.0, 1.0))])
    positions[0, 5:9], positions[1, ::3] = np.nan, np.nan
    return positions


@pytest.mark.slow
def test_missing_values_have_no_effect():
    fitted_system = fit_spring([(TIMES, x) for x in records_with_missing_positions()], substeps=2)
    np.testing.assert_allclose(fitted_system.training.values, [2.0, 0.3], rtol=1e-4)


@pytest.mark.slow
def test_control_zeros_in_place_of_missing_values_have_an_effect():
    positions = np.nan_to_num(records_with_missing_positions())
    result, text = problems_of([(TIMES, x) for x in positions], noise=1e-3)
    assert "times the noise" in text
    assert np.abs(result.values - [2.0, 0.3]).max() > 1e-2


@pytest.mark.slow
def test_descents_leave_missing_values_out():
    """The losses of the matching and the shooting are finite, and the least squares end at the numbers."""
    start = [1.0, 0.0, 0.0]
    states = lt.integrate(spring(TRUE_SPRING), start, (0.0, 4.0), 0.1, lt.MetriplecticRungeKutta(6)).x.copy()
    states[::4, 0], states[1::7, 2] = np.nan, np.nan
    how = {"matching": 50, "shooting": 20, "noise": 1e-3, "validation": 0, "observe": None}
    result = fit_spring((TIMES, states), **how).training
    assert np.isfinite(result.loss).all()
    np.testing.assert_allclose(result.values, [2.0, 0.3], rtol=1e-3)


@pytest.mark.slow
def test_trajectories_may_be_held_out():
    random = np.random.default_rng(0)
    records = [spring_record(start) for start in ((1.0, 0.0), (0.0, 1.0), (-0.7, 0.5))]
    data = [(TIMES, x + 0.01 * random.standard_normal(len(TIMES))) for x in records]
    result = fit_spring(data, validation=0.34, noise=0.01, substeps=1).training
    assert result.held_out == pytest.approx(1.0, abs=0.4)
    assert result.initial_states.shape == (2, 3)


def test_parameters_of_a_system_have_their_names():
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    run = lt.integrate(body, [0.5, 1.0, 0.7], (0.0, 4.0), 0.1, method=lt.MetriplecticGauss(3))
    guess = lt.models.rigid_body((2.5, 2.2, 1.2), rate=0.5)
    fitted_system = lt.learn.fit(guess, run, parameters=["energy.inertia", "dissipation.rate"], positive=True)
    assert fitted_system.training.names == (*(f"energy.inertia[{i}]" for i in range(3)), "dissipation.rate")
    np.testing.assert_allclose(fitted_system.energy.A, [1 / 3, 1 / 2, 1.0], rtol=1e-5)
    assert float(fitted_system.dissipation.rate) == pytest.approx(0.1, rel=1e-4)
    ratio, error = fitted_system.training.estimate(lambda v: v[0] / v[2])
    assert ratio == pytest.approx(3.0, rel=1e-5)
    assert 0.0 <= error < 1e-3
    assert fitted_system.check().passed
    np.testing.assert_allclose(fitted_system.training.initial_states, [[0.5, 1.0, 0.7]], rtol=1e-6)


def test_a_scale_that_no_angular_velocity_shows_is_called_so():
    """The motion of a free body depends on the ratios of its inertias only."""
    guess = {"inertia": np.array([0.3, 1.0, 1.2])}
    with pytest.warns(lt.learn.FitWarning, match=r"the data do not determine inertia\[0\] = .* ± inf"):
        fitted_system = lt.learn.fit(
            lambda p: lt.models.free_rigid_body(p["inertia"]),
            sensors.thrown_book(1, **SHORT_MOTION),
            parameters=guess,
            positive=True,
            observe=lambda x, p: dict(zip(("gx", "gy", "gz"), x / p["inertia"], strict=True)),
        )
    assert (fitted_system.training.rank, fitted_system.training.parameters) == (2, 3)
    assert np.isinf(fitted_system.training.confidence_interval().high).all()


@pytest.mark.slow
def test_intervals_are_those_of_students_distribution():
    positions = spring_record() + 0.01 * np.random.default_rng(0).standard_normal(len(TIMES))
    unbounded_fit = fit_spring((TIMES, positions), positive=None, noise=0.01).training
    with pytest.raises(lt.InputError, match="confidence_level must be between 0 and 1, got 95"):
        unbounded_fit.confidence_interval(95)
    low, high = unbounded_fit.confidence_interval(0.9)
    quantile = scipy.stats.t.ppf(0.95, unbounded_fit.degrees_of_freedom)
    assert (
        unbounded_fit.degrees_of_freedom == len(TIMES) - 4
    )  # two parameters, position and momentum; the entropy is not seen
    np.testing.assert_allclose(high - unbounded_fit.values, quantile * unbounded_fit.standard_errors, rtol=1e-12)
    np.testing.assert_allclose(unbounded_fit.values - low, quantile * unbounded_fit.standard_errors, rtol=1e-12)
    positive_fit = fit_spring((TIMES, positions), noise=0.01).training
    np.testing.assert_allclose(positive_fit.standard_errors, unbounded_fit.standard_errors, rtol=2e-2)
    low, high = positive_fit.confidence_interval(0.9)
    np.testing.assert_allclose(low * high, positive_fit.values**2, rtol=1e-12)  # symmetric in the logarithm


@pytest.mark.slow
def test_a_frame_and_its_arrays_give_one_fit():
    """Columns are found by the names in the observation, whatever their order; others are left out."""
    table = sensors.thrown_book(2, **SHORT_MOTION)
    frame = pandas.DataFrame(table)[[*reversed(table)]].assign(battery=1.0)
    arrays = np.stack([np.radians(table[f"g{axis} [deg/s]"]) for axis in "xyz"], axis=1)
    name_fit = lt.learn.fit(book, frame, substeps=1, **HOW).training
    order_fit = lt.learn.fit(book, (table["time [ms]"] / 1e3, arrays), substeps=1, **HOW).training
    np.testing.assert_allclose(name_fit.values, order_fit.values, rtol=1e-9)


@pytest.mark.slow
def test_an_observation_may_depend_on_the_attitude_and_a_parameter():
    """A camera that is mounted at an unknown distance sees two marks on a body of unknown inertias."""
    marks, inertia = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).T, (1.0, 2.0, 2.5)
    body = lt.models.free_rigid_body(inertia, attitude=True)
    run = lt.integrate(body, [0.4, 1.0, 0.6], (0.0, 2.0), 0.1, method=lt.MetriplecticGauss(3))
    fitted_system = lt.learn.fit(
        lambda p: lt.models.free_rigid_body((1.0, p["b"], p["c"]), attitude=True),
        (run.t, 0.7 * run.attitude @ marks),
        parameters={"b": 1.9, "c": 2.4, "scale": 0.6},
        positive=True,
        observe=lambda x, R, p: p["scale"] * R @ marks,
        substeps=1,
    )
    np.testing.assert_allclose(fitted_system.training.values, [2.0, 2.5, 0.7], rtol=1e-3)


def test_a_solution_is_not_observed_with_the_guess_of_the_parameters():
    """By the guess, the angular velocity of a run would be a wrong one; as numbers it determines the inertias."""
    inertia, scale = np.array([0.3, 1.0, 1.2]), lambda p: jnp.stack([p["a"], 1.0, p["c"]])
    run = lt.integrate(
        lt.models.free_rigid_body(inertia), inertia * [0.3, 8.0, 0.2], (0.0, 2.0), 0.02, lt.MetriplecticGauss(3)
    )
    body = lambda p: lt.models.free_rigid_body((p["a"], 1.0, p["c"]))  # noqa: E731
    how = {"parameters": {"a": 0.5, "c": 1.3}, "positive": True}
    for data in (run, [run, run]):
        with pytest.raises(lt.InputError, match="cannot be observed before they are known"):
            lt.learn.fit(body, data, observe=lambda x, p: x / scale(p), **how)
    fitted_system = lt.learn.fit(body, (run.t, run.x / inertia), observe=lambda x, p: x / scale(p), **how)
    np.testing.assert_allclose(fitted_system.training.values, [0.3, 1.2], rtol=1e-6)


BAD = {
    "no parameters": (lambda: lt.learn.fit(spring, (TIMES, spring_record())), "needs parameters="),
    "no dict": (
        lambda: fit_spring((TIMES, spring_record()), parameters=["drag"]),
        "a dict from names to initial values",
    ),
    "empty": (lambda: fit_spring((TIMES, spring_record()), parameters={}), "parameters is empty"),
    "text": (lambda: fit_spring((TIMES, spring_record()), parameters={"drag": "low"}), "'drag' must be a number"),
    "not finite": (lambda: fit_spring((TIMES, spring_record()), parameters={"drag": np.nan}), "must be finite"),
    "missing": (
        lambda: fit_spring((TIMES, spring_record()), parameters={"drag": 0.1}),
        "needs the parameter 'stiffness'",
    ),
    "unknown positive": (
        lambda: fit_spring((TIMES, spring_record()), positive="mass"),
        "'mass', but the parameters of the fit are stiffness, drag",
    ),
    "not positive": (
        lambda: fit_spring((TIMES, spring_record()), parameters=SPRING_GUESS | {"drag": 0.0}),
        "the parameter 'drag' must stay positive, but its initial value is 0",
    ),
    "unknown name": (
        lambda: lt.learn.fit(lt.models.rigid_body(), (TIMES, np.ones((41, 3))), parameters=["energy.moments"]),
        "no parameter 'energy.moments'; its parameters are energy.inertia,",
    ),
    "wrong shape": (
        lambda: lt.learn.fit(lt.models.rigid_body(), (TIMES, np.ones((41, 3))), parameters={"energy.inertia": 1.0}),
        "energy.inertia must have shape (3,), got ()",
    ),
    "no system": (lambda: fit_spring_with(lambda p: p), "must return a system, got dict"),
    "no parameter of observe": (
        lambda: fit_spring((TIMES, spring_record()), observe=lambda x, p: x[0] + p["offset"]),
        "observe uses the parameter 'offset', but the parameters are stiffness, drag",
    ),
    "arguments in another order": (
        lambda: fit_spring((TIMES, spring_record()), observe=lambda p, x: x[0] * p["drag"]),
        "observe uses the parameter 0, but the parameters are stiffness, drag. Its arguments are (x, parameters)",
    ),
    "four arguments": (
        lambda: fit_spring((TIMES, spring_record()), observe=lambda a, b, c, d: a),
        "a function of (x), (x, parameters) or (t, x, parameters)",
    ),
    "also": (lambda: fit_spring((TIMES, spring_record()), also=lambda s: s.energy), "cannot be combined"),
    "a checkpoint": (
        lambda: fit_spring((TIMES, spring_record()), checkpoint="a.npz"),
        "checkpoint= is for the matching",
    ),
    "wrong number of columns": (
        lambda: fit_spring({"t": TIMES, "a": spring_record(), "b": TIMES}),
        "the data have 2 columns (a, b), but 1 are observed. Choose 1 with lt.learn.read_data",
    ),
    "unknown column": (
        lambda: fit_spring({"t": TIMES, "a": spring_record()}, observe=lambda x: {"angle": x[0]}),
        "no column 'angle'; their columns are t, a",
    ),
    "unsorted": (lambda: fit_spring((TIMES[::-1], spring_record())), "Sort the rows by time"),
    "all missing": (lambda: fit_spring((TIMES, np.nan * TIMES)), "has no values, only NaN"),
    "one time": (lambda: fit_spring((TIMES[:1], spring_record()[:1])), "has 1 time, at least 2 are needed"),
    "one value": (
        lambda: fit_spring((TIMES, np.where(TIMES == 0.0, 1.0, np.nan))),
        "has 1 time with values, at least 2 are needed",
    ),
}


def fit_spring_with(build):
    return lt.learn.fit(build, (TIMES, spring_record()), parameters=SPRING_GUESS)


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_fitted_has_an_error_of_one_line(case):
    call, words = BAD[case]
    with pytest.raises((lt.InputError, lt.FunctionError)) as raised:
        call()
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_function_that_needs_numbers_is_refused():
    def build(p):
        return spring(p | {"drag": 0.0}) if p["drag"] < 0.0 else spring(p)

    with pytest.raises(lt.FunctionError, match="the function that builds the system could not be evaluated for traced"):
        fit_spring_with(build)


def test_the_advice_about_columns_works():
    table, system = {"t": TIMES, "a": spring_record(), "b": TIMES}, spring(TRUE_SPRING)
    for data, observe in ((lt.learn.read_data(table, columns=["a"]), position), (table, lambda x: {"a": x[0]})):
        (trajectory,) = parse_trajectories(data, system, make_observation(system, None, observe))
        np.testing.assert_array_equal(trajectory.x.ravel(), spring_record())


@pytest.mark.slow
def test_fits_with_new_errors_spread_as_the_standard_error():
    data = TIMES, spring_record() + 0.01 * np.random.default_rng(0).standard_normal(len(TIMES))
    how = {"parameters": SPRING_GUESS, "positive": True, "observe": position, "noise": 0.01, "substeps": 1}
    fits = lt.learn.several(lambda seed: spring, data, 2, **how)
    _, deviation = fits.spread(lambda s: s.dissipation.part.D[1, 1])
    assert 0.0 < deviation < 0.05


def problems_of(*arguments, **how):
    """Fit the spring, and return the record of the fit and all its warnings as one text."""
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        fitted_system = fit_spring(*arguments, **how)
    return fitted_system.training, " ".join(str(warning.message) for warning in messages)


def test_smooth_data_that_the_model_cannot_describe_are_called_so():
    """A motion with another force has no noise, which could hide that it is another one."""
    result, text = problems_of((TIMES, spring_record() + 0.5 * np.sin(TIMES) ** 2))
    assert "times the noise: the model cannot describe the data" in text
    assert result.residual > 3.0


@pytest.mark.slow
def test_few_data_give_a_warning():
    data = TIMES[:5], spring_record()[:5] + 0.01 * np.sin(40.0 * TIMES[:5])
    result, text = problems_of(data, noise=0.01)  # the least squares have no drag
    assert "do not determine" in text
    assert "If a positive parameter tends to 0, leave it out of the fit" in text
    assert result.values[1] < 1e-10
    assert not result.converged
    with pytest.raises(lt.InputError, match=r"drag = -.*, with which no system can be built: .* with positive="):
        problems_of(data, noise=0.01, positive=None)


def test_a_fit_that_stops_early_says_so(monkeypatch):
    monkeypatch.setattr("liethermo.learn.refining.MAX_DAMPING", 0.0)
    result, text = problems_of((TIMES, spring_record()), noise=0.01)
    assert "the fit has not converged" in text
    assert result.converged is False
