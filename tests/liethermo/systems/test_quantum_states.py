"""States of quantum systems: pure ones, eigenvalues at zero, ensembles, and constants added to the energy."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import liethermo as lt
import manifolds as mf
from liethermo.functions.gradients import EPS
from tests.cases import few_combinations
from tests.liethermo.systems.qubits import (
    LOWER,
    QUBIT,
    RATE,
    RHO,
    T,
    X,
    Z,
    infinite,
    levels,
    lindblad,
    qubit,
    random_density,
    random_hermitian,
    solve_by_scipy,
)


def test_a_matrix_is_a_state_whatever_its_numbers_are():
    """Real numbers and integers too, and of one level."""
    q = lt.QuantumSystem([[0, 0], [0, 1]])
    ends = [lt.integrate(q, rho, (0.0, 0.2), 0.1).x for rho in ([[0.5, 0], [0, 0.5]], q.state(np.eye(2) / 2))]
    assert np.array_equal(*ends)
    one = lt.QuantumSystem([[2.0]])
    run = lt.integrate(one, [[1.0]], (0.0, 0.2), 0.1)
    assert run.audit().passed
    assert np.array_equal(one.density(run.x[-1]), [[1.0]])


def test_a_pure_state_is_refused_with_what_to_do():
    q = qubit()
    with pytest.raises(lt.InputError, match="gradient of the entropy is infinite, and"):
        lt.integrate(q, q.state([0.0, 1.0]), (0.0, 1.0), 0.1)
    assert np.linalg.eigvalsh(q.density(q.state([0.0, 1.0], mixed=1e-6)))[0] == pytest.approx(5e-7)


PRECESSING_STATE = [0.6, 0.8]
"""A pure state that the Hamiltonian of the qubit turns."""


def test_a_pure_state_with_a_floor_is_refused_where_steps_would_be_wrong():
    """Steepest ascent would let the error of a step grow, and jumps take an infinite gradient in implicit steps."""
    floor = lt.VonNeumann(floor=1e-12)
    q = lt.QuantumSystem(QUBIT, lt.SteepestEntropyAscent(0.4), entropy=floor)
    with pytest.raises(lt.InputError, match=r"eigenvectors the Hamiltonian turns.*mixed=1e-6"):
        lt.integrate(q, q.state(PRECESSING_STATE), (0.0, 1.0), 0.1)
    still = lt.integrate(q, q.state([1.0, 0.0]), (0.0, 1.0), 0.1)
    assert np.abs(q.density(still.x[-1]) - np.diag([1.0, 0.0])).max() <= 1e-15
    dephasing = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(Z, 0.3)]), entropy=floor)
    with pytest.raises(lt.InputError, match=r"or lt\.MetriplecticRungeKutta"):
        lt.integrate(dephasing, dephasing.state(PRECESSING_STATE), (0.0, 1.0), 0.1)
    for what in (lambda x: lt.flow(dephasing, x, (0.0, 1.0), 0.1), lambda x: lt.suggest_step(dephasing, x)):
        with pytest.raises(lt.InputError, match=r"cannot start at this x0.*or lt\.MetriplecticRungeKutta"):
            what(dephasing.state(PRECESSING_STATE))
    end = lt.integrate(dephasing, dephasing.state(PRECESSING_STATE), (0.0, 1.0), 0.1, lt.MetriplecticRungeKutta(8)).x[
        -1
    ]
    assert abs(abs(dephasing.density(end)[0, 1]) - 0.48 * np.exp(-0.6)) <= 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("driven", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_ensemble_refuses_what_a_single_run_refuses(driven):
    """Each trajectory by itself, and by the method too: stages without the gradient start there."""
    H = (lambda t: (1.0 + 0.1 * t) * QUBIT) if driven else QUBIT
    q = lt.QuantumSystem(H, lt.ThermalJumps([(Z, 0.3)]), entropy=lt.VonNeumann(floor=1e-12))
    x0s = np.stack([q.state(RHO)] * 5)
    x0s[3] = q.state(PRECESSING_STATE)
    many = lt.ensemble(q, x0s, (0.0, 0.2), 0.1)
    assert np.flatnonzero(~many.ok).tolist() == [3]
    assert many.message(3).startswith("trajectory 3: the run cannot start at this x0: its density matrix has")
    with pytest.raises(lt.InputError) as one:
        lt.integrate(q, x0s[3], (0.0, 0.2), 0.1)
    assert many.message(3) == f"trajectory 3: {one.value}"
    assert np.array_equal(many.x[4], lt.integrate(q, x0s[4], (0.0, 0.2), 0.1).x[-1])
    with pytest.raises(lt.InputError, match=r"trajectory 0: the run cannot start.*or lt\.MetriplecticRungeKutta"):
        lt.ensemble(q, q.state(PRECESSING_STATE), (0.0, 0.2), 0.1)
    assert lt.ensemble(q, x0s, (0.0, 0.2), 0.1, lt.MetriplecticRungeKutta(4)).ok.all()


def test_an_ensemble_over_rates_refuses_the_states_of_their_members():
    x0s = np.stack([qubit().state(RHO)] * 4)
    x0s[2] = qubit().state([0.0, 1.0])
    many = lt.ensemble(
        qubit(), x0s, (0.0, 0.2), 0.1, parameters={"dissipation.rates[0]": np.array([0.1, 0.2, 0.3, 0.4])}
    )
    assert np.flatnonzero(~many.ok).tolist() == [2]
    assert "gradient of the entropy is infinite, and" in many.message(2)


SHIFTED_METHODS = [lt.MetriplecticRungeKutta(4), lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2)]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("coupling", [LOWER, X], ids=["lowering", "Hermitian"])
@pytest.mark.parametrize("method", SHIFTED_METHODS, ids=str)
def test_two_levels_relax_beside_a_third_one_far_below(method, coupling):
    """Levels at 0, 5e9 and 5e9 + 1: the frequency 1 is not zero beside the largest energy."""
    H, V = np.diag([0.0, 5e9, 5e9 + 1.0]), np.zeros((3, 3), complex)
    V[1:, 1:] = coupling
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, 0.5)]), infinite(0.8))
    run = lt.integrate(q, q.state(np.diag([0.2, 0.5, 0.3])), (0.0, 30.0), 0.25, method)
    p = np.diag(q.density(run.x[-1])).real
    assert p[2] / p[1] == pytest.approx(np.exp(-1.0 / 0.8), rel=1e-8)
    assert p[0] == pytest.approx(0.2, abs=1e-15)
    assert run.audit().passed


@pytest.mark.slow
def test_a_bath_takes_the_heat_of_a_small_gap_between_large_energies():
    """Its temperature is that beside the two levels alone: heat is summed from differences of levels."""
    ends = []
    for far in (0.0, 5e12):
        H, V = np.diag([0.0, far, far + 1.0]), np.zeros((3, 3), complex)
        V[1:, 1:] = X
        q = lt.QuantumSystem(H, lt.ThermalJumps([(V, 0.5)]), lt.HeatBaths(capacity=2.0, temperature=0.8))
        run = lt.integrate(q, q.state(np.diag([0.2, 0.5, 0.3])), (0.0, 5.0), 0.1, lt.MetriplecticGauss(2))
        assert run.audit().passed
        ends.append(float(q.temperatures(run.x[-1])[0]))
    assert ends[1] == pytest.approx(ends[0], rel=1e-12)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("shift", [1e6, 1e10, 1e13])
@pytest.mark.parametrize("kind", ["isolated", "noise", "bath", "driven", "terms", "steepest ascent"])
def test_a_constant_added_to_the_hamiltonian_changes_no_state(kind, shift):
    """The shift is a power of two, so H + c is exact; but for a function of time, which is rounded beside it."""
    shift, H = 2.0 ** np.round(np.log2(shift)), np.diag([0.0, 1.25]) + 0.5 * X
    built = {
        "isolated": lambda H: lt.QuantumSystem(H),
        "noise": lambda H: lt.QuantumSystem(H, lt.ThermalJumps([(X + Z, 0.3)])),
        "bath": lambda H: lt.QuantumSystem(H, lt.ThermalJumps([(X, 0.3)]), lt.HeatBaths(2.0, T)),
        "driven": lambda H: lt.QuantumSystem(lambda t: H + 0.25 * jnp.cos(t) * Z),
        "terms": lambda H: lt.QuantumSystem([H, (0.25 * Z, jnp.cos)]),
        "steepest ascent": lambda H: lt.QuantumSystem(H, lt.SteepestEntropyAscent(0.4)),
    }[kind]
    plain, moved = (built(H + c * np.eye(2)) for c in (0.0, shift))
    assert plain.energy_law == moved.energy_law
    method, within = lt.MetriplecticGauss(2), 1e-12
    if kind == "driven":
        within = max(1e-9, 4.0 * EPS * shift)
    runs = [lt.integrate(q, q.state(RHO), (0.0, 2.0), 0.1, method) for q in (plain, moved)]
    assert np.abs(runs[0].x - runs[1].x).max() <= within
    assert np.abs(runs[0].entropy - runs[1].entropy).max() <= within
    assert runs[1].energy[0] - shift == pytest.approx(runs[0].energy[0], abs=8.0 * EPS * shift)
    assert runs[1].audit().passed


def test_a_coupling_that_does_not_commute_exchanges_energy_whatever_the_constant_is():
    for c in (0.0, 1e10, 1e13):
        noisy = lt.QuantumSystem(np.diag([c, 1.0 + c]), lt.ThermalJumps([(X, 0.3)]))
        assert noisy.energy_law is None
        run = lt.integrate(noisy, noisy.state(np.diag([0.9, 0.1])), (0.0, 1.0), 0.05)
        assert np.diag(noisy.density(run.x[-1])).real[0] == pytest.approx(0.5 + 0.4 * np.exp(-0.6), abs=1e-4)
        dephasing = lt.QuantumSystem(np.diag([c, 1.0 + c]), lt.ThermalJumps([(Z, 0.3)]))
        assert dephasing.energy_law == "conserved"


@pytest.mark.parametrize("spacing", [1.0, 0.1])
def test_equal_differences_of_levels_are_one_frequency(spacing):
    """Distances of the levels 0.1 n differ by rounding, more so beside a constant; the coupling stays in one piece."""
    for c in (0.0, 1e8):
        H, V = np.diag(spacing * np.arange(12.0) + c), np.diag(np.sqrt(np.arange(1.0, 12.0)), 1)
        turned = np.linalg.qr(random_hermitian(12))[0]
        for U in (np.eye(12), turned):
            H1, V1 = U @ H @ U.conj().T, U @ V @ U.conj().T
            q = lt.QuantumSystem((H1 + H1.conj().T) / 2, lt.ThermalJumps([(V1, 0.1)]), infinite())
            assert len(q.dissipation.terms[0].jumps) == 1
    near = lt.QuantumSystem(np.diag([0.0, 1.0, 2.0 + 1e-9]), lt.ThermalJumps([(np.diag([1, 1], 1), 0.1)]), infinite())
    assert len(near.dissipation.terms[0].jumps) == 2  # these differ


def test_frequencies_that_are_equal_at_one_time_are_apart_at_others():
    H = lambda t: jnp.diag(jnp.array([0.0, 1.0, 2.0 + t], dtype=complex))  # noqa: E731
    q = lt.QuantumSystem(H, lt.ThermalJumps([(np.diag([1.0, 1.0], 1), RATE)]), infinite())
    rho, wanted, energies = random_density(3), [], np.array([0.0, 1.0, 2.5])
    for k in range(2):
        V, omega = np.zeros((3, 3), complex), energies[k + 1] - energies[k]
        V[k, k + 1] = 1.0
        wanted += [(V, RATE * np.exp(omega / (2 * T))), (V.T, RATE * np.exp(-omega / (2 * T)))]
    found = q.structure.matrix(q.vector_field(q.state(rho), t=0.5)[:9])
    assert np.abs(found - lindblad(rho, np.diag(energies), wanted)).max() <= 1e-14
    off = lt.QuantumSystem(lambda t: jnp.sin(t) * X, lt.ThermalJumps([(Z, RATE)]), infinite())  # zero at t = 0
    assert len(off.dissipation.terms[0].jumps) == 1


def ladder(temperature, U=None, size=8):
    """A ladder of levels in a cold bath, in a frame U, and its generator as a matrix."""
    U = np.eye(size) if U is None else U
    H, V = (U @ M @ U.conj().T for M in (np.diag(np.arange(float(size))), np.diag(np.sqrt(np.arange(1.0, size)), 1)))
    H = (H + H.conj().T) / 2
    rate = lambda omega, T: 0.1 * jnp.exp(-omega / (2.0 * T))  # noqa: E731
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, rate)]), infinite(temperature))
    jumps, basis = [(V, 0.1), (V.conj().T, 0.1 * np.exp(-1.0 / temperature))], np.eye(size**2).reshape(-1, size, size)
    return q, np.stack([lindblad(E, H, jumps).ravel() for E in basis], axis=1), H


COLD = {
    "explicit": (lt.MetriplecticRungeKutta(8), 0.25, 1e-10),
    "midpoint": (lt.MetriplecticMidpoint(), 0.1, 1e-3),
    "Taylor": (lt.MetriplecticTaylor(12), 0.5, 1e-11),
    "Gauss": (lt.MetriplecticGauss(2), 0.25, 1e-4),
}


@pytest.mark.slow
@few_combinations(by=["explicit", "midpoint", "Taylor", "Gauss"], temperature=[0.1, 1 / 30], turned=[False, True])
def test_a_ladder_relaxes_to_a_cold_state(by, temperature, turned):
    """Populations of Gibbs' state fall to exp(-70) and exp(-210): to eigenvalues that are zero to rounding."""
    (method, step, within), size = COLD[by], 8
    q, generator, _ = ladder(temperature, np.linalg.qr(random_hermitian(size))[0] if turned else None)
    rho = random_density(size)
    run = lt.integrate(q, q.state(rho), (0.0, 150.0), step, method)
    assert run.status.ok
    exact = (scipy.linalg.expm(150.0 * generator) @ rho.ravel()).reshape(size, size)
    assert np.abs(q.density(run.x[-1]) - exact).max() <= within
    audit = run.audit()
    assert audit.passed, audit
    assert np.linalg.eigvalsh(q.density(run.x)).min() >= -1e-14
    again = lt.integrate(q, run.x[-1], (0.0, 1.0), step, method)  # the state is one that a run can start from
    assert again.status.ok


@pytest.mark.slow
def test_a_step_that_leaves_the_cone_ends_the_run_and_a_shorter_one_stays_inside():
    """The error of a Gauss step of 0.5 is 0.02 where the smallest eigenvalue is 2e-6: the message says what to do."""
    q, generator, _ = ladder(0.1, np.linalg.qr(random_hermitian(8))[0])
    rho, method = random_density(8), lt.MetriplecticGauss(2)
    run = lt.integrate(q, q.state(rho), (0.0, 20.0), 0.5, method, on_failure="return")
    assert not run.status.ok
    assert "outside the cone of positive matrices: a shorter step stays inside" in str(run.status)
    shorter = lt.integrate(q, q.state(rho), (0.0, 20.0), 0.25, method)
    exact = (scipy.linalg.expm(20.0 * generator) @ rho.ravel()).reshape(8, 8)
    assert np.abs(q.density(shorter.x[-1]) - exact).max() <= 1e-3


@pytest.mark.parametrize("coherence", [0.0, 0.1])
def test_the_advice_on_a_step_of_millions_of_relaxation_times(coherence):
    """With a constant rate, the jumps down have ``rate * exp(omega / 2T)``, here 1.5e8; no step of 0.03 resolves it."""
    lower = np.diag([1.0], 1)
    q = lt.QuantumSystem(np.diag([0.0, 4.0]), lt.ThermalJumps([(lower, 0.3)]), infinite(0.1))
    rho, method = np.array([[0.53, coherence], [coherence, 0.47]]), lt.MetriplecticGauss(2)
    run = lt.integrate(q, q.state(rho), (0.0, 3.0), 0.03, method, on_failure="return")
    assert not run.status.ok
    step = float(re.search(r"(?i)try a smaller step, for example ([\d.e-]+)", run.status.message)[1])
    shorter = lt.integrate(q, q.state(rho), (0.0, 100.0 * step), step, method)
    jumps = [(lower, 0.3 * np.exp(20.0)), (lower.T, 0.3 * np.exp(-20.0))]
    generator = np.stack([lindblad(E, np.diag([0.0, 4.0]), jumps).ravel() for E in np.eye(4).reshape(-1, 2, 2)], axis=1)
    exact = (scipy.linalg.expm(shorter.t[-1] * generator) @ rho.ravel()).reshape(2, 2)
    assert np.abs(q.density(shorter.x[-1]) - exact).max() <= 1e-4
    assert shorter.audit().passed


STIFF = {
    "2 levels": ((4.0,), lt.MetriplecticGauss(2), 0.03, 2.0),
    "3 levels": ((1.0, 4.0), lt.MetriplecticGauss(2), 0.015, 1.5),
    "3 levels by the midpoint": ((1.0, 4.0), lt.MetriplecticMidpoint(), 0.002, 1.0),
    "4 levels": ((1.0, 3.0, 3.0), lt.MetriplecticGauss(2), 0.01, 3.0),
    "3 levels by three stages": ((1.0, 2.0), lt.MetriplecticGauss(3), 0.015, 1.5),
}


@pytest.mark.sampled("2 levels")
@pytest.mark.parametrize("name", STIFF)
def test_stiff_steps_rest_in_a_cold_state(name):
    """Steps of several relaxation times: from rest, updates of a diverging iteration begin at rounding."""
    gaps, method, step, end = STIFF[name]
    size, rate, temperature = len(gaps) + 1, 100.0, 0.1
    U = np.linalg.qr(random_hermitian(size))[0]
    H, V = (np.diag(np.cumsum((0.0, *gaps))), np.diag(np.sqrt(np.arange(1.0, size)), 1))
    jumps = []
    for gap in set(gaps):
        part = np.zeros((size, size))
        for k in np.flatnonzero(np.asarray(gaps) == gap):
            part[k, k + 1] = V[k, k + 1]
        jumps += [(U @ part @ U.conj().T, rate), (U @ part.T @ U.conj().T, rate * np.exp(-gap / temperature))]
    H, V = (U @ M @ U.conj().T for M in (H, V))
    H = (H + H.conj().T) / 2
    coupling = (V, lambda omega, T: rate * jnp.exp(-omega / (2.0 * T)))
    q = lt.QuantumSystem(H, lt.ThermalJumps([coupling]), infinite(temperature))
    rho, basis = random_density(size), np.eye(size**2).reshape(-1, size, size)
    generator = np.stack([lindblad(E, H, jumps).ravel() for E in basis], axis=1)
    run = lt.integrate(q, q.state(rho), (0.0, end), step, method)
    exact = (scipy.linalg.expm(run.t[-1] * generator) @ rho.ravel()).reshape(size, size)
    assert np.abs(q.density(run.x[-1]) - exact).max() <= 1e-13
    audit = run.audit()
    assert audit.passed, audit


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_adaptive_steps_to_a_cold_state_pass_the_audit(rtol):
    """A residual of 2e-13 changes a population of 1e-13, where the entropy falls by 30 times this change."""
    q = lt.QuantumSystem(np.diag([0.0, 4.0]), lt.ThermalJumps([(np.eye(2, k=1), 0.3)]), infinite(0.1))
    run = lt.integrate(q, q.state(np.diag([0.3, 0.7])), (0.0, 3.0), lt.Adaptive(rtol), lt.MetriplecticGauss(1))
    audit = run.audit()
    assert audit.passed, audit


@pytest.mark.sampled("midpoint")
@pytest.mark.parametrize("by", COLD)
def test_a_cold_state_of_gibbs_is_at_rest(by):
    q, _, H = ladder(0.1, np.linalg.qr(random_hermitian(8))[0])
    gibbs = scipy.linalg.expm(-H / 0.1)
    gibbs = gibbs / np.trace(gibbs).real
    run = lt.integrate(q, q.state((gibbs + gibbs.conj().T) / 2), (0.0, 1.0), 0.25, COLD[by][0])
    assert run.status.ok
    assert np.abs(run.x - run.x[0]).max() <= 1e-14
    assert run.audit().passed


def test_the_entropy_and_its_gradient_are_finite_at_eigenvalues_that_are_zero_to_rounding():
    S, structure = lt.VonNeumann(), mf.DensityMatrices(2)
    for p in (0.0, 1e-300, -1e-22, -1e-13):
        x = structure.vector(np.diag([1.0 - p, p]).astype(complex))
        assert abs(float(S.value(x))) <= 1e-10
        assert np.isfinite(S.gradient(x)).all()
        assert np.isfinite(S.discrete_gradient(None, x, 0.1 - x, 0.0 * x)).all()
    for floor in (0.0, 1e-12):
        x = structure.vector(np.diag([1.001, -0.001]).astype(complex))
        assert np.isnan(lt.VonNeumann(floor).value(x))  # no state: a step that ends there is not accepted
        assert not np.isfinite(lt.VonNeumann(floor).gradient(x)).all()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("p", [1e-3, 1e-41, 0.0, -1e-14])
@pytest.mark.parametrize("other", [0.5, 1e-20, -1e-18])
def test_the_entropy_changes_by_its_discrete_gradient_at_zero_eigenvalues(p, other):
    S, structure = lt.VonNeumann(), mf.DensityMatrices(2)
    x, y = (structure.vector(np.diag([1.0 - a, a]).astype(complex)) for a in (p, other))
    change = float(S.discrete_gradient(None, x, y - x, 0.0 * x) @ (y - x))
    assert change == pytest.approx(float(S.value(y) - S.value(x)), rel=1e-9, abs=1e-15)


BATHS = {
    "no bath": lambda: None,
    "an infinite bath": infinite,
    "a finite bath": lambda: lt.HeatBaths(capacity=2.0, temperature=T),
}


@pytest.mark.slow
@pytest.mark.parametrize("baths", BATHS)
def test_pure_states_run_by_methods_without_the_gradient_of_the_entropy(baths):
    """With and without a floor of the entropy: the one that is asked for is the one that is seen."""
    for floor in (0.0, 1e-12):
        q = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(X, RATE)]), BATHS[baths](), lt.VonNeumann(floor))
        assert q.floor == floor
        run = lt.integrate(q, [0.0, 1.0], (0.0, 2.0), 0.05, lt.MetriplecticRungeKutta(8))
        assert run.audit().passed
        fast, rest = (
            (2 * RATE, 0.0) if baths == "no bath" else (2 * RATE * np.cosh(1.3 / (2 * T)), np.tanh(1.3 / (2 * T)))
        )
        z = float(q.expectation(run.x[-1], Z))
        if baths == "a finite bath":
            rho, _ = solve_by_scipy(np.diag([0.0, 1.0]).astype(complex), 2.0, 2.0)
            assert z == pytest.approx((rho[0, 0] - rho[1, 1]).real, abs=1e-11)
        else:
            assert z == pytest.approx(rest - (1.0 + rest) * np.exp(-2.0 * fast), abs=1e-11)
        with pytest.raises(lt.InputError, match=r"Use system.*or lt\.MetriplecticRungeKutta"):
            lt.integrate(q, [0.0, 1.0], (0.0, 2.0), 0.05, lt.MetriplecticMidpoint())


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "method",
    [
        lt.MetriplecticMidpoint(),
        lt.MetriplecticGauss(2),
        lt.MetriplecticRungeKutta(8),
        pytest.param(lt.MetriplecticTaylor(12), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_an_isolated_system_runs_from_pure_states(method):
    q, H = levels(3, None), random_hermitian(3)
    for ket in ([1.0, 0.0, 0.0], np.array([0.6, 0.0, 0.8j]), np.linalg.eigh(H)[1][:, 1]):
        run = lt.integrate(q, ket, (0.0, 1.0), 0.01, method)
        exact = scipy.linalg.expm(-1j * H) @ np.asarray(ket)
        assert np.abs(q.density(run.x[-1]) - np.outer(exact, exact.conj())).max() <= 1e-3
        if isinstance(method, lt.MetriplecticMidpoint):  # which keeps eigenvalues to its order alone
            continue
        assert run.audit().passed
        assert np.abs(np.linalg.eigvalsh(q.density(run.x[-1]))[:2]).max() <= 1e-14


def test_products_keep_the_floor_of_parts_with_baths():
    floor = lt.VonNeumann(1e-10)
    one = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, RATE)]), infinite(), entropy=floor)
    both = one * qubit()
    assert (one.floor, both.floor, both.coupled(np.kron(X, X)).floor) == (1e-10, 1e-10, 1e-10)
    assert float(both.entropy(both.state(np.diag([1.0, 0.0, 0.0, 0.0])))) == 0.0
    run = lt.integrate(both, both.state([0.0, 0.0, 0.0, 1.0]), (0.0, 1.0), 0.1, lt.MetriplecticRungeKutta(6))
    assert run.audit().passed


@pytest.mark.slow
def test_the_advice_for_a_pure_state_under_steepest_ascent_works():
    """A floor where the state stays as pure as it is; to mix it where the Hamiltonian turns it."""
    q = lt.QuantumSystem(np.diag([0.0, 1.0, 2.5]), lt.SteepestEntropyAscent(0.4))
    state = np.diag([0.3, 0.7, 0.0]).astype(complex)
    with pytest.raises(
        lt.InputError, match=r"infinite\. Use .* or give the system entropy=lt\.VonNeumann\(floor=1e-12\)"
    ):
        lt.integrate(q, state, (0.0, 1.0), 0.1)
    floor = lt.QuantumSystem(np.diag([0.0, 1.0, 2.5]), lt.SteepestEntropyAscent(0.4), entropy=lt.VonNeumann(1e-12))
    for system, start in ((floor, state), (q, q.state(state, mixed=1e-6))):
        assert lt.integrate(system, start, (0.0, 1.0), 0.1).audit().passed
    turned = lt.QuantumSystem(random_hermitian(3), lt.SteepestEntropyAscent(0.4))
    with pytest.raises(lt.InputError, match=r"Use system\.state\(rho, mixed=1e-6\)$"):
        lt.integrate(turned, state, (0.0, 1.0), 0.1)
    assert lt.integrate(turned, turned.state(state, mixed=1e-6), (0.0, 1.0), 0.1).audit().passed


@pytest.mark.slow
def test_steepest_ascent_ends_in_a_cold_state():
    """Eight levels reach a temperature of a fourteenth of their distance, and a run goes on there."""
    q = lt.QuantumSystem(np.diag(np.arange(8.0)), lt.SteepestEntropyAscent(1.0))
    start = np.diag([1.0 - 1e-6 - 6e-9, 1e-6, *[1e-9] * 6])
    for method in (lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2)):
        run = lt.integrate(q, start, (0.0, 10.0), 0.02, method)
        assert run.audit().passed
        p = np.diag(q.density(run.x[-1])).real
        assert p[1:4] / p[0] == pytest.approx((p[1] / p[0]) ** np.arange(1.0, 4.0), rel=1e-2)  # of Gibbs
        assert lt.integrate(q, run.x[-1], (0.0, 0.2), 0.02, method).audit().passed


def test_a_ket_may_be_a_column():
    """As of QuTiP, and many of them; with a message of its own where its norm is not one."""
    q, ket = qubit(), np.array([0.6, 0.8j])
    wanted = q.state(np.outer(ket, ket.conj()))
    for given in (ket, ket[:, None], HasFull(ket[:, None])):
        assert np.abs(q.state(given) - wanted).max() <= 1e-16
        assert np.abs(q.state_array(given) - wanted).max() <= 1e-16
    many = q.state(np.stack([ket[:, None], [[1.0], [0.0]]]))
    assert np.abs(many - np.stack([wanted, q.state([1.0, 0.0])])).max() <= 1e-16
    with pytest.raises(lt.InputError, match=r"the ket must have norm 1, got 2. Divide the ket"):
        q.state([[2.0], [0.0]])
    with pytest.raises(
        lt.InputError, match=r"have shape \(2, 2\), got \(3, 1\); a ket has the shape \(2,\) or \(2, 1\)"
    ):
        q.state(np.ones((3, 1)))


class HasFull:
    """A stand-in for QuTiP's operators, which have a method for their matrix, a call, and no array."""

    def __init__(self, matrix):
        self.matrix = matrix

    def full(self):
        return self.matrix

    def __call__(self, *arguments):
        raise AssertionError


def test_operators_of_other_libraries_are_read_by_their_matrices():
    q = lt.QuantumSystem([HasFull(QUBIT), (HasFull(X), jnp.cos)], lt.ThermalJumps([(HasFull(Z), 0.1)]))
    assert q.is_driven
    assert np.abs(lt.QuantumSystem(HasFull(QUBIT)).hamiltonians_at_test_times()[0] - QUBIT).max() <= 1e-15


BAD = {
    "term 1 of the Hamiltonian is not Hermitian": lambda q: lt.QuantumSystem([QUBIT, (LOWER, jnp.cos)]),
    "term 1 of the Hamiltonian has shape": lambda q: lt.QuantumSystem([QUBIT, (np.eye(3), jnp.cos)]),
    "term 1 of the Hamiltonian must be a matrix, or a pair": lambda q: lt.QuantumSystem([QUBIT, (X, 0.5)]),
    "term 0 of the Hamiltonian must be a matrix, or a pair": lambda q: lt.QuantumSystem([[X, 0.5], QUBIT]),
    "of term 1 of the Hamiltonian must return a real number": lambda q: lt.QuantumSystem(
        [QUBIT, (X, lambda t: 1j * t)]
    ),
    "the function for the Hamiltonian must have one argument": lambda q: lt.QuantumSystem(lambda: QUBIT),
    "one argument, the time t: missing .* 's'": lambda q: lt.QuantumSystem([QUBIT, (X, lambda t, s: t)]),
    r"V\[0\] with the energy 1.3 .* = 3.39e\+27": lambda q: lt.QuantumSystem(
        QUBIT, lt.ThermalJumps([(LOWER, RATE)]), infinite(0.01)
    ),
    r"at T = 0.0001, .* = nan.*Give the rate as a function": lambda q: lt.QuantumSystem(
        QUBIT, lt.ThermalJumps([(X, lambda w, T: 0.1 / (2 * jnp.sinh(w / (2 * T))))]), infinite(1e-4)
    ),
    "eigenvectors of the Hamiltonian, so it must not be a traced value": lambda q: lt.ensemble(
        lambda p: lt.QuantumSystem(p * QUBIT, lt.ThermalJumps([(LOWER, RATE)]), infinite()),
        q.state(RHO),
        (0.0, 1.0),
        0.1,
        parameters=np.array([0.5, 1.0]),
    ),
    "Hermitian": lambda q: lt.QuantumSystem(LOWER),
    "square": lambda q: lt.QuantumSystem(np.ones((2, 3))),
    r"V\[0\] has shape \(3, 3\)": lambda q: lt.QuantumSystem(
        QUBIT, lt.ThermalJumps([(np.eye(3), 1.0)]), baths=infinite()
    ),
    "rate must be >= 0 and finite": lambda q: lt.ThermalJumps([(LOWER, -1.0)]),
    r"V\[0\] is zero": lambda q: lt.ThermalJumps([(0.0 * LOWER, 1.0)]),
    "pairs": lambda q: lt.ThermalJumps([LOWER]),
    "bath 1, but there are 1": lambda q: lt.QuantumSystem(
        QUBIT, lt.ThermalJumps([(LOWER, 1.0)], bath=1), baths=infinite()
    ),
    "or remove baths=": lambda q: lt.QuantumSystem(QUBIT, baths=infinite()),
    "must be lt.ThermalJumps": lambda q: lt.QuantumSystem(QUBIT, lt.DoubleBracket(1.0)),
    r"rate of V\[0\] must be a number, or a function .* got": lambda q: lt.ThermalJumps([(LOWER, lambda w, T: [w])]),
    "at omega = 1 and T = 1 it is -1": lambda q: lt.ThermalJumps([(LOWER, lambda w, T: -1.0)]),
    r"to a number >= 0: .*positional argument": lambda q: lt.ThermalJumps([(LOWER, lambda w: 1.0)]),
    r"got an array of float64, shape \(0, 0\)": lambda q: lt.QuantumSystem(np.zeros((0, 0))),
    "the observable must have shape": lambda q: q.expectation(q.state(RHO), np.eye(3)),
    "mixed, .* from 0 to 1, got 'half'": lambda q: q.state(RHO, mixed="half"),
    "matrix must be Hermitian": lambda q: q.state(RHO + 0.1 * LOWER),
    "least eigenvalue is": lambda q: q.state(np.diag([1.2, -0.2])),
    "trace 1, got 0.7": lambda q: q.state(0.7 * RHO),
    r"have shape \(2, 2\), got \(3, 3\)": lambda q: q.state(np.eye(3) / 3),
    "must be finite": lambda q: q.state(np.nan * RHO),
    "lt.QuantumSystem": lambda q: lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(np.ones(3)), lt.Quadratic(np.ones(3)), lt.SteepestEntropyAscent()
    ),
    "product of the sizes of the parts must be 2": lambda q: lt.QuantumSystem(QUBIT, parts=[3]),
}


@pytest.mark.parametrize("message", BAD)
def test_what_is_refused(message):
    with pytest.raises(lt.InputError, match=message):
        BAD[message](qubit())


@pytest.mark.slow
def test_an_ensemble_over_the_temperatures_of_a_function():
    """The couplings are split by the Hamiltonian, which is known where temperatures are not."""

    def system(temperature):
        return lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, RATE)]), baths=infinite(temperature))

    x = qubit().state(RHO)
    many = lt.ensemble(system, x, (0.0, 1.0), 0.1, lt.MetriplecticGauss(2), parameters=np.array([0.5, T]))
    alone = lt.integrate(qubit(), x, (0.0, 1.0), 0.1, lt.MetriplecticGauss(2)).x[-1]
    assert np.abs(many.x[1] - alone).max() <= 1e-15


@pytest.mark.slow
def test_a_study_over_quantum_systems():
    """A point is a system of its own, made by a function."""

    def system(point):
        return lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, point["rate"])]), infinite(point["temperature"]))

    study = lt.Study(
        system,
        {"rate": [0.1, 0.3], "temperature": [0.5, 0.7]},
        x0=qubit().state(RHO),
        t_span=(0.0, 2.0),
        step=0.1,
        method=lt.MetriplecticGauss(2),
        measure={"final": "final"},
    )
    study.run(progress=False)
    q = system({"rate": 0.3, "temperature": 0.7})
    alone = lt.integrate(q, q.state(RHO), (0.0, 2.0), 0.1, lt.MetriplecticGauss(2)).x[-1]
    assert np.abs(study.results.final.sel(rate=0.3, temperature=0.7).values - alone).max() <= 1e-15


def test_ensembles_over_rates_and_states():
    q = qubit()
    x0s = q.state(np.stack([random_density(2, seed) for seed in range(5)]))
    found = lt.ensemble(q, x0s, (0.0, 2.0), 0.1, lt.MetriplecticGauss(2))
    alone = lt.integrate(q, x0s[3], (0.0, 2.0), 0.1, lt.MetriplecticGauss(2)).x[-1]
    assert np.array_equal(found.x[3], alone)


def test_an_ensemble_takes_matrices():
    """As a single run takes one; and says which of them is none."""
    q, matrices = qubit(), np.stack([random_density(2, seed) for seed in range(3)])
    many = lt.ensemble(q, matrices, (0.0, 0.2), 0.1)
    assert np.array_equal(many.x, lt.ensemble(q, q.state(matrices), (0.0, 0.2), 0.1).x)
    matrices[1] *= 0.5  # a trace of a half
    many = lt.ensemble(q, matrices, (0.0, 0.2), 0.1)
    assert many.ok.tolist() == [True, False, True]
    assert "trace 1, got 0.5" in many.message(1)
