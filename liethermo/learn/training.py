"""Descent on a loss, in blocks of steps after each of which the course is looked at and may be kept in a file."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import disk
from ..errors import FileError, InputError
from ..runs.progress import Progress
from .compile_options import fast_compile_options
from .descent import soap_optimiser
from .losses import Objective, ParameterVector
from .refining import LeastSquaresResult

STEPS_PER_EVALUATION = 50
"""Steps between two looks at the course."""

MAX_VALIDATION_ITEMS = 512
"""Items at most that a validation loss is the mean over."""

IMPROVEMENT_FACTOR = 0.999
"""What the loss has to fall below, relative to the least so far, to count as better."""

CHECKPOINT_FORMAT = "liethermo-training-1"


@dataclass(frozen=True)
class Phase:
    """A part of a fit: a loss, and how long and how fast it is descended."""

    name: str
    objective: Objective
    held_out_objective: Objective | None
    steps: int
    rate: float
    batch_size: int
    array_shapes: tuple[tuple[int, ...], ...]


LEAST_SQUARES = "least squares"
"""Name of the refinement in the record of a fit."""

MAX_RELATIVE_STANDARD_ERROR = 0.5
"""Standard error of a number, relative to it, above which the data do not determine it."""

MAX_RESIDUAL_TO_NOISE = 1.5
"""Residual, relative to the noise, above which the model does not describe the data."""


class FitWarning(UserWarning):
    """A fit that has not converged, or whose data do not determine what is learned."""


@dataclass(frozen=True)
class Training:
    """The record of a fit.

    Attributes
    ----------
    step : ndarray of int, shape (looks,)
        Steps taken when the course was looked at, those of all phases together.
    phase : ndarray of str, shape (looks,)
    loss : ndarray, shape (looks,)
        The mean over the steps since the last look; mean squares, of the matching relative to the speed of the state,
        of the shooting to the spread of the data or the noise.
    validation : ndarray, shape (looks,)
        The loss of what is held out, NaN where nothing is.
    parameters : int
        How many numbers were learned.
    seconds : float
        Of this call, compilation among them.
    ended : dict of str
        How each phase ended, in words.
    names : tuple of str
        Where each learned number stands in the system, if the fit was refined by least squares, else none. What
        follows is about these numbers, in their order; arrays are empty and numbers NaN without them.
    values, standard_errors : ndarray, shape (p,)
        The learned numbers, and their standard errors: infinite for a number that the data do not determine.
    covariance : ndarray, shape (p, p)
        Of their errors.
    rank : int
        Number of combinations of the learned numbers that the data determine; p if they determine all.
    condition : float
        Of the Jacobian with columns of norm one: large if some combination is hardly determined.
    residual : float
        Root mean square of what the runs miss of the data, by degrees of freedom, relative to the noise: 1 if the model
        describes the data. If the noise is not known, relative to the spread of the data.
    held_out : float
        The same of the trajectories held out, of which only the first states are found.
    gradient : float
        Norm of the derivative of ln(loss) by the learned numbers, logarithms of those that stay positive: of the least
        squares, or of the last batch.
    converged : bool or None
        Whether the Newton step of the least squares is below a hundredth of a standard error; None without them.
    noise : ndarray, shape (k,)
        Standard deviations of the errors of the data, given or estimated; empty where they count as exact.
    noise_is_estimated : bool
    """

    step: np.ndarray
    phase: np.ndarray
    loss: np.ndarray
    validation: np.ndarray
    parameters: int
    seconds: float
    ended: dict[str, str] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    values: np.ndarray = field(default_factory=lambda: np.zeros(0))
    standard_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    rank: int | None = None
    condition: float = np.nan
    residual: float = np.nan
    held_out: float = np.nan
    gradient: float = np.nan
    converged: bool | None = None
    noise: np.ndarray = field(default_factory=lambda: np.zeros(0))
    noise_is_estimated: bool = False

    def with_estimates(
        self, own: ParameterVector, refined: LeastSquaresResult | None, noise, noise_is_estimated: bool
    ) -> Training:
        """Return the record with what a refinement by least squares has found, and the noise."""
        sigma = np.zeros(0) if noise is None else np.asarray(noise)
        record = replace(self, noise=sigma, noise_is_estimated=noise_is_estimated)
        if refined is None:
            return record
        values = np.where(own.is_log, np.exp(refined.weights), refined.weights)
        scale = np.where(own.is_log, values, 1.0)
        with np.errstate(invalid="ignore"):
            covariance = refined.covariance * np.outer(scale, scale)
        covariance = np.where(np.isfinite(covariance), covariance, np.inf)
        return replace(
            record,
            names=own.names,
            values=values,
            standard_errors=np.sqrt(np.diag(covariance)),
            covariance=covariance,
            rank=refined.rank,
            condition=refined.condition,
            residual=refined.residual,
            held_out=refined.held_out_residual,
            gradient=refined.gradient_norm,
            converged=refined.converged,
            ended=self.ended | {LEAST_SQUARES: f"after {refined.iterations} iterations"},
        )

    @property
    def problems(self) -> list[str]:
        """What is wrong with the fit, a sentence each; empty where nothing is known to be."""
        found = []
        if self.converged is False:
            found.append(
                "the fit has not converged: its least squares could not be made smaller, or are not finite. Begin "
                "nearer to the data, or give more iterations, as shooting=2000"
            )
        vague = [
            f"{name} = {value:.3g} ± {error:.2g}"
            for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True)
            if np.isinf(error) or (value > 0.0 and error > MAX_RELATIVE_STANDARD_ERROR * value)
        ]
        if vague:
            found.append(
                f"the data do not determine {', '.join(vague)}: give more data, or leave known numbers out of the fit"
            )
        if self.noise.size and self.residual > MAX_RESIDUAL_TO_NOISE:
            found.append(
                f"what the runs miss of the data is {self.residual:.2g} times the noise: the model cannot describe "
                "them, its steps are too long (substeps=), or the noise is larger (noise=)"
            )
        return found

    def __str__(self) -> str:
        lines = [f"{self.parameters} parameters, {self.seconds:.1f} s"]
        for name, how in self.ended.items():
            of = np.flatnonzero(self.phase == name)
            if len(of):
                last, held = self.loss[of[-1]], self.validation[of[-1]]
                beside = "" if np.isnan(held) else f", held out {held:.2e}"
                lines.append(
                    f"{name}: loss {self.loss[of[0]]:.2e} to {last:.2e}{beside}; {how}{self._late_decrease(of)}"
                )
        if self.noise.size:
            low, high = float(self.noise.min()), float(self.noise.max())
            size = f"{low:.2g}" if low == high else f"{low:.2g} to {high:.2g}"
            lines.append(f"noise of the data: {size}, {'estimated' if self.noise_is_estimated else 'given'}")
        if self.converged is None:
            if np.isfinite(self.gradient):
                lines.append(f"norm of the gradient of ln(loss) of the last batch: {self.gradient:.1e}")
            return "\n".join(lines)
        verdict = "converged" if self.converged else "NOT converged"
        lines.append(
            f"{LEAST_SQUARES}: {verdict} {self.ended[LEAST_SQUARES]}; norm of the gradient of ln(loss) "
            f"{self.gradient:.1e}"
        )
        of_what = "the noise" if self.noise.size else "the spread of the data"
        beside = "" if np.isnan(self.held_out) else f", held out {self.held_out:.3g}"
        lines.append(f"residuals: {self.residual:.3g} of {of_what}{beside}")
        lines.append(
            f"the data determine {self.rank} of {self.parameters} numbers; condition of the Jacobian "
            f"{self.condition:.1e}"
        )
        lines += [
            f"  {name} = {value:.6g} ± {error:.1g}"
            for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True)
        ]
        return "\n".join([*lines, *(f"CAUTION: {problem}" for problem in self.problems)])

    def _late_decrease(self, of: np.ndarray) -> str:
        """By how much the loss fell in the last fifth of the looks at a phase, in words."""
        if len(of) < 10:
            return ""
        before, last = self.loss[of[-1 - len(of) // 5]], self.loss[of[-1]]
        return (
            f", in the last fifth of which the loss fell by {max(1.0 - last / before, 0.0):.1%}" if before > 0.0 else ""
        )


class TrainingRun:
    """A fit under way: all that its next step depends on, so that it can go on from a file."""

    def __init__(self, phases: list[Phase], start: np.ndarray, identity: str):
        self.phases, self.fit_fingerprint = phases, identity
        self.phase_index = self.block_index = 0
        self.evaluations: list[tuple[int, str, float, float]] = []
        self.gradient_norm = float("nan")
        self.ended: dict[str, str] = {}
        self.weights = np.asarray(start)
        self._start_phase()

    def _start_phase(self) -> None:
        """Begin the phase that is next, with the best weights so far."""
        phase = self.phases[self.phase_index]
        self.block_index, self.evaluations_since_best = 0, 0
        self.vector = jnp.concatenate([jnp.asarray(self.weights), jnp.asarray(phase.objective.initial_free)])
        self.optimiser = _make_optimiser(phase)
        self.optimiser_state = self.optimiser.init(self.vector)
        self.best_vector, self.best_loss = np.asarray(self.vector), np.inf

    def run(self, seed: int, patience: int | None, checkpoint: Path | None, progress: bool | None) -> None:
        """Take all steps, or as many as it takes, or as time is given.

        Raises
        ------
        InputError
            If the loss is not finite.
        """
        total = sum(phase.steps for phase in self.phases)
        with Progress((0, total), progress, "step {:.0f}") as bar:
            while self.phase_index < len(self.phases):
                phase = self.phases[self.phase_index]
                try:
                    how = self._run_phase(phase, seed, patience, checkpoint, bar)
                except KeyboardInterrupt:
                    self.ended[phase.name] = "interrupted"
                    self.weights = self.best_vector[: len(self.weights)]
                    return
                self.ended[phase.name] = how
                self.weights = self.best_vector[: len(self.weights)]
                self.phase_index += 1
                if self.phase_index < len(self.phases):
                    self._start_phase()
                self._save_checkpoint(checkpoint)

    def _run_phase(self, phase: Phase, seed: int, patience: int | None, checkpoint: Path | None, bar: Progress) -> str:
        length = min(STEPS_PER_EVALUATION, phase.steps)
        blocks = -(-phase.steps // length)
        descend, look = _compile_programs(phase, self.optimiser)
        before = sum(p.steps for p in self.phases[: self.phase_index])
        if self.block_index == 0 and phase.held_out_objective is not None and np.isfinite(found := look(self.vector)):
            self.best_loss = found  # what does worse on what is held out than the weights before is not taken
        while self.block_index < blocks:
            random = np.random.default_rng([seed, self.phase_index, self.block_index])
            batch = min(phase.batch_size, phase.objective.n_items)
            chosen = np.stack([random.permutation(phase.objective.n_items)[:batch] for _ in range(length)])
            self.vector, self.optimiser_state, losses, slopes = descend(
                self.vector, self.optimiser_state, phase.objective.arrays, chosen
            )
            self.gradient_norm = float(slopes[-1])
            self.block_index += 1
            step, loss, held = before + self.block_index * length, float(jnp.mean(losses)), look(self.vector)
            self.evaluations.append((step, phase.name, loss, held))
            judged = loss if np.isnan(held) and phase.held_out_objective is None else held
            if not np.isfinite(loss):
                raise InputError(
                    f"the loss is {loss} after {step} steps, in the {phase.name}: the runs leave the domain of the "
                    "functions or the steps are too long; try a smaller rate, or more substeps"
                )
            self.evaluations_since_best = (
                0 if judged < IMPROVEMENT_FACTOR * self.best_loss else self.evaluations_since_best + 1
            )
            if judged < self.best_loss:
                self.best_vector, self.best_loss = np.asarray(self.vector), judged
            bar.update(step)
            self._save_checkpoint(checkpoint)
            if patience is not None and self.evaluations_since_best >= patience:
                return f"no better for {patience} looks, after {self.block_index * length} steps"
        return f"after {self.block_index * length} steps"

    def training_record(self, seconds: float) -> Training:
        steps, phases, values, held = zip(*self.evaluations, strict=True) if self.evaluations else ((), (), (), ())
        count = self.weights.size
        arrays = np.array(steps, dtype=int), np.array(phases, dtype=str), np.array(values), np.array(held)
        return Training(*arrays, count, seconds, self.ended, gradient=self.gradient_norm)

    # -- files --------------------------------------------------------------------------------------------------------

    def _save_checkpoint(self, path: Path | None) -> None:
        if path is None:
            return
        said = {
            "format": CHECKPOINT_FORMAT,
            "identity": self.fit_fingerprint,
            "index": self.phase_index,
            "block": self.block_index,
            "since": self.evaluations_since_best,
            "least": self.best_loss,
            "looks": self.evaluations,
            "ended": self.ended,
            "gradient": self.gradient_norm,
        }
        leaves = jax.tree_util.tree_leaves(self.optimiser_state)
        arrays = {"weights": self.weights, "vector": self.vector, "best": self.best_vector}
        write_archive(path, said, arrays | {f"state_{i}": leaf for i, leaf in enumerate(leaves)})

    def resume(self, path: Path) -> None:
        """Go on from a file.

        Raises
        ------
        FileError
            If it is of another fit, or none.
        """
        said, arrays = read_archive(path, CHECKPOINT_FORMAT)
        if said.get("identity") != self.fit_fingerprint:
            raise FileError(
                f"{path} is the checkpoint of a fit of another model, of other data or with other settings: give "
                "another path, or remove it"
            )
        self.phase_index, self.weights = said["index"], arrays["weights"]
        self.evaluations, self.ended = [tuple(look) for look in said["looks"]], said["ended"]
        self.gradient_norm = said.get("gradient", float("nan"))
        if self.phase_index >= len(self.phases):
            self.best_vector = arrays["best"]
            return
        self._start_phase()
        self.block_index, self.evaluations_since_best, self.best_loss = said["block"], said["since"], said["least"]
        if not self.vector.shape == arrays["vector"].shape == arrays["best"].shape:
            raise FileError(f"{path} cannot be gone on from: its numbers are not as many as those of this fit")
        self.vector, self.best_vector = jnp.asarray(arrays["vector"]), arrays["best"]
        first, structure = jax.tree_util.tree_flatten(self.optimiser_state)
        leaves = [jnp.asarray(arrays[f"state_{i}"]) for i in range(len(first))]
        self.optimiser_state = jax.tree_util.tree_unflatten(structure, leaves)


def _make_optimiser(phase: Phase) -> Any:
    """With a rate that falls to a hundredth along a cosine; steps with a gradient that is not finite are left."""
    try:
        import optax
    except ImportError:
        raise InputError("lt.learn.fit needs optax: pip install 'liethermo[learn]'") from None
    schedule = optax.cosine_decay_schedule(phase.rate, phase.steps, alpha=0.01)
    return optax.apply_if_finite(
        soap_optimiser(phase.array_shapes, schedule), max_consecutive_errors=10 * STEPS_PER_EVALUATION
    )


def _compile_programs(phase: Phase, optimiser: Any) -> tuple[Callable, Callable]:
    """A block of steps, and the loss of what is held out."""

    def train_step(carry, chosen):
        vector, state, arrays = carry
        value, slope = jax.value_and_grad(phase.objective.loss)(vector, arrays, chosen)
        updates, state = optimiser.update(slope, state, vector)
        count = slope.size - phase.objective.initial_free.size
        return (vector + updates, state, arrays), (value, jnp.linalg.norm(slope[:count]) / value)

    def train_block(vector, state, arrays, chosen):
        (vector, state, _), (values, slopes) = jax.lax.scan(train_step, (vector, state, arrays), chosen)
        return vector, state, values, slopes

    held = phase.held_out_objective
    descend = jax.jit(train_block, compiler_options=fast_compile_options())
    if held is None:
        return descend, lambda vector: float("nan")
    some = np.linspace(0, held.n_items - 1, min(held.n_items, MAX_VALIDATION_ITEMS)).round().astype(int)
    looking = jax.jit(held.loss, compiler_options=fast_compile_options())
    weights = phase.objective.initial_free.size
    return descend, lambda vector: float(looking(vector[: vector.size - weights], held.arrays, some))


def write_archive(path: Path, said: dict[str, Any], arrays: dict[str, Any]) -> None:
    """A file of arrays and JSON; it appears whole or not at all.

    Raises
    ------
    FileError
    """
    made, held = io.BytesIO(), {name: np.asarray(values) for name, values in arrays.items()}
    text = json.dumps({**said, "checksum": _checksum(said, held)})
    np.savez(made, __json__=np.frombuffer(text.encode(), dtype=np.uint8), **held)  # type: ignore[arg-type]
    try:
        disk.write_atomically(path, made.getvalue())
    except (OSError, ValueError) as error:
        raise FileError(f"cannot write {path!s:.200}: {disk.describe_os_error(error)}") from error


def read_archive(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What :func:`write` wrote.

    Raises
    ------
    FileError
        If there is none, or it is damaged or of another kind.
    """
    try:
        content = path.read_bytes()
        if not content.startswith(b"PK"):
            raise ValueError("it is no archive of arrays")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        said = json.loads(arrays.pop("__json__").tobytes())
        if not isinstance(said, dict) or said.get("format") != kind:
            raise ValueError(f"it is no {kind}")
        if said.pop("checksum", None) != _checksum(said, arrays):
            raise ValueError("its contents are not those that were written")
    except FileNotFoundError:
        raise FileError(f"there is no file {path!s:.200}") from None
    except Exception as error:  # the readers beneath raise a dozen kinds for a broken file
        raise FileError(f"{path!s:.200} cannot be read: it is damaged or of another kind ({error!s:.100})") from error
    return said, arrays


def _checksum(said: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    parts = [
        part for name in sorted(arrays) for part in (name, arrays[name].dtype.str, arrays[name].shape, arrays[name])
    ]
    return fingerprint(json.dumps(said, sort_keys=True), *parts)


def fingerprint(*parts: Any) -> str:
    """SHA-256 of arrays and of what has a text."""
    found = hashlib.sha256()
    for part in parts:
        found.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return found.hexdigest()
