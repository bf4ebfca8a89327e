"""Names of the parameters of systems, and systems with other values of them."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.runs.named_parameters import named_parameters, replace_parameters
from tests.liethermo.systems.qubits import qubit

MOMENTS = np.array([3.0, 2.0, 1.0])
START = [0.1, 0.5, 0.6]
SPAN = (0.0, 5.0)


def body_with_bath(moments=MOMENTS, rate=0.1, capacity=2.0, temperature=1.0) -> lt.System:
    bath = lt.HeatBaths(capacity, temperature)
    return lt.LiePoissonSystem(mf.so(3), energy_of(moments), dissipation=lt.DoubleBracket(rate), baths=bath)


def energy_of(moments) -> lt.Energy:
    return lt.Quadratic(1.0 / moments if np.ndim(moments) == 1 else np.linalg.inv(moments))


def last_state(system) -> np.ndarray:
    return lt.integrate(system, system.state([*START, 0.0][: system.dim]), SPAN, 0.1).x[-1]


def model_functions() -> list[str]:
    """Return the names of the functions for ready systems whose arguments all have defaults."""
    functions = {name: getattr(lt.models, name) for name in lt.models.__all__}
    return sorted(
        name
        for name, function in functions.items()
        if inspect.isfunction(function)
        and all(argument.default is not argument.empty for argument in inspect.signature(function).parameters.values())
    )


def model(name: str) -> lt.System:
    system = getattr(lt.models, name)()
    if not isinstance(system, lt.System):
        pytest.skip("no system")
    return system


# -- names --------------------------------------------------------------------------------------------------------


def test_names_do_not_depend_on_a_bath():
    free_body = lt.LiePoissonSystem(mf.so(3), energy_of(MOMENTS), dissipation=lt.DoubleBracket(0.1))
    assert set(named_parameters(free_body)) == {"energy.inertia", "energy.c", "dissipation.rate"}
    assert set(named_parameters(body_with_bath())) - set(named_parameters(free_body)) == {
        "baths.capacity",
        "baths.temperature",
    }
    assert "baths.temperature" in named_parameters(body_with_bath(capacity=np.inf))


def test_names_do_not_depend_on_a_torque_or_an_attitude():
    body = lt.models.rigid_body()
    turning_body = lt.models.rigid_body(attitude=True, torque=lambda t, m: -0.1 * m)
    names = {name for name in named_parameters(turning_body) if not name.startswith("torque")}
    assert names == set(named_parameters(body))


@pytest.mark.slow
@pytest.mark.parametrize("name", model_functions())
def test_names_of_models_have_no_wrappers(name):
    for parameter in named_parameters(model(name)):
        fields = set(parameter.replace("[", ".[").split("."))
        assert not fields & {"body", "part", "term", "function", "phi", "poisson.first", "momentum_maps", "subsystems"}


@pytest.mark.slow
@pytest.mark.parametrize("name", model_functions())
def test_every_parameter_of_a_model_keeps_the_laws_and_has_an_effect(name):
    """A parameter that is kept in several places changes in all of them: else energy or entropy would break."""
    system = model(name)
    x = jnp.asarray(system.samples(3, seed=1))

    def functions_of(system) -> list[np.ndarray]:
        values = [system.vector_field(x), *(system.energy.value(y) for y in x)]
        values += [system.temperatures(x)] if system.baths.number else []
        return [np.asarray(value) for value in values]

    for parameter, value in named_parameters(system).items():
        if parameter.startswith(("dissipation", "baths", "friction", "lagrangian")) or parameter.endswith("inertia"):
            changed_system = replace_parameters(system, {parameter: 1.03 * value})
            assert changed_system.check().passed, parameter
            pairs = zip(functions_of(system), functions_of(changed_system), strict=True)
            has_no_size = parameter.endswith("axis") or not np.any(value)  # a direction, or zero
            assert any(not np.array_equal(*pair) for pair in pairs) or has_no_size, parameter


# -- values -------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "value", "arguments"),
    [
        ("baths.capacity", [5.0], {"capacity": 5.0}),
        ("baths.temperature", [1.5], {"temperature": 1.5}),
        ("dissipation.rate", 0.3, {"rate": 0.3}),
        ("energy.inertia", [3.0, 2.5, 1.5], {"moments": np.array([3.0, 2.5, 1.5])}),
    ],
)
def test_a_parameter_by_name_is_that_of_the_constructor(name, value, arguments):
    system, expected = body_with_bath(), last_state(body_with_bath(**arguments))
    start = system.state([*START, 0.0])
    assert not np.array_equal(last_state(system), expected)
    np.testing.assert_array_equal(last_state(replace_parameters(system, {name: value})), expected)
    propagator = lt.Propagator(system, None, 0.1)
    np.testing.assert_array_equal(propagator.final(start, SPAN, parameters={name: value}), expected)
    many = lt.ensemble(system, start, SPAN, 0.1, parameters={name: np.array([value, value])})
    np.testing.assert_allclose(many.x, np.stack([expected, expected]), rtol=1e-14)
    flow = lt.flow(system, start, SPAN, 0.1, parameters={name: jnp.asarray(value)})
    np.testing.assert_allclose(flow, expected, rtol=1e-13)


def test_a_tensor_of_inertia_is_a_parameter():
    tensor = np.array([[3.0, 0.2, 0.0], [0.2, 2.0, 0.1], [0.0, 0.1, 1.5]])
    system = body_with_bath(moments=np.diag(MOMENTS) + 0.1)
    np.testing.assert_allclose(named_parameters(system)["energy.inertia"], np.diag(MOMENTS) + 0.1, rtol=1e-15)
    changed_system = replace_parameters(system, {"energy.inertia": tensor})
    np.testing.assert_allclose(last_state(changed_system), last_state(body_with_bath(moments=tensor)), rtol=1e-13)


def test_paths_of_arrays_are_names_too():
    system = body_with_bath()
    for path in ("dissipation.part.rate", "dissipation.rate"):
        assert float(replace_parameters(system, {path: 0.3}).dissipation.part.rate) == 0.3
    changed_system = replace_parameters(system, {"energy.body.A": 1.0 / np.array([3.0, 2.5, 1.5])})
    np.testing.assert_array_equal(named_parameters(changed_system)["energy.inertia"], [3.0, 2.5, 1.5])


def test_entries_of_a_parameter_are_axes_of_a_study(tmp_path):
    study = lt.Study(
        body_with_bath(),
        {"energy.inertia[1]": [2.0, 2.5], "baths.capacity[0]": [2.0, 5.0]},
        x0=[*START, 0.0],
        t_span=SPAN,
        step=0.1,
        measure={"x": "final"},
    )
    study.run(progress=False)
    for i, moment in enumerate([2.0, 2.5]):
        for j, capacity in enumerate([2.0, 5.0]):
            system = body_with_bath(moments=np.array([3.0, moment, 1.0]), capacity=capacity)
            np.testing.assert_allclose(study.results.x.values[i, j], last_state(system), rtol=1e-13)


# -- bad input ----------------------------------------------------------------------------------------------------


def test_two_names_of_one_parameter_are_refused():
    values = {"energy.inertia": MOMENTS, "energy.body.A": 1.0 / MOMENTS}
    with pytest.raises(lt.InputError, match=r"are the same parameter\. Give one of them"):
        replace_parameters(body_with_bath(), values)


def test_an_unknown_name_lists_those_that_there_are():
    with pytest.raises(lt.InputError, match=r"no parameter 'rate'; .*baths\.capacity.*a function that builds"):
        replace_parameters(body_with_bath(), {"rate": 0.1})


def test_a_lagrangian_that_the_energy_was_computed_from_is_no_parameter():
    with pytest.raises(lt.InputError, match="a function that builds the system"):
        replace_parameters(lt.models.mass_spring_gas(), {"lagrangian.summands[0].A": np.ones(3)})


def test_a_moment_of_zero_is_that_of_a_rod():
    """The rod does not turn about that axis; as a member of a family it ends no other one."""
    system = lt.LiePoissonSystem(mf.so(3), energy_of(MOMENTS), dissipation=lt.DoubleBracket(0.1))
    rod = replace_parameters(system, {"energy.inertia": [0.0, 2.0, 2.0]})
    np.testing.assert_array_equal(rod.energy.A, [0.0, 0.5, 0.5])
    many = lt.ensemble(system, START, SPAN, 0.1, parameters={"energy.inertia": [[0.0, 2.0, 2.0], MOMENTS]})
    np.testing.assert_allclose(many.x[1], last_state(system), rtol=1e-14)


def _friction_system() -> lt.MetriplecticSystem:
    return lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x: 0.5 * (x @ x),
        dissipation=lt.Friction(np.array([[2.0, 1.0], [1.0, 1.0]])),
        baths=lt.HeatBaths(np.inf, 2.0),
    )


def _spin_with_reservoir() -> lt.System:
    return lt.models.single_spin(1.0, 0.5, baths=lt.HeatBaths(np.inf, 1.0))


BODY = lt.models.tumbling_body((3.0, 2.5, 1.5), rate=0.1)
TENSOR = np.array([[2.0, 0.2, 0.0], [0.2, 2.5, 0.0], [0.0, 0.0, 1.5]])

CONDITIONS = {
    "moments": (lambda: BODY, "energy.inertia", [3.0, -2.5, 1.5], "moments of inertia must be positive"),
    "no rod": (lambda: BODY, "energy.inertia", [0.0, 2.5, 1.5], "moments of inertia must be positive"),
    "tensor": (lambda: lt.models.free_rigid_body(TENSOR), "energy.inertia", TENSOR - 2.0, "positive definite"),
    "stiffness": (lt.models.thermoelastic_chain, "energy.summands[1].stiffness", -100.0, "stiffness must be positive"),
    "gas": (lt.models.gas_piston, "energy.summands[4].gas.moles", 0.0, "moles must be positive"),
    "friction of a piston": (lt.models.gas_piston, "dissipation.parts[0].R", [-20.0], "friction must be >= 0"),
    "friction of a spring": (lt.models.mass_spring_gas, "friction.R", [-0.2], "friction must be >= 0"),
    "conductance": (lt.models.thermo_particles, "dissipation.conductance", [-1.0], "a conductance must be >= 0"),
    "bearing": (lt.models.reaction_wheels, "dissipation.friction", [0.1, -0.1, 0.1], "friction must be >= 0"),
    "reservoir": (_spin_with_reservoir, "baths.temperature", [-1.0], "temperature of a bath must be positive"),
    "damping": (_friction_system, "dissipation.D", [[1.0, 2.0], [2.0, 1.0]], "must be symmetric and positive semi"),
    "not symmetric": (_friction_system, "dissipation.D", [[1.0, 0.5], [0.0, 1.0]], "must be symmetric and positive"),
    "jumps": (qubit, "dissipation.rates[0]", -0.1, "rate must be >= 0 and finite"),
}
"""Systems with a parameter, a value that its constructor refuses, and the message."""

PISTON_AT_REST = [0.0, 0.5, 0.0, 0.0, 0.0]


@pytest.mark.sampled("moments", "stiffness", "damping")
@pytest.mark.parametrize("name", CONDITIONS)
def test_values_by_name_meet_the_conditions_of_constructors(name):
    build, parameter, invalid, message = CONDITIONS[name]
    system = build()
    valid = named_parameters(system)[parameter]
    assert np.shape(invalid) == valid.shape
    with pytest.raises(lt.InputError, match=message):
        replace_parameters(system, {parameter: invalid})
    replace_parameters(system, {parameter: valid})
    x0 = PISTON_AT_REST if build is lt.models.gas_piston else np.asarray(system.samples(1, seed=3))[0]
    propagator = lt.Propagator(system, None, 1e-3)
    for call in (
        lambda: propagator.final(x0, (0.0, 2e-3), parameters={parameter: invalid}),
        lambda: lt.flow(system, x0, (0.0, 2e-3), 1e-3, parameters={parameter: invalid}),
    ):
        with pytest.raises(lt.InputError, match=message):
            call()
    many = lt.ensemble(system, x0, (0.0, 2e-3), 1e-3, parameters={parameter: np.array([valid, invalid])})
    assert many.status[0] == 0 != many.status[1]
