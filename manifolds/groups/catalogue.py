"""Constructors of the classical matrix groups, and connected subgroups that are spanned by given matrices."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import numeric_array
from ..algebras import catalogue
from ..errors import ParameterError
from ..matrices.linear import adjoint, newton_schulz_step, solve
from . import closed_forms as closed
from . import maps
from .matrix_group import MatrixGroup, register

# -- the groups -----------------------------------------------------------------------------------------------------


@register((2,), (3,), (4,))
def SO(n: int) -> MatrixGroup:
    """Return the group of rotations of R^n: ``g^T g = I``, ``det g = 1``.

    Parameters
    ----------
    n : int
        The size of the matrices.

    Examples
    --------
    >>> group = mf.SO(3)
    >>> g = group.exp([0.1, 0.2, 0.3])
    >>> bool(group.belongs(g)), np.allclose(group.log(g), [0.1, 0.2, 0.3])
    (True, True)
    """
    group = MatrixGroup(
        f"SO({n})",
        catalogue.so(n),
        closed.special_unitary_defect,
        adjoint,
        log_map=closed.rotation_log,
        adjoint_cayley_map=None,
        restore_map=newton_schulz_step,
        equations=closed.orthogonal_equations,
    )
    if n == 2:
        return replace(
            group, exp_map=closed.exp_so2, log_map=closed.log_so2, adjoint_cayley_map=maps.cayley
        )  # abelian: any map will do
    if n == 3:
        group = replace(group, exp_map=closed.exp_so3, log_map=closed.log_so3, adjoint_cayley_map=closed.cayley_so3)
        return replace(group, cayley_map=closed.cayley_so3, inverse_cayley_map=closed.inverse_cayley_so3)
    return replace(group, adjoint_cayley_map=closed.element_with_cayley_adjoint_so4) if n == 4 else group


@register((2,), (3,))
def SE(n: int) -> MatrixGroup:
    """Return the group of rigid motions of R^n, homogeneous matrices ``[[rotation, translation], [0, 1]]``.

    Parameters
    ----------
    n : int
        The dimension of the space; the matrices have the size n + 1.
    """
    group = MatrixGroup(
        f"SE({n})",
        catalogue.se(n),
        closed.rigid_defect,
        closed.rigid_inverse,
        adjoint_cayley_map=maps.cayley if n == 2 else None,
        restore_map=closed.restore_rigid,
        equations=closed.rigid_equations,
    )
    if n == 2:
        return replace(group, log_map=closed.log_rigid)
    if n == 3:
        group = replace(
            group,
            exp_map=closed.exp_se3,
            log_map=closed.log_rigid,
            adjoint_cayley_map=closed.element_with_cayley_adjoint_se3,
        )
        return replace(group, cayley_map=closed.cayley_se3, inverse_cayley_map=closed.inverse_cayley_se3)
    return group


@register((2,), (3,))
def SU(n: int) -> MatrixGroup:
    """Return the group of unitary complex matrices of determinant 1.

    Parameters
    ----------
    n : int
        The size of the matrices.
    """
    group = MatrixGroup(
        f"SU({n})",
        catalogue.su(n),
        closed.special_unitary_defect,
        adjoint,
        restore_map=closed.restore_special_unitary,
        equations=closed.special_unitary_equations,
    )
    if n == 2:
        group = replace(group, exp_map=closed.exp_su2, log_map=closed.log_su2)
        return replace(
            group,
            inverse_cayley_map=closed.inverse_cayley_su2,
            adjoint_cayley_map=closed.element_with_cayley_adjoint_gl2,
        )
    return replace(group, cayley_map=None, adjoint_cayley_map=None)


@register((2,), (3,))
def SL(n: int) -> MatrixGroup:
    """Return the group of real matrices of determinant 1. The Cayley map exists for n = 2 only, where SL(2) = Sp(1).

    Parameters
    ----------
    n : int
        The size of the matrices.
    """
    group = MatrixGroup(f"SL({n})", catalogue.sl(n), closed.unimodular_defect, restore_map=closed.restore_unimodular)
    if n == 2:
        return replace(
            group, adjoint_cayley_map=closed.element_with_cayley_adjoint_gl2, equations=closed.symplectic_equations
        )
    return replace(group, cayley_map=None, adjoint_cayley_map=None, equations=closed.unimodular_equations)


@register((2,))
def Sp(n: int) -> MatrixGroup:
    """Return the group Sp(2n, R): ``g^T J g = J`` with ``J = [[0, I], [-I, 0]]``.

    Parameters
    ----------
    n : int
        Half the size of the matrices.
    """
    return MatrixGroup(
        f"Sp({n})",
        catalogue.sp(n),
        closed.symplectic_defect,
        closed.symplectic_inverse,
        adjoint_cayley_map=closed.element_with_cayley_adjoint_gl2 if n == 1 else None,
        restore_map=closed.restore_symplectic,
        equations=closed.symplectic_equations,
    )


@register((2,))
def GL(n: int) -> MatrixGroup:
    """Return the group of invertible real matrices; ``exp`` and ``log`` concern GL+, the component of positive
    determinant.

    Parameters
    ----------
    n : int
        The size of the matrices.
    """
    return MatrixGroup(
        f"GL({n})",
        catalogue.gl(n),
        closed.invertible_defect,
        adjoint_cayley_map={1: maps.cayley, 2: closed.element_with_cayley_adjoint_gl2}.get(n),
    )


@register((1,), (2,))
def Heisenberg(n: int = 1) -> MatrixGroup:
    """Return the group of matrices ``[[1, q, z], [0, I, p], [0, 0, 1]]``, whose Cayley map is the exponential.

    Parameters
    ----------
    n : int
        The number of pairs (q_i, p_i); the matrices have the size n + 2.
    """
    return MatrixGroup(
        f"Heisenberg({n})",
        catalogue.heisenberg(n),
        closed.heisenberg_defect,
        closed.heisenberg_inverse,
        closed.exp_heisenberg,
        closed.log_heisenberg,
        closed.exp_heisenberg,
        closed.log_heisenberg,
        closed.exp_heisenberg,
        closed.restore_heisenberg,
    )


SUBALGEBRA_TOLERANCE = 1e-10
"""Largest distance of a bracket of unit vectors from the subalgebra."""


def orthonormal_subalgebra_basis(group: MatrixGroup, spanning_matrices) -> np.ndarray:
    """Return orthonormal components of a basis of the subalgebra that matrices span, shape (k, dim of the group).

    Parameters
    ----------
    group : MatrixGroup
        The basis of its algebra must be orthogonal as matrices, all of one norm, as for so(n) and su(n).
    spanning_matrices : array, shape (k, n, n)

    Raises
    ------
    ParameterError
        If the matrices are dependent, not in the algebra of the group, or do not span a subalgebra.
    """
    basis, matrices = group.algebra._require_basis(), np.asarray(numeric_array(spanning_matrices, "stabilizer"))
    matrices = matrices.reshape(-1, *basis.shape[1:]) if matrices.size == 0 else matrices
    if matrices.shape[1:] != basis.shape[1:]:
        n = group.matrix_size
        raise ParameterError(
            f"the stabilizer in {group.name} must be matrices of shape (k, {n}, {n}), got {matrices.shape}"
        )

    def components_of_matrix(a):
        return np.einsum("dij,...ij->...d", basis.conj(), a).real / (np.abs(basis[0]) ** 2).sum()

    def matrix_of_components(c):
        return np.einsum("...d,dij->...ij", c, basis)

    directions = components_of_matrix(matrices)
    residuals = np.abs(matrices - matrix_of_components(directions)).max(axis=(1, 2), initial=0.0)
    if (residuals > SUBALGEBRA_TOLERANCE).any():
        raise ParameterError(
            f"matrix {int(np.argmax(residuals))} of the stabilizer is not in the algebra of {group.name}: it is "
            f"{residuals.max():.2g} off"
        )
    if len(directions) and (rank := np.linalg.matrix_rank(directions)) < len(directions):
        raise ParameterError(
            f"the {len(directions)} matrices of the stabilizer in {group.name} span {rank} dimensions only. Leave one "
            "out"
        )
    rows = np.linalg.qr(directions.T)[0].T
    for j, i in itertools.combinations(range(len(rows)), 2):
        a, b = matrix_of_components(rows[i]), matrix_of_components(rows[j])
        bracket = components_of_matrix(a @ b - b @ a)
        if (residual := np.linalg.norm(bracket - rows.T @ (rows @ bracket))) > SUBALGEBRA_TOLERANCE:
            raise ParameterError(
                f"the stabilizer in {group.name} is not a subalgebra: the bracket of its directions {j} and {i} is "
                f"{residual:.2g} off their span. Add the missing directions"
            )
    return rows


_MAX_NEWTON_STEPS = 30
"""Largest number of iterations of Newton's method."""


def horizontal_factor_coordinates(
    group: MatrixGroup, horizontal_rows: np.ndarray, stabilizer_rows: np.ndarray, element, max_length: float
):
    """Return c, shape (k,), with ``exp(c horizontal_rows) exp(b stabilizer_rows) = element``, by Newton's method.

    Parameters
    ----------
    horizontal_rows, stabilizer_rows : array, shape (k, dim)
        Bases of complementary subspaces of the algebra; the stabilizer is a subalgebra.
    element : array, shape (n, n)
        Element of the group.
    max_length : float
        Length that c must not reach; the result is NaN if it does, or if Newton's method does not converge.
    """
    d = len(horizontal_rows)

    def exponential_factors(z):
        return [
            group.exp_map(group.algebra, components)
            for components in (z[:d] @ horizontal_rows, z[d:] @ stabilizer_rows)
        ]

    def residual(z, element):
        a, b = exponential_factors(z)
        return a @ b - element

    def residual_in_algebra(z, element):
        """Return the residual as a vector of the algebra, which vanishes where the residual does."""
        a, b = exponential_factors(z)
        return group.algebra.vee(group.inverse_map(a @ b) @ residual(z, element))

    def to_real_vector(a):
        return jnp.concatenate([a.real.ravel(), a.imag.ravel()])

    def damped_newton_step(state):
        z, _, steps = state
        J, f = jax.jacfwd(lambda z: (to_real_vector(residual(z, element)),) * 2, has_aux=True)(z)
        direction = solve(J.T @ J, -(J.T @ f)[:, None])[:, 0]
        lengths = 0.5 ** np.arange(8.0)
        squared_residuals = jax.vmap(lambda t: (to_real_vector(residual(z + t * direction, element)) ** 2).sum())(
            lengths
        )
        move = jnp.asarray(lengths)[jnp.nanargmin(squared_residuals)] * direction
        return z + move, jnp.abs(move).max(), steps + 1

    def newton_solve(_, start):
        is_unfinished = lambda state: (state[1] > 1e-8) & (state[2] < _MAX_NEWTON_STEPS)  # noqa: E731
        z, change, _ = jax.lax.while_loop(is_unfinished, damped_newton_step, (start, jnp.inf, 0))
        is_solution = (
            ((z[:d] ** 2).sum() < max_length**2) & (change <= 1e-8) & (jnp.abs(residual(z, element)).max() <= 1e-10)
        )
        return jnp.where(is_solution, z, jnp.nan)

    velocity = group.algebra.vee(element - group.inverse_map(element)) / 2.0
    z = jax.lax.custom_root(  # its derivatives follow from the implicit function theorem
        lambda z: residual_in_algebra(z, element),
        jax.lax.stop_gradient(jnp.concatenate([horizontal_rows @ velocity, stabilizer_rows @ velocity])),
        newton_solve,
        lambda linear, b: solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b[:, None])[:, 0],
    )
    return z[:d]
