"""Magnetic extension of a Lie algebra: its semidirect sum with its own dual."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import real_components
from ..errors import ParameterError
from ..matrices.linear import BlockDiagonal, Diagonal
from .blocks import MAX_DIM_BY_CONSTANTS, DirectSum, semidirect_sum
from .bracket_algebra import BracketAlgebra
from .lie_algebra import LieAlgebra
from .matrix_algebra import MatrixAlgebra

MAX_FOLLOWED_CASIMIRS = 2
"""Number of Casimirs of g that are followed along a motion of its extension, where each gives two Casimirs."""


def magnetic_extension(g: LieAlgebra, by_brackets: bool | None = None) -> LieAlgebra:
    """Return ``g ⋉ g*`` by the coadjoint action: ``[(x, a), (y, b)] = ([x, y], ad*_y a - ad*_x b)``.

    Momenta are pairs (W, B) of W in g* and B in g, with ``ad*_(x, a) (W, B) = (ad*_x W - ad*_B a, -[x, B])``: B is
    carried by the velocity x and pushes back on W. The extension of so(3) is the algebra of the heavy top, and that of
    the fields without divergence is the one of ideal magnetohydrodynamics [Vishik & Dolzhanskii 1978; Marsden, Ratiu &
    Weinstein 1984]. Invariant functions f(B) are Casimirs, and so is the cross helicity ``<W, B>``.

    Parameters
    ----------
    g : LieAlgebra
        The algebra to extend.
    by_brackets : bool, optional
        Whether the extension acts by the brackets of g, without structure constants of its own: by default above
        dimension 40.

    Returns
    -------
    LieAlgebra
        Of dimension ``2 * g.dim``: the components of g first, then those of g*.

    Raises
    ------
    ParameterError
    """
    if not isinstance(g, LieAlgebra):
        raise ParameterError(f"magnetic_extension(g): g must be a LieAlgebra, got {type(g).__name__}")
    extension = MagneticExtension(g)
    is_small = extension.dim <= MAX_DIM_BY_CONSTANTS
    return extension.algebra_by_constants if (is_small if by_brackets is None else not by_brackets) else extension


@jax.tree_util.register_static
class MagneticExtension(BracketAlgebra):
    """Algebra ``g ⋉ g*``, computed by the operations of g; see :func:`manifolds.magnetic_extension`.

    Attributes
    ----------
    algebra : LieAlgebra
        The algebra g.
    """

    def __init__(self, algebra: LieAlgebra):
        super().__init__(f"{algebra.name} x {algebra.name}*", 2 * algebra.dim)
        self.algebra = algebra

    @property
    def _key(self):
        return self.algebra

    def _build_by_constants(self) -> LieAlgebra:
        # rho(x) a = -ad*_x a
        return semidirect_sum(self.algebra, -self.algebra.structure_constants, name=self.name)

    def halves(self, x, what: str = "x") -> tuple[jax.Array, jax.Array]:
        """Return the components of an element in g and in g*, shape (..., dim of g) each."""
        x = real_components(x, self.dim, what)
        return x[..., : self.algebra.dim], x[..., self.algebra.dim :]

    # -- the operations -----------------------------------------------------------------------------------------------

    def bracket(self, x, y) -> jax.Array:
        g, (x, a), (y, b) = self.algebra, self.halves(x), self.halves(y, "y")
        return jnp.concatenate([g.bracket(x, y), g.ad_star(y, a) - g.ad_star(x, b)], axis=-1)

    def ad_star(self, x, mu) -> jax.Array:
        g, (x, a), (W, B) = self.algebra, self.halves(x), self.halves(mu, "mu")
        return jnp.concatenate([g.ad_star(x, W) - g.ad_star(B, a), g.bracket(B, x)], axis=-1)

    def action(self, x) -> ExtendedAction:
        return ExtendedAction(self, x)

    # -- structure ----------------------------------------------------------------------------------------------------

    def killing_signature(self) -> tuple[int, int, int]:
        positive, negative, zero = self.algebra.killing_signature()  # the form is twice that of g, and zero on g*
        return positive, negative, zero + self.algebra.dim

    def killing_form(self) -> np.ndarray:
        self._check_matrix_memory("the Killing form")
        return np.pad(2.0 * self.algebra.killing_form(), (0, self.algebra.dim))

    def killing_inner_product(self):
        g = self.algebra
        if not g.is_compact_type():
            return -self.killing_form()
        form = g.killing_inner_product()
        blocks = (_DoubledForm(jnp.asarray(form) if isinstance(form, np.ndarray) else form), Diagonal(jnp.zeros(())))
        return BlockDiagonal(blocks, (g.dim, g.dim), (1, 1))

    def is_abelian(self) -> bool:
        return self.algebra.is_abelian()

    def is_unimodular(self) -> bool:
        return True  # the traces of ad_x on g and on g* cancel

    def derived_series(self) -> list[int]:
        return [self.dim] if self.algebra.is_semisimple() else self.algebra_by_constants.derived_series()

    def lower_central_series(self) -> list[int]:
        return [self.dim] if self.algebra.is_semisimple() else self.algebra_by_constants.lower_central_series()

    # -- Casimirs -----------------------------------------------------------------------------------------------------

    def casimir_count(self) -> int:
        g = self.algebra
        return self.algebra_by_constants.casimir_count() if invariant_form_map(g) is None else 2 * g.casimir_count()

    def _casimirs_of_degree(self, degree: int) -> list:
        """Return ``f(B)`` and ``<W, grad f(B)>`` for each Casimir f of g, where B is mapped to g* by the invariant
        form.

        If no invariant form is known, return the Casimirs found from the structure constants.
        """
        if invariant_form_map(self.algebra) is None:
            return self.algebra_by_constants.casimirs(degree)
        return [F for _, F in self._extended_casimirs([(str(f), f) for f in self.algebra.casimirs(degree)])]

    def leading_casimirs(self) -> list[tuple[str, Callable]]:
        if invariant_form_map(self.algebra) is None:
            return [("<W, B>", CrossHelicity(self))]
        return self._extended_casimirs(self.algebra.leading_casimirs()[:MAX_FOLLOWED_CASIMIRS])

    def _extended_casimirs(self, base_casimirs: list[tuple[str, Callable]]) -> list[tuple[str, Callable]]:
        """Return the two Casimirs of the extension, with their names, that follow from each Casimir of g."""
        kinds = (("of B", FieldCasimir), ("along W at B", MomentumFieldCasimir))
        return [
            (f"{name} {argument_text}", casimir_class(self, f))
            for name, f in base_casimirs
            for argument_text, casimir_class in kinds
        ]


class ExtendedAction:
    """Action of one element of the extension, computed by the action of its component in g."""

    def __init__(self, g: MagneticExtension, x):
        self.g, (x, self.a) = g, g.halves(x)
        self.base_action = g.algebra.action(x)

    def bracket(self, y) -> jax.Array:
        y, b = self.g.halves(y, "y")
        return jnp.concatenate(
            [self.base_action.bracket(y), self.g.algebra.ad_star(y, self.a) - self.base_action.ad_star(b)], axis=-1
        )

    def ad_star(self, mu) -> jax.Array:
        W, B = self.g.halves(mu, "mu")
        momentum_rate = self.base_action.ad_star(W) - self.g.algebra.ad_star(B, self.a)
        return jnp.concatenate([momentum_rate, -self.base_action.bracket(B)], axis=-1)


@jax.tree_util.register_static
@dataclass(frozen=True)
class _DoubledForm:
    """Linear map ``2 form``."""

    form: Any

    def __matmul__(self, x) -> jax.Array:
        return 2.0 * (self.form @ x)


def invariant_form_map(g: LieAlgebra) -> Callable | None:
    """Return a nondegenerate invariant form as a map from elements to dual vectors, shape (..., dim); None if unknown.

    Large matrix algebras have the trace form, other semisimple algebras the Killing form.
    """
    if isinstance(g, MatrixAlgebra):
        return g.trace_covector
    if isinstance(g, DirectSum):
        forms = [invariant_form_map(block) for block, _ in g.blocks]
        return None if None in forms else lambda x: _apply_forms_blockwise(g, forms, x)
    if not g.is_semisimple():
        return None
    form = g.killing_form()
    return lambda x: x @ form


def _apply_forms_blockwise(g: DirectSum, forms, x) -> jax.Array:
    """Apply the form of each block of a direct sum to its components of x; return the covector, shape (..., dim)."""
    covectors = [form(component) for form, component in zip(forms, g.split(x), strict=True)]
    return jnp.concatenate([component.reshape(*component.shape[:-2], -1) for component in covectors], axis=-1)


@jax.tree_util.register_static
@dataclass(frozen=True)
class CrossHelicity:
    """Cross helicity ``<W, B>``, shape (..., dim) to (...)."""

    algebra: MagneticExtension

    @property
    def dim(self) -> int:
        return self.algebra.dim

    def __call__(self, mu) -> jax.Array:
        W, B = self.algebra.halves(mu, "mu")
        return jnp.sum(W * B, axis=-1)

    def __str__(self) -> str:
        return "<W, B>"


@jax.tree_util.register_static
@dataclass(frozen=True)
class FieldCasimir:
    """Casimir f of g, evaluated at the dual vector of B, shape (..., dim) to (...)."""

    algebra: MagneticExtension
    casimir: Callable

    @property
    def dim(self) -> int:
        return self.algebra.dim

    def __call__(self, mu) -> jax.Array:
        return self.casimir(_dual_of_field(self.algebra, self.algebra.halves(mu, "mu")[1]))

    def __str__(self) -> str:
        return f"{self.casimir} of B"


@jax.tree_util.register_static
@dataclass(frozen=True)
class MomentumFieldCasimir(FieldCasimir):
    """Casimir ``<W, grad f>`` at the dual vector of B; a multiple of the cross helicity if f is quadratic."""

    def __call__(self, mu) -> jax.Array:
        W, B = self.algebra.halves(mu, "mu")
        return jax.jvp(self.casimir, (_dual_of_field(self.algebra, B),), (W,))[1]

    def __str__(self) -> str:
        return f"{self.casimir} along W at B"


def _dual_of_field(extension: MagneticExtension, B) -> jax.Array:
    """Return the dual vector of the field B by the invariant form of g, shape (..., dim of g)."""
    form = invariant_form_map(extension.algebra)
    assert form is not None
    return form(B)
