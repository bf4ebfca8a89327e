"""Runs with noise: exact energy on every path, one path whatever takes it, no noise to the bit, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.select_engine import EngineWithFallback
from liethermo.integrators.fluctuating import noise_dimension, with_noise_increments
from liethermo.models.gases import gas_piston_state
from liethermo.runs.noise import threefry
from liethermo.tracing import programs
from tests.cases import BuiltOnUse

ENTROPY = lt.Quadratic(4.0 * np.ones(3))
BODY = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), ENTROPY, lt.KillingDissipation(0.5))
NONQUADRATIC_BODY = lt.LiePoissonSystem(
    mf.so(3),
    lambda m: 0.5 * jnp.sum(m * m * jnp.array([1 / 3, 1 / 2, 1.0])) + 0.3 * jnp.cos(2.0 * m[0]),
    ENTROPY,
    lt.ProjectedMetric(normalized=True, rate=0.5),
)
FIELD = np.array([0.0, 0.0, -1.0])
SPIN = lt.LiePoissonSystem(mf.so(3), lambda s: jnp.dot(FIELD, s), None, lt.DoubleBracket(0.5))
START = np.array([1.0, 0.3, 0.2])
NOISE = lt.Fluctuations(1.0, seed=3)
BATH = lt.Fluctuations(1.0, seed=3, temperature=0.5)


def run(system, noise, engine, **arguments):
    return lt.integrate(system, START, (0.0, 5.02), 0.05, noise=noise, engine=engine, **arguments)


@pytest.mark.parametrize(
    ("system", "noise"),
    [
        pytest.param(BODY, NOISE, id="body", marks=pytest.mark.slow),
        pytest.param(NONQUADRATIC_BODY, NOISE, id="curved", marks=pytest.mark.slow),
        pytest.param(SPIN, BATH, id="spin"),
    ],
)
def test_both_engines_take_the_same_path(system, noise):
    """The energy is exact on it, and so is the length of a spin in a bath; a short last step has its own noise."""
    array, compiled_run = (run(system, noise, engine) for engine in ("array", "compiled"))
    assert np.abs(array.x - compiled_run.x).max() < 1e-13
    assert np.abs(np.diff(array.x, axis=0)).max() > 0.1
    for solution in (array, compiled_run):
        audit = solution.audit()
        assert audit.passed, str(audit)
        assert audit.energy_drift < 1e-14 or noise is BATH
    if noise is BATH:
        assert np.abs(np.linalg.norm(array.x, axis=1) / np.linalg.norm(START) - 1.0).max() < 1e-14
        assert np.ptp(array.energy) > 0.1
    else:
        assert np.diff(array.entropy).min() < -0.01  # the entropy law is one of the mean
        assert "a law of the mean" in str(array.audit())


def test_an_ensemble_with_noise_shows_the_rows_of_one_run():
    """The length of a spin is conserved on every path, and an ensemble says so too."""
    single = run(SPIN, BATH, "compiled").audit()
    many = lt.ensemble(SPIN, np.stack([START, -START]), (0.0, 5.02), 0.05, noise=BATH, engine="compiled").audit()
    drifts = [[row for row in audit.rows if row.law.startswith("drift of")] for audit in (single, many)]
    assert [[(row.law, row.passed) for row in rows] for rows in drifts] == [
        [("drift of mu1**2 + mu2**2 + mu3**2", True)]
    ] * 2
    assert many.casimir_drift < 1e-14


def test_a_path_depends_on_seed_and_numbers_alone():
    """Not on what is saved, on the size of the ensemble, its lanes and portions, or the engine."""
    whole_run = lt.ensemble(BODY, np.tile(START, (19, 1)), (0.0, 2.0), 0.05, noise=NOISE, outputs="trajectory")
    assert whole_run.engine == "compiled"
    assert len({x.tobytes() for x in whole_run.x[:, -1]}) == 19
    one = lt.integrate(BODY, START, (0.0, 2.0), 0.05, noise=NOISE.of(17), engine="compiled", save_every=7)
    assert np.array_equal(one.x[:-1], whole_run.x[17, ::7])
    part = lt.ensemble(BODY, np.tile(START, (3, 1)), (0.0, 2.0), 0.05, noise=NOISE.of(16))
    assert np.array_equal(part.x, whole_run.x[16:, -1])
    seeds = lt.Fluctuations(1.0, seed=(5, 3))
    two = lt.ensemble(BODY, np.tile(START, (2, 1)), (0.0, 2.0), 0.05, noise=seeds)
    assert np.array_equal(two.x[1], whole_run.x[0, -1])
    assert not np.array_equal(two.x[0], two.x[1])
    stops = lt.ensemble(BODY, np.tile(START, (2, 1)), (0.0, 2.0), 0.05, noise=NOISE, save_at=[0.5, 1.0, 2.0])
    assert np.abs(stops.x[:, 1:] - whole_run.x[:2, [10, 20, 40]]).max() < 1e-12


@pytest.mark.slow
def test_an_ensemble_of_the_array_engine():
    """By ``vmap``, over several calls of the engine."""
    arguments = np.tile(START, (3, 1)), (0.0, 2.02), 0.05
    array, compiled_run = (lt.ensemble(BODY, *arguments, noise=NOISE, engine=e) for e in ("array", "compiled"))
    assert np.abs(array.x - compiled_run.x).max() < 1e-13


def test_random_numbers_are_those_of_the_paper():
    """The known answers that come with Random123."""
    for key, counter, words in (
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ):
        found = threefry(*(tuple(np.array([w], np.uint32) for w in pair) for pair in (key, counter)))
        assert tuple(int(w[0]) for w in found) == words


def test_random_numbers_in_portions():
    """Normal, independent, bounded; the same however they are asked for."""
    all_increments = NOISE.increments_of_equal_steps(3, np.arange(40), 0, 1000, 1.0)
    assert np.array_equal(
        NOISE.increments_of_equal_steps(3, np.arange(10, 20), 100, 57, 1.0), all_increments[10:20, 100:157]
    )
    assert abs(
        (2.0 * NOISE.increments_of_equal_steps(3, np.arange(40), 0, 1000, 0.25) * all_increments).mean()
    ) < 4 / np.sqrt(all_increments.size)
    sample = all_increments.ravel()
    count = len(sample)
    assert abs(sample.mean()) < 4 / np.sqrt(count)
    assert abs(sample.var() - 1.0) < 4 * np.sqrt(2 / count)
    assert abs((sample**4).mean() - 3.0) < 4 * np.sqrt(96 / count)
    assert abs((all_increments[:, 1:] * all_increments[:, :-1]).mean()) < 4 / np.sqrt(count)
    assert abs((all_increments[1:] * all_increments[:-1]).mean()) < 4 / np.sqrt(count)
    assert np.abs(sample).max() < 6.0


@pytest.mark.parametrize("engine", [pytest.param("array", marks=pytest.mark.slow), "compiled"])
def test_no_noise_is_the_run_without_to_the_bit(engine):
    quiet = run(BODY, lt.Fluctuations(0.0), engine)
    assert np.array_equal(quiet.x, run(BODY, None, engine, method=lt.MetriplecticMidpoint()).x)
    assert quiet.audit().passed


def test_little_noise_is_nearly_the_run_without():
    """The distance from the run without noise is proportional to the square root of k."""
    still = run(BODY, None, "compiled", method=lt.MetriplecticMidpoint()).x
    distances = [np.abs(run(BODY, lt.Fluctuations(k, 1), "compiled").x - still).max() for k in (1e-8, 1e-10, 1e-12)]
    assert np.allclose(np.array(distances[:-1]) / distances[1:], 10.0, rtol=0.01)


@pytest.mark.slow
def test_a_lattice_needs_few_programs(monkeypatch):
    """One takes the steps, one begins a run, and the axioms have one: no size adds any, nor does another run."""
    trace_counts = []
    monkeypatch.setattr(
        programs._ArrayFunction, "__call__", _record_calls(programs._ArrayFunction.__call__, trace_counts)
    )
    sites = (3, 5, 4)
    magnet = lt.models.spin_lattice(sites, rate=1.0, baths=lt.HeatBaths(np.inf, 1.0))
    up = magnet.state(np.tile([0.0, 0.0, 1.0], (*sites, 1)))
    for seed, steps in ((1, 1), (2, 30)):
        run = lt.integrate(
            magnet, up, (0.0, 0.025 * steps), 0.025, noise=lt.Fluctuations(seed=seed), save_every=steps, engine="array"
        )
        assert run.stats.newton_iterations == 0
    programs_of_runs = [name for name in trace_counts if name in ("advance", "initial_run_state", "_map_over_points")]
    assert sorted(programs_of_runs) == ["_map_over_points", "advance", "initial_run_state"]


def _record_calls(call, names: list):
    def recording_call(self, dynamic):
        names.append(self.__name__)
        return call(self, dynamic)

    return recording_call


@pytest.mark.slow
def test_newton_where_the_fixed_point_is_too_far():
    """Noise so large that fixed-point iteration fails; both engines solve the same equation."""
    noise = lt.Fluctuations(6.0, 0)
    array, compiled_run = (
        lt.integrate(BODY, START, (0.0, 20.0), 0.1, noise=noise, engine=e) for e in ("array", "compiled")
    )
    assert min(array.stats.newton_iterations, compiled_run.stats.newton_iterations) > 0
    for solution in (array, compiled_run):
        assert solution.audit().passed
    assert np.abs(array.x[:20] - compiled_run.x[:20]).max() < 1e-9


@pytest.mark.slow
def test_attitudes_with_noise():
    """A body that fluctuates has an attitude, in its group, and moves its momentum as without one."""
    body = lt.LiePoissonSystem(mf.so(3), BODY.energy, ENTROPY, lt.KillingDissipation(0.5), group=mf.SO(3))
    solution = run(body, NOISE, "array")
    assert solution.audit().passed
    assert np.abs(solution.x - run(BODY, NOISE, "array").x).max() < 1e-12


@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
def test_noise_inside_a_body_keeps_its_momentum_in_space(engine):
    """The noise of a double bracket is a velocity too, and the attitude follows it; a bath takes the energy."""
    body = lt.LiePoissonSystem(mf.so(3), BODY.energy, dissipation=lt.DoubleBracket(0.2), group=mf.SO(3))
    noise = lt.Fluctuations(0.01, 3, temperature=1.0)
    solution = lt.integrate(body, START, (0.0, 10.0), 0.05, noise=noise, engine=engine)
    assert np.ptp(solution.x, axis=0).max() > 0.1
    (row,) = [row for row in solution.audit().rows if row.law == "drift of momentum in space"]
    assert row.passed
    assert row.value < 1e-14
    torque = lt.LiePoissonSystem(mf.so(3), BODY.energy, ENTROPY, lt.KillingDissipation(0.5), group=mf.SO(3))
    solution = lt.integrate(torque, START, (0.0, 1.0), 0.05, noise=NOISE, engine=engine)
    (row,) = [row for row in solution.audit().rows if row.law == "change of momentum in space"]
    assert row.passed is None
    assert row.value > 1e-3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"boltzmann": -1.0}, "boltzmann must be finite and >= 0"),
        ({"boltzmann": "much"}, "must be a number"),
        ({"seed": -1}, "seed must be an integer"),
        ({"seed": 0.5}, "seed must be an integer"),
        ({"seed": (1, 2, 1)}, "trajectories 0 and 2 have the same seed 1"),
        ({"temperature": -2.0}, "temperature"),
        ({"first": -1}, "first must be an integer"),
    ],
)
def test_unusable_noise(arguments, words):
    with pytest.raises(lt.InputError, match=words):
        lt.Fluctuations(**arguments)


class WrongNoiseFactor(lt.KillingDissipation):
    """Control: a factor that is 10 % too large."""

    def factor(self, system, x, dH, dL):
        return super().factor(system, x, dH, dL).scale_by(jnp.asarray(1.21))

    def bind_to(self, system):
        found = super().bind_to(system)
        return WrongNoiseFactor(found.rate, found.form)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dissipation": None}, "has none"),
        ({"dissipation": lt.EulerPoincareForce(jnp.sin)}, "EulerPoincareForce gives no factor"),
        ({"dissipation": lt.DissipationPotential(lt.CoulombFriction())}, "DissipationPotential gives no factor"),
        ({"dissipation": lt.DoubleBracket()}, "temperature of the bath"),
        ({"dissipation": WrongNoiseFactor()}, "differs from K dS by a relative error of 0.2"),
        ({"noise": lt.Fluctuations(temperature=1.0)}, "lowers the energy"),
        ({"noise": 1e-3}, "lt.Fluctuations"),
        ({"noise": lt.Fluctuations(seed=(1, 2))}, "2 seeds for 1"),
        ({"method": lt.MetriplecticGauss(2)}, "MetriplecticGauss"),
        ({"method": lt.MetriplecticRungeKutta(4)}, "MetriplecticRungeKutta"),
        ({"method": lt.Reference()}, "Reference"),
        ({"step": lt.Adaptive()}, "needs fixed steps"),
        ({"until": lt.Relaxed(1e-3)}, "needs fixed steps"),
        ({"dense": True}, "needs fixed steps"),
    ],
)
def test_what_has_no_noise(change, words):
    system = lt.LiePoissonSystem(
        mf.so(3), BODY.energy, ENTROPY, change.pop("dissipation", lt.KillingDissipation()), validate=False
    )
    arguments = {"step": 0.1, "noise": NOISE} | change
    with pytest.raises(lt.InputError, match=words):
        lt.integrate(system, START, (0.0, 1.0), **arguments)


def test_noise_is_named_in_the_provenance():
    solution = run(BODY, NOISE, "compiled")
    assert solution.provenance["noise"]["seed"] == 3
    assert jax.__version__ == solution.provenance["jax"]


@dataclasses.dataclass
class CoarsenedPath:
    """The increments of a fine path, added up for longer steps."""

    fine: np.ndarray
    factor: int

    def __call__(self, first_step, steps, h):
        del h
        increments = self.fine[first_step * self.factor : (first_step + steps) * self.factor]
        return increments.reshape(steps, self.factor, -1).sum(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "noise"), [(BODY, NOISE), (NONQUADRATIC_BODY, NOISE), (SPIN, BATH)], ids=["body", "curved", "spin"]
)
def test_paths_converge_in_the_mean_square(system, noise):
    """To those of the same Brownian motion with shorter steps, with order 1/2 at least."""
    fine, T, paths = 4096, 1.0, 120
    method, levels, errors = noise.method_with_noise(system, lt.MetriplecticMidpoint()), (64, 128, 256, 512), []
    increments = np.sqrt(T / fine) * np.random.default_rng(0).standard_normal((paths, fine, noise_dimension(method)))

    def end(W, steps):
        engine = EngineWithFallback(system, method, "compiled", steps, CoarsenedPath(W, fine // steps))
        return np.asarray(engine.advance(engine.initial_run_state(START), T / steps, 1, steps)[0].x)

    exact = np.array([end(W, fine) for W in increments])
    for steps in levels:
        errors.append(np.sqrt(((np.array([end(W, steps) for W in increments]) - exact) ** 2).sum(axis=1).mean()))
    order = -np.polyfit(np.log(levels), np.log(errors), 1)[0]
    assert order > 0.4, (order, errors)


@pytest.mark.slow
def test_a_spin_with_a_bath_of_its_own():
    """The bath is a body: the energy of both is exact on a path, and the length of the spin; the heat is recorded."""
    system = lt.models.single_spin(field=2.0, rate=0.5, baths=lt.HeatBaths(capacity=200.0, temperature=0.8))
    x0 = np.tile([0.6, 0.0, 0.8, 0.0], (2000, 1))
    ensemble = lt.ensemble(system, x0, (0.0, 12.0), 0.05, noise=NOISE, outputs="trajectory", save_every=10)
    assert ensemble.audit().passed
    assert ensemble.energy_drift.max() < 1e-13
    assert np.abs(np.linalg.norm(ensemble.x[..., :3], axis=-1) - 1.0).max() < 1e-13
    heat = 200.0 * 0.8 * np.expm1(ensemble.x[..., 3] / 200.0)
    lost_energy = 2.0 * (ensemble.x[..., 2] - 0.8)
    assert np.abs(heat - lost_energy).max() < 1e-11
    late_means = ensemble.x[:, ensemble.t >= 6.0, 2].mean(axis=1)
    z = 2.0 / 0.8
    assert abs(late_means.mean() - (1 / np.tanh(z) - 1 / z)) < 3.5 * late_means.std() / np.sqrt(2000) + 0.005


def _of(g, energy, entropy, rate):
    return lt.LiePoissonSystem(g, lt.Quadratic(energy), lt.Quadratic(entropy), lt.KillingDissipation(rate))


def _curved_form(n):
    A = np.random.default_rng(0).standard_normal((n, n))
    return A @ A.T / n + np.eye(n)


LONG_RUNS = BuiltOnUse(
    {  # k, the step, and a body of each kind
        "so(3)": lambda: (1.0, 0.02, BODY, START),
        "se(3)": lambda: (
            0.05,
            0.02,
            _of(mf.se(3), [1.0, 0.5, 0.4, 0.8, 0.7, 0.9], [0.0, 0.0, 0.0, -1.0, -1.0, -1.0], 0.3),
            [0.6, -0.3, 0.5, 0.4, 0.7, -0.2],
        ),
        "su(3)": lambda: (
            0.02,
            0.02,
            _of(mf.su(3), _curved_form(8), -np.ones(8), 0.02),
            0.2 * np.arange(-3.0, 5.0),
        ),
        "spin with a bath": lambda: (
            1.0,
            0.02,
            lt.models.single_spin(field=2.0, rate=0.5, baths=lt.HeatBaths(capacity=200.0, temperature=0.8)),
            [0.6, 0.0, 0.8, 0.0],
        ),
        "gases": lambda: (
            1e-3,
            2e-3,
            lt.models.gas_piston(moles=(1.0, 2.0), conductance=(100.0, 100.0)),
            gas_piston_state(0.4, (300.0, 310.0, 300.0), moles=(1.0, 2.0)),
        ),
    }
)


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG_RUNS)
def test_a_thousand_paths_of_ten_thousand_steps_keep_their_energy(name):
    k, h, system, x0 = LONG_RUNS[name]
    times = (0.0, 10_000 * h)
    x0 = np.tile(np.asarray(x0, dtype=float), (1000, 1))
    ensemble = lt.ensemble(
        system, x0, times, h, noise=lt.Fluctuations(k, seed=1), outputs="trajectory", save_every=2500
    )
    assert ensemble.ok.all()
    assert ensemble.energy_drift.max() < 1e-13
    assert np.ptp(ensemble.x[:, -1], axis=0).max() > 0.0
    if name == "spin with a bath":
        assert np.abs(np.linalg.norm(ensemble.x[..., :3], axis=-1) - 1.0).max() < 1e-13


@pytest.mark.slow
def test_heat_of_a_bath_is_what_the_energy_changes_by():
    """In every step: friction and noise do the work that the discrete gradient of H measures, the motion none."""
    system = rotor()
    solution = run(system, BATH, "array")
    method, gradient = lt.MetriplecticMidpoint(), lt.Gonzalez()
    rows = BATH.increments_of_equal_steps(3, np.zeros(1, int), 0, 100, 0.05)[0]
    noisy = BATH.method_with_noise(system, method)

    @jax.jit
    @jax.vmap
    def defect(x, new, dW):
        d, compensation = new - x, jnp.zeros(3)
        dH = gradient(system.energy, x, d, compensation)
        velocity = system.poisson.sharp(x + 0.5 * d, dH)
        heat = jnp.dot(
            dH,
            0.05
            * (with_noise_increments(noisy, dW).slopes(system, x, compensation, 0.05, d[None] / 0.05)[0] - velocity),
        )
        return heat - (system.energy.value(new) - system.energy.value(x)), jnp.dot(dH, velocity)

    heat, motion = defect(*map(jnp.asarray, (solution.x[:100], solution.x[1:101], rows)))
    assert np.abs(heat).max() < 1e-13
    assert np.abs(motion).max() < 1e-14


def rotor():
    return lt.LiePoissonSystem(
        mf.so(3), lambda m: 0.5 * jnp.dot(m, m) + 0.3 * jnp.cos(m[0]), None, lt.Friction(np.ones(3))
    )
