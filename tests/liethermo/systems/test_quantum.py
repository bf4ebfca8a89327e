"""Density matrices beside Lindblad's equation, closed forms and programs of their own; both laws; what is refused."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import liethermo as lt
import manifolds as mf
from liethermo.functions.gradients import EPS
from liethermo.systems.transport import generator_field
from tests.cases import covering, few_combinations
from tests.liethermo.systems.qubits import (
    FULL,
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
    motion,
    qubit,
    random_density,
    random_hermitian,
    solve_by_scipy,
)


@pytest.mark.slow
def test_the_structure_is_that_of_the_dual_of_unitary_matrices():
    structure, g = mf.DensityMatrices(3), mf.u(3)
    rho, H = random_density(3), random_density(3, 1)
    x, alpha = structure.vector(rho), structure.vector(H)
    assert np.abs(structure.matrix(structure.sharp(x, alpha)) + 1j * (H @ rho - rho @ H)).max() <= 1e-15
    assert float(structure.jacobi_residual(x)) <= 1e-14
    C = -1j * (H @ rho - rho @ H)
    element = g.vee(1j * H)
    dual, moved = ([np.trace((1j * m).conj().T @ e).real for e in g.basis] for m in (rho, C))
    assert np.abs(g.ad_star(element, np.array(dual)) - np.array(moved)).max() <= 1e-14


@pytest.mark.sampled(1)
@pytest.mark.parametrize("n", [2, 3, 4])
def test_at_a_constant_temperature_it_is_lindblads_equation(n):
    H = np.diag(np.cumsum(np.arange(n) * 0.7 + 0.3)).astype(complex)
    V = np.diag(np.sqrt(np.arange(1.0, n)), 1).astype(complex)  # of several frequencies
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, RATE)]), baths=infinite())
    rho, jumps = random_density(n), []
    for i in range(n - 1):
        part, omega = np.zeros((n, n), complex), (H[i + 1, i + 1] - H[i, i]).real
        part[i, i + 1] = V[i, i + 1]
        jumps += [(part, RATE * np.exp(omega / (2 * T))), (part.T, RATE * np.exp(-omega / (2 * T)))]
    assert np.abs(motion(q, rho) - lindblad(rho, H, jumps)).max() <= 1e-14
    assert q.check().passed


def test_a_hermitian_coupling_acts_once_and_a_rate_may_depend_on_frequency_and_temperature():
    H, rho = QUBIT, RHO
    bosons = lambda omega, T: 0.1 / (2 * jnp.sinh(omega / (2 * T)))  # noqa: E731
    q = lt.QuantumSystem(H, lt.ThermalJumps([(X, bosons)]), baths=infinite())
    n = 1 / np.expm1(1.3 / T)
    assert np.abs(motion(q, rho) - lindblad(rho, H, [(LOWER, 0.1 * (n + 1)), (LOWER.T, 0.1 * n)])).max() <= 1e-15
    raising = lt.QuantumSystem(H, lt.ThermalJumps([(LOWER.T, bosons)]), baths=infinite())  # at a positive omega too
    assert np.array_equal(motion(raising, rho), motion(q, rho))
    both = lt.QuantumSystem(H, lt.ThermalJumps([(Z, 0.3)]), baths=infinite())
    assert np.abs(motion(both, rho) - lindblad(rho, H, [(Z, 0.3)])).max() <= 1e-15


def test_a_qubit_beside_its_closed_form():
    """T1, T2 and the frequency."""
    q, t = qubit(), 20.0
    solution = lt.integrate(q, q.state(RHO), (0.0, t), 0.05, lt.MetriplecticGauss(4))
    rho = np.asarray(q.density(solution.x[-1]))
    fast = RATE * 2 * np.cosh(1.3 / (2 * T))
    rest = np.tanh(1.3 / (2 * T))
    population = rest + (RHO[0, 0] - RHO[1, 1]).real * np.exp(-fast * t) - rest * np.exp(-fast * t)
    assert abs((rho[0, 0] - rho[1, 1]).real - population) <= 1e-11
    assert abs(rho[0, 1] - RHO[0, 1] * np.exp(1.3j * t - fast * t / 2)) <= 1e-11
    audit = solution.audit()
    assert audit.passed
    assert audit.energy_drift <= 1e-13


SYSTEMS = {
    "a constant temperature": lambda: lt.QuantumSystem(
        random_hermitian(3), lt.ThermalJumps([(FULL, RATE)]), infinite()
    ),
    "two finite baths": lambda: lt.QuantumSystem(
        random_hermitian(3),
        [lt.ThermalJumps([(FULL, RATE)]), lt.ThermalJumps([(FULL.T, 0.1)], bath=1)],
        lt.HeatBaths(capacity=[0.8, 2.0], temperature=[T, 1.1], number=2),
    ),
    "no bath": lambda: lt.QuantumSystem(
        random_hermitian(3), lt.ThermalJumps([(FULL, RATE), (np.diag([1, 2, 4]), 0.3)])
    ),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_generator_is_the_force_at_the_gradients(name):
    """The form without the entropy, for Hamiltonians and couplings of no special form."""
    q = SYSTEMS[name]()
    for x in map(jnp.asarray, q.samples(2, 3)):
        wanted = q.field(x, q.energy.gradient(x), q.entropy.gradient(x))
        assert np.abs(generator_field(q, x) - wanted).max() <= 1e-12 * np.abs(wanted).max()  # measured: at most 2e-14


def test_the_entropy_has_a_discrete_gradient_in_closed_form():
    """The change of the entropy is right to rounding relative to the step, however short that is."""
    S = lt.VonNeumann()
    structure = mf.DensityMatrices(3)
    x, other = (structure.vector(random_density(3, seed)) for seed in (1, 2))
    for share in (1.0, 1e-3, 1e-9):
        d = share * (other - x)
        found = S.discrete_gradient(None, x, d, jnp.zeros_like(x))
        if share > 1e-4:
            assert float(found @ d) == pytest.approx(float(S.value(x + d) - S.value(x)), rel=1e-11)
        else:  # the difference of the values has no digit of the second order left
            middle = S.gradient(x + 0.5 * d)
            assert float(found @ d) == pytest.approx(float(middle @ d), rel=1e-12)
    assert np.abs(S.discrete_gradient(None, x, 0.0 * x, 0.0 * x) - S.gradient(x)).max() <= 1e-13


METHODS = {
    "midpoint": (lt.MetriplecticMidpoint(), 2, (0.4, 0.2, 0.1)),
    "Gauss 2": (lt.MetriplecticGauss(2), 4, (0.8, 0.4, 0.2)),
    "Gauss 3": (lt.MetriplecticGauss(3), 6, (0.3, 0.2, 0.15)),
    "explicit 4": (lt.MetriplecticRungeKutta(4), 4, (0.4, 0.2, 0.1)),
    "explicit 6": (lt.MetriplecticRungeKutta(6), 6, (0.8, 0.4, 0.2)),
    "explicit 8": (lt.MetriplecticRungeKutta(8), 8, (0.6, 0.3)),
    "Taylor 5": (lt.MetriplecticTaylor(5), 5, (0.1, 0.05, 0.025)),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", METHODS)
def test_orders(name):
    """With a bath of finite heat capacity, so that nothing is linear, beside SciPy."""
    method, order, steps = METHODS[name]
    q = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, RATE)]), baths=lt.HeatBaths(capacity=0.8, temperature=T))
    x0 = q.state(RHO)
    rho, y = solve_by_scipy(np.asarray(RHO, complex), 0.8, 2.4)
    exact = q.state(rho / np.trace(rho), entropies=[y])
    errors = [np.abs(lt.integrate(q, x0, (0.0, 2.4), h, method).x[-1] - exact).max() for h in steps]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert np.abs(slopes - order).max() <= 0.35


def test_a_finite_bath():
    """Energy of the whole, an entropy that never falls, and the state of Gibbs at the temperature that both reach."""
    H = np.diag([0.0, 1.0, 2.7]).astype(complex)
    V = np.diag([1.0, 1.0], 1).astype(complex)
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, 0.4)]), baths=lt.HeatBaths(capacity=5.0, temperature=1.0))
    solution = lt.integrate(q, q.state(random_density(3)), (0.0, 60.0), 0.2, lt.MetriplecticGauss(2))
    audit = solution.audit()
    assert audit.passed
    assert audit.energy_drift <= 1e-13
    assert np.diff(solution.entropy).min() >= -1e-15
    temperature = float(q.temperatures(solution.x[-1])[0])
    gibbs = scipy.linalg.expm(-H / temperature)
    assert np.abs(q.density(solution.x[-1]) - gibbs / np.trace(gibbs)).max() <= 1e-9
    assert np.abs(np.trace(q.density(solution.x), axis1=-2, axis2=-1) - 1.0).max() <= 1e-14


TWO = [lt.ThermalJumps([(FULL[:2, :2], RATE)]), lt.ThermalJumps([(FULL[1:, 1:], 0.1)], bath=1)]
QUANTUM_SYSTEMS = {
    "no dissipation": lambda: levels(3, None),
    "an infinite bath": lambda: levels(3, lt.ThermalJumps([(FULL, RATE)]), infinite()),
    "a finite bath": lambda: levels(2, TWO[0], lt.HeatBaths(capacity=0.8, temperature=T)),
    "two infinite baths": lambda: levels(2, TWO, lt.HeatBaths(capacity=[np.inf] * 2, temperature=[T, 1.1], number=2)),
    "two finite baths": lambda: levels(2, TWO, lt.HeatBaths(capacity=[0.8, 2.0], temperature=[T, 1.1], number=2)),
    "dephasing": lambda: levels(3, lt.ThermalJumps([(random_hermitian(3) @ random_hermitian(3), 0.05)])),
    "unital noise": lambda: levels(3, lt.ThermalJumps([(FULL, 0.1)])),
    "steepest ascent": lambda: levels(3, lt.SteepestEntropyAscent(0.4)),
    "steepest ascent with a floor": lambda: lt.QuantumSystem(
        random_hermitian(3), lt.SteepestEntropyAscent(0.4), entropy=lt.VonNeumann(floor=1e-12)
    ),
}
STEPS = {
    "Taylor": lt.MetriplecticTaylor(8),
    "midpoint": lt.MetriplecticMidpoint(),
    "explicit": lt.MetriplecticRungeKutta(4),
    "Gauss": lt.MetriplecticGauss(2),
}
SYSTEM_METHOD_PAIRS = [
    (name, by)
    for name in QUANTUM_SYSTEMS
    for by in STEPS
    if by != "Taylor" or not name.startswith("steepest")  # refused: no series of the entropy
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "by"),
    covering(SYSTEM_METHOD_PAIRS, lambda name, by: [(name, STEPS[by].explicit), by]),
)
def test_every_dissipation_keeps_its_laws_by_every_method(name, by):
    """From random states; and from one next to a pure state, at which steps may be refused."""
    q = QUANTUM_SYSTEMS[name]()
    size = q.structure.size
    pure = np.array([0.6, 0.8j, 0.0])[:size]
    states = [
        q.state(0.999 * np.outer(pure, pure.conj()) + 0.001 * random_density(size, 9)),  # no two eigenvalues are equal
        *(q.state(0.7 * random_density(size, i) + 0.3 * np.eye(size) / size) for i in range(5)),
    ]
    many = lt.ensemble(q, np.stack(states), (0.0, 3.0), 0.05, STEPS[by], outputs="trajectory")
    assert many.ok[1:].all()
    for i, kept in enumerate(np.isfinite(many.x).all(axis=2)):
        assert many.ok[i] or "step" in many.message(i)
        x, E, S = many.x[i, kept], many.energy[i, kept], many.entropy[i, kept]
        rho = np.asarray(q.density(x))
        assert np.array_equal(rho, rho.conj().swapaxes(-1, -2))
        assert np.abs(np.trace(rho, axis1=-2, axis2=-1) - 1.0).max() <= 1e-13
        keeps_eigenvalues = q.dissipation is not None or "entropy" not in many.laws.inexact
        assert not keeps_eigenvalues or np.linalg.eigvalsh(rho).min() >= -1e-14
        assert q.energy_law is None or np.abs(E - E[0]).max() <= 1e-13
        if not keeps_eigenvalues:  # the midpoint scheme without dissipation keeps linear and quadratic Casimirs only
            assert not many.audit().passed, "the audit says that the entropy changes"
        if q.entropy_law == "nondecreasing":
            assert np.diff(S).min(initial=0.0) >= -2e-15
        elif "entropy" not in many.laws.inexact:  # rounding of the state, times the gradient: steep next to a pure one
            steep = np.linalg.norm(q.entropy.gradient(many.x[i, 0])) * np.linalg.norm(many.x[i, 0])
            assert np.abs(np.diff(S)).max(initial=0.0) <= max(2e-15, 2.0 * EPS * steep)


def steepest(rho, H, rate, others=()):
    """Steepest ascent by a program of its own: a Gram determinant in place of a projector."""
    p, u = np.linalg.eigh(rho)
    S = -(u * np.log(p)) @ u.conj().T
    span = [np.eye(len(H)), H, *others]

    def product(A, B):
        return 0.5 * np.trace(rho @ (A @ B + B @ A)).real

    gram = np.array([[product(A, B) for B in span] for A in span])
    multipliers = np.linalg.solve(gram, [product(A, S) for A in span])
    D = S - sum(m * A for m, A in zip(multipliers, span, strict=True))
    return -1j * (H @ rho - rho @ H) + rate * 0.5 * (rho @ D + D @ rho)


def test_steepest_ascent_beside_a_program_of_its_own():
    H, rho, N = np.diag([0.0, 1.0, 2.5]).astype(complex), random_density(3), np.diag([1.0, 0.0, 1.0]).astype(complex)
    q = lt.QuantumSystem(H, lt.SteepestEntropyAscent(0.4, preserve=[N]))
    assert np.abs(motion(q, rho) - steepest(rho, H, 0.4, [N])).max() <= 1e-14

    def field(t, y):
        r = (y[:9] + 1j * y[9:]).reshape(3, 3)
        d = steepest(r, H, 0.4, [N]).ravel()
        return np.concatenate([d.real, d.imag])

    y0 = np.concatenate([rho.ravel().real, rho.ravel().imag])
    y = scipy.integrate.solve_ivp(field, (0, 4.0), y0, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    solution = lt.integrate(q, q.state(rho), (0.0, 4.0), 0.1, lt.MetriplecticGauss(3))
    assert np.abs(q.density(solution.x[-1]) - (y[:9] + 1j * y[9:]).reshape(3, 3)).max() <= 1e-9
    assert np.ptp(q.expectation(solution.x, N)) <= 1e-13
    assert solution.audit().passed


@pytest.mark.slow
def test_steepest_ascent_keeps_the_rank():
    """By the midpoint scheme, which adds nothing to the motion, to rounding; by others to their order."""
    H = np.diag([0.0, 1.0, 2.5, 3.1]).astype(complex)
    q = lt.QuantumSystem(H, lt.SteepestEntropyAscent(0.4), entropy=lt.VonNeumann(floor=1e-12))
    rho = np.zeros((4, 4), complex)
    rho[:3, :3] = random_density(3)
    solution = lt.integrate(q, q.state(rho), (0.0, 2.0), 0.05, lt.MetriplecticMidpoint())
    least = np.linalg.eigvalsh(q.density(solution.x))[:, 0]
    assert np.abs(least).max() <= 1e-15
    assert solution.audit().energy_drift <= 1e-13
    assert np.diff(solution.entropy).min() > 0.0


def test_noise_without_a_bath():
    dephasing = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(Z, 0.3)]))
    assert dephasing.energy_law == "conserved"
    assert np.abs(motion(dephasing, RHO) - lindblad(RHO, QUBIT, [(Z, 0.3)])).max() <= 1e-15
    turning = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(X, 0.3)]))
    assert turning.energy_law is None
    assert turning.entropy_law == "nondecreasing"
    assert np.abs(motion(turning, RHO) - lindblad(RHO, QUBIT, [(X, 0.3)])).max() <= 1e-15


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(1), lt.MetriplecticGauss(2)], ids=str
)
def test_noise_without_a_bath_at_the_order_of_the_method(method):
    """Nothing but the trace is kept: neither the energy nor the entropy is taken off the force."""
    q = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(X, 0.3)]))

    def field(t, y):
        rate = lindblad(y.reshape(2, 2), QUBIT, [(X, 0.3)])
        return rate.ravel()

    exact = scipy.integrate.solve_ivp(field, (0.0, 1.6), RHO.ravel(), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    runs = [lt.integrate(q, q.state(RHO), (0.0, 1.6), h, method) for h in (0.2, 0.1)]
    assert all(run.audit().passed for run in runs)
    errors = [np.abs(q.density(run.x[-1]) - exact.reshape(2, 2)).max() for run in runs]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=0.2)


def test_a_system_is_prepared_once():
    """Numbers that could change in place are not remembered: each run would trace the series of the field again."""
    ascent = lt.QuantumSystem(QUBIT, lt.SteepestEntropyAscent(0.4, preserve=[Z]))
    for q in (qubit(), ascent):
        assert not any(isinstance(leaf, np.ndarray) for leaf in jax.tree_util.tree_leaves(q))


@pytest.mark.slow
def test_a_hamiltonian_in_terms_is_the_function_that_they_make():
    """Constant terms, pairs in tuples and in lists; and amplitudes of an ensemble, which a function hides."""
    H0, H1, H2 = (random_hermitian(3, seed) for seed in (1, 2, 3))
    by_terms = lt.QuantumSystem([H0, (H1, jnp.cos), [H2, lambda t: 0.3 * t], 0.5 * H0])
    by_function = lt.QuantumSystem(lambda t: 1.5 * H0 + jnp.cos(t) * H1 + 0.3 * t * H2)
    x = by_terms.state(random_density(3))
    ends = [lt.integrate(q, x, (0.0, 2.0), 0.1, lt.MetriplecticMidpoint()) for q in (by_terms, by_function)]
    assert np.abs(ends[0].x - ends[1].x).max() <= 1e-14
    assert np.abs(ends[0].energy - ends[1].energy).max() <= 1e-14
    assert not lt.QuantumSystem([H0, H1]).is_driven
    assert np.array_equal(
        lt.QuantumSystem([H0, H1]).hamiltonians_at_test_times()[0],
        lt.QuantumSystem(H0 + H1).hamiltonians_at_test_times()[0],
    )
    assert not lt.QuantumSystem([[0.0, 1.0], [1.0, 0.0]]).is_driven

    def driven(amplitude):
        return lt.QuantumSystem([QUBIT, (X, lambda t: amplitude * jnp.cos(t))])

    x = driven(0.4).state(RHO)
    many = lt.ensemble(driven, x, (0.0, 1.0), 0.1, lt.MetriplecticMidpoint(), parameters=np.array([0.1, 0.4]))
    alone = lt.integrate(driven(0.4), x, (0.0, 1.0), 0.1, lt.MetriplecticMidpoint())
    assert np.abs(many.x[1] - alone.x[-1]).max() <= 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2)], ids=str)
def test_newtons_method_takes_the_derivative_of_the_generator(method):
    """The slopes differ from it by the order of the method; the control: the identity alone is far off."""
    q = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, RATE)]), baths=lt.HeatBaths(capacity=0.8, temperature=T))
    x, h, off = q.state(RHO), 0.05, jnp.zeros(q.dim)
    k = jnp.tile(q.vector_field(x), (method.stages, 1))
    d = jnp.cos(jnp.arange(float(k.size))).reshape(k.shape)
    by_slopes = functools.partial(lt.integrators.base.OneStepMethod.residual_jvp, method)
    found, wanted = (
        np.asarray(jax.jit(lambda k, d, made=made: made(q, x, off, h, k)(d))(k, d))
        for made in (method.residual_jvp, by_slopes)
    )
    assert np.abs(found - wanted).max() <= 0.1 * np.abs(wanted + d).max()


def test_tables_of_unknowns_are_no_tables_of_parameters():
    """Three stages of sixteen numbers are more than the parameters, beside which the compiled loop looked them up."""
    H, V = np.diag(np.arange(4.0)), np.diag(np.sqrt(np.arange(1.0, 4.0)), 1)
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, 0.1)]), baths=infinite())
    assert lt.integrate(q, q.state(random_density(4)), (0.0, 0.2), 0.1, lt.MetriplecticGauss(3)).audit().passed


def test_products_and_partial_traces():
    one = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, 0.3)]), baths=infinite(1.0), names=["A"])
    other = lt.QuantumSystem(2 * QUBIT, lt.ThermalJumps([(LOWER, 0.2)]), baths=infinite(0.5), names=["B"])
    both = one * other
    a, b = random_density(2, 3), random_density(2, 4)
    x = both.state(np.kron(a, b))
    assert np.abs(both.reduced(x, "A") - a).max() <= 1e-15
    assert np.abs(both.reduced(x, 1) - b).max() <= 1e-15
    rate = both.structure.matrix(both.vector_field(x)[:16])
    apart = np.kron(motion(one, a), b) + np.kron(a, motion(other, b))
    assert np.abs(rate - apart).max() <= 1e-15
    linked = both.coupled(0.2 * (np.kron(LOWER, LOWER.T) + np.kron(LOWER.T, LOWER)))
    assert linked.check().passed
    assert linked.baths.number == 2


def test_a_hamiltonian_that_depends_on_time():
    """The work is in the ledger; jumps follow the frequency of the moment."""
    H = lambda t: (1.0 + 0.2 * t) * jnp.asarray(QUBIT)  # noqa: E731
    q = lt.QuantumSystem(H, lt.ThermalJumps([(LOWER, RATE)]), baths=infinite())
    rate = q.structure.matrix(q.vector_field(q.state(RHO), t=1.0)[:4])
    omega = 1.2 * 1.3
    jumps = [(LOWER, RATE * np.exp(omega / (2 * T))), (LOWER.T, RATE * np.exp(-omega / (2 * T)))]
    assert np.abs(rate - lindblad(RHO, 1.2 * QUBIT, jumps)).max() <= 1e-15
    solution = lt.integrate(q, q.state(RHO), (0.0, 3.0), 0.1)
    assert solution.audit().passed
    assert np.diff(solution.entropy).min() >= -1e-15
    with pytest.raises(lt.InputError, match="eigenvectors of the Hamiltonian depend on time"):
        lt.QuantumSystem(lambda t: jnp.cos(t) * Z + jnp.sin(t) * X, lt.ThermalJumps([(LOWER, 0.1)]), baths=infinite())


def test_a_step_that_leaves_the_cone_is_refused():
    q = lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, 50.0)]), baths=infinite(0.1))
    x, span, method = q.state(np.diag([0.02, 0.98]).astype(complex)), (0.0, 0.01), lt.MetriplecticRungeKutta(4)
    solution = lt.integrate(q, x, (0.0, 1.0), 0.5, method, on_failure="return")
    assert not solution.status.ok
    assert "outside the cone of positive matrices" in solution.status.message
    shortened = lt.integrate(q, x, span, lt.Adaptive(1e-8, first=0.01), method)
    assert shortened.status.ok
    assert np.linalg.eigvalsh(q.density(shortened.x)).min() > 0.0


def test_taylor_steps_need_a_motion_without_the_entropy():
    """Lindblad's equation has series of every order; steepest ascent has a logarithm of the matrix in it."""
    q = lt.QuantumSystem(QUBIT, lt.SteepestEntropyAscent(0.4))
    with pytest.raises(lt.InputError, match=r"'matrix_chain' has no rule .* take lt.MetriplecticRungeKutta"):
        lt.integrate(q, q.state(RHO), (0.0, 1.0), 0.1, lt.MetriplecticTaylor(12))


def meeting(size, gap):
    """A density matrix with an eigenvalue 0.7, and others that are equal but for two of them, a gap apart."""
    p = np.append(np.full(size - 1, 0.3 / (size - 1)), 0.7)
    p[:2] += 0.15 * gap / (size - 1) * np.array([1.0, -1.0])
    vectors = np.linalg.qr(random_hermitian(size, 5))[0]
    return (vectors * p) @ vectors.conj().T


GAPS = [0.0, 1e-12, 1e-8, 1e-4, 0.3]


@pytest.mark.sampled(1)
@few_combinations(
    size=[2, 3, 4, 8],
    method=[*map(lt.MetriplecticGauss, (2, 1, 3)), lt.MetriplecticTaylor(8), *map(lt.MetriplecticRungeKutta, (4, 8))],
)
def test_an_isolated_system_keeps_its_spectrum_where_eigenvalues_meet(method, size):
    """There the gradients of trace, purity and entropy depend on each other, and the entropy touches its level.

    Steps do not use them: they go along the orbit.
    """
    q = levels(size, None)
    states = np.stack([q.state(meeting(size, gap)) for gap in GAPS])
    many = lt.ensemble(q, states, (0.0, 2.0), 0.02, method, outputs="trajectory")
    assert many.ok.all(), [many.message(i) for i in np.flatnonzero(~many.ok)]
    p = np.linalg.eigvalsh(q.density(many.x))
    assert max(np.ptp(many.entropy, axis=1).max(), np.ptp(many.energy, axis=1).max()) <= 4e-15  # measured: 2.7e-15
    assert max(np.ptp(p.sum(axis=2), axis=1).max(), np.ptp((p**2).sum(axis=2), axis=1).max()) <= 5e-15
    assert np.ptp(p, axis=1).max() <= 4e-15


@pytest.mark.slow
def test_adaptive_steps_where_eigenvalues_meet():
    for method in (lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(12)):
        q = levels(4, None)
        for gap in GAPS:
            run = lt.integrate(q, q.state(meeting(4, gap)), (0.0, 2.0), lt.Adaptive(1e-9), method)
            assert run.audit().passed
            assert np.ptp(run.entropy) <= 4e-15


def test_midpoint_steps_keep_trace_purity_and_energy_where_eigenvalues_meet():
    """And the entropy to their order: it is no quadratic function."""
    q, drifts = levels(3, None), []
    for h in (0.1, 0.05):
        run = lt.integrate(q, q.state(meeting(3, 0.5)), (0.0, 2.0), h, lt.MetriplecticMidpoint())
        assert max(np.ptp(run.casimirs[name]) for name in ("tr(rho)", "tr(rho^2)")) <= 1e-15
        assert np.ptp(run.energy) <= 2e-15
        drifts.append(np.ptp(run.entropy))
    assert drifts[0] >= 1e-6  # the control: Gauss steps of one stage keep it
    run = lt.integrate(q, q.state(meeting(3, 0.5)), (0.0, 2.0), 0.1, lt.MetriplecticGauss(1))
    assert np.ptp(run.entropy) <= 4e-15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "steps"),
    [
        (lt.MetriplecticGauss(2), (0.1, 0.05)),
        (lt.MetriplecticRungeKutta(6), (0.2, 0.1)),
        pytest.param(lt.MetriplecticRungeKutta(4), (0.1, 0.05), marks=pytest.mark.slow),
        pytest.param(lt.MetriplecticTaylor(8), (0.25, 0.125), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_driven_isolated_system_keeps_its_spectrum(method, steps):
    q = lt.QuantumSystem([random_hermitian(3, 1), (random_hermitian(3, 2), jnp.cos)])
    rho = meeting(3, 0.0)

    def field(t, y):
        H = random_hermitian(3, 1) + np.cos(t) * random_hermitian(3, 2)
        return lindblad(y.reshape(3, 3), H, []).ravel()

    exact = scipy.integrate.solve_ivp(field, (0.0, 2.0), rho.ravel(), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    runs = [lt.integrate(q, q.state(rho), (0.0, 2.0), h, method) for h in steps]
    errors = [np.abs(q.density(run.x[-1]) - exact.reshape(3, 3)).max() for run in runs]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=0.2)
    for run in runs:
        assert run.audit().passed
        assert np.ptp(np.linalg.eigvalsh(q.density(run.x)), axis=0).max() <= 3e-15


@pytest.mark.slow
def test_long_taylor_steps_obey_both_laws():
    q, t = qubit(), 100.0
    solution = lt.integrate(q, q.state(RHO), (0.0, t), 4.0, lt.MetriplecticTaylor(24))
    audit, rho = solution.audit(), np.asarray(q.density(solution.x[-1]))
    assert audit.passed
    assert audit.energy_drift <= 1e-15
    assert np.diff(solution.entropy).min() >= -1e-15
    fast, rest = RATE * 2 * np.cosh(1.3 / (2 * T)), np.tanh(1.3 / (2 * T))
    assert abs((rho[0, 0] - rho[1, 1]).real - rest - ((RHO[0, 0] - RHO[1, 1]).real - rest) * np.exp(-fast * t)) <= 1e-13


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", [lt.MetriplecticRungeKutta(6), lt.MetriplecticGauss(2)], ids=str)
def test_a_constant_that_is_added_to_the_energy_changes_nothing(method):
    runs = [
        lt.integrate(lt.QuantumSystem(random_hermitian(2) + shift * np.eye(2)), RHO, (0.0, 1.0), 0.1, method)
        for shift in (0.0, 1e4)
    ]
    assert np.abs(runs[0].x - runs[1].x).max() <= 1e-11
    assert runs[1].audit().resolved


def test_couplings_and_products_keep_the_floor_of_the_entropy():
    floor = lt.VonNeumann(floor=1e-10)
    q = lt.QuantumSystem(QUBIT, lt.SteepestEntropyAscent(0.2), entropy=floor)
    assert q.coupled(0.1 * Z).entropy == floor
    assert (lt.QuantumSystem(QUBIT, entropy=floor) * lt.QuantumSystem(QUBIT)).entropy == floor


@pytest.mark.slow
def test_eigenvectors_of_larger_matrices_are_those_of_lapack():
    """In programs of the array engine too, where a loop of rotations takes much longer."""
    H, V = np.diag(np.arange(8.0)), np.diag(np.sqrt(np.arange(1.0, 8.0)), 1)  # of one frequency: a table of many terms
    q = lt.QuantumSystem(H, lt.ThermalJumps([(V, 0.1)]), baths=infinite())
    rho = random_density(8)
    jumps = [(V, 0.1 * np.exp(0.5 / T)), (V.T, 0.1 * np.exp(-0.5 / T))]
    assert np.abs(motion(q, rho) - lindblad(rho, H, jumps)).max() <= 1e-14
    text = jax.jit(q.entropy.value).lower(q.state(rho)[:64]).as_text()
    assert "lapack" in text
    assert "while" not in text


@pytest.mark.slow
def test_many_qubits_reach_the_gibbs_states_of_their_baths():
    """Each with a temperature and a rate of its own."""

    def member(p):
        return lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, p["rate"])]), infinite(p["temperature"]))

    rng, number = np.random.default_rng(0), 1000
    parameters = {"rate": rng.uniform(0.1, 0.4, number), "temperature": rng.uniform(0.4, 2.0, number)}
    x0s = np.pad(np.asarray(qubit().structure.vector(np.stack([random_density(2, i) for i in range(number)]))), (0, 1))
    many = lt.ensemble(member, x0s[:-1], (0.0, 250.0), 2.5, lt.MetriplecticTaylor(20), parameters=parameters)
    assert many.audit().passed
    assert many.energy_drift.max() <= 1e-14
    weights = np.exp(-np.outer(1.0 / parameters["temperature"], np.diag(QUBIT).real))
    gibbs = np.eye(2) * (weights / weights.sum(axis=1, keepdims=True))[:, None, :]
    assert np.abs(qubit().density(many.x) - gibbs).max() <= 1e-9


EVENT_CASES = {
    "midpoint": (lt.MetriplecticMidpoint(), 0.05, 1e-3),
    "explicit": (lt.MetriplecticRungeKutta(8), 0.05, 1e-12),
    "Taylor": (lt.MetriplecticTaylor(12), 0.25, 1e-12),
    "adaptive": (lt.MetriplecticRungeKutta(8), lt.Adaptive(1e-11), 1e-9),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EVENT_CASES)
def test_a_run_stops_where_a_population_or_the_purity_has_a_value(name):
    """Beside the closed form of the population, which falls to 0.3, and the purity of the last state."""
    (method, step, within), q = EVENT_CASES[name], qubit()
    start = np.array([[0.1, 0.1], [0.1, 0.9]])
    fast, rest = RATE * 2 * np.cosh(1.3 / (2 * T)), np.exp(-1.3 / T) / (1.0 + np.exp(-1.3 / T))
    time = np.log((0.9 - rest) / (0.3 - rest)) / fast
    run = lt.integrate(q, start, (0.0, 50.0), step, method, until=lambda x: x[1] - 0.3)
    assert run.status.code == "event"
    assert abs(run.t[-1] - time) <= within
    assert abs(q.density(run.x[-1])[1, 1].real - 0.3) <= 1e-13
    assert run.audit().passed

    def purity(x):
        rho = q.density(x)
        return jnp.sum(jnp.abs(rho) ** 2) - 0.6

    many = lt.ensemble(q, np.stack([start, RHO]), (0.0, 50.0), step, method, until=purity)
    assert many.ok.all()
    rho = np.asarray(q.density(many.x))
    assert np.abs(np.sum(np.abs(rho) ** 2, axis=(1, 2)) - 0.6).max() <= 1e-13
    alone = lt.integrate(q, start, (0.0, 50.0), step, method, until=purity)
    assert abs(many.event_time[0] - alone.event_time) <= 1e-12
