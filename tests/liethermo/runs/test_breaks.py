"""Functions of time that jump: steps end there, see the right side, and the laws count the work of a jump."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.runs.time_features import UndeclaredFeatureWarning
from tests.refusals import refusal_test

INERTIA = np.array([1.0, 2.0, 3.0])

X0 = np.array([0.3, -0.2, 0.9])

SWITCHES = (2.0, 2.5, 7.0, 9.0)
"""Times at which the thruster is switched."""

TORQUES = np.array([(0.0, 0.0, 0.1), (0.0, 0.0, 0.0), (0.2, 0.0, 0.0)])
"""Torques between two switches."""

END = 12.0

METHODS = [
    (lt.MetriplecticRungeKutta(6), lt.Adaptive(1e-9), 1e-9),
    (lt.MetriplecticRungeKutta(8), lt.Adaptive(1e-9), 1e-9),
    (lt.MetriplecticTaylor(), lt.Adaptive(1e-9), 1e-9),
    (lt.MetriplecticGauss(3), lt.Adaptive(1e-9), 1e-9),
    (lt.MetriplecticRungeKutta(8), 0.1, 1e-12),
    (lt.MetriplecticGauss(3), 0.1, 1e-12),
    (lt.MetriplecticMidpoint(), 0.01, 2e-6),
    (lt.Reference(1e-11), 0.1, 1e-10),
]
"""Methods, steps, and largest errors; those of adaptive runs are the tolerance, the others were measured."""


def thruster_at(t):
    k = np.searchsorted(SWITCHES, t, side="right") - 1
    return TORQUES[k] if 0 <= k < len(TORQUES) else np.zeros(3)


@pytest.fixture(scope="module")
def reference():
    """The last momentum by SciPy, which starts again at each switch."""
    m = X0
    for start, end in itertools.pairwise([0.0, *SWITCHES, END]):
        torque = thruster_at(0.5 * (start + end))
        run = solve_ivp(
            lambda t, m, u=torque: np.cross(m, m / INERTIA) + u, (start, end), m, "DOP853", rtol=1e-13, atol=1e-14
        )
        m = run.y[:, -1]
    return m


@pytest.fixture(scope="module")
def body():
    pulses = lt.torques.PiecewiseConstant(SWITCHES, TORQUES)
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=pulses)


def undeclared_pulses(t, m):
    first, second = (jnp.where((t >= a) & (t < b), 1.0, 0.0) for a, b in ((2.0, 2.5), (7.0, 9.0)))
    return first * TORQUES[0] + second * TORQUES[2]


def body_with_undeclared_pulses():
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=undeclared_pulses)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "step", "max_error"), METHODS, ids=str)
def test_thruster_pulses_are_integrated_to_the_tolerance(body, reference, method, step, max_error):
    solution = lt.integrate(body, X0, (0.0, END), step, method)
    assert np.abs(solution.x[-1] - reference).max() < max_error
    assert np.isin(SWITCHES, solution.t).all()


@pytest.mark.slow
def test_both_engines_and_ensembles_see_the_pulses_alike(body, reference):
    method = lt.MetriplecticRungeKutta(8)
    for step in (0.1, lt.Adaptive(1e-9)):
        array, compiled = (
            lt.integrate(body, X0, (0.0, END), step, method, engine=engine).x[-1] for engine in ("array", "compiled")
        )
        many = lt.ensemble(body, [X0, 0.5 * X0], (0.0, END), step, method)
        np.testing.assert_allclose(array, compiled, atol=1e-13)
        np.testing.assert_array_equal(many.x[0], compiled)
        assert np.abs(compiled - reference).max() < 1e-9


def test_saved_times_and_breaks_are_kept_apart(body, reference):
    for step in (0.1, lt.Adaptive(1e-9)):
        solution = lt.integrate(body, X0, (0.0, END), step, lt.MetriplecticRungeKutta(8), save_at=[1.0, 7.0, 11.0])
        np.testing.assert_array_equal(solution.t, [0.0, 1.0, 7.0, 11.0, END])
        many = lt.ensemble(
            body, [X0], (0.0, END), step, lt.MetriplecticRungeKutta(8), save_at=[1.0, 7.0, 11.0], outputs="trajectory"
        )
        np.testing.assert_array_equal(many.t, solution.t)
        np.testing.assert_array_equal(many.x[0], solution.x)
    every_third = lt.integrate(body, X0, (0.0, END), 0.3, lt.MetriplecticRungeKutta(8), save_every=3)
    assert np.isin(SWITCHES, every_third.t).all()
    assert np.abs(every_third.x[-1] - reference).max() < 1e-11
    assert every_third.audit().passed


@pytest.mark.slow
def test_flow_has_the_states_and_derivatives_of_the_run(body, reference):
    import jax

    end = lt.flow(body, X0, (0.0, END), 0.1, lt.MetriplecticGauss(3))
    assert np.abs(end - reference).max() < 1e-12
    derivative = jax.jacfwd(lambda x: lt.flow(body, x, (0.0, 3.0), 0.1, lt.MetriplecticGauss(3)))(jnp.asarray(X0))
    difference = [
        (
            lt.flow(body, X0 + d, (0.0, 3.0), 0.1, lt.MetriplecticGauss(3))
            - lt.flow(body, X0 - d, (0.0, 3.0), 0.1, lt.MetriplecticGauss(3))
        )
        / 2e-5
        for d in 1e-5 * np.eye(3)
    ]
    np.testing.assert_allclose(derivative, np.transpose(difference), atol=1e-9)


@pytest.mark.slow
def test_dense_output_on_both_sides_of_a_switch(body):
    solution = lt.integrate(body, X0, (0.0, 3.0), lt.Adaptive(1e-11), lt.MetriplecticRungeKutta(8), dense=True)
    fine = lt.integrate(body, X0, (0.0, 3.0), 0.05, lt.MetriplecticRungeKutta(8))
    np.testing.assert_allclose(solution(fine.t), fine.x, atol=1e-9)


# -- an energy that jumps -----------------------------------------------------------------------------------------


def tilted_energy(strength):
    return lambda m: 0.5 * jnp.sum(m**2 / INERTIA) + strength * m[2] * m[0]


def damped_body(energy):
    return lt.LiePoissonSystem(mf.so(3), energy, lambda m: jnp.log(1.0 + m @ m), lt.KillingDissipation(0.1))


@pytest.fixture(scope="module")
def switched_reference():
    """The last momentum and the work: three runs of autonomous systems, and the jumps of the energy between them."""
    m, work = X0, 0.0
    weak, strong = damped_body(tilted_energy(0.0)), damped_body(tilted_energy(2.0))
    for system, start, end in ((weak, 0.0, 1.0), (strong, 1.0, 3.0), (weak, 3.0, 5.0)):
        if start:
            other = weak if system is strong else strong
            work += float(system.energy.value(m) - other.energy.value(m))
        m = lt.integrate(system, m, (start, end), 0.01, lt.MetriplecticRungeKutta(8)).x[-1]
    return m, work


@pytest.mark.sampled(1)
@pytest.mark.parametrize("is_right_continuous", [True, False])
@pytest.mark.parametrize(
    ("method", "step", "max_error"),
    [
        pytest.param(lt.MetriplecticRungeKutta(8), lt.Adaptive(1e-10), 2e-9, marks=pytest.mark.slow, id="RK8"),
        pytest.param(lt.MetriplecticTaylor(), lt.Adaptive(1e-10), 2e-9, marks=pytest.mark.slow, id="Taylor"),
        pytest.param(lt.MetriplecticGauss(3), 0.025, 1e-8, id="Gauss"),
        pytest.param(lt.Reference(1e-12), 0.1, 1e-11, id="SciPy"),
    ],
)
def test_jump_of_the_energy_is_work(switched_reference, method, step, max_error, is_right_continuous):
    def energy(m, t):
        is_on = (t >= 1.0) & (t < 3.0) if is_right_continuous else (t > 1.0) & (t <= 3.0)
        return tilted_energy(jnp.where(is_on, 2.0, 0.0))(m)

    m, work = switched_reference
    solution = lt.integrate(damped_body(energy), X0, (0.0, 5.0), step, method, breaks=[3.0, 1.0])
    assert np.abs(solution.x[-1] - m).max() < max_error
    assert abs(solution.casimirs["work"][-1] - work) < max_error
    assert solution.audit().passed
    assert np.ptp(solution.energy - solution.casimirs["work"]) < (1e-11 if isinstance(method, lt.Reference) else 1e-14)


# -- breaks at the ends of a span ---------------------------------------------------------------------------------


def switched_energy(is_right_continuous):
    def energy(m, t):
        is_on = (t >= 1.0) & (t < 3.0) if is_right_continuous else (t > 1.0) & (t <= 3.0)
        return tilted_energy(jnp.where(is_on, 2.0, 0.0))(m)

    return damped_body(energy)


@pytest.mark.sampled("Gauss-False")
@pytest.mark.parametrize("is_right_continuous", [True, False])
@pytest.mark.parametrize(
    ("method", "step", "max_error"),
    [
        pytest.param(lt.Reference(1e-12), 0.1, 1e-11, id="SciPy"),
        pytest.param(lt.MetriplecticRungeKutta(8), lt.Adaptive(1e-10), 2e-9, id="RK8"),
        pytest.param(lt.MetriplecticTaylor(), lt.Adaptive(1e-10), 2e-9, id="Taylor"),
        pytest.param(lt.MetriplecticGauss(3), 0.025, 1e-8, id="Gauss"),
    ],
)
def test_a_run_in_parts_that_end_at_the_switches(switched_reference, method, step, max_error, is_right_continuous):
    """A part ends with the energy from before a switch, and the next one starts with the energy from after it."""
    system, m, parts = switched_energy(is_right_continuous), X0, []
    for span in ((0.0, 1.0), (1.0, 3.0), (3.0, 5.0)):
        part = lt.integrate(system, m, span, step, method, breaks=[1.0, 3.0])
        if not isinstance(method, lt.Reference):  # which keeps the energy to its tolerance only
            assert part.audit().passed
            assert np.abs(part.casimirs["work"]).max() < 1e-14
            assert np.diff(part.t).min() > 1e-4
        m, parts = part.x[-1], [*parts, part]
    assert np.abs(m - switched_reference[0]).max() < max_error
    jumps = [after.energy[0] - before.energy[-1] for before, after in itertools.pairwise(parts)]
    assert abs(sum(jumps) - switched_reference[1]) < max_error


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "step", "max_error"), METHODS, ids=str)
def test_pulses_that_start_and_end_with_the_span(body, method, step, max_error):
    """One step too many, such as those that shrink towards the end, would be seen in the sizes of the steps."""
    m = X0
    for start, end in ((2.0, 2.5), (2.5, 7.0), (7.0, 9.0)):
        torque = thruster_at(0.5 * (start + end))
        m = solve_ivp(
            lambda t, m, u=torque: np.cross(m, m / INERTIA) + u, (start, end), m, "DOP853", rtol=1e-13, atol=1e-14
        ).y[:, -1]
    solution = lt.integrate(body, X0, (2.0, 9.0), step, method)
    assert np.abs(solution.x[-1] - m).max() < max_error
    assert np.diff(solution.t).min() > 1e-4
    many = lt.ensemble(body, [X0, X0], (2.0, 9.0), step, method) if not isinstance(method, lt.Reference) else None
    assert many is None or np.array_equal(many.x, [solution.x[-1]] * 2)


def test_a_break_within_rounding_of_an_end_is_at_the_end(body):
    whole = lt.integrate(body, X0, (2.0, 9.0), 0.1, lt.MetriplecticRungeKutta(8))
    breaks = [np.nextafter(2.0, 3.0), np.nextafter(9.0, 0.0)]
    again = lt.integrate(body, X0, (2.0, 9.0), 0.1, lt.MetriplecticRungeKutta(8), breaks=breaks)
    assert np.array_equal(again.t, whole.t)
    assert np.abs(again.x - whole.x).max() < 1e-14


@pytest.mark.slow
def test_energy_states_its_breaks(switched_reference):
    def drive(m, t):
        return jnp.where((t >= 1.0) & (t < 3.0), 2.0, 0.0) * m[2] * m[0]

    energy = lt.Quadratic(1.0 / INERTIA) + lt.TimeDependent(drive, breaks=[1.0, 3.0])
    pulse = lt.PiecewiseConstant([1.0, 3.0], [2.0])
    for system in (
        damped_body(energy),
        damped_body(lt.Quadratic(1.0 / INERTIA) + lt.TimeDependent(lambda m, t: pulse(t) * m[2] * m[0], [1.0, 3.0])),
    ):
        solution = lt.integrate(system, X0, (0.0, 5.0), 0.05, lt.MetriplecticRungeKutta(8))
        assert {1.0, 3.0} <= set(solution.t)
        assert np.abs(solution.x[-1] - switched_reference[0]).max() < 2e-8


def test_multiples_of_an_energy_keep_its_breaks():
    drive = lt.TimeDependent(lambda m, t: jnp.where(t >= 1.0, m[0], 0.0), breaks=[1.0])
    for energy in (2.0 * drive, -drive, drive / 3.0):
        system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA) + energy)
        assert 1.0 in lt.integrate(system, X0, (0.0, 1.7), 0.3).t


# -- features that nobody declares ----------------------------------------------------------------------------------


def test_adaptive_runs_find_undeclared_jumps(reference):
    body = body_with_undeclared_pulses()
    method = lt.MetriplecticRungeKutta(8)
    solution = lt.integrate(body, X0, (0.0, END), lt.Adaptive(1e-9), method)
    assert np.abs(solution.x[-1] - reference).max() < 1e-9
    many = lt.ensemble(body, [X0, X0], (0.0, END), lt.Adaptive(1e-9), method)
    np.testing.assert_array_equal(many.x[1], solution.x[-1])


def test_steps_of_given_size_warn_and_the_advice_helps(reference):
    body, method = body_with_undeclared_pulses(), lt.MetriplecticRungeKutta(8)
    with pytest.warns(UndeclaredFeatureWarning, match=r"breaks=\[2, 2.5, 7, 9\]"):
        blind = lt.integrate(body, X0, (0.0, END), 0.3, method)
    assert np.abs(blind.x[-1] - reference).max() > 1e-3
    advised = lt.integrate(body, X0, (0.0, END), 0.3, method, breaks=[2, 2.5, 7, 9])
    assert np.abs(advised.x[-1] - reference).max() < 1e-11


@pytest.mark.slow
def test_short_pulse_on_a_spin_at_rest_is_not_skipped():
    width = 0.02

    def energy(m, t):
        return -0.3 * m[2] - 50.0 * jnp.exp(-(((t - 30.0) / width) ** 2)) * m[0]

    def rate(t, m):
        return np.cross(m, -np.array([50.0 * np.exp(-(((t - 30.0) / width) ** 2)), 0.0, 0.3]))

    m = np.array([0.0, 0.0, 1.0])
    for span in ((29.8, 30.2), (30.2, 100.0)):  # the spin rests before
        m = solve_ivp(rate, span, m, "DOP853", rtol=1e-12, atol=1e-12, max_step=1e-3 if span[1] < 31.0 else 1.0).y[
            :, -1
        ]
    system = lt.LiePoissonSystem(mf.so(3), energy)
    for method in (lt.MetriplecticRungeKutta(8),):
        solution = lt.integrate(system, [0.0, 0.0, 1.0], (0.0, 100.0), lt.Adaptive(1e-9), method)
        assert np.abs(solution.x[-1] - m).max() < 1e-7


@pytest.mark.slow
def test_smooth_drives_have_no_features():
    """A control: a slow field, a fast one and a ramp are no features, and a run with breaks there is the same run."""
    for drive in (jnp.sin, lambda t: jnp.sin(50.0 * t), lambda t: 0.1 * t):
        system = lt.LiePoissonSystem(
            mf.so(3), lambda m, t, drive=drive: 0.5 * jnp.sum(m**2 / INERTIA) + drive(t) * m[0]
        )
        solution = lt.integrate(system, X0, (0.0, 30.0), 0.25)  # no warning, which would be an error
        np.testing.assert_array_equal(solution.t, 0.25 * np.arange(121))


# -- errors of quadratures ----------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("frequency", [1.0, 10.0])
@pytest.mark.parametrize(
    "method", [*map(lt.MetriplecticRungeKutta, (4, 6, 8)), lt.MetriplecticTaylor(), lt.MetriplecticGauss(3)], ids=str
)
def test_adaptive_steps_see_errors_of_a_quadrature(method, frequency):
    """A body that a motor turns about one axis: ``L' = cos(omega t)``. The order-8 estimate alone vanishes there."""
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=lambda t, m: jnp.stack([0.0, 0.0, 1.0]) * jnp.cos(frequency * t)
    )
    solution = lt.integrate(system, [0.0, 0.0, 1.0], (0.0, 10.0), lt.Adaptive(1e-9), method)
    np.testing.assert_allclose(solution.x[:, 2], 1.0 + np.sin(frequency * solution.t) / frequency, atol=1e-9)


# -- bad input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("breaks", [[[1.0]], [np.nan], "soon", 1.0])
def test_bad_breaks_are_refused(body, breaks):
    with pytest.raises(lt.InputError, match="breaks"):
        lt.integrate(body, X0, (0.0, 1.0), 0.1, breaks=breaks)


def test_bad_tables_are_refused():
    with pytest.raises(lt.InputError, match="must increase"):
        lt.PiecewiseConstant([1.0, 0.5], [1.0])
    with pytest.raises(lt.InputError, match="one for each interval"):
        lt.torques.PiecewiseConstant([1.0, 2.0], TORQUES)


def test_breaks_that_depend_on_the_parameters_of_an_ensemble_are_refused():
    def build(delay):
        pulse = lt.torques.PiecewiseConstant(times=[1.03 + delay, 2.07 + delay], torques=[(0.0, 0.0, 0.5)])
        return lt.models.rigid_body((1.0, 2.0, 3.0), torque=pulse)

    delays = np.array([0.0, 0.31])
    with pytest.raises(lt.InputError, match=r"Run each trajectory with lt\.integrate"):
        lt.ensemble(build, [0.1, 0.2, 0.3], (0.0, 3.0), 0.1, parameters=delays)
    for delay in delays:
        assert lt.integrate(build(delay), [0.1, 0.2, 0.3], (0.0, 3.0), 0.1).status.ok


KNOTS = np.array([0.0, 1.3, 2.1, 4.05, 6.6, 8.9, 15.0])

MOMENTS = 0.1 * np.random.default_rng(0).standard_normal((len(KNOTS), 3))
"""Torques at these times; the last is after the end of the run."""


@pytest.fixture(scope="module")
def reference_with_table():
    """The last momentum under a linear table by SciPy, which starts again at each of its times."""
    m = X0
    for start, end in itertools.pairwise([*KNOTS[:-1], END]):
        run = solve_ivp(
            lambda t, m: np.cross(m, m / INERTIA) + [np.interp(t, KNOTS, column) for column in MOMENTS.T],
            *((start, end), m, "DOP853"),
            rtol=1e-13,
            atol=1e-14,
        )
        m = run.y[:, -1]
    return m


def body_with_table(kind="linear"):
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=lt.torques.Tabulated(KNOTS, MOMENTS, kind))


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("method", "step", "max_error"), METHODS, ids=str)
def test_steps_end_at_the_times_of_a_linear_table(reference_with_table, method, step, max_error):
    run = lt.integrate(body_with_table(), X0, (0.0, END), step, method)
    assert np.isin(KNOTS[:-1], run.t).all()
    assert np.abs(run.x[-1] - reference_with_table).max() < 2.0 * max_error
    assert run.audit().passed or isinstance(method, lt.Reference)  # whose energy has the error of its steps


@pytest.mark.slow
def test_a_step_across_a_kink_would_lose_the_order(reference_with_table):
    """The control: the same values as a function that declares nothing."""

    def torque(t, m):
        return jnp.stack([jnp.interp(t, KNOTS, column) for column in MOMENTS.T])

    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=torque)
    run = lt.integrate(body, X0, (0.0, END), lt.Adaptive(1e-9), lt.MetriplecticRungeKutta(8))
    assert np.abs(run.x[-1] - reference_with_table).max() > 1e-8


@pytest.mark.slow
def test_times_of_a_table_that_are_no_stops(reference_with_table):
    """A table finer than the steps, one whose pieces are smooth, and one with more than the largest number of times."""
    method = lt.MetriplecticGauss(2)
    for body, step in ((body_with_table(), 4.0), (body_with_table("cubic"), 0.5)):
        assert not np.isin(KNOTS[1:-1], lt.integrate(body, X0, (0.0, END), step, method).t).any()
    every_second = lt.integrate(body_with_table(), X0, (0.0, END), 0.5, method, save_every=2)
    np.testing.assert_allclose(every_second.t, np.arange(13.0))
    times = np.linspace(0.0, END, 2000)
    long_table = lt.torques.Tabulated(times, 0.1 * np.sin(times)[:, None] * np.ones(3))
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / INERTIA), torque=long_table)
    run = lt.integrate(body, X0, (0.0, END), lt.Adaptive(1e-6), lt.MetriplecticRungeKutta(4))
    assert run.stats.steps < 1000


@pytest.mark.slow
def test_tables_in_ensembles(reference_with_table):
    body, method = body_with_table(), lt.MetriplecticRungeKutta(6)
    scales = np.array([1.0, 0.5])
    many = lt.ensemble(
        body, X0, (0.0, END), lt.Adaptive(1e-9), method, parameters={"torque.moments": scales[:, None, None] * MOMENTS}
    )
    assert np.abs(many.x[0] - reference_with_table).max() < 2e-9
    table_times = np.stack([KNOTS, KNOTS + 0.2])  # no common times at which steps could end
    many_times = lt.ensemble(body, X0, (0.0, END), 0.01, method, parameters={"torque.times": table_times})
    assert np.abs(many_times.x[0] - reference_with_table).max() < 1e-4


def test_pulses_that_overlap_are_added():
    starts, ends = [2.0, 5.0, 5.4, 9.0, 9.0], [2.6, 5.8, 6.0, 9.2, 9.25]
    heights = np.random.default_rng(2).standard_normal((5, 3))
    pulses = lt.PiecewiseConstant.from_pulses(starts, ends, heights)
    assert pulses.times == tuple(sorted({*starts, *ends}))
    for t in np.linspace(1.03, 10.03, 50):
        expected = sum(h for a, b, h in zip(starts, ends, heights, strict=True) if a <= t < b) + np.zeros(3)
        np.testing.assert_allclose(pulses(t), expected, atol=1e-15)


test_a_piecewise_constant_function_that_is_refused = refusal_test(
    (lambda: lt.PiecewiseConstant([1.0, 2.0, 3.0], [1.0, 0.0, 2.0]), "with 3 times needs 2 values, .* shape \\(3,\\)"),
    (lambda: lt.PiecewiseConstant([1.0, 1.0, 3.0], [1.0, 0.0]), "must increase"),
    (lambda: lt.PiecewiseConstant.from_pulses([1.0], [1.0], [1.0]), "must end after its start"),
    (lambda: lt.PiecewiseConstant.from_pulses([1.0], [2.0, 3.0], [1.0]), "one start, one end and one value"),
)
