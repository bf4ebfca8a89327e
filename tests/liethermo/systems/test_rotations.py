"""Attitudes, angular velocities and states of bodies, beside SciPy's rotations and closed forms."""

import pickle
import warnings

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import liethermo as lt
import manifolds as mf

ANGLES = np.array([0.0, 1e-12, 1e-6, 0.3, np.pi / 2, 3.0, np.pi - 1e-6, np.pi - 1e-12, np.pi, np.pi + 1e-9, 2 * np.pi])
"""Angles of rotation, with those at which formulas for quaternions lose digits."""

ROUNDING = 4e-15
"""Largest error of an entry of a rotation matrix: some roundings of numbers up to 1."""


def random_axes(count):
    axes = np.random.default_rng(0).standard_normal((count, 3))
    axes[:3] = np.eye(3)
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def rotations_at_angles():
    return Rotation.from_rotvec(np.concatenate([angle * random_axes(20) for angle in ANGLES]))


@pytest.mark.parametrize("scalar", ["last", "first"])
def test_quaternions_make_scipys_matrices_at_all_angles(scalar):
    rotations = rotations_at_angles()
    q = rotations.as_quat(scalar_first=scalar == "first")
    for sign in (1.0, -1.0):
        g = lt.bodies.attitude(quaternion=sign * q, scalar=scalar)
        assert np.abs(g - rotations.as_matrix()).max() < ROUNDING
    other = "first" if scalar == "last" else "last"
    assert np.abs(lt.bodies.attitude(quaternion=q, scalar=other) - rotations.as_matrix()).max() > 1.0  # the control


@pytest.mark.parametrize("sequence", ["zyx", "ZYX", "zxz", "ZXZ", "xyz", "YXZ", "yz", "X"])
@pytest.mark.parametrize("degrees", [False, True])
def test_euler_angles_make_scipys_matrices(sequence, degrees):
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (50, len(sequence)))
    angles = np.rad2deg(angles) if degrees else angles
    expected = Rotation.from_euler(sequence, angles, degrees=degrees).as_matrix()
    assert np.abs(lt.bodies.attitude(euler=angles, sequence=sequence, degrees=degrees) - expected).max() < ROUNDING


def run_from(attitude, body=None, **options):
    body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.02) if body is None else body
    x0 = body.state(angular_velocity=(0.3, 0.2, 0.5))
    return lt.integrate(body, x0, (0.0, 1.0), 0.25, lt.MetriplecticGauss(2), attitude=attitude, **options)


def test_all_forms_of_an_attitude_start_the_same_run():
    R = Rotation.from_euler("zyx", [40.0, 20.0, -30.0], degrees=True)
    forms = [
        R,
        R.as_matrix(),
        lt.bodies.attitude(rotation=R),
        lt.bodies.attitude(matrix=R.as_matrix()),
        lt.bodies.attitude(quaternion=R.as_quat()),
        lt.bodies.attitude(euler=(40.0, 20.0, -30.0), degrees=True),
    ]
    ends = [run_from(form).attitude[-1] for form in forms]
    assert np.abs(np.array(ends) - ends[0]).max() < ROUNDING
    assert np.abs(run_from(R.inv()).attitude[-1] - ends[0]).max() > 0.1  # the other side is another run
    p = lt.Propagator(lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.02), lt.MetriplecticGauss(2), 0.25)
    assert np.abs(p(np.array([0.9, 0.4, 0.5, 0.0]), (0.0, 1.0), attitude=R).attitude[-1] - ends[0]).max() < ROUNDING


def test_a_float32_matrix_is_projected_with_a_warning():
    R = Rotation.from_euler("zyx", [0.4, 0.2, -0.3])
    with pytest.warns(lt.bodies.AttitudeWarning, match="single precision") as caught:
        solution = run_from(R.as_matrix().astype(np.float32))
    assert len(caught) == 1
    g = solution.attitude[0]
    assert np.abs(g.T @ g - np.eye(3)).max() < 1e-15
    assert np.abs(g - R.as_matrix()).max() < 1e-7
    with pytest.warns(lt.bodies.AttitudeWarning, match="norm"):
        lt.bodies.attitude(quaternion=R.as_quat().astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run_from(R.as_matrix())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "needs one of"),
        ({"quaternion": [0, 0, 0, 1.0], "matrix": np.eye(3)}, "quaternion and matrix"),
        ({"quaternion": [0, 0, 0, 2.0]}, "norm 1, got 2"),
        ({"quaternion": [0, 0, 0, 0.0]}, "norm 1, got 0"),
        ({"quaternion": [0, 0, 0, np.nan]}, "norm 1"),
        ({"quaternion": [0, 0, 1.0]}, "shape"),
        ({"quaternion": [0, 0, 0, 1.0], "scalar": "w"}, "scalar must be"),
        ({"euler": [0.1, 0.2], "sequence": "zyx"}, "shape"),
        ({"euler": [0.1, 0.2, 0.3], "sequence": "zzx"}, "no axis twice"),
        ({"euler": [0.1, 0.2, 0.3], "sequence": "zYx"}, "sequence must be"),
        ({"matrix": np.diag([1.0, 1.0, -1.0])}, "reflection"),
        ({"matrix": 1.001 * np.eye(3)}, "not in SO"),
        ({"matrix": np.eye(4)}, "shape"),
        ({"rotation": np.eye(3)}, "scipy"),
    ],
)
def test_bad_attitudes_are_refused(arguments, message):
    with pytest.raises(lt.InputError, match=message):
        lt.bodies.attitude(**arguments)


def test_quaternions_are_differentiable():
    q = np.array([0.5, 0.5, 0.5, 0.5])
    jacobian = jax.jacfwd(lambda q: lt.bodies.attitude(quaternion=q))(q)
    step = 1e-6 * np.array([0.5, -0.5, 0.5, -0.5])  # tangential, so that the norm stays 1
    difference = lt.bodies.attitude(quaternion=q + step) - lt.bodies.attitude(quaternion=q - step)
    assert np.allclose(jacobian @ (2 * step), difference, atol=1e-11)


def test_results_are_those_of_scipy():
    solution = run_from(Rotation.from_euler("zyx", [0.4, 0.2, -0.3]))
    expected = Rotation.from_matrix(solution.attitude)
    assert (lt.bodies.rotation(solution).inv() * expected).magnitude().max() < ROUNDING
    for sequence in ("zyx", "ZYX", "ZXZ"):
        angles = lt.bodies.euler_angles(solution, sequence, degrees=True)
        assert np.allclose(angles, expected.as_euler(sequence, degrees=True), atol=1e-12)
        assert np.allclose(lt.bodies.attitude(euler=angles, sequence=sequence, degrees=True), solution.attitude)
    q = lt.bodies.quaternions(solution)
    assert np.array_equal(np.roll(q, 1, axis=-1), lt.bodies.quaternions(solution, scalar="first"))


def test_angular_velocities_turn_the_quaternions():
    """In a free body the derivative of the quaternion is half its product with the angular velocity."""
    body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), group=mf.SO(3))
    step = 1e-3
    solution = lt.integrate(body, [0.3, 0.4, 0.5], (0.0, 0.2), step, lt.MetriplecticGauss(2))
    omega, omega_space = lt.bodies.angular_velocity(solution), lt.bodies.angular_velocity(solution, "space")
    assert np.allclose(np.einsum("tij,tj->ti", solution.attitude, omega), omega_space, atol=1e-15)
    R = lt.bodies.rotation(solution)
    middle = 0.5 * (omega[1:] + omega[:-1])
    # the angle of a step differs from step * Omega at its middle by O(step^3)
    assert np.abs((R[:-1].inv() * R[1:]).as_rotvec() / step - middle).max() < step**2
    assert np.allclose(lt.bodies.angular_velocity(solution, degrees=True), np.degrees(omega))


MODELS = {
    "rigid body": lambda: lt.models.rigid_body((3.0, 2.0, 1.5)),
    "tumbling body": lambda: lt.models.tumbling_body([[3.0, 0.2, 0.0], [0.2, 2.0, 0.1], [0.0, 0.1, 1.5]], rate=0.1),
    "damper wheel": lambda: lt.models.damper_wheel(),
    "ring damper": lambda: lt.models.ring_damper(),
    "dual spin": lambda: lt.models.dual_spin(),
    "body with wheels": lambda: lt.models.body_with_wheels(),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", MODELS)
def test_a_state_has_the_angular_velocity_and_temperature_it_was_given(name):
    system, omega = MODELS[name](), np.array([0.1, -0.2, 0.3])
    n_rotors = system.algebra.dim - 3
    rates = {"rotor_rates": 0.5 + np.arange(n_rotors)} if n_rotors else {}
    heat = {} if name == "rigid body" else {"temperature": 1.7}
    x0 = system.state(angular_velocity=omega, **rates, **heat)
    assert np.allclose(system.body_kinematics.velocities["angular_velocity"](x0), omega, atol=1e-15)
    if isinstance(system, lt.LiePoissonSystem):
        assert np.allclose(system.energy.gradient(x0)[3 : 3 + n_rotors], 0.5 + np.arange(n_rotors), atol=1e-14)
    if name == "body with wheels":
        assert float(system.temperature(x0)) == pytest.approx(1.7, rel=1e-14)
    elif heat:
        assert np.allclose(system.temperatures(x0), 1.7)
    solution = lt.integrate(system, x0, (0.0, 0.5), 0.1)
    assert np.allclose(lt.bodies.angular_velocity(solution)[0], omega, atol=1e-15)
    if n_rotors:
        assert np.allclose(lt.bodies.rotor_rates(solution)[0], rates["rotor_rates"], atol=1e-14)
    else:
        with pytest.raises(lt.InputError, match="no rotor rates"):
            lt.bodies.rotor_rates(solution)
    both = system.state(angular_velocity=np.stack([omega, 2 * omega]), batch=True, **rates, **heat)
    assert np.allclose(both[0], x0)
    rates_in_degrees = {key: np.degrees(value) for key, value in rates.items()}
    in_degrees = system.state(angular_velocity=np.degrees(omega), degrees=True, **rates_in_degrees, **heat)
    assert np.allclose(in_degrees, x0, rtol=1e-13, atol=1e-15)


def test_a_state_of_a_quartic_energy_is_found_by_newtons_method():
    system = lt.LiePoissonSystem(mf.so(3), lambda mu: 0.5 * mu @ mu + 0.1 * (mu @ mu) ** 2)
    x0 = system.state(angular_velocity=(0.3, 0.0, 0.4))
    mu = np.linalg.norm(x0)
    assert mu + 0.4 * mu**3 == pytest.approx(0.5, rel=1e-14)
    assert np.allclose(lt.bodies.angular_velocity(lt.integrate(system, x0, (0.0, 0.1), 0.1))[0], [0.3, 0.0, 0.4])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "needs x"),
        ({"x": [1.0, 0, 0], "angular_velocity": [1.0, 0, 0]}, "got both"),
        ({"angular_velocity": [1.0, 0]}, "shape"),
        ({"angular_velocity": [1.0, 0, np.inf]}, "finite"),
        ({"angular_velocity": [1.0, 0, 0], "rotor_rates": [1.0]}, "a body with rotors"),
        ({"angular_velocity": [1.0, 0, 0], "temperature": -1.0}, "positive"),
        ({"x": [1.0, 0, 0], "temperature": 1.0}, "temperature= cannot be combined with x"),
        ({"x": [1.0, 0, 0], "degrees": True}, "degrees= cannot be combined with x"),
    ],
)
def test_bad_states_are_refused(arguments, message):
    with pytest.raises(lt.InputError, match=message):
        lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.1).state(**arguments)
    with pytest.raises(lt.InputError, match="no angular velocity"):
        lt.LiePoissonSystem(mf.sl(2), lt.Quadratic([1.0, 1.0, 1.0])).state(angular_velocity=[1.0, 0, 0])


@pytest.mark.slow
def test_ensembles_and_files_have_angular_velocities(tmp_path):
    inertias = np.array([[3.0, 2.0, 1.5], [3.0, 2.5, 1.0]])
    starts = Rotation.from_euler("z", [[0.1], [0.2]])
    e = lt.ensemble(
        lambda inertia: lt.models.tumbling_body(inertia, rate=0.05),
        [0.1, 0.2, 0.3],
        (0.0, 1.0),
        0.1,
        parameters=inertias,
        outputs="trajectory",
        attitude=starts,
    )
    omega = lt.bodies.angular_velocity(e)
    assert np.allclose(omega, e.x[..., :3] / inertias[:, None])
    assert np.allclose(lt.bodies.angular_velocity(e[1]), omega[1])
    assert np.allclose(lt.bodies.rotation(e).as_matrix()[:, 0], starts.as_matrix())
    assert lt.bodies.euler_angles(e).shape == (2, 11, 3)
    dataset = e.to_xarray({"time": "s"})
    assert dataset["angular_velocity"].attrs["units"] == "rad/s"
    assert "scalar last" in dataset["quaternion"].attrs["comment"]
    e.save(tmp_path / "e.nc")
    assert np.array_equal(lt.bodies.angular_velocity(lt.load(tmp_path / "e.nc")), omega)
    solution = e[0]
    solution.save(tmp_path / "s.nc")
    for copy in (lt.load(tmp_path / "s.nc"), pickle.loads(pickle.dumps(solution))):
        assert np.array_equal(lt.bodies.angular_velocity(copy, "space"), lt.bodies.angular_velocity(solution, "space"))
    with pytest.raises(lt.InputError, match="no states were kept"):
        lt.bodies.angular_velocity(lt.ensemble(MODELS["rigid body"](), [1.0, 0, 0], (0.0, 1.0), 0.1, outputs="summary"))
    with pytest.raises(lt.InputError, match="no rigid body"):
        lt.bodies.angular_velocity(lt.integrate(lt.models.damped_oscillator(), [1.0, 0.0, 0.0], (0.0, 0.1), 0.1))


@pytest.mark.slow
def test_rotor_rates_of_a_driven_body_and_of_an_ensemble(tmp_path):
    """A motor of torque u turns a free wheel by ``p' = u``, with ``p = J (a . Omega + w)``."""
    J, u = 0.1, 0.02
    body = lt.models.reaction_wheels((3.0, 2.0, 1.5), [[0, 0, 1.0]], J, torque=lt.torques.Motor([u]), attitude=False)
    x0 = body.state(angular_velocity=(0.1, 0.0, 0.2), rotor_rates=[4.0])
    solution = lt.integrate(body, x0, (0.0, 2.0), 0.1)
    spin = lt.bodies.angular_velocity(solution)[:, 2]
    rates = 4.0 + u * solution.t / J - (spin - spin[0])
    assert np.allclose(lt.bodies.rotor_rates(solution)[:, 0], rates, atol=1e-12)
    assert np.allclose(lt.bodies.rotor_rates(solution, degrees=True)[:, 0], np.degrees(rates), atol=1e-10)
    loaded = lt.load(solution.save(tmp_path / "run.nc", units={"time": "s"}))
    assert np.array_equal(lt.bodies.rotor_rates(loaded), lt.bodies.rotor_rates(solution))
    assert solution.to_xarray(units={"time": "s"})["rotor_rates"].attrs["units"] == "rad/s"
    many = lt.ensemble(body, np.stack([x0, x0]), (0.0, 2.0), 0.1)
    assert np.allclose(lt.bodies.rotor_rates(many)[:, 0], rates[-1], atol=1e-12)


@pytest.mark.parametrize("attitude", [[0.0, 0.0, 0.0, 1.0], [0.1, 0.2, 0.3], np.eye(3)[0], np.ones((5, 4))])
def test_a_run_refers_quaternions_and_angles_to_the_function_that_converts_them(attitude):
    body = lt.models.free_rigid_body(attitude=True)
    with pytest.raises(lt.InputError, match=r"lt\.bodies\.attitude\(quaternion=\.\.\.\)"):
        lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 1.0), 0.1, attitude=attitude)


def test_angular_momentum_in_both_frames_of_a_run_and_an_ensemble():
    body = lt.models.reaction_wheels((3.0, 2.0, 1.5), friction=0.1)
    x0 = body.state(angular_velocity=(0.1, 0.2, 0.5), rotor_rates=(3.0, 0.0, -1.0))
    g0 = Rotation.from_euler("zyx", [0.4, 0.2, -0.3])
    span, method = (0.0, 2.0), lt.MetriplecticMidpoint()
    run = lt.integrate(body, x0, span, 0.1, method, attitude=g0)
    expected = np.array([3.0, 2.0, 1.5]) * [0.1, 0.2, 0.5] + 0.1 * np.array([3.0, 0.0, -1.0])
    assert np.allclose(lt.bodies.angular_momentum(run)[0], expected, atol=1e-15)
    assert np.allclose(lt.bodies.angular_momentum(run, frame="space"), g0.apply(expected), atol=1e-13)
    many = lt.ensemble(body, np.stack([x0, 2 * x0]), span, 0.1, method, attitude=g0)
    assert np.allclose(lt.bodies.angular_momentum(many, "space"), np.outer([1, 2], g0.apply(expected)), atol=1e-13)
    assert np.allclose(np.radians(lt.bodies.nutation(run, degrees=True)), lt.bodies.nutation(run), atol=1e-15)
    with pytest.raises(lt.InputError, match="frame must be"):
        lt.bodies.angular_momentum(run, frame="inertial")
    wheels = lt.models.body_with_wheels()
    closed = lt.integrate(wheels, wheels.state(angular_velocity=(0.1, 0.2, 0.3)), (0.0, 0.1), 0.1)
    with pytest.raises(lt.InputError, match="angular momentum"):
        lt.bodies.angular_momentum(closed)  # its state begins with the angular velocity
