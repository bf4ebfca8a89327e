"""Species that eat each other: ``x_i' = x_i sum_j A_ij (x_j - s_j)``, A skew, s their numbers at rest."""

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf
from liethermo.systems import Domain


class LotkaVolterra(lt.System):
    domain = Domain("positive numbers", lambda x: "" if np.all(np.asarray(x) > 0.0) else "a species has no members")

    def __init__(self, interaction, rest):
        A, rest = np.asarray(interaction, dtype=float), np.asarray(rest, dtype=float)
        tensor = mf.PoissonTensor(lambda x: x[:, None] * A * x[None, :], len(rest))
        self._build(tensor, len(rest), lambda x: jnp.sum(x - rest * jnp.log(x)), None, None, (), False)

    def samples(self, count, seed=0, scale=1.0):
        return np.random.default_rng(seed).uniform(0.5, 2.0, (count, self.dim))
