"""The trajectories of an ensemble one by one: as solutions, in files, with their indices in every message."""

import json
import pickle

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.engines.status_codes import StatusCode
from tests.systems import rigid_body

SPAN = (0.0, 6.0)
STEP = 0.1


def states(number, seed=0):
    return np.random.default_rng(seed).standard_normal((number, 3))


def build(p):
    return lt.models.rigid_body(p["inertia"], p["rate"])


@pytest.fixture(scope="module")
def family():
    return {"inertia": 1.0 + np.abs(states(7, 3)), "rate": np.linspace(0.1, 1.0, 7)}


# -- one of them ------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("outputs", ["final", "trajectory"])
def test_a_member_is_the_solution_of_its_own_run(family, outputs):
    ensemble = lt.ensemble(build, states(7), SPAN, STEP, parameters=family, outputs=outputs, save_every=5)
    one = lt.integrate(build({k: v[4] for k, v in family.items()}), states(7)[4], SPAN, STEP, save_every=5)
    solution, saved = ensemble[4], slice(None) if outputs == "trajectory" else [0, -1]
    assert np.array_equal(solution.t, one.t[saved])
    for name in ("x", "energy", "entropy"):
        assert np.abs(getattr(solution, name) - getattr(one, name)[saved]).max() < 1e-14, name
    assert solution.casimirs.keys() == one.casimirs.keys()
    assert solution.laws == one.laws
    assert solution.stats.energy_range == pytest.approx(one.stats.energy_range, rel=1e-15)
    assert (solution.stats.steps, solution.status.code) == (one.stats.steps, "completed")
    assert solution.status.message == "trajectory 4: reached t = 6 in 60 steps"
    assert solution.audit().passed, str(solution.audit())
    assert solution.evidence.local_error == pytest.approx(one.evidence.local_error, rel=0.5)
    assert solution.provenance["trajectory"] == 4


def test_counting():
    ensemble = lt.ensemble(rigid_body(), states(3), SPAN, STEP)
    assert [s.x[-1].tolist() for s in ensemble] == ensemble.x.tolist()
    assert np.array_equal(ensemble[-1].x, ensemble[2].x)
    with pytest.raises(IndexError, match="from -3 to 2, got 3"):
        ensemble[3]
    with pytest.raises(lt.InputError, match="must be an integer"):
        ensemble["2"]
    with pytest.raises(lt.InputError, match="no states were kept"):
        lt.ensemble(rigid_body(), states(3), SPAN, STEP, outputs="summary")[0]


@pytest.mark.slow
@pytest.mark.parametrize("outputs", ["final", "trajectory"])
def test_members_with_attitudes_and_with_work(outputs):
    inertia = jnp.array([3.0, 2.0, 1.0])
    top = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1 / inertia), None, group=mf.SO(3))
    ensemble = lt.ensemble(top, states(3), (0.0, 2.0), STEP, outputs=outputs)
    one = lt.integrate(top, states(3)[1], (0.0, 2.0), STEP)
    assert np.abs(ensemble[1].attitude[-1] - one.attitude[-1]).max() < 1e-14
    assert ensemble[1].attitude[0] == pytest.approx(np.eye(3))
    assert ensemble[1].audit().passed
    driven = lt.MetriplecticSystem(mf.Canonical(1), lambda x, t: 0.5 * x @ x * (1.0 + 0.3 * jnp.sin(t)))
    ensemble = lt.ensemble(driven, states(3)[:, :2], (0.5, 2.0), STEP, outputs=outputs)
    one = lt.integrate(driven, states(3)[1, :2], (0.5, 2.0), STEP)
    assert ensemble[1].x.shape[1] == 2
    assert ensemble[1].energy[[0, -1]] == pytest.approx(one.energy[[0, -1]], rel=1e-14)
    assert ensemble[1].casimirs["work"][-1] == pytest.approx(one.casimirs["work"][-1], rel=1e-13)
    assert ensemble[1].audit().passed


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("outputs", ["final", "trajectory", "summary"])
def test_save_and_load(tmp_path, outputs):
    x0s = states(5)
    x0s[2, 1] = np.nan
    ensemble = lt.ensemble(rigid_body(), x0s, SPAN, STEP, outputs=outputs, save_every=20)
    loaded_run = lt.load(ensemble.save(tmp_path / "deep" / "many.nc"))
    for name, value in vars(ensemble).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, getattr(loaded_run, name), equal_nan=True), name
            assert value.dtype == getattr(loaded_run, name).dtype, name
    assert str(loaded_run) == str(ensemble)
    assert str(loaded_run.audit()) == str(ensemble.audit())
    assert (loaded_run.laws, loaded_run.reasons, loaded_run.provenance) == (
        ensemble.laws,
        dict(ensemble.reasons),
        ensemble.provenance,
    )
    if outputs != "summary":
        assert np.array_equal(loaded_run[3].x, ensemble[3].x)
        assert loaded_run[3].casimirs == {}
        assert 0.0 < loaded_run[3].audit().energy_drift < 1e-15
        assert loaded_run[3].audit().passed
    copy = pickle.loads(pickle.dumps(ensemble))
    assert str(copy.audit()) == str(ensemble.audit())


def test_a_damaged_file_is_refused(tmp_path):
    path = lt.ensemble(rigid_body(), states(3), SPAN, STEP).save(tmp_path / "many.nc")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 8
    path.write_bytes(content)
    with pytest.raises(lt.FileError, match=r"many\.nc is damaged"):
        lt.load(path)


def test_xarray():
    x0s = states(4)
    x0s[1, 0] = np.inf
    ensemble = lt.ensemble(rigid_body(), x0s, SPAN, STEP, save_at=[1.0, 2.5])
    dataset = ensemble.to_xarray()
    assert dataset["x"].dims == ("trajectory", "time", "component")
    assert dataset["time"].to_numpy().tolist() == [0.0, 1.0, 2.5, 6.0]
    assert dataset["status_text"].to_numpy().tolist() == ["completed", "inadmissible", "completed", "completed"]
    assert "trajectory 1: the state is not finite" in str(dataset["message"].sel(trajectory=1).item())
    assert float(dataset["relaxation_time"].sel(trajectory=2)) == ensemble.relaxation_time[2]
    assert json.loads(dataset.attrs["provenance"])["method"] == "MetriplecticGauss(stages=1)"


# -- which cannot be started ---------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("is_named", [True, False])
def test_inadmissible_parameters_are_a_status_of_their_member(is_named):
    """Three of a thousand, one of them not a number; the others are what they are without them."""
    rates = np.linspace(0.1, 2.0, 1000)
    rates[[17, 400, 999]] = -1.0, np.nan, -2.0
    options = {"outputs": "final", "engine": "compiled"}

    def run(rates, x0s):
        if is_named:
            return lt.ensemble(rigid_body(), x0s, SPAN, STEP, parameters={"dissipation.rate": rates}, **options)
        return lt.ensemble(lambda rate: lt.models.rigid_body(rate=rate), x0s, SPAN, STEP, parameters=rates, **options)

    many, good = run(rates, states(1000)), np.delete(np.arange(1000), [17, 400, 999])
    assert np.flatnonzero(many.status == StatusCode.INADMISSIBLE).tolist() == [17, 400, 999]
    assert not many.ok[17]
    assert sorted(many.reasons) == [17, 400, 999]
    assert np.array_equal(many.x[good], run(rates[good], states(1000)[good]).x)
    assert np.isnan(many.x[17]).all()
    assert many.message(400) == "trajectory 400: one of its parameters is NaN"
    assert "inadmissible: trajectory 17: " in str(many)
    with pytest.raises(lt.InputError, match="trajectory 17: "):
        many[17]
    failed_laws = [row.law for row in many.audit().rows if row.passed is False]
    assert set(failed_laws) - {"accuracy"} == {"trajectories that failed"}
    assert np.array_equal(many[998].x[-1], many.x[998])


def test_half_of_them_inadmissible():
    rates = np.linspace(-1.0, 1.0, 20)
    ensemble = lt.ensemble(rigid_body(), [0.1, 1.0, 0.2], SPAN, STEP, parameters={"dissipation.rate": rates})
    assert np.array_equal(ensemble.ok, rates >= 0.0)


def test_states_that_are_none_stay_where_they_are():
    x0s = states(50)
    x0s[[3, 4, 49], 1] = np.nan, np.inf, -np.inf
    ensemble, rest = lt.ensemble(rigid_body(), x0s, SPAN, STEP), np.delete(np.arange(50), [3, 4, 49])
    assert np.flatnonzero(~ensemble.ok).tolist() == [3, 4, 49]
    assert np.array_equal(ensemble.x[rest], lt.ensemble(rigid_body(), x0s[rest], SPAN, STEP).x)
    assert "component" in ensemble.message(49)


# -- times that are asked for ---------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["compiled", pytest.param("array", marks=pytest.mark.slow)])
def test_save_at(engine):
    """Members take the steps of single runs, and save the same states."""
    times, x0s = [0.37, 1.0, 1.05, 3.3], states(9)
    ensemble = lt.ensemble(rigid_body(), x0s, SPAN, STEP, save_at=times, engine=engine)
    assert ensemble.t.tolist() == [0.0, *times, 6.0]
    for i in (0, 8):
        one = lt.integrate(rigid_body(), x0s[i], SPAN, STEP, save_at=times, engine=engine)
        assert np.abs(ensemble.x[i] - one.x).max() < 1e-14
        assert ensemble.steps[i] == one.stats.steps
    assert ensemble.audit().passed


def test_progress(capfd):
    lt.ensemble(rigid_body(), states(20), SPAN, STEP, progress=True)
    assert "20 trajectories" in capfd.readouterr().err
    lt.ensemble(rigid_body(), states(20), SPAN, STEP, progress=False)
    assert capfd.readouterr().err == ""
