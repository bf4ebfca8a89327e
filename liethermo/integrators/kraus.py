"""Steps of Lindblad's equation that are quantum channels: completely positive, and exact in the trace."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.matrices.exponential import expm
from manifolds.matrices.linear import adjoint

from ..dissipation.lindblad import LindbladJumps
from ..errors import InputError
from ..systems import QuantumSystem, System
from ..systems.kind_checks import require_kind, unwrap_user_system
from .base import OneStepMethod, register
from .explicit import StepRow
from .runge_kutta import END_SLOPE_ROW, hermite_cubic_weights

KRAUS_ORDERS = (2, 4)
"""Orders of :class:`KrausMethod`."""

SIMPSON_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0
"""Weights of Simpson's rule at the start, the middle and the end of an interval; all are positive."""


class KrausMethod(OneStepMethod):
    """Steps of Lindblad's equation that are quantum channels, for any step size [Cao & Lu 2025].

    Duhamel's formula writes the state as an integral over the time of the last jump,

        rho(t) = W(t, 0) rho W(t, 0)^H + integral_0^t W(t, s) (sum_j rate_j V_j rho(s) V_j^H) W(t, s)^H ds,

    with the exponential W of the motion without jumps, ``W' = (-i H - sum_j rate_j V_j^H V_j / 2) W``. The integral is
    replaced by a quadrature with positive weights, and rho(s) at its nodes by the formula of the order below. The
    result is a sum ``sum A rho A^H``, a completely positive map of rho, with ``sum A^H A = S = 1 + O(h^(p+1))``. The
    step applies it to ``S^-1/2 rho S^-1/2``. So every step is completely positive and conserves the trace, whatever its
    size is. Trace and positivity hold to rounding, also for pure states. Other methods keep positivity to their order.

    H and the rates may depend on time. W has the order of the method by Magnus' expansion, and is exact if they do not.
    So a fast precession with slow jumps needs no short steps. A step costs 1 (order 2) or 5 (order 4) exponentials of
    an N x N matrix, and twice 2 or 9 sums over the jumps.

    Parameters
    ----------
    order : int
        2 or 4.

    Examples
    --------
    >>> lower = np.array([[0, 1], [0, 0]])
    >>> qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), lt.LindbladJumps([(lower, 0.2)]))
    >>> run = lt.integrate(
    ...     qubit, qubit.state([0.0, 1.0]), (0.0, 60.0), 6.0, lt.KrausMethod(4)
    ... )
    >>> bool(np.linalg.eigvalsh(qubit.density(run.x)).min() > -1e-15), run.audit().passed
    (True, True)
    """

    systems: ClassVar[str] = "quantum systems with Lindblad jumps"

    number: int = eqx.field(static=True)

    def __init__(self, order: int = 4):
        if type(order) is not int or order not in KRAUS_ORDERS:
            raise InputError(f"order must be 2 or 4, got {order!r}")
        self.number = order

    def __str__(self) -> str:
        return f"KrausMethod(order={self.number})"

    @property
    def order(self) -> int:
        return self.number

    stages = END_SLOPE_ROW + 1
    explicit = True
    preserves = frozenset({"positivity"})

    @property
    def evaluations_per_iteration(self) -> int:
        """Number of sums over the jumps, those for the completeness relation included."""
        return 4 if self.number == 2 else 18

    def preserves_function(self, system: System, name: str) -> bool:
        return name == "tr(rho)"

    def check(self, system: System) -> None:
        """Raise InputError unless the system is a QuantumSystem with LindbladJumps and no other dissipation."""
        terms = _undriven_quantum_system(system).total_dissipation.terms
        if not terms or not all(isinstance(term, LindbladJumps) for term in terms):
            raise InputError(
                "KrausMethod needs lt.LindbladJumps and no other dissipation. For lt.ThermalJumps use "
                "lt.MetriplecticGauss, which obeys the laws of the energy and the entropy"
            )

    def start(self, system: System, x) -> jax.Array:
        return jnp.zeros((self.stages, x.shape[0])).at[StepRow.MEAN_SLOPE].set(system.vector_field(x))

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        """Return the rows of :class:`.explicit.StepRow`, followed by the slopes at both ends."""
        x = x + compensation
        body, n, clock_time = _undriven_quantum_system(system), _undriven_quantum_system(system).body_dim, None
        if (clock := system.clock) is not None:
            clock_time = clock.time(x)
        channel = _StepChannel.build(system, body.structure, clock_time, h, self.number)
        middle, end = channel.middle_and_end_states(x[:n])
        d = end - x[:n]
        if clock is not None:
            d = jnp.concatenate([d, _clock_and_work_increments(system, clock.unit, x, h, middle, end)])
        field = jax.vmap(system.vector_field)(jnp.stack([x, x + d]))
        zero = jnp.zeros_like(x)
        return jnp.stack([d / h, zero, zero, k[StepRow.INITIAL_LEVELS], *field])

    def increment(self, h, k) -> jax.Array:
        return h * k[StepRow.MEAN_SLOPE]

    def weights(self, theta) -> np.ndarray:
        return hermite_cubic_weights(theta, self.stages)


class _StepChannel(NamedTuple):
    """The completely positive map of a step of Lindblad's equation.

    Attributes
    ----------
    structure : manifolds.DensityMatrices
    order : int
    h : array, shape ()
    operators : function from a fraction of the step to the jump operators, shape (jumps, N, N)
    rates : function from a fraction of the step to the rates, shape (jumps,)
    propagators : dict from (start, end), as fractions of the step, to arrays, shape (N, N)
        W between these times.
    """

    structure: mf.DensityMatrices
    order: int
    h: jax.Array
    operators: Callable
    rates: Callable
    propagators: dict

    @classmethod
    def build(cls, system: System, structure: mf.DensityMatrices, time, h, order: int) -> _StepChannel:
        """Return the channel of a step of size h from ``time``, which is None if the system does not depend on time."""
        body = _undriven_quantum_system(system)
        fractions = (0.0, 0.25, 0.5, 1.0)
        frozen = dict.fromkeys(fractions, body)
        if time is not None and system.clock is not None:
            span = system.clock.span
            frozen = {c: body.at_time(span.clip(time + c * h)) for c in fractions}
        terms = [term for term in body.total_dissipation.terms if isinstance(term, LindbladJumps)]

        def operators(fraction) -> np.ndarray | jax.Array:
            operator_arrays = [term.operators_at(frozen[fraction].time) for term in terms]
            has_constants = all(isinstance(part, np.ndarray) for part in operator_arrays)
            return np.concatenate(operator_arrays) if has_constants else jnp.concatenate(operator_arrays)

        def rates(fraction) -> jax.Array:
            return jnp.concatenate([term.rates_at(frozen[fraction].time) for term in terms])

        def decay_generator(fraction) -> jax.Array:
            H = structure.matrix(frozen[fraction].energy.gradient(jnp.zeros(body.dim))[: structure.dim])
            losses = adjoint(operators(fraction)) @ operators(fraction)
            return -1j * H - 0.5 * jnp.tensordot(rates(fraction), jnp.asarray(losses), 1)

        intervals = [(0.0, 1.0)] if order == 2 else [(0.0, 0.25), (0.25, 0.5), (0.0, 0.5), (0.5, 1.0), (0.0, 1.0)]
        if time is None:
            exponents = [(end - start) * h * decay_generator(0.0) for start, end in intervals]
        else:
            ends_and_middle = decay_generator(0.0), decay_generator(0.5), decay_generator(1.0)
            exponents = _magnus_exponents(*ends_and_middle, h, intervals)
        propagators = dict(zip(intervals, expm(jnp.stack(exponents)), strict=True))
        return cls(structure, order, h, operators, rates, propagators)

    def middle_and_end_states(self, x) -> tuple[jax.Array, jax.Array]:
        """Return the states, shape (N^2,) each, in the middle and at the end of the step that starts at x."""
        identity = self.structure.matrix(
            jax.grad(lambda y: jnp.trace(self._unnormalised_middle_and_end(self.structure.matrix(y))[1]).real)(
                jnp.zeros_like(x)
            )
        )
        root = mf.spectral(_inverse_square_root, identity)
        middle, end = self._unnormalised_middle_and_end(root @ self.structure.matrix(x) @ root)
        return self.structure.vector(middle), self.structure.vector(end)

    def _unnormalised_middle_and_end(self, rho) -> tuple[jax.Array, jax.Array]:
        """Return rho in the middle and at the end of a step, by quadrature, before the trace is normalised."""
        start_gain = self._jump_gain(0.0, rho)

        def state_of_order_2(fraction):  # the trapezoidal rule, with the state of order 1 at its end
            W, step = self.propagators[0.0, fraction], fraction * self.h
            without, gain = _conjugate(W, rho), _conjugate(W, start_gain)
            return without + 0.5 * step * (gain + self._jump_gain(fraction, without + step * gain))

        if self.order == 2:
            end = state_of_order_2(1.0)
            return 0.5 * (rho + end), end

        def state_by_simpson(fraction, middle_gain, end_gain):
            full_propagator, second_half_propagator = (
                self.propagators[0.0, fraction],
                self.propagators[0.5 * fraction, fraction],
            )
            gains = _conjugate(full_propagator, start_gain), _conjugate(second_half_propagator, middle_gain), end_gain
            return _conjugate(full_propagator, rho) + fraction * self.h * sum(
                weight * gain for weight, gain in zip(SIMPSON_WEIGHTS, gains, strict=True)
            )

        quarter, half, end = (state_of_order_2(c) for c in (0.25, 0.5, 1.0))
        half_gain = self._jump_gain(0.5, half)
        third_order_half = state_by_simpson(0.5, self._jump_gain(0.25, quarter), half_gain)
        third_order_end = state_by_simpson(1.0, half_gain, self._jump_gain(1.0, end))
        return third_order_half, state_by_simpson(
            1.0, self._jump_gain(0.5, third_order_half), self._jump_gain(1.0, third_order_end)
        )

    def _jump_gain(self, fraction: float, rho) -> jax.Array:
        """Return the gain of rho by jumps per unit of time, ``sum rate V rho V^H``, at a fraction of the step."""
        V = self.operators(fraction)
        return jnp.sum(self.rates(fraction)[:, None, None] * (V @ rho @ adjoint(V)), axis=0)


def _conjugate(W, rho) -> jax.Array:
    """Return ``W rho W^H``."""
    return W @ rho @ adjoint(W)


def _inverse_square_root(eigenvalues):
    return 1.0 / jnp.sqrt(eigenvalues)


def _magnus_exponents(J0, J, J1, h, intervals) -> list[jax.Array]:
    """Return the exponents of Magnus' expansion of order 4 on intervals of a step, shape (N, N) each.

    J0, J and J1 are the generator of the propagator, ``W' = J W``, at the start, the middle and the end of the step.
    Over a step the generator is replaced by a quadratic polynomial in time [Blanes et al. 2009].
    """
    slope, curvature = J1 - J0, 2.0 * (J0 - 2.0 * J + J1)
    commutator = slope @ J - J @ slope
    exponents = []
    for start, end in intervals:
        a, b, length = start - 0.5, end - 0.5, end - start
        integral = length * J + (b**2 - a**2) / 2.0 * slope + (b**3 - a**3) / 3.0 * curvature
        exponents.append(h * integral + h**2 * length**3 / 12.0 * commutator)
    return exponents


def _undriven_quantum_system(system: System) -> QuantumSystem:
    """Return the quantum system itself, or the one that a driven system wraps."""
    return require_kind(unwrap_user_system(system), QuantumSystem, "KrausMethod")


def _clock_and_work_increments(system: System, unit: float, x, h, middle, end) -> jax.Array:
    """Return the increments of the clock and of the work in a step, shape (2,); Simpson's rule integrates the power."""
    states = jnp.stack([x[:-2], middle, end])
    times = x[-2] + jnp.array([0.0, 0.5, 1.0]) * h * unit
    points = jnp.concatenate([states, times[:, None], jnp.zeros((3, 1))], axis=1)
    powers = jax.vmap(system.energy.gradient)(points)[:, -2]
    return jnp.stack([h * unit, h * unit**2 * jnp.dot(SIMPSON_WEIGHTS, powers)])


register(*map(KrausMethod, KRAUS_ORDERS))
