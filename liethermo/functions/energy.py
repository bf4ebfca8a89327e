"""Energies and entropies: functions of the state as sums of terms, quadratic or general.

A discretisation treats the two kinds differently. The gradient of a quadratic term at the midpoint is a discrete
gradient already. A general term gets a correction of its own, along its own coordinates if these are given
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
from ..tracing.programs import jit_if_traced
from ..tracing.short_form import callable_name, short_form
from .conditions import checked_numbers
from .indices import (
    ComponentMap,
    Components,
    check_coordinates_are_quadratic,
    clique_pattern,
    sparsity_pattern,
    union_pattern,
)
from .path import CollocationPath, DiscreteGradientScheme
from .rounding import value_and_rounding_scale
from .time_span import (
    CoordinatesWithTime,
    DeclaredTimes,
    FixedTimeFunction,
    FunctionWithBreaks,
    MultipleFunction,
    NegatedFunction,
    StateTimeFunction,
    TimeSpan,
    checked_breaks,
    required_argument_count,
)


@jit_if_traced
def _autodiff_gradient(energy: Energy, x) -> jax.Array:
    """Return the gradient of an energy at a state, computed by JAX."""
    return jax.grad(energy.value)(x)


MIN_BUFFERED_DIM = 1_000
"""Number of components from which a gradient is stored in memory before it is used."""


def _evaluate_into_buffer(function: Callable, x) -> jax.Array:
    """Return ``function(x)``, of the shape of x, computed once and stored; NaN if the first entry of x is not finite.

    XLA would compute elementwise results anew for each use of an entry, but it stores the result of a branch.
    """
    return jax.lax.cond(jnp.isfinite(x[0]), function, lambda x: jnp.full_like(x, jnp.nan), x)


MAX_CLIQUE_COMPONENTS = 2_000
"""Largest number of components of a term whose block in :meth:`Energy.hessian_pattern` is dense."""


class Energy(Module):
    """A real function of the state with a gradient; energies add with ``+``, subtract with ``-``, and scale with ``*``.

    Calling an energy evaluates it, from shape (..., n) to shape (...); an energy that depends on time also takes a
    time, shape (...).
    """

    __repr__ = short_form

    @abstractmethod
    def value(self, x) -> jax.Array:
        """Return the value at one state, shape (n,), as an array of shape ()."""

    def gradient(self, x) -> jax.Array:
        """Return the gradient at one state, shape (n,)."""
        x = float64_array(x)
        return (
            _autodiff_gradient(self, x)
            if x.size < MIN_BUFFERED_DIM
            else _evaluate_into_buffer(lambda x: _autodiff_gradient(self, x), x)
        )

    def sensitivity(self, x) -> jax.Array:
        """Return the scale ``|grad f(x)| |x|`` of the errors that rounding of x causes; for a sum, added over terms.

        One rounding of the state changes f by eps times this scale, whatever the value of f is: ``log |x|^2`` has the
        sensitivity 2 where it vanishes, and a constant that is added to f has none. Every drift is judged relative to
        it.
        """
        return jax.lax.stop_gradient(jnp.linalg.norm(self.gradient(x)) * jnp.linalg.norm(x))

    def rounding_scale(self, x) -> jax.Array:
        """Return the size of the largest terms inside the value at x, to whose eps it is rounded even if they cancel.

        Near q = 0 the value of ``1 - cos q`` consists of rounding at the scale 1.
        """
        return jax.lax.stop_gradient(value_and_rounding_scale(self.value, x)[1])

    def difference_rounding_scale(self, x) -> jax.Array:
        """Return the scale at which a difference of values of one term is rounded; zero if it has a closed form."""
        return jnp.zeros(()) if self.is_quadratic else self.rounding_scale(x)

    @property
    def terms(self) -> tuple[Energy, ...]:
        """Return the summands, none of which is a sum."""
        return (self,)

    @property
    def is_quadratic(self) -> bool:
        """True if the energy is known to be a polynomial of degree at most two, whose midpoint gradient is exact."""
        return False

    @property
    def degree(self) -> float:
        """Upper bound of the degree as a polynomial, infinity if none is known.

        Quadratures of low degree are exact.
        """
        return 2.0 if self.is_quadratic else math.inf

    def discrete_gradient(self, scheme: DiscreteGradientScheme, x, d, compensation) -> jax.Array:
        """Return the discrete gradient of one term, shape (n,), from x + compensation to x + compensation + d."""
        return (
            scheme.quadratic(self, x, d, compensation)
            if self.is_quadratic
            else scheme.general(self, x, d, compensation)
        )

    def stage_gradients(self, scheme: Callable, path: CollocationPath) -> jax.Array:
        """Return the discrete gradients of one term at the stages of a collocation method, shape (s, n)."""
        return scheme(self, path)

    def pullback_to_chart(self, coordinates: mf.Coordinates, space: mf.Space, start=None) -> Energy:
        """Return this energy of state vectors of a space as an energy of the coordinates of a chart.

        For a single step, ``start`` is the state vector at which the step begins.
        """
        return ChartEnergy(self, coordinates, space, start)

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array | None:
        """Return the sparsity pattern of the Hessian, or None if it is unknown.

        The discrete gradients have the same pattern.
        """
        return self.couplings(dim)

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        """Return None; a subclass may define :meth:`hessian_pattern` by this name, which it had in 0.2."""
        return None

    def check_components(self, dim: int, role: str) -> None:
        """Raise an error unless a state of this dimension has the components that the energy depends on."""

    def on(self, coordinates: Sequence[int] | np.ndarray | Callable) -> Energy:
        """Return this energy as a function of some coordinates y of a larger state, ``x -> self(coordinates(x))``.

        Its discrete gradients are then corrected along y only and lie in the span of dy: a potential of positions puts
        no correction into momenta, and a potential of distances conserves the momentum maps under which distances are
        invariant.

        Parameters
        ----------
        coordinates : sequence of int, or function from x, shape (n,), to y, shape (m,)
            Indices into the state, or a map at most quadratic in x (checked when a system is built).
        """
        return self.map_terms(lambda term: Pullback(term, coordinates))

    def map_terms(self, transform: Callable[[Energy], Energy]) -> Energy:
        """Return the sum of ``transform(term)``, an energy, over the terms."""
        return Sum.from_terms([transform(term) for term in self.terms])

    @property
    def depends_on_time(self) -> bool:
        """True for a function of the state and the time; see :class:`TimeDependent`."""
        return False

    def at_time(self, t) -> Energy:
        """Return the energy at a fixed time, as a function of the state."""
        return self

    def with_time(self) -> Energy:
        """Return a time-dependent energy as an energy of the state with the time appended, shape (n + 1,)."""
        raise NotImplementedError(f"{type(self).__name__} does not depend on time")

    @with_library_settings
    def __call__(self, x, t=None) -> jax.Array:
        x = self.flattened_states(jnp.asarray(x, dtype=jnp.float64))
        if t is None:
            return jnp.vectorize(self.value, signature="(n)->()")(x)
        evaluate = jnp.vectorize(lambda x, t: self.at_time(t).value(x), signature="(n),()->()")
        return evaluate(x, jnp.asarray(t, dtype=jnp.float64))

    def flattened_states(self, x) -> jax.Array:
        """Return states, shape (..., n), from states in that shape or in another one that the energy accepts."""
        return x

    def __add__(self, other) -> Energy:
        return Sum((*self.terms, *make_energy(other, "a term of a sum").terms))

    def __radd__(self, other) -> Energy:
        return self if type(other) is int and other == 0 else self + other  # the sum of a list begins with 0

    def __neg__(self) -> Energy:
        return Negative(self)

    def __sub__(self, other) -> Energy:
        return self + -make_energy(other, "a term of a sum")

    def __rsub__(self, other) -> Energy:
        return -self + other

    __array_ufunc__ = None  # a number of NumPy times an energy is an energy

    def __mul__(self, factor) -> Energy:
        factor = checked_numbers(factor, "the factor of an energy", ())
        return self.map_terms(lambda term: term.multiple(factor))

    __rmul__ = __mul__

    def __truediv__(self, divisor) -> Energy:
        return self * (1.0 / checked_numbers(divisor, "the divisor of an energy", ()))

    def multiple(self, factor) -> Energy:
        """Return a term times a number, the factor, shape ()."""
        return Multiple(self, factor)


def float64_array(x) -> jax.Array:
    """Return a state, which may be a list or integers, as an array of float64."""
    return jnp.asarray(x, dtype=jnp.float64)


class Quadratic(Energy):
    """A quadratic energy or entropy, ``x @ A @ x / 2 + b @ x + c``.

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
        self.A = checked_numbers(A, "A of a quadratic function")
        self.b = None if b is None else checked_numbers(b, "b of a quadratic function")
        self.c = checked_numbers(c, "c of a quadratic function", ())
        if self.A.ndim not in (1, 2) or len(set(self.A.shape)) != 1:
            raise InputError(f"A must have shape (n, n), or (n,) for a diagonal matrix, got {self.A.shape}")
        if self.b is not None and self.b.shape != self.A.shape[:1]:
            raise InputError(f"b must have shape {self.A.shape[:1]} to match A, got {self.b.shape}")
        if self.A.ndim == 2 and not isinstance(self.A, jax.core.Tracer):
            matrix = np.asarray(self.A)
            asymmetry = float(np.abs(matrix - matrix.T).max())
            if asymmetry > 1e-12 * float(np.abs(matrix).max()):
                raise InputError(
                    f"A must be symmetric, but it differs from its transpose by {asymmetry:.3g}. Use (A + A.T) / 2"
                )
            if asymmetry > 0.0:  # A x must be the exact gradient of x A x / 2
                self.A = real_array((matrix + matrix.T) / 2)

    is_quadratic = True

    def apply_matrix(self, x) -> jax.Array:
        """Return the matrix of the quadratic form times x, shape (n,)."""
        return self.A * x if self.A.ndim == 1 else self.A @ x

    def value(self, x) -> jax.Array:
        linear = 0.0 if self.b is None else jnp.dot(self.b, x)
        return 0.5 * jnp.dot(x, self.apply_matrix(x)) + linear + self.c

    def gradient(self, x) -> jax.Array:
        matrix_vector_product = self.apply_matrix(float64_array(x))
        return matrix_vector_product if self.b is None else matrix_vector_product + self.b

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array | None:
        if is_traced(self.A):
            return None
        indices = np.nonzero(np.asarray(self.A))
        return sparsity_pattern(indices[0], indices[-1], dim)

    def multiple(self, factor) -> Energy:
        return Quadratic(factor * self.A, None if self.b is None else factor * self.b, factor * self.c)

    def __neg__(self) -> Energy:
        return Quadratic(-self.A, None if self.b is None else -self.b, -self.c)


class Linear(Energy):
    """A linear energy, ``b @ x``, whose gradient does not depend on the state.

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

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        return sparsity_pattern([], [], dim)

    def __neg__(self) -> Energy:
        return Linear(-self.b)


class Function(Energy):
    """An energy given by a plain function from a JAX array, shape (n,), to a scalar; JAX differentiates it.

    The function may be an ``equinox.Module``, whose arrays are then parameters of the system.

    Parameters
    ----------
    function : callable
        From x, shape (n,), to a scalar, by jax.numpy.
    degree : float, optional
        Degree of a polynomial, for which methods have special formulas; infinite by default.

    Examples
    --------
    >>> well = lt.Function(lambda x: x[0] ** 4 / 4 - x[0] ** 2 / 2)
    >>> print(well.gradient(np.array([2.0])))
    [6.]
    """

    function: Callable
    degree: float = eqx.field(static=True, default=math.inf)

    @property
    def is_quadratic(self) -> bool:
        return self.degree <= 2

    def value(self, x) -> jax.Array:
        return jnp.asarray(self.function(x))


class TimeDependent(Energy, FunctionWithBreaks):
    """An energy ``H(x, t)`` that depends on time, such as that of a rotating field or a moving piston.

    A plain function of two arguments is taken as such an energy wherever a system expects one. This class declares any
    function as time-dependent, and makes it a term of a sum. In ``lt.Quadratic(A) + lt.TimeDependent(V)`` only V needs
    a correction, and ``lt.TimeDependent(V).on(range(n))`` is a function of the first n components and the time.

    Parameters
    ----------
    function : function from x, shape (n,), and t, shape (), to a scalar
        The function may be an ``equinox.Module``, whose arrays are then parameters of the system.
    breaks : sequence of float
        Times at which the function jumps or has a kink; the steps of a run end there.

    Examples
    --------
    >>> field = lt.TimeDependent(lambda x, t: -jnp.cos(t) * x[0])
    >>> energy = lt.Quadratic(np.ones(2)) + field
    >>> float(energy(np.array([1.0, 0.0]), 0.0))
    -0.5
    """

    function: Callable
    breaks: tuple[float, ...] = eqx.field(static=True, default=(), converter=checked_breaks)

    depends_on_time = True

    @property
    def break_times(self) -> tuple[float, ...]:
        return (*self.breaks, *DeclaredTimes.from_tree(self.function).jumps)

    @property
    def kink_times(self) -> tuple[float, ...]:
        return DeclaredTimes.from_tree(self.function).kinks

    @property
    def known_span(self) -> tuple[float, float]:
        return DeclaredTimes.from_tree(self.function).known_span

    def at_time(self, t) -> Energy:
        return Function(FixedTimeFunction(self.function, jnp.asarray(t, dtype=jnp.float64)))

    def with_time(self) -> Energy:
        return StateTimeEnergy(SpanLimitedEnergy(Function(StateTimeFunction(self.function)), TimeSpan()))

    def value(self, x) -> jax.Array:
        raise InputError("this energy depends on time, so its value needs a time. Call energy(x, t)")

    def multiple(self, factor) -> Energy:
        return TimeDependent(MultipleFunction(self.function, factor), self.breaks)

    def __neg__(self) -> Energy:
        return TimeDependent(NegatedFunction(self.function), self.breaks)


class SpanLimitedEnergy(Energy):
    """An energy of a state with the time appended, shape (n + 1,), whose time is clipped to a span."""

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
    """A function of a state with the time appended, whose change is divided between the state and the time.

    The components of a discrete gradient by the state are those of the mean over both end times; the component by the
    time is the difference quotient of the mean over both end states. At the stages of a collocation method the
    corrections along the state and along the time are weighted by the squares of the two gradients. The result does not
    depend on the unit of time, and a function that does not depend on time has the gradients of a function of the
    state.
    """

    energy: Energy

    is_quadratic = forward_to("energy")
    value = forward_to("energy")

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        if self.is_quadratic:
            return scheme.quadratic(self, x, d, compensation)
        compensation = jnp.zeros_like(x) + compensation
        ends = jnp.stack([x + compensation, x + (compensation + d)])

        def mean_of_two_values(states, times):
            values = jax.vmap(lambda y, t: self.value(jnp.append(y, t)))(states, times)
            return 0.5 * (values[0] + values[1])

        def average_over_end_times(y):
            return mean_of_two_values(jnp.stack([y, y]), ends[:, -1])

        def average_over_end_states(t):
            return mean_of_two_values(ends[:, :-1], jnp.concatenate([t, t]))

        state_gradient = scheme.general(Function(average_over_end_times), x[:-1], d[:-1], compensation[:-1])
        return jnp.concatenate(
            [state_gradient, scheme.general(Function(average_over_end_states), x[-1:], d[-1:], compensation[-1:])]
        )

    def stage_gradients(self, scheme, path) -> jax.Array:
        return scheme(self, path, correction_weights=_squared_gradient_weights)


def _squared_gradient_weights(gradients) -> jax.Array:
    """Return weights, shape (m,), of the components of a correction: those of the state, then that of the time.

    The weight of each component of the state is the squared norm of the gradient by the state, and the weight of the
    time is the squared derivative by the time; ``gradients``, shape (s, m), are those at the stages.
    """
    scale = jnp.max(jnp.abs(gradients))
    squares = jnp.sum((gradients / jnp.where(scale > 0.0, scale, 1.0)) ** 2, axis=0)
    return jnp.append(jnp.full(gradients.shape[1] - 1, jnp.sum(squares[:-1])), squares[-1])


class Pullback(Energy):
    """A term that depends on the state through coordinates ``y = pi(x)`` at most quadratic in x; see :meth:`Energy.on`.

    For such a map ``y' - y = Dpi(z) d`` exactly, with z the midpoint, so ``Dpi(z)^T`` maps discrete gradients in y to
    discrete gradients in x [Gonzalez 1996]. If the map selects components, a quadratic term stays quadratic.
    """

    term: Energy
    coordinates: Callable

    def __init__(self, term: Energy, coordinates: Sequence[int] | np.ndarray | Callable):
        self.term, self.coordinates = (
            term,
            coordinates if callable(coordinates) else Components.from_indices(coordinates),
        )

    @property
    def _selects_components(self) -> bool:
        """True if the coordinates are components of the state, reordered or scaled."""
        return isinstance(self.coordinates, ComponentMap)

    @property
    def is_quadratic(self) -> bool:
        return self._selects_components and self.term.is_quadratic

    def value(self, x) -> jax.Array:
        return self.term.value(self.coordinates(x))

    def gradient(self, x) -> jax.Array:
        y, pull_back = jax.vjp(self.coordinates, float64_array(x))
        return pull_back(self.term.gradient(y))[0]  # a term may override its gradient

    def sensitivity(self, x) -> jax.Array:
        uses_term = self._selects_components or isinstance(self.term, StateTimeEnergy)
        return self.term.sensitivity(self.coordinates(x)) if uses_term else super().sensitivity(x)

    def rounding_scale(self, x) -> jax.Array:
        return self.term.rounding_scale(self.coordinates(x)) if self._selects_components else super().rounding_scale(x)

    def difference_rounding_scale(self, x) -> jax.Array:
        return (
            self.term.difference_rounding_scale(self.coordinates(x))
            if self._selects_components
            else super().difference_rounding_scale(x)
        )

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        if self.is_quadratic:  # at the midpoint of the whole state, which other terms use too
            return scheme.quadratic(self, x, d, compensation)
        coordinates, compensation = self.coordinates, jnp.zeros_like(x) + compensation
        midpoint = x + (compensation + 0.5 * d)
        term_compensation = jax.jvp(coordinates, (x + 0.5 * compensation,), (compensation,))[1]
        step = jax.jvp(coordinates, (midpoint,), (d,))[1]
        (gradient,) = jax.vjp(coordinates, midpoint)[1](
            self.term.discrete_gradient(scheme, coordinates(x), step, term_compensation)
        )
        return gradient

    def stage_gradients(self, scheme, path) -> jax.Array:
        path, pull_back = path.path_and_pullback_in(self.coordinates)
        return pull_back(self.term.stage_gradients(scheme, path))

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array | None:
        if not isinstance(self.coordinates, Components) or len(self.coordinates.indices) > MAX_CLIQUE_COMPONENTS:
            return None
        return clique_pattern([np.asarray(self.coordinates.indices) % dim], dim)

    def check_components(self, dim: int, role: str) -> None:
        check_coordinates_are_quadratic(self.coordinates, dim, role)

    depends_on_time = forward_to("term")

    def at_time(self, t) -> Energy:
        return eqx.tree_at(lambda e: e.term, self, self.term.at_time(t)) if self.depends_on_time else self

    def with_time(self) -> Energy:
        return Pullback(self.term.with_time(), CoordinatesWithTime(self.coordinates))

    def multiple(self, factor) -> Energy:
        return Pullback(self.term.multiple(factor), self.coordinates)

    def __neg__(self) -> Energy:
        return Pullback(-self.term, self.coordinates)


class Negative(Energy):
    """The negative of a term."""

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

    hessian_pattern = forward_to("term")
    check_components = forward_to("term")
    flattened_states = forward_to("term")

    def __neg__(self) -> Energy:
        return self.term


class Multiple(Energy):
    """A term times a number, shape ()."""

    term: Energy
    factor: jax.Array

    is_quadratic = forward_to("term")
    degree = forward_to("term")

    def value(self, x) -> jax.Array:
        return self.factor * self.term.value(x)

    def gradient(self, x) -> jax.Array:
        return self.factor * self.term.gradient(x)

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        return self.factor * self.term.discrete_gradient(scheme, x, d, compensation)

    def stage_gradients(self, scheme, path) -> jax.Array:
        return self.factor * self.term.stage_gradients(scheme, path)

    hessian_pattern = forward_to("term")
    check_components = forward_to("term")
    flattened_states = forward_to("term")

    def multiple(self, factor) -> Energy:
        return Multiple(self.term, factor * self.factor)

    def __neg__(self) -> Energy:
        return Multiple(self.term, -self.factor)


class Sum(Energy):
    """A sum of energies."""

    summands: tuple[Energy, ...]

    @classmethod
    def from_terms(cls, terms: Sequence[Energy]) -> Energy:
        """Return the sum of some terms; a single term is returned as it is."""
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

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array | None:
        return union_pattern(term.hessian_pattern(dim) for term in self.summands)

    def flattened_states(self, x) -> jax.Array:
        for term in self.summands:
            x = term.flattened_states(x)
        return x

    def __neg__(self) -> Energy:
        return Sum(tuple(-term for term in self.summands))

    def value(self, x) -> jax.Array:
        return sum((term.value(x) for term in self.summands[1:]), self.summands[0].value(x))

    def gradient(self, x) -> jax.Array:
        return sum((term.gradient(x) for term in self.summands[1:]), self.summands[0].gradient(x))

    def sensitivity(self, x) -> jax.Array:
        return sum((term.sensitivity(x) for term in self.summands[1:]), self.summands[0].sensitivity(x))


def map_operands(energy: Energy, transform: Callable[[Energy], Energy]) -> Energy:
    """Return a sum, negative or multiple with ``transform(operand)`` for each operand; another energy unchanged."""
    if isinstance(energy, Sum):
        return Sum(tuple(map(transform, energy.summands)))
    if isinstance(energy, Negative):
        return Negative(transform(energy.term))
    if isinstance(energy, Multiple):
        return Multiple(transform(energy.term), energy.factor)
    return energy


def function_name(energy: Energy) -> str:
    """Return the name of the Python function that an energy was made from; "" if there is none."""
    return callable_name(energy.function, "") if isinstance(energy, Function | TimeDependent) else ""


def make_energy(function, role: str) -> Energy:
    """Return an :class:`Energy` from an energy, a Casimir polynomial, a function, or a list of them, which is a sum.

    A polynomial becomes quadratic if possible. A function that needs two arguments is one of the state and the time.
    """
    if isinstance(function, Energy):
        return function
    if isinstance(function, list) and function:
        return Sum(tuple(summand for term in function for summand in make_energy(term, f"each term of {role}").terms))
    if isinstance(function, mf.Polynomial) and function.degree <= 2:
        return quadratic_from_polynomial(function)
    if callable(function):
        return TimeDependent(function) if required_argument_count(function) == 2 else Function(function)
    raise FunctionError(f"{role} must be a function of the state or an lt.Quadratic, got {type(function).__name__}")


CHART_ROUNDINGS = 4.0
"""Number of roundings in each component of a point that a chart computes."""


class ChartEnergy(Energy):
    """An energy of the state vectors of a space, evaluated on the coordinates of a chart."""

    energy: Energy
    coordinates: mf.Coordinates
    space: mf.Space = eqx.field(static=True)
    start: jax.Array | None = None

    def value(self, x) -> jax.Array:
        return self.energy.value(self.space.to_vector(self.coordinates.point(x)))

    def rounding_scale(self, x) -> jax.Array:
        """Return the rounding scale at the start of the step, if it is known, so that iterations share one value."""
        if self.start is None:
            return super().rounding_scale(x)
        return self.energy.rounding_scale(self.start) + CHART_ROUNDINGS * self.energy.sensitivity(self.start)


def quadratic_from_polynomial(polynomial: mf.Polynomial) -> Quadratic:
    """Return a polynomial of degree at most two as a :class:`Quadratic`."""
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
