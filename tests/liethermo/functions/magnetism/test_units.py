"""Units of magnets beside constants in closed form, and conventions of other programs beside each other."""

import numpy as np
import pytest
import scipy.constants as constants

import liethermo as lt

mag = lt.magnetism


def test_one_spin_in_one_tesla_precesses_at_28_02_ghz():
    """Published: ``gamma_e / 2 pi = 28.02495 GHz / T`` [CODATA 2018]."""
    for name, per_ghz in (("SI", 1e9), ("meV", 1e-3)):
        u = mag.units(name)
        assert float(u.frequency(1.0)) / per_ghz == pytest.approx(28.02495, abs=1e-5)
        motion = u.gilbert(0.0)
        system = lt.SpinSystem(1, mag.zeeman(1, (0.0, 0.0, 1.0), u.moment()), ratio=motion.ratio)
        period = 1.0 / float(u.frequency(1.0))
        run = lt.integrate(system, [1.0, 0.0, 0.0], (0.0, period), period / 100, lt.MetriplecticGauss(3))
        np.testing.assert_allclose(run.x[-1], [1.0, 0.0, 0.0], atol=1e-11)  # error of the method, order 6
        quarter = run.x[25]  # an electron turns counterclockwise about its field
        np.testing.assert_allclose(quarter, [0.0, 1.0, 0.0], atol=1e-11)


def test_constants_agree_between_units():
    si, meV = mag.units("SI"), mag.units("meV")
    joule = 1e-3 * constants.e
    assert meV.boltzmann == pytest.approx(0.08617333, rel=1e-7)  # meV / K
    assert meV.bohr_magneton == pytest.approx(0.05788382, rel=1e-7)  # meV / T
    assert meV.hbar == pytest.approx(0.6582120, rel=1e-7)  # meV ps
    assert meV.gamma(2.0) * 1e12 == pytest.approx(si.gamma(2.0), rel=1e-14)
    # two Bohr magnetons 1 angstrom apart: mu_0 mu_B^2 / 4 pi a^3 = 0.05368 meV
    assert meV.dipole_constant * meV.bohr_magneton**2 == pytest.approx(0.0536815, rel=1e-5)
    in_joule = si.dipole_constant * si.bohr_magneton**2 / 1e-30
    assert meV.dipole_constant * meV.bohr_magneton**2 == pytest.approx(in_joule / joule, rel=1e-14)
    assert float(meV.thermal_energy(300.0)) == pytest.approx(25.852, abs=1e-3)
    assert (mag.units("reduced").gamma(1.0), float(mag.units("reduced").moment(3.0))) == (1.0, 3.0)


@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_gilbert_and_landau_lifshitz_are_their_equations(alpha):
    u, mu = mag.units("meV"), mag.units("meV").moment(2.0)
    B, s = np.array([0.1, 0.2, 5.0]), np.array([0.6, 0.0, 0.8])
    energy = mag.zeeman(1, B, mu)
    rates = {}
    for form in ("gilbert", "landau_lifshitz"):
        motion = getattr(u, form)(alpha, mu)
        system = lt.SpinSystem(1, energy, lt.LandauLifshitz(motion.rate), ratio=motion.ratio)
        rates[form] = np.asarray(system.vector_field(s))
    gamma = u.gamma()
    ll = -gamma * np.cross(s, B) - alpha * gamma * np.cross(s, np.cross(s, B))
    np.testing.assert_allclose(rates["landau_lifshitz"], ll, rtol=1e-13, atol=1e-13)
    g = rates["gilbert"]  # implicit: s' = -gamma s x B + alpha s x s'
    np.testing.assert_allclose(g, -gamma * np.cross(s, B) + alpha * np.cross(s, g), rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_a_bath_in_kelvin_gives_the_function_of_langevin():
    """``<s_z> = coth x - 1 / x`` with x = mu B / k T [Langevin 1905], by noise in meV, ps, tesla and kelvin."""
    u, B, T, count = mag.units("meV"), 200.0, 100.0, 512
    mu = u.moment(2.0)
    motion = u.gilbert(1.0, mu)
    bath = lt.HeatBaths(np.inf, u.thermal_energy(T))
    system = lt.SpinSystem(
        count, mag.zeeman(count, (0.0, 0.0, B), mu), lt.LandauLifshitz(motion.rate), bath, motion.ratio
    )
    start = np.tile([0.0, 0.0, 1.0], count)
    noise = lt.Fluctuations(seed=1)
    run = lt.integrate(
        system, system.state(start), (0.0, 1.2), 1e-3, lt.MetriplecticMidpoint(), noise=noise, save_every=20
    )
    x = float(mu) * B / float(u.thermal_energy(T))
    mean = np.asarray(system.spins(run.x))[20:, :, 2].mean()
    assert mean == pytest.approx(1.0 / np.tanh(x) - 1.0 / x, abs=0.015)  # three standard errors


def test_conventions_of_other_programs_are_one_energy():
    """Energies as other programs write them, of one random state, beside the conversions of the guide."""
    rng = np.random.default_rng(2)
    crystal = mag.lattice("triangular", (4, 3))
    bonds = crystal.shell(1)
    s = rng.standard_normal((12, 3))
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    J, D = 1.3, rng.standard_normal((3, 3))
    pairs = bonds.site_pairs().reshape(3, 12, 2)
    once = sum(float(s[i] @ s[j]) for kind in pairs for i, j in kind)
    dmi = sum(float(D[k] @ np.cross(s[i], s[j])) for k, kind in enumerate(pairs) for i, j in kind)
    x = s.ravel()
    vampire = -J * once
    assert float(mag.exchange(crystal, J)(x)) == pytest.approx(vampire)
    sunny = +J * once + dmi
    assert float((mag.exchange(crystal, -J) + mag.dzyaloshinskii_moriya(bonds, D))(x)) == pytest.approx(sunny)
    uppasd = -J * 2.0 * once - 2.0 * dmi  # sums over i != j visit each pair twice
    converted = mag.exchange(crystal, 2.0 * J) + mag.dzyaloshinskii_moriya(bonds, -2.0 * D)
    assert float(converted(x)) == pytest.approx(uppasd)


def test_bad_units_are_refused():
    with pytest.raises(lt.LiethermoError, match='"SI", "meV" or "reduced"'):
        mag.units("cgs")
    with pytest.raises(lt.LiethermoError, match="alpha must be >= 0"):
        mag.units("SI").gilbert(-0.1)
    with pytest.raises(lt.LiethermoError, match="a moment must be positive"):
        mag.units("SI").gilbert(0.1, moment=0.0)


def test_two_sublattices_have_one_temperature():
    """A dimer of two unlike spins in one bath: ``<s_1 . s_2>`` is Langevin's function of J / kT, in meV and kelvin.

    Moments, damping and so the rates of both spins differ by a factor of up to ten; the temperature does not. As a
    control, the correlation at one and a half times the temperature is more than six standard errors away.
    """
    u = lt.magnetism.units("meV")
    J, kT = -2.0, float(u.thermal_energy(15.0))  # antiferromagnetic
    motion = u.gilbert(np.array([0.5, 0.1]), u.moment(np.array([2.2, 5.0])))
    system = lt.SpinSystem(
        (2,),
        lt.magnetism.exchange((2,), [(0, 1, J)]),
        lt.LandauLifshitz(motion.rate),
        lt.HeatBaths(np.inf, kT),
        ratio=motion.ratio,
    )
    starts = np.repeat(np.asarray(system.state([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))[None], 3000, axis=0)
    run = lt.ensemble(system, starts, (0.0, 20.0), 0.05, lt.MetriplecticMidpoint(), noise=lt.Fluctuations(seed=4))
    s = np.asarray(system.spins(run.x))
    product = (s[:, 0] * s[:, 1]).sum(axis=1)
    error = product.std() / np.sqrt(len(product))

    def langevin(temperature):
        return 1.0 / np.tanh(J / temperature) - temperature / J

    assert abs(product.mean() - langevin(kT)) < 4.0 * error
    assert abs(product.mean() - langevin(1.5 * kT)) > 6.0 * error
