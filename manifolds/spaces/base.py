"""Base class of state spaces: points, tangent vectors, a metric and its geodesics, with checked arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import first_nonfinite_index, first_true_multi_index, format_index, is_traced, numeric_array
from ..errors import ComponentError, DomainError, OffManifoldError, ShapeError
from ..groups.matrix_group import MEMBERSHIP_TOLERANCE
from .maps import SpaceMaps

__all__ = ["CUT_MARGIN", "MEMBERSHIP_TOLERANCE", "Space", "register", "register_result_class", "registered_spaces"]

CUT_MARGIN = 1e-8
"""Smallest relative distance from the cut locus at which a logarithm is taken; below, rounding decides its
direction."""

MIN_CUT_ANGLE = 2e-14
"""Smallest angle from the cut locus at which a closed form returns a logarithm.

At an angle a its direction is known to about 1e-16 / a, and the point to which it leads, to rounding. At smaller angles
nothing is known of the direction.
"""

_registry: list[tuple[Callable[..., Space], tuple]] = []


def register(*argument_tuples: tuple):
    """Decorate a constructor to register the space of each argument tuple; the property suite runs on these spaces."""

    def add_to_registry(constructor):
        _registry.extend((constructor, a) for a in argument_tuples)
        return constructor

    return add_to_registry


def registered_spaces() -> Iterator[Space]:
    """Yield one instance of every registered state space."""
    for constructor, args in _registry:
        yield constructor(*args)


class Space(SpaceMaps):
    """Riemannian manifold in an ambient space of arrays; leading axes of all arguments are batches, and broadcast.

    A point is an array of shape ``shape``, a tangent vector at it an array of equal shape, with the components of
    its velocity in the ambient space. A covector, such as the gradient that ``jax.grad`` takes of a function of the
    ambient array, is paired with a tangent vector by ``Re sum(alpha * v)``.

    All maps can be jitted, vmapped and differentiated. They check their arguments, and raise where they are
    not defined; under tracing, where values are not available, they return NaN instead.

    A subclass is a frozen dataclass, decorated with ``jax.tree_util.register_static``. It implements ``name``, ``dim``,
    ``shape`` and ``_project``, and may override the other members that begin with an underscore; each is a plain JAX
    function of checked arrays with leading batch axes. The tangent spaces follow from ``_project``, any smooth map from
    arrays to points that leaves points unchanged; the metric is that of the ambient array unless ``_inner`` is
    overridden. There are geodesics if ``_exp``, ``_log`` and ``_transport`` are given, with :meth:`injectivity_radius`;
    a space without geodesics runs in the chart of a :class:`manifolds.ProjectionRetraction`, or of a chart of your own.
    A closed form is faster than a derived map: the native spaces have all of them.

    Attributes
    ----------
    name, metric : str
        The space, and its metric in words.
    dim : int
    shape : tuple of int
        Of a point.
    dtype : numpy.dtype
        Of a point: float64 or complex128.
    """

    # -- points ---------------------------------------------------------------------------------------------------

    def point(self, x, project: bool = False, tolerance: float = MEMBERSHIP_TOLERANCE) -> jax.Array:
        """Return ``x`` as a point of the space, or a batch of points, shape ``(..., *shape)``, after a check.

        Parameters
        ----------
        x : array, shape ``(..., *shape)``
        project : bool
            Move it to the space first (see :meth:`project`), however far away it is.
        tolerance : float
            Largest residual (see :meth:`residual`) that passes.

        Raises
        ------
        OffManifoldError, ShapeError, ComponentError
            If x is off the space (not checked under tracing), or no array of real numbers of this shape.
        """
        return self._checked_point(self.project(x) if project else self._ambient_array(x, "x"), "x", tolerance)

    def residual(self, x) -> jax.Array:
        """Return the distance from the space relative to the size of x, to the order of magnitude, shape (...)."""
        return self._call_compiled("_residual", self._ambient_array(x, "x"))

    def belongs(self, x, tolerance: float = 1e-10) -> jax.Array:
        """Return True for each point with ``residual(x) <= tolerance``, shape (...)."""
        return self.residual(x) <= tolerance

    def project(self, x) -> jax.Array:
        """Return a point of the space near x, the nearest one if that has a simple form, shape ``(..., *shape)``.

        DomainError if there is none, as for the centre of a sphere.
        """
        x = self._ambient_array(x, "x")
        y = self._call_compiled("_project", x)
        if (index := first_nonfinite_index(y, len(self.shape))) is not None:
            reason = self._why_overflow(np.asarray(x)[index]) or "no point of the space is nearest to it"
            raise DomainError(f"{self.name}: x{format_index(index)} cannot be projected: {reason}")
        return y

    def random(self, key_or_seed, size: tuple[int, ...] = ()) -> jax.Array:
        """Return random points, shape ``(*size, *shape)``: uniform if the space is compact, else around a centre.

        Parameters
        ----------
        key_or_seed : JAX random key, or int
        size : tuple of int
        """
        return self._call_compiled("_random", random_key(key_or_seed), static=(tuple(size),))

    def to_vector(self, x) -> jax.Array:
        """Return points or tangent vectors as flat real arrays, shape (..., size): real parts, then imaginary parts."""
        x = self._ambient_array(x, "x")
        rows = x.reshape(*x.shape[: x.ndim - len(self.shape)], -1)
        return rows if self.dtype.kind != "c" else jnp.concatenate([rows.real, rows.imag], axis=-1)

    def from_vector(self, x) -> jax.Array:
        """Return the points or tangent vectors of flat real arrays, shape ``(..., *shape)``: the inverse of
        :meth:`to_vector`."""
        x = jnp.asarray(numeric_array(x, "x"))
        if x.shape[-1:] != (self.size,):
            raise ShapeError(f"x must have last axis {self.size} for {self.name}, but its shape is {x.shape}")
        if self.dtype.kind == "c":
            real, imaginary = jnp.split(x, 2, axis=-1)
            x = real + 1j * imaginary
        return x.reshape(*x.shape[:-1], *self.shape)

    # -- tangent vectors ------------------------------------------------------------------------------------------

    def project_tangent(self, x, w) -> jax.Array:
        """Return the tangent vector at x nearest to the ambient array w in the Euclidean norm, shape ``(...,
        *shape)``."""
        return self._call_compiled("_project_tangent", self._checked_point(x, "x"), self._ambient_array(w, "w"))

    def random_tangent(self, key_or_seed, x, scale: float = 1.0) -> jax.Array:
        """Return random tangent vectors at x, with normal components of standard deviation ``scale`` in the frame."""
        x = self._checked_point(x, "x")
        batch = x.shape[: x.ndim - len(self.shape)]
        return self.from_coordinates(x, scale * jax.random.normal(random_key(key_or_seed), (*batch, self.dim)))

    def frame(self, x) -> jax.Array:
        """Return an orthonormal basis of the tangent space at x, shape ``(..., dim, *shape)``."""
        return self._call_compiled("_frame", self._checked_point(x, "x"))

    def coordinates(self, x, v) -> jax.Array:
        """Return the components of a tangent vector in :meth:`frame`, shape (..., dim)."""
        return self._call_compiled("_coordinates", *self._checked_point_and_vectors(x, v=v))

    def from_coordinates(self, x, c) -> jax.Array:
        """Return the tangent vector at x with the components c, shape (..., dim), in :meth:`frame`."""
        c = jnp.asarray(numeric_array(c, "c"))
        if c.shape[-1:] != (self.dim,):
            raise ShapeError(f"c must have last axis {self.dim} for {self.name}, but its shape is {c.shape}")
        return self._call_compiled("_from_coordinates", self._checked_point(x, "x"), c.astype(jnp.float64))

    # -- metric ---------------------------------------------------------------------------------------------------

    def inner(self, x, u, v) -> jax.Array:
        """Return the inner product of two tangent vectors at x, shape (...)."""
        return self._call_compiled("_inner", *self._checked_point_and_vectors(x, u=u, v=v))

    def norm(self, x, v) -> jax.Array:
        """Return the length of a tangent vector, shape (...); its derivative at v = 0 is taken as 0."""
        return self._call_compiled("_norm", *self._checked_point_and_vectors(x, v=v))

    def flat(self, x, v) -> jax.Array:
        """Return the covector ``w -> inner(x, v, w)``, as an ambient array, shape ``(..., *shape)``."""
        return self._call_compiled("_metric_covector", *self._checked_point_and_vectors(x, v=v))

    def sharp(self, x, alpha) -> jax.Array:
        """Return the tangent vector v with ``inner(x, v, w) = Re sum(alpha * w)`` for all w; dH gives the gradient of
        H.

        Parameters
        ----------
        x : array, shape ``(..., *shape)``
        alpha : array, shape ``(..., *shape)``
            An ambient covector; only its action on tangent vectors matters.
        """
        return self._call_compiled("_sharp", self._checked_point(x, "x"), self._ambient_array(alpha, "alpha"))

    def isotropic(self, x, w) -> jax.Array:
        """Return the tangent vector ``R w``, with ``R R^T`` the inverse of the metric; normal numbers w give isotropic
        noise.

        Parameters
        ----------
        x : array, shape ``(..., *shape)``
        w : array, shape (..., isotropic_size)
        """
        w = jnp.asarray(numeric_array(w, "w"))
        if w.shape[-1:] != (self.isotropic_size,):
            size = self.isotropic_size
            raise ShapeError(f"w must have last axis {size} for {self.name}, but its shape is {w.shape}")
        return self._call_compiled("_isotropic", self._checked_point(x, "x"), w.astype(jnp.float64))

    def divergence(self, field, x) -> jax.Array:
        """Return the divergence of a vector field at one point, shape (): the rate at which its flow expands Riemannian
        volume.

        Parameters
        ----------
        field : function
            From a point to a tangent vector there, arrays of the shape of a point.
        x : array, shape ``shape``

        Raises
        ------
        SpaceError
            On a space without geodesics whose metric is not that of the arrays around.
        """
        x = self._checked_point(x, "x")
        return self._divergence_terms(x, lambda y, alpha: self._pair(alpha, field(y))).sum()

    # -- geodesics ------------------------------------------------------------------------------------------------

    def exp(self, x, v) -> jax.Array:
        """Return the point at time 1 of the geodesic from x with velocity v, shape ``(..., *shape)``: Riemannian
        exponential. DomainError if it exceeds the range of double precision."""
        x, v = self._checked_point_and_vectors(x, v=v)
        y = self._call_compiled("_exp", x, v)
        if (index := first_nonfinite_index(y, len(self.shape))) is not None:
            raise DomainError(f"{self.name}: exp(x, v){format_index(index)} exceeds the range of double precision")
        return y

    def log(self, x, y) -> jax.Array:
        """Return the v of least length with ``exp(x, v) = y``, a tangent vector at x: the Riemannian logarithm.

        The points x and y have the shape ``(..., *shape)``.

        Raises
        ------
        DomainError
            If y is at the cut locus of x, as its antipode is on a sphere, or (SU(n) with n > 2, Stiefel) beyond the
            domain of the logarithm used; under tracing the result is NaN. For a rotation by pi in one plane, see
            :meth:`manifolds.MatrixGroup.log`.
        """
        x, y = self._checked_point(x, "x"), self._checked_point(y, "y")
        v = self._call_compiled("_log", x, y)
        self._raise_if_not_finite(v, len(self.shape), x, y, "log")
        return v

    def distance(self, x, y) -> jax.Array:
        """Return the length of the shortest geodesic from x to y, shape (...).

        The derivative at y = x is taken as 0. ``distance(x, y)**2`` has exact derivatives there. Other smooth functions
        of the distance, such as ``1 - cos(d)``, have exact derivatives up to the third: use :meth:`squared_distance`
        if you need higher ones. DomainError if the distance follows from :meth:`log` and the logarithm is undefined.
        """
        x, y = self._checked_point(x, "x"), self._checked_point(y, "y")
        d = self._distance(x, y)
        self._raise_if_not_finite(d, 0, x, y, "distance")
        return d

    def squared_distance(self, x, y) -> jax.Array:
        """Return the square of :meth:`distance`, shape (...): a smooth function, also where x and y are one point.

        Raises
        ------
        DomainError
            As for :meth:`distance`.
        """
        x, y = self._checked_point(x, "x"), self._checked_point(y, "y")
        square = self._squared_distance(x, y)
        self._raise_if_not_finite(square, 0, x, y, "squared_distance")
        return square

    def midpoint(self, x, y) -> jax.Array:
        """Return the point half way along the shortest geodesic from x to y, shape ``(..., *shape)``; raises as
        :meth:`log`."""
        x, y = self._checked_point(x, "x"), self._checked_point(y, "y")
        z = self._midpoint(x, y)
        self._raise_if_not_finite(z, len(self.shape), x, y, "midpoint")
        return z

    def transport(self, x, v, u) -> jax.Array:
        """Return the parallel transport of the tangent vector u along ``t -> exp(x, t v)``, from t = 0 to 1.

        Returns
        -------
        array, shape ``(..., *shape)``
            A tangent vector at ``exp(x, v)``. Inner products are kept.
        """
        return self._call_compiled("_transport", *self._checked_point_and_vectors(x, v=v, u=u))

    def reach(self, x, v) -> jax.Array:
        """Return the length of v divided by the injectivity radius; below 1, ``log`` recovers v from ``exp(x, v)``.

        It is defined under tracing too, where it tells if a step stays in the domain. In a product it is the largest
        over the factors.
        """
        return self._call_compiled("_reach", *self._checked_point_and_vectors(x, v=v))

    # -- checks ---------------------------------------------------------------------------------------------------

    def _ambient_array(self, x, label: str) -> jax.Array:
        """Return ``x`` as an array with the shape and dtype of points."""
        array = jnp.asarray(numeric_array(x, label))
        if jnp.iscomplexobj(array) and self.dtype.kind != "c":
            raise ComponentError(
                f"{label} must be real for {self.name}, got {array.dtype}. Take its real part if that is meant"
            )
        if array.shape[array.ndim - len(self.shape) :] != self.shape or array.ndim < len(self.shape):
            expected_shape = f"(..., {', '.join(map(str, self.shape))})"
            raise ShapeError(
                f"{label} must have the shape {expected_shape} for {self.name}, but its shape is {array.shape}"
            )
        return array.astype(self.dtype)

    def _checked_point(self, x, label: str, tolerance: float = MEMBERSHIP_TOLERANCE) -> jax.Array:
        x = self._ambient_array(x, label)
        if is_traced(x):
            return x
        with jax.ensure_compile_time_eval():  # x may be a constant in a program being traced
            residual, values = np.asarray(self._call_compiled("_residual", x)), np.asarray(x)
        if (index := first_true_multi_index(~(residual <= tolerance))) is not None:
            largest_residual = float(residual[index])
            if reason := self._why_overflow(values[index]):
                raise DomainError(f"{self.name}: {label}{format_index(index)} cannot be used: {reason}")
            raise OffManifoldError(
                f"{self.name}: {label}{format_index(index)} is off the space: "
                f"{self._why_off_space(values[index], largest_residual)}, tolerance {tolerance:.0e}; "
                f"point({label}, project=True) moves it there",
                residual=largest_residual,
                tolerance=tolerance,
            )
        return x

    def _why_off_space(self, x: np.ndarray, residual: float) -> str:
        return f"residual {residual:.3g}" if np.isfinite(x).all() else "residual nan, as it is not finite"

    def _why_overflow(self, x: np.ndarray) -> str:
        """Return why the maps of the space overflow at a finite array x; an empty text if they do not."""
        return ""

    def _checked_point_and_vectors(self, x, name: str = "x", **vectors) -> list[jax.Array]:
        """Return the point and the vectors, after checking that each vector is tangent at the point."""
        x, arrays = self._checked_point(x, name), []
        for label, v in vectors.items():
            v = self._ambient_array(v, label)
            if not is_traced(x, v):
                self._check_tangent(x, name, v, label)
            arrays.append(v)
        return [x, *arrays]

    def _check_tangent(self, x, name: str, v, label: str) -> None:
        with jax.ensure_compile_time_eval():
            residual = np.asarray(self._call_compiled("_tangent_residual", x, v))
        if (index := first_true_multi_index(~(residual <= MEMBERSHIP_TOLERANCE))) is not None:
            largest_residual = float(residual[index])
            raise OffManifoldError(
                f"{self.name}: {label}{format_index(index)} is not tangent at {name}: residual {largest_residual:.3g}, "
                f"tolerance {MEMBERSHIP_TOLERANCE:.0e}; project_tangent({name}, {label}) makes it so",
                residual=largest_residual,
                tolerance=MEMBERSHIP_TOLERANCE,
            )

    def _tangent_residual(self, x, v):
        axes = self._axes
        scale = jnp.maximum(jnp.abs(v).max(axis=axes, initial=0.0), 1.0)
        return jnp.abs(v - self._project_tangent(x, v)).max(axis=axes, initial=0.0) / scale

    def _raise_if_not_finite(self, value, n_core_axes: int, x, y, map_name: str) -> None:
        if (index := first_nonfinite_index(value, n_core_axes)) is not None:
            batch = value.shape[: value.ndim - n_core_axes]
            x, y = (np.asarray(jnp.broadcast_to(a, (*batch, *self.shape))[index]) for a in (x, y))
            raise DomainError(
                f"{self.name}: {map_name}(x, y){format_index(index)} is not defined: {self._why_log_is_undefined(x, y)}"
            )

    # -- helpers --------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"<{self.name}: dim {self.dim}, points of shape {self.shape}, {self.metric} metric>"

    def __mul__(self, other: Space) -> Space:
        return self._product(self, other) if isinstance(other, Space) else NotImplemented

    def __pow__(self, count: int) -> Space:
        return self._power(self, count)

    _product: ClassVar[Callable[..., Space]]
    """Class of products of spaces, set by :func:`register_result_class`, since it is defined after this class."""

    _power: ClassVar[Callable[..., Space]]
    """Class of powers of spaces, set by :func:`register_result_class`, since it is defined after this class."""


def register_result_class(operation: str) -> Callable[[type[Space]], type[Space]]:
    """Return a decorator that makes a class the result of an operation, ``"_product"`` or ``"_power"``, of spaces."""

    def set_result_class(space_class: type[Space]) -> type[Space]:
        setattr(Space, operation, space_class)
        return space_class

    return set_result_class


def random_key(key_or_seed):
    """Return a JAX random key, made from an integer seed if that is given."""
    return jax.random.key(key_or_seed) if isinstance(key_or_seed, int | np.integer) else key_or_seed
