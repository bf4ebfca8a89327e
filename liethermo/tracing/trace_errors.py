"""Messages for a user's function that cannot be traced: the cause and the cure first, JAX's message last."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend.core import Jaxpr
from jax.extend.core.primitives import convert_element_type_p

from manifolds._jaxprs import is_user_file, user_source_line

from ..errors import FunctionError
from .searches import iterate_equations

TRACE_ERRORS = (TypeError, ValueError, IndexError, AttributeError)
"""Exceptions that a call with traced arrays may raise."""

JAX_ERROR_REMEDIES = {
    jax.errors.TracerBoolConversionError: (
        "it uses a traced value in `if`, `while`, `and`, `or`, `min` or `max`",
        "Replace `if` by jnp.where or jax.lax.cond, and max(a, b) by jnp.maximum(a, b)",
    ),
    jax.errors.TracerArrayConversionError: (
        "it passes a traced value to NumPy",
        "Replace np by jax.numpy, such as np.sin by jnp.sin",
    ),
    jax.errors.TracerIntegerConversionError: (
        "it uses a traced value as a Python integer",
        "Index arrays of jax.numpy with it, and take loops of fixed length or jax.lax.fori_loop",
    ),
    jax.errors.NonConcreteBooleanIndexError: (
        "it selects entries by a traced condition, so their number is unknown",
        "Replace x[condition] by jnp.where(condition, x, 0.0)",
    ),
    jax.errors.ConcretizationTypeError: (
        "it converts a traced value to a Python number, as float and the functions of math do",
        "Leave out float, and replace math by jax.numpy, such as math.sin by jnp.sin",
    ),
}
"""Cause and remedy for each error that JAX raises if a traced value is used as a number."""


def trace_error_message(subject: str, error: BaseException, default_advice: str = "") -> str:
    """Return the message of the error that a function cannot be traced: subject, cause and remedy.

    Parameters
    ----------
    subject : str
        Names the function and its arguments, such as "the energy could not be evaluated on a state of shape (3,)".
    error : exception
        The exception that a call with traced arrays has raised.
    default_advice : str
        Advice for an unknown error.
    """
    for kind, (cause, remedy) in JAX_ERROR_REMEDIES.items():
        if isinstance(error, kind):
            jax_message = str(error).splitlines()[0].rstrip(".")
            return f"{subject}: {cause}{_user_line_in_parentheses(error)}. {remedy}. JAX reports: {jax_message}"
    if isinstance(error, FunctionError):
        return f"{subject}: {error}"
    message = f"{subject}: {type(error).__name__}: {error}".rstrip(".")
    return f"{message}. {default_advice}" if default_advice else message


def _user_line_in_parentheses(error: BaseException) -> str:
    """Return the line of the user's code that raised an error, in parentheses, or ""."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if is_user_file(Path(frame.filename)):
            return f" ({Path(frame.filename).name}:{frame.lineno}, in {frame.name})"
    return ""


def check_returned_value(value, name: str) -> None:
    """Raise FunctionError if a function returned None."""
    if value is None:
        raise FunctionError(f"{name} returns None. Add the missing `return`")


def check_precision(jaxpr: Jaxpr, name: str) -> None:
    """Raise FunctionError if the jaxpr of a function rounds double precision to single or less.

    Steps conserve the laws to the rounding of double precision, so no step with such a function could be solved.
    """
    for eqn, _ in iterate_equations(jaxpr):
        if eqn.primitive is convert_element_type_p:
            operand: Any = eqn.invars[0].aval
            dtype = np.dtype(eqn.params["new_dtype"])
            if operand.dtype == np.float64 and dtype.kind == "f" and dtype.itemsize < 8:
                raise FunctionError(
                    f"{name} rounds numbers to {dtype} ({user_source_line(eqn)}), "
                    "but the laws hold to the rounding of float64. "
                    f"Leave out {dtype}, such as astype(jnp.{dtype})"
                )
