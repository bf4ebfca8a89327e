"""Micromagnetic energies beside closed forms: prisms, walls, spirals, resonance, and standard problem 4 of µMAG."""

import math

import numpy as np
import pytest

import liethermo as lt
from liethermo.functions.magnetism.newell import (
    _closed_form_tensors,
    _mean_dipole_tensors,
    demagnetising_tensors,
    mirror_octant,
    triangle_density_gauss_rule,
)
from tests.refusals import refusal_test

mag = lt.magnetism
MU0 = 4e-7 * math.pi


def factor_of_prism(a, b, c):
    """Return the demagnetising factor along z of a prism with the half edges a, b, c [Aharoni 1998, eq. 1]."""
    log, atan, root = math.log, math.atan, math.sqrt
    r, ab, bc, ac = root(a * a + b * b + c * c), root(a * a + b * b), root(b * b + c * c), root(a * a + c * c)
    total = (b * b - c * c) / (2 * b * c) * log((r - a) / (r + a)) + (a * a - c * c) / (2 * a * c) * log(
        (r - b) / (r + b)
    )
    total += b / (2 * c) * log((ab + a) / (ab - a)) + a / (2 * c) * log((ab + b) / (ab - b))
    total += c / (2 * a) * log((bc - b) / (bc + b)) + c / (2 * b) * log((ac - a) / (ac + a))
    total += 2 * atan(a * b / (c * r)) + (a**3 + b**3 - 2 * c**3) / (3 * a * b * c)
    total += (a * a + b * b - 2 * c * c) / (3 * a * b * c) * r + c / (a * b) * (ac + bc)
    return (total - (ab**3 + bc**3 + ac**3) / (3 * a * b * c)) / math.pi


@pytest.mark.parametrize(
    "edges", [(1.0, 1.0, 1.0), (1.0, 2.0, 3.0), (5.0, 5.0, 3.0), (10.0, 1.0, 0.5), (1.0, 1.0, 30.0)]
)
def test_prisms_have_the_factors_of_aharoni(edges):
    N = mag.demagnetising_factors(edges)
    a, b, c = edges
    expected = [factor_of_prism(b, c, a), factor_of_prism(a, c, b), factor_of_prism(a, b, c)]
    np.testing.assert_allclose(N, expected, rtol=1e-11)  # the reference loses digits of long prisms
    assert sum(N) == pytest.approx(1.0, abs=1e-15)


def test_a_body_of_cells_has_the_factors_of_the_whole():
    """Uniformly magnetised cells are a prism, so the mean over the cells is the factor of the prism."""
    box = mag.mesh((12, 5, 3), (1.0, 2.0, 0.7))
    whole = mag.demagnetising_factors((12.0, 10.0, 2.1))
    energy = mag.demagnetisation(box, 1.0, constant=1.0)
    volume = 12.0 * 10.0 * 2.1
    for axis in range(3):
        m = np.tile(np.eye(3)[axis], 180)
        assert 2.0 * float(energy(m)) / volume == pytest.approx(whole[axis], rel=1e-13)


def test_the_trace_is_one_in_a_cell_and_zero_elsewhere():
    N = demagnetising_tensors((30, 20, 10), np.array([1.0, 0.8, 0.3]))
    trace = N[0] + N[3] + N[5]
    assert trace[0, 0, 0] == pytest.approx(1.0, abs=1e-15)
    trace[0, 0, 0] = 0.0
    assert np.abs(trace).max() < 1e-15


@pytest.mark.parametrize("edges", [(1.0, 1.0, 1.0), (1.0, 0.5, 0.1)])
def test_near_and_far_formulas_agree(edges):
    """At eight edges both are accurate; a control with two nodes is not."""
    size = np.array(edges)
    offsets = np.rint(8.0 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.6, 0.5]]) / size).astype(int)
    near = _closed_form_tensors(offsets, size)
    np.testing.assert_allclose(_mean_dipole_tensors(offsets * size, size, 6), near, atol=1e-15)
    assert np.abs(_mean_dipole_tensors(offsets * size, size, 2) - near).max() > 1e-9


def test_the_tensor_of_two_cells_is_its_integral():
    """The closed form beside the integral over both cells, by Gauss quadrature, three edges away."""
    N = demagnetising_tensors((4, 3, 2), np.array([1.0, 0.8, 0.6]))
    r = np.array([3.0, 1.6, 0.6])
    by_quadrature = _mean_dipole_tensors(r[None], np.array([1.0, 0.8, 0.6]), 12)[:, 0]
    np.testing.assert_allclose(N[:, 3, 2, 1], by_quadrature, atol=1e-13)
    points, weights = triangle_density_gauss_rule(6)
    for power in range(12):  # moments of 1 - |t|
        exact = 0.0 if power % 2 else 2.0 / ((power + 1) * (power + 2))
        assert weights @ points**power == pytest.approx(exact, abs=1e-14)


def test_fourier_transforms_agree_with_the_sum_over_cells():
    box = mag.mesh((4, 3, 2), (1.0, 0.8, 0.6))
    M = np.random.default_rng(0).uniform(0.5, 2.0, box.sites)
    m = np.random.default_rng(1).standard_normal((*box.sites, 3))
    N = mirror_octant(demagnetising_tensors((4, 3, 2), np.array([1.0, 0.8, 0.6])), (7, 5, 3))
    total, index = 0.0, ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    for i in np.ndindex(4, 3, 2):
        for j in np.ndindex(4, 3, 2):
            n = N[(slice(None), *np.subtract(i, j))]
            tensor = np.array([[n[index[a][b]] for b in range(3)] for a in range(3)])
            total += 0.5 * M[i] * M[j] * m[i] @ tensor @ m[j]
    energy = mag.demagnetisation(box, M, constant=1.0)
    assert float(energy(m.ravel())) == pytest.approx(total * 0.48, rel=1e-12)


def test_a_wall_has_its_width_and_its_energy():
    """``m_z = tanh(x / delta)``, delta = sqrt(A / K), and the energy 4 sqrt(A K) an area [Landau & Lifshitz 1935].

    On cells of edge d both change by O(d^2 / delta^2), 1e-3 here.
    """
    A, K, edge, count = 1e-11, 1e6, 0.2e-9, 200
    box = mag.mesh((count, 1, 1), edge)
    terms = mag.continuum_exchange(box, A) + mag.anisotropy(box, K * edge**3)
    delta = math.sqrt(A / K)
    x = box.positions[:, 0, 0, 0] - count * edge / 2
    start = np.zeros((count, 1, 1, 3))
    start[:, 0, 0, 2] = np.clip(x / (3 * delta), -1.0, 1.0)
    start[:, 0, 0, 0] = np.sqrt(1.0 - start[:, 0, 0, 2] ** 2)
    wall = mag.minimise(terms, start, 1e-9)
    np.testing.assert_allclose(wall.spins[:, 0, 0, 2], np.tanh(x / delta), atol=2e-3)
    up = np.tile([0.0, 0.0, 1.0], count)
    energy = (wall.energy - float(terms(up))) / edge**2
    assert energy == pytest.approx(4.0 * math.sqrt(A * K), rel=2e-3)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("kind", "sense"), [("bulk", "Bloch"), ("interfacial", "Neel")])
def test_a_spiral_has_its_pitch_and_its_hand(kind, sense):
    """The pitch is ``4 pi A / |D|`` [Dzyaloshinskii 1965]: 128 cells of it in a periodic row are the ground state."""
    A, D, count = 8.78e-12, 1.58e-3, 32
    pitch = 4.0 * math.pi * A / D
    edge = pitch / count
    box = mag.mesh((count, 1, 1), edge, periodic=(True, False, False))
    energy = mag.continuum_exchange(box, A) + mag.continuum_antisymmetric_exchange(box, D, kind)
    q = 2.0 * math.pi * np.arange(count) / count
    spirals = {}
    for hand in (1, -1):
        plane = {"Bloch": (0 * q, np.cos(q), hand * np.sin(q)), "Neel": (hand * np.sin(q), 0 * q, np.cos(q))}[sense]
        spirals[hand] = float(energy(np.stack(plane, axis=-1).ravel()))
    uniform = float(energy(np.tile([0.0, 0.0, 1.0], count)))
    expected = -(D**2) / (4.0 * A) * count * edge**3
    assert min(spirals.values()) - uniform == pytest.approx(expected, rel=5e-3)
    assert max(spirals.values()) > uniform
    # m . curl m = -h q for bulk, and m_z dm_x/dx - m_x dm_z/dx = h q for interfacial: D > 0 prefers the negative
    assert min(spirals, key=spirals.get) == (1 if kind == "bulk" else -1)


@pytest.mark.slow
def test_a_film_resonates_at_the_frequency_of_kittel():
    """``f = gamma / 2 pi sqrt((B + (N_y - N_x) mu_0 M) (B + (N_z - N_x) mu_0 M))`` [Kittel 1948], one prism in SI."""
    edges, M, B, u = (100e-9, 80e-9, 10e-9), 8e5, 0.1, mag.units("SI")
    box = mag.mesh((1, 1, 1), edges)
    moment = M * box.cell_volume
    energy = mag.demagnetisation(box, M) + mag.zeeman(box, (B, 0.0, 0.0), moment)
    a, b, c = edges
    N = [factor_of_prism(b, c, a), factor_of_prism(a, c, b), factor_of_prism(a, b, c)]
    stiffnesses = [B + (N[axis] - N[0]) * MU0 * M for axis in (1, 2)]
    frequency = u.gamma() / (2.0 * math.pi) * math.sqrt(stiffnesses[0] * stiffnesses[1])
    system = lt.SpinSystem(box, energy, ratio=u.gilbert(0.0, moment).ratio)
    tilt = 1e-4
    start = np.array([math.sqrt(1 - tilt**2), tilt, 0.0])
    period = 1.0 / frequency
    run = lt.integrate(system, start, (0.0, 20 * period), period / 40, lt.MetriplecticGauss(3))
    np.testing.assert_allclose(run.x[:, 1] / tilt, np.cos(2 * math.pi * frequency * run.t), atol=2e-6)
    assert run.audit().energy_drift < 1e-13


@pytest.mark.slow
def test_standard_problem_4():
    """The mean of m_x vanishes first at 0.136 to 0.139 ns in the solutions that µMAG publishes for field 1."""
    cells = (125, 32, 1)
    edges = (4e-9, 125e-9 / 32, 3e-9)
    film = lt.models.micromagnet(cells, edges)
    start = np.tile(np.array([1.0, 0.1, 0.0]) / math.hypot(1.0, 0.1), (*cells, 1))
    s_state = mag.minimise(film.energy, start, 1e-6)
    np.testing.assert_allclose(s_state.spins.mean(axis=(0, 1, 2)), [0.967, 0.126, 0.0], atol=4e-3)
    g = 2.211e5 / MU0 / mag.units("SI").gamma(1.0)
    film = lt.models.micromagnet(cells, edges, field=(-24.6e-3, 4.3e-3, 0.0), g=g)
    method = lt.MetriplecticRungeKutta(4)
    run = lt.integrate(film, film.state(s_state.spins), (0.0, 2e-10), 2e-13, method, save_every=5)
    m_x = np.asarray(film.spins(run.x))[..., 0].mean(axis=(1, 2, 3))
    before = np.nonzero(m_x > 0)[0]
    k = before[np.nonzero(np.diff(before) > 1)[0][0]] if (np.diff(before) > 1).any() else before[-1]
    crossing = run.t[k] + (run.t[k + 1] - run.t[k]) * m_x[k] / (m_x[k] - m_x[k + 1])
    assert crossing == pytest.approx(0.1375e-9, abs=0.0018e-9)
    assert (np.diff(run.energy) < 0.0).all()


@pytest.mark.slow
def test_a_micromagnet_keeps_both_laws():
    baths = lt.HeatBaths(64.0, 4e-21)  # of capacity 64 k, at 300 K
    film = lt.models.micromagnet((8, 4, 2), alpha=0.1, baths=baths)
    start = np.random.default_rng(0).standard_normal((8, 4, 2, 3))
    start /= np.linalg.norm(start, axis=-1, keepdims=True)
    run = lt.integrate(film, film.state(start), (0.0, 5e-12), 5e-14, lt.MetriplecticRungeKutta(4), save_every=10)
    assert run.audit().energy_drift < 1e-13, run.audit()
    assert (np.diff(run.entropy) > 0.0).all()


def test_different_materials_have_the_harmonic_mean():
    box = mag.mesh((2, 1, 1), (1.0, 2.0, 3.0))
    A = np.array([1.0, 3.0]).reshape(2, 1, 1)
    energy = mag.continuum_exchange(box, A)
    s = [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    assert float(energy(s)) == pytest.approx(-2.0 * 1.5 * 6.0)


BAD = {
    "edges": (lambda: mag.mesh((3, 3, 3), (1.0, -1.0, 1.0)), "positive edges"),
    "two axes": (lambda: mag.mesh((3, 3), 1.0), "three numbers of cells"),
    "periodic": (lambda: mag.demagnetisation(mag.mesh((3, 3, 3), 1.0, True), 1.0), "Use periodic=False"),
    "no mesh": (lambda: mag.demagnetisation(mag.lattice("bcc", 3), 1.0), "lt.magnetism.mesh"),
    "kind": (lambda: mag.continuum_antisymmetric_exchange(mag.mesh((3, 3, 3), 1.0), 1.0, "surface"), "interfacial"),
    "prism": (lambda: mag.demagnetising_factors((1.0, 0.0, 1.0)), "positive and finite"),
}


test_bad_cells_are_refused = refusal_test(BAD, error=lt.LiethermoError)
