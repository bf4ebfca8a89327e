"""Neural networks as functions of states in the units of the data, and the mark of learned parts."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..errors import InputError
from ..tracing.traced import TracedFunction


class Learned(Module):
    """Mark of a learned function: floating-point arrays inside it are parameters of :func:`liethermo.learn.fit`.

    Calling it calls the function. Arrays outside of such marks are not changed by a fit.

    Parameters
    ----------
    function : function of arrays, such as an ``equinox.Module``
    """

    function: Callable

    def __call__(self, *arguments):
        return _call_jitted(self.function, arguments)


@eqx.filter_jit
def _call_jitted(function: Callable, arguments: tuple):
    """Call a function under ``jit``, so that compiled programs contain one routine for all calls."""
    return function(*arguments)


class Perceptron(Module):
    """A multilayer perceptron ``W_d tanh(... tanh(W_0 x + b_0) ...) + b_d``, with random weights.

    Parameters
    ----------
    sizes : sequence of int
        Widths of the input, the hidden layers and the output.
    seed : int
    """

    weights: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]

    def __init__(self, sizes, seed: int):
        random = np.random.default_rng(seed)
        pairs = list(itertools.pairwise(sizes))
        self.weights = tuple(jnp.asarray(random.standard_normal((m, n)) / np.sqrt(n)) for n, m in pairs)
        self.biases = tuple(jnp.asarray(0.1 * random.standard_normal(m)) for _, m in pairs)

    def __call__(self, x):
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = jnp.tanh(W @ x + b)
        return self.weights[-1] @ x + self.biases[-1]


class Network(Module):
    """A scaled network ``output_scale * function((x - centre) / scale)`` whose inner values are of order one.

    Attributes
    ----------
    centre, scale : array, shape (m,)
        Mean and standard deviation of the inputs over the data, which :func:`liethermo.learn.fit` fills in.
    output_scale : array, shape (outputs,)
        Scale of the outputs, which :func:`liethermo.learn.fit` fills in.
    function : Learned
    """

    centre: jax.Array
    scale: jax.Array
    output_scale: jax.Array
    function: Learned

    @classmethod
    def from_sizes(cls, dim: int, outputs: int, width: int, depth: int, seed: int) -> Network:
        """Return a perceptron with ``depth`` hidden layers of ``width`` neurons, with default scales."""
        for name, value in {"the number of components": dim, "width": width, "depth": depth}.items():
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(f"{name} must be a positive integer, got {value!r}")
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise InputError(f"seed must be an integer >= 0, got {seed!r}")
        layers = Perceptron([dim, *[width] * depth, outputs], int(seed))
        return cls(jnp.zeros(dim), jnp.ones(dim), jnp.ones(outputs), Learned(layers))

    @property
    def has_default_scales(self) -> bool:
        """True if no scales have been filled in."""
        fields = ((self.centre, 0.0), (self.scale, 1.0), (self.output_scale, 1.0))
        return all(bool(np.all(np.asarray(values) == default)) for values, default in fields)

    def __call__(self, x):
        return self.output_scale * self.function((x - self.centre) / self.scale)


def learned_mask(tree: Any) -> Any:
    """Return a pytree that is True for learned leaves; a part without any is a single False.

    Constants in plain functions inside a mark are not learned.
    """

    def is_parameter(part):
        return False if isinstance(part, TracedFunction) else eqx.is_inexact_array(part)

    def mask_part(part):
        if not isinstance(part, Learned):
            return False
        return jax.tree_util.tree_map(is_parameter, part, is_leaf=lambda leaf: isinstance(leaf, TracedFunction))

    return jax.tree_util.tree_map(mask_part, tree, is_leaf=lambda part: isinstance(part, Learned))
