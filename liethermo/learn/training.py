"""Descent on a loss, in blocks of steps after each of which the course is looked at and may be kept in a file."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import disk
from ..errors import FileError, InputError
from ..runs.progress import Progress
from .descent import descent
from .losses import Task
from .quickly import quickly

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
    """

    step: np.ndarray
    phase: np.ndarray
    loss: np.ndarray
    validation: np.ndarray
    parameters: int
    seconds: float
    ended: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        lines = [f"{self.parameters} parameters, {self.seconds:.1f} s"]
        for name, how in self.ended.items():
            of = np.flatnonzero(self.phase == name)
            if len(of):
                last, held = self.loss[of[-1]], self.validation[of[-1]]
                beside = "" if np.isnan(held) else f", held out {held:.2e}"
                lines.append(f"{name}: loss {self.loss[of[0]]:.2e} to {last:.2e}{beside}; {how}")
        return "\n".join(lines)


class Course:
    """A fit under way: all that its next step depends on, so that it can go on from a file."""

    def __init__(self, phases: list[Phase], start: np.ndarray, identity: str):
        self.phases, self.identity = phases, identity
        self.index = self.block = 0
        self.looks: list[tuple[int, str, float, float]] = []
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
            self.vector, self.state, losses = descend(self.vector, self.state, phase.task.arrays, chosen)
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
        return Training(*arrays, count, seconds, self.ended)

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
        if self.index >= len(self.phases):
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
        return (vector + updates, state, arrays), value

    def block(vector, state, arrays, chosen):
        (vector, state, _), values = jax.lax.scan(one, (vector, state, arrays), chosen)
        return vector, state, values

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
