"""Orthonormal frames of a few gradients, some of which may vanish or depend on the others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

DEPENDENCE_RTOL_SQUARED = 1e-24
"""Square of what is left of a vector, relative to its own, below which it depends on those before it."""

MIN_SQUARED_NORM = 1e-280
"""Square of a vector below which it is none: products of its components have lost their digits."""


class OrthonormalFrame(NamedTuple):
    """Orthonormal vectors that span what given ones span; zero instead of one that depends on those before it.

    Attributes
    ----------
    unit_vectors : list of array, shape (n,)
    combinations : list of array, shape (m,)
        Unit j is ``sum_l combinations[j][l] vectors[l]``.
    images : list of array, shape (n,)
        Those of the units by the form in which they are orthonormal; they themselves by default.
    squared_norms : list of array, shape ()
        Of what was left of each vector, zero instead of one that was left out; their product is Gram's determinant.
    """

    unit_vectors: list[jax.Array]
    combinations: list[jax.Array]
    images: list[jax.Array]
    squared_norms: list[jax.Array]

    def project_off(self, v) -> jax.Array:
        """v less its components in the span."""
        return self._orthogonalize(v)[0]

    def project_off_images(self, v) -> jax.Array:
        """An image less its components in the span of the images: ``P^T v``, where :meth:`off` is P."""
        for e, image in zip(self.unit_vectors, self.images, strict=True):
            v = v - jnp.dot(e, v) * image
        return v

    def coefficients(self, v) -> jax.Array:
        """Those w for which ``sum_l w_l vectors[l]`` is the component of v in the span, shape (m,)."""
        return sum_terms(jnp.dot(e, v) * c for e, c in zip(self.unit_vectors, self.combinations, strict=True))

    def vector_with_products(self, products) -> jax.Array:
        """The vector in the span whose inner products with the given ones are these, shape (n,)."""
        return sum_terms(jnp.dot(c, products) * e for e, c in zip(self.unit_vectors, self.combinations, strict=True))

    def _orthogonalize(self, v) -> tuple[jax.Array, list[jax.Array]]:
        taken: list[jax.Array] = [jnp.zeros(())] * len(self.unit_vectors)
        for _ in range(2):  # the second pass removes what rounding left of the first
            for j, (e, image) in enumerate(zip(self.unit_vectors, self.images, strict=True)):
                along = jnp.dot(image, v)
                v, taken[j] = v - along * e, taken[j] + along
        return v, taken


def gram_schmidt(
    vectors: Sequence[jax.Array],
    reference_vectors: Sequence[jax.Array] | None = None,
    metric_map: Callable | None = None,
) -> OrthonormalFrame:
    """The frame of some vectors by Gram and Schmidt, orthonormal in a form given as a map: from v to ``G v``.

    ``reference_vectors`` are vectors whose dependence decides instead of the given ones. Discrete gradients of C and exp(C)
    differ by a multiple of the slope alone, and to project off both would stop the motion: the gradients tell.
    """
    image_of = metric_map or (lambda v: v)
    found, plain = OrthonormalFrame([], [], [], []), OrthonormalFrame([], [], [], [])
    for j, vector in enumerate(vectors):
        rest, taken = found._orthogonalize(vector)
        image = image_of(rest)
        square = jnp.dot(image, rest)
        if reference_vectors is None:
            whole = square if rest is vector else jnp.dot(image_of(vector), vector)
            independent = square > DEPENDENCE_RTOL_SQUARED * whole
        else:
            plain_rest = plain.project_off(reference_vectors[j])
            plain_square = jnp.dot(plain_rest, plain_rest)
            independent = (square > 0.0) & (
                plain_square > DEPENDENCE_RTOL_SQUARED * jnp.dot(reference_vectors[j], reference_vectors[j])
            )
            plain.unit_vectors.append(plain_rest * _safe_inverse_sqrt(plain_square, independent))
            plain.images.append(plain.unit_vectors[-1])
        scale = _safe_inverse_sqrt(square, independent)
        combination = jnp.asarray(np.eye(len(vectors))[j])
        for along, earlier in zip(taken, found.combinations, strict=True):
            combination = combination - along * earlier
        found.unit_vectors.append(rest * scale)
        found.combinations.append(combination * scale)
        found.images.append(image * scale)
        found.squared_norms.append(jnp.where(independent, square, 0.0))
    return found


def vector_with_products(
    directions: Sequence[jax.Array],
    products: jax.Array,
    passes: int = 1,
    is_usable: Callable[[jax.Array], jax.Array] | None = None,
) -> jax.Array:
    """The vector in the span of some whose inner products with them are these, shape (n,).

    As ``frame(directions).with_products(products)``, in one pass and without roots: for an iteration that corrects what
    rounding leaves. One that depends on those before it, as at an equilibrium, is left out. A second pass is for
    directions that are nearly parallel, as in units of which one is much larger than another.

    What each direction adds is left out where it is not usable: the product with that direction is then as the others
    make it.
    """
    found = jnp.zeros_like(directions[0])
    units: list[tuple[jax.Array, jax.Array]] = []
    for v, product in zip(directions, products, strict=True):
        own = v
        for made in range(passes):
            for unit, square in units:
                own = own - (jnp.dot(own if made else v, unit) / square) * unit
        square = jnp.dot(own, own)
        use = square > jnp.maximum(DEPENDENCE_RTOL_SQUARED * jnp.dot(v, v), MIN_SQUARED_NORM)
        square = jnp.where(use, square, 1.0)
        own = jnp.where(use, own, 0.0)
        added = ((product - jnp.dot(v, found)) / square) * own
        found = found + (added if is_usable is None else jnp.where(is_usable(added), added, 0.0))
        units.append((own, square))
    return found


def sqrt_or_zero(square) -> jax.Array:
    """The square root, zero where there is none; that has a derivative at zero too."""
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _safe_inverse_sqrt(square, usable):
    """``1 / |v|`` from ``|v|^2``, or 0 where that cannot be used; safe to differentiate."""
    return jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, square, 1.0)), 0.0)


def sum_terms(parts: Iterable[jax.Array]) -> jax.Array:
    """The sum, without a zero to begin with."""
    first, *others = parts
    return sum(others, first)
