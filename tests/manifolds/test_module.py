"""Base class of pytrees: methods are ordinary ones, and pytrees if another module stores them."""

import types

import jax
import jax.numpy as jnp

from manifolds._pytree_module import Module


class ScaledNorm(Module):
    factor: jax.Array

    def value(self, x):
        return self.factor * jnp.sum(x**2)


class Holder(Module):
    functions: tuple

    def __call__(self, x):
        return sum(f(x) for f in self.functions)


def test_methods_are_ordinary_ones():
    assert isinstance(ScaledNorm(jnp.array(2.0)).value, types.MethodType)


def test_a_method_that_is_kept_has_the_parameters_of_its_object():
    holder = Holder((ScaledNorm(jnp.array(2.0)).value, jnp.sum))
    assert [float(leaf) for leaf in jax.tree_util.tree_leaves(holder) if isinstance(leaf, jax.Array)] == [2.0]
    x = jnp.array([1.0, 2.0])
    assert holder(x) == 13.0
    doubled_holder = jax.tree_util.tree_map(lambda leaf: 2 * leaf if isinstance(leaf, jax.Array) else leaf, holder)
    assert doubled_holder(x) == 23.0
