"""Micromagnetic energies on rectangular cells: exchange, Dzyaloshinskii-Moriya interaction and demagnetising field.

Spins are the unit vectors m of the magnetisation in each cell. Anisotropies and fields are those of ``lt.magnetism``,
with constants times the volume of a cell.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ...errors import InputError
from ..conditions import checked_host_numbers, checked_numbers
from ..energy import Energy
from .bond_terms import crystal_antisymmetric_exchange, crystal_exchange
from .dipoles import FourierKernel, padded_length, pair_interaction_energy
from .lattices import Bonds, Lattice, lattice
from .newell import demagnetising_tensors, mirror_octant
from .spin_energy import check_finite, checked_site_values
from .units import MAGNETIC_CONSTANT


def mesh(cells, size, periodic=False) -> Lattice:
    """Return a mesh of equal rectangular cells, a lattice with one spin in the middle of each cell.

    Parameters
    ----------
    cells : tuple of three int
        Number of cells along x, y and z.
    size : float, or tuple of three floats
        Edges of a cell (length), not of the whole mesh.
    periodic : bool or tuple of bool
        Whether the mesh is periodic, along each axis.

    Returns
    -------
    Lattice

    Raises
    ------
    InputError

    Examples
    --------
    >>> film = lt.magnetism.mesh((100, 25, 1), (5e-9, 5e-9, 3e-9))
    >>> film.sites, film.positions[0, 0, 0].tolist()
    ((100, 25, 1), [2.5e-09, 2.5e-09, 1.5e-09])
    """
    edges = checked_host_numbers(size, "the edges of a mesh")
    edges = np.broadcast_to(edges, (3,)) if edges.shape in ((), (3,)) else np.zeros(3)
    if not (edges > 0.0).all() or np.ndim(cells) != 1 or len(cells) != 3:
        raise InputError(
            f"a mesh must have three numbers of cells and one or three positive edges, got {cells}, {size}"
        )
    return lattice(np.diag(edges), cells, periodic=periodic, basis=[edges / 2.0])


def continuum_exchange(cells: Lattice, stiffness) -> Energy:
    """Return the exchange energy ``int A |grad m|^2`` of a mesh, up to a constant.

    Neighbours i, j at a distance d contribute ``-(2 A V / d^2) m_i . m_j``. At open borders the derivative of m along
    the normal is zero.

    Parameters
    ----------
    cells : Lattice
        A :func:`mesh`.
    stiffness : float, or array of the shape of the cells
        A (energy / length), 13e-12 J / m in permalloy. Between different cells it is the harmonic mean.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    bonds, edges = _axis_bonds_and_edges(cells)
    A = checked_site_values(stiffness, cells.sites, (), "an exchange stiffness")
    factors = 2.0 * cells.cell_volume / edges**2
    if not A.ndim:
        return crystal_exchange(bonds, factors * A)
    ends = jnp.stack([jnp.roll(A, -offset, axis=(0, 1, 2)) for offset in bonds.offsets])
    total = A + ends
    means = jnp.where(total > 0.0, 2.0 * A * ends / jnp.where(total > 0.0, total, 1.0), 0.0)
    return crystal_exchange(bonds, factors[:, None, None, None] * means)


def continuum_antisymmetric_exchange(cells: Lattice, constant, kind: str = "interfacial") -> Energy:
    """Return the Dzyaloshinskii-Moriya energy of cells, with the sign conventions of mumax3 and OOMMF.

    Parameters
    ----------
    cells : Lattice
        A :func:`mesh`.
    constant : float
        D (energy / length**2).
    kind : str
        "interfacial": ``int D [m_z div m - (m . grad) m_z]``; "bulk": ``int D m . curl m``.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    D = check_finite(checked_numbers(constant, "a Dzyaloshinskii-Moriya constant", ()), "a constant")
    bonds, edges = _axis_bonds_and_edges(cells)
    if kind == "interfacial":
        directions = np.cross([0.0, 0.0, 1.0], bonds.directions)
    elif kind == "bulk":
        directions = -bonds.directions
    else:
        raise InputError(f'kind must be "interfacial" or "bulk", got {kind!r}')
    return crystal_antisymmetric_exchange(bonds, D * (cells.cell_volume / edges)[:, None] * directions)


def demagnetisation(cells: Lattice, saturation, constant: float = MAGNETIC_CONSTANT) -> Energy:
    """Return the energy of the demagnetising field, ``mu_0 / 2 sum V M_i . N(r_i - r_j) M_j``, by Fourier transforms.

    N is the tensor of uniformly magnetised cells [Newell, Williams & Dunlop 1993], of trace 1 for one cell.

    Parameters
    ----------
    cells : Lattice
        A :func:`mesh` with open borders.
    saturation : float, or array of the shape of the cells
        \\|M\\| (A / m).
    constant : float
        mu_0, in the units of energy, length and magnetisation.

    Returns
    -------
    Energy

    Raises
    ------
    InputError

    Examples
    --------
    >>> cube = lt.magnetism.mesh((1, 1, 1), 1.0)
    >>> energy = lt.magnetism.demagnetisation(cube, 1.0, constant=1.0)
    >>> round(float(energy([0.0, 0.0, 1.0])), 12)  # half of 1 / 3
    0.166666666667
    """
    edges = _checked_cell_edges(cells)
    if any(cells.periodic):
        raise InputError("the demagnetising field of periodic cells is not available. Use periodic=False")
    padded_cells = tuple(padded_length(n, False) for n in cells.cells)
    tensors = mirror_octant(demagnetising_tensors(cells.cells, edges), padded_cells)
    kernel = FourierKernel.from_tensors(tensors[:, None, None], cells.cells)
    M = checked_site_values(saturation, cells.sites, (), "a saturation magnetisation")
    strength = checked_numbers(constant, "the magnetic constant", ()) * cells.cell_volume
    return pair_interaction_energy(cells.sites, 3, kernel, M, strength)


def demagnetising_factors(edges) -> np.ndarray:
    """Return the demagnetising factors of a rectangular prism, shape (3,), of sum 1.

    Parameters
    ----------
    edges : array, shape (3,)
        Edges of the prism along x, y and z (length).

    Returns
    -------
    array, shape (3,)

    Examples
    --------
    >>> lt.magnetism.demagnetising_factors((1.0, 1.0, 1.0)).round(6).tolist()
    [0.333333, 0.333333, 0.333333]
    """
    size = np.asarray(checked_numbers(edges, "the edges of a prism", (3,)))
    if not ((size > 0.0) & np.isfinite(size)).all():
        raise InputError(f"the edges of a prism must be positive and finite, got {size.tolist()}")
    return demagnetising_tensors((1, 1, 1), size)[[0, 3, 5], 0, 0, 0]


def _checked_cell_edges(mesh: Lattice) -> np.ndarray:
    """Return the edges of the cells of a mesh, shape (3,); raise InputError unless the cells are rectangular."""
    if not isinstance(mesh, Lattice) or len(mesh.cells) != 3 or len(mesh.basis) != 1:
        raise InputError("cells must be those of lt.magnetism.mesh")
    edges = np.diag(mesh.vectors)
    if not np.array_equal(mesh.vectors, np.diag(edges)) or not (edges > 0.0).all():
        raise InputError("cells must be rectangular, as those of lt.magnetism.mesh")
    return edges


def _axis_bonds_and_edges(cells: Lattice) -> tuple[Bonds, np.ndarray]:
    """Return the bonds along each axis with more than one cell, and the lengths of the cells along them."""
    edges = _checked_cell_edges(cells)
    axes = [axis for axis, n in enumerate(cells.cells) if n > 1] or [0]
    offsets = np.eye(3, dtype=int)[axes].tolist()
    return cells.bonds([tuple(offset) for offset in offsets]), edges[axes]
