"""Named Lie algebras, each with a conventional basis and, where there is one, a faithful matrix representation.

Every entry registers the instances on which the shared property suite runs (:func:`registered`): add an algebra
here, with ``@register(...)``, and it is tested.

The classical algebras of a dimension above 120 are :class:`manifolds.MatrixAlgebra`: the same bases, normalised alike,
but brackets are products of matrices and no constants are made. su(512) takes some megabytes. ``by_matrices=True``
asks for this form at any size, False for constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from .._arguments import check_memory, checked_size
from ..errors import ParameterError
from . import matrix_bases
from ._subspaces import rational_null_space
from .blocks import direct_sum, semidirect_sum
from .lie_algebra import LieAlgebra
from .matrix_algebra import ClassicalData, MatrixAlgebra
from .matrix_bases import MatrixBasis

_registry: list[tuple[Callable[..., LieAlgebra], tuple, dict]] = []

MAX_DIM_BY_CONSTANTS = 120
"""Largest dimension in which classical algebras are arrays of structure constants: su(11), so(16), sp(7)."""

MIN_WORKING_MATRICES = 20
"""Number of matrices that a step of a method needs at least, used in the check of memory."""

BIANCHI_KINDS = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX")
"""Bianchi's types of three-dimensional Lie algebras."""


def register(*positional: tuple, **keyword_values: list):
    """Decorate a constructor to register the algebra of each argument tuple, and of each keyword value.

    The property suite runs on every registered algebra.
    """

    def add_to_registry(constructor):
        _registry.extend((constructor, a, {}) for a in positional)
        _registry.extend((constructor, (), {key: value}) for key, values in keyword_values.items() for value in values)
        return constructor

    return add_to_registry


def registered() -> Iterator[LieAlgebra]:
    """Yield one instance of every registered algebra."""
    for constructor, args, kwargs in _registry:
        yield constructor(*args, **kwargs)


@register((1,), (3,))
def abelian(n: int) -> LieAlgebra:
    """Return the abelian algebra R^n, as translations.

    Parameters
    ----------
    n : int
        The dimension.

    Examples
    --------
    >>> float(abs(mf.abelian(2).structure_constants).max())
    0.0
    """
    n = checked_size(n, 1, "abelian(n)")
    basis = np.zeros((n, n + 1, n + 1))
    basis[np.arange(n), np.arange(n), n] = 1.0
    return _algebra_from_basis(basis, f"abelian({n})")


@register((2,), (3,), (4,), (5,), (2, 1), (3, 1))
def so(p: int, q: int = 0, *, by_matrices: bool | None = None) -> LieAlgebra:
    """Return the rotation algebra so(p), or so(p, q) of the form diag(1, …, 1, -1, …, -1).

    so(3) has ``[e1, e2] = e3``: its bracket is the cross product and ``hat(x) @ y = x × y``. Otherwise the basis is
    ``E_ij g - E_ji g`` for i < j in lexicographic order, g the form.

    Parameters
    ----------
    p, q : int
        The numbers of 1 and of -1 in the form.
    by_matrices : bool, optional
        Represent the algebra by its matrices, without an array of structure constants; by default above dimension 120.

    Examples
    --------
    >>> g = mf.so(3)
    >>> print(g.bracket([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]).tolist())
    [0.0, 0.0, 1.0]
    >>> print(*g.casimirs(degree=2))
    mu1**2 + mu2**2 + mu3**2
    """
    p, q = checked_size(p, 0, "so(p, q)"), checked_size(q, 0, "so(p, q)")
    n = checked_size(p + q, 2, "so(p, q)", "p + q")
    if (p, q) == (3, 0):
        i, j, k = np.eye(3)
        return _algebra_from_basis(
            [
                np.outer(k, j) - np.outer(j, k),
                np.outer(i, k) - np.outer(k, i),
                np.outer(j, i) - np.outer(i, j),
            ],
            "so(3)",
        )
    trace_degrees = tuple(range(2, n, 2))
    pfaffian = n // 2 if n % 2 == 0 else None
    data = ClassicalData(n // 2, (p * q, n * (n - 1) // 2 - p * q, 0), (n - 2.0, 0.0), q == 0, trace_degrees, pfaffian)
    return _classical_algebra(
        f"so({p},{q})" if q else f"so({n})", n, data, by_matrices, lambda: matrix_bases.orthogonal_basis(p, q)
    )


@register((2,), (3,), (4,))
def su(n: int, *, by_matrices: bool | None = None) -> LieAlgebra:
    """Return su(n): anti-Hermitian traceless matrices ``-i lambda_a / 2`` of the (generalised) Gell-Mann matrices.

    su(2) has the structure constants of so(3); su(3) the usual f_abc.

    Parameters
    ----------
    n : int
        The size of the matrices.
    by_matrices : bool, optional
        Represent the algebra by its matrices, without an array of structure constants; by default above dimension 120.

    Examples
    --------
    >>> mf.su(3).dim
    8
    """
    n = checked_size(n, 2, "su(n)")
    data = ClassicalData(n - 1, (0, n * n - 1, 0), (2.0 * n, 0.0), True, tuple(range(2, n + 1)))
    return _classical_algebra(f"su({n})", n, data, by_matrices, lambda: matrix_bases.unitary_basis(n, has_centre=False))


@register((2,))
def u(n: int, *, by_matrices: bool | None = None) -> LieAlgebra:
    """Return u(n), the anti-Hermitian matrices: the basis of su(n), then the centre ``-i/2 sqrt(2/n) 1``.

    Parameters
    ----------
    n : int
        The size of the matrices.
    by_matrices : bool, optional
        Represent the algebra by its matrices, without an array of structure constants; by default above dimension 120.

    Examples
    --------
    >>> mf.u(2).dim
    4
    """
    n = checked_size(n, 1, "u(n)")
    data = ClassicalData(n, (0, n * n - 1, 1), (2.0 * n, 2.0), True, tuple(range(1, n + 1)))
    return _classical_algebra(f"u({n})", n, data, by_matrices, lambda: matrix_bases.unitary_basis(n, has_centre=True))


@register((2,), (3,))
def sl(n: int, *, by_matrices: bool | None = None) -> LieAlgebra:
    """Return sl(n), the traceless real matrices: ``E_ii - E_(i+1)(i+1)``, then E_ij of the upper and the lower
    triangle.

    sl(2) is (h, e, f) with ``[h, e] = 2e``, ``[h, f] = -2f``, ``[e, f] = h``.

    Parameters
    ----------
    n : int
        The size of the matrices.
    by_matrices : bool, optional
        Represent the algebra by its matrices, without an array of structure constants; by default above dimension 120.

    Examples
    --------
    >>> mf.sl(2).dim
    3
    """
    n = checked_size(n, 2, "sl(n)")
    rotations = n * (n - 1) // 2
    data = ClassicalData(n - 1, (n * n - 1 - rotations, rotations, 0), (2.0 * n, 0.0), False, tuple(range(2, n + 1)))
    return _classical_algebra(f"sl({n})", n, data, by_matrices, lambda: matrix_bases.special_linear_basis(n))


@register((1,), (2,))
def sp(n: int, *, by_matrices: bool | None = None) -> LieAlgebra:
    """Return sp(2n, R): matrices ``[[A, B], [C, -A^T]]`` with B and C symmetric; A row by row, then B, then C.

    Parameters
    ----------
    n : int
        Half the size of the matrices.
    by_matrices : bool, optional
        Represent the algebra by its matrices, without an array of structure constants; by default above dimension 120.

    Examples
    --------
    >>> mf.sp(1).dim
    3
    """
    n = checked_size(n, 1, "sp(n)")
    data = ClassicalData(n, (n * (n + 1), n * n, 0), (2.0 * n + 2.0, 0.0), False, tuple(range(2, 2 * n + 1, 2)))
    return _classical_algebra(f"sp({n})", 2 * n, data, by_matrices, lambda: matrix_bases.symplectic_basis(n))


@register(())
def g2() -> LieAlgebra:
    """Return the compact exceptional algebra of dimension 14: the matrices of so(7) that preserve the octonion
    three-form.

    The form is ``e123 + e145 + e167 + e246 - e257 - e347 - e356``; each matrix is the sum or difference of two basis
    elements of so(7), E_ij - E_ji. The Casimirs have the degrees 2 and 6.
    """
    form = np.zeros((7, 7, 7), dtype=np.int64)
    for i, j, k, sign in _OCTONIONS:
        for p, q, r in ((i, j, k), (j, k, i), (k, i, j)):
            form[p, q, r], form[q, p, r] = sign, -sign
    rotations = np.asarray(so(7).basis, dtype=np.int64)
    derivatives = np.einsum("api,ijk->apjk", rotations, form)
    derivatives = derivatives + derivatives.transpose(0, 2, 3, 1) + derivatives.transpose(0, 3, 1, 2)
    stabilizer = np.array(rational_null_space(derivatives.reshape(len(rotations), -1).T))
    return _algebra_from_basis(np.einsum("na,aij->nij", stabilizer, rotations), "g2")


_OCTONIONS = (
    (0, 1, 2, 1),
    (0, 3, 4, 1),
    (0, 5, 6, 1),
    (1, 3, 5, 1),
    (1, 4, 6, -1),
    (2, 3, 6, -1),
    (2, 4, 5, -1),
)
"""Indices and signs of the terms of the octonion three-form."""


@register((1,), (2,))
def gl(n: int, *, by_matrices: bool | None = None) -> LieAlgebra:
    """Return gl(n), all real matrices, with the basis E_ij row by row.

    Parameters
    ----------
    n : int
        The size of the matrices.
    by_matrices : bool, optional
        Represent the algebra by its matrices, without an array of structure constants; by default above dimension 120.

    Examples
    --------
    >>> mf.gl(2).dim
    4
    """
    n = checked_size(n, 1, "gl(n)")
    rotations = n * (n - 1) // 2
    data = ClassicalData(n, (n * n - 1 - rotations, rotations, 1), (2.0 * n, 2.0), False, tuple(range(1, n + 1)))
    return _classical_algebra(f"gl({n})", n, data, by_matrices, lambda: matrix_bases.general_linear_basis(n))


@register((2,), (3,))
def se(n: int) -> LieAlgebra:
    """Return the rigid motions of R^n: the rotations so(n) first, then the translations.

    Parameters
    ----------
    n : int
        The dimension of the space on which the group acts.

    Examples
    --------
    >>> mf.se(3).dim
    6
    """
    n = checked_size(n, 2, "se(n)")
    rotations = so(n)
    return semidirect_sum(rotations, rotations.basis, name=f"se({n})")


@register((1,), (2,))
def heisenberg(n: int = 1) -> LieAlgebra:
    """Return the Heisenberg algebra (q_1 … q_n, p_1 … p_n, z) with ``[q_i, p_i] = z``, as upper triangular matrices.

    Parameters
    ----------
    n : int
        The number of pairs (q_i, p_i).

    Examples
    --------
    >>> mf.heisenberg(2).dim
    5
    """
    n = checked_size(n, 1, "heisenberg(n)")
    q = [_matrix_unit(n + 2, 0, i + 1) for i in range(n)]
    p = [_matrix_unit(n + 2, i + 1, n + 1) for i in range(n)]
    return _algebra_from_basis([*q, *p, _matrix_unit(n + 2, 0, n + 1)], f"heisenberg({n})")


@register((2,), (3,))
def galilei(n: int) -> LieAlgebra:
    """Return the Galilei algebra of R^n: rotations J, boosts K, translations P, time shift H; ``[K_i, H] = P_i``.

    Parameters
    ----------
    n : int
        The dimension of the space on which the group acts.
    """
    n = checked_size(n, 2, "galilei(n)")
    rotations = np.zeros((n * (n - 1) // 2, n + 2, n + 2))
    rotations[:, :n, :n] = so(n).basis
    boosts = [_matrix_unit(n + 2, i, n) for i in range(n)]
    translations = [_matrix_unit(n + 2, i, n + 1) for i in range(n)]
    return _algebra_from_basis([*rotations, *boosts, *translations, _matrix_unit(n + 2, n, n + 1)], f"galilei({n})")


@register((1,), (2,))
def aff(n: int = 1) -> LieAlgebra:
    """Return the affine maps of R^n: gl(n) row by row, then the translations. aff(1) has ``[e1, e2] = e2``.

    Parameters
    ----------
    n : int
        The dimension of the space on which the group acts.
    """
    n = checked_size(n, 1, "aff(n)")
    return semidirect_sum(gl(n), gl(n).basis, name=f"aff({n})")


@register(kind=[k for k in BIANCHI_KINDS if k not in ("VI", "VII")])
def bianchi(kind: str, h: float | None = None) -> LieAlgebra:
    """Return one of Bianchi's three-dimensional algebras, in the form of Ellis and MacCallum (1969).

    ``[e2, e3] = n1 e1``, ``[e3, e1] = n2 e2 - a e3``, ``[e1, e2] = n3 e3 + a e2``, where (n1, n2, n3, a) is

    ====  ==================   ====  ======================
    I     (0, 0, 0, 0)         VI    (0, 1, -1, sqrt(-h))
    II    (1, 0, 0, 0)         VII   (0, 1, 1, sqrt(h))
    III   (0, 1, -1, 1)        VIII  (1, 1, -1, 0)
    IV    (0, 0, 1, 1)         IX    (1, 1, 1, 0)
    V     (0, 0, 0, 1)
    ====  ==================   ====  ======================

    Parameters
    ----------
    kind : "I" … "IX"
        Type in Bianchi's list.
    h : float
        For VI (h <= 0; h = 0 is VI_0, h = -1 is III) and VII (h >= 0; h = 0 is VII_0) only, where it must be given.

    Raises
    ------
    ParameterError
        If the kind is unknown, h is missing, has the wrong sign, or is given where it has no meaning.

    Examples
    --------
    >>> mf.bianchi("VIII").dim
    3
    """
    if kind not in BIANCHI_KINDS:
        raise ParameterError(f"kind must be one of {', '.join(BIANCHI_KINDS)}, got {kind!r}")
    is_family = kind in ("VI", "VII")
    if is_family and h is None:
        raise ParameterError(f"Bianchi {kind} is a family and needs h, for example bianchi({kind!r}, h=0)")
    if not is_family and h is not None:
        raise ParameterError(f"Bianchi {kind} has no parameter h")
    if h is not None and (not math.isfinite(h) or h * (1 if kind == "VII" else -1) < 0):
        raise ParameterError(f"Bianchi {kind} needs h {'>=' if kind == 'VII' else '<='} 0, got {h}")
    a = math.sqrt(abs(h or 0.0))
    n1, n2, n3, a = {
        "I": (0, 0, 0, 0),
        "II": (1, 0, 0, 0),
        "III": (0, 1, -1, 1),
        "IV": (0, 0, 1, 1),
        "V": (0, 0, 0, 1),
        "VI": (0, 1, -1, a),
        "VII": (0, 1, 1, a),
        "VIII": (1, 1, -1, 0),
        "IX": (1, 1, 1, 0),
    }[kind]
    name = f"bianchi({kind!r})" if h is None else f"bianchi({kind!r}, h={h:g})"
    constants = np.zeros((3, 3, 3))
    constants[1, 2, 0] = n1
    constants[2, 0, 1], constants[2, 0, 2] = n2, -a
    constants[0, 1, 2], constants[0, 1, 1] = n3, a
    constants -= constants.swapaxes(0, 1).copy()
    if kind in ("VIII", "IX"):  # no centre, so the adjoint matrices are faithful
        return LieAlgebra(constants, name=name, basis=constants.swapaxes(1, 2))
    if kind == "II":  # [e2, e3] = e1
        basis = np.array([_matrix_unit(3, 0, 2), _matrix_unit(3, 0, 1), _matrix_unit(3, 1, 2)])
        return LieAlgebra(constants, name=name, basis=basis)
    if kind == "I":
        return LieAlgebra(constants, name=name, basis=abelian(3).basis)
    # e1 acts on the abelian ideal (e2, e3): affine matrices of the plane
    basis = np.zeros((3, 3, 3))
    basis[0, :2, :2] = constants[0, 1:, 1:].T
    basis[1, 0, 2] = basis[2, 1, 2] = 1.0
    return LieAlgebra(constants, name=name, basis=basis)


for _kind, _h in [("VI", 0.0), ("VI", -0.25), ("VI", -0.5), ("VII", 0.0), ("VII", 1.0), ("VII", 0.3)]:
    _registry.append((bianchi, (_kind,), {"h": _h}))
_registry.append((lambda: direct_sum(so(3), heisenberg(1)), (), {}))
_registry.append((lambda: semidirect_sum(sl(2), sl(2).basis, name="sl(2) x R^2"), (), {}))


def _matrix_unit(n: int, i: int, j: int) -> np.ndarray:
    matrix = np.zeros((n, n))
    matrix[i, j] = 1.0
    return matrix


def _classical_algebra(
    name: str, size: int, data: ClassicalData, by_matrices: bool | None, make_basis: Callable[[], MatrixBasis]
) -> LieAlgebra:
    """Return the algebra by structure constants up to MAX_DIM_BY_CONSTANTS, else by products of matrices.

    ``by_matrices`` overrides this choice; the basis does not depend on it.
    """
    check_memory(MIN_WORKING_MATRICES * float(size) ** 2, f"one step with matrices of {name}", "take smaller ones")
    if not (sum(data.signature) > MAX_DIM_BY_CONSTANTS if by_matrices is None else by_matrices):
        return _algebra_from_basis(make_basis().basis_matrices(), name)
    return MatrixAlgebra(name, make_basis(), data)


def _algebra_from_basis(basis, name: str) -> LieAlgebra:
    return LieAlgebra.from_matrices(np.array(basis), name=name)
