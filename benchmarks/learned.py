"""Learned systems: two problems of the field, solved by ``lt.learn`` and by our own GFINN and NMS."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.integrate

import liethermo as lt
import manifolds as mf
from liethermo.learn.data import Trajectory, compute_data_scales

from . import learned_peers
from .report import Report, Table

LEARNING_RATE = 3e-3
"""Learning rate of every contestant."""

LONG_RUN_FACTOR = 100
"""Duration of the run in which the laws are followed, in durations of the data."""


class Problem(NamedTuple):
    """Data of a motion, made by SciPy at a tolerance of 1e-10, and prior knowledge of it."""

    title: str
    text: str
    vector_field: Callable
    random_state: Callable[[np.random.Generator], np.ndarray]
    step: float
    steps: int
    poisson: mf.PoissonStructure
    entropy: Callable
    t_end: float = 8.0
    n_trajectories: int = 100
    n_seeds: int = 3


def _gas_field(t, x):
    q, p, *s = x
    E1, E2 = (np.exp(s[0]) / q) ** (2 / 3), (np.exp(s[1]) / (2 - q)) ** (2 / 3)
    heat = 22.5 * (1 / E1 - 1 / E2)
    return [p, 2 / 3 * (E1 / q - E2 / (2 - q)), heat / E1, -heat / E2]


def _pendulum_field(t, x):
    """Two springs with the energy ``(ln l)^2 / 2 + ln l + exp(S - ln l) - 1`` of their length l and entropy S.

    Unit masses; heat goes from one spring to the other with a conductance of 1/2.
    """
    q1, q2, p1, p2, s = x[:2], x[2:4], x[4:6], x[6:8], x[8:]
    r1, r2 = q1, q2 - q1
    l1, l2 = np.linalg.norm(r1), np.linalg.norm(r2)
    T1, T2 = np.exp(s[0]) / l1, np.exp(s[1]) / l2
    f1, f2 = ((np.log(l) + 1 - T) / l * r / l for l, T, r in ((l1, T1, r1), (l2, T2, r2)))
    return [*p1, *p2, *(f2 - f1), *(-f2), 0.5 * (T2 - T1) / T1, 0.5 * (T1 - T2) / T2]


PROBLEMS = {
    "gas": Problem(
        "two gas containers",
        "The problem is that of the published code of GFINN. A few trajectories that start near the walls, which are "
        "rare in the data, dominate the means. Beyond T, models with more prior knowledge are less accurate than NMS. "
        "Their training ends at a ten times larger loss, and wider networks do not help. The long forecast lasts "
        f"{LONG_RUN_FACTOR} T.",
        _gas_field,
        lambda r: np.array([1.0, 0.0, 2.0, 2.0]) + r.uniform(-1.0, 1.0, 4) * [0.8, 1.0, 1.0, 1.0],
        0.02,
        8000,
        lt.learn.Poisson.canonical(1, 4),
        lambda x: x[2] + x[3],
    ),
    "pendulum": Problem(
        "thermoelastic double pendulum",
        "The parameters of the pendulum are our own. To T, GFINN is about as accurate as `lt.learn`. Beyond T, models "
        "with more prior knowledge are less accurate than both peers. Their training ends at a twenty times larger "
        f"loss. The long forecast lasts {LONG_RUN_FACTOR} T.",
        _pendulum_field,
        lambda r: np.array([1.0, 0.0, 2.1, 0.0, 0.0, 0.5, 0.0, 1.0, 0.2, 0.4]) + r.uniform(-0.2, 0.2, 10),
        0.05,
        4000,
        lt.learn.Poisson.canonical(4, 10),
        lambda x: x[8] + x[9],
    ),
}
"""The two problems, by name."""


def simulate_data(problem: Problem, is_quick: bool, seed: int = 0) -> np.ndarray:
    """Simulate trajectories of a problem to twice the training time; return states, shape (trajectories, times, n)."""
    random, runs = np.random.default_rng(seed), []
    times = np.arange(round(2 * problem.t_end / problem.step) + 1) * problem.step
    for _ in range(5 if is_quick else problem.n_trajectories):
        x0 = problem.random_state(random)
        solution = scipy.integrate.solve_ivp(
            problem.vector_field, (0, times[-1]), x0, "LSODA", times, rtol=1e-10, atol=1e-10
        )
        runs.append(solution.y.T)
    return np.stack(runs)


def _forecast_errors(states: np.ndarray, exact_states: np.ndarray) -> list[float]:
    """Return the mean squares and mean magnitudes of forecast errors, within the training time and after it."""
    half = (exact_states.shape[1] + 1) // 2
    error_parts = [states[:, :half] - exact_states[:, :half], states[:, half:] - exact_states[:, half:]]
    return [
        float(average(errors))
        for average in (lambda e: np.mean(e**2), lambda e: np.mean(np.abs(e)))
        for errors in error_parts
    ]


def _law_errors(energy: np.ndarray, entropy: np.ndarray, energy_spread: float) -> list[float]:
    """Return the drift of a learned energy relative to its spread over the test states, and the least entropy
    increment."""
    return [float(np.max(np.abs(energy - energy[0])) / energy_spread), float(np.diff(entropy).min())]


def compare_models(problem: Problem, is_quick: bool) -> list[list]:
    """Return a row for each contestant, averaged over the seeds of weights and batches; for the laws the worst."""
    x = simulate_data(problem, is_quick)
    count = max(1, len(x) // 5)
    half = round(problem.t_end / problem.step) + 1
    test, train = x[:count], [Trajectory(np.arange(half) * problem.step, states[:half]) for states in x[count:]]
    scales = compute_data_scales(train)
    steps, width, seeds = (50, 8, 1) if is_quick else (problem.steps, 32, problem.n_seeds)
    long_steps = round((2 if is_quick else LONG_RUN_FACTOR) * problem.t_end / problem.step)
    rows = []

    def add_library_model(build: Callable[[int], Any], name: str) -> None:
        def measure_seed(seed: int) -> list[float]:
            start = time.process_time()
            pairs = [tuple(trajectory) for trajectory in train]
            model = lt.learn.fit(
                build(seed),
                pairs,
                matching=steps,
                shooting=0,
                rate=LEARNING_RATE,
                validation=0.0,
                seed=seed,
                progress=False,
            )
            training_seconds = time.process_time() - start
            method = lt.MetriplecticRungeKutta(4)
            end = (x.shape[1] - 1) * problem.step
            states = lt.ensemble(model, test[:, 0], (0.0, end), problem.step, method, outputs="trajectory").x
            assert states is not None
            run = lt.integrate(model, test[0, 0], (0.0, long_steps * problem.step), problem.step, method)
            assert run.entropy is not None
            laws = _law_errors(run.energy, run.entropy, float(np.std(model.energy(test))))
            return [model.training.parameters, *_forecast_errors(states, test), *laws, training_seconds]

        add_row(name, [measure_seed(seed) for seed in range(seeds)])

    def add_peer_model(build: Callable[[int], learned_peers.PeerModel], name: str) -> None:
        def measure_seed(seed: int) -> list[float]:
            start = time.process_time()
            peer = learned_peers.train(build(seed), train, scales, steps, LEARNING_RATE, seed)
            training_seconds = time.process_time() - start
            states, laws = learned_peers.forecast(peer, test[:, 0], scales, problem.step, x.shape[1] - 1)
            run, _ = learned_peers.forecast(peer, test[:1, 0], scales, problem.step, long_steps)
            energy_spread = float(np.std(laws(test.reshape(-1, x.shape[2]))[0]))
            parameters = sum(leaf.size for leaf in jax.tree_util.tree_leaves(peer))
            energy, entropy = laws(run[0])
            return [
                parameters,
                *_forecast_errors(states, test),
                *_law_errors(energy, entropy, energy_spread),
                training_seconds,
            ]

        add_row(name, [measure_seed(seed) for seed in range(seeds)])

    def add_row(name: str, results: list[list[float]]) -> None:
        n_parameters, *errors, drift, increment, training_seconds = np.transpose(results)
        means = [float(np.mean(values)) for values in errors]
        rows.append(
            [
                name,
                int(n_parameters[0]),
                *means,
                float(drift.max()),
                float(increment.min()),
                float(training_seconds.mean()),
            ]
        )
        print(rows[-1], flush=True)

    known_parts: dict[str, Any]
    n, known_parts = x.shape[2], {"poisson": problem.poisson, "entropy": problem.entropy}
    add_library_model(lambda seed: lt.learn.Metriplectic(n, width=width, seed=seed), "`lt.learn`, nothing known")
    for construction in ("skew", "projected"):

        def build(seed: int, construction=construction) -> Any:
            friction = lt.learn.Friction(n, 1, construction, width=width, seed=4 * seed + 3)
            return lt.learn.Metriplectic(n, **known_parts, friction=friction, width=width, seed=seed)

        add_library_model(build, f"`lt.learn`, Π and S known, {construction}")
    add_peer_model(lambda seed: learned_peers.NMS(n, width, 2, seed, 1), "NMS, nothing known")
    add_peer_model(lambda seed: learned_peers.GFINN(n, width, 2, seed), "GFINN, nothing known")
    return rows


def problem_report(name: str, is_quick: bool) -> Report:
    """Compare the models on a problem, given by name, and return the report."""
    p = PROBLEMS[name]
    columns = {"Model": "text", "Parameters": "count", "MSE to T": "error", "T to 2 T": "error", "MAE to T": "error"}
    columns |= {"MAE, T to 2 T": "error", "Energy drift": "error", "Least entropy increment": "error"}
    columns |= {"Training": "seconds"}
    caption = (
        f"The data are {p.n_trajectories} trajectories to T = {p.t_end:g}, a fifth of them for the test. Training has "
        f"{p.steps} steps of 256 points. The table has means over {p.n_seeds} seed{'s' if p.n_seeds > 1 else ''}."
    )
    return Report(f"Learned: {p.title}", p.text, [Table(caption, columns, compare_models(p, is_quick))])
