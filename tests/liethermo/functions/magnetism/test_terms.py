"""Terms of the energy of spins: sums over pairs, derivatives by JAX, and both laws on every engine."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

import liethermo as lt
from liethermo.systems.spins import reorder_spins
from tests.refusals import refusal_test

mag = lt.magnetism
RNG = np.random.default_rng(3)


def random_spins(sites):
    s = RNG.standard_normal((*sites, 3))
    return s / np.linalg.norm(s, axis=-1, keepdims=True)


KAGOME = mag.lattice("kagome", (3, 4), periodic=(True, False))
BONDS = KAGOME.neighbours(0.9)
J_BOND = RNG.standard_normal(len(BONDS))
J_CELL = RNG.standard_normal((len(BONDS), *KAGOME.cells))
D_BOND = RNG.standard_normal((len(BONDS), 3))
M_BOND = RNG.standard_normal((len(BONDS), 3, 3))
M_CELL = RNG.standard_normal((len(BONDS), *KAGOME.cells, 3, 3))

PAIR_TERMS = {
    "one J": (lambda: mag.exchange(BONDS, 0.7), lambda k, c, u, v: -0.7 * u @ v),
    "J of each bond": (lambda: mag.exchange(BONDS, J_BOND), lambda k, c, u, v: -J_BOND[k] * u @ v),
    "J of each bond and cell": (lambda: mag.exchange(BONDS, J_CELL), lambda k, c, u, v: -J_CELL[k][c] * u @ v),
    "D of each bond": (lambda: mag.dzyaloshinskii_moriya(BONDS, D_BOND), lambda k, c, u, v: D_BOND[k] @ np.cross(u, v)),
    "tensors": (lambda: mag.exchange_tensor(BONDS, M_BOND), lambda k, c, u, v: -u @ M_BOND[k] @ v),
    "tensors of each cell": (lambda: mag.exchange_tensor(BONDS, M_CELL), lambda k, c, u, v: -u @ M_CELL[k][c] @ v),
    "biquadratic": (lambda: mag.biquadratic(BONDS, J_BOND), lambda k, c, u, v: -J_BOND[k] * (u @ v) ** 2),
    "biquadratic of each cell": (
        lambda: mag.biquadratic(BONDS, J_CELL),
        lambda k, c, u, v: -J_CELL[k][c] * (u @ v) ** 2,
    ),
}


@pytest.mark.parametrize("name", PAIR_TERMS)
def test_bond_terms_are_sums_over_bonds(name):
    build, of_pair = PAIR_TERMS[name]
    energy, s = build(), random_spins(KAGOME.sites)
    total = 0.0
    for k, (a, b, offset) in enumerate(zip(BONDS.first, BONDS.second, BONDS.offsets, strict=True)):
        for c in np.ndindex(KAGOME.cells):
            end = (c[0] + offset[0]) % 3, c[1] + offset[1]
            if 0 <= end[1] < 4:
                total += of_pair(k, c, s[c][a], s[end][b])
    x = jnp.asarray(s.ravel())
    value, gradient = jax.jit(jax.value_and_grad(energy.value))(x)
    assert float(value) == pytest.approx(total, abs=1e-12)
    np.testing.assert_allclose(jax.jit(energy.gradient)(x), gradient, atol=1e-13)


def test_shells_and_an_antisymmetric_tensor():
    crystal = mag.lattice("bcc", (3, 3, 3))
    x = random_spins(crystal.sites).ravel()
    by_shells = mag.exchange(crystal, [0.4, -0.2, 0.1])
    singly = [mag.exchange(crystal.shell(k + 1), J) for k, J in enumerate([0.4, -0.2, 0.1])]
    assert float(by_shells(x)) == pytest.approx(sum(float(term(x)) for term in singly), abs=1e-13)
    assert float(mag.exchange(crystal, {2: -0.2})(x)) == pytest.approx(float(singly[1](x)), abs=1e-13)
    D = np.array([0.1, 0.2, 0.3])
    J = -np.array([[0.0, D[2], -D[1]], [-D[2], 0.0, D[0]], [D[1], -D[0], 0.0]])
    by_tensor = mag.exchange_tensor(crystal.shell(1), J)
    assert float(by_tensor(x)) == pytest.approx(float(mag.dzyaloshinskii_moriya(crystal, D)(x)), abs=1e-13)


def test_a_lattice_agrees_with_a_grid():
    crystal, grid = mag.lattice("sc", (4, 3, 5), periodic=(True, False, True)), (4, 3, 5)
    x = jnp.asarray(random_spins(grid).ravel())
    bonds = crystal.bonds([(1, 0, 0), (0, 1, 0), (0, 0, 1)])
    vectors = RNG.standard_normal((3, 3))
    pairs = (
        (mag.exchange(crystal, 0.3), mag.exchange(grid, 0.3, periodic=(True, False, True))),
        (
            mag.dzyaloshinskii_moriya(bonds, vectors),
            mag.dzyaloshinskii_moriya(grid, list(vectors), periodic=(True, False, True)),
        ),
        (mag.anisotropy(crystal, 0.2), mag.uniaxial_anisotropy(grid, {2: 0.2})),
        (mag.zeeman(crystal, (0.1, 0.2, 0.3), 2.0), mag.zeeman(grid, (0.2, 0.4, 0.6))),
    )
    for first, second in pairs:
        np.testing.assert_allclose(first.gradient(x), second.gradient(x), atol=1e-14)


def test_anisotropies_are_their_polynomials():
    s, axis = random_spins((5,)), np.array([0.6, 0.0, 0.8])
    powers = mag.uniaxial_anisotropy(5, {2: 0.3, 4: -0.2, 6: np.linspace(0.0, 1.0, 5)}, axis)
    n = s @ axis
    expected = -np.sum(0.3 * n**2 - 0.2 * n**4 + np.linspace(0.0, 1.0, 5) * n**6)
    assert float(powers(s.ravel())) == pytest.approx(expected, abs=1e-14)
    rotation = np.linalg.qr(RNG.standard_normal((3, 3)))[0]
    x, y, z = rotation @ s.T
    cubic = mag.cubic_anisotropy(5, 0.4, 0.7, rotation)
    expected = np.sum(0.4 * (x * x * y * y + y * y * z * z + z * z * x * x) + 0.7 * (x * y * z) ** 2)
    assert float(cubic(s.ravel())) == pytest.approx(expected, abs=1e-14)
    for energy in (powers, cubic):
        np.testing.assert_allclose(energy.gradient(s.ravel()), jax.grad(energy.value)(s.ravel()), atol=1e-13)
    assert (powers.degree, cubic.degree, mag.uniaxial_anisotropy(1, {2: 1.0}).is_quadratic) == (6.0, 6.0, True)


@pytest.mark.parametrize("k", [2, 4, 6])
def test_stevens_functions_are_harmonic(k):
    """Each is proportional to a real solid harmonic: homogeneous, without a Laplacian, and orthogonal to the others."""
    x, y, z = sympy.symbols("x y z")
    functions = {}
    for q in range(-k, k + 1):
        monomials = mag.stevens_anisotropy(1, {(k, q): 1.0})
        terms = zip(monomials.powers, monomials.coefficients, strict=True)
        f = sum(int(c) * x ** p[0] * y ** p[1] * z ** p[2] for p, c in terms)
        assert sympy.expand(sum(sympy.diff(f, v, 2) for v in (x, y, z))) == 0
        assert sympy.Poly(f, x, y, z).homogeneous_order() == k
        functions[q] = sympy.expand(f)
    polar = {x: sympy.cos(1.1) * sympy.sin(0.7), y: sympy.sin(1.1) * sympy.sin(0.7), z: sympy.cos(0.7)}
    for q in range(1, k + 1):  # the azimuth enters as cos(q phi) and sin(q phi)
        ratio = (functions[-q] / functions[q]).subs(polar).evalf()
        assert float(ratio) == pytest.approx(math.tan(q * 1.1), rel=1e-12)
    published = {2: 3 * z**2 - 1, 4: 35 * z**4 - 30 * z**2 + 3, 6: 231 * z**6 - 315 * z**4 + 105 * z**2 - 5}
    on_sphere = functions[0].subs(polar).evalf()
    assert float(on_sphere) == pytest.approx(float(published[k].subs(polar).evalf()), rel=1e-12)


def test_fields_that_depend_on_site_and_time():
    grid = (2, 3)
    phases = jnp.arange(6.0).reshape(grid)

    def field(t):
        return jnp.stack([jnp.cos(t + phases), jnp.sin(t + phases), 0.0 * phases], axis=-1)

    energy, s = mag.zeeman(grid, field, 2.0), random_spins(grid)
    assert float(energy(s.ravel(), 0.3)) == pytest.approx(-2.0 * float(jnp.sum(s * field(0.3))), abs=1e-14)
    system = lt.SpinSystem(grid, energy + mag.exchange(grid, 1.0), lt.LandauLifshitz(0.1), lt.HeatBaths(6.0))
    run = lt.integrate(system, system.state(s), (0.0, 2.0), 0.05)
    assert run.audit().energy_drift < 1e-13, run.audit()
    assert (np.diff(run.entropy) > -1e-13).all()


@pytest.mark.slow
def test_a_resonant_field_turns_a_spin_by_the_formula_of_rabi():
    """In the frame that rotates with a circular field the motion is a rotation about (b, 0, B - w)."""
    B, b, w = 1.0, 0.2, 0.9
    energy = mag.zeeman(1, lambda t: jnp.array([b * jnp.cos(w * t), b * jnp.sin(w * t), B]))
    run = lt.integrate(lt.SpinSystem(1, energy), [0.0, 0.0, 1.0], (0.0, 30.0), 0.02, lt.MetriplecticGauss(3))
    rate = np.hypot(b, B - w)
    expected = 1.0 - 2.0 * (b / rate) ** 2 * np.sin(0.5 * rate * run.t) ** 2
    np.testing.assert_allclose(run.x[:, 2], expected, atol=1e-9)


def test_multiples_negatives_and_lists():
    grid = (3, 4)
    x = random_spins(grid).ravel()
    terms = [
        mag.exchange(grid, 0.5),
        mag.cubic_anisotropy(grid, 0.3),
        mag.zeeman(grid, (0.0, 0.1, 0.2)),
        lt.Function(lambda x: jnp.sum(x**4)),
        lt.Quadratic(np.ones(36)),
    ]
    total = sum(float(term(x)) for term in terms)
    for scaled, factor in ((2 * sum(terms), 2.0), (np.float64(3.0) * (terms[0] + terms[1]), None)):
        if factor:
            assert float(scaled(x)) == pytest.approx(factor * total, rel=1e-14)
        assert isinstance(scaled, lt.Energy)
    for term in terms:
        value = float(term(x))
        assert float((2 * term)(x)) == pytest.approx(2 * value, rel=1e-14)
        assert float((term / 4)(x)) == pytest.approx(value / 4, rel=1e-14)
        assert float((-term)(x)) == pytest.approx(-value, rel=1e-14)
        assert (2 * term).is_quadratic == term.is_quadratic
        np.testing.assert_allclose((-2 * term).gradient(x), -2 * term.gradient(x), rtol=1e-14, atol=1e-15)
    by_list, by_sum = (lt.SpinSystem(grid, energy) for energy in (terms[:3], terms[0] + terms[1] + terms[2]))
    assert float(by_list.energy(x)) == float(by_sum.energy(x))
    driven = 2 * mag.zeeman(grid, lambda t: jnp.array([t, 0.0, 0.0]))
    assert float(driven(x, 1.0)) == pytest.approx(-2.0 * x[::3].sum())


METHODS = {
    "midpoint": lt.MetriplecticMidpoint(),
    "Gauss": lt.MetriplecticGauss(2),
    "Runge-Kutta": lt.MetriplecticRungeKutta(4),
}


CASES = [
    ("midpoint", "compiled"),
    pytest.param("Gauss", "compiled", marks=pytest.mark.slow),
    pytest.param("midpoint", "array", marks=pytest.mark.slow),
    ("Runge-Kutta", "array"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "engine"), CASES)
def test_every_term_keeps_both_laws(name, engine):
    crystal = mag.lattice("honeycomb", (2, 2), periodic=False)
    bonds = crystal.shell(1)
    energy = [
        mag.exchange(crystal, 1.0),
        mag.exchange_tensor(bonds, RNG.standard_normal((3, 3)) * 0.3),
        mag.dzyaloshinskii_moriya(bonds, 0.2 * bonds.directions),
        mag.biquadratic(bonds, 0.3),
        mag.stevens_anisotropy(crystal, {(2, 0): 0.1, (4, 3): 0.2}),
        0.5 * mag.cubic_anisotropy(crystal, 0.4),
        mag.zeeman(crystal, RNG.standard_normal((*crystal.sites, 3)) * 0.2),
    ]
    system = lt.SpinSystem(crystal, energy, lt.LandauLifshitz(0.2), lt.HeatBaths(8.0))
    start = system.state(random_spins(crystal.sites))
    run = lt.integrate(system, start, (0.0, 4.0), 0.05, METHODS[name], engine=engine)
    audit = run.audit()
    assert audit.energy_drift < 1e-13, audit
    assert (np.diff(run.entropy) > -1e-13).all()
    assert run.entropy[-1] > run.entropy[0] + 0.1
    np.testing.assert_allclose(np.linalg.norm(system.spins(run.x), axis=-1), 1.0, atol=1e-14)


def large_magnet():
    """Above 1,000 components the spins are stored by components."""
    crystal = mag.lattice("kagome", (16, 16))
    bonds = crystal.shell(1)
    energy = [
        mag.exchange(crystal, [1.0, 0.1]),
        mag.dzyaloshinskii_moriya(bonds, 0.1 * bonds.directions),
        mag.biquadratic(bonds, 0.1),
        -1.0 * mag.uniaxial_anisotropy(crystal, {4: 0.3}),
    ]
    return lt.SpinSystem(crystal, energy, lt.LandauLifshitz(0.1), lt.HeatBaths(768.0))


def test_large_lattices_by_components_agree_with_small_ones():
    system = large_magnet()
    x = system.state(random_spins((16, 16, 3)))
    reordered = reorder_spins(system)
    gradient = reordered.system.energy.gradient(reordered.reorder_state(x))
    np.testing.assert_allclose(reordered.restore_state(gradient), system.energy.gradient(x), atol=1e-13)


@pytest.mark.slow
def test_large_lattices_keep_both_laws():
    system = large_magnet()
    start = system.state(random_spins((16, 16, 3)))
    run = lt.integrate(system, start, (0.0, 1.0), 0.05, lt.MetriplecticRungeKutta(4))
    assert run.audit().energy_drift < 1e-12, run.audit()
    assert (np.diff(run.entropy) > -1e-10).all()


BAD = {
    "shape of D": (lambda: mag.dzyaloshinskii_moriya(BONDS, np.ones((2, 3))), "must have shape"),
    "shape of J": (lambda: mag.exchange(BONDS, np.ones(2)), "an exchange constant of 12 bonds must have shape"),
    "shape of a tensor": (lambda: mag.exchange_tensor(BONDS, np.ones(3)), "an exchange tensor"),
    "bonds of a grid": (lambda: mag.exchange_tensor((3, 3), np.eye(3)), "bonds must be those of"),
    "no shells": (lambda: mag.exchange(KAGOME, []), "must not be empty"),
    "a power": (lambda: mag.uniaxial_anisotropy(3, {0: 1.0}), "positive integers"),
    "no function of Stevens": (lambda: mag.stevens_anisotropy(3, {(3, 1): 1.0}), "k = 2, 4 or 6"),
    "a number for powers": (lambda: mag.uniaxial_anisotropy(3, 0.2), "must be a dict such as"),
    "a number for functions of Stevens": (lambda: mag.stevens_anisotropy(3, 0.2), "must be a dict such as"),
    "a name of Stevens": (lambda: mag.stevens_anisotropy(3, {"O20": 0.2}), "a pair"),
    "a list of powers": (lambda: mag.polynomial_anisotropy(3, [(2, 0, 0)]), "must be a dict such as"),
    "no powers": (lambda: mag.polynomial_anisotropy(3, {}), "powers"),
    "axes": (lambda: mag.cubic_anisotropy(3, 1.0, axes=np.eye(2)), "the axes of an anisotropy"),
    "a field of the time": (lambda: mag.zeeman(3, lambda t: jnp.zeros(2)), "a field of the time"),
    "infinite": (lambda: mag.exchange(BONDS, np.inf), "finite"),
    "a factor": (lambda: np.ones(2).tolist() * 1 and mag.exchange(3) * "2", "the factor of an energy"),
}


test_bad_terms_are_refused = refusal_test(BAD, error=lt.LiethermoError)


def test_a_term_takes_spins_in_the_shape_of_their_lattice():
    terms = [mag.exchange(BONDS, 0.7), mag.anisotropy(KAGOME, 0.2), mag.zeeman(KAGOME, (0.1, 0.0, 1.0))]
    many = np.stack([random_spins(KAGOME.sites) for _ in range(2)])
    for energy in (*terms, terms[0] + terms[1], -terms[0], 2.0 * terms[0]):
        flat = energy(many.reshape(2, -1))
        assert np.array_equal(energy(many), flat)
        assert float(energy(many[0])) == flat[0]
    with pytest.raises(lt.InputError, match=r"spins must have shape \(\.\.\., 3, 4, 3, 3\) or \(\.\.\., 108\)"):
        terms[0](many[0, 0])
