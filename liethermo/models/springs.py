"""The damped oscillator [SML Examples 1, 5, 7], and chains of bodies on springs that heat and cool as they stretch."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import checked_numbers, positive_condition
from ..functions.energy import Energy, Function, Quadratic
from ..functions.mechanics import Each, Kinetic
from ..systems import ComposedSystem, Copies, EvolutionSystem
from .parameters import checked_integer, checked_positive


def damped_oscillator(mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.1) -> EvolutionSystem:
    """An oscillator whose friction heats a bath: ``H = p^2 / (2 m) + k q^2 / 2 + gamma S`` in the state (q, p, S).

    ``q' = p / m``, ``p' = -k q - gamma p``, ``S' = p^2 / m``; the bath has the temperature gamma. All energy becomes
    heat: S grows to ``H / gamma``. The midpoint scheme is SML (39). Figs. 1 and 2 start at (0, 10, 0), with h = 0.1 and
    gamma = 0.1; one step leads to (0.99255583, 9.85111663, 9.85167078).

    Parameters
    ----------
    mass, stiffness : float, > 0
        m and k (mass; mass / time**2).
    friction : float, > 0
        gamma (1 / time).

    Examples
    --------
    >>> oscillator = lt.models.damped_oscillator()
    >>> oscillator.dim
    3
    """
    m, k, gamma = (
        checked_positive(mass, "mass"),
        checked_positive(stiffness, "stiffness"),
        checked_positive(friction, "friction"),
    )
    return EvolutionSystem(Quadratic([k, 1.0 / m, 0.0], [0.0, 0.0, gamma]), 3)


def damped_oscillator_solution(t, x0, mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.1) -> np.ndarray:
    """Return the exact states at times t after x0 = (q, p, S), shape (..., 3), for any damping."""
    times, (q, p, S) = np.asarray(t, dtype=float), np.asarray(x0, dtype=float)
    rates = np.array([[0.0, 1.0 / mass], [-stiffness, -friction]])
    oscillation = scipy.linalg.expm(times[..., None, None] * rates) @ np.array([q, p])

    def mechanical_energy(q, p):
        return p**2 / (2 * mass) + stiffness * q**2 / 2

    heat = (mechanical_energy(q, p) - mechanical_energy(oscillation[..., 0], oscillation[..., 1])) / friction
    return np.concatenate([oscillation, (S + heat)[..., None]], axis=-1)


class Thermospring(Module):
    """The energy ``e(r^2, S)`` of a spring of length r and entropy S [Romero 2009, §4].

    ``e = C u^2 / 2 + b T_0 u + c (T - T_0)`` with ``u = log(r / r_0)`` and ``T = T_0 exp((S - b u) / c)``: stretching
    cools a spring with b > 0, and heat makes it longer. The tension is ``(C u - b (T - T_0)) / r``.

    Attributes
    ----------
    stiffness : C (energy)
    expansion : b (energy / temperature)
    capacity : c, at constant length (energy / temperature)
    length, temperature : r_0 and T_0, at which it is slack and S = 0
    """

    stiffness: jax.Array = eqx.field(metadata=positive_condition("stiffness").metadata)
    expansion: jax.Array
    capacity: jax.Array = eqx.field(metadata=positive_condition("capacity").metadata)
    length: jax.Array = eqx.field(metadata=positive_condition("length").metadata)
    temperature: jax.Array = eqx.field(metadata=positive_condition("temperature").metadata)

    def __call__(self, y):
        u = 0.5 * jnp.log(y[0] / self.length**2)
        T = self.temperature * jnp.exp((y[1] - self.expansion * u) / self.capacity)
        elastic = 0.5 * self.stiffness * u**2 + self.expansion * self.temperature * u
        return elastic + self.capacity * (T - self.temperature)


def _first_spring_variables(y):
    """Return the squared length of the first spring and its entropy, shape (2,), from (q_1, S_1)."""
    return jnp.stack([jnp.sum(y[:-1] ** 2), y[-1]])


def _spring_variables(y):
    """Return the squared length and the entropy of a spring between two bodies, shape (2,), from (q, q', S')."""
    n = len(y) // 2
    return jnp.stack([jnp.sum((y[n : 2 * n] - y[:n]) ** 2), y[-1]])


def thermoelastic_chain(
    bodies: int = 2,
    dimension: int = 2,
    mass: float = 1.0,
    stiffness: float = 100.0,
    expansion: float = 0.2,
    capacity: float = 1.0,
    length: float = 1.0,
    temperature: float = 10.0,
    conductance: float = 0.5,
    gravity: float = 0.0,
) -> ComposedSystem:
    """N bodies on N springs in a row, the first hung at the origin; neighbouring springs exchange heat.

    The a-th state is (q_a, p_a, S_a) with S_a the entropy of the spring that body a hangs on. With two bodies it is the
    double thermoelastic pendulum of Romero (2009) and of García Orden & Romero (2012). Stretching, temperature and the
    flow of heat act on each other, and the oscillation of the springs dies out. The springs enter by their squared
    lengths, so that the angular momentum about the origin is conserved exactly.

    Parameters
    ----------
    bodies, dimension : int
        N, and the dimension of the space, 1 to 3.
    mass, capacity, length, temperature : float, > 0
        Mass of each body; capacity, length and temperature of each spring: see :class:`Thermospring`.
    stiffness : float, > 0
        Stiffness of the springs (force / length).
    expansion : float
        Coupling of length and temperature: see :class:`Thermospring`.
    conductance : float, >= 0
        Heat conductance between neighbouring springs (power / temperature).
    gravity : float
        Acceleration against the last axis; without it the angular momentum is constant, and audited.
    """
    N, n = checked_integer(bodies, "bodies"), checked_integer(dimension, "dimension")
    if n > 3:
        raise InputError(f"dimension must be 1, 2 or 3, got {n}")
    spring = Thermospring(
        checked_positive(stiffness, "stiffness"),
        checked_numbers(expansion, "expansion", ()),
        checked_positive(capacity, "capacity"),
        checked_positive(length, "length"),
        checked_positive(temperature, "temperature"),
    )
    m = checked_positive(mass, "mass")
    body: Energy = Kinetic(jnp.full(n, 1.0 / m))
    g, has_gravity = checked_numbers(gravity, "gravity", ()), not (isinstance(gravity, float | int) and gravity == 0.0)
    if has_gravity:
        body = body + Quadratic(jnp.zeros(2 * n + 1), jnp.zeros(2 * n + 1).at[n - 1].set(m * g))
    state_size = 2 * n + 1
    q = state_size * np.arange(N)[:, None] + np.arange(n)
    S = state_size * np.arange(1, N + 1)[:, None] - 1
    springs: list[Energy] = [Function(spring).on(_first_spring_variables).on([*q[0], *S[0]])]
    if N > 1:
        springs.append(Each(Function(spring).on(_spring_variables), np.hstack([q[:-1], q[1:], S[1:]])))
    return ComposedSystem(
        Copies(N, body, state_size, name="spring"),
        coupling=springs,
        conductance=[(a, a + 1, conductance) for a in range(N - 1)],
        connected=False,  # allow a conductance of zero
        momentum_maps={} if has_gravity else _angular_momenta_by_name(N, n),
    )


def _angular_momenta_by_name(N: int, n: int) -> dict[str, Energy]:
    """Return the components of ``sum q x p`` by name, one for each pair of axes."""
    state_size = 2 * n + 1
    maps: dict[str, Energy] = {}
    for i, j in zip(*np.triu_indices(n, 1), strict=True):
        A = np.zeros((4, 4))
        for a, b, sign in (0, 3, 1.0), (1, 2, -1.0):  # in the variables (q_i, q_j, p_i, p_j)
            A[a, b] = A[b, a] = sign
        indices = state_size * np.arange(N)[:, None] + np.array([i, j, n + i, n + j])
        maps[f"angular momentum {'xyz'[i]}{'xyz'[j]}"] = Each(Quadratic(A), indices)
    return maps
