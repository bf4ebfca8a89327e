"""Density matrices in a bath of constant temperature, beside QuTiP."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import scipy.linalg

import liethermo as lt

from .. import laws, peers
from ..ensembles import ensemble_laws as ensemble_laws
from ..machine import available_cores
from ..report import Report, Table, UnavailableError, ratio
from ..timing import race

TEMPERATURE, RATE, T_END = 0.8, 0.1, 100.0

LOWERING, ENSEMBLE_T_END = np.array([[0.0, 1.0], [0.0, 0.0]]), 250.0

EARLY_TIME, N_SAVED = 5.0, 20
"""The time at which the error is measured beside that at the end, when coherences have decayed; states kept."""


def operators(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Levels whose distances differ, and a coupling of neighbours; no level so high that it is empty to rounding."""
    distances = np.concatenate([[0.0], np.linspace(0.7, 1.3, levels - 1)])
    return np.diag(np.cumsum(distances)), np.diag(np.sqrt(np.arange(1.0, levels)), 1)


def thermal_system(levels: int) -> lt.QuantumSystem:
    H, V = operators(levels)
    bath = lt.HeatBaths(capacity=np.inf, temperature=TEMPERATURE)
    return lt.QuantumSystem(H, lt.ThermalJumps([(V, RATE)]), baths=bath)


def jump_operators(levels: int) -> list[np.ndarray]:
    """The jumps of Lindblad's equation, their rates inside."""
    H, V = operators(levels)
    found = []
    for i in range(levels - 1):
        one, omega = np.zeros((levels, levels)), H[i + 1, i + 1] - H[i, i]
        one[i, i + 1] = V[i, i + 1]
        for L, energy in ((one, omega), (one.T, -omega)):
            found.append(np.sqrt(RATE * np.exp(energy / (2 * TEMPERATURE))) * L)
    return found


def exact_states(levels: int, rho: np.ndarray) -> np.ndarray:
    """The density matrices at the early time and at the end."""
    H, one = operators(levels)[0], np.eye(levels)
    generator = -1j * (np.kron(H, one) - np.kron(one, H.T))
    for L in jump_operators(levels):
        n = L.T @ L
        generator += np.kron(L, L.conj()) - 0.5 * (np.kron(n, one) + np.kron(one, n.T))
    return np.stack([scipy.linalg.expm(generator * t) @ rho.ravel() for t in (EARLY_TIME, T_END)]).reshape(
        2, levels, levels
    )


def qutip_work(levels: int, rho: np.ndarray, tolerance: float):
    """A call of ``qutip.mesolve`` to the end; its density matrices at the early time and there."""
    qutip = peers.import_peer("qutip")
    H, *jumps = (
        qutip.Qobj(L).to("CSR") for L in (operators(levels)[0], *jump_operators(levels))
    )  # faster than dense ones
    options = {"rtol": tolerance, "atol": 0.01 * tolerance, "nsteps": 1_000_000}
    times = np.linspace(0.0, T_END, N_SAVED + 1)

    def solve():
        states = qutip.mesolve(H, qutip.Qobj(rho), times, c_ops=jumps, options=options).states
        return np.stack([states[i].full() for i in (1, -1)])

    return solve


def qubit(parameters) -> lt.QuantumSystem:
    bath = lt.HeatBaths(capacity=np.inf, temperature=parameters["temperature"])
    return lt.QuantumSystem(np.diag([0.0, 1.0]), lt.ThermalJumps([(LOWERING, parameters["rate"])]), bath)


def qubit_ensemble(number: int) -> tuple[lt.Ensemble, np.ndarray]:
    """A run of qubits from random states in baths of as many temperatures, at as many rates; and how far each is from
    the Gibbs state of its bath at the end."""
    rng = np.random.default_rng(0)
    parameters = {"rate": rng.uniform(0.1, 0.4, number), "temperature": rng.uniform(0.4, 2.0, number)}
    some = qubit({"rate": 0.1, "temperature": 1.0})
    states = some.samples(number, 1) * np.append(np.ones(some.body_dim), 0.0)
    method = lt.MetriplecticTaylor(20)
    found = lt.ensemble(qubit, states, (0.0, ENSEMBLE_T_END), 2.5, method, parameters=parameters)
    weights = np.exp(-np.outer(1.0 / parameters["temperature"], [0.0, 1.0]))
    gibbs = np.zeros((number, some.body_dim))
    gibbs[:, :2] = weights / weights.sum(axis=1, keepdims=True)
    return found, np.abs(np.asarray(found.x)[:, : some.body_dim] - gibbs).max(axis=1)


def _ensemble_table(quick: bool) -> Table:
    number = 100 if quick else 100_000
    outcome = race({"ours": lambda: qubit_ensemble(number)}, rounds=1 if quick else 3)["ours"]
    found, distance = outcome.result
    cells = [f"{number:,}", outcome.wall_seconds, outcome.wall_seconds / number, float(distance.max())]
    columns = {"Qubits": "text", "To the end": "seconds", "Time a qubit": "seconds", "Distance from Gibbs": "error"}
    return Table(
        f"An ensemble of qubits, each with a temperature and a rate of its own, by Taylor steps of order 20 to "
        f"T = {ENSEMBLE_T_END:g}: the worst of all. Times by the clock, on {available_cores()} cores.",
        columns | laws.COLUMNS,
        [[*cells, *ensemble_laws(found).table_cells()]],
    )


def run(quick: bool) -> Report:
    rows, rounds = [], 1 if quick else 5
    small, large = ((2, 20, 2.5), (3, 20, 1.25), (4, 20, 1.25)), ((8, 16, 0.5), (16, 16, 0.25))
    for levels, order, step in small if quick else small + large:
        q, rng = thermal_system(levels), np.random.default_rng(levels)
        root = rng.normal(size=(levels, levels)) + 1j * rng.normal(size=(levels, levels))
        rho = root @ root.conj().T / np.trace(root @ root.conj().T).real
        x, wanted, method = q.state(rho), exact_states(levels, rho), lt.MetriplecticTaylor(order)
        start = time.process_time()
        lt.integrate(q, x, (0.0, step), step, method)
        first, steps = time.process_time() - start, round(T_END / step)

        def ours(q=q, x=x, step=step, steps=steps, method=method):
            return lt.integrate(q, x, (0.0, T_END), step, method, save_every=steps // N_SAVED)

        error = np.abs(np.asarray(q.density(ours().x[np.array([1, -1])])) - wanted).max()
        works = {"ours": ours}
        with contextlib.suppress(UnavailableError):
            works["QuTiP"] = qutip_work(levels, rho, max(error, 1e-12))
        outcomes = race(works, rounds=rounds)
        own = outcomes["ours"]
        cells = [levels, first, own.cpu_seconds / steps, own.cpu_seconds, error]
        if "QuTiP" in outcomes:
            other = outcomes["QuTiP"]
            cells += [ratio(other.cpu_seconds, own.cpu_seconds), np.abs(other.result - wanted).max()]
        else:
            cells += [None, None]
        rows.append([*cells, *laws.solution_laws(own.result).table_cells()])
    columns = {"Levels": "text", "First answer": "seconds", "Time a step": "seconds", "To the end": "seconds"}
    columns |= {"Error": "error", "QuTiP, relative": "ratio", "Its error": "error"}
    table = Table(
        f"Taylor steps of order 16 and 20 to T = {T_END:g}, beside QuTiP at about the same error. The error is the "
        f"largest of those at T = {EARLY_TIME:g} and at the end.",
        columns | laws.COLUMNS,
        rows,
    )
    text = "Levels in a bath of constant temperature, where the motion is Lindblad's equation. Processor times."
    return Report("Density matrices", text, [table, _ensemble_table(quick)], [])
