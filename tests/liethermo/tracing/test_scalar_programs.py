"""Scalar programs at limits of special functions, without needless operations, and refused by name."""

import dataclasses
import functools
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from jax import lax

import liethermo as lt
import manifolds as mf
from liethermo.integrators import MetriplecticMidpoint, registered_methods
from liethermo.tracing.builder import Instruction
from liethermo.tracing.scalarize import UnsupportedPrimitive, scalarize
from tests.cases import DISSIPATIONS, build, state_of
from tests.machine_code import compile_program
from tests.scalar_programs import check_agrees_with_jax, check_outputs, jax_values, program_of, real_and_imaginary

v = np.random.default_rng(0).standard_normal(3)

LIMIT_ARGUMENTS = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, -2.5, -7.5, 3.0, 30.5, 1e-10, -1e-10, np.inf, -np.inf, np.nan]
)


LIMIT_PAIRS = np.repeat(LIMIT_ARGUMENTS, len(LIMIT_ARGUMENTS)), np.tile(LIMIT_ARGUMENTS, len(LIMIT_ARGUMENTS))


derivative = lambda f: lambda a: jax.jvp(f, (a,), (jnp.ones_like(a),))[1]  # noqa: E731


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        pytest.param(lax.digamma, [LIMIT_ARGUMENTS], id="digamma"),
        pytest.param(lax.lgamma, [LIMIT_ARGUMENTS], id="lgamma"),
        pytest.param(derivative(lax.digamma), [LIMIT_ARGUMENTS], id="derivative of digamma"),
        pytest.param(derivative(derivative(lax.lgamma)), [LIMIT_ARGUMENTS], id="second derivative of lgamma"),
        *(
            pytest.param(functools.partial(jax.scipy.special.polygamma, n), [LIMIT_ARGUMENTS], id=f"polygamma {n}")
            for n in range(4)
        ),
        pytest.param(
            derivative(functools.partial(jax.scipy.special.polygamma, 1)),
            [LIMIT_ARGUMENTS],
            id="derivative of polygamma",
        ),
        pytest.param(lax.zeta, LIMIT_PAIRS, id="zeta"),
        pytest.param(lax.igamma, LIMIT_PAIRS, id="igamma"),
        pytest.param(lax.igammac, LIMIT_PAIRS, id="igammac"),
    ],
)
def test_special_functions_at_their_limits(function, arguments):
    """Poles, negative numbers, zeros and infinity agree with JAX."""
    program = program_of(function, *(a[0] for a in arguments))
    expected = np.asarray(jax.jit(jax.vmap(function))(*arguments))
    (interpreter_outputs,) = program.evaluate(*arguments, batch=True)
    run = compile_program(program)
    machine_outputs = np.array([run(*row)[0] for row in zip(*arguments, strict=True)])
    for outputs in (interpreter_outputs, machine_outputs):
        np.testing.assert_allclose(outputs, expected, rtol=1e-11, atol=1e-14)  # JAX computes 1 - igamma


def test_digamma_of_negative_numbers_has_derivatives():
    """The derivative agrees with the reflection formula of the trigamma function."""
    x = np.array([-0.5, -0.25, -1.3, -2.5])
    expected = (np.pi / np.sin(np.pi * x)) ** 2 - scipy.special.polygamma(1, 1.0 - x)
    (trigamma,) = program_of(derivative(lax.digamma), x).evaluate(x)
    np.testing.assert_allclose(trigamma, expected, rtol=1e-12)


def test_a_complex_number_divided_by_infinity():
    check_agrees_with_jax(
        lambda a, b: real_and_imaginary((a + 2j) / (b + 3j)),
        np.array([1.0, -2.0, np.inf]),
        np.array([np.inf, -np.inf, np.inf]),
    )
    check_agrees_with_jax(
        lambda a: real_and_imaginary(jax.jvp(lambda z: jnp.sqrt(z + 0j), (a,), (jnp.ones(2),))[1]),
        np.array([np.inf, 1.0]),
    )


def test_a_logarithm_of_a_large_complex_number():
    z = np.array([1e300, -1e300, 1e200, 1e5, 3.0])
    check_agrees_with_jax(lambda a, b: real_and_imaginary(jnp.log1p(a + 1j * b)), z, z[::-1].copy())


def test_special_values_of_reductions():
    for f in (jnp.max, jnp.min, jnp.sum, jnp.prod, jnp.argmax, jnp.argmin, jnp.cumsum):
        check_agrees_with_jax(
            lambda a, f=f: f(a, axis=-1), np.array([[1.0, np.nan, np.inf], [np.inf, 2.0, 3.0], [0.0, -np.inf, np.inf]])
        )


def test_cross_product_is_six_products_and_three_differences():
    C = mf.so(3).structure_constants
    program = check_agrees_with_jax(lambda a, b: jnp.einsum("abc,a,b->c", C, a, b), v, v[::-1])
    assert program.operation_counts == {"mul": 6, "sub": 3}


@pytest.mark.parametrize(
    ("f", "operations"),
    [
        (lambda a: a * 0.0 + 1.0, {}),
        (lambda a: 0.0 / a + 1.0 * a - 0.0, {}),
        (lambda a: a / 1.0 + a * -1.0 * 0.0, {}),
        (lambda a: jnp.exp(jnp.zeros(3)) * a, {}),
        (lambda a: jnp.negative(jnp.negative(a)), {}),
        (lambda a: [-a[0] * a[1] + a[2], a[1] * a[0]], {"mul": 1, "sub": 1}),
        (lambda a: [a[0] * -2.0 + a[1], 2.0 * a[0]], {"mul": 1, "sub": 1}),
        (lambda a: [-a[0] / a[1], a[0] / -a[1]], {"div": 1, "neg": 1}),
        (lambda a: [(a[0] + a[1]) * a[2], a[2] * (a[1] + a[0])], {"add": 1, "mul": 1}),
        (lambda a: jnp.sin(a)[0] + jnp.cos(a)[1] * jnp.eye(3)[0, 1], {"sin": 1}),
        (lambda a: a[0] ** 8, {"mul": 3}),
        (lambda a: jnp.tril(jnp.outer(a, a))[0], {"mul": 1}),
        (lambda a: jnp.where(jnp.arange(3) > 1, a, 2.0 * a), {"mul": 2}),
        (lambda a: a[0] - a[0], {"sub": 1}),  # NaN - NaN is not 0
        (lambda a: a[0] / a[0], {"div": 1}),
        (lambda a: (a[0] + a[1]) + a[2] - (a[0] + (a[1] + a[2])), {"add": 4, "sub": 1}),  # sums are not reassociated
    ],
)
def test_simplification(f, operations):
    assert check_agrees_with_jax(f, v).operation_counts == operations


def test_signed_zeros_are_kept_where_they_matter():
    """The functions atan2 and division distinguish -0.0 from 0.0, and so does merging."""
    program = check_agrees_with_jax(
        lambda a: [jnp.arctan2(a, z) for z in (0.0, -0.0)] + [a / z for z in (0.0, -0.0)], np.array([0.5])
    )
    assert program.operation_counts == {"atan2": 2, "div": 2}


def test_fixed_inputs_are_folded():
    matrix = np.diag([1.0, 2.0, 3.0])
    f = lambda A, a: A @ a  # noqa: E731
    fixed_inputs = [np.where(matrix == 0.0, 0.0, np.nan), None]
    program = program_of(f, matrix, v, fixed_inputs=fixed_inputs)
    assert program.operation_counts == {"mul": 3}
    check_outputs(program, [matrix, v], jax_values(f, matrix, v))
    assert program_of(f, matrix, v).operation_counts == {"mul": 9, "add": 6}


@pytest.mark.slow
def test_text_is_the_same_in_every_process():
    """The hash of the text is the key of a cache on disk."""
    script = """
import jax, jax.numpy as jnp, manifolds as mf
from liethermo.tracing.scalarize import scalarize
C = mf.su(2).structure_constants
f = lambda x, p: jnp.einsum("abc,a,b->c", C, x, jax.grad(lambda y: jnp.sum(jnp.cos(p * y)) * jnp.linalg.norm(y))(x))
spec = jax.ShapeDtypeStruct((3,), jnp.float64)
text = repr(scalarize(jax.make_jaxpr(f)(spec, spec)))
"""
    namespace: dict = {}
    exec(script, namespace)
    command = [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}\n{script}\nprint(text, end='')"]
    other_process_text = subprocess.run(
        command, env={"PYTHONHASHSEED": "7"}, capture_output=True, text=True, check=True
    ).stdout
    assert namespace["text"] == other_process_text
    second_namespace: dict = {}
    exec(script, second_namespace)
    assert second_namespace["text"] == other_process_text


@pytest.mark.parametrize(
    ("f", "primitive", "reason"),
    [
        (lambda a: jnp.linalg.eigvals(jnp.outer(a, a)).real, "eig", ""),
        (lambda a: jnp.float16(a) * 2.0, "convert_element_type", "on float16[3]"),
        (lambda a: jnp.arcsin(a + 1j).real, "asin", "on complex numbers"),
        (lambda a: jax.pure_callback(np.sin, a, a), "pure_callback", ""),
        (lambda a: lax.reduce_max(a[:0], (0,)), "reduce_max", "over an empty axis"),
    ],
    ids=["eig", "float16", "complex", "callback", "empty"],
)
def test_refusal_names_the_primitive_and_the_line(f, primitive, reason):
    with pytest.raises(UnsupportedPrimitive) as error_info:
        program_of(f, v)
    error = error_info.value
    assert isinstance(error, lt.errors.LiethermoError)
    assert (error.primitive, error.reason) == (primitive, reason)
    assert error.source_line.startswith("test_scalar_programs.py:")
    assert repr(primitive) in str(error)
    assert error.source_line in str(error)


def test_too_large_a_program_is_refused():
    with pytest.raises(UnsupportedPrimitive, match=r"'sin' within the size limit.*exceeds 500 scalar") as error_info:
        program_of(lambda a: jnp.sin(jnp.outer(a, a)), np.arange(1.0, 28.0), max_instructions=500)
    assert error_info.value.primitive == "sin"


def test_inputs_must_be_float64():
    with pytest.raises(lt.errors.InputError, match=r"argument 0 .* got int64"):
        program_of(lambda a: a, np.arange(3))


def test_a_corrupted_instruction_is_caught():
    """Control: the comparison fails if any one instruction is replaced by another operation."""
    f = lambda a, b: [jnp.cross(a, b) * jnp.exp(a), jnp.where(a > b, a / b, b)]  # noqa: E731
    args = [np.array([0.3, -0.8, 1.9]), np.array([0.1, -1.1, -0.4])]
    program, expected = check_agrees_with_jax(f, *args), jax_values(f, *args)
    replacements = {"add": "sub", "sub": "add", "mul": "add", "div": "mul", "exp": "sin", "gt": "lt", "select": "sub"}
    for i, (target, op, operands) in enumerate(program.instructions):
        wrong_instruction = Instruction(target, replacements[op], operands[-2:])
        instructions = (*program.instructions[:i], wrong_instruction, *program.instructions[i + 1 :])
        with pytest.raises(AssertionError, match="is not"):
            check_outputs(dataclasses.replace(program, instructions=instructions), args, expected)


def slopes(system, method):
    """Return the right-hand side of the stage equations, and its arguments from the state to the parameters."""
    parameters, structure = eqx.partition(system, eqx.is_inexact_array)

    def f(x, compensation, h, k, parameters):
        return method.slopes(eqx.combine(parameters, structure), x, compensation, h, k)

    x = state_of(system.algebra, 1)
    k = np.tile(np.asarray(system.vector_field(x)), (method.stages, 1))
    leaves, tree = jax.tree_util.tree_flatten(parameters)
    return (
        lambda x, compensation, h, k, *leaves: f(x, compensation, h, k, jax.tree_util.tree_unflatten(tree, leaves)),
        [x, 1e-17 * x, np.array(0.1), k, *map(np.asarray, leaves)],
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("case", DISSIPATIONS, ids=lambda case: case.name)
def test_every_dissipation(case):
    f, args = slopes(build(mf.so(3), case), MetriplecticMidpoint())
    check_agrees_with_jax(f, *args)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", list(registered_methods()), ids=str)
def test_every_method(method):
    f, args = slopes(build(mf.so(3), DISSIPATIONS[0]), method)
    check_agrees_with_jax(f, *args)


@pytest.mark.slow
def test_compiled_su3_with_killing_dissipation():
    g = mf.su(3)
    system = lt.LiePoissonSystem(g, lt.Quadratic(np.linspace(1, 2, 8)), g.casimirs(2)[0], lt.KillingDissipation(0.1))
    f, args = slopes(system, MetriplecticMidpoint())
    program = program_of(f, *args)
    assert len(program.instructions) < 800  # a dense loop would need some 4000
    check_outputs(program, args, jax_values(f, *args), compile_program(program)(*args))


def test_constant_factors_are_multiplied_first():
    """A loop over x then computes ``a b`` once: fewer products contain x, and the values do not change."""

    def f(a, b, x):
        return b * (a * x) + 0.5 * (a * x) * b, x * (x * a)

    program = scalarize(jax.make_jaxpr(f)(*[jax.ShapeDtypeStruct((), jnp.float64)] * 3))
    factored_program = program.regroup_constant_factors([2])
    values = 1.3, -0.7, 2.1
    for value, factored_value in zip(program.evaluate(*values), factored_program.evaluate(*values), strict=True):
        assert np.abs(value - factored_value) < 4e-16 * np.abs(value)
    (x,) = factored_program.inputs[2]
    factors = [i.args for i in factored_program.instructions if i.target.endswith("_factor")]
    assert factors
    assert all(x not in args for args in factors)
    assert sum(x in i.args for i in factored_program.instructions) > sum(x in i.args for i in program.instructions)
    assert program.regroup_constant_factors([0, 1, 2]).operation_counts == program.operation_counts, (
        "nothing to take out where all of them change"
    )
