"""Phase space of several bodies with an entropy each: canonical in all positions and momenta [SML §5]."""

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
    """Indices of all q, p and S in a state of several (q_a, p_a, S_a), and the body a that owns each q."""

    q: np.ndarray
    p: np.ndarray
    S: np.ndarray
    owner: np.ndarray


class ParticleIndices(NamedTuple):
    """Indices of the particle numbers in a state, and the body that owns each."""

    N: np.ndarray
    owner: np.ndarray


class ExtendedPhaseSpace(PoissonStructure):
    """Poisson structure on ``T*R^n_1 x R x … x T*R^n_N x R``, coordinates (q_1, p_1, S_1, q_2, …): canonical [SML §5].

    Every S_a is a Casimir function. With n_a = 0 a body has S_a alone. ``species`` gives the number of particle numbers
    that follow the S_a of each body; they are Casimir functions too.
    """

    degrees_of_freedom: tuple[int, ...] = eqx.field(static=True)
    species: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        for numbers, label in ((self.degrees_of_freedom, "degrees of freedom"), (self.species or (0,), "species")):
            if not (isinstance(numbers, tuple) and numbers and all(isinstance(n, int) and n >= 0 for n in numbers)):
                raise ParameterError(f"{label} must be a tuple of integers >= 0, got {numbers!r}")
        if self.species and len(self.species) != len(self.degrees_of_freedom):
            raise ParameterError(f"species are given for {len(self.species)} of {len(self.degrees_of_freedom)} bodies")

    @property
    def dim(self) -> int:
        return 2 * sum(self.degrees_of_freedom) + len(self.degrees_of_freedom) + sum(self.species)

    @property
    def state_indices(self) -> StateIndices:
        """Indices of all q, p and S in a state."""
        return _build_indices(self.degrees_of_freedom, self.species)[0]

    @property
    def particle_indices(self) -> ParticleIndices:
        """Indices of the particle numbers in a state."""
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
