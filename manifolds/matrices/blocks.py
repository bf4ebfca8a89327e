"""Block diagonal matrices of equal blocks, without their zeros."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._pytree_module import Module


class BlockDiagonal(Module):
    """The linear map of a block diagonal matrix, some of whose blocks are repeated.

    Attributes
    ----------
    blocks : tuple
        Square matrices, or other linear maps that ``@`` applies to one vector.
    sizes, counts : tuple of int
        Rows of each block, and how often it stands in a row.
    """

    blocks: tuple[Any, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)

    def __matmul__(self, x) -> jax.Array:
        """The image of a vector, shape (n,)."""
        parts, start = [], 0
        for block, size, count in zip(self.blocks, self.sizes, self.counts, strict=True):
            part = x[start : start + size * count].reshape(count, size)
            parts.append(jax.vmap(lambda v, block=block: block @ v)(part).ravel())
            start += size * count
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


class Diagonal(Module):
    """The linear map of a diagonal matrix, shape (n,) of its entries, or () for a multiple of the identity."""

    entries: jax.Array

    def __matmul__(self, x) -> jax.Array:
        return self.entries * x
