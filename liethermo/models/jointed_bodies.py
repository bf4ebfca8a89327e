"""Rigid bodies joined by hinges, sliders and universal joints in a tree, free in space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._precision import with_library_settings
from manifolds._pytree_module import replace_fields
from manifolds.structures.poisson import PoissonStructure, ProductPoisson

from ..errors import InputError
from ..functions.energy import Energy, Quadratic
from ..systems import HeatBaths, LiePoissonSystem
from ..systems.body_states import append_bath_entropies, broadcast_batches
from ..systems.interface import BodyKinematics, TorqueLaws
from ..tracing.programs import jit_unoptimised
from .articulated_bodies import ArticulatedBodies, JointSprings, KineticEnergy, SquaredMomentum
from .joint_states import (
    JointMotors,
    JointRange,
    TreeSystem,
    checked_vectors,
    kinetic_and_spring_terms,
    make_joint_damping,
    sum_of_terms,
)
from .orbits import Orbit, direction_and_distance_to_centre


class JointedBodies(TreeSystem, LiePoissonSystem):
    """A free tree of jointed rigid bodies on ``so(3)* x T*Q``; :meth:`Tree.system` builds it.

    ``Pi' = Pi × Omega + torque``, ``q' = dH/dp``, ``p' = -dH/dq - c q' + u``, ``T y' = sum c q'**2`` with ``H = (Pi, p)
    . M(q)^-1 (Pi, p) / 2 + V(q)`` [Marsden & Scheurle 1993]. Pi is the angular momentum about the common centre of
    mass, in axes of the base, and p are the momenta of the joint coordinates q. Springs, dampers and motors u in the
    joints change no angular momentum in space. The attitude is that of the base.

    The state is (Pi, q, p), followed by the entropy y of the bath if there is one. In a uniform field of gravity g it
    is (Pi, q, p, X, P, y), with the position X and the momentum P of the common centre of mass in axes in space: ``X' =
    P / m``, ``P' = m g``. Along an orbit the gradient of gravity acts on every body, a torque on Pi and forces on p.
    Joint coordinates are in the order of :attr:`joint_ranges`.

    Attributes
    ----------
    motors, orbit : JointMotors or None, Orbit or None
        The motors of the joints, and the orbit along which the gradient of gravity acts.
    """

    motors: JointMotors | None
    orbit: Orbit | None
    _joint_ranges: tuple[JointRange, ...] = eqx.field(static=True)

    def __init__(
        self,
        mechanism: ArticulatedBodies,
        springs: JointSprings,
        damping,
        joint_ranges: tuple[JointRange, ...],
        baths: HeatBaths | None = None,
        torque: Any = None,
        motors: JointMotors | None = None,
        attitude: bool = True,
        gravity: jax.Array | Orbit | None = None,
    ):
        algebra, k = mf.so(3), mechanism.n_joints
        self.algebra, self.group, self.reconstruction = algebra, None, None
        if attitude:
            self.group, self.reconstruction = mf.SO(3), "coadjoint"
        self._set_torque(torque)
        self.orbit = gravity if isinstance(gravity, Orbit) else None
        if self.orbit is not None and not attitude:
            raise InputError("gravity along an orbit depends on the attitude. Leave out attitude=False")
        self.motors, self._joint_ranges = motors, joint_ranges
        terms = kinetic_and_spring_terms(mechanism, springs)
        poisson: PoissonStructure = ProductPoisson(mf.LiePoisson(algebra), mf.Canonical(k))
        dim = 3 + 2 * k
        if gravity is not None and not isinstance(gravity, Orbit):
            mass, n = jnp.sum(mechanism.masses), dim
            terms = [term.on(range(n)) for term in terms]
            poisson, dim = ProductPoisson(poisson, mf.Canonical(3)), n + 6
            falling = Quadratic(jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) / mass, jnp.pad(-mass * gravity, (0, 3)))
            terms.append(falling.on(range(n, dim)))
        validate = False  # the axioms hold for every tree
        self._build(poisson, dim, sum_of_terms(terms), None, make_joint_damping(damping, 3), (), validate, baths=baths)

    @property
    def joint_ranges(self) -> tuple[JointRange, ...]:
        return self._joint_ranges

    # -- torques of motors and of gravity -----------------------------------------------------------------------------

    @property
    def torque_laws(self) -> TorqueLaws:
        laws, motors = super().torque_laws, "" if self.motors is None else str(self.motors)
        if self.orbit is None:
            return replace(laws, name=" + ".join(filter(None, [laws.name, motors])))
        name = " + ".join(filter(None, [laws.name, "gradient of gravity", motors]))
        changed_casimirs = frozenset(self.momentum_casimirs())
        return TorqueLaws(name, True, not self.has_fixed_attitude, changed_casimirs)

    def _torque_at(self, x, t, attitude):
        k = self.mechanism.n_joints
        body_torque, joint_forces = jnp.zeros(3), jnp.zeros(k)
        if self.orbit is not None:
            direction, distance = direction_and_distance_to_centre(self.orbit, t)
            # without the barrier XLA crashes on products of many such matrices with vectors
            n = jax.lax.optimization_barrier(attitude).T @ direction
            strength = self.orbit.mean_motion**2 / distance**3
            body_torque, joint_forces = (
                strength * force for force in self.mechanism.gravity_gradient_forces(x[3 : 3 + k], n)
            )
        if self.motors is not None:
            joint_forces = joint_forces + self.motors(t)
        forces = jnp.concatenate([body_torque, jnp.zeros(k), joint_forces])
        if self.torque is None:
            return forces
        return jnp.pad(super()._torque_at(x, t, attitude), (0, 2 * k)) + forces

    def drop_torque(self):
        system = super().drop_torque()
        return system if system is self else replace_fields(system, motors=None, orbit=None)

    def casimirs(self) -> dict[str, Energy]:
        kinetic = KineticEnergy(self.mechanism)
        return {name: SquaredMomentum(C, kinetic) for name, C in self.momentum_casimirs().items()}

    @property
    def body_kinematics(self) -> BodyKinematics:
        return super().body_kinematics._replace(momentum_scale=KineticEnergy(self.mechanism).momentum_scale)

    @property
    def inertia(self) -> None:
        """None: the inertia depends on the joint coordinates; see :meth:`mass_matrix`."""
        return None

    # -- mechanics ----------------------------------------------------------------------------------------------------

    def angular_velocity(self, x) -> jax.Array:
        """Return the angular velocity of the base in its axes, shape (..., 3) (rad/s), at states x, shape (..., n)."""
        return self._motion(x).angular_velocity

    @property
    def _centre_of_mass_index(self) -> int | None:
        """Index of the position of the centre of mass in a state; None if the state has no position."""
        n = 3 + 2 * self.mechanism.n_joints
        return n if self.body_dim > n else None

    def centre_of_mass(self, x) -> jax.Array:
        """Return the centre of mass of the tree in axes in space, shape (..., 3), at states x, shape (..., n).

        Raises
        ------
        InputError
            If the tree has no position, since it was built without ``gravity=(gx, gy, gz)``.
        """
        start = self._centre_of_mass_index
        if start is None:
            raise InputError(
                "the tree has no position. Build it by tree.system(gravity=(0, 0, 0)), or with another uniform field"
            )
        return self.state(x, batch=True)[..., start : start + 3]

    @with_library_settings
    def base_position(self, x, attitude) -> jax.Array:
        """Return the position of the origin of the base in axes in space, shape (..., 3).

        Parameters
        ----------
        x : array, shape (..., n)
            States. Without a position in the state, the common centre of mass is at zero.
        attitude : array, shape (..., 3, 3)
            Attitudes of the base, such as those of a solution.
        """
        x, k = self.state(x, batch=True), self.mechanism.n_joints
        q = x[..., 3 : 3 + k]
        offsets = _centres_of_mass_in_base(self.mechanism, q.reshape(-1, k)).reshape(*x.shape[:-1], 3)
        centre = jnp.zeros(3) if self._centre_of_mass_index is None else self.centre_of_mass(x)
        return centre - jnp.einsum("...ij,...j->...i", jnp.asarray(attitude), offsets)

    # -- states -------------------------------------------------------------------------------------------------------

    @with_library_settings
    def state(  # type: ignore[override]  # joints have coordinates and rates of their own
        self,
        x=None,
        batch: bool = False,
        *,
        angular_velocity=None,
        momentum=None,
        joints: Mapping[str, Any] | None = None,
        joint_rates: Mapping[str, Any] | None = None,
        centre_of_mass=None,
        velocity=None,
        temperature=None,
        degrees: bool = False,
    ) -> jax.Array:
        """Make a state from momenta or velocities and joint coordinates, or check an array of components.

        Parameters
        ----------
        x, batch : array, shape (n,), or (..., n) with ``batch=True``; optional
            The state, with or without the entropy of the bath, instead of all other arguments.
        angular_velocity : array, shape (3,) or (B, 3), optional
            Angular velocity of the base, in its axes (rad/s); zero by default.
        momentum : array, shape (3,) or (B, 3), optional
            Angular momentum of the whole about its centre of mass, in axes of the base (kg m**2 / s), instead of the
            angular velocity.
        joints, joint_rates : dict of float, or of array, shape (B,); optional
            Joint coordinates (rad, or m) and their rates (rad/s, or m/s) by the name of the body; two of a universal
            joint, shape (2,) or (B, 2). Those left out are zero.
        centre_of_mass, velocity : array, shape (3,) or (B, 3), optional
            Position (m) and velocity (m/s) of the common centre of mass in axes in space, for a tree in a uniform field
            of gravity; zero by default.
        temperature, degrees : float, or array, shape (B, 1); bool; optional
            Temperature of the bath, by default that at zero entropy; and whether angles and rates are in degrees.

        Returns
        -------
        array, shape (n,), or (B, n) if an argument has an axis of length B

        Raises
        ------
        InputError
            If there is no joint of this name, a shape does not fit, or a temperature is given without a bath.
        """
        details = angular_velocity, momentum, joints, joint_rates, centre_of_mass, velocity, temperature
        if x is not None:
            if degrees or any(value is not None for value in details):
                raise InputError("give a state x, or velocities and joints by name, not both")
            return super().state(x, batch)
        if angular_velocity is not None and momentum is not None:
            raise InputError("give angular_velocity= or momentum=, not both")
        q = self._joint_vector_from_names(joints, "joints", degrees)
        rates = self._joint_vector_from_names(joint_rates, "joint_rates", degrees)
        name = "angular_velocity" if momentum is None else "momentum"
        given_vectors = [v for v in (angular_velocity, momentum) if v is not None]
        vector = checked_vectors(given_vectors[0] if given_vectors else np.zeros(3), name)
        vector, q, rates, *translation = broadcast_batches(
            vector, q, rates, *self._centre_of_mass_components(centre_of_mass, velocity)
        )
        M = self.mass_matrix(q)
        if momentum is None:
            Omega = jnp.deg2rad(vector) if degrees else vector
        else:
            residual = vector - jnp.einsum("...ij,...j->...i", M[..., :3, 3:], rates)
            Omega = jnp.linalg.solve(M[..., :3, :3], residual[..., None])[..., 0]
        momenta = jnp.einsum("...ij,...j->...i", M, jnp.concatenate([Omega, rates], axis=-1))
        Pi = momenta[..., :3] if momentum is None else vector
        x = jnp.concatenate([Pi, q, momenta[..., 3:], *translation], axis=-1)
        x = append_bath_entropies(x, self.baths, temperature)
        return super().state(x, x.ndim > 1)

    def _centre_of_mass_components(self, centre_of_mass, velocity) -> tuple[jax.Array, ...]:
        """Return the components of a state for the position and momentum of the centre of mass; none without a
        position."""
        if self._centre_of_mass_index is None:
            if centre_of_mass is not None or velocity is not None:
                raise InputError(
                    "centre_of_mass= and velocity= need a tree with a position. Build it by "
                    "tree.system(gravity=(0, 0, 0)), or with another uniform field"
                )
            return ()
        values = {"centre_of_mass": centre_of_mass, "velocity": velocity}
        X, v = (checked_vectors(np.zeros(3) if value is None else value, name) for name, value in values.items())
        return X, jnp.sum(self.mechanism.masses) * v


@jit_unoptimised
def _centres_of_mass_in_base(mechanism: ArticulatedBodies, q) -> jax.Array:
    return jax.vmap(lambda q: mechanism.centre_of_mass_in_base(mechanism.poses(q)))(q)
