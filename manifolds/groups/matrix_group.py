"""Matrix Lie groups: exponential, logarithm, Cayley map, adjoint and coadjoint action.

Conventions: an element of the group is a matrix, shape (..., m, m), an element of its algebra its components, shape
(..., dim), in the basis of the :mod:`manifolds.algebras.catalogue`; leading axes are batches. ``Ad_star(g, mu)`` is the
transpose of ``Ad(g)``, with no inverse, so that its derivative at the identity is ``ad_star``. Derivatives of paths are
left-trivialised: ``g' = g hat(x)``.

All maps can be jitted, vmapped and differentiated. Outside of their domain they raise :class:`DomainError`; under
tracing, where values are not available, they return NaN instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial, wraps

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import (
    first_nonfinite_index,
    first_true_multi_index,
    format_index,
    is_traced,
    real_components,
    square_matrices,
)
from .._class_members import ListedType
from .._index_check import check_indices
from ..algebras.lie_algebra import LieAlgebra
from ..errors import ComponentError, DomainError, IndexOutOfRangeError, LieAlgebraError
from ..matrices.exponential import CAYLEY_CONDITION_LIMIT, HALF_TURN_MARGIN, cayley_of
from ..matrices.linear import inverse, max_abs_entry, solve
from . import closed_forms as closed
from . import maps
from .maps import fields_from_equations, product_group_fields

MEMBERSHIP_TOLERANCE = 1e-8
"""Largest distance of a matrix from the group, relative to its size, at which its logarithm is taken."""

MAP_DEFECT_TOLERANCE = 1e-10
"""Largest distance from the group, relative to its size, of the values of a map that counts as staying in the group."""

_LOG_DOMAIN_TEXT = (
    f"principal logarithm needs angles below pi - {HALF_TURN_MARGIN:.0e}, since at pi there may be a continuum "
    "to choose from (not where one plane of SO(n), SE(2) or SE(3) is turned by pi)"
)

_registry: list[tuple[Callable[..., MatrixGroup], tuple]] = []
_catalogued_groups: set[MatrixGroup] = set()
"""Groups made by registered constructors; the property suite has tested their maps, so the maps are not tested
again."""


def register(*argument_tuples: tuple):
    """Decorate a constructor to register the group of each argument tuple; the property suite runs on these groups."""

    def add_to_registry(constructor):
        @wraps(constructor)
        def build_catalogued_group(*args, **kwargs):
            _catalogued_groups.add(group := constructor(*args, **kwargs))
            return group

        _registry.extend((build_catalogued_group, a) for a in argument_tuples)
        return build_catalogued_group

    return add_to_registry


def registered_groups() -> Iterator[MatrixGroup]:
    """Yield one instance of every registered group."""
    for constructor, args in _registry:
        yield constructor(*args)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class MatrixGroup(metaclass=ListedType):
    """Group of matrices: its algebra, a measure of distance from it, and maps with special formulas.

    Build one with its name (``manifolds.SO(3)``). A new group needs its algebra, with matrices, and ``defect``; the
    other maps default to general matrix functions. Before such a map is used, :meth:`map_defect` tests at random
    elements that it stays in the group.

    Attributes
    ----------
    name : str
        The name in messages.
    algebra : LieAlgebra
        Its Lie algebra.
    defect : callable
        ``g -> array``, shape (...): the distance of g from the group relative to its size, of the order of the smallest
        relative change of g that brings it there. A function of one matrix is applied to each matrix of a batch.
    inverse_map, exp_map, log_map, cayley_map, inverse_cayley_map : callable or None
        ``g -> g^-1``; ``(algebra, x) -> g``; ``(algebra, g) -> x`` with NaN outside the domain; ``(algebra, x) -> g``
        or None if the Cayley map leaves the group; ``(algebra, g) -> x`` with NaN outside the domain.
    adjoint_cayley_map : callable or None
        ``(algebra, x) -> g`` with ``Ad(g) = cay(ad x)``, or None if ``cay(ad x)`` is not an adjoint action.
    restore_map : callable
        ``g -> g``: one Newton step to the group for a matrix that rounding has moved off it; by default g itself.
    equations : callable or None
        ``g -> array``, shape (..., m): independent functions that vanish on the group, and are constant along every
        ``g exp(t X)`` for X in the algebra, wherever g is; None if there are none.
    """

    name: str
    algebra: LieAlgebra
    defect: Callable
    inverse_map: Callable = inverse
    exp_map: Callable = maps.exp
    log_map: Callable = maps.log
    cayley_map: Callable | None = maps.cayley
    inverse_cayley_map: Callable = maps.inverse_cayley
    adjoint_cayley_map: Callable | None = maps.adjoint_cayley
    restore_map: Callable = closed.return_unchanged
    equations: Callable | None = None

    def __post_init__(self) -> None:
        if getattr(self.defect, "__module__", "") != closed.__name__:  # those are known to take batches
            object.__setattr__(self, "defect", _batched_defect(self.defect, self.name, self.algebra._require_basis()))

    @classmethod
    def from_equations(cls, f: Callable, n: int, name: str = "G") -> MatrixGroup:
        """Return the group of real matrices that solve ``f(A) = 0`` near the identity.

        Its algebra is the kernel of the derivative of f at the identity. ParameterError or ClosureError if f does not
        vanish at the identity or its solutions nearby do not form a group.

        Parameters
        ----------
        f : callable
            Function of one matrix by jax.numpy, shape (n, n), to an array of any shape, or to a list of them. Equations
            may depend on each other.
        n : int
            The size of the matrices.
        name : str
            The name in messages.

        Examples
        --------
        >>> boost = jnp.diag(jnp.array([1.0, 1.0, -1.0]))
        >>> lorentz = mf.MatrixGroup.from_equations(
        ...     lambda A: A.T @ boost @ A - boost, 3, name="O(2,1)"
        ... )
        >>> print(lorentz.dim, lorentz.algebra.isomorphism_type())
        3 A3,8
        """
        return cls(**fields_from_equations(f, n, name))

    def __mul__(self, other: MatrixGroup) -> MatrixGroup:
        """Return the product of two groups, whose matrices are block diagonal; its algebra is the direct sum."""
        return MatrixGroup(**product_group_fields(self, other)) if isinstance(other, MatrixGroup) else NotImplemented

    @property
    def dim(self) -> int:
        """Dimension of the group."""
        return self.algebra.dim

    @property
    def matrix_size(self) -> int:
        """Number m of rows of the matrices."""
        return self.algebra._require_basis().shape[-1]

    @property
    def is_complex(self) -> bool:
        """True if the matrices have complex entries."""
        return jnp.iscomplexobj(self.algebra._require_basis())

    @property
    def identity(self) -> jax.Array:
        """Identity matrix, shape (m, m)."""
        return jnp.eye(self.matrix_size, dtype=self.algebra._require_basis().dtype)

    def compose(self, g, h) -> jax.Array:
        """Return the product ``g h`` of group elements, shape (..., m, m)."""
        return self._element(g, "g") @ self._element(h, "h")

    def inverse(self, g) -> jax.Array:
        """Return the inverse of a group element by the group's own formula (a transpose for SO(n)), shape (..., m, m).

        Raises
        ------
        DomainError
            If g is singular. Membership in the group is not checked: see :meth:`belongs`.
        """
        g = self._element(g, "g")
        inverse = _call_compiled(self.inverse_map, g)
        if (index := first_nonfinite_index(inverse, 2)) is not None:
            raise DomainError(f"{self.name}: g{format_index(index)} has no inverse: it is singular or not finite")
        return inverse

    def belongs(self, g, tolerance: float = 1e-10) -> jax.Array:
        """Return True for each matrix that is in the group, up to a relative change of the matrix by about
        ``tolerance``.

        GL(n) is open: there the tolerance plays no part, and a matrix belongs if rounding cannot make it singular.

        Returns
        -------
        array of bool, shape (...)
        """
        return _call_compiled(self.defect, self._element(g, "g")) <= tolerance

    def random(self, key_or_seed, size: tuple[int, ...] = (), scale: float = 0.5) -> jax.Array:
        """Return random elements ``exp(x)`` with normal components of x of standard deviation ``scale``; not Haar
        measure.

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
        """Return the exponential of components of the algebra, shape (..., dim), as a group element, shape (..., m,
        m)."""
        return _call_compiled(self.exp_map, self.algebra, self._components(x, "x"))

    def log(self, g) -> jax.Array:
        """Return the principal logarithm: the x with ``exp(x) = g`` and eigenvalues of ``hat(x)`` at heights below pi.

        Parameters
        ----------
        g : array, shape (..., m, m)
            Within 1e-8 of the group, and with every eigenvalue at an angle below pi - 1e-8 from the positive axis. In
            SO(n), SE(2) and SE(3) one plane may be turned by pi.

        Returns
        -------
        array, shape (..., dim)
            Accurate to rounding, but only to about 1e-15/d for a pair of eigenvalues at the angles +-(pi - d) in a
            noncompact group. Derivatives are those along the group. A half turn (within 1e-8) has two logarithms; the
            first nonzero component of the one returned is positive.

        Raises
        ------
        DomainError
            If g is not in the group, or has no single principal logarithm, such as -I in SU(2). Under tracing the
            result is NaN instead.
        """
        g = self._element(g, "g")
        x = _log(self, g)
        if (index := first_nonfinite_index(x, 1)) is not None:
            raise DomainError(
                f"log on {self.name}: g{format_index(index)} {self._why_not_in_domain(np.asarray(g[index]))}"
            )
        return x

    def cayley(self, x) -> jax.Array:
        """Return the Cayley map ``(I - X/2)^-1 (I + X/2)``, X = hat(x); it agrees with ``exp`` to second order.

        Parameters
        ----------
        x : array, shape (..., dim)

        Returns
        -------
        array, shape (..., m, m)

        Raises
        ------
        LieAlgebraError
            If the map leaves the group: for SL(n) and SU(n) with n > 2, where the determinant of the result is not 1.
        DomainError
            If X has an eigenvalue 2, or for GL(n) also -2. Under tracing the result is NaN instead.
        """
        self._require_map("cayley")
        x = self._components(x, "x")
        g = _cayley(self, x)
        if (index := first_nonfinite_index(g, 2)) is not None:
            x = np.asarray(x[index])
            reason = self._why_no_cayley(x, self.algebra.hat(x) if np.isfinite(x).all() else x)
            raise DomainError(f"cayley on {self.name}: x{format_index(index)} {reason}")
        return g

    def inverse_cayley(self, g) -> jax.Array:
        """Return the inverse of the Cayley map, ``2 (g + I)^-1 (g - I)``, shape (..., dim).

        Raises
        ------
        LieAlgebraError
            As for :meth:`cayley`.
        DomainError
            If g is not in the group or has the eigenvalue -1. Under tracing the result is NaN instead.
        """
        self._require_map("cayley")
        g = self._element(g, "g")
        x = _inverse_cayley(self, g)
        if (index := first_nonfinite_index(x, 1)) is not None:
            reason = self._why_not_in_domain(np.asarray(g[index]), "inverse Cayley map needs no eigenvalue -1", "map")
            raise DomainError(f"inverse_cayley on {self.name}: g{format_index(index)} {reason}")
        return x

    def adjoint_cayley(self, x) -> jax.Array:
        """Return the group element near ``exp(x)`` with ``Ad(g) = cay(ad(x))``, Cayley's map of ``ad x``.

        ``Ad_star(g, mu)`` is then the end of a step of the midpoint scheme, ``nu = mu + ad_star(x, (mu + nu) / 2)``.
        It is :meth:`cayley` for SO(3) and SE(2), and another map to third order for SU(2), SL(2), SE(3) and SO(4).

        Parameters
        ----------
        x : array, shape (..., dim)

        Returns
        -------
        array, shape (..., m, m)

        Raises
        ------
        LieAlgebraError
            If ``cay(ad(x))`` is not an adjoint action: for SO(n) with n > 4, SE(n) with n > 3, SU(n) and SL(n) with
            n > 2, Sp(n) with n > 1.
        DomainError
            If ad(x) has a real eigenvalue of size 2 or more. Under tracing the result is NaN instead.
        """
        self._require_map("adjoint_cayley")
        assert self.adjoint_cayley_map is not None
        x = self._components(x, "x")
        g = _call_compiled(self.adjoint_cayley_map, self.algebra, x)
        if (index := first_nonfinite_index(g, 2)) is not None:
            x = np.asarray(x[index])
            reason = self._why_no_cayley(x, self.algebra.ad(x))
            raise DomainError(f"adjoint_cayley on {self.name}: for ad(x), x{format_index(index)} {reason}")
        return g

    def map_defect(self, kind: str) -> float:
        """Return the largest distance from the group, :attr:`defect`, of the values of a map at random elements of the
        algebra.

        Parameters
        ----------
        kind : {"exp", "cayley", "adjoint_cayley"}
            For ``"adjoint_cayley"`` the distance of ``Ad(g)`` from ``cay(ad(x))``, relative to its size, counts too.

        Returns
        -------
        float
            Of the order of rounding for a map that stays in the group; infinite if a value is not finite.
        """
        return _map_defect(self, kind)

    def Ad(self, g) -> jax.Array:
        """Return the adjoint action, the matrix of ``x -> vee(g hat(x) g^-1)``, shape (..., dim, dim).

        DomainError if g is not in the group (not checked under tracing).
        """
        g = self._element(g, "g")
        if not is_traced(g):
            with jax.ensure_compile_time_eval():  # g may be a constant in a program being traced
                is_outside = ~np.asarray(self.belongs(g, MEMBERSHIP_TOLERANCE))
                if (index := first_true_multi_index(is_outside)) is not None:
                    raise DomainError(
                        f"Ad on {self.name}: g{format_index(index)} {self._why_not_in_domain(np.asarray(g[index]))}"
                    )
        return _adjoint_action(self, g)

    def Ad_star(self, g, mu) -> jax.Array:
        """Return the coadjoint action, defined by ``<Ad_star(g, mu), x> = <mu, Ad(g) x>``.

        A right action: ``Ad_star(g h, mu) = Ad_star(h, Ad_star(g, mu))``. Its derivative along ``g = exp(t x)`` at
        t = 0 is ``ad_star(x, mu)``; the spatial momentum of a body is ``Ad_star(inverse(g), mu)``.

        Parameters
        ----------
        g : array, shape (..., m, m)
        mu : array, shape (..., dim); the result has the same shape
        """
        return jnp.einsum("...ab,...a->...b", self.Ad(g), self._components(mu, "mu"))

    def __repr__(self) -> str:
        return f"MatrixGroup({self.name!r}, dim={self.dim})"

    def _components(self, x, label: str) -> jax.Array:
        return real_components(x, self.dim, label)

    def _element(self, g, label: str) -> jax.Array:
        matrix = square_matrices(g, self.matrix_size, label)
        if jnp.iscomplexobj(matrix) and not np.iscomplexobj(self.algebra._require_basis()):
            raise ComponentError(
                f"{label} must be real for {self.name}, got {matrix.dtype}. Take its real part if that is meant"
            )
        return matrix.astype(self.algebra._require_basis().dtype)

    def _why_not_in_domain(
        self, g: np.ndarray, requirement: str = _LOG_DOMAIN_TEXT, map_name: str = "logarithm"
    ) -> str:
        if not np.isfinite(g).all():
            return "has entries that are not finite"
        defect = float(self.defect(g))
        if not defect <= MEMBERSHIP_TOLERANCE:
            return (
                f"is not in the group: relative distance {defect:.3g}, tolerance {MEMBERSHIP_TOLERANCE:.0e}; bring "
                "it back to the group first"
            )
        eigenvalues = np.linalg.eigvals(g)
        angles = np.angle(eigenvalues)
        is_below_half_turn = np.abs(angles).max() < np.pi - HALF_TURN_MARGIN
        if map_name == "logarithm" and self.is_complex and is_below_half_turn and abs(total := angles.sum()) > np.pi:
            return (
                f"has eigenvalues whose angles sum to {total:.6g}, so its principal logarithm is not in "
                f"{self.algebra.name}. Use the logarithm of g relative to a nearer element h, that is of "
                "compose(inverse(h), g)"
            )
        eigenvalue = eigenvalues[np.abs(np.angle(eigenvalues)).argmax()]
        return (
            f"has the eigenvalue {eigenvalue:.6g} at the angle {abs(np.angle(eigenvalue)):.10f}, and det g = "
            f"{np.linalg.det(g):.3g}; the {requirement}. Use the {map_name} of g relative to a nearer element h, that "
            "is of compose(inverse(h), g)"
        )

    def cayley_is_adjoint(self) -> bool:
        """Return True if :meth:`cayley` has ``Ad(cayley(x)) = cay(ad(x))``, as in SO(3) and SE(2)."""
        if self.cayley_map is None or self.cayley_map is self.adjoint_cayley_map or self in _catalogued_groups:
            return self.cayley_map is self.adjoint_cayley_map and self._has_map_into_group("cayley")
        return replace(self, adjoint_cayley_map=self.cayley_map)._has_map_into_group("adjoint_cayley")

    def _has_map_into_group(self, kind: str) -> bool:
        """Return True if the group has the map, and the map stays in the group."""
        if getattr(self, f"{kind}_map") is None:
            return False
        return self in _catalogued_groups or self.map_defect(kind) <= MAP_DEFECT_TOLERANCE

    def _require_map(self, kind: str) -> None:
        """Raise LieAlgebraError unless the group has the map, and the map stays in the group."""
        if self._has_map_into_group(kind):
            return
        map_text, remedy = _MAP_TEXTS[kind]
        residual = self.map_defect(kind)
        if residual <= MAP_DEFECT_TOLERANCE:
            raise LieAlgebraError(f"{self.name} has no {kind}_map; {remedy}")
        raise LieAlgebraError(
            f"{map_text} does not take {self.algebra.name} into {self.name}: at random elements it misses by "
            f"{residual:.3g} (tolerance {MAP_DEFECT_TOLERANCE:.0e}); {remedy}",
            residual=residual,
            tolerance=MAP_DEFECT_TOLERANCE,
        )

    def _why_no_cayley(self, x: np.ndarray, matrix) -> str:
        if not np.isfinite(x).all():
            return "has entries that are not finite"
        eigenvalues = np.linalg.eigvals(np.asarray(matrix))
        eigenvalue = eigenvalues[np.abs(eigenvalues**2 - 4).argmin()]
        return (
            f"has the eigenvalue {eigenvalue:.10g}, and at 2 and -2 the Cayley map is singular (limit on the condition "
            f"number {CAYLEY_CONDITION_LIMIT:.0e}); shorten x or use exp"
        )


@dataclass(frozen=True)
class _BatchedFunction:
    """Function of one matrix, shape (m, m), applied to batches."""

    function: Callable

    def __call__(self, g):
        return jnp.vectorize(self.function, signature="(m,n)->()")(g)


def _batched_defect(defect: Callable, name: str, basis: np.ndarray) -> Callable:
    """Return the defect of a group as a function of batches; LieAlgebraError if it maps no matrix to a number."""

    def output_shape(batch: tuple[int, ...]) -> tuple[int, ...] | None:
        try:
            g = jax.ShapeDtypeStruct((*batch, *basis.shape[1:]), basis.dtype)
            closed_jaxpr, result = jax.make_jaxpr(defect, return_shape=True)(g)
            check_indices(closed_jaxpr, f"the defect of the group {name}")
            return np.shape(result)
        except IndexOutOfRangeError:
            if batch:  # a function of one matrix
                return None
            raise
        except (TypeError, ValueError, IndexError):
            return None

    if output_shape((2, 3)) == (2, 3):
        return defect
    if output_shape(()) != ():
        raise LieAlgebraError(
            f"the defect of {name} must be a number for a matrix, a JAX array of shape {basis.shape[1:]}: it gives "
            f"{'an error' if output_shape(()) is None else f'an array of shape {output_shape(())}'}"
        )
    return _BatchedFunction(defect)


_MAP_TEXTS = {
    "exp": ("the exponential map", "its defect, its exp_map or the matrices of its algebra are wrong"),
    "cayley": ("the Cayley map", "use exp"),
    "adjoint_cayley": ("the map that makes Cayley's of ad x an adjoint action", "use exp"),
}
"""Name of each map from the algebra to the group, and the remedy if it leaves the group."""


# -- compiled maps --------------------------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=0)
def _call_compiled(function: Callable, *args):
    return function(*args)


@partial(jax.jit, static_argnums=0)
def _adjoint_action(group: MatrixGroup, g):
    g = g[..., None, :, :]
    images = g @ group.algebra._require_basis() @ group.inverse_map(g)
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


@cache
def _map_defect(group: MatrixGroup, kind: str) -> float:
    """Compute :meth:`MatrixGroup.map_defect` once for each group and map."""
    algebra, x = group.algebra, np.random.default_rng(0).standard_normal((4, group.dim))
    x /= np.linalg.norm(np.einsum("...a,aij->...ij", x, algebra._require_basis()), axis=(-2, -1))[:, None]
    if (
        kind == "adjoint_cayley"
        and not (residual := _ad_cayley_automorphism_residual(algebra, x)) <= MAP_DEFECT_TOLERANCE
    ):
        return residual
    group_map = getattr(group, f"{kind}_map") or getattr(maps, kind)

    @jax.jit
    def residuals(x):
        g = group_map(algebra, x)
        defect = group.defect(g)
        if kind != "adjoint_cayley":
            return defect
        expected_action = cayley_of(algebra.ad(x))
        return jnp.maximum(
            defect, max_abs_entry(_adjoint_action(group, g) - expected_action) / max_abs_entry(expected_action)
        )

    with jax.ensure_compile_time_eval():  # it may be asked for while a program is being traced
        return float(np.nan_to_num(np.asarray(residuals(x)), nan=np.inf).max())


def _ad_cayley_automorphism_residual(algebra: LieAlgebra, x: np.ndarray) -> float:
    """Return how far ``cay(ad x)`` is from preserving brackets, relative to its size; adjoint actions preserve them."""
    C, identity = algebra.structure_constants, np.eye(algebra.dim)
    ad = np.einsum("abc,...a->...cb", C, x)
    R = np.linalg.solve(identity - ad / 2, identity + ad / 2)
    difference = np.einsum("...ia,...jb,ijc->...abc", R, R, C) - np.einsum("abd,...cd->...abc", C, R)
    return float(np.abs(difference).max() / max(np.abs(C).max() * np.abs(R).max() ** 2, np.finfo(float).tiny))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _principal_log(group: MatrixGroup, g):
    is_member = group.defect(g) <= MEMBERSHIP_TOLERANCE
    return jnp.where(is_member[..., None], group.log_map(group.algebra, g), jnp.nan)


@_principal_log.defjvp
def _log_jvp(group: MatrixGroup, primals, tangents):
    """Return the logarithm and its derivative along ``tangents``, the solution of ``dexp(x) x' = vee(g^-1 g')``."""
    (g,), (dg,) = primals, tangents
    x = _principal_log(group, g)
    velocity = group.algebra.vee(group.inverse_map(g) @ dg)
    return x, solve(maps.dexp(group.algebra, x), velocity[..., None])[..., 0]


_log = jax.jit(_principal_log, static_argnums=0)
