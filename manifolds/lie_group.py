"""Matrix Lie groups: exponential, logarithm, Cayley map, adjoint and coadjoint action.

Conventions: an element of the group is a matrix, shape (..., m, m), an element of its algebra its components, shape
(..., dim), in the basis of the :mod:`manifolds.catalogue`; leading axes are batches. ``Ad_star(g, mu)`` is the
transpose of ``Ad(g)``, with no inverse, so that its derivative at the identity is ``ad_star``. Derivatives of paths are
left-trivialised: ``g' = g hat(x)``.

All maps can be jitted, vmapped and differentiated. Where a map is not defined they raise :class:`DomainError`; under
tracing, where values cannot be looked at, they return NaN instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from . import catalogue
from . import closed_forms as closed
from . import matrix_functions as general
from ._arrays import at, first, is_traced, real_components, square_matrices
from .errors import ComponentError, DomainError, LieAlgebraError
from .lie_algebra import LieAlgebra
from .symmetric import rotation_log

MEMBERSHIP_TOLERANCE = 1e-8
"""How far from the group, relative to its size, a matrix may lie for its logarithm to be taken."""

_LOG_NEEDS = (
    f"principal logarithm needs angles below pi - {closed.HALF_TURN_MARGIN:.0e}, since at pi there may be a continuum "
    "to choose from (not where one plane of SO(n), SE(2) or SE(3) is turned by pi)"
)

_registry: list[tuple[Callable[..., MatrixGroup], tuple]] = []


def register(*arguments: tuple):
    """Decorator: run the property suite on the constructor called with each of these argument tuples."""

    def remember(constructor):
        _registry.extend((constructor, a) for a in arguments)
        return constructor

    return remember


def registered_groups() -> Iterator[MatrixGroup]:
    """One instance after another of every registered group."""
    for constructor, arguments in _registry:
        yield constructor(*arguments)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class MatrixGroup:
    """A group of matrices: its algebra, a measure of distance from it, and the maps that have a special form.

    Build one with its name (``manifolds.SO(3)``). A new group needs its algebra, with matrices, and ``defect``; the
    rest defaults to general matrix functions.

    Attributes
    ----------
    name : str
    algebra : LieAlgebra
    defect : callable
        ``g -> array``, shape (...): how far g is from the group relative to its size, of the order of the smallest
        relative change of g that brings it there.
    inverse_map, exp_map, log_map, cayley_map, inverse_cayley_map : callable or None
        ``g -> g^-1``; ``(algebra, x) -> g``; ``(algebra, g) -> x`` with NaN outside the domain; ``(algebra, x) -> g``
        or None where the Cayley map leaves the group; ``(algebra, g) -> x`` with NaN outside the domain.
    restore_map : callable
        ``g -> g``: one Newton step to the group for a matrix that rounding has moved off it, where it has a formula.
    """

    name: str
    algebra: LieAlgebra
    defect: Callable
    inverse_map: Callable = general.inverse
    exp_map: Callable = general.exp
    log_map: Callable = general.log
    cayley_map: Callable | None = general.cayley
    inverse_cayley_map: Callable = general.inverse_cayley
    restore_map: Callable = closed.unchanged

    @property
    def dim(self) -> int:
        """Dimension of the group."""
        return self.algebra.dim

    @property
    def matrix_size(self) -> int:
        """Number m of rows of its matrices."""
        return self.algebra._known_basis().shape[-1]

    @property
    def identity(self) -> jax.Array:
        """The identity matrix, shape (m, m)."""
        return jnp.eye(self.matrix_size, dtype=self.algebra._known_basis().dtype)

    def compose(self, g, h) -> jax.Array:
        """Product ``g h`` of group elements, shape (..., m, m)."""
        return self._element(g, "g") @ self._element(h, "h")

    def inverse(self, g) -> jax.Array:
        """Inverse of a group element, by the group's own formula (a transpose for SO(n)), shape (..., m, m).

        Raises
        ------
        DomainError
            If g is singular. That g is in the group is taken for granted: see :meth:`belongs`.
        """
        g = self._element(g, "g")
        inverse = _compiled(self.inverse_map, g)
        if (index := _first_failure(inverse, 2)) is not None:
            raise DomainError(f"{self.name}: g{at(index)} has no inverse: it is singular or not finite")
        return inverse

    def belongs(self, g, tolerance: float = 1e-10) -> jax.Array:
        """Whether each matrix is in the group, up to a relative change of the matrix by about ``tolerance``.

        GL(n) is open: there the tolerance plays no part, and a matrix belongs if rounding cannot make it singular.

        Returns
        -------
        array of bool, shape (...)
        """
        return _compiled(self.defect, self._element(g, "g")) <= tolerance

    def random(self, key_or_seed, size: tuple[int, ...] = (), scale: float = 0.5) -> jax.Array:
        """Random elements ``exp(x)``, the components of x normal with standard deviation ``scale``; not Haar measure.

        Parameters
        ----------
        key_or_seed : JAX random key, or int
        size : tuple of int
            Shape of the batch.
        scale : float

        Returns
        -------
        array, shape ``(*size, m, m)``
        """
        key = jax.random.key(key_or_seed) if isinstance(key_or_seed, int | np.integer) else key_or_seed
        return self.exp(scale * jax.random.normal(key, (*size, self.dim)))

    def exp(self, x) -> jax.Array:
        """Exponential map, from components of the algebra, shape (..., dim), to the group, shape (..., m, m)."""
        return _compiled(self.exp_map, self.algebra, self._components(x, "x"))

    def log(self, g) -> jax.Array:
        """Principal logarithm: the x with ``exp(x) = g`` and eigenvalues of ``hat(x)`` at heights below pi.

        Parameters
        ----------
        g : array, shape (..., m, m)
            Within 1e-8 of the group, and with every eigenvalue at an angle below pi - 1e-8 from the positive axis. In
            SO(n), SE(2) and SE(3) one plane may be turned by pi.

        Returns
        -------
        array, shape (..., dim)
            Accurate to rounding; where the logarithm itself is ill-conditioned, as for a pair of eigenvalues at the
            angles +-(pi - d) in a noncompact group, to about 1e-15/d. Its derivative is that of x along the group:
            changes of g that leave the group are projected out. Of the two logarithms of a half turn, pi times an axis
            and its negative, the one is returned whose first component that is not zero (1e-8 of the axis) is positive.
            That holds up to 1e-8 from the half turn, where the angle may be larger than pi by as much. More than one
            plane turned by pi, and -I in SU(2), have a continuum of logarithms with nothing to choose one by.

        Raises
        ------
        DomainError
            If g is not in the group, or has no principal logarithm. Under tracing the result is NaN instead.
        """
        g = self._element(g, "g")
        x = _log(self, g)
        if (index := _first_failure(x, 1)) is not None:
            raise DomainError(f"log on {self.name}: g{at(index)} {self._why_not_in_domain(np.asarray(g[index]))}")
        return x

    def cayley(self, x) -> jax.Array:
        """Cayley map ``(I - X/2)^-1 (I + X/2)``, X = hat(x): agrees with ``exp`` to second order.

        Parameters
        ----------
        x : array, shape (..., dim)

        Returns
        -------
        array, shape (..., m, m)

        Raises
        ------
        LieAlgebraError
            For SL(n) and SU(n) with n > 2, where the determinant of the result is not 1.
        DomainError
            If X has an eigenvalue 2, or for GL(n) also -2. Under tracing the result is NaN instead.
        """
        self._need_cayley()
        x = self._components(x, "x")
        g = _cayley(self, x)
        if (index := _first_failure(g, 2)) is not None:
            raise DomainError(f"cayley on {self.name}: x{at(index)} {self._why_no_cayley(np.asarray(x[index]))}")
        return g

    def inverse_cayley(self, g) -> jax.Array:
        """Inverse of the Cayley map, ``2 (g + I)^-1 (g - I)``, shape (..., dim).

        Raises
        ------
        LieAlgebraError
            For SL(n) and SU(n) with n > 2, as for :meth:`cayley`.
        DomainError
            If g is not in the group or has the eigenvalue -1. Under tracing the result is NaN instead.
        """
        self._need_cayley()
        g = self._element(g, "g")
        x = _inverse_cayley(self, g)
        if (index := _first_failure(x, 1)) is not None:
            why = self._why_not_in_domain(np.asarray(g[index]), "inverse Cayley map needs no eigenvalue -1", "map")
            raise DomainError(f"inverse_cayley on {self.name}: g{at(index)} {why}")
        return x

    def Ad(self, g) -> jax.Array:
        """Adjoint action, the matrix of ``x -> vee(g hat(x) g^-1)``, shape (..., dim, dim).

        Raises
        ------
        DomainError
            If g is not in the group (not checked under tracing).
        """
        g = self._element(g, "g")
        if not is_traced(g):
            with jax.ensure_compile_time_eval():  # g may be a constant in a program being traced
                outside = ~np.asarray(self.belongs(g, MEMBERSHIP_TOLERANCE))
                if (index := first(outside)) is not None:
                    raise DomainError(
                        f"Ad on {self.name}: g{at(index)} {self._why_not_in_domain(np.asarray(g[index]))}"
                    )
        return _adjoint_action(self, g)

    def Ad_star(self, g, mu) -> jax.Array:
        """Coadjoint action, defined by ``<Ad_star(g, mu), x> = <mu, Ad(g) x>``.

        A right action: ``Ad_star(g h, mu) = Ad_star(h, Ad_star(g, mu))``. Its derivative along ``g = exp(t x)`` at
        t = 0 is ``ad_star(x, mu)``; the spatial momentum of a body is ``Ad_star(inverse(g), mu)``.

        Parameters
        ----------
        g : array, shape (..., m, m)
        mu : array, shape (..., dim)

        Returns
        -------
        array, shape (..., dim)
        """
        return jnp.einsum("...ab,...a->...b", self.Ad(g), self._components(mu, "mu"))

    def __repr__(self) -> str:
        return f"MatrixGroup({self.name!r}, dim={self.dim})"

    def _components(self, x, what: str) -> jax.Array:
        return real_components(x, self.dim, what)

    def _element(self, g, what: str) -> jax.Array:
        matrix = square_matrices(g, self.matrix_size, what)
        if jnp.iscomplexobj(matrix) and not np.iscomplexobj(self.algebra._known_basis()):
            raise ComponentError(
                f"{what} must be real for {self.name}, not {matrix.dtype}: take its real part if that is meant"
            )
        return matrix.astype(self.algebra._known_basis().dtype)

    def _why_not_in_domain(self, g: np.ndarray, needs: str = _LOG_NEEDS, image: str = "logarithm") -> str:
        if not np.isfinite(g).all():
            return "has entries that are not finite"
        defect = float(self.defect(g))
        if not defect <= MEMBERSHIP_TOLERANCE:
            return (
                f"is not in the group: relative distance {defect:.3g}, tolerance {MEMBERSHIP_TOLERANCE:.0e}; bring "
                "it back to the group first"
            )
        eigenvalues = np.linalg.eigvals(g)
        worst = eigenvalues[np.abs(np.angle(eigenvalues)).argmax()]
        return (
            f"has the eigenvalue {worst:.6g} at the angle {abs(np.angle(worst)):.10f}, and det g = "
            f"{np.linalg.det(g):.3g}; the {needs}: take the {image} of g relative to a nearer element h, that is of "
            "compose(inverse(h), g)"
        )

    def _need_cayley(self) -> None:
        if self.cayley_map is None:
            raise LieAlgebraError(
                f"the Cayley map does not take {self.algebra.name} into {self.name}: det (I - X/2)^-1 (I + X/2) is "
                "not 1 when X^3 has a trace; use exp"
            )

    def _why_no_cayley(self, x: np.ndarray) -> str:
        if not np.isfinite(x).all():
            return "has entries that are not finite"
        eigenvalues = np.linalg.eigvals(self.algebra.hat(x))
        nearest = eigenvalues[np.abs(eigenvalues**2 - 4).argmin()]
        return (
            f"has the eigenvalue {nearest:.10g}, and at 2 and -2 the Cayley map is singular (limit on the condition "
            f"number {general.CAYLEY_CONDITION_LIMIT:.0e}); shorten x or use exp"
        )


# -- the groups -----------------------------------------------------------------------------------------------------


@register((2,), (3,), (4,))
def SO(n: int) -> MatrixGroup:
    """Rotations of R^n: ``g^T g = I``, ``det g = 1``."""
    group = MatrixGroup(
        f"SO({n})",
        catalogue.so(n),
        closed.unitary_defect,
        closed.unitary_inverse,
        log_map=rotation_log,
        restore_map=general.orthonormalized,
    )
    if n == 2:
        return replace(group, exp_map=closed.so2_exp, log_map=closed.so2_log)
    if n == 3:
        group = replace(group, exp_map=closed.so3_exp, log_map=closed.so3_log)
        return replace(group, cayley_map=closed.so3_cayley, inverse_cayley_map=closed.so3_inverse_cayley)
    return group


@register((2,), (3,))
def SE(n: int) -> MatrixGroup:
    """Rigid motions of R^n, as homogeneous matrices ``[[rotation, translation], [0, 1]]``."""
    group = MatrixGroup(
        f"SE({n})", catalogue.se(n), closed.rigid_defect, closed.rigid_inverse, restore_map=closed.rigid_restored
    )
    if n == 2:
        return replace(group, log_map=closed.rigid_log)
    if n == 3:
        group = replace(group, exp_map=closed.se3_exp, log_map=closed.rigid_log)
        return replace(group, cayley_map=closed.se3_cayley, inverse_cayley_map=closed.se3_inverse_cayley)
    return group


@register((2,), (3,))
def SU(n: int) -> MatrixGroup:
    """Unitary complex matrices of determinant 1."""
    group = MatrixGroup(
        f"SU({n})",
        catalogue.su(n),
        closed.unitary_defect,
        closed.unitary_inverse,
        restore_map=closed.unitary_restored,
    )
    if n == 2:
        group = replace(group, exp_map=closed.su2_exp, log_map=closed.su2_log)
        return replace(group, inverse_cayley_map=closed.su2_inverse_cayley)
    return replace(group, cayley_map=None)


@register((2,), (3,))
def SL(n: int) -> MatrixGroup:
    """Real matrices of determinant 1. The Cayley map exists for n = 2 only, where SL(2) = Sp(1)."""
    group = MatrixGroup(f"SL({n})", catalogue.sl(n), closed.unimodular_defect)
    return group if n == 2 else replace(group, cayley_map=None)


@register((2,))
def Sp(n: int) -> MatrixGroup:
    """Sp(2n, R): ``g^T J g = J`` with ``J = [[0, I], [-I, 0]]``."""
    return MatrixGroup(f"Sp({n})", catalogue.sp(n), closed.symplectic_defect, closed.symplectic_inverse)


@register((2,))
def GL(n: int) -> MatrixGroup:
    """Invertible real matrices; ``exp`` and ``log`` concern the component GL+ of positive determinant."""
    return MatrixGroup(f"GL({n})", catalogue.gl(n), closed.invertible_defect)


@register((1,), (2,))
def Heisenberg(n: int = 1) -> MatrixGroup:
    """Upper triangular matrices ``[[1, q, z], [0, I, p], [0, 0, 1]]``. Here the Cayley map is the exponential."""
    return MatrixGroup(
        f"Heisenberg({n})",
        catalogue.heisenberg(n),
        closed.heisenberg_defect,
        closed.heisenberg_inverse,
        closed.heisenberg_exp,
        closed.heisenberg_log,
        closed.heisenberg_exp,
        closed.heisenberg_log,
    )


# -- compiled maps --------------------------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=0)
def _compiled(function: Callable, *arguments):
    return function(*arguments)


@partial(jax.jit, static_argnums=0)
def _adjoint_action(group: MatrixGroup, g):
    g = g[..., None, :, :]
    images = g @ group.algebra._known_basis() @ group.inverse_map(g)
    return group.algebra.vee(images).swapaxes(-1, -2)


@partial(jax.jit, static_argnums=0)
def _cayley(group: MatrixGroup, x):
    assert group.cayley_map is not None
    g = group.cayley_map(group.algebra, x)
    return jnp.where((group.defect(g) <= MEMBERSHIP_TOLERANCE)[..., None, None], g, jnp.nan)


@partial(jax.jit, static_argnums=0)
def _inverse_cayley(group: MatrixGroup, g):
    x = group.inverse_cayley_map(group.algebra, g)
    return jnp.where((group.defect(g) <= MEMBERSHIP_TOLERANCE)[..., None], x, jnp.nan)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _principal_log(group: MatrixGroup, g):
    member = group.defect(g) <= MEMBERSHIP_TOLERANCE
    return jnp.where(member[..., None], group.log_map(group.algebra, g), jnp.nan)


@_principal_log.defjvp
def _log_derivative(group: MatrixGroup, primals, tangents):
    """From ``exp(x) = g``: ``dexp(x) x' = vee(g^-1 g')``."""
    (g,), (dg,) = primals, tangents
    x = _principal_log(group, g)
    velocity = group.algebra.vee(group.inverse_map(g) @ dg)
    return x, general.solve(general.dexp(group.algebra, x), velocity[..., None])[..., 0]


_log = jax.jit(_principal_log, static_argnums=0)


def _first_failure(result, core: int) -> tuple[int, ...] | None:
    """Batch index of the first result that is not finite, its last ``core`` axes one element; None while tracing."""
    if is_traced(result):
        return None
    return first(~np.isfinite(np.asarray(result)).all(axis=tuple(range(-core, 0))))
