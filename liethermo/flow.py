"""The flow of a system as a function that JAX can differentiate, vectorise and compile."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from manifolds import matrix_functions

from .engine import array
from .integrators import DEFAULT_METHOD, OneStepMethod
from .systems import DrivenSystem, System, driven
from .timetable import Timetable


def flow(
    system: System,
    x0,
    t_span: tuple[float, float],
    step: float,
    method: OneStepMethod | None = None,
    save_every: int | None = None,
) -> jax.Array:
    """The state that x0 flows to, a differentiable function of x0 and of the parameters of the system.

    The steps are those of :func:`integrate` with the array engine. A derivative does not pass through their iterations:
    the stage equations ``k = slopes(x, k)`` define k, and their linearisation its derivative (implicit function
    theorem), exactly for the discrete flow. Use it under ``jax.grad``, ``jax.jacfwd``, ``jax.vmap`` and ``jax.jit``:
    the parameters are the arrays among the leaves of the system, or whatever a function builds it from.

    Parameters
    ----------
    system : System
    x0 : array, shape (n,)
    t_span : (float, float)
    step : float
        Steps of one size; the last is shortened to arrive.
    method : OneStepMethod
        ``MetriplecticGauss(1)`` by default, of order 2.
    save_every : int, optional
        Return every so-manieth state, the first and the last too.

    Returns
    -------
    array, shape (n,), or (times, n)
        NaN from where a step could not be solved: inside a compiled function nothing can be raised.

    Raises
    ------
    InputError
        If an argument cannot be used.
    """
    x, table = system.state(x0), Timetable(t_span, step, save_every)
    n, system = system.dim, driven(system)
    x = system.begin(x, table.start) if isinstance(system, DrivenSystem) else x
    method = (DEFAULT_METHOD if method is None else method).pulled(system).on(system)
    k = method.start(system, x)
    carry = (x, jnp.zeros_like(x), k, k)
    states = [x[None]]
    for h, saves, every in table.calls(limit=table.steps, saves=table.steps):
        carry, kept = _steps(system, method, carry, h, saves, every)
        states.append(kept)
    path = jnp.concatenate(states)[:, :n]
    return path[-1] if save_every is None else path


def _steps(system: System, method: OneStepMethod, carry, h: float, saves: int, every: int):
    def one_step(carry, _):
        x, low, k, before = carry
        new = _stages(system, method, x, low, h, method.predict(k, before))
        after, after_low, *_ = array.finish(system, method, x, low, h, new, system.energy.value(x))
        return (after, after_low, new, k), None

    def one_save(carry, _):
        carry, _ = jax.lax.scan(one_step, carry, length=every)
        return carry, carry[0]

    return jax.lax.scan(one_save, carry, length=saves)


def _stages(system: System, method: OneStepMethod, x, low, h: float, guess) -> jax.Array:
    """The solution of the stage equations, differentiated as the implicit function that it is."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(x)))

    def misfit(k):
        return method.slopes(system, x, low, h, k) - k

    def solve(misfit, guess):
        solved = array.solve_stages(
            lambda k: misfit(k) + k,
            guess,
            lambda k: size / h + jnp.max(jnp.abs(k)) + array.VANISHED,
            lambda k: method.jacobian(system, x, low, h, k),
            lambda: array.noise_of(system, x),
        )
        return jnp.where(solved.converged, solved.k, jnp.nan)

    def solve_linear(linear, y):
        matrix = jax.jacobian(lambda v: linear(v.reshape(y.shape)).ravel())(jnp.zeros(y.size))
        return matrix_functions.solve(matrix, y.reshape(-1, 1)).reshape(y.shape)

    return jax.lax.custom_root(misfit, jax.lax.stop_gradient(guess), solve, solve_linear)
