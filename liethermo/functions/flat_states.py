"""Functions of states in the shape that users see, as functions of flat states."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax

from manifolds._pytree_module import Module

from ..tracing.short_form import callable_name
from .energy import Energy, Function, TimeDependent, map_operands


def functions_of_flat_states(tree, shape: tuple[int, ...]):
    """Return a pytree with plain functions of states of this shape replaced by functions of flat states, shape (n,).

    Energies of other classes and Casimirs of algebras are functions of flat states already.
    """
    if len(shape) == 1:
        return tree
    return jax.tree_util.tree_map(
        lambda node: _energy_of_flat_states(node, shape) if isinstance(node, Energy) else node,
        tree,
        is_leaf=lambda node: isinstance(node, Energy),
    )


def _energy_of_flat_states(energy: Energy, shape: tuple[int, ...]) -> Energy:
    """Return an energy whose plain functions of states of this shape became functions of flat states."""
    if isinstance(energy, Function | TimeDependent):
        is_flat = getattr(energy.function, "dim", None) == math.prod(shape)  # a Casimir of the whole algebra
        return energy if is_flat else type(energy)(_FunctionOfFlatState(energy.function, shape))
    return map_operands(energy, lambda operand: _energy_of_flat_states(operand, shape))


class _FunctionOfFlatState(Module):
    """A function of states of some shape, as a function of flat states."""

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return callable_name(self.function)

    def __call__(self, x, *time):
        return self.function(x.reshape(self.shape), *time)
