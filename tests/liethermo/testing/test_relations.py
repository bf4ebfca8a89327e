"""What must not change a result does not, on random systems with every method; and the suite finds what does."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import liethermo as lt
import manifolds as mf
from liethermo import testing
from liethermo.integrators import fluctuating
from liethermo.integrators.base import has_error_estimate
from liethermo.runs.timetable import StepSchedule
from liethermo.testing.transformations import CoordinateChange, transform_structure_constants, transform_system
from tests.cases import DISSIPATIONS, REPRESENTATIVE, build, state_of

METHODS = {
    "midpoint": lt.MetriplecticMidpoint(),
    "coordinate increment": lt.MetriplecticMidpoint("coordinate_increment"),
    "gauss 2": lt.MetriplecticGauss(2),
    "gauss 3": lt.MetriplecticGauss(3),
    "explicit 4": lt.MetriplecticRungeKutta(4),
    "explicit 6": lt.MetriplecticRungeKutta(6),
    "explicit 8": lt.MetriplecticRungeKutta(8),
    "taylor": lt.MetriplecticTaylor(8),
}
QUICK = ("midpoint", "gauss 2", "explicit 4")
SLOW_RELATIONS = ("diffrax", "side by side")


@functools.cache
def system_of(g, name, seed):
    return build(g, next(case for case in DISSIPATIONS if case.name == name), seed)


def oscillator():
    """A bath takes the heat of a damped oscillator: a system that is no Lie-Poisson one."""
    tensor = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])

    def friction(x):
        v = jnp.array([0.0, 1.0, -x[1]])
        return 0.3 * jnp.outer(v, v)

    def energy(x):
        return 0.5 * x[1] ** 2 + 0.25 * x[0] ** 4 + x[2]

    return lt.MetriplecticSystem(tensor, energy, lambda x: x[2], lt.FrictionOperator(friction))


def tumbling(scale=1.0, friction=0.05):
    """A body whose energy falls, with its attitude."""
    inertia = scale * np.array([3.2, 3.0, 1.0])
    return lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1 / inertia), dissipation=lt.DoubleBracket(friction / scale), group=mf.SO(3)
    )


def relaxing():
    """A gradient flow, which comes to rest."""
    return lt.MetriplecticSystem(
        None, lambda x: 0.5 * jnp.sum(x * x) + 0.1 * x[0] ** 4, None, lt.Friction(), space=mf.Euclidean(2)
    )


def with_preserved():
    """A top whose friction is told to preserve the Casimir that is not its entropy."""
    g = mf.se(3)
    other, entropy = sorted(g.casimirs(2), key=str, reverse=True)

    def energy(m):
        return 0.5 * jnp.sum(m[:3] ** 2 / jnp.array([3.0, 2.0, 1.0])) + 0.3 * jnp.sin(m[5]) + 0.1 * m[3] ** 2

    return lt.LiePoissonSystem(g, energy, entropy, lt.ProjectedMetric(preserve=(other,), rate=0.2))


# -- all of them hold -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "x0", "method", "step", "time", "relations"),
    [
        pytest.param(relaxing, [1.0, 0.7], "explicit 4", 0.1, 5.0, ["constant"], id="a constant, coming to rest"),
        pytest.param(tumbling, [0.1, 0.2, 1.0], "midpoint", 0.1, 2000.0, ["units"], id="units of a body with attitude"),
        pytest.param(
            with_preserved,
            [0.4, -0.2, 0.7, 0.5, 0.3, 0.6],
            "midpoint",
            0.01,
            0.4,
            ["domain", "shares"],
            id="an entropy known near the motion",
        ),
        pytest.param(oscillator, [0.9, 0.3, 0.2], "explicit 6", 0.05, 2.0, ["scipy", "study"], id="by other calls"),
        pytest.param(oscillator, [0.9, 0.3, 0.2], "explicit 4", 0.05, 2.0, ["diffrax"], id="backwards by diffrax"),
    ],
)
def test_what_once_did_not_hold(make, x0, method, step, time, relations):
    assert testing.check_relations(make(), METHODS[method], x0, step, relations=relations, time=time).passed


@st.composite
def runs(draw, methods, relations):
    g = draw(st.sampled_from([*REPRESENTATIVE, None]))
    method = draw(st.sampled_from(methods))
    relation = draw(st.sampled_from([name for name in testing.RELATIONS if name in relations]))
    seed = draw(st.integers(0, 3))
    if g is None:
        system, x0 = oscillator(), np.array([0.9, 0.3, 0.2]) + 0.1 * np.random.default_rng(seed).standard_normal(3)
    else:
        names = [case.name for case in DISSIPATIONS if case.exempt(g) is None]
        system, x0 = system_of(g, draw(st.sampled_from(names)), seed), 0.5 * state_of(g, seed)
    step = draw(st.sampled_from([None, lt.Adaptive(1e-8)])) if has_error_estimate(METHODS[method]) else None
    return system, method, x0, step, relation, seed


def holds(run):
    system, method, x0, step, relation, seed = run
    report = testing.check_relations(system, METHODS[method], x0, step, relations=[relation], seed=seed)
    assert report.passed


@settings(max_examples=4)
@given(runs(QUICK, [name for name in testing.RELATIONS if name not in SLOW_RELATIONS]))
def test_relations_hold(run):
    holds(run)


@pytest.mark.slow
@settings(max_examples=1_000)
@given(runs(list(METHODS), list(testing.RELATIONS)))
def test_relations_hold_for_many(run):
    holds(run)


# -- and are about something ------------------------------------------------------------------------------------------


def test_another_basis_is_another_algebra():
    """The motion in turned axes by independent formulas: ``mu' = mu x (I^-1 mu)`` there and back."""
    inertia = np.array([3.0, 2.0, 1.0])
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / inertia))
    matrix = np.array([[2.0, 1.0, 0.0], [0.0, 1.0, -1.0], [0.5, 0.0, 1.0]])
    new = transform_system(body, CoordinateChange(matrix, 1.0, 1.0))
    mu = np.array([0.3, -0.7, 0.5])
    np.testing.assert_allclose(new.vector_field(matrix @ mu), matrix @ np.cross(mu, mu / inertia), atol=1e-14)
    C = transform_structure_constants(mf.so(3).structure_constants, matrix)
    basis = [np.tensordot(row, np.asarray(mf.so(3).structure_constants), 1) for row in matrix]
    for a in range(3):  # [e_a, e_b] in the old coordinates
        for b in range(3):
            np.testing.assert_allclose(matrix.T @ C[a, b], basis[a].T @ matrix[b], atol=1e-14)


class Sized(lt.MetriplecticMidpoint):
    """Control: something that is not small in every unit."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k) + 1e-6


class Drifting(lt.MetriplecticMidpoint):
    """Control: a step that depends on the value of the energy, so that a constant matters."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k) * (1.0 + 1e-6 * jnp.tanh(system.energy.value(x)))


CONTROLS = {
    "units": (Sized(), lt.ProjectedMetric(rate=0.2)),
    "constant": (Drifting(), lt.ProjectedMetric(rate=0.2)),
    "reversal": (Sized(), None),
}


@pytest.mark.parametrize("relation", list(CONTROLS))
def test_a_fault_is_found(relation):
    method, friction = CONTROLS[relation]
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 3.0])), lt.Quadratic(np.ones(3)), friction)
    assert testing.check_relations(body, METHODS["midpoint"], [0.5, 0.8, 0.3], 0.02, relations=[relation]).passed
    with pytest.raises(testing.PropertyError, match=f"{relation}: .*FAILS"):
        testing.check_relations(body, method, [0.5, 0.8, 0.3], 0.02, relations=[relation])


class Remembering(fluctuating.StochasticMidpoint):
    """Control: steps with noise that hand on what rounding has kept from the state."""

    carries_compensation = True


def test_noise_that_repeats_is_found(monkeypatch):
    """Controls: noise that is counted from the start of each call, and steps that depend on more than the state."""
    body = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 3.0])), lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.2)
    )

    def check(seed):  # one of its own for each method, which is remembered
        options = {"relations": ["noise"], "time": 4.0, "seed": seed}
        testing.check_relations(body, METHODS["midpoint"], [0.5, 0.8, 0.3], 0.02, **options)

    check(0)
    with monkeypatch.context() as patched:
        patched.setattr(StepSchedule, "reached", lambda self, steps: np.asarray(steps) * self.h)
        with pytest.raises(testing.PropertyError, match=r"noise: .*FAILS"):
            check(1)
    with monkeypatch.context() as patched:
        patched.setattr(fluctuating, "Fluctuating", Remembering)
        with pytest.raises(testing.PropertyError, match=r"noise: in parts .*FAILS"):
            check(2)


@pytest.mark.parametrize("method", ["midpoint", "explicit 4"])
def test_parts_of_what_depends_on_time(method):
    """Parts start at their own times; a torque knows time and attitude."""
    driven = lt.LiePoissonSystem(mf.so(3), lambda s, t: -jnp.cos(t) * s[2], None, lt.DoubleBracket(0.5))
    assert testing.check_relations(driven, METHODS[method], [1.0, 0.3, 0.2], relations=["split", "noise"]).passed
    pushed = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), torque=lambda t, mu, g: 0.3 * jnp.sin(t) * g[0], group=mf.SO(3)
    )
    assert testing.check_relations(pushed, METHODS[method], [1.0, 0.3, 0.2], 0.05, relations=["split", "file"]).passed


def test_a_name_that_is_none():
    with pytest.raises(lt.InputError, match="no relation 'unit'; there are constant, "):
        testing.check_relations(oscillator(), relations=["unit"])


def test_a_run_that_fails_is_told():
    """A fall into ``ln q``: the loaded run is the failed one to the bit, which is no evidence."""
    falling = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 + jnp.log(x[0]), validate=False)
    with pytest.raises(testing.PropertyError, match=r"the run completes .*FAILS"):
        testing.check_relations(falling, METHODS["explicit 4"], [0.1, -1.0], 0.02, relations=["file"])
