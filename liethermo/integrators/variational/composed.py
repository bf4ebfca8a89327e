"""Variational integrators of several entropies: on the states (q, p, S) of composed systems [GBY §1]."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import inverse

from ...systems import ComposedSystem, System
from ..base import MethodWrapper
from .discrete import FiniteDifference


class ComposedVariational(MethodWrapper):
    """A variational integrator as it runs on a composed system; see there for its equations.

    With one map the slopes are the field at the point where the map looks. With several, a row for each follows, with
    its momentum: ``(P_i - p_k) / h``. One iteration takes Newton's step for ``H_p(q_i, P_i, S_i) = V``.

    Attributes
    ----------
    maps : tuple of FiniteDifference
    """

    maps: tuple[FiniteDifference, ...]

    @property
    def stages(self) -> int:
        number = len(self.maps)
        return 1 if number == 1 else 1 + number

    @property
    def evaluations_per_iteration(self) -> int:
        return len(self.maps)

    def __str__(self) -> str:
        return str(self.method)

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        assert isinstance(system, ComposedSystem)
        maps = self.maps
        if len(maps) == 1:
            return system.vector_field(x + (compensation + h * map_fractions(system, maps[0]) * k[0]))[None]
        (q, p, S, _), total = system.poisson.state_indices, sum(map.weight for map in maps)
        parts, far = [map.weight / total for map in maps], [1.0 - map.alpha for map in maps]

        def mean(values) -> jax.Array:
            return sum(part * value for part, value in zip(parts[1:], values[1:], strict=True)) + parts[0] * values[0]

        # the points of the maps, with a momentum of its own each
        moved = [
            (h * map_fractions(system, map) * k[0]).at[p].set(h * row[p]) for map, row in zip(maps, k[1:], strict=True)
        ]
        points = [x + (compensation + d) for d in moved]
        gradients = [system.energy.gradient(point) for point in points]
        warm = mean([dH[S] for dH in gradients])
        dS = jnp.zeros_like(x).at[S].set(1.0)
        rates = []
        for point, dH in zip(points, gradients, strict=True):
            rate = jnp.zeros_like(x).at[p].set(-dH[q])
            if system.dissipation is not None:  # with temperatures that are the same at all points
                rate = rate + system.dissipation.force(system, point, dH.at[S].set(warm), dS, ())
            rates.append(rate)
        step = mean(rates)
        if not len(p):
            return jnp.concatenate([step[None], jnp.zeros_like(k[1:])])
        masses = [inverse(_momentum_hessian(system, point, p)) for point in points]
        needed = mean([share * rate[p] - row[p] for share, rate, row in zip(far, rates, k[1:], strict=True)])
        carried = mean([M @ dH[p] for M, dH in zip(masses, gradients, strict=True)])
        V = inverse(mean(masses)) @ (h * needed + carried)
        rows = [
            jnp.zeros_like(x).at[p].set(row[p] + M @ (V - dH[p]) / h)
            for row, M, dH in zip(k[1:], masses, gradients, strict=True)
        ]
        return jnp.stack([step.at[q].set(V), *rows])

    def start(self, system: System, x) -> jax.Array:
        rate = system.vector_field(x)
        return jnp.concatenate([rate[None], jnp.zeros((self.stages - 1, len(x)))])

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    def weights(self, theta) -> np.ndarray:
        return np.multiply.outer(np.asarray(theta, dtype=float), np.eye(self.stages)[0])


def map_fractions(system: ComposedSystem, map: FiniteDifference) -> np.ndarray:
    """How far on its way each component of a composed system is looked at."""
    q, p, _, _ = system.poisson.state_indices
    found = np.full(system.dim, map.beta)
    found[q], found[p] = map.alpha, 1.0 - map.alpha
    return found


def _momentum_hessian(system: ComposedSystem, x, p) -> jax.Array:
    """``H_pp``, the inverse of the mass matrix of all bodies."""
    return jax.jacfwd(lambda y: system.energy.gradient(x.at[p].set(y))[p])(x[p])
