"""The public suites pass for the library's own objects and fail for broken ones."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo import testing
from tests.cases import slow_case

TESTED_DISSIPATIONS = {
    "killing": lt.KillingDissipation(0.3),
    "projected": lt.ProjectedMetric(rate=0.2),
    "sum": lt.KillingDissipation(0.1) + lt.ProjectedMetric(rate=0.1),
    "coulomb": lt.DissipationPotential(lt.CoulombFriction(0.2, 0.1)),
}


@pytest.mark.sampled("MetriplecticRungeKutta(order=4)")
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
