"""The command line: what it prints, what it writes, and its exit status."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import liethermo as lt
from liethermo.cli import app
from liethermo.engines.compiled.engine import CompiledTrajectory
from liethermo.integrators import METHODS
from liethermo.spec import FIGURES

EXAMPLE = Path(__file__).parents[1] / "examples" / "relaxed_rigid_body.toml"

MODEL = '[model]\nname = "rigid_body"\n'
RUN = "[run]\ninitial = [0.001, 1.0, 0.001]\nt_span = [0.0, 2.0]\nstep = 0.1\n"
REFERENCE = '[method]\nname = "Reference"\nrtol = 1e-6\n'
OUTPUT_WITHOUT_FIGURES = "[outputs]\nfigures = []\n"

# What a user might write; the tests run it under this name.
MODULE = "a_users_module"
SOURCE = """
import jax.numpy as jnp
import liethermo as lt
import manifolds as mf

def build(rate: float, inertia=(3.0, 2.0, 1.0), *, label: str = ""):
    return lt.models.rigid_body(inertia, rate)

def half_a_domain():
    "The energy ends at a wall that the body of the paper runs into."
    energy = lambda mu: jnp.where(mu[0] < 1.2, (mu**2 / jnp.array([10.0, 5.0, 1.0])).sum() / 2, jnp.nan)
    entropy = lt.Quadratic(jnp.ones(3))
    return lt.LiePoissonSystem(mf.so(3), energy, entropy, lt.KillingDissipation(0.5))

def no_casimir(validate: "NameForTypeCheckersOnly" = True):
    return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(jnp.ones(3)), lambda mu: mu[0], validate=validate)

def six_components():
    return lt.LiePoissonSystem(mf.se(3), lt.Quadratic(jnp.ones(6)))

def no_algebra():
    return mf.so(1.5)

def raises():
    return [][3]

def no_system():
    return 3

not_a_function = 3
"""


class Folder:
    """A user's current folder, with a spec and the command line."""

    def __init__(self, path):
        self.path = path

    def spec(self, *parts, name="spec.toml"):
        (self.path / name).write_text("\n".join(parts))
        return name

    def call(self, *arguments):
        return CliRunner().invoke(app, list(map(str, arguments)))

    def refusal(self, *parts):
        """Return the problems that ``check`` reports for an invalid spec, one line each."""
        result = self.call("check", self.spec(*parts))
        assert result.exit_code == 2
        assert re.fullmatch(r"(spec\.toml: imports .*\n)?", result.stdout)
        head, *problems = result.stderr.splitlines()
        assert head == "liethermo: spec.toml cannot be run:"
        return [line.strip() for line in problems]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    sys.modules.pop(MODULE, None)
    (tmp_path / f"{MODULE}.py").write_text(SOURCE)
    yield Folder(tmp_path)
    sys.modules.pop(MODULE, None)


def function(name, parameters="{}"):
    return f'[model]\nfunction = "{MODULE}:{name}"\nparameters = {parameters}\n'


# -- runs -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The example of the README, run once."""
    results = tmp_path_factory.mktemp("example") / "results"
    return CliRunner().invoke(app, ["run", str(EXAMPLE), "--out", str(results)]), results


def test_example_prints_its_audit(example):
    result, _ = example
    assert result.exit_code == 0, result.output
    assert "completed: reached t = 200 in 2000 steps" in result.stdout
    assert "the laws hold" in result.stdout
    assert "FAILS" not in result.stdout


def test_example_writes_its_files(example):
    _, results = example
    assert sorted(os.listdir(results)) == ["laws.png", "momentum_sphere.png", EXAMPLE.name, "solution.nc"]
    assert (results / EXAMPLE.name).read_text() == EXAMPLE.read_text()
    for figure in ("momentum_sphere.png", "laws.png"):
        assert (results / figure).read_bytes().startswith(b"\x89PNG")


def test_example_shows_figure_1_of_the_paper(example):
    solution = lt.load(example[1] / "solution.nc")
    audit = solution.audit()
    assert audit.passed
    assert audit.energy_drift < 1e-14
    assert solution.entropy[-1] == pytest.approx(10.0 * solution.energy[-1], rel=1e-14)
    assert np.abs(solution.x[-1, 1:]).max() < 1e-6
    assert solution.provenance["spec"] == tomllib.loads(EXAMPLE.read_text())


def test_saved_run_is_audited(example):
    result = CliRunner().invoke(app, ["audit", str(example[1] / "solution.nc")])
    assert result.exit_code == 0
    assert "MetriplecticMidpoint(gradient=Gonzalez)" in result.stdout
    assert "the laws hold" in result.stdout


def test_result_cut_short_is_refused(example, tmp_path):
    truncated_file = tmp_path / "cut.nc"
    content = (example[1] / "solution.nc").read_bytes()
    truncated_file.write_bytes(content[: len(content) // 2])
    for file, message in (
        (truncated_file, "cut short"),
        (EXAMPLE, "cannot be read as NetCDF"),
        (tmp_path / "no.nc", "no file"),
    ):
        result = CliRunner().invoke(app, ["audit", str(file)])
        assert (result.exit_code, result.stdout) == (2, "")
        assert message in result.stderr


def test_a_law_that_fails(folder):
    result = folder.call("run", folder.spec(MODEL, RUN.replace("2.0]", "40.0]"), REFERENCE, OUTPUT_WITHOUT_FIGURES))
    assert result.exit_code == 1
    assert "energy drift" in result.stdout
    assert "A LAW FAILS" in result.stdout
    file = folder.path / "spec" / "solution.nc"  # the default folder has the spec's name
    assert lt.load(file).provenance["spec"]["method"] == {"name": "Reference", "rtol": 1e-6}
    assert folder.call("audit", file).exit_code == 1


@pytest.mark.slow
def test_a_run_that_stops_early_is_kept(folder):
    spec = folder.spec(function("half_a_domain"), RUN.replace("2.0]", "50.0]"))
    result = folder.call("run", spec, "--out", "results")
    assert result.exit_code == 1
    assert "The run stopped early" in result.stdout
    solution = lt.load("results/solution.nc")
    assert not solution.status.ok
    assert 0 < solution.status.step == len(solution.t) - 1
    assert solution.status.message in " ".join(result.stdout.split())
    assert np.isfinite(solution.x).all()
    assert Path("results/laws.png").is_file()


def test_ctrl_c_keeps_what_exists(folder, monkeypatch):
    advance, calls = CompiledTrajectory.advance, []

    def advance_once(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return advance(*arguments)

    monkeypatch.setattr(CompiledTrajectory, "advance", advance_once)
    result = folder.call("run", folder.spec(MODEL, RUN.replace("2.0]", "500.0]"), OUTPUT_WITHOUT_FIGURES))
    assert result.exit_code == 1
    assert "stopped by the user" in result.stdout
    solution = lt.load("spec/solution.nc")
    assert solution.status.code == "interrupted"
    assert len(solution.t) == solution.status.step + 1 > 1000
    assert solution.provenance["spec"]["run"]["step"] == 0.1


def test_outputs_are_as_asked(folder):
    outputs = '[outputs]\nnetcdf = "body.nc"\nfigures = ["laws"]\nfigure_format = "svg"\n'
    spec = folder.spec(MODEL, RUN + "save_every = 4\n", outputs)
    assert folder.call("run", spec, "--out", ".").exit_code == 0  # beside the spec, which stays as it is
    assert folder.call("run", spec, "--out", ".").exit_code == 0  # and again, over the first results
    assert {file.name for file in folder.path.glob("*.*")} == {spec, f"{MODULE}.py", "body.nc", "laws.svg"}
    assert len(lt.load("body.nc").t) == 6


def test_a_process_with_a_users_function(tmp_path):
    """A separate process, started in another folder than the spec's."""
    home = tmp_path / "home"
    home.mkdir()
    (home / f"{MODULE}.py").write_text(SOURCE)
    (home / "mine.toml").write_text(function("build", "{rate = 2, inertia = [2, 3, 4]}") + RUN + OUTPUT_WITHOUT_FIGURES)

    def call(*arguments):
        path = os.pathsep.join([str(EXAMPLE.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "-m", "liethermo.cli", *arguments]
        return subprocess.run(
            command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
        )

    good = call("run", "home/mine.toml")
    assert (good.returncode, good.stderr) == (0, "")
    assert f"{MODULE}:build" in good.stdout
    assert lt.load(tmp_path / "mine" / "solution.nc").audit().passed

    bad = call("run", "home/mime.toml")
    assert (bad.returncode, bad.stdout) == (2, "")
    assert bad.stderr == "liethermo: cannot read the spec file home/mime.toml: No such file or directory\n"


# -- check, models and help -----------------------------------------------------------------------------------------


def test_check_prints_the_axioms():
    result = CliRunner().invoke(app, ["check", str(EXAMPLE)])
    assert result.exit_code == 0, result.output
    assert "the spec is valid" in result.stdout
    assert "all axioms hold" in result.stdout


def test_check_fails_with_an_axiom(folder):
    default_check = folder.call("check", folder.spec(function("no_casimir"), RUN))
    assert default_check.exit_code == 1
    assert "not a Casimir" in default_check.stderr
    unvalidated_check = folder.call("check", folder.spec(function("no_casimir", "{validate = false}"), RUN))
    assert unvalidated_check.exit_code == 1
    assert "FAILS" in unvalidated_check.stdout
    assert "NOT metriplectic" in unvalidated_check.stdout


def test_models_lists_all_with_their_parameters():
    result = CliRunner().invoke(app, ["models"])
    assert result.exit_code == 0
    for name in lt.models.__all__:
        assert name in result.stdout
    assert "rate=1.0" in result.stdout


def test_methods_are_listed_with_what_they_keep():
    result = CliRunner().invoke(app, ["methods"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    for method in lt.registered_methods(special=True):
        line = next(line for line in lines if line.startswith(str(method)))
        assert f" {method.order} " in line
        assert all(name.replace("_", " ") in line for name in method.preserves)
    assert any("simple closed systems" in line for line in lines)


def test_a_variational_scheme_by_its_name(tmp_path):
    """The scheme conserves the entropy law but not the energy, and the exit status is 1."""
    spec = tmp_path / "spring.toml"
    spec.write_text(
        """
        [model]
        name = "mass_spring_gas"
        [run]
        initial = [0.3, 0.5, 0.0]
        t_span = [0.0, 1.0]
        step = 0.1
        [method]
        name = "VariationalIntegrator"
        phi = "{}"
        [outputs]
        figures = []
        """.replace("{}", "symmetrised")
    )
    result = CliRunner().invoke(app, ["run", str(spec), "--out", str(tmp_path / "out")])
    assert result.exit_code == 1, result.output
    assert str(lt.VariationalIntegrator.symmetrised()) in result.stdout
    verdicts = {law: next(line for line in result.stdout.splitlines() if law in line) for law in ("energy", "entropy")}
    assert "FAILS" in verdicts["energy"]
    assert "ok" in verdicts["entropy"]
    spec.write_text(spec.read_text().replace("symmetrised", "symmetrized"))
    result = CliRunner().invoke(app, ["run", str(spec), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "did you mean" in result.output.lower()


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["check", "-h"], ["audit", "-h"]])
def test_help(arguments):
    assert CliRunner().invoke(app, arguments).exit_code == 0


# -- specs that cannot be run -----------------------------------------------------------------------------------------

REFUSALS = {
    "nothing": ([""], ["run.initial is missing: the state", "run.t_span is", "run.step is", "model: give either name"]),
    "section": (
        [MODEL, RUN, "[ouputs]"],
        ["ouputs: no such key (did you mean outputs?); a spec file takes model, run"],
    ),
    "no section": (["run = 3", MODEL], ["run = 3: must be a section [run]"]),
    "key": ([MODEL, RUN, "stop = 3"], ["run.stop: no such key (did you mean step?); [run] takes initial, t_span"]),
    "initial": ([MODEL, RUN.replace("1.0,", '"a",')], ['run.initial[1] = "a": must be a valid number']),
    "nan": ([MODEL, RUN.replace("1.0,", "nan,")], ["run.initial[1] = NaN: must be a finite number"]),
    "shape": (
        [MODEL, RUN.replace("1.0, ", "")],
        ["run.initial = [0.001, 0.001]: a state of this system must have shape (3,)"],
    ),
    "step": ([MODEL, RUN.replace("0.1", "-0.1")], ["run.step = -0.1: must be greater than 0"]),
    "text": ([MODEL, RUN.replace("0.1", '"0.1"')], ['run.step = "0.1": must be a valid number']),
    "save_every": ([MODEL, RUN, "save_every = 1.5"], ["run.save_every = 1.5: must be a valid integer"]),
    "t_span": ([MODEL, RUN.replace("2.0]", "0.0]")], ["run.t_span = [0.0, 0.0]: must increase"]),
    "three times": ([MODEL, RUN.replace("2.0]", "2, 3]")], ["run.t_span = [0.0, 2, 3]: must have at most 2 items"]),
    "model": (
        ['[model]\nname = "rigid_bodie"', RUN],
        ["(did you mean rigid_body?)"],
    ),
    "model and function": ([MODEL, 'function = "a:b"', RUN], ["model: give either name"]),
    "parameters": (
        [MODEL, 'parameters = {inertai = [1, 2, 3], rate = "fast"}', RUN],
        [
            'model.parameters.rate = "fast": must be a valid number',
            "model.parameters.inertai: no such key (did you mean inertia?); rigid_body takes inertia, rate",
        ],
    ),
    "value of a parameter": (
        [MODEL, "parameters = {inertia = [1, 2]}", RUN],
        [
            'model.name = "rigid_body", model.parameters.inertia = [1, 2]: '
            "inertia must have shape (3,) or (3, 3), got (2,)"
        ],
    ),
    "method": (
        [MODEL, RUN, '[method]\nname = "Referense"'],
        [
            f'method.name = "Referense": must be one of {", ".join(f"{chr(34)}{name}{chr(34)}" for name in METHODS)} '
            "(did you mean Reference?)"
        ],
    ),
    "option of a method": (
        [MODEL, RUN, '[method]\ngradiant = "gonzalez"'],
        ["method.gradiant: no such key (did you mean gradient?); MetriplecticMidpoint takes gradient"],
    ),
    "gradient": (
        [MODEL, RUN, '[method]\ngradient = "gonzales"'],
        ["method.gradient = \"gonzales\": no discrete gradient 'gonzales'; the names are 'gonzalez', 'mean_value'"],
    ),
    "rtol": (
        [MODEL, RUN, REFERENCE.replace("1e-6", "2")],
        ["method.rtol = 2.0: rtol must be between 0 and 1, got 2.0"],
    ),
    "netcdf": ([MODEL, RUN, '[outputs]\nnetcdf = "a/b.nc"'], ['outputs.netcdf = "a/b.nc": must be a file name']),
    "figures": (
        [MODEL, RUN, '[outputs]\nfigures = ["law"]'],
        ['outputs.figures[0] = "law": must be one of "momentum_sphere", "laws" (did you mean laws?)'],
    ),
    "format": ([MODEL, RUN, '[outputs]\nfigure_format = "gif"'], ['outputs.figure_format = "gif": must be one of']),
    "figure of another space": (
        [
            function("six_components"),
            RUN.replace("[0.001", "[0, 0, 0, 0.001"),
            OUTPUT_WITHOUT_FIGURES.replace("[]", f"{list(FIGURES)}"),
        ],
        ['outputs.figures = ["momentum_sphere", "laws"]: momentum_sphere needs states of 3 components'],
    ),
    "not TOML": (["[model"], ["it is not valid TOML: Expected ']'"]),
    "no module": (
        ['[model]\nfunction = "a.b:f"', RUN],
        ['model.function = "a.b:f": there is no a/b.py beside the spec'],
    ),
    "path": (['[model]\nfunction = "mine.py"', RUN], ['model.function = "mine.py": must be "module:function"']),
    "no function": ([function("biuld"), RUN], ["defines no function 'biuld': it is not there (did you mean build?)"]),
    "not a function": ([function("not_a_function"), RUN], ["defines no function 'not_a_function'"]),
    "needed parameter": ([function("build"), RUN], ["model.parameters.rate is missing; build needs it"]),
    "date": (
        [function("build", "{rate = 2024-01-01}"), RUN],
        ['model.parameters.rate = "2024-01-01": must be a valid'],
    ),
    "raises": ([function("raises"), RUN], [f"IndexError: list index out of range ({MODULE}.py, line"]),
    "library error": ([function("no_algebra"), RUN], [f'model.function = "{MODULE}:no_algebra"']),
    "no system": ([function("no_system"), RUN], ["it returned 3, not a system"]),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_bad_spec_is_told_why(folder, case):
    parts, texts = REFUSALS[case]
    for line, text in zip(folder.refusal(*parts), texts, strict=True):
        assert text in line


def test_all_problems_are_told_at_once(folder):
    bad_method = REFERENCE.replace("rtol", "rtoll")
    lines = folder.refusal(MODEL, "parameters = {rat = 1}", RUN.replace("step", "stepp"), bad_method)
    keys = ("run.step is missing", "run.stepp: no", "model.parameters.rat: no", "method.rtoll: no")
    assert [line[: len(key)] for line, key in zip(lines, keys, strict=True)] == list(keys)


def test_a_module_that_cannot_be_imported(folder):
    (folder.path / f"{MODULE}.py").write_text("undefined_name")
    assert "importing 'a_users_module' failed with NameError" in folder.refusal(function("build"), RUN)[0]


def test_a_place_that_cannot_be_written(folder):
    (folder.path / "taken").write_text("a file")
    result = folder.call("run", folder.spec(MODEL, RUN), "--out", "taken")
    assert result.exit_code == 2
    assert "cannot write the results into taken" in result.stderr


def test_spec_errors_derive_from_the_library_and_the_builtin():
    error = lt.errors.SpecError("a.toml", ["one", "two"])
    assert isinstance(error, lt.LiethermoError)
    assert isinstance(error, ValueError)
    assert error.problems == ("one", "two")


def test_every_registered_integrator_can_be_named():
    assert {type(method).__name__ for method in lt.registered_methods(special=True)} | {"Reference"} == set(METHODS)
