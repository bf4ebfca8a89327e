"""A system that is taken apart and put together again is the same system, to the last bit."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.systems.invariants import are_conserved, preserved_function_names
from liethermo.testing.suites import copy_pytree
from liethermo.tracing.interpret import evaluate_at_points
from tests.cases import DISSIPATIONS, build
from tests.liethermo.closed_systems import ISOLATED_SYSTEMS
from tests.liethermo.integrators.test_convergence import SYSTEMS

REQUIRED_ARGUMENTS = {
    "zeitlin": {"N": 4},
    "magnetic_fluid": {"N": 4},
    "tumbling_body": {"inertia": (3.0, 2.0, 1.5), "rate": 0.1},
    "sorting_flow": {"target": (1.0, 2.0, 3.0)},
    "toda_flow": {"n": 3},
}

NO_SYSTEMS = {"IdealMixture", "QuantisedSphere", "hermitian_matrix", "hermitian_state"}
"""Public names of ``lt.models`` that are no systems and make none."""


def system_builders():
    yield from ((f"so(3), {case.name}", lambda case=case: build(mf.so(3), case)) for case in DISSIPATIONS)
    yield from SYSTEMS.items()
    yield from ((f"simple closed, {name}", lambda name=name: ISOLATED_SYSTEMS[name]) for name in ISOLATED_SYSTEMS)
    for name in sorted({*lt.models.__all__} - NO_SYSTEMS):
        yield f"model {name}", functools.partial(getattr(lt.models, name), **REQUIRED_ARGUMENTS.get(name, {}))


def _field(system, x):
    return system.vector_field(x)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("make", [pytest.param(make, id=name) for name, make in system_builders()])
def test_fields_and_laws(make):
    system = make()
    again = copy_pytree(system)
    assert again is not system
    fields = [evaluate_at_points(_field, s, system.samples(3)) for s in (system, again)]
    assert np.array_equal(*fields, equal_nan=True)
    assert (system.energy_law, system.entropy_law) == (again.energy_law, again.entropy_law)
    assert system.first_integrals() == again.first_integrals()
    assert sorted(system.functions()) == sorted(again.functions())  # JAX sorts the names of what it takes apart


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sum of frictions", "spin with a bath", "warm top"])
def test_trajectories(name):
    system = SYSTEMS[name]()
    x0 = system.samples(1, scale=0.5)[0]
    runs = [
        lt.integrate(s, x0, (0.0, 0.5), 0.05, lt.MetriplecticGauss(2), engine="array")
        for s in (system, copy_pytree(system))
    ]
    assert np.array_equal(runs[0].x, runs[1].x)
    assert runs[0].laws == runs[1].laws


def test_a_sum_keeps_what_every_part_is_told_to_preserve():
    """Also where both parts are told so, and after the sum is taken apart."""
    system = copy_pytree(SYSTEMS["sum of frictions"]())
    length = lambda x: jnp.dot(x[3:], x[3:])  # noqa: E731
    assert are_conserved(system, (lt.Function(length),)) == [True]
    assert {"mu4**2 + mu5**2 + mu6**2"} == system.first_integrals()  # one quantity, one name
    assert len(system.preserved_functions) == 2
    assert preserved_function_names(system) == ("mu4**2 + mu5**2 + mu6**2",) * 2


@pytest.mark.slow
def test_a_sum_with_one_part_that_preserves_is_consistent():
    """The slopes of a step of no length are the vector field, where an entropy is not quadratic."""

    def energy(m):
        return 0.5 * jnp.sum(m * m / jnp.array([3.0, 2.0, 1.0])) + 0.1 * m[0] ** 4

    L = lambda m: m[0] + 0.3 * m[1] ** 2  # noqa: E731
    friction = lt.ProjectedMetric(preserve=(L,), normalized=True, rate=0.3) + lt.ProjectedMetric(rate=0.2)
    system = copy_pytree(lt.LiePoissonSystem(mf.so(3), energy, lambda m: jnp.log(1.0 + jnp.dot(m, m)), friction))
    method, x = lt.MetriplecticGauss(1).on(system), jnp.array([0.8, 0.5, 0.9])
    field = system.vector_field(x)
    slopes = method.slopes(system, x, jnp.zeros(3), 1e-6, field[None])[0]
    assert np.abs(slopes - field).max() <= 1e-5 * np.abs(field).max()
