"""Every registered space with three methods: first result, time of a step, drift and order."""

from __future__ import annotations

import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

from .. import child as processes
from .. import peers
from ..report import Report, Table, Target, build_available, ratio

METHODS = {
    "RK4": lt.MetriplecticRungeKutta(4),
    "RK8": lt.MetriplecticRungeKutta(8),
    "Gauss(2)": lt.MetriplecticGauss(2),
}
"""Methods that are measured."""

ORDER_STEP_COUNTS = (1, 2, 4, 8, 16)
"""Numbers of steps to t = 1 from which the order is computed."""

MIN_ORDER_ERROR = 2e-13
"""Smallest error that counts for an order."""

RETRACTION_BY_SPACE = {"S^2": "exp", "H^2": "exp", "SO(3)": "exp", "S^2 x R^3": "exp"}
"""Spaces that are also run in charts, and their retraction."""

COLUMNS = {
    "Space": "text",
    "Dimension": "count",
    "Method": "text",
    "First, not cached": "seconds",
    "First, cached": "seconds",
    "Step": "seconds",
    "Over R^d": "ratio",
    "Energy drift": "error",
    "Off the space": "error",
    "Order": "text",
}
"""Columns of the table."""

MAX_SMALL_DIM = 6
"""Dimension from which the first result may take twice as long."""


def run(is_quick: bool) -> Report:
    """Measure each space in a process with an empty cache, and in another with the cache that it left."""
    steps = 1_000 if is_quick else 100_000
    euclidean = mf.Euclidean
    spaces = [space for space in mf.registered_spaces() if space.can_be_embedded and not isinstance(space, euclidean)]
    spaces = spaces[:2] if is_quick else spaces
    rows_by_space = {space.name: _space_rows(space, "around", steps) for space in spaces}
    chart_spaces = [space for space in spaces if space.name in RETRACTION_BY_SPACE]
    chart_rows = [
        row
        for space in chart_spaces
        for row in (rows_by_space[space.name][0], *_space_rows(space, RETRACTION_BY_SPACE[space.name], steps))
    ]
    rows = [row for space_rows in rows_by_space.values() for row in space_rows]
    text = (
        "A system with an energy and an entropy that are not quadratic, and the metric of the space projected off the "
        "energy, from its definition to the end of a run; then many steps, of which one state is kept. RK4 comes first "
        "in its process; the other methods follow in it. *Over R^d* is the time of a step over that of the same "
        "method, and of functions of the same form, on R^d with d the dimension of the space. The order is observed "
        "against SciPy's DOP853; where the error is rounding there is none. Times are of the processor."
    )
    caption = f"{steps:,} steps for the drift, in one thread; a point's residual at the end of them."
    rk4_rows = [row for row in rows if row[2] == "RK4"]
    targets = []
    for title, size_rows in (
        ("below", [r for r in rk4_rows if r[1] < MAX_SMALL_DIM]),
        ("of", [r for r in rk4_rows if r[1] >= MAX_SMALL_DIM]),
    ):
        max_value = 2.0 if title == "below" else 4.0
        suffix = "" if title == "below" else " or more"
        slowest = max((row[3] for row in size_rows), default=None)
        targets.append(
            Target(
                f"first answer on a manifold, {title} {MAX_SMALL_DIM} dimensions{suffix}, the slowest",
                max_value,
                slowest,
                "seconds",
            )
        )
    for name, max_value in (("S^2", 6.0), ("SPD(3)", 6.0), ("St(4, 2)", 12.0)):
        space_rows = [row[6] for row in rk4_rows if row[0] == name]
        targets.append(Target(f"a step on {name} over one on R^d", max_value, space_rows[0] if space_rows else None))
    tables = [
        Table(caption, COLUMNS, rows),
        Table("Steps of order 4 without charts, and in those of `retraction=`.", COLUMNS, chart_rows),
    ]
    rows_by_space, skip_reasons = build_available({"pymanopt": pymanopt_rows})
    if rows_by_space:
        columns = {
            "": "text",
            "Steps": "count",
            "Distance": "error",
            "Half the steps": "error",
            "Extrapolated": "error",
        }
        caption = (
            "Gradient flows to t = 1 beside pymanopt's steepest descent in equal steps, which is of first order: the "
            "distance of both ends, and that of the end that is extrapolated to steps of size zero."
        )
        tables.append(Table(caption, columns, rows_by_space["pymanopt"]))
    return Report("Systems on manifolds", text, tables, targets, skip_reasons)


def _space_rows(space: mf.Space, way: str, steps: int) -> list[list]:
    number = [registered_space.name for registered_space in mf.registered_spaces()].index(space.name)
    with tempfile.TemporaryDirectory() as cache:
        cold = processes.run_in_child_process("manifolds", str(number), way, str(steps), cache=cache)
        warm = processes.run_in_child_process("manifolds", str(number), way, "0", cache=cache)
    title = "" if way == "around" else f', retraction="{way}"'
    return [
        [
            space.name,
            space.dim,
            name + title,
            results[0],
            warm[name][0] if name in warm else None,
            results[1],
            ratio(results[1], results[2]),
            *results[3:],
        ]
        for name, results in cold.items()
    ]


def child(number: str, way: str, steps: str) -> dict[str, list]:
    """Return for each method the first result's time; step times, also on R^d; drift, residual and order."""
    space, count = list(mf.registered_spaces())[int(number)], int(steps)
    x0 = np.asarray(space.to_vector(space.random(3)))
    results: dict[str, list] = {}
    methods = METHODS if way == "around" else {"RK4": lt.MetriplecticRungeKutta(4, retraction=way)}
    for name, method in methods.items() if count else [*methods.items()][:1]:
        began = time.process_time()
        system = relaxing(space)
        lt.integrate(system, x0, (0.0, 1.0), 0.1, method)
        results[name] = [time.process_time() - began]
    if count == 0:
        return results
    euclidean = mf.Euclidean(space.dim)
    euclidean_system, start = relaxing(euclidean), np.asarray(euclidean.random(3))
    exact = _exact_final_state(system, x0)
    for name, method in methods.items():
        euclidean_seconds = _step_seconds(euclidean_system, start, METHODS[name]) if name == "RK4" else None
        results[name] += [_step_seconds(system, x0, method), euclidean_seconds]
        long_run = lt.integrate(system, x0, (0.0, 0.01 * count), 0.01, method, save_every=count)
        residual = float(space.residual(system.points(long_run.x[-1])))
        results[name] += [long_run.audit().energy_drift, residual, _observed_order(system, x0, method, exact)]
    return results


def relaxing(space: mf.Space) -> lt.MetriplecticSystem:
    """Return a system on a space with bounded functions without symmetries."""
    random = np.random.default_rng(5)
    a, b, c = random.standard_normal((3, space.size)) / np.sqrt(space.size)

    def energy(x):
        v = space.to_vector(x)
        return 0.5 * v @ v + 0.3 * jnp.sin(v @ b) + v @ a

    def entropy(x):
        v = space.to_vector(x)
        return -0.5 * (v @ c) ** 2 - 0.1 * v @ v + 0.2 * jnp.cos(v @ a)

    dissipation = lt.ProjectedMetric(normalized=True)
    return lt.MetriplecticSystem(None, energy, entropy, dissipation, space=space, validate=False)


def _step_seconds(system: lt.MetriplecticSystem, x0, method, steps: int = 20_000) -> float:
    """Time several runs and return the least processor seconds per step."""
    best_seconds = np.inf
    for _ in range(3):
        start_time = time.process_time()
        lt.integrate(system, x0, (0.0, 0.01 * steps), 0.01, method, save_every=steps)
        best_seconds = min(best_seconds, time.process_time() - start_time)
    return best_seconds / steps


def _exact_final_state(system: lt.MetriplecticSystem, x0) -> np.ndarray:
    field = jax.jit(lambda x: system.vector_field(x))
    exact = solve_ivp(lambda t, x: np.asarray(field(x)), (0.0, 1.0), x0, method="DOP853", rtol=1e-13, atol=1e-14)
    return exact.y[:, -1]


def _observed_order(system: lt.MetriplecticSystem, x0, method, exact) -> str:
    """Return the order from the two finest step sizes whose errors exceed rounding, as text."""
    errors = []
    for steps in ORDER_STEP_COUNTS:
        end = lt.integrate(system, x0, (0.0, 1.0), 1.0 / steps, method).x[-1]
        errors.append(np.abs(end - exact).max())
        if errors[-1] < MIN_ORDER_ERROR:
            break
    above = [error for error in errors if error >= MIN_ORDER_ERROR]
    return f"{np.log2(above[-2] / above[-1]):.2f}" if len(above) > 1 else "–"


# -- pymanopt ---------------------------------------------------------------------------------------------------------

DESCENT_STEPS = 200
"""Steps of steepest descent to t = 1."""


class _FixedStepSearch:
    """A line search that takes steps of a fixed size."""

    def __init__(self, h: float):
        self.h = h

    def search(self, objective, manifold, x, d, f0, df0):
        del objective, f0, df0
        return self.h, manifold.retraction(x, self.h * d)


def pymanopt_rows() -> list[list]:
    """Return for each space the distance between pymanopt's steepest descent and the gradient flow of the function.

    Raises
    ------
    UnavailableError
        If pymanopt is not installed.
    """
    pymanopt, A = peers.import_peer("pymanopt"), np.diag([1.0, 2.0, 4.0]) + 0.3
    sphere, definite, lines = mf.Sphere(2), mf.SPD(2), mf.Grassmann(3, 1)
    quadratic_cost = (lambda x: 0.5 * np.sum(x * (A @ x))), lambda x: A @ x
    volume_cost = (
        lambda x: np.trace(x) - np.linalg.slogdet(x)[1],
        lambda x: np.eye(2) - np.linalg.inv(x),
    )
    column = np.asarray(sphere.random(1))[:, None]
    cases = [
        (sphere, lambda x: 0.5 * x @ A @ x, column[:, 0], 1.0, pymanopt.manifolds.Sphere(3), quadratic_cost),
        (
            definite,
            lambda x: jnp.trace(x) - jnp.linalg.slogdet(x)[1],
            np.asarray(definite.random(1)),
            1.0,
            pymanopt.manifolds.SymmetricPositiveDefinite(2),
            volume_cost,
        ),
        # projectors change by twice the square of what the vectors do that they project to
        (
            lines,
            lambda x: 0.5 * jnp.trace(A @ x),
            column @ column.T,
            2.0,
            pymanopt.manifolds.Grassmann(3, 1),
            quadratic_cost,
        ),
    ]
    rows = []
    for space, function, x0, t_end, manifold, (cost, gradient) in cases:
        flow = lt.MetriplecticSystem(None, function, dissipation=lt.Friction(), space=space)
        run = lt.integrate(flow, x0, (0.0, t_end), t_end / 100, lt.MetriplecticRungeKutta(8))
        exact = np.asarray(flow.points(run.x[-1]))
        wrap = pymanopt.function.numpy(manifold)
        problem = pymanopt.Problem(manifold, wrap(cost), euclidean_gradient=wrap(gradient))

        def end(steps, problem=problem, start=column if space is lines else x0):
            optimizer = pymanopt.optimizers.SteepestDescent(
                _FixedStepSearch(1.0 / steps),
                max_iterations=steps,
                min_gradient_norm=0.0,
                min_step_size=0.0,
                verbosity=0,
            )
            x = optimizer.run(problem, initial_point=start).point
            return x @ x.T if x.shape == column.shape else x

        half_steps_end, full_steps_end = end(DESCENT_STEPS // 2), end(DESCENT_STEPS)
        ends = full_steps_end, half_steps_end, 2.0 * full_steps_end - half_steps_end
        rows.append([space.name, DESCENT_STEPS, *(float(np.abs(x - exact).max()) for x in ends)])
    return rows
