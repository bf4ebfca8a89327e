"""Factors of friction matrices: they map random numbers to noise, and fluxes to forces."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import BlockDiagonal, Diagonal
from manifolds.matrices.symmetric import semidefinite_factor

from ..functions.frames import sqrt_or_zero


class Factor(NamedTuple):
    """A matrix B, shape (n, size), with ``B B^T = K``, as a linear function.

    Attributes
    ----------
    size : int
        Number of columns.
    times : function
        Maps w, shape (size,), to ``B w``, shape (n,); linear.
    solenoidal : bool
        True if every column, at the gradients of the functions, is a field of divergence zero.
    added_attitude_velocity : function or None
        Maps w to the velocity that the force ``B w`` adds to an attitude: see
        :meth:`.Dissipation.added_attitude_velocity`. None if such a force is an external torque.
    spin_coefficients : array or None
        Numbers r, of shape () or (sites,), with ``B w = r_i w_i x s_i`` at every spin, if B has this form and w has
        three components for each spin: see :class:`.StochasticMidpoint`.
    """

    size: int
    times: Callable[[jax.Array], jax.Array]
    solenoidal: bool = False
    added_attitude_velocity: Callable[[jax.Array], jax.Array] | None = None
    spin_coefficients: jax.Array | None = None

    def transpose_times(self, alpha) -> jax.Array:
        """Return ``B^T alpha``, shape (size,)."""
        return jax.linear_transpose(self.times, jax.ShapeDtypeStruct((self.size,), jnp.float64))(alpha)[0]

    def scale_by(self, rate) -> Factor:
        """Return the factor of ``rate * K``; the rate is a number, which may depend on the state."""
        scale = sqrt_or_zero(rate)
        velocity_map = self.added_attitude_velocity
        scaled_map = None if velocity_map is None else lambda w: scale * velocity_map(w)
        spin_coefficients = None if self.spin_coefficients is None else scale * self.spin_coefficients
        return self._replace(
            times=lambda w: scale * self.times(w),
            added_attitude_velocity=scaled_map,
            spin_coefficients=spin_coefficients,
        )


def form_root(form) -> Any:
    """Return R with ``R R^T = form``, for a semidefinite matrix or an object that acts like one; None if unknown."""
    if isinstance(form, BlockDiagonal):
        roots = tuple(form_root(block) for block in form.blocks)
        has_roots = all(root is not None for root in roots)
        return eqx.tree_at(lambda f: f.blocks, form, roots) if has_roots else None
    if isinstance(form, Diagonal):
        return Diagonal(jnp.sqrt(form.entries))
    return semidefinite_factor(form) if isinstance(form, jax.Array | np.ndarray) else None


def concatenate_factors(factors: Sequence[Factor]) -> Factor:
    """Return the factors side by side: the factor of the sum of the matrices."""
    ends = list(itertools.accumulate((B.size for B in factors), initial=0))

    def times(w):
        slices = zip(factors, itertools.pairwise(ends), strict=True)
        return sum(B.times(w[start:end]) for B, (start, end) in slices)

    return Factor(ends[-1], times, all(B.solenoidal for B in factors))
