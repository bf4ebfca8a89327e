"""Set-ups and values of fidimag's own tests [Bisotti et al. 2018], https://github.com/computationalmodelling/fidimag.

Each test names the one that it has its set-up and its values from. Fields are minus the gradient of the energy. fidimag
numbers sites with x fastest, or in its older tests with z fastest; arrays here have the shape (x, y, z).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism


def field_of(energy, s):
    """Return the effective field at every spin, in the shape of s."""
    return -np.asarray(energy.gradient(jnp.asarray(s, dtype=float).ravel())).reshape(np.shape(s))


def index_spins(*sites):
    """Return spins that equal their indices (i, j, k); their length is not one."""
    return np.stack(np.meshgrid(*map(np.arange, sites), indexing="ij"), axis=-1).astype(float)


# -- tests/test_exch.py, atomistic ------------------------------------------------------------------------------------


def test_exch_1d():
    field = field_of(mag.exchange((5, 1, 1), 1.0, periodic=False), index_spins(5, 1, 1))
    np.testing.assert_array_equal(field[:, 0, 0, 0], [1, 2, 4, 6, 3])
    np.testing.assert_array_equal(field[..., 1:], 0.0)


def test_exch_1d_pbc():
    """Periodic along x alone: along an axis with one site a period would join a site with itself."""
    field = field_of(mag.exchange((5, 1, 1), 1.0, periodic=(True, False, False)), index_spins(5, 1, 1))
    np.testing.assert_array_equal(field[:, 0, 0, 0], [1 + 4, 2, 4, 6, 3 + 0])
    np.testing.assert_array_equal(field[..., 1:], 0.0)


def test_exch_2d():
    field = field_of(mag.exchange((5, 2, 1), 1.0, periodic=False), index_spins(5, 2, 1))
    np.testing.assert_array_equal(field[:, 0, 0, 0], [1, 2 + 1, 1 + 2 + 3, 2 + 3 + 4, 3 + 4])
    np.testing.assert_array_equal(field[..., 2], 0.0)


def test_exch_2d_pbc2d():
    """Two sites along y are neighbours twice."""
    energy = mag.exchange((3, 2, 1), 1.0, periodic=(True, True, False), images=True)
    field = field_of(energy, index_spins(3, 2, 1))
    np.testing.assert_array_equal(field[..., 0].ravel(), [3, 3, 4, 4, 5, 5])
    np.testing.assert_array_equal(field[..., 1].ravel(), [2, 2, 2, 2, 2, 2])
    np.testing.assert_array_equal(field[..., 2], 0.0)


def test_exch_3d():
    field = field_of(mag.exchange((4, 3, 2), 1.0, periodic=False), index_spins(4, 3, 2))
    np.testing.assert_array_equal(field[:, 0, 0, 0], [1, 4, 8, 8])
    np.testing.assert_array_equal(field[:, 1, 0, 0], [1, 5, 10, 11])


def test_exch_energy_1d():
    up = np.array([[0.0, 0.0, 1.0]] * 2)
    assert float(mag.exchange(2, 1.23, periodic=False).value(up.ravel())) == -1.23


def test_exch_1d_spatial():
    """tests/test_spatial_exch.py: antiferromagnetic, ferromagnetic, 0.3 between; the fields follow from the bonds."""
    J = np.where(np.arange(12) < 5, -1.0, 1.0)
    J[5] = 0.3  # of the sites 5 and 6
    field = field_of(mag.exchange(12, J, periodic=False), np.outer(np.arange(12.0), [1, 0, 0]))[:, 0]
    assert field[3] == -2.0 - 4.0
    assert field[5] == pytest.approx(-4.0 + 0.3 * 6.0)
    assert field[6] == pytest.approx(0.3 * 5.0 + 7.0)
    assert field[8] == 7.0 + 9.0


# -- tests/test_exch_micro.py -----------------------------------------------------------------------------------------


def test_exch_micro_1d():
    """``2 A nabla^2 m`` of a spiral with k = 0.1: within 3e-5 of the continuum, inside of the mesh."""
    angles = 0.1 * np.arange(100)
    m = np.stack([0 * angles, np.sin(angles), np.cos(angles)], axis=-1)
    field = field_of(mag.exchange(100, 2.0, periodic=False), m) - 2.0 * 2.0 * m  # 2 A (m_j - m_i) over two neighbours
    np.testing.assert_array_equal(field[:, 0], 0.0)
    assert np.abs(field[1:-1, 1] + 0.02 * np.sin(angles[1:-1])).max() < 3e-5


# -- tests/test_dmi.py ------------------------------------------------------------------------------------------------


def test_atom_dmi_1d():
    energy, spins = mag.dzyaloshinskii_moriya(2, (1.0, 0.0, 0.0), periodic=False), np.array([[1.0, 0.0, 0.0]] * 2)
    np.testing.assert_array_equal(field_of(energy, spins), 0.0)
    assert float(energy.value(spins.ravel())) == 0.0


def test_atom_dmi_1d_field():
    energy, s = mag.dzyaloshinskii_moriya(2, (1.23, 0.0, 0.0), periodic=False), np.array([[0.0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(field_of(energy, s), 1.23 * np.array([[0, -1, 0], [0, 0, -1]]), rtol=1e-15)
    assert float(energy.value(s.ravel())) == 1.23


@pytest.mark.parametrize(
    ("vector", "expected"),
    [((-1.0, 0.0, 0.0), [[0, 1, 0], [0, 0, 0], [0, -1, 0]]), ((0.0, -1.0, 0.0), [[-1, 0, 0], [0, 0, 0], [1, 0, 0]])],
    ids=["bulk", "interfacial"],
)
def test_micro_dmi(vector, expected):
    """Three cells along z. ``D m . curl m`` is that of the vectors -D r_ij, the interfacial one that of D r_ij x z."""
    field = field_of(mag.dzyaloshinskii_moriya(3, vector, periodic=False), np.array([[0.0, 0.0, 1.0]] * 3))
    np.testing.assert_allclose(field, expected, rtol=0, atol=1e-15)


# -- tests/test_anis.py, test_atomistic_zeeman.py, test_time_zeeman.py ------------------------------------------------


def test_anis():
    s = np.zeros((5, 3, 2, 3))
    energy = mag.anisotropy((5, 3, 2), 1.0, (1.0, 0.0, 0.0))
    assert field_of(energy, s).max() == 0.0
    s[0, 0, 0, 0] = 99.0
    assert field_of(energy, s)[0, 0, 0, 0] == 2 * 99


def test_zeeman():
    x, y = np.meshgrid(np.arange(5) + 0.5, np.arange(2) + 0.5, indexing="ij")
    energy = mag.zeeman((5, 2), np.stack([1.2 * x, 2.3 * y, 0 * x], axis=-1))
    field = field_of(energy, np.tile([1.0, 0.0, 0.0], (5, 2, 1)))
    np.testing.assert_array_equal(field[2, 0], [1.2 * 2.5, 2.3 * 0.5, 0.0])


def test_time_zeeman():
    system = lt.SpinSystem((2, 2), lambda s, t: -10.0 * jnp.cos(10e9 * t) * jnp.sum(s[..., 2]))
    for t, expected in ((0.0, 10.0), (1.0, 10.0 * np.cos(10e9))):
        field = field_of(system.energy.at_time(t), np.zeros((2, 2, 3)))
        np.testing.assert_array_equal(field[..., :2], 0.0)
        np.testing.assert_allclose(field[..., 2], expected, rtol=1e-12)


# -- tests/test_llg.py, test_llg_atomistic.py -------------------------------------------------------------------------


@pytest.mark.sampled("test_sim_10_spins")
@pytest.mark.parametrize("sites", [1, (10, 5)], ids=["test_sim_single_spin", "test_sim_10_spins"])
def test_sim_single_spin(sites):
    """Gilbert's damping 0.1 in a field of 1e5 A/m for a nanosecond: fidimag asks for 5e-7."""
    alpha, gamma, H = 0.1, 2.21e5, 1e5
    ratio, rate = lt.LandauLifshitz.gilbert(alpha, gamma)
    system = lt.SpinSystem(sites, mag.zeeman(sites, (0.0, 0.0, H)), lt.LandauLifshitz(rate), ratio=ratio)
    start = np.tile([1.0, 0.0, 0.0], system.dim // 3)
    run = lt.integrate(system, start, (0.0, 1e-9), 2e-12, lt.MetriplecticRungeKutta(8), save_every=5)
    angle = gamma / (1 + alpha**2) * H * run.t
    exact = np.stack([np.cos(angle), np.sin(angle), np.sinh(alpha * angle)], axis=-1) / np.cosh(alpha * angle)[:, None]
    assert np.abs(run.x.reshape(len(run.t), -1, 3) - exact[:, None]).max() < 1e-12
    assert np.abs(np.linalg.norm(run.x.reshape(-1, 3), axis=1) - 1.0).max() < 1e-14


# -- tests/test_exch_rkky.py ------------------------------------------------------------------------------------------


def test_exchange_rkky():
    """Two antiparallel layers: ``gamma sqrt(K (K + 2 sigma))``. fidimag prints whether it is within 1 %."""
    gamma, mu0, Ms = 2.211e5, 4e-7 * np.pi, 8.6e5
    K, sigma = 2 * 5e4 / (mu0 * Ms), 1e-4 / 1e-9 / (mu0 * Ms)
    energy = mag.anisotropy(2, K / 2.0) + mag.exchange(2, -sigma, periodic=False)
    system = lt.SpinSystem(2, energy, ratio=gamma)
    opposite = jnp.array([0.0, 0.0, -1.0, 0.0, 0.0, 1.0])
    frequencies = np.linalg.eigvals(np.asarray(jax.jacfwd(system.vector_field)(opposite))).imag
    assert frequencies.max() == pytest.approx(gamma * np.sqrt(K * (K + 2 * sigma)), rel=1e-12)


# -- walls and waves --------------------------------------------------------------------------------------------------


def test_energy():
    """tests/test_energy.py: a wall in a chain with an easy and a hard axis relaxes; its energy falls in every step."""
    x = np.arange(200)
    start = np.where((x < 80)[:, None], [1.0, 0, 0], np.where((x > 120)[:, None], [-1.0, 0, 0], [0, 1.0, 0]))
    terms = mag.anisotropy(200, 0.005, (1.0, 0.0, 0.0)) + mag.anisotropy(200, -0.01)
    ratio, rate = lt.LandauLifshitz.gilbert(0.5, 2 * np.pi)
    system = lt.SpinSystem(200, mag.exchange(200, periodic=False) + terms, lt.LandauLifshitz(rate), ratio=ratio)
    run = lt.integrate(system, start.ravel(), (0.0, 100.0), 0.05, lt.MetriplecticRungeKutta(4), save_every=4)
    assert (np.diff(run.energy) < 0.0).all()


def relax(energy, start, time, step):
    """Return the spins after damping with almost no precession, in the shape of the start."""
    system = lt.SpinSystem(len(start), energy, lt.LandauLifshitz(0.5), ratio=1e-3)
    run = lt.integrate(system, np.ravel(start), (0.0, time), step, lt.MetriplecticRungeKutta(4), save_every=1000)
    return run.x[-1].reshape(-1, 3)


@pytest.mark.slow
def test_dw_dmi_atomistic():
    """tests/test_dw_atomistic.py: a twisted wall in 300 spins against the continuum."""
    D, K, x = 0.01, 0.005, np.arange(300) + 0.5
    start = np.where((x < 140)[:, None], [1.0, 0, 0], np.where((x > 160)[:, None], [-1.0, 0, 0], [0, 1.0, 0]))
    energy = mag.exchange(300, periodic=False) + mag.anisotropy(300, K, (1.0, 0.0, 0.0))
    energy = energy + mag.dzyaloshinskii_moriya(300, (D, 0.0, 0.0), periodic=False)
    m, x = relax(energy, start, 4000.0, 0.5), x - 150.0
    A = 0.5
    width = np.sqrt(A / (K - D**2 / (4 * A)))
    angle = -D / (2 * A) * x
    exact = np.stack([-np.sinh(x / width), np.cos(angle), np.sin(angle)], axis=-1) / np.cosh(x / width)[:, None]
    assert np.abs(m - exact).max(axis=0) == pytest.approx(0.0, abs=0.001)
    assert np.abs(m - exact)[:, 2].max() < 0.0006


@pytest.mark.slow
def test_domain_wall_cobalt():
    """tests/test_domain_wall_cobalt.py: 100 nm of cobalt in cells of 1 nm; free ends, where fidimag's are pinned."""
    A, K, cell = 30e-12, 520e3, 1e-9
    x = np.arange(100) + 0.5
    m_z = 1.0 - 2.0 * x / 100.0
    start = np.stack([0 * x, np.sqrt(1.0 - m_z**2), m_z], axis=-1)
    energy = mag.exchange(100, 2 * A / cell**2 / K, periodic=False) + mag.anisotropy(100, 1.0)
    m = relax(energy, start, 30.0, 0.01)
    exact = -np.tanh((x - 50.0) * cell / np.sqrt(A / K))
    assert np.abs(m[:, 2] - exact).max() < 1e-2


@pytest.mark.slow
def test_prb88_184422():
    """tests/test_prb88_184422.py: the twist at the edges of a film [Rohart & Thiaville 2013, eq. 8].

    There ``sin theta = Delta / xi``.

    fidimag compares with a file of OOMMF, which we do not have; its other reference is this equation.
    """
    A, D, K, cell = 16e-12, 3.6e-3, 510e3, 1e-9
    x = np.arange(100) + 0.5
    energy = mag.exchange(100, 2 * A / cell**2 / K, periodic=False) + mag.anisotropy(100, 1.0)
    energy = energy + mag.dzyaloshinskii_moriya(100, (0.0, D / cell / K, 0.0), periodic=False)
    m = relax(energy, np.tile([0.0, 0.0, 1.0], (100, 1)), 20.0, 0.01)
    width, pitch = np.sqrt(A / K) / cell, 2 * A / D / cell
    edge_angle = np.arcsin(width / pitch)
    angle = 2 * np.arctan(np.tan(edge_angle / 2) * np.exp(-x / width))
    assert np.abs(np.abs(m[:50, 0]) - np.sin(angle[:50])).max() < 0.01
    np.testing.assert_allclose(m[:, 0], -m[::-1, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(m[:, 1], 0.0, atol=1e-9)


def test_spin_waves():
    """examples/atomistic/sw.py: the frequencies of a ring are those of small waves, ``2 J (1 - cos q) + 2 K + B``."""
    n, J, K, B = 16, 1.0, 0.1, 0.3
    energy = mag.exchange(n, J) + mag.anisotropy(n, K) + mag.zeeman(n, (0.0, 0.0, B))
    system = lt.SpinSystem(n, energy)
    up = jnp.tile(jnp.array([0.0, 0.0, 1.0]), n)
    frequencies = np.sort(np.linalg.eigvals(np.asarray(jax.jacfwd(system.vector_field)(up))).imag)[-n:]
    q = 2 * np.pi * np.arange(n) / n
    np.testing.assert_allclose(frequencies, np.sort(2 * J * (1 - np.cos(q)) + 2 * K + B), rtol=1e-12)


# -- tests/test_skyrmion_number.py ------------------------------------------------------------------------------------


def chirality(s):
    """Return the finite spin chirality of two triangles at each site [PRL 108, 017601], over 8 pi."""
    x, y = (lambda by: np.roll(s, -by, 0)), (lambda by: np.roll(s, -by, 1))
    triangles = sum(np.sum(s * np.cross(x(by), y(by)), axis=-1) for by in (1, -1))
    return triangles.sum() / (8 * np.pi)


def berg_luscher(s):
    """Return the solid angles of two triangles at each site [Berg & Luescher 1981], over 4 pi."""
    x, y = (lambda by: np.roll(s, -by, 0)), (lambda by: np.roll(s, -by, 1))
    total = 0.0
    for by in (1, -1):
        a, b = x(by), y(by)
        volume = np.sum(s * np.cross(a, b), axis=-1)
        pairs = 1.0 + np.sum(s * a, axis=-1) + np.sum(a * b, axis=-1) + np.sum(b * s, axis=-1)
        total += 2.0 * np.arctan2(volume, pairs).sum()
    return total / (4 * np.pi)


@pytest.mark.slow
def test_skx_num_atomistic():
    """A skyrmion that points down, of 120 x 120 spins with D = 0.09 J in a field of 0.005 J."""
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(120) + 0.5, indexing="ij")
    core_spin = np.array([0.05, 0.01, -1.0]) / np.linalg.norm([0.05, 0.01, -1.0])
    s = np.where(((x - 60) ** 2 + (y - 60) ** 2 < 400)[..., None], core_spin, [0.0, 0.0, 1.0])
    system = lt.models.spin_lattice(
        (120, 120), 1.0, field=(0, 0, 5e-3), dmi=[(0.09, 0, 0), (0, 0.09, 0)], rate=0.5, baths=False
    )
    run = lt.integrate(system, s.ravel(), (0.0, 400.0), 0.4, lt.MetriplecticRungeKutta(4), save_every=1000)
    end = run.x[-1].reshape(120, 120, 3)
    assert np.linalg.norm(np.asarray(system.vector_field(run.x[-1])).reshape(-1, 3), axis=1).max() < 1e-2
    assert -1.0 < chirality(end) < -0.99
    assert berg_luscher(end) == pytest.approx(-1.0, abs=1e-4)
