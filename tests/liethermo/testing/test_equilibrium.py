"""Equilibria of fluctuating systems, and the suites: they pass for known objects and fail for broken ones."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo import testing
from liethermo.integrators import fluctuating
from liethermo.models.gases import GAS_CONSTANT, gas_piston_state
from liethermo.testing import PropertyError, check_equilibrium
from liethermo.testing.equilibrium import weighted_equilibrium_samples
from tests.additions.group import LINE
from tests.cases import slow_case

INERTIA = np.array([3.0, 2.0, 1.0])
FIELD = 2.0
TEMPERATURE = 0.8
ENTROPY = lt.Quadratic(4.0 * np.ones(3))
NOISE = lt.Fluctuations(1.0, seed=2)
BATH = lt.Fluctuations(1.0, seed=2, temperature=TEMPERATURE)


def body(dissipation):
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), ENTROPY, dissipation)


SPIN = lt.LiePoissonSystem(mf.so(3), lambda s: -FIELD * s[2], None, lt.DoubleBracket(0.5))
ROTOR = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), None, lt.Friction(0.5 * np.ones(3)))
UP = np.array([0.0, 0.0, 1.0])


def draw_equilibrium_states(system, noise, number):
    """Return independent states in equilibrium, shape (number, 3)."""
    exact, rng = weighted_equilibrium_samples(system, noise, UP, np.zeros((2, 3))), np.random.default_rng(1)
    return exact.points[rng.choice(len(exact.points), number, p=exact.weights / exact.weights.sum())]


def langevin(x):
    return 1.0 / np.tanh(x) - 1.0 / x


def test_a_spin_in_a_bath_has_the_magnetisation_of_langevin():
    report = check_equilibrium(SPIN, BATH, UP, 8.0, 0.1, paths=1000, moments={"s": lambda s: s[2]})
    note = next(row.note for row in report.rows if row.name.startswith("<s>"))
    measured_mean, sampled_mean = (float(word.split()[-1]) for word in note.replace("+-", ",").split(",")[:2])
    assert abs(sampled_mean - langevin(FIELD / TEMPERATURE)) < 0.005
    assert abs(measured_mean - langevin(FIELD / TEMPERATURE)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.1, 0.05, 0.025])
@pytest.mark.parametrize(
    ("system", "noise", "time"),
    [(SPIN, BATH, 12.0), (ROTOR, BATH, 12.0), (body(lt.KillingDissipation(0.5)), NOISE, 8.0)],
    ids=["spin", "rotor", "body"],
)
def test_known_equilibria(system, noise, time, step):
    """The bias of the largest step is below the errors of 2,000 paths."""
    check_equilibrium(system, noise, UP, time, step)


@pytest.mark.slow
@pytest.mark.parametrize(
    "dissipation",
    [
        lt.ProjectedMetric(np.diag([0.5, 1.0, 1.5]), normalized=True, rate=0.5),
        lt.ProjectedMetric(lambda x: jnp.diag(1.0 + 0.5 * jnp.sin(x) ** 2), rate=0.5),
        lt.FrictionOperator(np.diag([0.5, 1.0, 1.5]), 0.5, project=True),
        lt.FourBracket.kulkarni_nomizu(0.3 * np.eye(3), np.diag([0.5, 1.0, 1.5])),
        lt.KillingDissipation(0.1) + lt.ProjectedMetric(rate=0.2),
    ],
    ids=["normalised", "of the state", "operator", "4-bracket", "sum"],
)
def test_every_dissipation_has_the_same_equilibrium(dissipation):
    """The measure does not depend on K, owing to the divergence term: paths that start in equilibrium stay in it."""
    system = body(dissipation)
    check_equilibrium(system, NOISE, draw_equilibrium_states(system, NOISE, 3000), 6.0, 0.03, paths=3000)


@pytest.mark.slow
def test_a_body_of_six_components():
    """se(3), where the linear momentum alone is in the entropy, with an energy that is not quadratic."""
    weights = np.array([1.0, 2.0, 3.0, 1.0, 1.5, 2.0])

    def H(m):
        return 0.5 * jnp.sum(weights * m * m) + 0.25 * jnp.dot(m[:3], m[:3]) ** 2

    g = mf.se(3)
    system = lt.LiePoissonSystem(g, H, lambda m: jnp.dot(m[3:], m[3:]), lt.ProjectedMetric(normalized=True, rate=0.5))
    squares = {f"x{i + 1}^2": lambda m, i=i: m[i] ** 2 for i in range(6)}  # from one well to the other it takes long
    check_equilibrium(system, lt.Fluctuations(0.5, seed=4), 0.7 * np.ones(6), 10.0, 0.02, moments=squares)


class OverscaledNoise(lt.DoubleBracket):
    """Control: a dissipation whose noise factor is a tenth too large."""

    def factor(self, system, x, dH, dL):
        return super().factor(system, x, dH, dL).scale_by(jnp.asarray(1.21))


OVERSCALED_SPIN = lt.LiePoissonSystem(mf.so(3), SPIN.energy, None, OverscaledNoise(0.5))


@pytest.mark.slow
def test_the_wrong_noise_is_found(monkeypatch):
    """Incorrect noise is refused; without the check it leads to another equilibrium."""
    with pytest.raises(lt.InputError, match=r"differs from K dS by a relative error of 0.2"):
        lt.integrate(OVERSCALED_SPIN, UP, (0.0, 1.0), 0.1, noise=BATH)
    monkeypatch.setattr(fluctuating, "FACTOR_RTOL", 1.0)
    with pytest.raises(PropertyError, match="standard errors"):
        check_equilibrium(OVERSCALED_SPIN, BATH, UP, 12.0, 0.05, moments={"s": lambda s: s[2]})


@pytest.mark.slow
@pytest.mark.parametrize("system", [SPIN, OVERSCALED_SPIN], ids=["right", "a tenth too large"])
def test_detailed_balance(system, monkeypatch):
    """In equilibrium as many paths go from A to B as back, and the ratio of the rates is the known ``P(B) / P(A)``.

    A and B are the states with energies below and above a value; time reversal changes neither.
    """
    monkeypatch.setattr(fluctuating, "FACTOR_RTOL", 1.0)
    starts = draw_equilibrium_states(SPIN, BATH, 40_000)
    ends = lt.ensemble(system, starts, (0.0, 0.6), 0.05, noise=BATH).x
    starts_in_B, ends_in_B = starts[:, 2] > 0.7, ends[:, 2] > 0.7
    n_B_to_A, n_A_to_B = int((starts_in_B & ~ends_in_B).sum()), int((~starts_in_B & ends_in_B).sum())
    standard_score = (n_B_to_A - n_A_to_B) / np.sqrt(n_B_to_A + n_A_to_B)
    assert min(n_B_to_A, n_A_to_B) > 2000
    if system is SPIN:
        assert abs(standard_score) < 3.0
        ratio = (n_A_to_B / (~starts_in_B).sum()) / (n_B_to_A / starts_in_B.sum())
        z = FIELD / TEMPERATURE
        exact_ratio = (np.exp(z) - np.exp(0.7 * z)) / (np.exp(0.7 * z) - np.exp(-z))
        assert abs(ratio / exact_ratio - 1.0) < 5.0 / np.sqrt(min(n_B_to_A, n_A_to_B))
    else:
        assert abs(standard_score) > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("step", [4e-3, 2e-3, 1e-3])
def test_a_piston_between_two_gases(step):
    """The position has the variance ``k / (n_l R / q^2 + n_r R / (L - q)^2)``, as at a fixed temperature."""
    k, paths, moles = 1e-3, 2000, (1.0, 2.0)
    gases = lt.models.gas_piston(moles=moles, conductance=(100.0, 100.0))
    q = moles[0] / sum(moles)
    x0 = gas_piston_state(q, (300.0, 300.0, 300.0), moles=moles)
    path_ensemble = lt.ensemble(
        gases, np.tile(x0, (paths, 1)), (0.0, 2.0), step, noise=lt.Fluctuations(k, seed=3), outputs="trajectory",
        save_every=round(0.05 / step),
    )  # fmt: skip
    assert path_ensemble.audit().passed
    assert path_ensemble.energy_drift.max() < 1e-13
    squares = ((path_ensemble.x[:, path_ensemble.t >= 1.0, 1] - q) ** 2).mean(axis=1)
    exact = k / (moles[0] * GAS_CONSTANT / q**2 + moles[1] * GAS_CONSTANT / (1.0 - q) ** 2)
    assert abs(squares.mean() - exact) < 3.0 * squares.std() / np.sqrt(paths)


LINEAR = lt.LiePoissonSystem(
    LINE, lambda x: 0.5 * (x[0] ** 2 + jnp.log(jnp.abs(x[1])) ** 2), None, lt.DoubleBracket(0.3), validate=False
)


def weight(x):
    """Return the log density of the measure ``da db / |b|``, which coadjoint motion on the affine algebra conserves."""
    return -jnp.log(jnp.abs(x[1]))


def test_the_measure_of_an_algebra_that_is_not_unimodular():
    """Volume is not conserved, which is reported unless a density is given."""
    report = BATH.check(LINEAR)
    assert report.passed
    assert report.rows[-1].residual > 0.1
    assert "unknown" in report.rows[-1].note
    report_with_density = lt.Fluctuations(1.0, seed=2, temperature=TEMPERATURE, density=weight).check(LINEAR)
    assert report_with_density.rows[-1].residual < 1e-10
    with pytest.raises(ValueError, match="Give a density"):
        check_equilibrium(LINEAR, BATH, [0.0, 1.0], 1.0, 0.1)


@pytest.mark.slow
def test_equilibrium_with_a_density():
    """``(a, log b)`` is normal, with the variance k T."""
    noise = lt.Fluctuations(0.5, seed=2, temperature=TEMPERATURE, density=weight)
    a, y = np.sqrt(0.5 * TEMPERATURE) * np.random.default_rng(0).standard_normal((2, 100_000))
    moments = {"y": lambda x: jnp.log(x[1]), "y^2": lambda x: jnp.log(x[1]) ** 2, "a^2": lambda x: x[0] ** 2}
    samples = np.stack([a, np.exp(y)], axis=1), np.ones(len(a))
    check_equilibrium(LINEAR, noise, [0.0, 1.0], 20.0, 0.02, moments=moments, samples=samples)
    without_density = lt.Fluctuations(0.5, seed=2, temperature=TEMPERATURE)
    with pytest.raises(PropertyError):
        check_equilibrium(LINEAR, without_density, [0.0, 1.0], 20.0, 0.02, moments=moments, samples=samples)


def test_an_unknown_measure_is_refused():
    """The noise conserves two functions, or the given samples are too few."""
    spins = lt.LiePoissonSystem(
        mf.direct_sum(mf.so(3), mf.so(3)), lt.Quadratic(np.arange(1.0, 7.0)), None, lt.DoubleBracket(0.1)
    )
    with pytest.raises(ValueError, match="give samples"):
        weighted_equilibrium_samples(spins, BATH, np.ones(6), np.zeros((2, 6)))
    ten_samples = np.tile(UP, (10, 1)), np.ones(10)
    with pytest.raises(ValueError, match="count as 10 alone"):
        check_equilibrium(SPIN, BATH, UP, 1.0, 0.1, paths=8, samples=ten_samples)


TESTED_DISSIPATIONS = {
    "killing": lt.KillingDissipation(0.3),
    "projected": lt.ProjectedMetric(rate=0.2),
    "sum": lt.KillingDissipation(0.1) + lt.ProjectedMetric(rate=0.1),
    "coulomb": lt.DissipationPotential(lt.CoulombFriction(0.2, 0.1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", [pytest.param(m, id=str(m)) for m in lt.registered_methods(special=True)])
def test_methods(method):
    assert testing.check_method(method).passed


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TESTED_DISSIPATIONS))
def test_dissipations(name):
    assert testing.check_dissipation(TESTED_DISSIPATIONS[name]).passed


@pytest.mark.parametrize("name", ["rigid_body", *map(slow_case, ("damped_oscillator", "thermo_particles"))])
def test_systems(name):
    assert testing.check_system(getattr(lt.models, name)()).passed


class Leaking(lt.ProjectedMetric):
    """Control: a dissipation with an incomplete projection, which loses energy."""

    def force(self, system, x, dH, dS, dL):
        return super().force(system, x, dH, dS, dL) + 0.1 * dS


def test_a_dissipation_that_loses_energy():
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), lt.Quadratic(np.ones(3)), Leaking(rate=0.2), validate=False
    )
    with pytest.raises(testing.PropertyError, match=r"any vector instead of grad H is in the kernel .*FAILS"):
        testing.check_dissipation(system)


class Euler(lt.MetriplecticMidpoint):
    """Control: Euler's method, of first order and without conservation laws."""

    def slopes(self, system, x, compensation, h, k):
        return system.vector_field(x)[None]


def test_a_method_that_claims_too_much():
    system = lt.LiePoissonSystem(
        mf.so(3), lambda m: 0.5 * jnp.sum(m * m * jnp.array([1.0, 0.5, 0.3])) + 0.1 * m[0] ** 4
    )
    with pytest.raises(testing.PropertyError) as failure:
        testing.check_method(Euler(), {"body": (system, [0.8, 0.5, 0.9], 1.0)})
    failing = {row.name for row in failure.value.report.rows if row.passed is False}
    assert {"body: order 2", "body: energy drift"} <= failing
