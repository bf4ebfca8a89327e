"""Derivatives of flows: along trajectories, at equilibria, and of the implicit function that a step is."""

import decimal
from decimal import Decimal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import liethermo as lt
import manifolds as mf
from liethermo.runs.flow_derivatives import _inverse_or_nan
from tests.cases import covering
from tests.liethermo.integrators.test_convergence import METRIPLECTIC_METHODS, PROBLEMS, SYSTEMS

METHODS = [m for m in lt.registered_methods() if isinstance(m, METRIPLECTIC_METHODS)]


def methods_with(names) -> list:
    """Return methods with names of systems: each method, and each system with a method of each kind."""
    cases = [pytest.param(method, name, id=f"{method}-{name}") for name in names for method in METHODS]
    return covering(cases, lambda method, name: [(method.explicit, name), str(method)])


def jacobian_by_differences(f, x, size=2e-3):
    """The Jacobian of f by central differences of sixth order."""
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}

    def directional_derivative(v):
        return sum(w * (f(x + c * size * v) - f(x - c * size * v)) for c, w in weights.items()) / size

    return np.stack([directional_derivative(v) for v in np.eye(len(x))], axis=1)


# -- along trajectories ------------------------------------------------------------------------------------------------

UNCONSTRAINED_PROBLEMS = [
    name for name in PROBLEMS if name != "spin with a bath"
]  # its coordinates are bound to a sphere


@pytest.mark.slow
@pytest.mark.parametrize(("method", "name"), methods_with(UNCONSTRAINED_PROBLEMS))
def test_along_trajectories(method, name):
    """Both modes are the derivative of the discrete flow, as its differences show."""
    problem, system, h = PROBLEMS[name], SYSTEMS[name](), 0.1
    end = jax.jit(lambda x: lt.flow(system, x, (0.0, 3 * h), h, method))
    x = jnp.asarray(problem.start)
    derivative = jax.jit(jax.jacfwd(end))(x), jax.jit(jax.jacrev(end))(x)
    expected = jacobian_by_differences(lambda y: np.asarray(end(jnp.asarray(y))), np.asarray(problem.start))
    for jacobian in derivative:
        assert np.abs(jacobian - expected).max() < 2e-10 * max(1.0, np.abs(expected).max())


MOMENTS = tuple(map(Decimal, ("3", "2", "1")))
QUARTIC = Decimal("0.25")
RATE = Decimal("0.5")


def midpoint_step(x, h):
    """The midpoint scheme (BFM 4.5) of a body with a quartic energy and S = log(1 + |m|^2), written out in decimals.

    Gonzalez' discrete gradient (4.3), K of (2.2) with it in the kernel (4.6).
    """

    def energy(m):
        return sum(c * c / (2 * i) for c, i in zip(m, MOMENTS, strict=True)) + QUARTIC * m[0] ** 4

    def gradient(m):
        return np.array([c / i for c, i in zip(m, MOMENTS, strict=True)]) + np.array([4 * QUARTIC * m[0] ** 3, 0, 0])

    d, displacement_norm = np.array([Decimal(0)] * 3), Decimal(1)
    while displacement_norm > Decimal("1e-40"):
        z = x + d / 2
        dH, dS = gradient(z), 2 * z / (1 + z @ z)
        if d @ d > 0:
            dH = dH + (energy(x + d) - energy(x) - dH @ d) / (d @ d) * d
        new = h * (np.cross(z, dH) + RATE * ((dH @ dH) * dS - (dH @ dS) * dH))
        displacement_norm, d = max(abs(c) for c in new - d), new
    return x + d


@pytest.mark.slow
@pytest.mark.parametrize(
    "start", [pytest.param(("0.3", "1.0", "0.2"), id="moving"), pytest.param(("1.0", "0", "0"), id="at rest")]
)
def test_the_midpoint_scheme_in_eighty_digits(start):
    """Differences of a step written out in decimals have no rounding; at rest they go round the 0/0 as well."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda m: 0.5 * jnp.sum(m * m / jnp.array([3.0, 2.0, 1.0])) + 0.25 * m[0] ** 4,
        lambda m: jnp.log(1.0 + jnp.dot(m, m)),
        lt.ProjectedMetric(rate=0.5),
    )
    steps, h = 3, Decimal("0.125")

    def end(x):
        for _ in range(steps):
            x = midpoint_step(x, h)
        return x

    with decimal.localcontext(prec=80):
        x, size = np.array(list(map(Decimal, start))), Decimal("1e-12")
        units = [np.array([Decimal(int(i == j)) for j in range(3)]) for i in range(3)]
        expected = np.stack([(end(x + size * e) - end(x - size * e)) / (2 * size) for e in units], axis=1).astype(float)
        state = end(x).astype(float)
    flow = jax.jit(lambda y: lt.flow(system, y, (0.0, steps * float(h)), float(h), lt.MetriplecticMidpoint()))
    x = jnp.array(list(map(float, start)))
    assert np.abs(flow(x) - state).max() < 4e-16
    assert np.abs(jax.jit(jax.jacfwd(flow))(x) - expected).max() < 2e-14
    assert np.abs(jax.jit(jax.jacrev(flow))(x) - expected).max() < 2e-14
    assert np.abs(expected - np.eye(3)).max() > 0.1


# -- at equilibria -----------------------------------------------------------------------------------------------------


def _body():
    def energy(m):
        return 0.5 * jnp.sum(m * m / jnp.array([3.0, 2.0, 1.0])) + 0.1 * m[0] ** 4

    friction = lt.ProjectedMetric(rate=0.3)
    return lt.LiePoissonSystem(mf.so(3), energy, lambda m: jnp.log(1.0 + jnp.dot(m, m)), friction)


def _sleeping_top():
    """Spinning upright; no dissipation, no entropy, two Casimirs."""

    def energy(x):
        return 0.5 * jnp.sum(jnp.array([1.0, 0.8, 0.5]) * x[:3] ** 2) + x[5] + 0.3 * x[5] ** 3

    return lt.LiePoissonSystem(mf.se(3), energy)


def _pendulum():
    """At rest below, with friction that heats a bath: S is not quadratic, T = 1.3."""

    def energy(x):
        return 0.5 * x[1] ** 2 + 1.0 - jnp.cos(x[0]) + jnp.exp(x[2])

    def entropy(x):
        return x[2]

    def K(x):
        T = jnp.exp(x[2])
        e = jnp.array([0.0, 1.0, -x[1] / T])
        return 0.5 * T * jnp.outer(e, e)

    tensor = np.zeros((3, 3))
    tensor[0, 1], tensor[1, 0] = 1.0, -1.0
    return lt.MetriplecticSystem(tensor, energy, entropy, lt.FrictionOperator(K), dim=3)


def _lowered_body():
    def energy(m):
        return 0.5 * jnp.sum(m * m / jnp.array([3.0, 2.0, 1.0])) + 0.1 * m[0] ** 4 + 0.2 * m[0]

    return lt.LiePoissonSystem(mf.so(3), energy, dissipation=lt.DoubleBracket(rate=0.4))


def _two_bodies():
    """Heat between two bodies at one temperature."""
    return lt.MetriplecticSystem(
        None,
        lambda u: u[0] + u[1],
        lambda u: jnp.log(u[0]) + 2.0 * jnp.log(u[1]),
        lt.ProjectedMetric(normalized=True, rate=0.7),
        dim=2,
    )


EQUILIBRIA = {
    "a body about its axis": (_body, (1.0, 0.0, 0.0)),
    "a body about its middle axis": (_body, (0.0, 1.0, 0.0)),
    "a sleeping top": (_sleeping_top, (0.0, 0.0, 1.5, 0.0, 0.0, 1.0)),
    "a pendulum below": (_pendulum, (0.0, 0.0, np.log(1.3))),
    "a pendulum above": (_pendulum, (np.pi, 0.0, np.log(1.3))),
    "a body that was lowered": (_lowered_body, (-1.0, 0.0, 0.0)),
    "two bodies of one temperature": (_two_bodies, (1.0, 2.0)),
}


@pytest.mark.sampled("MetriplecticRungeKutta(order=4)-a body about its axis")
@pytest.mark.parametrize(("method", "name"), methods_with(EQUILIBRIA))
def test_at_equilibria(method, name):
    """The Jacobian is that of differences, and the exponential of the field's to the order of the method.

    Explicit steps have no derivative where gradients are dependent: what corrects them is of the order of the method,
    homogeneous of degree one in the distance from the equilibrium, and not linear. The Jacobian is that without it.
    """
    build, x = EQUILIBRIA[name]
    system, x, h = build(), jnp.asarray(x), 0.1
    assert np.abs(system.vector_field(x)).max() < 1e-15
    end = jax.jit(lambda y: lt.flow(system, y, (0.0, h), h, method))
    derivative = np.asarray(jax.jit(jax.jacfwd(end))(x))
    expected = jacobian_by_differences(lambda y: np.asarray(end(jnp.asarray(y))), np.asarray(x))
    assert np.abs(jax.jit(jax.jacrev(end))(x) - derivative).max() < 1e-12
    linear = np.asarray(jax.jit(jax.jacfwd(system.vector_field))(x))
    correction_error = 0.1 * (h * np.abs(linear).max()) ** (method.order + 1) if method.explicit else 0.0
    assert np.abs(derivative - expected).max() < 2e-9 + correction_error
    exact = scipy.linalg.expm(h * linear)
    assert np.abs(derivative - exact).max() < (2.0 * h * np.abs(linear).max()) ** (method.order + 1)
    assert np.abs(exact - np.eye(len(x))).max() > 0.01


IMPLICIT = [method for method in METHODS if not method.explicit]
P = jnp.array([0.7, 0.4])


def body(p):
    energy = lambda m: 0.5 * m[0] ** 2 / 3.0 + 0.25 * m[1] ** 2 + 0.5 * m[2] ** 2 + p[0] * m[0] ** 4  # noqa: E731
    return lt.LiePoissonSystem(mf.so(3), energy, lambda m: jnp.log(1.0 + p[1] * m @ m), lt.KillingDissipation(0.5))


def sphere_system(p):
    return lt.MetriplecticSystem(
        None,
        lambda x: p[0] * x[2] ** 3 + 0.5 * x[0] * x[1],
        lambda x: jnp.cos(p[1] * x[0]),
        lt.ProjectedMetric(rate=0.5),
        space=mf.Sphere(2),
    )


STARTS = {body: jnp.array([0.3, 1.0, 0.2]), sphere_system: jnp.array([0.6, 0.0, 0.8])}


def both_ways(function, order, y):
    """The derivative of a function outside of ``jax.jit``, and inside, where steps are not known when it is traced."""
    for _ in range(order):
        function = jax.jacfwd(function)
    return np.asarray(function(y)), np.asarray(jax.jit(function)(y))


@pytest.mark.slow
@pytest.mark.parametrize("build", STARTS, ids=lambda build: build.__name__)
@pytest.mark.parametrize("order", [1, 2])
def test_all_states_of_a_path(build, order):
    """By the first state and by parameters; the last step is shorter."""

    def path(y):
        return lt.flow(build(y[3:]), y[:3], (0.0, 0.55), 0.1, save_every=2)

    derivatives, expected = both_ways(path, order, jnp.concatenate([STARTS[build], P]))
    assert derivatives.shape == (5, 3) + order * (5,)  # at 0, 0.2, 0.4, 0.5 and 0.55
    assert np.abs(derivatives - expected).max() < 1e-12 * np.abs(expected).max()
    assert np.abs(expected[-1]).max(axis=0).min() > 1e-3 if order == 1 else np.abs(expected[-1]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("method", IMPLICIT, ids=str)
def test_every_method(method):
    """Alone by the parameters, then by the state: what does not move is no direction."""
    x = STARTS[body]
    for function, y in (
        (lambda p: lt.flow(body(p), x, (0.0, 0.2), 0.1, method), P),
        (lambda x: lt.flow(body(P), x, (0.0, 0.2), 0.1, method), x),
    ):
        derivatives, expected = both_ways(function, 1, y)
        assert np.abs(derivatives - expected).max() < 1e-12 * np.abs(expected).max()
        assert np.abs(expected).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("build", STARTS, ids=lambda build: build.__name__)
def test_the_third_derivative_is_the_difference_of_second_ones(build):
    """A test that knows no other way to take derivatives."""
    second, size = jax.jit(jax.hessian(lambda x: lt.flow(build(P), x, (0.0, 0.3), 0.1))), 1e-4
    third = jax.jacfwd(jax.jacfwd(jax.jacfwd(lambda x: lt.flow(build(P), x, (0.0, 0.3), 0.1))))(STARTS[build])
    x = STARTS[build]
    differences = np.stack([(second(x + size * e) - second(x - size * e)) / (2 * size) for e in np.eye(3)], axis=-1)
    assert np.abs(third - differences).max() < 1e-6 * np.abs(third).max()
    for axes in ((0, 1, 3, 2), (0, 3, 2, 1)):
        assert np.array_equal(third, np.transpose(third, axes))


@pytest.mark.slow
def test_a_step_that_fails_has_no_derivative():
    """NaN, as the state is, from there on."""
    long_step_path = lambda x: lt.flow(body(P), x, (0.0, 300.0), 100.0, save_every=1)  # noqa: E731
    x = 10.0 * STARTS[body]
    state, derivative = np.asarray(long_step_path(x)), np.asarray(jax.jacfwd(long_step_path)(x))
    assert np.isnan(state[1:]).all()
    assert np.isnan(derivative[1:]).all()
    assert np.array_equal(derivative[0], np.eye(3))


def test_equations_without_an_inverse():
    matrices = np.stack([np.eye(2), np.ones((2, 2)), np.diag([2.0, 4.0])])
    inverse = _inverse_or_nan(matrices)
    assert np.isnan(inverse[1]).all()
    assert np.array_equal(inverse[[0, 2]], [np.eye(2), np.diag([0.5, 0.25])])
