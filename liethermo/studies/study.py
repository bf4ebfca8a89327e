"""The class :class:`Study`: definition, runs and results of a parameter study."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from manifolds._class_members import ListedType
from manifolds._precision import with_library_settings
from manifolds.errors import warn

from ..disk import checked_path
from ..engines.status_codes import StatusCode
from ..errors import InputError
from ..integrators import OneStepMethod
from ..results.audit import Audit
from ..runs.adaptive import Adaptive
from ..runs.events import Relaxed
from ..runs.noise import Fluctuations, check_noise
from ..runs.preparation import check_choice, checked_or_default_method
from ..runs.schedule import make_schedule
from ..systems import System
from . import identity, store_metadata
from .axes import Axes, Zipped, axes_in_store_order
from .measures import At, Measure, SolutionMeasure, ValuesAtTimes, parse_measures_and_event
from .members import UNKNOWN_PARAMETER_TEXT, AccessRecorder, system_builder, to_python_values
from .progress import StudyProgressBar, StudyStatus
from .running import solve_chunks_locally, solve_chunks_on_cluster
from .solve import MEASURE_FAILED, STATUSES, PointResults, PointSolver, StudyTask, describe_error
from .store import STORE_FORMAT, StoreSurvey, StudyStore
from .store_results import audit_store, load_status, open_results, status_of_store

if TYPE_CHECKING:
    import xarray

TARGET_STEPS_PER_CHUNK = 20_000_000
"""Target number of time steps in a chunk: long beside the overhead of a chunk, short beside a study."""

MAX_POINTS_PER_CHUNK = 16_384
"""Maximum number of points in a chunk, unless ``chunk`` is given."""

MAX_UNVECTORISED_CHUNK_POINTS = 64
"""Maximum number of points in a chunk if each system is built separately."""

MAX_CANDIDATE_POINTS = 256
"""Maximum number of points, spread over the axes, that are tried as an example."""

MAX_FAILED_EXAMPLES = 2
"""Number of systems that are built but cannot be run after which the search for an example stops."""

WARN_UNVECTORISED_POINTS = 1_000
"""Number of points above which the user is warned that each system is built separately."""


class Study(metaclass=ListedType):
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
        Folder of the results; by default a temporary one, for as long as this object or an array of its results exists.
    attitude, noise : array, shape (m, m), or function from the dict of a point to one; Fluctuations; optional
        As for :func:`integrate` (dimensionless attitudes). The seed of a point depends only on the seed of the noise
        and on its place on the axes. Chunks, workers and longer axes do not change it.
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
        self._measures, until = parse_measures_and_event(measure, until)
        axis_names = {*self._axes.names, *self._axes.parameter_names}
        if shared_names := axis_names & {*self._measures}:
            raise InputError(f"{shared_names.pop()!r} names a measure and an axis; rename one of them")
        check_noise(noise)
        method = checked_or_default_method(method, noise)
        check_choice("engine", engine, ("auto", "array", "compiled"))
        if chunk is not None and (isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1):
            raise InputError(f"chunk must be a positive integer, got {chunk!r}")
        sources = [*(["x0"] if x0 is not None else []), *(a.name for a in self._axes.axes if a.states is not None)]
        if not sources:
            raise InputError("x0 is missing: a state, or a function from the dict of a point to one")
        if len(sources) > 1:
            raise InputError(f"initial states are given more than once, by {' and '.join(sources)}. Keep one of them")
        times = sorted({t for m in self._measures.values() if isinstance(m, ValuesAtTimes) for t in m.at.times})
        needs_path = any(measure.needs_path for measure in self._measures.values())
        schedule = make_schedule(t_span, step, 1)
        if times and not (schedule.start <= times[0] and times[-1] <= schedule.end):
            raise InputError(
                f"the times of lt.At must lie within t_span = {tuple(t_span)}, got {times[0]:g} to {times[-1]:g}"
            )
        needs_all_steps = any(m.needs_path and not isinstance(m, ValuesAtTimes) for m in self._measures.values())
        unreachable_times = [
            t for t in times if needs_all_steps and np.abs(schedule.saved_times - t).min() > 1e-9 * schedule.h
        ]
        if unreachable_times:
            raise InputError(
                "with a function of a solution among the measures, the times of lt.At must be ends of steps, "
                f"got {unreachable_times[0]:g}"
            )
        save_at = tuple(times) if times and not needs_all_steps else None
        n_saved = (len(times) if save_at else schedule.n_steps + 1) if needs_path else 0
        self._chunk_points, self._n_steps, self._n_saved = chunk, schedule.n_steps, n_saved
        self._array_attributes = {
            name: {k: v for k, v in (("units", (units or {}).get(name)), ("long_name", (names or {}).get(name))) if v}
            for name in (*axis_names, *self._measures)
        }
        for name, measure_object in self._measures.items():
            self._array_attributes[name].setdefault("long_name", measure_object.description())
        unknown = [name for name in (*(units or {}), *(names or {})) if name not in self._array_attributes]
        if unknown:
            raise InputError(f"there is no axis, parameter or measure {unknown[0]!r} to name")
        self._spec = None if spec is None else dict(spec)
        self._temporary_folder: store_metadata.TemporaryFolder | None = None
        if store is None:
            self._temporary_folder = store_metadata.TemporaryFolder()
            store = self._temporary_folder.path / "study.zarr"
        self.store = checked_path(store, "store")
        parameters = self._axes.parameter_names
        self._task = StudyTask(
            system_builder(build, parameters), parameters, x0, attitude, (schedule.start, schedule.end), step, method,
            until, engine, self._measures, {}, save_at, n_saved, noise,
        )  # fmt: skip
        self._example: tuple[PointSolver, PointResults, np.ndarray] | None = None
        self._example_index: tuple[int, ...] = ()

    # -- running --------------------------------------------------------------------------------------------------

    @with_library_settings
    def run(self, client: object = None, *, progress: bool | None = None) -> StudyStatus:
        """Solve the unfinished points and store their results.

        Parameters
        ----------
        client : dask.distributed.Client, optional
            A cluster whose machines share the folder of the store. By default, all cores of this machine are used.
        progress : bool, optional
            Show a bar with the remaining time; by default in a terminal and in a notebook.

        Returns
        -------
        StudyStatus
            Also after Ctrl-C; another call resumes the study.

        Raises
        ------
        InputError, FileError
            If no point can be run, the store belongs to another study, or another run works on it.
        """
        store, axes = self._open_or_create_store_and_axes()
        is_interrupted = False
        with store_metadata.lock_store(store.root) as record_run:
            store, axes = (
                self._open_or_create_store_and_axes()
            )  # another run may have changed it before the lock was taken
            store_metadata.remove_partial_files(store.root)
            if store.shape != axes.shape:
                store = store.extend(axes)
            survey = store.survey()
            record_run(survey.n_done)
            try:
                with StudyProgressBar(store.n_points, survey.n_done, progress) as progress_bar:
                    self._solve_remaining(store, axes, survey, progress_bar, client)
            except KeyboardInterrupt:
                is_interrupted = True
        return dataclasses.replace(status_of_store(store), damaged=survey.damaged, interrupted=is_interrupted)

    def _solve_remaining(
        self, store: StudyStore, axes: Axes, survey: StoreSurvey, progress_bar: StudyProgressBar, client: Any
    ) -> None:
        """Solve the unfinished chunks of the store, in this process or on the cluster of ``client``."""
        if not survey.remaining_chunks:
            return
        solver = self._solve_example(axes, tuple(store.study_description["place"]))[0]
        if client is None:
            solve_chunks_locally(solver, store, axes, survey, progress_bar)
        else:
            solve_chunks_on_cluster(solver.task, store, axes, survey, progress_bar, client)

    def status(self) -> StudyStatus:
        """Return the progress of the study from its store, also while another process runs it.

        FileError if there is no store.
        """
        return load_status(self.store)

    # -- results ----------------------------------------------------------------------------------------------------

    @property
    def results(self) -> xarray.Dataset:
        """The results so far, with the axes as coordinates; ``status`` and ``message`` say how each point ended.

        Values are read from the files on access.
        """
        dataset = open_results(self.store, self._temporary_folder)
        store = StudyStore.open(self.store)
        axes, stored_axes = self._axes, store.read_axes()
        order = {}
        for axis, stored_axis in zip(axes.axes, stored_axes.axes, strict=True):
            if axis.name in axis.columns and len(axis) == len(
                stored_axis
            ):  # from the order of the store to that of this study
                index_by_key = {row: i for i, row in enumerate(stored_axis.value_keys())}
                order[axis.name] = [index_by_key[row] for row in axis.value_keys()]
        return dataset.isel(order) if order else dataset

    def audit(self, **tolerances: float) -> Audit:
        """Audit the laws over all finished points, each law by its worst point; printing the result gives a table.

        FileError if there is no store, InputError if a tolerance has an unknown name or is negative.

        Parameters
        ----------
        energy, entropy, casimirs, residual : float
            Tolerances: see :class:`liethermo.results.audit.Tolerances`.
        """
        return audit_store(self.store, **tolerances)

    # -- store and example ------------------------------------------------------------------------------------------

    def _open_or_create_store_and_axes(self) -> tuple[StudyStore, Axes]:
        """Open or create the store; return it and the axes in its order, or raise InputError if another study made
        it."""
        if not self.store.exists() or (self.store.is_dir() and not any(self.store.iterdir())):
            solver, columns, x0 = self._solve_example()
            description = {**identity.study_as_json(solver, columns, x0), "place": list(self._example_index)}
            array_attributes: dict[str, dict[str, Any]] = {
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
                "title": f"study of {', '.join(self._axes.parameter_names)}: {description['system']}",
                **identity.provenance(description, solver.engine),
                "study": description,
                "laws": dataclasses.asdict(laws),
                "measures": list(self._measures),
                "axes": {axis.name: list(axis.columns) for axis in self._axes.axes},
                "spec": self._spec,
            }
            shapes = {
                name: (values.shape[1:], "complex128" if values.dtype.kind == "c" else "float64")
                for name, values in columns.measures.items()
            }
            store = StudyStore.create(
                self.store, self._axes, self._points_per_chunk(solver), shapes, array_attributes, attributes
            )
        else:
            store = StudyStore.open(self.store)
        try:
            axes = axes_in_store_order(self._axes, store.read_or_repair_axes(self._axes))
            solver, columns, x0 = self._solve_example(axes, tuple(store.study_description["place"]))
            differences = identity.study_differences(
                identity.study_as_json(solver, columns, x0), store.study_description
            )
        except InputError as error:
            differences = [str(error)]
        if differences:
            head = f"{self.store} is the store of another study. Use another name for this one:"
            raise InputError("\n  ".join([head, *differences]))
        return store, axes

    def _points_per_chunk(self, solver: PointSolver) -> int:
        """Return the approximate number of points per chunk for a new store."""
        if self._chunk_points is not None:
            return self._chunk_points
        max_points = MAX_UNVECTORISED_CHUNK_POINTS if solver.systems.family is None else MAX_POINTS_PER_CHUNK
        return max(1, min(max_points, max(64, TARGET_STEPS_PER_CHUNK // max(self._n_steps, 100))))

    def _solve_example(
        self, axes: Axes | None = None, index: tuple[int, ...] = ()
    ) -> tuple[PointSolver, PointResults, np.ndarray]:
        """Run one point of the study as an example; return its solver, its results and its initial state.

        The example is the point at ``index`` of the axes, or the first candidate that can be run.
        """
        if self._example is not None and (
            axes is None or self._example[0].task.example_point == _point_and_state_at(axes, index)[0]
        ):
            return self._example
        axes, candidates = (self._axes, self._example_candidate_indices()) if axes is None else (axes, [index])
        first_failure, n_failed = "", 0
        for index in candidates:
            seeds = None if self._task.noise is None else self._task.noise.grid_seeds([np.array([i]) for i in index])
            reason, was_built = self._solve_example_or_explain(*_point_and_state_at(axes, index), seeds)
            if self._example is not None and not reason:
                self._example_index = index
                return self._example
            first_failure = first_failure or f"{axes.describe_point(index)}: {reason}"
            n_failed += was_built
            if n_failed == MAX_FAILED_EXAMPLES:
                break
        raise InputError(f"no point of the study can be run; the first: {first_failure}")

    def _example_candidate_indices(self) -> list[tuple[int, ...]]:
        """Return the indices of candidates for the example point, spread over the axes; the first is the first
        point."""
        size, shape = self._axes.size, self._axes.shape
        numbers = dict.fromkeys(int(size * _van_der_corput(k)) for k in range(MAX_CANDIDATE_POINTS))
        return [tuple(map(int, np.unravel_index(number, shape))) for number in numbers]

    def _solve_example_or_explain(
        self, point: dict[str, Any], states: np.ndarray | None, seeds: np.ndarray | None
    ) -> tuple[str, bool]:
        """Solve one point as the example of the study; return an error message, or "", and whether its
        system was built."""
        self._example = None
        self._check_axes_are_used(point)
        try:
            solver = PointSolver(dataclasses.replace(self._task, example_point=point))
        except Exception as error:  # user code, which may raise at some points
            return describe_error(error), False
        columns = solver.solve({name: np.array([value]) for name, value in point.items()}, states, 1, seeds)
        if columns.status[0] in (StatusCode.INADMISSIBLE, MEASURE_FAILED):
            return columns.message[0], True
        measures = {
            name: _with_example_value(measure, columns.measures[name][0]) for name, measure in self._measures.items()
        }
        solver.task = dataclasses.replace(solver.task, measures=measures)
        if solver.systems.family is not None:  # use one engine for all chunks
            solver.task = dataclasses.replace(solver.task, engine=solver.engine)
        elif self._axes.size > WARN_UNVECTORISED_POINTS:
            warn(
                f"the builder cannot be traced ({solver.systems.why_no_family}), so that each of {self._axes.size} "
                "systems is built separately. Write it with jax.numpy and without Python's if, so that one program "
                "builds all"
            )
        self._example = solver, columns, self._initial_state(solver, point, states)
        return "", True

    def _initial_state(self, solver: PointSolver, point: dict[str, Any], states: np.ndarray | None) -> np.ndarray:
        """Return the initial state of a point, shape (n,), after its system has checked it."""
        source = self._task.x0
        x0 = states[0] if states is not None else source(AccessRecorder(point)) if callable(source) else source
        return np.asarray(solver.systems.example_system.state(x0), dtype=np.float64)

    def _check_axes_are_used(self, point: dict[str, Any]) -> None:
        """Raise InputError if an axis is used neither by the builder, nor by ``x0``, nor by ``attitude``."""
        recorder = AccessRecorder(to_python_values(point))
        for function in filter(callable, (self._task.build, self._task.x0, self._task.attitude)):
            try:
                function(recorder)
            except InputError as error:
                if UNKNOWN_PARAMETER_TEXT in str(error):
                    raise
                return
            except Exception:  # reported as the status of this point
                return
        unread = [name for name in self._axes.parameter_names if name not in recorder.accessed_names]
        if unread:
            raise InputError(f"axis {unread[0]!r} is used by neither build nor x0. For repeated runs use lt.replicas")


def _with_example_value(measure: Measure, value: np.ndarray) -> Measure:
    """Return a measure that is a user's function with its value at the example point attached, and others unchanged."""
    return dataclasses.replace(measure, example_value=value) if isinstance(measure, SolutionMeasure) else measure


def _point_and_state_at(axes: Axes, index: tuple[int, ...]) -> tuple[dict[str, Any], np.ndarray | None]:
    """Return the parameters of the point at an index, and its initial state, shape (1, n), None if no axis has any."""
    indices = tuple(np.array([i]) for i in index)
    return to_python_values({name: values[0] for name, values in axes.parameters_at(indices).items()}), axes.states_at(
        indices
    )


def _van_der_corput(k: int) -> float:
    """Return the k-th number of the van der Corput sequence: 0, 1/2, 1/4, 3/4, ..."""
    return sum((k >> bit & 1) / 2 ** (bit + 1) for bit in range(k.bit_length()))
