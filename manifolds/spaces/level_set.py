"""Manifolds defined by equations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from .._content_keys import FrozenFunction
from ..errors import DomainError, IndexOutOfRangeError, ParameterError, SpaceError
from ..matrices.linear import solve_without_pivoting
from .base import MEMBERSHIP_TOLERANCE, Space, register
from .maps import inner_by_flat

MIN_GRADIENT_SINGULAR_VALUE = 1e-9
"""Smallest singular value of the normalised gradients of the constraints for which these count as independent."""

N_RANDOM_TRIALS = 16
"""Number of random arrays, of which at least one has to lead to a point."""

MIN_GRADIENT_RATIO = 1e-5
"""Length of a gradient on the manifold, relative to that at random arrays, below which it counts as zero."""

_MAX_NEWTON_STEPS = 24
"""Number of Newton steps of a projection."""


@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class LevelSet(Space):
    """Manifold of the arrays x with ``constraints(x) = 0``: ``LevelSet(lambda x: x @ x - 1, 3)`` is a sphere.

    Newton's method along the gradients projects points, and finds random ones. Points must have linearly independent
    gradients. Geodesics are integrated, see :meth:`geodesic`; there is no closed form.

    Parameters
    ----------
    constraints : function, or a sequence of functions
        From an array of the given shape to a number, or to an array of them: smooth, and independent of each other.
    shape, name : int or tuple of int, and str
        The shape of a point, and the name of the space in messages.
    metric : array, shape (n, n), or function from x to one; optional
        Positive definite (dimensionless, or in any units): inner products of flattened arrays, n their number of
        entries, restricted to the manifold. By default the sum of products.

    Raises
    ------
    SpaceError, ParameterError
        If the constraints are not such functions, depend on each other, or no random array leads to a point; if the
        shape or the metric cannot be used.

    Examples
    --------
    >>> ellipsoid = mf.LevelSet(
    ...     lambda x: x[0] ** 2 + x[1] ** 2 / 4 + x[2] ** 2 / 9 - 1, (3,)
    ... )
    >>> x = ellipsoid.point([1.0, 1.0, 1.0], project=True)
    >>> ellipsoid.dim, bool(ellipsoid.belongs(x))
    (2, True)
    """

    constraints: tuple[Callable, ...]
    sizes: tuple[int, ...]
    form: Callable | None
    name: str = "level set"

    def __init__(self, constraints, shape, metric=None, name: str = "level set"):
        functions = tuple(constraints) if isinstance(constraints, list | tuple) else (constraints,)
        sizes = tuple(shape) if isinstance(shape, list | tuple) else (shape,)
        sizes = tuple(checked_size(n, 1, "LevelSet(constraints, shape)", "a size") for n in sizes)
        for field, value in (("sizes", sizes), ("name", name)):
            object.__setattr__(self, field, value)
        labels = [f"constraint {i}" for i in range(len(functions))] if len(functions) > 1 else ["constraints"]
        frozen = tuple(_frozen_function(self, *pair) for pair in zip(functions, labels, strict=True))
        object.__setattr__(self, "constraints", frozen)
        if callable(metric):
            metric = _frozen_function(self, metric, "metric")
        object.__setattr__(
            self, "form", metric if metric is None or callable(metric) else _ConstantMetric.from_matrix(metric, self)
        )
        self._check_constraints()

    def _check_constraints(self) -> None:
        """Raise an error unless the constraints define a manifold and the metric has the right shape."""
        n_constraints = jax.eval_shape(self._constraints, jax.ShapeDtypeStruct(self.shape, jnp.float64)).shape[-1]
        if not 0 < n_constraints < self.size:
            raise SpaceError(f"{self.name}: {n_constraints} constraints on {self.size} numbers leave no manifold")
        x = jax.random.normal(jax.random.key(0), (N_RANDOM_TRIALS, *self.shape))
        singular_values = self._call_compiled("_min_gradient_singular_value", x)
        if not bool((singular_values > MIN_GRADIENT_SINGULAR_VALUE).any()):
            largest_value = float(np.nanmax(np.asarray(singular_values), initial=0.0))
            raise SpaceError(
                f"{self.name}: its constraints depend on each other: of their gradients, made unit vectors, the least "
                f"singular value is at most {largest_value:.1e} at {N_RANDOM_TRIALS} random arrays. Leave one out"
            )
        points = self._call_compiled("_project", x)
        has_point = np.asarray(jnp.isfinite(points).all(axis=self._axes))
        if not has_point.any():
            raise SpaceError(
                f"{self.name}: Newton's method finds no point of it from {N_RANDOM_TRIALS} random arrays: its "
                "constraints may contradict each other, or depend on each other at its points"
            )
        gradient_norms = [
            np.linalg.norm(np.asarray(self._call_compiled("_constraint_jacobian", y)), axis=-1) for y in (x, points)
        ]
        gradient_ratios = (gradient_norms[1][has_point] / np.median(gradient_norms[0], axis=0)).max(axis=0)
        if (gradient_ratios < MIN_GRADIENT_RATIO).any():
            i = int(np.argmin(gradient_ratios))
            raise SpaceError(
                f"{self.name}: the gradient of constraint {i} vanishes on it, near {np.asarray(points)[has_point][0]}. "
                "Give a function that changes its sign there"
            )
        if self.form is not None and self._call_compiled("_metric_at", x).shape[-2:] != (self.size, self.size):
            raise ParameterError(
                f"{self.name}: the metric must be a matrix of shape {(self.size, self.size)} at each point"
            )

    @property
    def metric(self):  # type: ignore[override]
        return "induced" if self.form is None else "given"

    @property
    def dim(self):
        return self.size - jax.eval_shape(self._constraints, jax.ShapeDtypeStruct(self.shape, jnp.float64)).shape[-1]

    @property
    def shape(self):
        return self.sizes

    def geodesic(self, x, v, steps: int = 200) -> jax.Array:
        """Return the point at time 1 of the geodesic from x with velocity v, shape ``shape``, by integration.

        The method takes classical Runge-Kutta steps for ``x' = sharp(p)``, ``p' = -d(p . sharp(p))/dx / 2``: the error
        falls like the fourth power of their number.

        Parameters
        ----------
        x, v : array, shape ``shape``
            A point, and a tangent vector there.
        steps : int
        """
        x, v = self._checked_point_and_vectors(x, v=v)
        end = self._call_compiled("_geodesic", x, v, static=(checked_size(steps, 1, "geodesic", "steps"),))
        if not bool(jnp.isfinite(end).all()):
            raise DomainError(f"{self.name}: the geodesic could not be followed with {steps} steps. Use more")
        return end

    # -- maps ---------------------------------------------------------------------------------------------------------

    def _constraints(self, x):
        batch = x.shape[: x.ndim - len(self.shape)]

        def constraints_at(y):
            return jnp.concatenate([jnp.ravel(jnp.asarray(c(y))) for c in self.constraints])

        return jax.vmap(constraints_at)(x.reshape(-1, *self.shape)).reshape(*batch, -1) if batch else constraints_at(x)

    def _project(self, x):
        x = jax.lax.fori_loop(
            0, _MAX_NEWTON_STEPS, lambda _, y: y - self._minimal_correction(y, self._constraints(y)), x
        )
        return jnp.where(self._scale(self._residual(x) <= MEMBERSHIP_TOLERANCE, jnp.ones_like(x)) > 0, x, jnp.nan)

    def _restore(self, x):
        return x - self._minimal_correction(x, self._constraints(x))

    def _residual(self, x):
        distance = jnp.abs(self._minimal_correction(x, self._constraints(x))).max(axis=self._axes)
        return distance / jnp.maximum(jnp.abs(x).max(axis=self._axes), 1.0)

    def _random(self, key, size):
        candidates = self._project(jax.random.normal(key, (N_RANDOM_TRIALS, *size, *self.shape)))
        is_point = jnp.isfinite(candidates).all(axis=self._axes, keepdims=True)
        indices = jnp.argmax(is_point, axis=0, keepdims=True)
        return jnp.take_along_axis(candidates, indices, axis=0)[0]

    def _project_tangent(self, x, w):
        return self._tangential_part(x, w)

    def _metric_at(self, x):
        assert self.form is not None
        batch, form = x.shape[: x.ndim - len(self.shape)], self.form
        matrices = jax.vmap(lambda y: jnp.asarray(form(y)))(x.reshape(-1, *self.shape))
        return matrices.reshape(*batch, *matrices.shape[1:])

    _inner = inner_by_flat

    def _metric_covector(self, x, v):
        if self.form is None:
            return v + jnp.zeros_like(x)
        return self.from_vector((self._metric_at(x) @ self.to_vector(v)[..., None])[..., 0])

    def _sharp(self, x, alpha):
        if self.form is None:
            return self._tangential_part(x, alpha)
        g, alpha = self._metric_at(x), self.to_vector(alpha + jnp.zeros_like(x))[..., None]
        columns = self._constraint_jacobian(x).swapaxes(-1, -2)
        vectors = solve_without_pivoting(g, jnp.concatenate([columns, alpha], axis=-1))
        normal, v = vectors[..., :-1], vectors[..., -1:]
        weights = solve_without_pivoting(columns.swapaxes(-1, -2) @ normal, columns.swapaxes(-1, -2) @ v)
        return self.from_vector((v - normal @ weights)[..., 0])

    @property
    def _has_induced_metric(self):
        return self.form is None

    def _min_gradient_singular_value(self, x):
        """Return the least singular value of the gradients of the constraints, made unit vectors, shape (...)."""
        rows = self._constraint_jacobian(x)
        rows = rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)
        return jnp.sqrt(jnp.linalg.eigvalsh(rows @ rows.swapaxes(-1, -2))[..., 0])

    def _geodesic(self, x, v, steps):
        def hamiltonian_rate(state):
            x, p = state
            velocity = self._sharp(x, p)
            return velocity, -0.5 * jax.grad(lambda y: self._pair(p, self._sharp(y, p)))(x)

        def runge_kutta_step(_, state):
            advance = lambda share, k: jax.tree_util.tree_map(lambda a, b: a + share / steps * b, state, k)  # noqa: E731
            a = hamiltonian_rate(state)
            b = hamiltonian_rate(advance(0.5, a))
            c = hamiltonian_rate(advance(0.5, b))
            d = hamiltonian_rate(advance(1.0, c))
            return jax.tree_util.tree_map(
                lambda y, a, b, c, d: y + (a + 2.0 * b + 2.0 * c + d) / (6.0 * steps), state, a, b, c, d
            )

        return self._project(jax.lax.fori_loop(0, steps, runge_kutta_step, (x, self._metric_covector(x, v)))[0])

    def _why_off_space(self, x, residual):
        if (
            np.isfinite(x).all()
            and not float(self._call_compiled("_min_gradient_singular_value", jnp.asarray(x)))
            > MIN_GRADIENT_SINGULAR_VALUE
        ):
            return "the gradients of its constraints depend on each other there"
        return super()._why_off_space(x, residual)


def _frozen_function(space: LevelSet, function: Callable, label: str) -> FrozenFunction:
    """Return a function of the user, traced for the shape of the points of a space; SpaceError if it cannot be used."""
    try:
        return FrozenFunction(function, space.sizes)
    except IndexOutOfRangeError as error:
        raise SpaceError(str(error.with_function(f"{space.name}: the function {label}"))) from None
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        raise SpaceError(f"{space.name}: {label} must take an array of shape {space.sizes}: {error}") from None


@dataclass(frozen=True)
class _ConstantMetric:
    """Metric with a constant matrix."""

    rows: tuple[tuple[float, ...], ...]

    @classmethod
    def from_matrix(cls, metric, space: LevelSet) -> _ConstantMetric:
        matrix = np.asarray(metric, dtype=np.float64)
        n = math.prod(space.sizes)
        if matrix.shape != (n, n) or not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
            raise ParameterError(f"{space.name}: the metric must be a symmetric matrix of shape {(n, n)}")
        if not (min_eigenvalue := np.linalg.eigvalsh(matrix)[0]) > 0.0:
            raise ParameterError(
                f"{space.name}: the metric must be positive definite, got the eigenvalue {min_eigenvalue:.3g}"
            )
        return cls(tuple(map(tuple, matrix.tolist())))

    def __call__(self, x):
        return jnp.asarray(self.rows)


def _torus_function(x):
    return (jnp.sqrt(x[0] ** 2 + x[1] ** 2) - 2.0) ** 2 + x[2] ** 2 - 1.0


register((_torus_function, 3))(LevelSet)
