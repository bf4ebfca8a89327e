"""Equilibria of fluctuating systems: known answers, detailed balance, and noise that is not the right one."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.integrators import fluctuating
from liethermo.models.gas_piston import GAS_CONSTANT, gas_piston_state
from liethermo.testing import PropertyError, check_equilibrium
from liethermo.testing.equilibrium import sample_exact_measure
from tests.additions.group import LINE

INERTIA = np.array([3.0, 2.0, 1.0])
FIELD, TEMPERATURE = 2.0, 0.8
ENTROPY = lt.Quadratic(4.0 * np.ones(3))
NOISE, BATH = lt.Fluctuations(1.0, seed=2), lt.Fluctuations(1.0, seed=2, temperature=TEMPERATURE)


def body(dissipation):
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), ENTROPY, dissipation)


SPIN = lt.LiePoissonSystem(mf.so(3), lambda s: -FIELD * s[2], None, lt.DoubleBracket(0.5))
ROTOR = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), None, lt.Friction(0.5 * np.ones(3)))
UP = np.array([0.0, 0.0, 1.0])


def drawn(system, noise, number):
    """Independent states in equilibrium."""
    exact, rng = sample_exact_measure(system, noise, UP, np.zeros((2, 3))), np.random.default_rng(1)
    return exact.points[rng.choice(len(exact.points), number, p=exact.weights / exact.weights.sum())]


def langevin(x):
    return 1.0 / np.tanh(x) - 1.0 / x


def test_a_spin_in_a_bath_has_the_magnetisation_of_langevin():
    report = check_equilibrium(SPIN, BATH, UP, 8.0, 0.1, paths=1000, moments={"s": lambda s: s[2]})
    note = next(row.note for row in report.rows if row.name.startswith("<s>"))
    found, exact = (float(word.split()[-1]) for word in note.replace("+-", ",").split(",")[:2])
    assert abs(exact - langevin(FIELD / TEMPERATURE)) < 0.005
    assert abs(found - langevin(FIELD / TEMPERATURE)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.1, 0.05, 0.025])
@pytest.mark.parametrize(
    ("system", "noise", "time"),
    [(SPIN, BATH, 12.0), (ROTOR, BATH, 12.0), (body(lt.KillingDissipation(0.5)), NOISE, 8.0)],
    ids=["spin", "rotor", "body"],
)
def test_known_equilibria(system, noise, time, step):
    """The bias of the largest step stays below the errors of 2,000 paths."""
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
    """The measure does not know K, which is what the divergence of K is there for: from there, paths stay there."""
    system = body(dissipation)
    check_equilibrium(system, NOISE, drawn(system, NOISE, 3000), 6.0, 0.03, paths=3000)


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


class Crooked(lt.DoubleBracket):
    """Control: noise by a factor that is a tenth too large."""

    def factor(self, system, x, dH, dL):
        return super().factor(system, x, dH, dL).scale_by(jnp.asarray(1.21))


CROOKED = lt.LiePoissonSystem(mf.so(3), SPIN.energy, None, Crooked(0.5))


@pytest.mark.slow
def test_the_wrong_noise_is_found(monkeypatch):
    """It is refused; and where nobody looks, it has another equilibrium."""
    with pytest.raises(lt.InputError, match=r"differs from K dS by a relative error of 0.2"):
        lt.integrate(CROOKED, UP, (0.0, 1.0), 0.1, noise=BATH)
    monkeypatch.setattr(fluctuating, "MISFIT", 1.0)
    with pytest.raises(PropertyError, match="standard errors"):
        check_equilibrium(CROOKED, BATH, UP, 12.0, 0.05, moments={"s": lambda s: s[2]})


@pytest.mark.slow
@pytest.mark.parametrize("system", [SPIN, CROOKED], ids=["right", "a tenth too large"])
def test_detailed_balance(system, monkeypatch):
    """From equilibrium as many go from A to B as back: ``p(A to B) / p(B to A) = P(B) / P(A)``, which is known.

    A and B are where the energy is below and above a value: turning time round changes neither.
    """
    monkeypatch.setattr(fluctuating, "MISFIT", 1.0)
    starts = drawn(SPIN, BATH, 40_000)
    ends = lt.ensemble(system, starts, (0.0, 0.6), 0.05, noise=BATH).x
    before, after = starts[:, 2] > 0.7, ends[:, 2] > 0.7
    there, back = int((before & ~after).sum()), int((~before & after).sum())
    away = (there - back) / np.sqrt(there + back)
    assert min(there, back) > 2000
    if system is SPIN:
        assert abs(away) < 3.0
        ratio = (back / (~before).sum()) / (there / before.sum())
        z = FIELD / TEMPERATURE
        expected = (np.exp(z) - np.exp(0.7 * z)) / (np.exp(0.7 * z) - np.exp(-z))
        assert abs(ratio / expected - 1.0) < 5.0 / np.sqrt(min(there, back))
    else:
        assert abs(away) > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("step", [4e-3, 2e-3, 1e-3])
def test_a_piston_between_two_gases(step):
    """It jitters with the variance ``k / (n_l R / q^2 + n_r R / (L - q)^2)``, as at a fixed temperature."""
    k, paths, moles = 1e-3, 2000, (1.0, 2.0)
    gases = lt.models.gas_piston(moles=moles, conductance=(100.0, 100.0))
    q = moles[0] / sum(moles)
    x0 = gas_piston_state(q, (300.0, 300.0, 300.0), moles=moles)
    many = lt.ensemble(
        gases, np.tile(x0, (paths, 1)), (0.0, 2.0), step, noise=lt.Fluctuations(k, seed=3), outputs="trajectory",
        save_every=round(0.05 / step),
    )  # fmt: skip
    assert many.audit().passed
    assert many.energy_drift.max() < 1e-13
    squares = ((many.x[:, many.t >= 1.0, 1] - q) ** 2).mean(axis=1)
    exact = k / (moles[0] * GAS_CONSTANT / q**2 + moles[1] * GAS_CONSTANT / (1.0 - q) ** 2)
    assert abs(squares.mean() - exact) < 3.0 * squares.std() / np.sqrt(paths)


LINEAR = lt.LiePoissonSystem(
    LINE, lambda x: 0.5 * (x[0] ** 2 + jnp.log(jnp.abs(x[1])) ** 2), None, lt.DoubleBracket(0.3), validate=False
)


def weight(x):
    """Of the measure that coadjoint motion on the affine algebra keeps: ``da db / |b|``."""
    return -jnp.log(jnp.abs(x[1]))


def test_the_measure_of_an_algebra_that_is_not_unimodular():
    """Volume is not kept there: that is said, and a density can be given."""
    report = BATH.check(LINEAR)
    assert report.passed
    assert report.rows[-1].residual > 0.1
    assert "not known" in report.rows[-1].note
    weighted = lt.Fluctuations(1.0, seed=2, temperature=TEMPERATURE, density=weight).check(LINEAR)
    assert weighted.rows[-1].residual < 1e-10
    with pytest.raises(ValueError, match="give a density"):
        check_equilibrium(LINEAR, BATH, [0.0, 1.0], 1.0, 0.1)


@pytest.mark.slow
def test_equilibrium_with_a_density():
    """``(a, log b)`` is normal, with the variance k T."""
    noise = lt.Fluctuations(0.5, seed=2, temperature=TEMPERATURE, density=weight)
    a, y = np.sqrt(0.5 * TEMPERATURE) * np.random.default_rng(0).standard_normal((2, 100_000))
    moments = {"y": lambda x: jnp.log(x[1]), "y^2": lambda x: jnp.log(x[1]) ** 2, "a^2": lambda x: x[0] ** 2}
    samples = np.stack([a, np.exp(y)], axis=1), np.ones(len(a))
    check_equilibrium(LINEAR, noise, [0.0, 1.0], 20.0, 0.02, moments=moments, samples=samples)
    plain = lt.Fluctuations(0.5, seed=2, temperature=TEMPERATURE)
    with pytest.raises(PropertyError):
        check_equilibrium(LINEAR, plain, [0.0, 1.0], 20.0, 0.02, moments=moments, samples=samples)


def test_what_is_not_known_is_not_compared():
    """Two functions that motion and noise keep; too few points that count."""
    spins = lt.LiePoissonSystem(
        mf.direct_sum(mf.so(3), mf.so(3)), lt.Quadratic(np.arange(1.0, 7.0)), None, lt.DoubleBracket(0.1)
    )
    with pytest.raises(ValueError, match="give samples"):
        sample_exact_measure(spins, BATH, np.ones(6), np.zeros((2, 6)))
    few = np.tile(UP, (10, 1)), np.ones(10)
    with pytest.raises(ValueError, match="count as 10 alone"):
        check_equilibrium(SPIN, BATH, UP, 1.0, 0.1, paths=8, samples=few)
