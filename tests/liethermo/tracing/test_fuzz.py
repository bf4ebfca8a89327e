"""Random functions by the scalar compiler and by JAX: a few by default, more in the slow tier and by `make fuzz`."""

import time

import numpy as np
import pytest

import liethermo.tracing.primitives as primitives
from liethermo.tracing.builder import elementwise
from liethermo.tracing.scalarize import CONTROL_FLOW_RULES
from tests import fuzz
from tests.fuzz_operations import OPERATIONS

NOT_DRAWN = {
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


def drawn(seed: int, **options) -> fuzz.Outcome:
    random = np.random.default_rng(seed)
    summary = str(random.choice(list(fuzz.SUMMARIES)))
    function = fuzz.function_of(seed, steps=int(random.integers(1, 6)))
    outcome = fuzz.compared(function, summary, seed, **options)
    assert outcome.kind != "differs", f"{summary} of\n{function.text}\n{outcome.text}"
    return outcome


@pytest.mark.parametrize("seed", range(5))
def test_random_functions(seed):
    drawn(seed, count=3)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(100, 400, 25))
def test_many_random_functions(first):
    kinds = [drawn(seed).kind for seed in range(first, first + 25)]
    assert kinds.count("agrees") > 18


@pytest.mark.slow
def test_functions_that_nobody_has_drawn_yet():
    counts = fuzz.searched(60.0, int(time.time()))
    assert not counts["differs"], "what differs is printed above, with its seed"


@pytest.mark.slow
@pytest.mark.parametrize("name", OPERATIONS)
def test_every_operation_by_itself(name):
    for seed in range(4):
        summary = list(fuzz.SUMMARIES)[seed]
        function = fuzz.function_of(seed, [name], steps=1)
        outcome = fuzz.compared(function, summary, seed)
        assert outcome.kind != "differs", f"{summary} of\n{function.text}\n{outcome.text}"


def test_every_primitive_that_is_claimed_is_drawn():
    claimed = set(primitives.UNROLLING_RULES) | set(CONTROL_FLOW_RULES)
    assert claimed - fuzz.primitives_drawn() == set(NOT_DRAWN)


@pytest.mark.parametrize("name", ["sin", "max"])
def test_a_wrong_rule_is_found(name, monkeypatch):
    """A control."""
    right = primitives.UNROLLING_RULES[name]

    def wrong(b, eqn, *arrays):
        return elementwise(lambda a: b.mul(a, 1.0 + 1e-9), right(b, eqn, *arrays))

    monkeypatch.setitem(primitives.UNROLLING_RULES, name, wrong)
    function = fuzz.function_of(1, [name], steps=1)
    assert fuzz.compared(function, "value", 1, machine_code=False).kind == "differs"
