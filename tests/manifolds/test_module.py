"""The base of all pytrees: methods are ordinary ones, and pytrees where another module keeps them."""

import types

import jax
import jax.numpy as jnp

from manifolds._pytree_module import Module


class Scaled(Module):
    factor: jax.Array

    def value(self, x):
        return self.factor * jnp.sum(x**2)


class Holder(Module):
    functions: tuple

    def __call__(self, x):
        return sum(f(x) for f in self.functions)


def test_methods_are_ordinary_ones():
    assert isinstance(Scaled(jnp.array(2.0)).value, types.MethodType)


def test_a_method_that_is_kept_has_the_parameters_of_its_object():
    held = Holder((Scaled(jnp.array(2.0)).value, jnp.sum))
    assert [float(leaf) for leaf in jax.tree_util.tree_leaves(held) if isinstance(leaf, jax.Array)] == [2.0]
    x = jnp.array([1.0, 2.0])
    assert held(x) == 13.0
    twice = jax.tree_util.tree_map(lambda leaf: 2 * leaf if isinstance(leaf, jax.Array) else leaf, held)
    assert twice(x) == 23.0
