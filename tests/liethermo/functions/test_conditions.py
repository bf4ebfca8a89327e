"""Conditions on parameters: refused where they are numbers, found again at every point where they are swept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.functions.conditions import collect_conditions, refusal_message, require_condition


def found(build, *arguments):
    """The conditions that a builder notes while it is traced, evaluated, and the messages of those that fail."""
    messages = []

    def conditions(*arguments):
        with collect_conditions() as noted:
            build(*arguments)
        messages[:] = [condition.message for condition in noted]
        return [(condition.holds, condition.value) for condition in noted]

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
def test_what_is_refused_as_a_number_is_noted_in_the_same_words_where_it_is_traced(name):
    build, bad = BUILDERS[name]
    with pytest.raises(lt.LiethermoError) as refused:
        build(jnp.asarray(bad))
    assert str(refused.value) in found(build, bad)
    assert found(build, 1.0) == []


def test_nothing_is_noted_where_nobody_listens():
    assert jax.jit(lambda x: require_condition(x, lambda x: x > 0.0, "{value}") or x)(-1.0) == -1.0
    with pytest.raises(lt.InputError, match="not -1"):
        require_condition(np.float64(-1.0), lambda x: x > 0.0, "not {value:g}")
