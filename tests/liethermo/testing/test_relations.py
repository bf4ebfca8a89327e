"""The relations hold on random systems with every method, and the suite detects faults."""

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
from liethermo.runs.schedule import StepSchedule
from liethermo.testing.transformations import (
    CoordinateChange,
    transform_coordinates_and_units,
    transform_structure_constants,
)
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
FAST_METHODS = ("midpoint", "gauss 2", "explicit 4")
SLOW_RELATIONS = ("diffrax", "side by side")


@functools.cache
def system_of(g, name, seed):
    return build(g, next(case for case in DISSIPATIONS if case.name == name), seed)


def oscillator():
    """Return a damped oscillator with a bath, which is no Lie-Poisson system."""
    tensor = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])

    def friction(x):
        v = jnp.array([0.0, 1.0, -x[1]])
        return 0.3 * jnp.outer(v, v)

    def energy(x):
        return 0.5 * x[1] ** 2 + 0.25 * x[0] ** 4 + x[2]

    return lt.MetriplecticSystem(tensor, energy, lambda x: x[2], lt.FrictionOperator(friction))


def tumbling_body(scale=1.0, friction=0.05):
    """Return a body with attitude whose energy falls."""
    inertia = scale * np.array([3.2, 3.0, 1.0])
    return lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1 / inertia), dissipation=lt.DoubleBracket(friction / scale), group=mf.SO(3)
    )


def gradient_flow():
    """Return a gradient flow, which comes to rest."""
    return lt.MetriplecticSystem(
        None, lambda x: 0.5 * jnp.sum(x * x) + 0.1 * x[0] ** 4, None, lt.Friction(), space=mf.Euclidean(2)
    )


def top_with_preserved_casimir():
    """Return a top whose friction preserves the Casimir that is not its entropy."""
    g = mf.se(3)
    preserved_casimir, entropy = sorted(g.casimirs(2), key=str, reverse=True)

    def energy(m):
        return 0.5 * jnp.sum(m[:3] ** 2 / jnp.array([3.0, 2.0, 1.0])) + 0.3 * jnp.sin(m[5]) + 0.1 * m[3] ** 2

    return lt.LiePoissonSystem(g, energy, entropy, lt.ProjectedMetric(preserve=(preserved_casimir,), rate=0.2))


# -- all of them hold -----------------------------------------------------------------------------------------------


@pytest.mark.sampled("an entropy known near the motion")
@pytest.mark.parametrize(
    ("make", "x0", "method", "step", "time", "relations"),
    [
        pytest.param(gradient_flow, [1.0, 0.7], "explicit 4", 0.1, 5.0, ["constant"], id="a constant, coming to rest"),
        pytest.param(
            tumbling_body, [0.1, 0.2, 1.0], "midpoint", 0.1, 2000.0, ["units"], id="units of a body with attitude"
        ),
        pytest.param(
            top_with_preserved_casimir,
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
def test_relations_that_once_failed_hold(make, x0, method, step, time, relations):
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


def assert_relation_holds(run):
    system, method, x0, step, relation, seed = run
    report = testing.check_relations(system, METHODS[method], x0, step, relations=[relation], seed=seed)
    assert report.passed


@pytest.mark.slow
@settings(max_examples=4)
@given(runs(FAST_METHODS, [name for name in testing.RELATIONS if name not in SLOW_RELATIONS]))
def test_relations_hold(run):
    assert_relation_holds(run)


@pytest.mark.slow
@settings(max_examples=1_000)
@given(runs(list(METHODS), list(testing.RELATIONS)))
def test_relations_hold_for_many(run):
    assert_relation_holds(run)


# -- and are about something ------------------------------------------------------------------------------------------


def test_another_basis_is_another_algebra():
    """The motion in other axes agrees with the formula ``mu' = mu x (I^-1 mu)``, transformed there and back."""
    inertia = np.array([3.0, 2.0, 1.0])
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / inertia))
    matrix = np.array([[2.0, 1.0, 0.0], [0.0, 1.0, -1.0], [0.5, 0.0, 1.0]])
    new = transform_coordinates_and_units(body, CoordinateChange(matrix, 1.0, 1.0))
    mu = np.array([0.3, -0.7, 0.5])
    np.testing.assert_allclose(new.vector_field(matrix @ mu), matrix @ np.cross(mu, mu / inertia), atol=1e-14)
    C = transform_structure_constants(mf.so(3).structure_constants, matrix)
    basis = [np.tensordot(row, np.asarray(mf.so(3).structure_constants), 1) for row in matrix]
    for a in range(3):  # [e_a, e_b] in the old coordinates
        for b in range(3):
            np.testing.assert_allclose(matrix.T @ C[a, b], basis[a].T @ matrix[b], atol=1e-14)


class ConstantAdded(lt.MetriplecticMidpoint):
    """Control: a method with an absolute error, which is not small in every unit."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k) + 1e-6


class EnergyDependent(lt.MetriplecticMidpoint):
    """Control: a method whose step depends on the value of the energy, so that a constant matters."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k) * (1.0 + 1e-6 * jnp.tanh(system.energy.value(x)))


CONTROLS = {
    "units": (ConstantAdded(), lt.ProjectedMetric(rate=0.2)),
    "constant": (EnergyDependent(), lt.ProjectedMetric(rate=0.2)),
    "reversal": (ConstantAdded(), None),
}


@pytest.mark.parametrize("relation", list(CONTROLS))
def test_a_fault_is_found(relation):
    method, friction = CONTROLS[relation]
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 3.0])), lt.Quadratic(np.ones(3)), friction)
    assert testing.check_relations(body, METHODS["midpoint"], [0.5, 0.8, 0.3], 0.02, relations=[relation]).passed
    with pytest.raises(testing.PropertyError, match=f"{relation}: .*FAILS"):
        testing.check_relations(body, method, [0.5, 0.8, 0.3], 0.02, relations=[relation])


class Remembering(fluctuating.StochasticMidpoint):
    """Control: stochastic steps that carry the compensation, and so depend on more than the state."""

    carries_compensation = True


def test_noise_that_repeats_is_found(monkeypatch):
    """Controls: noise that restarts with each call, and steps that depend on more than the state."""
    body = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(np.array([1.0, 2.0, 3.0])), lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.2)
    )

    def check(seed):  # one of its own for each method, which is remembered
        options = {"relations": ["noise"], "time": 4.0, "seed": seed}
        testing.check_relations(body, METHODS["midpoint"], [0.5, 0.8, 0.3], 0.02, **options)

    check(0)
    with monkeypatch.context() as patch:
        patch.setattr(StepSchedule, "times_after", lambda self, steps: np.asarray(steps) * self.h)
        with pytest.raises(testing.PropertyError, match=r"noise: .*FAILS"):
            check(1)
    with monkeypatch.context() as patch:
        patch.setattr(fluctuating, "StochasticMidpoint", Remembering)
        with pytest.raises(testing.PropertyError, match=r"noise: in parts .*FAILS"):
            check(2)


@pytest.mark.sampled("midpoint")
@pytest.mark.parametrize("method", ["midpoint", "explicit 4"])
def test_split_runs_of_driven_systems(method):
    """Segments of a split run start at their own times; a torque depends on time and attitude."""
    driven = lt.LiePoissonSystem(mf.so(3), lambda s, t: -jnp.cos(t) * s[2], None, lt.DoubleBracket(0.5))
    assert testing.check_relations(driven, METHODS[method], [1.0, 0.3, 0.2], relations=["split", "noise"]).passed
    torqued = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), torque=lambda t, mu, g: 0.3 * jnp.sin(t) * g[0], group=mf.SO(3)
    )
    assert testing.check_relations(torqued, METHODS[method], [1.0, 0.3, 0.2], 0.05, relations=["split", "file"]).passed


def test_an_unknown_relation_is_refused():
    with pytest.raises(lt.InputError, match="no relation 'unit'; there are constant, "):
        testing.check_relations(oscillator(), relations=["unit"])


def test_a_run_that_fails_is_told():
    """The motion falls into ``ln q``; equality with the loaded run is no evidence then."""
    singular_system = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 + jnp.log(x[0]), validate=False)
    with pytest.raises(testing.PropertyError, match=r"the run completes .*FAILS"):
        testing.check_relations(singular_system, METHODS["explicit 4"], [0.1, -1.0], 0.02, relations=["file"])
