"""Torques on a body from outside: functions of the time, the momentum and the attitude."""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import replace_fields

from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..functions.time_span import is_spline, required_argument_count
from ..tracing.interpret import MAX_UNROLLED_DIM, vanishing_entry_indices
from ..tracing.short_form import callable_name
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import TracedFunction, trace_callables_and_result_shapes
from .base import System
from .interface import TorqueLaws


class TorqueSystem(System):
    """Base class of systems on which an external torque may act, evaluated at a time and perhaps an attitude.

    Attributes
    ----------
    torque : function, tuple or list of functions, or None
    torque_arguments : (t, attitude) or None
        Where the torque is taken: see :meth:`at_time`.
    """

    torque: Any
    torque_arguments: tuple[jax.Array, jax.Array | None] | None

    @property
    @abstractmethod
    def torque_laws(self) -> TorqueLaws:
        """Name and effects of the external torque."""

    @property
    def has_fixed_attitude(self) -> bool:
        """True if the attitude at which the torque is evaluated is known: see :meth:`at_time`."""
        return self.torque_arguments is not None and self.torque_arguments[1] is not None

    @property
    def is_driven(self) -> bool:
        return super().is_driven or (self.torque_laws.name != "" and self.torque_arguments is None)

    def at_time(self, t, attitude=None):
        system = super().at_time(t)
        if not self.torque_laws.name:
            return system
        arguments = jnp.asarray(t, dtype=jnp.float64), None if attitude is None else jnp.asarray(attitude)
        return replace_fields(system, torque_arguments=arguments)

    def drop_torque(self):
        if not self.torque_laws.name:
            return self
        return replace_fields(self, torque=None, torque_arguments=None)

    def external_torque(self, x):
        laws = self.torque_laws
        if not laws.name:
            return None
        t, attitude = (None, None) if self.torque_arguments is None else self.torque_arguments
        if t is None or (attitude is None and laws.needs_attitude):
            what = "time and the attitude" if laws.needs_attitude else "time"
            raise InputError(
                f"the torque {laws.name} has a value only at a {what}. Use system.at_time(t"
                f"{', attitude' if laws.needs_attitude else ''})"
            )
        torque = self._torque_at(x, t, attitude)
        return jnp.pad(torque, (0, self.dim - len(torque)))

    @abstractmethod
    def _torque_at(self, x, t, attitude) -> jax.Array:
        """Return the torque, shape (m,), on the first m components of a state x."""

    def field(self, x, dH, dS, dL=()):
        """Return the vector field at x, shape (n,), with the external torque."""
        velocity = self.external_velocity(x, dH)
        field = self.drop_torque()._field_without_torque(x, dH, dS, dL)
        return field if velocity is None else field + velocity

    def _field_without_torque(self, x, dH, dS, dL) -> jax.Array:
        """Return the vector field at x, shape (n,), without the external torque."""
        return super().field(x, dH, dS, dL)


def traced_torque_and_argument_counts(
    user_torque: Any, algebra: mf.LieAlgebra, group: mf.MatrixGroup | None
) -> tuple[Any, tuple[int, ...]]:
    """Return a torque with its functions checked and traced, and the number of arguments of each term.

    Raises
    ------
    InputError, FunctionError
        If it is not a function of t, (t, mu), (t, mu, attitude) or (t, mu, attitude, velocity) to a dual vector; or if
        there is no attitude.
    """
    if user_torque is None:
        return None, ()
    terms = _torque_terms(user_torque)
    if not terms:
        raise InputError("torque is an empty list. For a system without a torque use None")
    argument_counts = tuple(map(_checked_argument_count, terms))
    if max(argument_counts) > MAX_ARGUMENTS_WITHOUT_ATTITUDE and group is None:
        name = torque_name(
            next(term for term, n in zip(terms, argument_counts, strict=True) if n > MAX_ARGUMENTS_WITHOUT_ATTITUDE)
        )
        raise InputError(f"the torque {name} depends on the attitude. Give the system a group, such as group=mf.SO(3)")
    shapes = _argument_shapes(algebra, group)

    def evaluate_terms(torque, t, mu, velocity, *g):
        attitude = g[0] if len(g) == 1 else g[0] + 1j * g[1]
        return [jnp.asarray(value) for value in _evaluate_terms(torque, argument_counts, t, mu, attitude, velocity)]

    user_torque = terms if isinstance(user_torque, list) else user_torque
    try:
        torque, values = trace_callables_and_result_shapes(user_torque, evaluate_terms, *shapes)
    except InputError:  # of a torque of the library, which says what it needs
        raise
    except IndexOutOfRangeError as error:
        raise error.with_function(f"the torque, at a momentum of shape {algebra.shape},") from None
    except TRACE_ERRORS as error:
        what = f"the torque could not be evaluated on a momentum of shape {algebra.shape}"
        raise FunctionError(trace_error_message(what, error)) from error
    for term, value in zip(terms, values, strict=True):
        acts_on_body = value.shape == (3,) and begins_with_rotations(algebra)
        if (value.shape != algebra.shape and not acts_on_body) or not jnp.issubdtype(value.dtype, jnp.floating):
            raise FunctionError(
                f"the torque {torque_name(term)} must return real numbers of shape {algebra.shape}, as the momentum "
                f"has, got {value.dtype} of shape {value.shape}"
            )
    return torque, argument_counts


def _argument_shapes(algebra: mf.LieAlgebra, group: mf.MatrixGroup | None) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of the real arguments of a torque: t, mu, velocity, and of a complex attitude both parts."""
    shape = () if group is None else group.identity.shape
    # real and imaginary parts of complex groups are separate arguments: functions are traced for real arrays
    complex_group = group is not None and jnp.iscomplexobj(group.identity)
    return ((), algebra.shape, algebra.shape, *((shape,) * (2 if complex_group else 1)))


def evaluate_torque(torque: Any, argument_counts: tuple[int, ...], t, mu, attitude, velocity) -> jax.Array:
    """Return the torque, with the shape of mu: the sum of its terms, of which some act on three components only."""
    total = jnp.zeros_like(mu)
    for term in _evaluate_terms(torque, argument_counts, t, mu, attitude, velocity):
        term = jnp.asarray(term)
        total = total + (term if term.shape == mu.shape else jnp.concatenate([term, jnp.zeros(mu.shape[0] - 3)]))
    return total


@functools.lru_cache(maxsize=64)
def begins_with_rotations(algebra: mf.LieAlgebra) -> bool:
    """Return whether the first three basis elements are rotations and the others an ideal, as in se(3).

    The first three components of a velocity are then the angular velocity of a body, whatever it carries.
    """
    if len(algebra.shape) != 1 or not 3 <= algebra.dim <= MAX_UNROLLED_DIM:
        return False
    constants = np.asarray(algebra.structure_constants)  # [e_a, e_b] = sum_c constants[a, b, c] e_c
    rotations = constants[:3, :3]
    is_subalgebra = np.allclose(rotations[..., :3], mf.so(3).structure_constants) and not rotations[..., 3:].any()
    return bool(is_subalgebra and not constants[:, 3:, :3].any())


def torque_free_components(
    torque: Any, argument_counts: tuple[int, ...], algebra: mf.LieAlgebra, group: mf.MatrixGroup | None
) -> tuple[int, ...]:
    """Return the indices of the momentum components on which a torque never acts, whatever its parameters.

    A motor inside a body turns a wheel and changes no component of the angular momentum of the whole.
    """
    if algebra.dim > MAX_UNROLLED_DIM:
        return ()
    shapes = _argument_shapes(algebra, group)
    return tuple(
        sorted(vanishing_entry_indices(_evaluate_torque_from_real_arguments, (torque, argument_counts), *shapes))
    )


def _evaluate_torque_from_real_arguments(torque_and_counts: tuple, t, mu, velocity, *attitude_parts) -> jax.Array:
    """Return the torque from real arguments: a complex attitude is given as two arrays."""
    torque, counts = torque_and_counts
    g = attitude_parts[0] if len(attitude_parts) == 1 else attitude_parts[0] + 1j * attitude_parts[1]
    return evaluate_torque(torque, counts, t, mu, g, velocity)


def torque_name(torque: Any) -> str:
    """Return the name of a torque, for messages and provenance."""
    if isinstance(torque, list | tuple):
        return " + ".join(map(torque_name, torque))
    return callable_name(torque)


def _torque_terms(torque: Any) -> tuple[Callable, ...]:
    """Return the terms of a torque as a tuple of functions."""
    return tuple(torque) if isinstance(torque, list | tuple) else (torque,)


def _evaluate_terms(torque: Any, argument_counts: tuple[int, ...], t, mu, attitude, velocity) -> list:
    """Return the values of the terms of a torque in a list, each called with as many arguments as it takes."""
    terms, arguments = zip(_torque_terms(torque), argument_counts, strict=True), (t, mu, attitude, velocity)
    return [term(*arguments[:count]) for term, count in terms]


MAX_ARGUMENTS_WITHOUT_ATTITUDE = 2
"""Number of arguments above which a torque depends on the attitude: t alone, or t and mu, need none."""

MAX_ARGUMENTS = 4
"""Largest number of arguments of a torque: after t and mu the attitude, then the velocity ``dH/dmu``."""


def _checked_argument_count(term: Any) -> int:
    """Return the number of arguments of a term of a torque, 1 to 4; InputError if it cannot be a torque."""
    if not callable(term):
        raise InputError(
            "a torque must be a function of t, of (t, mu) or of (t, mu, attitude), such as "
            f"lt.torques.ConstantInBody([0.0, 0.0, 1.0]), got {type(term).__name__}"
        )
    if is_spline(term):
        raise InputError("a spline is a torque only in a wrapper. Use lt.torques.Tabulated(spline)")
    count = len(term.program.argument_avals) if isinstance(term, TracedFunction) else required_argument_count(term)
    if count is None or not 1 <= count <= MAX_ARGUMENTS:
        raise InputError(
            "a torque must be a function of (t), (t, mu), (t, mu, attitude) or (t, mu, attitude, dH/dmu), but "
            f"{torque_name(term)} needs {'an unknown number of' if count is None else count} arguments"
        )
    return count
