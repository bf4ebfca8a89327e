"""Systems on spaces and groups of one's own, which the library has no formulas for."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.manifolds.spaces.test_own_spaces import HEISENBERG, Ellipsoid


def heisenberg_system():
    """Points [[1, a, c], [0, 1, b], [0, 0, 1]]; the left-invariant fields d/da and d/dc commute, and b is a Casimir."""
    bracket = np.zeros((9, 9))
    bracket[1, 2], bracket[2, 1] = 1.0, -1.0
    return lt.MetriplecticSystem(
        bracket,
        energy=lambda g: (g[0, 1] ** 2 + g[0, 2] ** 2) / 2 + g[0, 1] ** 4 / 4 + jnp.exp(g[1, 2]),
        entropy=lambda g: g[1, 2],
        dissipation=lt.ProjectedMetric(rate=0.3),
        space=HEISENBERG,
    )


def test_a_system_on_a_group_of_ones_own():
    """The group stands for its space, and the axioms hold at random elements of it."""
    system = heisenberg_system()
    assert system.space == mf.GroupSpace(HEISENBERG)
    assert system.check().passed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "retraction"),
    [
        (lt.MetriplecticGauss, "cayley"),
        (lt.MetriplecticGauss, None),
        (lt.MetriplecticMidpoint, None),
        (lt.MetriplecticMidpoint, "midpoint_cayley"),
    ],
)
def test_a_group_of_ones_own_keeps_the_laws(method, retraction):
    system = heisenberg_system()
    start = np.array([[1.0, 0.7, -0.4], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
    how = method(1, retraction=retraction) if method is lt.MetriplecticGauss else method(retraction=retraction)
    run = lt.integrate(system, start, (0.0, 2.0), 0.1, how, engine="array")
    assert run.audit().passed
    assert run.entropy[-1] > run.entropy[0] + 0.1
    assert bool(system.space.belongs(system.points(run.x), 1e-14).all())


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2)], ids=str)
def test_order_on_a_space_without_geodesics(method):
    """A spin on an ellipsoid, in the chart of the projection, against the same field integrated in R^3 by SciPy."""
    from scipy.integrate import solve_ivp

    space = Ellipsoid((1.0, 2.0, 3.0))
    squares = np.array([1.0, 4.0, 9.0])

    def cross(a):
        return jnp.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])

    system = lt.MetriplecticSystem(
        lambda x: cross(x / squares), lambda x: x[2] ** 2 + 0.3 * x[0] * x[1] + 0.1 * x[0] ** 4, space=space
    )
    start, T = np.asarray(space.project(np.ones(3))), 2.0

    def rate(_, x):
        dH = [0.3 * x[1] + 0.4 * x[0] ** 3, 0.3 * x[0], 2.0 * x[2]]
        return np.cross(x / squares, dH)

    wanted = solve_ivp(rate, (0.0, T), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    errors = []
    for n in (20, 40, 80):
        run = lt.integrate(system, start, (0.0, T), T / n, method, engine="array", save_every=n)
        assert run.audit().passed
        errors.append(np.abs(run.x[-1] - wanted).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - method.order) < 0.2).all(), errors
