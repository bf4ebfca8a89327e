"""Machine code computes what NumPy computes, in every lane; it is unloaded, and found on disk."""

import gc
import itertools
import platform

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from llvmlite import binding as llvm
from llvmlite import ir

from liethermo.engines.compiled import machine_code
from liethermo.engines.compiled.llvm_writer import FLOAT64, ProgramWriter
from liethermo.engines.compiled.machine_code import MachineCode
from liethermo.tracing.builder import BOOLEAN_OPERATIONS, COMPARISONS, OPERATIONS, Instruction
from liethermo.tracing.program import Program
from liethermo.tracing.scalarize import UnsupportedPrimitive, scalarize
from tests.machine_code import compile_program as compiled
from tests.machine_code import count_memory_maps as memory_maps
from tests.scalar_programs import program_of

BINARY_OPERATIONS = {*"add sub mul div pow rem max min atan2 igamma igammac".split(), *COMPARISONS - {"is_finite"}}
"""Operations on two numbers."""

SPECIAL_NUMBERS = np.array([0.0, -0.0, 1.0, -1.5, 2.5, 0.3, -3.7, np.inf, -np.inf, np.nan, 1e300, 1e-300])
"""Ordinary and special numbers."""

NUMBER_PAIRS = np.array(list(itertools.product(SPECIAL_NUMBERS, SPECIAL_NUMBERS)))
"""All pairs of these numbers, shape (pairs, 2)."""


def single_operation_program(op: str) -> Program:
    """Return a program that applies one operation to two numbers."""
    operand_instructions = [Instruction("p", "lt", ("a", "b")), Instruction("q", "gt", ("a", 0.5))]
    if op in BOOLEAN_OPERATIONS:
        other_operands = {"not": (), "branch": (0,)}.get(op, ("q",))
        tested_instruction = [Instruction("t", op, ("p", *other_operands))]
    elif op == "select":
        tested_instruction = [Instruction("t", op, ("p", "a", "b"))]
    elif op in ("float", "int"):
        tested_instruction = [Instruction("t", op, ("p",))]
    elif op in ("quotient", "wrap"):
        operand_instructions += [Instruction("i", "truncate", ("a",)), Instruction("j", "truncate", ("b",))]
        tested_instruction = [Instruction("t", op, ("i", "j") if op == "quotient" else ("i", 8, True))]
    elif op == "pick":
        operand_instructions += [Instruction("i", "truncate", ("a",))]
        tested_instruction = [Instruction("t", op, ("i", "a", "b", 0.5, "a", "b"))]
    elif op == "regularized_incomplete_beta":
        tested_instruction = [Instruction("t", op, ("a", "b", 0.3))]
    else:
        tested_instruction = [Instruction("t", op, ("a", "b") if op in BINARY_OPERATIONS else ("a",))]
    return Program((("a",), ("b",)), (*operand_instructions, *tested_instruction), (("t",),), ((1,),))


@pytest.mark.parametrize("lanes", [1, 4])
@pytest.mark.parametrize(
    "op", sorted(set(OPERATIONS) - {"item", "table", "column", "lookup"})
)  # those belong to blocks
def test_every_operation_at_every_kind_of_number(op, lanes):
    program = single_operation_program(op)
    function = compiled(program, lanes)
    for a, b in NUMBER_PAIRS.reshape(-1, lanes, 2).swapaxes(1, 2):
        (result,), (expected,) = function(a, b), program.evaluate(a, b, batch=True)
        np.testing.assert_allclose(np.ravel(result), np.ravel(expected).astype(float), rtol=4e-15, equal_nan=True)
        is_number = ~np.isnan(np.ravel(expected).astype(float))
        if expected.dtype.kind == "f" and op not in ("max", "min", "sign"):  # the zeros of those may have either sign
            assert np.array_equal(np.signbit(np.ravel(result))[is_number], np.signbit(np.ravel(expected))[is_number])


@pytest.mark.parametrize("lanes", [1, 4])
def test_comparisons_of_truth_values_and_of_integers(lanes):
    """Comparisons of truth values take true, which is one bit, as greater than false."""
    tests = sorted(COMPARISONS - {"is_finite"})
    operand_instructions = [Instruction("p", "lt", ("a", "b")), Instruction("q", "gt", ("a", 0.5))]
    operand_instructions += [Instruction("i", "truncate", ("a",)), Instruction("j", "truncate", ("b",))]
    comparisons = [Instruction(x + op, op, (x, y)) for op in tests for x, y in ("pq", "ij")]
    names = tuple(instruction.target for instruction in comparisons)
    program = Program((("a",), ("b",)), (*operand_instructions, *comparisons), (names,), ((len(names),),))
    function, finite_pairs = compiled(program, lanes), NUMBER_PAIRS[np.abs(NUMBER_PAIRS).max(axis=1) < 1e6]
    for a, b in finite_pairs[: len(finite_pairs) // lanes * lanes].reshape(-1, lanes, 2).swapaxes(1, 2):
        (result,), (expected,) = function(a, b), program.evaluate(a, b, batch=True)
        np.testing.assert_array_equal(result.reshape(expected.shape), expected)


def test_products_in_sums_are_the_same_in_every_lane():
    """Fused products are rounded equally in a single run and in every lane."""

    def run(a):
        x, y, z = a
        return x * y + z, z - x * y, x * y - z, x * y - z * x, -(x * y) + z, (x * y - z) + x * y

    program, lanes = program_of(run, np.ones(3)), 4
    single_function, lane_function = compiled(program), compiled(program, lanes)
    inputs = np.random.default_rng(0).uniform(-1.0, 1.0, (100, lanes, 3))
    for a in inputs:
        rows = [np.concatenate([np.ravel(v) for v in single_function(lane_input)]) for lane_input in a]
        result = np.stack([np.ravel(v) for v in lane_function(a)], axis=1)
        assert np.array_equal(result, rows)
        expected = np.stack([np.ravel(v) for v in program.evaluate(a, batch=True)], axis=1)
        assert np.abs(result - expected).max() <= 4e-16


@pytest.mark.parametrize("lanes", [1, 4])
def test_the_largest_component(lanes):
    """The maximum of absolute values, compared by their bits, propagates NaN."""
    program = program_of(lambda a: jnp.max(jnp.abs(a)), np.ones(3))
    triples = np.array(list(itertools.product(SPECIAL_NUMBERS, repeat=3))).reshape(-1, lanes, 3)
    function = compiled(program, lanes)
    for a in triples:
        (result,) = function(a)
        expected = np.maximum(np.maximum(abs(a[:, 0]), abs(a[:, 1])), abs(a[:, 2]))
        np.testing.assert_array_equal(np.ravel(result), expected)
        assert not np.signbit(np.ravel(result)[~np.isnan(expected)]).any()


def test_arithmetic_of_integers_and_constants():
    program = program_of(lambda a: (3 * np.argmax(np.zeros(3)) + a.argmax() * 2 - 1, a.argmin() == 1), np.ones(3))
    for lanes in (1, 2):
        function = compiled(program, lanes)
        a = np.array([[0.3, -1.0, 2.0], [5.0, np.nan, 1.0]])[:lanes]
        for result, expected in zip(function(a), program.evaluate(a, batch=True), strict=True):
            assert np.array_equal(np.ravel(result), np.ravel(expected))


TABLE_PROGRAMS = {
    "product": (lambda a, b: a @ b, (6, 6), (6, 6)),
    "loop": (lambda a, x: jax.lax.scan(lambda s, row: (jnp.sin(s) @ row / 9.0, s), x, a), (70, 3, 3), (3,)),
    "lookup": (lambda a, x: a[jnp.floor(x).astype(int)], (40,), (1,)),
}
"""Programs that read tables from memory, with the shapes of their arguments."""


@pytest.mark.parametrize("lanes", [1, 8])
@pytest.mark.parametrize("name", TABLE_PROGRAMS)
def test_tables_may_begin_at_any_number(name, lanes):
    """NumPy aligns its arrays to 16 bytes, but a vector has up to 64."""
    f, *shapes = TABLE_PROGRAMS[name]
    random = np.random.default_rng(0)
    arrays = [random.uniform(0.0, 1.5, (lanes, *shape)) for shape in shapes]
    program = program_of(f, *(a[0] for a in arrays))
    function, expected = compiled(program, lanes), program.evaluate(*arrays, batch=True)
    for offset in range(8):
        for result, right in zip(function(*arrays, offset=offset), expected, strict=True):
            np.testing.assert_allclose(result.reshape(right.shape), right, rtol=1e-13)


def test_an_operation_without_an_instruction_is_refused():
    writer = ProgramWriter(
        ir.IRBuilder(ir.Function(ir.Module(), ir.FunctionType(FLOAT64, [FLOAT64]), "f").append_basic_block()), 1
    )
    with pytest.raises(UnsupportedPrimitive, match="gamma"):
        writer.write_operation("gamma", [writer.constant(1.0)])


def test_code_is_unloaded():
    """Repeated compilation takes no more memory maps than a single one."""
    program = lambda i: program_of(lambda a: a * (i + 0.5), np.ones(2))  # noqa: E731
    for i in range(3):
        compiled(program(i))
    gc.collect()
    n_maps_before = memory_maps()
    for i in range(60):
        assert compiled(program(i))(np.ones(2))[0][0] == i + 0.5
    gc.collect()
    assert memory_maps() <= n_maps_before + 30


def test_code_is_found_on_disk_and_damage_is_seen(tmp_path, monkeypatch):
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path / "cache"))
    compilations = []
    monkeypatch.setattr(
        machine_code,
        "_compile_module",
        lambda *a, make=machine_code._compile_module: compilations.append(1) or make(*a),
    )
    program = program_of(lambda a: a * 3.25, np.ones(2))
    for _ in range(2):
        assert compiled(program)(np.ones(2))[0][0] == 3.25
    assert len(compilations) == 1
    (file,) = (tmp_path / "cache").glob("*.o")
    content = file.read_bytes()
    for damaged_content in (content[: len(content) // 2], b"", content[:-1] + bytes([content[-1] ^ 1])):
        file.write_bytes(damaged_content)
        assert compiled(program)(np.ones(2))[0][0] == 3.25
    assert len(compilations) == 4
    assert file.read_bytes() == content


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="its processors have other names")
def test_code_is_made_for_the_processor_that_is_named(tmp_path, monkeypatch):
    """``LIETHERMO_CPU`` limits the instructions, and its code has files of its own."""
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path))
    program, compilations = program_of(lambda a: a * 3.75 + 1.0, np.ones(2)), []
    monkeypatch.setattr(
        machine_code,
        "_compile_module",
        lambda *a, make=machine_code._compile_module: compilations.append(1) or make(*a),
    )
    try:
        for cpu in ("x86-64", "x86-64-v2"):
            monkeypatch.setenv("LIETHERMO_CPU", cpu)
            machine_code._host_target_cpu_features_and_text.cache_clear()
            for _ in range(2):
                assert compiled(program, 8)(np.ones((8, 2)))[0].tolist() == [[4.75, 4.75]] * 8
            assert "ymm" not in machine_code._new_target_machine().emit_assembly(llvm.parse_assembly(VECTOR_ADD_IR))
    finally:
        monkeypatch.delenv("LIETHERMO_CPU")
        machine_code._host_target_cpu_features_and_text.cache_clear()
    assert len(compilations) == len(list(tmp_path.glob("*.o"))) == 2


VECTOR_ADD_IR = """
define void @add(<8 x double>* %p) {
  %a = load <8 x double>, <8 x double>* %p
  %b = fadd <8 x double> %a, %a
  store <8 x double> %b, <8 x double>* %p
  ret void
}
"""


def test_a_module_that_llvm_refuses_is_an_error():
    module = ir.Module()
    function = ir.Function(module, ir.FunctionType(FLOAT64, []), "f")
    ir.IRBuilder(function.append_basic_block())  # a block without a terminator
    with pytest.raises(RuntimeError):
        MachineCode(module)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_the_exponential_is_that_of_the_field(lanes):
    """The exponential is accurate to one unit in the last place, and infinite, zero or NaN beyond its range."""
    program = scalarize(jax.make_jaxpr(jnp.exp)(jax.ShapeDtypeStruct((1,), jnp.float64)))
    function = compiled(program, lanes)
    random = np.random.default_rng(0)
    normal_arguments = np.concatenate(
        [random.uniform(-708.0, 709.7, 400), random.uniform(-1.0, 1.0, 400), [0.0, -1e-300]]
    )
    special_arguments = np.array([709.79, -745.2, 1e308, -1e308, np.inf, -np.inf, np.nan, -744.0, 700.0, -700.0])
    x = np.resize(np.concatenate([normal_arguments, special_arguments]), lanes * 900)
    rows = x.reshape(-1, lanes)
    results = np.concatenate([np.ravel(function(row[:, None] if lanes > 1 else row)[0]) for row in rows])
    for argument, value in zip(x[: len(normal_arguments)], results, strict=False):
        exact = mpmath.exp(mpmath.mpf(argument))
        assert abs(mpmath.mpf(value) - exact) <= 1.01 * np.spacing(float(exact))
    with np.errstate(over="ignore", under="ignore"):
        np.testing.assert_allclose(results, np.exp(x), rtol=5e-16, atol=5e-324)
