"""Fits: known numbers are found again, the same twice, on from a checkpoint; what cannot be used is refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.learn import training
from liethermo.learn.data import Trajectory, spline_states_and_rates
from liethermo.learn.fitting import checked_noise_std
from liethermo.learn.losses import prepare_differentiable_stepper
from liethermo.learn.observation import make_observation, states_matching_observations_and_rates

from . import cases

pytest.importorskip("optax")


def _numbers(system):
    friction = system.dissipation.function.function.log_gamma
    return np.exp([float(system.energy.function.function.log_stiffness), float(friction)])


def test_numbers_are_found_by_matching_and_shooting():
    """The splines are off by 1e-6 here; the runs, whose steps are of order 4, by 1e-5."""
    t, x = cases.record()
    matching_fit = lt.learn.fit(cases.oscillator(), (t, x), matching=300, shooting=0, rate=0.1)
    shot = lt.learn.fit(cases.oscillator(), (t, x), matching=0, shooting=200, rate=0.1)
    for fit in (matching_fit, shot):
        np.testing.assert_allclose(_numbers(fit), [cases.STIFFNESS, cases.GAMMA], rtol=1e-3)
        assert fit.check().passed
    assert matching_fit.training.parameters == 2
    assert matching_fit.training.loss[-1] < 1e-6 < matching_fit.training.loss[0]
    assert "matching" in str(matching_fit.training)


@pytest.mark.slow
def test_other_parameters_of_any_system_are_found():
    """Inertias and a rate of the relaxed rigid body. The sum of the 1/I moves nothing but through the friction."""
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    runs = [lt.integrate(body, x0, (0.0, 6.0), 0.1, method=lt.MetriplecticRungeKutta(6)) for x0 in np.eye(3) + 0.3]
    start = lt.models.rigid_body((2.5, 2.2, 1.3), rate=0.5)
    fitted_system = lt.learn.fit(
        start,
        runs,
        matching=1500,
        shooting=0,
        rate=0.05,
        validation=0,
        positive=lambda s: (s.energy.A, s.dissipation.rate),
    )
    np.testing.assert_allclose(1.0 / fitted_system.energy.A, [3.0, 2.0, 1.0], rtol=1e-2)
    assert float(fitted_system.dissipation.rate) == pytest.approx(float(body.dissipation.rate), rel=1e-2)


@pytest.mark.slow
def test_a_network_learns_the_force_and_the_laws_hold_in_the_forecast():
    t, x = cases.record(8)
    energy = lt.Quadratic(np.ones(1)).on([1]) + lt.learn.Energy(1, width=8, depth=1).on([0]) + _Heat().on([2])
    system = cases.oscillator(energy=energy, gamma=0.5)
    fitted_system = lt.learn.fit(system, (t, x), matching=600, shooting=50, rate=0.02)
    run = lt.integrate(fitted_system, x[0, 0], (0.0, 4.0), 0.1, method=lt.MetriplecticRungeKutta(4))
    assert np.abs(run.x - x[0]).max() < 0.05  # 0.012
    assert np.ptp(run.energy) < 1e-14 * np.abs(run.energy).max() + 1e-14
    assert (np.diff(run.entropy) > 0.0).all()


def _Heat():
    return lt.Each(lambda y: jnp.exp(y[0]), [[0]])


def test_the_same_twice_and_on_from_a_checkpoint(tmp_path, monkeypatch):
    t, x = cases.record()
    how = {"matching": 150, "shooting": 100, "rate": 0.05, "window": 2}
    system = cases.oscillator()
    whole_run = lt.learn.fit(system, (t, x), **how)

    class InterruptedProgress(training.Progress):
        stop = np.inf

        def update(self, t):
            if t >= self.stop:
                raise KeyboardInterrupt

    path = tmp_path / "course.npz"
    monkeypatch.setattr(training, "Progress", InterruptedProgress)
    for stop in (100, 200, np.inf):  # in the matching, in the shooting, not at all
        InterruptedProgress.stop = stop
        fitted_system = lt.learn.fit(system, (t, x), checkpoint=path, **how)
    assert "interrupted" not in fitted_system.training.ended.values()
    for a, b in zip(jax.tree_util.tree_leaves(whole_run), jax.tree_util.tree_leaves(fitted_system), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(whole_run.training.loss, fitted_system.training.loss)
    other_fit = lt.learn.fit(system, (t, x), **{**how, "shooting": 0}, seed=1)
    assert not np.array_equal(whole_run.training.loss[:3], other_fit.training.loss)
    with pytest.raises(lt.FileError, match="the checkpoint of a fit of another model"):
        lt.learn.fit(system, (t, x), checkpoint=path, **{**how, "rate": 0.06})


@pytest.mark.slow
def test_units_make_no_difference():
    """Seconds or 1e-12 of them, metres or 1e12 of them: the losses are the same but for rounding."""
    t, x = cases.record(3, 21)
    results = []
    for time, size in ((1.0, 1.0), (1e-12, 1e12), (1e20, 1e-20)):
        system = lt.learn.Metriplectic(3, width=4, depth=1)
        fitted_system = lt.learn.fit(system, (time * t, size * x), matching=50, shooting=0)
        results.append(np.r_[fitted_system.training.loss, fitted_system.training.validation])
    np.testing.assert_allclose(results[1:], [results[0]] * 2, rtol=1e-6)


@pytest.mark.slow
def test_what_is_not_observed_is_known_through_the_laws():
    """The heat is not seen: the stiffness and the friction on the motion are found all the same."""
    t, x = cases.record(3, 31, 3.0)
    energy = lt.learn.Energy(_Bath(jnp.zeros(())))
    system = cases.oscillator(energy=energy, friction=lt.learn.Friction(3, function=_Drag(jnp.zeros(()))))
    fitted_system = lt.learn.fit(system, (t, x[..., :2]), observed=[0, 1], shooting=400, rate=0.1, window=5)
    stiffness = np.exp(float(fitted_system.energy.function.function.log_stiffness))
    drag = np.exp(float(fitted_system.dissipation.function.function.log_gamma))
    np.testing.assert_allclose([stiffness, drag], [cases.STIFFNESS, cases.GAMMA], rtol=0.02)


class _Bath(cases.Spring):
    """A bath of temperature 1."""

    def __call__(self, x):
        return 0.5 * x[1] ** 2 + 0.5 * jnp.exp(self.log_stiffness) * x[0] ** 2 + x[2]


class _Drag(cases.Rubbing):
    def __call__(self, x):
        return jnp.stack([0.0, 0.0, -jnp.exp(0.5 * self.log_gamma)])


@pytest.mark.slow
def test_noise_and_times_at_any_distances():
    t, x = cases.record(4, 81)
    random = np.random.default_rng(1)
    data = []
    for states in x:
        kept_rows = np.sort(random.choice(len(t), 60, replace=False))
        data.append((t[kept_rows], states[kept_rows] + 0.01 * random.standard_normal((60, 3))))
    fitted_system = lt.learn.fit(cases.oscillator(), data, noise=0.01, matching=150, shooting=200, rate=0.1, window=8)
    np.testing.assert_allclose(_numbers(fitted_system), [cases.STIFFNESS, cases.GAMMA], rtol=0.03)
    last_loss = fitted_system.training.loss[-1]
    assert 0.3 < last_loss < 3.0  # of the size of the noise


def test_early_stopping_keeps_the_best():
    t, x = cases.record()
    fitted_system = lt.learn.fit(cases.oscillator(2.0, 0.3), (t, x), matching=2000, shooting=0, rate=1e-9, patience=2)
    assert fitted_system.training.step[-1] < 2000
    assert "no better for 2 looks" in fitted_system.training.ended["matching"]


T = np.linspace(0.0, 1.0, 5)
X = np.arange(15.0).reshape(5, 3)


@pytest.mark.parametrize(
    ("data", "how", "words"),
    [
        ((T, np.where(np.arange(15).reshape(5, 3) == 7, np.inf, X)), {}, "component 1 of state 2 is inf"),
        ((T[:1], X[:1]), {}, "has 1 time, at least 2 are needed"),
        ((T[[0, 2, 1, 3, 4]], X), {}, "times must grow, but time 2 is 0.25 after 0.5"),
        ((T, X[:4]), {}, "5 times and 4 states"),
        ((T, X[:, :2]), {}, "shape"),
        ((T, X), {"observed": [0, 3]}, "component 3"),
        ((T, X), {"observed": [0, 1]}, "2 components are observed"),
        ((T, np.ones((5, 3))), {}, "nothing moves"),
        ((T, X), {"noise": -1.0}, "positive standard deviation"),
        ((T, X), {"matching": -1}, "matching must be an integer >= 0"),
        ((T, X), {"validation": 1.0}, "fraction from 0 to below 1"),
        ({"t": T}, {}, "no columns besides the times"),
        (5, {}, "pair"),
        ([], {}, "no trajectories"),
        ("records.csv", {}, "there is no file records.csv"),
        ((T, X[:, :2]), {"observed": [0, 1], "shooting": 0}, "of the shooting"),
        ([[]], {}, "no trajectories"),
        ((T, 5.0), {}, "5 times and no states"),
        ((T, [[1.0, 2.0, 3.0], [1.0, 2.0]]), {}, "not made of real numbers"),
        ((T, X * 1j), {}, "not made of real numbers: they are of type complex128"),
        ((T.astype("datetime64[s]"), X), {}, "of type datetime64"),
        ([(T, X), (T, X[:, :2])], {}, "trajectory 1: .*shape"),
        ((T, X[:, :2]), {"observed": [-1, 1]}, "component -1"),
        ((T, X), {"observed": [[0], [1, 2]]}, "sequence of different component numbers"),
        ((T, X), {"noise": "some"}, "not a number with a unit"),
        ((T, X), {"noise": [0.1, 0.1]}, "one for each of 3 components"),
        ((T, X), {"validation": "a fifth"}, "fraction from 0 to below 1"),
        ((T, X), {"rate": float("nan")}, "rate must be a positive number"),
        ((T, X), {"method": "RK4"}, "method must be a OneStepMethod"),
        ((T, X), {"batch": 0}, "batch must be an integer >= 1"),
    ],
)
def test_bad_data_has_an_error_of_one_line(data, how, words):
    with pytest.raises((lt.InputError, lt.FunctionError, lt.FileError), match=words) as raised:
        lt.learn.fit(cases.oscillator(), data, **how)
    assert "\n" not in str(raised.value)


def test_a_system_of_which_nothing_is_learned_is_refused():
    body = lt.models.rigid_body()
    with pytest.raises(lt.InputError, match="nothing to learn"):
        lt.learn.fit(body, (T, X))


def test_what_is_no_system_is_refused():
    with pytest.raises(lt.InputError, match="fit needs a system"):
        lt.learn.fit(lambda x: x, (T, X))


def test_a_loss_that_is_not_finite_is_an_error():
    def square_root_of_position(x):
        return jnp.sqrt(x[0])

    system = cases.oscillator(energy=lt.learn.Energy(cases.Spring(jnp.zeros(()))) + square_root_of_position)
    t, x = cases.record()
    with pytest.raises(lt.InputError, match="the loss is nan after 50 steps, in the matching"):
        lt.learn.fit(system, (t, x), matching=50, shooting=0)


def _attitudes(noise):
    """Records of the attitudes of a body with friction inside, each turned by a small random angle."""
    body, random, observations = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.08), np.random.default_rng(0), []
    for start in random.standard_normal((4, 3)):
        run = lt.integrate(body, start, (0.0, 8.0), 0.05, method=lt.MetriplecticRungeKutta(6), save_every=4)
        noise_rotations = mf.SO(3).exp(noise * random.standard_normal((len(run.t), 3)))
        observations.append((run.t, run.attitude[5] @ run.attitude @ np.asarray(noise_rotations)))  # in axes of its own
    return observations


def test_the_first_states_show_the_attitudes_and_move_as_they_do():
    """The matched states are those of the body: a spline alone is off by the noise over the distance of the times."""
    body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.08)
    (t, R), *_ = _attitudes(0.0)
    observation = make_observation(body, None, lambda x, R: R)
    run = prepare_differentiable_stepper(body, lt.MetriplecticRungeKutta(4), 1, True)[0]
    smoothed_data = spline_states_and_rates(Trajectory(t, R.reshape(-1, 9)), None)
    states = states_matching_observations_and_rates(observation, run, [(t, *smoothed_data)], np.ones(9), 1.0, None)[0]
    true = lt.integrate(body, np.random.default_rng(0).standard_normal(3), (0.0, 8.0), 0.05, save_every=4)
    np.testing.assert_allclose(states[:, 4:], R.reshape(-1, 9), atol=2e-3)  # splines are worst at their ends: 4e-4
    np.testing.assert_allclose(states[5:-5, :3], true.x[5:-5, :3], atol=2e-2)


@pytest.mark.slow
def test_a_body_is_found_from_its_attitudes_alone():
    """Up to the unit of momenta, which attitudes do not tell."""
    with pytest.warns(lt.learn.FitWarning, match=r"the data do not determine energy.body.A\[0\]"):
        fitted_system = lt.learn.fit(
            lt.models.tumbling_body((2.5, 2.0, 1.2), rate=0.1),
            _attitudes(1e-3),
            observe=lambda x, R: R,
            noise=1e-3,
            shooting=1500,
            rate=0.02,
            window=10,
            positive=lambda s: (s.energy.body.A, s.dissipation.part.rate),
        )
    assert (fitted_system.training.rank, fitted_system.training.parameters) == (3, 4)
    inertia = 1.0 / np.asarray(fitted_system.energy.body.A)
    np.testing.assert_allclose(inertia / inertia[2], [3.0, 2.0, 1.0], rtol=0.02)
    assert float(fitted_system.dissipation.part.rate) * inertia[2] == pytest.approx(0.08, rel=0.1)


@pytest.mark.slow
def test_components_and_a_function_of_the_state_are_one_mechanism():
    t, x = cases.record(2, 21)
    system = cases.oscillator(energy=lt.learn.Energy(_Bath(jnp.zeros(()))))
    how = {"shooting": 60, "rate": 0.1, "window": 5}
    with pytest.warns(lt.learn.FitWarning, match="do not determine"):  # a first entropy can make up for the friction
        index_fit = lt.learn.fit(system, (t, x[..., 1:2]), observed=[1], **how)
    with pytest.warns(lt.learn.FitWarning, match="do not determine"):
        function_fit = lt.learn.fit(system, (t, x[..., 1]), observe=lambda x: x[1], **how)
    for fit in (index_fit, function_fit):
        assert fit.training.loss[-1] < 0.5 * fit.training.loss[0]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"observe": lambda x: x, "observed": [0]}, "cannot be combined"),
        ({"observe": 3}, "function of the state"),
        ({"observe": lambda x, R: R}, "Give the system a group"),
        ({"observe": lambda x: x[:, 0]}, "could not be evaluated"),
        ({"observe": lambda x: 1}, "real numbers"),
        ({"observe": lambda x: x[:2]}, r"shape \(5, 3\), but observe returns shape \(2,\)"),
        ({"observe": lambda x: x, "validation": 0.5}, "initial values of unobserved components"),
    ],
)
def test_an_observation_that_cannot_be_used_has_an_error_of_one_line(how, words):
    with pytest.raises((lt.InputError, lt.FunctionError), match=words) as raised:
        lt.learn.fit(cases.oscillator(), (T, X), **how)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_noise_with_a_unit_is_the_same_as_in_si_units():
    """The states of a table with units are in SI units, so ``"0.5 deg"`` is 0.0087 rad."""
    for noise, values in (("0.5 deg", np.pi / 360.0), (["0.5 deg", 0.01], [np.pi / 360.0, 0.01])):
        np.testing.assert_allclose(checked_noise_std(noise, 2), np.broadcast_to(values, 2), rtol=1e-15)
    data = cases.oscillator(), cases.record(2, 21)
    how = {"matching": 0, "shooting": 20, "rate": 0.1, "window": 5}
    fits = [lt.learn.fit(*data, noise=noise, **how) for noise in ("0.6 deg", np.radians(0.6))]
    np.testing.assert_array_equal(fits[0].training.loss, fits[1].training.loss)
    with pytest.raises(lt.InputError, match="unknown unit"):
        lt.learn.fit(*data, noise="0.6 dog", **how)
