"""Functions of NumPy in a program of JAX: by the functions of ``jax.numpy`` with their names, or called in Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from manifolds._pytree_module import Module


class NumpyCompatibleArray(NDArrayOperatorsMixin):
    """A JAX array that NumPy's functions accept: each calls the function of ``jax.numpy`` that has its name."""

    def __init__(self, array: jax.Array):
        self.array = array

    def __array_ufunc__(self, ufunc, method, *inputs, **keywords):
        if method != "__call__" or keywords:
            return NotImplemented
        return _wrap_arrays(getattr(jnp, ufunc.__name__)(*map(unwrap_array, inputs)))

    def __array_function__(self, function, types, arguments, keywords):
        module = jnp.linalg if function.__module__ == "numpy.linalg" else jnp
        arguments, keywords = jax.tree_util.tree_map(unwrap_array, (arguments, keywords))
        return _wrap_arrays(getattr(module, function.__name__)(*arguments, **keywords))

    def __getattr__(self, name: str):
        value = getattr(self.array, name)
        if not callable(value):
            return _wrap_arrays(value)
        return lambda *arguments, **keywords: _wrap_arrays(value(*map(unwrap_array, arguments), **keywords))

    def __getitem__(self, index):
        return _wrap_arrays(self.array[unwrap_array(index)])

    def __iter__(self):
        return map(_wrap_arrays, iter(self.array))

    def __len__(self) -> int:
        return len(self.array)

    def __bool__(self) -> bool:
        return bool(self.array)

    def __float__(self) -> float:
        return float(self.array)

    def __array__(self, *arguments, **keywords):
        return np.asarray(self.array)


def unwrap_array(value: Any) -> Any:
    """Return the array of a :class:`NumpyCompatibleArray`; other values are returned unchanged."""
    return value.array if isinstance(value, NumpyCompatibleArray) else value


def _wrap_arrays(value: Any) -> Any:
    """Return a pytree with each JAX array in it as a :class:`NumpyCompatibleArray`."""
    return jax.tree_util.tree_map(lambda a: NumpyCompatibleArray(a) if isinstance(a, jax.Array) else a, value)


def accept_jax_arrays(function: Callable) -> Callable:
    """Return a function that accepts and returns JAX arrays, from a function written with NumPy."""

    def call(*arguments):
        return jnp.asarray(unwrap_array(function(*map(_wrap_arrays, arguments))), dtype=jnp.float64)

    return call


class PythonCall(Module):
    """A function from arrays to a number that cannot be traced, so that programs call it in Python.

    An exception of the function is kept, and the value is NaN: see :meth:`raise_first_error`.
    """

    function: Callable = eqx.field(static=True)
    errors: _HashableErrorList = eqx.field(static=True)

    def __init__(self, function: Callable):
        self.function, self.errors = function, _HashableErrorList()

    def __call__(self, *arguments) -> jax.Array:
        result = jax.ShapeDtypeStruct((), jnp.float64)
        return jax.pure_callback(self._evaluate_in_python, result, *arguments, vmap_method="sequential")

    def _evaluate_in_python(self, *arguments) -> np.ndarray:
        """Return the value of the function, shape (); if it raises, store the exception and return NaN."""
        try:
            return np.asarray(self.function(*map(np.asarray, arguments)), dtype=np.float64).reshape(())
        except Exception as error:
            self.errors.append(error)
            return np.asarray(np.nan)

    def raise_first_error(self) -> None:
        """Raise the first exception of the function since the last call of this method."""
        if self.errors:
            error, *_ = self.errors
            self.errors.clear()
            raise error


class _HashableErrorList(list):
    """A list of exceptions that is hashed and compared by identity."""

    def __hash__(self) -> int:  # type: ignore[override]
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other
