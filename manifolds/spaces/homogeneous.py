"""Homogeneous spaces G/H of compact groups, with elements of G as points, and flags: nested subspaces of R^n."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from .._pytree_module import forward_to
from ..errors import ParameterError, SpaceError
from ..groups.catalogue import horizontal_factor_coordinates, orthonormal_subalgebra_basis
from ..groups.matrix_group import MatrixGroup
from ..matrices.exponential import expm
from .base import CUT_MARGIN, Space, register
from .groups import BiInvariantSpace, SpecialOrthogonal, SpecialUnitary
from .maps import inner_by_coordinates


@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class Homogeneous(Space):
    """Space G/H of a group SO(n) or SU(n) and a subgroup H, with the metric that it inherits from G.

    A point is any element g of its class gH; functions must be invariant under ``g -> g h``, h in H. A tangent vector
    is horizontal: ``g hat(xi)`` with xi orthogonal to the algebra of H; its length is that of xi. A system therefore
    moves in G, along horizontal fields. Geodesics are ``g exp(t xi)``, and parallel transport along one solves ``eta' =
    -[xi, eta]_m / 2``, m being the horizontal part [O'Neill 1966; Milnor 1976]. Newton's method computes the logarithm,
    which is accepted below the distance at which geodesics can have conjugate points; where H winds around in G, as in
    lens spaces, there may be a shorter one.

    Parameters
    ----------
    group : MatrixGroup or space
        SO(n) or SU(n).
    stabilizer : array, shape (k, n, n)
        Matrices that span the algebra of H, which is connected.
    name : str, optional
        The name in messages.

    Raises
    ------
    SpaceError
        If the group is another one.
    ParameterError
        If the matrices are dependent, not in the algebra of the group, or do not span a subalgebra.
    """

    group_space: BiInvariantSpace
    horizontal_basis: tuple[tuple[float, ...], ...]
    name: str = "G/H"
    metric = "normal"
    has_iterative_log = True
    is_quotient = True

    def __init__(self, group, stabilizer, name: str | None = None):
        group_space = _group_space_of(group)
        rows = orthonormal_subalgebra_basis(group_space.group, stabilizer)
        horizontal_rows = (
            np.linalg.svd(rows, full_matrices=True)[2][len(rows) :] if len(rows) else np.eye(group_space.dim)
        )
        if not len(horizontal_rows):
            raise ParameterError(
                f"{group_space.name}: the stabilizer must not be the full group, whose quotient is a single point"
            )
        full_name = f"{group_space.name}/H" if name is None else name
        values = {
            "group_space": group_space,
            "horizontal_basis": tuple(map(tuple, horizontal_rows.tolist())),
            "name": full_name,
        }
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def dim(self):
        return len(self.horizontal_basis)

    shape = forward_to("group_space")
    dtype = forward_to("group_space")

    def injectivity_radius(self, x=None):
        """Return a lower bound of the radius, pi over the root of the largest sectional curvature.

        Curvatures are at most ``|[X, Y]|^2`` for unit X, Y [Bloch & Iserles 2005]: 2 in SO(n) with n > 3, else 1.
        """
        has_curvature_two = isinstance(self.group_space, SpecialOrthogonal) and self.group_space.n > 3
        return math.pi / math.sqrt(2.0) if has_curvature_two else math.pi

    @cached_property
    def _horizontal_rows(self) -> np.ndarray:
        """Orthonormal basis of the horizontal part of the algebra, in components, shape (dim, dim of the group)."""
        return np.array(self.horizontal_basis)

    @cached_property
    def _stabilizer_rows(self) -> np.ndarray:
        """Orthonormal basis of the algebra of H, in components, shape (dim of H, dim of the group)."""
        return np.linalg.svd(self._horizontal_rows, full_matrices=True)[2][self.dim :]

    # -- points of the group ------------------------------------------------------------------------------------------

    _residual = forward_to("group_space")
    _project = forward_to("group_space")
    _constraints = forward_to("group_space")
    _correction = forward_to("group_space")
    _tangential_part = forward_to("group_space")
    _constraint_rounding_scales = forward_to("group_space")
    _inside = forward_to("group_space")
    _n_gaussian_samples = forward_to("group_space")
    _point_from_gaussian_samples = forward_to("group_space")

    # -- horizontal vectors -------------------------------------------------------------------------------------------

    def _project_tangent(self, x, w):
        return self._from_coordinates(x, self._coordinates(x, w))

    def _coordinates(self, x, v):
        return self.group_space._velocity(x, v) @ self._horizontal_rows.T

    def _from_coordinates(self, x, c):
        return self.group_space._from_velocity(x, c @ self._horizontal_rows)

    def _frame(self, x):
        return x[..., None, :, :] @ np.einsum(
            "da,aij->dij", self._horizontal_rows, self.group_space.group.algebra._require_basis()
        )

    _inner = inner_by_coordinates

    def _metric_covector(self, x, v):
        return self.group_space._metric_covector(x, self._project_tangent(x, v))

    _exp = forward_to("group_space")

    def _transport(self, x, v, u):
        brackets = (
            self._horizontal_rows
            @ self.group_space.group.algebra.ad(self.group_space._velocity(x, v))
            @ self._horizontal_rows.T
        )
        c = expm(-0.5 * brackets) @ self._coordinates(x, u)[..., None]
        return self._from_coordinates(self._exp(x, v), c[..., 0])

    def _log(self, x, y):
        pair = "(n,n),(n,n)->(d)"
        return self._from_coordinates(x, jnp.vectorize(self._single_log_coordinates, signature=pair)(x, y))

    def _single_log_coordinates(self, x, y):
        """Return the horizontal c with ``exp(c) exp(b) = x^-1 y`` for some b in the algebra of H."""
        reach = self.injectivity_radius() * (1.0 - CUT_MARGIN)
        return horizontal_factor_coordinates(
            self.group_space.group,
            self._horizontal_rows,
            self._stabilizer_rows,
            self.group_space._relative_element(x, y),
            reach,
        )


def _group_space_of(group) -> BiInvariantSpace:
    """Return SO(n) or SU(n) as a space, from the space or the matrix group; raise SpaceError for other groups."""
    if isinstance(group, BiInvariantSpace):
        return group
    if isinstance(group, MatrixGroup):
        for space_class, name in ((SpecialOrthogonal, "SO"), (SpecialUnitary, "SU")):
            if group.name == f"{name}({group.matrix_size})":
                return space_class(group.matrix_size)
    group_name = getattr(group, "name", type(group).__name__)
    raise SpaceError(f"Homogeneous(group, stabilizer): group must be SO(n) or SU(n), got {group_name}")


@register((1, 1, 2))
@jax.tree_util.register_static
class Flag(Homogeneous):
    """Flags ``V_1 < V_2 < ... < R^n``: each subspace has ``steps[i]`` dimensions more than the one before.

    ``Flag(1, 1, 2)`` has a line in a plane in R^4. A point is a rotation x whose first columns span V_1, the next ones
    complete them to a basis of V_2, and so on; each piece is oriented. Two pieces are a Grassmann manifold, at
    ``1 / sqrt(2)`` of its distances.

    Parameters
    ----------
    steps : int
        The dimensions of the pieces, two or more.
    """

    def __init__(self, *steps: int):
        if len(steps) < 2:
            raise ParameterError(f"Flag(*steps) needs at least two steps, as in Flag(1, 2), got {len(steps)}")
        sizes = [checked_size(step, 1, "Flag(*steps)", "a step") for step in steps]
        n, start, rotations = sum(sizes), 0, []
        for size in sizes:
            for i in range(start, start + size):
                for j in range(i + 1, start + size):
                    rotation = np.zeros((n, n))
                    rotation[i, j], rotation[j, i] = -1.0, 1.0
                    rotations.append(rotation)
            start += size
        super().__init__(SpecialOrthogonal(n), np.reshape(rotations, (-1, n, n)), f"Fl({', '.join(map(str, sizes))})")
        object.__setattr__(self, "steps", tuple(sizes))

    steps: tuple[int, ...]

    def projectors(self, x) -> jax.Array:
        """Return the orthogonal projectors onto the pieces, shape (..., pieces, n, n), of which functions of flags are
        made.

        Parameters
        ----------
        x : array, shape (..., n, n)
        """
        frames = jnp.split(self._ambient_array(x, "x"), np.cumsum(self.steps)[:-1], axis=-1)
        return jnp.stack([frame @ frame.swapaxes(-1, -2) for frame in frames], axis=-3)
