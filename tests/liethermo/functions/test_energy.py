"""Energies, conditions on their parameters, and rounding errors of functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.functions.conditions import collect_conditions, condition_message, require_condition
from liethermo.functions.energy import MIN_BUFFERED_DIM, make_energy
from liethermo.functions.rounding import propagated_rounding_scale, value_and_rounding_scale


def test_a_large_gradient_is_buffered_and_has_derivatives():
    """The gradient is stored by a branch, which must not affect batches and derivatives."""
    energy = make_energy(lambda x: jnp.sum(x * jnp.roll(x, 1) ** 2), "the energy")
    x, v = np.random.default_rng(3).standard_normal((2, MIN_BUFFERED_DIM))
    plain_gradient = jax.grad(energy.value)
    assert " cond[" in str(jax.make_jaxpr(energy.gradient)(x))
    assert " cond[" not in str(jax.make_jaxpr(energy.gradient)(x[1:])), "a control: small ones are not"
    np.testing.assert_allclose(
        jax.vmap(energy.gradient)(jnp.stack([x, v])), jax.vmap(plain_gradient)(jnp.stack([x, v])), atol=1e-14
    )
    tangent, expected = (jax.jvp(f, (x,), (v,))[1] for f in (energy.gradient, plain_gradient))
    np.testing.assert_allclose(tangent, expected, atol=1e-13)
    assert np.isnan(energy.gradient(np.append(np.inf, x[1:]))).all()


def failed_messages(build, *arguments):
    """Trace a builder, evaluate the conditions that it records, and return the messages of those that fail."""
    messages = []

    def conditions(*arguments):
        with collect_conditions() as records:
            build(*arguments)
        messages[:] = [condition.message for condition in records]
        return [(condition.holds, condition.value) for condition in records]

    results = jax.jit(conditions)(*map(jnp.asarray, arguments))
    return [
        condition_message(message, value)
        for message, (holds, value) in zip(messages, results, strict=True)
        if not holds
    ]


BUILDERS = {
    "rate": (lambda p: lt.models.rigid_body((3.0, 2.0, 1.5), p), -0.25),
    "inertia": (lambda p: lt.models.rigid_body(jnp.stack([p, 2.0 * p, 1.5 * p])), -1.0),
    "mass": (lambda p: lt.models.damped_oscillator(mass=p), 0.0),
    "matrix": (lambda p: lt.InnerProductDissipation(jnp.diag(jnp.stack([p, 1.0 + p, 1.0]))), -0.5),
}


@pytest.mark.parametrize("name", BUILDERS)
def test_traced_values_fail_with_the_messages_of_concrete_values(name):
    build, bad = BUILDERS[name]
    with pytest.raises(lt.LiethermoError) as error:
        build(jnp.asarray(bad))
    assert str(error.value) in failed_messages(build, bad)
    assert failed_messages(build, 1.0) == []


def test_traced_conditions_are_ignored_outside_of_collect_conditions():
    assert jax.jit(lambda x: require_condition(x, lambda x: x > 0.0, "{value}") or x)(-1.0) == -1.0
    with pytest.raises(lt.InputError, match="not -1"):
        require_condition(np.float64(-1.0), lambda x: x > 0.0, "not {value:g}")


X = np.array([0.5, 2.0])
CASES = {
    "a difference": (lambda x: x[0] - 0.5, 0.5),
    "a sum of large terms": (lambda x: (x[0] + 1e6) - 1e6, 1e6),
    "another unit": (lambda x: 1e-20 * (x[0] - 0.5), 0.5e-20),
    "a steep function": (lambda x: jnp.sqrt(jnp.abs(x[0] - 0.5 + 1e-12)), 0.25e6),
    "a jump": (lambda x: jnp.where(2.0 * x[0] > 1.0, 1.0, -1.0), 0.0),
    "beside a hole": (lambda x: jnp.where(x[0] > 0.5, jnp.nan, x[0] - 0.5), 0.5),
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", CASES)
def test_rounding_scale_of_a_function(name):
    """The scale is right up to a factor, as random errors are between 0.5 and 1."""
    function, scale = CASES[name]
    assert 0.3 * scale <= float(propagated_rounding_scale(function, X, np.abs(X))) <= 3.0 * scale


def test_rounding_scale_of_functions_of_matrices():
    """Eigenvalues are iterated to rounding: what is perturbed is their matrix, and their result."""
    space = mf.SPD(2)
    p = np.asarray(space.random(1))

    def half_squared_distance(x):
        v = space.log(p, x.reshape(2, 2))
        return 0.5 * space.inner(p, v, v)

    for seed in range(2, 6):
        x = np.asarray(space.random(seed)).ravel()
        value, scale = value_and_rounding_scale(half_squared_distance, x)
        assert 0.3 * float(value) <= float(scale) <= 100.0 * float(value)
