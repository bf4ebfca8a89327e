"""Reading trees of rigid bodies from URDF and MJCF files."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

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
    """Return the bodies of a URDF file or text, from the base outwards; see :meth:`.Tree.from_urdf`.

    If the base is fixed, its mass is zero.
    """
    robot = _read_root(source, "robot", "URDF")
    _refuse_children(robot, "robot", {"link", "joint"}, URDF_SHAPES | {"transmission"})
    links = {_attribute(link, "name"): link for link in robot.findall("link")}
    joint_of: dict[str, Element] = {}
    for joint in robot.findall("joint"):
        kind, name = _attribute(joint, "type"), _attribute(joint, "name")
        if kind not in URDF_JOINTS:
            raise InputError(
                f"the joint {name!r} is of type {kind!r}, which is not covered. The types that are: "
                f"{', '.join(URDF_JOINTS)}"
            )
        parent, child = (_attribute(_child(joint, tag), "link") for tag in ("parent", "child"))
        for link in (parent, child):
            if link not in links:
                raise InputError(f"the joint {name!r} names the link {link!r}, which the file does not have")
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
        records.append(_urdf_link(name, links[name], joint_of.get(name)))
        names += [child for child, joint in joint_of.items() if _attribute(_child(joint, "parent"), "link") == name]
    if len(records) < len(links):
        rest = sorted(set(links) - {record.name for record in records})
        raise InputError(f"the links {', '.join(rest)} are in a loop of joints, so they are not a tree")
    return _assemble(records, fixed_base)


URDF_SHAPES = {"visual", "collision", "material"}
"""Elements of URDF that do not act on the motion of a free tree."""

URDF_JOINTS = ("revolute", "continuous", "prismatic", "fixed")
"""Types of joints of URDF that are covered."""


def _urdf_link(name: str, link: Element, joint: Element | None) -> LinkRecord:
    _refuse_children(link, f"link {name!r}", {"inertial"}, URDF_SHAPES)
    mass, centre, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    if (inertial := link.find("inertial")) is not None:
        _refuse_children(inertial, f"inertial of {name!r}", {"origin", "mass", "inertia"}, set())
        mass = _number(_child(inertial, "mass"), "value")
        entries = {key: _number(_child(inertial, "inertia"), key) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")}
        R, centre = _urdf_origin(inertial)
        inertia = R @ _symmetric(*entries.values()) @ R.T
    if joint is None:
        return LinkRecord(name, None, np.eye(3), np.zeros(3), mass, centre, inertia, ())
    joint_name, kind = _attribute(joint, "name"), _attribute(joint, "type")
    covered = {"parent", "child", "origin", "axis", "dynamics"}
    _refuse_children(joint, f"joint {joint_name!r}", covered, {"limit", "calibration", "safety_controller"})
    rotation, origin = _urdf_origin(joint)
    joints: tuple[JointRecord, ...] = ()
    if kind != "fixed":
        axis, dynamics = joint.find("axis"), joint.find("dynamics")
        direction = np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis, "xyz", 3)
        damping = 0.0
        if dynamics is not None:
            damping = _number(dynamics, "damping", 0.0)
            _refuse_nonzero(dynamics, "friction", f"dynamics of the joint {joint_name!r}")
        joints = (JointRecord(kind == "prismatic", np.zeros(3), direction, 0.0, damping, 0.0),)
    parent = _attribute(_child(joint, "parent"), "link")
    return LinkRecord(name, parent, rotation, origin, mass, centre, inertia, joints)


def _urdf_origin(element: Element) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation and the position of the ``origin`` of an element."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    angles = _numbers(origin, "rpy", 3, np.zeros(3))
    return Rotation.from_euler("xyz", angles).as_matrix(), _numbers(origin, "xyz", 3, np.zeros(3))


GROUND_NAME = "world"
"""Name of the ground in MJCF files."""


def read_mjcf(source: str | os.PathLike) -> tuple[list[BodyRecord], bool]:
    """Return the bodies of an MJCF file or text, from the base outwards, and whether the base is the ground.

    See :meth:`.Tree.from_mjcf`.
    """
    root = _read_root(source, "mujoco", "MJCF")
    covered = {"compiler", "option", "default", "worldbody"}
    _refuse_children(root, "mujoco", covered, MJCF_SETTINGS)
    for option in root.findall("option"):
        for name in ("density", "viscosity", "wind"):
            _refuse_nonzero(option, name, "option")
    reader = _MjcfReader(root)
    world = _child(root, "worldbody")
    _refuse_children(world, "worldbody", {"body"}, MJCF_SHAPES)
    bodies = world.findall("body")
    if not bodies:
        raise InputError("worldbody must have a body, got none")
    has_ground = not any(_is_free(body) for body in bodies)
    if has_ground:
        zero = np.zeros(3)
        reader.records.append(LinkRecord(GROUND_NAME, None, np.eye(3), zero, 0.0, zero, np.zeros((3, 3)), ()))
    elif len(bodies) != 1:
        raise InputError(f"a free base must be the only body of worldbody, got {len(bodies)} bodies")
    for body in bodies:
        reader.add_body(body, GROUND_NAME if has_ground else None)
    return _assemble(reader.records, has_ground), has_ground


def _is_free(body: Element) -> bool:
    """Return whether a body of an MJCF file has a free joint."""
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

MJCF_ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
"""Attributes of MJCF that orient a frame."""


class _MjcfReader:
    """The bodies of an MJCF file, with its units of angles and its defaults."""

    def __init__(self, root: Element):
        self.records: list[LinkRecord] = []
        self.angle_unit, self.joint_defaults = np.pi / 180.0, dict[str, str]()
        for compiler in root.findall("compiler"):
            for name, value in compiler.attrib.items():
                if name not in MJCF_COMPILER_IGNORED and MJCF_COMPILER_DEFAULTS.get(name) != value:
                    raise InputError(f"{name}={value!r} of the compiler is not covered")
            angle = compiler.get("angle", "degree")
            if angle not in ("degree", "radian"):
                raise InputError(f"angle of the compiler must be degree or radian, got {angle!r}")
            self.angle_unit = 1.0 if angle == "radian" else np.pi / 180.0
            if compiler.get("inertiafromgeom", "auto") == "true":
                raise InputError("inertiafromgeom='true' is not covered. Give each body an inertial element")
        for default in root.findall("default"):
            _refuse_children(default, "default", {"joint"}, MJCF_SHAPES | {"mesh", "material", "pair"})
            for joint in default.findall("joint"):
                self.joint_defaults |= joint.attrib

    def add_body(self, body: Element, parent: str | None) -> None:
        """Append a body and the bodies in it to the records."""
        name = body.get("name") or f"body {len(self.records) + 1}"
        _refuse_children(body, f"body {name!r}", {"inertial", "joint", "freejoint", "body"}, MJCF_SHAPES)
        for attribute in ("childclass", "mocap", "gravcomp"):
            if body.get(attribute) not in (None, "false", "0"):
                raise InputError(f"{attribute} of the body {name!r} is not covered")
        joints = body.findall("joint")
        is_free = _is_free(body)
        if is_free != (parent is None) or (is_free and len(joints) + len(body.findall("freejoint")) != 1):
            raise InputError(
                f"the body {name!r} must have no free joint, which belongs to the base" if is_free
                else f"the body {name!r} is the base, which needs a freejoint and no other joint"
            )  # fmt: skip
        inertial = body.find("inertial")
        if inertial is None:
            raise InputError(f"the body {name!r} needs an inertial element, since inertias of shapes are not computed")
        R, centre = self._frame(inertial)
        inertia = R @ _mjcf_inertia(inertial, name) @ R.T
        rotation, origin = self._frame(body)
        records = () if is_free else tuple(self._joint(joint, name) for joint in joints)
        mass = _number(inertial, "mass")
        self.records.append(LinkRecord(name, parent, rotation, origin, mass, centre, inertia, records))
        for child in body.findall("body"):
            self.add_body(child, name)

    def _joint(self, joint: Element, body: str) -> JointRecord:
        attributes = self.joint_defaults | joint.attrib
        joint = Element("joint", attributes)
        what, kind = f"the joint {attributes.get('name', 'of ' + body)!r}", attributes.get("type", "hinge")
        if kind not in ("hinge", "slide"):
            raise InputError(f"{what} is of type {kind!r}, which is not covered. Supported types are hinge and slide")
        for attribute in ("armature", "frictionloss", "springdamper", "ref"):
            _refuse_nonzero(joint, attribute, what)
        ignored = MJCF_JOINT_ATTRIBUTES | {"armature", "frictionloss", "springdamper", "ref"}
        if unknown := sorted(set(attributes) - ignored):
            raise InputError(f"the attribute {unknown[0]!r} of {what} is not covered")
        unit = self.angle_unit if kind == "hinge" else 1.0
        return JointRecord(
            kind == "slide",
            _numbers(joint, "pos", 3, np.zeros(3)),
            _numbers(joint, "axis", 3, np.array([0.0, 0.0, 1.0])),
            _number(joint, "stiffness", 0.0),
            _number(joint, "damping", 0.0),
            unit * _number(joint, "springref", 0.0),
        )

    def _frame(self, element: Element) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation and the position of the frame of an element."""
        position = _numbers(element, "pos", 3, np.zeros(3))
        kinds = [kind for kind in MJCF_ORIENTATIONS if kind in element.attrib]
        if len(kinds) > 1:
            raise InputError(
                f"{element.tag} must have at most one attribute for its orientation, got {' and '.join(kinds)}"
            )
        if not kinds:
            return np.eye(3), position
        if kinds[0] == "quat":
            return Rotation.from_quat(np.roll(_numbers(element, "quat", 4), -1)).as_matrix(), position
        if kinds[0] == "axisangle":
            *axis, angle = _numbers(element, "axisangle", 4)
            direction = np.array(axis) / np.linalg.norm(axis)
            return Rotation.from_rotvec(self.angle_unit * angle * direction).as_matrix(), position
        if kinds[0] == "euler":
            angles = self.angle_unit * _numbers(element, "euler", 3)
            return Rotation.from_euler("XYZ", angles).as_matrix(), position  # eulerseq="xyz" means rotating axes
        raise InputError(f"the orientation of {element.tag} must be quat, axisangle or euler, got {kinds[0]}")


def _mjcf_inertia(inertial: Element, name: str) -> np.ndarray:
    """Return the tensor of inertia in axes of the inertial frame, shape (3, 3)."""
    if "fullinertia" in inertial.attrib:
        return _symmetric(*_numbers(inertial, "fullinertia", 6))
    if "diaginertia" in inertial.attrib:
        return np.diag(_numbers(inertial, "diaginertia", 3))
    raise InputError(f"the inertial of {name!r} needs diaginertia or fullinertia")


def _symmetric(xx, yy, zz, xy, xz, yz) -> np.ndarray:
    """Return a symmetric tensor from its entries."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# -- from links to bodies ---------------------------------------------------------------------------------------------


class _Group:
    """Links that are fixed in each other, which are one body; axes are parallel to those of the base."""

    def __init__(self, name: str, parent: str | None, at: np.ndarray, joints: tuple[JointRecord, ...]):
        self.name, self.parent, self.at, self.joints = name, parent, at, joints
        self.masses: list[float] = []
        self.centres: list[np.ndarray] = []
        self.inertias: list[np.ndarray] = []

    def record(self, joint: Joint | None) -> BodyRecord:
        """Return the body: the sum of its links."""
        total = sum(self.masses)
        centre = np.asarray(self.masses) @ np.asarray(self.centres) / total
        inertia = np.zeros((3, 3))
        for m, c, J in zip(self.masses, self.centres, self.inertias, strict=True):
            r = c - centre
            inertia += J + m * (r @ r * np.eye(3) - np.outer(r, r))
        return BodyRecord(self.name, total, centre, inertia, self.parent, joint)


def _assemble(links: list[LinkRecord], has_ground: bool) -> list[BodyRecord]:
    """Return the bodies of links that are listed from the base outwards; links without a joint merge with theirs.

    If the base is the ground, its mass and inertia are zero.
    """
    groups: dict[str, _Group] = {}
    frames: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}  # group, rotation and origin in it, of each link
    for link in links:
        if link.name in frames:
            raise InputError(f"two bodies have the name {link.name!r}")
        if link.parent is None:
            group_name, R, origin = link.name, np.eye(3), np.zeros(3)
            groups[link.name] = _Group(link.name, None, np.zeros(3), ())
        else:
            group_name, R, origin = frames[link.parent]
            R, origin = R @ link.rotation, origin + R @ link.origin
            if link.joints:
                position = R @ _common_position(link)
                rotated = tuple(joint._replace(axis=R @ joint.axis) for joint in link.joints)
                groups[link.name] = _Group(link.name, group_name, origin + position, rotated)
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
    return _records(groups, has_ground)


def _common_position(link: LinkRecord) -> np.ndarray:
    """Return the point where all joints of a link act."""
    position = link.joints[0].position
    for joint in link.joints[1:]:
        if not np.allclose(joint.position, position, rtol=COINCIDENCE_RTOL, atol=0.0):
            raise InputError(f"the joints of {link.name!r} are at different places, which is not covered")
    return position


def _records(groups: dict[str, _Group], has_ground: bool) -> list[BodyRecord]:
    """Return the bodies; a massless one between two hinges whose axes meet makes them a universal joint."""
    records = []
    for group in groups.values():
        is_ground = has_ground and group.parent is None
        if is_ground:
            zero = np.zeros(3)
            records.append(BodyRecord(group.name, 0.0, zero, np.zeros((3, 3)), None, None))
        elif not group.masses:
            children = [child for child in groups.values() if child.parent == group.name]
            if group.parent is None or len(children) != 1 or not _can_merge(group, children[0]):
                raise InputError(
                    f"the body {group.name!r} has no mass. A massless body is covered if it is fixed in another one, "
                    "or stands between two hinges at one place"
                )
            child = children[0]
            child.parent, child.at, child.joints = group.parent, group.at, group.joints + child.joints
    for group in groups.values():
        if group.masses and not (has_ground and group.parent is None):
            records.append(group.record(None if group.parent is None else _named_joint(group)))
    return records


def _can_merge(group: _Group, child: _Group) -> bool:
    """Return True if the joints of a massless body and of its child make a universal joint."""
    is_hinge_pair = len(group.joints) == len(child.joints) == 1 and not (
        group.joints[0].slides or child.joints[0].slides
    )
    return is_hinge_pair and float(np.abs(child.at).max()) <= COINCIDENCE_RTOL * float(np.abs(group.at).max())


def _named_joint(group: _Group) -> Joint:
    """Return the joint of a body; InputError with the name of the body if its joint cannot be used."""
    try:
        return _joint_of(group)
    except InputError as error:
        raise InputError(f"the joint of {group.name!r} cannot be used: {error}") from error


def _joint_of(group: _Group) -> Joint:
    """Return the joint of a body."""
    joints = group.joints
    if len(joints) == 1:
        joint = joints[0]
        kind = Slider if joint.slides else Hinge
        return kind(group.at, joint.axis, joint.stiffness, joint.damping, joint.rest)
    if len(joints) == 2 and not any(joint.slides for joint in joints):
        axes, stiffness, damping, rests = (
            [getattr(joint, name) for joint in joints] for name in ("axis", "stiffness", "damping", "rest")
        )
        return Universal(group.at, axes, stiffness, damping, rests)
    kinds = " and ".join("slide" if joint.slides else "hinge" for joint in joints)
    raise InputError(
        f"the joints {kinds} together are not covered. The combinations that are: one hinge, one slide, two hinges"
    )


# -- XML --------------------------------------------------------------------------------------------------------------


def _read_root(source: str | os.PathLike, tag: str, kind: str) -> Element:
    """Return the root element of a file, or of a text that begins with ``<``."""
    if isinstance(source, str) and source.lstrip().startswith("<"):
        text = source
    else:
        try:
            text = Path(source).read_text(encoding="utf-8")
        except OSError as error:
            raise FileError(f"cannot read the {kind} file {os.fspath(source)!r:.200}: {error.strerror}") from error
        except (UnicodeDecodeError, TypeError, ValueError) as error:
            raise FileError(f"cannot read the {kind} file {source!r:.200}: {error}") from error
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"a {kind} file must not declare entities or a document type")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"the {kind} text is not well-formed XML: {error}") from error
    if root.tag != tag:
        raise InputError(f"a {kind} file must have the root element {tag!r}, got {root.tag!r}")
    return root


def _refuse_children(element: Element, what: str, covered: set[str], ignored: set[str]) -> None:
    """Raise InputError if an element has a child of another kind."""
    for child in element:
        if isinstance(child.tag, str) and child.tag not in covered | ignored:
            raise InputError(
                f"the element {child.tag!r} in {what} is not covered. Remove it if it does not matter, or build the "
                "tree with lt.bodies.Tree"
            )


def _refuse_nonzero(element: Element, name: str, what: str) -> None:
    """Raise InputError if an attribute has a value that is not zero."""
    if name in element.attrib and _numbers(element, name, len(element.attrib[name].split())).any():
        raise InputError(f"{name} of {what} must be zero, got {element.attrib[name]!r}")


def _child(element: Element, tag: str) -> Element:
    children = element.findall(tag)
    if len(children) != 1:
        name = element.get("name")
        where = element.tag if name is None else f"{element.tag} {name!r}"
        raise InputError(f"{where} must have one {tag!r}, got {len(children)}")
    return children[0]


def _attribute(element: Element, name: str) -> str:
    if name not in element.attrib:
        raise InputError(f"the element {element.tag!r} needs the attribute {name!r}")
    return element.attrib[name]


def _numbers(element: Element, name: str, count: int, default: np.ndarray | None = None) -> np.ndarray:
    """Return the numbers of an attribute, shape (count,)."""
    if default is not None and name not in element.attrib:
        return default
    text = _attribute(element, name)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        raise InputError(f"{name} of {element.tag!r} must be numbers, got {text!r}") from None
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InputError(f"{name} of {element.tag!r} must be {count} finite numbers, got {text!r}")
    return numbers


def _number(element: Element, name: str, default: float | None = None) -> float:
    fallback = None if default is None else np.array([default])
    return float(_numbers(element, name, 1, fallback)[0])
