"""Whether a fluctuating system comes to the equilibrium that statistical mechanics has for it."""

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
from ..integrators.fluctuating import noise_invariance
from ..runs.ensemble import ensemble
from ..runs.fluctuations import MEASURE_ROW, Fluctuations
from ..systems import System
from ..tracing.interpret import evaluate_at_points

MAX_STANDARD_ERRORS = 3.5
"""Standard errors by which a moment may miss: one of 2,000 that are right misses by more."""

N_EXACT_SAMPLES, MIN_EFFECTIVE_SAMPLES = 100_000, 1_000
"""Independent points of the exact measure, and as how many of equal weight they have to count at least."""

N_AVERAGED_STATES = 20
"""States of each path that its means are over, in the second half of its time."""

N_BISECTIONS = 60


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
    """Compare moments of many paths, in the second half of a span of time, with those of the exact measure.

    That is ``exp(S / k)`` on the level of the energy that x0 is on, or ``exp(-H / (k T))`` with a bath, on the level of
    the Casimir that noise keeps, where it keeps one: found by independent points along random rays from the origin,
    which a level has to meet once, with their statistical weights. Errors are those of the paths, which are
    independent, and of the points.

    Parameters
    ----------
    system : System
    noise : Fluctuations
    x0 : array, shape (n,), or (paths, n)
        Where paths start, all on one level.
    time, step : float
        The time has to be several times as long as the relaxation.
    paths : int
    moments : dict of functions from a state to a number, optional
        By default the components, their squares, and the entropy or the energy.
    samples : Samples, optional
        Points of the exact measure with their weights, where it is known in another way.
    errors : float
        Standard errors that a moment may miss by. The bias of a step is among what it misses.
    seed : int
        Of the points.

    Raises
    ------
    PropertyError
        If a moment misses.
    ValueError
        If the exact measure is not known, or not found.
    """
    suite = Suite(f"the equilibrium of a {system.kind}")
    report = noise.check(system)
    for check in report.rows:
        suite.rows.append(check)
        if check.axiom == MEASURE_ROW and check.residual > check.tolerance and samples is None:
            raise ValueError(f"the motion does not keep volume, so the measure is not known: give a density\n{report}")
    starts = np.broadcast_to(np.atleast_2d(np.asarray(x0, dtype=float)), (paths, system.dim))
    every = max(1, round(time / step / (2 * N_AVERAGED_STATES)))
    many = ensemble(system, starts, (0.0, time), step, noise=noise, outputs="trajectory", save_every=every)
    suite.check_true("all paths end", many.ok.all(), f"{(~many.ok).sum()} do not" if not many.ok.all() else "")
    suite.rows += [row for row in many.audit().rows if row.passed is not None]
    assert many.x is not None
    late = many.x[:, many.t >= 0.5 * time]
    exact = Samples(*samples) if samples is not None else sample_exact_measure(system, noise, starts[0], late, seed)
    weights = np.asarray(exact.weights) / np.sum(exact.weights)
    effective = 1.0 / np.sum(weights**2)
    if effective < MIN_EFFECTIVE_SAMPLES:
        raise ValueError(f"the points of the exact measure count as {effective:.0f} alone: give samples of it")
    for name, f in (_default_moments(system) if moments is None else moments).items():
        function = make_energy(f, f"moment {name!r}")
        found = (
            evaluate_at_points(energy_value, function, late.reshape(-1, system.dim))
            .reshape(late.shape[:2])
            .mean(axis=1)
        )
        value = evaluate_at_points(energy_value, function, np.asarray(exact.points))
        mean = float(weights @ value)
        own = float(np.sqrt(weights**2 @ (value - mean) ** 2))
        error = float(np.hypot(own, found.std(ddof=1) / np.sqrt(paths)))
        away = abs(float(found.mean()) - mean)
        if away <= 1e-12 * max(1.0, abs(mean)):  # what is constant has errors of rounding alone
            away = 0.0
        defect = away / error if error > 0.0 else np.inf if away else 0.0
        note = f"{found.mean():.5g}, exactly {mean:.5g} +- {own:.1g}"
        suite.rows.append(TableRow(f"<{name}> in standard errors", float(defect), errors, bool(defect <= errors), note))
    return suite.report()


def sample_exact_measure(system: System, noise: Fluctuations, x0, near: np.ndarray, seed: int = 0) -> Samples:
    """Independent points of the exact measure: see :func:`check_equilibrium`.

    Parameters
    ----------
    near : array, shape (..., n)
        States of paths, whose covariance says where to look where no level bounds the measure.

    Raises
    ------
    ValueError
        If several functions are kept, or rays do not meet a level once.
    """
    kept = {"the energy": system.energy} if system.energy_law == "conserved" else {}
    untouched = noise_invariance(system)
    kept |= {name: system.functions()[name] for name in sorted(system.first_integrals()) if untouched[name]}
    if len(kept) > 1:
        raise ValueError(f"motion and noise keep {', '.join(kept)}: for more than one give samples of the measure")
    random, n = np.random.default_rng(seed), system.dim
    directions = random.standard_normal((N_EXACT_SAMPLES, n))
    if not kept:
        spread = np.linalg.cholesky(1.5 * np.cov(near.reshape(-1, n).T).reshape(n, n))
        points, centre = directions @ spread.T, near.reshape(-1, n).mean(axis=0)
        logs = _log_density(system, noise, points + centre) + 0.5 * np.sum(directions**2, axis=1)
        return Samples(points + centre, np.exp(logs - logs.max()))
    (name, F), level = next(iter(kept.items())), jnp.asarray(x0, dtype=float)
    curvature = np.asarray(jax.hessian(F.value)(jnp.zeros(n)))
    lengths, axes = np.linalg.eigh(curvature)
    shape = (axes / np.sqrt(lengths)) @ axes.T if lengths[0] > 1e-6 * lengths[-1] > 0.0 else np.eye(n)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ shape.T
    radius, slope = evaluate_at_points(_level_crossing_on_ray, (F, level), directions).T
    if not (np.isfinite(radius) & (slope > 0.0)).all():
        raise ValueError(f"rays from the origin do not meet the level of {name} once: give samples of the measure")
    points = radius[:, None] * directions
    logs = _log_density(system, noise, points) + (n - 1) * np.log(radius) - np.log(slope)
    return Samples(points, np.exp(logs - logs.max()))


def _level_crossing_on_ray(model: tuple[Energy, jax.Array], direction):
    """How far along a ray the level of a function is, and its slope there; NaN where it is not met."""
    F, x0 = model
    level, start = F.value(x0), F.value(jnp.zeros_like(x0))

    def below(r):
        return (F.value(r * direction) - level) * (start - level) > 0.0

    size = jnp.linalg.norm(x0) / jnp.linalg.norm(direction)
    outside = jax.lax.fori_loop(0, 40, lambda _, r: jnp.where(below(r), 2.0 * r, r), size)

    def halved(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        inside = below(middle)
        return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

    low, high = jax.lax.fori_loop(0, N_BISECTIONS, halved, (0.0 * outside, outside))
    slope = jnp.dot(F.gradient(high * direction), direction) * jnp.sign(level - start)
    return jnp.stack([jnp.where(below(outside), jnp.nan, 0.5 * (low + high)), slope])


def _log_density(system: System, noise: Fluctuations, points: np.ndarray) -> np.ndarray:
    """The logarithm of the density, up to a constant."""
    found = np.zeros(len(points))
    if noise.temperature is not None:
        found = found - evaluate_at_points(energy_value, system.energy, points) / (noise.boltzmann * noise.temperature)
    if system.entropy is not None:
        found = found + evaluate_at_points(energy_value, system.entropy, points) / noise.boltzmann
    if noise.density is not None:
        found = found + evaluate_at_points(energy_value, make_energy(noise.density, "the density"), points)
    return found


def _default_moments(system: System) -> dict[str, Callable]:
    found: dict[str, Callable] = {}
    for i in range(system.dim):
        found |= {f"x{i + 1}": lambda x, i=i: x[i], f"x{i + 1}^2": lambda x, i=i: x[i] ** 2}
    if system.entropy is not None:
        return found | {"S": system.entropy}
    return found | {"H": system.energy}
