"""Density matrices in a bath of constant temperature, against QuTiP."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import scipy.linalg

import liethermo as lt

from .. import laws, peers
from ..ensembles import ensemble_laws
from ..machine import available_cores
from ..report import Report, Table, UnavailableError, ratio
from ..timing import race

TEMPERATURE = 0.8
"""Temperature of the bath."""
RATE = 0.1
"""Rate of the jumps."""
T_END = 100.0
"""Duration of the runs."""

LOWERING = np.array([[0.0, 1.0], [0.0, 0.0]])
"""Lowering operator of a qubit."""
ENSEMBLE_T_END = 250.0
"""Duration of the ensemble of qubits."""

EARLY_TIME = 5.0
"""Time of the second error measurement; at the end, the coherences have decayed."""

N_SAVED = 20
"""Number of saved states."""


def hamiltonian_and_coupling(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a Hamiltonian with unequal level distances, and the operator that couples neighbouring levels.

    The distances are so small that no level is empty to rounding in equilibrium.
    """
    distances = np.concatenate([[0.0], np.linspace(0.7, 1.3, levels - 1)])
    return np.diag(np.cumsum(distances)), np.diag(np.sqrt(np.arange(1.0, levels)), 1)


def thermal_system(levels: int) -> lt.QuantumSystem:
    H, V = hamiltonian_and_coupling(levels)
    bath = lt.HeatBaths(capacity=np.inf, temperature=TEMPERATURE)
    return lt.QuantumSystem(H, lt.ThermalJumps([(V, RATE)]), baths=bath)


def jump_operators(levels: int) -> list[np.ndarray]:
    """Return the jump hamiltonian_and_coupling of Lindblad's equation, including their rates."""
    H, V = hamiltonian_and_coupling(levels)
    jumps = []
    for i in range(levels - 1):
        lowering, omega = np.zeros((levels, levels)), H[i + 1, i + 1] - H[i, i]
        lowering[i, i + 1] = V[i, i + 1]
        for L, energy in ((lowering, omega), (lowering.T, -omega)):
            jumps.append(np.sqrt(RATE * np.exp(energy / (2 * TEMPERATURE))) * L)
    return jumps


def exact_states(levels: int, rho: np.ndarray) -> np.ndarray:
    """Return the density matrices at the early time and at the end."""
    H, identity = hamiltonian_and_coupling(levels)[0], np.eye(levels)
    generator = -1j * (np.kron(H, identity) - np.kron(identity, H.T))
    for L in jump_operators(levels):
        n = L.T @ L
        generator += np.kron(L, L.conj()) - 0.5 * (np.kron(n, identity) + np.kron(identity, n.T))
    return np.stack([scipy.linalg.expm(generator * t) @ rho.ravel() for t in (EARLY_TIME, T_END)]).reshape(
        2, levels, levels
    )


def qutip_work(levels: int, rho: np.ndarray, tolerance: float):
    """Return a run of ``qutip.mesolve`` that gives the density matrices at the early time and at the end."""
    qutip = peers.import_peer("qutip")
    H, *jumps = (
        qutip.Qobj(L).to("CSR") for L in (hamiltonian_and_coupling(levels)[0], *jump_operators(levels))
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
    """Run qubits from random states with different temperatures and rates; return the ensemble, and final distances
    from the Gibbs states."""
    rng = np.random.default_rng(0)
    parameters = {"rate": rng.uniform(0.1, 0.4, number), "temperature": rng.uniform(0.4, 2.0, number)}
    example_system = qubit({"rate": 0.1, "temperature": 1.0})
    states = example_system.samples(number, 1) * np.append(np.ones(example_system.body_dim), 0.0)
    method = lt.MetriplecticTaylor(20)
    result = lt.ensemble(qubit, states, (0.0, ENSEMBLE_T_END), 2.5, method, parameters=parameters)
    weights = np.exp(-np.outer(1.0 / parameters["temperature"], [0.0, 1.0]))
    gibbs = np.zeros((number, example_system.body_dim))
    gibbs[:, :2] = weights / weights.sum(axis=1, keepdims=True)
    return result, np.abs(np.asarray(result.x)[:, : example_system.body_dim] - gibbs).max(axis=1)


def _ensemble_table(is_quick: bool) -> Table:
    number = 100 if is_quick else 100_000
    outcome = race({"ours": lambda: qubit_ensemble(number)}, rounds=1 if is_quick else 3)["ours"]
    result, distance = outcome.result
    cells = [f"{number:,}", outcome.wall_seconds, outcome.wall_seconds / number, float(distance.max())]
    columns = {"Qubits": "text", "To the end": "seconds", "Time a qubit": "seconds", "Distance from Gibbs": "error"}
    return Table(
        f"An ensemble of qubits, each with a temperature and a rate of its own, by Taylor steps of order 20 to "
        f"T = {ENSEMBLE_T_END:g}: the worst of all. Times by the clock, on {available_cores()} cores.",
        columns | laws.COLUMNS,
        [[*cells, *ensemble_laws(result).table_cells()]],
    )


def run(is_quick: bool) -> Report:
    rows, rounds = [], 1 if is_quick else 5
    small_cases, large_cases = ((2, 20, 2.5), (3, 20, 1.25), (4, 20, 1.25)), ((8, 16, 0.5), (16, 16, 0.25))
    for levels, order, step in small_cases if is_quick else small_cases + large_cases:
        q, rng = thermal_system(levels), np.random.default_rng(levels)
        root = rng.normal(size=(levels, levels)) + 1j * rng.normal(size=(levels, levels))
        rho = root @ root.conj().T / np.trace(root @ root.conj().T).real
        x, exact, method = q.state(rho), exact_states(levels, rho), lt.MetriplecticTaylor(order)
        start = time.process_time()
        lt.integrate(q, x, (0.0, step), step, method)
        first_seconds, steps = time.process_time() - start, round(T_END / step)

        def ours(q=q, x=x, step=step, steps=steps, method=method):
            return lt.integrate(q, x, (0.0, T_END), step, method, save_every=steps // N_SAVED)

        error = np.abs(np.asarray(q.density(ours().x[np.array([1, -1])])) - exact).max()
        works = {"ours": ours}
        with contextlib.suppress(UnavailableError):
            works["QuTiP"] = qutip_work(levels, rho, max(error, 1e-12))
        outcomes = race(works, rounds=rounds)
        own_outcome = outcomes["ours"]
        cells = [levels, first_seconds, own_outcome.cpu_seconds / steps, own_outcome.cpu_seconds, error]
        if "QuTiP" in outcomes:
            qutip_outcome = outcomes["QuTiP"]
            cells += [
                ratio(qutip_outcome.cpu_seconds, own_outcome.cpu_seconds),
                np.abs(qutip_outcome.result - exact).max(),
            ]
        else:
            cells += [None, None]
        rows.append([*cells, *laws.solution_laws(own_outcome.result).table_cells()])
    columns = {"Levels": "text", "First answer": "seconds", "Time a step": "seconds", "To the end": "seconds"}
    columns |= {"Error": "error", "QuTiP, relative": "ratio", "Its error": "error"}
    table = Table(
        f"Taylor steps of order 16 and 20 to T = {T_END:g}, beside QuTiP at about the same error. The error is the "
        f"largest of those at T = {EARLY_TIME:g} and at the end.",
        columns | laws.COLUMNS,
        rows,
    )
    text = "Levels in a bath of constant temperature, where the motion is Lindblad's equation. Processor times."
    return Report("Density matrices", text, [table, _ensemble_table(is_quick)], [])
