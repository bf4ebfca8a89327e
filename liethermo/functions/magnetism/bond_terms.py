"""Energies of the bonds of a crystal: exchange by shell, exchange tensors, antisymmetric and biquadratic exchange."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds.structures.spins import Lattice as PeriodicSpins
from manifolds.structures.spins import (
    VectorComponents,
    add_vectors,
    dot_vectors,
    scale_vectors,
    sum_of_dots,
)

from ...errors import InputError
from ..conditions import checked_numbers
from ..energy import Energy, Sum
from ..indices import clique_pattern
from .lattices import Bonds, Lattice
from .spin_energy import SpinEnergy, bond_component_indices, checked_finite_numbers


def exchange_tensor(bonds, tensors) -> Energy:
    """Return the bilinear exchange ``-sum s_i . J_ij s_j`` with a matrix J_ij for each bond; each pair counts once.

    The matrix has a symmetric part, which is an anisotropic exchange, and an antisymmetric part. A
    Dzyaloshinskii-Moriya vector D is the matrix J with ``J_xy = -J_yx = -D_z``, and cyclic permutations.

    Parameters
    ----------
    bonds : Lattice or Bonds
        Nearest neighbours of a lattice, or bonds such as ``lattice.shell(2)``; s_i is the first end of a bond.
    tensors : array, shape (3, 3), (m, 3, 3) or ``(m, *cells, 3, 3)``
        J_ij (energy): one for all bonds, one for each of the m bonds of a cell, or one for each bond of every cell.

    Returns
    -------
    Energy

    Raises
    ------
    InputError

    Examples
    --------
    >>> chain = lt.magnetism.lattice("chain", 8)
    >>> ising = lt.magnetism.exchange_tensor(chain, np.diag([0.0, 0.0, 1.0]))
    >>> float(ising(np.tile([0.0, 0.0, 1.0], 8)))
    -8.0
    """
    return _bond_matrix_energy(_checked_bonds(bonds), tensors, -1.0, "an exchange tensor")


def biquadratic(bonds, strength=1.0) -> Energy:
    """Return the biquadratic exchange ``-sum B_ij (s_i . s_j)^2``: B > 0 aligns neighbours parallel or antiparallel.

    Parameters
    ----------
    bonds : Lattice or Bonds
        Nearest neighbours of a lattice, or bonds such as ``lattice.shell(2)``.
    strength : float, or array, shape (m,) or ``(m, *cells)``
        B_ij (energy); each pair counts once.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    bonds = _checked_bonds(bonds)
    values = _bond_values(bonds, strength, (), "a biquadratic constant")
    lattice = bonds.lattice
    return BiquadraticEnergy(lattice.sites, lattice.cells, _atoms_and_offset_rows(bonds), tuple(values))


def crystal_exchange(lattice_or_bonds: Lattice | Bonds, strength) -> Energy:
    """Return the Heisenberg exchange of bonds, or of shells of a lattice; see ``magnetism.exchange``."""
    if isinstance(lattice_or_bonds, Bonds):
        return _scalar_exchange(lattice_or_bonds, strength)
    if isinstance(strength, Mapping):
        if not strength:
            raise InputError("a mapping from shells to exchange constants must not be empty")
        shells = [lattice_or_bonds.shell(number) for number in strength]
        _check_pairs_of_shells(lattice_or_bonds, shells)
        return Sum.from_terms([_scalar_exchange(shell, J) for shell, J in zip(shells, strength.values(), strict=True)])
    if isinstance(strength, list | tuple):
        if not strength:
            raise InputError("a list of exchange constants, one for each shell, must not be empty")
        shells = list(lattice_or_bonds.shells(len(strength)))
        _check_pairs_of_shells(lattice_or_bonds, shells)
        return Sum.from_terms([_scalar_exchange(shell, J) for shell, J in zip(shells, strength, strict=True)])
    return _scalar_exchange(lattice_or_bonds.shell(1), strength)


def _check_pairs_of_shells(lattice: Lattice, shells: list[Bonds]) -> None:
    """Raise InputError if bonds of two shells join one pair on a short periodic axis, unless images count."""
    parts = [(shell.first, shell.second, shell.offsets) for shell in shells]
    first, second, offsets = (np.concatenate(values) for values in zip(*parts, strict=True))
    Bonds(lattice, first, second, offsets).check_pairs()


def _scalar_exchange(bonds: Bonds, strength) -> Energy:
    """Return the Heisenberg exchange of bonds, with one constant or one for each bond."""
    bonds.check_pairs()
    value = checked_finite_numbers(strength, "an exchange constant")
    cells = bonds.lattice.cells
    if not value.ndim and all(bonds.presence(k).all() for k in range(len(bonds))):
        return CrystalExchange(bonds.lattice.sites, cells, _atoms_and_offset_rows(bonds), value)
    J = _bond_values(bonds, strength, (), "an exchange constant")
    return CrystalExchange(bonds.lattice.sites, cells, _atoms_and_offset_rows(bonds), tuple(J))


def crystal_antisymmetric_exchange(lattice_or_bonds: Lattice | Bonds, vectors) -> Energy:
    """Return the Dzyaloshinskii-Moriya interaction of bonds; see ``magnetism.dzyaloshinskii_moriya``."""
    vector_name = "a Dzyaloshinskii-Moriya vector"
    bonds, D = _checked_bonds(lattice_or_bonds), checked_numbers(vectors, vector_name)
    if D.shape[-1:] != (3,):
        raise InputError(f"{vector_name} must have shape (3,), (m, 3) or (m, *cells, 3), got {D.shape}")
    # D . (u x v) = u . A v
    zero = jnp.zeros_like(D[..., 0])
    rows = [[zero, D[..., 2], -D[..., 1]], [-D[..., 2], zero, D[..., 0]], [D[..., 1], -D[..., 0], zero]]
    return _bond_matrix_energy(bonds, jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2), 1.0, vector_name)


def refuse_grid_arguments(neighbours, periodic, images: bool) -> None:
    """Raise InputError if arguments of simple lattices are given for a lattice that has its own."""
    if neighbours is not None or periodic is not True or images:
        raise InputError(
            "neighbours=, periodic= and images= belong to sites given as integers. Give them to lt.magnetism.lattice, "
            "and bonds such as lattice.shell(2) in place of neighbours="
        )


def _checked_bonds(lattice_or_bonds) -> Bonds:
    """Return bonds, or those of nearest neighbours of a lattice; InputError for other objects and for double bonds."""
    if not isinstance(lattice_or_bonds, Lattice | Bonds):
        raise InputError(
            f"bonds must be those of lt.magnetism.lattice, or a lattice, got {type(lattice_or_bonds).__name__}"
        )
    bonds = lattice_or_bonds.shell(1) if isinstance(lattice_or_bonds, Lattice) else lattice_or_bonds
    bonds.check_pairs()
    return bonds


def _atoms_and_offset_rows(bonds: Bonds) -> tuple[tuple[int, ...], ...]:
    """Return a tuple (first atom, second atom, *offset) of integers for each bond."""
    rows = np.column_stack([bonds.first, bonds.second, bonds.offsets]).tolist()
    return tuple(map(tuple, rows))


def _bond_values(bonds: Bonds, values, value_shape: tuple[int, ...], quantity_name: str) -> list[jax.Array]:
    """Return a list with the values of each bond, checked.

    They have shape ``value_shape``, or ``(*cells, *value_shape)`` where they vary between cells; they are 0 in cells
    without the bond.
    """
    array = checked_finite_numbers(values, quantity_name)
    count, cells = len(bonds), bonds.lattice.cells
    shapes = value_shape, (count, *value_shape), (count, *cells, *value_shape)
    if array.shape not in shapes:
        raise InputError(
            f"{quantity_name} of {count} bonds must have shape {' or '.join(map(str, shapes))}, got {array.shape}"
        )
    bond_values = []
    for number in range(count):
        bond_value = array if array.shape == value_shape else array[number]
        presence = bonds.presence(number)
        if not presence.all():
            bond_value = jnp.where(presence.reshape(*cells, *(1 for _ in value_shape)), bond_value, 0.0)
        bond_values.append(bond_value)
    return bond_values


def _bond_matrix_energy(bonds: Bonds, matrices, sign: float, quantity_name: str) -> Energy:
    """Return the energy ``sign sum s_i . M_ij s_j`` over bonds, with checked matrices."""
    values = _bond_values(bonds, matrices, (3, 3), quantity_name)
    lattice = bonds.lattice
    return BondMatrixEnergy(
        lattice.sites, lattice.cells, _atoms_and_offset_rows(bonds), tuple(sign * value for value in values)
    )


class CrystalBondEnergy(SpinEnergy):
    """Base class of energies of the bonds of a crystal.

    Attributes
    ----------
    cells : tuple of int
    rows : tuple of tuples of int
        Atoms of both ends and offset of the cell of the second, for each bond of a cell.
    """

    cells: tuple[int, ...] = eqx.field(static=True)
    rows: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def interaction_range(self) -> tuple[int, ...]:
        ranges = np.abs(np.array([row[2:] for row in self.rows])).max(axis=0).tolist()
        return (*ranges, *(0,) * (len(self.sites) - len(self.cells)))

    @property
    def _has_basis(self) -> bool:
        return len(self.sites) > len(self.cells)

    def _spins_of_atom(self, spins: VectorComponents, atom: int) -> VectorComponents:
        """Return the spins of one atom of the basis in all cells, shape of the cells."""
        if not self._has_basis:
            return spins
        a, b, c = (component[..., atom] for component in spins)
        return a, b, c

    def _spins_of_atom_in_shifted_cells(
        self, shifted_cache: dict, spins: PeriodicSpins, atom: int, offset
    ) -> VectorComponents:
        """Return the spins of one atom in the cells at an offset from each cell, shape of the cells.

        ``shifted_cache`` caches shifted lattices by their offset.
        """
        offset = tuple(offset)
        if offset not in shifted_cache:
            shifted_cache[offset] = (
                spins.at((*offset, *(0,) * (len(self.sites) - len(self.cells)))) if any(offset) else (spins.site_spins)
            )
        return self._spins_of_atom(shifted_cache[offset], atom)

    def _join_vectors_of_atoms(self, vectors_by_atom: dict[int, VectorComponents]) -> VectorComponents:
        """Return vectors on the shape of the sites from the vectors of each atom of the basis; zero for other atoms."""
        if not self._has_basis:
            return vectors_by_atom[0]
        zero = jnp.zeros(self.cells)
        atoms = [vectors_by_atom.get(atom, (zero, zero, zero)) for atom in range(self.sites[-1])]
        a, b, c = (jnp.stack([vectors[axis] for vectors in atoms], axis=-1) for axis in range(3))
        return a, b, c

    def _shift_cells(self, value, offset, n_trailing_axes: int = 0):
        """Return values on the cells shifted by an offset; values that are equal in all cells are returned unchanged.

        The last ``n_trailing_axes`` axes hold the value of one cell.
        """
        return value if value.ndim == n_trailing_axes else jnp.roll(value, offset, axis=tuple(range(len(self.cells))))

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        atoms = self.sites[-1] if self._has_basis else 1
        numbers = np.arange(int(np.prod(self.cells))).reshape(self.cells)
        members = []
        for a, b, *offset in self.rows:
            ends = np.roll(numbers, [-o for o in offset], axis=tuple(range(len(self.cells))))
            members.append(bond_component_indices(numbers.ravel() * atoms + a, ends.ravel() * atoms + b))
        return clique_pattern(np.concatenate(members), dim)


class CrystalExchange(CrystalBondEnergy):
    """Heisenberg exchange of the bonds of a crystal.

    Attributes
    ----------
    J : array, shape (), or tuple of arrays, each of shape () or that of the cells
        One constant for all bonds, or one for each.
    """

    J: jax.Array | tuple[jax.Array, ...]

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        shifted_cache: dict = {}
        total: dict[int, VectorComponents] = {}
        for number, (a, b, *offset) in enumerate(self.rows):
            neighbour = self._spins_of_atom_in_shifted_cells(shifted_cache, spins, b, offset)
            _add_to_atom(total, a, scale_vectors(self.J[number], neighbour) if isinstance(self.J, tuple) else neighbour)
        energy = sum(
            (sum_of_dots(self._spins_of_atom(spins.site_spins, a), vectors) for a, vectors in total.items()),
            jnp.zeros(()),
        )
        return -energy if isinstance(self.J, tuple) else -self.J * energy

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        shifted_cache: dict = {}
        total: dict[int, VectorComponents] = {}
        for number, (a, b, *offset) in enumerate(self.rows):
            spin_ahead = self._spins_of_atom_in_shifted_cells(shifted_cache, spins, b, offset)
            spin_behind = self._spins_of_atom_in_shifted_cells(shifted_cache, spins, a, [-o for o in offset])
            if isinstance(self.J, tuple):
                J = self.J[number]
                spin_ahead, spin_behind = (
                    scale_vectors(J, spin_ahead),
                    scale_vectors(self._shift_cells(J, offset), spin_behind),
                )
            _add_to_atom(total, a, spin_ahead)
            _add_to_atom(total, b, spin_behind)
        return scale_vectors(-1.0 if isinstance(self.J, tuple) else -self.J, self._join_vectors_of_atoms(total))

    def multiple(self, factor) -> Energy:
        J = tuple(factor * value for value in self.J) if isinstance(self.J, tuple) else factor * self.J
        return CrystalExchange(self.sites, self.cells, self.rows, J)


class BondMatrixEnergy(CrystalBondEnergy):
    """The energy ``sum s_i . M_ij s_j`` over the bonds of a crystal.

    Attributes
    ----------
    matrices : tuple of arrays, shape (3, 3) or ``(*cells, 3, 3)``
        M of each bond.
    """

    matrices: tuple[jax.Array, ...]

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        shifted_cache: dict = {}
        energy = jnp.zeros(())
        for M, (a, b, *offset) in zip(self.matrices, self.rows, strict=True):
            neighbour = _matrix_times(M, self._spins_of_atom_in_shifted_cells(shifted_cache, spins, b, offset))
            energy = energy + sum_of_dots(self._spins_of_atom(spins.site_spins, a), neighbour)
        return energy

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        shifted_cache: dict = {}
        total: dict[int, VectorComponents] = {}
        for M, (a, b, *offset) in zip(self.matrices, self.rows, strict=True):
            transpose = jnp.swapaxes(self._shift_cells(M, offset, 2), -1, -2)
            _add_to_atom(
                total, a, _matrix_times(M, self._spins_of_atom_in_shifted_cells(shifted_cache, spins, b, offset))
            )
            spin_behind = self._spins_of_atom_in_shifted_cells(shifted_cache, spins, a, [-o for o in offset])
            _add_to_atom(total, b, _matrix_times(transpose, spin_behind))
        return self._join_vectors_of_atoms(total)

    def multiple(self, factor) -> Energy:
        return BondMatrixEnergy(self.sites, self.cells, self.rows, tuple(factor * M for M in self.matrices))


class BiquadraticEnergy(CrystalBondEnergy):
    """The energy ``-sum B_ij (s_i . s_j)^2`` over the bonds of a crystal.

    Attributes
    ----------
    B : tuple of arrays, each of shape () or that of the cells
    """

    B: tuple[jax.Array, ...]

    @property
    def is_quadratic(self) -> bool:
        return False

    @property
    def degree(self) -> float:
        return 4.0

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        shifted_cache: dict = {}
        energy = jnp.zeros(())
        for B, (a, b, *offset) in zip(self.B, self.rows, strict=True):
            cosine = dot_vectors(
                self._spins_of_atom(spins.site_spins, a),
                self._spins_of_atom_in_shifted_cells(shifted_cache, spins, b, offset),
            )
            energy = energy - jnp.sum(B * cosine**2)
        return energy

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        shifted_cache: dict = {}
        total: dict[int, VectorComponents] = {}
        for B, (a, b, *offset) in zip(self.B, self.rows, strict=True):
            first_spin, second_spin = self._spins_of_atom(spins.site_spins, a), self._spins_of_atom(spins.site_spins, b)
            spin_ahead = self._spins_of_atom_in_shifted_cells(shifted_cache, spins, b, offset)
            spin_behind = self._spins_of_atom_in_shifted_cells(shifted_cache, spins, a, [-o for o in offset])
            _add_to_atom(total, a, scale_vectors(-2.0 * B * dot_vectors(first_spin, spin_ahead), spin_ahead))
            B_behind = self._shift_cells(B, offset)
            _add_to_atom(total, b, scale_vectors(-2.0 * B_behind * dot_vectors(second_spin, spin_behind), spin_behind))
        return self._join_vectors_of_atoms(total)

    def multiple(self, factor) -> Energy:
        return BiquadraticEnergy(self.sites, self.cells, self.rows, tuple(factor * B for B in self.B))


def _add_to_atom(totals_by_atom: dict[int, VectorComponents], atom: int, vectors: VectorComponents) -> None:
    """Add vectors to the total of an atom, in place."""
    totals_by_atom[atom] = add_vectors(totals_by_atom[atom], vectors) if atom in totals_by_atom else vectors


def _matrix_times(M, v: VectorComponents) -> VectorComponents:
    """Return the product of matrices, shape (..., 3, 3), with vectors by components."""
    a, b, c = (M[..., i, 0] * v[0] + M[..., i, 1] * v[1] + M[..., i, 2] * v[2] for i in range(3))
    return a, b, c
