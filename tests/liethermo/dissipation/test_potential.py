"""Potentials of forces: quadratic ones give K, named ones have the stated slopes, and unusable ones are rejected."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.models.gases import gas_piston_state
from tests.cases import DISSIPATIONS, build, energy_of, few_combinations
from tests.liethermo import random_systems
from tests.refusals import refusal_test

S = lt.Quadratic(np.ones(3))


def half_square(f):
    return 0.5 * jnp.dot(f, f)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "case",
    [
        c
        for c in DISSIPATIONS
        if c.name not in ("force", "double_bracket", "sum") and not c.name.startswith("potential")
    ],
    ids=lambda case: case.name,
)
def test_a_quadratic_potential_is_K(case):
    system = build(mf.so(3), case)
    potential = lt.DissipationPotential(half_square, of=system.dissipation)
    potential_system = lt.LiePoissonSystem(mf.so(3), system.energy, system.entropy, potential)
    x = np.random.default_rng(0).standard_normal((20, 3))
    force = np.asarray(system.vector_field(x))
    assert np.abs(np.asarray(potential_system.vector_field(x)) - force).max() <= 1e-14 * np.abs(force).max()


def test_the_default_is_the_orthogonal_projector():
    """The force is ``P grad psi(P dS)``, with P the projector off dH."""
    psi = lt.PowerLawFriction(3.0, 0.7, each=True)
    system = lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), S, lt.DissipationPotential(psi))
    x = jnp.array([0.3, -0.8, 0.5])
    dH, dS = system.energy.gradient(x), S.gradient(x)
    P = np.eye(3) - np.outer(dH, dH) / (dH @ dH)
    f = P @ dS
    motion = system.poisson.sharp(x, dH)
    assert np.allclose(system.vector_field(x) - motion, P @ (0.7 * np.abs(f) * f), atol=1e-14)


@pytest.mark.parametrize(
    ("psi", "slope"),
    [
        (lt.CoulombFriction(2.0, 0.3), lambda f: 2.0 * f / np.sqrt(f * f + 0.09)),
        (lt.PowerLawFriction(1.5, 2.0), lambda f: 2.0 * np.sign(f) * np.abs(f) ** 0.5),
        (lt.PowerLawFriction(4.0, 2.0, 0.1), lambda f: 2.0 * f * (f * f + 0.01)),
        (lt.ActivatedFriction(0.5, 0.2), lambda f: 0.1 * np.sinh(f / 0.2)),
    ],
    ids=["coulomb", "root", "cubic", "activated"],
)
def test_named_potentials(psi, slope):
    """Slopes agree with formulas at forces of many sizes and at zero, for single forces and for their length."""
    f = np.array([0.0, 1e-9, -1e-4, 0.03, -0.4, 2.0, -5.0])
    slopes = jax.jit(jax.vmap(jax.grad(lambda f: psi(f[None]))))(jnp.asarray(f))
    assert np.allclose(slopes, slope(f), rtol=1e-13, atol=1e-300)
    length, direction = 0.7, np.array([0.6, -0.8])
    slopes = jax.jit(jax.grad(psi))(jnp.asarray(length * direction))
    assert np.allclose(slopes, slope(np.array(length)) * direction, rtol=1e-13)


def test_forces_between_bodies():
    """Activated heat conduction has a flow for each pair of bodies, and obeys both laws."""
    bodies = lt.models.gas_piston(friction=0.0)
    potential = lt.DissipationPotential(lt.ActivatedFriction(1.0, 0.5, each=True), of=bodies.dissipation)
    x = jnp.asarray(gas_piston_state(0.4, (310.0, 290.0, 300.0)))
    dH, dS = bodies.energy.gradient(x), bodies.entropy.gradient(x)
    force = potential.force(bodies, x, dH, dS, ())
    assert abs(force @ dH) < 1e-12 * float(np.linalg.norm(force) * np.linalg.norm(dH))
    T, k = np.asarray(dH[bodies.poisson.state_indices.S]), 5.0
    root_01, root_12 = (np.sqrt(k * a * b) for a, b in itertools.pairwise(T))
    f = np.array([root_01 * (1 / T[0] - 1 / T[1]), root_12 * (1 / T[1] - 1 / T[2])])
    flow = 0.5 * np.sinh(f / 0.5)
    entropy_rates = np.array(
        [root_01 * flow[0] / T[0], -root_01 * flow[0] / T[1] + root_12 * flow[1] / T[1], -root_12 * flow[1] / T[2]]
    )
    assert np.allclose(force[bodies.poisson.state_indices.S], entropy_rates, rtol=1e-12)


@pytest.mark.parametrize(
    ("psi", "words"),
    [
        (lambda f: -jnp.dot(f, f), "psi convex"),
        (lambda f: jnp.dot(f, f) + jnp.sum(jnp.cos(3.0 * f)), "psi convex"),
        (lambda f: jnp.dot(f, f) + f[0], "psi least at 0"),
        (lambda x, f: (x[0] - 0.1) * jnp.dot(f, f), "psi convex"),
    ],
    ids=["concave", "wavy", "tilted", "of the state"],
)
def test_invalid_potentials_are_rejected(psi, words):
    with pytest.raises(lt.AxiomError, match=words):
        lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), S, lt.DissipationPotential(psi))


test_unusable_potentials = refusal_test(
    (lambda: lt.DissipationPotential(3.0), "function from forces"),
    (lambda: lt.DissipationPotential(half_square, of=lt.DoubleBracket()), "conserves the energy, and DoubleBracket"),
    (lambda: lt.DissipationPotential(half_square, of=3.0), "of must be a dissipation"),
    (lambda: lt.PowerLawFriction(1.0), "exponent"),
    (lambda: lt.CoulombFriction(-1.0), ">= 0"),
    (lambda: lt.CoulombFriction(1.0, 0.0), "> 0"),
    (lambda: lt.ActivatedFriction(1.0, [1.0, 2.0]), "one number"),
)


def test_a_potential_needs_a_factor_and_returns_a_number():
    for dissipation, error in (
        (lt.DissipationPotential(lambda f: f), lt.FunctionError),
        (lt.DissipationPotential(half_square, of=lt.DissipationPotential(half_square)), lt.InputError),
    ):
        with pytest.raises(error, match=r"one number|no factor"):
            lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), S, dissipation)


POTENTIALS = {
    "coulomb": lambda rate: lt.DissipationPotential(lt.CoulombFriction(rate, 0.1)),
    "power": lambda rate: lt.DissipationPotential(lt.PowerLawFriction(2.5, rate)),
    "activated": lambda rate: lt.DissipationPotential(lt.ActivatedFriction(rate, 5.0)),
}
"""Potentials as functions of their rate, by name."""


@pytest.mark.slow
@few_combinations(
    method=[lt.MetriplecticMidpoint(), lt.MetriplecticGauss(1), lt.MetriplecticGauss(3), lt.MetriplecticRungeKutta(4)],
    kind=POTENTIALS,
)
def test_laws_of_a_thousand_random_systems(method, kind):
    """The laws hold for random energies and entropies; the midpoint scheme claims no entropy law for these."""
    for g, number in ((mf.so(3), 1000), (mf.se(3), 100)):

        def build_system(p, g=g):
            S = random_systems.entropy(random_systems.casimirs(g), p)
            return lt.LiePoissonSystem(g, random_systems.energy(p), S, POTENTIALS[kind](p["rate"]), validate=False)

        p, x0s = random_systems.parameters(g, number, 3), random_systems.states(g, number, 3)
        ensemble = lt.ensemble(build_system, x0s, (0.0, 1.0), 0.02, method, parameters=p, outputs="summary")
        assert ensemble.ok.all()
        assert ensemble.energy_drift.max() < 1e-13
        if "entropy_law" in method.preserves:
            assert ensemble.audit().passed, str(ensemble.audit())


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=str)
def test_orders(method):
    """The orders against SciPy are those of the methods, since the potential is smooth."""
    dissipation = lt.DissipationPotential(lt.ActivatedFriction(0.3, 0.5))
    system = lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), S, dissipation)
    x0 = np.array([0.5, -0.6, 0.9])
    exact = lt.integrate(system, x0, (0.0, 1.0), 1.0, lt.Reference(rtol=3e-14)).x[-1]
    errors = []
    for n in (10, 20, 40):
        run = lt.integrate(system, x0, (0.0, 1.0), 1.0 / n, method, engine="array")
        assert run.audit().passed
        errors.append(np.abs(run.x[-1] - exact).max())
    assert np.abs(np.log2(np.array(errors[:-1]) / errors[1:]) - 4.0).max() < 0.35


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=str)
def test_activated_friction_may_end_in_finite_time(method):
    """If the entropy grows steeper along the motion, exp(|grad S| / scale) diverges, to rates of 1e7 and beyond.

    The regular run agrees with SciPy to the tolerance; the other one ends at the same time as SciPy's.
    """
    g = mf.so(3)
    p, x0s = random_systems.parameters(g, 1000, 3), random_systems.states(g, 1000, 3)
    regular, blowing_up = (({name: value[i] for name, value in p.items()}, x0s[i]) for i in (365, 240))

    def system(q):
        S = random_systems.entropy(random_systems.casimirs(g), q)
        dissipation = lt.DissipationPotential(lt.ActivatedFriction(q["rate"], 2.0))
        return lt.LiePoissonSystem(g, random_systems.energy(q), S, dissipation, validate=False)

    run = lt.integrate(system(regular[0]), regular[1], (0.0, 1.0), lt.Adaptive(1e-6), method)
    exact = lt.integrate(system(regular[0]), regular[1], (0.0, 1.0), 0.01, lt.Reference(rtol=1e-10))
    assert run.audit().passed
    assert np.abs(run.x[-1] - exact.x[-1]).max() < 1e-5
    run = lt.integrate(system(blowing_up[0]), blowing_up[1], (0.0, 1.0), lt.Adaptive(1e-6), method, on_failure="return")
    exact = lt.integrate(
        system(blowing_up[0]), blowing_up[1], (0.0, 1.0), 0.01, lt.Reference(rtol=1e-10), on_failure="return"
    )
    assert run.status.code == "step_underflow"
    assert exact.status.code == "reference_failed"
    assert exact.t[-1] < run.t[-1] < exact.t[-1] + 0.01
