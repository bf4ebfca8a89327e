"""Trees read from URDF and MJCF beside the same trees built by hand, and the elements that are refused."""

import jax
import numpy as np
import pytest

import liethermo as lt

URDF = """<?xml version="1.0"?>
<robot name="satellite">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="bus">
    <visual><geometry><box size="1 1 1"/></geometry></visual>
    <inertial><mass value="10"/><inertia ixx="3" iyy="2" izz="1.5" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="yoke"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="panel">
    <inertial><origin xyz="0.8 0 0" rpy="0 0 1.5707963267948966"/><mass value="2"/>
      <inertia ixx="0.05" iyy="0.4" izz="0.42" ixy="0.01" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="mass"><inertial><mass value="0.3"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="fixed" type="fixed"><parent link="bus"/><child link="yoke"/>
    <origin xyz="0.5 0 0" rpy="1.5707963267948966 0 0"/></joint>
  <joint name="hinge" type="revolute"><parent link="yoke"/><child link="panel"/><origin xyz="0.2 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/><dynamics damping="0.3"/></joint>
  <joint name="rail" type="prismatic"><parent link="panel"/><child link="mass"/><origin xyz="1 0 0"/>
    <axis xyz="0 1 0"/></joint>
</robot>"""

MJCF = """<mujoco model="satellite">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81" timestep="0.001"/>
  <default><joint damping="0.3"/></default>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="bus" pos="0 0 2"><freejoint/>
      <inertial pos="0 0 0" mass="10" diaginertia="3 2 1.5"/>
      <geom type="box" size="1 1 1"/>
      <body name="panel" pos="0.5 0.1 0" quat="0.7071067811865476 0.7071067811865476 0 0">
        <joint type="hinge" axis="0 0 -1" pos="0.1 0 0" stiffness="4" springref="0.2"/>
        <inertial pos="0.8 0 0" mass="2" fullinertia="0.05 0.4 0.42 0.01 0 0"/>
        <body name="tip" pos="1.5 0 0">
          <joint axis="1 0 0" damping="0"/><joint axis="0 1 0" damping="0.1"/>
          <inertial pos="0 0 0.3" mass="1" diaginertia="0.01 0.03 0.03"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""


def assert_equal_motion(read, built, names):
    """The two trees have the same vector field at a random state."""
    rng = np.random.default_rng(0)
    a, b = (tree.system(attitude=False) for tree in (read, built))
    assert [name for name, _, _ in a.joint_ranges] == [name for name, _, _ in b.joint_ranges] == names
    x = rng.standard_normal(a.dim)
    field = jax.jit(b.vector_field)(x)
    assert np.allclose(jax.jit(a.vector_field)(x), field, rtol=0, atol=1e-12 * np.abs(field).max())
    assert float(a.energy(x)) == pytest.approx(float(b.energy(x)), rel=1e-13)


def test_a_urdf_file_is_the_tree_built_by_hand(tmp_path):
    tree = lt.bodies.Tree()
    mass, centre = 10.5, np.array([0.5 * 0.6 / 10.5, 0.0, 0.0])
    rest = lambda r: r @ r * np.eye(3) - np.outer(r, r)  # noqa: E731
    # the axes of the yoke are turned by 90 degrees about x, which swaps equal moments
    inertia = np.diag([3.0, 2.0, 1.5]) + 10.0 * rest(centre) + np.diag([0.01, 0.02, 0.02])
    inertia = inertia + 0.5 * rest(np.array([0.6, 0.0, 0.0]) - centre)
    tree.add("bus", mass, centre, inertia)
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    quarter = turn @ np.array([[0.0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]])
    tensor = quarter @ np.array([[0.05, 0.01, 0], [0.01, 0.4, 0], [0, 0, 0.42]]) @ quarter.T
    hinge = lt.bodies.Hinge((0.7, 0, 0), (0, -1, 0), damping=0.3)
    tree.add("panel", 2.0, (0.8, 0, 0), tensor, "bus", hinge)
    tree.add("mass", 0.3, parent="panel", joint=lt.bodies.Slider((1, 0, 0), (0, 0, 1)))
    assert_equal_motion(lt.bodies.Tree.from_urdf(URDF), tree, ["panel", "mass"])
    path = tmp_path / "satellite.urdf"
    path.write_text(URDF)
    assert lt.bodies.Tree.from_urdf(path).names == ("bus", "panel", "mass")


def test_an_mjcf_file_is_the_tree_built_by_hand():
    tree = lt.bodies.Tree()
    tree.add("bus", 10.0, inertia=(3.0, 2.0, 1.5))
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    tensor = turn @ np.array([[0.05, 0.01, 0], [0.01, 0.4, 0], [0, 0, 0.42]]) @ turn.T
    hinge = lt.bodies.Hinge((0.6, 0.1, 0), (0, 1, 0), stiffness=4.0, damping=0.3, rest_angle=0.2)
    tree.add("panel", 2.0, (0.7, 0, 0), tensor, "bus", hinge)
    joint = lt.bodies.Universal((1.4, 0, 0), [(1, 0, 0), (0, 0, 1)], damping=(0.0, 0.1))
    tree.add("tip", 1.0, turn @ [0, 0, 0.3], (0.01, 0.03, 0.03), "panel", joint)
    assert_equal_motion(lt.bodies.Tree.from_mjcf(MJCF), tree, ["panel", "tip"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (URDF.replace('type="revolute"', 'type="floating"'), "'floating', which is not covered"),
        (URDF.replace("</robot>", "<gazebo/></robot>"), "the element 'gazebo' in robot"),
        (URDF.replace('<child link="panel"/>', '<child link="bus"/>'), "a loop"),
        (URDF.replace('<dynamics damping="0.3"/>', '<dynamics friction="0.3"/>'), "friction of .* zero, got '0.3'"),
        (URDF.replace('<mass value="2"/>', '<mass value="0"/>'), "an inertia but no mass"),
        (URDF.replace("<axis xyz", "<axis ixyz"), "needs the attribute 'xyz'"),
        (URDF.replace('<parent link="yoke"/>', '<parent link="arm"/>'), "the link 'arm'"),
        (URDF.replace("</robot>", ""), "not well-formed XML"),
        (URDF.replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), "the joint of 'panel' cannot be used: the axis"),
        (URDF.replace('damping="0.3"', 'damping="-0.3"'), "the joint of 'panel' cannot be used: damping"),
        (URDF.replace('<joint name="fixed" type="fixed"><parent link="bus"/>',
                      '<joint name="ring" type="continuous"><parent link="mass"/>'), "are in a loop of joints"),
        (URDF.replace('iyy="0.4"', 'iyy="9"'), "no rigid body has the inertia of 'panel'"),
        ("<mujoco/>", "the root element 'robot'"),
        (URDF.replace('<link name="mass">', '<link name="panel"/><link name="mass">'), "two links .* 'panel'"),
        (URDF.replace('<dynamics damping="0.3"/>', '<dynamics damping="0.3" K="5"/>'), "K of .* must be zero, got '5'"),
        (URDF.replace('<origin xyz="0.2 0 0"/>', '<origin xyz="0.2 0 0" quat_xyzw="0 0 1 0"/>'),
         "'quat_xyzw' of the origin in joint 'hinge'"),
        (URDF.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><axis xyz="0 0 1"/>'), "at most one 'axis', got 2"),
        (URDF.replace('<origin xyz="1 0 0"/>', '<origin xyz="1 0 0"/><origin xyz="2 0 0"/>'), "at most one 'origin'"),
    ],
)  # fmt: skip
def test_urdf_that_is_not_covered_is_refused(text, message):
    with pytest.raises(lt.InputError, match=message):
        lt.bodies.Tree.from_urdf(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MJCF.replace('type="hinge"', 'type="ball"'), "'ball', which is not covered"),
        (MJCF.replace("</mujoco>", "<equality/></mujoco>"), "the element 'equality' in mujoco"),
        (MJCF.replace('name="tip"', 'name="tip" zaxis="0 1 0"'), "must be quat, axisangle or euler, got zaxis"),
        (MJCF.replace('axis="0 0 -1"', 'axis="0 0 0"'), "the joint of 'panel' cannot be used: the axis"),
        (MJCF.replace('mass="2"', 'mass="0"'), "'panel' has an inertia but no mass"),
        (MJCF.replace('diaginertia="3 2 1.5"', 'diaginertia="3 2 9"'), "no rigid body has the inertia of 'bus'"),
        (MJCF.replace('stiffness="4"', 'armature="4"'), "armature of .* must be zero, got '4'"),
        (MJCF.replace('stiffness="4"', 'class="big"'), "the attribute 'class'"),
        (MJCF.replace("<worldbody>", '<worldbody><body name="other"/>'), "must be the only body"),
        (MJCF.replace('timestep="0.001"', 'viscosity="0.1"'), "viscosity of option must be zero, got '0.1'"),
        (MJCF.replace('pos="0.8 0 0" mass', 'pos="0.8 0" mass'), "must be 3 finite numbers"),
        (MJCF.replace('<joint axis="1 0 0" damping="0"/>', '<joint type="slide" axis="1 0 0"/>'), "slide and hinge"),
        (MJCF.replace("<freejoint/>", '<joint type="free"/>'), "damping of the free joint of 'bus' must be zero"),
        *((MJCF.replace("<freejoint/>", f'<joint type="free" damping="0" {load}="0.5"/>'), f"{load} of the free joint")
          for load in ("armature", "stiffness", "frictionloss")),
        (MJCF.replace("<freejoint/>", '<freejoint align="true"/>'), "align='true' of the free joint of 'bus'"),
        (MJCF.replace("<default>", '<option><flag spring="disable"/></option><default>'), "spring='disable' of flag"),
        (MJCF.replace("<default>", '<option><flag damper="disable"/></option><default>'), "damper='disable' of flag"),
        (MJCF.replace("<default>", '<default class="stiff">'), "class='stiff' of default"),
        (MJCF.replace('quat="0.7071067811865476 0.7071067811865476 0 0"', 'quat="0 0 0 0"'), "quat of 'body' .* zero"),
        (MJCF.replace('name="tip"', 'name="tip" axisangle="0 0 0 1"'), "the axis in axisangle of 'body'"),
        (MJCF.replace('name="tip"', 'name="tip" position="0 0 1"'), "'position' of the body 'tip'"),
        (MJCF.replace('mass="10"', 'mass="10" density="3"'), "'density' of the inertial of 'bus'"),
        (MJCF.replace('fullinertia="', 'diaginertia="1 1 1" fullinertia="'), "'panel' .* not have diaginertia beside"),
        (MJCF.replace('fullinertia="', 'quat="1 1 0 0" fullinertia="'), "'panel' .* not have quat beside"),
        (MJCF.replace('<geom type="box" size="1 1 1"/>', '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'),
         "body 'bus' must have at most one 'inertial', got 2"),
        (MJCF.replace('name="tip"', 'name="tip" gravcomp="1"'), "gravcomp of the body 'tip'"),
        (MJCF.replace('name="tip"', 'name="tip" childclass="a"'), "the attribute 'childclass' of the body 'tip'"),
    ],
)  # fmt: skip
def test_mjcf_that_is_not_covered_is_refused(text, message):
    with pytest.raises(lt.InputError, match=message):
        lt.bodies.Tree.from_mjcf(text)


def test_settings_of_mjcf_in_several_elements_count_together():
    """MuJoCo merges sections that appear twice; what does not act on the motion is accepted."""
    text = MJCF.replace('<compiler angle="radian"/>', '<compiler angle="radian"/><compiler autolimits="true"/>')
    text = text.replace("<freejoint/>", '<joint type="free" damping="0" pos="1 2 3" ref="0"/>')
    text = text.replace('name="tip"', 'name="tip" gravcomp="0.0"')
    assert_equal_motion(lt.bodies.Tree.from_mjcf(text), lt.bodies.Tree.from_mjcf(MJCF), ["panel", "tip"])


def test_a_file_that_does_not_exist():
    with pytest.raises(lt.FileError, match="cannot read the URDF file"):
        lt.bodies.Tree.from_urdf("no such file.urdf")


def test_a_massless_link_between_two_hinges_is_a_universal_joint():
    text = URDF.replace("</robot>", """
      <link name="cross"/><link name="dish"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="a" type="continuous"><parent link="bus"/><child link="cross"/><origin xyz="0 0 0.5"/>
        <axis xyz="1 0 0"/></joint>
      <joint name="b" type="continuous"><parent link="cross"/><child link="dish"/><axis xyz="0 1 0"/></joint>
    </robot>""")  # fmt: skip
    system = lt.bodies.Tree.from_urdf(text).system()
    assert {name: end - start for name, start, end in system.joint_ranges} == {"panel": 1, "mass": 1, "dish": 2}
    with pytest.raises(lt.InputError, match="the body 'cross' has no mass"):
        lt.bodies.Tree.from_urdf(text.replace('<child link="dish"/>', '<child link="dish"/><origin xyz="0 0 0.1"/>'))


GROUND_MJCF = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="upper" pos="0 0 1"><joint type="hinge" axis="0 1 0" damping="0.1"/>
    <inertial pos="0 0 -0.5" mass="1" diaginertia="0.08 0.08 0.01"/>
    <body name="lower" pos="0 0 -1"><joint type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 -0.4" mass="0.7" diaginertia="0.05 0.05 0.01"/></body></body>
</worldbody></mujoco>"""
"""A double pendulum in the world, without a free joint."""

GROUND_URDF = """<robot name="arm"><link name="table"/>
  <link name="upper"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
    <inertia ixx="0.08" iyy="0.08" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.4"/><mass value="0.7"/>
    <inertia ixx="0.05" iyy="0.05" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="a" type="continuous"><parent link="table"/><child link="upper"/><origin xyz="0 0 1"/>
    <axis xyz="0 1 0"/><dynamics damping="0.1"/></joint>
  <joint name="b" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -1"/>
    <axis xyz="0 1 0"/></joint>
</robot>"""


def test_trees_on_the_ground():
    tree = lt.bodies.Tree(ground="floor")
    hinge = lt.bodies.Hinge((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), damping=0.1)
    tree.add("upper", 1.0, (0.0, 0.0, -0.5), (0.08, 0.08, 0.01), parent="floor", joint=hinge)
    elbow = lt.bodies.Hinge((0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
    tree.add("lower", 0.7, (0.0, 0.0, -0.4), (0.05, 0.05, 0.01), parent="upper", joint=elbow)
    system, x = tree.system(gravity=(0.0, 0.0, -9.81)), np.array([0.3, -0.2, 0.1, 0.4])
    from_files = lt.bodies.Tree.from_mjcf(GROUND_MJCF), lt.bodies.Tree.from_urdf(GROUND_URDF, fixed_base=True)
    assert [other.base for other in from_files] == ["world", "table"]
    for other in from_files:
        field = other.system(gravity=(0.0, 0.0, -9.81)).vector_field(x)
        np.testing.assert_allclose(np.asarray(field), np.asarray(system.vector_field(x)), atol=1e-13)
    with pytest.raises(lt.InputError, match="no mass"):
        lt.bodies.Tree.from_urdf(GROUND_URDF)
