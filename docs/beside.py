"""The picture of the first page: one run by this library and by others, and what becomes of the laws in it."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

INERTIA, START, RATE, END, STEP = (3.0, 2.0, 1.0), (0.06, 0.1, 1.0), 0.02, 2000.0, 0.25
TOLERANCE, TIMES = 1e-6, 401
"""What the others are asked for, and the number of times at which a run is looked at."""

COLOURS = {"SciPy DOP853": "#d55e00", "diffrax Dopri8": "#009e73", "heyoka": "#cc79a7", "liethermo": "#0072b2"}
TITLES = ("Drift of the energy", "Entropy below its maximum", "Drift of the momentum in space")


def draw(path: Path) -> None:
    """Draw the picture."""
    import matplotlib.pyplot as plt

    t = np.linspace(0.0, END, TIMES)
    with plt.rc_context({"svg.hashsalt": "liethermo", "font.size": 9, "font.family": "sans-serif"}):
        figure, panels = plt.subplots(1, 3, figsize=(10.0, 3.1), sharey=True, layout="constrained")
        for name, found in errors().items():
            for axes, error in zip(panels, found, strict=True):
                width = 2.2 if name == "liethermo" else 1.3
                axes.semilogy(t, np.maximum(error, 1e-17), color=COLOURS[name], linewidth=width, label=name)
        for axes, title in zip(panels, TITLES, strict=True):
            axes.set_title(title, fontsize=10)
            axes.set_xlabel("time")
            axes.grid(True, linewidth=0.4, alpha=0.5)
            axes.spines[["top", "right"]].set_visible(False)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def draw_once(path: Path, made_by: str) -> None:
    """Draw the picture where it is missing, or where this file or what is named has made another one."""
    note, made_by = path.with_suffix(".txt"), f"{made_by}\n{Path(__file__).read_text()}"
    if not (path.is_file() and note.is_file() and note.read_text() == made_by):
        draw(path)
        note.write_text(made_by)


def errors() -> dict[str, np.ndarray]:
    """By solver, what the three panels show of a body with friction inside that tumbles to rest, shape (3, times).

    The states of the others are read at equal times. All numbers are relative: to the kinetic energy that turns to
    heat, to the entropy that is produced, to the momentum.
    """
    import liethermo as lt

    body, every = lt.models.tumbling_body(INERTIA, rate=RATE), round(END / STEP / (TIMES - 1))
    ours = lt.integrate(body, START, (0.0, END), STEP, lt.MetriplecticGauss(3), save_every=every)
    assert ours.attitude is not None
    found = {name: _of(run[:, :4], _turned(run)) for name, run in runs().items()}
    return found | {"liethermo": _of(ours.x, np.einsum("tij,tj->ti", np.asarray(ours.attitude), ours.x[:, :3]))}


def field(y, exp: Callable) -> list:
    """The momentum, the entropy of the heat and a quaternion, as a user of another solver would write them down."""
    m, s, q = y[:3], y[3], y[4:]
    xi = [a / b for a, b in zip(m, INERTIA, strict=True)]
    turning = _cross(m, xi)
    w = [a + RATE * b for a, b in zip(xi, turning, strict=True)]
    spin = _cross(q[1:], w)
    return [
        *_cross(m, w),
        RATE * sum(a * a for a in turning) * exp(-s),
        -0.5 * sum(a * b for a, b in zip(q[1:], w, strict=True)),
        *(0.5 * (q[0] * a + b) for a, b in zip(w, spin, strict=True)),
    ]


def _cross(a, b) -> list:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _of(x: np.ndarray, in_space: np.ndarray) -> np.ndarray:
    kinetic, heat = 0.5 * np.sum(x[:, :3] ** 2 / np.array(INERTIA), axis=1), np.expm1(x[:, 3])
    rest = kinetic[0] - 0.5 * np.sum(x[0, :3] ** 2) / max(INERTIA)  # of which all becomes heat
    greatest = math.log1p(rest)
    energy = np.abs(kinetic + heat - kinetic[0] - heat[0]) / rest
    momentum = np.linalg.norm(in_space - in_space[0], axis=1) / np.linalg.norm(in_space[0])
    return np.array(
        [np.maximum.accumulate(energy), np.abs(greatest - x[:, 3]) / greatest, np.maximum.accumulate(momentum)]
    )


def _turned(run: np.ndarray) -> np.ndarray:
    """The momentum in space, by quaternions made of length one."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(run[:, 4:], scalar_first=True).apply(run[:, :3])


def runs() -> dict[str, np.ndarray]:
    """The states of the solvers that are installed, shape (times, 8)."""
    y0, times = np.array([*START, 0.0, 1.0, 0.0, 0.0, 0.0]), np.linspace(0.0, END, TIMES)
    solvers = {"diffrax Dopri8": ("diffrax", _diffrax), "heyoka": ("heyoka", _heyoka)}
    there = {name: solve for name, (package, solve) in solvers.items() if importlib.util.find_spec(package)}
    return {name: solve(y0, times) for name, solve in ({"SciPy DOP853": _scipy} | there).items()}


def _scipy(y0: np.ndarray, times: np.ndarray) -> np.ndarray:
    from scipy.integrate import solve_ivp

    span = (0.0, END)
    return solve_ivp(lambda t, y: field(y, math.exp), span, y0, "DOP853", times, rtol=TOLERANCE, atol=TOLERANCE).y.T


def _diffrax(y0: np.ndarray, times: np.ndarray) -> np.ndarray:
    import diffrax
    import jax.numpy as jnp

    found = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: jnp.stack(field(y, jnp.exp))),
        diffrax.Dopri8(),
        0.0,
        END,
        None,
        jnp.asarray(y0),
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=1_000_000,
    )
    return np.array(found.ys)


def _heyoka(y0: np.ndarray, times: np.ndarray) -> np.ndarray:
    import heyoka

    variables = heyoka.make_vars(*(f"y{i}" for i in range(len(y0))))
    equations = list(zip(variables, field(variables, heyoka.exp), strict=True))
    return heyoka.taylor_adaptive(equations, y0, tol=TOLERANCE).propagate_grid(times)[-1]
