"""Studies on the command line, and further keys of spec files: adaptive steps, events, attitudes, changes."""

import sys

import numpy as np
import pytest
from typer.testing import CliRunner

import liethermo as lt
from liethermo.cli import app
from liethermo.spec import read
from liethermo.spec.schema import list_spec_keys

MODEL = '[model]\nname = "rigid_body"\nparameters = {inertia = [2.0, 1.5, 1.0]}\n'
RUN = "[run]\ninitial = [0.1, 1.0, 0.1]\nt_span = [0.0, 4.0]\nstep = 0.1\n"
STUDY = """
[study]
axes.rate = {first = 0.1, last = 2.0, points = 4, scale = "log"}
axes."inertia[0]" = [1.8, 2.2, 2.4]
measure = {tau = "relaxation_time", final = "final"}
chunk = 4
units = {rate = "1/s"}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def call(*arguments):
    return CliRunner().invoke(app, list(map(str, arguments)))


def spec(folder, *parts):
    (folder / "spec.toml").write_text("\n".join(parts))
    return "spec.toml"


def test_a_study_from_a_spec_file_its_status_and_its_picture(folder):
    result = call("study", spec(folder, MODEL, RUN, STUDY), "--out", "body.zarr")
    assert result.exit_code == 0, result.output
    assert "12 of 12 points are done" in result.stdout
    assert "the laws hold" in result.stdout
    assert (folder / "body.png").read_bytes().startswith(b"\x89PNG")
    dataset = lt.load_study("body.zarr")
    assert dict(dataset.sizes)["inertia[0]"] == 3
    assert dataset.rate.units == "1/s"
    np.testing.assert_allclose(dataset.rate, np.geomspace(0.1, 2.0, 4), rtol=1e-15)
    final_state = lt.integrate(lt.models.rigid_body((2.4, 1.5, 1.0), 2.0), [0.1, 1.0, 0.1], (0.0, 4.0), 0.1).x[-1]
    np.testing.assert_allclose(dataset.final[3, 2], final_state, rtol=0, atol=1e-14)
    assert dataset.attrs["spec"]["study"]["chunk"] == 4

    second_call = call("study", "spec.toml", "--out", "body.zarr")
    assert second_call.exit_code == 0
    status_call = call("status", "body.zarr")
    assert (status_call.exit_code, "12 of 12 points are done (100 %)" in status_call.stdout) == (0, True)
    plot_call = call("plot", "body.zarr", "--measure", "tau", "--out", "tau.svg")
    assert plot_call.exit_code == 0, plot_call.output
    assert (folder / "tau.svg").is_file()
    assert call("plot", "body.zarr", "--measure", "sigma").exit_code == 2
    other_step_call = call("study", "spec.toml", "--out", "body.zarr", "--set", "run.step=0.2")
    assert other_step_call.exit_code == 2
    assert "step is 0.2, and 0.1 in the store" in other_step_call.stderr
    assert call("status", "none.zarr").exit_code == 2
    assert "there is no Dask scheduler" in call("study", "spec.toml", "--cluster", "nonsense://here").stderr


@pytest.mark.slow
def test_points_that_fail_make_the_exit_status_one(folder):
    result = call("study", spec(folder, MODEL, RUN, STUDY), "--set", "study.axes.rate=[0.5, -1.0]")
    assert result.exit_code == 1, result.output
    assert "3 inadmissible" in result.stdout
    assert (folder / "spec.zarr").is_dir()  # named after the spec


def refusals(folder, *parts, changes=()):
    result = call("check", spec(folder, *parts), *(word for change in changes for word in ("--set", change)))
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    return [line.strip() for line in result.stderr.splitlines()[1:]]


@pytest.mark.parametrize(
    ("study", "problem"),
    [
        ("", "study.axes is missing: by parameters of the model"),
        (
            "axes.rat = [1.0]",
            "study.axes: rigid_body has no parameter rat (did you mean rate?); it has inertia, rate, attitude, torque, "
            "initial",
        ),
        ('axes."inertia[3]" = [1.0]', "study.axes: inertia[3] is not an entry of inertia = [2.0, 1.5, 1.0]"),
        ("axes.inertia = [1.0]", "study.axes: inertia = [2.0, 1.5, 1.0] is a list; an axis is one entry of it"),
        ("axes.rate = []", "study.axes.rate = []: "),
        (
            "axes.rate = {first = 0.0, last = 1.0, points = 3, scale = 'log'}",
            "study.axes.rate: the values of a log",
        ),
        ("axes.rate = {first = 0.0, last = 1.0, point = 3}", "study.axes.rate.first: no such key"),
        ("axes.rate = {points = 3}", "study.axes.rate.first is missing"),
        ('axes.s = {zip = {rate = [1.0], "inertia[0]" = [1.0, 2.0]}}', "study.axes.s: parameters that vary together"),
        ("axes.s = {sobol = 4}", "study.axes.s: a sample needs at least one range"),
        ("axes.s = {seed = 4}", "study.axes.s: must have one of zip"),
        (
            "axes.rate = [1.0]\nmeasure = {m = {relaxed = -1.0}}",
            "study.measure.m.relaxed = -1.0: must be greater",
        ),
        ("axes.rate = [1.0]\nmeasure = {m = {}}", "study.measure.m: must have one of relaxed and at"),
        ("axes.rate = [1.0]\nmeasure = {m = 'median'}", "study: the measure 'm' must be"),
        ("axes.rate = [1.0]\nchunks = 3", "study.chunks: no such key (did you mean chunk?)"),
    ],
)
def test_invalid_study_sections_are_refused(folder, study, problem):
    problems = refusals(folder, MODEL, RUN, f"[study]\n{study}")
    assert any(line.startswith(problem) for line in problems), problems


@pytest.mark.slow
def test_adaptive_steps_an_event_and_changes(folder):
    path = spec(folder, MODEL, RUN.replace("0.1\n", "{adaptive = 1e-9, largest = 0.5}\n").replace("4.0]", "400.0]"))
    plan = read(path, ["run.until.relaxed=1e-4", "model.parameters.rate=0.5", "outputs.figures=[]"])
    assert plan.step == lt.Adaptive(1e-9, largest=0.5)
    assert plan.until == lt.Relaxed(1e-4)
    assert plan.parameters["rate"] == 0.5
    result = call("run", path, "--set", "run.until.relaxed=1e-4", "--set", "outputs.figures=[]")
    assert result.exit_code == 0, result.output
    solution = lt.load("spec/solution.nc")
    direct = lt.integrate(
        lt.models.rigid_body((2.0, 1.5, 1.0)), [0.1, 1.0, 0.1], (0.0, 400.0), plan.step, until=lt.Relaxed(1e-4)
    )
    assert solution.event_time == direct.event_time < 400.0
    assert "Adaptive(rtol=1e-09" in result.stdout


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("run.step={adaptive=0.0}", "run.step.adaptive = 0.0: must be greater than 0"),
        ("run.step={adaptiv=1e-3}", "run.step.adaptiv: no such key (did you mean adaptive?)"),
        ("run.step=-1.0", "run.step = -1.0: must be greater than 0"),
        ("run.until={relaxed='soon'}", 'run.until.relaxed = "soon": must be a valid number'),
        ("run.until=3.0", "run.until = 3.0: must be a section [run.until]"),
        ("run.attitude=[1.0]", "run.attitude[0] = 1.0: must be a valid array"),
        ("nonsense", "--set nonsense: must be section.key=value"),
        ("run.step.fine=1", "--set run.step.fine=1: step is not a section"),
        ("method.name=Midpoint", 'method.name = "Midpoint": must be one of'),
    ],
)
def test_changes_that_cannot_be_made(folder, change, problem):
    problems = refusals(folder, MODEL, RUN, changes=[change])
    assert any(line.startswith(problem) for line in problems), problems


def test_every_key_is_explained():
    rows = list_spec_keys()
    assert {section for section, *_ in rows} >= {
        "model",
        "run",
        "method",
        "outputs",
        "study",
        "run.step",
        "run.until",
    }
    assert [(section, name) for section, name, _, what in rows if not what] == []
