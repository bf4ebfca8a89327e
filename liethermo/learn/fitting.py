"""``fit``: a system that is learned from trajectories."""

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
from .model import has_networks, scale_networks
from .observation import default_states, make_observation, n_coordinates, states_matching_rates
from .refining import can_refine, pad_runs, refine_by_least_squares
from .training import FitWarning, Phase, TrainingRun, fingerprint

T = TypeVar("T", bound=System)

BATCH_SIZES = {"matching": 256, "shooting": 32}
"""Points, and short runs, of one step."""

SHOOTING_RATE_FACTOR = 0.3
"""The rate of the shooting, relative to that of the matching before it."""


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
    """A system like the given one, with what is learned of it fitted to trajectories.

    The first part matches the vector field to the derivatives of splines through the data. The second part matches the
    states at the ends of short runs from the data (multiple shooting), whose steps obey both discrete laws. Each part
    is a descent by SOAP [Vyas et al. 2025], which is Adam in the eigenvectors of each layer's gradients, with a rate
    that falls along a cosine. The same arguments give the same result.

    If at most 64 numbers are learned, none of them in networks of this module, a third part follows the second: least
    squares over whole trajectories by Levenberg and Marquardt's method, which finds the first states too. It gives
    standard errors of the numbers, says how many combinations of them the data determine, and whether the iteration has
    converged: see :class:`Training`. The errors suppose that those of the data are independent, and that the model can
    describe the data.

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
        If the least squares have not converged, the data do not determine a number, or what the runs miss of the data
        is much more than the noise.

    Raises
    ------
    InputError
        If an argument or the data cannot be used, or nothing is learned, or the loss is not finite.
    FileError
        If the checkpoint is of another fit, or cannot be written.
    """
    began = time.perf_counter()
    if not isinstance(system, System):
        raise InputError(f"fit takes a system, such as lt.learn.Metriplectic(4), not {type(system).__name__}")
    if not isinstance(method, OneStepMethod | None):
        raise InputError(f"method is a OneStepMethod, such as lt.MetriplecticRungeKutta(4), not {method!r}")
    if not (_is_real_number(rate) and 0.0 < rate < np.inf):
        raise InputError(f"rate is a positive number, not {rate!r}")
    counts = {"matching": matching, "shooting": shooting, "batch": batch, "window": window, "substeps": substeps}
    for name, value in {**counts, "patience": patience, "seed": seed}.items():
        _check_count(name, value, 0 if name in BATCH_SIZES or name == "seed" else 1, name in ("batch", "patience"))
    if system.is_driven:
        raise InputError("a fit is for systems without an energy that depends on time, and without torques")
    seen = make_observation(system, observed, observe)
    method = MetriplecticRungeKutta(4) if method is None else method
    run = losses.differentiable_stepper(system, method, substeps, seen.group is not None)[0]
    whole = [trajectory.flat_trajectory for trajectory in parse_trajectories(data, system, seen)]
    shown = data_scales(whole)
    sigma = checked_noise(noise, shown.scale.size)
    noise_is_estimated = noise is None
    if noise_is_estimated:
        sigma = estimate_noise(whole, shown.scale)
    smooth = [spline_states_and_rates(trajectory, sigma) for trajectory in whole]
    if seen.is_full_state or has_networks(system):
        starts = [default_states(seen, run, x) for x, _ in smooth]
    else:
        starts = states_matching_rates(seen, run, smooth, shown.scale, shown.time_scale)
    states = np.concatenate(starts)
    found = shown.extend_to_states(seen.component_indices, states[:, : system.dim])
    system = scale_networks(system, found, states[:, : system.dim])
    if not seen.is_full_state and validation:
        raise InputError("validation is for data of all components: what is not observed has no start that is known")
    own = losses.parameter_vector(system, also, positive)
    if not own.initial_values.size:
        raise InputError(
            "nothing is learned of this system: give it parts of lt.learn, or name parameters with also= or positive="
        )
    share = (0.2 if seen.is_full_state else 0.0) if validation is None else validation
    train, held = _split_held_out(list(zip(whole, starts, strict=True)), share, seed)
    noisy = 1.0 if sigma is None else float(np.sqrt(np.mean((sigma / shown.scale) ** 2)))
    behind = np.ones(run.dim - system.dim)  # the numbers of an attitude
    searched = found.scale.copy()
    if sigma is not None and len(seen.component_indices):
        searched[seen.component_indices] = sigma
    searched = np.concatenate([searched, noisy * np.ones(n_coordinates(run) - system.dim)])
    units = shown.scale if sigma is None else sigma, searched, noisy * np.concatenate([found.scale, behind])

    def make_matching_objective(part: list) -> Objective:
        return losses.trajectory_matching(own, [trajectory for trajectory, _ in part], sigma, found)

    def make_shooting_objective(part: list, free: bool) -> Objective:
        pieces = cut_windows([trajectory for trajectory, _ in part], [own for _, own in part], window, free)
        return losses.shooting_objective(own, method, pieces, seen, units, substeps, free)

    phases = []
    if matching and seen.is_full_state:
        task = make_matching_objective(train)
        phases.append(
            Phase(
                "matching",
                task,
                make_matching_objective(held) if held else None,
                matching,
                rate,
                batch or BATCH_SIZES["matching"],
                own.array_shapes,
            )
        )
    free = sigma is not None or not seen.is_full_state
    if shooting:
        slower = SHOOTING_RATE_FACTOR if phases else 1.0
        task = make_shooting_objective(train, free)
        phases.append(
            Phase(
                "shooting",
                task,
                make_shooting_objective(held, False) if held else None,
                shooting,
                slower * rate,
                batch or BATCH_SIZES["shooting"],
                own.array_shapes,
            )
        )
    settings = (matching, shooting, rate, batch, window, substeps, method, share, patience, seed)
    if not phases:
        way = "matching" if seen.is_full_state else "shooting, as not all of the states is observed"
        raise InputError(f"there is nothing to do: give more than 0 iterations of the {way}")
    numbers = [values for trajectory in whole for values in trajectory]
    course = TrainingRun(
        phases,
        own.initial_values,
        fingerprint(
            *numbers, own.initial_values, sigma, seen.component_indices, *seen.fingerprint_parts(run), repr(settings)
        ),
    )
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.exists():
        course.resume(path)
    course.run(seed, patience, path, progress)
    weights, refined = course.weights, None
    if shooting and can_refine(own, system, whole, run, substeps) and "interrupted" not in course.ended.values():
        firsts = _fitted_initial_states(course.best_vector, own, train, window, free, seen, run, searched)
        parts = [pair[0] for pair in (*train, *held)]
        runs = pad_runs(parts, [*firsts, *(states[0] for _, states in held)])
        is_held_out = np.arange(len(parts)) >= len(train)
        refined = refine_by_least_squares(own, weights, method, runs, is_held_out, seen, units[:2], substeps)
        weights = refined.weights
    fitted = cast(T, own.build_system(jnp.asarray(weights)))
    training = course.training_record(time.perf_counter() - began).with_estimates(
        own, refined, sigma, noise_is_estimated
    )
    object.__setattr__(fitted, "training", training)
    for problem in training.problems:
        warn(problem, FitWarning)
    return fitted


def _fitted_initial_states(vector, own, train: list, window: int, free: bool, seen, run, searched) -> np.ndarray:
    """Return the states in which whole trajectories begin, as the shooting has found them, shape (B, N)."""
    starts = np.stack([states[0] for _, states in train])
    if not free:
        return starts
    pieces = cut_windows([trajectory for trajectory, _ in train], [states for _, states in train], window, free)
    moves = (
        np.asarray(vector)[own.start.size :].reshape(len(pieces.initial_states), -1)[pieces.first_windows] * searched
    )
    return np.asarray(jax.vmap(lambda x, z: seen.displace(run, x, z))(jnp.asarray(starts), jnp.asarray(moves)))


def _check_count(name: str, value: Any, least: int, optional: bool) -> None:
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise InputError(f"{name} is an integer >= {least}, not {value!r}")


def _is_real_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def checked_noise(noise: float | Sequence[float] | None, count: int) -> np.ndarray | None:
    """Return standard deviations of the errors of data, shape (count,); None where none are given, or 0."""
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
            f"noise is a positive standard deviation, or one for each of {count} components, not {noise!r}"
        )
    return np.broadcast_to(sigma, (count,)).copy()


def _split_held_out(data: list, share: float, seed: int) -> tuple[list, list]:
    """What is learned from, and what is held out: whole trajectories with their states, or the end of the only one."""
    if not (_is_real_number(share) and 0.0 <= share < 1.0):
        raise InputError(f"validation is a share from 0 to below 1, not {share!r}")
    if share == 0.0:
        return data, []
    if len(data) == 1:
        (t, x), states = data[0]
        cut = round((1.0 - share) * (len(t) - 1))
        if min(cut, len(t) - 1 - cut) < 1:
            return data, []
        first = Trajectory(t[: cut + 1], x[: cut + 1]), states[: cut + 1]
        return [first], [(Trajectory(t[cut:], x[cut:]), states[cut:])]
    order = np.random.default_rng(seed).permutation(len(data))
    count = min(max(1, round(share * len(data))), len(data) - 1)
    return [data[i] for i in sorted(order[count:])], [data[i] for i in sorted(order[:count])]
