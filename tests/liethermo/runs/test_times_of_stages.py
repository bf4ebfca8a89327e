"""Functions of time are evaluated at times from the start of a run to its end only: 0.1 + 0.1 + 0.1 > 0.3."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import liethermo as lt
import manifolds as mf

SPAN = (0.1, 0.4)
STEP = 0.1
START = [1.0, 0.0]


def table(t, span=SPAN):
    """A function of time that is not a number outside of the span."""
    return jnp.where((t >= span[0]) & (t <= span[1]), jnp.cos(t), jnp.nan)


def forced_oscillator(force=table, stiffness=1.0):
    """An oscillator in a force, whose energy is known in the span only."""
    return lt.MetriplecticSystem(
        poisson=mf.Canonical(1), energy=lambda x, t: 0.5 * (x[1] ** 2 + stiffness * x[0] ** 2) + force(t) * x[0], dim=2
    )


def body_with_torque(torque, **options):
    energy = lambda m: 0.5 * (m[0] ** 2 + m[1] ** 2 / 2.0 + m[2] ** 2 / 3.0)  # noqa: E731
    return lt.LiePoissonSystem(mf.so(3), energy, torque=torque, **options)


def solve_by_scipy(force, span, start=START):
    """Solve for the forced oscillator by DOP853, which evaluates nothing beyond the end either."""
    return scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -y[0] - force(t)], span, start, method="DOP853", rtol=1e-12, atol=1e-12
    ).y[:, -1]


EXACT = solve_by_scipy(np.cos, SPAN)

METHODS = [
    lt.MetriplecticMidpoint(),
    lt.MetriplecticGauss(2),
    lt.MetriplecticRungeKutta(4),
    lt.MetriplecticRungeKutta(8),
    lt.MetriplecticTaylor(8),
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [STEP, lt.Adaptive(1e-6)], ids=["fixed", "adaptive"])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_an_energy_that_is_known_in_the_span_only(method, step):
    run = lt.integrate(forced_oscillator(), START, SPAN, step, method)
    assert run.t[-1] == SPAN[1]
    assert np.abs(run.x[-1] - EXACT).max() < 1e-3
    assert np.isfinite(run.energy).all()
    assert run.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [STEP, lt.Adaptive(1e-6)], ids=["fixed", "adaptive"])
def test_on_the_array_engine(step):
    run = lt.integrate(forced_oscillator(), START, SPAN, step, lt.MetriplecticGauss(2), engine="array")
    assert np.abs(run.x[-1] - EXACT).max() < 1e-5


def test_kept_states_dense_output_and_events():
    method = lt.MetriplecticGauss(2)
    run = lt.integrate(forced_oscillator(), START, SPAN, STEP, method, save_at=[0.2, 0.3])
    assert run.t.tolist() == [0.1, 0.2, 0.3, 0.4]
    assert np.isfinite(run.x).all()
    dense = lt.integrate(forced_oscillator(), START, SPAN, STEP, method, dense=True)
    assert np.array_equal(dense(SPAN[1]), dense.x[-1])
    assert np.isfinite(dense(np.nextafter(SPAN[1], 0.0))).all()
    until = lt.integrate(forced_oscillator(), START, SPAN, STEP, method, until=lambda x: x[1] + 5.0)
    assert until.status.code == "completed"
    assert np.array_equal(until.x[-1], dense.x[-1])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
@pytest.mark.parametrize("step", [STEP, lt.Adaptive(1e-8)], ids=["fixed", "adaptive"])
def test_members_of_an_ensemble_are_single_runs_to_the_bit(step, engine):
    starts, stiffness = np.array([[1.0, 0.0], [0.5, 0.2], [-1.0, 2.0]]), np.array([1.0, 1.5, 0.5])
    method = lt.MetriplecticGauss(2)
    ensemble = lt.ensemble(
        lambda p: forced_oscillator(stiffness=p), starts, SPAN, step, method, parameters=stiffness, engine=engine
    )
    assert ensemble.ok.all()
    for i, (x, k) in enumerate(zip(starts, stiffness, strict=True)):
        one = lt.integrate(forced_oscillator(stiffness=k), x, SPAN, step, method, engine=engine).x[-1]
        # XLA compiles lanes and single runs by different instructions
        assert np.array_equal(ensemble.x[i], one) if engine == "compiled" else np.abs(ensemble.x[i] - one).max() < 1e-14


@pytest.mark.slow
def test_a_flow_and_its_derivative():
    def end(x):
        return lt.flow(forced_oscillator(), x, SPAN, STEP, lt.MetriplecticGauss(2))

    assert np.abs(end(jnp.asarray(START)) - EXACT).max() < 1e-5
    exact = solve_by_scipy(lambda t: 0.0, SPAN), solve_by_scipy(lambda t: 0.0, SPAN, [0.0, 1.0])  # it is linear
    assert np.abs(jax.jacfwd(end)(jnp.asarray(START)) - np.column_stack(exact)).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(8)], ids=str
)
def test_a_torque_that_ends_as_a_root(method):
    def torque(t, mu):
        return jnp.array([0.0, 0.0, 1.0]) * jnp.sqrt(0.3 - t)

    exact = scipy.integrate.solve_ivp(
        lambda t, m: np.cross(m, m / [1.0, 2.0, 3.0]) + np.array([0.0, 0.0, np.sqrt(0.3 - t)]),
        (0.0, 0.3),
        [0.4, 0.5, -0.3],
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    )
    for step, tolerance in ((0.1, 3e-3), (lt.Adaptive(1e-5), 1e-3)):
        run = lt.integrate(body_with_torque(torque), [0.4, 0.5, -0.3], (0.0, 0.3), step, method)
        assert np.abs(run.x[-1] - exact.y[:, -1]).max() < tolerance


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=str)
def test_a_torque_that_needs_the_attitude(method):
    def torque(t, mu, g):
        return g.T @ jnp.array([0.0, 0.2, 1.0]) * table(t, (0.0, 0.3))

    run = lt.integrate(body_with_torque(torque, group=mf.SO(3)), [0.4, 0.5, -0.3], (0.0, 0.3), 0.1, method)
    assert run.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("stages", [1, 2])
def test_an_energy_whose_power_is_infinite_at_the_end(stages):
    """The derivative of a root by time is infinite where it ends; the motion and the work are finite."""

    def force(t):
        return jnp.sqrt(0.3 - t)

    exact = solve_by_scipy(lambda t: np.sqrt(0.3 - t), (0.0, 0.3))
    run = lt.integrate(forced_oscillator(force), START, (0.0, 0.3), lt.Adaptive(1e-6), lt.MetriplecticGauss(stages))
    assert np.abs(run.x[-1] - exact).max() < 1e-4


def test_the_reference_solver():
    run = lt.integrate(forced_oscillator(), START, SPAN, STEP, lt.Reference(1e-10))
    assert run.status.ok
    assert np.abs(run.x[-1] - EXACT).max() < 1e-8


def test_times_are_sums_of_steps_rounded_once():
    """Times of equal steps, of steps to saved times, and of adaptive steps, against rational numbers."""
    body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    start, h = 0.7, 0.1
    run = lt.integrate(body, [0.1, 0.2, 1.0], (start, 30.0), h)
    exact = [float(Fraction(start) + n * Fraction(h)) for n in range(len(run.t) - 1)]
    assert run.t.tolist() == [*exact, 30.0]
    assert len({start + n * h for n in range(len(exact))} - set(exact)) > 10  # two roundings are seen
    run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 1e3), lt.Adaptive(1e-6), dense=True)
    assert run.t[-1] == 1e3
    assert (np.diff(run.t) > 0.0).all()


def test_the_clock_of_adaptive_steps_is_their_time():
    """The sum of the steps, which q' = 1 adds up as a driven system's clock does, stays with the times of the run."""
    system = lt.MetriplecticSystem(poisson=mf.Canonical(1), energy=lambda x: x[1], dim=2)
    step = lt.Adaptive(1e-8, largest=0.0137)
    run = lt.integrate(system, [0.7, 1.0], (0.7, 70.0), step, lt.MetriplecticRungeKutta(4))
    assert len(run.t) > 5_000
    assert np.abs(run.x[:, 0] - run.t).max() <= np.spacing(70.0)


def test_a_step_below_the_last_place_of_the_times_is_refused():
    """Far from the origin of time the clock does not see shorter steps, so that the state would go on alone."""
    system = lt.MetriplecticSystem(poisson=mf.Canonical(1), energy=lambda x: 5e3 * x @ x, dim=2)

    def run(start):
        span, method = (start, start + 2.0**-8), lt.MetriplecticRungeKutta(4)
        return lt.integrate(system, START, span, lt.Adaptive(1e-8), method, on_failure="return")

    run_far_from_zero = run(2.0**40)
    assert run_far_from_zero.status.code == "step_underflow"
    assert "nearer to zero" in run_far_from_zero.status.message
    assert run(0.0).status.ok  # as the message says
