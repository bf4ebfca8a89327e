"""Rigid bodies joined by hinges, sliders and universal joints in a tree that is fixed to the ground."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds._precision import with_library_settings
from manifolds._pytree_module import replace_fields

from ..errors import InputError
from ..systems import HeatBaths
from ..systems.body_states import append_bath_entropies, broadcast_batches
from ..systems.interface import TORQUE_FREE_LAWS, TorqueLaws
from ..systems.torque import TorqueSystem
from .articulated_bodies import ArticulatedBodies, JointSprings, WeightPotential
from .joint_states import (
    JointMotors,
    JointRange,
    TreeSystem,
    kinetic_and_spring_terms,
    make_joint_damping,
    sum_of_terms,
)


class BodiesOnGround(TreeSystem, TorqueSystem):
    """Jointed rigid bodies on the ground, such as pendulums and arms, on ``T*Q``; :meth:`Tree.system` builds them.

    ``q' = dH/dp``, ``p' = -dH/dq - c q' + u``, ``T y' = sum c q'**2`` with ``H = p . M(q)^-1 p / 2 + V(q)``. V is the
    energy of the springs and of the weights in a uniform field of gravity, and u are the torques of motors. The state
    is (q, p), followed by the entropy y of the bath if there is one.

    Attributes
    ----------
    motors : JointMotors or None
        Motors of the joints.

    Examples
    --------
    A pendulum that hangs from the ceiling:

    >>> tree = lt.bodies.Tree(ground="ceiling")
    >>> hinge = lt.bodies.Hinge(at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    >>> bob = tree.add(
    ...     "bob", mass=1.0, centre=(0.0, 0.0, -0.5), parent="ceiling", joint=hinge
    ... )
    >>> pendulum = tree.system(gravity=(0.0, 0.0, -9.81))
    >>> pendulum.state(joints={"bob": 0.3}).shape
    (2,)
    """

    motors: JointMotors | None
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
        self.torque, self.torque_arguments = None, None
        self.motors, self._joint_ranges = motors, joint_ranges
        terms = kinetic_and_spring_terms(mechanism, springs)
        if gravity is not None:
            terms.append(WeightPotential(mechanism, gravity))
        dissipation = make_joint_damping(damping, 0)
        k, validate = mechanism.n_joints, False  # the axioms hold for every tree
        self._build(mf.Canonical(k), 2 * k, sum_of_terms(terms), None, dissipation, (), validate, baths=baths)

    @property
    def joint_ranges(self) -> tuple[JointRange, ...]:
        return self._joint_ranges

    # -- the torques of the motors ------------------------------------------------------------------------------------

    @property
    def torque_laws(self) -> TorqueLaws:
        return TORQUE_FREE_LAWS if self.motors is None else TorqueLaws(str(self.motors))

    def _torque_at(self, x, t, attitude):
        assert self.motors is not None
        return jnp.pad(self.motors(t), (self.mechanism.n_joints, 0))

    def drop_torque(self):
        system = super().drop_torque()
        return system if system is self else replace_fields(system, motors=None)

    # -- states -------------------------------------------------------------------------------------------------------

    @with_library_settings
    def state(
        self,
        x=None,
        batch: bool = False,
        *,
        joints: Mapping[str, Any] | None = None,
        joint_rates: Mapping[str, Any] | None = None,
        temperature=None,
        degrees: bool = False,
    ) -> jax.Array:
        """Make a state of shape (2 k,) from joint coordinates and rates by name, or check an array of components.

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
        temperature : float, or array, shape (B, 1); optional
            Temperature of the bath; by default that at zero entropy.
        degrees : bool
            If true, joint angles and their rates are in degrees and degrees/s.

        Returns
        -------
        array, shape (n,), or (B, n) if an argument has an axis of length B

        Raises
        ------
        InputError
            If there is no joint of this name, a shape does not fit, or a temperature is given without a bath.
        """
        if x is not None:
            if degrees or any(value is not None for value in (joints, joint_rates, temperature)):
                raise InputError("give a state x, or joints and rates by name, not both")
            return super().state(x, batch)
        q = self._joint_vector_from_names(joints, "joints", degrees)
        q, rates = broadcast_batches(q, self._joint_vector_from_names(joint_rates, "joint_rates", degrees))
        momenta = jnp.einsum("...ij,...j->...i", self.mass_matrix(q), rates)
        x = append_bath_entropies(jnp.concatenate([q, momenta], axis=-1), self.baths, temperature)
        return super().state(x, x.ndim > 1)
