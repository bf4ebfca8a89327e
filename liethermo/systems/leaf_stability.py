"""The energy-Casimir test: whether a conserved or monotone function has a strict extremum at an equilibrium."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..functions.energy import Energy
from ..tracing.interpret import evaluate_at_points
from .base import System

MAX_LEAF_DIM = 200
"""Largest dimension of a leaf on which the test is made; its cost grows with the fourth power."""

DEFINITE_RTOL = 1e-9
"""Smallest eigenvalue of a definite second variation, relative to the largest: smaller ones may be rounding."""

CRITICAL_RTOL = 1e-7
"""Largest gradient of a combination of functions that counts as zero, relative to its terms."""

SIGN_PENALTY = 1e3
"""Weight of a coefficient of the wrong sign, beside an eigenvalue of at most one."""

SEARCH_SEEDS = (0, 1, 2, 3)
"""Seeds of the initial combinations of the search; the smallest eigenvalue is concave, so few are needed."""


def retract(system: System, x, v) -> jax.Array:
    """Return the state ``x + v``, shape (n,), projected onto the state space."""
    if system.space is None:
        return x + v
    return system.space.to_vector(system.space._project(system.points(x + v)))


def has_lyapunov_function(
    system: System, x: np.ndarray, frame: np.ndarray, leaf_basis: np.ndarray, functions: dict[str, Energy]
) -> bool:
    """Return whether a combination of functions is critical at x and definite on the leaf: a Lyapunov function.

    The functions are the conserved ones, with any coefficients, and those that the laws let change one way only, with
    coefficients >= 0.

    Parameters
    ----------
    x : array, shape (n,)
    frame : array, shape (m, n)
        Basis of the tangent space of the state space.
    leaf_basis : array, shape (m, p)
        Basis of the tangent space of the leaf, in coordinates of the frame.
    """
    p = leaf_basis.shape[1]
    if not 0 < p <= MAX_LEAF_DIM:
        return False
    monotone: list[Energy] = []
    if system.entropy_law == "nondecreasing" and system.entropy is not None:
        monotone.append(-system.entropy)
    if system.energy_law == "nonincreasing":
        monotone.append(system.energy)
    terms = (*functions.values(), *monotone)
    if not terms:
        return False
    gradients, hessians = (a[0] for a in evaluate_at_points(_gradients_and_hessians, (system, terms, frame), x[None]))
    if not (np.isfinite(gradients).all() and np.isfinite(hessians).all()):
        return False
    variations = leaf_basis.T @ hessians @ leaf_basis
    scales = np.maximum(np.linalg.norm(gradients, axis=1), np.linalg.norm(variations, axis=(1, 2)))
    scales = np.where(scales > 0.0, scales, 1.0)
    gradients, variations = gradients / scales[:, None], variations / scales[:, None, None]
    # a monotone function that depends on conserved ones only widens the search
    return any(
        _has_definite_combination(gradients[:n_terms], variations[:n_terms], len(functions))
        for n_terms in dict.fromkeys((len(functions), len(terms)))
        if n_terms
    )


def _has_definite_combination(gradients: np.ndarray, variations: np.ndarray, n_conserved: int) -> bool:
    """Return whether a combination of functions exists whose gradient vanishes and whose Hessian is definite.

    Parameters
    ----------
    gradients : array, shape (terms, m)
    variations : array, shape (terms, p, p)
    n_conserved : int
        Number of the first terms, whose coefficients may have any sign.
    """
    _, singular_values, vectors = np.linalg.svd(gradients.T, full_matrices=True)
    rank = int(np.sum(singular_values > CRITICAL_RTOL))
    combinations = vectors[rank:]  # coefficients whose total gradient vanishes
    return bool(len(combinations)) and _can_be_positive_definite(combinations, variations, n_conserved)


def _can_be_positive_definite(combinations: np.ndarray, variations: np.ndarray, n_conserved: int) -> bool:
    """Return whether a combination of symmetric matrices, with coefficients of the right sign, is positive definite.

    Parameters
    ----------
    combinations : array, shape (k, terms)
    variations : array, shape (terms, p, p)
    n_conserved : int
        Number of the first terms, whose coefficients may have any sign.
    """

    def negative_margin(weights):
        norm = np.linalg.norm(weights)
        if norm == 0.0:
            return 0.0
        coefficients = weights @ combinations / norm
        eigenvalues = np.linalg.eigvalsh(np.tensordot(coefficients, variations, 1))
        wrong_sign = -np.minimum(coefficients[n_conserved:], 0.0).sum()
        size = np.abs(eigenvalues).max()
        return SIGN_PENALTY * wrong_sign - (eigenvalues[0] / size if size > 0.0 else 0.0)

    k = len(combinations)
    if k == 1:
        return min(negative_margin(np.ones(1)), negative_margin(-np.ones(1))) < -DEFINITE_RTOL
    for seed in SEARCH_SEEDS:
        start = np.random.default_rng(seed).standard_normal(k)
        result = scipy.optimize.minimize(negative_margin, start, method="Nelder-Mead", options={"maxiter": 200 * k})
        if result.fun < -DEFINITE_RTOL:
            return True
    return False


def _gradients_and_hessians(system_terms_frame: tuple, x) -> tuple[jax.Array, jax.Array]:
    """Return gradients, shape (terms, m), and Hessians, shape (terms, m, m), of functions in coordinates of a frame."""
    system, terms, frame = system_terms_frame

    def values_near(coordinates):
        y = retract(system, x, coordinates @ frame)
        return jnp.stack([term.value(y) for term in terms])

    zero = jnp.zeros(frame.shape[0])
    return jax.jacfwd(values_near)(zero), jax.jacfwd(jax.jacfwd(values_near))(zero)
