"""Systems whose positions are points of a manifold, against the same motion in coordinates or by its own equations."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.tracing.interpret import evaluate_at_points

GRAVITY = 9.81
MASS = 1.3
RATE = 0.4
CAPACITY = 5.0
V = lt.VariationalIntegrator


def heat(S):
    """Internal energy of temperature 300 at S = 0."""
    return 300.0 * CAPACITY * jnp.exp(S / CAPACITY)


def temperature(S):
    return 300.0 * np.exp(S / CAPACITY)


class Case(NamedTuple):
    """A system, a state, and the state after a time by an independent calculation."""

    system: lt.SimpleClosedSystem
    x0: np.ndarray
    end: np.ndarray
    duration: float


def solve_by_scipy(field: Callable, y0, duration: float) -> np.ndarray:
    """SciPy, to its rounding."""
    return solve_ivp(field, (0.0, duration), y0, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


# -- a spherical pendulum whose friction depends on where it is -------------------------------------------------------


def sphere_state(y) -> np.ndarray:
    theta, phi, w, u, S = y
    q = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    down = np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])
    round_ = np.array([-np.sin(phi), np.cos(phi), 0.0])
    return np.concatenate([q, w * down + np.sin(theta) * u * round_, [S]])


def pendulum_field(t, y):
    """``L = m (theta'^2 + sin^2 phi'^2) / 2 - m g cos theta``, and the heat."""
    theta, phi, w, u, S = y
    sin, cos = np.sin(theta), np.cos(theta)
    rate = RATE * (1.0 + 0.3 * (sin * np.cos(phi)) ** 2)
    w_dot = sin * cos * u * u + GRAVITY * sin - rate / MASS * w
    u_dot = -2.0 * cos / sin * w * u - rate / MASS * u
    return [w, u, w_dot, u_dot, rate * (w * w + sin * sin * u * u) / temperature(S)]


def pendulum_friction(q, v, S):
    return -RATE * (1.0 + 0.3 * q[0] ** 2) * v + 7.0 * q  # what is across the sphere counts for nothing


@functools.cache
def pendulum() -> Case:
    L = lambda q, v, S: 0.5 * MASS * v @ v - MASS * GRAVITY * q[2] - heat(S)  # noqa: E731
    system = lt.SimpleClosedSystem(L, friction=pendulum_friction, space=mf.Sphere(2))
    y0 = [2.0, 0.3, 0.2, 1.5, 0.1]
    return Case(system, sphere_state(y0), sphere_state(solve_by_scipy(pendulum_field, y0, 2.0)), 2.0)


# -- a motion of covariance matrices, geodesic but for a potential and friction ---------------------------------------


def covariance_field(t, y):
    """``q'' = v q^-1 v - q^2 - rate v``: geodesics of tr(q^-1 v q^-1 v), the potential tr q, friction."""
    q, v, S = y[:4].reshape(2, 2), y[4:8].reshape(2, 2), y[8]
    inverse = np.linalg.inv(q)
    w = inverse @ v
    return np.concatenate([y[4:8], (v @ w - q @ q - RATE * v).ravel(), [RATE * np.trace(w @ w) / temperature(S)]])


@functools.cache
def covariances() -> Case:
    def L(q, v, S):
        w = jnp.linalg.solve(q, v)
        return 0.5 * jnp.trace(w @ w) - jnp.trace(q) - heat(S)

    def friction(q, v, S):
        inverse = jnp.linalg.inv(q)
        return -RATE * inverse @ v @ inverse

    system = lt.SimpleClosedSystem(L, friction=friction, space=mf.SPD(2))
    x0 = np.array([1.0, 0.2, 0.2, 0.7, 0.3, 0.4, 0.4, -0.2, 0.1])
    return Case(system, x0, solve_by_scipy(covariance_field, x0, 1.0), 1.0)


# -- a heavy top with friction and a torque from outside, on SO(3) ----------------------------------------------------

INERTIA = np.array([1.0, 1.6, 2.1])
LEVER = np.array([0.3, -0.2, 0.5])


def top_field(t, y):
    """Euler's equations, the attitude and the ledger."""
    R, omega, S = y[:9].reshape(3, 3), y[9:12], y[12]
    down = R.T @ np.array([0.0, 0.0, -1.0])
    push = np.array([0.1, 0.0, 0.2])
    torque = np.cross(LEVER, down) - RATE * omega + push
    hat = np.cross(np.eye(3), omega)
    rate = np.linalg.solve(np.diag(INERTIA), np.cross(INERTIA * omega, omega) + torque)
    heating = (0.05 + RATE * omega @ omega) / temperature(S)
    return np.concatenate([(R @ hat).ravel(), rate, [heating, push @ omega, 0.05, 1.0]])


@functools.cache
def top() -> Case:
    spread = np.diag(0.5 * INERTIA.sum() - INERTIA)  # of the mass along the axes of the body
    push = np.cross(np.eye(3), np.array([0.1, 0.0, 0.2]))

    def L(q, v, S):
        return 0.5 * jnp.trace(v @ spread @ v.T) - (q @ LEVER)[2] - heat(S)

    system = lt.SimpleClosedSystem(
        L,
        friction=lambda q, v, S: -0.5 * RATE * v,
        external=lambda q, v, S, t: 0.5 * q @ push,
        heat_power=0.05,
        space=mf.SpecialOrthogonal(3),
    )
    omega = np.array([0.4, 1.1, -0.3])
    y0 = np.concatenate([np.eye(3).ravel(), omega, np.zeros(4)])

    def state(y):
        R = y[:9].reshape(3, 3)
        return np.concatenate([y[:9], (R @ np.cross(np.eye(3), y[9:12])).ravel(), y[12:]])

    return Case(system, state(y0), state(solve_by_scipy(top_field, y0, 1.0)), 1.0)


# -- two bodies, one on the hyperbolic plane and one on a line, with a spring between them ----------------------------


def hyperbolic_state(y) -> np.ndarray:
    r, phi, z, w, u, p, S = y
    q = [np.cosh(r), np.sinh(r) * np.cos(phi), np.sinh(r) * np.sin(phi), z]
    out = np.array([np.sinh(r), np.cosh(r) * np.cos(phi), np.cosh(r) * np.sin(phi)])
    round_ = np.array([0.0, -np.sin(phi), np.cos(phi)])
    return np.concatenate([q, w * out + np.sinh(r) * u * round_, [p, S]])


def hyperbolic_field(t, y):
    """``L = (r'^2 + sinh^2 phi'^2 + z'^2) / 2 - (cosh r - z)^2 / 2``."""
    r, _, z, w, u, p, S = y
    pull = np.cosh(r) - z
    w_dot = np.sinh(r) * np.cosh(r) * u * u - pull * np.sinh(r) - RATE * w
    u_dot = -2.0 / np.tanh(r) * w * u - RATE * u
    gain = RATE * (w * w + np.sinh(r) ** 2 * u * u) / temperature(S)
    return [w, u, p, w_dot, u_dot, pull, gain]


@functools.cache
def coupled_points() -> Case:
    def length(v):
        return -(v[0] ** 2) + v[1] ** 2 + v[2] ** 2

    def L(q, v, S):
        return 0.5 * (length(v) + v[3] ** 2) - 0.5 * (q[0] - q[3]) ** 2 - heat(S)

    friction = lambda q, v, S: -RATE * v * jnp.array([-1.0, 1.0, 1.0, 0.0])  # noqa: E731
    system = lt.SimpleClosedSystem(L, friction=friction, space=mf.Hyperbolic(2) * mf.Euclidean(1))
    y0 = [0.8, 0.3, 0.5, 0.2, 0.6, 0.1, 0.1]
    return Case(system, hyperbolic_state(y0), hyperbolic_state(solve_by_scipy(hyperbolic_field, y0, 1.0)), 1.0)


CASES = {"pendulum": pendulum, "covariances": covariances, "top": top, "coupled": coupled_points}


def errors(case: Case, method, counts) -> tuple[np.ndarray, list]:
    runs = [lt.integrate(case.system, case.x0, (0.0, case.duration), case.duration / n, method) for n in counts]
    for run in runs:
        assert run.status.ok, run.status
    return np.array([np.abs(run.x[-1] - case.end).max() for run in runs]), runs


def check(case: Case, method, order: float, counts=(20, 40, 80), keeps_energy: bool = False) -> None:
    """The order against the reference, the second law, the first where the method has it, and the constraints."""
    missed, runs = errors(case, method, counts)
    slopes = np.log2(missed[:-1] / missed[1:])
    assert abs(slopes[-1] - order) < 0.2, (missed, slopes)
    for run in runs:
        space = case.system.space
        assert np.asarray(space.residual(case.system.points(run.x))).max() < 1e-14  # 2e-15 measured
        if getattr(case.system, "heat_power", None) is None:
            assert np.diff(run.entropy).min() > 0.0
        if keeps_energy:
            assert np.ptp(run.energy) < 1e-14 * np.abs(run.energy).max()  # 1e-15 measured
    assert runs[-1].audit().passed or not keeps_energy


EXACT = [(lt.MetriplecticMidpoint(), 2.0), (lt.MetriplecticGauss(2), 4.0), (lt.MetriplecticRungeKutta(4), 4.0)]
VARIATIONAL = [(V.verlet(), 1.0), (V.midpoint(), 2.0), (V.symmetrised(), 2.0), (V.midpoint(0.25), 1.0)]
GEODESIC = [(V.midpoint(retraction="exp"), 2.0), (V.symmetrised("exp"), 2.0), (V.verlet("exp"), 1.0)]


@pytest.mark.slow
def test_the_pendulum_by_gauss():
    check(pendulum(), lt.MetriplecticGauss(2), 4.0, keeps_energy=True)


@pytest.mark.slow
def test_the_pendulum_by_a_variational_scheme():
    check(pendulum(), V.midpoint(), 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "covariances", "coupled"])
@pytest.mark.parametrize(("method", "order"), EXACT, ids=str)
def test_laws_and_orders_of_metriplectic_methods(name, method, order):
    check(CASES[name](), method, order, keeps_energy=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "covariances", "coupled"])
@pytest.mark.parametrize(("method", "order"), VARIATIONAL, ids=str)
def test_orders_of_variational_schemes(name, method, order):
    counts = (160, 320, 640) if order == 1.0 else (20, 40, 80)
    check(CASES[name](), method, order, counts)


@pytest.mark.slow
def test_a_top_with_work_and_heat_from_outside():
    """On SO(3), six equations for nine numbers, with the ledger."""
    check(top(), V.midpoint(), 2.0, (20, 40))


@pytest.mark.slow
@pytest.mark.parametrize(("method", "order"), GEODESIC, ids=str)
def test_orders_along_geodesics(method, order):
    check(pendulum(), method, order, (160, 320, 640) if order == 1.0 else (20, 40, 80))


@pytest.mark.slow
def test_two_positions_start_a_variational_run():
    """The first step leads from q_0 to q_1, and the energies of the scheme are at its own points."""
    case, method, h = pendulum(), V.midpoint(), 0.02
    run = lt.integrate(case.system, case.x0, (0.0, 2 * h), h, method)
    q0, q1 = run.x[0, :3], run.x[1, :3]
    again = lt.integrate(case.system, method.state(case.system, q0, q1, run.x[0, 6], h), (0.0, h), h, method)
    assert np.abs(again.x[1, :3] - q1).max() < 1e-13
    assert np.abs(again.x[0] - run.x[0]).max() < 1e-11  # over h
    assert np.ptp(method.energies(case.system, run.x, h)) < 1e-2


def test_evolution_and_contact_fields():
    """``q' = p/m, p' = -H_q - p T, S' = p.p/m`` along the sphere, and ``H' = -H_S H`` of the contact field."""
    space, x = mf.Sphere(2), pendulum().x0
    H = lambda q, p, S: 0.5 * p @ p / MASS + MASS * GRAVITY * q[2] + heat(S)  # noqa: E731
    system = lt.EvolutionSystem(H, space=space)
    q, p, S = x[:3], x[3:6], x[6]
    force = np.array([0.0, 0.0, -MASS * GRAVITY])
    T, along = temperature(S), np.eye(3) - np.outer(q, q)
    expected = np.concatenate([p / MASS, along @ force - (p @ p / MASS) * q - T * p, [p @ p / MASS]])
    assert np.abs(np.asarray(system.vector_field(x)) - expected).max() < 1e-12 * np.abs(expected).max()
    contact = lt.ContactSystem(H, space=space, validate=False)
    energy = float(contact.energy(x))
    expected[-1] -= energy
    assert np.abs(np.asarray(contact.vector_field(x)) - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.slow
def test_an_evolution_field_keeps_its_laws():
    """Both laws to rounding; the second is promised for one mass, and not for three that the sphere mixes."""
    H = lambda mass: (  # noqa: E731
        lt.Kinetic(1.0 / np.asarray(mass)) + lt.Potential(lambda q, S: 0.3 * q[2] ** 3 + 0.02 * jnp.exp(S))
    )
    one = lt.EvolutionSystem(H([2.0, 2.0, 2.0]), space=mf.Sphere(2))
    three = lt.EvolutionSystem(H([0.1, 2.0, 50.0]), space=mf.Sphere(2), validate=False)
    assert one.check().passed
    assert (one.entropy_law, three.entropy_law) == ("nondecreasing", None)
    x0 = [1.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.0]
    run = lt.integrate(one, x0, (0.0, 5.0), 0.25, lt.MetriplecticGauss(2))
    assert np.ptp(run.energy) < 1e-14
    assert np.diff(run.entropy).min() > 0.0
    assert run.audit().passed


# -- the other principles of SML: a one-form, and Herglotz' equations, on the sphere -----------------------------------

GAMMA = 0.7


@functools.cache
def constrained_pendulum() -> lt.ChetaevSystem:
    """The pendulum by ``eta = T dS + F_fr dq``."""
    L = lambda q, v, S: 0.5 * MASS * v @ v - MASS * GRAVITY * q[2] - heat(S)  # noqa: E731
    form = lambda q, v, S: jnp.append(pendulum_friction(q, v, S), 300.0 * jnp.exp(S / CAPACITY))  # noqa: E731
    return lt.ChetaevSystem(L, form, space=mf.Sphere(2))


def lagrangian(q, v, S):
    return 0.5 * MASS * v @ v - MASS * GRAVITY * q[2] - GAMMA * S


def herglotz_field(t, y):
    """(12): a friction ``L_v L_S = -GAMMA L_v``, and ``S' = v . L_v``."""
    theta, _, w, u, _ = y
    sin, cos = np.sin(theta), np.cos(theta)
    w_dot = sin * cos * u * u + GRAVITY * sin - GAMMA * w
    return [w, u, w_dot, -2.0 * cos / sin * w * u - GAMMA * u, MASS * (w * w + sin * sin * u * u)]


@functools.cache
def herglotz_pendulum() -> Case:
    y0 = [2.0, 0.3, 0.2, 1.5, 0.1]
    system = lt.ThermodynamicHerglotz(lagrangian, space=mf.Sphere(2))
    return Case(system, sphere_state(y0), sphere_state(solve_by_scipy(herglotz_field, y0, 1.0)), 1.0)


def fields(system, points) -> np.ndarray:
    return evaluate_at_points(lambda system, x: system.vector_field(x), system, np.asarray(points))


def discrete_errors(order: int, counts=(20, 40, 80)) -> np.ndarray:
    """Return the errors of discrete Herglotz integrators on the sphere, in (q, p, S)."""
    H = lambda q, p, S: 0.5 * p @ p / MASS + MASS * GRAVITY * q[2] + GAMMA * S  # noqa: E731
    case, mass = herglotz_pendulum(), np.repeat([1.0, MASS, 1.0], (3, 3, 1))
    system = lt.EvolutionSystem(H, space=mf.Sphere(2))
    action = lambda q0, q1, S0, h: h * lagrangian(0.5 * (q0 + q1), (q1 - q0) / h, S0)  # noqa: E731
    method = lt.DiscreteHerglotz(action, order=order)
    found, runs = errors(Case(system, mass * case.x0, mass * case.end, case.duration), method, counts)
    for run in runs:
        assert np.abs((run.x[:, :3] ** 2).sum(axis=1) - 1.0).max() < 1e-14
    return found


def test_a_one_form_on_the_sphere():
    """Its field is that of the friction; the law of its entropy is found at points of the sphere."""
    x = np.asarray(pendulum().system.samples(4))
    expected = fields(pendulum().system, x)
    assert np.abs(fields(constrained_pendulum(), x) - expected).max() < 1e-13 * np.abs(expected).max()
    assert constrained_pendulum().entropy_law == "nondecreasing"


@pytest.mark.slow
@pytest.mark.parametrize(("method", "order"), [(lt.MetriplecticGauss(2), 4.0), (V.midpoint(), 2.0)], ids=str)
def test_orders_of_a_one_form_on_the_sphere(method, order):
    check(pendulum()._replace(system=constrained_pendulum()), method, order, keeps_energy=order == 4.0)


def test_herglotz_equations_on_the_sphere():
    """``v' = -g grad z - GAMMA v - |v|^2 q`` of both, ``S' = v . L_v`` of (12) and ``S' = L`` of (10)."""
    x = herglotz_pendulum().x0
    q, v, S = x[:3], x[3:6], x[6]
    along = np.array([0.0, 0.0, -GRAVITY]) + GRAVITY * q[2] * q
    expected = np.concatenate([v, along - GAMMA * v - (v @ v) * q, [MASS * v @ v]])
    assert np.abs(fields(herglotz_pendulum().system, x[None]) - expected).max() < 1e-13 * np.abs(expected).max()
    contact = lt.Herglotz(lagrangian, space=mf.Sphere(2), validate=False)
    expected[-1] = lagrangian(q, v, S)
    assert np.abs(fields(contact, x[None]) - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.slow
def test_laws_and_order_of_herglotz_equations_on_the_sphere():
    check(herglotz_pendulum(), lt.MetriplecticGauss(2), 4.0, keeps_energy=True)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 4])
def test_orders_of_discrete_herglotz_on_the_sphere(order):
    found = discrete_errors(order, (640, 1280) if order == 1 else (20, 40))
    assert abs(np.log2(found[0] / found[1]) - order) < 0.2, found


@pytest.mark.slow
def test_units():
    """In units of mass 1e20 times smaller the motion is the same: the equations of the space are not drowned."""
    case, unit = pendulum(), 1e20
    L = lambda q, v, S: unit * (0.5 * MASS * v @ v - MASS * GRAVITY * q[2]) - unit * heat(S / unit)  # noqa: E731
    friction = lambda q, v, S: unit * pendulum_friction(q, v, S)  # noqa: E731
    system = lt.SimpleClosedSystem(L, friction=friction, space=mf.Sphere(2), validate=False)
    scale = np.append(np.ones(6), unit)
    one, other = (
        lt.integrate(s, x, (0.0, 0.5), 0.05, V.midpoint()).x
        for s, x in ((case.system, case.x0), (system, case.x0 * scale))
    )
    assert np.abs(other / scale - one).max() < 1e-12


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: lt.EvolutionSystem(jnp.sum, space="S2"), r"space must be a manifolds.Space.*got str"),
        (
            lambda: lt.EvolutionSystem(jnp.sum, 5, space=mf.Sphere(2)),
            r"on S\^2 .*must have 7 components, got dim=5",
        ),
        (lambda: lt.EvolutionSystem(jnp.sum), r"2n \+ 1 for n degrees of freedom, got None"),
        (lambda: lt.EvolutionSystem(jnp.sum, space=mf.SpecialUnitary(2)), r"SU\(2\) is complex"),
        (
            lambda: lt.integrate(flat(), [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, V.midpoint(retraction="exp")),
            "Leave retraction= out",
        ),
        (lambda: run(lt.VariationalGauss(2)), r"VariationalGauss runs only on R\^n. On a manifold use"),
        (lambda: run(V(Lazy(0.5))), "no subclass"),
        (lambda: run(lt.DiscreteHerglotz(lambda q0, q1, S0, h: S0)), "got a SimpleClosedSystem"),
        (lambda: herglotz_pendulum().system.hamiltonian_system(), r"inverted on R\^n only.*S\^2.*with space="),
        (
            lambda: run(V.midpoint(retraction=mf.retraction(mf.Sphere(3), "exp"))),
            r"belongs to S\^3, but the system is on S\^2",
        ),
        (lambda: run(V.midpoint(), np.array([1.0, 0, 0, 0.5, 1.0, 0, 0])), r"T S\^2.*off the space"),
    ],
)
def test_errors_are_one_line(call, words):
    with pytest.raises((lt.LiethermoError, mf.ManifoldsError), match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


class Lazy(lt.FiniteDifference):
    """A map of one's own."""


@functools.cache
def flat() -> lt.SimpleClosedSystem:
    return lt.SimpleClosedSystem(lambda q, v, S: 0.5 * v @ v - 0.5 * q @ q - jnp.exp(S), 3)


def run(method, x0=None):
    case = pendulum()
    return lt.integrate(case.system, case.x0 if x0 is None else x0, (0.0, 0.1), 0.05, method)
