"""Ensembles: each trajectory is the one that it would be alone, in both engines; failures stay where they are."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.status_codes import STATUS_NAMES
from tests.systems import rigid_body

ENGINES = ("array", "compiled")
ENGINE_CASES = (pytest.param("array", marks=pytest.mark.slow), "compiled")


def states(number, dim=3, seed=0):
    return np.random.default_rng(seed).standard_normal((number, dim))


@pytest.mark.parametrize("engine", ENGINE_CASES)
def test_each_is_the_trajectory_it_would_be_alone(engine):
    """37 trajectories leave lanes empty; 20.05 is no multiple of the step."""
    x0s = states(37)
    ensemble = lt.ensemble(rigid_body(), x0s, (0.0, 20.05), 0.1, outputs="trajectory", save_every=7, engine=engine)
    assert (ensemble.x.shape, ensemble.energy.shape, ensemble.entropy.shape) == ((37, 31, 3), (37, 31), (37, 31))
    assert ensemble.ok.all()
    assert ensemble.audit().passed
    for i in (0, 15, 16, 36):
        one = lt.integrate(rigid_body(), x0s[i], (0.0, 20.05), 0.1, save_every=7)
        assert np.array_equal(one.t, ensemble.t)
        assert np.abs(one.x - ensemble.x[i]).max() <= 1e-13
        assert np.abs(one.entropy - ensemble.entropy[i]).max() <= 1e-13
        assert ensemble.steps[i] == one.stats.steps
        assert ensemble.iterations[i] == pytest.approx(one.stats.fixed_point_iterations, rel=0.05)


def test_a_trajectory_does_not_depend_on_its_neighbours():
    x0s = states(40)
    ensemble = lt.ensemble(rigid_body(), x0s, (0.0, 10.0), 0.1, engine="compiled")
    reversed_ensemble = lt.ensemble(rigid_body(), x0s[::-1], (0.0, 10.0), 0.1, engine="compiled")
    assert np.array_equal(ensemble.x, reversed_ensemble.x[::-1])


def test_outputs():
    x0s = states(5)
    path, final, summary = (
        lt.ensemble(rigid_body(), x0s, (0.0, 5.0), 0.1, outputs=outputs, engine="compiled")
        for outputs in ("trajectory", "final", "summary")
    )
    assert (final.x.shape, summary.x) == ((5, 3), None)
    assert (path.t.shape, final.t.tolist(), summary.t.tolist()) == ((51,), [5.0], [5.0])
    assert np.array_equal(final.x, path.x[:, -1])
    assert np.array_equal(summary.entropy, path.entropy[:, -1])
    drift = np.abs(path.energy - path.energy[:, :1]).max(axis=1)
    drift /= np.maximum(np.abs(path.energy[:, 0]), path.energy_sensitivity)
    gradient = np.linalg.norm(rigid_body().energy.apply_matrix(path.x.reshape(-1, 3)), axis=-1)
    sensitivity = (gradient * np.linalg.norm(path.x.reshape(-1, 3), axis=-1)).reshape(5, 51).max(axis=1)
    assert np.allclose(path.energy_sensitivity, sensitivity, rtol=1e-14)
    assert np.array_equal(summary.energy_drift, drift)
    assert np.allclose(summary.least_entropy_increment, np.diff(path.entropy).min(axis=1), rtol=1e-12, atol=0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ENGINES)
def test_named_parameters(engine):
    rates, x0 = np.linspace(0.1, 2.0, 20), [0.3, 1.0, 0.2]
    ensemble = lt.ensemble(rigid_body(), x0, (0.0, 5.0), 0.1, parameters={"dissipation.rate": rates / 2}, engine=engine)
    for i in (0, 13):
        one = lt.integrate(lt.models.rigid_body(rate=rates[i]), x0, (0.0, 5.0), 0.1)
        assert np.abs(one.x[-1] - ensemble.x[i]).max() <= 1e-14


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_function_that_builds_systems(engine):
    """Some parameters one for each, some one for all; initial states too."""
    parameters = {"inertia": 1.0 + np.abs(states(20)), "rate": np.array([0.7])}
    build = lambda p: lt.models.rigid_body(p["inertia"], p["rate"])  # noqa: E731
    x0s = states(20, seed=1)
    ensemble = lt.ensemble(build, x0s, (0.0, 5.0), 0.1, parameters=parameters, engine=engine)
    assert ensemble.audit().passed
    for i in (0, 13):
        one = lt.integrate(build({"inertia": parameters["inertia"][i], "rate": 0.7}), x0s[i], (0.0, 5.0), 0.1)
        assert np.abs(one.x[-1] - ensemble.x[i]).max() <= 1e-13


@pytest.mark.slow
def test_parameters_of_user_functions():
    class Quartic(eqx.Module):
        strength: jax.Array

        def __call__(self, mu):
            return 0.5 * jnp.sum(mu**2 / jnp.array([3.0, 2.0, 1.0])) + self.strength * mu[0] ** 4

    system = lt.LiePoissonSystem(mf.so(3), Quartic(jnp.asarray(0.0)), lt.Quadratic(np.ones(3)), lt.ProjectedMetric())
    strengths = np.array([0.1, 0.5, 0.9])
    ensemble = lt.ensemble(system, [0.5, 1.0, 0.2], (0.0, 2.0), 0.1, parameters={"energy.function.strength": strengths})
    for i, strength in enumerate(strengths):
        single_system = lt.LiePoissonSystem(
            mf.so(3), Quartic(jnp.asarray(strength)), lt.Quadratic(np.ones(3)), lt.ProjectedMetric()
        )
        assert (
            np.abs(lt.integrate(single_system, [0.5, 1.0, 0.2], (0.0, 2.0), 0.1).x[-1] - ensemble.x[i]).max() <= 1e-14
        )


def leaves_its_domain():
    def energy(p):
        return 0.5 * jnp.sum(p * p / jnp.array([10.0, 5.0, 1.0])) + 1e-3 * jnp.sqrt(1.1 - p[0])

    entropy, dissipation = lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.5)
    return lt.LiePoissonSystem(mf.so(3), energy, entropy, dissipation, validate=False)


@pytest.mark.parametrize("engine", ENGINE_CASES)
def test_a_failure_stays_where_it_is(engine):
    x0s = np.array([[0.3, 0.1, 0.1]] * 7 + [[0.001, 1.0, 0.001]] + [[0.2, 0.1, 0.3]] * 12)
    options = {"outputs": "trajectory", "save_every": 7, "engine": engine}
    ensemble = lt.ensemble(leaves_its_domain(), x0s, (0.0, 60.0), 0.1, **options)
    one = lt.integrate(leaves_its_domain(), x0s[7], (0.0, 60.0), 0.1, save_every=7, on_failure="return")
    assert one.status.code == "non_finite"
    assert [STATUS_NAMES[code] for code in ensemble.status] == [*["completed"] * 7, "non_finite", *["completed"] * 12]
    assert ensemble.steps[7] == one.status.step
    n_saved = one.status.step // 7 + 1
    assert np.isfinite(ensemble.x[7, :n_saved]).all()
    assert np.abs(ensemble.x[7, :n_saved] - one.x[:n_saved]).max() < 1e-12
    assert np.isnan(ensemble.x[7, n_saved:]).all()
    assert np.isfinite(np.delete(ensemble.x, 7, axis=0)).all()
    assert not ensemble.audit().passed
    assert f"non_finite: trajectory 7: NaN or infinity in step {one.status.step + 1}" in str(ensemble)
    assert ensemble[7].status.code == "non_finite"
    assert ensemble[7].t[-1] == ensemble.t[n_saved - 1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ENGINES)
def test_newton_where_a_lane_needs_it(engine):
    """One stiff body among soft ones."""
    rates = np.array([0.5, 0.5, 100.0, 0.5])
    ensemble = lt.ensemble(
        rigid_body(), [0.1, 1.0, 0.1], (0.0, 50.0), 0.5, parameters={"dissipation.rate": rates}, engine=engine
    )
    one = lt.integrate(lt.models.rigid_body(rate=200.0), [0.1, 1.0, 0.1], (0.0, 50.0), 0.5)
    assert one.stats.newton_iterations > 0
    assert np.abs(ensemble.x[2] - one.x[-1]).max() < 1e-13
    assert ensemble.audit().passed
    assert [row.law for row in ensemble.audit().rows if row.passed is False] == ["accuracy"]  # stiff, and not resolved


def test_relaxation_time():
    """On one axis the entropy of a linear relaxation is known: S(t) = S(T) - c exp(-t / tau)."""

    def build(tau):
        friction = lambda x: jnp.diag(jnp.array([0.0, 1.0])) / tau  # noqa: E731
        entropy = lambda x: x[1] - 0.5 * x[1] ** 2  # noqa: E731
        return lt.MetriplecticSystem(
            np.zeros((2, 2)), lambda x: x[0], entropy, lt.FrictionOperator(friction), dim=2, validate=False
        )

    ensemble = lt.ensemble(build, [0.0, 0.0], (0.0, 60.0), 0.01, parameters=np.array([1.0, 2.0]), outputs="summary")
    assert np.allclose(ensemble.relaxation_time, [0.5, 1.0], rtol=1e-4)
    still = lt.ensemble(lt.models.free_rigid_body(), [0.0, 1.0, 0.0], (0.0, 5.0), 0.1, outputs="summary")
    assert np.isnan(still.relaxation_time).all()


@pytest.mark.slow
def test_double_bracket():
    """The energy falls and the entropy stays: the energy is what relaxes."""
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), lt.Quadratic(np.ones(3)), lt.DoubleBracket(0.5)
    )
    ensemble = lt.ensemble(system, states(6), (0.0, 30.0), 0.05, outputs="summary")
    assert ensemble.audit().passed
    assert ((ensemble.relaxation_time > 0.0) & (ensemble.relaxation_time < 30.0)).all()


def test_interrupted(monkeypatch):
    """Ctrl-C returns what there is."""

    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("liethermo.engines.array_engine._advance_batch", interrupt)
    ensemble = lt.ensemble(rigid_body(), states(3), (0.0, 1.0), 0.1, engine="array")
    assert [STATUS_NAMES[code] for code in ensemble.status] == ["interrupted"] * 3
    assert not ensemble.steps.any()


@pytest.mark.slow
def test_what_cannot_be_compiled():
    def energy(mu):
        return jnp.sum(jnp.abs(jnp.fft.fft(mu)) ** 2 * jnp.array([1.0, 2.0, 3.0]))

    system = lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), validate=False)
    with pytest.warns(UserWarning, match="the array engine runs it instead"):
        ensemble = lt.ensemble(system, [0.3, 1.0, 0.2], (0.0, 0.3), 0.1)
    assert ensemble.engine == "array"
    with pytest.raises(lt.LiethermoError, match="JAX primitive"):
        lt.ensemble(system, [0.3, 1.0, 0.2], (0.0, 0.3), 0.1, engine="compiled")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x0s": np.zeros((2, 2, 3))}, r"\(n,\) or \(trajectories, n\)"),
        ({"x0s": np.zeros((2, 4))}, r"\(\.\.\., 3\)"),
        ({"x0s": np.array([[0.0, 1.0, np.inf]])}, "not finite"),
        ({"x0s": np.zeros((0, 3))}, "at least one"),
        ({"outputs": "all"}, "'final', 'trajectory' or 'summary'"),
        ({"engine": "fast"}, "'auto', 'array' or 'compiled'"),
        ({"step": 0.0}, "positive"),
        ({"method": lt.Reference()}, "runs single trajectories"),
        ({"system": 3}, "a function that builds one"),
        ({"system": lt.models.rigid_body}, "needs parameters"),
        ({"parameters": {"rate": np.ones(2)}}, r"no parameter 'rate'; its parameters are .*dissipation\.rate"),
        ({"parameters": {"dissipation.rate": np.ones((2, 2))}}, r"have shape \(trajectories\), got \(2, 2\)"),
        ({"parameters": np.ones(2)}, "a dict from names to values"),
        ({"parameters": {"dissipation.rate": np.ones(2)}, "x0s": np.ones((3, 3))}, r"different numbers .*\[2, 3\]"),
        ({"parameters": {"dissipation.rate": -np.ones(3)}}, "no trajectory can be started; trajectory 0"),
        ({"save_at": [0.5], "outputs": "final"}, 'save_at needs outputs="trajectory"'),
        ({"save_at": [0.5, 1.5]}, "outside"),
        ({"x0s": np.full((3, 3), np.nan)}, "no trajectory can be started; trajectory 0: the state is not finite"),
        ({"system": lambda p: 3.0, "parameters": np.ones(2)}, "must return a system"),
        ({"system": lambda p: lt.models.rigid_body(rate=float(p)), "parameters": np.ones(2)}, "traced JAX arrays"),
        (
            {"system": lambda p: lt.QuantumSystem(np.diag([0.0, p])), "parameters": np.ones(2)},
            "traced JAX arrays.* or give a system",
        ),
        (
            {"system": lambda p: lt.models.rigid_body(rate=p), "parameters": -np.ones(500)},
            "trajectory 0: .*must be >= 0",
        ),
    ],
)
def test_bad_input(arguments, message):
    default = {"system": rigid_body(), "x0s": np.array([0.1, 1.0, 0.1]), "t_span": (0.0, 1.0), "step": 0.1}
    with pytest.raises(lt.InputError, match=message):
        lt.ensemble(**(default | arguments))


def test_save_every_asks_for_trajectories():
    starts = np.array([[0.1, 0.2, 1.0], [0.3, -0.2, 0.5]])
    many = lt.ensemble(lt.models.rigid_body(rate=0.2), starts, (0.0, 1.0), 0.1, save_every=5)
    single = lt.integrate(lt.models.rigid_body(rate=0.2), starts[1], (0.0, 1.0), 0.1, save_every=5)
    np.testing.assert_allclose(many.x[1], single.x, atol=1e-15)
    assert many.x.shape == (2, 3, 3)
    with pytest.raises(lt.InputError, match="save_at"):
        lt.ensemble(lt.models.rigid_body(), starts, (0.0, 1.0), lt.Adaptive(1e-6), save_every=5)
