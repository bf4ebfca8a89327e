"""Checks of the matrices, forms and rates that a user passes to dissipations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.matrices.linear import BlockDiagonal, Diagonal

from ..errors import IndefiniteError, InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import ParameterCondition, checked_numbers, require_condition
from ..functions.indices import Indices
from .geometry import Geometry

RATE_CONDITION = ParameterCondition(
    lambda rate: (rate >= 0.0) & (rate < np.inf),
    "a dissipation rate must be >= 0 and finite, got {value}: a negative rate would lower the entropy",
)
"""Condition on the rate, or the rates, of a dissipation."""

NEGATIVE_EIGENVALUE_MESSAGE = (
    "has the negative eigenvalue {value:.3g}: it must be positive semidefinite, or entropy would fall"
)
"""End of the message for a form with a negative eigenvalue."""


def evaluate_form(form, x):
    """Return the matrix of a form at the state x: a constant is returned unchanged, a function is evaluated."""
    return jnp.asarray(form(x)) if callable(form) else form


def repeat_over_sites(form, system: Geometry):
    """Return a form on the components of one site as a form on all sites; another form unchanged."""
    if callable(form) or form is None or not system.sites or np.shape(form) != system.shape[-1:] * 2:
        return form
    return BlockDiagonal((form,), system.shape[-1:], (system.dim // system.shape[-1],))


def state_shape_dtype(dim: int):
    """Return the shape and dtype of a state of a dimension, for abstract evaluation by JAX."""
    return jax.ShapeDtypeStruct((dim,), jnp.float64)


def checked_rate(rate) -> jax.Array:
    """Return a rate as one nonnegative number (or a traced one)."""
    return checked_rates(rate, ())


def checked_rates(rates, *shapes: tuple[int, ...]) -> jax.Array:
    """Return a rate, or one for each site, as an array of nonnegative numbers (or traced ones) of one of the shapes."""
    array = checked_numbers(rates, "a rate", *shapes)
    RATE_CONDITION.require(array)
    return array


def checked_bath_indices(bath) -> Indices | None:
    """Return the index of a bath, or one for each site, as checked integers; the system checks that the baths exist."""
    if bath is None or isinstance(bath, Indices):
        return bath
    numbers = np.asarray(bath)
    if numbers.dtype.kind not in "iu":
        raise InputError(f"bath must be the number of a bath, or an array of numbers for the sites, got {bath!r}")
    return Indices(numbers)


def reject_number_as_form(form, dissipation: object, label: str) -> None:
    """Raise InputError if a number is passed for a form: it is probably meant as a rate."""
    if isinstance(form, int | float):
        raise InputError(
            f"{type(dissipation).__name__} takes {label}, a matrix, as its first argument, got the number {form}. "
            f"For a rate give rate={form}"
        )


def checked_semidefinite(form, label: str, symmetric: bool = True) -> jax.Array:
    """Return a form as a positive semidefinite matrix (or a traced one).

    Without ``symmetric`` only its symmetric part has to be semidefinite.
    """
    matrix = checked_numbers(form, label)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise InputError(f"{label} must be a square matrix, got shape {matrix.shape}")
    if isinstance(matrix, jax.core.Tracer):
        eigenvalues = jnp.linalg.eigvalsh((matrix + matrix.T) / 2)
        tolerance = 1e-12 * matrix.shape[0] * jnp.abs(matrix).max()
        require_condition(
            eigenvalues[0], lambda eigenvalue: eigenvalue >= -tolerance, f"{label} {NEGATIVE_EIGENVALUE_MESSAGE}"
        )
        return matrix
    entries = np.asarray(matrix)
    if not np.isfinite(entries).all():
        raise InputError(f"{label} must be finite, got {entries.tolist()}")
    scale = float(np.abs(entries).max())
    asymmetry = float(np.abs(entries - entries.T).max())
    if symmetric and not asymmetry <= 1e-12 * scale:
        raise InputError(f"{label} is not symmetric: it differs from its transpose by {asymmetry:.3g}")
    min_eigenvalue = float(np.linalg.eigvalsh(0.5 * (entries + entries.T))[0])
    if min_eigenvalue < -1e-12 * scale * matrix.shape[0]:
        raise IndefiniteError(
            f"{label} {NEGATIVE_EIGENVALUE_MESSAGE}".format(value=min_eigenvalue),
            residual=min_eigenvalue,
            tolerance=1e-12 * scale * matrix.shape[0],
        )
    return matrix


def check_form_shape(form, dim: int, label: str) -> None:
    """Raise InputError unless a form, or the value of a form that depends on the state, has shape (dim, dim)."""
    if isinstance(form, BlockDiagonal):
        return
    if isinstance(form, Diagonal):
        if form.entries.shape != (dim,):
            raise InputError(f"{label} has {form.entries.size} entries, and a state has {dim} components")
        return
    if callable(form):
        traced_function_and_shape(form, [(dim,)], [(dim, dim)], label, f"a state of shape ({dim},)")
    elif form.shape != (dim, dim):
        raise InputError(
            f"{label} must be a ({dim}, {dim}) matrix for a state of {dim} components, got shape {form.shape}"
        )


def require_algebra(system: Geometry, name: str, form=None) -> mf.LieAlgebra:
    """Return the algebra of a system; InputError if it has none, or a form does not fit its dimension."""
    algebra = system.lie_algebra
    if algebra is None:
        raise InputError(f"{name} needs a Lie algebra. Use it in a LiePoissonSystem, or use ProjectedMetric()")
    dim = algebra.dim if form is None or isinstance(form, BlockDiagonal) else form.shape[0]
    if dim != algebra.dim:
        raise InputError(
            f"the form of {name} must have shape ({algebra.dim}, {algebra.dim}) on {algebra.name}, got ({dim}, {dim})"
        )
    return algebra
