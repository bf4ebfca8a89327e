"""Matrix groups as state spaces: any group with a left-invariant metric; SO(n), SU(n), SE(n) with Riemannian
geodesics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from .._arrays import numeric_array
from .._pytree_module import forward_to
from ..errors import ParameterError, SpaceError
from ..groups.catalogue import SE, SL, SO, SU, Heisenberg
from ..groups.closed_forms import affine_matrix, return_unchanged
from ..groups.matrix_group import MEMBERSHIP_TOLERANCE, MatrixGroup, _log
from ..matrices.linear import determinant, skew_matrix, solve, spectral_radius, symmetric_matrix
from ..matrices.symmetric import one_sided_jacobi_svd, orthonormal_columns, polar
from .base import Space, register
from .maps import inner_by_coordinates, inner_by_flat, squared_distance_with_cut_locus, tangential_part_by_projection

_so, _su, _se = lru_cache(SO), lru_cache(SU), lru_cache(SE)


@jax.tree_util.register_static
class GroupSpace(Space):
    """Matrix group as a state space, native or user-defined; tangent vectors at g are ``g hat(xi)``.

    The metric is left-invariant. ``exp(x, x hat(xi))`` is ``x exp(xi)``, whatever the metric: these curves are
    geodesics of the connection for which left-invariant fields are parallel, which preserves inner products, and of the
    metric itself if it is right-invariant too. Therefore :meth:`transport` preserves the velocity xi, and
    :meth:`distance` is the length of ``log(x^-1 y)``, not less than that of the shortest curve. SO(n), SU(n) and SE(n)
    are spaces of their own, with the Riemannian geodesics: :class:`SpecialOrthogonal`, :class:`SpecialUnitary`,
    :class:`SpecialEuclidean`.

    Parameters
    ----------
    group : MatrixGroup
        The group, whose ``restore_map`` alone projects a nearby point to it.
    inner : array, shape (dim, dim), optional
        Inner products of the basis of the algebra; by default the basis is orthonormal.

    Raises
    ------
    SpaceError
        If ``group`` is no MatrixGroup.
    ParameterError
        If ``inner`` is not symmetric and positive definite.
    """

    metric = "left-invariant"
    exp_is_group_exp = True

    def __init__(self, group: MatrixGroup, inner=None):
        if not isinstance(group, MatrixGroup):
            raise SpaceError(
                f"GroupSpace(group): group must be a MatrixGroup, such as SL(3), got {type(group).__name__}"
            )
        inner = np.eye(group.dim) if inner is None else np.asarray(numeric_array(inner, "inner"), dtype=np.float64)
        if inner.shape != (group.dim,) * 2 or not np.allclose(inner, inner.T, rtol=1e-12, atol=0.0):
            raise ParameterError(f"inner must be a symmetric matrix of shape {(group.dim,) * 2} for {group.name}")
        try:
            self._root = np.linalg.cholesky(inner)
        except np.linalg.LinAlgError:
            min_eigenvalue = np.linalg.eigvalsh(inner)[0]
            raise ParameterError(f"inner must be positive definite, got the eigenvalue {min_eigenvalue:.3g}") from None
        self._group = group

    def __eq__(self, other):
        is_same_class = type(self) is type(other)
        return is_same_class and self._group == other._group and np.array_equal(self._root, other._root)

    def __hash__(self):
        return hash((self._group, self._root.tobytes()))

    @property
    def group(self) -> MatrixGroup:
        """The group, with its exponential, logarithm, Cayley map and adjoint actions."""
        return self._group

    @property
    def dtype(self):  # type: ignore[override]
        return self.group.algebra._require_basis().dtype

    name = forward_to("group")
    dim = forward_to("group")

    @property
    def shape(self):
        return (self.group.matrix_size,) * 2

    def velocity(self, x, v) -> jax.Array:
        """Return the left-trivialised velocity: the ``xi`` in ``v = x hat(xi)``, components in the algebra, shape (...,
        dim)."""
        return self._call_compiled("_velocity", *self._checked_point_and_vectors(x, v=v))

    def from_velocity(self, x, xi) -> jax.Array:
        """Return ``x hat(xi)``, the inverse of :meth:`velocity`."""
        xi = self.group._components(xi, "xi")
        return self._call_compiled("_from_velocity", self._checked_point(x, "x"), xi)

    def _velocity(self, x, v):
        return self.group.algebra.vee(self.group.inverse_map(x) @ v)

    def _from_velocity(self, x, xi):
        return x @ self.group.algebra.hat(xi)

    def _residual(self, x):
        return self.group.defect(x)

    def _relative_element(self, x, y):
        return self.group.inverse_map(x) @ y

    def _group_exp(self, x, v):
        return self._apply_restore_map(x @ self.group.exp_map(self.group.algebra, self._velocity(x, v)))

    def _group_log(self, x, y):
        return self._from_velocity(x, _log(self.group, self._relative_element(x, y)))

    def _left_translate(self, x, y, u):
        return y @ (self.group.inverse_map(x) @ u)

    def _cayley(self, x, v):
        self.group._require_map("cayley")
        assert self.group.cayley_map is not None
        return self._apply_restore_map(x @ self.group.cayley_map(self.group.algebra, self._velocity(x, v)))

    def _inverse_cayley(self, x, y):
        self.group._require_map("cayley")
        return self._from_velocity(x, self.group.inverse_cayley_map(self.group.algebra, self._relative_element(x, y)))

    def _apply_restore_map(self, x):
        """Take one Newton step to the group, so that rounding errors do not add up."""
        return self.group.restore_map(x)

    @property
    def can_be_embedded(self):
        """False if nothing but the algebra and a distance from the group is known."""
        return self._has_equations or self.group.restore_map is not return_unchanged or self.dim == self.size

    @property
    def _has_equations(self):
        return self.group.equations is not None

    def _constraints(self, x):
        return super()._constraints(x) if self.group.equations is None else self.group.equations(x)

    def _restore(self, x):
        return self._apply_restore_map(x)

    def _inside(self, x):
        return self.group.defect(x) <= MEMBERSHIP_TOLERANCE

    # -- the metric of this space, which its subclasses replace -----------------------------------------------------

    def injectivity_radius(self, x=None):
        """Return a lower bound of the injectivity radius: eigenvalues of a shorter velocity are smaller than pi."""
        basis = self._orthonormal_basis
        generic_element = np.einsum("a,aij->ij", np.random.default_rng(0).standard_normal(len(basis)), basis)
        if not np.abs(np.linalg.matrix_power(generic_element, len(generic_element))).max() > 1e-12 * np.abs(
            generic_element
        ).max() ** len(generic_element):
            return math.inf  # nilpotent: no eigenvalue but zero
        rows = basis.reshape(len(basis), -1)
        return math.pi / math.sqrt(np.linalg.eigvalsh((rows.conj() @ rows.T).real)[-1])

    def _reach(self, x, v):
        return spectral_radius(self.group.algebra.hat(self._velocity(x, v))) / math.pi

    def _project(self, x):
        for _ in range(_MAX_RESTORE_STEPS):
            x = self._apply_restore_map(x)
        return jnp.where((self.group.defect(x) <= MEMBERSHIP_TOLERANCE)[..., None, None], x, jnp.nan)

    @property
    def _n_gaussian_samples(self):
        return self.dim

    def _point_from_gaussian_samples(self, w):
        return self.group.exp_map(self.group.algebra, 0.5 * w)

    def _project_tangent(self, x, w):
        xi = self._velocity(x, w)
        basis = x[..., None, :, :] @ self.group.algebra._require_basis()
        rows = basis.reshape(*basis.shape[:-2], -1)
        remainder = (w - self._from_velocity(x, xi)).reshape(*xi.shape[:-1], -1, 1)
        gram = (rows.conj() @ rows.swapaxes(-1, -2)).real
        return self._from_velocity(x, xi + solve(gram, (rows.conj() @ remainder).real)[..., 0])

    @cached_property
    def _orthonormal_basis(self) -> np.ndarray:
        """Orthonormal basis of the algebra, shape (dim, m, m)."""
        return np.einsum("ab,bij->aij", np.linalg.inv(self._root), self.group.algebra._require_basis())

    def _frame(self, x):
        return x[..., None, :, :] @ self._orthonormal_basis

    def _coordinates(self, x, v):
        return self._velocity(x, v) @ self._root

    def _from_coordinates(self, x, c):
        return self._from_velocity(x, c @ np.linalg.inv(self._root))

    _inner = inner_by_coordinates

    @cached_property
    def _adjoint_traces(self) -> np.ndarray:
        """Traces ``tr ad`` of the orthonormal basis, shape (dim,): zero on a unimodular group."""
        with jax.ensure_compile_time_eval():
            axes = np.eye(self.dim)
            brackets = np.asarray(self.group.algebra.bracket(axes[:, None], axes[None]))
        return np.linalg.solve(self._root, np.einsum("kaa->k", brackets))

    def _divergence_terms(self, x, pair_with_field):
        """Return the terms along left translations, and ``-tr ad_E`` unless the group is unimodular."""
        translation_terms = super()._divergence_terms(x, pair_with_field)
        if self.group.algebra.is_unimodular():
            return translation_terms
        field_terms = pair_with_field(x, self._metric_covector(x, self._from_coordinates(x, -self._adjoint_traces)))
        return jnp.concatenate([translation_terms, field_terms[None]])

    def _exp(self, x, v):
        return self._group_exp(x, v)

    def _log(self, x, y):
        return self._group_log(x, y)

    def _transport(self, x, v, u):
        return self._left_translate(x, self._group_exp(x, v), u)

    def _why_log_is_undefined(self, x, y):
        return f"x^-1 y {self.group._why_not_in_domain(np.asarray(self._relative_element(x, y)))}"


_MAX_RESTORE_STEPS = 8
"""Number of Newton steps to the group; each squares the distance, so that eight of them reach rounding from 1/2."""

_REAL_EIGENVALUE_SINE = 1e-9
"""Largest sine of the angle of an eigenvalue that counts as 1 or -1, so that its angle has no sign."""

register(())(lambda: GroupSpace(Heisenberg(1)))
register(())(lambda: GroupSpace(SL(2), np.diag([1.0, 2.0, 2.0]) + 0.5))


class BiInvariantSpace(GroupSpace):
    """Unitary matrices, with the inner product of components in the basis of the algebra.

    The metric is invariant under translations from both sides, so geodesics are ``x exp(t xi)`` [Milnor 1976].
    """

    metric = "bi-invariant"
    bi_invariant = True

    def _project_tangent(self, x, w):
        return self._from_velocity(x, self._velocity(x, w))  # vee is the orthogonal projection

    _tangential_part = tangential_part_by_projection

    def _frame(self, x):
        return x[..., None, :, :] @ self.group.algebra._require_basis()

    def _coordinates(self, x, v):
        return self._velocity(x, v)

    def _from_coordinates(self, x, c):
        return self._from_velocity(x, c)

    _inner = inner_by_flat

    def _metric_covector(self, x, v):
        basis = self.group.algebra._require_basis()
        return v.conj() / (np.abs(basis[0]) ** 2).sum()  # orthogonal matrices, all of this norm

    def _reach(self, x, v):
        return Space._reach(self, x, v)

    def _squared_distance(self, x, y):
        return squared_distance_with_cut_locus(self, x, y)

    def _squared_distance_value(self, x, y):
        """Return the sum of the squared angles of the eigenvalues of ``x^-1 y``, defined at half turns too.

        ``|g v + v| = 2 cos(t/2)`` and ``|g v - v| = 2 sin(t/2)`` for eigenvectors v; these are computed from ``g + 1``,
        to a rounding also where the cosine is small. NaN if the angles are not those of one logarithm in the algebra.
        """
        g, identity = self._relative_element(x, y), np.eye(self.shape[0])
        cosines, vectors = one_sided_jacobi_svd(g + identity)
        sines = (g - identity) @ vectors
        angles = 2.0 * jnp.arctan2(*(jnp.sqrt((jnp.abs(a) ** 2).sum(axis=-2)) for a in (sines, cosines)))
        square = (angles**2).sum(axis=-1) / (jnp.abs(self.group.algebra._require_basis()[0]) ** 2).sum()
        if not self.group.is_complex:
            return square
        eigenvalue_imaginary_parts = (vectors.conj() * (g @ vectors)).sum(axis=-2).imag
        angle_sines = jnp.sin(angles)
        signs = jnp.where(
            angle_sines > _REAL_EIGENVALUE_SINE,
            eigenvalue_imaginary_parts / jnp.where(angle_sines > _REAL_EIGENVALUE_SINE, angle_sines, 1.0),
            0.0,
        )
        half_turns = (jnp.where(angle_sines > _REAL_EIGENVALUE_SINE, 0.0, angles)).sum(axis=-1)
        total = jnp.abs((signs * angles).sum(axis=-1))
        return jnp.where(total <= half_turns + 1.0, square, jnp.nan)

    def _transport(self, x, v, u):
        """Return the transported vector ``x m eta m``, with ``m = exp(xi/2)``, v = x hat(xi) and u = x hat(eta)."""
        half = self.group.exp_map(self.group.algebra, 0.5 * self._velocity(x, v))
        return x @ half @ self._relative_element(x, u) @ half


@register((3,), (4,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SpecialOrthogonal(BiInvariantSpace):
    """Rotations of R^n, with ``inner(x, u, v) = tr(u^T v) / 2``: the distance of rotations of one plane is their angle.

    n = 2 and 3 have closed forms; other n use general matrix functions.

    Parameters
    ----------
    n : int
        The size of the matrices.
    """

    n: int

    def __post_init__(self):
        checked_size(self.n, 2, "SpecialOrthogonal(n)")

    @property
    def group(self):
        return _so(self.n)

    def injectivity_radius(self, x=None):
        return math.pi

    def _project(self, x):
        return _nearest_rotation(x)

    def _squared_distance(self, x, y):
        if self.n <= 3:  # where every rotation has a logarithm
            return Space._squared_distance(self, x, y)
        return super()._squared_distance(x, y)

    @property
    def _n_gaussian_samples(self):
        return self.size

    def _point_from_gaussian_samples(self, w):
        return _random_rotation(self.from_vector(w))

    def _correction(self, x, constraint_change):
        return 0.5 * symmetric_matrix(constraint_change, self.n) @ x

    def _constraint_rounding_scales(self, x):
        return 2.0 * (jnp.abs(x) @ jnp.abs(x).swapaxes(-1, -2))[..., *np.triu_indices(self.n)]


@register((2,), (3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SpecialUnitary(BiInvariantSpace):
    """Complex unitary matrices of determinant 1, with ``inner(x, u, v) = 2 Re tr(u^H v)``.

    SU(2) is a sphere S^3 of radius 2, with closed forms. The logarithm is the principal one: for n > 2 it reaches to
    the radius ``pi sqrt(2n/(n-1))`` given here, less than the injectivity radius 2 pi of the space.

    Parameters
    ----------
    n : int
        The size of the matrices.
    """

    n: int
    dtype = np.dtype(np.complex128)

    def __post_init__(self):
        checked_size(self.n, 2, "SpecialUnitary(n)")

    @property
    def group(self):
        return _su(self.n)

    def injectivity_radius(self, x=None):
        return math.pi * math.sqrt(2 * self.n / (self.n - 1))

    def _project(self, x):
        return self._scale_to_unit_determinant(polar(x))

    def _scale_to_unit_determinant(self, x):
        return x * jnp.exp(-1j * jnp.angle(determinant(x)) / self.n)[..., None, None]

    @property
    def _n_gaussian_samples(self):
        return self.size

    def _point_from_gaussian_samples(self, w):
        return self._scale_to_unit_determinant(orthonormal_columns(self.from_vector(w)))

    def _correction(self, x, constraint_change):
        real_entries, imaginary_entries, phase = jnp.split(
            constraint_change, np.cumsum([self.n * (self.n + 1) // 2, math.comb(self.n, 2)]), -1
        )
        hermitian = symmetric_matrix(real_entries, self.n) + 1j * skew_matrix(imaginary_entries, self.n)
        return 0.5 * hermitian @ x + (1j / self.n) * phase[..., None] * x

    def _constraint_rounding_scales(self, x):
        products = 2.0 * jnp.abs(x) @ jnp.abs(x).swapaxes(-1, -2)
        upper = [products[..., *np.triu_indices(self.n, k)] for k in (0, 1)]
        return jnp.concatenate([*upper, jnp.full((*x.shape[:-2], 1), float(self.n))], axis=-1)


@register((2,), (3, 0.5))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SpecialEuclidean(GroupSpace):
    """Rigid motions of R^n, with ``inner = tr(W^T W') / 2 + u·u' / length^2`` of velocities W of rotation and u.

    The metric is left-invariant and that of the product of SO(n) and R^n: along geodesics the body turns at a constant
    rate while its origin moves straight. One-parameter subgroups are different curves, screw motions: the group
    retraction follows them.

    Parameters
    ----------
    n : int
        Dimension of the space of the motions.
    length : float
        The translation that counts as much as a rotation by one radian.
    """

    n: int
    length: float = 1.0
    exp_is_group_exp = False

    def __post_init__(self):
        checked_size(self.n, 2, "SpecialEuclidean(n)")
        if not 0.0 < self.length < math.inf:
            raise ParameterError(f"SpecialEuclidean(n, length): length must be a positive number, got {self.length!r}")

    @property
    def group(self):
        return _se(self.n)

    @property
    def rotations(self) -> SpecialOrthogonal:
        """Space of the rotations of the motions."""
        return SpecialOrthogonal(self.n)

    def injectivity_radius(self, x=None):
        return math.pi

    def _project(self, x):
        return affine_matrix(_nearest_rotation(x[..., :-1, :-1]), x[..., :-1, -1:])

    @property
    def _n_gaussian_samples(self):
        return self.n * (self.n + 1)

    def _point_from_gaussian_samples(self, w):
        rotation_normals, translation_normals = jnp.split(w, [self.n**2], axis=-1)
        rotation = _random_rotation(rotation_normals.reshape(*w.shape[:-1], self.n, self.n))
        return affine_matrix(rotation, self.length * translation_normals[..., None])

    def _project_tangent(self, x, w):
        return self._map_rotation_and_translation(self.rotations._project_tangent, lambda x, w: w, x, w)

    _tangential_part = tangential_part_by_projection

    def _correction(self, x, constraint_change):
        rotation_change, last_row_change = jnp.split(constraint_change, [self.n * (self.n + 1) // 2], axis=-1)
        top = self.rotations._correction(x[..., :-1, :-1], rotation_change)
        return jnp.concatenate(
            [jnp.pad(top, [(0, 0)] * (top.ndim - 1) + [(0, 1)]), last_row_change[..., None, :]], axis=-2
        )

    def _constraint_rounding_scales(self, x):
        return jnp.concatenate(
            [self.rotations._constraint_rounding_scales(x[..., :-1, :-1]), jnp.abs(x[..., -1, :])], axis=-1
        )

    def _frame(self, x):
        scale = np.where(np.arange(self.dim) < self.rotations.dim, 1.0, self.length)
        return x[..., None, :, :] @ (scale[:, None, None] * self.group.algebra._require_basis())

    def _coordinates(self, x, v):
        return Space._coordinates(self, x, v)

    def _from_coordinates(self, x, c):
        return Space._from_coordinates(self, x, c)

    _inner = inner_by_flat

    def _metric_covector(self, x, v):
        return self._map_rotation_and_translation(
            self.rotations._metric_covector, lambda x, v: v / self.length**2, x, v
        )

    def _exp(self, x, v):
        y = self._map_rotation_and_translation(self.rotations._exp, lambda x, v: x + v, x, v)
        return affine_matrix(y[..., :-1, :-1], y[..., :-1, -1:])

    def _log(self, x, y):
        return self._map_rotation_and_translation(self.rotations._log, lambda x, y: y - x, x, y)

    def _squared_distance(self, x, y):
        displacement = (y[..., :-1, -1] - x[..., :-1, -1]) / self.length
        return self.rotations._squared_distance(x[..., :-1, :-1], y[..., :-1, :-1]) + (displacement**2).sum(axis=-1)

    def _transport(self, x, v, u):
        return self._map_rotation_and_translation(
            self.rotations._transport, lambda x, v, u: u + jnp.zeros_like(v), x, v, u
        )

    def _reach(self, x, v):
        return self.rotations._reach(x[..., :-1, :-1], v[..., :-1, :-1])

    def _map_rotation_and_translation(self, rotation_map, translation_map, *arrays):
        """Return ``[[R, t], [0, 0]]``: R by ``rotation_map``, t by ``translation_map``, of the blocks of the arrays."""
        rotation = rotation_map(*(a[..., :-1, :-1] for a in arrays))
        translation = translation_map(*(a[..., :-1, -1:] for a in arrays))
        batch = jnp.broadcast_shapes(rotation.shape[:-2], translation.shape[:-2])
        top = jnp.concatenate([jnp.broadcast_to(a, (*batch, *a.shape[-2:])) for a in (rotation, translation)], axis=-1)
        return jnp.concatenate([top, jnp.zeros_like(top[..., :1, :])], axis=-2)

    def _why_log_is_undefined(self, x, y):
        return self.rotations._why_log_is_undefined(x[:-1, :-1], y[:-1, :-1])


def _nearest_rotation(x):
    """Return the nearest rotation, NaN if a reflection is nearer."""
    x = polar(x)
    return jnp.where((determinant(x) > 0.0)[..., None, None], x, jnp.nan)


def _random_rotation(w):
    """Return the rotation made of Gaussian samples w; its distribution is Haar's, since that of w is rotation
    invariant."""
    x = orthonormal_columns(w)
    return x * jnp.where(np.arange(w.shape[-1]) == 0, determinant(x)[..., None, None], 1.0)
