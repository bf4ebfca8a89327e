"""Programs translated to LLVM instructions mean what they mean to NumPy, in every lane."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liethermo.engines.compiled.straight_line import OF_NUMBERS, OF_TESTS, TESTS, is_plain, straight_line
from liethermo.tracing.primitives import Instruction
from liethermo.tracing.scalarize import Program
from tests.liethermo.tracing.test_scalarize import STEPS, program_of, shapes, steps

LANES = 3


def translation(program: Program, *sizes: int):
    """The program as a function of arrays, each with LANES as the first axis; compiled once."""
    outputs = [len(entries) for entries in program.outputs]
    sources = [f"w[{LANES * i} + l]" for i in range(sum(sizes))]
    targets = [f"w[{LANES * (sum(sizes) + i)} + l]" for i in range(sum(outputs))]
    function = straight_line("\n".join(program.body(sources, targets)), looped=True)
    run = numba.njit(error_model="numpy")(lambda p, w, first, last: function(p, w, first, last))

    def call(*arrays):
        w = np.zeros((sum(sizes) + sum(outputs), LANES))
        w[: sum(sizes)] = np.concatenate([a.reshape(LANES, -1) for a in arrays], axis=1).T
        run(np.zeros(1), w.reshape(-1), 0, LANES)
        results = np.split(w[sum(sizes) :].T, np.cumsum(outputs)[:-1], axis=1)
        return [r.reshape(LANES, *shape) for r, shape in zip(results, program.shapes, strict=True)]

    return call


def same(a, b):
    np.testing.assert_allclose(a, b, rtol=2e-15, atol=0.0, equal_nan=True)
    assert np.array_equal(np.signbit(a)[~np.isnan(a)], np.signbit(b)[~np.isnan(b)])


def test_every_operation_at_every_kind_of_number():
    instructions, results = [], []
    for op in sorted(OF_NUMBERS | TESTS):
        pair = op in {"add", "sub", "mul", "div", "pow", "rem", "max", "min"} or op in TESTS - {"is_finite"}
        instructions.append(Instruction(f"is_{op}", op, ("a", "b") if pair else ("a",)))
        if op in TESTS:
            instructions.append(Instruction(f"number_{op}", "float", (f"is_{op}",)))
        results.append(f"number_{op}" if op in TESTS else f"is_{op}")
    for op in sorted(OF_TESTS):
        instructions.append(Instruction(f"is_{op}", op, ("is_lt",) if op == "not" else ("is_lt", "is_eq")))
        instructions.append(Instruction(f"number_{op}", "select", (f"is_{op}", "b", 0.25)))
        results.append(f"number_{op}")
    program = Program((("a",), ("b",)), tuple(instructions), (tuple(results),), ((len(results),),))
    assert is_plain(program)
    special = np.array([0.0, -0.0, 1.0, -1.5, 2.5, 0.3, -3.7, np.inf, -np.inf, np.nan, 1e300])
    grid = np.stack([x.ravel() for x in np.meshgrid(special, special)])
    grid = np.concatenate([grid, grid[:, : -grid.shape[1] % LANES]], axis=1)
    rows = grid.reshape(2, -1, LANES)
    function = translation(program, 1, 1)
    for a, b in rows.swapaxes(0, 1)[..., None]:
        same(*function(a, b), *program.evaluate(a, b, batch=True))


@settings(max_examples=12)
@given(st.lists(steps, min_size=1, max_size=7), shapes, shapes, st.integers(0, 99))
def test_random_programs_agree(chosen, shape_x, shape_y, seed):
    def run(x, y):
        values = [x, y]
        for name, i, j, k in chosen:
            values.append(STEPS[name](values[-1 - i % len(values)], values[-1 - j % len(values)], k))
        return values[2:]

    random = np.random.default_rng(seed)
    x, y = (random.uniform(-1.5, 1.5, (LANES, *shape)) for shape in (shape_x, shape_y))
    program = program_of(run, x[0], y[0])
    if not is_plain(program):
        return
    function = translation(program, x[0].size, y[0].size)
    for seen, found in zip(function(x, y), program.evaluate(x, y, batch=True), strict=True):
        np.testing.assert_allclose(seen, found, rtol=1e-12, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize(
    ("op", "args"),
    [("erf", ("a",)), ("int", ("a",)), ("add", ("a", 1)), ("and", ("a", "a")), ("select", ("a", "a", "a"))],
)
def test_what_is_left_to_numba(op, args):
    """Other operations, integers, and truth values out of place."""
    assert not is_plain(Program((("a",),), (Instruction("t", op, args),), (("t",),), ((1,),)))
