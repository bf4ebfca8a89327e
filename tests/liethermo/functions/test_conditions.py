"""Conditions on parameters: checked for concrete values, and re-evaluated at every point of a sweep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.functions.conditions import collect_conditions, refusal_message, require_condition


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
        refusal_message(message, value) for message, (holds, value) in zip(messages, results, strict=True) if not holds
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
