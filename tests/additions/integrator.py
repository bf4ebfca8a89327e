"""The averaged vector field by Simpson's rule: order two, and no law for functions that are not polynomials."""

import jax
import jax.numpy as jnp

import liethermo as lt


class Simpson(lt.OneStepMethod):
    stages = 1
    order = 2
    preserves = frozenset()

    def slopes(self, system, x, compensation, h, k):
        points = x + (compensation + jnp.array([[0.0], [0.5], [1.0]]) * h * k)
        weights = jnp.array([1.0, 4.0, 1.0]) / 6.0
        mean = lambda f: weights @ jax.vmap(f.gradient)(points)  # noqa: E731
        dS = None if system.entropy is None else mean(system.entropy)
        return system.field(points[1], mean(system.energy), dS, tuple(map(mean, system.preserved_functions)))[None]

    def increment(self, h, k):
        return h * k[0]
