"""Engines and heat currents of quantum systems beside closed forms: maser, local and global dissipation."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import liethermo as lt
import manifolds as mf

LOWER = np.array([[0.0, 1.0], [0.0, 0.0]])
RATE = 0.01


# -- the three-level maser [Scovil & Schulz-DuBois 1959] ---------------------------------------------------------------

COLD_LEVEL = 1.0
HOT_LEVEL = 2.5
MASER_RATE = 0.02


def transition(j, k):
    return np.eye(3)[:, [j]] * np.eye(3)[[k]]


def boson_jumps(operator, frequency, temperature):
    n = 1.0 / np.expm1(frequency / temperature)
    return lt.LindbladJumps([(operator, MASER_RATE * (n + 1)), (operator.T, MASER_RATE * n)])


def maser(hot, cold, drive):
    """Return the maser in the frame of its drive, and its couplings to the hot and the cold bath."""
    jumps = boson_jumps(transition(0, 2), HOT_LEVEL, hot), boson_jumps(transition(0, 1), COLD_LEVEL, cold)
    frame = lt.RotatingFrame((HOT_LEVEL - COLD_LEVEL) * transition(2, 2))
    field = drive * (transition(1, 2) + transition(2, 1))
    H = frame.rotating_wave(np.diag([0.0, COLD_LEVEL, HOT_LEVEL]), field, HOT_LEVEL - COLD_LEVEL)
    return lt.QuantumSystem(H, list(jumps)), jumps


@pytest.mark.sampled(1)
@pytest.mark.parametrize("drive", [2e-3, 0.1])
@pytest.mark.parametrize("hot", [1.0, 5.0])
def test_a_maser_has_the_efficiency_of_its_frequencies(drive, hot):
    """Power over heat is ``1 - omega_cold / omega_hot``; it is positive where ``T_c / T_h < omega_c / omega_h``."""
    cold, energies = 0.6, np.diag([0.0, COLD_LEVEL, HOT_LEVEL])
    system, jumps = maser(hot, cold, drive)
    rho = system.density(system.steady_state().x)
    heat_in, heat_out = (float(j.current(rho, energies)) for j in jumps)
    power = heat_in + heat_out
    np.testing.assert_allclose(power / heat_in, 1.0 - COLD_LEVEL / HOT_LEVEL, rtol=1e-9)
    assert (power > 0.0) == (cold / hot < COLD_LEVEL / HOT_LEVEL)


@pytest.mark.slow
def test_a_strong_drive_equalises_the_levels_of_the_maser():
    """The flux of quanta at saturation, from the balance of the populations ``p1 = p2``."""
    hot, cold = 5.0, 0.6
    system, jumps = maser(hot, cold, 200.0)
    rho = system.density(system.steady_state().x)
    n_hot, n_cold = 1.0 / np.expm1(HOT_LEVEL / hot), 1.0 / np.expm1(COLD_LEVEL / cold)
    ground = 1.0 / (1.0 + 2.0 * (n_hot + n_cold) / (n_hot + n_cold + 2.0))
    upper = 0.5 * (1.0 - ground)
    flux = MASER_RATE * (n_hot * ground - (n_hot + 1.0) * upper)
    heat = float(jumps[0].current(rho, np.diag([0.0, COLD_LEVEL, HOT_LEVEL])))
    np.testing.assert_allclose(heat, HOT_LEVEL * flux, rtol=1e-6)


# -- two coupled qubits between two baths: local and global dissipation ------------------------------------------------

COUPLINGS = (np.kron(LOWER, np.eye(2)), np.kron(np.eye(2), LOWER))


def pair_hamiltonian(frequencies, g):
    H = sum(w * V.T @ V for w, V in zip(frequencies, COUPLINGS, strict=True))
    exchange = COUPLINGS[0].T @ COUPLINGS[1]
    return H + g * (exchange + exchange.T)


def total_rate(frequency, T):
    return 2.0 * RATE * np.cosh(frequency / (2 * T))


def occupation(frequency, T):
    return 1.0 / (1.0 + np.exp(frequency / T))


def local_current(frequencies, temperatures, g):
    """Return the heat that flows in from the first bath, with jumps of each qubit alone."""
    H = pair_hamiltonian(frequencies, g)
    jumps = [
        lt.LindbladJumps([(V, RATE * np.exp(w / (2 * T))), (V.T, RATE * np.exp(-w / (2 * T)))])
        for V, w, T in zip(COUPLINGS, frequencies, temperatures, strict=True)
    ]
    system = lt.QuantumSystem(H, jumps, parts=(2, 2))
    return float(jumps[0].current(system.density(system.steady_state().x), H))


def global_system(frequencies, temperatures, g):
    jumps = [lt.ThermalJumps([(V, RATE)], bath=i) for i, V in enumerate(COUPLINGS)]
    baths = lt.HeatBaths(np.inf, temperatures, 2)
    return lt.QuantumSystem(pair_hamiltonian(frequencies, g), jumps, baths=baths, parts=(2, 2))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("g", [0.1, 0.01, 0.001])
def test_the_local_current_is_that_of_its_equations(g):
    """Populations and coherence close: ``I = 4 g^2 G1 G2 (f1 - f2) / ((G1 + G2) (4 g^2 + G1 G2))`` quanta."""
    T = (2.0, 0.5)
    rates, f = [total_rate(1.0, t) for t in T], [occupation(1.0, t) for t in T]
    product = rates[0] * rates[1]
    expected = 4 * g**2 * product * (f[0] - f[1]) / (sum(rates) * (4 * g**2 + product))
    np.testing.assert_allclose(local_current((1.0, 1.0), T, g), expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("g", [0.1, 0.001])
def test_the_global_current_is_that_of_two_modes(g):
    """Each mode of frequency ``1 +- g`` couples with half of its weight to either bath; no trace of g is left."""
    T, expected = (2.0, 0.5), 0.0
    for omega in (1.0 + g, 1.0 - g):
        rates, f = [total_rate(omega, t) for t in T], [occupation(omega, t) for t in T]
        expected += 0.5 * omega * rates[0] * rates[1] / sum(rates) * (f[0] - f[1])
    system = global_system((1.0, 1.0), T, g)
    np.testing.assert_allclose(system.heat_currents(system.steady_state().x)[0], expected, rtol=1e-9)


@pytest.mark.slow
def test_local_heat_may_flow_from_cold_to_hot():
    """Local heat does where ``omega_h / T_h > omega_c / T_c`` [Levy & Kosloff 2014]; global heat never does."""
    T = (1.0, 0.8)
    for hot_frequency, flows_backwards in ((1.1, False), (1.5, True)):
        frequencies = (hot_frequency, 1.0)
        assert (hot_frequency / T[0] > 1.0 / T[1]) == flows_backwards
        assert (local_current(frequencies, T, 0.05) < 0.0) == flows_backwards
        system = global_system(frequencies, T, 0.05)
        x = system.steady_state().x
        assert float(system.heat_currents(x)[0]) > 0.0
        assert float(system.entropy_production(x)) > 0.0


# -- baths whose temperature depends on time ---------------------------------------------------------------------------


def warm_and_cool(t):
    return 0.7 + 0.3 * jnp.sin(t)


@pytest.mark.slow
def test_a_qubit_follows_a_bath_that_is_warmed_and_cooled():
    """Populations by SciPy; the ledger has the work ``dT/dt y`` on the bath, and the entropy does not fall."""
    omega, rate = 1.3, 0.2
    bath = lt.HeatBaths(capacity=np.inf, temperature=warm_and_cool)
    qubit = lt.QuantumSystem(np.diag([0.0, omega]), lt.ThermalJumps([(LOWER, rate)]), baths=bath)
    run = lt.integrate(qubit, np.diag([0.4, 0.6]), (0.0, 6.0), 0.1, lt.MetriplecticGauss(3))

    def field(t, y):
        T, (p, entropy, _) = 0.7 + 0.3 * np.sin(t), y
        filling = rate * (np.exp(-omega / (2 * T)) * (1 - p) - np.exp(omega / (2 * T)) * p)
        return [filling, -omega * filling / T, 0.3 * np.cos(t) * entropy]

    p, entropy, work = scipy.integrate.solve_ivp(field, (0.0, 6.0), [0.6, 0.0, 0.0], rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(qubit.density(run.x[-1])[1, 1].real, p, atol=1e-9)
    np.testing.assert_allclose(run.x[-1, -1], entropy, atol=1e-9)
    np.testing.assert_allclose(run.casimirs["work"][-1], work, atol=1e-9)
    np.testing.assert_allclose(qubit.temperatures(run.x, run.t)[:, 0], 0.7 + 0.3 * np.sin(run.t), rtol=1e-15)
    audit = run.audit()
    assert audit.passed
    assert audit.energy_drift < 1e-14
    current = -omega * field(6.0, [p, 0.0, 0.0])[0]
    np.testing.assert_allclose(qubit.heat_currents(run.x[-1], 6.0), [-current], atol=1e-8)


@pytest.mark.slow
def test_a_classical_body_heats_a_bath_whose_temperature_is_driven():
    bath = lt.HeatBaths(np.inf, warm_and_cool)
    body = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic([1 / 3, 1 / 2, 1.0]), dissipation=lt.DoubleBracket(0.1), baths=bath
    )
    run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 5.0), 0.1)
    assert run.audit().passed
    assert run.x[-1, -1] > run.x[0, -1]


@pytest.mark.slow
def test_a_temperature_that_depends_on_time_has_its_conditions():
    with pytest.raises(lt.InputError, match="capacity must be infinite"):
        lt.HeatBaths(1.0, warm_and_cool)
    with pytest.raises(lt.FunctionError, match=r"must have shape \(\)"):
        lt.HeatBaths(np.inf, lambda t: jnp.ones(3), number=2)
    cold = lt.QuantumSystem(
        np.diag([0.0, 1.0]), lt.ThermalJumps([(LOWER, 0.1)]), baths=lt.HeatBaths(np.inf, lambda t: -1.0 - 0.0 * t)
    )
    with pytest.raises(lt.IntegrationError):  # steps with a temperature that is not positive are refused
        lt.integrate(cold, cold.state(np.eye(2) / 2), (0.0, 1.0), 0.1)
    bath = lt.HeatBaths(np.inf, warm_and_cool)
    qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), lt.ThermalJumps([(LOWER, 0.1)]), baths=bath)
    with pytest.raises(lt.InputError, match="Give the time beside the state"):
        qubit.temperatures(qubit.state(np.eye(2) / 2))
