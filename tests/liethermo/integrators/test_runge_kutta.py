"""Explicit Runge-Kutta steps: tableaus, orders, and controls."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.step import initial_run_state, take_step
from liethermo.integrators.tableaus import (
    LOBATTO_ORDERS,
    ErrorEstimate,
    ExplicitTableau,
    explicit_lobatto_tableau,
    rooted_tree_vectors,
)
from tests.liethermo.integrators.test_orders import NONLINEAR

RK = lt.MetriplecticRungeKutta
EPS = float(np.finfo(np.float64).eps)
BODY = lt.models.rigid_body((5.0, 4.0, 2.0), rate=0.5)
X0 = np.array([0.2, 1.0, 0.3])
ORDERS = [4, 6, 8]


# -- tableaus ---------------------------------------------------------------------------------------------------------


def density(sizes_and_densities) -> tuple[int, float]:
    """Return nodes and density of a rooted tree from those of its branches."""
    nodes = 1 + sum(n for n, _ in sizes_and_densities)
    return nodes, nodes * float(np.prod([g for _, g in sizes_and_densities]))


def rooted_trees(order: int):
    """Return all rooted trees by number of nodes, up to ``order``, as tuples of branches."""
    trees = {1: [()]}
    for n in range(2, order + 1):
        trees[n] = list({tuple(sorted(f)) for f in forests(trees, n - 1)})
    return trees


def forests(trees, nodes):
    if nodes == 0:
        yield ()
        return
    for branch_nodes in range(1, nodes + 1):
        for tree in trees[branch_nodes]:
            for rest in forests(trees, nodes - branch_nodes):
                yield (tree, *rest)


def tree_vector_and_density(A, tree):
    """Return the vector of a tree at the stages, its number of nodes and its density."""
    branches = [tree_vector_and_density(A, branch) for branch in tree]
    vector = np.ones(len(A))
    for v, _, _ in branches:
        vector = vector * (A @ v)
    return vector, *density([(n, g) for _, n, g in branches])


@pytest.mark.parametrize(("order", "stages"), [(4, 4), (6, 7), (8, 11)])
def test_order_conditions(order, stages):
    """All rooted trees meet the conditions [Hairer, Nørsett & Wanner 1993, II.2]; error weights vanish up to q."""
    tableau = explicit_lobatto_tableau(order)
    A, b, estimate, quadrature_estimate = tableau
    counts = [1, 1, 2, 4, 9, 20, 48, 115, 286]
    trees = rooted_trees(order)
    assert [len(trees[n]) for n in trees] == counts[:order]
    assert len(b) == stages
    assert (b >= 0.0).all()
    assert np.array_equal(A, np.tril(A, -1))
    for n, trees_of_n in trees.items():
        for tree in trees_of_n:
            vector, nodes, gamma = tree_vector_and_density(A, tree)
            assert nodes == n
            assert b @ vector == pytest.approx(1.0 / gamma, rel=1e-12)
            for d, q, _ in filter(None, (estimate, quadrature_estimate)):
                assert n > q or abs(d @ vector) < 1e-14
    for d, q, _ in filter(None, (estimate, quadrature_estimate)):
        assert max(abs(d @ v) for v in rooted_tree_vectors(A, q + 1)[q + 1]) > 1e-3


@pytest.mark.parametrize("order", LOBATTO_ORDERS)
def test_error_estimates_are_right_for_a_linear_equation_and_a_quadrature(order):
    """The local errors of x' = x and x' = exp(t), by the tableau in plain numbers, as h -> 0."""
    A, b, estimate, quadrature_estimate = explicit_lobatto_tableau(order)
    h = 0.5  # errors of order 8 are rounding for shorter steps
    linear, quadrature = np.linalg.solve(np.eye(len(b)) - h * A, np.ones(len(b))), np.exp(h * A.sum(axis=1))
    for slopes, (d, q, scale) in ((linear, estimate), (quadrature, quadrature_estimate or estimate)):
        error, length = abs(h * b @ slopes - np.expm1(h)), np.expm1(h)
        size = scale * length * (h * abs(d @ slopes) / length) ** (order / q)
        assert 0.3 < size / error < (30.0 if d is estimate.weights and slopes is quadrature else 3.0)


@pytest.mark.sampled("4")
@pytest.mark.parametrize("order", ORDERS)
def test_the_estimate_is_right_for_a_linear_oscillation(order):
    """The error of a step of a rotation is along the circle, where no correction changes it."""
    system = lt.MetriplecticSystem(mf.Canonical(1), lt.Quadratic(np.eye(2)))
    method = RK(order).on(system)
    state = initial_run_state(system, method, jnp.array([1.0, 0.0]))
    relative_errors = []
    for h in {4: (0.2, 0.1, 0.05), 6: (0.2, 0.1, 0.05), 8: (0.4, 0.2, 0.1)}[order]:
        new = take_step(system, method, state, h)
        true_error = np.linalg.norm(np.asarray(new.x) - [np.cos(h), -np.sin(h)])
        relative_errors.append(float(method.error(system, state.x, state.compensation, h, new.k)) / true_error - 1.0)
    assert 0.0 < relative_errors[2] < 0.01
    assert 3.0 < relative_errors[1] / relative_errors[2] < 5.0


# -- orders -----------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", NONLINEAR)
def test_observed_order(name, order):
    system, x0 = NONLINEAR[name]
    x0 = 1.5 * x0
    exact = lt.integrate(system, x0, (0.0, 4.0), 4.0, lt.Reference(rtol=3e-14)).x[-1]
    steps = np.array({4: [48, 72, 108, 160], 6: [24, 32, 42, 56], 8: [18, 23, 29, 37]}[order])
    runs = [lt.integrate(system, x0, (0.0, 4.0), 4.0 / n, RK(order)) for n in steps]
    errors = np.array([np.abs(run.x[-1] - exact).max() for run in runs])
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert (errors > 1e-12).all(), errors
    assert abs(slope - order) < 0.1 * order, (errors, slope)
    for run in runs:
        assert run.audit(energy=2e-15 * 10).passed


# -- controls ---------------------------------------------------------------------------------------------------------


class NegativeWeight(RK):
    """Control of order two, with the weights -3 and 4, whose step is far off and takes more corrections."""

    max_corrections: ClassVar[int] = 20

    @property
    def tableau(self):
        return ExplicitTableau(
            np.array([[0.0, 0.0], [1 / 8, 0.0]]),
            np.array([-3.0, 4.0]),
            ErrorEstimate(np.array([1.0, -1.0]), 1, 1.0),
            None,
        )


def heated_mass():
    """Return a mass whose friction heats a body: (q, p, S) without forces."""

    def friction(x):
        T = jnp.exp(x[2])
        direction = jnp.array([0.0, 1.0, -x[1] / T])
        return T * jnp.outer(direction, direction)

    energy = lambda x: 0.5 * x[1] ** 2 + jnp.exp(x[2])  # noqa: E731
    return lt.MetriplecticSystem(None, energy, lambda x: x[2], lt.FrictionOperator(friction), dim=3)


def test_a_negative_weight_breaks_the_second_law():
    """The friction has halved at an eighth of the step: the quadrature subtracts more entropy than it adds."""
    bad, good = (lt.integrate(heated_mass(), [0.0, 1.0, 0.0], (0.0, 0.8), 0.8, m) for m in (NegativeWeight(4), RK(4)))
    assert bad.stats.least_entropy_increment < -0.03
    assert not bad.audit().passed
    assert bad.audit().energy_drift <= 1e-15
    assert good.stats.least_entropy_increment > 0.1
    assert good.audit().passed


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [5, 2, 4.0, True, "4", None])
def test_invalid_orders(order):
    with pytest.raises(lt.errors.InputError, match="order must be 4, 6 or 8"):
        RK(order)


def test_bad_input():
    with pytest.raises(lt.errors.InputError, match="does not conserve"):
        lt.integrate(BODY, X0, (0.0, 1.0), 0.1, RK(4, preserve=lambda m: m[0]))
    with pytest.raises(lt.errors.InputError, match="below the rounding"):
        lt.integrate(BODY, X0, (0.0, 1.0), lt.Adaptive(1e-20), RK(4))
    with pytest.raises(lt.errors.InputError, match="sparse engine"):
        lt.integrate(BODY, X0, (0.0, 1.0), 0.1, RK(4), engine="sparse")
