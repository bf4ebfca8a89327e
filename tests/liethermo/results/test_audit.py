"""The audit: sizes that rounding is judged by, how accurate a run is, whether it is one of its system; its controls."""

import dataclasses
import pickle

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from typer.testing import CliRunner

import liethermo as lt
import manifolds as mf
from liethermo.cli import app
from liethermo.results import looking

BODY = lt.models.rigid_body()
X0 = [0.001, 1.0, 0.001]


def rows(audit, law):
    return [row for row in audit.rows if row.law.startswith(law)]


def the_row(audit, law):
    (row,) = rows(audit, law)
    return row


# -- what starts at zero ----------------------------------------------------------------------------------------------


def heavy_top():
    """Pi . Gamma = 0 at the start, a Casimir of se(3)*."""
    energy = lt.Quadratic(np.diag([1.0, 1.0, 0.5, 0.0, 0.0, 0.0]), b=[0.0, 0.0, 0.0, 0.3, 0.0, 1.0])
    return lt.LiePoissonSystem(mf.se(3), energy), [0.3, -0.4, 1.1, 0.8, 0.6, 0.0]


def three_particles():
    """Joined by springs in a row, their centre of mass at rest."""
    q, p = np.eye(6)[:3], np.eye(6)[3:]
    springs = sum(np.outer(q[i] - q[j], q[i] - q[j]) for i, j in ((0, 1), (1, 2)))
    momentum = lt.Quadratic(np.zeros((6, 6)), b=p.sum(axis=0))
    system = lt.MetriplecticSystem(
        mf.Canonical(3), lt.Quadratic(springs + p.T @ p), momentum_maps={"momentum": momentum}
    )
    return system, [0.1, 1.3, 2.2, 0.1, 0.2, -0.3]


def pendulum():
    """Let go at 90 degrees, where its energy is zero."""
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 - jnp.cos(x[0])), [np.pi / 2, 0.0]


def separatrix():
    """On the way up to the unstable equilibrium, at its energy, which is zero."""
    q = 1.0
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 + jnp.cos(x[0]) - 1.0), [
        q,
        -2.0 * np.sin(q / 2),
    ]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("case", [heavy_top, three_particles, pendulum, separatrix])
def test_laws_of_what_starts_at_zero(case, tmp_path):
    system, x0 = case()
    solution = lt.integrate(system, x0, (0.0, 15.0), 0.05)
    starts = [solution.energy[0], *(series[0] for series in solution.casimirs.values())]
    assert np.abs(starts).min() < 1e-15
    assert solution.audit().passed, f"\n{solution.audit()}"
    assert solution.audit().energy_drift < 1e-14
    loaded = lt.load(solution.save(tmp_path / "run.nc"))
    assert str(loaded.audit()) == str(solution.audit())
    broken = dataclasses.replace(solution, energy=solution.energy + np.linspace(0.0, 1e-11, len(solution.t)))
    assert the_row(broken.audit(), "energy drift").passed is False
    if case is pendulum:
        result = CliRunner().invoke(app, ["audit", str(tmp_path / "run.nc")])
        assert result.exit_code == 0, result.output
        many = lt.ensemble(system, [x0, [1.0, 0.5]], (0.0, 15.0), 0.05)
        assert many.audit().passed, f"\n{many.audit()}"
        assert many.energy_drift[0] < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize(
    "entropy",
    [
        pytest.param(lambda m: jnp.log(m @ m), id="log"),
        pytest.param(lambda m: m @ m - 1.0, id="difference", marks=pytest.mark.slow),
        pytest.param(lambda m: jnp.tanh(m @ m), id="tanh", marks=pytest.mark.slow),
        pytest.param(lambda m: 0.5 * m @ m + 1e12, id="constant", marks=pytest.mark.slow),
    ],
)
def test_entropies_fall_by_the_rounding_of_what_they_are_computed_from(entropy):
    """Gauss keeps the law exactly; what is left is rounding, whatever the value of S is there."""
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 1 / 2, 1 / 3]), entropy, lt.ProjectedMetric(rate=0.3))
    x0s = np.random.default_rng(0).standard_normal((64, 3))
    x0s /= np.linalg.norm(x0s, axis=1)[:, None]
    many = lt.ensemble(system, x0s, (0.0, 60.0), 0.2, lt.MetriplecticGauss(1))
    assert many.audit().passed, f"\n{many.audit()}"
    fall = np.full(64, 1e-11) + 16 * np.spacing(many.entropy_scale)
    damaged = dataclasses.replace(many, least_entropy_increment=-fall)
    assert the_row(damaged.audit(), "relative fall").passed is False
    in_all = dataclasses.replace(many, entropy_change=-fall)
    assert the_row(in_all.audit(), "relative fall of the entropy in all").passed is False


def test_a_constant_does_not_hide_a_drift():
    """What can be seen beside a constant of 1e10 is seen: a drift of 1e-4, eight orders above what is promised."""
    moments = jnp.array([3.0, 2.0, 1.0])
    high = lt.LiePoissonSystem(
        mf.so(3), lambda m: 1e10 + 0.5 * jnp.sum(m * m / moments), lambda m: 0.5 * m @ m + 1e12, lt.ProjectedMetric()
    )
    kept = lt.integrate(high, [0.3, 1.0, 0.2], (0.0, 10.0), 0.1)
    assert kept.audit().passed, f"\n{kept.audit()}"
    drifting = dataclasses.replace(kept, energy=kept.energy + np.linspace(0.0, 1e-4, len(kept.t)))
    assert the_row(drifting.audit(), "energy drift").passed is False
    assert drifting.audit().energy_drift == pytest.approx(1e-14, rel=0.1)  # relative to the value, as it is defined
    falling = dataclasses.replace(kept, entropy=1e12 - 4e-4 * np.arange(len(kept.t)))  # each step as rounding might
    row = the_row(falling.audit(), "least entropy increment")
    assert (row.passed, "in all it falls by 0.04" in row.note) == (False, True)


def test_the_size_of_a_function():
    x = np.array([3.0, 4.0])
    norm = lt.Function(lambda x: jnp.log(x @ x) - jnp.log(25.0) + 1e10)
    assert norm.sensitivity(x) == pytest.approx(2.0)
    assert (-norm).sensitivity(x) == pytest.approx(2.0)
    assert (norm + lt.Quadratic([1.0, 1.0])).sensitivity(x) == pytest.approx(27.0)
    assert lt.Quadratic([1.0]).on([1]).sensitivity(x) == pytest.approx(16.0)


# -- how accurate the run is ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_steps_that_do_not_resolve_the_motion(tmp_path):
    """One step of 300 over the paper's figure keeps every law."""
    solution = lt.integrate(BODY, X0, (0.0, 300.0), 300.0)
    audit = solution.audit()
    assert the_row(audit, "accuracy").passed is False
    assert (audit.passed, audit.resolved) == (True, False)
    assert "try suggest_step" in the_row(audit, "accuracy").note
    assert "DO NOT RESOLVE" in str(audit).splitlines()[-1]
    assert [row.law for row in audit.rows if row.passed is False] == ["accuracy"]
    assert solution.audit(accuracy=np.inf).resolved
    result = CliRunner().invoke(app, ["audit", str(solution.save(tmp_path / "run.nc"))])
    assert (result.exit_code, "DO NOT RESOLVE" in result.output) == (0, True)
    assert lt.ensemble(BODY, [X0, X0], (0.0, 300.0), 300.0).audit().resolved is False


KEPLER = lt.Function(lambda x: 0.5 * (x[2] ** 2 + x[3] ** 2) - 1.0 / jnp.hypot(x[0], x[1]))
"""About a centre of mass one; a circle of radius one takes 2 pi."""


def from_afar(e):
    """The farthest point of an ellipse with a half axis of one."""
    return [-(1.0 + e), 0.0, 0.0, -np.sqrt((1.0 - e) / (1.0 + e))]


def on_the_ellipse(e, t):
    """The places at times after the farthest point, by Kepler's equation, shape (times, 2)."""
    mean = np.asarray(t) + np.pi
    u = np.array([scipy.optimize.brentq(lambda u, m=m: u - e * np.sin(u) - m, m - 1.0, m + 1.0) for m in mean])
    return np.stack([np.cos(u) - e, np.sqrt(1.0 - e * e) * np.sin(u)], axis=1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("method", "e", "number", "every", "resolved"),
    [
        (lt.MetriplecticGauss(2), 0.99, 101, 1, False),
        (lt.MetriplecticGauss(2), 0.99, 203, 1, False),
        (lt.MetriplecticGauss(2), 0.99, 203, 50, False),
        (lt.MetriplecticRungeKutta(6), 0.95, 203, 1, False),
        (lt.MetriplecticRungeKutta(6), 0.98, 901, 1, False),
        (lt.MetriplecticGauss(2), 0.9, 451, 1, True),
        (lt.MetriplecticGauss(2), 0.9, 451, 50, True),
        (lt.MetriplecticRungeKutta(6), 0.95, 901, 1, True),
        (lt.MetriplecticMidpoint(), 0.9, 451, 1, False),
    ],
)
def test_the_audit_finds_the_steps_past_the_centre(method, e, number, every, resolved):
    """Few steps of many pass the centre, and long ones jump over all of the passage, after which nothing is right."""
    system = lt.MetriplecticSystem(mf.Canonical(2), KEPLER)
    solution = lt.integrate(system, from_afar(e), (0.0, 2 * np.pi), 2 * np.pi / number, method, save_every=every)
    error = np.abs(solution.x[:, :2] - on_the_ellipse(e, solution.t)).max()
    audit = solution.audit()
    assert (error < 0.02) == resolved == audit.resolved, f"{error}\n{audit}"
    assert audit.passed
    assert solution.evidence.looked == solution.stats.steps
    assert audit.verdict.endswith("resolve the motion" if resolved else "THE STEPS DO NOT RESOLVE THE MOTION")
    assert solution.evidence.error_time == pytest.approx(np.pi, abs=0.2)


@pytest.mark.parametrize("every", [1, 6])
def test_the_audit_finds_a_step_through_a_barrier(every):
    """It is as thin as a twentieth of the step, and twice as high as would stop the particle."""
    barrier = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 + jnp.exp(-((x[0] / 0.01) ** 2)))
    solution = lt.integrate(barrier, [-1.05, 1.0], (0.0, 2.4), 0.4, lt.MetriplecticMidpoint(), save_every=every)
    assert solution.x[-1] == pytest.approx([1.35, 1.0])  # where it would be without a barrier
    assert solution.audit().resolved is False
    turned = lt.integrate(barrier, [-1.05, 1.0], (0.0, 2.4), 1e-3, lt.MetriplecticGauss(3), save_every=every)
    assert turned.x[-1] == pytest.approx([-1.36, -1.0], abs=0.02)
    assert turned.audit().resolved


@pytest.mark.parametrize("every", [1, 40])
def test_the_verdict_says_how_many_steps_were_looked_at(monkeypatch, every):
    """They are those where the motion is fastest."""
    monkeypatch.setattr(looking, "MAX_SAMPLED_VALUES", 3_000)
    system, orbit = lt.MetriplecticSystem(mf.Canonical(2), KEPLER), 2 * np.pi
    few = lt.integrate(
        system, from_afar(0.9), (0.0, 4 * orbit), orbit / 451, lt.MetriplecticMidpoint(), save_every=every
    )
    assert few.evidence.looked < few.stats.steps
    assert few.audit().resolved is False
    many = lt.integrate(system, from_afar(0.9), (0.0, orbit), orbit / 4001, lt.MetriplecticGauss(2), save_every=every)
    audit, looked = many.audit(), many.evidence.looked
    assert audit.resolved
    assert 8 <= looked < 4001
    assert audit.verdict == f"the laws hold, and the steps resolve the motion (checked {looked:,} of 4,001 steps)"
    assert abs(many.evidence.error_time - np.pi) < 0.3


def test_an_ensemble_is_followed_past_the_centre():
    """Its first steps are all it has kept, and they tell nothing."""
    system, x0s = lt.MetriplecticSystem(mf.Canonical(2), KEPLER), [from_afar(0.5), from_afar(0.9), from_afar(0.1)]
    found = {
        number: lt.ensemble(system, x0s, (0.0, 2 * np.pi), 2 * np.pi / number, lt.MetriplecticGauss(2))
        for number in (101, 901)
    }
    assert not found[101].ok[1] or found[101].audit().resolved is False
    assert found[101].evidence.error_time == pytest.approx(np.pi, abs=0.3)
    assert found[901].audit().resolved
    assert found[901].audit().coverage == ""
    alike = lt.ensemble(system, np.tile(x0s[0], (40, 1)), (0.0, 2 * np.pi), 2 * np.pi / 101, lt.MetriplecticGauss(2))
    assert alike.audit().verdict.endswith("(checked 3,232 of 4,040 steps)")


def test_the_estimate_is_of_the_order_of_the_method():
    found = [
        the_row(lt.integrate(BODY, [0.3, 1.0, -0.2], (0.0, 8.0), h).audit(), "accuracy").value for h in (0.8, 0.4, 0.2)
    ]
    assert np.abs(np.log2(np.divide(found[:-1], found[1:])) - 2.0).max() < 0.2  # a step is of its length to h^2
    assert the_row(lt.ensemble(BODY, [0.3, 1.0, -0.2], (0.0, 8.0), 0.2).audit(), "accuracy").passed


def test_long_steps_at_rest_are_no_fault():
    """A body that has relaxed is at rest, and adaptive steps are long there."""
    solution = lt.integrate(BODY, [0.1, 1.0, 0.1], (0.0, 300.0), lt.Adaptive(1e-6))
    assert np.diff(solution.t).max() > 3.0
    assert solution.audit().passed, f"\n{solution.audit()}"


def test_methods_without_an_estimate_say_so():
    row = the_row(lt.integrate(BODY, X0, (0.0, 5.0), 0.5, lt.Reference(rtol=1e-6)).audit(), "accuracy")
    assert (row.passed, row.tolerance, "not estimated" in row.note) == (None, None, True)


def test_a_copy_knows_the_evidence():
    solution = lt.integrate(BODY, X0, (0.0, 5.0), 0.1)
    assert str(pickle.loads(pickle.dumps(solution)).audit()) == str(solution.audit())


# -- whether it is a run of the system --------------------------------------------------------------------------------


def test_a_method_that_follows_another_field():
    """An entropy that is no Casimir, let through: Gauss holds it by force, and integrates something else."""
    system = lt.MetriplecticSystem(
        mf.LiePoisson(mf.so(3)),
        lt.Quadratic([1.0, 1 / 2, 1 / 3]),
        lambda m: jnp.exp(m[0]) + m[1],
        lt.ProjectedMetric(rate=0.1),
        validate=False,
    )
    solution = lt.integrate(system, [0.6, 0.5, -0.7], (0.0, 5.0), 0.02, lt.MetriplecticGauss(1))
    row = the_row(solution.audit(), "consistency")
    assert row.passed is False
    assert row.value > 0.05
    assert not solution.audit().passed
    assert "DO NOT FOLLOW THE VECTOR FIELD" in str(solution.audit()) or "A LAW FAILS" in str(solution.audit())


def test_a_run_that_stopped_is_no_law_that_fails():
    system = lt.models.rigid_body()
    x0, explicit = [0.1, 1.0, 0.3], lt.MetriplecticRungeKutta(8)
    solution = lt.integrate(system, x0, (0.0, 60.0), 15.0, explicit, on_failure="return")
    assert not solution.status.ok
    assert not solution.audit().passed
    assert solution.audit().verdict == "THE RUN STOPPED before its end; the laws hold until there"


class Late(lt.MetriplecticMidpoint):
    """Control: consistent, but of first order only."""

    def slopes(self, system, x, compensation, h, k):
        return system.vector_field(x + h * k[0])[None]


class Slow(lt.MetriplecticMidpoint):
    """Control: a thousandth too slow, which no law sees."""

    def slopes(self, system, x, compensation, h, k):
        return 0.999 * super().slopes(system, x, compensation, h, k)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "passed"), [(Late(), True), (Slow(), False)], ids=["late", "slow"])
def test_consistency_is_judged_by_short_steps(method, passed):
    solution = lt.integrate(BODY, [0.3, 1.0, -0.2], (0.0, 4.0), 0.4, method)
    row = the_row(solution.audit(), "consistency")
    assert row.passed is passed, row
    assert passed or row.value == pytest.approx(1e-3, rel=0.01)


class Cold(lt.MetriplecticMidpoint):
    """Control: a thousandth of the heat that friction makes in :func:`with_wheel` is missing."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k).at[:, 4].multiply(0.999)


def with_wheel(attitude):
    return lt.models.damper_wheel(inertia=(1.6, 2.0, 1.0), attitude=attitude)


@pytest.mark.parametrize("attitude", [True, False])
@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=["mid", "2", "4"]
)
def test_the_heat_of_a_wheel_at_rest_is_rounding(method, attitude):
    """The wheel turns by 1e-17 relative to the body, and makes a heat of 1e-34 from an entropy of zero."""
    solution = lt.integrate(with_wheel(attitude), [1e-17, 1.0, 2e-17, 0.05, 0.0], (0.0, 20.0), 0.1, method)
    assert abs(solution.entropy[-1]) < 1e-30
    assert solution.audit().passed, f"\n{solution.audit()}"
    assert attitude or solution.evidence.inconsistency is None  # nothing moves


@pytest.mark.parametrize("nutation", [1e-3, 1e-9])
@pytest.mark.parametrize(("method", "passed"), [(lt.MetriplecticMidpoint(), True), (Cold(), False)], ids=["", "cold"])
def test_heat_that_is_missing_in_a_body_almost_at_rest(method, passed, nutation):
    """Control of the test above: the heat, as small as the square of the nutation, is looked at while there is one."""
    x0 = [nutation, 1.0, 0.0, 0.05 + nutation, 0.0]
    solution = lt.integrate(with_wheel(True), x0, (0.0, 20.0), 0.1, method)
    row = the_row(solution.audit(), "consistency")
    assert row.passed is passed, row
    assert passed or row.value == pytest.approx(1e-3, rel=0.01)


def with_drag(name):
    """A system with drag that heats a bath, a state at rest, and its field without the bath in NumPy."""
    baths = lt.HeatBaths(2.0, 1.0)
    if name == "heavy top":
        inertia, rate, gravity = np.array([1.0, 1.2, 0.5]), 0.2, np.array([0.0, 0.0, 1.0])
        system = lt.LiePoissonSystem(
            mf.se(3),
            lambda mu: 0.5 * jnp.sum(mu[:3] ** 2 / inertia) + mu[5],
            dissipation=lt.Friction([rate] * 3 + [0.0] * 3),
            baths=baths,
        )

        def field(t, x):
            omega = x[:3] / inertia
            turned = np.cross(x[:3], omega) + np.cross(x[3:], gravity) - rate * omega
            return np.concatenate([turned, np.cross(x[3:], omega)])

        return system, [0.0, 0.0, 0.0, 0.6, 0.0, 0.8], field
    potential, force = {
        "spring": (lambda q: 0.5 * q**2, lambda q: -q),
        "pendulum": (lambda q: 1.0 - jnp.cos(q), lambda q: -np.sin(q)),
    }[name]
    system = lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x: potential(x[0]) + 0.5 * x[1] ** 2,
        dissipation=lt.Friction([0.0, 0.3]),
        baths=baths,
    )
    return system, [1.0, 0.0], lambda t, x: np.array([x[1], force(x[0]) - 0.3 * x[1]])


@pytest.mark.sampled(3)
@pytest.mark.parametrize("step", [0.05, lt.Adaptive(1e-8)], ids=["fixed", "adaptive"])
@pytest.mark.parametrize(
    "method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4), lt.MetriplecticTaylor(10)], ids=str
)
@pytest.mark.parametrize("name", ["spring", "pendulum", "heavy top"])
def test_drag_from_rest_is_the_motion(name, method, step):
    """The entropy of the bath begins as t^3, so that every step misses the same share of its mean rate."""
    system, x0, field = with_drag(name)
    solution = lt.integrate(system, x0, (0.0, 10.0), step, method)
    exact = scipy.integrate.solve_ivp(field, (0.0, 10.0), x0, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert np.abs(solution.x[-1, : len(x0)] - exact).max() < 1e-6
    audit = solution.audit()
    assert audit.verdict == "the laws hold, and the steps resolve the motion", str(audit)
    assert the_row(audit, "consistency").value < 1e-10


@pytest.mark.sampled(1)
@pytest.mark.parametrize("power", [1, 2, 4])
def test_a_force_that_grows_from_zero_is_the_motion(power):
    """From rest at the equilibrium, so that the velocity begins as t^(power + 1)."""
    system = lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x, t: 0.5 * x[0] ** 2 + 0.5 * x[1] ** 2 - x[0] * t**power,
        dissipation=lt.Friction([0.0, 0.3]),
        baths=lt.HeatBaths(2.0, 1.0),
    )
    audit = lt.integrate(system, [0.0, 0.0], (0.0, 5.0), 0.05, lt.MetriplecticRungeKutta(4)).audit()
    assert audit.passed, str(audit)


class Cool(lt.MetriplecticMidpoint):
    """Control: a thousandth of the heat of drag on a spring is missing."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k).at[:, 2].multiply(0.999)


def test_heat_that_is_missing_from_rest_on():
    system, x0, _ = with_drag("spring")
    row = the_row(lt.integrate(system, x0, (0.0, 10.0), 0.05, Cool()).audit(), "consistency")
    assert row.passed is False
    assert row.value == pytest.approx(1e-3, rel=0.01)


def test_members_of_an_ensemble_that_start_at_rest():
    """The audit of all, and that of one trajectory, which takes its steps again."""
    system, x0, _ = with_drag("spring")
    x0s = np.outer([1.0, 0.5, -2.0], x0)
    many = lt.ensemble(system, x0s, (0.0, 10.0), 0.05, lt.MetriplecticRungeKutta(4), outputs="trajectory")
    assert many.audit().verdict == "the laws hold, and the steps resolve the motion"
    alone = many[1].audit()
    assert alone.passed, str(alone)
    assert the_row(alone, "consistency").value < 1e-10


# -- what is conserved ------------------------------------------------------------------------------------------------


def test_what_the_method_does_not_promise():
    """A cubic momentum map: a constant of the system, and not of the method; and a function that is neither."""
    H = lt.Quadratic([1.0, 1.0, 0.5])
    system = lt.LiePoissonSystem(mf.so(3), H, momentum_maps={"cube": lambda m: m[2] ** 3 + jnp.sin(m[2])})
    assert system.check().passed
    solution = lt.integrate(system, [0.4, -0.8, 1.2], (0.0, 5.0), 0.1)
    (row,) = rows(solution.audit(), "drift of cube")
    assert (row.passed, row.tolerance, "does not conserve it exactly" in row.note) == (None, None, True)
    assert row.value < 1e-14
    relaxed = lt.integrate(BODY, X0, (0.0, 5.0), 0.1)
    (row,) = rows(relaxed.audit(), "change of mu1**2")
    assert row.note == "not a constant of this system"
    assert solution.laws.unpromised == ("cube",)


@pytest.mark.parametrize("rate", [1e-13, 1.0, 1e13])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_slow_friction_is_friction_still(rate, scale):
    """Which Casimirs a system conserves does not depend on its units."""
    quadratic = lt.Quadratic(np.ones(3))
    for dissipation in (lt.KillingDissipation(rate), lt.ProjectedMetric(rate=rate)):
        system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 5.0]) / scale), quadratic, dissipation)
        assert system.conserves((quadratic, system.energy)) == [False, True]
    free = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 5.0]) / scale))
    assert free.conserves((quadratic, lt.Quadratic(np.zeros(3), b=[0.0, 0.0, 1.0]))) == [True, False]


def test_large_states_of_a_slow_body():
    """At states of 1e12 the Casimir grows, and the audit does not ask that it stays."""
    system = lt.models.rigid_body((3e12, 2e12, 1e12), rate=1e-12)
    solution = lt.integrate(system, [1e10, 1e12, 3e11], (0.0, 20.0), 0.1)
    assert solution.entropy[-1] > solution.entropy[0]
    assert solution.audit().passed, f"\n{solution.audit()}"


# -- the keywords -----------------------------------------------------------------------------------------------------


def test_unknown_tolerances_are_named():
    solution, many = lt.integrate(BODY, X0, (0.0, 1.0), 0.1), lt.ensemble(BODY, X0, (0.0, 1.0), 0.1)
    for run in (solution, many):
        with pytest.raises(
            lt.InputError, match=r"'energy_drift'.*energy, entropy, casimirs, residual, attitude, accuracy"
        ):
            run.audit(energy_drift=1e-10)


# -- what has nothing to do -------------------------------------------------------------------------------------------

TURNED = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 2)) @ np.array([1.0, 1.0j]))[0]
LEVELS, PHASES = ((TURNED * values) @ TURNED.conj().T for values in ([0.0, 1.0, 2.5], [1.0, -1.0, 0.3]))
LOWERING = np.diag([1.0, 1.0], 1)


def quantum(H, V, rate, capacity):
    bath = lt.HeatBaths(capacity=capacity, temperature=0.7)
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, rate)]), bath)
    return q, q.samples(1, 3)[0] * np.append(np.ones(q.body_dim), 0.0)


def body(dissipation, energy=(1.0, 1 / 2, 1 / 3), capacity=2.0):
    baths = None if capacity is None else lt.HeatBaths(capacity=capacity)
    entropy = lt.Quadratic(np.ones(3)) if capacity is None else None
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(energy), entropy, dissipation, baths=baths)
    return system, system.state(np.append([0.4, 0.5, 0.8], [0.0] * (system.dim - 3)))


IDLE = {
    "jumps at rate zero": lambda: quantum(LEVELS, LOWERING, 0.0, 0.8),
    "jumps without a Hamiltonian": lambda: quantum(0.0 * LEVELS, LOWERING, 0.5, np.inf),
    "jumps of equal levels": lambda: quantum(np.eye(3), LOWERING, 0.5, np.inf),
    "jumps that exchange no heat": lambda: quantum(LEVELS, PHASES, 0.4, 0.8),
    "the identity as a jump": lambda: quantum(LEVELS, np.eye(3), 0.4, np.inf),
    "a bracket at rate zero": lambda: body(lt.DoubleBracket(0.0)),
    "a bracket without an energy": lambda: body(lt.DoubleBracket(0.3), np.zeros(3), np.inf),
    "friction at rate zero": lambda: body(lt.Friction(rate=0.0), capacity=np.inf),
    "Killing at rate zero": lambda: body(lt.KillingDissipation(0.0), capacity=None),
    "a projected metric at rate zero": lambda: body(lt.ProjectedMetric(rate=0.0), capacity=None),
    "four-bracket without an energy": lambda: body(
        lt.FourBracket.kulkarni_nomizu(np.eye(3), np.eye(3)), np.zeros(3), None
    ),
}


@pytest.mark.sampled(
    "jumps without a Hamiltonian-Gauss", "jumps that exchange no heat-Gauss", "a bracket at rate zero-explicit"
)
@pytest.mark.parametrize("by", ["Gauss", "explicit"])
@pytest.mark.parametrize("name", IDLE)
def test_what_rounding_makes_of_nothing_is_no_motion(name, by):
    """Baths that take no heat, and energies that are zero, are moved by rounding alone."""
    methods = {"Gauss": lt.MetriplecticGauss(2), "explicit": lt.MetriplecticRungeKutta(4)}
    system, x0 = IDLE[name]()
    audit = lt.integrate(system, x0, (0.0, 2.0), 0.05, methods[by]).audit()
    assert audit.passed, str(audit)
