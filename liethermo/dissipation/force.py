"""Forces on the reduced momentum of an Euler-Poincaré system."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from manifolds._pytree_module import Module

from ..functions.checks import traced_function_and_shape
from .base import Dissipation
from .checks import require_algebra


class EulerPoincareForce(Dissipation):
    """A force ``ad*_xi F(xi)`` [BFM 3.2, 3.4]: ``mu' = ad*_xi (mu + F(xi))`` conserves the energy for every F.

    The entropy law is not guaranteed; ``system.check()`` reports the sign of the entropy production at random points.

    Parameters
    ----------
    F : function from xi in g, shape (dim,), to a covector, shape (dim,)
        On copies of an algebra both have the shape ``(*sites, d)``.
    """

    F: Callable

    entropy_law = None
    needs_entropy = False

    def bind_to(self, system):
        require_algebra(system, "EulerPoincareForce")
        traced_function_and_shape(
            self.F, [system.shape], [system.shape], "the force F", f"a velocity of shape {system.shape}"
        )
        return dataclasses.replace(self, F=_FlattenedMap(self.F, system.shape)) if system.sites else self

    def added_momentum(self, dH, bracket_dH_dS):
        return self.F(dH)

    def force(self, system, x, dH, dS, dL):
        return system.algebra.ad_star(dH, self.F(dH))


class _FlattenedMap(Module):
    """A map of arrays of one shape, as a map of flat arrays."""

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, xi):
        return jnp.asarray(self.function(xi.reshape(self.shape))).ravel()
