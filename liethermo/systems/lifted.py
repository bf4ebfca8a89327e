"""``LiftedSystem``: a system on states that extend those of another system, with the laws of that system."""

from __future__ import annotations

from abc import abstractmethod
from functools import partial

import jax.numpy as jnp

from manifolds._pytree_module import forward_to

from ..dissipation.base import LiftedDissipation, LiftedGeometry
from ..functions.energy import Energy
from .base import System
from .domain import Domain
from .interface import EngineHints, MotionQuantities


class LiftedSystem(System):
    """A system whose states begin with those of the system :attr:`inner`; energy, entropy and laws are functions of it.

    A subclass sets its fields, calls :meth:`_lift_laws`, and defines the motion of the components that it adds.
    """

    @property
    @abstractmethod
    def inner(self) -> System:
        """The inner system, whose state is the first part of a state of this one."""

    def inner_at(self, x) -> System:
        """Return the inner system as it acts at a state, at its time and attitude."""
        return self.inner

    def _lift_laws(self) -> None:
        """Set entropy, momentum maps and dissipation, those of the inner system."""
        inner = self.inner
        self.entropy = None if inner.entropy is None else self.extend(inner.entropy)
        self.momentum_maps = {name: self.extend(J) for name, J in inner.momentum_maps.items()}
        self.dissipation = InnerDissipation.lift_terms(inner.dissipation, self.extend)
        self.preserved_labels, self.invariant_verdicts = inner.preserved_labels, inner.invariant_verdicts

    def extend(self, energy: Energy) -> Energy:
        """Return a function of states from a function of inner states."""
        return energy.on(range(self.inner.dim))

    def inner_arguments(self, x, dH, dS, dL) -> tuple:
        """Return the inner state and the gradients with respect to it; dS may be None."""
        n = self.inner.dim
        return x[:n], dH[:n], None if dS is None else dS[:n], tuple(L[:n] for L in dL)

    def transport(self, x, dH, dS, dL=()):
        return self.inner_at(x).transport(*self.inner_arguments(x, dH, dS, dL))

    def raise_index(self, x, alpha):
        n = self.inner.dim
        return jnp.concatenate([self.inner.raise_index(x[:n], alpha[:n]), alpha[n:]])

    def lower_index(self, x, v):
        n = self.inner.dim
        return jnp.concatenate([self.inner.lower_index(x[:n], v[:n]), v[n:]])

    def casimirs(self) -> dict[str, Energy]:
        return {name: self.extend(C) for name, C in self.inner.casimirs().items()}

    @property
    def domain(self) -> Domain:
        n, domain = self.inner.dim, self.inner.domain
        return Domain(
            domain.description,
            lambda x: self._inner_at_first(x).domain.why_outside(x[..., :n]),
            lambda x: self._inner_at_first(x).domain.why_singular(x[..., :n]),
            None if domain.margin is None else lambda x: self.inner_at(x).domain.margin_at(x[..., :n]),
        )

    def _inner_at_first(self, x) -> System:
        """Return the inner system as it acts at the first of several states, shape (..., n), that are not traced."""
        return self.inner

    @property
    def motion_quantities(self) -> MotionQuantities:
        n, inner = self.inner.dim, self.inner.motion_quantities

        def velocity(name: str, x):
            return self.inner_at(x).motion_quantities.velocities[name](x[:n])

        return inner._replace(
            velocities={name: partial(velocity, name) for name in inner.velocities},
            momentum_scale=lambda x: inner.momentum_scale(x[:n]),
        )

    @property
    def hints(self) -> EngineHints:
        return self.inner.hints._replace(is_smooth=super().hints.is_smooth)

    torque_laws = forward_to("inner")
    orbit_levels = forward_to("inner")
    surface = forward_to("inner")


class InnerDissipation(LiftedDissipation):
    """A dissipation of the inner system, at the time and the attitude of the state."""

    is_noiseless = forward_to("inner")

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return LiftedGeometry.from_leading_components(system.inner_at(x), x, system.inner.dim)
