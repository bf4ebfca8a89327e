"""Attitudes in files and ensembles: CSV histories with units in the names of columns, and what cannot be used."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import liethermo as lt
import manifolds as mf


@pytest.fixture(scope="module")
def run():
    body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.05)
    start = Rotation.from_rotvec(np.pi * np.array([0.6, 0.0, 0.8]))  # half a turn, where the scalar part is zero
    x0 = body.state(angular_velocity=(0.3, 0.2, 1.0))
    return lt.integrate(body, x0, (0.0, 8.0), 0.25, lt.MetriplecticGauss(2), attitude=start)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("scalar", ["last", "first"])
@pytest.mark.parametrize("degrees", [False, True])
def test_what_is_written_is_read_back(run, tmp_path, degrees, scalar):
    path = lt.bodies.write_csv(tmp_path / "run.csv", run, degrees=degrees, scalar=scalar)
    header = path.read_text().splitlines()[0].split(",")
    assert header[1] == ("q_x" if scalar == "last" else "q_w")
    assert header[-1] == f"omega_z [{'deg' if degrees else 'rad'}/s]"
    history = lt.bodies.read_csv(path)
    assert np.array_equal(history.t, run.t)
    assert np.abs(history.attitude - run.attitude).max() < 2e-15
    assert np.abs(history.angular_velocity - lt.bodies.angular_velocity(run)).max() < 4e-16
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    q = table[:, 1:5] if scalar == "last" else np.roll(table[:, 1:5], -1, axis=1)
    assert (Rotation.from_quat(q) * Rotation.from_matrix(run.attitude).inv()).magnitude().max() < 2e-15
    # a run goes on from a row of the file
    body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.05)
    x0 = body.state(angular_velocity=history.angular_velocity[4])
    rest = lt.integrate(body, x0, (1.0, 8.0), 0.25, lt.MetriplecticGauss(2), attitude=history.attitude[4])
    assert np.abs(rest.attitude[-1] - run.attitude[-1]).max() < 1e-13


@pytest.mark.parametrize("degrees", [False, True])
def test_euler_angles_are_further_columns(run, tmp_path, degrees):
    path = lt.bodies.write_csv(tmp_path / "run.csv", run, degrees=degrees, euler="ZYX")
    unit = "deg" if degrees else "rad"
    names = path.read_text().splitlines()[0].split(",")
    assert names[-3:] == [f"euler_ZYX_{i} [{unit}]" for i in (1, 2, 3)]
    angles = np.loadtxt(path, delimiter=",", skiprows=1)[:, -3:]
    expected = Rotation.from_matrix(run.attitude).as_euler("ZYX", degrees=degrees)
    assert np.abs(angles - expected).max() < 1e-13
    assert np.abs(lt.bodies.read_csv(path).attitude - run.attitude).max() < 2e-15
    with pytest.raises(lt.InputError, match="three"):
        lt.bodies.write_csv(path, run, euler="ZY")


def test_columns_are_found_by_their_names(tmp_path):
    path = tmp_path / "other.csv"
    path.write_text("mode, q_w ,q_x,q_y,q_z,t [s]\n3,0.7071,0,0,0.7071,10.5\n3,1,0,0,0,11\n")
    history = lt.bodies.read_csv(path)
    assert history.angular_velocity is None
    assert history.t.tolist() == [10.5, 11.0]
    expected = Rotation.from_euler("z", [[90.0], [0.0]], degrees=True)
    assert (history.rotation * expected.inv()).magnitude().max() < 1e-15


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table"),
        ("t,q_x,q_y,q_z,q_w\n", "at least one line"),
        ("t,q_x,q_y,q_z\n0,0,0,1\n", "no column 'q_w'"),
        ("t,q_x,q_y,q_z,q_w\n0,0,0,0,a\n", "not a table of numbers"),
        ("t,q_x,q_y,q_z,q_w\n0,0,0,0,1,2\n", "numbers in each line"),
        ("t,q_x,q_y,q_z,q_w\n0,0,0,0,1\n0,0,0,2,1\n", "norm 2.23607 in line 3"),
        ("t,q_x,q_y,q_z,q_w\n0,0,0,0,nan\n", "norm nan in line 2"),
        ("t,q_x,q_y,q_z,q_w,q_x\n0,0,0,0,1,1\n", "2 columns 'q_x'"),
        ("t,q_x,q_y,q_z,q_w,t\n0,0,0,0,1,1\n", "2 columns 't'"),
        ("t,q_x,q_y,q_z,q_w\n0,0,0,0,1\nnan,0,0,0,1\n", "the column 't', line 3, that is not finite"),
        ("t,q_x,q_y,q_z,q_w,omega_x,omega_y,omega_z\n0,0,0,0,1,0,inf,0\n", "the column 'omega_y', line 2"),
        ("t,q_x [deg],q_y,q_z,q_w\n0,0,0,0,1\n", "components of a quaternion have no unit"),
        ("t [deg],q_x,q_y,q_z,q_w\n0,0,0,0,1\n", "in 'deg', .* Convert the column to s"),
        ("t,q_x,q_y,q_z,q_w,omega_x\n0,0,0,0,1,2\n", "no column 'omega_y'"),
        ("t,q_x,q_y,q_z,q_w,omega_x [rpx],omega_y,omega_z\n0,0,0,0,1,2,0,0\n", "in 'rpx': unknown unit"),
        ("t,q_x,q_y,q_z,q_w,omega_x [m],omega_y,omega_z\n0,0,0,0,1,2,0,0\n", "in 'm', .* Convert the column to rad/s"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(lt.FileError, match=message):
        lt.bodies.read_csv(path)


def test_units_of_times_and_angular_velocities_are_converted(tmp_path):
    path = tmp_path / "units.csv"
    path.write_text("t [ms],q_x,q_y,q_z,q_w,omega_x [rpm],omega_y [deg/s],omega_z\n250,0,0,0,1,60,180,2\n")
    history = lt.bodies.read_csv(path)
    np.testing.assert_allclose(history.t, [0.25], rtol=1e-15)
    np.testing.assert_allclose(history.angular_velocity, [[2 * np.pi, np.pi, 2.0]], rtol=1e-15)


def test_what_cannot_be_written(run, tmp_path):
    with pytest.raises(lt.FileError, match="could not be written"):
        lt.bodies.write_csv(tmp_path / "missing" / "run.csv", run)
    with pytest.raises(lt.FileError, match="could not be read"):
        lt.bodies.read_csv(tmp_path / "missing.csv")
    body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.05)
    many = lt.ensemble(body, np.ones((2, 3)), (0.0, 0.5), 0.25, outputs="trajectory")
    with pytest.raises(lt.InputError, match=r"write_csv\(path, e\[i\]\)"):
        lt.bodies.write_csv(tmp_path / "many.csv", many)
    lt.bodies.write_csv(tmp_path / "one.csv", many[1])
    with pytest.raises(lt.InputError, match="no attitudes"):
        lt.bodies.write_csv(tmp_path / "x.csv", lt.integrate(lt.models.rigid_body(), [1.0, 0, 0], (0.0, 0.1), 0.1))


@pytest.mark.slow
def test_complex_groups_and_files(tmp_path):
    """On SU(2), with complex elements, a full turn gives -I; a file stores the attitudes."""
    system = lt.LiePoissonSystem(mf.su(2), lt.Quadratic(np.ones(3)), group=mf.SU(2))
    run = lt.integrate(system, [0.0, 0.0, 1.0], (0.0, 2 * np.pi), np.pi / 200, lt.MetriplecticGauss(2), engine="array")
    assert np.abs(run.attitude[-1] + np.eye(2)).max() < 1e-7
    loaded = lt.load(run.save(tmp_path / "run.nc"))
    assert np.array_equal(loaded.attitude, run.attitude)
    su3 = lt.LiePoissonSystem(mf.su(3), lt.Quadratic(np.arange(1.0, 9.0)), group=mf.SU(3))
    run = lt.integrate(su3, np.ones(8), (0.0, 1.0), 0.1, engine="array")
    assert np.asarray(mf.SU(3).belongs(run.attitude, 1e-14)).all()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["array", "compiled"])
def test_ensembles_carry_attitudes(engine):
    """Each member equals a single run; one momentum may have several attitudes, and summaries have none."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lt.Quadratic(1.0 / np.array([3.0, 2.0, 1.0])),
        lt.Quadratic(np.ones(3)),
        lt.KillingDissipation(0.1),
        group=mf.SO(3),
    )
    rng = np.random.default_rng(0)
    mu, g = rng.standard_normal((4, 3)), mf.SO(3).exp(rng.standard_normal((4, 3)))
    ensemble = lt.ensemble(system, mu, (0.0, 2.0), 0.1, attitude=g, outputs="trajectory", engine=engine)
    assert (ensemble.x.shape, ensemble.attitude.shape) == ((4, 21, 3), (4, 21, 3, 3))
    single_run = lt.integrate(system, mu[2], (0.0, 2.0), 0.1, attitude=g[2])
    assert np.abs(ensemble.attitude[2] - single_run.attitude).max() < 1e-13
    assert np.abs(ensemble.x[2] - single_run.x).max() < 1e-13
    common_momentum = lt.ensemble(system, mu[2], (0.0, 2.0), 0.1, attitude=g, engine=engine)
    assert (
        np.abs(common_momentum.attitude @ mf.SO(3).inverse(g) @ g[2] - common_momentum.attitude[2]).max() > 1e-3
    )  # g acts from the left
    assert np.abs(g[2] @ mf.SO(3).inverse(g) @ common_momentum.attitude - common_momentum.attitude[2]).max() < 1e-13
    assert lt.ensemble(system, mu, (0.0, 2.0), 0.1, outputs="summary", engine=engine).attitude is None


def test_attitudes_that_cannot_be_used():
    without_group = lt.models.free_rigid_body()
    with pytest.raises(lt.InputError, match=r"group=mf\.SO\(3\)"):
        lt.ensemble(without_group, [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, attitude=np.eye(3))
    with_group = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.ones(3)), group=mf.SO(3))
    with pytest.raises(lt.InputError, match="one attitude"):
        lt.integrate(with_group, [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, attitude=np.stack([np.eye(3)] * 2))
    with pytest.raises(lt.InputError, match=r"not in SO\(3\)"):
        lt.ensemble(with_group, np.eye(3), (0.0, 1.0), 0.1, attitude=np.stack([np.eye(3), np.eye(3), 2 * np.eye(3)]))
