"""Every registered space with three methods: the first answer, the time of a step, drift and order."""

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
from ..report import Report, Table, Target

METHODS = {
    "RK4": lt.MetriplecticRungeKutta(4),
    "RK8": lt.MetriplecticRungeKutta(8),
    "Gauss(2)": lt.MetriplecticGauss(2),
}

STEPS = {4: (10, 20), 8: (4, 6)}

COLUMNS = {
    "Space": "text",
    "Method": "text",
    "First, not cached": "seconds",
    "First, cached": "seconds",
    "Step": "seconds",
    "Over R^d": "ratio",
    "Energy drift": "error",
    "Off the space": "error",
    "Order": "number",
}


def run(quick: bool) -> Report:
    """One process for each space and method, twice: with an empty cache, and with the one that it left."""
    steps = 1_000 if quick else 100_000
    spaces = list(mf.registered_spaces())
    numbers = [i for i, space in enumerate(spaces) if space.surrounded]
    numbers = numbers[:2] if quick else numbers
    rows: list[list] = []
    for i in numbers:
        for name in ["RK4"] if quick else METHODS:
            with tempfile.TemporaryDirectory() as cache:
                cold, warm = (processes.call("manifolds", str(i), name, str(steps), cache=cache) for _ in range(2))
            own = [min(a, b) for a, b in zip(cold[1:3], warm[1:3], strict=True)]
            rows.append([spaces[i].name, name, cold[0], warm[0], own[0], own[0] / own[1], *warm[3:]])
    text = (
        "A system with an energy and an entropy that are not quadratic, and the metric of the space projected off the "
        "energy, from its definition to the end of a run; then many steps, of which one state is kept. *Over R^d* is "
        "the time of a step over that of the same method, and of functions of the same form, on R^d with d the "
        "dimension of the space. The order is observed against SciPy's DOP853; where the error is rounding there is "
        "none."
    )
    caption = f"{steps:,} steps for the drift, in one thread; a point's residual at the end of them."
    worst = max(row[3] for row in rows)
    return Report(
        "Systems on manifolds without charts",
        text,
        [Table(caption, COLUMNS, rows)],
        [Target("first answer on a manifold, cached, the slowest", 4.0, worst, "seconds")],
    )


def child(number: str, name: str, steps: str) -> list:
    """First answer; the time of a step, there and on R^d; drift, residual and order."""
    space, method = list(mf.registered_spaces())[int(number)], METHODS[name]
    x0 = np.asarray(space.to_vector(space.random(3)))
    began = time.process_time()
    system = relaxing(space)
    lt.integrate(system, x0, (0.0, 1.0), 0.1, method)
    first = time.process_time() - began
    flat = mf.Euclidean(space.dim)
    plain = relaxing(flat)
    times = [_step(s, x, method) for s, x in ((system, x0), (plain, np.asarray(flat.random(3))))]
    count = int(steps)
    long = lt.integrate(system, x0, (0.0, 0.01 * count), 0.01, method, save_every=count)
    residual = float(space.residual(system.points(long.x[-1])))
    return [first, *times, long.audit().energy_drift, residual, _order(system, x0, method)]


def relaxing(space: mf.Space) -> lt.MetriplecticSystem:
    """Bounded functions without symmetries."""
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


def _step(system: lt.MetriplecticSystem, x0, method, steps: int = 20_000) -> float:
    """Seconds that a step takes, the best of several runs."""
    best = np.inf
    for _ in range(5):
        began = time.process_time()
        lt.integrate(system, x0, (0.0, 0.01 * steps), 0.01, method, save_every=steps)
        best = min(best, time.process_time() - began)
    return best / steps


def _order(system: lt.MetriplecticSystem, x0, method) -> float:
    field = jax.jit(lambda x: system.vector_field(x))
    exact = solve_ivp(lambda t, x: np.asarray(field(x)), (0.0, 1.0), x0, method="DOP853", rtol=1e-13, atol=1e-14)
    few, many = STEPS[method.order]
    ends = [lt.integrate(system, x0, (0.0, 1.0), 1.0 / n, method).x[-1] for n in (few, many)]
    errors = [np.abs(end - exact.y[:, -1]).max() for end in ends]
    return float(np.log(errors[0] / errors[1]) / np.log(many / few)) if errors[1] > 1e-13 else float("nan")
