"""Matter that crosses membranes, and chemical reactions: friction between chemical potentials [after GBY; SML §7]."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module
from manifolds.algebras._null_space import row_echelon

from .base import Dissipation
from .factor import Factor


class Process(Module):
    """A process that changes several particle numbers together, ``N' = nu J``.

    Attributes
    ----------
    stoichiometry : tuple of float
        The coefficients nu of all particle numbers of the system.
    heat_shares : tuple of float
        The fractions of the released energy ``A = -nu . mu`` that heat each body, of sum 1.
    entropy_transport : tuple of float
        1 for a body that receives entropy, -1 for one that gives entropy, otherwise 0.
    entropy : array, shape ()
        Entropy transported with a particle.
    coefficient : array, shape (), or function of the whole state
        L >= 0.
    """

    stoichiometry: tuple[float, ...] = eqx.field(static=True)
    heat_shares: tuple[float, ...] = eqx.field(static=True)
    entropy_transport: tuple[float, ...] = eqx.field(static=True)
    entropy: jax.Array
    coefficient: jax.Array | Callable


class MatterExchange(Dissipation):
    """Processes e with fluxes ``J_e = L_e z_e . dS`` along vectors z_e that hold the energy.

    ``z = nu d/dN + sum_b (w_b A + c_b s T_m) / T_b d/dS_b`` with the affinity ``A = -nu . mu``, ``mu = H_N`` and
    ``T_b = H_{S_b}``; w has sum 1 and c has sum 0, so ``z . dH = nu . mu + A = 0``, for discrete gradients too. The
    entropy grows by ``sum_e L_e (z_e . dS)^2``; in one body ``J = L A / T``, and through a membrane between equal
    temperatures ``J = L (mu_2 - mu_1) / T``. In metriplectic form K is ``sum_e L_e z_e z_e^T``.

    Parameters
    ----------
    processes : sequence of Process
    """

    processes: tuple[Process, ...]

    def __init__(self, processes: Sequence[Process]):
        self.processes = tuple(processes)

    def force(self, system, x, dH, dS, dL):
        z_dot, apply_fluxes = self._affinity_and_velocity_maps(system, x, dH)
        return apply_fluxes(self._flux_coefficients(x) * z_dot(dS))

    def factor(self, system, x, dH, dL):
        _, apply_fluxes = self._affinity_and_velocity_maps(system, x, dH)
        root = jnp.sqrt(self._flux_coefficients(x))
        return Factor(len(self.processes), lambda w: apply_fluxes(root * w))

    def _flux_coefficients(self, x) -> jax.Array:
        """Return L of each process; NaN where it is negative: the step is then rejected."""
        coefficients = [e.coefficient(x) if callable(e.coefficient) else e.coefficient for e in self.processes]
        L = jnp.stack([jnp.asarray(value) for value in coefficients])
        return jnp.where(L >= 0.0, L, jnp.nan)

    def _affinity_and_velocity_maps(self, system, x, dH) -> tuple[Callable, Callable]:
        """Return two functions: from dS to ``z_e . dS`` of each process, and from fluxes to ``sum_e flux_e z_e``."""
        stoichiometry, heat_shares, entropy_transport = (
            np.array([getattr(e, name) for e in self.processes])
            for name in ("stoichiometry", "heat_shares", "entropy_transport")
        )
        N, S = system.poisson.particle_indices.N, system.poisson.state_indices.S
        mu, T = dH[N], dH[S]
        T, n_ends = jnp.where(T > 0.0, T, jnp.nan), np.abs(entropy_transport)
        affinity = -(stoichiometry @ mu)
        mean_temperature = n_ends @ T / np.maximum(n_ends.sum(axis=1), 1.0)
        transported_heat = jnp.stack([e.entropy for e in self.processes]) * mean_temperature
        entropies = (heat_shares * affinity[:, None] + entropy_transport * transported_heat[:, None]) / T
        return (
            lambda dS: stoichiometry @ dS[N] + entropies @ dS[S],
            lambda flux: jnp.zeros_like(x).at[N].add(flux @ stoichiometry).at[S].add(flux @ entropies),
        )


def conserved_number_combinations(processes: Sequence[Process], n_particle_numbers: int) -> np.ndarray:
    """Return combinations of particle numbers that no process changes, shape (combinations, count), row-reduced."""
    rows = np.array([e.stoichiometry for e in processes]).reshape(-1, n_particle_numbers)
    _, singular, basis = np.linalg.svd(rows, full_matrices=True)
    rank = int((singular > 1e-12 * max(1.0, singular.max(initial=0.0))).sum())
    kernel, _ = row_echelon(basis[rank:], tolerance=1e-9)
    return np.where(np.abs(kernel) < 1e-12, 0.0, kernel)
