"""A prepared propagator returns what ``integrate`` and ``ensemble`` return, to the bit."""

import dataclasses
import pickle
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.select_engine import CompiledEngineWarning
from liethermo.systems import invariants
from tests.refusals import refusal_test

SPAN = (0.0, 1.3)
STEP = 0.25
MU = np.array([0.3, 0.9, -0.4])


def rigid_body():
    return lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)


def body_with_group():
    return lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([0.5, 1.0, 1.5]), dissipation=lt.DoubleBracket(0.1), group=mf.SO(3)
    )


def body_with_bath():
    return lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.1, attitude=False)


def spin_on_sphere():
    return lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), lambda s: s[0] ** 4 + s[1] ** 2, space=mf.Sphere(2))


def driven_body():
    energy = lambda m, t: 0.5 * jnp.sum(m**2 / jnp.array([3.0, 2.0, 1.0])) + 0.1 * jnp.sin(t) * m[0]  # noqa: E731
    return lt.LiePoissonSystem(mf.so(3), energy)


def spins_on_sites():
    return lt.models.spin_lattice((3, 1), exchange_constant=1.0, rate=0.1, baths=True)


SYSTEMS = {
    "body": (rigid_body, MU),
    "group": (body_with_group, MU),
    "bath": (body_with_bath, MU),
    "sphere": (spin_on_sphere, np.array([0.6, 0.64, 0.48])),
    "driven": (driven_body, MU),
    "sites": (spins_on_sites, np.array([[[1.0, 0, 0]], [[0, 1.0, 0]], [[0, 0.6, 0.8]]])),
}
METHODS = {
    "Gauss": lt.MetriplecticGauss(2),
    "Runge-Kutta": lt.MetriplecticRungeKutta(4),
}


def start_of(system, x0):
    return system.state(x0) if system.sites else x0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
def test_final_state_equals_that_of_integrate(name, method):
    build, x0 = SYSTEMS[name]
    system = build()
    x0 = start_of(system, x0)
    expected_values = lt.integrate(system, x0, SPAN, STEP, method)
    propagator = lt.Propagator(system, method, STEP)
    assert np.array_equal(propagator.final(x0, SPAN), expected_values.x[-1])
    solution = propagator(x0, SPAN)
    assert np.array_equal(solution.x, expected_values.x)
    assert np.array_equal(solution.t, expected_values.t)
    assert solution.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("span", [(0.0, 1.0), (0.5, 0.6), (2.0, 2.0 + 3 * STEP), (-1.0, 0.1)])
def test_spans_that_end_between_steps(span):
    body, method = rigid_body(), lt.MetriplecticGauss(2)
    propagator = lt.Propagator(body, method, STEP)
    assert np.array_equal(propagator.final(MU, span), lt.integrate(body, MU, span, STEP, method).x[-1])


def test_adaptive_steps_and_options_of_a_call():
    body = rigid_body()
    propagator = lt.Propagator(body, lt.MetriplecticRungeKutta(8), lt.Adaptive(1e-8))
    expected_values = lt.integrate(body, MU, (0.0, 9.0), lt.Adaptive(1e-8), lt.MetriplecticRungeKutta(8))
    assert np.array_equal(propagator.final(MU, (0.0, 9.0)), expected_values.x[-1])
    saved = propagator(MU, (0.0, 9.0), save_at=[1.0, 2.0], dense=True)
    assert saved.t.tolist() == [0.0, 1.0, 2.0, 9.0]
    assert propagator(MU, (0.0, np.inf), until=lt.Relaxed(1e-6)).status.code == "event"


def test_noise_is_that_of_integrate():
    body, noise = body_with_bath(), lt.Fluctuations(1e-3, seed=3)
    expected_values = lt.integrate(body, MU, SPAN, STEP, noise=noise)
    propagator = lt.Propagator(body, None, STEP, noise=noise)
    assert np.array_equal(propagator.final(MU, SPAN), expected_values.x[-1])


def test_many_is_an_ensemble():
    body, x0s = rigid_body(), np.array([MU, 2.0 * MU, -MU])
    propagator = lt.Propagator(body, lt.MetriplecticGauss(2), STEP)
    many = propagator.many(x0s, SPAN)
    assert np.array_equal(many.x, lt.ensemble(body, x0s, SPAN, STEP, lt.MetriplecticGauss(2)).x)
    assert np.array_equal(many.x, [propagator.final(x0, SPAN) for x0 in x0s])


def test_parameters_of_a_call():
    propagator = lt.Propagator(rigid_body(), lt.MetriplecticGauss(2), STEP)
    other = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.7)  # whose dissipation has half this rate
    expected_values = lt.integrate(other, MU, SPAN, STEP, lt.MetriplecticGauss(2))
    parameters = {"dissipation.rate": 0.35}
    assert np.array_equal(propagator.final(MU, SPAN, parameters=parameters), expected_values.x[-1])
    assert np.array_equal(propagator(MU, SPAN, parameters=parameters).x, expected_values.x)
    assert not np.array_equal(propagator.final(MU, SPAN), expected_values.x[-1])
    with pytest.raises(lt.InputError, match=r"no parameter 'rate'; its parameters are .*dissipation\.rate"):
        propagator.final(MU, SPAN, parameters={"rate": 0.7})
    with pytest.raises(lt.InputError, match=r"dissipation\.rate must have shape \(\), got \(2,\)"):
        propagator.final(MU, SPAN, parameters={"dissipation.rate": [0.7, 0.1]})


BATHS_OF_TWO_KINDS = lt.HeatBaths([1.0, 2.0], [1.0, 0.5])


@pytest.mark.parametrize(
    ("name", "invalid", "valid", "message"),
    [
        ("dissipation.rate", -1.0, 0.3, r"a dissipation rate must be >= 0 and finite, got -1"),
        ("dissipation.rate", np.nan, 0.3, r"a dissipation rate must be >= 0 and finite, got nan"),
        ("baths.capacity", [1.0, -2.0], [0.5, 2.0], r"the capacity of a bath must be positive, got \[1\.0, -2\.0\]"),
        ("baths.temperature", [0.0, 1.0], [0.5, 2.0], r"the temperature of a bath must be positive"),
    ],
)
def test_new_values_meet_the_conditions_of_the_constructors(name, invalid, valid, message):
    """A negative rate made the entropy fall, silently: machine code takes new values without a new system."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda m: m @ (m * np.array([1.0, 2.0, 3.0])),
        dissipation=lt.DoubleBracket(0.1),
        baths=BATHS_OF_TWO_KINDS,
    )
    p, x0 = lt.Propagator(system, None, STEP), [*MU, 0.0, 0.0]
    calls = [
        lambda value: p.final(x0, SPAN, parameters={name: value}),
        lambda value: p(x0, SPAN, parameters={name: value}).x[-1],
        lambda value: lt.flow(system, x0, SPAN, STEP, parameters={name: value}),
    ]
    for call in calls:
        before = call(valid)
        with pytest.raises(lt.InputError, match=message):
            call(invalid)
        assert np.array_equal(call(valid), before)
    if not np.isnan(invalid).any():  # an ensemble runs the other members
        many = p.many(x0, SPAN, parameters={name: np.array([valid, invalid, valid])})
        assert many.status.tolist()[0] == many.status.tolist()[2] == 0 != many.status.tolist()[1]
        assert np.array_equal(many.x[0], calls[1](valid))


def test_what_is_conserved_belongs_to_the_parameters_of_the_call():
    """An isotropic body conserves more than others: its neighbours in a loop over parameters must not."""
    energy = lt.Quadratic([1.0, 1.0, 1.0])
    body = lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic([2.0, 2.0, 2.0]), lt.ProjectedMetric(rate=0.3))
    propagator = lt.Propagator(body, lt.MetriplecticRungeKutta(4), STEP)
    for A in ([1.0, 1.0, 1.0], [1.0, 0.5, 2.0]):
        other = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(A), body.entropy, lt.ProjectedMetric(rate=0.3))
        expected_values = lt.integrate(other, MU, SPAN, STEP, lt.MetriplecticRungeKutta(4)).x[-1]
        assert np.array_equal(propagator.final(MU, SPAN, parameters={"energy.A": A}), expected_values)


def test_threads_and_pickles():
    propagator = lt.Propagator(rigid_body(), lt.MetriplecticGauss(2), STEP)
    x0s = np.random.default_rng(0).standard_normal((40, 3))
    expected_values = [propagator.final(x0, SPAN) for x0 in x0s]
    with ThreadPoolExecutor(4) as pool:
        assert np.array_equal(list(pool.map(lambda x0: propagator.final(x0, SPAN), x0s)), expected_values)
    again = pickle.loads(pickle.dumps(propagator))
    assert np.array_equal([again.final(x0, SPAN) for x0 in x0s[:3]], expected_values[:3])
    assert repr(again) == repr(propagator)


def test_a_result_is_not_overwritten_by_the_next_call():
    propagator = lt.Propagator(rigid_body(), lt.MetriplecticGauss(2), STEP)
    one = propagator.final(MU, SPAN)
    copy = one.copy()
    propagator.final(-MU, SPAN)
    assert np.array_equal(one, copy)


@pytest.mark.slow
def test_steps_that_need_newton():
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=60.0)
    propagator = lt.Propagator(body, lt.MetriplecticGauss(1), 0.5)
    expected_values = lt.integrate(body, MU, (0.0, 3.0), 0.5, lt.MetriplecticGauss(1))
    assert expected_values.stats.newton_iterations > 0
    assert np.array_equal(propagator.final(MU, (0.0, 3.0)), expected_values.x[-1])
    assert np.array_equal(propagator.final(MU, (0.0, 3.0)), expected_values.x[-1])


def test_a_step_that_fails_raises_what_integrate_raises():
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=1e3)
    propagator = lt.Propagator(body, lt.MetriplecticRungeKutta(4), 5.0)
    with pytest.raises(lt.NonFiniteError) as expected_values:
        lt.integrate(body, 9.0 * MU, (0.0, 50.0), 5.0, lt.MetriplecticRungeKutta(4))
    with pytest.raises(lt.NonFiniteError) as error:
        propagator.final(9.0 * MU, (0.0, 50.0))
    assert str(error.value) == str(expected_values.value)
    assert str(error.value.solution.status) == str(expected_values.value.solution.status)


def final_states_with(*rates):
    """Return final states with values of the rate of dissipation, one after another."""
    propagator = lt.Propagator(rigid_body(), None, 0.1)
    return [propagator.final(MU, SPAN, parameters={"dissipation.rate": rate}) for rate in rates]


test_bad_arguments = refusal_test(
    (lambda: lt.Propagator(rigid_body(), "RK4", 0.1), "method must be an integrator"),
    (lambda: lt.Propagator("body", None, 0.1), "the first argument must be a system"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1, engine="gpu"), "engine must be"),
    (lambda: lt.Propagator(rigid_body(), lt.Reference(), lt.Adaptive(1e-8)), "Reference chooses its own steps"),
    (lambda: lt.Propagator(rigid_body(), None, -0.1), "step must be positive"),
    (lambda: lt.Propagator(rigid_body(), None, None), "step must be a number, got None"),
    (lambda: lt.Propagator(rigid_body(), None, "0.1"), "step must be a number, got '0.1'"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1).final(MU, (1.0, 0.0)), "t_span must be finite and increasing"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1).final(MU[:2], SPAN), "a state of this system must have shape"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1).final(MU * np.nan, SPAN), "the state is not finite"),
    (lambda: lt.Propagator(rigid_body(), lt.Reference(), 0.1).many(MU, SPAN), "runs single trajectories"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1).final(MU, SPAN, parameters=0.3), "must be a dict from names"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1)(MU, SPAN, parameters=[0.3]), "must be a dict from names"),
    (lambda: final_states_with(0.3, "0.3"), r"dissipation.rate must be made of real numbers, got '0.3'"),
    (lambda: final_states_with("a"), r"dissipation.rate must be made of real numbers, got 'a'"),
    (lambda: lt.Propagator(rigid_body(), None, 0.1)(MU, SPAN, save_at="a"), "save_at must be made of real numbers"),
)


def test_what_a_solution_computes_later_is_what_it_would_have_computed_at_once():
    """Casimirs and provenance are computed at their first use, once, and a pickled copy has them."""
    propagator = lt.Propagator(rigid_body(), lt.MetriplecticGauss(2), STEP)
    solution, read_first = propagator(MU, SPAN), propagator(MU, SPAN)
    assert read_first.casimirs is read_first.casimirs
    copy = pickle.loads(pickle.dumps(solution))
    for name, series in read_first.casimirs.items():
        assert np.array_equal(copy.casimirs[name], series)
        assert np.array_equal(solution.casimirs[name], series)
    entries = {name: value for name, value in read_first.provenance.items() if name != "date"}
    assert {name: value for name, value in copy.provenance.items() if name != "date"} == entries
    assert dataclasses.replace(solution, t=solution.t + 1.0).provenance["step"] == STEP


def test_runs_of_one_problem_do_not_share_what_they_return():
    propagator = lt.Propagator(rigid_body(), lt.MetriplecticGauss(2), STEP)
    first = propagator(MU, SPAN)
    x, t, final_state = first.x.copy(), first.t.copy(), propagator.final(MU, SPAN).copy()
    second = propagator(-2.0 * np.asarray(MU), SPAN)
    second.t[:], second.x[:] = 0.0, 0.0
    assert np.array_equal(first.x, x)
    assert np.array_equal(propagator(MU, SPAN).t, t)
    assert np.array_equal(propagator.final(MU, SPAN), final_state)
    assert first.audit().passed


@pytest.mark.slow
def test_a_run_that_fell_back_is_told_each_time():
    """The array engine takes over in every run of such a system, and every run says so."""
    unsupported = lambda m: jnp.sum(jnp.array([1.0, 2.0, 3.0]) * m**2) / 2 + 0.0 * jnp.sum(jnp.fft.fft(m).real)  # noqa: E731
    system = lt.LiePoissonSystem(mf.so(3), unsupported)
    propagator = lt.Propagator(system, lt.MetriplecticMidpoint(), STEP)
    for _ in range(2):
        with pytest.warns(CompiledEngineWarning, match="array engine"):
            assert propagator(MU, SPAN).provenance["engine"] == "array"


def test_what_is_conserved_is_found_once_for_each_set_of_parameters(monkeypatch):
    """The verdicts on one system with new parameters are kept, and serve all that need the same program."""
    p = lt.Propagator(lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), lt.MetriplecticRungeKutta(4), step=0.5)
    tested = []
    find_verdicts = invariants._conservation_verdicts
    monkeypatch.setattr(
        invariants, "_conservation_verdicts", lambda system, near=None: tested.append(1) or find_verdicts(system, near)
    )
    for rate in (0.11, 0.12, 0.13):
        p.final([0.1, 0.2, 1.0], (0.0, 2.0), parameters={"dissipation.rate": rate})
    assert len(tested) == 1
    for rate in (0.11, 0.12, 0.13):
        p([0.1, 0.2, 1.0], (0.0, 2.0), parameters={"dissipation.rate": rate})
    assert len(tested) == 3


def test_propagators_of_other_steps_do_not_share_a_schedule():
    body, x0, span = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), [0.1, 0.2, 1.0], (0.0, 1.0)
    for step, n_times, n_times_of_every_second in ((0.5, 3, 2), (0.25, 5, 3), (1, 2, 2), (0.5, 3, 2)):
        assert len(lt.Propagator(body, None, step)(x0, span).t) == n_times
        assert len(lt.integrate(body, x0, span, step, save_every=2).t) == n_times_of_every_second
    for invalid_step in ("half", None, -0.5):
        with pytest.raises(lt.InputError, match="step must be"):
            lt.integrate(body, x0, span, invalid_step)
    adaptive = lt.integrate(body, x0, span, lt.Adaptive(1e-6))
    assert len(lt.integrate(body, x0, span, lt.Adaptive(1e-9)).t) > len(adaptive.t)
