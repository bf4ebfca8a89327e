"""Do ten tasks of a newcomer with the pages of the site alone: ``newcomer_tasks.md`` lists them."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

PAGE = Path(__file__).with_name("newcomer_tasks.md")


def test_1_a_relaxing_body():
    body = lt.models.rigid_body(inertia=(3.0, 2.0, 1.0), rate=0.2)
    solution = lt.integrate(body, [0.06, 0.1, 1.0], t_span=(0.0, 100.0), step=0.1)
    assert solution.audit().passed
    assert np.abs(solution.x[-1][1:]).max() < 0.02 * abs(solution.x[-1][0])  # it turns about its first axis


def test_2_an_algebra_by_its_brackets():
    C = np.zeros((3, 3, 3))
    C[0, 1, 2], C[0, 2, 1] = 1, -1  # rotations and shifts of the plane
    g = mf.LieAlgebra.from_structure_constants(C - C.swapaxes(0, 1), name="plane", basis_names=("J", "X", "Y"))
    assert g.casimir_count() == 1
    assert [str(casimir) for casimir in g.casimirs(degree=2)] == ["X**2 + Y**2"]


@pytest.mark.slow
def test_3_an_energy_of_my_own():
    g = mf.so(3)
    system = lt.LiePoissonSystem(
        g,
        energy=lambda mu: jnp.cosh(mu[0]) + mu[1] ** 2 + 2 * mu[2] ** 2,
        entropy=g.casimirs(degree=2)[0],
        dissipation=lt.KillingDissipation(rate=0.1),
    )
    assert system.check().passed
    assert lt.integrate(system, [0.3, 0.5, 0.8], (0.0, 20.0), 0.1).audit().passed


def test_4_a_method_and_a_step():
    body, x0 = lt.models.rigid_body((3.0, 2.0, 1.0)), [0.1, 0.2, 1.0]
    suggestion = lt.suggest_method(body, x0, rtol=1e-8)
    end_state = lt.integrate(body, x0, (0.0, 10.0), suggestion.step, suggestion.method).x[-1]
    exact = lt.integrate(body, x0, (0.0, 10.0), 10.0, lt.Reference(rtol=1e-12)).x[-1]
    assert np.abs(end_state - exact).max() < 1e-6


def test_5_until_it_has_relaxed():
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    run = lt.integrate(body, [0.06, 0.1, 1.0], (0.0, 1e4), lt.Adaptive(1e-8), until=lt.Relaxed(1e-8))
    assert run.event_time is not None
    assert run.event_time < 1e3
    assert body.entropy_production(run.x[-1]) == pytest.approx(1e-8, rel=1e-3)


def test_6_a_sweep():
    rates = np.linspace(0.2, 2.0, 20)
    sweep = lt.ensemble(
        lt.models.rigid_body((3.0, 2.0, 1.0)),
        [0.1, 0.2, 1.0],
        (0.0, 200.0),
        0.1,
        parameters={"dissipation.rate": rates / 2},
        outputs="summary",
    )
    assert sweep.ok.all()
    assert sweep.relaxation_time[0] > 3 * sweep.relaxation_time[-1]  # more friction, less time


@pytest.mark.slow
def test_7_a_spin_and_its_bath():
    space = mf.Sphere(2) * mf.Euclidean(1)
    system = lt.MetriplecticSystem(
        poisson=mf.LiePoisson(mf.direct_sum(mf.so(3), mf.abelian(1))),
        energy=lambda x: -x[2] + jnp.exp(x[3]),  # a field along the third axis, and heat
        entropy=lambda x: x[3],
        dissipation=lt.ProjectedMetric(rate=0.5),
        space=space,
    )
    start = space.point([1.0, 0.0, -0.5, 0.0], project=True)
    run = lt.integrate(system, start, (0.0, 40.0), 0.1, lt.MetriplecticGauss(2))
    assert run.audit().passed
    assert run.x[-1][2] > 0.99  # the spin has aligned


@pytest.mark.slow
def test_8_heat_and_rubbing():
    pair = lt.ComposedSystem(
        {
            "stone": lt.Subsystem(lambda x: 2.0 * jnp.exp(x[0] / 2.0), 1),
            "slider": lt.Subsystem(lambda x: 0.5 * x[1] ** 2 + jnp.exp(x[2]), 3, friction=0.3),
        },
        coupling=lambda q: 0.5 * jnp.sum(q**2),
        conductance=0.5,
    )
    run = lt.integrate(pair, [1.2, 1.0, 0.0, 0.1], (0.0, 60.0), 0.1)
    stone_temperature, slider_temperature = map(float, pair.temperatures(run.x[-1]))
    assert run.audit().passed
    assert stone_temperature == pytest.approx(slider_temperature, rel=1e-3)


@pytest.mark.slow
def test_9_a_derivative():
    def final_entropy(rate):
        system = lt.models.rigid_body((3.0, 2.0, 1.0), rate=rate)
        return system.entropy.value(lt.flow(system, jnp.array([0.1, 0.2, 1.0]), (0.0, 5.0), 0.1))

    h = 1e-5
    difference = (final_entropy(0.2 + h) - final_entropy(0.2 - h)) / (2 * h)
    assert jax.grad(final_entropy)(0.2) == pytest.approx(float(difference), rel=1e-7)


def test_10_saved_and_read(tmp_path):
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1).save(tmp_path / "body.nc")
    assert lt.load(tmp_path / "body.nc").audit().passed


def test_the_page_lists_these_tasks_and_their_lines():
    rows = re.findall(r"^\| (\d+) \|.*\| (\d+) \|$", PAGE.read_text(), re.MULTILINE)
    line_counts = {}
    for name, thing in globals().items():
        if (number := re.sub(r"^test_(\d+)_.*", r"\1", name)).isdigit():
            body = inspect.getsource(thing).partition("):\n")[2]
            line_counts[int(number)] = sum(1 for line in body.splitlines() if line.strip())
    assert {int(number): int(lines) for number, lines in rows} == line_counts
    assert sorted(line_counts) == list(range(1, 11))
