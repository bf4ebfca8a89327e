"""Identifiability of learned parameters: the rank of the sensitivity, and repeated fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._precision import with_library_settings
from manifolds.errors import warn

from ..errors import InputError
from ..integrators import OneStepMethod
from ..runs.integrate import integrate
from ..systems import System
from . import losses
from .data import Trajectory, compute_data_scales, estimate_noise_if_visible, parse_trajectories
from .fitting import checked_noise_std, fit, prepare_system_and_parameters
from .observation import make_observation
from .training import FitWarning

T = TypeVar("T", bound=System)

RANK_RTOL = 1e-8
"""Singular value, relative to the largest, below which a combination of parameters counts as undetermined."""


MIN_BOOTSTRAP_TRAJECTORIES = 8
"""Smallest number of trajectories for a bootstrap; draws from fewer are often equal."""

MAX_BOOTSTRAP_DRAWS = 100
"""Largest number of attempts to draw trajectories that were not drawn before."""


@dataclass(frozen=True)
class Determined:
    """Combinations of the parameters on which an observation depends, to first order.

    Attributes
    ----------
    values : ndarray, shape (p,)
        Singular values of the sensitivity, relative to the largest.
    rank : int
        Number of determined combinations.
    directions : ndarray, shape (p, p)
        Combinations as rows, the best determined first; the last ``p - rank`` change nothing. For parameters that are
        ``positive`` they refer to the logarithms.
    """

    values: np.ndarray
    rank: int
    directions: np.ndarray
    parameters: losses.ParameterVector

    @with_library_settings
    def share(self, quantity: Callable[[Any], Any]) -> np.ndarray:
        """Return how far the data determine the quantities of a system, from 0 (not at all) to 1 (fully).

        The result is the fraction of the norm of each gradient by the parameters that lies in the determined
        combinations.

        Parameters
        ----------
        quantity : function from a system to an array
            Such as an energy at some state, or the difference of two.
        """
        jacobian = _jacobian_by_parameters(self.parameters, quantity)
        determined_components = jacobian @ self.directions[: self.rank].T
        norms = np.linalg.norm(jacobian, axis=1)
        fractions = np.linalg.norm(determined_components, axis=1) / np.where(norms > 0.0, norms, 1.0)
        return np.where(norms > 0.0, fractions, 1.0)


@with_library_settings
def determined(
    system: T,
    observed: Callable[[T], Any],
    *,
    also: Callable[[T], Any] | None = None,
    positive: Callable[[T], Any] | None = None,
    tolerance: float = RANK_RTOL,
) -> Determined:
    """Return the combinations of the learned parameters that an observation determines.

    Data determine a learned energy only up to a gauge: a constant, or a function of conserved quantities. A fit does
    not reveal this; the rank of the Jacobian of the observations by the parameters does.

    Parameters
    ----------
    system : System
        The system, with the parameters of the fit.
    observed : function from such a system to an array
        The observed quantities, in units in which all are known about equally well: ``lambda s: s.vector_field(x)`` at
        the states x of the data, or the states of a run by ``lt.flow``.
    also, positive
        As for :func:`fit`.
    tolerance : float
        Singular value, relative to the largest, below which a combination counts as undetermined: the relative accuracy
        of the data.

    Raises
    ------
    InputError
        If nothing is learned.
    """
    params = losses.learned_parameter_vector(system, also, positive)
    if not params.initial_values.size:
        raise InputError(
            "the system has nothing to learn. Give it parts of lt.learn, or name parameters with also= or positive="
        )
    jacobian = _jacobian_by_parameters(params, observed)
    _, values, directions = np.linalg.svd(jacobian, full_matrices=jacobian.shape[0] < jacobian.shape[1])
    relative = np.zeros(params.initial_values.size)
    relative[: len(values)] = values / (values[0] if values[0] > 0.0 else 1.0)
    return Determined(relative, int(np.sum(relative > tolerance)), directions, params)


def _jacobian_by_parameters(params: losses.ParameterVector, quantity: Callable) -> np.ndarray:
    """Return the Jacobian of a function of a system by the learned parameters, shape (values, p)."""

    def flat_quantity(vector):
        return jnp.ravel(jnp.asarray(quantity(params.build_system(vector))))

    initial_values = jnp.asarray(params.initial_values)
    n_values = jax.eval_shape(flat_quantity, initial_values).shape[0]
    jacobian_transform = jax.jacfwd if params.initial_values.size <= n_values else jax.jacrev
    jacobian = np.asarray(jax.jit(jacobian_transform(flat_quantity))(initial_values))
    if not np.isfinite(jacobian).all():
        raise InputError("the derivative of the observations by the parameters is not finite")
    return jacobian


@dataclass(frozen=True)
class Fits:
    """Systems fitted to equal or resampled data from different initial weights.

    Attributes
    ----------
    systems : tuple of System
        The fitted systems.
    """

    systems: tuple[System, ...]

    def spread(self, quantity: Callable[[Any], Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the standard deviation of a quantity over the systems.

        Parameters
        ----------
        quantity : function from a system to an array

        Warns
        -----
        FitWarning
            If all systems have equal values; then the deviation of 0 says nothing about what the data determine.
        """
        values = np.stack([np.asarray(quantity(system)) for system in self.systems])
        if (values == values[0]).all():
            warn(
                "the quantity is equal in all fits, so its deviation of 0 is not an error: the fits had the same data "
                "and first weights, or it does not depend on what was learned. Give noise=, or more trajectories",
                FitWarning,
            )
        return values.mean(axis=0), values.std(axis=0, ddof=1)

    def forecast(
        self, x0, t_span: tuple[float, float], step: float, method: OneStepMethod | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times, mean states and standard deviations of the runs of all systems.

        The arguments are those of :func:`liethermo.integrate`.
        """
        runs = [integrate(system, x0, t_span, step, method=method) for system in self.systems]
        states = np.stack([run.x for run in runs])
        return runs[0].t, states.mean(axis=0), states.std(axis=0, ddof=1)


def several(
    build: Callable[[int], T], data: Any, number: int = 5, *, seed: int = 0, resample: bool = True, **fit_options
) -> Fits:
    """Return :class:`Fits`: several systems fitted to resampled data from different initial weights.

    With 8 trajectories or more, each fit draws as many with replacement (bootstrap). With fewer, draws are often equal.
    So each fit adds errors of the size of the noise, given or estimated, to the data, and the deviation of the fits is
    the standard error of one. Fewer trajectories without noise are drawn with replacement, no draw twice. With one
    trajectory and no noise, the fits differ in their initial weights and batches only.

    Parameters
    ----------
    build : function from a seed to a system
        Such as ``lambda seed: lt.learn.Metriplectic(4, seed=seed)``.
    data, fit_options
        As for :func:`fit`.
    number : int
        Number of fits.
    seed : int
        Seed of the first fit.
    resample : bool
        Resample the data for each fit.

    Raises
    ------
    InputError
        As for :func:`fit`.
    """
    if isinstance(number, bool) or not isinstance(number, int) or number < 2:
        raise InputError(f"number of fits must be an integer >= 2, got {number!r}")
    systems: list[System] = []
    previous_draws: set[tuple[int, ...]] = set()
    for fit_seed in range(seed, seed + number):
        system, rng = build(fit_seed), np.random.default_rng(fit_seed)
        example, values, _ = prepare_system_and_parameters(
            system, fit_options.get("parameters"), fit_options.get("also"), fit_options.get("positive")
        )
        observation = make_observation(example, fit_options.get("observed"), fit_options.get("observe"), values)
        trajectories = parse_trajectories(data, example, observation)
        sigma = (
            _given_or_estimated_noise_std(trajectories, fit_options.get("noise"))
            if resample and len(trajectories) < MIN_BOOTSTRAP_TRAJECTORIES
            else None
        )
        if sigma is not None:
            noisy_data = [
                (t, x + (sigma * rng.standard_normal((len(t), sigma.size))).reshape(x.shape)) for t, x in trajectories
            ]
            noise_option = {} if fit_options.get("noise") is None else {"noise": np.sqrt(2.0) * sigma}
            systems.append(fit(system, noisy_data, seed=fit_seed, **{**fit_options, **noise_option}))
            continue
        trajectory_indices = (
            _draw_bootstrap_indices(len(trajectories), rng, previous_draws) if resample else range(len(trajectories))
        )
        systems.append(fit(system, [trajectories[i] for i in trajectory_indices], seed=fit_seed, **fit_options))
    return Fits(tuple(systems))


def _given_or_estimated_noise_std(trajectories: list[Trajectory], noise) -> np.ndarray | None:
    """Return the standard deviations of the measurement noise, given or estimated; None if no noise is visible."""
    flat_trajectories = [trajectory.flat_trajectory for trajectory in trajectories]
    scale = compute_data_scales(flat_trajectories).scale
    return (
        estimate_noise_if_visible(flat_trajectories, scale) if noise is None else checked_noise_std(noise, scale.size)
    )


def _draw_bootstrap_indices(
    n_trajectories: int, rng: np.random.Generator, previous_draws: set[tuple[int, ...]]
) -> np.ndarray:
    """Draw trajectory indices with replacement, if possible not as in ``previous_draws``, and add them to that set."""
    for _ in range(MAX_BOOTSTRAP_DRAWS):
        indices = rng.integers(n_trajectories, size=n_trajectories)
        if tuple(sorted(indices.tolist())) not in previous_draws:
            break
    previous_draws.add(tuple(sorted(indices.tolist())))
    return indices
