"""Run each addition through the suite of its kind, in one call, and integrate with it."""

import functools
from pathlib import Path

import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.additions.algebra import OSCILLATOR
from tests.additions.dissipation import Steep
from tests.additions.group import AFFINE
from tests.additions.integrator import Simpson
from tests.additions.space import Ring
from tests.additions.system import LotkaVolterra

START = [1.5, 0.7, 1.0]


@functools.cache
def prey():
    return LotkaVolterra([[0.0, -1.0, 0.5], [1.0, 0.0, -0.8], [-0.5, 0.8, 0.0]], [1.0, 1.2, 0.9])


@functools.cache
def ring_system():
    friction = lt.ProjectedMetric(normalized=True)
    return lt.MetriplecticSystem(None, lambda x: x[2] + 0.1 * x[0], lambda x: x[1] - x[0] ** 2, friction, space=Ring())


def run_on_ring(method):
    return lt.integrate(ring_system(), Ring().random(0), (0.0, 2.0), 0.1, method)


def test_the_algebra():
    assert mf.testing.check_algebra(OSCILLATOR).passed
    quadratic = OSCILLATOR.casimirs(2)
    system = lt.LiePoissonSystem(OSCILLATOR, lt.Quadratic([1.0, 2.0, 3.0, 1.0]), quadratic[0], Steep(0.1))
    assert lt.integrate(system, [0.5, 0.2, 1.0, 0.7], (0.0, 5.0), 0.05).audit().passed


def test_the_group():
    body = lt.LiePoissonSystem(AFFINE.algebra, lt.Quadratic([1.0, 2.0]), group=AFFINE)
    run = lt.integrate(body, [0.3, 0.8], (0.0, 2.0), 0.05, attitude=np.eye(2))
    assert run.audit().passed
    assert float(np.max(AFFINE.defect(run.attitude))) < 1e-13


def test_the_space():
    run = run_on_ring(lt.MetriplecticMidpoint())
    assert np.ptp(run.energy) < 1e-14
    assert run.entropy[-1] > run.entropy[0]
    assert Ring().belongs(run.x).all()


def test_the_dissipation():
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), lt.Quadratic(np.ones(3)), Steep(0.2))
    assert lt.integrate(system, [0.5, 0.2, 1.0], (0.0, 5.0), 0.05).audit().passed


def test_the_integrator():
    run = lt.integrate(lt.models.rigid_body(), [0.5, 0.2, 1.0], (0.0, 5.0), 0.05, Simpson())
    assert run.audit().passed


@pytest.mark.slow
@pytest.mark.parametrize(
    "suite",
    [
        lambda: mf.testing.check_group(AFFINE),
        lambda: mf.testing.check_space(Ring()),
        lambda: run_on_ring(lt.MetriplecticRungeKutta(4)).audit(),
        lambda: lt.testing.check_dissipation(Steep(0.2), mf.so(3)),
        lambda: lt.testing.check_method(Simpson()),
        lambda: lt.testing.check_system(prey(), START),
    ],
    ids=["group", "space", "motion in it", "dissipation", "integrator", "system"],
)
def test_each_in_the_suite_of_its_kind(suite):
    assert suite().passed


def test_the_system():
    run = lt.integrate(prey(), START, (0.0, 20.0), 0.1, lt.MetriplecticRungeKutta(6))
    assert run.audit().passed
    with pytest.raises(lt.InputError, match="no members"):
        lt.integrate(prey(), [1.0, -1.0, 1.0], (0.0, 1.0), 0.1)


def test_what_an_addition_costs():
    """Each file has at most 30 lines, with its imports and its docstring."""
    lines = {path.stem: len(path.read_text().splitlines()) for path in Path(__file__).parent.glob("[a-s]*.py")}
    assert set(lines) == {"algebra", "dissipation", "group", "integrator", "space", "system"}
    assert max(lines.values()) <= 30, lines
