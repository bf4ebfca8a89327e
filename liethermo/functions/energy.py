"""Energies and entropies: functions of the state as sums of terms, quadratic or general.

The distinction matters to a discretisation. A quadratic term needs no discrete gradient, since its gradient at the
midpoint is one already; a general term gets a correction of its own, along its own coordinates where these are given
(:meth:`Energy.on`) [:doc:`/explanation/exact_laws`].
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf
from manifolds._arrays import is_traced, real_array
from manifolds._precision import with_library_settings
from manifolds._pytree_module import Module, forward_to

from ..errors import FunctionError, InputError
from ..tracing.programs import subprogram
from .arguments import (
    CoordinatesWithTime,
    FixedTimeFunction,
    NegatedFunction,
    StateTimeFunction,
    required_argument_count,
)
from .conditions import check_numbers
from .coordinates import ComponentMap, Components, check_coordinates
from .indices import clique_pattern, sparsity_pattern, union_pattern
from .path import CollocationPath, DiscreteGradientScheme
from .rounding import value_and_rounding_scale
from .time_span import TimeSpan


@subprogram
def _gradient(energy: Energy, x) -> jax.Array:
    return jax.grad(energy.value)(x)


MIN_BUFFERED_DIM = 1_000
"""Components from which a gradient is put into memory before anything is made of it."""


def _evaluate_buffered(function: Callable, x) -> jax.Array:
    """``function(x)`` of the shape of x, computed once: XLA computes elementwise results anew for each use of an entry.

    It keeps what a branch returns. NaN where the first entry of x is not finite.
    """
    return jax.lax.cond(jnp.isfinite(x[0]), function, lambda x: jnp.full_like(x, jnp.nan), x)


MAX_CLIQUE_COMPONENTS = 2_000
"""Components that a term may depend on together, for the pattern of what depends on what to be worth having."""


class Energy(Module):
    """A real function of the state with a gradient; energies add with ``+`` and subtract with ``-``.

    Calling one evaluates it: shape (..., n) to shape (...); with a time, shape (...), where it depends on one.
    """

    @abstractmethod
    def value(self, x) -> jax.Array:
        """The value at one state, shape (n,) to shape ()."""

    def gradient(self, x) -> jax.Array:
        """The gradient at one state, shape (n,)."""
        x = float64_array(x)
        return _gradient(self, x) if x.size < MIN_BUFFERED_DIM else _evaluate_buffered(lambda x: _gradient(self, x), x)

    def sensitivity(self, x) -> jax.Array:
        """``|grad f(x)| |x|``, of a sum the sum over its terms: the size at which the function is rounded.

        One rounding of the state changes f by eps times this, whatever the value of f is: ``log |x|^2`` has the
        sensitivity 2 where it vanishes, and a constant that is added to f has none. Every drift is judged against it.
        """
        return jax.lax.stop_gradient(jnp.linalg.norm(self.gradient(x)) * jnp.linalg.norm(x))

    def rounding_scale(self, x) -> jax.Array:
        """The size at which the value at x is rounded: that of the largest terms inside, though they cancel in it.

        Near q = 0 the value of ``1 - cos q`` is rounding, of the size of 1.
        """
        return jax.lax.stop_gradient(value_and_rounding_scale(self.value, x)[1])

    def difference_rounding_scale(self, x) -> jax.Array:
        """The size at which a difference of values of one term is rounded; zero where that has a closed form."""
        return jnp.zeros(()) if self.is_quadratic else self.rounding_scale(x)

    @property
    def terms(self) -> tuple[Energy, ...]:
        """The summands, none of them a sum itself."""
        return (self,)

    @property
    def is_quadratic(self) -> bool:
        """Whether it is known to be a polynomial of degree two at most: its gradient at a midpoint is then exact."""
        return False

    @property
    def degree(self) -> float:
        """Its degree as a polynomial, at most; infinity where it is not known to be one. Quadratures may be exact."""
        return 2.0 if self.is_quadratic else math.inf

    def discrete_gradient(self, scheme: DiscreteGradientScheme, x, d, compensation) -> jax.Array:
        """The discrete gradient of one term by a scheme, shape (n,), from x + compensation to x + compensation + d."""
        return (
            scheme.quadratic(self, x, d, compensation)
            if self.is_quadratic
            else scheme.general(self, x, d, compensation)
        )

    def stage_gradients(self, scheme: Callable, path: CollocationPath) -> jax.Array:
        """Those of one term at the stages of a collocation method, shape (s, n)."""
        return scheme(self, path)

    def pullback_to_chart(self, coordinates: mf.Coordinates, space: mf.Space, start=None) -> Energy:
        """A function of state vectors of a space, as one of coordinates.

        Where it is for one step, ``start`` is the state vector from which that leads.
        """
        return ChartEnergy(self, coordinates, space, start)

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        """The pattern of the Hessian: which components of the gradient depend on which of the state; None if unknown.

        The discrete gradients have it too.
        """
        return None

    def check_components(self, dim: int, role: str) -> None:
        """Raise unless the components that it depends on are those of a state of this dimension."""

    def on(self, coordinates: Sequence[int] | np.ndarray | Callable) -> Energy:
        """This energy as a function of some coordinates y of a larger state, ``x -> self(coordinates(x))``.

        Its discrete gradients are then corrected along y only and lie in the span of dy: a potential of positions
        puts no correction into momenta, one of distances keeps the momentum maps that distances are invariant under.

        Parameters
        ----------
        coordinates : sequence of int, or function from x, shape (n,), to y, shape (m,)
            Indices into the state, or a map at most quadratic in x (checked where a system is built).
        """
        return self.map_terms(lambda term: Pullback(term, coordinates))

    def map_terms(self, change: Callable[[Energy], Energy]) -> Energy:
        """The sum of what its terms become by ``change``, a function from a term to an energy."""
        return Sum.of([change(term) for term in self.terms])

    @property
    def depends_on_time(self) -> bool:
        """Whether it is a function of the state and the time; see :class:`TimeDependent`."""
        return False

    def at_time(self, t) -> Energy:
        """The function of the state alone that it is at a time."""
        return self

    def with_time(self) -> Energy:
        """The same as a function of the state with the time behind it, shape (n + 1,): of one that depends on both."""
        raise NotImplementedError(f"{type(self).__name__} does not depend on time")

    @with_library_settings
    def __call__(self, x, t=None) -> jax.Array:
        x = jnp.asarray(x, dtype=jnp.float64)
        if t is None:
            return jnp.vectorize(self.value, signature="(n)->()")(x)
        at = jnp.vectorize(lambda x, t: self.at_time(t).value(x), signature="(n),()->()")
        return at(x, jnp.asarray(t, dtype=jnp.float64))

    def __add__(self, other) -> Energy:
        return Sum((*self.terms, *make_energy(other, "a term of a sum").terms))

    __radd__ = __add__

    def __neg__(self) -> Energy:
        return Negative(self)

    def __sub__(self, other) -> Energy:
        return self + -make_energy(other, "a term of a sum")

    def __rsub__(self, other) -> Energy:
        return -self + other


def float64_array(x) -> jax.Array:
    """A state that may be given as a list, or in integers."""
    return jnp.asarray(x, dtype=jnp.float64)


class Quadratic(Energy):
    """``x @ A @ x / 2 + b @ x + c``.

    Parameters
    ----------
    A : array, shape (n, n) symmetric, or (n,) for a diagonal matrix
        The matrix of the quadratic form (unit of the function over that of ``x**2``): for a body the inverse inertia.
    b : array, shape (n,), optional
        The coefficients of the linear part (unit of the function over that of x); zero by default.
    c : float, optional
        The constant (unit of the function).

    Examples
    --------
    >>> energy = lt.Quadratic([1.0, 2.0, 3.0])
    >>> float(energy.value(jnp.array([1.0, 1.0, 0.0])))
    1.5
    >>> energy.gradient(jnp.array([1.0, 1.0, 0.0])).tolist()
    [1.0, 2.0, 0.0]
    """

    A: jax.Array
    b: jax.Array | None
    c: jax.Array

    def __init__(self, A, b=None, c=0.0):
        self.A = check_numbers(A, "A of a quadratic function")
        self.b = None if b is None else check_numbers(b, "b of a quadratic function")
        self.c = check_numbers(c, "c of a quadratic function", ())
        if self.A.ndim not in (1, 2) or len(set(self.A.shape)) != 1:
            raise InputError(f"A has shape (n, n), or (n,) for a diagonal, not {self.A.shape}")
        if self.b is not None and self.b.shape != self.A.shape[:1]:
            raise InputError(f"b has shape {self.A.shape[:1]} beside this A, not {self.b.shape}")
        if self.A.ndim == 2 and not isinstance(self.A, jax.core.Tracer):
            matrix = np.asarray(self.A)
            asymmetry = float(np.abs(matrix - matrix.T).max())
            if asymmetry > 1e-12 * float(np.abs(matrix).max()):
                raise InputError(f"A is not symmetric (by {asymmetry:.3g}); only its symmetric part (A + A.T)/2 acts")
            if asymmetry > 0.0:  # the gradient A x of the value x A x / 2 has to be exact
                self.A = real_array((matrix + matrix.T) / 2)

    is_quadratic = True

    def linear_part(self, x) -> jax.Array:
        """``A x``."""
        return self.A * x if self.A.ndim == 1 else self.A @ x

    def value(self, x) -> jax.Array:
        linear = 0.0 if self.b is None else jnp.dot(self.b, x)
        return 0.5 * jnp.dot(x, self.linear_part(x)) + linear + self.c

    def gradient(self, x) -> jax.Array:
        along = self.linear_part(float64_array(x))
        return along if self.b is None else along + self.b

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        if is_traced(self.A):
            return None
        places = np.nonzero(np.asarray(self.A))
        return sparsity_pattern(places[0], places[-1], dim)

    def __neg__(self) -> Energy:
        return Quadratic(-self.A, None if self.b is None else -self.b, -self.c)


class Linear(Energy):
    """``b @ x``, whose gradient does not depend on the state.

    Parameters
    ----------
    b : array, shape (n,)
    """

    b: jax.Array

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return jnp.dot(self.b, x)

    def gradient(self, x) -> jax.Array:
        return self.b

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        return sparsity_pattern([], [], dim)

    def __neg__(self) -> Energy:
        return Linear(-self.b)


class Function(Energy):
    """An energy given by a plain function from a JAX array, shape (n,), to a scalar; differentiated by JAX.

    The function may be an ``equinox.Module``: its arrays are then parameters of the system.
    """

    function: Callable
    degree: float = eqx.field(static=True, default=math.inf)

    @property
    def is_quadratic(self) -> bool:
        return self.degree <= 2

    def value(self, x) -> jax.Array:
        return jnp.asarray(self.function(x))


class TimeDependent(Energy):
    """An energy ``H(x, t)`` that is changed from outside: a field that is turned, a piston that is moved.

    A plain function of two arguments is taken for one wherever the energy of a system is asked for; this class says so
    of any function, and makes terms of sums. ``lt.Quadratic(A) + lt.TimeDependent(V)`` needs a correction for V only,
    and ``lt.TimeDependent(V).on(range(n))`` is a function of the first n components and the time.

    Parameters
    ----------
    function : function from x, shape (n,), and t, shape (), to a scalar
        An ``equinox.Module`` too: its arrays are then parameters of the system.
    """

    function: Callable

    depends_on_time = True

    def at_time(self, t) -> Energy:
        return Function(FixedTimeFunction(self.function, jnp.asarray(t, dtype=jnp.float64)))

    def with_time(self) -> Energy:
        return StateTimeEnergy(SpanLimitedEnergy(Function(StateTimeFunction(self.function)), TimeSpan()))

    def value(self, x) -> jax.Array:
        raise InputError("this energy depends on time, so its value is known at a time only: energy(x, t)")

    def __neg__(self) -> Energy:
        return TimeDependent(NegatedFunction(self.function))


class SpanLimitedEnergy(Energy):
    """A function of a state and the time behind it, shape (n + 1,), evaluated at times within a span only."""

    energy: Energy
    span: TimeSpan

    def _clip(self, z) -> jax.Array:
        return jnp.append(z[:-1], self.span.clip(z[-1]))

    def value(self, z) -> jax.Array:
        return self.energy.value(self._clip(z))

    def gradient(self, z) -> jax.Array:
        return self.energy.gradient(self._clip(z))

    def sensitivity(self, z) -> jax.Array:
        return self.energy.sensitivity(self._clip(z))

    def rounding_scale(self, z) -> jax.Array:
        return self.energy.rounding_scale(self._clip(z))


class StateTimeEnergy(Energy):
    """A function of a state and the time behind it, with what it changes by divided between the two.

    A discrete gradient is, by the state, one of the mean over both ends in time, and by the time the difference
    quotient of the mean over both states. At the stages of a collocation method the corrections along the state and
    along the time are weighted by the squares of the gradient by the one and by the other. So it does not matter in
    which units time is measured, and a function that does not depend on it has the gradients of one of the state.
    """

    energy: Energy

    is_quadratic = forward_to("energy")
    value = forward_to("energy")

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        if self.is_quadratic:
            return scheme.quadratic(self, x, d, compensation)
        compensation = jnp.zeros_like(x) + compensation
        ends = jnp.stack([x + compensation, x + (compensation + d)])

        def mean(states, times):
            values = jax.vmap(lambda y, t: self.value(jnp.append(y, t)))(states, times)
            return 0.5 * (values[0] + values[1])

        def mean_by_state(y):
            return mean(jnp.stack([y, y]), ends[:, -1])

        def mean_by_time(t):
            return mean(ends[:, :-1], jnp.concatenate([t, t]))

        by_state = scheme.general(Function(mean_by_state), x[:-1], d[:-1], compensation[:-1])
        return jnp.concatenate([by_state, scheme.general(Function(mean_by_time), x[-1:], d[-1:], compensation[-1:])])

    def stage_gradients(self, scheme, path) -> jax.Array:
        return scheme(self, path, correction_weights=_squared_gradient_weights)


def _squared_gradient_weights(gradients) -> jax.Array:
    """Squares of gradients, shape (s, m): that by the state, for each of its components, and that by the time."""
    size = jnp.max(jnp.abs(gradients))
    squares = jnp.sum((gradients / jnp.where(size > 0.0, size, 1.0)) ** 2, axis=0)
    return jnp.append(jnp.full(gradients.shape[1] - 1, jnp.sum(squares[:-1])), squares[-1])


class Pullback(Energy):
    """A term that depends on the state through coordinates ``y = pi(x)`` at most quadratic in it; see Energy.on.

    For such a map ``y' - y = Dpi(z) d`` with z the midpoint, exactly, so ``Dpi(z)^T`` takes discrete gradients in y to
    discrete gradients in x [Gonzalez 1996]. A choice of components leaves what is known of the term as it is.
    """

    term: Energy
    coordinates: Callable

    def __init__(self, term: Energy, coordinates: Sequence[int] | np.ndarray | Callable):
        self.term, self.coordinates = term, coordinates if callable(coordinates) else Components.of(coordinates)

    @property
    def _selects_components(self) -> bool:
        return isinstance(self.coordinates, ComponentMap)

    @property
    def is_quadratic(self) -> bool:
        return self._selects_components and self.term.is_quadratic

    def value(self, x) -> jax.Array:
        return self.term.value(self.coordinates(x))

    def gradient(self, x) -> jax.Array:
        y, back = jax.vjp(self.coordinates, float64_array(x))
        return back(self.term.gradient(y))[0]  # in its own way, where it has one

    def sensitivity(self, x) -> jax.Array:
        own = self._selects_components or isinstance(self.term, StateTimeEnergy)
        return self.term.sensitivity(self.coordinates(x)) if own else super().sensitivity(x)

    def rounding_scale(self, x) -> jax.Array:
        return self.term.rounding_scale(self.coordinates(x)) if self._selects_components else super().rounding_scale(x)

    def difference_rounding_scale(self, x) -> jax.Array:
        return (
            self.term.difference_rounding_scale(self.coordinates(x))
            if self._selects_components
            else super().difference_rounding_scale(x)
        )

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        if self.is_quadratic:  # at points of whole states, which others look at too
            return scheme.quadratic(self, x, d, compensation)
        of, compensation = self.coordinates, jnp.zeros_like(x) + compensation
        middle, kept = x + (compensation + 0.5 * d), jax.jvp(of, (x + 0.5 * compensation,), (compensation,))[1]
        step = jax.jvp(of, (middle,), (d,))[1]
        (back,) = jax.vjp(of, middle)[1](self.term.discrete_gradient(scheme, of(x), step, kept))
        return back

    def stage_gradients(self, scheme, path) -> jax.Array:
        path, back = path.map_coordinates(self.coordinates)
        return back(self.term.stage_gradients(scheme, path))

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        if not isinstance(self.coordinates, Components) or len(self.coordinates.indices) > MAX_CLIQUE_COMPONENTS:
            return None
        return clique_pattern([np.asarray(self.coordinates.indices) % dim], dim)

    def check_components(self, dim: int, role: str) -> None:
        check_coordinates(self.coordinates, dim, role)

    depends_on_time = forward_to("term")

    def at_time(self, t) -> Energy:
        return eqx.tree_at(lambda e: e.term, self, self.term.at_time(t)) if self.depends_on_time else self

    def with_time(self) -> Energy:
        return Pullback(self.term.with_time(), CoordinatesWithTime(self.coordinates))

    def __neg__(self) -> Energy:
        return Pullback(-self.term, self.coordinates)


class Negative(Energy):
    """Minus a term."""

    term: Energy

    is_quadratic = forward_to("term")

    def value(self, x) -> jax.Array:
        return -self.term.value(x)

    def gradient(self, x) -> jax.Array:
        return -self.term.gradient(x)

    sensitivity = forward_to("term")

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        return -self.term.discrete_gradient(scheme, x, d, compensation)

    def stage_gradients(self, scheme, path) -> jax.Array:
        return -self.term.stage_gradients(scheme, path)

    couplings = forward_to("term")
    check_components = forward_to("term")

    def __neg__(self) -> Energy:
        return self.term


class Sum(Energy):
    """A sum of energies."""

    summands: tuple[Energy, ...]

    @classmethod
    def of(cls, terms: Sequence[Energy]) -> Energy:
        """A sum of some, which is the one where there is no other."""
        return terms[0] if len(terms) == 1 else cls(tuple(terms))

    @property
    def terms(self) -> tuple[Energy, ...]:
        return self.summands

    @property
    def is_quadratic(self) -> bool:
        return all(term.is_quadratic for term in self.summands)

    @property
    def depends_on_time(self) -> bool:
        return any(term.depends_on_time for term in self.summands)

    def at_time(self, t) -> Energy:
        return Sum(tuple(term.at_time(t) for term in self.summands))

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        return union_pattern(term.couplings(dim) for term in self.summands)

    def __neg__(self) -> Energy:
        return Sum(tuple(-term for term in self.summands))

    def value(self, x) -> jax.Array:
        return sum((term.value(x) for term in self.summands[1:]), self.summands[0].value(x))

    def gradient(self, x) -> jax.Array:
        return sum((term.gradient(x) for term in self.summands[1:]), self.summands[0].gradient(x))

    def sensitivity(self, x) -> jax.Array:
        return sum((term.sensitivity(x) for term in self.summands[1:]), self.summands[0].sensitivity(x))


def function_name(energy: Energy) -> str:
    """The name of the plain function that an energy is given by; empty where there is none."""
    return getattr(energy.function, "__name__", "") if isinstance(energy, Function | TimeDependent) else ""


def make_energy(function, role: str) -> Energy:
    """An :class:`Energy` from one, from a Casimir polynomial (quadratic ones are recognised) or from a function.

    One that needs two arguments is a function of the state and the time.
    """
    if isinstance(function, Energy):
        return function
    if isinstance(function, mf.Polynomial) and function.degree <= 2:
        return quadratic_from_polynomial(function)
    if callable(function):
        return TimeDependent(function) if required_argument_count(function) == 2 else Function(function)
    raise FunctionError(f"{role} must be a function of the state or an lt.Quadratic, not {type(function).__name__}")


CHART_ROUNDINGS = 4.0
"""Roundings of each component of a point that a chart computes."""


class ChartEnergy(Energy):
    """A function of state vectors, as one of coordinates."""

    energy: Energy
    coordinates: mf.Coordinates
    space: mf.Space = eqx.field(static=True)
    start: jax.Array | None = None

    def value(self, x) -> jax.Array:
        return self.energy.value(self.space.to_vector(self.coordinates.point(x)))

    def rounding_scale(self, x) -> jax.Array:
        """At the start of the step, where that is known: so it is found once, not at every iteration."""
        if self.start is None:
            return super().rounding_scale(x)
        return self.energy.rounding_scale(self.start) + CHART_ROUNDINGS * self.energy.sensitivity(self.start)


def quadratic_from_polynomial(polynomial: mf.Polynomial) -> Quadratic:
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
