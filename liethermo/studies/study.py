"""``Study``: what a user describes, and what comes of it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from manifolds._precision import with_library_settings
from manifolds.errors import warn

from ..engines.codes import StatusCode
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..results.audit import Audit
from ..runs.adaptive import Adaptive
from ..runs.events import Relaxed
from ..runs.fluctuations import DEFAULT_NOISE_METHOD, Fluctuations, check_noise
from ..runs.preparation import check_choice
from ..runs.timetable import make_schedule
from ..systems import System
from . import files, identity
from .axes import Axes, Zipped
from .measures import At, Measure, SolutionMeasure, ValuesAtTimes, parse_measures
from .members import UNKNOWN_PARAMETER_TEXT, AccessRecorder, as_python_values, system_builder
from .progress import StudyProgressBar, StudyStatus
from .running import run_locally, run_on_cluster
from .solve import MEASURE_FAILED, STATUSES, PointResults, PointSolver, StudyTask, describe_error
from .store import STORE_FORMAT, StoreSurvey, StudyStore, match_axes
from .store_results import audit_store, load_status, open_results, store_status

if TYPE_CHECKING:
    import xarray

TARGET_STEPS_PER_CHUNK = 20_000_000
"""Steps of all points of a chunk, about: some seconds."""

MAX_POINTS_PER_CHUNK = 16_384
"""Points of a chunk at most, unless asked for."""

MAX_UNVECTORISED_CHUNK_POINTS = 64
"""Points of a chunk at most where each is built by itself."""

MAX_CANDIDATE_POINTS = 256
"""Points that are tried until one can be run, spread over all."""

MAX_FAILED_EXAMPLES = 2
"""Systems that are built and cannot be run, after which no more are tried."""

WARN_UNVECTORISED_POINTS = 1_000
"""Points from which one is reason_of that each has to be built by itself."""


class Study:
    """Runs over grids and samples of parameters, in chunks whose results are kept.

    A point that cannot run, that fails or that breaks a law has its own status and message, and the others go on. The
    results of a point do not depend on the chunks or on the workers.

    Parameters
    ----------
    build : System, or function from a dict with one entry for each parameter to a System
        For a system, the names of axes are those of its parameters, such as ``"dissipation.rate"``. If a function
        accepts traced JAX arrays, one program builds the systems of all points. Otherwise each point is built by
        itself, which takes longer.
    axes : dict from str to values
        Lists of numbers or texts, or :func:`zipped`, :func:`latin_hypercube`, :func:`sobol`, :func:`replicas`.
    x0 : array, shape (n,), or function from the dict of a point to one
        Initial states, in the units of the system; left out if the axes have replicas with states.
    t_span, step, method, until, engine
        As for :func:`integrate` and :func:`ensemble`, with the same units.
    measure : dict from str to measure
        The results to keep of each point: a name ("final", "relaxation_time", "end_time", …), ``lt.Relaxed(tol)`` for
        the time at which the rate is below ``tol``, where the run ends too, ``lt.At(times)``, or any function from a
        :class:`Solution` to a number or an array.
    store : path, optional
        Folder of the results. Without one they are kept in a temporary folder as long as this object, or an array of
        its results, exists.
    attitude : array, shape (m, m), or function from the dict of a point to one, optional
        As for :func:`integrate` (dimensionless).
    noise : Fluctuations, optional
        As for :func:`integrate`. The seed of a point depends only on that of the noise and on its place on the axes.
        Chunks, workers and longer axes do not change it.
    chunk : int, optional
        The approximate number of points of a chunk. A chunk is in memory at once, and is lost if a run is killed.
    units, names : dict from str to str, optional
        Units and names of axes, parameters and measures, for tables and pictures: ``units={"rate": "1/s"}``.
    spec : dict, optional
        JSON data to keep with the results.

    Raises
    ------
    InputError
        If an argument cannot be used.

    Examples
    --------
    >>> study = lt.Study(
    ...     lambda p: lt.models.rigid_body((1.0, p["ratio"], 0.5), p["rate"]),
    ...     {"ratio": [0.6, 0.8], "rate": [0.5, 1.0, 2.0]},
    ...     x0=[0.1, 0.2, 1.0],
    ...     t_span=(0.0, 20.0),
    ...     step=0.2,
    ...     measure={"tau": "relaxation_time"},
    ... )
    >>> study.run(progress=False).ok, dict(study.results["tau"].sizes)
    (True, {'ratio': 2, 'rate': 3})
    """

    @with_library_settings
    def __init__(
        self,
        build: System | Callable[[dict], System],
        axes: Mapping[str, Sequence | np.ndarray | Zipped],
        *,
        x0: npt.ArrayLike | Callable[[dict], npt.ArrayLike] | None = None,
        t_span: tuple[float, float],
        step: float | Adaptive,
        method: OneStepMethod | None = None,
        measure: Mapping[str, str | Relaxed | At | Callable],
        store: str | os.PathLike | None = None,
        until: Relaxed | Callable | None = None,
        engine: Literal["auto", "array", "compiled"] = "auto",
        attitude: npt.ArrayLike | Callable[[dict], npt.ArrayLike] | None = None,
        noise: Fluctuations | None = None,
        chunk: int | None = None,
        units: Mapping[str, str] | None = None,
        names: Mapping[str, str] | None = None,
        spec: Mapping[str, object] | None = None,
    ):
        self._axes = Axes.from_mapping(axes)
        self._measures, until = parse_measures(measure, until)
        taken = {*self._axes.names, *self._axes.parameter_names}
        if both := taken & {*self._measures}:
            raise InputError(f"{both.pop()!r} is a measure and an axis")
        check_noise(noise)
        method = (DEFAULT_METHOD if noise is None else DEFAULT_NOISE_METHOD) if method is None else method
        if not isinstance(method, OneStepMethod):
            raise InputError(f"the method must be an integrator such as lt.MetriplecticGauss(), not {method!r}")
        check_choice("engine", engine, ("auto", "array", "compiled"))
        if chunk is not None and (isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1):
            raise InputError(f"chunk must be a positive integer, not {chunk!r}")
        sources = [*(["x0"] if x0 is not None else []), *(a.name for a in self._axes.axes if a.states is not None)]
        if not sources:
            raise InputError("x0 is missing: a state, or a function from the dict of a point to one")
        if len(sources) > 1:
            raise InputError(f"initial states come from one place, not from {' and '.join(sources)}")
        times = sorted({t for m in self._measures.values() if isinstance(m, ValuesAtTimes) for t in m.at.times})
        path = any(measure.needs_path for measure in self._measures.values())
        table = make_schedule(t_span, step, 1)
        if times and not (table.start <= times[0] and times[-1] <= table.end):
            raise InputError(
                f"the times of measures lie within t_span = {tuple(t_span)}, and {times[0]:g} to {times[-1]:g} do not"
            )
        every = any(m.needs_path and not isinstance(m, ValuesAtTimes) for m in self._measures.values())
        off = [t for t in times if every and np.abs(table.saved_times - t).min() > 1e-9 * table.h]
        if off:
            raise InputError(f"beside a function of a solution lt.At takes times at which steps end, not {off[0]:g}")
        save_at = tuple(times) if times and not every else None
        saves = (len(times) if save_at else table.n_steps + 1) if path else 0
        self._chunk_points, self._n_steps, self._n_saved = chunk, table.n_steps, saves
        self._array_attributes = {
            name: {k: v for k, v in (("units", (units or {}).get(name)), ("long_name", (names or {}).get(name))) if v}
            for name in (*taken, *self._measures)
        }
        for name, what in self._measures.items():
            self._array_attributes[name].setdefault("long_name", what.description())
        unknown = [name for name in (*(units or {}), *(names or {})) if name not in self._array_attributes]
        if unknown:
            raise InputError(f"there is no axis, parameter or measure {unknown[0]!r} to name")
        self._spec = None if spec is None else dict(spec)
        self._temporary_folder: files.TemporaryFolder | None = None
        if store is None:
            self._temporary_folder = files.TemporaryFolder()
            store = self._temporary_folder.path / "study.zarr"
        self.store = Path(store)
        parameters = self._axes.parameter_names
        self._task = StudyTask(
            system_builder(build, parameters), parameters, x0, attitude, (table.start, table.end), step, method, until, engine,
            self._measures, {}, save_at, saves, noise,
        )  # fmt: skip
        self._example: tuple[PointSolver, PointResults, np.ndarray] | None = None
        self._example_index: tuple[int, ...] = ()

    # -- running --------------------------------------------------------------------------------------------------

    @with_library_settings
    def run(self, client: object = None, *, progress: bool | None = None) -> StudyStatus:
        """Do what is not done, and keep it: nothing is done twice.

        Parameters
        ----------
        client : dask.distributed.Client, optional
            A cluster whose machines share the folder of the store. By default this machine, with all its cores.
        progress : bool, optional
            Show a bar with the time left; by default on a terminal and in a notebook.

        Returns
        -------
        StudyStatus
            After Ctrl-C too: running again goes on from there.

        Raises
        ------
        InputError
            If no point can be run, or the store is that of another study.
        FileError
            If the store cannot be read or written, or another run works on it.
        """
        store, axes = self._open_store()
        interrupted = False
        with files.lock_store(store.root) as tell:
            store, axes = self._open_store()  # as another run may have left it
            files.remove_parts(store.root)
            if store.shape != axes.shape:
                store = store.extend(axes)
            survey = store.survey()
            tell(survey.n_done)
            try:
                with StudyProgressBar(store.n_points, survey.n_done, progress) as bar:
                    self._solve_remaining(store, axes, survey, bar, client)
            except KeyboardInterrupt:
                interrupted = True
        return dataclasses.replace(store_status(store), damaged=survey.damaged, interrupted=interrupted)

    def _solve_remaining(
        self, store: StudyStore, axes: Axes, survey: StoreSurvey, bar: StudyProgressBar, client: Any
    ) -> None:
        if not survey.remaining_chunks:
            return
        solver = self._solve_example(axes, tuple(store.study_description["place"]))[0]
        if client is None:
            run_locally(solver, store, axes, survey, bar)
        else:
            run_on_cluster(solver.task, store, axes, survey, bar, client)

    def status(self) -> StudyStatus:
        """How far the study is, from its store: any process may ask, also while another runs it.

        Raises
        ------
        FileError
            If there is no store.
        """
        return load_status(self.store)

    # -- results ----------------------------------------------------------------------------------------------------

    @property
    def results(self) -> xarray.Dataset:
        """The results so far: the axes are coordinates, ``status`` and ``message`` say how each point ended.

        Values are read from the files when they are looked at.

        Raises
        ------
        FileError
            If there is no store.
        """
        found = open_results(self.store, self._temporary_folder)
        store = StudyStore.open(self.store)
        mine, theirs = self._axes, store.read_axes()
        order = {}
        for axis, kept in zip(mine.axes, theirs.axes, strict=True):
            if axis.name in axis.columns and len(axis) == len(kept):  # in the order of this study, not of the store
                place = {row: i for i, row in enumerate(kept.value_keys())}
                order[axis.name] = [place[row] for row in axis.value_keys()]
        return found.isel(order) if order else found

    def audit(self, **tolerances: float) -> Audit:
        """The laws over all points that are done, each by the one that kept it worst; printing it gives a table.

        Parameters
        ----------
        energy, entropy, casimirs, residual : float
            What is accepted: see :class:`liethermo.results.audit.Tolerances`.

        Raises
        ------
        FileError
            If there is no store.
        InputError
            If there is no tolerance of a name, or it is negative.
        """
        return audit_store(self.store, **tolerances)

    # -- what it is -------------------------------------------------------------------------------------------------

    def _open_store(self) -> tuple[StudyStore, Axes]:
        """The store, made where there is none, and the axes in its order; refused where it is of another study."""
        if not self.store.exists() or (self.store.is_dir() and not any(self.store.iterdir())):
            solver, columns, x0 = self._solve_example()
            described = {**identity.describe_study(solver, columns, x0), "place": list(self._example_index)}
            about: dict[str, dict[str, Any]] = {
                **self._array_attributes,
                "status": {
                    "long_name": "how the point ended",
                    "flag_values": list(STATUSES.values()),
                    "flag_meanings": " ".join(STATUSES),
                },
                "message": {"long_name": "what happened at the point"},
                "laws": {"long_name": "what is known of the laws along the run"},
            }
            laws = solver.laws
            assert laws is not None
            attributes = {
                "format": STORE_FORMAT,
                "title": f"study of {', '.join(self._axes.parameter_names)}: {described['system']}",
                **identity.provenance(described, solver.engine),
                "study": described,
                "laws": dataclasses.asdict(laws),
                "measures": list(self._measures),
                "axes": {axis.name: list(axis.columns) for axis in self._axes.axes},
                "spec": self._spec,
            }
            shapes = {
                name: (values.shape[1:], "complex128" if values.dtype.kind == "c" else "float64")
                for name, values in columns.measures.items()
            }
            store = StudyStore.create(self.store, self._axes, self._points_per_chunk(solver), shapes, about, attributes)
        else:
            store = StudyStore.open(self.store)
        try:
            axes = match_axes(self._axes, store.repaired_axes(self._axes))
            solver, columns, x0 = self._solve_example(axes, tuple(store.study_description["place"]))
            lines = identity.study_differences(identity.describe_study(solver, columns, x0), store.study_description)
        except InputError as error:
            lines = [str(error)]
        if lines:
            head = f"{self.store} is the store of another study; take another name for this one:"
            raise InputError("\n  ".join([head, *lines]))
        return store, axes

    def _points_per_chunk(self, solver: PointSolver) -> int:
        """Points of a chunk."""
        if self._chunk_points is not None:
            return self._chunk_points
        most = MAX_UNVECTORISED_CHUNK_POINTS if solver.systems.family is None else MAX_POINTS_PER_CHUNK
        return max(1, min(most, max(64, TARGET_STEPS_PER_CHUNK // max(self._n_steps, 100))))

    def _solve_example(
        self, axes: Axes | None = None, place: tuple[int, ...] = ()
    ) -> tuple[PointSolver, PointResults, np.ndarray]:
        """The solver, and its example solved: the point at a place of some axes, or the first that can be run."""
        if self._example is not None and (
            axes is None or self._example[0].task.example_point == _point_at(axes, place)[0]
        ):
            return self._example
        axes, places = (self._axes, self._candidate_indices()) if axes is None else (axes, [place])
        first, failed = "", 0
        for place in places:
            seeds = None if self._task.noise is None else self._task.noise.grid_seeds([np.array([i]) for i in place])
            why, built = self._try_point(*_point_at(axes, place), seeds)
            if self._example is not None and not why:
                self._example_index = place
                return self._example
            first = first or f"{axes.describe_point(place)}: {why}"
            failed += built
            if failed == MAX_FAILED_EXAMPLES:
                break
        raise InputError(f"no point of the study can be run; the first: {first}")

    def _candidate_indices(self) -> list[tuple[int, ...]]:
        """Places spread over the axes, the first point first."""
        size, shape = self._axes.size, self._axes.shape
        numbers = dict.fromkeys(int(size * _van_der_corput(k)) for k in range(MAX_CANDIDATE_POINTS))
        return [tuple(map(int, np.unravel_index(number, shape))) for number in numbers]

    def _try_point(
        self, point: dict[str, Any], states: np.ndarray | None, seeds: np.ndarray | None
    ) -> tuple[str, bool]:
        """Solve a point by itself; why it cannot be, or nothing, and whether its system was built."""
        self._example = None
        self._require_used_axes(point)
        try:
            solver = PointSolver(dataclasses.replace(self._task, example_point=point))
        except Exception as error:  # the builder may be anyone's, and may raise at some points
            return describe_error(error), False
        columns = solver.solve({name: np.array([value]) for name, value in point.items()}, states, 1, seeds)
        if columns.status[0] in (StatusCode.INADMISSIBLE, MEASURE_FAILED):
            return columns.message[0], True
        measures = {
            name: _with_example_value(measure, columns.measures[name][0]) for name, measure in self._measures.items()
        }
        solver.task = dataclasses.replace(solver.task, measures=measures)
        if solver.systems.family is not None:  # and not another engine for some of the chunks
            solver.task = dataclasses.replace(solver.task, engine=solver.engine)
        elif self._axes.size > WARN_UNVECTORISED_POINTS:
            warn(
                f"the builder cannot be traced ({solver.systems.why_no_family}), so that each of {self._axes.size} points is "
                "built by itself; written with jax.numpy and without Python's if, one program builds all"
            )
        self._example = solver, columns, self._initial_state(solver, point, states)
        return "", True

    def _initial_state(self, solver: PointSolver, point: dict[str, Any], states: np.ndarray | None) -> np.ndarray:
        given = self._task.x0
        x0 = states[0] if states is not None else given(AccessRecorder(point)) if callable(given) else given
        return np.asarray(solver.systems.example_system.state(x0), dtype=np.float64)

    def _require_used_axes(self, point: dict[str, Any]) -> None:
        """Refuse axes that are not used."""
        watched = AccessRecorder(as_python_values(point))
        for function in filter(callable, (self._task.build, self._task.x0, self._task.attitude)):
            try:
                function(watched)
            except InputError as error:
                if UNKNOWN_PARAMETER_TEXT in str(error):
                    raise
                return
            except Exception:  # reason_of as the reason of this point
                return
        unread = [name for name in self._axes.parameter_names if name not in watched.accessed_names]
        if unread:
            raise InputError(
                f"{unread[0]!r} is looked at neither by the builder nor by x0; an axis of replicas is lt.replicas"
            )


def _with_example_value(measure: Measure, value: np.ndarray) -> Measure:
    """A measure that knows what it is at the first point."""
    return dataclasses.replace(measure, example_value=value) if isinstance(measure, SolutionMeasure) else measure


def _point_at(axes: Axes, place: tuple[int, ...]) -> tuple[dict[str, Any], np.ndarray | None]:
    """The point at a place, and its initial state, shape (1, n), where an axis brings one."""
    rows = tuple(np.array([i]) for i in place)
    return as_python_values({name: values[0] for name, values in axes.parameters_at(rows).items()}), axes.states_at(
        rows
    )


def _van_der_corput(k: int) -> float:
    """The k-th number of van der Corput's sequence: 0, 1/2, 1/4, 3/4, ..."""
    return sum((k >> bit & 1) / 2 ** (bit + 1) for bit in range(k.bit_length()))
