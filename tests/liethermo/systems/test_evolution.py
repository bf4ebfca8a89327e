"""Evolution fields: both laws at every step, the closed form of the paper, and the plain contact fields beside them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import liethermo as lt
import manifolds as mf
from liethermo.functions.gradients import DISCRETE_GRADIENTS
from tests.cases import tolerance

seeds = st.integers(0, 10**6)
GAMMA = 0.1


def oscillator():
    """SML Example 5: ``H = p^2/2 + q^2/2 + gamma S``."""
    return lt.EvolutionSystem(lt.Quadratic([1.0, 1.0, 0.0], [0.0, 0.0, GAMMA]), dim=3)


class Bumpy(eqx.Module):
    """A random potential V(q, S): a warm spring that softens, and waves in all directions."""

    a: jax.Array  # (n + 1,) wave vector
    b: jax.Array  # (n,) stiffness

    def __call__(self, q, S):
        return 0.3 * jnp.sin(self.a[:-1] @ q + self.a[-1] * S) + 0.5 * jnp.sum(self.b * q**2) * jnp.exp(-S / 9) + S


class Metric(eqx.Module):
    """A random inverse metric that depends on q."""

    root: jax.Array  # (n, n)

    def __call__(self, q):
        bent = self.root * (1.5 + jnp.sin(q))
        return bent @ bent.T + 0.1 * jnp.eye(len(q))


def bumpy_energy(seed, bent):
    rng = np.random.default_rng(seed)
    a, b, root = 2 * rng.standard_normal(3), rng.random(2), rng.standard_normal((2, 2))
    kinetic = lt.Kinetic(Metric(jnp.asarray(root)) if bent else root @ root.T)
    return kinetic + lt.Potential(Bumpy(jnp.asarray(a), jnp.asarray(b)))


def random_state(seed):
    return 1.5 * np.random.default_rng(seed).standard_normal(5)


def assert_both_laws(solution):
    """At every step, to rounding."""
    assert solution.audit().energy_drift <= tolerance("energy")
    allowed = tolerance("entropy") * np.abs(solution.entropy).max()
    assert solution.stats.least_entropy_increment >= -allowed


# -- the field --------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def both_fields(energy, x):
    evolution, contact = lt.EvolutionSystem(energy, 5, validate=False), lt.ContactSystem(energy, 5, validate=False)
    M = mf.CanonicalContact(2)
    return (
        evolution.vector_field(x) - M.evolution_vector_field(energy.value)(x),
        contact.vector_field(x) - M.hamiltonian_vector_field(energy.value)(x),
    )


@given(seed=seeds)
def test_the_fields_are_those_of_the_contact_structure(seed):
    for difference in both_fields(bumpy_energy(seed, True), random_state(seed)):
        assert np.abs(difference).max() < 1e-13


def test_the_linearly_damped_system():
    """SML Example 1, with the sign of its friction force: ``p' = -V' - gamma p``, ``S' = p^2/m``, T = gamma."""
    m, gamma, x = 2.0, 0.3, np.array([0.7, -1.1, 0.4])
    system = lt.EvolutionSystem(lt.Kinetic([1 / m]) + lt.Potential(lambda q, S: 0.25 * q[0] ** 4 + gamma * S), 3)
    q, p, _ = x
    assert np.allclose(system.vector_field(x), [p / m, -(q**3) - gamma * p, p**2 / m], rtol=0, atol=1e-15)
    assert float(system.temperature(x)) == pytest.approx(gamma, abs=1e-16)
    assert float(system.entropy_production(x)) == pytest.approx(p**2 / m, abs=1e-15)


def test_the_report():
    """The axioms, the first law as a tangency, and the sign of Delta_Q H where the second law is not known to hold."""
    known = str(oscillator().check())
    assert "eta(x') = 0" in known
    assert "entropy law" in known
    turning = lt.EvolutionSystem(lambda x: 0.5 * x[1] ** 2 + 0.5 * x[0] ** 2 + x[1] * jnp.sin(x[2]) + 0.1 * x[2], 3)
    assert turning.entropy_law is None
    (row,) = [row for row in turning.check().rows if row.axiom == "min Delta_Q H"]
    assert row.passed is None
    assert row.residual < 0
    assert "entropy falls there" in row.note
    points = np.random.default_rng(0).standard_normal((16, 3))
    assert row.residual == pytest.approx((points[:, 1] ** 2 + points[:, 1] * np.sin(points[:, 2])).min(), abs=1e-13)
    rising = lt.EvolutionSystem(lambda x: 0.5 * x[1] ** 4 + x[2], 3)  # not known, but found to produce entropy
    (row,) = [row for row in rising.check().rows if row.axiom == "min Delta_Q H"]
    assert row.residual >= 0
    assert "falls" not in row.note


# -- both laws at every step ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("bent", [pytest.param(False, marks=pytest.mark.slow, id="G"), pytest.param(True, id="G(q)")])
@given(seed=seeds, h=st.floats(0.01, 1.0))
def test_both_laws_for_random_potentials_and_steps(bent, seed, h):
    """SML §6.1 asks for a quadratic V; here any V, and a metric that depends on q."""
    system = lt.EvolutionSystem(bumpy_energy(seed, bent), 5, validate=False)
    assert system.entropy_law == "nondecreasing"
    solution = lt.integrate(system, random_state(seed), (0.0, 40 * h), h, on_failure="return", engine="array")
    if solution.stats.steps:
        assert_both_laws(solution)
    assert solution.entropy[-1] >= solution.entropy[0]
    if not solution.status.ok:  # some of these motions are so fast that the equations of a coarse step have no solution
        assert "smaller step" in solution.status.message
        end = solution.t[-1] + min(h, 0.2)
        assert lt.integrate(system, random_state(seed), (0.0, end), min(h, 0.2) / 16, engine="array").status.ok


@pytest.mark.slow
@pytest.mark.parametrize("name", DISCRETE_GRADIENTS)
def test_both_laws_with_every_discrete_gradient(name):
    """Diagonal G, for which the coordinate increment as printed is a midpoint gradient too."""
    energy = lt.Kinetic([1.0, 0.5]) + lt.Potential(Bumpy(jnp.array([2.0, -1.0, 1.5]), jnp.ones(2)))
    system = lt.EvolutionSystem(energy, 5)
    solution = lt.integrate(system, random_state(4), (0.0, 20.0), 0.2, lt.MetriplecticMidpoint(name))
    assert_both_laws(solution)
    assert solution.audit().passed


@pytest.mark.slow
def test_the_same_energy_as_one_plain_function():
    """Control: not told what is kinetic, the scheme keeps the first law and loses the second, in coarse steps."""

    def V(q, S):
        return 0.5 * jnp.cos(7.0 * q[0] + 0.4 * q[1] + 0.3 * S) + 0.1 * jnp.sum(q**4) + 0.002 * S + 0.5 * q[0]

    energy, x0, h = lt.Kinetic([3.5, 1e-3]) + lt.Potential(V), [0.0, 0.0, 0.2, 0.3, 0.0], 0.7
    plain = lt.EvolutionSystem(lambda x: energy.value(x), 5)
    assert plain.entropy_law is None
    told, untold = (
        lt.integrate(s, x0, (0.0, 4 * h), h, engine="array") for s in (lt.EvolutionSystem(energy, 5), plain)
    )
    assert_both_laws(told)
    assert untold.audit().energy_drift <= tolerance("energy")
    assert untold.stats.least_entropy_increment < -0.05
    assert "no law promised" in str(untold.audit())


def test_a_lorentzian_metric_promises_nothing():
    """SML §7: the second law fails for such metrics, except along time-like curves."""
    system = lt.EvolutionSystem(lt.Kinetic([1.0, -1.0]) + lt.Potential(lambda q, S: 0.1 * S + q @ q), 5)
    assert system.entropy_law is None
    assert float(system.entropy_production([0.0, 0.0, 0.2, 1.0, 0.0])) == pytest.approx(0.04 - 1.0)


# -- the closed forms of the paper ------------------------------------------------------------------------------------


def closed_form_39(q, p, S, h, gamma):
    """One step of the damped oscillator, as printed [SML 39]."""
    D = 2 * gamma * h + h**2 + 4
    q1 = (2 * gamma * h * q - h**2 * q + 4 * h * p + 4 * q) / D
    p1 = -(2 * gamma * h * p + h**2 * p + 4 * h * q - 4 * p) / D
    S1 = (S * h**4 + (4 * S * gamma + 4 * q**2) * h**3 + (4 * S * gamma**2 - 16 * p * q + 8 * S) * h**2) / D**2
    return q1, p1, S1 + ((16 * S * gamma + 16 * p**2) * h + 16 * S) / D**2


def thousand_steps() -> np.ndarray:
    """Return 1000 steps of (39) in extended precision, from (0, 10, 0)."""
    h = gamma = np.longdouble("0.1")
    expected = [tuple(map(np.longdouble, (0, 10, 0)))]
    for _ in range(1000):
        expected.append(closed_form_39(*expected[-1], h, gamma))
    return np.array(expected)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_39(engine):
    """The generic scheme is (39): 1000 steps, against (39) in extended precision."""
    solution = lt.integrate(oscillator(), [0.0, 10.0, 0.0], (0.0, 100.0), 0.1, engine=engine)
    expected = thousand_steps()
    sizes = np.abs(expected).max(axis=0).astype(float)
    assert np.abs(solution.x[1] - [0.99255583, 9.85111663, 9.85167078]).max() < 1e-8
    assert (np.abs((solution.x - expected).astype(float)) <= 1e-14 * sizes).all()
    assert_both_laws(solution)
    # the exact motion dies out, and all energy has become heat
    assert solution.entropy[-1] == pytest.approx(50.0 / GAMMA, rel=1e-3)


@pytest.mark.slow
def test_observed_order():
    system, x0 = lt.EvolutionSystem(bumpy_energy(3, True), 5, validate=False), 0.5 * random_state(3)
    exact = lt.integrate(system, x0, (0.0, 2.0), 2.0, lt.Reference(rtol=1e-13)).x[-1]
    errors = []
    for n in (40, 80, 160, 320):
        errors.append(
            np.abs(
                lt.integrate(system, x0, (0.0, 2.0), 2.0 / n, save_every=n // 40, engine="array").x[-1] - exact
            ).max()
        )
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert min(errors) > 1e-10
    assert (np.abs(slopes - 2.0) < 0.2).all(), (errors, slopes)


@pytest.mark.slow
@pytest.mark.parametrize(("stages", "coarsest"), [(2, 80), (3, 40)])
def test_gauss(stages, coarsest):
    """Order 2s with both laws exact: V is corrected along q and S, the kinetic energy along q."""
    energy = lt.Kinetic(lambda q: 1.5 + jnp.sin(q)) + lt.Potential(Bumpy(jnp.array([2.0, 1.5]), jnp.array([1.0])))
    system, x0, method = lt.EvolutionSystem(energy, 3), [0.3, 1.0, 0.2], lt.MetriplecticGauss(stages)
    exact, errors = lt.integrate(system, x0, (0.0, 4.0), 4.0, lt.Reference(rtol=1e-13)).x[-1], []
    for n in (coarsest, 2 * coarsest, 4 * coarsest):
        solution = lt.integrate(system, x0, (0.0, 4.0), 4.0 / n, method, save_every=n // 10, engine="array")
        errors.append(np.abs(solution.x[-1] - exact).max())
        assert_both_laws(solution)
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert min(errors) > 2e-12
    assert (np.abs(slopes - 2 * stages) < 0.2).all(), (errors, slopes)


@pytest.mark.slow
def test_both_engines():
    system, x0 = lt.EvolutionSystem(bumpy_energy(5, True), 5, validate=False), random_state(5)
    array, compiled = (lt.integrate(system, x0, (0.0, 2.0), 0.05, engine=engine) for engine in ("array", "compiled"))
    assert np.abs(array.x - compiled.x).max() < 1e-12
    assert_both_laws(compiled)


# -- the plain contact field ------------------------------------------------------------------------------------------


def contact_run(a_S, b, steps):
    energy = lt.Kinetic([1.0]) + lt.Potential(Bumpy(jnp.array([2.0, a_S]), jnp.array([b])))
    system = lt.ContactSystem(energy, 3, validate=False)
    return (
        energy,
        system,
        lt.integrate(system, [0.3, 1.0, 0.2], (0.0, 1.0), 1.0 / steps, save_every=steps // 10, engine="array"),
    )


@pytest.mark.slow
def test_the_contact_field_keeps_its_law_exactly():
    """``H' = -R(H) H`` becomes ``H(x') - H(x) = -h (dgrad H)_S H(z)``, to rounding, at every step."""
    energy, system, solution = contact_run(1.5, 1.0, 10)
    x, d = solution.x[:-1], np.diff(solution.x, axis=0)
    gradient = eqx.filter_jit(jax.vmap(lambda x, d: lt.Gonzalez()(energy, x, d)))
    predicted = -0.1 * np.asarray(gradient(x, d))[:, -1] * np.asarray(energy(x + d / 2))
    assert np.ptp(solution.energy) > 0.2
    assert np.abs(np.diff(solution.energy) - predicted).max() < 1e-14
    assert "dH/dt = -R(H) H" in str(system.check())
    assert solution.entropy is None
    audit = solution.audit()
    assert audit.passed
    assert [row.note for row in audit.rows if row.law == "energy drift"] == ["no law promised"]


@pytest.mark.slow
def test_a_contact_field_at_constant_temperature_loses_its_energy_exponentially():
    """H_S = 1: ``H(t) = H(0) exp(-t)``, to second order."""
    errors = []
    for steps in (10, 20, 40):
        solution = contact_run(0.0, 0.0, steps)[2]
        errors.append(np.abs(solution.energy - solution.energy[0] * np.exp(-solution.t)).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - 2.0) < 0.2).all(), errors


# -- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 4, 3.0, True, None])
def test_the_state_has_an_odd_number_of_components(dim):
    with pytest.raises(lt.InputError, match=r"2n \+ 1 for n degrees of freedom"):
        lt.EvolutionSystem(lambda x: x @ x, dim)


def test_unusable_energies():
    with pytest.raises(lt.FunctionError, match="could not be evaluated"):
        lt.EvolutionSystem(lt.Quadratic(np.ones(5)), 3)
    with pytest.raises(lt.InputError, match="not finite at any"):
        lt.EvolutionSystem(lambda x: jnp.log(-(x @ x)), 3)
    with pytest.raises(lt.AxiomError, match="momentum map J"):
        lt.EvolutionSystem(lambda x: x @ x, 3, momentum_maps={"J": lambda x: x[1]})
