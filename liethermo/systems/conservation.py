"""Test which functions a system conserves, by their rates of change at given states."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.energy import Energy
from ..functions.frames import gram_schmidt
from .check import AXIOM_TOLERANCE
from .interface import SystemInterface


class InvariantRates(NamedTuple):
    """Rates of change of functions along each part of a vector field: the motion, each dissipation, a torque.

    Attributes
    ----------
    values : array, shape (..., parts, functions)
    scales : array, shape (..., parts, functions)
        The speed of each part times the length of each gradient: what a rate is judged by.
    """

    values: jax.Array
    scales: jax.Array


def function_rates_of_change(system_and_functions: tuple[SystemInterface, tuple[Energy, ...]], x) -> InvariantRates:
    """Return the rates of change of functions at x along the motion, along each dissipation and along a torque.

    The speed of a dissipation is the norm of its force, or of its force for other gradients of equal length if that is
    larger: the force itself may be the rounding error of zero.

    Parameters
    ----------
    system_and_functions : (System, tuple of Energy)
    x : array, shape (n,)
    """
    system, functions = system_and_functions
    gradients = jnp.stack([f.gradient(x) for f in functions])
    dH = project_covector(system, x, system.energy.gradient(x))
    dS = jnp.zeros_like(x) if system.entropy is None else project_covector(system, x, system.entropy.gradient(x))
    random = np.random.default_rng(0).standard_normal((2, system.dim)) / np.sqrt(system.dim)
    motion = system.poisson.sharp(x, dH)
    velocities = [motion]
    speeds = [jnp.linalg.norm(motion) + jnp.linalg.norm(system.poisson.sharp(x, jnp.abs(dH)))]
    for dissipation in system.total_dissipation.terms:
        dL = tuple(project_covector(system, x, L.gradient(x)) for L in dissipation.preserve)
        a, b = (project_covector(system, x, v * jnp.linalg.norm(d)) for v, d in zip(random, (dH, dS), strict=True))
        velocities.append(dissipation.force(system, x, dH, dS, dL))
        other_force = dissipation.force(system, x, a, b, dL)
        speeds.append(jnp.fmax(jnp.linalg.norm(velocities[-1]), jnp.linalg.norm(other_force)))
    if (torque := system.external_torque(x)) is not None:
        velocities.append(torque)
        speeds.append(jnp.linalg.norm(torque))
    rates = jnp.stack(velocities) @ gradients.T
    energy = system.energy.value(x)  # a derivative may be finite where the function is not defined
    value = energy if system.entropy is None else energy + system.entropy.value(x)
    is_defined = jnp.isfinite(jnp.stack([energy, *[value] * (len(velocities) - 1)]))
    rates = jnp.where(is_defined[:, None], rates, jnp.nan)
    for i, dissipation in enumerate(system.total_dissipation.terms, start=1):
        if dissipation.preserve:  # by construction, wherever it is defined
            is_preserved = _are_in_span(gradients, [L.gradient(x) for L in dissipation.preserve])
            rates = rates.at[i].set(jnp.where(is_preserved, 0.0, rates[i]))
    scales = jnp.stack(speeds)[:, None] * jnp.linalg.norm(gradients, axis=1)
    return InvariantRates(rates, jnp.where(rates == 0.0, 1.0, scales))


def dissipation_keeps_casimirs(system: SystemInterface) -> bool:
    """Return whether no summand of the dissipation changes a Casimir, by construction."""
    return all(term.preserves_casimirs for term in system.total_dissipation.terms)


def project_covector(system: SystemInterface, x, alpha) -> jax.Array:
    """Return the part of a covector, shape (n,), that acts on tangent vectors of the space; alpha itself on R^n."""
    return alpha if system.space is None else system.lower_index(x, system.raise_index(x, alpha))


def _are_in_span(gradients, vectors) -> jax.Array:
    """Return for each gradient, shape (m, n), whether it is a linear combination of some vectors: bools, shape (m,)."""
    project_off = gram_schmidt(vectors).project_off
    remainders = jnp.stack([project_off(gradient) for gradient in gradients])
    return jnp.sum(remainders**2, axis=1) <= (AXIOM_TOLERANCE**2) * jnp.sum(gradients**2, axis=1)


class PointwiseVerdicts(NamedTuple):
    """Verdicts at several states on whether functions are conserved.

    Attributes
    ----------
    is_defined : array of bool, shape (..., functions)
        Whether all rates are finite; otherwise nothing is known.
    is_conserved : array of bool, shape (..., functions)
        Whether the motion and every dissipation conserve the function, each relative to its own size, so that a
        dissipation much slower than the motion counts too.
    """

    is_defined: np.ndarray | jax.Array
    is_conserved: np.ndarray | jax.Array


def judge_conservation(rates: InvariantRates, tolerance: float = AXIOM_TOLERANCE) -> PointwiseVerdicts:
    """Return verdicts at each point on whether functions are conserved, from their rates (NumPy or JAX).

    Parameters
    ----------
    rates : InvariantRates
    tolerance : float
        Largest rate of a conserved function, relative to its scale.
    """
    values, scales = rates
    with np.errstate(invalid="ignore"):
        all_parts_vanish = (abs(values) <= tolerance * scales).all(axis=-2)
        sum_vanishes = abs(values.sum(axis=-2)) <= tolerance * abs(values).max(axis=-2)
    return PointwiseVerdicts((abs(values) < np.inf).all(axis=-2), all_parts_vanish | sum_vanishes)


def is_proportional(f: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return whether the sampled vector field f is a constant multiple of g: bools, shape (...).

    Parameters
    ----------
    f, g : array, shape (..., points, n)
        Points at which f or g is not finite are left out.
    """
    is_finite = np.isfinite(f).all(axis=-1) & np.isfinite(g).all(axis=-1)
    f, g = (np.where(is_finite[..., None], field, 0.0) for field in (f, g))
    f_norms, g_norms = np.linalg.norm(f, axis=-1), np.linalg.norm(g, axis=-1)
    same_zeros = ((f_norms > 0.0) == (g_norms > 0.0)).all(axis=-1) & (f_norms > 0.0).any(axis=-1)
    index_of_largest = np.argmax(g_norms, axis=-1)[..., None, None]
    a, b = (np.take_along_axis(field, index_of_largest, axis=-2)[..., 0, :] for field in (f, g))
    i = np.argmax(np.abs(b), axis=-1)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.take_along_axis(a, i, axis=-1) / np.take_along_axis(b, i, axis=-1)
        residual = np.linalg.norm(f - factor[..., None] * g, axis=-1)
        is_multiple = (residual <= AXIOM_TOLERANCE * f_norms).all(axis=-1)  # each point relative to its own norm
    return same_zeros & is_multiple
