"""Matrix groups: every registered one through the same properties, closed forms against general ones, and controls."""

from fractions import Fraction
from functools import cache
from math import factorial, pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

import manifolds as mf
from manifolds import matrix_functions
from manifolds.closed_forms import stumpff

TOLERANCES = {
    # name: (bound, what was measured and why)
    "member": (5e-15, "at most 2e-15 seen, up to eight squarings or products of rotations"),
    "roundtrip": (1e-14, "log(exp(x)) - x, |x| <= 1.5; at most 3e-15 seen, a few roundings times cond(g)"),
    "product": (2e-14, "identities between products of three or four elements; at most 6e-15 seen"),
    "adjoint": (2e-13, "Ad(exp x) - expm(ad x) relative; at most 6e-14 seen, nearly all of it SciPy's expm"),
    "reference": (2e-13, "relative to SciPy's expm and logm; at most 5e-14 seen, nearly all of it SciPy's"),
    "derivative": (2e-14, "automatic derivatives against exact ones; at most 5e-15 seen"),
    "half_turn": (5e-15, "SO, SE, SU within 1e-7 of the cut; at most 2e-15 seen, roundings of pi"),
    "stumpff": (1e-15, "relative, for z < 9; at most 5e-16 seen"),
}

seeds = st.integers(0, 10**6)
BATCH = 4


def close(a, b, name, scale=1.0):
    return np.abs(np.asarray(a) - np.asarray(b)).max(initial=0.0) <= TOLERANCES[name][0] * scale


def elements(group, seed, count=1, size=1.0):
    """Batches of algebra elements of Euclidean norm ``size``: inside the domain of log for sizes below pi / 2."""
    x = np.random.default_rng(seed).standard_normal((count, BATCH, group.dim))
    x *= size / np.linalg.norm(x, axis=-1, keepdims=True)
    return x if count > 1 else x[0]


def duals(group, seed):
    return np.random.default_rng(10_000 + seed).standard_normal((BATCH, group.dim))


@pytest.fixture(scope="module", params=list(mf.registered_groups()), ids=lambda group: group.name)
def G(request):
    """Module scope: pytest then runs all tests of one group together, which share its compiled maps."""
    return request.param


@cache
def traced_log(group):
    return jax.jit(group.log)


# -- every registered group: exp, log, products -----------------------------------------------------------------------


@given(seed=seeds)
def test_exp_lands_in_the_group(G, seed):
    for size in (1e-3, 1.0, 3.0):
        g = G.exp(elements(G, seed, size=size))
        assert g.shape == (BATCH, G.matrix_size, G.matrix_size)
        assert bool(G.belongs(g, TOLERANCES["member"][0]).all())
    assert np.array_equal(G.exp(np.zeros(G.dim)), G.identity)


@given(seed=seeds)
def test_log_inverts_exp(G, seed):
    for size in (1e-3, 0.5, 1.5):
        x = elements(G, seed, size=size)
        assert close(G.log(G.exp(x)), x, "roundtrip")


@given(seed=seeds)
def test_exp_is_a_one_parameter_subgroup(G, seed):
    x = elements(G, seed)
    assert close(G.compose(G.exp(0.3 * x), G.exp(0.9 * x)), G.exp(1.2 * x), "product")


@given(seed=seeds)
def test_group_axioms(G, seed):
    g, h, k = (G.exp(x) for x in elements(G, seed, 3))
    assert close(G.compose(g, G.inverse(g)), G.identity, "product")
    assert close(G.compose(G.inverse(g), g), G.identity, "product")
    assert close(G.compose(G.compose(g, h), k), G.compose(g, G.compose(h, k)), "product", 10.0)
    assert close(G.inverse(G.compose(g, h)), G.compose(G.inverse(h), G.inverse(g)), "product", 10.0)
    assert bool(G.belongs(G.compose(g, h), TOLERANCES["member"][0]).all())
    assert bool(G.belongs(G.inverse(g), TOLERANCES["member"][0]).all())


def slope(sizes, errors):
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


SIZES = np.array([0.2, 0.1, 0.05, 0.025])


def test_product_is_baker_campbell_hausdorff_to_second_order(G):
    x, y = elements(G, 1, 2)[:, :1] * SIZES[:, None]
    third = G.log(G.compose(G.exp(x), G.exp(y))) - (x + y + G.algebra.bracket(x, y) / 2)
    errors = np.abs(third).max(axis=-1)
    if G.algebra.is_nilpotent():  # the series ends here
        assert close(third, 0.0, "roundtrip")
    else:
        assert abs(slope(SIZES, errors) - 3) < 0.2


# -- every registered group: adjoint and coadjoint action -------------------------------------------------------------


@given(seed=seeds)
def test_adjoint_action(G, seed):
    x, y, z = elements(G, seed, 3)
    g, h = G.exp(x), G.exp(y)
    conjugate = g @ G.algebra.hat(z) @ G.inverse(g)
    assert close(jnp.einsum("...ab,...b->...a", G.Ad(g), z), G.algebra.vee(conjugate), "product", 10.0)
    assert close(G.Ad(G.compose(g, h)), G.Ad(g) @ G.Ad(h), "product", 10.0)
    expected = scipy.linalg.expm(np.asarray(G.algebra.ad(x)))
    assert close(G.Ad(g), expected, "adjoint", np.abs(expected).max())


@given(seed=seeds)
def test_coadjoint_action(G, seed):
    (x, y), mu = elements(G, seed, 2), duals(G, seed)
    g, h = G.exp(x), G.exp(y)

    def paired(mu, x):
        return (np.asarray(mu) * x).sum(axis=-1)

    moved = np.einsum("...ab,...b->...a", G.Ad(g), y)
    assert close(paired(G.Ad_star(g, mu), y), paired(mu, moved), "product", 10.0)
    assert close(G.Ad_star(G.compose(g, h), mu), G.Ad_star(h, G.Ad_star(g, mu)), "product", 100.0)
    if not G.algebra.is_abelian():  # control: the action of the inverse, another convention in use, is not dual
        assert not close(paired(G.Ad_star(G.inverse(g), mu), y), paired(mu, moved), "product", 1e6)


def test_derivative_of_the_coadjoint_action_is_ad_star(G):
    x, mu = elements(G, 2), duals(G, 2)

    def along(t):
        return G.Ad_star(G.exp(t * x), mu)

    _, rate = jax.jit(lambda t: jax.jvp(along, (t,), (1.0,)))(0.0)
    assert close(rate, G.algebra.ad_star(x, mu), "derivative")
    if not G.algebra.is_abelian():  # control
        assert not close(-rate, G.algebra.ad_star(x, mu), "derivative", 1e6)


# -- every registered group: Cayley -----------------------------------------------------------------------------------


def test_cayley(G):
    if G.name in ("SL(3)", "SU(3)"):
        with pytest.raises(mf.LieAlgebraError, match=r"does not take s[lu].3. into S[LU]\(3\).*use exp"):
            G.cayley(np.zeros(G.dim))
        return
    x = elements(G, 3)
    g, X = G.cayley(x), np.asarray(G.algebra.hat(x))
    one = np.eye(G.matrix_size)
    assert bool(G.belongs(g, TOLERANCES["member"][0]).all())
    assert close(g, np.linalg.solve(one - X / 2, one + X / 2), "product")
    assert close(G.cayley(-x), G.inverse(g), "product")
    x = x[:1] * SIZES[:, None]
    errors = np.abs(G.cayley(x) - G.exp(x)).max(axis=(-2, -1))
    if G.algebra.is_nilpotent() and not G.algebra.is_abelian():  # X^3 = 0, and the two agree
        assert close(errors, 0.0, "member")
    else:
        assert abs(slope(SIZES, errors) - 3) < 0.2


# -- every registered group: arrays, derivatives, compiled programs ---------------------------------------------------


def test_exp_and_log_equal_scipy(G):
    x = elements(G, 4)
    g = np.asarray(G.exp(x))
    expected = scipy.linalg.expm(np.asarray(G.algebra.hat(x)))
    assert close(g, expected, "reference", np.abs(expected).max())
    logarithms = np.stack([scipy.linalg.logm(one) for one in g])
    assert close(G.algebra.hat(G.log(g)), logarithms, "reference")


def test_batches_equal_loops(G):
    x, mu = elements(G, 5), duals(G, 5)
    g = G.exp(x)
    assert close(G.exp(x[2]), g[2], "member", 10.0)
    assert close(G.inverse(g[2]), G.inverse(g)[2], "product")
    assert close(G.Ad(g[2]), G.Ad(g)[2], "product")
    assert close(G.Ad_star(g[2], mu[2]), G.Ad_star(g, mu)[2], "product")
    assert close(G.Ad_star(g[2], mu)[2], G.Ad_star(g, mu)[2], "product")
    assert G.Ad(g.reshape(2, 2, *g.shape[1:])).shape == (2, 2, G.dim, G.dim)
    assert G.belongs(g).shape == (BATCH,)
    assert G.belongs(g[0]).shape == ()


def test_gradient_of_exp_at_zero_is_the_basis(G):
    gradient = jax.jit(jax.grad(lambda x: G.exp(x).real.sum()))(np.zeros(G.dim))
    assert close(gradient, G.algebra.basis.real.sum(axis=(1, 2)), "derivative")


def test_tiny_elements_keep_their_digits(G):
    x = elements(G, 8, size=1e-9)
    X = np.asarray(G.algebra.hat(x))
    off_diagonal = ~np.eye(G.matrix_size, dtype=bool)
    assert close(G.exp(x)[:, off_diagonal], (X + X @ X / 2)[:, off_diagonal], "roundtrip", 1e-9)


def test_compiled_programs_make_no_lapack_calls(G):
    """Two of them in one program can wait for each other forever (see matrix_functions.solve)."""
    x = elements(G, 9)
    for function, argument in ((G.exp, x), (G.log, G.exp(x)), (G.inverse, G.exp(x)), (G.Ad, G.exp(x))):
        assert "lapack" not in jax.jit(function).lower(argument).as_text()
    assert "lapack" in jax.jit(lambda x: jnp.linalg.inv(G.exp(x))).lower(x).as_text()  # control


def test_random_elements(G):
    g = G.random(3, (BATCH,))
    assert g.shape == (BATCH, G.matrix_size, G.matrix_size)
    assert bool(G.belongs(g).all())
    assert np.array_equal(g, G.random(jax.random.key(3), (BATCH,)))


def test_groups_are_static_and_compare_by_value(G):
    (twin,) = (other for other in mf.registered_groups() if other.name == G.name)
    assert twin is not G
    assert twin == G
    assert hash(twin) == hash(G)
    assert jax.tree_util.tree_leaves(G) == []
    assert close(jax.jit(lambda group, x: group.exp(x))(G, np.zeros(G.dim)), G.identity, "member")
    assert mf.SO(4) != mf.SO(3)
    assert G.name in repr(G)


# -- every registered group: what is refused --------------------------------------------------------------------------


def test_off_the_group(G):
    g = np.array(G.exp(elements(G, 10)))
    if G.name.startswith("GL"):
        g[1] = 0.0
    else:
        g[1] *= 1.001  # moves the determinant, the last row or the diagonal of every other group
    assert G.belongs(g).tolist() == [True, False, True, True]
    with pytest.raises(mf.DomainError, match=r"g\[1\] is not in the group: relative distance .* tolerance 1e-08"):
        G.log(g)
    g[1] = np.nan
    assert not G.belongs(g)[1]
    with pytest.raises(mf.DomainError, match=r"g\[1\] has entries that are not finite"):
        G.log(g)


def test_wrong_shapes_and_kinds(G):
    with pytest.raises(mf.ShapeError, match="last axis"):
        G.exp(np.zeros(G.dim + 1))
    for operation in (G.log, G.inverse, G.Ad, G.belongs):
        with pytest.raises(mf.ShapeError, match="last axes"):
            operation(np.zeros((G.matrix_size, G.matrix_size + 1)))
    with pytest.raises(mf.ComponentError):
        G.exp(np.zeros(G.dim, dtype=complex))
    if G.name.startswith("SU"):
        assert bool(G.belongs(np.eye(G.matrix_size)))
    else:
        with pytest.raises(mf.ComponentError, match="must be real"):
            G.log(np.eye(G.matrix_size, dtype=complex))


# -- particular groups ------------------------------------------------------------------------------------------------


DIFFERENTIATED = [mf.SO(3), mf.SE(3), mf.SU(2), mf.Heisenberg(1), mf.SO(4), mf.SL(2)]
"""Every closed form, and the general functions for a compact and a noncompact group: the rule of log is one for all."""


@pytest.mark.parametrize("group", DIFFERENTIATED, ids=lambda group: group.name)
def test_derivative_of_log_after_exp_is_the_identity(group):
    """At zero, next to it and elsewhere; mapped over a batch, so that maps and loops are compared too."""

    def one(x, v):
        return jax.jvp(lambda x: group.log(group.exp(x)), (x,), (v,))

    mapped, v = jax.jit(jax.vmap(one)), elements(group, 6)
    for size in (0.0, 1e-10, 1.0):
        x = elements(group, 7, size=size)
        value, derivative = mapped(x, v)
        assert close(value, x, "roundtrip")
        assert close(derivative, v, "derivative")


@pytest.mark.parametrize("group", [mf.SO(3), mf.SU(2), mf.SL(2)], ids=lambda group: group.name)
def test_reverse_mode_and_second_derivatives(group):
    x, mu = elements(group, 11)[0], duals(group, 11)[0]
    shift = group.exp(elements(group, 12)[0])

    def f(x):
        return jnp.dot(mu, group.log(group.compose(group.exp(x), shift)))

    both = jax.jit(lambda x: (jax.jacfwd(f)(x), jax.jacrev(f)(x), jax.jacfwd(jax.jacrev(f))(x)))
    for at in (x, np.zeros(group.dim)):
        forward, reverse, hessian = both(at)
        assert close(forward, reverse, "derivative")
        assert close(hessian, hessian.T, "derivative", 10.0)


def turned(group, gap, seed=0):
    """Elements whose largest eigenvalue angle is pi - gap: one turning plane where there are several."""
    x = elements(group, seed)
    if group.name == "SO(4)":
        B = np.zeros((4, 4))
        B[0, 1], B[2, 3] = pi - gap, 1.0
        Q = np.asarray(group.random(seed, (BATCH,), 1.0))
        return np.asarray(group.algebra.vee(Q @ (B - B.T) @ Q.swapaxes(1, 2)))
    if group.name == "SU(3)":
        Q = np.asarray(group.random(seed, (BATCH,), 1.0))
        B = 1j * np.diag([pi - gap, -2.0, 2.0 - pi + gap])
        return np.asarray(group.algebra.vee(Q @ B @ Q.conj().swapaxes(1, 2)))
    full = 2 * (pi - gap) if group.name == "SU(2)" else pi - gap
    x[:, :3] *= full / np.linalg.norm(x[:, :3], axis=-1, keepdims=True)
    return x


COMPACT = [mf.SO(3), mf.SE(3), mf.SU(2), mf.SO(4), mf.SU(3)]


@pytest.mark.parametrize("group", COMPACT, ids=lambda group: group.name)
def test_log_up_to_the_half_turn(group):
    for gap in (1e-2, 1e-6, 1e-7):
        x = turned(group, gap)
        assert close(group.log(group.exp(x)), x, "half_turn")
    for gap in (1e-9, 0.0):
        g = group.exp(turned(group, gap))
        with pytest.raises(
            mf.DomainError, match=r"g\[0\] has the eigenvalue -1.* at the angle 3\.14159.*pi - 1e-08: take"
        ):
            group.log(g)
        assert bool(jnp.isnan(traced_log(group)(g)).all())


def test_log_of_shears_near_the_negative_axis_loses_digits_as_its_condition_says():
    """A pair of eigenvalues at +-(pi - d), mixed by a shear: the logarithm itself has the condition number 1/d."""
    group, shear = mf.SL(2), np.array([[1.0, 2.0], [0.0, 1.0]])
    for gap in (1e-2, 1e-4, 1e-6):
        X = shear @ np.array([[0.0, gap - pi], [pi - gap, 0.0]]) @ np.linalg.inv(shear)
        x = group.algebra.vee(X)
        assert np.abs(group.log(group.exp(x)) - x).max() < 1e-14 / gap


@pytest.mark.parametrize(
    ("group", "g", "message"),
    [
        (mf.SO(3), np.diag([-1.0, -1.0, 1.0]), "eigenvalue -1.*det g = 1"),
        (mf.SL(2), np.diag([-2.0, -0.5]), "eigenvalue -2 at the angle 3.1415926536"),
        (mf.GL(2), np.diag([3.0, -2.0]), "eigenvalue -2 .*det g = -6;"),
        (mf.GL(1), [[-1.0]], "det g = -1;"),
        (mf.SU(2), -np.eye(2), "eigenvalue -1"),
        (mf.SO(3), np.diag([1.0, 1.0, -1.0]), "not in the group: relative distance 2,"),
    ],
)
def test_matrices_without_principal_logarithm(group, g, message):
    with pytest.raises(mf.DomainError, match=message):
        group.log(g)


@pytest.mark.parametrize(
    ("group", "x", "eigenvalue"),
    [
        (mf.GL(1), [2.0], "2"),
        (mf.GL(1), [-2.0], "-2"),
        (mf.SL(2), [2.0, 0.0, 0.0], "-?2"),
        (mf.Sp(1), [2.0, 1.0, 0.0], "-?2"),
    ],
)
def test_poles_of_the_cayley_map(group, x, eigenvalue):
    with pytest.raises(mf.DomainError, match=f"x\\[1\\] has the eigenvalue {eigenvalue},.*shorten x or use exp"):
        group.cayley([np.zeros(group.dim), x])
    assert bool(jnp.isnan(jax.jit(group.cayley)(np.array(x))).all())


def test_inverse_of_a_singular_matrix():
    with pytest.raises(mf.DomainError, match=r"GL\(2\): g\[1\] has no inverse"):
        mf.GL(2).inverse([np.eye(2), [[1.0, 2.0], [2.0, 4.0]]])


def test_log_of_large_and_small_scales():
    group = mf.GL(2)
    for factor in (1e-100, 1e100):
        assert close(group.log(factor * np.eye(2)), np.log(factor) * np.array([1.0, 0.0, 0.0, 1.0]), "roundtrip", 100.0)


def test_a_group_of_ones_own():
    """The docstring's promise: an algebra with matrices and a defect are enough."""
    group = mf.MatrixGroup("Aff+(1)", mf.aff(1), lambda g: jnp.abs(g[..., 1, :] - jnp.array([0.0, 1.0])).max(axis=-1))
    x = elements(group, 13)
    g = group.exp(x)
    assert close(group.log(g), x, "roundtrip")
    assert close(g[:, 0, 0], np.exp(x[:, 0]), "member")
    assert bool(group.belongs(group.inverse(g)).all())


# -- the numerical tools ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_stumpff_functions(order):
    for z in (0.0, 1e-20, 0.3, 0.999999, 1.0, 1.000001, 2.0, 8.0):
        exact = float(sum(Fraction(-z) ** k / factorial(2 * k + order) for k in range(30)))
        assert abs(float(stumpff(order, z)) - exact) <= TOLERANCES["stumpff"][0] * max(
            abs(exact), 0.5 / factorial(order)
        )
    slope_at_zero = jax.grad(lambda z: stumpff(order, z))(0.0)
    assert float(slope_at_zero) == -1.0 / factorial(order + 2)


@pytest.mark.parametrize("angle", [1e-5, 1.0, 5.3, 5.5, 10.6, 21.0, 1000.0])
def test_matrix_exponential_of_rotations(angle):
    """``jax.scipy.linalg.expm`` is wrong by 1e-8 at 10.6."""
    g = matrix_functions.expm(jnp.array([[0.0, -angle], [angle, 0.0]]))
    exact = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    assert close(g, exact, "member", max(1.0, angle / 5))


def test_matrix_exponential_beyond_its_range_is_nan():
    assert bool(jnp.isnan(matrix_functions.expm(1e6 * jnp.eye(2))).all())
    assert bool(jnp.isnan(matrix_functions.expm(jnp.full((2, 2), jnp.nan))).all())


@pytest.mark.parametrize("dtype", [float, complex])
def test_solve_and_determinant(dtype):
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 3, 5, 5)).astype(dtype)
    if dtype is complex:
        a, b = a + 1j * b, b - 2j * a
    a[0, 0, 0] = 0.0  # needs a row exchange
    x = matrix_functions.solve(a, b)
    assert np.abs(a @ x - b).max() < 1e-13
    assert np.allclose(matrix_functions.determinant(a), np.linalg.det(a), rtol=1e-13, atol=0.0)
    assert not np.isfinite(matrix_functions.inverse(np.zeros((2, 2)))).any()

    def total(solver):
        return jax.grad(lambda a, b: jnp.abs(solver(a, b)).sum(), argnums=(0, 1))(a, b)

    for ours, theirs in zip(total(matrix_functions.solve), total(jnp.linalg.solve), strict=True):
        assert np.allclose(ours, theirs, rtol=1e-11, atol=1e-11)
