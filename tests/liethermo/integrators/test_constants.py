"""A constant added to the energy, or to the entropy, changes only the rounding of their values."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.cases import few_combinations

EPS = np.finfo(float).eps
QUARTIC_ENERGY = lambda x: 0.5 * x @ x + 0.1 * x[0] ** 4  # noqa: E731
EXPLICIT = [lt.MetriplecticRungeKutta(4), lt.MetriplecticTaylor(8)]
IMPLICIT = [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(1), lt.MetriplecticGauss(2), lt.MetriplecticGauss(4)]


def damped_system(constant, friction=None):
    friction = lt.Friction() if friction is None else friction
    return lt.MetriplecticSystem(None, lambda x: QUARTIC_ENERGY(x) + constant, None, friction, space=mf.Euclidean(2))


def oscillator_system(constant):
    return lt.MetriplecticSystem(jnp.array([[0.0, 1.0], [-1.0, 0.0]]), lambda x: QUARTIC_ENERGY(x) + constant, dim=2)


def energy_difference(build, constant, method, steps, h, **options):
    """Return the largest difference, less the constant, to the energies without the constant, and the run."""
    reference, run = (
        lt.integrate(build(c), [1.0, 0.5], (0.0, h * steps), h, method, save_every=max(1, steps // 100), **options)
        for c in (0.0, constant)
    )
    levels = [np.array([QUARTIC_ENERGY(x) for x in s.x]) for s in (reference, run)]
    return np.abs(levels[1] - levels[0]).max(), run


@pytest.mark.sampled(1)
@pytest.mark.parametrize("constant", [1.0, -1.0, 100.0, 1e4])
def test_a_state_that_relaxes(constant):
    """Relaxation goes on beside a constant; it once ended at t = 3 beside 1, at t = 0.6 beside 100."""
    change, run = energy_difference(damped_system, constant, EXPLICIT[0], 500, 0.1)
    assert run.status.ok
    assert run.audit().passed
    assert change <= 8 * EPS * abs(constant) + 1e-14
    assert np.abs(run.x[-1]).max() <= 1e-20


@pytest.mark.sampled(1)
@few_combinations(build=[damped_system, oscillator_system], constant=[1e3, 1e4, 1e8], method=[*EXPLICIT, *IMPLICIT])
def test_a_constant_does_not_change_the_motion(build, constant, method):
    change, run = energy_difference(build, constant, method, 1000, 0.1)
    assert run.audit().passed
    assert change <= 8 * EPS * constant


def test_long_steps_beside_a_constant():
    """The tolerance for rounding in the solver is below that of an audit."""
    change, run = energy_difference(oscillator_system, 1e3, lt.MetriplecticGauss(4), 4000, 0.25)
    assert run.audit().passed
    assert change <= 8 * EPS * 1e3


@pytest.mark.slow
@pytest.mark.parametrize("method", [*EXPLICIT, lt.MetriplecticGauss(2)], ids=str)
def test_a_hundred_thousand_steps_near_equilibrium(method):
    for build in (damped_system, oscillator_system):
        change, run = energy_difference(build, 1e4, method, 100_000, 0.1)
        assert run.audit().passed
        assert change <= 8 * EPS * 1e4


def test_a_state_that_vanishes():
    """The run goes on where the squares of the state are below the smallest numbers."""
    run = lt.integrate(damped_system(0.0), [1.0, 0.5], (0.0, 400.0), 0.1, EXPLICIT[0], save_every=100)
    assert run.status.ok
    assert np.abs(run.x[-1]).max() <= 1e-150


@pytest.mark.slow
def test_an_entropy_with_a_constant():
    """Explicit steps hold the entropy by its values too, and a constant does not disturb them."""

    def body(constant):
        energy = lambda m: 0.5 * m @ (m / jnp.array([1.0, 2.0, 3.0])) + 0.1 * m[0] ** 4 + constant  # noqa: E731
        entropy = lambda m: jnp.log(m @ m) + constant  # noqa: E731
        return lt.LiePoissonSystem(mf.so(3), energy, entropy, lt.KillingDissipation(0.5))

    reference, run = (lt.integrate(body(c), [0.9, 0.3, 0.2], (0.0, 20.0), 0.1, EXPLICIT[0]) for c in (0.0, 1e4))
    assert run.audit().passed
    assert np.abs(run.x - reference.x).max() <= 1e4 * 64 * EPS


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_engines_and_adaptive_steps(engine):
    runs = [
        lt.ensemble(
            damped_system(c), np.array([[1.0, 0.5]]), (0.0, 20.0), lt.Adaptive(rtol=1e-8), EXPLICIT[0], engine=engine
        )
        for c in (0.0, 1e4)
    ]
    assert all(run.ok.all() for run in runs)
    assert np.abs(runs[1].x - runs[0].x).max() <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticGauss(1)], ids=str)
@pytest.mark.parametrize("space", [mf.SPD(2), mf.Sphere(2), mf.Stiefel(3, 2)], ids=lambda space: space.name)
def test_a_constant_on_manifolds(space, method):
    def energy(x):
        return jnp.sum(jnp.asarray([[1.0, 0.2], [0.2, 2.0]]) * (x.T @ x)) if x.ndim == 2 else x[0] + 0.4 * x[1] ** 4

    levels = []
    for c in (0.0, 1e4):
        build = lambda x, c=c: energy(x) + c  # noqa: E731
        system = lt.MetriplecticSystem(None, build, None, lt.Friction(rate=0.2), space=space)
        run = lt.integrate(system, space.random(0), (0.0, 2.0), 0.05, method)
        assert run.audit().passed
        levels.append(run.energy - c)
    assert np.abs(levels[1] - levels[0]).max() <= 16 * EPS * 1e4
