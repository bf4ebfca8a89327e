"""Observations: all components of a state, some of them, or a function of state, attitude, time and parameters."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..functions.time_span import required_argument_count
from ..results.solution import Solution
from ..systems import System
from ..tracing.index_check import check_indices_and_return_shapes
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message


def fast_compile_options() -> dict[str, Any]:
    """Return XLA options that compile long derivative programs faster; they run about as fast.

    A level of optimisation that the user has set is respected.
    """
    if "optimization_level" in os.environ.get("XLA_FLAGS", ""):
        return {}
    return {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}


LEVENBERG_ITERATIONS = 30
"""Number of Levenberg-Marquardt iterations in the search for an initial state."""

N_INITIAL_ATTITUDES = 16
"""Number of attitudes from which the first state of a trajectory is searched."""

INITIAL_DAMPING = 1e-2
"""Damping of the first Levenberg-Marquardt iteration, relative to the diagonal of the normal matrix."""

DAMPING_DECREASE = 0.3
"""Factor of the damping after an accepted step."""

DAMPING_INCREASE = 10.0
"""Factor of the damping after a rejected step."""


class Observation(NamedTuple):
    """The function of a state that is compared with data.

    Attributes
    ----------
    function : function of x, shape (n,), the attitude, shape (m, m), or None, the time, and the parameters
    shape : tuple of int
        Shape of one observation.
    component_indices : array of int
        Components that are observed directly, in the order of the observations; empty for a function.
    group : manifolds.MatrixGroup or None
        Group of the observed attitude.
    is_full_state : bool
        True if the whole state is observed, in the form of the system.
    names : tuple of str
        Names of the observed numbers; empty if they have none.
    needs_parameters : bool
        True if the function depends on the parameters of the fit.
    """

    function: Callable
    shape: tuple[int, ...]
    component_indices: np.ndarray
    group: mf.MatrixGroup | None
    is_full_state: bool
    names: tuple[str, ...] = ()
    needs_parameters: bool = False

    def observe(self, prepared_system: System, state, t, parameters) -> jax.Array:
        """Return the observed quantities in a state of a run at time t, as a flat array of shape (k,)."""
        layout = prepared_system.attitude_layout
        x, attitude = (state, None) if layout is None else layout.split_state(state)
        return jnp.ravel(self.function(x, attitude, t, parameters))

    def fingerprint_parts(self, prepared_system: System, parameters) -> list:
        """Return the jaxpr and the constants of the observation function, to be hashed as its identity."""
        jaxpr = jax.make_jaxpr(lambda state, t: self.observe(prepared_system, state, t, parameters))(
            jnp.asarray(states_from_observations(self, prepared_system, self.zero_observations)[0]), jnp.zeros(())
        )
        return [str(jaxpr.jaxpr), *map(np.asarray, jaxpr.consts)]

    @property
    def zero_observations(self) -> np.ndarray:
        return np.zeros((1, int(np.prod(self.shape))))

    def observe_solution(self, solution: Solution) -> jax.Array:
        """Return the observed quantities at each time of a solution, shape (m, ...).

        Raises
        ------
        InputError
            If attitudes are observed and the solution has none, or the observation depends on unknown parameters.
        """
        if self.needs_parameters:
            raise InputError(
                "observe depends on the parameters of the fit, so a solution cannot be observed before they are known. "
                "Give the observations as a pair (solution.t, values), or a function observe of x alone"
            )
        x, t = jnp.asarray(solution.x), jnp.asarray(solution.t)
        if self.group is None:
            return jax.vmap(lambda x, t: self.function(x, None, t, None))(x, t)
        if solution.attitude is None:
            raise InputError("observe needs an attitude, and a solution in the data has none")
        return jax.vmap(lambda x, R, t: self.function(x, R, t, None))(x, jnp.asarray(solution.attitude), t)

    def displace(self, prepared_system: System, state, z) -> jax.Array:
        """Return a state displaced by tangent coordinates z: x + z, and the attitude times the exponential of the
        remaining ones."""
        if (layout := prepared_system.attitude_layout) is None:
            return state + z
        (x, g), n = layout.split_state(state), layout.body_dim
        return layout.join_state(x + z[:n], g @ layout.group.exp_map(layout.group.algebra, z[n:]))


def make_observation(
    system: System,
    observed: Sequence[int] | None,
    observe: Callable | None,
    parameters: Mapping[str, Any] | None = None,
) -> Observation:
    """Make an :class:`Observation` from the arguments ``observed`` and ``observe`` of a fit.

    Parameters
    ----------
    parameters : dict of arrays, optional
        Parameters of the fit, which ``observe`` may depend on.

    Raises
    ------
    InputError, FunctionError
    """
    if observe is None:
        indices = _checked_component_indices(observed, system.dim)
        return Observation(lambda x, *arguments: x[indices], (len(indices),), indices, None, observed is None)
    if observed is not None:
        raise InputError("observed= and observe= cannot be combined. Give component numbers or a function of the state")
    kinds = _argument_kinds(observe, parameters is not None)
    group = system.matrix_group if "attitude" in kinds else None
    if "attitude" in kinds and group is None:
        raise InputError(
            "observe needs an attitude. Give the system a group, such as group=mf.SO(3); or, for a function of state "
            "and parameters, give parameters="
        )

    def function(x, attitude, t, parameters):
        values = {"x": x, "attitude": attitude, "t": t, "parameters": parameters}
        return _observation_as_array(observe(*(values[kind] for kind in kinds)))

    zero_state = jnp.zeros(system.dim), None if group is None else group.identity, jnp.zeros(())
    names: list[str] = []
    try:

        def evaluate_and_record_names(*arrays):
            argument_by_kind = dict(zip(("x", "attitude", "t", "parameters"), arrays, strict=True))
            observed_values = observe(*(argument_by_kind[kind] for kind in kinds))
            names[:] = list(entry_names(observed_values)) if isinstance(observed_values, Mapping) else []
            return _observation_as_array(observed_values)

        output_shape = check_indices_and_return_shapes(evaluate_and_record_names, *zero_state, parameters)
    except IndexOutOfRangeError as error:
        raise error.with_function(f"observe, at a state of shape ({system.dim},),") from None
    except KeyError as error:
        names_text = ", ".join(parameters or {})
        order_text = f". Its arguments are ({', '.join(kinds)})" if len(kinds) > 1 else ""
        raise InputError(
            f"observe uses the parameter {error}, but the parameters are {names_text}{order_text}"
        ) from None
    except TRACE_ERRORS as error:
        arguments_text = f" as a function of ({', '.join(kinds)})" if parameters is not None else ""
        description = f"observe could not be evaluated on a state of shape ({system.dim},){arguments_text}"
        raise FunctionError(trace_error_message(description, error)) from error
    if not jnp.issubdtype(output_shape.dtype, jnp.floating):
        raise FunctionError(f"observe must return real numbers, got {output_shape.dtype}")
    return Observation(
        function, output_shape.shape, np.zeros(0, int), group, False, tuple(names), "parameters" in kinds
    )


ATTITUDE_NAMES = ("R", "attitude")
"""Names of an argument of ``observe`` that is the attitude, where a fit has parameters."""


def _argument_kinds(observe: Any, has_parameters: bool) -> tuple[str, ...]:
    """Return the meaning of each argument of ``observe``: ``"x"``, ``"attitude"``, ``"t"`` or ``"parameters"``.

    Raises
    ------
    InputError
    """
    n_arguments = required_argument_count(observe) if callable(observe) else 0
    if not has_parameters:
        if n_arguments not in (1, 2):
            raise InputError(
                "observe must be a function of the state, or of the state and the attitude, such as lambda x, R: R; "
                "with parameters= also of (x, parameters) or (t, x, parameters)"
            )
        return ("x", "attitude")[:n_arguments]
    kinds: dict[int, tuple[str, ...]] = {1: ("x",), 2: ("x", "parameters"), 3: ("t", "x", "parameters")}
    names = list(inspect.signature(observe).parameters)[:n_arguments] if n_arguments else []
    attitude_positions = [i for i, name in enumerate(names) if name in ATTITUDE_NAMES]
    n_other_arguments = (n_arguments or 0) - len(attitude_positions)
    if n_other_arguments not in kinds or len(attitude_positions) > 1:
        raise InputError(
            "observe must be a function of (x), (x, parameters) or (t, x, parameters), and of the attitude if one of "
            f"these is called R; got {observe!r}"
        )
    result = list(kinds[n_other_arguments])
    for i in attitude_positions:
        result.insert(i, "attitude")
    return tuple(result)


def _observation_as_array(observation: Any) -> jax.Array:
    """Return an observation as an array; the arrays in a dict are concatenated."""
    if isinstance(observation, Mapping):
        return jnp.concatenate([jnp.ravel(jnp.asarray(value, dtype=jnp.float64)) for value in observation.values()])
    return jnp.asarray(observation)


def entry_names(arrays: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a name for each entry of the arrays in a dict, such as ``omega[0]``, in order."""
    return tuple(
        str(name) + (f"[{', '.join(map(str, index))}]" if np.ndim(value) else "")
        for name, value in arrays.items()
        for index in np.ndindex(np.shape(value))
    )


def _checked_component_indices(observed: Sequence[int] | None, dim: int) -> np.ndarray:
    """Return the indices of the observed components, all if ``observed`` is None; raise InputError if one is invalid
    or occurs twice."""
    if observed is None:
        return np.arange(dim)
    try:
        indices = np.asarray(observed)
    except ValueError:  # rows of different lengths
        indices = np.zeros(0)
    if (
        indices.dtype.kind not in "iu"
        or indices.ndim != 1
        or not len(indices)
        or len(set(indices.tolist())) < len(indices)
    ):
        raise InputError(f"observed must be a sequence of different component numbers, got {observed!r}")
    invalid_indices = indices[(indices < 0) | (indices >= dim)]
    if len(invalid_indices):
        raise InputError(f"observed has component {invalid_indices[0]}, but a state has the components 0 to {dim - 1}")
    return indices


def states_from_observations(observation: Observation, prepared_system: System, observations: np.ndarray) -> np.ndarray:
    """Fill states, shape (m, N), with the observed components, zeros for the others, and the identity as attitude."""
    x = np.zeros((len(observations), dim_without_attitude(prepared_system)))
    if len(observation.component_indices):
        x[:, observation.component_indices] = observations
    return x if prepared_system.attitude_layout is None else np.asarray(prepared_system.initial_state(x, batch=True))


def states_matching_observations_and_rates(
    observation: Observation,
    prepared_system: System,
    trajectories_with_rates: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    observation_scale: np.ndarray,
    time_scale: float,
    parameters: Mapping[str, Any] | None,
) -> list[np.ndarray]:
    """Find states, shape (m, N) for each trajectory, whose observations and their rates of change match the data.

    The search for each state starts from the one before it. The first search starts from several attitudes, because the
    identity may be far away.

    Parameters
    ----------
    trajectories_with_rates : list of three arrays each, shapes (m,), (m, k) and (m, k)
        Times, observations and their rates of change.
    observation_scale : array, shape (k,)
        Scales of the observations.
    time_scale : float
        Time in which the observations change by their scales.
    parameters : dict of arrays or None
        Parameters on which the observations depend.
    """
    zero, scale = jnp.zeros(n_displacement_coordinates(prepared_system)), np.tile(observation_scale, 2)

    def residual(displacement, base_state, time, observed_values, observed_rate):
        def observe(state, time):
            return observation.observe(prepared_system, state, time, parameters)

        x = observation.displace(prepared_system, base_state, displacement)
        predicted_values, predicted_rate = jax.jvp(
            observe, (x, time), (prepared_system._vector_field(x), jnp.ones_like(time))
        )
        return (
            jnp.concatenate([predicted_values - observed_values, time_scale * (predicted_rate - observed_rate)]) / scale
        )

    def solve_state(state, *data_at_time):
        def step(carry, _):
            state, damping = carry
            r, J = residual(zero, state, *data_at_time), jax.jacfwd(residual)(zero, state, *data_at_time)
            square = J.T @ J
            weights = jnp.diag(square)
            weights = jnp.where(weights > 0.0, weights, 1.0)  # coordinates without effect do not move
            new_state = observation.displace(
                prepared_system, state, -jnp.linalg.solve(square + damping * jnp.diag(weights), J.T @ r)
            )
            is_better = jnp.sum(residual(zero, new_state, *data_at_time) ** 2) < jnp.sum(r**2)
            return (
                jnp.where(is_better, new_state, state),
                damping * jnp.where(is_better, DAMPING_DECREASE, DAMPING_INCREASE),
            ), None

        return jax.lax.scan(step, (state, INITIAL_DAMPING), length=LEVENBERG_ITERATIONS)[0][0]

    def solve_states_in_turn(initial_guess, data_of_trajectory):
        def step(state, data_at_time):
            state = solve_state(state, *data_at_time)
            return state, state

        return jax.lax.scan(step, initial_guess, data_of_trajectory)[1]

    @functools.partial(jax.jit, compiler_options=fast_compile_options())
    def solve_trajectory(initial_guesses, *data_of_trajectory):
        first_data = [values[0] for values in data_of_trajectory]
        first_states = jax.vmap(lambda state: solve_state(state, *first_data))(initial_guesses)
        costs = jax.vmap(lambda state: jnp.sum(residual(zero, state, *first_data) ** 2))(first_states)
        return solve_states_in_turn(first_states[jnp.argmin(costs)], data_of_trajectory)

    random_displacements = np.random.default_rng(0).standard_normal((N_INITIAL_ATTITUDES, len(zero))) * (
        np.arange(len(zero)) >= dim_without_attitude(prepared_system)
    )
    random_displacements[0] = 0.0
    random_displacements = random_displacements[: 1 if observation.group is None else N_INITIAL_ATTITUDES]
    states = []
    for t, observations, rates in trajectories_with_rates:
        base_state = jnp.asarray(states_from_observations(observation, prepared_system, observations[:1])[0])
        initial_guesses = jax.vmap(
            lambda z, base_state=base_state: observation.displace(prepared_system, base_state, z)
        )(jnp.asarray(random_displacements))
        states.append(np.asarray(solve_trajectory(initial_guesses, *map(jnp.asarray, (t, observations, rates)))))
    return states


def dim_without_attitude(prepared_system: System) -> int:
    """Return the number of state components that do not belong to the attitude."""
    layout = prepared_system.attitude_layout
    return prepared_system.dim if layout is None else layout.body_dim


def n_displacement_coordinates(prepared_system: System) -> int:
    """Return the number of tangent coordinates by which :meth:`Observation.displace` moves a state."""
    layout = prepared_system.attitude_layout
    return dim_without_attitude(prepared_system) + (0 if layout is None else layout.group.dim)
