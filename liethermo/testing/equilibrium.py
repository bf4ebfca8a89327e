"""Check that a fluctuating system reaches the equilibrium of statistical mechanics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._tables import TableRow
from manifolds.testing import Report, Suite

from ..functions.checks import energy_value
from ..functions.energy import Energy, make_energy
from ..integrators.fluctuating import noise_invariance_by_name
from ..runs.ensemble import ensemble
from ..runs.noise import MEASURE_ROW, Fluctuations
from ..systems import System
from ..tracing.interpret import evaluate_at_points

MAX_STANDARD_ERRORS = 3.5
"""Largest deviation of a moment in standard errors; one correct moment in 2,000 deviates more."""

N_EXACT_SAMPLES = 100_000
"""Number of independent points of the exact measure."""

MIN_EFFECTIVE_SAMPLES = 1_000
"""Minimum effective sample size of the weighted points of the exact measure."""

N_AVERAGED_STATES = 20
"""Number of states of each path, in the second half of its time span, that are averaged."""

N_BISECTIONS = 60
"""Number of bisections that locate a level on a ray, enough for all bits of a double."""


class Samples(NamedTuple):
    """Points of a measure, shape (m, n), and their weights, shape (m,)."""

    points: np.ndarray
    weights: np.ndarray


def check_equilibrium(
    system: System,
    noise: Fluctuations,
    x0,
    time: float,
    step: float,
    paths: int = 2_000,
    moments: Mapping[str, Callable] | None = None,
    samples: Samples | tuple[np.ndarray, np.ndarray] | None = None,
    errors: float = MAX_STANDARD_ERRORS,
    seed: int = 0,
) -> Report:
    """Check that moments of many noisy paths, in the second half of a time span, are those of the exact measure.

    The exact measure is ``exp(S / k)`` on the energy level of x0 or, with a bath, ``exp(-H / (k T))`` on the level of a
    Casimir that the noise conserves, if there is one. It is sampled by weighted independent points on random rays from
    the origin, which must meet the level once. The standard errors include those of the independent paths and of the
    points.

    Parameters
    ----------
    system : System
        The system to test.
    noise : Fluctuations
        The noise to test.
    x0 : array, shape (n,), or (paths, n)
        Initial states of the paths, all on one level.
    time, step : float
        The time has to be several relaxation times.
    paths : int
        Number of paths.
    moments : dict of functions from a state to a number, optional
        By default the components, their squares, and the entropy or the energy.
    samples : Samples, optional
        Points of the exact measure with their weights, if they are known from elsewhere.
    errors : float
        Largest deviation of a moment in standard errors. It has to cover the bias of the step size too.
    seed : int
        Seed of the points.

    Raises
    ------
    PropertyError
        If a moment deviates more.
    ValueError
        If the exact measure is unknown or cannot be sampled.
    """
    suite = Suite(f"the equilibrium of a {system.kind}")
    report = noise.check(system)
    for check in report.rows:
        suite.rows.append(check)
        if check.axiom == MEASURE_ROW and check.residual > check.tolerance and samples is None:
            raise ValueError(
                "the motion does not conserve the measure, so the equilibrium is not known. Give a density to "
                f"lt.Fluctuations, or samples=\n{report}"
            )
    starts = np.broadcast_to(np.atleast_2d(np.asarray(x0, dtype=float)), (paths, system.dim))
    save_every = max(1, round(time / step / (2 * N_AVERAGED_STATES)))
    path_ensemble = ensemble(
        system, starts, (0.0, time), step, noise=noise, outputs="trajectory", save_every=save_every
    )
    suite.check_true(
        "all paths end",
        path_ensemble.ok.all(),
        f"{(~path_ensemble.ok).sum()} do not" if not path_ensemble.ok.all() else "",
    )
    suite.rows += [row for row in path_ensemble.audit().rows if row.passed is not None]
    assert path_ensemble.x is not None
    late_states = path_ensemble.x[:, path_ensemble.t >= 0.5 * time]
    exact_samples = (
        Samples(*samples)
        if samples is not None
        else weighted_equilibrium_samples(system, noise, starts[0], late_states, seed)
    )
    weights = np.asarray(exact_samples.weights) / np.sum(exact_samples.weights)
    effective_count = 1.0 / np.sum(weights**2)
    if effective_count < MIN_EFFECTIVE_SAMPLES:
        raise ValueError(f"the points of the exact measure count as {effective_count:.0f} alone. Give samples of it")
    for name, f in (_default_moment_functions(system) if moments is None else moments).items():
        function = make_energy(f, f"moment {name!r}")
        path_means = (
            evaluate_at_points(energy_value, function, late_states.reshape(-1, system.dim))
            .reshape(late_states.shape[:2])
            .mean(axis=1)
        )
        sample_values = evaluate_at_points(energy_value, function, np.asarray(exact_samples.points))
        exact_mean = float(weights @ sample_values)
        sampling_error = float(np.sqrt(weights**2 @ (sample_values - exact_mean) ** 2))
        standard_error = float(np.hypot(sampling_error, path_means.std(ddof=1) / np.sqrt(paths)))
        difference = abs(float(path_means.mean()) - exact_mean)
        if difference <= 1e-12 * max(1.0, abs(exact_mean)):  # a constant moment has only rounding errors
            difference = 0.0
        standard_score = difference / standard_error if standard_error > 0.0 else np.inf if difference else 0.0
        note = f"{path_means.mean():.5g}, exactly {exact_mean:.5g} +- {sampling_error:.1g}"
        suite.rows.append(
            TableRow(
                f"<{name}> in standard errors", float(standard_score), errors, bool(standard_score <= errors), note
            )
        )
    return suite.report()


def weighted_equilibrium_samples(
    system: System, noise: Fluctuations, x0, path_states: np.ndarray, seed: int = 0
) -> Samples:
    """Sample the exact equilibrium measure of :func:`check_equilibrium`; return independent points and their weights.

    Parameters
    ----------
    path_states : array, shape (..., n)
        States of paths; their covariance gives the proposal if no level bounds the measure.

    Raises
    ------
    ValueError
        If several functions are conserved, or a ray does not meet a level exactly once.
    """
    invariants = {"the energy": system.energy} if system.energy_law == "conserved" else {}
    is_invariant = noise_invariance_by_name(system)
    invariants |= {name: system.functions()[name] for name in sorted(system.first_integrals()) if is_invariant[name]}
    if len(invariants) > 1:
        raise ValueError(
            f"motion and noise conserve {', '.join(invariants)}. If there are several, give samples of the measure"
        )
    rng, n = np.random.default_rng(seed), system.dim
    directions = rng.standard_normal((N_EXACT_SAMPLES, n))
    if not invariants:
        covariance_root = np.linalg.cholesky(1.5 * np.cov(path_states.reshape(-1, n).T).reshape(n, n))
        points, centre = directions @ covariance_root.T, path_states.reshape(-1, n).mean(axis=0)
        log_weights = _equilibrium_log_density(system, noise, points + centre) + 0.5 * np.sum(directions**2, axis=1)
        return Samples(points + centre, np.exp(log_weights - log_weights.max()))
    (name, F), level = next(iter(invariants.items())), jnp.asarray(x0, dtype=float)
    curvature = np.asarray(jax.hessian(F.value)(jnp.zeros(n)))
    eigenvalues, axes = np.linalg.eigh(curvature)
    level_shape = (axes / np.sqrt(eigenvalues)) @ axes.T if eigenvalues[0] > 1e-6 * eigenvalues[-1] > 0.0 else np.eye(n)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ level_shape.T
    radius, slope = evaluate_at_points(_level_distance_and_slope, (F, level), directions).T
    if not (np.isfinite(radius) & (slope > 0.0)).all():
        raise ValueError(f"rays from the origin do not meet the level of {name} once. Give samples of the measure")
    points = radius[:, None] * directions
    log_weights = _equilibrium_log_density(system, noise, points) + (n - 1) * np.log(radius) - np.log(slope)
    return Samples(points, np.exp(log_weights - log_weights.max()))


def _level_distance_and_slope(function_and_level_state: tuple[Energy, jax.Array], direction):
    """Return the distance along a ray at which a function reaches a level, and its outward slope; NaN if it does
    not."""
    F, x0 = function_and_level_state
    level, start = F.value(x0), F.value(jnp.zeros_like(x0))

    def is_before_level(r):
        return (F.value(r * direction) - level) * (start - level) > 0.0

    initial_radius = jnp.linalg.norm(x0) / jnp.linalg.norm(direction)
    outer_radius = jax.lax.fori_loop(0, 40, lambda _, r: jnp.where(is_before_level(r), 2.0 * r, r), initial_radius)

    def bisect(_, bracket):
        inner_end, outer_end = bracket
        midpoint = 0.5 * (inner_end + outer_end)
        is_inside = is_before_level(midpoint)
        return jnp.where(is_inside, midpoint, inner_end), jnp.where(is_inside, outer_end, midpoint)

    inner_end, outer_end = jax.lax.fori_loop(0, N_BISECTIONS, bisect, (0.0 * outer_radius, outer_radius))
    slope = jnp.dot(F.gradient(outer_end * direction), direction) * jnp.sign(level - start)
    return jnp.stack([jnp.where(is_before_level(outer_radius), jnp.nan, 0.5 * (inner_end + outer_end)), slope])


def _equilibrium_log_density(system: System, noise: Fluctuations, points: np.ndarray) -> np.ndarray:
    """Return the logarithm of the equilibrium density at each point, shape (m,), up to a constant."""
    log_density = np.zeros(len(points))
    if noise.temperature is not None:
        log_density = log_density - evaluate_at_points(energy_value, system.energy, points) / (
            noise.boltzmann * noise.temperature
        )
    if system.entropy is not None:
        log_density = log_density + evaluate_at_points(energy_value, system.entropy, points) / noise.boltzmann
    if noise.density is not None:
        log_density = log_density + evaluate_at_points(energy_value, make_energy(noise.density, "the density"), points)
    return log_density


def _default_moment_functions(system: System) -> dict[str, Callable]:
    """Return the default moments by name: components, their squares, and the entropy or the energy."""
    moments: dict[str, Callable] = {}
    for i in range(system.dim):
        moments |= {f"x{i + 1}": lambda x, i=i: x[i], f"x{i + 1}^2": lambda x, i=i: x[i] ** 2}
    if system.entropy is not None:
        return moments | {"S": system.entropy}
    return moments | {"H": system.energy}
