"""Conditions on parameters: checked at once for known values, recorded for a later check of traced values."""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced, real_array

from ..errors import InputError


class ParameterCondition(NamedTuple):
    """A condition on a parameter, for the constructor of its object and for values that are given by name later.

    Attributes
    ----------
    test : function from an array to an array of truth values
        Of each entry, or of each row.
    template : str
        The message of the error, with a placeholder: ``"a rate must be >= 0, got {value}"``.
    matrix_test : function from matrices, shape (..., n, n), to truth values, shape (...); optional
        The test of a value that is a matrix, for parameters that are a matrix or its diagonal.
    matrix_template : str
    """

    test: Callable
    template: str
    matrix_test: Callable | None = None
    matrix_template: str = ""

    @property
    def metadata(self) -> dict[str, ParameterCondition]:
        """Metadata of a field of a module, ``eqx.field(metadata=condition.metadata)``, whose values given by name have
        to meet the condition."""
        return {"condition": self}

    def require(self, value) -> None:
        """Raise InputError unless the condition holds for a value; record it for a traced value."""
        require_condition(value, *self._test_and_template(np.ndim(value)))

    def holds(self, value: np.ndarray) -> bool:
        """Return whether the condition holds for a value."""
        return bool(self._test_and_template(value.ndim)[0](value).all())

    def violations(self, values: np.ndarray) -> dict[int, str]:
        """Return the values along the first axis for which the condition does not hold, with the messages; NaN is left
        out."""
        test, template = self._test_and_template(values.ndim - 1)
        has_nan = np.isnan(values).reshape(len(values), -1).any(axis=1)
        holds = np.asarray(test(np.where(np.isnan(values), 1.0, values))).reshape(len(values), -1).all(axis=1)
        return {int(i): condition_message(template, values[i]) for i in np.flatnonzero(~holds & ~has_nan)}

    def _test_and_template(self, ndim: int) -> tuple[Callable, str]:
        if ndim == 2 and self.matrix_test is not None:
            return self.matrix_test, self.matrix_template
        return self.test, self.template


def positive_condition(name: str) -> ParameterCondition:
    """Return the condition that numbers are positive and finite."""
    return ParameterCondition(lambda a: (a > 0.0) & (a < np.inf), name + " must be positive and finite, got {value}")


def nonnegative_condition(name: str) -> ParameterCondition:
    """Return the condition that numbers are zero or positive, and finite."""
    return ParameterCondition(lambda a: (a >= 0.0) & (a < np.inf), name + " must be >= 0 and finite, got {value}")


def semidefinite_condition(name: str, symmetric: bool = True) -> ParameterCondition:
    """Return the condition that the entries of a diagonal are >= 0, or that a matrix is positive semidefinite.

    Without ``symmetric`` only its symmetric part has to be semidefinite.
    """
    matrix_text = "symmetric and positive semidefinite" if symmetric else "positive semidefinite"
    return ParameterCondition(
        lambda a: (a >= 0.0) & (a < np.inf),
        name + " must be >= 0 and finite, got {value}",
        _are_symmetric_and_semidefinite if symmetric else _are_semidefinite,
        f"{name} must be {matrix_text}, got {{value}}",
    )


def _are_symmetric_and_semidefinite(matrices):
    xp = np if isinstance(matrices, np.ndarray) else jnp
    asymmetry = xp.abs(matrices - xp.swapaxes(matrices, -1, -2)).max(axis=(-2, -1))
    return _are_semidefinite(matrices) & (asymmetry <= 1e-12 * xp.abs(matrices).max(axis=(-2, -1)))


def _are_semidefinite(matrices):
    xp = np if isinstance(matrices, np.ndarray) else jnp
    eigenvalues = xp.linalg.eigvalsh(0.5 * (matrices + xp.swapaxes(matrices, -1, -2)))
    return eigenvalues[..., 0] >= -1e-12 * matrices.shape[-1] * xp.abs(matrices).max(axis=(-2, -1))


def condition_of_field(owner: Any, name: str) -> ParameterCondition | None:
    """Return the condition of a field of a module; None if it has none."""
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    return next((field.metadata.get("condition") for field in fields if field.name == name), None)


class TracedCondition(NamedTuple):
    """A condition on a value that is being traced, recorded for a check with numbers.

    Attributes
    ----------
    holds : traced truth value
    value : traced array
    message : str
        The message of the error, with a placeholder: ``"a rate must be >= 0, got {value}"``.
    """

    holds: Any
    value: Any
    message: str


_collected_conditions: contextvars.ContextVar[list[TracedCondition] | None] = contextvars.ContextVar(
    "collected_conditions", default=None
)


@contextlib.contextmanager
def collect_conditions() -> Iterator[list[TracedCondition]]:
    """Collect the conditions on traced values inside a ``with`` block; a sweep evaluates them at every point."""
    conditions: list[TracedCondition] = []
    token = _collected_conditions.set(conditions)
    try:
        yield conditions
    finally:
        _collected_conditions.reset(token)


def require_condition(value, test: Callable, message_template: str) -> None:
    """Raise InputError unless a test is true for all entries of a value; record the test of a traced value.

    Parameters
    ----------
    value : array
    test : function from an array to an array of truth values
    message_template : str
        The message, with a placeholder ``{value}`` for the value as a list.

    Raises
    ------
    InputError
    """
    if is_traced(value):
        if (conditions := _collected_conditions.get()) is not None:
            conditions.append(TracedCondition(jnp.all(test(value)), value, message_template))
    elif not bool(np.all(test(np.asarray(value)))):
        raise InputError(condition_message(message_template, value))


def checked_numbers(value, quantity_name: str, *shapes: tuple[int, ...]) -> jax.Array:
    """Return a user's numbers as an array of float64; check its shape if shapes are given.

    Raises
    ------
    InputError
        If the value is not made of real numbers, or has another shape.
    """
    array = _converted_numbers(value, quantity_name, real_array)
    if shapes == ((),) and array.shape:
        raise InputError(f"{quantity_name} must be one number, got an array of shape {array.shape}")
    if shapes and array.shape not in shapes:
        raise InputError(f"{quantity_name} must have shape {' or '.join(map(str, shapes))}, got {array.shape}")
    return array


def checked_host_numbers(value, quantity_name: str) -> np.ndarray:
    """Return a user's numbers, none of them traced, as a NumPy array of float64.

    A conversion to an array of JAX takes longer than a short run.

    Raises
    ------
    InputError
        If the value is not made of real numbers.
    """
    if is_traced(value):
        return np.asarray(value)  # an error of JAX, for which callers say what to use under a transformation
    return _converted_numbers(value, quantity_name, lambda value: np.asarray(value, dtype=np.float64))


def host_number(value, quantity_name: str) -> float:
    """Return a user's number as a float.

    Raises
    ------
    InputError
        If the value is not one real number. A string is none, although ``float`` would convert it.
    """
    try:
        if isinstance(value, str | bytes):
            raise TypeError("a string")
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{quantity_name} must be a number, got {value!r:.60}") from None


def _converted_numbers(value, quantity_name: str, convert: Callable) -> Any:
    """Return ``convert(value)``; raise InputError unless the value is made of real numbers."""
    try:
        kind = "f" if is_traced(value) else (value if isinstance(value, jax.Array) else np.asarray(value)).dtype.kind
        if kind not in "biufO" or value is None:  # NumPy would convert strings to numbers, and None to NaN
            raise TypeError(f"not {kind}")
        return convert(value)
    except (TypeError, ValueError) as error:
        description = repr(value) if isinstance(value, str | complex | None) else type(value).__name__
        raise InputError(f"{quantity_name} must be made of real numbers, got {description}") from error


MAX_PRINTED_ENTRIES = 12
"""Largest array that a message prints whole: a matrix of rank 3, with some room."""


def condition_message(message_template: str, value) -> str:
    """Return the error message of a condition, from its template with a placeholder for the value.

    An array of more than :data:`MAX_PRINTED_ENTRIES` numbers is described by its shape and its range.
    """
    array = np.asarray(value)
    if array.size <= MAX_PRINTED_ENTRIES:
        return message_template.format(value=array.tolist())
    text = f"an array of shape {array.shape} with numbers from {array.min():.6g} to {array.max():.6g}"
    return message_template.format(value=text)
