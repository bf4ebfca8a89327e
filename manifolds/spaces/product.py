"""Products of state spaces, powers of one space, and tangent bundles: positions with velocities or momenta."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from .._pytree_module import forward_to
from ..errors import SpaceError
from ..matrices.linear import solve_without_pivoting
from .base import Space, random_key, register, register_result_class
from .constant_curvature import Euclidean, Sphere
from .groups import SpecialOrthogonal


@register_result_class("_product")
@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class Product(Space):
    """Product of several spaces, also written ``A * B``: a point is one flat array of the factors' points in order.

    :meth:`split` and :meth:`join` convert between that array and the points of the factors. The metric is the sum.

    Parameters
    ----------
    factors : Space
        The spaces, in the order of their points in the array.

    Examples
    --------
    >>> space = mf.Sphere(2) * mf.Euclidean(1)
    >>> x = space.join(np.array([0.0, 0.0, 1.0]), np.array([5.0]))
    >>> x.shape, space.dim, bool(space.belongs(x))
    ((4,), 3, True)
    """

    factors: tuple[Space, ...]
    metric = "product"

    def __init__(self, *factors: Space):
        flat_factors: list[Space] = []
        for factor in factors:
            if not isinstance(factor, Space):
                raise SpaceError(f"the factors of a product must be state spaces, got {type(factor).__name__}")
            flat_factors.extend(factor.factors if isinstance(factor, Product) else [factor])
        if not flat_factors:
            raise SpaceError("a product needs at least one factor")
        object.__setattr__(self, "factors", tuple(flat_factors))

    @property
    def name(self):
        return " x ".join(factor.name for factor in self.factors)

    @property
    def dim(self):
        return sum(factor.dim for factor in self.factors)

    @property
    def shape(self):
        return (sum(math.prod(factor.shape) for factor in self.factors),)

    @property
    def dtype(self):  # type: ignore[override]
        return np.result_type(*(factor.dtype for factor in self.factors))

    def split(self, x) -> list[jax.Array]:
        """Return the components of a point or tangent vector, each an array of its factor's shape."""
        x, points, start = self._ambient_array(x, "x"), [], 0
        for factor in self.factors:
            size = math.prod(factor.shape)
            point = x[..., start : start + size].reshape(*x.shape[:-1], *factor.shape)
            points.append(point if factor.dtype.kind == "c" else point.real)
            start += size
        return points

    def join(self, *parts) -> jax.Array:
        """Return the flat array of ``parts``, a point of each factor: the inverse of :meth:`split`."""
        arrays = [factor._ambient_array(part, "part") for factor, part in zip(self.factors, parts, strict=True)]
        rows = [a.reshape(*a.shape[: a.ndim - len(f.shape)], -1) for f, a in zip(self.factors, arrays, strict=True)]
        batch = jnp.broadcast_shapes(*(row.shape[:-1] for row in rows))
        return jnp.concatenate([jnp.broadcast_to(row, (*batch, row.shape[-1])) for row in rows], axis=-1)

    def injectivity_radius(self, x=None):
        points = [None] * len(self.factors) if x is None else self.split(x)
        return min(factor.injectivity_radius(point) for factor, point in zip(self.factors, points, strict=True))

    def _apply_to_factors(self, method_name: str, *arrays) -> list:
        """Call a method of every factor on its components of the arrays; return the list of results."""
        factor_arguments = zip(*(self.split(a) for a in arrays), strict=True)
        return [
            getattr(factor, method_name)(*arguments)
            for factor, arguments in zip(self.factors, factor_arguments, strict=True)
        ]

    def _apply_and_join(self, method_name: str, *arrays):
        """Call a method of every factor on its components; join the resulting points or vectors."""
        return self.join(*self._apply_to_factors(method_name, *arrays))

    def _residual(self, x):
        imaginary = jnp.abs(x - self.join(*self.split(x))).max(axis=-1)  # where a factor is real
        return jnp.maximum(jnp.stack(self._apply_to_factors("_residual", x)).max(axis=0), imaginary)

    def _project(self, x):
        return self._apply_and_join("_project", x)

    def random(self, key_or_seed, size=()):
        keys = jax.random.split(random_key(key_or_seed), len(self.factors))
        return self.join(*(factor.random(k, size) for factor, k in zip(self.factors, keys, strict=True)))

    def _random(self, key, size):
        return self.random(key, size)

    @property
    def _n_gaussian_samples(self):
        numbers = [factor._n_gaussian_samples for factor in self.factors]
        return None if None in numbers else sum(n for n in numbers if n is not None)

    def _point_from_gaussian_samples(self, w):
        ends = np.cumsum([factor._n_gaussian_samples or 0 for factor in self.factors])[:-1]
        pairs = zip(self.factors, jnp.split(w, ends, axis=-1), strict=True)
        return self.join(*(factor._point_from_gaussian_samples(factor_normals) for factor, factor_normals in pairs))

    def _restore(self, x):
        return self._apply_and_join("_restore", x)

    def _project_tangent(self, x, w):
        return self._apply_and_join("_project_tangent", x, w)

    @property
    def can_be_embedded(self):
        return all(factor.can_be_embedded for factor in self.factors)

    _has_equations = True

    @property
    def is_quotient(self):  # type: ignore[override]
        return any(factor.is_quotient for factor in self.factors)

    def _constraints(self, x):
        return self._apply_and_concatenate("_constraints", x)

    def _constraint_rounding_scales(self, x):
        return self._apply_and_concatenate("_constraint_rounding_scales", x)

    def _apply_and_concatenate(self, method_name: str, *arrays):
        """Call a method of every factor on its components; concatenate the results, shape (..., m)."""
        values = self._apply_to_factors(method_name, *arrays)
        batch = jnp.broadcast_shapes(*(c.shape[:-1] for c in values))
        return jnp.concatenate([jnp.broadcast_to(c, (*batch, c.shape[-1])) for c in values], axis=-1)

    def _minimal_correction(self, x, constraint_change):
        return self._apply_to_constraint_parts("_minimal_correction", x, constraint_change)

    def _correction(self, x, constraint_change):
        return self._apply_to_constraint_parts("_correction", x, constraint_change)

    def _apply_to_constraint_parts(self, method_name: str, x, constraint_change):
        """Call a method of every factor on its point and its part of ``constraint_change``; join the results."""
        points = self.split(x)
        sizes = [
            constraints.shape[-1]
            for constraints in jax.eval_shape(lambda x: self._apply_to_factors("_constraints", x), x)
        ]
        triples = zip(self.factors, points, jnp.split(constraint_change, np.cumsum(sizes)[:-1], axis=-1), strict=True)
        return self.join(*(getattr(factor, method_name)(point, component) for factor, point, component in triples))

    def _tangential_part(self, x, w):
        return self._apply_and_join("_tangential_part", x, w)

    def _inside(self, x):
        return jnp.stack(self._apply_to_factors("_inside", x)).all(axis=0)

    def _frame(self, x):
        batch, columns = x.shape[:-1], []
        for i, (factor, point) in enumerate(zip(self.factors, self.split(x), strict=True)):
            zeros = [jnp.zeros((*batch, factor.dim, *other.shape)) for other in self.factors]
            columns.append(self.join(*zeros[:i], factor._frame(point), *zeros[i + 1 :]))
        return jnp.concatenate(columns, axis=-2)

    def _coordinates(self, x, v):
        return self._apply_and_concatenate("_coordinates", x, v)

    def _from_coordinates(self, x, c):
        ends = np.cumsum([factor.dim for factor in self.factors])[:-1]
        triples = zip(self.factors, self.split(x), jnp.split(c, ends, axis=-1), strict=True)
        return self.join(*(factor._from_coordinates(point, components) for factor, point, components in triples))

    @property
    def isotropic_size(self):
        return sum(factor.isotropic_size for factor in self.factors)

    def _isotropic(self, x, w):
        ends = np.cumsum([factor.isotropic_size for factor in self.factors])[:-1]
        triples = zip(self.factors, self.split(x), jnp.split(w, ends, axis=-1), strict=True)
        return self.join(*(factor._isotropic(point, component) for factor, point, component in triples))

    def _inner(self, x, u, v):
        return sum(self._apply_to_factors("_inner", x, u, v))

    def _metric_covector(self, x, v):
        return self._apply_and_join("_metric_covector", x, v)

    def _sharp(self, x, alpha):
        return self._apply_and_join("_sharp", x, alpha)

    def _exp(self, x, v):
        return self._apply_and_join("_exp", x, v)

    def _log(self, x, y):
        return self._apply_and_join("_log", x, y)

    def _midpoint(self, x, y):
        return self._apply_and_join("_midpoint", x, y)

    def _squared_distance(self, x, y):
        return sum(self._apply_to_factors("_squared_distance", x, y))

    def _transport(self, x, v, u):
        return self._apply_and_join("_transport", x, v, u)

    def _reach(self, x, v):
        return jnp.stack(self._apply_to_factors("_reach", x, v)).max(axis=0)

    @property
    def bi_invariant(self):  # type: ignore[override]
        return all(factor.bi_invariant for factor in self.factors)

    @property
    def exp_is_group_exp(self):  # type: ignore[override]
        return all(factor.exp_is_group_exp for factor in self.factors)

    @property
    def has_geodesics(self):
        return all(factor.has_geodesics for factor in self.factors)

    @property
    def is_smooth(self):  # type: ignore[override]
        return all(factor.is_smooth for factor in self.factors)

    def _euclidean_reach(self, x, v):
        return jnp.stack(self._apply_to_factors("_euclidean_reach", x, v)).max(axis=0)

    def _group_exp(self, x, v):
        return self._apply_and_join("_group_exp", x, v)

    def _group_log(self, x, y):
        return self._apply_and_join("_group_log", x, y)

    def _left_translate(self, x, y, u):
        return self._apply_and_join("_left_translate", x, y, u)

    def _cayley(self, x, v):
        return self._apply_and_join("_cayley", x, v)

    def _inverse_cayley(self, x, y):
        return self._apply_and_join("_inverse_cayley", x, y)

    def _why_log_is_undefined(self, x, y):
        for i, (factor, *pair) in enumerate(zip(self.factors, self.split(x), self.split(y), strict=True)):
            if not np.isfinite(factor._log(*pair)).all():
                return f"in factor {i}, {factor.name}, {factor._why_log_is_undefined(*map(np.asarray, pair))}"
        raise AssertionError("the logarithm is defined in every factor")


@register_result_class("_power")
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Power(Space):
    """Product of ``count`` copies of a space, also written ``A**count``: points of shape ``(count, *base.shape)``.

    ``Sphere(2) ** 100`` holds the states of a chain of a hundred spins. The copies run as one batch.

    Parameters
    ----------
    base, count : Space, int
        The space, and the number of its copies.
    """

    base: Space
    count: int
    metric = "product"

    def __post_init__(self):
        if not isinstance(self.base, Space):
            raise SpaceError(f"Power(base, count): base must be a state space, got {type(self.base).__name__}")
        checked_size(self.count, 1, "Power(base, count)", "count")

    @property
    def name(self):
        return f"({self.base.name})^{self.count}"

    @property
    def dim(self):
        return self.count * self.base.dim

    @property
    def shape(self):
        return (self.count, *self.base.shape)

    dtype = forward_to("base")

    def injectivity_radius(self, x=None):
        if x is None:
            return self.base.injectivity_radius()
        return min(self.base.injectivity_radius(point) for point in self._ambient_array(x, "x"))

    def _residual(self, x):
        return self.base._residual(x).max(axis=-1)

    _project = forward_to("base")

    def random(self, key_or_seed, size=()):
        return self.base.random(key_or_seed, (*size, self.count))

    def _random(self, key, size):
        return self.random(key, size)

    @property
    def is_quotient(self):  # type: ignore[override]
        return self.base.is_quotient

    @property
    def _n_gaussian_samples(self):
        return None if self.base._n_gaussian_samples is None else self.count * self.base._n_gaussian_samples

    def _point_from_gaussian_samples(self, w):
        return self.base._point_from_gaussian_samples(w.reshape(*w.shape[:-1], self.count, -1))

    _restore = forward_to("base")
    _project_tangent = forward_to("base")
    can_be_embedded = forward_to("base")
    _has_equations = forward_to("base")

    def _constraints(self, x):
        return self._join_copies(self.base._constraints(x))

    def _constraint_rounding_scales(self, x):
        return self._join_copies(self.base._constraint_rounding_scales(x))

    @staticmethod
    def _join_copies(c):
        """Return numbers of each copy, shape (..., count, m), as one array, shape (..., count m)."""
        return c.reshape(*c.shape[:-2], -1)

    def _minimal_correction(self, x, constraint_change):
        return self.base._minimal_correction(x, self._split_copies(constraint_change))

    def _correction(self, x, constraint_change):
        return self.base._correction(x, self._split_copies(constraint_change))

    def _split_copies(self, c):
        """Return an array, shape (..., count m), as numbers of each copy, shape (..., count, m)."""
        return c.reshape(*c.shape[:-1], self.count, c.shape[-1] // self.count)

    _tangential_part = forward_to("base")

    def _inside(self, x):
        return self.base._inside(x).all(axis=-1)

    def _frame(self, x):
        frames = self.base._frame(x).reshape(*x.shape[: -len(self.shape)], self.count, self.base.dim, -1)
        blocks = jnp.einsum("...idm,ij->...idjm", frames, np.eye(self.count))
        return blocks.reshape(*x.shape[: -len(self.shape)], self.dim, *self.shape)

    def _coordinates(self, x, v):
        c = self.base._coordinates(x, v)
        return c.reshape(*c.shape[:-2], self.dim)

    def _from_coordinates(self, x, c):
        return self.base._from_coordinates(x, c.reshape(*c.shape[:-1], self.count, self.base.dim))

    @property
    def isotropic_size(self):
        return self.count * self.base.isotropic_size

    def _isotropic(self, x, w):
        return self.base._isotropic(x, w.reshape(*w.shape[:-1], self.count, self.base.isotropic_size))

    def _inner(self, x, u, v):
        return self.base._inner(x, u, v).sum(axis=-1)

    _metric_covector = forward_to("base")
    _sharp = forward_to("base")
    _exp = forward_to("base")
    _log = forward_to("base")
    _midpoint = forward_to("base")

    def _squared_distance(self, x, y):
        return self.base._squared_distance(x, y).sum(axis=-1)

    _transport = forward_to("base")

    def _reach(self, x, v):
        return self.base._reach(x, v).max(axis=-1)

    bi_invariant = forward_to("base")
    exp_is_group_exp = forward_to("base")
    has_geodesics = forward_to("base")
    is_smooth = forward_to("base")

    def _euclidean_reach(self, x, v):
        return self.base._euclidean_reach(x, v).max(axis=-1)

    _group_exp = forward_to("base")
    _group_log = forward_to("base")
    _left_translate = forward_to("base")
    _cayley = forward_to("base")
    _inverse_cayley = forward_to("base")

    def _why_log_is_undefined(self, x, y):
        is_undefined = ~np.isfinite(np.asarray(self.base._log(x, y))).reshape(self.count, -1).all(axis=1)
        i = int(is_undefined.argmax())
        return f"in copy {i}, {self.base._why_log_is_undefined(x[i], y[i])}"


register((Sphere(2), Euclidean(3)), (SpecialOrthogonal(3), Euclidean(3)))(Product)
register((Sphere(2), 4))(Power)


@register((3, 2))
@jax.tree_util.register_static
class Oblique(Power):
    """Oblique manifold: p unit vectors of R^n, the rows of a matrix, shape (p, n). It is a power of a sphere.

    Parameters
    ----------
    n, p : int
    """

    def __init__(self, n: int, p: int):
        super().__init__(Sphere(checked_size(n, 2, "Oblique(n, p)") - 1), checked_size(p, 1, "Oblique(n, p)", "p"))

    @property
    def name(self):
        return f"Oblique({self.base.dim + 1}, {self.count})"


@register((Sphere(2),))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class TangentBundle(Space):
    """Pairs (q, v) of a point of a space and a tangent vector there, shape ``(2, *base.shape)``.

    It represents the cotangent bundle too: a covector p at q is paired with tangent vectors by ``sum(p * v)``, and
    among the arrays with equal products the tangent one is taken. In these arrays the form ``p dq`` is the canonical
    one of T*Q. The metric is that of the ambient arrays.

    Parameters
    ----------
    base : Space
        Space of real arrays.
    """

    base: Space

    def __post_init__(self):
        if not isinstance(self.base, Space):
            raise SpaceError(f"TangentBundle(base): base must be a state space, got {type(self.base).__name__}")
        if self.base.dtype.kind == "c":
            raise SpaceError(
                f"TangentBundle(base): base must be a space of real arrays, but {self.base.name} is complex"
            )

    @property
    def name(self):
        return f"T {self.base.name}"

    @property
    def dim(self):
        return 2 * self.base.dim

    @property
    def shape(self):
        return (2, *self.base.shape)

    can_be_embedded = forward_to("base")
    is_smooth = forward_to("base")
    _has_equations = forward_to("base")

    def tangential_part(self, q, w) -> jax.Array:
        """Return the projection of the flat array w on the tangent space at the flat point q, shape (n,)."""
        base = self.base
        return base.to_vector(base._tangential_part(base.from_vector(q), base.from_vector(w)))

    def tangent_projector_and_compensation(self, x) -> tuple[jax.Array, jax.Array]:
        """Return matrices P and N, shape (n, n), for which ``(P a, P b + N P a)`` are tangent vectors at flat (q, v).

        P is the projector along Q. Moving q takes v out of the tangent space: ``N q'`` is the component of v' across Q
        that compensates for it.
        """
        base, (q, v) = self.base, self._position_and_vector(self.from_vector(x))
        rate_jacobian = jax.jacfwd(lambda y: self._constraint_rates(base.from_vector(y), v))(base.to_vector(q))
        if not self._has_equations:
            P = jax.vmap(lambda w: self.tangential_part(x[: base.size], w), out_axes=1)(jnp.eye(base.size))
            return P, -rate_jacobian
        rows = base._constraint_jacobian(q)
        pseudo_inverse = solve_without_pivoting(rows @ rows.T, rows).T
        return jnp.eye(base.size) - pseudo_inverse @ rows, -pseudo_inverse @ rate_jacobian

    # -- maps ---------------------------------------------------------------------------------------------------------

    def _constraint_rates(self, q, v):
        """Return the rates of the constraints of Q along v, shape (..., m), which vanish if v is tangent."""
        if self._has_equations:
            return jax.jvp(self.base._constraints, (q,), (v,))[1]
        return self.base.to_vector(v - self.base._tangential_part(q, v))

    def _constraints(self, x):
        q, v = self._position_and_vector(x)
        return jnp.concatenate([self.base._constraints(q), self._constraint_rates(q, v)], axis=-1)

    def _minimal_correction(self, x, constraint_change):
        if self._has_equations:
            return super()._minimal_correction(x, constraint_change)
        return self.from_vector(constraint_change)

    def _inside(self, x):
        return self.base._inside(self._position_and_vector(x)[0])

    def _project(self, x):
        q, v = self._position_and_vector(x)
        q = self.base._project(q)
        return self._stack_pair(q, self.base._project_tangent(q, v))

    def _random(self, key, size):
        point_key, vector_key = jax.random.split(random_key(key))
        q = self.base._random(point_key, size)
        return self._stack_pair(q, self.base._project_tangent(q, jax.random.normal(vector_key, q.shape)))

    def _project_tangent(self, x, w):
        return self._tangential_part(x, w) if self._has_equations else super()._project_tangent(x, w)

    def _sharp(self, x, alpha):
        return self._project_tangent(x, alpha)

    def _metric_covector(self, x, v):
        return v + jnp.zeros_like(x)

    # -- helpers ------------------------------------------------------------------------------------------------------

    def _position_and_vector(self, x):
        """Return the position q and the tangent vector v of a point (q, v) of the bundle."""
        axis = -1 - len(self.base.shape)
        return tuple(jnp.take(x, i, axis=axis) for i in (0, 1))

    def _stack_pair(self, q, v):
        """Return the point (q, v) of the bundle, shape ``(..., 2, *base.shape)``."""
        return jnp.stack(jnp.broadcast_arrays(q, v), axis=-1 - len(self.base.shape))
