"""Every dissipation on every algebra: the algebra of K, continuous and discrete, and rejected input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.base import REPLACED_MEMBERS
from tests.cases import (
    ALGEBRAS,
    DISSIPATIONS,
    REPRESENTATIVE,
    TRANSCENDENTAL,
    build,
    combinations,
    covering,
    energy_of,
    entropy_of,
    kind_of,
    state_of,
    tolerance,
)
from tests.refusals import refusal_test

SAMPLES = 5
"""Number of test points on each algebra."""


def points(g):
    return np.array([state_of(g, seed) for seed in range(SAMPLES)])


REASON_FOR_NO_CASE = {
    "AdiabaticJumps": "it acts on density matrices: see test_adiabatic",
    "BathConduction": "it acts on baths alone: see test_bath_conduction",
    "Friction": "it acts on velocities: see test_torques and test_factor",
    "LandauLifshitz": "it acts on spins: see test_planes and the tests of peers",
    "LindbladJumps": "it acts on density matrices: see test_lindblad",
    "LocalProjectedMetric": "it acts on sites: see test_sites",
    "SteepestEntropyAscent": "it acts on density matrices: see test_quantum",
    "ThermalJumps": "it acts on density matrices: see test_quantum",
}
"""Reason why a public dissipation is no case of ``DISSIPATIONS``."""


def test_every_dissipation_is_a_case_or_has_a_reason():
    classes = [getattr(lt, name) for name in lt.__all__]
    names = {c.__name__ for c in classes if isinstance(c, type) and issubclass(c, lt.Dissipation)}
    terms = [term for case in DISSIPATIONS for term in build(mf.so(3), case).total_dissipation.terms]
    tested_names = {base.__name__ for term in terms for base in type(term).__mro__}
    missing = names - tested_names - set(REASON_FOR_NO_CASE)
    assert not missing, f"add a case to DISSIPATIONS in tests/cases.py, or a reason here: {sorted(missing)}"


@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    ("g", "case"),
    covering(
        combinations(ALGEBRAS),
        lambda g, case: ((kind_of(g), case.name), (g.name, DISSIPATIONS.index(case) % 2)),
    ),
)
def test_axioms_hold(g, case):
    """K is symmetric and semidefinite, K grad H = 0, and the laws hold: the system's own report passes."""
    report = build(g, case).check(points=points(g))
    assert report.passed, f"\n{report}"


def discrete_properties(system, g):
    """Return the largest |dgrad H . force| and the smallest grad S . force, relative, over random gradients."""

    def at(x, dH, dS, dL):
        force = system.dissipation.force(system, x, dH, dS, dL)
        size = jnp.linalg.norm(force)
        size = jnp.where(size > 0.0, size, 1.0)
        return jnp.dot(dH, force) / (size * jnp.linalg.norm(dH)), jnp.dot(dS, force) / (size * jnp.linalg.norm(dS))

    rng = np.random.default_rng(0)
    x = points(g)
    dH = jax.vmap(system.energy.gradient)(x) + 0.1 * rng.standard_normal(x.shape)  # not the gradient of H anywhere
    dS = jax.vmap(system.entropy.gradient)(x)
    dL = tuple(jax.vmap(L.gradient)(x) + 0.1 * rng.standard_normal(x.shape) for L in system.preserved_functions)
    energy_residuals, productions = jax.vmap(at)(x, dH, dS, dL)
    return float(jnp.max(jnp.abs(energy_residuals))), float(jnp.min(productions))


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("g", "case"), covering(combinations(REPRESENTATIVE), lambda g, case: [(g.is_semisimple(), case.name)])
)
def test_any_vector_in_place_of_the_gradient_is_in_the_kernel(g, case):
    """BFM (4.6), Remark 4.7: a vector that is not grad H is in the kernel of the K_d made from it, and K_d >= 0."""
    system = build(g, case)
    energy_defect, production = discrete_properties(system, g)
    if system.energy_law == "conserved":
        assert energy_defect <= 10 * tolerance("kernel")
    if system.entropy_law == "nondecreasing":
        assert production >= -10 * tolerance("kernel")


@pytest.mark.sampled(7)
@pytest.mark.parametrize("g", [g for g in ALGEBRAS if g.casimir_count() and not g.is_abelian()], ids=lambda g: g.name)
def test_killing_dissipation_works_or_refuses_with_a_reason(g):
    """Over the whole catalogue the laws hold, or the dissipation is rejected with the right reason."""
    case = DISSIPATIONS[0]
    reason = case.exempt(g)
    if reason is None:
        system = build(g, case)
        assert system.check(points=points(g)).passed
        return
    with pytest.raises(lt.LiethermoError) as refusal:
        build(g, case)
    message = str(refusal.value)
    assert "ProjectedMetric" in message
    assert "InnerProductDissipation" in message
    if "indefinite" in reason:
        assert isinstance(refusal.value, lt.IndefiniteError)
        assert refusal.value.residual < 0


@pytest.mark.parametrize("scale", [1e-9, 1e-6, 1e6])
def test_killing_dissipation_on_a_basis_of_any_scale(scale):
    """The units of an algebra do not change whether it counts as solvable, or its Killing form as indefinite."""
    form = lt.KillingDissipation.inner_product

    def rescale_basis(g):
        return mf.LieAlgebra.from_structure_constants(scale * g.structure_constants)

    for g in (mf.so(3), mf.sl(2), mf.se(3)):
        np.testing.assert_allclose(form(rescale_basis(g)), scale**2 * form(g), rtol=1e-12, atol=1e-12 * scale**2)
    H, S = energy_of(3, 0), lt.Quadratic(np.ones(3))
    assert lt.LiePoissonSystem(rescale_basis(mf.so(3)), H, S, lt.KillingDissipation()).dissipation.form is not None
    with pytest.raises(lt.InputError, match=r"solvable.* use ProjectedMetric"):
        lt.LiePoissonSystem(rescale_basis(mf.se(2)), H, lt.Quadratic(np.diag([0.0, 1, 1])), lt.KillingDissipation())
    with pytest.raises(lt.IndefiniteError, match="indefinite"):
        form(rescale_basis(mf.gl(2)))


def test_killing_on_so3_is_the_projected_metric():
    """-kappa / 2 is the dot product: rate 1/2 reproduces (2.2) and the relaxed rigid body."""
    g, H, S = mf.so(3), energy_of(3, 0), lt.Quadratic(np.ones(3))
    x = points(g)
    killing_field = lt.LiePoissonSystem(g, H, S, lt.KillingDissipation(rate=0.5)).vector_field(x)
    metric_field = lt.LiePoissonSystem(g, H, S, lt.ProjectedMetric()).vector_field(x)
    assert np.allclose(killing_field, metric_field, rtol=0, atol=1e-13)
    bracket = lt.FourBracket.kulkarni_nomizu(np.eye(3) / 2, np.eye(3))
    assert np.allclose(lt.LiePoissonSystem(g, H, S, bracket).vector_field(x), metric_field, rtol=0, atol=1e-13)
    inner_product_field = lt.LiePoissonSystem(g, H, S, lt.InnerProductDissipation(np.eye(3))).vector_field(x)
    assert np.allclose(inner_product_field, metric_field, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_the_relaxed_body_as_printed():
    """BFM Example 3.2: Pi' = Pi × Omega + |Omega|^2 Pi - (Omega . Pi) Omega, also from the force F = Omega × Pi."""
    inertia, system = np.array([10.0, 5.0, 1.0]), lt.models.rigid_body(inertia=(10, 5, 1), rate=1.0)
    Pi = np.array([0.3, 1.0, -0.2])
    Omega = Pi / inertia
    printed_field = np.cross(Pi, Omega) + Omega @ Omega * Pi - Omega @ Pi * Omega
    assert np.allclose(system.vector_field(Pi), printed_field, rtol=0, atol=1e-15)
    forced_system = lt.EulerPoincareSystem(
        mf.so(3),
        lagrangian=lambda w: 0.5 * jnp.sum(inertia * w * w),
        entropy=lt.Quadratic(np.ones(3)),
        force=lambda w: jnp.cross(w, inertia * w),
    )
    assert np.allclose(forced_system.vector_field(Pi), printed_field, rtol=0, atol=1e-14)


def test_normalisations_differ_by_the_length_of_dH():
    g, H, S = mf.so(3), energy_of(3, 0), lt.Quadratic(np.ones(3))
    G, x = np.diag([1.0, 2.0, 0.5]), np.array([0.3, -0.7, 0.4])
    K_full, K_normalized = (
        lt.LiePoissonSystem(g, H, S, lt.ProjectedMetric(G, normalized=choice)).friction_matrix(x)
        for choice in (False, True)
    )
    dH = np.asarray(H.gradient(x))
    assert np.allclose(K_full, dH @ G @ dH * K_normalized, rtol=0, atol=1e-14)
    assert np.allclose(K_full, (dH @ G @ dH) * G - np.outer(G @ dH, G @ dH), rtol=0, atol=1e-14)


def test_preserved_functions_and_dependent_ones():
    """The gradients of preserved functions are in the kernel of K; a function of H changes nothing."""
    g, H, S = mf.so(4), energy_of(6, 0), lt.Quadratic(np.eye(6))
    L, M, x = lt.Quadratic(np.diag(np.arange(1.0, 7.0))), lambda y: jnp.sin(y[0] + y[3]), np.linspace(-1, 1, 6)
    for normalized in (False, True):
        system = lt.LiePoissonSystem(g, H, S, lt.ProjectedMetric(preserve=(L, M), normalized=normalized))
        K = np.asarray(system.friction_matrix(x))
        for gradient in (H.gradient(x), L.gradient(x), jax.grad(M)(x)):
            assert np.abs(K @ gradient).max() <= 1e-13 * np.abs(K).max() * np.abs(gradient).max()
        assert np.linalg.matrix_rank(K, tol=1e-10 * np.abs(K).max()) == 3
    squared_energy = lt.ProjectedMetric(preserve=(lambda y: H.value(y) ** 2,), normalized=True)
    K = lt.LiePoissonSystem(g, H, S, squared_energy).friction_matrix(x)
    K_without = lt.LiePoissonSystem(g, H, S, lt.ProjectedMetric(normalized=True)).friction_matrix(x)
    assert np.allclose(K, K_without, atol=1e-12)


def test_friction_operator_keeps_its_other_kernel_vectors():
    """Remark 4.7: kernel vectors of K orthogonal to grad H (momentum maps) stay in the kernel of K_d."""
    rng = np.random.default_rng(0)
    kernel_vector, H = np.array([0.0, 0.0, 1.0, 0.0]), lt.Quadratic(np.diag([1.0, 2.0, 0.0, 3.0]))
    random_vector = rng.standard_normal(4)

    def K(x):
        frame = jnp.linalg.qr(
            jnp.stack([H.gradient(x), jnp.asarray(kernel_vector), jnp.asarray(random_vector)], axis=1)
        )[0]
        return jnp.outer(frame[:, 2], frame[:, 2])

    system = lt.MetriplecticSystem(np.zeros((4, 4)), H, lambda x: x[0] + x[2] ** 2, lt.FrictionOperator(K))
    x, dH = rng.standard_normal(4), np.asarray(H.gradient(rng.standard_normal(4)))
    K_d = np.asarray(jax.jacfwd(lambda dS: system.dissipation.force(system, x, dH, dS, ()))(jnp.zeros(4)))
    assert np.abs(K_d @ kernel_vector).max() <= 1e-14
    assert np.abs(K_d @ dH).max() <= 1e-13
    assert np.allclose(K_d, K_d.T, atol=1e-14)
    assert np.linalg.eigvalsh(K_d)[0] >= -1e-14


def test_dissipations_add():
    g, H, S = mf.so(3), energy_of(3, 0), lt.Quadratic(np.ones(3))
    a, b = lt.ProjectedMetric(rate=0.3), lt.KillingDissipation(rate=0.2)
    x = points(g)
    conservative = lt.LiePoissonSystem(g, H, S)
    total = lt.LiePoissonSystem(g, H, S, a + b).vector_field(x)
    force_fields = [lt.LiePoissonSystem(g, H, S, d).vector_field(x) - conservative.vector_field(x) for d in (a, b)]
    rounding = 4e-16 * np.abs(total).max()
    assert np.abs(total - conservative.vector_field(x) - force_fields[0] - force_fields[1]).max() <= rounding
    mixed_laws = lt.LiePoissonSystem(g, H, S, a + lt.DoubleBracket(0.1))
    assert (mixed_laws.energy_law, mixed_laws.entropy_law) == ("nonincreasing", "nondecreasing")
    without_law = lt.LiePoissonSystem(g, H, S, a + lt.EulerPoincareForce(lambda xi: xi))
    assert without_law.entropy_law is None


@pytest.mark.parametrize("parts", [list, tuple])
def test_a_list_of_dissipations_is_their_sum(parts):
    """A list works in the constructor of every kind of system that takes a dissipation, also beside a force."""
    H, S, x = lt.Quadratic([1 / 3, 1 / 2, 1.0]), lt.Quadratic(np.ones(3)), points(mf.so(3))
    a, b, damping = lt.ProjectedMetric(rate=0.3), lt.KillingDissipation(rate=0.2), lt.LandauLifshitz(0.1)

    def force(xi):
        return 0.1 * xi * xi

    makers = [
        (lambda given: lt.LiePoissonSystem(mf.so(3), H, S, given), (a, b)),
        (lambda given: lt.EulerPoincareSystem(mf.so(3), lt.Quadratic([3.0, 2.0, 1.0]), S, given), (a, b)),
        (lambda given: lt.EulerPoincareSystem(mf.so(3), lt.Quadratic([3.0, 2.0, 1.0]), S, given, force), (a, b)),
        (lambda given: lt.MetriplecticSystem(None, H, lambda y: y[0], given, dim=3), (a, lt.ProjectedMetric(rate=0.1))),
        (lambda given: lt.SpinSystem(1, lambda s: s[0, 0] * s[0, 1], given), (damping, lt.LandauLifshitz(0.3))),
    ]
    for make, pair in makers:
        from_sequence, from_sum = make(parts(pair)), make(pair[0] + pair[1])
        assert len(from_sequence.dissipation.terms) == len(from_sum.dissipation.terms) >= 2
        assert np.array_equal(from_sequence.vector_field(x), from_sum.vector_field(x))
        assert not np.allclose(from_sequence.vector_field(x), make(pair[0]).vector_field(x), rtol=1e-3)
    single = lt.LiePoissonSystem(mf.so(3), H, S, parts([a]))
    assert isinstance(single.dissipation, lt.ProjectedMetric)


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ([], "dissipation is an empty list"),
        ((), "dissipation is an empty list"),
        ([lt.DoubleBracket(0.1), None], r"dissipation\[1\] must be a Dissipation of this library, got NoneType"),
        ([[lt.DoubleBracket(0.1)]], r"dissipation\[0\] must be a Dissipation of this library, got list"),
        ("friction", "a list of them or None, got str"),
        ([lt.DoubleBracket(0.1), lt.KillingDissipation(0.1)], "KillingDissipation increases the entropy"),
    ],
)
def test_invalid_lists_of_dissipations(argument, words):
    """The error is one line that names the entry, also beside a force."""
    H = lt.Quadratic([1 / 3, 1 / 2, 1.0])
    for kind, options in ((lt.LiePoissonSystem, {}), (lt.EulerPoincareSystem, {"force": lambda xi: xi})):
        with pytest.raises(lt.InputError, match=words) as caught:
            kind(mf.so(3), H, None, argument, **options)
        assert "\n" not in str(caught.value)


# -- controls: what must fail -------------------------------------------------------------------------------------


def test_a_dissipation_that_overrides_a_member_by_its_former_name_is_refused():
    """An override by the former name would have no effect."""
    assert REPLACED_MEMBERS["velocity"] == "added_attitude_velocity"
    for name, replacement in REPLACED_MEMBERS.items():
        assert hasattr(lt.Dissipation, replacement)
        assert not hasattr(lt.Dissipation, name)
        with pytest.raises(TypeError, match=rf"^Earlier defines {name}, which nothing calls\. Override {replacement}$"):
            type("Earlier", (lt.Friction,), {name: None})
        type("Present", (lt.Friction,), {replacement: getattr(lt.Friction, replacement)})


class WrongEnergy(lt.Dissipation):
    """Control: a projected metric built from the gradient of another function than H."""

    def force(self, system, x, dH, dS, dL):
        wrong_dH = dH + jnp.ones_like(dH)
        return jnp.dot(wrong_dH, wrong_dH) * dS - jnp.dot(wrong_dH, dS) * wrong_dH


class WrongSign(lt.Dissipation):
    """Control: minus a projected metric."""

    def force(self, system, x, dH, dS, dL):
        return jnp.dot(dH, dS) * dH - jnp.dot(dH, dH) * dS


@pytest.mark.parametrize(
    ("dissipation", "failing"),
    [(WrongEnergy(), {"K grad H = 0", "energy law"}), (WrongSign(), {"K >= 0", "entropy law"})],
    ids=["wrong energy", "wrong sign"],
)
def test_a_wrong_dissipation_fails_its_axioms_and_only_those(dissipation, failing):
    system = lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), lt.Quadratic(np.ones(3)), dissipation, validate=False)
    report = system.check()
    assert {row.axiom for row in report.rows if row.passed is False} == failing
    assert "NOT metriplectic" in str(report)
    with pytest.raises(lt.AxiomError):
        lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), lt.Quadratic(np.ones(3)), dissipation)


ANISOTROPIC_ENERGY = lt.Quadratic(np.array([1.0, 2.0, 5.0]))
"""Energy of a body with three different moments of inertia."""


@pytest.mark.parametrize(
    "K",
    [
        np.eye(3),
        lambda x: jnp.diag(x**2),
        lambda x: jnp.outer(
            ANISOTROPIC_ENERGY.gradient(x), jnp.cross(jnp.ones(3), ANISOTROPIC_ENERGY.gradient(x))
        ),  # K grad H = 0 alone
    ],
    ids=["constant", "function", "one side"],
)
def test_a_friction_operator_is_not_repaired_unasked(K):
    """K grad H is not zero: without project=True the system would use a projection that nobody asked for."""
    arguments = mf.so(3), ANISOTROPIC_ENERGY, lt.Quadratic(np.ones(3))
    with pytest.raises(lt.AxiomError, match=r"as given fails.*project=True") as caught:
        lt.LiePoissonSystem(*arguments, lt.FrictionOperator(K))
    assert caught.value.residual > 0.05
    report = lt.LiePoissonSystem(*arguments, lt.FrictionOperator(K), validate=False).check()
    assert "K grad H = 0, as given" in [row.axiom for row in report.rows if row.passed is False]


def _drag_and_its_heat(x):
    v = jnp.array([0.0, 1.0, -x[1] / jnp.exp(x[2])])  # orthogonal to grad (H + U) = (q, p, T)
    return 0.3 * jnp.exp(x[2]) * jnp.outer(v, v)


def test_a_friction_operator_drives_the_entropies_of_baths():
    """A friction operator works with the entropies of baths alone; it once needed an entropy of the body."""
    oscillator, baths = lt.Quadratic(np.ones(2)), lt.HeatBaths(1.0, 1.0)
    operator, drag = lt.FrictionOperator(_drag_and_its_heat), lt.Friction([0.0, 0.3])
    system = lt.MetriplecticSystem(mf.Canonical(1), oscillator, dissipation=operator, baths=baths)
    drag_system = lt.MetriplecticSystem(mf.Canonical(1), oscillator, dissipation=drag, baths=baths)
    x = np.random.default_rng(0).standard_normal((5, 3))
    np.testing.assert_allclose(system.vector_field(x), drag_system.vector_field(x), rtol=0, atol=1e-14)
    assert system.check().passed
    run = lt.integrate(system, [1.0, 0.7], (0.0, 5.0), 0.1)
    assert run.audit().passed, f"\n{run.audit()}"
    sum_system = lt.MetriplecticSystem(mf.Canonical(1), oscillator, dissipation=[drag, operator], baths=baths)
    np.testing.assert_allclose(
        sum_system.vector_field(x),
        drag_system.vector_field(x) + system.vector_field(x) - _conservative_field(x),
        rtol=0,
        atol=1e-14,
    )
    with pytest.raises(lt.InputError, match=r"\(3, 3\) matrix for a state of 3 components"):
        lt.MetriplecticSystem(mf.Canonical(1), oscillator, dissipation=lt.FrictionOperator(np.eye(2)), baths=baths)
    with pytest.raises(lt.InputError, match=r"besides the entropies of its baths\. Give entropy="):
        lt.LiePoissonSystem(mf.so(3), ANISOTROPIC_ENERGY, dissipation=lt.KillingDissipation(), baths=baths)


def _conservative_field(x):
    return np.stack([x[:, 1], -x[:, 0], 0.0 * x[:, 0]], axis=1)


def test_a_friction_operator_that_is_to_be_projected():
    system = lt.LiePoissonSystem(
        mf.so(3), ANISOTROPIC_ENERGY, lt.Quadratic(np.ones(3)), lt.FrictionOperator(np.eye(3), 0.3, True)
    )
    assert system.check().passed
    metric = lt.ProjectedMetric(normalized=True, rate=0.3)
    metric_system = lt.LiePoissonSystem(mf.so(3), ANISOTROPIC_ENERGY, lt.Quadratic(np.ones(3)), metric)
    x = points(mf.so(3))
    assert np.abs(system.vector_field(x) - metric_system.vector_field(x)).max() <= 1e-14


ASYMMETRIC_FORM = lambda x: jnp.eye(3).at[0, 1].set(x[2])  # noqa: E731
"""Control: a form that is not symmetric."""
INDEFINITE_FORM = lambda x: jnp.diag(jnp.array([1.0, -1.0, 1.0]))  # noqa: E731
"""Control: a form with a negative eigenvalue."""


@pytest.mark.parametrize(
    ("dissipation", "words"),
    [
        (lt.ProjectedMetric(ASYMMETRIC_FORM), "K symmetric"),
        (lt.ProjectedMetric(ASYMMETRIC_FORM, normalized=True), "K symmetric"),
        (lt.ProjectedMetric(INDEFINITE_FORM), "K >= 0"),
        (lt.FourBracket.kulkarni_nomizu(ASYMMETRIC_FORM, np.eye(3)), "K symmetric"),
        (lt.FourBracket.kulkarni_nomizu(INDEFINITE_FORM, INDEFINITE_FORM), "K >= 0"),
        (lt.FourBracket(lambda x: x[0] * jnp.ones((3, 3, 3, 3))), "K grad H = 0"),
    ],
    ids=["cometric", "normalized", "signed cometric", "form", "signed forms", "four-bracket"],
)
def test_functions_of_the_state_are_not_repaired_either(dissipation, words):
    with pytest.raises(lt.AxiomError, match=words):
        lt.LiePoissonSystem(mf.so(3), ANISOTROPIC_ENERGY, lt.Quadratic(np.ones(3)), dissipation)


test_unusable_dissipations = refusal_test(
    (lambda: lt.InnerProductDissipation(np.diag([1.0, -1.0, 1.0])), "negative eigenvalue -1", lt.IndefiniteError),
    (lambda: lt.InnerProductDissipation([[0, 1], [0, 0]]), "not symmetric"),
    (lambda: lt.InnerProductDissipation(np.ones(3)), "square"),
    (lambda: lt.ProjectedMetric(np.diag([1.0, -1.0])), "cometric", lt.IndefiniteError),
    (lambda: lt.ProjectedMetric(rate=-1.0), ">= 0"),
    (lambda: lt.KillingDissipation(rate=np.nan), ">= 0"),
    (lambda: lt.KillingDissipation(rate=[1.0, 2.0]), "one number"),
    (lambda: lt.FourBracket(np.ones((2, 2, 2, 2))), r"R\[i,j,k,l\] = -R\[j,i,k,l\]"),
    (lambda: lt.FourBracket(np.ones((2, 2, 2))), r"\(n, n, n, n\)"),
    (lambda: lt.FrictionOperator(-np.eye(2)), "friction operator", lt.IndefiniteError),
    (lambda: lt.InnerProductDissipation(lambda x: np.eye(3)), "a constant matrix, got a function"),
    (lambda: lt.DoubleBracket(metric=-np.eye(2)), "metric", lt.IndefiniteError),
)


@pytest.mark.parametrize(
    "dissipation",
    [
        lt.InnerProductDissipation(np.eye(2)),
        lt.FrictionOperator(lambda x: x),
        lt.FourBracket(np.zeros((2, 2, 2, 2))),
        lt.FourBracket.kulkarni_nomizu(np.eye(2), np.eye(3)),
        lt.DoubleBracket(metric=np.eye(2)),
        lt.EulerPoincareForce(lambda xi: xi[:2]),
    ],
    ids=lambda d: type(d).__name__,
)
def test_dissipations_of_the_wrong_size(dissipation):
    with pytest.raises((lt.InputError, lt.FunctionError), match=r"3|dimension"):
        lt.LiePoissonSystem(mf.so(3), energy_of(3, 0), lt.Quadratic(np.ones(3)), dissipation)


test_algebra_dissipations_need_an_algebra = refusal_test(
    (
        lambda: lt.MetriplecticSystem(mf.Canonical(1), lambda x: x @ x, lambda x: 0.0 * x[0], lt.KillingDissipation()),
        "Lie algebra",
    ),
)


def test_every_transcendental_casimir_is_one():
    """The table of the test suite is checked too: a wrong Casimir would weaken every test that uses it."""
    for g in ALGEBRAS:
        if g.name in TRANSCENDENTAL:
            system = lt.LiePoissonSystem(g, energy_of(3, 0), entropy_of(g), validate=False)
            assert system.check(points=points(g)).passed


def test_a_dissipation_that_extends_another_stays_what_it_is():
    """Binding to a system keeps the subclass: otherwise its own force would be lost silently."""

    class DoubledKilling(lt.KillingDissipation):
        def added_momentum(self, dH, turned):
            return 2.0 * super().added_momentum(dH, turned)

    def friction(dissipation):
        system = lt.LiePoissonSystem(
            mf.so(3), lt.Quadratic([1.0, 2.0, 3.0]), lt.Quadratic(-np.ones(3)), dissipation=dissipation
        )
        return np.asarray(system.friction_matrix(np.array([0.3, -1.0, 0.7])))

    friction_matrix = friction(lt.KillingDissipation(0.3))
    assert np.abs(friction_matrix).max() > 0.01
    np.testing.assert_allclose(friction(DoubledKilling(0.3)), 2.0 * friction_matrix, rtol=1e-14)


@pytest.mark.parametrize("kind", [lt.ProjectedMetric, lt.Friction, lt.FrictionOperator])
def test_a_rate_in_place_of_a_matrix_is_rejected(kind):
    with pytest.raises(
        lt.InputError, match=f"^{kind.__name__} takes .*, got the number 0.3. For a rate give rate=0.3$"
    ):
        kind(0.3)
    assert float(kind(np.eye(3), rate=0.3).rate) == 0.3


def test_two_ways_to_move_the_kernel_of_a_friction_operator():
    """BFM Remark 4.7: the orthogonal projection, by its matrix; the oblique one differs by O(h^3) in a step."""
    root = np.random.default_rng(3).standard_normal((3, 3))
    x, ones = np.array([0.4, -0.7, 0.9]), lt.Quadratic(np.ones(3))

    def system(projection):  # where H is quadratic the discrete gradient is that at the midpoint, and both are one
        return lt.LiePoissonSystem(
            mf.so(3),
            lambda m: 0.5 * m @ m + 0.3 * jnp.sum(m**4),
            ones,
            lt.FrictionOperator(root @ root.T, 0.3, project=True, projection=projection),
        )

    dH, dS = np.array([0.3, 1.1, -0.2]), np.array([0.5, 0.2, 0.7])
    P_off = np.eye(3) - np.outer(dH, dH) / (dH @ dH)
    formula = 0.3 * P_off @ root @ root.T @ P_off @ dS
    orthogonal = system("orthogonal")
    force = np.asarray(orthogonal.dissipation.force(orthogonal, jnp.asarray(x), dH, dS, ()))
    assert np.abs(force - formula).max() < 1e-14
    differences = {}
    for h in (0.02, 0.01):
        runs = [lt.integrate(system(p), x, (0.0, h), h, lt.MetriplecticMidpoint()) for p in ("orthogonal", "oblique")]
        assert all(run.audit().passed for run in runs)
        differences[h] = np.abs(runs[0].x[-1] - runs[1].x[-1]).max()
    assert 6.0 < differences[0.02] / differences[0.01] < 10.0  # a third power: h times what the kernels differ by
    with pytest.raises(lt.InputError, match="projection must be"):
        lt.FrictionOperator(np.eye(3), projection="skew")
