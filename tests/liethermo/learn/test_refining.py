"""The diagnostics of a fit: standard errors, whether data determine the numbers, whether it has converged."""

from __future__ import annotations

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import liethermo as lt
import manifolds as mf
from liethermo.learn import files, training
from liethermo.learn.data import Trajectory, estimate_noise_if_visible
from liethermo.learn.least_squares import MAX_STEP_BIAS, MIN_RELATIVE_BIAS, _is_negligible_change
from liethermo.learn.refining import LeastSquaresResult

pytest.importorskip("optax")

RATE = 0.15
NOISE = 0.02
STARTS = ((1.0, 0.0, 0.0), (-0.5, 1.0, 0.2), (0.3, -1.2, -0.1))
TIMES = np.linspace(0.0, 8.0, 81)
SHORT_FIT = {"matching": 100, "shooting": 50}


def spring(rate):
    """The spring of the page on one's own data."""
    friction = lt.Friction(np.diag([0.0, 1.0]), rate=rate)
    energy = lambda x: x[1] ** 2 / 2 + x[0] ** 2  # noqa: E731
    return lt.MetriplecticSystem(mf.Canonical(1), energy, dissipation=friction, baths=lt.HeatBaths(1.0, 1.0))


def rate_of(system):
    return system.dissipation.part.rate


def field(t, x, rate):
    q, p, y = x
    return [p, -2.0 * q - rate * p, rate * p**2 / np.exp(y)]


def run(start, rate, times=TIMES):
    how = {"args": (rate,), "rtol": 1e-10, "atol": 1e-12}
    return scipy.integrate.solve_ivp(field, times[[0, -1]], start, "DOP853", times, **how).y.T


def records(seed=0, noise=NOISE, starts=STARTS):
    random = np.random.default_rng(seed)
    clean = [run(start, RATE) for start in starts]
    return [(TIMES, x + noise * random.standard_normal(x.shape)) for x in clean]


def least_squares(data, noise=NOISE):
    """The rate and its standard error by SciPy, over the rate and all first states."""

    def weighted_residuals(v):
        runs = [run(start, v[0], t) for start, (t, _) in zip(v[1:].reshape(-1, 3), data, strict=True)]
        return np.concatenate([(x - y).ravel() for x, (_, y) in zip(runs, data, strict=True)]) / noise

    result = scipy.optimize.least_squares(weighted_residuals, np.concatenate([[0.2], *(x[0] for _, x in data)]))
    variance = 2 * result.cost / (result.fun.size - result.x.size)
    return result.x[0], np.sqrt(np.linalg.inv(result.jac.T @ result.jac)[0, 0] * variance)


def test_the_rate_and_its_error_are_those_of_least_squares():
    data = records(3)
    fitted_system = lt.learn.fit(spring(0.5), data, positive=rate_of, noise=NOISE, validation=0, **SHORT_FIT)
    rate, error = least_squares(data)
    result = fitted_system.training
    assert float(rate_of(fitted_system)) == pytest.approx(rate, abs=0.02 * error)
    assert result.values == pytest.approx([float(rate_of(fitted_system))], rel=1e-14)
    assert result.standard_errors == pytest.approx([error], rel=0.02)
    assert result.names == ("dissipation.part.rate",)
    assert result.converged
    assert result.gradient < 0.01
    assert (result.rank, result.parameters) == (1, 1)
    assert result.residual == pytest.approx(1.0, abs=0.1)
    assert "dissipation.part.rate = 0.1" in str(result)
    assert "least squares: converged" in str(result)
    assert result.problems == []


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_friction_is_found_where_the_noise_is_not_given(seed):
    """The friction was 0.28 and 0.10 for a true 0.15: splines through noisy data have its derivatives."""
    fitted_system = lt.learn.fit(spring(0.5), records(seed), positive=rate_of, **SHORT_FIT).training
    assert abs(fitted_system.values[0] - RATE) < 2.5 * fitted_system.standard_errors[0]
    assert fitted_system.standard_errors[0] < 0.002
    assert fitted_system.noise_is_estimated
    np.testing.assert_allclose(fitted_system.noise, NOISE, rtol=0.3)
    assert fitted_system.held_out == pytest.approx(1.0, abs=0.4)
    assert "estimated" in str(fitted_system)


@pytest.mark.slow
def test_two_observed_components_determine_it_too():
    """The friction was 0.184: the descent had not come to its end, and nothing said so."""
    data = [(t, x[:, :2]) for t, x in records(0)]
    fitted_system = lt.learn.fit(
        spring(0.5), data, observed=[0, 1], positive=rate_of, noise=NOISE, shooting=100
    ).training
    assert fitted_system.converged
    assert abs(fitted_system.values[0] - RATE) < 2.5 * fitted_system.standard_errors[0]
    assert fitted_system.standard_errors[0] < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("observed", [None, [0, 1]], ids=["all", "two"])
@pytest.mark.parametrize("guess", [0.05, 1.0])
def test_the_defaults_find_it_within_two_standard_errors(guess, observed):
    errors = []
    for seed in range(4):
        data = [(t, x if observed is None else x[:, observed]) for t, x in records(seed)]
        fitted_system = lt.learn.fit(spring(guess), data, positive=rate_of, observed=observed).training
        assert fitted_system.converged
        errors.append((fitted_system.values[0] - RATE) / fitted_system.standard_errors[0])
    assert np.abs(errors).max() < 3.0
    assert np.sqrt(np.mean(np.square(errors))) < 2.0


@pytest.mark.slow
def test_three_rows_do_not_determine_it():
    """0.43 came without a word."""
    data = [(t[:3], x[:3]) for t, x in records(1)[:1]]
    with pytest.warns(lt.learn.FitWarning, match=r"the data do not determine dissipation.part.rate = .* ± "):
        fitted_system = lt.learn.fit(spring(0.5), data, positive=rate_of, **SHORT_FIT)
    result = fitted_system.training
    assert result.standard_errors[0] > 0.5 * result.values[0]
    assert "CAUTION: the data do not determine" in str(result)


class EnergyWithOffset(eqx.Module):
    """``p^2/2 + k q^2 + c``: no motion depends on c."""

    k: jax.Array
    c: jax.Array

    def __call__(self, x):
        return x[1] ** 2 / 2 + self.k * x[0] ** 2 + self.c


def test_a_number_that_moves_nothing_is_called_so():
    friction = lt.Friction(np.diag([0.0, 1.0]), rate=RATE)
    energy = lt.learn.Energy(EnergyWithOffset(jnp.array(1.3), jnp.array(0.1)))
    start = lt.MetriplecticSystem(mf.Canonical(1), energy, dissipation=friction, baths=lt.HeatBaths(1.0, 1.0))
    with pytest.warns(lt.learn.FitWarning, match=r"the data do not determine .*c = 0\.1 ± inf"):
        fitted_system = lt.learn.fit(start, records(0), noise=NOISE, **SHORT_FIT)
    result = fitted_system.training
    assert (result.rank, result.parameters) == (1, 2)
    assert np.isinf(result.condition)
    k = [name.endswith("k") for name in result.names].index(True)
    assert abs(result.values[k] - 1.0) < 3 * result.standard_errors[k] < 0.02
    assert np.isinf(result.standard_errors[1 - k])


def test_a_model_that_cannot_describe_the_data_is_called_so():
    data = [(t, x + 0.3 * np.sin(3.0 * t)[:, None]) for t, x in records(0)]
    with pytest.warns(lt.learn.FitWarning, match=r"times the noise: the model cannot describe the data"):
        fitted_system = lt.learn.fit(spring(0.5), data, positive=rate_of, noise=NOISE, **SHORT_FIT)
    assert fitted_system.training.residual > 3.0


def test_noise_is_told_from_motion():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 8.0, 90))
    for noise in (0.005, 0.05):
        random = np.random.default_rng(1)
        data = [Trajectory(t, run(start, RATE, t) + noise * random.standard_normal((90, 3))) for start in STARTS]
        np.testing.assert_allclose(estimate_noise_if_visible(data, np.ones(3)), noise, rtol=0.25)
    for times in (t, np.linspace(0.0, 8.0, 17)):  # 17 rows are 9 in a period
        data = [Trajectory(times, run(start, RATE, times)) for start in STARTS]
        assert estimate_noise_if_visible(data, np.ones(3)) is None
    assert estimate_noise_if_visible([Trajectory(t[:3], np.zeros((3, 1)))], np.ones(1)) is None
    rounded_data = [Trajectory(TIMES, run(STARTS[0], RATE) + 1e-9 * np.random.default_rng(0).standard_normal((81, 3)))]
    assert estimate_noise_if_visible(rounded_data, np.ones(3)) is None


@pytest.mark.slow
def test_data_without_noise_can_be_said_to_be_exact():
    data = records(0)
    exact = lt.learn.fit(spring(0.5), data, positive=rate_of, noise=0, matching=100, shooting=0)
    assert exact.training.noise.size == 0
    assert abs(float(rate_of(exact)) - RATE) > 0.003  # splines through the data
    assert exact.training.converged is None
    assert np.isfinite(exact.training.gradient)
    assert "norm of the gradient" in str(exact.training)


@pytest.mark.slow
def test_trajectories_of_any_lengths_and_attitudes():
    """The rest of a shorter trajectory is left out; what is not finite there does no harm."""
    data = [(t[: 81 - 20 * i], x[: 81 - 20 * i]) for i, (t, x) in enumerate(records(2))]
    fitted_system = lt.learn.fit(spring(0.5), data, positive=rate_of, noise=NOISE, validation=0, **SHORT_FIT).training
    rate, error = least_squares(data)
    assert fitted_system.values[0] == pytest.approx(rate, abs=0.02 * error)
    assert fitted_system.standard_errors == pytest.approx([error], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 8])
def test_fits_to_few_trajectories_spread_as_their_errors(number):
    """Three trajectories were drawn again and again, and the deviation was 0.0."""
    data, options = records(0), {"matching": 50, "shooting": 20, "validation": 0}
    fits = lt.learn.several(lambda seed: spring(0.3), data, number, positive=rate_of, noise=NOISE, **options)
    mean, deviation = fits.spread(rate_of)
    error = least_squares(data)[1]
    assert (0.01 if number == 2 else 0.4) * error < deviation < (4.0 if number == 2 else 2.0) * error
    assert abs(mean - RATE) < 4 * error


def test_fits_that_are_all_equal_say_nothing():
    data = [(TIMES, run(STARTS[0], RATE))]
    fits = lt.learn.several(lambda seed: spring(0.5), data, 2, positive=rate_of, validation=0, **SHORT_FIT)
    with pytest.warns(lt.learn.FitWarning, match=r"equal in all fits, so its deviation of 0 is not an error"):
        fits.spread(lambda s: s.energy.value(jnp.zeros(3)))


def test_the_findings_come_back_from_a_file(tmp_path):
    fitted_system = lt.learn.fit(spring(0.5), records(0), positive=rate_of, **SHORT_FIT)
    path = lt.learn.save(fitted_system, tmp_path / "spring.npz")
    loaded_system = lt.learn.load(path, spring(1.0))
    assert str(loaded_system.training) == str(fitted_system.training)
    np.testing.assert_array_equal(loaded_system.training.covariance, fitted_system.training.covariance)
    metadata, arrays = training.read_archive(path, files.MODEL_FORMAT)  # a file of before
    for name in files.ESTIMATE_FIELDS:
        arrays.pop(name)
    metadata["training"] = {name: metadata["training"][name] for name in ("parameters", "seconds", "ended")}
    training.write_archive(path, metadata, arrays)
    old = lt.learn.load(path, spring(1.0)).training
    assert old.converged is None
    assert old.names == ()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "matching" in str(old)
    assert len(jax.tree_util.tree_leaves(fitted_system)) == len(jax.tree_util.tree_leaves(spring(1.0)))


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("shift", "std", "is_negligible"),
    [
        (0.9 * MAX_STEP_BIAS * 0.2, 0.2, True),
        (1.1 * MAX_STEP_BIAS * 0.2, 0.2, False),
        (0.9 * MIN_RELATIVE_BIAS * 5.0, 0.0, True),
        (1.1 * MIN_RELATIVE_BIAS * 5.0, 0.0, False),
        (100.0, np.inf, True),  # the data do not determine it
    ],
)
def test_steps_are_short_enough_where_shorter_ones_hardly_change_the_parameters(shift, std, is_negligible):
    """The change is judged by the standard error of a parameter, or relative to the parameter, which is 5."""
    result = LeastSquaresResult(
        weights=np.array([1.0, 5.0]),
        covariance=np.diag([1.0, std**2]),
        rank=2,
        condition=1.0,
        residual=1.0,
        held_out_residual=np.nan,
        gradient_norm=0.0,
        converged=True,
        iterations=3,
        degrees_of_freedom=10,
        states=np.zeros((1, 2, 3)),
        residual_variances=np.ones(1),
    )
    assert _is_negligible_change(np.array([0.0, shift]), result, np.array([False, False])) == is_negligible
