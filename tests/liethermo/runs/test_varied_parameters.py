"""Parameters that change from call to call of a propagator, as arguments of machine code."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.runs.varied_parameters import VariedParameters

MU = np.array([0.1, 0.2, 1.0])
SPAN = (0.0, 3.0)
STEP = 0.1

METHODS = [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4), lt.MetriplecticTaylor(6)]


def body(A=(1.0, 1.0, 1.0), rate=0.3):
    """An isotropic body conserves |mu|^2 though it relaxes; others do not."""
    entropy = lambda m: jnp.log(1.0 + m @ m)  # noqa: E731
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(A), entropy, lt.KillingDissipation(rate))


def body_with_bath(capacity=5.0, temperature=1.0, rate=0.3):
    baths = lt.HeatBaths(capacity, temperature)
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 2.0]), None, lt.Friction(rate=rate), baths=baths)


@pytest.fixture
def built_systems(monkeypatch):
    """Count the systems that are built for new parameters."""
    built, with_parameters = [], lt.Propagator.with_parameters
    monkeypatch.setattr(
        lt.Propagator, "with_parameters", lambda p, values: built.append(values) or with_parameters(p, values)
    )
    return built


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_values_of_another_symmetry_in_any_order(method):
    generic, isotropic, symmetric = [1.0, 0.5, 2.0], [1.0, 1.0, 1.0], [2.0, 2.0, 1.0]
    expected = {tuple(A): lt.integrate(body(A), MU, SPAN, STEP, method).x[-1] for A in (generic, isotropic, symmetric)}
    for order in ([isotropic, generic, symmetric], [generic, symmetric, isotropic, generic]):
        propagator = lt.Propagator(body(), method, STEP)
        for A in order:
            final = propagator.final(MU, SPAN, parameters={"energy.A": A})
            assert np.array_equal(final, expected[tuple(A)])


def test_control_a_program_that_is_chosen_by_the_first_values_is_wrong(monkeypatch):
    set_values_and_get_program_key = VariedParameters.set_values_and_get_program_key
    monkeypatch.setattr(
        VariedParameters,
        "set_values_and_get_program_key",
        lambda varied, values: set_values_and_get_program_key(varied, values) and b"one",
    )
    propagator, method = lt.Propagator(body(), METHODS[0], STEP), METHODS[0]
    propagator.final(MU, SPAN, parameters={"energy.A": [1.0, 1.0, 1.0]})
    final = propagator.final(MU, SPAN, parameters={"energy.A": [1.0, 0.5, 2.0]})
    assert not np.allclose(final, lt.integrate(body([1.0, 0.5, 2.0]), MU, SPAN, STEP, method).x[-1], rtol=1e-3)


def test_moments_of_inertia_after_those_of_a_sphere():
    propagator = lt.Propagator(lt.models.rigid_body((1.0, 1.0, 1.0), rate=0.2), METHODS[1], STEP)
    for inertia in ((1.0, 1.0, 1.0), (1.0, 2.0, 3.0), (1.0, 1.0, 1.0), (2.0, 2.0, 1.0)):
        other = lt.models.rigid_body(inertia, rate=0.2)
        expected = lt.integrate(other, MU, SPAN, STEP, METHODS[1]).x[-1]
        assert np.array_equal(propagator.final(MU, SPAN, parameters={"energy.inertia": inertia}), expected)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_rates_of_zero_and_rates_that_nearly_are(method):
    propagator = lt.Propagator(body((1.0, 0.5, 2.0)), method, STEP)
    for rate in (0.3, 0.0, 1e-300, 1e-14, 0.0, 0.4):
        expected = lt.integrate(body((1.0, 0.5, 2.0), rate), MU, SPAN, STEP, method).x[-1]
        assert np.array_equal(propagator.final(MU, SPAN, parameters={"dissipation.rate": rate}), expected)


def test_values_near_the_tolerance_of_the_test_of_conservation(built_systems):
    """A call leaves the decision to a run where machine code and NumPy could decide differently."""
    propagator, method = lt.Propagator(body(), METHODS[1], STEP), METHODS[1]
    for difference in np.geomspace(1e-16, 1.0, 33):
        A = [1.0, 1.0, 1.0 + difference]
        expected = lt.integrate(body(A), MU, SPAN, STEP, method).x[-1]
        assert np.array_equal(propagator.final(MU, SPAN, parameters={"energy.A": A}), expected)
    assert 20 < len(built_systems) < 30


def test_no_system_is_built_for_values_that_need_the_same_program(built_systems):
    rates = np.linspace(0.1, 0.5, 20)
    propagator = lt.Propagator(lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), METHODS[1], STEP)
    finals = [propagator.final(MU, SPAN, parameters={"dissipation.rate": rate}) for rate in rates]
    assert len(built_systems) == 2  # to see whether the parameters can be arguments, and to compile the program
    for rate, final in zip(rates[::7], finals[::7], strict=True):
        assert np.array_equal(final, propagator(MU, SPAN, parameters={"dissipation.rate": rate}).x[-1])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS[:2], ids=str)
def test_baths_of_other_capacities_and_temperatures(method):
    x0, propagator = np.append(MU, 0.3), lt.Propagator(body_with_bath(), method, STEP)
    for capacity, temperature in ((5.0, 1.0), (50.0, 1.0), (0.5, 2.0), (5.0, 0.3)):
        parameters = {"baths.capacity": [capacity], "baths.temperature": [temperature]}
        other = body_with_bath(capacity, temperature)
        assert np.array_equal(
            propagator.final(x0, SPAN, parameters=parameters), lt.integrate(other, x0, SPAN, STEP, method).x[-1]
        )


CASES = {
    "attitude": (
        lambda: lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2, attitude=True),
        MU,
        {"energy.inertia": [[1.0, 1.0, 1.0], [1.0, 2.0, 3.0]], "dissipation.rate": [0.0, 0.1]},
    ),
    "torque": (
        lambda: lt.LiePoissonSystem(
            mf.so(3),
            lt.Quadratic([1.0, 0.5, 2.0]),
            lt.Quadratic([2.0, 2.0, 2.0]),
            lt.ProjectedMetric(rate=0.3),
            torque=lambda t, m: jnp.array([jnp.cos(t), 0.0, 0.1]),
        ),
        MU,
        {"energy.A": [[1.0, 1.0, 1.0], [1.0, 2.0, 3.0]], "dissipation.rate": [0.0, 0.1]},
    ),
    "spin": (lambda: lt.models.single_spin(1.0, 0.5), MU, {"energy.b": [[0.0, 0.0, 1.0], [1.0, 0.0, 2.0]]}),
    "gas": (lt.models.mass_spring_gas, np.array([1.2, 0.1, 1.0]), {"friction.R": [[0.0], [0.3]]}),
}


UNUSUAL_VALUES = {
    "slender rods": (
        lambda: lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2),
        MU,
        {"energy.inertia": [[0.0, 1.0, 1.0], [1.0, 1.0, 2.0], [1.0, 1.0, 0.0]]},
    ),
    "tensors": (
        lambda: lt.models.rigid_body(np.diag([3.0, 2.0, 1.0]) + 0.1, rate=0.2),
        MU,
        {"energy.inertia": [np.eye(3), np.diag([3.0, 2.0, 1.0]), np.diag([3.0, 2.0, 1.0]) + 0.2]},
    ),
    "negative": (lambda: lt.models.rigid_body((3.0, 2.0, 1.0)), MU, {"dissipation.rate": [-0.1, -0.0, 0.1]}),
    "temperature of zero": (body_with_bath, np.append(MU, 0.3), {"baths.temperature": [[0.0], [1.0], [-1.0]]}),
    "capacity of infinity": (body_with_bath, np.append(MU, 0.3), {"baths.capacity": [[np.inf], [0.5], [1.0]]}),
}


def state_or_error(propagator, x0, parameters, is_run):
    """Return the last state, or the text of the error."""
    try:
        run = propagator.with_parameters(parameters) if is_run else propagator
        return run(x0, SPAN).x[-1] if is_run else run.final(x0, SPAN, parameters=parameters)
    except lt.LiethermoError as error:
        return str(error)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", UNUSUAL_VALUES)
@pytest.mark.parametrize("method", METHODS[:2], ids=str)
def test_unusual_values_give_the_states_and_the_errors_of_runs(name, method):
    build, x0, values_by_name = UNUSUAL_VALUES[name]
    propagator = lt.Propagator(build(), method, STEP)
    for parameter, values in values_by_name.items():
        for value in (*values, *values[::-1]):
            expected = state_or_error(lt.Propagator(build(), method, STEP), x0, {parameter: value}, is_run=True)
            final = state_or_error(propagator, x0, {parameter: value}, is_run=False)
            assert np.array_equal(final, expected)


def test_a_method_that_preserves_functions_and_a_copy_for_another_process():
    body_without_entropy = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 2.0]))
    method = lt.MetriplecticGauss(2, preserve=[lt.Quadratic([2.0, 2.0, 2.0])])
    propagator = lt.Propagator(body_without_entropy, method, STEP)
    for p in (propagator, pickle.loads(pickle.dumps(propagator))):
        for A in ([1.0, 0.5, 2.0], [3.0, 0.5, 0.1]):
            expected = propagator(MU, SPAN, parameters={"energy.A": A}).x[-1]
            assert np.array_equal(p.final(MU, SPAN, parameters={"energy.A": A}), expected)
            assert np.array_equal(p.final(list(MU), list(SPAN), parameters={"energy.A": A}), expected)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("method", METHODS[:2], ids=str)
def test_final_states_are_those_of_runs(name, method):
    build, x0, parameters = CASES[name]
    system = build()
    propagator = lt.Propagator(system, method, STEP)
    for parameter, values in parameters.items():
        for value in (*values, *values[::-1]):
            expected = propagator(x0, SPAN, parameters={parameter: value}).x[-1]
            assert np.array_equal(propagator.final(x0, SPAN, parameters={parameter: value}), expected)


def test_threads_have_parameters_of_their_own():
    propagator = lt.Propagator(lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), METHODS[0], STEP)
    rates = np.linspace(0.05, 0.5, 200)
    expected = [propagator.final(MU, SPAN, parameters={"dissipation.rate": rate}) for rate in rates]
    with ThreadPoolExecutor(4) as pool:
        finals = pool.map(lambda rate: propagator.final(MU, SPAN, parameters={"dissipation.rate": rate}), rates)
        assert np.array_equal(list(finals), expected)
    assert len(np.unique(np.asarray(expected)[:, 2])) == len(rates)
    assert np.array_equal(propagator.final(MU, SPAN), lt.integrate(propagator.system, MU, SPAN, STEP, METHODS[0]).x[-1])


def test_values_that_cannot_be_used_are_refused():
    propagator = lt.Propagator(lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), METHODS[0], STEP)
    for _ in range(2):
        propagator.final(MU, SPAN, parameters={"dissipation.rate": 0.3})
        with pytest.raises(lt.InputError, match=r"dissipation\.rate must have shape \(\), got \(2,\)"):
            propagator.final(MU, SPAN, parameters={"dissipation.rate": [0.7, 0.1]})
        with pytest.raises(lt.InputError, match="moments of inertia must be positive and finite, got"):
            propagator.final(MU, SPAN, parameters={"energy.inertia": [np.nan, 2.0, 1.0]})
        with pytest.raises(lt.InputError, match="a dissipation rate must be >= 0 and finite, got nan"):
            propagator.final(MU, SPAN, parameters={"dissipation.rate": np.nan})
        with pytest.raises(lt.InputError, match="a state of this system must have shape"):
            propagator.final(MU[:2], SPAN, parameters={"dissipation.rate": 0.4})
        with pytest.raises(lt.InputError, match="the state is not finite"):
            propagator.final(MU * np.nan, SPAN, parameters={"dissipation.rate": 0.4})
