"""Energies of mechanical systems in states (q, p, S): kinetic and potential energy, discretised term by term."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from .energy import Energy, Function, Pullback, Quadratic, is_traced


class Kinetic(Energy):
    """``p . G(q) p / 2`` of a state (q, p) or (q, p, S), or ``v . G(q) v / 2`` of (q, v, S) [SML 28].

    G is the inverse of the metric (of the mass matrix) in a Hamiltonian, the metric itself in a Lagrangian. Whatever the scheme its discrete gradient by p is ``(G(q) + G(q')) (p + p') / 4``: a semidefinite matrix times the
    mean of p, which is what keeps the entropy of an evolution field from falling at any step.

    Parameters
    ----------
    G : array, shape (n, n) symmetric, or (n,) for a diagonal matrix; or function from q, shape (n,), to one
    """

    G: jax.Array | Callable

    def __init__(self, G):
        self.G = G if callable(G) else Quadratic(G).A  # checked there

    def at(self, q) -> jax.Array:
        """``G(q)``, shape (n, n) or (n,)."""
        return jnp.asarray(self.G(q)) if callable(self.G) else self.G

    def value(self, x) -> jax.Array:
        q, p = _halves(x)
        return 0.5 * jnp.dot(p, _apply(self.at(q), p))

    def discrete_gradient(self, scheme, x, d, low) -> jax.Array:
        (q, p), (dq, dp), (low_q, low_p) = map(_halves, (x, d, jnp.zeros_like(x) + low))
        middle, nothing = p + (low_p + 0.5 * dp), jnp.zeros(len(x) - 2 * len(p))
        if not callable(self.G):
            return jnp.concatenate([jnp.zeros_like(q), _apply(self.G, middle), nothing])
        first, last = p + low_p, p + (low_p + dp)
        G = [self.at(q + low_q), self.at(q + (low_q + dq))]
        by_p = 0.5 * (_apply(G[0], middle) + _apply(G[1], middle))

        def mean(q):  # over both ends in p, of the kinetic energy at q
            return 0.25 * (jnp.dot(first, _apply(self.at(q), first)) + jnp.dot(last, _apply(self.at(q), last)))

        by_q = scheme.general(Function(mean), q, dq, low_q)
        return jnp.concatenate([by_q, by_p, nothing])


class Potential(Pullback):
    """A potential ``V(q, S)`` of a state (q, p, S), entropy included: internal energy, springs that heat [SML 28].

    Parameters
    ----------
    V : function from q, shape (n,), and S, a scalar, to a scalar
    """

    def __init__(self, V: Callable):
        super().__init__(Function(_Apart(V)), _without_momenta)


class _Apart(Function):
    """V(q, S) as a function of one array."""

    def value(self, x):
        return jnp.asarray(self.function(x[:-1], x[-1]))


def is_mechanical(energy: Energy, dim: int) -> bool:
    """Whether H is ``p . G(q) p / 2 + V(q, S)`` with G semidefinite [SML 28], and each term known to be of that kind.

    Then ``p . (dgrad H)_p >= 0`` with p the midpoint, for the discrete gradients of every scheme that takes that of a
    quadratic term at the midpoint. A plain function of the whole state is not known to be anything.
    """
    if is_traced(energy):
        return False
    points = np.random.default_rng(0).standard_normal((4, dim))
    return all(_is_kinetic(term, points) or is_free_of_momenta(term, points) for term in energy.terms)


def _is_kinetic(term: Energy, points: np.ndarray) -> bool:
    n = points.shape[1] // 2
    if isinstance(term, Kinetic):
        return all(_is_semidefinite(np.asarray(term.at(q))) for q in points[:, :n])
    if not isinstance(term, Quadratic):
        return False
    A = np.diag(term.A) if term.A.ndim == 1 else np.asarray(term.A)
    rows, linear = A[n : 2 * n], None if term.b is None else np.asarray(term.b)[n : 2 * n]
    mixed = np.delete(rows, np.s_[n : 2 * n], axis=1)
    return not mixed.any() and (linear is None or not linear.any()) and _is_semidefinite(rows[:, n : 2 * n])


def is_free_of_momenta(term: Energy, points: np.ndarray) -> bool:
    """Whether a term is known not to depend on p (or v), from the derivative of its coordinates at some states."""
    n = points.shape[1] // 2
    if not isinstance(term, Pullback):
        return False
    return not any(np.asarray(jax.jacfwd(term.of)(x))[:, n : 2 * n].any() for x in points)


def _is_semidefinite(G: np.ndarray) -> bool:
    eigenvalues = G if G.ndim == 1 else np.linalg.eigvalsh(G)
    return bool(eigenvalues.min() >= -1e-14 * np.abs(eigenvalues).max())


def _halves(x):
    n = len(x) // 2
    return x[:n], x[n : 2 * n]


def _apply(G, p):
    return G * p if G.ndim == 1 else G @ p


def _without_momenta(x):
    n = len(x) // 2
    return jnp.concatenate([x[:n], x[2 * n :]])
