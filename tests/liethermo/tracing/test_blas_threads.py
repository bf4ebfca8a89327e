"""Programs that factorise small matrices run with one BLAS thread, and the number of threads is restored."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import threadpoolctl

import liethermo as lt
from liethermo.tracing.blas_threads import MAX_SINGLE_THREAD_ROWS, needs_one_blas_thread, with_one_blas_thread
from liethermo.tracing.programs import jit_cached
from manifolds.matrices.spectral import spectral


@pytest.fixture(autouse=True)
def three_threads():
    """Let each BLAS library have three threads during a test."""
    with threadpoolctl.threadpool_limits(limits=3, user_api="blas"):
        yield


def thread_counts() -> set[int]:
    return {library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"}


@pytest.mark.parametrize(
    ("function", "rows", "expected"),
    [
        (jnp.linalg.eigvalsh, 20, True),
        (jax.vmap(jnp.linalg.inv), 20, True),
        (jnp.linalg.svd, MAX_SINGLE_THREAD_ROWS + 1, False),
        (jnp.linalg.eigvalsh, 4, False),
        (lambda a: a @ a, 20, False),
    ],
)
def test_which_programs_use_one_thread(function, rows, expected):
    matrix = np.broadcast_to(np.eye(rows), (3, rows, rows)) if expected and rows == 20 else np.eye(rows)
    assert needs_one_blas_thread(jax.make_jaxpr(function)(matrix).jaxpr) is expected


def test_matrix_functions_of_this_library_are_factorisations():
    assert needs_one_blas_thread(jax.make_jaxpr(lambda a: spectral(jnp.exp, a))(np.eye(20)).jaxpr)


def test_the_number_of_threads_is_restored_after_an_error_and_in_threads():
    def fail(_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        with_one_blas_thread(fail)(None)
    assert thread_counts() == {3}
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(with_one_blas_thread(np.linalg.inv), [np.eye(20)] * 40))
    assert thread_counts() == {3}


@pytest.mark.parametrize(("rows", "expected"), [(20, 1), (MAX_SINGLE_THREAD_ROWS + 1, 3)])
def test_a_program_runs_with_one_thread(rows, expected):
    @jit_cached
    def largest_eigenvalue_and_thread_count(matrix):
        count = jax.pure_callback(lambda: np.array(max(thread_counts())), jax.ShapeDtypeStruct((), np.int64))
        return jnp.linalg.eigvalsh(matrix)[-1], count

    largest, count = largest_eigenvalue_and_thread_count(jnp.diag(jnp.arange(1.0, rows + 1)))
    assert float(largest) == pytest.approx(rows)
    assert int(count) == expected
    assert thread_counts() == {3}


def test_a_run_of_a_quantum_system_leaves_the_threads_as_they_were():
    lower = np.diag(np.sqrt(np.arange(1.0, 4.0)), 1)
    system = lt.QuantumSystem(
        np.diag(np.arange(4.0)), lt.ThermalJumps([(lower, 0.1)]), baths=lt.HeatBaths(np.inf, temperature=1.0)
    )
    assert lt.integrate(system, system.state(np.eye(4) / 4), (0.0, 0.1), 0.1).audit().passed
    assert thread_counts() == {3}
