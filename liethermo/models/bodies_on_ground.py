"""Rigid bodies joined by hinges, sliders and universal joints in a tree that is fixed to the ground."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings

from ..errors import InputError
from ..functions.energy import Energy
from ..systems import HeatBaths
from .articulated_bodies import ArticulatedBodies, JointDamping, JointSprings, KineticEnergy, WeightPotential
from .joint_states import JointMotors, JointRange, TreeSystem, broadcast_batches, sum_of_terms


class BodiesOnGround(TreeSystem):
    """A tree of jointed rigid bodies on the ground, such as pendulums and arms, on ``T*Q``; :meth:`Tree.system` builds
    it.

    ``q' = dH/dp``, ``p' = -dH/dq - c q' + u``, ``T y' = sum c q'**2`` with ``H = p . M(q)^-1 p / 2 + V(q)``. V is the
    energy of the springs and of the weights in a uniform field of gravity, and u are the torques of motors. The state
    is (q, p), followed by the entropy y of the bath if there is one.

    Attributes
    ----------
    motors : JointMotors or None
    motor_time : array, shape (), or None
        Time at which the torques of the motors are taken: see :meth:`at_time`.
    """

    motors: JointMotors | None
    motor_time: jax.Array | None
    _joint_ranges: tuple[JointRange, ...] = eqx.field(static=True)

    def __init__(
        self,
        mechanism: ArticulatedBodies,
        springs: JointSprings,
        damping,
        joint_ranges: tuple[JointRange, ...],
        baths: HeatBaths | None = None,
        motors: JointMotors | None = None,
        gravity: jax.Array | None = None,
    ):
        self.motors, self.motor_time, self._joint_ranges = motors, None, joint_ranges
        terms: list[Energy] = [KineticEnergy(mechanism)]
        if is_traced(springs.stiffness) or np.asarray(springs.stiffness).any():
            terms.append(springs)
        if gravity is not None:
            terms.append(WeightPotential(mechanism, gravity))
        dissipation = JointDamping(damping, 0) if is_traced(damping) or np.asarray(damping).any() else None
        k, validate = mechanism.n_joints, False  # the axioms hold for every tree
        self._build(mf.Canonical(k), 2 * k, sum_of_terms(terms), None, dissipation, (), validate, baths=baths)

    @property
    def joint_ranges(self) -> tuple[JointRange, ...]:
        return self._joint_ranges

    # -- the torques of the motors ------------------------------------------------------------------------------------

    @property
    def torque_name(self) -> str:
        return "" if self.motors is None else str(self.motors)

    has_impulse = False

    @property
    def is_driven(self) -> bool:
        return self.motors is not None and self.motor_time is None

    def at_time(self, t, attitude=None):
        if self.motors is None:
            return self
        system = copy(self)
        object.__setattr__(system, "motor_time", jnp.asarray(t, dtype=jnp.float64))
        return system

    def external_torque(self, x):
        if self.motors is None:
            return None
        if self.motor_time is None:
            raise InputError(f"the torque {self.torque_name} is known at a time: take system.at_time(t)")
        k = self.mechanism.n_joints
        return jnp.pad(self.motors(self.motor_time), (k, self.dim - 2 * k))

    def field(self, x, dH, dS, dL=()):
        torque = self.external_torque(x)
        motion = super().field(x, dH, dS, dL)
        return motion if torque is None else motion + torque

    def drop_torque(self):
        system = copy(self)
        for name in ("motors", "motor_time"):
            object.__setattr__(system, name, None)
        return system

    # -- states -------------------------------------------------------------------------------------------------------

    @with_library_settings
    def state(
        self,
        x=None,
        batch: bool = False,
        *,
        joints: Mapping[str, Any] | None = None,
        joint_rates: Mapping[str, Any] | None = None,
    ) -> jax.Array:
        """Return a state, from joint coordinates and rates, or from an array of its components.

        Parameters
        ----------
        x : array, shape (n,), optional
            The state (q, p, y), or (q, p), instead of all other arguments.
        batch : bool
            Allow x to be many states, shape (..., n).
        joints : dict of float, or of array, shape (B,); optional
            Joint coordinates (rad, or m) by the name of the body; two of a universal joint, shape (2,) or (B, 2). Those
            left out are zero.
        joint_rates : dict, as ``joints``; optional
            Rates of the joint coordinates (rad/s, or m/s); those left out are zero.

        Returns
        -------
        array, shape (n,), or (B, n) if an argument has an axis of length B

        Raises
        ------
        InputError
            If there is no joint of a name, or a shape does not fit.
        """
        if x is not None:
            if joints is not None or joint_rates is not None:
                raise InputError("give a state x, or joints and rates by name, not both")
            return super().state(x, batch)
        q, rates = self._joint_vector(joints, "joints"), self._joint_vector(joint_rates, "joint_rates")
        q, rates = broadcast_batches(q, rates)
        momenta = jnp.einsum("...ij,...j->...i", self.mass_matrix(q), rates)
        x = jnp.concatenate([q, momenta], axis=-1)
        return super().state(x, x.ndim > 1)
