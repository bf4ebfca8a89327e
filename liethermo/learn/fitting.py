"""``fit``: learn a system from trajectories."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._precision import with_library_settings
from manifolds.errors import warn

from ..errors import InputError
from ..integrators import MetriplecticRungeKutta, OneStepMethod
from ..systems import System
from . import losses
from .data import Trajectory, cut_windows, data_scales, estimate_noise, parse_trajectories, spline_states_and_rates
from .losses import Objective
from .model import has_learned_parts, scale_networks
from .observation import default_states, make_observation, n_displacement_coordinates, states_matching_rates
from .refining import can_refine, pad_runs, refine_by_least_squares
from .training import FitWarning, Phase, TrainingRun, fingerprint

T = TypeVar("T", bound=System)

BATCH_SIZES = {"matching": 256, "shooting": 32}
"""Default batch sizes: points of an iteration of the matching, and short runs of one of the shooting."""

SHOOTING_RATE_FACTOR = 0.3
"""Learning rate of the shooting, relative to that of the matching before it."""


@with_library_settings
def fit(
    system: T,
    data: Any,
    *,
    matching: int = 2000,
    shooting: int = 500,
    rate: float = 1e-2,
    batch: int | None = None,
    window: int = 4,
    substeps: int = 1,
    method: OneStepMethod | None = None,
    noise: float | Sequence[float] | None = None,
    observed: Sequence[int] | None = None,
    observe: Callable | None = None,
    validation: float | None = None,
    patience: int | None = None,
    seed: int = 0,
    also: Callable[[T], Any] | None = None,
    positive: Callable[[T], Any] | None = None,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | None = None,
) -> T:
    """Return a copy of a system whose learned parts are fitted to trajectories.

    The first phase matches the vector field to the derivatives of splines through the data. The second phase matches
    the states at the ends of short runs from the data (multiple shooting), whose steps obey both discrete laws. Both
    minimise by SOAP [Vyas et al. 2025], which is Adam in the eigenvectors of each layer's gradients, with a learning
    rate that falls along a cosine. Equal arguments give equal results.

    If at most 64 parameters are learned, none of them in networks of this module, a third phase follows: least squares
    over whole trajectories by the Levenberg-Marquardt method, which fits the initial states too. It gives standard
    errors of the parameters, the number of their combinations that the data determine, and whether the iteration has
    converged: see :class:`Training`. The standard errors assume that the errors of the data are independent, and that
    the model can describe the data.

    Parameters
    ----------
    system : System
        Any system, such as :class:`Metriplectic`, in the units of the data. The fit learns its marked parts: the
        networks of this module are marked. The energy may not depend on time, and a torque is refused.
    data : pair (t, x), list of them, or solutions
        Times of shape (m,) at any spacing, and states of shape (m, n); or (trajectories, m, n) at the same times. They
        are in the units of the system; the fit scales them by their spread.
    matching, shooting : int
        Numbers of iterations of the two parts. If not all components are observed, there is no matching.
    rate : float
        Learning rate in the matching (dimensionless); the shooting uses 0.3 of it.
    batch : int, optional
        Points, or short runs, of one iteration: 256 and 32 by default.
    window : int
        Intervals of a short run.
    substeps : int
        Steps of a run between two times of the data.
    method : OneStepMethod
        The method of the runs; by default ``MetriplecticRungeKutta(4)``, with one correction a step.
    noise : float, or array, shape (n,), optional
        Standard deviation of the errors of the data (in their units), one number or one for each number observed.
        Splines then smooth the data, losses are relative to it, and the fit also finds the initial states of the short
        runs. By default it is estimated from the data, by differences that a motion does not have; errors below a
        thousandth of the spread of the data are left out of account. 0 says that the data are exact.
    observed : sequence of int, optional
        Indices of the components that were measured; the data then have shape (m, len(observed)).
    observe : function of x, shape (n,), or of x and the attitude, shape (m, m); optional
        What was measured, an array of any shape, in place of ``observed``: ``lambda x, R: R`` for attitudes. The data
        then have shape (m, ...), in the units of what it returns; solutions are observed by it.

        If states are not observed in full, the fit finds the initial ones: only the laws determine them. A system
        without networks begins with those that move as the data do. One with networks begins with zeros.
    validation : float, optional
        Fraction of the trajectories that is held out (of a single trajectory the end). The fit returns the weights that
        do best there. By default a fifth, and 0 if not all components are observed.
    patience : int, optional
        A part of the fit ends after this number of evaluations without improvement; there is one every 50 iterations.
    seed : int
        The seed of the batches and of the held-out data.
    also, positive : function from a system to its arrays, optional
        Further parameters to fit, such as ``also=lambda s: s.energy.A``. Those of ``positive``, such as
        ``lambda s: s.dissipation.rate``, stay positive. They keep the units of the system.
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
        If the checkpoint is of another fit, or cannot be written.
    """
    start_time = time.perf_counter()
    if not isinstance(system, System):
        raise InputError(f"fit needs a system such as lt.learn.Metriplectic(4), got {type(system).__name__}")
    if not isinstance(method, OneStepMethod | None):
        raise InputError(f"method must be a OneStepMethod such as lt.MetriplecticRungeKutta(4), got {method!r}")
    if not (_is_real_number(rate) and 0.0 < rate < np.inf):
        raise InputError(f"rate must be a positive number, got {rate!r}")
    counts = {"matching": matching, "shooting": shooting, "batch": batch, "window": window, "substeps": substeps}
    for name, value in {**counts, "patience": patience, "seed": seed}.items():
        _check_count(name, value, 0 if name in BATCH_SIZES or name == "seed" else 1, name in ("batch", "patience"))
    if system.is_driven:
        raise InputError("fit needs a system without torques, whose energy does not depend on time")
    observation = make_observation(system, observed, observe)
    method = MetriplecticRungeKutta(4) if method is None else method
    run = losses.differentiable_stepper(system, method, substeps, observation.group is not None).system
    trajectories = [trajectory.flat_trajectory for trajectory in parse_trajectories(data, system, observation)]
    data_scale = data_scales(trajectories)
    sigma = checked_noise(noise, data_scale.scale.size)
    noise_is_estimated = noise is None
    if noise_is_estimated:
        sigma = estimate_noise(trajectories, data_scale.scale)
    smoothed_trajectories = [spline_states_and_rates(trajectory, sigma) for trajectory in trajectories]
    if observation.is_full_state or has_learned_parts(system):
        starts = [default_states(observation, run, x) for x, _ in smoothed_trajectories]
    else:
        starts = states_matching_rates(observation, run, smoothed_trajectories, data_scale.scale, data_scale.time_scale)
    states = np.concatenate(starts)
    state_scale = data_scale.extend_to_states(observation.component_indices, states[:, : system.dim])
    system = scale_networks(system, state_scale, states[:, : system.dim])
    if not observation.is_full_state and validation:
        raise InputError(
            "validation= cannot be combined with observed= or observe=: the initial values of unobserved components "
            "are unknown"
        )
    params = losses.parameter_vector(system, also, positive)
    if not params.initial_values.size:
        raise InputError(
            "the system has nothing to learn. Give it parts of lt.learn, or name parameters with also= or positive="
        )
    held_out_fraction = (0.2 if observation.is_full_state else 0.0) if validation is None else validation
    training_data, held_out_data = _split_held_out(
        list(zip(trajectories, starts, strict=True)), held_out_fraction, seed
    )
    relative_noise = 1.0 if sigma is None else float(np.sqrt(np.mean((sigma / data_scale.scale) ** 2)))
    attitude_units = np.ones(run.dim - system.dim)  # the numbers of an attitude
    search_units = state_scale.scale.copy()
    if sigma is not None and len(observation.component_indices):
        search_units[observation.component_indices] = sigma
    search_units = np.concatenate(
        [search_units, relative_noise * np.ones(n_displacement_coordinates(run) - system.dim)]
    )
    units = (
        data_scale.scale if sigma is None else sigma,
        search_units,
        relative_noise * np.concatenate([state_scale.scale, attitude_units]),
    )

    def make_matching_objective(data: list) -> Objective:
        return losses.trajectory_matching_objective(params, [trajectory for trajectory, _ in data], sigma, state_scale)

    def make_shooting_objective(data: list, finds_initial_states: bool) -> Objective:
        windows = cut_windows(
            [trajectory for trajectory, _ in data], [params for _, params in data], window, finds_initial_states
        )
        return losses.shooting_objective(params, method, windows, observation, units, substeps, finds_initial_states)

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
    settings = (matching, shooting, rate, batch, window, substeps, method, held_out_fraction, patience, seed)
    if not phases:
        phase_text = "matching" if observation.is_full_state else "shooting, because the state is observed in part"
        raise InputError(f"fit has no iterations. Give more than 0 of the {phase_text}")
    data_arrays = [values for trajectory in trajectories for values in trajectory]
    training_run = TrainingRun(
        phases,
        params.initial_values,
        fingerprint(
            *data_arrays,
            params.initial_values,
            sigma,
            observation.component_indices,
            *observation.fingerprint_parts(run),
            repr(settings),
        ),
    )
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.exists():
        training_run.restore(path)
    training_run.run(seed, patience, path, progress)
    weights, refined = training_run.weights, None
    if (
        shooting
        and can_refine(params, system, trajectories, run, substeps)
        and "interrupted" not in training_run.ended.values()
    ):
        initial_states = _fitted_initial_states(
            training_run.best_vector,
            params,
            training_data,
            window,
            finds_initial_states,
            observation,
            run,
            search_units,
        )
        trajectories_and_held_out = [pair[0] for pair in (*training_data, *held_out_data)]
        runs = pad_runs(trajectories_and_held_out, [*initial_states, *(states[0] for _, states in held_out_data)])
        is_held_out = np.arange(len(trajectories_and_held_out)) >= len(training_data)
        refined = refine_by_least_squares(params, weights, method, runs, is_held_out, observation, units[:2], substeps)
        weights = refined.weights
    fitted = cast(T, params.build_system(jnp.asarray(weights)))
    training = training_run.training_record(time.perf_counter() - start_time).with_estimates(
        params, refined, sigma, noise_is_estimated
    )
    object.__setattr__(fitted, "training", training)
    for problem in training.problems:
        warn(problem, FitWarning)
    return fitted


def _fitted_initial_states(
    fitted_vector,
    params,
    train: list,
    window: int,
    finds_initial_states: bool,
    observation,
    prepared_system,
    search_units,
) -> np.ndarray:
    """Return the initial states of whole trajectories, shape (B, N), as fitted by the shooting."""
    starts = np.stack([states[0] for _, states in train])
    if not finds_initial_states:
        return starts
    windows = cut_windows(
        [trajectory for trajectory, _ in train], [states for _, states in train], window, finds_initial_states
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


def _check_count(name: str, value: Any, minimum: int, optional: bool) -> None:
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise InputError(f"{name} must be an integer >= {minimum}, got {value!r}")


def _is_real_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def checked_noise(noise: float | Sequence[float] | None, count: int) -> np.ndarray | None:
    """Return standard deviations of the errors of data, shape (count,); None if ``noise`` is None or 0."""
    if noise is None:
        return None
    try:
        sigma = np.asarray(noise, dtype=np.float64)
    except (TypeError, ValueError):
        sigma = np.array(np.nan)
    if sigma.shape == () and sigma == 0.0:
        return None
    if sigma.shape not in ((), (count,)) or not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise InputError(
            f"noise must be a positive standard deviation, or one for each of {count} components, got {noise!r}"
        )
    return np.broadcast_to(sigma, (count,)).copy()


def _split_held_out(data: list, held_out_fraction: float, seed: int) -> tuple[list, list]:
    """Split data into a training set and a held-out set: whole trajectories, or the end of the only one."""
    if not (_is_real_number(held_out_fraction) and 0.0 <= held_out_fraction < 1.0):
        raise InputError(f"validation must be a fraction from 0 to below 1, got {held_out_fraction!r}")
    if held_out_fraction == 0.0:
        return data, []
    if len(data) == 1:
        (t, x), states = data[0]
        cut = round((1.0 - held_out_fraction) * (len(t) - 1))
        if min(cut, len(t) - 1 - cut) < 1:
            return data, []
        training_part = Trajectory(t[: cut + 1], x[: cut + 1]), states[: cut + 1]
        return [training_part], [(Trajectory(t[cut:], x[cut:]), states[cut:])]
    order = np.random.default_rng(seed).permutation(len(data))
    count = min(max(1, round(held_out_fraction * len(data))), len(data) - 1)
    return [data[i] for i in sorted(order[count:])], [data[i] for i in sorted(order[:count])]
