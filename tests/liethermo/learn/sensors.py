"""Tables of sensors of real motions, made by SciPy's DOP853 from equations in coordinates, with noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.integrate

INERTIA = np.array([0.2, 1.0, 1.1])
"""Moments of inertia of a thrown book relative to the second one, about which its rotation is unstable."""

GYROSCOPE_NOISE = 1.0
"""Standard deviation of the errors of a gyroscope (deg/s)."""

GRAVITY = 9.81
"""Acceleration of gravity (m/s^2)."""

LENGTH = 0.4
"""Length of a pendulum (m)."""

MASS = 0.5
"""Mass of the pendulum (kg)."""

DAMPING = 0.006
"""Damping of its brake (N m s/rad)."""

CAPACITY = 3.0
"""Heat capacity of the brake (J/K)."""

ROOM_TEMPERATURE = 293.15
"""Initial temperature of the brake (K)."""

ANGLE_NOISE = 0.3
"""Standard deviation of the errors of an angle (deg)."""

TEMPERATURE_NOISE = 0.01
"""Standard deviation of the errors of a temperature (K)."""


def _solve(field, start, t):
    return scipy.integrate.solve_ivp(field, (0.0, t[-1]), start, "DOP853", t, rtol=1e-11, atol=1e-12).y.T


def irregular_times(end: float, number: int, random: np.random.Generator) -> np.ndarray:
    """Return times in (0, end), in order, to whole microseconds."""
    return np.unique(np.round(random.uniform(0.0, end, number), 6))


def euler_equations(t, omega):
    """Euler's equations of a free body in its principal axes."""
    a, b, c = INERTIA
    x, y, z = omega
    return [(b - c) / a * y * z, (c - a) / b * z * x, (a - b) / c * x * y]


def thrown_book(seed=0, start=(0.02, 9.0, 0.1), end=2.0, number=200, noise=GYROSCOPE_NOISE) -> dict[str, np.ndarray]:
    """Return times (ms) and readings of a gyroscope (deg/s)."""
    random = np.random.default_rng(seed)
    t = irregular_times(end, number, random)
    omega = np.degrees(_solve(euler_equations, start, t)) + noise * random.standard_normal((len(t), 3))
    return {"time [ms]": 1e3 * t} | {f"g{axis} [deg/s]": values for axis, values in zip("xyz", omega.T, strict=True)}


def pendulum_equations(t, state):
    """The damped pendulum, whose friction heats its brake."""
    angle, velocity, _temperature = state
    acceleration = -GRAVITY / LENGTH * np.sin(angle) - DAMPING / (MASS * LENGTH**2) * velocity
    return [velocity, acceleration, DAMPING * velocity**2 / CAPACITY]


def warm_pendulum(seed=0) -> dict[str, np.ndarray]:
    """Return times (s), angles (deg) and temperatures (degC); nine of ten temperatures are missing."""
    random = np.random.default_rng(seed)
    t = irregular_times(20.0, 300, random)
    state = _solve(pendulum_equations, (1.2, 0.0, ROOM_TEMPERATURE), t)
    angle = np.degrees(state[:, 0]) + ANGLE_NOISE * random.standard_normal(len(t))
    temperature = state[:, 2] - 273.15 + TEMPERATURE_NOISE * random.standard_normal(len(t))
    temperature[np.arange(len(t)) % 10 != 0] = np.nan
    return {"t [s]": t, "angle [deg]": angle, "temperature [degC]": temperature}


def write_csv(path: Path, table: dict[str, np.ndarray]) -> Path:
    """Write a table with a line of names; missing values are empty."""
    rows = np.column_stack(list(table.values()))
    lines = [",".join("" if np.isnan(value) else f"{value:.6f}" for value in row) for row in rows]
    path.write_text("\n".join([",".join(table), *lines]))
    return path
