"""Audit: rounding scales, accuracy of a run, consistency with the system, with controls that must fail."""

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
from liethermo.results import step_sampling
from liethermo.systems.invariants import are_conserved
from tests.cases import only_row, rows
from tests.systems import rigid_body

X0 = [0.001, 1.0, 0.001]


# -- what starts at zero ----------------------------------------------------------------------------------------------


def heavy_top():
    """Return a heavy top whose Casimir Pi . Gamma of se(3)* is zero."""
    energy = lt.Quadratic(np.diag([1.0, 1.0, 0.5, 0.0, 0.0, 0.0]), b=[0.0, 0.0, 0.0, 0.3, 0.0, 1.0])
    return lt.LiePoissonSystem(mf.se(3), energy), [0.3, -0.4, 1.1, 0.8, 0.6, 0.0]


def three_particles():
    """Return three particles in a row joined by springs, whose momentum is zero."""
    q, p = np.eye(6)[:3], np.eye(6)[3:]
    springs = sum(np.outer(q[i] - q[j], q[i] - q[j]) for i, j in ((0, 1), (1, 2)))
    momentum = lt.Quadratic(np.zeros((6, 6)), b=p.sum(axis=0))
    system = lt.MetriplecticSystem(
        mf.Canonical(3), lt.Quadratic(springs + p.T @ p), momentum_maps={"momentum": momentum}
    )
    return system, [0.1, 1.3, 2.2, 0.1, 0.2, -0.3]


def pendulum():
    """Return a pendulum that starts at 90 degrees, where its energy is zero."""
    return lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 - jnp.cos(x[0])), [np.pi / 2, 0.0]


def separatrix():
    """Return a motion towards an unstable equilibrium, at its energy, which is zero."""
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
    loaded_solution = lt.load(solution.save(tmp_path / "run.nc"))
    assert str(loaded_solution.audit()) == str(solution.audit())
    drifting_solution = dataclasses.replace(solution, energy=solution.energy + np.linspace(0.0, 1e-11, len(solution.t)))
    assert only_row(drifting_solution.audit(), "energy drift").passed is False
    if case is pendulum:
        result = CliRunner().invoke(app, ["audit", str(tmp_path / "run.nc")])
        assert result.exit_code == 0, result.output
        ensemble = lt.ensemble(system, [x0, [1.0, 0.5]], (0.0, 15.0), 0.05)
        assert ensemble.audit().passed, f"\n{ensemble.audit()}"
        assert ensemble.energy_drift[0] < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize(
    "entropy",
    [
        pytest.param(lambda m: jnp.log(m @ m), id="log"),
        pytest.param(lambda m: m @ m - 1.0, id="difference"),
        pytest.param(lambda m: jnp.tanh(m @ m), id="tanh"),
        pytest.param(lambda m: 0.5 * m @ m + 1e12, id="constant"),
    ],
)
def test_entropies_fall_by_the_rounding_of_what_they_are_computed_from(entropy):
    """Gauss methods keep the entropy law exactly; only rounding is left, whatever the value of S."""
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 1 / 2, 1 / 3]), entropy, lt.ProjectedMetric(rate=0.3))
    x0s = np.random.default_rng(0).standard_normal((64, 3))
    x0s /= np.linalg.norm(x0s, axis=1)[:, None]
    ensemble = lt.ensemble(system, x0s, (0.0, 60.0), 0.2, lt.MetriplecticGauss(1))
    assert ensemble.audit().passed, f"\n{ensemble.audit()}"
    fall = np.full(64, 1e-11) + 16 * np.spacing(ensemble.entropy_scale)
    step_damage = dataclasses.replace(ensemble, least_entropy_increment=-fall)
    assert only_row(step_damage.audit(), "least entropy increment").passed is False
    total_damage = dataclasses.replace(ensemble, entropy_change=-fall)
    assert only_row(total_damage.audit(), "least entropy increment").passed is False


def test_the_worst_trajectory_of_a_row_is_one_that_has_run():
    """A trajectory that could not start obeys every law by doing nothing; it hid the others in each row."""
    body, x0s = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), np.random.default_rng(0).standard_normal((4, 3))
    x0s[0] = np.nan
    ensemble = lt.ensemble(body, x0s, (0.0, 3.0), 0.1)
    rows = [only_row(ensemble.audit(), law) for law in ("energy drift", "least entropy increment", "stage residual")]
    worst = [int(row.note.removeprefix("worst is trajectory ")) for row in rows]
    assert min(worst) > 0
    assert all(row.tolerance != 0.0 for row in rows)
    assert rows[1].value == ensemble.least_entropy_increment[worst[1]]


def test_an_ensemble_of_one_has_the_laws_of_a_single_run():
    body, x0 = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), [0.1, 0.2, 1.0]
    single = lt.integrate(body, x0, (0.0, 3.0), 0.1).audit()
    many = lt.ensemble(body, [x0], (0.0, 3.0), 0.1, outputs="trajectory").audit()
    for law in ("energy drift", "least entropy increment", "stage residual"):
        row, other = only_row(single, law), only_row(many, law)
        assert (row.value, row.passed) == (other.value, other.passed), law
        assert row.tolerance == pytest.approx(other.tolerance, rel=1e-12), law


def test_a_constant_does_not_hide_a_drift():
    """A drift of 1e-4 is seen beside a constant of 1e10, eight orders above what is promised."""
    moments = jnp.array([3.0, 2.0, 1.0])
    offset_system = lt.LiePoissonSystem(
        mf.so(3), lambda m: 1e10 + 0.5 * jnp.sum(m * m / moments), lambda m: 0.5 * m @ m + 1e12, lt.ProjectedMetric()
    )
    solution = lt.integrate(offset_system, [0.3, 1.0, 0.2], (0.0, 10.0), 0.1)
    assert solution.audit().passed, f"\n{solution.audit()}"
    drifting_solution = dataclasses.replace(solution, energy=solution.energy + np.linspace(0.0, 1e-4, len(solution.t)))
    assert only_row(drifting_solution.audit(), "energy drift").passed is False
    assert drifting_solution.audit().energy_drift == pytest.approx(
        1e-14, rel=0.1
    )  # relative to the value by definition
    drift_between_saves = dataclasses.replace(
        solution.stats, energy_range=(solution.energy[0], solution.energy[0] + 1e-4)
    )
    unsaved_drift = dataclasses.replace(solution, stats=drift_between_saves)
    assert only_row(unsaved_drift.audit(), "energy drift").passed is False
    falling_entropy = dataclasses.replace(
        solution, entropy=1e12 - 4e-4 * np.arange(len(solution.t))
    )  # each decrease is as small as rounding
    row = only_row(falling_entropy.audit(), "least entropy increment")
    assert (row.passed, "in all it falls by 0.04" in row.note) == (False, True)


@pytest.mark.parametrize(
    ("residual", "relative_fall", "passed"),
    [(0.0, 1e-13, False), (2e-13, 1e-13, True), (2e-13, 1e-12, False), (1e-3, 1e-13, True), (1e-3, 1e-11, False)],
)
def test_the_entropy_may_fall_by_the_residual_of_a_step(residual, relative_fall, passed):
    """A residual above its own tolerance excuses no more than one at the tolerance."""
    solution = lt.integrate(rigid_body(), [0.1, 0.2, 1.0], (0.0, 1.0), 0.1)
    fall = relative_fall * solution.evidence.entropy
    stats = dataclasses.replace(solution.stats, worst_residual=residual, least_entropy_increment=-fall)
    audit = dataclasses.replace(solution, stats=stats).audit()
    assert only_row(audit, "least entropy increment").passed is passed
    assert only_row(audit, "stage residual").passed is (residual <= 1e-12)


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
    """One step of 300, as long as the figure of the paper, keeps every law."""
    solution = lt.integrate(rigid_body(), X0, (0.0, 300.0), 300.0)
    audit = solution.audit()
    assert only_row(audit, "accuracy").passed is False
    assert (audit.passed, audit.resolved) == (True, False)
    assert "Try suggest_step" in only_row(audit, "accuracy").note
    assert "DO NOT RESOLVE" in str(audit).splitlines()[-1]
    assert [row.law for row in audit.rows if row.passed is False] == ["accuracy"]
    assert solution.audit(accuracy=np.inf).resolved
    result = CliRunner().invoke(app, ["audit", str(solution.save(tmp_path / "run.nc"))])
    assert (result.exit_code, "DO NOT RESOLVE" in result.output) == (0, True)
    assert lt.ensemble(rigid_body(), [X0, X0], (0.0, 300.0), 300.0).audit().resolved is False


KEPLER = lt.Function(lambda x: 0.5 * (x[2] ** 2 + x[3] ** 2) - 1.0 / jnp.hypot(x[0], x[1]))
"""Energy of a Kepler orbit about a centre of mass one; a circle of radius one takes 2 pi."""


def apocentre(e):
    """Return the state at the farthest point of an ellipse of eccentricity e with a semi-major axis of one."""
    return [-(1.0 + e), 0.0, 0.0, -np.sqrt((1.0 - e) / (1.0 + e))]


def kepler_positions(e, t):
    """Return the positions at times t after the farthest point by Kepler's equation, shape (times, 2)."""
    mean_anomaly = np.asarray(t) + np.pi
    u = np.array([scipy.optimize.brentq(lambda u, m=m: u - e * np.sin(u) - m, m - 1.0, m + 1.0) for m in mean_anomaly])
    return np.stack([np.cos(u) - e, np.sqrt(1.0 - e * e) * np.sin(u)], axis=1)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "e", "n_steps", "save_every", "is_resolved"),
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
def test_the_audit_finds_the_steps_past_the_centre(method, e, n_steps, save_every, is_resolved):
    """Few of the steps pass the centre, and long ones jump over the passage, after which the orbit is wrong."""
    system = lt.MetriplecticSystem(mf.Canonical(2), KEPLER)
    solution = lt.integrate(system, apocentre(e), (0.0, 2 * np.pi), 2 * np.pi / n_steps, method, save_every=save_every)
    error = np.abs(solution.x[:, :2] - kepler_positions(e, solution.t)).max()
    audit = solution.audit()
    assert (error < 0.02) == is_resolved == audit.resolved, f"{error}\n{audit}"
    assert audit.passed
    assert solution.evidence.looked == solution.stats.steps
    assert audit.verdict.endswith("resolve the motion" if is_resolved else "THE STEPS DO NOT RESOLVE THE MOTION")
    assert solution.evidence.error_time == pytest.approx(np.pi, abs=0.2)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("save_every", [1, 6])
def test_the_audit_finds_a_step_through_a_barrier(save_every):
    """The barrier is a twentieth of a step wide, and twice as high as would stop the particle."""
    barrier = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 + jnp.exp(-((x[0] / 0.01) ** 2)))
    solution = lt.integrate(barrier, [-1.05, 1.0], (0.0, 2.4), 0.4, lt.MetriplecticMidpoint(), save_every=save_every)
    assert solution.x[-1] == pytest.approx([1.35, 1.0])  # its position without a barrier
    assert solution.audit().resolved is False
    fine_solution = lt.integrate(
        barrier, [-1.05, 1.0], (0.0, 2.4), 1e-3, lt.MetriplecticGauss(3), save_every=save_every
    )
    assert fine_solution.x[-1] == pytest.approx([-1.36, -1.0], abs=0.02)
    assert fine_solution.audit().resolved


@pytest.mark.sampled(1)
@pytest.mark.parametrize("save_every", [1, 40])
def test_the_verdict_says_how_many_steps_were_looked_at(monkeypatch, save_every):
    """The verdict tells the number of checked steps, which are those where the motion is fastest."""
    monkeypatch.setattr(step_sampling, "MAX_SAMPLED_VALUES", 3_000)
    system, orbit = lt.MetriplecticSystem(mf.Canonical(2), KEPLER), 2 * np.pi
    coarse_run = lt.integrate(
        system, apocentre(0.9), (0.0, 4 * orbit), orbit / 451, lt.MetriplecticMidpoint(), save_every=save_every
    )
    assert coarse_run.evidence.looked < coarse_run.stats.steps
    assert coarse_run.audit().resolved is False
    fine_run = lt.integrate(
        system, apocentre(0.9), (0.0, orbit), orbit / 4001, lt.MetriplecticGauss(2), save_every=save_every
    )
    audit, n_checked = fine_run.audit(), fine_run.evidence.looked
    assert audit.resolved
    assert 8 <= n_checked < 4001
    assert audit.verdict == f"the laws hold, and the steps resolve the motion (checked {n_checked:,} of 4,001 steps)"
    assert abs(fine_run.evidence.error_time - np.pi) < 0.3


def test_an_ensemble_is_followed_past_the_centre():
    """An ensemble of final states is replayed beyond its first steps, which tell nothing."""
    system, x0s = lt.MetriplecticSystem(mf.Canonical(2), KEPLER), [apocentre(0.5), apocentre(0.9), apocentre(0.1)]
    ensembles = {
        n_steps: lt.ensemble(system, x0s, (0.0, 2 * np.pi), 2 * np.pi / n_steps, lt.MetriplecticGauss(2))
        for n_steps in (101, 901)
    }
    assert not ensembles[101].ok[1] or ensembles[101].audit().resolved is False
    assert ensembles[101].evidence.error_time == pytest.approx(np.pi, abs=0.3)
    assert ensembles[901].audit().resolved
    assert ensembles[901].audit().coverage == ""
    equal_members = lt.ensemble(
        system, np.tile(x0s[0], (40, 1)), (0.0, 2 * np.pi), 2 * np.pi / 101, lt.MetriplecticGauss(2)
    )
    assert equal_members.audit().verdict.endswith("(checked 3,232 of 4,040 steps)")


def test_the_estimate_is_of_the_order_of_the_method():
    errors = [
        only_row(lt.integrate(rigid_body(), [0.3, 1.0, -0.2], (0.0, 8.0), h).audit(), "accuracy").value
        for h in (0.8, 0.4, 0.2)
    ]
    assert (
        np.abs(np.log2(np.divide(errors[:-1], errors[1:])) - 2.0).max() < 0.2
    )  # relative to the length of a step the error is of order h^2
    assert only_row(lt.ensemble(rigid_body(), [0.3, 1.0, -0.2], (0.0, 8.0), 0.2).audit(), "accuracy").passed


def test_long_steps_at_rest_are_no_fault():
    """Adaptive steps are long when a body has relaxed, and the audit accepts them."""
    solution = lt.integrate(rigid_body(), [0.1, 1.0, 0.1], (0.0, 300.0), lt.Adaptive(1e-6))
    assert np.diff(solution.t).max() > 3.0
    assert solution.audit().passed, f"\n{solution.audit()}"


def test_methods_without_an_estimate_say_so():
    row = only_row(lt.integrate(rigid_body(), X0, (0.0, 5.0), 0.5, lt.Reference(rtol=1e-6)).audit(), "accuracy")
    assert (row.passed, row.tolerance, "not estimated" in row.note) == (None, None, True)


def test_a_copy_knows_the_evidence():
    solution = lt.integrate(rigid_body(), X0, (0.0, 5.0), 0.1)
    assert str(pickle.loads(pickle.dumps(solution)).audit()) == str(solution.audit())


# -- whether it is a run of the system --------------------------------------------------------------------------------


def test_a_method_that_follows_another_field():
    """A method that holds an entropy that is no Casimir integrates another field, and the audit says so."""
    system = lt.MetriplecticSystem(
        mf.LiePoisson(mf.so(3)),
        lt.Quadratic([1.0, 1 / 2, 1 / 3]),
        lambda m: jnp.exp(m[0]) + m[1],
        lt.ProjectedMetric(rate=0.1),
        validate=False,
    )
    solution = lt.integrate(system, [0.6, 0.5, -0.7], (0.0, 5.0), 0.02, lt.MetriplecticGauss(1))
    row = only_row(solution.audit(), "consistency")
    assert row.passed is False
    assert row.value > 0.05
    assert not solution.audit().passed
    assert "DO NOT FOLLOW THE VECTOR FIELD" in str(solution.audit()) or "A LAW FAILS" in str(solution.audit())


def test_a_run_that_stopped_is_no_law_that_fails():
    system = lt.models.rigid_body()
    x0, method = [0.1, 1.0, 0.3], lt.MetriplecticRungeKutta(8)
    solution = lt.integrate(system, x0, (0.0, 60.0), 15.0, method, on_failure="return")
    assert not solution.status.ok
    assert not solution.audit().passed
    assert solution.audit().verdict == "THE RUN STOPPED before its end; the laws hold until there"


class FirstOrderMidpoint(lt.MetriplecticMidpoint):
    """Control: consistent, but only of first order."""

    def slopes(self, system, x, compensation, h, k):
        return system.vector_field(x + h * k[0])[None]


class SlowedMidpoint(lt.MetriplecticMidpoint):
    """Control: slower than the motion by a thousandth, which no law shows."""

    def slopes(self, system, x, compensation, h, k):
        return 0.999 * super().slopes(system, x, compensation, h, k)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "is_consistent"), [(FirstOrderMidpoint(), True), (SlowedMidpoint(), False)], ids=["late", "slow"]
)
def test_consistency_is_judged_by_short_steps(method, is_consistent):
    solution = lt.integrate(rigid_body(), [0.3, 1.0, -0.2], (0.0, 4.0), 0.4, method)
    row = only_row(solution.audit(), "consistency")
    assert row.passed is is_consistent, row
    assert is_consistent or row.value == pytest.approx(1e-3, rel=0.01)


@pytest.mark.sampled("array-slow", "compiled-right")
@pytest.mark.parametrize(
    ("method", "is_consistent"),
    [(lt.MetriplecticMidpoint(), True), (SlowedMidpoint(), False)],
    ids=["right", "slow"],
)
@pytest.mark.parametrize(
    ("engine", "step"),
    [("array", 0.1), ("compiled", 0.1), ("compiled", lt.Adaptive(1e-6))],
    ids=["array", "compiled", "adaptive"],
)
def test_an_ensemble_is_as_consistent_as_its_trajectories(engine, method, is_consistent, step):
    """The slow method keeps energy and Casimirs, so an ensemble with it shows nothing else."""
    x0s = [[0.3, 1.0, -0.2], [0.5, -0.2, 0.9], [0.0, 0.0, 0.0]]
    many = lt.ensemble(rigid_body(), x0s, (0.0, 4.0), step, method, engine=engine)
    single = lt.integrate(rigid_body(), x0s[0], (0.0, 4.0), step, method, engine=engine)
    rows = [only_row(result.audit(), "consistency") for result in (many, single)]
    assert [row.passed for row in rows] == [is_consistent] * 2, rows
    assert [row.note for row in rows] == [rows[1].note] * 2
    if not is_consistent:
        assert [row.value for row in rows] == pytest.approx([1e-3] * 2, rel=0.01)
        assert many.audit().verdict == "the laws hold, but THE STEPS DO NOT FOLLOW THE VECTOR FIELD"
        assert not many.audit().passed


class SlowedWithWeakFriction(lt.MetriplecticMidpoint):
    """Control: a method that is slow for systems whose friction is weaker than 0.05, and right for others."""

    def slopes(self, system, x, compensation, h, k):
        factor = jnp.where(system.dissipation.rate < 0.05, 0.999, 1.0)
        return factor * super().slopes(system, x, compensation, h, k)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-6)], ids=["fixed", "adaptive"])
@pytest.mark.parametrize("weakest_rate", [0.06, 0.04])
def test_one_system_of_an_ensemble_that_the_method_does_not_follow(weakest_rate, step):
    """Steps of every trajectory are compared with its own vector field."""
    rates = np.linspace(0.1, 0.3, 20)
    rates[7] = weakest_rate
    body, x0 = lt.models.rigid_body(rate=0.2), [0.3, 1.0, -0.2]
    many = lt.ensemble(body, x0, (0.0, 4.0), step, SlowedWithWeakFriction(), parameters={"dissipation.rate": rates})
    row = only_row(many.audit(), "consistency")
    assert row.passed is (weakest_rate > 0.05), row
    assert row.value == pytest.approx(0.0 if row.passed else 1e-3, rel=0.01, abs=1e-8)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("outputs", ["trajectory", "final", "summary"])
def test_an_ensemble_reports_an_entropy_that_should_be_constant(outputs):
    """The midpoint scheme keeps quadratic Casimirs only; one run and an ensemble both say that the entropy changes."""
    system = lt.QuantumSystem(np.array([[0.0, 0.4, 0.2j], [0.4, 1.0, 0.7], [-0.2j, 0.7, 2.5]]))
    x0s = np.stack([system.state(np.diag(p)) for p in ([0.6, 0.3, 0.1], [0.2, 0.5, 0.3])])
    for method, passes in ((lt.MetriplecticGauss(2), True), (lt.MetriplecticMidpoint(), False)):
        single = lt.integrate(system, x0s[0], (0.0, 5.0), 0.25, method).audit()
        many = lt.ensemble(system, x0s, (0.0, 5.0), 0.25, method, outputs=outputs).audit()
        assert only_row(single, "entropy drift").passed is only_row(many, "entropy drift").passed is passes


class WrongClaim(lt.OneStepMethod):
    """Slopes at the middle of a step along a straight line, which keep no Casimir, whatever the class claims."""

    stages = 1
    order = 2
    preserves = frozenset({"energy", "casimirs"})

    def slopes(self, system, x, compensation, h, k):
        return system.vector_field(x + 0.5 * h * system.vector_field(x))[None]

    def increment(self, h, k):
        return h * k[0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("outputs", ["trajectory", "final"])
@pytest.mark.parametrize(("method", "passes"), [(lt.MetriplecticMidpoint(), True), (WrongClaim(), False)])
def test_an_ensemble_reports_the_drift_of_functions_that_should_be_constant(outputs, method, passes):
    """The row of an ensemble has the largest drift of its trajectories."""
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 2.0, 5.0]))
    x0s = np.array([[0.4, -0.8, 1.2], [0.9, 0.1, -0.5], [0.0, 0.7, 0.2]])
    many = lt.ensemble(system, x0s, (0.0, 5.0), 0.25, method, outputs=outputs)
    (row,) = rows(many.audit(), "drift of mu1**2 + mu2**2 + mu3**2")
    member_drifts = [rows(run.audit(), row.law)[0].value for run in many]
    assert row.passed is passes
    assert many.audit().casimir_drift == row.value == pytest.approx(max(member_drifts), abs=1e-15)


# -- what is conserved ------------------------------------------------------------------------------------------------


def test_what_the_method_does_not_promise():
    """The audit shows a cubic momentum map, which the method does not promise to keep, and a function that changes."""
    H = lt.Quadratic([1.0, 1.0, 0.5])
    system = lt.LiePoissonSystem(mf.so(3), H, momentum_maps={"cube": lambda m: m[2] ** 3 + jnp.sin(m[2])})
    assert system.check().passed
    solution = lt.integrate(system, [0.4, -0.8, 1.2], (0.0, 5.0), 0.1)
    (row,) = rows(solution.audit(), "drift of cube")
    assert (row.passed, row.tolerance, "does not conserve it exactly" in row.note) == (None, None, True)
    assert row.value < 1e-14
    body_run = lt.integrate(rigid_body(), X0, (0.0, 5.0), 0.1)
    (row,) = rows(body_run.audit(), "change of mu1**2")
    assert row.note == "not a constant of this system"
    assert solution.laws.unpromised == ("cube",)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("rate", [1e-13, 1.0, 1e13])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_slow_friction_is_friction_still(rate, scale):
    """The set of Casimirs that a system conserves does not depend on its units."""
    quadratic = lt.Quadratic(np.ones(3))
    for dissipation in (lt.KillingDissipation(rate), lt.ProjectedMetric(rate=rate)):
        system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 5.0]) / scale), quadratic, dissipation)
        assert are_conserved(system, (quadratic, system.energy)) == [False, True]
    free_system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 5.0]) / scale))
    assert are_conserved(free_system, (quadratic, lt.Quadratic(np.zeros(3), b=[0.0, 0.0, 1.0]))) == [True, False]


def test_large_states_of_a_slow_body():
    """The Casimir of states of 1e12 grows by friction, and the audit does not require that it is constant."""
    system = lt.models.rigid_body((3e12, 2e12, 1e12), rate=1e-12)
    solution = lt.integrate(system, [1e10, 1e12, 3e11], (0.0, 20.0), 0.1)
    assert solution.entropy[-1] > solution.entropy[0]
    assert solution.audit().passed, f"\n{solution.audit()}"


# -- the keywords -----------------------------------------------------------------------------------------------------


def test_unknown_tolerances_are_named():
    solution, ensemble = lt.integrate(rigid_body(), X0, (0.0, 1.0), 0.1), lt.ensemble(rigid_body(), X0, (0.0, 1.0), 0.1)
    for run in (solution, ensemble):
        with pytest.raises(
            lt.InputError, match=r"'energy_drift'.*energy, entropy, casimirs, residual, attitude, accuracy"
        ):
            run.audit(energy_drift=1e-10)


# -- what has nothing to do -------------------------------------------------------------------------------------------

UNITARY = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 2)) @ np.array([1.0, 1.0j]))[0]
LEVELS = (UNITARY * [0.0, 1.0, 2.5]) @ UNITARY.conj().T
PHASES = (UNITARY * [1.0, -1.0, 0.3]) @ UNITARY.conj().T
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


IDLE_SYSTEMS = {
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
"""Systems whose dissipation does nothing, with initial states."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method_name", ["Gauss", "explicit"])
@pytest.mark.parametrize("name", IDLE_SYSTEMS)
def test_what_rounding_makes_of_nothing_is_no_motion(name, method_name):
    """Baths that receive no heat, and energies that are zero, change by rounding alone, and the audit passes."""
    methods = {"Gauss": lt.MetriplecticGauss(2), "explicit": lt.MetriplecticRungeKutta(4)}
    system, x0 = IDLE_SYSTEMS[name]()
    audit = lt.integrate(system, x0, (0.0, 2.0), 0.05, methods[method_name]).audit()
    assert audit.passed, str(audit)
