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
    BATH_CAPACITY_CONDITION,
    BATH_TEMPERATURE_CONDITION,
    BathEnergy,
    DrivenReservoirEnergy,
    ReservoirEnergy,
    ZeroEnergy,
    bath_energy_terms,
    make_bath_energy,
)
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import ParameterCondition, checked_numbers
from ..functions.energy import Energy, Sum
from ..functions.mechanics import Each
from ..tracing.short_form import format_arguments


class HeatBaths(Module):
    """Heat baths, each with an energy that is a function of its own entropy y: by default ``U = C T (exp(y / C) - 1)``.

    This default has the constant heat capacity C, and the temperature T at y = 0. A system with baths has the state
    (x, y), the energy ``H(x) + U(y)``, and an entropy that includes ``sum y``. A dissipation that lowers the energy of
    its body heats the first bath, or the bath with the number ``bath``: see
    :class:`liethermo.dissipation.heating.Heating`.

    Parameters
    ----------
    capacity : float > 0, or array, shape (number,)
        C (energy / temperature), in any consistent units. A bath of infinite capacity keeps its temperature, ``U = T
        y``.
    temperature : float > 0, or array, shape (number,); or function of the time; or a sequence with an entry per bath
        T (temperature, at y = 0). Baths of infinite capacity may have temperatures that are functions of the time t:
        one function to a number > 0 or to an array, shape (number,), or a function for some of the baths, ``U = T(t)
        y``. A device that changes the temperature does the work ``y T'(t)``, which the ledger of a run has; the heat
        that the bath receives is ``T(t) y`` less this work.
    number : int, optional
        The number of baths. By default there is one for each entry of the other arguments, or one.
    energy : function from y, a scalar, to a scalar; or a sequence with a function or None per bath; optional
        The energy of each bath as a function of its entropy y (energy / temperature), instead of the two numbers. It
        has to increase. Electrons with the capacity ``c T``, for example, have ``U = T y + y^2 / (2 c)``.

    Attributes
    ----------
    energy : Energy
        Total energy of the baths as a function of their entropies, shape (number,).
    number : int
        The number of baths. ``system.baths.number`` is 0 for a system without baths.

    Raises
    ------
    InputError

    Examples
    --------
    >>> body = lt.LiePoissonSystem(
    ...     mf.so(3),
    ...     lt.Quadratic([1 / 3, 1 / 2, 1.0]),
    ...     dissipation=lt.DoubleBracket(0.1),
    ...     baths=lt.HeatBaths(2.0),
    ... )
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 50.0), 0.1)
    >>> bool(run.entropy[-1] > run.entropy[0]), run.audit().energy_drift < 1e-13
    (True, True)
    """

    energy: Energy
    number: int = eqx.field(static=True)

    def __repr__(self) -> str:
        if isinstance(self.energy, BathEnergy):
            return f"HeatBaths({format_arguments(vars(self.energy))})"
        return f"HeatBaths({format_arguments(vars(self))})"

    def __init__(self, capacity=1.0, temperature=1.0, number: int | None = None, energy=None):
        if number is None:
            sequences = [v for v in (capacity, temperature, energy) if isinstance(v, list | tuple) or np.ndim(v) == 1]
            number = max(map(len, sequences), default=1)
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise InputError(f"the number of baths must be a positive integer, got {number!r}")
        self.number = number
        if callable(energy):
            self.energy = Each(_BathEnergyFunction(energy), np.arange(number)[:, None])
            return
        functions = _entry_per_bath(energy, "energy", number) if energy is not None else [None] * number
        temperatures = _entry_per_bath(temperature, "temperature", number)
        driven = [i for i, T in enumerate(temperatures) if callable(T) and functions[i] is None]
        if not driven and all(function is None for function in functions):
            self.energy = make_bath_energy(
                _checked_positive_array(capacity, "capacity", number, BATH_CAPACITY_CONDITION),
                _checked_positive_array(temperature, "temperature", number, BATH_TEMPERATURE_CONDITION),
            )
            return
        numbers = [1.0 if callable(T) else T for T in temperatures]
        C, T = (
            _checked_positive_array(capacity, "capacity", number, BATH_CAPACITY_CONDITION),
            _checked_positive_array(numbers, "temperature", number, BATH_TEMPERATURE_CONDITION),
        )
        for i in driven:
            if not is_traced(C) and np.isfinite(C[i]):
                raise InputError(
                    f"the temperature of bath {i} is a function of the time, so its capacity must be infinite, got "
                    f"{float(C[i]):g}. Set capacity=np.inf"
                )
        terms: list[Energy] = [
            DrivenReservoirEnergy(_checked_temperature_function(temperatures[i], i)).on([i]) for i in driven
        ]
        terms += [Each(_BathEnergyFunction(f), np.array([[i]])) for i, f in enumerate(functions) if f is not None]
        constant = np.array([i for i, f in enumerate(functions) if f is None and i not in driven], dtype=int)
        if constant.size:
            terms.append(make_bath_energy(C[constant], T[constant]).on(constant))
        self.energy = Sum.from_terms(terms)

    @property
    def has_positive_temperatures(self) -> bool:
        """True if the temperatures are positive in every state by construction."""
        return all(
            isinstance(term, BathEnergy | ReservoirEnergy | DrivenReservoirEnergy)
            for term in bath_energy_terms(self.energy)
        )

    @property
    def constant_entropy_scales(self) -> np.ndarray | float:
        """Scale of the entropy of each bath as a NumPy array, shape (number,); the number 1 if the energy is traced.

        It is :meth:`entropy_scales`, for code outside of JAX; all are 1 if a temperature or an energy is a function.
        """
        return 1.0 if is_traced(self.energy) else np.asarray(self.entropy_scales())

    def entropy_scales(self) -> jax.Array:
        """Return the scale of the entropy of each bath, shape (number,): its capacity, or 1 if that is infinite."""
        if not isinstance(self.energy, BathEnergy):  # none has a capacity, or one is given by a function
            return jnp.ones(self.number)
        return jnp.where(jnp.isfinite(self.energy.capacity), self.energy.capacity, 1.0)


class _AbsentBaths(HeatBaths):
    """The baths of a system without baths: none."""

    def __init__(self):
        self.energy, self.number = ZeroEnergy(), 0


ABSENT_BATHS = _AbsentBaths()
"""The baths of a system that has none."""


def checked_baths(baths: HeatBaths | None) -> HeatBaths:
    """Return the baths that a user gave, after a check of their type; :data:`ABSENT_BATHS` for None.

    Raises
    ------
    InputError
    """
    if not isinstance(baths, HeatBaths | None):
        raise InputError(f"baths must be lt.HeatBaths(...), got {type(baths).__name__}")
    return ABSENT_BATHS if baths is None else baths


def _entry_per_bath(value, what: str, n_baths: int) -> list:
    """Return a list with one entry per bath, from one value or function for all baths, or from a sequence."""
    if callable(value):
        shape = np.shape(value(0.0)) if n_baths > 1 else ()
        return [value] * n_baths if shape != (n_baths,) else [_EntryOfFunction(value, i) for i in range(n_baths)]
    if not isinstance(value, list | tuple):
        return [value] * n_baths if np.ndim(value) == 0 else list(value)
    if len(value) != n_baths:
        raise InputError(f"the {what} of {n_baths} baths must have one entry per bath, got {len(value)}")
    return list(value)


class _EntryOfFunction(Module):
    """One entry of an array-valued function of time, as a function of time."""

    function: Callable
    index: int = eqx.field(static=True)

    def __call__(self, t):
        return self.function(t)[self.index]


def _checked_temperature_function(function: Callable, index: int) -> Callable:
    """Return a checked function of time whose value is the temperature of a bath; NaN where it is not positive."""
    what = f"the temperature of bath {index}"
    traced_function, _ = traced_function_and_shape(function, ((),), [()], what, "a time")
    return _PositiveTemperature(traced_function)


class _PositiveTemperature(Module):
    """A temperature as a function of time, NaN where it is not positive, so that a step is rejected."""

    function: Callable

    def __call__(self, t):
        T = jnp.asarray(self.function(t), dtype=jnp.float64)
        return jnp.where(T > 0.0, T, jnp.nan)


def _checked_positive_array(value, what: str, n_baths: int, condition: ParameterCondition) -> jax.Array:
    # numbers stay numbers while JAX traces a family of systems
    """Return one positive number per bath as an array, shape (n_baths,); InputError for other values."""
    evaluation = contextlib.nullcontext() if is_traced(value) else jax.ensure_compile_time_eval()
    with evaluation:
        array = checked_numbers(value, f"the {what} of baths")
        array = jnp.broadcast_to(array, (n_baths,)) if array.ndim == 0 else array
    if array.shape != (n_baths,):
        raise InputError(
            f"the {what} of {n_baths} baths must be a number or have shape ({n_baths},), got {array.shape}"
        )
    condition.require(array)
    return array


class _BathEnergyFunction(Module):
    """The energy of one bath as a function of its entropy in an array, shape (1,)."""

    energy: Callable

    def __call__(self, y):
        return self.energy(y[0])


def poisson_with_baths(body_poisson: mf.PoissonStructure, n_baths: int) -> mf.PoissonStructure:
    """Return the Poisson structure of a body with baths, whose entropies have no conjugate variables."""
    return ProductPoisson(body_poisson, mf.NoPoisson(n_baths)) if n_baths else body_poisson


class BathEntropy(Energy):
    """The total entropy of the baths: the sum of the last components of a state."""

    number: int = eqx.field(static=True)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return jnp.sum(x[-self.number :])

    def gradient(self, x) -> jax.Array:
        return jnp.where(jnp.arange(x.size) < x.size - self.number, 0.0, 1.0)
