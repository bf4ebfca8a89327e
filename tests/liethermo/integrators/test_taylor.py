"""Taylor steps: orders on R^n and on manifolds, tolerances, states between the steps, events, rejected input."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.integrators.tableaus import lobatto_nodes_and_weights
from tests.liethermo.integrators.test_on_manifolds import CASES, starts
from tests.liethermo.integrators.test_orders import NONLINEAR

Taylor = lt.MetriplecticTaylor
BODY = lt.models.rigid_body((5.0, 4.0, 2.0), rate=0.5)
X0 = np.array([0.2, 1.0, 0.3])
MULTIPLES = np.array([4, 5, 6, 7, 8])
"""Numbers of eighths of the length over which errors are measured."""


def reference(system, x, time, pieces=1):
    return lt.integrate(system, x, (0.0, time), time / pieces, lt.Reference(rtol=3e-14)).x


POWERS = {
    # name: (power of the first component, as the library has it; its derivative in NumPy)
    "3.0": (lambda m: m[0] ** 3.0, lambda x: 3.0 * x**2),
    "2.0": (lambda m: m[0] ** 2.0, lambda x: 2.0 * x),
    "of NumPy": (lambda m: m[0] ** np.float64(4.0), lambda x: 4.0 * x**3),
    "of JAX": (lambda m: jnp.power(m[0], jnp.array(3.0)), lambda x: 3.0 * x**2),
    "of each entry": (lambda m: jnp.sum(m[:1] ** np.array([2.0, 3.0])), lambda x: 2.0 * x + 3.0 * x**2),
}


class Power(eqx.Module):
    """A power whose exponent is a parameter of the system."""

    exponent: float

    def __call__(self, m):
        return m[0] ** self.exponent


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", [*POWERS, "a parameter"])
def test_whole_powers_as_floats_near_zero(name):
    """Runs agree with DOP853 on Euler's equations in NumPy."""
    power, derivative = POWERS.get(name) or (Power(3.0), lambda x: 3.0 * x**2)
    system = lt.LiePoissonSystem(mf.so(3), lambda m: power(m) + m[1] ** 2 + 0.5 * m[2] ** 2 + 0.1 * m[0] ** 2)

    def field(t, m):
        return np.cross(m, [derivative(m[0]) + 0.2 * m[0], 2.0 * m[1], m[2]])

    for start in (0.0, 1e-6, -1e-3):
        x0 = np.array([start, 0.5, -0.3])
        run = lt.integrate(system, x0, (0.0, 1.0), 0.05, Taylor(8))
        reference_end = solve_ivp(field, (0.0, 1.0), x0, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
        assert np.abs(run.x[-1] - reference_end).max() <= 1e-10
        assert run.audit().passed


@pytest.mark.parametrize("nodes", range(2, 14))
def test_quadrature(nodes):
    c, b = lobatto_nodes_and_weights(nodes)
    assert (b > 0.0).all()
    assert np.array_equal(c, np.sort(c))
    assert (c[0], c[-1]) == (0.0, 1.0)
    for n in range(2 * nodes - 2):
        assert b @ c**n == pytest.approx(1.0 / (n + 1), rel=3e-15)
    assert abs(b @ c ** (2 * nodes - 2) - 1.0 / (2 * nodes - 1)) > 1e-16 * 10.0 ** (14 - nodes)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("order", "length"), [(2, 0.1), (5, 0.2), (6, 0.2), (12, 0.3), (20, 0.6)])
@pytest.mark.parametrize("name", NONLINEAR)
def test_observed_order(name, order, length):
    """The error of a step has the slope order + 1: the mean over eight states, for five lengths."""
    system, x0 = NONLINEAR[name]
    x0s = 1.5 * x0 * (1.0 + 0.3 * np.random.default_rng(1).standard_normal((8, len(x0))))
    length = length if len(x0) == 3 else min(length, 0.4)
    exact = np.array([reference(system, x, length, 8) for x in x0s])
    errors = []
    for m in MULTIPLES:
        h = m * length / 8
        ensemble = lt.ensemble(system, x0s, (0.0, h), h, Taylor(order))
        errors.append(np.sqrt(np.mean((ensemble.x - exact[:, m]) ** 2)))
        assert ensemble.energy_drift.max() <= 2e-15
        assert ensemble.least_entropy_increment.min() >= -1e-15
    assert_slope(errors, order)


def assert_slope(errors, order):
    is_resolved = np.array(errors) > 3e-13
    assert is_resolved.sum() >= 3, errors
    slope = np.polyfit(np.log(MULTIPLES[is_resolved]), np.log(np.array(errors)[is_resolved]), 1)[0]
    assert abs(slope - (order + 1)) < 0.1 * order, (errors, slope)


@pytest.mark.slow
@pytest.mark.parametrize(("order", "length"), [(6, 0.6), (12, 1.0), (20, 1.4)])
@pytest.mark.parametrize("name", ["spin", "bath", "frame"])
def test_observed_order_on_manifolds(name, order, length):
    system, x0 = CASES[name](), starts(name)
    if name == "frame":  # of a smaller radius of convergence
        length *= 0.3 if order == 20 else 0.6
    exact, errors = reference(system, x0, length, 8), []
    for m in MULTIPLES:
        h = m * length / 8
        run = lt.integrate(system, x0, (0.0, h), h, Taylor(order), engine="array")
        errors.append(np.abs(run.x[-1] - exact[m]).max())
        assert run.audit(energy=4e-15).passed
    assert_slope(errors, order)


@pytest.mark.slow
@pytest.mark.parametrize(("rtol", "order"), [(1e-6, 8), pytest.param(1e-12, 15, marks=pytest.mark.slow)])
def test_orders_from_tolerances_and_states_between(rtol, order):
    """The default order follows from the tolerance; the error is within it, also between the steps."""
    run = lt.integrate(BODY, X0, (0.0, 10.0), lt.Adaptive(rtol), Taylor(), dense=True)
    assert run.provenance["method"] == f"MetriplecticTaylor(order={order})"
    assert run.stats.steps < 20
    assert run.audit().passed
    assert np.abs(run(run.t) - run.x).max() < 1e-15
    exact, times = reference(BODY, X0, 10.0, 20), 10.0 * np.arange(21) / 20
    assert np.abs(run.x[-1] - exact[-1]).max() < 3.0 * rtol
    assert np.abs(run(times) - exact).max() < 10.0 * rtol


@pytest.mark.parametrize("rtol", [1e-6, pytest.param(1e-12, marks=pytest.mark.slow)])
def test_events(rtol):
    """An event is located to rounding by a step that ends there, in long steps too."""
    run = lt.integrate(BODY, X0, (0.0, 10.0), lt.Adaptive(rtol), Taylor(), until=lambda m: m[1] - 0.5)
    assert run.status.code == "event"
    assert run.x[-1][1] == pytest.approx(0.5, abs=1e-14)
    assert np.abs(run.x[-1] - reference(BODY, X0, run.event_time)[-1]).max() < 10.0 * rtol


@pytest.mark.slow
def test_a_kink_is_seen_by_the_estimate():
    """A condition is evaluated at the start of a step: adaptive steps end where its value changes."""

    def energy(m):
        return 0.5 * jnp.sum(m**2 / jnp.array([5.0, 4.0, 2.0])) + jnp.where(m[0] > 0.0, 0.3 * m[0] ** 4, 0.0)

    system = lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.05))
    run = lt.integrate(system, [0.3, 1.0, 0.6], (0.0, 12.0), lt.Adaptive(1e-8), Taylor(12))
    assert np.ptp(np.sign(run.x[:, 0])) == 2.0
    assert np.abs(run.x[-1] - reference(system, [0.3, 1.0, 0.6], 12.0)[-1]).max() < 1e-6
    assert run.audit().passed


@pytest.mark.slow
def test_double_bracket_dissipation():
    """The energy falls, by a quadrature that is exact to the order, and the Casimir is constant."""
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / np.array([5.0, 4.0, 2.0])), lt.Quadratic(np.ones(3)), lt.DoubleBracket(0.3)
    )
    run = lt.integrate(system, X0, (0.0, 10.0), 0.5, Taylor(16))
    assert run.stats.largest_energy_increment < 0.0
    assert np.ptp(run.entropy) < 1e-15
    assert np.abs(run.x[-1] - reference(system, X0, 10.0)[-1]).max() < 1e-12


@pytest.mark.parametrize("order", [1, 25, 2.5, True, "6"])
def test_invalid_orders(order):
    with pytest.raises(lt.errors.InputError, match="order must be an integer from 2 to 24 or None"):
        Taylor(order)


class LawlessFriction(lt.FrictionOperator):
    """A dissipation without laws."""

    energy_law = entropy_law = None


def test_bad_input():
    def attempt(energy, order=8):
        system = lt.LiePoissonSystem(mf.so(3), energy, lt.Quadratic(np.ones(3)), lt.KillingDissipation(0.1))
        return lt.integrate(system, X0, (0.0, 1.0), 0.1, Taylor(order))

    for energy, name in ((lambda m: jnp.sum(jnp.abs(m)), "abs"), (lambda m: jnp.sum(jnp.maximum(m, 0.0)), "max")):
        with pytest.raises(lt.errors.InputError, match=f"of the energy the JAX primitive '{name}' is not smooth") as e:
            attempt(energy)
        assert "MetriplecticRungeKutta" in str(e.value)
    with pytest.raises(lt.errors.InputError, match="does not conserve"):
        lt.integrate(BODY, X0, (0.0, 1.0), 0.1, Taylor(8, preserve=lambda m: m[0]))
    friction = LawlessFriction(lambda x: jnp.eye(2))
    lawless = lt.MetriplecticSystem(None, lambda x: x[0], lambda x: x[1], friction, dim=2, validate=False)
    with pytest.raises(lt.errors.InputError, match="this one has none"):
        lt.integrate(lawless, [1.0, 2.0], (0.0, 1.0), 0.1, Taylor(8))


@pytest.mark.slow
def test_without_a_tolerance_the_order_is_that_of_1e_10():
    """Every way to run uses this order."""
    assert Taylor().order == Taylor().on(BODY).order == Taylor().on(BODY, 1e-10).order == 13
    ours = lt.integrate(BODY, X0, (0.0, 0.4), 0.2, Taylor(13))
    states = [
        lt.integrate(BODY, X0, (0.0, 0.4), 0.2, Taylor()).x[-1],
        lt.ensemble(BODY, X0[None], (0.0, 0.4), 0.2, Taylor()).x[0],
        lt.flow(BODY, X0, (0.0, 0.4), 0.2, Taylor()),
    ]
    for x in states:
        assert np.abs(x - ours.x[-1]).max() < 1e-14
    assert lt.diffrax.Solver(Taylor()).order(None) == 13


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2])
def test_spins_that_heat_baths(number):
    """The run agrees with the Runge-Kutta method of order 8 and obeys both laws."""
    rate = np.array([0.1, 0.5, 0.2])
    system = lt.models.spin_lattice(
        3,
        rate=rate,
        exchange_constant=0.8,
        field=(0.2, 0.0, 0.5),
        baths=lt.HeatBaths(capacity=2.0, temperature=1.5, number=number),
        bath=None if number == 1 else np.array([1, 0, 1]),
    )
    spins = np.random.default_rng(0).standard_normal((3, 3))
    x0 = system.state(spins / np.linalg.norm(spins, axis=1)[:, None])
    run = lt.integrate(system, x0, (0.0, 1.0), 0.1, Taylor(12))
    reference_run = lt.integrate(system, x0, (0.0, 1.0), 0.02, lt.MetriplecticRungeKutta(8))
    assert np.abs(run.x[-1] - reference_run.x[-1]).max() < 1e-12
    assert run.audit().passed, str(run.audit())
    assert np.ptp(run.entropy) > 0.1
