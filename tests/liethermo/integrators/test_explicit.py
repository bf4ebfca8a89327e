"""Explicit methods with both laws: laws from rest to instability, engines, derivatives, and controls."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.integrators.explicit import StepRow
from tests.cases import covering, few_combinations
from tests.liethermo import random_systems

RK = lt.MetriplecticRungeKutta
Taylor = lt.MetriplecticTaylor
EPS = float(np.finfo(np.float64).eps)
BODY = lt.models.rigid_body((5.0, 4.0, 2.0), rate=0.5)
X0 = np.array([0.2, 1.0, 0.3])
METHODS = [*map(RK, (4, 6, 8)), *map(Taylor, (6, 12, 20))]
each_method = pytest.mark.parametrize("method", METHODS, ids=str)


# -- laws -------------------------------------------------------------------------------------------------------------


def random_run(g, number, steps, method, h=0.002, engine="compiled"):
    p, x0s = random_systems.parameters(g, number, 1), random_systems.states(g, number, 1)
    build = random_systems.family(g)
    return lt.ensemble(build, x0s, (0.0, h * steps), h, method, parameters=p, outputs="summary", engine=engine)


def assert_laws(ensemble):
    assert ensemble.ok.all(), str(ensemble)
    assert ensemble.energy_drift.max() <= 1e-14
    assert (
        ensemble.least_entropy_increment >= -4 * EPS * np.maximum(ensemble.entropy_scale, ensemble.entropy_sensitivity)
    ).all()


def test_laws_of_random_systems():
    assert_laws(random_run(mf.so(3), 24, 500, RK(4)))


MAX_DIM_OF_ORDER_20 = 3
"""Maximum dimension of an algebra for a Taylor method of order 20: LLVM takes minutes for larger programs."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("g", "method"),
    covering(
        (
            pytest.param(g, method, id=f"{method}-{g.name}")
            for g in random_systems.ALGEBRAS
            for method in METHODS
            if method.order < 20 or g.dim <= MAX_DIM_OF_ORDER_20
        ),
        lambda g, method: [(g.name, type(method)), method.order],
    ),
)
def test_laws_of_a_thousand_systems(g, method):
    """The laws hold for 143 systems on each of seven algebras."""
    assert_laws(random_run(g, 143, 1000, method))


@pytest.mark.slow
@each_method
def test_drift_over_a_million_steps(method):
    """The energy and a conserved Casimir do not drift, for energies that are not quadratic."""
    quartic = lambda m: 0.5 * jnp.sum(m**2 / jnp.array([5.0, 4.0, 2.0])) + 0.1 * m[0] ** 4 + jnp.cos(m[2])  # noqa: E731
    for friction in (None, lt.KillingDissipation(1e-4)):
        system = lt.LiePoissonSystem(mf.so(3), quartic, lt.Quadratic(np.ones(3)), friction)
        run = lt.integrate(system, X0, (0.0, 100_000.0), 0.1, method, save_every=10_000)
        assert run.audit().energy_drift <= 2e-14
        assert run.stats.least_entropy_increment >= -4 * EPS * np.abs(run.entropy).max()
        if friction is None:
            assert np.abs(run.entropy / run.entropy[0] - 1.0).max() <= 2e-14


def test_rounding_of_values_is_no_missed_level():
    """The gradient of the entropy is curved more than it changes in a step, so steps use values of the entropy."""

    def entropy(m):
        C = jnp.dot(m, m)
        return C + 0.5 * jnp.sin(C)

    def energy(m):
        return 0.03 * (0.5 * jnp.sum(m**2 / jnp.array([5.0, 4.0, 2.0])) + 0.1 * jnp.cos(m[2]))

    system = lt.LiePoissonSystem(mf.so(3), energy, entropy, lt.ProjectedMetric(rate=100.0), validate=False)
    method = lt.MetriplecticRungeKutta(4)
    run = lt.integrate(system, [3.0, 3.0, 2.6], (0.0, 0.4), 0.002, method, engine="compiled")
    assert np.ptp(run.energy) <= 4e-15 * run.energy[0]
    assert (np.diff(run.entropy) > 0.0).all()


@pytest.mark.sampled(1)
@each_method
def test_a_state_that_relaxes_goes_on_at_its_rate(method):
    """The deviation from equilibrium decays to 1e-45 at the rate of the linear motion: rounding does not stop it."""
    inertia, rate = np.array([5.0, 4.0, 2.0]), 1.0
    system = lt.models.rigid_body(tuple(inertia), rate=rate)
    jacobian = np.asarray(jax.jacfwd(system.vector_field)(jnp.array([1.0, 0.0, 0.0])))[1:, 1:]
    slowest = np.linalg.eigvals(jacobian).real.max()
    run = lt.integrate(system, [1.0, 1e-9, 2e-9], (0.0, 2500.0), 0.5, method, save_every=10)
    deviation = np.linalg.norm(run.x[:, 1:], axis=1)
    assert deviation[-1] < 1e-40
    assert np.log(deviation[-1] / deviation[100]) / (run.t[-1] - run.t[100]) == pytest.approx(slowest, rel=0.02)
    assert run.audit().passed


@pytest.mark.sampled(1)
@few_combinations(method=METHODS, rate=[0.0, 1e-6, 1.0])
def test_saddles_and_weak_friction(method, rate):
    system = lt.models.rigid_body((5.0, 4.0, 2.0), rate=rate)
    for x0 in ([1e-3, 1.0, 1e-3], [1e-9, 1.0, 1e-9], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1e-160, 0.0, 1e-160]):
        run = lt.integrate(system, x0, (0.0, 600.0), 0.3, method)
        assert run.audit(energy=2e-15).passed, str(run.audit())
        if not rate:
            assert np.ptp(run.entropy) <= 2e-15 * max(run.entropy[0], 1e-300)


def rubbing_body():
    inertia = jnp.array([3.0, 2.0, 1.0])
    friction, baths = lt.DoubleBracket(0.08), lt.HeatBaths(2.0, 1.0)
    return lt.LiePoissonSystem(mf.so(3), lambda m: 0.5 * jnp.sum(m**2 / inertia), dissipation=friction, baths=baths), [
        0.06,
        0.1,
        1.0,
    ]


def spin_in_a_field():
    friction, baths = lt.DoubleBracket(0.3), lt.HeatBaths(2.0, 1.0)
    return lt.LiePoissonSystem(mf.so(3), lambda s: -s[2] - 0.3 * s[2] ** 2, dissipation=friction, baths=baths), [
        0.3,
        0.5,
        -0.8,
    ]


def pushed_to_an_axis():
    """Only the energy is conserved, and the entropy is a function of the length of the momentum."""
    return BODY, X0


def orbit_that_becomes_a_circle():
    """Friction acts on the radial velocity alone: the angular momentum is conserved, and the motion goes on."""

    def energy(x):
        return 0.5 * jnp.dot(x[2:4], x[2:4]) - 1.0 / jnp.sqrt(jnp.dot(x[:2], x[:2])) + jnp.exp(x[4])

    def friction(x):
        heat = jnp.dot(x[:2], x[2:4]) * jnp.exp(-x[4])
        w = jnp.concatenate([jnp.zeros(2), -x[:2], heat[None]])
        return 0.2 * jnp.outer(w, w)

    poisson = np.zeros((5, 5))
    poisson[:2, 2:4], poisson[2:4, :2] = np.eye(2), -np.eye(2)
    momentum = {"J": lambda x: x[0] * x[3] - x[1] * x[2]}
    return lt.MetriplecticSystem(
        lambda x: jnp.asarray(poisson),
        energy,
        lambda x: x[4],
        lt.FrictionOperator(friction),
        dim=5,
        momentum_maps=momentum,
    ), [1.0, 0.0, 0.1, 1.1, 0.0]


RELAXING = [rubbing_body, spin_in_a_field, pushed_to_an_axis]


def assert_laws_after_relaxation(case, method, end):
    """Assert the laws in adaptive steps, which grow until one overestimates the growth of the entropy.

    The levels then have no common point. Corrections toward one missed the energy and the Casimirs by 1e-15 in each
    step, all with one sign.
    """
    system, x0 = case()
    run = lt.integrate(system, x0, (0.0, end), lt.Adaptive(1e-7), method)
    assert run.audit(energy=2e-15, casimirs=4e-15).passed, str(run.audit())
    assert run.stats.rejected > 0


@pytest.mark.sampled("rubbing_body-MetriplecticRungeKutta(order=4)")
@few_combinations(case=RELAXING, method=METHODS)
def test_adaptive_steps_keep_the_laws_after_relaxation(method, case):
    assert_laws_after_relaxation(case, method, 2000.0)


@pytest.mark.slow
@few_combinations(case=RELAXING, method=[*map(RK, (4, 6, 8)), Taylor(12)])
def test_adaptive_steps_keep_the_laws_long_after_relaxation(method, case):
    assert_laws_after_relaxation(case, method, 1e5)


@pytest.mark.slow
@pytest.mark.parametrize("case", RELAXING)
def test_fixed_steps_go_on_at_an_equilibrium(case):
    """Stable fixed steps, as long as the final adaptive steps, keep the laws at an equilibrium."""
    system, x0 = case()
    for method, h in ((RK(4), 0.5), (RK(8), 1.0)):
        assert lt.integrate(system, x0, (0.0, 2000.0), h, method).audit(energy=2e-15).passed


@pytest.mark.slow
@pytest.mark.parametrize("method", [RK(8), RK(6)], ids=str)
def test_adaptive_steps_on_a_circular_orbit(method):
    """The laws hold though grad H is orthogonal to each step, and grad S depends on the other gradients."""
    system, x0 = orbit_that_becomes_a_circle()
    run = lt.integrate(system, x0, (0.0, 1000.0), lt.Adaptive(1e-7), method)
    assert run.stats.rejected < 100
    assert run.audit().energy_drift <= 2e-15
    assert np.abs(run.casimirs["J"] / run.casimirs["J"][0] - 1.0).max() <= 2e-14
    assert run.stats.least_entropy_increment > -1e-14
    radius = np.linalg.norm(run.x[len(run.x) // 2 :, :2], axis=1)
    assert np.ptp(radius) < 1e-5
    assert radius[-1] == pytest.approx(1.1**2, rel=1e-5)  # J^2, of a circle


def angular_momentum(x):
    return x[0] * x[3] - x[1] * x[2]


def kepler():
    def energy(x):
        return 0.5 * jnp.dot(x[2:], x[2:]) - 1.0 / jnp.sqrt(jnp.dot(x[:2], x[:2]))

    return lt.MetriplecticSystem(
        mf.Canonical(2), energy, dim=4, momentum_maps={"J": lambda x: x[0] * x[3] - x[1] * x[2]}
    )


@pytest.mark.sampled(1)
@few_combinations(method=METHODS, excess=[0.0, 1e-12, 1e-6, 1e-3, 0.1])
def test_dependent_gradients(method, excess):
    """Near a circular orbit grad H and grad J are nearly parallel: the laws hold, or a status says so."""
    run = lt.integrate(kepler(), [1.0, 0.0, 0.0, np.sqrt(1.0 + excess)], (0.0, 20.0), 0.1, method, on_failure="return")
    assert run.status.code in ("completed", "not_converged")
    assert run.audit().energy_drift <= 2e-14
    assert np.abs(run.casimirs["J"] / run.casimirs["J"][0] - 1.0).max() <= 1e-13
    if excess >= 1e-6:
        assert run.status.ok


def test_functions_preserved_on_request():
    system = lt.MetriplecticSystem(mf.Canonical(2), kepler().energy, dim=4)
    x0 = [1.0, 0.0, 0.0, 1.2]
    runs = [lt.integrate(system, x0, (0.0, 10.0), 0.2, RK(6, preserve)) for preserve in ((), (angular_momentum,))]
    values = [np.array([angular_momentum(x) for x in run.x]) for run in runs]
    drifts = [np.abs(v / v[0] - 1.0).max() for v in values]
    assert drifts[0] > 1e-9
    assert drifts[1] <= 2e-15


@pytest.mark.slow
def test_a_driven_body():
    """The energy changes by exactly the work done."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda m, t: 0.5 * jnp.sum(m**2 / jnp.array([5.0, 4.0, 2.0])) + 0.2 * jnp.sin(t) * m[0] ** 3,
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.1),
    )
    run = lt.integrate(system, X0, (0.0, 20.0), 0.1, RK(6))
    assert run.audit(energy=1e-14).passed
    assert np.ptp(run.energy) > 1e-2


# -- stiffness, adaptive steps, derivatives, engines ------------------------------------------------------------------


@pytest.mark.sampled(1)
@each_method
def test_stiffness_ends_with_advice(method):
    stiff = lt.models.rigid_body(rate=200.0)
    run = lt.integrate(stiff, [0.1, 1.0, 0.1], (0.0, 50.0), 0.5, method, on_failure="return")
    assert not run.status.ok
    assert "MetriplecticGauss" in run.status.message
    assert np.array_equal(run.x, [[0.1, 1.0, 0.1]])
    adaptive = lt.integrate(stiff, [0.1, 1.0, 0.1], (0.0, 1.0), lt.Adaptive(1e-6), method)
    assert adaptive.status.ok
    assert adaptive.audit().passed


@pytest.mark.slow
@each_method
def test_adaptive_steps_events_and_output_between(method):
    exact = lt.integrate(BODY, X0, (0.0, 10.0), 10.0, lt.Reference(rtol=1e-13)).x[-1]
    errors = []
    for rtol in (1e-5, 1e-7, 1e-9, 1e-11):
        run = lt.integrate(BODY, X0, (0.0, 10.0), lt.Adaptive(rtol), method, dense=True)
        errors.append(np.abs(run.x[-1] - exact).max() / rtol)
        assert run.audit().passed
    assert np.median(errors) < 10.0, errors
    assert np.median(errors) > 0.01 or method.order > 8, errors  # those arrive while their first steps still grow
    t_left, t_right = run.t[len(run.t) // 2 - 1 : len(run.t) // 2 + 1]
    t_middle = 0.5 * (t_left + t_right)
    x_middle = lt.integrate(BODY, X0, (0.0, t_middle), t_middle, lt.Reference(rtol=1e-13)).x[-1]
    assert np.abs(run(t_middle) - x_middle).max() < 1e-10
    event = lt.integrate(BODY, X0, (0.0, 10.0), lt.Adaptive(1e-9), method, until=lambda m: m[1] - 0.5)
    assert event.status.code == "event"
    assert event.x[-1][1] == pytest.approx(0.5, abs=1e-12)


@pytest.mark.sampled("MetriplecticRungeKutta(order=4)")
@each_method
def test_engines_take_the_same_steps(method):
    quartic = lambda m: 0.5 * jnp.sum(m**2 / jnp.array([5.0, 4.0, 2.0])) + 0.1 * m[0] ** 4  # noqa: E731
    entropy = lambda m: jnp.log(1.0 + jnp.dot(m, m))  # noqa: E731
    system = lt.LiePoissonSystem(mf.so(3), quartic, entropy, lt.ProjectedMetric(rate=0.3))
    a, b = (lt.integrate(system, X0, (0.0, 10.0), 0.2, method, engine=e) for e in ("array", "compiled"))
    assert np.abs(a.x - b.x).max() <= 1e-14
    assert a.stats.fixed_point_iterations == b.stats.fixed_point_iterations == a.stats.steps
    x0s = np.random.default_rng(0).standard_normal((11, 3))
    ensemble_states = lt.ensemble(system, x0s, (0.0, 5.0), 0.2, method, engine="compiled").x
    single_states = [lt.integrate(system, x, (0.0, 5.0), 0.2, method, engine="compiled").x[-1] for x in x0s]
    assert np.abs(ensemble_states - single_states).max() <= 1e-15 * np.abs(ensemble_states).max()


@pytest.mark.slow
@each_method
def test_derivatives(method):
    """Derivatives by the state and by a parameter agree with differences of fourth order."""

    def end(x, rate):
        return lt.flow(lt.models.rigid_body((5.0, 4.0, 2.0), rate=rate), x, (0.0, 3.0), 0.25, method)

    forward_jacobians = jax.jacfwd(end, (0, 1))(jnp.asarray(X0), 0.5)
    reverse_jacobians = jax.jacrev(end, (0, 1))(jnp.asarray(X0), 0.5)

    def difference(f, h=1e-3):
        return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    state_derivative = np.stack(
        [difference(lambda e, v=v: np.asarray(end(X0 + e * v, 0.5))) for v in np.eye(3)], axis=1
    )
    rate_derivative = difference(lambda e: np.asarray(end(X0, 0.5 + e)))
    for jacobians in (forward_jacobians, reverse_jacobians):
        assert np.abs(jacobians[0] - state_derivative).max() < 1e-10
        assert np.abs(jacobians[1] - rate_derivative).max() < 1e-10


# -- controls ---------------------------------------------------------------------------------------------------------


def remove_corrections(method):
    """Return the method without its corrections, which does not report its constraint residual."""

    class UncorrectedMethod(type(method)):
        def slopes(self, system, x, compensation, h, k):
            laws = self._laws_to_hold(system)
            rates = lambda y: self.field_and_law_rates(system, laws, y)  # noqa: E731
            d, _, error, interpolation_rows = self.base_step(rates, False, x, compensation, h)
            return jnp.stack([d / h, error, jnp.zeros_like(x), k[StepRow.INITIAL_LEVELS], *interpolation_rows])

    return UncorrectedMethod(method.order)


STEPS_TO_DRIFT = {
    RK: {4: [20, 30, 45], 6: [14, 20, 28], 8: [10, 14, 20]},
    Taylor: {6: [14, 20, 28], 12: [11, 13, 16], 20: [11, 12, 13]},
}
"""Numbers of steps, by method and order, that show the drift without corrections."""


@pytest.mark.sampled(1)
@each_method
def test_without_corrections_the_energy_drifts_at_the_order_of_the_method(method):
    steps, x0 = np.array(STEPS_TO_DRIFT[type(method)][method.order]), 6.0 * X0
    runs = [lt.integrate(BODY, x0, (0.0, 5.0), 5.0 / n, remove_corrections(method)) for n in steps]
    drifts = [run.audit().energy_drift for run in runs]
    slope = -np.polyfit(np.log(steps), np.log(drifts), 1)[0]
    assert min(drifts) > 1e-13
    assert slope > 0.9 * method.order - 0.3, (drifts, slope)
    assert lt.integrate(BODY, x0, (0.0, 5.0), 5.0 / steps[-1], method).audit().energy_drift < 1e-15


class SingleCorrection(RK):
    """Control: only one correction is made."""

    max_corrections: ClassVar[int] = 1


def test_a_step_that_misses_its_levels_fails():
    run = lt.integrate(BODY, 6.0 * X0, (0.0, 1.0), 0.5, SingleCorrection(4), on_failure="return")
    assert run.status.code == "not_converged"
    assert run.status.residual > 1e-10


@pytest.mark.slow
def test_an_energy_is_not_steered_where_the_levels_hardly_meet():
    """At an equilibrium the entropy is maximal for the energy: with one ulp less energy no such state exists."""
    heat = lambda x: jnp.exp(x[0]) + jnp.exp(x[1])  # noqa: E731
    K = lambda x: 0.1 * jnp.outer(a := jnp.array([jnp.exp(x[1]), -jnp.exp(x[0])]), a)  # noqa: E731
    system = lt.MetriplecticSystem(mf.NoPoisson(2), heat, lambda x: x[0] + x[1], lt.FrictionOperator(K), dim=2)
    x, method, zero = jnp.array([1.0 + 1e-10, 1.0]), RK(4).on(system), jnp.zeros(2)
    k = method.start(system, x)
    for drift in (0.0, 6.0 * EPS, -6.0 * EPS):  # levels of a start that roundings have taken the run away from
        levels = k.at[StepRow.INITIAL_LEVELS, 0].multiply(1.0 + drift)
        k_new = method.slopes(system, x, zero, 0.01, levels)
        assert np.abs(k_new[StepRow.CONSTRAINT_RESIDUAL]).max() * 0.01 < 1e-14
        assert np.abs(k_new[StepRow.MEAN_SLOPE]).max() < 1e-9
