"""Branches contain the instructions that only one side of a ``lax.cond`` needs; values do not change."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from liethermo.tracing.branches import MIN_BRANCH_COST, Branch, sink_instructions_into_branches
from tests.liethermo.tracing.test_scalarize import program_of
from tests.machine_code import compile_program

LONG_STEPS = MIN_BRANCH_COST  # of two instructions each


def long_polynomial(x, factor: float):
    """Return a polynomial of x whose instructions cost more than a jump."""
    for i in range(LONG_STEPS):
        x = x * factor + 0.01 * (i + 1)
    return x


def instructions_with_depth(items, depth: int = 0):
    """Yield every instruction with the number of branches around it."""
    for item in items:
        if isinstance(item, Branch):
            yield item.test, depth
            for side in item.sides:
                yield from instructions_with_depth(side, depth + 1)
            yield from ((choice, depth) for choice in item.choices)
        else:
            yield item, depth


def checked_branches(program, **options):
    """Nest the branches of a program; assert that every instruction occurs once and after its arguments."""
    items = sink_instructions_into_branches(program, **options)
    order = [instruction for instruction, _ in instructions_with_depth(items)]
    assert sorted(order) == sorted(program.instructions)
    defined_names = {name for names in program.inputs for name in names}
    for target, _, args in order:
        assert defined_names.issuperset(a for a in args if isinstance(a, str))
        defined_names.add(target)
    return items


def branches(items) -> list[Branch]:
    return [item for item in items if isinstance(item, Branch)]


def count_inside(items) -> int:
    return sum(depth > 0 for _, depth in instructions_with_depth(items))


def test_instructions_of_each_side_are_inside_the_branch():
    def f(x):
        return lax.cond(x[0] > 0.0, lambda x: long_polynomial(x, 0.9), lambda x: long_polynomial(x, 1.1), x)

    items = checked_branches(program_of(f, np.ones(2)))
    (branch,) = branches(items)
    assert [sum(1 for _ in instructions_with_depth(side)) for side in branch.sides] == [4 * LONG_STEPS, 4 * LONG_STEPS]
    assert len(branch.choices) == 2
    assert len(items) < 6, "nothing but the test is outside"


def test_shared_instructions_are_outside_the_branch():
    def f(x):
        shared_work = long_polynomial(x, 0.9)
        result = lax.cond(x > 0.0, lambda: long_polynomial(shared_work, 0.8), lambda: x)
        return result, shared_work

    (branch,) = branches(checked_branches(program_of(f, np.array(1.0))))
    assert (
        sum(1 for _ in instructions_with_depth(branch.sides[0]))
        + sum(1 for _ in instructions_with_depth(branch.sides[1]))
        == 2 * LONG_STEPS
    )


def test_common_work_of_both_sides_needs_no_branch():
    def f(x):
        return lax.cond(x > 0.0, lambda: long_polynomial(x, 0.9), lambda: -long_polynomial(x, 0.9))

    items = checked_branches(program_of(f, np.array(1.0)))
    assert not branches(items)


def test_nested_branches():
    def f(x):
        def middle(y):
            return lax.cond(y < 2.0, lambda y: long_polynomial(y, 0.7), lambda y: y, long_polynomial(y, 0.8))

        return lax.cond(x > 0.0, middle, lambda x: x, x)

    items = checked_branches(program_of(f, np.array(1.0)))
    (outer,) = branches(items)
    (inner_branch,) = [branch for side in outer.sides for branch in branches(side)]
    assert sum(1 for side in inner_branch.sides for _ in side) == 2 * LONG_STEPS


def test_consecutive_branches_are_not_nested():
    """The second branch starts from several results of the first, some of which only the second needs."""

    def f(x):
        state = x, 2.0 * x
        for limit in (0.5, 0.6, 0.7):
            state = lax.cond(
                state[1] > limit, lambda s: (long_polynomial(s[0], 0.9), long_polynomial(s[1], 0.8)), lambda s: s, state
            )
        return state[0]

    items = checked_branches(program_of(f, np.array(1.0)))
    assert len(branches(items)) == 3, "none is inside another"
    assert count_inside(items) == 5 * 2 * LONG_STEPS, "what only a later test needs is still jumped over"


def test_cheap_sides_and_where_make_no_branch():
    short_program = program_of(lambda x: lax.cond(x > 0.0, lambda x: x * 2.0, lambda x: x / 3.0, x), np.array(1.0))
    assert not branches(checked_branches(short_program))
    assert branches(checked_branches(short_program, min_side_cost=1))
    choice = program_of(lambda x: jnp.where(x > 0.0, long_polynomial(x, 0.9), x), np.array(1.0))
    assert not branches(checked_branches(choice, min_side_cost=1))


def test_equal_branches_merge():
    def f(x):
        a, b = (lax.cond(x > 0.0, lambda x: long_polynomial(x, 0.9), lambda x: x, x) for _ in range(2))
        return a, b + 1.0

    (branch,) = branches(checked_branches(program_of(f, np.array(1.0))))
    assert len(branch.choices) == 1


@pytest.mark.parametrize("lanes", [1, 4])
def test_sides_that_a_lane_does_not_choose_do_not_affect_it(lanes):
    """The side is jumped over, or other lanes take it."""

    def f(x):
        return lax.cond(x > 0.0, lambda x: jnp.log(long_polynomial(x, 0.9)), lambda x: x, x), x

    program = program_of(f, np.array(1.0))
    inputs = np.array([1.0, -1e300, -np.inf, np.nan])[:lanes]
    outputs, _ = compile_program(program, lanes)(inputs)
    expected, _ = program.evaluate(inputs, batch=True)
    np.testing.assert_allclose(np.ravel(outputs), np.ravel(expected), rtol=1e-14, equal_nan=True)
    assert np.array_equal(np.ravel(outputs)[1:], inputs[1:], equal_nan=True)


steps = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 5), st.integers(0, 5), st.floats(-1.0, 1.0)), min_size=1, max_size=6
)


def short_branch(a, b):
    return lax.cond(b > 0.1, lambda: long_polynomial(long_polynomial(a, 0.9), 0.5), lambda: a)


def entangled_branches(x, specs):
    """Evaluate branches that start from results of others, are nested, or share sides and results."""
    values = [x[0], x[1], x[2]]
    for kind, i, j, limit in specs:
        a, b = values[-1 - i % len(values)], values[-1 - j % len(values)]
        test = a + 0.3 * b > limit
        if kind == 0:
            values += lax.cond(
                test, lambda a, b: (long_polynomial(a, 0.9), long_polynomial(b, 0.6)), lambda a, b: (b, a), a, b
            )
        elif kind == 1:
            values += [
                lax.cond(test, lambda a, b: long_polynomial(a * b, 0.8), lambda a, b: long_polynomial(a - b, 0.7), a, b)
            ]
        elif kind == 2:
            values += [
                lax.cond(
                    test, lambda a, b: long_polynomial(short_branch(a, b), 0.9), lambda a, b: short_branch(b, a), a, b
                )
            ]
        else:
            values += [jnp.where(test, long_polynomial(a, 0.9), b), a * b]
    return values[3:]


@pytest.mark.slow
@settings(max_examples=25)
@given(steps, st.integers(0, 99))
def test_lanes_of_random_branches_equal_single_runs(specs, seed):
    lanes = 4
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, (lanes, 3))
    program = program_of(lambda x: entangled_branches(x, specs), x[0])
    checked_branches(program)
    lane_outputs, single_outputs = (
        compile_program(program, lanes)(x),
        [compile_program(program)(single) for single in x],
    )
    for i, (lane_output, expected) in enumerate(zip(lane_outputs, program.evaluate(x, batch=True), strict=True)):
        np.testing.assert_allclose(lane_output, expected, rtol=1e-12, atol=1e-13)
        assert np.array_equal(lane_output, [single[i] for single in single_outputs]), "no lane depends on the others"
