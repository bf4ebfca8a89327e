"""Spins: their energies against sums over edges, damping against its formula, laws, closed forms, refusals."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.sparse

import liethermo as lt
import manifolds as mf
from tests.cases import BuiltOnUse, few_combinations

SITES = (3, 4)
COUNT = 12
RANDOM = np.random.default_rng(7)
SPINS = RANDOM.standard_normal((*SITES, 3))
JS = RANDOM.standard_normal(SITES)
DS = RANDOM.standard_normal((*SITES, 3))


def unit(*sites, seed=0):
    s = np.random.default_rng(seed).standard_normal((*sites, 3))
    return s / np.linalg.norm(s, axis=-1, keepdims=True)


def sum_over_pairs(s, offsets, closed, pair):
    """The sum of ``pair(site, s_i, s_j)`` over pairs of a site with the one ahead, as loops."""
    total = 0.0
    for site in np.ndindex(*SITES):
        for offset in offsets:
            ahead = [a + b for a, b in zip(site, offset, strict=True)]
            if any(not around and not 0 <= a < n for a, n, around in zip(ahead, SITES, closed, strict=True)):
                continue
            total = total + pair(site, s[site], s[tuple(a % n for a, n in zip(ahead, SITES, strict=True))])
    return total


NEAREST = [(1, 0), (0, 1)]
MATRIX = np.triu(RANDOM.standard_normal((COUNT, COUNT)) * (RANDOM.random((COUNT, COUNT)) < 0.3), 1)
EDGES = [(int(i), int(j), float(MATRIX[i, j])) for i, j in zip(*np.nonzero(MATRIX), strict=True)]
VECTORS = [(3, 1, (0.1, 0.2, -0.3)), (0, 11, (1.0, 0.0, 0.5))]


def sum_over_edges(s, edges, pair):
    flat = s.reshape(-1, 3)
    return sum(pair(flat[i], flat[j], weight) for i, j, weight in edges)


def pair_exchange(a, b, J):
    return -J * jnp.dot(a, b)


def pair_dmi(a, b, D):
    return jnp.dot(jnp.asarray(D), jnp.cross(a, b))


mag = lt.magnetism
ENERGIES = BuiltOnUse(
    {
        "exchange": lambda: (
            mag.exchange(SITES, 0.7),
            lambda s: sum_over_pairs(s, NEAREST, (True, True), lambda site, a, b: -0.7 * a @ b),
        ),
        "open, of each pair": lambda: (
            mag.exchange(SITES, JS, periodic=(False, True)),
            lambda s: sum_over_pairs(s, NEAREST, (False, True), lambda site, a, b: -JS[site] * (a @ b)),
        ),
        "diagonal neighbours": lambda: (
            mag.exchange(SITES, [JS, 2.0 * JS], neighbours=[(1, -1), (0, 2)]),
            lambda s: (
                sum_over_pairs(s, [(1, -1)], (True, True), lambda site, a, b: -JS[site] * (a @ b))
                + sum_over_pairs(s, [(0, 2)], (True, True), lambda site, a, b: -2.0 * JS[site] * (a @ b))
            ),
        ),
        "matrix": lambda: (mag.exchange(COUNT, MATRIX + MATRIX.T), lambda s: sum_over_edges(s, EDGES, pair_exchange)),
        "sparse": lambda: (
            mag.exchange(COUNT, scipy.sparse.csr_array(MATRIX + MATRIX.T)),
            lambda s: sum_over_edges(s, EDGES, pair_exchange),
        ),
        "edges": lambda: (mag.exchange(SITES, EDGES), lambda s: sum_over_edges(s, EDGES, pair_exchange)),
        "DMI": lambda: (
            mag.dzyaloshinskii_moriya(SITES, DS, periodic=False),
            lambda s: sum_over_pairs(s, NEAREST, (False, False), lambda site, a, b: pair_dmi(a, b, DS[site])),
        ),
        "DMI on edges": lambda: (
            mag.dzyaloshinskii_moriya(SITES, VECTORS),
            lambda s: sum_over_edges(s, VECTORS, pair_dmi),
        ),
        "anisotropy": lambda: (
            mag.anisotropy(SITES, JS, DS),
            lambda s: -jnp.sum(JS * jnp.sum(DS * s, axis=-1) ** 2),
        ),
        "along axes": lambda: (
            mag.anisotropy(SITES, JS, (0.0, 2.0, 0.0)),
            lambda s: -jnp.sum(JS * (2.0 * s[..., 1]) ** 2),
        ),
        "Zeeman": lambda: (
            mag.zeeman(SITES, (0.1, 0.2, 0.3), JS),
            lambda s: -jnp.sum(JS * (s @ jnp.array([0.1, 0.2, 0.3]))),
        ),
    }
)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ENERGIES)
def test_energies_are_the_sums_over_their_edges(name):
    energy, written = ENERGIES[name]
    x = jnp.append(SPINS.ravel(), 3.0)  # what comes behind the spins is left alone
    value, gradient = jax.jit(jax.value_and_grad(lambda x: written(x[:-1].reshape(*SITES, 3))))(x)
    assert energy.is_quadratic
    assert float(energy.value(x)) == pytest.approx(float(value), abs=1e-13)
    np.testing.assert_allclose(jax.jit(energy.gradient)(x), gradient, atol=1e-13)
    pattern = energy.hessian_pattern(37).toarray()
    hessian = np.asarray(jax.jit(jax.jacfwd(energy.gradient))(x))
    assert not hessian[~pattern].any()


D = 0.3
PLANE_VECTORS = [(0.0, D, 0.0), (-D, 0.0, 0.0)]


@pytest.mark.parametrize(
    "vectors",
    [
        PLANE_VECTORS,
        [(0, D, 0), (-D, 0, 0)],
        tuple(PLANE_VECTORS),
        [list(v) for v in PLANE_VECTORS],
        [np.array(v) for v in PLANE_VECTORS],
    ],
    ids=["tuples", "with integers", "tuple", "lists", "arrays"],
)
def test_a_vector_for_each_neighbour_is_no_list_of_edges(vectors):
    """``[(0, D, 0), (-D, 0, 0)]`` was read as the edges (0, D) and (-D, 0)."""
    energy = lt.models.spin_lattice(SITES, 0.0, dmi=vectors, baths=False).energy
    given = {(1, 0): PLANE_VECTORS[0], (0, 1): PLANE_VECTORS[1]}

    def energy_by_pairs(s):
        return sum(
            sum_over_pairs(s, [o], (True, True), lambda site, a, b, v=v: pair_dmi(a, b, v)) for o, v in given.items()
        )

    assert float(energy.value(SPINS.ravel())) == pytest.approx(float(energy_by_pairs(SPINS)), abs=1e-13)


def test_a_list_of_integers_is_a_vector_for_the_neighbour():
    """On a chain ``[(0, 1, 0)]`` is the vector of the pair ahead; an edge has a vector behind its two ends."""
    chain = np.random.default_rng(3).standard_normal((5, 3))
    energy = mag.dzyaloshinskii_moriya(5, [(0, 1, 0)])
    assert float(energy.value(chain.ravel())) == pytest.approx(np.cross(chain, np.roll(chain, -1, axis=0))[:, 1].sum())
    edge = mag.dzyaloshinskii_moriya(5, [(0, 1, (0, 1, 0))])
    assert float(edge.value(chain.ravel())) == pytest.approx(np.cross(chain[0], chain[1])[1])


def test_an_exchange_for_each_site_of_a_square_lattice_is_no_graph():
    """An array of the shape (4, 4) of the sites was refused as a matrix that is not (16, 16)."""
    J, s = RANDOM.standard_normal((4, 4)), RANDOM.standard_normal((4, 4, 3))
    by_sites = sum(np.sum(J * np.sum(s * np.roll(s, -1, axis), axis=-1)) for axis in (0, 1))
    assert float(mag.exchange((4, 4), J).value(s.ravel())) == pytest.approx(-by_sites)
    values = mag.exchange(3, [(0.1, 0.2, 0.3)])  # of the pair ahead of each of three sites, not an edge from 0.1 to 0.2
    assert float(values.value(s[0, :3].ravel())) == pytest.approx(
        -np.sum(np.array([0.1, 0.2, 0.3]) * np.sum(s[0, :3] * np.roll(s[0, :3], -1, 0), axis=-1))
    )


def formula(x, sites, H_s, rate, ratio, capacity):
    """The motion written once more, in NumPy: one bath."""
    s, a = x[:-1].reshape(-1, 3), H_s(x[:-1]).reshape(-1, 3)
    torque = np.cross(s, a)
    r, g = np.broadcast_to(rate, sites).reshape(-1, 1), np.broadcast_to(ratio, sites).reshape(-1, 1)
    T = np.exp(x[-1] / capacity)
    return np.append((g * torque + r * np.cross(s, torque)).ravel(), np.sum(r * torque**2) / T)


def small_lattice(**changes):
    """Three spins with everything."""
    given = {"exchange_constant": 0.8, "anisotropy_constant": 0.3, "field": (0.2, 0.0, 0.5), "dmi": (0.1, 0.3, 0.0)}
    return lt.models.spin_lattice(3, rate=np.array([0.1, 0.5, 0.2]), **given | changes)


def test_damping_is_landau_and_lifshitz_s():
    ratio, rate = np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.5, 0.2])
    energy = mag.exchange(3, 0.8) + mag.zeeman(3, (0.2, 0.0, 0.5))
    system = lt.SpinSystem(3, energy, lt.LandauLifshitz(rate), lt.HeatBaths(2.0), ratio)
    x = np.append(unit(3).ravel(), 0.4)

    def energy_by_hand(s):
        s = s.reshape(3, 3)
        return -0.8 * jnp.sum(s * jnp.roll(s, 1, 0)) - s.sum(0) @ jnp.array([0.2, 0.0, 0.5])

    gradient = jax.grad(energy_by_hand)
    expected = formula(x, (3,), lambda s: np.asarray(gradient(s)), rate, ratio, 2.0)
    np.testing.assert_allclose(system.vector_field(x), expected, atol=1e-14)
    assert system.check().passed
    alone = lt.SpinSystem(3, energy, lt.LandauLifshitz(rate), ratio=ratio)
    np.testing.assert_allclose(alone.vector_field(x[:-1]), expected[:-1], atol=1e-14)
    assert alone.energy_law == "nonincreasing"
    assert alone.check().passed
    gamma, damping = lt.LandauLifshitz.gilbert(0.3, 2.0)
    s, a = unit(2)
    landau = gamma * np.cross(s, a) + damping * np.cross(s, np.cross(s, a))
    np.testing.assert_allclose(landau, 2.0 * np.cross(s, a) + 0.3 * np.cross(s, landau), atol=1e-14)


def test_each_site_heats_its_own_bath():
    system = small_lattice(baths=lt.HeatBaths([1.0, 2.0], [1.0, 3.0], number=2), bath=np.array([1, 0, 1]))
    assert system.check().passed
    x = np.concatenate([unit(3).ravel(), [0.1, -0.2]])
    flow, gradient = np.asarray(system.vector_field(x)), np.asarray(system.energy.gradient(x))
    torque = np.cross(x[:9].reshape(3, 3), gradient[:9].reshape(3, 3))
    heat = np.array([0.1, 0.5, 0.2]) * np.sum(torque**2, axis=1)
    T = np.array([np.exp(0.1), 3.0 * np.exp(-0.1)])
    np.testing.assert_allclose(system.temperatures(x), T, atol=1e-14)
    np.testing.assert_allclose(flow[9:], np.array([heat[1], heat[0] + heat[2]]) / T, atol=1e-14)


@pytest.mark.parametrize("baths", [True, lt.HeatBaths(number=2)])
def test_the_force_is_that_of_its_factor_for_any_gradients(baths):
    system = small_lattice(baths=baths, bath=None if baths is True else np.array([1, 0, 1]))
    x, dH, dS = RANDOM.standard_normal((3, system.dim))
    dH[system.body_dim :] = np.abs(dH[system.body_dim :])  # temperatures, which constant capacities have above zero
    B = system.dissipation.factor(system, x, jnp.asarray(dH), ())
    force = system.dissipation.force(system, x, jnp.asarray(dH), jnp.asarray(dS), ())
    np.testing.assert_allclose(force, B.times(B.transpose_times(jnp.asarray(dS))), atol=1e-13)
    np.testing.assert_allclose(B.transpose_times(jnp.asarray(dH)), 0.0, atol=1e-13)


@pytest.mark.slow
def test_the_suite_of_dissipations():
    lt.testing.check_dissipation(small_lattice())


@functools.cache
def reference(t=1.0):
    """By SciPy from the formula, the gradient from JAX."""
    system = small_lattice(baths=lt.HeatBaths(3.0))
    x = np.append(unit(3).ravel(), 0.0)
    gradient = jax.jit(lambda x: system.energy.gradient(x))

    def H_s(s):
        return np.asarray(gradient(np.append(s, 0.0)))[:-1]

    def field(t, x):
        return formula(x, (3,), H_s, np.array([0.1, 0.5, 0.2]), 1.0, 3.0)

    return system, x, scipy.integrate.solve_ivp(field, (0.0, t), x, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


@pytest.mark.parametrize(
    ("method", "order", "steps"),
    [
        (lt.MetriplecticRungeKutta(4), 4, (10, 20, 40)),
        pytest.param(lt.MetriplecticGauss(2), 4, (5, 10, 20), marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticMidpoint(), 2, (20, 40, 80), marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticGauss(1), 2, (20, 40, 80), marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticRungeKutta(8), 8, (17, 22, 28), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_methods_converge_to_the_motion_at_their_order_with_the_laws_exact(method, order, steps):
    system, x, exact = reference()
    errors = []
    for n in steps:
        solution = lt.integrate(system, x, (0.0, 1.0), 1.0 / n, method)
        errors.append(np.abs(solution.x[-1] - exact).max())
        assert np.ptp(solution.energy) < 1e-14 * abs(solution.energy[0])
        assert np.diff(solution.entropy).min() > 0.0
        assert np.abs(np.linalg.norm(system.spins(solution.x), axis=-1) - 1.0).max() < 2e-15
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert -slope == pytest.approx(order, abs=0.3)


def single_spin_solution(t, start, field, rate):
    """Return the exact spin at some times, shape (..., 3), from a unit vector at t = 0.

    ``s_3 = tanh(rate B t + artanh s_3(0))``, and the rest turns by the angle ``B t`` [Landau & Lifshitz 1935].
    """
    t, s = np.asarray(t, dtype=float), np.asarray(start, dtype=float)
    growth = rate * field * t
    # addition theorems of tanh and sech avoid artanh(s_3(0)), which overflows if s_3(0) rounds to 1
    third = (np.sinh(growth) + s[2] * np.cosh(growth)) / (np.cosh(growth) + s[2] * np.sinh(growth))
    transverse_factor = 1.0 / (np.cosh(growth) + s[2] * np.sinh(growth))
    c, d = np.cos(field * t), np.sin(field * t)
    return np.stack(
        [transverse_factor * (c * s[0] - d * s[1]), transverse_factor * (d * s[0] + c * s[1]), third], axis=-1
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticRungeKutta(6)], ids=str)
def test_a_single_spin_switches_when_the_closed_form_says(method):
    B, rate = 2.0, 0.15
    system = lt.models.single_spin(B, rate)
    start = np.array([np.sin(3.0), 0.0, np.cos(3.0)])
    run = functools.partial(lt.integrate, system, start, method=method)
    solution = run((0.0, 20.0), 0.01, save_every=50)
    exact = single_spin_solution(solution.t, start, B, rate)
    np.testing.assert_allclose(solution.x, exact, atol=3e-3 if method.order == 2 else 1e-10)
    assert np.abs(np.linalg.norm(solution.x, axis=1) - 1.0).max() < 1e-14
    switched = -np.arctanh(start[2]) / (rate * B)
    long, short = (run((0.0, 20.0), h, until=lambda s: s[2]).event_time for h in (0.02, 0.01))
    if method.order == 2:  # an error in h^2, which extrapolation removes
        assert (long - switched) / (short - switched) == pytest.approx(4.0, rel=1e-2)
        assert (4.0 * short - long) / 3.0 == pytest.approx(switched, rel=1e-7)
    else:
        assert short == pytest.approx(switched, rel=1e-10)


def test_one_spin_is_a_vector():
    heated = lt.models.single_spin(baths=lt.HeatBaths(2.0))
    for spin in ([0.6, 0.0, 0.8], [[0.6, 0.0, 0.8]], [0.6, 0.0, 0.8, 0.0]):
        assert np.array_equal(heated.state(spin), [0.6, 0.0, 0.8, 0.0])


def test_the_closed_form_solves_the_equations():
    start, t = np.array([0.6, 0.0, -0.8]), 1.7
    exact = functools.partial(single_spin_solution, start=start, field=1.3, rate=0.4)
    s, slope = exact(t), (exact(t + 1e-5) - exact(t - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, lt.models.single_spin(1.3, 0.4).vector_field(s), atol=1e-9)
    assert s[2] == pytest.approx(np.tanh(0.4 * 1.3 * t + np.arctanh(-0.8)), abs=1e-15)


@pytest.mark.slow
def test_a_small_wave_on_a_ring_has_the_frequency_of_its_length():
    n, J, K, amplitude = 24, 0.9, 0.2, 1e-5
    system = lt.models.spin_lattice(n, J, K, rate=0.0, baths=False)
    q = 2.0 * np.pi * 5 / n
    s = np.stack([amplitude * np.cos(q * np.arange(n)), amplitude * np.sin(q * np.arange(n)), np.ones(n)], axis=1)
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    solution = lt.integrate(system, system.state(s), (0.0, 2.0), 0.05, lt.MetriplecticRungeKutta(6), engine="array")
    wave = np.asarray(system.spins(solution.x))[..., 0] + 1j * np.asarray(system.spins(solution.x))[..., 1]
    phase = np.unwrap(np.angle(wave @ np.exp(-1j * q * np.arange(n))))
    frequency = np.polyfit(solution.t, phase, 1)[0]
    expected_frequency = 2.0 * J * (1.0 - np.cos(q)) + 2.0 * K  # of a wave of q radians per site, without a field
    assert abs(frequency) == pytest.approx(expected_frequency, rel=1e-8)
    assert solution.audit().passed


ORDER_METHODS = [lt.MetriplecticGauss(1), lt.MetriplecticRungeKutta(4)]


def run_damped_lattice(count, h, t, method, **given):
    system = lt.models.spin_lattice(count, anisotropy_constant=0.1, **given)
    n = max(1, round(t / h))
    solution = lt.integrate(system, system.state(unit(count)), (0.0, n * h), h, method, save_every=n, engine="array")
    energy, stats = solution.energy, solution.stats
    assert max(abs(energy[0] - np.array(stats.energy_range))) <= 1e-13 * abs(energy[0])
    assert stats.least_entropy_increment > 0.0
    assert np.abs(np.linalg.norm(system.spins(solution.x), axis=-1) - 1.0).max() < 1e-14
    return solution


@pytest.mark.slow
@few_combinations(h=[0.1, 0.03, 0.01, 0.003, 0.001], method=[*ORDER_METHODS, lt.MetriplecticGauss(2)])
def test_ten_thousand_damped_spins_with_a_bath_at_every_step(method, h):
    run_damped_lattice(10_000, h, 2.0, method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ORDER_METHODS, ids=str)
def test_a_million_damped_spins(method):
    run_damped_lattice(1_000_000, 0.1, 0.5, method)


@pytest.mark.slow
def test_double_brackets_on_a_lattice_lower_the_energy_to_the_last_bit_of_the_lengths():
    system = lt.models.spin_lattice((16, 16), anisotropy_constant=0.1, baths=False, rate=0.3)
    for method in (lt.MetriplecticGauss(1), lt.MetriplecticRungeKutta(4)):
        solution = lt.integrate(system, system.state(unit(16, 16)), (0.0, 10.0), 0.1, method, engine="array")
        assert np.diff(solution.energy).max() < 0.0
        assert np.abs(np.linalg.norm(system.spins(solution.x), axis=-1) - 1.0).max() < 1e-14
        assert solution.audit().passed


def test_control_a_correction_that_is_not_local_leaves_the_spheres(monkeypatch):
    system = small_lattice()
    monkeypatch.setattr(lt.SpinSystem, "constraint_surface", None)
    solution = lt.integrate(
        system, system.state(unit(3)), (0.0, 5.0), 0.25, lt.MetriplecticRungeKutta(6), engine="compiled"
    )
    assert np.abs(np.linalg.norm(system.spins(solution.x), axis=-1) - 1.0).max() > 1e-6


CHAIN = [(0, 1, 1.0), (1, 2, 1.0)]
REFUSED_CALLS = [
    (lambda: small_lattice().state(np.zeros((3, 2))), r"\(3, 3\), or \(10,\) with all components in one row"),
    (lambda: small_lattice().state(np.zeros((4, 3))), r"must have shape \(3, 3\)"),
    (lambda: small_lattice().state(np.zeros(8)), r"\(10,\) with all components"),
    (lambda: mag.exchange(3, [(0, 1, 1.0), (1, 3, 1.0)]), r"the edge \(1, 3\) must join two of the 3 parts"),
    (lambda: mag.exchange(3, np.triu(np.ones((3, 3)), 1)), "the exchange must be symmetric"),
    (lambda: mag.exchange(3, np.ones((3, 3))), "of site 0 with itself"),
    (lambda: mag.exchange(4, np.ones((3, 3))), r"of 4 parts must be a \(4, 4\) matrix"),
    (lambda: mag.exchange(3, [(0, 1, np.inf)]), "between site 0 and site 1 must be finite, got inf"),
    (lambda: mag.exchange((4, 4), np.ones(3)), r"an exchange constant must have shape \(\) or"),
    (lambda: mag.exchange((4, 4), 1.0, neighbours=[(1, 0), (-1, 0)]), "name a pair twice"),
    (lambda: mag.exchange((4, 4), 1.0, neighbours=[(0, 0)]), "not all zero"),
    (lambda: mag.exchange((4, 4), 1.0, periodic=(True,)), "each of the 2 axes"),
    (lambda: mag.exchange((4, 0)), "sites must be a positive integer"),
    (lambda: mag.dzyaloshinskii_moriya(3, [(0, 3, (1, 0, 0))]), r"the edge \(0, 3\) must join two of the 3 sites"),
    (lambda: mag.dzyaloshinskii_moriya(3, [(0, 1, (1, 0, 0)), (1, 0, (1, 0, 0))]), "given twice"),
    (lambda: mag.zeeman(3, (1.0, 2.0)), r"a field must have shape \(3,\) or \(3, 3\), got \(2,\)"),
    (lambda: lt.SpinSystem(3, mag.exchange(4, 1.0)), "a term of 4 spins"),
    (lambda: lt.SpinSystem(3, mag.exchange(3), lt.LandauLifshitz(np.ones(4))), r"have the shape \(3,\) of the sites"),
    (lambda: lt.SpinSystem(3, mag.exchange(3), lt.LandauLifshitz(-1.0)), "must be >= 0"),
    (lambda: lt.LandauLifshitz([0.1, -0.2]), r"must be >= 0 and finite, got \[0.1, -0.2\]"),
    (lambda: lt.LandauLifshitz(np.inf), "must be >= 0 and finite, got inf"),
    (
        lambda: lt.LandauLifshitz(np.linspace(-1.0, 1.0, 1000)),
        r"got an array of shape \(1000,\) with numbers from -1 to 1:",
    ),
    (lambda: small_lattice(bath=np.array([0, 0, 1])), "a dissipation heats bath 1, but there are 1 baths"),
    (lambda: small_lattice(bath=np.array([0, 0])), "of the shape .3,. of the sites"),
    (lambda: lt.HeatBaths(-1.0), r"must be positive, got \[-1.0\]"),
    (lambda: lt.HeatBaths([1.0, 2.0], number=1), r"1 baths must be a number or have shape \(1,\)"),
    (lambda: small_lattice(baths=2.0), "baths must be lt.HeatBaths, True"),
    (
        lambda: lt.LiePoissonSystem(mf.so(3), lambda s: s[0] ** 2, dissipation=lt.LandauLifshitz()),
        "LandauLifshitz needs a SpinSystem",
    ),
]


@pytest.mark.parametrize(("attempt", "says"), REFUSED_CALLS)
def test_refusals(attempt, says):
    with pytest.raises(lt.InputError, match=says):
        attempt()


def test_ratios_and_sites_of_the_structure_are_checked():
    with pytest.raises(mf.ParameterError, match=r"have shape \(3,\), got \(2,\)"):
        mf.Spins(3, ratio=np.ones(2))
    assert mf.Spins((2, 3), 1).tensor(RANDOM.standard_normal(19)).shape == (19, 19)
    assert float(mf.Spins(2, 1, [1.0, 3.0]).jacobi_residual(RANDOM.standard_normal(7))) < 1e-14


class IteratedRotation(lt.SpinSystem):
    """Control: what turns the spins is left to the iteration."""

    def solve_slopes_at_each_spin(self, *arguments):
        return None


class NoiseAlone(lt.SpinSystem):
    """Control: only the turn by noise is solved for at once."""

    def solve_slopes_at_each_spin(self, x, dH, dS, noise_rates, others, half_step, k):
        slopes = super().solve_slopes_at_each_spin(x, dH, dS, noise_rates, others, 0.0, k)
        matrices = jnp.eye(3) - jnp.stack([jnp.cross(half_step * noise_rates, e) for e in np.eye(3)], axis=-1)
        residuals = (slopes - k)[:-1].reshape(-1, 3, 1)
        return jnp.append(k[:-1] + jnp.linalg.solve(matrices, residuals).ravel(), slopes[-1])


class Unsaid(lt.LandauLifshitz):
    """Control: noise that does not say how it turns the spins."""

    def factor(self, system, x, dH, dL):
        return super().factor(system, x, dH, dL)._replace(spin_coefficients=None)


@pytest.mark.slow
def test_what_noise_turns_a_step_solves_for_at_once():
    """A step takes a fraction of the iterations of the control, where the spin that is turned farthest decides."""
    sites, bath = (4, 4, 4), lt.HeatBaths(np.inf, 1.4)
    runs = []
    for kind in (lt.SpinSystem, IteratedRotation):
        system = kind(sites, lt.magnetism.exchange(sites, 1.0), lt.LandauLifshitz(2.0), bath)
        start = system.state(unit(*sites))
        runs.append(lt.integrate(system, start, (0.0, 0.05), 0.01, noise=lt.Fluctuations(1.0, 3), engine="array"))
    at_once, control = runs
    assert np.abs(at_once.x - control.x).max() < 1e-13
    assert np.ptp(at_once.x[:, 0]) > 0.05
    assert at_once.stats.newton_iterations == 0
    assert 2 * at_once.stats.fixed_point_iterations < control.stats.fixed_point_iterations


@pytest.mark.sampled("0.02-False")
@pytest.mark.parametrize(("step", "needs_newton"), [(0.02, False), (0.06, True)])
def test_precession_and_damping_of_each_spin_are_solved_for_at_once(step, needs_newton):
    """The control takes a fifth more iterations in short steps, and Newton's method in long ones."""
    sites, bath, runs = (4, 4, 4), lt.HeatBaths(np.inf, 1.4), []
    for kind in (lt.SpinSystem, NoiseAlone):
        system = kind(sites, lt.magnetism.exchange(sites, 1.0), lt.LandauLifshitz(2.0), bath)
        start = system.state(np.tile([0.0, 0.0, 1.0], (*sites, 1)))
        runs.append(lt.integrate(system, start, (0.0, 10 * step), step, noise=lt.Fluctuations(1.0, 3), engine="array"))
    at_once, control = runs
    assert np.abs(at_once.x - control.x).max() < 1e-11
    assert at_once.stats.newton_iterations == 0
    if needs_newton:
        assert control.stats.newton_iterations > 50
    else:
        assert 1.2 * at_once.stats.fixed_point_iterations < control.stats.fixed_point_iterations


@pytest.mark.slow
def test_spins_with_torque_power_and_two_baths_move_as_the_iteration_alone_says():
    sites, runs = (3, 2), []
    for kind in (lt.SpinSystem, IteratedRotation):
        system = kind(
            sites,
            lt.magnetism.exchange(sites, 1.0),
            [lt.LandauLifshitz(0.5, bath=np.arange(6).reshape(sites) % 2), lt.BathConduction([[0.0, 0.3], [0.3, 0.0]])],
            lt.HeatBaths(5.0, number=2),
            torque=lambda t, s: jnp.stack([jnp.sin(3.0 * t), 0.0 * t, 0.2 + 0.0 * t]),
            power=lambda t: jnp.exp(-t),
        )
        start = system.state(unit(*sites))
        runs.append(lt.integrate(system, start, (0.0, 0.5), 0.02, noise=lt.Fluctuations(0.2, 3), engine="array"))
    at_once, control = runs
    assert at_once.audit().passed
    assert np.abs(at_once.x - control.x).max() < 1e-13
    assert at_once.stats.fixed_point_iterations < control.stats.fixed_point_iterations


def test_equations_of_each_spin_have_the_derivative_of_its_velocity():
    """Compared with the derivative of the vector field of one spin, less the part that changes its length."""
    spin = lt.SpinSystem(1, lt.magnetism.zeeman(1, [0.3, 0.5, 1.0]), lt.LandauLifshitz(0.7), ratio=1.3)
    s, v, w = unit(1).ravel(), *RANDOM.standard_normal((2, 3))
    dH, h = np.array([-0.3, -0.5, -1.0]), 0.2
    slopes, k = (
        spin.solve_slopes_at_each_spin(s, dH, np.zeros(3), w[None], np.zeros(3), h, v),
        spin.vector_field(s) + np.cross(w, s),
    )
    u = np.asarray(slopes) - v
    derivative = jax.jvp(lambda s: spin.vector_field(s) + jnp.cross(w, s), (s,), (u,))[1] + 0.7 * dH * (s @ u)
    assert np.abs(u - h * np.asarray(derivative) - (k - v)).max() < 1e-14


FIELDS = np.array([0.5, 2.0, 5.0])


@pytest.mark.slow
@pytest.mark.parametrize("damping", [lt.LandauLifshitz, Unsaid])
def test_free_spins_in_a_bath_have_langevins_magnetisation(damping):
    """Within three standard errors, in steps of a fifth of the time that a spin forgets its direction in.

    Control: noise that does not make up for what a midpoint step turns too little misses it.
    """
    sites, T = (30, 32, 3), 1.0
    fields = np.zeros((*sites, 3))
    fields[..., 2] = FIELDS
    system = lt.SpinSystem(sites, lt.magnetism.zeeman(sites, fields), damping(1.0), lt.HeatBaths(np.inf, T))
    start = system.state(np.tile([0.0, 0.0, 1.0], (*sites, 1)))
    run = lt.integrate(system, start, (0.0, 12.0), 0.1, noise=lt.Fluctuations(1.0, 5), save_every=2, engine="array")
    assert np.ptp(run.energy) < 1e-12 * np.abs(run.energy).max()
    mean = np.asarray(system.spins(run.x))[run.t > 4.0, ..., 2].mean(axis=0).reshape(-1, 3)
    off = mean.mean(axis=0) - (1.0 / np.tanh(FIELDS / T) - T / FIELDS)
    off /= mean.std(axis=0) / np.sqrt(len(mean))
    assert (np.abs(off).max() < 3.0) == (damping is lt.LandauLifshitz), off


def test_the_largest_step_turns_no_spin_by_more_than_its_angle():
    """In its field, with ratios and rates at each site, and by noise of the temperature of the bath."""
    sites = (3, 3)
    ratio, rate = np.full(sites, 2.0), np.full(sites, 0.5)
    ratio[1, 1], rate[2, 0] = 3.0, 4.0
    field = RANDOM.standard_normal((*sites, 3))
    energy = lt.magnetism.zeeman(sites, lambda t: t * field)
    baths = lt.HeatBaths(np.inf, lambda t: 0.1 * t)
    system = lt.SpinSystem(sites, energy, lt.LandauLifshitz(rate), baths, ratio=ratio)
    start = unit(*sites)
    fastest = (np.hypot(ratio, rate) * np.linalg.norm(2.0 * field, axis=-1)).max()
    assert system.largest_step(start, 0.1, t=2.0) == pytest.approx(0.1 / fastest, rel=1e-13)
    by_noise = 1e-4 / (2.0 * 50.0 * 0.2 * 4.0)
    assert system.largest_step(start, 0.01, boltzmann=50.0, t=2.0) == pytest.approx(by_noise, rel=1e-13)
    h = system.largest_step(start, 0.05, t=1.0)
    x = np.asarray(system.state(start))
    turned = np.linalg.norm(np.asarray(system.vector_field(x, 1.0))[:27].reshape(9, 3), axis=1) * h
    assert 0.01 < turned.max() <= 0.05
    with pytest.raises(lt.InputError, match="no spin turns"):
        system.largest_step(start, t=0.0)
