"""Training: descent on a loss in blocks of steps, with an evaluation and a checkpoint after each block."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from manifolds._class_members import ListedType

from .. import disk
from ..errors import FileError, InputError
from ..runs.progress import Progress
from .descent import soap_optimiser
from .losses import Objective, ParameterVector
from .observation import fast_compile_options
from .refining import LeastSquaresResult

STEPS_PER_EVALUATION = 50
"""Number of steps between two evaluations."""

MAX_VALIDATION_ITEMS = 512
"""Largest number of items over which a validation loss is averaged."""

IMPROVEMENT_FACTOR = 0.999
"""Loss, relative to the smallest so far, below which it counts as improved."""

CHECKPOINT_FORMAT = "liethermo-training-1"
"""Name of the file format of checkpoints."""


@dataclass(frozen=True)
class Phase:
    """One phase of a fit: its loss, number of steps, learning rate and batch size."""

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
"""Relative standard error of a parameter above which the data do not determine it."""

MAX_RESIDUAL_TO_NOISE = 1.5
"""Residual, relative to the noise, above which the model does not describe the data."""

NOISE_ESTIMATE_ERROR = 1.5
"""Standard error of an estimate of the noise from n differences, times the root of n, relative to the noise."""


class FitWarning(UserWarning):
    """Warning: a fit has not converged, or the data do not determine its parameters."""


class ConfidenceInterval(NamedTuple):
    """Ends of the confidence intervals of parameters.

    Attributes
    ----------
    low, high : ndarray, shape (p,)
    """

    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Training(metaclass=ListedType):
    """The record of a fit.

    Attributes
    ----------
    step : ndarray of int, shape (evaluations,)
        Number of steps before each evaluation, summed over phases.
    phase : ndarray of str, shape (evaluations,)
        Phase of each evaluation.
    loss : ndarray, shape (evaluations,)
        Mean loss of the steps since the last evaluation. Mean squares: in the matching relative to the speed of the
        state, in the shooting relative to the spread of the data or the noise.
    validation : ndarray, shape (evaluations,)
        The loss of the held-out data, NaN if there are none.
    parameters : int
        Number of learned parameters.
    seconds : float
        Duration of the call, including compilation.
    ended : dict of str
        The reason why each phase ended, in words.
    names : tuple of str
        Name of each learned parameter in the system, if the fit was refined by least squares; otherwise empty. The
        following entries describe these parameters in order; without a refinement arrays are empty and numbers NaN.
    values, standard_errors : ndarray, shape (p,)
        The learned parameters, and their standard errors: infinite for a parameter that the data do not determine.
    covariance : ndarray, shape (p, p)
        Covariance of their errors.
    rank : int
        Number of combinations of the learned parameters that the data determine; p if they determine all.
    condition : float
        Condition number of the Jacobian with unit columns: large if some combination is hardly determined.
    residual : float
        Root mean square of the residuals of the runs, by degrees of freedom, relative to the noise: 1 if the model
        describes the data. If the noise is not known, relative to the spread of the data.
    held_out : float
        Root mean square of the residuals of held-out trajectories, of which only the initial states are fitted.
    gradient : float
        Norm of the derivative of ln(loss) by the learned parameters, or their logarithms if they stay positive: at the
        end of the least squares, or for the last batch.
    converged : bool or None
        True if the Newton step of the least squares is below a hundredth of a standard error; None without a
        refinement.
    noise : ndarray, shape (k,)
        Standard deviations of the errors of the data, given or estimated; empty if the data count as exact.
    noise_is_estimated : bool
        True if the noise was estimated from the residuals.
    degrees_of_freedom : int
        Number of observations minus the number of determined unknowns of the least squares.
    initial_states : ndarray, shape (trajectories, n)
        Fitted states at the first times of the trajectories that are not held out, in order.
    is_positive : tuple of bool, of length p
        True for parameters that the fit keeps positive.
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
    degrees_of_freedom: int = 0
    initial_states: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    is_positive: tuple[bool, ...] = ()

    def with_estimates(
        self,
        params: ParameterVector,
        least_squares_result: LeastSquaresResult | None,
        noise,
        noise_is_estimated: bool,
        shape: tuple[int, int],
    ) -> Training:
        """Return the record with the results of a least-squares refinement and the noise added.

        Parameters
        ----------
        shape : (int, int)
            Number of trajectories that are not held out, which come first, and of components of a state.
        """
        sigma = np.zeros(0) if noise is None else np.asarray(noise)
        record = replace(self, noise=sigma, noise_is_estimated=noise_is_estimated)
        if least_squares_result is None:
            return record
        values = np.where(params.is_log, np.exp(least_squares_result.weights), least_squares_result.weights)
        scale = np.where(params.is_log, values, 1.0)
        with np.errstate(invalid="ignore"):
            covariance = least_squares_result.covariance * np.outer(scale, scale)
        covariance = np.where(np.isfinite(covariance), covariance, np.inf)
        return replace(
            record,
            names=params.names,
            values=values,
            standard_errors=np.sqrt(np.diag(covariance)),
            covariance=covariance,
            rank=least_squares_result.rank,
            condition=least_squares_result.condition,
            residual=least_squares_result.residual,
            held_out=least_squares_result.held_out_residual,
            gradient=least_squares_result.gradient_norm,
            converged=least_squares_result.converged,
            degrees_of_freedom=least_squares_result.degrees_of_freedom,
            initial_states=np.asarray(least_squares_result.states)[: shape[0], 0, : shape[1]],
            is_positive=tuple(map(bool, params.is_log)),
            ended=self.ended | {LEAST_SQUARES: f"after {least_squares_result.iterations} iterations"},
        )

    def confidence_interval(self, confidence_level: float = 0.95) -> ConfidenceInterval:
        """Return the confidence interval of each fitted parameter.

        They come from Student's distribution for the estimates, or for their logarithms if parameters stay positive. An
        interval is infinite for a parameter that the data do not determine.

        Parameters
        ----------
        confidence_level : float, between 0 and 1

        Raises
        ------
        InputError
            If the level is out of range, or the fit has no standard errors.
        """
        if not 0.0 < confidence_level < 1.0:
            raise InputError(f"confidence_level must be between 0 and 1, got {confidence_level!r}")
        self._check_has_estimates()
        quantile = scipy.stats.t.ppf(0.5 + 0.5 * confidence_level, max(self.degrees_of_freedom, 1))
        half_width = quantile * self.standard_errors
        is_positive = np.array(self.is_positive or [False] * len(self.names))
        safe_values = np.where(is_positive, self.values, 1.0)
        with np.errstate(over="ignore"):
            ratio = np.exp(np.where(is_positive, half_width, 0.0) / safe_values)
        return ConfidenceInterval(
            np.where(is_positive, safe_values / ratio, self.values - half_width),
            np.where(is_positive, safe_values * ratio, self.values + half_width),
        )

    def estimate(self, quantity: Callable[[jax.Array], Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return the value of a function of the fitted parameters, and its standard error by linear error propagation.

        Parameters
        ----------
        quantity : function from the parameters, shape (p,), in the order of ``names``, to an array
            Such as ``lambda v: v[0] / v[2]``, written with jax.numpy.

        Raises
        ------
        InputError
            If the fit has no standard errors.
        """
        self._check_has_estimates()
        values = jnp.asarray(self.values)
        jacobian = np.asarray(jax.jacfwd(lambda v: jnp.asarray(quantity(v)))(values))
        is_known = np.isfinite(self.standard_errors)
        covariance = np.where(np.outer(is_known, is_known), self.covariance, 0.0)
        variance = np.einsum("...i,ij,...j->...", jacobian, covariance, jacobian)
        needs_unknown = (jacobian[..., ~is_known] != 0.0).any(axis=-1)
        return np.asarray(quantity(values)), np.where(needs_unknown, np.inf, np.sqrt(np.maximum(variance, 0.0)))

    def _check_has_estimates(self) -> None:
        """Raise InputError if the fit has no standard errors."""
        if not len(self.names):
            raise InputError(
                "the fit has no standard errors: it has networks, more than 64 parameters, or shooting=0. Fit few "
                "numbers with parameters="
            )

    @property
    def problems(self) -> list[str]:
        """Problems of the fit, one sentence each; empty if none is known."""
        messages = []
        if self.converged is False:
            messages.append(
                "the fit has not converged: its least squares could not be made smaller, or are not finite. Begin "
                "with other initial values, or give more iterations, as shooting=2000. If a positive parameter "
                "tends to 0, leave it out of the fit"
            )
        undetermined_parameters = [
            f"{name} = {value:.3g} ± {error:.2g}"
            for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True)
            if np.isinf(error) or (value > 0.0 and error > MAX_RELATIVE_STANDARD_ERROR * value)
        ]
        if undetermined_parameters:
            messages.append(
                f"the data do not determine {', '.join(undetermined_parameters)}. Give more data, or leave "
                "known numbers out of the fit"
            )
        max_residual = MAX_RESIDUAL_TO_NOISE
        if self.noise.size and self.noise_is_estimated:  # two standard errors above the noise that was estimated
            n_differences = max(self.degrees_of_freedom / self.noise.size, 1.0)
            max_residual *= 1.0 + 2.0 * NOISE_ESTIMATE_ERROR / np.sqrt(n_differences)
        if self.noise.size and self.residual > max_residual:
            messages.append(
                f"the residuals of the runs are {self.residual:.2g} times the noise: the model cannot describe the "
                "data, its steps are too long (substeps=), or the noise is larger (noise=)"
            )
        return messages

    def __str__(self) -> str:
        plural = "" if self.parameters == 1 else "s"
        lines = [f"{self.parameters} parameter{plural}, {self.seconds:.1f} s"]
        for name, ending in self.ended.items():
            indices = np.flatnonzero(self.phase == name)
            if len(indices):
                last_loss, held_out_loss = self.loss[indices[-1]], self.validation[indices[-1]]
                held_out_text = "" if np.isnan(held_out_loss) else f", held out {held_out_loss:.2e}"
                lines.append(
                    f"{name}: loss {self.loss[indices[0]]:.2e} to {last_loss:.2e}{held_out_text}; {ending}"
                    f"{self._late_loss_decrease_text(indices)}"
                )
        if self.noise.size:
            min_noise, max_noise = float(self.noise.min()), float(self.noise.max())
            noise_text = f"{min_noise:.2g}" if min_noise == max_noise else f"{min_noise:.2g} to {max_noise:.2g}"
            lines.append(f"noise of the data: {noise_text}, {'estimated' if self.noise_is_estimated else 'given'}")
        if self.converged is None:
            if np.isfinite(self.gradient):
                lines.append(f"norm of the gradient of ln(loss) of the last batch: {self.gradient:.1e}")
            return "\n".join(lines)
        verdict = "converged" if self.converged else "NOT converged"
        lines.append(
            f"{LEAST_SQUARES}: {verdict} {self.ended[LEAST_SQUARES]}; norm of the gradient of ln(loss) "
            f"{self.gradient:.1e}"
        )
        unit_text = "the noise" if self.noise.size else "the spread of the data"
        held_out_text = "" if np.isnan(self.held_out) else f", held out {self.held_out:.3g}"
        lines.append(f"residuals: {self.residual:.3g} of {unit_text}{held_out_text}")
        lines.append(
            f"the data determine {self.rank} of {self.parameters} numbers; condition of the Jacobian "
            f"{self.condition:.1e}"
        )
        lines += [
            f"  {name} = {value:.6g} ± {error:.1g}"
            for name, value, error in zip(self.names, self.values, self.standard_errors, strict=True)
        ]
        return "\n".join([*lines, *(f"CAUTION: {problem}" for problem in self.problems)])

    def _late_loss_decrease_text(self, indices: np.ndarray) -> str:
        """Return a clause with the decrease of the loss over the last fifth of a phase, or "" for few evaluations."""
        if len(indices) < 10:
            return ""
        earlier_loss, last_loss = self.loss[indices[-1 - len(indices) // 5]], self.loss[indices[-1]]
        return (
            f", in the last fifth of which the loss fell by {max(1.0 - last_loss / earlier_loss, 0.0):.1%}"
            if earlier_loss > 0.0
            else ""
        )


def training_without_descent(n_parameters: int, seconds: float) -> Training:
    """Return an empty record, for a fit by least squares alone."""
    empty_array = np.zeros(0)
    return Training(np.zeros(0, int), np.zeros(0, str), empty_array, empty_array, n_parameters, seconds)


class TrainingRun:
    """State of a running fit: everything that determines the next step, so that the fit can resume from a file."""

    def __init__(self, phases: list[Phase], initial_weights: np.ndarray, fit_fingerprint: str):
        self.phases, self.fit_fingerprint = phases, fit_fingerprint
        self.phase_index = self.block_index = 0
        self.evaluations: list[tuple[int, str, float, float]] = []
        self.gradient_norm = float("nan")
        self.ended: dict[str, str] = {}
        self.weights = np.asarray(initial_weights)
        self._start_phase()

    def _start_phase(self) -> None:
        """Initialise the current phase from the best weights so far."""
        phase = self.phases[self.phase_index]
        self.block_index, self.evaluations_since_best = 0, 0
        self.vector = jnp.concatenate([jnp.asarray(self.weights), jnp.asarray(phase.objective.initial_free)])
        self.optimiser = _make_optimiser(phase)
        self.optimiser_state = self.optimiser.init(self.vector)
        self.best_vector, self.best_loss = np.asarray(self.vector), np.inf

    def run(self, seed: int, patience: int | None, checkpoint: Path | None, progress: bool | None) -> None:
        """Run all remaining phases, each to its number of steps or until ``patience`` ends it.

        Raises
        ------
        InputError
            If the loss is not finite.
        """
        n_steps = sum(phase.steps for phase in self.phases)
        with Progress((0, n_steps), progress, "step {:.0f}") as progress_bar:
            while self.phase_index < len(self.phases):
                phase = self.phases[self.phase_index]
                try:
                    ending = self._run_phase(phase, seed, patience, checkpoint, progress_bar)
                except KeyboardInterrupt:
                    self.ended[phase.name] = "interrupted"
                    self.weights = self.best_vector[: len(self.weights)]
                    return
                self.ended[phase.name] = ending
                self.weights = self.best_vector[: len(self.weights)]
                self.phase_index += 1
                if self.phase_index < len(self.phases):
                    self._start_phase()
                self._save_checkpoint(checkpoint)

    def _run_phase(
        self, phase: Phase, seed: int, patience: int | None, checkpoint: Path | None, progress_bar: Progress
    ) -> str:
        """Run one phase, with an evaluation and a checkpoint after each block of steps; return why it ended.

        Raises
        ------
        InputError
            If the loss is not finite.
        """
        steps_per_block = min(STEPS_PER_EVALUATION, phase.steps)
        n_blocks = -(-phase.steps // steps_per_block)
        descend, evaluate_held_out = _compile_descent_and_evaluation(phase, self.optimiser)
        previous_steps = sum(p.steps for p in self.phases[: self.phase_index])
        if (
            self.block_index == 0
            and phase.held_out_objective is not None
            and np.isfinite(held_out_loss := evaluate_held_out(self.vector))
        ):
            self.best_loss = held_out_loss  # weights that do worse on held-out data than the initial ones are not kept
        while self.block_index < n_blocks:
            rng = np.random.default_rng([seed, self.phase_index, self.block_index])
            batch = min(phase.batch_size, phase.objective.n_items)
            batches = np.stack([rng.permutation(phase.objective.n_items)[:batch] for _ in range(steps_per_block)])
            self.vector, self.optimiser_state, losses, gradient_norms = descend(
                self.vector, self.optimiser_state, phase.objective.arrays, batches
            )
            self.gradient_norm = float(gradient_norms[-1])
            self.block_index += 1
            step, loss, new_held_out_loss = (
                previous_steps + self.block_index * steps_per_block,
                float(jnp.mean(losses)),
                evaluate_held_out(self.vector),
            )
            self.evaluations.append((step, phase.name, loss, new_held_out_loss))
            compared_loss = (
                loss if np.isnan(new_held_out_loss) and phase.held_out_objective is None else new_held_out_loss
            )
            if not np.isfinite(loss):
                raise InputError(
                    f"the loss is {loss} after {step} steps, in the {phase.name}: the runs leave the domain of the "
                    "functions or the steps are too long. Try a smaller rate, or more substeps"
                )
            self.evaluations_since_best = (
                0 if compared_loss < IMPROVEMENT_FACTOR * self.best_loss else self.evaluations_since_best + 1
            )
            if compared_loss < self.best_loss:
                self.best_vector, self.best_loss = np.asarray(self.vector), compared_loss
            progress_bar.update(step)
            self._save_checkpoint(checkpoint)
            if patience is not None and self.evaluations_since_best >= patience:
                return f"no better for {patience} looks, after {self.block_index * steps_per_block} steps"
        return f"after {self.block_index * steps_per_block} steps"

    def training_record(self, seconds: float) -> Training:
        """Return the record of the evaluations so far, for a fit that took some seconds."""
        steps, phases, losses, held_out_losses = (
            zip(*self.evaluations, strict=True) if self.evaluations else ((), (), (), ())
        )
        n_weights = self.weights.size
        arrays = np.array(steps, dtype=int), np.array(phases, dtype=str), np.array(losses), np.array(held_out_losses)
        return Training(*arrays, n_weights, seconds, self.ended, gradient=self.gradient_norm)

    # -- files --------------------------------------------------------------------------------------------------------

    def _save_checkpoint(self, path: Path | None) -> None:
        """Save the state of the fit to a file, unless the path is None."""
        if path is None:
            return
        metadata = {
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
        write_archive(path, metadata, arrays | {f"state_{i}": leaf for i, leaf in enumerate(leaves)})

    def restore_checkpoint(self, path: Path) -> None:
        """Restore the state of the fit from a checkpoint file, without training.

        Raises
        ------
        FileError
            If the file is not a checkpoint, or of another fit.
        """
        metadata, arrays = read_archive(path, CHECKPOINT_FORMAT)
        if metadata.get("identity") != self.fit_fingerprint:
            raise FileError(
                f"{path} is the checkpoint of a fit of another model, of other data or with other settings. Give "
                "another path, or remove it"
            )
        self.phase_index, self.weights = metadata["index"], arrays["weights"]
        self.evaluations, self.ended = [tuple(evaluation) for evaluation in metadata["looks"]], metadata["ended"]
        self.gradient_norm = metadata.get("gradient", float("nan"))
        if self.phase_index >= len(self.phases):
            self.best_vector = arrays["best"]
            return
        self._start_phase()
        self.block_index, self.evaluations_since_best, self.best_loss = (
            metadata["block"],
            metadata["since"],
            metadata["least"],
        )
        if not self.vector.shape == arrays["vector"].shape == arrays["best"].shape:
            raise FileError(f"{path} cannot be resumed: its arrays have other shapes than those of this fit")
        self.vector, self.best_vector = jnp.asarray(arrays["vector"]), arrays["best"]
        initial_leaves, structure = jax.tree_util.tree_flatten(self.optimiser_state)
        leaves = [jnp.asarray(arrays[f"state_{i}"]) for i in range(len(initial_leaves))]
        self.optimiser_state = jax.tree_util.tree_unflatten(structure, leaves)


def _make_optimiser(phase: Phase) -> Any:
    """Return the optimiser of a phase: SOAP with a cosine schedule; it skips steps whose gradient is not finite."""
    try:
        import optax
    except ImportError:
        raise InputError("lt.learn.fit needs optax, which is not installed: pip install optax") from None
    schedule = optax.cosine_decay_schedule(phase.rate, phase.steps, alpha=0.01)
    return optax.apply_if_finite(
        soap_optimiser(phase.array_shapes, schedule), max_consecutive_errors=10 * STEPS_PER_EVALUATION
    )


def _compile_descent_and_evaluation(phase: Phase, optimiser: Any) -> tuple[Callable, Callable]:
    """Return two compiled functions: one takes a block of optimiser steps, one evaluates the held-out loss."""

    def train_step(carry, indices):
        vector, state, arrays = carry
        value, gradient = jax.value_and_grad(phase.objective.loss)(vector, arrays, indices)
        updates, state = optimiser.update(gradient, state, vector)
        count = gradient.size - phase.objective.initial_free.size
        return (vector + updates, state, arrays), (value, jnp.linalg.norm(gradient[:count]) / value)

    def train_block(vector, state, arrays, batches):
        (vector, state, _), (values, gradient_norms) = jax.lax.scan(train_step, (vector, state, arrays), batches)
        return vector, state, values, gradient_norms

    held_out_objective = phase.held_out_objective
    descend = jax.jit(train_block, compiler_options=fast_compile_options())
    if held_out_objective is None:
        return descend, lambda vector: float("nan")
    item_indices = (
        np.linspace(0, held_out_objective.n_items - 1, min(held_out_objective.n_items, MAX_VALIDATION_ITEMS))
        .round()
        .astype(int)
    )
    held_out_loss = jax.jit(held_out_objective.loss, compiler_options=fast_compile_options())
    n_free = phase.objective.initial_free.size
    return descend, lambda vector: float(
        held_out_loss(vector[: vector.size - n_free], held_out_objective.arrays, item_indices)
    )


def write_archive(path: Path, metadata: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write arrays and JSON metadata to an NPZ file atomically.

    Raises
    ------
    FileError
    """
    buffer, saved_arrays = io.BytesIO(), {name: np.asarray(values) for name, values in arrays.items()}
    text = json.dumps({**metadata, "checksum": _checksum(metadata, saved_arrays)})
    np.savez(buffer, __json__=np.frombuffer(text.encode(), dtype=np.uint8), **saved_arrays)  # type: ignore[arg-type]
    with disk.file_errors("write", path):
        disk.write_atomically(path, buffer.getvalue())


def read_archive(path: Path, file_format: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the JSON metadata and the arrays of an NPZ file that :func:`write_archive` wrote.

    Raises
    ------
    FileError
        If there is no file, or it is damaged or of another format.
    """
    try:
        content = path.read_bytes()
        if not content.startswith(b"PK"):
            raise ValueError("it is not an archive of arrays")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        metadata = json.loads(arrays.pop("__json__").tobytes())
        if not isinstance(metadata, dict) or metadata.get("format") != file_format:
            raise ValueError(f"it is not a {file_format}")
        if metadata.pop("checksum", None) != _checksum(metadata, arrays):
            raise ValueError("its contents are not those that were written")
    except FileNotFoundError:
        raise FileError(f"there is no file {path!s:.200}") from None
    except Exception as error:  # readers of archives raise many kinds of errors for a broken file
        raise FileError(f"{path!s:.200} cannot be read: it is damaged or of another kind ({error!s:.100})") from error
    return metadata, arrays


def _checksum(metadata: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    values = [
        value for name in sorted(arrays) for value in (name, arrays[name].dtype.str, arrays[name].shape, arrays[name])
    ]
    return fingerprint(json.dumps(metadata, sort_keys=True), *values)


def fingerprint(*values: Any) -> str:
    """Return the SHA-256 of arrays and of the texts of other objects, as hexadecimal."""
    digest = hashlib.sha256()
    for value in values:
        digest.update(np.ascontiguousarray(value).tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()
