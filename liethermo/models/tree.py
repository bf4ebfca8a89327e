"""Trees of jointed rigid bodies, which build :class:`.jointed_bodies.JointedBodies`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._class_members import ListedType

from ..errors import FunctionError, InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers
from ..systems import HeatBaths
from ..tracing.programs import jit_unoptimised
from ..tracing.short_form import join_first_items
from .articulated_bodies import ArticulatedBodies, JointSprings
from .bodies_on_ground import BodiesOnGround
from .inertia import INEQUALITY_RTOL, are_symmetric_to_rounding, satisfies_triangle_inequalities
from .joint_states import JointMotors, JointRange
from .jointed_bodies import JointedBodies
from .joints import Joint, JointCoordinate
from .orbits import Orbit
from .parameters import checked_finite, checked_positive
from .tree_files import BodyRecord, read_mjcf, read_urdf

MIN_PIVOT_FRACTION = 1e-12
"""Least inertia that a joint moves, relative to that of the whole tree, below which it counts as zero.

A pivot is a difference of inertias of the whole, so rounding alone leaves about 1e-16 of it."""

TEST_ANGLES_SEED = 0
"""Seed of the joint coordinates at which a tree is tested for joints that move no inertia."""


class _Body(NamedTuple):
    """A rigid body of a tree."""

    name: str
    mass: jax.Array
    centre: jax.Array
    inertia: jax.Array
    parent: str | None
    joint: Joint | None


class Tree(metaclass=ListedType):
    """A tree of rigid bodies that are joined by hinges, sliders and universal joints, free in space or on the ground.

    The axes of all bodies are parallel to those of the base if all joint coordinates are zero, and the origin of a body
    is at its joint. Units are SI or any other consistent ones.

    Parameters
    ----------
    ground : str, optional
        Name of the ground, which is then the base and does not move. Without it the first body is the base, and free.

    Examples
    --------
    A satellite with a panel on a hinge with a spring and a damper (a pendulum: :class:`BodiesOnGround`):

    >>> tree = lt.bodies.Tree()
    >>> bus = tree.add("bus", mass=10.0, inertia=(3.0, 2.0, 1.5))
    >>> hinge = lt.bodies.Hinge(
    ...     at=(0.5, 0.1, 0.0), axis=(0.0, 1.0, 0.0), stiffness=4.0, damping=0.3
    ... )
    >>> panel = tree.add(
    ...     "panel",
    ...     mass=2.0,
    ...     centre=(0.8, 0.0, 0.1),
    ...     inertia=(0.05, 0.4, 0.42),
    ...     parent=bus,
    ...     joint=hinge,
    ... )
    >>> system = tree.system(baths=lt.HeatBaths(capacity=50.0, temperature=300.0))
    >>> x0 = system.state(angular_velocity=(0.3, 0.1, 0.8), joints={"panel": 0.4})
    >>> solution = lt.integrate(system, x0, (0.0, 10.0), 0.05, lt.MetriplecticGauss(2))
    >>> solution.audit().passed, solution.joints["panel"].shape
    (True, (201,))
    """

    def __init__(self, ground: str | None = None) -> None:
        self._bodies: dict[str, _Body] = {}
        self._has_ground = ground is not None
        if ground is not None:
            name, zero = _checked_name(ground), jnp.zeros(())
            self._bodies[name] = _Body(name, zero, jnp.zeros(3), jnp.zeros((3, 3)), None, None)

    def add(
        self,
        name: str,
        mass,
        centre=(0.0, 0.0, 0.0),
        inertia=(0.0, 0.0, 0.0),
        parent: str | None = None,
        joint: Joint | None = None,
    ) -> str:
        """Add a body and return its name; the first is the base, and each later one needs a parent and a joint.

        Parameters
        ----------
        name, mass : str, and float > 0
            Name of the body and of its joint, and its mass (kg).
        centre : array, shape (3,)
            Centre of mass in axes of the body, from its origin (m).
        inertia : array, shape (3,) or (3, 3)
            Moments of inertia, or the symmetric tensor, about the centre of mass in axes of the body (kg m**2). Zero is
            a point mass, and (0, J, J) a slender rod.
        parent : str
            Name of a body that was added before.
        joint : Hinge, Slider or Universal
            The joint between the parent and this body.

        Raises
        ------
        InputError
            If the name exists, the parent does not, or no rigid body has this mass and inertia.
        """
        _checked_name(name)
        if name in self._bodies:
            raise InputError(f"there is a body {name!r} already. Give each body another name")
        if not self._bodies and (parent is not None or joint is not None):
            raise InputError(f"{name!r} is the first body, so it is the base, which has no parent and no joint")
        if self._bodies:
            if parent is None or joint is None:
                missing_argument = "a parent" if parent is None else "a joint"
                raise InputError(f"{name!r} needs {missing_argument}: only the base, {self.base!r}, has none")
            if parent not in self._bodies:
                names = ", ".join(map(repr, self._bodies))
                raise InputError(
                    f"the parent {parent!r} of {name!r} is unknown. Add bodies from the base outwards, without loops; "
                    f"the tree has {names}"
                )
            if not isinstance(joint, Joint):
                raise InputError(
                    f"the joint of {name!r} must be lt.bodies.Hinge, Slider or Universal, got {type(joint).__name__}"
                )
        self._bodies[name] = _Body(
            name,
            checked_positive(mass, f"the mass of {name!r}"),
            checked_finite(centre, f"the centre of {name!r}", 3),
            _checked_body_inertia(inertia, name),
            parent,
            joint,
        )
        return name

    @property
    def base(self) -> str:
        """Name of the base."""
        if not self._bodies:
            raise InputError("the tree has no bodies. Add a base first")
        return next(iter(self._bodies))

    def __repr__(self) -> str:
        return f"Tree({join_first_items(self._bodies, ('', ''))})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all bodies, the base first."""
        return tuple(self._bodies)

    def system(
        self,
        baths: HeatBaths | None = None,
        torque: Any = None,
        motors: Mapping[str, Any] | None = None,
        gravity: Any = None,
        attitude: bool = True,
    ) -> JointedBodies | BodiesOnGround:
        """Return the equations of motion of the tree.

        Parameters
        ----------
        baths : HeatBaths, optional
            The bath that the dampers of the joints heat. Without one their heat is lost, and the energy falls.
        torque : function of t and Pi, or of t, Pi and the attitude, or a list of them; optional
            External torque, shape (3,), on the whole about its centre of mass in axes of the base: see ``lt.torques``.
        motors : dict of float or of function from t, optional
            Torques of motors by the name of the body, as ``motor`` of a joint, which they replace.
        gravity : array, shape (3,), or lt.torques.Orbit; optional
            A uniform field in axes in space (m/s^2). On the ground it acts on the joints. A free tree falls in it: the
            state then has position and momentum of the common centre of mass, and attitude and joints move as without
            gravity. Along an orbit the gradient of gravity acts on every body of a free tree, to second order in its
            size over the distance from the centre.
        attitude : bool
            If true, runs follow the attitude of a free base, an element of SO(3).

        Raises
        ------
        InputError
            If there is no joint, or one moves no inertia; for a motor without a joint, a torque or orbit on the ground.
        """
        if gravity is not None and not isinstance(gravity, Orbit):
            gravity = checked_finite(gravity, "gravity", 3)
        base = self._bodies[self.base]
        moved_bodies = [body for body in self._bodies.values() if body.joint is not None]
        if not moved_bodies:
            raise InputError(
                f"the tree has one body, {base.name!r}, and no joint. Add bodies, or use lt.LiePoissonSystem with "
                "lt.Quadratic for one rigid body"
            )
        tree_arrays = _make_tree_arrays(base, moved_bodies, self._has_ground)
        first_joint_index = tree_arrays.mechanism.first_joint_index
        ranges = tuple(
            (name, first_joint_index + start, first_joint_index + end) for name, start, end in tree_arrays.joint_ranges
        )
        if not is_traced(tree_arrays.mechanism):
            _check_joints_move_inertia(tree_arrays.mechanism, tree_arrays.joint_ranges)
        joint_motors = _make_joint_motors(moved_bodies, motors, tree_arrays)
        if not self._has_ground:
            bodies = tree_arrays.mechanism, tree_arrays.springs, tree_arrays.damping, ranges
            return JointedBodies(*bodies, baths, torque, joint_motors, attitude, gravity)
        if torque is not None:
            raise InputError(
                f"torque= acts on a free base, and {base.name!r} is the ground. Use motors= for the joints"
            )
        if isinstance(gravity, Orbit):
            raise InputError(
                "gravity along an orbit is for a free tree; on the ground give a field, such as (0, 0, -9.81)"
            )
        return BodiesOnGround(
            tree_arrays.mechanism, tree_arrays.springs, tree_arrays.damping, ranges, baths, joint_motors, gravity
        )

    @classmethod
    def from_urdf(cls, source: str | os.PathLike, fixed_base: bool = False) -> Tree:
        """Return the tree of a URDF file with revolute, continuous, prismatic and fixed joints.

        ``damping`` of a joint is taken over; limits of position, effort and velocity, shapes and materials do not act.
        Bodies at fixed joints are merged with their parents.

        Parameters
        ----------
        source : str or path
            A file, or the text of one.
        fixed_base : bool
            If true, the base is the ground, and its mass does not count. By default it is free.

        Raises
        ------
        InputError
            If an element, a type of joint or a value is not covered.
        FileError
            If the file cannot be read.

        Examples
        --------
        >>> tree = lt.bodies.Tree.from_urdf('''<robot name="pair">
        ...   <link name="bus"><inertial><mass value="10"/>
        ...     <inertia ixx="3" iyy="2" izz="1.5" ixy="0" ixz="0" iyz="0"/></inertial></link>
        ...   <link name="panel"><inertial><origin xyz="0.8 0 0"/><mass value="2"/>
        ...     <inertia ixx="0.05" iyy="0.4" izz="0.42" ixy="0" ixz="0" iyz="0"/>
        ...   </inertial></link>
        ...   <joint name="hinge" type="continuous"><parent link="bus"/><child link="panel"/>
        ...     <origin xyz="0.5 0 0"/><axis xyz="0 1 0"/><dynamics damping="0.3"/></joint>
        ... </robot>''')
        >>> tree.names
        ('bus', 'panel')
        """
        return _tree_from_records(cls, read_urdf(source, fixed_base), fixed_base)

    @classmethod
    def from_mjcf(cls, source: str | os.PathLike) -> Tree:
        """Return the tree of an MJCF file of MuJoCo: one free body, or bodies in the world, with hinges and slides.

        If no body of the ``worldbody`` has a free joint, the base is the ground, with the name ``world``. Masses and
        inertias are those of ``inertial`` elements. ``damping``, ``stiffness``, ``springref`` and ``armature="0"`` of a
        joint are covered; limits of position and force, and contacts, do not act. Springs, damping and ``armature`` of
        a free joint are refused. The gravity of the file and the pose of a free base are not taken over: give
        ``gravity=`` to :meth:`system`, and ``attitude=`` to :func:`.integrate`.

        Parameters
        ----------
        source : str or path
            A file, or the text of one.

        Raises
        ------
        InputError
            If an element, an attribute or a value is not covered.
        FileError
            If the file cannot be read.

        Examples
        --------
        >>> tree = lt.bodies.Tree.from_mjcf('''<mujoco><option gravity="0 0 0"/><worldbody>
        ...   <body name="bus"><freejoint/>
        ...     <inertial pos="0 0 0" mass="10" diaginertia="3 2 1.5"/>
        ...     <body name="panel" pos="0.5 0 0">
        ...       <joint type="hinge" axis="0 1 0" damping="0.3"/>
        ...       <inertial pos="0.8 0 0" mass="2" diaginertia="0.05 0.4 0.42"/></body></body>
        ... </worldbody></mujoco>''')
        >>> tree.names
        ('bus', 'panel')
        """
        return _tree_from_records(cls, *read_mjcf(source))


def _checked_name(name: str) -> str:
    if not isinstance(name, str) or not name:
        raise InputError(f"the name of a body must be a text that is not empty, got {name!r}")
    return name


def _tree_from_records(cls: type[Tree], records: Sequence[BodyRecord], has_ground: bool) -> Tree:
    """Return a tree made of body records, of which the first is the base or the ground."""
    tree = cls(records[0].name if has_ground else None)
    for record in records[1:] if has_ground else records:
        tree.add(*record)
    return tree


def _checked_body_inertia(inertia, name: str) -> jax.Array:
    """Return the tensor of inertia of a rigid body, shape (3, 3), after checking it; points and rods are allowed.

    Raises
    ------
    InputError
        If a tensor is not symmetric, a moment is negative, or one is more than the sum of the other two.
    """
    inertia_text = f"the inertia of {name!r}"
    array = checked_finite(checked_numbers(inertia, inertia_text, (3,), (3, 3)), inertia_text)
    if is_traced(array):
        return jnp.diag(array) if array.ndim == 1 else 0.5 * (array + array.T)
    tensor = np.diag(array) if array.ndim == 1 else np.asarray(array)
    if not are_symmetric_to_rounding(tensor):
        raise InputError(f"{inertia_text} must be a symmetric tensor, got {tensor.tolist()}")
    tensor = 0.5 * (tensor + tensor.T)
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] < -INEQUALITY_RTOL * abs(moments).max():
        raise InputError(f"{inertia_text} must have principal moments >= 0, got {moments.tolist()}")
    if not satisfies_triangle_inequalities(moments):
        raise InputError(
            f"no rigid body has {inertia_text}: its largest principal moment, {moments[2]:g}, is more than the "
            f"sum of the others, {moments[0] + moments[1]:g}. Check that it is about the centre of mass"
        )
    return jnp.asarray(tensor)


class _TreeArrays(NamedTuple):
    """The mechanism, springs, dampers and joint ranges of a tree, as arrays.

    Attributes
    ----------
    mechanism : ArticulatedBodies
    springs : JointSprings
    damping : array, shape (k,)
    joint_ranges : list of (str, int, int)
        Name of each moved body, and the range of its joint coordinates.
    """

    mechanism: ArticulatedBodies
    springs: JointSprings
    damping: jax.Array
    joint_ranges: list[JointRange]


def _make_tree_arrays(base: _Body, moved_bodies: list[_Body], has_ground: bool) -> _TreeArrays:
    """Make the arrays of a tree; each joint coordinate moves one link, and the last one moves that of the body."""
    link_by_body = {base.name: 0}
    parents: list[int] = []
    joint_positions: list[jax.Array] = []
    joint_ranges: list[JointRange] = []
    coordinates: list[JointCoordinate] = []
    for body in moved_bodies:
        assert body.joint is not None
        assert body.parent is not None
        link, joint_position = link_by_body[body.parent], body.joint.at
        for coordinate in body.joint.coordinates:
            parents.append(link)
            joint_positions.append(joint_position)
            coordinates.append(coordinate)
            link, joint_position = len(parents), jnp.zeros(3)
        link_by_body[body.name] = link
        joint_ranges.append((body.name, link - body.joint.size, link))
    bodies = moved_bodies if has_ground else [base, *moved_bodies]
    mechanism = ArticulatedBodies(
        jnp.stack([body.mass for body in bodies]),
        jnp.stack([body.centre for body in bodies]),
        jnp.stack([body.inertia for body in bodies]),
        jnp.stack(joint_positions),
        jnp.stack([coordinate.axis for coordinate in coordinates]),
        tuple(link_by_body[body.name] for body in bodies),
        tuple(parents),
        tuple(coordinate.slides for coordinate in coordinates),
        has_ground,
    )
    springs = JointSprings(
        jnp.stack([coordinate.stiffness for coordinate in coordinates]),
        jnp.stack([coordinate.rest for coordinate in coordinates]),
        mechanism.first_joint_index,
    )
    return _TreeArrays(mechanism, springs, jnp.stack([coordinate.damping for coordinate in coordinates]), joint_ranges)


@jit_unoptimised
def _joint_inertias_and_mass_matrix(mechanism: ArticulatedBodies, q) -> tuple[jax.Array, jax.Array]:
    return mechanism.articulated_joint_inertias(q), mechanism.mass_matrix(q)


def _check_joints_move_inertia(mechanism: ArticulatedBodies, joint_ranges: list[JointRange]) -> None:
    """Raise InputError if a joint moves no inertia, or the tree has none about an axis, at random joint coordinates."""
    q = np.random.default_rng(TEST_ANGLES_SEED).uniform(0.5, 1.0, mechanism.n_joints)
    with jax.ensure_compile_time_eval():
        joint_inertias, M = map(np.asarray, _joint_inertias_and_mass_matrix(mechanism, jnp.asarray(q)))
    n_base_velocities = mechanism.first_joint_index
    scales = np.diagonal(M)[n_base_velocities:]
    inertia_scale = np.diagonal(M)[:n_base_velocities].max(initial=scales.max())
    for name, start, end in joint_ranges:
        for i in range(start, end):
            scale = np.sum(mechanism.masses) if mechanism.slides[i] else max(scales[i], inertia_scale)
            if not joint_inertias[i] > MIN_PIVOT_FRACTION * scale:
                raise InputError(
                    f"the joint of {name!r} moves no inertia, so its motion is undefined. Give the body an inertia, or "
                    "a centre of mass off the axis"
                )
    if mechanism.is_fixed:
        return
    moments = np.linalg.eigvalsh(M[:3, :3] - M[:3, 3:] @ np.linalg.solve(M[3:, 3:], M[3:, :3]))
    if not moments[0] > MIN_PIVOT_FRACTION * inertia_scale:
        raise InputError(
            "the tree has no inertia about an axis if its joints are free, so its motion is undefined. Give the base "
            "an inertia"
        )


def _make_joint_motors(
    moved_bodies: list[_Body], motors: Mapping[str, Any] | None, tree_arrays: _TreeArrays
) -> JointMotors | None:
    """Return the motors in the joints of a tree, checked and traced; None if no joint has a motor."""
    if not isinstance(motors, Mapping | None):
        raise InputError(f"motors must be a dict by the names of bodies, got {type(motors).__name__}")
    names = [body.name for body in moved_bodies]
    if unknown := [name for name in motors or {} if name not in names]:
        raise InputError(f"no joint moves {', '.join(map(repr, unknown))}. The joints move {', '.join(names)}")
    motor_by_body = {body.name: body.joint.motor for body in moved_bodies if body.joint is not None} | dict(
        motors or {}
    )
    functions, indices, driven_bodies = [], [], []
    for name, start, end in tree_arrays.joint_ranges:
        if (motor := motor_by_body[name]) is None:
            continue
        n_coordinates, motor_text = end - start, f"the motor of {name!r}"
        allowed_shapes = ((n_coordinates,), ()) if n_coordinates == 1 else ((n_coordinates,),)
        if callable(motor):
            motor, _ = traced_function_and_shape(motor, [()], allowed_shapes, motor_text, "a time t")
        else:
            motor = checked_finite(np.atleast_1d(motor) if not is_traced(motor) else motor, motor_text)
            if motor.shape not in allowed_shapes:
                shape_text = "one number" if n_coordinates == 1 else f"an array of shape ({n_coordinates},)"
                raise FunctionError(f"{motor_text} must be {shape_text}, got an array of shape {motor.shape}")
        functions.append(motor)
        indices.append(tuple(range(start, end)))
        driven_bodies.append(name)
    if not functions:
        return None
    return JointMotors(tuple(functions), tuple(indices), tree_arrays.mechanism.n_joints, tuple(driven_bodies))
