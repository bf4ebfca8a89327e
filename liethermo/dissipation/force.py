"""Forces on the reduced momentum of an Euler-Poincaré system."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..errors import InputError
from .base import Dissipation
from .checks import needed_algebra, zero_state


class EulerPoincareForce(Dissipation):
    """A force ``ad*_xi F(xi)`` [BFM 3.2, 3.4]: ``mu' = ad*_xi (mu + F(xi))`` conserves the energy for every F.

    The entropy law is not guaranteed; ``system.check()`` reports the sign of the entropy production at random points.

    Parameters
    ----------
    F : function from xi in g, shape (dim,), to a covector, shape (dim,)
    """

    F: Callable

    @property
    def entropy_law(self):
        return None

    @property
    def needs_entropy(self):
        return False

    def prepared(self, system):
        g = needed_algebra(system, "EulerPoincareForce")
        shape = jax.eval_shape(lambda xi: jnp.asarray(self.F(xi)), zero_state(g.dim)).shape
        if shape != (g.dim,):
            raise InputError(f"the force F must map shape ({g.dim},) to ({g.dim},), but it returns shape {shape}")
        return self

    def momentum(self, dH, turned):
        return self.F(dH)

    def force(self, system, x, dH, dS, dL):
        return system.algebra.ad_star(dH, self.F(dH))
