"""Ensembles with steps of their own: each trajectory as it would be alone, whoever is beside it."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.status_codes import StatusCode
from liethermo.runs import adaptive_ensemble, ensemble_lanes

BODY = lt.models.rigid_body()
METHOD = lt.MetriplecticRungeKutta(6)
ENGINES = ("compiled", pytest.param("array", marks=pytest.mark.slow))
SPAN = (0.0, 10.0)


def states(number, seed=0):
    x = np.random.default_rng(seed).standard_normal((number, 3))
    return x / np.linalg.norm(x, axis=1)[:, None]


def nonlinear():
    inertia = jnp.array([3.0, 2.0, 1.0])
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: 0.5 * jnp.sum(p * p / inertia) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1]),
        lambda p: jnp.log(1.0 + p @ p),
        lt.ProjectedMetric(rate=0.3),
    )


def assert_same_ensembles(ensemble, other_ensemble, order=slice(None)):
    """To the last bit."""
    for name in (
        "x",
        "energy",
        "entropy",
        "status",
        "steps",
        "rejected",
        "end_time",
        "energy_drift",
        "relaxation_time",
    ):
        assert np.array_equal(getattr(ensemble, name)[order], getattr(other_ensemble, name), equal_nan=True), name


# -- each as alone ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [METHOD, pytest.param(lt.MetriplecticGauss(2), marks=pytest.mark.slow)])
def test_each_takes_the_steps_that_it_takes_alone(method):
    """To the last bit in the compiled engine, which runs one program on a lane or on eight."""
    x0s, system = states(21), nonlinear()
    ensemble = lt.ensemble(system, x0s, SPAN, lt.Adaptive(1e-8), method, engine="compiled")
    assert ensemble.ok.all(), str(ensemble)
    assert len(set(ensemble.steps.tolist())) > 3
    assert ensemble.audit().passed, str(ensemble.audit())
    for i in (0, 7, 20):
        one = lt.integrate(system, x0s[i], SPAN, lt.Adaptive(1e-8), method, engine="compiled")
        assert np.array_equal(one.x[-1], ensemble.x[i])
        assert (one.stats.steps, one.stats.rejected) == (ensemble.steps[i], ensemble.rejected[i])
        assert one.stats.energy_range == ensemble[i].stats.energy_range
        assert ensemble[i].audit().passed


@pytest.mark.slow
def test_engines_take_the_same_steps():
    """But for rounding, which the array engine's programs for one and for many do otherwise."""
    x0s = states(12)
    a, b = (lt.ensemble(BODY, x0s, SPAN, lt.Adaptive(1e-8), METHOD, engine=engine) for engine in ("array", "compiled"))
    one = lt.integrate(BODY, x0s[3], SPAN, lt.Adaptive(1e-8), METHOD, engine="array")
    assert np.array_equal(a.steps, b.steps)
    assert np.abs(a.x - b.x).max() < 1e-11
    assert one.stats.steps == a.steps[3]
    assert np.abs(one.x[-1] - a.x[3]).max() < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_trajectory_does_not_depend_on_its_neighbours(engine, monkeypatch):
    """Permuted, cut into other portions, in more threads, with fewer attempts in a call: the same to the last bit."""
    x0s = np.concatenate([states(40), [[1e-9, 1.0, 1e-9]]])
    rates = np.linspace(0.1, 1.0, 41)

    def run(order):
        parameters = {"dissipation.rate": rates[order]}
        return lt.ensemble(
            BODY, x0s[order], (0.0, 60.0), lt.Adaptive(1e-7), METHOD, parameters=parameters, engine=engine
        )

    default_run, order = run(np.arange(41)), np.random.default_rng(1).permutation(41)
    assert default_run.ok.all()
    assert_same_ensembles(default_run, run(order), order)
    assert_same_ensembles(default_run, run(np.arange(5)), slice(5))
    monkeypatch.setattr(ensemble_lanes, "THREAD_BATCH_SIZE", 8)
    monkeypatch.setattr(ensemble_lanes, "ARRAY_BATCH_SIZE", 16)
    monkeypatch.setattr(adaptive_ensemble, "ATTEMPTS_PER_CALL_RANGE", (1, 3))
    assert_same_ensembles(default_run, run(np.arange(41)))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_stiff_failing_and_early_ones_together(engine):
    """One needs Newton's method, one leaves its domain, one rests, one starts beside a saddle, one cannot start."""
    inertia = jnp.array([10.0, 5.0, 1.0])

    def build(p):
        energy = lambda m: 0.5 * jnp.sum(m * m / inertia) + 1e-3 * jnp.sqrt(p["edge"] - m[0])  # noqa: E731
        entropy, friction = lt.Quadratic(np.ones(3)), lt.KillingDissipation(p["rate"])
        return lt.LiePoissonSystem(mf.so(3), energy, entropy, friction, validate=False)

    x0s = np.array([[0.1, 1, 0.1], [0.001, 1, 0.001], [1, 0, 0], [1e-9, 1, 1e-9], [0.3, 0.2, 0.9], [0.3, 0.4, 0.5]])
    parameters = {"rate": np.array([50.0, 0.5, 0.5, 0.5, -1.0, 0.5]), "edge": np.array([9, 1.1, 9, 9, 9, 9])}
    step, method = lt.Adaptive(1e-6), lt.MetriplecticGauss(2)
    ensemble = lt.ensemble(build, x0s, (0.0, 120.0), step, method, parameters=parameters, engine=engine)
    assert ensemble.status[[0, 2, 3, 4, 5]].tolist() == [0, 0, 0, StatusCode.INADMISSIBLE, 0]
    for i in (0, 1, 2, 3, 5):
        system = build({name: value[i] for name, value in parameters.items()})
        one = lt.integrate(system, x0s[i], (0.0, 120.0), step, method, engine=engine, on_failure="return")
        assert (one.status.code, one.stats.steps) == (ensemble[i].status.code, ensemble.steps[i])
        assert one.status.time == pytest.approx(ensemble.end_time[i], rel=1e-9)
        assert np.abs(one.x[-1] - ensemble.x[i]).max() < 1e-9
    assert ensemble[1].status.code == "step_underflow"
    assert ensemble.message(1).startswith("trajectory 1: no step from t = ")
    assert len(set(ensemble.steps.tolist())) == 6
    assert ensemble.x[3, 0] > 0.5  # it has fallen in its time
    rows = {row.law: row.passed for row in ensemble.audit().rows}
    assert rows.pop("trajectories that failed") is False
    assert all(is_obeyed is not False for law, is_obeyed in rows.items() if law != "accuracy")


@pytest.mark.slow
def test_limits():
    x0s = np.array([[0.1, 1.0, 0.1], [1.0, 0.0, 0.0]])
    ensemble = lt.ensemble(BODY, x0s, (0.0, 50.0), lt.Adaptive(1e-8, most_steps=20), METHOD)
    assert ensemble.status.tolist() == [StatusCode.STEP_LIMIT, StatusCode.COMPLETED]
    one = lt.integrate(BODY, x0s[0], (0.0, 50.0), lt.Adaptive(1e-8, most_steps=20), METHOD, on_failure="return")
    assert ensemble.end_time[0] == one.status.time
    assert "most_steps" in ensemble.message(0)
    steps = lt.ensemble(BODY, x0s, (0.0, 5.0), lt.Adaptive(1e-4, first=0.01, largest=0.25), METHOD).steps
    assert (steps >= 20).all()


# -- times and events -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_save_at(engine):
    times, x0s = [0.0, 0.37, 1.0, 1.05, 7.3], states(11)
    ensemble = lt.ensemble(BODY, x0s, SPAN, lt.Adaptive(1e-8), METHOD, save_at=times, engine=engine)
    assert ensemble.t.tolist() == [*times, 10.0]
    assert ensemble.x.shape == (11, 6, 3)
    for i in (0, 10):
        one = lt.integrate(BODY, x0s[i], SPAN, lt.Adaptive(1e-8), METHOD, save_at=times, engine=engine)
        assert np.array_equal(one.t, ensemble[i].t)
        assert np.abs(one.x - ensemble.x[i]).max() < 1e-12
        assert one.stats.steps == ensemble.steps[i]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-8)])
@pytest.mark.parametrize("engine", ENGINES)
def test_events_happen_when_they_do_alone(engine, step):
    """The production of entropy falls below a limit; in some that does not happen."""
    x0s = np.concatenate([states(9), [[1.0, 0.0, 0.0]]])
    options = {"until": lt.Relaxed(1e-4), "engine": engine}
    ensemble = lt.ensemble(BODY, x0s, (0.0, 40.05), step, METHOD, **options)
    assert set(ensemble.status.tolist()) == {StatusCode.COMPLETED, StatusCode.EVENT}
    assert ensemble.end_time[9] == 40.05
    assert np.isnan(ensemble.event_time[9])
    for i in (0, 4, 8, 9):
        one = lt.integrate(BODY, x0s[i], (0.0, 40.05), step, METHOD, **options)
        assert (one.status.code, one.stats.steps) == (ensemble[i].status.code, ensemble.steps[i])
        assert one.t[-1] == pytest.approx(ensemble.end_time[i], rel=1e-13)
        assert one.event_time == (None if i == 9 else pytest.approx(ensemble.event_time[i], rel=1e-13))
        assert np.abs(one.x[-1] - ensemble.x[i]).max() < 1e-12
    entropy_productions = [float(BODY.entropy_production(x)) for x in ensemble.x[ensemble.status == StatusCode.EVENT]]
    assert entropy_productions == pytest.approx([1e-4] * len(entropy_productions), rel=1e-9)
    assert ensemble.audit().passed


def test_an_event_of_ones_own_in_a_family():
    """Parameters differ, and so do the systems that the function is of."""
    level, x0s = 0.3, states(6, 4)
    rates = np.linspace(0.2, 1.0, 6)
    options = {"until": lambda x: x[0] - level}
    arguments = {"parameters": {"dissipation.rate": rates}}
    ensemble = lt.ensemble(BODY, x0s, (0.0, 30.0), lt.Adaptive(1e-9), METHOD, **arguments, **options)
    has_event = ensemble.status == StatusCode.EVENT
    assert has_event.sum() >= 2
    i = int(np.flatnonzero(has_event)[-1])
    assert np.abs(ensemble.x[has_event, 0] - level).max() < 1e-13
    one = lt.integrate(
        lt.models.rigid_body(rate=2 * rates[i]), x0s[i], (0.0, 30.0), lt.Adaptive(1e-9), METHOD, **options
    )
    assert one.event_time == pytest.approx(ensemble.event_time[i], rel=1e-12)
    assert ensemble[i].status.message.startswith(f"trajectory {i}: the event happened at t = ")


@pytest.mark.slow
def test_large_systems_look_for_what_grows():
    """Twenty wells in a row, more components than a whole Jacobian matrix is looked at of."""

    def energy(x):
        q, p = x[:6], x[6:]
        return 0.5 * p @ p + jnp.sum(0.25 * q**4 - 0.5 * q**2) + 0.3 * jnp.sum((q[1:] - q[:-1]) ** 2)

    wells = lt.MetriplecticSystem(mf.Canonical(6), energy)
    x0s = np.zeros((3, 12))
    x0s[[0, 1, 2], [3, 1, 0]] = 1e-11, 1e-9, 0.4
    options = {"until": lambda x: jnp.max(jnp.abs(x[:6])) - 0.5}
    ensemble = lt.ensemble(wells, x0s, (0.0, 100.0), lt.Adaptive(1e-6), lt.MetriplecticGauss(2), **options)
    for i in range(3):
        one = lt.integrate(wells, x0s[i], (0.0, 100.0), lt.Adaptive(1e-6), lt.MetriplecticGauss(2), **options)
        assert one.event_time == pytest.approx(ensemble.event_time[i], rel=1e-10)


@pytest.mark.slow
def test_on_a_manifold_with_attitudes_and_with_a_clock():
    inertia = jnp.array([3.0, 2.0, 1.0])
    top = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / inertia), None, group=mf.SO(3))
    driven = lt.MetriplecticSystem(mf.Canonical(1), lambda x, t: 0.5 * x @ x * (1.0 + 0.3 * jnp.sin(t)))
    sphere = lt.models.rigid_body()
    cases = [(top, states(3), lt.MetriplecticGauss(2)), (driven, states(3)[:, :2], METHOD), (sphere, states(3), METHOD)]
    for system, x0s, method in cases:
        ensemble = lt.ensemble(system, x0s, (0.5, 4.0), lt.Adaptive(1e-8), method)
        one = lt.integrate(system, x0s[1], (0.5, 4.0), lt.Adaptive(1e-8), method)
        assert np.abs(one.x[-1] - ensemble.x[1]).max() < 1e-12
        assert ensemble.steps[1] == one.stats.steps
        assert ensemble.audit().passed


def test_interrupted(monkeypatch):
    """Ctrl-C returns what there is."""

    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("liethermo.engines.adaptive_runs._advance_batch_program", interrupt)
    ensemble = lt.ensemble(BODY, states(3), SPAN, lt.Adaptive(1e-6), METHOD, engine="array")
    assert ensemble.status.tolist() == [StatusCode.INTERRUPTED] * 3
    assert not ensemble.steps.any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"outputs": "trajectory"}, "needs save_at"),
        (
            {"system": lt.models.mass_spring_gas, "x0s": np.full(3, 0.5), "method": lt.VariationalGauss(2)},
            "cannot be adaptive: a variational scheme conserves",
        ),
        ({"until": 3.0}, "until must be"),
        ({"until": lambda x: x}, "one number"),
        ({"system": lt.models.free_rigid_body, "until": lt.Relaxed(1e-3)}, "produces entropy or loses energy"),
        ({"save_at": [11.0]}, "outside"),
    ],
)
def test_bad_input(arguments, message):
    if "system" in arguments:
        arguments = arguments | {"system": arguments["system"]()}
    default = {"system": BODY, "x0s": states(2), "t_span": SPAN, "step": lt.Adaptive(1e-6)}
    with pytest.raises(lt.LiethermoError, match=message):
        lt.ensemble(**(default | arguments))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["compiled", "array"])
def test_the_accuracy_of_an_audit_is_that_of_an_accepted_step(engine):
    """The first size that is tried is much too long, and is no step of the run."""
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    starts = np.array([[0.1, 0.2, 1.0], [0.3, 0.1, 0.9]])
    step = lt.Adaptive(1e-8, first=19.0)

    audit = lt.ensemble(body, starts, (0.0, 20.0), step, lt.MetriplecticRungeKutta(8), engine=engine).audit()

    accuracy = next(row.value for row in audit.rows if row.name == "accuracy")
    assert 1e-12 < accuracy < 1e-7
