"""Random functions through the scalar compiler and JAX: a few by default, more in the slow tier and by `make fuzz`."""

import time

import numpy as np
import pytest

import liethermo.tracing.primitives as primitives
from liethermo.tracing.builder import map_elementwise
from liethermo.tracing.scalarize import CONTROL_FLOW_RULES
from tests import fuzz
from tests.fuzz_operations import OPERATIONS

UNDRAWN_PRIMITIVES = {
    "inverse": "the library's own, in Newton's method",
    "deferred": "the library's own, in Newton's method",
    "matrix_chain": "the library's own, of functions of matrices",
    "expand_dims": "lax writes it as broadcast_in_dim",
    "custom_vjp_call": "in test_scalarize",
    "name": "in test_scalarize",
    "empty2": "in test_scalarize",
    **dict.fromkeys(
        "copy_p pjit call closed_call core_call checkpoint remat".split(), "names of other versions of JAX"
    ),
}
"""Supported primitives that no random function uses, with the reason."""


def check_random_function(seed: int, **options) -> fuzz.Outcome:
    rng = np.random.default_rng(seed)
    summary = str(rng.choice(list(fuzz.SUMMARIES)))
    function = fuzz.random_function(seed, steps=int(rng.integers(1, 6)))
    outcome = fuzz.compare_with_jax(function, summary, seed, **options)
    assert outcome.kind != "differs", f"{summary} of\n{function.text}\n{outcome.text}"
    return outcome


@pytest.mark.sampled(3)
@pytest.mark.parametrize("seed", range(5))
def test_random_functions(seed):
    check_random_function(seed, count=3)


@pytest.mark.slow
@pytest.mark.parametrize("first_seed", range(100, 200, 25))
def test_many_random_functions(first_seed):
    kinds = [check_random_function(seed).kind for seed in range(first_seed, first_seed + 25)]
    assert kinds.count("agrees") > 18


@pytest.mark.slow
def test_random_functions_from_a_new_seed():
    counts = fuzz.search_differences(60.0, int(time.time()))
    assert not counts["differs"], "what differs is printed above, with its seed"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "derivative_seed"), [(name, 1 + i % 3) for i, name in enumerate(OPERATIONS)])
def test_every_operation_by_itself(name, derivative_seed):
    """The value of each operation, and one of its derivatives."""
    for seed in (0, derivative_seed):
        summary = list(fuzz.SUMMARIES)[seed]
        function = fuzz.random_function(seed, [name], steps=1)
        outcome = fuzz.compare_with_jax(function, summary, seed)
        assert outcome.kind != "differs", f"{summary} of\n{function.text}\n{outcome.text}"


def test_every_supported_primitive_is_drawn():
    supported_primitives = set(primitives.UNROLLING_RULES) | set(CONTROL_FLOW_RULES)
    assert supported_primitives - fuzz.drawn_primitives() == set(UNDRAWN_PRIMITIVES)


@pytest.mark.parametrize("name", ["sin", "max"])
def test_comparison_detects_a_wrong_rule(name, monkeypatch):
    """Control: a rule with a relative error of 1e-9 is detected."""
    rule = primitives.UNROLLING_RULES[name]

    def wrong_rule(b, eqn, *arrays):
        return map_elementwise(lambda a: b.mul(a, 1.0 + 1e-9), rule(b, eqn, *arrays))

    monkeypatch.setitem(primitives.UNROLLING_RULES, name, wrong_rule)
    function = fuzz.random_function(1, [name], steps=1)
    assert fuzz.compare_with_jax(function, "value", 1, machine_code=False).kind == "differs"
