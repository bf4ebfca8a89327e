"""Dipolar energies of spins: all pairs of a few spins, and lattices by fast Fourier transforms.

A dipolar energy is the quadratic form ``1/2 sum_ij s_i . T(r_i - r_j) s_j``. On a lattice it is a convolution. Along
open axes the spins are padded with zeros to twice the length; along periodic axes the tensor is the sum over all images
[Ewald 1921; Parry 1975].
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module
from manifolds.structures.spins import Lattice as PeriodicSpins
from manifolds.structures.spins import VectorComponents, sum_of_dots

from ...errors import InputError
from ..energy import Energy
from .ewald import COMPONENTS, dipole_tensor, ewald_kernel, transform_axes
from .lattices import Lattice
from .spin_energy import SpinEnergy, checked_finite_numbers, checked_site_values


def dipoles(positions, moment=1.0, strength=1.0, boundary: str = "tin foil") -> Energy:
    """Return the dipolar energy ``strength sum_{i<j} mu_i mu_j [s_i . s_j - 3 (s_i . e)(s_j . e)] / r^3``.

    r is the distance of two spins, and e the unit vector between them. On a lattice the cost of a gradient is that of
    fast Fourier transforms, O(N log N); for positions it is O(N^2).

    Parameters
    ----------
    positions : Lattice, or array, shape (N, 3)
        A lattice with open or periodic axes; or the positions of a few spins (length).
    moment : float, or array of the shape of the sites
        mu_i.
    strength : float
        ``mu_0 / 4 pi`` in the units of energy, length and moment: see ``lt.magnetism.units(...).dipole_constant``.
    boundary : str
        Surroundings of a lattice with three periodic axes: "tin foil", without a depolarising field, or "vacuum", for
        a large sphere in vacuum, with the depolarising field -M / 3.

    Returns
    -------
    Energy

    Raises
    ------
    InputError

    Examples
    --------
    >>> pair = lt.magnetism.dipoles([(0.0, 0.0, 0.0), (0.0, 0.0, 2.0)])
    >>> float(pair([0.0, 0.0, 1.0, 0.0, 0.0, 1.0]))  # head to tail, -2 / r^3
    -0.25
    """
    strength = checked_finite_numbers(strength, "the strength of dipoles", ())
    if boundary not in ("tin foil", "vacuum"):
        raise InputError(f'the boundary of dipoles must be "tin foil" or "vacuum", got {boundary!r}')
    if isinstance(positions, Lattice):
        moments = checked_site_values(moment, positions.sites, (), "a moment")
        kernel = dipolar_lattice_kernel(positions, boundary)
        return pair_interaction_energy(positions.sites, len(positions.cells), kernel, moments, strength)
    r = np.asarray(checked_finite_numbers(positions, "positions of dipoles"))
    if r.ndim != 2 or r.shape[1] != 3:
        raise InputError(f"positions of dipoles must have shape (N, 3), got {r.shape}")
    moments = checked_site_values(moment, (len(r),), (), "a moment")
    r_between = r[:, None] - r
    if (np.linalg.norm(r_between, axis=-1) + np.eye(len(r)) == 0.0).any():
        raise InputError("two dipoles must not have the same position")
    tensors = dipole_tensor(r_between)
    matrix = jnp.asarray(np.swapaxes(tensors, 1, 2).reshape(3 * len(r), 3 * len(r)))
    scale = jnp.repeat(jnp.broadcast_to(moments, (len(r),)), 3)
    return DipoleMatrix((len(r),), strength * scale[:, None] * matrix * scale)


MAX_MATRIX_SITES = 16
"""Number of sites up to which a lattice has a matrix of all pairs: the compiled engine has no Fourier transforms."""


def pair_interaction_energy(sites: tuple[int, ...], n_axes: int, kernel: FourierKernel, moments, strength) -> Energy:
    """Return the quadratic energy of all pairs of sites that interact by a kernel.

    It is computed by Fourier transforms or, for at most :data:`MAX_MATRIX_SITES` sites, by a matrix.
    """
    convolution_energy = ConvolutionEnergy(sites, n_axes, kernel, moments, strength)
    count = math.prod(sites)
    if count > MAX_MATRIX_SITES:
        return convolution_energy
    return DipoleMatrix(sites, jax.vmap(convolution_energy.gradient)(jnp.eye(3 * count)))


class DipoleMatrix(SpinEnergy):
    """The quadratic energy ``s . M s / 2`` of all pairs of spins.

    Attributes
    ----------
    matrix : array, shape (3 N, 3 N), symmetric
    """

    matrix: jax.Array

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        return 0.5 * sum_of_dots(self.lattice_gradients(spins), spins.site_spins)

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        gradient = (self.matrix @ jnp.stack(spins.site_spins, axis=-1).reshape(-1)).reshape(*self.sites, 3)
        return gradient[..., 0], gradient[..., 1], gradient[..., 2]

    def multiple(self, factor) -> Energy:
        return DipoleMatrix(self.sites, factor * self.matrix)


class ConvolutionEnergy(SpinEnergy):
    """The quadratic energy ``strength / 2 sum mu_i s_i . T(r_i - r_j) mu_j s_j``, computed by Fourier transforms.

    Attributes
    ----------
    axes : int
        Number of axes of the lattice, without that of the basis.
    kernel : array, shape (6, atoms, atoms, *transform)
        Real or complex Fourier transform of T on the padded lattice; the components xx, xy, xz, yy, yz, zz.
    moments : array, shape () or that of the sites
    strength : array, shape ()
    """

    axes: int = eqx.field(static=True)
    kernel: FourierKernel
    moments: jax.Array
    strength: jax.Array

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        return 0.5 * sum_of_dots(self.lattice_gradients(spins), spins.site_spins)

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        s = jnp.stack([self.moments * component for component in spins.site_spins])  # (3, *sites)
        has_basis = len(self.sites) > self.axes
        s = jnp.moveaxis(s, -1, 1) if has_basis else s[:, None]
        fields = self.kernel.convolve(s)
        fields = jnp.moveaxis(fields, 1, -1) if has_basis else fields[:, 0]
        fx, fy, fz = (self.moments * (self.strength * fields[i]) for i in range(3))
        return fx, fy, fz

    def multiple(self, factor) -> Energy:
        return ConvolutionEnergy(self.sites, self.axes, self.kernel, self.moments, factor * self.strength)


PAIR_INDEX = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Index of the entry (i, j) of a symmetric tensor among its six components xx, xy, xz, yy, yz, zz."""


class FourierKernel(Module):
    """The Fourier transform of a tensor on a padded lattice.

    Attributes
    ----------
    components : tuple of six arrays, shape (atoms, atoms, *transformed cells), real or complex
        The components xx, xy, xz, yy, yz, zz, in the order of axes of :meth:`_forward_transform`. They are arrays of
        their own, and real ones are not multiplied with complex modes: XLA would move slices or complex copies of them
        out of a loop, one for each use, and then compute equal fields for each use.
    cells, padded_cells : tuple of int
    """

    components: tuple[jax.Array, ...]
    cells: tuple[int, ...] = eqx.field(static=True)
    padded_cells: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def from_tensors(cls, tensors: np.ndarray, cells: tuple[int, ...]) -> FourierKernel:
        """Return the kernel of real tensors, shape (6, atoms, atoms, *padded cells)."""
        axes = [3 + axis for axis in transform_axes(tensors.shape[3:])]
        return cls.from_transform(np.fft.rfftn(tensors, axes=axes), cells, tensors.shape[3:])

    @classmethod
    def from_transform(
        cls, transform: np.ndarray, cells: tuple[int, ...], padded_cells: tuple[int, ...]
    ) -> FourierKernel:
        """Return the kernel of a transform, which is made real if each atom is a centre of inversion."""
        if np.abs(transform.imag).max() <= REAL_TOLERANCE * np.abs(transform).max():
            transform = transform.real
        transform = np.moveaxis(transform, 3 + transform_axes(padded_cells)[-1], 3)
        return cls(tuple(jnp.asarray(np.ascontiguousarray(part)) for part in transform), cells, padded_cells)

    def convolve(self, s) -> jax.Array:
        """Return ``sum_j T(r_i - r_j) s_j``, for s of shape (3, atoms, *cells)."""
        modes = self._forward_transform(s)
        if jnp.iscomplexobj(self.components[0]):
            return self._inverse_transform(self._multiply_modes(modes))
        return self._inverse_transform(
            jax.lax.complex(self._multiply_modes(modes.real), self._multiply_modes(modes.imag))
        )

    def _multiply_modes(self, modes) -> jax.Array:
        """Return the product of the kernel with modes, both real or both complex, shape (3, atoms, *modes)."""
        products = [[self.components[PAIR_INDEX[i][j]] * modes[j] for j in range(3)] for i in range(3)]
        return jnp.stack([jnp.sum(x + y + z, axis=1) for x, y, z in products])

    def _forward_transform(self, s) -> jax.Array:
        """Return the Fourier modes of s, with the last axis, which is transformed first, before the other ones.

        So no transform of that axis has to pass over the zeros along the others, nor over strided memory.
        """
        *other_axes, last_axis = transform_axes(self.padded_cells)
        modes = jnp.fft.rfft(s, self.padded_cells[last_axis], axis=2 + last_axis)
        modes = jnp.moveaxis(modes, 2 + last_axis, 2)
        return jnp.fft.fftn(modes, [self.padded_cells[axis] for axis in other_axes], [3 + axis for axis in other_axes])

    def _inverse_transform(self, modes) -> jax.Array:
        *other_axes, last_axis = transform_axes(self.padded_cells)
        rows = jnp.fft.ifftn(modes, axes=[3 + axis for axis in other_axes])
        rows = rows[(..., *(slice(n) for axis, n in enumerate(self.cells) if axis != last_axis))]
        rows = jnp.moveaxis(rows, 2, 2 + last_axis)
        fields = jnp.fft.irfft(rows, self.padded_cells[last_axis], axis=2 + last_axis)
        return jax.lax.slice_in_dim(fields, 0, self.cells[last_axis], axis=2 + last_axis)


REAL_TOLERANCE = 1e-15
"""Imaginary part of a transform, relative to its largest entry, that is rounding."""


def padded_length(n: int, is_periodic: bool) -> int:
    """Return the length of an axis on which a convolution has no wrap, a product of 2, 3 and 5; n if it is periodic."""
    if is_periodic or n == 1:
        return n
    length = 2 * n - 1
    while True:
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return length
        length += 1


def dipolar_lattice_kernel(lattice: Lattice, boundary: str) -> FourierKernel:
    """Return the Fourier transform of the dipolar tensors of a lattice, periodic images included."""
    padded_cells = tuple(padded_length(n, p) for n, p in zip(lattice.cells, lattice.periodic, strict=True))
    if any(lattice.periodic):
        return _ewald_lattice_kernel(lattice, padded_cells, boundary)
    atoms = len(lattice.basis)
    offsets = _cell_offsets(padded_cells)
    r = offsets @ lattice.vectors
    # No two cells have these offsets. With zeros there, T(-r) = T(r) for all entries, so that the transform is real.
    is_unused = (np.abs(offsets) >= lattice.cells).any(axis=-1)
    tensors = np.empty((len(COMPONENTS), atoms, atoms, *padded_cells))
    for a, b in np.ndindex(atoms, atoms):
        tensors[:, a, b] = _symmetric_components(dipole_tensor(r + lattice.basis[a] - lattice.basis[b]))
    tensors[..., is_unused] = 0.0
    return FourierKernel.from_tensors(tensors, lattice.cells)


def _ewald_lattice_kernel(lattice: Lattice, padded_cells: tuple[int, ...], boundary: str) -> FourierKernel:
    """Return the kernel of a lattice with periodic axes from its sums over images, by Ewald's method."""
    transform = ewald_kernel(lattice, padded_cells)
    if all(lattice.periodic) and len(lattice.cells) == 3 and boundary == "vacuum":
        for component in (0, 3, 5):  # the field of a sphere is that of the mean moment, at wave vector zero
            transform[component, :, :, 0, 0, 0] += 4.0 * np.pi / (3.0 * lattice.cell_volume)
    return FourierKernel.from_transform(transform, lattice.cells, padded_cells)


def _cell_offsets(padded_cells: tuple[int, ...]) -> np.ndarray:
    """Return the offsets of cells on a padded lattice, shape (*padded_cells, d): 0, 1, …, -1 along each axis."""
    axes = [np.rint(np.fft.fftfreq(n, 1.0 / n)) for n in padded_cells]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _symmetric_components(tensors: np.ndarray) -> np.ndarray:
    """Return the components xx, xy, xz, yy, yz, zz of symmetric tensors, shape (..., 3, 3), along a new first axis."""
    return np.stack([tensors[..., i, j] for i, j in COMPONENTS])
