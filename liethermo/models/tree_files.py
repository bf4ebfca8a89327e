"""Reading trees of rigid bodies from URDF and MJCF files."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from ..disk import checked_path
from ..errors import FileError, InputError
from .joints import Hinge, Joint, Slider, Universal

COINCIDENCE_RTOL = 1e-12
"""Distance of two axes of a universal joint, relative to the offsets that place them, that counts as rounding."""


class BodyRecord(NamedTuple):
    """One body of a file, as the arguments of :meth:`.Tree.add`, in axes parallel to those of the base.

    Attributes
    ----------
    name : str
    mass : float
    centre : array, shape (3,)
    inertia : array, shape (3, 3)
    parent : str or None
    joint : Joint or None
    """

    name: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    parent: str | None
    joint: Joint | None


class JointRecord(NamedTuple):
    """One joint of a file, in axes of the body that it moves.

    Attributes
    ----------
    slides : bool
    position : array, shape (3,)
        A point of the axis, from the origin of the body.
    axis : array, shape (3,)
    stiffness, damping, rest : float
    """

    slides: bool
    position: np.ndarray
    axis: np.ndarray
    stiffness: float
    damping: float
    rest: float


class LinkRecord(NamedTuple):
    """One body of a file in its own frame, placed in that of its parent.

    Attributes
    ----------
    name : str
    parent : str or None
    rotation : array, shape (3, 3)
        From axes of the body to axes of the parent.
    origin : array, shape (3,)
        Origin of the body in the parent.
    mass : float
    centre : array, shape (3,)
    inertia : array, shape (3, 3)
        About the centre of mass, in axes of the body.
    joints : tuple of JointRecord
        The joints between the parent and the body; a body without any is fixed in its parent.
    """

    name: str
    parent: str | None
    rotation: np.ndarray
    origin: np.ndarray
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    joints: tuple[JointRecord, ...]


def read_urdf(source: str | os.PathLike, fixed_base: bool = False) -> list[BodyRecord]:
    """Read the bodies of a URDF file or text, in order from the base outwards; see :meth:`.Tree.from_urdf`.

    If the base is fixed, its mass is zero.
    """
    robot = _read_xml_root(source, "robot", "URDF")
    _refuse_unknown_children(robot, "robot", {"link", "joint"}, URDF_SHAPES | {"transmission"})
    links: dict[str, Element] = {}
    for link in robot.findall("link"):
        link_name = _required_attribute(link, "name")
        if link_name in links:
            raise InputError(f"two links have the name {link_name!r}")
        links[link_name] = link
    joint_of: dict[str, Element] = {}
    for joint in robot.findall("joint"):
        kind, name = _required_attribute(joint, "type"), _required_attribute(joint, "name")
        if kind not in URDF_JOINTS:
            raise InputError(
                f"the joint {name!r} is of type {kind!r}, which is not covered. The types that are: "
                f"{', '.join(URDF_JOINTS)}"
            )
        parent, child = (_required_attribute(_required_only_child(joint, tag), "link") for tag in ("parent", "child"))
        for link_name in (parent, child):
            if link_name not in links:
                raise InputError(f"the joint {name!r} names the link {link_name!r}, which the file does not have")
        if child in joint_of:
            raise InputError(f"the link {child!r} has two parents: a loop of joints is not a tree")
        joint_of[child] = joint
    roots = [name for name in links if name not in joint_of]
    if len(roots) != 1:
        text = "every link is the child of a joint, which is a loop" if not roots else f"got {', '.join(roots)}"
        raise InputError(f"a URDF file must have one link without a parent, the base: {text}")
    names, records = roots, []
    while names:
        name, *names = names
        records.append(_read_urdf_link(name, links[name], joint_of.get(name)))
        names += [
            child
            for child, joint in joint_of.items()
            if _required_attribute(_required_only_child(joint, "parent"), "link") == name
        ]
    if len(records) < len(links):
        unreached_links = sorted(set(links) - {record.name for record in records})
        raise InputError(f"the links {', '.join(unreached_links)} are in a loop of joints, so they are not a tree")
    return _merge_fixed_links(records, fixed_base)


URDF_SHAPES = {"visual", "collision", "material"}
"""Elements of URDF that do not act on the motion of a free tree."""

URDF_JOINTS = ("revolute", "continuous", "prismatic", "fixed")
"""Types of joints of URDF that are covered."""


def _read_urdf_link(name: str, link: Element, joint: Element | None) -> LinkRecord:
    _refuse_unknown_children(link, f"link {name!r}", {"inertial"}, URDF_SHAPES)
    mass, centre, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    if (inertial := _optional_only_child(link, "inertial")) is not None:
        _refuse_unknown_children(inertial, f"inertial of {name!r}", {"origin", "mass", "inertia"}, set())
        mass = _number_attribute(_required_only_child(inertial, "mass"), "value")
        entries = {
            key: _number_attribute(_required_only_child(inertial, "inertia"), key)
            for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        }
        R, centre = _read_urdf_origin(inertial)
        inertia = R @ _symmetric_matrix(*entries.values()) @ R.T
    if joint is None:
        return LinkRecord(name, None, np.eye(3), np.zeros(3), mass, centre, inertia, ())
    joint_name, kind = _required_attribute(joint, "name"), _required_attribute(joint, "type")
    covered = {"parent", "child", "origin", "axis", "dynamics"}
    _refuse_unknown_children(joint, f"joint {joint_name!r}", covered, {"limit", "calibration", "safety_controller"})
    rotation, origin = _read_urdf_origin(joint)
    joints: tuple[JointRecord, ...] = ()
    if kind != "fixed":
        axis, dynamics = _optional_only_child(joint, "axis"), _optional_only_child(joint, "dynamics")
        direction = np.array([1.0, 0.0, 0.0]) if axis is None else _number_array_attribute(axis, "xyz", 3)
        damping = 0.0
        if dynamics is not None:
            damping = _number_attribute(dynamics, "damping", 0.0)
            for attribute in sorted(set(dynamics.attrib) - {"damping"}):
                _refuse_nonzero_attribute(dynamics, attribute, f"dynamics of the joint {joint_name!r}")
        joints = (JointRecord(kind == "prismatic", np.zeros(3), direction, 0.0, damping, 0.0),)
    parent = _required_attribute(_required_only_child(joint, "parent"), "link")
    return LinkRecord(name, parent, rotation, origin, mass, centre, inertia, joints)


def _read_urdf_origin(element: Element) -> tuple[np.ndarray, np.ndarray]:
    """Read the ``origin`` of a URDF element; return the rotation, shape (3, 3), and the position, shape (3,)."""
    origin = _optional_only_child(element, "origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    _refuse_unknown_attributes(origin, f"the origin in {_element_text(element)}", {"xyz", "rpy"})
    angles = _number_array_attribute(origin, "rpy", 3, np.zeros(3))
    return Rotation.from_euler("xyz", angles).as_matrix(), _number_array_attribute(origin, "xyz", 3, np.zeros(3))


GROUND_NAME = "world"
"""Name of the ground in MJCF files."""


def read_mjcf(source: str | os.PathLike) -> tuple[list[BodyRecord], bool]:
    """Read the bodies of an MJCF file or text, in order from the base outwards, and True if the base is the ground.

    See :meth:`.Tree.from_mjcf`.
    """
    root = _read_xml_root(source, "mujoco", "MJCF")
    covered = {"compiler", "option", "default", "worldbody"}
    _refuse_unknown_children(root, "mujoco", covered, MJCF_SETTINGS)
    for option in root.findall("option"):
        for name in ("density", "viscosity", "wind"):
            _refuse_nonzero_attribute(option, name, "option")
        for flag in option.findall("flag"):
            for name in ("spring", "damper"):
                if flag.get(name, "enable") != "enable":
                    raise InputError(f"{name}={flag.get(name)!r} of flag is not covered")
    reader = _MjcfReader(root)
    world = _required_only_child(root, "worldbody")
    _refuse_unknown_children(world, "worldbody", {"body"}, MJCF_SHAPES)
    bodies = world.findall("body")
    if not bodies:
        raise InputError("worldbody must have a body, got none")
    has_ground = not any(_has_free_joint(body) for body in bodies)
    if has_ground:
        zero = np.zeros(3)
        reader.records.append(LinkRecord(GROUND_NAME, None, np.eye(3), zero, 0.0, zero, np.zeros((3, 3)), ()))
    elif len(bodies) != 1:
        raise InputError(f"a free base must be the only body of worldbody, got {len(bodies)} bodies")
    for body in bodies:
        reader.add_body(body, GROUND_NAME if has_ground else None)
    return _merge_fixed_links(reader.records, has_ground), has_ground


def _has_free_joint(body: Element) -> bool:
    """Return True if a body of an MJCF file has a free joint."""
    has_free_joint = any(joint.get("type") == "free" for joint in body.findall("joint"))
    return has_free_joint or body.find("freejoint") is not None


MJCF_SETTINGS = {"asset", "visual", "statistic", "size", "sensor", "custom", "keyframe", "contact"}
"""Elements of MJCF that do not act on the motion of a free tree without contacts."""

MJCF_SHAPES = {"geom", "site", "camera", "light"}
"""Elements of a body of MJCF that do not act on its motion if it has an ``inertial``."""

MJCF_COMPILER_DEFAULTS = {"coordinate": "local", "eulerseq": "xyz", "balanceinertia": "false", "settotalmass": "-1"}
"""Attributes of the compiler of MJCF that are covered with one value only."""

MJCF_COMPILER_IGNORED = {"angle", "autolimits", "inertiafromgeom", "meshdir", "texturedir", "assetdir", "strippath"}
"""Attributes of the compiler of MJCF that are read, or that do not act on bodies with an ``inertial``."""

MJCF_JOINT_ATTRIBUTES = {
    "name", "type", "pos", "axis", "stiffness", "damping", "springref", "limited", "range", "margin", "group", "user",
    "solreflimit", "solimplimit", "solreffriction", "solimpfriction", "actuatorfrcrange", "actuatorfrclimited",
}  # fmt: skip
"""Attributes of a joint of MJCF that are covered, or that do not act without limits and actuators."""

MJCF_FREE_JOINT_LOADS = ("stiffness", "damping", "armature", "frictionloss", "springdamper")
"""Attributes of a free joint of MJCF that act on the motion of the base; its other attributes do not."""

MJCF_ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
"""Attributes of MJCF that orient a frame."""


class _MjcfReader:
    """Reader of the bodies of an MJCF file, with the unit of angles and the joint defaults of the file."""

    def __init__(self, root: Element):
        self.records: list[LinkRecord] = []
        self.angle_unit, self.joint_defaults = np.pi / 180.0, dict[str, str]()
        for compiler in root.findall("compiler"):
            for name, value in compiler.attrib.items():
                if name not in MJCF_COMPILER_IGNORED and MJCF_COMPILER_DEFAULTS.get(name) != value:
                    raise InputError(f"{name}={value!r} of the compiler is not covered")
            if (angle := compiler.get("angle")) is not None:  # one compiler element does not undo another one
                if angle not in ("degree", "radian"):
                    raise InputError(f"angle of the compiler must be degree or radian, got {angle!r}")
                self.angle_unit = 1.0 if angle == "radian" else np.pi / 180.0
            if compiler.get("inertiafromgeom", "auto") == "true":
                raise InputError("inertiafromgeom='true' is not covered. Give each body an inertial element")
        for default in root.findall("default"):
            _refuse_unknown_children(default, "default", {"joint"}, MJCF_SHAPES | {"mesh", "material", "pair"})
            if default.get("class", "main") != "main":
                raise InputError(f"class={default.get('class')!r} of default is not covered")
            for joint in default.findall("joint"):
                self.joint_defaults |= joint.attrib

    def add_body(self, body: Element, parent: str | None) -> None:
        """Append a body, and recursively the bodies in it, to the records."""
        name = body.get("name") or f"body {len(self.records) + 1}"
        _refuse_unknown_children(body, f"body {name!r}", {"inertial", "joint", "freejoint", "body"}, MJCF_SHAPES)
        covered = {"name", "pos", "mocap", "gravcomp", "user", "sleep", *MJCF_ORIENTATIONS}
        _refuse_unknown_attributes(body, f"the body {name!r}", covered)
        if body.get("mocap", "false") != "false":
            raise InputError(f"mocap of the body {name!r} is not covered")
        _refuse_nonzero_attribute(body, "gravcomp", f"the body {name!r}")
        joints = body.findall("joint")
        is_free = _has_free_joint(body)
        if is_free != (parent is None) or (is_free and len(joints) + len(body.findall("freejoint")) != 1):
            raise InputError(
                f"the body {name!r} must have no free joint, which belongs to the base" if is_free
                else f"the body {name!r} is the base, which needs a freejoint and no other joint"
            )  # fmt: skip
        if is_free:
            self._check_free_joint(body, name)
        inertial = _optional_only_child(body, "inertial")
        if inertial is None:
            raise InputError(f"the body {name!r} needs an inertial element, since inertias of shapes are not computed")
        R, centre = self._read_frame(inertial)
        inertia = R @ _read_mjcf_inertia(inertial, name) @ R.T
        rotation, origin = self._read_frame(body)
        records = () if is_free else tuple(self._read_joint(joint, name) for joint in joints)
        mass = _number_attribute(inertial, "mass")
        self.records.append(LinkRecord(name, parent, rotation, origin, mass, centre, inertia, records))
        for child in body.findall("body"):
            self.add_body(child, name)

    def _check_free_joint(self, body: Element, name: str) -> None:
        """Raise InputError if the free joint of a body has springs, dampers or an attribute that is not covered."""
        text = f"the free joint of {name!r}"
        joint, covered = body.find("freejoint"), {"name", "group", "align"}
        if joint is None:  # the defaults of joints do not act on a freejoint
            joint = Element("joint", self.joint_defaults | body.findall("joint")[0].attrib)
            covered = MJCF_JOINT_ATTRIBUTES | {*MJCF_FREE_JOINT_LOADS, "ref", "align"}
            for attribute in MJCF_FREE_JOINT_LOADS:
                _refuse_nonzero_attribute(joint, attribute, text)
        _refuse_unknown_attributes(joint, text, covered)
        if joint.get("align") == "true":
            raise InputError(f"align='true' of {text} is not covered, because it turns the axes of the base")

    def _read_joint(self, joint: Element, body: str) -> JointRecord:
        attributes = self.joint_defaults | joint.attrib
        joint = Element("joint", attributes)
        joint_text, kind = f"the joint {attributes.get('name', 'of ' + body)!r}", attributes.get("type", "hinge")
        if kind not in ("hinge", "slide"):
            raise InputError(
                f"{joint_text} is of type {kind!r}, which is not covered. Supported types are hinge and slide"
            )
        for attribute in ("armature", "frictionloss", "springdamper", "ref"):
            _refuse_nonzero_attribute(joint, attribute, joint_text)
        covered = MJCF_JOINT_ATTRIBUTES | {"armature", "frictionloss", "springdamper", "ref"}
        _refuse_unknown_attributes(joint, joint_text, covered)
        unit = self.angle_unit if kind == "hinge" else 1.0
        return JointRecord(
            kind == "slide",
            _number_array_attribute(joint, "pos", 3, np.zeros(3)),
            _number_array_attribute(joint, "axis", 3, np.array([0.0, 0.0, 1.0])),
            _number_attribute(joint, "stiffness", 0.0),
            _number_attribute(joint, "damping", 0.0),
            unit * _number_attribute(joint, "springref", 0.0),
        )

    def _read_frame(self, element: Element) -> tuple[np.ndarray, np.ndarray]:
        """Read the frame of an MJCF element; return the rotation, shape (3, 3), and the position, shape (3,)."""
        position = _number_array_attribute(element, "pos", 3, np.zeros(3))
        kinds = [kind for kind in MJCF_ORIENTATIONS if kind in element.attrib]
        if len(kinds) > 1:
            raise InputError(
                f"{element.tag} must have at most one attribute for its orientation, got {' and '.join(kinds)}"
            )
        if not kinds:
            return np.eye(3), position
        if kinds[0] == "quat":
            quaternion = _number_array_attribute(element, "quat", 4)
            if not quaternion.any():
                raise InputError(f"quat of {element.tag!r} must not be zero")
            return Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), position
        if kinds[0] == "axisangle":
            *axis, angle = _number_array_attribute(element, "axisangle", 4)
            if not any(axis):
                raise InputError(f"the axis in axisangle of {element.tag!r} must not be zero")
            direction = np.array(axis) / np.linalg.norm(axis)
            return Rotation.from_rotvec(self.angle_unit * angle * direction).as_matrix(), position
        if kinds[0] == "euler":
            angles = self.angle_unit * _number_array_attribute(element, "euler", 3)
            return Rotation.from_euler("XYZ", angles).as_matrix(), position  # eulerseq="xyz" means rotating axes
        raise InputError(f"the orientation of {element.tag} must be quat, axisangle or euler, got {kinds[0]}")


def _read_mjcf_inertia(inertial: Element, name: str) -> np.ndarray:
    """Read the tensor of inertia of an MJCF body in axes of the inertial frame, shape (3, 3)."""
    attributes = ("diaginertia", "fullinertia", *MJCF_ORIENTATIONS)
    _refuse_unknown_attributes(inertial, f"the inertial of {name!r}", {"pos", "mass", *attributes})
    others = [key for key in attributes if key != "fullinertia" and key in inertial.attrib]
    if "fullinertia" in inertial.attrib and others:
        raise InputError(f"the inertial of {name!r} must not have {others[0]} beside fullinertia")
    if "fullinertia" in inertial.attrib:
        return _symmetric_matrix(*_number_array_attribute(inertial, "fullinertia", 6))
    if "diaginertia" in inertial.attrib:
        return np.diag(_number_array_attribute(inertial, "diaginertia", 3))
    raise InputError(f"the inertial of {name!r} needs diaginertia or fullinertia")


def _symmetric_matrix(xx, yy, zz, xy, xz, yz) -> np.ndarray:
    """Return the symmetric 3 by 3 matrix with the given entries."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# -- from links to bodies ---------------------------------------------------------------------------------------------


class _RigidLinkGroup:
    """Links that are fixed to each other and so make one rigid body, in axes parallel to those of the base."""

    def __init__(self, name: str, parent: str | None, at: np.ndarray, joints: tuple[JointRecord, ...]):
        self.name, self.parent, self.at, self.joints = name, parent, at, joints
        self.masses: list[float] = []
        self.centres: list[np.ndarray] = []
        self.inertias: list[np.ndarray] = []

    def to_body_record(self, joint: Joint | None) -> BodyRecord:
        """Return the rigid body that the links make, with their total mass and inertia."""
        total_mass = sum(self.masses)
        centre = np.asarray(self.masses) @ np.asarray(self.centres) / total_mass
        inertia = np.zeros((3, 3))
        for m, c, J in zip(self.masses, self.centres, self.inertias, strict=True):
            r = c - centre
            inertia += J + m * (r @ r * np.eye(3) - np.outer(r, r))
        return BodyRecord(self.name, total_mass, centre, inertia, self.parent, joint)


def _merge_fixed_links(links: list[LinkRecord], has_ground: bool) -> list[BodyRecord]:
    """Merge links without a joint into their parents, and return the bodies; parents come before their children.

    If the base is the ground, its mass and inertia are zero.
    """
    groups: dict[str, _RigidLinkGroup] = {}
    frames: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}  # group, rotation and origin in it, of each link
    for link in links:
        if link.name in frames:
            raise InputError(f"two bodies have the name {link.name!r}")
        if link.parent is None:
            group_name, R, origin = link.name, np.eye(3), np.zeros(3)
            groups[link.name] = _RigidLinkGroup(link.name, None, np.zeros(3), ())
        else:
            group_name, R, origin = frames[link.parent]
            R, origin = R @ link.rotation, origin + R @ link.origin
            if link.joints:
                position = R @ _common_joint_position(link)
                rotated = tuple(joint._replace(axis=R @ joint.axis) for joint in link.joints)
                groups[link.name] = _RigidLinkGroup(link.name, group_name, origin + position, rotated)
                group_name, origin = link.name, -position
        frames[link.name] = group_name, R, origin
        group = groups[group_name]
        if link.mass < 0.0:
            raise InputError(f"the mass of {link.name!r} must be positive, got {link.mass:g}")
        if link.mass > 0.0:
            group.masses.append(link.mass)
            group.centres.append(origin + R @ link.centre)
            group.inertias.append(R @ link.inertia @ R.T)
        elif np.any(link.inertia):
            raise InputError(f"{link.name!r} has an inertia but no mass")
    return _body_records(groups, has_ground)


def _common_joint_position(link: LinkRecord) -> np.ndarray:
    """Return the common position of all joints of a link, shape (3,); raise InputError if they differ."""
    position = link.joints[0].position
    for joint in link.joints[1:]:
        if not np.allclose(joint.position, position, rtol=COINCIDENCE_RTOL, atol=0.0):
            raise InputError(f"the joints of {link.name!r} are at different places, which is not covered")
    return position


def _body_records(groups: dict[str, _RigidLinkGroup], has_ground: bool) -> list[BodyRecord]:
    """Return the body records of link groups; a massless body between two hinges at a point becomes a universal
    joint."""
    records = []
    for group in groups.values():
        is_ground = has_ground and group.parent is None
        if is_ground:
            zero = np.zeros(3)
            records.append(BodyRecord(group.name, 0.0, zero, np.zeros((3, 3)), None, None))
        elif not group.masses:
            children = [child for child in groups.values() if child.parent == group.name]
            if group.parent is None or len(children) != 1 or not _can_form_universal_joint(group, children[0]):
                raise InputError(
                    f"the body {group.name!r} has no mass. A massless body is covered if it is fixed in another one, "
                    "or stands between two hinges at one place"
                )
            child = children[0]
            child.parent, child.at, child.joints = group.parent, group.at, group.joints + child.joints
    for group in groups.values():
        if group.masses and not (has_ground and group.parent is None):
            records.append(group.to_body_record(None if group.parent is None else _make_joint_of_body(group)))
    return records


def _can_form_universal_joint(group: _RigidLinkGroup, child: _RigidLinkGroup) -> bool:
    """Return True if the hinges of a massless body and of its child make a universal joint."""
    is_hinge_pair = len(group.joints) == len(child.joints) == 1 and not (
        group.joints[0].slides or child.joints[0].slides
    )
    return is_hinge_pair and float(np.abs(child.at).max()) <= COINCIDENCE_RTOL * float(np.abs(group.at).max())


def _make_joint_of_body(group: _RigidLinkGroup) -> Joint:
    """Make the joint of a body; raise InputError, with the name of the body, if the joint cannot be used."""
    try:
        return _make_joint(group)
    except InputError as error:
        raise InputError(f"the joint of {group.name!r} cannot be used: {error}") from error


def _make_joint(group: _RigidLinkGroup) -> Joint:
    """Make the joint of a group from its records: a hinge, a slider or a universal joint.

    Raises
    ------
    InputError
        If the joints of the group are another combination.
    """
    joints = group.joints
    if len(joints) == 1:
        joint = joints[0]
        joint_class = Slider if joint.slides else Hinge
        return joint_class(group.at, joint.axis, joint.stiffness, joint.damping, joint.rest)
    if len(joints) == 2 and not any(joint.slides for joint in joints):
        axes, stiffness, damping, rests = (
            [getattr(joint, name) for joint in joints] for name in ("axis", "stiffness", "damping", "rest")
        )
        return Universal(group.at, axes, stiffness, damping, rests)
    kinds = " and ".join("slide" if joint.slides else "hinge" for joint in joints)
    raise InputError(
        f"a body with the joints {kinds} is not covered. A body may have one hinge, one slide or two hinges"
    )


# -- XML --------------------------------------------------------------------------------------------------------------


def _read_xml_root(source: str | os.PathLike, root_tag: str, format_name: str) -> Element:
    """Parse an XML file, or a text that begins with ``<``, and return its root element.

    Raises
    ------
    FileError, InputError
        If the file cannot be read, the XML is not well-formed or declares entities, or the root has another tag.
    """
    if isinstance(source, str) and source.lstrip().startswith("<"):
        text = source
    else:
        path = checked_path(source, "the source")
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise FileError(
                f"cannot read the {format_name} file {os.fspath(source)!r:.200}: {error.strerror}"
            ) from error
        except (UnicodeDecodeError, TypeError, ValueError) as error:
            raise FileError(f"cannot read the {format_name} file {source!r:.200}: {error}") from error
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"a {format_name} file must not declare entities or a document type")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"the {format_name} text is not well-formed XML: {error}") from error
    if root.tag != root_tag:
        raise InputError(f"a {format_name} file must have the root element {root_tag!r}, got {root.tag!r}")
    return root


def _refuse_unknown_children(
    element: Element, element_text: str, covered_tags: set[str], ignored_tags: set[str]
) -> None:
    """Raise InputError if an XML element has a child whose tag is neither covered nor ignored."""
    for child in element:
        if isinstance(child.tag, str) and child.tag not in covered_tags | ignored_tags:
            raise InputError(
                f"the element {child.tag!r} in {element_text} is not covered. Remove it if it does not matter, or "
                "build the tree with lt.bodies.Tree"
            )


def _refuse_unknown_attributes(element: Element, element_text: str, covered_attributes: set[str]) -> None:
    """Raise InputError if an XML element has an attribute that is not covered."""
    if unknown := sorted(set(element.attrib) - covered_attributes):
        raise InputError(f"the attribute {unknown[0]!r} of {element_text} is not covered")


def _refuse_nonzero_attribute(element: Element, attribute_name: str, owner_text: str) -> None:
    """Raise InputError if an XML attribute has a value that is not zero."""
    if (
        attribute_name in element.attrib
        and _number_array_attribute(element, attribute_name, len(element.attrib[attribute_name].split())).any()
    ):
        raise InputError(f"{attribute_name} of {owner_text} must be zero, got {element.attrib[attribute_name]!r}")


def _required_only_child(element: Element, tag: str) -> Element:
    """Return the child of an XML element with this tag; raise InputError unless there is exactly one."""
    children = element.findall(tag)
    if len(children) != 1:
        raise InputError(f"{_element_text(element)} must have one {tag!r}, got {len(children)}")
    return children[0]


def _optional_only_child(element: Element, tag: str) -> Element | None:
    """Return the child of an XML element with this tag, or None; raise InputError if there are several."""
    children = element.findall(tag)
    if len(children) > 1:
        raise InputError(f"{_element_text(element)} must have at most one {tag!r}, got {len(children)}")
    return children[0] if children else None


def _element_text(element: Element) -> str:
    """Return the tag of an XML element, and its name if it has one."""
    name = element.get("name")
    return element.tag if name is None else f"{element.tag} {name!r}"


def _required_attribute(element: Element, attribute_name: str) -> str:
    """Return an attribute of an XML element as text; raise InputError if it is missing."""
    if attribute_name not in element.attrib:
        raise InputError(f"the element {element.tag!r} needs the attribute {attribute_name!r}")
    return element.attrib[attribute_name]


def _number_array_attribute(
    element: Element, attribute_name: str, count: int, default: np.ndarray | None = None
) -> np.ndarray:
    """Parse an XML attribute as finite numbers, shape (count,), or return the default if it is missing.

    Raises
    ------
    InputError
        If the numbers are not finite or not ``count`` ones, or the attribute is missing and has no default.
    """
    if default is not None and attribute_name not in element.attrib:
        return default
    text = _required_attribute(element, attribute_name)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        raise InputError(f"{attribute_name} of {element.tag!r} must be numbers, got {text!r}") from None
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InputError(f"{attribute_name} of {element.tag!r} must be {count} finite numbers, got {text!r}")
    return numbers


def _number_attribute(element: Element, attribute_name: str, default: float | None = None) -> float:
    default_array = None if default is None else np.array([default])
    return float(_number_array_attribute(element, attribute_name, 1, default_array)[0])
