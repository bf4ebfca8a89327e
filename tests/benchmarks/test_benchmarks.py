"""The benchmarks run, the C programs take the same steps, and missing peers are reported. Nothing is timed here."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from benchmarks import child, first_page, laws, native, page, reference, simulators
from benchmarks.__main__ import RESULT_FOLDER, main
from benchmarks.contest import max_difference_from_c
from benchmarks.heat_bath import simulate_heisenberg_heat_bath
from benchmarks.laws import Laws
from benchmarks.measurements import magnet, manifolds, memory, spin, tumbling, variational
from benchmarks.native import BodyProgram, EnsembleProgram
from benchmarks.peers import scipy_run
from benchmarks.problems import X0, body_parameters, general_body, general_parameters, quadratic_body, random_states
from benchmarks.report import Report, Table, Target, UnavailableError
from benchmarks.timing import race
from liethermo import MetriplecticGauss
from liethermo.engines.solver_options import DEFAULT_OPTIONS
from liethermo.engines.status_codes import StatusCode

ROOT = Path(__file__).resolve().parents[2]

needs_compiler = pytest.mark.skipif(native.find_c_compiler() is None, reason="no C compiler")


@pytest.fixture
def bare_machine(monkeypatch):
    """A machine without a C compiler and without the optional peers."""
    monkeypatch.setenv("CC", "no-such-compiler")
    for name in ("diffrax", "heyoka"):
        monkeypatch.setitem(sys.modules, name, None)
    native.compile_library.cache_clear()
    yield
    native.compile_library.cache_clear()


@pytest.mark.slow
def test_the_driver_on_a_bare_machine(bare_machine, tmp_path, capsys):
    main(["work_precision", "--quick", "--out", str(tmp_path)])
    output = capsys.readouterr().out
    for name in (
        "midpoint, C (no C compiler was found",
        "diffrax Tsit5 (diffrax is not",
        "heyoka Taylor (heyoka is not",
    ):
        assert f"Left out: {name}" in output
    result = json.loads((tmp_path / "work_precision.json").read_text())
    rows = {row[0]: row for row in result["report"]["tables"][1]["rows"]}
    assert {"midpoint, compiled engine", "midpoint, array engine", "SciPy DOP853"} == rows.keys()
    assert all(rows[f"midpoint, {engine} engine"][-1] == "hold" for engine in ("array", "compiled"))
    assert rows["SciPy DOP853"][-1] == "broken: energy"

    with pytest.raises(ValueError, match="holds no results"):  # quick ones do not count
        page.write_pages(tmp_path, tmp_path / "page.md", tmp_path / "runs.md")
    result["quick"] = False
    (tmp_path / "work_precision.json").write_text(json.dumps(result))
    page.write_pages(tmp_path, tmp_path / "page.md", tmp_path / "runs.md")
    assert "| midpoint, array engine | 500 steps |" in (tmp_path / "runs.md").read_text()
    assert (tmp_path / "work_precision.svg").read_text().count("SciPy DOP853") == 1


MAIN_PAGE = Path("docs/reference/benchmarks.md")
LEARNING_PAGE = MAIN_PAGE.with_name(page.LEARNING_PAGE_NAME)
RUNS = Path("benchmarks/runs.md")


def test_all_pages_are_those_of_the_kept_results(tmp_path):
    for path in (MAIN_PAGE, RUNS):
        (tmp_path / path).parent.mkdir(parents=True)
    page.write_pages(RESULT_FOLDER, tmp_path / MAIN_PAGE, tmp_path / RUNS)
    for path in (MAIN_PAGE, LEARNING_PAGE, RUNS):
        assert (tmp_path / path).read_text() == (ROOT / path).read_text(), f"{path}: python -m benchmarks --kept --page"
    main_page = (tmp_path / MAIN_PAGE).read_text()
    assert len(main_page.split()) <= 3500
    assert (
        main_page.index("![") < main_page.index("\n- **") < main_page.index("\n| ")
    )  # the chart, the sentences, the tables
    assert "broken" not in main_page
    times = [row.split("|")[3].strip() for row in main_page.splitlines() if row.count("\u00a0× |") == 1]
    assert len(times) > 30
    assert all(re.match(r"an? (step|run|body|state)\b", unit) for unit in times)  # what each time is the time of
    chart = (tmp_path / MAIN_PAGE).with_suffix(".svg").read_text()
    width_points = float(re.search(r'<svg [^>]*width="([\d.]+)pt"', chart)[1])
    smallest_font = min(float(size) for size in re.findall(r"font(?:-size)?: [^;\"]*?([\d.]+)px", chart))
    assert smallest_font * 358 / width_points >= 10  # pixels, where the screen has 390 and the chart 358


def test_a_page_has_one_row_a_comparison_and_escapes_bars():
    table = Table("", {"": "text", "| |s| - 1 |": "error", "Time": "seconds"}, [["a | b", 1e-16, 2e-6]])
    lines = table.markdown().strip().splitlines()
    assert [len(re.findall(r"(?<!\\)\|", line)) for line in lines] == [4, 4, 4]
    rows = [["ours", 2.0, 1e-9, 1e-16], ["peer, slow", 9.0, 1e-9, 2e-7], ["peer, quick", 1.0, 1e-5, 2e-3]]
    columns = {"": "text", "Time": "seconds", "Error": "error", "Energy drift": "error"}
    report = Report("", "", [Table("", columns, rows)])
    pair = first_page.RowPair("some", 0, "work", "a step", "ours", "peer")
    comparison = first_page._compare_rows(report, pair)
    figures = first_page.RowFigures(2.0, 1e-9, 1e-16), first_page.RowFigures(1.0, 1e-5, 2e-3)
    assert comparison == first_page.PeerComparison("work", "a step", "peer, quick", *figures)  # the fastest counts
    accurate = first_page._compare_rows(report, dataclasses.replace(pair, max_error=1e-8))
    assert accurate.peer == "peer, slow"
    (sentence, conservation) = first_page.summary_sentences([dataclasses.replace(comparison, peer="heyoka")])
    assert "faster in 0 of 1 tasks" in sentence
    assert "at most 1.0e-16 with this library, and 2.0e-03 to 2.0e-03 with the others (1 tasks)" in conservation
    assert first_page._compare_rows(report, dataclasses.replace(pair, theirs="nobody")) is None


def test_the_statistics_of_the_magnet():
    """The autocorrelation time and the error of an AR(1) process agree with their exact values."""
    random, rho, n = np.random.default_rng(0), 0.9, 60_000
    x = random.standard_normal(n)
    for i in range(1, n):
        x[i] = rho * x[i - 1] + np.sqrt(1 - rho**2) * x[i]
    time = _series(np.column_stack([x, np.sqrt(x - x.min()), np.zeros((n, 2))])).autocorrelation_time  # of m²
    assert abs(time / ((1 + rho) / (2 * (1 - rho))) - 1.0) < 0.2  # 0.06 is its standard error
    rows = np.column_stack([x, x, np.zeros((n, 2))])
    mean, error = magnet.value_and_jackknife_error(lambda s, row_indices: s.energy[row_indices].mean(), _series(rows))
    assert 0.5 < error / np.sqrt(2 * time / n) < 1.5
    assert abs(mean) < 4 * error


def _series(rows, temperature=1.0):
    return magnet.Series("", 1, temperature, len(rows), 1, rows)


def test_where_the_cumulants_of_two_lattices_are_equal():
    """A double well, whose cumulants are integrals, and vectors in a plane with energy m⁴ and cumulant 1 - pi / 6."""
    x, random, n = np.linspace(-4.0, 4.0, 8_001), np.random.default_rng(0), 40_000
    well = 0.8 * (x**2 - 1.2) ** 2

    def cumulant(T):
        second, fourth = (float((x**k * np.exp(-well / T)).sum() / np.exp(-well / T).sum()) for k in (2, 4))
        return 1.0 - fourth / (3.0 * second**2)

    crossing = brentq(lambda T: cumulant(T) - (1.0 - np.pi / 6.0), 0.5, 3.0)
    T = 1.03 * crossing
    cumulative = np.cumsum(np.exp(-well / T))
    positions = np.interp(random.random(n), cumulative / cumulative[-1], x)
    square = np.abs(np.sqrt(T / 2) * random.standard_normal(n))
    a = _series(np.column_stack([0.8 * (positions**2 - 1.2) ** 2, positions, np.zeros((n, 2))]), T)
    b = _series(np.column_stack([square**2, np.sqrt(square), np.zeros((n, 2))]), T)
    for series, value in zip((a, b), (cumulant(T), 1.0 - np.pi / 6.0), strict=True):
        assert abs(magnet.series_row(series)[-2] - value) < 4 * magnet.series_row(series)[-1] < 0.05
    estimate, error = magnet.crossing_rows([a, b])[0][1:3]
    assert abs(estimate - crossing) < 4 * error < 0.4 * crossing
    joined_rows = magnet.join_runs([a, b])
    assert joined_rows.steps == 2 * n
    assert len(joined_rows.samples) == len(a.drop_transient().samples) + len(b.drop_transient().samples)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("T", [10.0, 20.0])
def test_monte_carlo_of_the_magnet_at_high_temperatures(T):
    """The energy of a bond is Langevin's function of J / kT, up to loops of four bonds."""
    (rows,) = simulate_heisenberg_heat_bath(6, [T], 400)
    energies = rows[:, 0].reshape(20, -1).mean(axis=1)
    exact = -3.0 * (1.0 / np.tanh(1.0 / T) - T)
    assert abs(energies.mean() - exact) < 4 * energies.std() / np.sqrt(19) + 4.0 / (3 * T) ** 3
    assert abs(energies.mean()) > 10 * energies.std() / np.sqrt(19)
    assert np.abs(np.linalg.norm(rows[:, 1:], axis=1)).max() < 0.3


def test_the_driver_refuses_unknown_names(capsys):
    with pytest.raises(SystemExit):
        main(["single_bodies"])
    assert "no measurement single_bodies; there are single_body," in capsys.readouterr().err


def test_c_is_handed_the_library_s_rules():
    header = (native.SOURCE_FOLDER / "rules.h").read_text()
    macros = set(re.findall(r"\b[A-Z_]{4,}\b", "".join(p.read_text() for p in native.SOURCE_FOLDER.glob("*.[ch]"))))
    for flag in native.solver_option_macros():
        name, value = flag.removeprefix("-D").split("=")
        assert name in macros
        assert float(value) == getattr(DEFAULT_OPTIONS, name.lower())
        assert f"define {name}" not in header
    statuses = re.search(r"enum \{ (.*) \};", header)
    assert statuses is not None
    assert statuses[1].split(", ") == ["RUNNING", *(code.name for code in (StatusCode(1), StatusCode(2)))]


@pytest.mark.sampled(1)
@needs_compiler
@pytest.mark.parametrize(
    ("source", "parameters", "system"),
    [("rigid_body.c", body_parameters, quadratic_body), ("general.c", general_parameters, general_body)],
)
def test_c_runs_the_same_scheme(source, parameters, system):
    assert max_difference_from_c(BodyProgram(source, parameters(1.0)), system(1.0)) <= 1e-12
    with pytest.raises(RuntimeError, match="differ by"):  # another rate is another trajectory
        max_difference_from_c(BodyProgram(source, parameters(1.001)), system(1.0))


@needs_compiler
@pytest.mark.parametrize(
    "number", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
def test_c_runs_the_same_variational_scheme(number):
    assert variational.max_difference_from_c(number) <= 1e-12


@needs_compiler
@pytest.mark.parametrize("way", ["without charts", pytest.param("in charts", marks=pytest.mark.slow)])
def test_c_moves_the_same_spin(way):
    assert spin.max_difference_from_c(way) <= 1e-12
    with pytest.raises(RuntimeError, match="differ by"):
        spin.max_difference_from_c(way, 0.0301)


@needs_compiler
def test_lanes_do_as_one_body_does():
    bodies, single_body = EnsembleProgram(body_parameters(1.0)), BodyProgram("rigid_body.c", body_parameters(1.0))
    x0s = random_states(19)  # no multiple of the lanes
    summaries = bodies.integrate(x0s, 0.05, 200, threads=3)
    for x0, summary in zip(x0s, summaries, strict=True):
        (end,), (run,) = single_body.integrate(x0, 0.05, 200)
        assert np.abs(summary["x"] - end).max() <= 1e-14
        assert summary["iterations"] == pytest.approx(run["iterations"], rel=0.02)
        assert summary["least_entropy_increment"] == pytest.approx(run["least_entropy_increment"], rel=1e-6)


@needs_compiler
def test_a_c_program_that_fails_says_so():
    with pytest.raises(RuntimeError, match="stopped early: not_converged"):
        BodyProgram("rigid_body.c", body_parameters(1.0)).integrate([0.1, 1.0, 0.1], 3.0, 5)
    with pytest.raises(RuntimeError, match="stopped early: not_converged"):
        EnsembleProgram(body_parameters(1.0)).integrate([[0.0, 1.0, 0.0], [0.1, 1.0, 0.1]], 3.0, 5, threads=1)
    with pytest.raises(RuntimeError, match="stopped early: non_finite"):
        EnsembleProgram(body_parameters(1.0)).integrate([[0.1, 1.0, 0.1], [np.nan, 0.0, 1.0]], 0.1, 5, threads=1)


def test_the_reference_is_the_trajectory(monkeypatch):
    """The Taylor reference agrees with SciPy, and does not depend on its own step."""
    x0 = [0.3, -0.8, 0.5]
    exact = reference.exact_state(x0, 0.7, 5.0)
    assert np.abs(scipy_run(1e-13, x0, 5.0, 0.7).solve_end() - exact).max() < 1e-11
    assert np.abs(reference.exact_state(x0, 0.71, 5.0) - exact).max() > 1e-3
    monkeypatch.setattr(reference, "TAYLOR_STEP", reference.TAYLOR_STEP / 2)
    assert np.array_equal(reference.exact_state(x0, 0.7, 5.0), exact)


@pytest.mark.slow
@pytest.mark.skipif(
    not memory.PROCESS_STATUS_FILE.is_file(), reason="this system does not tell a process its largest size"
)
def test_a_process_is_not_charged_its_parent_s_memory():
    """The peak memory of a child process excludes that of its parent, unlike the value of ``getrusage``."""
    large_array = np.ones(100_000_000)
    child_bytes = child.run_python(
        "-c", "from benchmarks.measurements.memory import peak_resident_bytes; print(peak_resident_bytes())"
    )
    assert 1e7 < float(child_bytes) < large_array.nbytes < memory.peak_resident_bytes()


@needs_compiler
def test_c_steers_the_energy():
    """A general energy keeps its value over a long run; without drift corrections it is off by 5e-13."""
    _, run = BodyProgram("general.c", general_parameters(1e-3)).integrate(X0, 0.1, 300_000)
    assert laws.c_run_laws(run).energy_drift < 2e-14
    _, run = BodyProgram("general.c", general_parameters(1e-3), "-DDRIFT_THRESHOLD=INFINITY").integrate(
        X0, 0.1, 300_000
    )
    assert laws.c_run_laws(run).energy_drift > 2e-14


@pytest.mark.parametrize(
    ("limit", "measurement", "is_lower_bound", "verdict"),
    [
        (2.5, 2.4, False, "met"),
        (2.5, 2.6, False, "missed"),
        (30.0, 31.0, True, "met"),
        (30.0, 29.0, True, "missed"),
        (30.0, None, True, "not measured"),
        (2.5, float("nan"), False, "missed"),
    ],
)
def test_verdicts(limit, measurement, is_lower_bound, verdict):
    assert Target("work", limit, measurement, at_least=is_lower_bound).verdict == verdict


def test_broken_laws_are_named():
    assert Laws(1e-15, 0.0).table_cells()[-1] == "hold"
    assert Laws(1e-15, None).table_cells()[-1] == "hold"
    assert Laws(1e-12, -1e-12).table_cells()[-1] == "broken: energy, entropy"
    assert Laws(float("nan"), 0.0).table_cells()[-1] == "broken: energy"


def test_a_race_takes_turns():
    calls = []
    outcomes = race({"a": lambda: calls.append("a"), "b": lambda: calls.append("b") or 7}, rounds=3)
    turns = re.sub(r"(.)\1+", r"\1", "".join(calls))
    assert turns == "ab" * 4  # one before the first round
    assert outcomes["b"].result == 7
    assert 0.0 < outcomes["a"].wall_seconds < 0.02


@pytest.mark.parametrize("body", [tumbling.FREE_BODY, tumbling.DAMPED_BODY], ids=["free", "damped"])
def test_the_tumbling_body_is_one_in_the_library_and_in_scipy(body):
    ours = simulators.library_run(body, MetriplecticGauss(3), 0.05, 5.0, 10)()
    exact = simulators.scipy_run(body, 1e-12, 5.0, 10)()
    perturbed_body = simulators.scipy_run(dataclasses.replace(body, inertia=1.001 * body.inertia), 1e-12, 5.0, 10)()
    assert np.abs(ours.momentum - exact.momentum).max() <= 1e-9  # measured: 6e-11
    assert np.abs(ours.spatial_momentum - exact.spatial_momentum).max() <= 1e-9
    assert ours.total_energy is not None
    assert np.ptp(ours.total_energy) <= 1e-14
    assert np.abs(ours.momentum - perturbed_body.momentum).max() > 1e-4


@pytest.mark.parametrize("body", [tumbling.FREE_BODY, tumbling.DAMPED_BODY], ids=["free", "damped"])
def test_the_tumbling_body_is_one_in_mujoco(body):
    pytest.importorskip("mujoco")
    theirs = simulators.mujoco_run(body, "RK4", 0.01, 5.0, 10)()
    exact = simulators.scipy_run(body, 1e-12, 5.0, 10)()
    assert np.abs(theirs.spatial_momentum - exact.spatial_momentum).max() <= 1e-9
    assert np.abs(theirs.momentum - exact.momentum).max() <= 1e-9


def test_simulators_that_are_missing_are_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setitem(sys.modules, "Basilisk.simulation.spacecraft", None)
    with pytest.raises(UnavailableError, match="mujoco is not installed"):
        simulators.mujoco_run(tumbling.FREE_BODY, "RK4", 0.01, 1.0, 1)
    with pytest.raises(UnavailableError, match="Basilisk is not installed"):
        simulators.basilisk_run(tumbling.FREE_BODY, 0.01, 1.0, 1)


def test_gradient_flows_beside_steepest_descent_of_pymanopt():
    """The difference of the two steps is of first order: it halves with the step size and vanishes by extrapolation."""
    pytest.importorskip("pymanopt")
    for _, _, full_step_difference, half_step_difference, extrapolation in manifolds.pymanopt_rows():
        assert 1.9 < half_step_difference / full_step_difference < 2.1
        assert extrapolation < 0.02 * full_step_difference
