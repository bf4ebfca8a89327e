"""Variational integrators of several entropies: on the states (q, p, S) of composed systems [GBY §1]."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import inverse

from ...systems import ComposedSystem, System
from ...systems.kind_checks import require_kind
from ..base import MethodWrapper
from .discrete import FiniteDifference


class ComposedVariational(MethodWrapper):
    """A variational integrator as it runs on a composed system; :class:`.VariationalIntegrator` has the equations.

    With one map the slopes are the field at the point of the map. With several maps, a row for each follows with its
    momentum: ``(P_i - p_k) / h``. One iteration takes a Newton step for ``H_p(q_i, P_i, S_i) = V``.

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
        system = require_kind(system, ComposedSystem, str(self))
        maps = self.maps
        if len(maps) == 1:
            return system.vector_field(x + (compensation + h * component_evaluation_fractions(system, maps[0]) * k[0]))[
                None
            ]
        (q, p, S, _), total = system.poisson.state_indices, sum(map.weight for map in maps)
        map_weights, end_fractions = [map.weight / total for map in maps], [1.0 - map.alpha for map in maps]

        def weighted_mean(values) -> jax.Array:
            return (
                sum(weight * value for weight, value in zip(map_weights[1:], values[1:], strict=True))
                + map_weights[0] * values[0]
            )

        # the points of the maps, each with its own momentum
        displacements = [
            (h * component_evaluation_fractions(system, map) * k[0]).at[p].set(h * row[p])
            for map, row in zip(maps, k[1:], strict=True)
        ]
        points = [x + (compensation + d) for d in displacements]
        gradients = [system.energy.gradient(point) for point in points]
        temperatures = weighted_mean([dH[S] for dH in gradients])
        dS = jnp.zeros_like(x).at[S].set(1.0)
        rates = []
        for point, dH in zip(points, gradients, strict=True):
            rate = jnp.zeros_like(x).at[p].set(-dH[q])
            if system.dissipation is not None:  # with the mean temperatures at all points
                rate = rate + system.dissipation.force(system, point, dH.at[S].set(temperatures), dS, ())
            rates.append(rate)
        step = weighted_mean(rates)
        if not len(p):
            return jnp.concatenate([step[None], jnp.zeros_like(k[1:])])
        mass_matrices = [inverse(_momentum_hessian(system, point, p)) for point in points]
        momentum_gap = weighted_mean(
            [fraction * rate[p] - row[p] for fraction, rate, row in zip(end_fractions, rates, k[1:], strict=True)]
        )
        momentum_velocity = weighted_mean([M @ dH[p] for M, dH in zip(mass_matrices, gradients, strict=True)])
        V = inverse(weighted_mean(mass_matrices)) @ (h * momentum_gap + momentum_velocity)
        rows = [
            jnp.zeros_like(x).at[p].set(row[p] + M @ (V - dH[p]) / h)
            for row, M, dH in zip(k[1:], mass_matrices, gradients, strict=True)
        ]
        return jnp.stack([step.at[q].set(V), *rows])

    def start(self, system: System, x) -> jax.Array:
        rate = system.vector_field(x)
        return jnp.concatenate([rate[None], jnp.zeros((self.stages - 1, len(x)))])

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    def weights(self, theta) -> np.ndarray:
        return np.multiply.outer(np.asarray(theta, dtype=float), np.eye(self.stages)[0])


def component_evaluation_fractions(system: ComposedSystem, map: FiniteDifference) -> np.ndarray:
    """Return, for each component of a composed system, the fraction of the step at which the map evaluates it."""
    q, p, _, _ = system.poisson.state_indices
    fractions = np.full(system.dim, map.beta)
    fractions[q], fractions[p] = map.alpha, 1.0 - map.alpha
    return fractions


def _momentum_hessian(system: ComposedSystem, x, momentum_indices) -> jax.Array:
    """Return ``H_pp``, the second derivatives of the energy by the momenta: the inverse of the mass matrix."""
    return jax.jacfwd(lambda y: system.energy.gradient(x.at[momentum_indices].set(y))[momentum_indices])(
        x[momentum_indices]
    )
