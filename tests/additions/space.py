"""A ring: the surface at a distance of one from a circle of radius three."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

import manifolds as mf


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Ring(mf.Space):
    radius: float = 3.0
    name = "ring"
    dim = 2
    shape = (3,)

    def _project(self, x):
        axis_distance = jnp.linalg.norm(x[..., :2], axis=-1, keepdims=True)
        centre = jnp.concatenate([self.radius * x[..., :2] / axis_distance, jnp.zeros_like(axis_distance)], axis=-1)
        return centre + (x - centre) / jnp.linalg.norm(x - centre, axis=-1, keepdims=True)
