"""``fit``: learn a system from trajectories."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arguments import is_integer
from manifolds._precision import with_library_settings
from manifolds.errors import ManifoldsError, warn

from ..disk import checked_path
from ..errors import InputError, LiethermoError
from ..integrators import MetriplecticRungeKutta, OneStepMethod
from ..systems import System
from ..units import quantity_in_si
from . import losses
from .data import (
    Trajectory,
    compute_data_scales,
    cut_windows,
    estimate_noise_levels,
    parse_trajectories,
    shortest_time_scale,
    spline_states_and_rates,
)
from .least_squares import LeastSquaresProblem, fit_by_least_squares
from .losses import Objective
from .observation import (
    make_observation,
    n_displacement_coordinates,
    states_from_observations,
    states_matching_observations_and_rates,
)
from .parameters import build_with_parameters, initial_parameter_values, named_parameter_vector
from .parts import has_learned_parts, scale_networks
from .refining import (
    MAX_COLUMN_STEPS,
    MAX_PARAMETERS,
    RunModel,
    can_refine_by_least_squares,
    pad_runs,
    refine_by_least_squares,
    segments_of_whole_trajectories,
)
from .training import FitWarning, Phase, Training, TrainingRun, fingerprint, training_without_descent

T = TypeVar("T", bound=System)

BATCH_SIZES = {"matching": 256, "shooting": 32}
"""Default batch sizes: points of an iteration of the matching, and short runs of one of the shooting."""

DEFAULT_ITERATIONS = {"matching": 2000, "shooting": 500}
"""Default numbers of iterations of a fit without ``parameters=``."""

SHOOTING_RATE_FACTOR = 0.3
"""Learning rate of the shooting, relative to that of the matching before it."""


@with_library_settings
def fit(
    system: T | Callable[[dict[str, Any]], T],
    data: Any,
    *,
    parameters: Any = None,
    matching: int | None = None,
    shooting: int | None = None,
    rate: float = 1e-2,
    batch: int | None = None,
    window: int = 4,
    substeps: int | None = None,
    method: OneStepMethod | None = None,
    noise: float | str | Sequence[float | str] | None = None,
    observed: Sequence[int] | None = None,
    observe: Callable | None = None,
    validation: float | None = None,
    patience: int | None = None,
    seed: int = 0,
    also: Callable[[T], Any] | None = None,
    positive: Callable[[T], Any] | Sequence[str] | str | bool | None = None,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | None = None,
) -> T:
    """Return a copy of a system whose parameters or learned parts are fitted to trajectories.

    With ``parameters=`` a few numbers are fitted by least squares over whole trajectories, by the Levenberg-Marquardt
    method with derivatives of the discrete flow. The initial states are fitted too. The first runs are short and then
    grow (multiple shooting), so a guess that is wrong by tens of per cent does no harm. The steps are halved until the
    parameters no longer depend on them. The result has standard errors, a covariance, the number of combinations that
    the data determine, and whether the iteration has converged: see :class:`Training`. The standard errors assume that
    the errors of the data are independent, and that the model can describe the data.

    Without ``parameters=`` the fit learns networks and marked parts. The first phase matches the vector field to the
    derivatives of splines through the data. The second phase matches the states at the ends of short runs from the data
    (multiple shooting), whose steps obey both discrete laws. Both minimise by SOAP [Vyas et al. 2025], which is Adam in
    the eigenvectors of each layer's gradients, with a learning rate that falls along a cosine. If at most 64 numbers
    are learned, none of them in networks of this module, the same least squares over whole trajectories follow. Equal
    arguments give equal results.

    Parameters
    ----------
    system : System, or function from a dict of parameters to a System
        Any system, such as :class:`Metriplectic`, in the units of the data. The fit learns its marked parts: the
        networks of this module are marked. The energy may not depend on time, and a torque is refused.
    data : pair (t, x), list of them, solutions, or a table
        Times of shape (m,) at any spacing, and states of shape (m, n); or (trajectories, m, n) at the same times. They
        are in the units of the system; the fit scales them by their spread. NaN is a missing value.

        A table is a path of a CSV file, a DataFrame, a dataset of xarray, a dict of arrays, or the result of
        :func:`read_data`, which has options. Columns are matched to a dict that ``observe`` returns, by name, or in
        order. Units in their labels are converted to SI units.
    parameters : dict from names to initial values, or sequence of names, optional
        The numbers to fit, in the units of the system: arguments of the function ``system``; or parameters of a system,
        such as ``["dissipation.rate", "energy.inertia"]``, from the values that it has.
    matching, shooting : int
        Numbers of iterations of the two parts, 2000 and 500 without ``parameters=``, else 0. If not all components are
        observed, there is no matching. If both are 0, there are least squares only.
    rate : float
        Learning rate in the matching (dimensionless); the shooting uses 0.3 of it.
    batch : int, optional
        Points, or short runs, of one iteration: 256 and 32 by default.
    window : int
        Intervals of a short run of the shooting.
    substeps : int, optional
        Steps of a run between two times of the data. By default one; with least squares only, as many as needed.
    method : OneStepMethod
        The method of the runs; by default ``MetriplecticRungeKutta(4)``, with one correction a step.
    noise : float, str, or sequence of them, length n, optional
        Standard deviation of the errors of the data, one number or one for each number observed, in the units of the
        system: in SI units for a table with units. A text has a unit of its own: ``noise="0.5 deg/s"`` is 0.00873
        rad/s. Splines then smooth the data, losses are relative to it, and the fit also finds the initial states of the
        short runs. By default it is estimated from the data, by differences that a motion does not have; errors below a
        thousandth of the spread of the data are left out of account. Least squares only take it from the residuals,
        where the differences do not show it. 0 says that the data are exact.
    observed : sequence of int, optional
        Indices of the components that were measured; the data then have shape (m, len(observed)).
    observe : function, optional
        What was measured, in place of ``observed``: an array of any shape, or a dict from names of columns to numbers
        or arrays, in the units of the data. It is a function of x, shape (n,), or of x and the attitude, shape (m, m):
        ``lambda x, R: R`` for attitudes. With ``parameters=`` it is a function of (x), (x, parameters) or
        (t, x, parameters), where parameters are a dict of those that are fitted; an argument that is called ``R`` or
        ``attitude`` is the attitude. Solutions are observed by it, if it does not depend on parameters.

        If states are not observed in full, the fit finds the initial ones: only the laws determine them. A system
        without networks begins with those that move as the data do. One with networks begins with zeros.
    validation : float, optional
        Fraction of the trajectories that is held out (of a single trajectory the end). The fit returns the weights that
        do best there. By default a fifth, and 0 if not all components are observed, or with least squares only.
    patience : int, optional
        A part of the fit ends after this number of evaluations without improvement; there is one every 50 iterations.
    seed : int
        The seed of the batches and of the held-out data.
    also : function from a system to its arrays, optional
        Further parameters to fit, such as ``also=lambda s: s.energy.A``, with the descent.
    positive : bool, names, or function from a system to its arrays, optional
        Of ``parameters=`` those that stay positive, True for all. Without ``parameters=`` further parameters to fit
        that stay positive, such as ``lambda s: s.dissipation.rate``. They keep the units of the system.
    checkpoint : path, optional
        A file with the progress after each evaluation. If it exists, the fit continues from it, to the same result.
    progress : bool, optional
        Show a progress bar; by default if the standard error is a terminal.

    Returns
    -------
    System
        The fitted system, with the record in ``.training``: see :class:`Training`.

    Warns
    -----
    FitWarning
        If the least squares have not converged, the data do not determine a parameter, or the residuals of the runs are
        much larger than the noise.

    Raises
    ------
    InputError
        If an argument or the data cannot be used, or nothing is learned, or the loss is not finite.
    FileError
        If the checkpoint is of another fit or cannot be written, or a table cannot be read.

    Examples
    --------
    The rate of the dissipation of a body, from its momenta:

    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> run = lt.integrate(body, [0.3, 0.2, 1.0], (0.0, 2.0), 0.1, lt.MetriplecticGauss(3))
    >>> guess = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.3)
    >>> fitted = lt.learn.fit(guess, run, parameters=["dissipation.rate"], positive=True)
    >>> round(float(fitted.dissipation.rate / body.dissipation.rate), 4)
    1.0
    """
    start_time = time.perf_counter()
    if not isinstance(method, OneStepMethod | None):
        raise InputError(f"method must be a OneStepMethod such as lt.MetriplecticRungeKutta(4), got {method!r}")
    if not (_is_real_number(rate) and 0.0 < rate < np.inf):
        raise InputError(f"rate must be a positive number, got {rate!r}")
    matching = DEFAULT_ITERATIONS["matching"] * (parameters is None) if matching is None else matching
    shooting = DEFAULT_ITERATIONS["shooting"] * (parameters is None) if shooting is None else shooting
    counts = {"matching": matching, "shooting": shooting, "batch": batch, "window": window, "substeps": substeps}
    for name, value in {**counts, "patience": patience, "seed": seed}.items():
        is_optional = name in ("batch", "patience", "substeps")
        _check_integer(name, value, 0 if name in BATCH_SIZES or name == "seed" else 1, is_optional)
    model, values, make_params = prepare_system_and_parameters(system, parameters, also, positive)
    if model.is_driven:
        raise InputError("fit needs a system without torques, whose energy does not depend on time")
    observation = make_observation(model, observed, observe, values)
    method = MetriplecticRungeKutta(4) if method is None else method
    n_substeps = 1 if substeps is None else substeps
    prepared_system = losses.prepare_differentiable_stepper(
        model, method, n_substeps, observation.group is not None
    ).system
    trajectories = [trajectory.flat_trajectory for trajectory in parse_trajectories(data, model, observation)]
    data_scale = compute_data_scales(trajectories)
    sigma = checked_noise_std(noise, data_scale.scale.size)
    noise_is_estimated = noise is None
    noise_levels = None
    if noise_is_estimated:
        noise_levels = estimate_noise_levels(trajectories, data_scale.scale)
        sigma = noise_levels.std if noise_levels.is_noise.any() else None
    smoothed_trajectories = [spline_states_and_rates(trajectory, sigma) for trajectory in trajectories]
    if observation.is_full_state or has_learned_parts(model):
        starts = [states_from_observations(observation, prepared_system, x) for x, _ in smoothed_trajectories]
    else:
        times_and_smoothed = [
            (t, *states_and_rates) for (t, _), states_and_rates in zip(trajectories, smoothed_trajectories, strict=True)
        ]
        starts = states_matching_observations_and_rates(
            observation, prepared_system, times_and_smoothed, data_scale.scale, data_scale.time_scale, values
        )
    states = np.concatenate(starts)
    state_scale = data_scale.extend_to_states(observation.component_indices, states[:, : model.dim])
    model = scale_networks(model, state_scale, states[:, : model.dim])
    if not observation.is_full_state and validation and matching + shooting:
        raise InputError(
            "validation= cannot be combined with observed= or observe=: the initial values of unobserved components "
            "are unknown"
        )
    params = make_params(model)
    if not params.initial_values.size:
        raise InputError(
            "the system has nothing to learn. Give it parts of lt.learn, or name parameters with parameters=, also= or "
            "positive="
        )
    default_fraction = 0.2 if observation.is_full_state and matching + shooting else 0.0
    held_out_fraction = default_fraction if validation is None else validation
    training_data, held_out_data = _split_off_held_out_data(
        list(zip(trajectories, starts, strict=True)), held_out_fraction, seed
    )

    def units_for_noise(sigma: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the units of the observations, of the displacements of initial states, and of gaps between runs."""
        relative_noise = 1.0 if sigma is None else float(np.sqrt(np.mean((sigma / data_scale.scale) ** 2)))
        search_units = state_scale.scale.copy()
        if sigma is not None and len(observation.component_indices):
            search_units[observation.component_indices] = sigma
        attitude_search_units = relative_noise * np.ones(n_displacement_coordinates(prepared_system) - model.dim)
        attitude_units = np.ones(prepared_system.dim - model.dim)  # the numbers of an attitude
        return (
            data_scale.scale if sigma is None else sigma,
            np.concatenate([search_units, attitude_search_units]),
            relative_noise * np.concatenate([state_scale.scale, attitude_units]),
        )

    shape = len(training_data), model.dim
    can_be_refined = can_refine_by_least_squares(params, model, trajectories, prepared_system, n_substeps)
    if not matching and not shooting:
        if not can_be_refined:
            raise InputError(
                f"least squares alone need at most {MAX_PARAMETERS} parameters, none of them in a network, and at most "
                f"{MAX_COLUMN_STEPS:.0e} steps of all trajectories times parameters. Give more than 0 "
                "iterations of the matching or the shooting"
            )
        if checkpoint is not None:
            raise InputError("checkpoint= is for the matching and the shooting, which have no iterations. Remove it")
        rates = [rates for _, rates in smoothed_trajectories]
        problem = LeastSquaresProblem(
            params,
            method,
            observation,
            training_data,
            held_out_data,
            lambda sigma: units_for_noise(sigma)[:2],
            shortest_time_scale(rates, data_scale),
        )
        least_squares = fit_by_least_squares(problem, sigma, noise_levels, substeps)
        least_squares_result, sigma, weights = least_squares.result, least_squares.noise, least_squares.result.weights
        training = training_without_descent(params.initial_values.size, time.perf_counter() - start_time)
        return _build_fitted_system(
            params, weights, training.with_estimates(params, least_squares_result, sigma, noise_is_estimated, shape)
        )
    units = units_for_noise(sigma)

    def make_matching_objective(data: list) -> Objective:
        return losses.spline_matching_objective(params, [trajectory for trajectory, _ in data], sigma, state_scale)

    def make_shooting_objective(data: list, finds_initial_states: bool) -> Objective:
        windows = cut_windows(
            [trajectory for trajectory, _ in data], [states for _, states in data], window, finds_initial_states
        )
        return losses.shooting_objective(params, method, windows, observation, units, n_substeps, finds_initial_states)

    phases = []
    if matching and observation.is_full_state:
        objective = make_matching_objective(training_data)
        phases.append(
            Phase(
                "matching",
                objective,
                make_matching_objective(held_out_data) if held_out_data else None,
                matching,
                rate,
                batch or BATCH_SIZES["matching"],
                params.array_shapes,
            )
        )
    finds_initial_states = sigma is not None or not observation.is_full_state
    if shooting:
        rate_factor = SHOOTING_RATE_FACTOR if phases else 1.0
        objective = make_shooting_objective(training_data, finds_initial_states)
        phases.append(
            Phase(
                "shooting",
                objective,
                make_shooting_objective(held_out_data, False) if held_out_data else None,
                shooting,
                rate_factor * rate,
                batch or BATCH_SIZES["shooting"],
                params.array_shapes,
            )
        )
    settings = (matching, shooting, rate, batch, window, n_substeps, method, held_out_fraction, patience, seed)
    if not phases:
        raise InputError(
            "fit has no iterations, because the matching needs states that are observed in full. Give more than 0 of "
            "the shooting"
        )
    data_arrays = [values for trajectory in trajectories for values in trajectory]
    training_run = TrainingRun(
        phases,
        params.initial_values,
        fingerprint(
            *data_arrays,
            params.initial_values,
            sigma,
            observation.component_indices,
            *observation.fingerprint_parts(prepared_system, values),
            repr(settings),
        ),
    )
    path = None if checkpoint is None else checked_path(checkpoint, "checkpoint")
    if path is not None and path.exists():
        training_run.restore_checkpoint(path)
    training_run.run(seed, patience, path, progress)
    weights, least_squares_result_or_none = training_run.weights, None
    if shooting and can_be_refined and "interrupted" not in training_run.ended.values():
        first_states = _fitted_initial_states(
            training_run.best_vector,
            params,
            training_data,
            window,
            finds_initial_states,
            observation,
            prepared_system,
            units[1],
        )
        pairs = [*training_data, *held_out_data]
        runs = pad_runs([trajectory for trajectory, _ in pairs], [states for _, states in pairs])
        runs.states[: len(first_states), 0] = first_states
        is_held_out = np.arange(len(pairs)) >= len(training_data)
        run_model = RunModel(params, method, observation)
        least_squares_result_or_none = refine_by_least_squares(
            run_model, weights, runs, segments_of_whole_trajectories(runs), is_held_out, units[:2], n_substeps
        )
        weights = least_squares_result_or_none.weights
    training = training_run.training_record(time.perf_counter() - start_time)
    return _build_fitted_system(
        params, weights, training.with_estimates(params, least_squares_result_or_none, sigma, noise_is_estimated, shape)
    )


def prepare_system_and_parameters(
    system: Any, parameters: Any, also: Any, positive: Any
) -> tuple[System, Any, Callable]:
    """Return the system to fit, the initial values of its named parameters, and a function that makes the parameter
    vector of a system.

    The values are None if the parameters are not named.

    Raises
    ------
    InputError
        If the arguments do not choose parameters of a system.
    """
    if parameters is None:
        if not isinstance(system, System):
            hint = ". A function that builds systems needs parameters=" if callable(system) else ""
            raise InputError(f"fit needs a system such as lt.learn.Metriplectic(4), got {type(system).__name__}{hint}")
        if positive is not None and not callable(positive):
            raise InputError(f"positive must be a function of the system if parameters= is not given, got {positive!r}")
        return system, None, lambda system: losses.learned_parameter_vector(system, also, positive)
    if also is not None:
        raise InputError("also= and parameters= cannot be combined. Name all parameters to fit in parameters=")
    values = initial_parameter_values(system, parameters)
    example_system = build_with_parameters(system, values)
    if has_learned_parts(example_system):
        raise InputError("parameters= are for systems without parts of lt.learn. Fit networks with also= and positive=")
    return example_system, values, lambda _: named_parameter_vector(system, values, positive)


def _build_fitted_system(params: losses.ParameterVector, weights: np.ndarray, training: Training) -> Any:
    """Build the system with the fitted weights, attach the record of the fit, and warn of the problems of the fit.

    Raises
    ------
    InputError
        If there is no system with the fitted parameters, such as one with a negative friction.
    """
    try:
        fitted_system = params.build_system(jnp.asarray(weights))
    except (LiethermoError, ManifoldsError) as error:
        values = np.where(params.is_log, np.exp(weights), weights)
        text = ", ".join(f"{name} = {value:.3g}" for name, value in zip(params.names, values, strict=True))
        raise InputError(
            f"the least squares end at {text}, with which no system can be built: {error}. Keep such parameters "
            "positive with positive=, or begin with other initial values"
        ) from error
    object.__setattr__(fitted_system, "training", training)
    for problem in training.problems:
        warn(problem, FitWarning)
    return fitted_system


def _fitted_initial_states(
    fitted_vector,
    params,
    training_data: list,
    window: int,
    finds_initial_states: bool,
    observation,
    prepared_system,
    search_units,
) -> np.ndarray:
    """Return the initial states of the training trajectories, shape (B, N), as the shooting phase has fitted them."""
    starts = np.stack([states[0] for _, states in training_data])
    if not finds_initial_states:
        return starts
    windows = cut_windows(
        [trajectory for trajectory, _ in training_data],
        [states for _, states in training_data],
        window,
        finds_initial_states,
    )
    displacements = (
        np.asarray(fitted_vector)[params.initial_values.size :].reshape(len(windows.initial_states), -1)[
            windows.first_windows
        ]
        * search_units
    )
    return np.asarray(
        jax.vmap(lambda x, z: observation.displace(prepared_system, x, z))(
            jnp.asarray(starts), jnp.asarray(displacements)
        )
    )


def _check_integer(name: str, value: Any, minimum: int, is_optional: bool) -> None:
    """Raise InputError unless a value is an integer >= ``minimum``, or None if it is optional."""
    if is_optional and value is None:
        return
    if not is_integer(value) or value < minimum:
        raise InputError(f"{name} must be an integer >= {minimum}, got {value!r}")


def _is_real_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def checked_noise_std(noise: float | str | Sequence[float | str] | None, n_components: int) -> np.ndarray | None:
    """Return the standard deviations in the argument ``noise`` of a fit, shape (n_components,); None if it is None or
    0.

    Texts such as ``"0.5 deg/s"`` are converted to SI units.
    """
    if noise is None:
        return None
    if isinstance(noise, str):
        noise = quantity_in_si(noise)
    elif isinstance(noise, Sequence):
        noise = [quantity_in_si(value) if isinstance(value, str) else value for value in noise]
    try:
        sigma = np.asarray(noise, dtype=np.float64)
    except (TypeError, ValueError):
        sigma = np.array(np.nan)
    if sigma.shape == () and sigma == 0.0:
        return None
    if sigma.shape not in ((), (n_components,)) or not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise InputError(
            f"noise must be a positive standard deviation, or one for each of {n_components} components, got {noise!r}"
        )
    return np.broadcast_to(sigma, (n_components,)).copy()


def _split_off_held_out_data(data: list, held_out_fraction: float, seed: int) -> tuple[list, list]:
    """Split data into a training and a held-out set: by trajectories, or by time if there is only one trajectory."""
    if not (_is_real_number(held_out_fraction) and 0.0 <= held_out_fraction < 1.0):
        raise InputError(f"validation must be a fraction from 0 to below 1, got {held_out_fraction!r}")
    if held_out_fraction == 0.0:
        return data, []
    if len(data) == 1:
        (t, x), states = data[0]
        split_index = round((1.0 - held_out_fraction) * (len(t) - 1))
        if min(split_index, len(t) - 1 - split_index) < 1:
            return data, []
        training_part = Trajectory(t[: split_index + 1], x[: split_index + 1]), states[: split_index + 1]
        return [training_part], [(Trajectory(t[split_index:], x[split_index:]), states[split_index:])]
    order = np.random.default_rng(seed).permutation(len(data))
    count = min(max(1, round(held_out_fraction * len(data))), len(data) - 1)
    return [data[i] for i in sorted(order[count:])], [data[i] for i in sorted(order[:count])]
