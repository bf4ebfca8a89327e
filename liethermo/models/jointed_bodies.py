"""Rigid bodies joined by hinges, sliders and universal joints in a tree, free in space."""

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
from manifolds._pytree_module import Module
from manifolds.structures.poisson import ProductPoisson

from ..errors import InputError
from ..functions.energy import Energy, Sum
from ..systems import HeatBaths, LiePoissonSystem
from ..tracing.programs import jit_unoptimised
from .articulated_bodies import ArticulatedBodies, JointDamping, JointSprings, KineticEnergy, Motion, SquaredMomentum
from .parameters import checked_finite


class JointMotors(Module):
    """Torques of motors in the joints, as functions of the time.

    Attributes
    ----------
    functions : tuple of arrays, shape (size,), or functions from t, shape (), to one
    indices : tuple of tuple of int
        Joint coordinates that each motor drives.
    n_joints : int
        Number of joint coordinates.
    names : tuple of str
        Names of the bodies that are driven.
    """

    functions: tuple[Any, ...]
    indices: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    n_joints: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t) -> jax.Array:
        torques = jnp.zeros(self.n_joints)
        for function, indices in zip(self.functions, self.indices, strict=True):
            values = jnp.asarray(function(t) if callable(function) else function)
            torques = torques.at[np.array(indices)].add(values.reshape(len(indices)))
        return torques


class JointedBodies(LiePoissonSystem):
    """A free tree of jointed rigid bodies on ``so(3)* x T*Q``; :meth:`Tree.system` builds it.

    ``Pi' = Pi × Omega + torque``, ``q' = dH/dp``, ``p' = -dH/dq - c q' + u``, ``T y' = sum c q'**2`` with ``H = (Pi, p)
    . M(q)^-1 (Pi, p) / 2 + V(q)`` [Marsden & Scheurle 1993]. Pi is the angular momentum about the common centre of
    mass, in axes of the base, and p are the momenta of the joint coordinates q; the linear momentum is zero. Springs,
    dampers and motors u in the joints change no angular momentum in space. The attitude is that of the base.

    The state is (Pi, q, p), followed by the entropy y of the bath if there is one. Joint coordinates are in the order
    of :attr:`joint_indices`.

    Attributes
    ----------
    motors : JointMotors or None
    joint_indices : tuple of (str, int, int)
        Name of each body that has a joint, and the first and the last but one index of its coordinates in a state.
    """

    motors: JointMotors | None
    joint_indices: tuple[tuple[str, int, int], ...] = eqx.field(static=True)

    def __init__(
        self,
        mechanism: ArticulatedBodies,
        springs: JointSprings,
        damping,
        joint_indices: tuple[tuple[str, int, int], ...],
        baths: HeatBaths | None = None,
        torque: Any = None,
        motors: JointMotors | None = None,
        attitude: bool = True,
    ):
        algebra, k = mf.so(3), mechanism.n_joints
        self.algebra, self.group, self.reconstruction = algebra, None, None
        if attitude:
            self.group, self.reconstruction = mf.SO(3), "coadjoint"
        self._set_torque(torque)
        self.motors, self.joint_indices = motors, joint_indices
        energy: Energy = KineticEnergy(mechanism)
        if is_traced(springs.stiffness) or np.asarray(springs.stiffness).any():
            energy = Sum((energy, springs))
        dissipation = JointDamping(damping) if is_traced(damping) or np.asarray(damping).any() else None
        poisson = ProductPoisson(mf.LiePoisson(algebra), mf.Canonical(k))
        validate = False  # the axioms hold for every tree
        self._build(poisson, 3 + 2 * k, energy, None, dissipation, (), validate, baths=baths)

    # -- the motor torques --------------------------------------------------------------------------------------------

    @property
    def torque_name(self) -> str:
        motors = "" if self.motors is None else f"motors of {', '.join(self.motors.names)}"
        return " + ".join(filter(None, [super().torque_name, motors]))

    @property
    def is_driven(self) -> bool:
        return super().is_driven or (self.motors is not None and self.torque_arguments is None)

    def at_time(self, t, attitude=None):
        system = super().at_time(t, attitude)
        if self.motors is None or system.torque_arguments is not None:
            return system
        system = copy(system)
        object.__setattr__(system, "torque_arguments", (jnp.asarray(t, dtype=jnp.float64), None))
        return system

    def external_torque(self, x):
        torque = super().external_torque(x)
        if self.motors is None:
            return torque
        if self.torque_arguments is None:
            raise InputError(f"the torque {self.torque_name} is known at a time: take system.at_time(t)")
        k = self.mechanism.n_joints
        joint_torques = jnp.pad(self.motors(self.torque_arguments[0]), (3 + k, self.dim - 3 - 2 * k))
        return joint_torques if torque is None else torque + joint_torques

    def drop_torque(self):
        system = copy(super().drop_torque())
        object.__setattr__(system, "motors", None)
        object.__setattr__(system, "torque_arguments", None)
        return system

    @property
    def torque_invariant_casimirs(self) -> frozenset[str]:
        return frozenset(self.casimirs()) if self.torque is None else super().torque_invariant_casimirs

    def casimirs(self) -> dict[str, Energy]:
        kinetic = KineticEnergy(self.mechanism)
        return {name: SquaredMomentum(C, kinetic) for name, C in self.momentum_casimirs().items()}

    def momentum_scale(self, x) -> jax.Array:
        return KineticEnergy(self.mechanism).momentum_scale(x)

    @property
    def joint_ranges(self):
        return self.joint_indices

    @property
    def inertia(self) -> None:
        """None: the inertia depends on the joint coordinates; see :meth:`mass_matrix`."""
        return None

    # -- mechanics ----------------------------------------------------------------------------------------------------

    @property
    def mechanism(self) -> ArticulatedBodies:
        """The bodies and joints, with their parameters."""
        kinetic = self.drop_baths().energy.terms[0]
        assert isinstance(kinetic, KineticEnergy)
        return kinetic.mechanism

    @with_library_settings
    def mass_matrix(self, q) -> jax.Array:
        """Return M(q), shape (..., 3 + k, 3 + k), for which the kinetic energy is ``(Omega, q') . M (Omega, q') / 2``.

        Parameters
        ----------
        q : array, shape (..., k)
            Joint coordinates (rad or m).
        """
        q = jnp.asarray(q, dtype=jnp.float64)
        if q.shape[-1:] != (self.mechanism.n_joints,):
            raise InputError(f"q must have shape (..., {self.mechanism.n_joints}), got {q.shape}")
        matrices = _mass_matrices(self.mechanism, q.reshape(-1, q.shape[-1]))
        return matrices.reshape(*q.shape[:-1], *matrices.shape[1:])

    def angular_velocity(self, x) -> jax.Array:
        """Return the angular velocity of the base in its axes, shape (..., 3) (rad/s), at states x, shape (..., n)."""
        return self._motion(x).angular_velocity

    def joint_rates(self, x) -> dict[str, jax.Array]:
        """Return the rates of the joint coordinates by the name of the body, at states x, shape (..., n).

        Each has the shape (...), or (..., 2) for a universal joint.
        """
        rates = self._motion(x).joint_rates
        return {name: _entries(rates, start - 3, end - 3) for name, start, end in self.joint_indices}

    @with_library_settings
    def _motion(self, x) -> Motion:
        x = self.state(x, batch=True)
        flat = _motions(self.mechanism, x.reshape(-1, self.dim))
        return Motion(*(part.reshape(*x.shape[:-1], *part.shape[1:]) for part in flat))

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
    ) -> jax.Array:
        """Return a state, from velocities or from an array of its components.

        Parameters
        ----------
        x : array, shape (n,), optional
            The state (Pi, q, p, y), or (Pi, q, p), instead of all other arguments.
        batch : bool
            Allow x to be many states, shape (..., n).
        angular_velocity : array, shape (3,) or (B, 3), optional
            Angular velocity of the base, in its axes (rad/s); zero by default.
        momentum : array, shape (3,) or (B, 3), optional
            Angular momentum of the whole about its centre of mass, in axes of the base (kg m**2 / s), instead of the
            angular velocity.
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
        velocities = angular_velocity, momentum, joints, joint_rates
        if x is not None:
            if any(value is not None for value in velocities):
                raise InputError("give a state x, or velocities and joints by name, not both")
            return super().state(x, batch)
        if angular_velocity is not None and momentum is not None:
            raise InputError("give angular_velocity= or momentum=, not both")
        q, rates = self._joint_vector(joints, "joints"), self._joint_vector(joint_rates, "joint_rates")
        name = "angular_velocity" if momentum is None else "momentum"
        given_vectors = [v for v in (angular_velocity, momentum) if v is not None]
        vector = checked_finite(given_vectors[0] if given_vectors else np.zeros(3), name)
        if vector.shape[-1:] != (3,) or vector.ndim > 2:
            raise InputError(f"{name} must have shape (3,), or (B, 3) for many states, got {vector.shape}")
        batch_shapes = [vector.shape[:-1], q.shape[:-1], rates.shape[:-1]]
        try:
            shape = jnp.broadcast_shapes(*batch_shapes)
        except ValueError:
            raise InputError(f"the arguments of a state have batches of different lengths: {batch_shapes}") from None
        vector, q, rates = (jnp.broadcast_to(v, (*shape, v.shape[-1])) for v in (vector, q, rates))
        M = self.mass_matrix(q)
        if momentum is None:
            Omega = vector
        else:
            residual = vector - jnp.einsum("...ij,...j->...i", M[..., :3, 3:], rates)
            Omega = jnp.linalg.solve(M[..., :3, :3], residual[..., None])[..., 0]
        momenta = jnp.einsum("...ij,...j->...i", M, jnp.concatenate([Omega, rates], axis=-1))
        Pi = momenta[..., :3] if momentum is None else vector
        return super().state(jnp.concatenate([Pi, q, momenta[..., 3:]], axis=-1), bool(shape))

    def _joint_vector(self, values: Mapping[str, Any] | None, argument: str) -> jax.Array:
        """Return coordinates or rates of all joints, shape (k,) or (B, k), from those that are given by name."""
        if not isinstance(values, Mapping | None):
            raise InputError(f"{argument} must be a dict by the names of bodies, got {type(values).__name__}")
        values = dict(values or {})
        names = [name for name, _, _ in self.joint_indices]
        if unknown := [name for name in values if name not in names]:
            raise InputError(f"no joint moves {', '.join(map(repr, unknown))}. The joints move {', '.join(names)}")
        columns = []
        for name, start, end in self.joint_indices:
            size, what = end - start, f"{argument}[{name!r}]"
            array = checked_finite(values.get(name, np.zeros(size)), what)
            array = array[..., None] if size == 1 and array.shape[-1:] != (1,) else array
            if array.shape[-1:] != (size,) or array.ndim > 2:
                raise InputError(f"{what} must have shape ({size},), or (B, {size}), got {array.shape}")
            columns.append(array)
        try:
            shape = jnp.broadcast_shapes(*(column.shape[:-1] for column in columns))
        except ValueError:
            raise InputError(f"the entries of {argument} have different lengths") from None
        return jnp.concatenate([jnp.broadcast_to(c, (*shape, c.shape[-1])) for c in columns], axis=-1)


@jit_unoptimised
def _mass_matrices(mechanism: ArticulatedBodies, q) -> jax.Array:
    return jax.vmap(mechanism.mass_matrix)(q)


@jit_unoptimised
def _motions(mechanism: ArticulatedBodies, x) -> Motion:
    kinetic = KineticEnergy(mechanism)
    return jax.vmap(lambda y: mechanism.motion(*kinetic.split_state(y)))(x)


def _entries(values, start: int, end: int):
    """Return some components of values, shape (..., k): shape (...) for one, (..., end - start) for more."""
    return values[..., start] if end - start == 1 else values[..., start:end]
