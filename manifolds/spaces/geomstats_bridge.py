"""Any geomstats manifold with a metric as a state space, through callbacks to the host.

geomstats runs in NumPy: a compiled program stops at every call and hands the arrays over. Such a space is therefore
slower than a native one, and confined to the CPU and the array engine. Batches go over in one call.

Derivatives, forward and reverse, are central differences of order 8 on the host, over geodesics where a point varies:
right to about 1e-12 for the closed forms of geomstats, to less for its numerical solvers. There are no second
derivatives.

geomstats is imported by :func:`from_geomstats`, not before.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ParameterError, SpaceError
from ..matrices.linear import solve
from ..matrices.symmetric import cholesky, solve_lower
from .base import CUT_MARGIN, MEMBERSHIP_TOLERANCE, Space, random_key

_STENCIL = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
"""Weights of f(x + k h) - f(x - k h) in h f'(x), to order 8."""

_DIFFERENCE_STEP = 0.02
"""Step of the differences, a length in the metric: for smooth f their error h^8 f^(9)/630 is below rounding, eps/h."""


def from_geomstats(space, injectivity_radius: float | None = None) -> GeomstatsSpace:
    """Return a geomstats manifold, equipped with a metric, as a state space.

    Parameters
    ----------
    space : geomstats Manifold
        For example ``Hypersphere(2)`` or ``PoincareBall(2)``, with points of its own kind: see ``space.shape``.
    injectivity_radius : float, optional
        By default the radius of the metric, and infinite if the metric has none; for SO(n) and SE(n) pi and sqrt(2) pi,
        as geomstats 2.8 returns larger values than the true ones.

    Raises
    ------
    SpaceError
        If it is not a geomstats manifold, has no metric, or its metric no exponential or logarithm; if its points are
        complex, or geomstats runs with a backend other than NumPy.
    """
    from geomstats import backend
    from geomstats.geometry.complex_manifold import ComplexManifold
    from geomstats.geometry.manifold import Manifold

    if isinstance(space, ComplexManifold):
        raise SpaceError(f"{_geomstats_name(space)} has complex points, which are not supported")

    if not isinstance(space, Manifold):
        raise SpaceError(f"from_geomstats(space): space must be a geomstats manifold, got {type(space).__name__}")
    if not backend.__name__.endswith("numpy"):
        raise SpaceError(
            f"geomstats must run with NumPy, got the backend {backend.__name__}. Set GEOMSTATS_BACKEND=numpy"
        )
    if getattr(space, "metric", None) is None:
        raise SpaceError(f"{_geomstats_name(space)} has no metric: equip it with one, space.equip_with_metric(...)")
    if injectivity_radius is not None and not injectivity_radius > 0.0:
        raise ParameterError(f"injectivity_radius must be positive, got {injectivity_radius!r}")
    bridge = GeomstatsSpace(
        space, _constant_injectivity_radius(space) if injectivity_radius is None else injectivity_radius
    )
    for kernel in ("exp", "log", "inner", "project_tangent"):
        bridge._require_kernel(kernel)
    return bridge


@jax.tree_util.register_static
class GeomstatsSpace(Space):
    """Geomstats manifold as a state space, made by :func:`from_geomstats`.

    Attributes
    ----------
    source : geomstats Manifold
        The manifold of geomstats.
    """

    is_smooth = False

    def __init__(self, source, radius: float | None):
        self.source, self._injectivity_radii = source, radius
        self.metric = type(source.metric).__name__
        self._available_kernels: set[str] = set()

    @property
    def name(self):
        return _geomstats_name(self.source)

    @property
    def dim(self):
        return int(self.source.dim)

    @property
    def shape(self):
        return tuple(int(n) for n in self.source.shape)

    def random(self, key_or_seed, size=()) -> jax.Array:
        """Return points from geomstats' own distribution, shape ``(*size, *shape)``; not under tracing."""
        seed = int(jax.random.randint(random_key(key_or_seed), (), 0, 2**31 - 1))
        state = np.random.get_state()  # noqa: NPY002
        try:
            np.random.seed(seed)  # noqa: NPY002  geomstats draws from NumPy's global generator
            points = self.source.random_point(n_samples=math.prod(size))
        finally:
            np.random.set_state(state)  # noqa: NPY002
        return jnp.asarray(points, dtype=jnp.float64).reshape(*size, *self.shape)

    def injectivity_radius(self, x=None):
        if self._injectivity_radii is not None:
            return self._injectivity_radii
        x = self.source.random_point() if x is None else x
        return float(self._evaluate_on_host("radius", np.asarray(x, dtype=float)[None])[0])

    def _random(self, key, size):
        raise SpaceError(
            f"{self.name} draws random points with NumPy, which compiled programs cannot do. Call its method random "
            "outside of them"
        )

    def _residual(self, x):
        return self._call_kernel("residual", x)

    def _project(self, x):
        return self._call_kernel("project", x)

    def _project_tangent(self, x, w):
        return self._call_kernel("project_tangent", x, w)

    def _inner(self, x, u, v):
        return self._call_kernel("inner", x, u, v)

    def _exp(self, x, v):
        return self._call_kernel("exp", x, v)

    def _log(self, x, y):
        return _log(self, *jnp.broadcast_arrays(x, y))

    def _distance(self, x, y):
        return self._call_kernel("distance", x, y)

    def _transport(self, x, v, u):
        return self._call_kernel("transport", x, v, u)

    def _metric_covector(self, x, v):
        """Return the covector of v: its inner products with the projected axes, shape ``(..., *shape)``."""
        x, v = self._with_frame_axis(x), self._with_frame_axis(v)
        values = self._inner(x, v, self._project_tangent(x, self._ambient_basis))
        return values.reshape(*values.shape[:-1], *self.shape)

    def _frame(self, x):
        """Return Gram-Schmidt vectors of the projections of ``dim`` axes, which are chosen for independence."""
        axis_vectors = jnp.asarray(self._ambient_basis)[_tangent_basis_axes(self, x)]
        base = self._with_frame_axis(x)
        vectors = self._project_tangent(base, axis_vectors)
        left_vectors, right_vectors = jnp.expand_dims(vectors, -2 - len(self.shape)), self._with_frame_axis(vectors)
        gram = self._inner(self._with_frame_axis(base), left_vectors, right_vectors)
        rows = solve_lower(cholesky(gram), vectors.reshape(*gram.shape[:-1], -1))
        return rows.reshape(vectors.shape)

    def _coordinates(self, x, v):
        return self._inner(self._with_frame_axis(x), self._frame(x), self._with_frame_axis(v))

    def _reach(self, x, v):
        radius = self._call_kernel("radius", x) if self._injectivity_radii is None else self._injectivity_radii
        return self._norm(x, v) / radius

    def _why_log_is_undefined(self, x, y):
        return (
            "geomstats found no logarithm, or one that its own exponential map does not lead back from, or one not "
            f"within the injectivity radius {self.injectivity_radius(x):.6g}; go by a point between them"
        )

    # -- calls to the host ----------------------------------------------------------------------------------------

    @property
    def _ambient_basis(self) -> np.ndarray:
        return np.eye(math.prod(self.shape)).reshape(-1, *self.shape)

    def _call_kernel(self, kernel: str, *arrays):
        self._require_kernel(kernel)
        return _call_kernel_on_host(self, kernel, jnp.broadcast_arrays(*arrays))

    def _require_kernel(self, kernel: str) -> None:
        """Raise SpaceError unless geomstats implements a kernel, tested at a random point."""
        if kernel in self._available_kernels:
            return
        x = np.asarray(self.source.random_point(), dtype=float)[None]
        try:
            _KERNELS[kernel](self, *({"v": 0.0 * x}.get(kind, x) for kind in _KERNEL_SIGNATURES[kernel][0]))
        except (NotImplementedError, AttributeError, TypeError, ValueError) as error:
            raise SpaceError(f"{self.name} with {self.metric} has no {kernel.replace('_', ' ')}: {error}") from None
        self._available_kernels.add(kernel)

    def _result_shape(self, kernel: str) -> tuple[int, ...]:
        """Return the shape of the result for one point."""
        return self.shape if _KERNEL_SIGNATURES[kernel][1] == "array" else ()

    def _evaluate_on_host(self, kernel: str, *arrays: np.ndarray) -> np.ndarray:
        """Evaluate a kernel on arrays of shape ``(count, *shape)``: as one batch, or one by one if geomstats refuses
        some."""
        count = len(arrays[0])
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():  # what comes of it is looked at
                warnings.simplefilter("ignore")
                return np.asarray(_KERNELS[kernel](self, *arrays), dtype=float).reshape(
                    count, *self._result_shape(kernel)
                )
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            if count == 1:
                return np.full((1, *self._result_shape(kernel)), np.nan)
            return np.concatenate(
                [self._evaluate_on_host(kernel, *(a[i : i + 1] for a in arrays)) for i in range(count)]
            )

    def _jacobian_on_host(self, kernel: str, *arrays: np.ndarray) -> np.ndarray:
        """Return derivatives by all entries of all arguments, shape (count, size of the result, number of entries)."""
        columns = [
            self._derivative_along(kernel, arrays, k, np.broadcast_to(axis, arrays[k].shape))
            for k in range(len(arrays))
            for axis in self._ambient_basis
        ]
        return np.stack(columns, axis=-1)

    def _derivative_along(self, kernel: str, arrays, argument_index: int, direction: np.ndarray) -> np.ndarray:
        """Return the derivative along a direction of the k-th argument, shape (count, size of the result)."""
        kind, length = _KERNEL_SIGNATURES[kernel][0][argument_index], np.ones(len(direction))
        if kind != "a":
            x = arrays[argument_index if kind == "p" else 0]
            direction = self._evaluate_on_host("project_tangent", x, direction)
            length = np.sqrt(np.maximum(self._evaluate_on_host("inner", x, direction, direction), 0.0))
        unit_direction = direction / np.where(length > 0.0, length, 1.0).reshape(-1, *(1,) * len(self.shape))
        weighted_sum = np.zeros((len(direction), math.prod(self._result_shape(kernel))))
        for offset, weight in _STENCIL.items():
            forward, backward = (
                self._evaluate_on_host(
                    kernel,
                    *self._arguments_with_displaced(
                        kernel, arrays, argument_index, sign * offset * _DIFFERENCE_STEP * unit_direction
                    ),
                )
                for sign in (1, -1)
            )
            weighted_sum += weight * (forward - backward).reshape(weighted_sum.shape)
        return weighted_sum / _DIFFERENCE_STEP * length[:, None]

    def _arguments_with_displaced(
        self, kernel: str, arrays, argument_index: int, displacement: np.ndarray
    ) -> list[np.ndarray]:
        """Return the arguments with the k-th displaced: a point along a geodesic, with its tangent vectors projected
        there."""
        kinds, displaced_arguments = _KERNEL_SIGNATURES[kernel][0], list(arrays)
        if kinds[argument_index] != "p":
            displaced_arguments[argument_index] = displaced_arguments[argument_index] + displacement
            return displaced_arguments
        displaced_arguments[argument_index] = self._evaluate_on_host(
            "exp", displaced_arguments[argument_index], displacement
        )
        if argument_index == 0:
            tangent_indices = [i for i, kind in enumerate(kinds) if kind == "v"]
            for i in tangent_indices:
                displaced_arguments[i] = self._evaluate_on_host(
                    "project_tangent", displaced_arguments[0], displaced_arguments[i]
                )
        return displaced_arguments


# -- kernels of geomstats, on arrays of shape (count, *shape) -----------------------------------------------------


def _log_or_nan(space: GeomstatsSpace, x, y):
    """Return the logarithm, NaN if it does not lead to y or is too long, since failing solvers return numbers too."""
    axes = tuple(range(1, x.ndim))
    v = np.array(space.source.metric.log(y, x), dtype=float)
    residual = np.abs(space.source.metric.exp(v, x) - y).max(axis=axes) / np.maximum(np.abs(y).max(axis=axes), 1.0)
    length = np.sqrt(space.source.metric.inner_product(v, v, x))
    radius = _injectivity_radii(space, x) if space._injectivity_radii is None else space._injectivity_radii
    v[~((residual <= 1e-6) & (length < radius * (1.0 - CUT_MARGIN)))] = np.nan
    return v


def _injectivity_radii(space: GeomstatsSpace, x):
    """Return the injectivity radius at each point."""
    return np.array([float(np.squeeze(space.source.metric.injectivity_radius(point))) for point in x])


def _residual(space: GeomstatsSpace, x):
    """Return the relative residual of the equations, or distance to the projection; infinite if the space has
    neither."""
    axes = tuple(range(1, x.ndim))
    scale = np.maximum(np.abs(x).max(axis=axes), 1.0)
    is_inside = np.array([np.all(space.source.belongs(point, atol=MEMBERSHIP_TOLERANCE)) for point in x])
    residual = np.where(is_inside, 0.0, np.inf)
    if hasattr(space.source, "submersion"):
        residual = np.abs(np.asarray(space.source.submersion(x))).reshape(len(x), -1).max(axis=1) / scale**2
    elif not is_inside.all():
        try:
            distance = np.abs(space.source.projection(x) - x).max(axis=axes) / scale
            residual = np.where(is_inside, 0.0, np.where(distance > MEMBERSHIP_TOLERANCE, distance, np.inf))
        except (NotImplementedError, AttributeError):
            pass
    return np.where(np.isfinite(x).all(axis=axes), residual, np.nan)


_KERNEL_SIGNATURES = {
    "exp": ("pv", "array"),
    "log": ("pp", "array"),
    "transport": ("pvv", "array"),
    "project_tangent": ("pa", "array"),
    "project": ("a", "array"),
    "inner": ("pvv", "scalar"),
    "distance": ("pp", "scalar"),
    "radius": ("p", "scalar"),
    "residual": ("a", "scalar"),
}
"""Kinds of the arguments and of the result of each kernel.

The kinds are p, a point, v, a vector tangent at the first point, and a, any array.
"""

_KERNELS: dict[str, Callable] = {
    "exp": lambda space, x, v: space.source.metric.exp(v, x),
    "log": _log_or_nan,
    "transport": lambda space, x, v, u: space.source.metric.parallel_transport(u, x, direction=v),
    "project_tangent": lambda space, x, w: space.source.to_tangent(w, x),
    "project": lambda space, x: space.source.projection(x),
    "inner": lambda space, x, u, v: space.source.metric.inner_product(u, v, x),
    "distance": lambda space, x, y: space.source.metric.dist(x, y),
    "radius": _injectivity_radii,
    "residual": _residual,
}
r"""Implementation of each kernel on arrays of shape (count, \*shape)."""


# -- callbacks ----------------------------------------------------------------------------------------------------


def _call_function_on_host(space: GeomstatsSpace, function: Callable, result_shape: tuple[int, ...], dtype, arrays):
    """Call ``function`` on the host, on arrays with one batch axis, from a JAX program with any number of batch
    axes."""
    batch = arrays[0].shape[: arrays[0].ndim - len(space.shape)]

    def run_on_host(*arrays):
        host_batch = arrays[0].shape[: arrays[0].ndim - len(space.shape)]
        result = function(*(np.asarray(a).reshape(-1, *space.shape) for a in arrays))
        return result.reshape((*host_batch, *result_shape)).astype(dtype)

    return jax.pure_callback(
        run_on_host,
        jax.ShapeDtypeStruct((*batch, *result_shape), dtype),
        *arrays,
        vmap_method="broadcast_all",
    )


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _call_kernel_on_host(space: GeomstatsSpace, kernel: str, arrays):
    return _call_function_on_host(
        space, partial(space._evaluate_on_host, kernel), space._result_shape(kernel), np.float64, arrays
    )


@_call_kernel_on_host.defjvp
def _call_kernel_on_host_jvp(space: GeomstatsSpace, kernel: str, primals, tangents):
    (arrays,), (array_tangents,) = primals, tangents
    value = _call_kernel_on_host(space, kernel, arrays)
    jacobian = _jacobian(space, kernel, arrays)
    entries = jnp.concatenate(
        [array_tangent.reshape(*jacobian.shape[:-2], -1) for array_tangent in array_tangents], axis=-1
    )
    return value, jnp.einsum("...ij,...j->...i", jacobian, entries).reshape(value.shape)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _log(space: GeomstatsSpace, x, y):
    return space._call_kernel("log", x, y)


@_log.defjvp
def _log_jvp(space: GeomstatsSpace, primals, tangents):
    """Return the logarithm and its derivative along ``tangents``, by differentiating ``exp(x, v) = y``.

    As x moves by x', v moves with the tangent space, by D, and in it, by the combination of frame vectors that
    satisfies ``d_v exp (D + frame c) + d_x exp x' = y'``.
    """
    (x, y), (dx, dy) = primals, tangents
    v, size = _log(space, x, y), math.prod(space.shape)

    def flatten_points(a):
        return a.reshape(*a.shape[: a.ndim - len(space.shape)], size)

    exp_jacobian, projection_jacobian = (_jacobian(space, kernel, [x, v]) for kernel in ("exp", "project_tangent"))
    dx, frame = flatten_points(dx), space._frame(x)
    exp_of_frame = jnp.einsum("...ij,...aj->...ai", exp_jacobian[..., size:], flatten_points(frame))
    remainder = flatten_points(dy) - jnp.einsum(
        "...ij,...j->...i", exp_jacobian[..., :size], dx
    )  # exp projects its argument, hence no D
    dual = flatten_points(space._metric_covector(space._with_frame_axis(y), space._frame(y)))
    matrix = jnp.einsum("...bi,...ai->...ba", dual, exp_of_frame)
    c = solve(matrix, jnp.einsum("...bi,...i->...b", dual, remainder)[..., None])[..., 0]
    dv = jnp.einsum("...ij,...j->...i", projection_jacobian[..., :size], dx).reshape(v.shape)
    return v, dv + (c.reshape(*c.shape, *(1,) * len(space.shape)) * frame).sum(axis=-1 - len(space.shape))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _jacobian(space: GeomstatsSpace, kernel: str, arrays):
    result_shape = (math.prod(space._result_shape(kernel)), len(arrays) * math.prod(space.shape))
    return _call_function_on_host(space, partial(space._jacobian_on_host, kernel), result_shape, np.float64, arrays)


@_jacobian.defjvp
def _refuse_second_derivative(space: GeomstatsSpace, kernel: str, primals, tangents):
    raise SpaceError(f"{space.name}: {kernel} has first derivatives only, as they are differences taken on the host")


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _tangent_basis_axes(space: GeomstatsSpace, x):
    """Return the axes, shape (dim,), whose projections are the best basis of the tangent space at x: pivoted
    Gram-Schmidt."""
    return _call_function_on_host(space, partial(_tangent_basis_axes_on_host, space), (space.dim,), np.int64, [x])


@_tangent_basis_axes.defjvp
def _tangent_basis_axes_jvp(space: GeomstatsSpace, primals, tangents):
    indices = _tangent_basis_axes(space, *primals)
    return indices, np.zeros(indices.shape, jax.dtypes.float0)


def _tangent_basis_axes_on_host(space: GeomstatsSpace, x: np.ndarray) -> np.ndarray:
    rows = []
    for point in x:
        axes = space._ambient_basis
        points = np.broadcast_to(point, axes.shape)
        vectors = space._evaluate_on_host("project_tangent", points, axes).reshape(len(axes), -1)
        indices: list[int] = []
        for _ in range(space.dim):
            indices.append(int((vectors**2).sum(axis=1).argmax()))
            direction = vectors[indices[-1]] / np.linalg.norm(vectors[indices[-1]])
            vectors = vectors - np.outer(vectors @ direction, direction)
        rows.append(indices)
    return np.array(rows).reshape(len(x), space.dim)


def _constant_injectivity_radius(space) -> float | None:
    """Return the injectivity radius if it is constant, infinity if unknown, None if it varies with the point."""
    corrected_radii = {
        "BiInvariantMetric": math.pi,
        "SpecialEuclideanMatricesCanonicalLeftMetric": math.sqrt(2.0) * math.pi,
    }
    if (kind := type(space.metric).__name__) in corrected_radii:
        return corrected_radii[kind]
    try:
        radii = [float(np.squeeze(space.metric.injectivity_radius(space.random_point()))) for _ in range(2)]
    except (NotImplementedError, AttributeError):
        return math.inf
    return radii[0] if radii[0] == radii[1] else None


def _geomstats_name(space) -> str:
    """Return the name of a geomstats space for messages, such as ``"geomstats Hypersphere(2)"``."""
    return f"geomstats {type(space).__name__.strip('_')}({space.dim})"
