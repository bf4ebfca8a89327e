"""Solutions: files that restore them or are refused, xarray, verdicts of the audit, and states between the steps."""

import dataclasses
import functools
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

import liethermo as lt
import manifolds as mf
from liethermo.engines.status_codes import RESULT_CODES

X0 = [0.001, 1.0, 0.001]


@pytest.fixture(scope="module")
def solution():
    return lt.integrate(lt.models.rigid_body(), X0, (0.0, 20.0), 0.1)


def test_save_and_load(solution, tmp_path):
    path = solution.with_provenance(seed=7).save(tmp_path / "deep" / "run.nc")
    loaded_solution = lt.load(path)
    for name in ("t", "x", "energy", "entropy"):
        assert np.array_equal(getattr(loaded_solution, name), getattr(solution, name)), name
    assert loaded_solution.casimirs.keys() == solution.casimirs.keys()
    assert all(np.array_equal(loaded_solution.casimirs[k], solution.casimirs[k]) for k in solution.casimirs)
    assert (loaded_solution.status, loaded_solution.stats, loaded_solution.laws) == (
        solution.status,
        solution.stats,
        solution.laws,
    )
    assert loaded_solution.provenance["seed"] == 7
    assert loaded_solution.provenance["step"] == 0.1
    assert str(loaded_solution.audit()) == str(solution.audit())
    assert [p.name for p in path.parent.iterdir()] == ["run.nc"]


def test_no_entropy_and_no_invariants(tmp_path):
    import manifolds as mf

    system = lt.MetriplecticSystem(mf.Canonical(1), lambda x: x @ x)
    loaded_solution = lt.load(lt.integrate(system, [1.0, 0.0], (0.0, 1.0), 0.1).save(tmp_path / "a.nc"))
    assert loaded_solution.entropy is None
    assert loaded_solution.casimirs == {}
    assert loaded_solution.audit().passed
    assert np.isnan(loaded_solution.audit().entropy_min_increment)


def test_xarray(solution):
    dataset = solution.to_xarray()
    assert dataset["x"].dims == ("time", "component")
    assert float(dataset["entropy"].sel(time=20.0)) == solution.entropy[-1]
    assert json.loads(dataset.attrs["provenance"])["library"].startswith("liethermo ")


@pytest.mark.parametrize("kept_length", [0, 10, 0.3, 0.9, 0.99])
def test_a_file_cut_short(solution, tmp_path, kept_length):
    path = solution.save(tmp_path / "run.nc")
    content = path.read_bytes()
    path.write_bytes(content[: int(kept_length if kept_length >= 1 else kept_length * len(content))])
    with pytest.raises(lt.FileError, match=r"run\.nc"):
        lt.load(path)


def have_equal_content(a, b) -> bool:
    arrays = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("t", "x", "energy", "entropy"))
    casimirs = a.casimirs.keys() == b.casimirs.keys()
    casimirs = casimirs and all(np.array_equal(a.casimirs[name], b.casimirs[name]) for name in a.casimirs)
    other_fields = ("status", "stats", "laws", "provenance", "event_time")
    return arrays and casimirs and all(getattr(a, name) == getattr(b, name) for name in other_fields)


@pytest.mark.filterwarnings("error")
def test_a_damaged_file_is_refused_or_loads_unharmed(solution, tmp_path, capfd):
    """A flipped bit anywhere in a file never gives another trajectory, nor output on the terminal.

    HDF5's reader, which some such files keep busy for ever, never sees them, unless the bit is in the tag of the
    digest.
    """
    path, damaged_path = solution.save(tmp_path / "run.nc"), tmp_path / "damaged.nc"
    content, random, n_refused = path.read_bytes(), np.random.default_rng(12), 0
    tag_indices = range(len(content) - 80, len(content) - 70)
    for index in [*random.integers(len(content) - 100, size=300), *tag_indices]:
        damaged_content = bytearray(content)
        damaged_content[index] ^= 1 << random.integers(8)
        damaged_path.write_bytes(damaged_content)
        try:
            assert have_equal_content(lt.load(damaged_path), solution), index
        except lt.FileError:
            n_refused += 1
    assert n_refused == 300
    assert capfd.readouterr().err == ""


def test_a_changed_number_and_a_changed_word(solution, tmp_path):
    import h5py

    for change in ("number", "word"):
        path = solution.save(tmp_path / f"{change}.nc")
        with h5py.File(path, "r+") as file:
            if change == "number":
                file["x"][3, 1] += 1e-15
            else:
                file.attrs["status"] = file.attrs["status"].replace("completed", "event")
        with pytest.raises(lt.FileError, match="checksum"):
            lt.load(path)


def test_a_file_of_an_earlier_version(solution, tmp_path):
    """A file of an earlier version has no checksum, loads, and warns."""
    import h5py

    path = solution.save(tmp_path / "old.nc")
    with h5py.File(path, "r+") as file:
        del file.attrs["sha256"]
        with_checksum = path.with_name("half.nc")
        file.flush()
        with_checksum.write_bytes(path.read_bytes())
        file.attrs["format"] = "liethermo-solution-1"
    with pytest.warns(UserWarning, match="without a checksum"):
        assert have_equal_content(lt.load(path), solution)
    with pytest.raises(lt.FileError, match="checksum"):
        lt.load(with_checksum)


def test_other_files(tmp_path):
    import xarray

    with pytest.raises(lt.FileError, match="there is no file"):
        lt.load(tmp_path / "none.nc")
    xarray.Dataset({"a": ("b", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(lt.FileError, match="not a liethermo result"):
        lt.load(tmp_path / "other.nc")
    assert issubclass(lt.FileError, OSError)


def test_save_to_writes_on_failure_and_on_the_way(tmp_path, monkeypatch):
    monkeypatch.setattr("liethermo.runs.run.CHECKPOINT_SECONDS", 0.0)
    saved_lengths = []
    original = lt.Solution.save
    monkeypatch.setattr(
        lt.Solution, "save", lambda self, path: saved_lengths.append(len(self.t)) or original(self, path)
    )
    lt.integrate(lt.models.rigid_body(), X0, (0.0, 300.0), 0.1, save_to=tmp_path / "run.nc")
    assert len(saved_lengths) > 2
    assert saved_lengths == sorted(saved_lengths)
    assert len(lt.load(tmp_path / "run.nc").t) == 3001


# -- the audit ----------------------------------------------------------------------------------------------------


def test_the_audit_sees_each_kind_of_damage(solution):
    """Controls: a trajectory damaged in one respect fails in that respect."""
    assert solution.audit().passed

    def failing(**changes):
        audit = dataclasses.replace(solution, **changes).audit()
        assert not audit.passed
        return [row.law for row in audit.rows if row.passed is False]

    energy, entropy = solution.energy.copy(), solution.entropy.copy()
    energy[7] *= 1 + 1e-12
    assert failing(energy=energy) == ["energy drift"]
    entropy[7] -= 1e-3
    assert failing(entropy=entropy) == ["least entropy increment"]
    assert failing(stats=dataclasses.replace(solution.stats, worst_residual=1e-6)) == ["stage residual"]
    assert failing(stats=dataclasses.replace(solution.stats, least_entropy_increment=-1.0)) == [
        "least entropy increment"
    ]
    laws = dataclasses.replace(solution.laws, conserved=tuple(solution.casimirs))
    assert failing(laws=laws)[0].startswith("drift of mu1**2")


def test_audit_tolerances_are_the_users(solution):
    assert not solution.audit(energy=0.0, residual=0.0).passed
    with pytest.raises(lt.InputError, match=">= 0"):
        solution.audit(energy=-1.0)
    with pytest.raises(lt.InputError, match="'enthalpy'"):
        solution.audit(enthalpy=1.0)


def test_zero_energy_is_measured_absolutely():
    solution = lt.integrate(lt.models.rigid_body(), [0.0, 0.0, 0.0], (0.0, 1.0), 0.1)
    assert solution.audit().passed
    assert solution.audit().energy_drift == 0.0


# -- imports ------------------------------------------------------------------------------------------------------


def test_import_is_light():
    """Packages that are not needed to integrate are not imported; the duration is measured in benchmarks, not here."""
    heavy_packages = ("geomstats", "matplotlib", "xarray", "pandas", "rich", "dask", "distributed", "zarr")
    script = f"import sys, liethermo; print([m for m in {heavy_packages} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_double_precision_is_on():
    import jax.numpy as jnp

    assert jnp.zeros(()).dtype == np.float64


def test_statuses_have_one_vocabulary():
    for code in RESULT_CODES:
        assert lt.Status(code, "a sentence", 1, 0.0) == lt.Status(code.status_name, "a sentence", 1, 0.0)
    assert [code.status_name for code in RESULT_CODES if lt.Status(code, "", 0, 0.0).ok] == ["completed", "event"]
    with pytest.raises(lt.InputError, match=r"no status 'finished'; there are completed, not_converged"):
        lt.Status("finished", "a sentence", 1, 0.0)


INERTIA = np.array([3.0, 2.0, 1.0])


def kinetic(p):
    return 0.5 * jnp.sum(p * p / INERTIA) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1])


def momentum_system(**options):
    return lt.LiePoissonSystem(
        mf.so(3), kinetic, lambda p: jnp.log(1.0 + p @ p), lt.ProjectedMetric(rate=0.3), **options
    )


SYSTEMS = {
    "so(3)": momentum_system,
    "sphere": lambda: lt.MetriplecticSystem(mf.LiePoisson(mf.so(3)), kinetic, space=mf.Sphere(2), validate=False),
    "attitude": lambda: momentum_system(group=mf.SO(3)),
}


@functools.cache
def system_of(name):
    return SYSTEMS[name]()


START = np.array([0.6, 0.64, 0.48])
END = 4.0
TIMES = np.linspace(0.0, END, 64)[1:-1]  # none at the end of a step

METHODS = {  # each with a step whose error is far above rounding
    "RK4": (lt.MetriplecticRungeKutta(4), 0.4),
    "RK6": (lt.MetriplecticRungeKutta(6), 0.8),
    "RK8": (lt.MetriplecticRungeKutta(8), 1.0),
    "Gauss1": (lt.MetriplecticGauss(1), 0.2),
    "Gauss2": (lt.MetriplecticGauss(2), 0.4),
    "Gauss3": (lt.MetriplecticGauss(3), 0.8),
    "Taylor6": (lt.MetriplecticTaylor(6), 0.8),
}


@functools.cache
def exact_states(name):
    """Return the momenta at TIMES: an attitude does not change them, and on the sphere there is no friction."""
    body = lt.LiePoissonSystem(mf.so(3), kinetic) if name == "sphere" else system_of("so(3)")

    field = jax.jit(lambda x: body.vector_field(x))
    return solve_ivp(lambda _, x: np.asarray(field(x)), (0.0, END), START, "DOP853", TIMES, rtol=1e-13, atol=1e-15).y.T


CASE_IDS = [f"{system}-{method}" for system in SYSTEMS for method in METHODS]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("case", CASE_IDS, ids=CASE_IDS)
def test_the_order_and_the_laws_of_the_method_hold_between_its_steps(case):
    name, method = case.split("-")
    system, (method, h), errors = system_of(name), METHODS[method], []
    for step in (h, h / 2):
        run = lt.integrate(system, START, (0.0, END), step, method, dense=True)
        states = run(TIMES)
        assert np.array_equal(run(run.t), run.x)
        errors.append(np.abs(states - exact_states(name)).max())
        energies = np.asarray(system.energy(states))
        assert np.ptp(np.append(energies, run.energy[0])) < 4e-15
        if system.entropy is not None:
            entropies = np.asarray(system.entropy(states))
            entropies_before = run.entropy[np.searchsorted(run.t, TIMES, side="right") - 1]
            assert (entropies - entropies_before).min() > -4e-16
    assert np.log2(errors[0] / errors[1]) > method.order - 0.8, errors
    assert errors[1] > 1e-12, "rounding tells nothing of an order"


@pytest.mark.slow
def test_control_the_cubic_between_has_an_order_of_its_own():
    """Control: the cubic Hermite interpolant of the steps has order 4, whatever the method."""
    system, (method, h), errors = system_of("so(3)"), METHODS["RK8"], []
    for step in (h, h / 2):
        run = lt.integrate(system, START, (0.0, END), step, method)
        slopes = np.array([np.asarray(system.vector_field(x)) for x in run.x])
        errors.append(np.abs(CubicHermiteSpline(run.t, run.x, slopes)(TIMES) - exact_states("so(3)")).max())
    assert np.log2(errors[0] / errors[1]) < 5.0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ["compiled", "array"])
def test_states_between_adaptive_steps(engine):
    """Dense output of adaptive steps takes times of any shape, refuses extrapolation, and is NaN if a step fails."""
    run = lt.integrate(
        system_of("so(3)"),
        START,
        (0.0, END),
        lt.Adaptive(1e-8),
        lt.MetriplecticRungeKutta(4),
        dense=True,
        engine=engine,
    )
    assert run(1.0).shape == (3,)
    assert run(np.ones((2, 5))).shape == (2, 5, 3)
    assert np.array_equal(run(1.0), run([[1.0]])[0, 0])
    with pytest.raises(lt.InputError, match=r"t must be from 0 to 4, .*, got 4\.1"):
        run(4.1)
    assert run.dense is not None
    assert np.isnan(run.dense.step_ends(run.x[:1], np.array([1e6]))).all()
