"""``HeatBaths``, which take the heat of a dissipation; their entropies are appended to the state of a body."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.structures.poisson import ProductPoisson

from ..errors import InputError
from ..functions.bath_energy import (
    BathEnergy,
    ReservoirEnergy,
    ReservoirEnergyFunction,
    TimedReservoirEnergy,
    make_bath_energy,
)
from ..functions.conditions import checked_numbers
from ..functions.each import Each
from ..functions.energy import Energy
from ..tracing.short_form import short_form


class HeatBaths(Module):
    """Baths, each with an energy that is a function of its own entropy y: by default ``U = C T (exp(y / C) - 1)``.

    This default has the constant heat capacity C, and the temperature T at y = 0. A system with baths has the state
    (x, y), the energy ``H(x) + U(y)``, and an entropy that includes ``sum y``. A dissipation that lowers the energy of
    its body heats the first bath, or the bath with the number ``bath``: see
    :class:`liethermo.dissipation.heating.Heating`.

    Parameters
    ----------
    capacity, temperature : float > 0, or array, shape (number,)
        C (energy / temperature) and T (temperature, at y = 0), in any consistent units. A bath of infinite capacity
        keeps its temperature, ``U = T y``. If all capacities are infinite, the temperature may be a function of the
        time t that returns one number, or an array, shape (number,). The ledger then contains the work ``dT/dt y`` of
        the agent that changes it; without an exchange of heat it is zero.
    number : int
        The number of baths.
    energy : function from y, a scalar, to a scalar, optional
        The energy of each bath as a function of its entropy y (energy / temperature), instead of the two numbers. It
        has to increase.

    Attributes
    ----------
    energy : Energy
        Total energy of the baths as a function of their entropies, shape (number,).

    Raises
    ------
    InputError

    Examples
    --------
    >>> body = lt.LiePoissonSystem(
    ...     mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), dissipation=lt.DoubleBracket(0.1), baths=lt.HeatBaths(2.0)
    ... )
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 50.0), 0.1)
    >>> bool(run.entropy[-1] > run.entropy[0]), run.audit().energy_drift < 1e-13
    (True, True)
    """

    energy: Energy
    number: int = eqx.field(static=True)

    __repr__ = short_form

    def __init__(self, capacity=1.0, temperature=1.0, number: int = 1, energy: Callable | None = None):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise InputError(f"the number of baths is a positive integer, not {number!r}")
        self.number = number
        if energy is None and callable(temperature):
            self.energy = _timed_reservoirs(capacity, temperature, number)
        elif energy is None:
            parameters = {"capacity": capacity, "temperature": temperature}
            self.energy = make_bath_energy(
                *(_check_positive(value, what, number, what == "capacity") for what, value in parameters.items())
            )
        else:
            self.energy = Each(_BathEnergyFunction(energy), np.arange(number)[:, None])

    @property
    def has_positive_temperatures(self) -> bool:
        """True if the temperatures are positive in every state by construction."""
        return isinstance(self.energy, BathEnergy | ReservoirEnergy | TimedReservoirEnergy)

    @property
    def scale(self) -> np.ndarray | float:
        """Entropies over which the temperatures change, shape (number,): the capacities if they are constant."""
        return 1.0 if is_traced(self.energy) else np.asarray(self.entropy_scales())

    def entropy_scales(self) -> jax.Array:
        """Return :attr:`scale` as an array that JAX can trace, shape (number,)."""
        if not isinstance(self.energy, BathEnergy):  # any scale suits a bath of constant temperature
            return jnp.ones(self.number)
        return jnp.where(jnp.isfinite(self.energy.capacity), self.energy.capacity, 1.0)


def _timed_reservoirs(capacity, temperature: Callable, number: int) -> TimedReservoirEnergy:
    """Return the energy of baths whose temperature is a function of time, after a test of the function at t = 0."""
    if not np.isinf(np.asarray(capacity)).all():
        raise InputError(
            f"a temperature that is a function of time belongs to baths of infinite capacity, got {capacity!r}: the "
            "temperature of a finite bath follows from the heat that it receives. Give capacity=np.inf"
        )
    function = ReservoirEnergyFunction(temperature, number)
    try:
        with jax.ensure_compile_time_eval():
            values = np.asarray(function.temperatures(jnp.zeros(())))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the temperature of {number} baths must be a function of the time t to one number, or to an array of "
            f"shape ({number},): {error}"
        ) from None
    if not (np.isfinite(values).all() and (values > 0.0).all()):
        raise InputError(f"the temperature of a bath must be positive and finite, got {values.tolist()} at t = 0")
    return TimedReservoirEnergy(function)


def _check_positive(value, what: str, number: int, infinite: bool) -> jax.Array:
    # numbers stay numbers while JAX traces a family of systems
    evaluation = contextlib.nullcontext() if is_traced(value) else jax.ensure_compile_time_eval()
    with evaluation:
        array = checked_numbers(value, f"the {what} of baths")
        array = jnp.broadcast_to(array, (number,)) if array.ndim == 0 else array
    if array.shape != (number,):
        raise InputError(f"the {what} of {number} baths is one number, or has shape ({number},), not {array.shape}")
    if not is_traced(array) and not all(a > 0.0 and (infinite or np.isfinite(a)) for a in array.tolist()):
        allowed = "positive" if infinite else "positive and finite"
        raise InputError(f"the {what} of a bath must be {allowed}, not {array.tolist()}")
    return array


class _BathEnergyFunction(Module):
    energy: Callable

    def __call__(self, y):
        return self.energy(y[0])


def poisson_with_baths(body: mf.PoissonStructure, number: int) -> ProductPoisson:
    """Return the Poisson structure of a body with baths, whose entropies have no conjugate variables."""
    return ProductPoisson(body, mf.NoPoisson(number))


class BathEntropy(Energy):
    """The entropy of baths: the sum of the last components of a state."""

    number: int = eqx.field(static=True)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return jnp.sum(x[-self.number :])

    def gradient(self, x) -> jax.Array:
        return jnp.where(jnp.arange(x.size) < x.size - self.number, 0.0, 1.0)
