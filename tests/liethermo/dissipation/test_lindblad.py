"""Lindblad's equation with any jumps, beside optical Bloch equations, superoperators of SciPy, and QuTiP."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import liethermo as lt

LOWER = np.array([[0.0, 1.0], [0.0, 0.0]])
SX = np.array([[0.0, 1.0], [1.0, 0.0]])
SZ = np.diag([1.0, -1.0])
RHO = np.array([[0.6, 0.2 - 0.1j], [0.2 + 0.1j, 0.4]])
METHOD = lt.MetriplecticGauss(3)


class FakeQobj:
    """An operator with the ``full()`` of QuTiP's ``Qobj``."""

    def __init__(self, matrix):
        self.matrix = np.asarray(matrix, dtype=complex)

    def full(self):
        return self.matrix


def liouvillian(H, jumps) -> np.ndarray:
    """Return Lindblad's generator on row-major ``vec(rho)``, from its definition."""
    one = np.eye(len(H))
    L = -1j * (np.kron(H, one) - np.kron(one, H.T))
    for V, rate in jumps:
        square = V.conj().T @ V
        L = L + rate * (np.kron(V, V.conj()) - 0.5 * np.kron(square, one) - 0.5 * np.kron(one, square.T))
    return L


def test_a_damped_driven_qubit_obeys_the_optical_bloch_equations():
    """In the rotating frame: ``H = -delta sz / 2 + Omega sx / 2``, decay at the rate gamma from level 1 to level 0."""
    delta, Omega, gamma = 0.4, 0.9, 0.3
    qubit = lt.QuantumSystem(-0.5 * delta * SZ + 0.5 * Omega * SX, lt.LindbladJumps([(LOWER, gamma)]))
    # r' = B x r - (gamma / 2, gamma / 2, gamma) r + (0, 0, gamma), with B = (Omega, 0, -delta)
    M = np.array([[-gamma / 2, delta, 0.0], [-delta, -gamma / 2, -Omega], [0.0, Omega, -gamma]])
    rest = -np.linalg.solve(M, [0.0, 0.0, gamma])
    saturation = 2 * Omega**2 / (gamma**2 + 4 * delta**2)
    np.testing.assert_allclose((1 - rest[2]) / 2, 0.5 * saturation / (1 + saturation), rtol=1e-12)  # textbook form
    state = qubit.steady_state()
    np.testing.assert_allclose(qubit.bloch(state.x), rest, atol=1e-14)
    np.testing.assert_allclose(
        np.sort_complex(state.linearisation.eigenvalues), np.sort_complex(np.linalg.eigvals(M)), atol=1e-13
    )
    run = lt.integrate(qubit, qubit.state(RHO), (0.0, 10.0), 0.05, METHOD)
    r0 = np.asarray(qubit.bloch(qubit.state(RHO)))
    expected_values = rest + scipy.linalg.expm(10.0 * M) @ (r0 - rest)
    np.testing.assert_allclose(qubit.bloch(run.x[-1]), expected_values, atol=1e-9)


def test_the_motion_is_that_of_the_exponential_of_its_superoperator():
    rng = np.random.default_rng(0)
    a = rng.standard_normal((3, 3, 3)) + 1j * rng.standard_normal((3, 3, 3))
    H, jumps = a[0] + a[0].conj().T, [(a[1], 0.1), (a[2], 0.05)]
    rho = np.diag([0.5, 0.3, 0.2]).astype(complex)
    system = lt.QuantumSystem(FakeQobj(H), lt.LindbladJumps([(FakeQobj(V), rate) for V, rate in jumps]))
    run = lt.integrate(system, system.state(rho), (0.0, 2.0), 0.01, METHOD)
    expected_values = (scipy.linalg.expm(2.0 * liouvillian(H, jumps)) @ rho.ravel()).reshape(3, 3)
    np.testing.assert_allclose(system.density(run.x[-1]), expected_values, atol=1e-9)
    audit = run.audit()
    assert audit.passed
    assert str(audit).count("no law promised") == 2
    assert audit.verdict.startswith("the promised laws hold, and the steps resolve the motion")
    assert abs(np.trace(system.density(run.x[-1])) - 1.0) < 1e-14


@pytest.mark.slow
def test_a_drive_in_qutips_form_is_that_of_dop853():
    """``[H0, [H1, f]]`` with a function, and with an array of its values."""
    omega, Omega, gamma = 2.0, 0.5, 0.2
    H0, H1, times = 0.5 * omega * SZ, Omega * SX, np.linspace(0.0, 5.0, 2001)
    jumps = [(LOWER, gamma)]

    def field(t, v):
        return liouvillian(H0 + np.cos(omega * t) * H1, jumps) @ v

    expected_values = scipy.integrate.solve_ivp(
        field, (0.0, 5.0), RHO.ravel().astype(complex), method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    dissipation = lt.LindbladJumps(jumps)
    driven = lt.QuantumSystem([H0, [H1, lambda t: jnp.cos(omega * t)]], dissipation)
    tabulated = lt.QuantumSystem([H0, [H1, np.cos(omega * times)]], dissipation, times=times)
    for system in (driven, tabulated):
        run = lt.integrate(system, system.state(RHO), (0.0, 5.0), 0.02, METHOD)
        np.testing.assert_allclose(system.density(run.x[-1]).ravel(), expected_values, atol=1e-9)


def test_a_run_beyond_the_times_of_a_coefficient_is_refused():
    """Its last cubic continued there without a word: a pulse that has decayed grew again."""

    def qubit(times):
        return lt.QuantumSystem([SZ, [SX, np.exp(-3.0 * times)]], times=times)

    step = 0.05
    short, long = qubit(np.linspace(0.0, 0.3, 16)), qubit(np.linspace(-1.0, 2.0, 151))
    x0 = np.asarray(short.state(RHO))
    for span in ((0.0, 0.5), (-0.2, 0.3)):  # the control
        assert np.isfinite(lt.integrate(long, x0, span, step, METHOD).x[-1]).all()
    span = (0.0, 0.1 + 0.1 + 0.1)  # 0.3 and a rounding
    expected = lt.integrate(long, x0, span, step, METHOD).x[-1]
    for run in (
        lambda system, span: lt.integrate(system, x0, span, step, METHOD).x[-1],
        lambda system, span: lt.integrate(system, x0, span, lt.Adaptive(1e-9), METHOD).x[-1],
        lambda system, span: lt.ensemble(system, [x0, x0], span, step, METHOD).x[1],
        lambda system, span: lt.Propagator(system, METHOD, step).final(x0, span),
        lambda system, span: np.asarray(lt.flow(system, x0, span, step, METHOD)),
    ):
        for outside in ((0.0, 0.5), (-0.2, 0.3)):
            with pytest.raises(lt.errors.InputError, match=r"from 0 to 0\.3\. Give its values for the whole span"):
                run(short, outside)
        np.testing.assert_allclose(run(short, span), expected, atol=1e-6)


@pytest.mark.slow
def test_a_pure_state_does_not_lower_the_order():
    """From the ground state, where the gradient of the entropy is infinite, at order 6, beside ``mesolve``.

    Bloch vector by QuTiP 5.3.1, ``mesolve(H, rho, [0, 6], [sqrt(0.25) * lower])``, solver dop853 at 1e-12.
    """
    drive = [-SZ, [0.6 * SX, lambda t: jnp.cos(1.7 * t)]]
    qubit = lt.QuantumSystem(drive, lt.LindbladJumps([(LOWER, 0.25)]))
    expected_values = [0.48273702972652954, -0.4089103911923284, 0.13632498568856344]
    errors = []
    for step in (0.1, 0.05):
        run = lt.integrate(qubit, [1.0, 0.0], (0.0, 6.0), step, METHOD)
        errors.append(np.abs(np.asarray(qubit.bloch(run.x[-1])) - expected_values).max())
    assert errors[1] < 1e-9
    assert errors[0] / errors[1] > 2**5.5


def test_a_rate_that_depends_on_time_is_that_of_mesolve():
    """``[lower, lambda t: sqrt(0.3 * (1 + sin(t) / 2))]`` of QuTiP 5.3.1, at t = 4."""
    rate = lambda t: 0.3 * (1.0 + 0.5 * jnp.sin(t))  # noqa: E731
    qubit = lt.QuantumSystem(-SZ + 0.3 * SX, lt.LindbladJumps([(LOWER, rate)]))
    run = lt.integrate(qubit, [1.0, 0.0], (0.0, 4.0), 0.05, METHOD)
    expected_values = [-0.3410013963251303, -0.1323242925144413, 0.9287665574252146]
    np.testing.assert_allclose(qubit.bloch(run.x[-1]), expected_values, atol=1e-9)


def test_rates_that_depend_on_time_are_those_of_dop853():
    H = 0.5 * SZ + 0.3 * SX
    system = lt.QuantumSystem(H, lt.LindbladJumps([(LOWER, lambda t: 0.2 * (1 + jnp.sin(t))), (SZ, 0.05)]))

    def field(t, v):
        return liouvillian(H, [(LOWER, 0.2 * (1 + np.sin(t))), (SZ, 0.05)]) @ v

    expected_values = scipy.integrate.solve_ivp(
        field, (0.0, 4.0), RHO.ravel().astype(complex), method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    run = lt.integrate(system, system.state(RHO), (0.0, 4.0), 0.02, METHOD)
    np.testing.assert_allclose(system.density(run.x[-1]).ravel(), expected_values, atol=1e-9)
    assert run.audit().passed
    velocity = np.asarray(system.structure.matrix(system.vector_field(system.state(RHO), 1.0)))
    np.testing.assert_allclose(velocity.ravel(), field(1.0, RHO.ravel()), atol=1e-14)
    with pytest.raises(lt.InputError, match="rate of the dissipation of this QuantumSystem depends on time"):
        system.steady_state()
    with pytest.raises(lt.InputError, match="function of the time t"):
        lt.LindbladJumps([(LOWER, lambda omega, T: 1.0)])


def turning_operator(t, numpy=jnp):
    """A jump operator of two frequencies, which is no constant matrix times a rate."""
    return LOWER + 0.5 * numpy.exp(1.3j * t) * SX + 0.2j * numpy.cos(t) * SZ


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("method", "error"), [(METHOD, 1e-9), (lt.KrausMethod(4), 1e-6)], ids=["Gauss", "Kraus"])
def test_jump_operators_that_depend_on_time_are_those_of_dop853(method, error):
    H, rate = 0.5 * SZ + 0.3 * SX, lambda t: 0.2 * (1.5 + jnp.sin(t))
    system = lt.QuantumSystem(H, lt.LindbladJumps([(turning_operator, rate), (SZ, 0.05)]))
    assert system.is_driven

    def field(t, v):
        return liouvillian(H, [(turning_operator(t, np), 0.2 * (1.5 + np.sin(t))), (SZ, 0.05)]) @ v

    rho_by_dop853 = scipy.integrate.solve_ivp(
        field, (0.0, 4.0), RHO.ravel().astype(complex), method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    run = lt.integrate(system, system.state(RHO), (0.0, 4.0), 0.02, method)
    np.testing.assert_allclose(system.density(run.x[-1]).ravel(), rho_by_dop853, atol=error)
    assert np.ptp(run.casimirs["tr(rho)"]) < 1e-13
    audit = run.audit()
    assert audit.passed
    rows = {row.law: row for row in audit.rows}
    assert not any("entropy" in law and row.passed is not None for law, row in rows.items())  # none is promised
    positivity = rows["least eigenvalue of rho"]
    assert positivity.value == pytest.approx(np.linalg.eigvalsh(system.density(run.x)).min(), abs=1e-6)
    assert positivity.passed is (True if isinstance(method, lt.KrausMethod) else None)
    V, A = turning_operator(0.7, np), 0.3 * SX + SZ  # the current of an observable at a time, from its definition
    square = V.conj().T @ V
    expected_current = (0.2 * (1.5 + np.sin(0.7))) * np.trace(
        A @ (V @ RHO @ V.conj().T - 0.5 * square @ RHO - 0.5 * RHO @ square)
    )
    jumps = lt.LindbladJumps([(turning_operator, rate)])
    np.testing.assert_allclose(jumps.current(RHO, A, 0.7), expected_current.real, atol=1e-14)


def test_an_operator_in_a_rotating_frame_has_the_motion_of_the_laboratory():
    """In the frame of G a jump operator V is ``exp(i G t) V exp(-i G t)``; the laboratory's V is constant."""
    G, V, rate = 0.8 * np.diag([1.0, 0.0, -0.6]), np.eye(3, k=1) + np.diag([1.0, -1.0, 0.5]), 0.3
    rho = np.diag([0.2, 0.3, 0.5])
    laboratory = lt.QuantumSystem(G, lt.LindbladJumps([(V, rate)]))
    levels = jnp.asarray(np.diag(G))

    def operator(t):
        return jnp.exp(1j * levels[:, None] * t) * V * jnp.exp(-1j * levels * t)

    frame = lt.QuantumSystem(np.zeros((3, 3)), lt.LindbladJumps([(operator, rate)]))
    end, end_in_frame = (lt.integrate(s, s.state(rho), (0.0, 3.0), 0.05, METHOD).x[-1] for s in (laboratory, frame))
    U = np.diag(np.exp(1j * np.diag(G) * 3.0))
    np.testing.assert_allclose(frame.density(end_in_frame), U @ laboratory.density(end) @ U.conj().T, atol=1e-10)


def test_operators_that_are_no_functions_of_time_are_refused():
    with pytest.raises(lt.InputError, match="returns a Qobj"):
        lt.LindbladJumps([(lambda t: FakeQobj(LOWER), 0.1)])
    with pytest.raises(lt.InputError, match="function of the time t"):
        lt.LindbladJumps([(lambda omega, T: LOWER, 0.1)])
    with pytest.raises(lt.InputError, match="shape"):
        lt.QuantumSystem(SZ, lt.LindbladJumps([(lambda t: jnp.eye(3), 0.1)]))
    frame = lt.RotatingFrame(SZ)
    with pytest.raises(lt.InputError, match="depends on time"):
        frame.jumps([(turning_operator, 0.1)])


@pytest.mark.parametrize(
    ("coefficient", "times", "words"),
    [
        ("cos(w*t)", None, "string 'cos"),
        (np.ones(5), None, "needs times="),
        (np.ones(5), np.arange(4.0), "one for each value"),
        (np.cos, np.arange(4.0), "Remove times="),
    ],
)
def test_coefficients_that_do_not_fit_are_refused(coefficient, times, words):
    with pytest.raises(lt.InputError, match=words):
        lt.QuantumSystem([SZ, [SX, coefficient]], times=times)


def test_states_of_every_shape():
    system, ket = lt.QuantumSystem(SZ), np.array([0.6, 0.8j])
    rho = np.outer(ket, ket.conj())
    for state in (ket, ket[:, None], ket.conj()[None], rho.T.reshape(4, 1), rho.T.reshape(1, 4).conj(), rho):
        np.testing.assert_allclose(system.density(system.state(FakeQobj(state))), rho, atol=1e-15)
        np.testing.assert_allclose(system.density(system.state_array(FakeQobj(state))), rho, atol=1e-15)


def test_collapse_operators_contain_their_rates():
    """``c_ops`` of QuTiP: ``sqrt(rate) V``, or ``[V, f]`` with the rate ``f(t)^2``."""
    jumps = lt.LindbladJumps.from_collapse_operators(
        [FakeQobj(np.sqrt(0.2) * LOWER), [FakeQobj(SZ), lambda t: jnp.sqrt(0.1 * (1 + t))]]
    )
    system, same = (lt.QuantumSystem(SX, d) for d in (jumps, lt.LindbladJumps([(LOWER, 0.2), (SZ, 0.3)])))
    x = system.state(RHO)
    np.testing.assert_allclose(system.vector_field(x, 2.0), same.vector_field(x), atol=1e-15)
    with pytest.raises(lt.InputError, match=r"string 'sqrt\(t\)', which is not evaluated"):
        lt.LindbladJumps.from_collapse_operators([[LOWER, "sqrt(t)"]])
    with pytest.raises(lt.InputError, match=r"such as \[V\]"):
        lt.LindbladJumps.from_collapse_operators(LOWER)


def test_a_function_that_returns_operators_is_refused():
    """As ``QobjEvo`` does; the advice names the form that is read."""
    with pytest.raises(lt.InputError, match=r"returns a Qobj, which JAX cannot trace. Give its terms, \[H0"):
        lt.QuantumSystem(lambda t: FakeQobj(np.cos(t) * SX))


def test_jumps_that_do_not_fit_are_refused():
    with pytest.raises(lt.InputError, match="shape"):
        lt.QuantumSystem(SZ, lt.LindbladJumps([(np.eye(3), 0.1)]))
    with pytest.raises(lt.InputError, match="list of pairs"):
        lt.LindbladJumps([LOWER])


def test_heat_currents_balance_at_rest_and_produce_entropy():
    T = np.array([0.5, 2.0])
    jumps = [lt.ThermalJumps([(LOWER, 0.1)], bath=i) for i in range(2)]
    qubit = lt.QuantumSystem(np.diag([0.0, 1.3]), jumps, baths=lt.HeatBaths(np.inf, T, 2))
    x = qubit.steady_state().x
    currents = np.asarray(qubit.heat_currents(x))
    assert currents[1] > 0.0  # from the hot bath
    np.testing.assert_allclose(currents.sum(), 0.0, atol=1e-15)
    np.testing.assert_allclose(qubit.entropy_production(x), -np.sum(currents / T), rtol=1e-12)


def coupled_qubits(g: float):
    """Return two qubits between two baths with local and with global dissipation, and the local jumps."""
    H = np.kron(np.diag([0.0, 1.0]), np.eye(2)) + np.kron(np.eye(2), np.diag([0.0, 1.0]))
    H = H + g * (np.kron(LOWER, LOWER.T) + np.kron(LOWER.T, LOWER))
    couplings, T, rate = (np.kron(LOWER, np.eye(2)), np.kron(np.eye(2), LOWER)), (2.0, 0.5), 0.01
    jumps = [lt.ThermalJumps([(V, rate)], bath=i) for i, V in enumerate(couplings)]
    whole = lt.QuantumSystem(H, jumps, baths=lt.HeatBaths(np.inf, T, 2), parts=(2, 2))
    pairs = [[(V, rate * np.exp(0.5 / t)), (V.T, rate * np.exp(-0.5 / t))] for V, t in zip(couplings, T, strict=True)]
    part = lt.QuantumSystem(H, lt.LindbladJumps([pair for bath in pairs for pair in bath]), parts=(2, 2))
    return H, whole, part, pairs


def current_of(H, rho, pairs) -> float:
    """Return ``tr(H D(rho))`` of the jumps of one bath."""
    D = liouvillian(np.zeros_like(H), pairs)
    return np.trace(H @ (D @ rho.ravel()).reshape(H.shape)).real


@pytest.mark.slow
def test_local_and_global_dissipation_differ_where_the_coupling_is_weak():
    """Local currents vanish with ``g^2``; global ones do not [Levy & Kosloff 2014; Hofer et al. 2017]."""
    for g in (0.1, 1e-3):
        H, whole, part, pairs = coupled_qubits(g)
        global_current = float(whole.heat_currents(whole.steady_state().x)[0])
        rho = np.asarray(part.density(part.steady_state().x))
        L = liouvillian(H, [pair for bath in pairs for pair in bath])
        _, _, vectors = np.linalg.svd(L)
        kernel = vectors[-1].conj().reshape(4, 4)
        np.testing.assert_allclose(rho, kernel / np.trace(kernel), atol=1e-12)
        local_current = current_of(H, rho, pairs[0])
        if g == 0.1:
            assert abs(local_current / global_current - 1.0) < 0.1
        else:
            assert local_current < 0.05 * global_current


def test_qutip_agrees():
    qutip = pytest.importorskip("qutip")
    H, jumps, times = SZ + 0.3 * SX, [(LOWER, 0.2)], np.linspace(0.0, 3.0, 4)
    c_ops = [np.sqrt(rate) * qutip.Qobj(V) for V, rate in jumps]
    options = {"atol": 1e-12, "rtol": 1e-11}
    result = qutip.mesolve(qutip.Qobj(H), qutip.Qobj(RHO), times, c_ops, options=options)
    system = lt.QuantumSystem(qutip.Qobj(H), lt.LindbladJumps(jumps))
    run = lt.integrate(system, system.state(qutip.Qobj(RHO)), (0.0, 3.0), 0.02, METHOD)
    np.testing.assert_allclose(system.density(run.x[-1]), result.states[-1].full(), atol=1e-9)
