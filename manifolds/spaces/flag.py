"""Flag manifolds: nested subspaces of R^n."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..errors import ParameterError
from .base import register
from .groups import SpecialOrthogonal
from .homogeneous import Homogeneous


@register((1, 1, 2))
@jax.tree_util.register_static
class Flag(Homogeneous):
    """Flags ``V_1 < V_2 < ... < R^n``: each subspace has ``steps[i]`` dimensions more than the one before.

    ``Flag(1, 1, 2)`` has a line in a plane in R^4. A point is a rotation x whose first columns span V_1, the next ones
    complete them to a basis of V_2, and so on; each piece is oriented. Two pieces are a Grassmann manifold, at
    ``1 / sqrt(2)`` of its distances.

    Parameters
    ----------
    steps : int
        The dimensions of the pieces, two or more.
    """

    def __init__(self, *steps: int):
        if len(steps) < 2:
            raise ParameterError(f"Flag(*steps) needs at least two steps, as in Flag(1, 2), got {len(steps)}")
        sizes = [checked_size(step, 1, "Flag(*steps)", "a step") for step in steps]
        n, start, rotations = sum(sizes), 0, []
        for size in sizes:
            for i in range(start, start + size):
                for j in range(i + 1, start + size):
                    rotation = np.zeros((n, n))
                    rotation[i, j], rotation[j, i] = -1.0, 1.0
                    rotations.append(rotation)
            start += size
        super().__init__(SpecialOrthogonal(n), np.reshape(rotations, (-1, n, n)), f"Fl({', '.join(map(str, sizes))})")
        object.__setattr__(self, "steps", tuple(sizes))

    steps: tuple[int, ...]

    def projectors(self, x) -> jax.Array:
        """Return the orthogonal projectors onto the pieces, shape (..., pieces, n, n), of which functions of flags are
        made.

        Parameters
        ----------
        x : array, shape (..., n, n)
        """
        frames = jnp.split(self._ambient_array(x, "x"), np.cumsum(self.steps)[:-1], axis=-1)
        return jnp.stack([frame @ frame.swapaxes(-1, -2) for frame in frames], axis=-3)
