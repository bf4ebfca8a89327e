"""Adaptive steps follow the attitude of a body whose momentum rests: a steady spin beside its closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import liethermo as lt
import manifolds as mf

METHODS = [lt.MetriplecticGauss(2), lt.MetriplecticGauss(4), lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(12)]
ISOTROPIC = (2.0, 2.0, 2.0)
TRIAXIAL = (3.0, 2.0, 1.0)
SPINS = [(ISOTROPIC, (0.7, -1.1, 0.4)), (TRIAXIAL, (0.0, 0.0, 2.0)), (TRIAXIAL, (-1.3, 0.0, 0.0))]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "engine"), [(METHODS[0], "array"), *((method, "compiled") for method in METHODS)], ids=str
)
def test_the_attitude_of_a_steady_spin_has_the_error_that_was_asked_for(method, engine):
    """The momentum is constant, so its own error would allow steps of many turns."""
    end, rtol = 30.0, 1e-8
    for inertia, omega in SPINS:
        body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / np.array(inertia)), group=mf.SO(3))
        run = lt.integrate(body, inertia * np.array(omega), (0.0, end), lt.Adaptive(rtol), method, engine=engine)
        angle = end * np.linalg.norm(omega)
        error = np.abs(run.attitude[-1] - Rotation.from_rotvec(end * np.array(omega)).as_matrix()).max()
        assert error < rtol * angle, (inertia, omega, error)
        assert run.audit().passed


def test_steps_without_an_attitude_stay_as_long_as_they_were():
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 0.3]))
    run = lt.integrate(body, [0.0, 0.0, 2.0], (0.0, 30.0), lt.Adaptive(1e-8), lt.MetriplecticRungeKutta(8))
    assert run.stats.steps < 20


def test_members_of_an_ensemble_turn_as_alone():
    method = lt.MetriplecticRungeKutta(6)
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 0.3]), group=mf.SO(3))
    momenta = np.array([[0.0, 0.0, 2.0], [0.3, 0.2, -1.0], [1.0, 0.0, 0.0]])
    control, span = lt.Adaptive(1e-8), (0.0, 10.0)
    many = lt.ensemble(body, momenta, span, control, method)
    for i, momentum in enumerate(momenta):
        alone = lt.integrate(body, momentum, span, control, method)
        assert np.abs(many.attitude[i] - alone.attitude[-1]).max() < 1e-13


@pytest.mark.parametrize("seed", range(2))
def test_an_isotropic_body_with_friction_and_long_adaptive_steps_passes_its_audit(seed):
    """Rounding alone moves its momentum. Steps of many turns made its momentum in space wrong by its own size."""
    inertia = np.ones(3)
    body = lt.LiePoissonSystem(
        mf.so(3),
        lambda mu: 0.5 * (mu[0] ** 2 / inertia[0] + mu[1] ** 2 / inertia[1] + mu[2] ** 2 / inertia[2]),
        dissipation=lt.DoubleBracket(0.08),
        baths=lt.HeatBaths(2.0, 1.0),
        group=mf.SO(3),
    )
    momentum = (1.0 + seed) * np.random.default_rng(seed).standard_normal(3)
    run = lt.integrate(body, momentum, (0.0, 60.0), lt.Adaptive(1e-7), lt.MetriplecticRungeKutta(8))
    audit = run.audit()
    assert audit.passed, audit
    assert np.abs(run.attitude[-1] - Rotation.from_rotvec(60.0 * momentum).as_matrix()).max() < 1e-10
