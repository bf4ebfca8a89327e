"""Heat conduction between the baths of a system, as in models of electrons, phonons and spins."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.edges import graph_edges
from ..functions.with_baths import temperature_derivatives_by_entropy
from .bodies import HeatConduction


class BathConduction(HeatConduction):
    """Heat conduction between baths, ``T_i y_i' = sum_j G_ij (T_j - T_i)`` for their entropies y and temperatures T.

    It is a summand beside the dissipation that heats the baths, and acts on the baths alone. The energy of all baths is
    constant, and their entropy grows by ``sum G_ij (T_i - T_j)^2 / (T_i T_j)`` over the pairs. The two-temperature
    model of electrons and phonons [Anisimov, Kapeliovich & Perelman 1974] is two baths and one conductance.

    Parameters
    ----------
    conductance : float, for two baths; sequence of (i, j, G), each pair once; or array, shape (number, number)
        G (power / temperature) between the baths i and j, numbered from 0.

    Raises
    ------
    InputError

    Examples
    --------
    >>> baths = lt.HeatBaths(capacity=[1.0, 20.0], temperature=[2.0, 0.5], number=2)
    >>> spin = lt.SpinSystem(
    ...     1,
    ...     lt.magnetism.zeeman(1, (0, 0, 1.0)),
    ...     [lt.LandauLifshitz(0.1), lt.BathConduction(0.3)],
    ...     baths,
    ... )
    >>> run = lt.integrate(spin, spin.state([[1.0, 0.0, 0.0]]), (0.0, 30.0), 0.1)
    >>> run.audit().passed, spin.temperatures(run.x[-1]).round(2).tolist()
    (True, [0.63, 0.62])
    """

    acts_on_baths_alone = True
    can_drive_baths = True

    def __init__(self, conductance):
        n_baths = _count_baths(conductance)
        names = [f"bath {i}" for i in range(n_baths)]
        super().__init__(graph_edges(conductance, n_baths, "the conductance", names))

    def bind_to(self, system):
        n_baths = 0 if system.baths is None else system.baths.number
        last = int(np.max(np.asarray(self.second_bodies), initial=0))
        if last >= n_baths:
            raise InputError(
                f"BathConduction joins bath {last}, but there are {n_baths} baths, numbered from 0: give the system "
                f"baths=lt.HeatBaths(..., number={last + 1})"
            )
        return self

    def entropy_indices(self, system):
        return np.arange(system.body_dim, system.dim)

    def entropy_rates(self, T, dS) -> jax.Array:
        """Return the growth rates of the entropies of all baths.

        Parameters
        ----------
        T, dS : array, shape (number,)
            Temperatures of the baths, and the gradient of the entropy by theirs.
        """
        first, second = self.edge_entropy_rates(T, T, dS, T)
        i, j = np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        return jnp.zeros_like(T).at[i].add(first).at[j].add(second)

    def divergence(self, system, x):
        """Return the divergence of each column of B.

        It is ``sqrt(G T_i / T_j) T_j' / (2 T_j) - sqrt(G T_j / T_i) T_i' / (2 T_i)``.

        T' is the derivative of a temperature by its entropy, at constant conductances.
        """
        slopes = temperature_derivatives_by_entropy(system.energy, x, system.body_dim)
        if slopes is None:
            return jnp.zeros(len(self.conductance))
        i, j = np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        T = system.energy.gradient(x)[system.body_dim :]
        root, ratio = jnp.sqrt(self.conductance), jnp.sqrt(T[i] / T[j])
        return 0.5 * root * (ratio * slopes[j] / T[j] - slopes[i] / (ratio * T[i]))


def _count_baths(conductance) -> int:
    """Return the number of baths that conductances join: edges, a matrix, or a number for two baths."""
    if isinstance(conductance, list | tuple) and all(isinstance(edge, tuple) for edge in conductance):
        ends = [end for edge in conductance for end in edge[:2] if isinstance(end, int | np.integer)]
        return max(ends, default=0) + 1
    return 2 if np.ndim(conductance) == 0 else len(conductance)
