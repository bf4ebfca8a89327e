"""SO(n) and SU(n) with their bi-invariant metrics, and SE(n) with the metric of rotations times translations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from ..catalogue import _size
from ..closed_forms import affine
from ..errors import ParameterError
from ..lie_group import SE, SO, SU, MatrixGroup, _log
from ..matrix_functions import determinant, polar
from ..symmetric import orthonormal_columns
from .base import Space, register

_so, _su, _se = lru_cache(SO), lru_cache(SU), lru_cache(SE)


class GroupSpace(Space):
    """A matrix group as a state space; tangent vectors at g are ``g hat(xi)``, frames the left-invariant ones.

    Attributes
    ----------
    group : MatrixGroup
        Its exponential, logarithm, Cayley map and adjoint actions.
    """

    @property
    def group(self) -> MatrixGroup:
        raise NotImplementedError

    @property
    def name(self):
        return self.group.name

    @property
    def dim(self):
        return self.group.dim

    @property
    def shape(self):
        return (self.group.matrix_size,) * 2

    def velocity(self, x, v) -> jax.Array:
        """Left-trivialised velocity: the ``xi`` in ``v = x hat(xi)``, components in the algebra, shape (..., dim)."""
        return self._compiled("_velocity", *self._checked_vectors(x, v=v))

    def from_velocity(self, x, xi) -> jax.Array:
        """``x hat(xi)``, the inverse of :meth:`velocity`."""
        xi = self.group._components(xi, "xi")
        return self._compiled("_from_velocity", self._checked_point(x, "x"), xi)

    def _velocity(self, x, v):
        return self.group.algebra.vee(self.group.inverse_map(x) @ v)

    def _from_velocity(self, x, xi):
        return x @ self.group.algebra.hat(xi)

    def _residual(self, x):
        return self.group.defect(x)

    def _relative(self, x, y):
        return self.group.inverse_map(x) @ y

    def _group_exp(self, x, v):
        return self._restored(x @ self.group.exp_map(self.group.algebra, self._velocity(x, v)))

    def _group_log(self, x, y):
        return self._from_velocity(x, _log(self.group, self._relative(x, y)))

    def _left_carry(self, x, y, u):
        return y @ (self.group.inverse_map(x) @ u)

    def _cayley(self, x, v):
        self.group._need("cayley")
        assert self.group.cayley_map is not None
        return self._restored(x @ self.group.cayley_map(self.group.algebra, self._velocity(x, v)))

    def _inverse_cayley(self, x, y):
        self.group._need("cayley")
        return self._from_velocity(x, self.group.inverse_cayley_map(self.group.algebra, self._relative(x, y)))

    def _restored(self, x):
        """One Newton step to the group, so that rounding does not add up."""
        return self.group.restore_map(x)


class BiInvariantSpace(GroupSpace):
    """Unitary matrices, with the inner product of components in the basis of the algebra.

    It is invariant under translations from both sides, so geodesics are ``x exp(t xi)`` [Milnor 1976].
    """

    metric = "bi-invariant"
    bi_invariant = True

    def _project_tangent(self, x, w):
        return self._from_velocity(x, self._velocity(x, w))  # vee is the orthogonal projection

    def _frame(self, x):
        return x[..., None, :, :] @ self.group.algebra._known_basis()

    def _coordinates(self, x, v):
        return self._velocity(x, v)

    def _from_coordinates(self, x, c):
        return self._from_velocity(x, c)

    def _inner(self, x, u, v):
        return self._pair(self._flat(x, u), v)

    def _flat(self, x, v):
        basis = self.group.algebra._known_basis()
        return v.conj() / (np.abs(basis[0]) ** 2).sum()  # orthogonal matrices, all of this norm

    def _exp(self, x, v):
        return self._group_exp(x, v)

    def _log(self, x, y):
        return self._group_log(x, y)

    def _transport(self, x, v, u):
        """``x m eta m`` with ``m = exp(xi/2)``: the velocity eta turns by Ad(m^-1)."""
        half = self.group.exp_map(self.group.algebra, 0.5 * self._velocity(x, v))
        return x @ half @ self._relative(x, u) @ half

    def _why_no_log(self, x, y):
        return f"x^-1 y {self.group._why_not_in_domain(np.asarray(self._relative(x, y)))}"


@register((3,), (4,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SpecialOrthogonal(BiInvariantSpace):
    """Rotations of R^n, with ``inner(x, u, v) = tr(u^T v) / 2``: rotations of a plane are as far apart as their angles.

    Closed forms for n = 2 and 3; general matrix functions otherwise.
    """

    n: int

    def __post_init__(self):
        _size(self.n, 2, "SpecialOrthogonal(n)")

    @property
    def group(self):
        return _so(self.n)

    def injectivity_radius(self, x=None):
        return math.pi

    def _project(self, x):
        return _rotation(x)

    def _random(self, key, size):
        return _random_rotation(key, (*size, *self.shape))


@register((2,), (3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SpecialUnitary(BiInvariantSpace):
    """Complex unitary matrices of determinant 1, with ``inner(x, u, v) = 2 Re tr(u^H v)``.

    SU(2) is a sphere S^3 of radius 2; closed forms. The logarithm is the principal one: for n > 2 it reaches to the
    radius ``pi sqrt(2n/(n-1))`` given here, less than the injectivity radius 2 pi of the space.
    """

    n: int
    dtype = np.dtype(np.complex128)

    def __post_init__(self):
        _size(self.n, 2, "SpecialUnitary(n)")

    @property
    def group(self):
        return _su(self.n)

    def injectivity_radius(self, x=None):
        return math.pi * math.sqrt(2 * self.n / (self.n - 1))

    def _project(self, x):
        return self._of_unit_determinant(polar(x))

    def _of_unit_determinant(self, x):
        return x * jnp.exp(-1j * jnp.angle(determinant(x)) / self.n)[..., None, None]

    def _random(self, key, size):
        real, imaginary = jax.random.normal(key, (2, *size, *self.shape))
        return self._of_unit_determinant(orthonormal_columns(real + 1j * imaginary))


@register((2,), (3, 0.5))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SpecialEuclidean(GroupSpace):
    """Rigid motions of R^n, with ``inner = tr(W^T W') / 2 + u·u' / length^2`` of velocities W of rotation and u.

    The metric is left-invariant and that of the product of SO(n) and R^n: geodesics turn at a constant rate while the
    origin of the body goes straight. They are not the one-parameter subgroups, which are screw motions: for those take
    the group retraction.

    Parameters
    ----------
    n : int
    length : float
        The translation that counts as much as a rotation by one radian.
    """

    n: int
    length: float = 1.0
    metric = "left-invariant"

    def __post_init__(self):
        _size(self.n, 2, "SpecialEuclidean(n)")
        if not 0.0 < self.length < math.inf:
            raise ParameterError(f"SpecialEuclidean(n, length): the length is a positive number, not {self.length!r}")

    @property
    def group(self):
        return _se(self.n)

    @property
    def rotations(self) -> SpecialOrthogonal:
        """The space of the rotation parts."""
        return SpecialOrthogonal(self.n)

    def injectivity_radius(self, x=None):
        return math.pi

    def _project(self, x):
        return affine(_rotation(x[..., :-1, :-1]), x[..., :-1, -1:])

    def _random(self, key, size):
        of_rotation, of_translation = jax.random.split(key)
        translation = self.length * jax.random.normal(of_translation, (*size, self.n, 1))
        return affine(_random_rotation(of_rotation, (*size, self.n, self.n)), translation)

    def _project_tangent(self, x, w):
        return self._map(self.rotations._project_tangent, lambda x, w: w, x, w)

    def _frame(self, x):
        scale = np.where(np.arange(self.dim) < self.rotations.dim, 1.0, self.length)
        return x[..., None, :, :] @ (scale[:, None, None] * self.group.algebra._known_basis())

    def _inner(self, x, u, v):
        return self._pair(self._flat(x, u), v)

    def _flat(self, x, v):
        return self._map(self.rotations._flat, lambda x, v: v / self.length**2, x, v)

    def _exp(self, x, v):
        y = self._map(self.rotations._exp, lambda x, v: x + v, x, v)
        return affine(y[..., :-1, :-1], y[..., :-1, -1:])

    def _log(self, x, y):
        return self._map(self.rotations._log, lambda x, y: y - x, x, y)

    def _transport(self, x, v, u):
        return self._map(self.rotations._transport, lambda x, v, u: u + jnp.zeros_like(v), x, v, u)

    def _reach(self, x, v):
        return self.rotations._reach(x[..., :-1, :-1], v[..., :-1, :-1])

    def _map(self, rotational, translational, *arrays):
        """Blocks ``[[rotational, translational], [0, 0]]`` of functions of the same blocks."""
        rotation = rotational(*(a[..., :-1, :-1] for a in arrays))
        translation = translational(*(a[..., :-1, -1:] for a in arrays))
        batch = jnp.broadcast_shapes(rotation.shape[:-2], translation.shape[:-2])
        top = jnp.concatenate([jnp.broadcast_to(a, (*batch, *a.shape[-2:])) for a in (rotation, translation)], axis=-1)
        return jnp.concatenate([top, jnp.zeros_like(top[..., :1, :])], axis=-2)

    def _why_no_log(self, x, y):
        return self.rotations._why_no_log(x[:-1, :-1], y[:-1, :-1])


def _rotation(x):
    """The nearest rotation, NaN where there is a reflection nearer than any."""
    x = polar(x)
    return jnp.where((determinant(x) > 0.0)[..., None, None], x, jnp.nan)


def _random_rotation(key, shape):
    x = orthonormal_columns(
        jax.random.normal(key, shape)
    )  # Haar measure, as those of the columns are rotation invariant
    return x * jnp.where(jnp.arange(shape[-1]) == 0, determinant(x)[..., None, None], 1.0)
