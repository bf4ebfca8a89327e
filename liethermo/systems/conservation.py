"""Which functions are constant along a system, judged at points by their rates of change."""

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
    """Rates of change of functions along the parts of a vector field: the motion, each dissipation, a torque.

    Attributes
    ----------
    values : array, shape (..., parts, functions)
    scales : array, shape (..., parts, functions)
        The speed of each part times the length of each gradient: what a rate is judged by.
    """

    values: jax.Array
    scales: jax.Array


def rates_of_change(model: tuple[SystemInterface, tuple[Energy, ...]], x) -> InvariantRates:
    """Return the rates of change of functions at x along the motion, along each dissipation and along a torque.

    The speed of a dissipation is the norm of its force, or of its force for other gradients of equal length if that is
    larger: the force itself may be the rounding error of zero.

    Parameters
    ----------
    model : (System, tuple of Energy)
    x : array, shape (n,)
    """
    system, functions = model
    gradients = jnp.stack([f.gradient(x) for f in functions])
    dH = project_covector(system, x, system.energy.gradient(x))
    dS = jnp.zeros_like(x) if system.entropy is None else project_covector(system, x, system.entropy.gradient(x))
    random = np.random.default_rng(0).standard_normal((2, system.dim)) / np.sqrt(system.dim)
    motion = system.poisson.sharp(x, dH)
    parts = [motion]
    speeds = [jnp.linalg.norm(motion) + jnp.linalg.norm(system.poisson.sharp(x, jnp.abs(dH)))]
    dissipations = () if system.dissipation is None else system.dissipation.terms
    for part in dissipations:
        dL = tuple(project_covector(system, x, L.gradient(x)) for L in part.preserve)
        a, b = (project_covector(system, x, v * jnp.linalg.norm(d)) for v, d in zip(random, (dH, dS), strict=True))
        parts.append(part.force(system, x, dH, dS, dL))
        speeds.append(jnp.fmax(jnp.linalg.norm(parts[-1]), jnp.linalg.norm(part.force(system, x, a, b, dL))))
    if (push := system.external_torque(x)) is not None:
        parts.append(push)
        speeds.append(jnp.linalg.norm(push))
    rates = jnp.stack(parts) @ gradients.T
    energy = system.energy.value(x)  # a derivative may be finite where the function is not defined
    laws = energy if system.entropy is None else energy + system.entropy.value(x)
    defined = jnp.isfinite(jnp.stack([energy, *[laws] * (len(parts) - 1)]))
    rates = jnp.where(defined[:, None], rates, jnp.nan)
    for i, part in enumerate(dissipations, start=1):
        if part.preserve:  # by construction, wherever it is defined
            kept = _is_spanned(gradients, [L.gradient(x) for L in part.preserve])
            rates = rates.at[i].set(jnp.where(kept, 0.0, rates[i]))
    scales = jnp.stack(speeds)[:, None] * jnp.linalg.norm(gradients, axis=1)
    return InvariantRates(rates, jnp.where(rates == 0.0, 1.0, scales))


def project_covector(system: SystemInterface, x, alpha) -> jax.Array:
    """Return the part of a covector that acts on tangent vectors: alpha itself on R^n."""
    return alpha if system.space is None else system.lower_index(x, system.raise_index(x, alpha))


def _is_spanned(gradients, vectors) -> jax.Array:
    """Return which of the gradients, shape (m, n), are linear combinations of vectors, shape (m,)."""
    off = gram_schmidt(vectors).project_off
    rest = jnp.stack([off(gradient) for gradient in gradients])
    return jnp.sum(rest**2, axis=1) <= (AXIOM_TOLERANCE**2) * jnp.sum(gradients**2, axis=1)


class PointwiseVerdicts(NamedTuple):
    """What rates of change say of functions at points.

    Attributes
    ----------
    is_defined : array of bool, shape (..., functions)
        Where all rates are finite; elsewhere nothing is known.
    is_conserved : array of bool, shape (..., functions)
        Where the motion and each dissipation conserve the function, relative to their own sizes. Dissipations much
        slower than the motion are judged too, since their effect adds up.
    """

    is_defined: np.ndarray
    is_conserved: np.ndarray


def judge_conservation(rates: InvariantRates) -> PointwiseVerdicts:
    """Return at which points each function is conserved."""
    values, scales = rates
    with np.errstate(invalid="ignore"):
        each = (np.abs(values) <= AXIOM_TOLERANCE * scales).all(axis=-2)
        together = np.abs(values.sum(axis=-2)) <= AXIOM_TOLERANCE * np.abs(values).max(axis=-2)
    return PointwiseVerdicts(np.asarray(np.isfinite(values).all(axis=-2)), each | together)


def is_proportional(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether one field of gradients is a constant multiple of the other, shape (...).

    Parameters
    ----------
    one, other : array, shape (..., points, n)
        Points at which one of them is not finite are left out.
    """
    inside = np.isfinite(one).all(axis=-1) & np.isfinite(other).all(axis=-1)
    one, other = (np.where(inside[..., None], field, 0.0) for field in (one, other))
    lengths, other_lengths = np.linalg.norm(one, axis=-1), np.linalg.norm(other, axis=-1)
    alike = ((lengths > 0.0) == (other_lengths > 0.0)).all(axis=-1) & (lengths > 0.0).any(axis=-1)
    at = np.argmax(other_lengths, axis=-1)[..., None, None]
    a, b = (np.take_along_axis(field, at, axis=-2)[..., 0, :] for field in (one, other))
    i = np.argmax(np.abs(b), axis=-1)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.take_along_axis(a, i, axis=-1) / np.take_along_axis(b, i, axis=-1)
        residual = np.linalg.norm(one - factor[..., None] * other, axis=-1)
        near = (residual <= AXIOM_TOLERANCE * lengths).all(axis=-1)  # at each point by itself: their scales differ
    return alike & near
