"""Mechanics of a tree of rigid bodies with joints of one degree of freedom: mass matrix, kinetic energy, velocities.

Everything is expressed in axes of the base, which is free, or fixed to the ground. A spatial velocity is ``V = (omega,
v)``, with v the velocity of the point of a body that coincides with the origin of the base; a spatial momentum is
(angular momentum about that origin, linear momentum). With screws S_i of the joints and inertias I_j, shape (6, 6), the
kinetic energy is ``sum_j V_j . I_j V_j / 2`` with ``V_j = V_parent + S_j q_j'`` [Featherstone, *Rigid Body Dynamics
Algorithms*, 2008, chapters 2, 6 and 7].
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..dissipation.base import Dissipation
from ..dissipation.factor import Factor
from ..functions.energy import Energy, Pullback, float64_array
from ..functions.indices import Indices
from ..tracing.programs import jit_if_traced


class Poses(NamedTuple):
    """Positions and orientations of the links, joints and bodies of a tree, in axes of the base.

    Attributes
    ----------
    rotations : array, shape (k + 1, 3, 3)
        Rotation from axes of each link to axes of the base.
    positions : array, shape (k + 1, 3)
        Origin of each link, from the origin of the base.
    joint_screws : array, shape (k, 6)
        Screw of the joint that moves each link but the base.
    body_centres : array, shape (m, 3)
        Centre of mass of each body, from the origin of the base.
    body_inertias : array, shape (m, 3, 3)
        Tensor of inertia of each body about its centre of mass.
    """

    rotations: jax.Array
    positions: jax.Array
    joint_screws: jax.Array
    body_centres: jax.Array
    body_inertias: jax.Array


class SpatialInertias(NamedTuple):
    """Spatial inertias of n bodies about the origin of the base, which map spatial velocities to momenta.

    Attributes
    ----------
    mass : array, shape (n,)
    first_moment : array, shape (n, 3)
        Mass times centre of mass.
    rotational : array, shape (n, 3, 3)
        Tensor of inertia about the origin of the base.
    """

    mass: jax.Array
    first_moment: jax.Array
    rotational: jax.Array

    def momentum(self, velocity) -> jax.Array:
        """Return the spatial momentum at a spatial velocity, both of shape (n, 6)."""
        omega, v = velocity[:, :3], velocity[:, 3:]
        angular = _matrix_vector_products(self.rotational, omega) + jnp.cross(self.first_moment, v)
        return jnp.concatenate([angular, self.mass[:, None] * v - jnp.cross(self.first_moment, omega)], axis=1)


class Motion(NamedTuple):
    """Velocities of a tree at given momenta, with the derivative of the kinetic energy by the joint coordinates.

    Attributes
    ----------
    energy : array, shape ()
        Kinetic energy.
    angular_velocity : array, shape (3,)
        Angular velocity of the base.
    joint_rates : array, shape (k,)
    joint_gradient : array, shape (k,)
        Derivative of the kinetic energy by the joint coordinates at constant momenta.
    rounding_scale : array, shape ()
        The kinetic energy is rounded to about eps times this scale.
    """

    energy: jax.Array
    angular_velocity: jax.Array
    joint_rates: jax.Array
    joint_gradient: jax.Array
    rounding_scale: jax.Array


class ArticulatedBodies(Module):
    """The mechanics of a tree of rigid bodies: link 0 is the base, and joint i moves link i + 1 against its parent.

    A link without a body stands between two joints that act at one place. The axes of all links are parallel if all
    joint coordinates are zero.

    Attributes
    ----------
    masses : array, shape (m,)
        Masses of the bodies (mass).
    centres : array, shape (m, 3)
        Centres of mass in axes of the link, from its origin (length).
    inertias : array, shape (m, 3, 3)
        Tensors of inertia about the centre of mass, in axes of the link (mass * length**2).
    places : array, shape (k, 3)
        Origin of each moved link in its parent if the joint coordinate is zero (length).
    axes : array, shape (k, 3)
        Unit vector of the axis of each joint, in axes of the parent.
    body_links : tuple of int
        Link of each body.
    parents : tuple of int
        Parent of each moved link; it has a smaller index than the link.
    slides : tuple of bool
        True for a joint that moves its link along the axis, False for one that turns it about the axis.
    is_fixed : bool
        True if link 0 is the ground, which has no body and does not move.
    """

    masses: jax.Array
    centres: jax.Array
    inertias: jax.Array
    places: jax.Array
    axes: jax.Array
    body_links: tuple[int, ...] = eqx.field(static=True)
    parents: tuple[int, ...] = eqx.field(static=True)
    slides: tuple[bool, ...] = eqx.field(static=True)
    is_fixed: bool = eqx.field(static=True, default=False)

    @property
    def n_joints(self) -> int:
        """Number of joint coordinates, k."""
        return len(self.parents)

    @property
    def first_joint_index(self) -> int:
        """Index of the first joint coordinate in a state: 3, behind the angular momentum, or 0 on the ground."""
        return 0 if self.is_fixed else 3

    # -- which joints move what: constants of the tree ----------------------------------------------------------------

    @property
    def _path_matrix(self) -> np.ndarray:
        """Boolean matrix, shape (k + 1, k), that is True if joint j is on the path from the base to link i."""
        is_on_path = np.zeros((self.n_joints + 1, self.n_joints), bool)
        for i, parent in enumerate(self.parents):
            is_on_path[i + 1] = is_on_path[parent]
            is_on_path[i + 1, i] = True
        return is_on_path

    @property
    def _bodies_moved_by_link(self) -> np.ndarray:
        """Matrix of 0 and 1, shape (k + 1, m), with 1 if body j moves with link i; all bodies move with the base."""
        links = np.array(self.body_links)
        return np.concatenate([np.ones((1, len(links))), self._path_matrix[links].T])

    @property
    def _n_base_screws(self) -> int:
        return 0 if self.is_fixed else 6

    # -- kinematics and inertia ---------------------------------------------------------------------------------------

    def poses(self, q) -> Poses:
        """Return the positions and orientations of all links, joints and bodies at joint coordinates q, shape (k,).

        The pose of each link in its parent is composed with that of the parent, then with that of the parent's parent,
        and so on with twice as many links each time, for all links at once.
        """
        slides = np.array(self.slides)[:, None]
        turns = _rotations_about_axes(self.axes, jnp.where(slides[:, 0], 0.0, q))
        strokes = jnp.where(slides, q[:, None] * self.axes, 0.0)
        rotations = jnp.concatenate([jnp.eye(3)[None], turns])
        positions = jnp.concatenate([jnp.zeros((1, 3)), self.places + strokes])
        references = np.array([0, *self.parents])  # the link in whose axes the pose of each link is known
        while references.any():
            positions = positions[references] + _matrix_vector_products(rotations[references], positions)
            rotations = rotations[references] @ rotations
            references = references[references]
        axes = _matrix_vector_products(rotations[np.array(self.parents)], self.axes)
        screws = jnp.where(
            slides,
            jnp.concatenate([jnp.zeros_like(axes), axes], axis=1),
            jnp.concatenate([axes, jnp.cross(positions[1:], axes)], axis=1),
        )
        links = np.array(self.body_links)
        R = rotations[links]
        centres, inertias = (
            positions[links] + _matrix_vector_products(R, self.centres),
            R @ self.inertias @ jnp.swapaxes(R, 1, 2),
        )
        return Poses(rotations, positions, screws, centres, inertias)

    def composite_inertias(self, poses: Poses) -> SpatialInertias:
        """Return the composite inertia of each of k + 1 links: that of all bodies that move with the link."""
        centres, masses = poses.body_centres, self.masses[:, None]
        squares = jnp.sum(centres**2, axis=1)[:, None, None] * jnp.eye(3) - centres[:, :, None] * centres[:, None, :]
        rotational = poses.body_inertias + masses[:, :, None] * squares
        inertias = jnp.concatenate([masses, masses * centres, rotational.reshape(-1, 9)], axis=1)
        sums = jnp.asarray(self._bodies_moved_by_link) @ inertias
        return SpatialInertias(sums[:, 0], sums[:, 1:4], sums[:, 4:].reshape(-1, 3, 3))

    def screws(self, poses: Poses) -> jax.Array:
        """Return the screw axes of all velocities: six of a free base, angular ones first, then one of each joint."""
        return jnp.concatenate([jnp.eye(6)[: self._n_base_screws], poses.joint_screws])

    def _inertia_matrix(self, screws, composites: SpatialInertias) -> jax.Array:
        """Return the inertia matrix H, shape (n, n), of the kinetic energy ``v . H v / 2`` of velocities v along
        screws.

        By the composite-body recursion: ``H_ij = S_j . I_i S_i`` if j is i or moves all that i moves, and I_i is the
        inertia of all bodies that i moves.
        """
        b = self._n_base_screws
        links = np.array([0] * b + list(range(1, self.n_joints + 1)))
        momenta = SpatialInertias(*(composite[links] for composite in composites)).momentum(screws)
        is_below = np.pad(self._path_matrix[1:], ((b, 0), (b, 0)))  # (i, j): screw j is i or moves all that i moves
        is_below[:, :b] = np.tri(b + self.n_joints, b, dtype=bool)
        entries = jnp.where(is_below, momenta @ screws.T, 0.0)
        return entries + jnp.where(is_below & ~np.eye(len(links), dtype=bool), entries, 0.0).T

    def _inertia_matrix_at(self, q) -> jax.Array:
        """Return :meth:`_inertia_matrix` at joint coordinates q."""
        poses = self.poses(q)
        return self._inertia_matrix(self.screws(poses), self.composite_inertias(poses))

    def mass_matrix(self, q) -> jax.Array:
        """Return the mass matrix M(q) of the kinetic energy ``(Omega, q') . M(q) (Omega, q') / 2``, shape (3 + k, 3 +
        k).

        The linear momentum is zero. M is the matrix of a free base by the composite-body recursion, with the linear
        velocity eliminated by a Schur complement, whose pivot is the total mass. On the ground M has the shape (k, k).
        """
        H = self._inertia_matrix_at(q)
        if self.is_fixed:
            return H
        velocity_indices = np.delete(np.arange(len(H)), [3, 4, 5])
        linear = H[3:6, velocity_indices]
        return H[np.ix_(velocity_indices, velocity_indices)] - linear.T @ linear / jnp.sum(self.masses)

    # -- energy and velocities of given momenta -----------------------------------------------------------------------

    def momentum_scale(self, Pi, q, p) -> jax.Array:
        """Return the magnitude of the terms of the angular momentum, at which it is rounded, shape (): ``sqrt(2 T J)``.

        T is the kinetic energy, and J the trace of the locked inertia about the origin of the base. The terms of a tree
        without angular momentum cancel.
        """
        locked_inertia = jnp.trace(self.composite_inertias(self.poses(q)).rotational[0])
        return jnp.sqrt(2.0 * self.kinetic_energy(Pi, q, p) * locked_inertia)

    def articulated_joint_inertias(self, q) -> jax.Array:
        """Return the articulated-body inertia of each joint, shape (k,): what it moves if the joints beyond are
        free."""
        H = self._inertia_matrix_at(q)
        steps = _eliminate_velocities(H, jnp.zeros(len(H)))
        return jnp.stack([step.pivot for step in steps[: self.n_joints]])[::-1]

    def kinetic_energy(self, Pi, q, p) -> jax.Array:
        """Return the kinetic energy ``(Pi, p) . M(q)^-1 (Pi, p) / 2``, a sum of squares."""
        return _kinetic_energy_from_elimination(
            _eliminate_velocities(self._inertia_matrix_at(q), self._momenta_along_screws(Pi, p))
        )

    def _momenta_along_screws(self, Pi, p) -> jax.Array:
        """Return the momenta along all screws, for an angular momentum Pi, joint momenta p and no linear momentum."""
        return p if self.is_fixed else jnp.concatenate([Pi, jnp.zeros(3), p])

    def motion(self, Pi, q, p) -> Motion:
        """Return the velocities for an angular momentum Pi and joint momenta p; see :class:`Motion`.

        On the ground Pi does not count.

        At constant momenta the kinetic energy has the derivative ``h_i . (S_i × V_i)`` by q_i, h_i the momentum of all
        bodies that joint i moves: minus its derivative at constant velocities, which is that of the screw S_i as seen
        from these bodies.

        An error dI of the inertia that a link moves changes the energy by ``-V . dI V / 2``. The entries of an inertia
        are rounded to eps of the square roots of its diagonal, before the free joints lower it.
        """
        poses, b = self.poses(q), self._n_base_screws
        composites, screws = self.composite_inertias(poses), self.screws(poses)
        # behind barriers: otherwise XLA computes both again for each of their uses
        H = jax.lax.optimization_barrier(self._inertia_matrix(screws, composites))
        steps = _eliminate_velocities(H, self._momenta_along_screws(Pi, p))
        rates = jax.lax.optimization_barrier(_velocities_from_elimination(steps))
        moves = np.concatenate([np.ones((self.n_joints + 1, b)), self._path_matrix], axis=1)
        velocities = moves @ (rates[:, None] * screws)
        momenta = self._bodies_moved_by_link[1:] @ self._body_momenta(poses, velocities[np.array(self.body_links)])
        gradient = jnp.sum(momenta * _spatial_cross_products(poses.joint_screws, velocities[1:]), axis=1)
        diagonals = [jnp.diagonal(composites.rotational, axis1=1, axis2=2), jnp.tile(composites.mass[:, None], 3)]
        scales = jnp.sum(jnp.abs(velocities) * jnp.sqrt(jnp.concatenate(diagonals, axis=1)), axis=1) ** 2
        angular_velocity = jnp.zeros(3) if self.is_fixed else rates[:3]
        return Motion(
            _kinetic_energy_from_elimination(steps), angular_velocity, rates[b:], gradient, 0.5 * jnp.sum(scales)
        )

    def _body_momenta(self, poses: Poses, velocities) -> jax.Array:
        """Return the spatial momentum of each body at its spatial velocity, both of shape (m, 6)."""
        centres, omega = poses.body_centres, velocities[:, :3]
        linear = self.masses[:, None] * (velocities[:, 3:] + jnp.cross(omega, centres))
        angular = _matrix_vector_products(poses.body_inertias, omega) + jnp.cross(centres, linear)
        return jnp.concatenate([angular, linear], axis=1)

    # -- gravity ------------------------------------------------------------------------------------------------------

    def centre_of_mass_in_base(self, poses: Poses) -> jax.Array:
        """Return the centre of mass of the tree relative to the origin of the base, shape (3,)."""
        return self.masses @ poses.body_centres / jnp.sum(self.masses)

    def weight_potential(self, q, gravity) -> jax.Array:
        """Return the potential energy ``-sum m_j g . r_j`` in a uniform field g, shape (3,), from the ground."""
        return -jnp.dot(gravity, self.masses @ self.poses(q).body_centres)

    def weight_forces(self, q, gravity) -> jax.Array:
        """Return the forces of a uniform field on the joint coordinates, shape (k,)."""
        forces = self.masses[:, None] * gravity
        return self._joint_forces_and_total_wrench(self.poses(q), forces, jnp.zeros_like(forces))[0]

    def gravity_gradient_forces(self, q, direction) -> tuple[jax.Array, jax.Array]:
        """Return the gravity-gradient torque on the tree, shape (3,), and forces on the joints, shape (k,).

        A point at rho from the centre of mass has the acceleration ``3 n (n . rho) - rho`` for a unit vector n to the
        centre of the orbit, in axes of the base, times ``G M / r**3``. The inertia of a body about its own centre of
        mass adds the torque ``3 n × I n`` [Hughes, *Spacecraft Attitude Dynamics*, 1986, 8.1].
        """
        poses, n = self.poses(q), direction
        offsets = poses.body_centres - self.centre_of_mass_in_base(poses)
        forces = self.masses[:, None] * (3.0 * (offsets @ n)[:, None] * n - offsets)
        torques = 3.0 * jnp.cross(n, poses.body_inertias @ n)
        joint_forces, total = self._joint_forces_and_total_wrench(poses, forces, torques)
        return total[:3], joint_forces  # the total force is zero, so the torque is the same about every point

    def _joint_forces_and_total_wrench(self, poses: Poses, forces, torques) -> tuple[jax.Array, jax.Array]:
        """Sum forces and torques on the bodies; return the joint forces, shape (k,), and the total wrench, shape (6,).

        Each force acts in the centre of mass of its body; both have the shape (m, 3). The wrench is (torque about the
        origin of the base, force).
        """
        wrenches = jnp.concatenate([torques + jnp.cross(poses.body_centres, forces), forces], axis=1)
        sums = self._bodies_moved_by_link @ wrenches
        return jnp.sum(poses.joint_screws * sums[1:], axis=1), sums[0]


class _Elimination(NamedTuple):
    """One step of the elimination of velocities from the kinetic energy at given momenta.

    Attributes
    ----------
    column : array, shape (j,)
        Entries of the matrix that couple it with the velocities before it.
    pivot : array, shape ()
        Its entry on the diagonal.
    momentum : array, shape ()
        Its momentum, less the parts of the velocities behind it.
    """

    column: jax.Array
    pivot: jax.Array
    momentum: jax.Array


def _eliminate_velocities(H, momenta) -> list[_Elimination]:
    """Eliminate the velocities v from ``v . H v / 2 - momenta . v``, from the leaves of the tree to the base.

    In this order the pivots are those of the articulated-body recursion, and none is the small difference of large
    numbers because of bodies that lie nearer to the base.
    """
    steps: list[_Elimination] = []
    for last_index in reversed(range(len(H))):
        step = _Elimination(H[:last_index, last_index], H[last_index, last_index], momenta[last_index])
        steps.append(step)
        H = H[:last_index, :last_index] - jnp.outer(step.column, step.column / step.pivot)
        momenta = momenta[:last_index] - step.column * (step.momentum / step.pivot)
    return steps


def _velocities_from_elimination(eliminations: list[_Elimination]) -> jax.Array:
    """Return the velocities, shape (n,), that belong to the momenta, by back-substitution."""
    v = jnp.zeros(0)
    for step in reversed(eliminations):
        v = jnp.concatenate([v, ((step.momentum - jnp.sum(step.column * v)) / step.pivot)[None]])
    return v


def _kinetic_energy_from_elimination(eliminations: list[_Elimination]) -> jax.Array:
    """Return the kinetic energy as a sum of squares, one for each eliminated velocity."""
    return 0.5 * jnp.sum(jnp.stack([step.momentum**2 / step.pivot for step in eliminations]))


def _matrix_vector_products(matrices, vectors) -> jax.Array:
    """Return the products of n matrices, shape (n, 3, 3), with n vectors, shape (n, 3)."""
    return jnp.sum(matrices * vectors[:, None, :], axis=2)


def _rotations_about_axes(axes, angles) -> jax.Array:
    """Return rotation matrices, shape (n, 3, 3), by angles about unit vectors, from Rodrigues' formula."""
    s, half = jnp.sin(angles)[:, None, None], jnp.sin(0.5 * angles)[:, None, None]
    # 1 - cos as a square, which keeps its digits at small angles
    outer_products = axes[:, :, None] * axes[:, None, :]
    return (1.0 - 2.0 * half**2) * jnp.eye(3) + s * _cross_matrices(axes) + 2.0 * half**2 * outer_products


def _cross_matrices(vectors) -> jax.Array:
    """Return the matrices of ``v ×``, shape (n, 3, 3), of vectors of shape (n, 3)."""
    return jnp.cross(vectors[:, None, :], jnp.eye(3)).swapaxes(1, 2)


def _spatial_cross_products(V, W) -> jax.Array:
    """Return the spatial cross products ``V × W``: the rates of W fixed in bodies that move with V, shape (n, 6)."""
    linear = jnp.cross(V[:, :3], W[:, 3:]) + jnp.cross(V[:, 3:], W[:, :3])
    return jnp.concatenate([jnp.cross(V[:, :3], W[:, :3]), linear], axis=1)


class KineticEnergy(Energy):
    """The kinetic energy ``(Pi, p) . M(q)^-1 (Pi, p) / 2`` of a tree with the state (Pi, q, p).

    The state of a tree on the ground is (q, p), without the angular momentum.

    Attributes
    ----------
    mechanism : ArticulatedBodies
    """

    mechanism: ArticulatedBodies

    def split_state(self, x) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Split a state into angular momentum, joint coordinates and joint momenta, shapes (3,), (k,) and (k,).

        The angular momentum is zero if the base is the ground.
        """
        k, first_joint_index = self.mechanism.n_joints, self.mechanism.first_joint_index
        Pi = x[:3] if first_joint_index else jnp.zeros(3)
        return Pi, x[first_joint_index : first_joint_index + k], x[first_joint_index + k : first_joint_index + 2 * k]

    def momentum_scale(self, x) -> jax.Array:
        """Return the magnitude of the terms of the angular momentum at a state, shape ()."""
        return self.mechanism.momentum_scale(*self.split_state(x))

    def value(self, x) -> jax.Array:
        return _kinetic_energy(self, x)

    def gradient(self, x) -> jax.Array:
        return _kinetic_gradient(self, float64_array(x))

    def rounding_scale(self, x) -> jax.Array:
        return jax.lax.stop_gradient(_kinetic_rounding_scale(self, x))


@jit_if_traced
def _kinetic_energy(kinetic: KineticEnergy, x) -> jax.Array:
    return kinetic.mechanism.kinetic_energy(*kinetic.split_state(x))


@jit_if_traced
def _kinetic_gradient(kinetic: KineticEnergy, x) -> jax.Array:
    motion = kinetic.mechanism.motion(*kinetic.split_state(x))
    velocity = [] if kinetic.mechanism.is_fixed else [motion.angular_velocity]
    return jnp.concatenate([*velocity, motion.joint_gradient, motion.joint_rates])


@jit_if_traced
def _kinetic_rounding_scale(kinetic: KineticEnergy, x) -> jax.Array:
    return kinetic.mechanism.motion(*kinetic.split_state(x)).rounding_scale


class WeightPotential(Energy):
    """The potential energy ``-sum m_j g . r_j(q)`` of a tree on the ground, with the state (q, p).

    Attributes
    ----------
    mechanism : ArticulatedBodies
    gravity : array, shape (3,)
        g, in axes of the ground (length / time**2).
    """

    mechanism: ArticulatedBodies
    gravity: jax.Array

    def value(self, x) -> jax.Array:
        return _weight_potential(self, x)

    def gradient(self, x) -> jax.Array:
        return _weight_gradient(self, float64_array(x))

    def rounding_scale(self, x) -> jax.Array:
        """Return the sum of the weights times the lengths of the chains that carry them."""
        return jax.lax.stop_gradient(_weight_potential_rounding_scale(self, x))


@jit_if_traced
def _weight_potential(potential: WeightPotential, x) -> jax.Array:
    return potential.mechanism.weight_potential(x[: potential.mechanism.n_joints], potential.gravity)


@jit_if_traced
def _weight_potential_rounding_scale(potential: WeightPotential, x) -> jax.Array:
    mechanism, q = potential.mechanism, x[: potential.mechanism.n_joints]
    strokes = jnp.where(np.array(mechanism.slides), jnp.abs(q), 0.0)
    lengths = mechanism._path_matrix @ (jnp.linalg.norm(mechanism.places, axis=1) + strokes)
    arms = lengths[np.array(mechanism.body_links)] + jnp.linalg.norm(mechanism.centres, axis=1)
    return jnp.linalg.norm(potential.gravity) * jnp.dot(mechanism.masses, arms)


@jit_if_traced
def _weight_gradient(potential: WeightPotential, x) -> jax.Array:
    k = potential.mechanism.n_joints
    return jnp.concatenate([-potential.mechanism.weight_forces(x[:k], potential.gravity), jnp.zeros(k)])


class SquaredMomentum(Pullback):
    """The squared angular momentum of a tree, a Casimir, with the rounding error of the terms of the momentum.

    Attributes
    ----------
    kinetic : KineticEnergy
    """

    kinetic: KineticEnergy

    def __init__(self, term: Energy, kinetic: KineticEnergy):
        super().__init__(term, range(3))
        self.kinetic = kinetic

    def sensitivity(self, x) -> jax.Array:
        return jnp.maximum(super().sensitivity(x), self.kinetic.momentum_scale(x) ** 2)


class JointSprings(Energy):
    """The energy ``sum k_i (q_i - r_i)**2 / 2`` of springs in the joints.

    Attributes
    ----------
    stiffness : array, shape (k,)
        Torque per angle of hinges, force per length of sliders.
    rest : array, shape (k,)
        Joint coordinates r at which the springs are relaxed.
    first_joint_index : int
        Index of the first joint coordinate in a state.
    """

    stiffness: jax.Array
    rest: jax.Array
    first_joint_index: int = eqx.field(static=True, default=3)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.sum(self.stiffness * self._deflections(x) ** 2)

    def gradient(self, x) -> jax.Array:
        force = self.stiffness * self._deflections(x)
        return jnp.concatenate([jnp.zeros(self.first_joint_index), force, jnp.zeros_like(force)])

    def _deflections(self, x) -> jax.Array:
        first_joint_index = self.first_joint_index
        return x[first_joint_index : first_joint_index + self.stiffness.shape[0]] - self.rest


class JointDamping(Dissipation):
    """Viscous dampers in the joints, ``p_i' = -c_i q_i'``; they conserve the angular momentum.

    Attributes
    ----------
    coefficients : array, shape (k,), >= 0
        c: torque per angular velocity of hinges, force per velocity of sliders.
    first_joint_index : int
        Index of the first joint coordinate in a state.
    """

    coefficients: jax.Array
    first_joint_index: int = eqx.field(static=True, default=3)

    energy_law = "nonincreasing"
    entropy_law = None
    needs_entropy = False
    preserves_casimirs = True

    @property
    def heated_bath_index(self):
        return Indices(0)

    @property
    def _momenta_along_screws(self) -> slice:
        """Slice of the joint momenta in a state."""
        k = self.coefficients.shape[0]
        return slice(self.first_joint_index + k, self.first_joint_index + 2 * k)

    def force(self, system, x, dH, dS, dL):
        return (
            jnp.zeros_like(dH).at[self._momenta_along_screws].set(-self.coefficients * dH[self._momenta_along_screws])
        )

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        return jnp.zeros_like(dH)

    def factor(self, system, x, dH, dL):
        root, momenta = jnp.sqrt(self.coefficients), self._momenta_along_screws
        momentum_rates = lambda w: jnp.zeros_like(x).at[momenta].set(root * w)  # noqa: E731
        return Factor(root.shape[0], momentum_rates, True, added_attitude_velocity=lambda w: jnp.zeros_like(x))
