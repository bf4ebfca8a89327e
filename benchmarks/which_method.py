"""Work against precision of the methods on four problems: the figure of the page on choosing a method.

``python -m benchmarks.which_method`` writes ``docs/howto/which_method.svg``. Work is counted in evaluations of the
vector field in a run, stages times iterations, so that it is the same on every machine; precision is the largest error
at the end of a hundred runs against collocation of order 12.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np

import liethermo as lt
import manifolds as mf

FIGURE_PATH = Path(__file__).resolve().parent.parent / "docs" / "howto" / "which_method.svg"
"""Path of the figure."""
STEP_SIZES = tuple(0.8 / 2**k for k in range(7))
"""Step sizes of each method."""
N_RUNS = 100
"""Number of runs whose largest error counts."""


@dataclass(frozen=True)
class Problem:
    """A system, its initial state, and the duration of the runs."""

    title: str
    build_system: Callable[[], lt.System]
    initial_state: tuple[float, ...]
    t_end: float
    reference_step: float  # of the reference


def _rigid_body_problem() -> lt.System:
    return lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)


def _four_dimensional_body_problem() -> lt.System:
    g = mf.so(4)
    inertia = jnp.array([1.0, 1.5, 2.0, 2.5, 3.0, 3.5])
    return lt.LiePoissonSystem(
        g,
        lambda mu: 0.5 * jnp.sum(mu**2 / inertia) + 0.02 * jnp.sum(mu**4),
        lt.Quadratic(np.ones(6)),
        lt.ProjectedMetric(rate=0.1),
    )


def _oscillator_problem() -> lt.System:
    return lt.EvolutionSystem(
        lt.Kinetic([1.0]) + lt.Potential(lambda q, S: 0.5 * q @ q + 0.1 * jnp.sum(q**4) + jnp.exp(S / 2.0)), dim=3
    )


def _stiff_exchange_problem() -> lt.System:
    def block_energy(x):
        return 0.5 * x[1] ** 2 + jnp.exp(x[2])

    return lt.ComposedSystem(
        {
            "block": lt.Subsystem(block_energy, 3, friction=0.3),
            "bed": lt.Subsystem(lambda x: 2.0 * jnp.exp(x[0] / 2.0), 1),
        },
        coupling=lambda q: 0.5 * jnp.sum(q**2),
        conductance=400.0,
    )


PROBLEMS = (
    Problem("relaxing body, so(3)", _rigid_body_problem, (0.06, 0.1, 1.0), 40.0, 0.05),
    Problem(
        "body in four dimensions, so(4)", _four_dimensional_body_problem, (0.9, 0.3, -0.5, 0.2, 0.6, -0.4), 20.0, 0.05
    ),
    Problem("oscillator and its heat", _oscillator_problem, (1.0, 0.0, -2.0), 20.0, 0.05),
    Problem("stiff exchange of heat", _stiff_exchange_problem, (2.0, 0.0, 0.4, 0.0), 10.0, 0.002),
)
"""The four problems."""

METHODS = (
    lt.MetriplecticRungeKutta(4),
    lt.MetriplecticRungeKutta(6),
    lt.MetriplecticRungeKutta(8),
    lt.MetriplecticGauss(1),
    lt.MetriplecticGauss(2),
    lt.MetriplecticGauss(3),
)
"""The methods that are compared."""


def measure_methods(problem: Problem) -> dict[str, list[tuple[float, float]]]:
    """Return points (error, evaluations) for each method, without step sizes that fail."""
    system, span = problem.build_system(), (0.0, problem.t_end)
    states = np.array(problem.initial_state) * (
        1.0 + 0.1 * np.random.default_rng(0).standard_normal((N_RUNS, system.dim))
    )
    exact = lt.ensemble(system, states, span, problem.reference_step, lt.MetriplecticGauss(6), progress=False).x
    assert exact is not None  # final states are kept
    points: dict[str, list[tuple[float, float]]] = {str(method): [] for method in METHODS}
    for method in METHODS:
        for step in STEP_SIZES:
            result = lt.ensemble(system, states, span, step, method, progress=False)
            if result.ok.all():
                error = float(np.abs(np.asarray(result.x) - exact).max() / np.abs(exact).max())
                points[str(method)].append(
                    (max(error, 1e-15), float(result.iterations.mean()) * method.evaluations_per_iteration)
                )
    return points


def draw_figure(results: dict[str, dict[str, list[tuple[float, float]]]], path: Path) -> None:
    """Draw the curves, one frame for each problem."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with matplotlib.rc_context({"svg.hashsalt": "liethermo", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(2, 2, figsize=(8.4, 6.2), layout="constrained")
        for frame, (title, curves) in zip(axes.flat, results.items(), strict=True):
            for i, (name, points) in enumerate(curves.items()):
                if points:
                    explicit = name.startswith("MetriplecticRungeKutta")
                    style = {"marker": "o" if explicit else "s", "linestyle": "-" if explicit else "--"}
                    frame.loglog(
                        *np.transpose(points), color=f"C{i}", markersize=3.5, linewidth=1.2, label=name, **style
                    )
            frame.invert_xaxis()
            frame.set(title=title, xlabel="relative error at the end", ylabel="evaluations of the field")
            frame.grid(True, which="major", linewidth=0.4, alpha=0.5)
            frame.spines[["top", "right"]].set_visible(False)
        figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncol=3, frameon=False)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--figure", type=Path, default=FIGURE_PATH)
    arguments = parser.parse_args()
    results = {}
    for problem in PROBLEMS:
        results[problem.title] = measure_methods(problem)
        print(problem.title)
        for name, points in results[problem.title].items():
            print(f"  {name:<36}", "  ".join(f"{error:.0e}: {work:.3g}" for error, work in points))
    draw_figure(results, arguments.figure)


if __name__ == "__main__":
    main()
