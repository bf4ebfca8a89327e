"""Every method, with every option, converges to a solution that an independent program computed.

The vector fields are written out by hand in NumPy and integrated by SciPy's DOP853 at 1e-13, so neither the library's
brackets nor its gradients take part. A method that obeys every law and follows another flow fails here, as one did that
held a momentum map.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from tests.cases import covering

CANONICAL = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])


@dataclass(frozen=True)
class Problem:
    """A system, its vector field by hand, its start and duration, and its conserved functions beside H."""

    build: Callable[[], lt.systems.System]
    field: Callable[[np.ndarray], np.ndarray]
    start: tuple[float, ...]
    time: float
    kept: dict[str, Callable]
    """Casimirs that every Gauss method holds, and momentum maps that it holds on request, by those names."""

    @functools.cached_property
    def end(self) -> np.ndarray:
        solution = solve_ivp(
            lambda _, x: self.field(x), (0.0, self.time), self.start, method="DOP853", rtol=1e-13, atol=1e-15
        )
        assert solution.success
        return solution.y[:, -1]


# -- the problems ------------------------------------------------------------------------------------------------------


def angular_momentum(x):
    return x[0] * x[3] - x[1] * x[2]


def _central():
    def energy(x):
        return 0.5 * jnp.dot(x, x) + 0.25 * (x[0] ** 2 + x[1] ** 2) ** 2

    return lt.MetriplecticSystem(CANONICAL, energy, momentum_maps={"J": angular_momentum})


def _central_field(x):
    q, p = x[:2], x[2:]
    return np.concatenate([p, -(1.0 + q @ q) * q])


MOMENTS = np.array([1.0, 1.0, 0.5])
FIELD_CUBIC = 0.3


def _top():
    """A symmetric heavy top in a field that is not uniform: the body's third momentum is a momentum map."""

    def energy(x):
        return 0.5 * jnp.sum(MOMENTS * x[:3] ** 2) + x[5] + FIELD_CUBIC * x[5] ** 3

    return lt.LiePoissonSystem(mf.se(3), energy, momentum_maps={"third": lambda x: x[2]})


def _top_field(x):
    m, p = x[:3], x[3:]
    w, v = MOMENTS * m, np.array([0.0, 0.0, 1.0 + 3.0 * FIELD_CUBIC * p[2] ** 2])
    return np.concatenate([np.cross(m, w) + np.cross(p, v), np.cross(p, w)])


AXES = np.array([1.0, 0.8, 0.5])


def _length(x):
    return jnp.dot(x[3:], x[3:])


def _warm_top(parts: int = 1):
    """A top with friction that conserves |p|^2, from an entropy that is not quadratic."""

    def energy(x):
        return 0.5 * jnp.sum(AXES * x[:3] ** 2) + x[5] + 0.1 * x[0] ** 4

    friction = lt.ProjectedMetric(preserve=(_length,), normalized=True, rate=0.2 / parts)
    total = functools.reduce(lambda a, b: a + b, [friction] * parts)
    return lt.LiePoissonSystem(mf.se(3), energy, lambda x: jnp.exp(0.5 * jnp.dot(x[:3], x[3:])), total)


def _warm_top_field(x):
    m, p = x[:3], x[3:]
    w = AXES * m + np.array([0.4 * m[0] ** 3, 0.0, 0.0])
    v = np.array([0.0, 0.0, 1.0])
    motion = np.concatenate([np.cross(m, w) + np.cross(p, v), np.cross(p, w)])
    frame = np.linalg.qr(np.array([np.concatenate([w, v]), np.concatenate([np.zeros(3), p])]).T)[0]
    dS = 0.5 * np.exp(0.5 * m @ p) * np.concatenate([p, m])
    return motion + 0.2 * (dS - frame @ (frame.T @ dS))


TARGET = 1.9
INERTIA = np.array([3.0, 2.0, 1.0])


def _chosen_casimir():
    """Relaxation to a chosen |m|^2, where grad S vanishes and the motion goes on."""

    def energy(m):
        return 0.5 * jnp.sum(m * m / INERTIA) + 0.1 * m[0] ** 4

    return lt.LiePoissonSystem(
        mf.so(3), energy, lambda m: -0.5 * (jnp.dot(m, m) - TARGET) ** 2, lt.ProjectedMetric(rate=1.0)
    )


def _chosen_casimir_field(m):
    w = m / INERTIA + np.array([0.4 * m[0] ** 3, 0.0, 0.0])
    dS = -2.0 * (m @ m - TARGET) * m
    return np.cross(m, w) + (w @ w) * dS - (w @ dS) * w


def _bianchi():
    """A system whose Casimir is no polynomial; it is known as the entropy alone."""

    def energy(m):
        return 0.5 * jnp.dot(m, m) + 0.1 * jnp.sin(m[0])

    return lt.LiePoissonSystem(
        mf.bianchi("V"), energy, lambda m: m[1] / m[2], lt.ProjectedMetric(rate=0.05), validate=False
    )


def _bianchi_field(m):
    dH = m + np.array([0.1 * np.cos(m[0]), 0.0, 0.0])
    constants = mf.bianchi("V").structure_constants
    motion = np.einsum("abc,a,c->b", constants, dH, m)
    dS = np.array([0.0, 1.0 / m[2], -m[1] / m[2] ** 2])
    return motion + 0.05 * ((dH @ dH) * dS - (dH @ dS) * dH)


def _double_bracket():
    def energy(m):
        return 0.5 * jnp.sum(m * m / INERTIA) + 0.1 * m[0] ** 4 + 0.2 * m[2]

    return lt.LiePoissonSystem(mf.so(3), energy, dissipation=lt.DoubleBracket(rate=0.4))


def _double_bracket_field(m):
    w = m / INERTIA + np.array([0.4 * m[0] ** 3, 0.0, 0.2])
    motion = np.cross(m, w)
    return motion + 0.4 * np.cross(m, motion)


MATRIX = np.array([[1.0, 0.3, 0.0], [0.3, 0.7, -0.2], [0.0, -0.2, 1.4]])


def _cometric():
    """A friction operator on R^3 with a constant Poisson tensor: an oscillator that heats a reservoir."""

    def energy(x):
        return 0.5 * (x[0] ** 2 + x[1] ** 2) + 0.1 * x[0] ** 4 + jnp.exp(x[2])

    tensor = np.zeros((3, 3))
    tensor[0, 1], tensor[1, 0] = 1.0, -1.0

    def K(x):  # friction of the momentum, whose work goes into x[2]
        T = jnp.exp(x[2])
        e = jnp.array([0.0, 1.0, -x[1] / T])
        return 0.5 * T * jnp.outer(e, e)

    return lt.MetriplecticSystem(tensor, energy, lambda x: x[2], lt.FrictionOperator(K), dim=3)


def _cometric_field(x):
    T = np.exp(x[2])
    return np.array([x[1], -x[0] - 0.4 * x[0] ** 3 - 0.5 * x[1], 0.5 * x[1] ** 2 / T])


FIELD = np.array([0.3, -0.2, 0.9])


def _spin():
    """One spin on its sphere, with a bath that takes the energy as heat; flat coordinates (s, U)."""
    space = mf.Sphere(2) * mf.Euclidean(1)

    def poisson(x):
        s = x[:3]
        hat = jnp.array([[0.0, -s[2], s[1]], [s[2], 0.0, -s[0]], [-s[1], s[0], 0.0]])
        return jnp.zeros((4, 4)).at[:3, :3].set(hat)

    def energy(x):
        s, U = space.split(x)
        return -jnp.dot(jnp.asarray(FIELD), s) - 0.4 * s[0] ** 2 + U[0]

    def entropy(x):
        return jnp.log(2.0 + space.split(x)[1][0])

    return lt.MetriplecticSystem(poisson, energy, entropy, lt.ProjectedMetric(normalized=True, rate=0.5), space=space)


def _spin_field(x):
    s, U = x[:3], x[3]
    g = -FIELD - np.array([0.8 * s[0], 0.0, 0.0])
    tangent = g - (g @ s) * s
    dH, dS = np.append(tangent, 1.0), np.array([0.0, 0.0, 0.0, 1.0 / (2.0 + U)])
    return np.append(np.cross(s, g), 0.0) + 0.5 * (dS - (dH @ dS) / (dH @ dH) * dH)


def _squared_casimir(x):
    return jnp.dot(x[:3], x[3:])


TOP_START = np.array([0.4, -0.3, 1.2, 0.3, 0.2, 0.9])
PROBLEMS = {
    "central potential": Problem(_central, _central_field, (1.0, 0.0, 0.2, 0.8), 3.0, {"J": angular_momentum}),
    "symmetric top": Problem(
        _top, _top_field, tuple(TOP_START), 2.0, {"third": lambda x: x[2], "length": _length, "area": _squared_casimir}
    ),
    "warm top": Problem(_warm_top, _warm_top_field, tuple(TOP_START), 2.0, {"length": _length}),
    "chosen Casimir": Problem(_chosen_casimir, _chosen_casimir_field, (0.8, 0.5, 1.2), 3.0, {}),
    "bianchi V": Problem(_bianchi, _bianchi_field, (0.3, 0.4, 1.5), 1.0, {}),
    "double bracket": Problem(
        _double_bracket, _double_bracket_field, (0.8, 0.5, 0.9), 2.0, {"C": lambda m: jnp.dot(m, m)}
    ),
    "heated oscillator": Problem(_cometric, _cometric_field, (1.0, 0.5, 0.1), 2.0, {}),
    "spin with a bath": Problem(_spin, _spin_field, (0.6, 0.0, 0.8, 0.0), 2.0, {}),
    "sum of frictions": Problem(lambda: _warm_top(2), _warm_top_field, tuple(TOP_START), 2.0, {"length": _length}),
}
SYSTEMS = {name: functools.cache(problem.build) for name, problem in PROBLEMS.items()}


# -- the methods, with every option ------------------------------------------------------------------------------------

STEPS = {1: (80, 160), 2: (40, 80), 4: (16, 32), 6: (10, 20), 8: (5, 10)}
"""Numbers of steps, by order, in the asymptotic regime and above rounding."""

FINER = {("spin with a bath", 6): (14, 28)}
"""Numbers of steps of single systems, whose order shows only in shorter steps: 5.1, 5.5, 5.7 as they shrink."""


METRIPLECTIC_METHODS = lt.MetriplecticGauss | lt.MetriplecticMidpoint | lt.MetriplecticRungeKutta
"""Classes of the methods for every system."""


def methods_for(name: str) -> list[lt.OneStepMethod]:
    """Return the methods that a problem is run with: all registered ones, and each option that applies."""
    methods = [m for m in lt.registered_methods() if isinstance(m, METRIPLECTIC_METHODS)]
    if name == "central potential":
        methods += [lt.MetriplecticGauss(s, preserve=angular_momentum) for s in (1, 2, 3)]
        methods += [lt.MetriplecticGauss(s, preserve=lambda x: jnp.sin(angular_momentum(x))) for s in (1, 2, 3)]
    if name == "symmetric top":
        methods += [lt.MetriplecticGauss(s, preserve=lambda x: jnp.exp(x[2])) for s in (1, 2)]
    if name == "warm top":
        methods += [lt.MetriplecticGauss(s, preserve=lambda x: jnp.exp(_length(x))) for s in (1, 2)]
    if name == "spin with a bath":
        methods += [lt.MetriplecticGauss(2, retraction="midpoint"), lt.MetriplecticMidpoint(retraction="exp")]
        methods += [lt.MetriplecticRungeKutta(6, retraction="projection")]
    return methods


def cases():
    for name in PROBLEMS:
        for i, method in enumerate(methods_for(name)):
            yield pytest.param(name, method, id=f"{name}-{method}-{i}")


def keys(name, method):
    """Every problem meets every class of methods, and every method the problems with friction and those without."""
    options = getattr(method, "functions", ()), getattr(method, "retraction", None)
    with_friction = name not in ("central potential", "symmetric top")
    return (name, type(method), *map(bool, options)), (str(method), with_friction)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("name", "method"), covering(cases(), keys))
def test_convergence(name, method):
    problem, system = PROBLEMS[name], SYSTEMS[name]()
    explicit = isinstance(method, lt.MetriplecticRungeKutta)
    n_coarse, n_fine = (
        (20, 40) if explicit and method.order == 4 else FINER.get((name, method.order), STEPS[method.order])
    )
    runs = [
        lt.integrate(
            system,
            problem.start,
            (0.0, problem.time),
            problem.time / n,
            method,
            save_every=n_fine,
            engine="compiled" if explicit else "array",
        )
        for n in (n_coarse, n_fine)
    ]
    errors = [float(np.abs(run.x[-1] - problem.end).max()) for run in runs]
    assert errors[1] > 1e-13, errors  # above the rounding of the reference
    assert np.log2(errors[0] / errors[1]) > method.order - (0.125 * method.order if explicit else 0.35), errors
    assert errors[1] < 5e-3, errors
    for run in runs:
        assert run.audit(energy=1e-13).energy_drift <= 1e-13 or system.energy_law != "conserved"
        if isinstance(method, lt.MetriplecticGauss) or explicit:
            preserves_on_request = explicit or method.functions
            invariants = [
                f for name, f in problem.kept.items() if name not in system.momentum_maps or preserves_on_request
            ]
            for invariant in invariants:
                values = np.asarray(jax.vmap(invariant)(run.x))
                assert np.abs(values - values[0]).max() <= 4e-15 * max(1.0, abs(values[0]))
