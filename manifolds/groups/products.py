"""Maps of a product of matrix groups, from those of its factors: matrices are block diagonal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from ..algebras.lie_algebra import LieAlgebra
from ..algebras.sums import direct_sum


@dataclass(frozen=True)
class BlockMap:
    """A map of each factor of a product, applied to the blocks of a matrix or to the parts of an element.

    Attributes
    ----------
    maps : tuple of callable
        The map of each factor.
    algebras : tuple of LieAlgebra
        The algebras of the factors.
    takes_components, gives_components : bool
        True if the arguments, or the values, are components of the algebra instead of matrices.
    """

    maps: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]
    takes_components: bool = False
    gives_components: bool = False

    def __call__(self, algebra: LieAlgebra, argument) -> jax.Array:
        parts = (_split_components if self.takes_components else split_blocks)(self.algebras, argument)
        images = [f(g, part) for f, g, part in zip(self.maps, self.algebras, parts, strict=True)]
        return jnp.concatenate(images, axis=-1) if self.gives_components else join_blocks(images)


@dataclass(frozen=True)
class MatrixBlockMap:
    """A map ``g -> g`` of each factor of a product, applied to the blocks."""

    maps: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]

    def __call__(self, g) -> jax.Array:
        blocks = split_blocks(self.algebras, g)
        return join_blocks([f(block) for f, block in zip(self.maps, blocks, strict=True)])


@dataclass(frozen=True)
class BlockDefect:
    """The largest distance of a block from its group, and of the other entries from zero."""

    defects: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]

    def __call__(self, g) -> jax.Array:
        blocks = split_blocks(self.algebras, g)
        largest = jnp.abs(g - join_blocks(blocks)).max(axis=(-2, -1))
        for defect, block in zip(self.defects, blocks, strict=True):
            largest = jnp.maximum(largest, defect(block))
        return largest


@dataclass(frozen=True)
class BlockEquations:
    """The equations of all factors of a product."""

    equations: tuple[Callable, ...]
    algebras: tuple[LieAlgebra, ...]

    def __call__(self, g) -> jax.Array:
        blocks = split_blocks(self.algebras, g)
        return jnp.concatenate([f(block) for f, block in zip(self.equations, blocks, strict=True)], axis=-1)


def product_fields(first: Any, second: Any) -> dict[str, Any]:
    """Return the fields of the product of two matrix groups, by name."""
    groups = (first, second)
    algebras = tuple(group.algebra for group in groups)

    def maps_of_components(kind: str) -> BlockMap | None:
        maps = tuple({"cayley": g.cayley_map, "adjoint_cayley": g.adjoint_cayley_map}[kind] for g in groups)
        return None if None in maps else BlockMap(maps, algebras, takes_components=True)

    equations = tuple(group.equations for group in groups)
    return {
        "name": f"{first.name} x {second.name}",
        "algebra": direct_sum(*algebras),
        "defect": BlockDefect(tuple(group.defect for group in groups), algebras),
        "inverse_map": MatrixBlockMap(tuple(group.inverse_map for group in groups), algebras),
        "exp_map": BlockMap(tuple(group.exp_map for group in groups), algebras, takes_components=True),
        "log_map": BlockMap(tuple(group.log_map for group in groups), algebras, gives_components=True),
        "cayley_map": maps_of_components("cayley"),
        "inverse_cayley_map": BlockMap(
            tuple(group.inverse_cayley_map for group in groups), algebras, gives_components=True
        ),
        "adjoint_cayley_map": maps_of_components("adjoint_cayley"),
        "restore_map": MatrixBlockMap(tuple(group.restore_map for group in groups), algebras),
        "equations": None if None in equations else BlockEquations(equations, algebras),
    }


def split_blocks(algebras: tuple[LieAlgebra, ...], g) -> list[jax.Array]:
    """Return the diagonal blocks of matrices, real ones for factors of real matrices."""
    blocks, start = [], 0
    for algebra in algebras:
        basis = algebra._require_basis()
        block = g[..., start : start + basis.shape[-1], start : start + basis.shape[-1]]
        blocks.append(block if jnp.iscomplexobj(basis) else block.real)
        start += basis.shape[-1]
    return blocks


def join_blocks(blocks: list[jax.Array]) -> jax.Array:
    """Return block diagonal matrices, shape (..., m, m)."""
    size, start, rows = sum(block.shape[-1] for block in blocks), 0, []
    for block in blocks:
        n = block.shape[-1]
        widths = [(0, 0)] * (block.ndim - 1) + [(start, size - start - n)]
        rows.append(jnp.pad(block, widths))
        start += n
    return jnp.concatenate(rows, axis=-2)


def _split_components(algebras: tuple[LieAlgebra, ...], x) -> list[jax.Array]:
    parts, start = [], 0
    for algebra in algebras:
        parts.append(x[..., start : start + algebra.dim])
        start += algebra.dim
    return parts
