"""Events that end a run: zeros of a user's function, and the relaxation of the state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds._pytree_module import Module

from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..systems import System
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import trace_callables


@dataclass(frozen=True)
class Relaxed:
    """The event that the entropy production falls below ``tol`` (per unit of time), for ``integrate(until=...)``.

    Some systems produce no entropy, but their energy falls, as under a :class:`liethermo.DoubleBracket`. For these the
    rate at which the dissipation lowers the energy is used instead.

    The rate may be below ``tol`` at the start, as near an unstable equilibrium. It then has to rise above it first.

    Parameters
    ----------
    tol : float, > 0
        The rate (entropy / time, or energy / time if the energy falls) below which the run stops.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 1e4), lt.Adaptive(1e-8), until=lt.Relaxed(1e-6))
    >>> run.status.code
    'event'
    """

    tol: float

    def __post_init__(self):
        if not (math.isfinite(self.tol) and self.tol > 0.0):
            raise InputError(f"tol must be positive and finite, got {self.tol!r}")


class Event:
    """An event function of system and state, whose sign changes the engines detect.

    Parameters
    ----------
    until : Relaxed or function from a state, shape (n,), to a scalar
    system : System

    Attributes
    ----------
    function : pytree
        Function of a system and a state, for engines.
    falling_only : bool
        True if only a fall through zero is an event.
    """

    def __init__(self, until: Relaxed | Callable, system: System):
        self.falling_only = isinstance(until, Relaxed)
        self.name = "the event function"
        if isinstance(until, Relaxed):
            if system.entropy_law == "nondecreasing":  # the laws say which rate vanishes as the system relaxes
                rate, name = "entropy_production", "entropy production"
            elif system.energy_law == "nonincreasing":
                rate, name = "energy_fall", "fall of the energy"
            else:
                raise InputError(
                    "Relaxed(tol) needs a system that produces entropy or loses energy, and this system promises "
                    "neither. Give a function of the state as until"
                )
            self.name = f"{name} below {until.tol:g}"
            self.function: Any = RateAboveThreshold(jnp.asarray(until.tol), rate)
        elif callable(until):
            user_state = jax.eval_shape(system.user_state, jax.ShapeDtypeStruct((system.dim,), jnp.float64))
            try:
                self.function = UserStateFunction(trace_callables(until, lambda f, x: f(x), user_state.shape))
            except IndexOutOfRangeError as error:
                raise error.with_function(f"the event function, at a state of shape {user_state.shape},") from None
            except TRACE_ERRORS as error:
                description = f"the event function could not be evaluated on a state of shape {user_state.shape}"
                raise FunctionError(trace_error_message(description, error)) from error
        else:
            raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, got {until!r}")
        x = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
        output = jax.eval_shape(lambda x: self.function(system, x), x)
        if getattr(output, "shape", None) != ():
            shape = getattr(output, "shape", type(output).__name__)
            raise FunctionError(
                f"the event function must return one number, got shape {shape}. For several events, return the "
                "smallest one, jnp.min, or the product"
            )


class RateAboveThreshold(Module):
    """A rate of a system minus a threshold."""

    threshold: jax.Array
    rate_name: str = eqx.field(static=True)

    def __call__(self, system: System, x):
        return getattr(system, self.rate_name)(x) - self.threshold


class UserStateFunction(Module):
    """A user's event function, applied to the state in the user's form."""

    function: Callable

    def __call__(self, system: System, x):
        return self.function(system.user_state(x))
