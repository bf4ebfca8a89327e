"""Closed forms of free bodies, and what is told of how a body is turned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import liethermo as lt
from liethermo.models.body_with_wheels import body_with_wheels_rest

ASYMMETRIC = np.array([1.0, 2.0, 3.0])


def free_body_run(inertia, mu0, t_end, times=None, rate=0.0):
    """Momentum and attitude of a body, by DOP853: equations of their own, shape (12,)."""
    inertia = np.asarray(inertia)

    def f(t, s):
        mu, R = s[:3], s[3:].reshape(3, 3)
        xi = mu / inertia
        derivative = xi + rate * np.cross(mu, xi)
        return np.concatenate(
            [np.cross(mu, derivative), np.cross(R, derivative).ravel()]
        )  # rows r: (R hat(w))_r = r x w

    start = np.concatenate([mu0, np.eye(3).ravel()])
    return solve_ivp(f, (0.0, t_end), start, "DOP853", t_eval=times, rtol=3e-14, atol=1e-15)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)], ids=str)
@pytest.mark.parametrize("mu0", [(0.3, 0.2, 1.0), (1.0, 0.3, -0.2), (0.02, 0.0, 1.0)], ids=str)
def test_periods_against_an_integration(mu0, order):
    """After a period the momentum is back, and the axis has turned about L by its mean rate times the period."""
    inertia, mu0 = ASYMMETRIC[list(order)], np.array(mu0)[list(order)]
    periods = lt.bodies.periods(inertia, mu0)
    run = free_body_run(inertia, mu0, float(periods.rotation))
    mu, g = run.y[:3, -1], run.y[3:, -1].reshape(3, 3)
    assert np.allclose(mu, mu0, rtol=0, atol=3e-12)
    rotation_vector = Rotation.from_matrix(g).as_rotvec()  # the whole turns about the momentum in space
    L = mu0 / np.linalg.norm(mu0)
    angle = 2 * np.pi * periods.rotation / periods.precession
    assert np.linalg.norm(np.cross(rotation_vector, L)) < 3e-12
    assert abs(np.sin(0.5 * (rotation_vector @ L - angle))) < 3e-12
    axis = order[periods.axis]
    assert axis == (2 if abs(mu0[list(order).index(2)]) > 0.9 else 0)
    periods_of_energy = lt.bodies.periods(inertia, np.linalg.norm(mu0), 0.5 * np.sum(mu0**2 / inertia))
    assert np.allclose([*periods[:2]], [*periods_of_energy[:2]], rtol=1e-12)


def test_periods_in_their_limits():
    round_body = lt.bodies.periods((2.0, 2.0, 3.0), (0.6, 0.0, 0.8))
    assert round_body.precession == pytest.approx(2 * np.pi * 2.0, rel=1e-14)
    assert round_body.rotation == pytest.approx(2 * np.pi / (0.8 * (1 / 2.0 - 1 / 3.0)), rel=1e-14)
    assert np.isinf(lt.bodies.periods((2, 2, 2), (0.0, 0.6, 0.8)).rotation)
    separatrix = lt.bodies.periods(ASYMMETRIC, 1.0, 1.0 / (2 * 2.0))
    assert np.isinf(separatrix.rotation)
    assert separatrix.precession == pytest.approx(2 * np.pi * 2.0)
    periods = lt.bodies.periods(ASYMMETRIC, np.array([[0.3, 0.2, 1.0], [1.0, 0.3, -0.2]]))
    assert periods.rotation.shape == periods.axis.shape == (2,)
    assert periods.axis.tolist() == [2, 0]
    for energy, momentum in ((7.0, 1.0), (0.1, 1.0)):
        with pytest.raises(lt.InputError, match=r"the energy for the momentum .* must lie between") as error:
            lt.bodies.periods(ASYMMETRIC, momentum, energy)
        assert "\n" not in str(error.value)


def test_angles_of_a_free_round_body():
    """The axis goes round L at L / I_1, and the body round its axis at L cos(theta) (1/I_3 - 1/I_1), in whole turns."""
    inertia, mu0 = np.array([1.0, 1.0, 1.6]), np.array([0.6, 0.0, 0.8])
    body = lt.models.tumbling_body(inertia, rate=0.0)
    rotation = Rotation.from_rotvec([0.3, -2.0, 0.5]).as_matrix()
    run = lt.integrate(body, mu0, (0.0, 60.0), 0.1, lt.MetriplecticGauss(4), attitude=rotation)
    assert np.ptp(lt.bodies.nutation(run)) < 1e-14
    assert lt.bodies.nutation(run)[0] == pytest.approx(np.arctan2(0.6, 0.8), rel=1e-14)
    assert np.allclose(np.diff(lt.bodies.precession(run)), 0.1, rtol=0, atol=1e-9)
    assert np.allclose(np.diff(lt.bodies.spin(run)), 0.1 * 0.8 * (1 / 1.6 - 1.0), rtol=0, atol=1e-9)
    assert np.allclose(lt.bodies.nutation(run, (0, 0, -3.0)), np.pi - lt.bodies.nutation(run), rtol=0, atol=1e-14)

    q = lt.bodies.quaternions(run)
    assert np.allclose(Rotation.from_quat(q).as_matrix(), run.attitude, rtol=0, atol=1e-14)
    assert q[0, 3] >= 0.0
    assert np.abs(np.diff(q, axis=0)).max() < 0.1  # continuous, while w changes its sign
    assert q[:, 3].min() < -0.5

    phi, theta, psi = lt.bodies.precession(run), lt.bodies.nutation(run), lt.bodies.spin(run)
    relative = Rotation.from_euler("ZXZ", np.stack([phi, theta, psi], axis=1)).as_matrix()
    frame = run.attitude @ relative.swapaxes(1, 2)  # the axes of space about L, the same at all times
    assert np.ptp(frame, axis=0).max() < 1e-12
    L = rotation @ mu0
    axes = run.attitude @ np.array([0.0, 0.0, 1.0])
    assert np.allclose(axes @ L / np.linalg.norm(L), np.cos(theta), rtol=0, atol=1e-13)

    data = run.to_xarray(units={"nutation": "rad"})
    assert np.array_equal(data["quaternion"], q)
    for name, values in (("nutation", theta), ("precession", phi), ("spin", psi)):
        assert np.array_equal(data[name], values)
        assert data[name].attrs["long_name"]
    assert data["nutation"].attrs["units"] == "rad"


def test_what_files_tell(tmp_path):
    body = lt.models.tumbling_body((3.0, 2.0, 1.5), rate=0.1)
    run = lt.integrate(body, (0.06, 0.1, 1.0), (0.0, 5.0), 0.1)
    loaded_run = lt.load(run.save(tmp_path / "run.nc"))
    for angle_function in (lt.bodies.nutation, lt.bodies.precession, lt.bodies.spin, lt.bodies.quaternions):
        assert np.array_equal(angle_function(loaded_run), angle_function(run))


def test_a_rod_has_its_nutation_from_its_own_axis():
    """Two greatest moments are of no one axis."""
    run = lt.integrate(lt.models.tumbling_body((2.0, 2.0, 0.5), rate=0.1), (0.1, 0.0, 1.0), (0.0, 1.0), 0.1)
    assert lt.bodies.nutation(run)[0] == pytest.approx(np.arctan(0.1), rel=1e-14)


def test_what_has_no_angles():
    free_body = lt.integrate(lt.models.free_rigid_body((3, 2, 1.5)), (0.1, 0.2, 1.0), (0.0, 1.0), 0.1)
    assert lt.bodies.nutation(free_body).shape == (11,)  # needs no attitude
    with pytest.raises(lt.InputError, match=r"there are no attitudes.*attitude=True"):
        lt.bodies.quaternions(free_body)
    with pytest.raises(lt.InputError, match=r"need a solution or an ensemble, got 'body\.csv'"):
        lt.bodies.write_csv(free_body, "body.csv")  # the path comes first
    oscillator = lt.integrate(lt.models.damped_oscillator(), (0.0, 1.0, 0.0), (0.0, 1.0), 0.1)
    with pytest.raises(lt.InputError, match="momentum on so"):
        lt.bodies.nutation(oscillator)
    with pytest.raises(lt.InputError, match="not all zero"):
        lt.bodies.nutation(free_body, (0, 0, 0))


def test_the_damping_time_of_a_solid_body():
    """In numbers: mu Q = 5e11 Pa, 2500 kg / m^3, R = 1 km, a period of 10 h, A = 100."""
    tau = lt.bodies.damping_time(5e9, 100.0, 2500.0, 1e3, 2 * np.pi / 36000.0)
    assert tau == pytest.approx(100 * 5e11 / (2500 * 1e6 * (2 * np.pi / 36000.0) ** 3), rel=1e-14)
    assert lt.bodies.damping_time(5e9, 100.0, 2500.0, np.array([1e3, 2e3]), 1e-4)[1] == pytest.approx(
        lt.bodies.damping_time(5e9, 100.0, 2500.0, 1e3, 1e-4) / 4
    )
    with pytest.raises(lt.InputError, match=r"spin must be positive and finite, got 0\.0"):
        lt.bodies.damping_time(5e9, 100.0, 2500.0, 1e3, 0.0)
    rates = lt.bodies.rate_of(np.array([1.0, 2.0]), (1.0, 1.5, 2.0), 3.0)
    assert np.allclose(rates[0], 2 * rates[1])


# -- relaxation times --------------------------------------------------------------------------------------------------


@pytest.mark.sampled("(162.75, 162.75, 37.5)")
@pytest.mark.parametrize("inertia", [(162.75, 162.75, 37.5), (37.5, 162.75, 162.75), (3.0, 0.5, 3.0)], ids=str)
def test_a_rod_comes_to_its_flat_spin_in_the_relaxation_time(inertia):
    """``tan theta = tan theta_0 exp(t / tau)`` from the long axis, at every angle; it was reached in tau / 2."""
    inertia, tau, L = np.array(inertia), 7.0, 1.3
    long_axis = np.argmin(inertia)
    mu0 = L * np.roll([np.cos(0.1), np.sin(0.1), 0.0], long_axis)
    rate = float(lt.bodies.rate_of(tau, inertia, L))
    run = free_body_run(inertia, mu0, 6 * tau, tau * np.arange(7), rate)
    tangent = np.linalg.norm(np.delete(run.y[:3], long_axis, axis=0), axis=0) / run.y[long_axis]
    assert np.allclose(np.diff(np.log(tangent)), 1.0, rtol=0, atol=1e-9)
    body = lt.models.tumbling_body(inertia, relaxation_time=tau, momentum=L, attitude=False)
    assert float(body.dissipation.part.rate) == rate
    angle = lt.bodies.nutation(lt.integrate(body, mu0, (0.0, tau), tau / 200, lt.MetriplecticRungeKutta(8)))
    assert np.tan(angle[-1]) / np.tan(angle[0]) == pytest.approx(np.e, rel=1e-8)


@pytest.mark.parametrize("middle", [162.75 * (1 - 1e-12), 162.7499, 162.7, 162.0, 155.0, 100.0, 37.5], ids=str)
@pytest.mark.parametrize("tau", [1.0, 50.0, 5000.0])
def test_the_relaxation_time_is_an_eigenvalue_of_the_linear_equations(middle, tau):
    """The real part of the faster root is -1 / tau, whether the two roots oscillate or not."""
    inertia, L = np.array([162.75, middle, 37.5]), 40.0
    rate = float(lt.bodies.rate_of(tau, inertia, L))
    d2, d3 = 1 / inertia[1:] - 1 / inertia[0]
    linear = np.array([[-rate * L**2 * d2, -L * d3], [L * d2, -rate * L**2 * d3]])
    assert np.linalg.eigvals(linear).real.min() * tau == pytest.approx(-1.0, rel=1e-5)  # equal to 1e-9 is equal


def test_nearly_equal_moments_with_strong_friction_fall_to_their_plane_in_the_relaxation_time():
    """The momentum comes to the plane of the two greatest moments in tau; within it the axis takes a longer time."""
    inertia, tau, L = np.array([162.75, 162.7, 37.5]), 20.0, 40.0
    rate = float(lt.bodies.rate_of(tau, inertia, L))
    d2, d3 = 1 / inertia[1:] - 1 / inertia[0]
    linear = np.array([[-rate * L**2 * d2, -L * d3], [L * d2, -rate * L**2 * d3]])
    roots, modes = np.linalg.eig(linear)
    fast_mode = modes[:, np.argmin(roots)]  # -0.06 rad across the plane for each rad within it
    mu0 = np.array([L, *(1e-4 * L * fast_mode)])
    run = free_body_run(inertia, mu0, 3 * tau, tau * np.arange(4), rate)
    assert np.allclose(np.diff(np.log(np.abs(run.y[2]))), -1.0, rtol=0, atol=1e-4)
    plane_run = free_body_run(inertia, L * np.array([np.cos(0.02), np.sin(0.02), 0.0]), rate / d2, [0, rate / d2], rate)
    assert np.log(plane_run.y[1, 0] / plane_run.y[1, -1]) == pytest.approx(1.0, abs=0.12)


def test_the_rate_has_derivatives_and_is_continuous_at_a_rod():
    rate = lambda inertia: lt.bodies.rate_of(5.0, inertia, 40.0)  # noqa: E731
    for inertia in ([162.75, 162.75, 37.5], [162.75, 162.7, 37.5], [162.75, 100.0, 37.5], [162.75, 37.5, 37.5]):
        assert np.isfinite(jax.grad(rate)(jnp.array(inertia))).all()
    assert float(rate([162.75, 162.75 * (1 - 1e-8), 37.5])) == pytest.approx(float(rate([162.75, 162.75, 37.5])))
    with pytest.raises(lt.InputError, match="three equal moments"):
        rate(Rotation.random(rng=1).as_matrix() @ np.diag([2.0, 2.0, 2.0]) @ Rotation.random(rng=1).inv().as_matrix())


# -- tensors of inertia ------------------------------------------------------------------------------------------------

ROTATION_MATRIX = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
TENSOR = ROTATION_MATRIX @ np.diag([2.0, 2.5, 3.0]) @ ROTATION_MATRIX.T


def test_a_tensor_is_one_body():
    """A tensor was read as three bodies, and the answers looked plausible."""
    mu = np.array([0.1, 0.2, 1.0])
    one, diagonal_periods = lt.bodies.periods(TENSOR, ROTATION_MATRIX @ mu), lt.bodies.periods((2.0, 2.5, 3.0), mu)
    assert one.rotation.shape == ()
    assert np.allclose([*one], [*diagonal_periods], rtol=1e-12)
    periods_of_energy = lt.bodies.periods(TENSOR, np.linalg.norm(mu), 0.5 * np.sum(mu**2 / [2.0, 2.5, 3.0]))
    assert np.allclose([*periods_of_energy], [*diagonal_periods], rtol=1e-12)
    periods = lt.bodies.periods(np.stack([TENSOR, np.diag([1.0, 2.0, 2.5])]), np.stack([ROTATION_MATRIX @ mu, mu]))
    assert np.allclose(periods.rotation[0], diagonal_periods.rotation, rtol=1e-12)
    assert np.allclose(periods.rotation[1], lt.bodies.periods((1.0, 2.0, 2.5), mu).rotation, rtol=1e-12)
    assert float(lt.bodies.rate_of(3.0, TENSOR, 1.0)) == pytest.approx(float(lt.bodies.rate_of(3.0, (2, 2.5, 3), 1.0)))
    moments, axes = lt.bodies.principal_axes(TENSOR)
    assert np.allclose(moments, [2.0, 2.5, 3.0], rtol=1e-14)
    assert np.allclose(axes @ np.diag(moments) @ axes.T, TENSOR, rtol=0, atol=1e-14)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_three_bodies_are_three_bodies():
    """Moments that happen to make a symmetric array, which is then no tensor of a rigid body."""
    three = np.array([[2.0, 3.0, 4.0], [3.0, 4.0, 2.0], [4.0, 2.0, 3.0]])
    periods = lt.bodies.periods(three, 1.0, 0.5 / 2.5)
    single_runs = [lt.bodies.periods(body, 1.0, 0.5 / 2.5).rotation for body in three]
    assert np.array_equal(periods.rotation, single_runs)
    assert lt.bodies.rate_of(1.0, np.ones((3, 3)) * [1.0, 1.5, 2.0], 1.0).shape == (3,)
    equal_moments = [[3.0, 2.0, 2.0], [2.0, 3.0, 2.0], [2.0, 2.0, 3.0]]  # positive definite, and its rows are bodies
    assert lt.bodies.rate_of(1.0, equal_moments, 1.0).shape == (3,)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.01, 1.0), min_size=3, max_size=3), st.integers(0, 2**16))
def test_no_tensor_of_a_rigid_body_is_ever_three_bodies(masses, seed):
    rotation = Rotation.random(rng=seed).as_matrix()
    moments = np.sum(masses) - np.array(masses)  # of three masses on the axes
    assert lt.bodies.rate_of(1.0, rotation @ np.diag(moments + 1e-3 * np.arange(3)) @ rotation.T, 1.0).shape == ()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda I: lt.bodies.rate_of(1.0, I([[9, 1, 1], [1, 2, 1], [1, 1, 3]]), 1.0), "one body at a time"),
        (lambda I: lt.bodies.periods(I([[2, -3, 0], [-3, 2, 0], [0, 0, 2]]), 1.0, 1.0), "positive definite, got"),
        (lambda I: lt.bodies.periods(I([[2, 0, 0], [0.1, 2, 0], [0, 0, 2]]), 1.0, 1.0), "positive and finite"),
        (lambda I: jax.jit(lambda i: lt.bodies.rate_of(1.0, i, 1.0))(I(TENSOR)), "use jax.vmap for many"),
        (lambda I: lt.bodies.principal_axes(I([2.0, 2.5])), r"must have shape \(3,\) or \(\.\.\., 3, 3\), got \(2,\)"),
        (lambda I: lt.models.body_with_wheels(I(np.ones((2, 3)))), r"got \(2, 3\)"),
        (lambda I: body_with_wheels_rest(1.0, 1.0, I([1.0, 2.0])), r"got \(2,\)"),
        (lambda I: lt.models.rigid_body(I([[2, 0, 0], [0.1, 2, 0], [0, 0, 2]])), "must be symmetric"),
        (lambda I: lt.torques.GravityGradient(I([[2, 0, 0], [0.1, 2, 0], [0, 0, 2]]), 1.0), "must be symmetric"),
        (lambda I: lt.models.tumbling_body(I([[2, 3, 0], [3, 2, 0], [0, 0, 2]]), rate=0.1), "positive definite, got"),
    ],
)
def test_arrays_that_are_no_inertia(call, message):
    with pytest.raises(lt.InputError, match=message) as error:
        call(lambda rows: np.array(rows, dtype=float))
    assert "\n" not in str(error.value)


def test_a_diagonal_tensor_is_its_moments():
    moments, mu = np.array([2.0, 2.5, 3.0]), np.array([0.1, 0.2, 1.0])
    diagonal = lt.models.free_rigid_body(np.diag(moments))
    assert np.array_equal(diagonal.energy.A, 1.0 / moments)
    gravity = lt.torques.GravityGradient(np.diag(moments), 1.0)
    assert np.allclose(
        gravity(0.3, mu, ROTATION_MATRIX),
        lt.torques.GravityGradient(moments, 1.0)(0.3, mu, ROTATION_MATRIX),
        atol=1e-15,
    )
