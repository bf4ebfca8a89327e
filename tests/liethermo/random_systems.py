"""Random metriplectic systems on an algebra, their coefficients parameters: thousands of systems are one program."""

import functools
import warnings

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf
from tests.cases import TRANSCENDENTAL

ALGEBRAS = [mf.so(3), mf.se(3), mf.so(4), mf.su(3), mf.sl(2), mf.bianchi("VI", h=-0.5), mf.heisenberg(1)]


def energy(p):
    """Quadratic, polynomial, trigonometric and exponential; no term is negative, so that H has their size."""

    def H(mu):
        polynomial = jnp.sum((p["root"] @ mu) ** 2) / 2 + p["strength"][0] * jnp.dot(p["a"], mu) ** 4
        trigonometric = p["strength"][1] * (1.0 - jnp.cos(jnp.dot(p["b"], mu)))
        return polynomial + trigonometric + p["strength"][2] * jnp.exp(jnp.dot(p["c"], mu))

    return H


def entropy(casimirs, p):
    """``w0 C + w1 log(1 + C^2) + w2 sin C + w3 (C - c)^2`` for each Casimir."""

    def S(mu):
        total = 0.0
        for i, C in enumerate(casimirs):
            w, value = p["weights"][i], C(mu)
            total += w[0] * value + w[1] * jnp.log(1.0 + value**2) + w[2] * jnp.sin(value)
            total += w[3] * (value - p["centre"][i]) ** 2
        return total

    return S


@functools.cache
def casimirs(g):
    if g.name in TRANSCENDENTAL:
        return (TRANSCENDENTAL[g.name][0],)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mf.NoPolynomialCasimirWarning)
        return tuple(C for degree in (1, 2, 3) for C in g.casimirs(degree))[: g.casimir_count()]


@functools.cache
def family(g):
    """The function from one set of parameters to its system: one and the same, so that it is compiled once."""

    def build(p):
        S, friction = entropy(casimirs(g), p), lt.ProjectedMetric(rate=p["rate"])
        return lt.LiePoissonSystem(g, energy(p), S, friction, validate=False)

    return build


def parameters(g, number, seed=0):
    """Independent ones; the entropies increase with the Casimirs, some of which have singularities behind them."""
    rng, n, kinds = np.random.default_rng(seed), g.dim, len(casimirs(g))

    def directions(shortest, longest):  # long ones make systems that a step of the suite cannot follow
        d = rng.standard_normal((number, n))
        return d / np.linalg.norm(d, axis=1, keepdims=True) * rng.uniform(shortest, longest, (number, 1))

    weights = rng.uniform(-1.0, 1.0, (number, kinds, 4))
    weights[..., 0] += 2.5
    weights[..., 3] = 0.0
    return {
        "root": np.eye(n) + 0.5 * rng.standard_normal((number, n, n)) / np.sqrt(n),
        "strength": rng.uniform(0.0, [0.1, 0.5, 0.5], (number, 3)),
        "a": directions(0.5, 1.5),
        "b": directions(0.5, 3.0),
        "c": directions(0.5, 1.5),
        "weights": weights,
        "centre": np.zeros((number, kinds)),
        "rate": rng.uniform(0.0, 0.1, number),
    }


def states(g, number, seed=0):
    rng = np.random.default_rng(seed)
    if g.name in TRANSCENDENTAL:
        return np.array(TRANSCENDENTAL[g.name][1]) + 0.05 * rng.standard_normal((number, g.dim))
    x = rng.standard_normal((number, g.dim))
    return x / np.linalg.norm(x, axis=1, keepdims=True) * rng.uniform(0.5, 1.5, (number, 1))
