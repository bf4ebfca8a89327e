"""What is asked of the matrices, forms and rates that constructions are given."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.matrices.blocks import BlockDiagonal, Diagonal

from ..errors import IndefiniteError, InputError
from ..functions.checks import check_function_shape
from ..functions.conditions import check_numbers, require_condition
from ..functions.indices import Indices
from .geometry import Geometry

NEGATIVE_EIGENVALUE_MESSAGE = (
    "has the negative eigenvalue {value:.3g}: it must be positive semidefinite, or entropy would fall"
)


def evaluate_form(form, x):
    """A constant, or a function of the state evaluated at x."""
    return jnp.asarray(form(x)) if callable(form) else form


def repeat_over_sites(form, system: Geometry):
    """A form on the components of one site as that on those of all; another form as it is."""
    if callable(form) or form is None or not system.sites or np.shape(form) != system.shape[-1:] * 2:
        return form
    return BlockDiagonal((form,), system.shape[-1:], (system.dim // system.shape[-1],))


def state_shape_dtype(dim: int):
    return jax.ShapeDtypeStruct((dim,), jnp.float64)


def checked_rate(rate) -> jax.Array:
    """A rate as one non-negative number (or a traced one)."""
    array = check_numbers(rate, "a rate", ())
    require_condition(
        array,
        lambda rate: rate >= 0.0,
        "a dissipation rate must be >= 0, not {value}: a negative one would lower the entropy",
    )
    return array


def checked_rates(rates) -> jax.Array:
    """A rate, or one for each site, as an array of non-negative numbers (or traced ones)."""
    array = check_numbers(rates, "a rate")
    if not isinstance(array, jax.core.Tracer) and not np.all(np.asarray(array) >= 0.0):
        min_rate = float(np.asarray(array).min())
        raise InputError(f"a dissipation rate must be >= 0, not {min_rate}: a negative one would lower the entropy")
    return array


def checked_bath(bath) -> Indices | None:
    """The number of a bath, or one for each site; whether there are so many, the system knows."""
    if bath is None or isinstance(bath, Indices):
        return bath
    numbers = np.asarray(bath)
    if numbers.dtype.kind not in "iu":
        raise InputError(f"bath is the number of a bath, or an array of these for the sites, not {bath!r}")
    return Indices(numbers)


def reject_rate_as_form(form, dissipation: object, what: str) -> None:
    """Raise where a number stands for a form: that of a multiple of the identity is another thing than a rate."""
    if isinstance(form, int | float):
        raise InputError(
            f"{type(dissipation).__name__} takes {what} first, a matrix, and {form} is a number: for a rate say "
            f"rate={form}"
        )


def checked_semidefinite(form, what: str, symmetric: bool = True) -> jax.Array:
    """A form as a positive semidefinite matrix (or a traced one): symmetric, or with a symmetric part that is."""
    matrix = check_numbers(form, what)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise InputError(f"{what} must be a square matrix, not an array of shape {matrix.shape}")
    if isinstance(matrix, jax.core.Tracer):
        eigenvalues = jnp.linalg.eigvalsh((matrix + matrix.T) / 2)
        tolerance = 1e-12 * matrix.shape[0] * jnp.abs(matrix).max()
        require_condition(
            eigenvalues[0], lambda eigenvalue: eigenvalue >= -tolerance, f"{what} {NEGATIVE_EIGENVALUE_MESSAGE}"
        )
        return matrix
    entries = np.asarray(matrix)
    if not np.isfinite(entries).all():
        raise InputError(f"{what} must be finite, not {entries.tolist()}")
    scale = float(np.abs(entries).max())
    asymmetry = float(np.abs(entries - entries.T).max())
    if symmetric and not asymmetry <= 1e-12 * scale:
        raise InputError(f"{what} is not symmetric: it differs from its transpose by {asymmetry:.3g}")
    min_eigenvalue = float(np.linalg.eigvalsh(0.5 * (entries + entries.T))[0])
    if min_eigenvalue < -1e-12 * scale * matrix.shape[0]:
        raise IndefiniteError(
            f"{what} {NEGATIVE_EIGENVALUE_MESSAGE}".format(value=min_eigenvalue),
            residual=min_eigenvalue,
            tolerance=1e-12 * scale * matrix.shape[0],
        )
    return matrix


def check_matrix(form, dim: int, what: str) -> None:
    """Raise unless a form, or what a function of the state gives, acts on states of this dimension."""
    if isinstance(form, BlockDiagonal):
        return
    if isinstance(form, Diagonal):
        if form.entries.shape != (dim,):
            raise InputError(f"{what} has {form.entries.size} entries, and a state has {dim} components")
        return
    if callable(form):
        check_function_shape(form, [(dim,)], [(dim, dim)], what, f"a state of shape ({dim},)")
    elif form.shape != (dim, dim):
        raise InputError(
            f"{what} must be a ({dim}, {dim}) matrix for a state of {dim} components, not shape {form.shape}"
        )


def require_algebra(system: Geometry, name: str, form=None) -> mf.LieAlgebra:
    """The algebra of a system; InputError where it has none, or where a form is not one of it."""
    algebra = system.lie_algebra
    if algebra is None:
        raise InputError(f"{name} lives on a Lie algebra: use it in a LiePoissonSystem, or take ProjectedMetric()")
    dim = algebra.dim if form is None or isinstance(form, BlockDiagonal) else form.shape[0]
    if dim != algebra.dim:
        raise InputError(f"the form of {name} is ({dim}, {dim}), but {algebra.name} has dimension {algebra.dim}")
    return algebra
