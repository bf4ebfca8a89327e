"""Joint coordinates, rates and motors of trees of rigid bodies, by the names of the bodies."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings
from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.energy import Energy, Pullback, Sum
from ..systems.base import System
from ..systems.interface import BodyKinematics, EngineHints
from ..tracing.programs import jit_unoptimised
from .articulated_bodies import ArticulatedBodies, JointDamping, JointSprings, KineticEnergy, Motion
from .parameters import checked_finite

MAX_UNROLLED_NEWTON_JOINTS = 4
"""Largest number of joint coordinates for which the compiled engine is chosen by itself for implicit methods.

Their steps for larger trees are compiled in seconds too, but Newton's method, which one may need later, takes minutes.
"""

JointRange = tuple[str, int, int]
"""Name of a body that has a joint, and the first and the last but one index of its coordinates in a state."""


class JointMotors(Module):
    """The torques of the motors in the joints of a tree, as a function of time.

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

    def __str__(self) -> str:
        return f"motors of {', '.join(self.names)}"


class TreeSystem(System):
    """Base class of the equations of motion of a tree of rigid bodies, free or on the ground."""

    @property
    @abstractmethod
    def joint_ranges(self) -> tuple[JointRange, ...]:
        """Name of each body that has a joint, and the start and stop index of the joint's coordinates in a state."""

    @property
    def mechanism(self) -> ArticulatedBodies:
        """The bodies and joints, with their parameters."""
        term: Energy = self.drop_baths().energy.terms[0]
        kinetic = term.term if isinstance(term, Pullback) else term
        assert isinstance(kinetic, KineticEnergy)
        return kinetic.mechanism

    @property
    def engine_hints(self) -> EngineHints:
        return super().engine_hints._replace(can_unroll_newton=self.mechanism.n_joints <= MAX_UNROLLED_NEWTON_JOINTS)

    @with_library_settings
    def mass_matrix(self, q) -> jax.Array:
        """Return the mass matrix M(q) of the kinetic energy ``(Omega, q') . M (Omega, q') / 2``, or ``q' . M q' / 2``.

        Parameters
        ----------
        q : array, shape (..., k)
            Joint coordinates (rad or m).

        Returns
        -------
        array, shape (..., 3 + k, 3 + k), or (..., k, k) of a tree on the ground
        """
        q = jnp.asarray(q, dtype=jnp.float64)
        if q.shape[-1:] != (self.mechanism.n_joints,):
            raise InputError(f"q must have shape (..., {self.mechanism.n_joints}), got {q.shape}")
        matrices = _mass_matrices(self.mechanism, q.reshape(-1, q.shape[-1]))
        return matrices.reshape(*q.shape[:-1], *matrices.shape[1:])

    def joint_rates(self, x) -> dict[str, jax.Array]:
        """Return the rates of the joint coordinates by the name of the body, at states x, shape (..., n).

        Each has the shape (...), or (..., 2) for a universal joint (rad/s or m/s).
        """
        rates, first_joint_index = self._motion(x).joint_rates, self.mechanism.first_joint_index
        return {
            name: _entries_of_joint(rates, start - first_joint_index, end - first_joint_index)
            for name, start, end in self.joint_ranges
        }

    @property
    def body_kinematics(self) -> BodyKinematics:
        quantities = super().body_kinematics
        if not self.joint_ranges:
            return quantities
        start, k = self.joint_ranges[0][1] + self.mechanism.n_joints, self.mechanism.n_joints
        velocities = {**quantities.velocities, "joint_rates": lambda x: self.energy.gradient(x)[start : start + k]}
        return quantities._replace(velocities=velocities, joint_ranges=self.joint_ranges)

    @with_library_settings
    def _motion(self, x) -> Motion:
        x = self.state(x, batch=True)
        flat_motion = _motions(self.mechanism, x.reshape(-1, self.dim))
        return Motion(*(array.reshape(*x.shape[:-1], *array.shape[1:]) for array in flat_motion))

    def _joint_vector_from_names(
        self, values: Mapping[str, Any] | None, argument_name: str, degrees: bool
    ) -> jax.Array:
        """Return coordinates or rates of all joints, shape (k,) or (B, k), from values by body name; others are 0.

        Angles may be given in degrees; the result has radians. Displacements of sliders have one unit only.
        """
        if not isinstance(values, Mapping | None):
            raise InputError(f"{argument_name} must be a dict by the names of bodies, got {type(values).__name__}")
        values = dict(values or {})
        names = [name for name, _, _ in self.joint_ranges]
        if unknown := [name for name in values if name not in names]:
            raise InputError(f"no joint moves {', '.join(map(repr, unknown))}. The joints move {', '.join(names)}")
        columns = []
        for name, start, end in self.joint_ranges:
            n_coordinates, argument_text = end - start, f"{argument_name}[{name!r}]"
            array = checked_finite(values.get(name, np.zeros(n_coordinates)), argument_text)
            array = array[..., None] if n_coordinates == 1 and array.shape[-1:] != (1,) else array
            if array.shape[-1:] != (n_coordinates,) or array.ndim > 2:
                raise InputError(
                    f"{argument_text} must have shape ({n_coordinates},), or (B, {n_coordinates}), got {array.shape}"
                )
            columns.append(array)
        try:
            shape = jnp.broadcast_shapes(*(column.shape[:-1] for column in columns))
        except ValueError:
            raise InputError(f"the entries of {argument_name} have different lengths") from None
        vector = jnp.concatenate([jnp.broadcast_to(c, (*shape, c.shape[-1])) for c in columns], axis=-1)
        return jnp.where(np.array(self.mechanism.slides), vector, jnp.deg2rad(vector)) if degrees else vector


def checked_vectors(value, name: str) -> jax.Array:
    """Return finite vectors as an array of shape (3,) or (B, 3), one for each state."""
    vector = checked_finite(value, name)
    if vector.shape[-1:] != (3,) or vector.ndim > 2:
        raise InputError(f"{name} must have shape (3,), or (B, 3) for many states, got {vector.shape}")
    return vector


def kinetic_and_spring_terms(mechanism: ArticulatedBodies, springs: JointSprings) -> list[Energy]:
    """Return the terms of the energy of a tree: kinetic energy, and springs if there are any."""
    has_springs = is_traced(springs.stiffness) or np.asarray(springs.stiffness).any()
    return [KineticEnergy(mechanism), *([springs] if has_springs else [])]


def make_joint_damping(coefficients, first_joint_index: int) -> JointDamping | None:
    """Return the dissipation of the dampers in the joints; None if all coefficients are 0."""
    is_damped = is_traced(coefficients) or np.asarray(coefficients).any()
    return JointDamping(coefficients, first_joint_index) if is_damped else None


def sum_of_terms(terms: list[Energy]) -> Energy:
    """Return the sum of the terms of an energy as one energy."""
    return terms[0] if len(terms) == 1 else Sum(tuple(terms))


@jit_unoptimised
def _mass_matrices(mechanism: ArticulatedBodies, q) -> jax.Array:
    return jax.vmap(mechanism.mass_matrix)(q)


@jit_unoptimised
def _motions(mechanism: ArticulatedBodies, x) -> Motion:
    kinetic = KineticEnergy(mechanism)
    return jax.vmap(lambda y: mechanism.motion_from_momenta(*kinetic.split_state(y)))(x)


def _entries_of_joint(values, start: int, end: int):
    """Return the entries of one joint, from ``start`` to ``end``, of values of shape (..., k); one entry without its
    axis."""
    return values[..., start] if end - start == 1 else values[..., start:end]
