"""Equilibria, their linear motion on the leaf, and steady states, beside closed forms and independent eigenvalues."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

MOMENTS = np.array([3.0, 2.0, 1.0])
LOWER = np.array([[0.0, 1.0], [0.0, 0.0]])
BIANCHI = [
    ("I", None), ("II", None), ("III", None), ("IV", None), ("V", None), ("VI", 0.0), ("VI", -0.3), ("VI", -1.7),
    ("VII", 0.0), ("VII", 0.6), ("VIII", None), ("IX", None),
]  # fmt: skip


def body_frequency(axis: int, momentum: float) -> complex:
    """Return the frequency of a free body near a spin about a principal axis; imaginary where the spin is unstable."""
    i, j = np.delete(MOMENTS, axis)
    k = MOMENTS[axis]
    return momentum / k * np.sqrt(complex((k - i) * (k - j) / (i * j)))


# -- rigid bodies -----------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("axis", range(3))
def test_frequencies_of_a_free_body_are_those_of_euler(axis):
    motion = lt.linearise(lt.models.free_rigid_body(MOMENTS), 0.8 * np.eye(3)[axis])
    expected = body_frequency(axis, 0.8)
    assert motion.eigenvalues.shape == (2,)
    np.testing.assert_allclose(motion.frequencies, expected.real, atol=1e-14)
    np.testing.assert_allclose(motion.eigenvalues.real, [expected.imag, -expected.imag], atol=1e-14)
    assert motion.stable is (axis != 1)
    assert motion.codimension == 1  # the gradients of the energy and of the Casimir are parallel at a spin


def test_friction_inside_damps_at_the_closed_rate():
    """The nutation decays at ``rate L^2 / 2 ((1/I1 - 1/I3) + (1/I2 - 1/I3))``, and the heat is no mode."""
    rate, L = 0.1, 0.7
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / MOMENTS), dissipation=lt.DoubleBracket(rate), baths=lt.HeatBaths(2.0)
    )
    motion = lt.linearise(system, [L, 0.0, 0.0, 0.1])
    a, b, c = 1.0 / MOMENTS
    mean, difference = rate * L**2 * (b + c - 2 * a) / 2, rate * L**2 * (c - b) / 2
    np.testing.assert_allclose(motion.rates, [mean, mean], rtol=1e-13)
    expected = np.sqrt(body_frequency(0, L).real ** 2 - difference**2)
    np.testing.assert_allclose(motion.frequencies, expected, rtol=1e-13)
    assert motion.stability is lt.Stability.ASYMPTOTIC
    assert lt.linearise(system, [0.0, 0.0, L, 0.1]).stable is False


def test_all_equilibria_of_a_leaf_are_found():
    rest = lt.equilibria(lt.models.free_rigid_body(MOMENTS), [0.0, 0.6, 0.8])
    assert len(rest) == 6
    np.testing.assert_allclose(np.sort(np.abs(rest.x), axis=1)[:, 2], 1.0, rtol=1e-12)
    assert rest.stable == [True] * 4 + [False] * 2


@pytest.mark.sampled(1)
@pytest.mark.parametrize("unit", [1e-20, 1.0, 1e20])
def test_the_unit_of_momentum_does_not_matter(unit):
    """Momenta, energies and rates in other units have the same equilibria, with the same stability."""
    system = lt.LiePoissonSystem(
        mf.so(3),
        lambda m: 0.5 * unit * jnp.sum((m / unit) ** 2 / MOMENTS),
        lambda m: unit * jnp.log(1.0 + (m / unit) @ (m / unit)),
        lt.KillingDissipation(0.3 * unit),
    )
    start = np.array([0.4, 0.5, -0.3])
    rest = lt.equilibria(system, unit * start)
    assert rest.stable == [True] * 2 + [False] * 4
    spin = np.sqrt(MOMENTS[0] * np.sum(start**2 / MOMENTS))  # the energy is kept, and all in the slowest rotation
    np.testing.assert_allclose(np.abs(rest.x[:2] / unit).max(axis=1), spin, rtol=1e-12)


def test_a_rate_of_zero_is_no_dissipation():
    """The energy is a level only where a dissipation acts: else each spin of the leaf has its own."""
    undamped = lt.models.rigid_body(MOMENTS, rate=0.0)
    rest = lt.equilibria(undamped, [0.0, 0.6, 0.8])
    assert rest.stable == [True] * 4 + [False] * 2
    motion = lt.linearise(undamped, [0.8, 0.0, 0.0])
    np.testing.assert_allclose(motion.frequencies, body_frequency(0, 0.8).real, rtol=1e-14)
    assert len(lt.equilibria(lt.models.rigid_body(MOMENTS, rate=0.1), [0.0, 0.6, 0.8])) == 6


def test_a_relaxed_body_has_the_equilibria_of_its_energy():
    rest = lt.equilibria(lt.models.rigid_body(MOMENTS, rate=0.3), [0.1, 0.9, 0.2])
    energy = 0.5 * np.sum(np.array([0.1, 0.9, 0.2]) ** 2 / MOMENTS)
    np.testing.assert_allclose(
        np.sort(np.linalg.norm(rest.x, axis=1) ** 2)[::-1], 2 * energy * MOMENTS[[0, 0, 1, 1, 2, 2]]
    )
    assert rest.stable == [True, True, False, False, False, False]


@pytest.mark.parametrize(("ratio", "stable"), [(0.98, False), (1.02, True)])
def test_a_sleeping_top_is_stable_above_its_limit(ratio, stable):
    """``omega^2 > 4 m g l I1 / I3^2``, where the conserved spin about the axis proves it."""
    I1, I3, mgl = 2.0, 0.5, 1.3
    omega = ratio * np.sqrt(4.0 * mgl * I1) / I3
    inertia = jnp.array([I1, I1, I3])
    top = lt.LiePoissonSystem(
        mf.se(3),
        lambda x: 0.5 * jnp.sum(x[:3] ** 2 / inertia) + mgl * x[5],
        momentum_maps={"spin": lambda x: x[2]},
    )
    motion = lt.linearise(top, [0.0, 0.0, I3 * omega, 0.0, 0.0, 1.0])
    assert motion.stable is stable
    # theta'' + (...) of the linear top in complex form: I1 z'' - i I3 omega z' - mgl z = 0, in turning axes
    roots = np.roots([I1, -1j * I3 * omega, -mgl])
    fastest = np.abs(roots.real).max() if not stable else 0.0
    np.testing.assert_allclose(motion.eigenvalues.real.max(), fastest, atol=1e-7)


def test_a_direction_that_is_not_on_the_leaf_would_be_neutral():
    """Control: the whole Jacobian of a damped body has an eigenvalue zero, along the Casimir."""
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / MOMENTS), dissipation=lt.DoubleBracket(0.1), baths=lt.HeatBaths(2.0)
    )
    motion = lt.linearise(system, [1.0, 0.0, 0.0, 0.1])
    assert np.abs(np.linalg.eigvals(motion.jacobian)).min() < 1e-14
    assert motion.rates.min() > 1e-2


# -- every Lie algebra of three dimensions ----------------------------------------------------------------------------


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("kind", "h"), BIANCHI)
def test_every_bianchi_type(kind, h):
    """``H = (x - x*) A (x - x*) / 2`` is at rest at x*, with the eigenvalues of ``Pi(x*) A``."""
    algebra = mf.bianchi(kind) if h is None else mf.bianchi(kind, h=h)
    A, x_star = np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.0]]), np.array([0.7, -0.4, 0.9])
    system = lt.LiePoissonSystem(algebra, lambda x: 0.5 * (x - x_star) @ A @ (x - x_star))
    tensor = np.einsum("abc,c->ba", algebra.structure_constants, x_star)
    expected = np.linalg.eigvals(tensor @ A)
    expected = expected[np.abs(expected) > 1e-9]
    motion = lt.linearise(system, x_star)
    if kind == "I":  # abelian: every state is at rest, and is its own leaf
        assert not expected.size
        assert not motion.jacobian.any()
        return
    assert len(motion.eigenvalues) == 2
    np.testing.assert_allclose(np.sort(motion.frequencies), np.sort(np.abs(expected.imag)), rtol=1e-11)
    np.testing.assert_allclose(motion.rates, 0.0, atol=1e-12)
    assert motion.stable is True  # the energy has a minimum there
    rest = lt.equilibria(system, x_star, count=8)
    assert np.linalg.norm(rest.x - x_star, axis=1).min() < 1e-9


def test_a_leaf_of_fewer_dimensions_is_not_a_leaf_of_its_neighbours():
    """At zero every motion of so(3) is at rest and the Casimir has no gradient, so no direction is taken out."""
    motion = lt.linearise(lt.models.free_rigid_body(MOMENTS), np.zeros(3))
    assert motion.codimension == 0
    assert "energy" not in motion.leaf_names


# -- other kinds of systems -------------------------------------------------------------------------------------------


def test_a_space_has_the_modes_of_its_tangent_plane():
    A = np.diag([1.0, 2.0, 4.0])

    def cross(x):
        return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])

    system = lt.MetriplecticSystem(cross, lambda x: 0.5 * x @ A @ x, space=mf.Sphere(2))
    motion = lt.linearise(system, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(motion.frequencies, np.sqrt(1.0 * 3.0), rtol=1e-12)
    assert motion.stable is True
    assert np.abs(motion.basis[0]).max() < 1e-14  # tangent to the sphere
    rest = lt.equilibria(system, count=24)
    assert len(rest) == 6
    assert rest.stable.count(False) == 2


def test_a_damped_oscillator_has_its_closed_rates():
    gamma = 0.2
    system = lt.models.damped_oscillator(friction=gamma)
    motion = lt.linearise(system, np.zeros(system.dim))
    np.testing.assert_allclose(motion.rates, gamma / 2, rtol=1e-12)
    np.testing.assert_allclose(motion.frequencies, np.sqrt(1 - gamma**2 / 4), rtol=1e-12)


def test_a_pendulum_with_heat_is_a_metriplectic_system():
    def heated_pendulum(friction):
        return lt.MetriplecticSystem(
            poisson=np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
            energy=lambda x: 0.5 * x[1] ** 2 + 1.0 - jnp.cos(x[0]) + jnp.exp(x[2]),
            entropy=lambda x: x[2],
            dissipation=lt.FrictionOperator(
                lambda x: friction * jnp.outer(*2 * (jnp.array([0.0, jnp.exp(x[2]), -x[1]]),)) / jnp.exp(x[2])
            ),
        )

    rest = lt.equilibria(heated_pendulum(0.3), [1.0, 0.0, 1.0], starts=[[0.5, 0.1, 0.0], [3.0, 0.1, 0.0]])
    assert rest.stable == [True, False]
    np.testing.assert_allclose(np.cos(rest.x[:, 0]), [1.0, -1.0], rtol=1e-12)
    np.testing.assert_allclose(rest[0].linearisation.rates, 0.15, rtol=1e-9)
    saddle = np.roots([1.0, 0.3, -1.0])
    np.testing.assert_allclose(np.sort(rest[1].linearisation.eigenvalues.real), np.sort(saddle), rtol=1e-9)


# -- driven and open systems ------------------------------------------------------------------------------------------


def liouvillian(H, jumps) -> np.ndarray:
    """Return Lindblad's generator on row-major ``vec(rho)``, from the Kronecker products of its definition."""
    one = np.eye(len(H))
    L = -1j * (np.kron(H, one) - np.kron(one, H.T))
    for rate, V in jumps:
        L = L + rate * (
            np.kron(V, V.conj()) - 0.5 * np.kron(V.conj().T @ V, one) - 0.5 * np.kron(one, (V.conj().T @ V).T)
        )
    return L


def test_a_qubit_between_two_baths_rests_in_the_kernel_of_its_liouvillian():
    omega, rates, T = 1.3, (0.1, 0.25), (0.5, 2.0)
    baths = lt.HeatBaths(capacity=np.inf, temperature=T, number=2)
    jumps = [lt.ThermalJumps([(LOWER, rate)], bath=i) for i, rate in enumerate(rates)]
    qubit = lt.QuantumSystem(np.diag([0.0, omega]), jumps, baths=baths)
    terms = [
        (g * np.exp(sign * omega / (2 * t)), V)
        for g, t in zip(rates, T, strict=True)
        for sign, V in ((1, LOWER), (-1, LOWER.T))
    ]
    L = liouvillian(np.diag([0.0, omega]), terms)
    _, _, vectors = np.linalg.svd(L)
    kernel = vectors[-1].conj().reshape(2, 2)
    rest = lt.steady_state(qubit)
    np.testing.assert_allclose(qubit.density(rest.x), kernel / np.trace(kernel), atol=1e-15)
    eigenvalues = np.linalg.eigvals(L)
    expected = np.sort(-eigenvalues[np.abs(eigenvalues) > 1e-12].real)
    np.testing.assert_allclose(np.sort(rest.linearisation.rates), expected, rtol=1e-13)
    p = (kernel / np.trace(kernel))[1, 1].real
    (up, down) = (rates[0] * np.exp(-omega / (2 * T[0])), rates[0] * np.exp(omega / (2 * T[0])))
    np.testing.assert_allclose(rest.bath_heat, omega * (down * p - up * (1 - p)) * np.array([1, -1]), rtol=1e-12)


def test_a_constant_torque_against_drag_has_its_balance():
    moment = jnp.array([0.3, -0.2, 0.5])
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(np.full(3, 0.5)), torque=lambda t, mu: moment - 0.4 * mu)
    rest = lt.steady_state(system, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(rest.x, np.asarray(moment) / 0.4, rtol=1e-12)
    np.testing.assert_allclose(rest.linearisation.rates, 0.4, rtol=1e-12)


def test_a_periodic_drive_is_refused_by_name():
    system = lt.LiePoissonSystem(
        mf.so(3), lt.Quadratic(1.0 / MOMENTS), torque=lambda t, mu: jnp.array([jnp.sin(t), 0.0, 0.0]) - mu
    )
    with pytest.raises(lt.InputError, match=r"depends on time.*Give t="):
        lt.steady_state(system, [1.0, 0.0, 0.0])
    assert lt.steady_state(system, [1.0, 0.1, 0.0], t=0.0).stable
    driven = lt.QuantumSystem([np.diag([0.0, 1.0]), (np.array([[0, 1], [1, 0]]), jnp.cos)])
    with pytest.raises(lt.InputError, match="the energy of this QuantumSystem depends on time"):
        lt.steady_state(driven)


def test_a_motion_without_rest_is_an_error():
    def rotation(t, mu):
        return jnp.array([1.0, 0.0, 0.0])

    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / MOMENTS), torque=rotation)
    with pytest.raises(lt.ConvergenceError, match="does not come to rest"):
        lt.steady_state(system, [0.3, 0.2, 0.1])


def test_a_state_that_moves_is_refused():
    with pytest.raises(lt.InputError, match="not an equilibrium"):
        lt.linearise(lt.models.free_rigid_body(MOMENTS), [0.1, 1.0, 0.0])
    with pytest.raises(lt.InputError, match="conserves"):
        lt.equilibria(lt.models.free_rigid_body(MOMENTS), [0.1, 1.0, 0.0], levels=["heat"])


def stoner_wohlfarth_spins(fields):
    """Return spins without coupling in their own fields, with an anisotropy along z, precessing and damped."""
    fields = jnp.asarray(fields)
    return lt.SpinSystem(
        len(fields), lambda s: -jnp.sum(fields * s) - 0.3 * jnp.sum(s[:, 2] ** 2), lt.LandauLifshitz(0.1)
    )


def test_every_spin_keeps_its_length_on_a_leaf_of_spins():
    fields = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])
    rest = lt.equilibria(stoner_wohlfarth_spins(fields), [0.0, 0.0, 1.0, 0.0, 0.0, 1.5], count=40)
    spins = rest.x.reshape(-1, 2, 3)
    assert np.abs(np.linalg.norm(spins, axis=2) - [1.0, 1.5]).max() < 1e-9
    # a field above 2 K |s| leaves a spin its two poles, so the pair has four equilibria, of which one is stable
    assert len(rest) == 4
    assert [bool(stable) for stable in rest.stable] == [True, False, False, False]
    assert rest.level_names == ("|s|^2 / 2 at 1", "|s|^2 / 2 at 2")


def test_modes_of_spins_do_not_change_their_lengths():
    system = stoner_wohlfarth_spins([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])
    modes = lt.linearise(system, [0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    # s' = s x B - 0.1 s x (s x B) near the pole, with B = field + 2 K
    assert modes.eigenvalues.size == 4
    assert modes.stability == "asymptotically stable"
    assert np.sort(modes.frequencies) == pytest.approx([1.6, 1.6, 2.6, 2.6], rel=1e-12)
    assert np.sort(modes.rates) == pytest.approx([0.16, 0.16, 0.26, 0.26], rel=1e-12)


def test_a_long_list_of_levels_is_shortened_where_it_is_printed():
    system = stoner_wohlfarth_spins(np.tile([0.0, 0.0, 1.0], (30, 1)))
    up = np.tile([0.0, 0.0, 1.0], (30, 1))
    rest = lt.equilibria(system, up, starts=up.reshape(1, -1) + 0.01)
    assert rest.level_names[-1] == "|s|^2 / 2 at 30"
    assert rest.stable == [True]
    text = str(rest)
    assert "|s|^2 / 2 at 2, 26 more, |s|^2 / 2 at 29" in text
    assert "26 more" in str(lt.linearise(system, up))
