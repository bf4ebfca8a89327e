"""Crystal lattices of spins: cells with a basis, shells of neighbours, and the bonds between sites."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manifolds._arguments import is_integer
from manifolds._class_members import ListedType

from ...errors import InputError
from ..conditions import checked_host_numbers

SHELL_TOLERANCE = 1e-6
"""Relative difference of distances below which two neighbours belong to one shell.

Positions are computed in double precision, and different shells of simple crystals differ by more than 1e-3.
"""

_SQRT3 = math.sqrt(3.0)

_FCC_TRANSLATIONS = ((0.0, 0.0, 0.0), (0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0))

_CUBE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

_FCC_VECTORS = ((0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0))

_TRIANGLE = ((1.0, 0.0, 0.0), (0.5, 0.5 * _SQRT3, 0.0))

_DIAMOND = ((0.0, 0.0, 0.0), (0.25, 0.25, 0.25))

_TETRAHEDRON = ((0.0, 0.0, 0.0), (0.0, 0.25, 0.25), (0.25, 0.0, 0.25), (0.25, 0.25, 0.0))

_ORIGIN = ((0.0, 0.0, 0.0),)


def _fcc_copies(motif) -> tuple[tuple[float, ...], ...]:
    """Return the positions of a motif repeated at the four points of a face-centred cubic cell."""
    return tuple(tuple((np.add(t, r)).tolist()) for t in _FCC_TRANSLATIONS for r in motif)


CRYSTALS: dict[str, tuple[tuple, tuple]] = {
    "chain": (((1.0, 0.0, 0.0),), _ORIGIN),
    "square": (_CUBE[:2], _ORIGIN),
    "triangular": (_TRIANGLE, _ORIGIN),
    "honeycomb": (_TRIANGLE, ((0.0, 0.0, 0.0), (0.5, 0.5 / _SQRT3, 0.0))),
    "kagome": (_TRIANGLE, ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.25, 0.25 * _SQRT3, 0.0))),
    "sc": (_CUBE, _ORIGIN),
    "bcc": (_CUBE, ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))),
    "fcc": (_CUBE, _FCC_TRANSLATIONS),
    "diamond": (_CUBE, _fcc_copies(_DIAMOND)),
    "pyrochlore": (_CUBE, _fcc_copies(_TETRAHEDRON)),
}
"""Vectors of the conventional cell and positions of the basis, in units of the lattice constant, by name."""

PRIMITIVE_CELLS: dict[str, tuple[tuple, tuple]] = {
    "bcc": (((-0.5, 0.5, 0.5), (0.5, -0.5, 0.5), (0.5, 0.5, -0.5)), _ORIGIN),
    "fcc": (_FCC_VECTORS, _ORIGIN),
    "diamond": (_FCC_VECTORS, _DIAMOND),
    "pyrochlore": (_FCC_VECTORS, _TETRAHEDRON),
}
"""Primitive cells of the crystals whose conventional cell holds several of them."""

IDEAL_HCP_RATIO = math.sqrt(8.0 / 3.0)
"""Ratio c / a of close-packed spheres."""


def lattice(
    crystal,
    cells,
    constant: float = 1.0,
    periodic: bool | Sequence[bool] = True,
    basis=None,
    primitive: bool = False,
    c_over_a: float = IDEAL_HCP_RATIO,
    images: bool = False,
) -> Lattice:
    """Return a lattice of spins, by the name of a crystal or from vectors and a basis.

    Parameters
    ----------
    crystal : str, or array, shape (d, 3)
        "chain", "square", "triangular", "honeycomb", "kagome", "sc", "bcc", "fcc", "hcp", "diamond" or "pyrochlore";
        or the vectors of a cell (length), d = 1, 2 or 3.
    cells : int or tuple of int
        Number of cells along each vector; one integer for all vectors.
    constant : float > 0
        Lattice constant a (length), by which vectors and basis are multiplied. In a honeycomb or kagome lattice a is
        the length of a cell vector, not the distance of neighbours.
    periodic : bool or tuple of bool
        Whether the lattice is periodic, along each vector.
    basis : array, shape (atoms, 3), optional
        Positions of the atoms of a cell (length), for a crystal given by vectors; one atom at the origin by default.
    primitive : bool
        Use the primitive cell of "bcc", "fcc", "diamond" or "pyrochlore" (1, 1, 2 and 4 atoms), not the conventional
        cubic cell (2, 4, 8 and 16 atoms).
    c_over_a : float > 0
        Ratio of the two lattice constants of "hcp".
    images : bool
        Count bonds to the periodic images of a spin as bonds of their own. By default bonds that join a pair twice, or
        a spin with its own image, as on a periodic axis of length 1 or 2, are refused.

    Returns
    -------
    Lattice

    Raises
    ------
    InputError

    Examples
    --------
    >>> iron = lt.magnetism.lattice("bcc", (4, 4, 4), constant=2.87)
    >>> iron.sites
    (4, 4, 4, 2)
    >>> [(shell.coordination, round(shell.distance, 3)) for shell in iron.shells(3)]
    [(8, 2.485), (6, 2.87), (12, 4.059)]
    """
    if isinstance(crystal, str):
        if basis is not None:
            raise InputError(f"the crystal {crystal!r} has a basis of its own. Give vectors to use basis=")
        vectors, positions = _vectors_and_basis_of_crystal(crystal, primitive, c_over_a)
    else:
        vectors, positions = crystal, _ORIGIN if basis is None else basis
    scale = _checked_length(constant, "the constant of a lattice")
    vectors, positions = (
        scale * checked_host_numbers(value, name)
        for value, name in ((vectors, "the vectors of a lattice"), (positions, "the basis of a lattice"))
    )
    if not (np.isfinite(vectors).all() and np.isfinite(positions).all()):
        raise InputError("vectors and basis of a lattice must be finite numbers")
    if vectors.ndim != 2 or vectors.shape[1] != 3 or not 1 <= len(vectors) <= 3:
        raise InputError(f"the vectors of a lattice must have shape (1, 3), (2, 3) or (3, 3), got {vectors.shape}")
    if np.linalg.matrix_rank(vectors) < len(vectors):
        raise InputError(f"the vectors of a lattice must be linearly independent, got {vectors.tolist()}")
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions):
        raise InputError(f"the basis of a lattice must have shape (atoms, 3), got {positions.shape}")
    axes = len(vectors)
    cell_counts = _axis_values(cells, axes, "cells")
    if any(not is_integer(n) or n < 1 for n in cell_counts):
        raise InputError(f"cells must be positive integers, one for each of the {axes} axes, got {cells!r}")
    for value, name in ((primitive, "primitive"), (images, "images")):
        _check_truth_values((value,), name)
    periodic_axes = _axis_values(periodic, axes, "periodic")
    _check_truth_values(periodic_axes, "periodic")
    result = Lattice(vectors, positions, tuple(map(int, cell_counts)), tuple(map(bool, periodic_axes)), bool(images))
    result.check_basis()
    return result


def _vectors_and_basis_of_crystal(name: str, primitive: bool, c_over_a: float) -> tuple:
    """Return the cell vectors and basis positions of a named crystal, in units of the lattice constant."""
    if name == "hcp":
        c_over_a = _checked_length(c_over_a, "c_over_a")
        return (*_TRIANGLE, (0.0, 0.0, c_over_a)), (
            (0.0, 0.0, 0.0),
            (0.5, 0.5 / _SQRT3, 0.5 * c_over_a),
        )
    if name not in CRYSTALS:
        names = ", ".join(map(repr, sorted([*CRYSTALS, "hcp"])))
        raise InputError(f"no crystal {name!r}. The names are {names}; or give vectors and a basis")
    return PRIMITIVE_CELLS.get(name, CRYSTALS[name]) if primitive else CRYSTALS[name]


def _checked_length(value, name: str) -> float:
    """Return a number; raise InputError unless it is one positive and finite number."""
    number = checked_host_numbers(value, name)
    if number.shape or not 0.0 < number < np.inf:
        raise InputError(f"{name} must be one positive and finite number, got {value!r}")
    return float(number)


def _check_truth_values(values, name: str) -> None:
    """Raise InputError unless all values are True or False; a text such as "no" would count as True."""
    if not all(isinstance(value, bool | np.bool_) for value in values):
        raise InputError(f"{name} must be True or False, got {', '.join(map(repr, values))}")


def _axis_values(value, n_axes: int, quantity_name: str) -> tuple:
    """Return a tuple of one value for each axis; a single value is repeated."""
    values = (value,) * n_axes if np.ndim(value) == 0 else tuple(value)
    if len(values) != n_axes:
        raise InputError(f"{quantity_name} must be one value, or one for each of the {n_axes} axes, got {value!r}")
    return values


@dataclass(frozen=True, eq=False)
class Lattice(metaclass=ListedType):
    """A piece of a crystal: cells along one, two or three vectors, each with the atoms of a basis.

    :func:`lattice` builds one. Every term of ``lt.magnetism``, and ``lt.SpinSystem``, accepts it in place of ``sites``.

    Attributes
    ----------
    vectors : array, shape (d, 3)
        Vectors of the cell (length).
    basis : array, shape (atoms, 3)
        Positions of the atoms of a cell (length).
    cells : tuple of int
        Number of cells along each vector.
    periodic : tuple of bool
        Whether each axis is periodic.
    images : bool
        Whether periodic images of a spin count as further neighbours.
    """

    vectors: np.ndarray
    basis: np.ndarray
    cells: tuple[int, ...]
    periodic: tuple[bool, ...]
    images: bool = False

    @property
    def sites(self) -> tuple[int, ...]:
        """Shape of the sites: the cells, and an axis for the atoms of a cell if there are several."""
        return self.cells if len(self.basis) == 1 else (*self.cells, len(self.basis))

    @property
    def site_count(self) -> int:
        """Number of sites."""
        return math.prod(self.sites)

    @property
    def cell_volume(self) -> float:
        """Volume, area or length of a cell."""
        return float(np.sqrt(np.linalg.det(self.vectors @ self.vectors.T)))

    @property
    def reciprocal_vectors(self) -> np.ndarray:
        """Vectors b_i with ``a_i . b_j = 2 pi delta_ij`` in the span of the vectors, shape (d, 3)."""
        return 2.0 * np.pi * np.linalg.pinv(self.vectors).T

    @property
    def positions(self) -> np.ndarray:
        """Positions of the sites (length), shape ``(*sites, 3)``."""
        cell_positions = np.indices(self.cells).reshape(len(self.cells), -1).T @ self.vectors
        return (cell_positions[:, None, :] + self.basis).reshape(*self.sites, 3)

    def check_basis(self) -> None:
        """Raise InputError if two atoms have one position."""
        if len(self.basis) > 1:
            fractions = (self.basis[:, None] - self.basis) @ np.linalg.pinv(self.vectors)
            nearest = self.basis[:, None] - self.basis - np.round(fractions) @ self.vectors
            distances = np.linalg.norm(nearest, axis=-1) + np.diag(np.full(len(self.basis), np.inf))
            a, b = np.unravel_index(np.argmin(distances), distances.shape)
            if distances[a, b] <= SHELL_TOLERANCE * np.linalg.norm(self.vectors, axis=1).min():
                raise InputError(f"the atoms {a} and {b} of the basis are at one position of the crystal")

    def bonds(self, pairs: Sequence[tuple]) -> Bonds:
        """Return the bonds of each ``(a, b, offset)``: atom a of every cell with atom b of the cell ``offset`` away.

        Parameters
        ----------
        pairs : sequence of tuples
            ``(a, b, offset)``, with an offset of d integers; or an offset alone, for a lattice with one atom in a cell.
            Each bond is given once, not in both directions.

        Returns
        -------
        Bonds

        Raises
        ------
        InputError
        """
        axes, rows = len(self.cells), []
        if isinstance(pairs, str) or not np.iterable(pairs):
            raise InputError(f"pairs must be a sequence of bonds (a, b, offset), or of offsets, got {pairs!r}")
        for pair in pairs:
            a, b, offset = pair if _has_atom_indices(pair) else (0, 0, pair)
            offset = tuple(np.atleast_1d(offset).tolist())
            if len(offset) != axes or not all(_is_integral(o) for o in offset):
                raise InputError(f"the offset of a bond must have {axes} integers, got {offset}")
            if not all(_is_integral(atom) and 0 <= atom < len(self.basis) for atom in (a, b)):
                raise InputError(f"a bond must join two of the {len(self.basis)} atoms of a cell, got {a} and {b}")
            row = (int(a), int(b), *map(int, offset))
            if row in rows or _reversed_bond_row(row) in rows:
                raise InputError(f"the bond {pair} is given twice. Give each bond once, in one direction")
            rows.append(row)
        if not rows:
            raise InputError("a list of bonds must not be empty")
        return Bonds.from_rows(self, rows)

    def neighbours(self, distance: float) -> Bonds:
        """Return all bonds up to a distance (length)."""
        distance = _checked_length(distance, "the distance of neighbours")
        rows = self._bond_rows_within(float(distance) * (1.0 + SHELL_TOLERANCE))
        if not rows:
            raise InputError(f"no two sites of the lattice are at a distance of at most {distance:g}")
        return Bonds.from_rows(self, rows)

    def shells(self, count: int) -> tuple[Bonds, ...]:
        """Return the bonds of the nearest ``count`` shells of neighbours, which are those of an infinite crystal.

        In a crystal with a basis, a shell is a set of all bonds of one length.
        """
        if not is_integer(count) or count < 1:
            raise InputError(f"the number of shells must be a positive integer, got {count!r}")
        return _nearest_shells(self, int(count))

    def shell(self, number: int) -> Bonds:
        """Return the bonds of one shell: 1 for nearest neighbours, 2 for next-nearest neighbours."""
        return self.shells(number)[-1]

    def _bond_rows_within(self, distance: float) -> list[tuple[int, ...]]:
        """Return the bonds up to a distance as rows ``(a, b, *offset)``, each in one direction."""
        inverse = np.linalg.pinv(self.vectors)
        rows = []
        for a, b in np.ndindex(len(self.basis), len(self.basis)):
            if a > b:
                continue
            shift = self.basis[b] - self.basis[a]
            # |o_i| = |(r - shift) . g_i| <= (|r| + |shift|) |g_i|
            reach = np.ceil((distance + np.linalg.norm(shift)) * np.linalg.norm(inverse, axis=0)).astype(int)
            offsets = np.stack(np.meshgrid(*(np.arange(-r, r + 1) for r in reach), indexing="ij"), axis=-1)
            offsets = offsets.reshape(-1, len(reach))
            if a == b:  # of each two opposite offsets the one whose first component that is not 0 is positive
                leading = np.take_along_axis(offsets, np.argmax(offsets != 0, axis=1)[:, None], axis=1)[:, 0]
                offsets = offsets[leading > 0]
            lengths = np.linalg.norm(offsets @ self.vectors + shift, axis=1)
            rows += [(a, b, *offset) for offset in offsets[lengths <= distance].tolist()]
        return rows


@functools.lru_cache(maxsize=64)
def _nearest_shells(lattice: Lattice, count: int) -> tuple[Bonds, ...]:
    """Return the bonds of the nearest shells of neighbours of a lattice, cached."""
    distance = float(np.linalg.norm(lattice.vectors, axis=1).max())
    while True:
        bonds = Bonds.from_rows(lattice, lattice._bond_rows_within(distance))
        lengths = np.linalg.norm(bonds.vectors, axis=1)
        order = np.argsort(lengths, kind="stable")
        is_new_shell = np.diff(lengths[order]) > SHELL_TOLERANCE * lengths[order][:-1]
        # the last shell may be cut by rounding of the distance
        groups = np.split(order, np.nonzero(is_new_shell)[0] + 1)[:-1]
        if len(groups) >= count:
            return tuple(bonds.subset(np.sort(group)) for group in groups[:count])
        distance *= 1.5


def _is_integral(value) -> bool:
    """Return whether a value is a real number that is an integer."""
    return isinstance(value, int | float | np.integer | np.floating) and float(value).is_integer()


def _has_atom_indices(pair) -> bool:
    """Return whether a bond is given as ``(a, b, offset)``, and not as an offset alone."""
    return isinstance(pair, tuple | list) and len(pair) == 3 and np.ndim(pair[2]) == 1


def _reversed_bond_row(row: tuple[int, ...]) -> tuple[int, ...]:
    """Return the row ``(b, a, *-offset)`` of a bond ``(a, b, *offset)`` read from its other end."""
    a, b, *offset = row
    return (b, a, *(-o for o in offset))


@dataclass(frozen=True, eq=False)
class Bonds:
    """Bonds of a lattice: one in every cell for each row, as far as both ends exist.

    Attributes
    ----------
    lattice : Lattice
        The lattice of the sites.
    first, second : array of int, shape (m,)
        Atoms of the basis at both ends.
    offsets : array of int, shape (m, d)
        Offset of the cell of the second end.
    """

    lattice: Lattice
    first: np.ndarray
    second: np.ndarray
    offsets: np.ndarray

    @classmethod
    def from_rows(cls, lattice: Lattice, rows) -> Bonds:
        """Return bonds from rows ``(a, b, *offset)``."""
        table = np.array(rows, dtype=int).reshape(-1, 2 + len(lattice.cells))
        return cls(lattice, table[:, 0], table[:, 1], table[:, 2:])

    def subset(self, indices) -> Bonds:
        """Return some of the bonds, by index or by a mask."""
        return Bonds(self.lattice, self.first[indices], self.second[indices], self.offsets[indices])

    def __len__(self) -> int:
        return len(self.first)

    @property
    def vectors(self) -> np.ndarray:
        """Vectors from the first to the second end (length), shape (m, 3)."""
        basis = self.lattice.basis
        return self.offsets @ self.lattice.vectors + basis[self.second] - basis[self.first]

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors from the first to the second end, shape (m, 3)."""
        return self.vectors / np.linalg.norm(self.vectors, axis=1, keepdims=True)

    @property
    def distance(self) -> float:
        """Length of the longest bond; in a shell all bonds have this length up to rounding."""
        return float(np.linalg.norm(self.vectors, axis=1).max())

    @property
    def coordination(self) -> float:
        """Mean number of bonds at an atom inside the crystal; an integer where it is one."""
        mean = 2 * len(self) / len(self.lattice.basis)
        return int(mean) if mean == int(mean) else mean

    def presence(self, number: int) -> np.ndarray:
        """Return in which cells a bond exists, shape of the cells; across an open border there is none."""
        cells, periodic = self.lattice.cells, self.lattice.periodic
        result = np.ones(cells, dtype=bool)
        for axis, (n, shift, is_periodic) in enumerate(zip(cells, self.offsets[number], periodic, strict=True)):
            ends = np.arange(n) + shift
            is_inside = np.ones(n, dtype=bool) if is_periodic else (ends >= 0) & (ends < n)
            result = result & is_inside.reshape([-1 if a == axis else 1 for a in range(len(cells))])
        return result

    def check_pairs(self) -> None:
        """Raise InputError if a bond joins a spin with itself, or two bonds join one pair, unless images count."""
        if self.lattice.images:
            return
        cells, bond_by_pair = self.lattice.cells, {}
        for number, (a, b, offset) in enumerate(zip(self.first, self.second, self.offsets, strict=True)):
            if not self.presence(number).any():
                continue
            wrapped_offset = tuple(
                int(o) % n if is_periodic else int(o)
                for o, n, is_periodic in zip(offset, cells, self.lattice.periodic, strict=True)
            )
            opposite = tuple(
                -o % n if is_periodic else -o
                for o, n, is_periodic in zip(wrapped_offset, cells, self.lattice.periodic, strict=True)
            )
            key, reverse = (int(a), int(b), wrapped_offset), (int(b), int(a), opposite)
            if key == reverse or key in bond_by_pair or reverse in bond_by_pair:
                problem = "a spin with itself" if a == b and not any(wrapped_offset) else "a pair of spins twice"
                raise InputError(
                    f"the bond ({a}, {b}, {tuple(offset.tolist())}) joins {problem}, because the lattice of {cells} "
                    "cells is periodic and short. Use more cells, periodic=False along the short axis, or images=True "
                    "to count periodic images as neighbours"
                )
            bond_by_pair[key] = number

    def site_pairs(self) -> np.ndarray:
        """Return the pairs of sites that are joined, numbered in C order, shape (bonds, 2)."""
        self.check_pairs()
        cells, atoms = self.lattice.cells, len(self.lattice.basis)
        numbers = np.arange(math.prod(cells)).reshape(cells)
        pairs = []
        for number, (a, b, offset) in enumerate(zip(self.first, self.second, self.offsets, strict=True)):
            ends = np.roll(numbers, -offset, axis=tuple(range(len(cells))))
            mask = self.presence(number)
            pairs.append(np.stack([numbers[mask] * atoms + a, ends[mask] * atoms + b], axis=1))
        return np.concatenate(pairs)
