"""Energies that depend on time: orders, the law dH = work, the entropy law, ensembles, derivatives, refusals."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.systems.driven import CLOCK_UNIT, DrivenSystem
from liethermo.tracing.interpret import evaluate_at_points
from tests.refusals import refusal_test

RATE = 1.3
SPAN = (0.5, 3.5)

LAW = 3e-14
"""Limit of the drift of ``H - W`` relative to H over 10^4 steps; 1.2e-14 seen."""

SPIN_START = np.array([0.4, 0.7, -0.5])
INERTIA = np.array([2.0, 1.0, 2 / 3])


def still(x):
    """A pendulum with a stiffer spring."""
    return 0.5 * x[1] ** 2 + 1.0 - jnp.cos(x[0]) + 0.1 * x[0] ** 4


def still_in_time(x, t):
    del t
    return still(x)


def shaken(x, t):
    return still(x) - 0.4 * x[0] * x[1] * jnp.sin(RATE * t)


def energy_in_rotating_field(mu, t):
    field = 0.3 * (mu[0] * jnp.cos(RATE * t) + mu[1] * jnp.sin(RATE * t))
    return jnp.sum(mu**2 / INERTIA) / 2 - field + 0.1 * mu[2] ** 4


class Push(eqx.Module):
    """Energy of a periodic force on a spring, with an amplitude that is a parameter."""

    amplitude: jax.Array

    def __call__(self, x, t):
        return -self.amplitude * x[0] * jnp.cos(RATE * t)


def pushed_spring(amplitude) -> lt.MetriplecticSystem:
    energy = lt.Quadratic(np.ones(2)) + lt.TimeDependent(Push(jnp.asarray(amplitude)))
    return lt.MetriplecticSystem(mf.Canonical(1), energy)


def pushed_exactly(t, amplitude=0.5, start=(1.0, 0.0), t0=0.7):
    """q and p at times, shape (..., 2)."""
    size = amplitude / (1.0 - RATE**2)
    q, p = start[0] - size * np.cos(RATE * t0), start[1] + size * RATE * np.sin(RATE * t0)
    c, s = np.cos(t - t0), np.sin(t - t0)
    driven = size * np.cos(RATE * t), -size * RATE * np.sin(RATE * t)
    return np.stack([q * c + p * s + driven[0], p * c - q * s + driven[1]], axis=-1)


SPIN = lt.LiePoissonSystem(
    mf.so(3), energy_in_rotating_field, lambda mu: jnp.exp(0.3 * mu @ mu), lt.KillingDissipation(0.05), validate=False
)
SHAKEN = lt.MetriplecticSystem(mf.Canonical(1), shaken)
STILL = lt.MetriplecticSystem(mf.Canonical(1), still)
STILL_IN_TIME = lt.MetriplecticSystem(mf.Canonical(1), still_in_time)
CASES = {"spin": (SPIN, SPIN_START), "shaken": (SHAKEN, np.array([1.0, 0.2]))}
GAUSS = {s: lt.MetriplecticGauss(s) for s in (1, 2, 3)}


@pytest.fixture(scope="module")
def ends():
    """States at the end of the span by SciPy, to 1e-13, from fields written here by hand."""

    def shaken_rate(t, x):
        push = 0.4 * np.sin(RATE * t)
        return np.array([x[1] - push * x[0], push * x[1] - np.sin(x[0]) - 0.4 * x[0] ** 3])

    def spin_rate(t, mu):
        xi = mu / INERTIA - 0.3 * np.array([np.cos(RATE * t), np.sin(RATE * t), 0.0]) + [0.0, 0.0, 0.4 * mu[2] ** 3]
        dS = 0.6 * mu * np.exp(0.3 * mu @ mu)
        return np.cross(mu, xi) + 0.05 * 2.0 * (xi @ xi * dS - xi @ dS * xi)

    rates = {"spin": spin_rate, "shaken": shaken_rate}
    return {
        name: solve_ivp(rates[name], SPAN, x0, method="DOP853", rtol=3e-14, atol=1e-14).y[:, -1]
        for name, (_, x0) in CASES.items()
    }


STEPS = {2: (30, 60, 120), 4: (15, 30, 60), 6: (8, 12, 18)}


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("case", "method"),
    [
        ("shaken", GAUSS[2]),
        ("spin", GAUSS[2]),
        *(
            pytest.param(case, method, marks=pytest.mark.slow)
            for case, method in [
                ("shaken", GAUSS[1]),
                ("shaken", GAUSS[3]),
                ("spin", GAUSS[1]),
                ("spin", GAUSS[3]),
                ("spin", lt.MetriplecticMidpoint("mean_value")),
                ("spin", lt.MetriplecticMidpoint("symmetric_coordinate_increment")),
                ("shaken", lt.MetriplecticMidpoint()),
            ]
        ),
    ],
    ids=str,
)
def test_orders_and_laws_against_scipy(case, method, ends):
    system, x0 = CASES[case]
    errors = []
    for n in STEPS[method.order]:
        run = lt.integrate(system, x0, SPAN, (SPAN[1] - SPAN[0]) / n, method, engine="compiled")
        audit = run.audit()
        assert audit.energy_drift <= LAW, audit
        assert audit.passed or "entropy_law" not in method.preserves, audit
        work = run.casimirs["work"]
        assert np.abs(work).max() > 0.01
        assert np.abs(run.energy - system.energy(run.x, run.t)).max() < 1e-14
        assert np.abs(run.energy - run.energy[0] - work).max() < 1e-14
        errors.append(np.abs(run.x[-1] - ends[case]).max())
    n = np.array(STEPS[method.order])
    slopes = np.log(np.array(errors[:-1]) / errors[1:]) / np.log(n[1:] / n[:-1])
    assert errors[-1] > 1e-12, "at the rounding plateau nothing is measured"
    assert (np.abs(slopes - method.order) < 0.25).all(), (errors, slopes)


@pytest.mark.slow
def test_the_law_over_ten_thousand_steps():
    run = lt.integrate(SHAKEN, [1.0, 0.2], (0.5, 100.5), 0.01, GAUSS[2], engine="compiled", save_every=100)
    audit = run.audit()
    assert run.stats.steps == 10_000
    assert audit.passed
    assert audit.energy_drift <= LAW
    assert "energy minus work drift" in str(audit)
    assert np.ptp(run.energy) > 0.01, "work is done"


def _slopes(model, z):
    """Return the slopes of a step of 0.3 from z, a state followed by the initial slopes, one after another."""
    system, method = model
    y, k = z[: system.dim], z[system.dim :].reshape(method.stages, -1)
    return method.slopes(system, y, jnp.zeros_like(y), 0.3, k)


def slopes(system, method, states, rates):
    """At some states, shape (m, n), with slopes, shape (m, stages, n), in a driven system with ``t' = 1``."""
    if system.is_driven:
        system = DrivenSystem(system)
        states = system.initial_state(states, 0.5, batch=True)
        rates = np.concatenate([rates, np.full((*rates.shape[:-1], 2), system.unit)], axis=-1)
    return evaluate_at_points(
        _slopes, (system, method), np.concatenate([states, rates.reshape(len(rates), -1)], axis=1)
    )


METHODS = [
    *map(lt.MetriplecticMidpoint, ("gonzalez", "mean_value", "coordinate_increment", "symmetric_coordinate_increment")),
    *GAUSS.values(),
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_an_energy_that_does_not_change_does_no_work(method):
    """Written as H(x, t) it gives the steps of H(x), whatever the slopes handed to the method."""
    rng = np.random.default_rng(1)
    states, rates = rng.standard_normal((4, 2)), rng.standard_normal((4, method.stages, 2))
    plain, timed = (slopes(s, method, states, rates) for s in (STILL, STILL_IN_TIME))
    assert np.abs(timed[..., :2] - plain).max() < 1e-14
    assert np.abs(timed[..., -1]).max() == 0.0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_time_is_exact(method):
    """Whatever the slopes handed to the method, t' = 1, where the entropy law and the energy are corrected too."""
    rng = np.random.default_rng(1)
    states, rates = rng.standard_normal((4, 3)), rng.standard_normal((4, method.stages, 3))
    clock, work = np.moveaxis(slopes(SPIN, method, states, rates)[..., -2:] / CLOCK_UNIT, -1, 0)
    assert np.abs(clock - 1.0).max() < 1e-15
    assert np.abs(work).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", [GAUSS[2], lt.MetriplecticMidpoint()], ids=str)
def test_the_trajectory_of_an_energy_that_does_not_change(method):
    runs = [lt.integrate(s, [1.0, 0.2], (0.5, 20.5), 0.1, method, engine="compiled") for s in (STILL, STILL_IN_TIME)]
    assert np.abs(runs[0].x - runs[1].x).max() < 1e-13
    assert np.abs(runs[1].casimirs["work"]).max() == 0.0


def test_an_audit_sees_work_that_is_wrong():
    """Control: an ordinary solver loses the balance, and an energy that is pushed is not constant."""
    run = lt.integrate(pushed_spring(0.5), [1.0, 0.0], (0.7, 20.7), 0.1, lt.Reference(1e-6))
    assert np.abs(run.x - pushed_exactly(run.t)).max() < 1e-4
    assert 1e-10 < run.audit().energy_drift < 1e-3
    assert not run.audit().passed
    assert np.ptp(run.energy) > 0.1


def test_adaptive_steps_events_dense_output_and_files(tmp_path, ends):
    method, x0 = GAUSS[2], CASES["shaken"][1]
    run = lt.integrate(SHAKEN, x0, SPAN, lt.Adaptive(1e-9), method, dense=True, engine="compiled")
    assert run.x.shape[1] == 2
    assert np.abs(run.x[-1] - ends["shaken"]).max() < 1e-7
    assert np.abs(run(run.t) - run.x).max() < 1e-14
    assert np.abs(run.energy_balance - run.energy[0]).max() < 1e-14

    late = lt.integrate(SHAKEN, x0, SPAN, 0.05, method, until=lambda x: x[0] - 0.2, engine="compiled")
    assert abs(late.x[-1, 0] - 0.2) < 1e-14
    assert np.abs(run(late.event_time) - late.x[-1]).max() < 1e-4

    loaded = lt.load(late.save(tmp_path / "driven.nc"))
    assert loaded.laws == late.laws
    assert loaded.laws.balance == ("work",)
    assert str(loaded.audit()) == str(late.audit())


def test_adaptive_steps_do_not_see_the_clock():
    """The steps do not depend on the starting time: an error is relative to the user's state, not to the time."""
    period = 2.0 * np.pi / RATE
    starts = [0.5, 0.5 + 10_000 * period]
    runs = [
        lt.integrate(SHAKEN, [1.0, 0.2], (t, t + 3.0), lt.Adaptive(1e-6), GAUSS[2], engine="compiled") for t in starts
    ]
    assert runs[0].stats.steps == runs[1].stats.steps
    assert np.abs(runs[0].x[-1] - runs[1].x[-1]).max() < 1e-9


@pytest.mark.slow
def test_a_sweep_of_the_amplitude():
    amplitudes = np.linspace(0.0, 1.0, 5)
    found_values = lt.ensemble(
        pushed_spring, [1.0, 0.0], (0.7, 5.7), 0.05, parameters=amplitudes, outputs="trajectory", save_every=10
    )
    assert found_values.ok.all()
    assert found_values.x.shape == (5, 11, 2)
    assert np.abs(found_values.x - [pushed_exactly(found_values.t, a) for a in amplitudes]).max() < 3e-3
    assert np.abs(found_values.work[0]).max() == 0.0
    assert np.abs(found_values.work[1:, -1]).min() > 0.01
    expected_values = [
        pushed_spring(a).energy(x, found_values.t) for a, x in zip(amplitudes, found_values.x, strict=True)
    ]
    assert np.abs(found_values.energy - expected_values).max() < 1e-14
    assert np.abs(found_values.energy - found_values.energy[:, :1] - found_values.work).max() < 1e-14
    assert found_values.audit(energy=1e-12).passed
    assert "energy minus work drift" in str(found_values.audit())


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_a_sweep_by_the_name_of_the_parameter(engine):
    amplitudes = np.linspace(0.0, 1.0, 5)
    named = {"energy.summands[1].function.amplitude": amplitudes}
    found_values = lt.ensemble(
        pushed_spring(9.0), [1.0, 0.0], (0.7, 5.7), 0.05, GAUSS[2], parameters=named, engine=engine
    )
    assert np.abs(found_values.x - [pushed_exactly(5.7, a) for a in amplitudes]).max() < 1e-6
    short = lt.ensemble(
        pushed_spring(9.0), [1.0, 0.0], (0.7, 5.7), 0.05, GAUSS[2], parameters=named, engine=engine, outputs="summary"
    )
    assert short.x is None
    assert np.array_equal(short.work, found_values.work)
    assert np.array_equal(short.energy, found_values.energy)


@pytest.mark.slow
def test_the_derivative_of_a_flow_by_the_amplitude():
    """The flow of a spring is affine in the amplitude of what pushes it, the discrete one too."""

    def end(amplitude):
        return lt.flow(pushed_spring(amplitude), jnp.array([1.0, 0.0]), (0.7, 2.7), 0.1, lt.MetriplecticMidpoint())

    both = jax.jit(lambda amplitude: jax.jvp(end, (amplitude,), (1.0,)))
    (first, slope), (last, _) = both(0.0), both(1.0)
    assert np.abs(slope - (last - first)).max() < 1e-13
    assert np.abs(slope).max() > 0.1


@pytest.mark.slow
def test_what_the_user_sees():
    x, t = np.array([1.0, 0.2]), 0.9
    push = 0.4 * np.sin(RATE * t)
    expected_values = [x[1] - push * x[0], push * x[1] - np.sin(x[0]) - 0.4 * x[0] ** 3]
    assert np.allclose(SHAKEN.vector_field(x, t), expected_values, rtol=1e-14)
    assert np.allclose(SHAKEN.at_time(t).vector_field(x), expected_values, rtol=1e-14)
    times = np.array([0.0, t])
    assert np.allclose(SHAKEN.vector_field(np.stack([x, x]), times)[1], expected_values, rtol=1e-14)
    assert np.allclose(SHAKEN.energy(x, times), [still(x), shaken(x, t)], rtol=1e-15)
    assert SHAKEN.is_driven
    assert not SHAKEN.at_time(t).is_driven
    assert STILL.at_time(t) is STILL
    assert np.array_equal(STILL.vector_field(x, t), STILL.vector_field(x))
    assert SPIN.entropy_production(SPIN_START, t) > 0.0
    K = SPIN.friction_matrix(SPIN_START, t)
    assert np.abs(K @ SPIN.at_time(t).energy.gradient(jnp.asarray(SPIN_START))).max() < 1e-15
    for call in (SPIN.vector_field, SPIN.entropy_production):
        with pytest.raises(lt.InputError, match="Give the time"):
            call(SPIN_START)


class _FrictionOfAnEnergyAtRest(lt.Dissipation):
    """Its kernel is the gradient of |x|^2 / 2, whatever it is handed."""

    def force(self, system, x, dH, dS, dL):
        return (x @ x) * dS - (x @ dS) * x


def test_the_axioms_are_tested_at_random_times():
    def energy(x, t):
        return 0.5 * x @ x + t * x[0]

    with pytest.raises(lt.AxiomError, match="K grad H = 0"):
        lt.MetriplecticSystem(None, energy, lambda x: x[1], _FrictionOfAnEnergyAtRest(), dim=3)
    system = lt.MetriplecticSystem(None, energy, lambda x: x[1], _FrictionOfAnEnergyAtRest(), dim=3, validate=False)
    assert system.check(times=0.0).passed
    assert not system.check(times=[0.5] * 16).passed
    assert SPIN.check().passed


def test_a_driven_system_is_the_same_when_taken_apart():
    driven = DrivenSystem(SPIN)
    leaves, structure = jax.tree_util.tree_flatten(driven)
    again = jax.tree_util.tree_unflatten(structure, leaves)
    y = driven.initial_state(SPIN_START, 0.9)
    assert np.array_equal(driven.vector_field(y), again.vector_field(y))
    assert np.array_equal(driven.vector_field(y)[:3], SPIN.vector_field(SPIN_START, 0.9))


def moving_wall(y, t):
    return 0.5 * (y[0] - 0.3 * jnp.sin(2.0 * t)) ** 2 + 0.1 * jnp.exp(y[1])


@pytest.mark.slow
def test_an_evolution_system_with_a_moving_wall():
    """The potential is a term of its own, along its own coordinates, so the entropy is monotone at coarse steps too."""
    wall = lt.TimeDependent(moving_wall).on([0, 2])
    system = lt.EvolutionSystem(lt.Kinetic([1.0]) + wall, dim=3)
    run = lt.integrate(system, [1.0, 0.0, 0.0], (0.3, 40.3), 0.4, engine="compiled")
    assert run.laws.entropy == "nondecreasing"
    assert run.audit().passed, run.audit()
    assert run.casimirs["work"][-1] > 0.1
    assert system.temperature(run.x[-1], 1.0) > 0.1
    plain = lt.EvolutionSystem(lambda x, t: 0.5 * x[1] ** 2 + moving_wall(x[jnp.array([0, 2])], t), dim=3)
    assert plain.entropy_law is None


@pytest.mark.slow
def test_contact_and_composed_systems():
    contact = lt.ContactSystem(lambda x, t: 0.5 * x[1] ** 2 + 0.5 * (x[0] - jnp.sin(t)) ** 2 + 0.1 * x[2], dim=3)
    run = lt.integrate(contact, [1.0, 0.0, 0.0], (0.3, 4.3), 0.05)
    assert run.laws.energy is None
    assert run.audit().passed
    pair = lt.ComposedSystem(
        {
            "stone": lt.Subsystem(lambda x: jnp.exp(x[0]), 1),
            "slider": lt.Subsystem(lambda x: 0.5 * x[1] ** 2 + jnp.exp(x[2]), 3, friction=0.3),
        },
        coupling=lambda q, S, t: 0.5 * jnp.sum((q - 0.3 * jnp.sin(2.0 * t)) ** 2),
        conductance=0.5,
    )
    run = lt.integrate(pair, [0.2, 1.0, 0.0, 0.1], (0.3, 20.3), 0.1)
    assert run.audit().passed, run.audit()
    assert run.casimirs["work"][-1] > 0.1
    assert np.ptp(np.asarray(pair.temperatures(run.x[-1], 20.3))) < 0.1


@pytest.mark.slow
def test_an_euler_poincare_system_with_changing_inertia():
    """The field equals that of the Hamiltonian written by hand."""

    def growing_inertia(t):
        return INERTIA * (1.0 + 0.2 * jnp.sin(t))

    by_velocity = lt.EulerPoincareSystem(
        mf.so(3), lambda xi, t: 0.5 * jnp.sum(growing_inertia(t) * xi**2), validate=False
    )
    by_momentum = lt.LiePoissonSystem(mf.so(3), lambda mu, t: 0.5 * jnp.sum(mu**2 / growing_inertia(t)), validate=False)
    mu, t = jnp.asarray(SPIN_START), 0.9
    assert np.allclose(by_velocity.velocity(mu, t), mu / growing_inertia(t), rtol=1e-14)
    assert np.allclose(by_velocity.momentum(mu / growing_inertia(t), t), mu, rtol=1e-14)
    fields = [DrivenSystem(s, unit=1.0) for s in (by_velocity, by_momentum)]
    found_values = [s.vector_field(s.initial_state(mu, t)) for s in fields]
    assert np.allclose(*found_values, rtol=1e-12, atol=1e-14)
    assert not by_velocity.hints.can_unroll


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), GAUSS[2]], ids=str)
def test_a_spin_on_its_sphere(method):
    def energy(x, t):
        return 0.4 * x[2] ** 2 - x[0] * jnp.cos(RATE * t) - x[1] * jnp.sin(RATE * t) - 0.5 * x[2]

    def hat(x):
        return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])

    system = lt.MetriplecticSystem(hat, energy, space=mf.Sphere(2))
    x0, span = np.array([0.6, 0.0, 0.8]), (0.5, 2.5)

    def rate(t, x):
        return np.cross(x, [-np.cos(RATE * t), -np.sin(RATE * t), 0.8 * x[2] - 0.5])

    end = solve_ivp(rate, span, x0, method="DOP853", rtol=3e-14, atol=1e-14).y[:, -1]
    errors = []
    for n in (20, 40):
        run = lt.integrate(system, x0, span, 2.0 / n, method, save_every=n, dense=n == 40)
        assert run.audit().passed, run.audit()
        assert abs(np.linalg.norm(run.x[-1]) - 1.0) < 1e-15
        errors.append(np.abs(run.x[-1] - end).max())
    assert abs(np.log2(errors[0] / errors[1]) - method.order) < 0.2
    assert np.abs(run(2.5) - run.x[-1]).max() < 1e-12
    assert np.abs(run.casimirs["work"][-1] - (energy(end, 2.5) - energy(x0, 0.5))) < 2 * errors[-1] + 1e-13


@pytest.mark.slow
def test_functions_held_by_the_method_and_stiff_steps():
    free = lt.LiePoissonSystem(mf.so(3), energy_in_rotating_field)
    held = lt.MetriplecticGauss(2, preserve=(lambda mu: (mu @ mu) ** 2,))
    run = lt.integrate(free, SPIN_START, SPAN, 0.1, held, engine="compiled")
    assert run.audit().passed
    assert np.abs(np.sum(run.x**2, axis=1) - SPIN_START @ SPIN_START).max() < 1e-14

    stiff = lt.MetriplecticSystem(mf.Canonical(1), lambda x, t: 5e4 * (x[0] - jnp.sin(t)) ** 2 + 0.5 * x[1] ** 2)
    for engine in ("array", "compiled"):
        run = lt.integrate(stiff, [0.01, 1.0], (0.0, 5.0), 0.1, GAUSS[2], engine=engine)
        assert run.stats.newton_iterations > 0
        assert run.audit(energy=1e-12).passed, run.audit()


test_what_is_refused = refusal_test(
    (
        lambda: lt.MetriplecticSystem(None, still, lambda x, t: t * x[0], dim=2),
        "the entropy must be a function of the state alone",
    ),
    (
        lambda: lt.MetriplecticSystem(None, still, momentum_maps={"J": shaken}, dim=2),
        "momentum map 'J' must be a function of the state alone",
    ),
    (lambda: lt.MetriplecticSystem(None, lambda x, t: t * x, dim=2), r"shape \(2,\)"),
    (lambda: lt.MetriplecticSystem(None, lt.TimeDependent(lambda x, t: x[7] * t).on([7]), dim=2), "component 7"),
    (
        lambda: lt.ThermodynamicHerglotz(lambda x, t: x[1] ** 2 - x[0] * t, dim=3),
        "the Lagrangian must be a function of the state alone",
    ),
    (lambda: lt.SimpleClosedSystem(lambda q, v, S, t: v @ v - S * t, dim=3), "external"),
    (lambda: lt.Subsystem(shaken, 3), "the energy of a subsystem must be a function of the state alone"),
    (lambda: SHAKEN.energy(np.ones(2)), r"energy\(x, t\)"),
    (lambda: lt.integrate(SHAKEN, [1.0, 0.0], SPAN, 0.1, lt.VariationalGauss(2)), "Metriplectic.* depends on time"),
    (lambda: lt.integrate(SHAKEN, [1.0, 0.0, 0.5], SPAN, 0.1), r"shape \(2,\)"),
    error=(lt.InputError, lt.FunctionError),
)
