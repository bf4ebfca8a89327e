"""Torques: what acts on a body from outside, as functions of the time, the momentum and the attitude."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import manifolds as mf

from ..errors import FunctionError, InputError
from ..functions.arguments import required_argument_count
from ..tracing.interpret import MAX_UNROLLED_DIM, vanishing_entries
from ..tracing.trace_errors import TRACE_ERRORS, explain_trace_error
from ..tracing.traced import TracedFunction, trace_callables_with_result


def check_torque(given: Any, algebra: mf.LieAlgebra, group: mf.MatrixGroup | None) -> tuple[Any, tuple[bool, ...]]:
    """What a system is given as its torque, its plain functions traced; and which of its parts need the attitude.

    Raises
    ------
    InputError, FunctionError
        If it is no function of t and mu, or of t, mu and the attitude, to a dual vector; or if there is no attitude.
    """
    if given is None:
        return None, ()
    parts = _torque_terms(given)
    if not parts:
        raise InputError("torque is an empty list: a system without a torque is given None")
    needs = tuple(map(_needs_attitude, parts))
    if any(needs) and group is None:
        name = torque_name(parts[needs.index(True)])
        raise InputError(f"the torque {name} depends on the attitude: give the system a group, such as group=mf.SO(3)")
    shape = () if group is None else group.identity.shape
    # of complex groups both parts, since what is traced here is traced for real arrays
    complex_group = group is not None and jnp.iscomplexobj(group.identity)
    shapes = ((), algebra.shape, *((shape,) * (2 if complex_group else 1)))

    def evaluate_terms(torque, t, mu, *g):
        attitude = g[0] if len(g) == 1 else g[0] + 1j * g[1]
        return [jnp.asarray(part) for part in _evaluate_terms(torque, needs, t, mu, attitude)]

    given = parts if isinstance(given, list) else given
    try:
        torque, found = trace_callables_with_result(given, evaluate_terms, *shapes)
    except TRACE_ERRORS as error:
        what = f"the torque could not be evaluated on a momentum of shape {algebra.shape}"
        raise FunctionError(explain_trace_error(what, error)) from error
    for part, result in zip(parts, found, strict=True):
        if result.shape != algebra.shape or not jnp.issubdtype(result.dtype, jnp.floating):
            raise FunctionError(
                f"the torque {torque_name(part)} must return real numbers of shape {algebra.shape}, as the momentum has, "
                f"not {result.dtype} of shape {result.shape}"
            )
    return torque, needs


def evaluate_torque(torque: Any, needs: tuple[bool, ...], t, mu, attitude) -> jax.Array:
    """The sum of the parts, of the shape of mu."""
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
    return tuple(sorted(vanishing_entries(_torque_of_model, (torque, needs), *shapes)))


def _torque_of_model(model: tuple, t, mu, *attitude) -> jax.Array:
    torque, needs = model
    g = attitude[0] if len(attitude) == 1 else attitude[0] + 1j * attitude[1]
    return evaluate_torque(torque, needs, t, mu, g)


def torque_name(torque: Any) -> str:
    """What a torque is called, in messages and in provenances."""
    if isinstance(torque, list | tuple):
        return " + ".join(map(torque_name, torque))
    return getattr(torque, "__name__", type(torque).__name__)


def _torque_terms(torque: Any) -> tuple[Callable, ...]:
    return tuple(torque) if isinstance(torque, list | tuple) else (torque,)


def _evaluate_terms(torque: Any, needs: tuple[bool, ...], t, mu, attitude) -> list:
    parts = zip(_torque_terms(torque), needs, strict=True)
    return [part(t, mu, attitude) if turned else part(t, mu) for part, turned in parts]


def _needs_attitude(part: Any) -> bool:
    if not callable(part):
        raise InputError(
            "a torque is a function of t and mu, or of t, mu and the attitude, such as "
            f"lt.torques.ConstantInBody([0.0, 0.0, 1.0]), not {type(part).__name__}"
        )
    number = len(part.program.argument_avals) if isinstance(part, TracedFunction) else required_argument_count(part)
    if number not in (2, 3):
        raise InputError(
            f"a torque is a function of t and mu, or of t, mu and the attitude, and {torque_name(part)} needs "
            f"{'an unknown number of' if number is None else number} arguments"
        )
    return number == 3
