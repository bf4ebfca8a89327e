"""The shared suite: every algebra, dissipation and method through the laws at every step."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.cases import (
    ALGEBRAS,
    DISSIPATIONS,
    TRANSCENDENTAL,
    build,
    combinations,
    covering,
    energy_of,
    kind_of,
    state_of,
    tolerance,
)

METHODS = list(lt.registered_methods())
STEPS = 40
STEP = 0.05


def run(system, x0, method=None, steps=STEPS, h=STEP):
    if system.algebra.name in TRANSCENDENTAL:  # their entropies are singular nearby: stay close to the initial state
        h = h / 10
    size, speed = np.linalg.norm(x0), np.linalg.norm(system.vector_field(x0))
    h = min(h, 0.05 * size / speed) if speed > 0.0 else h  # longer ones of some have no solution
    return lt.integrate(system, x0, (0.0, steps * h), h, method or lt.MetriplecticMidpoint())


def assert_laws(system, solution, method):
    """Assert the laws of the system that the method claims to preserve, at every step."""
    stats, audit = solution.stats, solution.audit()
    scale = abs(solution.energy[0])
    assert solution.status.ok
    if "energy" in method.preserves:
        if system.energy_law == "conserved":
            assert audit.energy_drift <= tolerance("energy")
        else:
            assert stats.largest_energy_increment <= tolerance("energy") * scale
    quadratic = all(isinstance(term, lt.Quadratic) for term in system.entropy.terms)
    exact = "entropy_law" in method.preserves or (quadratic and "entropy_law_quadratic" in method.preserves)
    entropy_size = np.abs(solution.entropy).max()
    if system.entropy_law == "nondecreasing":
        # a scheme that is not exact for this entropy may lose O(h^3) of it in a step
        tolerated_decrease = max(entropy_size, 1.0) * (
            tolerance("entropy") if exact else solution.provenance["step"] ** 3
        )
        assert stats.least_entropy_increment >= -tolerated_decrease
    for name in solution.laws.conserved:
        series = solution.casimirs[name]
        assert np.abs(series - series[0]).max() <= tolerance("casimir") * max(1.0, np.abs(series).max())


# -- every algebra, every dissipation, every method ---------------------------------------------------------------


def law_cases():
    """Return algebras with dissipations and methods, so that each pair of a kind of algebra, a dissipation and a method
    meets."""
    pairs = [case.values for case in combinations(ALGEBRAS)]
    places = [(ALGEBRAS.index(g), DISSIPATIONS.index(case)) for g, case in pairs]
    triples = [(*pair, METHODS[(i + j) % len(METHODS)]) for pair, (i, j) in zip(pairs, places, strict=True)]

    def keys(g, case, method):
        kind, method = kind_of(g), METHODS.index(method)
        return (kind, case.name), (case.name, method), (kind, method), (g.name, DISSIPATIONS.index(case) % 3)

    for g, case, method in covering(triples, keys):
        yield pytest.param(g, case, method, id=f"{g.name}-{case.name}-{method}")


@pytest.mark.sampled(
    "so(3)-killing-MetriplecticRungeKutta(order=4)",
    "heisenberg(1)-potential_power_law-MetriplecticMidpoint(gradient=Gonzalez)",
    "se(2)-inner_product-MetriplecticMidpoint(gradient=MeanValue)",
)
@pytest.mark.parametrize(("g", "case", "method"), list(law_cases()))
def test_every_algebra_dissipation_and_method(g, case, method):
    system = build(g, case)
    if isinstance(method, lt.MetriplecticTaylor):
        # near what is not smooth, such as |f|^1.5 at f = 0, or a pole, no polynomial reaches as far as other steps do
        end = 0.2 if g.name in TRANSCENDENTAL else 1.0
        solution = lt.integrate(system, state_of(g, 4), (0.0, end), lt.Adaptive(1e-8), method)
    else:
        solution = run(system, state_of(g, 4), method)
    assert_laws(system, solution, method)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_every_method_without_dissipation(method):
    """The energy and the quadratic Casimirs of a Lie-Poisson system are constant to rounding."""
    g = mf.se(3)
    system = lt.LiePoissonSystem(g, energy_of(6, 2))
    solution = run(system, state_of(g, 2), method)
    assert solution.audit().energy_drift <= tolerance("energy")
    assert len(solution.laws.conserved) == 2
    for name in solution.laws.conserved:
        assert np.abs(np.diff(solution.casimirs[name])).max() <= tolerance("casimir")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("g", [mf.su(3), mf.sl(3), mf.se(3)], ids=lambda g: g.name)
def test_killing_dissipation_from_random_states(g):
    """On the algebras named in the paper the laws hold at every step, from several states."""
    system = build(g, DISSIPATIONS[0], seed=3)
    for seed in range(4):
        solution = run(system, 0.5 * state_of(g, 10 + seed), steps=60, h=0.02)
        assert_laws(system, solution, lt.MetriplecticMidpoint())
        assert solution.entropy[-1] > solution.entropy[0]


def test_momentum_maps_are_kept():
    """A linear momentum map in the kernel of K is constant: BFM §2.4."""
    g, H = mf.so(3), lt.Quadratic(np.array([1.0, 1.0, 0.5]))  # symmetric about e3, so mu3 is conserved by the motion
    system = lt.LiePoissonSystem(
        g,
        H,
        lt.Quadratic(np.ones(3)),
        lt.ProjectedMetric(preserve=(lambda mu: mu[2],), normalized=True),
        momentum_maps={"mu3": lambda mu: mu[2]},
    )
    assert system.check().passed
    solution = run(system, [0.4, -0.8, 1.2])
    assert np.abs(solution.casimirs["mu3"] - 1.2).max() <= 1e-15
    assert "mu3" in str(solution.audit())


# -- controls that must fail --------------------------------------------------------------------------------------


def test_rk4_breaks_casimirs_and_energy():
    """Control: the classical Runge-Kutta method fails the audit that the midpoint scheme passes."""
    system = lt.models.free_rigid_body()
    x0, h, steps = np.array([np.cos(1.1), 0, np.sin(1.1)]), 0.2, 200
    field, x, states = system.vector_field, jnp.asarray(x0), []
    for _ in range(steps):
        states.append(np.asarray(x))
        k1 = field(x)
        k2 = field(x + h / 2 * k1)
        k3 = field(x + h / 2 * k2)
        k4 = field(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    states = np.array(states)
    casimir = np.asarray(system.entropy(states))
    energy = np.asarray(system.energy(states))
    assert np.abs(casimir - casimir[0]).max() > 1e3 * tolerance("casimir")
    assert np.abs(energy - energy[0]).max() > 1e3 * tolerance("energy")


def test_the_reference_method_fails_the_audit():
    system = lt.models.rigid_body()
    solution = run(system, [0.001, 1.0, 0.001], lt.Reference(rtol=1e-4), steps=400, h=0.5)
    audit = solution.audit()
    assert not audit.passed
    assert audit.energy_drift > 1e-8
    assert "A LAW FAILS" in str(audit)
    assert solution.laws.inexact == ("energy", "entropy")
    assert str(audit).count("not kept exactly by this method") == 2
    assert run(system, [0.001, 1.0, 0.001]).laws.inexact == ()


class WrongGradientMidpoint(lt.MetriplecticMidpoint):
    """Control: K built from grad H(x) instead of the discrete gradient."""

    def slopes(self, system, x, compensation, h, k):
        d = h * k[0]
        z = x + 0.5 * d
        dH = self.gradient(system.energy, x, d)
        motion = system.poisson.sharp(z, dH)
        dS = system.entropy.gradient(z)
        return (motion + system.dissipation.force(system, z, system.energy.gradient(x), dS, ()))[None]


class PlainMidpoint(lt.MetriplecticMidpoint):
    """Control: the plain implicit midpoint rule."""

    def slopes(self, system, x, compensation, h, k):
        return system.vector_field(x + 0.5 * h * k[0])[None]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [WrongGradientMidpoint(), PlainMidpoint()], ids=lambda m: type(m).__name__)
def test_schemes_that_are_not_rebuilt_lose_energy_and_only_energy(method):
    system = build(mf.so(3), next(case for case in DISSIPATIONS if case.name == "projected"))
    solution = run(system, state_of(mf.so(3), 0), method)
    assert solution.audit().energy_drift > 1e4 * tolerance("energy")
    assert solution.stats.least_entropy_increment >= 0.0


def test_transcendental_entropies_are_monotone_to_third_order_only():
    """For an entropy that is not quadratic the midpoint scheme has the entropy increment right to O(h^3) only."""
    g = mf.bianchi("V")
    system = build(g, next(case for case in DISSIPATIONS if case.name == "projected"))
    defects = []
    for h in (0.01, 0.005, 0.0025):
        x = state_of(g, 0)
        solution = lt.integrate(system, x, (0.0, h), h)
        z = 0.5 * (solution.x[0] + solution.x[1])
        production = float(system.entropy.gradient(z) @ (solution.x[1] - solution.x[0]))
        defects.append(abs(solution.entropy[1] - solution.entropy[0] - production))
    slopes = np.log2(np.array(defects[:-1]) / defects[1:])
    assert (np.abs(slopes - 3.0) < 0.2).all(), (defects, slopes)
