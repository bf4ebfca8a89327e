"""Ready torques beside SciPy's DOP853, in coordinates with quaternions and angular velocities."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import liethermo as lt
from liethermo.engines.compiled.engine import CompiledEngine
from liethermo.models.orbits import eccentric_anomaly, rotate_by_vector
from liethermo.runs.preparation import prepare_system_and_method
from tests.refusals import refusal_test

T = lt.torques

INERTIA = np.array([[3.0, 0.2, 0.1], [0.2, 2.0, -0.3], [0.1, -0.3, 1.5]])
AXES = np.array([[1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
WHEELS = np.array([0.1, 0.2])
BEARINGS = np.array([0.05, 0.0])

START = Rotation.from_euler("zyx", [0.4, 0.2, -0.3])
RATES = np.array([0.3, -0.2, 0.5])
WHEEL_RATES = np.array([1.0, -2.0])

END = 4.0
STEP = 0.05

ACCURACY = 2e-9
"""Largest error at END beside DOP853 at 1e-12: steps of 0.05 at order 6 have up to 8.7e-10."""


def reference(torque, with_wheels, motor=None):
    """Attitude matrix, angular velocity, rates of wheels at END, from M (Omega', w') = (L x Omega + tau, u - k w)."""
    a, J, k = (AXES.T, WHEELS, BEARINGS) if with_wheels else (np.zeros((3, 0)), np.zeros(0), np.zeros(0))
    M = np.block([[INERTIA, a * J], [(a * J).T, np.diag(J)]])

    def f(t, s):
        x, y, z, w = s[:4]
        omega, rates = s[4:7], s[7:]
        p, q, r = omega
        dq = 0.5 * np.array([w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p,
                             -x * p - y * q - z * r])  # fmt: skip
        g = Rotation.from_quat(s[:4]).as_matrix()
        L = INERTIA @ omega + a @ (J * rates)
        drive = np.zeros(len(J)) if motor is None else motor(t)
        right = np.concatenate([np.cross(L, omega) + torque(t, g, omega), drive - k * rates])
        return np.concatenate([dq, np.linalg.solve(M, right)])

    s0 = np.concatenate([START.as_quat(), RATES, WHEEL_RATES if with_wheels else []])
    s = s0
    for start, end in itertools.pairwise(NODES):  # a linear table has kinks there
        s = solve_ivp(f, (start, end), s, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.1).y[:, -1]
    return Rotation.from_quat(s[:4]).as_matrix(), s[4:7], s[7:]


def wheels_reference(J, k, capacity, temperature, wheel_rates, torque):
    """Attitude matrix, angular velocity, rates of three wheels about body axes, and temperature at END."""
    M = np.block([[INERTIA + np.diag(J), np.diag(J)], [np.diag(J), np.diag(J)]])

    def f(t, s):
        x, y, z, w = s[:4]
        (p, q, r), velocity = s[4:7], s[4:10]
        dq = 0.5 * np.array([w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p,
                             -x * p - y * q - z * r])  # fmt: skip
        L, g = (M @ velocity)[:3], Rotation.from_quat(s[:4]).as_matrix()
        right = np.concatenate([np.cross(L, s[4:7]) + torque(g), -k * s[7:10]])
        return np.concatenate([dq, np.linalg.solve(M, right), [k * s[7:10] @ s[7:10] / capacity]])

    s0 = np.concatenate([START.as_quat(), RATES, wheel_rates, [temperature]])
    s = solve_ivp(f, (0.0, END), s0, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.1).y[:, -1]
    return Rotation.from_quat(s[:4]).as_matrix(), s[4:7], s[7:10], s[10]


def run(torque, with_wheels, **options):
    if with_wheels:
        system = lt.models.reaction_wheels(INERTIA, AXES, WHEELS, BEARINGS, torque=torque)
        x0 = system.state(angular_velocity=RATES, rotor_rates=WHEEL_RATES)
    else:
        system = lt.models.free_rigid_body(INERTIA, attitude=True, torque=torque)
        x0 = system.state(angular_velocity=RATES)
    options = {"method": lt.MetriplecticGauss(3), "attitude": START} | options
    return system, lt.integrate(system, x0, (0.0, END), STEP, **options)


def kepler_direction(t, n, e, start):
    """Unit vector from the body to the centre, and r / a, with the apsis and E by brentq."""
    towards, normal = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    E0 = 2 * np.arctan(np.sqrt((1 - e) / (1 + e)) * np.tan(start / 2))
    M = E0 - e * np.sin(E0) + n * t
    E = brentq(lambda E: E - e * np.sin(E) - M, M - 1, M + 1, xtol=1e-15, rtol=1e-15)
    nu = 2 * np.arctan2(np.sqrt(1 + e) * np.sin(E / 2), np.sqrt(1 - e) * np.cos(E / 2))
    turned = Rotation.from_rotvec(normal * (nu - start)).apply(towards)
    return turned, 1 - e * np.cos(E)


N = 0.7
ECCENTRICITY = 0.4
ANOMALY = 0.5
ORBIT = {"eccentricity": ECCENTRICITY, "towards": (0.6, 0.8, 0.0), "anomaly": ANOMALY}
DIPOLE = np.array([0.1, 0.0, -1.0])
SPIN = np.array([0.0, 0.2, 0.3])


def dipole_field(t):
    direction, distance = kepler_direction(t, N, ECCENTRICITY, ANOMALY)
    r = -1.5 * distance * direction
    k = Rotation.from_rotvec(SPIN * t).apply(DIPOLE)
    return 3 * np.dot(k, r) * r / np.linalg.norm(r) ** 5 - k / np.linalg.norm(r) ** 3


def gravity_gradient(t, g, omega):
    direction, distance = kepler_direction(t, N, ECCENTRICITY, ANOMALY)
    n = g.T @ direction
    return 3 * N**2 / distance**3 * np.cross(n, INERTIA @ n)


def b_dot(t, g, omega):
    h = 1e-4  # the fourth-order difference of B in body axes, at attitudes that turn by omega
    fields = [Rotation.from_rotvec(omega * c * h).as_matrix().T @ g.T @ dipole_field(t + c * h) for c in (-2, -1, 1, 2)]
    rate = (fields[0] - 8 * fields[1] + 8 * fields[2] - fields[3]) / (12 * h)
    return np.cross(-0.4 * rate, g.T @ dipole_field(t))


DRAG = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.1]])
GAS = np.array([0.0, 0.1, 0.4])

PLATES = {
    "areas": [1.0, 2.0, 0.5],
    "normals": [[1.0, 0, 0], [0, -2.0, 0], [0, 1.0, 1.0]],
    "centres": [[0.5, 0.2, 0], [0, -0.4, 0.3], [0.1, 0, 0.6]],
    "specular": 0.3,
    "diffuse": [0.1, 0.2, 0.3],
}
SUN = np.array([1.0, 2.0, -1.0])


def plates(t, g, omega):
    u, total = g.T @ SUN / np.linalg.norm(SUN), np.zeros(3)
    for A, n, c, d in zip(PLATES["areas"], PLATES["normals"], PLATES["centres"], PLATES["diffuse"], strict=True):
        n = np.array(n) / np.linalg.norm(n)
        cosine = n @ u
        if cosine > 0:
            absorbed, specular, diffuse = 1 - 0.3 - d, 0.3, d
            force = absorbed * u + specular * 2 * cosine * n + diffuse * (u + 2 / 3 * n)
            total += np.cross(c, -0.2 * A * cosine * force)
    return total


NODES = np.linspace(0.0, END, 9)
MOMENTS = np.random.default_rng(3).standard_normal((9, 3)) * 0.2
SPLINE = scipy.interpolate.CubicSpline(NODES, MOMENTS)

CASES = {
    "gravity gradient": (lambda: T.GravityGradient(INERTIA, N, **ORBIT), gravity_gradient),
    "gravity gradient of an orbit": (lambda: T.GravityGradient(INERTIA, T.Orbit(N, **ORBIT)), gravity_gradient),
    "dipole": (
        lambda: T.Magnetic([0.1, 0.3, -0.2], T.DipoleField(DIPOLE, T.Orbit(N, 1.5, **ORBIT), SPIN)),
        lambda t, g, omega: np.cross([0.1, 0.3, -0.2], g.T @ dipole_field(t)),
    ),
    "B-dot": (lambda: T.BDot(0.4, T.DipoleField(DIPOLE, T.Orbit(N, 1.5, **ORBIT), SPIN)), b_dot),
    "drag": (lambda: T.RayleighDrag(DRAG, GAS), lambda t, g, omega: -DRAG @ (omega - g.T @ GAS)),
    "sphere": (
        lambda: T.SolarPressureSphere(2.0, [0.0, 0.3, 0.1], SUN, 1.2, lambda t: 0.1 * jnp.cos(t)),
        lambda t, g, omega: 0.1 * np.cos(t) * 1.2 * 2.0 * np.cross([0.0, 0.3, 0.1], -g.T @ SUN) / np.linalg.norm(SUN),
    ),
    "thrusters": (
        lambda: T.Thrusters(
            [[0, 1.0, 0], [0, 0, 2.0]], [[0.1, 0, 0], [0, 0.2, 0]], lambda t: jnp.stack([jnp.sin(t), t])
        ),
        lambda t, g, omega: np.array([-0.4 * t, 0.0, -0.1 * np.sin(t)]),
    ),
    "cubic table": (lambda: T.Tabulated(NODES, MOMENTS, "cubic"), lambda t, g, omega: SPLINE(t)),
    "spline": (lambda: T.Tabulated(SPLINE), lambda t, g, omega: SPLINE(t)),
    "linear table": (
        lambda: T.Tabulated(NODES, MOMENTS),
        lambda t, g, omega: np.array([np.interp(t, NODES, MOMENTS[:, i]) for i in range(3)]),
    ),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("with_wheels", [False, True], ids=["body", "wheels"])
@pytest.mark.parametrize("name", CASES)
def test_a_ready_torque_beside_an_integration_in_coordinates(name, with_wheels):
    make, torque = CASES[name]
    _, solution = run(make(), with_wheels)
    g, omega, rates = reference(torque, with_wheels)
    assert np.abs(solution.attitude[-1] - g).max() < ACCURACY
    assert np.abs(lt.bodies.angular_velocity(solution)[-1] - omega).max() < ACCURACY
    if with_wheels:
        p = WHEELS * (AXES @ omega + rates)
        assert np.abs(solution.x[-1, 3:5] - p).max() < ACCURACY
    without = reference(lambda t, g, omega: np.zeros(3), with_wheels)
    assert np.abs(without[1] - omega).max() > 1e-2  # the control: the torque matters
    assert solution.audit().passed


def test_plates_beside_an_integration_in_coordinates():
    """The kinks where a plate turns out of the light leave an error of second order."""
    _, solution = run(T.SolarPressurePlates(**PLATES, sun=SUN, pressure=0.2), False)
    g, omega, _ = reference(plates, False)
    assert np.abs(solution.attitude[-1] - g).max() < 1e-5
    assert np.abs(lt.bodies.angular_velocity(solution)[-1] - omega).max() < 1e-5
    assert solution.audit().passed


def test_a_list_of_torques_with_motors_on_wheels():
    torques = [T.Motor(lambda t: jnp.stack([0.02 * jnp.cos(t), -0.01])), T.GravityGradient(INERTIA, N, **ORBIT),
               T.RayleighDrag(DRAG, GAS)]  # fmt: skip
    _, solution = run(torques, True)
    both = lambda t, g, omega: gravity_gradient(t, g, omega) - DRAG @ (omega - g.T @ GAS)  # noqa: E731
    g, omega, rates = reference(both, True, lambda t: np.array([0.02 * np.cos(t), -0.01]))
    assert np.abs(solution.attitude[-1] - g).max() < ACCURACY
    assert np.abs(solution.x[-1, 3:5] - WHEELS * (AXES @ omega + rates)).max() < ACCURACY


@pytest.mark.sampled(1)
@pytest.mark.parametrize("torque", [lambda: T.BDot(0.5, np.array([0.0, 0.0, 1.0])), lambda: T.RayleighDrag(0.3)])
def test_a_lossy_torque_takes_the_energy_that_the_ledger_says(torque):
    _, solution = run(torque(), False)
    work = solution.casimirs["work"]
    assert (np.diff(work) < 0.0).all()
    assert np.abs(solution.energy - solution.energy[0] - work).max() < 2e-15
    assert solution.audit().passed


@pytest.mark.sampled("rigid_body")
@pytest.mark.parametrize("model", ["rigid_body", "tumbling_body", "damper_wheel", "ring_damper", "dual_spin",
                                   "reaction_wheels"])  # fmt: skip
def test_every_model_takes_torques_that_act_on_the_momentum_of_the_whole(model):
    options = {"rate": 0.0} if model in ("rigid_body", "tumbling_body") else {}
    arguments = {"inertia": (2.0, 1.6, 1.0), "attitude": True, "torque": T.ConstantInSpace([0.1, 0.2, 0.3])} | options
    system = getattr(lt.models, model)(**arguments)
    solution = lt.integrate(system, system.state(angular_velocity=RATES), (0.0, 1.0), 0.25, attitude=START)
    momentum = np.einsum("tij,tj->ti", solution.attitude, solution.x[:, :3])
    impulse = np.stack([solution.casimirs[f"impulse {i}"] for i in (1, 2, 3)], axis=1)
    assert np.abs(momentum - momentum[0] - impulse).max() < 1e-14
    assert np.abs(impulse - solution.t[:, None] * [0.1, 0.2, 0.3]).max() < 2e-3  # the torque at attitudes of stages
    assert solution.audit().passed


@pytest.mark.slow
def test_a_body_with_wheels_takes_torques_that_need_no_attitude():
    system = lt.models.body_with_wheels(torque=[T.ConstantInBody([0.1, 0.0, 0.0]), T.Motor([0.0, 0.0, 0.05])])
    x = system.state(angular_velocity=[0.1, 0.2, 0.3], rotor_rates=[0.0, 0.1, 0.2])
    force = system.external_force(x[:6], x[6], 0.0)  # on the momentum l_xi, of the whole and of the wheels
    assert np.allclose(force, [0.1, 0, 0, 0, 0, 0.05], atol=1e-15)
    assert lt.integrate(system, x, (0.0, 1.0), 0.1).audit().passed
    with pytest.raises(lt.InputError, match="attitude=True"):
        lt.models.body_with_wheels(torque=T.ConstantInSpace([0.1, 0.0, 0.0]))


def test_the_attitude_of_a_body_with_three_wheels_beside_an_integration_in_coordinates():
    wheels, k, torque = np.array([0.3, 0.2, 0.1]), 0.2, np.array([0.1, -0.2, 0.05])
    options = {"inertia": INERTIA, "wheels": wheels, "friction": k, "heat": 2.0, "temperature": 1.5}
    velocity = {"angular_velocity": RATES, "rotor_rates": [1.0, -2.0, 0.5]}
    system = lt.models.body_with_wheels(**options, attitude=True, torque=T.ConstantInSpace(torque))
    solution = lt.integrate(system, system.state(**velocity), (0.0, END), STEP, lt.MetriplecticGauss(3), attitude=START)
    g, omega, rates, temperature = wheels_reference(wheels, k, 2.0, 1.5, [1.0, -2.0, 0.5], lambda g: g.T @ torque)
    assert np.abs(lt.bodies.rotation(solution)[-1].as_matrix() - g).max() < ACCURACY
    q = Rotation.from_matrix(g).as_quat()
    assert min(np.abs(lt.bodies.quaternions(solution)[-1] - s * q).max() for s in (1.0, -1.0)) < ACCURACY
    angles = Rotation.from_matrix(g).as_euler("zyx")
    assert np.abs(lt.bodies.euler_angles(solution, "zyx")[-1] - angles).max() < 2.0 * ACCURACY
    assert np.abs(lt.bodies.angular_velocity(solution)[-1] - omega).max() < ACCURACY
    assert np.abs(system.energy.gradient(jnp.asarray(solution.x[-1]))[3:6] - rates).max() < 2.0 * ACCURACY
    assert float(system.temperatures(solution.x)[-1, 0]) == pytest.approx(temperature, abs=ACCURACY)
    assert solution.audit().passed


def test_reaction_wheels_with_one_wheel_are_a_damper_wheel():
    one = lt.models.reaction_wheels((2.0, 1.6, 1.0), [[0.0, 1.0, 0.0]], 0.1, 0.05)
    other = lt.models.damper_wheel((2.0, 1.6, 1.0), (0.0, 1.0, 0.0), 0.1, 0.05)
    x = np.array([0.3, 0.4, 0.5, 0.1, 0.2])
    assert np.allclose(one.vector_field(x), other.vector_field(x), rtol=0, atol=1e-15)
    many = lt.models.reaction_wheels(INERTIA, AXES, WHEELS, BEARINGS)
    assert bool(many.check().passed)
    M = np.block([[INERTIA, AXES.T * WHEELS], [(AXES.T * WHEELS).T, np.diag(WHEELS)]])
    velocity = np.concatenate([RATES, WHEEL_RATES])
    L, p = INERTIA @ RATES + AXES.T @ (WHEELS * WHEEL_RATES), WHEELS * (AXES @ RATES + WHEEL_RATES)
    assert np.allclose(many.state(angular_velocity=RATES, rotor_rates=WHEEL_RATES)[:5], [*L, *p], atol=1e-15)
    energy = 0.5 * velocity @ M @ velocity
    assert float(many.drop_baths().energy.value(jnp.array([*L, *p]))) == pytest.approx(energy, rel=1e-14)
    with pytest.raises(lt.InputError, match="less than the inertia"):
        lt.models.reaction_wheels((1.0, 1.0, 1.0), [[1.0, 0, 0], [1.0, 0, 0]], 0.6)


def test_keplers_equation_at_all_eccentricities():
    M = np.linspace(-7.0, 7.0, 201)
    for e in (0.0, 0.1, 0.5, 0.9, 0.99, 0.999):
        E = np.asarray(jax.vmap(lambda M, e=e: eccentric_anomaly(M, e))(M))
        residual = E - e * np.sin(E) - M
        assert np.abs(residual - 2 * np.pi * np.round(residual / (2 * np.pi))).max() < 4e-15


def test_a_rotation_of_a_vector_is_scipys():
    v = np.array([0.3, -0.5, 0.8])
    for size in (0.0, 1e-9, 1e-3, 1.1e-3, 1.0, np.pi, 5.0):
        angle = size * np.array([0.6, 0.0, 0.8])
        assert np.abs(rotate_by_vector(v, jnp.asarray(angle)) - Rotation.from_rotvec(angle).apply(v)).max() < 1e-15
    assert np.isfinite(jax.jacfwd(lambda t: rotate_by_vector(v, jnp.array([t, 0.0, 0.0])))(0.0)).all()


@pytest.mark.sampled(4)
@pytest.mark.parametrize("m", [2, 3, 4, 5, 8, 9, 17, 100])
def test_tables_are_scipys_splines(m):
    rng = np.random.default_rng(m)
    t, y = np.sort(rng.uniform(0.0, 10.0, m)), rng.standard_normal((m, 3))
    q = np.concatenate([rng.uniform(t[0], t[-1], 100), t])
    linear = np.stack([np.interp(q, t, y[:, i]) for i in range(3)], axis=1)
    assert np.abs(jax.jit(jax.vmap(T.Table(t, y)))(q) - linear).max() < 2e-15
    splines = [scipy.interpolate.PchipInterpolator(t, y), scipy.interpolate.make_interp_spline(t, y, min(3, m - 1))]
    if m > 3:
        splines += [scipy.interpolate.CubicSpline(t, y), scipy.interpolate.Akima1DInterpolator(t, y),
                    scipy.interpolate.UnivariateSpline(t, y[:, 0], s=0.1)]  # fmt: skip
    for spline in splines:
        values = spline(q)
        assert np.abs(jax.jit(jax.vmap(T.Table(spline)))(q) - values).max() < 2e-14 * np.abs(values).max()
    assert not np.any(jax.jit(jax.vmap(T.Table(t, y)))(np.array([t[0] - 1e-9, t[-1] + 1e-9])))


test_bad_torques_are_refused = refusal_test(
    (lambda: T.Tabulated(lambda t: t), "kind='cubic'"),
    (lambda: T.Tabulated([0.0, 1.0]), "spline of SciPy alone"),
    (lambda: T.Tabulated(SPLINE, MOMENTS), "a spline has its values"),
    (lambda: T.Tabulated(NODES, MOMENTS, kind="quadratic"), "kind must be"),
    (lambda: T.Tabulated(scipy.interpolate.CubicSpline(NODES, MOMENTS.T, axis=1)), "axis 0"),
    (lambda: lt.models.free_rigid_body(attitude=True, torque=SPLINE), r"Tabulated\(spline\)"),
    (lambda: T.BDot(-1.0, np.ones(3)), "gain must be >= 0"),
    (lambda: T.RayleighDrag(-np.eye(3)), "positive semidefinite"),
    (lambda: T.RayleighDrag(-1.0), ">= 0"),
    (lambda: T.Orbit(1.0, eccentricity=1.0), "below 1"),
    (lambda: T.DipoleField(DIPOLE, np.ones(3)), "function of t"),
    (lambda: T.DipoleField(DIPOLE, T.Orbit(N)), "radius"),
    (lambda: T.Orbit(N)(0.0), "radius"),
    (lambda: T.GravityGradient(INERTIA, T.Orbit(N), eccentricity=0.1, anomaly=0.0), "eccentricity and anomaly"),
    (lambda: lt.models.free_rigid_body(torque=T.Motor([0.1, 0.0, 0.0])), "each wheel of the body, which has 0"),
    (lambda: lt.models.reaction_wheels(torque=T.Motor([0.1, 0.0])), "which has 3, but got shape"),
    (lambda: lt.models.reaction_wheels(torque=T.Motor(lambda t: jnp.ones(4))), "which has 3, but got shape"),
    (lambda: lt.models.free_rigid_body().state(angular_velocity=np.ones(3), rotor_rates=[1.0]), "with rotors"),
    (lambda: T.SolarPressurePlates([1.0], [[0, 0, 0.0]], [[0, 0, 1.0]]), "must not be zero"),
    (lambda: T.SolarPressurePlates([1.0], [[0, 0, 1.0]], [[0, 0, 1.0]], 0.7, 0.7), "at most 1"),
    (lambda: T.Thrusters(np.zeros((2, 3)), np.zeros((3, 3))), "shape"),
)


def test_the_program_of_a_long_table_is_short():
    """The rows are read from memory: the work of a step grows with the logarithm of their number."""
    counts = []
    for m in (9, 1801):
        times = np.linspace(0.0, END, m)
        moments = np.stack([np.sin(times), np.cos(times), 0.0 * times], axis=1)  # with zeros, which are not compiled in
        system = lt.models.free_rigid_body(INERTIA, torque=T.Tabulated(times, moments))
        counts.append(CompiledEngine(*prepare_system_and_method(system, lt.MetriplecticGauss(2))).n_operations_per_step)
    assert counts[1] < counts[0] + 300  # eight more halvings for each stage


def test_a_long_table_with_zeros_is_read_alike_by_both_engines():
    """Zeros among the parameters are compiled in, but not those of a table, which is read from memory."""
    times = np.linspace(0.0, END, 301)
    moments = np.stack(
        [np.maximum(np.sin(times), 0.0), 0.0 * times, np.where(np.arange(301) == 150, 0.01, 0.0)], axis=1
    )
    ends = [run(T.Tabulated(times, moments), False, engine=engine)[1].x[-1] for engine in ("array", "compiled")]
    assert np.abs(ends[0] - ends[1]).max() < 1e-13
    _, omega, _ = reference(lambda t, g, omega: [np.interp(t, times, column) for column in moments.T], False)
    assert np.abs(ends[1] - INERTIA @ omega).max() < 1e-4  # kinks inside of steps


def test_torque_of_the_time_alone():
    """A function of t, a table and pulses are torques as they are; the pulses state their breaks."""
    start, span, method = [0.3, -0.2, 0.9], (0.0, 3.0), lt.MetriplecticMidpoint()
    pairs = [
        (lambda t: jnp.stack([0.0 * t, jnp.sin(t), 0.1 * t]), lambda t, mu: jnp.stack([0.0 * t, jnp.sin(t), 0.1 * t])),
        (lt.PiecewiseConstant([0.25, 1.1], [(0.0, 0.0, 0.1)]), T.PiecewiseConstant([0.25, 1.1], [(0.0, 0.0, 0.1)])),
        (T.Table(NODES, MOMENTS, kind="cubic"), T.Tabulated(NODES, MOMENTS, kind="cubic")),
    ]
    for of_time, of_momentum in pairs:
        runs = [
            lt.integrate(lt.models.free_rigid_body(INERTIA, torque=torque), start, span, 0.1, method)
            for torque in (of_time, of_momentum)
        ]
        np.testing.assert_array_equal(runs[0].t, runs[1].t)
        np.testing.assert_allclose(runs[0].x, runs[1].x, atol=1e-15)
        assert runs[0].audit().passed
        assert np.ptp(runs[0].x @ np.eye(3)[1]) > 1e-3


def test_levels_of_thrusters_may_be_a_list():
    as_list, as_array = (
        T.Thrusters(np.eye(3), np.ones((3, 3)), levels) for levels in ([0.1, 0.0, 0.3], np.array([0.1, 0.0, 0.3]))
    )
    np.testing.assert_array_equal(as_list(0.0, jnp.zeros(3)), as_array(0.0, jnp.zeros(3)))
    assert np.abs(as_list(0.0, jnp.zeros(3))).max() > 0.1
