"""Test problems for methods."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation.friction_operator import FrictionOperator
from ..dissipation.inner_product import KillingDissipation
from ..dissipation.lindblad import LindbladJumps
from ..dissipation.projected_metric import ProjectedMetric
from ..errors import InputError
from ..functions.energy import Quadratic
from ..integrators import OneStepMethod
from ..integrators.base import EVERY_SYSTEM
from ..systems import (
    EulerPoincareClosedSystem,
    LiePoissonSystem,
    MetriplecticSystem,
    QuantumSystem,
    SimpleClosedSystem,
    System,
)

Problem = tuple[System, object, float]
"""A system, its initial state and the duration of the run."""


def problems_for(method: OneStepMethod) -> dict[str, Problem]:
    """Return the test problems that a method accepts, by name."""
    if method.systems == EVERY_SYSTEM:
        return general_problems()
    problems = {
        name: problem
        for name, problem in (closed_system_problems() | density_matrix_problems()).items()
        if _accepts_system(method, problem[0])
    }
    if not problems:
        raise InputError(f"{method} is for {method.systems}, but no test problem is one. Give systems=...")
    return problems


def _accepts_system(method: OneStepMethod, system: System) -> bool:
    try:
        method.check(system)
    except InputError:
        return False
    return True


def closed_system_problems() -> dict[str, Problem]:
    """Return problems with special systems: mechanical with heat, isolated and driven, and a rigid body with heat."""

    def lagrangian(q, v, S):
        kinetic = 0.5 * (1.5 + jnp.sin(q[1])) * v[0] ** 2 + 0.6 * v[1] ** 2 + 0.05 * jnp.sum(v**4)
        return kinetic - 0.25 * jnp.sum(q**4) - 3.0 * jnp.exp(S / 4 + 0.1 * q[0])

    def friction(q, v, S):
        return -(0.2 + 0.1 * S**2) * v

    def driving_force(q, v, S, t):
        return jnp.array([0.3 * jnp.cos(t), -0.2 * q[0]])

    def reduced_lagrangian(xi, S):
        moments = jnp.array([3.0, 2.0, 1.0])
        return 0.5 * jnp.sum(moments * xi**2) + 0.05 * jnp.dot(xi, xi) ** 2 - jnp.exp(S)

    def braking(xi, S):
        return -0.1 * (1.0 + S**2) * xi

    start = [0.4, -0.3, 0.5, 0.8, 0.2]
    return {
        "mechanical": (SimpleClosedSystem(lagrangian, 5, friction=friction), start, 1.0),
        "driven": (SimpleClosedSystem(lagrangian, 5, friction, driving_force), start, 1.0),
        "body with heat": (
            EulerPoincareClosedSystem(mf.so(3), reduced_lagrangian, braking),
            [0.5, -0.3, 0.4, 0.1],
            1.0,
        ),
    }


def density_matrix_problems() -> dict[str, Problem]:
    """Return two open quantum systems: one of three levels with two jumps, and a driven qubit in its ground state."""
    lower, sx = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    H = np.array([[0.0, 0.3, 0.1j], [0.3, 0.8, 0.2], [-0.1j, 0.2, 1.5]])
    levels = QuantumSystem(H, LindbladJumps([(np.eye(3, k=1), 0.4), (np.diag([0.0, 1.0, -1.0]), 0.2)]))
    drive = [np.diag([0.0, 1.0]), [sx, lambda t: 0.6 * jnp.cos(1.3 * t)]]
    qubit = QuantumSystem(drive, LindbladJumps([(lower, lambda t: 0.3 + 0.2 * jnp.sin(t))]))
    return {
        "three levels": (levels, levels.state(np.diag([0.2, 0.3, 0.5])), 2.0),
        "driven qubit": (qubit, qubit.state([1.0, 0.0]), 2.0),
    }


def general_problems() -> dict[str, Problem]:
    """Return general problems: a relaxing body, a top with and without friction, and a damped oscillator in R^3."""
    moments = jnp.array([3.0, 2.0, 1.0])

    def body(m):
        return 0.5 * jnp.sum(m * m / moments) + 0.1 * jnp.cos(2.0 * m[0])

    def top(m):
        return 0.5 * jnp.sum(m[:3] ** 2 / moments) + 0.3 * jnp.sin(m[5]) + 0.1 * m[3] ** 2

    def oscillator(x):
        return 0.5 * x[1] ** 2 + 0.25 * x[0] ** 4 + x[2]

    def friction(x):
        v = jnp.array([0.0, 1.0, -x[1]])
        return 0.3 * jnp.outer(v, v)

    tensor = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return {
        "body": (
            LiePoissonSystem(mf.so(3), body, Quadratic(np.ones(3)), KillingDissipation(0.3)),
            [0.8, 0.5, 0.9],
            2.0,
        ),
        "top": (
            LiePoissonSystem(mf.se(3), top, None, None),
            [0.4, -0.2, 0.7, 0.5, 0.3, 0.6],
            1.0,
        ),
        "oscillator": (
            MetriplecticSystem(mf.PoissonTensor(tensor), oscillator, lambda x: x[2], FrictionOperator(friction), dim=3),
            [0.9, 0.3, 0.2],
            2.0,
        ),
        "relaxing top": (
            LiePoissonSystem(mf.se(3), top, _squared_force, ProjectedMetric(rate=0.2)),
            [0.4, -0.2, 0.7, 0.5, 0.3, 0.6],
            1.0,
        ),
    }


def _squared_force(m):
    return jnp.dot(m[3:], m[3:])
