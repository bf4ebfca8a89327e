"""BFM: metriplectic Euler-Poincaré equations."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.optimize

import liethermo as lt
import manifolds as mf
from liethermo.tracing.interpret import evaluate_at_points

from . import Difference, Order, fields, largest_difference, order, relative_difference, row, solve_with_scipy

I = np.array([1.0, 2.0, 3.5])
G = np.array([[1.0, 0.2, 0.1], [0.2, 2.0, -0.3], [0.1, -0.3, 0.5]])
POINTS = np.random.default_rng(0).standard_normal((6, 3))
BALL = lt.Quadratic(np.ones(3))


def H(m):
    """Return an energy that is not quadratic, so that discrete gradients differ from gradients at the midpoint."""
    return 0.5 * jnp.sum(m * m / I) + 0.1 * jnp.sum(m**4)


def dH(m):
    return m / I + 0.4 * m**3


def energy(m):
    return float(0.5 * np.sum(m * m / I) + 0.1 * np.sum(m**4))


def friction(system) -> np.ndarray:
    return evaluate_at_points(_friction, system, POINTS)


def _friction(system, x):
    return system.friction_matrix(x)


def project_out(K, *kernel):
    """Return ``K - K D (D^T K D)^-1 D^T K``, D the vectors of the kernel."""
    D = np.stack(kernel, axis=1)
    return K - K @ D @ np.linalg.solve(D.T @ K @ D, D.T @ K)


@functools.cache
def relaxing():
    return lt.LiePoissonSystem(mf.so(3), H, BALL, lt.ProjectedMetric())


def relaxing_by_hand(t, m):
    w = dH(m)
    return np.cross(m, w) + (w @ w) * m - (w @ m) * w


@row("BFM", "(2.2)", "`ProjectedMetric`", "the formula")
def projected_metric():
    expected = [(w @ G @ w) * G - np.outer(G @ w, G @ w) for w in dH(POINTS)]
    return relative_difference(friction(lt.LiePoissonSystem(mf.so(3), H, BALL, lt.ProjectedMetric(G))), expected)


@row("BFM", "Remark 2.1", "`ProjectedMetric` with `preserve=`, normalised", "the formula")
def several_functions():
    L, weights = lt.Quadratic([1.0, 1.0, 0.0]), np.array([1.0, 1.0, 0.0])
    metric = lt.ProjectedMetric(G, preserve=(L,), normalized=True)
    expected = [project_out(G, dH(m), weights * m) for m in POINTS]
    return relative_difference(friction(lt.LiePoissonSystem(mf.so(3), H, BALL, metric)), expected)


@row("BFM", "§2.3", "`MetriplecticSystem`", "the formula")
def metriplectic():
    hat = lambda m: jnp.array([[0.0, -m[2], m[1]], [m[2], 0.0, -m[0]], [-m[1], m[0], 0.0]])  # noqa: E731
    system = lt.MetriplecticSystem(hat, H, BALL, lt.ProjectedMetric(G), dim=3)
    K = [(w @ G @ w) * G - np.outer(G @ w, G @ w) for w in dH(POINTS)]
    expected = [np.cross(m, dH(m)) + k @ m for m, k in zip(POINTS, K, strict=True)]
    return relative_difference(fields(system, POINTS), expected)


@row("BFM", "§2.4", "momentum maps in the kernel of K, in 200 steps", "their first value")
def momentum_maps():
    energy, spin_component = lt.Quadratic([1.0, 1.0, 0.5]), lambda m: m[2]
    metric = lt.ProjectedMetric(preserve=(spin_component,), rate=0.1)
    system = lt.LiePoissonSystem(
        mf.so(3), energy, lambda m: 0.25 * (m @ m) ** 2, metric, momentum_maps={"m3": spin_component}
    )
    run = lt.integrate(system, [0.3, 1.0, 0.7], (0.0, 20.0), 0.1)
    assert run.audit().passed
    assert np.ptp(run.entropy) > 1e-3 or np.ptp(run.x[:, 0]) > 0.1  # it moves
    return relative_difference(run.x[:, 2], np.full(len(run.x), 0.7))


@row("BFM", "(3.1), Example 3.1", "`LiePoissonSystem`, so(3) and se(3)", "cross product; constants")
def euler_poincare():
    free_system = lt.LiePoissonSystem(mf.so(3), H)
    g, weights = mf.se(3), np.linspace(1.0, 2.0, 6)
    points = np.random.default_rng(1).standard_normal((4, 6))
    euler_poincare_rates = [np.einsum("ijk,i,k->j", g.structure_constants, weights * m, m) for m in points]
    return largest_difference(
        relative_difference(fields(free_system, POINTS), [np.cross(m, dH(m)) for m in POINTS]),
        relative_difference(fields(lt.LiePoissonSystem(g, lt.Quadratic(weights)), points), euler_poincare_rates),
    )


@row("BFM", "(3.2)–(3.4)", "`EulerPoincareForce`", "cross product")
def forces():
    system = lt.LiePoissonSystem(
        mf.so(3), H, BALL, lt.EulerPoincareForce(lambda w: jnp.array([w[1], w[0] * w[2], 1.0])), validate=False
    )
    force = lambda w: np.array([w[1], w[0] * w[2], 1.0])  # noqa: E731
    return relative_difference(fields(system, POINTS), [np.cross(m + force(dH(m)), dH(m)) for m in POINTS])


@row("BFM", "(3.6), (3.7)", "`InnerProductDissipation`, se(3)", "structure constants")
def inner_products():
    g, weights = mf.se(3), np.linspace(1.0, 2.0, 6)
    root = np.random.default_rng(2).standard_normal((6, 6))
    C, K = np.asarray(g.structure_constants), root @ root.T
    S = lt.Quadratic(np.kron([[0.0, 0.0], [0.0, 1.0]], np.eye(3)))  # the length of the linear momentum
    system = lt.LiePoissonSystem(g, lt.Quadratic(weights), S, lt.InnerProductDissipation(K))
    points, expected = np.random.default_rng(1).standard_normal((4, 6)), []
    for m in points:
        xi, dS = weights * m, np.concatenate([np.zeros(3), m[3:]])
        F = K @ np.einsum("ijk,i,j->k", C, xi, dS)
        expected.append(np.einsum("ijk,i,k->j", C, xi, m + F))
    return relative_difference(fields(system, points), expected)


@row("BFM", "§3, the Killing form", "`KillingDissipation`, sl(3) by its Cartan involution", "traces of matrices")
def killing():
    g = mf.sl(3)
    basis = np.asarray(g.basis)
    form = np.array([[6.0 * np.trace(a @ b.T) for b in basis] for a in basis])  # -kappa(a, theta b), theta b = -b^T
    weights, m = np.linspace(1.0, 2.0, 8), np.random.default_rng(3).standard_normal(8)
    kappa = np.array([[6.0 * np.trace(a @ b) for b in basis] for a in basis])
    S, C = lt.Quadratic(np.linalg.inv(kappa)), np.asarray(g.structure_constants)
    system = lt.LiePoissonSystem(g, lt.Quadratic(weights), S, lt.KillingDissipation())
    dS = np.linalg.solve(kappa, m)
    F = form @ np.einsum("ijk,i,j->k", C, weights * m, dS)
    return relative_difference(fields(system, m), [np.einsum("ijk,i,k->j", C, weights * m, m + F)])


@row("BFM", "Remark 3.3", "`mf.trilinear_form`, su(3)", "traces of matrices")
def trilinear():
    g = mf.su(3)
    e = np.asarray(g.basis)
    brackets = e[:, None] @ e[None] - e[None] @ e[:, None]
    return relative_difference(mf.trilinear_form(g), 6.0 * np.einsum("aij,bdji->abd", e, brackets).real)


@row("BFM", "Example 3.2", "`models.rigid_body`", "the equations printed")
def rigid_body():
    inertia = np.array([10.0, 5.0, 1.0])
    expected = [np.cross(p, p / inertia) + (w @ w) * p - (w @ p) * w for p, w in ((p, p / inertia) for p in POINTS)]
    return relative_difference(fields(lt.models.rigid_body(), POINTS), expected)


@row("BFM", "Fig. 1", "the relaxed body, $\\lvert\\Pi\\rvert^2$ at its end", "$2 I_1 H$")
def figure_1():
    run = lt.integrate(lt.models.rigid_body(), [1.0, 1.0, 1.0], (0.0, 100.0), 0.1)
    assert run.audit().passed
    return relative_difference(run.x[-1] @ run.x[-1], [20.0 * 0.5 * (0.1 + 0.2 + 1.0)])


@row("BFM", "(4.1)–(4.4)", "`Gonzalez`, `MeanValue`, `CoordinateIncrement`", "quadrature; quotients")
def discrete_gradients():
    function = lt.Function(H)
    x, d = np.array([0.3, -0.7, 1.1]), np.array([0.4, 0.9, -0.5])
    middle = dH(x + 0.5 * d)
    gonzalez = middle + (energy(x + d) - energy(x) - middle @ d) / (d @ d) * d
    change_gradient = scipy.integrate.quad_vec(lambda s: dH(x + s * d), 0.0, 1.0, epsabs=1e-15, epsrel=1e-15)[0]
    corners = [x + np.where(np.arange(3) < i, d, 0.0) for i in range(4)]
    increments = np.diff([energy(corner) for corner in corners]) / d
    gradients = [kind(function, jnp.asarray(x), jnp.asarray(d)) for kind in (lt.Gonzalez(), lt.MeanValue())]
    increment_gradient = lt.CoordinateIncrement(symmetric=False)(function, jnp.asarray(x), jnp.asarray(d))
    return largest_difference(
        relative_difference(gradients[0], gonzalez),
        relative_difference(gradients[1], change_gradient),
        relative_difference(increment_gradient, increments),
    )


@row("BFM", "(4.5), (4.6)", "a step of `MetriplecticMidpoint`", "its equations by SciPy's root")
def midpoint_step():
    x, h = np.array([0.3, 1.0, -0.4]), 0.2

    def misfit(end):
        d, z = end - x, 0.5 * (x + end)
        w = dH(z) + (energy(end) - energy(x) - dH(z) @ d) / (d @ d) * d
        return x + h * (np.cross(z, w) + (w @ w) * z - (w @ z) * w) - end

    end = scipy.optimize.root(misfit, x + h * relaxing_by_hand(0.0, x), tol=1e-14).x
    return relative_difference(lt.integrate(relaxing(), x, (0.0, h), h).x[-1], end)


@row("BFM", "(4.5), its order", "`MetriplecticMidpoint`", "SciPy at $10^{-13}$")
def midpoint_order() -> Order:
    x0 = np.array([0.3, 1.0, -0.4])
    return order(relaxing(), x0, 1.0, solve_with_scipy(relaxing_by_hand, x0, 1.0), lt.MetriplecticMidpoint(), (40, 80))


@row("BFM", "Props. 4.2, 4.4", "the energy in 1000 steps; no step loses entropy", "its first value")
def laws():
    run = lt.integrate(relaxing(), [0.3, 1.0, -0.4], (0.0, 100.0), 0.1)
    assert run.stats.least_entropy_increment >= -1e-15 * run.entropy.max()
    return relative_difference(run.energy, np.full(len(run.energy), run.energy[0]))


@row("BFM", "(4.8)", '`retraction="exp"` and `"midpoint"` on a sphere', "great circles")
def retractions():
    z, v = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.4, 0.9, -0.3])
    speed = float(jnp.linalg.norm(v))
    circle = lambda angle: np.cos(angle) * np.asarray(z) + np.sin(angle) * np.asarray(v) / speed  # noqa: E731
    exp_retraction, midpoint_retraction = (mf.retraction(mf.Sphere(2), kind) for kind in ("exp", "midpoint"))
    inverse = midpoint_retraction.inverse(jnp.asarray(circle(-0.5 * speed)), jnp.asarray(circle(0.5 * speed)))
    return largest_difference(
        relative_difference(exp_retraction.point(z, v), circle(speed)),
        relative_difference(inverse[0], z),
        relative_difference(inverse[1], v),
    )


@row("BFM", "(4.9), (4.10)", "`MetriplecticMidpoint` with `retraction=` on a sphere", "SciPy at $10^{-13}$")
def sphere_order() -> Order:
    system = lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), H, space=mf.Sphere(2))
    x0 = np.array([0.6, 0.0, 0.8])
    method = lt.MetriplecticMidpoint(retraction="midpoint")
    return order(system, x0, 4.0, solve_with_scipy(lambda t, m: np.cross(m, dH(m)), x0, 4.0), method)


@row("BFM", "Remark 4.7", '`FrictionOperator(projection="orthogonal")`', "its matrix")
def general_friction() -> Difference:
    K = lt.FrictionOperator(G, project=True, projection="orthogonal")
    P = [np.eye(3) - np.outer(w, w) / (w @ w) for w in dH(POINTS)]
    expected = [p @ G @ p for p in P]
    return relative_difference(friction(lt.LiePoissonSystem(mf.so(3), H, BALL, K)), expected)
