"""Rigid bodies joined by hinges, sliders and universal joints in a tree, free in space."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._precision import with_library_settings
from manifolds._pytree_module import Module
from manifolds.structures.poisson import ProductPoisson

from ..errors import FunctionError, InputError
from ..functions.conditions import checked_numbers
from ..functions.energy import Energy, Sum
from ..systems import HeatBaths, LiePoissonSystem
from ..systems.torque import check_torque, torque_free_components
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message
from ..tracing.traced import trace_callables_and_result_shapes
from .articulated_bodies import ArticulatedBodies, JointDamping, JointSprings, KineticEnergy, Motion
from .inertia import INEQUALITY_RTOL, is_symmetric
from .joints import Joint, JointCoordinate
from .parameters import checked_finite, checked_positive
from .tree_files import BodyRecord, read_mjcf, read_urdf

MIN_PIVOT_FRACTION = 1e-12
"""Least inertia that a joint moves, relative to that of the whole tree, below which it counts as zero.

A pivot is a difference of inertias of the whole, so rounding alone leaves about 1e-16 of it."""

TEST_ANGLES_SEED = 0
"""Seed of the joint coordinates at which a tree is tested for joints that move no inertia."""


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
        self.torque, self.torques_need_attitude = check_torque(torque, algebra, self.group)
        self.torque_free_components = (
            ()
            if torque is None
            else torque_free_components(self.torque, self.torques_need_attitude, algebra, self.group)
        )
        self.torque_arguments, self.motors, self.joint_indices = None, motors, joint_indices
        energy: Energy = KineticEnergy(mechanism)
        if is_traced(springs.stiffness) or np.asarray(springs.stiffness).any():
            energy = Sum((energy, springs))
        dissipation = JointDamping(damping) if is_traced(damping) or np.asarray(damping).any() else None
        poisson = ProductPoisson(mf.LiePoisson(algebra), mf.Canonical(k))
        self._build(poisson, 3 + 2 * k, energy, None, dissipation, (), True, baths=baths)

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
        return {name: C.on(range(3)) for name, C in self.momentum_casimirs().items()}

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
        return jnp.vectorize(self.mechanism.mass_matrix, signature="(k)->(m,m)")(q)

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
        kinetic = KineticEnergy(self.mechanism)
        flat = jax.vmap(lambda y: self.mechanism.motion(*kinetic.split_state(y)))(x.reshape(-1, self.dim))
        return Motion(*(part.reshape(*x.shape[:-1], *part.shape[1:]) for part in flat))

    @property
    def mechanism_record(self) -> dict[str, Any] | None:
        """Bodies and joints as JSON data, from which velocities are computed; None while they are traced."""
        mechanism = self.mechanism
        if is_traced(mechanism):
            return None
        arrays = {name: np.asarray(getattr(mechanism, name)).tolist() for name in MECHANISM_ARRAYS}
        return arrays | {
            "body_links": list(mechanism.body_links),
            "parents": list(mechanism.parents),
            "slides": list(mechanism.slides),
        }

    # -- states -------------------------------------------------------------------------------------------------------

    @with_library_settings
    def state(
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


MECHANISM_ARRAYS = ("masses", "centres", "inertias", "places", "axes")
"""Names of the arrays of a mechanism in :attr:`JointedBodies.mechanism_record`."""


def mechanism_from_record(record: Mapping[str, Any]) -> ArticulatedBodies:
    """Return the bodies and joints of a :attr:`JointedBodies.mechanism_record`."""
    arrays = [jnp.asarray(record[name], dtype=jnp.float64) for name in MECHANISM_ARRAYS]
    return ArticulatedBodies(
        *arrays, tuple(record["body_links"]), tuple(record["parents"]), tuple(map(bool, record["slides"]))
    )


def _entries(values, start: int, end: int):
    """Return some components of values, shape (..., k): shape (...) for one, (..., end - start) for more."""
    return values[..., start] if end - start == 1 else values[..., start:end]


class _Body(NamedTuple):
    """A rigid body of a tree."""

    name: str
    mass: jax.Array
    centre: jax.Array
    inertia: jax.Array
    parent: str | None
    joint: Joint | None


class Tree:
    """A tree of rigid bodies that are joined by hinges, sliders and universal joints, free in space.

    The axes of all bodies are parallel to those of the base if all joint coordinates are zero, and the origin of a body
    is at its joint. Units are SI or any other consistent ones.

    Examples
    --------
    A satellite with a panel on a hinge with a spring and a damper:

    >>> tree = lt.bodies.Tree()
    >>> bus = tree.add("bus", mass=10.0, inertia=(3.0, 2.0, 1.5))
    >>> hinge = lt.bodies.Hinge(at=(0.5, 0.1, 0.0), axis=(0.0, 1.0, 0.0), stiffness=4.0, damping=0.3)
    >>> panel = tree.add("panel", mass=2.0, centre=(0.8, 0.0, 0.1), inertia=(0.05, 0.4, 0.42), parent=bus, joint=hinge)
    >>> system = tree.system(baths=lt.HeatBaths(capacity=50.0, temperature=300.0))
    >>> x0 = system.state(angular_velocity=(0.3, 0.1, 0.8), joints={"panel": 0.4})
    >>> solution = lt.integrate(system, x0, (0.0, 10.0), 0.05, lt.MetriplecticGauss(2))
    >>> solution.audit().passed, solution.joints["panel"].shape
    (True, (201,))
    """

    def __init__(self) -> None:
        self._bodies: dict[str, _Body] = {}

    def add(
        self,
        name: str,
        mass,
        centre=(0.0, 0.0, 0.0),
        inertia=(0.0, 0.0, 0.0),
        parent: str | None = None,
        joint: Joint | None = None,
    ) -> str:
        """Add a body; the first one is the base, and each later one needs a parent and a joint.

        Parameters
        ----------
        name : str
            Name of the body, and of its joint.
        mass : float, > 0
            Mass (kg).
        centre : array, shape (3,)
            Centre of mass in axes of the body, from its origin (m).
        inertia : array, shape (3,) or (3, 3)
            Moments of inertia, or the symmetric tensor, about the centre of mass in axes of the body (kg m**2). Zero is
            a point mass, and (0, J, J) a slender rod.
        parent : str
            Name of a body that was added before.
        joint : Hinge, Slider or Universal
            The joint between the parent and this body.

        Returns
        -------
        str
            The name, to be the parent of other bodies.

        Raises
        ------
        InputError
            If the name exists, the parent does not, or no rigid body has this mass and inertia.
        """
        if not isinstance(name, str) or not name:
            raise InputError(f"the name of a body must be a text that is not empty, got {name!r}")
        if name in self._bodies:
            raise InputError(f"there is a body {name!r} already. Give each body another name")
        if not self._bodies and (parent is not None or joint is not None):
            raise InputError(f"{name!r} is the first body, so it is the base, which has no parent and no joint")
        if self._bodies:
            if parent is None or joint is None:
                missing = "a parent" if parent is None else "a joint"
                raise InputError(f"{name!r} needs {missing}: only the first body, {self.base!r}, is free")
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
            raise InputError("the tree has no bodies: add a base first")
        return next(iter(self._bodies))

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
    ) -> JointedBodies:
        """Return the equations of motion of the tree.

        Parameters
        ----------
        baths : HeatBaths, optional
            The bath that the dampers of the joints heat. Without one their heat is lost, and the energy falls.
        torque : function of t and Pi, or of t, Pi and the attitude, or a list of them; optional
            External torque on the whole about its centre of mass, in axes of the base, shape (3,): see
            :mod:`liethermo.torques`.
        motors : dict of float or of function from t, optional
            Torques of motors by the name of the body, as ``motor`` of a joint, which they replace.
        gravity : optional
            Must be None. In a uniform field the centre of mass of a free tree falls, and attitude and joints move as
            without gravity; a gradient of gravity acts by ``torque``.
        attitude : bool
            If true, runs follow the attitude of the base, an element of SO(3).

        Raises
        ------
        InputError
            If the tree has no joint, a joint moves no inertia, or a motor belongs to no joint.
        """
        if gravity is not None:
            raise InputError(
                "gravity= is not available, since a free tree has no position. In a uniform field attitude and joints "
                "move as without it; for its gradient use torque=lt.torques.GravityGradient(...)"
            )
        base = self._bodies[self.base]
        moved = [body for body in self._bodies.values() if body.joint is not None]
        if not moved:
            raise InputError(
                f"the tree has one body, {base.name!r}, and no joint. Add bodies, or use lt.LiePoissonSystem with "
                "lt.Quadratic for one rigid body"
            )
        layout = _layout(base, moved)
        indices = tuple((name, 3 + start, 3 + end) for name, start, end in layout.joint_ranges)
        if not is_traced(layout.mechanism):
            _check_pivots(layout.mechanism, layout.joint_ranges)
        joint_motors = _joint_motors(moved, motors, layout)
        return JointedBodies(
            layout.mechanism, layout.springs, layout.damping, indices, baths, torque, joint_motors, attitude
        )

    @classmethod
    def from_urdf(cls, source: str | os.PathLike) -> Tree:
        """Return the tree of a URDF file: a free base, and revolute, continuous, prismatic and fixed joints.

        ``damping`` of a joint is taken over; limits of position, effort and velocity, shapes and materials do not act.
        Bodies at fixed joints are merged with their parents.

        Parameters
        ----------
        source : str or path
            A file, or the text of one.

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
        ...     <inertia ixx="0.05" iyy="0.4" izz="0.42" ixy="0" ixz="0" iyz="0"/></inertial></link>
        ...   <joint name="hinge" type="continuous"><parent link="bus"/><child link="panel"/>
        ...     <origin xyz="0.5 0 0"/><axis xyz="0 1 0"/><dynamics damping="0.3"/></joint>
        ... </robot>''')
        >>> tree.names
        ('bus', 'panel')
        """
        return _tree_of(cls, read_urdf(source))

    @classmethod
    def from_mjcf(cls, source: str | os.PathLike) -> Tree:
        """Return the tree of an MJCF file of MuJoCo: one free body with hinges and slides.

        Masses and inertias are those of ``inertial`` elements. ``damping``, ``stiffness``, ``springref`` and
        ``armature="0"`` of a joint are covered; gravity must be zero.

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
        ...   <body name="bus"><freejoint/><inertial pos="0 0 0" mass="10" diaginertia="3 2 1.5"/>
        ...     <body name="panel" pos="0.5 0 0"><joint type="hinge" axis="0 1 0" damping="0.3"/>
        ...       <inertial pos="0.8 0 0" mass="2" diaginertia="0.05 0.4 0.42"/></body></body>
        ... </worldbody></mujoco>''')
        >>> tree.names
        ('bus', 'panel')
        """
        return _tree_of(cls, read_mjcf(source))


def _tree_of(cls: type[Tree], records: Sequence[BodyRecord]) -> Tree:
    """Return a tree with the bodies of a file."""
    tree = cls()
    for record in records:
        tree.add(*record)
    return tree


def _checked_body_inertia(inertia, name: str) -> jax.Array:
    """Return the tensor of inertia of a rigid body, shape (3, 3); points and slender rods are allowed.

    Raises
    ------
    InputError
        If a tensor is not symmetric, a moment is negative, or one is more than the sum of the other two.
    """
    what = f"the inertia of {name!r}"
    array = checked_finite(checked_numbers(inertia, what, (3,), (3, 3)), what)
    if is_traced(array):
        return jnp.diag(array) if array.ndim == 1 else 0.5 * (array + array.T)
    tensor = np.diag(array) if array.ndim == 1 else np.asarray(array)
    if not is_symmetric(tensor):
        raise InputError(f"{what} must be a symmetric tensor, got {tensor.tolist()}")
    tensor = 0.5 * (tensor + tensor.T)
    moments = np.linalg.eigvalsh(tensor)
    rounding = INEQUALITY_RTOL * abs(moments).max()
    if moments[0] < -rounding:
        raise InputError(f"{what} must have principal moments >= 0, got {moments.tolist()}")
    if moments[2] > moments[0] + moments[1] + rounding:
        raise InputError(
            f"no rigid body has {what}: its largest principal moment, {moments[2]:g}, is more than the sum of the "
            f"others, {moments[0] + moments[1]:g}. Check that it is about the centre of mass"
        )
    return jnp.asarray(tensor)


class _Layout(NamedTuple):
    """Arrays of a tree.

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
    joint_ranges: list[tuple[str, int, int]]


def _layout(base: _Body, moved: list[_Body]) -> _Layout:
    """Return the arrays of a tree; each coordinate of a joint moves a link, the last one that of the body."""
    link_of = {base.name: 0}
    parents: list[int] = []
    places: list[jax.Array] = []
    joint_ranges: list[tuple[str, int, int]] = []
    coordinates: list[JointCoordinate] = []
    for body in moved:
        assert body.joint is not None
        assert body.parent is not None
        link, place = link_of[body.parent], body.joint.at
        for coordinate in body.joint.coordinates:
            parents.append(link)
            places.append(place)
            coordinates.append(coordinate)
            link, place = len(parents), jnp.zeros(3)
        link_of[body.name] = link
        joint_ranges.append((body.name, link - body.joint.size, link))
    bodies = [base, *moved]
    mechanism = ArticulatedBodies(
        jnp.stack([body.mass for body in bodies]),
        jnp.stack([body.centre for body in bodies]),
        jnp.stack([body.inertia for body in bodies]),
        jnp.stack(places),
        jnp.stack([coordinate.axis for coordinate in coordinates]),
        tuple(link_of[body.name] for body in bodies),
        tuple(parents),
        tuple(coordinate.slides for coordinate in coordinates),
    )
    springs = JointSprings(
        jnp.stack([coordinate.stiffness for coordinate in coordinates]),
        jnp.stack([coordinate.rest for coordinate in coordinates]),
    )
    return _Layout(mechanism, springs, jnp.stack([coordinate.damping for coordinate in coordinates]), joint_ranges)


def _check_pivots(mechanism: ArticulatedBodies, joint_ranges: list[tuple[str, int, int]]) -> None:
    """Raise InputError if a joint moves no inertia, or the whole has none about an axis, at a random configuration."""
    q = np.random.default_rng(TEST_ANGLES_SEED).uniform(0.5, 1.0, mechanism.n_joints)
    with jax.ensure_compile_time_eval():
        pivots, M = np.asarray(mechanism.pivots(q)), np.asarray(mechanism.mass_matrix(q))
    scales = np.diagonal(M)[3:]
    inertia_scale = np.diagonal(M)[:3].max()
    for name, start, end in joint_ranges:
        for i in range(start, end):
            scale = np.sum(mechanism.masses) if mechanism.slides[i] else max(scales[i], inertia_scale)
            if not pivots[i] > MIN_PIVOT_FRACTION * scale:
                raise InputError(
                    f"the joint of {name!r} moves no inertia, so its motion is undefined: give the body an inertia, or "
                    "a centre of mass off the axis"
                )
    moments = np.linalg.eigvalsh(M[:3, :3] - M[:3, 3:] @ np.linalg.solve(M[3:, 3:], M[3:, :3]))
    if not moments[0] > MIN_PIVOT_FRACTION * inertia_scale:
        raise InputError(
            "the tree has no inertia about an axis if its joints are free, so its motion is undefined: give the base an "
            "inertia"
        )


def _joint_motors(moved: list[_Body], given: Mapping[str, Any] | None, layout: _Layout) -> JointMotors | None:
    """Return the motors of a tree, checked and traced; None if there is none."""
    if not isinstance(given, Mapping | None):
        raise InputError(f"motors must be a dict by the names of bodies, got {type(given).__name__}")
    names = [body.name for body in moved]
    if unknown := [name for name in given or {} if name not in names]:
        raise InputError(f"no joint moves {', '.join(map(repr, unknown))}. The joints move {', '.join(names)}")
    by_name = {body.name: body.joint.motor for body in moved if body.joint is not None} | dict(given or {})
    functions, indices, driven = [], [], []
    for name, start, end in layout.joint_ranges:
        if (motor := by_name[name]) is None:
            continue
        size, what = end - start, f"the motor of {name!r}"
        if callable(motor):
            motor, shape = _traced_motor(motor, what)
        else:
            motor = checked_finite(np.atleast_1d(motor) if not is_traced(motor) else motor, what)
            shape = motor.shape
        if shape not in ((size,), *([()] if size == 1 else [])):
            wanted = "one number" if size == 1 else f"an array of shape ({size},)"
            raise FunctionError(f"{what} must give {wanted}, got shape {shape}")
        functions.append(motor)
        indices.append(tuple(range(start, end)))
        driven.append(name)
    if not functions:
        return None
    return JointMotors(tuple(functions), tuple(indices), layout.mechanism.n_joints, tuple(driven))


def _traced_motor(motor: Callable, what: str) -> tuple[Any, tuple[int, ...]]:
    """Return a function of the time with plain functions traced, and the shape of its result."""
    try:
        traced, result = trace_callables_and_result_shapes(motor, lambda function, t: jnp.asarray(function(t)), ())
    except TRACE_ERRORS as error:
        raise FunctionError(trace_error_message(f"{what} could not be evaluated at a time", error)) from error
    return traced, result.shape
