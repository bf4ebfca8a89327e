"""Property suite of state spaces."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..retractions.charts import ProjectionRetraction
from ..retractions.coordinates import coordinates_around
from ..spaces.base import Space
from .report import Report, Suite

BATCH_SIZE = 4
"""Number of random points."""

DIVERGENCE_TOLERANCE = 1e-8
"""Largest error of a divergence, compared to that by finite differences."""


def check_space(M: Space, length: float = 0.5, seed: int = 0, allowed: float = 1e-12) -> Report:
    """Check points, tangent vectors, metric and, if the space has geodesics, exponential, logarithm and transport.

    Parameters
    ----------
    M : Space
    length : float
        Length of the geodesics; at most 0.45 times the injectivity radius is used.
    allowed : float
        Largest residual, relative to the squared size of the points.

    Raises
    ------
    PropertyError
        If one of the properties does not hold.
    """
    suite, random = Suite(M.name), np.random.default_rng(seed)
    x = np.asarray(M.random(seed, (BATCH_SIZE,)))
    c, d = random.standard_normal((2, BATCH_SIZE, M.dim))
    u, v = (np.asarray(M.from_coordinates(x, w)) for w in (c, d))
    noise = random.standard_normal(x.shape)
    scale = max(1.0, float(np.abs(x).max())) ** 2 * max(1, M.dim)
    suite.check_true("shape and kind of random points", x.shape == (BATCH_SIZE, *M.shape) and x.dtype == M.dtype)
    suite.check_true("random points are in the space", bool(np.all(M.belongs(x))))
    suite.check_small("a point is its own projection", M.project(x) - x, scale, allowed)
    shifted = x + 0.01 * noise
    suite.check_true("projections are in the space", bool(np.all(M.belongs(M.project(shifted)))))
    if bool(np.all(M.belongs(shifted, 1e-4))):
        suite.skip_check("a point off the space is seen", "every array is a point")
    suite.check_small("to_vector, from_vector", M.from_vector(M.to_vector(x)) - x, scale, allowed)
    suite.check_small("tangent vectors are their own projections", M.project_tangent(x, u) - u, scale, allowed)
    suite.check_small("coordinates of vectors", np.asarray(M.coordinates(x, u)) - c, scale, allowed)
    frame = np.einsum("ba,ba...->b...", c, M.frame(x))
    suite.check_small("the frame spans the coordinates", frame - u, scale, allowed)
    suite.check_small("the frame is orthonormal", np.asarray(M.inner(x, u, v)) - (c * d).sum(1), scale, allowed)
    suite.check_small(
        "the metric is symmetric", np.asarray(M.inner(x, u, v)) - np.asarray(M.inner(x, v, u)), scale, allowed
    )
    suite.check_small("norms", np.asarray(M.norm(x, u)) ** 2 - np.asarray(M.inner(x, u, u)), scale, allowed)
    axes = tuple(range(-len(M.shape), 0))
    pairing = np.sum(np.asarray(M.flat(x, u)) * v, axis=axes).real
    suite.check_small("flat(u) v = <u, v>", pairing - np.asarray(M.inner(x, u, v)), scale, allowed)
    suite.check_small("sharp inverts flat", np.asarray(M.sharp(x, M.flat(x, u))) - u, scale, allowed)
    R = np.asarray(
        M.isotropic(x[:, None], np.broadcast_to(np.eye(M.isotropic_size), (BATCH_SIZE, *[M.isotropic_size] * 2)))
    )
    products = [np.asarray(M.inner(np.broadcast_to(x[:, None], R.shape), R, w[:, None])) for w in (u, v)]
    suite.check_small(
        "isotropic: R R^T inverts the metric", (products[0] * products[1]).sum(1) - (c * d).sum(1), scale, 10 * allowed
    )
    if M.has_geodesics or M._has_induced_metric:
        mixing_matrix = jnp.asarray(random.standard_normal((M.size, M.size))) / M.size

        def field(y):
            return M._project_tangent(y, M.from_vector(mixing_matrix @ jnp.tanh(M.to_vector(y))))

        residual = np.asarray(jax.jit(partial(M.divergence, field))(x[0])) - divergence_by_volume(M, field, x[0])
        suite.check_small("divergences are those of the volume", residual, scale, DIVERGENCE_TOLERANCE)
    if M.can_be_embedded:
        original_change, correction_change, tangent_change = _constraint_changes(M, x, noise)
        suite.check_small(
            "corrections change the equations by what is asked", correction_change - original_change, scale, allowed
        )
        suite.check_small("what is along the space changes no equation", tangent_change, scale, allowed)
    if not M.has_geodesics:
        suite.skip_check("geodesics", "the space has none of its own: its charts project")
        return suite.report()
    reach = min(length, 0.45 * M.injectivity_radius(x[0]))
    v_short = (reach / np.linalg.norm(c, axis=1)).reshape(-1, *(1,) * len(M.shape)) * u
    y = np.asarray(M.exp(x, v_short))
    scale = max(1.0, float(np.abs(x).max()), float(np.abs(y).max())) ** 2 * max(1, M.dim)
    suite.check_true("exp is in the space", bool(np.all(M.belongs(y))))
    suite.check_small("exp 0", M.exp(x, np.zeros_like(x)) - x, scale, allowed)
    suite.check_small("log inverts exp", np.asarray(M.log(x, y)) - v_short, scale, 10 * allowed)
    if M.metric == "left-invariant":
        suite.skip_check("distance and transport", "one-parameter subgroups are not the geodesics of this metric")
        return suite.report()
    suite.check_small(
        "distance is the length of the geodesic", np.asarray(M.distance(x, y)) - reach, scale, 10 * allowed
    )
    suite.check_small(
        "distance is symmetric", np.asarray(M.distance(y, x)) - np.asarray(M.distance(x, y)), scale, 10 * allowed
    )
    transported_u, transported_v = (np.asarray(M.transport(x, v_short, w)) for w in (u, v))
    suite.check_small(
        "transported vectors are tangent",
        np.asarray(M.project_tangent(y, transported_u)) - transported_u,
        scale,
        10 * allowed,
    )
    product_change = np.asarray(M.inner(y, transported_u, transported_v)) - np.asarray(M.inner(x, u, v))
    suite.check_small("transport keeps inner products", product_change, scale, 10 * allowed)
    half = np.asarray(M.exp(x, 0.5 * v_short))
    suite.check_small("midpoints", np.asarray(M.midpoint(x, y)) - half, scale, 10 * allowed)
    return suite.report()


def _constraint_changes(M: Space, x, w) -> list[np.ndarray]:
    """Return the changes of the constraints along w, along the correction for these changes, and along w made
    tangent."""

    @jax.jit
    def changes(x, w):
        change_along = lambda v: jax.jvp(M._constraints, (x,), (v + jnp.zeros_like(x),))[1]  # noqa: E731
        return change_along(w), change_along(M._correction(x, change_along(w))), change_along(M._tangential_part(x, w))

    return [np.asarray(c) for c in changes(x, np.asarray(w, dtype=M.dtype))]


def divergence_by_volume(M: Space, field, x, step: float = 2e-3) -> float:
    """Return ``d(sqrt(g) X^i)/dc_i / sqrt(g)`` in coordinates around a point, by differences of order four."""
    coordinates = coordinates_around(ProjectionRetraction(M), x)

    @jax.jit
    def flux(c):
        place = coordinates.at(c)
        frame = M._frame(place.point)
        volume = 1.0 / jnp.abs(jnp.linalg.det(jax.vmap(place.lower)(frame)))
        return volume, volume * place.lower(field(place.point))

    total, axes = 0.0, step * np.eye(M.dim)
    for i, e in enumerate(axes):
        near_flux, far_flux = (flux(k * e)[1][i] - flux(-k * e)[1][i] for k in (1, 2))
        total += float((8.0 * near_flux - far_flux) / (12.0 * step))
    return total / float(flux(np.zeros(M.dim))[0])
