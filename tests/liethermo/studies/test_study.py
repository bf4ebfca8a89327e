"""Studies from beginning to end: values, statuses, restarts, extensions, other studies."""

import gc
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo import disk
from liethermo.studies import files
from liethermo.studies.running import run_locally

from .cases import RATES, RATIOS, X0, body, content, study

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A store that was never disturbed."""
    store = tmp_path_factory.mktemp("studies") / "whole.zarr"
    return store, study(store).run()


def test_every_point_is_what_a_run_of_its_own_gives(done):
    store, status = done
    assert status.complete
    assert not status.ok
    assert status.counts == {"completed": 30, "inadmissible": 5}
    found = study(store).results
    assert dict(found.sizes) == {"rate": 7, "ratio": 5, "quantity": 13, "final_component": 3}
    assert np.array_equal(found.rate, RATES)
    for i, j in ((0, 0), (3, 4), (5, 2)):
        solution = lt.integrate(body({"rate": RATES[i], "ratio": RATIOS[j]}), X0, (0.0, 4.0), 0.1)
        np.testing.assert_allclose(found.final[i, j], solution.x[-1], rtol=0, atol=1e-14)
        kept = found.laws[i, j]
        assert kept.sel(quantity="steps") == 40
        assert kept.sel(quantity="entropy_change") == pytest.approx(
            solution.entropy[-1] - solution.entropy[0], rel=1e-12
        )
        assert kept.sel(quantity="energy_drift") == pytest.approx(solution.audit().energy_drift, abs=1e-15)
    # the time constant, by the trapezoidal rule on the same steps
    rest = solution.entropy[-1] - solution.entropy
    assert found.tau[5, 2] == pytest.approx(np.trapezoid(rest, solution.t) / rest[0], rel=2e-2)


def test_a_parameter_that_is_refused_is_the_status_of_its_points(done):
    found = study(done[0]).results
    bad = found.sel(rate=-1.0)
    codes = dict(zip(found.status.flag_meanings.split(), found.status.flag_values, strict=True))
    assert (bad.status == codes["inadmissible"]).all()
    assert set(bad.message.values.tolist()) == {
        "a dissipation rate must be >= 0, not -1.0: a negative one would lower the entropy"
    }
    assert np.isnan(bad.tau).all()
    assert np.isnan(bad.final).all()
    assert (found.status.sel(rate=RATES[0]) == 0).all()


def test_the_audit_is_over_all_points_and_names_the_worst(done):
    audit = study(done[0]).audit()
    rows = {row.law: row for row in audit.rows}
    assert rows["energy drift"].passed
    assert "worst at rate = " in rows["energy drift"].note
    assert rows["points with status inadmissible"].value == 5
    assert not audit.passed
    assert audit.energy_drift == float(study(done[0]).results.laws.sel(quantity="energy_drift").max())
    assert not {row.law: row for row in study(done[0]).audit(energy=0.0, entropy=0.0).rows}["energy drift"].passed or (
        audit.energy_drift < 1e-15
    )
    with pytest.raises(lt.InputError, match="no tolerance 'energie'"):
        study(done[0]).audit(energie=1.0)


def test_chunks_and_their_order_make_no_difference_to_the_last_bit(done, tmp_path, monkeypatch):
    whole = study(done[0]).results.load()
    for chunk in (1, 3, 1000):
        found = study(tmp_path / f"{chunk}.zarr", chunk=chunk)
        found.run()
        assert found.results.drop_attrs().identical(whole.drop_attrs()), chunk

    def backwards(solver, store, axes, survey, bar):
        survey.remaining_chunks.reverse()
        run_locally(solver, store, axes, survey, bar)

    monkeypatch.setattr("liethermo.studies.study.here", backwards)
    assert study(tmp_path / "backwards.zarr").run().complete
    assert content(tmp_path / "backwards.zarr") == content(done[0])


def test_nothing_is_done_twice(done, monkeypatch):
    monkeypatch.setattr("liethermo.studies.study.here", lambda *_: pytest.fail("there is nothing to do"))
    before = content(done[0])
    assert study(done[0]).run().complete
    assert content(done[0]) == before


def test_longer_axes_run_the_new_points_alone(done, tmp_path):
    store = tmp_path / "longer.zarr"
    study(store, {"rate": RATES[:4], "ratio": RATIOS[::2]}).run()
    names = ("tau", "final", "laws")
    old = {name: study(store, {"rate": RATES[:4], "ratio": RATIOS[::2]}).results[name].values for name in names}
    asked = []

    def watched(solver, store, axes, survey, bar):
        columns = solver.columns
        solver.columns = lambda points, states, size, *rest: asked.append(size) or columns(points, states, size, *rest)
        run_locally(solver, store, axes, survey, bar)
        del solver.columns

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("liethermo.studies.study.here", watched)
        assert study(store).run().complete
    assert sum(asked) == 35 - 12
    found, whole = study(store).results.load(), study(done[0]).results.load()
    for name in (*names, "status", "message"):
        assert np.array_equal(found[name].values, whole[name].values, equal_nan=name in names), name
    for name in names:
        assert np.array_equal(found[name].values[:4, ::2], old[name])
    assert found.ratio.values.tolist() == RATIOS.tolist()  # in the order asked for, whatever that of the store


def test_damaged_and_missing_files_are_noticed_and_made_again(done, tmp_path):
    store = tmp_path / "damaged.zarr"
    study(store).run()
    whole = content(store)
    assert whole == content(done[0])
    (store / "tau/c/1/0").unlink()
    cut = store / "laws/c/0/0/0"
    cut.write_bytes(cut.read_bytes()[:-9])
    flipped = store / "status/c/3/0"
    flipped.write_bytes(bytes([flipped.read_bytes()[0] ^ 1]) + flipped.read_bytes()[1:])
    (store / "message/c/6/0").unlink()
    half_written = store / "tau/c" / f".0.abc{disk.PART_SUFFIX}"
    half_written.write_bytes(b"half")
    status = study(store).run()
    assert set(status.damaged) == {
        "tau/c/1/0 is missing",
        "laws/c/0/0/0 is damaged",
        "status/c/3/0 is damaged",
        "message/c/6/0 is missing",
    }
    assert "done again: tau/c/1/0 is missing" in str(status)
    assert content(store) == whole


def test_another_study_is_refused_and_the_difference_named(done):
    store, before = done[0], content(done[0])
    cases = {
        "step is 0.2, and 0.1": {"step": 0.2},
        "t_span is": {"t_span": (0.0, 5.0)},
        "method is": {"method": lt.MetriplecticRungeKutta(order=4)},
        "the initial state is 0.2": {"x0": [0.2, 1.0, 0.1]},
        "measures is": {"measure": {"tau": "relaxation_time"}},
        "the vector field is": {"build": lambda p: lt.models.rigid_body((1.0 + p["ratio"], 1.0, 0.7), p["rate"])},
        "the axis 'ratio' lacks 0.1": {"axes": {"rate": RATES, "ratio": [0.3]}},
        "the axes are rate": {
            "axes": {"rate": RATES, "ratio": RATIOS, "more": [1]},
            "build": lambda p: p["more"] and body(p),
        },
    }
    for message, changes in cases.items():
        with pytest.raises(lt.InputError, match="is the store of another study") as refused:
            study(store, **changes).run()
        assert message in str(refused.value)
    assert content(store) == before
    same = study(store, build=lambda p: lt.models.rigid_body((1.0 + p["ratio"], 1.0, 0.8), p["rate"]))
    assert same.run().complete  # another function that does the same


@pytest.mark.slow
def test_a_builder_that_looks_at_values_is_called_for_each_point(tmp_path):
    def chain(p):
        if p["rate"] > 1.0:
            raise ValueError("too fast")
        return lt.models.rigid_body((3.0, 2.0, 1.5) if p["kind"] == "top" else (2.0, 2.0, 1.0), p["rate"])

    axes = {"kind": ["top", "plate"], "rate": [0.5, 2.0]}
    found = study(tmp_path / "s.zarr", axes, build=chain)
    status = found.run()
    assert status.counts == {"completed": 2, "inadmissible": 2}
    results = found.results
    assert results.message.sel(kind="plate", rate=2.0).item() == "ValueError: too fast"
    direct = lt.integrate(lt.models.rigid_body((2.0, 2.0, 1.0), 0.5), X0, (0.0, 4.0), 0.1)
    np.testing.assert_allclose(results.final.sel(kind="plate", rate=0.5), direct.x[-1], rtol=0, atol=1e-14)


@pytest.mark.slow
def test_failures_broken_laws_and_measures_that_raise_are_statuses(tmp_path):
    def gains(p):  # a friction whose sign the library is not told
        energy = lt.Quadratic([1.0, 0.5, 0.25])

        def friction(x):
            dH = energy.gradient(x)
            return p["sign"] * (dH @ dH * jnp.eye(3) - jnp.outer(dH, dH))

        return lt.LiePoissonSystem(
            mf.so(3), energy, lt.Quadratic(jnp.ones(3)), lt.FrictionOperator(friction), validate=False
        )

    def moderate(solution):
        if solution.x[-1, 0] > 0.9:
            raise ArithmeticError("large")
        return solution.x[-1, :2]

    found = study(tmp_path / "s.zarr", {"sign": [1.0, -1.0]}, build=gains, measure={"m": moderate, "s": "steps"})
    status = found.run()
    results = found.results
    assert status.counts.get("law_broken") == 1, results.message.values
    assert "relative fall of the entropy" in results.message.sel(sign=-1.0).item()
    assert not {row.law: row for row in found.audit().rows}["relative fall of the entropy"].passed


def test_a_system_can_be_swept_by_the_names_of_its_parameters(tmp_path):
    system = lt.models.rigid_body((3.0, 2.0, 1.5), 1.0)
    found = study(tmp_path / "s.zarr", {"dissipation.rate": [0.2, 0.4], "energy.A[0]": [0.3, 0.4]}, build=system)
    assert found.run().ok
    direct = lt.ensemble(system, X0, (0.0, 4.0), 0.1, parameters={"dissipation.rate": np.array([0.2, 0.4])})
    wanted = lt.integrate(lt.models.rigid_body((2.5, 2.0, 1.5), 0.8), X0, (0.0, 4.0), 0.1).x[-1]
    np.testing.assert_allclose(found.results.final[1, 1], wanted, atol=1e-14)
    assert direct.x.shape == (2, 3)
    with pytest.raises(lt.InputError, match=r"no parameter 'rate' that is one number; it has"):
        study(axes={"rate": [0.1]}, build=system)


def test_replicas_and_initial_states_of_their_own(tmp_path):
    states = np.random.default_rng(0).normal(size=(5, 3))
    axes = {"rate": [0.3], "replica": lt.replicas(states)}
    found = study(tmp_path / "a.zarr", axes, x0=None, build=lambda p: body({"ratio": 0.2, **p}))
    found.run()
    seeded = study(
        tmp_path / "b.zarr",
        {"rate": [0.3], "seed": range(5)},
        x0=lambda p: np.random.default_rng(0).normal(size=(5, 3))[p["seed"]],
        build=lambda p: body({"ratio": 0.2, "rate": p["rate"]}),
    )
    seeded.run()
    assert np.array_equal(found.results.final.values, seeded.results.final.values)
    assert np.array_equal(found.results.replica_state, states)
    named = study(
        tmp_path / "c.zarr",
        {"place": ["pole", "equator"]},
        x0=lambda p: [0.0, 0.0, 1.0] if p["place"] == "pole" else [1.0, 0.0, 0.0],
        build=lambda p: body({"ratio": 0.2, "rate": 0.3}),
    )
    named.run()
    assert np.array_equal(named.results.final.sel(place="pole"), [0.0, 0.0, 1.0])  # both are equilibria
    assert np.array_equal(named.results.final.sel(place="equator"), [1.0, 0.0, 0.0])
    with pytest.raises(lt.InputError, match="x0 and replica"):
        study(axes=axes, build=body)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"axes": {"rate": [0.1], "ratio": [0.2], "idle": [1.0]}},
            "'idle' is looked at neither by the builder nor by x0",
        ),
        ({"axes": {"rate": [0.1]}}, "the builder asks for 'ratio', and no parameter of an axis is called so"),
        ({"axes": {"rate": [-1.0, -2.0], "ratio": [0.2]}}, "no point of the study can be run; the first: rate = -1"),
        ({"x0": [0.1, 1.0]}, "no point of the study can be run.*shape"),
        ({"measure": {"f": lambda solution: "text"}}, "f: .*not numbers"),
    ],
)
def test_what_cannot_be_run_is_said_before_anything_is_written(changes, message, tmp_path):
    with pytest.raises(lt.InputError, match=message):
        study(tmp_path / "s.zarr", **changes).run()
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measure": {}}, "measure is a dict"),
        ({"measure": {"m": "median"}}, "the measure 'm' is lt.Relaxed"),
        ({"measure": {"rate": "final"}}, "'rate' is a measure and an axis"),
        ({"measure": {"m": lt.At([1.0, 9.0])}}, "and 1 to 9 do not"),
        ({"measure": {"a": lt.Relaxed(1e-3), "b": lt.Relaxed(1e-4)}}, "is to end it too"),
        ({"chunk": 0}, "chunk must be a positive integer"),
        ({"measure": {"a": lt.At([0.25]), "f": len}}, "lt.At takes times at which steps end, not 0.25"),
        ({"x0": None}, "x0 is missing"),
        ({"method": "midpoint"}, "the method must be an integrator"),
        ({"units": {"speed": "m/s"}}, "no axis, parameter or measure 'speed'"),
        ({"build": 3}, "a study takes a system"),
        ({"step": -0.1}, "step must be positive"),
        ({"engine": "gpu"}, "engine"),
    ],
)
def test_bad_arguments(changes, message):
    with pytest.raises(lt.InputError, match=message):
        study(**changes)


def test_folders_that_are_no_stores_and_folders_that_cannot_be_written(tmp_path, monkeypatch, done):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("dear reader")
    for call in (lambda s: s.run(), lambda s: s.status(), lambda s: s.results):
        with pytest.raises(lt.FileError, match=r"thesis is a folder, but not the store of a study"):
            call(study(tmp_path / "thesis"))
    with pytest.raises(lt.FileError, match="there is no store"):
        _ = study(tmp_path / "none.zarr").results

    def refuse(self, *_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(lt.FileError, match=r"cannot make the store .*Permission denied"):
        study(tmp_path / "readonly" / "s.zarr").run()


def test_a_full_disk_is_said_and_loses_nothing(done, tmp_path, monkeypatch):
    store, write, left = tmp_path / "s.zarr", disk.write_atomically, [40]

    def short(path, data):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(disk, "write", short)
        with pytest.raises(lt.FileError, match=r"the disk is full .*What is done is kept"):
            study(store).run()
    status = study(store).status()
    assert 0 < status.done < status.points
    assert np.isfinite(study(store).results.tau).sum() >= status.done
    assert study(store).run().complete
    assert content(store) == content(done[0])


def test_two_runs_at_once_and_a_status_from_outside(done, tmp_path):
    store = done[0]
    with files.lock_store(store) as tell:
        tell(0)
        with pytest.raises(lt.FileError, match=f"another run works on .*process {os.getpid()} on"):
            study(store).run()
        status = study(store).status()
        assert status.running["pid"] == os.getpid()
        assert status.seconds_left == 0.0
        assert "works on it" in str(status)
    assert study(store).status().running is None


def test_ctrl_c_leaves_a_store_to_go_on_from(done, tmp_path, monkeypatch):
    store = tmp_path / "s.zarr"

    def interrupted(solver, store, axes, survey, bar):
        del survey.remaining_chunks[3:]
        run_locally(solver, store, axes, survey, bar)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("liethermo.studies.study.here", interrupted)
        status = study(store).run()
    assert status.interrupted
    assert (status.done, status.points) == (15, 35)
    assert "interrupted; run the study again to go on" in str(status)
    assert study(store).run().complete
    assert content(store) == content(done[0])


def test_events_adaptive_steps_given_times_and_functions_of_a_solution(tmp_path):
    def turned(solution):
        return np.abs(solution.x).max(axis=0)

    measure = {
        "relaxed": lt.Relaxed(1e-3),
        "at": lt.At([0.25, 1.0]),
        "entropy": lt.At([1.0], "entropy"),
        "end": "end_time",
    }
    span, times = (0.0, 90.0), [0.25, 1.0]
    axes = {"rate": [0.5, -1.0, 2.0, 1e-9], "ratio": [0.3]}
    found = study(tmp_path / "s.zarr", axes, t_span=span, step=lt.Adaptive(1e-9), measure=measure)
    assert found.run().counts == {"event": 2, "inadmissible": 1, "completed": 1}
    results = found.results
    for rate in (0.5, 2.0):
        system = body({"rate": rate, "ratio": 0.3})
        alone = lt.integrate(system, X0, span, lt.Adaptive(1e-9), until=lt.Relaxed(1e-3), save_at=times)
        point = results.sel(rate=rate, ratio=0.3)
        assert point.relaxed == pytest.approx(alone.event_time, rel=1e-12)
        assert point.end == point.relaxed
        np.testing.assert_allclose(point["at"], alone.x[[list(alone.t).index(t) for t in times]], rtol=0, atol=1e-13)
        assert point.entropy.item() == pytest.approx(alone.entropy[list(alone.t).index(1.0)], rel=1e-13)
    assert np.isnan(results.relaxed.sel(rate=1e-9))
    assert results.end.sel(rate=1e-9) == 90.0
    assert results.relaxed.long_name == "time of relaxation, to a rate below 0.001"

    def growing(solution):
        return np.ones(2 if solution.entropy[-1] < 0.55 else 3)

    for chunk in (1, 8):  # the first point tells the shape, and not those who are solved beside another
        pair = {"rate": [0.5, 2.0], "ratio": [0.3]}
        uneven = study(tmp_path / f"u{chunk}.zarr", pair, measure={"g": growing}, chunk=chunk)
        assert uneven.run().counts == {"completed": 1, "measure_failed": 1}
        assert "real numbers of shape (3,), and real numbers of shape (2,)" in uneven.results.message[1, 0].item()

    shaped = study(tmp_path / "f.zarr", {"rate": [0.5, 2.0], "ratio": [0.3]}, measure={"turned": turned})
    assert shaped.run().ok
    wanted = turned(lt.integrate(body({"rate": 2.0, "ratio": 0.3}), X0, (0.0, 4.0), 0.1))
    np.testing.assert_allclose(shaped.results.bind_attitude[1, 0], wanted, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_what_the_array_engine_runs_does_not_depend_on_chunks_either(tmp_path):
    results = []
    for chunk in (1, 7):
        found = study(tmp_path / f"{chunk}.zarr", chunk=chunk, engine="array", t_span=(0.0, 1.0))
        found.run()
        results.append(found.results.load().drop_attrs())
    assert results[0].identical(results[1])


VICTIM = """
import sys
sys.path.insert(0, {root!r})
from tests.liethermo.studies.cases import study
from liethermo.studies import running
running.TOGETHER = 1
print("ready", flush=True)
study({store!r}).run()
"""


def killed(store, delay, random):
    """Run the study in another process, and kill it so many seconds after it has begun."""
    code = textwrap.dedent(VICTIM.format(root=str(ROOT), store=str(store)))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=ROOT) as process:
        process.stdout.readline()
        deadline = time.time() + 60.0
        while not (store / "tau/c").exists() and time.time() < deadline and process.poll() is None:
            time.sleep(0.002)
        time.sleep(delay * random.random())
        process.send_signal(signal.SIGKILL)
        process.wait()


@pytest.mark.parametrize("repetitions", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_a_process_that_is_killed_loses_what_it_was_at(repetitions, done, tmp_path):
    random, partly = np.random.default_rng(5), 0
    for i in range(repetitions):
        store = tmp_path / f"{i}.zarr"
        killed(store, 0.05, random)
        status = study(store).status()
        partly += 0 < status.done < status.points
        assert study(store).run().complete
        assert content(store) == content(done[0])
    assert repetitions == 1 or partly > repetitions // 3, "kills fell too early or too late to mean much"


def spin_in_a_bath(point):
    field = jnp.array([0.0, 0.0, 1.0])
    return lt.LiePoissonSystem(mf.so(3), lambda m: -m @ field, dissipation=lt.DoubleBracket(point["rate"]))


def test_noise_of_a_point_is_its_own(tmp_path):
    """Chunks, other points and longer axes do not change it; another seed, or another place, does."""

    def study(rates, name, chunk, seed=3):
        return lt.Study(
            spin_in_a_bath, {"rate": rates, "copy": lt.replicas(4)}, x0=[0.6, 0.0, 0.8], t_span=(0.0, 1.0), step=0.1,
            measure={"final": "final"}, noise=lt.Fluctuations(0.2, seed, temperature=1.0), chunk=chunk,
            store=tmp_path / f"{name}.zarr",
        )  # fmt: skip

    rates = [0.5, 1.0]
    whole, cut = study(rates, "whole", 64), study(rates, "cut", 3)
    whole.run()
    cut.run()
    ends = whole.results["final"].values
    assert np.array_equal(ends, cut.results["final"].values)
    assert len(np.unique(ends[..., 0])) == 8, "every point has its own"
    longer = study([*rates, 2.0], "whole", 64)
    longer.run()
    assert np.array_equal(longer.results["final"].values[:2], ends)
    other = study(rates, "other", 64, seed=4)
    other.run()
    assert not np.array_equal(other.results["final"].values, ends)
    with pytest.raises(lt.InputError, match="noise"):
        study(rates, "whole", 64, seed=4).run()
    assert np.abs(np.linalg.norm(ends, axis=-1) - 1.0).max() < 1e-14


def test_noise_at_a_place_is_that_of_its_seed(tmp_path):
    noise = lt.Fluctuations(0.2, 3, temperature=1.0)
    study = lt.Study(
        spin_in_a_bath, {"rate": [0.5, 1.0]}, x0=[0.6, 0.0, 0.8], t_span=(0.0, 1.0), step=0.1,
        measure={"final": "final"}, noise=noise, store=tmp_path / "one.zarr",
    )  # fmt: skip
    study.run()
    seed = int(noise.grid_seeds([np.array([1])])[0])
    alone = lt.integrate(
        spin_in_a_bath({"rate": 1.0}), [0.6, 0.0, 0.8], (0.0, 1.0), 0.1,
        noise=lt.Fluctuations(0.2, seed, temperature=1.0),
    )  # fmt: skip
    assert np.abs(study.results["final"].values[1] - alone.x[-1]).max() < 1e-14


@pytest.mark.parametrize(
    "taken", [lambda results: results["end"], lambda results: results.isel(end_component=0)["end"]]
)
def test_results_outlive_a_study_without_a_store(taken):
    """What is not read yet holds the files, which go with the last that does."""
    axes = {"dissipation.rate": [0.1, 0.3]}
    of_ends = lt.Study(lt.models.rigid_body(), axes, x0=X0, t_span=(0.0, 0.2), step=0.1, measure={"end": "final"})
    of_ends.run(progress=False)
    folder, expected = of_ends.store.parent, taken(of_ends.results).values
    kept = taken(of_ends.results)
    del of_ends
    gc.collect()
    assert np.isfinite(expected).all()
    assert np.array_equal(kept.values, expected)
    del kept
    gc.collect()
    assert not folder.exists()
