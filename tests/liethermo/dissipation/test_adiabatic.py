"""Jumps between instantaneous levels, beside their definition integrated by SciPy, and beside QuTiP's brmesolve."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import liethermo as lt

SX = np.array([[0.0, 1.0], [1.0, 0.0]])
SY = np.array([[0.0, -1.0j], [1.0j, 0.0]])
SZ = np.diag([1.0, -1.0])
RHO = np.array([[0.6, 0.2 - 0.1j], [0.2 + 0.1j, 0.4]])
T = 0.6
RATE = 0.2
COUPLING = SY + 0.3 * SX
TERMS = [(SZ, lambda t: 0.5 * jnp.cos(0.1 * t)), (SX, lambda t: 0.5 * (1.0 + 0.1 * t) * jnp.sin(0.1 * t))]


def turning_hamiltonian(t):
    return 0.5 * np.cos(0.1 * t) * SZ + 0.5 * (1.0 + 0.1 * t) * np.sin(0.1 * t) * SX


def reservoir(temperature=T):
    return lt.HeatBaths(capacity=np.inf, temperature=temperature)


def qubit(coupling=COUPLING, baths=None, rate=RATE):
    return lt.QuantumSystem(TERMS, lt.AdiabaticJumps([(coupling, rate)]), baths=reservoir() if baths is None else baths)


def davies_field(rho, H, V, temperature, rate):
    """Return Lindblad's equation with the components of V in the eigenvectors of H, from its definition."""
    energies, U = np.linalg.eigh(H)
    gaps, inside = np.round(energies[None, :] - energies[:, None], 9), U.conj().T @ V @ U
    change = -1j * (H @ rho - rho @ H)
    for omega in np.unique(gaps):
        L = U @ np.where(gaps == omega, inside, 0.0) @ U.conj().T
        square = L.conj().T @ L
        gain = L @ rho @ L.conj().T - 0.5 * (square @ rho + rho @ square)
        change = change + rate * np.exp(omega / (2 * temperature)) * gain
    return change


def test_the_field_is_that_of_davies_at_each_time():
    system = qubit()
    for t in (0.0, 3.0, 8.0):
        velocity = system.structure.matrix(system.vector_field(system.state(RHO), t)[:4])
        expected = davies_field(RHO, turning_hamiltonian(t), COUPLING, T, RATE)
        np.testing.assert_allclose(velocity, expected, atol=1e-15)


def test_a_coupling_that_is_not_hermitian_acts_with_its_adjoint():
    lower = np.array([[0.0, 1.0], [0.2, 0.1]])
    system = qubit(lower)
    energies, U = np.linalg.eigh(turning_hamiltonian(3.0))
    omega, inside = energies[1] - energies[0], U.conj().T @ lower @ U
    expected = -1j * (turning_hamiltonian(3.0) @ RHO - RHO @ turning_hamiltonian(3.0))
    zero = np.diag(np.diag(inside))
    jumps = [(zero, 1.0), (zero.conj().T, 1.0)]
    for entry in (inside[0, 1], inside[1, 0]):  # each part acts together with its adjoint
        down = np.array([[0.0, entry], [0.0, 0.0]])
        jumps += [(down, np.exp(omega / (2 * T))), (down.conj().T, np.exp(-omega / (2 * T)))]
    for jump, factor in jumps:
        L = U @ jump @ U.conj().T
        square = L.conj().T @ L
        expected = expected + RATE * factor * (L @ RHO @ L.conj().T - 0.5 * (square @ RHO + RHO @ square))
    velocity = system.structure.matrix(system.vector_field(system.state(RHO), 3.0)[:4])
    np.testing.assert_allclose(velocity, expected, atol=1e-15)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("coupling", "bloch"),
    [
        (SY, [-0.812873884306688, 0.04339211151962829, -0.28408778185566147]),
        (COUPLING, [-0.8149853465342158, 0.04162647442825283, -0.28087524840103084]),
    ],
)
def test_a_turning_field_is_that_of_brmesolve(coupling, bloch):
    """Bloch vectors at t = 10 by QuTiP 5.3.1.

    ``brmesolve(H, rho, [0, 10], a_ops=[[V, lambda w: 0.2 * exp(w / 1.2)]], sec_cutoff=0.1)``, solver dop853 at 1e-12.
    """
    system = qubit(coupling)
    run = lt.integrate(system, RHO, (0.0, 10.0), 0.1, lt.MetriplecticGauss(3))
    np.testing.assert_allclose(system.bloch(run.x[-1]), bloch, atol=1e-9)
    assert run.audit().passed
    assert "NOT VALID" not in run.audit().verdict


@pytest.mark.slow
def test_three_levels_are_those_of_brmesolve():
    """Populations and coherences at t = 8 by QuTiP 5.3.1, with ``sec_cutoff=0.05``."""
    H0, H1 = np.diag([0.0, 1.0, 2.5]), np.array([[0.0, 0.2, 0.1], [0.2, 0.0, 0.3], [0.1, 0.3, 0.0]])
    V = np.array([[0.0, 1.0, 0.5], [1.0, 0.0, 0.7], [0.5, 0.7, 0.2]])
    system = lt.QuantumSystem(
        [H0, (H1, lambda t: jnp.sin(0.3 * t))], lt.AdiabaticJumps([(V, 0.05)]), baths=reservoir(0.8)
    )
    run = lt.integrate(system, np.diag([0.2, 0.3, 0.5]), (0.0, 8.0), 0.1, lt.MetriplecticGauss(3))
    rho = np.asarray(system.density(run.x[-1]))
    np.testing.assert_allclose(
        np.diag(rho).real, [0.485130846278359, 0.3304403942561569, 0.18442875946548357], atol=1e-9
    )
    expected = [
        -0.027676492353730323 - 0.008289050278014186j,
        -0.007836539293242824 + 0.00012264363991381809j,
        -0.020818390770110797 - 0.0006986025015061893j,
    ]
    np.testing.assert_allclose(rho[[0, 0, 1], [1, 2, 2]], expected, atol=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=str
)
def test_both_laws_hold_with_a_finite_bath(method):
    """The energy changes by the work of the drive alone, and the entropy of qubit and bath does not fall."""
    system = qubit(baths=lt.HeatBaths(capacity=0.8, temperature=T))
    run = lt.integrate(system, RHO, (0.0, 10.0), 0.25, method)
    audit = run.audit()
    assert audit.passed
    assert audit.energy_drift < 1e-14
    assert np.diff(run.entropy).min() > -1e-15
    work = scipy.integrate.simpson(np.asarray(system.power(run.x, run.t)), x=run.t)
    np.testing.assert_allclose(run.casimirs["work"][-1], work, rtol=3e-3)


def test_the_power_of_a_drive_needs_the_time():
    driven = qubit(baths=lt.HeatBaths(capacity=0.8, temperature=T))
    x = np.stack([driven.state(RHO)] * 3)
    with pytest.raises(lt.InputError, match="Give the time beside the state"):
        driven.power(x)
    undriven = lt.QuantumSystem(np.diag([0.0, 1.0]))
    assert np.array_equal(undriven.power(x[:, : undriven.dim]), np.zeros(3))


def test_the_friction_is_symmetric_and_takes_no_energy():
    assert qubit().check(times=1.0).passed


def test_equal_frequencies_form_one_jump():
    """Two qubits that turn together: coherence is carried between pairs of levels with the same distance."""
    one = np.eye(2)
    terms = [(np.kron(M, one) + np.kron(one, M), f) for M, f in TERMS]
    V = np.kron(SY, one)
    system = lt.QuantumSystem(terms, lt.AdiabaticJumps([(V, RATE)]), baths=reservoir(), parts=(2, 2))
    rho = np.kron(RHO, np.array([[0.3, 0.1j], [-0.1j, 0.7]]))
    H = np.kron(turning_hamiltonian(2.0), one) + np.kron(one, turning_hamiltonian(2.0))
    velocity = system.structure.matrix(system.vector_field(system.state(rho), 2.0)[:16])
    np.testing.assert_allclose(velocity, davies_field(rho, H, V, T, RATE), atol=1e-14)
    # the second qubit is left alone: its density matrix moves by its own Hamiltonian
    reduced = np.einsum("iaib->ab", np.asarray(velocity).reshape(2, 2, 2, 2))
    second = rho.reshape(2, 2, 2, 2).trace(axis1=0, axis2=2)
    h = turning_hamiltonian(2.0)
    np.testing.assert_allclose(reduced, -1j * (h @ second - second @ h), atol=1e-14)


def test_a_hamiltonian_at_rest_gives_the_jumps_of_its_eigenvectors():
    H = turning_hamiltonian(5.0)
    plain = lt.QuantumSystem(H, lt.ThermalJumps([(COUPLING, RATE)]), baths=reservoir())
    adiabatic = lt.QuantumSystem(H, lt.AdiabaticJumps([(COUPLING, RATE)]), baths=reservoir())
    np.testing.assert_allclose(
        adiabatic.vector_field(adiabatic.state(RHO)), plain.vector_field(plain.state(RHO)), atol=1e-15
    )
    gibbs = scipy.linalg.expm(-H / T)
    rest = adiabatic.density(adiabatic.steady_state().x)
    np.testing.assert_allclose(rest, gibbs / np.trace(gibbs), atol=1e-12)


def test_rates_may_depend_on_frequency_temperature_and_time():
    """A coupling ``c(t) V`` to bosons: the rate ``c(t)^2 g / (2 sinh(omega / 2T))``."""

    def rate(omega, temperature, t):
        return jnp.sin(t) ** 2 * 0.3 / (2 * jnp.sinh(omega / (2 * temperature)))

    lower = np.array([[0.0, 1.0], [0.0, 0.0]])
    for jumps in (lt.ThermalJumps([(lower, rate)]), lt.AdiabaticJumps([(lower, rate)])):
        system = lt.QuantumSystem(np.diag([0.0, 1.3]), jumps, baths=reservoir())
        assert system.is_driven
        velocity = np.asarray(system.structure.matrix(system.vector_field(system.state(RHO), 0.7)[:4]))
        n = 1.0 / np.expm1(1.3 / T)
        fill = np.sin(0.7) ** 2 * 0.3 * (n * 0.6 - (n + 1) * 0.4)
        np.testing.assert_allclose(velocity[1, 1], fill, atol=1e-15)
        run = lt.integrate(system, RHO, (0.0, 3.0), 0.1)
        assert run.audit().passed
        assert abs(run.casimirs["work"][-1]) < 1e-15  # a coupling that is switched does no work in this limit


def test_a_fast_drive_is_named_by_the_audit():
    fast = lt.QuantumSystem(
        [(SZ, lambda t: 0.5 * jnp.cos(5 * t)), (SX, lambda t: 0.5 * jnp.sin(5 * t))],
        lt.AdiabaticJumps([(SY, RATE)]),
        baths=reservoir(),
    )
    np.testing.assert_allclose(fast.adiabatic_parameter([0.0, 0.3]), 2.5, rtol=1e-12)  # |H'| = 5 / 2, gap 1
    audit = lt.integrate(fast, RHO, (0.0, 1.0), 0.05).audit()
    row = next(row for row in audit.rows if row.law == "adiabatic parameter")
    assert row.passed is False
    assert audit.passed  # the laws hold
    assert audit.verdict.endswith("THE EQUATIONS ARE USED WHERE THEY ARE NOT VALID")


@pytest.mark.slow
def test_the_audit_of_an_ensemble_shows_the_worst_adiabatic_parameter():
    """``|H'| / (2 gap^2)`` of a field that turns at the rate w is w / (2 |field|): the weakest field is the worst."""
    field = [(SZ, lambda t: 0.5 * jnp.cos(0.3 * t)), (SX, lambda t: 0.5 * jnp.sin(0.3 * t))]
    system = lt.QuantumSystem(field, lt.AdiabaticJumps([(SY, RATE)]), baths=reservoir())
    parameter = float(np.max(system.adiabatic_parameter([0.0, 0.5])))
    many = lt.ensemble(system, [RHO, RHO], (0.0, 1.0), 0.05)
    row = next(row for row in many.audit().rows if row.law == "adiabatic parameter")
    assert row.value == pytest.approx(parameter, rel=1e-9)
    assert row.passed is False
    assert many.audit().passed  # the laws hold, the equations do not
    assert many.audit().verdict.endswith("THE EQUATIONS ARE USED WHERE THEY ARE NOT VALID")


def test_a_rate_that_is_infinite_at_zero_is_refused_where_it_is_used():
    """The advice works: the rate of an ohmic bath is finite at zero."""

    def infinite(omega, temperature):
        return 0.1 / jnp.sinh(omega / (2 * temperature))

    with pytest.raises(lt.InputError, match="at omega = 0 is inf"):
        qubit(COUPLING, rate=infinite)
    advised = qubit(COUPLING, rate=lambda w, T: 0.1 * jnp.where(w == 0, 2 * T, w / jnp.sinh(w / (2 * T))))
    assert np.isfinite(advised.vector_field(advised.state(RHO), 1.0)).all()


def test_jumps_that_do_not_fit_are_refused():
    with pytest.raises(lt.InputError, match="AdiabaticJumps exchange heat with a bath"):
        lt.QuantumSystem(TERMS, lt.AdiabaticJumps([(SY, RATE)]))
    with pytest.raises(lt.InputError, match="bath 1, but there are 1"):
        lt.QuantumSystem(TERMS, lt.AdiabaticJumps([(SY, RATE)], bath=1), baths=reservoir())
    with pytest.raises(lt.InputError, match=r"slow drive use lt\.AdiabaticJumps"):
        lt.QuantumSystem(TERMS, lt.ThermalJumps([(SY, RATE)]), baths=reservoir())
