"""Dipolar energies beside direct sums, lattice constants in closed form, and lattices of one axis less."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special as special

import liethermo as lt
from liethermo.functions.magnetism.dipoles import dipolar_lattice_kernel, padded_length
from liethermo.functions.magnetism.ewald import dipole_tensor, ewald_kernel, transform_axes
from tests.refusals import refusal_test

mag = lt.magnetism
RNG = np.random.default_rng(5)


def random_spins(count):
    s = RNG.standard_normal((count, 3))
    return s / np.linalg.norm(s, axis=1, keepdims=True)


def direct_energy(positions, moments, spins):
    total = 0.0
    for i, j in itertools.combinations(range(len(positions)), 2):
        r = positions[i] - positions[j]
        d, e = np.linalg.norm(r), r / np.linalg.norm(r)
        u, v = moments[i] * spins[i], moments[j] * spins[j]
        total += (u @ v - 3.0 * (u @ e) * (v @ e)) / d**3
    return total


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("name", "cells"), [("chain", 7), ("kagome", (3, 2)), ("sc", (3, 2, 4)), ("bcc", (2, 3, 2))])
def test_open_lattices_are_direct_sums(name, cells):
    crystal = mag.lattice(name, cells, constant=1.3, periodic=False)
    positions, spins = crystal.positions.reshape(-1, 3), random_spins(crystal.site_count)
    moments = RNG.uniform(0.5, 2.0, crystal.sites)
    expected = 0.7 * direct_energy(positions, moments.ravel(), spins)
    by_transforms = mag.dipoles(crystal, moments, 0.7)
    by_pairs = mag.dipoles(positions, moments.ravel(), 0.7)
    for energy in (by_transforms, by_pairs):
        assert float(energy(spins.ravel())) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(
        by_transforms.gradient(spins.ravel()), by_pairs.gradient(spins.ravel()), rtol=0, atol=1e-13
    )


def transform_of(crystal):
    """Return the transforms of the six components, shape (6, atoms, atoms, ...), axes in the order of the lattice."""
    kernel = dipolar_lattice_kernel(crystal, "tin foil")
    return np.moveaxis(np.stack(kernel.components), 3, 3 + transform_axes(kernel.padded_cells)[-1])


def test_a_chain_has_the_sums_of_zeta_and_of_clausen():
    """``sum 1 / n^3 = zeta(3)``; at wave number q it is ``sum cos(q n) / n^3``, a polynomial at pi: -3 zeta(3) / 4."""
    T = transform_of(mag.lattice("chain", 8))[:, 0, 0]
    zeta = special.zeta(3)
    np.testing.assert_allclose(T[:, 0], np.array([-4, 0, 0, 2, 0, 2]) * zeta, rtol=1e-14)
    np.testing.assert_allclose(T[:, 4], -0.75 * np.array([-4, 0, 0, 2, 0, 2]) * zeta, rtol=1e-13)
    n = np.arange(1, 200_001)  # the rest of an alternating sum is below its first term, 1e-16
    np.testing.assert_allclose(T[3, 1], 2 * np.sum(np.cos(0.25 * np.pi * n) / n**3), rtol=1e-13)


def test_a_square_lattice_has_the_sum_of_zeta_and_beta():
    """``sum' 1 / r^3 = 4 zeta(3/2) beta(3/2)`` [Glasser 1973]."""
    beta = 4**-1.5 * (special.zeta(1.5, 0.25) - special.zeta(1.5, 0.75))
    total = 4 * special.zeta(1.5) * beta
    T = transform_of(mag.lattice("square", (4, 6)))[:, 0, 0, 0, 0]
    np.testing.assert_allclose(T, np.array([-0.5, 0, 0, -0.5, 0, 1.0]) * total, atol=1e-14)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["sc", "bcc", "fcc"])
def test_cubic_lattices_have_the_field_of_lorentz(name):
    """The sum over a sphere vanishes; without a depolarising field ``-4 pi M / 3`` remains."""
    crystal = mag.lattice(name, (4, 3, 5), primitive=True)
    up = np.tile([0.0, 0.0, 1.0], crystal.site_count)
    lorentz = -2.0 * np.pi / (3.0 * crystal.cell_volume)
    assert float(mag.dipoles(crystal)(up)) / crystal.site_count == pytest.approx(lorentz, rel=1e-14)
    assert float(mag.dipoles(crystal, boundary="vacuum")(up)) == pytest.approx(0.0, abs=1e-12)


def test_the_ground_state_of_a_cubic_lattice_is_that_of_luttinger_and_tisza():
    """Chains along z, antiparallel to their neighbours: -2.676 for mu = a = 1 [Luttinger & Tisza 1946, table II]."""
    crystal = mag.lattice("sc", (4, 4, 4))
    i, j, _ = np.indices(crystal.cells)
    s = np.zeros((*crystal.cells, 3))
    s[..., 2] = (-1.0) ** (i + j)
    assert float(mag.dipoles(crystal)(s.ravel())) / 64 == pytest.approx(-2.676, abs=1e-3)


CRYSTALS = {
    "oblique layers": ([(1.0, 0.0, 0.0), (0.3, 1.1, 0.0), (0.2, 0.4, 0.9)], [(0.0, 0.0, 0.0), (0.4, 0.3, 0.5)]),
    "cubic layers": (np.eye(3), [(0.0, 0.0, 0.0)]),
}


@pytest.mark.parametrize("name", CRYSTALS)
def test_three_axes_are_a_stack_of_layers(name):
    """The field of layers at a wave vector along them falls off exponentially, so their sum converges to rounding."""
    vectors, basis = CRYSTALS[name]
    crystal = mag.lattice(vectors, (3, 3, 4), basis=basis)
    T = ewald_kernel(crystal, (3, 3, 4))
    # layers up to a distance at which exp(-Q h) is below rounding
    stack = mag.lattice(vectors, (3, 3, 40), basis=basis, periodic=(True, True, False))
    length = 80
    layers = np.fft.ifftn(_full_transform(ewald_kernel(stack, (3, 3, length)), length), axes=(5,))
    offsets = np.rint(np.fft.fftfreq(length, 1 / length))
    for q in range(3):
        summed = np.sum(layers * np.exp(-2j * np.pi * q * offsets / 4), axis=-1)
        for i, j in ((1, 0), (0, 1), (1, 1), (2, 1)):
            np.testing.assert_allclose(summed[..., i, j], T[..., i, j, q], atol=1e-12 * np.abs(T).max())


def _full_transform(half, length):
    """Return the transform along the last axis from its half, by the symmetry of real tensors."""
    full = np.zeros((*half.shape[:-1], length), dtype=complex)
    full[..., : half.shape[-1]] = half
    for k in range(half.shape[-1], length):
        full[..., k] = np.conj(
            half[..., :, :, length - k][..., (-np.arange(half.shape[3])) % half.shape[3], :][
                ..., (-np.arange(half.shape[4])) % half.shape[4]
            ]
        )
    return full


def test_a_layer_is_a_row_of_chains():
    vectors, basis = [(1.0, 0.0, 0.0), (0.3, 1.1, 0.0)], [(0.0, 0.0, 0.0), (0.4, 0.3, 0.5)]
    T = ewald_kernel(mag.lattice(vectors, (3, 4), basis=basis), (3, 4))
    length = 80
    row = ewald_kernel(mag.lattice(vectors, (3, 40), basis=basis, periodic=(True, False)), (3, length))
    full = np.zeros((*row.shape[:-1], length), dtype=complex)
    full[..., : row.shape[-1]] = row
    for k in range(row.shape[-1], length):
        full[..., k] = np.conj(row[..., (-np.arange(3)) % 3, length - k])
    chains = np.fft.ifft(full, axis=-1)
    offsets = np.rint(np.fft.fftfreq(length, 1 / length))
    for q in range(3):
        summed = np.sum(chains * np.exp(-2j * np.pi * q * offsets / 4), axis=-1)
        for i in (1, 2):
            np.testing.assert_allclose(summed[..., i], T[..., i, q], atol=1e-12 * np.abs(T).max())


def test_chains_of_several_atoms_are_direct_sums():
    """Direct sums over 2,000 images, with the rest by Euler's and Maclaurin's formula in its first terms."""
    basis = np.array([(0.0, 0.0, 0.0), (0.3, 0.4, 0.2)])
    crystal = mag.lattice([(1.0, 0.0, 0.0)], 4, basis=basis)
    tensors = np.fft.irfft(ewald_kernel(crystal, (4,)), 4, axis=-1)
    cut = 2_000
    for o, (a, b) in itertools.product(range(4), itertools.product(range(2), repeat=2)):
        r = basis[a] - basis[b] + np.array([o, 0.0, 0.0]) + 4.0 * np.arange(-cut, cut + 1)[:, None] * [1.0, 0.0, 0.0]
        total = np.where(np.linalg.norm(r, axis=1)[:, None, None] > 0, dipole_tensor(r), 0.0).sum(axis=0)
        edges = 4.0 * (cut + 0.5) + np.array([r[cut, 0], -r[cut, 0]])
        rest = np.sum(0.5 / edges**2) / 4.0  # integral of 1 / x^3, midpoint rule
        total = total + rest * np.diag([-2.0, 1.0, 1.0])
        tensor = tensors[:, a, b, o]
        expected = [total[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
        np.testing.assert_allclose(tensor, expected, atol=2e-11)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "periodic"),
    [("kagome", True), ("kagome", (False, True)), ("pyrochlore", (True, False, True)), ("diamond", True)],
)
def test_the_splitting_does_not_matter(name, periodic):
    crystal = mag.lattice(name, (4, 3, 2)[: 2 if name == "kagome" else 3], periodic=periodic, primitive=True)
    padded = tuple(padded_length(n, p) for n, p in zip(crystal.cells, crystal.periodic, strict=True))
    first, second = (ewald_kernel(crystal, padded, splitting) for splitting in (0.55, 1.1))
    np.testing.assert_allclose(first, second, atol=2e-15 * np.abs(first).max() * 10)


@pytest.mark.parametrize("periodic", [(True, True), (False, True), (False, False)])
def test_periodic_energies_are_sums_over_images(periodic):
    """The gradient is that of the energy, and an enlarged lattice of copies has a multiple of the energy."""
    crystal = mag.lattice("honeycomb", (3, 4), periodic=periodic)
    energy, s = mag.dipoles(crystal, 1.2), random_spins(crystal.site_count).ravel()
    assert float(energy(s)) == pytest.approx(0.5 * float(energy.gradient(s) @ s), rel=1e-14)
    if periodic[1]:
        twice = mag.dipoles(mag.lattice("honeycomb", (3, 8), periodic=periodic), 1.2)
        copies = np.tile(s.reshape(*crystal.sites, 3), (1, 2, 1, 1)).ravel()
        assert float(twice(copies)) == pytest.approx(2.0 * float(energy(s)), rel=1e-13)


@pytest.mark.sampled("True")
@pytest.mark.parametrize("few", [True, False])
def test_dipoles_keep_both_laws(few):
    crystal = mag.lattice("square", (4, 4), periodic=(True, False))
    target = crystal.positions.reshape(-1, 3) if few else crystal
    sites = 16 if few else crystal
    energy = mag.dipoles(target, 1.0, 0.3) + mag.exchange(sites, 0.5)
    system = lt.SpinSystem(sites, energy, lt.LandauLifshitz(0.2), lt.HeatBaths(16.0))
    run = lt.integrate(system, random_spins(16).ravel(), (0.0, 3.0), 0.05, lt.MetriplecticRungeKutta(4), engine="array")
    assert run.audit().energy_drift < 1e-13, run.audit()
    assert (np.diff(run.entropy) > -1e-13).all()
    assert run.entropy[-1] > run.entropy[0] + 0.1


def test_two_dipoles_and_a_control():
    pair = mag.dipoles([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0)], 3.0, 0.5)
    assert float(pair([1, 0, 0, 1, 0, 0])) == pytest.approx(-2.0 * 0.5 * 9.0 / 8.0)
    assert float(pair([0, 0, 1, 0, 0, 1])) == pytest.approx(0.5 * 9.0 / 8.0)


def test_control_an_axis_without_padding_gives_another_energy():
    crystal = mag.lattice("chain", 5, periodic=False)
    s = random_spins(5)
    tensors = dipole_tensor(np.array([0.0, 1.0, 2.0, -2.0, -1.0])[:, None] * [1.0, 0.0, 0.0])
    wrapped = 0.5 * sum(s[i] @ tensors[(i - j) % 5] @ s[j] for i in range(5) for j in range(5))
    assert abs(wrapped - float(mag.dipoles(crystal)(s.ravel()))) > 1e-2


BAD = {
    "a boundary": (lambda: mag.dipoles(mag.lattice("sc", 3), boundary="glass"), "must be"),
    "one position": (lambda: mag.dipoles([(0.0, 0.0, 0.0)] * 2), "the same position"),
    "positions": (lambda: mag.dipoles([1.0, 2.0]), r"\(N, 3\)"),
    "moments": (lambda: mag.dipoles(mag.lattice("sc", 3), np.ones(3)), "a moment must have shape"),
}


test_bad_dipoles_are_refused = refusal_test(BAD, error=lt.LiethermoError)


def test_open_lattices_of_one_atom_have_a_real_kernel():
    """The dipolar tensor is even, so its transform is real; as a control, atoms of kagome are no pair of mirror
    images in their cell."""
    for name, cells, kind in (("sc", (6, 7, 8), "f"), ("square", (16, 20), "f"), ("kagome", (5, 5), "c")):
        energy = mag.dipoles(mag.lattice(name, cells, periodic=False))
        assert energy.kernel.components[0].dtype.kind == kind


def test_a_loop_transforms_a_field_once_for_all_its_uses():
    """Slices or complex copies of a kernel that XLA moves out of the loop would make two fields of one."""
    energy = mag.dipoles(mag.lattice("sc", (4, 3, 5), periodic=False))

    def step(_, x):
        force = jax.lax.optimization_barrier(energy.gradient(x))
        return x - 0.01 * force + 0.01 * x * jnp.dot(x, energy.gradient(x))

    run = jax.jit(lambda x: jax.lax.fori_loop(0, 5, step, x))
    transforms = re.findall(r"fft_type=(\w+)", run.lower(random_spins(60).ravel()).compile().as_text())
    assert sorted(transforms) == ["FFT", "IFFT", "IRFFT", "RFFT"]
