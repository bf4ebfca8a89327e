"""Systems: the Euler-Poincaré side, the axioms' report, and input that is refused."""

import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.integrators import registered_methods
from liethermo.systems import Domain
from liethermo.systems.check import MAX_FULL_JACOBI_DIM
from liethermo.systems.interface import REPLACED_MEMBERS
from tests.cases import energy_of, state_of

SPHERE = lt.Quadratic(np.ones(3))


# -- Euler-Poincaré ---------------------------------------------------------------------------------------------------


def quartic(xi):
    return 0.5 * jnp.sum(jnp.array([3.0, 2.0, 1.0]) * xi**2) + 0.1 * jnp.sum(xi**4)


@pytest.mark.slow
@given(seed=st.integers(0, 10**6))
def test_legendre_transform(seed):
    """mu = dl/dxi and xi = dH/dmu are inverse; H(mu) = <mu, xi> - l(xi); grad H and its Hessian are consistent."""
    system = _quartic_system()
    xi = 2.0 * np.random.default_rng(seed).standard_normal(3)
    mu = system.momentum(xi)
    assert np.allclose(system.velocity(mu), xi, rtol=0, atol=1e-12)
    assert float(system.energy(mu)) == pytest.approx(float(mu @ xi - quartic(xi)), rel=1e-13)
    gradient, hessian, inverse = _derivatives(mu, xi)
    assert np.allclose(gradient, xi, rtol=0, atol=1e-12)
    assert np.allclose(hessian @ inverse, np.eye(3), rtol=0, atol=1e-11)


@jax.jit
def _derivatives(mu, xi):
    H = _quartic_system().energy.value
    return jax.grad(H)(mu), jax.hessian(H)(mu), jax.hessian(quartic)(xi)


@functools.cache
def _quartic_system():
    return lt.EulerPoincareSystem(mf.so(3), quartic, entropy=SPHERE, dissipation=lt.KillingDissipation(0.5))


@pytest.mark.slow
def test_quadratic_lagrangians_are_transformed_in_closed_form():
    A = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.0], [0.0, 0.0, 0.5]])
    b = np.array([0.1, -0.2, 0.3])
    closed = lt.EulerPoincareSystem(mf.so(3), lt.Quadratic(A, b, 0.7), entropy=SPHERE)
    general = lt.EulerPoincareSystem(mf.so(3), lambda xi: 0.5 * xi @ A @ xi + b @ xi + 0.7, entropy=SPHERE)
    x = np.array([0.4, -1.2, 0.8])
    assert isinstance(closed.energy, lt.Quadratic)
    assert float(closed.energy(x)) == pytest.approx(float(general.energy(x)), abs=1e-13)
    assert np.allclose(closed.vector_field(x), general.vector_field(x), rtol=0, atol=1e-13)
    diagonal = lt.EulerPoincareSystem(mf.so(3), lt.Quadratic([2.0, 1.0, 0.5]))
    assert np.allclose(diagonal.velocity([2.0, 1.0, 0.5]), 1.0)


@pytest.mark.slow
def test_an_euler_poincare_run_obeys_the_laws():
    solution = lt.integrate(_quartic_system(), [0.5, 1.0, -0.3], (0.0, 20.0), 0.1)
    assert solution.audit().passed, f"\n{solution.audit()}"
    assert solution.entropy[-1] > 1.05 * solution.entropy[0]


@pytest.mark.slow
def test_a_force_keeps_the_energy_whatever_it_is():
    """BFM (3.2): any F; its entropy law is not promised, and the report shows the sign of the production."""
    system = lt.EulerPoincareSystem(
        mf.so(3), quartic, entropy=SPHERE, force=lambda xi: jnp.array([xi[1] ** 2, jnp.sin(xi[0]), xi[2]])
    )
    assert system.entropy_law is None
    assert "min dS/dt" in str(system.check())
    solution = lt.integrate(system, [0.5, 1.0, -0.3], (0.0, 20.0), 0.1)
    assert solution.audit().passed
    assert solution.stats.least_entropy_increment < 0  # nothing was promised


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("algebra", "method"),
    [
        pytest.param(algebra, method, id=f"{algebra.name}-{method}")
        for method in registered_methods()
        for algebra in (mf.so(3), mf.se(3))
    ],
)
def test_a_force_on_a_body_without_an_entropy(algebra, method):
    """BFM Example 3.1, as SciPy has it from the structure constants."""
    n, C, inertia = algebra.dim, algebra.structure_constants, np.linspace(1.0, 2.0, algebra.dim)
    start, T, steps = np.linspace(0.5, 1.0, n), 1.0, 50 if method.order > 1 else 1000

    def motion(t, mu):
        xi = mu / inertia
        return np.einsum("abc,a,c->b", C, xi, mu - 0.1 * xi**3)

    exact = solve_ivp(motion, (0.0, T), start, rtol=1e-10, atol=1e-12).y[:, -1]
    system = lt.EulerPoincareSystem(algebra, lt.Quadratic(inertia), force=lambda xi: -0.1 * xi**3)
    run = lt.integrate(system, start, (0.0, T), T / steps, method)
    assert run.audit().passed
    assert np.abs(run.x[-1] - exact).max() < 1e-3


@pytest.mark.parametrize(
    "lagrangian", [lt.Quadratic([1.0, 0.0, 2.0]), lt.Quadratic(np.ones((3, 3))), lambda xi: xi[0] ** 2 + xi[1] ** 2]
)
def test_singular_lagrangians_are_refused(lagrangian):
    with pytest.raises(lt.InputError, match="singular"):
        lt.EulerPoincareSystem(mf.so(3), lagrangian)


# -- metriplectic systems on R^n ----------------------------------------------------------------------------------


def test_a_system_on_rn_with_a_user_poisson_tensor():
    """The damped oscillator with a heat bath: (q, p, S), H = p^2/2 + q^2/2 + T0 S, friction by a K(x)."""

    def K(x):
        v = jnp.array([0.0, 1.0, -x[1]])  # orthogonal to grad H = (q, p, 1)
        return 0.3 * jnp.outer(v, v)

    tensor = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    system = lt.MetriplecticSystem(
        lambda x: jnp.asarray(tensor),
        energy=lambda x: 0.5 * (x[0] ** 2 + x[1] ** 2) + x[2],
        entropy=lambda x: x[2],
        dissipation=lt.FrictionOperator(K),
        dim=3,
    )
    assert system.check().passed
    x = np.array([0.4, 0.7, 0.1])
    assert np.allclose(system.vector_field(x), [0.7, -0.4 - 0.3 * 0.7, 0.3 * 0.7**2])
    solution = lt.integrate(system, x, (0.0, 30.0), 0.1)
    assert solution.audit().passed, f"\n{solution.audit()}"
    assert np.abs(solution.x[-1, :2]).max() < 0.05


def test_canonical_structure():
    system = lt.MetriplecticSystem(mf.Canonical(1), lambda x: 0.5 * x[1] ** 2 - jnp.cos(x[0]))
    solution = lt.integrate(system, [1.0, 0.0], (0.0, 50.0), 0.1)
    assert solution.audit().passed
    assert solution.entropy is None
    assert system.entropy_law is None


def test_a_momentum_map_that_is_not_defined_everywhere():
    """Points outside its domain are left out, as they are of an entropy; a wrong one fails all the same."""
    oscillator = lambda x: 0.5 * (x[0] ** 2 + x[1] ** 2)  # noqa: E731
    outside = lambda x: jnp.sqrt(x[0] ** 2 + x[1] ** 2 - 1.0)  # noqa: E731
    system = lt.MetriplecticSystem(mf.Canonical(1), oscillator, momentum_maps={"outside": outside})
    (row,) = (row for row in system.check().rows if row.name == "momentum map outside")
    assert row.passed
    assert "points outside its domain" in row.note
    run = lt.integrate(system, [1.5, 0.5], (0.0, 10.0), 0.1)
    assert run.audit().passed, f"\n{run.audit()}"
    log = lambda x: jnp.log(x[0] ** 2 + x[1] ** 2 - 1.0)  # noqa: E731  (its derivative is defined everywhere)
    assert lt.MetriplecticSystem(mf.Canonical(1), oscillator, momentum_maps={"log": log}).check().passed
    with pytest.raises(lt.AxiomError, match="has to commute with H"):
        lt.MetriplecticSystem(mf.Canonical(1), oscillator, momentum_maps={"q": lambda x: jnp.sqrt(x[0])})
    with pytest.raises(lt.AxiomError, match="not finite at any of the points"):
        lt.MetriplecticSystem(mf.Canonical(1), oscillator, momentum_maps={"none": lambda x: jnp.sqrt(-1.0 - x[0] ** 2)})


def test_a_field_on_many_sites_makes_no_matrix():
    n = 100_000
    field = lt.MetriplecticSystem(mf.Canonical(n), lambda x: 0.5 * jnp.sum(x**2) + jnp.sum(x[:n] ** 4))
    assert np.isfinite(field.vector_field(np.ones(2 * n))).all()
    with pytest.raises(lt.FunctionError, match=rf"Pi\(x\) of a covector must have shape \({2 * n},\), got \({n},\)"):
        lt.MetriplecticSystem(_HalvedSharp(n), lambda x: x @ x)


class _HalvedSharp(mf.Canonical):
    def sharp(self, x, alpha):
        return super().sharp(x, alpha)[::2]


def test_batches_of_states():
    system, x = lt.models.rigid_body(), np.random.default_rng(0).standard_normal((4, 2, 3))
    assert system.energy(x).shape == (4, 2)
    assert system.vector_field(x).shape == (4, 2, 3)
    assert np.allclose(system.vector_field(x)[1, 1], system.vector_field(x[1, 1]), atol=1e-15)
    assert (system.entropy_production(x) >= 0).all()


def test_systems_are_pytrees_of_their_parameters():
    """Rates and inertias can be mapped over and differentiated."""

    def field(rate):
        return lt.models.rigid_body(rate=rate).vector_field(jnp.array([0.3, 1.0, -0.2]))

    rates = jnp.array([0.0, 1.0, 2.0])
    swept = jax.vmap(field)(rates)
    assert np.allclose(swept[2] - swept[1], swept[1] - swept[0], atol=1e-15)
    assert np.allclose(jax.jacfwd(field)(1.0), swept[1] - swept[0], atol=1e-15)

    class QuarticEnergy(eqx.Module):
        stiffness: jax.Array

        def __call__(self, mu):
            return 0.5 * self.stiffness * jnp.sum(mu**4)

    system = lt.LiePoissonSystem(mf.so(3), QuarticEnergy(jnp.asarray(2.0)), SPHERE)
    assert any(leaf.shape == () and leaf == 2.0 for leaf in jax.tree_util.tree_leaves(system))


# -- refusals -----------------------------------------------------------------------------------------------------


def test_an_entropy_that_is_no_casimir():
    with pytest.raises(lt.CasimirError, match=r"not a Casimir.*g\.casimirs") as caught:
        lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), lambda mu: mu[0] ** 2, lt.KillingDissipation())
    assert caught.value.residual > 0.1
    built = lt.LiePoissonSystem(
        mf.so(3), energy_of(3, 0), lambda mu: mu[0] ** 2, lt.KillingDissipation(), validate=False
    )
    assert "Pi grad S = 0" in [row.axiom for row in built.check().rows if row.passed is False]


def test_a_poisson_tensor_that_is_none():
    with pytest.raises(lt.AxiomError, match="Pi skew fails"):
        lt.MetriplecticSystem(lambda x: jnp.eye(2), energy=lambda x: x @ x, dim=2)
    with pytest.raises(lt.AxiomError, match="Jacobi fails"):
        lt.MetriplecticSystem(
            lambda x: jnp.array([[0.0, x[1], 0.0], [-x[1], 0.0, 1.0], [0.0, -1.0, 0.0]]), lambda x: x @ x, dim=3
        )


@pytest.mark.parametrize("fits", [True, False], ids=["Poisson", "not"])
def test_jacobi_of_many_components(fits):
    """The Jacobi identity is checked for three functions: arrays of n^3 numbers are not formed."""
    n = MAX_FULL_JACOBI_DIM + 5

    def tensor(x):
        a, b, c = x[:3] if fits else (x[1], 0.0, 1.0)
        return jnp.zeros((n, n)).at[:3, :3].set(jnp.array([[0.0, a, b], [-a, 0.0, c], [-b, -c, 0.0]]))

    built = lt.MetriplecticSystem(tensor, lambda x: x @ x, dim=n, validate=False)
    (row,) = (row for row in built.check().rows if row.axiom == "Jacobi")
    assert row.passed == fits


def test_a_momentum_map_that_is_not_conserved():
    with pytest.raises(lt.AxiomError, match="momentum map J"):
        lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), SPHERE, momentum_maps={"J": lambda mu: mu[0]})


@pytest.mark.parametrize(
    ("energy", "error", "words"),
    [
        (lambda mu: mu, lt.FunctionError, r"one number.*\(3,\).*jnp.sum"),
        (lambda mu: mu @ mu + 0j, lt.FunctionError, "real number"),
        (lambda mu: np.sin(float(mu[0])), lt.FunctionError, "jax.numpy"),
        (lambda mu: mu[0] + undefined, NameError, "undefined"),  # noqa: F821
        (lambda a, b, c: a, lt.FunctionError, "could not be evaluated"),
        (3.0, lt.FunctionError, "lt.Quadratic"),
        (lt.Quadratic(np.ones(4)), lt.FunctionError, "shape"),
    ],
)
def test_unusable_energies(energy, error, words):
    with pytest.raises(error, match=words):
        lt.LiePoissonSystem(mf.so(3), energy)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: lt.LiePoissonSystem("so(3)", SPHERE), "manifolds.LieAlgebra"),
        (lambda: lt.LiePoissonSystem(mf.so(3), SPHERE, dissipation=lt.ProjectedMetric()), "needs an entropy"),
        (lambda: lt.LiePoissonSystem(mf.so(3), SPHERE, SPHERE, dissipation=0.5), "Dissipation"),
        (lambda: lt.MetriplecticSystem(lambda x: jnp.eye(2), lambda x: x @ x), "dim=n"),
        (lambda: lt.MetriplecticSystem(mf.Canonical(1), lambda x: x @ x, dim=3), "dim is 3"),
        (lambda: lt.Quadratic([[0.0, 1.0], [0.0, 0.0]]), "must be symmetric"),
        (lambda: lt.Quadratic(np.ones((2, 3))), r"\(n, n\)"),
        (lambda: lt.Quadratic(np.ones(2), np.ones(3)), "b must have shape"),
        (lambda: lt.models.rigid_body(inertia=(1.0, 2.0)), r"inertia must have shape \(3,\)"),
        (lambda: lt.models.rigid_body(inertia=(1.0, -2.0, 1.0)), "positive"),
        (lambda: lt.models.rigid_body(rate=-1.0), "got -1.0"),
    ],
)
def test_unusable_arguments(make, words):
    with pytest.raises(lt.InputError, match=words):
        make()


def test_inertias_that_no_body_has():
    """Said where they are given, except for the paper's own."""
    for make in (lt.models.rigid_body, lt.models.free_rigid_body):
        with pytest.warns(UserWarning, match="no rigid body has.*largest, 9, is more than the sum of the others, 6"):
            make((2.0, 9.0, 4.0))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            make()
            make((10, 5, 1))
            make((3.0, 2.0, 1.0))  # a plate


def test_a_quadratic_energy_is_symmetric_to_the_last_bit():
    """Its gradient is A x: of a matrix that rounding has left askew the energy would drift."""
    A = np.array([[2.0, 0.3 + 2e-13], [0.3, 1.0]])
    assert np.array_equal(lt.Quadratic(A).A, lt.Quadratic(A).A.T)


def test_functions_outside_their_domain_everywhere():
    with pytest.raises(lt.InputError, match=r"check\(points"):
        lt.LiePoissonSystem(mf.so(3), lambda mu: jnp.log(-jnp.dot(mu, mu)), SPHERE)


def test_the_report_counts_points_outside_the_domain():
    system = lt.LiePoissonSystem(mf.so(3), lambda mu: jnp.sqrt(mu[0]), SPHERE)
    report = system.check(samples=32)
    assert report.passed
    assert 0 < report.points < 32
    assert "outside the domain" in str(report)
    assert system.check(points=state_of(mf.so(3), 0) ** 2 + 0.1).points == 1


class Unstartable(lt.LiePoissonSystem):
    domain = Domain(why_entropy_gradient_infinite=lambda x: "its gradient is infinite")


class UnstartableOnASpace(lt.MetriplecticSystem):
    domain = Unstartable.domain


def test_members_that_are_not_called_any_more_are_refused():
    """A kind of system of an earlier version, whose own ``outside`` would not be asked."""
    with pytest.raises(TypeError, match=r"Earlier defines outside, which nothing calls\. Override domain"):
        type("Earlier", (lt.MetriplecticSystem,), {"outside": lambda self, x: "too hot"})
    kind = type("Kind", (lt.MetriplecticSystem,), {"domain": Domain(why_outside=lambda x: "too hot")})
    assert kind(None, lambda x: x[0] ** 2, dim=1).domain.why_outside(jnp.ones(1)) == "too hot"


def test_members_that_were_renamed_are_refused_under_their_old_names():
    """An override of the old name would have no effect; ``preserved``, which methods of users call, still works."""
    for name, replacement in REPLACED_MEMBERS.items():
        assert hasattr(lt.MetriplecticSystem, replacement)
        with pytest.raises(TypeError, match=rf"defines {name}, which nothing calls\. Override {replacement}"):
            type("Earlier", (lt.MetriplecticSystem,), {name: None})
    friction = lt.ProjectedMetric(preserve=(lambda x: x[0],), rate=0.1)
    system = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), SPHERE, friction, validate=False)
    (preserved,) = system.preserved
    assert preserved is system.preserved_functions[0]


def test_what_a_system_says_of_first_states_is_heard_through_what_it_is_run_as():
    """Beside an attitude, in the space around a manifold, and with a clock."""
    energy, entropy = lt.Quadratic([1.0, 1 / 2, 1 / 3]), lt.Quadratic(np.ones(3))
    body = Unstartable(mf.so(3), energy, entropy, lt.KillingDissipation(0.1), group=mf.SO(3))
    driven = Unstartable(mf.so(3), energy, entropy, lt.KillingDissipation(0.1), torque=lambda t, mu: 0.1 * mu)
    on_sphere = UnstartableOnASpace(
        None, lambda x: x[2], lambda x: x[0], lt.ProjectedMetric(rate=0.1), space=mf.Sphere(2), validate=False
    )
    for system in (body, driven, on_sphere):
        with pytest.raises(lt.InputError, match="cannot start at this x0: its gradient is infinite"):
            lt.integrate(system, [0.0, 0.0, 1.0], (0.0, 1.0), 0.1)
