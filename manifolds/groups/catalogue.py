"""Constructors of the classical matrix groups."""

from __future__ import annotations

from dataclasses import replace

from ..algebras import catalogue
from ..matrices.linear import adjoint, newton_schulz_step
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
    return replace(group, adjoint_cayley_map=closed.adjoint_cayley_so4) if n == 4 else group


@register((2,), (3,))
def SE(n: int) -> MatrixGroup:
    """Return the group of rigid motions of R^n, homogeneous matrices ``[[rotation, translation], [0, 1]]``."""
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
            group, exp_map=closed.exp_se3, log_map=closed.log_rigid, adjoint_cayley_map=closed.adjoint_cayley_se3
        )
        return replace(group, cayley_map=closed.cayley_se3, inverse_cayley_map=closed.inverse_cayley_se3)
    return group


@register((2,), (3,))
def SU(n: int) -> MatrixGroup:
    """Return the group of unitary complex matrices of determinant 1."""
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
            group, inverse_cayley_map=closed.inverse_cayley_su2, adjoint_cayley_map=closed.adjoint_cayley_gl2
        )
    return replace(group, cayley_map=None, adjoint_cayley_map=None)


@register((2,), (3,))
def SL(n: int) -> MatrixGroup:
    """Return the group of real matrices of determinant 1. The Cayley map exists for n = 2 only, where SL(2) = Sp(1)."""
    group = MatrixGroup(f"SL({n})", catalogue.sl(n), closed.unimodular_defect, restore_map=closed.restore_unimodular)
    if n == 2:
        return replace(group, adjoint_cayley_map=closed.adjoint_cayley_gl2, equations=closed.symplectic_equations)
    return replace(group, cayley_map=None, adjoint_cayley_map=None, equations=closed.unimodular_equations)


@register((2,))
def Sp(n: int) -> MatrixGroup:
    """Return the group Sp(2n, R): ``g^T J g = J`` with ``J = [[0, I], [-I, 0]]``."""
    return MatrixGroup(
        f"Sp({n})",
        catalogue.sp(n),
        closed.symplectic_defect,
        closed.symplectic_inverse,
        adjoint_cayley_map=closed.adjoint_cayley_gl2 if n == 1 else None,
        restore_map=closed.restore_symplectic,
        equations=closed.symplectic_equations,
    )


@register((2,))
def GL(n: int) -> MatrixGroup:
    """Return the group of invertible real matrices; ``exp`` and ``log`` concern GL+, the component of positive
    determinant."""
    return MatrixGroup(
        f"GL({n})",
        catalogue.gl(n),
        closed.invertible_defect,
        adjoint_cayley_map={1: maps.cayley, 2: closed.adjoint_cayley_gl2}.get(n),
    )


@register((1,), (2,))
def Heisenberg(n: int = 1) -> MatrixGroup:
    """Return the group of matrices ``[[1, q, z], [0, I, p], [0, 0, 1]]``, whose Cayley map is the exponential."""
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
