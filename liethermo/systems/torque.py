"""Torques on a body from outside: functions of the time, the momentum and the attitude."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import manifolds as mf

from ..errors import FunctionError, InputError
from ..functions.arguments import required_argument_count
from ..tracing.interpret import MAX_UNROLLED_DIM, vanishing_entry_indices
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import TracedFunction, trace_callables_and_result_shapes


def check_torque(given: Any, algebra: mf.LieAlgebra, group: mf.MatrixGroup | None) -> tuple[Any, tuple[bool, ...]]:
    """Return a checked torque with its plain functions traced, and which of its terms need the attitude.

    Raises
    ------
    InputError, FunctionError
        If it is no function of t and mu, or of t, mu and the attitude, to a dual vector; or if there is no attitude.
    """
    if given is None:
        return None, ()
    terms = _torque_terms(given)
    if not terms:
        raise InputError("torque is an empty list: a system without a torque is given None")
    needs = tuple(map(_needs_attitude, terms))
    if any(needs) and group is None:
        name = torque_name(terms[needs.index(True)])
        raise InputError(f"the torque {name} depends on the attitude: give the system a group, such as group=mf.SO(3)")
    shape = () if group is None else group.identity.shape
    # real and imaginary parts of complex groups are separate arguments: functions are traced for real arrays
    complex_group = group is not None and jnp.iscomplexobj(group.identity)
    shapes = ((), algebra.shape, *((shape,) * (2 if complex_group else 1)))

    def evaluate_terms(torque, t, mu, *g):
        attitude = g[0] if len(g) == 1 else g[0] + 1j * g[1]
        return [jnp.asarray(value) for value in _evaluate_terms(torque, needs, t, mu, attitude)]

    given = terms if isinstance(given, list) else given
    try:
        torque, values = trace_callables_and_result_shapes(given, evaluate_terms, *shapes)
    except TRACE_ERRORS as error:
        what = f"the torque could not be evaluated on a momentum of shape {algebra.shape}"
        raise FunctionError(trace_error_message(what, error)) from error
    for term, value in zip(terms, values, strict=True):
        if value.shape != algebra.shape or not jnp.issubdtype(value.dtype, jnp.floating):
            raise FunctionError(
                f"the torque {torque_name(term)} must return real numbers of shape {algebra.shape}, as the momentum "
                f"has, not {value.dtype} of shape {value.shape}"
            )
    return torque, needs


def evaluate_torque(torque: Any, needs: tuple[bool, ...], t, mu, attitude) -> jax.Array:
    """Return the sum of the terms of a torque, with the shape of mu."""
    return sum(_evaluate_terms(torque, needs, t, mu, attitude), jnp.zeros_like(mu))


def torque_free_components(
    torque: Any, needs: tuple[bool, ...], algebra: mf.LieAlgebra, group: mf.MatrixGroup | None
) -> tuple[int, ...]:
    """Return the components of the momentum on which a torque does not act, whatever its parameters.

    A motor inside a body turns a wheel and changes no component of the angular momentum of the whole.
    """
    if algebra.dim > MAX_UNROLLED_DIM:
        return ()
    shape = () if group is None else group.identity.shape
    complex_group = group is not None and jnp.iscomplexobj(group.identity)
    shapes = ((), algebra.shape, *((shape,) * (2 if complex_group else 1)))
    return tuple(sorted(vanishing_entry_indices(_torque_of_model, (torque, needs), *shapes)))


def _torque_of_model(model: tuple, t, mu, *attitude) -> jax.Array:
    torque, needs = model
    g = attitude[0] if len(attitude) == 1 else attitude[0] + 1j * attitude[1]
    return evaluate_torque(torque, needs, t, mu, g)


def torque_name(torque: Any) -> str:
    """Return the name of a torque, for messages and provenances."""
    if isinstance(torque, list | tuple):
        return " + ".join(map(torque_name, torque))
    return getattr(torque, "__name__", type(torque).__name__)


def _torque_terms(torque: Any) -> tuple[Callable, ...]:
    return tuple(torque) if isinstance(torque, list | tuple) else (torque,)


def _evaluate_terms(torque: Any, needs: tuple[bool, ...], t, mu, attitude) -> list:
    terms = zip(_torque_terms(torque), needs, strict=True)
    return [term(t, mu, attitude) if needs_attitude else term(t, mu) for term, needs_attitude in terms]


def _needs_attitude(term: Any) -> bool:
    if not callable(term):
        raise InputError(
            "a torque is a function of t and mu, or of t, mu and the attitude, such as "
            f"lt.torques.ConstantInBody([0.0, 0.0, 1.0]), not {type(term).__name__}"
        )
    count = len(term.program.argument_avals) if isinstance(term, TracedFunction) else required_argument_count(term)
    if count not in (2, 3):
        raise InputError(
            f"a torque is a function of t and mu, or of t, mu and the attitude, and {torque_name(term)} needs "
            f"{'an unknown number of' if count is None else count} arguments"
        )
    return count == 3
