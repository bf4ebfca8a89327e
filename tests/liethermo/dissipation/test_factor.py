"""Factors of friction matrices: squares, kernels, divergences of columns; conduction of heat between baths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.noise import factor_divergences, noisy_terms_with_factors
from liethermo.models.gases import gas_piston_state
from liethermo.systems.spins import reorder_spins
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root
from tests.cases import DISSIPATIONS, build, state_of
from tests.refusals import refusal_test

NAMES_WITHOUT_FACTOR = {"force", "potential_coulomb", "potential_power_law", "potential_activated"}
"""Names of dissipations that have no factor."""
CASES_WITH_FACTOR = [
    pytest.param(g, case, id=f"{g.name}-{case.name}")
    for g in (mf.so(3), mf.se(3))
    for case in DISSIPATIONS
    if case.name not in NAMES_WITHOUT_FACTOR and case.exempt(g) is None
]


@jax.jit
def measure_factors(system, x, dH, dS, dL):
    """Return the relative residual of ``B B^T = K``, ``B^T dH``, and the divergences less those by differentiation."""
    terms, conserves_energy = (
        noisy_terms_with_factors(system.dissipation, system, x, dH, dL),
        system.dissipation.energy_law == "conserved",
    )
    covector = dS if conserves_energy else -dH
    product = sum(B.times(B.transpose_times(covector)) for _, B in terms)
    force = system.dissipation.force(system, x, dH, dS, dL)
    kernel = jnp.concatenate(
        [B.transpose_times(v) for _, B in terms for v in ((dH, *dL) if conserves_energy else dL)] or [jnp.zeros(1)]
    )

    def matrix(y):
        terms_at_y = noisy_terms_with_factors(
            system.dissipation,
            system,
            y,
            system.energy.gradient(y),
            [L.gradient(y) for L in system.preserved_functions],
        )
        return jnp.concatenate([jax.vmap(B.times)(jnp.eye(B.size)) for _, B in terms_at_y])

    traces = jnp.einsum("aii->a", jax.jacfwd(matrix)(x))
    scale = jnp.linalg.norm(force)
    return (
        jnp.linalg.norm(product - force) / scale,
        jnp.max(jnp.abs(kernel)),
        factor_divergences(system.dissipation, system, x) - traces,
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("g", "case"), CASES_WITH_FACTOR)
def test_factors(g, case):
    """The factors are right for gradients of functions and for any other vectors, as discrete gradients are."""
    system, rng = build(g, case), np.random.default_rng(1)
    for seed in range(3):
        x = jnp.asarray(state_of(g, seed))
        dH = system.energy.gradient(x) + 0.1 * rng.standard_normal(g.dim)
        dL = tuple(L.gradient(x) + 0.1 * rng.standard_normal(g.dim) for L in system.preserved_functions)
        product, kernel, defect = measure_factors(system, x, dH, rng.standard_normal(g.dim), dL)
        assert product < 1e-13
        assert kernel < 1e-13 * float(jnp.linalg.norm(dH))
        assert np.abs(defect).max() < 1e-12


@pytest.mark.slow
def test_factors_between_bodies():
    """Each flow of heat and each friction has its own column, for any gradient with positive temperatures."""
    system = lt.models.gas_piston()
    x = jnp.asarray(gas_piston_state(0.4, (310.0, 290.0, 300.0), p=0.3))
    rng = np.random.default_rng(0)
    dH = system.energy.gradient(x) * (1.0 + 0.01 * rng.standard_normal(5))
    terms = noisy_terms_with_factors(system.dissipation, system, x, dH, ())
    assert sum(B.size for _, B in terms) == 3
    dS = rng.standard_normal(5)
    product = sum(B.times(B.transpose_times(dS)) for _, B in terms)
    assert np.allclose(product, system.dissipation.force(system, x, dH, dS, ()), rtol=1e-13)
    assert max(float(jnp.abs(B.transpose_times(dH)).max()) for _, B in terms) < 1e-12 * float(jnp.abs(dH).max())


def test_a_dissipation_without_a_factor():
    system = build(mf.so(3), next(case for case in DISSIPATIONS if case.name == "force"))
    x = jnp.ones(3)
    with pytest.raises(lt.InputError, match=r"EulerPoincareForce gives no factor"):
        noisy_terms_with_factors(system.dissipation, system, x, x, ())
    pairs = np.zeros((3, 3, 3, 3))
    for i, j, sign in ((0, 1, 1.0), (0, 2, -0.5)):
        for a, b in ((i, j), (j, i)):
            for c, d in ((i, j), (j, i)):
                pairs[a, b, c, d] = sign * (1 if (a, b) == (c, d) else -1)
    bracket = lt.FourBracket(pairs)
    with pytest.raises(lt.IndefiniteError, match="pairs of covectors"):
        bracket.factor(system, x, x, ())


@pytest.mark.slow
def test_roots_of_singular_matrices():
    """Roots of rank two of four, and their derivative against differences; eigenvalues that meet do no harm."""
    rng = np.random.default_rng(2)
    A, direction = rng.standard_normal((4, 2)), rng.standard_normal((4, 2))

    @jax.jit
    def K(t):
        return (A + t * direction) @ (A + t * direction).T

    root, h = jax.jit(lambda t: semidefinite_root(K(t))), 1e-5
    for factor in (semidefinite_factor(K(0.0)), root(0.0)):
        assert np.allclose(factor @ factor.T, K(0.0), atol=1e-14)
    assert np.abs(jax.jit(jax.jacfwd(root))(0.0) - (root(h) - root(-h)) / (2 * h)).max() < 1e-8
    derivative = jax.jacfwd(lambda t: semidefinite_root(jnp.eye(3) + t * jnp.diag(jnp.array([1.0, 2.0, 3.0]))))(0.0)
    assert np.allclose(derivative, np.diag([0.5, 1.0, 1.5]), atol=1e-14)
    assert np.isfinite(semidefinite_root(jnp.zeros((2, 2)))).all()
    assert np.isfinite(semidefinite_factor(jnp.zeros((2, 2)))).all()


def body_with_baths(dissipation, baths):
    moments = np.array([1.0, 2.0, 5.0])
    return lt.LiePoissonSystem(
        mf.so(3), lambda m: 0.5 * jnp.sum(m**2 / moments) + 0.1 * m[0] ** 4, dissipation=dissipation, baths=baths
    )


HEATING_SYSTEMS = {
    "one bath": lambda: body_with_baths(lt.DoubleBracket(0.3), lt.HeatBaths(capacity=2.0, temperature=1.3)),
    "friction that varies": lambda: body_with_baths(
        lt.Friction(lambda m: (1.0 + m[1] ** 2) * jnp.diag(jnp.array([1.0, 2.0, 0.5]))), lt.HeatBaths(capacity=2.0)
    ),
    "below zero": lambda: body_with_baths(
        lt.DoubleBracket(0.3), lt.HeatBaths(energy=lambda y: 0.5 * y**2 + 0.1 * y**4)
    ),
    "a bath for each spin": lambda: lt.models.spin_lattice(
        (2, 2), baths=lt.HeatBaths(capacity=[1.0, 2.0], number=2), bath=[[0, 1], [1, 0]]
    ),
    "spins": lambda: lt.models.spin_lattice((2, 2), baths=False),
}
"""Systems with friction that heats baths, by name."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("make", HEATING_SYSTEMS.values(), ids=HEATING_SYSTEMS)
def test_divergences_of_heating_systems(make):
    """The closed form of the divergence agrees with differentiation of every column by every component."""
    system, rng = make(), np.random.default_rng(2)
    x = jnp.asarray(rng.standard_normal(system.dim))
    if system.baths.number:
        x = x.at[system.body_dim :].set(-0.4)  # where the energy of a bath may fall
    product, _, defect = measure_factors(system, x, system.energy.gradient(x), rng.standard_normal(system.dim), ())
    if system.baths.number:
        assert product < 1e-13
    assert np.abs(defect).max() < 1e-12
    if system.baths.number:
        assert np.abs(factor_divergences(system.dissipation, system, x)).max() > 1e-3


FIELD = 1.2
RATE = 0.3
CONDUCTANCE = 0.7
ELECTRON_CAPACITY = 0.5
"""Capacity of the electrons over their temperature."""

PULSE = lt.magnetism.LaserPulse(energy=3.0, duration=0.4, centre=1.5)
START = np.array([1.0, 0.0, 0.2]) / np.sqrt(1.04)


def two_temperatures(**arguments):
    """A spin, electrons with the capacity ``c T``, which the spin and a laser heat, and phonons."""
    baths = lt.HeatBaths(
        capacity=[1.0, 20.0],
        temperature=[0.5, 0.5],
        number=2,
        energy=[lambda y: 0.5 * y + y**2 / (2.0 * ELECTRON_CAPACITY), None],
    )
    zeeman = lt.magnetism.zeeman(1, (0.0, 0.0, FIELD))
    damping = [lt.LandauLifshitz(RATE, bath=0), lt.BathConduction(CONDUCTANCE)]
    return lt.SpinSystem(1, zeeman, damping, baths, **arguments)


def motion(t, u):
    """Rates of the spin and of the two temperatures, written out."""
    s, T_e, T_p = u[:3], u[3], u[4]
    dH = np.array([0.0, 0.0, -FIELD])
    torque = np.cross(s, dH)
    into_electrons = RATE * torque @ torque + float(PULSE(t)) + CONDUCTANCE * (T_p - T_e)
    return [
        *(torque + RATE * np.cross(s, torque)),
        into_electrons / (ELECTRON_CAPACITY * T_e),
        CONDUCTANCE * (T_e - T_p) / 20.0,
    ]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "order"),
    [(lt.MetriplecticMidpoint(), 2), (lt.MetriplecticGauss(2), 4), (lt.MetriplecticRungeKutta(4), 4)],
    ids=str,
)
def test_a_laser_heats_electrons_spins_and_phonons(method, order):
    """Temperatures are SciPy's at the order of the method; energy less work is exact, and the pulse is the work."""
    reference = solve_ivp(motion, (0.0, 6.0), [*START, 0.5, 0.5], rtol=1e-11, atol=1e-12).y[:, -1]
    system = two_temperatures(power=[PULSE, None])
    errors = []
    for h in (0.05, 0.025):
        run = lt.integrate(system, system.state(START), (0.0, 6.0), h, method)
        end = np.concatenate([run.x[-1, :3], system.temperatures(run.x[-1])])
        errors.append(np.abs(end - reference).max())
        audit = run.audit()
        assert audit.passed
        assert audit.energy_drift < 1e-15
        assert np.diff(run.entropy).min() > 0.0
        assert abs(run.casimirs["work"][-1] - 3.0) < 1e-12
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] > 0.85 * 2.0**order


def test_two_baths_approach_each_other_exponentially():
    """The difference of two temperatures decays at the rate ``G (1 / C_1 + 1 / C_2)``."""
    baths = lt.HeatBaths(capacity=[2.0, 3.0], temperature=[1.5, 0.5], number=2)
    system = lt.SpinSystem(1, lt.magnetism.zeeman(1, (0.0, 0.0, 1.0)), lt.BathConduction([(0, 1, 0.6)]), baths)
    run = lt.integrate(system, system.state([0.0, 0.0, 1.0]), (0.0, 4.0), 0.05, lt.MetriplecticGauss(3))
    T = np.asarray(system.temperatures(run.x))
    assert np.abs(T[:, 0] - T[:, 1] - np.exp(-0.6 * (1 / 2.0 + 1 / 3.0) * run.t)).max() < 1e-9
    assert np.ptp(T @ [2.0, 3.0]) < 1e-13
    assert run.audit().passed


@pytest.mark.slow
def test_noise_of_conduction_has_the_distribution_of_equal_energy():
    """A spin and two small baths with noise: mean temperatures and mean spin of ``exp(S)`` on the energy level."""
    C, T_0 = np.array([3.0, 5.0]), np.array([1.0, 0.6])
    damping = [lt.LandauLifshitz(0.5), lt.BathConduction(0.8)]
    system = lt.SpinSystem(1, lt.magnetism.zeeman(1, (0.0, 0.0, 2.0)), damping, lt.HeatBaths(C, T_0, 2))
    assert system.check().passed
    assert lt.Fluctuations().check(system).passed
    starts = np.repeat(np.asarray(system.state([0.0, 0.0, 1.0]))[None], 1000, axis=0)
    noise = lt.Fluctuations(seed=3)
    x = np.asarray(lt.ensemble(system, starts, (0.0, 16.0), 0.04, lt.MetriplecticMidpoint(), noise=noise).x)
    assert np.ptp(system.energy(x)) < 1e-12

    z, share = np.meshgrid(np.linspace(-1.0, 1.0, 201), (np.arange(2000) + 0.5) / 2000)
    U_min, total = -C * T_0, -2.0 + 2.0 * z  # energy of both baths, from the energy of the spin
    width = total - U_min.sum()
    U = U_min[0] + share * width
    T = T_0[0] + U / C[0], T_0[1] + (total - U) / C[1]
    weight = T[0] ** (C[0] - 1) * T[1] ** (C[1] - 1) * width
    exact = np.array([np.sum(weight * f) / np.sum(weight) for f in (*T, z)])
    observations = np.column_stack([system.temperatures(x), x[:, 2]])
    assert (
        np.abs(observations.mean(axis=0) - exact) < 4.0 * observations.std(axis=0) / np.sqrt(len(observations))
    ).all()
    assert (observations.std(axis=0) > 0.05).all()


def test_many_spins_conduct_component_by_component():
    """The order of components of a large lattice changes nothing: three baths, of which sites heat two."""
    sites = (3, 4, 5)
    baths = lt.HeatBaths([4.0, 6.0, 9.0], [1.0, 0.7, 0.4], 3)
    bath = np.arange(60).reshape(sites) % 2
    damping = [lt.LandauLifshitz(0.2, bath), lt.BathConduction([(0, 1, 0.3), (1, 2, 0.5)])]
    system = lt.SpinSystem(sites, lt.magnetism.exchange(sites, 1.0), damping, baths)
    planar = reorder_spins(system)
    assert planar is not None
    x = np.asarray(system.samples(1)[0])
    field = np.asarray(planar.restore_state(jax.jit(planar.system.vector_field)(planar.reorder_state(x))))
    scale = np.abs(field).max()
    assert np.abs(field - np.asarray(jax.jit(system.vector_field)(x))).max() < 1e-14 * scale
    total = jax.jit(lambda x: lt.System.field(system, x, system.energy.gradient(x), system.entropy.gradient(x)))(x)
    assert np.abs(field - total).max() < 1e-14 * scale


BAD = {
    "no baths": (lambda: _with(None, 0.1), "Give the system baths"),
    "one bath": (lambda: _with(lt.HeatBaths(), 0.1), "number=2"),
    "a third bath": (lambda: _with(lt.HeatBaths(number=2), [(0, 2, 0.1)]), "number=3"),
    "a negative conductance": (lambda: _with(lt.HeatBaths(number=2), -0.1), ">= 0"),
    "an asymmetric matrix": (lambda: _with(lt.HeatBaths(number=2), np.array([[0.0, 1.0], [0.5, 0.0]])), "symmetric"),
}


def _with(baths, conductance):
    damping = [lt.LandauLifshitz(0.1), lt.BathConduction(conductance)]
    return lt.SpinSystem(1, lt.magnetism.zeeman(1, (0.0, 0.0, 1.0)), damping, baths)


test_bad_conductances_are_refused = refusal_test(BAD)


@pytest.mark.slow
def test_bodies_with_baths_conduct_too():
    """A damped rigid body: its two baths come to one temperature, both laws exact."""
    body = lt.LiePoissonSystem(
        mf.so(3),
        energy=lt.Quadratic([1 / 3, 1 / 2, 1.0]),
        dissipation=[lt.DoubleBracket(0.2), lt.BathConduction(0.5)],
        baths=lt.HeatBaths([1.0, 2.0], [1.0, 0.5], 2),
    )
    run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 40.0), 0.1, lt.MetriplecticMidpoint())
    assert run.audit().passed
    assert np.ptp(np.asarray(body.temperatures(run.x[-1]))) < 0.01  # the damping still heats the first
