"""The isomorphism type of a real Lie algebra of dimension up to 5, in the names of Patera et al. (1976).

An algebra is split into indecomposable summands: abelian ones by its centre, others by idempotents of its centroid.
Each summand is then recognised by its radical, its nilradical and the Jordan blocks of the elements outside of it. No
basis enters these, so isomorphic algebras have one type.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import LieAlgebraError
from . import _solvable_types as solvable
from ._solvable_types import Summand, upper_eigenvalues_and_multiplicities
from ._subspaces import brackets_of_rows, complement, coordinates, intersection, is_exact, null_space, row_space
from .blocks import direct_sum
from .lie_algebra import LieAlgebra
from .patera import CATALOGUE, patera
from .substructure import (
    WorkingConstants,
    centralizer,
    centre,
    derived_ideals,
    lower_central_ideals,
    nilradical,
    radical,
    working_constants,
)

MAX_TYPE_DIM = 5
"""Largest dimension of an indecomposable summand that has a name in the list."""

CONSTANT_ROUNDING = 1e-11
"""Constants of a summand below this are rounding, in an orthonormal basis of an algebra with constants up to 1."""


@dataclass(frozen=True)
class IsomorphismType:
    """The isomorphism type of a real Lie algebra: its indecomposable summands, by name.

    Attributes
    ----------
    summands : tuple of (name, parameters)
        Names of :func:`manifolds.patera`, with pairs (parameter, value); empty if the type is not known.
    reason : str
        The reason why the type is unknown; empty if it is known.
    """

    summands: tuple[Summand, ...]
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """True if every summand has a name."""
        return not self.reason

    @property
    def name(self) -> str:
        """The names of all summands, such as ``"A4,9^b"`` or ``"A3,1 + 2 A1"``; ``"unknown"`` if they are not known."""
        if not self.is_known:
            return "unknown"
        return " + ".join(self._texts_with_counts(lambda summand: _family_name(summand)))

    @property
    def decomposition(self) -> str:
        """The summands with the values of their parameters, such as ``"A3,5^a (a=0.5) + A1"``."""
        return " + ".join(self._texts_with_counts(_summand_text)) if self.is_known else "unknown"

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters of all summands by name; no two summands have parameters up to dimension 5."""
        return {name: value for _, pairs in self.summands for name, value in pairs}

    def algebra(self) -> LieAlgebra:
        """Return the algebra of this type from the list, with its invariants; a direct sum of several summands.

        Raises
        ------
        LieAlgebraError
            If the type is not known.
        """
        if not self.is_known:
            raise LieAlgebraError(f"the isomorphism type is unknown: {self.reason}; there is no algebra to build")
        algebras = [patera(name, **dict(pairs)) for name, pairs in self.summands]
        return algebras[0] if len(algebras) == 1 else direct_sum(*algebras)

    def _texts_with_counts(self, text_of: Callable[[Summand], str]) -> list[str]:
        """Return the text of each different summand, with the number of its copies in front if it is above 1."""
        counts = Counter(text_of(summand) for summand in self.summands)
        return [text if count == 1 else f"{count} {text}" for text, count in counts.items()]

    def __str__(self) -> str:
        return self.decomposition if self.is_known else f"unknown ({self.reason})"


def _family_name(summand: Summand) -> str:
    """Return the name of a summand with the names of its parameters, such as ``"A3,5^a"``."""
    name, pairs = summand
    return name + ("^" + ",".join(parameter for parameter, _ in pairs) if pairs else "")


def _summand_text(summand: Summand) -> str:
    """Return the name of a summand with the values of its parameters, such as ``"A3,5^a (a=0.5)"``."""
    values = ", ".join(f"{parameter}={value:g}" for parameter, value in summand[1])
    return _family_name(summand) + (f" ({values})" if values else "")


def isomorphism_type(g: LieAlgebra) -> IsomorphismType:
    """Return the isomorphism type of an algebra; see :meth:`manifolds.LieAlgebra.isomorphism_type`."""
    work = working_constants(g)
    try:
        summands = [_indecomposable_type(summand) for summand in _indecomposable_summands(work)]
    except LieAlgebraError as error:
        return IsomorphismType((), str(error))
    order = {name: i for i, name in enumerate(CATALOGUE)}
    return IsomorphismType(tuple(sorted(summands, key=lambda summand: (-order[summand[0]], summand[1]))))


def _restrict_to_rows(work: WorkingConstants, rows: np.ndarray) -> WorkingConstants:
    """Return the constants of a subalgebra in the basis of independent rows."""
    brackets = brackets_of_rows(rows, rows, work.constants).reshape(-1, work.dim)
    constants = coordinates(rows, brackets).reshape((len(rows),) * 3) if len(rows) else np.zeros((0, 0, 0))
    if not is_exact(constants):
        constants = np.where(np.abs(constants) < CONSTANT_ROUNDING, 0.0, constants)
        constants = constants / (float(np.abs(constants).max(initial=0.0)) or 1.0)
    return WorkingConstants(constants, np.ones(len(rows)), work.name)


def _indecomposable_summands(work: WorkingConstants) -> list[WorkingConstants]:
    """Return the indecomposable summands of an algebra."""
    central, derived_series = centre(work), derived_ideals(work)
    brackets = derived_series[1] if len(derived_series) > 1 else derived_series[0]
    abelian = complement(intersection(central, brackets, work.name), central, work.name)
    lines = [_restrict_to_rows(work, row[None]) for row in abelian]
    if len(abelian) == work.dim:
        return lines
    if len(abelian):
        derived_and_abelian = row_space(np.vstack([brackets, abelian]), work.name)
        complement_rows = complement(derived_and_abelian, work.full_space_rows, work.name)
        work = _restrict_to_rows(work, row_space(np.vstack([brackets, complement_rows]), work.name))
    return _split_by_centroid(work) + lines


def _split_by_centroid(work: WorkingConstants) -> list[WorkingConstants]:
    """Split an algebra without abelian summands into indecomposable ones, by a generic element of its centroid.

    The centroid consists of the linear maps with ``phi [x, y] = [phi x, y]``.
    """
    n, C = work.dim, work.constants
    equations = []
    for a in range(n):
        for b in range(n):
            block = np.zeros((n, n, n), dtype=C.dtype)
            for d in range(n):
                block[d, d, :] = block[d, d, :] + C[a, b]
                block[d, :, a] = block[d, :, a] - C[:, b, d]
            equations.append(block.reshape(n, n * n))
    basis = null_space(np.vstack(equations), work.name)
    random = np.random.default_rng(0)
    weights = (
        random.integers(-99, 100, len(basis)).astype(object) if is_exact(basis) else random.standard_normal(len(basis))
    )
    phi = (weights @ basis).reshape(n, n)
    eigenvalues = upper_eigenvalues_and_multiplicities(phi)
    if len(eigenvalues) == 1:
        return [work]
    values = phi.astype(np.float64)
    scale, summands = float(np.abs(values).max()), []
    float_work = WorkingConstants(C.astype(np.float64) / float(np.abs(C).max()), np.ones(n), work.name)
    for eigenvalue, multiplicity in eigenvalues:
        factor = (values - eigenvalue * np.eye(n)) / scale
        real_factor = factor.real if eigenvalue.imag == 0.0 else (factor @ factor.conj()).real
        rows = null_space(np.linalg.matrix_power(real_factor, multiplicity), work.name)
        summands += _split_by_centroid(_restrict_to_rows(float_work, rows))
    return summands


def _indecomposable_type(work: WorkingConstants) -> Summand:
    """Return the name and parameters of an indecomposable algebra; LieAlgebraError if it has no name."""
    n = work.dim
    if n > MAX_TYPE_DIM:
        raise LieAlgebraError(f"{work.name} has an indecomposable summand of dimension {n}, above {MAX_TYPE_DIM}")
    solvable_ideal = radical(work)
    if len(solvable_ideal) < n:
        return _nonsolvable_type(work, len(solvable_ideal))
    if n <= 2:
        return (f"A{n}", ())
    nil = nilradical(work)
    if len(nil) == n:
        return _nilpotent_type(work)
    return solvable.solvable_type(work, nil)


def _nonsolvable_type(work: WorkingConstants, radical_dim: int) -> Summand:
    """Return the type of an indecomposable algebra with a Levi subalgebra; LieAlgebraError if it has no name."""
    if work.dim == 5 and radical_dim == 2:
        return ("A5,40", ())
    if work.dim != 3:
        raise LieAlgebraError(f"{work.name} has an indecomposable summand of dimension {work.dim} with a Levi part")
    C = work.constants.astype(np.float64)
    eigenvalues = np.linalg.eigvalsh(np.einsum("acd,bdc->ab", C, C))
    return ("A3,9" if eigenvalues[-1] < 0.0 else "A3,8", ())


def _nilpotent_type(work: WorkingConstants) -> Summand:
    """Return the type of an indecomposable nilpotent algebra; LieAlgebraError if it has no name."""
    ideals = lower_central_ideals(work)
    dims = tuple(len(ideal) for ideal in ideals)
    names = {(3, 1, 0): "A3,1", (4, 2, 1, 0): "A4,1", (5, 2, 0): "A5,1", (5, 3, 2, 0): "A5,3", (5, 1, 0): "A5,4"}
    names[5, 2, 1, 0] = "A5,5"
    if dims == (5, 3, 2, 1, 0):
        return ("A5,2" if len(centralizer(work, ideals[1])) == 4 else "A5,6", ())
    if dims not in names:
        raise LieAlgebraError(f"{work.name} has a nilpotent summand whose lower central series has dimensions {dims}")
    return (names[dims], ())


LieAlgebra._isomorphism_type = staticmethod(isomorphism_type)
