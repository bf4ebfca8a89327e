"""Lindblad's equation with any jump operators, without a promise about energy and entropy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module
from manifolds.matrices.linear import adjoint

from ..errors import InputError
from .base import Dissipation
from .checks import RATE_CONDITION, checked_rate
from .operators import HasMatrix, Operator, checked_hermitian, checked_square_matrix, get_density_structure


class LindbladJumps(Dissipation):
    """Lindblad's equation with any jump operators: ``sum rate (V rho V^H - {V^H V, rho} / 2)`` [Lindblad 1976].

    The operators need not belong to a bath: measurement, pumping, and the local dissipation of a part of a coupled
    system have this form. No law of the energy or the entropy is promised, and an audit says so. The trace is exact.
    The equation keeps the density matrix positive. A run keeps it positive up to the error of its steps, and ends where
    an eigenvalue is below -1e-6. For a bath with a temperature use :class:`ThermalJumps`, which obeys both laws.

    A collapse operator of QuTiP is ``sqrt(rate) * V``: see :meth:`from_collapse_operators`. The adjoint of V is a jump
    of its own, with its own rate. :class:`KrausMethod` keeps the density matrix positive to rounding.

    Parameters
    ----------
    couplings : list of (V, rate)
        V is a dimensionless matrix, shape (N, N), or a ``Qobj``; or a function of the time t to an array, written with
        jax.numpy, such as ``lambda t: V0 + jnp.exp(1j * w * t) * V1``. The rate is a number >= 0 (1 / time), or a
        function of the time t to one. A rate that becomes negative is not refused, but the motion may then leave the
        density matrices.

    Raises
    ------
    InputError
        If a matrix or a rate cannot be used.

    Examples
    --------
    >>> lower = np.array([[0, 1], [0, 0]])
    >>> qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), lt.LindbladJumps([(lower, 0.2)]))
    >>> run = lt.integrate(
    ...     qubit, qubit.state([0.0, 1.0]), (0.0, 5.0), 0.1, lt.MetriplecticGauss(3)
    ... )
    >>> excited = qubit.density(run.x[-1])[1, 1].real
    >>> bool(abs(excited - np.exp(-0.2 * 5.0)) < 1e-10)
    True
    """

    operators: tuple[Operator | OperatorFunction, ...]
    rates: tuple[Any, ...] = eqx.field(metadata=RATE_CONDITION.metadata)

    energy_law = None
    entropy_law = None
    is_symmetric = False
    is_noiseless = True
    needs_entropy = False
    has_generator = True

    def __init__(self, couplings: Sequence[tuple[Any, Any]]):
        pairs = list(couplings)
        if not pairs or not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in pairs):
            raise InputError("couplings must be a list of pairs (V, rate), such as [(V, 0.1)]")
        self.operators = tuple(_checked_jump_operator(V, f"the jump operator V[{i}]") for i, (V, _) in enumerate(pairs))
        self.rates = tuple(
            _rate_checked_at_start(rate, i) if callable(rate) else checked_rate(rate)
            for i, (_, rate) in enumerate(pairs)
        )

    @classmethod
    def from_collapse_operators(cls, operators: Sequence[Any]) -> LindbladJumps:
        """Return the jumps of a list of collapse operators, ``c_ops`` of QuTiP.

        Parameters
        ----------
        operators : list of C, or of [C, f]
            C is a matrix, shape (N, N), or a ``Qobj``, of the unit ``1 / sqrt(time)``: the rate is part of it. With a
            real function f of the time t the operator is ``f(t) C``. A string is not evaluated.

        Examples
        --------
        >>> lower = np.array([[0, 1], [0, 0]])
        >>> jumps = lt.LindbladJumps.from_collapse_operators([np.sqrt(0.2) * lower])
        >>> qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), jumps)
        """
        if isinstance(operators, np.ndarray) and operators.ndim == 2:
            raise InputError(
                f"collapse operators must be a list, such as [V], got one array of shape {operators.shape}"
            )
        couplings = []
        for i, operator in enumerate(operators):
            is_pair = isinstance(operator, list | tuple) and len(operator) == 2 and np.ndim(operator[0]) != 1
            matrix, factor = operator if is_pair else (operator, None)
            if factor is not None and not callable(factor):
                kind = f"the string {factor!r}, which is not evaluated" if isinstance(factor, str) else repr(factor)
                raise InputError(
                    f"the factor of collapse operator {i} must be a function of t, such as lambda t: jnp.sqrt(1 + t), "
                    f"got {kind}"
                )
            couplings.append((matrix, 1.0 if factor is None else _SquaredTimeFactor(factor)))
        return cls(couplings)

    @property
    def depends_on_time(self) -> bool:
        """True if a rate or an operator is a function of time."""
        return any(callable(value) for value in (*self.rates, *self.operators))

    def bind_to(self, system):
        size = get_density_structure(system, "LindbladJumps").size
        for i, V in enumerate(self.operators):
            shape = V.shape if isinstance(V, OperatorFunction) else np.shape(V)
            if shape != (size, size):
                raise InputError(
                    f"the jump operator V[{i}] has shape {shape}, but the Hamiltonian has shape ({size}, {size})"
                )
        return self

    def force(self, system, x, dH, dS, dL):
        return self.generator_field(system, x, dH)

    def generator_field(self, system, x, dH):
        structure, n = system.structure, system.body_dim
        rates, rho, V = self.rates_at(system.time), structure.matrix(x[:n]), self.operators_at(system.time)
        gain = jnp.sum(rates[:, None, None] * (V @ rho @ adjoint(V)), axis=0)
        loss = jnp.tensordot(rates, jnp.asarray(adjoint(V) @ V), 1) @ rho  # its Hermitian part is the anticommutator
        return jnp.pad(structure.vector(gain - loss), (0, system.dim - n))

    def current(self, rho, observable, t: float = 0.0) -> jax.Array:
        """Return ``tr(A D(rho))``, shape (...): the rate at which these jumps change the mean of an observable A.

        With A = H it is the energy that flows in through the jumps of one bath, as the local approach defines heat.

        Parameters
        ----------
        rho : array, shape (..., N, N)
            Density matrices.
        observable : array, shape (N, N)
            A, Hermitian.
        t : float
            The time, if a rate or an operator depends on it.
        """
        time = jnp.asarray(t, dtype=jnp.float64)
        A, V = checked_hermitian(observable, "the observable"), self.operators_at(time)
        if A.shape != V.shape[1:]:
            raise InputError(f"the observable has shape {A.shape}, and the jump operators {V.shape[1:]}")
        squares = adjoint(V) @ V
        dual = adjoint(V) @ A @ V - 0.5 * (squares @ A + A @ squares)  # the adjoint map of each jump
        total = jnp.tensordot(self.rates_at(time), jnp.asarray(dual), 1)
        return jnp.einsum("ij,...ji->...", total, jnp.asarray(rho)).real

    def rates_at(self, time) -> jax.Array:
        """Return the rates at a time, shape (jumps,); the time may be None if they do not depend on it."""
        self._require_time(time)
        return jnp.stack([jnp.asarray(rate(time)) if callable(rate) else rate for rate in self.rates])

    def operators_at(self, time) -> np.ndarray | jax.Array:
        """Return the jump operators at a time, shape (jumps, N, N); the time may be None if nothing depends on it."""
        self._require_time(time)
        if not any(isinstance(V, OperatorFunction) for V in self.operators):
            return np.stack([np.asarray(V) for V in self.operators])  # constants of a program
        return jnp.stack(
            [V(time) if isinstance(V, OperatorFunction) else jnp.asarray(np.asarray(V)) for V in self.operators]
        )

    def _require_time(self, time) -> None:
        """Raise InputError if a rate or an operator depends on time, and ``time`` is None."""
        if self.depends_on_time and time is None:
            raise InputError("a rate or an operator of LindbladJumps depends on time. Use system.at_time(t)")


class OperatorFunction(Module):
    """A jump operator that depends on time.

    Attributes
    ----------
    function : function from t, shape (), to an array, shape (N, N)
    shape : tuple of int
        Shape of its values.
    """

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t) -> jax.Array:
        return jnp.asarray(self.function(t), dtype=jnp.complex128)


def _checked_jump_operator(V: Any, label: str) -> Operator | OperatorFunction:
    """Return a jump operator as a matrix, or as a function of time, tested at t = 0."""
    if not callable(V) or isinstance(V, HasMatrix):
        return Operator(checked_square_matrix(V, label))
    try:
        value = V(0.0)
    except TypeError as error:
        raise InputError(f"{label} must be a matrix, or a function of the time t: {error}") from None
    if isinstance(value, HasMatrix):
        raise InputError(
            f"{label} is a function that returns a Qobj, which JAX cannot trace. Return an array of jax.numpy, such as "
            "jnp.cos(t) * V.full()"
        )
    return OperatorFunction(V, checked_square_matrix(value, label).shape)


class _SquaredTimeFactor(Module):
    """The rate ``f(t)^2`` of a collapse operator with a factor f that depends on time."""

    factor: Callable

    def __call__(self, t):
        return jnp.asarray(self.factor(t)) ** 2


def _rate_checked_at_start(rate: Callable, i: int) -> Callable:
    """Return the rate of the jump operator V[i], a function of time, after a test at t = 0."""
    try:
        value = rate(0.0)
    except TypeError as error:
        raise InputError(f"the rate of V[{i}] must be a number, or a function of the time t: {error}") from None
    checked_rate(value)
    return rate
