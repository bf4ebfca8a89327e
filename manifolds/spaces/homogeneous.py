"""Homogeneous spaces G/H of compact groups: points are elements of the group."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from .._pytree_module import forward_to
from ..errors import ParameterError, SpaceError
from ..groups.matrix_group import MatrixGroup
from ..groups.subgroups import factor_element, subalgebra_basis
from ..matrices.exponential import expm
from .base import CUT_MARGIN, Space
from .groups import BiInvariantSpace, SpecialOrthogonal, SpecialUnitary
from .maps import inner_by_coordinates


@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class Homogeneous(Space):
    """The space G/H of a group SO(n) or SU(n) and a subgroup H, with the metric that G gives it.

    A point is any element g of its class gH; functions are those of g that H leaves alone. A tangent vector is
    horizontal: ``g hat(xi)`` with xi orthogonal to the algebra of H, and as long as xi. So a system moves upstairs in
    G, along horizontal fields. Geodesics are ``g exp(t xi)``, and parallel transport along one solves
    ``eta' = -[xi, eta]_m / 2``, m being the horizontal part [O'Neill 1966; Milnor 1976]. The logarithm is found by
    Newton's method, and accepted below the distance at which geodesics can have conjugate points; where H winds around
    in G, as in lens spaces, there may be a shorter one.

    Parameters
    ----------
    group : MatrixGroup or space
        SO(n) or SU(n).
    stabilizer : array, shape (k, n, n)
        Matrices that span the algebra of H, which is connected.
    name : str, optional

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
        upstairs = _group_space_of(group)
        rows = subalgebra_basis(upstairs.group, stabilizer)
        rest = np.linalg.svd(rows, full_matrices=True)[2][len(rows) :] if len(rows) else np.eye(upstairs.dim)
        if not len(rest):
            raise ParameterError(f"{upstairs.name}: the stabilizer is the whole group, and leaves a single point")
        chosen = f"{upstairs.name}/H" if name is None else name
        values = {
            "group_space": upstairs,
            "horizontal_basis": tuple(map(tuple, rest.tolist())),
            "name": chosen,
        }
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def dim(self):
        return len(self.horizontal_basis)

    shape = forward_to("group_space")
    dtype = forward_to("group_space")

    def injectivity_radius(self, x=None):
        """Curvatures are at most ``|[X, Y]|^2`` for unit X, Y [Bloch & Iserles 2005]: 2 in SO(n) with n > 3, else 1."""
        steep = isinstance(self.group_space, SpecialOrthogonal) and self.group_space.n > 3
        return math.pi / math.sqrt(2.0) if steep else math.pi

    @cached_property
    def _m(self) -> np.ndarray:
        """The horizontal part of the algebra: orthonormal components, shape (dim, dim of the group)."""
        return np.array(self.horizontal_basis)

    @cached_property
    def _h(self) -> np.ndarray:
        """That of H."""
        return np.linalg.svd(self._m, full_matrices=True)[2][self.dim :]

    # -- points: those of the group -----------------------------------------------------------------------------------

    _residual = forward_to("group_space")
    _project = forward_to("group_space")
    _constraints = forward_to("group_space")
    _correction = forward_to("group_space")
    _tangential_part = forward_to("group_space")
    _constraint_scales = forward_to("group_space")
    _inside = forward_to("group_space")
    _n_normals = forward_to("group_space")
    _point_from_normals = forward_to("group_space")

    # -- horizontal vectors -------------------------------------------------------------------------------------------

    def _project_tangent(self, x, w):
        return self._from_coordinates(x, self._coordinates(x, w))

    def _coordinates(self, x, v):
        return self.group_space._velocity(x, v) @ self._m.T

    def _from_coordinates(self, x, c):
        return self.group_space._from_velocity(x, c @ self._m)

    def _frame(self, x):
        return x[..., None, :, :] @ np.einsum("da,aij->dij", self._m, self.group_space.group.algebra._require_basis())

    _inner = inner_by_coordinates

    def _flat(self, x, v):
        return self.group_space._flat(x, self._project_tangent(x, v))

    _exp = forward_to("group_space")

    def _transport(self, x, v, u):
        brackets = self._m @ self.group_space.group.algebra.ad(self.group_space._velocity(x, v)) @ self._m.T
        c = expm(-0.5 * brackets) @ self._coordinates(x, u)[..., None]
        return self._from_coordinates(self._exp(x, v), c[..., 0])

    def _log(self, x, y):
        pair = "(n,n),(n,n)->(d)"
        return self._from_coordinates(x, jnp.vectorize(self._single_log, signature=pair)(x, y))

    def _single_log(self, x, y):
        """The horizontal c, with b in H, for which ``exp(c) exp(b)`` is the way from x to y."""
        reach = self.injectivity_radius() * (1.0 - CUT_MARGIN)
        return factor_element(self.group_space.group, self._m, self._h, self.group_space._relative_element(x, y), reach)


def _group_space_of(group) -> BiInvariantSpace:
    if isinstance(group, BiInvariantSpace):
        return group
    if isinstance(group, MatrixGroup):
        for kind, name in ((SpecialOrthogonal, "SO"), (SpecialUnitary, "SU")):
            if group.name == f"{name}({group.matrix_size})":
                return kind(group.matrix_size)
    given = getattr(group, "name", type(group).__name__)
    raise SpaceError(f"Homogeneous(group, stabilizer): the group is SO(n) or SU(n), not {given}")
