"""What a term may take for its coordinates: components of the state, or a map at most quadratic in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced

from ..errors import FunctionError, InputError
from ..tracing.interpret import at_points

COORDINATE_TOLERANCE = 1e-10
"""How far a map of coordinates may be from quadratic, relative to its values: a few roundings."""


class Coordinates(Protocol):
    """A term that depends on the state through coordinates: some of its components, or a function of it."""

    indices: tuple[int, ...]
    function: Callable | None

    def of(self, x) -> jax.Array: ...


def check_coordinates(term: Coordinates, dim: int, role: str) -> None:
    """Raise unless the coordinates of a term are components of the state, or a map at most quadratic in it."""
    if term.function is None:
        outside = [i for i in term.indices if not -dim <= i < dim]
        if outside:  # JAX would read the last component instead
            raise InputError(f"{role} has a term on component {outside[0]} of a state with {dim} components")
        return
    if is_traced(term):
        return
    try:
        start, end, step = at_points(_chord, term, np.random.default_rng(0).standard_normal((1, 2 * dim)))
    except (TypeError, ValueError, IndexError) as error:
        raise FunctionError(f"the coordinates of a term of {role} could not be evaluated: {error}") from error
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


def _chord(term: Coordinates, ends):
    """The coordinates of two random states, and their difference as a quadratic map would have it."""
    x, d = jnp.split(ends, 2)
    return term.of(x), term.of(x + d), jax.jvp(term.of, (x + 0.5 * d,), (d,))[1]
