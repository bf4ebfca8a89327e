"""Energies and entropies: functions of the state as sums of terms, quadratic or general.

The distinction matters to a discretisation. A quadratic term needs no discrete gradient, since its gradient at the
midpoint is one already; a general term gets a correction of its own [EQUATIONS: "Sums of energies"].
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import real_array

from .engine.interpret import polynomial_degree
from .errors import FunctionError, InputError


class Energy(eqx.Module):
    """A real function of the state with a gradient; energies add with ``+``.

    Calling one evaluates it: shape (..., n) to shape (...).
    """

    @abstractmethod
    def value(self, x) -> jax.Array:
        """The value at one state, shape (n,) to shape ()."""

    def gradient(self, x) -> jax.Array:
        """The gradient at one state, shape (n,)."""
        return jax.grad(self.value)(x)

    @property
    def terms(self) -> tuple[Energy, ...]:
        """The summands, none of them a sum itself."""
        return (self,)

    @property
    def is_quadratic(self) -> bool:
        """Whether it is known to be a polynomial of degree two at most: its gradient at a midpoint is then exact."""
        return False

    def __call__(self, x) -> jax.Array:
        return jnp.vectorize(self.value, signature="(n)->()")(jnp.asarray(x, dtype=jnp.float64))

    def __add__(self, other) -> Energy:
        return Sum((*self.terms, *as_energy(other, "a term of a sum").terms))

    __radd__ = __add__


class Quadratic(Energy):
    """``x @ A @ x / 2 + b @ x + c``.

    Parameters
    ----------
    A : array, shape (n, n) symmetric, or (n,) for a diagonal matrix
    b : array, shape (n,), optional
    c : float, optional
    """

    A: jax.Array
    b: jax.Array | None
    c: jax.Array

    def __init__(self, A, b=None, c=0.0):
        self.A = real_array(A)
        self.b = None if b is None else real_array(b)
        self.c = real_array(c)
        if self.A.ndim not in (1, 2) or len(set(self.A.shape)) != 1:
            raise InputError(f"A has shape (n, n), or (n,) for a diagonal, not {self.A.shape}")
        if self.b is not None and self.b.shape != self.A.shape[:1]:
            raise InputError(f"b has shape {self.A.shape[:1]} beside this A, not {self.b.shape}")
        if self.A.ndim == 2 and not isinstance(self.A, jax.core.Tracer):
            matrix = np.asarray(self.A)
            asymmetry = float(np.abs(matrix - matrix.T).max())
            if asymmetry > 1e-12 * float(np.abs(matrix).max()):
                raise InputError(f"A is not symmetric (by {asymmetry:.3g}); only its symmetric part (A + A.T)/2 acts")

    @property
    def is_quadratic(self) -> bool:
        return True

    def linear_part(self, x) -> jax.Array:
        """``A x``."""
        return self.A * x if self.A.ndim == 1 else self.A @ x

    def value(self, x) -> jax.Array:
        linear = 0.0 if self.b is None else jnp.dot(self.b, x)
        return 0.5 * jnp.dot(x, self.linear_part(x)) + linear + self.c

    def gradient(self, x) -> jax.Array:
        return self.linear_part(x) if self.b is None else self.linear_part(x) + self.b


class Function(Energy):
    """An energy given by a plain function from a JAX array, shape (n,), to a scalar; differentiated by JAX.

    The function may be an ``equinox.Module``: its arrays are then parameters of the system.
    """

    function: Callable
    quadratic: bool = eqx.field(static=True, default=False)

    @property
    def is_quadratic(self) -> bool:
        return self.quadratic

    def value(self, x) -> jax.Array:
        return jnp.asarray(self.function(x))


class Sum(Energy):
    """A sum of energies."""

    summands: tuple[Energy, ...]

    @property
    def terms(self) -> tuple[Energy, ...]:
        return self.summands

    @property
    def is_quadratic(self) -> bool:
        return all(term.is_quadratic for term in self.summands)

    def value(self, x) -> jax.Array:
        return sum((term.value(x) for term in self.summands[1:]), self.summands[0].value(x))

    def gradient(self, x) -> jax.Array:
        return sum((term.gradient(x) for term in self.summands[1:]), self.summands[0].gradient(x))


def as_energy(function, role: str) -> Energy:
    """An :class:`Energy` from one, from a Casimir polynomial (quadratic ones are recognised) or from a function."""
    if isinstance(function, Energy):
        return function
    if isinstance(function, mf.Polynomial) and function.degree <= 2:
        return _quadratic(function)
    if callable(function):
        return Function(function)
    raise FunctionError(f"{role} must be a function of the state or an lt.Quadratic, not {type(function).__name__}")


class OfPoint(Energy):
    """A function of the points of a space, as a function of their vectors, shape (n,)."""

    energy: Energy
    space: mf.Space = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(self.space.from_vector(x))


def on_points(energy: Energy, space: mf.Space | None) -> Energy:
    """An energy of the points of a space as one of their vectors; an lt.Quadratic is one of vectors already."""
    if space is None or space.shape == (space.size,):
        return energy
    terms = tuple(term if isinstance(term, Quadratic) else OfPoint(term, space) for term in energy.terms)
    return terms[0] if len(terms) == 1 else Sum(terms)


def _quadratic(polynomial: mf.Polynomial) -> Quadratic:
    A, b, c = np.zeros((polynomial.dim, polynomial.dim)), np.zeros(polynomial.dim), 0.0
    for power, coefficient in polynomial.terms:
        factors = np.repeat(np.arange(polynomial.dim), power)
        if len(factors) == 2:
            A[factors[0], factors[1]] += float(coefficient)
            A[factors[1], factors[0]] += float(coefficient)
        elif len(factors) == 1:
            b[factors[0]] += float(coefficient)
        else:
            c += float(coefficient)
    return Quadratic(A, b if b.any() else None, c)


def recognised(energy: Energy, dim: int) -> Energy:
    """The same energy, those of its plain functions marked that are written as polynomials of degree two."""
    if isinstance(energy, Sum):
        return Sum(tuple(recognised(term, dim) for term in energy.summands))
    if isinstance(energy, Function) and not energy.quadratic and polynomial_degree(_value, energy, dim) <= 2:
        return Function(energy.function, quadratic=True)
    return energy


def _value(energy: Energy, x):
    return energy.value(x)


def check_scalar(energy: Energy, dim: int, role: str) -> None:
    """Raise unless the energy maps a state of this dimension to one real number."""
    state = jax.ShapeDtypeStruct((dim,), jnp.float64)
    try:
        result = jax.eval_shape(energy.value, state)
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        raise FunctionError(
            f"{role} could not be evaluated on a state of shape ({dim},): {type(error).__name__}: {error}. "
            "It must be written with jax.numpy and accept one array"
        ) from error
    if result.shape != ():
        raise FunctionError(
            f"{role} must return one number, but it returns shape {result.shape}; did you mean jnp.sum?"
        )
    if not jnp.issubdtype(result.dtype, jnp.floating):
        raise FunctionError(f"{role} must return a real number, but it returns {result.dtype}")
