"""Orthonormal frames of a few gradients, which may vanish or be linearly dependent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

DEPENDENCE_RTOL_SQUARED = 1e-24
"""Squared norm of a residual, relative to that of its vector, below which the vector depends on the previous ones."""

MIN_SQUARED_NORM = 1e-280
"""Squared norm below which a vector counts as zero, because products of its components have lost their digits."""


class OrthonormalFrame(NamedTuple):
    """Orthonormal vectors with the span of given vectors; a vector that depends on previous ones has a zero instead.

    Attributes
    ----------
    unit_vectors : list of array, shape (n,)
    combinations : list of array, shape (m,)
        Unit vector j is ``sum_l combinations[j][l] vectors[l]``.
    images : list of array, shape (n,)
        Images of the unit vectors under the form in which they are orthonormal; the unit vectors by default.
    squared_norms : list of array, shape ()
        Squared norm of the residual of each vector, zero for a dependent one; their product is Gram's determinant.
    """

    unit_vectors: list[jax.Array]
    combinations: list[jax.Array]
    images: list[jax.Array]
    squared_norms: list[jax.Array]

    def project_off(self, v) -> jax.Array:
        """Return v without its component in the span."""
        return self._residual_and_coefficients(v)[0]

    def project_off_transposed(self, v) -> jax.Array:
        """Return ``P^T v``, where P is the matrix of :meth:`project_off`: v without its component along the images."""
        for e, image in zip(self.unit_vectors, self.images, strict=True):
            v = v - jnp.dot(e, v) * image
        return v

    def coefficients(self, v) -> jax.Array:
        """Return w, shape (m,), for which ``sum_l w_l vectors[l]`` is the component of v in the span."""
        return sum_arrays(jnp.dot(e, v) * c for e, c in zip(self.unit_vectors, self.combinations, strict=True))

    def vector_with_inner_products(self, products) -> jax.Array:
        """Return the vector in the span, shape (n,), that has given inner products with the given vectors."""
        return sum_arrays(jnp.dot(c, products) * e for e, c in zip(self.unit_vectors, self.combinations, strict=True))

    def _residual_and_coefficients(self, v) -> tuple[jax.Array, list[jax.Array]]:
        """Return v without its component in the span, and its coefficients in the unit vectors."""
        coefficients: list[jax.Array] = [jnp.zeros(())] * len(self.unit_vectors)
        for _ in range(2):  # the second pass removes what rounding left of the first
            for j, (e, image) in enumerate(zip(self.unit_vectors, self.images, strict=True)):
                coefficient = jnp.dot(image, v)
                v, coefficients[j] = v - coefficient * e, coefficients[j] + coefficient
        return v, coefficients


def gram_schmidt(
    vectors: Sequence[jax.Array],
    reference_vectors: Sequence[jax.Array] | None = None,
    metric_map: Callable | None = None,
) -> OrthonormalFrame:
    """Return the Gram-Schmidt frame of some vectors, orthonormal in the inner product of ``metric_map``, v -> G v.

    If ``reference_vectors`` are given, their linear dependence decides instead. The discrete gradients of C and exp(C)
    may differ by a multiple of the increment, and projecting off both would then stop the motion; the gradients show
    the dependence.
    """
    image_of = metric_map or (lambda v: v)
    frame, reference_frame = OrthonormalFrame([], [], [], []), OrthonormalFrame([], [], [], [])
    for j, vector in enumerate(vectors):
        residual, coefficients = frame._residual_and_coefficients(vector)
        image = image_of(residual)
        squared_norm = jnp.dot(image, residual)
        if reference_vectors is None:
            full_squared_norm = squared_norm if residual is vector else jnp.dot(image_of(vector), vector)
            is_independent = squared_norm > DEPENDENCE_RTOL_SQUARED * full_squared_norm
        else:
            reference_residual = reference_frame.project_off(reference_vectors[j])
            reference_squared_norm = jnp.dot(reference_residual, reference_residual)
            is_independent = (squared_norm > 0.0) & (
                reference_squared_norm > DEPENDENCE_RTOL_SQUARED * jnp.dot(reference_vectors[j], reference_vectors[j])
            )
            reference_frame.unit_vectors.append(
                reference_residual * _safe_inverse_sqrt(reference_squared_norm, is_independent)
            )
            reference_frame.images.append(reference_frame.unit_vectors[-1])
        scale = _safe_inverse_sqrt(squared_norm, is_independent)
        combination = jnp.asarray(np.eye(len(vectors))[j])
        for coefficient, previous_combination in zip(coefficients, frame.combinations, strict=True):
            combination = combination - coefficient * previous_combination
        frame.unit_vectors.append(residual * scale)
        frame.combinations.append(combination * scale)
        frame.images.append(image * scale)
        frame.squared_norms.append(jnp.where(is_independent, squared_norm, 0.0))
    return frame


def vector_with_inner_products(
    directions: Sequence[jax.Array],
    products: jax.Array,
    n_passes: int = 1,
    is_usable: Callable[[jax.Array], jax.Array] | None = None,
) -> jax.Array:
    """Return the vector in the span of some directions, shape (n,), that has given inner products with them.

    The result is ``gram_schmidt(directions).vector_with_inner_products(products)``, but computed in one pass and
    without square roots, for an iteration that corrects rounding errors. A direction that depends on previous ones, as
    at an equilibrium, is skipped. A second pass is for directions that are nearly parallel, as in units in which one
    component is much larger than another.

    An increment along a direction for which ``is_usable`` is false is skipped; the product with this direction is then
    not enforced.
    """
    result = jnp.zeros_like(directions[0])
    units: list[tuple[jax.Array, jax.Array]] = []
    for v, product in zip(directions, products, strict=True):
        residual = v
        for pass_index in range(n_passes):
            for unit, squared_norm in units:
                residual = residual - (jnp.dot(residual if pass_index else v, unit) / squared_norm) * unit
        squared_norm = jnp.dot(residual, residual)
        is_independent = squared_norm > jnp.maximum(DEPENDENCE_RTOL_SQUARED * jnp.dot(v, v), MIN_SQUARED_NORM)
        squared_norm = jnp.where(is_independent, squared_norm, 1.0)
        residual = jnp.where(is_independent, residual, 0.0)
        increment = ((product - jnp.dot(v, result)) / squared_norm) * residual
        result = result + (increment if is_usable is None else jnp.where(is_usable(increment), increment, 0.0))
        units.append((residual, squared_norm))
    return result


def sqrt_or_zero(square) -> jax.Array:
    """Return the square root, or zero where the argument is not positive, with a finite derivative at zero."""
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _safe_inverse_sqrt(square, is_usable):
    """Return ``1 / |v|`` from ``|v|^2``, or 0 where it is not usable, with finite derivatives."""
    return jnp.where(is_usable, 1.0 / jnp.sqrt(jnp.where(is_usable, square, 1.0)), 0.0)


def sum_arrays(terms: Iterable[jax.Array]) -> jax.Array:
    """Return the sum of arrays, without a zero at the start."""
    first_term, *other_terms = terms
    return sum(other_terms, first_term)
