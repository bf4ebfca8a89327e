"""What data determine of a system: the rank of the sensitivity, and fits of several first weights."""

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
from .data import Trajectory, data_scales, estimate_noise, parse_trajectories
from .fitting import checked_noise, fit
from .observation import make_observation
from .training import FitWarning

T = TypeVar("T", bound=System)

RANK_RTOL = 1e-8
"""Singular values, relative to the largest, below which a combination of parameters changes nothing."""


MIN_BOOTSTRAP_TRAJECTORIES = 8
"""Trajectories from which they are drawn again: of fewer the draws are often the same."""

MAX_BOOTSTRAP_DRAWS = 100
"""Draws of trajectories in the search for one that has not been drawn before."""


@dataclass(frozen=True)
class Determined:
    """Which combinations of the parameters something depends on, to first order.

    Attributes
    ----------
    values : ndarray, shape (p,)
        Singular values of the sensitivity, relative to the largest.
    rank : int
        How many combinations are determined.
    directions : ndarray, shape (p, p)
        Combinations, a row each, by what they are determined: the last ``p - rank`` change nothing. Those of
        parameters that are ``positive`` are of their logarithms.
    """

    values: np.ndarray
    rank: int
    directions: np.ndarray
    parameters: losses.ParameterVector

    @with_library_settings
    def share(self, quantity: Callable[[Any], Any]) -> np.ndarray:
        """How far quantities are determined: 1 where fully, 0 where not at all.

        The share of the length of each gradient by the parameters that lies in the combinations that are determined.

        Parameters
        ----------
        quantity : function from a system to an array
            Such as an energy at some state, or the difference of two.
        """
        rows = _parameter_jacobian(self.parameters, quantity)
        along = rows @ self.directions[: self.rank].T
        sizes = np.linalg.norm(rows, axis=1)
        found = np.linalg.norm(along, axis=1) / np.where(sizes > 0.0, sizes, 1.0)
        return np.where(sizes > 0.0, found, 1.0)


@with_library_settings
def determined(
    system: T,
    observed: Callable[[T], Any],
    *,
    also: Callable[[T], Any] | None = None,
    positive: Callable[[T], Any] | None = None,
    tolerance: float = RANK_RTOL,
) -> Determined:
    """Which combinations of the learned parameters are determined by what is observed.

    A learned energy is known up to what the data cannot tell: a constant, a function of what is conserved. No fit shows
    that; the rank of the derivative of what is observed by the parameters does.

    Parameters
    ----------
    system : System
    observed : function from such a system to an array
        What the data are of, in units in which all are known about equally well: ``lambda s: s.vector_field(x)`` at the
        states x of the data, or the states of a run by ``lt.flow``.
    also, positive
        As of :func:`fit`.
    tolerance : float
        Singular value, relative to the largest, below which a combination counts as not determined: what the data are
        known to.

    Raises
    ------
    InputError
        If nothing is learned.
    """
    own = losses.parameter_vector(system, also, positive)
    if not own.initial_values.size:
        raise InputError("nothing is learned of this system, so there is nothing to determine")
    jacobian = _parameter_jacobian(own, observed)
    _, values, directions = np.linalg.svd(jacobian, full_matrices=jacobian.shape[0] < jacobian.shape[1])
    relative = np.zeros(own.initial_values.size)
    relative[: len(values)] = values / (values[0] if values[0] > 0.0 else 1.0)
    return Determined(relative, int(np.sum(relative > tolerance)), directions, own)


def _parameter_jacobian(own: losses.ParameterVector, quantity: Callable) -> np.ndarray:
    def values(vector):
        return jnp.ravel(jnp.asarray(quantity(own.build_system(vector))))

    start = jnp.asarray(own.initial_values)
    size = jax.eval_shape(values, start).shape[0]
    by = jax.jacfwd if own.initial_values.size <= size else jax.jacrev
    found = np.asarray(jax.jit(by(values))(start))
    if not np.isfinite(found).all():
        raise InputError("the derivative of what is observed by the parameters is not finite")
    return found


@dataclass(frozen=True)
class Fits:
    """Systems fitted to the same data from different first weights.

    Attributes
    ----------
    systems : tuple of System
    """

    systems: tuple[System, ...]

    def spread(self, quantity: Callable[[Any], Any]) -> tuple[np.ndarray, np.ndarray]:
        """The mean and the standard deviation of a quantity over the systems.

        Parameters
        ----------
        quantity : function from a system to an array

        Warns
        -----
        FitWarning
            If all systems have the same values: then their deviation of 0 says nothing of what the data determine.
        """
        found = np.stack([np.asarray(quantity(system)) for system in self.systems])
        if (found == found[0]).all():
            warn(
                "the quantity is equal in all fits, so its deviation of 0 is no error: the fits had the same data and "
                "first weights, or it does not depend on what was learned. Give noise=, or more trajectories",
                FitWarning,
            )
        return found.mean(axis=0), found.std(axis=0, ddof=1)

    def forecast(
        self, x0, t_span: tuple[float, float], step: float, method: OneStepMethod | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times, mean states and their standard deviations, shapes (times,) and (times, n); arguments of integrate."""
        runs = [integrate(system, x0, t_span, step, method=method) for system in self.systems]
        states = np.stack([run.x for run in runs])
        return runs[0].t, states.mean(axis=0), states.std(axis=0, ddof=1)


def several(
    build: Callable[[int], T], data: Any, number: int = 5, *, seed: int = 0, resample: bool = True, **how
) -> Fits:
    """Fits from different first weights to data that are drawn again from those given: how far they agree.

    From 8 trajectories or more, each fit draws as many with replacement (bootstrap). Draws of fewer are often the same.
    Then each fit has the data with further errors of the size of the noise, given or estimated, and the deviation of
    the fits is the standard error of one. Fewer trajectories without noise are drawn too, no draw twice. If there is
    only one, without noise, the fits differ in their first weights and batches alone.

    Parameters
    ----------
    build : function from a seed to a system
        Such as ``lambda seed: lt.learn.Metriplectic(4, seed=seed)``.
    data, how
        As of :func:`fit`.
    number : int
        Of fits.
    seed : int
        Of the first.
    resample : bool
        Draw data again for each fit.

    Raises
    ------
    InputError
        As of :func:`fit`.
    """
    if isinstance(number, bool) or not isinstance(number, int) or number < 2:
        raise InputError(f"number of fits is an integer >= 2, not {number!r}")
    systems: list[System] = []
    drawn: set[tuple[int, ...]] = set()
    for own in range(seed, seed + number):
        system, random = build(own), np.random.default_rng(own)
        whole = parse_trajectories(data, system, make_observation(system, how.get("observed"), how.get("observe")))
        sigma = _noise_std(whole, how.get("noise")) if resample and len(whole) < MIN_BOOTSTRAP_TRAJECTORIES else None
        if sigma is not None:
            noisy = [(t, x + (sigma * random.standard_normal((len(t), sigma.size))).reshape(x.shape)) for t, x in whole]
            more = {} if how.get("noise") is None else {"noise": np.sqrt(2.0) * sigma}
            systems.append(fit(system, noisy, seed=own, **{**how, **more}))
            continue
        chosen = _draw_bootstrap_indices(len(whole), random, drawn) if resample else range(len(whole))
        systems.append(fit(system, [whole[i] for i in chosen], seed=own, **how))
    return Fits(tuple(systems))


def _noise_std(whole: list[Trajectory], noise) -> np.ndarray | None:
    """Return the standard deviations of the errors of data, given or estimated; None where there are none."""
    flat = [trajectory.flat_trajectory for trajectory in whole]
    size = data_scales(flat).scale
    return estimate_noise(flat, size) if noise is None else checked_noise(noise, size.size)


def _draw_bootstrap_indices(count: int, random: np.random.Generator, drawn: set[tuple[int, ...]]) -> np.ndarray:
    """Draw so many out of as many, with replacement, and remember it; another draw than before, where there is one."""
    for _ in range(MAX_BOOTSTRAP_DRAWS):
        chosen = random.integers(count, size=count)
        if tuple(sorted(chosen.tolist())) not in drawn:
            break
    drawn.add(tuple(sorted(chosen.tolist())))
    return chosen
