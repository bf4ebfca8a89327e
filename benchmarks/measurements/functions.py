"""Energies with loops, linear algebra, complex numbers and special functions, on both engines."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy import special

import liethermo as lt
import manifolds as mf

from .. import laws
from ..contest import STEP_SIZE
from ..report import Report, Table, Target, ratio
from ..timing import race

INERTIA = jnp.array([1.0, 2.0, 3.0])
"""Moments of inertia of the body."""
INITIAL_STATE = (0.3, 1.0, -0.5)
"""Initial angular momentum."""
KNOTS = jnp.linspace(-3.0, 3.0, 400)
"""Grid of the interpolation and of the scan."""


def positive_definite_matrix(m):
    """Return a positive definite matrix with distinct eigenvalues."""
    return jnp.diag(jnp.array([2.0, 4.0, 7.0])) + 0.3 * jnp.outer(m, m)


def square_root_by_newton(s):
    """Return the square root by Newton's method in a ``while_loop``."""

    def is_inaccurate(root):
        return jnp.abs(root**2 - s) > 1e-13 * s

    return lax.while_loop(is_inaccurate, lambda c: (c + s / c) / 2, s)


FUNCTIONS = {
    "`while_loop`, a square root": lambda m: square_root_by_newton(1.0 + m @ m),
    "`scan`, 400 passes": lambda m: lax.scan(lambda c, t: (c + 0.01 * jnp.cos(t * m[0] + c), None), m[2], KNOTS)[0],
    "`cond`": lambda m: lax.cond(m[1] > 9.0, lambda a: jnp.sin(a[0]), lambda a: a[0] ** 4, m),
    "`interp`": lambda m: jnp.interp(m[0] ** 3 + m[1], KNOTS, 0.5 * KNOTS),
    "complex numbers": lambda m: jnp.abs((m[0] + 1j * m[1] + 2.0) ** 3 * jnp.exp(0.1j * m[2])),
    "`eigvalsh`, 3 × 3": lambda m: jnp.sum(jnp.exp(0.2 * jnp.linalg.eigvalsh(positive_definite_matrix(m)))),
    "`solve`, 3 × 3": lambda m: m @ jnp.linalg.solve(positive_definite_matrix(m), m),
    "`slogdet`, 3 × 3": lambda m: jnp.linalg.slogdet(positive_definite_matrix(m))[1],
    "`svd`, 3 × 3": lambda m: jnp.sum(jnp.linalg.svd(positive_definite_matrix(m), compute_uv=False)),
    "`cholesky`, 3 × 3": lambda m: jnp.sum(jnp.log(jnp.diag(jnp.linalg.cholesky(positive_definite_matrix(m))))),
    "`expm`, 3 × 3": lambda m: 0.1 * jnp.trace(jax.scipy.linalg.expm(0.3 * positive_definite_matrix(m))),
    "`lgamma`": lambda m: special.gammaln(4.0 + m[0]),
    "Bessel functions": lambda m: special.i0(m[0]) + special.i1e(m[1]),
}
"""Functions that a tenth of the energy consists of, by name."""


def function_body(function) -> lt.LiePoissonSystem:
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda m: 0.5 * jnp.sum(m * m / INERTIA) + 0.1 * function(m),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.1),
    )


def run(is_quick: bool) -> Report:
    """Race both engines on each function, and time the first answer of the compiled one, caches empty but for XLA's."""
    steps, rounds = (200, 1) if is_quick else (2000, 3)
    rows, targets, method = [], [], lt.MetriplecticMidpoint()
    for name, function in list(FUNCTIONS.items())[: 2 if is_quick else None]:
        system = function_body(function)
        start = time.monotonic()
        lt.integrate(system, INITIAL_STATE, (0.0, STEP_SIZE), STEP_SIZE, method, engine="compiled")
        first_seconds = time.monotonic() - start
        works = {
            engine: lambda engine=engine, system=system: lt.integrate(
                system, INITIAL_STATE, (0.0, STEP_SIZE * steps), STEP_SIZE, method, save_every=steps, engine=engine
            )
            for engine in ("compiled", "array")
        }
        outcomes = race(works, rounds=rounds)
        ours, array_seconds = (outcomes[engine].cpu_seconds / steps for engine in works)
        cells = laws.solution_laws(outcomes["compiled"].result).table_cells()
        rows.append([name, first_seconds, ours, ratio(array_seconds, ours), *cells])
        targets.append(Target(f"first answer of an energy with {name}", 3.0, first_seconds, "seconds"))
    columns = {"": "text", "First answer": "seconds", "Time a step": "seconds", "Array engine, relative": "ratio"}
    table = Table(f"Midpoint steps of size {STEP_SIZE} on so(3)*.", columns | laws.COLUMNS, rows)
    text = "An energy of a body and a tenth of a function that does not unroll. Processor times of a step."
    return Report("Functions of every kind", text, [table], targets)
