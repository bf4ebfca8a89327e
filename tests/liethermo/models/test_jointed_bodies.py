"""Trees of jointed bodies beside Newton's and Euler's equations with constraints, closed forms, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from liethermo.engines.select_engine import is_worth_compiling
from tests.liethermo.models.newton_euler import Body, final_state

TENSOR = np.diag([3.0, 2.0, 1.5]) + 0.1

BODIES = [
    Body(10.0, np.array([0.1, 0.0, 0.05]), TENSOR),
    Body(
        *(2.0, np.array([0.8, 0.0, 0.1]), np.diag([0.05, 0.4, 0.42])),
        *(0, False, np.array([0.5, 0.1, 0.0]), np.array([0.0, 1.0, 0.0]), 4.0, 0.3),
    ),
    Body(
        *(1.0, np.array([0.3, 0.05, 0.0]), np.diag([0.01, 0.03, 0.03])),
        *(1, False, np.array([1.5, 0.0, 0.0]), np.array([0.0, 0.6, 0.8]), 1.0, 0.05),
    ),
    Body(
        *(1.5, np.array([0.1, 0.2, 0.0]), np.diag([0.1, 0.12, 0.13])),
        *(0, True, np.array([-0.5, 0.1, 0.0]), np.array([0.6, 0.0, 0.8]), 5.0, 0.2),
    ),
]
"""A bus, a panel on a hinge, its tip on a second hinge, and a tank that slides."""

NAMES = ("bus", "panel", "tip", "tank")

ANGULAR_VELOCITY = (0.3, 0.1, 0.8)

JOINTS = dict(zip(NAMES[1:], (0.4, -0.7, 0.2), strict=True))

RATES = dict(zip(NAMES[1:], (0.2, 0.5, -0.3), strict=True))

BATHS = lt.HeatBaths(capacity=50.0, temperature=300.0)


def tree_of(bodies, names, **changes):
    tree = lt.bodies.Tree()
    tree.add(names[0], bodies[0].mass, bodies[0].centre, bodies[0].inertia)
    for name, body in zip(names[1:], bodies[1:], strict=True):
        kind = lt.bodies.Slider if body.slides else lt.bodies.Hinge
        joint = kind(
            at=body.place, axis=body.axis, **({"stiffness": body.stiffness, "damping": body.damping} | changes)
        )
        tree.add(name, body.mass, body.centre, body.inertia, parent=names[body.parent], joint=joint)
    return tree


@pytest.fixture(scope="module")
def system():
    return tree_of(BODIES, NAMES).system(baths=BATHS)


@pytest.fixture(scope="module")
def x0(system):
    return system.state(angular_velocity=ANGULAR_VELOCITY, joints=JOINTS, joint_rates=RATES)


@pytest.fixture(scope="module")
def reference():
    return final_state(BODIES, ANGULAR_VELOCITY, [*JOINTS.values()], [*RATES.values()], 5.0)


def momentum_in_space(solution):
    return np.einsum("tij,tj->ti", solution.attitude, solution.x[:, :3])


@pytest.mark.parametrize(
    ("method", "step", "order"),
    [
        (lt.MetriplecticGauss(3), 0.05, 6),
        pytest.param(lt.MetriplecticRungeKutta(6), 0.05, 6, marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticMidpoint(), 0.02, 2, marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticGauss(2), 0.05, 4, marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticRungeKutta(4), 0.02, 4, marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticRungeKutta(8), 0.1, 8, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_orders_beside_newton_and_euler(system, x0, reference, method, step, order):
    R, q, heat = reference
    errors = []
    for h in (step, step / 2.0):
        solution = lt.integrate(system, x0, (0.0, 5.0), h, method)
        joints = [solution.joints[name][-1] for name in NAMES[1:]]
        errors.append(max(np.abs(solution.attitude[-1] - R).max(), np.abs(joints - q).max()))
        assert solution.audit().passed
        assert np.ptp(solution.energy) < 1e-12
        momentum = momentum_in_space(solution)
        assert np.abs(momentum - momentum[0]).max() < 1e-12
        assert (np.diff(solution.entropy) >= 0.0).all()
        bath_heat = 300.0 * 50.0 * np.expm1(solution.x[-1, -1] / 50.0)  # of a bath of constant capacity
        assert bath_heat == pytest.approx(heat, rel=1e-2 if order == 2 else 1e-4)
    assert errors[-1] < (1e-3 if order == 2 else 1e-5)
    assert np.log2(errors[0] / errors[1]) > order - 0.7


@pytest.mark.slow
def test_engines_and_ensembles(system, x0):
    solution = lt.integrate(system, x0, (0.0, 1.0), 0.1, lt.MetriplecticGauss(2), engine="array")
    other = lt.integrate(system, x0, (0.0, 1.0), 0.1, lt.MetriplecticGauss(2))
    np.testing.assert_allclose(solution.x, other.x, atol=1e-12)
    many = lt.ensemble(system, [x0, x0], (0.0, 1.0), 0.1, lt.MetriplecticGauss(2), outputs="trajectory")
    np.testing.assert_array_equal(many[1].x, other.x)
    assert many.joints["panel"].shape == (2, 11)


def test_joints_and_velocities_of_solutions_and_files(system, x0, tmp_path):
    solution = lt.integrate(system, x0, (0.0, 0.2), 0.05, lt.MetriplecticGauss(3))
    solution.save(tmp_path / "run.nc")
    loaded = lt.load(tmp_path / "run.nc")
    np.testing.assert_array_equal(loaded.joints["tip"], solution.joints["tip"])
    np.testing.assert_array_equal(lt.bodies.angular_velocity(loaded), lt.bodies.angular_velocity(solution))
    np.testing.assert_allclose(lt.bodies.angular_velocity(solution)[0], ANGULAR_VELOCITY, atol=1e-14)
    rates = system.joint_rates(x0)
    assert {name: float(rate) for name, rate in rates.items()} == pytest.approx(RATES)
    for run in (solution, loaded):
        rates = lt.bodies.joint_rates(run)
        assert {name: float(series[0]) for name, series in rates.items()} == pytest.approx(RATES)
        np.testing.assert_allclose(rates["tip"], system.joint_rates(solution.x)["tip"], atol=1e-13)
    dataset = solution.to_xarray()
    assert dataset["joint_rates"].dims == ("time", "joint_coordinate")


def test_joint_rates_are_derivatives_of_the_joints(system, x0):
    h = 1e-3
    many = lt.ensemble(system, [x0, x0], (0.0, 10 * h), h, lt.MetriplecticGauss(2), outputs="trajectory")
    rates = lt.bodies.joint_rates(many)
    for name, angles in many.joints.items():
        assert rates[name].shape == angles.shape
        slopes = (angles[..., :-4] - 8 * angles[..., 1:-3] + 8 * angles[..., 3:-1] - angles[..., 4:]) / (12 * h)
        np.testing.assert_allclose(rates[name][..., 2:-2], slopes, atol=1e-9)
    np.testing.assert_array_equal(lt.bodies.joint_rates(many[1])["tip"], rates["tip"][1])


def test_a_rigid_body_has_no_joint_rates():
    run = lt.integrate(lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), [0.1, 0.2, 1.0], (0.0, 1.0), 0.1)
    with pytest.raises(lt.InputError, match="not a tree"):
        lt.bodies.joint_rates(run)


# -- closed forms ---------------------------------------------------------------------------------------------------


def test_two_masses_on_a_slider_swing_with_the_reduced_mass():
    tree = lt.bodies.Tree()
    tree.add("bus", 4.0, inertia=(1.0, 1.0, 1.0))
    tree.add("mass", 1.0, inertia=(0.1, 0.1, 0.1), parent="bus", joint=lt.bodies.Slider((0, 0, 0), (1, 0, 0), 2.0))
    system = tree.system()
    run = lt.integrate(system, system.state(joints={"mass": 0.3}), (0.0, 4.0), 0.05, lt.MetriplecticGauss(4))
    np.testing.assert_allclose(run.joints["mass"], 0.3 * np.cos(np.sqrt(2.0 / 0.8) * run.t), atol=1e-11)


@pytest.mark.slow
def test_cat_turns_over_without_angular_momentum():
    """Two halves on a universal joint bend round in a circle: at zero momentum the base has turned at the end."""
    tree = lt.bodies.Tree()
    tree.add("front", 2.0, centre=(0.0, 0.0, 0.25), inertia=(0.06, 0.06, 0.01))
    motor = lambda t: 0.05 * jnp.stack([jnp.sin(2.0 * t), jnp.cos(2.0 * t)])  # noqa: E731
    joint = lt.bodies.Universal(at=(0.0, 0.0, 0.0), axes=((1, 0, 0), (0, 1, 0)), stiffness=0.3, motor=motor)
    tree.add("rear", 2.0, centre=(0.0, 0.0, -0.25), inertia=(0.06, 0.06, 0.01), parent="front", joint=joint)
    system = tree.system()
    x0 = system.state(momentum=(0.0, 0.0, 0.0), joints={"rear": (0.3, 0.0)})
    run = lt.integrate(system, x0, (0.0, 30.0), 0.05, lt.MetriplecticGauss(2))
    assert np.abs(run.x[:, :3]).max() < 1e-13
    assert run.joints["rear"].shape == (601, 2)
    assert np.linalg.norm(lt.bodies.rotation(run)[-1].as_rotvec()) > 0.1
    assert run.audit().passed


@pytest.mark.slow
def test_motor_inside_changes_no_momentum_and_its_work_is_in_the_balance():
    tree = tree_of(BODIES, NAMES, damping=0.0)
    system = tree.system(motors={"panel": lambda t: 0.4 * jnp.sin(t)})
    x0 = system.state(angular_velocity=ANGULAR_VELOCITY, joints=JOINTS)
    run = lt.integrate(system, x0, (0.0, 5.0), 0.05, lt.MetriplecticGauss(3))
    momentum = momentum_in_space(run)
    assert np.abs(momentum - momentum[0]).max() < 1e-12
    assert np.ptp(run.energy) > 1e-2
    assert np.ptp(run.energy - run.casimirs["work"]) < 1e-13
    assert run.audit().passed


@pytest.mark.slow
def test_first_pulse_of_a_motor_at_rest_passes_the_audit():
    """The state is zero when the motor starts, so its size there is no scale of the residual of a step."""
    pulse = lt.PiecewiseConstant([0.7, 1.5], [0.2])
    system = tree_of(BODIES[:2], NAMES[:2]).system(baths=BATHS, motors={"panel": pulse})
    run = lt.integrate(system, system.state(), (0.0, 2.0), 0.05, lt.MetriplecticGauss(2))
    assert not run.x[:15].any()
    assert np.abs(run.joints["panel"][-1]) > 0.01
    assert run.stats.worst_residual < 1e-12
    assert run.audit().passed


@pytest.mark.slow
def test_explicit_steps_of_a_tree_that_is_released_at_rest():
    """The momentum stays zero, and the joint swings as by Newton and Euler."""
    system = tree_of(BODIES[:2], NAMES[:2]).system(baths=BATHS)
    run = lt.integrate(system, system.state(joints={"panel": 0.4}), (0.0, 2.0), 0.05, lt.MetriplecticRungeKutta(6))
    attitude, joints, _ = final_state(BODIES[:2], (0.0, 0.0, 0.0), [0.4], [0.0], 2.0)
    assert not run.x[:, :3].any()
    assert abs(run.joints["panel"][-1] - joints[0]) < 1e-7
    assert np.abs(run.attitude[-1] - attitude).max() < 1e-7
    assert run.audit().passed


def test_torque_on_the_base_changes_the_momentum_by_its_impulse():
    tree = tree_of(BODIES[:2], NAMES[:2])
    system = tree.system(baths=BATHS, torque=lt.torques.ConstantInSpace((0.1, 0.0, 0.2)))
    run = lt.integrate(system, system.state(joints={"panel": 0.4}), (0.0, 3.0), 0.1, lt.MetriplecticGauss(2))
    np.testing.assert_allclose(momentum_in_space(run)[-1], np.array([0.3, 0.0, 0.6]), atol=1e-7)  # of order 4
    assert run.audit().passed


@pytest.mark.slow
def test_chain_of_ten_bodies_for_a_long_time():
    links = [Body(5.0, np.zeros(3), np.diag([2.0, 1.5, 1.0]))]
    for i in range(9):
        axis = np.eye(3)[i % 3]
        centre, inertia, place = np.array([0.2, 0.05, 0.0]), np.diag([0.05, 0.06, 0.07]), np.array([0.4, 0.0, 0.1])
        links.append(Body(1.0, centre, inertia, i, False, place, axis, 0.5))
    names = [f"link {i}" for i in range(10)]
    system = tree_of(links, names).system()
    joints = dict(zip(names[1:], 0.1 * np.arange(9), strict=True))
    x0 = system.state(angular_velocity=ANGULAR_VELOCITY, joints=joints)
    run = lt.integrate(system, x0, (0.0, 100.0), 0.1, lt.MetriplecticGauss(2), save_every=10)
    momentum = momentum_in_space(run)
    assert np.abs(momentum - momentum[0]).max() < 1e-11
    assert np.ptp(run.energy) < 1e-12
    R, q, _ = final_state(links, ANGULAR_VELOCITY, [*joints.values()], np.zeros(9), 3.0)
    fine = lt.integrate(system, x0, (0.0, 3.0), 0.01, lt.MetriplecticGauss(3))
    assert np.abs(fine.attitude[-1] - R).max() < 1e-7
    assert np.abs([fine.joints[name][-1] for name in names[1:]] - q).max() < 1e-7


def test_mass_matrix_is_that_of_the_kinetic_energy(system):
    q, velocities = np.array([0.4, -0.7, 0.2]), np.array([0.3, 0.1, 0.8, 0.2, 0.5, -0.3])
    M = system.mass_matrix(q)
    np.testing.assert_allclose(M, M.T, atol=1e-14)
    x = np.concatenate([(M @ velocities)[:3], q, (M @ velocities)[3:], [0.0]])
    springs = 0.5 * np.array([4.0, 1.0, 5.0]) @ q**2
    kinetic = float(system.drop_baths().energy.value(x[:-1])) - springs
    assert kinetic == pytest.approx(float(0.5 * velocities @ M @ velocities), rel=1e-14)


# -- files ----------------------------------------------------------------------------------------------------------

URDF = """<robot name="pair">
  <link name="bus"><inertial><mass value="10"/>
    <inertia ixx="3" iyy="2" izz="1.5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="panel"><inertial><origin xyz="0.8 0 0"/><mass value="2"/>
    <inertia ixx="0.05" iyy="0.4" izz="0.42" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="bus"/><child link="panel"/><origin xyz="0.5 0 0"/>
    <axis xyz="0 1 0"/><dynamics damping="0.3"/></joint>
</robot>"""

MJCF = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody>
  <body name="bus"><freejoint/><inertial pos="0 0 0" mass="10" diaginertia="3 2 1.5"/>
    <body name="panel" pos="0.5 0 0"><joint type="hinge" axis="0 1 0" damping="0.3"/>
      <inertial pos="0.8 0 0" mass="2" diaginertia="0.05 0.4 0.42"/></body></body>
</worldbody></mujoco>"""


def test_files_of_both_kinds_give_the_tree_of_python():
    tree = lt.bodies.Tree()
    tree.add("bus", 10.0, inertia=(3.0, 2.0, 1.5))
    hinge = lt.bodies.Hinge((0.5, 0.0, 0.0), (0.0, 1.0, 0.0), damping=0.3)
    tree.add("panel", 2.0, (0.8, 0.0, 0.0), (0.05, 0.4, 0.42), parent="bus", joint=hinge)
    for other in (lt.bodies.Tree.from_urdf(URDF), lt.bodies.Tree.from_mjcf(MJCF)):
        assert other.names == tree.names
        np.testing.assert_allclose(other.system().mass_matrix([0.4]), tree.system().mass_matrix([0.4]), atol=1e-15)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (URDF.replace("continuous", "planar"), "planar"),
        (URDF.replace("<dynamics", "<springs"), "springs"),
        (URDF.replace('<mass value="2"/>', '<mass value="0"/>'), "mass"),
        (URDF.replace('child link="panel"', 'child link="bus"'), "bus"),
    ],
)
def test_elements_that_are_not_covered_are_refused_by_name(text, match):
    with pytest.raises(lt.InputError, match=match):
        lt.bodies.Tree.from_urdf(text).system()


def test_an_unknown_element_of_mjcf_is_refused_by_name():
    with pytest.raises(lt.InputError, match="tendon"):
        lt.bodies.Tree.from_mjcf(MJCF.replace("</worldbody>", "</worldbody><tendon/>"))


# -- bad input ------------------------------------------------------------------------------------------------------

HINGE = lt.bodies.Hinge((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"name": "bus", "mass": 1.0, "parent": "bus", "joint": HINGE}, "already"),
        ({"name": "arm", "mass": 0.0, "parent": "bus", "joint": HINGE}, "mass"),
        ({"name": "arm", "mass": 1.0, "parent": "leg", "joint": HINGE}, "unknown"),
        ({"name": "arm", "mass": 1.0, "parent": "arm", "joint": HINGE}, "'arm' is unknown.*without loops"),
        ({"name": "arm", "mass": 1.0, "parent": "bus"}, "joint"),
        (
            {"name": "arm", "mass": 1.0, "parent": "bus", "joint": HINGE, "inertia": np.triu(np.ones((3, 3)))},
            "symmetric",
        ),
        ({"name": "arm", "mass": 1.0, "parent": "bus", "joint": HINGE, "inertia": (1.0, 1.0, 3.0)}, "no rigid body"),
    ],
)
def test_bodies_that_cannot_be_added(arguments, match):
    tree = lt.bodies.Tree()
    tree.add("bus", 1.0, inertia=(1.0, 1.0, 1.0))
    with pytest.raises(lt.InputError, match=match):
        tree.add(**arguments)


@pytest.mark.parametrize(
    ("make_joint", "match"),
    [
        (lambda: lt.bodies.Hinge((0, 0, 0), (0, 0, 0)), "axis of a hinge must be a direction"),
        (lambda: lt.bodies.Slider((0, 0, 0), (0, 0, 0)), "axis of a slider must be a direction"),
        (lambda: lt.bodies.Universal((0, 0, 0), ((0, 0, 0), (0, 1, 0))), "axis of a universal joint must be"),
        (lambda: lt.bodies.Universal((0, 0, 0), ((0, 1, 0), (0, 2, 0))), "must not be parallel"),
        (lambda: lt.bodies.Hinge((0, 0, 0), (0, 0, 1), damping=-1.0), "damping of a hinge must be finite and >= 0"),
    ],
)
def test_joints_without_axes_or_with_negative_damping(make_joint, match):
    with pytest.raises(lt.InputError, match=match):
        make_joint()


def test_states_in_degrees_and_by_temperature(system, x0):
    degrees = {name: np.degrees(value) for name, value in JOINTS.items()} | {"tank": JOINTS["tank"]}  # the tank slides
    rates = {name: np.degrees(value) for name, value in RATES.items()} | {"tank": RATES["tank"]}
    same = system.state(
        angular_velocity=np.degrees(ANGULAR_VELOCITY),
        joints=degrees,
        joint_rates=rates,
        temperature=310.0,
        degrees=True,
    )
    np.testing.assert_allclose(same[:-1], x0[:-1], rtol=1e-13, atol=1e-15)
    assert float(system.temperature(same)) == pytest.approx(310.0, rel=1e-13)
    many = system.state(angular_velocity=[ANGULAR_VELOCITY] * 2, joints=JOINTS, joint_rates=RATES, temperature=310.0)
    np.testing.assert_allclose(many[1], same, rtol=1e-13, atol=1e-15)
    with pytest.raises(lt.InputError, match="not both"):
        system.state(x0, degrees=True)
    with pytest.raises(lt.InputError, match=r"baths=lt.HeatBaths"):
        tree_of(BODIES, NAMES).system().state(temperature=310.0)


def test_states_on_the_ground_in_degrees_and_by_temperature():
    tree = lt.bodies.Tree(ground="ceiling")
    hinge = lt.bodies.Hinge(at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), damping=0.1)
    tree.add("bob", mass=1.0, centre=(0.0, 0.0, -0.5), parent="ceiling", joint=hinge)
    pendulum = tree.system(gravity=(0.0, 0.0, -9.81), baths=BATHS)
    x0 = pendulum.state(joints={"bob": 30.0}, joint_rates={"bob": 90.0}, temperature=290.0, degrees=True)
    np.testing.assert_allclose(x0[:2], [np.pi / 6, 0.25 * np.pi / 2], rtol=1e-14)  # m l^2 = 0.25
    assert float(pendulum.temperature(x0)) == pytest.approx(290.0, rel=1e-13)
    with pytest.raises(lt.InputError, match="not both"):
        pendulum.state(x0, temperature=290.0)


def test_other_bad_input(system):
    with pytest.raises(lt.InputError, match="'antenna'"):
        system.state(joints={"antenna": 0.1})
    with pytest.raises(lt.InputError, match="gravity"):
        tree_of(BODIES, NAMES).system(gravity=(0.0, 0.0))
    tree = lt.bodies.Tree()
    tree.add("bus", 1.0, inertia=(1.0, 1.0, 1.0))
    tree.add("point", 1.0, parent="bus", joint=HINGE)
    with pytest.raises(lt.InputError, match="moves no inertia"):
        tree.system()


def test_a_control_without_the_change_of_inertia_fails(reference):
    """A control: a body that is frozen at its first joint angle turns otherwise."""
    start = np.asarray(tree_of(BODIES, NAMES).system().mass_matrix([*JOINTS.values()]))[:3, :3]
    momentum = start @ ANGULAR_VELOCITY

    def frozen(t, z):
        omega = np.linalg.solve(start, z[:3])
        R = z[3:].reshape(3, 3)
        hat = np.cross(np.eye(3), -omega)
        return np.concatenate([np.cross(z[:3], omega), (R @ hat).ravel()])

    run = solve_ivp(frozen, (0.0, 5.0), np.concatenate([momentum, np.eye(3).ravel()]), "DOP853", rtol=1e-9)
    assert np.abs(run.y[3:, -1].reshape(3, 3) - reference[0]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("parents", [range(8), (0, 0, 1, 1, 3, 4, 4, 0)], ids=["chain", "branches"])
def test_larger_trees_beside_derivatives_of_the_places_of_their_bodies(parents):
    """``M = sum m D r^T D r + D w^T J D w`` less the linear momentum, r and w of each body from link to link."""
    rng = np.random.default_rng(3)
    tree, bodies = lt.bodies.Tree(), []
    for i, parent in enumerate([None, *parents]):
        mass, centre, moments = 1.0 + rng.random(), rng.normal(size=3), 1.0 + rng.random(3)
        axis, place = rng.normal(size=3), rng.normal(size=3)
        kind = lt.bodies.Slider if i % 3 == 2 else lt.bodies.Hinge
        joint = {} if parent is None else {"parent": f"body {parent}", "joint": kind(at=place, axis=axis)}
        tree.add(f"body {i}", mass, centre, moments, **joint)
        bodies.append((mass, centre, np.diag(moments), axis / np.linalg.norm(axis), place, parent, i % 3 == 2))
    q = rng.normal(size=len(parents))

    def places_and_rotations(velocities, time):
        """Return centres and rotations of all bodies after a time, the base turning by ``velocities[:3]``."""
        turn, joints = velocities[:3] * time, q + velocities[3:] * time
        rotations, origins, centres = [], [], []
        for i, (_, centre, _, axis, place, parent, slides) in enumerate(bodies):
            if parent is None:
                R, origin = jax.scipy.linalg.expm(jnp.cross(turn, -jnp.eye(3))), jnp.zeros(3)
            else:
                R, origin = rotations[parent], origins[parent] + rotations[parent] @ place
                step = joints[i - 1] * axis
                if slides:
                    origin = origin + R @ step
                else:
                    R = R @ jax.scipy.linalg.expm(jnp.cross(step, -jnp.eye(3)))
            rotations.append(R)
            origins.append(origin)
            centres.append(origin + R @ centre)
        return jnp.stack(centres), jnp.stack(rotations)

    def kinetic_energy(velocities):
        (_, R), (v, rates) = jax.jvp(lambda t: places_and_rotations(velocities, t), (0.0,), (1.0,))
        masses = np.array([body[0] for body in bodies])
        v = v - masses @ v / masses.sum()  # no linear momentum
        spin = jnp.swapaxes(R, 1, 2) @ rates
        omega = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        inertias = np.stack([body[2] for body in bodies])
        return 0.5 * (masses @ jnp.sum(v**2, axis=1) + jnp.einsum("ni,nij,nj", omega, inertias, omega))

    M = jax.hessian(kinetic_energy)(jnp.zeros(3 + len(parents)))
    np.testing.assert_allclose(tree.system().mass_matrix(q), M, atol=1e-13 * float(jnp.abs(M).max()))


def test_larger_trees_are_compiled_for_explicit_methods_alone():
    """Newton's method of such a tree takes minutes to compile, and an explicit step never needs it."""
    tree = lt.bodies.Tree()
    tree.add("link 0", mass=5.0, inertia=(2.0, 1.5, 1.0))
    for i in range(6):
        hinge = lt.bodies.Hinge(at=(0.4, 0.0, 0.1), axis=np.eye(3)[i % 3], stiffness=0.5)
        tree.add(f"link {i + 1}", 1.0, (0.2, 0.05, 0.0), (0.05, 0.06, 0.07), parent=f"link {i}", joint=hinge)
    system = tree.system()
    assert is_worth_compiling(system, lt.MetriplecticRungeKutta(4))
    assert not is_worth_compiling(system, lt.MetriplecticGauss(2))
    assert is_worth_compiling(tree_of(BODIES, NAMES).system(), lt.MetriplecticGauss(2))
