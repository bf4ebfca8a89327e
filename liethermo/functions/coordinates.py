"""Coordinates of a term of an energy: components of the state, or a map at most quadratic in the state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import FunctionError, InputError
from ..tracing.interpret import evaluate_at_points
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from .indices import Indices

COORDINATE_TOLERANCE = 1e-10
"""Largest deviation of a map of coordinates from a quadratic one, relative to its values: a few roundings."""


class ComponentMap(Module):
    """A linear map from a state to some of its components, reordered or scaled by powers of two."""

    @abstractmethod
    def __call__(self, x) -> jax.Array: ...


class Components(ComponentMap):
    """Components of a state by their indices; a range is read as a slice."""

    indices: range | Indices = eqx.field(static=True)

    @classmethod
    def of(cls, numbers: Sequence[int] | np.ndarray) -> Components:
        if isinstance(numbers, range) and numbers.step == 1 and numbers.start >= 0:
            return cls(numbers)
        return cls(Indices(np.asarray(numbers, dtype=np.int64)))

    def __call__(self, x):
        indices = self.indices
        return x[indices.start : indices.stop] if isinstance(indices, range) else x[np.asarray(indices)]


def check_coordinates(coordinates: Callable, dim: int, role: str) -> None:
    """Raise an error unless coordinates are components of the state or a map at most quadratic in the state."""
    if isinstance(coordinates, Components):
        invalid_indices = [i for i in np.asarray(coordinates.indices).tolist() if not -dim <= i < dim]
        if invalid_indices:  # JAX would read the last component instead
            raise InputError(f"{role} has a term on component {invalid_indices[0]}, but the state has {dim} components")
    if isinstance(coordinates, ComponentMap) or is_traced(coordinates):
        return
    try:
        start, end, step = evaluate_at_points(
            _coordinates_at_ends_and_increment, coordinates, np.random.default_rng(0).standard_normal((1, 2 * dim))
        )
    except TRACE_ERRORS as error:
        raise FunctionError(
            trace_error_message(f"the coordinates of a term of {role} could not be evaluated", error)
        ) from error
    if start.ndim != 2:
        raise FunctionError(f"the coordinates of a term of {role} must be a vector, got shape {start.shape[1:]}")
    scale = max(1.0, float(np.abs(start).max() + np.abs(end).max()))
    defect = float(np.abs(end - start - step).max())
    if not defect <= COORDINATE_TOLERANCE * scale:
        raise InputError(
            f"the coordinates of a term of {role} must be a quadratic function of the state, but they miss "
            f"y' - y = Dpi(z)(x' - x) by {defect:.3g} (tolerance {COORDINATE_TOLERANCE * scale:.1g}), so the energy "
            "would not be exact. Use, for example, the square of a distance, and take its root inside the term"
        )


def _coordinates_at_ends_and_increment(coordinates: Callable, ends):
    """Return the coordinates of two states, and the difference that a quadratic map would give."""
    x, d = jnp.split(ends, 2)
    return coordinates(x), coordinates(x + d), jax.jvp(coordinates, (x + 0.5 * d,), (d,))[1]
