"""The Lagrangian side: Herglotz' equations, the Legendre transform, and the discrete Herglotz integrator."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from tests.cases import tolerance

GAMMA = 0.1
OSCILLATOR = lt.Quadratic([-1.0, 1.0, 0.0], [0.0, 0.0, -GAMMA])
"""SML Example 7: ``L = v^2/2 - q^2/2 - gamma S``."""


def mass(q):
    return jnp.array([[2.0 + jnp.sin(q[1]), 0.3], [0.3, 1.5]])


def warm(q, S):
    return 0.5 * q @ q * jnp.exp(-S / 5) + jnp.cos(jnp.sum(q)) + S


def coupled_lagrangian(x):
    """No kinetic minus potential energy: v, q and S all multiply each other."""
    q, v, S = x[:2], x[2:4], x[4]
    return 0.5 * jnp.sum((1.5 + jnp.sin(q)) * v**2) + 0.05 * jnp.sum(v**4) + 0.2 * q[0] * v[1] * jnp.cos(S) - q @ q - S


A = np.diag([-1.0, -2.0, 2.0, 1.0, 0.3]) + 0.2 * (np.eye(5, k=2) + np.eye(5, k=-2) + np.eye(5, k=1) + np.eye(5, k=-1))
LAGRANGIANS = {
    "kinetic minus potential": lt.Kinetic(mass) - lt.Potential(warm),
    "constant mass": lt.Kinetic([[2.0, 0.3], [0.3, 1.5]]) - lt.Potential(warm),
    "quadratic": lt.Quadratic(A, [0.1, 0.2, -0.3, 0.4, -1.0], 0.7),
    "tangled": coupled_lagrangian,
}
SLOW_LAGRANGIANS = ("constant mass", "kinetic minus potential")
each_lagrangian = pytest.mark.parametrize(
    "L",
    [
        pytest.param(L, id=name, marks=pytest.mark.slow if name in SLOW_LAGRANGIANS else ())
        for name, L in LAGRANGIANS.items()
    ],
)


def _system(kind, L):
    return kind(L, 5, validate=False)


# -- the equations ----------------------------------------------------------------------------------------------------


def equations(system, x):
    """Residuals of ``E_L = v . L_v - L``, ``q' = v`` and ``d/dt L_v - L_q = L_v L_S``; ``S'``, ``v . L_v`` and L."""
    L, rate, n = system.lagrangian, system.vector_field(x), system.dim // 2
    gradient, v = L.gradient(x), x[n : 2 * n]
    _, change = jax.jvp(lambda y: L.gradient(y)[n : 2 * n], (x,), (rate,))
    by_q, by_v, by_S = gradient[:n], gradient[n : 2 * n], gradient[-1]
    energy = system.energy.value(x) - (v @ by_v - L.value(x))
    return (energy, rate[:n] - v, change - by_q - by_v * by_S), (rate[-1], v @ by_v, L.value(x))


def relatedness(system, x):
    """``TFL (the field at x)`` minus the field at FL(x), and the difference of the energies."""
    image = system.hamiltonian_system()
    y, pushed = jax.jvp(system.contact.legendre, (x,), (system.vector_field(x),))
    return pushed - image.vector_field(y), system.energy.value(x) - image.energy.value(y)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0))
def both_sides(L, x):
    thermal, contact = (_system(kind, L) for kind in (lt.ThermodynamicHerglotz, lt.Herglotz))
    (zeros, (heat, made, _)), (more_zeros, (action, _, value)) = equations(thermal, x), equations(contact, x)
    related = relatedness(thermal, x), relatedness(contact, x)
    return [*zeros, *more_zeros, heat - made, action - value], related, heat - value


@pytest.mark.sampled("quadratic")
@each_lagrangian
def test_herglotz_equations_and_the_legendre_transform(L):
    """(12) and (10); Gamma_L and E_H are FL-related with H = E_L o FL^-1 [SML §3.1], and so are xi_L and X_H."""
    equations, related, control = both_sides(L, np.random.default_rng(1).standard_normal((8, 5)))
    for residual in equations:
        assert np.abs(residual).max() < 1e-12
    for residual in jax.tree_util.tree_leaves(related):
        assert np.abs(residual).max() < 1e-11
    assert np.abs(control).min() > 1e-3  # the two fields are not the same


def test_the_legendre_transform_has_the_type_of_its_side():
    for kind, image in (lt.ThermodynamicHerglotz, lt.EvolutionSystem), (lt.Herglotz, lt.ContactSystem):
        assert type(_system(kind, LAGRANGIANS["quadratic"]).hamiltonian_system()) is image


@pytest.mark.slow
def test_closed_forms_stay_closed():
    """E_L and H keep the form of L: their entropy cannot fall, and no equation is solved for v."""
    known = _system(lt.ThermodynamicHerglotz, LAGRANGIANS["kinetic minus potential"])
    assert known.entropy_law == known.hamiltonian_system().entropy_law == "nondecreasing"
    assert isinstance(_system(lt.ThermodynamicHerglotz, LAGRANGIANS["quadratic"]).energy, lt.Quadratic)
    oscillator = lt.ThermodynamicHerglotz(OSCILLATOR)
    H = oscillator.hamiltonian_system().energy
    assert isinstance(H, lt.Quadratic)
    assert np.allclose(H.A, np.diag([1.0, 1.0, 0.0]), rtol=0, atol=1e-15)
    assert np.allclose(H.b, [0.0, 0.0, GAMMA], rtol=0, atol=1e-15)
    assert oscillator.entropy_law == "nondecreasing"
    unknown = _system(lt.ThermodynamicHerglotz, LAGRANGIANS["tangled"])
    assert unknown.entropy_law is None
    assert "min Delta(L)" in str(unknown.check())


@pytest.mark.slow
def test_both_laws_on_velocities():
    """The midpoint scheme on TQ x R, with a metric that depends on q, and its order."""
    L, x0 = lt.Kinetic(lambda q: 1.5 + jnp.sin(q)) - lt.Potential(warm), [0.5, 1.0, 0.2]
    system = lt.ThermodynamicHerglotz(L, 3)
    exact, errors = lt.integrate(system, x0, (0.0, 4.0), 4.0, lt.Reference(rtol=1e-12)).x[-1], []
    for n in (20, 40, 80):
        solution = lt.integrate(system, x0, (0.0, 4.0), 4.0 / n, save_every=n // 20, engine="array")
        errors.append(np.abs(solution.x[-1] - exact).max())
        assert solution.audit().energy_drift <= tolerance("energy")
        assert solution.stats.least_entropy_increment >= 0.0
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - 2.0) < 0.2).all(), errors


@pytest.mark.parametrize(
    ("lagrangian", "dim", "words"),
    [
        (lt.Quadratic([1.0, 0.0, 1.0]), None, "singular"),
        (lambda x: x[2] * x[0] + x[4], 5, "singular"),
        (lambda x: 0.5 * (x[2] + x[3]) ** 2 - x[4], 5, "singular"),
        (lambda x: x[1] ** 2, None, r"dim=2n\+1"),
        (lambda x: x[1] ** 2, 4, "odd|2n \\+ 1"),
    ],
)
@pytest.mark.parametrize("kind", [lt.ThermodynamicHerglotz, lt.Herglotz])
def test_unusable_lagrangians(kind, lagrangian, dim, words):
    with pytest.raises(lt.InputError, match=words):
        kind(lagrangian, dim)


# -- the discrete Herglotz integrator ---------------------------------------------------------------------------------


def recorder():
    """The step is that of the discrete Lagrangian alone; a system is there to say what is recorded."""
    return lt.EvolutionSystem(lt.Quadratic([1.0, 1.0, 0.0], [0.0, 0.0, GAMMA]), 3)


def L_d(q0, q1, S0, h):
    """SML Example 7."""
    return (q1 - q0) @ (q1 - q0) / (2 * h) - h * (q1 + q0) @ (q1 + q0) / 8 - h * GAMMA * S0


@functools.cache
def thousand_steps() -> tuple[lt.Solution, np.ndarray]:
    """A run from q = 0, 1, and q and S of (42) in extended precision."""
    method = lt.DiscreteHerglotz(L_d)
    solution = lt.integrate(recorder(), method.state(0.0, 1.0, 0.0, 0.1), (0.1, 100.1), 0.1, method, engine="array")
    h = gamma = np.longdouble("0.1")
    q0, q1, S0 = map(np.longdouble, (0, 1, 0))
    expected_values = []
    for _ in range(1001):
        S1 = S0 + (q1 - q0) ** 2 / h - h * (q1**2 - q0**2) / 4
        q2 = gamma * h**3 * (q0 + q1) + 4 * gamma * h * (q0 - q1) - h**2 * (q0 + 2 * q1) - 4 * q0 + 8 * q1
        expected_values.append((q1, S1))
        q0, q1, S0 = q1, q2 / (h**2 + 4), S1
    return solution, np.array(expected_values).astype(float)


@pytest.mark.slow
def test_42():
    """The generic scheme (40)-(41) is (42): 1000 steps, against (42) in extended precision."""
    solution, expected_values = thousand_steps()
    assert (np.abs(solution.x[:, [0, 2]] - expected_values) <= 1e-14 * np.abs(expected_values).max(axis=0)).all()
    # what the paper says of Figs. 5 and 6: the Hamiltonian oscillates before it settles; but S falls at some steps
    early, late = solution.energy[:100], solution.energy[-100:]
    assert np.ptp(early) > 0.5
    assert np.ptp(late) < 1e-3
    assert -0.01 < solution.stats.least_entropy_increment < -0.001
    assert not solution.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("given", [OSCILLATOR, lambda q, v, S: OSCILLATOR(jnp.array([q[0], v[0], S]))], ids=["1", "3"])
def test_the_action_of_the_midpoint_rule(given):
    made = lt.DiscreteHerglotz.midpoint(given).discrete_lagrangian
    for q0, q1, S0, h in np.random.default_rng(0).standard_normal((4, 4)):
        q0, q1 = jnp.array([q0]), jnp.array([q1])
        assert float(made(q0, q1, S0, h)) == pytest.approx(float(L_d(q0, q1, S0, h)), rel=1e-13)


def quartic_action(q0, q1, S0, h):
    """Not quadratic in q_1: an implicit step."""
    q, v = 0.5 * (q0 + q1), (q1 - q0) / h
    return h * (0.5 * v @ v + 0.05 * jnp.sum(v**4) - 0.25 * jnp.sum(q**4) - 0.3 * S0 * (1.0 + 0.1 * q[0]))


def quartic_run(steps, t=2.0):
    method = lt.DiscreteHerglotz(quartic_action)
    return lt.integrate(
        recorder(), [1.0, 0.5, 0.0], (0.0, t), t / steps, method, save_every=steps // 40, engine="array"
    )


@pytest.mark.slow
def test_observed_order_of_discrete_herglotz():
    """Order 1, by hand: (40) and (41) take S and the friction at the start of the step."""

    def L(x):  # of which quartic_action is the midpoint rule
        return quartic_action(x[:1] - 0.5 * x[1:2], x[:1] + 0.5 * x[1:2], x[2], 1.0)

    system = lt.ThermodynamicHerglotz(L, 3)
    v = np.roots([0.2, 0.0, 1.0, -0.5])[-1].real  # p = v + v^3/5
    assert np.allclose(system.legendre([1.0, v, 0.0]), [1.0, 0.5, 0.0], rtol=0, atol=1e-15)
    exact = lt.integrate(system, [1.0, v, 0.0], (0.0, 2.0), 2.0, lt.Reference(rtol=1e-12)).x[-1]
    errors = [np.abs(quartic_run(n).x[-1] - system.legendre(exact)).max() for n in (160, 320, 640, 1280)]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(slopes - lt.DiscreteHerglotz(quartic_action).order) < 0.2).all(), errors


@pytest.mark.slow
def test_discrete_herglotz_solves_40_and_41():
    """The states of a run satisfy the printed equations, for a discrete Lagrangian that makes them implicit."""
    h, solution = 0.05, quartic_run(40)
    q, S = solution.x[:, :1], solution.x[:, 2]

    @jax.vmap
    def residuals(q0, q1, q2, S0, S1):
        D2 = jax.grad(quartic_action, argnums=1)(q0, q1, S0, h)
        D1, DS = jax.grad(quartic_action, argnums=(0, 2))(q1, q2, S1, h)
        return D1 + (1.0 + DS) * D2, S1 - S0 - (q1 - q0) @ D2

    for residual in residuals(q[:-2], q[1:-1], q[2:], S[:-2], S[1:-1]):
        assert np.abs(residual).max() < 1e-13


def solved_step(method, x, h):
    """The end of a step, its equations iterated to rounding: Newton's method is in the slopes."""
    x = jnp.asarray(x)
    k = jnp.zeros((method.stages, 3))
    for _ in range(12):
        k = method.slopes(recorder(), x, jnp.zeros(3), h, k)
    return np.asarray(x + method.increment(h, k))


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 2])
@pytest.mark.parametrize("S0", [3.7, 0.0])
def test_discrete_herglotz_of_higher_order(order, S0):
    """SML 6.3 asks for more than order 1: the order for any first action; symmetric in time."""
    method, x0 = lt.DiscreteHerglotz(quartic_action, order=order), quartic_start(S0)
    errors = errors_of_order(order, S0)
    assert method.order == order
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2, errors
    assert np.abs(solved_step(method, solved_step(method, x0, 0.1), -0.1) - x0).max() < 1e-13
    plain = lt.DiscreteHerglotz(quartic_action)
    assert np.abs(solved_step(plain, solved_step(plain, x0, 0.1), -0.1) - x0).max() > 1e-5
    with pytest.raises(lt.InputError, match="order must be 1, 2 or 4"):
        lt.DiscreteHerglotz(quartic_action, order=3)


def quartic_start(S0) -> np.ndarray:
    v0 = 0.4
    return np.array([1.0, v0 + 0.2 * v0**3, S0])


def errors_of_order(order, S0) -> list:
    """Return the errors of two runs of the quartic action, the second with half the step, against (12) by hand."""

    def rate(t, y):  # of quartic_action: L = v^2/2 + v^4/20 - q^4/4 - 0.3 S (1 + q/10)
        q, v, S = y
        p, by_q, by_S = v + 0.2 * v**3, -(q**3) - 0.03 * S, -0.3 * (1.0 + 0.1 * q)
        return [v, (by_q + by_S * p) / (1.0 + 0.6 * v**2), p * v]

    q, v, S = solve_ivp(rate, (0.0, 1.0), [1.0, 0.4, S0], method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    exact, method = np.array([q, v + 0.2 * v**3, S]), lt.DiscreteHerglotz(quartic_action, order=order)
    runs = [lt.integrate(recorder(), quartic_start(S0), (0.0, 1.0), h, method, engine="array") for h in (0.1, 0.05)]
    return [np.abs(run.x[-1] - exact).max() for run in runs]


def test_discrete_herglotz_runs_evolution_systems_only():
    with pytest.raises(lt.InputError, match=r"EvolutionSystem, got a LiePoissonSystem"):
        lt.integrate(lt.models.rigid_body(), [1.0, 0.0, 0.0], (0.0, 1.0), 0.1, lt.DiscreteHerglotz(L_d))
