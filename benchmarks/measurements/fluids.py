"""Fluids on the sphere as su(N): against the isospectral midpoint, and with a magnetic field and its invariants."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

import liethermo as lt

from .. import child as process
from ..isospectral import IsospectralMidpoint
from ..report import Report, Table, Target
from ..timing import race

VORTICITY_DEGREES = (2, 12)
"""Degrees of the initial vorticity."""

TURN_PER_STEP = 0.05
"""Angle in radians by which the fastest part of the fluid turns in a step."""

DECAY_RATE = 1e-3
"""Rate of the selective decay."""

LONG_RUN_STEPS = 10_000
"""Number of steps over which the invariants of the magnetic fluid are measured."""

MAGNETIC_RATE = 1e-4
"""Friction rate of the magnetic fluid."""

METHOD = lt.MetriplecticRungeKutta(4)
"""Method of the library."""


def run(is_quick: bool) -> Report:
    """Time steps of the library and of the isospectral midpoint on matrices of growing size."""
    sizes = (16, 20) if is_quick else (32, 64, 128, 256, 512)
    rows, targets = [], []
    for N in sizes:
        steps, rounds = (2, 1) if is_quick else (max(4, 10_240 // N), 1 if N > 256 else 3)
        new_rows, ratio = process.run_in_child_process(
            "fluids", "plain", str(N), str(steps), str(rounds), one_core=True
        )
        rows += new_rows
        if not is_quick and N in (128, 256):
            targets.append(
                Target(f"su({N}), one step with exact laws, against the isospectral step without", 1.0, ratio)
            )
    columns = {
        "N": "count",
        "": "text",
        "Time a step": "seconds",
        "Relative": "ratio",
        "Energy": "error",
        **{f"tr W^{k}": "error" for k in (2, 3, 4)},
        "Iterations": "number",
    }
    caption = (
        f"Steps in which the fluid turns by {TURN_PER_STEP} radians; relative changes of the energy and of the "
        "Casimirs in all "
        "of them. Both run in a process of one core, and the time is that of the processor. Without decay the Casimirs "
        "are to stay; with it the enstrophy, tr W^2, falls and never rises."
    )
    text = (
        "Zeitlin's fluid from a random field of degrees 2 to 12. *Isospectral midpoint* is the published algorithm in "
        "NumPy and machine code, without dissipation. The library takes steps of `MetriplecticRungeKutta(4)` with "
        "selective decay, the energy exact and the entropy never falling."
    )
    magnetic, magnetic_targets = magnetic_tables(is_quick)
    tables = [Table(caption, columns, rows), *magnetic]
    return Report("Large matrix algebras: a fluid on the sphere", text, tables, targets + magnetic_targets, {})


def magnetic_tables(is_quick: bool) -> tuple[list[Table], list[Target]]:
    """Return tables and targets: steps with and without a magnetic field, and the invariants in many steps."""
    sizes = (12,) if is_quick else (64, 128, 256)
    steps, rounds, long_steps = (4, 1, 20) if is_quick else (40, 3, LONG_RUN_STEPS)
    rows, targets = [], []
    for N in sizes:
        results = process.run_in_child_process("fluids", "beside", str(N), str(steps), str(rounds), one_core=True)
        rows.append([N, *results, results[1] / results[0]])
        targets.append(Target(f"a step with a magnetic field beside one without, su({N})", 2.5, rows[-1][-1]))
    step_table = Table(
        "A step without decay of `zeitlin` and of `magnetic_fluid` at the same N, by the same method, each so long "
        f"that its fastest part turns by {TURN_PER_STEP} radians.",
        {"N": "count", "Without": "seconds", "With": "seconds", "Ratio": "ratio"},
        rows,
    )
    invariant_rows, runs = [], [(12, 0.0)] if is_quick else [(64, 0.0), (64, MAGNETIC_RATE), (128, 0.0), (256, 0.0)]
    for N, rate in runs:
        results = process.run_in_child_process("fluids", "kept", str(N), str(long_steps), str(rate))
        invariant_rows.append([N, "ideal" if rate == 0.0 else "with friction", *results])
        if rate == 0.0:
            work = f"{long_steps:,} steps of a magnetic fluid, su({N}): energy, cross helicity and tr B^3"
            targets.append(Target(work, 1e-12, max(results[1], *results[3:6]), "error"))
    names = ("Energy, largest change", "Energy, last by first", "tr W B", "tr B^2", "tr B^3", "tr B^4", "tr W B^2")
    columns = {"N": "count", "": "text", "Time of the run": "seconds"}
    caption = (
        f"{long_steps:,} steps, each so long that the fastest wave turns by {TURN_PER_STEP} radians; the largest "
        "relative changes "
        "along the run. Cross helicity and traces are computed from the matrices of the states, apart from the "
        "library's own. Friction is to lower the energy alone. The trace of the fourth power is not followed by the "
        "steps, so it is kept to their order."
    )
    kinds = ("error", "number", *["error"] * 5)
    return [step_table, Table(caption, columns | dict(zip(names, kinds, strict=True)), invariant_rows)], targets


def child(part: str, *numbers: str):
    """Run one part of the measurement in the child process."""
    functions: dict[str, Callable] = {
        "plain": race_isospectral,
        "beside": time_with_and_without_field,
        "kept": invariant_changes,
    }
    return functions[part](*numbers)


def max_turning_rate(q: lt.models.QuantisedSphere, mu) -> float:
    """Return the largest angular rate of the flow whose stream function is the state."""
    return float(q.gamma * np.ptp(np.linalg.eigvalsh(1j * np.asarray(q.matrix(mu)))))


def magnetic_initial_state(N: int) -> tuple:
    """Return the sphere, a flow, a flow with a field, and the step sizes of both."""
    q, degrees = lt.models.QuantisedSphere(N), (min(VORTICITY_DEGREES[0], N - 1), min(VORTICITY_DEGREES[1], N - 1))
    W, B = q.random(0, degrees, 4.0), q.random(1, degrees, 1.0)
    turn = max_turning_rate(q, q.inverse_laplacian(W))
    return q, W, q.magnetic_state(W, B), TURN_PER_STEP / turn, TURN_PER_STEP / max(turn, max_turning_rate(q, B))


def time_with_and_without_field(*numbers: str) -> list[float]:
    """Return the seconds of a step without and with a magnetic field, excluding those of the call."""
    N, steps, rounds = map(int, numbers)
    _, W, x, flow_step, magnetic_step = magnetic_initial_state(N)
    works = {
        (name, count): functools.partial(
            lt.integrate, system, start, (0.0, count * h), h, METHOD, save_every=count, engine="array"
        )
        for name, system, start, h in (
            ("without", lt.models.zeitlin(N), W, flow_step),
            ("with", lt.models.magnetic_fluid(N), x, magnetic_step),
        )
        for count in (2, 2 + steps)
    }
    outcomes = race(works, rounds=rounds)
    return [(outcomes[n, 2 + steps].cpu_seconds - outcomes[n, 2].cpu_seconds) / steps for n in ("without", "with")]


def invariant_changes(N: str, steps: str, rate: str) -> list[float]:
    """Return the seconds of a run, and the largest relative changes of the magnetic fluid's invariants."""
    q, _, x, _, h = magnetic_initial_state(int(N))
    system, count = lt.models.magnetic_fluid(int(N), float(rate)), int(steps)
    run = lt.integrate(system, x, (0.0, count * h), h, METHOD, save_every=max(1, count // 20), engine="array")
    energy = run.stats.energy_range or (run.energy.min(), run.energy.max())
    rows = []
    for state in run.x:
        W, B = (1j * np.asarray(q.matrix(f)) for f in q.magnetic_fields(state))
        powers = [np.linalg.matrix_power(B, k) for k in range(5)]
        traces = [np.trace(W @ B), *(np.trace(powers[k]) for k in (2, 3, 4)), np.trace(W @ powers[2])]
        scales = [norm(W) * norm(B), norm(B) ** 2, norm(B) * norm(powers[2]), norm(powers[2]) ** 2]
        rows.append((np.real(traces), [*scales, norm(W) * norm(powers[2])]))
    values, scales = np.swapaxes(rows, 0, 1)
    changes = np.abs(values - values[0]).max(axis=0) / scales[0]
    first_energy = float(run.energy[0])
    drift, energy_ratio = (energy[1] - energy[0]) / abs(first_energy), float(run.energy[-1]) / first_energy
    return [run.stats.wall_time, float(drift), energy_ratio, *map(float, changes)]


norm = np.linalg.norm


def race_isospectral(*numbers: str):
    """Race both schemes in one process; return the rows of the table and the ratio of the times."""
    N, steps, rounds = map(int, numbers)
    q = lt.models.QuantisedSphere(N)
    x = q.random(0, (min(VORTICITY_DEGREES[0], N - 1), min(VORTICITY_DEGREES[1], N - 1)), 4.0)
    W, scheme = np.asarray(q.matrix(x)), IsospectralMidpoint(N)
    h = TURN_PER_STEP / (q.gamma * np.abs(np.linalg.eigvalsh(1j * scheme.stream_matrix(W))).max() * 2.0)
    system = lt.models.zeitlin(N, "enstrophy", DECAY_RATE)
    span, method = (0.0, h * steps), METHOD
    library_result = functools.partial(
        lt.integrate, system, x, span, h, method, save_every=steps, engine="array", progress=False
    )
    peer = functools.partial(scheme.integrate, W, h * q.gamma, steps)
    outcomes = race(
        {"isospectral midpoint, no dissipation": peer, "this library, selective decay": library_result}, rounds=rounds
    )
    (name, peer_outcome), (own_name, library_outcome) = outcomes.items()
    W_end, iterations = peer_outcome.result
    solution = library_outcome.result
    energy = solution.stats.energy_range
    min_energy, max_energy = energy if energy is not None else (solution.energy.min(), solution.energy.max())
    drift, energy_change = (
        abs(scheme.energy(W_end) / scheme.energy(W) - 1.0),
        (max_energy - min_energy) / abs(solution.energy[0]),
    )
    casimir_changes = _casimir_changes(W, np.asarray(q.matrix(solution.x[-1])))
    ratio = float(library_outcome.cpu_seconds / peer_outcome.cpu_seconds)
    rows = [
        [N, name, peer_outcome.cpu_seconds / steps, 1.0, drift, *_casimir_changes(W, W_end), iterations],
        [N, own_name, library_outcome.cpu_seconds / steps, ratio, float(energy_change), *casimir_changes, None],
    ]
    return rows, ratio


def _casimir_changes(W_start: np.ndarray, W_end: np.ndarray) -> list[float]:
    """Return relative changes of the traces of powers 2 to 4, the odd one relative to that of absolute values."""
    a, b = (np.linalg.eigvalsh(1j * W) for W in (W_start, W_end))
    return [float(abs((b**k).sum() - (a**k).sum()) / (np.abs(a) ** k).sum()) for k in (2, 3, 4)]
