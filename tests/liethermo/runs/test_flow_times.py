"""``lt.flow`` at any times and with parameters, beside SciPy's DOP853 and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import liethermo as lt
import manifolds as mf

TIMES = np.array([0.37, 0.0, 2.0, 1.113, 0.2, 1.9999])
X0 = np.array([0.3, 0.9, 0.4])


# The Killing form of so(3) is -2, so a model with the rate r has a KillingDissipation with the rate r / 2.


def rigid_body(moments=(3.0, 2.0, 1.0), rate=0.3):
    return lt.models.rigid_body(moments, rate=rate)


def reference(times, moments=(3.0, 2.0, 1.0), rate=0.3, x0=X0):
    """Return states of BFM's relaxed body by DOP853, from its equations: ``p x W + rate (|W|^2 p - (W . p) W)``."""

    def field(t, p):
        W = p / np.asarray(moments)
        return np.cross(p, W) + rate * (W @ W * p - (W @ p) * W)

    result = scipy.integrate.solve_ivp(
        field, (0.0, 2.0), x0, method="DOP853", t_eval=np.sort(times), rtol=1e-13, atol=1e-14
    )
    return result.y.T[np.argsort(np.argsort(times))]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(3), lt.MetriplecticRungeKutta(6)], ids=["gauss", "explicit"])
def test_states_at_irregular_times_are_those_of_dop853(method):
    states = lt.flow(rigid_body(), X0, (0.0, 2.0), 0.1, method, save_at=TIMES)
    np.testing.assert_allclose(states, reference(TIMES), atol=2e-9)
    np.testing.assert_array_equal(states[1], X0)


def test_a_time_at_the_end_of_a_step_has_the_state_of_that_step():
    path = lt.flow(rigid_body(), X0, (0.0, 1.0), 0.1, save_every=1)
    states = lt.flow(rigid_body(), X0, (0.0, 1.0), 0.1, save_at=0.1 * np.arange(11))
    np.testing.assert_allclose(states, path, atol=1e-14)


def test_derivatives_by_parameters_times_and_states_are_those_of_differences():
    method = lt.MetriplecticGauss(2)

    def states(rate, x0, times):
        return lt.flow(
            rigid_body(), x0, (0.0, 2.0), 0.1, method, save_at=times, parameters={"dissipation.rate": rate / 2}
        )

    arguments, h = (jnp.asarray(0.3), jnp.asarray(X0), jnp.asarray(TIMES[[0, 3, 5]])), 1e-5
    by_rate, by_state, by_time = jax.jacfwd(states, argnums=(0, 1, 2))(*arguments)
    rate, x0, times = arguments
    np.testing.assert_allclose(
        by_rate, (states(rate + h, x0, times) - states(rate - h, x0, times)) / (2 * h), atol=1e-9
    )
    for i, e in enumerate(np.eye(3)):
        differences = (states(rate, x0 + h * e, times) - states(rate, x0 - h * e, times)) / (2 * h)
        np.testing.assert_allclose(by_state[..., i], differences, atol=1e-9)
    for i, e in enumerate(np.eye(3)):
        differences = (states(rate, x0, times + h * e) - states(rate, x0, times - h * e)) / (2 * h)
        np.testing.assert_allclose(by_time[..., i], differences, atol=1e-9)
    velocities = rigid_body().vector_field(states(*arguments))
    np.testing.assert_allclose(jnp.einsum("iji->ij", by_time), velocities, atol=1e-5)

    def loss(rate, x0, times):
        return jnp.sum(states(rate, x0, times) ** 3)

    gradient = jax.grad(loss, argnums=(0, 1, 2))(*arguments)
    values = states(*arguments)
    np.testing.assert_allclose(gradient[0], jnp.sum(3 * values**2 * by_rate), rtol=1e-10)
    np.testing.assert_allclose(gradient[1], jnp.einsum("ij,ijk->k", 3 * values**2, by_state), rtol=1e-10)
    np.testing.assert_allclose(gradient[2], jnp.einsum("ij,ijk->k", 3 * values**2, by_time), rtol=1e-10)


@pytest.mark.slow
def test_times_and_parameters_can_be_mapped():
    def build(rate, times):
        return lt.flow(lambda r: rigid_body(rate=r), X0, (0.0, 2.0), 0.2, save_at=times, parameters=rate)

    rates, times = jnp.array([0.1, 0.3]), jnp.array([[0.1, 1.3], [0.7, 0.2]])
    mapped = jax.jit(jax.vmap(build))(rates, times)
    for i in range(2):
        np.testing.assert_allclose(mapped[i], build(rates[i], times[i]), atol=1e-13)
    assert np.isnan(jax.jit(lambda t: build(0.1, t))(jnp.array([2.5]))).all()


@pytest.mark.slow
def test_a_driven_system_has_its_own_clock():
    moment = lt.TimeDependent(lambda x, t: 0.5 * jnp.sum(x**2 / jnp.array([3.0, 2.0, 1.0])) + jnp.sin(t) * x[0])
    system = lt.LiePoissonSystem(mf.so(3), moment)
    states = lt.flow(system, X0, (0.0, 2.0), 0.1, lt.MetriplecticGauss(3), save_at=TIMES)

    def field(t, p):
        return np.cross(p, p / np.array([3.0, 2.0, 1.0]) + np.array([np.sin(t), 0.0, 0.0]))

    result = scipy.integrate.solve_ivp(
        field, (0.0, 2.0), X0, method="DOP853", t_eval=np.sort(TIMES), rtol=1e-13, atol=1e-14
    )
    np.testing.assert_allclose(states, result.y.T[np.argsort(np.argsort(TIMES))], atol=2e-9)


@pytest.mark.slow
def test_a_fit_to_a_table_finds_its_parameters():
    times = np.sort(np.random.default_rng(0).uniform(0.0, 2.0, 12))
    table = reference(times, rate=0.42)

    def residuals(rate):
        states = lt.flow(
            rigid_body(), X0, (0.0, 2.0), 0.05, lt.MetriplecticGauss(2), save_at=times,
            parameters={"dissipation.rate": rate[0] / 2},
        )  # fmt: skip
        return (states - table).ravel()

    fit = scipy.optimize.least_squares(residuals, [0.1], jac=jax.jacfwd(residuals))
    np.testing.assert_allclose(fit.x, 0.42, atol=1e-6)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"save_at": [0.1, 3.0]}, "times of t_span"),
        ({"save_at": []}, "list of times"),
        ({"save_at": [0.1], "save_every": 2}, "got both"),
        ({"parameters": {"nothing": 1.0}}, "no parameter 'nothing'"),
        ({"parameters": {"dissipation.rate": [1.0, 2.0]}}, r"dissipation\.rate must have shape \(\), got \(2,\)"),
        ({"parameters": [1.0]}, "dict from names"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(keywords, words):
    with pytest.raises(lt.InputError, match=words):
        lt.flow(rigid_body(), X0, (0.0, 2.0), 0.1, **keywords)
