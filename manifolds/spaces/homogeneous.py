"""Homogeneous spaces G/H of compact groups, and flags among them: points are elements of the group."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import as_numeric
from .._module import forwarded
from .._sizes import checked_size
from ..errors import ParameterError, SpaceError
from ..groups.matrix_group import MatrixGroup
from ..matrices.exponential import expm
from ..matrices.linear import solve
from .base import CUT_MARGIN, Space, register
from .groups import BiInvariantSpace, SpecialOrthogonal, SpecialUnitary

CLOSED = 1e-10
"""What of a bracket of unit vectors may be off the stabilizer."""

_MOST_STEPS = 30
"""Iterations of Newton's method for the logarithm."""


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

    upstairs: BiInvariantSpace
    horizontal: tuple[tuple[float, ...], ...]
    name: str = "G/H"
    metric = "normal"

    def __init__(self, group, stabilizer, name: str | None = None):
        upstairs = _space_of(group)
        rows = _orthonormal(upstairs, stabilizer)
        rest = np.linalg.svd(rows, full_matrices=True)[2][len(rows) :] if len(rows) else np.eye(upstairs.dim)
        if not len(rest):
            raise ParameterError(f"{upstairs.name}: the stabilizer is the whole group, and leaves a single point")
        chosen = f"{upstairs.name}/H" if name is None else name
        values = {"upstairs": upstairs, "horizontal": tuple(map(tuple, rest.tolist())), "name": chosen}
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def dim(self):
        return len(self.horizontal)

    shape = forwarded("upstairs")
    dtype = forwarded("upstairs")

    def injectivity_radius(self, x=None):
        """Curvatures are at most ``|[X, Y]|^2`` for unit X, Y [Bloch & Iserles 2005]: 2 in SO(n) with n > 3, else 1."""
        steep = isinstance(self.upstairs, SpecialOrthogonal) and self.upstairs.n > 3
        return math.pi / math.sqrt(2.0) if steep else math.pi

    @cached_property
    def _m(self) -> np.ndarray:
        """The horizontal part of the algebra: orthonormal components, shape (dim, dim of the group)."""
        return np.array(self.horizontal)

    @cached_property
    def _h(self) -> np.ndarray:
        """That of H."""
        return np.linalg.svd(self._m, full_matrices=True)[2][self.dim :]

    # -- points: those of the group -----------------------------------------------------------------------------------

    _residual = forwarded("upstairs")
    _project = forwarded("upstairs")
    _constraints = forwarded("upstairs")
    _correction = forwarded("upstairs")
    _along = forwarded("upstairs")
    _rounded = forwarded("upstairs")
    _inside = forwarded("upstairs")
    _normals = forwarded("upstairs")
    _from_normals = forwarded("upstairs")

    # -- horizontal vectors -------------------------------------------------------------------------------------------

    def _project_tangent(self, x, w):
        return self._from_coordinates(x, self._coordinates(x, w))

    def _coordinates(self, x, v):
        return self.upstairs._velocity(x, v) @ self._m.T

    def _from_coordinates(self, x, c):
        return self.upstairs._from_velocity(x, c @ self._m)

    def _frame(self, x):
        return x[..., None, :, :] @ np.einsum("da,aij->dij", self._m, self.upstairs.group.algebra._known_basis())

    def _inner(self, x, u, v):
        return (self._coordinates(x, u) * self._coordinates(x, v)).sum(axis=-1)

    def _flat(self, x, v):
        return self.upstairs._flat(x, self._project_tangent(x, v))

    _exp = forwarded("upstairs")

    def _transport(self, x, v, u):
        brackets = self._m @ self.upstairs.group.algebra.ad(self.upstairs._velocity(x, v)) @ self._m.T
        c = expm(-0.5 * brackets) @ self._coordinates(x, u)[..., None]
        return self._from_coordinates(self._exp(x, v), c[..., 0])

    def _log(self, x, y):
        pair = "(n,n),(n,n)->(d)"
        return self._from_coordinates(x, jnp.vectorize(self._log_of_one, signature=pair)(x, y))

    def _log_of_one(self, x, y):
        """The horizontal c, with b in H, for which ``exp(c) exp(b)`` is the way from x to y."""
        group, d = self.upstairs.group, self.dim
        way = self.upstairs._relative(x, y)

        def gap(z, way):
            factors = [group.exp_map(group.algebra, part) for part in (z[:d] @ self._m, z[d:] @ self._h)]
            return factors[0] @ factors[1] - way

        def balance(z, way):
            """The gap as a vector of the algebra, which vanishes where the gap does."""
            ends = [group.exp_map(group.algebra, part) for part in (z[:d] @ self._m, z[d:] @ self._h)]
            return group.algebra.vee(group.inverse_map(ends[0] @ ends[1]) @ gap(z, way))

        def step(state):
            z, _, steps = state
            J, f = jax.jacfwd(lambda z: (flat(gap(z, way)),) * 2, has_aux=True)(z)
            direction = solve(J.T @ J, -(J.T @ f)[:, None])[:, 0]
            lengths = 0.5 ** np.arange(8.0)
            sizes = jax.vmap(lambda t: (flat(gap(z + t * direction, way)) ** 2).sum())(lengths)
            move = jnp.asarray(lengths)[jnp.nanargmin(sizes)] * direction
            return z + move, jnp.abs(move).max(), steps + 1

        def flat(a):
            return jnp.concatenate([a.real.ravel(), a.imag.ravel()])

        def newton(_, start):
            unfinished = lambda state: (state[1] > 1e-8) & (state[2] < _MOST_STEPS)  # noqa: E731
            z, change, _ = jax.lax.while_loop(unfinished, step, (start, jnp.inf, 0))
            inside = (z[:d] ** 2).sum() < (self.injectivity_radius() * (1.0 - CUT_MARGIN)) ** 2
            found = (change <= 1e-8) & (jnp.abs(gap(z, way)).max() <= 1e-10)
            return jnp.where(inside & found, z, jnp.nan)

        velocity = group.algebra.vee(way - group.inverse_map(way)) / 2.0
        start = jax.lax.stop_gradient(jnp.concatenate([self._m @ velocity, self._h @ velocity]))
        z = jax.lax.custom_root(  # for the derivatives, by the implicit function theorem
            lambda z: balance(z, way),
            start,
            newton,
            lambda linear, b: solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b[:, None])[:, 0],
        )
        return z[:d]

    def _why_no_log(self, x, y):
        return (
            f"no geodesic shorter than {self.injectivity_radius():.6g} from x to y was found, and a longer one might "
            "not be the shortest; go by a point between them"
        )


class Flag(Homogeneous):
    """Flags ``V_1 < V_2 < ... < R^n``: each subspace has so many dimensions more than the one before.

    ``Flag(1, 1, 2)`` has a line in a plane in R^4. A point is a rotation x whose first columns span V_1, the next ones
    what V_2 has beside it, and so on; each piece is oriented. Two pieces are a Grassmann manifold, at ``1 / sqrt(2)``
    of its distances.

    Parameters
    ----------
    steps : int
        The dimensions of the pieces, two or more.
    """

    def __init__(self, *steps: int):
        if len(steps) < 2:
            raise ParameterError(f"a flag has two pieces or more, such as Flag(1, 2), not {len(steps)}")
        sizes = [checked_size(step, 1, "Flag(*steps)", "a step") for step in steps]
        n, start, turns = sum(sizes), 0, []
        for size in sizes:
            for i in range(start, start + size):
                for j in range(i + 1, start + size):
                    turn = np.zeros((n, n))
                    turn[i, j], turn[j, i] = -1.0, 1.0
                    turns.append(turn)
            start += size
        super().__init__(SpecialOrthogonal(n), np.reshape(turns, (-1, n, n)), f"Fl({', '.join(map(str, sizes))})")
        object.__setattr__(self, "steps", tuple(sizes))

    steps: tuple[int, ...]

    def projectors(self, x) -> jax.Array:
        """The orthogonal projectors to the pieces, shape (..., pieces, n, n): what functions of flags are made of.

        Parameters
        ----------
        x : array, shape (..., n, n)
        """
        parts = jnp.split(self._array(x, "x"), np.cumsum(self.steps)[:-1], axis=-1)
        return jnp.stack([part @ part.swapaxes(-1, -2) for part in parts], axis=-3)


jax.tree_util.register_static(Flag)
register((1, 1, 2))(Flag)


def _space_of(group) -> BiInvariantSpace:
    if isinstance(group, BiInvariantSpace):
        return group
    if isinstance(group, MatrixGroup):
        for kind, name in ((SpecialOrthogonal, "SO"), (SpecialUnitary, "SU")):
            if group.name == f"{name}({group.matrix_size})":
                return kind(group.matrix_size)
    given = getattr(group, "name", type(group).__name__)
    raise SpaceError(f"Homogeneous(group, stabilizer): the group is SO(n) or SU(n), not {given}")


def _orthonormal(upstairs: BiInvariantSpace, stabilizer) -> np.ndarray:
    """Orthonormal components of what spans a subalgebra, shape (k, dim of the group)."""
    basis, matrices = upstairs.group.algebra._known_basis(), np.asarray(as_numeric(stabilizer, "stabilizer"))
    matrices = matrices.reshape(-1, *upstairs.shape) if matrices.size == 0 else matrices
    if matrices.shape[1:] != upstairs.shape:
        n = upstairs.shape[0]
        raise ParameterError(
            f"the stabilizer in {upstairs.name} is given by matrices, shape (k, {n}, {n}), not {matrices.shape}"
        )

    def components(a):
        return np.einsum("dij,...ij->...d", basis.conj(), a).real / (np.abs(basis[0]) ** 2).sum()

    def matrix(c):
        return np.einsum("...d,dij->...ij", c, basis)

    given = components(matrices)
    outside = np.abs(matrices - matrix(given)).max(axis=(1, 2), initial=0.0)
    if (outside > CLOSED).any():
        raise ParameterError(
            f"matrix {int(np.argmax(outside))} of the stabilizer is not in the algebra of {upstairs.name}: it is "
            f"{outside.max():.2g} off"
        )
    if len(given) and (rank := np.linalg.matrix_rank(given)) < len(given):
        raise ParameterError(
            f"the {len(given)} matrices of the stabilizer in {upstairs.name} span {rank} dimensions only: leave one out"
        )
    rows = np.linalg.qr(given.T)[0].T
    for j, i in itertools.combinations(range(len(rows)), 2):
        a, b = matrix(rows[i]), matrix(rows[j])
        bracket = components(a @ b - b @ a)
        if (off := np.linalg.norm(bracket - rows.T @ (rows @ bracket))) > CLOSED:
            raise ParameterError(
                f"the stabilizer in {upstairs.name} is no subalgebra: the bracket of its directions {j} and {i} is "
                f"{off:.2g} off their span; add what is missing"
            )
    return rows
