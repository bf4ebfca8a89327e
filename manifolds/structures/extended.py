"""The phase space of several bodies with an entropy each: canonical in all positions and momenta [SML §5]."""

from __future__ import annotations

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ParameterError
from .poisson import PoissonStructure


class StateIndices(NamedTuple):
    """Where things are in a state of several (q_a, p_a, S_a): indices of all q, p and S, and whose each q is."""

    q: np.ndarray
    p: np.ndarray
    S: np.ndarray
    owner: np.ndarray


class ParticleIndices(NamedTuple):
    """Where particle numbers are in such a state, and whose each is."""

    N: np.ndarray
    owner: np.ndarray


class ExtendedPhaseSpace(PoissonStructure):
    """``T*R^n_1 x R x … x T*R^n_N x R``, coordinates (q_1, p_1, S_1, q_2, …): canonical in all (q, p) [SML §5].

    Every S_a is a Casimir function. An n_a of 0 leaves S_a alone. With ``species``, so many particle numbers follow the
    S_a of each body, Casimir functions too.
    """

    degrees_of_freedom: tuple[int, ...] = eqx.field(static=True)
    species: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        for numbers, what in ((self.degrees_of_freedom, "degrees of freedom"), (self.species or (0,), "species")):
            if not (isinstance(numbers, tuple) and numbers and all(isinstance(n, int) and n >= 0 for n in numbers)):
                raise ParameterError(f"{what} are a tuple of integers >= 0, not {numbers!r}")
        if self.species and len(self.species) != len(self.degrees_of_freedom):
            raise ParameterError(f"species are given for {len(self.species)} of {len(self.degrees_of_freedom)} bodies")

    @property
    def dim(self) -> int:
        return 2 * sum(self.degrees_of_freedom) + len(self.degrees_of_freedom) + sum(self.species)

    @property
    def state_indices(self) -> StateIndices:
        """Indices into a state."""
        return _build_indices(self.degrees_of_freedom, self.species)[0]

    @property
    def particle_indices(self) -> ParticleIndices:
        """Indices of the particle numbers."""
        return _build_indices(self.degrees_of_freedom, self.species)[1]

    def tensor(self, x) -> jax.Array:
        del x  # constant
        return jnp.asarray(np.eye(self.dim)[self._conjugate] * self._sign[:, None])

    def sharp(self, x, alpha) -> jax.Array:
        del x
        return self._sign * alpha[self._conjugate]

    @property
    def _conjugate(self) -> np.ndarray:
        q, p, _, _ = self.state_indices
        partner = np.arange(self.dim)
        partner[q], partner[p] = p, q
        return partner

    @property
    def _sign(self) -> np.ndarray:
        q, p, _, _ = self.state_indices
        sign = np.zeros(self.dim)
        sign[q], sign[p] = 1.0, -1.0
        return sign


@functools.lru_cache(maxsize=64)
def _build_indices(
    degrees_of_freedom: tuple[int, ...], species: tuple[int, ...]
) -> tuple[StateIndices, ParticleIndices]:
    n, m = np.array(degrees_of_freedom), np.array(species or (0,) * len(degrees_of_freedom))
    starts = np.cumsum(2 * n + 1 + m) - (2 * n + 1 + m)
    owner, holder = np.repeat(np.arange(len(n)), n), np.repeat(np.arange(len(n)), m)
    q = starts[owner] + np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
    S = starts + 2 * n
    N = S[holder] + 1 + np.arange(m.sum()) - np.repeat(np.cumsum(m) - m, m)
    return StateIndices(q, q + n[owner], S, owner), ParticleIndices(N, holder)
