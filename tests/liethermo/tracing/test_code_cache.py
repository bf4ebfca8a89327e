"""Cache of machine code on disk: only files that this user alone can have written are run; XLA's programs too."""

import hashlib
import os
import stat
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from liethermo.engines.compiled import machine_code
from liethermo.tracing import programs
from liethermo.tracing.programs import CacheWarning
from tests.liethermo.tracing.test_scalarize import program_of
from tests.machine_code import compile_program as compiled


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("LIETHERMO_CACHE", str(tmp_path / "cache"))
    programs._warn_untrusted.cache_clear()
    return tmp_path / "cache"


@pytest.fixture
def compilations(monkeypatch):
    """Return a list that grows by one with each compilation."""
    calls = []
    monkeypatch.setattr(
        machine_code, "_compile_module", lambda *a, make=machine_code._compile_module: calls.append(1) or make(*a)
    )
    return calls


def run() -> None:
    assert compiled(program_of(lambda a: a * 7.25, np.ones(2)))(np.ones(2))[0][0] == 7.25


def test_the_folder_and_its_files_are_the_users_alone(folder, compilations):
    run()
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700
    (file,) = folder.glob("*.o")
    assert stat.S_IMODE(os.stat(file).st_mode) == 0o600
    run()
    assert len(compilations) == 1


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_a_folder_that_others_may_write_to_is_not_used(folder, compilations, mode):
    run()
    os.chmod(folder, mode)
    with pytest.warns(CacheWarning, match="others may write to it"):
        run()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run()  # the warning is not repeated
    assert len(compilations) == 3


def test_a_file_that_others_may_write_to_is_not_run(folder, compilations):
    run()
    (file,) = folder.glob("*.o")
    os.chmod(file, 0o666)
    with pytest.warns(CacheWarning, match="others may write to it"):
        run()
    assert len(compilations) == 2
    run()  # the file has been replaced
    assert len(compilations) == 2


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_what_belongs_to_another_user_is_not_run(folder, compilations):
    run()
    (file,) = folder.glob("*.o")
    os.chown(file, 12345, 12345)
    with pytest.warns(CacheWarning, match="belongs to another user"):
        run()
    assert len(compilations) == 2
    os.chown(folder, 12345, 12345)
    with pytest.warns(CacheWarning, match="belongs to another user"):
        run()
    assert len(compilations) == 3


def test_links_are_not_followed(folder, compilations, tmp_path):
    run()
    (file,) = folder.glob("*.o")
    file.rename(tmp_path / "elsewhere.o")
    file.symlink_to(tmp_path / "elsewhere.o")
    run()
    assert len(compilations) == 2
    assert not file.is_symlink()
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved")
    with pytest.warns(CacheWarning, match="it is a link"):
        run()
    assert len(compilations) == 3


ELF = b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x01\0\x3e\0" + b"\xff" * 44
"""Header of an ELF object whose sections lie beyond its end."""


def with_checksum(code: bytes) -> bytes:
    return hashlib.sha256(code).digest() + code


@pytest.mark.parametrize(
    "content",
    [
        b"",
        with_checksum(b""),
        with_checksum(b"#!/bin/sh\n"),
        with_checksum(b"\x7fELF"),
        with_checksum(ELF),
        with_checksum(b"\0" * 500),
    ],
)
def test_what_is_no_object_is_passed_over(folder, compilations, content):
    run()
    (file,) = folder.glob("*.o")
    file.write_bytes(content)
    run()
    assert len(compilations) == 2


def test_a_pipe_is_passed_over(folder, compilations):
    run()
    (file,) = folder.glob("*.o")
    file.unlink()
    os.mkfifo(file)
    run()
    assert len(compilations) == 2


HOMELESS_SCRIPT = """
import os, pathlib
def nobody():
    raise RuntimeError("Could not determine home directory.")
pathlib.Path.home = nobody
import liethermo as lt
print(lt.integrate(lt.models.rigid_body(), [0.1, 1.0, 0.1], (0.0, 1.0), 0.1).audit().passed)
"""


@pytest.mark.parametrize("has_xdg_cache", [True, False])
def test_without_a_home(tmp_path, has_xdg_cache):
    removed_variables = {"HOME", "LIETHERMO_CACHE", "XDG_CACHE_HOME"}
    environment = {name: value for name, value in os.environ.items() if name not in removed_variables}
    if has_xdg_cache:
        environment["XDG_CACHE_HOME"] = str(tmp_path)
    process = subprocess.run(
        [sys.executable, "-c", HOMELESS_SCRIPT], capture_output=True, text=True, env=environment, check=False
    )
    assert process.stdout.strip() == "True", process.stderr
    assert (tmp_path / "liethermo").exists() == has_xdg_cache


def test_a_folder_that_cannot_be_made_is_no_fault(monkeypatch, compilations):
    for folder_name in ("/dev/null/cache", "a\0b"):
        monkeypatch.setattr(programs, "cache_folder", lambda where=folder_name: programs.Path(where))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run()
    assert len(compilations) == 2


# -- programs of XLA --------------------------------------------------------------------------------------------------


@programs.jit_cached
def exponential(factor: float, x):
    return {"x": jnp.exp(-factor * x), "sum": jnp.sin(x).sum()}


@programs.jit_cached
def python_sum(x):
    return jax.pure_callback(lambda a: np.asarray(a) + 1.0, jax.ShapeDtypeStruct(x.shape, x.dtype), x)


@pytest.fixture
def loaded_programs(folder, monkeypatch):
    """Return a list that says of each program whether it was loaded; every program is written."""
    loads, load = [], programs._load_stored_program

    def noting_load(*arguments):
        program = load(*arguments)
        loads.append(program is not None)
        return program

    monkeypatch.setattr(programs, "_load_stored_program", noting_load)
    monkeypatch.setattr(programs, "MIN_STORED_COMPILE_SECONDS", 0.0)
    jax_folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield loads
    jax.config.update("jax_compilation_cache_dir", jax_folder)
    compilation_cache.reset_cache()


def run_in_new_process(function, *arguments):
    """Call a function as a process does that has no program in memory."""
    programs._program_cache._entries.clear()
    return jax.tree_util.tree_map(np.asarray, function(*arguments))


def test_a_program_of_xla_is_compiled_once(folder, loaded_programs):
    x = jnp.linspace(0.0, 3.0, 50)
    first = run_in_new_process(exponential, 2.0, x)
    (file,) = folder.glob("*.xla")
    assert stat.S_IMODE(os.stat(file).st_mode) == 0o600
    second = run_in_new_process(exponential, 2.0, x)
    assert loaded_programs == [False, True]
    assert all(np.array_equal(first[name], second[name]) for name in ("x", "sum"))


def test_other_constants_shapes_and_functions_are_other_programs(folder, loaded_programs):
    for factor, n in ((2.0, 5), (3.0, 5), (2.0, 6)):
        x = np.linspace(0.0, 1.0, n)
        assert np.allclose(
            run_in_new_process(exponential, factor, jnp.asarray(x))["x"], np.exp(-factor * x), rtol=1e-15
        )
    assert loaded_programs == [False] * 3
    assert len(list(folder.glob("*.xla"))) == 3


def test_programs_that_differ_in_unused_arguments_are_other_programs(folder, loaded_programs):
    def choose(i):
        @programs.jit_cached
        def exponential_of_one(*arrays):
            return jnp.exp(arrays[i])

        return exponential_of_one

    first, second, shorter = jnp.zeros(3), jnp.ones(3), jnp.zeros(0)
    for i, arrays in ((0, (first, second)), (1, (first, second)), (0, (first, shorter)), (0, (first, second))):
        assert np.allclose(run_in_new_process(choose(i), *arrays), np.exp(arrays[i]), rtol=1e-15)
    assert loaded_programs == [False, False, False, True]


@pytest.mark.parametrize(
    "damage", [lambda code: code[:-7], lambda code: with_checksum(b"no program"), lambda code: b""]
)
def test_a_damaged_program_is_compiled_again(folder, loaded_programs, damage):
    x = jnp.ones(4)
    first = run_in_new_process(exponential, 1.0, x)
    (file,) = folder.glob("*.xla")
    file.write_bytes(damage(file.read_bytes()))
    assert np.array_equal(run_in_new_process(exponential, 1.0, x)["x"], first["x"])
    run_in_new_process(exponential, 1.0, x)  # the file has been replaced
    assert loaded_programs == [False, False, True]


def test_a_program_that_others_may_write_to_is_not_run(folder, loaded_programs):
    run_in_new_process(exponential, 1.0, jnp.ones(3))
    (file,) = folder.glob("*.xla")
    os.chmod(file, 0o666)
    with pytest.warns(CacheWarning, match="others may write to it"):
        run_in_new_process(exponential, 1.0, jnp.ones(3))
    assert loaded_programs == [False, False]


def test_a_program_that_calls_python_is_not_written(folder, loaded_programs):
    assert np.array_equal(run_in_new_process(python_sum, jnp.ones(3)), np.full(3, 2.0))
    assert not list(folder.glob("*.xla"))


def test_programs_inside_of_programs_are_not_written(folder, loaded_programs):
    programs._program_cache._entries.clear()
    derivative = jax.grad(lambda x: exponential(2.0, x)["sum"])(jnp.ones(3))
    assert np.allclose(derivative, np.cos(np.ones(3)), rtol=1e-15)
    assert loaded_programs == []


def test_the_cache_of_jax_takes_precedence(folder, loaded_programs, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    for _ in range(2):
        assert np.allclose(run_in_new_process(exponential, 0.5, jnp.ones(7))["x"], np.exp(-0.5), rtol=1e-15)
    assert loaded_programs == []
    assert not folder.exists()


LATTICE_SCRIPT = """
import numpy as np, liethermo as lt
spins = lt.models.spin_lattice((6, 6))
x = np.random.default_rng(0).standard_normal((6, 6, 3))
x /= np.linalg.norm(x, axis=2, keepdims=True)
run = lt.integrate(spins, x, (0.0, 0.5), 0.1, lt.MetriplecticRungeKutta(4), engine="array")
print(run.x.tobytes().hex()[-4000:])
"""


@pytest.mark.slow
def test_a_second_process_computes_the_same_bits(tmp_path):
    environment = {**os.environ, "LIETHERMO_CACHE": str(tmp_path / "cache"), "JAX_COMPILATION_CACHE_DIR": ""}
    outputs, files = [], []
    for _ in range(2):
        process = subprocess.run(
            [sys.executable, "-c", LATTICE_SCRIPT], capture_output=True, text=True, env=environment, check=True
        )
        assert process.stderr == ""
        outputs.append(process.stdout)
        files.append(sorted(file.name for file in (tmp_path / "cache").glob("*.xla")))
    assert outputs[0] == outputs[1]
    assert files[0] == files[1] != []


def test_optimisation_barriers_hold_in_programs_on_the_cpu():
    """The control is a program with the default options, in which XLA computes the sine in the loop that joins."""

    def join_powers(x):
        y = jax.lax.optimization_barrier(jnp.sin(x))
        return jnp.concatenate([y, y * y])

    lowered = jax.jit(join_powers).lower(jnp.ones(100))
    with_barrier, control = (lowered.compile(options).as_text() for options in (programs.LOOP_XLA_OPTIONS, None))
    assert "opt-barrier" in with_barrier
    assert "opt-barrier" not in control
