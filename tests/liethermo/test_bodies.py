"""Closed forms of free bodies, and what is told of how a body is turned."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import liethermo as lt

ASYMMETRIC = np.array([1.0, 2.0, 3.0])


def free(inertia, mu0, t_end, times=None, rate=0.0):
    """Momentum and attitude of a body, by DOP853: equations of their own, shape (12,)."""
    inertia = np.asarray(inertia)

    def f(t, s):
        mu, R = s[:3], s[3:].reshape(3, 3)
        xi = mu / inertia
        whole = xi + rate * np.cross(mu, xi)
        return np.concatenate([np.cross(mu, whole), np.cross(R, whole).ravel()])  # rows r: (R hat(w))_r = r x w

    start = np.concatenate([mu0, np.eye(3).ravel()])
    return solve_ivp(f, (0.0, t_end), start, "DOP853", t_eval=times, rtol=3e-14, atol=1e-15)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)], ids=str)
@pytest.mark.parametrize("mu0", [(0.3, 0.2, 1.0), (1.0, 0.3, -0.2), (0.02, 0.0, 1.0)], ids=str)
def test_periods_against_an_integration(mu0, order):
    """After a period the momentum is back, and the axis has turned about L by its mean rate times the period."""
    inertia, mu0 = ASYMMETRIC[list(order)], np.array(mu0)[list(order)]
    found = lt.bodies.periods(inertia, mu0)
    run = free(inertia, mu0, float(found.rotation))
    mu, g = run.y[:3, -1], run.y[3:, -1].reshape(3, 3)
    assert np.allclose(mu, mu0, rtol=0, atol=3e-12)
    back = Rotation.from_matrix(g).as_rotvec()  # the whole turns about the momentum in space
    L = mu0 / np.linalg.norm(mu0)
    turned = 2 * np.pi * found.rotation / found.precession
    assert np.linalg.norm(np.cross(back, L)) < 3e-12
    assert abs(np.sin(0.5 * (back @ L - turned))) < 3e-12
    axis = order[found.axis]
    assert axis == (2 if abs(mu0[list(order).index(2)]) > 0.9 else 0)
    by_energy = lt.bodies.periods(inertia, np.linalg.norm(mu0), 0.5 * np.sum(mu0**2 / inertia))
    assert np.allclose([*found[:2]], [*by_energy[:2]], rtol=1e-12)


def test_periods_in_their_limits():
    round_body = lt.bodies.periods((2.0, 2.0, 3.0), (0.6, 0.0, 0.8))
    assert round_body.precession == pytest.approx(2 * np.pi * 2.0, rel=1e-14)
    assert round_body.rotation == pytest.approx(2 * np.pi / (0.8 * (1 / 2.0 - 1 / 3.0)), rel=1e-14)
    assert np.isinf(lt.bodies.periods((2, 2, 2), (0.0, 0.6, 0.8)).rotation)
    separatrix = lt.bodies.periods(ASYMMETRIC, 1.0, 1.0 / (2 * 2.0))
    assert np.isinf(separatrix.rotation)
    assert separatrix.precession == pytest.approx(2 * np.pi * 2.0)
    many = lt.bodies.periods(ASYMMETRIC, np.array([[0.3, 0.2, 1.0], [1.0, 0.3, -0.2]]))
    assert many.rotation.shape == many.axis.shape == (2,)
    assert many.axis.tolist() == [2, 0]
    for energy, momentum in ((7.0, 1.0), (0.1, 1.0)):
        with pytest.raises(lt.InputError, match="has an energy from") as error:
            lt.bodies.periods(ASYMMETRIC, momentum, energy)
        assert "\n" not in str(error.value)


def test_angles_of_a_free_round_body():
    """The axis goes round L at L / I_1, and the body round its axis at L cos(theta) (1/I_3 - 1/I_1), in whole turns."""
    inertia, mu0 = np.array([1.0, 1.0, 1.6]), np.array([0.6, 0.0, 0.8])
    body = lt.models.tumbling_body(inertia, rate=0.0)
    turned = Rotation.from_rotvec([0.3, -2.0, 0.5]).as_matrix()
    run = lt.integrate(body, mu0, (0.0, 60.0), 0.1, lt.MetriplecticGauss(4), attitude=turned)
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
    L = turned @ mu0
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
    again = lt.load(run.save(tmp_path / "run.nc"))
    for told in (lt.bodies.nutation, lt.bodies.precession, lt.bodies.spin, lt.bodies.quaternions):
        assert np.array_equal(told(again), told(run))


def test_a_rod_has_its_nutation_from_its_own_axis():
    """Two greatest moments are of no one axis."""
    run = lt.integrate(lt.models.tumbling_body((2.0, 2.0, 0.5), rate=0.1), (0.1, 0.0, 1.0), (0.0, 1.0), 0.1)
    assert lt.bodies.nutation(run)[0] == pytest.approx(np.arctan(0.1), rel=1e-14)


def test_what_has_no_angles():
    free_body = lt.integrate(lt.models.free_rigid_body((3, 2, 1.5)), (0.1, 0.2, 1.0), (0.0, 1.0), 0.1)
    assert lt.bodies.nutation(free_body).shape == (11,)  # needs no attitude
    with pytest.raises(lt.InputError, match="there are no attitudes"):
        lt.bodies.quaternions(free_body)
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
    with pytest.raises(lt.InputError, match=r"spin must be positive and finite, not 0\.0"):
        lt.bodies.damping_time(5e9, 100.0, 2500.0, 1e3, 0.0)
    rates = lt.bodies.rate_of(np.array([1.0, 2.0]), (1.0, 1.5, 2.0), 3.0)
    assert np.allclose(rates[0], 2 * rates[1])
