"""Split of systems and methods into a structure, which is compiled, and parameters, its arguments."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ...tracing.caching import memoize


@dataclass(frozen=True)
class ProgramStructure:
    """A structure shared by systems, methods or step controls that differ only in values of their parameters.

    Attributes
    ----------
    key : hashable
        Equal for equal structures.
    shapes : tuple of shapes
        Shapes of the parameters, which are arrays.
    rebuild : function from a list of arrays to a module with these parameters
    """

    key: Any
    shapes: tuple[tuple[int, ...], ...]
    rebuild: Callable[[list], Any] = field(compare=False)

    @staticmethod
    @memoize
    def from_module(module: eqx.Module) -> ProgramStructure:
        """Return the structure of a module; its parameters are the arrays among its leaves."""
        dynamic, static = eqx.partition(module, eqx.is_inexact_array)
        leaves, structure = jax.tree_util.tree_flatten(dynamic)
        static_leaves, static_structure = jax.tree_util.tree_flatten(static)
        return ProgramStructure(
            (structure, static_structure, tuple(static_leaves)),
            tuple(np.shape(leaf) for leaf in leaves),
            lambda arrays: eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static),
        )

    @property
    def n_parameters(self) -> int:
        """Total number of entries of the parameter arrays."""
        return sum(map(math.prod, self.shapes))

    def build(self, p) -> Any:
        """Return the module whose parameter arrays, flattened and joined, are p, shape (n_parameters,)."""
        ends = list(itertools.accumulate(map(math.prod, self.shapes)))
        arrays = [p[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, self.shapes, strict=True)]
        return self.rebuild(arrays)


@memoize
def parameter_arrays(module: eqx.Module) -> tuple[np.ndarray, ...]:
    """Return the parameter arrays of a system, a method or a step control."""
    leaves = jax.tree_util.tree_leaves(eqx.filter(module, eqx.is_inexact_array))
    return tuple(np.asarray(leaf, dtype=np.float64) for leaf in leaves)


def flat_parameters(*modules: eqx.Module) -> np.ndarray:
    """Return the parameter arrays of systems, methods or step controls, flattened and joined, shape (p,)."""
    return np.concatenate([np.zeros(0), *(array.ravel() for module in modules for array in parameter_arrays(module))])
