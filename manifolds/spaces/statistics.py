"""Means and dispersions of points of a state space, such as the attitudes of an ensemble."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import is_traced
from ..errors import DomainError, ParameterError
from .base import Space

MAX_ITERATIONS = 200
"""Largest number of iterations; each gains a digit or more within the ball in which the mean is known to be unique."""


def frechet_mean(space: Space, points, weights=None) -> jax.Array:
    """Return the point with the least mean square distance from given points, shape ``(*space.shape)``.

    The iteration ``m <- exp(m, sum_i w_i log(m, x_i))`` starts from the point of the space nearest to the mean of the
    arrays, and ends when rounding stops it. The mean is unique for points in a ball of less than half the injectivity
    radius, and of less than ``pi / (4 sqrt(K))`` for sectional curvatures up to K > 0 [Karcher 1977]; for points
    further apart the result is a point at which the mean square distance is stationary.

    Under ``jax.jit``, ``vmap`` and derivatives the mean is NaN where these errors would be raised. Its first
    derivatives are exact, by the implicit function theorem; second ones are not defined.

    Parameters
    ----------
    space : Space
        The space of the points.
    points : array, shape ``(..., *space.shape)``
        The points.
    weights : array, shape (...), optional
        Not negative, with a positive sum.

    Raises
    ------
    DomainError
        If a point is at the cut locus of the mean as far as it is found, or the iteration does not come to rest.
    OffManifoldError, ParameterError
    """
    x, w = _points_and_weights(space, points, weights)
    if is_traced(x, w):
        return _traced_mean(space, x, w)
    try:
        mean = space.project(jnp.tensordot(w, x, axes=1))
    except DomainError:  # as of antipodal points
        mean = x[0]
    step_length, min_step_length, n_stalled = np.inf, np.inf, 0
    for _ in range(MAX_ITERATIONS):
        step = jnp.tensordot(w, space.log(mean, x), axes=1)
        step_length = float(space.norm(mean, step))
        n_stalled = 0 if step_length < 0.5 * min_step_length else n_stalled + 1
        min_step_length = min(min_step_length, step_length)
        if step_length == 0.0 or (n_stalled > 2 and step_length < 1e-12 * max(1.0, float(jnp.max(jnp.abs(mean))))):
            return mean
        mean = space.exp(mean, step)
    raise DomainError(
        f"the mean on {space.name} did not come to rest: the last of {MAX_ITERATIONS} steps had the length "
        f"{step_length:.3g}. The points may be too far apart for one mean. Use points of a smaller region"
    )


def dispersion(space: Space, points, weights=None, mean=None) -> jax.Array:
    """Return the mean square distance of points from their Fréchet mean, a scalar.

    It can be traced, with first and second derivatives: see :func:`frechet_mean`.

    Parameters
    ----------
    space, points, weights
        As for :func:`frechet_mean`.
    mean : array, shape ``(*space.shape)``, optional
        Another point, from which distances are taken.
    """
    x, w = _points_and_weights(space, points, weights)
    mean = frechet_mean(space, x, w) if mean is None else mean
    return jnp.dot(w, space.distance(mean, x) ** 2)


def _traced_mean(space: Space, x: jax.Array, w: jax.Array) -> jax.Array:
    """Return the mean of traced points, NaN if the iteration does not come to rest.

    The iteration is that of :func:`frechet_mean`, without derivatives. One step of Newton's method for
    ``sum_i w_i log(m, x_i) = 0`` in coordinates around its end has the derivatives of the root.
    """
    points, weights = jax.lax.stop_gradient((x, w))

    def mean_log(mean, x, w):
        return jnp.tensordot(w, space.log(mean, x), axes=1)

    def karcher_step(state):
        mean, _, min_step_length, n_stalled, count = state
        step = mean_log(mean, points, weights)
        step_length = space.norm(mean, step)
        n_stalled = jnp.where(step_length < 0.5 * min_step_length, 0, n_stalled + 1)
        return space.exp(mean, step), step_length, jnp.minimum(min_step_length, step_length), n_stalled, count + 1

    def has_converged(state):
        mean, step_length, _, n_stalled, _ = state
        return (step_length == 0.0) | (
            (n_stalled > 2) & (step_length < 1e-12 * jnp.maximum(1.0, jnp.max(jnp.abs(mean))))
        )

    first_mean = space.project(jnp.tensordot(weights, points, axes=1))
    first_mean = jnp.where(jnp.isfinite(first_mean).all(), first_mean, points[0])
    start = first_mean, jnp.inf * jnp.ones(()), jnp.inf * jnp.ones(()), jnp.zeros((), int), jnp.zeros((), int)
    end = jax.lax.while_loop(lambda state: ~has_converged(state) & (state[-1] < MAX_ITERATIONS), karcher_step, start)
    mean = jnp.where(has_converged(end), end[0], jnp.nan)

    def mean_log_coordinates(c, x, w):
        nearby_point = space.exp(mean, space.from_coordinates(mean, c))
        return space.coordinates(nearby_point, mean_log(nearby_point, x, w))

    origin = jnp.zeros(space.dim)
    jacobian = jax.lax.stop_gradient(jax.jacfwd(mean_log_coordinates)(origin, x, w))
    correction = -jnp.linalg.solve(jacobian, mean_log_coordinates(origin, x, w))
    return space.exp(mean, space.from_coordinates(mean, correction - jax.lax.stop_gradient(correction)))


def _points_and_weights(space: Space, points, weights) -> tuple[jax.Array, jax.Array]:
    """Return the points as one batch, and their weights with the sum 1."""
    x = space.point(points)
    batch = x.shape[: x.ndim - len(space.shape)]
    x = x.reshape(-1, *space.shape)
    if len(x) == 0:
        raise ParameterError("points must not be empty")
    if weights is None:
        return x, jnp.full(len(x), 1.0 / len(x))
    w = jnp.asarray(weights, dtype=jnp.float64)
    if w.shape != batch:
        raise ParameterError(f"weights must have one weight for each point, shape {batch}, got {w.shape}")
    if not is_traced(w) and not bool((w >= 0.0).all() & (w.sum() > 0.0) & jnp.isfinite(w).all()):
        raise ParameterError("weights must be finite and not negative, with a positive sum")
    return x, w.ravel() / w.sum()
