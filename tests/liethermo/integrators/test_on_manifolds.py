"""Systems on manifolds: orders, laws at every step, membership, geomstats spaces, both engines, rejected input."""

from __future__ import annotations

import geomstats.geometry.hypersphere as gs_hypersphere
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

TOLERANCES = {
    # name: (bound, what was measured and why)
    "energy": (1e-13, "relative drift over 10^4 steps; at most 3e-14 seen, the walk of the roundings of points"),
    "member": (1e-15, "relative residual of a state; at most 7e-16 seen, after 10^5 steps as after one"),
    "entropy": (2 * float(np.finfo(float).eps), "fall in a step, relative to entropy_size; at most 1 eps seen"),
    "engines": (1e-12, "difference of the engines' trajectories; at most 3e-14 seen"),
    "twin": (1e-10, "difference to geomstats, whose derivatives are differences; at most 3e-12 seen"),
}


def tolerance(name: str) -> float:
    return TOLERANCES[name][0]


INERTIA = np.array([1.0, 2.0, 4.0])
SPHERE = mf.Sphere(2)
SPIN = mf.LiePoisson(mf.so(3))
BATH = mf.Sphere(2) * mf.Euclidean(1)
START = np.array([0.6, 0.64, 0.48])


def cubic(s):
    """Return the energy of a spin, which is not quadratic."""
    return jnp.sum((s[:3] ** 2 + 2 / 3 * s[:3] ** 3) / (2 * INERTIA))


def free_spin(space=SPHERE) -> lt.MetriplecticSystem:
    """Return a spin ``s' = s x grad H`` without entropy, as every Casimir is constant on a sphere."""
    return lt.MetriplecticSystem(SPIN, cubic, space=space, validate=False)


def relaxing_spin() -> lt.MetriplecticSystem:
    """Return a spin that heats a bath of temperature ``exp(S)`` by its damping."""
    return lt.MetriplecticSystem(
        mf.LiePoisson(mf.direct_sum(mf.so(3), mf.abelian(1))),
        lambda x: cubic(x) + jnp.exp(x[3]),
        lambda x: x[3],
        lt.ProjectedMetric(rate=0.3),
        space=BATH,
    )


def relaxing_frame() -> lt.MetriplecticSystem:
    """Return a rotation that climbs an entropy at constant energy."""
    A, B = np.array([[1.0, 0.2, 0.0], [0.1, 2.0, 0.3], [0.0, -0.2, 0.5]]), np.diag([1.2, -1.8, 0.9]) + 0.2
    return lt.MetriplecticSystem(
        None,
        lambda R: jnp.sum(A * R) + 0.3 * R[0, 0] ** 3,
        lambda R: jnp.sum(B * R) + 0.1 * jnp.sin(R[1, 2]),
        lt.ProjectedMetric(normalized=True),
        space=mf.SpecialOrthogonal(3),
        validate=False,
    )


def relaxing_covariance() -> lt.MetriplecticSystem:
    """Return a covariance that climbs ``log det`` at constant ``tr(A P)``, to a multiple of the inverse of A."""
    A = np.array([[1.0, 0.2, 0.0], [0.2, 2.0, 0.3], [0.0, 0.3, 0.5]])
    return lt.MetriplecticSystem(
        None,
        lambda P: jnp.sum(A * P) + 0.05 * P[0, 1] ** 3,
        lambda P: jnp.log(_determinant(P)),
        lt.ProjectedMetric(normalized=True),
        space=mf.SPD(3),
        validate=False,
    )


def _determinant(P):
    return jnp.dot(P[0], jnp.cross(P[1], P[2]))


def starts(name: str):
    if name == "frame":
        return np.asarray(mf.SO(3).exp(np.array([0.3, -0.5, 0.8])))
    if name == "covariance":
        return np.array([[1.0, 0.5, 0.2], [0.5, 1.5, -0.4], [0.2, -0.4, 0.8]])
    return START if name == "spin" else np.append(START, 0.0)


CASES = {"spin": free_spin, "bath": relaxing_spin, "frame": relaxing_frame, "covariance": relaxing_covariance}
"""Systems by name; each comes with an initial point of :func:`starts`."""

MIDPOINT = lt.MetriplecticMidpoint()
GAUSS = lt.MetriplecticGauss(2)

RUNS = [
    pytest.param("bath", GAUSS, id="bath-gauss2"),
    pytest.param("frame", MIDPOINT, id="frame-midpoint"),
    pytest.param("covariance", lt.MetriplecticMidpoint(retraction="midpoint_euclidean"), id="covariance-euclidean"),
    *(
        pytest.param(name, method, id=f"{name}-{kind}")
        for name, method, kind in [
            ("spin", lt.MetriplecticMidpoint("mean_value"), "mean_value"),
            ("spin", lt.MetriplecticMidpoint(retraction="exp"), "midpoint-exp"),
            ("spin", lt.MetriplecticGauss(1), "gauss1"),
            ("spin", GAUSS, "gauss2"),
            ("spin", lt.MetriplecticGauss(3), "gauss3"),
            ("spin", lt.MetriplecticGauss(2, retraction="midpoint"), "gauss2-midpoint"),
            ("bath", MIDPOINT, "midpoint"),
            ("frame", GAUSS, "gauss2"),
            ("covariance", MIDPOINT, "midpoint"),
            ("frame", lt.MetriplecticGauss(2, retraction="cayley"), "gauss2-cayley"),
            ("frame", lt.MetriplecticMidpoint(retraction="midpoint_cayley"), "midpoint-cayley"),
            ("covariance", GAUSS, "gauss2"),
            ("covariance", lt.MetriplecticGauss(2, retraction="euclidean"), "gauss2-euclidean"),
        ]
    ),
]


@pytest.fixture(scope="module")
def build():
    """Return a function that builds each system once, by name."""
    systems: dict[str, lt.MetriplecticSystem] = {}

    def get(name):
        if name not in systems:
            systems[name] = CASES[name]()
        return systems[name]

    return get


def entropy_scale(system, x) -> float:
    """Return the scale of the rounding of S: S itself, and its change by the rounding of its argument."""
    return abs(float(system.entropy(x))) + float(np.abs(system.entropy.gradient(x)) @ np.abs(x))


def final(system, x0, method, steps, T=2.0):
    """Run and keep the last state only: one program for every number of steps."""
    return lt.integrate(system, x0, (0.0, T), T / steps, method, engine="array", save_every=steps)


@pytest.mark.sampled("spin-midpoint-exp")
@pytest.mark.parametrize(("name", "method"), RUNS)
def test_orders_and_laws(build, name, method):
    """The order is 2s against SciPy; the laws hold at each of many steps, and the last state is on the space."""
    system, x0 = build(name), starts(name)
    field = jax.jit(lambda x: system.vector_field(x))
    start = np.asarray(system.state(x0))
    exact = solve_ivp(lambda t, x: np.asarray(field(x)), (0, 2), start, method="DOP853", rtol=1e-13, atol=1e-14).y[
        :, -1
    ]
    steps = {2: [20, 40, 80], 4: [10, 20, 40], 6: [8, 10, 12]}[method.order]
    errors = np.array([np.abs(final(system, x0, method, n).x[-1] - exact).max() for n in steps])
    slopes = np.log(errors[:-1] / errors[1:]) / np.log(np.array(steps[1:]) / steps[:-1])
    assert errors[-1] > 1e-13, "at the rounding plateau nothing is measured"
    assert (np.abs(slopes - method.order) < 0.2).all(), (errors, slopes)

    solution = final(system, x0, method, 2000, T=200.0 if name == "covariance" else 40.0)
    assert solution.audit().energy_drift <= tolerance("energy")
    assert system.space.residual(system.points(solution.x[-1])) <= tolerance("member")
    if system.entropy is not None:
        size = max(entropy_scale(system, x) for x in solution.x)
        assert solution.stats.least_entropy_increment >= -tolerance("entropy") * size
        assert solution.entropy[-1] > solution.entropy[0]


def test_axioms(build):
    report = build("bath").check()
    assert report.passed
    assert {row.axiom for row in report.rows} >= {"tangent", "Pi skew", "Jacobi", "K >= 0", "energy law", "entropy law"}


# -- where it comes to rest -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_spin_comes_to_rest_where_its_energy_is_least(build):
    end = final(build("bath"), starts("bath"), GAUSS, 400, T=400.0).x[-1, :3]
    gradient = np.asarray(jax.grad(cubic)(end))
    assert np.abs(np.cross(end, gradient)).max() < 1e-7
    neighbours = SPHERE.exp(end, SPHERE.random_tangent(0, np.tile(end, (50, 1)), 0.1))
    assert float(cubic(end)) < min(float(cubic(s)) for s in neighbours)


@pytest.mark.slow
def test_a_double_bracket_on_a_sphere():
    """Landau and Lifshitz: ``Pi^2 = -1``, so the spin descends the gradient, and keeps its length."""
    system = lt.MetriplecticSystem(SPIN, cubic, dissipation=lt.DoubleBracket(0.5), space=SPHERE, validate=False)
    gradient = np.asarray(jax.grad(cubic)(START))
    descent = gradient - START * np.dot(START, gradient)
    assert np.allclose(system.vector_field(START), np.cross(START, gradient) - 0.5 * descent, atol=1e-15)
    solution = final(system, START, MIDPOINT, 400, T=40.0)
    assert solution.stats.largest_energy_increment <= 4e-16
    assert solution.energy[-1] < solution.energy[0] - 0.1


# -- other routes to the same trajectory ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", [MIDPOINT, GAUSS], ids=["midpoint", "gauss2"])
def test_a_geomstats_space_gives_the_same_trajectory(method):
    twin = mf.from_geomstats(gs_hypersphere.Hypersphere(2))
    runs = [
        lt.integrate(free_spin(space), START, (0.0, 0.6), 0.2, method, engine="array", progress=False)
        for space in (SPHERE, twin)
    ]
    assert np.abs(runs[0].x - runs[1].x).max() <= tolerance("twin")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param("spin", MIDPOINT, id="S^2-midpoint"),
        pytest.param("spin", GAUSS, id="S^2-gauss2"),
        pytest.param("frame", MIDPOINT, id="SO(3)-midpoint"),
    ],
)
def test_both_engines_take_the_same_steps(build, name, method):
    system = build(name)
    runs = [
        lt.integrate(system, starts(name), (0.0, 5.0), 0.1, method, engine=engine) for engine in ("array", "compiled")
    ]
    assert np.abs(runs[0].x - runs[1].x).max() <= tolerance("engines")


@pytest.mark.slow
def test_spins_that_do_not_interact(build):
    """A power of a space runs its copies as one batch: each spin moves as it does alone."""
    start_states = np.stack([START, -START])
    pair = lt.MetriplecticSystem(
        mf.PoissonMap(lambda x, alpha: jnp.cross(x.reshape(2, 3), alpha.reshape(2, 3)).ravel(), 6),
        lambda s: cubic(s[0]) + cubic(s[1]),
        space=SPHERE**2,
        validate=False,
    )
    pair_states = final(pair, start_states, GAUSS, 40).x[-1].reshape(2, 3)
    single_states = [final(build("spin"), s, GAUSS, 40).x[-1] for s in start_states]
    assert np.abs(pair_states - np.stack(single_states)).max() < 1e-6  # they share one correction of the gradients


# -- the rest of the interface ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_events_dense_output_and_adaptive_steps(build):
    system = build("spin")
    solution = lt.integrate(system, START, (0.0, 5.0), lt.Adaptive(1e-8), GAUSS, until=lambda s: s[2], dense=True)
    assert abs(solution.x[-1][2]) < 1e-13
    states = solution(np.linspace(0.0, solution.event_time, 50))
    assert np.asarray(SPHERE.belongs(states)).all()
    fine = lt.integrate(system, START, (0.0, 0.5), 0.01, lt.MetriplecticGauss(3))
    assert np.abs(solution(0.5) - fine.x[-1]).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bath", "frame"])
def test_membership_after_a_hundred_thousand_steps(build, name):
    system = build(name)
    solution = final(system, starts(name), MIDPOINT, 100_000, T=10_000.0)
    assert system.space.residual(system.points(solution.x[-1])) <= tolerance("member")
    assert solution.audit().energy_drift <= tolerance("energy")


# -- controls that must fail ------------------------------------------------------------------------------------------


class PlainMidpoint(lt.MetriplecticMidpoint):
    """Control: the midpoint rule with plain gradients."""

    def slopes(self, system, x, compensation, h, k):
        return system.vector_field(x + 0.5 * h * k[0])[None]


@pytest.mark.slow
def test_plain_gradients_lose_energy(build):
    solution = final(build("bath"), starts("bath"), PlainMidpoint(), 40)
    assert solution.audit().energy_drift > 1e4 * tolerance("energy")
    assert BATH.residual(solution.x[-1]) <= tolerance("member")


def test_a_tensor_that_leads_off_the_sphere_is_refused():
    with pytest.raises(lt.AxiomError, match="tangent"):
        lt.MetriplecticSystem(mf.PoissonMap(lambda x, alpha: x + alpha, 3), cubic, space=SPHERE)


# -- refusals ---------------------------------------------------------------------------------------------------------


def test_a_point_off_the_manifold(build):
    with pytest.raises(mf.OffManifoldError, match=r"residual 0\.1.*tolerance 1e-08.*project=True"):
        lt.integrate(build("spin"), 1.1 * START, (0.0, 1.0), 0.1)
    assert np.allclose(build("spin").state(SPHERE.point(1.1 * START, project=True)), START)


@pytest.mark.slow
def test_a_step_beyond_the_injectivity_radius(build):
    fast_spin = lt.MetriplecticSystem(SPIN, lambda s: 20.0 * s[2], space=SPHERE, validate=False)
    with pytest.raises(lt.NonFiniteError, match=r"as long as the domain.*injectivity radius 3\.14159") as failure:
        final(fast_spin, START, lt.MetriplecticMidpoint(retraction="midpoint"), 10, T=10.0)
    assert len(failure.value.solution.x) == 1


def test_spaces_and_retractions_that_do_not_fit(build):
    with pytest.raises(lt.InputError, match="from_geomstats"):
        lt.MetriplecticSystem(SPIN, cubic, space=gs_hypersphere.Hypersphere(2))
    with pytest.raises(lt.InputError, match="must have 9 coordinates, one for each real component"):
        lt.MetriplecticSystem(SPIN, cubic, space=mf.SpecialOrthogonal(3))
    with pytest.raises(lt.InputError, match="on R\\^n"):
        lt.integrate(lt.models.rigid_body(), START, (0, 1), 0.1, lt.MetriplecticMidpoint(retraction="exp"))
    with pytest.raises(lt.InputError, match=r"one of 'midpoint', 'exp'.*, got 'expo'"):
        lt.MetriplecticGauss(2, retraction="expo")
    rotation_retraction = mf.retraction(mf.SpecialOrthogonal(3), "exp")
    with pytest.raises(lt.InputError, match="the retraction belongs to SO"):
        lt.integrate(build("spin"), START, (0, 1), 0.1, lt.MetriplecticGauss(2, retraction=rotation_retraction))
    with pytest.raises(mf.SpaceError, match="not a group"):
        lt.integrate(build("spin"), START, (0, 1), 0.1, lt.MetriplecticGauss(2, retraction="cayley"))
    with pytest.raises(lt.InputError, match="Lie algebra"):
        lt.MetriplecticSystem(SPIN, cubic, lambda s: s[0], lt.KillingDissipation(), space=SPHERE)
