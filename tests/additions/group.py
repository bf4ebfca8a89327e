"""The affine maps of the line, x -> a x + b with a > 0, as matrices of two rows."""

import jax.numpy as jnp
import numpy as np

import manifolds as mf

LINE = mf.LieAlgebra.from_matrices(
    [np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])], name="line"
)


def distance(g):
    last_row_error = jnp.abs(g[..., 1, :] - jnp.array([0.0, 1.0])).max(axis=-1)
    return jnp.maximum(last_row_error, jnp.maximum(-g[..., 0, 0], 0.0))


AFFINE = mf.MatrixGroup("affine maps of the line", LINE, distance)
