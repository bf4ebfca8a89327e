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
    """One trajectory with one tolerance.

    Attributes
    ----------
    solve_end : function without arguments
        Integrates and returns the final state, shape (3,); this is timed.
    solve_path : function without arguments
        Returns the states at the solver's own steps, shape (steps + 1, 3).
    """

    solve_end: Callable[[], np.ndarray]
    solve_path: Callable[[], np.ndarray]


def import_peer(name: str):
    """Import a peer when it is needed, or raise UnavailableError."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UnavailableError(f"{name} is not installed; `make bench` installs it") from None


# -- SciPy ------------------------------------------------------------------------------------------------------------


def scipy_run(tolerance: float, x0, t_end: float, rate: float) -> PeerRun:
    """Return a run by SciPy's DOP853, of order eight."""
    field = _scipy_field(rate)

    def solve():
        solution = solve_ivp(field, (0.0, t_end), x0, method="DOP853", rtol=tolerance, atol=tolerance)
        if not solution.success:
            raise RuntimeError(solution.message)
        return solution.y.T

    return PeerRun(lambda: solve()[-1], solve)


def scipy_ensemble(tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """Return a function that gives the final states from all x0s, computed one after another."""
    runs = [scipy_run(tolerance, x0, t_end, rate) for x0 in x0s]
    return lambda: np.array([run.solve_end() for run in runs])


@functools.cache
def _scipy_field(rate: float) -> Callable:
    scalar_field = numba.njit(body_field)

    @numba.njit
    def field(t, x):
        return np.array(scalar_field(x[0], x[1], x[2], rate))

    return field


# -- diffrax ----------------------------------------------------------------------------------------------------------


def diffrax_run(solver: str, tolerance: float, x0, t_end: float, rate: float) -> PeerRun:
    """Return a run by a Runge-Kutta method of diffrax, by name, with its PID controller."""
    dfx, x0 = import_peer("diffrax"), np.asarray(x0, dtype=float)
    end = _diffrax_final_state(solver, t_end, rate)

    def path():
        saveat = dfx.SaveAt(t0=True, steps=True)
        times, states = _compile_diffrax_solve(solver, t_end, rate, saveat, 100_000)(x0, tolerance)
        return np.asarray(states)[np.isfinite(np.asarray(times))]

    return PeerRun(lambda: np.asarray(end(x0, tolerance)), path)


def diffrax_ensemble(solver: str, tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """Return a function that gives the final states from all x0s, computed under ``vmap``."""
    ends = _diffrax_final_states(solver, t_end, rate)
    return lambda: np.asarray(ends(x0s, tolerance))


@functools.cache
def _diffrax_final_states(solver: str, t_end: float, rate: float) -> Callable:
    jax = import_peer("jax")
    return jax.jit(jax.vmap(_diffrax_final_state(solver, t_end, rate), in_axes=(0, None)))


@functools.cache
def _diffrax_final_state(solver: str, t_end: float, rate: float) -> Callable:
    solve = _compile_diffrax_solve(solver, t_end, rate, import_peer("diffrax").SaveAt(t1=True), None)
    return import_peer("jax").jit(lambda x0, tolerance: solve(x0, tolerance)[1][0])


def _compile_diffrax_solve(solver, t_end, rate, saveat, max_steps) -> Callable:
    """Return a compiled function that gives diffrax's times and states, or NaN if diffrax gave up."""
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
    """Return a run by heyoka's Taylor series, whose order follows from the tolerance."""
    return heyoka_equations_run(_heyoka_system(rate), tolerance, x0, t_end)


def heyoka_equations_run(equations: list, tolerance: float, x0, t_end: float) -> PeerRun:
    """Return a run of heyoka for given equations: pairs of a variable and its derivative."""
    hy, x0 = import_peer("heyoka"), np.asarray(x0, dtype=float)
    integrator = hy.taylor_adaptive(equations, x0, tol=tolerance)

    def reset():
        integrator.time = 0.0
        integrator.state[:] = x0

    def end():
        reset()
        _require_reached_end_time(hy, integrator.propagate_until(t_end)[0])
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
    """Return a function that gives the final states from all x0s: one SIMD integrator per core, which share the
    batches."""
    return heyoka_equations_threads(_heyoka_system(rate), tolerance, x0s, t_end)


def heyoka_equations_threads(equations: list, tolerance: float, x0s: np.ndarray, t_end: float) -> Callable:
    """Return a function like that of :func:`heyoka_threads` for given equations: pairs of a variable and its
    derivative."""
    hy, (batches, states) = import_peer("heyoka"), _simd_batches(x0s)
    first_integrator = hy.taylor_adaptive_batch(equations, states[0].copy(), tol=tolerance)
    integrators = [copy.deepcopy(first_integrator) for _ in range(available_cores())]

    def work(thread: int) -> np.ndarray:
        integrator, thread_batches = integrators[thread], states[thread :: len(integrators)]
        final_states = np.empty_like(thread_batches)
        for start, end in zip(thread_batches, final_states, strict=True):
            integrator.set_time(0.0)
            integrator.state[:] = start
            integrator.propagate_until(t_end)
            end[:] = integrator.state
        return final_states

    def ends():
        final_states = np.empty((batches, *states.shape[1:]))
        with ThreadPoolExecutor(len(integrators)) as threads:
            for thread, thread_states in enumerate(threads.map(work, range(len(integrators)))):
                final_states[thread :: len(integrators)] = thread_states
        return final_states.swapaxes(1, 2).reshape(-1, x0s.shape[1])[: len(x0s)]

    return ends


def heyoka_ensemble(tolerance: float, x0s: np.ndarray, t_end: float, rate: float) -> Callable:
    """Return a function that gives the final states from all x0s by heyoka's ensemble mode, one integrator copy per
    batch."""
    hy, (batches, states) = import_peer("heyoka"), _simd_batches(x0s)
    integrator = hy.taylor_adaptive_batch(_heyoka_system(rate), states[0].copy(), tol=tolerance)

    def start(integrator_copy, i):
        integrator_copy.set_time(0.0)
        integrator_copy.state[:] = states[i]
        return integrator_copy

    def ends():
        outcomes = hy.ensemble_propagate_until_batch(integrator, t_end, batches, start)
        return np.stack([outcome[0].state for outcome in outcomes]).swapaxes(1, 2).reshape(-1, 3)[: len(x0s)]

    return ends


def _simd_batches(x0s: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of batches for heyoka and the states, shape (batches, n, lanes), padded with states from the
    front."""
    lanes = import_peer("heyoka").recommended_simd_size()
    batches = -(-len(x0s) // lanes)
    return batches, np.resize(x0s, (batches, lanes, x0s.shape[1])).swapaxes(1, 2).copy()


def _heyoka_system(rate: float) -> list:
    x, y, z = import_peer("heyoka").make_vars("x", "y", "z")
    return list(zip((x, y, z), body_field(x, y, z, rate), strict=True))


def equations_for_heyoka(field: Callable, dim: int) -> list:
    """Return the equations of a vector field from its traced scalar program, so that no formula is written twice."""
    hy = import_peer("heyoka")
    program = scalarize(jax.make_jaxpr(field)(jnp.zeros(dim)))
    variables = [hy.make_vars(f"x{i}") for i in range(dim)]
    values = dict(zip(program.inputs[0], variables, strict=True))
    for target, op, args in program.instructions:
        name = str(op)
        function = getattr(operator, {"div": "truediv"}.get(name, name), None) or getattr(hy, name)
        values[target] = function(*(values[a] if isinstance(a, str) else a for a in args))
    derivatives = [values[a] if isinstance(a, str) else hy.expression(a) for a in program.outputs[0]]
    return list(zip(variables, derivatives, strict=True))


def _require_reached_end_time(hy, outcome) -> None:
    if outcome != hy.taylor_outcome.time_limit:
        raise RuntimeError(f"heyoka stopped early: {outcome}")
