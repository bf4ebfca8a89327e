"""Maps of a state space that its author writes, and the defaults derived from them."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import is_traced
from .._class_members import ListedABCMeta
from .._index_check import check_indices
from ..errors import SpaceError
from ..matrices.linear import solve_without_pivoting


class SpaceMaps(metaclass=ListedABCMeta):
    """Maps of a state space as its author writes them: plain JAX functions of checked arrays.

    Leading axes are batches. ``name``, ``dim``, ``shape`` and ``_project`` are required; the other maps have defaults
    that follow from these, or raise an error with the reason, and may be overridden. :class:`manifolds.Space` documents
    the public ones.
    """

    metric: str = "induced"
    bi_invariant: bool = False
    """True if the space is a group whose exponential is the Riemannian one."""
    exp_is_group_exp: bool = False
    """True if the space is a group and :meth:`exp` its exponential, as with a bi-invariant metric."""
    is_smooth: bool = True
    """True if the maps have derivatives of every order; False if only first ones exist."""
    has_iterative_log: bool = False
    """True if ``log`` searches for the geodesic, up to the injectivity radius."""
    dtype: np.dtype = np.dtype(np.float64)

    @property
    @abstractmethod
    def name(self) -> str: ...

    @property
    @abstractmethod
    def dim(self) -> int: ...

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]: ...

    @property
    def size(self) -> int:
        """Number of real components of a point."""
        return math.prod(self.shape) * (2 if self.dtype.kind == "c" else 1)

    @abstractmethod
    def to_vector(self, x) -> jax.Array: ...

    @abstractmethod
    def from_vector(self, x) -> jax.Array: ...

    # -- points and tangent vectors -----------------------------------------------------------------------------------

    @abstractmethod
    def _project(self, x):
        """Return a point of the space, x itself if it is one; NaN if there is none."""

    def _residual(self, x):
        y = self._project(x)
        return jnp.abs(x - y).max(axis=self._axes) / jnp.maximum(jnp.abs(y).max(axis=self._axes), 1.0)

    @property
    def _n_gaussian_samples(self) -> int | None:
        """Number of Gaussian samples from which a random point is made, None if it is drawn otherwise."""
        return self.size if type(self)._random is SpaceMaps._random else None

    def _point_from_gaussian_samples(self, w):
        """Return a random point made of independent Gaussian samples w, shape (..., samples)."""
        return self._project(self.from_vector(w))

    def _random(self, key, size):
        return self._point_from_gaussian_samples(jax.random.normal(key, (*size, self._n_gaussian_samples or 0)))

    def _tangent_basis(self, x):
        """Return a basis of the tangent space, orthonormal as flat arrays, shape (..., dim, size).

        Gram-Schmidt orthogonalises the projected axes, the longest remainder first.
        """
        tangent_map = (
            (lambda w: self._tangential_part(x, w)) if self._has_equations else jax.linearize(self._project, x)[1]
        )
        axes = self.from_vector(jnp.eye(self.size))
        remainders = jax.vmap(lambda axis: self.to_vector(tangent_map(jnp.broadcast_to(axis, x.shape))), out_axes=-2)(
            axes
        )
        basis: list[jax.Array] = []
        for _ in range(self.dim):
            is_longest = jnp.argmax((remainders**2).sum(axis=-1), axis=-1)[..., None] == jnp.arange(self.size)
            e = jnp.where(is_longest[..., None], remainders, 0.0).sum(axis=-2)
            e = e / jnp.sqrt((e**2).sum(axis=-1, keepdims=True))
            remainders = remainders - (remainders * e[..., None, :]).sum(axis=-1, keepdims=True) * e[..., None, :]
            basis.append(e)
        return jnp.stack(basis, axis=-2)

    def _project_tangent(self, x, w):
        basis, vector = self._tangent_basis(x), self.to_vector(w)
        weights = (basis * vector[..., None, :]).sum(axis=-1, keepdims=True)
        return self.from_vector((weights * basis).sum(axis=-2))

    def _frame(self, x):
        frame: list[jax.Array] = []
        for v in jnp.moveaxis(self.from_vector(self._tangent_basis(x)), -1 - len(self.shape), 0):
            for e in frame:
                v = v - self._scale(self._inner(x, e, v), e)
            frame.append(self._scale(1.0 / jnp.sqrt(self._inner(x, v, v)), v))
        return jnp.stack(frame, axis=-1 - len(self.shape))

    def _inner(self, x, u, v):
        return self._pair(u.conj(), v + jnp.zeros_like(x))

    def _metric_covector(self, x, v):
        x, v = jnp.broadcast_arrays(x, v)
        return jax.grad(lambda w: self._inner(x, v, w).sum())(jnp.zeros_like(v))

    @property
    def has_geodesics(self) -> bool:
        """True if the space has :meth:`exp`, :meth:`log`, :meth:`transport` and what follows from them."""
        return type(self)._exp is not SpaceMaps._exp

    def _exp(self, x, v):
        raise SpaceError(
            f"{self.name} has no geodesics. Implement _exp, _log and _transport, or use a chart that "
            "needs none, such as manifolds.ProjectionRetraction(space)"
        )

    def _log(self, x, y):
        """Return the logarithm, NaN where it is not defined."""
        return self._exp(x, y)  # raises

    def _transport(self, x, v, u):
        return self._exp(x, v)  # raises

    def _coordinates(self, x, v):
        return self._pair(self._frame(x), self._with_frame_axis(self._metric_covector(x, v)))

    def _from_coordinates(self, x, c):
        weights = c.reshape(*c.shape, *(1,) * len(self.shape))
        return (weights * self._frame(x)).sum(axis=-1 - len(self.shape))

    def _sharp(self, x, alpha):
        return self._from_coordinates(x, self._pair(self._frame(x), self._with_frame_axis(alpha)))

    @property
    def isotropic_size(self) -> int:
        """Number of components of w in :meth:`isotropic`."""
        return self.size if self._has_induced_metric else self.dim

    def _isotropic(self, x, w):
        """Return ``R w`` with ``R R^T`` the inverse of the metric, and R differentiable in x.

        A smooth frame is such an R; so are the fields of a group of isometries, and the projection of arrays.
        """
        return (
            self._project_tangent(x, self.from_vector(w)) if self._has_induced_metric else self._from_coordinates(x, w)
        )

    @property
    def _has_induced_metric(self) -> bool:
        """True if the metric is known to be that of the ambient arrays."""
        return type(self)._inner is SpaceMaps._inner

    def _divergence_terms(self, x, pair_with_field):
        """Return ``<E_i, nabla_{E_i} X>`` over a frame E, shape (dim, ...): the divergence of X is the sum over i.

        ``pair_with_field(y, alpha)`` returns the product of a covector alpha at y with the field X, or with each of
        several fields.
        """

        def pairing_along_geodesic(t, e):
            y = self._exp(x, t * e)
            return pair_with_field(y, self._metric_covector(y, self._transport(x, t * e, e)))

        def pairing_along_line(t, e):  # the metric being that of the arrays around
            return pair_with_field(self._project(x + t * e), e.conj())

        if not (self.has_geodesics or self._has_induced_metric):
            raise SpaceError(
                f"{self.name} has no geodesics, along which divergences are computed. Implement _exp, _log and "
                "_transport"
            )
        pairing_along = pairing_along_geodesic if self.has_geodesics else pairing_along_line
        frame = jnp.moveaxis(self._frame(x), -1 - len(self.shape), 0)
        return jax.vmap(lambda e: jax.jvp(lambda t: pairing_along(t, e), (0.0,), (1.0,))[1])(frame)

    def _norm(self, x, v):
        return safe_sqrt(self._inner(x, v, v))

    def _distance(self, x, y):
        return safe_sqrt(self._squared_distance(x, y))

    # These two are made of compiled maps, as a logarithm can be long to compile.

    def _squared_distance(self, x, y):
        """Return the squared distance, with its derivatives of every order also where the two points are equal."""
        if type(self)._distance is not SpaceMaps._distance:
            return self._distance(x, y) ** 2
        v = self._call_compiled("_log", x, y)
        return self._call_compiled("_inner", x, v, v)

    def _midpoint(self, x, y):
        return self._call_compiled("_exp", x, 0.5 * self._call_compiled("_log", x, y))

    def _reach(self, x, v):
        return self._norm(x, v) / self.injectivity_radius()

    # -- in the ambient arrays --------------------------------------------------------------------------------------
    # Systems run there when no retraction is given. These maps are evaluated near the space too.

    @property
    def can_be_embedded(self) -> bool:
        """True if systems run in the ambient arrays of the space when no retraction is given."""
        return True

    is_quotient: ClassVar[bool] = False
    """True if many points represent one class; functions must then be constant on each class."""

    def _constraints(self, x):
        """Return independent functions that vanish on the space, shape (..., m); by default the change by
        :meth:`_restore`.

        Collocation conserves quadratic constraints, at no cost to an implicit step.
        """
        return self.to_vector(x - self._restore(x))

    def _restore(self, x):
        """Take a step, such as Newton's, from a nearby x towards the space; x itself if it is a point."""
        return self._project(x)

    def _inside(self, x):
        """Return True for each solution of the constraints that is in the space, shape (...)."""
        return jnp.ones(x.shape[: x.ndim - len(self.shape)], bool)

    @property
    def _has_equations(self) -> bool:
        return type(self)._constraints is not SpaceMaps._constraints

    def _constraint_jacobian(self, x):
        """Return the derivatives of the constraints, shape (..., m, size)."""
        values, pullback = jax.vjp(lambda y: self._constraints(self.from_vector(y)), self.to_vector(x))
        axes = np.eye(values.shape[-1])
        return jax.vmap(lambda e: pullback(jnp.broadcast_to(e, values.shape))[0], out_axes=-2)(axes)

    def _minimal_correction(self, x, constraint_change):
        """Return the least displacement at x that changes the constraints by ``constraint_change``, shape (..., m)."""
        if not self._has_equations:
            return self.from_vector(constraint_change)
        rows = self._constraint_jacobian(x)
        weights = solve_without_pivoting(rows @ rows.swapaxes(-1, -2), constraint_change[..., None])
        return self.from_vector((weights * rows).sum(axis=-2))

    def _correction(self, x, constraint_change):
        """Return a displacement that changes the constraints by ``constraint_change``, exactly if x is a point."""
        return self._minimal_correction(x, constraint_change)

    def _tangential_part(self, x, w):
        """Return the component of w that leaves the constraints at x unchanged; x may be near the space, not on it."""
        if not self._has_equations:
            return self._project_tangent(x, w)
        x, w = jnp.broadcast_arrays(x, w)
        return w - self._minimal_correction(x, jax.jvp(self._constraints, (x,), (w,))[1])

    def _constraint_rounding_scales(self, x):
        """Return the sizes of the terms of the constraints at x, by which rounding scales, shape (..., m)."""
        if not self._has_equations:
            return jnp.abs(self.to_vector(x))
        return (jnp.abs(self._constraint_jacobian(x)) * jnp.abs(self.to_vector(x))[..., None, :]).sum(axis=-1)

    # Maps of the retractions other than the Riemannian one, on spaces that have them.

    def _euclidean_reach(self, x, v):
        """Return the length of v relative to a bound below which ``x + v`` surely stays in the space, an open set."""
        raise SpaceError(f"{self.name} is not an open set of arrays: x + v leaves it")

    def _group_exp(self, x, v):
        """Return ``x exp(x^-1 v)``."""
        raise SpaceError(f"{self.name} is not a group: it has no group exponential and no Cayley map")

    def _group_log(self, x, y):
        """Return the inverse of :meth:`_group_exp`, NaN where it is not defined."""
        return self._group_exp(x, y)  # raises

    def _left_translate(self, x, y, u):
        """Return ``y x^-1 u``."""
        return self._group_exp(x, u)  # raises

    def _cayley(self, x, v):
        """Return ``x cayley(x^-1 v)``."""
        return self._group_exp(x, v)  # raises

    def _inverse_cayley(self, x, y):
        return self._group_exp(x, y)  # raises

    def _why_log_is_undefined(self, x, y) -> str:
        """Return the reason why ``log(x, y)`` is NaN, for one pair of NumPy arrays."""
        if not self.has_geodesics:
            return "the chart around x does not reach y; go by a point between them"
        if self.has_iterative_log:
            return (
                f"no geodesic shorter than {self.injectivity_radius():.6g} from x to y was found, and a longer one "
                "might not be the shortest; go by a point between them"
            )
        return (
            "y is at the cut locus of x or beyond it (injectivity radius "
            f"{self.injectivity_radius():.6g}), where no one geodesic is the shortest; go by a point between them"
        )

    def injectivity_radius(self, x=None) -> float:
        """Return the radius of the ball of tangent vectors at x that ``exp`` maps one to one, with ``log`` its inverse.

        The radius of a native space is constant, so x is not needed.
        """
        return math.inf

    # -- helpers --------------------------------------------------------------------------------------------------

    @property
    def _axes(self) -> tuple[int, ...]:
        """Axes of one point."""
        return tuple(range(-len(self.shape), 0))

    def _pair(self, alpha, v):
        """Return ``Re sum(alpha * v)`` over the axes of one point."""
        return (alpha * v).sum(axis=self._axes).real

    def _scale(self, factor, v):
        """Multiply each vector by its factor."""
        return factor.reshape(*factor.shape, *(1,) * len(self.shape)) * v

    def _with_frame_axis(self, v):
        """Return ``v`` with an axis of length 1 for the vectors of a frame."""
        return jnp.expand_dims(v, -1 - len(self.shape))

    def _call_compiled(self, method_name: str, *arrays, static: tuple = ()):
        """Call a method in a compiled program; small calls are compiled without optimisation."""
        is_small = sum(np.size(array) for array in arrays) + np.prod(static) * self.size <= MAX_UNOPTIMIZED_SIZE
        skip_optimization = is_small and not any(
            is_traced(array) for array in arrays
        )  # a part of another program has no options
        return (run_kernel_unoptimized if skip_optimization else run_kernel)(self, method_name, static, *arrays)


MAX_UNOPTIMIZED_SIZE = 10_000
"""Largest number of array entries for which a kernel is compiled without optimisation.

Up to it compilation takes longer than the run, as long as the kernel is called a few times.
"""


def _call_method(space: SpaceMaps, method_name: str, static: tuple, *arrays) -> Any:
    method = getattr(space, method_name)
    if type(space).__module__.partition(".")[0] not in ("manifolds", "liethermo"):  # a space of the user's own
        check_indices(
            jax.make_jaxpr(lambda *arrays: method(*arrays, *static))(*arrays),
            f"{method_name} of {type(space).__name__}",
        )
    return method(*arrays, *static)


run_kernel = jax.jit(_call_method, static_argnums=(0, 1, 2))
run_kernel_unoptimized = jax.jit(
    _call_method, static_argnums=(0, 1, 2), compiler_options={"xla_backend_optimization_level": 0}
)


ZERO_LENGTH_LIMIT = 2.0**-300
"""Lengths below this, in any unit, count as zero where a derivative divides by them; division by a power of two is
exact."""


@jax.custom_jvp
def safe_sqrt(z):
    """Return ``sqrt(max(z, 0))``, with a derivative that is zero if z and its derivative are, so that its square is
    smooth.

    The root d of a square z has no derivative at zero, but ``d**2`` has: z', and then z''. JAX computes them as
    ``2 d d'`` with ``d' = z' / (2 d)``. So where z vanishes, the root is replaced by
    ZERO_LENGTH_LIMIT, both in the derivative and in the product.
    """
    positive = z > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, z, 1.0)), jnp.where(z <= 0.0, 0.0, z))


@safe_sqrt.defjvp
def _safe_sqrt_jvp(primals, tangents):
    (z,), (dz,) = primals, tangents
    is_small = z < ZERO_LENGTH_LIMIT**2
    root = jnp.sqrt(jnp.where(is_small, 1.0, z))
    slope = jnp.where(
        is_small, 0.5 / ZERO_LENGTH_LIMIT, 0.5 / root
    )  # of constants, which have no derivatives to overflow
    return jnp.where(is_small, ZERO_LENGTH_LIMIT, root), jnp.where(z < 0.0, 0.0, slope) * dz


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def squared_distance_with_cut_locus(space: Any, x, y):
    """Return the squared distance from ``_squared_distance_value``, defined at the cut locus too.

    Derivatives follow from the logarithm; at the cut locus they are NaN.
    """
    return space._squared_distance_value(x, y)


@squared_distance_with_cut_locus.defjvp
def _squared_distance_with_cut_locus_jvp(space, primals, tangents):
    return squared_distance_with_cut_locus(space, *primals), jax.jvp(
        partial(SpaceMaps._squared_distance, space), primals, tangents
    )[1]


# -- methods of several spaces: ``_inner = inner_by_flat`` in the body of a class --------------------------------------


def inner_by_flat(self: SpaceMaps, x, u, v):
    """Return the inner product by :meth:`SpaceMaps._metric_covector`."""
    return self._pair(self._metric_covector(x, u), v)


def inner_by_coordinates(self: SpaceMaps, x, u, v):
    """Return the inner product of coordinates in the orthonormal frame."""
    return (self._coordinates(x, u) * self._coordinates(x, v)).sum(axis=-1)


def tangential_part_by_projection(self: SpaceMaps, x, w):
    """Return ``_project_tangent(x, w)``, for spaces where that is right near the space too."""
    return self._project_tangent(x, w)
