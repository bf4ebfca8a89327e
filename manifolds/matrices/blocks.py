"""Block diagonal matrices of repeated blocks, stored without their zeros."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._pytree_module import Module


class BlockDiagonal(Module):
    """Linear map of a block diagonal matrix whose blocks may be repeated.

    Attributes
    ----------
    blocks : tuple
        Square matrices, or other linear maps that ``@`` applies to one vector.
    sizes, counts : tuple of int
        Rows of each block, and the number of its consecutive copies.
    """

    blocks: tuple[Any, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)

    def __matmul__(self, x) -> jax.Array:
        """Return the image of a vector, shape (n,)."""
        images, start = [], 0
        for block, size, count in zip(self.blocks, self.sizes, self.counts, strict=True):
            block_vectors = x[start : start + size * count].reshape(count, size)
            images.append(jax.vmap(lambda v, block=block: block @ v)(block_vectors).ravel())
            start += size * count
        return images[0] if len(images) == 1 else jnp.concatenate(images)


class Diagonal(Module):
    """Linear map of a diagonal matrix; ``entries`` has shape (n,), or () for a multiple of the identity."""

    entries: jax.Array

    def __matmul__(self, x) -> jax.Array:
        return self.entries * x
