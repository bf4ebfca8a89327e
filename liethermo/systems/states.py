"""Conversions of states: checks of those that users give, evaluation at batches of states, and shapes of lattices."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings

from ..errors import InputError
from ..tracing.programs import jit_unoptimised


def checked_state_array(system: Any, x, batch: bool = False) -> np.ndarray | jax.Array:
    """Return x as a checked state of a system, an array of JAX if JAX traces x, otherwise of NumPy."""
    if not isinstance(x, jax.Array):
        try:
            x = np.asarray(x)
        except (TypeError, ValueError) as error:
            raise InputError(f"a state must be a rectangular array of real numbers: {error}") from None
        if x.dtype.kind not in "fiubc":
            raise InputError(f"a state must be an array of real numbers, got {x.dtype}")
    if system.space is not None and x.shape[-len(system.space.shape) :] == system.space.shape:
        x = system.space.to_vector(x)
    if system.sites and x.shape[-len(system.shape) :] == system.shape:
        x = x.reshape(*x.shape[: -len(system.shape)], system.dim)
    if x.shape[-1:] != (system.dim,):
        x = _append_zero_bath_entropies(system, x)
    if jnp.iscomplexobj(x):
        raise InputError(f"a state must be real, got {x.dtype}. Take its real part if that is meant")
    if x.shape[-1:] != (system.dim,) or (x.ndim > 1 and not batch):
        expected_shape = f"(..., {system.dim})" if batch else f"({system.dim},)"
        if system.sites:
            site_shape = ", ".join([*(["..."] if batch else []), *map(str, system.shape)])
            expected_shape = f"({site_shape}), or flat {expected_shape}"
        raise InputError(f"a state of this system must have shape {expected_shape}, got {x.shape}")
    if isinstance(x, jax.core.Tracer):
        return x
    numbers = np.asarray(x, dtype=np.float64)
    if not np.isfinite(numbers).all():
        first_bad_index = tuple(int(i) for i in np.argwhere(~np.isfinite(numbers))[0])
        raise InputError(f"the state is not finite: component {first_bad_index} is {numbers[first_bad_index]}")
    if system.space is not None:
        system.space.point(system.points(numbers))
    return numbers


def _append_zero_bath_entropies(system: Any, x) -> np.ndarray | jax.Array:
    """Return a state of the body with zero bath entropies appended; any other array unchanged."""
    body = system.drop_baths()
    shape = body.shape if body.space is None else body.space.shape
    if shape == (1, 3) and x.shape == (3,):
        x = x[None]
    if x.shape[-len(shape) :] == shape:
        vectors = x.reshape(*x.shape[: -len(shape)], -1) if body.space is None else body.space.to_vector(x)
    elif x.shape[-1:] == (body.dim,):
        vectors = x
    else:
        return x
    zeros = np.zeros((*vectors.shape[:-1], system.dim - body.dim))
    return (jnp if isinstance(x, jax.Array) else np).concatenate([vectors, zeros], axis=-1)


@with_library_settings
def evaluate_batch(system: Any, function: Callable, x, t, result_signature: str) -> jax.Array:
    """Return ``function(system, x)`` for each state of a batch, with the system frozen at its time t.

    Parameters
    ----------
    function : function of a system and a state
        Defined in a module: programs are cached by it.
    result_signature : str
        The shape of one result, as in ``"(n)"``.

    Raises
    ------
    InputError
        If a time is needed and none is given.
    """
    x, t = system.state(x, batch=True), checked_times(system, t)
    evaluate = _evaluate_batch if is_traced((system, x, t)) else _evaluate_batch_program
    return evaluate(system, function, x, t, result_signature)


def checked_times(system: Any, t) -> jax.Array | None:
    """Return the times of states as an array; None for a system that does not depend on time.

    Raises
    ------
    InputError
        If a time is needed and none is given.
    """
    if not system.is_driven:
        return None
    if t is None:
        what = (
            "energy of this system depends on" if system.energy.depends_on_time else "torque of this system depends on"
        )
        raise InputError(f"the {what} time. Give the time beside the state")
    return jnp.asarray(t, dtype=jnp.float64)


def _evaluate_batch(system: Any, function: Callable, x, t, result_signature: str) -> jax.Array:
    """Return ``function(system, x)`` for each state of a batch, traced by JAX operation by operation."""
    if t is None:
        return jnp.vectorize(lambda y: function(system, y), signature=f"(n)->{result_signature}")(x)
    evaluate = jnp.vectorize(lambda y, t: function(system.at_time(t), y), signature=f"(n),()->{result_signature}")
    return evaluate(x, t)


_evaluate_batch_program = jit_unoptimised(_evaluate_batch)
"""Compiled form of :func:`_evaluate_batch`: one program, where a direct call compiles each operation by itself."""


def reshape_to_sites(system: Any, solution: Any) -> Any:
    """Return a solution or an ensemble with its states, shape (..., n), reshaped to (..., *sites, d)."""
    while system.inner_system is not None:
        system = system.inner_system
    if not system.sites:
        return solution
    states = {name: value for name in solution.state_fields if (value := getattr(solution, name)) is not None}
    reshaped_states = {name: value.reshape(*value.shape[:-1], *system.shape) for name, value in states.items()}
    return dataclasses.replace(solution, **reshaped_states)
