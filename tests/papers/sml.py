"""SML: the geometry of some thermodynamic systems."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf
from liethermo.models.springs import damped_oscillator_solution
from liethermo.models.thermo_particles import thermo_particles_solution
from liethermo.tracing.interpret import evaluate_at_points

from . import (
    Difference,
    Order,
    Tests,
    Value,
    fields,
    largest_difference,
    order,
    relative_difference,
    row,
    solve_with_scipy,
)

chetaev = Tests("systems.test_simple_closed")
composed = Tests("systems.test_composed")
configurations = Tests("systems.test_configurations")
evolution = Tests("systems.test_evolution")
herglotz = Tests("systems.test_herglotz")
matter = Tests("systems.test_matter")

POINTS = np.random.default_rng(0).standard_normal((5, 5))
MASS = np.array([2.0, 0.7])
BENT = 0.3


def H(q, p, S):
    return 0.5 * jnp.sum(p * p / MASS) + jnp.sin(BENT * q[0] * q[1]) * jnp.exp(0.2 * S) + 0.5 * q @ q + jnp.exp(S)


def gradients(x):
    """Return the derivatives of H by q, p and S, by hand."""
    q, p, S = x[:2], x[2:4], x[4]
    wave, slope = np.sin(BENT * q[0] * q[1]), np.cos(BENT * q[0] * q[1]) * BENT * q[::-1]
    return slope * np.exp(0.2 * S) + q, p / MASS, 0.2 * wave * np.exp(0.2 * S) + np.exp(S)


def evolution_rates(x, action: bool):
    dH_dq, dH_dp, T = gradients(x)
    p = x[2:4]
    return np.concatenate([dH_dp, -dH_dq - p * T, [p @ dH_dp - (float(H(x[:2], p, x[4])) if action else 0.0)]])


@row("SML", "(1)–(4)", "`mf.ContactForm`: the bivector from the form alone", "(4) as printed")
def bivector():
    form_only = mf.ContactForm(mf.CanonicalContact(2).form, 5)
    expected = []
    for x in POINTS:  # d/dp ^ (d/dq + p d/dS)
        L = np.zeros((5, 5))
        L[2:4, :2], L[2:4, 4] = np.eye(2), x[2:4]
        expected.append(L - L.T)
    return relative_difference(evaluate_at_points(_bivector, form_only, POINTS), expected)


def _bivector(structure, x):
    return structure.bivector(x)


@row("SML", "(5)", "the Jacobi bracket: the generalised rule of Leibniz", "both sides")
def leibniz():
    M = mf.CanonicalContact(2)
    f, g, h = (lambda x: jnp.sin(x @ x)), (lambda x: x[0] * x[3] + x[4]), (lambda x: jnp.exp(0.3 * x[1]) * x[2])
    gh, bracket = (lambda x: g(x) * h(x)), M.jacobi_bracket
    sides = []
    for x in map(jnp.asarray, POINTS[:2]):
        df_dS = 2.0 * float(x[4]) * float(jnp.cos(x @ x))  # -E(f), E = -d/dS
        right_side = g(x) * bracket(f, h)(x) + h(x) * bracket(f, g)(x) - gh(x) * df_dS
        sides.append((float(bracket(f, gh)(x)), float(right_side)))
    return relative_difference(*np.array(sides).T)


@row("SML", "(7)", "`EvolutionSystem`", "the equations printed")
def evolution_field():
    return relative_difference(
        fields(lt.EvolutionSystem(H, 5, validate=False), POINTS), [evolution_rates(x, False) for x in POINTS]
    )


@row("SML", "Prop. 2.1", "`ContactSystem`", "the equations printed")
def contact_field():
    return relative_difference(
        fields(lt.ContactSystem(H, 5, validate=False), POINTS), [evolution_rates(x, True) for x in POINTS]
    )


def herglotz_rates(x, action: bool):
    """Evaluate (10) or (12) by hand, for the Lagrangian of the tests of ChetaevSystem."""
    q, v, S = x[:2], x[2:4], x[4]
    M, T = np.array([[1.0 + 0.3 * q[0] ** 2, 0.2], [0.2, 1.0]]), 0.5 * np.exp(0.5 * S)
    dL_dq = np.array([0.3 * q[0] * v[0] ** 2 - q[0] - 0.4 * q[0] ** 3, -q[1]])
    mass_rate = np.array([0.6 * q[0] * v[0] ** 2, 0.0])
    L = 0.5 * v @ M @ v - 0.5 * q @ q - 0.1 * q[0] ** 4 - np.exp(0.5 * S)
    return np.concatenate([v, np.linalg.solve(M, dL_dq - mass_rate - T * M @ v), [L if action else v @ M @ v]])


@functools.cache
def thermodynamic():
    return lt.ThermodynamicHerglotz(lambda x: chetaev.L(x[:2], x[2:4], x[4]), 5, validate=False)


@row("SML", "(8)–(11)", "`Herglotz`", "the equations by hand")
def herglotz_field():
    system = lt.Herglotz(lambda x: chetaev.L(x[:2], x[2:4], x[4]), 5, validate=False)
    return relative_difference(fields(system, POINTS), [herglotz_rates(x, True) for x in POINTS])


@row("SML", "(12)", "`ThermodynamicHerglotz`", "the equations by hand")
def thermodynamic_field():
    return relative_difference(fields(thermodynamic(), POINTS), [herglotz_rates(x, False) for x in POINTS])


@row("SML", "Def. 3.1, (13), (14)", "`ChetaevSystem` by `MetriplecticGauss(2)`", "SciPy at $10^{-13}$")
def chetaev_order() -> Order:
    exact = solve_with_scipy(chetaev.field_by_hand, chetaev.CHETAEV_START, 2.0)
    return order(chetaev.chetaev_system(), chetaev.CHETAEV_START, 2.0, exact, lt.MetriplecticGauss(2))


@row("SML", "Prop. 3.3", "`ChetaevSystem` with $\\eta_L$ is `ThermodynamicHerglotz`", "the equations by hand")
def proposition_3_3():
    def minus_momentum(q, v, S):
        return -jnp.stack([(1.0 + 0.3 * q[0] ** 2) * v[0] + 0.2 * v[1], 0.2 * v[0] + v[1]])

    system = lt.ChetaevSystem(chetaev.L, minus_momentum, 5, validate=False)
    return relative_difference(fields(system, POINTS), [herglotz_rates(x, False) for x in POINTS])


@row("SML", "Def. 3.1 on a manifold", "`ChetaevSystem(space=...)` on a sphere", "the pendulum's friction")
def chetaev_on_a_sphere():
    x = configurations.pendulum().system.samples(4)
    return relative_difference(
        fields(configurations.constrained_pendulum(), x), fields(configurations.pendulum().system, x)
    )


@row("SML", "Props. 4.1, 4.3", "the energy in 400 steps; no step loses entropy", "its first value")
def isolated_laws():
    energy = lt.Kinetic([1.0, 2.0]) + lt.Potential(lambda q, S: jnp.sin(q[0] * q[1]) + 0.5 * q @ q + jnp.exp(S))
    run = lt.integrate(lt.EvolutionSystem(energy, 5), POINTS[0], (0.0, 80.0), 0.2)
    assert run.stats.least_entropy_increment >= 0.0
    return relative_difference(run.energy, np.full(len(run.energy), run.energy[0]))


@row("SML", "Example 1", "the damped oscillator in closed form", "SciPy at $10^{-13}$")
def oscillator():
    gamma, x0 = 0.3, [0.7, -1.1, 0.4]
    exact = solve_with_scipy(lambda t, y: [y[1], -y[0] - gamma * y[1], y[1] ** 2], x0, 3.0)
    return relative_difference(damped_oscillator_solution(3.0, x0, 1.0, 1.0, gamma), exact)


@row("SML", "§5, (32)", "`ComposedSystem`", "the matrix printed")
def composed_field():
    wave, k = np.random.default_rng(3).standard_normal(8), 0.7

    def energy(x):
        return jnp.sin(wave @ x) + jnp.exp(x[4]) + jnp.exp(0.5 * x[7]) + jnp.sum(x[:4] ** 2)

    zero = lambda dim: lt.Subsystem(None, dim)  # noqa: E731
    system = lt.ComposedSystem([zero(5), zero(3)], coupling=lt.Function(energy), conductance=k, validate=False)
    x = np.array([0.3, -0.2, 0.5, 0.1, 1.5, 0.2, -0.4, 2.0])
    dH = wave * np.cos(wave @ x) + np.concatenate([2.0 * x[:4], [np.exp(x[4]), 0.0, 0.0, 0.5 * np.exp(0.5 * x[7])]])
    K = k * (1.0 / dH[4] - 1.0 / dH[7])
    tensor = np.zeros((8, 8))
    tensor[:2, 2:4], tensor[2:4, :2] = np.eye(2), -np.eye(2)
    tensor[5, 6], tensor[6, 5], tensor[4, 7], tensor[7, 4] = 1.0, -1.0, K, -K
    return relative_difference(fields(system, x), [tensor @ dH])


@row("SML", "Example 2", "`models.thermo_particles` by `MetriplecticMidpoint`", "the closed solution")
def particles() -> Order:
    capacities, T = (1.0, 2.0), np.array([3.0, 1.0])
    system, x0 = lt.models.thermo_particles(capacities, 0.7), np.array(capacities) * np.log(T)
    end = np.array(capacities) * np.log(thermo_particles_solution(2.0, T, capacities, 0.7))
    return order(system, x0, 2.0, end, lt.MetriplecticMidpoint())


@row("SML", "Examples 3, 4", "bodies that move, and springs between them", "the equations by hand")
def moving_bodies():
    system = lt.models.moving_thermo_particles((1.0, 2.0), (1.0, 3.0), 0.5)
    q, p, S, r, s, R = x = np.array([0.0, 0.3, 0.1, 2.0, -1.0, 0.9])
    T, U = np.exp(S), np.exp(R / 3.0)
    free_rates = [p, 0.0, 0.5 * (U - T) / T, s / 2.0, 0.0, 0.5 * (T - U) / U]
    spring = lambda q: 0.5 * (q[0] - q[1]) ** 2  # noqa: E731
    build_body = lambda m, c: lt.Subsystem(lt.Kinetic([1.0 / m]) + lt.Potential(lambda q, S: c * jnp.exp(S / c)), 3)  # noqa: E731
    tied_system = lt.ComposedSystem([build_body(1.0, 1.0), build_body(2.0, 3.0)], spring, 0.5)
    spring_forces = np.array([0.0, r - q, 0.0, 0.0, q - r, 0.0])
    return largest_difference(
        relative_difference(fields(system, x), [free_rates]),
        relative_difference(fields(tied_system, x), [free_rates + spring_forces]),
    )


@row("SML", "(34)–(39)", "`MetriplecticMidpoint`, 1000 steps", "(39) in extended precision")
def closed_form():
    run = lt.integrate(evolution.oscillator(), [0.0, 10.0, 0.0], (0.0, 100.0), 0.1)
    states, expected = run.x, evolution.thousand_steps().astype(float)
    return relative_difference(states / np.abs(expected).max(axis=0), expected / np.abs(expected).max(axis=0))


@row("SML", "§6.2, Lemma 6.2", "the entropy of a step, energies quadratic", "the formula printed")
def lemma_6_2():
    quadratic = lambda: lt.Subsystem(lambda x: 0.5 * x[0] ** 2, 1)  # noqa: E731
    system, h, k = lt.ComposedSystem([quadratic(), quadratic()], conductance=0.5, validate=False), 0.1, 0.5
    x = lt.integrate(system, [1.0, 3.0], (0.0, h), h).x
    T = x.mean(axis=0)
    return relative_difference(np.diff(x.sum(axis=1)), [h * k * (T[1] - T[0]) ** 2 / (T[0] * T[1])])


@row("SML", "§6.2, as printed", '`conduction="midpoint"` against discrete temperatures, two steps', "each other")
def printed_conduction() -> Value:
    bodies = [lt.Subsystem(composed.Warm(jnp.asarray(1.0)), 1) for _ in range(2)]
    ends = [
        lt.integrate(lt.ComposedSystem(bodies, conductance=1.0, conduction=kind), np.log([1.0, 3.0]), (0.0, 0.2), 0.1)
        for kind in ("midpoint", "discrete")
    ]
    return Value(np.abs(ends[0].x[-1] - ends[1].x[-1]).max())


@row("SML", "(40), (41)", "`DiscreteHerglotz`, an action that makes it implicit", "the equations by hand")
def discrete_herglotz():
    h, run = 0.05, herglotz.quartic_run(40)
    q, S = run.x[:, 0], run.x[:, 2]

    def derivatives(a, b, S):
        z, v = 0.5 * (a + b), (b - a) / h
        dL_dz, dL_dv = -(z**3) - 0.03 * S, v + 0.2 * v**3
        return 0.5 * h * dL_dz - dL_dv, 0.5 * h * dL_dz + dL_dv, -0.3 * h * (1.0 + 0.1 * z)

    D1, _, DS = derivatives(q[1:-1], q[2:], S[1:-1])
    D2 = derivatives(q[:-1], q[1:], S[:-1])[1]
    return largest_difference(
        relative_difference((1.0 + DS) * D2[:-1], -D1),
        relative_difference(np.diff(S) / np.ptp(S), np.diff(q) * D2 / np.ptp(S)),
    )


@row("SML", "(42)", "`DiscreteHerglotz`, 1000 steps", "(42) in extended precision")
def recursion():
    run, expected = herglotz.thousand_steps()
    return relative_difference(run.x[:, [0, 2]] / np.abs(expected).max(axis=0), expected / np.abs(expected).max(axis=0))


@row("SML", "§6.3, its question", "`DiscreteHerglotz(..., order=4)`, any first action", "SciPy at $10^{-13}$")
def higher_order() -> Order:
    return Order(np.log2(np.divide(*herglotz.errors_of_order(4, 3.7))))


@row("SML", "§6.3 on a manifold", "`DiscreteHerglotz(..., order=2)` on a sphere", "SciPy, in angles")
def herglotz_on_a_sphere() -> Order:
    return Order(np.log2(np.divide(*configurations.discrete_errors(2, (20, 40)))))


@row("SML", "Figs. 1, 2", "the error of q and of S in them", "the closed solution")
def figures_1_and_2() -> Value:
    run = lt.integrate(lt.models.damped_oscillator(), [0.0, 10.0, 0.0], (0.0, 60.0), 0.1)
    errors = np.abs(run.x - damped_oscillator_solution(run.t, [0.0, 10.0, 0.0])).max(axis=0)
    assert abs(errors[0] - 0.0612) < 1e-4  # of (39), iterated by itself
    return Value(errors[2])


@row("SML", "Figs. 3, 4", "the temperatures at their end", "286.575")
def figures_3_and_4():
    run = lt.integrate(lt.models.thermo_particles(), np.log([273.15, 300.0]), (0.0, 50.0), 0.1)
    return relative_difference(np.exp(run.x[-1]), [286.575, 286.575])


@row("SML", "Figs. 5, 6", "the energy of (42) at its start", "(42), iterated by itself")
def figures_5_and_6():
    run, _ = herglotz.thousand_steps()
    S = 0.1**-1 - 0.1 / 4.0  # (42) from q = 0, 1
    p = 1.0 / 0.1 - 0.1 / 4.0
    return relative_difference(run.energy[0], [0.5 * p * p + 0.5 + 0.1 * S])


@row("SML", "§7, metrics", "$S'$ of a Lorentzian metric, time-like and space-like", "$p \\cdot g^{-1} p$")
def lorentzian():
    energy = lambda q, p, S: 0.5 * (p[0] ** 2 - p[1] ** 2) + jnp.exp(S)  # noqa: E731
    system = lt.EvolutionSystem(energy, 5, validate=False)
    assert system.entropy_law is None
    return relative_difference(fields(system, POINTS)[:, 4], [x[2] ** 2 - x[3] ** 2 for x in POINTS])


@row("SML", "§7, many bodies", "`ComposedSystem`: factors $K_{ij}$ of three", "the formula")
def many_bodies():
    k, c, x = np.array([[0.0, 1.0, 0.5], [1.0, 0.0, 2.0], [0.5, 2.0, 0.0]]), np.array([1.0, 2.0, 0.5]), POINTS[0, :3]
    system = lt.ComposedSystem([lt.Subsystem(composed.Warm(jnp.asarray(a)), 1) for a in c], conductance=k)
    T = np.exp(x / c)
    return relative_difference(fields(system, x), [(k * (1.0 / T[:, None] - 1.0 / T)) @ T])


@row("SML", "§7, matter", "`models.porous_piston` by `MetriplecticGauss(2)`", "SciPy at $10^{-13}$")
def porous_piston() -> Order:
    exact = solve_with_scipy(matter.piston_by_hand, matter.start(), 2.0)
    return order(matter.piston(), matter.start(), 2.0, exact, lt.MetriplecticGauss(2), (40, 80))


@row("SML", "§7, reactions", "`models.reaction_vessel` at rest", "the law of mass action")
def mass_action() -> Difference:
    end = lt.integrate(matter.vessel(), matter.gas_state(), (0.0, 300.0), 0.1).x[-1]
    T = np.asarray(matter.vessel().temperatures(end))[0]
    c, e, s = np.array([1.5, 1.5, 2.5]), np.array([0.0, 0.0, -2.0]), np.array([0.0, 0.0, 0.5])
    standard = e + (c + 1.0) * T - T * (c * np.log(T) + s)
    return relative_difference(end[3] / (end[1] * end[2]), [np.exp((standard[0] + standard[1] - standard[2]) / T)])
