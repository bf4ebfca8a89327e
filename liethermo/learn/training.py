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
from .descent import descent
from .losses import Task, Weights
from .quickly import quickly
from .refining import Refined

BLOCK = 50
"""Steps between two looks at the course."""

LOOKED_AT = 512
"""Items at most that a validation loss is the mean over."""

BETTER = 0.999
"""What the loss has to fall below, relative to the least so far, to count as better."""

FORMAT = "liethermo-training-1"


@dataclass(frozen=True)
class Phase:
    """A part of a fit: a loss, and how long and how fast it is descended."""

    name: str
    task: Task
    held_out: Task | None
    steps: int
    rate: float
    batch: int
    shapes: tuple[tuple[int, ...], ...]


LEAST_SQUARES = "least squares"
"""Name of the refinement in the record of a fit."""

VAGUE = 0.5
"""Standard error of a number, relative to it, above which the data do not determine it."""

MISFIT = 1.5
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

    def with_findings(self, own: Weights, refined: Refined | None, noise, noise_is_estimated: bool) -> Training:
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
            held_out=refined.held_out,
            gradient=refined.gradient,
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
            if np.isinf(error) or (value > 0.0 and error > VAGUE * value)
        ]
        if vague:
            found.append(
                f"the data do not determine {', '.join(vague)}: give more data, or leave known numbers out of the fit"
            )
        if self.noise.size and self.residual > MISFIT:
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
                lines.append(f"{name}: loss {self.loss[of[0]]:.2e} to {last:.2e}{beside}; {how}{self._fall(of)}")
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

    def _fall(self, of: np.ndarray) -> str:
        """By how much the loss fell in the last fifth of the looks at a phase, in words."""
        if len(of) < 10:
            return ""
        before, last = self.loss[of[-1 - len(of) // 5]], self.loss[of[-1]]
        return (
            f", in the last fifth of which the loss fell by {max(1.0 - last / before, 0.0):.1%}" if before > 0.0 else ""
        )


class Course:
    """A fit under way: all that its next step depends on, so that it can go on from a file."""

    def __init__(self, phases: list[Phase], start: np.ndarray, identity: str):
        self.phases, self.identity = phases, identity
        self.index = self.block = 0
        self.looks: list[tuple[int, str, float, float]] = []
        self.gradient = float("nan")
        self.ended: dict[str, str] = {}
        self.weights = np.asarray(start)
        self._enter()

    def _enter(self) -> None:
        """Begin the phase that is next, with the best weights so far."""
        phase = self.phases[self.index]
        self.block, self.since = 0, 0
        self.vector = jnp.concatenate([jnp.asarray(self.weights), jnp.asarray(phase.task.free)])
        self.optimiser = _optimiser(phase)
        self.state = self.optimiser.init(self.vector)
        self.best, self.least = np.asarray(self.vector), np.inf

    def run(self, seed: int, patience: int | None, checkpoint: Path | None, progress: bool | None) -> None:
        """Take all steps, or as many as it takes, or as time is given.

        Raises
        ------
        InputError
            If the loss is not finite.
        """
        total = sum(phase.steps for phase in self.phases)
        with Progress((0, total), progress, "step {:.0f}") as bar:
            while self.index < len(self.phases):
                phase = self.phases[self.index]
                try:
                    how = self._phase(phase, seed, patience, checkpoint, bar)
                except KeyboardInterrupt:
                    self.ended[phase.name] = "interrupted"
                    self.weights = self.best[: len(self.weights)]
                    return
                self.ended[phase.name] = how
                self.weights = self.best[: len(self.weights)]
                self.index += 1
                if self.index < len(self.phases):
                    self._enter()
                self._save(checkpoint)

    def _phase(self, phase: Phase, seed: int, patience: int | None, checkpoint: Path | None, bar: Progress) -> str:
        length = min(BLOCK, phase.steps)
        blocks = -(-phase.steps // length)
        descend, look = _programs(phase, self.optimiser)
        before = sum(p.steps for p in self.phases[: self.index])
        if self.block == 0 and phase.held_out is not None and np.isfinite(found := look(self.vector)):
            self.least = found  # what does worse on what is held out than the weights before is not taken
        while self.block < blocks:
            random = np.random.default_rng([seed, self.index, self.block])
            batch = min(phase.batch, phase.task.items)
            chosen = np.stack([random.permutation(phase.task.items)[:batch] for _ in range(length)])
            self.vector, self.state, losses, slopes = descend(self.vector, self.state, phase.task.arrays, chosen)
            self.gradient = float(slopes[-1])
            self.block += 1
            step, loss, held = before + self.block * length, float(jnp.mean(losses)), look(self.vector)
            self.looks.append((step, phase.name, loss, held))
            judged = loss if np.isnan(held) and phase.held_out is None else held
            if not np.isfinite(loss):
                raise InputError(
                    f"the loss is {loss} after {step} steps, in the {phase.name}: the runs leave the domain of the "
                    "functions or the steps are too long; try a smaller rate, or more substeps"
                )
            self.since = 0 if judged < BETTER * self.least else self.since + 1
            if judged < self.least:
                self.best, self.least = np.asarray(self.vector), judged
            bar.update(step)
            self._save(checkpoint)
            if patience is not None and self.since >= patience:
                return f"no better for {patience} looks, after {self.block * length} steps"
        return f"after {self.block * length} steps"

    def record(self, seconds: float) -> Training:
        steps, phases, values, held = zip(*self.looks, strict=True) if self.looks else ((), (), (), ())
        count = self.weights.size
        arrays = np.array(steps, dtype=int), np.array(phases, dtype=str), np.array(values), np.array(held)
        return Training(*arrays, count, seconds, self.ended, gradient=self.gradient)

    # -- files --------------------------------------------------------------------------------------------------------

    def _save(self, path: Path | None) -> None:
        if path is None:
            return
        said = {
            "format": FORMAT,
            "identity": self.identity,
            "index": self.index,
            "block": self.block,
            "since": self.since,
            "least": self.least,
            "looks": self.looks,
            "ended": self.ended,
            "gradient": self.gradient,
        }
        leaves = jax.tree_util.tree_leaves(self.state)
        arrays = {"weights": self.weights, "vector": self.vector, "best": self.best}
        write(path, said, arrays | {f"state_{i}": leaf for i, leaf in enumerate(leaves)})

    def resume(self, path: Path) -> None:
        """Go on from a file.

        Raises
        ------
        FileError
            If it is of another fit, or none.
        """
        said, arrays = read(path, FORMAT)
        if said.get("identity") != self.identity:
            raise FileError(
                f"{path} is the checkpoint of a fit of another model, of other data or with other settings: give "
                "another path, or remove it"
            )
        self.index, self.weights = said["index"], arrays["weights"]
        self.looks, self.ended = [tuple(look) for look in said["looks"]], said["ended"]
        self.gradient = said.get("gradient", float("nan"))
        if self.index >= len(self.phases):
            self.best = arrays["best"]
            return
        self._enter()
        self.block, self.since, self.least = said["block"], said["since"], said["least"]
        if not self.vector.shape == arrays["vector"].shape == arrays["best"].shape:
            raise FileError(f"{path} cannot be gone on from: its numbers are not as many as those of this fit")
        self.vector, self.best = jnp.asarray(arrays["vector"]), arrays["best"]
        first, structure = jax.tree_util.tree_flatten(self.state)
        leaves = [jnp.asarray(arrays[f"state_{i}"]) for i in range(len(first))]
        self.state = jax.tree_util.tree_unflatten(structure, leaves)


def _optimiser(phase: Phase) -> Any:
    """With a rate that falls to a hundredth along a cosine; steps with a gradient that is not finite are left."""
    try:
        import optax
    except ImportError:
        raise InputError("lt.learn.fit needs optax: pip install 'liethermo[learn]'") from None
    schedule = optax.cosine_decay_schedule(phase.rate, phase.steps, alpha=0.01)
    return optax.apply_if_finite(descent(phase.shapes, schedule), max_consecutive_errors=10 * BLOCK)


def _programs(phase: Phase, optimiser: Any) -> tuple[Callable, Callable]:
    """A block of steps, and the loss of what is held out."""

    def one(carry, chosen):
        vector, state, arrays = carry
        value, slope = jax.value_and_grad(phase.task.loss)(vector, arrays, chosen)
        updates, state = optimiser.update(slope, state, vector)
        count = slope.size - phase.task.free.size
        return (vector + updates, state, arrays), (value, jnp.linalg.norm(slope[:count]) / value)

    def block(vector, state, arrays, chosen):
        (vector, state, _), (values, slopes) = jax.lax.scan(one, (vector, state, arrays), chosen)
        return vector, state, values, slopes

    held = phase.held_out
    descend = jax.jit(block, compiler_options=quickly())
    if held is None:
        return descend, lambda vector: float("nan")
    some = np.linspace(0, held.items - 1, min(held.items, LOOKED_AT)).round().astype(int)
    looking = jax.jit(held.loss, compiler_options=quickly())
    weights = phase.task.free.size
    return descend, lambda vector: float(looking(vector[: vector.size - weights], held.arrays, some))


def write(path: Path, said: dict[str, Any], arrays: dict[str, Any]) -> None:
    """A file of arrays and JSON; it appears whole or not at all.

    Raises
    ------
    FileError
    """
    made, held = io.BytesIO(), {name: np.asarray(values) for name, values in arrays.items()}
    text = json.dumps({**said, "checksum": _checksum(said, held)})
    np.savez(made, __json__=np.frombuffer(text.encode(), dtype=np.uint8), **held)  # type: ignore[arg-type]
    try:
        disk.write(path, made.getvalue())
    except (OSError, ValueError) as error:
        raise FileError(f"cannot write {path!s:.200}: {disk.why(error)}") from error


def read(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
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
