"""Noise on manifolds: points of them, exact energy on every path, and the measure with the volume of each space."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.testing import check_equilibrium
from tests.additions.group import AFFINE
from tests.additions.space import Ring
from tests.cases import BuiltOnUse

SPHERE = mf.Sphere(2)
T = 0.8
BATH = lt.Fluctuations(1.0, seed=1, temperature=T)
NOISE = lt.Fluctuations(1.0, seed=1)
A = np.array([[1.0, 0.2, 0.0], [0.0, 0.5, 0.0], [0.3, 0.0, -0.7]])


def spins(x):
    return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def field(x):
    return 0.3 * x[0] - 1.5 * x[2]


def level(x):
    return x[0] ** 2 + 2.0 * x[1] ** 2 + 3.5 * x[2] ** 2 + 0.2 * x[2]


def tilted_entropy(x):
    return 1.5 * x[0] + x[1] * x[2]


def damped_system(space, energy, dissipation=None, poisson=None):
    return lt.MetriplecticSystem(poisson, energy, None, dissipation or lt.Friction(rate=0.5), space=space)


def system_on_level(dissipation):
    return lt.MetriplecticSystem(None, level, tilted_entropy, dissipation, space=SPHERE)


@functools.cache
def normalised_system_on_level():
    return system_on_level(lt.ProjectedMetric(normalized=True, rate=0.5))


@functools.cache
def spin():
    return damped_system(SPHERE, field, lt.DoubleBracket(0.5), spins)


START = np.array([0.6, 0.0, 0.8])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "noise"), [(spin, BATH), (normalised_system_on_level, NOISE)], ids=["bath", "level"]
)
def test_paths_stay_on_the_space_and_on_their_level(system, noise):
    """By both engines the same."""
    array, compiled_run = (
        lt.integrate(system(), START, (0.0, 5.02), 0.05, noise=noise, engine=e) for e in ("array", "compiled")
    )
    assert np.abs(array.x - compiled_run.x).max() < 1e-12
    assert np.abs(np.diff(array.x, axis=0)).max() > 0.1
    for solution in (array, compiled_run):
        assert solution.audit().passed, str(solution.audit())
        assert np.abs(np.linalg.norm(solution.x, axis=1) - 1.0).max() < 1e-14
        if noise is NOISE:
            assert solution.audit().energy_drift < 2e-15
            assert np.diff(solution.entropy).min() < -1e-3


def test_ensembles_take_the_paths_of_single_runs():
    ensemble = lt.ensemble(spin(), np.tile(START, (5, 1)), (0.0, 1.0), 0.05, noise=BATH)
    one = lt.integrate(spin(), START, (0.0, 1.0), 0.05, noise=BATH.of(3))
    assert np.abs(one.x[-1] - ensemble.x[3]).max() < 1e-13
    assert len({x.tobytes() for x in ensemble.x}) == 5


def test_no_noise_is_the_run_without_to_the_bit():
    arguments = spin(), START, (0.0, 2.0), 0.05
    quiet = lt.integrate(*arguments, noise=lt.Fluctuations(0.0), engine="compiled")
    assert np.array_equal(quiet.x, lt.integrate(*arguments, method=lt.MetriplecticMidpoint(), engine="compiled").x)


def test_noise_and_motion_are_checked():
    report = BATH.check(spin())
    assert report.passed
    assert "no: the equilibrium measure" not in str(report)
    shrinking = damped_system(SPHERE, field, poisson=lambda x: (1.0 + 0.5 * x[0]) * spins(x))  # a Poisson tensor too
    assert "no: the equilibrium measure" in str(BATH.check(shrinking))
    density = lt.Fluctuations(1.0, temperature=T, density=lambda x: -jnp.log(1.0 + 0.5 * x[0]))
    assert "no: the equilibrium measure" not in str(density.check(shrinking))


def test_what_has_no_noise():
    system_without_noise = system_on_level(lt.ProjectedMetric(np.diag([1.0, 2.0, 3.0])))
    with pytest.raises(lt.InputError, match=r"ProjectedMetric gives no factor .* on S\^2"):
        lt.integrate(system_without_noise, START, (0.0, 1.0), 0.1, noise=NOISE)


@pytest.mark.slow
def test_a_driven_spin_in_a_bath():
    """The ledger has the work of the field; a density is one of the body's state."""
    system = damped_system(SPHERE, lambda x, t: field(x) + 0.5 * x[0] * jnp.cos(3.0 * t), lt.DoubleBracket(0.5), spins)
    noise = lt.Fluctuations(1.0, seed=1, temperature=T, density=lambda x: 0.1 * x[2])
    solution = lt.integrate(system, START, (0.0, 3.0), 0.05, noise=noise)
    assert solution.audit().passed, str(solution.audit())
    assert np.abs(np.linalg.norm(solution.x, axis=1) - 1.0).max() < 1e-14
    assert np.ptp(solution.casimirs["work"]) > 0.1


def rotations(count):
    points = np.asarray(mf.SpecialOrthogonal(3).random(3, (count,)))
    return points.reshape(count, 9), np.exp(np.einsum("ij,nij->n", A, points) / T)


def frames(count):
    points = np.asarray(mf.Stiefel(3, 2).random(3, (count,)))
    return points.reshape(count, 6), np.exp(np.einsum("ij,nij->n", A[:, :2], points) / T)


def spin_states(count):
    points = np.asarray(SPHERE.random(3, (count,)))
    return points, np.exp(-field(points.T) / T)


def states_near_the_level(count):
    """Return points of a thin shell about the level of H, whose thickness gives the measure, and weights exp(S)."""
    points = np.asarray(SPHERE.random(3, (40 * count,)))
    points = points[(np.abs(level(points.T) - level(START)) < 0.01) & (points[:, 2] > 0.0)]
    return points, np.exp(tilted_entropy(points.T))


def hyperbolic_points(count):
    r, angle = (a.ravel() for a in np.meshgrid(np.linspace(0.005, 6.0, count // 200), np.arange(200) * np.pi / 100))
    points = np.stack([np.cosh(r), np.sinh(r) * np.cos(angle), np.sinh(r) * np.sin(angle)], axis=1)
    return points, np.sinh(r) * np.exp(-_hyperbolic(points.T) / T)


def _hyperbolic(x):
    return 1.5 * (x[0] - 1.0) + 0.4 * x[1]


def affine_maps(count):
    """The left-invariant volume is da db / a^2, which right translations change: the group is not unimodular."""
    side = np.linspace(-5.0, 5.0, int(np.sqrt(count)))
    u, b = (a.ravel() for a in np.meshgrid(side, side))
    a = np.exp(u)
    return np.stack([a, b, 0.0 * a, 1.0 + 0.0 * a], axis=1), np.exp(-u - _affine([a, b]) / T)


def _affine(x):
    return 1.5 * (x[0] + 1.0 / x[0]) + x[1] ** 2 * (1.0 + 0.5 * x[0] / (1.0 + x[0]))


def ring_points(count):
    u, v = (a.ravel() for a in np.meshgrid(*[np.linspace(0.0, 2.0 * np.pi, int(np.sqrt(count)), endpoint=False)] * 2))
    radius = 3.0 + np.cos(v)
    points = np.stack([radius * np.cos(u), radius * np.sin(u), np.sin(v)], axis=1)
    return points, radius * np.exp(-_ring(points.T) / T)


def _ring(x):
    return 0.3 * x[0] + 0.5 * x[2]


def definite_matrices(count):
    """The invariant volume is det^(-3/2) dx."""
    side = np.linspace(-4.0, 4.0, round(count ** (1 / 3)))
    u, v, q = (a.ravel() for a in np.meshgrid(side, side, np.linspace(-1.0, 1.0, len(side) + 2)[1:-1]))
    a, d = np.exp(u), np.exp(v)
    b = q * np.sqrt(a * d)
    points = np.stack([a, b, b, d], axis=1)
    return points, (1.0 - q * q) ** -1.5 * np.exp(-_definite(points.T) / T)


def _definite(x):
    return (x[0] + x[3]) * (1.0 + 0.7 / (x[0] * x[3] - x[1] * x[2]))


PAIR = mf.Sphere(2) * mf.Euclidean(1)


def pairs(count):
    points, z = np.asarray(SPHERE.random(3, (count,))), np.random.default_rng(0).standard_normal((count, 1))
    states = np.concatenate([points, z], axis=1)
    return states, np.exp(-_pair(states.T) / T + z[:, 0] ** 2 / 2.0)


def _pair(x):
    return x[3] ** 2 * (1.0 + 0.5 * x[2]) - x[2]


CASES = BuiltOnUse(
    {
        "spin": lambda: (spin(), BATH, spin_states, START),
        "rotations": lambda: (
            damped_system(mf.SpecialOrthogonal(3), lambda R: -jnp.sum(A * R)),
            BATH,
            rotations,
            np.eye(3),
        ),
        "frames": lambda: (
            damped_system(mf.Stiefel(3, 2), lambda R: -jnp.sum(A[:, :2] * R)),
            BATH,
            frames,
            np.eye(3)[:, :2],
        ),
        "hyperbolic": lambda: (damped_system(mf.Hyperbolic(2), _hyperbolic), BATH, hyperbolic_points, [1.0, 0.0, 0.0]),
        "definite": lambda: (
            damped_system(mf.SPD(2), lambda x: _definite(x.ravel())),
            BATH,
            definite_matrices,
            np.eye(2),
        ),
        "affine": lambda: (
            damped_system(mf.GroupSpace(AFFINE), lambda x: _affine(x.ravel())),
            BATH,
            affine_maps,
            np.eye(2),
        ),
        "ring": lambda: (damped_system(Ring(), _ring), BATH, ring_points, None),
        "product": lambda: (damped_system(PAIR, _pair), BATH, pairs, [0.6, 0.0, 0.8, 0.0]),
        "level": lambda: (normalised_system_on_level(), NOISE, states_near_the_level, START),
        "level, not normalised": lambda: (
            system_on_level(lt.ProjectedMetric(rate=0.1)),
            NOISE,
            states_near_the_level,
            START,
        ),
    }
)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_equilibria_with_the_volume_of_the_space(name):
    """``exp(-H / (k T))``, or ``exp(S / k)`` on the level of H, times Riemannian volume."""
    system, noise, samples, start = CASES[name]
    points, weights = samples(100_000)
    if start is None:  # where it would take long to get around: paths that start there stay there
        start = points[np.random.default_rng(1).choice(len(points), 1000, p=weights / weights.sum())]
    else:
        start = np.asarray(start, dtype=float).ravel()
    check_equilibrium(system, noise, start, 12.0, 0.02, paths=1000, samples=(points, weights))


@pytest.mark.slow
def test_noise_moves_a_state_far_on_a_surface_of_no_degree():
    """The energy cannot be changed along its gradient where it is least: noise has no law of the energy to hold."""
    system, noise, samples, _ = CASES["ring"]
    ensemble = lt.ensemble(system, samples(100)[0], (0.0, 3.0), 0.02, noise=noise)
    assert ensemble.ok.all()
    assert (
        system.space.residual(ensemble.x).max() < 1e-13
    )  # differences of values of size 4, 64 roundings of which count


@pytest.mark.slow
def test_the_energy_is_exact_on_a_thousand_paths_of_ten_thousand_steps():
    ensemble = lt.ensemble(normalised_system_on_level(), np.tile(START, (1000, 1)), (0.0, 200.0), 0.02, noise=NOISE)
    assert ensemble.ok.all()
    assert ensemble.energy_drift.max() < 1e-13
