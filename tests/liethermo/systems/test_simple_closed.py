"""Simple closed systems, and those of Chetaev's principle: equations, both balances, the ledger, and bad input."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.tracing.interpret import evaluate_at_points
from tests.cases import tolerance
from tests.liethermo.closed_systems import ISOLATED_SYSTEMS, MECHANICAL, OPEN, X0, friction, swirl

KINDS = {"isolated": ISOLATED_SYSTEMS, "open": OPEN}

each_system = pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in ("isolated", "open") for name in KINDS[kind]]
)


def residuals(system, x):
    """Return residuals (q' = v, both equations (2.4), energy, ledger), E', and the production -F_fr . v / T."""
    n, rate = system.degrees_of_freedom, system.vector_field(x)
    q, v, S, t = system.split_state(x)
    by_q, by_v, by_S = jax.grad(system.lagrangian_value, argnums=(0, 1, 2))(q, v, S)
    change = jax.jvp(system.momentum, (q, v, S), (rate[:n], rate[n : 2 * n], rate[2 * n]))[1]
    F, push, heat = (f(q, v, S, t) for f in (system.friction_force, system.external_force, system.heating))
    energy_rate = jax.jvp(system.mechanical_energy, (x,), (rate,))[1]
    found = {
        "q' = v": rate[:n] - v,
        "momentum": change - by_q - F - push,
        "heat": -by_S * rate[2 * n] - heat + F @ v,
        "energy balance": energy_rate - push @ v - heat,
        "E": system.mechanical_energy(x) - (v @ by_v - system.lagrangian_value(q, v, S)),
        "energy law": jnp.dot(system.energy.gradient(x), rate),
    }
    if system.has_ledger:
        found["ledger"] = rate[2 * n + 1 :] - jnp.stack([push @ v, heat, 1.0])
    return found, energy_rate, -F @ v / -by_S


@pytest.mark.sampled(1)
@each_system
def test_the_equations_and_both_balances(kind, name):
    system = KINDS[kind][name]
    points = np.random.default_rng(0).standard_normal((8, system.dim))
    found, energy_rate, production = evaluate_at_points(residuals, system, points)
    for name, residual in found.items():
        assert np.abs(residual).max() < 2e-12, name
    assert production.min() > 1e-4
    assert (np.abs(energy_rate).max() > 0.1) == system.has_ledger  # so the balance is one of something
    assert system.check(points).passed


@functools.cache
def small_system():
    return lt.SimpleClosedSystem(
        lt.Quadratic([-1.0, 2.0, 0.0]) - lt.Function(lambda y: jnp.exp(y[0])).on([2]),
        3,
        0.3,
        lambda q, v, S, t: jnp.cos(t) - q,
        0.1,
    )


@pytest.mark.slow
def test_the_metriplectic_schemes_run_a_small_one_and_keep_its_laws():
    _run_and_judge(small_system(), [0.4, 0.5, 0.2])


@pytest.mark.slow
@each_system
def test_the_metriplectic_schemes_run_each_and_keep_its_laws(kind, name):
    _run_and_judge(KINDS[kind][name], X0)


def _run_and_judge(system, x0):
    """The energy with the ledger is that of an isolated system."""
    solution = lt.integrate(system, x0, (0.0, 2.0), 0.05, engine="array")
    assert solution.audit().energy_drift <= tolerance("energy")
    if not system.has_ledger:
        assert solution.stats.least_entropy_increment > 0.0
        assert solution.audit().passed


def test_the_ledger_in_the_audit():
    system = small_system()
    solution = lt.integrate(system, [0.4, 0.5, 0.2], (0.0, 2.0), 0.05)
    work, heat = solution.casimirs["work received"], solution.casimirs["heat received"]
    assert min(abs(work[-1]), abs(heat[-1])) > 0.01
    gained = np.asarray(system.mechanical_energy(solution.x)) - work - heat
    assert np.ptp(gained) < 1e-13
    printed = {row.law: row.value for row in solution.audit().rows}
    assert printed["work received"] == work[-1]
    assert printed["heat received"] == heat[-1]
    assert "from outside" in str(solution.audit())
    assert solution.t[-1] == pytest.approx(solution.x[-1, -1], abs=1e-12)  # the ledger's clock


def test_a_ledger_is_written_and_read(tmp_path):
    solution = lt.integrate(small_system(), [0.4, 0.5, 0.2], (0.0, 2.0), 0.05)
    again = lt.load(solution.save(tmp_path / "run.nc"))
    assert str(again.audit()) == str(solution.audit())


def _rate(system, x):
    return system.vector_field(x)


@pytest.mark.slow
def test_the_same_lagrangian_in_its_different_forms():
    """Three arguments, one array, and a sum of energies; a coefficient of friction and the force that it means."""
    R = np.array([[0.5, 0.3], [-0.2, 0.3]])  # its symmetric part brakes, the rest turns [GBY §2]

    def L(q, v, S):
        return 0.5 * v @ v - 0.5 * q @ q - jnp.exp(S)

    forms = [
        lt.SimpleClosedSystem(L, 5, friction=R),
        lt.SimpleClosedSystem(lambda x: L(x[:2], x[2:4], x[4]), 5, friction=lambda q, v, S: -R @ v),
        lt.SimpleClosedSystem(
            lt.Kinetic(np.ones(2)) - lt.Potential(lambda q, S: 0.5 * q @ q + jnp.exp(S)), 5, friction=R
        ),
    ]
    fields = [evaluate_at_points(_rate, system, np.array([X0])) for system in forms]
    for field in fields[1:]:
        assert np.abs(field - fields[0]).max() < 1e-14


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_friction_that_injects_energy():
    def pushing(q, v, S):
        return jnp.array([0.1 * v[0], -v[1]])

    with pytest.raises(lt.AxiomError, match=r"entropy law|F_fr"):
        lt.SimpleClosedSystem(MECHANICAL, 5, friction=pushing)
    report = lt.SimpleClosedSystem(MECHANICAL, 5, friction=pushing, validate=False).check()
    assert not report.passed
    assert [row.axiom for row in report.rows if row.passed is False] == ["entropy law", "F_fr . v <= 0"]
    heated = lt.SimpleClosedSystem(MECHANICAL, 5, friction=pushing, heat_power=1.0, validate=False).check()
    assert [row.axiom for row in heated.rows if row.passed is False] == ["F_fr . v <= 0"]


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"lagrangian": lambda q, v, S: 0.5 * v[0] ** 2 - S}, lt.InputError, "singular"),
        ({"lagrangian": lambda q, v, S: v @ q - S}, lt.InputError, "singular"),
        ({"dim": 4}, lt.InputError, r"2n \+ 1"),
        ({"dim": None}, lt.InputError, "dim"),
        ({"friction": -1.0}, lt.InputError, "inject"),
        ({"friction": np.diag([1.0, -0.1])}, lt.IndefiniteError, "negative"),
        ({"friction": np.array([[0.1, 1.0], [0.5, 0.1]])}, lt.IndefiniteError, "negative"),
        ({"friction": np.ones(3)}, lt.InputError, "shape"),
        ({"friction": lambda q, v, S: -v[:1]}, lt.FunctionError, r"shape \(2,\), got \(1,\)"),
        ({"external": lambda q, v, S: q[5] * jnp.ones(3)}, lt.FunctionError, "external force"),
        ({"external": lambda q: q}, lt.FunctionError, "external force could not be evaluated"),
        ({"heat_power": lambda q, v, S: v}, lt.FunctionError, "heat power"),
    ],
)
def test_unusable_arguments(arguments, error, words):
    given = {"lagrangian": MECHANICAL, "dim": 5, "friction": friction} | arguments
    with pytest.raises(error, match=words):
        lt.SimpleClosedSystem(**given)


def test_a_run_starts_at_a_positive_temperature():
    system = lt.SimpleClosedSystem(lambda q, v, S: 0.5 * v @ v - S + 0.5 * S**2, 3, friction=0.1, validate=False)
    with pytest.raises(lt.InputError, match=r"temperature -dL/dS must be positive, got -1"):
        lt.integrate(system, [0.0, 1.0, 2.0], (0.0, 1.0), 0.1)


def test_initial_states_may_leave_out_the_ledger():
    system = lt.SimpleClosedSystem(MECHANICAL, 5, external=swirl)
    assert np.array_equal(system.state(X0), [*X0, 0.0, 0.0, 0.0])
    with pytest.raises(lt.InputError, match="shape"):
        system.state([*X0, 0.0])


def test_forces_at_one_point():
    """The time may be left out of the arguments of a force, and nothing else."""
    ones, q, kinetic = jnp.ones(3), jnp.ones(2), lambda xi, S: 0.5 * xi @ xi - S
    algebra = lt.EulerPoincareClosedSystem(mf.so(3), kinetic, friction=0.2, validate=False)
    plane = lt.SimpleClosedSystem(MECHANICAL, 5, 0.2, heat_power=lambda q, v, S, t: 1.0 + t, validate=False)
    np.testing.assert_array_equal(algebra.friction_force(ones, 0.1), -0.2 * ones)
    np.testing.assert_array_equal(plane.friction_force(q, q, 0.1), -0.2 * q)
    assert (float(plane.heating(q, q, 0.1)), float(plane.heating(q, q, 0.1, 2.0))) == (1.0, 3.0)
    with pytest.raises(lt.InputError, match=r"functions of \(xi, S, t\), but 1 arguments"):
        algebra.friction_force(ones)
    with pytest.raises(lt.InputError, match=r"functions of \(q, v, S, t\), but 2 arguments"):
        plane.friction_force(q, q)


CHETAEV_START = np.array([0.3, -0.2, 0.5, 0.4, 0.1])


def L(q, v, S):
    """The mass depends on q and couples the velocities; the temperature is exp(S/2)/2."""
    kinetic = 0.5 * (1.0 + 0.3 * q[0] ** 2) * v[0] ** 2 + 0.5 * v[1] ** 2 + 0.2 * v[0] * v[1]
    return kinetic - 0.5 * q @ q - 0.1 * q[0] ** 4 - jnp.exp(0.5 * S)


def eta(q, v, S):
    """Not linear in v, not symmetric, and with an eta_S of its own."""
    turned = jnp.array([-0.5 * v[1], 0.5 * v[0]])
    return jnp.append(turned - jnp.array([1.0 + v @ v, jnp.exp(q[1])]) * v, 2.0 + jnp.sin(S))


@functools.cache
def chetaev_system():
    return lt.ChetaevSystem(L, eta, 5, validate=False)


def field_by_hand(t, y):
    """(14), written out."""
    q, v, S = y[:2], y[2:4], y[4]
    mass, T = np.array([[1.0 + 0.3 * q[0] ** 2, 0.2], [0.2, 1.0]]), 0.5 * np.exp(0.5 * S)
    form = np.array([-v[0] * (1.0 + v @ v) - 0.5 * v[1], 0.5 * v[0] - v[1] * np.exp(q[1])])
    by_q = np.array([0.3 * q[0] * v[0] ** 2 - q[0] - 0.4 * q[0] ** 3, -q[1]])
    turned = np.array([0.6 * q[0] * v[0] ** 2, 0.0])  # of d/dt L_v
    at_S = 2.0 + np.sin(S)
    return np.concatenate([v, np.linalg.solve(mass, T / at_S * form + by_q - turned), [-(form @ v) / at_S]])


def test_the_equations_and_their_laws():
    points = np.random.default_rng(1).standard_normal((8, 5))
    field = evaluate_at_points(lambda system, x: system.vector_field(x), chetaev_system(), points)
    expected = np.array([field_by_hand(0.0, x) for x in points])
    assert np.abs(field - expected).max() < 1e-12 * np.abs(expected).max()
    assert (chetaev_system().energy_law, chetaev_system().entropy_law) == ("conserved", "nondecreasing")
    assert chetaev_system().check(points).passed


def test_it_is_the_thermodynamic_herglotz_system_for_eta_L():
    """SML Prop. 3.3; and for ``T dS + F dq`` a simple closed system with that friction."""
    points = np.random.default_rng(2).standard_normal((8, 5))
    field = lambda system: evaluate_at_points(lambda system, x: system.vector_field(x), system, points)  # noqa: E731
    by_L = lt.ChetaevSystem(L, lambda q, v, S: jnp.append(-jax.grad(L, argnums=1)(q, v, S), 1.0), 5, validate=False)
    herglotz = lt.ThermodynamicHerglotz(lambda x: L(x[:2], x[2:4], x[4]), 5, validate=False)
    assert np.abs(field(by_L) - field(herglotz)).max() < 1e-12 * np.abs(field(herglotz)).max()
    R = jnp.array([[0.3, 0.2], [-0.1, 0.4]])
    by_force = lt.ChetaevSystem(L, lambda q, v, S: 2.0 / jnp.exp(0.5 * S) * (R @ v), 5, validate=False)
    assert by_force.entropy_law is None, "a form that pushes has no law of the entropy"
    braking = lt.ChetaevSystem(L, lambda q, v, S: -2.0 / jnp.exp(0.5 * S) * (R @ v), 5, validate=False)
    closed = lt.SimpleClosedSystem(L, 5, friction=R, validate=False)
    assert np.abs(field(braking) - field(closed)).max() < 1e-12 * np.abs(field(closed)).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "order"),
    [
        (lt.MetriplecticGauss(2), 4.0),
        (lt.MetriplecticMidpoint(), 2.0),
        (lt.MetriplecticRungeKutta(6), 6.0),
        (lt.VariationalIntegrator.midpoint(), 2.0),
        (lt.VariationalIntegrator.verlet(), 1.0),
        (lt.VariationalGauss(2), 4.0),
    ],
    ids=str,
)
def test_methods_and_their_orders(method, order):
    exact = solve_ivp(field_by_hand, (0.0, 2.0), CHETAEV_START, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    runs = [lt.integrate(chetaev_system(), CHETAEV_START, (0.0, 2.0), h, method) for h in (0.1, 0.05)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2, errors
    assert np.diff(runs[0].entropy).min() > 0.0
    if "energy" in method.preserves:
        assert runs[0].audit().energy_drift < 1e-14


def test_a_form_of_the_entropy_rate():
    """``eta_q . v + eta_S S' = 0``, solved for S'."""

    def form_with_entropy_rate(q, v, S, S_dot):
        return jnp.append(-v * (1.0 + 0.1 * S_dot**2), 1.0 + 0.2 * S_dot)

    system = lt.ChetaevSystem(L, form_with_entropy_rate, 5, validate=False)
    rate = np.asarray(system.vector_field(CHETAEV_START))
    form = np.asarray(form_with_entropy_rate(CHETAEV_START[:2], CHETAEV_START[2:4], CHETAEV_START[4], rate[4]))
    assert rate[4] > 0.3
    assert abs(form[:2] @ CHETAEV_START[2:4] + form[2] * rate[4]) < 1e-15
    assert abs(float(system.energy.gradient(CHETAEV_START) @ rate)) < 1e-15


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (3.0, lt.InputError, "a function"),
        (lambda q, v, S: jnp.ones(5), lt.FunctionError, r"shape \(3,\) or \(2,\), got \(5,\)"),
        (lambda q: q, lt.FunctionError, "could not be evaluated"),
    ],
)
def test_bad_input(given, error, words):
    with pytest.raises(error, match=words):
        lt.ChetaevSystem(L, given, 5)
