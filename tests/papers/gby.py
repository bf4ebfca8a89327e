"""GBY: variational discretization of the nonequilibrium thermodynamics of simple systems."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np

import liethermo as lt
from liethermo.models.gases import MASS_SPRING_CASES, MASS_SPRING_STARTS, mass_spring_gas_solution
from liethermo.tracing.interpret import evaluate_at_points

from . import Difference, Order, Tests, Value, fields, order, relative_difference, row, solve_with_scipy

variational = Tests("integrators.test_variational")
on_groups = Tests("integrators.test_variational_lie")
structure = Tests("integrators.test_variational_structure")
chetaev = Tests("systems.test_simple_closed")
composed = Tests("systems.test_composed")
configurations = Tests("systems.test_configurations")

V = lt.VariationalIntegrator
R = np.array([[0.3, 0.2], [-0.1, 0.4]])
POINTS = np.random.default_rng(0).standard_normal((5, 5))


def friction_field(t, y, push=(0.0, 0.0), power=0.0):
    """Evaluate (2.4) by hand, with a friction tensor that is not symmetric, a force ``push`` and a heat supply
    ``power``."""
    q, v, S = y[:2], y[2:4], y[4]
    M, T, F = np.array([[1.0 + 0.3 * q[0] ** 2, 0.2], [0.2, 1.0]]), 0.5 * np.exp(0.5 * S), -R @ v
    dL_dq = np.array([0.3 * q[0] * v[0] ** 2 - q[0] - 0.4 * q[0] ** 3, -q[1]])
    mass_rate = np.array([0.6 * q[0] * v[0] ** 2, 0.0])
    return np.concatenate([v, np.linalg.solve(M, dL_dq - mass_rate + F + push), [(power - F @ v) / T]])


@row("GBY", "(2.4), isolated", "`SimpleClosedSystem`, a friction tensor", "the equations by hand")
def simple_closed():
    system = lt.SimpleClosedSystem(chetaev.L, 5, friction=R, validate=False)
    return relative_difference(fields(system, POINTS), [friction_field(0.0, x) for x in POINTS])


def pushed_field(t, y):
    push, power = np.array([0.2 * np.cos(t), 0.1]), 0.3 + 0.1 * np.sin(t)
    return np.concatenate([friction_field(t, y[:5], push, power), [push @ y[2:4], power, 1.0]])


@functools.cache
def open_system():
    return lt.SimpleClosedSystem(
        chetaev.L,
        5,
        friction=R,
        external=lambda q, v, S, t: jnp.stack([0.2 * jnp.cos(t), 0.1 + 0.0 * t]),
        heat_power=lambda q, v, S, t: 0.3 + 0.1 * jnp.sin(t),
        validate=False,
    )


@row("GBY", "(2.4), open", "`external=`, `heat_power=`, the ledger; `MetriplecticGauss(2)`", "SciPy at $10^{-13}$")
def ledger() -> Order:
    exact = solve_with_scipy(pushed_field, np.append(chetaev.CHETAEV_START, np.zeros(3)), 2.0)
    return order(open_system(), chetaev.CHETAEV_START, 2.0, exact, lt.MetriplecticGauss(2))


@row("GBY", "§2 on a group", '`EulerPoincareClosedSystem`, `LieVariational("exp")`', "SciPy at $10^{-13}$")
def group_order() -> Order:
    x0 = np.array([0.5, 0.3, -0.4, 0.2])
    exact = solve_with_scipy(on_groups.forced_field, np.append(x0, np.zeros(3)), 2.0)
    return order(on_groups.forced_system(), x0, 2.0, exact, lt.LieVariational("exp"), laws=False)


@row("GBY", "§2 on a manifold", "`space=`, a pendulum by `MetriplecticGauss(2)`", "SciPy, in angles")
def manifold_order() -> Order:
    case = configurations.pendulum()
    return order(case.system, case.x0, case.duration, case.end, lt.MetriplecticGauss(2), (40, 80))


@row("GBY", "§3.2 on a manifold", "`VariationalIntegrator.midpoint()`, the pendulum", "SciPy, in angles")
def manifold_map_order() -> Order:
    case = configurations.pendulum()
    return order(case.system, case.x0, case.duration, case.end, V.midpoint(), (40, 80), laws=False)


def recursions(name: str) -> Difference:
    """Compare 500 steps of Case 1 with the printed recursion, with friction 10 and a long step."""
    h, system, method = (
        0.05,
        lt.models.mass_spring_gas(**MASS_SPRING_CASES[1], friction=10.0),
        variational.SCHEMES[name],
    )
    run = lt.integrate(system, method.state(system, 0.3, 0.31, 0.0, h), (0.0, 500 * h), h, method)
    x, S = variational.printed_recursion(name, 0.3, 0.31, 0.0, 500, 5.0, 5.0, 10.0, 1.5 * 8.31446261815324, 300.0, h)
    expected = np.stack([x, S], axis=1).astype(float)
    return relative_difference(run.x[:, [0, 2]] / np.abs(expected).max(axis=0), expected / np.abs(expected).max(axis=0))


@row("GBY", "§3.3, scheme 1", "`VariationalIntegrator.verlet()`, 500 steps", "§5.2 in extended precision")
def scheme_1():
    return recursions("scheme 1")


@row("GBY", "§3.3, scheme 2", "`VariationalIntegrator.midpoint()`, 500 steps", "§5.2 in extended precision")
def scheme_2():
    return recursions("scheme 2")


@row("GBY", "§3.3, scheme 3", "`VariationalIntegrator.symmetrised()`, 500 steps", "§5.2 in extended precision")
def scheme_3():
    return recursions("scheme 3")


@row("GBY", "(3.5)–(3.12)", "scheme 2 on a Lagrangian of no special form", "SciPy at $10^{-13}$")
def scheme_2_order() -> Order:
    exact = solve_with_scipy(pushed_field, np.append(chetaev.CHETAEV_START, np.zeros(3)), 2.0)
    return order(open_system(), chetaev.CHETAEV_START, 2.0, exact, V.midpoint(), (40, 80), laws=False)


@row("GBY", "Remark 3.5", "maps of the forces chosen apart", "SciPy at $10^{-13}$")
def maps_apart() -> Order:
    method, _ = variational.ORDERS["symmetric forces apart"]
    exact = solve_with_scipy(pushed_field, np.append(chetaev.CHETAEV_START, np.zeros(3)), 2.0)
    return order(open_system(), chetaev.CHETAEV_START, 2.0, exact, method, (40, 80), laws=False)


@row("GBY", "§5.1", "the $\\alpha$ family at $\\alpha = 0.3$", "SciPy at $10^{-13}$")
def alpha_family() -> Order:
    exact = solve_with_scipy(pushed_field, np.append(chetaev.CHETAEV_START, np.zeros(3)), 2.0)
    return order(open_system(), chetaev.CHETAEV_START, 2.0, exact, V.midpoint(0.3), (320, 640), laws=False)


@row("GBY", "(3.13)–(3.15)", "the matrix of regularity, scheme 2", "(5.3) as it should be")
def regularity():
    m, k, friction, h, heat = 5.0, 5.0, 10.0, 0.1, 1.5 * 8.31446261815324
    x0, x1, S0, S1 = 0.3, 0.35, 0.1, 0.2
    speed, s, T = (x1 - x0) / h, (S1 - S0) / h, 300.0 * np.exp(0.5 * (S0 + S1) / heat)
    expected = [
        [-m / h - h * k / 4 - friction / 2, 0.0],
        [2 * friction * speed / h, -T / h * (h * s / (2 * heat) + 1)],
    ]
    discrete = V.midpoint().discrete_system(lt.models.mass_spring_gas(m, k, friction), h)
    matrices, _ = evaluate_at_points(variational._matrices, discrete, np.array([[x0, x1, S0, S1]]))
    return relative_difference(matrices[0], expected)


@row("GBY", "(4.7), Theorem 4.3", "the structure of the flow of scheme 2", "both sides")
def structure_of_the_flow():
    forms = structure.forms_of_two_steps("mechanical", "scheme 2")
    return relative_difference(forms[1, 1] - forms[0, 0], forms[:, 2:].sum(axis=(0, 1)))


@row("GBY", "§1, several entropies", "scheme 2 on a piston between two gases", "SciPy at $10^{-13}$")
def several_entropies() -> Order:
    x0 = np.array([0.1, -0.2, 0.2, 0.5, 0.3])
    exact = solve_with_scipy(piston_by_hand, x0, 1.0)
    return order(composed.piston(), x0, 1.0, exact, V.midpoint(), (25, 50), laws=False)


def piston_by_hand(t, y):
    S_l, S_r, q, p, S_p = y
    T_l, T_r, T_p = np.exp(S_l) * (1 + q) ** (-2 / 3), np.exp(S_r) * (1 - q) ** (-2 / 3), 0.01 * np.exp(S_p)
    force = 2 / 3 * (T_l / (1 + q) - T_r / (1 - q)) - 0.2 * p
    heating = 0.2 * p * p + 0.3 * (T_l - T_p) + 0.2 * (T_r - T_p)
    return [0.3 * (T_p - T_l) / T_l, 0.2 * (T_p - T_r) / T_r, p, force, heating / T_p]


@row("GBY", "(5.5)–(5.9)", "the mass and spring in closed form, under-, critically and overdamped", "SciPy")
def closed_solution():
    heat, x0, solutions, expected = 1.5 * 8.31446261815324, np.array([0.3, 0.5, 0.0]), [], []
    for friction in (2.0, 10.0, 20.0):

        def rate(t, y, friction=friction):
            return [y[1], -y[0] - friction / 5.0 * y[1], friction * y[1] ** 2 / (300.0 * np.exp(y[2] / heat))]

        solutions.append(mass_spring_gas_solution(2.0, x0, friction=friction))
        expected.append(solve_with_scipy(rate, x0, 2.0))
    return relative_difference(solutions, expected)


def energies(case: int, scheme: int) -> Value:
    """Return the largest energy error of 10^4 steps without friction."""
    system, method = (
        lt.models.mass_spring_gas(**MASS_SPRING_CASES[case], friction=0.0),
        variational.SCHEMES[f"scheme {scheme}"],
    )
    x0 = method.state(system, MASS_SPRING_STARTS[case], MASS_SPRING_STARTS[case], 0.0, variational.H)
    run = lt.integrate(system, x0, (0.0, 10_000 * variational.H), variational.H, method)
    assert run.stats.least_entropy_increment >= 0.0
    return Value(variational._deviation(method, system, run).max())


for case, scheme, bound in ((1, 1, -8), (1, 3, -11), (2, 1, -6), (2, 3, -9)):
    what, beside = f"energy error of scheme {scheme}, no friction", f"bound printed: $10^{{{bound}}}$"
    row("GBY", f"§5.3, Case {case}", what, beside, case, scheme)(energies)
