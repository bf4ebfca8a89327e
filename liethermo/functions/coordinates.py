"""What a term may take for its coordinates: components of the state, or a map at most quadratic in it."""

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
from ..tracing.trace_errors import TRACE_ERRORS, explain_trace_error
from .indices import Indices

COORDINATE_TOLERANCE = 1e-10
"""How far a map of coordinates may be from quadratic, relative to its values: a few roundings."""


class ComponentMap(Module):
    """A linear map from a state to some of its components, in another order or in units that are powers of two."""

    @abstractmethod
    def __call__(self, x) -> jax.Array: ...


class Components(ComponentMap):
    """Components by their numbers; a range of them is read without gathering."""

    indices: range | Indices = eqx.field(static=True)

    @classmethod
    def of(cls, numbers: Sequence[int] | np.ndarray) -> Components:
        if isinstance(numbers, range) and numbers.step == 1 and numbers.start >= 0:
            return cls(numbers)
        return cls(Indices(np.asarray(numbers, dtype=np.int64)))

    def __call__(self, x):
        places = self.indices
        return x[places.start : places.stop] if isinstance(places, range) else x[np.asarray(places)]


def check_coordinates(coordinates: Callable, dim: int, role: str) -> None:
    """Raise unless coordinates are components of the state, or a map at most quadratic in it."""
    if isinstance(coordinates, Components):
        outside = [i for i in np.asarray(coordinates.indices).tolist() if not -dim <= i < dim]
        if outside:  # JAX would read the last component instead
            raise InputError(f"{role} has a term on component {outside[0]} of a state with {dim} components")
    if isinstance(coordinates, ComponentMap) or is_traced(coordinates):
        return
    try:
        start, end, step = evaluate_at_points(
            _coordinate_increments, coordinates, np.random.default_rng(0).standard_normal((1, 2 * dim))
        )
    except TRACE_ERRORS as error:
        raise FunctionError(
            explain_trace_error(f"the coordinates of a term of {role} could not be evaluated", error)
        ) from error
    if start.ndim != 2:
        raise FunctionError(
            f"the coordinates of a term of {role} are one array of numbers, not shape {start.shape[1:]}"
        )
    size = max(1.0, float(np.abs(start).max() + np.abs(end).max()))
    defect = float(np.abs(end - start - step).max())
    if not defect <= COORDINATE_TOLERANCE * size:
        raise InputError(
            f"the coordinates of a term of {role} are not a quadratic function of the state: they miss "
            f"y' - y = Dpi(z)(x' - x) by {defect:.3g} (tolerance {COORDINATE_TOLERANCE * size:.1g}), which would "
            "cost the exactness of the energy. Let the term take, say, the square of a distance and root it itself"
        )


def _coordinate_increments(coordinates: Callable, ends):
    """The coordinates of two random states, and their difference as a quadratic map would have it."""
    x, d = jnp.split(ends, 2)
    return coordinates(x), coordinates(x + d), jax.jvp(coordinates, (x + 0.5 * d,), (d,))[1]
