"""Dispersions, structure factors, charges and temperatures beside closed forms."""

import numpy as np
import pytest

import liethermo as lt
from tests.refusals import refusal_test

mag = lt.magnetism
UP = np.array([0.0, 0.0, 1.0])


def up(crystal):
    return np.tile(UP, (*crystal.sites, 1))


WAVES = np.array([[0.3, 0.2, 0.5], [1.0, -0.4, 0.7], [2.0, 1.0, 0.0]])


@pytest.mark.parametrize("name", ["sc", "bcc", "fcc"])
def test_ferromagnets_have_their_dispersion(name):
    """``w = J z (1 - gamma_q) + 2 K + B``, gamma_q the mean of cos(q . r) over neighbours [Kittel 2005, ch. 12]."""
    crystal = mag.lattice(name, (4, 4, 4), primitive=True)
    energy = [mag.exchange(crystal, 0.7), mag.anisotropy(crystal, 0.1), mag.zeeman(crystal, (0, 0, 0.3))]
    r = crystal.shell(1).vectors
    expected = 0.7 * 2.0 * np.sum(1.0 - np.cos(WAVES @ r.T), axis=1) + 0.2 + 0.3
    frequencies = mag.spin_wave_frequencies(energy, crystal, up(crystal), WAVES)
    np.testing.assert_allclose(frequencies[:, 0], expected, rtol=1e-12)


def test_an_antiferromagnet_in_meV_and_ps():
    """``w = z |J| / hbar sqrt(1 - gamma_q^2)`` for spins of length 1 in units of hbar [Anderson 1952]."""
    u, J = mag.units("meV"), -1.2
    crystal = mag.lattice("square", (8, 8), constant=4.0)
    i, j = np.indices((8, 8))
    neel = (-1.0) ** (i + j)[..., None] * UP
    q = np.array([[0.2, 0.1, 0.0], [0.05, 0.3, 0.0], [0.0, 0.0, 0.0]])
    ratio = 1.0 / u.hbar
    frequencies = mag.spin_wave_frequencies(mag.exchange(crystal, J), crystal, neel, q, ratio, magnetic_cell=(2, 2))
    gamma = 0.5 * (np.cos(4.0 * q[:, 0]) + np.cos(4.0 * q[:, 1]))
    expected = 4.0 * abs(J) / u.hbar * np.sqrt(1.0 - gamma**2)
    # the cell has four spins: the wave q, and q + (pi, 0)
    np.testing.assert_allclose(np.abs(frequencies - expected[:, None]).min(axis=1), 0.0, atol=1e-7 * expected.max())
    for k in range(2):
        assert (np.abs(frequencies[k] / expected[k] - 1.0) < 1e-10).sum() == 2
    with pytest.raises(lt.LiethermoError, match="do not repeat"):
        mag.spin_wave_frequencies(mag.exchange(crystal, J), crystal, neel, q)


def test_antisymmetric_exchange_shifts_waves_of_one_direction():
    """``w = 2 J (1 - cos q) + K' + 2 D sin q`` for D along the spins, up to the sign of the direction."""
    J, D, K = 1.0, 0.2, 0.3
    crystal = mag.lattice("chain", 12)
    energy = [mag.exchange(crystal, J), mag.dzyaloshinskii_moriya(crystal, (0, 0, D)), mag.anisotropy(crystal, K)]
    q = np.array([[0.7, 0.0, 0.0], [-0.7, 0.0, 0.0]])
    frequencies = mag.spin_wave_frequencies(energy, crystal, up(crystal), q)[:, 0]
    base = 2.0 * J * (1.0 - np.cos(0.7)) + 2.0 * K
    np.testing.assert_allclose(
        np.sort(frequencies), [base - 2 * D * np.sin(0.7), base + 2 * D * np.sin(0.7)], rtol=1e-12
    )


def test_a_honeycomb_magnet_has_a_gap_at_its_corner():
    """At K the two branches are ``3 J -+ 3 sqrt(3) D`` [Owerre 2016]."""
    crystal = mag.lattice("honeycomb", (6, 6))
    rows = [(0, 0, (1, 0)), (0, 0, (-1, 1)), (0, 0, (0, -1)), (1, 1, (-1, 0)), (1, 1, (1, -1)), (1, 1, (0, 1))]
    D = 0.1
    energy = [mag.exchange(crystal, 1.0), mag.dzyaloshinskii_moriya(crystal.bonds(rows), (0, 0, D))]
    b = crystal.reciprocal_vectors
    corner = (2 * b[0] + b[1]) / 3.0
    frequencies = mag.spin_wave_frequencies(energy, crystal, up(crystal), corner)
    np.testing.assert_allclose(frequencies, [3.0 - 3 * 3**0.5 * D, 3.0 + 3 * 3**0.5 * D], rtol=1e-12)


def test_a_state_that_moves_or_is_unstable():
    crystal = mag.lattice("chain", 8)
    tilted = up(crystal) + 0.1 * np.arange(8)[:, None]
    with pytest.raises(lt.LiethermoError, match=r"magnetic_cell=|lt.magnetism.minimise"):
        mag.spin_wave_frequencies(mag.exchange(crystal, 1.0), crystal, tilted, [(1.0, 0.0, 0.0)], magnetic_cell=(8,))
    energy = mag.exchange(crystal, 1.0) + mag.anisotropy(crystal, 0.5, (0.0, 1.0, 0.0))
    unstable = mag.spin_wave_frequencies(energy, crystal, up(crystal), [(0.1, 0.0, 0.0)])
    assert np.isnan(unstable).any()


def test_the_dynamic_structure_factor_has_its_peak_at_the_wave():
    """One wave of a ferromagnetic chain, run and transformed: its peak is at (q, w) and not at (-q, w) or (q, -w)."""
    count, mode = 16, 3
    crystal = mag.lattice("chain", count)
    energy = [mag.exchange(crystal, 1.0), mag.zeeman(crystal, (0.0, 0.0, 0.5))]
    q = 2.0 * np.pi * mode / count
    x = np.arange(count)
    tilt = 0.01
    s = np.stack([tilt * np.cos(q * x), tilt * np.sin(q * x), np.full(count, np.sqrt(1 - tilt**2))], axis=-1)
    system = lt.SpinSystem(crystal, energy)
    run = lt.integrate(system, system.state(s), (0.0, 204.8), 0.05, lt.MetriplecticRungeKutta(4), save_every=8)
    S = mag.dynamic_structure_factor(system.spins(run.x)[:-1], run.t[:-1], crystal)
    across = S.values[..., 0, 0].real + S.values[..., 1, 1].real
    frequency, wave = np.unravel_index(np.argmax(across), across.shape)
    expected = float(mag.spin_wave_frequencies(energy, crystal, up(crystal), (q, 0.0, 0.0))[0])
    resolution = S.frequencies[1] - S.frequencies[0]
    # s_x + i s_y ~ exp(i (q x + w t)): s_x = cos(q x + w t) is the waves (q, -w) and (-q, w)
    assert wave in (mode, count - mode)
    sign = -1.0 if wave == mode else 1.0
    assert abs(S.frequencies[frequency] - sign * expected) < resolution
    static = mag.structure_factor(system.spins(run.x)[:-1], crystal)
    integral = across.sum(axis=0) * resolution
    np.testing.assert_allclose(integral[mode], (static.values[mode, 0, 0] + static.values[mode, 1, 1]).real, rtol=1e-2)


def test_structure_factors_by_transforms_are_direct_sums():
    crystal = mag.lattice("kagome", (4, 3))
    s = np.random.default_rng(2).standard_normal((5, *crystal.sites, 3))
    by_transform = mag.structure_factor(s, crystal)
    direct = mag.structure_factor(s, crystal, by_transform.wave_vectors)
    np.testing.assert_allclose(by_transform.values, direct.values, atol=1e-12)
    r, q = crystal.positions.reshape(-1, 3), by_transform.wave_vectors[2, 1]
    mode = np.exp(-1j * r @ q) @ s[0].reshape(-1, 3)
    one = mag.structure_factor(s[0], crystal, q)
    np.testing.assert_allclose(one.values, np.outer(mode, mode.conj()) / 36, atol=1e-12)
    e = q / np.linalg.norm(q)
    expected = np.einsum("ab,ab->", np.eye(3) - np.outer(e, e), one.values).real
    assert one.scattering == pytest.approx(expected)
    # the sum over a Brillouin zone of one atom is the square of the spins
    square = mag.lattice("square", (4, 6))
    t = np.random.default_rng(3).standard_normal((4, 6, 3))
    assert mag.structure_factor(t, square).trace.sum() == pytest.approx(np.sum(t**2))


def skyrmion(n, radius, vorticity=1):
    x, y = np.meshgrid(np.arange(n) - n / 2 + 0.5, np.arange(n) - n / 2 + 0.5, indexing="ij")
    r, phi = np.hypot(x, y), np.arctan2(y, x)
    theta = np.pi - np.pi * np.clip(r / radius, 0.0, 1.0)
    return np.stack(
        [np.sin(theta) * np.cos(vorticity * phi), np.sin(theta) * np.sin(vorticity * phi), np.cos(theta)], axis=-1
    )


def test_skyrmions_have_integer_charges():
    texture = skyrmion(32, 12.0)
    assert mag.topological_charge(texture, periodic=True) == pytest.approx(-1.0, abs=1e-12)
    assert mag.topological_charge(skyrmion(32, 12.0, vorticity=-1), True) == pytest.approx(1.0, abs=1e-12)
    assert mag.topological_charge(skyrmion(48, 20.0, vorticity=2), True) == pytest.approx(-2.0, abs=1e-12)
    assert mag.topological_charge(np.tile(UP, (8, 8, 1))) == 0.0
    both = mag.topological_charge(np.stack([texture, -texture]), True)
    np.testing.assert_allclose(both, [-1.0, 1.0], atol=1e-12)
    half = mag.topological_charge(skyrmion(32, 32.0)[8:24, 8:24])  # control: an open piece has no integer charge
    assert abs(half - round(half)) > 0.01


@pytest.mark.slow
def test_spins_in_equilibrium_have_the_temperature_of_their_distribution():
    """Independent spins with a quartic anisotropy, sampled from exp(-E / T)."""
    T, K, B, count = 0.4, 0.5, 0.7, 400
    random = np.random.default_rng(0)
    energy = [mag.uniaxial_anisotropy(count, {4: K}), mag.zeeman(count, (0.0, 0.0, B))]
    z = np.linspace(-1.0, 1.0, 200_001)
    weight = np.cumsum(np.exp((K * z**4 + B * z) / T))
    samples = []
    for _ in range(5):
        c = np.interp(random.uniform(0.0, weight[-1], count), weight, z)
        phi = random.uniform(0.0, 2 * np.pi, count)
        samples.append(np.stack([np.sqrt(1 - c**2) * np.cos(phi), np.sqrt(1 - c**2) * np.sin(phi), c], axis=-1))
    assert mag.spin_temperature(energy, np.array(samples), count) == pytest.approx(T, rel=0.06)  # 2,000 spins
    # bilinear energies: the formula of Nurdin and Schotte
    chain = mag.exchange(count, 1.0)
    s = samples[0]
    field = -np.asarray(chain.gradient(s.ravel())).reshape(-1, 3)
    expected = np.sum(np.cross(s, field) ** 2) / (2.0 * np.sum(s * field))
    assert mag.spin_temperature(chain, s, count) == pytest.approx(expected, rel=1e-12)
    with pytest.raises(lt.LiethermoError, match="no positive temperature"):
        mag.spin_temperature(mag.zeeman(1, (0.0, 0.0, 1.0)), [[0.0, 0.6, -0.8]], 1)


def test_the_laplacian_of_many_spins_is_estimated():
    count = 600
    s = np.random.default_rng(0).standard_normal((count, 3)) * 0.3 + UP
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    energy = mag.exchange(count, 1.0)
    field = -np.asarray(energy.gradient(s.ravel())).reshape(-1, 3)
    expected = np.sum(np.cross(s, field) ** 2) / (2.0 * np.sum(s * field))
    assert mag.spin_temperature(energy, s, count) == pytest.approx(expected, rel=0.02)


BAD = {
    "times": (lambda: mag.dynamic_structure_factor(np.ones((4, 4, 3)), [0.0, 1.0, 2.0, 4.0], CHAIN()), "evenly"),
    "few times": (lambda: mag.dynamic_structure_factor(np.ones((2, 4, 3)), [0.0, 1.0], CHAIN()), "at least 4"),
    "shape": (lambda: mag.structure_factor(np.ones((5, 3)), CHAIN()), "spins must have shape"),
    "waves": (lambda: mag.structure_factor(np.ones((4, 3)), CHAIN(), [1.0]), "wave vectors must have shape"),
    "a plane": (lambda: mag.topological_charge(np.ones((4, 3))), "spins of a plane"),
    "no length": (lambda: mag.topological_charge(np.zeros((4, 4, 3))), "greater than 0"),
    "segments": (
        lambda: mag.dynamic_structure_factor(np.ones((4, 4, 3)), np.arange(4.0), CHAIN(), segments=0),
        "segments must be",
    ),
    "open": (
        lambda: mag.spin_wave_frequencies(
            mag.exchange(4), mag.lattice("chain", 4, periodic=False), np.tile(UP, (4, 1)), [(0.0, 0.0, 0.0)]
        ),
        "periodic along every axis",
    ),
}


def CHAIN():
    return mag.lattice("chain", 4)


test_bad_measurements_are_refused = refusal_test(BAD, error=lt.LiethermoError)


def test_an_unstable_spin_does_not_hide_the_frequency_of_a_stable_one():
    """Two spins without coupling are at a minimum, with the frequency 2 K, and at a saddle."""
    crystal = mag.lattice([(2.0, 0.0, 0.0)], 4, basis=[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    of_first, of_second = np.array([1.0, 0.0]) * np.ones((4, 1)), np.array([0.0, 1.0]) * np.ones((4, 1))
    energy = [
        mag.anisotropy(crystal, 1.5 * of_first),
        mag.anisotropy(crystal, of_second, (1.0, 0.0, 0.0)),
        mag.anisotropy(crystal, -of_second, (0.0, 1.0, 0.0)),
    ]
    frequencies = mag.spin_wave_frequencies(energy, crystal, up(crystal), [(0.3, 0.0, 0.0)])
    np.testing.assert_allclose(frequencies, [[3.0, np.nan]], rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lattice": 8}, r"lattice must be one of lt\.magnetism\.lattice"),
        ({"ratio": np.ones(8)}, "ratio must be one number"),
        ({"ratio": np.nan}, "ratio must be finite"),
        ({"wave_vectors": [(np.nan, 0.0, 0.0)]}, "wave vectors must be finite"),
        ({"magnetic_cell": 3}, "magnetic_cell must be positive integers"),
        ({"magnetic_cell": (0,)}, "magnetic_cell must be positive integers"),
        ({"magnetic_cell": "x"}, "magnetic_cell must be positive integers"),
        ({"spins": np.zeros((8, 3))}, "length greater than 0"),
    ],
)
def test_bad_arguments_of_waves_are_refused(arguments, message):
    crystal = mag.lattice("chain", 8)
    good = {"energy": mag.exchange(crystal, 1.0), "lattice": crystal, "spins": up(crystal)}
    good |= {"wave_vectors": [(1.0, 0.0, 0.0)]}
    mag.spin_wave_frequencies(**good, magnetic_cell=2)
    with pytest.raises(lt.InputError, match=message):
        mag.spin_wave_frequencies(**good | arguments)


def test_wave_vectors_and_spins_of_a_structure_factor_are_finite():
    crystal = mag.lattice("chain", 8)
    with pytest.raises(lt.InputError, match="wave vectors must be finite"):
        mag.structure_factor(up(crystal), crystal, [(np.nan, 0.0, 0.0)])
    with pytest.raises(lt.InputError, match="spins must be finite"):
        mag.structure_factor(np.nan * up(crystal), crystal)
