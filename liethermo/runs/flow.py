"""The flow of a system as a function that JAX can differentiate, vectorise and compile."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings

from ..engines import implicit
from ..engines.stages import StageEquations, StageSolution, explicit_slopes, solve_fixed_point, solve_stages
from ..engines.stepping import (
    apply_drift_correction,
    can_correct_energy_drift,
    end_of_step,
    energy_drift_correction,
    stage_equations,
)
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..systems import System
from ..tracing.programs import jit_program, jit_unoptimised
from .adaptive import Adaptive
from .preparation import checked_initial_state, initial_state, limit_to_span, prepare_for_method
from .sensitivities import state_derivatives
from .timetable import StepSchedule


@with_library_settings
def flow(
    system: System,
    x0,
    t_span: tuple[float, float],
    step: float,
    method: OneStepMethod | None = None,
    save_every: int | None = None,
    attitude=None,
) -> jax.Array:
    """The final state of the flow from x0, a differentiable function of x0 and of the parameters of the system.

    The steps are those of :func:`integrate` with the array engine. A derivative does not pass through their iterations.
    The stage equations ``k = slopes(x, k)`` define k, and their linearisation defines its derivative (implicit function
    theorem). This derivative is exact for the discrete flow, and keeps the slopes of all its steps in memory. The
    function works under ``jax.grad``, ``jax.jacfwd``, ``jax.vmap`` and ``jax.jit``, and it has derivatives of every
    order. Parameters are the arrays among the leaves of the system, the arguments from which a function builds it, and
    numbers in closures. Without ``jax.jit`` the function runs compiled programs, which are reused for other numbers.
    They are compiled in little time where the run is short, and derivatives of small systems are interpreted. In a
    function that is called often, ``jax.jit`` makes calls quicker.

    Parameters
    ----------
    system : System
        The system. Its functions fix the units.
    x0 : array, shape (n,)
        The initial state, in the units of the system.
    t_span : (float, float)
        Start and end (in the unit of time of the system).
    step : float
        Size of all steps (time); the last one is shortened to end at the end of the span.
    method : OneStepMethod
        The integrator; by default ``MetriplecticGauss(1)``, of order 2.
    save_every : int, optional
        Return the first state, the states of every ``save_every``-th step, and the last.
    attitude : array, shape (m, m), optional
        The initial attitude (dimensionless), if a torque depends on it; the identity by default. The function returns
        momenta only.

    Returns
    -------
    array, shape (n,), or (times, n)
        The final state, the one at the end of t_span; with ``save_every`` states at several times, the final one last.
        ``(*sites, d)`` instead of n, of a system on sites. NaN from where a step could not be solved: inside a
        compiled function nothing can be raised.

    Raises
    ------
    InputError
        If an argument cannot be used.

    Examples
    --------
    >>> def end(rate):
    ...     return lt.flow(lt.models.rigid_body(rate=rate), jnp.array([0.1, 1.0, 0.1]), (0.0, 1.0), 0.1)
    >>> jax.jacfwd(end)(0.5).shape
    (3,)
    """
    method = DEFAULT_METHOD if method is None else method
    _check_arguments(system, t_span, step, method)
    x, table = system.state(x0), StepSchedule(t_span, step, save_every)
    n, shown = system.dim, system
    system, method = prepare_for_method(system, method, None, attitude is not None)
    system = limit_to_span(system, table.start, table.end)
    begin = x, table.start, attitude
    # of what is traced nothing is known that a start could be refused for
    x = jnp.asarray(
        initial_state(system, *begin) if is_traced(system, x) else checked_initial_state(system, method, *begin)
    )
    calls = tuple(table.engine_calls(max_steps=table.n_steps, max_saves=table.n_steps))
    sizes, counts = np.array([h for h, *_ in calls]), tuple((saves, every) for _, saves, every, _ in calls)
    # A derivative is that of steps whose slopes are known: their iterations are left to a program without one.
    given, last = (system, method, x), save_every is None
    known = not method.explicit and is_traced(given)
    values = _stop_gradients(given) if known else given
    newton = method.explicit or is_traced(values)
    compiled = jit_unoptimised if table.n_steps * x.size <= MAX_UNOPTIMISED_WORK else jit_program
    path, steps = compiled(_compute_path)(values, sizes, counts, newton, known, last)
    if not newton and not np.isfinite(np.asarray(path)[-1]).all():  # it is compiled where a step needs it
        path, steps = compiled(_compute_path)(values, sizes, counts, True, known, last)
    if known:
        leaves = jax.tree_util.tree_leaves(given)
        moves, moving = tuple(map(is_traced, leaves)), [leaf for leaf in leaves if is_traced(leaf)]
        order = _differentiation_order(moving)
        count = sum(leaf.size for leaf in moving)
        if order and count <= MAX_FORWARD_DIRECTIONS and count**order <= MAX_FORWARD_DERIVATIVES:
            found = _saved_path_derivatives(values, moves, order, sizes, counts, steps, last)
            path = jit_program(_taylor_path)(path, found, moving, _stop_gradients(moving))
        else:
            path = jit_program(_path_of_solved_steps)(*given, sizes, steps, last)
    path = path if path.shape[-1] == n else path[..., :n]
    return shown.points(path) if shown.space is None else path


def _check_arguments(system, t_span, step, method) -> None:
    """Raise InputError where what is given is for another kind of run."""
    if not isinstance(system, System):
        raise InputError(f"flow takes a system, such as lt.models.rigid_body(), not {type(system).__name__}")
    if not isinstance(method, OneStepMethod):
        raise InputError(f"method is a OneStepMethod, such as lt.MetriplecticGauss(2), not {method!r}")
    if isinstance(step, Adaptive):
        raise InputError("flow takes steps of one size, a number, not lt.Adaptive: lt.integrate has adaptive steps")
    if is_traced(t_span, step):
        raise InputError(
            "t_span and step are numbers, not traced: they are not differentiated or mapped. The derivative by the end "
            "time is system.vector_field at the end; for other times multiply the energy and the rates by a factor"
        )


MAX_UNOPTIMISED_WORK = 1_000
"""Steps times components up to which a program is not optimised: that would take longer than it saves in many calls."""

MAX_FORWARD_DIRECTIONS, MAX_FORWARD_DERIVATIVES = 64, 256
"""Numbers that are differentiated by, and entries of the derivative of one component, up to which a derivative is found
at once, forwards, for all that is differentiated by."""


def _stop_gradients(tree: Any) -> Any:
    """A pytree of which nothing is differentiated."""
    return jax.tree_util.tree_map(lambda a: jax.lax.stop_gradient(a) if isinstance(a, jax.Array) else a, tree)


def _differentiation_order(moving: Sequence) -> int:
    """How many derivatives are taken by some tracers whose values are known; zero where one is not known."""
    most = 0
    for leaf in moving:
        count = 0
        while isinstance(leaf, jax.core.Tracer):
            if leaf.to_concrete_value() is None:
                return 0
            leaf, count = leaf.primal, count + 1
        most = max(most, count)
    return most


def _compute_path(
    given: tuple[System, OneStepMethod, jax.Array],
    sizes,
    counts: tuple[tuple[int, int], ...],
    newton: bool,
    known: bool,
    last: bool,
) -> tuple[jax.Array, list]:
    """The states kept, the first among them, or the last alone: for programs in which all numbers are arguments.

    With ``known`` also, for each call, the state at the begin of each step, its compensation, and the slopes that solve
    its equations.
    """
    system, method, x = given
    carry, states, steps = initial_carry(system, method, x), [x[None]], []
    for i, (saves, every) in enumerate(counts):

        def step(carry, _, h=sizes[i]):
            after = differentiable_step(system, method, carry, h, solve_or_nan if newton else fixed_point_or_nan)
            return after, (*carry[:2], after[2]) if known else None

        def save(carry, _, step=step, every=every):
            carry, solved = jax.lax.scan(step, carry, length=every)
            return carry, (carry[0], solved)

        carry, (kept, solved) = jax.lax.scan(save, carry, length=saves)
        states.append(kept)
        steps.append(solved)
    return _select_saved(states, last), steps


def _select_saved(states: Sequence, last: bool) -> jax.Array:
    return states[-1][-1] if last else jnp.concatenate(states)


def _saved_path_derivatives(
    given: tuple, moves: tuple[bool, ...], order: int, sizes, counts, steps: list, last: bool
) -> list[np.ndarray]:
    """The derivatives of the path up to an order, by all leaves that move in one row: shapes (..., n, p, ..., p)."""
    each = [np.repeat(h, saves * every) for h, (saves, every) in zip(sizes, counts, strict=True)]
    parts = [[np.asarray(part).reshape(-1, *part.shape[2:]) for part in call] for call in steps]
    x, compensation, k = (np.concatenate(part) for part in zip(*parts, strict=True))
    found = state_derivatives(given, moves, order, np.concatenate(each), (x, compensation, k))
    ends = np.cumsum([0, *(every for saves, every in counts for _ in range(saves))])
    return [derivative[-1] if last else derivative[ends] for derivative in found]


def _taylor_path(path, derivatives: Sequence, moving: Sequence, here: Sequence) -> jax.Array:
    """Taylor's polynomial where it is differentiated: its derivatives there are those given."""
    d = ravel_pytree([a - b for a, b in zip(moving, here, strict=True)])[0]
    for order, term in enumerate(derivatives, start=1):
        for _ in range(order):
            term = term @ d
        path = path + term / math.factorial(order)
    return path


def _path_of_solved_steps(system: System, method: OneStepMethod, x, sizes, steps: list, last: bool) -> jax.Array:
    """The states of a path whose steps are solved: as functions of the first and of the parameters."""
    states = [x[None]]
    for i, solved in enumerate(steps):

        def step(x, known, h=sizes[i]):
            _, compensation, k = known
            k = _implicit_slopes(system, method, x, compensation, h, k)
            return method.move(system, x, compensation, h, k)[0], None

        def save(x, known, step=step):
            x, _ = jax.lax.scan(step, x, known)
            return x, x

        x, kept = jax.lax.scan(save, x, solved)
        states.append(kept)
    return _select_saved(states, last)


def _implicit_slopes(system: System, method: OneStepMethod, x, compensation, h, k) -> jax.Array:
    """The slopes of a step that are known, differentiated as the implicit function that they are."""
    return _solve_stages_implicitly(system, method, x, compensation, h, k, lambda own: own.guess)


def initial_carry(system: System, method: OneStepMethod, x) -> tuple[jax.Array, ...]:
    """What steps hand on, at the start: the state, what rounding keeps from it, the slopes of the last two steps."""
    k = method.start(system, x)
    return x, jnp.zeros_like(x), k, k


def solve_or_nan(own: StageEquations) -> jax.Array:
    """The slopes that solve the equations of a step; NaN where they are not found."""
    return _slopes_or_nan(solve_stages(own))


def fixed_point_or_nan(own: StageEquations) -> jax.Array:
    """The same by fixed-point iteration alone."""
    return _slopes_or_nan(solve_fixed_point(own))


def _slopes_or_nan(solved: StageSolution) -> jax.Array:
    return jnp.where(solved.converged, solved.k, jnp.nan)


def differentiable_step(
    system: System, method: OneStepMethod, carry: tuple[jax.Array, ...], h, solve: Callable = solve_or_nan
) -> tuple[jax.Array, ...]:
    """A step that JAX differentiates, from what :func:`initial_carry` says; NaN where it could not be solved."""
    x, compensation, k, before = carry
    if method.explicit:
        new = _slopes_or_nan(explicit_slopes(system, method, x, compensation, h, k))
    else:
        new = _solve_stages_implicitly(system, method, x, compensation, h, method.predict(k, before), solve)
    after, after_compensation, energy, *_ = end_of_step(system, method, x, compensation, h, new)
    if can_correct_energy_drift(system, method):
        after_compensation = apply_drift_correction(
            system,
            after,
            after_compensation,
            energy_drift_correction(system, after, after_compensation, energy, system.energy.value(x)),
        )
    return after, after_compensation, new, k


def _solve_stages_implicitly(
    system: System, method: OneStepMethod, x, compensation, h, guess, solve: Callable
) -> jax.Array:
    """The solution of the stage equations by ``solve``, differentiated as the implicit function that it is."""
    dynamic, static = eqx.partition((system, method, x, compensation, h), eqx.is_array)

    def slopes(dynamic, k):
        system, method, x, compensation, h = eqx.combine(dynamic, static)
        return method.slopes(system, x, compensation, h, k)

    def solution(dynamic, guess):
        system, method, x, compensation, h = eqx.combine(dynamic, static)
        return solve(stage_equations(system, method, x, compensation, h, guess, guess)._replace(guess=guess))

    return implicit.implicit_solution(solution, lambda dynamic, k: slopes(dynamic, k) - k, dynamic, guess)
