"""Closed forms for a free body: the periods of its motion, and the damping of its nutation by internal friction."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from ..errors import InputError
from ..functions.conditions import checked_numbers, require_condition
from .inertia import EQUAL_MOMENTS_RTOL, are_inertia_tensors, principal_axes, principal_moments


class Periods(NamedTuple):
    """The periods of a free body, three arrays of equal shape.

    Attributes
    ----------
    rotation : ndarray
        Period (time) of the angular velocity in body axes; infinite on the separatrix. Near the axis of greatest
        inertia of a body with ``I_1 = I_2`` it is ``2 pi I_1 I_3 / (L_3 (I_3 - I_1))``.
    precession : ndarray
        Mean time (time) in which the circled axis of the body turns once about the angular momentum in space. It is ``2
        pi I_1 / L`` for a body with two equal moments.
    axis : ndarray of int
        Index of the circled axis, 0, 1 or 2 in the order of the given moments: the axis of the greatest or the least
        inertia. For a tensor it is the index of a principal axis in ascending order of the moments, 0 or 2: see
        :func:`liethermo.bodies.principal_axes`.
    """

    rotation: np.ndarray
    precession: np.ndarray
    axis: np.ndarray


def periods(inertia, momentum, energy=None) -> Periods:
    """Return the periods of a free body from elliptic integrals [Landau & Lifshitz, Mechanics §37; Samarasinha &
    A'Hearn 1991].

    With ``I_1 <= I_2 <= I_3`` and ``L**2 > 2 E I_2`` the angular momentum circles about the axis of ``I_3`` in body
    axes (short-axis mode), with ``L**2 < 2 E I_2`` about that of ``I_1`` (long-axis mode).

    Parameters
    ----------
    inertia : array, shape (..., 3), > 0, or (..., 3, 3)
        Principal moments (mass * length**2), in any order, or tensors of inertia in body axes. An array whose last two
        axes have length 3 holds tensors where each block is symmetric and positive definite and its principal moments
        obey ``I_i <= I_j + I_k``; no three rigid bodies have the rows of such a block as their moments.
    momentum : array, shape (..., 3), or (...) beside an energy
        Angular momentum in body axes, or its norm L (mass * length**2 / time).
    energy : array, shape (...), optional
        Kinetic energy E (mass * length**2 / time**2); by default that of the momentum.

    Returns
    -------
    Periods
        Arrays of shape (...); for a steady spin both periods are the limits for small circles.

    Raises
    ------
    InputError
        If no motion of the body has such an energy and momentum: ``L**2 / (2 I_3) <= E <= L**2 / (2 I_1)``.
    """
    moments, L = np.asarray(principal_moments(inertia)), np.asarray(momentum, dtype=float)
    if energy is None:
        if L.shape[-1:] != (3,):
            raise InputError(f"without energy=, momentum must have shape (..., 3), got {L.shape}")
        if are_inertia_tensors(np.asarray(inertia)):
            L = np.einsum("...ji,...j->...i", principal_axes(inertia).axes, L)
        E, L = 0.5 * np.sum(L**2 / moments, axis=-1), np.linalg.norm(L, axis=-1)
    else:
        E = np.asarray(energy, dtype=float)
    order = np.argsort(moments, axis=-1, kind="stable")
    shape = np.broadcast_shapes(L.shape, E.shape, moments.shape[:-1])
    I1, I2, I3 = (np.broadcast_to(np.take_along_axis(moments, order, -1)[..., i], shape) for i in range(3))
    L, E = np.broadcast_to(L, shape), np.broadcast_to(E, shape)
    L_squared, rounding = L**2, 8 * np.finfo(float).eps
    min_energy, max_energy = L_squared / (2 * I3), L_squared / (2 * I1)
    is_possible = (min_energy > 0.0) & (min_energy * (1 - rounding) <= E) & (max_energy * (1 + rounding) >= E)
    if not is_possible.all():
        i = np.unravel_index(int(np.argmin(is_possible)), shape)
        raise InputError(
            f"the energy for the momentum {L[i]:g} must lie between L**2 / (2 I_3) = {min_energy[i]:g} and "
            f"L**2 / (2 I_1) = {max_energy[i]:g}, got {E[i]:g}"
        )
    is_short_axis = L_squared >= 2 * E * I2
    a, c = np.where(is_short_axis, I1, I3), np.where(is_short_axis, I3, I1)  # c is the moment of the circled axis
    with np.errstate(divide="ignore", invalid="ignore"):
        circling_factor = (c - I2) * (L_squared - 2 * E * a)
        m = np.clip((I2 - a) * (2 * E * c - L_squared) / circling_factor, 0.0, 1.0)
        K = scipy.special.ellipk(m)
        rotation = 4 * K * np.sqrt(a * I2 * c / circling_factor)
        n = -c * (I2 - a) / (a * (c - I2))
        mean_rate = 1 / c + (1 / a - 1 / c) * _elliptic_pi(n, m) / K
    is_aperiodic = (circling_factor <= 0.0) | np.isinf(K)  # a steady spin, or motion on the separatrix
    rotation, mean_rate = np.where(is_aperiodic, np.inf, rotation), np.where(is_aperiodic, 1 / I2, mean_rate)
    axis = np.where(is_short_axis, order[..., 2], order[..., 0])
    return Periods(rotation, 2 * np.pi / (L * mean_rate), axis)


def _elliptic_pi(n, m) -> np.ndarray:
    """Return the complete elliptic integral of the third kind, by Carlson's forms [DLMF 19.25.2]."""
    RF, RJ = scipy.special.elliprf, scipy.special.elliprj
    return RF(0.0, 1.0 - m, 1.0) + n / 3.0 * RJ(0.0, 1.0 - m, 1.0, 1.0 - n)


def rate_of(relaxation_time, inertia, momentum) -> jax.Array:
    """Return the rate of internal friction of a body whose small nutations decay by a factor e in the given time.

    The friction is that of ``x' = Pi dH + rate Pi Pi dH``. With ``I_1 <= I_2 <= I_3``, ``d_i = 1/I_i - 1/I_3`` and
    ``r = rate L**2``, small nutations from the spin about the axis 3 obey a linear equation with the trace
    ``-r (d_1 + d_2)`` and the determinant ``(r**2 + L**2) d_1 d_2``. There are three cases.

    - The nutation oscillates, where ``rate L |d_1 - d_2| < 2 sqrt(d_1 d_2)``, as it does for every body with three
      different moments and weak friction. Its amplitude falls by e in ``tau``, ``1/tau = r (d_1 + d_2) / 2``. Large
      nutations of a body with ``I_1 = I_2`` obey that too: ``tan theta = tan theta_0 exp(-t / tau)``.
    - A rod, ``I_2 = I_3``, does not oscillate: it comes to a flat spin about whichever transverse axis. The tangent of
      the angle from the flat spin falls by e in tau, ``1/tau = r d_1``, at small angles and at large ones. That is
      twice the rate of a body whose two greatest moments differ by ever so little, and oscillates.
    - If ``I_2`` and ``I_3`` are nearly equal, friction may be too strong for an oscillation. Then the angle between
      the momentum and the plane of the axes 2 and 3 falls by e in tau, the shorter time of the linear equation:
      ``1/tau = r (d_1 + d_2) / 2 + sqrt(r**2 (d_1 - d_2)**2 / 4 - L**2 d_1 d_2)``. The way to the axis 3 within that
      plane takes the longer time, about ``rate / d_2``, which tau does not mean.

    The rate is a continuous function of the moments and of tau through all three, but moments that differ by less than
    1e-9 of themselves count as equal.

    Parameters
    ----------
    relaxation_time : float or array, > 0
        tau (time).
    inertia : array, shape (..., 3), > 0, or (..., 3, 3)
        Principal moments (mass * length**2), in any order, not all equal; or tensors of inertia, by the rule of
        :func:`periods`.
    momentum : float or array, > 0
        The norm L of the angular momentum (mass * length**2 / time).

    Returns
    -------
    array
        Rate (time / (mass * length**2)).

    Raises
    ------
    InputError
    """
    moments = principal_moments(inertia)
    tau, L = checked_numbers(relaxation_time, "a relaxation time"), checked_numbers(momentum, "the size of a momentum")
    for value, label in ((tau, "a relaxation time"), (L, "the size of a momentum")):
        require_condition(
            value, lambda v: (v > 0.0) & (v < np.inf), label + " must be positive and finite, got {value}"
        )
    smallest_moment, middle_moment, greatest_moment = jnp.moveaxis(jnp.sort(moments, axis=-1), -1, 0)
    is_unequal = greatest_moment - smallest_moment > EQUAL_MOMENTS_RTOL * greatest_moment
    require_condition(is_unequal, lambda v: v, "a body with three equal moments has no nutation to relax")
    is_slender_rod = greatest_moment - middle_moment <= EQUAL_MOMENTS_RTOL * greatest_moment
    d1 = (greatest_moment - smallest_moment) / (greatest_moment * smallest_moment)
    ratio = jnp.where(
        is_slender_rod,
        0.0,
        (greatest_moment - middle_moment) * smallest_moment / ((greatest_moment - smallest_moment) * middle_moment),
    )  # d_2 / d_1
    decay = 1.0 / (tau * L * d1)
    oscillates = decay * (1.0 - ratio) <= jnp.sqrt(jnp.where(ratio > 0.0, ratio, 1.0)) * (1.0 + ratio) * (ratio > 0.0)
    oscillating_rate = 2.0 * decay / (1.0 + ratio)
    discriminant = jnp.where(oscillates, 1.0, (decay * (1.0 - ratio)) ** 2 - 4.0 * ratio**2)  # sqrt has a derivative
    overdamped_rate = 2.0 * (decay**2 + ratio) / ((1.0 + ratio) * decay + jnp.sqrt(discriminant))
    return jnp.where(oscillates, oscillating_rate, overdamped_rate) / L


def damping_time(rigidity, quality, density, radius, spin, shape_factor=100.0) -> np.ndarray:
    """Return the time in which inelastic friction damps the nutation of a solid body, ``A mu Q / (rho R**2 omega**3)``.

    The form is agreed upon, and follows from dimensions. The constant A depends on the shape and on who computed it:
    Burns & Safronov (1973) have about 100 for bodies that are nearly round and less for long ones; Efroimsky & Lazarian
    (2000) argue for friction stronger by one to two orders of magnitude, since stresses at twice the frequency of
    precession were left out; Sharma, Burns & Hui (2005) solve the elastic problem for ellipsoids of revolution
    and find a few hundred, so slower damping; Breiter, Rozek & Vokrouhlicky (2012) correct both and find
    that they then differ little. So a time is known to a factor of about ten, beside what is not known of mu Q.

    Parameters
    ----------
    rigidity : float or array, > 0
        mu (pressure; Pa).
    quality : float or array, > 0
        Q, the strain energy over the energy lost in a radian.
    density : float or array, > 0
        rho (mass / length**3; kg / m**3).
    radius : float or array, > 0
        Mean radius R (length; m).
    spin : float or array, > 0
        omega, 2 pi over the period of rotation (1 / time; rad / s).
    shape_factor : float or array, > 0
        A.

    Returns
    -------
    ndarray
        Time (s, of SI units).

    Raises
    ------
    InputError
    """
    arguments = {
        "rigidity": rigidity,
        "quality": quality,
        "density": density,
        "radius": radius,
        "spin": spin,
        "shape_factor": shape_factor,
    }
    mu, Q, rho, R, omega, A = (np.asarray(value, dtype=float) for value in arguments.values())
    for name, value in arguments.items():
        require_condition(value, lambda v: (v > 0.0) & (v < np.inf), name + " must be positive and finite, got {value}")
    return A * mu * Q / (rho * R**2 * omega**3)
