"""Bodies with a wheel, a ring or a rotor against DOP853 for the Newton-Euler equations in velocities."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from liethermo.models.rotors import spin_temperature

INERTIA = np.array([2.0, 1.6, 1.0])
AXIS = np.array([0.1, 1.0, -0.3])
START = np.array([0.4, 0.3, 1.2])


def velocities(inertia, a, J, k, L, p, t_end, internal_torque=lambda L, Omega, w: (np.zeros(3), 0.0)):
    """Return the final (L, p) and the heat of the bearing, from ``L' + Omega × L = 0`` and ``J (a . Omega + w)' = -k
    w``."""
    a = a / np.linalg.norm(a)
    mass = np.block([[np.diag(inertia), J * a[:, None]], [J * a[None], np.array([[J]])]])

    def f(t, s):
        Omega, w = s[:3], s[3]
        L = inertia * Omega + J * w * a
        friction_rotation, axial_torque = internal_torque(L, Omega, w)
        return np.append(
            np.linalg.solve(mass, np.append(np.cross(L, Omega + friction_rotation), axial_torque - k * w)), k * w**2
        )

    start = np.append(np.linalg.solve(mass, np.append(L, p)), 0.0)
    run = solve_ivp(f, (0.0, t_end), start, "DOP853", rtol=3e-14, atol=1e-15)
    Omega, w = run.y[:3, -1], run.y[3, -1]
    return np.append(inertia * Omega + J * w * a, J * (a / 1.0 @ Omega + w)), run.y[4, -1]


@pytest.mark.parametrize("ring", [False, True], ids=["wheel", "ring"])
def test_a_nutation_damper_against_velocities(ring):
    if ring:
        R, r, rho, eta = 0.5, 0.01, 900.0, 0.01
        system = lt.models.ring_damper(INERTIA, AXIS, R, r, rho, eta, capacity=2.0)
        mass_of_liquid, length = rho * np.pi * r**2 * 2 * np.pi * R, 2 * np.pi * R
        J, k = mass_of_liquid * R**2, 8 * np.pi * eta * length * R * R  # Poiseuille: a force 8 pi eta length speed
    else:
        J, k = 0.2, 0.15
        system = lt.models.damper_wheel(INERTIA, AXIS, J, k, capacity=2.0)
    run = lt.integrate(system, [*START, 0.1], (0.0, 20.0), 0.05, lt.MetriplecticGauss(3))
    exact, heat = velocities(INERTIA, AXIS, J, k, START, 0.1, 20.0)
    assert np.allclose(run.x[-1, :4], exact, rtol=0, atol=2e-9)
    assert 2.0 * (float(system.temperatures(run.x[-1])[0]) - 1.0) == pytest.approx(heat, abs=1e-9)
    audit = run.audit()
    assert audit.passed
    assert "drift of mu1**2 + mu2**2 + mu3**2" in {row.law for row in audit.rows}
    assert np.ptp(np.linalg.norm(run.x[:, :3], axis=1)) < 4e-15
    assert np.allclose(run.provenance["inertia"], np.diag(INERTIA), rtol=0, atol=1e-14)


@pytest.mark.sampled("dual spin-MetriplecticMidpoint(gradient=Gonzalez)")
@pytest.mark.parametrize(
    "method",
    [
        lt.MetriplecticMidpoint(),
        lt.MetriplecticGauss(2),
        pytest.param(lt.MetriplecticRungeKutta(6), marks=pytest.mark.slow),
    ],
    ids=str,
)
@pytest.mark.parametrize(
    "system",
    [
        pytest.param(lambda: lt.models.damper_wheel(INERTIA, AXIS, 0.2, 0.15), id="wheel"),
        pytest.param(lambda: lt.models.dual_spin(INERTIA, AXIS, 0.2, 0.1, 0.05, 0.03), id="dual spin"),
    ],
)
def test_the_momentum_in_space_is_constant(system, method):
    run = lt.integrate(system(), [*START, 0.1], (0.0, 20.0), 0.1, method)
    S = np.einsum("tij,tj->ti", run.attitude, run.x[:, :3])
    assert np.abs(S - S[0]).max() < 1e-14
    rows = {row.law: row for row in run.audit().rows}
    assert rows["drift of momentum in space"].passed is not False  # Gauss methods do not promise it here
    assert np.abs(np.diff(run.attitude[:, 0, 0])).max() > 0.01  # it turns


def test_a_damper_wheel_brings_the_body_to_its_spin():
    """The final state is a spin about the axis of greatest inertia, with the wheel at rest and the predicted
    temperature."""
    system = lt.models.damper_wheel(INERTIA, AXIS, 0.2, 0.15, capacity=2.0, temperature=3.0, attitude=False)
    run = lt.integrate(system, [*START, 0.1], (0.0, 2000.0), 0.2)
    assert np.sin(lt.bodies.nutation(run)[-1]) < 1e-6
    end = spin_temperature(np.linalg.norm(START), run.energy[0], INERTIA, 2.0, 3.0)
    assert float(system.temperatures(run.x[-1])[0]) == pytest.approx(end, rel=1e-11)


@pytest.mark.sampled("MetriplecticRungeKutta(order=6)-0.1")
@pytest.mark.parametrize(
    ("method", "step"),
    [
        (lt.MetriplecticRungeKutta(6), 0.1),
        (lt.MetriplecticRungeKutta(8), lt.Adaptive(1e-9)),
        (lt.MetriplecticTaylor(8), 0.1),
        (lt.MetriplecticGauss(3), 0.1),
    ],
    ids=str,
)
def test_motors_turn_a_body_from_rest_without_momentum(method, step):
    """The momentum of the whole is zero all the way, where the gradient of its length vanishes."""
    inertia, J, k = np.array([[3.0, 0.2, 0.1], [0.2, 2.0, -0.3], [0.1, -0.3, 1.5]]), 0.1, 0.02
    times, torques = [1.0, 3.0, 5.0], np.array([[0.02, 0.0, 0.01], [-0.02, 0.01, 0.0]])
    motors = lt.torques.Motor(lt.PiecewiseConstant(times, torques))
    body = lt.models.reaction_wheels(inertia, wheels=J, friction=k, torque=motors)
    run = lt.integrate(body, body.state(angular_velocity=np.zeros(3)), (0.0, 7.0), step, method)

    mass = np.block([[inertia, J * np.eye(3)], [J * np.eye(3), J * np.eye(3)]])

    def f(t, s, u):
        velocity = np.linalg.solve(mass, np.append(np.zeros(3), s[9:]))
        return np.append((s[:9].reshape(3, 3) @ np.cross(np.eye(3), velocity[:3])).ravel(), u - k * velocity[3:])

    s = np.append(np.eye(3).ravel(), np.zeros(3))
    for start, end, u in zip([*times], [*times[1:], 7.0], [*torques, np.zeros(3)], strict=True):
        s = solve_ivp(f, (start, end), s, "DOP853", rtol=1e-12, atol=1e-14, args=(u,)).y[:, -1]
    assert np.abs(run.attitude[-1] - s[:9].reshape(3, 3)).max() < 1e-9
    assert np.abs(run.x[-1, 3:6] - s[9:]).max() < 1e-9
    assert np.abs(run.attitude[-1] - np.eye(3)).max() > 1e-2
    assert np.abs(run.x[:, :3]).max() < 1e-18
    assert run.audit().passed


@pytest.mark.sampled("MetriplecticRungeKutta(order=4)")
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticRungeKutta(8)], ids=str)
def test_wheels_turn_a_body_whose_momentum_nearly_cancels(method):
    """Corrections of the energy moved a small momentum of the whole by more than its length, and steps failed."""
    inertia, J, k = np.array([3.0, 2.0, 1.5]), 0.1, 0.02
    body = lt.models.reaction_wheels(inertia, wheels=J, friction=k)
    at_rest = np.asarray(body.state(angular_velocity=np.zeros(3), rotor_rates=np.array([3.0, -2.0, 5.0])))
    B = 1.0 / (inertia - J)

    def f(t, s):
        L, p = s[9:12], s[12:]
        omega = B * (L - p)
        spin = s[:9].reshape(3, 3) @ np.cross(np.eye(3), omega)
        return np.concatenate([spin.ravel(), np.cross(L, omega), -k * (p / J - omega)])

    for momentum in np.array([[1e-16, 0.0, 1e-16], [1e-13, 2e-13, 0.0], [1e-9, 0.0, 0.0], [0.0, 1e-5, -1e-5]]):
        x0 = np.concatenate([momentum, at_rest[3:]])
        run = lt.integrate(body, x0, (0.0, 8.0), 0.05, method)
        start = np.concatenate([np.eye(3).ravel(), momentum, x0[3:6]])
        s = solve_ivp(f, (0.0, 8.0), start, "DOP853", rtol=1e-12, atol=1e-20).y[:, -1]
        order_4 = method.order == 4
        assert np.abs(run.attitude[-1] - s[:9].reshape(3, 3)).max() < (1e-6 if order_4 else 1e-10), momentum
        change = np.abs(run.x[-1, :3] - s[9:12]).max()
        assert change < (1e-5 if order_4 else 1e-9) * np.abs(momentum).max() + 1e-17, momentum
        assert run.audit().passed, (momentum, run.audit())


def test_dual_spin_against_velocities():
    a, J, k, rates = np.array([0.0, 0.0, 1.0]), 0.3, 0.02, (0.05, 0.03)
    inertia = np.array([1.1, 1.0, 0.6])
    system = lt.models.dual_spin(inertia, a, J, k, *rates, capacity=(2.0, 3.0))

    def internal_torque(L, Omega, w):
        platform_rotation, rotor_rotation = (
            r * np.cross(L, v) for r, v in zip(rates, (Omega, Omega + w * a), strict=True)
        )
        return platform_rotation + rotor_rotation, a @ np.cross(L, rotor_rotation)

    run = lt.integrate(system, [*START, 0.5], (0.0, 20.0), 0.05, lt.MetriplecticGauss(3))
    exact, _ = velocities(inertia, a, J, k, START, 0.5, 20.0, internal_torque)
    assert np.allclose(run.x[-1, :4], exact, rtol=0, atol=2e-9)
    assert run.audit().passed
    assert np.diff(run.x[:, 4:], axis=0).min() >= 0.0  # each is warmed
    assert np.ptp(np.linalg.norm(run.x[:, :3], axis=1)) < 4e-15


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("rate_name", "final_nutation"), [("platform_rate", 0.0), ("rotor_rate", 0.5 * np.pi)])
def test_where_the_friction_is_decides_whether_a_slender_dual_spin_body_is_stable(rate_name, final_nutation):
    """A damping platform keeps a rod's spin if it is despun [Likins 1967]; a damping rotor leaves it for the flat
    spin."""
    system = lt.models.dual_spin((1.0, 1.0, 0.6), (0, 0, 1), 0.3, **{rate_name: 0.2})
    L = np.array([0.2, 0.0, 1.0])  # the platform is nearly despun: p carries L along the axis
    run = lt.integrate(system, [*L, 1.0], (0.0, 300.0), 0.1)
    nutation = lt.bodies.nutation(run, (0, 0, 1))
    assert nutation[0] == pytest.approx(np.arctan(0.2))
    assert (nutation[-1] < 1e-3) if final_nutation == 0.0 else (nutation[-1] > 1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lt.models.damper_wheel(wheel=1.7), "less than the inertia of the whole"),
        (lambda: lt.models.damper_wheel(axis=(0, 0, 0)), "three numbers that are not all zero"),
        (lambda: lt.models.damper_wheel(friction=-1.0), "must be >= 0"),
        (lambda: lt.models.ring_damper(viscosity=0.0), "viscosity must be positive"),
        (lambda: lt.models.dual_spin(capacity=(1.0, 2.0, 3.0)), "a number or have shape"),
        (lambda: lt.models.dual_spin(rotor=-0.1), "must be positive"),
    ],
)
def test_invalid_parameters_are_refused(make, message):
    with pytest.raises(lt.InputError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
