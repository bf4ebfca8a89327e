"""One BLAS thread for programs that factorise small matrices.

OpenBLAS divides a factorisation among its threads from some 18 rows on, and threads without work wait in busy loops. On
a machine with other work an eigendecomposition of 64 rows then takes ten to forty times the processor time.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import threadpoolctl
from jax.extend.core import Jaxpr

from manifolds.matrices.chains import chain_p

from .searches import iterate_equations

FACTORISATIONS = frozenset(
    """cholesky eig eigh geqrf hessenberg householder_product inverse lu schur svd triangular_solve tridiagonal
    tridiagonal_solve""".split()
) | {chain_p.name}
"""Primitives that call LAPACK on the CPU, those of this library included."""

MIN_THREADED_ROWS = 16
"""Smallest number of rows for which BLAS may use several threads."""

MAX_SINGLE_THREAD_ROWS = 128
"""Largest number of rows of a matrix that is factorised by one thread; more threads are of use for larger ones."""


def needs_one_blas_thread(jaxpr: Jaxpr) -> bool:
    """Return whether a program factorises matrices that BLAS would divide among threads, though all are small."""
    row_counts = [
        max(equation.invars[0].aval.shape[-2:])
        for equation, _ in iterate_equations(jaxpr)
        if equation.primitive.name in FACTORISATIONS
    ]
    return MIN_THREADED_ROWS <= max(row_counts, default=0) <= MAX_SINGLE_THREAD_ROWS


def with_one_blas_thread(program: Callable) -> Callable:
    """Return a function that calls a compiled program while BLAS has one thread, and waits for its results.

    The first Python thread that sets a limit is the only one that may, as long as it lives. In another thread a limit
    has no effect, and programs may use more BLAS threads.
    """

    @functools.wraps(program)
    def call(arguments):
        with _blas_libraries().limit(limits=1):
            return jax.block_until_ready(program(arguments))

    return call


@functools.cache
def _blas_libraries() -> threadpoolctl.ThreadpoolController:
    """Return the BLAS libraries of this process: NumPy and SciPy have one each, and JAX calls that of SciPy."""
    return threadpoolctl.ThreadpoolController().select(user_api="blas")
