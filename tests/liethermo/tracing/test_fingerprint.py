"""Fingerprints of traced programs: equal in every process, different for any difference that changes a result."""

import itertools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.compiled import machine_code, step_loop
from liethermo.engines.compiled.engine import CompiledEngine
from liethermo.runs.preparation import prepare_system_and_method
from liethermo.tracing.caching import LRUCache
from liethermo.tracing.fingerprint import compiler_source_fingerprint, program_fingerprint
from manifolds.matrices.exponential import expm
from manifolds.matrices.spectral import spectral

TABLE = np.linspace(0.1, 1.0, 2_000)


def fingerprint(function, *arguments):
    return program_fingerprint(jax.make_jaxpr(function)(*(arguments or (np.ones(3),))))


def scan_over(x, length):
    return jax.lax.scan(lambda carry, _: (jnp.sin(carry), None), x, None, length=length)[0]


def changed_table(index):
    table = TABLE.copy()
    table[index] = np.nextafter(table[index], 2.0)
    return table


PROGRAMS = {
    "product": lambda x: 2.0 * x,
    "another number": lambda x: np.nextafter(2.0, 3.0) * x,
    "zero": lambda x: x + 0.0,
    "negative zero": lambda x: x + -0.0,
    "other operands": lambda x: x[0] - x[1],
    "swapped operands": lambda x: x[1] - x[0],
    "sum along the axis": lambda x: jnp.stack([x, x]).sum(axis=0),
    "sum along the other axis": lambda x: jnp.stack([x, x]).sum(axis=1),
    "table": lambda x: jnp.asarray(TABLE) * x[0],
    "table changed in the last bit of one entry": lambda x: jnp.asarray(changed_table(1_000)) * x[0],
    "integer table": lambda x: jnp.arange(3, dtype=np.int64) * x,
    "table of shorter integers": lambda x: jnp.arange(3, dtype=np.int32) * x,
    "comparison": lambda x: jnp.where(x > 0.0, x, 1.0),
    "comparison with equality": lambda x: jnp.where(x >= 0.0, x, 1.0),
    "branches": lambda x: jax.lax.cond(x[0] > 0.0, jnp.sin, jnp.cos, x),
    "exchanged branches": lambda x: jax.lax.cond(x[0] > 0.0, jnp.cos, jnp.sin, x),
    "loop": lambda x: scan_over(x, 3),
    "longer loop": lambda x: scan_over(x, 4),
    "function of its own derivative": lambda x: jax.nn.relu(x),
    "another one": lambda x: jax.nn.relu6(x),
    "part in a jitted function": lambda x: jax.jit(lambda y: y + 1.0)(x),
    "another part in a jitted function": lambda x: jax.jit(lambda y: y + 3.0)(x),
    "matrix function": lambda x: spectral(jnp.exp, jnp.diag(x)),
    "another matrix function": lambda x: spectral(jnp.log, jnp.diag(x)),
    "exponential": lambda x: expm(jnp.diag(x)),
    "gather": lambda x: x[jnp.array([0, 2])],
    "gather of other entries": lambda x: x[jnp.array([0, 1])],
    "clipped gather": lambda x: x.at[jnp.array([0, 2])].get(mode="clip"),
}


def test_programs_that_differ_have_different_fingerprints():
    fingerprints = {name: fingerprint(function) for name, function in PROGRAMS.items()}
    assert None not in fingerprints.values()
    equal = [pair for pair in itertools.combinations(PROGRAMS, 2) if len({fingerprints[name] for name in pair}) == 1]
    assert not equal


def test_a_fingerprint_knows_shapes_and_types_of_arguments():
    arguments = [np.ones(3), np.ones(4), np.ones((3, 1)), np.ones(3, np.float32), np.ones(3, complex)]
    assert len({fingerprint(lambda x: x + x, argument) for argument in arguments}) == len(arguments)


def test_a_program_that_is_traced_again_has_the_same_fingerprint():
    for function in PROGRAMS.values():
        again = fingerprint(lambda x, function=function: function(x))
        assert again == fingerprint(function)


def test_a_function_of_the_user_inside_an_equation_has_no_fingerprint():
    assert fingerprint(lambda x: spectral(lambda y: jnp.sin(y), jnp.diag(x))) is None


def test_fingerprints_are_those_of_another_process():
    script = (
        "from tests.liethermo.tracing.test_fingerprint import *\n"
        "print([fingerprint(f).hex() for f in PROGRAMS.values()], compiler_source_fingerprint().hex())"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    expected = [fingerprint(f).hex() for f in PROGRAMS.values()], compiler_source_fingerprint().hex()
    assert output.split() == f"{expected[0]} {expected[1]}".split()


# -- machine code that is found by the fingerprint --------------------------------------------------------------------


def body(moment=2.0, power=4):
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda m: 0.5 * (m[0] ** 2 + m[1] ** 2 / 1.5) + m[2] ** power / moment,
        lambda m: jnp.log(1 + m @ m),
        lt.KillingDissipation(0.3),
    )


X0 = np.array([0.4, 0.5, -0.3])
RK4 = lt.MetriplecticRungeKutta(4)


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """Return an empty folder for the cache on disk; loops of steps are not kept in memory."""
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path))
    monkeypatch.setattr(step_loop, "_step_loop_cache", LRUCache(0))
    return tmp_path


def states_of_run(system, method=RK4):
    engine = CompiledEngine(*prepare_system_and_method(system, method))
    return engine.start(X0).advance(0.1, 10, 1).x


@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticGauss(2)], ids=str)
def test_a_run_with_code_from_the_cache_unrolls_no_program(method, empty_cache, monkeypatch):
    states = states_of_run(body(), method)
    assert {file.suffix for file in empty_cache.iterdir()} >= {".o", ".count"}

    def refuse(*_, **__):
        raise AssertionError("a program is unrolled")

    monkeypatch.setattr(step_loop, "scalarize", refuse)
    np.testing.assert_array_equal(states_of_run(body(), method), states)
    # a number of the user's function is a parameter of the same program
    other = states_of_run(body(moment=3.0), method)
    np.testing.assert_allclose(
        other[-1], lt.integrate(body(moment=3.0), X0, (0.0, 1.0), 0.1, method, engine="array").x[-1], rtol=1e-13
    )
    assert abs(other - states).max() > 1e-4
    with pytest.raises(AssertionError, match="unrolled"):
        states_of_run(body(power=6), method)


def test_code_of_another_version_of_the_compiler_is_not_used(empty_cache, monkeypatch):
    states_of_run(body())
    assert len(list(empty_cache.glob("*.o"))) == 1
    monkeypatch.setattr(step_loop, "compiler_source_fingerprint", lambda: b"another version")
    states_of_run(body())
    assert len(list(empty_cache.glob("*.o"))) == 2


def test_a_damaged_file_is_compiled_again(empty_cache):
    states = states_of_run(body())
    for file in empty_cache.iterdir():
        file.write_bytes(file.read_bytes()[:-1] + b"0")
    np.testing.assert_array_equal(states_of_run(body()), states)


def test_an_operation_count_is_read_as_it_was_written(empty_cache):
    machine_code.write_operation_count("a program", 1_234)
    assert machine_code.read_operation_count("a program") == 1_234
    assert machine_code.read_operation_count("another program") is None
