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

from manifolds._pytree_module import Module

from ..dissipation.base import Dissipation
from ..dissipation.factor import Factor
from ..functions.energy import Energy, Pullback, float64_array
from ..functions.indices import Indices
from ..tracing.programs import subprogram


class Poses(NamedTuple):
    """Rotations and positions of the links of a tree, in axes of the base.

    Attributes
    ----------
    rotations : list of array, shape (3, 3)
        Rotation from axes of each link to axes of the base.
    positions : list of array, shape (3,)
        Origin of each link, from the origin of the base.
    screws : list of array, shape (6,)
        Screw of the joint that moves each link but the base.
    """

    rotations: list[jax.Array]
    positions: list[jax.Array]
    screws: list[jax.Array]


class Motion(NamedTuple):
    """Velocities of a tree for given momenta, with the forces of the kinetic energy.

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
    """A tree of rigid bodies: link 0 is the base, and joint i moves link i + 1 against its parent.

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

    def poses(self, q) -> Poses:
        """Return rotations and positions of all links and the screws of the joints, for joint coordinates q."""
        rotations, positions, screws = [jnp.eye(3)], [jnp.zeros(3)], []
        for i, (parent, slides) in enumerate(zip(self.parents, self.slides, strict=True)):
            R, axis = rotations[parent], rotations[parent] @ self.axes[i]
            position = positions[parent] + R @ self.places[i]
            if slides:
                screws.append(jnp.concatenate([jnp.zeros(3), axis]))
                position = position + q[i] * axis
            else:
                screws.append(jnp.concatenate([axis, jnp.cross(position, axis)]))
                R = R @ _rotation(self.axes[i], q[i])
            rotations.append(R)
            positions.append(position)
        return Poses(rotations, positions, screws)

    def spatial_inertias(self, poses: Poses) -> list[jax.Array]:
        """Return the spatial inertia of each link, shape (6, 6); zero for a link without a body."""
        inertias = [jnp.zeros((6, 6))] * (self.n_joints + 1)
        for body, link in enumerate(self.body_links):
            R, mass = poses.rotations[link], self.masses[body]
            centre = _cross_matrix(poses.positions[link] + R @ self.centres[body])
            coupling = mass * centre
            rotational = R @ self.inertias[body] @ R.T - coupling @ centre
            inertias[link] = jnp.block([[rotational, coupling], [-coupling, mass * jnp.eye(3)]])
        return inertias

    def mass_matrix(self, q) -> jax.Array:
        """Return M(q), shape (3 + k, 3 + k), for which the kinetic energy is ``(Omega, q') . M(q) (Omega, q') / 2``.

        The linear momentum is zero. M is the matrix of a free base by the composite-body recursion, with the linear
        velocity eliminated by a Schur complement, whose pivot is the total mass. On the ground M has the shape (k, k).
        """
        k, poses = self.n_joints, self.poses(q)
        composites = self.spatial_inertias(poses)
        base_columns, M = [jnp.zeros(6)] * k, jnp.zeros((k, k))
        for i in reversed(range(k)):
            momentum = composites[i + 1] @ poses.screws[i]
            ancestor = i
            while ancestor >= 0:
                entry = jnp.dot(poses.screws[ancestor], momentum)
                M = M.at[i, ancestor].set(entry).at[ancestor, i].set(entry)
                ancestor = self.parents[ancestor] - 1
            base_columns[i] = momentum
            composites[self.parents[i]] += composites[i + 1]
        if self.is_fixed:
            return M
        columns = jnp.stack(base_columns, axis=1)
        locked = composites[0]
        angular = jnp.concatenate([locked[:3, :3], columns[:3]], axis=1)
        joints = jnp.concatenate([columns[:3].T, M], axis=1)
        linear = jnp.concatenate([locked[3:, :3], columns[3:]], axis=1)
        return jnp.concatenate([angular, joints]) - linear.T @ linear / jnp.sum(self.masses)

    def momentum_scale(self, Pi, q, p) -> jax.Array:
        """Return the size of the terms whose sum is the angular momentum, shape (): ``sqrt(2 T J)``.

        T is the kinetic energy, and J the trace of the locked inertia about the origin of the base. The terms of a tree
        without angular momentum cancel.
        """
        inertias = self.spatial_inertias(self.poses(q))
        locked = sum(jnp.trace(inertia[:3, :3]) for inertia in inertias)
        return jnp.sqrt(2.0 * self.kinetic_energy(Pi, q, p) * locked)

    def pivots(self, q) -> jax.Array:
        """Return the inertia that each joint moves if all joints beyond it are free, shape (k,)."""
        return jnp.stack([joint.pivot for joint in self._eliminate(q, jnp.zeros(3), jnp.zeros(self.n_joints))[1]])

    def kinetic_energy(self, Pi, q, p) -> jax.Array:
        """Return the kinetic energy ``(Pi, p) . M(q)^-1 (Pi, p) / 2`` by the articulated-body recursion, O(k)."""
        _, joints, base = self._eliminate(q, Pi, p)
        return _sum_of_squares(joints, base)

    def motion(self, Pi, q, p) -> Motion:
        """Return the velocities for an angular momentum Pi and joint momenta p, O(k); see :class:`Motion`.

        On the ground Pi does not count.

        At constant momenta the kinetic energy has the derivative ``h_i . (S_i × V_i)`` by q_i, h_i the momentum of all
        bodies that joint i moves: minus its derivative at constant velocities, which is that of the screw S_i as seen
        from these bodies.

        An error dI of the inertia that a link moves changes the energy by ``-V . dI V / 2``. The entries of an inertia
        are rounded to eps of the square roots of its diagonal, before the free joints lower it.
        """
        poses, joints, base = self._eliminate(q, Pi, p)
        V = _base_velocity(base) if base else jnp.zeros(6)
        velocities, rates = [V], []
        for joint, parent, screw in zip(joints, self.parents, poses.screws, strict=True):
            rate = (joint.impulse - jnp.dot(joint.column, velocities[parent])) / joint.pivot
            rates.append(rate)
            velocities.append(velocities[parent] + rate * screw)
        inertias = self.spatial_inertias(poses)
        momenta = [inertia @ velocity for inertia, velocity in zip(inertias, velocities, strict=True)]
        gradient = [jnp.zeros(())] * self.n_joints
        for i in reversed(range(self.n_joints)):
            gradient[i] = jnp.dot(momenta[i + 1], _motion_cross(poses.screws[i], velocities[i + 1]))
            momenta[self.parents[i]] += momenta[i + 1]
        diagonals = [jnp.diagonal(inertia) for inertia in inertias]
        for i in reversed(range(self.n_joints)):
            diagonals[self.parents[i]] += diagonals[i + 1]
        scales = [jnp.sum(jnp.abs(v) * jnp.sqrt(d)) ** 2 for v, d in zip(velocities, diagonals, strict=True)]
        energy, rounding_scale = _sum_of_squares(joints, base), 0.5 * jnp.sum(jnp.stack(scales))
        return Motion(energy, V[:3], jnp.stack(rates), jnp.stack(gradient), rounding_scale)

    def _eliminate(self, q, Pi, p) -> tuple[Poses, list[_Elimination], list[_Elimination]]:
        """Eliminate the joint rates from the leaves to the base, then the velocity of the base.

        ``T(V, q') - p . q'`` is minimal at the rates ``q_i' = (u_i - U_i . V_parent) / D_i``, and the rest of the tree
        then sees the articulated inertia ``I - U U^T / D`` and the bias ``U u / D``. The linear momentum is zero, so
        the angular momentum is the same about every point.
        """
        poses = self.poses(q)
        inertias = self.spatial_inertias(poses)
        biases = [jnp.zeros(6)] * (self.n_joints + 1)
        joints: list[_Elimination] = []
        for i in reversed(range(self.n_joints)):
            joint = _Elimination.from_inertia(inertias[i + 1], biases[i + 1], poses.screws[i], p[i])
            joints.append(joint)
            inertias[self.parents[i]] += joint.reduced_inertia(inertias[i + 1])
            biases[self.parents[i]] += joint.bias(biases[i + 1])
        base = [] if self.is_fixed else _eliminate_base(inertias[0], biases[0], Pi)
        return poses, joints[::-1], base

    # -- gravity ------------------------------------------------------------------------------------------------------

    def body_centres(self, poses: Poses) -> list[jax.Array]:
        """Return the centre of mass of each body, from the origin of the base, shape (3,) each."""
        links = zip(self.body_links, self.centres, strict=True)
        return [poses.positions[link] + poses.rotations[link] @ centre for link, centre in links]

    def common_centre(self, poses: Poses) -> jax.Array:
        """Return the centre of mass of the whole, from the origin of the base, shape (3,)."""
        return self.masses @ jnp.stack(self.body_centres(poses)) / jnp.sum(self.masses)

    def weight_potential(self, q, gravity) -> jax.Array:
        """Return the potential energy ``-sum m_j g . r_j`` in a uniform field g, shape (3,), from the ground."""
        return -jnp.dot(gravity, self.masses @ jnp.stack(self.body_centres(self.poses(q))))

    def weight_forces(self, q, gravity) -> jax.Array:
        """Return the forces of a uniform field on the joint coordinates, shape (k,)."""
        poses = self.poses(q)
        forces = [mass * gravity for mass in self.masses]
        return self._collect_wrenches(poses, forces, [jnp.zeros(3)] * len(forces))[0]

    def tidal_forces(self, q, direction) -> tuple[jax.Array, jax.Array]:
        """Return the torque on the whole, shape (3,), and the joint forces, shape (k,), in a gradient of gravity.

        A point at rho from the centre of mass has the acceleration ``3 n (n . rho) - rho`` for a unit vector n to the
        centre of the orbit, in axes of the base, times ``G M / r**3``. The inertia of a body about its own centre of
        mass adds the torque ``3 n × I n`` [Hughes, *Spacecraft Attitude Dynamics*, 1986, 8.1].
        """
        poses = self.poses(q)
        origin, n = self.common_centre(poses), direction
        forces, torques = [], []
        for body, (link, centre) in enumerate(zip(self.body_links, self.body_centres(poses), strict=True)):
            R, offset = poses.rotations[link], centre - origin
            forces.append(self.masses[body] * (3.0 * jnp.dot(n, offset) * n - offset))
            torques.append(3.0 * jnp.cross(n, R @ (self.inertias[body] @ (R.T @ n))))
        joint_forces, total = self._collect_wrenches(poses, forces, torques)
        return total[:3], joint_forces  # the total force is zero, so the torque is the same about every point

    def _collect_wrenches(self, poses: Poses, forces: list, torques: list) -> tuple[jax.Array, jax.Array]:
        """Return the joint forces, shape (k,), and the total wrench, shape (6,), of forces and torques on the bodies.

        Each force acts in the centre of mass of its body. The wrench is (torque about the origin of the base, force).
        """
        wrenches = [jnp.zeros(6)] * (self.n_joints + 1)
        for link, centre, force, torque in zip(self.body_links, self.body_centres(poses), forces, torques, strict=True):
            wrenches[link] = jnp.concatenate([torque + jnp.cross(centre, force), force])
        joint_forces = [jnp.zeros(())] * self.n_joints
        for i in reversed(range(self.n_joints)):
            joint_forces[i] = jnp.dot(poses.screws[i], wrenches[i + 1])
            wrenches[self.parents[i]] += wrenches[i + 1]
        return jnp.stack(joint_forces), wrenches[0]


class _Elimination(NamedTuple):
    """One velocity, eliminated from a quadratic function of spatial velocities.

    Attributes
    ----------
    column : array, shape (6,)
        U, the articulated inertia times the screw.
    pivot : array, shape ()
        D, the screw times U.
    impulse : array, shape ()
        u, the momentum of the joint less the bias along the screw.
    """

    column: jax.Array
    pivot: jax.Array
    impulse: jax.Array

    @classmethod
    def from_inertia(cls, inertia, bias, screw, momentum) -> _Elimination:
        """Return the elimination of the velocity along a screw that has a given momentum."""
        column = inertia @ screw
        return cls(column, jnp.dot(screw, column), momentum - jnp.dot(screw, bias))

    def reduced_inertia(self, inertia) -> jax.Array:
        """Return the articulated inertia without the eliminated velocity, shape (6, 6)."""
        return inertia - jnp.outer(self.column, self.column / self.pivot)

    def bias(self, bias) -> jax.Array:
        """Return the bias that the rest of the tree sees, shape (6,)."""
        return bias + self.column * (self.impulse / self.pivot)


def _eliminate_base(inertia, bias, Pi) -> list[_Elimination]:
    """Eliminate the velocity of a free base, without linear momentum: the translations first.

    The column of each step has the entries of the velocities that are eliminated after it.
    """
    A, b = jnp.roll(inertia, 3, axis=(0, 1)), jnp.roll(bias, 3)
    steps: list[_Elimination] = []
    for momentum in [0.0, 0.0, 0.0, *Pi]:
        step = _Elimination(A[1:, 0], A[0, 0], momentum - b[0])
        steps.append(step)
        A, b = step.reduced_inertia(A[1:, 1:]), step.bias(b[1:])
    return steps


def _base_velocity(steps: list[_Elimination]) -> jax.Array:
    """Return the velocity of the base, shape (6,), from the steps of :func:`_eliminate_base`."""
    V = jnp.zeros(0)
    for step in reversed(steps):
        V = jnp.concatenate([((step.impulse - jnp.dot(step.column, V)) / step.pivot)[None], V])
    return jnp.roll(V, 3)


def _sum_of_squares(joints: list[_Elimination], base: list[_Elimination]) -> jax.Array:
    """Return the kinetic energy, a sum of squares: one for each eliminated velocity."""
    return 0.5 * jnp.sum(jnp.stack([step.impulse**2 / step.pivot for step in [*joints, *base]]))


def _cross_matrix(v) -> jax.Array:
    """Return the matrix of ``v ×``, shape (3, 3)."""
    zero = jnp.zeros_like(v[0])
    return jnp.array([[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]])


def _rotation(axis, angle) -> jax.Array:
    """Return the rotation by an angle about a unit vector, shape (3, 3), by Rodrigues' formula."""
    s, half = jnp.sin(angle), jnp.sin(0.5 * angle)
    # 1 - cos as a square, which keeps its digits at small angles
    return (1.0 - 2.0 * half**2) * jnp.eye(3) + s * _cross_matrix(axis) + 2.0 * half**2 * jnp.outer(axis, axis)


def _motion_cross(V, W) -> jax.Array:
    """Return the rate of a spatial velocity W that is fixed in a body which moves with V, shape (6,)."""
    return jnp.concatenate([jnp.cross(V[:3], W[:3]), jnp.cross(V[:3], W[3:]) + jnp.cross(V[3:], W[:3])])


class KineticEnergy(Energy):
    """The kinetic energy ``(Pi, p) . M(q)^-1 (Pi, p) / 2`` of a tree with the state (Pi, q, p).

    The state of a tree on the ground is (q, p), without the angular momentum.

    Attributes
    ----------
    mechanism : ArticulatedBodies
    """

    mechanism: ArticulatedBodies

    def split_state(self, x) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return angular momentum, joint coordinates and joint momenta, shapes (3,), (k,) and (k,).

        The angular momentum is zero if the base is the ground.
        """
        k, first = self.mechanism.n_joints, self.mechanism.first_joint_index
        Pi = x[:3] if first else jnp.zeros(3)
        return Pi, x[first : first + k], x[first + k : first + 2 * k]

    def momentum_scale(self, x) -> jax.Array:
        """Return :meth:`ArticulatedBodies.momentum_scale` of a state."""
        return self.mechanism.momentum_scale(*self.split_state(x))

    def value(self, x) -> jax.Array:
        return _kinetic_energy(self, x)

    def gradient(self, x) -> jax.Array:
        return _kinetic_gradient(self, float64_array(x))

    def rounding_scale(self, x) -> jax.Array:
        return jax.lax.stop_gradient(_kinetic_rounding_scale(self, x))


@subprogram
def _kinetic_energy(kinetic: KineticEnergy, x) -> jax.Array:
    return kinetic.mechanism.kinetic_energy(*kinetic.split_state(x))


@subprogram
def _kinetic_gradient(kinetic: KineticEnergy, x) -> jax.Array:
    motion = kinetic.mechanism.motion(*kinetic.split_state(x))
    velocity = [] if kinetic.mechanism.is_fixed else [motion.angular_velocity]
    return jnp.concatenate([*velocity, motion.joint_gradient, motion.joint_rates])


@subprogram
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
        return jax.lax.stop_gradient(_weight_rounding_scale(self, x))


@subprogram
def _weight_potential(weight: WeightPotential, x) -> jax.Array:
    return weight.mechanism.weight_potential(x[: weight.mechanism.n_joints], weight.gravity)


@subprogram
def _weight_rounding_scale(weight: WeightPotential, x) -> jax.Array:
    mechanism, q = weight.mechanism, x[: weight.mechanism.n_joints]
    lengths = [jnp.zeros(())]
    for i, (parent, slides) in enumerate(zip(mechanism.parents, mechanism.slides, strict=True)):
        stroke = jnp.abs(q[i]) if slides else jnp.zeros(())
        lengths.append(lengths[parent] + jnp.linalg.norm(mechanism.places[i]) + stroke)
    arms = jnp.stack([lengths[link] for link in mechanism.body_links]) + jnp.linalg.norm(mechanism.centres, axis=1)
    return jnp.linalg.norm(weight.gravity) * jnp.dot(mechanism.masses, arms)


@subprogram
def _weight_gradient(weight: WeightPotential, x) -> jax.Array:
    k = weight.mechanism.n_joints
    return jnp.concatenate([-weight.mechanism.weight_forces(x[:k], weight.gravity), jnp.zeros(k)])


class SquaredMomentum(Pullback):
    """The squared angular momentum of a tree, a Casimir, whose rounding is that of the terms of the momentum.

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
        first = self.first_joint_index
        return x[first : first + self.stiffness.shape[0]] - self.rest


class JointDamping(Dissipation):
    """Viscous dampers in the joints, ``p_i' = -c_i q_i'``; they change no momentum of the whole.

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
    def _momenta(self) -> slice:
        """Range of the joint momenta in a state."""
        k = self.coefficients.shape[0]
        return slice(self.first_joint_index + k, self.first_joint_index + 2 * k)

    def force(self, system, x, dH, dS, dL):
        return jnp.zeros_like(dH).at[self._momenta].set(-self.coefficients * dH[self._momenta])

    def velocity(self, system, x, dH, dS, dL):
        return jnp.zeros_like(dH)

    def factor(self, system, x, dH, dL):
        root, momenta = jnp.sqrt(self.coefficients), self._momenta
        momentum_rates = lambda w: jnp.zeros_like(x).at[momenta].set(root * w)  # noqa: E731
        return Factor(root.shape[0], momentum_rates, True, velocity=lambda w: jnp.zeros_like(x))
