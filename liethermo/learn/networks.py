"""Networks that are functions of states in the units of data, and the mark of what is learned."""

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
    """The mark of what is learned: floating-point arrays inside are parameters of :func:`liethermo.learn.fit`.

    Called, it is the function that it holds. All that is outside of such marks stays as it is.

    Parameters
    ----------
    function : function of arrays, such as an ``equinox.Module``
    """

    function: Callable

    def __call__(self, *arguments):
        return _call_jitted(self.function, arguments)


@eqx.filter_jit
def _call_jitted(function: Callable, arguments: tuple):
    """A call that is traced once: machine code has one routine for all of its places."""
    return function(*arguments)


class Perceptron(Module):
    """A multilayer perceptron ``W_d tanh(... tanh(W_0 x + b_0) ...) + b_d``, with random weights.

    Parameters
    ----------
    sizes : sequence of int
        Of the input, the hidden layers and the output.
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
    """``unit * function((x - centre) / size)``: a function whose inputs and outputs are of the size of one.

    Attributes
    ----------
    centre, scale : array, shape (m,)
        Of the inputs: mean and spread of the data, which :func:`liethermo.learn.fit` fills in.
    output_scale : array, shape (outputs,)
        Of the outputs, likewise.
    function : Learned
    """

    centre: jax.Array
    scale: jax.Array
    output_scale: jax.Array
    function: Learned

    @classmethod
    def from_sizes(cls, dim: int, outputs: int, width: int, depth: int, seed: int) -> Network:
        """A perceptron with ``depth`` hidden layers of ``width`` neurons."""
        for name, value in {"the number of components": dim, "width": width, "depth": depth}.items():
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(f"{name} is a positive integer, not {value!r}")
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise InputError(f"seed is an integer >= 0, not {seed!r}")
        layers = Perceptron([dim, *[width] * depth, outputs], int(seed))
        return cls(jnp.zeros(dim), jnp.ones(dim), jnp.ones(outputs), Learned(layers))

    @property
    def has_default_scales(self) -> bool:
        """Whether nothing is known yet of its inputs."""
        fields = ((self.centre, 0.0), (self.scale, 1.0), (self.output_scale, 1.0))
        return all(bool(np.all(np.asarray(values) == first)) for values, first in fields)

    def __call__(self, x):
        return self.output_scale * self.function((x - self.centre) / self.scale)


def learned_mask(tree: Any) -> Any:
    """Which leaves of a pytree are learned: a tree of True and False, one False for a part without any.

    Numbers that a plain function inside of a mark is written with are none.
    """

    def is_parameter(part):
        return False if isinstance(part, TracedFunction) else eqx.is_inexact_array(part)

    def mask_part(part):
        if not isinstance(part, Learned):
            return False
        return jax.tree_util.tree_map(is_parameter, part, is_leaf=lambda leaf: isinstance(leaf, TracedFunction))

    return jax.tree_util.tree_map(mask_part, tree, is_leaf=lambda part: isinstance(part, Learned))
