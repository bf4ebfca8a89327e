"""Drives of spins: torques by currents (Slonczewski, Zhang and Li, spin-orbit), and the power of a laser pulse."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module
from manifolds.structures.spins import cross

from ...errors import FunctionError, IndexOutOfRangeError, InputError
from ...tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ...tracing.traced import trace_callables_and_result_shapes
from ..conditions import checked_numbers, nonnegative_condition, positive_condition
from ..time_span import required_argument_count
from .lattices import Lattice
from .spin_energy import checked_finite_numbers


class Slonczewski(Module):
    """Spin-transfer torque of a perpendicular current, ``a s x (s x p) + b s x p`` [Slonczewski 1996].

    It is an argument ``torque`` of ``lt.SpinSystem``.

    Parameters
    ----------
    polarisation : array, shape (3,) or ``(*sites, 3)``
        p, a unit vector, which is not normalised.
    damping_like, field_like : float, array of the shape of the sites, or function of the time
        a and b (1 / time), beside Landau and Lifshitz' form. The damping-like torque turns spins towards p if a < 0.

    Raises
    ------
    InputError
    """

    polarisation: jax.Array
    damping_like: jax.Array | Callable
    field_like: jax.Array | Callable

    def __init__(self, polarisation, damping_like=0.0, field_like=0.0):
        self.polarisation = checked_finite_numbers(polarisation, "a polarisation")
        if self.polarisation.shape[-1:] != (3,):
            raise InputError(f"a polarisation must have shape (3,) or (*sites, 3), got {self.polarisation.shape}")
        self.damping_like = _checked_amplitude(damping_like)
        self.field_like = _checked_amplitude(field_like)

    def __call__(self, t, s):
        a, b = _evaluate_amplitude(self.damping_like, t), _evaluate_amplitude(self.field_like, t)
        return a * cross(s, self.polarisation) + b * self.polarisation


class SpinOrbit(Slonczewski):
    """Spin-orbit torque of a current in the plane, with the polarisation ``normal x current`` [Manchon et al. 2019].

    Parameters
    ----------
    current : array, shape (3,)
        Direction of the current.
    damping_like, field_like : float, array of the shape of the sites, or function of the time
        Amplitudes (1 / time) of ``s x (s x p)`` and of ``s x p``, as of :class:`Slonczewski`.
    normal : array, shape (3,)
        Normal of the interface, from the heavy metal to the magnet.

    Raises
    ------
    InputError
    """

    def __init__(self, current, damping_like=0.0, field_like=0.0, normal=(0.0, 0.0, 1.0)):
        n, j = (
            np.asarray(checked_finite_numbers(value, name, (3,)))
            for value, name in ((normal, "the normal"), (current, "the current"))
        )
        p = np.cross(n, j)
        length = np.linalg.norm(p)
        if not length > 0.0:
            raise InputError("the current of a spin-orbit torque must not be parallel to the normal")
        super().__init__(p / length, damping_like, field_like)


class ZhangLi(Module):
    """Spin-transfer torque of a current along a texture, ``-(u . grad) s + beta s x (u . grad) s`` [Zhang & Li 2004].

    The spins are unit vectors. The derivative is a central difference, and one-sided at open borders.

    Parameters
    ----------
    cells : Lattice
        A mesh with rectangular cells.
    velocity : array, shape (3,)
        u (length / time), the drift velocity of the electrons times their polarisation.
    beta : float
        Degree of non-adiabaticity.
    alpha : float
        Gilbert's damping constant, if the torque belongs to Gilbert's form: u is then multiplied by
        ``(1 + alpha beta) / (1 + alpha^2)``, and beta is replaced by ``(beta - alpha) / (1 + alpha beta)``, as the
        solution of Gilbert's equation for s' requires. 0 for a torque beside Landau and Lifshitz' form.

    Raises
    ------
    InputError
    """

    velocity: jax.Array
    beta: jax.Array
    cells: tuple[int, ...] = eqx.field(static=True)
    edges: tuple[float, ...] = eqx.field(static=True)
    periodic: tuple[bool, ...] = eqx.field(static=True)

    def __init__(self, cells: Lattice, velocity, beta=0.0, alpha=0.0):
        if not isinstance(cells, Lattice) or len(cells.basis) != 1 or cells.vectors.shape != (3, 3):
            raise InputError("cells must be those of lt.magnetism.mesh")
        self.edges = tuple(float(edge) for edge in np.diag(cells.vectors))
        if not np.array_equal(cells.vectors, np.diag(self.edges)):
            raise InputError("cells must be rectangular, as those of lt.magnetism.mesh")
        self.cells, self.periodic = cells.cells, cells.periodic
        u = checked_finite_numbers(velocity, "a velocity", (3,))
        b, a = (checked_finite_numbers(value, name, ()) for value, name in ((beta, "beta"), (alpha, "alpha")))
        self.velocity = u * (1.0 + a * b) / (1.0 + a**2)
        self.beta = (b - a) / (1.0 + a * b)

    def __call__(self, t, s):
        if s.shape != (*self.cells, 3):
            raise InputError(
                f"the current of this torque flows in a mesh of {self.cells} cells, so spins must have shape "
                f"{(*self.cells, 3)}, got {s.shape}"
            )
        derivative = jnp.zeros_like(s)
        for axis, (edge, is_periodic) in enumerate(zip(self.edges, self.periodic, strict=True)):
            if s.shape[axis] > 1:
                derivative = derivative + self.velocity[axis] * _central_difference(s, axis, edge, is_periodic)
        return cross(s, derivative) + self.beta * derivative


def _central_difference(s, axis: int, spacing: float, is_periodic: bool) -> jax.Array:
    """Return the derivative of spins along an axis by central differences, one-sided at open borders."""
    next_values, previous_values = jnp.roll(s, -1, axis), jnp.roll(s, 1, axis)
    if is_periodic:
        return (next_values - previous_values) / (2.0 * spacing)
    index = np.arange(s.shape[axis]).reshape([-1 if a == axis else 1 for a in range(s.ndim)])
    is_first, is_last = index == 0, index == s.shape[axis] - 1
    local_spacing = jnp.where(is_first | is_last, spacing, 2.0 * spacing)
    return (jnp.where(is_last, s, next_values) - jnp.where(is_first, s, previous_values)) / local_spacing


def _checked_amplitude(value):
    """Return the amplitude of a torque: a function of the time unchanged, or checked numbers."""
    name = "the amplitude of a torque"
    return value if callable(value) else checked_finite_numbers(value, name)


def _evaluate_amplitude(value, t) -> jax.Array:
    """Return an amplitude at a time, with a trailing axis for the components of spins if it varies."""
    amplitude = jnp.asarray(value(t) if callable(value) else value)
    return amplitude[..., None] if amplitude.ndim else amplitude


def checked_spin_torque(torque, sites: tuple[int, ...]) -> tuple[Callable, ...]:
    """Return a checked tuple of functions w(t, s) of torques ``s x w``.

    Raises
    ------
    InputError, FunctionError
    """
    terms = tuple(torque) if isinstance(torque, list | tuple) else (torque,)
    for term in terms:
        if not callable(term) or required_argument_count(term) != 2:
            raise InputError(
                "a torque on spins must be a function w of t and s, such as lt.magnetism.Slonczewski, which acts as "
                f"s x w, got {type(term).__name__}"
            )
    shape = (*sites, 3)

    def evaluate_terms(functions, t, s):
        return [jnp.asarray(function(t, s)) for function in functions]

    try:
        functions, values = trace_callables_and_result_shapes(terms, evaluate_terms, (), shape)
    except IndexOutOfRangeError as error:
        raise error.with_function(f"the torque, at spins of shape {shape},") from None
    except TRACE_ERRORS as error:
        subject = f"the torque could not be evaluated on spins of shape {shape}"
        raise FunctionError(trace_error_message(subject, error)) from error
    for value in values:
        if value.shape not in (shape, (3,)) or not jnp.issubdtype(value.dtype, jnp.floating):
            raise FunctionError(
                f"a torque on spins must return real numbers of shape {shape} or (3,), got {value.dtype} of shape "
                f"{value.shape}"
            )
    return functions


GAUSSIAN_EXPONENT = 4.0 * math.log(2.0)
"""``4 log 2``: a Gaussian ``exp(-4 log 2 (t / w)^2)`` has the full width w at half its maximum."""


class LaserPulse(Module):
    """The power of a Gaussian laser pulse, ``P(t) = E sqrt(4 log 2 / pi) / w exp(-4 log 2 ((t - t_0) / w)^2)``.

    It is an argument ``power`` of ``lt.SpinSystem``, which gives it to a bath, such as that of the electrons.

    Parameters
    ----------
    energy : float >= 0
        E, the energy absorbed. The fluence absorbed times the area, in the units of the energy of the system.
    duration : float > 0
        w, the full width at half maximum (time).
    centre : float
        t_0, the time of the largest power.

    Raises
    ------
    InputError

    Examples
    --------
    >>> pulse = lt.magnetism.LaserPulse(energy=2.0, duration=0.1, centre=0.5)
    >>> round(float(pulse(0.5)), 2), round(float(pulse(0.55) / pulse(0.5)), 3)
    (18.79, 0.5)
    """

    energy: jax.Array
    duration: jax.Array
    centre: jax.Array

    def __init__(self, energy, duration, centre=0.0):
        self.energy = checked_numbers(energy, "the energy of a pulse", ())
        self.duration = checked_numbers(duration, "the duration of a pulse", ())
        self.centre = checked_finite_numbers(centre, "the centre of a pulse", ())
        nonnegative_condition("the energy of a pulse").require(self.energy)
        positive_condition("the duration of a pulse").require(self.duration)

    def __call__(self, t) -> jax.Array:
        height = self.energy * math.sqrt(GAUSSIAN_EXPONENT / math.pi) / self.duration
        return height * jnp.exp(-GAUSSIAN_EXPONENT * ((t - self.centre) / self.duration) ** 2)
