"""The constants of a member of a family depend on that member alone, whatever the others and their order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.engines.status_codes import StatusCode
from liethermo.runs import member_groups
from liethermo.runs.system_family import Family
from liethermo.systems.invariants import find_invariants

START = np.array([0.4, 0.5, -0.3])
SPAN = (0.0, 2.0)
STEP = 0.1
ORDERS = ([0, 1, 2], [2, 0, 1], [1, 2, 0])
METHODS = [
    lt.MetriplecticMidpoint(),
    lt.MetriplecticGauss(2),
    lt.MetriplecticRungeKutta(4),
    lt.MetriplecticTaylor(6),
]


def body(p):
    """Isotropic for a = 1, where the energy is a function of the Casimir and friction conserves both."""
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda m: 0.5 * (m[0] ** 2 + m[1] ** 2 + p["a"] * m[2] ** 2),
        lambda m: jnp.log(1 + m @ m),
        lt.KillingDissipation(0.3),
    )


A = np.array([1.0, 0.5, 2.0])


def field(a):
    """``mu' = mu x xi + F``, ``F = 0.6 xi x (dS x xi)``, in NumPy: minus the Killing form of so(3) is 2."""

    def rate(t, mu):
        xi, dS = np.array([1.0, 1.0, a]) * mu, 2.0 * mu / (1.0 + mu @ mu)
        return np.cross(mu, xi) + 0.3 * 2.0 * np.cross(xi, np.cross(dS, xi))

    return rate


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_members_are_as_if_alone(method):
    single_runs = np.array([lt.integrate(body({"a": a}), START, SPAN, STEP, method).x[-1] for a in A])
    exact = [solve_ivp(field(a), SPAN, START, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1] for a in A]
    assert np.abs(single_runs - exact).max() < (2e-3 if method.order == 2 else 2e-5)
    for order in ORDERS:
        ensemble = lt.ensemble(body, START, SPAN, STEP, method, parameters={"a": A[order]})
        assert np.array_equal(ensemble.status, np.zeros(3))
        assert np.abs(ensemble.x - single_runs[order]).max() < 1e-14, order
        assert ensemble.audit().passed, str(ensemble.audit())
        assert ensemble.laws.energy == "conserved"
    assert ensemble[0].audit().passed


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticRungeKutta(6)], ids=str)
def test_adaptive_steps_and_saved_times(method):
    options = {"parameters": {"a": A}, "save_at": [0.5, 2.0]}
    ensemble = lt.ensemble(body, START, SPAN, lt.Adaptive(1e-6), method, **options)
    for i, a in enumerate(A):
        one = lt.integrate(body({"a": a}), START, SPAN, lt.Adaptive(1e-6), method, save_at=[0.5, 2.0])
        assert np.abs(ensemble.x[i] - one.x).max() < 1e-12


@pytest.mark.slow
def test_named_parameters():
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(np.eye(3)), lambda m: jnp.log(1 + m @ m), lt.KillingDissipation(0.3)
    )
    quadratics = np.stack([np.diag([1.0, 1.0, a]) for a in A])
    ensemble = lt.ensemble(system, START, SPAN, STEP, parameters={"energy.A": quadratics})
    single_runs = lt.ensemble(body, START, SPAN, STEP, parameters={"a": A})
    assert np.abs(ensemble.x - single_runs.x).max() < 1e-14


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS[2:], ids=str)
def test_an_isotropic_body_does_not_stop_the_others(method):
    """The steps of the others cannot end on its levels: they were not converged."""
    inertia = np.array([[1.0, 1.0, 1.0], [3.0, 2.0, 1.0], [1.0, 2.0, 3.0]])
    ensemble = lt.ensemble(lambda p: lt.models.rigid_body(p["I"]), START, SPAN, STEP, method, parameters={"I": inertia})
    assert ensemble.ok.all(), str(ensemble)
    assert ensemble.audit().passed


@pytest.mark.slow
def test_a_point_of_a_study():
    axes = {"a": [1.0, 0.5, 2.0]}
    study = lt.Study(body, axes, x0=START, t_span=SPAN, step=STEP, measure={"x": "final"})
    study.run(progress=False)
    single_runs = np.array([lt.integrate(body({"a": a}), START, SPAN, STEP).x[-1] for a in A])
    assert np.abs(study.results.x.values - single_runs).max() < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS[1:3], ids=str)
def test_a_flow_under_vmap(method):
    def end(a):
        return lt.flow(body({"a": a}), jnp.asarray(START), SPAN, STEP, method)

    single_flows = np.array([end(a) for a in A])
    assert np.abs(jax.vmap(end)(jnp.asarray(A)) - single_flows).max() < 1e-12
    assert np.abs(jax.jit(jax.vmap(end))(jnp.asarray(A)) - single_flows).max() < 1e-12


@pytest.mark.slow
def test_a_control_one_verdict_for_all_is_found(monkeypatch):
    """Control: with what the first member conserves held for all, the relation of company fails."""

    def group_like_first_member(family, method, states):
        first_verdicts = find_invariants(family.member(0))
        facts = member_groups.InvariantFacts(None, first_verdicts)
        return [
            member_groups.MemberGroup(
                np.arange(len(states)), family.annotate_members(member_groups.attach_invariant_facts, facts)
            )
        ], {}

    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), lambda m: jnp.log(1 + m @ m), lt.KillingDissipation(0.3)
    )
    assert lt.testing.check_relations(system, lt.MetriplecticGauss(1), START, 0.1, relations=["company"]).passed
    monkeypatch.setattr("liethermo.runs.ensemble.group_members_by_invariants", group_like_first_member)
    with pytest.raises(lt.testing.PropertyError, match="company"):
        lt.testing.check_relations(system, lt.MetriplecticGauss(1), START, 0.1, relations=["company"])


# -- what a method is asked to preserve -------------------------------------------------------------------------------


def asymmetric_body(p):
    """Conserves ``m[2]`` where the energy is symmetric about the axis 3."""
    return lt.LiePoissonSystem(mf.so(3), lambda m: 0.5 * (m[0] ** 2 + p["b"] * m[1] ** 2) + m[2] ** 2)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss, lt.MetriplecticRungeKutta])
def test_what_a_member_does_not_conserve_is_not_held(method):
    holding = method(4, preserve=[lambda m: m[2]])
    ensemble = lt.ensemble(asymmetric_body, START, SPAN, STEP, holding, parameters={"b": np.array([1.0, 2.0, 1.0])})
    assert ensemble.status.tolist() == [StatusCode.COMPLETED, StatusCode.INADMISSIBLE, StatusCode.COMPLETED]
    assert "does not conserve the preserved function" in ensemble.reasons[1]
    assert np.abs(ensemble.x[[0, 2], 2] - START[2]).max() < 1e-15
    ensemble = lt.ensemble(asymmetric_body, START, SPAN, STEP, holding, parameters={"b": np.array([2.0, 1.0])})
    assert ensemble.status.tolist() == [StatusCode.INADMISSIBLE, StatusCode.COMPLETED]


@pytest.mark.slow
def test_a_preserved_function_that_is_a_casimir_of_one_member():
    """``x A x`` is a multiple of the Casimir for A = 1 alone: each member names what its friction preserves."""

    def build(p):
        friction = lt.ProjectedMetric(preserve=(lt.Quadratic(p["A"]),), normalized=True, rate=0.3)
        return lt.LiePoissonSystem(
            mf.so(3), lt.Quadratic(jnp.array([1.0, 2.0, 3.0])), lambda m: jnp.log(1 + m @ m), friction
        )

    matrices = np.stack([np.eye(3), np.diag([1.0, 2.0, 4.0]), 2.0 * np.eye(3)])
    method = lt.MetriplecticGauss(2)
    for order in ORDERS:
        ensemble = lt.ensemble(build, START, SPAN, STEP, method, parameters={"A": matrices[order]})
        for i, k in enumerate(order):
            one = lt.integrate(build({"A": matrices[k]}), START, SPAN, STEP, method)
            assert np.abs(ensemble.x[i] - one.x[-1]).max() < 1e-14
            assert ensemble[i].casimirs.keys() == one.casimirs.keys()
            assert set(ensemble[i].laws.conserved) == set(one.laws.conserved)


# -- domains and inertia ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_member_outside_its_own_domain_is_not_started():
    """The temperature ``2 a S`` at the same state is negative for one member, neither the first nor an extreme one."""

    def gas(p):
        return lt.SimpleClosedSystem(
            lambda q, v, S: 0.5 * v @ v - 0.5 * q @ q - (p["a"] * (p["a"] - 2.0) + 0.5) * S, dim=3, validate=False
        )

    a = np.array([0.0, 1.0, 3.0])  # temperatures 0.5, -0.5, 3.5
    ensemble = lt.ensemble(gas, [0.3, 0.1, 1.0], (0.0, 1.0), 0.1, parameters={"a": a})
    assert ensemble.status.tolist() == [StatusCode.COMPLETED, StatusCode.INADMISSIBLE, StatusCode.COMPLETED], str(
        ensemble
    )
    assert "temperature" in ensemble.reasons[1]


def test_one_inertia_only_if_all_have_it():
    """The parameter that differs is the last of ten, and most are the same for all."""

    def build(p):
        shift = 1e-3 * jnp.sum(p["all"][:9])
        return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(jnp.array([1.0, 2.0, 3.0]) + p["all"][9]), shift_of(shift))

    def shift_of(shift):
        return lambda m: shift + m @ m

    rows = np.random.default_rng(0).standard_normal((12, 10))
    rows[:, 9] = 0.0
    family = Family.from_arguments(build, {"all": rows})
    np.testing.assert_allclose(member_groups.common_inertia(family), np.diag([1.0, 1 / 2, 1 / 3]))
    rows[5, 9] = 1e-3
    assert member_groups.common_inertia(Family.from_arguments(build, {"all": rows})) is None


# -- the rest of an ensemble ------------------------------------------------------------------------------------------


def test_groups_are_few_and_in_order():
    values = np.array([2.0, 1.0, 0.5, 1.0, 3.0])
    family = Family.from_arguments(body, {"a": values})
    groups, refusal_reasons = member_groups.group_members_by_invariants(
        family, lt.MetriplecticMidpoint(), np.tile(START, (5, 1))
    )
    assert [group.indices.tolist() for group in groups] == [[0, 2, 4], [1, 3]]
    assert refusal_reasons == {}
    names = [group.family.member(0).invariant_verdicts.conserved_names for group in groups]
    assert names[0] == frozenset()
    assert len(names[1]) == 1


@pytest.mark.slow
def test_an_interruption_stops_all_groups(monkeypatch):
    from liethermo.runs.ensemble_lanes import FixedEnsembleRun

    def count_call(run):
        calls.append(len(run.group.x0))

    calls: list[int] = []
    monkeypatch.setattr(FixedEnsembleRun, "run_on_compiled_engine", count_call)
    ensemble = lt.ensemble(body, START, SPAN, STEP, parameters={"a": A}, engine="compiled")
    assert calls == [1]
    assert ensemble.status.tolist() == [StatusCode.INTERRUPTED] * 3


def test_the_laws_of_an_ensemble_are_those_of_a_single_run_as_far_as_all_have_them():
    """Isotropic bodies conserve a Casimir that the others dissipate; without dissipation all conserve it."""
    single = lt.integrate(lt.models.free_rigid_body(), START, SPAN, STEP)
    ensemble = lt.ensemble(lt.models.free_rigid_body(), [START, START], SPAN, STEP)
    assert ensemble.laws == single.laws
    assert single.laws.conserved
    damped, moments = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), [[2.0, 2.0, 2.0], [3.0, 2.0, 1.0]]
    mixed = lt.ensemble(damped, [START, START], SPAN, STEP, parameters={"energy.inertia": np.array(moments)})
    assert mixed[0].laws.conserved
    assert not mixed[1].laws.conserved
    assert (mixed.laws.conserved, mixed.laws.unpromised) == ((), ())


@pytest.mark.sampled(1)
@pytest.mark.parametrize("outputs", ["final", "trajectory", "summary"])
def test_files_of_mixed_groups(tmp_path, outputs):
    ensemble = lt.ensemble(body, START, SPAN, STEP, parameters={"a": A}, outputs=outputs)
    loaded_run = lt.load(ensemble.save(tmp_path / "many.nc"))
    assert str(loaded_run.audit()) == str(ensemble.audit())
    assert np.array_equal(loaded_run.energy, ensemble.energy)
    if outputs != "summary":
        assert np.array_equal(ensemble[1].x[-1], ensemble.x[1] if outputs == "final" else ensemble.x[1, -1])


def test_names_of_parameters_that_end_with_an_index():
    """The numbers in a function are leaves called ``numbers[0]``; an entry of one is ``numbers[0][1]``."""
    body = lt.LiePoissonSystem(mf.so(3), lambda m: 0.5 * (m[0] ** 2 + 3.0 * m[1] ** 2) + jnp.cosh(0.7 * m[2]))
    name = "energy.function.numbers[0][0]"
    study = lt.Study(body, {name: [3.0, 1.0]}, x0=START, t_span=(0.0, 1.0), step=STEP, measure={"x": "final"})
    study.run(progress=False)
    end_state = lt.integrate(body, START, (0.0, 1.0), STEP).x[-1]
    gaps = np.abs(study.results.x.values - end_state).max(axis=1)
    assert gaps.min() < 1e-14
    assert gaps.max() > 1e-3
