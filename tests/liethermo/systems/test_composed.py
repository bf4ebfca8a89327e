"""Composed systems: heat and friction between bodies, both laws at every step, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.bodies import HeatConduction
from liethermo.functions.edges import Edges
from tests.cases import tolerance
from tests.refusals import refusal_test

seeds = st.integers(0, 10**6)


class Warm(eqx.Module):
    """Internal energy ``c exp(S/c)``: heat capacity c, temperature ``exp(S/c)`` [SML Example 2]."""

    capacity: jax.Array

    def __call__(self, x):
        return self.capacity * jnp.exp(x[-1] / self.capacity)


class Springs(eqx.Module):
    """A random V(q, S): springs that soften as they warm, and a wave through everything."""

    stiffness: jax.Array
    wave: jax.Array

    def __call__(self, q, S):
        pulls = 0.5 * jnp.sum(self.stiffness * jnp.diff(q) ** 2) * jnp.exp(-jnp.sum(S) / 9)
        return pulls + 0.2 * jnp.sin(self.wave[: len(q)] @ q + self.wave[len(q) :] @ S)


def particles(capacities=(1.0, 1.0), conductance=1.0):
    """Two thermo-particles [SML Example 2]."""
    return lt.ComposedSystem([lt.Subsystem(Warm(jnp.asarray(c)), 1) for c in capacities], conductance=conductance)


def random_system(seed):
    """Three bodies on lines and in planes of many kinds of friction, everything random."""
    rng = np.random.default_rng(seed)
    c, m, k, r, drag = (rng.uniform(0.5, 2.0, 3) for _ in range(5))
    root = jnp.asarray(0.5 * rng.standard_normal((1, 1)))
    bodies = {
        "line": lt.Subsystem(lt.Kinetic(m[:1]) + lt.Function(Warm(jnp.asarray(c[0]))).on([2]), 3, friction=r[0]),
        "stone": lt.Subsystem(Warm(jnp.asarray(c[1])), 1),
        "other": lt.Subsystem(
            lt.Kinetic(m[1:2]) + lt.Function(Warm(jnp.asarray(c[2]))).on([2]), 3, friction=root @ root.T
        ),
    }
    coupling = Springs(jnp.asarray(rng.random(1)), jnp.asarray(rng.standard_normal(5)))
    conductance = [(0, 1, k[0]), (2, 1, k[1])]
    return lt.ComposedSystem(bodies, coupling, conductance, drag=[(0, 2, drag[0])], validate=False)


def random_state(seed):
    return 0.7 * np.random.default_rng(seed).standard_normal(7)


def assert_both_laws(solution):
    assert solution.audit().energy_drift <= tolerance("energy")
    assert solution.stats.least_entropy_increment >= -tolerance("entropy") * np.abs(solution.entropy).max()


# -- the field --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(seed=seeds)
def test_the_almost_poisson_tensor_of_the_paper(seed):
    """``x' = Lambda_K dH`` with the matrix printed in §5, for n_1 = 2 and n_2 = 1."""
    rng = np.random.default_rng(seed)
    wave = rng.standard_normal(8)
    H = lambda x: jnp.sin(wave @ x) + jnp.exp(x[4]) + jnp.exp(0.5 * x[7]) + jnp.sum(x[:4] ** 2)  # noqa: E731
    zero = lambda dim: lt.Subsystem(lt.Quadratic(np.zeros(dim)), dim)  # noqa: E731  (all energy in the coupling)
    system = lt.ComposedSystem([zero(5), zero(3)], coupling=lt.Function(H), conductance=0.7, validate=False)
    x = jnp.asarray(0.3 * rng.standard_normal(8))
    dH = np.asarray(jax.grad(H)(x))
    K = 0.7 * (1 / dH[4] - 1 / dH[7])
    tensor = np.zeros((8, 8))
    tensor[:2, 2:4], tensor[2:4, :2] = np.eye(2), -np.eye(2)
    tensor[5, 6], tensor[6, 5] = 1.0, -1.0
    tensor[4, 7], tensor[7, 4] = K, -K
    if dH[4] > 0 and dH[7] > 0:
        assert np.allclose(system.vector_field(x), tensor @ dH, rtol=0, atol=1e-13)


def test_fourier_factors():
    """Three bodies: skew factors, ``S_a' = sum_b K_ab T_b``, the energy constant."""
    k = np.array([[0.0, 1.0, 0.5], [1.0, 0.0, 2.0], [0.5, 2.0, 0.0]])
    system = lt.ComposedSystem([lt.Subsystem(Warm(jnp.asarray(c)), 1) for c in (1.0, 2.0, 0.5)], conductance=k)
    x = np.array([0.3, -0.4, 0.2])
    T, K = np.asarray(system.temperatures(x)), np.asarray(system.fourier_factors(x))
    assert np.allclose(T, np.exp(x / [1.0, 2.0, 0.5]), rtol=1e-15)
    assert np.allclose(K, k * (1 / T[:, None] - 1 / T), rtol=0, atol=1e-15)
    assert np.array_equal(K, -K.T)
    assert np.allclose(system.vector_field(x), K @ T, rtol=0, atol=1e-15)
    production = sum(k[i, j] * (T[i] - T[j]) ** 2 / (T[i] * T[j]) for i in range(3) for j in range(i))
    assert float(system.entropy_production(x)) == pytest.approx(production, rel=1e-13)
    batch = np.stack([x, 2 * x])
    assert system.fourier_factors(batch).shape == (2, 3, 3)
    assert [part.shape for part in system.split(batch)] == [(2, 1)] * 3
    assert np.array_equal(system.entropies(batch), batch)


def test_the_equations_of_friction():
    """``p' = -R v``, ``S' = v . R v / T`` in one body, drag between two, contact friction: written out."""
    body = lt.Kinetic([0.5]) + lt.Function(Warm(jnp.asarray(2.0))).on([2])
    _, p_a, S_a, q_b, p_b, S_b = x = np.array([0.3, 1.0, 0.2, -0.4, -0.6, -0.1])
    v_a, v_b, T_a, T_b = 0.5 * p_a, 0.5 * p_b, np.exp(S_a / 2), np.exp(S_b / 2)

    def field(a=None, b=None, **between):
        system = lt.ComposedSystem([lt.Subsystem(body, 3, a), lt.Subsystem(body, 3, b)], **between)
        assert system.check().passed
        return np.asarray(system.vector_field(x))

    own = field(a=0.3, b=lambda y: 0.1 * y[0] ** 2)
    R_b = 0.1 * q_b**2
    assert np.allclose(own, [v_a, -0.3 * v_a, 0.3 * v_a**2 / T_a, v_b, -R_b * v_b, R_b * v_b**2 / T_b], atol=1e-15)
    w = v_a - v_b
    rubbed = [v_a, -0.4 * w, 0.2 * w**2 / T_a, v_b, 0.4 * w, 0.2 * w**2 / T_b]
    assert np.allclose(field(drag=0.4), rubbed, atol=1e-15)
    assert np.allclose(field(a="contact"), [v_a, -p_a * T_a, p_a * v_a, v_b, 0.0, 0.0], atol=1e-15)


@pytest.mark.slow
def test_one_body_with_contact_friction_is_an_evolution_system():
    energy = lt.Kinetic([0.5]) + lt.Potential(lambda q, S: 0.5 * q @ q + jnp.exp(S))
    composed, evolution = lt.ComposedSystem([lt.Subsystem(energy, 3, "contact")]), lt.EvolutionSystem(energy, 3)
    x = np.array([0.3, -0.7, 0.1])
    assert np.allclose(composed.vector_field(x), evolution.vector_field(x), rtol=0, atol=1e-15)
    assert composed.entropy_law == evolution.entropy_law == "nondecreasing"
    untold = lt.Subsystem(lambda x: energy.value(x), 3, "contact")
    assert lt.ComposedSystem([untold]).entropy_law is None
    pushed = lt.ComposedSystem([lt.Subsystem(energy, 3, "contact")], coupling=lt.Function(lambda x: x[1] * x[0] ** 3))
    assert pushed.entropy_law is None


# -- both laws at every step ------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(seed=seeds, h=st.floats(0.01, 1.0))
def test_both_laws_or_a_reason(seed, h):
    """Random V(q, S), conductances, frictions and steps: the laws hold, or a status says why a step was refused."""
    system = random_system(seed)
    assert system.entropy_law == "nondecreasing"
    solution = lt.integrate(system, random_state(seed), (0.0, 40 * h), h, on_failure="return", engine="array")
    if solution.stats.steps:
        assert_both_laws(solution)
    assert solution.status.ok or (h > 0.1 and solution.status.message)


@pytest.mark.slow
def test_observed_order_of_two_particles():
    """Against the exact relaxation ``T_b - T_a = (T_b - T_a)(0) exp(-k (1/c_a + 1/c_b) t)``."""
    c = np.array([1.0, 3.0])
    T0 = np.array([1.0, 2.5])
    mean, rate = c @ T0 / c.sum(), 0.7 * (1 / c).sum()
    exact = mean + np.array([-c[1], c[0]]) / c.sum() * 1.5 * np.exp(-rate * 2.0)
    system, errors = particles(c, 0.7), []
    for n in (20, 40, 80):
        solution = lt.integrate(system, c * np.log(T0), (0.0, 2.0), 2.0 / n, save_every=n // 20, engine="array")
        errors.append(np.abs(np.exp(solution.x[-1] / c) - exact).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - 2.0) < 0.2).all(), errors


@pytest.mark.slow
def test_the_entropy_of_a_step():
    """``S' - S = h k (T_a - T_b)^2 / (T_a T_b)`` in discrete temperatures, for an H far from quadratic [Lemma 6.2]."""
    system, x, h = particles((0.3, 0.5), 2.0), np.array([-0.2, 0.4]), 0.2
    solution = lt.integrate(system, x, (0.0, 20 * h), h, engine="array")
    discrete = eqx.filter_jit(jax.vmap(lambda x, d: lt.Gonzalez()(system.energy, x, d)))
    T = np.asarray(discrete(solution.x[:-1], np.diff(solution.x, axis=0)))
    predicted = 2.0 * h * (T[:, 0] - T[:, 1]) ** 2 / T.prod(axis=1)
    assert np.abs(np.diff(solution.entropy) - predicted).max() < 2e-15
    at_midpoint = np.exp((solution.x[:-1] + solution.x[1:]) / 2 / [0.3, 0.5])  # control: T of the lemma's proof
    wrong = 2.0 * h * (at_midpoint[:, 0] - at_midpoint[:, 1]) ** 2 / at_midpoint.prod(axis=1)
    assert np.abs(np.diff(solution.entropy) - wrong).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint("mean_value"), lt.MetriplecticGauss(2)], ids=str)
def test_other_methods(method):
    system = random_system(3)
    x0 = lt.integrate(system, random_state(3), (0.0, 0.5), 0.5, lt.Reference(rtol=1e-12)).x[-1]
    assert np.abs(system.vector_field(x0)).max() < 2.0 < 40.0 < np.abs(system.vector_field(random_state(3))).max()
    # the heat that rushes into the coldest body at first is too quick for these steps
    exact = lt.integrate(system, x0, (0.0, 2.0), 2.0, lt.Reference(rtol=1e-12)).x[-1]
    errors = []
    for n in (40, 80, 160):
        solution = lt.integrate(system, x0, (0.0, 2.0), 2.0 / n, method, save_every=n // 40, engine="array")
        errors.append(np.abs(solution.x[-1] - exact).max())
        assert_both_laws(solution)
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - method.order) < 0.2).all(), errors


@pytest.mark.slow
def test_both_engines():
    system, x0 = random_system(5), random_state(5)
    array, compiled = (lt.integrate(system, x0, (0.0, 2.0), 0.05, engine=engine) for engine in ("array", "compiled"))
    assert np.abs(array.x - compiled.x).max() < 1e-12
    assert_both_laws(compiled)


# -- controls that must fail ------------------------------------------------------------------------------------------


class ConstantFactor(HeatConduction):
    """Control: the skew tensor with a constant in place of the Fourier factor, the Poisson tensor of SML §5."""

    def force(self, system, x, dH, dS, dL):
        T = dH[S := system.poisson.state_indices.S]
        i, j = np.array(self.first_bodies), np.array(self.second_bodies)
        return jnp.zeros_like(x).at[S[i]].add(self.conductance * T[j]).at[S[j]].add(-self.conductance * T[i])


class MidpointTemperatures(HeatConduction):
    """Control: the heat of the discrete temperatures, divided by those at the midpoint."""

    def force(self, system, x, dH, dS, dL):
        S = system.poisson.state_indices.S
        T = system.energy.gradient(x)[S]
        return super().force(system, x, dH, dS, dL) * jnp.ones_like(x).at[S].set(dH[S] / T)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("conduction", "energy", "entropy"),
    [(ConstantFactor, True, False), (MidpointTemperatures, False, True)],
)
def test_conduction_that_keeps_one_law_alone(conduction, energy, entropy):
    """Skewness without Fourier's factor keeps the energy only, its sign without skewness the entropy only."""
    right = particles(conductance=0.3)
    part = right.dissipation
    graph = Edges(np.array(part.first_bodies), np.array(part.second_bodies), part.conductance)
    wrong = eqx.tree_at(lambda s: s.dissipation, right, conduction(graph))
    solution = lt.integrate(wrong, np.log([2.0, 4.0]), (0.0, 5.0), 0.1, engine="array")
    assert (solution.audit().energy_drift < 1e-14) is energy
    assert (solution.stats.least_entropy_increment >= -1e-15) is entropy


# -- what is refused --------------------------------------------------------------------------------------------------

STONE = lt.Subsystem(Warm(jnp.asarray(1.0)), 1, name="stone")
CART = lt.Subsystem(lt.Kinetic([1.0]) + lt.Function(Warm(jnp.asarray(1.0))).on([2]), 3, name="cart")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"conductance": [[0.0, 1.0, 0.0], [2.0, 0.0, 1.0], [0.0, 1.0, 0.0]]}, "must be symmetric.*transpose by 1"),
        ({"conductance": np.ones((2, 2))}, r"of 3 parts must be a \(3, 3\) matrix, got shape \(2, 2\)"),
        ({"conductance": [(0, 1, -1.0), (1, 2, 1.0)]}, "between stone and cart must be finite and >= 0, got -1"),
        ({"conductance": [(0, 1, np.nan), (1, 2, 1.0)]}, "finite"),
        ({"conductance": [(0, 1, 1.0)]}, "2 parts that.*of stone and cart and that of body 2.*connected=False"),
        ({"conductance": np.eye(3)}, "with itself"),
        ({"conductance": [(0, 3, 1.0)]}, "must join two of the 3 parts"),
        ({"conductance": [(0, 1, 1.0), (1, 0, 1.0)]}, "given twice"),
        ({"conductance": [(0, 1)]}, r"\(i, j, weight\)"),
        ({"conductance": 1.0}, "only for two parts, got 3"),
        ({"drag": [(0, 1, 1.0)]}, "drag between stone and cart needs velocities.*0 and 1"),
        ({"drag": [(1, 2, -1.0)]}, "the drag between cart and body 2"),
        ({"coupling": 3.0}, "function of q"),
    ],
)
def test_unusable_couplings(arguments, words):
    bodies = [STONE, CART, lt.Subsystem(CART.energy, 3)]
    with pytest.raises(lt.InputError, match=words):
        lt.ComposedSystem(bodies, **arguments)


test_unusable_subsystems = refusal_test(
    (lambda: lt.Subsystem(lambda x: x[0], 2), "2n \\+ 1, or 1 for S alone"),
    (lambda: lt.Subsystem(Warm(jnp.asarray(1.0)), 1, friction=1.0), "no momenta"),
    (lambda: lt.Subsystem(CART.energy, 3, friction=-1.0), ">= 0, got -1"),
    (lambda: lt.Subsystem(CART.energy, 3, friction=[1.0, 2.0]), "shape"),
    (lambda: lt.Subsystem(CART.energy, 3, friction="dry"), "'contact', got 'dry'"),
    (
        lambda: lt.Subsystem(CART.energy, 3, friction=lambda x: x),
        r"must have shape \(\) or \(1,\) or \(1, 1\), got \(3,\)",
    ),
    (lambda: lt.ComposedSystem([CART, CART.energy]), "must be an lt.Subsystem"),
    (lambda: lt.ComposedSystem([]), "at least one"),
    error=(lt.InputError, lt.FunctionError),
)


@pytest.mark.slow
def test_graphs_in_every_form():
    """Matrix, sparse matrix and edges say the same; parts may be meant."""
    k = np.array([[0.0, 1.0, 0.5], [1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    bodies = [lt.Subsystem(Warm(jnp.asarray(c)), 1) for c in (1.0, 2.0, 0.5)]
    fields = [
        np.asarray(lt.ComposedSystem(bodies, conductance=graph).vector_field([0.1, 0.5, -0.3]))
        for graph in (k, k.tolist(), scipy.sparse.csr_array(k), [(0, 1, 1.0), (2, 0, 0.5)])
    ]
    for field in fields[1:]:
        assert np.allclose(field, fields[0], rtol=0, atol=1e-15)
    apart = lt.ComposedSystem(bodies, conductance=[(0, 1, 1.0)], connected=False)
    assert float(apart.vector_field([0.1, 0.5, -0.3])[2]) == 0.0


def test_conductances_are_parameters():
    """They can be swept and differentiated."""

    def production(k):
        return particles(conductance=k).entropy_production(jnp.array([0.1, 0.5]))

    swept = jax.vmap(production)(jnp.array([1.0, 2.0]))
    assert np.allclose(swept[1], 2 * swept[0], rtol=1e-15)
    assert np.allclose(jax.grad(production)(3.0), swept[0], rtol=1e-14)


@pytest.mark.slow
def test_conductances_that_depend_on_temperatures_and_states():
    """Fourier's law with them by hand; both laws in every step; the order in which an edge names its bodies."""
    stone = lambda: lt.Subsystem(Warm(jnp.asarray(1.0)), 1)  # noqa: E731
    law = lambda T_a, T_b, x: T_a + 2.0 * T_b**2 + x[0] ** 2  # noqa: E731
    x = np.log([1.0, 3.0])
    one = lt.ComposedSystem([stone(), stone()], conductance=[(1, 0, law)])
    k = 3.0 + 2.0 * 1.0 + 0.0
    assert np.allclose(one.vector_field(x), [k * 2.0 / 1.0, -k * 2.0 / 3.0], rtol=1e-14)
    assert np.allclose(one.fourier_factors(x)[0, 1], k * (1.0 - 1.0 / 3.0), rtol=1e-14)
    other = lt.ComposedSystem([stone(), stone()], conductance=lambda T_a, T_b: T_a * T_b)
    assert np.allclose(other.vector_field(x), [3.0 * 2.0, -3.0 * 2.0 / 3.0], rtol=1e-14)
    assert_both_laws(lt.integrate(one, x, (0.0, 3.0), 0.1))
    mixed = lt.ComposedSystem([stone() for _ in range(3)], conductance=[(0, 1, law), (1, 2, 0.5)])
    assert np.allclose(mixed.vector_field([0.0, 0.0, np.log(2.0)])[2], -0.5 / 2.0, rtol=1e-14)
    cooling = lt.ComposedSystem([stone(), stone()], conductance=lambda T_a, T_b: -1.0 + 0.0 * T_a, validate=False)
    assert lt.integrate(cooling, x, (0.0, 1.0), 0.1, on_failure="return").status.code == "non_finite"
    with pytest.raises(lt.InputError, match="needs two bodies, got 3"):
        lt.ComposedSystem([stone() for _ in range(3)], conductance=law)


def test_fourier_factors_as_they_are_printed():
    """SML 6.2 by hand: K by the temperatures at the midpoint; the library's differ in the second order of the step."""
    x, h = np.log([1.0, 3.0]), 0.1

    def printed_residual(end):
        z = np.exp(0.5 * (x + end))
        T = (np.exp(end) - np.exp(x)) / (end - x)
        K = 1.0 / z[0] - 1.0 / z[1]
        return x + h * np.array([K * T[1], -K * T[0]]) - end

    expected = scipy.optimize.root(printed_residual, x + np.array([0.1, -0.05]), tol=1e-13).x
    bodies = [lt.Subsystem(Warm(jnp.asarray(1.0)), 1) for _ in range(2)]
    ends = {}
    for conduction in ("midpoint", "discrete"):
        system = lt.ComposedSystem(bodies, conductance=1.0, conduction=conduction)
        solution = lt.integrate(system, x, (0.0, h), h, lt.MetriplecticMidpoint())
        ends[conduction] = solution.x[-1]
        assert solution.audit().energy_drift < 1e-15
        assert system.entropy_law == {"midpoint": None, "discrete": "nondecreasing"}[conduction]
    assert np.abs(ends["midpoint"] - expected).max() < 1e-13
    assert 1e-5 < np.abs(ends["discrete"] - expected).max() < 1e-3
    with pytest.raises(lt.InputError, match="conduction must be"):
        lt.ComposedSystem(bodies, conductance=1.0, conduction="middle")


def piston():
    """A piston between two gases, that rubs and lets heat through [GBY §1: several entropies]."""

    def gases(q, S):
        return (
            jnp.exp(S[0]) * (1.0 + q[0]) ** (-2 / 3) + jnp.exp(S[1]) * (1.0 - q[0]) ** (-2 / 3) + 0.01 * jnp.exp(S[2])
        )

    bodies = {
        "left": lt.Subsystem(None, 1),
        "right": lt.Subsystem(None, 1),
        "piston": lt.Subsystem(lt.Kinetic([1.0]), 3, friction=0.2),
    }
    return lt.ComposedSystem(bodies, gases, [(0, 2, 0.3), (2, 1, 0.2)], validate=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "order"),
    [
        (lt.VariationalIntegrator.midpoint(), 2.0),
        (lt.VariationalIntegrator.verlet(), 1.0),
        (lt.VariationalIntegrator.midpoint(0.3), 1.0),
        (lt.VariationalIntegrator.symmetrised(), 2.0),
        (lt.VariationalIntegrator([lt.FiniteDifference(0.2), lt.FiniteDifference(0.9)]), 1.0),
    ],
    ids=str,
)
def test_variational_integrators_of_several_entropies(method, order):
    """The schemes are stationary for their discrete action, by difference quotients; orders; no entropy falls."""
    system, x0 = piston(), np.array([0.1, -0.2, 0.2, 0.5, 0.3])
    exact = lt.integrate(system, x0, (0.0, 1.0), 0.02, lt.MetriplecticGauss(4)).x[-1]
    runs = [lt.integrate(system, x0, (0.0, 1.0), h, method) for h in (0.02, 0.01)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.15, errors
    assert np.diff(runs[0].entropy).min() > 0.0
    assert np.ptp(runs[0].energy) > 1e-7  # the energy is what the metriplectic schemes keep

    # (3.12) of three nodes, L_d and the forces by hand
    shares, h, (first, middle, last) = [map.alpha for map in method.phi], 0.02, runs[0].x[:3]
    U = lambda q, S: float(  # noqa: E731
        np.exp(S[0]) * (1 + q) ** (-2 / 3) + np.exp(S[1]) * (1 - q) ** (-2 / 3) + 0.01 * np.exp(S[2])
    )

    def action(q0, q1, a, b):  # the entropies are those of the nodes a, b
        potentials = [
            U((1 - alpha) * q0 + alpha * q1, (1 - alpha) * a[[0, 1, 4]] + alpha * b[[0, 1, 4]]) for alpha in shares
        ]
        return h * (0.5 * ((q1 - q0) / h) ** 2 - np.mean(potentials))

    q, e = [x[2] for x in (first, middle, last)], 1e-5
    by_middle = action(q[0], q[1] + e, first, middle) - action(q[0], q[1] - e, first, middle)
    by_middle += action(q[1] + e, q[2], middle, last) - action(q[1] - e, q[2], middle, last)
    friction = -0.2 * np.mean([alpha * (q[1] - q[0]) + (1 - alpha) * (q[2] - q[1]) for alpha in shares])
    assert abs(by_middle / (2 * e) + friction) < 1e-9
    assert abs(friction) > 1e-5


@pytest.mark.slow
def test_means_over_maps_where_the_mass_depends_on_the_position():
    """Scheme 3 gives each map a momentum of its own: order 2 against a Gauss method, and the same step by SciPy."""
    metric = lambda q: jnp.array([1.0 + 0.5 * q[0] ** 2])  # noqa: E731
    body = lt.Subsystem(
        lt.Kinetic(metric) + lt.Potential(lambda q, S: 0.5 * q[0] ** 2 + jnp.exp(S)), 3, friction=0.3, name="body"
    )
    room = lt.Subsystem(lambda x: 2.0 * jnp.exp(x[0] / 2.0), 1, name="room")
    system, x0 = lt.ComposedSystem([body, room], conductance=0.4), np.array([0.8, 0.3, 0.1, -0.4])
    method = lt.VariationalIntegrator.symmetrised()
    exact = lt.integrate(system, x0, (0.0, 1.0), 0.02, lt.MetriplecticGauss(4)).x[-1]
    runs = [lt.integrate(system, x0, (0.0, 1.0), h, method) for h in (0.04, 0.02)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - 2.0) < 0.15, errors
    assert np.diff(runs[0].entropy).min() > 0.0

    # L = v^2 / (2 G(q)) - V: the momentum between two steps is D_2 L_d of the one and -D_1 L_d of the other
    h, (q0, q1) = 0.04, runs[0].x[:2, 0]
    mass, slope = lambda q: 1.0 / (1.0 + 0.5 * q * q), lambda q: -q / (1.0 + 0.5 * q * q) ** 2
    v = (q1 - q0) / h
    p0 = 0.5 * v * (mass(q0) + mass(q1)) - 0.5 * h * (0.5 * slope(q0) * v * v - q0 - 0.3 * v)
    assert abs(p0 - x0[1]) < 1e-13
    with pytest.raises(lt.InputError, match="exchange particles need a single finite difference map"):
        lt.integrate(lt.models.porous_piston(), np.ones(7), (0.0, 1.0), 0.1, method)
    with pytest.raises(lt.InputError, match="the maps of forces and constraint must be phi"):
        lt.integrate(system, x0, (0.0, 1.0), 0.1, lt.VariationalIntegrator("midpoint", forces="verlet"))


@pytest.mark.slow
def test_temperatures_that_are_not_positive():
    """At the start, an error that names the body; on the way, a status; at test points, left out."""
    odd = lt.Subsystem(lambda x: 0.5 * x[0] ** 2, 1, name="odd")  # T = S
    system = lt.ComposedSystem([STONE, odd], conductance=1.0, validate=False)
    with pytest.raises(lt.InputError, match=r"cannot start.*temperature of odd is -0.5.*positive"):
        lt.integrate(system, [0.1, -0.5], (0.0, 1.0), 0.1)
    assert "outside the domain" in str(system.check())
    solution = lt.integrate(system, [-3.0, 0.3], (0.0, 40.0), 4.0, on_failure="return", engine="array")
    assert not solution.status.ok
    assert "positive" in solution.status.message


def test_places():
    places = mf.ExtendedPhaseSpace((2, 0, 1)).state_indices
    assert places.q.tolist() == [0, 1, 6]
    assert places.p.tolist() == [2, 3, 7]
    assert places.S.tolist() == [4, 5, 8]
    assert places.owner.tolist() == [0, 0, 2]
    space = mf.ExtendedPhaseSpace((2, 0, 1))
    alpha = np.arange(1.0, 10.0)
    assert np.array_equal(space.tensor(alpha) @ alpha, space.sharp(alpha, alpha))
    assert space.rank(alpha) == 6
    assert float(space.jacobi_residual(alpha)) == 0.0
    with pytest.raises(mf.ParameterError, match="integers >= 0"):
        mf.ExtendedPhaseSpace((1, -1))
