"""What systems and methods are to the compiled engine: a form, which is compiled, and parameters, its arguments."""

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
    """What systems, or methods, have in common that differ in their parameters.

    Attributes
    ----------
    key : hashable
        The same for the same form.
    shapes : tuple of shapes
        Of the parameters, which are arrays.
    rebuild : function from a list of arrays to one of them
    """

    key: Any
    shapes: tuple[tuple[int, ...], ...]
    rebuild: Callable[[list], Any] = field(compare=False)

    @staticmethod
    @memoize
    def from_module(module: eqx.Module) -> ProgramStructure:
        """The form of a system, a method or a pacing, its parameters being the arrays among its leaves."""
        dynamic, static = eqx.partition(module, eqx.is_inexact_array)
        leaves, structure = jax.tree_util.tree_flatten(dynamic)
        static_leaves, static_structure = jax.tree_util.tree_flatten(static)
        return ProgramStructure(
            (static_structure, tuple(static_leaves)),
            tuple(np.shape(leaf) for leaf in leaves),
            lambda arrays: eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static),
        )

    @property
    def n_parameters(self) -> int:
        """How many numbers the parameters are."""
        return sum(map(math.prod, self.shapes))

    def build(self, p) -> Any:
        """The one with the parameters p, shape (size,), all arrays one after another."""
        ends = list(itertools.accumulate(map(math.prod, self.shapes)))
        arrays = [p[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, self.shapes, strict=True)]
        return self.rebuild(arrays)


@memoize
def parameter_arrays(module: eqx.Module) -> tuple[np.ndarray, ...]:
    """The parameters of a system, a method or a pacing."""
    leaves = jax.tree_util.tree_leaves(eqx.filter(module, eqx.is_inexact_array))
    return tuple(np.asarray(leaf, dtype=np.float64) for leaf in leaves)


def flat_parameters(*modules: eqx.Module) -> np.ndarray:
    """The parameters of systems, methods or pacings, one after another, shape (p,)."""
    return np.concatenate([np.zeros(0), *(array.ravel() for module in modules for array in parameter_arrays(module))])
