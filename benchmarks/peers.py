"""Other solvers on the relaxed rigid body, each used as its documentation advises.

Every right-hand side is compiled: by numba for SciPy, by JAX for diffrax, by heyoka itself. A peer that is not
installed raises :class:`.UnavailableError`.
"""

from __future__ import annotations

import copy
import functools
import importlib
import operator
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numba
import numpy as np
from scipy.integrate import solve_ivp

from liethermo.tracing.scalarize import scalarize

from .machine import available_cores
from .problems import body_field
from .report import UnavailableError


@dataclass(frozen=True)
class PeerRun:
    """One trajectory under one tolerance.

    Attributes
    ----------
    solve_end : function without arguments
        Integrates and returns the state at the end, shape (3,): what is timed.
    solve_path : function without arguments
        The states at the solver's own steps, shape (steps + 1, 3).
    """

    solve_end: Callable[[], np.ndarray]
    solve_path: Callable[[], np.ndarray]


def import_peer(name: str):
    """A peer, imported when it is wanted."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UnavailableError(f"{name} is not installed; `make bench` installs it") from None


# -- SciPy ------------------------------------------------------------------------------------------------------------


def scipy_run(tolerance: float, x0, t_end: float, rate: float) -> PeerRun:
    """DOP853, eighth order."""
    field = _scipy_field(rate)

    def solve():
        solution = solve_ivp(field, (0.0, t_end), x0, method="DOP853", rtol=tolerance, atol=tolerance)
        if not solution.success:
            raise RuntimeError(solution.message)
        return solution.y.T

    return PeerRun(lambda: solve()[-1], solve)


def scipy_ensemble(tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """The states at the end from all of the x0s, one after another."""
    runs = [scipy_run(tolerance, x0, t_end, rate) for x0 in x0s]
    return lambda: np.array([run.solve_end() for run in runs])


@functools.cache
def _scipy_field(rate: float) -> Callable:
    compiled = numba.njit(body_field)

    @numba.njit
    def field(t, x):
        return np.array(compiled(x[0], x[1], x[2], rate))

    return field


# -- diffrax ----------------------------------------------------------------------------------------------------------


def diffrax_run(solver: str, tolerance: float, x0, t_end: float, rate: float) -> PeerRun:
    """A Runge-Kutta method of diffrax, by name, with its PID controller."""
    dfx, x0 = import_peer("diffrax"), np.asarray(x0, dtype=float)
    end = _diffrax_end(solver, t_end, rate)

    def path():
        saved = dfx.SaveAt(t0=True, steps=True)
        times, states = _diffrax_solve(solver, t_end, rate, saved, 100_000)(x0, tolerance)
        return np.asarray(states)[np.isfinite(np.asarray(times))]

    return PeerRun(lambda: np.asarray(end(x0, tolerance)), path)


def diffrax_ensemble(solver: str, tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """The states at the end from all of the x0s, under ``vmap``."""
    ends = _diffrax_ends(solver, t_end, rate)
    return lambda: np.asarray(ends(x0s, tolerance))


@functools.cache
def _diffrax_ends(solver: str, t_end: float, rate: float) -> Callable:
    jax = import_peer("jax")
    return jax.jit(jax.vmap(_diffrax_end(solver, t_end, rate), in_axes=(0, None)))


@functools.cache
def _diffrax_end(solver: str, t_end: float, rate: float) -> Callable:
    solve = _diffrax_solve(solver, t_end, rate, import_peer("diffrax").SaveAt(t1=True), None)
    return import_peer("jax").jit(lambda x0, tolerance: solve(x0, tolerance)[1][0])


def _diffrax_solve(solver, t_end, rate, saveat, max_steps) -> Callable:
    """Times and states as diffrax returns them, compiled; NaN where it gave up."""
    dfx, jax = import_peer("diffrax"), import_peer("jax")
    jnp = jax.numpy

    def field(t, x, args):
        return jnp.stack(body_field(x[0], x[1], x[2], rate))

    @jax.jit
    def solve(x0, tolerance):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            getattr(dfx, solver)(),
            t0=0.0,
            t1=t_end,
            dt0=None,
            y0=x0,
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            saveat=saveat,
            max_steps=max_steps,
            throw=False,
        )
        return solution.ts, jnp.where(solution.result == dfx.RESULTS.successful, solution.ys, jnp.nan)

    return solve


# -- heyoka -----------------------------------------------------------------------------------------------------------


def heyoka_run(tolerance: float, x0, t_end: float, rate: float) -> PeerRun:
    """Taylor series of the order that the tolerance asks for."""
    return heyoka_equations_run(_heyoka_system(rate), tolerance, x0, t_end)


def heyoka_equations_run(equations: list, tolerance: float, x0, t_end: float) -> PeerRun:
    """The same for other equations: pairs of a variable and its derivative."""
    hy, x0 = import_peer("heyoka"), np.asarray(x0, dtype=float)
    integrator = hy.taylor_adaptive(equations, x0, tol=tolerance)

    def reset():
        integrator.time = 0.0
        integrator.state[:] = x0

    def end():
        reset()
        _require_time_limit(hy, integrator.propagate_until(t_end)[0])
        return integrator.state.copy()

    def path():
        reset()
        states = [x0]
        while integrator.time < t_end:
            integrator.step(t_end - integrator.time)
            states.append(integrator.state.copy())
        return np.array(states)

    return PeerRun(end, path)


def heyoka_threads(tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """The states at the end from all of the x0s: a SIMD integrator for each core, and the batches dealt out to them."""
    return heyoka_equations_threads(_heyoka_system(rate), tolerance, x0s, t_end)


def heyoka_equations_threads(equations: list, tolerance: float, x0s: np.ndarray, t_end: float) -> Callable:
    """The same for other equations: pairs of a variable and its derivative."""
    hy, (batches, states) = import_peer("heyoka"), _simd_batches(x0s)
    first = hy.taylor_adaptive_batch(equations, states[0].copy(), tol=tolerance)
    integrators = [copy.deepcopy(first) for _ in range(available_cores())]

    def work(which: int) -> np.ndarray:
        integrator, mine = integrators[which], states[which :: len(integrators)]
        found = np.empty_like(mine)
        for start, end in zip(mine, found, strict=True):
            integrator.set_time(0.0)
            integrator.state[:] = start
            integrator.propagate_until(t_end)
            end[:] = integrator.state
        return found

    def ends():
        found = np.empty((batches, *states.shape[1:]))
        with ThreadPoolExecutor(len(integrators)) as threads:
            for which, part in enumerate(threads.map(work, range(len(integrators)))):
                found[which :: len(integrators)] = part
        return found.swapaxes(1, 2).reshape(-1, x0s.shape[1])[: len(x0s)]

    return ends


def heyoka_ensemble(tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """The states at the end from all of the x0s: heyoka's own ensemble mode, with a copy of an integrator a batch."""
    hy, (batches, states) = import_peer("heyoka"), _simd_batches(x0s)
    integrator = hy.taylor_adaptive_batch(_heyoka_system(rate), states[0].copy(), tol=tolerance)

    def start(copied, i):
        copied.set_time(0.0)
        copied.state[:] = states[i]
        return copied

    def ends():
        finished = hy.ensemble_propagate_until_batch(integrator, t_end, batches, start)
        return np.stack([one[0].state for one in finished]).swapaxes(1, 2).reshape(-1, 3)[: len(x0s)]

    return ends


def _simd_batches(x0s: np.ndarray) -> tuple[int, np.ndarray]:
    """States as batches for heyoka, shape (batches, n, lanes); the last is filled up with states from the front."""
    lanes = import_peer("heyoka").recommended_simd_size()
    batches = -(-len(x0s) // lanes)
    return batches, np.resize(x0s, (batches, lanes, x0s.shape[1])).swapaxes(1, 2).copy()


def _heyoka_system(rate: float) -> list:
    x, y, z = import_peer("heyoka").make_vars("x", "y", "z")
    return list(zip((x, y, z), body_field(x, y, z, rate), strict=True))


def equations_for_heyoka(field: Callable, dim: int) -> list:
    """The equations of motion of a vector field, from its scalar program: nothing is typed twice."""
    hy = import_peer("heyoka")
    program = scalarize(jax.make_jaxpr(field)(jnp.zeros(dim)))
    variables = [hy.make_vars(f"x{i}") for i in range(dim)]
    values = dict(zip(program.inputs[0], variables, strict=True))
    for target, op, args in program.instructions:
        name = str(op)
        function = getattr(operator, {"div": "truediv"}.get(name, name), None) or getattr(hy, name)
        values[target] = function(*(values[a] if isinstance(a, str) else a for a in args))
    found = [values[a] if isinstance(a, str) else hy.expression(a) for a in program.outputs[0]]
    return list(zip(variables, found, strict=True))


def _require_time_limit(hy, outcome) -> None:
    if outcome != hy.taylor_outcome.time_limit:
        raise RuntimeError(f"heyoka stopped early: {outcome}")
