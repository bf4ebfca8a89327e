"""The flow of a system as a function that JAX can differentiate, vectorise and compile."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings

from ..engines.stage_solver import (
    StageEquations,
    StageSolution,
    explicit_stage_solution,
    solve_fixed_point,
    solve_stages,
)
from ..engines.step import (
    can_correct_energy_drift,
    compensation_after_drift_correction,
    end_of_step,
    energy_drift_multiplier,
    stage_equations,
)
from ..errors import InputError
from ..functions.time_span import DeclaredTimes
from ..integrators import OneStepMethod
from ..systems import System
from ..systems.clock import system_between_breaks
from ..systems.kind_checks import require_system
from ..tracing.programs import jit_cached, jit_unoptimised
from .adaptive import Adaptive
from .flow_derivatives import solve_with_implicit_derivative, state_derivatives
from .named_parameters import replace_parameters
from .preparation import (
    checked_initial_state,
    checked_or_default_method,
    limit_time_functions_to_span,
    prepare_for_method,
)
from .schedule import StepSchedule, clip_times_to_span, make_schedule


def system_with_parameters(system_or_builder, parameters) -> System:
    """Return the system with these parameters, set by name in a system or passed to a function that builds it.

    Raises
    ------
    InputError
        If the system has no parameter of some name, or a value has another shape than the parameter.
    """
    if parameters is None:
        return system_or_builder
    if not isinstance(system_or_builder, System):
        if not callable(system_or_builder):
            raise InputError(
                f"system must be a system, or a function of parameters=, got {type(system_or_builder).__name__}"
            )
        return system_or_builder(parameters)
    if not isinstance(parameters, Mapping):
        raise InputError(
            "parameters of a system must be a dict by the names of its parameters. For parameters of another form, "
            "give a function of them that builds the system"
        )
    return replace_parameters(system_or_builder, parameters)


def checked_save_times(save_at, schedule: StepSchedule) -> jax.Array | np.ndarray:
    """Return the times of ``save_at`` as an array, shape (times,), after checking them unless they are traced."""
    times = jnp.asarray(save_at, dtype=jnp.float64) if is_traced(save_at) else np.asarray(save_at, dtype=np.float64)
    if times.ndim != 1 or not times.size:
        raise InputError(f"save_at must be a list of times, got an array of shape {times.shape}")
    if isinstance(times, jax.Array):
        return times
    if not np.isfinite(times).all():
        raise InputError(f"save_at must be a list of finite times, got {save_at!r:.60}")
    return clip_times_to_span(times, schedule.start, schedule.end, "save_at")


def states_at_times(
    system: System,
    method: OneStepMethod,
    path_states,
    path_times,
    requested_times,
    span: tuple[float, float],
    step_function: Callable,
) -> jax.Array:
    """Return the states at the requested times, shape (times, n), each by one step from the last state before its time.

    Parameters
    ----------
    path_states : array, shape (steps + 1, n)
        The initial state and the states at the ends of steps.
    path_times : array, shape (steps + 1,)
        The times of these states.
    requested_times : array, shape (times,)
    span : (float, float)
        Start and end of the run; the state at a time outside of it is NaN.
    step_function : function of (system, method, state, step size)
        Returns the next state.
    """
    start, end = span
    is_inside = (requested_times >= start) & (requested_times <= end)
    # The step has a length h > 0 where it can, for its derivative by h: the last state strictly before the time.
    index = jnp.clip(jnp.searchsorted(path_times, requested_times, side="left") - 1, 0, len(path_times) - 2)

    def end_state(x, h):
        # A step of size zero, at the start of the run, divides by zero; its derivative by the time is the velocity.
        is_zero = h == 0.0
        next_state = step_function(system, method, x, jnp.where(is_zero, path_times[1] - path_times[0], h))
        return jnp.where(is_zero, x + h * system._vector_field(x), next_state)

    states = jax.vmap(end_state)(path_states[index], requested_times - path_times[index])
    return jnp.where(is_inside[:, None], states, jnp.nan)


@with_library_settings
def flow(
    system: System,
    x0,
    t_span: tuple[float, float],
    step: float,
    method: OneStepMethod | None = None,
    save_every: int | None = None,
    attitude=None,
    save_at=None,
    parameters=None,
    breaks: Sequence[float] = (),
) -> jax.Array:
    """Return the final state of the flow from x0, a differentiable function of x0 and the parameters of the system.

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
    system : System, or function from parameters to a System
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
    attitude : array, shape (m, m), or scipy.spatial.transform.Rotation; optional
        The initial attitude (dimensionless), if a torque depends on it; the identity by default. The function returns
        momenta only.
    save_at : array, shape (times,), optional
        Times in t_span (in the unit of time of the system), in any order, traced or not. The state at such a time is
        the end of one more step, from the last state before it. So it has the order of the method, and the steps of
        the run do not depend on these times. At a traced time outside of t_span the state is NaN.
    parameters : dict from names to arrays, or pytree, optional
        Values of parameters of the system by name, such as ``{"dissipation.rate": 0.2}``, in its units, with the
        shapes that they have in the system. If ``system`` is a function, its argument.
    breaks : sequence of float
        Times (in the unit of ``t_span``) at which functions of time jump; see :func:`integrate`.

    Returns
    -------
    array, shape (n,), or (times, n)
        The final state, the one at the end of t_span; with ``save_every`` states at several times, the final one last;
        with ``save_at`` the states at these times. ``(*sites, d)`` instead of n, of a system on sites. NaN from where a
        step could not be solved: inside a compiled function nothing can be raised.

    Raises
    ------
    InputError
        If an argument cannot be used.

    Examples
    --------
    >>> def end(rate):
    ...     return lt.flow(
    ...         lt.models.rigid_body(rate=rate), jnp.array([0.1, 1.0, 0.1]), (0.0, 1.0), 0.1
    ...     )
    >>> jax.jacfwd(end)(0.5).shape
    (3,)
    >>> times = jnp.array([0.13, 0.5, 0.77])
    >>> body = lt.models.rigid_body()
    >>> lt.flow(
    ...     body,
    ...     [0.1, 1.0, 0.1],
    ...     (0.0, 1.0),
    ...     0.1,
    ...     save_at=times,
    ...     parameters={"dissipation.rate": 0.5},
    ... ).shape
    (3, 3)
    """
    method = checked_or_default_method(method)
    system = system_with_parameters(system, parameters)
    _check_fixed_step_arguments(system, t_span, step)
    if save_at is not None and save_every is not None:
        raise InputError("flow takes save_at or save_every, got both. Remove one of them")
    save_every = 1 if save_at is not None else save_every
    x, declared_times = system.state(x0), DeclaredTimes.from_tree(system)
    schedule = make_schedule(t_span, step, save_every, breaks=breaks, declared_times=declared_times)
    times = None if save_at is None else checked_save_times(save_at, schedule)
    n, user_system = system.dim, system
    system, method = prepare_for_method(system, method, None, attitude is not None)
    system = limit_time_functions_to_span(system, schedule)
    initial_arguments = x, schedule.start, attitude
    # the values of a traced state are unknown, so it cannot be checked
    x = jnp.asarray(
        system.initial_state(*initial_arguments)
        if is_traced(system, x)
        else checked_initial_state(system, method, *initial_arguments)
    )
    calls = tuple(schedule.engine_calls(max_steps=schedule.n_steps, max_saves=schedule.n_steps))
    step_sizes, save_counts = (
        np.array([h for h, *_ in calls]),
        tuple((n_saves, steps_per_save) for _, n_saves, steps_per_save, _ in calls),
    )
    # Derivatives need solved slopes only. So a program without derivatives runs the iterations.
    system_method_state, final_only = (system, method, x), save_every is None
    is_differentiated = not method.explicit and is_traced(system_method_state)
    stopped_arguments = _stop_gradients(system_method_state) if is_differentiated else system_method_state
    uses_newton = method.explicit or is_traced(stopped_arguments)
    compile_program = jit_unoptimised if schedule.n_steps * x.size <= MAX_UNOPTIMISED_WORK else jit_cached
    path, solved_steps = compile_program(_integrate_path)(
        stopped_arguments, step_sizes, save_counts, uses_newton, is_differentiated, final_only
    )
    if (
        not uses_newton and not np.isfinite(np.asarray(path)[-1]).all()
    ):  # compile Newton's method only if a step needs it
        path, solved_steps = compile_program(_integrate_path)(
            stopped_arguments, step_sizes, save_counts, True, is_differentiated, final_only
        )
    if is_differentiated:
        leaves = jax.tree_util.tree_leaves(system_method_state)
        leaf_is_traced, traced_leaves = tuple(map(is_traced, leaves)), [leaf for leaf in leaves if is_traced(leaf)]
        order = _differentiation_order(traced_leaves)
        n_directions = sum(leaf.size for leaf in traced_leaves)
        if order and n_directions <= MAX_FORWARD_DIRECTIONS and n_directions**order <= MAX_FORWARD_DERIVATIVES:
            derivatives = _saved_path_derivatives(
                stopped_arguments, leaf_is_traced, order, step_sizes, save_counts, solved_steps, final_only
            )
            path = jit_cached(_attach_derivatives)(path, derivatives, traced_leaves, _stop_gradients(traced_leaves))
        else:
            path = jit_cached(_differentiable_path_from_solved_steps)(
                *system_method_state, step_sizes, solved_steps, final_only
            )
    if times is not None:
        path = _states_at_times_by_newton_if_needed((system, method), path, schedule, times, compile_program)
    path = path if path.shape[-1] == n else path[..., :n]
    return user_system.points(path) if user_system.space is None else path


def _states_at_times_by_newton_if_needed(
    system_and_method, path_states, schedule: StepSchedule, requested_times, compile_program: Callable
) -> jax.Array:
    """Return the states at the requested times, shape (times, n); steps that do not converge use Newton's method."""
    arguments = *system_and_method, path_states, schedule.saved_times, requested_times
    span, program = (schedule.start, schedule.end), compile_program(_solve_states_at_times)
    if system_and_method[1].explicit or is_traced(arguments):
        return program(*arguments, span, True)
    states = program(*arguments, span, False)
    if np.isfinite(np.asarray(states)).all():
        return states
    return program(*arguments, span, True)


def _solve_states_at_times(
    system, method, path_states, path_times, requested_times, span: tuple[float, float], uses_newton: bool
) -> jax.Array:
    solve = solve_stages_or_nan if uses_newton else iterate_fixed_point_or_nan

    def end_state(system, method, x, h):
        return differentiable_step(system, method, initial_carry(system, method, x), h, solve)[0]

    return states_at_times(system, method, path_states, path_times, requested_times, span, end_state)


def _check_fixed_step_arguments(system, t_span, step) -> None:
    """Raise InputError unless the system is a System, the step is a number, and span and step are not traced."""
    require_system(system, "flow needs a system such as lt.models.rigid_body()")
    if isinstance(step, Adaptive):
        raise InputError("flow needs a fixed step, a number, got lt.Adaptive. For adaptive steps use lt.integrate")
    if is_traced(t_span, step):
        raise InputError(
            "t_span and step must be numbers, got traced values. The derivative by the end time is system.vector_field "
            "at the end. For derivatives by other times, integrate to t = 1 and multiply the energy and the rates by a "
            "traced duration"
        )


MAX_UNOPTIMISED_WORK = 1_000
"""Number of steps times components up to which a program is compiled without optimisation, which saves time unless it
is called very often."""

MAX_FORWARD_DIRECTIONS = 64
"""Largest number of variables by which derivatives are computed in forward mode, all at once."""

MAX_FORWARD_DERIVATIVES = 256
"""Largest number of entries of the derivative of one component that is computed in forward mode."""


def _stop_gradients(tree: Any) -> Any:
    """Return the pytree with ``jax.lax.stop_gradient`` applied to its arrays."""
    return jax.tree_util.tree_map(lambda a: jax.lax.stop_gradient(a) if isinstance(a, jax.Array) else a, tree)


def _differentiation_order(traced_leaves: Sequence) -> int:
    """Return the order of the derivatives that JAX takes by traced leaves; 0 if some leaf has no known value."""
    max_order = 0
    for leaf in traced_leaves:
        leaf_order = 0
        while isinstance(leaf, jax.core.Tracer):
            if leaf.to_concrete_value() is None:
                return 0
            leaf, leaf_order = leaf.primal, leaf_order + 1
        max_order = max(max_order, leaf_order)
    return max_order


def _integrate_path(
    system_method_state: tuple[System, OneStepMethod, jax.Array],
    step_sizes,
    save_counts: tuple[tuple[int, int], ...],
    uses_newton: bool,
    return_slopes: bool,
    final_only: bool,
) -> tuple[jax.Array, list]:
    """Return the saved states, shape (saves, n), or the final state, shape (n,), of a run with fixed steps.

    With ``return_slopes`` also return, for each engine call, the state at the start of each step, its compensation, and
    the slopes that solve its equations. All parameters are arguments, so the function can be compiled once.
    """
    system, method, x = system_method_state
    carry, states, steps = initial_carry(system, method, x), [x[None]], []
    for i, (n_saves, n_substeps) in enumerate(save_counts):

        def step(carry, _, h=step_sizes[i]):
            new_carry = differentiable_step(
                system, method, carry, h, solve_stages_or_nan if uses_newton else iterate_fixed_point_or_nan
            )
            return new_carry, (*carry[:2], new_carry[2]) if return_slopes else None

        def take_steps_of_save(carry, _, step=step, steps_per_save=n_substeps):
            carry, solved_steps = jax.lax.scan(step, carry, length=steps_per_save)
            return carry, (carry[0], solved_steps)

        carry, (saved_states, call_steps) = jax.lax.scan(take_steps_of_save, carry, length=n_saves)
        states.append(saved_states)
        steps.append(call_steps)
    return _concatenate_or_take_final(states, final_only), steps


def _concatenate_or_take_final(states_of_calls: Sequence, final_only: bool) -> jax.Array:
    return states_of_calls[-1][-1] if final_only else jnp.concatenate(states_of_calls)


def _saved_path_derivatives(
    system_method_state: tuple,
    leaf_is_traced: tuple[bool, ...],
    order: int,
    step_sizes,
    save_counts,
    solved_steps: list,
    final_only: bool,
) -> list[np.ndarray]:
    """Return the derivatives of the saved states of orders 1 to ``order``, shapes (..., n, p), (..., n, p, p), …

    The p variables are the entries of all traced leaves.
    """
    repeated_sizes = [
        np.repeat(h, n_saves * steps_per_save)
        for h, (n_saves, steps_per_save) in zip(step_sizes, save_counts, strict=True)
    ]
    flat_calls = [[np.asarray(array).reshape(-1, *array.shape[2:]) for array in call] for call in solved_steps]
    x, compensation, k = (np.concatenate(array) for array in zip(*flat_calls, strict=True))
    derivatives = state_derivatives(
        system_method_state, leaf_is_traced, order, np.concatenate(repeated_sizes), (x, compensation, k)
    )
    save_indices = np.cumsum([0, *(steps_per_save for n_saves, steps_per_save in save_counts for _ in range(n_saves))])
    return [derivative[-1] if final_only else derivative[save_indices] for derivative in derivatives]


def _attach_derivatives(path, derivatives: Sequence, traced_leaves: Sequence, leaf_values: Sequence) -> jax.Array:
    """Return the path with the given derivatives by the traced leaves.

    The path plus its Taylor polynomial in ``traced_leaves - leaf_values``, which is zero, has these derivatives.
    """
    d = ravel_pytree([a - b for a, b in zip(traced_leaves, leaf_values, strict=True)])[0]
    for order, term in enumerate(derivatives, start=1):
        for _ in range(order):
            term = term @ d
        path = path + term / math.factorial(order)
    return path


def _differentiable_path_from_solved_steps(
    system: System, method: OneStepMethod, initial_state, step_sizes, solved_steps: list, final_only: bool
) -> jax.Array:
    """Return the path of solved steps as a differentiable function of the initial state and the parameters."""
    states = [initial_state[None]]
    for i, call_steps in enumerate(solved_steps):

        def step(x, solved_step, h=step_sizes[i]):
            _, compensation, k = solved_step
            step_system = system_between_breaks(system, x)
            k = _attach_implicit_derivative_to_slopes(step_system, method, x, compensation, h, k)
            return method.move(step_system, x, compensation, h, k)[0], None

        def take_steps_of_save(x, steps_of_save, step=step):
            x, _ = jax.lax.scan(step, x, steps_of_save)
            return x, x

        initial_state, saved_states = jax.lax.scan(take_steps_of_save, initial_state, call_steps)
        states.append(saved_states)
    return _concatenate_or_take_final(states, final_only)


def _attach_implicit_derivative_to_slopes(system: System, method: OneStepMethod, x, compensation, h, k) -> jax.Array:
    """Return the solved slopes k of a step, with the derivative that the stage equations define."""
    return _solve_stages_with_implicit_derivative(
        system, method, x, compensation, h, k, lambda equations: equations.guess
    )


def initial_carry(system: System, method: OneStepMethod, x) -> tuple[jax.Array, ...]:
    """Return the carry of the first step: the state, its compensation, and the slopes of the last two steps."""
    k = method.start(system, x)
    return x, jnp.zeros_like(x), k, k


def solve_stages_or_nan(equations: StageEquations) -> jax.Array:
    """Return the slopes that solve the stage equations of a step, or NaN if the solver fails."""
    return _converged_slopes_or_nan(solve_stages(equations))


def iterate_fixed_point_or_nan(equations: StageEquations) -> jax.Array:
    """Return the slopes that solve the stage equations by fixed-point iteration, or NaN if it fails."""
    return _converged_slopes_or_nan(solve_fixed_point(equations))


def _converged_slopes_or_nan(solution: StageSolution) -> jax.Array:
    return jnp.where(solution.converged, solution.k, jnp.nan)


def differentiable_step(
    system: System, method: OneStepMethod, carry: tuple[jax.Array, ...], h, stage_solver: Callable = solve_stages_or_nan
) -> tuple[jax.Array, ...]:
    """Return the carry after one step, differentiable by JAX; NaN if the stage equations cannot be solved."""
    x, compensation, k, older_k = carry
    system = system_between_breaks(system, x)
    if method.explicit:
        new_k = _converged_slopes_or_nan(explicit_stage_solution(system, method, x, compensation, h, k))
    else:
        new_k = _solve_stages_with_implicit_derivative(
            system, method, x, compensation, h, method.predict(k, older_k), stage_solver
        )
    new_x, new_compensation, energy, *_ = end_of_step(system, method, x, compensation, h, new_k)
    if can_correct_energy_drift(system, method):
        new_compensation = compensation_after_drift_correction(
            system,
            new_x,
            new_compensation,
            energy_drift_multiplier(system, new_x, new_compensation, energy, system.energy.value(x)),
        )
    return new_x, new_compensation, new_k, k


def _solve_stages_with_implicit_derivative(
    system: System, method: OneStepMethod, x, compensation, h, guess, stage_solver: Callable
) -> jax.Array:
    """Return the slopes that ``stage_solver`` computes, with the derivative from the implicit function theorem."""
    array_leaves, static = eqx.partition((system, method, x, compensation, h), eqx.is_array)

    def slopes(array_leaves, k):
        system, method, x, compensation, h = eqx.combine(array_leaves, static)
        return method.slopes(system, x, compensation, h, k)

    def solve_from_arrays(array_leaves, guess):
        system, method, x, compensation, h = eqx.combine(array_leaves, static)
        return stage_solver(stage_equations(system, method, x, compensation, h, guess, guess)._replace(guess=guess))

    return solve_with_implicit_derivative(
        solve_from_arrays, lambda dynamic, k: slopes(dynamic, k) - k, array_leaves, guess
    )
