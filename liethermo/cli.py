"""The command line. Commands import pydantic, Matplotlib, rich and Dask themselves, so that ``--help`` is quick."""

from __future__ import annotations

import contextlib
import inspect
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from manifolds import ManifoldsError

from . import __version__, disk
from . import models as catalogue
from .errors import AxiomError, FileError, InputError, LiethermoError
from .integrators import registered_methods
from .results.audit import Audit
from .results.ensemble import Ensemble
from .results.files import load
from .results.solution import Solution
from .runs.integrate import integrate
from .studies.store_results import load_status, load_study
from .systems import System
from .systems.check import CheckReport

if TYPE_CHECKING:
    from .spec import Spec

EXIT_LAWS_FAILED = 1
"""Exit status if a law or an axiom fails, or the run stopped early."""

EXIT_BAD_INPUT = 2
"""Exit status for a spec or a file that is invalid."""

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Integrate systems that obey the two laws of thermodynamics, and see that they do.",
    epilog="Exit status: 0 where all laws hold, 1 where one fails or the run stopped early, 2 for a bad spec or file.",
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"liethermo {__version__}")
        raise typer.Exit


@app.callback()
def _top_level_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Say the version and exit.")
    ] = False,
) -> None: ...


SetOptions = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="In place of what the spec says, for example run.step=0.01."),
]
AllowedModules = Annotated[
    list[str] | None,
    typer.Option("--allow", metavar="MODULE", help="A module that the spec may name though it is not beside it."),
]
StoreFolder = Annotated[Path, typer.Argument(metavar="STORE.zarr", help="A result of `liethermo study`.")]
SpecFile = Annotated[Path, typer.Argument(metavar="SPEC.toml", help="The run, described in TOML.")]


@contextlib.contextmanager
def _report_errors() -> Iterator[None]:
    """Print errors of the library as a message and exit with a status, without a traceback."""
    try:
        yield
    except (LiethermoError, ManifoldsError) as error:
        typer.echo(f"liethermo: {error}", err=True)
        raise typer.Exit(EXIT_LAWS_FAILED if isinstance(error, AxiomError) else EXIT_BAD_INPUT) from error


@app.command()
@_report_errors()
def run(
    spec: SpecFile,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the results; by default named after the spec, here.")
    ] = None,
    change: SetOptions = None,
    allow: AllowedModules = None,
) -> None:
    """Run a spec file: integrate, audit the laws, and write result, figures and a copy of the spec into a folder."""
    from .spec import read

    plan = read(spec, change or (), allow or ())
    system = plan.build_system()
    folder = _prepare_result_folder(spec, Path(spec.stem) if out is None else out)
    start, end = plan.run.t_span
    typer.echo(plan.summary)
    file = folder / plan.outputs.netcdf
    solution = integrate(
        system,
        plan.run.initial,
        (start, end),
        plan.step,
        plan.method,
        save_every=plan.run.save_every,
        until=plan.until,
        attitude=plan.run.attitude,
        on_failure="return",
        save_to=file,
    ).with_provenance(spec=plan.table)
    solution.save(file)
    laws_hold = _print_audit(solution)
    if not solution.status.ok:
        typer.echo(f"The run stopped early. The trajectory up to t = {solution.t[-1]:g} is kept.")
    figures = _draw_figures(plan, system, solution, folder)
    typer.echo(f"In {folder}{os.sep}: {', '.join([file.name, *figures, spec.name])}")
    raise typer.Exit(0 if laws_hold and solution.status.ok else EXIT_LAWS_FAILED)


@app.command()
@_report_errors()
def study(
    spec: SpecFile,
    out: Annotated[
        Path | None, typer.Option(metavar="STORE.zarr", help="Folder of the results; by default named after the spec.")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, such as tcp://10.0.0.1:8786.")
    ] = None,
    change: SetOptions = None,
    allow: AllowedModules = None,
) -> None:
    """Run the unfinished points of a study, audit the laws, and draw a measure."""
    from .spec import read
    from .spec.reading import build_study

    plan = read(spec, change or (), allow or ())
    store = Path(f"{spec.stem}.zarr") if out is None else out
    parameter_study = build_study(plan, store)
    typer.echo(plan.summary)
    with _dask_client(cluster, spec.resolve().parent) as client:
        study_status = parameter_study.run(client)
    typer.echo(str(study_status))
    laws_hold = _print_table(parameter_study.audit())
    if plan.study is not None and study_status.done:
        _draw_study(store, plan.study.figure, store.with_suffix(f".{plan.outputs.figure_format}"))
    raise typer.Exit(0 if laws_hold and study_status.ok else EXIT_LAWS_FAILED)


@app.command()
@_report_errors()
def status(store: StoreFolder) -> None:
    """Print the progress of the study in a store, also while it runs."""
    typer.echo(str(load_status(store)))


@app.command()
@_report_errors()
def plot(
    store: StoreFolder,
    measure: Annotated[str | None, typer.Option(metavar="NAME", help="By default the first that can be drawn.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="A .png, .pdf or .svg file.")] = None,
) -> None:
    """Draw a measure of the study in a store."""
    _draw_study(store, measure, store.with_suffix(".png") if out is None else out)


@app.command()
@_report_errors()
def check(spec: SpecFile, change: SetOptions = None, allow: AllowedModules = None) -> None:
    """Validate a spec file and test the axioms of its system at random points, without running it."""
    from .spec import read

    plan = read(spec, change or (), allow or (), lambda source_text: typer.echo(f"{spec}: {source_text}"))
    if plan.study is not None:
        from .spec.reading import build_study

        build_study(plan, "unused.zarr")
    report = plan.build_system().check()
    typer.echo(f"{spec}: the spec is valid")
    _print_table(report)
    raise typer.Exit(0 if report.passed else EXIT_LAWS_FAILED)


@app.command()
def models() -> None:
    """List the models that a spec file can name, with their parameters."""
    from rich.console import Console
    from rich.table import Table

    table = Table("model", "parameters", "what it is", box=None, pad_edge=False)
    for name in catalogue.__all__:
        model = getattr(catalogue, name)
        parameters = [str(p.replace(annotation=p.empty)) for p in inspect.signature(model).parameters.values()]
        table.add_row(name, "\n".join(parameters), (inspect.getdoc(model) or "").partition("\n")[0].replace("``", ""))
    Console(markup=False).print(table)


@app.command()
def methods() -> None:
    """List the methods that a spec file can name, with their orders, exact conservation laws and purposes."""
    from rich.console import Console
    from rich.table import Table

    table = Table("method", "order", "keeps exactly", "for", box=None, pad_edge=False)
    for method in registered_methods(special=True):
        guarantees = ", ".join(sorted(name.replace("_", " ") for name in method.preserves))
        table.add_row(str(method), str(method.order), guarantees or "-", method.systems)
    Console(markup=False).print(table)


@app.command()
@_report_errors()
def audit(file: Annotated[Path, typer.Argument(metavar="FILE.nc", help="A result of `liethermo run`.")]) -> None:
    """Audit the laws of a saved run."""
    solution = load(file)
    typer.echo(
        f"{file}: {solution.provenance.get('system', 'a system')}, {solution.provenance.get('method', 'a method')}"
    )
    raise typer.Exit(0 if _print_audit(solution) else EXIT_LAWS_FAILED)


def main() -> None:
    """Entry point of the command ``liethermo``."""
    app(prog_name="liethermo")


# -- helpers --------------------------------------------------------------------------------------------------------


def _prepare_result_folder(spec: Path, folder: Path) -> Path:
    """Create the folder of the results and copy the spec into it, so that an unwritable folder fails at once."""
    with disk.file_errors("write the results into", folder), contextlib.suppress(shutil.SameFileError):
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(spec, folder / spec.name)
    return folder


def _draw_figures(plan: Spec, system: System, solution: Solution, folder: Path) -> list[str]:
    """Draw the figures that a spec file asks for, and return the names of their files."""
    os.environ.setdefault("MPLBACKEND", "agg")  # write files without a display
    from .results import plot

    files = []
    for name in plan.outputs.figures:
        figure = getattr(plot, name)
        options = {"system": system} if "system" in inspect.signature(figure).parameters else {}
        files.append(f"{name}.{plan.outputs.figure_format}")
        figure(solution, path=folder / files[-1], **options)
    return files


def _print_audit(result: Solution | Ensemble) -> bool:
    """Print the status of a run or an ensemble and its audit; return True if all laws hold."""
    audit = result.audit()
    if isinstance(result, Solution):
        typer.echo(f"{result.status} ({result.stats.wall_time:.1f} s)")
    else:
        typer.echo(f"{result} ({result.wall_time:.1f} s)")
    return _print_table(audit)


def _print_table(table: Audit | CheckReport) -> bool:
    """Print an audit or a check with coloured verdicts; return True if it passed."""
    text = str(table).replace(" FAILS", " " + typer.style("FAILS", fg="red", bold=True))
    typer.echo(re.sub(r" ok(?= |$)", " " + typer.style("ok", fg="green"), text, flags=re.MULTILINE))
    return table.passed


@contextlib.contextmanager
def _dask_client(address: str | None, folder: Path) -> Iterator[Any]:
    """Yield a client of a Dask cluster to which modules in a folder are sent, or None without an address."""
    if address is None:
        yield None
        return
    from distributed import Client

    from .spec.trust import pickle_spec_modules_by_value

    try:
        client = Client(address, timeout=20)
    except (OSError, ValueError) as error:
        raise FileError(f"there is no Dask scheduler at {address}: {error}") from error
    with client, pickle_spec_modules_by_value(folder):
        yield client


def _draw_study(store: Path, measure: str | None, file: Path) -> None:
    """Draw a measure of a store into a file; without a named measure, an undrawable store only prints the reason."""
    os.environ.setdefault("MPLBACKEND", "agg")
    from .results.plot import study as draw_study

    try:
        draw_study(load_study(store), measure, file)
        typer.echo(f"In {store}; drawn in {file}")
    except InputError as error:
        if measure is not None:
            raise
        typer.echo(f"In {store}; nothing is drawn: {error}")


if __name__ == "__main__":
    main()
