"""Functions that are traced once, so that later changes of the values they read have no effect."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from ._content_keys import content_key


class FrozenFunction:
    """Function of one array, traced for a given shape; instances with equal operations and numbers are equal.

    Programs are kept by the spaces that they belong to. A space must therefore not equal another one whose function
    read other numbers when it was given, though both were given the same function object.

    Parameters
    ----------
    function : function from an array of the shape to an array
    shape : tuple of int

    Attributes
    ----------
    closed_jaxpr : ClosedJaxpr
    """

    def __init__(self, function: Callable, shape: tuple[int, ...]):
        self.function, self.shape = function, shape
        x = jax.ShapeDtypeStruct(shape, jnp.float64)
        # a new lambda, since JAX caches the trace of a function
        self.closed_jaxpr: ClosedJaxpr = jax.make_jaxpr(lambda x: jnp.asarray(function(x)))(x)
        self._key = content_key(self.closed_jaxpr)

    def __call__(self, x):
        return jaxpr_as_fun(self.closed_jaxpr)(jnp.asarray(x, dtype=jnp.float64))[0]

    def __eq__(self, other) -> bool:
        return isinstance(other, FrozenFunction) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self):
        return FrozenFunction, (self.function, self.shape)
