"""Systems on manifolds without charts: order, laws and constraints in the space around, and rejected input."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.integrators import InCharts
from liethermo.integrators.levels import project_implicit_step
from liethermo.runs.preparation import prepare_system_and_method
from tests.manifolds.spaces.test_own_spaces import Ellipsoid

RK4 = lt.MetriplecticRungeKutta(4)
RK8 = lt.MetriplecticRungeKutta(8)
GAUSS = lt.MetriplecticGauss(2)
MIDPOINT = lt.MetriplecticMidpoint()

STEPS = {2: (20, 40), 4: (10, 20), 8: (6, 9)}
"""Numbers of steps, by order."""

MAX_SPACE_RESIDUAL = 4e-15
"""Largest residual of a state, relative to it; at most 7e-16 seen after 10^4 steps."""

SPACES = {
    "sphere": lambda: mf.Sphere(2),
    "SPD": lambda: mf.SPD(2),
    "Stiefel": lambda: mf.Stiefel(3, 2),
    "hyperboloid": lambda: mf.Hyperbolic(2),
    "rotations": lambda: mf.SpecialOrthogonal(3),
    "unitary": lambda: mf.SpecialUnitary(2),
    "motions": lambda: mf.SpecialEuclidean(2),
    "subspaces": lambda: mf.Grassmann(3, 1),
    "correlations": lambda: mf.Correlation(3),
    "flags": lambda: mf.Flag(1, 1, 1),
    "volume": lambda: mf.GroupSpace(mf.SL(2), np.diag([1.0, 2.0, 2.0])),
    "product": lambda: mf.Sphere(2) * mf.Euclidean(2),
    "power": lambda: mf.Sphere(2) ** 2,
    "ellipsoid": lambda: Ellipsoid((1.0, 1.5, 2.0)),
}
"""Spaces by name; the last has no equations, only a projection."""

STEP_REFINEMENTS = {"hyperboloid": 4}
"""Factors on the numbers of steps for spaces with a faster motion."""


def relaxing(space: mf.Space) -> lt.MetriplecticSystem:
    """Return a system without symmetries, neither energy nor entropy quadratic, with the metric of the space."""
    random = np.random.default_rng(5)
    (a, b), Q = random.standard_normal((2, space.size)), random.standard_normal((space.size, space.size))
    Q = -(Q @ Q.T) / space.size

    def energy(x):
        v = space.to_vector(x)
        return v @ a + 0.1 * jnp.sin(v @ b)

    def entropy(x):
        v = space.to_vector(x)
        return 0.5 * v @ Q @ v + 0.2 * jnp.cos(v @ a)

    return lt.MetriplecticSystem(None, energy, entropy, lt.ProjectedMetric(normalized=True), space=space)


def start(space: mf.Space) -> np.ndarray:
    return np.asarray(space.to_vector(space.random(3)))


def reference(system: lt.MetriplecticSystem, x0, T: float) -> np.ndarray:
    """Return SciPy's solution of the field on the manifold, in the arrays around it."""
    field = jax.jit(lambda x: system.vector_field(x))
    solution = solve_ivp(lambda t, x: np.asarray(field(x)), (0.0, T), x0, method="DOP853", rtol=1e-12, atol=1e-13)
    return solution.y[:, -1]


@pytest.mark.sampled("sphere-MetriplecticRungeKutta(order=4)")
@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param(name, method, id=f"{name}-{method}")
        for i, name in enumerate(SPACES)
        for method in ((RK4, GAUSS), (MIDPOINT, RK8))[i % 2]
    ],
)
def test_order_laws_and_constraints(name, method):
    space = SPACES[name]()
    system, x0, T = relaxing(space), start(space), 1.0
    exact, errors = reference(system, x0, T), []
    steps = [STEP_REFINEMENTS.get(name, 1) * n for n in STEPS[method.order]]
    for n in steps:
        run = lt.integrate(system, x0, (0.0, T), T / n, method)
        assert run.audit().passed, run.audit()
        assert run.audit().energy_drift <= 1e-14
        assert run.stats.least_entropy_increment > 0.0
        assert float(space.residual(system.points(run.x)).max()) <= MAX_SPACE_RESIDUAL
        errors.append(np.abs(run.x[-1] - exact).max())
    slope = np.log(errors[0] / errors[1]) / np.log(steps[1] / steps[0])
    assert errors[-1] < 1e-12 or abs(slope - method.order) < 0.12 * method.order, (errors, slope)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "SPD", "Stiefel", "hyperboloid", "rotations"])
def test_with_charts_and_without(name):
    """Runs in charts and without agree within their errors."""
    space = SPACES[name]()
    system, x0 = relaxing(space), start(space)
    runs = [lt.integrate(system, x0, (0.0, 1.0), 0.05, m) for m in (GAUSS, lt.MetriplecticGauss(2, retraction="exp"))]
    assert np.abs(runs[0].x - runs[1].x).max() < 1e-5


def test_the_embedded_system_runs_unless_a_retraction_is_given():
    """Without a retraction a spin runs without chart and projection; with a retraction it runs in charts."""
    spin = lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), lambda s: s[0] ** 4 + s[1] ** 2, space=mf.Sphere(2))
    system, method = prepare_system_and_method(spin, GAUSS)
    assert type(system).__name__ == "EmbeddedSystem"
    assert system.is_tangent
    assert method == GAUSS
    chart_run = prepare_system_and_method(spin, lt.MetriplecticGauss(2, retraction="exp"))
    assert chart_run[0] is spin
    assert isinstance(chart_run[1], InCharts)

    def tensor(x):
        a, b, c = x
        c = c + jnp.sum(x**2) - 1.0  # off the sphere it is no longer tangent
        return jnp.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])

    not_tangent = lt.MetriplecticSystem(tensor, lambda s: s[0] ** 4 + s[1] ** 2, space=mf.Sphere(2))
    assert not prepare_system_and_method(not_tangent, GAUSS)[0].is_tangent
    x0 = np.array([0.6, 0.64, 0.48])
    ends = [lt.integrate(s, x0, (0.0, 1.0), 0.01, GAUSS).x[-1] for s in (spin, not_tangent)]
    assert np.abs(ends[0] - ends[1]).max() < 1e-6
    assert abs(np.linalg.norm(ends[1]) - 1.0) < MAX_SPACE_RESIDUAL


def test_a_step_out_of_the_domain_ends_the_run():
    """A covariance that would lose its rank in one long step ends the run with a status, not with NaN."""
    shrinking = lt.MetriplecticSystem(
        None, lambda P: 3.0 * jnp.trace(P), dissipation=lt.Friction(np.ones(4)), space=mf.SPD(2), validate=False
    )
    run = lt.integrate(shrinking, np.eye(2), (0.0, 2.0), 0.25, RK4, on_failure="return")
    assert run.status.code == "non_finite"
    assert "leaves SPD(2): not positive definite" in run.status.message
    assert "t = 0.25" in run.status.message
    assert np.isfinite(run.x).all()
    assert len(run.t) == 2


def sphere_system(energy):
    return lt.MetriplecticSystem(None, energy, lambda x: x[1], lt.ProjectedMetric(), space=mf.Sphere(2))


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: sphere_system(lambda x: jnp.log(x[0] - 2.0)), lt.InputError, "not finite at any of the 4 test points"),
        (lambda: sphere_system(lambda x: x[0] * x[:2]), lt.FunctionError, r"the energy must return one number.*\(2,\)"),
        (
            lambda: lt.integrate(sphere_system(lambda x: x[0]), [1.0, 1.0, 0.0], (0.0, 1.0), 0.1, RK4),
            mf.OffManifoldError,
            r"S\^2: .*is off the space: residual 0\.414.*project=True",
        ),
        (
            lambda: lt.integrate(sphere_system(lambda x: x[0]), [1.0, np.nan, 0.0], (0.0, 1.0), 0.1, RK4),
            ValueError,
            "not finite",
        ),
    ],
)
def test_invalid_systems_and_points_are_rejected_in_one_line(build, error, message):
    with pytest.raises(error, match=message) as refusal:
        build()
    assert "\n" not in str(refusal.value)


def test_a_start_where_the_energy_is_not_finite_ends_the_run_with_a_reason():
    system = sphere_system(lambda x: jnp.log(x[0]) + x[1])
    with pytest.raises(lt.IntegrationError, match="energy") as refusal:
        lt.integrate(system, [-1.0, 0.0, 0.0], (0.0, 1.0), 0.1, RK4)
    assert "not finite" in str(refusal.value)


def test_a_point_near_the_space_keeps_its_level():
    """An accepted point near the space is not moved: it stays on the level on which it begins."""
    system = relaxing(mf.Sphere(2))
    x0 = np.array([0.6, 0.64, 0.48]) * (1.0 + 1e-10)
    run = lt.integrate(system, x0, (0.0, 1.0), 0.1, RK4)
    assert np.abs(np.linalg.norm(run.x, axis=1) - (1.0 + 1e-10)).max() < 1e-13
    with pytest.raises(mf.OffManifoldError):
        lt.integrate(system, 1.1 * x0, (0.0, 1.0), 0.1, RK4)


@pytest.mark.slow
def test_events_dense_output_and_adaptive_steps():
    space = mf.Stiefel(3, 2)
    system, x0 = relaxing(space), start(space)
    run = lt.integrate(system, x0, (0.0, 3.0), lt.Adaptive(1e-8), RK8, dense=True, until=lambda X: X[0, 0] - 0.1)
    states = run(np.linspace(0.0, run.t[-1], 20))
    assert float(space.residual(system.points(states)).max()) <= MAX_SPACE_RESIDUAL
    assert np.abs(states[-1] - reference(system, x0, run.t[-1])).max() < 1e-6


@pytest.mark.slow
def test_an_ensemble_is_its_runs_and_a_flow_has_derivatives():
    space = mf.Sphere(2)
    system = relaxing(space)
    x0s = np.asarray(space.random(1, (3,)))
    ensemble = lt.ensemble(system, x0s, (0.0, 1.0), 0.1, RK4)
    for i, x0 in enumerate(x0s):
        assert np.array_equal(ensemble.x[i], lt.integrate(system, x0, (0.0, 1.0), 0.1, RK4).x[-1])
    v = np.asarray(space.random_tangent(2, x0s[0]))
    for method in (RK4, GAUSS):

        def end(t, method=method):
            return lt.flow(system, space.exp(x0s[0], t * v), (0.0, 1.0), 0.1, method)

        derivative = jax.jvp(end, (0.0,), (1.0,))[1]
        quotient = (end(1e-5) - end(-1e-5)) / 2e-5
        assert np.abs(derivative - quotient).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "Stiefel"])
def test_noise_stays_on_the_space(name):
    space = SPACES[name]()
    system = relaxing(space)
    run = lt.integrate(system, start(space), (0.0, 2.0), 0.01, noise=lt.Fluctuations(1e-2, seed=1))
    assert float(space.residual(system.points(run.x)).max()) <= MAX_SPACE_RESIDUAL
    assert run.audit().energy_drift <= 1e-14


@pytest.mark.slow
def test_an_energy_that_depends_on_time():
    space = mf.Sphere(2)
    system = lt.MetriplecticSystem(
        mf.LiePoisson(mf.so(3)), lambda s, t: s[0] * jnp.sin(t) + s[2] ** 2, space=space, validate=False
    )
    x0 = np.array([0.6, 0.64, 0.48])
    runs = [lt.integrate(system, x0, (0.0, 2.0), 0.05, m) for m in (RK4, lt.MetriplecticGauss(2, retraction="exp"))]
    assert np.abs(runs[0].x - runs[1].x).max() < 1e-5
    assert runs[0].audit().passed
    assert np.abs(np.linalg.norm(runs[0].x, axis=1) - 1.0).max() < MAX_SPACE_RESIDUAL


def hypersphere():
    from geomstats.geometry.hypersphere import Hypersphere

    return Hypersphere(2)


def spd_matrices():
    from geomstats.geometry.spd_matrices import SPDMatrices

    return SPDMatrices(2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("space", "theirs"),
    [(mf.Sphere(2), hypersphere), (mf.SPD(2), spd_matrices)],
    ids=["sphere", "SPD"],
)
def test_gradient_flows_run_along_the_geodesics_of_geomstats(space, theirs):
    """The gradient flow of half the squared distance from p follows the geodesic to p; its length falls by exp(-t)."""
    metric, p, x0 = theirs().metric, np.asarray(space.random(1)), np.asarray(space.random(2))

    def half_the_square(x):
        v = space.log(p, x)
        return 0.5 * space.inner(p, v, v)

    system = lt.MetriplecticSystem(None, half_the_square, dissipation=lt.Friction(), space=space)
    run = lt.integrate(system, x0, (0.0, 1.0), 0.05, RK8)
    exact = np.array([metric.exp(np.exp(-t) * metric.log(x0, p), p) for t in run.t])
    assert np.abs(system.points(run.x) - exact).max() < 1e-11
    assert run.audit().passed


@pytest.mark.parametrize(("residual", "is_kept"), [(1e-13, True), (1e-11, False)])
def test_an_implicit_step_that_stays_off_the_surface_has_failed(residual, is_kept):
    no_laws = SimpleNamespace(energy=None, energy_law=None, entropy=None, entropy_law=None)
    surface = SimpleNamespace(project_displacement=lambda x, compensation, d: (d, residual * jnp.linalg.norm(x)))
    x, d = jnp.array([3.0, 4.0]), jnp.array([0.1, 0.2])
    projected = project_implicit_step(no_laws, surface, [], x, jnp.zeros(2), d)
    assert bool(jnp.all(projected == d)) if is_kept else bool(jnp.isnan(projected).all())
