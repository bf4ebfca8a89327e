"""Minima and hysteresis loops beside closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt

mag = lt.magnetism


@pytest.mark.sampled(1)
@pytest.mark.parametrize("degrees", [1.0, 20.0, 45.0, 80.0])
def test_a_grain_switches_at_the_field_of_stoner_and_wohlfarth(degrees):
    """``h = (cos^{2/3} a + sin^{2/3} a)^{-3/2}`` in units of 2 K / mu [Stoner & Wohlfarth 1948]."""
    angle, mu, K = np.radians(degrees), 0.5, 0.3
    expected = (np.cos(angle) ** (2 / 3) + np.sin(angle) ** (2 / 3)) ** -1.5
    h = np.concatenate([[0.0], expected * np.array([0.9, 0.99, 0.999, 1.001, 1.01])])
    direction = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    fields = h[:, None] * 2 * K / mu * direction
    loop = mag.hysteresis_loop(mag.anisotropy(1, K), [[0.0, 0.0, 1.0]], fields, mu)
    assert (loop.magnetisation[:4, 2] > 0.0).all()
    assert (loop.magnetisation[4:, 2] < 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(loop.spins, axis=-1), 1.0, rtol=1e-14)


def test_an_anisotropy_of_50_micro_ev_switches_at_its_field_in_tesla():
    """A grain of 2.5 Bohr magnetons and 0.05 meV switches at ``2 K / mu`` = 0.691 T along its axis.

    The field is from the constants 0.05788 meV / T and 0.05 meV, not from the units of the library.
    """
    mu = mag.units("meV").moment(2.5)
    threshold = 2 * 0.05 / (2.5 * 0.0578838)
    tilt = np.radians(1e-3)
    expected = threshold * (np.cos(tilt) ** (2 / 3) + np.sin(tilt) ** (2 / 3)) ** -1.5
    fields = np.array([0.999, 1.001])[:, None] * expected * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    loop = mag.hysteresis_loop(mag.anisotropy(1, 0.05), [[0.0, 0.0, 1.0]], fields, mu)
    assert loop.magnetisation[0, 2] > 0.0 > loop.magnetisation[1, 2]


def test_a_spin_opposite_to_its_field_turns():
    loop = mag.hysteresis_loop(mag.anisotropy(1, 0.1), [[0.0, 0.0, 1.0]], [[0.0, 0.0, -1.0]])
    np.testing.assert_allclose(loop.magnetisation[0], [0.0, 0.0, -1.0], atol=1e-7)
    fixed = mag.minimise(mag.zeeman(1, (0.0, 0.0, -1.0)), [[0.0, 0.0, 1.0]])  # control: no torque, no step
    assert (fixed.steps, fixed.spins[0, 2]) == (0, 1.0)


def test_triangles_order_at_120_degrees():
    """The energy of a triangular antiferromagnet is ``-3 |J| / 2`` a spin [Wannier 1950, for vectors]."""
    crystal = mag.lattice("triangular", (6, 6))
    start = np.random.default_rng(1).standard_normal((6, 6, 3))
    start /= np.linalg.norm(start, axis=-1, keepdims=True)
    ground = mag.minimise(mag.exchange(crystal, -1.0), start, 1e-9)
    assert ground.energy / 36 == pytest.approx(-1.5, abs=1e-12)
    assert ground.torque < 1e-9


def test_lengths_are_kept_and_functions_are_accepted():
    start = np.array([[2.0, 0.0, 0.1], [0.0, 0.5, 0.1]])
    minimum = mag.minimise(lambda s: -s[0, 2] - 2.0 * s[1, 2], start)
    np.testing.assert_allclose(np.linalg.norm(minimum.spins, axis=1), np.linalg.norm(start, axis=1), rtol=1e-14)
    np.testing.assert_allclose(minimum.spins[:, 2], np.linalg.norm(start, axis=1), rtol=1e-14)


def test_a_descent_that_does_not_end_says_so():
    start = np.random.default_rng(1).standard_normal((20, 3))
    with pytest.raises(lt.LiethermoError, match="after 3 steps the torque is"):
        mag.minimise(mag.exchange(20), start, max_steps=3)
    with pytest.raises(lt.LiethermoError, match=r"shape \(\*sites, 3\)"):
        mag.minimise(mag.exchange(20), start.ravel())
    with pytest.raises(lt.LiethermoError, match="greater than 0"):
        mag.minimise(mag.exchange(2), np.zeros((2, 3)))
    with pytest.raises(lt.LiethermoError, match=r"fields must have shape \(n, 3\)"):
        mag.hysteresis_loop(mag.exchange(20), start, [0.0, 0.0, 1.0])


def test_functions_of_spins_and_terms_are_one_energy():
    """Python functions take spins of the shape of the sites in every helper, alone, in a list and in a sum."""
    sites, weights = 3, np.array([1.0, 2.0, 3.0])
    coupling, easy = mag.exchange(sites, 0.7), mag.anisotropy(sites, weights)

    def anisotropy_of_spins(s):
        return -jnp.sum(jnp.asarray(weights) * s[..., 2] ** 2)

    start = np.array([[0.1, 0.2, 1.0], [0.3, -0.1, 0.9], [0.0, 0.4, 0.8]])
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    for energy in ([coupling, anisotropy_of_spins], coupling + anisotropy_of_spins, [anisotropy_of_spins, coupling]):
        loop = mag.hysteresis_loop(energy, start, [(0.5, 0.0, 0.2)], moment=2.0)
        expected = mag.hysteresis_loop([coupling, easy], start, [(0.5, 0.0, 0.2)], moment=2.0)
        np.testing.assert_allclose(loop.energies, expected.energies, rtol=1e-13)
        found, reference = (mag.minimise(e, start) for e in (energy, [coupling, easy]))
        np.testing.assert_allclose(found.spins, reference.spins, atol=1e-7)
        kT = mag.spin_temperature(energy, start, sites)
        assert kT == pytest.approx(mag.spin_temperature([coupling, easy], start, sites), rel=1e-13)
        system = lt.SpinSystem(sites, energy)
        assert float(system.energy(start.ravel())) == pytest.approx(float((coupling + easy)(start.ravel())), rel=1e-14)
    alone = mag.hysteresis_loop(anisotropy_of_spins, start, [(0.5, 0.0, 0.2)])
    np.testing.assert_allclose(alone.energies, mag.hysteresis_loop(easy, start, [(0.5, 0.0, 0.2)]).energies, rtol=1e-13)
    with pytest.raises(lt.FunctionError, match="each term of the energy must be a function"):
        mag.minimise([coupling, 1.0], start)


def test_a_function_whose_globals_change_is_another_energy():
    strength = 1.0

    def anisotropy_of_spins(s):
        return -strength * jnp.sum(s[..., 2])

    start = [[0.6, 0.0, 0.8]]
    assert mag.minimise(anisotropy_of_spins, start).energy == pytest.approx(-1.0)
    strength = 3.0
    assert mag.minimise(anisotropy_of_spins, start).energy == pytest.approx(-3.0)


def test_a_minimum_belongs_to_one_time():
    """The advice of the message works."""
    turning = mag.zeeman(1, lambda t: jnp.array([jnp.cos(t), jnp.sin(t), 0.0]))
    start = np.array([[0.0, 0.0, 1.0]])
    chain = mag.lattice("chain", 1, images=True)
    for call in (
        lambda e: mag.minimise(e, start),
        lambda e: mag.hysteresis_loop(e, start, [(0.0, 0.0, 1.0)]),
        lambda e: mag.spin_temperature(e, start, 1),
        lambda e: mag.spin_wave_frequencies(e, chain, start, [(0.0, 0.0, 0.0)]),
        lambda e: mag.minimise(lambda s, t: -jnp.sum(s[..., 0]), start),
    ):
        with pytest.raises(lt.InputError, match=r"energy\.at_time\(t\)"):
            call(turning)
    rest = mag.minimise(turning.at_time(0.5 * np.pi), start)
    np.testing.assert_allclose(rest.spins, [[0.0, 1.0, 0.0]], atol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0.0}, "the tolerance must be positive"),
        ({"tolerance": "x"}, "the tolerance must be made of real numbers"),
        ({"max_steps": 0}, "max_steps must be a positive integer"),
        ({"max_steps": np.inf}, "max_steps must be a positive integer"),
        ({"perturbation": -1.0}, "the perturbation must be >= 0"),
        ({"perturbation": [0.1, 0.2]}, "the perturbation must be one number"),
        ({"seed": -1}, "the seed must be an integer"),
        ({"moment": [1.0, 2.0, 3.0]}, r"a moment must have shape \(\) or \(2,\)"),
        ({"moment": [1.0, -1.0]}, "the mean of the moments must be positive"),
        ({"fields": [(0.0, np.nan, 1.0)]}, "fields must be finite"),
        ({"spins": [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]}, "length greater than 0"),
        ({"spins": 1.0}, r"shape \(\*sites, 3\)"),
        ({"energy": lambda a, b, c: 0.0}, "could not be evaluated"),
    ],
)
def test_bad_arguments_of_a_loop_are_refused(arguments, message):
    good = {"energy": mag.anisotropy(2, 1.0), "spins": [[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]], "fields": [(0.0, 0.0, 1.0)]}
    mag.hysteresis_loop(**good)
    with pytest.raises(lt.LiethermoError, match=message):
        mag.hysteresis_loop(**good | arguments)
