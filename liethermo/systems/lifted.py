"""``LiftedSystem``: a system on states that extend those of another system, with the laws of that system."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp

from manifolds._pytree_module import forward_to

from ..dissipation.base import LiftedDissipation, LiftedGeometry
from ..functions.energy import Energy
from .base import System
from .domain import Domain
from .interface import BodyKinematics, EngineHints


class LiftedSystem(System):
    """A system whose states begin with those of :attr:`inner_system`, of which energy, entropy and laws are functions.

    A subclass sets its fields, calls :meth:`_lift_laws`, and defines the motion of the components that it adds.
    """

    @property
    def inner_system(self) -> System:
        """The system whose state is the first part of a state of this one, by default :attr:`wrapped_system`."""
        assert self.wrapped_system is not None
        return self.wrapped_system.system

    def inner_system_at(self, x) -> System:
        """Return the inner system frozen at the time and the attitude of a state x."""
        return self.inner_system

    def _lift_laws(self) -> None:
        """Set entropy, momentum maps and dissipation to those of the inner system, as functions of longer states."""
        inner = self.inner_system
        self.entropy = None if inner.entropy is None else self.lift_energy(inner.entropy)
        self.momentum_maps = {name: self.lift_energy(J) for name, J in inner.momentum_maps.items()}
        self.dissipation = InnerDissipation.lift_terms(inner.dissipation, self.lift_energy)
        self.preserved_labels, self.invariant_verdicts = inner.preserved_labels, inner.invariant_verdicts

    def lift_energy(self, energy: Energy) -> Energy:
        """Return an energy as a function of states, from an energy of inner states."""
        return energy.on(range(self.inner_system.dim))

    def restrict_to_inner_state(self, x, dH, dS, dL) -> tuple:
        """Return the state and the gradients restricted to components of the inner state; dS may be None."""
        n = self.inner_system.dim
        return x[:n], dH[:n], None if dS is None else dS[:n], tuple(L[:n] for L in dL)

    def attitude_velocity_from_gradients(self, x, dH, dS, dL=()):
        return self.inner_system_at(x).attitude_velocity_from_gradients(*self.restrict_to_inner_state(x, dH, dS, dL))

    def raise_index(self, x, alpha):
        n = self.inner_system.dim
        return jnp.concatenate([self.inner_system.raise_index(x[:n], alpha[:n]), alpha[n:]])

    def lower_index(self, x, v):
        n = self.inner_system.dim
        return jnp.concatenate([self.inner_system.lower_index(x[:n], v[:n]), v[n:]])

    def casimirs(self) -> dict[str, Energy]:
        return {name: self.lift_energy(C) for name, C in self.inner_system.casimirs().items()}

    @property
    def domain(self) -> Domain:
        n, domain = self.inner_system.dim, self.inner_system.domain
        return Domain(
            domain.description,
            lambda x: self._inner_system_at_first_state(x).domain.why_outside(x[..., :n]),
            lambda x: self._inner_system_at_first_state(x).domain.why_entropy_gradient_infinite(x[..., :n]),
            None if domain.margin is None else lambda x: self.inner_system_at(x).domain.margin_at(x[..., :n]),
        )

    def _inner_system_at_first_state(self, x) -> System:
        """Return the inner system frozen at the time of the first of several states, shape (..., n), not traced."""
        return self.inner_system

    @property
    def body_kinematics(self) -> BodyKinematics:
        n, inner = self.inner_system.dim, self.inner_system.body_kinematics

        def velocity(name: str, x):
            return self.inner_system_at(x).body_kinematics.velocities[name](x[:n])

        return inner._replace(
            velocities={name: partial(velocity, name) for name in inner.velocities},
            momentum_scale=lambda x: inner.momentum_scale(x[:n]),
        )

    @property
    def engine_hints(self) -> EngineHints:
        return self.inner_system.engine_hints._replace(is_smooth=super().engine_hints.is_smooth)

    torque_laws = forward_to("inner_system")
    orbit_levels = forward_to("inner_system")
    constraint_surface = forward_to("inner_system")


class InnerDissipation(LiftedDissipation):
    """A dissipation of the inner system, as one of longer states."""

    is_noiseless = forward_to("inner")

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return LiftedGeometry.from_leading_components(system.inner_system_at(x), x, system.inner_system.dim)
