"""A run in parts is the run: with noise to the bit, without it to rounding, with adaptive steps to their tolerance."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.runs.noise import integer_code_of_step_size, integer_codes_of_step_times
from liethermo.runs.schedule import ScheduleSegment
from tests.cases import BuiltOnUse
from tests.systems import oscillator

ENTROPY = lt.Quadratic(4.0 * np.ones(3))
ENERGY = lt.Quadratic([1 / 3, 1 / 2, 1.0])
NOISE = lt.Fluctuations(1.0, seed=3)
BATH = lt.Fluctuations(1.0, seed=3, temperature=0.5)
HOT = lt.Fluctuations(6.0, seed=0)
START = [1.0, 0.3, 0.2]
ARRAY = pytest.mark.slow


def run_in_parts(system, x0, times, step, **options):
    """The last of some runs, each of which goes on from the end of the one before."""
    x, attitude, run = x0, options.pop("attitude", None), None
    for span in itertools.pairwise(times):
        run = lt.integrate(system, x, span, step, attitude=attitude, **options)
        x, attitude = run.x[-1], None if run.attitude is None else run.attitude[-1]
    return run


def body(**options):
    return lt.LiePoissonSystem(mf.so(3), ENERGY, ENTROPY, lt.KillingDissipation(0.5), **options)


def magnet():
    return lt.models.spin_lattice((3, 5, 4), rate=1.0, baths=lt.HeatBaths(np.inf, 1.0))


NOISY = BuiltOnUse(
    {  # a system, its start, noise, step and times
        "body": lambda: (body(), START, NOISE, 0.05, (0.0, 1.5, 4.0)),
        "spin": lambda: (
            lt.LiePoissonSystem(mf.so(3), lambda s: -s[2], None, lt.DoubleBracket(0.5)), START, BATH, 0.05,
            (0.0, 1.5, 4.0),
        ),
        "Newton's method": lambda: (body(), START, HOT, 0.1, (0.0, 5.0, 20.0)),
        "bath": lambda: (
            lt.models.single_spin(2.0, 0.5, baths=lt.HeatBaths(200.0, 0.8)), [0.6, 0.0, 0.8, 0.0], NOISE, 0.1,
            (-0.7, 0.3, 1.0, 2.3),
        ),
        "attitude": lambda: (body(group=mf.SO(3)), START, NOISE, 0.05, (0.0, 1.5, 4.0)),
        "many steps": lambda: (body(), START, NOISE, 0.05, (0.0, 100.0, 301.5)),
    }
)  # fmt: skip


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=ARRAY)])
@pytest.mark.parametrize("name", NOISY)
def test_a_noisy_run_in_parts_is_the_run_to_the_bit(name, engine):
    system, x0, noise, step, times = NOISY[name]
    whole_run = lt.integrate(system, x0, (times[0], times[-1]), step, noise=noise, engine=engine)
    parts = run_in_parts(system, x0, times, step, noise=noise, engine=engine)
    assert np.array_equal(parts.x[-1], whole_run.x[-1])
    assert np.abs(np.diff(whole_run.x, axis=0)).max() > 0.1
    if whole_run.attitude is not None:
        assert np.array_equal(parts.attitude[-1], whole_run.attitude[-1])
    shifted_run = lt.integrate(system, parts.x[0], (0.0, times[-1] - times[-2]), step, noise=noise, engine=engine)
    assert np.abs(shifted_run.x[-1] - parts.x[-1]).max() > 1e-3  # the noise of another time is another one


@pytest.mark.slow
@pytest.mark.parametrize("case", ["lattice", "sphere", "rotor"])
def test_a_noisy_run_on_a_surface_in_parts(case):
    """Spins are on spheres, points on manifolds in the space around them or in charts."""
    system, x0, noise = {
        "lattice": lambda: (magnet(), np.asarray(magnet().state(np.tile([0.0, 0.0, 1.0], (3, 5, 4, 1)))), NOISE),
        "sphere": lambda: (
            lt.MetriplecticSystem(None, lambda x: x[2] + 0.3 * x[0] * x[1], None, lt.Friction(), space=mf.Sphere(2)),
            [0.6, 0.0, 0.8],
            BATH,
        ),
        "rotor": lambda: (
            lt.MetriplecticSystem(None, lambda R: -R[2, 2], None, lt.Friction(), space=mf.SpecialOrthogonal(3)),
            np.eye(3),
            BATH,
        ),
    }[case]()
    whole_run = lt.integrate(system, x0, (0.0, 1.0), 0.025, noise=noise)
    assert np.array_equal(run_in_parts(system, x0, (0.0, 0.4, 1.0), 0.025, noise=noise).x[-1], whole_run.x[-1])


def test_a_noisy_run_goes_on_from_a_file(tmp_path):
    system = body(group=mf.SO(3))
    whole_run = lt.integrate(system, START, (0.0, 3.0), 0.1, noise=NOISE)
    lt.integrate(system, START, (0.0, 1.3), 0.1, noise=NOISE, save_to=tmp_path / "half.nc")
    half = lt.load(tmp_path / "half.nc")
    rest = lt.integrate(system, half.x[-1], (half.t[-1], 3.0), 0.1, noise=NOISE, attitude=half.attitude[-1])
    assert np.array_equal(rest.x, whole_run.x[13:])
    assert np.array_equal(rest.attitude, whole_run.attitude[13:])


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=ARRAY)])
def test_a_noisy_ensemble_in_parts(engine):
    starts = np.random.default_rng(0).standard_normal((11, 3))
    options = {"noise": NOISE, "engine": engine}
    whole_run = lt.ensemble(body(), starts, (0.0, 2.0), 0.05, **options)
    first_part = lt.ensemble(body(), starts, (0.0, 0.75), 0.05, **options)
    rest = lt.ensemble(body(), first_part.x, (0.75, 2.0), 0.05, **options)
    assert np.array_equal(rest.x, whole_run.x)
    single_runs = lt.integrate(body(), first_part.x[4], (0.75, 2.0), 0.05, noise=NOISE.of(4), engine=engine)
    assert engine == "array" or np.array_equal(single_runs.x[-1], whole_run.x[4])


@pytest.mark.slow
def test_a_noisy_study_in_parts():
    """Replicas have seeds of their own; a study that starts where another one ended goes on with them."""

    def study(x0s, span):
        new_study = lt.Study(
            body(), {"replica": lt.replicas(x0s)}, t_span=span, step=0.05, measure={"final": "final"}, noise=NOISE
        )
        new_study.run(progress=False)
        return new_study.results.final.values

    starts = np.random.default_rng(0).standard_normal((4, 3))
    assert np.array_equal(study(study(starts, (0.0, 1.0)), (1.0, 2.0)), study(starts, (0.0, 2.0)))


def test_a_driven_noisy_run_in_parts_is_the_run_to_rounding():
    """The clock of a part is rounded when it starts; the noise is that of the run."""
    system = lt.LiePoissonSystem(mf.so(3), lambda s, t: -jnp.cos(t) * s[2], None, lt.DoubleBracket(0.5))
    whole_run = lt.integrate(system, START, (0.0, 13.1), 0.1, noise=BATH)
    assert (
        np.abs(run_in_parts(system, START, (0.0, 0.7, 1.3, 13.1), 0.1, noise=BATH).x[-1] - whole_run.x[-1]).max()
        < 1e-13
    )


@pytest.mark.slow
def test_a_loop_of_short_noisy_runs_has_the_mean_of_equilibrium():
    """The mean over 2,000 runs is <s3> = coth(1) - 1 for a spin in a field of one temperature."""
    system, noise = lt.models.single_spin(1.0, 0.5, baths=lt.HeatBaths(np.inf, 1.0)), lt.Fluctuations(seed=5)
    x, s3 = np.array([0.0, 0.0, 1.0, 0.0]), []
    for i in range(2000):
        x = lt.integrate(system, x, (float(i), i + 1.0), 0.1, noise=noise, save_every=10).x[-1]
        s3.append(x[2])
    blocks = np.reshape(s3, (40, 50)).mean(axis=1)
    exact = 1.0 / np.tanh(1.0) - 1.0
    assert abs(blocks.mean() - exact) < 3.0 * blocks.std(ddof=1) / np.sqrt(40)
    assert blocks.std() > 0.02  # it moves
    whole_run = lt.integrate(system, [0.0, 0.0, 1.0, 0.0], (0.0, 2000.0), 0.1, noise=noise, save_every=10)
    assert np.array_equal(whole_run.x[1:, 2], s3)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["body", "spin", "bath"])
def test_energy_and_casimirs_of_noisy_runs_do_not_drift(name):
    """Though no step hands on what rounding has kept: over 1e5 steps they stay within a few roundings."""
    system, x0, noise, _, _ = NOISY[name]
    times = [500.0, 1000.0, 2000.0]
    ensemble = lt.ensemble(
        system, np.tile(x0, (8, 1)), (0.0, 2000.0), 0.02, noise=noise, outputs="trajectory", save_at=times
    )
    assert ensemble.ok.all()
    if noise is not BATH:
        assert ensemble.energy_drift.max() < 5e-15
    if name != "body":
        squares = (ensemble.x[..., :3] ** 2).sum(axis=-1)
        assert np.abs(squares / np.sum(np.square(x0[:3])) - 1.0).max() < 2e-14


# -- the names of steps ------------------------------------------------------------------------------------------------


@pytest.mark.sampled(4)
@pytest.mark.parametrize("step", [0.1, 1e-3, 0.05, 1 / 3, 0.7, 1e6 / 7])
@pytest.mark.parametrize("offset", [0.0, 0.5, 0.25, 1 / 3, 0.1, 0.3, 1 / 128, 3 / 1024])
def test_steps_at_times_that_are_rounded_otherwise_have_the_same_names(step, offset):
    """Summed up one by one, multiplied, or as parts begin; from times far below zero to far above."""
    for first_step in (0, -1000, 10**6, -(10**9)):
        start = (first_step + offset) * step
        n = np.arange(2000)
        product_times = start + n * step
        sum_times = np.cumsum(np.append(start, np.full(1999, step)))
        shifted_times = (start + 700 * step) + (n - 700) * step
        product_cells = integer_codes_of_step_times(product_times, step, step)
        for times in (sum_times, shifted_times, (first_step + offset + n) * step):
            assert integer_codes_of_step_times(times, step, step)[0] == product_cells[0]
            assert np.array_equal(integer_codes_of_step_times(times, step, step)[1], product_cells[1])
        assert (np.diff(product_cells[1]) == 64).all()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("step", "steps"), [(0.1, 1), (0.1, 10), (0.01, 1), (1e-3, 100), (1 / 3, 3)])
def test_parts_have_the_steps_of_the_run_however_late_they_are(step, steps):
    """1024.9 - 1024.8 is more than 0.1 by rounding, which is no time for a step."""
    for first_step in [*range(0, 200_000, 17), 10**6, 10**7 + 3, 10**8 + 1]:
        part = ScheduleSegment.from_span(first_step * steps * step, (first_step + 1) * steps * step, step)
        assert (part.n_full_steps, part.last_step_size) == (steps, 0.0)
        part = ScheduleSegment.from_span(first_step * steps * step, (first_step + 1) * steps * step + 0.25 * step, step)
        assert part.n_full_steps == steps
        assert np.isclose(part.last_step_size, 0.25 * step, rtol=1e-4)


@pytest.mark.slow
def test_a_noisy_loop_of_single_steps_at_late_times():
    """Each of its parts is one step of the run, at whatever time."""
    whole_run = lt.integrate(body(), START, (0.0, 1100.0), 0.1, noise=NOISE)
    x = whole_run.x[10_240]
    for i in range(10_240, 10_360):
        x = lt.integrate(body(), x, (0.1 * i, 0.1 * (i + 1)), 0.1, noise=NOISE).x[-1]
    assert np.array_equal(x, whole_run.x[10_360])


def test_no_two_steps_of_a_path_have_the_same_name():
    """However short they are, in whatever order: the parts of a path that events divide."""
    rng = np.random.default_rng(0)
    lengths = np.minimum(0.1, 10.0 ** rng.uniform(-9.0, 0.0, 20_000))
    starts = -3.0 + np.append(0.0, np.cumsum(lengths)[:-1])
    names = set()
    for start, length in zip(starts, lengths, strict=True):
        halvings, cells = integer_codes_of_step_times(np.array([start]), length, 0.1)
        names.add((halvings, int(cells[0])))
    assert len(names) == len(lengths)


def test_names_of_steps_whose_sizes_are_rounded_otherwise():
    """A tenth of a span is the same step in all spans; steps that differ by more are others."""
    for i in range(1, 200):
        assert integer_code_of_step_size((0.1 * (i + 1) - 0.1 * i) / 10) == integer_code_of_step_size(0.01)
    for step in (0.1, 0.5, 1.0, 1 / 3, 1e-12, 7e30):
        assert (
            integer_code_of_step_size(step * (1 + 1e-12))
            == integer_code_of_step_size(step * (1 - 1e-12))
            == integer_code_of_step_size(step)
        )
        codes = [integer_code_of_step_size(step * (1.0 + 1e-8 * i)) for i in range(-5, 6)]
        assert len(set(codes)) == 11
        assert codes == sorted(codes)


def increments(noise=NOISE, count=2, members=8, starts=None, length=0.1, step=0.1):
    starts = 0.1 * np.arange(4000) if starts is None else starts
    return noise.increments(count, np.arange(members), starts, length, step) / np.sqrt(length)


def test_noise_of_other_times_seeds_trajectories_and_steps_is_independent():
    """Moments up to the fourth, and correlations, within four standard errors."""
    reference = increments()
    n = reference.size
    for power, mean, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs((reference**power).mean() - mean) < 4.0 * np.sqrt(variance / n)
    independent_increments = {
        "the next step": reference[:, 1:],
        "a later part": increments(starts=400.0 + 0.1 * np.arange(4000)),
        "before zero": increments(starts=-400.0 + 0.1 * np.arange(4000)),
        "half a step later": increments(starts=0.05 + 0.1 * np.arange(4000)),
        "far later": increments(starts=1e9 + 0.1 * np.arange(4000)),
        "another seed": increments(lt.Fluctuations(seed=4)),
        "other trajectories": increments(NOISE.of(8)),
        "another step": increments(length=0.2, step=0.2, starts=0.2 * np.arange(4000)),
        "shorter steps": increments(length=0.05, step=0.05, starts=0.05 * np.arange(4000)),
        "shortened steps": increments(length=0.04),
        "the other components": reference[..., ::-1],
        "the trajectories in another order": reference[::-1],
    }
    for what, increments_of_case in independent_increments.items():
        steps = increments_of_case.shape[1]
        for f, g in ((reference, increments_of_case), (reference**2 - 1.0, increments_of_case**2 - 1.0)):
            product = f[:, -steps:] * g if what != "the next step" else f[:, :-1] * g
            assert abs(product.mean()) < 4.0 * product.std() / np.sqrt(product.size), what


def test_parts_that_end_within_a_step_have_noise_of_their_own():
    """Their steps are others, so the path is another; its noise does not repeat, and the means are right."""
    system, noise = lt.models.single_spin(1.0, 0.5, baths=lt.HeatBaths(np.inf, 1.0)), lt.Fluctuations(seed=5)
    x = np.tile([0.0, 0.0, 1.0, 0.0], (400, 1))
    t, means = 0.0, []
    for i in range(200):
        end = t + (0.03, 0.25, 0.0025, 0.4)[i % 4]
        x = lt.ensemble(system, x, (t, end), 0.1, noise=noise).x
        t = end
        if t > 12.0:
            means.append(x[:, 2])
    path_means = np.mean(means, axis=0)
    assert abs(path_means.mean() - (1.0 / np.tanh(1.0) - 1.0)) < 4.0 * path_means.std() / np.sqrt(400)


# -- without noise -----------------------------------------------------------------------------------------------------


def driven_body():
    """A body with a wheel's friction inside, heat, a torque that depends on time, and on the attitude."""
    return lt.LiePoissonSystem(
        mf.so(3),
        ENERGY,
        dissipation=lt.DoubleBracket(0.2),
        baths=lt.HeatBaths(capacity=2.0, temperature=0.5),
        torque=lambda t, mu, g: 0.3 * jnp.sin(t) * g[0] - 0.1 * mu,
        group=mf.SO(3),
    )


NOISELESS_CASES = BuiltOnUse(
    {  # a system, its start, and a method
        "body, Gauss": lambda: (body(), START, lt.MetriplecticGauss(2)),
        "body, midpoint": lambda: (body(), START, lt.MetriplecticMidpoint()),
        "body, Runge-Kutta": lambda: (body(), START, lt.MetriplecticRungeKutta(4)),
        "body, Taylor": lambda: (body(), START, lt.MetriplecticTaylor(8)),
        "attitude, Gauss": lambda: (body(group=mf.SO(3)), START, lt.MetriplecticGauss(2)),
        "attitude, Runge-Kutta": lambda: (body(group=mf.SO(3)), START, lt.MetriplecticRungeKutta(4)),
        "bath": lambda: (
            lt.models.single_spin(2.0, 0.5, baths=lt.HeatBaths(200.0, 0.8)),
            [0.6, 0.0, 0.8, 0.0],
            lt.MetriplecticGauss(2),
        ),
        "drive, Gauss": lambda: (driven(), START, lt.MetriplecticGauss(2)),
        "drive, Runge-Kutta": lambda: (driven(), START, lt.MetriplecticRungeKutta(4)),
        "torque, Gauss": lambda: (driven_body(), START, lt.MetriplecticGauss(2)),
        "torque, Runge-Kutta": lambda: (driven_body(), START, lt.MetriplecticRungeKutta(4)),
    }
)


def driven():
    return lt.LiePoissonSystem(
        mf.so(3), lambda m, t: 0.5 * jnp.dot(m, jnp.array([1 / 3, 1 / 2, 1.0]) * m) + 0.3 * jnp.cos(2.0 * t) * m[0],
        ENTROPY, lt.KillingDissipation(0.1),
    )  # fmt: skip


TIMES = (-0.4, 0.1, 1.3, 2.0, 6.0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", NOISELESS_CASES)
def test_a_run_in_parts_is_the_run_to_rounding(name):
    """With equal steps; a part starts at its own time, from the last state and attitude of the one before."""
    system, x0, method = NOISELESS_CASES[name]
    whole_run = lt.integrate(system, x0, (TIMES[0], TIMES[-1]), 0.1, method)
    parts = run_in_parts(system, x0, TIMES, 0.1, method=method)
    assert np.abs(parts.x[-1] - whole_run.x[-1]).max() < 1e-13
    assert np.allclose(parts.t, whole_run.t[24:], rtol=0.0, atol=1e-14)
    if whole_run.attitude is not None:
        assert np.abs(parts.attitude[-1] - whole_run.attitude[-1]).max() < 1e-13
    shifted_run = run_in_parts(system, x0, tuple(t + 1.0 for t in TIMES), 0.1, method=method)
    distance = np.abs(shifted_run.x[-1] - whole_run.x[-1]).max()
    assert distance > 1e-2 if system.is_driven else distance < 1e-12  # the control: times are absolute


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["body, Gauss", "attitude, Runge-Kutta", "bath", "torque, Gauss"])
def test_a_run_goes_on_from_a_file(name, tmp_path):
    """States, times and attitudes of a file are those of the run, so what goes on from them is, to the bit."""
    system, x0, method = NOISELESS_CASES[name]
    half = lt.integrate(system, x0, (-0.4, 1.3), 0.1, method, save_to=tmp_path / "half.nc")
    loaded_run = lt.load(tmp_path / "half.nc")
    rests = [
        lt.integrate(
            system, run.x[-1], (run.t[-1], 4.0), 0.1, method,
            attitude=None if run.attitude is None else run.attitude[-1],
        )
        for run in (half, loaded_run)
    ]  # fmt: skip
    assert np.array_equal(rests[0].x, rests[1].x)
    assert np.array_equal(rests[0].t, rests[1].t)
    whole_run = lt.integrate(system, x0, (-0.4, 4.0), 0.1, method)
    assert np.abs(rests[1].x[-1] - whole_run.x[-1]).max() < 1e-13


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "name",
    [
        "body, Gauss",
        "attitude, Runge-Kutta",
        pytest.param("drive, Runge-Kutta", marks=pytest.mark.slow),
        pytest.param("torque, Gauss", marks=pytest.mark.slow),
    ],
)
def test_adaptive_steps_in_parts_agree_to_their_tolerance(name):
    """Each part begins with a step that it has to find; a tenth of the tolerance brings both ten times nearer."""
    system, x0, method = NOISELESS_CASES[name]
    distances = []
    for rtol in (1e-6, 1e-9):
        whole_run = lt.integrate(system, x0, (TIMES[0], TIMES[-1]), lt.Adaptive(rtol), method)
        parts = run_in_parts(system, x0, TIMES, lt.Adaptive(rtol), method=method)
        distances.append(np.abs(parts.x[-1] - whole_run.x[-1]).max() / rtol)
    assert max(distances) < 30.0


@pytest.mark.slow
def test_adaptive_steps_that_end_where_parts_do_are_those_of_parts():
    """A run that keeps its states at the ends of parts is the parts to a part of its tolerance."""
    whole_run = lt.integrate(driven(), START, (TIMES[0], TIMES[-1]), lt.Adaptive(1e-8), save_at=TIMES[1:])
    for i in range(1, len(TIMES)):
        part = run_in_parts(driven(), START, TIMES[: i + 1], lt.Adaptive(1e-8))
        assert np.abs(part.x[-1] - whole_run.x[np.searchsorted(whole_run.t, TIMES[i])]).max() < 1e-6


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.1, lt.Adaptive(1e-10)], ids=["fixed", "adaptive"])
@pytest.mark.parametrize("cut_time", [0.3, 1.5, 1.57, 1.5707, 1.6, 4.7, 5.0])
def test_events_of_a_run_in_parts_are_those_of_the_run(step, cut_time):
    """q = cos t is zero at pi/2, 3 pi/2, ...: wherever parts end, each is found once, at its time."""
    events, x, t = [], [1.0, 0.0], 0.0
    for end in (cut_time, 9.0):
        while t < end:
            run = lt.integrate(oscillator(), x, (t, end), step, lt.MetriplecticGauss(4), until=lambda z: z[0])
            x, t = run.x[-1], run.t[-1]
            if run.event_time is not None:
                events.append(run.event_time)
                tolerance = min(1e-3, end - t)  # off the event: by a step without one
                if tolerance > 0.0:
                    rest = lt.integrate(oscillator(), x, (t, t + tolerance), tolerance, lt.MetriplecticGauss(4))
                    x, t = rest.x[-1], rest.t[-1]
    assert np.allclose(events, np.pi * np.array([0.5, 1.5, 2.5]), rtol=0.0, atol=2e-8)


def test_relaxation_in_parts_ends_when_the_run_does():
    """The event of rest depends on the state alone."""
    until = lt.Relaxed(1e-6)
    whole_run = lt.integrate(body(), START, (0.0, 400.0), lt.Adaptive(1e-9), lt.MetriplecticRungeKutta(8), until=until)
    x, t = START, 0.0
    for end in np.arange(1.0, 400.0):
        part = lt.integrate(body(), x, (t, end), lt.Adaptive(1e-9), lt.MetriplecticRungeKutta(8), until=until)
        x, t = part.x[-1], part.t[-1]
        if part.event_time is not None:
            break
    assert whole_run.event_time is not None
    assert abs(t - whole_run.event_time) < 1e-4 * whole_run.event_time


@pytest.mark.slow
def test_a_flow_in_parts_is_the_flow():
    whole_run = lt.flow(driven(), jnp.array(START), (-0.4, 6.0), 0.1)
    x = jnp.array(START)
    for span in itertools.pairwise(TIMES):
        x = lt.flow(driven(), x, span, 0.1)
    assert np.abs(np.asarray(x - whole_run)).max() < 1e-13


@pytest.mark.slow
def test_an_ensemble_in_parts_is_the_ensemble():
    """Also of a driven family, from states at the end of another ensemble."""

    def member(p):
        return lt.LiePoissonSystem(
            mf.so(3), lambda m, t: 0.5 * jnp.sum(m * m * jnp.array([1.0, 0.5, 0.3])) + p * jnp.cos(t) * m[0],
            ENTROPY, lt.KillingDissipation(0.1),
        )  # fmt: skip

    strengths, starts = np.linspace(0.1, 0.5, 5), np.random.default_rng(0).standard_normal((5, 3))
    for step, tolerance in ((0.05, 1e-13), (lt.Adaptive(1e-9), 1e-7)):
        whole_run = lt.ensemble(member, starts, (-0.5, 3.0), step, parameters=strengths)
        first_part = lt.ensemble(member, starts, (-0.5, 0.75), step, parameters=strengths)
        rest = lt.ensemble(member, first_part.x, (0.75, 3.0), step, parameters=strengths)
        assert np.abs(rest.x - whole_run.x).max() < tolerance
