"""Studies from beginning to end: values, statuses, restarts, extensions, and stores of other studies."""

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
from liethermo.studies import store_metadata
from liethermo.studies.running import solve_chunks_locally

from .cases import RATES, RATIOS, X0, body, content, study

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def finished_study(tmp_path_factory):
    """The path of a store that was never disturbed, and the status of its run."""
    store = tmp_path_factory.mktemp("studies") / "whole.zarr"
    return store, study(store).run()


def test_every_point_is_what_a_run_of_its_own_gives(finished_study):
    store, status = finished_study
    assert status.complete
    assert not status.ok
    assert status.counts == {"completed": 30, "inadmissible": 5}
    results = study(store).results
    assert dict(results.sizes) == {"rate": 7, "ratio": 5, "quantity": 13, "final_component": 3}
    assert np.array_equal(results.rate, RATES)
    for i, j in ((0, 0), (3, 4), (5, 2)):
        solution = lt.integrate(body({"rate": RATES[i], "ratio": RATIOS[j]}), X0, (0.0, 4.0), 0.1)
        np.testing.assert_allclose(results.final[i, j], solution.x[-1], rtol=0, atol=1e-14)
        law_quantities = results.laws[i, j]
        assert law_quantities.sel(quantity="steps") == 40
        assert law_quantities.sel(quantity="entropy_change") == pytest.approx(
            solution.entropy[-1] - solution.entropy[0], rel=1e-12
        )
        assert law_quantities.sel(quantity="energy_drift") == pytest.approx(solution.audit().energy_drift, abs=1e-15)
    # the time constant, by the trapezoidal rule on the same steps
    rest = solution.entropy[-1] - solution.entropy
    assert results.tau[5, 2] == pytest.approx(np.trapezoid(rest, solution.t) / rest[0], rel=2e-2)


def test_a_parameter_that_is_refused_is_the_status_of_its_points(finished_study):
    results = study(finished_study[0]).results
    bad = results.sel(rate=-1.0)
    codes = dict(zip(results.status.flag_meanings.split(), results.status.flag_values, strict=True))
    assert (bad.status == codes["inadmissible"]).all()
    assert set(bad.message.values.tolist()) == {
        "a dissipation rate must be >= 0 and finite, got -1.0: a negative rate would lower the entropy"
    }
    assert np.isnan(bad.tau).all()
    assert np.isnan(bad.final).all()
    assert (results.status.sel(rate=RATES[0]) == 0).all()


def test_the_audit_is_over_all_points_and_names_the_worst(finished_study):
    audit = study(finished_study[0]).audit()
    rows = {row.law: row for row in audit.rows}
    assert rows["energy drift"].passed
    assert "worst at rate = " in rows["energy drift"].note
    assert rows["points with status inadmissible"].value == 5
    assert not audit.passed
    assert audit.energy_drift == float(study(finished_study[0]).results.laws.sel(quantity="energy_drift").max())
    assert not {row.law: row for row in study(finished_study[0]).audit(energy=0.0, entropy=0.0).rows}[
        "energy drift"
    ].passed or (audit.energy_drift < 1e-15)
    with pytest.raises(lt.InputError, match="no tolerance 'energie'"):
        study(finished_study[0]).audit(energie=1.0)


def test_chunks_and_their_order_make_no_difference_to_the_last_bit(finished_study, tmp_path, monkeypatch):
    reference_results = study(finished_study[0]).results.load()
    for chunk in (1, 3, 1000):
        rechunked = study(tmp_path / f"{chunk}.zarr", chunk=chunk)
        rechunked.run()
        assert rechunked.results.drop_attrs().identical(reference_results.drop_attrs()), chunk

    def run_in_reverse(solver, store, axes, survey, bar):
        survey.remaining_chunks.reverse()
        solve_chunks_locally(solver, store, axes, survey, bar)

    monkeypatch.setattr("liethermo.studies.study.solve_chunks_locally", run_in_reverse)
    assert study(tmp_path / "backwards.zarr").run().complete
    assert content(tmp_path / "backwards.zarr") == content(finished_study[0])


def test_nothing_is_done_twice(finished_study, monkeypatch):
    monkeypatch.setattr(
        "liethermo.studies.study.solve_chunks_locally", lambda *_: pytest.fail("there is nothing to do")
    )
    initial_content = content(finished_study[0])
    assert study(finished_study[0]).run().complete
    assert content(finished_study[0]) == initial_content


def test_longer_axes_run_the_new_points_alone(finished_study, tmp_path):
    store = tmp_path / "longer.zarr"
    study(store, {"rate": RATES[:4], "ratio": RATIOS[::2]}).run()
    names = ("tau", "final", "laws")
    old_values = {name: study(store, {"rate": RATES[:4], "ratio": RATIOS[::2]}).results[name].values for name in names}
    solved_counts = []

    def run_and_count(solver, store, axes, survey, bar):
        solve = solver.solve
        solver.solve = lambda points, states, count, *rest: (
            solved_counts.append(count) or solve(points, states, count, *rest)
        )
        solve_chunks_locally(solver, store, axes, survey, bar)
        del solver.solve

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("liethermo.studies.study.solve_chunks_locally", run_and_count)
        assert study(store).run().complete
    assert sum(solved_counts) == 35 - 12
    extended_results, reference_results = study(store).results.load(), study(finished_study[0]).results.load()
    for name in (*names, "status", "message"):
        assert np.array_equal(extended_results[name].values, reference_results[name].values, equal_nan=name in names), (
            name
        )
    for name in names:
        assert np.array_equal(extended_results[name].values[:4, ::2], old_values[name])
    assert (
        extended_results.ratio.values.tolist() == RATIOS.tolist()
    )  # in the order asked for, whatever that of the store


def test_damaged_and_missing_files_are_noticed_and_made_again(finished_study, tmp_path):
    store = tmp_path / "damaged.zarr"
    study(store).run()
    undamaged = content(store)
    assert undamaged == content(finished_study[0])
    (store / "tau/c/1/0").unlink()
    truncated_file = store / "laws/c/0/0/0"
    truncated_file.write_bytes(truncated_file.read_bytes()[:-9])
    changed_file = store / "status/c/3/0"
    changed_file.write_bytes(bytes([changed_file.read_bytes()[0] ^ 1]) + changed_file.read_bytes()[1:])
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
    assert content(store) == undamaged


def test_another_study_is_refused_and_the_difference_named(finished_study):
    store, initial_content = finished_study[0], content(finished_study[0])
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
        with pytest.raises(lt.InputError, match="is the store of another study") as error:
            study(store, **changes).run()
        assert message in str(error.value)
    assert content(store) == initial_content
    equal_study = study(store, build=lambda p: lt.models.rigid_body((1.0 + p["ratio"], 1.0, 0.8), p["rate"]))
    assert equal_study.run().complete  # another function that does the same


@pytest.mark.slow
def test_a_builder_that_looks_at_values_is_called_for_each_point(tmp_path):
    def chain(p):
        if p["rate"] > 1.0:
            raise ValueError("too fast")
        return lt.models.rigid_body((3.0, 2.0, 1.5) if p["kind"] == "top" else (2.0, 2.0, 1.0), p["rate"])

    axes = {"kind": ["top", "plate"], "rate": [0.5, 2.0]}
    parameter_study = study(tmp_path / "s.zarr", axes, build=chain)
    status = parameter_study.run()
    assert status.counts == {"completed": 2, "inadmissible": 2}
    results = parameter_study.results
    assert results.message.sel(kind="plate", rate=2.0).item() == "ValueError: too fast"
    direct = lt.integrate(lt.models.rigid_body((2.0, 2.0, 1.0), 0.5), X0, (0.0, 4.0), 0.1)
    np.testing.assert_allclose(results.final.sel(kind="plate", rate=0.5), direct.x[-1], rtol=0, atol=1e-14)


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

    parameter_study = study(
        tmp_path / "s.zarr", {"sign": [1.0, -1.0]}, build=gains, measure={"m": moderate, "s": "steps"}
    )
    status = parameter_study.run()
    results = parameter_study.results
    assert status.counts.get("law_broken") == 1, results.message.values
    assert "least entropy increment" in results.message.sel(sign=-1.0).item()
    assert not {row.law: row for row in parameter_study.audit().rows}["least entropy increment"].passed


def test_a_system_can_be_swept_by_the_names_of_its_parameters(tmp_path):
    system = lt.models.rigid_body((3.0, 2.0, 1.5), 1.0)
    parameter_study = study(
        tmp_path / "s.zarr", {"dissipation.rate": [0.2, 0.4], "energy.A[0]": [0.3, 0.4]}, build=system
    )
    assert parameter_study.run().ok
    direct = lt.ensemble(system, X0, (0.0, 4.0), 0.1, parameters={"dissipation.rate": np.array([0.2, 0.4])})
    final_state = lt.integrate(lt.models.rigid_body((2.5, 2.0, 1.5), 0.8), X0, (0.0, 4.0), 0.1).x[-1]
    np.testing.assert_allclose(parameter_study.results.final[1, 1], final_state, atol=1e-14)
    assert direct.x.shape == (2, 3)
    with pytest.raises(lt.InputError, match=r"no parameter 'rate' that is one number; it has"):
        study(axes={"rate": [0.1]}, build=system)


def test_replicas_and_initial_states_of_their_own(tmp_path):
    states = np.random.default_rng(0).normal(size=(5, 3))
    axes = {"rate": [0.3], "replica": lt.replicas(states)}
    replica_study = study(tmp_path / "a.zarr", axes, x0=None, build=lambda p: body({"ratio": 0.2, **p}))
    replica_study.run()
    seed_study = study(
        tmp_path / "b.zarr",
        {"rate": [0.3], "seed": range(5)},
        x0=lambda p: np.random.default_rng(0).normal(size=(5, 3))[p["seed"]],
        build=lambda p: body({"ratio": 0.2, "rate": p["rate"]}),
    )
    seed_study.run()
    assert np.array_equal(replica_study.results.final.values, seed_study.results.final.values)
    assert np.array_equal(replica_study.results.replica_state, states)
    text_study = study(
        tmp_path / "c.zarr",
        {"place": ["pole", "equator"]},
        x0=lambda p: [0.0, 0.0, 1.0] if p["place"] == "pole" else [1.0, 0.0, 0.0],
        build=lambda p: body({"ratio": 0.2, "rate": 0.3}),
    )
    text_study.run()
    assert np.array_equal(text_study.results.final.sel(place="pole"), [0.0, 0.0, 1.0])  # both are equilibria
    assert np.array_equal(text_study.results.final.sel(place="equator"), [1.0, 0.0, 0.0])
    with pytest.raises(lt.InputError, match="x0 and replica"):
        study(axes=axes, build=body)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"axes": {"rate": [0.1], "ratio": [0.2], "idle": [1.0]}},
            "axis 'idle' is used by neither build nor x0",
        ),
        ({"axes": {"rate": [0.1]}}, "the builder asks for 'ratio', and no parameter of an axis is called so"),
        ({"axes": {"rate": [-1.0, -2.0], "ratio": [0.2]}}, "no point of the study can be run; the first: rate = -1"),
        ({"x0": [0.1, 1.0]}, "no point of the study can be run.*shape"),
        ({"measure": {"f": lambda solution: "text"}}, "f: .*not numbers"),
    ],
)
def test_a_study_that_cannot_run_is_refused_before_anything_is_written(changes, message, tmp_path):
    with pytest.raises(lt.InputError, match=message):
        study(tmp_path / "s.zarr", **changes).run()
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measure": {}}, "measure must be a dict"),
        ({"measure": {"m": "median"}}, "the measure 'm' must be lt.Relaxed"),
        ({"measure": {"rate": "final"}}, "'rate' names a measure and an axis"),
        ({"measure": {"m": lt.At([1.0, 9.0])}}, "got 1 to 9"),
        ({"measure": {"a": lt.Relaxed(1e-3), "b": lt.Relaxed(1e-4)}}, "is to end it too"),
        ({"chunk": 0}, "chunk must be a positive integer"),
        ({"measure": {"a": lt.At([0.25]), "f": len}}, "the times of lt.At must be ends of steps, got 0.25"),
        ({"x0": None}, "x0 is missing"),
        ({"method": "midpoint"}, "method must be an integrator"),
        ({"units": {"speed": "m/s"}}, "no axis, parameter or measure 'speed'"),
        ({"build": 3}, "build must be a system"),
        ({"step": -0.1}, "step must be positive"),
        ({"engine": "gpu"}, "engine"),
    ],
)
def test_invalid_arguments_are_refused(changes, message):
    with pytest.raises(lt.InputError, match=message):
        study(**changes)


def test_folders_that_are_no_stores_and_folders_that_cannot_be_written(tmp_path, monkeypatch, finished_study):
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


def test_a_full_disk_is_said_and_loses_nothing(finished_study, tmp_path, monkeypatch):
    store, write, writes_left = tmp_path / "s.zarr", disk.write_atomically, [40]

    def write_to_full_disk(path, data):
        writes_left[0] -= 1
        if writes_left[0] < 0:
            raise OSError(28, "No space left on device")
        write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(disk, "write_atomically", write_to_full_disk)
        with pytest.raises(lt.FileError, match=r"the disk is full .*Finished chunks are saved"):
            study(store).run()
    status = study(store).status()
    assert 0 < status.done < status.points
    assert np.isfinite(study(store).results.tau).sum() >= status.done
    assert study(store).run().complete
    assert content(store) == content(finished_study[0])


def test_two_runs_at_once_and_a_status_from_outside(finished_study, tmp_path):
    store = finished_study[0]
    with store_metadata.lock_store(store) as record_run:
        record_run(0)
        with pytest.raises(lt.FileError, match=f"another run works on .*process {os.getpid()} on"):
            study(store).run()
        status = study(store).status()
        assert status.running["pid"] == os.getpid()
        assert status.seconds_left == 0.0
        assert "works on it" in str(status)
    assert study(store).status().running is None


def test_ctrl_c_leaves_a_store_to_go_on_from(finished_study, tmp_path, monkeypatch):
    store = tmp_path / "s.zarr"

    def run_and_interrupt(solver, store, axes, survey, bar):
        del survey.remaining_chunks[3:]
        solve_chunks_locally(solver, store, axes, survey, bar)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("liethermo.studies.study.solve_chunks_locally", run_and_interrupt)
        status = study(store).run()
    assert status.interrupted
    assert (status.done, status.points) == (15, 35)
    assert "interrupted; run the study again to go on" in str(status)
    assert study(store).run().complete
    assert content(store) == content(finished_study[0])


def test_events_adaptive_steps_given_times_and_functions_of_a_solution(tmp_path):
    def largest_components(solution):
        return np.abs(solution.x).max(axis=0)

    measure = {
        "relaxed": lt.Relaxed(1e-3),
        "at": lt.At([0.25, 1.0]),
        "entropy": lt.At([1.0], "entropy"),
        "end": "end_time",
    }
    span, times = (0.0, 90.0), [0.25, 1.0]
    axes = {"rate": [0.5, -1.0, 2.0, 1e-9], "ratio": [0.3]}
    parameter_study = study(tmp_path / "s.zarr", axes, t_span=span, step=lt.Adaptive(1e-9), measure=measure)
    assert parameter_study.run().counts == {"event": 2, "inadmissible": 1, "completed": 1}
    results = parameter_study.results
    for rate in (0.5, 2.0):
        system = body({"rate": rate, "ratio": 0.3})
        single_run = lt.integrate(system, X0, span, lt.Adaptive(1e-9), until=lt.Relaxed(1e-3), save_at=times)
        point = results.sel(rate=rate, ratio=0.3)
        assert point.relaxed == pytest.approx(single_run.event_time, rel=1e-12)
        assert point.end == point.relaxed
        np.testing.assert_allclose(
            point["at"], single_run.x[[list(single_run.t).index(t) for t in times]], rtol=0, atol=1e-13
        )
        assert point.entropy.item() == pytest.approx(single_run.entropy[list(single_run.t).index(1.0)], rel=1e-13)
    assert np.isnan(results.relaxed.sel(rate=1e-9))
    assert results.end.sel(rate=1e-9) == 90.0
    assert results.relaxed.long_name == "time of relaxation, to a rate below 0.001"

    def varying_shape(solution):
        return np.ones(2 if solution.entropy[-1] < 0.55 else 3)

    for chunk in (1, 8):  # the first point tells the shape, and not those who are solved beside another
        pair = {"rate": [0.5, 2.0], "ratio": [0.3]}
        uneven = study(tmp_path / f"u{chunk}.zarr", pair, measure={"g": varying_shape}, chunk=chunk)
        assert uneven.run().counts == {"completed": 1, "measure_failed": 1}
        assert "real numbers of shape (3,), but real numbers of shape (2,)" in uneven.results.message[1, 0].item()

    array_study = study(
        tmp_path / "f.zarr", {"rate": [0.5, 2.0], "ratio": [0.3]}, measure={"turned": largest_components}
    )
    assert array_study.run().ok
    expected_value = largest_components(lt.integrate(body({"rate": 2.0, "ratio": 0.3}), X0, (0.0, 4.0), 0.1))
    np.testing.assert_allclose(array_study.results.turned[1, 0], expected_value, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_results_of_the_array_engine_do_not_depend_on_chunks(tmp_path):
    results = []
    for chunk in (1, 7):
        parameter_study = study(tmp_path / f"{chunk}.zarr", chunk=chunk, engine="array", t_span=(0.0, 1.0))
        parameter_study.run()
        results.append(parameter_study.results.load().drop_attrs())
    assert results[0].identical(results[1])


VICTIM = """
import sys
sys.path.insert(0, {root!r})
from tests.liethermo.studies.cases import study
from liethermo.studies import running
running.MAX_POINTS_PER_PORTION = 1
print("ready", flush=True)
study({store!r}).run()
"""


def run_and_kill(store, delay, random):
    """Run the study in another process, and kill it up to ``delay`` seconds after its first result."""
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
def test_a_killed_process_loses_only_its_unfinished_chunks(repetitions, finished_study, tmp_path):
    random, n_partial = np.random.default_rng(5), 0
    for i in range(repetitions):
        store = tmp_path / f"{i}.zarr"
        run_and_kill(store, 0.05, random)
        status = study(store).status()
        n_partial += 0 < status.done < status.points
        assert study(store).run().complete
        assert content(store) == content(finished_study[0])
    assert repetitions == 1 or n_partial > repetitions // 3, "kills fell too early or too late to mean much"


def spin_in_a_bath(point):
    field = jnp.array([0.0, 0.0, 1.0])
    return lt.LiePoissonSystem(mf.so(3), lambda m: -m @ field, dissipation=lt.DoubleBracket(point["rate"]))


def test_noise_of_a_point_depends_on_its_place_and_the_seed_alone(tmp_path):
    """Chunks, other points and longer axes do not change the noise; another seed or place does."""

    def study(rates, name, chunk, seed=3):
        return lt.Study(
            spin_in_a_bath, {"rate": rates, "copy": lt.replicas(4)}, x0=[0.6, 0.0, 0.8], t_span=(0.0, 1.0), step=0.1,
            measure={"final": "final"}, noise=lt.Fluctuations(0.2, seed, temperature=1.0), chunk=chunk,
            store=tmp_path / f"{name}.zarr",
        )  # fmt: skip

    rates = [0.5, 1.0]
    one_chunk, small_chunks = study(rates, "whole", 64), study(rates, "cut", 3)
    one_chunk.run()
    small_chunks.run()
    ends = one_chunk.results["final"].values
    assert np.array_equal(ends, small_chunks.results["final"].values)
    assert len(np.unique(ends[..., 0])) == 8, "every point has its own"
    extended = study([*rates, 2.0], "whole", 64)
    extended.run()
    assert np.array_equal(extended.results["final"].values[:2], ends)
    reseeded = study(rates, "other", 64, seed=4)
    reseeded.run()
    assert not np.array_equal(reseeded.results["final"].values, ends)
    with pytest.raises(lt.InputError, match="noise"):
        study(rates, "whole", 64, seed=4).run()
    assert np.abs(np.linalg.norm(ends, axis=-1) - 1.0).max() < 1e-14


def test_noise_of_a_point_is_that_of_a_run_with_its_seed(tmp_path):
    noise = lt.Fluctuations(0.2, 3, temperature=1.0)
    study = lt.Study(
        spin_in_a_bath, {"rate": [0.5, 1.0]}, x0=[0.6, 0.0, 0.8], t_span=(0.0, 1.0), step=0.1,
        measure={"final": "final"}, noise=noise, store=tmp_path / "one.zarr",
    )  # fmt: skip
    study.run()
    seed = int(noise.grid_seeds([np.array([1])])[0])
    single_run = lt.integrate(
        spin_in_a_bath({"rate": 1.0}), [0.6, 0.0, 0.8], (0.0, 1.0), 0.1,
        noise=lt.Fluctuations(0.2, seed, temperature=1.0),
    )  # fmt: skip
    assert np.abs(study.results["final"].values[1] - single_run.x[-1]).max() < 1e-14


@pytest.mark.parametrize(
    "select", [lambda results: results["end"], lambda results: results.isel(end_component=0)["end"]]
)
def test_results_outlive_a_study_without_a_store(select):
    """Results that are not read yet keep the temporary files; these go with the last reference."""
    axes = {"dissipation.rate": [0.1, 0.3]}
    parameter_study = lt.Study(
        lt.models.rigid_body(), axes, x0=X0, t_span=(0.0, 0.2), step=0.1, measure={"end": "final"}
    )
    parameter_study.run(progress=False)
    folder, values = parameter_study.store.parent, select(parameter_study.results).values
    selection = select(parameter_study.results)
    del parameter_study
    gc.collect()
    assert np.isfinite(values).all()
    assert np.array_equal(selection.values, values)
    del selection
    gc.collect()
    assert not folder.exists()
