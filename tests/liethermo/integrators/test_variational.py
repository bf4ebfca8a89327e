"""Variational integrators: the printed equations, the paper's table, orders, laws, starts, and bad input."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
from liethermo.models.gases import MASS_SPRING_CASES, MASS_SPRING_STARTS, mass_spring_gas_solution
from liethermo.tracing.interpret import evaluate_at_points
from tests.liethermo.closed_systems import ISOLATED_SYSTEMS, OPEN, SCHEMES, X0
from tests.refusals import refusal_test

H = 1e-3
TABLE = {  # largest |E - E_0| / E_0 over 5-20 thousand steps, for lambda = 0, 0.2, 5, 10
    (1, "scheme 1"): (3.0e-8, 2.8e-8, 1.3e-8, 9.3e-9),
    (1, "scheme 2"): (3e-15, 8.4e-12, 1.6e-11, 1.6e-11),
    (1, "scheme 3"): (3.0e-11, 2.9e-11, 2.0e-11, 1.7e-11),
    (2, "scheme 1"): (9.5e-9, 9.3e-9, 6.4e-9, 4.9e-9),
    (2, "scheme 2"): (4e-16, 2.2e-12, 6.2e-12, 6.7e-12),
    (2, "scheme 3"): (1.3e-11, 1.3e-11, 1.1e-11, 9.4e-12),
}
FRICTIONS = (0.0, 0.2, 5.0, 10.0)

each_scheme = pytest.mark.parametrize("name", SCHEMES)


def _run(system, method, x0, steps, h=H, **options):
    return lt.integrate(system, x0, (0.0, steps * h), h, method, **{"engine": "compiled", **options})


# -- the printed equations --------------------------------------------------------------------------------------------


def printed_recursion(name, x0, x1, S0, steps, m, k, friction, heat, T0, h):
    """Return x and S by the recursions of §5.2 in extended precision; scheme 2 with the temperature of (3.9)."""
    m, k, lam, heat, T0, h = map(np.longdouble, (m, k, friction, heat, T0, h))

    def T(S):
        return T0 * np.exp(S / heat)

    def entropy(a, b, S):
        heat_produced, S1 = lam * ((b - a) / h) ** 2 * h, S
        for _ in range(30):  # a contraction, since the temperature hardly changes in a step
            mean = {"scheme 1": T(S), "scheme 2": T((S + S1) / 2), "scheme 3": (T(S) + T(S1)) / 2}[name]
            S1 = S + heat_produced / mean
        return S1

    x, S = [np.longdouble(x0), np.longdouble(x1)], [np.longdouble(S0)]
    S.append(entropy(*x, S[0]))
    for _ in range(steps - 1):
        a, b = x[-2:]
        if name == "scheme 1":
            c = (m * (2 * b - a) - h**2 * k * b + h * lam * b) / (m + h * lam)
        elif name == "scheme 2":
            c = (m * (2 * b - a) - h**2 * k * (a + 2 * b) / 4 + h * lam * a / 2) / (m + h**2 * k / 4 + h * lam / 2)
        else:
            c = (m * (2 * b - a) - h**2 * k * b + h * lam * a / 2) / (m + h * lam / 2)
        x.append(c)
        S.append(entropy(b, c, S[-1]))
    return np.array(x), np.array(S)


@pytest.mark.sampled("scheme 1-compiled")
@pytest.mark.parametrize(
    ("name", "engine"),
    [
        ("scheme 1", "compiled"),
        ("scheme 2", "array"),
        ("scheme 3", "compiled"),
        pytest.param("scheme 1", "array", marks=pytest.mark.slow),
        pytest.param("scheme 2", "compiled", marks=pytest.mark.slow),
        pytest.param("scheme 3", "array", marks=pytest.mark.slow),
    ],
)
def test_the_printed_schemes(name, engine):
    """500 steps of Case 1 with friction 10 and a long step, from two positions, are the recursions of §5.2."""
    h, system = 0.05, lt.models.mass_spring_gas(**MASS_SPRING_CASES[1], friction=10.0)
    start = SCHEMES[name].state(system, 0.3, 0.31, 0.0, h)
    solution = _run(system, SCHEMES[name], start, 500, h, engine=engine)
    heat = 1.5 * 8.31446261815324
    x, S = printed_recursion(name, 0.3, 0.31, 0.0, 500, 5.0, 5.0, 10.0, heat, 300.0, h)
    assert np.abs(solution.x[:, 0] - x).max() < 1e-13
    assert np.abs(solution.x[:, 2] - S).max() < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        pytest.param(kind, name, marks=() if (kind, name) == ("mechanical", "scheme 2") else pytest.mark.slow)
        for kind in OPEN
        for name in SCHEMES
    ],
)
def test_a_run_solves_3_12(kind, name):
    """The nodes satisfy the equations in three positions, with every force, for Lagrangians of no special form."""
    h, method, system = 0.05, SCHEMES[name], OPEN[kind]
    x = _run(system, method, X0, 8, h, engine="compiled").x

    @jax.jit
    @jax.vmap
    def step_residuals(x0, x1, x2):
        (a, _, Sa, ta), (b, _, Sb, tb), (c, _, Sc, _) = (system.split_state(y) for y in (x0, x1, x2))
        step_1, step_2 = method.discrete_system(system, h, ta), method.discrete_system(system, h, tb)
        return (
            step_1.momenta(a, b, Sa, Sb)[1] - step_2.momenta(b, c, Sb, Sc)[0],  # (3.12)
            step_2.constraint(b, c, Sb, Sc),
            system.momentum(*system.split_state(x1)[:3]) - step_2.momenta(b, c, Sb, Sc)[0],
        )

    for residual in step_residuals(x[:-2], x[1:-1], x[2:]):
        assert np.abs(residual).max() < 1e-12


def test_the_matrix_of_regularity():
    """The matrices are (5.2)-(5.4) for the mass and spring, with the signs of (3.13): see *Misprints* in the docs."""
    m, k, lam, h, heat = 5.0, 5.0, 10.0, 0.1, 1.5 * 8.31446261815324
    system = lt.models.mass_spring_gas(m, k, lam)
    x0, x1, S0, S1 = 0.3, 0.35, 0.1, 0.2
    V, s = (x1 - x0) / h, (S1 - S0) / h
    T = 300.0 * np.exp(np.array([S0, 0.5 * (S0 + S1), S1]) / heat)
    matrix_by_scheme = {
        "scheme 1": [[-m / h - lam, 0.0], [2 * lam * V / h, -T[0] / h]],
        "scheme 2": [[-m / h - h * k / 4 - lam / 2, 0.0], [2 * lam * V / h, -T[1] / h * (h * s / (2 * heat) + 1)]],
        "scheme 3": [[-m / h - lam / 2, 0.0], [2 * lam * V / h, -(T[2] * s / heat + (T[0] + T[2]) / h) / 2]],
    }
    for name, matrix in matrix_by_scheme.items():
        discrete = SCHEMES[name].discrete_system(system, h)
        matrices, reduced_matrices = evaluate_at_points(_matrices, discrete, np.array([[x0, x1, S0, S1]]))
        assert np.abs(matrices[0] - np.array(matrix)).max() < 1e-10 * np.abs(matrix).max(), name
        assert np.allclose(reduced_matrices[0], np.array(matrix)[:1, :1], rtol=1e-13)


def _matrices(discrete, x):
    r = x[:1], x[1:2], x[2], x[3]
    return discrete.end_point_jacobian(*r), discrete.reduced_regularity_matrix(*r)


def test_a_map_of_one_s_own():
    """A subclass that implements alpha = 1/2 by itself makes the same discrete system."""

    class Midpoint(lt.FiniteDifference):
        def position(self, q0, V, h):
            return 0.5 * (q0 + (q0 + h * V))

        @property
        def is_symmetric(self):
            return True

    user_scheme = lt.VariationalIntegrator(Midpoint(0.5))
    assert user_scheme.order == 2
    points = np.array([[0.1, 0.2, 0.15, 0.1, 0.2, 0.3]])
    a, b = (
        evaluate_at_points(_momenta, scheme.discrete_system(OPEN["tangled"], 0.1), points)
        for scheme in (user_scheme, SCHEMES["scheme 2"])
    )
    assert np.abs(a - b).max() < 1e-14
    assert (
        np.abs(
            a - evaluate_at_points(_momenta, SCHEMES["scheme 3"].discrete_system(OPEN["tangled"], 0.1), points)
        ).max()
        > 1e-3
    )


def _momenta(discrete, x):
    r = x[:2], x[2:4], x[4], x[5]
    return jnp.concatenate([*discrete.momenta(*r), discrete.constraint(*r)[None]])


# -- the paper's tests ------------------------------------------------------------------------------------------------


@pytest.mark.sampled("scheme 1-2")
@pytest.mark.parametrize("case", MASS_SPRING_CASES)
@each_scheme
def test_the_table_of_energies(case, name):
    """Cases 1 and 2 over 10^4 steps agree with the table within a factor of 3; S grows at every step."""
    for friction, table_value in zip(FRICTIONS, TABLE[case, name], strict=True):
        system, method = lt.models.mass_spring_gas(**MASS_SPRING_CASES[case], friction=friction), SCHEMES[name]
        solution = _run(
            system, method, method.state(system, MASS_SPRING_STARTS[case], MASS_SPRING_STARTS[case], 0.0, H), 10_000
        )
        deviation = _deviation(method, system, solution)
        assert deviation.max() < 3 * table_value, friction
        if table_value > 1e-14:  # not rounding
            assert deviation.max() > table_value / 3, friction
        rises = np.diff(solution.x[:, 2])[1:]  # in the first step nothing moves, x_0 = x_1
        assert (rises > 0.0).all() if friction > 0.0 else (rises == 0.0).all()


def _deviation(method, system, solution):
    E = method.energies(system, solution.x, H)
    return np.abs(E / E[0] - 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("case", MASS_SPRING_CASES)
@each_scheme
def test_the_table_over_1e5_steps(case, name):
    """The bounds hold to the end, and the entropy grows at every step at which friction still acts."""
    for friction, table_value in zip(FRICTIONS, TABLE[case, name], strict=True):
        system, method = lt.models.mass_spring_gas(**MASS_SPRING_CASES[case], friction=friction), SCHEMES[name]
        x0 = method.state(system, MASS_SPRING_STARTS[case], MASS_SPRING_STARTS[case], 0.0, H)
        solution = _run(system, method, x0, 100_000, engine="compiled")
        deviation = _deviation(method, system, solution)
        assert deviation.max() < 3 * table_value, friction
        assert solution.stats.least_entropy_increment >= 0.0
        if friction > 0.0:  # in the first step nothing moves, x_0 = x_1
            is_moving = np.abs(solution.x[:-1, 1]) > 1e-6
            assert (np.diff(solution.x[:, 2])[is_moving] > 0.0)[1:].all()
        last_deviations = deviation[-20_000:]
        if name == "scheme 1" and friction > 0.0:
            assert last_deviations.max() < deviation[:20_000].max()  # "decreases in time"
        elif friction > 1.0:
            assert (
                np.ptp(last_deviations) < 1e-3 * last_deviations.max()
            )  # "stays constant": once the mass is at rest, and so that of scheme 1


ORDERS = {  # by hand: 1 where a scheme is not symmetric
    "scheme 1": (SCHEMES["scheme 1"], 1),
    "scheme 2": (SCHEMES["scheme 2"], 2),
    "scheme 3": (SCHEMES["scheme 3"], 2),
    "alpha = 0.3": (lt.VariationalIntegrator.midpoint(0.3), 1),
    "forces apart": (lt.VariationalIntegrator(lt.FiniteDifference(0.5), forces=lt.FiniteDifference(0.0)), 1),
    "symmetric forces apart": (
        lt.VariationalIntegrator(lt.FiniteDifference(0.5), forces=(lt.FiniteDifference(0.0), lt.FiniteDifference(1.0))),
        2,
    ),
}


def _slopes(errors):
    return np.log2(np.array(errors[:-1]) / errors[1:])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("friction", [2.0, 10.0, 20.0], ids=["underdamped", "critical", "overdamped"])
def test_orders_against_the_exact_solution(name, friction):
    method, order = ORDERS[name]
    assert method.order == order
    system, x0, errors = lt.models.mass_spring_gas(**MASS_SPRING_CASES[1], friction=friction), [0.3, 0.5, 0.0], []
    for steps in (80, 160, 320, 640):
        solution = _run(system, method, x0, steps, 4.0 / steps, save_every=steps // 40)
        errors.append(np.abs(solution.x - mass_spring_gas_solution(solution.t, x0, friction=friction)).max(0))
    assert (np.abs(_slopes(errors) - order) < 0.2).all(), errors


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "scheme 3" else pytest.mark.slow) for name in ORDERS],
)
def test_orders_on_a_system_of_no_special_form(name):
    """With every force, work and heat from outside, the error of the energy balance has the same order."""
    (method, order), system = ORDERS[name], OPEN["tangled"]
    assert method.order == order
    exact = lt.integrate(system, X0, (0.0, 1.0), 1.0, lt.Reference(rtol=1e-12)).x[-1]
    errors, defects = [], []
    for steps in (40, 80, 160, 320):
        solution = _run(system, method, X0, steps, 1.0 / steps, save_every=steps)
        errors.append(np.abs(solution.x[-1] - exact).max())
        defects.append(solution.audit().energy_drift)
    assert (np.abs(_slopes(errors) - order) < 0.2).all(), errors
    assert (np.abs(_slopes(defects) - order) < 0.2).all(), defects


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scheme 3", "scheme 1", "scheme 2", "alpha = 0.3"])
def test_the_entropy_grows_at_every_step(name):
    """The entropy grows in coarse steps too, although the energy is not conserved."""
    solution = _run(ISOLATED_SYSTEMS["mechanical"], ORDERS[name][0], X0, 60, 0.3, engine="compiled")
    assert solution.stats.least_entropy_increment > 0.0
    assert solution.energy.max() - solution.energy.min() > 1e-3  # the energy is not kept


# -- starts -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "scheme 2" else pytest.mark.slow) for n in SCHEMES])
def test_two_ways_to_start(name):
    """From (q_0, q_1, S_0) the first step leads to q_1; from (q_0, v_0, S_0) it is exact: v_0 = L_v^-1(p_0)."""
    method, system, h = SCHEMES[name], ISOLATED_SYSTEMS["tangled"], 0.05
    solution = _run(system, method, X0, 2, h, engine="compiled")
    state = method.state(system, solution.x[0, :2], solution.x[1, :2], X0[4], h)
    assert np.abs(state - X0).max() < 1e-12
    S1 = solution.x[1, 4]
    assert np.abs(method.state(system, X0[:2], solution.x[1, :2], X0[4], h, S1=S1) - X0).max() < 1e-12


@pytest.mark.slow
def test_inconsistent_first_steps():
    method, system = SCHEMES["scheme 2"], ISOLATED_SYSTEMS["mechanical"]
    with pytest.raises(lt.InputError, match=r"not on the discrete constraint: \|P_d\| = .* Leave S1 out"):
        method.state(system, [0.4, -0.3], [0.42, -0.28], 0.2, 0.05, S1=0.25)
    with pytest.raises(lt.InputError, match="shape"):
        method.state(system, [0.4], [0.42, -0.28], 0.2, 0.05)
    cold = lt.SimpleClosedSystem(lambda q, v, S: 0.5 * v @ v - S + 0.5 * S**2, 3, friction=0.1, validate=False)
    with pytest.raises(lt.InputError, match="temperature may be negative"):
        method.state(cold, 0.0, 0.1, 2.0, 0.1)


# -- failures ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_a_temperature_that_reaches_zero_stops_the_run(engine):
    """The temperature is T = 1 - S: friction heats the body until it is zero."""
    system = lt.SimpleClosedSystem(
        lambda q, v, S: 0.5 * v @ v - 0.5 * q @ q - S + 0.5 * S**2, 3, friction=1.0, validate=False
    )
    with pytest.raises(lt.NonFiniteError, match=r"positive temperature|temperature -dL/dS") as caught:
        _run(system, SCHEMES["scheme 3"], [0.0, 1.2, 0.0], 1000, 0.02, engine=engine)
    partial = caught.value.solution
    assert 2 < len(partial.t) < 1000
    assert (np.asarray(system.temperature(partial.x)) > 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_a_degenerate_regularity_matrix_is_reported(engine):
    """-m/h - h U''/4 = 0 for m = 1, h = 1/2 and U'' = -16: the midpoint rule does not determine q_1."""
    system = lt.SimpleClosedSystem(lambda q, v, S: 0.5 * v @ v + 8.0 * q @ q - jnp.exp(S), 3)
    with pytest.raises(lt.NonFiniteError, match=r"the regularity matrix \(3.13\) is singular.* 0"):
        _run(system, SCHEMES["scheme 2"], [0.1, 0.0, 0.0], 4, 0.5, engine=engine)
    assert _run(system, SCHEMES["scheme 2"], [0.1, 0.0, 0.0], 4, 0.4, engine=engine).status.ok


test_bad_input = refusal_test(
    (lambda: lt.FiniteDifference(1.5), "between 0 and 1, got 1.5"),
    (lambda: lt.FiniteDifference(0.5, beta=-0.1), "beta"),
    (lambda: lt.FiniteDifference(0.5, weight=0.0), "weight"),
    (lambda: lt.VariationalIntegrator([]), "phi must be"),
    (lambda: lt.VariationalIntegrator(0.5), "phi must be|not iterable"),
    (
        lambda: lt.integrate(
            lt.models.rigid_body(), [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, lt.VariationalIntegrator.verlet()
        ),
        "SimpleClosedSystem, got a LiePoissonSystem",
    ),
)


# -- engines ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in SCHEMES])
def test_both_engines_take_the_same_steps(name):
    system = OPEN["tangled"]
    array_run, compiled_run = (
        _run(system, SCHEMES[name], X0, 50, 0.02, engine=engine) for engine in ("array", "compiled")
    )
    assert np.abs(array_run.x - compiled_run.x).max() < 1e-13
