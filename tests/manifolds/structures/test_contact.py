"""Contact structures: Prop. 2.1 and (5), (6) of SML with random functions, closed forms, and controls that must fail.

Each property is one compiled function of the structure, a point and random coefficients, which returns residuals.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import manifolds as mf

MAX_RESIDUAL = 1e-11
"""Largest residual: at most 1e-12 seen, from derivatives of functions of order one and the inverse of W."""

MIN_CONTROL_RESIDUAL = 1e-3
"""Smallest residual of a control."""

seeds = st.integers(0, 10**6)


def lagrangian(n):
    """Return a regular Lagrangian with every mixed derivative: L_vq, L_vS and a Hessian W that varies."""
    coupling = 0.1 * np.random.default_rng(n).standard_normal((n, n))

    def L(x):
        q, v, S = x[:n], x[n : 2 * n], x[-1]
        mass = 1.0 + 0.2 * jnp.sin(q) ** 2
        return 0.5 * jnp.sum(mass * v**2) + v @ coupling @ q + 0.1 * jnp.sin(S) * jnp.sum(v) - jnp.cos(q[0] + S)

    return L


def general_contact_form(dim):
    """Return a structure known by its form alone: the canonical one times a function, pulled back by a map."""
    canonical, c = mf.CanonicalContact(dim // 2), 0.1 * np.random.default_rng(dim).standard_normal((dim, dim))

    def form(x):
        image, jacobian = x + jnp.sin(c @ x), jnp.eye(dim) + jnp.cos(c @ x)[:, None] * c
        return jnp.exp(0.2 * jnp.sin(x[0] - x[-1])) * canonical.form(image) @ jacobian

    return mf.ContactForm(form, dim)


def structure_param(M, *marks):
    return pytest.param(M, id=f"{type(M).__name__}-{M.dim}", marks=marks)


SPLIT_STRUCTURES = [
    structure_param(mf.CanonicalContact(2)),
    structure_param(mf.LagrangianContact(lagrangian(1), 1)),
    structure_param(mf.CanonicalContact(1), pytest.mark.slow),
    structure_param(mf.LagrangianContact(lagrangian(2), 2), pytest.mark.slow),
]
each_structure = pytest.mark.parametrize(
    "M",
    [
        *SPLIT_STRUCTURES,
        structure_param(general_contact_form(3)),
        structure_param(general_contact_form(5), pytest.mark.slow),
    ],
)
each_split = pytest.mark.parametrize("M", SPLIT_STRUCTURES)


def data(M, seed):
    """Return a point, coefficients for :func:`functions`, and two vectors or covectors."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal(M.dim), rng.standard_normal((3, M.dim)) / np.sqrt(M.dim), rng.standard_normal((2, M.dim))


def functions(coefficients):
    """Return three functions that depend on all coordinates together."""
    a, b, c = coefficients
    return (lambda x: jnp.sin(a @ x)), (lambda x: (b @ x) ** 2 + x[0]), (lambda x: jnp.exp(c @ x / 2))


def forget_closed_forms(M):
    """Return the structure that is given by the form of M alone."""
    return mf.ContactForm(M.form, M.dim)


def lie_derivative(field, form, x):
    """Return ``(L_X eta)_j = X_i d_i eta_j + eta_i d_j X_i``."""
    return jax.jacfwd(form)(x) @ field(x) + form(x) @ jax.jacfwd(field)(x)


def assert_zero(residuals):
    for name, residual in residuals.items():
        assert np.abs(np.asarray(residual)).max() <= MAX_RESIDUAL, (name, residual)


def assert_visible(residuals):
    for name, residual in residuals.items():
        assert np.abs(np.asarray(residual)).max() >= MIN_CONTROL_RESIDUAL, (name, residual)


# -- the structure ----------------------------------------------------------------------------------------------------


@eqx.filter_jit
def structure(M, x, u, v):
    eta, omega, R, bivector = M.form(x), M.differential(x), M.reeb(x), M.bivector(x)
    return {
        "skew": omega + omega.T,
        "eta(R) = 1": eta @ R - 1.0,
        "i_R d eta = 0": R @ omega,
        "flat": M.flat(x, v) - (v @ omega + (eta @ v) * eta),
        "flat(R) = eta": M.flat(x, R) - eta,
        "sharp(flat(v)) = v": M.sharp(x, M.flat(x, v)) - v,
        "horizontal in ker eta": eta @ M.horizontal(x, v),
        "the rest along R": M.horizontal(x, v) + (eta @ v) * R - v,
        "(3)": u @ bivector @ v + M.sharp(x, u) @ omega @ M.sharp(x, v),
        "bivector_sharp": M.bivector_sharp(x, u) - u @ bivector,
    }


@pytest.mark.sampled(1)
@each_structure
@given(seed=seeds)
def test_what_the_form_determines(M, seed):
    x, _, (u, v) = data(M, seed)
    assert float(M.volume(x)) > 0.1
    assert_zero(structure(M, x, u, v))


@eqx.filter_jit
def against_the_definition(M, x, alpha):
    general_form = forget_closed_forms(M)
    differences = {
        name: getattr(M, name)(x) - getattr(general_form, name)(x) for name in ("reeb", "volume", "bivector")
    }
    sharps = ("sharp", "bivector_sharp", "flat")
    return differences | {name: getattr(M, name)(x, alpha) - getattr(general_form, name)(x, alpha) for name in sharps}


@pytest.mark.sampled(1)
@each_split
@given(seed=seeds)
def test_closed_forms_follow_from_the_form(M, seed):
    """The Reeb field, sharp and the bivector of (4) and its Lagrangian counterpart (11) follow from (3)."""
    x, _, (alpha, _) = data(M, seed)
    assert_zero(against_the_definition(M, x, alpha))


@pytest.mark.slow
def test_the_volume_is_that_of_the_form():
    """n = 1: ``eta ^ d eta = eta_1 omega_23 + eta_2 omega_31 + eta_3 omega_12``; zero for a closed form."""
    M, x = general_contact_form(3), np.array([0.4, -0.7, 1.1])
    eta, omega = M.form(x), M.differential(x)
    wedge = eta[0] * omega[1, 2] + eta[1] * omega[2, 0] + eta[2] * omega[0, 1]
    assert float(M.volume(x)) == pytest.approx(abs(float(wedge)), rel=1e-12)
    assert float(mf.CanonicalContact(3).volume(np.ones(7))) == pytest.approx(1.0, abs=1e-15)
    closed_form = mf.ContactForm(lambda x: jnp.array([0.0, 0.0, 1.0]), 3)
    assert float(closed_form.volume(np.ones(3))) == 0.0
    assert not np.isfinite(closed_form.sharp(np.ones(3), np.ones(3))).all()


@eqx.filter_jit
def liouville(M, x):
    eta, omega, delta = M.form(x), M.differential(x), M.liouville(x)
    onto_kernel = jnp.eye(M.dim) - jnp.outer(M.reeb(x), eta)
    return {
        "in ker eta": eta @ delta,
        "i_Delta d eta = -p dq on ker eta": (delta @ omega - (eta - jnp.eye(M.dim)[-1])) @ onto_kernel,
    }


@each_split
@given(seed=seeds)
def test_liouville_field(M, seed):
    """Delta = p d/dp (2); printed with ``i_Delta omega = +p dq``, which is -Delta for omega = d eta."""
    assert_zero(liouville(M, data(M, seed)[0]))


# -- Proposition 2.1 --------------------------------------------------------------------------------------------------


@eqx.filter_jit
def proposition_2_1(M, x, coefficients):
    f = functions(coefficients)[0]
    X, E = M.hamiltonian_vector_field(f), M.evolution_vector_field(f)
    eta, df = M.form(x), jax.grad(f)(x)
    Rf = df @ M.reeb(x)
    return {
        "X_f(f) = -R(f) f": df @ X(x) + Rf * f(x),
        "E_f(f) = 0": df @ E(x),
        "L_X eta = -R(f) eta": lie_derivative(X, M.form, x) + Rf * eta,
        "L_E eta = -R(f) eta + df": lie_derivative(E, M.form, x) + Rf * eta - df,
        "i_X eta = -f": eta @ X(x) + f(x),
        "i_E eta = 0": eta @ E(x),
        "flat(X_f)": M.flat(x, X(x)) - (df - (Rf + f(x)) * eta),
        "flat(E_f)": M.flat(x, E(x)) - (df - Rf * eta),
    }


@pytest.mark.sampled(1)
@each_structure
@given(seed=seeds)
def test_proposition_2_1(M, seed):
    assert_zero(proposition_2_1(M, *data(M, seed)[:2]))


@pytest.mark.sampled(2)
@each_structure
def test_a_contact_field_is_a_reeb_field(M):
    """Theorem 2.2: where f is not zero, X_f is the Reeb field of -eta/f (printed: of eta/f)."""
    f, x = (lambda y: 2.0 + jnp.sin(jnp.sum(y))), data(M, 3)[0]
    scaled_form = mf.ContactForm(lambda y: -M.form(y) / f(y), M.dim)
    assert np.allclose(
        jax.jit(scaled_form.reeb)(x), jax.jit(M.hamiltonian_vector_field(f))(x), rtol=0, atol=MAX_RESIDUAL
    )


def test_fields_in_coordinates():
    """The printed coordinate forms of X_f and E_f (7), for the damped oscillator with mass [SML Example 1]."""
    m, gamma, (q, p, S) = 2.0, 0.3, (0.7, -1.1, 0.4)
    H = lambda x: x[1] ** 2 / (2 * m) + 0.25 * x[0] ** 4 + gamma * x[2]  # noqa: E731
    M = mf.CanonicalContact(1)
    evolution = np.array([p / m, -(q**3) - gamma * p, p**2 / m])
    assert np.allclose(M.evolution_vector_field(H)([q, p, S]), evolution, rtol=0, atol=1e-15)
    energy = float(H(jnp.array([q, p, S])))
    assert np.allclose(M.hamiltonian_vector_field(H)([q, p, S]), evolution - [0, 0, energy], rtol=0, atol=1e-15)


@pytest.mark.slow
def test_a_lagrangian_in_coordinates():
    """``R_L = d/dS - W^ij L_{v_j S} d/dv_i``, the Hessian (8) and the energy, as printed in §3.1."""
    n, L = 2, lagrangian(2)
    M = mf.LagrangianContact(L, n)
    x = data(M, 5)[0]
    hessian, gradient = jax.hessian(L)(x), jax.grad(L)(x)
    W = hessian[n : 2 * n, n : 2 * n]
    reeb = [*np.zeros(n), *-np.linalg.solve(W, hessian[n : 2 * n, -1]), 1.0]
    assert np.allclose(M.hessian(x), W, rtol=0, atol=MAX_RESIDUAL)
    assert np.allclose(M.reeb(x), reeb, rtol=0, atol=MAX_RESIDUAL)
    assert float(M.energy(x)) == pytest.approx(float(x[n : 2 * n] @ gradient[n : 2 * n] - L(x)), abs=1e-14)
    assert np.allclose(M.legendre(x), [*x[:n], *gradient[n : 2 * n], x[-1]], rtol=0, atol=1e-14)


# -- brackets ---------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def brackets(M, x, coefficients):
    f, g, h = functions(coefficients)
    cartan, jacobi = M.cartan_bracket, M.jacobi_bracket
    df, dg, R = jax.grad(f)(x), jax.grad(g)(x), M.reeb(x)
    gh = lambda y: g(y) * h(y)  # noqa: E731
    leibniz_sum = lambda bracket: g(x) * bracket(f, h)(x) + h(x) * bracket(f, g)(x)  # noqa: E731
    return {
        "[f, g] skew": cartan(f, g)(x) + cartan(g, f)(x),
        "{f, g} skew": jacobi(f, g)(x) + jacobi(g, f)(x),
        "[f, g] obeys Leibniz": cartan(f, gh)(x) - leibniz_sum(cartan),
        "(5) with E = -R": jacobi(f, gh)(x) - (leibniz_sum(jacobi) - g(x) * h(x) * (df @ R)),
        "[f, g] = E_f(g)": cartan(f, g)(x) - dg @ M.evolution_vector_field(f)(x),
        "{f, g} = X_f(g) + g R(f)": jacobi(f, g)(x) - dg @ M.hamiltonian_vector_field(f)(x) - g(x) * (df @ R),
    }


@pytest.mark.sampled(1)
@each_structure
@given(seed=seeds)
def test_brackets(M, seed):
    assert_zero(brackets(M, *data(M, seed)[:2]))


@eqx.filter_jit
def jacobi_structure(M, x):
    tensor = lambda y: jax.vmap(lambda alpha: M.bivector_sharp(y, alpha))(jnp.eye(M.dim))  # noqa: E731
    R, dR, L, dL = M.reeb(x), jax.jacfwd(M.reeb)(x), tensor(x), jax.jacfwd(tensor)(x)
    cyclic = lambda a: a + a.transpose(1, 2, 0) + a.transpose(2, 0, 1)  # noqa: E731
    schouten = cyclic(jnp.einsum("il,jkl->ijk", L, dL))
    lie_derivative_of_L = jnp.einsum("l,jkl->jk", R, dL) - dR @ L - L @ dR.T
    return {
        "[L, L] = 2 E ^ L": schouten - cyclic(jnp.einsum("i,jk->ijk", R, L)),
        "[L, E] = 0": lie_derivative_of_L,
    }, schouten


@pytest.mark.sampled(1)
@each_structure
def test_the_bivector_and_the_reeb_field_are_a_jacobi_structure(M):
    """Components of [Lambda, Lambda] = 2 E ^ Lambda and [Lambda, E] = 0, E = -R: Lambda by itself is not Poisson."""
    holds, schouten = jacobi_structure(M, data(M, 7)[0])
    assert_zero(holds)
    assert_visible({"Lambda is Poisson": schouten})


def test_which_bracket_obeys_the_jacobi_identity():
    """The Jacobi bracket does; the Cartan bracket, as a control, does not."""
    M = mf.CanonicalContact(1)
    x, coefficients, _ = data(M, 7)
    f, g, h = functions(coefficients)

    def cyclic(bracket):
        return jax.jit(lambda x: sum(bracket(bracket(a, b), c)(x) for a, b, c in [(f, g, h), (g, h, f), (h, f, g)]))(x)

    assert_zero({"Jacobi": cyclic(M.jacobi_bracket)})
    assert_visible({"Cartan": cyclic(M.cartan_bracket)})


@eqx.filter_jit
def splitting(M, x, coefficients):
    f, g, _ = functions(coefficients)
    df, dg, R, delta = jax.grad(f)(x), jax.grad(g)(x), M.reeb(x), M.liouville(x)
    reversible, thermodynamic = M.cosymplectic_bracket(f, g)(x), M.liouville_bracket(f, g)(x)
    poisson = mf.Cosymplectic(M)
    tensor = poisson.tensor(x)
    residuals = {
        "(6)": M.cartan_bracket(f, g)(x) - (reversible + thermodynamic),
        "{f, g}_Delta": thermodynamic - ((dg @ R) * (df @ delta) - (df @ R) * (dg @ delta)),
        "Lambda_0 = Lambda + R ^ Delta": reversible
        - df @ (forget_closed_forms(M).bivector(x) + jnp.outer(R, delta) - jnp.outer(delta, R)) @ dg,
        "Lambda_0 is Poisson": poisson.jacobi_residual(x),
        "S is its Casimir": tensor[:, -1],
        "its sign": tensor @ df - M.cosymplectic_sharp(x, df),
    }
    return residuals, tensor


@pytest.mark.sampled(1)
@each_split
@given(seed=seeds)
def test_the_cartan_bracket_splits(M, seed):
    """SML (6): a Poisson bracket with the Casimir function S, and the thermodynamic bracket."""
    x, coefficients, _ = data(M, seed)
    residuals, tensor = splitting(M, x, coefficients)
    assert_zero(residuals)
    assert np.linalg.matrix_rank(tensor) == M.dim - 1


def test_brackets_in_coordinates():
    """``{f, g}`` and ``[f, g]`` in coordinates, §2.1; the first term of the Jacobi bracket is misprinted there."""
    M = mf.CanonicalContact(1)
    x, coefficients, _ = data(M, 11)
    f, g, _ = functions(coefficients)
    p, (fq, fp, fS), (gq, gp, gS) = x[1], np.asarray(jax.grad(f)(x)), np.asarray(jax.grad(g)(x))
    thermal = -fS * (p * gp - g(x)) + gS * (p * fp - f(x))
    assert float(M.jacobi_bracket(f, g)(x)) == pytest.approx(float(fp * gq - fq * gp + thermal), abs=1e-14)
    assert abs(float(M.jacobi_bracket(f, g)(x) - (fq * gp + thermal))) > 0.1  # as printed
    cartan = fp * gq - fq * gp - fS * p * gp + gS * p * fp
    assert float(M.cartan_bracket(f, g)(x)) == pytest.approx(cartan, abs=1e-14)


# -- controls that must fail ------------------------------------------------------------------------------------------


@eqx.filter_jit
def false_claims(M, x, coefficients):
    f, g, h = functions(coefficients)
    jacobi, df, eta, R = M.jacobi_bracket, jax.grad(f)(x), M.form(x), M.reeb(x)
    leibniz = jacobi(f, lambda y: g(y) * h(y))(x) - (g(x) * jacobi(f, h)(x) + h(x) * jacobi(f, g)(x))
    eta_rate = lie_derivative(M.evolution_vector_field(f), M.form, x)
    return {
        "{f, g} obeys Leibniz": leibniz,
        "(5) with E(h), as printed": leibniz + g(x) * h(x) * (jax.grad(h)(x) @ R),
        "X_f(f) = 0": df @ M.hamiltonian_vector_field(f)(x),
        "E_f keeps ker eta": eta_rate - (eta_rate @ R) * eta,
    }


@pytest.mark.sampled(1)
@each_structure
def test_false_claims_are_seen_to_be_false(M):
    assert_visible(false_claims(M, *data(M, 7)[:2]))


@pytest.mark.slow
@each_split
def test_the_cosymplectic_part_alone_is_another_dynamics(M):
    """Lambda_0 conserves f too, but its field leaves the kernel of eta and produces no S."""
    x, coefficients, _ = data(M, 7)
    df = jax.grad(functions(coefficients)[0])(x)
    field = M.cosymplectic_sharp(x, df)
    assert_zero({"f": df @ field, "S": field[-1]})
    assert_visible({"eta": M.form(x) @ field})


def test_unusable_structures():
    for n in (0, 1.5):
        with pytest.raises(mf.ParameterError, match="positive integer"):
            mf.CanonicalContact(n)
    for dim in (2, 1, 3.0):
        with pytest.raises(mf.ParameterError, match="must be odd"):
            mf.ContactForm(lambda x: x, dim)
    with pytest.raises(mf.ShapeError, match=r"shape \(5,\)"):
        mf.ContactForm(lambda x: x[:2], 5)
    with pytest.raises(mf.ShapeError, match="last axis 3"):
        mf.CanonicalContact(1).evolution_vector_field(lambda x: x[0])([1.0, 2.0])


def test_a_form_with_an_index_out_of_range_is_refused():
    with pytest.raises(IndexError, match="a contact form has the index 3 of an axis with 3 entries"):
        mf.ContactForm(lambda x: jnp.array([-x[3], 0.0, 1.0]), 3)
