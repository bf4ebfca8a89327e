"""What one side of a ``lax.cond`` alone needs stands inside it, and nothing else does; numbers stay as they are."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from liethermo.tracing.branches import MIN_BRANCH_COST, Branch, nest_branches
from tests.liethermo.tracing.test_scalarize import program_of
from tests.machine_code import compiled

TURNS = MIN_BRANCH_COST  # of two instructions each


def long(x, factor: float):
    """Work that takes more instructions than a jump is worth."""
    for i in range(TURNS):
        x = x * factor + 0.01 * (i + 1)
    return x


def inside(items, depth: int = 0):
    """Every instruction, and how many branches it is in."""
    for item in items:
        if isinstance(item, Branch):
            yield item.test, depth
            for side in item.sides:
                yield from inside(side, depth + 1)
            yield from ((choice, depth) for choice in item.choices)
        else:
            yield item, depth


def ordered(program, **options):
    """The branches of a program; checks that every instruction is there once and after what it depends on."""
    items = nest_branches(program, **options)
    order = [instruction for instruction, _ in inside(items)]
    assert sorted(order) == sorted(program.instructions)
    known = {name for names in program.inputs for name in names}
    for target, _, args in order:
        assert known.issuperset(a for a in args if isinstance(a, str))
        known.add(target)
    return items


def branches(items) -> list[Branch]:
    return [item for item in items if isinstance(item, Branch)]


def size(items) -> int:
    return sum(depth > 0 for _, depth in inside(items))


def test_each_side_stands_inside():
    def f(x):
        return lax.cond(x[0] > 0.0, lambda x: long(x, 0.9), lambda x: long(x, 1.1), x)

    items = ordered(program_of(f, np.ones(2)))
    (branch,) = branches(items)
    assert [sum(1 for _ in inside(side)) for side in branch.sides] == [4 * TURNS, 4 * TURNS]
    assert len(branch.choices) == 2
    assert len(items) < 6, "nothing but the test is outside"


def test_what_is_needed_elsewhere_stands_outside():
    def f(x):
        shared = long(x, 0.9)
        chosen = lax.cond(x > 0.0, lambda: long(shared, 0.8), lambda: x)
        return chosen, shared

    (branch,) = branches(ordered(program_of(f, np.array(1.0))))
    assert sum(1 for _ in inside(branch.sides[0])) + sum(1 for _ in inside(branch.sides[1])) == 2 * TURNS


def test_what_both_sides_compute_stands_outside():
    def f(x):
        return lax.cond(x > 0.0, lambda: long(x, 0.9), lambda: -long(x, 0.9))

    items = ordered(program_of(f, np.array(1.0)))
    assert not branches(items)


def test_one_branch_inside_another():
    def f(x):
        def middle(y):
            return lax.cond(y < 2.0, lambda y: long(y, 0.7), lambda y: y, long(y, 0.8))

        return lax.cond(x > 0.0, middle, lambda x: x, x)

    items = ordered(program_of(f, np.array(1.0)))
    (outer,) = branches(items)
    (inner,) = [branch for side in outer.sides for branch in branches(side)]
    assert sum(1 for side in inner.sides for _ in side) == 2 * TURNS


def test_one_branch_after_another():
    """The second starts from several results of the first, some of which only it needs."""

    def f(x):
        state = x, 2.0 * x
        for limit in (0.5, 0.6, 0.7):
            state = lax.cond(state[1] > limit, lambda s: (long(s[0], 0.9), long(s[1], 0.8)), lambda s: s, state)
        return state[0]

    items = ordered(program_of(f, np.array(1.0)))
    assert len(branches(items)) == 3, "none is inside another"
    assert size(items) == 5 * 2 * TURNS, "what only a later test needs is still jumped over"


def test_short_work_is_not_worth_a_jump_and_a_choice_is_no_branch():
    short = program_of(lambda x: lax.cond(x > 0.0, lambda x: x * 2.0, lambda x: x / 3.0, x), np.array(1.0))
    assert not branches(ordered(short))
    assert branches(ordered(short, min_instructions=1))
    choice = program_of(lambda x: jnp.where(x > 0.0, long(x, 0.9), x), np.array(1.0))
    assert not branches(ordered(choice, min_instructions=1))


def test_equal_branches_are_one():
    def f(x):
        one, other = (lax.cond(x > 0.0, lambda x: long(x, 0.9), lambda x: x, x) for _ in range(2))
        return one, other + 1.0

    (branch,) = branches(ordered(program_of(f, np.array(1.0))))
    assert len(branch.choices) == 1


@pytest.mark.parametrize("lanes", [1, 4])
def test_what_a_lane_does_not_choose_it_does_not_see(lanes):
    """Where a side is jumped over, and where other lanes take it."""

    def f(x):
        return lax.cond(x > 0.0, lambda x: jnp.log(long(x, 0.9)), lambda x: x, x), x

    program = program_of(f, np.array(1.0))
    given = np.array([1.0, -1e300, -np.inf, np.nan])[:lanes]
    found, _ = compiled(program, lanes)(given)
    expected, _ = program.evaluate(given, batch=True)
    np.testing.assert_allclose(np.ravel(found), np.ravel(expected), rtol=1e-14, equal_nan=True)
    assert np.array_equal(np.ravel(found)[1:], given[1:], equal_nan=True)


steps = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 5), st.integers(0, 5), st.floats(-1.0, 1.0)), min_size=1, max_size=6
)


def inner(a, b):
    return lax.cond(b > 0.1, lambda: long(long(a, 0.9), 0.5), lambda: a)


def tangled(x, chosen):
    """Branches that start from the results of others, alone, in one another, with sides and results in common."""
    values = [x[0], x[1], x[2]]
    for kind, i, j, limit in chosen:
        a, b = values[-1 - i % len(values)], values[-1 - j % len(values)]
        test = a + 0.3 * b > limit
        if kind == 0:
            values += lax.cond(test, lambda a, b: (long(a, 0.9), long(b, 0.6)), lambda a, b: (b, a), a, b)
        elif kind == 1:
            values += [lax.cond(test, lambda a, b: long(a * b, 0.8), lambda a, b: long(a - b, 0.7), a, b)]
        elif kind == 2:
            values += [lax.cond(test, lambda a, b: long(inner(a, b), 0.9), lambda a, b: inner(b, a), a, b)]
        else:
            values += [jnp.where(test, long(a, 0.9), b), a * b]
    return values[3:]


@settings(max_examples=25)
@given(steps, st.integers(0, 99))
def test_random_branches_mean_the_same_in_every_lane(chosen, seed):
    lanes = 4
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, (lanes, 3))
    program = program_of(lambda x: tangled(x, chosen), x[0])
    ordered(program)
    together, alone = compiled(program, lanes)(x), [compiled(program)(own) for own in x]
    for i, (seen, right) in enumerate(zip(together, program.evaluate(x, batch=True), strict=True)):
        np.testing.assert_allclose(seen, right, rtol=1e-12, atol=1e-13)
        assert np.array_equal(seen, [own[i] for own in alone]), "no lane depends on its neighbours"
