"""Set-ups and values of QuTiP's tests of its master-equation solver, ``qutip/tests/solver/test_mesolve.py``.

QuTiP writes jumps with any rates. Here they have detailed balance, at the temperature of a bath or at an infinite one
without it. A decay at zero temperature is that in a bath so cold that the jumps upwards are rounding, exp(-50).

Rates that depend on time, pumps that are faster than the decay, and jumps of a part of a coupled system are those of
``LindbladJumps``: see its tests. What has no counterpart here: Hamiltonians that are not Hermitian, and superoperators
as initial states.
"""

import pickle

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt

SZ = np.diag([1.0, -1.0])
SX = np.array([[0.0, 1.0], [1.0, 0.0]])
COLD = 1.0 / 50.0
"""Temperature of a bath, relative to the frequency of a jump, at which jumps upwards are rounding."""


def destroy(levels):
    return np.diag(np.sqrt(np.arange(1.0, levels)), 1)


def basis(levels, n):
    return np.eye(levels)[:, [n]]  # a column, as QuTiP's kets are


def decay(operator, rate, frequency=1.0, bath=0):
    """Return jumps by an operator at a rate, in a bath of the temperature ``COLD * frequency``."""
    return lt.ThermalJumps([(operator, lambda omega, T: rate * jnp.exp(-omega / (2.0 * T)))], bath)


def cold(frequency=1.0):
    return lt.HeatBaths(capacity=np.inf, temperature=COLD * frequency)


class Qobj:
    """Operator that gives its matrix by ``full()``."""

    def __init__(self, matrix):
        self.matrix = matrix

    def full(self):
        return self.matrix


# -- decay of a cavity: TestMESolveDecay -------------------------------------------------------------------------------

LEVELS = 10
KAPPA = 0.2
A = destroy(LEVELS)
NUMBER = A.T @ A
HAMILTONIANS = {
    "const": NUMBER,
    "func": lambda t: jnp.asarray(A.T) @ jnp.asarray(A),
    "list_func": [(NUMBER, lambda t: 1.0 + 0.0 * t)],
    "list_array": [(NUMBER, lambda t: jnp.interp(t, np.linspace(0.0, 10.0, 201), np.ones(201)))],
    "Qobj": Qobj(NUMBER),
}


@pytest.mark.slow
@pytest.mark.parametrize("H", HAMILTONIANS)
def test_constant_decay(H):
    """``9 exp(-kappa t)`` quanta; QuTiP asks for 1e-6."""
    q = lt.QuantumSystem(HAMILTONIANS[H], decay(A, KAPPA), cold())
    run = lt.integrate(q, basis(LEVELS, 9), (0.0, 10.0), 0.25, lt.MetriplecticTaylor(12))
    assert np.abs(q.expectation(run.x, NUMBER) - 9.0 * np.exp(-KAPPA * run.t)).max() <= 1e-10
    assert run.audit().passed


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [lt.MetriplecticRungeKutta(4), lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(8)], ids=str
)
def test_constant_decay_by_every_method(method):
    """QuTiP runs its decays by each of its solvers, with a tolerance of 1e-5."""
    q = lt.QuantumSystem(NUMBER, decay(A, KAPPA), cold())
    run = lt.integrate(q, basis(LEVELS, 9), (0.0, 10.0), 0.1, method)
    assert np.abs(q.expectation(run.x, NUMBER) - 9.0 * np.exp(-KAPPA * run.t)).max() <= 1e-6


def test_a_rate_is_no_function_of_time():
    """``sqrt(kappa exp(-t)) a`` has no counterpart, and says what rates are functions of."""
    with pytest.raises(lt.InputError, match="a number, or a function of omega and T"):
        lt.ThermalJumps([(A, lambda t: KAPPA * np.exp(-t))])


@pytest.mark.slow
def test_stepping_and_a_rate_that_is_switched_off():
    """A run in two parts; in the second the rate is zero, and the number of quanta stays (1e-6)."""
    decaying, lossless = (lt.QuantumSystem(NUMBER, decay(A, rate), cold()) for rate in (1.0, 0.0))
    state = lt.integrate(decaying, basis(LEVELS, 9), (0.0, 1.0), 0.125, lt.MetriplecticTaylor(12)).x[-1]
    final_state = lt.integrate(lossless, state, (1.0, 2.0), 0.125, lt.MetriplecticTaylor(12)).x[-1]
    quanta = [float(decaying.expectation(x, NUMBER)) for x in (state, final_state)]
    assert quanta[0] == pytest.approx(9.0 * np.exp(-1.0), abs=1e-10)
    assert quanta[1] == pytest.approx(quanta[0], abs=1e-13)


@pytest.mark.slow
def test_pickling():
    q = lt.QuantumSystem(NUMBER, lt.ThermalJumps([(A, 0.1)]), lt.HeatBaths(np.inf, 0.5))
    copy = pickle.loads(pickle.dumps(q))
    ends = [lt.integrate(s, basis(LEVELS, 9), (0.0, 1.0), 0.25, lt.MetriplecticTaylor(8)).x[-1] for s in (q, copy)]
    assert np.array_equal(*ends)


def test_a_hamiltonian_that_is_not_hermitian_is_refused():
    """QuTiP normalises its states; here no state would remain one."""
    with pytest.raises(lt.InputError, match="the Hamiltonian is not Hermitian"):
        lt.QuantumSystem([[1.0, -0.1j], [-0.1j, 1.0]])


# -- a qubit: testQubitDynamics1, 2 ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("g2", [0.1, 0.0])
def test_qubit_dynamics(g2):
    """A rotation about x with dephasing by ``sqrt(g2) sz``; QuTiP compares with a formula that is right to 0.05."""
    delta = 2.0 * np.pi
    q = lt.QuantumSystem(delta / 2.0 * SX, lt.ThermalJumps([(SZ, g2)]) if g2 else None)
    run = lt.integrate(q, basis(2, 0), (0.0, 5.0), 0.025, lt.MetriplecticRungeKutta(8))
    x, y, z = q.bloch(run.x).T
    rough = np.exp(-g2 * run.t)
    assert max(np.abs(x).max(), np.abs(y + np.sin(delta * run.t) * rough).max()) <= 0.05
    assert np.abs(z - np.cos(delta * run.t) * rough).max() <= 0.05
    omega = np.sqrt(delta**2 - g2**2)
    exact = rough * (np.cos(omega * run.t) + g2 / omega * np.sin(omega * run.t))
    assert np.abs(z - exact).max() <= 1e-9
    assert run.audit().passed


# -- a cavity and an atom: TestJCModelEvolution ------------------------------------------------------------------------


def jaynes_cummings(levels, frequency, coupling):
    a, sm = np.kron(destroy(levels), np.eye(2)), np.kron(np.eye(levels), destroy(2))
    H = frequency * (a.T @ a + sm.T @ sm) + coupling * (a.T @ sm + a @ sm.T)
    return H, a.T @ a, sm.T @ sm


@pytest.mark.slow
@pytest.mark.parametrize("end", [20.0, 1000.0])
def test_vacuum_rabi_oscillations(end):
    """Case 1: photons and excitation are exchanged with ``2 g sqrt(n + 1)``; QuTiP asks for 5e-3 up to t = 1000."""
    g, n = 2.0 * np.pi * 0.01, 2
    H, photons, excitation = jaynes_cummings(4, 2.0 * np.pi, g)
    q = lt.QuantumSystem(H, parts=[4, 2])
    run = lt.integrate(q, np.kron(basis(4, n), basis(2, 1)), (0.0, end), 0.1, lt.MetriplecticTaylor(20), save_every=5)
    phase = np.cos(2.0 * g * np.sqrt(n + 1) * run.t)
    assert np.abs(q.expectation(run.x, photons) - n - 0.5 * (1.0 - phase)).max() <= 1e-8
    assert np.abs(q.expectation(run.x, excitation) - 0.5 * (1.0 + phase)).max() <= 1e-8
    assert run.audit().passed


@pytest.mark.slow
def test_decay_without_interaction():
    """Case 2: a cavity and an atom that decay each by itself, kappa = 0.005 and gamma = 0.01; QuTiP asks for 5e-3."""
    w, kappa, gamma, n = 2.0 * np.pi, 0.005, 0.01, 2
    cavity = lt.QuantumSystem(w * destroy(4).T @ destroy(4), decay(destroy(4), kappa), cold(w))
    atom = lt.QuantumSystem(w * destroy(2).T @ destroy(2), decay(destroy(2), gamma), cold(w))
    q = cavity * atom
    _, photons, excitation = jaynes_cummings(4, w, 0.0)
    run = lt.integrate(
        q, np.kron(basis(4, n), basis(2, 1)), (0.0, 50.0), 0.25, lt.MetriplecticTaylor(16), save_every=10
    )
    assert np.abs(q.expectation(run.x, photons) - n * np.exp(-kappa * run.t)).max() <= 1e-10
    assert np.abs(q.expectation(run.x, excitation) - np.exp(-gamma * run.t)).max() <= 1e-10


# -- coefficients that are step functions: TestMESolveStepFuncCoeff ----------------------------------------------------

STEPS = {
    "python": (lambda t: jnp.where(t < np.pi / 2, 1.0, 0.0), np.pi / 2),
    "array, equal times": (lambda t: jnp.where(t < np.pi / 2, 0.25, 0.75), np.pi),
    "array, other times": (lambda t: jnp.where(t < np.pi / 2, 0.5, 0.25), 3.0 * np.pi / 2),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", STEPS)
def test_step_functions_turn_a_qubit_by_half_a_turn(name):
    """The end is ``sigma_x`` times the start, to a fidelity of 1e-6; the jump is at the end of a step."""
    f, end = STEPS[name]
    ket = np.array([[0.6], [0.8j]])
    q = lt.QuantumSystem([(SX, f)])
    run = lt.integrate(q, ket, (0.0, end), np.pi / 40, lt.MetriplecticGauss(3))
    final_ket = SX @ ket
    assert abs((final_ket.conj().T @ np.asarray(q.density(run.x[-1])) @ final_ket)[0, 0] - 1.0) <= 1e-6
